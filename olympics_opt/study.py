"""The whole line on one sport, in stages that survive being stopped.

solve -> certify -> warm start -> train -> evaluate -> verify -> report. Each stage has a folder;
stopped at any moment, the same command goes on with the stage it was in (training from its last
checkpoint). Sized to end within a quarter of an hour on two processor cores.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from olympics_opt.fine_tune import POLICY, FineTuning, fine_tune
from olympics_opt.solve import CERTIFICATE, DEMO, SOLUTION
from olympics_opt.stages import Done, Stage, run_stages
from warmstart import atomic

if TYPE_CHECKING:
    from olympics_opt.cli import Study

REPORT = "report.html"


@dataclass(frozen=True)
class Plan:
    """What a study of a sport optimises, trains and plays."""

    problem: str
    outcome: float
    """Prescribed outcome of the optimisation, in the problem's unit."""
    strengths: tuple[str, ...] = ("human", "paper")
    """Strengths of the optimised athlete, in this order until one is feasible."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of the task in training and in every trial."""


PLANS: dict[str, Plan] = {
    "high_jump": Plan("high_jump", 1.0, options={"bar_height": 1.0}),
    "long_jump": Plan("long_jump", 5.0),
}

TUNING = FineTuning()


def run_study(config: Study) -> int:
    """The command. Raises ValueError for a sport without a plan, PolicyError for a policy that
    cannot be fine-tuned, Infeasible, and KeyboardInterrupt where it was asked to stop."""
    from rl.policy import load_policy

    if config.name not in PLANS:
        raise ValueError(f"there is no study of '{config.name}'; there is: {', '.join(PLANS)}")
    plan = PLANS[config.name]
    # An unusable policy is told before anything is solved.
    policy = load_policy(config.policy, config.name)
    if policy.actor is None:
        raise ValueError(f"'{config.policy}' is a baseline: a study fine-tunes a trained policy")
    stages = make_stages(config, plan, policy.metadata)
    try:
        done = run_stages(config.out, stages)
    except KeyboardInterrupt:
        print("\nThe study stops here; the same command continues it.")
        raise
    atomic.write_bytes(config.out / REPORT, (config.out / "report" / REPORT).read_bytes())
    total = sum(d.seconds for d in done.values())
    print(f"study of {config.name}: {total / 60:.1f} minutes in all")
    print(headline(done))
    print(f"report: {(config.out / REPORT).resolve()}")
    return 0


