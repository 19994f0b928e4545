"""One option over a range: many optimisations at once, on disk, taken up again where they stopped.

A sweep's folder holds the files of each value (see :mod:`warmstart.job`), ``sweep.json``, the
table so far, and ``sweep.png``, its plot. Each file is written atomically, the result of a value
last, so a sweep that was killed goes on with what is missing and ends with the same table.

What a value starts from does not depend on which process was faster. Without ``continuation``
every value starts from the problem's own guess; a value that then has no certified motion is tried
once more from the nearest neighbour that has one. With ``continuation`` the values are taken one
after another, each from the nearest one solved before; one that then has no motion is tried once
more from its own start. Every attempt is kept.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
from collections.abc import Iterable
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from warmstart.atomic import write_json
from warmstart.job import GOOD, Job, Result, left_over
from warmstart.sweep_report import plot, table
from warmstart.sweep_report import show as report
from warmstart.workers import Run, workers

TABLE, PLOT = "sweep.json", "sweep.png"
_AGAIN = ("infeasible", "rejected")
"""States that another start may mend."""


def sweep(
    problem: str,
    field: str,
    values: Iterable[float],
    out_dir: str | Path,
    *,
    processes: int = 2,
    cluster: str | None = None,
    options: dict[str, Any] | None = None,
    certify: bool = True,
    track: bool = False,
    continuation: bool = False,
    show: bool = True,
    registry: str = "warmstart.problems",
) -> list[Result]:
    """Solves a problem for every value of one config field; returns the results in their order.

    ``options`` are further config fields. ``track`` follows each certified motion in MuJoCo with
    feedback. ``cluster`` is an address for Ray (see :func:`warmstart.workers.ray_cluster`).
    ``registry`` is a module with ``get_problem(name)`` returning an object with ``config`` (a
    dataclass), ``outcome`` and ``unit``, and ``solve(config, guess=None) -> Solution``. Files of
    finished values are kept; a folder of another sweep is refused. Raises ValueError, and then
    nothing is written, for an unknown problem or field, a field that is no number, a value that
    the problem does not accept, that is not finite or occurs twice.
    """
    options = dict(options or {})
    entry = importlib.import_module(registry).get_problem(problem)
    values = _checked(problem, entry.config, field, values, options)
    with workers(processes, cluster) as run:
        out = Path(out_dir)
        head = {
            "problem": problem,
            "field": field,
            "options": options,
            "certify": certify,
            "track": track,
            "continuation": continuation,
        }
        _claim(out, head)
        jobs = [
            Job(
                name=f"{problem}_{field}_{_label(value)}",
                problem=problem,
                options={**options, field: value},
                registry=registry,
                value=float(value),
                certify=certify,
                track=track,
            )
            for value in values
        ]
        work = _Work(out, head, jobs, run, show)
        with work.progress:
            if continuation:
                work.one_after_another()
            else:
                work.do(jobs)
            work.try_again()
        results = work.results()
        work.write_table()
    plot(results, field, entry, out / PLOT)
    if show:
        report(table(results, field, entry.unit), results, Console(stderr=True))
    return results


def read_sweep(path: str | Path) -> tuple[dict[str, Any], list[Result]]:
    """The table of a sweep, from its folder or file: what was swept, and its results.

    Raises ValueError naming the file when it is not such a table.
    """
    path = Path(path)
    path = path / TABLE if path.is_dir() else path
    try:
        found = json.loads(path.read_text())
        return found, [Result(**row) for row in found["results"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not the table of a sweep: {error}") from error


class _Work:
    """The values of one sweep: what is done, what is not, and how to go on."""

    def __init__(
        self, out: Path, head: dict[str, Any], jobs: list[Job], run: Run, show: bool
    ) -> None:
        self.out, self.head, self.jobs, self.run = out, head, jobs, run
        self.done: dict[str, Result] = {}
        """Final results by name of the value's own job."""
        self._extra = 0
        self.progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            disable=not show,
        )
        what = f"{head['problem']}: {head['field']}"
        self.task = self.progress.add_task(what, total=len(jobs))

    def do(self, jobs: list[Job]) -> None:
        """Solves what is not on disk already."""
        kept, todo = left_over(self.out, jobs)
        for job, result in kept:
            self._took(job, result, "kept")
        if todo:
            self.run(todo, self.out, self._took)

    def one_after_another(self) -> None:
        """Each value from the nearest one before it that has a motion, else from its own start."""
        for i, job in enumerate(self.jobs):
            near = self._neighbour(job, self.jobs[:i])
            self.do([self._from(job, near)])
            if near is not None and self.done[job.name].status in _AGAIN:
                self._second({f"{job.name}_own": (job, job)})

    def try_again(self) -> None:
        """Values without a motion from their own start, once more from the nearest that has one."""
        again = {}
        for job in self.jobs:
            near = self._neighbour(job, self.jobs)
            found = self.done[job.name]
            if found.status in _AGAIN and not found.start and near is not None:
                name = f"{job.name}_from_{near.name.removeprefix(self._stem)}"
                again[name] = (job, self._from(job, near))
        self._second(again)

    def _second(self, attempts: dict[str, tuple[Job, Job]]) -> None:
        """Another start for values without a motion; name -> (the value's job, the attempt)."""
        self.progress.update(self.task, total=len(self.jobs) + self._extra + len(attempts))
        self._extra += len(attempts)
        self.do([dataclasses.replace(second, name=n) for n, (_, second) in attempts.items()])
        for name, (job, second) in attempts.items():
            first, later = self.done[job.name], self.done.pop(name)
            if later.good:
                self.done[job.name] = later
            else:
                start = second.start or "its own start"
                reason = f"{first.reason}; from {start}: {later.reason}"
                self.done[job.name] = dataclasses.replace(first, reason=reason)

    def results(self) -> list[Result]:
        """In the order of the values."""
        return [self.done[job.name] for job in self.jobs if job.name in self.done]

    def write_table(self) -> None:
        """Writes sweep.json with what is known so far."""
        rows = [asdict(result) for result in self.results()]
        write_json(self.out / TABLE, {**self.head, "results": rows})

    @property
    def _stem(self) -> str:
        return f"{self.head['problem']}_{self.head['field']}_"

    def _neighbour(self, job: Job, among: list[Job]) -> Result | None:
        """The nearest value of these that has a motion; the lower of two as near."""

        def distance(other: Job) -> tuple[float, float]:
            assert other.value is not None and job.value is not None
            return abs(other.value - job.value), other.value

        for other in sorted(among, key=distance):
            found = self.done.get(other.name)
            if other.name != job.name and found is not None and found.status in GOOD:
                return found
        return None

    def _from(self, job: Job, near: Result | None) -> Job:
        if near is None:
            return job
        guess = (self.out / f"{near.name}.npz").read_bytes()
        return dataclasses.replace(job, start=near.name, guess=guess)

    def _took(self, job: Job, result: Result, how: str = "") -> None:
        self.done[job.name] = result
        words = f"{self.head['field']} {result.value:g}: {result.status}"
        words += f" ({how})" if how else f", {result.seconds:.0f} s"
        words += f", from {result.start}" if result.start else ""
        if not self.progress.disable:
            self.progress.console.print(words, highlight=False)
        self.progress.update(self.task, advance=1)
        self.write_table()


