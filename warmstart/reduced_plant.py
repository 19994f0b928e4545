"""The athlete as a Drake plant with few joints, on floats and on AutoDiffXd.

Coordinates are those of :mod:`warmstart.rigid_body`: x, y, z, pitch, roll, yaw of the root with
R_WB = Ry(pitch) Rx(roll) Rz(yaw), then the free hinges; all other hinges are welded. A sagittal
model has the root ("x", "z", "pitch") and hinges about y.
"""

# The stubs of Drake type arrays more narrowly than they are.
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialForce_
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    ModelInstanceIndex,
    MultibodyForces_,
    PrismaticJoint,
    RevoluteJoint,
    SpatialInertia,
)

from sports.humanoid.body import Body, Link
from sports.humanoid.drake_plant import link_inertia

ROOT = ("x", "y", "z", "pitch", "roll", "yaw")
_ROOT_AXIS = {"x": 0, "y": 1, "z": 2, "pitch": 1, "roll": 0, "yaw": 2}
_UNIT = np.eye(3)


class ReducedPlant:
    """The athlete with few joints: hinges not in ``free`` are held at ``pose`` (rad; 0 if absent).

    Works on floats and on AutoDiffXd alike; vectors are ordered as ``names``. The torque that
    holds a ``watched`` hinge is reported by `inverse_dynamics`; other held hinges are welded.
    """

    def __init__(
        self,
        body: Body,
        free: Sequence[str],
        pose: Mapping[str, float],
        root: Sequence[str] = ROOT,
        watched: Sequence[str] = (),
    ) -> None:
        unknown = {*free, *watched} - {dof.name for dof in body.dofs}
        if unknown:
            raise ValueError(f"body '{body.name}' has no hinge '{min(unknown)}'")
        self.body = body
        self.names = (*root, *(dof.name for dof in body.dofs if dof.name in set(free)))
        self.num_root = len(root)
        self.watched = tuple(d.name for d in body.dofs if d.name in set(watched) - set(free))
        self.plant = plant = MultibodyPlant(0.0)
        instance = plant.AddModelInstance("athlete")
        joints = {}
        previous = plant.world_body()
        pelvis = plant.AddRigidBody(
            body.links[0].name, instance, link_inertia(body.links[0].shapes)
        )
        for i, name in enumerate(root):
            child = (
                pelvis
                if i == len(root) - 1
                else plant.AddRigidBody(f"{name}_frame", instance, SpatialInertia.Zero())
            )
            make = PrismaticJoint if name in "xyz" else RevoluteJoint
            joints[name] = plant.AddJoint(
                make(name, previous.body_frame(), child.body_frame(), _UNIT[_ROOT_AXIS[name]])
            )
            previous = child
        for link in body.links[1:]:
            self._hang(link, instance, joints, pose)
        dofs = {dof.name: dof for dof in body.dofs}
        for name in self.names[self.num_root :]:
            actuator = plant.AddJointActuator(name, joints[name])
            actuator.set_default_rotor_inertia(dofs[name].armature)
            actuator.set_default_gear_ratio(1.0)
        plant.Finalize()
        self.effort = np.array([dofs[n].effort for n in self.names[self.num_root :]])
        self.damping = np.array([dofs[n].kd for n in self.names[self.num_root :]])
        self.watched_effort = np.array([dofs[n].effort for n in self.watched])
        self._order = np.array([joints[name].position_start() for name in self.names])
        self._watch = np.array([joints[n].position_start() for n in self.watched], dtype=int)
        self._held = np.array([pose.get(n, 0.0) for n in self.watched])
        self._engines = {False: (plant, plant.CreateDefaultContext())}
        smooth = plant.ToAutoDiffXd()
        self._engines[True] = (smooth, smooth.CreateDefaultContext())
        self.mass = plant.CalcTotalMass(self._engines[False][1])

    def _hang(
        self, link: Link, instance: ModelInstanceIndex, joints: dict, pose: Mapping[str, float]
    ) -> None:
        """Adds a link: its free hinges in order x, y, z, its held ones as fixed rotations."""
        plant = self.plant
        previous = plant.GetBodyByName(link.parent, instance)
        rigid = plant.AddRigidBody(link.name, instance, link_inertia(link.shapes))
        hinges = [f"{link.name}_{axis}" for axis in "xyz"]
        free = [name in self.names or name in self.watched for name in hinges]
        turns = [
            RigidTransform(RollPitchYaw(_UNIT[i] * pose.get(name, 0.0)), np.zeros(3))
            for i, name in enumerate(hinges)
        ]
        last = max((i for i in range(3) if free[i]), default=-1)
        X_after = RigidTransform()  # held rotations behind the last free hinge
        for i in range(last + 1, 3):
            X_after = X_after @ turns[i]
        X_PF = RigidTransform(np.array(link.offset))
        for i in range(last + 1):
            if not free[i]:
                X_PF = X_PF @ turns[i]
                continue
            name = hinges[i]
            on_parent = plant.AddFrame(
                FixedOffsetFrame(f"{name}_parent", previous.body_frame(), X_PF)
            )
            if i == last:
                previous = rigid
                on_child = plant.AddFrame(
                    FixedOffsetFrame(f"{name}_child", rigid.body_frame(), X_after.inverse())
                )
            else:
                previous = plant.AddRigidBody(f"{name}_frame", instance, SpatialInertia.Zero())
                on_child = previous.body_frame()
            joints[name] = plant.AddJoint(RevoluteJoint(name, on_parent, on_child, _UNIT[i]))
            X_PF = RigidTransform()
        if last < 0:
            plant.WeldFrames(previous.body_frame(), rigid.body_frame(), X_PF @ X_after)

    @property
    def n(self) -> int:
        return len(self.names)

    def _full(self, x: np.ndarray, held: np.ndarray | float) -> np.ndarray:
        """A vector in the plant's order, with constants for the watched hinges."""
        full = np.zeros(len(self._order) + len(self._watch), dtype=x.dtype)
        if x.dtype == object:
            full[:] = [AutoDiffXd(0.0)] * len(full)
        full[self._order] = x
        for i, value in zip(self._watch, np.broadcast_to(held, self._watch.shape), strict=True):
            full[i] = AutoDiffXd(value) if x.dtype == object else value
        return full

    def _at(self, q: np.ndarray, v: np.ndarray):
        """Plant and context at a state; AutoDiff when the entries are."""
        plant, context = self._engines[np.asarray(q).dtype == object]
        plant.SetPositions(context, self._full(q, self._held))
        plant.SetVelocities(context, self._full(v, 0.0))
        return plant, context

    def inverse_dynamics(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        forces: Sequence[tuple[str, Sequence[float], np.ndarray]] = (),
    ) -> np.ndarray:
        """(n + watched,) generalised forces that the motion needs besides gravity and contact.

        ``forces``: (link, point in the link's frame (m), force in the world (3,) (N)). Joint
        damping is not included.
        """
        plant, context = self._at(q, v)
        scalar = AutoDiffXd if np.asarray(q).dtype == object else float
        applied = MultibodyForces_[scalar](plant)
        plant.CalcForceElementsContribution(context, applied)
        zero = np.zeros(3)
        for link, p_BP, f_W in forces:
            rigid = plant.GetBodyByName(link)
            R_WB = plant.EvalBodyPoseInWorld(context, rigid).rotation()
            rigid.AddInForce(
                context,
                R_WB.matrix() @ np.asarray(p_BP),
                SpatialForce_[scalar](zero.astype(f_W.dtype), f_W),
                plant.world_frame(),
                applied,
            )
        tau = plant.CalcInverseDynamics(context, self._full(a, 0.0), applied)
        return np.concatenate([tau[self._order], tau[self._watch]])

    def link_velocity(self, q: np.ndarray, v: np.ndarray, link: str) -> np.ndarray:
        """(6,) angular velocity and velocity of a link's origin in the world."""
        plant, context = self._at(q, v)
        V_WB = plant.EvalBodySpatialVelocityInWorld(context, plant.GetBodyByName(link))
        return np.concatenate([V_WB.rotational(), V_WB.translational()])

    def heights(self, q: np.ndarray, points: Sequence[tuple[str, Sequence[float]]]) -> np.ndarray:
        """World z (m) of points fixed to links."""
        plant, context = self._at(q, np.zeros_like(q))
        out = []
        for link, p_BP in points:
            X_WB = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(link))
            p_WP = X_WB.translation() + X_WB.rotation().matrix() @ np.asarray(p_BP)
            out.append(p_WP[2])
        return np.array(out)
