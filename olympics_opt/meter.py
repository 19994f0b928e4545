"""How fast one task runs on one engine: bare physics, the environment around it, training.

Absolute figures say little on a machine that others use too, so the three are measured in turn,
again and again, on the same worlds, and compared within each turn:

* bare physics: the engine's own stepping of the same model, nothing read, no momentum kept, nothing
  reset (``mujoco``: a ``Batch`` of its own with as many native threads as the environment has, and
  ``step(nstep=substeps)``; ``warp``: a CUDA graph of the substeps alone);
* environment: physics, observations, rewards, terminations and resets, with random actions;
* training: whole PPO iterations, rollout and update.

Actions are what a fresh policy samples: normal, sigma 0.12. Nothing resets bare physics, and worlds
that have fallen are slower, so it goes along the states that the environment went through: put
there before every control step on a CPU, so that both take the same steps; before every eighth on a
GPU, where stopping the clock costs time. Each goes through all of them in a row: taking turns step
by step would empty the processor's caches before every step, as no loop of either does.
"""

from __future__ import annotations

import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rl.ppo import PPO, PPOConfig
from rl.rollout import collect
from sports.env import Env, make_env

STEPS = 24
"""Control steps of one measurement: a rollout of the trainer."""
RELOAD = {"cpu": 1, "cuda": 8}
"""Bare physics is put into the environment's states after so many control steps."""
WARM_UPS, WARM_UP = 4, 60.0
"""Turns on a GPU that are not counted, and the time (s) after which no further one begins: athletes
with fingers that play two by two take minutes for each."""
SIGMA = PPOConfig().sigma


@dataclass(frozen=True)
class Row:
    """Figures of one task on one engine; rates are medians over the turns, per second."""

    task: str
    engine: str
    device: str
    worlds: int
    timestep: float
    substeps: int
    turns: int
    bare_physics: float
    """Control steps, all worlds together."""
    environment: float
    """Control steps."""
    training: float | None
    """Samples (control steps of an agent, learned from)."""
    environment_share: float
    """Environment over bare physics: median of the turns' ratios."""
    training_share: float | None
    spread: dict[str, list[float]]
    """Least and greatest rate over the turns by quantity."""
    setup_s: float
    """Building the worlds, compiling, first calls."""
    host_memory_gib: float
    """Greatest resident memory of this process so far."""
    device_memory_gib: float | None
    """Memory of the GPU in use while measuring, others' included."""
    nan_worlds: int
    overflow: int