def _checked(
    problem: str, config: type, field: str, values: Iterable[float], options: dict[str, Any]
) -> list[float]:
    """The values as the field wants them. Raises ValueError for what makes no sweep."""
    known = {f.name: f for f in dataclasses.fields(config)}
    for name in (field, *options):
        if name not in known:
            raise ValueError(f"problem '{problem}' has no option '{name}'; known: {list(known)}")
    values = [float(v) for v in values]
    if not values or not all(map(math.isfinite, values)) or len(set(values)) < len(values):
        raise ValueError(f"a sweep needs different finite values, not {values}")
    default, whole = known[field].default, known[field].type in (int, "int")
    if isinstance(default, bool) or not isinstance(default, int | float):
        raise ValueError(f"option '{field}' of '{problem}' is not a number, so it cannot be swept")
    if whole and not all(v.is_integer() for v in values):
        raise ValueError(f"option '{field}' of '{problem}' takes whole numbers, not {values}")
    kind = int if whole else float
    for value in values:  # refuses what no motion could reach, before the work
        config(**{**options, field: kind(value)})
    return [kind(value) for value in values]


def _label(value: float) -> str:
    """A value in a file's name; different values have different labels."""
    return f"{value:g}" if float(f"{value:g}") == value else repr(value)


def _claim(out: Path, head: dict[str, Any]) -> None:
    """Marks a folder as this sweep's. Raises ValueError when it holds another one."""
    path = out / TABLE
    if not path.is_file():
        write_json(path, {**head, "results": []})
        return
    try:
        found = json.loads(path.read_text())
        other = {k: found[k] for k in head}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a sweep's table; choose another folder") from error
    mine = json.loads(json.dumps(head))
    if other != mine:
        differs = next(k for k in mine if other[k] != mine[k])
        raise ValueError(
            f"{out} holds a sweep of {other['problem']} over {other['field']} whose {differs} is "
            f"{other[differs]}, not {mine[differs]}; choose another folder"
        )


def shipped_sweep(problem: str, field: str) -> list[Result]:
    """The results of a sweep that is shipped as package data, to study without a solver.

    Raises ValueError naming those that there are.
    """
    folder = Path(str(resources.files("warmstart").joinpath("data", "sweeps")))
    path = folder / f"{problem}_{field}.json"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.json")))
        raise ValueError(f"no sweep of {problem} over {field} is shipped; there are: {known}")
    return read_sweep(path)[1]
