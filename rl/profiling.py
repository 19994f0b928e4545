"""Where the time of training goes: ``olympics-opt train TASK --profile``.

A few updates are timed part by part, with nothing else running; then some more are recorded by
torch's profiler, which slows them, for a trace and for what waits for the device. On a GPU the
parts are timed on the device's own clock: its work is in one order, so the time between two marks
is that of what lies between them, gaps included in which the device waits for the host.
"""

from __future__ import annotations

import collections
import gzip
import json
import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile, record_function

from rl import provenance
from rl.parts import Style
from warmstart.atomic import write_text

WARM_UP, TIMED, TRACED = 3, 5, 2
"""Updates that are not measured (they compile, allocate and capture), timed, and traced."""
ROLLOUT = "rollout"
SIMULATION, SENSES = "simulation", "observations, rewards, resets"
STORING, STATISTICS, STYLE = "rollout: storing, bonuses", "episode statistics", "style"
POLICY, ADVANTAGES, UPDATE = "policy", "values and advantages", "update"
RANKS, REST = "messages between ranks", "the loop"


class Phases:
    """Seconds of nested parts of a program, each without the parts inside it."""

    def __init__(self, on_gpu: bool, wait: Callable[[], None] = lambda: None) -> None:
        """``on_gpu``: read the device's clock; else the host's, after ``wait``."""
        self._on_gpu, self._wait = on_gpu, wait
        self._open = [REST]
        self._marks: list[tuple[Any, str]] = []
        self._mark()

    def wrap(self, owner: Any, method: str, name: str) -> None:
        """From now on the time of ``owner.method`` counts as ``name``. Where there is none, nothing
        happens: learners differ in their parts."""
        plain = getattr(owner, method, None)
        if plain is None:
            return

        def timed(*args: Any, **options: Any) -> Any:
            with self.of(name):
                return plain(*args, **options)

        setattr(owner, method, timed)

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """The time inside counts as ``name``."""
        self._open.append(name)
        self._mark()
        try:
            with record_function(name):
                yield
        finally:
            self._open.pop()
            self._mark()

    def _mark(self) -> None:
        if self._on_gpu:
            now: Any = torch.cuda.Event(enable_timing=True)
            now.record()
        else:
            self._wait()
            now = time.perf_counter()
        self._marks.append((now, self._open[-1]))

    def seconds(self) -> dict[str, float]:
        """Seconds by name since the last call, in order of first appearance. Waits."""
        self._mark()
        if self._on_gpu:
            torch.cuda.synchronize()
        found: dict[str, float] = {}
        for (begin, name), (end, _) in zip(self._marks[:-1], self._marks[1:]):
            took = begin.elapsed_time(end) / 1000.0 if self._on_gpu else end - begin
            found[name] = found.get(name, 0.0) + took
        self._marks = self._marks[-1:]
        return found


@dataclass(frozen=True)
class Trace:
    """What a trace of several rollouts and updates tells."""

    device_busy: float | None
    """Share of the time since the first rollout in which the device computed or copied; None
    without one."""
    waits: dict[str, int]
    """Calls by which the host waited for the device while rollouts were played, by name."""


def read_trace(path: Path) -> Trace:
    """Reads a Chrome trace (gz) of torch's profiler."""
    with gzip.open(path, "rt") as f:
        events = [e for e in json.load(f)["traceEvents"] if e.get("ph") == "X"]
    rollouts = [(e["ts"], e["ts"] + e["dur"]) for e in events if _is_rollout(e)]
    waits: collections.Counter[str] = collections.Counter()
    work = []
    for e in events:
        kind = e.get("cat", "")
        if kind in ("kernel", "gpu_memcpy", "gpu_memset"):
            work.append((e["ts"], e["ts"] + e["dur"]))
        elif kind in ("cuda_runtime", "cuda_driver") and "Synchronize" in e["name"]:
            if any(begin <= e["ts"] <= end for begin, end in rollouts):
                waits[e["name"]] += 1
    busy = None
    if work and rollouts:
        begin, end = min(a for a, _ in rollouts), max(b for _, b in work)
        busy = _covered(work) / (end - begin)
    return Trace(busy, dict(waits))


def _is_rollout(event: dict[str, Any]) -> bool:
    return event["name"] == ROLLOUT and event.get("cat") in ("user_annotation", "cpu_op")


def _covered(spans: list[tuple[float, float]]) -> float:
    """Length of the union of spans."""
    total, reached = 0.0, float("-inf")
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, reached))
        reached = max(reached, end)
    return total


