"""Plays episodes with a policy on any engine and states what it can do, with intervals.

Every world plays the same number of episodes, so short ones are not over-counted, with the mean
action. A trial in which the engine diverged counts as failed. Trials differ by the start noise
of training (without it a deterministic engine would play one episode a thousand times).
"""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import stats

from rl import provenance
from rl.host import one_torch_thread
from rl.policy import Policy, load_policy
from rl.recording import Recording, Tape
from sports.env import Env, Starts, make_env, make_scene
from sports.registry import get_task
from sports.starts import START_NOISE, loose_joints

__all__ = ["EvaluationResult", "Recording", "evaluate", "interval"]

DEFAULT_WORLDS = {"mujoco": 250, "warp": 1000, "drake": 2}
START_FRAMES = 4096
KEEP_ALL = 64
"""A share of more trials keeps its best and its median only."""

Progress = Callable[[int, int], None]
"""(trials done, trials) -> None"""


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


@dataclass(frozen=True)
class _Job:
    """A share of the trials, for one process."""

    task: str
    engine: str
    trials: int
    worlds: int
    seed: int
    strength: str
    limits: str
    options: dict[str, Any]
    physics_options: dict[str, Any]
    timestep_divisor: int
    start_noise: float
    record: bool
    worlds_recorded: tuple[int, ...]


@dataclass
class _Played:
    """What a share came to. Trials in the order of their episodes, then of their worlds."""

    trials: dict[str, np.ndarray]
    recordings: dict[int, Recording]
    """By trial; all that may turn out best or median."""
    overflow: int
    nan_worlds: int
    timestep: float
    """Of the engine (s): Drake may take more of them than the scene asks for."""
    substeps: int


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
) -> EvaluationResult:
    """Plays ``trials`` episodes and summarises the task's metrics.

    Args:
        policy: a loaded policy, or what ``load_policy`` accepts (a run, a file,
            ``pretrained[:ALGO[-STRENGTH]]``, ``zero``, ``random``).
        task: name of the task.
        engine: ``mujoco``, ``warp`` or ``drake``.
        trials: number of episodes.
        seed: of starts and of everything random in the task.
        num_worlds: worlds at once (per process); None for the engine's default.
        strength: torque limits; None for those that the policy was trained with.
        limits: joint limits; likewise.
        options: the task's options.
        physics_options: the engine's options.
        timestep_divisor: 2 for half the time step at the same control rate.
        start_noise: +- joint noise of the standing start (rad).
        record: 0 for none, else keep the best and the median episode.
        record_worlds: also keep the first episode of these worlds (of the first process).
        processes: for drake, which steps worlds in sequence; None for one per core.
        progress: called with (trials done, trials).

    Raises ValueError for an unknown task or option and PolicyError for a policy that does not
    fit, RuntimeError for an engine that cannot run here.
    """
    if trials < 1:
        raise ValueError(f"trials must be at least 1, not {trials}")
    get_task(task)
    if not isinstance(policy, Policy):
        policy = load_policy(policy, task)
    card = policy.metadata
    strength = strength or str(card.get("strength", "paper"))
    limits = limits or str(card.get("limits", "paper"))
    options = dict(options or {})
    make_scene(  # a mistake is told before any process starts
        task,
        strength=strength,  # type: ignore[arg-type]
        limits=limits,  # type: ignore[arg-type]
        options=options,
        timestep_divisor=timestep_divisor,
    )
    worlds = num_worlds or DEFAULT_WORLDS.get(engine, DEFAULT_WORLDS["mujoco"])
    many = engine == "drake" and (processes is None or processes > 1)
    workers = min(processes or os.cpu_count() or 1, trials) if many else 1
    shares = _shares(trials, worlds, workers)
    jobs = [
        _Job(
            task=task,
            engine=engine,
            trials=share,
            worlds=worlds,
            seed=seed + 7919 * i,
            strength=strength,
            limits=limits,
            options=options,
            physics_options=dict(physics_options or {}),
            timestep_divisor=timestep_divisor,
            start_noise=start_noise,
            record=record > 0,
            worlds_recorded=record_worlds if i == 0 else (),
        )
        for i, share in enumerate(shares)
    ]
    played = _run(policy, jobs, workers, trials, progress)
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
        z = float(stats.norm.ppf(0.975))
        middle = (mean + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * math.sqrt(mean * (1 - mean) / n + z * z / (4 * n * n))
        # At 0 and 1 the end is exact; rounding must not leave the range.
        low = 0.0 if mean == 0.0 else max(0.0, middle - half)
        high = 1.0 if mean == 1.0 else min(1.0, middle + half)
        return {"mean": mean, "ci95": [low, high], "n": n, "unit": unit}
    if n == 1 or not np.isfinite(x).all():
        return {"mean": mean if math.isfinite(mean) else None, "ci95": None, "n": n, "unit": unit}
    half = float(stats.t.ppf(0.975, n - 1)) * float(x.std(ddof=1)) / math.sqrt(n)
    return {"mean": mean, "ci95": [mean - half, mean + half], "n": n, "unit": unit}


def _shares(trials: int, worlds: int, workers: int) -> list[int]:
    """Trials of each job: multiples of ``worlds`` but the last, about four jobs per worker."""
    if workers == 1:
        return [trials]
    size = max(1, math.ceil(trials / (4 * workers * worlds))) * worlds
    return [min(size, trials - start) for start in range(0, trials, size)]


def _run(
    policy: Policy, jobs: list[_Job], workers: int, trials: int, progress: Progress | None
) -> list[_Played]:
    report = progress or (lambda done, total: None)
    if workers == 1:
        return [_play(policy, job, lambda done: report(done, trials)) for job in jobs]
    played: dict[int, _Played] = {}
    context = multiprocessing.get_context("spawn")
    report(0, trials)
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_one_thread) as pool:
        futures = {pool.submit(_play, policy, job): i for i, job in enumerate(jobs)}
        try:
            for future in as_completed(futures):
                played[futures[future]] = future.result()
                report(sum(jobs[i].trials for i in played), trials)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [played[i] for i in range(len(jobs))]


