"""Endurance: a task under random actions for thousands of steps, and everything that goes wrong.

What is looked for: numbers in an observation or reward that are not finite, worlds that diverge,
buffers that overflow, rewards or observations of absurd size, and memory that grows.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from olympics_opt.meter import device_name, resident_gib
from rl.checkpoint import checkpoints, load_checkpoint, save_checkpoint
from rl.host import threads_of_each
from sports.env import Env, make_env
from warmstart.atomic import write_json

STEPS = 10_000
SIGMA = 0.3
"""Of the random actions: more than a fresh policy's, so that the athletes thrash about."""
ACTIONS = 64
"""Different actions for each world, in turn."""
LOOK_SECONDS = 0.5
"""Between two looks at how far several processes have come."""
KEPT_MINUTES = 5.0
"""Between the states that are kept of a run: what a kill may cost."""


@dataclass(frozen=True)
class Soak:
    """What became of one task."""

    task: str
    engine: str
    device: str
    worlds: int
    agents: int
    steps: int
    sigma: float
    episodes: int
    bad_observations: int
    """Numbers of an observation that were not finite, in worlds that had not diverged."""
    bad_rewards: int
    largest_observation: float
    largest_reward: float
    """Of one step, unscaled, by size."""
    nan_worlds: int
    overflow: int
    overflows: dict[str, int]
    """Which of the engine's buffers, by its name there, and how often; of a world more than one may
    overflow."""
    steps_per_second: float
    """Control steps of all worlds together."""
    device_memory_gib: tuple[float, float] | None
    """Memory of the GPU in use after a hundredth of the steps and at the end."""
    host_memory_gib: float
    processes: int = 1
    """That shared the worlds out; memory is that of all of them."""

    @property
    def clean(self) -> bool:
        """Whether nothing was lost but worlds that diverged and were counted."""
        return self.bad_observations == self.bad_rewards == self.overflow == 0


@dataclass
class Tally:
    """What has been counted so far, over all calls."""

    step: int = 0
    """Control steps of each world."""
    bad_observations: int = 0
    bad_rewards: int = 0
    episodes: int = 0
    largest_observation: float = 0.0
    largest_reward: float = 0.0
    nan_worlds: int = 0
    overflow: int = 0
    overflows: dict[str, int] = field(default_factory=dict)
    seconds: float = 0.0
    early_gib: float | None = None
    """Memory of the GPU in use after a hundredth of the steps."""


def soak(
    task: str,
    engine: str,
    *,
    worlds: int,
    steps: int = STEPS,
    seed: int = 0,
    physics_options: dict[str, Any] | None = None,
    on_step: Callable[[int], None] | None = None,
    keep: Path | None = None,
    minutes: float | None = None,
) -> Soak:
    """Plays ``steps`` control steps of random actions in ``worlds`` worlds.

    Args:
        task: name of a task.
        engine: ``mujoco``, ``warp`` or ``drake``.
        worlds: number of worlds.
        steps: control steps of each.
        seed: of actions and starts.
        physics_options: of the engine.
        on_step: called with the number of steps taken, now and then.
        keep: folder in which the worlds are kept every few minutes and at the end; the same call
            goes on with them.
        minutes: time limit of this call; its ``steps`` are those taken until then, by all calls.

    Raises:
        ValueError: unknown task or engine, counts that are not positive, or a folder that keeps
            another endurance run.
        CheckpointError: the folder cannot be read or written.
        RuntimeError: the engine cannot run here.
    """
    if min(worlds, steps) < 1:
        raise ValueError(f"worlds and steps must be positive, not {worlds} and {steps}")
    if minutes is not None and minutes <= 0.0:
        raise ValueError(f"the minutes must be positive, not {minutes}")
    about = {"task": task, "engine": engine, "worlds": worlds, "seed": seed, "sigma": SIGMA}
    env = make_env(
        task, engine=engine, num_worlds=worlds, seed=seed, physics_options=physics_options
    )
    try:
        tally = _begin(keep, about, env)
        generator = torch.Generator(env.device).manual_seed(seed)
        shape = (ACTIONS, worlds, env.num_agents, env.action_size)
        actions = SIGMA * torch.randn(shape, generator=generator, device=env.device)
        began, limit = time.perf_counter(), math.inf if minutes is None else 60.0 * minutes
        left = limit
        while left > 0.0 and tally.step < steps:
            _play(env, actions, tally, steps, min(left, 60.0 * KEPT_MINUTES), on_step)
            if keep is not None:
                state = {"soak": about | asdict(tally)}
                save_checkpoint(keep, tally.step, state, env.state_dict())
            left = limit - (time.perf_counter() - began)
        late = _device_gib(env)
        return Soak(
            task=task,
            engine=engine,
            device=device_name(env.device),
            worlds=worlds,
            agents=env.num_agents,
            steps=tally.step,
            sigma=SIGMA,
            episodes=tally.episodes,
            bad_observations=tally.bad_observations,
            bad_rewards=tally.bad_rewards,
            largest_observation=tally.largest_observation,
            largest_reward=tally.largest_reward,
            nan_worlds=tally.nan_worlds,
            overflow=tally.overflow,
            overflows=tally.overflows,
            steps_per_second=worlds * tally.step / max(tally.seconds, 1e-9),
            device_memory_gib=None
            if tally.early_gib is None or late is None
            else (tally.early_gib, late),
            host_memory_gib=resident_gib(),
        )
    finally:
        env.close()


