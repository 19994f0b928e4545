"""A leg or an arm moved at its end, in closed form: the limb keeps its plane, the end its turn.

Every frame has one answer that depends smoothly on what is asked, so that a smooth correction of a
foot gives a smooth leg; an iterative fit does not, near the stretched leg.
"""

from __future__ import annotations

import numpy as np

from warmstart.mocap.capture import unit
from warmstart.mocap.kinematics import Chain, Frames, exp, swing

REACH = 0.998
"""A limb is stretched to this share of its length at most, or as far as it was."""


def stretch(chain: Chain, frames: Frames, limb: tuple[str, str, str], shift: np.ndarray) -> np.ndarray:
    """(T,) by how much (m) the end of a limb, moved by ``shift`` (T, 3), would be out of reach."""
    start, middle, end = (frames.origin[:, chain.index[name]] for name in limb)
    full = chain.length(limb[0], limb[1]) + chain.length(limb[1], limb[2])
    limit = np.maximum(REACH * full, np.linalg.norm(end - start, axis=1))
    return np.maximum(0.0, np.linalg.norm(end + shift - start, axis=1) - limit)


def move_end(
    chain: Chain,
    frames: Frames,
    local: np.ndarray,
    limb: tuple[str, str, str],
    hinge: np.ndarray,
    shift: np.ndarray,
) -> None:
    """Turns the links of ``limb`` (first, second, end) in ``local`` so that the end's origin moves
    by ``shift`` (T, 3), as far as the limb reaches, and the end keeps its turn in the world.

    ``hinge`` (3,): axis in the first link about which the limb bends, which leads where the limb is
    stretched and shows no plane.
    """
    first, second, end = (chain.index[name] for name in limb)
    a, b, c = (frames.origin[:, i] for i in (first, second, end))
    upper, lower = b - a, c - b
    la, lb = np.linalg.norm(upper, axis=1), np.linalg.norm(lower, axis=1)
    far = np.linalg.norm(c - a, axis=1)
    goal = c + shift - a
    limit = np.maximum(REACH * (la + lb), far)
    want = np.clip(np.linalg.norm(goal, axis=1), 0.3 * far, limit)
    along = unit(upper)
    axis = frames.turn[:, first] @ hinge
    axis = unit(axis - (axis * along).sum(1, keepdims=True) * along)
    plane = np.cross(upper, lower) / (la * lb)[:, None]
    plane = np.where((plane * axis).sum(1, keepdims=True) < 0, -plane, plane)
    axis = unit(plane + 0.05 * axis)
    bend = _bend(la, lb, want) - _bend(la, lb, far)
    knee = exp(bend[:, None] * axis)
    turned = upper + (knee @ lower[..., None])[..., 0]
    whole = swing(unit(turned), unit(goal))
    parent = frames.turn[:, chain.parent[first]]
    new_first = whole @ frames.turn[:, first]
    new_second = whole @ knee @ frames.turn[:, second]
    local[:, first] = np.swapaxes(parent, 1, 2) @ new_first
    local[:, second] = np.swapaxes(new_first, 1, 2) @ new_second
    local[:, end] = np.swapaxes(new_second, 1, 2) @ frames.turn[:, end]


def _bend(a: np.ndarray, b: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Angle between two bones whose far ends are ``far`` apart: 0 when stretched (rad)."""
    return np.arccos(np.clip((far**2 - a**2 - b**2) / (2 * a * b), -1.0, 1.0))