def _one_thread() -> None:
    torch.set_num_threads(1)


def _play(policy: Policy, job: _Job, report: Callable[[int], None] | None = None) -> _Played:
    """Plays one share of the trials in this process."""
    episodes = math.ceil(job.trials / job.worlds)
    worlds = math.ceil(job.trials / episodes)
    env = make_env(
        job.task,
        engine=job.engine,
        num_worlds=worlds,
        seed=job.seed,
        strength=job.strength,  # type: ignore[arg-type]
        limits=job.limits,  # type: ignore[arg-type]
        training=False,
        options=job.options,
        physics_options=job.physics_options,
        timestep_divisor=job.timestep_divisor,
    )
    try:
        policy.check(env)
        policy.to(env.device)
        policy.seed(job.seed)
        if job.start_noise > 0.0:
            env.starts = standing_starts(env, job.start_noise, job.seed)
        with one_torch_thread(env.device):
            return _play_episodes(policy, job, env, episodes, report)
    finally:
        env.close()


def standing_starts(env: Env, noise: float, seed: int) -> Starts:
    """Frames of the standing start with joint noise +-``noise`` (rad), of agent 0."""
    scene = env.physics.scene
    generator = torch.Generator().manual_seed(seed)
    start = torch.tensor(scene.default_qpos()[scene.agent_qpos(0)], dtype=torch.float32)
    qpos = start.repeat(START_FRAMES, 1)
    draw = 2.0 * torch.rand(qpos[:, 7:].shape, generator=generator) - 1.0
    qpos[:, 7:] += noise * loose_joints(scene, qpos.device) * draw
    qvel = torch.zeros(START_FRAMES, 6 + scene.body.num_dofs)
    return Starts(qpos, qvel, {}, probability=1.0).to(env.device)


