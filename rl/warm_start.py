"""Starting a task from a policy of another: weights follow the names of what they look at.

An actor reads slices of an observation with names (``body_pos``, ``goal/ball``, ...). A policy for
one athlete, against a machine or nobody, becomes one for a contest: the columns of its first layer
go to the slices of the same names, and those of slices it has never seen, such as the opponent,
are zero. In the beginning it therefore plays as before, whatever the opponent does. The same goes
for a task whose options show more than the policy's did. Where actions are around another pose,
its last layer is made to ask for the same joint angles.

One that acts through a latent prior may also begin another body's task, where the athlete is its
own with fingers (``rl.prior_body``). What it read of a link it reads of the same; of a hand that is
wrist and fingers there, of the wrist, which turns alike and is near, so that it plays nearly as
before. Numbers that it does not have, an arm's own share and the hands', begin with 0.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F

from rl.config import TRACKING
from rl.latent_action import as_told
from rl.networks import MLP
from rl.policy import Policy, PolicyError, read_policy
from rl.prior_body import counterparts
from sports.env import make_scene
from sports.frames import proprioception_slices
from sports.humanoid.body import Body, load_body
from sports.registry import task_names

ALIASES: dict[str, tuple[str, ...]] = {
    "goal/other_goal": ("goal/goal",),
    "goal/ball_position": ("goal/ball_pos",),
    "goal/ball_rotation": ("goal/ball_rot",),
    "goal/ball_velocity": ("goal/ball_linvel", "goal/ball_angvel"),
}
"""What other tasks call the same thing, or its parts in order."""


def load_start(source: str, env: Any, task: str) -> tuple[Policy, torch.Tensor]:
    """A policy to begin training with, and (D,) bool the features that it has never seen.

    A policy of the task itself is returned as it is, unless the task's options show more than the
    policy knows. One of another task must move the same body with the same actions; its card then
    says the task and layout of the environment.
    Raises PolicyError for a policy that cannot be used.
    """
    policy = _with_arms_and_hands(read_policy(source, task), env)
    found = policy.metadata["task"]
    if policy.actor is None:
        raise ValueError(f"--init {source} is a baseline: there is nothing to start from")
    if found == task and not _sees_more(policy, env):
        policy.check(env)
        return policy, torch.zeros(env.obs_size, dtype=torch.bool)
    _same_athlete(policy, env, task, source)
    policy, unseen = _moved(policy, env, task)
    policy.check(env)
    return policy, unseen


def _with_arms_and_hands(policy: Policy, env: Any) -> Policy:
    """The policy with a 0 for each number of the environment's latent actions that it lacks, and
    as it is where it lacks none or acts in another way."""
    layer, own = getattr(env, "layer", None), policy.metadata.get("latent")
    if layer is None or policy.actor is None or not isinstance(own, dict):
        return policy
    own = as_told(own)
    more = {k: v for k, v in layer.card.items() if own.get(k) != v}
    if not more or more.keys() - {"arm_residual", "hands"} or any(own[name] for name in more):
        return policy
    weights = dict(policy.actor.state_dict())
    size = len(weights["head.bias"])
    if size not in (layer.arm.start, layer.arm.stop) or own["hands"]:
        return policy  # of another arm; or the arm's numbers would come before those of the hands
    rows = layer.size - size
    weights["head.weight"] = F.pad(weights["head.weight"], (0, 0, 0, rows))
    weights["head.bias"] = F.pad(weights["head.bias"], (0, rows))
    card = policy.metadata | {"latent": layer.card, "action_size": layer.size}
    actor = MLP(card["obs_size"], tuple(card["hidden"]), layer.size, card["activation"])
    actor.load_state_dict(weights)
    made = Policy(actor.requires_grad_(False), policy.mean, policy.std, card, prior=policy.prior)
    made.extra = policy.extra
    return made


def _sees_more(policy: Policy, env: Any) -> bool:
    """Whether the environment shows all that the policy knows by name, and something else."""
    layout = policy.metadata.get("obs_layout") or {}
    known = {name: stop - start for name, (start, stop) in layout.items()}
    shown = {name: s.stop - s.start for name, s in env.obs_slices.items()}
    return bool(known) and known.items() < shown.items()


def _same_athlete(policy: Policy, env: Any, task: str, source: str) -> None:
    """Raises PolicyError where an action would mean another thing."""
    card = policy.metadata
    found, body = card["task"], getattr(env.task, "body", "none")
    where = f"the policy '{source}' of task '{found}' cannot start '{task}'"
    if card["body"] != body and not _acts_alike(policy, env):
        raise PolicyError(f"{where}: its body is '{card['body']}', not '{body}'")
    if card["action_size"] != env.action_size:
        raise PolicyError(
            f"{where}: it has {card['action_size']} actions, the task {env.action_size}"
        )
    if not isinstance(card.get("obs_layout"), dict):
        raise PolicyError(f"{where}: its card does not say what it observes")
    if TRACKING in (found, task):
        raise PolicyError(f"{where}: actions of '{TRACKING}' are around the clips' poses")


def _acts_alike(policy: Policy, env: Any) -> bool:
    """Whether latents of a policy of another body mean the same to the environment's athlete."""
    layer = getattr(env, "layer", None)
    if layer is None or policy.prior is None or layer.prior.digest != policy.prior.digest:
        return False
    try:
        counterparts(load_body(policy.metadata["body"]), env.physics.scene.body)
    except ValueError:
        return False
    return True


