"""A javelin throw by the athlete of the task: SMPL-X, with the javelin in its fingers.

The certified throws of ``solve javelin`` have the javelin rigid on a hand without fingers, from
another stance. Here the task's own athlete throws its own javelin from its own hold, by friction
alone. The arm and the trunk draw the javelin back along the line on which it will fly and push it
along that line (inverse kinematics), with the torques of inverse dynamics, and then the fingers
open. Numbers change that: see ``BASE`` and ``BUMPED``. :mod:`warmstart.robust_javelin` seeks them,
for throws that are long by the task's own rules, go over the shoulder, stay in the sector and land
tip first. Targets are held over control steps of 1/30 s as a policy's are, and every frame of the
clip is a state which MuJoCo reached from the task's own start.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.optimize import least_squares

from sports.env import Env, make_scene
from sports.humanoid.body import FINGERS, Strength, load_body
from sports.humanoid.mjcf import body_name, build_model
from sports.javelin import AIM, DELIVERY, HOLD_STEPS, LOW_HAND, REACH, half_sector
from sports.javelin import END as TIP
from sports.physics.base import GRAVITY
from sports.physics.game import top
from sports.scene import Scene, humanoid_scene
from warmstart import rotation, thrown
from warmstart.clip import Clip
from warmstart.performance import perform, searched_clip
from warmstart.tracking import Worlds

TASK = "javelin"
BACK, AHEAD, END = -0.95, 0.2, 0.0
"""Along the line through the grip of the hold, from there (m): how far the hand can be, and where
the push ends."""
COAST = 0.02
"""Time constant with which the hand stops after the push (s)."""
TRUNK, ARM = ("Torso", "Spine", "Chest"), ("R_Thorax", "R_Shoulder", "R_Elbow", "R_Wrist")
COST = {"Torso": 0.12, "Spine": 0.12, "Chest": 0.12, "R_Thorax": 0.1}
"""Residual per radian off the hold, ``ARM_COST`` for other joints..."""
ARM_COST, AT, TURNED, SMOOTH = 0.03, 20.0, 3.0, 0.3
"""... per metre off the line, per unit of the hand's rotation matrix off that of the hold, and per
radian off the point before, for a servo with the damping ``DAMPING``."""
DAMPING = 50.0
"""N m s/rad"""
WIDEST = 2.6
"""rad"""
BASE = np.array([0.7, 0.50, 0.20, 0.0, 40.0, 0.0, 0.3, 1.0, 0.5])
"""How far the javelin is drawn back (m), when the push begins (s) and how long it takes (s), by
how much the targets lead (s), how many times as hard as in the hold the fingers press, when they
open (s, from the end of the push) and how far: at the knuckles, at the other joints of the fingers
and at the thumb (rad)."""
BUMPED = (
    *(tuple(f"{link}_{axis}" for link in TRUNK) for axis in "xyz"),
    ("R_Thorax_y",),
    ("R_Thorax_z",),
    *((f"R_Shoulder_{axis}",) for axis in "xyz"),
    ("R_Elbow_y",),
    ("R_Elbow_z",),
    *((f"R_Wrist_{axis}",) for axis in "xyz"),
    ("L_Hip_y", "R_Hip_y"),
    ("L_Hip_z", "R_Hip_z"),
    ("L_Knee_y", "R_Knee_y"),
    ("L_Ankle_y", "R_Ankle_y"),
)
"""Joints with bumps on their targets..."""
BUMPS = (-0.28, -0.21, -0.14, -0.07, 0.0)
"""... and the middles of these, from the end of the push (s); each is as wide as they are apart."""
UNITS = np.array(
    [0.05, 0.02, 0.02, 0.01, 15.0, 0.03, 0.3, 0.3, 0.3, *[0.15] * (len(BUMPS) * len(BUMPED))]
)
"""Of the numbers of ``BASE`` and of the bumps (rad)."""
SQUEEZED = 0.3
"""Time in which the fingers come to press so hard (s)."""
WATCHED = 30
"""Control steps after which a candidate is judged by the javelin's flight."""
NEAR, TILTED = 0.12, 0.4
"""Palm to grip (m) and angle off the hold (rad) that candidates keep while they must hold: the
rules say 0.15 and 0.5."""
STEEP = (-1.0, -0.25)
"""Elevation of the nose where the javelin lands (rad)."""
SPIN = 1.5
"""Fastest turn of the javelin in flight (rad/s)."""
OVER_ARM = LOW_HAND - 0.05
"""How far below the shoulder the palm may be within the last control steps before the release (m):
the rules say 0.15."""
SLUNG = 30.0
"""Cost of a metre below that."""
ALIGNED, ATTACK = 0.15, 10.0
"""Angle between nose and path as the javelin leaves the hand (rad), and the cost of a radian above
it. At a cost of 3 the nose stayed 34 degrees off the path in 80 rounds, at 10 it came to 20 in 30;
in Drake, whose hands let go elsewhere, such a javelin flies 40 degrees off."""
ASIDE, WIDE, INSIDE = 0.1, 1.5, 0.5
"""Cost of a metre to the side, and of one more beyond that share of the sector's half width."""
EPS = 0.01
"""Step of finite differences (s)."""


