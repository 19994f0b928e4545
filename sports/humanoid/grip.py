"""Finds holds by simulation: ``python -m sports.humanoid.grip javelin`` (or ``basketball``).

1. *Reach*: least squares on the arm joints bring the palms to the object; joint limits are
   anatomical, large angles cost.
2. *Close*: every finger bends joint by joint until it touches.
3. *Squeeze*: with the trunk pinned, the finger servos press with constant torques, first on the
   pinned object, then on the free one, until nothing moves; then their targets are frozen. What
   is at rest under constant torques is at rest under every stiffer servo.
4. *Stand*: the torques of trunk and legs are those that carry the weight over the feet (statics:
   the ground's force acts below the centre of mass, shared by the feet as levers).
5. *Balance*: toes that give way under the load tip the athlete a little; the ankles' torques are
   corrected (secant rule) until the root stays where it is.
6. *Prove*: the athlete stands free for 3 s at every strength; the hold in which the object moves
   least is kept.

Where the hand meets the object and how hard it presses is drawn at random from ``Search``, with
a seed. World frame, facing +x; m, rad, N m. "Wrist frame": x to the thumb's side, the right
hand's fingers along -y, the palm looks along -z.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.optimize import least_squares

from sports.humanoid.body import Body, Strength, load_body
from sports.humanoid.hold import (
    BASKETBALL,
    HANDS,
    HELD,
    JAVELIN,
    JAVELIN_RADIUS,
    NOSE_UP,
    Hold,
    mirrored_axis,
)
from sports.humanoid.mjcf import body_name, build_model
from sports.physics import default_state, make_physics
from sports.physics.base import GRAVITY
from sports.scene import Scene, SceneObject, Start

DATA = Path(__file__).parent / "data"
SINK = 0.0015
"""How far the soles of a standing athlete are in the ground (m)."""
TOUCH = 3e-4
"""A finger that overlaps the object by this (m) has closed."""
BEND_STEP, BEND_LIMIT = 0.01, 1.7
"""Finger joints close in steps (rad) up to a fist."""
FINGER_DAMPING = 0.5
"""Of finger joints while they squeeze (N m s/rad): a tenth of theirs, for the sake of time."""
PINNED, FREE, FROZEN = 1.0, 1.5, 1.0
"""Seconds of squeezing: object pinned, object free, targets frozen."""
PASSES = 2
"""Reaches, each corrected by what the squeezing before it moved."""
SWAY, SECANTS = 1.5, 4
"""Seconds of standing after which the athlete should be where it was, and corrections."""
ASTRAY = 0.05
"""An object that squeezing moved further (m) was lost; one on the ground lies very still."""
PROOF = 3.0
"""Seconds that a hold must stand."""
ARM = ("Thorax", "Shoulder", "Elbow", "Wrist")
FINGERS = ("Index", "Middle", "Ring", "Pinky")
COST = {"Thorax": 0.3, "Shoulder": 0.03, "Elbow": 0.03, "Wrist": 0.04}
"""Residual per radian of an arm joint."""
AT, ALONG = 20.0, 5.0
"""Residuals per metre off the place and per unit of direction off the wanted one."""
GUESSES = 5
"""Starts of the least squares."""


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


@dataclass(frozen=True)
class Search:
    """What is looked for: reaches and finger torques of a draw of parameters."""

    held: SceneObject
    ranges: dict[str, tuple[float, float]]
    reaches: Callable[[dict[str, float]], tuple[Reach, ...]]
    thumb: float
    """Angle (rad) of the thumb's first joint about z from which it closes."""
    torques: Callable[[dict[str, float]], tuple[float, float, float, float]]
    """N m at the first, second and third joint of a finger, and at the thumb's."""


def _javelin_reaches(p: dict[str, float]) -> tuple[Reach, ...]:
    nose = np.array([math.cos(NOSE_UP), 0.0, math.sin(NOSE_UP)])
    above = np.array([-math.sin(NOSE_UP), 0.0, math.cos(NOSE_UP)])
    # Palm up below the shaft, the thumb towards the tail, the shaft along the knuckles.
    across = np.array([-math.cos(p["tilt"]), math.sin(p["tilt"]), 0.0])
    point = np.array([-0.012, -p["place"], -0.0166 - JAVELIN_RADIUS])
    up = Axis(np.array([0.0, 0.0, -1.0]), above, 0.3)
    reach = Reach("R", point, np.array(JAVELIN.pos), (Axis(across, nose), up), np.zeros(3))
    return (reach,)


