"""One optimisation as a job: what a worker process or a cluster is given, and what it gives back.

A job is solved by :func:`solve_job`, which touches no disk but a temporary folder, so that it can
run on a machine that does not share one; :func:`store` writes what came out beside each other:
``NAME.npz`` (the solution), ``NAME.certificate.json`` and ``NAME.demo.npz`` where asked for and
earned, and last ``NAME.json``, the :class:`Result`. A result on disk therefore has its files.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import tempfile
import time
import traceback
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warmstart.atomic import write_bytes, write_json

if TYPE_CHECKING:
    from warmstart.solution import Solution

GOOD = ("certified", "solved", "untracked")
"""States of a result whose motion may serve as a neighbour's start."""
STATES = (*GOOD, "rejected", "infeasible", "crashed")
Files = dict[str, bytes]


@dataclass(frozen=True)
class Job:
    """What to solve and what to do with it."""

    name: str
    """Stem of its files."""
    problem: str
    options: dict[str, Any] = field(default_factory=dict)
    """Config fields that differ from their defaults."""
    registry: str = "warmstart.problems"
    """Module with ``get_problem(name)``."""
    value: float | None = None
    """Of the field that a sweep varies."""
    certify: bool = True
    track: bool = False
    """Follow a certified motion in MuJoCo with feedback."""
    second_opinion: bool = False
    """Ask Drake and SNOPT about the take-off."""
    start: str = ""
    """Name of the solution to start from; empty for the problem's own start."""
    guess: bytes | None = None
    """That solution's file."""
    made: dict[str, str] = field(default_factory=dict)
    """Where and with what, as the caller wants it kept beside the result."""


@dataclass(frozen=True)
class Result:
    """What became of a job."""

    name: str
    problem: str
    value: float | None
    """Of the swept field."""
    asked: float | None
    """The outcome that was prescribed, in the problem's unit."""
    status: str
    """``certified``; ``solved`` (no certificate was asked for); ``untracked`` (certified, but
    MuJoCo could not follow it to a success); ``rejected`` (by the gate); ``infeasible`` (no
    solution); ``crashed``."""
    reason: str
    """Why it is no demonstration; empty where it is one."""
    seconds: float
    """Wall-clock time with certificate and tracking."""
    start: str = ""
    """Name of the solution that it started from; empty for the problem's own start."""
    achieved: dict[str, float] = field(default_factory=dict)
    """``planned``, ``replay_mujoco``, ``replay_drake`` (from the certificate, which says
    whether they are open loop) and
    ``tracked`` (with feedback, in MuJoCo), in the problem's unit; 0 for no valid attempt."""
    figures: dict[str, float] = field(default_factory=dict)
    """Those of :func:`warmstart.measure.figures`."""
    peaks: dict[str, float] = field(default_factory=dict)
    """Largest torque at each hinge (N m)."""
    opinion: dict[str, Any] = field(default_factory=dict)
    """Drake's and SNOPT's second opinion, or ``{"why not": ...}``."""
    made: dict[str, str] = field(default_factory=dict)

    @property
    def finished(self) -> bool:
        """Whether it stays as it is when the work is taken up again; a crash is tried again."""
        return self.status != "crashed"

    @property
    def good(self) -> bool:
        """Whether there is a motion that nothing speaks against but perhaps the tracking."""
        return self.status in GOOD

    @property
    def peak_hinge(self) -> str:
        """Name of the hinge with the largest torque; empty without a motion."""
        return max(self.peaks, key=lambda name: self.peaks[name], default="")


def crashed(job: Job, reason: str, seconds: float) -> Result:
    """The result of a job whose worker is gone or whose code failed."""
    return Result(job.name, job.problem, job.value, None, "crashed", reason, seconds, job.start)


def solve_job(job: Job) -> tuple[Result, Files]:
    """Solves a job here and now. Returns its result and the files to store, by file name.

    Raises nothing: what goes wrong is the result's status and reason.
    """
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            result, files = _solve(job, Path(folder))
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(where.filename).name}:{where.lineno}"
            result, files = crashed(job, f"{type(error).__name__} at {place}: {error}", 0.0), {}
    return dataclasses.replace(result, seconds=time.perf_counter() - begin), files


