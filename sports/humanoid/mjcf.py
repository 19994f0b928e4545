"""Writes a scene as a MuJoCo model through MjSpec.

Gains act as ``stiffness = position servo limited to +-effort``, ``damping = passive joint
damping``: a clamped damper inside the actuator stops damping and explodes (measured). Contact
forces come from contact sensors (``netforce``): one per athlete link against the ground, then
one per named pair of the scene, then (``Scene.link_contacts``) one per link against everything,
then one per bouncing ball against the ground; then each athlete's ``WHOLE_SENSORS``. Three numbers
each, world frame.

Contacts of athletes and ground yield to load (``CONTACT_IMPEDANCE``). With MuJoCo's default of
0.9-0.95 a foot that has sunk in on impact is driven out again whatever it carries, so the ground
does work: 0.16 m/s forward and 0.18 m/s up in 0.13 s of a sprint, more at a coarse time step.
docs/physics.md has the measurements.

A ball with a restitution decides by priority how it touches anything: a contact whose damping
turns the approach v into -e v within one time step. A spring would take several, in which the ball
sinks in. MuJoCo's friction pyramid has one damping for all directions, so that a ball which slides
over the ground at 15 m/s would hop 1.8 m high: there the contact has no friction, and the engine
adds Coulomb's after each step (``athletes.roll_ball``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from sports.humanoid.body import Body, Shape, is_finger
from sports.scene import GROUND, Scene, SceneObject, humanoid_scene

_KIND = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}
_FORCE_DATA = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
_NETFORCE = 3
CONTACT_SOLREF = (1.0 / 60.0, 0.7)
"""Time constant (s; two time steps of 1/120 s, the least that MuJoCo takes) and damping ratio of
the contacts of athletes and ground."""
CONTACT_IMPEDANCE = 0.6
"""Share of a contact's acceleration that is prescribed; the rest yields to the load."""
CONTACT_SOLIMP = (CONTACT_IMPEDANCE, CONTACT_IMPEDANCE, 0.001, 0.5, 2.0)
"""The impedance in MuJoCo's terms: the same at any depth."""
FIRM_SOLREF, FIRM_SOLIMP = (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)
"""The same contacts where they feel the joints' damping: MuJoCo's defaults."""
HOLD_SOLREF, HOLD_IMPEDANCE = (1.0 / 120.0, 1.0), 0.99
"""Contacts of athletes with what they can hold: the least time constant at 1/240 s, critical
damping, and so little yielding that a held javelin creeps by 0.2 mm/s."""
BOUNCE_STIFFNESS, BOUNCE_IMPEDANCE = 144.0, 0.998
"""Of a ball's contacts: acceleration per depth (1/s^2) and impedance. It lies 0.1 mm deep; at
1/120 s one that arrives at 30 m/s, up to 25 cm deep when it is seen, gains 1 % from the spring."""
# Collision classes: all that is solid, the ground plane, athletes, other objects, fingers
# (which meet objects only). What can be held has every shape twice: one for athletes, one for the
# rest.
_SOLID, _GROUND, _ATHLETE, _OBJECT, _FINGER = 1, 2, 4, 8, 16


def body_name(agent: int, link: str) -> str:
    """Name of a link's body in the MuJoCo model; ``:k`` after it is the geom of its shape k."""
    return f"agent{agent}/{link}"


def _add_shape(body: mujoco.MjsBody, shape: Shape, **fields: object) -> None:
    geom = body.add_geom(type=_KIND[shape.kind], mass=shape.mass, **fields)
    if shape.end is None:
        geom.pos = shape.center
        geom.size[: len(shape.size)] = shape.size
    else:
        geom.fromto = (*shape.center, *shape.end)
        geom.size[0] = shape.size[0]


def _add_agent(spec: mujoco.MjSpec, scene: Scene, agent: int) -> None:
    body, friction = scene.body, scene.ground_friction
    bodies: dict[str, mujoco.MjsBody] = {}
    for link in body.links:
        parent = spec.worldbody if link.parent is None else bodies[link.parent]
        node = parent.add_body(name=body_name(agent, link.name), pos=link.offset)
        if link.parent is None:
            node.pos, node.quat = np.split(scene.default_qpos()[scene.agent_qpos(agent)][:7], [3])
        bodies[link.name] = node
        if link.parent is None:
            node.add_freejoint(name=f"agent{agent}/root")
        finger = is_finger(link.name)
        for k, shape in enumerate(link.shapes):
            _add_shape(
                node,
                shape,
                name=f"{body_name(agent, link.name)}:{k}",
                friction=(friction, 0.005, 0.0001),
                contype=_FINGER if finger else _SOLID | _ATHLETE,
                conaffinity=_OBJECT if finger else _SOLID | _GROUND,
                condim=3,
                solref=CONTACT_SOLREF,
                solimp=CONTACT_SOLIMP,
                rgba=(0.72, 0.55, 0.43, 1.0) if agent % 2 == 0 else (0.35, 0.5, 0.75, 1.0),
            )
    for dof in body.dofs:
        joint = bodies[dof.link].add_joint(
            name=f"agent{agent}/{dof.name}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[float(dof.axis == a) for a in "xyz"],
            range=(dof.lower, dof.upper),
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            armature=dof.armature,
        )
        joint.damping[0] = dof.kd
        actuator = spec.add_actuator(
            name=f"agent{agent}/{dof.name}",
            target=joint.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            forcerange=(-dof.effort, dof.effort),
        )
        actuator.gainprm[0] = dof.kp
        actuator.biasprm[:3] = (0.0, -dof.kp, 0.0)
    for a, b in body.excluded_pairs:
        spec.add_exclude(bodyname1=body_name(agent, a), bodyname2=body_name(agent, b))


