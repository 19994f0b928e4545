"""How fast is it: bare physics, the environment around it, and training, in one run.

Absolute figures say little on a machine that others use too, so the three are measured in turn,
again and again, on the same worlds, and compared within each turn:

* bare physics: the engine's own stepping of the same model, nothing read, nothing reset
  (``mujoco``: ``Batch.step(nstep=substeps)``; ``warp``: a CUDA graph of the substeps alone);
* environment: physics, observations, rewards, terminations and resets, with random actions;
* training: whole PPO iterations, rollout and update.

Actions are what a fresh policy samples: normal, sigma 0.12. Bare physics starts every few steps
from the environment's states, so that both meet the same mixture of running and falling.
"""

from __future__ import annotations

import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from torch import Tensor

from rl import provenance
from rl.ppo import PPO, PPOConfig
from rl.rollout import collect
from sports.env import Env, make_env
from sports.registry import get_task, task_names
from warmstart.atomic import write_json

Engine = Literal["mujoco", "warp", "drake"]
WORLDS = {"mujoco": 256, "warp": 8192, "drake": 4}
STEPS = 24
"""Control steps of one measurement: a rollout of the trainer."""
RELOAD = 8
"""Bare physics takes over the environment's states after so many control steps."""
SIGMA = PPOConfig().sigma
ENVIRONMENT_SHARE, TRAINING_SHARE = 0.85, 0.75
"""What the environment and training should keep of the speed of bare physics; training is
judged on a GPU only, where the learner does not share the engine's processors."""


@dataclass(frozen=True)
class BenchConfig:
    """Measure bare physics, environment and training speed of each task on each engine."""

    out: Path = Path("runs/bench.json")
    """JSON file for the figures."""
    engine: tuple[Engine, ...] = ()
    """Engines; by default mujoco, and warp where there is a GPU."""
    task: tuple[str, ...] = ()
    """Tasks; by default all."""
    worlds: int | None = None
    """Worlds; by default 256 on mujoco, 8192 on warp, 4 on drake."""
    seconds: float = 30.0
    """Time of measurement for each task on each engine; at least three turns are taken."""
    training: bool = True
    """Measure training too."""
    seed: int = 0
    """Seed of actions, starts and networks."""


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
        """``clock`` gives seconds; tests pass their own."""
        self.env, self.steps, self._clock = env, steps, clock
        generator = torch.Generator(env.device).manual_seed(seed)
        shape = (16, env.num_worlds, env.num_agents, env.action_size)
        noise = torch.randn(shape, generator=generator, device=env.device)
        self._actions = SIGMA * noise
        self._controls = (self._actions.clamp(-1, 1) * env.action_scale).flatten(2)
        self._bare = _bare_stepper(env)
        self.agent: PPO | None = None
        self._obs = env.reset()
        if training:
            cuda = torch.cuda.is_available()
            config = hyper or PPOConfig(steps=steps)
            device = env.device if env.device.type == "cuda" or not cuda else torch.device("cuda")
            self.agent = PPO(env.obs_size, env.action_size, config, device, seed)
            self._rollout = self.agent.new_rollout(env.num_worlds * env.num_agents)

    def bare_physics(self) -> float:
        """Control steps per second of the engine alone; the environment is left as it was."""
        env, spent = self.env, 0.0
        for start in range(0, self.steps, RELOAD):
            state = env.state_dict()
            with self._timed() as elapsed:
                for i in range(start, min(start + RELOAD, self.steps)):
                    self._bare(self._controls[i % len(self._controls)])
            spent += elapsed[0]
            self._obs = env.load_state_dict(state)
        return env.num_worlds * self.steps / spent

    def environment(self) -> float:
        """Control steps per second of the environment under random actions."""
        env = self.env
        with _torch_threads(env), self._timed() as elapsed:
            for i in range(self.steps):
                self._obs = env.step(self._actions[i % len(self._actions)]).obs
        return env.num_worlds * self.steps / elapsed[0]

    def training(self) -> float:
        """Samples per second of one PPO iteration: rollout, advantages, update."""
        env, agent = self.env, self.agent
        if agent is None:
            raise ValueError("this meter was made without training")
        with self._timed() as elapsed:
            with _torch_threads(env):
                self._obs = collect(env, agent, self._rollout, self._obs, agent.config.gamma)
            statistic = agent.update(self._rollout)
            torch.stack([v.detach().float() for v in statistic.values()]).tolist()
        return env.num_worlds * env.num_agents * agent.config.steps / elapsed[0]

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


