"""The two triples of hinge angles that make one rotation of a joint, and their whole turns.

Observations show rotations, so nobody can see on which turn the hinges of a joint stand.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def nearest_turn(angle: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """Hinge angles (..., n) of the same rotations of all joints, nearest to ``near`` (..., n), and
    (..., n / 3) bool, whether a joint's are of the other kind.

    Rx(a) Ry(b) Rz(c) = Rx(a + pi) Ry(pi - b) Rz(c + pi): every rotation has two triples of hinge
    angles, up to whole turns. Servos do the same in either, b's in the mirror.
    """
    own, near = angle.unflatten(-1, (-1, 3)), near.unflatten(-1, (-1, 3))
    a, b, c = own.unbind(-1)
    other = torch.stack((a + math.pi, math.pi - b, c + math.pi), -1)
    turn = 2.0 * math.pi
    pair = [x + turn * torch.round((near - x) / turn) for x in (own, other)]
    far, far_other = ((x - near).square().sum(-1) for x in pair)
    flipped = far_other < far
    return torch.where(flipped[..., None], pair[1], pair[0]).flatten(-2), flipped