def _basketball_reaches(p: dict[str, float]) -> tuple[Reach, ...]:
    radius = BASKETBALL.shapes[0].size[0]
    reaches = []
    for side in HANDS["basketball"]:
        outward = np.array([-math.sin(p["behind"]), 0.0, -math.sin(p["below"])])
        outward[1] = (1.0 if side == "L" else -1.0) * math.sqrt(1.0 - outward @ outward)
        mirror = mirrored_axis(side)
        palm = np.array([-0.015, -p["place"], -0.0166]) * mirror
        tips = np.array([math.cos(p["rise"]), 0.0, math.sin(p["rise"])])
        fingers = tips - (tips @ outward) * outward
        axes = (
            Axis(np.array([0.0, 0.0, -1.0]), -outward),
            Axis(np.array([0.0, -1.0, 0.0]) * mirror, fingers / np.linalg.norm(fingers), 1.0),
        )
        place = np.array(BASKETBALL.pos) + radius * outward
        reaches.append(Reach(side, palm, place, axes, -p["press"] * outward))
    return tuple(reaches)


SEARCHES = {
    "javelin": Search(
        held=JAVELIN,
        ranges={"place": (0.07, 0.1), "tilt": (0.0, 0.3), "squeeze": (0.2, 0.6)},
        reaches=_javelin_reaches,
        thumb=0.6,
        torques=lambda p: (p["squeeze"], 0.7 * p["squeeze"], 0.4 * p["squeeze"], 0.2),
    ),
    "basketball": Search(
        held=BASKETBALL,
        ranges={
            "place": (0.08, 0.11),
            "behind": (0.0, 0.5),
            "below": (0.0, 0.5),
            "rise": (0.0, 1.2),
            "press": (8.0, 25.0),
        },
        reaches=_basketball_reaches,
        thumb=0.0,
        torques=lambda p: (0.15, 0.1, 0.05, 0.1),
    ),
}


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
        self.fingers = self.dofs(*(f"{s}_{f}" for s in hands for f in (*FINGERS, "Thumb")))

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
            for finger in (*FINGERS, "Thumb"):
                axis, way = ("z", -sign) if finger == "Thumb" else ("x", sign)
                names = [f"{side}_{finger}{k}" for k in (1, 2, 3)]
                yield finger, [(self.body.dof_index(f"{n}_{axis}"), way, n) for n in names]

    def touching(self) -> set[int]:
        """Numbers of the links that overlap the object."""
        pairs = [self.model.geom_bodyid[c.geom] for c in self.data.contact if c.dist < -TOUCH]
        return {int(a + b - self.object) for a, b in pairs if self.object in (a, b)}


def reach(rig: Rig, reaches: tuple[Reach, ...], rng: np.random.Generator) -> np.ndarray:
    """(nq,) the athlete standing with its palms where they should be."""
    model, data, body = rig.model, rig.data, rig.body
    lower, upper = (np.clip(body.array(k)[rig.arms], -2.5, 2.5) for k in ("lower", "upper"))
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


def try_hold(name: str, parameters: dict[str, float], seed: int) -> Hold:
    """The hold that these parameters lead to, good or bad. Raises ValueError if none does."""
    search, hands = SEARCHES[name], HANDS[name]
    rig = Rig(load_body("smplx", limits="anatomical"), search.held, hands)
    slot, wanted = rig.scene.object_qpos(search.held.name), np.array(search.held.pos)
    reaches = search.reaches(parameters)
    for _ in range(PASSES):
        qpos = close(rig, reach(rig, reaches, np.random.default_rng(seed)), search.thumb)
        rest, torque = squeeze(rig, qpos, reaches, search.torques(parameters))
        # Squeezing moves the object by millimetres: reach as much to the other side.
        error = rest[slot][:3] - wanted
        if np.linalg.norm(error) > ASTRAY:
            raise ValueError(f"the object came to {rest[slot][:3]}, not to {wanted}")
        reaches = tuple(replace(r, place=r.place - error) for r in reaches)
    dofs = [dof.name for dof in rig.body.dofs]
    place, attitude = rest[slot][:3].round(6).tolist(), _unrolled(rest[slot][3:]).round(6).tolist()
    hold = Hold(
        name=name,
        root_height=round(float(rest[2]), 6),
        angles=dict(zip(dofs, rest[7 : 7 + rig.n].round(6).tolist())),
        torques=dict(zip(dofs, torque.round(5).tolist())),
        pos=(place[0], place[1], place[2]),
        quat=(attitude[0], attitude[1], attitude[2], attitude[3]),
        hands=hands,
    )
    return balance(hold)


def _unrolled(quat: np.ndarray) -> np.ndarray:
    """(4,) the attitude with the same x axis that has no roll about it: what is held is round."""
    w, x, y, z = quat
    nose = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    yaw, pitch = math.atan2(nose[1], nose[0]), math.asin(nose[2])
    cy, sy, cp, sp = (f(v / 2) for v in (yaw, pitch) for f in (math.cos, math.sin))
    return np.array([cy * cp, sy * sp, -cy * sp, sy * cp])