class Meter:
    """Measures one task on one engine, a turn at a time."""

    def __init__(
        self,
        env: Env,
        *,
        seed: int = 0,
        training: bool = True,
        steps: int = STEPS,
        hyper: PPOConfig | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """``steps``: control steps of one measurement; ``clock`` gives seconds, tests pass their
        own."""
        self.env, self.steps, self._clock = env, steps, clock
        generator = torch.Generator(env.device).manual_seed(seed)
        shape = (16, env.num_worlds, env.num_agents, env.action_size)
        noise = torch.randn(shape, generator=generator, device=env.device)
        self._actions = SIGMA * noise
        self._controls = env.targets(self._actions).flatten(2)
        self._bare = _bare(env)
        self.agent: PPO | None = None
        self._obs = env.reset()
        if training:
            cuda = torch.cuda.is_available()
            config = hyper or PPOConfig(steps=steps)
            device = env.device if env.device.type == "cuda" or not cuda else torch.device("cuda")
            self.agent = PPO(env.obs_size, env.action_size, config, device, seed)
            self._rollout = self.agent.new_rollout(env.num_worlds * env.num_agents)

    def pair(self) -> dict[str, float]:
        """Control steps per second of the ``environment`` under random actions, and of
        ``bare_physics`` along its states."""
        env, every = self.env, RELOAD[self.env.device.type]
        picks = [i % len(self._actions) for i in range(self.steps)]
        blocks = [picks[start : start + every] for start in range(0, self.steps, every)]
        bare = environment = 0.0
        trail = []
        with _torch_threads(env):
            for block in blocks:
                trail.append(self._bare.save())
                with self._timed() as elapsed:
                    for i in block:
                        self._obs = env.step(self._actions[i]).obs
                environment += elapsed[0]
            end = self._bare.save()
            for block, state in zip(blocks, trail):
                self._bare.load(state)
                with self._timed() as elapsed:
                    for i in block:
                        self._bare.step(self._controls[i])
                bare += elapsed[0]
            self._bare.load(end)
        count = env.num_worlds * self.steps
        return {"bare_physics": count / bare, "environment": count / environment}

    def training(self) -> dict[str, float]:
        """Samples per second of one PPO iteration: rollout, advantages, update."""
        env, agent = self.env, self.agent
        if agent is None:
            raise ValueError("this meter was made without training")
        with self._timed() as elapsed:
            with _torch_threads(env):
                self._obs = collect(env, agent, self._rollout, self._obs, agent.config.gamma)
            statistic = agent.update(self._rollout)
            torch.stack([v.detach().float() for v in statistic.values()]).tolist()
        samples = env.num_worlds * env.num_agents * agent.config.steps
        return {"training": samples / elapsed[0]}

    @contextmanager
    def _timed(self) -> Iterator[list[float]]:
        """Seconds of the block, with the device's work done before and after."""
        elapsed = [0.0]
        self._wait()
        began = self._clock()
        yield elapsed
        self._wait()
        elapsed[0] = self._clock() - began

    def _wait(self) -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()


@contextmanager
def _torch_threads(env: Env) -> Iterator[None]:
    """One torch thread while an engine on the CPU uses the cores, as the trainer does."""
    threads = torch.get_num_threads()
    if env.device.type == "cpu":
        torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class _Borrowed:
    """Bare physics on the environment's own engine, to be given its state back afterwards."""

    def __init__(self, env: Env, step: Callable[[Tensor], None]) -> None:
        """``step``: a control step of the engine alone, from targets (N, nu)."""
        self.step, self.save, self.load = step, env.state_dict, env.load_state_dict


class _BareMujoco:
    """A plain batch of the environment's model."""

    def __init__(self, physics: Any) -> None:
        from mujoco.batch import Batch

        self._physics = physics
        self.batch = Batch(physics.model, nsim=physics.num_worlds, nthread=physics.threads)

    def save(self) -> dict[str, Tensor]:
        """The environment's present states, solver warm starts and movable fixtures."""
        physics = self._physics
        return physics.extra_state() | {"mocap_pos": physics.mocap_pos.clone()}

    def load(self, state: dict[str, Tensor]) -> None:
        """Makes them those of the batch."""
        for name in ("qpos", "qvel", "qacc_warmstart"):
            self.batch.bind(name)[:] = state[name].numpy()
        for k, o in enumerate(self._physics.scene.mocap_objects):
            row = self._physics.model.body(o.name).mocapid[0]
            self.batch.bind("mocap_pos")[:, row] = state["mocap_pos"][:, k].numpy()

    def step(self, targets: Tensor) -> None:
        self.batch.bind("ctrl")[:] = targets.numpy()
        self.batch.step(nstep=self._physics.scene.substeps)


def _bare(env: Env) -> _Borrowed | _BareMujoco:
    physics: Any = env.physics
    if physics.engine == "mujoco":
        return _BareMujoco(physics)
    if physics.engine == "warp":
        return _Borrowed(env, _bare_warp(physics, physics.scene.substeps))
    return _Borrowed(env, physics.step)


def _bare_warp(physics: Any, substeps: int) -> Callable[[Tensor], None]:
    import mujoco_warp as mjw
    import warp as wp

    targets_view = wp.to_torch(physics.d.ctrl)
    device = wp.device_from_torch(physics.device)

    def substep_all() -> None:
        for _ in range(substeps):
            mjw.step(physics.m, physics.d)

    graph = None
    with wp.ScopedDevice(device):
        substep_all()
        if physics.device.type == "cuda":
            with wp.ScopedCapture() as capture:
                substep_all()
            graph = capture.graph

    def step(targets: Tensor) -> None:
        targets_view.copy_(targets)
        with wp.ScopedDevice(device):
            if graph is None:
                substep_all()
            else:
                stream = wp.stream_from_torch(torch.cuda.current_stream(physics.device))
                wp.capture_launch(graph, stream=stream)

    return step


def measure(
    task: str,
    engine: str,
    *,
    worlds: int,
    seconds: float = 30.0,
    training: bool = True,
    seed: int = 0,
    steps: int = STEPS,
    on_turn: Callable[[int, float], None] | None = None,
) -> Row:
    """Figures of one task on one engine.

    Args:
        task: name of a task.
        engine: ``mujoco``, ``warp`` or ``drake``.
        worlds: number of worlds.
        seconds: time of measurement; at least three turns are taken.
        training: measure training too (never on drake).
        seed: of actions, starts and networks.
        steps: control steps of a turn.
        on_turn: called after each turn with their number and the share of the time used.

    Raises:
        ValueError: unknown task or engine, or steps that are not positive.
        RuntimeError: the engine cannot run here.
    """
    if steps < 1:
        raise ValueError(f"a turn takes one control step or more, not {steps}")
    began = time.perf_counter()
    env = make_env(task, engine=engine, num_worlds=worlds, seed=seed)
    try:
        meter = Meter(env, seed=seed, training=training and engine != "drake", steps=steps)
        # First calls compile, allocate and capture.
        parts = [meter.pair]
        if meter.agent is not None:
            parts.append(meter.training)
        cuda = env.device.type == "cuda"
        for warm_up in range(WARM_UPS if cuda else 1):
            if warm_up and time.perf_counter() - began > WARM_UP:
                break
            for part in parts:
                part()
        setup = time.perf_counter() - began
        began, turns, learning = time.perf_counter(), [], 0.0
        while len(turns) < 3 or time.perf_counter() - began < seconds:
            turn: dict[str, float] = {}
            spent = time.perf_counter() - began
            for k in range(len(parts)):  # a different one leads each turn
                part = parts[(len(turns) + k) % len(parts)]
                if part == meter.training:
                    # On a CPU an update takes long: at most half of the time goes there.
                    if not cuda and turns and learning > spent / 2:
                        continue
                    learning -= time.perf_counter()
                turn |= part()
                if part == meter.training:
                    learning += time.perf_counter()
            turns.append(turn)
            if on_turn is not None:
                on_turn(len(turns), (time.perf_counter() - began) / seconds)
        device_memory = None
        if torch.cuda.is_available():
            free, total = torch.cuda.mem_get_info()
            device_memory = (total - free) / 2**30
        return Row(
            task=task,
            engine=engine,
            device=device_name(env.device),
            worlds=env.num_worlds,
            timestep=env.physics.scene.timestep,
            substeps=env.physics.scene.substeps,
            turns=len(turns),
            **summary(turns),
            setup_s=setup,
            host_memory_gib=resident_gib(),
            device_memory_gib=device_memory,
            nan_worlds=int(env.physics.nan_worlds),
            overflow=int(env.physics.overflow),
        )
    finally:
        env.close()


def summary(turns: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Medians, ratios within the turns, and extremes of rates measured turn by turn.

    Every turn has ``bare_physics`` and ``environment``; some have ``training``.
    """
    values = {
        name: [turn[name] for turn in turns if name in turn]
        for name in ("bare_physics", "environment", "training")
    }
    shares = {
        name: [turn[name] / turn["bare_physics"] for turn in turns if name in turn]
        for name in ("environment", "training")
    }

    def median(rates: list[float]) -> float | None:
        return statistics.median(rates) if rates else None

    return {
        **{name: median(rates) for name, rates in values.items()},
        **{f"{name}_share": median(rates) for name, rates in shares.items()},
        "spread": {name: [min(rates), max(rates)] for name, rates in values.items() if rates},
    }


def device_name(device: torch.device) -> str:
    """What the machine calls it."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"


def resident_gib() -> float:
    """Greatest resident memory of this process so far (GiB)."""
    scale = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale / 2**30
