"""Fixed features of 1 s windows of motion, the same numbers on every machine and for every policy.

Nothing is learned: an encoder trained on motions would be blind to what its training set lacks,
and one trained on those under test would say what it is asked. A window of 31 frames becomes 32
numbers:

* 24 random projections of its slow part: of each channel of the posture (see ``channels``) the
  first four coefficients of the cosine transform (DCT-II), that is its mean and what varies below
  2 Hz, summed with signs that a hash draws (Achlioptas 2003: signs keep distances as well as normal
  numbers do; a hash, unlike a generator, is the same in all versions of all libraries);
* 8 energies, log10: of joint rotation and of the paths of head, hands and feet, in four bands
  (0.5 to 1.5, 2 to 3.5, 4 to 7.5, 8 to 15 Hz). Projections of four coefficients do not see
  jitter; these do.

Units are divided by fixed scales, those of ordinary motion, and each family of channels has the
same weight however many channels it has.
"""

from __future__ import annotations

import hashlib
from functools import cache

import numpy as np
import scipy.fft

from rl.likeness_motion import Motion
from rl.likeness_terms import KEY_LINKS, WINDOW, path, windows
from sports.humanoid.body import Body, is_finger, load_body
from warmstart import rotation
from warmstart.library import FPS

NAME = "olympics-opt likeness features 1"
"""Of this definition, in reference files: features of two definitions do not compare."""
SLOW = 4
"""Coefficients of the cosine transform that are projected."""
PROJECTIONS = 24
BANDS = ((1, 4), (4, 8), (8, 16), (16, 31))
"""Coefficients [first, end) of each band; coefficient k is k / 2 Hz."""
SIZE = PROJECTIONS + 2 * len(BANDS)
"""Features D of a window."""
LEAST = (1e-3, 1e-4)
"""(rad/s)^2 and (m/s)^2 below which an energy counts as rest."""
SCALES = {
    "height": 0.3,
    "attitude": 0.3,
    "velocity": 1.5,
    "spin": 2.0,
    "joints": 0.3,
    "joint_spin": 3.0,
    "places": 0.3,
}
"""m, 1, m/s, rad/s, 1, rad/s, m."""


def window_features(motion: Motion) -> np.ndarray:
    """(W, D) of the windows of a motion; W = 0 for one shorter than a second."""
    starts = windows(len(motion.qpos))
    if not len(starts):
        return np.zeros((0, SIZE))
    families, spin, speed = channels(motion)
    flat = np.concatenate(list(families.values()), 1)  # (T, C)
    rows = np.arange(WINDOW) + np.asarray(starts)[:, None]
    slow = _cosines(flat[rows])[:, :SLOW]  # (W, 4, C)
    sign = projection(SLOW * flat.shape[1])
    projected = slow.reshape(len(slow), -1) @ sign.T
    energies = [
        np.log10((_cosines(x[rows])[:, a:b] ** 2).sum(1).mean(-1) + least)
        for x, least in zip((spin, speed), LEAST)
        for a, b in BANDS
    ]
    return np.concatenate((projected, np.stack(energies, 1)), 1)


def channels(motion: Motion) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Channels of each frame by family, scaled and weighted; joint spins and speeds in units.

    Vectors are in the heading frame (yaw of the pelvis), so that where the athlete is and which
    way it faces do not matter. ``height`` of the pelvis above the ground; ``attitude`` of the
    pelvis and ``joints``: the first two columns of rotation matrices (Zhou et al. 2019);
    ``velocity`` and ``spin`` of the pelvis; ``joint_spin``: angular velocity of each link against
    its parent, in its own frame; ``places`` of head, hands and feet from the pelvis. Fingers are
    left out, and SMPL's stiff hand, so that both bodies have the same channels.

    Returns the families ((T, C) each), (T, 3 J) joint spins (rad/s) and (T, 15) velocities (m/s)
    of head, hands and feet against the pelvis.
    """
    body = load_body(motion.body)
    links = path(motion)
    root = links.pos[:, 0]
    heading = _heading(links.quat[:, 0])  # (T, 4)
    back = rotation.conjugate(heading)
    joints = [i - 1 for i in shown_joints(body)]
    local = rotation.from_hinges(motion.qpos[:, 7:].reshape(len(root), -1, 3))[:, joints]
    spin = rotation.spin(local, FPS)
    keys = [body.link_index(name) for name in KEY_LINKS]
    arms = links.pos[:, keys] - root[:, None]
    here = rotation.rotate(np.broadcast_to(back[:, None], (*arms.shape[:2], 4)), arms)
    velocity = np.gradient(root, 1.0 / FPS, axis=0)
    attitude = rotation.multiply(back, links.quat[:, 0])
    families = {
        "height": root[:, 2:],
        "attitude": _two_columns(attitude),
        "velocity": rotation.rotate(back, velocity),
        "spin": rotation.rotate(back, links.angvel[:, 0]),
        "joints": _two_columns(local),
        "joint_spin": spin,
        "places": here,
    }
    weighted = {}
    for name, values in families.items():
        rows = values.reshape(len(root), -1)
        weighted[name] = rows / (SCALES[name] * np.sqrt(rows.shape[1]))
    speed = np.gradient(arms, 1.0 / FPS, axis=0)
    return weighted, spin.reshape(len(root), -1), speed.reshape(len(root), -1)


def shown_joints(body: Body) -> list[int]:
    """Indices of the links whose joints are channels: those that SMPL and SMPL-X share."""
    names = body.link_names
    return [i for i in range(1, len(names)) if not (is_finger(names[i]) or names[i][2:] == "Hand")]


@cache
def projection(size: int) -> np.ndarray:
    """(PROJECTIONS, size) of +-1: bits of SHAKE-256 of the definition's name and the row."""
    rows = []
    for row in range(PROJECTIONS):
        stream = hashlib.shake_256(f"{NAME} {row}".encode()).digest((size + 7) // 8)
        bits = np.unpackbits(np.frombuffer(stream, np.uint8))[:size]
        rows.append(2.0 * bits - 1.0)
    return np.array(rows)


def _cosines(x: np.ndarray) -> np.ndarray:
    """(W, T, C) -> coefficients (W, T, C), so scaled that their squares sum to the mean square."""
    return scipy.fft.dct(x, type=2, norm="ortho", axis=1) / np.sqrt(x.shape[1])


def _heading(quat: np.ndarray) -> np.ndarray:
    """(T, 4) rotation about z by the yaw of attitudes (T, 4), that of the pelvis' x axis."""
    ahead = rotation.rotate(quat, np.broadcast_to([1.0, 0.0, 0.0], (len(quat), 3)))
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    return rotation.exp(yaw[:, None] * np.array([0.0, 0.0, 1.0]))


def _two_columns(quat: np.ndarray) -> np.ndarray:
    """(..., 6) first two columns of the matrices of (..., 4)."""
    columns = [
        rotation.rotate(quat, np.broadcast_to(axis, (*quat.shape[:-1], 3)))
        for axis in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    ]
    return np.concatenate(columns, -1)
