"""From a capture to a clip of our body: :func:`retarget`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from sports.humanoid.body import Body, load_body
from warmstart import rotation
from warmstart.clip import Clip, finite_difference_qvel
from warmstart.mocap.capture import KEY_JOINTS, Capture, without_t_pose
from warmstart.mocap.fit import Aim, fit
from warmstart.mocap.ground import find_contacts, ground
from warmstart.mocap.guess import first_guess
from warmstart.mocap.kinematics import Chain, matrix, quaternion
from warmstart.mocap.quality import Quality, measure

HOLD = 0.05
"""Weight of a link's first guess in the fit (m of joint error per rad)."""
STIFF = 100.0
HINGED: dict[str, float | tuple[float, float, float]] = {
    **{f"{side}_Knee": (STIFF, HOLD, STIFF) for side in "LR"},
    **{f"{side}_Elbow": HOLD for side in "LR"},
}
"""Knees keep to their hinge: it is the middle one, and near 90 degrees of flexion anything else
would spin the other two."""
SINGULAR = 1e-5
"""Cosine of a joint's middle hinge below which its other two are not told apart."""
NOISY = ("TRAM", "WHAM", "GVHMR")
"""Layouts of video tools, whose motions are smoothed."""
CUTOFF = 6.0
"""Frequency (Hz) at which the smoothing of video motions leaves half the power."""


@dataclass(frozen=True, eq=False)
class Retargeted:
    """A clip and how good it is."""

    clip: Clip
    quality: Quality

    @property
    def reasons(self) -> list[str]:
        """Why it is rejected; empty when it is good."""
        return self.quality.reasons()


def retarget(
    capture: Capture, body: str = "smpl", *, grounded: bool = True, cutoff: float | None = None
) -> Retargeted:
    """The motion of a capture on our body, hands at rest.

    ``body``: ``smpl`` or ``smplx``. ``grounded``: put the feet on the floor z = 0; without it
    heights are the source's, scaled. ``cutoff`` (Hz) smooths joints and root before the feet are
    planted; by default only motions from video are smoothed. Raises ValueError for an unknown body,
    a capture that is all T-pose, or a motion that no hinge angles can follow.
    """
    table = load_body(body)
    chain = Chain(table)
    capture = without_t_pose(capture)
    fps = capture.fps
    guess = first_guess(chain, capture)
    weights = {name: 0.5 if name in HINGED else 1.0 for name in KEY_JOINTS}
    hold = {name: HINGED.get(name, HOLD) for name in chain.names if name in _MOVING}
    root, local = fit(chain, guess.root, chain.local(guess.turn), Aim(guess.targets, weights, hold))
    if cutoff is None and capture.meta.get("layout") in NOISY:
        cutoff = CUTOFF
    if cutoff is not None:
        root, local = smooth(root, local, fps, cutoff)
    moved = np.zeros(len(root))
    if grounded:
        done = ground(chain, root, local, fps)
        root, local, contacts, moved = done.root, done.local, done.contacts, done.moved
    else:
        contacts = find_contacts(chain, chain.frames(root, local), fps)
    angles = hinge_angles(table, local)
    qpos = np.concatenate([root, quaternion(local[:, 0]), angles], axis=1)
    qpos[1:, 3:7] *= _side(qpos[:, 3:7])
    quality = measure(
        chain, chain.frames(root, local), fps, contacts, guess.targets, guess.scaled, moved
    )
    meta = {**capture.meta, "quality": {k: round(v, 5) for k, v in quality.to_json().items()}}
    qvel = finite_difference_qvel(table, qpos, fps)
    return Retargeted(Clip(fps=fps, body=body, qpos=qpos, qvel=qvel, meta=meta), quality)


_MOVING = {
    "Pelvis",
    *("Torso", "Spine", "Chest", "Neck", "Head"),
    *(
        f"{side}_{joint}"
        for side in "LR"
        for joint in ("Hip", "Knee", "Ankle", "Thorax", "Shoulder", "Elbow", "Wrist")
    ),
}