def soak_shared(
    task: str,
    engine: str,
    *,
    worlds: int,
    processes: int,
    steps: int = STEPS,
    seed: int = 0,
    on_step: Callable[[int], None] | None = None,
    keep: Path | None = None,
    minutes: float | None = None,
    shares: Sequence[int] = (),
) -> Soak | None:
    """:func:`soak` with the worlds shared out among processes, each on a GPU of its own where the
    engine needs one.

    Every process has its own seed, from ``seed`` on. ``keep`` gets a folder of each; ``on_step`` is
    called with the mean of their steps. ``shares``, numbered from 0: only these are played now, the
    others in other calls with the same ``keep``, where ``soak.json`` says what each came to. Until
    all are there the result is None.

    Raises:
        ValueError: as :func:`soak`; fewer worlds than processes, no process, a folder that keeps
            the shares of another number of them, or shares that there are not or that nothing
            keeps.
        CheckpointError: as :func:`soak`.
        RuntimeError: as :func:`soak`; fewer GPUs than processes at the same time.
    """
    if shares and keep is None:
        raise ValueError("shares that are played apart must be kept: give a folder")
    if shares and not set(shares) <= set(range(processes)):
        raise ValueError(f"shares of {processes} processes are 0 to {processes - 1}, not {shares}")
    if processes == 1:
        return soak(
            task,
            engine,
            worlds=worlds,
            steps=steps,
            seed=seed,
            on_step=on_step,
            keep=keep,
            minutes=minutes,
        )
    if not 1 <= processes <= worlds:
        raise ValueError(f"{worlds} worlds cannot be shared out among {processes} processes")
    played = sorted(set(shares)) or list(range(processes))
    gpus = torch.cuda.device_count() if engine == "warp" else 0
    if 0 < gpus < len(played):
        raise RuntimeError(f"{len(played)} processes need a GPU each; here are {gpus}")
    names = [f"share_{i}_of_{processes}" for i in range(processes)]
    folders = [] if keep is None else [keep / name for name in names]
    for folder in () if keep is None else keep.glob("share_*"):
        if folder not in folders:
            there = folder.name.rpartition("_")[2]
            raise ValueError(f"'{keep}' keeps the shares of {there} processes, not of {processes}")
    about = {"task": task, "engine": engine, "worlds": worlds, "seed": seed}
    found = {i: _kept_share(each, about) for i, each in enumerate(folders) if i not in played}
    context = multiprocessing.get_context("spawn")
    taken = context.Array("q", processes)
    with ProcessPoolExecutor(
        len(played), mp_context=context, initializer=_count_in, initargs=(taken,)
    ) as pool:
        futures = {
            i: pool.submit(
                _soak_share,
                i,
                gpu if gpus else None,
                task,
                engine,
                worlds=worlds // processes + (i < worlds % processes),
                steps=steps,
                seed=seed + i,
                physics_options=threads_of_each(engine, len(played)),
                keep=folders[i] if folders else None,
                minutes=minutes,
            )
            for gpu, i in enumerate(played)
        }
        while wait(futures.values(), timeout=LOOK_SECONDS).not_done:
            if on_step is not None:
                on_step(sum(taken[:]) // len(played))
    for i, future in futures.items():
        found[i] = share = future.result()
        if shares:
            write_json(folders[i] / _SHARE, {"of": about, "soak": asdict(share)})
    there = [each for i in range(processes) if (each := found[i]) is not None]
    return together(there) if len(there) == processes else None


_SHARE = "soak.json"
"""In the folder of a share that was played apart: what it came to."""


def _kept_share(folder: Path, about: dict[str, Any]) -> Soak | None:
    """A share that another call has played; None where none has."""
    path = folder / _SHARE
    if not path.is_file():
        return None
    kept = json.loads(path.read_text())
    if kept["of"] != about:
        raise ValueError(f"'{folder}' keeps another endurance run: give another folder")
    return Soak(**kept["soak"])


_taken: Any = None
"""In a process of ``soak_shared``: how many steps each of them has taken."""


def _count_in(taken: Any) -> None:
    global _taken
    _taken = taken


def _soak_share(i: int, gpu: int | None, task: str, engine: str, **options: Any) -> Soak:
    """In a process of its own: share ``i`` of the worlds, on its GPU."""
    torch.set_num_threads(1)
    if gpu is not None:
        torch.cuda.set_device(gpu)

    def count(step: int) -> None:
        _taken[i] = step

    return soak(task, engine, on_step=count, **options)


def together(shares: Sequence[Soak]) -> Soak:
    """What several runs of one task and engine, at the same time, come to: counts and memory
    add up, of the steps the fewest count."""
    memory = [each.device_memory_gib for each in shares if each.device_memory_gib is not None]
    return replace(
        shares[0],
        worlds=sum(each.worlds for each in shares),
        steps=min(each.steps for each in shares),
        episodes=sum(each.episodes for each in shares),
        bad_observations=sum(each.bad_observations for each in shares),
        bad_rewards=sum(each.bad_rewards for each in shares),
        largest_observation=max(each.largest_observation for each in shares),
        largest_reward=max(each.largest_reward for each in shares),
        nan_worlds=sum(each.nan_worlds for each in shares),
        overflow=sum(each.overflow for each in shares),
        overflows=dict(sum((Counter(each.overflows) for each in shares), Counter())),
        steps_per_second=sum(each.steps_per_second for each in shares),
        device_memory_gib=(sum(early for early, _ in memory), sum(late for _, late in memory))
        if memory
        else None,
        host_memory_gib=sum(each.host_memory_gib for each in shares),
        processes=len(shares),
    )


def _begin(keep: Path | None, about: dict[str, Any], env: Env) -> Tally:
    """The tally of the worlds that a folder keeps, which the environment takes back."""
    saved = [] if keep is None else checkpoints(keep)
    if not saved:
        return Tally()
    state, tensors = load_checkpoint(saved[-1])
    told = dict(state.get("soak", {}))
    if {name: told.pop(name, None) for name in about} != about:
        raise ValueError(f"'{keep}' keeps another endurance run: give another folder")
    env.load_state_dict(tensors)
    return Tally(**told)


def _play(
    env: Env,
    actions: Tensor,
    tally: Tally,
    steps: int,
    seconds: float,
    on_step: Callable[[int], None] | None,
) -> None:
    """Plays until ``steps``, or for so many seconds, and adds to the tally."""
    # Of numbers: not finite in features and rewards; of worlds: ended.
    counts = torch.zeros(3, dtype=torch.long, device=env.device)
    largest = torch.zeros(2, device=env.device)
    mark, began = max(1, steps // 100), time.perf_counter()
    nan_worlds, overflow = int(env.physics.nan_worlds), int(env.physics.overflow)
    overflows = Counter(env.physics.overflows())
    while tally.step < steps:
        result = env.step(actions[tally.step % len(actions)])
        # The environment removes NaN from its observations; here they are looked for.
        features = torch.cat(tuple(env.task.features(env.view, env.memory).values()), -1)
        counts += torch.stack(
            (
                (~features.isfinite()).sum(),
                (~result.reward.isfinite()).sum(),
                (result.ended | ~result.valid).sum(),
            )
        )
        sizes = torch.stack((result.obs.abs().amax(), result.reward.abs().amax()))
        largest = torch.maximum(largest, sizes)
        tally.step += 1
        if tally.step == mark:
            tally.early_gib = _device_gib(env)
        if tally.step % mark == 0:
            if on_step is not None:
                on_step(tally.step)
            largest.tolist()  # waits for the device: steps that are only queued take no time
            if time.perf_counter() - began >= seconds:
                break
    bad_observations, bad_rewards, episodes = counts.tolist()
    tally.bad_observations += bad_observations
    tally.bad_rewards += bad_rewards
    tally.episodes += episodes
    sizes = largest.tolist()
    tally.largest_observation = max(tally.largest_observation, sizes[0])
    tally.largest_reward = max(tally.largest_reward, sizes[1])
    tally.nan_worlds += int(env.physics.nan_worlds) - nan_worlds
    tally.overflow += int(env.physics.overflow) - overflow
    more = Counter(env.physics.overflows()) - overflows
    tally.overflows = dict(Counter(tally.overflows) + more)
    tally.seconds += time.perf_counter() - began


def _device_gib(env: Env) -> float | None:
    if env.device.type != "cuda":
        return None
    free, total = torch.cuda.mem_get_info(env.device)
    return (total - free) / 2**30