def profile_training(trainer: Any, iterate: Callable[[], Any]) -> Path:
    """Times and traces a few updates of a trainer (see rl.train); returns the trace's path.

    Writes ``trace.json.gz`` and ``profile.json`` into the run's folder and prints a table, from
    rank 0; the others take part. ``iterate`` plays and learns once.
    """
    out: Path = trainer.config.out
    cuda = trainer.device.type == "cuda"
    on_gpu = cuda and trainer.env.device.type == "cuda"
    phases = Phases(on_gpu, torch.cuda.synchronize if cuda else lambda: None)
    _name_parts(phases, trainer)
    for _ in range(WARM_UP):
        iterate()
    phases.seconds()
    began = time.perf_counter()
    for _ in range(TIMED):
        iterate()
    seconds = {name: s / TIMED for name, s in phases.seconds().items()}
    whole = (time.perf_counter() - began) / TIMED
    places: collections.Counter[str] = collections.Counter()
    with _waits_seen(trainer, places) if cuda else _nothing():
        kinds = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if cuda else [])]
        with profile(activities=kinds) as recorded:
            for _ in range(TRACED):
                iterate()
            if cuda:
                torch.cuda.synchronize()
    path = out / "trace.json.gz"
    if trainer.rank == 0:
        out.mkdir(parents=True, exist_ok=True)
        part = out / ".part.trace.json.gz"
        recorded.export_chrome_trace(str(part))
        os.replace(part, path)
        found = read_trace(path)
        figures = {
            "task": trainer.config.task,
            "engine": trainer.config.engine,
            "worlds": trainer.env.num_worlds,
            "ranks": trainer.ranks,
            "samples_per_s": trainer.made.samples_each / whole,
            "seconds_per_update": seconds,
            "waits_in_rollouts": dict(places),
            "updates_timed": TIMED,
            "updates_traced": TRACED,
            **{f"trace_{k}": v for k, v in asdict(found).items()},
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "hardware": provenance.hardware(),
        }
        write_text(out / "profile.json", json.dumps(figures, indent=1))
        if not trainer.config.quiet:
            print("\n".join(lines(figures, cuda)), flush=True)
    return path


def lines(figures: dict[str, Any], cuda: bool) -> list[str]:
    """The table, as lines of text."""
    seconds = figures["seconds_per_update"]
    whole = sum(seconds.values())
    text = [
        f"{figures['task']} on {figures['engine']}, {figures['worlds']} worlds x "
        f"{figures['ranks']} processes: {figures['samples_per_s']:,.0f} samples/s",
        f"{'part of an update':<32}{'ms':>9}{'share':>8}",
    ]
    text += [f"{k:<32}{1e3 * s:>9.1f}{s / whole:>8.1%}" for k, s in seconds.items()]
    text.append(f"{'all':<32}{1e3 * whole:>9.1f}")
    if not cuda:
        return [*text, "no GPU: nothing to wait for"]
    busy = figures["trace_device_busy"]
    if busy is not None:
        text.append(f"the GPU was busy in {busy:.0%} of the traced time")
    waits = figures["waits_in_rollouts"] | figures["trace_waits"]
    if not waits:
        return [*text, "nothing in the rollout waits for the device"]
    text.append(f"waits for the device in {figures['updates_traced']} rollouts:")
    return text + [f"  {count} x {place}" for place, count in waits.items()]


def _name_parts(phases: Phases, trainer: Any) -> None:
    env, agent = trainer.env, trainer.agent
    style = next((part.amp for part in trainer.parts if isinstance(part, Style)), None)
    physics = getattr(env, "physics", None)
    phases.wrap(physics, "step", SIMULATION)
    phases.wrap(env, "step", SENSES if physics is not None else SIMULATION)
    for method in ("act", "prepare"):
        phases.wrap(agent, method, POLICY)
    phases.wrap(agent, "_compute_advantages", ADVANTAGES)
    phases.wrap(agent, "update", UPDATE)
    for method in ("watch", "pay", "update"):
        phases.wrap(style, method, STYLE)
    for step in (getattr(agent, "_step", None), getattr(style, "_train", None)):
        phases.wrap(getattr(step, "shared", None), "average", RANKS)
    phases.wrap(trainer, "_watch", STATISTICS)
    inner = trainer._play

    def play() -> None:
        with record_function(ROLLOUT), phases.of(STORING):
            inner()

    trainer._play = play


@contextmanager
def _waits_seen(trainer: Any, places: collections.Counter[str]) -> Iterator[None]:
    """Counts the lines of code in which torch waits for the device while a rollout is played."""
    inner = trainer._play

    def play() -> None:
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            try:
                inner()
            finally:
                torch.cuda.set_sync_debug_mode("default")
        for w in heard:
            if "synchronizing CUDA" in str(w.message):
                places[f"{w.filename}:{w.lineno}"] += 1

    trainer._play = play
    try:
        yield
    finally:
        trainer._play = inner


@contextmanager
def _nothing() -> Iterator[None]:
    yield