def store(out: Path, result: Result, files: Files) -> None:
    """Writes a job's files, its result last. Raises OSError."""
    for name, data in files.items():
        write_bytes(out / name, data)
    write_json(out / f"{result.name}.json", asdict(result))


def read_result(path: Path) -> Result | None:
    """The result in a file; None where there is none, it is unreadable or lacks its solution."""
    try:
        result = Result(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return None
    if result.status not in STATES or result.name != path.stem:
        return None
    solved = result.status not in ("infeasible", "crashed")
    return None if solved and not path.with_suffix(".npz").is_file() else result


def left_over(out: Path, jobs: Iterable[Job]) -> tuple[list[tuple[Job, Result]], list[Job]]:
    """What an earlier run finished, and the jobs that are still to do, rid of its remains."""
    kept, todo = [], []
    for job in jobs:
        found = read_result(out / f"{job.name}.json")
        if found is not None and found.finished and found.start == job.start:
            kept.append((job, found))
        else:
            forget(out, job.name)
            todo.append(job)
    return kept, todo


def forget(out: Path, name: str) -> None:
    """Removes what an earlier run left of a job, its result first."""
    for suffix in (".json", ".npz", ".certificate.json", ".demo.npz"):
        (out / f"{name}{suffix}").unlink(missing_ok=True)


def _solve(job: Job, folder: Path) -> tuple[Result, Files]:
    from warmstart.measure import figures, peak_torques
    from warmstart.solution import Solution

    files: Files = {}
    problem = importlib.import_module(job.registry).get_problem(job.problem)
    none = Result(job.name, job.problem, job.value, None, "infeasible", "", 0.0, job.start)
    none = dataclasses.replace(none, made=job.made)
    try:
        config = problem.config(**job.options)
        none = dataclasses.replace(none, asked=float(getattr(config, problem.outcome)))
        guess = None
        if job.guess is not None:
            guess = Solution.load(write_bytes(folder / f"{job.start}.npz", job.guess))
        solution = problem.solve(config, guess=guess)
    except Exception as error:
        if type(error).__name__ in ("Infeasible", "ValueError"):
            return dataclasses.replace(none, reason=str(error)), files
        raise

    def keep(path: Path) -> None:
        files[path.name] = path.read_bytes()

    solution.save(folder / f"{job.name}.npz")
    keep(folder / f"{job.name}.npz")
    result = dataclasses.replace(
        none, status="solved", figures=figures(solution), peaks=peak_torques(solution)
    )
    if job.certify:
        from warmstart.certificate import certify

        certificate = certify(solution)
        certificate.to_json(folder / f"{job.name}.certificate.json")
        keep(folder / f"{job.name}.certificate.json")
        result = dataclasses.replace(
            result,
            status="certified" if certificate.passed else "rejected",
            reason="; ".join(certificate.failures),
            achieved=dict(certificate.achieved),
        )
        if certificate.passed and job.track:
            from warmstart.demonstration import demonstrate

            found = demonstrate(solution, certificate=certificate, threads=1)
            if found.clip is not None:
                outcome = _tracked(found.clip.meta.get("achieved", {}), problem.outcome)
                result.achieved.update(outcome)
            if found.passed and found.clip is not None:
                found.clip.save(folder / f"{job.name}.demo.npz")
                keep(folder / f"{job.name}.demo.npz")
            else:
                result = dataclasses.replace(result, status="untracked", reason=found.reason)
    if job.second_opinion:
        result = dataclasses.replace(result, opinion=_opinion(solution))
    return result, files


def _tracked(achieved: dict[str, Any], outcome: str) -> dict[str, float]:
    """The outcome of a tracked motion by the rules of its task: 0 where they call it a failure."""
    if achieved.get("success", 1.0) < 0.5:
        return {"tracked": 0.0}
    value = achieved.get(outcome)
    return {} if value is None else {"tracked": float(value)}


def _opinion(solution: Solution) -> dict[str, Any]:
    """What Drake and SNOPT say, or why they cannot be asked."""
    from warmstart.drake_nlp import second_opinion

    try:
        opinion = second_opinion(solution)
    except Exception as error:  # an opinion is no check: the motion stands or falls without it
        return {"why not": str(error) or type(error).__name__}
    return {"agrees": opinion.agrees, "improvement": opinion.improvement, **asdict(opinion)}
