"""The student of a tracker: a latent prior's encoder and decoder, which follow clips."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import torch
from torch import Tensor

from rl.prior import LatentPrior, PriorError, check_layout
from rl.tracker import TrackingConfig


class Student:
    """Plays the mean latent of the posterior, with absolute PD targets for actions.

    Of the interface of ``rl.policy.Policy`` what an evaluation of trackers needs.
    """

    def __init__(self, prior: LatentPrior) -> None:
        """Raises PriorError for a prior without its encoder."""
        if not prior.encoder:
            raise PriorError("this prior was saved without its encoder: it cannot follow clips")
        self.prior = prior
        options = asdict(replace(TrackingConfig(), action="absolute", split="all"))
        self.metadata: dict[str, Any] = {
            **prior.card,
            "task": "tracking",
            "algo": "latent student",
            "sha256": prior.digest,
            "config": {"options": options},
        }

    def __call__(self, obs: Tensor) -> Tensor:
        """(..., D) -> (..., n), unclipped."""
        latent, _ = self.prior.posterior(obs)
        return self.prior.decode(obs, latent)

    def to(self, device: torch.device | str) -> Student:
        """The same on a device (moved in place)."""
        self.prior.to(device)
        return self

    def seed(self, seed: int) -> None:
        """Nothing here is random."""

    def check(self, env: Any) -> None:
        """Raises PriorError where the student does not fit an environment."""
        shape = self.prior.nets.shape
        if (shape.obs_size, shape.action_size) != (env.obs_size, env.action_size):
            raise PriorError(
                f"the prior is of body '{self.prior.card['body']}' ({shape.action_size} hinges), "
                f"these clips are of one with {env.action_size}"
            )
        check_layout(self.prior.card["layout"], env.obs_slices)
