"""Body -> Drake MultibodyPlant, built in code from the same table rows as the MJCF.

Drake's own inertia formulas are used, so that a parity test compares two independent
implementations of the mass properties. The MJCF is never parsed: Drake's parser would put a
body's offset on the last of three hinges and drop gains and collision masks.

Each link but the root hangs on three revolute joints (x, y, z) with two massless bodies in
between; the root is a quaternion floating body. Notation: p_WB is the position of link B in
the world W, V_WB its spatial velocity, M_SLo_L the spatial inertia of a shape S about the
link's origin Lo expressed in L.

Contact. MuJoCo touches a plane with the 8 corners of a box and the 2 ends of a capsule, Drake's
point contact has one point per pair of geometries. Each of those points is therefore a small
sphere of its own (`points`), which meets the ground and nothing else, while the true shapes
(`shapes`) meet everything but the ground.
"""

# The stubs of Drake and MuJoCo type arrays, ports and modules more narrowly than they are.
# pyright: reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import (
    Box,
    Capsule,
    CollisionFilterDeclaration,
    Cylinder,
    GeometryId,
    GeometrySet,
    ProximityProperties,
    SceneGraph,
    Sphere,
)
from pydrake.geometry import Shape as DrakeShape
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    ContactModel,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JointActuator,
    ModelInstanceIndex,
    PdControllerGains,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
)
from pydrake.systems.framework import Diagram, DiagramBuilder

from sports.humanoid.body import Body, Shape, is_finger, support_points

POINT_RADIUS = 1e-4
"""Radius (m) of the sphere that stands for a box corner against the ground."""
FRICTION = 1.0
"""Coulomb coefficient of every geometry (sports.md, Common). Drake combines two coefficients as
2 a b / (a + b), which is 1 for two surfaces of 1."""
STIFFNESS = 2e5
"""Point contact stiffness (N/m) of athletes and ground: a standing athlete sinks in by less than
1 mm on 16 sole corners."""
DISSIPATION = 0.3
"""Hunt-Crossley dissipation (s/m). From 1024 states of running and jumping athletes, the same
targets for 4 control steps, centres of mass differ from MuJoCo's at 1/1920 s by 0.00, 0.00 m/s in
the mean (forward, up) and 0.08, 0.07, 0.08 rms at strength ``human``; see docs/physics.md. With
10 s/m the force of an impact was 1.7 times MuJoCo's."""
OBJECT_STIFFNESS, OBJECT_DISSIPATION = 1e5, 1.0
"""Of bars, uprights and other objects: a pushed bar leaves its groove as in MuJoCo."""
HOLD_STIFFNESS = 1e6
"""Of hands with fingers and of what they can hold (N/m), half of it for both together. In the
holds, MuJoCo's contacts have 4e5 N/m at the fingers and 6.6e5 at the palm (force by depth). With
the stiffnesses above it was 6.7e4: fingers sank in by a tenth of a millimetre more, and since they
are held by stiff servos the javelin was pressed with 14 N instead of 47."""

_UNIT = np.eye(3)


