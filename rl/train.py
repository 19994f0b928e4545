"""Trains a policy: the loop around a learner, with checkpoints, schedules, logs and signals.

``python -m rl.train TASK --out RUN ...`` or ``torchrun --nproc-per-node G -m rl.train TASK ...``.
The same loop drives every engine; with several ranks each plays its own worlds.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from rl import amp, latent_run, provenance
from rl.checkpoint import (
    CheckpointError,
    checkpoints,
    load_checkpoint,
    ranks_of,
    save_checkpoint,
)
from rl.cloning import STATISTIC as CLONE_ERROR
from rl.cloning import Cloning
from rl.config import (
    DEFAULT_SAMPLES,
    PRIOR,
    TRACKING,
    MakeEnv,
    TrainConfig,
    default_env,
    load_placed_starts,
    load_starts,
    parse_args,
    settle,
)
from rl.host import Signals, Stopwatch, join_ranks, one_torch_thread, pick_device
from rl.imitation import Imitation
from rl.impact import ImpactCost
from rl.meter import EpisodeMeter
from rl.policy import FORMAT as POLICY_FORMAT
from rl.policy import read_policy
from rl.ppo import PPO, STATISTICS
from rl.profiling import profile_training
from rl.ranks import over_ranks
from rl.rollout import collect
from rl.runlog import Row, RunLog
from rl.selfplay import SelfPlay
from rl.warm_start import load_start
from sports.env import Starts
from warmstart.atomic import write_text
from warmstart.clip import Clip

__all__ = ["RunSummary", "TrainConfig", "load_starts", "main", "parse_args", "train"]


@dataclass(frozen=True)
class RunSummary:
    """What a call of ``train`` did."""

    out: Path
    iterations: int
    samples: int
    minutes: float
    stopped_by: str
    """``samples``, ``minutes``, ``signal``, or ``profile``."""
    metrics: dict[str, float]
    """Episode metrics of the last iteration in which an episode ended."""
    checkpoint: Path
    """The last one; the trace of a profile."""
    rank: int = 0
    """Of this process; rank 0 speaks for all."""

    def sentence(self) -> str:
        """What the command says at its end."""
        what = "trace" if self.stopped_by == "profile" else "last checkpoint"
        return (
            f"stopped by {self.stopped_by} after {self.samples:,} samples, "
            f"{self.minutes:.1f} minutes; {what} {self.checkpoint}"
        )


def train(
    config: TrainConfig,
    *,
    starts: Starts | None = None,
    environment: MakeEnv = default_env,
    on_iteration: Callable[[Row], None] | None = None,
    part: float = 1.0,
) -> RunSummary:
    """Trains until ``samples``, ``minutes`` or a signal, whichever is first.

    Args:
        config: see TrainConfig.
        starts: demonstration frames; else those of ``config.clips``.
        environment: makes the environment, for tests and for tasks outside the registry.
        on_iteration: called with each progress row (rank 0).
        part: stop after this part of the samples or minutes; a call with ``resume`` goes on.

    SIGTERM and SIGINT save a checkpoint and return, at the end of the iteration.
    Raises ValueError for settings that cannot be, PolicyError for ``init``, CheckpointError when
    a checkpoint cannot be written or read, RuntimeError for an engine that cannot run here.
    """
    began_group = join_ranks(config.device)
    try:
        config = settle(config)
        trainer = _Trainer(config, starts, environment, on_iteration)
        summary = trainer.profile() if config.profile else trainer.run(part)
    except ValueError:  # every rank has made the same mistake
        _leave_ranks(began_group)
        raise
    _leave_ranks(began_group)
    return summary


def _leave_ranks(began: bool) -> None:
    """Not after an error of one rank: the others would be waited for, and torchrun ends them."""
    if began:
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
        self.device = pick_device(config.device)
        self.resumed = config.resume and bool(checkpoints(config.out))
        fresh = config.init and not self.resumed
        card = read_policy(str(config.init), config.task).metadata if fresh else {}
        if "hidden" in card and not config.paper:
            shape = {n: card[n] for n in ("hidden", "activation", "observation_clip")}
            shape["hidden"] = tuple(shape["hidden"])
            config = replace(config, ppo=replace(config.ppo, **shape))
        self.config, self.hyper = config, config.hyper
        self.env = environment(config, config.seed + 7919 * self.rank)
        if starts is None and config.clips and config.task not in (TRACKING, PRIOR):
            load = load_placed_starts if config.styled else load_starts
            starts = load(config.clips, config.start_probability[0])
        if starts is not None:
            self.env.starts = starts.to(self.env.device)
        self.imitation: Imitation | None = None
        if config.imitation > 0.0:
            if starts is None:
                raise ValueError("the imitation reward needs demonstrations: give --clips")
            self.imitation = Imitation(self.env, config.imitation, config.imitation_sharpness)
        self.bonuses: list[Callable[[Any], Tensor]] = [self.imitation] if self.imitation else []
        if config.impact > 0.0:
            self.bonuses.append(ImpactCost(self.env, config.impact, config.impact_limit))
        if config.prior is not None:
            latent_run.act_through_prior(self.env, config)
        rows = self.env.num_worlds * self.env.num_agents
        self.agent = self._learner()
        self.rollout = self.agent.new_rollout(rows)
        self.meter = EpisodeMeter(self.env)
        self.style: amp.AMP | None = None
        if config.styled:
            device, how = self.device, (config.seed, config.cuda_graph, self.agent.bf16)
            self.style = amp.of_athletes(
                self.env, config.clips, self.hyper.steps, config.amp, device, *how
            )
        self.cloning: Cloning | None = None
        if config.clone > 0:
            clip, fingers = Clip.load(config.clips[0]), config.clone_fingers
            self.cloning = Cloning(self.env, self.agent, clip, config.clone, fingers)
        self.iteration, self.samples, self.minutes = 0, 0, 0.0
        self.metrics: dict[str, float] = {}
        self.warmup = 0
        # Without any statistics the first rollout is for the observation normaliser only.
        self.first_learning = 0 if config.init or config.task == PRIOR else 1
        self.unseen: Tensor | None = None
        """(D,) bool features that the first policy, of another task, has never seen."""
        if fresh:
            self._begin_from(str(config.init))
        self.selfplay: SelfPlay | None = None
        if config.algo == "selfplay":
            self.selfplay = SelfPlay(
                self.env, self.agent, config.selfplay, self.hyper.steps, config.seed
            )
        learned = self.selfplay.learned_rows if self.selfplay is not None else rows
        self.samples_each = self.rollout.steps * learned * self.ranks
        self.obs = self._restore() if self.resumed else self.env.reset()

    def _learner(self) -> Any:
        c = self.config
        bf16 = {"auto": None, "float32": False, "bfloat16": True}[c.precision]
        if c.task == PRIOR:
            return latent_run.make_distiller(c, self.env, self.device, bf16)
        sizes = (self.env.obs_size, self.env.action_size)
        return PPO(*sizes, self.hyper, self.device, c.seed, c.cuda_graph, bf16)

    def _begin_from(self, source: str) -> None:
        """Takes the networks and statistics of another policy."""
        policy, unseen = load_start(source, self.env, self.config.task)
        if policy.layer is not None:
            raise ValueError("--init is a latent policy: give --prior as well")
        assert policy.actor is not None
        count = policy.metadata["obs_count"]
        self.agent.load_policy(policy.actor, policy.mean, policy.std, count)
        critic = self.agent.load_critic(policy.extra)
        self.warmup = 0 if critic else self.hyper.critic_warmup
        if bool(unseen.any()):
            self.unseen, self.first_learning = unseen.to(self.device), 1

    def _watch(self, result: Any) -> None:
        self.meter(result)
        if self.style is not None:
            self.style.watch(result)
        if self.selfplay is not None:
            self.selfplay.watch(result)

    # -- the loop -------------------------------------------------------------------------------

    def run(self, part: float) -> RunSummary:
        """Iterates until a stop criterion holds for this part of the run."""
        config = self.config
        stop_samples = config.samples
        if stop_samples is None and config.minutes is None:
            stop_samples = DEFAULT_SAMPLES
        log = None
        if self.rank == 0:
            self._write_config()
            if self.resumed and not config.quiet:
                print(f"{config.out} goes on after iteration {self.iteration}", flush=True)
            if self.ranks > 1 and not config.quiet:
                print(
                    f"{self.ranks} processes with {self.env.num_worlds} worlds each: samples and "
                    "samples_per_s are of all of them",
                    flush=True,
                )
        began = time.monotonic() - 60.0 * self.minutes
        last_saved, saved, stopped_by = self.minutes, None, ""
        try:
            with Signals() as signals:
                while not stopped_by:
                    if stop_samples is not None and self.samples >= part * stop_samples:
                        stopped_by = "samples"
                    elif config.minutes is not None and self.minutes >= part * config.minutes:
                        stopped_by = "minutes"
                    elif signals.heard(self.device):
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
                if config.task == PRIOR and self.rank == 0:
                    latent_run.write_prior(config.out)
        except OSError as error:
            raise CheckpointError(
                f"the run could not write to {config.out} ({error.strerror or error}): free some "
                "space and go on with --resume"
            ) from error
        finally:
            if log is not None:
                log.close()
            self.env.close()
        return self._summary(stopped_by, saved)

    def profile(self) -> RunSummary:
        """Measures a few updates instead of training; the run's checkpoints stay as they are."""
        began = time.monotonic() - 60.0 * self.minutes
        try:
            path = profile_training(self, lambda: self._iterate(began, self.config.samples))
        finally:
            self.env.close()
        return self._summary("profile", path)

    def _summary(self, stopped_by: str, path: Path) -> RunSummary:
        return RunSummary(
            out=self.config.out,
            iterations=self.iteration,
            samples=self.samples,
            minutes=self.minutes,
            stopped_by=stopped_by,
            metrics=self.metrics,
            checkpoint=path,
            rank=self.rank,
        )

    def _iterate(self, began: float, stop_samples: int | None) -> Row:
        """One rollout and its update. Waits for the device once, for the numbers of the row."""
        self._schedule(self._share(stop_samples))
        learns = self.iteration >= self.first_learning
        clock = Stopwatch(self.device)
        clock.mark()
        self._play()
        clock.mark()
        losses = self._learn()
        clock.mark()
        row: Row = {"iteration": self.iteration + 1}
        rates = {"learning_rate": self.agent.learning_rate, "sigma": self.agent.sigma}
        levels = {f"curriculum/{k}": x.float().mean() for k, x in self.env.curriculum.items()}
        means = losses | rates | levels
        physics = getattr(self.env, "physics", None)
        counts = {k: getattr(physics, k, 0) for k in ("nan_worlds", "overflow")}
        episode = self.meter.totals()
        # Rank 0's clock decides for all: the others add 0 seconds.
        seconds = time.monotonic() - began if self.rank == 0 else 0.0
        own = (*counts.values(), torch.tensor(seconds, dtype=torch.float64))
        totals, averages = over_ranks(
            torch.cat([episode.to(self.device), *(self._number(x) for x in own)]),
            torch.cat([self._number(x) for x in means.values()]),
        )  # the one wait of the iteration
        before = self.minutes
        # Seconds were read before the device had finished; the wait is over now.
        self.minutes = (time.monotonic() - began) / 60.0
        if self.ranks > 1:
            self.minutes = totals[-1] / 60.0
        self.iteration += 1
        self.samples += self.samples_each
        counts_now = {k: int(v) for k, v in zip(counts, totals[len(episode) :])}
        means_now = dict(zip(means, averages))
        losses_now = {k: means_now[k] for k in (*losses, *rates)}
        if not all(math.isfinite(v) for v in losses_now.values()):
            raise RuntimeError(
                f"learning diverged at iteration {self.iteration} (a loss is not finite): go on "
                "from the last checkpoint with --resume, or start with a smaller learning rate"
            )
        contests: Row = {}
        if self.selfplay is not None:
            contests |= self.selfplay.settle(self.samples, learns)
        summary = self.meter.summary(totals)
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
            **dict.fromkeys(STATISTICS if self.config.task != PRIOR else ()),
            **dict.fromkeys(amp.STATISTICS if self.style is not None else ()),
            **dict.fromkeys((CLONE_ERROR,) if self.cloning is not None else ()),
            **losses_now,
            **contests,
            **summary,
        }
        return row | counts_now | {k: means_now[k] for k in levels}

    def _play(self) -> None:
        """Fills the rollout."""
        with one_torch_thread(self.env.device):
            self.obs = collect(
                self.env,
                self._cloning or self.selfplay or self.agent,
                self.rollout,
                self.obs,
                self.hyper.gamma,
                on_step=self._watch,
                bonuses=self.bonuses,
            )
        merge = getattr(self.env, "merge_ranks", None)
        if self.ranks > 1 and merge is not None:  # what the environment learns from its episodes
            merge()
        if self.style is not None:
            self.style.pay(self.rollout, self.env.reward_scale)

    def _learn(self) -> dict[str, Tensor]:
        """Learns from the rollout; returns () statistics."""
        if self.iteration < self.first_learning:
            if self.unseen is not None:
                self.agent.obs_norm.adopt(self.unseen)
            self.agent.obs_norm.commit()
            return {}
        learn = self.selfplay.learn if self.selfplay is not None else self.agent.update
        losses = learn(self.rollout)
        losses |= self.style.update() if self.style is not None else {}
        if self._cloning is not None:
            losses |= self._cloning.update(self.rollout, self.iteration)
        return losses

    @property
    def _cloning(self) -> Cloning | None:
        """In the first iterations of a run that clones, and always where fingers stay cloned."""
        if self.cloning is not None:
            self.cloning.leading = self.iteration < self.config.clone
            if self.cloning.leading or self.config.clone_fingers:
                return self.cloning
        return None

    def _number(self, x: Tensor | int) -> Tensor:
        """(1,) float64 on the learner's device."""
        return torch.as_tensor(x).double().to(self.device)[None]

    def _share(self, stop_samples: int | None) -> float:
        """Part of the run that is done, 0..1: the schedules' clock."""
        share = 0.0 if stop_samples is None else self.samples / stop_samples
        if self.config.minutes is not None:
            share = max(share, self.minutes / self.config.minutes)
        return min(share, 1.0)

    def _schedule(self, share: float) -> None:
        c, h = self.config, self.hyper
        if c.task == PRIOR:
            self.agent.schedule(share)
        if h.sigma_final is not None:
            self.agent.sigma.fill_(h.sigma * (h.sigma_final / h.sigma) ** share)
        resting = self.iteration < max(self.warmup, c.clone)  # only the critic learns by reward
        self.agent.actor_weight.fill_(0.0 if resting else 1.0)
        schedule = getattr(self.env, "schedule", None)
        if schedule is not None:  # an environment with a curriculum over the whole run
            schedule(share)
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
        if c.prior is not None:
            latent_run.keep_prior(self.env, c.out)
        data = {
            "config": dataclasses.asdict(replace(c, ppo=self.hyper, paper=False)),
            "paper": c.paper,
            "ranks": self.ranks,
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "hardware": provenance.hardware(),
        }
        write_text(c.out / "config.json", json.dumps(data, indent=1, default=str))

    def card(self) -> dict[str, Any]:
        """What the policy file says about itself; see rl.policy."""
        c, norm = self.config, self.agent.obs_norm
        task = getattr(self.env, "task", None)
        return {
            "format": POLICY_FORMAT,
            "task": c.task,
            "algo": c.method,
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
            **getattr(self.env, "card", {}),
            **latent_run.card(self.env, self.agent),
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
        if self.style is not None:
            tensors |= {f"style/{k}": v for k, v in self.style.state_dict().items()}
        if self.cloning is not None:
            tensors |= {f"cloning/{k}": v for k, v in self.cloning.state_dict().items()}
        if self.selfplay is not None:
            state["selfplay"] = self.selfplay.state()
            tensors |= {f"selfplay/{k}": v for k, v in self.selfplay.state_dict().items()}
        tensors["obs"] = self.obs
        barrier = dist.barrier if self.ranks > 1 else None
        return save_checkpoint(self.config.out, self.iteration, state, tensors, self.rank, barrier)

    def _restore(self) -> Tensor:
        """Takes the last checkpoint back; returns the observation to go on from."""
        path = checkpoints(self.config.out)[-1]
        saved = ranks_of(path)
        state, tensors = load_checkpoint(path, self.rank % saved)

        def part(prefix: str) -> dict[str, Tensor]:
            return {k[len(prefix) :]: v for k, v in tensors.items() if k.startswith(prefix)}

        self.agent.load_state_dict(part("agent/"))
        self.env.load_state_dict(part("env/"))
        self.meter.load_state_dict(part("meter/"))
        if self.style is not None:
            self.style.load_state_dict(part("style/"))
        if self.cloning is not None:
            self.cloning.load_state_dict(part("cloning/"))
        if self.selfplay is not None:
            self.selfplay.load(state["selfplay"], part("selfplay/"))
        self.iteration, self.samples = state["iteration"], state["samples"]
        self.minutes, self.warmup = state["minutes"], state["warmup"]
        self.metrics = state["card"]["metrics"]
        if saved < self.ranks and self.rank == 0 and not self.config.quiet:
            print(
                f"{path} has the worlds of {saved} processes: the others begin with copies of them",
                flush=True,
            )
        if self.rank >= saved:  # the worlds of another rank, but not its future
            part_of_run = 1_000_003 * self.rank + self.iteration
            owners = (self.agent, self.env, self.style, self.selfplay)
            for k, owner in enumerate(owners):
                generator = getattr(owner, "generator", None)
                if generator is not None:
                    generator.manual_seed(self.config.seed + 7919 * k + part_of_run)
        return tensors["obs"].to(self.env.device)


def main(args: list[str] | None = None) -> int:
    """Command line; returns the exit code: 0, or 2 with a sentence for a user's mistake."""
    try:
        summary = train(parse_args(sys.argv[1:] if args is None else args))
    except (ValueError, RuntimeError, OSError) as error:
        rank = os.environ.get("RANK", "0")
        if rank == "0" or not isinstance(error, ValueError):  # a user's mistake is told once
            print(f"error: {'' if rank == '0' else f'rank {rank}: '}{error}", file=sys.stderr)
        return 2
    if summary.rank == 0:
        print(summary.sentence())
    return 0


if __name__ == "__main__":
    sys.exit(main())
