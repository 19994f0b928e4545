"""Trains a policy: the loop around a learner, with checkpoints, schedules, logs and signals.

``python -m rl.train TASK --out RUN ...`` or ``torchrun --nproc-per-node G -m rl.train TASK ...``.
The same loop drives every engine; with several ranks each plays its own worlds.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import torch.distributed as dist
import tyro
from torch import Tensor

from rl import provenance
from rl.checkpoint import (
    CheckpointError,
    checkpoints,
    load_checkpoint,
    read_state,
    save_checkpoint,
)
from rl.imitation import Imitation
from rl.meter import EpisodeMeter
from rl.policy import FORMAT as POLICY_FORMAT
from rl.policy import load_policy
from rl.ppo import PAPER, PPO, STATISTICS, PPOConfig
from rl.rollout import collect
from rl.runlog import Row, RunLog
from sports.env import Env, Starts, make_env
from sports.physics.variation import Variation
from warmstart.atomic import write_text

DEFAULT_WORLDS = {"mujoco": 256, "warp": 8192, "drake": 4}
DEFAULT_SAMPLES = 100_000_000


@dataclass(frozen=True)
class TrainConfig:
    """What to train, on what, for how long."""

    task: tyro.conf.Suppress[str] = ""
    """Name of the task."""
    out: Path = Path("runs/train")
    """Folder of the run."""
    algo: Literal["ppo"] = "ppo"
    """Learner."""
    engine: Literal["mujoco", "warp", "drake"] = "mujoco"
    """Physics engine: mujoco needs no GPU, warp needs one, drake is for checking, not training."""
    worlds: int | None = None
    """Worlds per process; None for 256 on mujoco and 8192 on warp."""
    samples: int | None = None
    """Stop after this many samples; None for 100 M where no minutes are given."""
    minutes: float | None = None
    """Stop after this many minutes of training, earlier sessions of the run counted in."""
    seed: int = 0
    """Seed of weights, noise and environment."""
    resume: bool = False
    """Go on from the run's last checkpoint, with the run's own settings; a folder without one
    begins afresh."""
    strength: Literal["paper", "human"] = "paper"
    """Torque limits of the athlete."""
    limits: Literal["paper", "anatomical"] = "paper"
    """Joint limits of the athlete."""
    options: tyro.conf.Suppress[dict[str, Any]] = field(default_factory=dict)
    """The task's own options by name; on the command line ``--task.NAME``."""
    physics_options: tyro.conf.Suppress[dict[str, Any]] = field(default_factory=dict)
    """Options of the engine."""
    timestep_divisor: int = 1
    """2 halves the physics time step at the same control rate."""
    vary: bool = False
    """Let the worlds differ in friction, gains and contact softness and, with
    ``timestep_divisor`` 2, half of them run at the full time step: a policy that must hold in
    every engine needs it."""
    init: str | None = None
    """Start from this policy: a run, a policy file, or pretrained[:ALGO[-STRENGTH]]."""
    clips: tuple[Path, ...] = ()
    """Demonstrations (npz) from whose frames episodes may start."""
    start_probability: tuple[float, float] = (0.5, 0.1)
    """Share of episodes that start from a demonstration, at the beginning and end of the run."""
    imitation: float = 0.0
    """Reward per step for moving exactly like the demonstrations; fades to 0 over
    ``imitation_share`` of the run."""
    imitation_share: float = 0.5
    """Part of the run in which the imitation reward lasts."""
    imitation_sharpness: float = 10.0
    """The imitation reward falls with exp(-this x squared joint difference in rad^2)."""
    paper: bool = False
    """Use the hyper-parameters of the SMPLOlympics paper instead of ``ppo``."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Hyper-parameters."""
    device: str = "auto"
    """Where the networks live: auto (a GPU if there is one), cpu, cuda."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of the matrix products: auto is bfloat16 on a GPU and float32 on a CPU, where bfloat16 is
    about twice as fast if the processor has instructions for it, and slower if not."""
    checkpoint_minutes: float = 2.0
    """A checkpoint at least this often."""
    checkpoint_iterations: int | None = None
    """And after every so many iterations."""
    cuda_graph: bool = True
    """Replay the update as a CUDA graph where that is possible."""
    quiet: bool = False
    """Print nothing."""

    def __post_init__(self) -> None:
        for name in ("worlds", "samples", "minutes", "checkpoint_iterations"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ValueError(f"{name} must be positive, not {value}")
        if not all(0.0 <= p <= 1.0 for p in self.start_probability):
            raise ValueError(f"start_probability must lie in [0, 1], not {self.start_probability}")
        if self.paper and self.ppo != PPOConfig():
            raise ValueError("--paper fixes the hyper-parameters: leave the --ppo options out")

    @property
    def hyper(self) -> PPOConfig:
        """The hyper-parameters in force."""
        return PAPER if self.paper else self.ppo

    @property
    def num_worlds(self) -> int:
        """Worlds per process."""
        return self.worlds or DEFAULT_WORLDS[self.engine]


# What a resumed run may change; everything else is the run's own.
_FREE = {"out", "resume", "samples", "minutes", "quiet", "checkpoint_minutes"}
_FREE |= {"checkpoint_iterations", "device", "cuda_graph", "physics_options"}


@dataclass(frozen=True)
class RunSummary:
    """What a call of ``train`` did."""

    out: Path
    iterations: int
    samples: int
    minutes: float
    stopped_by: str
    """``samples``, ``minutes`` or ``signal``."""
    metrics: dict[str, float]
    """Episode metrics of the last iteration in which an episode ended."""
    checkpoint: Path


MakeEnv = Callable[[TrainConfig, int], Any]
"""(config, seed) -> environment."""


def default_env(config: TrainConfig, seed: int) -> Env:
    """The config's task on its engine, in training mode."""
    physics_options = dict(config.physics_options)
    if config.vary:
        physics_options |= {"variation": Variation(), "variation_seed": seed}
    return make_env(
        config.task,
        engine=config.engine,
        num_worlds=config.num_worlds,
        seed=seed,
        strength=config.strength,
        limits=config.limits,
        training=True,
        options=config.options,
        physics_options=physics_options,
        timestep_divisor=config.timestep_divisor,
    )


def train(
    config: TrainConfig,
    *,
    starts: Starts | None = None,
    environment: MakeEnv = default_env,
    on_iteration: Callable[[Row], None] | None = None,
) -> RunSummary:
    """Trains until ``samples``, ``minutes`` or a signal, whichever is first.

    Args:
        config: see TrainConfig.
        starts: demonstration frames; else those of ``config.clips``.
        environment: makes the environment, for tests and for tasks outside the registry.
        on_iteration: called with each progress row (rank 0).

    SIGTERM and SIGINT save a checkpoint and return, at the end of the iteration.
    Raises ValueError for settings that cannot be, PolicyError for ``init``, CheckpointError when
    a checkpoint cannot be written or read, RuntimeError for an engine that cannot run here.
    """
    began_group = _join_ranks()
    try:
        config = _settle(config)
        return _Trainer(config, starts, environment, on_iteration).run()
    finally:
        if began_group:
            dist.destroy_process_group()


class _Trainer:
    """One run in one process."""

    def __init__(
        self,
        config: TrainConfig,
        starts: Starts | None,
        environment: MakeEnv,
        on_iteration: Callable[[Row], None] | None,
    ) -> None:
        self.on_iteration = on_iteration
        ranked = dist.is_initialized()
        self.rank = dist.get_rank() if ranked else 0
        self.ranks = dist.get_world_size() if ranked else 1
        self.device = _device(config.device)
        self.resumed = config.resume and bool(checkpoints(config.out))
        fresh = config.init and not self.resumed
        policy = load_policy(str(config.init), config.task) if fresh else None
        if policy is not None and policy.actor is None:
            raise ValueError(f"--init {config.init} is a baseline: there is nothing to start from")
        if policy is not None and not config.paper:
            card = policy.metadata
            shape = {"hidden": tuple(card["hidden"]), "activation": card["activation"]}
            config = replace(config, ppo=replace(config.ppo, **shape))
        self.config, self.hyper = config, config.hyper
        self.env = environment(config, config.seed + 7919 * self.rank)
        if starts is None and config.clips:
            starts = load_starts(config.clips, config.start_probability[0])
        if starts is not None:
            self.env.starts = starts.to(self.env.device)
        self.imitation: Imitation | None = None
        if config.imitation > 0.0:
            if starts is None:
                raise ValueError("the imitation reward needs demonstrations: give --clips")
            self.imitation = Imitation(self.env, config.imitation, config.imitation_sharpness)
        rows = self.env.num_worlds * self.env.num_agents
        self.agent = PPO(
            self.env.obs_size,
            self.env.action_size,
            self.hyper,
            self.device,
            config.seed,
            config.cuda_graph,
            {"auto": None, "float32": False, "bfloat16": True}[config.precision],
        )
        self.rollout = self.agent.new_rollout(rows)
        self.meter = EpisodeMeter(self.env)
        self.samples_each = self.hyper.steps * rows * self.ranks
        self.iteration, self.samples, self.minutes = 0, 0, 0.0
        self.metrics: dict[str, float] = {}
        self.warmup = 0
        if self.resumed:
            self.obs = self._restore()
        else:
            self.obs = self.env.reset()
            if policy is not None and policy.actor is not None:  # never a baseline here
                policy.check(self.env)
                count = policy.metadata["obs_count"]
                self.agent.load_policy(policy.actor, policy.mean, policy.std, count)
                critic = self.agent.load_critic(policy.extra)
                self.warmup = 0 if critic else self.hyper.critic_warmup
        # Without any statistics the first rollout is for the observation normaliser only.
        self.first_learning = 0 if config.init else 1

    # -- the loop -------------------------------------------------------------------------------

    def run(self) -> RunSummary:
        """Iterates until a stop criterion holds."""
        config = self.config
        stop_samples = config.samples
        if stop_samples is None and config.minutes is None:
            stop_samples = DEFAULT_SAMPLES
        log = None
        if self.rank == 0:
            self._write_config()
            if self.resumed and not config.quiet:
                print(f"resuming {config.out} at iteration {self.iteration}", flush=True)
        began = time.monotonic() - 60.0 * self.minutes
        last_saved, saved, stopped_by = self.minutes, None, ""
        try:
            with _Signals() as signals:
                while not stopped_by:
                    if stop_samples is not None and self.samples >= stop_samples:
                        stopped_by = "samples"
                    elif config.minutes is not None and self.minutes >= config.minutes:
                        stopped_by = "minutes"
                    elif signals.heard(self):
                        stopped_by = "signal"
                    else:
                        done_before = self.iteration
                        row = self._iterate(began, stop_samples)
                        if self.rank == 0:
                            if log is None:
                                log = RunLog(config.out, list(row), done_before, config.quiet)
                            log.write(row, self._share(stop_samples))
                            if self.on_iteration is not None:
                                self.on_iteration(row)
                        every = config.checkpoint_iterations
                        due = self.minutes - last_saved >= config.checkpoint_minutes
                        saved = None
                        if due or (every is not None and self.iteration % every == 0):
                            saved, last_saved = self._save(), self.minutes
                saved = saved or self._save()
        except OSError as error:
            raise CheckpointError(
                f"the run could not write to {config.out} ({error.strerror or error}): free some "
                "space and go on with --resume"
            ) from error
        finally:
            if log is not None:
                log.close()
            self.env.close()
        return RunSummary(
            out=config.out,
            iterations=self.iteration,
            samples=self.samples,
            minutes=self.minutes,
            stopped_by=stopped_by,
            metrics=self.metrics,
            checkpoint=saved,
        )

    def _iterate(self, began: float, stop_samples: int | None) -> Row:
        """One rollout and its update. Waits for the device once, for the numbers of the row."""
        share = self._share(stop_samples)
        self._schedule(share)
        clock = _Stopwatch(self.device)
        clock.mark()
        # The engine's own threads step the worlds; torch's would only spin beside them.
        threads = torch.get_num_threads()
        if self.env.device.type == "cpu":
            torch.set_num_threads(1)
        self.obs = collect(
            self.env,
            self.agent,
            self.rollout,
            self.obs,
            self.hyper.gamma,
            on_step=self.meter,
            bonus=self.imitation,
        )
        torch.set_num_threads(threads)
        clock.mark()
        losses: dict[str, Tensor] = {}
        if self.iteration < self.first_learning:
            self.agent.obs_norm.commit()
        else:
            losses = self.agent.update(self.rollout)
        clock.mark()
        row: Row = {"iteration": self.iteration + 1}
        agent = self.agent
        numbers = {**losses, "learning_rate": agent.learning_rate, "sigma": agent.sigma}
        names = list(numbers)
        tail = torch.stack([x.double().to(self.device) for x in numbers.values()])
        episode = self.meter.totals().to(self.device)
        # Rank 0's clock decides for all: the others add 0 seconds.
        seconds = time.monotonic() - began if self.rank == 0 else 0.0
        head = torch.cat((episode, torch.tensor([seconds], dtype=torch.float64).to(self.device)))
        if self.ranks > 1:
            dist.all_reduce(head)
        values = torch.cat((head, tail)).tolist()  # the one wait of the iteration
        before = self.minutes
        # Seconds were read before the device had finished; the wait is over now.
        self.minutes = (time.monotonic() - began) / 60.0
        if self.ranks > 1:
            self.minutes = values[len(episode)] / 60.0
        self.iteration += 1
        self.samples += self.samples_each
        losses_now = dict(zip(names, values[len(episode) + 1 :]))
        if not all(math.isfinite(v) for v in losses_now.values()):
            raise RuntimeError(
                f"learning diverged at iteration {self.iteration} (a loss is not finite): go on "
                "from the last checkpoint with --resume, or start with a smaller learning rate"
            )
        summary = self.meter.summary(values[: len(episode)])
        metrics = {k[8:]: v for k, v in summary.items() if k.startswith("metrics/")}
        self.metrics |= {k: v for k, v in metrics.items() if v is not None and math.isfinite(v)}
        took = max(60.0 * (self.minutes - before), 1e-9)
        rollout_s, update_s = clock.laps()
        row |= {
            "samples": self.samples,
            "minutes": self.minutes,
            "samples_per_s": self.samples_each / took,
            "rollout_s": rollout_s,
            "update_s": update_s,
            **dict.fromkeys(STATISTICS),
            **losses_now,
            **summary,
        }
        physics = getattr(self.env, "physics", None)
        row["nan_worlds"] = int(getattr(physics, "nan_worlds", 0))
        row["overflow"] = int(getattr(physics, "overflow", 0))
        for name, level in self.env.curriculum.items():
            row[f"curriculum/{name}"] = float(level.float().mean())
        return row

    def _share(self, stop_samples: int | None) -> float:
        """Part of the run that is done, 0..1: the schedules' clock."""
        share = 0.0
        if stop_samples is not None:
            share = self.samples / stop_samples
        if self.config.minutes is not None:
            share = max(share, self.minutes / self.config.minutes)
        return min(share, 1.0)

    def _schedule(self, share: float) -> None:
        c, h = self.config, self.hyper
        if h.sigma_final is not None:
            self.agent.sigma.fill_(h.sigma * (h.sigma_final / h.sigma) ** share)
        self.agent.actor_weight.fill_(0.0 if self.iteration < self.warmup else 1.0)
        if self.env.starts is not None:
            first, last = c.start_probability
            self.env.starts.probability = first + (last - first) * share
        if self.imitation is not None:
            left = max(0.0, 1.0 - share / c.imitation_share)
            self.imitation.weight.fill_(c.imitation * left)

    # -- files ----------------------------------------------------------------------------------

    def _write_config(self) -> None:
        c = self.config
        c.out.mkdir(parents=True, exist_ok=True)
        data = {
            "config": dataclasses.asdict(replace(c, ppo=self.hyper, paper=False)),
            "paper": c.paper,
            "ranks": self.ranks,
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "hardware": provenance.hardware(),
        }
        text = json.dumps(data, indent=1, default=str)
        write_text(c.out / "config.json", text)

    def card(self) -> dict[str, Any]:
        """What the policy file says about itself; see rl.policy."""
        c, norm = self.config, self.agent.obs_norm
        task = getattr(self.env, "task", None)
        return {
            "format": POLICY_FORMAT,
            "task": c.task,
            "algo": c.algo,
            "body": getattr(task, "body", "none"),
            "strength": c.strength,
            "limits": c.limits,
            "obs_size": self.env.obs_size,
            "action_size": self.env.action_size,
            "obs_layout": {k: [s.start, s.stop] for k, s in self.env.obs_slices.items()},
            "hidden": list(self.hyper.hidden),
            "activation": self.hyper.activation,
            "observation_clip": self.hyper.observation_clip,
            "obs_mean": norm.mean.tolist(),
            "obs_std": norm.std.tolist(),
            "obs_count": float(norm.count),
            "config": json.loads(json.dumps(dataclasses.asdict(c), default=str)),
            "samples": self.samples,
            "minutes": self.minutes,
            "hardware": provenance.hardware(),
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "metrics": dict(self.metrics),
        }

    def _save(self) -> Path:
        state = {
            "samples": self.samples,
            "minutes": self.minutes,
            "ranks": self.ranks,
            "warmup": self.warmup,
            "card": self.card(),
        }
        tensors = {f"agent/{k}": v for k, v in self.agent.state_dict().items()}
        tensors |= {f"env/{k}": v for k, v in self.env.state_dict().items()}
        tensors |= {f"meter/{k}": v for k, v in self.meter.state_dict().items()}
        tensors["obs"] = self.obs
        barrier = dist.barrier if self.ranks > 1 else None
        return save_checkpoint(self.config.out, self.iteration, state, tensors, self.rank, barrier)

    def _restore(self) -> Tensor:
        """Takes the last checkpoint back; returns the observation to go on from."""
        path = checkpoints(self.config.out)[-1]
        state, tensors = load_checkpoint(path, self.rank)
        if state["ranks"] != self.ranks:
            raise ValueError(
                f"{path} was written by {state['ranks']} processes, this run has {self.ranks}: "
                "resume with as many"
            )

        def part(prefix: str) -> dict[str, Tensor]:
            return {k[len(prefix) :]: v for k, v in tensors.items() if k.startswith(prefix)}

        self.agent.load_state_dict(part("agent/"))
        self.env.load_state_dict(part("env/"))
        self.meter.load_state_dict(part("meter/"))
        self.iteration, self.samples = state["iteration"], state["samples"]
        self.minutes, self.warmup = state["minutes"], state["warmup"]
        self.metrics = state["card"]["metrics"]
        return tensors["obs"].to(self.env.device)


def load_starts(paths: tuple[Path, ...], probability: float) -> Starts:
    """Demonstration frames from clip files. Raises ValueError for a file that is not a clip."""
    from warmstart.bank import ClipBank
    from warmstart.clip import Clip

    return ClipBank([Clip.load(path) for path in paths]).starts(probability=probability)


class _Signals:
    """SIGTERM and SIGINT ask the loop to save and stop; a second SIGINT interrupts at once."""

    def __init__(self) -> None:
        self._asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> _Signals:
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

    def heard(self, trainer: _Trainer) -> bool:
        """Whether any rank was asked to stop."""
        if trainer.ranks == 1:
            return self._asked
        flag = torch.tensor([float(self._asked)], device=trainer.device)
        dist.all_reduce(flag, op=dist.ReduceOp.MAX)
        return bool(flag.item())


class _Stopwatch:
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


def _join_ranks() -> bool:
    """Joins the process group that torchrun has prepared, if any; whether it did."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or dist.is_initialized():
        return False
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
        dist.init_process_group("nccl")
    else:
        dist.init_process_group("gloo")
    return True


def _device(name: str) -> torch.device:
    if name != "auto":
        if name.startswith("cuda") and not torch.cuda.is_available():
            raise ValueError("there is no CUDA device here: use --device cpu")
        return torch.device(name)
    if torch.cuda.is_available():
        return torch.device("cuda", torch.cuda.current_device())
    return torch.device("cpu")


def _settle(config: TrainConfig) -> TrainConfig:
    """The run's own settings on a resume. Raises ValueError where the caller's contradict them."""
    if not config.task:
        raise ValueError("train needs the name of a task")
    saved = checkpoints(config.out)
    if saved and not config.resume:
        raise ValueError(
            f"{config.out} already holds a run: add --resume to continue it, or give another --out"
        )
    if not saved:
        return config
    stored = config_from_dict(read_state(saved[-1])["card"]["config"])
    plain = TrainConfig(task=config.task)
    changes = {}
    for f in dataclasses.fields(TrainConfig):
        given, own = getattr(config, f.name), getattr(stored, f.name)
        if f.name == "options":
            _same_options(config.task, given, own)
        elif f.name in _FREE:
            if given == getattr(plain, f.name) and f.name in ("samples", "minutes"):
                changes[f.name] = own
            else:
                changes[f.name] = given
        elif given != own and given != getattr(plain, f.name):
            raise ValueError(
                f"{f.name} {given!r} differs from the run's {own!r}: a resumed run keeps its "
                "settings; leave it out, or start a new run in another --out"
            )
    if stored.task != config.task:
        raise ValueError(f"{config.out} is a run of task '{stored.task}', not of '{config.task}'")
    return replace(stored, **changes)


def _same_options(task: str, given: dict[str, Any], own: dict[str, Any]) -> None:
    """Raises ValueError where a task option that was asked for is not the run's.

    The command line gives every option of the task, asked for or not, so that one at its default
    asks for nothing; lists are what JSON made of the run's tuples.
    """
    from sports.registry import get_task, task_names

    plain = dataclasses.asdict(get_task(task).config()) if task in task_names() else {}
    for name, value in given.items():
        asked = json.loads(json.dumps(value))
        default = json.loads(json.dumps(plain.get(name)))
        if asked not in (default, own.get(name, default)):
            raise ValueError(
                f"{name} {value!r} differs from the run's {own.get(name, default)!r}: a resumed "
                "run keeps its settings; leave it out, or start a new run in another --out"
            )


def config_from_dict(data: dict[str, Any]) -> TrainConfig:
    """A TrainConfig from its JSON. Raises ValueError where it is not one."""
    try:
        data = dict(data)
        ppo = dict(data.pop("ppo"))
        for name in ("hidden", "kl_band", "learning_rate_limits"):
            ppo[name] = tuple(ppo[name]) if ppo[name] is not None else None
        data["out"] = Path(data["out"])
        data["clips"] = tuple(Path(p) for p in data["clips"])
        data["start_probability"] = tuple(data["start_probability"])
        return TrainConfig(**data, ppo=PPOConfig(**ppo))
    except (TypeError, KeyError) as error:
        raise ValueError(f"the run's settings cannot be read ({error})") from error


def parse_args(args: list[str], prog: str = "python -m rl.train") -> TrainConfig:
    """``TASK [options]`` -> TrainConfig; the task's options are ``--task.NAME``.

    Raises ValueError for an unknown task; exits with code 2 and a message for other mistakes.
    """
    from sports.registry import get_task, task_names

    if not args or args[0].startswith("-"):
        if not {"-h", "--help"} & set(args):
            raise ValueError(f"say which task to train: {', '.join(task_names())}")
        print(f"usage: {prog} TASK [options], TASK one of {', '.join(task_names())}\n")
        tyro.cli(TrainConfig, args=args, prog=f"{prog} TASK")
    name, options_type = args[0], get_task(args[0]).config

    def command(run: TrainConfig, task: Any) -> TrainConfig:
        given = {f.name: getattr(task, f.name) for f in dataclasses.fields(task)}
        return replace(run, task=name, options=given)

    command.__annotations__ = {
        "run": Annotated[TrainConfig, tyro.conf.arg(name="")],
        "task": options_type,
    }
    return tyro.cli(command, args=args[1:], prog=f"{prog} {name}")


def main(args: list[str] | None = None) -> int:
    """Command line; returns the exit code: 0, or 2 with a sentence for a user's mistake."""
    try:
        summary = train(parse_args(sys.argv[1:] if args is None else args))
    except (ValueError, RuntimeError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if os.environ.get("RANK", "0") == "0":
        print(
            f"stopped by {summary.stopped_by} after {summary.samples} samples; last checkpoint "
            f"{summary.checkpoint}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
