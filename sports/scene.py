"""A scene is data: the athletes, the objects around them, and which contacts a task asks about.

Engines build their models from a :class:`Scene` and nothing else. World frame: z up, ground at
z = 0, play along +x. Units: m, kg, s, rad.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sports.humanoid.body import Body, Shape

GROUND = "ground"
"""The plane z = 0, as a contact side."""


@dataclass(frozen=True)
class Start:
    """Where an athlete stands, which way it faces, and how."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    """Heading about +z (rad); 0 faces +x."""
    pose: Mapping[str, float] = field(default_factory=dict)
    """Joint angles (rad) by dof; 0 for the others."""
    z: float | None = None
    """Height of the root (m); None for soles 5 mm above ground at the zero pose."""


@dataclass(frozen=True)
class SceneObject:
    """A ball, a bar, an upright, a net: shapes rigidly joined, and how they move.

    ``free`` objects have a free joint and are simulated; ``fixed`` ones never move; ``mocap``
    ones are fixtures whose position is state, set per world at a reset (uprights, hurdles).
    """

    name: str
    shapes: tuple[Shape, ...]
    motion: Literal["free", "fixed", "mocap"]
    pos: tuple[float, float, float]
    """Start position of the object's frame in the world (m)."""
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    friction: float = 1.0
    rgba: tuple[float, float, float, float] = (0.8, 0.3, 0.2, 1.0)
    meets_ground: bool = True
    """Whether the object collides with the ground plane."""
    solref: tuple[float, float] | None = None
    """MuJoCo contact reference (time constant s, damping ratio); None for the default."""
    restitution: float | None = None
    """Of a ball (a free object of one sphere): share of the normal speed that it keeps when it hits
    anything, which it alone decides; None for the engine's own contact. Its ``friction`` is then
    that with the ground. docs/physics.md says how the engines reach it."""
    grip: float = 0.0
    """Friction of such a ball with athletes. With other objects it has none."""
    rolling: float = 0.0
    """Rate at which such a ball loses speed as it rolls (1/s): from v it rolls v / rate far."""
    holdable: bool = False
    """Whether hands can hold it: its contacts with athletes are then firm (``mjcf.HOLD_SOLREF``),
    whatever ``solref`` and ``restitution`` say; in MuJoCo's usual ones friction creeps by
    centimetres a second."""

    def __post_init__(self) -> None:
        if self.restitution is None:
            if self.grip or self.rolling:
                raise ValueError(f"object '{self.name}': grip and rolling need a restitution")
            return
        if self.motion != "free" or [s.kind for s in self.shapes] != ["sphere"]:
            raise ValueError(f"object '{self.name}': only a free ball of one sphere can bounce")
        if not 0.0 < self.restitution < 1.0:
            raise ValueError(
                f"object '{self.name}': the restitution must be in (0, 1), not {self.restitution}"
            )
        if min(self.friction, self.grip, self.rolling) < 0.0 or max(self.friction, self.grip) >= 2:
            raise ValueError(
                f"object '{self.name}': friction and grip must be in [0, 2), rolling not negative"
            )

    def rolling_damping(self) -> float:
        """Torque against its spin (N m s/rad) that slows a rolling ball at the rate ``rolling``:
        (m + I / r^2) dv/dt = -damping v / r^2, with I = 2/5 m r^2 of a solid ball."""
        (sphere,) = self.shapes
        return self.rolling * 1.4 * sphere.mass * sphere.size[0] ** 2


