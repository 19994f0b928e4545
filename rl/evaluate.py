"""Plays episodes with a policy on any engine and states what it can do, with intervals.

Every world plays the same number of episodes, so short ones are not over-counted, with the mean
action. A trial in which the engine diverged counts as failed. Trials differ by the start noise
of training (without it a deterministic engine would play one episode a thousand times).
"""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.special import ndtri, stdtrit

from rl import provenance
from rl.host import RANK_STEP
from rl.kept_shares import KeptShares
from rl.policy import Policy, as_trained, load_policy
from rl.recording import Recording
from rl.trials import Played, Share, play_share, ranked, standing_starts
from rl.worlds import other_physics
from sports.env import make_scene
from sports.registry import get_task
from sports.starts import START_NOISE

__all__ = ["EvaluationResult", "Recording", "evaluate", "interval", "standing_starts"]

DEFAULT_WORLDS = {"mujoco": 250, "warp": 1000, "drake": 2}
ROUNDS = 7
"""Episodes that each world of a share plays at most, in Drake."""

Progress = Callable[[float, int], None]
"""(trials done, trials) -> None. One under way counts as the share of it that has been played."""


@dataclass(frozen=True)
class EvaluationResult:
    """What an evaluation found."""

    result: dict[str, Any]
    """The result schema: metrics with 95 % intervals and everything that decides them; JSON."""
    trials: dict[str, np.ndarray]
    """(trials,) each metric of each trial, NaN where undefined; also its ``return`` and
    ``episode_steps``."""
    recordings: dict[str, Recording] = field(default_factory=dict)
    """``best`` and ``median`` by the task's main metric (then by return), and ``world_W`` for
    each world asked for."""

    @property
    def best(self) -> Recording:
        """The best recorded episode. Raises KeyError without recordings."""
        return self.recordings["best"]

    @property
    def median(self) -> Recording:
        """The median one. Raises KeyError without recordings."""
        return self.recordings["median"]


def evaluate(
    policy: Policy | str | Path,
    task: str,
    *,
    engine: str = "mujoco",
    trials: int = 200,
    seed: int = 0,
    num_worlds: int | None = None,
    strength: str | None = None,
    limits: str | None = None,
    options: dict[str, Any] | None = None,
    physics_options: dict[str, Any] | None = None,
    timestep_divisor: int = 1,
    start_noise: float = START_NOISE,
    record: int = 0,
    record_worlds: tuple[int, ...] = (),
    processes: int | None = None,
    progress: Progress | None = None,
    parts: Path | None = None,
) -> EvaluationResult:
    """Plays ``trials`` episodes and summarises the task's metrics.

    Args:
        policy: a loaded policy, or what ``load_policy`` accepts (a run, a file,
            ``pretrained[:ALGO[-STRENGTH]]``, ``zero``, ``random``).
        task: name of the task.
        engine: ``mujoco``, ``warp`` or ``drake``.
        trials: number of episodes.
        seed: of starts and of everything random in the task.
        num_worlds: worlds at once (per process); None for the engine's default. Other numbers are
            other trials.
        strength: torque limits; None for those that the policy was trained with.
        limits: joint limits; likewise.
        options: the task's options; those that add to what the policy saw when it learned come
            from its card.
        physics_options: the engine's options.
        timestep_divisor: 2 for half the time step at the same control rate.
        start_noise: +- joint noise of the standing start (rad).
        record: 0 for none, else keep the best and the median episode.
        record_worlds: also keep the first episode of these worlds (of the first process).
        processes: for drake, which steps worlds in sequence; None for one per core. The trials
            are the same whatever their number.
        progress: called with (trials done, trials).
        parts: a folder for the shares of Drake's trials that are finished, so that the same
            evaluation, begun again after it was stopped, goes on (``rl.kept_shares.forget`` removes
            them); None for none.

    Raises ValueError for an unknown task or option and PolicyError for a policy that does not
    fit, RuntimeError for an engine that cannot run here.
    """
    if trials < 1:
        raise ValueError(f"trials must be at least 1, not {trials}")
    if processes is not None and processes < 1:
        raise ValueError(f"at least one process is needed, not {processes}")
    get_task(task)
    if not isinstance(policy, Policy):
        policy = load_policy(policy, task)
    card = policy.metadata
    strength, limits, options = as_trained(policy, task, strength, limits, options)
    make_scene(  # a mistake is told before any process starts
        task,
        strength=strength,  # type: ignore[arg-type]
        limits=limits,  # type: ignore[arg-type]
        options=options,
        timestep_divisor=timestep_divisor,
    )
    worlds = num_worlds or DEFAULT_WORLDS.get(engine, DEFAULT_WORLDS["mujoco"])
    sizes = _sizes(trials, worlds) if engine == "drake" else [trials]
    workers = min(processes or os.cpu_count() or 1, len(sizes))
    shares = [
        Share(
            task=task,
            engine=engine,
            trials=size,
            worlds=worlds,
            seed=seed + RANK_STEP * i,
            strength=strength,
            limits=limits,
            options=options,
            physics_options=dict(physics_options or {}),
            timestep_divisor=timestep_divisor,
            start_noise=start_noise,
            record=record > 0,
            worlds_recorded=record_worlds if i == 0 else (),
        )
        for i, size in enumerate(sizes)
    ]
    kept = KeptShares(parts if engine == "drake" else None, policy)
    played = _run(policy, shares, workers, trials, progress, kept)
    values = {name: np.concatenate([p.trials[name] for p in played]) for name in played[0].trials}
    recordings = _choose(task, values, played, record > 0, record_worlds)
    units = get_task(task).metrics
    result = {
        "task": task,
        "algo": card["algo"],
        "policy_sha256": card["sha256"],
        "engine": engine,
        "strength": strength,
        "limits": limits,
        "options": options,
        "timestep": played[0].timestep,
        "substeps": played[0].substeps,
        "start_noise": start_noise,
        "trials": trials,
        "seed": seed,
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
        "metrics": {
            name: interval(values[name], units.get(name, "")) for name in values if name in units
        },
        "overflow": sum(p.overflow for p in played),
        "nan_worlds": sum(p.nan_worlds for p in played),
    }
    if policy.prior is not None:
        result["prior_digest"] = policy.prior.digest
    result |= other_physics(physics_options or {}, timestep_divisor)
    for recording in recordings.values():
        recording.meta |= {"policy_sha256": card["sha256"], "commit": result["commit"]}
    return EvaluationResult(result, values, recordings)


