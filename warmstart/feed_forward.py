"""PD targets that would carry a recorded motion, if it were physical: inverse dynamics of a clip.

A recording says where a person was, not which forces were at work. Here the forces of the floor on
whatever is near it are found so that nothing is left over at the root, as far as pushes within
friction can do that; what is left over says how far from physics the motion is. The joints'
torques then follow, and from them the targets at which our servos give these torques. They are a
start for :mod:`warmstart.tracking`, which decides what is really played.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import nnls

from sports.humanoid.body import Body
from sports.humanoid.mjcf import body_name, build_model
from warmstart.clip import Clip
from warmstart.mocap.kinematics import Chain

GRAVITY = 9.81
NEAR = 0.04
"""A point of the body within this height (m) may be pushed by the floor..."""
TOUCH, REST = 0.01, 0.4
"""... at a cost that grows with its height over the first (m) and its speed over the second
(m/s), squared: what stands carries, not what swings past."""
FRICTION = 0.9
"""Of the pyramid of pushes: a little less than the floor's, 1."""
COST = 1e-5
"""Of a push, against what is left over at the root; both squared, in weights of the body."""
ARM = 0.3
"""Length (m) that makes a moment comparable with a force."""
SMOOTH = 0.02
"""Standard deviation (s) of the smoothing of velocities before accelerations are taken."""
_EDGES = np.array(
    [[FRICTION, 0.0, 1.0], [-FRICTION, 0.0, 1.0], [0.0, FRICTION, 1.0], [0.0, -FRICTION, 1.0]]
)


@dataclass(frozen=True, eq=False)
class Forces:
    """What moves a clip, between each frame and the next (K = T - 1)."""

    torque: np.ndarray
    """(K, n) of the servos (N m), whatever they can give."""
    floor: np.ndarray
    """(K, 3) force of the floor on the athlete (N)."""
    left_over: np.ndarray
    """(K, 6) force (N) and moment at the root (N m) that no push of the floor explains."""
    targets: np.ndarray
    """(K, n) PD targets that give the torque, within the servos' limits (rad)."""


def forces_of(clip: Clip, body: Body) -> Forces:
    """Inverse dynamics of a clip of the body ``body``, at the middle between its frames.

    Raises ValueError when the clip is of another body.
    """
    if clip.body != body.name:
        raise ValueError(f"the clip is of body '{clip.body}', not of '{body.name}'")
    model = build_model(body)
    model.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    )
    data, chain = mujoco.MjData(model), Chain(body)
    links = np.array([model.body(body_name(0, name)).id for name in body.link_names])
    middle = clip.at((np.arange(clip.num_frames - 1) + 0.5) / clip.fps)
    smooth = gaussian_filter1d(clip.qvel, SMOOTH * clip.fps, axis=0, mode="nearest")
    qacc = np.diff(smooth, axis=0) * clip.fps
    frames = len(qacc)
    torque, floor, left_over = np.empty((frames, body.num_dofs)), *np.zeros((2, frames, 6))
    for t in range(frames):
        data.qpos[:], data.qvel[:] = middle["qpos"][t], middle["qvel"][t]
        data.qacc[:] = qacc[t]
        mujoco.mj_inverse(model, data)
        need = data.qfrc_inverse.copy()
        near, lean = _near_floor(chain, data, links)
        if len(near):
            push, jac = _pushes(model, data, chain, links, near, lean, need[:6], body.mass)
            need -= np.einsum("pd,pdv->v", push, jac)
            floor[t, :3] = push.sum(0)
        torque[t], left_over[t] = need[6:], need[:6]
    effort, kp, limit = body.array("effort"), body.array("kp"), body.action_scale()
    targets = middle["qpos"][:, 7:] + np.clip(torque, -effort, effort) / kp
    return Forces(torque, floor[:, :3], left_over, np.clip(targets, -limit, limit))


def with_targets(clip: Clip, body: Body) -> tuple[Clip, Forces]:
    """The clip with the targets of :func:`forces_of`; the last row repeats the one before."""
    forces = forces_of(clip, body)
    ctrl = np.concatenate([forces.targets, forces.targets[-1:]])
    return replace(clip, ctrl=ctrl), forces


def _near_floor(
    chain: Chain, data: mujoco.MjData, links: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points of the surface (K,) that the floor may push, and how dear that is (K,) >= 1."""
    body = links[chain.surface_link]
    turn = data.xmat[body].reshape(-1, 3, 3)
    arm = np.einsum("kij,kj->ki", turn, chain.surface_point)
    height = data.xpos[body, 2] + arm[:, 2] - chain.surface_radius
    near = np.flatnonzero(height < NEAR)
    arm = arm[near] - chain.surface_radius[near, None] * np.array([0.0, 0.0, 1.0])
    speed = np.empty((len(near), 6))
    for i, b in enumerate(body[near]):
        mujoco.mj_objectVelocity(data.model, data, mujoco.mjtObj.mjOBJ_XBODY, b, speed[i], 0)
    rate = np.linalg.norm(speed[:, 3:] + np.cross(speed[:, :3], arm), axis=1)
    lift = np.maximum(height[near], 0.0)
    return near, 1.0 + (lift / TOUCH) ** 2 + (rate / REST) ** 2


def _pushes(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    chain: Chain,
    links: np.ndarray,
    near: np.ndarray,
    lean: np.ndarray,
    root: np.ndarray,
    mass: float,
) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) pushes of the floor (N) at the points ``near``, and their (K, 3, nv) Jacobians.

    Least squares over the edges of friction pyramids (Lawson and Hanson 1974, NNLS): what is left
    of the root's wrench (6,), plus a small cost of each push.
    """
    jac = np.empty((len(near), 3, model.nv))
    for i, k in enumerate(near):
        b = links[chain.surface_link[k]]
        place = data.xpos[b] + data.xmat[b].reshape(3, 3) @ chain.surface_point[k]
        place[2] -= chain.surface_radius[k]
        mujoco.mj_jac(model, data, jac[i], None, place, b)
    weight = mass * GRAVITY
    scale = np.repeat([1.0 / weight, 1.0 / (weight * ARM)], 3)
    # Columns: the root's wrench of a push of one weight along each edge of each point.
    columns = np.einsum("ed,pdv->vpe", _EDGES, jac[:, :, :6]).reshape(6, -1) * weight
    cost = np.sqrt(COST) * np.repeat(lean, len(_EDGES))
    rows = np.concatenate([scale[:, None] * columns, np.diag(cost)])
    goal = np.concatenate([scale * root, np.zeros(len(cost))])
    share, _ = nnls(rows, goal)
    return weight * share.reshape(-1, len(_EDGES)) @ _EDGES, jac
