"""What a run may add to its learner, each part with its places in the loop of ``rl.train``.

An iteration calls, of every part in turn: ``schedule``, then ``actor``, ``bonus`` and ``watch``
while worlds are played, ``paid`` when the rollout is full, ``update`` and ``learn`` to learn from
it, and ``settle`` at the end. The algorithms themselves know nothing of the loop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rl import amp
from rl.cloning import STATISTIC as CLONE_ERROR
from rl.cloning import Cloning
from rl.config import TrainConfig
from rl.imitation import Imitation
from rl.ppo import PPO
from rl.rollout import Actor, Rollout
from rl.runlog import Row
from rl.selfplay import SelfPlay
from warmstart.clip import Clip


class Part:
    """One that does nothing; those below say what they do."""

    name = ""
    """Of its tensors and state in a checkpoint."""
    columns: tuple[str, ...] = ()
    """Of the log: what ``learn`` returns, empty in rows without it."""
    bonus: Callable[[Any], Tensor] | None = None
    """StepResult -> (N, A) unscaled reward, added to the task's."""
    update: Callable[[Rollout], dict[str, Tensor]] | None = None
    """Instead of the learner's own."""
    generator: torch.Generator | None = None
    """Of its noise, where it has its own."""

    def schedule(self, share: float) -> None:
        """At the beginning of an iteration; ``share`` of the run is done, 0..1."""

    def actor(self, iteration: int) -> Actor | None:
        """Who plays in the learner's place; ``iteration`` of them were before."""

    def watch(self, result: Any) -> None:
        """After every step of the environment, with its StepResult."""

    def paid(self, rollout: Rollout) -> None:
        """After the rollout, before anything learns from it; may change its rewards."""

    def learn(self, rollout: Rollout, iteration: int) -> dict[str, Tensor]:
        """After the learner has learned; ``iteration`` as above. Returns () statistics."""
        return {}

    def settle(self, samples: int, learned: bool) -> Row:
        """Between iterations: what is done on the host, and told in the row. ``samples`` so far;
        whether this iteration ``learned``. May wait for the device."""
        return {}

    def state(self) -> dict[str, Any]:
        """The host's part of the state, as plain JSON."""
        return {}

    def state_dict(self) -> dict[str, Tensor]:
        """The tensors that decide how it goes on."""
        return {}

    def load(self, state: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        """Takes both back. Raises ValueError where they do not fit."""


class ImitationReward(Part):
    """Pays for moving exactly like the demonstrations, less and less."""

    name = "imitation"

    def __init__(self, config: TrainConfig, env: Any) -> None:
        self.config = config
        self.reward = Imitation(env, config.imitation, config.imitation_sharpness)
        self.bonus = self.reward

    def schedule(self, share: float) -> None:
        left = max(0.0, 1.0 - share / self.config.imitation_share)
        self.reward.weight.fill_(self.config.imitation * left)


class Style(Part):
    """Pays for moving like the clips, as a discriminator that learns beside the policy sees it."""

    name, columns = "style", amp.STATISTICS

    def __init__(self, config: TrainConfig, env: Any, agent: PPO) -> None:
        how = (config.hyper.steps, config.amp, agent.device, config.seed, config.cuda_graph)
        self.amp = amp.of_athletes(env, config.clips, *how, agent.bf16)
        self.generator, self.env = self.amp.generator, env

    def watch(self, result: Any) -> None:
        self.amp.watch(result)

    def paid(self, rollout: Rollout) -> None:
        self.amp.pay(rollout, self.env.reward_scale)

    def learn(self, rollout: Rollout, iteration: int) -> dict[str, Tensor]:
        return self.amp.update()

    def state_dict(self) -> dict[str, Tensor]:
        return self.amp.state_dict()

    def load(self, state: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        self.amp.load_state_dict(tensors)


class Lesson(Part):
    """In the first iterations the actor learns the targets of a clip; its fingers may go on."""

    name, columns = "cloning", (CLONE_ERROR,)

    def __init__(self, config: TrainConfig, env: Any, agent: PPO) -> None:
        clip, self.iterations, self.agent = Clip.load(config.clips[0]), config.clone, agent
        self.cloning = Cloning(
            env, agent, clip, config.clone, config.clone_fingers, config.clone_rates
        )

    @property
    def _going_on(self) -> bool:
        return self.cloning.leading or self.cloning.fingers is not None

    def actor(self, iteration: int) -> Actor | None:
        self.cloning.leading = iteration < self.iterations
        if iteration == max(self.iterations // 2, 1):
            # The fine half of the lesson is read as all will be that comes after it.
            self.agent.keep_statistics(torch.ones_like(self.agent.obs_norm.mean, dtype=torch.bool))
        return self.cloning if self._going_on else None

    def learn(self, rollout: Rollout, iteration: int) -> dict[str, Tensor]:
        return self.cloning.update(rollout, iteration) if self._going_on else {}

    def state_dict(self) -> dict[str, Tensor]:
        return self.cloning.state_dict()

    def load(self, state: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        self.cloning.load_state_dict(tensors)


class Opponents(Part):
    """The learner plays itself and its past, and learns from its own samples alone."""

    name = "selfplay"

    def __init__(self, config: TrainConfig, env: Any, agent: PPO) -> None:
        """``agent``: with the policy that it begins with, the first opponent."""
        self.play = SelfPlay(env, agent, config.selfplay, config.hyper.steps, config.seed)
        self.generator, self.update = self.play.generator, self.play.learn

    def actor(self, iteration: int) -> Actor | None:
        return self.play

    def watch(self, result: Any) -> None:
        self.play.watch(result)

    def settle(self, samples: int, learned: bool) -> Row:
        return {**self.play.settle(samples, learned)}

    def state(self) -> dict[str, Any]:
        return self.play.state()

    def state_dict(self) -> dict[str, Tensor]:
        return self.play.state_dict()

    def load(self, state: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        self.play.load(state, tensors)
