"""Holds: how a SMPL-X athlete stands with an object in its hands, as found by simulation.

A hold is data (``data/hold_*.json``), made by ``python -m sports.humanoid.grip NAME``: joint
angles, the object's pose and the torques of the servos at rest. The PD targets of any strength
follow as ``angle + torque / kp``, so that one record serves all of them. Facing +x, the root
upright over (0, 0).
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources

from sports.humanoid.body import Body, Shape
from sports.scene import Scene, SceneObject, Start

JAVELIN_LENGTH, JAVELIN_RADIUS = 2.7, 0.0125
"""m; the men's javelin is 2.6 to 2.7 m long and 25 to 30 mm thick (World Athletics)."""
AIR = 1.2
"""kg/m^3"""
SKIN_FRICTION, CYLINDER_DRAG = 0.004, 1.1
"""Coefficients along a smooth rod (of its surface; turbulent) and across it (of its side view):
textbook values. The force acts at the centre of mass: nothing turns the javelin in flight."""
NOSE_UP = math.radians(30.0)
_END = JAVELIN_LENGTH / 2 - JAVELIN_RADIUS
JAVELIN = SceneObject(
    name="javelin",
    shapes=(Shape("capsule", (-_END, 0.0, 0.0), (JAVELIN_RADIUS,), 0.8, end=(_END, 0.0, 0.0)),),
    motion="free",
    pos=(0.24, -0.59, 1.61),
    quat=(math.cos(NOSE_UP / 2), 0.0, -math.sin(NOSE_UP / 2), 0.0),
    friction=1.0,  # a cord grip in a dry hand
    rgba=(0.85, 0.85, 0.2, 1.0),
    drag=(
        0.5 * AIR * SKIN_FRICTION * 2.0 * math.pi * JAVELIN_RADIUS * JAVELIN_LENGTH,
        0.5 * AIR * CYLINDER_DRAG * 2.0 * JAVELIN_RADIUS * JAVELIN_LENGTH,
    ),
    holdable=True,
)
"""The nose is at the end of its +x axis, the grip at the centre of mass."""
BASKETBALL = SceneObject(
    name="ball",
    shapes=(Shape("sphere", (0.0, 0.0, 0.0), (0.12,), 0.6),),
    motion="free",
    pos=(0.35, 0.0, 1.5),
    friction=1.0,
    rgba=(0.85, 0.42, 0.15, 1.0),
    restitution=0.85,
    grip=1.0,
    holdable=True,
)
"""It leaves the floor, the ring and the board with 0.85 of its speed, but lies in the hands."""
HELD = {"javelin": JAVELIN, "basketball": BASKETBALL}
"""What the holds are for, by their names."""
HANDS = {"javelin": ("R",), "basketball": ("L", "R")}
_ARM = ("Thorax", "Shoulder", "Elbow", "Wrist", "Index", "Middle", "Ring", "Pinky", "Thumb")
_SPINE = ("Torso", "Spine", "Chest")


@dataclass(frozen=True)
class Hold:
    """How to stand and what to press with, so that an object stays in the hands."""

    name: str
    root_height: float
    """m"""
    angles: dict[str, float]
    """Joint angles by dof (rad), 0 for the others."""
    torques: dict[str, float]
    """Of the servos (N m) by dof, at rest; 0 for the others."""
    pos: tuple[float, float, float]
    """The object's place (m) and attitude."""
    quat: tuple[float, float, float, float]
    hands: tuple[str, ...]
    """Sides ("L", "R") of the hands that hold."""

    def start(self, body: Body) -> Start:
        """The athlete with the object in its hands, at the origin, facing +x. Raises ValueError
        for a body that lacks the joints."""
        missing = set(self.angles) - {dof.name for dof in body.dofs}
        if missing:
            raise ValueError(
                f"the hold of the {self.name} needs the fingers of body 'smplx'; body "
                f"'{body.name}' has no joint '{min(missing)}'"
            )
        return Start(pose=self.angles, z=self.root_height)

    def targets(self, body: Body) -> dict[str, float]:
        """PD targets (rad) by dof that keep the hold, for the body's servos."""
        targets = {
            dof.name: self.angles.get(dof.name, 0.0) + self.torques.get(dof.name, 0.0) / dof.kp
            for dof in body.dofs
        }
        return {name: target for name, target in targets.items() if target != 0.0}

    def steady(self, body: Body) -> frozenset[str]:
        """Dofs between the root and what it holds: noise there would tear the hands off it."""
        links = (*_SPINE, *(f"{side}_{link}" for side in self.hands for link in _ARM))
        return frozenset(dof.name for dof in body.dofs if dof.link.startswith(links))

    def placed(self, held: SceneObject) -> SceneObject:
        """The object where the hold has it."""
        return replace(held, pos=self.pos, quat=self.quat)

    def scene(self, body: Body, held: SceneObject, name: str = "hold") -> Scene:
        """The athlete with the object and nothing else."""
        return Scene(
            name=name,
            body=body,
            agents=(self.start(body),),
            objects=(self.placed(held),),
            offset=self.targets(body),
            steady=self.steady(body),
            timestep=1.0 / 240.0,
            substeps=8,
        )


@cache
def load_hold(name: str) -> Hold:
    """The packaged hold of that name. Raises ValueError for an unknown one."""
    file = resources.files("sports.humanoid").joinpath("data", f"hold_{name}.json")
    if name not in HELD or not file.is_file():
        raise ValueError(f"unknown hold '{name}'; known: {', '.join(HELD)}")
    data = json.loads(file.read_text())
    joints: dict[str, list[float]] = data["joints"]
    return Hold(
        name=name,
        root_height=data["root_height"],
        angles={dof: angle for dof, (angle, _) in joints.items()},
        torques={dof: torque for dof, (_, torque) in joints.items()},
        pos=tuple(data["object"]["pos"]),
        quat=tuple(data["object"]["quat"]),
        hands=tuple(data["hands"]),
    )