def _links_read(known: Body, body: Body) -> dict[int, list[int]]:
    """For each feature of ``body`` those of the ``known`` one that are read of it: of the same link
    first, then of links that are parts of it there."""
    here, there = (proprioception_slices(x.num_links) for x in (body, known))
    found = counterparts(known, body)
    order = sorted(range(known.num_links), key=lambda i: known.link_names[i] not in body.link_names)
    read = {0: [0]}  # the root's height
    for name, width in (("body_pos", 3), ("body_rot", 6), ("body_linvel", 3), ("body_angvel", 3)):
        skipped = int(name == "body_pos")  # the root has no position
        for i in (i for i in order if i >= skipped):
            to = here[name].start + width * (found[i] - skipped)
            of = there[name].start + width * (i - skipped)
            for k in range(width):
                read.setdefault(to + k, []).append(of + k)
    return read


def _moved(policy: Policy, env: Any, task: str) -> tuple[Policy, torch.Tensor]:
    assert policy.actor is not None
    card, layout = policy.metadata, policy.metadata["obs_layout"]
    columns = torch.full((env.obs_size,), -1)
    """Column of the policy for each feature; -1 for none."""
    for name, own in env.obs_slices.items():
        names = (name,) if name in layout else ALIASES.get(name, ())
        spans = [range(*layout[part]) for part in names if part in layout]
        known = [column for span in spans for column in span]
        if len(known) == own.stop - own.start:
            columns[own] = torch.tensor(known)
    body = env.physics.scene.body
    read = {} if card["body"] == body.name else _links_read(load_body(card["body"]), body)
    for to, parts in read.items():
        columns[to] = parts[0]
    new = columns < 0
    if bool(new.all()):
        raise PolicyError(
            f"the policy of task '{card['task']}' and task '{task}' observe nothing in common"
        )
    old = columns.clamp(min=0)
    weights = dict(policy.actor.state_dict())
    before = weights["trunk.0.weight"]
    weights["trunk.0.weight"] = before[:, old].masked_fill(new, 0.0)
    for to, (whole, *parts) in read.items():  # parts: as the whole, but for where they are
        for part in parts:
            share = policy.std[whole] / policy.std[part]
            weights["trunk.0.weight"][:, to] += share * before[:, part]
    if card["task"] in task_names() and getattr(env, "layer", None) is None:
        # The same PD targets: offset + scale a of one task in terms of the other's.
        scene = make_scene(card["task"], limits=card["limits"])
        offset, scale = (
            torch.as_tensor(x, dtype=torch.float32, device=env.device)
            for x in (scene.action_offset(), scene.body.action_scale())
        )
        ratio = (scale / env.action_scale).cpu()
        shift = ((offset - env.action_offset) / env.action_scale).cpu()
        weights["head.weight"] = ratio[:, None] * weights["head.weight"]
        weights["head.bias"] = ratio * weights["head.bias"] + shift
    sizes = (env.obs_size, tuple(card["hidden"]), card["action_size"])
    actor = MLP(*sizes, card["activation"])
    actor.load_state_dict(weights)
    layout = {k: [s.start, s.stop] for k, s in env.obs_slices.items()}
    shown = {"obs_size": env.obs_size, "obs_layout": layout}
    card = {**card, "task": task, "body": body.name, **shown}
    mean = policy.mean[old].masked_fill(new, 0.0)
    std = policy.std[old].masked_fill(new, 1.0)
    return Policy(actor.requires_grad_(False), mean, std, card, prior=policy.prior), new