def yields(solref: np.ndarray) -> np.ndarray:
    """Which contact references (..., 2) of a compiled model are those of athletes and ground."""
    return np.all(np.isclose(solref, CONTACT_SOLREF), axis=-1)


def holds(solref: np.ndarray) -> np.ndarray:
    """Which are those of athletes and what they can hold."""
    return np.all(np.isclose(solref, HOLD_SOLREF), axis=-1)


def firm_ground(model: mujoco.MjModel) -> None:
    """Makes contacts of athletes and ground firm, for an engine in which they feel the damping."""
    own = yields(model.geom_solref)
    model.geom_solref[own], model.geom_solimp[own] = FIRM_SOLREF, FIRM_SOLIMP


def let_rebound(model: mujoco.MjModel, scene: Scene, links: Sequence[str]) -> None:
    """Lets ``links`` of athletes decide how they touch anything but balls, which ``rebound_geoms``
    then finds. Raises ValueError for a link that the athletes do not have."""
    for link in links:
        if link not in scene.body.link_names:
            raise ValueError(f"variation: rebound_links has '{link}', which is no link of the body")
        for agent in range(scene.num_agents):
            body = model.body(body_name(agent, link)).id
            model.geom_priority[model.geom_bodyid == body] = 1


def rebound_geoms(model: mujoco.MjModel) -> np.ndarray:
    """(geoms,) bool, those that ``let_rebound`` chose."""
    return yields(model.geom_solref) & (model.geom_priority > 0)


def is_bounce(solref: np.ndarray) -> np.ndarray:
    """Which contact references (..., 2) of a compiled model are those of a ball's bounce; their
    damping holds for one time step."""
    return np.isclose(solref[..., 0], -BOUNCE_STIFFNESS * BOUNCE_IMPEDANCE**2)


def _bounce(ball: SceneObject, timestep: float) -> dict[str, object]:
    """Fields of a geom with the restitution of a ball, at a time step (s)."""
    assert ball.restitution is not None
    # On average a ball is first seen when it has gone half a time step deep: v h / 2.
    spring = BOUNCE_STIFFNESS * timestep**2 / 2.0
    damping = (1.0 + ball.restitution - spring) / timestep
    return {
        # MuJoCo divides these by the impedance, and gives the contact that share of them.
        "solref": (-BOUNCE_STIFFNESS * BOUNCE_IMPEDANCE**2, -damping),
        "solimp": (BOUNCE_IMPEDANCE, BOUNCE_IMPEDANCE, 0.001, 0.5, 2.0),
        "priority": 2,
        "condim": 1,
    }


def _add_object(spec: mujoco.MjSpec, obj: SceneObject, timestep: float) -> None:
    node = spec.worldbody.add_body(
        name=obj.name, pos=obj.pos, quat=obj.quat, mocap=obj.motion == "mocap"
    )
    if obj.motion in ("free", "ball"):
        node.add_freejoint(name=obj.name)
    for shape in obj.shapes:
        fields: dict[str, object] = {
            "friction": (obj.friction, 0.005, 0.0001),
            "contype": _SOLID | _OBJECT,
            "conaffinity": _SOLID | (_GROUND if obj.meets_ground else 0),
            "condim": 3,
            "rgba": obj.rgba,
        }
        if obj.motion == "ball":
            fields |= {"contype": 0, "conaffinity": 0}
        if obj.solref is not None:
            fields["solref"] = obj.solref
        if obj.restitution is not None:
            fields |= _bounce(obj, timestep)
        if obj.grip or obj.holdable:
            # Athletes meet a geom of their own.
            met = fields | {"contype": 0, "conaffinity": _ATHLETE | _FINGER, "condim": 3}
            met["friction"] = (obj.grip or obj.friction, 0.005, 0.0001)
            if obj.holdable:
                met |= {"priority": 1, "solref": HOLD_SOLREF}
                met["solimp"] = (HOLD_IMPEDANCE, HOLD_IMPEDANCE, 0.001, 0.5, 2.0)
            _add_shape(node, replace(shape, mass=0.0), **met)
            fields |= {"contype": 0, "conaffinity": (_GROUND if obj.meets_ground else 0) | _OBJECT}
        _add_shape(node, shape, **fields)


