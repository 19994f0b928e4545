"""Many motions with one command: ``solve PROBLEM --sweep`` and ``solve --all``.

``--all`` solves every registered problem at its defaults. The folder holds each problem's files
(see :mod:`warmstart.job`) and ``warmstart.json``, the table with commit, hardware and versions,
which is what ``results/warmstart.json`` is made of. What an earlier run finished is kept; a row
says at which commit it was made.
"""

from __future__ import annotations

import importlib
import json
import platform
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warmstart.job import Job, Result, left_over

if TYPE_CHECKING:
    from olympics_opt.cli import Solve

TABLE = "warmstart.json"
KIND = "olympics-opt solve --all"


def run_sweep(config: Solve, options: dict[str, Any]) -> int:
    """Solves for several values in parallel; 0 when at least one of them is certified."""
    from warmstart import sweep
    from warmstart.problems import get_problem

    assert config.sweep is not None and config.out is not None
    field, values = sweep_values(config.sweep)
    if field in options:
        raise ValueError(f"'{field}' is swept, so it cannot be set to {options[field]} as well")
    results = sweep.sweep(
        get_problem(config.name).name,
        field,
        values,
        config.out,
        processes=config.processes,
        cluster=config.cluster,
        options=options,
        track=config.track,
        continuation=config.continuation,
    )
    good = sum(r.status == "certified" for r in results)
    print(f"{good} of {len(results)} values certified{' and tracked' if config.track else ''}")
    print(f"wrote {config.out / sweep.TABLE}, {config.out / sweep.PLOT}")
    if good < len(results):
        print(f"olympics-opt solve --explain {config.out} tells what failed and what to try")
    return 0 if good else 1


def sweep_values(text: str) -> tuple[str, list[float]]:
    """``bar-height=0.8:1.5:8`` -> field and values. Raises ValueError for any other form."""
    name, _, numbers = text.partition("=")
    try:
        low, high, count = numbers.split(":")
        values = np.linspace(float(low), float(high), int(count))
    except ValueError:
        raise ValueError(
            f"a sweep is NAME=FIRST:LAST:COUNT, such as bar-height=0.8:1.5:8, not '{text}'"
        ) from None
    return name.strip().replace("-", "_"), [round(float(v), 9) for v in values]


def run_all(out: Path, processes: int, cluster: str | None, track: bool) -> int:
    """The command: 0 when every problem has a certified motion, else 1."""
    results = solve_all(out, processes=processes, cluster=cluster, track=track)
    good = sum(r.status == "certified" for r in results)
    print(f"{good} of {len(results)} problems certified{' and tracked' if track else ''}")
    print(f"wrote {out / TABLE}")
    if good < len(results):
        print(f"olympics-opt solve --explain {out} tells what failed and what to try")
    return 0 if good == len(results) else 1


def solve_all(
    out: Path,
    *,
    processes: int = 2,
    cluster: str | None = None,
    track: bool = True,
    certify: bool = True,
    second_opinion: bool = True,
    show: bool = True,
    registry: str = "warmstart.problems",
) -> list[Result]:
    """Solves every problem of a registry at its defaults; writes their files and the table.

    ``registry`` is a module with ``PROBLEMS`` and ``get_problem``. Raises ValueError, and then
    nothing is written, when the folder holds a table of another kind or with other settings, or a
    cluster does not answer.
    """
    from rich.console import Console

    from olympics_opt.progress import progress
    from rl import provenance
    from warmstart.sweep_report import show as report
    from warmstart.workers import workers

    problems = importlib.import_module(registry).PROBLEMS
    settings: dict[str, Any] = {
        "certify": certify,
        "track": track,
        "second_opinion": second_opinion,
    }
    _claim(out / TABLE, settings)
    made = {"commit": provenance.commit(), "hardware": provenance.hardware()}
    jobs = [Job(name, name, registry=registry, made=made, **settings) for name in problems]
    done: dict[str, Result] = {}

    with workers(processes, cluster) as run, progress(f"solving {len(jobs)} problems") as bar:

        def took(job: Job, result: Result) -> None:
            done[job.name] = result
            bar.show(f"{len(done)} of {len(jobs)}", len(done), len(jobs))
            if show:
                print(f"{job.name}: {result.status} in {result.seconds:.0f} s", flush=True)
            _write(out / TABLE, settings, done, problems)

        kept, todo = left_over(out, jobs)
        for job, result in kept:
            took(job, result)
        if todo:
            run(todo, out, took)
        bar.finish(f"{len(kept)} kept, {len(todo)} solved")
    results = [done[job.name] for job in jobs]
    if show:
        console = Console()
        report(table(results, problems), results, console)
        for r in results:
            if r.opinion:
                console.print(f"{r.name}: {opinion_words(r.opinion)}", soft_wrap=True)
    return results