def make_stages(config: Study, plan: Plan, card: dict[str, Any]) -> list[Stage]:
    """The stages of a study, wired to its folders; ``card`` is that of the shipped policy."""
    out, task = config.out, config.name
    policy_sha256 = card["sha256"]
    tuned = str(out / "train" / POLICY)

    def solve(folder: Path) -> dict[str, Any]:
        from olympics_opt.solve import optimise
        from warmstart.problems import Infeasible, get_problem

        problem = get_problem(plan.problem)
        refused: list[str] = []
        for strength in plan.strengths:
            options = {problem.outcome: plan.outcome, "strength": strength}
            try:
                solution = optimise(plan.problem, problem.config(**options), folder)
            except Infeasible as error:
                refused.append(f"strength {strength}: {error}")
                continue
            return {"strength": strength, "refused": refused, "stats": solution.stats}
        raise Infeasible("; ".join(refused))

    def certify(folder: Path) -> dict[str, Any]:
        from olympics_opt.solve import certify_solution
        from warmstart.solution import Solution

        solution = Solution.load(out / "solve" / SOLUTION)
        certificate = certify_solution(solution, folder)
        if not certificate.passed:
            raise RuntimeError(
                "the optimised motion is not certified, so it must not be learned from: "
                f"{'; '.join(certificate.failures)} (see {folder / CERTIFICATE})"
            )
        return {"passed": True, "achieved": certificate.achieved}

    def warm_start(folder: Path) -> dict[str, Any]:
        from olympics_opt.solve import make_demonstration
        from warmstart.certificate import Certificate
        from warmstart.solution import Solution

        solution = Solution.load(out / "solve" / SOLUTION)
        certificate = Certificate.from_json(out / "certify" / CERTIFICATE)
        found = make_demonstration(solution, certificate, folder, config.seed)
        meta = found.clip.meta if found.clip is not None else {}
        return {
            "success": found.passed,
            "reason": found.reason,
            "achieved": meta.get("achieved", {}),
            "link_error": meta.get("link_error"),
            "root_error": meta.get("root_error"),
        }

    def train(folder: Path) -> dict[str, Any]:
        from rl.train import TrainConfig
        from warmstart.bank import demonstration_files

        demo = out / "warm_start" / DEMO
        clips = (demo,) if demo.is_file() else tuple(demonstration_files(plan.problem))
        trained = card.get("config")
        facts = fine_tune(
            TrainConfig(
                task=task,
                out=folder / "run",
                engine="mujoco",
                worlds=config.worlds,
                minutes=config.minutes,
                seed=config.seed,
                checkpoint_minutes=0.5,
                options=plan.options,
                vary=bool(trained.get("vary")) if isinstance(trained, dict) else False,
                init=config.policy,
                clips=clips,
            ),
            folder,
            TUNING,
        )
        return facts | {"clips": ["the tracked motion" if c == demo else c.stem for c in clips]}

    def evaluate(folder: Path) -> dict[str, Any]:
        from olympics_opt.play import play, training_step

        for name, source in (("shipped", config.policy), ("fine-tuned", tuned)):
            played = play(
                task,
                source,
                trials=config.trials,
                seed=config.seed,
                options=plan.options,
                record=True,
                label=f"{name} policy",
            )
            atomic.write_json(folder / f"{name}.json", played.result)
            played.best.save(folder / f"{name}_best.npz")
            played.median.save(folder / f"{name}_median.npz")
        return {"training_step": training_step(config.policy, task)}

    def verify(folder: Path) -> dict[str, Any]:
        from olympics_opt.verify import verdict_text, verify

        report, recordings = verify(
            task,
            tuned,
            trials=config.drake_trials,
            seed=config.seed,
            options=plan.options,
            processes=config.processes,
        )
        report["policy"] = "the fine-tuned policy of this study"
        atomic.write_json(folder / "report.json", report)
        for name, recording in recordings.items():
            recording.save(folder / f"{name}.npz")
        return {"passed": report["verdict"]["passed"], "verdict": verdict_text(report)}

    def write_report(folder: Path) -> dict[str, Any]:
        from olympics_opt.report.page import write_page
        from olympics_opt.report.study import study_page

        write_page(study_page(task, out), folder / REPORT)
        return {}

    seed = {"seed": config.seed}
    return [
        Stage("solve", "Optimising a take-off", solve, {"plan": dataclasses.asdict(plan)}),
        Stage("certify", "Certifying it in Drake and MuJoCo", certify, needs=("solve",)),
        Stage("warm_start", "Tracking it in MuJoCo", warm_start, seed, needs=("solve", "certify")),
        Stage(
            "train",
            f"Fine-tuning a policy for {config.minutes:g} min",
            train,
            {
                **seed,
                "minutes": config.minutes,
                "worlds": config.worlds,
                "policy_sha256": policy_sha256,
                "options": plan.options,
                "fine_tuning": dataclasses.asdict(TUNING),
            },
            needs=("warm_start",),
            continues=True,
        ),
        Stage(
            "evaluate",
            "Playing the shipped and the fine-tuned policy",
            evaluate,
            {**seed, "trials": config.trials, "policy_sha256": policy_sha256},
            needs=("train",),
        ),
        Stage(
            "verify",
            "Verifying in Drake",
            verify,
            {**seed, "trials": config.drake_trials},
            needs=("train",),
        ),
        Stage(
            "report",
            "Writing the report",
            write_report,
            needs=("solve", "certify", "warm_start", "train", "evaluate", "verify"),
        ),
    ]


def headline(done: dict[str, Done]) -> str:
    """What came out, in a few lines."""
    certified = done["certify"].facts.get("achieved") or {}
    figures = ", ".join(f"{k} {v:.3g}" for k, v in certified.items() if isinstance(v, float))
    lines = [f"certified: {figures or 'passed'}"]
    for name in ("shipped", "fine-tuned"):
        result = json.loads((done["evaluate"].folder / f"{name}.json").read_text())
        success = result["metrics"]["success"]
        lines.append(f"{name}: success {success['mean']:.0%} of {result['trials']} trials")
    lines.append(f"in Drake: {done['verify'].facts['verdict']}")
    return "\n".join(lines)
