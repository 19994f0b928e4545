"""Scene objects in a Drake plant: free ones, fixtures, balls that bounce, what hands can hold."""

# The stubs of Drake type arrays, ports and modules more narrowly than they are.
# pyright: reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import (
    CollisionFilterDeclaration,
    GeometryId,
    GeometrySet,
    ProximityProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, QuaternionFloatingJoint, RigidBody

from sports.humanoid.drake_plant import (
    FRICTION,
    HOLD_STIFFNESS,
    OBJECT_DISSIPATION,
    OBJECT_STIFFNESS,
    DrakeHumanoid,
    add_ground,
    add_shapes,
    contact_properties,
    drake_shape,
    link_inertia,
)
from sports.physics.base import GRAVITY
from sports.scene import SceneObject

BOUNCE_LOSS = 1.7
"""Of Drake's discrete contact without dissipation: ``-ln(restitution) = BOUNCE_LOSS c`` where c is
the time step times the contact's frequency sqrt(stiffness / mass), for c < 0.2 (measured in drops
from 1 and 2 m; pi / 2 of an implicit Euler step, the rest is the ground's)."""
KICK_LOSS = 1.51
"""The same against surfaces that take nothing, which is what a ball that is kicked meets (measured
at 3 to 20 m/s and 1/960 to 1/7680 s: restitution 0.79 to 0.81 where 0.8 is asked for)."""
KICKED_STIFFNESS = 1e8
"""Of those surfaces (N/m): all of the spring is the ball's."""
_HELD = "held"


@dataclass(frozen=True)
class PlantObject:
    """A free object or a fixture in the plant."""

    name: str
    rigid: RigidBody
    frame: FixedOffsetFrame | None
    """Frame F of a fixture, whose X_WF is a context parameter; None for a free object."""
    joint: QuaternionFloatingJoint | None
    """Of a free object with the world: q = [quaternion wxyz, p_WB], v = [w_WB_W, v_WBo_W]."""
    quat: tuple[float, float, float, float]
    stiffness: float = OBJECT_STIFFNESS
    """Of its contacts (N/m); a ball's follows from its restitution and the time step."""
    reach: float = 0.0
    """Of a ball that is kicked: height (m) of its centre at which it begins to touch the ground."""


def add_object(
    plant: MultibodyPlant,
    obj: SceneObject,
    timestep: float,
    dissipation: float,
    points: list[GeometryId],
    shapes: list[GeometryId],
    stiffness: float = OBJECT_STIFFNESS,
) -> PlantObject:
    """Adds a scene object; its geometries are appended to ``points`` and ``shapes``."""
    instance = plant.AddModelInstance(obj.name)
    rigid = plant.AddRigidBody(obj.name, instance, link_inertia(obj.shapes))
    frame, joint, reach = None, None, 0.0
    if obj.motion in ("free", "ball"):
        damping = obj.rolling_damping() if obj.rolling else 0.0
        joint = QuaternionFloatingJoint(
            obj.name, plant.world_frame(), rigid.body_frame(), angular_damping=damping
        )
        joint = plant.AddJoint(joint)
    else:
        X_WF = RigidTransform(Quaternion(np.array(obj.quat, dtype=float)), np.array(obj.pos))
        frame = plant.AddFrame(FixedOffsetFrame(f"{obj.name}_fixture", plant.world_frame(), X_WF))
        plant.WeldFrames(frame, rigid.body_frame())
    if obj.motion == "ball":  # touches what the ball law says
        return PlantObject(obj.name, rigid, frame, joint, obj.quat)
    if obj.restitution is not None:
        (sphere,) = obj.shapes
        stiffness = _ball_stiffness(obj, sphere.mass, timestep)
        sinks = 0.0 if obj.holdable else sphere.mass * GRAVITY / stiffness
        reach = sphere.size[0] + sinks
        own = _add_ball(plant, rigid, obj, stiffness, sinks)
    else:
        own = add_shapes(
            plant,
            rigid,
            obj.name,
            obj.shapes,
            contact_properties(obj.friction, stiffness, dissipation),
            ground=obj.motion == "free" and obj.meets_ground,
            firm=contact_properties(obj.friction, HOLD_STIFFNESS, dissipation)
            if obj.holdable
            else None,
        )
    points.extend(own[0])
    shapes.extend(own[1])
    return PlantObject(obj.name, rigid, frame, joint, obj.quat, stiffness, reach)


def _ball_stiffness(ball: SceneObject, mass: float, timestep: float) -> float:
    """N/m with which a ball of a mass (kg) has its restitution at that time step (s)."""
    assert ball.restitution is not None
    loss = BOUNCE_LOSS if ball.holdable else KICK_LOSS
    frequency = -math.log(ball.restitution) / (loss * timestep)
    return mass * frequency**2