class _Line:
    """Poses of trunk and arm with the javelin on the line, by how far along it is."""

    def __init__(self, scene: Scene) -> None:
        self.model = model = build_model(scene, sensors=False)
        data, rest = mujoco.MjData(model), scene.default_qpos()
        body = scene.body
        own = [i for i, d in enumerate(body.dofs) if d.link.startswith((*TRUNK, *ARM))]
        self.dofs = np.array(own)
        lower, upper = (np.clip(body.array(k)[own], -WIDEST, WIDEST) for k in ("lower", "upper"))
        cost = np.array([COST.get(body.dofs[i].link, ARM_COST) for i in own])
        wrist, held = model.body(body_name(0, "R_Wrist")).id, model.body("javelin").id
        data.qpos[:] = rest
        mujoco.mj_kinematics(model, data)
        turn = data.xmat[wrist].reshape(3, 3).T.copy()
        grip, middle = turn @ (data.xpos[held] - data.xpos[wrist]), data.xpos[held].copy()
        slow = body.array("kd")[own] / DAMPING
        stand = rest[7 + self.dofs]
        aim = np.array(AIM)

        def pose(along: float, near: np.ndarray) -> np.ndarray:
            def residuals(x: np.ndarray) -> np.ndarray:
                data.qpos[:] = rest
                data.qpos[7 + self.dofs] = x
                mujoco.mj_kinematics(model, data)
                turned = data.xmat[wrist].reshape(3, 3)
                off = data.xpos[wrist] + turned @ grip - (middle + along * aim)
                tilt = (turned @ turn - np.eye(3)).ravel()
                return np.concatenate(
                    [AT * off, TURNED * tilt, cost * (x - stand), SMOOTH * slow * (x - near)]
                )

            guess = np.clip(near, lower + 1e-6, upper - 1e-6)
            return least_squares(residuals, guess, bounds=(lower, upper), diff_step=1e-4).x

        self.along = np.arange(BACK, AHEAD + 1e-9, 0.05)
        first = int(np.argmin(np.abs(self.along)))
        poses: dict[int, np.ndarray] = {}
        for rows in (range(first, len(self.along)), range(first - 1, -1, -1)):
            near = stand
            for i in rows:
                near = poses[i] = pose(self.along[i], near)
        self.poses = np.array([poses[i] for i in range(len(self.along))])

    def at(self, along: np.ndarray) -> np.ndarray:
        """(T, J) angles of ``dofs`` (rad) at places (T,) on the line (m)."""
        return np.stack([np.interp(along, self.along, x) for x in self.poses.T], axis=1)


class _Rig:
    """Torques of the athlete with the javelin rigid on its hand, while its root stays at rest."""

    def __init__(self, scene: Scene) -> None:
        body = load_body(scene.body.name, strength=scene.body.strength, equipment=["javelin"])
        self.model = build_model(humanoid_scene(body), sensors=False)
        self.data = mujoco.MjData(self.model)
        self.root = scene.default_qpos()[:7]
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT

    def torque(self, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray) -> np.ndarray:
        """(T, n) N m that the servos of the trunk and the arm need, damping included, for angles
        (rad), rates and accelerations (T, n)."""
        data, out = self.data, np.zeros_like(qpos)
        for k in range(len(qpos)):
            data.qpos[:] = *self.root, *qpos[k]
            data.qvel[6:], data.qacc[6:] = qvel[k], qacc[k]
            mujoco.mj_inverse(self.model, data)
            out[k] = data.qfrc_inverse[6:]
        return out