def interval(values: np.ndarray, unit: str) -> dict[str, Any]:
    """Mean and 95 % interval of one metric: {"mean", "ci95", "n", "unit"}.

    ``values`` (trials,), NaN where the metric is undefined; n counts the others. A fraction of
    zeros and ones gets Wilson's interval (Wilson 1927), anything else Student's t on the mean;
    ``ci95`` is None with fewer than two values, ``mean`` with none.
    """
    x = np.asarray(values, dtype=float)
    x = x[~np.isnan(x)]
    n = len(x)
    if n == 0:
        return {"mean": None, "ci95": None, "n": 0, "unit": unit}
    mean = float(x.mean())
    if unit == "fraction" and np.isin(x, (0.0, 1.0)).all():
        z = float(ndtri(0.975))
        middle = (mean + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * math.sqrt(mean * (1 - mean) / n + z * z / (4 * n * n))
        # At 0 and 1 the end is exact; rounding must not leave the range.
        low = 0.0 if mean == 0.0 else max(0.0, middle - half)
        high = 1.0 if mean == 1.0 else min(1.0, middle + half)
        return {"mean": mean, "ci95": [low, high], "n": n, "unit": unit}
    if n == 1 or not np.isfinite(x).all():
        return {"mean": mean if math.isfinite(mean) else None, "ci95": None, "n": n, "unit": unit}
    half = float(stdtrit(n - 1, 0.975)) * float(x.std(ddof=1)) / math.sqrt(n)
    return {"mean": mean, "ci95": [mean - half, mean + half], "n": n, "unit": unit}


def _sizes(trials: int, worlds: int) -> list[int]:
    """Trials of each share in Drake: an eighth of all, at most ``ROUNDS`` in each of its worlds.

    A share has a seed of its own, so how many there are may not depend on how many processes play
    them: the same seed is the same trials on every machine.
    """
    size = min(math.ceil(trials / (8 * worlds)), ROUNDS) * worlds
    return [min(size, trials - start) for start in range(0, trials, size)]


def _run(
    policy: Policy,
    shares: list[Share],
    workers: int,
    trials: int,
    progress: Progress | None,
    parts: KeptShares,
) -> list[Played]:
    """Plays them here, or in processes of their own; those that ``parts`` has are done."""
    report = progress or (lambda done, total: None)
    found = {i: parts.find(share) for i, share in enumerate(shares)}
    played = {i: p for i, p in found.items() if p is not None}
    done = sum(shares[i].trials for i in played)
    report(done, trials)
    missing = [i for i in range(len(shares)) if i not in played]
    if workers == 1:
        for i in missing:
            played[i] = play_share(policy, shares[i], lambda k, n=done: report(n + k, trials))
            parts.keep(shares[i], played[i])
            done += shares[i].trials
        return [played[i] for i in range(len(shares))]
    context = multiprocessing.get_context("spawn")
    counter = context.Value("i", 0)
    with ProcessPoolExecutor(
        workers, mp_context=context, initializer=_begin, initargs=(counter,)
    ) as pool:
        futures = {pool.submit(_play_counted, policy, shares[i]): i for i in missing}
        waiting = set(futures)
        try:
            while waiting:
                ended, waiting = wait(waiting, timeout=1.0, return_when=FIRST_COMPLETED)
                for future in ended:
                    i = futures[future]
                    played[i] = future.result()
                    parts.keep(shares[i], played[i])
                report(done + counter.value / 1000, trials)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [played[i] for i in range(len(shares))]


_counter: Any = None
"""Of a worker: thousandths of trials done by all of them, whole numbers, so that they add up."""


def _begin(counter: Any) -> None:
    global _counter
    _counter = counter
    torch.set_num_threads(1)


def _play_counted(policy: Policy, share: Share) -> Played:
    """``play_share`` in a worker, which tells of each trial."""
    before = 0

    def count(done: float) -> None:
        nonlocal before
        now = int(1000 * done)
        with _counter.get_lock():
            _counter.value += now - before
        before = now

    return play_share(policy, share, count)


def _choose(
    task: str,
    values: dict[str, np.ndarray],
    played: list[Played],
    record: bool,
    worlds: tuple[int, ...],
) -> dict[str, Recording]:
    """Best and median of the recorded trials, and the first episodes of single worlds."""
    recordings: dict[int, Recording] = {}
    offset = 0
    for p in played:
        recordings |= {offset + trial: r for trial, r in p.recordings.items()}
        offset += len(p.trials["return"])
    if not recordings:
        return {}
    place = {t: i for i, t in enumerate(ranked(task, values, range(len(values["return"]))))}
    best = max(recordings, key=place.__getitem__)
    median = min(recordings, key=lambda t: abs(place[t] - len(place) // 2))
    chosen = {}
    if record:
        chosen = {"best": recordings[best], "median": recordings[median]}
    first = len(played[0].trials["return"])
    for trial, recording in sorted(recordings.items(), reverse=True):
        if trial < first and recording.world in worlds:
            chosen[f"world_{recording.world}"] = recording
    return chosen