def _side(scene: Scene, name: str) -> tuple[mujoco.mjtObj, str]:
    if ":" in name or name == GROUND:
        return mujoco.mjtObj.mjOBJ_GEOM, name
    if name.endswith("/"):
        return mujoco.mjtObj.mjOBJ_XBODY, name[:-1]
    if "/" in name:
        return mujoco.mjtObj.mjOBJ_BODY, name
    if name.startswith("agent"):
        return mujoco.mjtObj.mjOBJ_XBODY, f"{name}/{scene.body.links[0].name}"
    return mujoco.mjtObj.mjOBJ_BODY, name


WHOLE_SENSORS = (
    *("SUBTREEANGMOM", "SUBTREELINVEL", "SUBTREECOM"),
    *("FRAMEPOS", "FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS"),
)
"""Of each athlete's root, in a row, for its momentum keeper: kinds of sensors with 3 numbers."""


def _add_sensors(spec: mujoco.MjSpec, scene: Scene) -> None:
    def add(name: str, a: tuple[mujoco.mjtObj, str], b: tuple[mujoco.mjtObj, str] | None) -> None:
        # MuJoCo reports the force on the second object: our first side, world frame.
        other = {"objtype": b[0], "objname": b[1]} if b is not None else {}
        sensor = spec.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            reftype=a[0],
            refname=a[1],
            **other,
        )
        sensor.intprm[:3] = (_FORCE_DATA, _NETFORCE, 1)

    ground = (mujoco.mjtObj.mjOBJ_GEOM, GROUND)
    for agent in range(scene.num_agents):
        for link in scene.body.links:
            name = body_name(agent, link.name)
            add(f"ground:{name}", (mujoco.mjtObj.mjOBJ_BODY, name), ground)
    for a, b in scene.contact_pairs:
        add(f"pair:{a}:{b}", _side(scene, a), _side(scene, b))
    if scene.link_contacts:
        for agent in range(scene.num_agents):
            for link in scene.body.link_names:
                name = body_name(agent, link)
                add(f"all:{name}", (mujoco.mjtObj.mjOBJ_BODY, name), None)
    for ball in scene.bouncing:
        add(f"rolls:{ball.name}", (mujoco.mjtObj.mjOBJ_BODY, ball.name), ground)
    for agent in range(scene.num_agents):
        root = body_name(agent, scene.body.links[0].name)
        for kind in WHOLE_SENSORS:
            frame = kind.startswith("FRAME")
            spec.add_sensor(
                name=f"{kind.lower()}:{root}",
                type=getattr(mujoco.mjtSensor, f"mjSENS_{kind}"),
                objtype=mujoco.mjtObj.mjOBJ_XBODY if frame else mujoco.mjtObj.mjOBJ_BODY,
                objname=root,
            )


def build_spec(scene: Scene, sensors: bool = True) -> mujoco.MjSpec:
    """The scene as an MjSpec: ground, athletes, objects, actuators, sensors, exclusions."""
    spec = mujoco.MjSpec()
    spec.modelname = scene.name
    spec.compiler.degree = False
    spec.option.timestep = scene.timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    # A diverged world is found, reset and counted by the backend, never silently by the engine.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1920, 1080
    ground = spec.worldbody.add_geom(
        name=GROUND,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(0, 0, 1),
        friction=(scene.ground_friction, 0.005, 0.0001),
        contype=_GROUND,
        conaffinity=_GROUND,
        condim=3,
        solref=CONTACT_SOLREF,
        solimp=CONTACT_SOLIMP,
        rgba=(0.6, 0.62, 0.65, 1.0),
    )
    assert ground is not None
    for i in range(scene.num_agents):
        _add_agent(spec, scene, i)
    for obj in scene.objects:
        _add_object(spec, obj, scene.timestep)
    if sensors:
        _add_sensors(spec, scene)
    return spec


def build_model(scene: Scene | Body, sensors: bool = True) -> mujoco.MjModel:
    """Compiles a scene, or one athlete alone on the ground, with ``qpos0`` at its start."""
    if isinstance(scene, Body):
        scene = humanoid_scene(scene)
    model = build_spec(scene, sensors).compile()
    for ball in scene.bouncing:
        first = model.joint(ball.name).dofadr[0]
        model.dof_damping[first + 3 : first + 6] = ball.rolling_damping()
    if (model.nq, model.nv, model.nu) != (scene.nq, scene.nv, scene.nu):
        raise RuntimeError(f"scene '{scene.name}': compiled model has an unexpected layout")
    return model


def dof_order(model: mujoco.MjModel) -> list[str]:
    """Names of the hinge joints in ``qpos`` order, agent prefix dropped, for parity tables."""
    return [
        model.joint(i).name.split("/", 1)[1]
        for i in range(model.njnt)
        if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE
    ]
