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
a seed. Steps 1 to 4 are in ``squeeze.py``; frames and units are those there.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from sports.humanoid.body import Body, Strength, load_body
from sports.humanoid.hold import BASKETBALL, HANDS, HELD, JAVELIN, JAVELIN_RADIUS, NOSE_UP, Hold
from sports.humanoid.squeeze import Axis, Reach, Rig, close, palm, reach, squeeze
from sports.physics import default_state, make_physics
from sports.scene import SceneObject

DATA = Path(__file__).parent / "data"
PASSES = 2
"""Reaches, each corrected by what the squeezing before it moved."""
SWAY, SECANTS = 1.5, 4
"""Seconds of standing after which the athlete should be where it was, and corrections."""
ASTRAY = 0.05
"""An object that squeezing moved further (m) was lost; one on the ground lies very still."""
PROOF = 3.0
"""Seconds that a hold must stand."""


@dataclass(frozen=True)
class Search:
    """What is looked for: reaches and finger torques of a draw of parameters."""

    held: SceneObject
    ranges: dict[str, tuple[float, float]]
    reaches: Callable[[Body, dict[str, float]], tuple[Reach, ...]]
    thumb: float
    """Angle (rad) of the thumb's first joint about z from which it closes."""
    torques: Callable[[dict[str, float]], tuple[float, float, float, float]]
    """N m at the first, second and third joint of a finger, and at the thumb's."""


def _javelin_reaches(body: Body, p: dict[str, float]) -> tuple[Reach, ...]:
    nose = np.array([math.cos(NOSE_UP), 0.0, math.sin(NOSE_UP)])
    above = np.array([-math.sin(NOSE_UP), 0.0, math.cos(NOSE_UP)])
    # Palm up below the shaft, the thumb towards the tail, the shaft along the knuckles.
    across = np.array([-math.cos(p["tilt"]), math.sin(p["tilt"]), 0.0])
    point = palm(body, "R", -0.012, p["place"], JAVELIN_RADIUS)
    up = Axis(np.array([0.0, 0.0, -1.0]), above, 0.3)
    reach = Reach("R", point, np.array(JAVELIN.pos), (Axis(across, nose), up), np.zeros(3))
    return (reach,)


def _basketball_reaches(body: Body, p: dict[str, float]) -> tuple[Reach, ...]:
    radius = BASKETBALL.shapes[0].size[0]
    reaches = []
    for side in HANDS["basketball"]:
        left = 1.0 if side == "L" else -1.0
        # From the ball to the palm: beside, behind and below it.
        outward = np.array([-math.sin(p["behind"]), 0.0, -math.sin(p["below"])])
        outward[1] = left * math.sqrt(1.0 - outward @ outward)
        tips = np.array([math.cos(p["rise"]), 0.0, math.sin(p["rise"])])
        fingers = tips - (tips @ outward) * outward
        axes = (
            Axis(np.array([0.0, 0.0, -1.0]), -outward),
            Axis(np.array([0.0, left, 0.0]), fingers / np.linalg.norm(fingers), 1.0),
        )
        place = np.array(BASKETBALL.pos) + radius * outward
        point = palm(body, side, -0.015, p["place"])
        reaches.append(Reach(side, point, place, axes, -p["press"] * outward))
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


def try_hold(name: str, parameters: dict[str, float], seed: int) -> Hold:
    """The hold that these parameters lead to, good or bad. Raises ValueError if none does."""
    search, hands = SEARCHES[name], HANDS[name]
    rig = Rig(load_body("smplx", limits="anatomical"), search.held, hands)
    slot, wanted = rig.scene.object_qpos(search.held.name), np.array(search.held.pos)
    reaches = search.reaches(rig.body, parameters)
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
        # Rounded, so that what the data file says leads to the same hold.
        drawn = {k: round(rng.uniform(*span), 4) for k, span in SEARCHES[name].ranges.items()}
        try:
            hold = try_hold(name, drawn, seed)
        except ValueError:
            continue
        bad = badness(hold)
        if best is None or bad < best[2]:
            best = hold, drawn, bad
            print(f"trial {trial}: badness {bad:.4f} with {drawn}", flush=True)
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
    drawn = json.dumps(parameters)
    path.write_text(
        f'{{\n  "command": "{command}",\n  "parameters": {drawn},\n'
        f'  "hands": {json.dumps(hold.hands)},\n  "root_height": {hold.root_height},\n'
        f'  "object": {held},\n  "joints": {{\n{lines}\n  }}\n}}\n'
    )


def main() -> None:
    """Searches, writes the data file and says how well the hold stands."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("name", choices=sorted(SEARCHES))
    parser.add_argument("--trials", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=None, help="data file, if not the package's")
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
