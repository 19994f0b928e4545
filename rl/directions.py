"""Directions in the space of a policy's weights, along which it may be moved as a whole.

Shapes: K directions, D observation, H units of the last hidden layer, U action size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rl.policy import Policy, PolicyError

Weights = dict[str, Tensor]
"""An actor's ``state_dict``, or a change of some of it."""


@dataclass(frozen=True)
class Directions:
    """A policy's weights and K changes of them, each for one unit of its number."""

    base: Weights
    changes: Sequence[Weights]

    def at(self, numbers: Tensor) -> Weights:
        """The weights at (K,) numbers; the policy's own at zeros."""
        there = {name: x.clone() for name, x in self.base.items()}
        for number, change in zip(numbers.tolist(), self.changes, strict=True):
            for name, x in change.items():
                there[name] += number * x
        return there


def weights_of(policy: Policy) -> Weights:
    """The actor's weights. Raises PolicyError for a baseline, which has none."""
    if policy.actor is None:
        raise PolicyError(f"'{policy.metadata['algo']}' is a baseline: it has no weights to change")
    return {name: x.detach().clone() for name, x in policy.actor.state_dict().items()}


def towards(policy: Policy, other: Policy) -> Weights:
    """What makes ``other`` of ``policy``, which keeps its own observation statistics: those of
    ``other`` go into the weights of its first layer. Exact where neither clips an observation.

    Raises PolicyError for another network, another prior or other ranges of clipping.
    """
    base, goal = weights_of(policy), weights_of(other)
    own, theirs = policy.metadata, other.metadata
    fits = {n: x.shape for n, x in base.items()} == {n: x.shape for n, x in goal.items()}
    same = ("activation", "observation_clip", "latent")
    if not fits or any(own.get(name) != theirs.get(name) for name in same):
        raise PolicyError(
            "only policies with networks, clipping and latents of one kind can be mixed"
        )
    goal = read_as(policy, other, goal)
    return {name: goal[name] - base[name] for name in base}


def read_as(policy: Policy, other: Policy, weights: Weights, prefix: str = "") -> Weights:
    """Weights of a network of ``other``'s, whose names begin with ``prefix``, for the same function
    of observations that are normalised as ``policy``'s are. Exact where neither clips."""
    first = f"{prefix}trunk.0"
    weight, bias = weights[f"{first}.weight"], weights[f"{first}.bias"]
    return {
        **weights,
        f"{first}.weight": weight * (policy.std / other.std),
        f"{first}.bias": bias + weight @ ((policy.mean - other.mean) / other.std),
    }


def scaled(change: Mapping[str, Tensor], unit: float) -> Weights:
    """The same direction in another unit."""
    return {name: unit * x for name, x in change.items()}


def moved(change: Mapping[str, Tensor], device: torch.device | str) -> Weights:
    """The same on a device."""
    return {name: x.to(device) for name, x in change.items()}


@dataclass(frozen=True)
class Phases:
    """What the last hidden layer of a policy at play does: it follows the phases of the motion."""

    middle: Tensor
    """(H,)"""
    axes: Tensor
    """(P, H): a component's value is axis . (layer - middle), 1 in root mean square."""


def phases(policy: Policy, obs: Tensor, components: int) -> Phases:
    """The mean and the strongest principal components in the observations (M, D). Raises ValueError
    where the layer has fewer of them."""
    hidden = _hidden(policy, obs)
    middle = hidden.mean(0)
    _, spread, axes = torch.linalg.svd(hidden - middle, full_matrices=False)
    if components > int((spread > 1e-6 * hidden.norm()).sum()):
        raise ValueError(f"the last hidden layer does not vary in {components} ways")
    # Along an axis the layer varies by spread / sqrt(M).
    scale = len(hidden) ** 0.5 / spread[:components, None]
    return Phases(middle.float(), (axes[:components] * scale).float())


RIDGE = 0.01
"""Of a part's phases: what is added to each variance of the rest, in shares of their mean."""


def phases_of_part(policy: Policy, obs: Tensor, part: Tensor, components: int) -> Phases:
    """Where the observations (M, D) of a part (M,) differ most from the rest: the mean of the rest,
    and the axes of the greatest quotients of the mean squares about it, within the part and in the
    rest. Along different axes the layer moves independently in both.

    Raises ValueError for a part without observations, or with all of them, and for more components
    than the layer has units.
    """
    hidden = _hidden(policy, obs)
    if not bool(part.any()) or bool(part.all()):
        raise ValueError("a part of the episodes needs something in it and something beside it")
    if components > hidden.shape[1]:
        raise ValueError(f"the last hidden layer does not vary in {components} ways")
    middle = hidden[~part].mean(0)
    within, rest = hidden[part] - middle, hidden[~part] - middle
    inside, outside = within.T @ within / len(within), rest.T @ rest / len(rest)
    outside.diagonal().add_(RIDGE * outside.diagonal().mean())
    # inside a = q outside a: with outside = L L^T, an ordinary problem in L^T a.
    lower = torch.linalg.cholesky(outside)
    half = torch.linalg.solve_triangular(lower, inside, upper=False)
    whitened = torch.linalg.solve_triangular(lower, half.T, upper=False)
    _, vectors = torch.linalg.eigh((whitened + whitened.T) / 2)
    best = vectors.flip(1)[:, :components]
    axes = torch.linalg.solve_triangular(lower.T, best, upper=True).T
    size = (within @ axes.T).square().mean(0).sqrt()
    return Phases(middle.float(), (axes / size[:, None]).float())


def _hidden(policy: Policy, obs: Tensor) -> Tensor:
    """(M, H) the last hidden layer at observations (M, D)."""
    assert policy.actor is not None
    with torch.no_grad():
        return policy.actor.trunk(policy.inputs(obs)).double()


def shifts(
    policy: Policy,
    found: Phases,
    unit: float,
    actions: Sequence[int] | None = None,
    always: bool = True,
) -> list[Weights]:
    """U (1 + P) changes of the last layer that move one action each, of all or of these: by
    ``unit`` always, or by ``unit`` times a component: more of it in one phase of the motion and
    less in another. Without ``always`` the U P latter."""
    assert policy.actor is not None
    changes: list[Weights] = []
    for action in range(policy.actor.head.out_features) if actions is None else actions:
        one = torch.zeros_like(policy.actor.head.bias)
        one[action] = unit
        if always:
            changes.append({"head.bias": one})
        changes += [
            {"head.weight": torch.outer(one, axis), "head.bias": -one * (axis @ found.middle)}
            for axis in found.axes
        ]
    return changes