def _add_ball(
    plant: MultibodyPlant, rigid: RigidBody, ball: SceneObject, stiffness: float, sinks: float
) -> tuple[list[GeometryId], list[GeometryId]]:
    """A ball that bounces: (sphere for the ground, sphere for the rest). The former is larger by
    what it ``sinks`` (m), so that at rest and rolling its centre is as high as it is wide. What
    hands can hold has one more for athletes alone, which is firm; then nothing but the ground rubs
    on the others."""
    (sphere,) = ball.shapes
    X_BS, usual = drake_shape(sphere)
    low = Sphere(sphere.size[0] + sinks)
    soft, firm = (stiffness, 0.0), (HOLD_STIFFNESS, OBJECT_DISSIPATION)
    surfaces = [("ground", ball.friction, soft), ("rest", ball.grip, soft)]
    if ball.holdable:
        surfaces[1:] = [("rest", 0.0, soft), (_HELD, ball.grip, firm)]
    # Drake combines two coefficients as 2 a b / (a + b), and the other surface has 1.
    found = [
        plant.RegisterCollisionGeometry(
            rigid,
            X_BS,
            low if against == "ground" else usual,
            f"{ball.name}_{against}",
            contact_properties(friction / (2.0 - friction), *compliance),
        )
        for against, friction, compliance in surfaces
    ]
    return found[:1], found[1:]


def separate_held(
    scene_graph: SceneGraph, humanoids: Sequence[DrakeHumanoid], shapes: Sequence[GeometryId]
) -> None:
    """Of balls that hands can hold, athletes meet the firm sphere and the objects the soft one."""
    inspector = scene_graph.model_inspector()
    name = {g: inspector.GetName(g).split("::")[-1] for g in shapes}
    held = [g for g in shapes if name[g].endswith(f"_{_HELD}")]
    soft = [g for h in held for g in shapes if name[g] == name[h].replace(_HELD, "rest")]
    athletes = [g for h in humanoids for own in h.shapes for g in own]
    declare = CollisionFilterDeclaration()
    declare.ExcludeBetween(GeometrySet(soft), GeometrySet(athletes))
    declare.ExcludeBetween(GeometrySet(held), GeometrySet([g for g in shapes if g not in held]))
    scene_graph.collision_filter_manager().Apply(declare)


def add_kick_surfaces(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    humanoids: Sequence[DrakeHumanoid],
    ground: GeometryId,
    ground_friction: float,
    points: Sequence[GeometryId],
    shapes: Sequence[GeometryId],
    kicked: Sequence[PlantObject],
) -> dict[GeometryId, GeometryId]:
    """What balls that are kicked meet, and nothing else does, instead of ground and athletes, whose
    own contacts take energy from them, the more the firmer the ball is: the same shapes, firm and
    without loss. Which shape of an athlete each of them doubles."""

    def properties(friction: float) -> ProximityProperties:
        return contact_properties(friction, KICKED_STIFFNESS, 0.0)

    floor = add_ground(plant, "ground_for_kicks", properties(ground_friction))
    doubles = {
        plant.RegisterCollisionGeometry(
            rigid, *drake_shape(shape), f"{link.name}_for_kicks{i}", properties(FRICTION)
        ): geometry
        for humanoid in humanoids
        for link, rigid, own in zip(humanoid.body.links, humanoid.links, humanoid.shapes)
        for i, (shape, geometry) in enumerate(zip(link.shapes, own))
    }
    balls = {g for ball in kicked for g in plant.GetCollisionGeometriesForBody(ball.rigid)}
    low, whole = [g for g in points if g in balls], [g for g in shapes if g in balls]
    limbs, athletes = list(doubles), list(doubles.values())
    feet = [g for h in humanoids for link in h.points for g in link]
    usual = [*points, *shapes, *athletes, *feet, ground]
    declare = CollisionFilterDeclaration()
    declare.ExcludeWithin(GeometrySet([*limbs, floor]))
    for surface, met in (([floor], low), (limbs, whole)):
        rest = GeometrySet([g for g in usual if g not in met])
        declare.ExcludeBetween(GeometrySet(surface), rest)
    declare.ExcludeBetween(GeometrySet(ground), GeometrySet(low))
    declare.ExcludeBetween(GeometrySet(athletes), GeometrySet(whole))
    scene_graph.collision_filter_manager().Apply(declare)
    return doubles


def floating(joint: QuaternionFloatingJoint | None) -> tuple[int, int]:
    """Where a free object's quaternion starts in q and its angular velocity in v."""
    assert joint is not None
    return joint.position_start(), joint.velocity_start()