@dataclass(frozen=True)
class Scene:
    """One world: athletes (agents), objects, time step and the contacts that a task names.

    State layout on every engine: ``qpos`` = for each agent 7 + num_dofs, then 7 for each free
    object in order; ``qvel`` = for each agent 6 + num_dofs, then 6 for each free object.
    """

    name: str
    body: Body
    agents: tuple[Start, ...] = (Start(),)
    objects: tuple[SceneObject, ...] = ()
    contact_pairs: tuple[tuple[str, str], ...] = ()
    """Pairs reported in ``Physics.pair_force``; each side is ``"agent0"`` (all its links), a
    link ``"agent0/L_Hand"``, one of its shapes ``"agent0/L_Hand:1"``, a link and all beyond it
    ``"agent0/L_Wrist/"`` (a hand with its fingers), an object's name, or (the second side)
    ``"ground"``."""
    link_contacts: bool = False
    """Whether ``Physics.link_force`` is wanted."""
    timestep: float = 1.0 / 120.0
    substeps: int = 4
    ground_friction: float = 1.0
    rows_per_world: int = 0
    """Constraint rows reserved per world on the GPU; 0 for the default of the body."""
    contacts_per_world: int = 0
    """Contacts reserved per world on the GPU; 0 for the default of the body."""
    offset: Mapping[str, float] = field(default_factory=dict)
    """PD targets (rad) of action 0 by dof, of every athlete; 0 for the others. An athlete who
    holds something goes on holding it with action 0."""
    steady: frozenset[str] = frozenset()
    """Dofs without noise at the start: those between two things that hold each other."""
    sites: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """Named marks drawn by the renderer (goal, line), world frame (m)."""

    @property
    def control_timestep(self) -> float:
        """Seconds per control step."""
        return self.timestep * self.substeps

    @property
    def num_agents(self) -> int:
        return len(self.agents)

    @property
    def free_objects(self) -> tuple[SceneObject, ...]:
        return tuple(o for o in self.objects if o.motion == "free")

    @property
    def bouncing(self) -> tuple[SceneObject, ...]:
        """The balls with a restitution: they bounce and roll."""
        return tuple(o for o in self.free_objects if o.restitution is not None)

    @property
    def mocap_objects(self) -> tuple[SceneObject, ...]:
        return tuple(o for o in self.objects if o.motion == "mocap")

    @property
    def nq(self) -> int:
        return self.num_agents * (7 + self.body.num_dofs) + 7 * len(self.free_objects)

    @property
    def nv(self) -> int:
        return self.num_agents * (6 + self.body.num_dofs) + 6 * len(self.free_objects)

    @property
    def nu(self) -> int:
        """Actuators of all agents together."""
        return self.num_agents * self.body.num_dofs

    def action_offset(self) -> np.ndarray:
        """(num_dofs,) PD targets (rad) of action 0, of one athlete."""
        return np.array([self.offset.get(dof.name, 0.0) for dof in self.body.dofs])

    def agent_qpos(self, agent: int) -> slice:
        """Where an agent's 7 + num_dofs positions lie in ``qpos``."""
        n = 7 + self.body.num_dofs
        return slice(agent * n, (agent + 1) * n)

    def agent_qvel(self, agent: int) -> slice:
        """Where an agent's 6 + num_dofs velocities lie in ``qvel``."""
        n = 6 + self.body.num_dofs
        return slice(agent * n, (agent + 1) * n)

    def object_qpos(self, name: str) -> slice:
        """Where a free object's position and quaternion lie in ``qpos``. Raises KeyError."""
        start = self.num_agents * (7 + self.body.num_dofs) + 7 * self._free_index(name)
        return slice(start, start + 7)

    def object_qvel(self, name: str) -> slice:
        """Where a free object's linear and angular velocity lie in ``qvel``. Raises KeyError."""
        start = self.num_agents * (6 + self.body.num_dofs) + 6 * self._free_index(name)
        return slice(start, start + 6)

    def _free_index(self, name: str) -> int:
        names = [o.name for o in self.free_objects]
        if name not in names:
            raise KeyError(f"scene '{self.name}' has no free object '{name}'")
        return names.index(name)

    def default_qpos(self) -> np.ndarray:
        """(nq,) every athlete in its start pose, objects where the scene puts them."""
        qpos = np.zeros(self.nq)
        height = self.body.standing_height()
        dofs = [dof.name for dof in self.body.dofs]
        for i, start in enumerate(self.agents):
            own = qpos[self.agent_qpos(i)]
            for name, angle in start.pose.items():
                own[7 + dofs.index(name)] = angle
            own[:7] = (
                start.x,
                start.y,
                height if start.z is None else start.z,
                math.cos(start.yaw / 2),
                0.0,
                0.0,
                math.sin(start.yaw / 2),
            )
        for o in self.free_objects:
            qpos[self.object_qpos(o.name)] = (*o.pos, *o.quat)
        return qpos

    def default_mocap_pos(self) -> np.ndarray:
        """(M, 3) positions of the mocap objects."""
        return np.array([o.pos for o in self.mocap_objects], dtype=float).reshape(-1, 3)


def humanoid_scene(body: Body, **kwargs: object) -> Scene:
    """One athlete on the ground and nothing else, for parity tests and optimisation."""
    return Scene(name=f"{body.name}_alone", body=body, **kwargs)  # type: ignore[arg-type]