def smooth(
    root: np.ndarray, local: np.ndarray, fps: float, cutoff: float
) -> tuple[np.ndarray, np.ndarray]:
    """Zero-phase Gaussian smoothing of root (T, 3) and rotations (T, B, 3, 3); half power at
    ``cutoff`` (Hz).

    Rotations are averaged as quaternions of one sign, which is exact to second order in their
    spread within the window. Raises ValueError for a cutoff that is not positive.
    """
    if not (math.isfinite(cutoff) and cutoff > 0):
        raise ValueError(f"a cutoff of {cutoff} Hz")
    width = fps * math.sqrt(math.log(2)) / (2 * math.pi * cutoff)
    quat = quaternion(local)
    quat[1:] *= _side(quat)
    mean = gaussian_filter1d(quat, width, axis=0, mode="nearest")
    mean /= np.linalg.norm(mean, axis=-1, keepdims=True)
    return gaussian_filter1d(root, width, axis=0, mode="nearest"), matrix(mean)


def _side(quat: np.ndarray) -> np.ndarray:
    """(T - 1, ..., 1) signs that make quaternions (T, ..., 4) neighbours of those before."""
    sign = np.sign((quat[1:] * quat[:-1]).sum(-1, keepdims=True))
    return np.cumprod(np.where(sign == 0, 1.0, sign), axis=0)


def hinge_angles(body: Body, local: np.ndarray) -> np.ndarray:
    """(T, n) hinge angles (rad) of rotations (T, B, 3, 3) against the parent, intrinsic X-Y-Z.

    A rotation has two triples, (x, y, z) and (x + pi, pi - y, z + pi), and whole turns of each. The
    first frame takes the smallest, every further one the nearest to the frame before: hinges then
    run on through the singular pose; whole turns beyond the joint's range are taken back.
    """
    r = local[:, 1:]
    flat = np.hypot(r[..., 0, 0], r[..., 0, 1])
    y = np.arctan2(r[..., 0, 2], flat)
    x, z = np.arctan2(-r[..., 1, 2], r[..., 2, 2]), np.arctan2(-r[..., 0, 1], r[..., 0, 0])
    one = np.stack([x, y, z], axis=-1)
    two = np.stack([x + np.pi, np.pi - y, z + np.pi], axis=-1)
    both = np.stack([one, two], axis=-2)
    # At the singular pose only x + z counts (y = 90 degrees) or x - z (-90): the rest is kept.
    singular = flat < SINGULAR
    sense = np.sign(r[..., 0, 2])
    total = np.arctan2(sense * r[..., 2, 1], r[..., 1, 1])
    turn = 2 * np.pi
    out = np.empty_like(one)
    last = np.zeros(one.shape[1:])
    for t in range(len(one)):
        near = both[t] - turn * np.round((both[t] - last[:, None]) / turn)
        pick = np.abs(near - last[:, None]).sum(-1).argmin(-1)
        now = np.take_along_axis(near, pick[:, None, None], axis=1)[:, 0]
        for j in np.flatnonzero(singular[t]):
            s = sense[t, j]
            off = s * total[t, j] - (last[j, 0] + s * last[j, 2])
            off -= turn * np.round(off / turn)
            now[j] = last[j, 0] + off / 2, now[j, 1], last[j, 2] + s * off / 2
        last = out[t] = now
    lower = body.array("lower").reshape(-1, 3)
    upper = body.array("upper").reshape(-1, 3)
    out -= turn * np.ceil(np.maximum(0.0, out - upper) / turn - 1e-12)
    out += turn * np.ceil(np.maximum(0.0, lower - out) / turn - 1e-12)
    return out.reshape(len(out), -1)


def local_rotations(body: Body, qpos: np.ndarray) -> np.ndarray:
    """(T, B, 3, 3) parent <- link (the root: world <- root) of a clip's ``qpos``."""
    joints = rotation.from_hinges(qpos[:, 7:].reshape(len(qpos), -1, 3))
    return matrix(np.concatenate([qpos[:, None, 3:7], joints], axis=1))
