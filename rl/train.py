"""Trains a policy: the loop around a learner, with checkpoints, schedules, logs and signals.

``python -m rl.train TASK --out RUN ...`` or ``torchrun --nproc-per-node G -m rl.train TASK ...``.
The same loop drives every engine; with several ranks each plays its own worlds.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rl import latent_run
from rl.assembly import Assembly, MakeEnv, assemble, default_env, plays_own
from rl.charges import ChargeWatch
from rl.checkpoint import CheckpointError
from rl.config import DEFAULT_SAMPLES, PRIOR, TrainConfig, load_starts, parse_args
from rl.host import Signals, Stopwatch, among_ranks, one_torch_thread
from rl.meter import apart
from rl.profiling import profile_training
from rl.ranks import over_ranks
from rl.rate_watch import RateWatch
from rl.rollout import collect
from rl.run_folder import Progress, keep_policy, restore, save, settle, write_config
from rl.runlog import KINDS, Row, RunLog
from rl.until import Until
from sports.env import Starts

__all__ = ["RunSummary", "TrainConfig", "load_starts", "main", "parse_args", "train"]


@dataclass(frozen=True)
class RunSummary:
    """What a call of ``train`` did."""

    out: Path
    iterations: int
    samples: int
    minutes: float
    stopped_by: str
    """``samples``, ``minutes``, ``until``, ``signal``, or ``profile``."""
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
    """Trains until ``samples``, ``minutes``, what ``until`` says or a signal, whichever is first.

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
    with among_ranks(config.device, share=config.own_ranks > 0):
        made = assemble(settle(config), starts, environment)
        trainer = _Trainer(made, on_iteration)
        return trainer.profile() if config.profile else trainer.run(part)


