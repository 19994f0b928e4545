"""What the duels share: the athlete starts on guard, the opponent stands on guard before it.

Guard pose, distances and targets are those of the tasks (``sports/combat.py``). The opponent is a
figure that stands still: it tells where a target is, and is not in the plan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from sports.humanoid.body import Body, Shape
from warmstart import rotation
from warmstart.outcome import link_poses
from warmstart.rigid_body import center_of_mass
from warmstart.transcription import Transcription

ROOT = ("pitch", "roll", "yaw")
"""Angles of the root, 0 on guard."""


def figure(body: Body, pose: Mapping[str, float], z: float) -> np.ndarray:
    """(1, 7 + n) state of an athlete that stands in a pose, facing +x, its root at (0, 0, z)."""
    qpos = np.zeros((1, 7 + body.num_dofs))
    qpos[0, 2:4] = z, 1.0
    for name, angle in pose.items():
        qpos[0, 7 + body.dof_index(name)] = angle
    return qpos


def between_feet(body: Body, pose: Mapping[str, float], z: float) -> float:
    """How far (m) the middle between the ankles is ahead of the root."""
    pos, _ = link_poses(body, figure(body, pose, z))
    return float(np.mean([pos[0, body.link_index(f"{side}_Ankle"), 0] for side in "LR"]))


def point_on_guard(
    body: Body,
    pose: Mapping[str, float],
    z: float,
    link: str,
    point: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> np.ndarray:
    """(3,) a point of a link (m, its frame) on guard, relative to the ground under the root (m)."""
    pos, quat = link_poses(body, figure(body, pose, z))
    i = body.link_index(link)
    return pos[0, i] + rotation.rotate(quat[0, i], np.array(point))


def front_of(body: Body, pose: Mapping[str, float], z: float, link: str) -> np.ndarray:
    """(3,) the foremost point of a link on guard, in the middle of its shape, relative to the
    ground under the root (m)."""
    pos, quat = link_poses(body, figure(body, pose, z))
    i = body.link_index(link)
    shape: Shape = body.links[i].shapes[0]
    middle = np.array([shape.center, shape.end or shape.center]).mean(0)
    reach = shape.size[0]  # half the depth of a box, the radius of a capsule or sphere
    return pos[0, i] + rotation.rotate(quat[0, i], middle + np.array([reach, 0.0, 0.0]))


def near(
    program: Transcription,
    knot: int,
    pose: Mapping[str, float],
    slack: float,
    names: Sequence[str] = (),
) -> None:
    """The angles ``names`` of a knot, or all, are within ``slack`` (rad) of a pose; it has 0 where
    it says nothing."""
    model = program.model
    for name in names or (*ROOT, *model.free):
        angle = pose.get(name, 0.0)
        program.bound(program.q[knot, model.index(name)], angle - slack, angle + slack)


def settled(program: Transcription, ahead: tuple[float, float], rate: float = 0.5) -> None:
    """At the last knot the athlete stands and hardly moves: no angle faster than ``rate`` (rad/s),
    the centre of mass at less than 0.1 m/s, and ``ahead`` (m) of the middle between the feet."""
    model = program.model
    program.bound(program.v[-1, 3:], -rate, rate)
    ankles = [model.tree.link(f"{side}_Ankle") for side in "LR"]

    def over(q, v, p):
        motion = model.motion(q, v)
        com, velocity = center_of_mass(model.tree, motion)
        left, right = (motion.p_WL[i] for i in ankles)
        return [
            ("mass over the feet", com[0] - (left + right)[0] / 2, *ahead),
            ("at rest", velocity, -0.1, 0.1),
        ]

    program.rows("settled", [program.K - 1], over, rates=True)


def even(program: Transcription, price: float) -> None:
    """Spreads the load over the soles: ``price`` times the sum of the squared vertical forces, in
    body weights, at every knot.

    A plan that stands on an edge of a sole is not replayed: the soft contacts of engines give way
    there, and the foot creeps.
    """

    def cost(f, p):
        up = ca.reshape(f / program.weight, 3, f.numel() // 3)[2, :]
        return price * ca.sumsqr(up), []

    for side in program.sides:
        rows = np.array([index.ravel() for index in program.f[side].values()])
        program.program.block(f"even load {side}", [rows], cost)