@dataclass(frozen=True)
class Flown:
    """What N throws come to; all (N,)."""

    far: np.ndarray
    """How far beyond the line the javelin will fly (m); NaN where the simulation diverged."""
    wrong: np.ndarray
    """What is wrong with the hold, the release and the landing."""
    aside: np.ndarray
    """How far from the middle of the field (m)."""

    def cost(self, strict: float = 1.0) -> np.ndarray:
        """(N,) what is wrong, weighed so, less how far (m); NaN where that is."""
        wide = np.maximum(self.aside - INSIDE * half_sector(np.maximum(self.far, 0.0)), 0.0)
        return strict * self.wrong - self.far + ASIDE * self.aside + WIDE * wide


class Thrower:
    """What throws by numbers do, in MuJoCo."""

    def __init__(self, strength: Strength) -> None:
        self.scene = make_scene(TASK, strength=strength)
        body = self.scene.body
        self.line, self.rig = _Line(self.scene), _Rig(self.scene)
        self.kp = body.array("kp")
        self.idle = np.setdiff1d(np.arange(body.num_dofs), self.line.dofs)
        self.hold, self.limit = self.scene.action_offset(), body.action_scale()
        self.rest = self.scene.default_qpos()[7 : 7 + body.num_dofs]
        self.wrist = body.link_index("R_Wrist")
        self.shoulder = body.link_index("R_Shoulder")
        self.palm = np.array(body.links[self.wrist].shapes[0].center)
        self.knuckles = self._bent(*(f"R_{f}1" for f in FINGERS if f != "Thumb"))
        self.joints = self._bent(*(f"R_{f}{k}" for f in FINGERS if f != "Thumb" for k in (2, 3)))
        self.thumb = self._bent("R_Thumb")
        self.slim = top(self.line.model, self.scene.free_objects[0])[3]
        self.fingers = np.concatenate([self.knuckles, self.joints, self.thumb])

    def _bent(self, *links: str) -> np.ndarray:
        """Indices of the dofs of links that begin so and are bent in the hold."""
        dofs = enumerate(self.scene.body.dofs)
        own = [i for i, d in dofs if d.link.startswith(links) and abs(self.rest[i]) > 0.1]
        return np.array(own)

    def targets(self, numbers: np.ndarray, steps: int) -> np.ndarray:
        """(steps, n) PD targets (rad) of the numbers (P,), in their units."""
        body, line, parts = self.scene.body, self.line, self.scene.substeps
        scaled = numbers * UNITS
        depth, begin, push, lead, press, opening, *opened = BASE + scaled[: len(BASE)]
        bumps = scaled[len(BASE) :].reshape(len(BUMPS), len(BUMPED))
        fine = (np.arange(steps)[:, None] + (np.arange(parts) + 0.5) / parts).ravel()
        t = fine * self.scene.control_timestep
        end = begin + push

        def pose(t: np.ndarray) -> np.ndarray:
            x = np.clip(t / begin, 0.0, 1.0)
            drawn = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
            share = np.clip((t - begin) / push, 0.0, 1.0)
            out = np.tile(self.rest, (len(t), 1))
            way, after = END + depth, np.maximum(t - end, 0.0)
            along = -depth * drawn + way * share**2
            along += 2.0 * way / push * COAST * (1.0 - np.exp(-after / COAST))
            out[:, line.dofs] = line.at(along)
            return out

        ahead = np.maximum(t + lead, 0.0)
        before, out, after = pose(ahead - EPS), pose(ahead), pose(ahead + EPS)
        torque = self.rig.torque(
            out, (after - before) / (2 * EPS), (after - 2 * out + before) / EPS**2
        )
        own = line.dofs
        out[:, own] += (torque / self.kp)[:, own]
        out[:, self.idle] = self.hold[self.idle]
        for when, sizes in zip(BUMPS, bumps):
            shape = np.maximum(0.0, 1.0 - np.abs(t - end - when) / (BUMPS[1] - BUMPS[0]))
            for joints, size in zip(BUMPED, sizes):
                out[:, [body.dof_index(joint) for joint in joints]] += (size * shape)[:, None]
        squeezed = np.clip(t / SQUEEZED, 0.0, 1.0) * (press - 1.0)
        out[:, self.fingers] += squeezed[:, None] * (self.hold - self.rest)[self.fingers]
        late = t >= end + opening
        for dofs, by in zip((self.knuckles, self.joints, self.thumb), opened):
            out[np.ix_(late, dofs)] = self.hold[dofs] - by * np.sign(self.rest[dofs])
        out = out.reshape(steps, parts, -1).mean(1)
        return np.clip(out, self.hold - self.limit, self.hold + self.limit)

    def fly(self, worlds: Worlds, ctrl: np.ndarray, start: np.ndarray) -> Flown:
        """The throws of targets (N, WATCHED, n) (rad) in worlds of the task, from ``start`` (nq,)
        at rest."""
        count, scene = len(ctrl), self.scene
        worlds.put(count, start, np.zeros(scene.nv), np.zeros(scene.nv))
        place, rate = scene.object_qpos("javelin"), scene.object_qvel("javelin")
        apart, tilt, aim = np.zeros(count), np.zeros(count), np.array(AIM)
        ahead = np.tile([1.0, 0.0, 0.0], (count, 1))
        heights, released = np.full((count, DELIVERY), np.inf), np.zeros(count, dtype=bool)
        attack = np.zeros(count)
        for k in range(WATCHED):
            before = worlds.qvel[:count, rate][:, :3].copy()
            worlds.step(ctrl[:, k])
            state, speed = worlds.qpos[:count, place], worlds.qvel[:count, rate]
            nose = rotation.rotate(state[:, 3:7], ahead)
            turned = worlds.xmat[:count, worlds.links[self.wrist]].reshape(count, 3, 3)
            palm = worlds.link_pos[:, self.wrist] + turned @ self.palm
            to_palm = palm - state[:, :3]
            if k < HOLD_STEPS:
                apart = np.maximum(apart, np.linalg.norm(to_palm, axis=1))
                tilt = np.maximum(tilt, np.arccos(np.clip(nose @ aim, -1.0, 1.0)))
            height = palm[:, 2] - worlds.link_pos[:, self.shoulder, 2]
            heights[~released] = np.column_stack((heights[:, 1:], height))[~released]
            along = np.clip((to_palm * nose).sum(1), -TIP, TIP)[:, None]
            path = speed[:, :3] / np.maximum(np.linalg.norm(speed[:, :3], axis=1), 1e-9)[:, None]
            off = np.arccos(np.clip((nose * path).sum(1), -1.0, 1.0))
            attack[~released] = off[~released]
            released |= np.linalg.norm(to_palm - along * nose, axis=1) > REACH
        velocity, step = speed[:, :3], scene.control_timestep
        spinning = rotation.rotate(state[:, 3:7], speed[:, 3:])
        spin = (spinning * nose).sum(1)[:, None] * nose
        turn = spinning - spin
        landing = thrown.fly(state[:, :3], velocity, nose, turn + self.slim * spin)
        push = np.linalg.norm((velocity - before) / step + (0.0, 0.0, GRAVITY), axis=1)

        def over(x: np.ndarray, limit: float) -> np.ndarray:
            return np.maximum(x - limit, 0.0)

        wrong = 20.0 * over(apart, NEAR) + 5.0 * over(tilt, TILTED) + 0.2 * over(push, 1.0)
        steep = landing.elevation
        wrong += 2.0 * (over(steep, STEEP[1]) + over(-steep, -STEEP[0]))
        wrong += 0.5 * over(np.linalg.norm(turn, axis=1), SPIN)
        wrong += SLUNG * over(-heights.min(1), OVER_ARM)
        wrong += ATTACK * over(attack, ALIGNED)
        return Flown(landing.far, wrong, np.abs(landing.aside))


def size_of(numbers: np.ndarray) -> np.ndarray:
    """(N,) cost of the numbers (N, P), in their units, for their size."""
    return 0.004 * (numbers**2).sum(1)


def throw(thrower: Thrower, numbers: np.ndarray) -> Clip:
    """The throw of the numbers (P,), played in the task until it ends."""
    scene, strength = thrower.scene, thrower.scene.body.strength
    ctrl = thrower.targets(numbers, WATCHED)
    touched: list[bool] = []

    def released(env: Env) -> bool:
        touched.append(bool(env.physics.pair_force[0, 0] > 0))
        return bool(env.memory["released"][0])

    played = perform(TASK, strength, scene.free_objects[0].name, ctrl, released)
    return searched_clip(played, touched, TASK, strength, numbers)
