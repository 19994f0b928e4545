"""Many optimisations at once: one process per solve, results on disk, started again where it was.

A sweep's directory holds, per value, ``NAME.npz`` (the solution), ``NAME.json`` (what happened)
and, when certified, ``NAME.certificate.json``; and ``sweep.json``, the table. Each file is written
atomically, so a sweep that was killed goes on with what is missing. Processes are spawned, never
forked, and never shared between solves: Python constraints of the solvers are not thread-safe.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import multiprocessing
import os
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from warmstart.atomic import write_json

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Result:
    """What became of one value of a sweep."""

    name: str
    value: float
    status: str
    """``certified``, ``solved`` (no certificate asked), ``rejected`` (the gate), ``infeasible``
    (no solution, with the reason) or ``crashed``."""
    reason: str
    """Why it is not a demonstration; empty where it is."""
    seconds: float
    achieved: dict[str, float]
    objective: float | None = None

    @property
    def finished(self) -> bool:
        """Whether it stays as it is when the sweep is run again; a crash is tried again."""
        return self.status != "crashed"


def sweep(
    problem: str,
    field: str,
    values: Iterable[float],
    out_dir: str | Path,
    *,
    processes: int = 2,
    options: dict[str, Any] | None = None,
    certify: bool = True,
    continuation: bool = False,
    show: bool = True,
    registry: str = "warmstart.problems",
) -> list[Result]:
    """Solves a problem for every value of one config field; returns the results in their order.

    ``options`` are further config fields. With ``continuation`` each solve starts from its
    neighbour's solution, the nearest one already on disk, so values are taken one after another
    from each process. ``registry`` is a module with ``get_problem(name)`` returning an object
    with ``config`` (a dataclass) and ``solve(config, guess=None) -> Solution``. Files of finished
    values are kept; those of another problem, option or field are refused. Raises ValueError for
    an unknown problem or field, for a value that is not finite or occurs twice, and when the
    directory holds another sweep.
    """
    values, options = [float(v) for v in values], dict(options or {})
    if not values or not all(math.isfinite(v) for v in values) or len(set(values)) < len(values):
        raise ValueError(f"a sweep needs different finite values, not {values}")
    if processes < 1:
        raise ValueError(f"a sweep needs at least one process, not {processes}")
    config = importlib.import_module(registry).get_problem(problem).config
    known = [f.name for f in dataclasses.fields(config)]
    for name in (field, *options):
        if name not in known:
            raise ValueError(f"problem '{problem}' has no option '{name}'; known: {known}")
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    head = {"problem": problem, "field": field, "options": options}
    _claim(out, head)
    jobs = {v: _Job(registry, problem, field, v, options, str(out), certify) for v in values}
    done = {v: r for v, job in jobs.items() if (r := _read(out, job.name)) and r.finished}
    todo = [v for v in values if v not in done]
    for value in todo:
        (out / f"{jobs[value].name}.json").unlink(missing_ok=True)
    with _progress(show) as bar:
        task = bar.add_task(f"{problem}: {field}", total=len(values), completed=len(done))

        def finished(value: float, result: Result) -> None:
            done[value] = result
            best = f"{field} {value:g}: {result.status}, {result.seconds:.0f} s"
            bar.update(task, advance=1, description=f"{problem}: {best}")

        _run(jobs, todo, min(processes, max(len(todo), 1)), continuation, finished)
    results = [done[v] for v in values]
    write_json(out / "sweep.json", {**head, "results": [asdict(r) for r in results]})
    if show:
        Console(stderr=True).print(table(results, field))
    return results


def table(results: Iterable[Result], field: str) -> Table:
    """The results as a rich table."""
    out = Table(field, "status", "achieved (m)", "seconds", "effort", "reason")
    for r in results:
        achieved = ", ".join(f"{k} {v:.2f}" for k, v in r.achieved.items())
        effort = "" if r.objective is None else f"{r.objective:.4g}"
        out.add_row(f"{r.value:g}", r.status, achieved, f"{r.seconds:.1f}", effort, r.reason)
    return out


@dataclass(frozen=True)
class _Job:
    registry: str
    problem: str
    field: str
    value: float
    options: dict[str, Any]
    out: str
    certify: bool
    guess: str | None = None

    @property
    def name(self) -> str:
        return f"{self.problem}_{self.field}_{self.value:g}"


def _run(
    jobs: dict[float, _Job],
    todo: list[float],
    processes: int,
    continuation: bool,
    finished: Callable[[float, Result], None],
) -> None:
    """Keeps ``processes`` solves running until nothing is left to do; ends them when interrupted.

    A process of its own for each solve: one that is killed (out of memory, a crash in native
    code) takes nothing else with it.
    """
    context = multiprocessing.get_context("spawn")
    left = list(todo)
    running: dict[int, tuple[float, BaseProcess, float]] = {}
    kept = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # children inherit it
    try:
        while left or running:
            while left and len(running) < processes:
                value = left.pop(0)
                job = jobs[value]
                if continuation:
                    job = dataclasses.replace(job, guess=_neighbour(job, list(jobs)))
                process = context.Process(target=_child, args=(job,), daemon=True)
                process.start()
                running[process.sentinel] = (value, process, time.perf_counter())
            for sentinel in wait(list(running)):
                value, process, begun = running.pop(sentinel)  # type: ignore[arg-type]
                process.join()
                seconds = time.perf_counter() - begun
                result = _read(Path(jobs[value].out), jobs[value].name)
                if process.exitcode != 0 or result is None:
                    reason = f"its process ended with code {process.exitcode}"
                    result = Result(jobs[value].name, value, "crashed", reason, seconds, {})
                    write_json(Path(jobs[value].out) / f"{result.name}.json", asdict(result))
                finished(value, result)
    finally:
        for _, process, _ in running.values():
            process.terminate()
        for name, value in kept.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


def _neighbour(job: _Job, values: list[float]) -> str | None:
    """The solution file of the nearest value that is on disk."""
    for value in sorted(values, key=lambda v: abs(v - job.value)):
        path = Path(job.out) / f"{dataclasses.replace(job, value=value).name}.npz"
        if value != job.value and path.is_file():
            return str(path)
    return None


def _child(job: _Job) -> None:
    """What a spawned process runs: a solve, and its result on disk."""
    result = _solve(job)
    write_json(Path(job.out) / f"{result.name}.json", asdict(result))


def _solve(job: _Job) -> Result:
    """One solve, in its own process."""
    from warmstart.solution import Solution

    begin = time.perf_counter()

    def result(status: str, reason: str = "", **more: Any) -> Result:
        seconds = time.perf_counter() - begin
        return Result(
            job.name, job.value, status, reason, seconds, more.pop("achieved", {}), **more
        )

    problem = importlib.import_module(job.registry).get_problem(job.problem)
    try:
        config = problem.config(**{**job.options, job.field: job.value})
        guess = Solution.load(job.guess) if job.guess else None
        solution = problem.solve(config, guess=guess)
    except Exception as error:
        if type(error).__name__ in ("Infeasible", "ValueError"):
            return result("infeasible", str(error))
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(where.filename).name}:{where.lineno}"
        return result("crashed", f"{type(error).__name__} at {place}: {error}")
    solution.save(Path(job.out) / f"{job.name}.npz")
    objective = solution.stats.get("objective")
    if not job.certify:
        return result("solved", objective=objective)
    from warmstart.certificate import certify

    certificate = certify(solution)
    certificate.to_json(Path(job.out) / f"{job.name}.certificate.json")
    return result(
        "certified" if certificate.passed else "rejected",
        "; ".join(certificate.failures),
        achieved=certificate.achieved,
        objective=objective,
    )


def _claim(out: Path, head: dict[str, Any]) -> None:
    """Marks a directory as this sweep's. Raises ValueError when it holds another one."""
    path = out / "sweep.json"
    if path.is_file():
        try:
            found = json.loads(path.read_text())
            other = {k: found[k] for k in head}
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is not a sweep's table; choose another directory") from error
        if other != json.loads(json.dumps(head)):
            raise ValueError(
                f"{out} holds a sweep of {other['problem']} over {other['field']} with options "
                f"{other['options']}; choose another directory"
            )
    else:
        write_json(path, {**head, "results": []})


def _read(out: Path, name: str) -> Result | None:
    """The stored result of a value; None where there is none or it is unreadable."""
    try:
        result = Result(**json.loads((out / f"{name}.json").read_text()))
    except (OSError, ValueError, TypeError):
        return None
    solved = result.status in ("certified", "solved", "rejected")
    return None if solved and not (out / f"{name}.npz").is_file() else result


def _progress(show: bool) -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=Console(stderr=True), disable=not show)