def _play_episodes(
    policy: Policy,
    job: _Job,
    env: Env,
    episodes: int,
    report: Callable[[int], None] | None,
) -> _Played:
    names = env.metric_names
    units = get_task(job.task).metrics
    trial_of = np.zeros(env.num_worlds, dtype=int)  # the episode that a world is in
    began = np.zeros(env.num_worlds, dtype=int)
    returns, done = np.zeros(env.num_worlds), 0
    table = {
        n: np.full((episodes, env.num_worlds), np.nan) for n in (*names, "return", "episode_steps")
    }
    spans: dict[tuple[int, int], tuple[int, int]] = {}
    tape = Tape(env, job.record or bool(job.worlds_recorded))
    obs, step = env.reset(), 0
    while (trial_of < episodes).any():
        action = policy(obs)
        result = env.step(action)
        obs, step = result.obs, step + 1
        tape.add(action, result)
        bad = (~result.valid).cpu().numpy()
        ended = result.ended.cpu().numpy() | bad
        returns += np.where(bad, 0.0, result.reward.mean(-1).cpu().numpy())
        if not ended.any():
            continue
        metrics = {n: result.metrics[n].double().cpu().numpy() for n in names}
        for w in np.flatnonzero(ended).tolist():
            e = int(trial_of[w])
            if e < episodes:
                for n in names:
                    table[n][e, w] = _settled(metrics[n][w], bad[w], units.get(n, ""))
                table["return"][e, w], table["episode_steps"][e, w] = returns[w], step - began[w]
                spans[e, w] = (began[w], step)
                done += 1
            trial_of[w], began[w], returns[w] = e + 1, step, 0.0
        if report is not None:
            report(min(done, job.trials))
    # The last round may be one too many in the last worlds: left out by index, not by outcome.
    trials = {n: x.flatten()[: job.trials] for n, x in table.items()}
    taped = {
        e * env.num_worlds + w: (w, start, end)
        for (e, w), (start, end) in spans.items()
        if e * env.num_worlds + w < job.trials and end <= len(tape.steps)
    }
    keep = {w for w in job.worlds_recorded if w in taped}  # trial w is world w's first episode
    if job.record and taped:
        order = _ranked(job.task, trials, taped)
        keep |= set(order if len(order) <= KEEP_ALL else (order[-1], order[len(order) // 2]))
    common = ("task", "options", "seed", "engine", "strength", "limits", "timestep_divisor")
    facts = {name: getattr(job, name) for name in common}
    recordings = {
        trial: tape.cut(*taped[trial], {n: float(trials[n][trial]) for n in names}, facts)
        for trial in sorted(keep)
    }
    physics = env.physics
    return _Played(
        trials,
        recordings,
        int(physics.overflow),
        int(physics.nan_worlds),
        timestep=getattr(physics, "timestep", physics.scene.timestep),
        substeps=getattr(physics, "substeps", physics.scene.substeps),
    )


def _settled(value: float, bad: bool, unit: str) -> float:
    """A metric of an ended episode: one that diverged has failed, and achieved nothing else."""
    if not bad or math.isnan(value):
        return float(value)
    return 0.0 if unit == "fraction" else math.nan


def _ranked(task: str, values: Mapping[str, np.ndarray], of: Iterable[int]) -> list[int]:
    """Trials from worst to best: by the task's main metric, then by return."""
    main = values[get_task(task).main_metric]
    rank = np.where(np.isnan(main), -np.inf, main)
    return sorted(of, key=lambda t: (rank[t], values["return"][t]))


def _choose(
    task: str,
    values: dict[str, np.ndarray],
    played: list[_Played],
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
    place = {t: i for i, t in enumerate(_ranked(task, values, range(len(values["return"]))))}
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
