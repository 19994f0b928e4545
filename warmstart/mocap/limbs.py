"""A leg or an arm moved at its end, in closed form: the limb keeps its plane, the end its turn.

Every frame has one answer that depends smoothly on what is asked, so that a smooth correction of a
foot gives a smooth leg; an iterative fit does not, near the stretched leg.
"""

from __future__ import annotations

import numpy as np

from warmstart.mocap.capture import unit
from warmstart.mocap.kinematics import Chain, Frames, exp, swing

REACH = 0.998
"""A limb is stretched to this share of its longest at most, or as far as it was."""
OVERSTRETCHED = 0.1
"""Sine of the angle by which a limb is bent the wrong way before it is taken to be."""
HINGES = {
    "Knee": np.array([0.0, 1.0, 0.0]),
    "L_Elbow": np.array([0.0, 0.0, -1.0]),
    "R_Elbow": np.array([0.0, 0.0, 1.0]),
}
"""Axis, in the first link, about which a limb bends: knees and elbows are hinges to within a few
degrees (limits ``anatomical``)."""


def hinge_of(link: str) -> np.ndarray:
    """(3,) axis of a knee or an elbow by its link's name."""
    return HINGES["Knee"] if link.endswith("Knee") else HINGES[link]


def limb_of(side: str, kind: str) -> tuple[str, str, str]:
    """First link, second link and end of a ``leg`` or an ``arm``."""
    names = ("Hip", "Knee", "Ankle") if kind == "leg" else ("Shoulder", "Elbow", "Wrist")
    return tuple(side + name for name in names)  # type: ignore[return-value]


def bend_for(
    upper: np.ndarray,
    lower: np.ndarray,
    axis: np.ndarray,
    far: np.ndarray,
    side: float | np.ndarray = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Angle (T,) by which ``lower`` (..., 3) must turn about ``axis`` (3,) so that both bones
    together span ``far`` (T,), and the longest that they can span (T,).

    ``|u + R l|^2 = u^2 + l^2 + 2 (C + M cos(angle - middle))`` with the parts of both across the
    axis: of the two answers the one past the stretched limb (``side`` 1), or before it (-1).
    """
    along = (upper @ axis) * (lower @ axis)
    a = (upper * lower).sum(-1) - along
    b = np.cross(lower, upper) @ axis
    size, middle = np.maximum(np.hypot(a, b), 1e-12), np.arctan2(b, a)
    squares = (upper**2).sum(-1) + (lower**2).sum(-1)
    cosine = ((far**2 - squares) / 2 - along) / size
    longest = np.sqrt(squares + 2 * (along + size))
    return middle + side * np.arccos(np.clip(cosine, -1.0, 1.0)), longest


def stretch(
    chain: Chain, frames: Frames, limb: tuple[str, str, str], shift: np.ndarray
) -> np.ndarray:
    """(T,) by how much (m) the end of a limb, moved by ``shift`` (T, 3), would be out of reach."""
    first, second, end = (chain.index[name] for name in limb)
    start, tip = frames.origin[:, first], frames.origin[:, end]
    turn = np.swapaxes(frames.turn[:, first], 1, 2)
    lower = (turn @ (tip - frames.origin[:, second])[..., None])[..., 0]
    far = np.linalg.norm(tip - start, axis=1)
    _, longest = bend_for(chain.offset[second], lower, hinge_of(limb[1]), far)
    limit = np.maximum(REACH * longest, far)
    return np.maximum(0.0, np.linalg.norm(tip + shift - start, axis=1) - limit)


def move_end(
    chain: Chain,
    frames: Frames,
    local: np.ndarray,
    limb: tuple[str, str, str],
    shift: np.ndarray,
) -> None:
    """Turns the links of ``limb`` (first, second, end) in ``local`` so that the end's origin moves
    by ``shift`` (T, 3), as far as the limb reaches, and the end keeps its turn in the world.

    The second link bends about its hinge, then the limb swings as a whole.
    """
    first, second, end = (chain.index[name] for name in limb)
    start, middle, tip = (frames.origin[:, i] for i in (first, second, end))
    turn = frames.turn[:, first]
    back = np.swapaxes(turn, 1, 2)
    upper = chain.offset[second]
    lower = (back @ (tip - middle)[..., None])[..., 0]
    far = np.linalg.norm(tip - start, axis=1)
    goal = tip + shift - start
    axis = hinge_of(limb[1])
    # Which way it is bent now: a knee of a recording may be overstretched. One that is stretched
    # to within a few degrees bends as knees do.
    past = np.cross(unit(lower), unit(upper)) @ axis
    side = np.where(past > OVERSTRETCHED, -1.0, 1.0)
    now, longest = bend_for(upper, lower, axis, far, side)
    want = np.clip(np.linalg.norm(goal, axis=1), 0.3 * longest, np.maximum(REACH * longest, far))
    # Both answers hold the same rounding, so that nothing asked is nothing done.
    then, _ = bend_for(upper, lower, axis, np.where(shift.any(1), want, far), side)
    bend = exp((then - now)[:, None] * axis)
    span = upper + (bend @ lower[..., None])[..., 0]
    whole = swing(unit((turn @ span[..., None])[..., 0]), unit(goal))
    new_first = whole @ turn
    new_second = new_first @ bend @ local[:, second]
    local[:, first] = np.swapaxes(frames.turn[:, chain.parent[first]], 1, 2) @ new_first
    local[:, second] = bend @ local[:, second]
    local[:, end] = np.swapaxes(new_second, 1, 2) @ frames.turn[:, end]
