"""The report of a study, read from the folders of its stages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from olympics_opt.report import sections
from olympics_opt.report.page import Block, Page, Plots, Section, Table, Text, Tile, Tiles, Video
from olympics_opt.report.verification import replay_of, verification_sections


def study_page(task: str, root: Path) -> Page:
    """The page of a finished study under ``root``. Raises ValueError or OSError for files that
    are missing or damaged."""
    from rl.evaluate import Recording
    from rl.runlog import read_progress
    from warmstart.solution import Solution

    solution = Solution.load(root / "solve" / "solution.npz")
    certificate = _json(root / "certify" / "certificate.json")
    warm = _json(root / "warm_start" / "stage.json")["facts"]
    training = _json(root / "train" / "stage.json")["facts"]
    results = {n: _json(root / "evaluate" / f"{n}.json") for n in ("shipped", "fine-tuned")}
    step_note = _json(root / "evaluate" / "stage.json")["facts"].get("training_step")
    verification = _json(root / "verify" / "report.json")
    recordings = {
        run: Recording.load(root / "verify" / f"{run}.npz")
        for run in verification["results"]
        if (root / "verify" / f"{run}.npz").is_file()
    }
    best = Recording.load(root / "evaluate" / "fine-tuned_best.npz")
    median = Recording.load(root / "evaluate" / "fine-tuned_median.npz")
    verified = verification_sections(verification)
    parts = [
        _summary(solution, certificate, warm, results, verification),
        _take_off(solution, warm, root),
        sections.certificate_section(certificate),
        _learning(task, training, read_progress(root / "train" / "run")),
        Section(
            "Shipped and fine-tuned",
            [sections.metric_table(results)],
            "Both policies from the standard start, in MuJoCo, without noise in their actions."
            + (f" Of the shipped one: {step_note}." if step_note else ""),
        ),
        replay_of({"best": best, "median": median}, "replay-policy", "The policy's motion"),
        Section("The best trial over time", [sections.motion_plots(best), *_video(root, best)]),
        *(s for s in verified if s.title != "Provenance"),
        *(
            [replay_of(recordings, "replay-engines", "The engines side by side")]
            if recordings
            else []
        ),
        _provenance(solution, results, verification, root),
    ]
    name = task.replace("_", " ")
    return Page(
        f"A study of the {name}",
        parts,
        "Drake finds a motion, MuJoCo learns to do it a thousand ways at once, Drake checks that "
        "it is true.",
    )


def _summary(
    solution: Any,
    certificate: dict[str, Any],
    warm: dict[str, Any],
    results: dict[str, dict[str, Any]],
    verification: dict[str, Any],
) -> Section:
    from warmstart.problems import get_problem

    tiles = [
        Tile(
            "optimised and certified",
            "yes" if certificate["passed"] else "no",
            f"strength {solution.strength}, {solution.stats.get('solve_s', 0):.0f} s to solve",
            "good" if certificate["passed"] else "bad",
        ),
        Tile(
            "tracked in MuJoCo",
            "success" if warm["success"] else "no",
            f"links {100 * warm['link_error']:.1f} cm off (root mean square)"
            if warm["link_error"] is not None
            else warm["reason"],
            "good" if warm["success"] else "bad",
        ),
        *(
            Tile(
                f"success, {name} policy",
                f"{100 * r['metrics']['success']['mean']:.0f} %",
                f"{r['trials']} trials in MuJoCo",
            )
            for name, r in results.items()
        ),
    ]
    kept = verification["verdict"].get("kept")
    passed = verification["verdict"]["passed"]
    tiles.append(
        Tile(
            "kept in Drake",
            "–" if kept is None else f"{100 * kept:.0f} %",
            f"of MuJoCo's success, {verification['trials']} trials",
            "good" if passed else "bad",
        )
    )
    unit = get_problem(solution.problem).unit
    asked = sections.asked_achieved_tiles(solution.asked, certificate["achieved"], unit)
    return Section("Summary", [Tiles(tiles), Text("The optimised motion", "heading"), asked])


def _take_off(solution: Any, warm: dict[str, Any], root: Path) -> Section:
    from olympics_opt.solve import motion_replay, solution_plots
    from sports.registry import get_task
    from warmstart.clip import Clip

    units = get_task(solution.problem).metrics
    demo = root / "warm_start" / "demo.npz"
    clip = Clip.load(demo) if demo.is_file() else None
    replay = motion_replay(solution, clip)
    rows = [
        [name.replace("_", " "), float(value), units.get(name, "")]
        for name, value in warm["achieved"].items()
        if isinstance(value, (int, float))
    ]
    table = Table(
        ["outcome in MuJoCo", "value", "unit"],
        rows,
        "By the rules of the sport, of the tracked motion.",
    )
    return Section(
        "The optimised take-off",
        [*replay.blocks, solution_plots(solution), table],
        "Least effort for the prescribed outcome. The tracked motion is what MuJoCo really did "
        "when it followed the optimised one with feedback; training starts from its states.",
    )


def _learning(task: str, training: dict[str, Any], rows: list[dict[str, Any]]) -> Section:
    from sports.registry import get_task

    main = get_task(task).main_metric
    wanted = list(dict.fromkeys(("success", main)))
    clips = ", ".join(training["clips"])
    text = (
        f"{training['samples']:,} samples in {training['minutes']:.1f} minutes, "
        f"{training['iterations']} iterations. "
        + (f"Some episodes start from states of: {clips}. " if clips else "No demonstration. ")
        + "While training, actions carry noise and starts vary, so the rates here are lower than "
        "in the trials below. Steps are small: so little data can keep or sharpen a good policy, "
        "hardly better it."
    )
    plots: Plots = sections.learning_plots(rows, wanted)
    return Section("Learning", [plots, _candidates(training)], text)


def _candidates(training: dict[str, Any]) -> Table:
    """The states saved while training, and which one is the study's policy."""
    trials, kept = training["selection"]["trials"], training["kept"]
    rows: list[list[object]] = [
        [c["iteration"], f"{100 * c['success']:.0f} %", c["return"], "yes" if i == kept else ""]
        for i, c in enumerate(training["candidates"])
    ]
    return Table(
        ["after iteration", "success", "mean return", "kept"],
        rows,
        f"The best of these, by success and then by return in {trials} trials each, is the "
        f"fine-tuned policy. Those trials (seed {training['selection']['seed']}) are not among "
        "the ones below.",
    )


def _video(root: Path, recording: Any) -> list[Block]:
    """The best trial as a video, where this machine can draw one; else what to install."""
    from olympics_opt.render import render_video

    path = root / "report" / "best.mp4"
    try:
        return [Video(render_video(recording, path, width=640, height=368))]
    except RuntimeError as error:
        return [Text(f"No video: {error}")]


def _provenance(
    solution: Any, results: dict[str, Any], verification: dict[str, Any], root: Path
) -> Section:
    tuned = results["fine-tuned"]
    stages = ("solve", "certify", "warm_start", "train", "evaluate", "verify")
    seconds = {s: f"{_json(root / s / 'stage.json')['seconds']:.0f} s" for s in stages}
    return sections.provenance_section(
        {
            "commit": tuned["commit"],
            "hardware": tuned["hardware"],
            "seed": tuned["seed"],
            "strength of the policy": tuned["strength"],
            "strength of the optimised athlete": solution.strength,
            "policy sha256": {n: r["policy_sha256"] for n, r in results.items()},
            "time": seconds,
            "solver": {k: v for k, v in solution.stats.items() if isinstance(v, (int, float, str))},
            "versions": verification["versions"],
        }
    )


def _json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read ({error}): run the study again") from error
