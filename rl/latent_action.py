"""Task policies in the space of the latent prior: a layer between a policy and its athlete.

The policy's action is a latent, or rather where in the prior's distribution it lies; the frozen
decoder makes PD targets of it. Any learner works with it as with any other action (PULSE; Luo et
al. 2024, section 3.3).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from rl.prior import LatentPrior, PriorError, body_digest, check_layout, self_layout
from rl.prior_body import SeenAs
from sports.humanoid.body import Body, is_finger, load_body
from sports.scene import Scene


@dataclass(frozen=True)
class LatentConfig:
    """How a policy acts through a latent prior (``--prior``)."""

    combine: Literal["bounded", "scaled", "free"] = "bounded"
    """bounded: z = mu + sigma x ``span`` x tanh(a) with the prior's mu and sigma in the present
    state, which keeps the policy human; scaled: the same without the tanh; free: z = mu + a, as in
    the PULSE paper."""
    span: float = 2.5
    """Standard deviations of the prior that a bounded policy reaches, and a scaled one by a = 1."""
    arm_residual: float = 0.0
    """Radians that the policy may add to the targets of the arm that holds the tool, or of those
    whose hands begin with something in them; 0 for none. 0.2 helps in racket sports."""
    hands: bool = False
    """Give the policy one number more for each hand with fingers, with which it opens: up to 0.2
    the fingers keep the task's grasp, from 1 on they are straight."""

    def __post_init__(self) -> None:
        if self.span <= 0.0 or not 0.0 <= self.arm_residual <= math.pi:
            raise ValueError("latent: span must be positive, arm_residual lie in [0, pi]")


def as_told(card: dict[str, Any]) -> dict[str, Any]:
    """``LatentActions.card`` as a policy tells it: one that is older than a setting acted as
    without it."""
    return asdict(LatentConfig()) | card


def arm_dofs(body: Body, tools: tuple[str, ...]) -> list[int]:
    """Indices of the hinges of the arms that hold the ``tools`` (links), from the shoulder blade
    on, fingers left out. Raises ValueError without a tool."""
    if not tools:
        raise ValueError(
            "the task has no tool and nothing in hand, so no arm for --latent.arm-residual: leave "
            "it out"
        )
    children = [link.parent for link in body.links]
    arm: set[str] = set()
    for tool in tools:
        arm |= {name for name in body.subtree(tool) if not is_finger(name)}
        at = body.links[body.link_index(tool)].parent
        while at is not None and children.count(at) == 1:
            arm.add(at)
            at = body.links[body.link_index(at)].parent
    return [i for i, dof in enumerate(body.dofs) if dof.link in arm]


def holding(scene: Scene) -> tuple[str, ...]:
    """The hands (links) that begin with something in them."""
    held = {dof.link for dof in scene.body.dofs if dof.name in scene.steady}
    return tuple(name for name in scene.body.link_names if name in held & {"L_Wrist", "R_Wrist"})


KEEP = 0.2
"""Up to here a hand's number leaves the grasp as it is: the noise of exploring drops nothing."""


def finger_dofs(body: Body) -> list[list[int]]:
    """Indices of the fingers' hinges, hand by hand. Raises ValueError for a body without any."""
    hands: dict[str, list[int]] = {}
    for i, dof in enumerate(body.dofs):
        if is_finger(dof.link):
            at = dof.link
            while is_finger(at):
                at = body.links[body.link_index(at)].parent or ""
            hands.setdefault(at, []).append(i)
    if not hands:
        raise ValueError(
            f"the athlete of this task (body '{body.name}') has no fingers for --latent.hands: "
            "leave it out"
        )
    return list(hands.values())


def _seen_as(prior: LatentPrior, body: Body, device: torch.device | str) -> SeenAs | None:
    """How the prior sees the athlete; None where it is the very body. Raises PriorError."""
    known, digest = prior.card["body"], prior.card["body_digest"]
    if digest == body_digest(body):
        return None
    try:
        told = load_body(known)
        if digest == body_digest(told):
            return SeenAs(told, body, device)
    except (ValueError, KeyError):
        pass  # no body of ours, or none that this one is like
    raise PriorError(
        f"the prior is of body '{known}', the athlete of this task is '{body.name}': use a prior "
        "of that body, or of the same without fingers"
    )


