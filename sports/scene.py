"""A scene is data: the athletes, the objects around them, and which contacts a task asks about.

Engines build their models from a :class:`Scene` and nothing else. World frame: z up, ground at
z = 0, play along +x. Units: m, kg, s, rad.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
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
    ones are fixtures whose position is state, set per world at a reset (uprights, hurdles). A
    ``ball`` has a place in the state as a free object has, but the ball law (``sports/ball.py``)
    moves it: it meets the scene's surfaces and nothing else.
    """

    name: str
    shapes: tuple[Shape, ...]
    motion: Literal["free", "fixed", "mocap", "ball"]
    pos: tuple[float, float, float]
    """Start position of the object's frame in the world (m)."""
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    friction: float = 1.0
    rgba: tuple[float, float, float, float] = (0.8, 0.3, 0.2, 1.0)
    meets_ground: bool = True
    """Whether the object collides with the ground plane."""
    solref: tuple[float, float] | None = None
    """MuJoCo contact reference (time constant s, damping ratio); None for the default."""
    law: str | None = None
    """Which ball of ``sports.ball.BALLS`` a ``ball`` is: tennis, table_tennis, golf."""
    drag: tuple[float, float] | None = None
    """Quadratic drag of a free object through the air (N s^2/m^2): along its x axis and across
    it. The force on its centre of mass is ``-k |v| v`` of either part of its velocity."""
    holdable: bool = False
    """Whether hands can hold it: its contacts with athletes are then firm (``mjcf.HOLD_SOLREF``),
    whatever ``solref`` says; in MuJoCo's usual ones a held javelin slides by 18 mm a second."""

    restitution: float | None = None
    """Of a ball (a free object of one sphere): share of the normal speed that it keeps when it hits
    anything, which it alone decides; None for the engine's own contact. Its ``friction`` is then
    that with the ground. docs/physics.md says how the engines reach it."""
    grip: float = 0.0
    """Friction of such a ball with athletes. With other objects it has none."""
    rolling: float = 0.0
    """Rate at which such a ball loses speed as it rolls (1/s): from v it rolls v / rate far."""

    def __post_init__(self) -> None:
        if (self.motion == "ball") != (self.law is not None):
            raise ValueError(f"object '{self.name}': a ball, and only a ball, follows a ball law")
        if self.drag is not None and self.motion != "free":
            raise ValueError(f"object '{self.name}' is not free, so it has no drag")
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
class Surface:
    """Something that a ball of the ball law can hit, in the world or on an athlete's link.

    ``kind`` and ``size`` (m), in the surface's frame:
      * ``plane``: z = 0, solid below; no size
      * ``box``: half-extents (3)
      * ``disc``: across z, both faces: radius and half its thickness
      * ``waves``: z = amplitude (cos(k x + a) + cos(k y + b)) smoothstep(inner, outer) over the
        distance from the z axis; amplitude, k (rad/m), inner, outer. The phases a and b of each
        world are ``Physics.wave_phase``
    """

    name: str
    kind: Literal["plane", "box", "disc", "waves"]
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of its frame in the world, or in the frame of its link (m)."""
    size: tuple[float, ...] = ()
    link: str | None = None
    """``"agent0/R_Wrist"``: a tool, which moves with that link and feels the impacts; None for a
    surface at rest."""
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Attitude of its frame."""
    restitution: float | None = None
    """None for that of the ball: on tools if the surface is on a link, else on the ground."""
    friction: float | None = None
    """None for that of the ball."""

    def __post_init__(self) -> None:
        wanted = {"plane": 0, "box": 3, "disc": 2, "waves": 4}
        if self.kind not in wanted:
            raise ValueError(f"surface '{self.name}': unknown kind '{self.kind}'")
        if len(self.size) != wanted[self.kind] or any(x <= 0 for x in self.size):
            raise ValueError(f"surface '{self.name}': a {self.kind} cannot have size {self.size}")
        if self.kind == "waves" and (self.link is not None or self.quat != (1.0, 0.0, 0.0, 0.0)):
            raise ValueError(f"surface '{self.name}': waves lie flat in the world")


@dataclass(frozen=True)
class Scene:
    """One world: athletes (agents), objects, time step and the contacts that a task names.

    State layout on every engine: ``qpos`` = for each agent 7 + num_dofs, then 7 for each free
    object in order; ``qvel`` = for each agent 6 + num_dofs, then 6 for each free object. A ball
    of the ball law counts as a free object here. Raises ValueError for two of those.
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
    surfaces: tuple[Surface, ...] = ()
    """What a ball of the ball law can hit; ``Physics.ball_hits`` counts in this order."""
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

    def __post_init__(self) -> None:
        if sum(o.motion == "ball" for o in self.objects) > 1:
            raise ValueError(f"scene '{self.name}' has more than one ball of the ball law")
        if len({s.name for s in self.surfaces}) != len(self.surfaces):
            raise ValueError(f"scene '{self.name}' has two surfaces of one name")

    @property
    def control_timestep(self) -> float:
        """Seconds per control step."""
        return self.timestep * self.substeps

    @property
    def num_agents(self) -> int:
        return len(self.agents)

    @property
    def free_objects(self) -> tuple[SceneObject, ...]:
        """Objects with a place in the state, the ball of the ball law among them."""
        return tuple(o for o in self.objects if o.motion in ("free", "ball"))

    @property
    def ball(self) -> SceneObject | None:
        """The ball of the ball law, if there is one."""
        return next((o for o in self.objects if o.motion == "ball"), None)

    @property
    def has_waves(self) -> bool:
        """Whether a surface has phases of each world."""
        return any(s.kind == "waves" for s in self.surfaces)

    def surface_index(self, name: str) -> int:
        """Column of a surface in ``Physics.ball_hits``. Raises KeyError."""
        names = [s.name for s in self.surfaces]
        if name not in names:
            raise KeyError(f"scene '{self.name}' has no surface '{name}'")
        return names.index(name)

    @property
    def bouncing(self) -> tuple[SceneObject, ...]:
        """The balls with a restitution: they bounce and roll."""
        return tuple(o for o in self.free_objects if o.restitution is not None)

    @property
    def kicked(self) -> tuple[SceneObject, ...]:
        """Those of them that no hand holds."""
        return tuple(o for o in self.bouncing if not o.holdable)

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

    def joint_dofs(self) -> np.ndarray:
        """(nv,) bool, which of ``qvel`` are rates of athletes' joints."""
        joints = np.zeros(self.nv, dtype=bool)
        for agent in range(self.num_agents):
            joints[self.agent_qvel(agent)][6:] = True
        return joints

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

    @cached_property
    def start_qpos(self) -> tuple[float, ...]:
        """``default_qpos`` worked out once, for what asks in every step."""
        return tuple(self.default_qpos().tolist())

    def default_mocap_pos(self) -> np.ndarray:
        """(M, 3) positions of the mocap objects."""
        return np.array([o.pos for o in self.mocap_objects], dtype=float).reshape(-1, 3)


def humanoid_scene(body: Body, **kwargs: object) -> Scene:
    """One athlete on the ground and nothing else, for parity tests and optimisation."""
    return Scene(name=f"{body.name}_alone", body=body, **kwargs)  # type: ignore[arg-type]


def finer(scene: Scene, divisor: int) -> Scene:
    """The same control step in ``divisor`` times as many physics steps. Raises ValueError for a
    divisor below 1."""
    if divisor < 1:
        raise ValueError(f"timestep_divisor must be at least 1, not {divisor}")
    return replace(scene, timestep=scene.timestep / divisor, substeps=scene.substeps * divisor)
