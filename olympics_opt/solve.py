"""``olympics-opt solve``: a motion from nothing, its certificate, and a page to look at it.

The order is the argument: optimise, prove by other code that the motion is possible, then follow
it in MuJoCo with feedback. Only what passed is written as a demonstration.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from olympics_opt.progress import progress

if TYPE_CHECKING:
    from olympics_opt.cli import Solve
    from olympics_opt.report.page import Plots, Section, Tiles
    from warmstart.certificate import Certificate
    from warmstart.clip import Clip
    from warmstart.demonstration import Demonstration
    from warmstart.drake_nlp import SecondOpinion
    from warmstart.solution import Solution

SOLUTION, DEMO, CERTIFICATE, PREVIEW = (
    "solution.npz",
    "demo.npz",
    "certificate.json",
    "preview.html",
)


def run_solve(config: Solve) -> int:
    """The command: 0 with a demonstration, 1 when the certificate or the tracking refuses it.

    Raises ValueError for an unknown problem or option, options that do not go together, or where
    a second opinion cannot be had, ``Infeasible`` naming the constraint that stopped the optimiser.
    """
    from olympics_opt.cli import chosen_options
    from olympics_opt.solve_many import run_all, run_sweep

    _one_thing_at_a_time(config)
    if config.explain is not None:
        return _explain(config.explain)
    assert config.out is not None
    if config.all:
        return run_all(config.out, config.processes, config.cluster, config.track)
    problem_config = config.problem  # type: ignore[attr-defined]  # added by the command line
    if config.sweep is not None:
        return run_sweep(config, chosen_options(config, "problem"))
    return _solve_one(config, problem_config, config.out)


def _one_thing_at_a_time(config: Solve) -> None:
    """Raises ValueError for a command line that asks for nothing, or for two things."""
    asked = {
        "PROBLEM": bool(config.name),
        "--all": config.all,
        "--explain": config.explain is not None,
    }
    chosen = [name for name, given in asked.items() if given]
    if len(chosen) != 1:
        what = f"not both {' and '.join(chosen)}" if chosen else "see olympics-opt list"
        raise ValueError(f"name a problem, or give --all, or --explain FOLDER: {what}")
    if config.explain is None and config.out is None:
        raise ValueError("--out FOLDER is needed for the results")
    many = config.sweep is not None or config.all
    if config.sweep is not None and not config.name:
        raise ValueError("--sweep is about one problem: name it")
    if config.sweep is not None and config.second_opinion:
        raise ValueError(
            "a second opinion is about one motion: leave out --sweep or --second-opinion"
        )
    if config.cluster is not None and not many:
        raise ValueError("--cluster is for many motions: give --sweep or --all as well")
    if config.continuation and config.sweep is None:
        raise ValueError("--continuation goes from value to value: give --sweep as well")


def _solve_one(config: Solve, problem_config: Any, out: Path) -> int:
    """One motion with everything that can be said about it; 0 with a demonstration."""
    from warmstart.problems import Infeasible

    (out / DEMO).unlink(missing_ok=True)  # of an earlier solve with other options
    begin = time.perf_counter()
    try:
        solution = optimise(config.name, problem_config, out)
    except Infeasible as error:
        for name in (SOLUTION, CERTIFICATE, PREVIEW):  # of the earlier solve, too
            (out / name).unlink(missing_ok=True)
        seconds = time.perf_counter() - begin
        _keep_result(config.name, problem_config, out, "infeasible", str(error), seconds)
        raise
    certificate = certify_solution(solution, out)
    opinion = ask_drake(solution, certificate, out) if config.second_opinion else None
    found = None
    if certificate.passed and config.track:
        found = make_demonstration(solution, certificate, out)
        certificate = found.certificate
    elif certificate.passed:
        from warmstart.clip import clip_from_solution

        clip_from_solution(solution).save(out / DEMO)
    write_preview(solution, certificate, found, out / PREVIEW, opinion)
    status, reason = "certified", ""
    if not certificate.passed:
        status, reason = "rejected", "; ".join(certificate.failures)
    elif found is not None and not found.passed:
        status, reason = "untracked", found.reason
    seconds = time.perf_counter() - begin
    _keep_result(config.name, problem_config, out, status, reason, seconds, solution, certificate)
    _print_outcome(solution, certificate, found, out)
    if opinion is not None:
        print(f"second opinion: {opinion.sentence()}")
    return 0 if (out / DEMO).is_file() else 1


def _keep_result(
    problem: str,
    problem_config: Any,
    out: Path,
    status: str,
    reason: str,
    seconds: float,
    solution: Solution | None = None,
    certificate: Certificate | None = None,
) -> None:
    """Writes solution.json: what became of the motion, and why."""
    from warmstart.job import Result, store
    from warmstart.measure import figures, peak_torques
    from warmstart.problems import get_problem

    asked = float(getattr(problem_config, get_problem(problem).outcome))
    name = SOLUTION.removesuffix(".npz")
    result = Result(name, problem, None, asked, status, reason, seconds)
    if solution is not None and certificate is not None:
        result = dataclasses.replace(
            result,
            achieved=certificate.achieved,
            figures=figures(solution),
            peaks=peak_torques(solution),
        )
    store(out, result, {})


def _explain(folder: Path) -> int:
    """Prints why each result of a folder is a demonstration or not."""
    from warmstart.explain import explain

    cases = explain(folder)
    for case in sorted(cases, key=lambda case: not case.passed):
        print("\n".join(case.lines()))
    print(f"{sum(case.passed for case in cases)} of {len(cases)} passed")
    return 0


def optimise(problem: str, problem_config: Any, out: Path) -> Solution:
    """Solves a problem with a progress display and writes solution.npz."""
    from warmstart.problems import get_problem

    entry = get_problem(problem)
    asked = getattr(problem_config, entry.outcome)
    with progress(f"optimising {problem}, {entry.outcome} {asked:g} {entry.unit}") as bar:
        solution = entry.solve(
            problem_config,
            progress=lambda i, effort: bar.show(f"iteration {i}, effort {effort:.4g}"),
        )
        bar.finish(f"solved in {solution.stats.get('solve_s', 0):.0f} s")
    solution.save(out / SOLUTION)
    return solution


def certify_solution(solution: Solution, out: Path) -> Certificate:
    """Checks a solution and writes certificate.json; the caller asks whether it passed."""
    from warmstart.certificate import certify

    with progress("certifying in Drake and MuJoCo") as bar:
        certificate = certify(solution)
        passed = sum(c.passed for c in certificate.checks)
        bar.finish(f"{passed} of {len(certificate.checks)} checks passed")
    certificate.to_json(out / CERTIFICATE)
    return certificate


def ask_drake(solution: Solution, certificate: Certificate, out: Path) -> SecondOpinion:
    """Drake's and SNOPT's second opinion on a take-off; joins it to certificate.json.

    It is an opinion on how good the motion is, not a check: a motion that is dearer than it need
    be is still possible. Raises ValueError for a motion without a stance before a flight.
    """
    from warmstart import atomic
    from warmstart.drake_nlp import second_opinion

    with progress("second opinion, Drake and SNOPT") as bar:
        opinion = second_opinion(solution)
        bar.finish("agrees" if opinion.agrees else "does not agree")
    found = {"agrees": opinion.agrees, "improvement": opinion.improvement}
    found |= dataclasses.asdict(opinion)
    atomic.write_json(out / CERTIFICATE, certificate.to_dict() | {"second_opinion": found})
    return opinion


def make_demonstration(
    solution: Solution, certificate: Certificate, out: Path, seed: int = 0
) -> Demonstration:
    """Follows a certified solution in MuJoCo with feedback; writes demo.npz where it succeeds.

    Success is what the task's own rules call so; the clip is labelled with what it achieved. A
    certificate that then says something of the clip is written again.
    """
    from warmstart.demonstration import demonstrate
    from warmstart.tracking import Tracking

    with progress("tracking in MuJoCo") as bar:
        found = demonstrate(
            solution,
            Tracking(seed=seed),
            certificate=certificate,
            progress=lambda i, n: bar.show(f"step {i} of {n}", i, n),
        )
        bar.finish("success" if found.passed else "no success")
    if found.passed and found.clip is not None:
        found.clip.save(out / DEMO)
        if found.certificate.clip:
            found.certificate.to_json(out / CERTIFICATE)
    return found


def write_preview(
    solution: Solution,
    certificate: Certificate,
    found: Demonstration | None,
    path: Path,
    opinion: SecondOpinion | None = None,
) -> Path:
    """The page of one optimised motion: asked, achieved, checks, plots, replay, provenance."""
    from olympics_opt.report import sections
    from olympics_opt.report.page import Page, Section, write_page
    from rl import provenance
    from warmstart.problems import get_problem

    unit = get_problem(solution.problem).unit
    facts = certificate.to_dict()
    tiles = sections.asked_achieved_tiles(solution.asked, certificate.achieved, unit)
    tracked = found.clip if found is not None else None
    blocks = [tiles, *([tracking_tiles(tracked)] if tracked is not None else [])]
    page = Page(
        f"{solution.problem.replace('_', ' ').capitalize()}: an optimised motion",
        [
            Section("Asked and achieved", blocks),
            motion_replay(solution, tracked),
            Section("The motion over time", [solution_plots(solution)]),
            sections.certificate_section(facts),
            *([opinion_section(opinion)] if opinion is not None else []),
            sections.provenance_section(
                {
                    "problem": solution.problem,
                    "asked": solution.asked,
                    "strength": solution.strength,
                    "solver": solution.stats,
                    "commit": provenance.commit(),
                    "hardware": provenance.hardware(),
                    "versions": provenance.versions(),
                }
            ),
        ],
        "The least-effort motion with the prescribed outcome, found by trajectory optimisation on "
        "full inverse dynamics.",
    )
    return write_page(page, path)


def opinion_section(opinion: SecondOpinion) -> Section:
    """What another formulation and another solver say about the take-off."""
    from olympics_opt.report.page import Section, Table, Text

    rows: list[list[object]] = [
        ["violation of the constraints (scaled)", opinion.reference_violation, opinion.violation],
        ["cost", opinion.reference_cost, opinion.cost],
        ["effort (s)", opinion.effort_reference, opinion.effort],
    ]
    return Section(
        "Second opinion",
        [
            Text(opinion.sentence(), "verdict", "good" if opinion.agrees else "warn"),
            Table(["", "the optimised motion", "after SNOPT"], rows, "Both in Drake's program."),
        ],
        "The last stance before the flight, between the same states and in the same time, written "
        "again for Drake's MathematicalProgram on a reduced Drake plant and given to SNOPT. The "
        "stance of an optimal motion must be feasible and stationary there too.",
    )


def tracking_tiles(tracked: Clip) -> Tiles:
    """What MuJoCo made of the motion."""
    from olympics_opt.report.page import Tile, Tiles, number

    achieved = tracked.meta.get("achieved", {})
    success = achieved.get("success")
    tiles = [
        Tile(
            "tracked in MuJoCo",
            {None: "no task", True: "success", False: "failed"}[
                None if success is None else success > 0.5
            ],
            "by the rules of the sport",
            "" if success is None else "good" if success > 0.5 else "bad",
        ),
    ]
    if "link_error" in tracked.meta:  # a refined throw follows no path
        error = f"{100 * tracked.meta['link_error']:.1f} cm"
        tiles.append(Tile("link error", error, "root mean square"))
    skip = ("success", "foul", "knocked", "bar_height")
    tiles += [
        Tile(f"tracked: {name.replace('_', ' ')}", number(float(value)))
        for name, value in achieved.items()
        if name not in skip and not name.startswith(("success_", "height_"))
    ]
    return Tiles(tiles)


def solution_plots(solution: Solution) -> Plots:
    """Height, speed, ground force and effort of an optimised motion over time."""
    from olympics_opt.report.page import Plots
    from olympics_opt.report.plots import Plot, Series
    from olympics_opt.report.sections import body_plots
    from sports.physics.base import GRAVITY

    time = solution.times - solution.times[0]
    weight = solution.body.mass * GRAVITY
    force = np.linalg.norm(solution.contact_force.sum(axis=1), axis=-1) / weight
    share = np.abs(solution.torque) / solution.body.array("effort")
    legs = [i for i, dof in enumerate(solution.body.dofs) if dof.link[2:] in _LEG]
    rest = [i for i in range(solution.body.num_dofs) if i not in legs]
    return Plots(
        [
            *body_plots(time, solution.qpos, solution.qvel).plots,
            Plot(
                "Ground force",
                "time (s)",
                "body weights",
                [Series("force", time, force)],
                levels={"standing": 1.0},
            ),
            Plot(
                "Largest torque",
                "time (s)",
                "share of the limit",
                [
                    Series("legs", time, share[:, legs].max(axis=1)),
                    Series("trunk and arms", time, share[:, rest].max(axis=1)),
                ],
                levels={"limit": 1.0},
            ),
        ]
    )


_LEG = ("Hip", "Knee", "Ankle", "Toe")


def motion_replay(solution: Solution, tracked: Clip | None) -> Section:
    """The 3-D replay of an optimised motion and of what MuJoCo made of it."""
    from olympics_opt.report.page import Fragment, Section
    from olympics_opt.report.replay import ReplayTrack, replay_html
    from warmstart.clip import clip_from_solution
    from warmstart.replay import scene_of

    clip = clip_from_solution(solution, 60.0)
    tracks = [ReplayTrack.from_clip(clip, "optimised")]
    if tracked is not None:
        tracks.append(ReplayTrack.from_clip(tracked, "tracked in MuJoCo"))
    title = f"{solution.problem.replace('_', ' ')}, optimised motion"
    fragment = replay_html(scene_of(clip), tracks, title=title, element_id="replay-solution")
    return Section("Replay", [Fragment(fragment)])


def _print_outcome(
    solution: Solution, certificate: Certificate, found: Demonstration | None, out: Path
) -> None:
    from olympics_opt.report.page import number

    for c in certificate.checks:
        limit = "recorded" if c.sense == "recorded" else f"{c.sense} {number(c.limit)}"
        mark = "passed" if c.passed else "FAILED"
        print(f"  {mark}  {c.name:<40}{number(c.value):>11} {c.unit} ({limit})")
    asked = ", ".join(f"{k} {number(v)}" for k, v in solution.asked.items())
    achieved = ", ".join(f"{k} {number(v)}" for k, v in certificate.achieved.items())
    print(f"asked: {asked}; achieved: {achieved or 'nothing'}")
    if found is not None and found.clip is not None:
        meta = found.clip.meta
        outcome = ", ".join(f"{k} {number(float(v))}" for k, v in meta.get("achieved", {}).items())
        if "link_error" in meta:
            outcome = f"links {100 * meta['link_error']:.1f} cm off, {outcome}"
        print(f"{meta.get('motion', 'tracked in MuJoCo')}: {outcome}")
        if reason := meta.get("why_not"):
            print(f"the plan is certified, the clip is not: {reason}")
    if not certificate.passed:
        print(f"not certified, so no demonstration is written: {'; '.join(certificate.failures)}")
    elif found is not None and found.reason:
        print(f"certified, but no demonstration is written: {found.reason}")
    names = (n for n in (DEMO, CERTIFICATE, PREVIEW) if (out / n).is_file())
    print(f"wrote {', '.join(str(out / n) for n in names)}")