def table(results: list[Result], problems: dict[str, Any]) -> Any:
    """One row a problem, as a rich table."""
    from warmstart.sweep_report import number, plain_table

    out = plain_table(
        *("problem", "solve\n(s)", "iterations", "violation", "asked", "achieved\nin MuJoCo"),
        *("achieved\nin Drake", "tracked\nin MuJoCo", "feedback\nin Drake"),
        *("Drake\n+ SNOPT", "verdict"),
        caption="achieved: the torques replayed open loop (a kick after a step: with feedback); "
        "tracked: by a search in the simulation; feedback: the torques corrected linearly",
    )
    for r in results:
        unit = problems[r.problem].unit
        achieved = [
            f"{number(r.achieved[name])} {unit}" if name in r.achieved else "–"
            for name in ("replay_mujoco", "replay_drake", "tracked", "feedback_drake")
        ]
        agrees = r.opinion.get("agrees")
        out.add_row(
            r.name,
            number(r.figures.get("solve_s")),
            number(r.figures.get("iterations")),
            f"{r.figures['violation']:.1e}" if "violation" in r.figures else "–",
            "–" if r.asked is None else f"{number(r.asked)} {unit}",
            *achieved,
            {None: "–", True: "agrees", False: "differs"}[agrees],
            r.status,
        )
    return out


def opinion_words(opinion: dict[str, Any]) -> str:
    """A second opinion in a line."""
    if "why not" in opinion:
        return f"no second opinion: {opinion['why not']}"
    agrees = "agrees" if opinion["agrees"] else "does not agree"
    return (
        f"Drake + SNOPT {agrees}: stationarity {opinion['stationarity']:.1e}, violation "
        f"{opinion['violation']:.1e}, cost {opinion['cost']:.4g} against "
        f"{opinion['reference_cost']:.4g}, {opinion['variables']} variables, "
        f"{opinion['solve_s']:.0f} s"
    )


def _write(
    path: Path, settings: dict[str, bool], done: dict[str, Result], problems: dict[str, Any]
) -> None:
    """The table so far, with what its numbers come from."""
    from rl import provenance
    from warmstart.atomic import write_json

    rows = []
    for name in problems:
        if name not in done:
            continue
        result = done[name]
        row = asdict(result)
        row |= {"unit": problems[name].unit, "outcome": problems[name].outcome}
        del row["value"], row["start"], row["peaks"]
        rows.append({**row, "peak_hinge": result.peak_hinge})
    table = {
        "kind": KIND,
        "settings": settings,
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
        "system": platform.platform(),
        "rows": rows,
    }
    write_json(path, table)


def _claim(path: Path, settings: dict[str, bool]) -> None:
    """Raises ValueError when the table that is there is of something else."""
    if not path.is_file():
        return
    try:
        found = json.loads(path.read_text())
        kind, other = found["kind"], found["settings"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a table of {KIND}; choose another folder") from error
    if kind != KIND or other != settings:
        raise ValueError(
            f"{path} was made with the settings {other}, not {settings}; choose another folder"
        )