@dataclass(frozen=True)
class DrakeHumanoid:
    """One athlete inside a finalized plant.

    State maps work on this athlete's own slices, batched over leading dimensions; `q_index` and
    `v_index` place them in the whole plant's q and v.
    """

    body: Body
    instance: ModelInstanceIndex
    links: tuple[RigidBody, ...]
    """In the order of ``body.links``."""
    joints: tuple[RevoluteJoint, ...]
    """In the order of ``body.dofs``; named as the dofs."""
    actuators: tuple[JointActuator, ...]
    """In the order of ``body.dofs``."""
    points: tuple[tuple[GeometryId, ...], ...]
    """Per link: spheres that touch the ground only; none for fingers."""
    shapes: tuple[tuple[GeometryId, ...], ...]
    """Per link: the true shapes, which touch everything but the ground."""

    @cached_property
    def q_index(self) -> np.ndarray:
        """(7 + num_dofs,) index into the plant's q of [quaternion wxyz, p_WB, dofs by name]."""
        base = self.links[0].floating_positions_start()
        return np.array([*range(base, base + 7), *(j.position_start() for j in self.joints)])

    @cached_property
    def v_index(self) -> np.ndarray:
        """(6 + num_dofs,) index into the plant's v of [w_WB_W, v_WBo_W, dofs by name]."""
        base = self.links[0].floating_velocities_start_in_v()
        return np.array([*range(base, base + 6), *(j.velocity_start() for j in self.joints)])

    def to_drake(self, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """MuJoCo state to this athlete's Drake state, ordered as `q_index` and `v_index`.

        qpos (..., 7 + n) = [p, quat wxyz, dofs], qvel (..., 6 + n) = [v_W, w_B, rates] ->
        q (..., 7 + n) = [quat wxyz, p, dofs], v (..., 6 + n) = [w_W, v_W, rates].
        The quaternion is normalised. Raises ValueError for wrong widths.
        """
        qpos, qvel = self._checked(qpos, qvel)
        quat = qpos[..., 3:7] / np.linalg.norm(qpos[..., 3:7], axis=-1, keepdims=True)
        q = np.concatenate([quat, qpos[..., :3], qpos[..., 7:]], axis=-1)
        w_W = rotate(quat, qvel[..., 3:6])
        return q, np.concatenate([w_W, qvel[..., :3], qvel[..., 6:]], axis=-1)

    def from_drake(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inverse of `to_drake`: this athlete's Drake state to MuJoCo's (qpos, qvel)."""
        q, v = self._checked(q, v)
        quat = q[..., :4] / np.linalg.norm(q[..., :4], axis=-1, keepdims=True)
        qpos = np.concatenate([q[..., 4:7], quat, q[..., 7:]], axis=-1)
        conjugate = quat * np.array([1.0, -1.0, -1.0, -1.0])
        w_B = rotate(conjugate, v[..., :3])
        return qpos, np.concatenate([v[..., 3:6], w_B, v[..., 6:]], axis=-1)

    def velocity_map(self, quat: np.ndarray) -> np.ndarray:
        """(6 + n, 6 + n) T with v_drake = T qvel_mujoco at a unit quaternion (w, x, y, z).

        Powers agree, so forces map as tau_mujoco = T' tau_drake and M_mujoco = T' M_drake T.
        """
        n = self.body.num_dofs
        T = np.zeros((6 + n, 6 + n))
        T[:3, 3:6] = RotationMatrix(Quaternion(np.asarray(quat, dtype=float))).matrix()
        T[3:6, :3] = np.eye(3)
        T[6:, 6:] = np.eye(n)
        return T

    def _checked(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q, v = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
        n = self.body.num_dofs
        if q.shape[-1] != 7 + n or v.shape[-1] != 6 + n:
            raise ValueError(
                f"body '{self.body.name}' needs {7 + n} positions and {6 + n} velocities, "
                f"not {q.shape[-1]} and {v.shape[-1]}"
            )
        return q, v


@dataclass(frozen=True)
class PlantModel:
    """A finalized plant with one athlete (and the ground)."""

    plant: MultibodyPlant
    scene_graph: SceneGraph
    diagram: Diagram
    humanoid: DrakeHumanoid


def rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate (..., 3) vectors by unit quaternions (..., 4) in (w, x, y, z)."""
    w, u = quat[..., :1], quat[..., 1:]
    t = 2.0 * np.cross(u, vector)
    return vector + w * t + np.cross(u, t)


def shape_inertia(shape: Shape) -> SpatialInertia:
    """M_SLo_L: spatial inertia of one shape about its owner's origin, by Drake's formulas."""
    center = np.asarray(shape.center, dtype=float)
    if shape.kind == "box":
        M_SScm = SpatialInertia.SolidBoxWithMass(shape.mass, *(2.0 * np.array(shape.size)))
    elif shape.kind == "sphere":
        M_SScm = SpatialInertia.SolidSphereWithMass(shape.mass, shape.size[0])
    else:
        segment = np.asarray(shape.end) - center
        length = float(np.linalg.norm(segment))
        center = center + segment / 2.0
        make = (
            SpatialInertia.SolidCapsuleWithMass
            if shape.kind == "capsule"
            else SpatialInertia.SolidCylinderWithMass
        )
        M_SScm = make(shape.mass, shape.size[0], length, segment / length)
    return M_SScm.Shift(-center)


def link_inertia(shapes: Iterable[Shape]) -> SpatialInertia:
    """M_LLo_L: sum over a link's shapes. Raises ValueError when there are none."""
    inertias = [shape_inertia(shape) for shape in shapes]
    if not inertias:
        raise ValueError("a link of the body has no shape, hence no mass")
    total = inertias[0]
    for inertia in inertias[1:]:
        total += inertia
    return total


def drake_shape(shape: Shape) -> tuple[RigidTransform, DrakeShape]:
    """Pose X_LS in the owner's frame and Drake geometry of a shape."""
    center = np.asarray(shape.center, dtype=float)
    if shape.kind == "box":
        return RigidTransform(center), Box(*(2.0 * np.array(shape.size)))
    if shape.kind == "sphere":
        return RigidTransform(center), Sphere(shape.size[0])
    segment = np.asarray(shape.end) - center
    length = float(np.linalg.norm(segment))
    R_LS = RotationMatrix.MakeFromOneVector(segment, axis_index=2)
    make = Capsule if shape.kind == "capsule" else Cylinder
    return RigidTransform(R_LS, center + segment / 2.0), make(shape.size[0], length)


def contact_properties(
    friction: float = FRICTION,
    stiffness: float = STIFFNESS,
    dissipation: float = DISSIPATION,
) -> ProximityProperties:
    """Point contact properties: Coulomb coefficient, stiffness (N/m), dissipation (s/m)."""
    properties = ProximityProperties()
    properties.AddProperty("material", "coulomb_friction", CoulombFriction(friction, friction))
    properties.AddProperty("material", "point_contact_stiffness", float(stiffness))
    properties.AddProperty("material", "hunt_crossley_dissipation", float(dissipation))
    return properties


def add_ground(
    plant: MultibodyPlant,
    name: str = "ground",
    properties: ProximityProperties | None = None,
) -> GeometryId:
    """The plane z = 0 on the world body: the top of a box, 1 km wide and 20 m deep.

    A box prunes pairs in the broad phase, a half space meets every sphere every step.
    """
    return plant.RegisterCollisionGeometry(
        plant.world_body(),
        RigidTransform([0.0, 0.0, -10.0]),
        Box(1000.0, 1000.0, 20.0),
        name,
        properties or contact_properties(),
    )


def add_humanoid(plant: MultibodyPlant, body: Body, name: str = "athlete") -> DrakeHumanoid:
    """Add an athlete to a plant that is not finalized yet.

    The plant must be registered with a SceneGraph for contact; without one only dynamics are
    available. Gains act as physics.md says: servo kp limited to +-effort, kd as joint damping,
    armature as rotor inertia behind a gear of 1. Call `filter_collisions` once everything is
    in the plant. The maps of the returned handle are valid after ``plant.Finalize()``.
    """
    instance = plant.AddModelInstance(name)
    dofs = {dof.name: dof for dof in body.dofs}
    links: dict[str, RigidBody] = {}
    joints: dict[str, RevoluteJoint] = {}
    for link in body.links:
        rigid = plant.AddRigidBody(link.name, instance, link_inertia(link.shapes))
        links[link.name] = rigid
        if link.parent is None:
            continue
        between = [
            plant.AddRigidBody(f"{link.name}_{axis}_frame", instance, SpatialInertia.Zero())
            for axis in "xy"
        ]
        chain = [links[link.parent], *between, rigid]
        for i, axis in enumerate("xyz"):
            dof = dofs[f"{link.name}_{axis}"]
            joint = RevoluteJoint(
                dof.name,
                chain[i].body_frame()
                if i
                else plant.AddFrame(_offset_frame(f"{link.name}_origin", chain[0], link.offset)),
                chain[i + 1].body_frame(),
                _UNIT[i],
                dof.lower,
                dof.upper,
                dof.kd,
            )
            joints[dof.name] = plant.AddJoint(joint)
    actuators = []
    for dof in body.dofs:
        actuator = plant.AddJointActuator(dof.name, joints[dof.name], dof.effort)
        actuator.set_default_rotor_inertia(dof.armature)
        actuator.set_default_gear_ratio(1.0)
        if plant.time_step() > 0:
            actuator.set_controller_gains(PdControllerGains(p=dof.kp, d=0.0))
        actuators.append(actuator)
    grasping = hands(body)
    geometry = [
        add_shapes(
            plant,
            links[link.name],
            link.name,
            link.shapes,
            contact_properties(),
            ground=not is_finger(link.name),
            firm=contact_properties(stiffness=HOLD_STIFFNESS) if link.name in grasping else None,
        )
        for link in body.links
    ]
    return DrakeHumanoid(
        body=body,
        instance=instance,
        links=tuple(links[link.name] for link in body.links),
        joints=tuple(joints[dof.name] for dof in body.dofs),
        actuators=tuple(actuators),
        points=tuple(points for points, _ in geometry),
        shapes=tuple(shapes for _, shapes in geometry),
    )


def hands(body: Body) -> frozenset[str]:
    """Links of hands that can hold something: fingers, and what the first of them hang on."""
    fingers = [link for link in body.links if is_finger(link.name)]
    return frozenset(name for link in fingers for name in (link.name, link.parent) if name)


def _offset_frame(name: str, parent: RigidBody, offset: Sequence[float]) -> FixedOffsetFrame:
    return FixedOffsetFrame(name, parent.body_frame(), RigidTransform(np.asarray(offset)))


def add_shapes(
    plant: MultibodyPlant,
    rigid: RigidBody,
    name: str,
    shapes: Iterable[Shape],
    properties: ProximityProperties,
    ground: bool = True,
    firm: ProximityProperties | None = None,
) -> tuple[tuple[GeometryId, ...], tuple[GeometryId, ...]]:
    """Register shapes on a body: (points for the ground, none if not ``ground``; true shapes).

    ``firm``: properties of the true shapes, if not those of the points. Nothing is registered, and
    both are empty, when the plant has no SceneGraph.
    """
    if not plant.geometry_source_is_registered():
        return (), ()
    points: list[GeometryId] = []
    solids: list[GeometryId] = []
    for i, shape in enumerate(shapes):
        X_LS, geometry = drake_shape(shape)
        solids.append(
            plant.RegisterCollisionGeometry(
                rigid, X_LS, geometry, f"{name}_shape{i}", firm or properties
            )
        )
        for k, (p_LoS_L, radius) in enumerate(support_points(shape) if ground else ()):
            points.append(
                plant.RegisterCollisionGeometry(
                    rigid,
                    RigidTransform(p_LoS_L),
                    Sphere(max(radius, POINT_RADIUS)),
                    f"{name}_point{i}_{k}",
                    properties,
                )
            )
    return tuple(points), tuple(solids)


def filter_collisions(
    scene_graph: SceneGraph,
    humanoids: Sequence[DrakeHumanoid],
    ground: Iterable[GeometryId] = (),
    object_points: Iterable[GeometryId] = (),
    object_shapes: Iterable[GeometryId] = (),
) -> None:
    """Explicit filters: points meet ``ground`` only, shapes everything but ``ground``.

    Shapes of one link, and of the pairs in ``body.excluded_pairs``, never meet; different
    athletes do, and so do athletes and objects; fingers meet objects only. The massless bodies
    between two links defeat Drake's own adjacent-body filter, so nothing is left to it.
    """
    points = [g for h in humanoids for link in h.points for g in link] + list(object_points)
    shapes = [g for h in humanoids for link in h.shapes for g in link] + list(object_shapes)
    ground = list(ground)
    declare = CollisionFilterDeclaration()
    declare.ExcludeWithin(GeometrySet(points))
    declare.ExcludeBetween(GeometrySet(points), GeometrySet(shapes))
    declare.ExcludeBetween(GeometrySet(shapes), GeometrySet(ground))
    fingers = [
        g
        for h in humanoids
        for link, own in zip(h.body.links, h.shapes)
        if is_finger(link.name)
        for g in own
    ]
    athletes = [g for h in humanoids for own in h.shapes for g in own]
    declare.ExcludeBetween(GeometrySet(fingers), GeometrySet(athletes))
    for humanoid in humanoids:
        body = humanoid.body
        for own in humanoid.shapes:
            declare.ExcludeWithin(GeometrySet(list(own)))
        for a, b in body.excluded_pairs:
            declare.ExcludeBetween(
                GeometrySet(list(humanoid.shapes[body.link_index(a)])),
                GeometrySet(list(humanoid.shapes[body.link_index(b)])),
            )
    scene_graph.collision_filter_manager().Apply(declare)


def start_plant(
    time_step: float, contact_approximation: str = "lagged"
) -> tuple[DiagramBuilder, MultibodyPlant, SceneGraph]:
    """An empty plant with its SceneGraph. ``time_step`` 0 means continuous (no PD gains).

    Raises ValueError for ``contact_approximation`` "tamsi", which ignores the PD gains.
    """
    if contact_approximation == "tamsi":
        raise ValueError("contact approximation 'tamsi' ignores PD gains; use 'lagged' or 'sap'")
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(time_step=time_step)
    if time_step > 0:
        config.discrete_contact_approximation = contact_approximation
    plant, scene_graph = AddMultibodyPlant(config, builder)
    plant.set_contact_model(ContactModel.kPoint)
    return builder, plant, scene_graph


def build_plant(
    body: Body,
    time_step: float = 1.0 / 480.0,
    ground: bool = True,
    contact_approximation: str = "lagged",
) -> PlantModel:
    """A finalized plant with one athlete at the zero pose, and the ground if asked.

    ``time_step`` in s; 0 gives a continuous plant for dynamics (M, C, gravity, kinematics,
    ``plant.ToAutoDiffXd()``), whose actuators have no PD gains.
    """
    builder, plant, scene_graph = start_plant(time_step, contact_approximation)
    plane = [add_ground(plant)] if ground else []
    humanoid = add_humanoid(plant, body)
    plant.Finalize()
    filter_collisions(scene_graph, [humanoid], plane)
    return PlantModel(plant, scene_graph, builder.Build(), humanoid)
