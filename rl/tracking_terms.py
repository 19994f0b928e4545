"""What a tracker sees, does and earns: pure functions of the athlete's links and a reference's."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rl.motion import Reference
from sports.frames import Heading
from sports.turns import nearest_turn


def goal_features(heading: Heading, body: Reference, goal: Reference) -> dict[str, Tensor]:
    """The 24 B numbers about a reference frame that a tracker sees (SMPL 576), by name (N, k).

    All in the heading frame of the athlete: of each link the differences of position 3, rotation
    6, linear and angular velocity 3 + 3 (reference minus athlete), then the reference's position
    from the athlete's root 3 and rotation 6. The difference of rotations is R_ref R^T; of rotation
    matrices the first two columns count (6-D). ``heading`` (N, 1); source: Luo et al. 2023, 3.1.
    """

    def local(v: Tensor) -> Tensor:
        return heading.local(v[:, None])[:, 0]

    own, wanted = body.rot, goal.rot
    # Columns of R_ref R^T in the world; those of H^T (.) H in the heading frame by c and s.
    turn = (wanted[..., :, None, :] * own[..., None, :, :]).sum(-1)
    c, s = heading.cos[:, 0, None, None], heading.sin[:, 0, None, None]
    first, second = turn[..., 0], turn[..., 1]
    columns = torch.stack((c * first + s * second, c * second - s * first), -2)
    root = body.pos[:, :1]
    return {
        "position_difference": local(goal.pos - body.pos).flatten(1),
        "rotation_difference": local(columns).flatten(1),
        "velocity_difference": local(goal.linvel - body.linvel).flatten(1),
        "spin_difference": local(goal.angvel - body.angvel).flatten(1),
        "reference_position": local(goal.pos - root).flatten(1),
        "reference_rotation": local(wanted[..., :2].transpose(-1, -2)).flatten(1),
    }


def tracking_errors(body: Reference, reference: Reference) -> Tensor:
    """(N, 4) mean over the links of the squared distance (m^2), angle (rad^2), difference of
    velocities (m^2/s^2) and of angular velocities (rad^2/s^2)."""
    trace = (body.rot * reference.rot).sum((-1, -2))
    angle = torch.acos((0.5 * (trace - 1.0)).clamp(-1.0, 1.0))
    squares = (
        (body.pos - reference.pos).square().sum(-1),
        angle.square(),
        (body.linvel - reference.linvel).square().sum(-1),
        (body.angvel - reference.angvel).square().sum(-1),
    )
    return torch.stack([x.mean(-1) for x in squares], -1)


def contact_mismatch(touching: Tensor, reference: Tensor) -> Tensor:
    """(N,) links whose contact with the ground differs: ``touching`` (N, B) bool against 1 (on the
    ground), -1 (off it) and 0 (either way) of ``reference`` (N, B)."""
    touches = touching.float()
    return torch.where(reference > 0, 1.0 - touches, touches * (reference < 0)).sum(-1)


def wrapped(angle: Tensor) -> Tensor:
    """The same angle (rad) in [-pi, pi)."""
    return torch.remainder(angle + math.pi, 2.0 * math.pi) - math.pi


def residual_targets(qpos: Tensor, reference: Tensor, action: Tensor, scale: float) -> Tensor:
    """PD targets (rad): the reference's angle, on the turn that a hinge is in, plus ``scale``
    times the action. All (..., n)."""
    return qpos + wrapped(reference - qpos) + scale * action


def least_turn(qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
    """The same states (..., 7 + n), (..., 6 + n) with the hinge angles nearest to zero: an action
    reaches no other turn, and nobody can see in which one a hinge is."""
    angle, flipped = nearest_turn(qpos[..., 7:], torch.zeros_like(qpos[..., 7:]))
    rates = qvel[..., 6:].unflatten(-1, (-1, 3))
    x, y, z = rates.unbind(-1)
    rates = torch.stack((x, torch.where(flipped, -y, y), z), -1).flatten(-2)
    return torch.cat((qpos[..., :7], angle), -1), torch.cat((qvel[..., :6], rates), -1)
