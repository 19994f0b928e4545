"""From a palm at an object to hands that hold it: reach, close the fingers, squeeze, stand.

The steps of ``sports.humanoid.grip``, on one athlete in plain MuJoCo. World frame, facing +x; m,
rad, N, N m. Wrist frame: x to the thumb's side, the right hand's fingers along -y, the palm looks
along -z.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.optimize import least_squares

from sports.humanoid.body import FINGERS, Body
from sports.humanoid.mjcf import body_name, build_model
from sports.physics.base import GRAVITY
from sports.scene import Scene, SceneObject, Start

SINK = 0.0015
"""How far the soles of a standing athlete are in the ground (m)."""
TOUCH = 3e-4
"""A finger that overlaps the object by this (m) has closed."""
BEND_STEP, BEND_LIMIT = 0.01, 1.7
"""Finger joints close in steps (rad) up to a fist."""
FINGER_DAMPING = 0.5
"""Of finger joints while they squeeze (N m s/rad): a twentieth of theirs, for the sake of time."""
PINNED, FREE, FROZEN = 1.0, 1.5, 1.0
"""Seconds of squeezing: object pinned, object free, targets frozen."""
ARM = ("Thorax", "Shoulder", "Elbow", "Wrist")
COST = {"Thorax": 0.3, "Shoulder": 0.03, "Elbow": 0.03, "Wrist": 0.04}
"""Residual per radian of an arm joint."""
AT, ALONG = 20.0, 5.0
"""Residuals per metre off the place and per unit of direction off the wanted one."""
GUESSES, WIDEST = 5, 2.5
"""Starts of the least squares, and the largest angle of an arm joint (rad)."""


class Axis(NamedTuple):
    """A direction of a wrist frame and where it should point in the world."""

    own: np.ndarray
    wanted: np.ndarray
    weight: float = ALONG


@dataclass(frozen=True)
class Reach:
    """Where a hand should be."""

    side: str
    point: np.ndarray
    """(3,) of the wrist frame, which must come to ..."""
    place: np.ndarray
    """(3,) ... this place in the world."""
    axes: tuple[Axis, ...]
    press: np.ndarray
    """(3,) force of the arm on the object (N), world frame, besides what carries it."""


class Rig:
    """One athlete and the object, for looking for a hold."""

    def __init__(self, body: Body, held: SceneObject, hands: tuple[str, ...]) -> None:
        self.body, self.held, self.hands = body, held, hands
        self.start = Start(z=body.standing_height(-SINK))
        self.scene = Scene("rig", body, (self.start,), (held,), timestep=1 / 240, substeps=8)
        self.model = build_model(self.scene, sensors=False)
        self.data = mujoco.MjData(self.model)
        self.n = body.num_dofs
        self.kp = body.array("kp")
        self.object = self.model.body(held.name).id
        self.arms = self.dofs(*(f"{side}_{link}" for side in hands for link in ARM))
        self.fingers = self.dofs(*(f"{s}_{f}" for s in hands for f in FINGERS))

    def dofs(self, *links: str) -> np.ndarray:
        """Indices of the dofs of links that begin so."""
        return np.array([i for i, d in enumerate(self.body.dofs) if d.link.startswith(links)])

    def link(self, name: str) -> int:
        """MuJoCo's number of a link."""
        return self.model.body(body_name(0, name)).id

    def chains(self) -> Iterator[tuple[str, list[tuple[int, float, str]]]]:
        """Fingers by side: dof that bends it, sign and link of every joint, knuckle first."""
        for side in self.hands:
            sign = 1.0 if side == "R" else -1.0
            for finger in FINGERS:
                axis, way = ("z", -sign) if finger == "Thumb" else ("x", sign)
                names = [f"{side}_{finger}{k}" for k in (1, 2, 3)]
                yield finger, [(self.body.dof_index(f"{n}_{axis}"), way, n) for n in names]

    def touching(self) -> set[int]:
        """Numbers of the links that overlap the object."""
        pairs = [self.model.geom_bodyid[c.geom] for c in self.data.contact if c.dist < -TOUCH]
        return {int(a + b - self.object) for a, b in pairs if self.object in (a, b)}


def palm(body: Body, side: str, x: float, out: float, above: float = 0.0) -> np.ndarray:
    """(3,) the point of a wrist frame ``above`` the palm (m), at ``x`` and ``out`` along the
    fingers."""
    (box,) = body.links[body.link_index(f"{side}_Wrist")].shapes
    surface = box.center[2] - box.size[2]
    return np.array([x, out if side == "L" else -out, surface - above])


def reach(rig: Rig, reaches: tuple[Reach, ...], rng: np.random.Generator) -> np.ndarray:
    """(nq,) the athlete standing with its palms where they should be."""
    model, data, body = rig.model, rig.data, rig.body
    lower, upper = (np.clip(body.array(k)[rig.arms], -WIDEST, WIDEST) for k in ("lower", "upper"))
    cost = np.array([COST[body.dofs[i].link[2:]] for i in rig.arms])
    rest = rig.scene.default_qpos()

    def residuals(x: np.ndarray) -> np.ndarray:
        data.qpos[:] = rest
        data.qpos[7 + rig.arms] = x
        mujoco.mj_kinematics(model, data)
        parts = [cost * x]
        for r in reaches:
            wrist = rig.link(f"{r.side}_Wrist")
            R_WH = data.xmat[wrist].reshape(3, 3)
            parts.append(AT * (data.xpos[wrist] + R_WH @ r.point - r.place))
            parts += [a.weight * (R_WH @ a.own - a.wanted) for a in r.axes]
        return np.concatenate(parts)

    guesses = rng.normal(0.0, 0.6, (GUESSES, len(lower))).clip(lower + 1e-3, upper - 1e-3)
    best = min(
        (least_squares(residuals, x, bounds=(lower, upper)) for x in guesses), key=lambda s: s.cost
    )
    qpos = rest.copy()
    qpos[7 + rig.arms] = best.x
    return qpos


