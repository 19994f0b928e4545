"""The mean of policies' weights: of one run at several times, or of runs that began alike.

Noise moves each state of a run another way from what all have learned, and the mean of their
weights undoes much of that: Izmailov et al. 2018, "Averaging Weights Leads to Wider Optima and
Better Generalization"; across runs, Wortsman et al. 2022, "Model soups". It holds for policies that
are near each other, not for two that learned apart from the beginning.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
from collections.abc import Sequence

import torch
from safetensors.torch import save
from torch import Tensor

from rl.directions import Directions, Weights, read_as, towards, weights_of
from rl.policy import Policy, PolicyError

ALIKE = ("task", "algo", "body", "strength", "limits", "obs_layout", "hidden")
"""What the cards of policies must agree about, beside what ``rl.directions.towards`` asks for."""


def mean_policy(policies: Sequence[Policy], shares: Sequence[float] | None = None) -> Policy:
    """The policy of the mean weights.

    It has the card, the observation statistics and the prior of the first; the others' first
    layers are put in terms of its statistics, which changes nothing but where the clip of an
    observation begins. The critics' mean comes along where all have one.

    Args:
        policies: two or more. A state that comes twice, as a run's last one does beside the files
            of ``--keep-policies``, counts once where no shares are given.
        shares: of each, not negative, of any sum above 0; equal if None.

    Raises PolicyError where the policies have not the same task, body and networks, and ValueError
    for shares that cannot be.
    """
    if shares is None:
        once: dict[str, Policy] = {}
        for policy in policies:
            once.setdefault(_state(policy), policy)
        policies = list(once.values())
    if len(policies) < 2:
        raise ValueError("a mean takes two policies or more that differ")
    wanted = [1.0] * len(policies) if shares is None else [float(share) for share in shares]
    if len(wanted) != len(policies):
        raise ValueError(f"{len(policies)} policies need as many shares, not {len(wanted)}")
    if not all(math.isfinite(share) and share >= 0.0 for share in wanted) or sum(wanted) <= 0.0:
        raise ValueError(f"shares must not be negative, and not all 0: {tuple(wanted)}")
    parts = [share / sum(wanted) for share in wanted]
    first, *others = policies
    base = weights_of(first)
    for other in others:
        _same_kind(first, other)
    ways = Directions(base, [towards(first, other) for other in others])
    weights = ways.at(torch.tensor(parts[1:], dtype=torch.float64))
    before = {key: told for key, told in first.metadata.items() if key != "averaged"}
    card = {
        **before,
        "metrics": {},
        "averaged": [  # behind what was done before
            {"sha256": p.metadata["sha256"], "samples": p.metadata.get("samples"), "share": part}
            for p, part in zip(policies, parts)
        ],
        "sha256": hashlib.sha256(save(weights)).hexdigest(),
    }
    card.pop("looks", None)
    assert first.actor is not None
    actor = copy.deepcopy(first.actor)
    actor.load_state_dict(weights)
    return Policy(actor, first.mean, first.std, card, _mean_critic(policies, parts), first.prior)


def _state(policy: Policy) -> str:
    """What a state of one run keeps when it is exported, and no other has."""
    card = policy.metadata
    told = [card.get(name) for name in ("samples", "minutes", "polish", "averaged")]
    return json.dumps(told if card.get("minutes") else card["sha256"])


def _same_kind(first: Policy, other: Policy) -> None:
    """Raises PolicyError where two policies' weights do not mean the same."""
    weights_of(other)  # a baseline has none
    for name in ALIKE:
        one, two = first.metadata.get(name), other.metadata.get(name)
        if one != two:
            raise PolicyError(
                f"policies of a mean must be of one kind, and these differ in "
                f"{name.replace('_', ' ')}: {one} and {two}"
            )


def _mean_critic(policies: Sequence[Policy], parts: Sequence[float]) -> dict[str, Tensor]:
    """Of the critics and their statistics; nothing where one is missing or another network."""
    first = policies[0]
    fits = {k: v.shape for k, v in first.extra.items()}
    if not fits or any({k: v.shape for k, v in p.extra.items()} != fits for p in policies):
        return {}
    critics: list[Weights] = [read_as(first, p, p.extra, "critic.") for p in policies]
    mean = dict(critics[0])
    for name, value in mean.items():
        if value.is_floating_point():  # else what says which features stay as they are
            mean[name] = sum((part * c[name] for part, c in zip(parts, critics)), 0.0 * value)
    return mean
