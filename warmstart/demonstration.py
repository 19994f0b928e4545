"""From a solution to a demonstration: certified, tracked in MuJoCo, labelled with what it achieved.

``python -m warmstart.demonstration SOLUTION.npz... --out DIR`` writes, for each solution that
passes, ``PROBLEM_ASKED_STRENGTH[_STYLE].npz`` and its certificate beside it. This is what made the
shipped clips, but the free throws: those are of :mod:`warmstart.robust_throw`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warmstart.certificate import Certificate, certify
from warmstart.clip import Clip, clip_from_solution
from warmstart.judged import RULES
from warmstart.outcome import OUTCOMES, is_cycle, link_poses
from warmstart.refine import Search, refine
from warmstart.refined_throw import labelled
from warmstart.replay import FEEDBACK, REPLAY_RATE, Replayed, replay_all
from warmstart.solution import Solution
from warmstart.tracking import Tracking, track_best


@dataclass(frozen=True)
class Demonstration:
    """What became of a solution."""

    certificate: Certificate
    """Of the plan."""
    clip: Clip | None
    """The tracked motion; None when the gate refused the solution or it could not be simulated."""
    reason: str
    """Why it is not a demonstration; empty when it is one."""

    @property
    def passed(self) -> bool:
        """Its plan is certified, and in MuJoCo it is a success by the task's rules that reaches
        what was asked (of a free throw: a basket)."""
        return self.clip is not None and not self.reason


def demonstrate(
    solution: Solution,
    settings: Tracking | None = None,
    *,
    certificate: Certificate | None = None,
    attempts: int = 3,
    threads: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Demonstration:
    """Certifies a solution and tracks it in its task; a strike or throw, whose gate asks for a
    replay that reaches the outcome, is that replay in MuJoCo; a free throw is thrown in its task
    with the real ball (:mod:`warmstart.refine`), which makes it another motion than the certified
    one: clip and certificate then say what it does in both engines and whether it is certified
    (:mod:`warmstart.refined_throw`).

    A ``certificate`` of the solution, where there is one already, is taken as it is. Raises
    ValueError when the solution's problem is no task.
    """
    certificate = certificate or certify(solution)
    if not certificate.passed:
        return Demonstration(certificate, None, "; ".join(certificate.failures))
    if solution.problem == "free_throw":
        return _thrown(solution, certificate, attempts, threads, progress)
    if solution.problem in RULES:
        return Demonstration(certificate, strike_clip(solution, certificate), "")
    try:
        tracked = track_best(
            solution, settings, attempts=attempts, threads=threads, progress=progress
        )
    except RuntimeError as error:
        return Demonstration(certificate, None, str(error))
    clip = tracked.clip
    meta = {
        **clip.meta,
        "certified": True,
        "planned": certificate.achieved.get("planned"),
        "link_error": tracked.link_error,
        "root_error": tracked.root_error,
    }
    reason = ""
    if not tracked.success:
        reason = no_success(clip, "tracked")
    elif tracked.share < 1.0:
        reason = f"tracked in MuJoCo, it reaches {100 * tracked.share:.1f} % of what was asked"
    return Demonstration(certificate, replace(clip, meta=meta), reason)


def no_success(clip: Clip, how: str) -> str:
    """Why a clip that was ``how`` (tracked, thrown) in MuJoCo is no demonstration."""
    return f"{how} in MuJoCo, the task calls it no success: {clip.meta['achieved']}"


def _thrown(
    solution: Solution,
    certificate: Certificate,
    attempts: int,
    threads: int,
    progress: Callable[[int, int], None] | None,
) -> Demonstration:
    """A free throw that the task counts as a basket, sought with other seeds until it does."""
    clip, reason = None, ""
    for seed in range(attempts):
        try:
            clip = refine(solution, Search(seed=seed), threads=threads, progress=progress).clip
        except RuntimeError as error:
            reason = str(error)
            continue
        if clip.meta["achieved"].get("success") == 1.0:
            clip, certificate = labelled(clip, certificate)
            return Demonstration(certificate, clip, "")
        reason = no_success(clip, "thrown")
    return Demonstration(certificate, clip, reason)


def strike_clip(solution: Solution, certificate: Certificate, fps: float = 60.0) -> Clip:
    """The replay of a certified strike or throw in MuJoCo as a clip, labelled with its figures.

    ``ctrl`` are the targets averaged over each frame, with what feedback added. Raises
    RuntimeError when it diverges.
    """
    planned = clip_from_solution(solution, fps)
    played = replay_all(solution, "mujoco", hold=0.0)
    times, qpos, qvel = played.times, played.qpos, played.qvel
    rows = np.round(planned.times * REPLAY_RATE).astype(int)
    rows = rows[rows < len(times)]
    assert planned.ctrl is not None
    width = planned.qpos.shape[1]
    motion = solution.sample(solution.times[0] + times[rows])["qpos"]
    places, _ = link_poses(solution.body, qpos[rows, :width])
    wanted, _ = link_poses(solution.body, motion)
    error = np.linalg.norm(places - wanted, axis=2)
    head = "replay in mujoco: "
    achieved = {
        c.name.removeprefix(head).replace(":", "").replace(" ", "_"): c.value
        for c in certificate.checks
        if c.name.startswith(head)
    }
    achieved[RULES[solution.problem].outcome] = achieved.pop("outcome")
    event, options = solution.stats["event"], solution.stats.get("options", {})
    meta = {
        **planned.meta,
        "source": "trajectory optimisation, replayed in MuJoCo"
        + (" with feedback" if solution.stats.get(FEEDBACK) else ""),
        "achieved": {k: round(v, 6) for k, v in achieved.items()},
        "options": options,
        "events": {"strike" if RULES[solution.problem].nearest else "release": event["time"]},
        "certified": True,
        "planned": certificate.achieved.get("planned"),
        "link_error": float(np.sqrt(np.mean(error**2))),
        "root_error": float(error[:, 0].max()),
    }
    return replace(
        planned,
        qpos=qpos[rows, :width],
        qvel=qvel[rows, : width - 1],
        ctrl=planned.ctrl[: len(rows)] + _held(played, rows) / solution.body.array("kp"),
        meta=meta,
    )


def _held(played: Replayed, rows: np.ndarray) -> np.ndarray:
    """(F, n) mean torque of feedback (N m) from each row of a replay to the next one."""
    ends = np.append(rows[1:], len(played.feedback))
    pairs = zip(rows, ends, strict=True)
    none = np.zeros(played.feedback.shape[1])
    return np.array([played.feedback[a:b].mean(0) if b > a else none for a, b in pairs])


def name_of(solution: Solution) -> str:
    """Of a demonstration's file: problem, side of a stroke or kind of punch, outcome, steps before
    it or whether a stride goes on after it, strength, style of a jump."""
    problem, options = solution.problem, solution.stats.get("options", {})
    side = options.get("side", options.get("punch"))
    rules = RULES.get(problem)
    asked = solution.asked[rules.outcome if rules else OUTCOMES[problem].field]
    unit = rules.unit.replace("/", "p") if rules else "m"
    step = ["step"] if options.get("approach") else []
    step += ["steps"] if options.get("from_start") else []
    step += ["cycle"] if is_cycle(solution.asked) else []
    words = [problem, *([side] if side else []), f"{asked:g}{unit}", *step, solution.strength]
    if solution.stats.get("style", "tuck") != "tuck":
        words.append(solution.stats["style"])
    return "_".join(words)


def save_demonstration(found: Demonstration, clip_path: Path, certificate_path: Path) -> None:
    """Writes the certificate always, and the clip if there is one, each atomically."""
    found.certificate.to_json(certificate_path)
    if found.clip is not None:
        found.clip.save(clip_path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Makes demonstrations of solution files; 1 when one of them failed, 2 for a bad file."""
    parser = argparse.ArgumentParser(prog="python -m warmstart.demonstration", description=__doc__)
    parser.add_argument("solutions", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--attempts", type=int, default=5)
    options = parser.parse_args(arguments)
    failed = 0
    for path in options.solutions:
        try:
            solution = Solution.load(path)
            found = demonstrate(solution, attempts=options.attempts)
            name = name_of(solution)
        except (ValueError, KeyError) as error:
            print(f"{path}: {error}", file=sys.stderr)
            return 2
        if found.passed:
            out = options.out
            save_demonstration(found, out / f"{name}.npz", out / f"{name}.json")
            assert found.clip is not None
            print(f"{name}: {found.clip.meta['achieved']}")
        else:
            failed += 1
            print(f"{name}: no demonstration: {found.reason}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