def close(rig: Rig, qpos: np.ndarray, thumb: float) -> np.ndarray:
    """(nq,) the same with the fingers bent until they touch."""
    data, chains = rig.data, list(rig.chains())
    data.qpos[:] = qpos
    for finger, joints in chains:
        if finger == "Thumb":
            data.qpos[7 + joints[0][0]] = -joints[0][1] * thumb
    still: set[int] = set()
    for _ in range(round((BEND_LIMIT + thumb) / BEND_STEP)):
        mujoco.mj_kinematics(rig.model, data)
        mujoco.mj_collision(rig.model, data)
        touching = rig.touching()
        for _, joints in chains:
            reached = [k for k, (_, _, link) in enumerate(joints) if rig.link(link) in touching]
            # What lies between the palm and a link that touches stays.
            still.update(dof for dof, _, _ in joints[: max(reached, default=-1) + 1])
            for dof, way, _ in joints:
                if dof not in still and way * data.qpos[7 + dof] < BEND_LIMIT:
                    data.qpos[7 + dof] += way * BEND_STEP
    return data.qpos.copy()


def statics(
    rig: Rig, qpos: np.ndarray, forces: list[tuple[int, np.ndarray, np.ndarray]]
) -> np.ndarray:
    """(num_dofs,) torques that keep the pose with the feet on the ground and ``forces`` on links:
    (number, place (3,), force (3,)). Raises ValueError where the athlete would topple."""
    model, data, n = rig.model, rig.data, rig.n
    data.qpos[:], data.qvel[:] = qpos, 0.0
    mujoco.mj_forward(model, data)
    torque = data.qfrc_bias[: 6 + n].copy()
    jac = np.zeros((3, model.nv))

    def push(link: int, place: np.ndarray, force: np.ndarray) -> None:
        mujoco.mj_jac(model, data, jac, None, place, link)
        torque[:] -= (jac.T @ force)[: 6 + n]

    for link, place, force in forces:
        push(link, place, force)
    # The root is upright: its rows are the force and the moment that the ground must give.
    weight = torque[2]
    x, y = qpos[0] - torque[4] / weight, qpos[1] + torque[3] / weight
    feet = [rig.link(f"{side}_Ankle") for side in "LR"]
    soles = [data.geom_xpos[model.body_geomadr[foot]] for foot in feet]
    reaches = [model.geom_size[model.body_geomadr[foot]][0] for foot in feet]
    left = (y - soles[1][1]) / (soles[0][1] - soles[1][1])
    for foot, sole, half, share in zip(feet, soles, reaches, (left, 1.0 - left)):
        if not 0.0 < share < 1.0 or abs(x - sole[0]) > half:
            raise ValueError(f"the athlete would topple: centre of mass over ({x:.3f}, {y:.3f})")
        push(foot, np.array([x, sole[1], 0.0]), np.array([0.0, 0.0, share * weight]))
    return torque[6:]


def squeeze(
    rig: Rig, qpos: np.ndarray, reaches: tuple[Reach, ...], press: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """(nq,) the pose and (num_dofs,) the servo torques in which arms and fingers come to rest."""
    model, data, n = rig.model, rig.data, rig.n
    mass = sum(shape.mass for shape in rig.held.shapes)
    lift = np.array([0.0, 0.0, GRAVITY * mass / len(reaches)])
    load = [(rig.link(f"{r.side}_Wrist"), r.place, -lift - r.press) for r in reaches]
    torque = statics(rig, qpos, load)
    fingers = np.zeros(n)
    for finger, joints in rig.chains():
        for (dof, way, _), size in zip(joints, press[3:] * 3 if finger == "Thumb" else press):
            fingers[dof] = way * size
    bent = np.flatnonzero(fingers)
    target = qpos[7 : 7 + n] + torque / rig.kp
    fixed = np.setdiff1d(np.arange(n), np.concatenate((rig.arms, rig.fingers)))
    damping = model.dof_damping.copy()
    slot = rig.scene.object_qpos(rig.held.name)
    mujoco.mj_resetData(model, data)
    data.qpos[:] = qpos
    try:
        model.dof_damping[6 + rig.fingers] = FINGER_DAMPING
        for k in range(round((PINNED + FREE + FROZEN) / model.opt.timestep)):
            time = k * model.opt.timestep
            if time < PINNED + FREE:
                target[bent] = data.qpos[7 + bent] + fingers[bent] / rig.kp[bent]
            else:
                model.dof_damping[:] = damping
            data.ctrl[:] = target
            mujoco.mj_step(model, data)
            data.qpos[:7], data.qvel[:6] = qpos[:7], 0.0
            data.qpos[7 + fixed], data.qvel[6 + fixed] = qpos[7 + fixed], 0.0
            if time < PINNED:
                data.qpos[slot], data.qvel[6 + n :] = qpos[slot], 0.0
    finally:
        model.dof_damping[:] = damping
    rest = data.qpos.copy()
    carried = [(rig.link(f"{rig.hands[0]}_Wrist"), rest[slot][:3], -lift * len(reaches))]
    torque = statics(rig, rest, carried)
    moved = np.concatenate((rig.arms, rig.fingers))
    torque[moved] = (rig.kp * (target - rest[7 : 7 + n]))[moved]
    return rest, torque
