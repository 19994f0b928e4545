"""A scene as a Drake plant: athletes, objects, ground, and who meets whom."""

# The stubs of Drake type arrays, ports and modules more narrowly than they are.
# pyright: reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import GeometryId
from pydrake.math import RigidTransform
from pydrake.multibody.tree import RigidBody

from sports.humanoid.drake_plant import (
    OBJECT_DISSIPATION,
    OBJECT_STIFFNESS,
    add_ground,
    add_humanoid,
    contact_properties,
    filter_collisions,
    start_plant,
)
from sports.physics.drake_objects import (
    KICKED_STIFFNESS,
    PlantObject,
    add_kick_surfaces,
    add_object,
    separate_held,
)
from sports.scene import GROUND, Scene


class Forces(NamedTuple):
    """Net forces (N, in W) of one time step, of what is in contact."""

    ground: dict[int, np.ndarray]
    """By athletes' link: what the ground does to it."""
    others: dict[int, np.ndarray]
    """By athletes' link: what all but the ground does to it; empty unless the scene asks for it."""
    pairs: dict[int, np.ndarray]
    """By the scene's contact pair: what its left side does to its right side."""


class ScenePlant:
    """One plant and one diagram at one time step, and a context for each world.

    Two of the same scene order their positions and velocities alike. Raises ValueError for a
    contact side that the scene does not have.
    """

    def __init__(
        self, scene: Scene, num_worlds: int, timestep: float, contact_approximation: str
    ) -> None:
        self.scene = scene
        self.timestep = timestep
        self.substeps = round(scene.control_timestep / timestep)
        builder, plant, scene_graph = start_plant(timestep, contact_approximation)
        self.plant = plant
        ground = add_ground(plant, properties=contact_properties(scene.ground_friction))
        agents = range(scene.num_agents)
        self.humanoids = [add_humanoid(plant, scene.body, f"agent{a}") for a in agents]
        points: list[GeometryId] = []
        shapes: list[GeometryId] = []
        self.free: list[PlantObject] = []
        self.fixtures: list[PlantObject] = []
        for obj in scene.objects:
            stiffness, losses = OBJECT_STIFFNESS, OBJECT_DISSIPATION
            if scene.bouncing and obj.motion != "free":
                losses = 0.0  # a wall must leave a ball the restitution that it has
                stiffness = KICKED_STIFFNESS if scene.kicked else stiffness
            added = add_object(plant, obj, timestep, losses, points, shapes, stiffness)
            (self.fixtures if added.frame is not None else self.free).append(added)
        doubles: dict[GeometryId, GeometryId] = {}
        if scene.kicked:
            names = [ball.name for ball in scene.kicked]
            balls = [o for o in self.free if o.name in names]
            friction = scene.ground_friction
            doubles = add_kick_surfaces(
                plant, scene_graph, self.humanoids, ground, friction, points, shapes, balls
            )
        plant.Finalize()
        filter_collisions(scene_graph, self.humanoids, [ground], points, shapes)
        separate_held(scene_graph, self.humanoids, shapes)
        self.diagram = builder.Build()
        self._roots = [self.diagram.CreateDefaultContext() for _ in range(num_worlds)]
        self.contexts = [plant.GetMyMutableContextFromRoot(root) for root in self._roots]
        self._contact_port = plant.get_contact_results_output_port()
        self._targets = [plant.get_desired_state_input_port(h.instance) for h in self.humanoids]
        self.bodies: list[RigidBody] = [link for h in self.humanoids for link in h.links]
        self.bodies += [obj.rigid for obj in self.free]
        self._mocap_rows = {o.name: k for k, o in enumerate(scene.mocap_objects)}
        self._index_contacts(doubles)

    def advance(self, world: int) -> bool:
        """One time step; False if the contact solver or a check for NaN gave up on this world."""
        try:
            self.diagram.ExecuteForcedEvents(self._roots[world], publish=False)
        except RuntimeError:
            return False
        return True

    def aim(self, world: int, targets: np.ndarray) -> None:
        """The athletes' servo targets (nu,)."""
        n = self.scene.body.num_dofs
        for a, port in enumerate(self._targets):
            wanted = np.zeros(2 * n)
            wanted[:n] = targets[a * n : (a + 1) * n]
            port.FixValue(self.contexts[world], wanted)

    def state(self, world: int) -> tuple[np.ndarray, np.ndarray]:
        """All positions and all velocities, the plant's."""
        context = self.contexts[world]
        q, v = self.plant.GetPositions(context), self.plant.GetVelocities(context)
        return np.asarray(q), np.asarray(v)

    def set_state(self, world: int, q: np.ndarray, v: np.ndarray) -> None:
        self.plant.SetPositions(self.contexts[world], q)
        self.plant.SetVelocities(self.contexts[world], v)

    def place_fixtures(self, world: int, mocap: np.ndarray) -> None:
        """mocap (M, 3): where the scene's mocap objects stand."""
        for obj in self.fixtures:
            row = self._mocap_rows.get(obj.name)
            if row is not None and obj.frame is not None:
                X_WF = RigidTransform(Quaternion(np.array(obj.quat)), mocap[row])
                obj.frame.SetPoseInParentFrame(self.contexts[world], X_WF)

    def close(self) -> None:
        self.contexts, self._roots = [], []

    # ---- contacts -------------------------------------------------------------------------

    def forces(self, world: int) -> Forces:
        """Of the last time step."""
        results = self._contact_port.Eval(self.contexts[world])
        ground: dict[int, np.ndarray] = {}
        others: dict[int, np.ndarray] = {}
        pairs: dict[int, np.ndarray] = {}
        for i in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(i)
            body_a, body_b = int(info.bodyA_index()), int(info.bodyB_index())
            f_Bc_W = info.contact_force()
            if body_a == 0 and body_b in self._link_of:
                link = self._link_of[body_b]
                ground[link] = ground.get(link, 0.0) + f_Bc_W
            elif body_b == 0 and body_a in self._link_of:
                link = self._link_of[body_a]
                ground[link] = ground.get(link, 0.0) - f_Bc_W
            elif self.scene.link_contacts:
                for body, force in ((body_b, f_Bc_W), (body_a, -f_Bc_W)):
                    link = self._link_of.get(body)
                    if link is not None:
                        others[link] = others.get(link, 0.0) + force
            met = info.point_pair()
            sides_a = body_a, self._shape_of.get(met.id_A, body_a)
            sides_b = body_b, self._shape_of.get(met.id_B, body_b)
            for sides in dict.fromkeys((a, b) for a in sides_a for b in sides_b):
                for k, sign in self._pairs_of.get(sides, ()):
                    pairs[k] = pairs.get(k, 0.0) + sign * f_Bc_W
        return Forces(ground, others, pairs)

    def load(self, world: int, rigid: RigidBody) -> float:
        """Force (N) that the ground took from a body in the last time step, infinite if it met
        anything else."""
        results = self._contact_port.Eval(self.contexts[world])
        index, total = int(rigid.index()), np.zeros(3)
        for i in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(i)
            sides = int(info.bodyA_index()), int(info.bodyB_index())
            if index in sides:
                if 0 not in sides:
                    return np.inf
                total += info.contact_force() * (1.0 if sides[1] == index else -1.0)
        return float(np.linalg.norm(total))

    def _index_contacts(self, doubles: dict[GeometryId, GeometryId]) -> None:
        """Tables from Drake's body indices to links and to the scene's pairs."""
        scene = self.scene
        names: dict[str, list[int]] = {GROUND: [0]}  # nothing else is on the world body
        self._link_of: dict[int, int] = {}
        self._shape_of: dict[GeometryId, int] = {}
        for a, humanoid in enumerate(self.humanoids):
            for i, link in enumerate(humanoid.links):
                index = int(link.index())
                self._link_of[index] = a * scene.body.num_links + i
                names.setdefault(f"agent{a}", []).append(index)
                name = f"agent{a}/{scene.body.link_names[i]}"
                names[name] = [index]
                for k, shape in enumerate(humanoid.shapes[i]):
                    # A shape of its own gets a number that no body has.
                    names[f"{name}:{k}"] = [-1 - len(self._shape_of)]
                    self._shape_of[shape] = names[f"{name}:{k}"][0]
            for link in scene.body.link_names:
                beyond = scene.body.subtree(link)
                names[f"agent{a}/{link}/"] = [names[f"agent{a}/{b}"][0] for b in beyond]
        for double, shape in doubles.items():
            self._shape_of[double] = self._shape_of[shape]
        for obj in [*self.free, *self.fixtures]:
            names[obj.name] = [int(obj.rigid.index())]
        self._pairs_of: dict[tuple[int, int], list[tuple[int, float]]] = {}
        for k, (left, right) in enumerate(scene.contact_pairs):
            for side in (left, right):
                if side not in names:
                    raise ValueError(f"scene '{scene.name}' has no contact side '{side}'")
            for i in names[left]:
                for j in names[right]:
                    self._pairs_of.setdefault((i, j), []).append((k, -1.0))
                    self._pairs_of.setdefault((j, i), []).append((k, 1.0))
