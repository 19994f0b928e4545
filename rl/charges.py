"""What a run charges for how the athlete moves, and the limit of all charges together.

A charge as high as what the task pays makes the end of the episode the best that an athlete can
come to, however well it moved before: it falls over at the start, and learns nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rl.config import TrainConfig
from rl.impact import ImpactCost
from rl.parts import Part
from rl.ranks import gathered
from rl.rate_watch import InARow
from rl.rollout import Rollout
from rl.runlog import Row
from rl.sinking import SinkingCost
from rl.torque_change import TorqueChangeCost

CHARGES = (
    "impact",
    "impact_limit",
    "sinking",
    "sinking_limit",
    "sinking_most",
    "torque_change",
    "torque_change_limit",
    "charge_limit",
)
"""Settings of a run that say what is charged."""

MEMORY = 0.9
"""Of the means of what is paid and charged, from iteration to iteration."""

LEAST = 1e-12
"""Pay or charge that is divided by."""

TOO_MUCH = 0.8
"""A share of the pay that is warned of."""


class ChargeLimit(Part):
    """Holds all charges together to a share of what the task pays, by one factor for all.

    The factor of an iteration follows from the means over those before it, of all processes; in the
    first it is 1. Where the task pays nothing on average nothing is charged.
    """

    name, columns = "charge_limit", ("cost/share",)

    def __init__(self, config: TrainConfig, env: Any) -> None:
        self.limit, self.env = config.charge_limit, env
        self.factor = torch.ones((), device=env.device)
        self.means = torch.zeros(2, device=env.device)
        """Paid by the task and asked for by the charges, per step and athlete."""
        self.sums, self.steps = torch.zeros_like(self.means), 0
        self.known = torch.zeros((), device=env.device)
        """Weight of ``means``, 0 before the first iteration and then up to 1."""

    def take(self, cost: Tensor) -> Tensor:
        """The bonus (N, A), never positive, that is left of what a charge asks for."""
        self.sums[1] -= cost.mean()
        return cost * self.factor

    def schedule(self, share: float) -> None:
        self.sums, self.steps = torch.zeros_like(self.sums), 0
        self.factor = self._factor()

    def watch(self, result: Any) -> None:
        self.sums[0] += torch.where(result.valid[:, None], result.reward, 0.0).mean()
        self.steps += 1

    def learn(self, rollout: Rollout, iteration: int) -> dict[str, Tensor]:
        now = gathered(self.sums / max(self.steps, 1)).mean(0)
        weight = 1.0 - MEMORY
        self.known = MEMORY * self.known + weight
        self.means = self.means + weight / self.known * (now - self.means)
        paid, asked = self.means
        return {"cost/share": asked * self._factor() / paid.clamp(min=LEAST)}

    def _factor(self) -> Tensor:
        """() of the charges that is taken from now on."""
        if self.limit is None:
            return torch.ones_like(self.factor)
        paid, asked = self.means
        most = self.limit * paid.clamp(min=0.0) / asked.clamp(min=LEAST)
        return torch.where(self.known > 0.0, most.clamp(max=1.0), 1.0)

    def state_dict(self) -> dict[str, Tensor]:
        return {"means": self.means.clone(), "known": self.known.clone()}

    def load(self, state: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        if not tensors:  # of a run that was begun before there was a limit
            return
        device = self.env.device
        self.means, self.known = (tensors[k].to(device) for k in ("means", "known"))


class Charge(Part):
    """A cost of how the athlete moves; the log tells what it came to."""

    def __init__(self, cost: Callable[[Any], Tensor], limit: ChargeLimit) -> None:
        self.cost, self.limit = cost, limit
        self.columns = (f"cost/{self.name}",)
        self.sum, self.steps = torch.zeros_like(limit.factor), 0

    def schedule(self, share: float) -> None:
        self.sum, self.steps = torch.zeros_like(self.sum), 0

    def bonus(self, result: Any) -> Tensor:
        bonus = self.limit.take(self.cost(result))
        self.sum, self.steps = self.sum - bonus.mean(), self.steps + 1
        return bonus

    def learn(self, rollout: Rollout, iteration: int) -> dict[str, Tensor]:
        return dict.fromkeys(self.columns, self.sum / max(self.steps, 1))


class Impacts(Charge):
    """Of hard impacts."""

    name = "impact"

    def __init__(self, config: TrainConfig, env: Any, limit: ChargeLimit) -> None:
        super().__init__(ImpactCost(env, config.impact, config.impact_limit), limit)


class Sinking(Charge):
    """Of sinking into the ground."""

    name = "sinking"

    def __init__(self, config: TrainConfig, env: Any, limit: ChargeLimit) -> None:
        cost = SinkingCost(env, config.sinking, config.sinking_limit, config.sinking_most)
        super().__init__(cost, limit)


class TorqueChanges(Charge):
    """Of torques that jump."""

    name = "torque_change"
    cost: TorqueChangeCost

    def __init__(self, config: TrainConfig, env: Any, limit: ChargeLimit) -> None:
        cost = TorqueChangeCost(env, config.torque_change, config.torque_change_limit)
        super().__init__(cost, limit)

    def state_dict(self) -> dict[str, Tensor]:
        return self.cost.state_dict()

    def load(self, state: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        self.cost.load_state_dict(tensors)


class ChargeWatch:
    """Looks at the rows of a run that charges without a limit."""

    def __init__(self) -> None:
        self._long = InARow()

    def __call__(self, row: Row, share: float) -> str | None:
        """One sentence, once, where the charges have come near to the pay. ``share`` of the run is
        done, 0..1."""
        charged = row.get("cost/share")
        if charged is None or not self._long(charged >= TOO_MUCH):
            return None
        return (
            f"the charges take {charged:.0%} of what the task pays, and an athlete may learn to "
            "end its episodes instead: --charge-limit 0.6 holds them to a share"
        )


def charges(config: TrainConfig, env: Any) -> list[Part]:
    """The limit and the charges that it holds; empty for a run that charges nothing. Raises
    ValueError for a charge that the task cannot have."""
    limit = ChargeLimit(config, env)
    parts: list[Part] = []
    if config.impact > 0.0:
        parts.append(Impacts(config, env, limit))
    if config.sinking > 0.0:
        parts.append(Sinking(config, env, limit))
    if config.torque_change > 0.0:
        parts.append(TorqueChanges(config, env, limit))
    return [limit, *parts] if parts else []