class LatentActions:
    """(N, A, D) observations and (N, A, ``size``) policy's actions -> (N, A, n) actions."""

    def __init__(
        self,
        prior: LatentPrior,
        config: LatentConfig,
        scene: Scene,
        tools: tuple[str, ...],
        device: torch.device | str,
    ) -> None:
        """Args:
        prior: frozen networks with their normaliser; moved to ``device``.
        config: see LatentConfig.
        scene: of the task: its athlete, and the pose that its actions are around.
        tools: links that hold the task's tool.
        device: where the environment lives.

        Raises PriorError for a prior of another body, unless the athlete is that body with
        fingers (``rl.prior_body``), ValueError for an arm without a tool.
        """
        body = scene.body
        self._seen = _seen_as(prior, body, device)
        self._layout = prior.card["layout"] if self._seen is None else self_layout(body.num_links)
        self.prior, self.config = prior.to(device), config
        scale, offset = body.action_scale(), scene.action_offset()

        def tensor(values: Any) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self._offset = tensor(offset / scale)
        # Fingers keep the task's grasp: action 0 is its pose.
        self._free = tensor([0.0 if is_finger(dof.link) else 1.0 for dof in body.dofs])
        arm = arm_dofs(body, tools or holding(scene)) if config.arm_residual > 0.0 else []
        spread = torch.zeros(len(arm), body.num_dofs)
        spread[torch.arange(len(arm)), arm] = 1.0
        self._spread = spread.to(device) * config.arm_residual / tensor(scale)
        hands = finger_dofs(body) if config.hands else []
        opens = torch.zeros(len(hands), body.num_dofs, device=device)
        for hand, fingers in enumerate(hands):
            opens[hand, fingers] = -self._offset[fingers]  # straight is the angle 0
        self._opens = opens
        self.arm = slice(prior.latent, prior.latent + len(arm))
        """Of the policy's action, the numbers of the arm's hinges."""
        self.size = self.arm.stop + len(hands)
        """Numbers of the policy's action: the latent's, then the arm's hinges, then the hands."""

    @property
    def card(self) -> dict[str, Any]:
        """What a policy says about it."""
        return {"prior_digest": self.prior.digest, **asdict(self.config)}

    def check(self, slices: dict[str, slice]) -> None:
        """Raises PriorError unless observations begin with the body as the prior sees it."""
        check_layout(self._layout, slices)

    def _state(self, obs: Tensor) -> Tensor:
        """(..., D) -> (..., D or S) observations that begin with the body as the prior sees it."""
        return obs if self._seen is None else self._seen.state(obs)

    def latent(self, obs: Tensor, action: Tensor) -> Tensor:
        """(..., D), (..., size) -> (..., Z)."""
        return self._latent(self._state(obs), action)

    def _latent(self, state: Tensor, action: Tensor) -> Tensor:
        mean, sigma = self.prior.moments(state)
        a = action[..., : self.prior.latent].float()
        if self.config.combine == "free":
            return mean + a
        reach = a if self.config.combine == "scaled" else torch.tanh(a)
        return mean + sigma * self.config.span * reach

    @torch.no_grad()
    def __call__(self, obs: Tensor, action: Tensor) -> Tensor:
        """PD targets of the decoder, as the task's actions; the environment clips them."""
        state = self._state(obs)
        decoded = self.prior.decode(state, self._latent(state, action))
        if self._seen is not None:
            decoded = self._seen.targets(decoded)
        arm = torch.tanh(action[..., self.arm].float()) @ self._spread
        open_ = (action[..., self.arm.stop :].float() - KEEP) / (1.0 - KEEP)
        return self._free * (decoded - self._offset) + arm + open_.clamp(0.0, 1.0) @ self._opens