def _bare_stepper(env: Env) -> Callable[[Tensor], None]:
    """A control step of the engine alone, from PD targets (N, nu)."""
    physics: Any = env.physics
    substeps = physics.scene.substeps
    if physics.engine == "mujoco":
        control = physics.batch.bind("ctrl")

        def step(targets: Tensor) -> None:
            control[:] = targets.numpy()
            physics.batch.step(nstep=substeps)

        return step
    if physics.engine == "warp":
        return _bare_warp(physics, substeps)
    return physics.step


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
    worlds: int | None = None,
    seconds: float = 30.0,
    training: bool = True,
    seed: int = 0,
    on_turn: Callable[[int, float], None] | None = None,
) -> Row:
    """Figures of one task on one engine.

    Args:
        task: name of a task.
        engine: ``mujoco``, ``warp`` or ``drake``.
        worlds: number of worlds; None for the engine's usual.
        seconds: time of measurement; at least three turns are taken.
        training: measure training too (never on drake).
        seed: of actions, starts and networks.
        on_turn: called after each turn with their number and the share of the time used.

    Raises:
        ValueError: unknown task or engine. RuntimeError: the engine cannot run here.
    """
    began = time.perf_counter()
    env = make_env(task, engine=engine, num_worlds=worlds or WORLDS.get(engine, 1), seed=seed)
    try:
        meter = Meter(env, seed=seed, training=training and engine != "drake")
        # First calls compile, allocate and capture.
        parts = [meter.bare_physics, meter.environment]
        if meter.agent is not None:
            parts.append(meter.training)
        cuda = env.device.type == "cuda"
        for _ in range(4 if cuda else 1):
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
                turn[part.__name__] = part()
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
            device=_device_name(env.device),
            worlds=env.num_worlds,
            timestep=env.physics.scene.timestep,
            substeps=env.physics.scene.substeps,
            turns=len(turns),
            **summary(turns),
            setup_s=setup,
            host_memory_gib=_resident_gib(),
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


def bench(
    out: str | Path,
    *,
    engines: Sequence[str] = (),
    tasks: Sequence[str] = (),
    worlds: int | None = None,
    seconds: float = 30.0,
    training: bool = True,
    seed: int = 0,
    quiet: bool = False,
) -> dict[str, Any]:
    """Measures every task on every engine, prints a table and writes the figures as JSON.

    The file is rewritten after each row, so that a stopped run keeps what it has.

    Args:
        out: JSON file.
        engines: by default ``mujoco``, and ``warp`` where there is a GPU.
        tasks: by default all.
        worlds: by default the engine's usual number.
        seconds: time of measurement for each row.
        training: measure training too.
        seed: of actions, starts and networks.
        quiet: print nothing.

    Returns:
        What the file holds: commit, versions, hardware and ``rows``.

    Raises:
        ValueError: unknown task or engine, or a time that is not positive.
        RuntimeError: an engine cannot run here.
    """
    from rich.console import Console
    from rich.progress import Progress

    if not seconds > 0:
        raise ValueError(f"seconds must be positive, not {seconds}")
    engines = tuple(engines) or (("mujoco", "warp") if torch.cuda.is_available() else ("mujoco",))
    tasks = tuple(tasks) or task_names()
    for name in tasks:
        get_task(name)
    console = Console(quiet=quiet)
    result: dict[str, Any] = {
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
        "system": platform.platform(),
        "seed": seed,
        "seconds": seconds,
        "sigma": SIGMA,
        "steps_per_turn": STEPS,
        "rows": [],
    }
    rows: list[Row] = []
    with Progress(console=console, transient=True, disable=quiet) as progress:
        for engine in engines:
            for task in tasks:
                bar = progress.add_task(f"{task} on {engine}", total=1.0)

                def show(turns: int, share: float, bar: Any = bar) -> None:
                    progress.update(bar, completed=min(share, 1.0))

                rows.append(
                    measure(
                        task,
                        engine,
                        worlds=worlds,
                        seconds=seconds,
                        training=training,
                        seed=seed,
                        on_turn=show,
                    )
                )
                progress.remove_task(bar)
                result["rows"] = [asdict(row) for row in rows]
                write_json(out, result)
    console.print(_table(rows))
    console.print(f"{provenance.hardware()}; commit {provenance.commit()}; written to {out}")
    return result


def _table(rows: Sequence[Row]) -> Any:
    from rich.table import Table

    table = Table(
        title="Per second; shares of bare physics within the same turns",
        title_justify="left",
        box=None,
    )
    heads = ("task", "engine", "worlds", "physics", "env", "share", "train", "share")
    for name in (*heads, "GiB"):
        side = "left" if name in ("task", "engine") else "right"
        table.add_column(name, justify=side, no_wrap=True)

    def share(value: float | None, wanted: float | None) -> str:
        if value is None:
            return ""
        text = f"{100 * value:.0f} %"
        color = "" if wanted is None else "green" if value >= wanted else "red"
        return f"[{color}]{text}[/]" if color else text

    for r in rows:
        wanted = TRAINING_SHARE if r.engine == "warp" else None
        memory = f"{r.host_memory_gib:.1f}"
        if r.device_memory_gib is not None:
            memory += f"+{r.device_memory_gib:.1f}"
        table.add_row(
            r.task,
            r.engine,
            str(r.worlds),
            _rate(r.bare_physics),
            _rate(r.environment),
            share(r.environment_share, ENVIRONMENT_SHARE),
            _rate(r.training) if r.training else "-",
            share(r.training_share, wanted),
            memory,
        )
    return table


def _rate(value: float) -> str:
    return f"{value / 1000:.1f} k" if value >= 1000 else f"{value:.0f}"


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"


def _resident_gib() -> float:
    scale = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale / 2**30


def main(args: Sequence[str] | None = None) -> int:
    """The command ``olympics-opt bench``."""
    config = tyro.cli(
        Annotated[BenchConfig, tyro.conf.arg(name="")], args=args, prog="olympics-opt bench"
    )
    bench(
        config.out,
        engines=config.engine,
        tasks=config.task,
        worlds=config.worlds,
        seconds=config.seconds,
        training=config.training,
        seed=config.seed,
    )
    return 0
