"""The process a run lives in: its signals, its clock, its device, its threads and its ranks."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import torch.distributed as dist

RANK_STEP = 7919
"""The seeds of processes that play side by side are so far apart."""


class Signals:
    """SIGTERM and SIGINT ask the loop to save and stop; a second SIGINT interrupts at once."""

    def __init__(self) -> None:
        self._asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Signals:
        for number in (signal.SIGTERM, signal.SIGINT):
            try:
                self._before[number] = signal.signal(number, self._hear)
            except ValueError:  # not the main thread: the caller's business
                break
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _hear(self, number: int, _frame: object) -> None:
        if self._asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        self._asked = True

    def heard(self, device: torch.device) -> bool:
        """Whether any rank was asked to stop; ``device`` is where the ranks talk."""
        if not dist.is_initialized() or dist.get_world_size() == 1:
            return self._asked
        flag = torch.tensor([float(self._asked)], device=device)
        dist.all_reduce(flag, op=dist.ReduceOp.MAX)
        return bool(flag.item())


class Stopwatch:
    """Seconds between marks, on the device's own clock, without waiting for it."""

    def __init__(self, device: torch.device) -> None:
        self._cuda = device.type == "cuda"
        self._marks: list[Any] = []

    def mark(self) -> None:
        if self._cuda:
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self._marks.append(event)
        else:
            self._marks.append(time.perf_counter())

    def laps(self) -> list[float]:
        """Seconds of each lap; the device must have passed the last mark."""
        pairs = zip(self._marks[:-1], self._marks[1:])
        if self._cuda:
            self._marks[-1].synchronize()
            return [a.elapsed_time(b) / 1000.0 for a, b in pairs]
        return [b - a for a, b in pairs]


def join_ranks(device: str = "auto", share: bool = False) -> bool:
    """Joins the process group that torchrun has prepared, if any; whether it did.

    With GPUs, each process takes the one of its local rank as the current device, and the ranks
    talk through NCCL; with ``device`` ``cpu``, or none, through gloo. With ``share`` processes
    that are more than the GPUs take them in turn and talk through gloo as well: NCCL wants a GPU
    for each. Raises ValueError where they are more without it, or ``device`` names one for all.
    """
    ranks = int(os.environ.get("WORLD_SIZE", "1"))
    if ranks == 1 or dist.is_initialized():
        return False
    if device == "cpu" or not torch.cuda.is_available():
        dist.init_process_group("gloo")
        return True
    here, gpus = local_ranks(), torch.cuda.device_count()
    if ":" in device:
        raise ValueError(
            f"--device {device} names one GPU for {ranks} processes: leave it out, and each takes "
            "its own"
        )
    if here > gpus and not share:
        raise ValueError(
            f"{here} processes need {here} GPUs, and this machine has {gpus}: give torchrun "
            f"--nproc-per-node {gpus}, or train on the processor with --device cpu"
        )
    own = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")) % gpus)
    torch.cuda.set_device(own)
    if here > gpus:
        dist.init_process_group("gloo")
    else:
        dist.init_process_group("nccl", device_id=own)
    return True


@contextmanager
def among_ranks(device: str = "auto", share: bool = False) -> Iterator[None]:
    """``join_ranks``, and leaves what it joined, but for an error of one rank alone: the others
    would be waited for, and torchrun ends them. A ValueError is a mistake that all have made."""
    began = join_ranks(device, share)
    try:
        yield
    except ValueError:
        _leave_ranks(began)
        raise
    _leave_ranks(began)


def _leave_ranks(began: bool) -> None:
    if began:
        dist.destroy_process_group()


def threads_of_each(engine: str, processes: int) -> dict[str, int]:
    """Options of an engine on the CPU that share the processors out among processes."""
    if engine != "mujoco" or processes == 1:
        return {}
    return {"threads": max(1, (os.cpu_count() or 1) // processes)}


def local_ranks() -> int:
    """Processes of this run on this machine."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1"))


@contextmanager
def one_torch_thread(device: torch.device) -> Iterator[None]:
    """While an engine on the CPU plays: its own threads step the worlds, and torch's, awake between
    their small tasks, would only take the cores from them. On a GPU nothing changes."""
    threads = torch.get_num_threads()
    if device.type == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def pick_device(name: str) -> torch.device:
    """``auto`` (a GPU if there is one), ``cpu`` or ``cuda``. Raises ValueError without a GPU."""
    if name != "auto":
        if name.startswith("cuda") and not torch.cuda.is_available():
            raise ValueError("there is no CUDA device here: use --device cpu")
        if name != "cuda":
            return torch.device(name)
    if torch.cuda.is_available():
        return torch.device("cuda", torch.cuda.current_device())
    return torch.device("cpu")