def balance(hold: Hold) -> Hold:
    """The hold with that torque of the ankles with which the athlete sways least."""

    def corrected(torque: float) -> Hold:
        ankles = {f"{side}_Ankle_y": torque for side in "LR"}
        torques = {dof: round(t + ankles.get(dof, 0.0), 5) for dof, t in hold.torques.items()}
        return replace(hold, torques=torques)

    first, second = 0.0, 1.0
    way = prove(hold, "human", seconds=SWAY).swayed
    for _ in range(SECANTS):
        now = prove(corrected(second), "human", seconds=SWAY).swayed
        if abs(now - way) < 1e-6:
            break
        first, second, way = second, second - now * (second - first) / (now - way), now
    return corrected(second)


class Proof(NamedTuple):
    """How far things went while an athlete stood with action 0."""

    moved: float
    """Furthest from its place the object was (m)."""
    turned: float
    """Furthest from its attitude (rad)."""
    creep: float
    """Object's way in the last second (m)."""
    sunk: float
    """How far the root came down (m)."""
    swayed: float
    """How far forward the root was in the end (m)."""


def prove(
    hold: Hold, strength: Strength = "paper", engine: str = "mujoco", seconds: float = PROOF
) -> Proof:
    """Lets an athlete stand with the hold's PD targets on an engine."""
    import torch

    scene = hold.scene(load_body("smplx", strength=strength), HELD[hold.name])
    options = {"device": "cpu"} if engine == "warp" else {}
    physics = make_physics(engine, scene, 1, **options)
    state = default_state(scene, 1, physics.device)
    physics.reset(torch.ones(1, dtype=torch.bool), state)
    ctrl = torch.tensor(scene.action_offset(), dtype=torch.float32)[None]
    pos, quat, root = [], [], []
    for _ in range(round(seconds / scene.control_timestep)):
        physics.step(ctrl)
        pos.append(physics.object_pos[0, 0].clone())
        quat.append(physics.object_quat[0, 0].clone())
        root.append(physics.body_pos[0, 0, 0].clone())
    way = torch.stack(pos).double() - torch.tensor(hold.pos)
    same = (torch.stack(quat).double() @ torch.tensor(hold.quat).double()).abs().clamp(max=1.0)
    physics.close()
    return Proof(
        moved=float(way.norm(dim=-1).max()),
        turned=float(2 * torch.arccos(same).max()),
        creep=float((way[-1] - way[max(-31, -len(way))]).norm()),
        sunk=hold.root_height - float(torch.stack(root)[:, 2].min()),
        swayed=float(root[-1][0]),
    )


def badness(hold: Hold) -> float:
    """What the search makes small: the object's way (m) and turn at both strengths, over 3 s."""
    total = 0.0
    for strength in ("paper", "human"):
        proof = prove(hold, strength)
        total = max(total, proof.moved + 0.1 * proof.turned + 3.0 * proof.creep + proof.sunk)
    return total


def search(name: str, trials: int, seed: int) -> tuple[Hold, dict[str, float], float]:
    """The best of so many draws, its parameters and its badness."""
    rng = np.random.default_rng(seed)
    best: tuple[Hold, dict[str, float], float] | None = None
    for trial in range(trials):
        drawn = {k: float(rng.uniform(*span)) for k, span in SEARCHES[name].ranges.items()}
        try:
            hold = try_hold(name, drawn, seed)
        except ValueError:
            continue
        bad = badness(hold)
        if best is None or bad < best[2]:
            best = hold, drawn, bad
            values = ", ".join(f"{k} {v:.4f}" for k, v in drawn.items())
            print(f"trial {trial}: badness {bad:.4f} with {values}", flush=True)
    if best is None:
        raise RuntimeError(f"none of {trials} trials found a hold '{name}'")
    return best


def write(hold: Hold, parameters: dict[str, float], command: str, path: Path) -> None:
    """Saves a hold as data: joints as [angle (rad), servo torque (N m)]."""
    joints = {
        dof: [angle, hold.torques[dof]]
        for dof, angle in hold.angles.items()
        if angle or hold.torques[dof]
    }
    lines = ",\n".join(f'    "{dof}": {json.dumps(pair)}' for dof, pair in joints.items())
    held = json.dumps({"pos": hold.pos, "quat": hold.quat})
    drawn = json.dumps({k: round(v, 5) for k, v in parameters.items()})
    path.write_text(
        f'{{\n  "command": "{command}",\n  "parameters": {drawn},\n'
        f'  "hands": {json.dumps(hold.hands)},\n  "root_height": {hold.root_height},\n'
        f'  "object": {held},\n  "joints": {{\n{lines}\n  }}\n}}\n'
    )


def main() -> None:
    """Searches, writes the data file and says how well the hold stands."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("name", choices=sorted(SEARCHES))
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--out", type=Path, default=None, help="data file; the package's by default"
    )
    args = parser.parse_args()
    command = (
        f"python -m sports.humanoid.grip {args.name} --trials {args.trials} --seed {args.seed}"
    )
    hold, drawn, _ = search(args.name, args.trials, args.seed)
    write(hold, drawn, command, args.out or DATA / f"hold_{args.name}.json")
    for strength in ("paper", "human"):
        print(strength, prove(hold, strength))


if __name__ == "__main__":
    main()
