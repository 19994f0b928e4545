"""The mean of policies' weights: of one run at several times, or of runs that began alike.

Noise moves each state of a run another way from what all have learned, and the mean of their
weights undoes much of that: Izmailov et al. 2018, "Averaging Weights Leads to Wider Optima and
Better Generalization"; across runs, Wortsman et al. 2022, "Model soups". It holds for policies that
are near each other, not for two that learned apart from the beginning.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence

import torch
from safetensors.torch import save
from torch import Tensor

from rl.networks import MLP
from rl.policy import Policy, PolicyError

ALIKE = (
    "task",
    "algo",
    "body",
    "strength",
    "limits",
    "obs_size",
    "obs_layout",
    "action_size",
    "hidden",
    "activation",
    "observation_clip",
    "latent",
)
"""What the cards of policies must agree about."""
_FIRST = "trunk.0"
"""The layer that reads the observation."""


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
        once: dict[tuple[object, ...], Policy] = {}
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
    first = policies[0]
    for other in policies:
        _same_kind(first, other)
    actors = [_read_as(_actor(p).state_dict(), "", p, first) for p in policies]
    actor = _mean(actors, parts)
    card = {
        **first.metadata,
        "metrics": {},
        "averaged": [
            {"sha256": p.metadata["sha256"], "samples": p.metadata.get("samples"), "share": part}
            for p, part in zip(policies, parts)
        ],
        "sha256": hashlib.sha256(save(actor)).hexdigest(),
    }
    card.pop("looks", None)
    sizes = [card["obs_size"], *card["hidden"], card["action_size"]]
    network = MLP(sizes[0], sizes[1:-1], sizes[-1], card["activation"])
    network.load_state_dict(actor)
    network.requires_grad_(False)
    extra: dict[str, Tensor] = {}
    if all({k: v.shape for k, v in p.extra.items()} == _shapes(first) for p in policies):
        critics = [_read_as(p.extra, "critic.", p, first) for p in policies]
        extra = _mean(critics, parts)
    return Policy(network, first.mean, first.std, card, extra, first.prior)


def _state(policy: Policy) -> tuple[object, ...]:
    """What tells one state of one run from all others: how far it is, to the last digit."""
    card = policy.metadata
    return (card.get("samples"), card.get("minutes")) if card.get("minutes") else (card["sha256"],)


def _shapes(policy: Policy) -> dict[str, torch.Size]:
    return {k: v.shape for k, v in policy.extra.items()}


def _actor(policy: Policy) -> MLP:
    if policy.actor is None:
        raise PolicyError(f"'{policy.metadata['algo']}' is a baseline: it has no weights")
    return policy.actor


def _same_kind(first: Policy, other: Policy) -> None:
    """Raises PolicyError where two policies' weights do not mean the same."""
    for policy in (first, other):
        _actor(policy)
    for name in ALIKE:
        one, two = first.metadata.get(name), other.metadata.get(name)
        if one != two:
            raise PolicyError(
                f"policies of a mean must be of one kind, and these differ in "
                f"{name.replace('_', ' ')}: {one} and {two}"
            )


def _read_as(
    weights: dict[str, Tensor], prefix: str, own: Policy, first: Policy
) -> dict[str, Tensor]:
    """Weights of a network that reads observations by ``own``'s statistics, for the same function
    of those by ``first``'s: (x - m) / s = ((x - m') / s') * (s' / s) + (m' - m) / s."""
    w, b = f"{prefix}{_FIRST}.weight", f"{prefix}{_FIRST}.bias"
    if w not in weights:
        return dict(weights)
    scale = (first.std.double() / own.std.double())[None, :]
    shift = (first.mean.double() - own.mean.double()) / own.std.double()
    matrix = weights[w].double()
    return {**weights, w: matrix * scale, b: weights[b].double() + matrix @ shift}


def _mean(networks: Sequence[dict[str, Tensor]], parts: Sequence[float]) -> dict[str, Tensor]:
    """Each number's mean, in the type that the first network's has; what is no number is its."""
    mean = {}
    for name, value in networks[0].items():
        if value.dtype == torch.bool:
            mean[name] = value
            continue
        total = sum(part * n[name].double() for n, part in zip(networks, parts))
        assert isinstance(total, Tensor)
        kind = torch.float64 if name.startswith("value_norm.") else torch.float32
        mean[name] = total.to(kind).contiguous()
    return mean
