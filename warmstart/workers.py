"""Who does the jobs: processes of this machine, or Ray on this machine or a cluster of them.

``with processes(2) as run`` and ``with ray_cluster("auto") as run`` give the same function:
``run(jobs, out, finished)`` solves all jobs, stores each one's files in ``out`` as soon as it is
done and calls ``finished(job, result)``. Solvers' Python constraints are not thread-safe, so every
job has a process of its own, with one thread.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from warmstart.job import Files, Job, Result, crashed, read_result, solve_job, store

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_DIE_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux's prctl."""
Run = Callable[[Sequence[Job], Path, Callable[[Job, Result], None]], None]


def workers(count: int, cluster: str | None) -> AbstractContextManager[Run]:
    """Processes of this machine, or Ray where a cluster is named. Raises ValueError for a count
    below 1 and where Ray is not installed."""
    if count < 1:
        raise ValueError(f"at least one process is needed, not {count}")
    return processes(count) if cluster is None else ray_cluster(cluster, count)


@contextmanager
def processes(count: int) -> Iterator[Run]:
    """Spawned processes, ``count`` at a time, each for one job: one that is killed (out of memory,
    a crash in native code) takes nothing else with it. They end with this process."""
    context = multiprocessing.get_context("spawn")
    running: dict[int, tuple[Job, BaseProcess, float]] = {}
    kept = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # children inherit it

    def run(jobs: Sequence[Job], out: Path, finished: Callable[[Job, Result], None]) -> None:
        left = list(jobs)
        while left or running:
            while left and len(running) < count:
                job = left.pop(0)
                process = context.Process(
                    target=_child, args=(job, str(out), os.getpid()), daemon=True
                )
                process.start()
                running[process.sentinel] = (job, process, time.perf_counter())
            for sentinel in wait(list(running)):
                job, process, begun = running.pop(sentinel)  # type: ignore[arg-type]
                process.join()
                result = read_result(out / f"{job.name}.json")
                if process.exitcode != 0 or result is None:
                    reason = f"its process ended with code {process.exitcode}"
                    result = crashed(job, reason, time.perf_counter() - begun)
                    store(out, result, {})
                finished(job, result)

    try:
        yield run
    finally:
        for _, process, _ in running.values():
            process.terminate()
        for name, value in kept.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


def _child(job: Job, out: str, parent: int) -> None:
    """What a spawned process runs. It does not outlive its parent, even one killed with -9: the
    sweep that is started again would have two processes at work on the same value."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
    store(Path(out), *solve_job(job))


@contextmanager
def ray_cluster(address: str, count: int = 2) -> Iterator[Run]:
    """Ray tasks of one processor each; the driver (this process) stores what comes back, so the
    machines need not share a disk.

    ``local`` starts Ray on this machine with ``count`` processors; ``auto`` is the cluster that
    this machine belongs to; anything else is an address, such as ``ray://HOST:10001``. The
    project must be installed on the cluster's machines. Raises ValueError without Ray and when no
    cluster answers.
    """
    try:
        import ray
    except ImportError:
        raise ValueError(
            "a cluster needs the package ray: pip install 'olympics-opt[cluster]'"
        ) from None
    variables: dict[str, str] = dict.fromkeys(_THREADS, "1")
    here = address == "local"
    if here:  # the same modules as here
        variables["PYTHONPATH"] = os.pathsep.join(p for p in sys.path if p)
    try:
        ray.init(
            address=address,
            runtime_env={"env_vars": variables},
            log_to_driver=False,
            logging_level="error",
            **({"num_cpus": count, "include_dashboard": False} if here else {}),
        )
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        line = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ValueError(f"no Ray cluster at '{address}': {line}") from error
    remote = ray.remote(num_cpus=1, max_retries=0, max_calls=1)(_remote)

    def run(jobs: Sequence[Job], out: Path, finished: Callable[[Job, Result], None]) -> None:
        begun = time.perf_counter()
        running = {remote.remote(job): job for job in jobs}
        while running:
            done, _ = ray.wait(list(running))
            for reference in done:
                job = running.pop(reference)
                try:
                    result, files = ray.get(reference)
                except ray.exceptions.RayError as error:
                    line = str(error).strip().splitlines()[0]
                    reason = f"its Ray worker ended: {type(error).__name__}: {line}"
                    result, files = crashed(job, reason, time.perf_counter() - begun), {}
                store(out, result, files)
                finished(job, result)

    try:
        yield run
    finally:
        ray.shutdown()


def _remote(job: Job) -> tuple[Result, Files]:
    return solve_job(job)