class _Trainer:
    """One run in one process."""

    def __init__(self, made: Assembly, on_iteration: Callable[[Row], None] | None) -> None:
        self.made, self.on_iteration = made, on_iteration
        self.config, self.device = made.config, made.device
        self.rank, self.ranks = made.rank, made.ranks
        self.env, self.agent, self.parts = made.env, made.agent, made.parts
        if made.resumed:
            self.now = restore(made)
        else:
            self.now = Progress(obs=self.env.reset(), warmup=made.warmup)
        self.goal = self.config.samples
        """Samples at which the run is done, as far as they decide."""
        self.until = None if self.config.until is None else Until(self.config.until)
        self.there = False
        """Whether what ``until`` asks for has come."""
        self.began = 0.0
        """When the run began by this process's clock, had it never paused (s)."""

    def run(self, part: float) -> RunSummary:
        """Iterates until a stop criterion holds for this part of the run."""
        config = self.config
        if self.goal is None and config.minutes is None:
            self.goal = DEFAULT_SAMPLES
        log = None
        if self.rank == 0:
            write_config(self.made)
            self._greet()
        self.began = time.monotonic() - 60.0 * self.now.minutes
        saved_at, saved = self.now.minutes, None
        watches = (RateWatch(config.hyper), ChargeWatch())
        try:
            with Signals() as signals:
                while not (stopped_by := self._stopped_by(part, signals)):
                    row = self._iterate()
                    self.there = self.until is not None and self.until(row)
                    if self.rank == 0:
                        if log is None:
                            after = self.now.iteration - 1
                            log = RunLog(config.out, list(row), after, config.quiet)
                        share = self._share()
                        log.write(row, share)
                        for advice in (watch(row, share) for watch in watches):
                            if advice is not None and not config.quiet:
                                print(f"warning: {advice}", file=sys.stderr, flush=True)
                        if self.on_iteration is not None:
                            self.on_iteration(row)
                    saved = self._save() if self._save_due(saved_at) else None
                    if saved is not None:
                        saved_at = self.now.minutes
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
        self.began = time.monotonic() - 60.0 * self.now.minutes
        try:
            path = profile_training(self, self._iterate)
        finally:
            self.env.close()
        return self._summary("profile", path)

    def _greet(self) -> None:
        if self.config.quiet:
            return
        if self.made.resumed:
            print(f"{self.config.out} goes on after iteration {self.now.iteration}", flush=True)
        if self.ranks > 1:
            print(
                f"{self.ranks} processes with {self.env.num_worlds} worlds each: samples and "
                "samples_per_s are of all of them",
                flush=True,
            )

    def _stopped_by(self, part: float, signals: Signals) -> str:
        """Which criterion ends this part of the run now, or nothing."""
        minutes = self.config.minutes
        if self.there:
            return "until"
        if self.goal is not None and self.now.samples >= part * self.goal:
            return "samples"
        if minutes is not None and self.now.minutes >= part * minutes:
            return "minutes"
        return "signal" if signals.heard(self.device) else ""

    def _save_due(self, saved_at: float) -> bool:
        """``saved_at``: minutes at the last checkpoint of this session."""
        every = self.config.checkpoint_iterations
        if every is not None and self.now.iteration % every == 0:
            return True
        return self.now.minutes - saved_at >= self.config.checkpoint_minutes

    def _save(self) -> Path:
        """Writes a checkpoint, and the policy in it where those are to be kept."""
        path = save(self.made, self.now)
        if self.config.keep_policies and self.rank == 0:
            keep_policy(self.made, self.now)
        return path

    def _summary(self, stopped_by: str, path: Path) -> RunSummary:
        return RunSummary(
            out=self.config.out,
            iterations=self.now.iteration,
            samples=self.now.samples,
            minutes=self.now.minutes,
            stopped_by=stopped_by,
            metrics=self.now.metrics,
            checkpoint=path,
            rank=self.rank,
        )

    # -- one iteration --------------------------------------------------------------------------

    def _iterate(self) -> Row:
        """One rollout and its update. Waits for the device once, for the numbers of the row."""
        now, began = self.now, self.now.minutes
        learns = now.iteration >= self.made.first_learning
        self._schedule(self._share())
        clock = Stopwatch(self.device)
        clock.mark()
        self._play()
        clock.mark()
        losses = self._learn() if learns else self._look()
        clock.mark()
        told = self._numbers(losses)
        now.iteration += 1
        now.samples += self.made.samples_each
        if not all(math.isfinite(v) for v in told.losses.values()):
            raise RuntimeError(
                f"learning diverged at iteration {now.iteration} (a loss is not finite): go on "
                "from the last checkpoint with --resume, or start with a smaller learning rate"
            )
        settled: Row = {}
        for part in self.parts:
            settled |= part.settle(now.samples, learns)
        metrics = {k[8:]: v for k, v in told.episodes.items() if k.startswith("metrics/")}
        now.metrics |= {k: v for k, v in metrics.items() if v is not None and math.isfinite(v)}
        took = max(60.0 * (now.minutes - began), 1e-9)
        rollout_s, update_s = clock.laps()
        return {
            "iteration": now.iteration,
            "samples": now.samples,
            "minutes": now.minutes,
            "samples_per_s": self.made.samples_each / took,
            "rollout_s": rollout_s,
            "update_s": update_s,
            **dict.fromkeys(self.made.columns),
            **told.losses,
            **settled,
            **told.episodes,
            **told.counts,
            **told.levels,
        }

    def _schedule(self, share: float) -> None:
        """Sets what changes over the run; ``share`` of it is done."""
        self.agent.schedule(share)
        # While the actor rests, reward teaches the critic alone.
        resting = self.now.iteration < max(self.now.warmup, self.config.clone)
        self.agent.actor_weight.fill_(0.0 if resting else 1.0)
        schedule = getattr(self.env, "schedule", None)
        if schedule is not None:  # an environment with a curriculum over the whole run
            schedule(share)
        if self.env.starts is not None:
            first, last = self.config.start_probability
            self.env.starts.probability = first + (last - first) * share
        for part in self.parts:
            part.schedule(share)

    def _play(self) -> None:
        """Fills the rollout."""
        rollout = self.made.rollout
        actors = (part.actor(self.now.iteration) for part in self.parts)
        with one_torch_thread(self.env.device):
            self.now.obs = collect(
                self.env,
                next((a for a in actors if a is not None), self.agent),
                rollout,
                self.now.obs,
                self.config.hyper.gamma,
                on_step=self._watch,
                bonuses=[part.bonus for part in self.parts if part.bonus is not None],
            )
        merge = getattr(self.env, "merge_ranks", None)
        if self.ranks > 1 and merge is not None:  # what the environment learns from its episodes
            merge()
        for part in self.parts:
            part.paid(rollout)

    def _watch(self, result: Any) -> None:
        self.made.meter(result)
        for part in self.parts:
            part.watch(result)

    def _learn(self) -> dict[str, Tensor]:
        """Learns from the rollout; returns () statistics."""
        rollout = self.made.rollout
        updates = (part.update for part in self.parts)
        update = next((u for u in updates if u is not None), self.agent.update)
        losses = update(rollout)
        for part in self.parts:
            losses |= part.learn(rollout, self.now.iteration)
        return losses

    def _look(self) -> dict[str, Tensor]:
        """Takes in what observations are like, and learns nothing else."""
        if self.made.unseen is not None:
            self.agent.obs_norm.adopt(self.made.unseen)
        self.agent.obs_norm.commit()
        return {}

    def _share(self) -> float:
        """Part of the run that is done, 0..1: the schedules' clock."""
        share = 0.0 if self.goal is None else self.now.samples / self.goal
        if self.config.minutes is not None:
            share = max(share, self.now.minutes / self.config.minutes)
        return min(share, 1.0)

    # -- what an iteration came to --------------------------------------------------------------

    def _numbers(self, losses: dict[str, Tensor]) -> _Numbers:
        """Numbers of all ranks, and the minutes so far. The one wait of an iteration."""
        losses = losses | {"learning_rate": self.agent.learning_rate, "sigma": self.agent.sigma}
        levels = {f"curriculum/{k}": x.float().mean() for k, x in self.env.curriculum.items()}
        physics = getattr(self.env, "physics", None)
        counts = {k: getattr(physics, k, 0) for k in ("nan_worlds", "overflow")}
        episodes = self.made.meter.totals().to(self.device)
        if self.config.own_ranks:
            episodes = apart(episodes, plays_own(self.config, self.rank, self.ranks))
        # Rank 0's clock decides for all: the others add 0 seconds.
        seconds = time.monotonic() - self.began if self.rank == 0 else 0.0
        own = (*counts.values(), torch.tensor(seconds, dtype=torch.float64))
        totals, averages = over_ranks(
            torch.cat([episodes, *(self._number(x) for x in own)]),
            torch.cat([self._number(x) for x in (*losses.values(), *levels.values())]),
        )
        if self.ranks == 1:
            # Seconds were read before the device had finished; the wait is over now.
            self.now.minutes = (time.monotonic() - self.began) / 60.0
        else:
            self.now.minutes = totals[-1] / 60.0
        return _Numbers(
            losses=dict(zip(losses, averages)),
            levels=dict(zip(levels, averages[len(losses) :])),
            counts={k: int(v) for k, v in zip(counts, totals[len(episodes) :])},
            episodes=self._episodes(totals[: len(episodes)]),
        )

    def _episodes(self, totals: list[float]) -> Row:
        """What the episodes of all ranks came to; with ``own_ranks`` also those of each kind."""
        meter = self.made.meter
        if not self.config.own_ranks:
            return meter.summary(totals)
        half = len(totals) // 2
        others, own = totals[:half], totals[half:]
        told = meter.summary([a + b for a, b in zip(others, own)])
        for kind, sums in zip(KINDS, (own, others)):
            told |= meter.metrics(sums, kind)
        return told

    def _number(self, x: Tensor | int) -> Tensor:
        """(1,) float64 on the learner's device."""
        return torch.as_tensor(x).double().to(self.device)[None]


@dataclass(frozen=True)
class _Numbers:
    """What an iteration came to, of all ranks together."""

    losses: dict[str, float]
    """Statistics of the learning, and its rates."""
    levels: dict[str, float]
    """Of the curriculum, means over the worlds."""
    counts: dict[str, int]
    """Worlds in which the engine failed, so far."""
    episodes: Row
    """See rl.meter."""


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
