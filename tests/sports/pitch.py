"""Ball games on states made by hand: who stands where, how the ball moves, who touches it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sports.env import Env, make_env
from sports.physics import PhysicsState, default_state
from sports.task import Advance


class Pitch:
    """An environment whose next step is decided by the test, in every world alike."""

    def __init__(self, task: str, num_worlds: int = 1, **options: object) -> None:
        self.env: Env = make_env(
            task,
            num_worlds=num_worlds,
            training=False,
            options=options,
            physics_options={"threads": 1},
        )
        self.scene = self.env.physics.scene
        self.state: PhysicsState = default_state(self.scene, num_worlds, "cpu")
        self.context: dict[str, Tensor] = {}

    def stand(self, agent: int, x: float, y: float, yaw: float = 0.0, z: float | None = None):
        """Puts an athlete's root somewhere."""
        rows = self.state.qpos[:, self.scene.agent_qpos(agent)]
        rows[:, 0], rows[:, 1] = x, y
        if z is not None:
            rows[:, 2] = z
        rows[:, 3:7] = torch.tensor((math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)))

    def ball(self, pos, vel=(0.0, 0.0, 0.0)):
        """Puts the ball somewhere, and lets it move."""
        name = self.scene.free_objects[0].name
        q, v = self.scene.object_qpos(name).start, self.scene.object_qvel(name).start
        self.state.qpos[:, q : q + 3] = torch.tensor(pos, dtype=torch.float32)
        self.state.qvel[:, v : v + 3] = torch.tensor(vel, dtype=torch.float32)

    def show(self) -> None:
        physics = self.env.physics
        physics.reset(torch.ones(self.env.num_worlds, dtype=torch.bool), self.state)
        self.env.view.refresh()

    def begin(self, clock: int = 5, **context: Tensor) -> None:
        """Starts an episode in the placed state."""
        self.show()
        self.env.memory = self.env.task.begin(self.env.view, context)
        self.env.view.clock = torch.full((self.env.num_worlds,), clock)

    def advance(self, *touches: str, down: tuple[int, ...] = ()) -> Advance:
        """One control step that ends in the placed state. ``touches``: first sides of the contact
        pairs that feel the ball; ``down``: athletes that lie on the ground."""
        self.show()
        physics = self.env.physics
        for k, (side, _) in enumerate(self.scene.contact_pairs):
            athlete = any(t.split("/")[0] == side for t in touches)
            physics.pair_force[:, k] = 50.0 if side in touches or athlete else 0.0
        for agent in down:
            physics.ground_force[:, agent, self.scene.body.link_index("Pelvis"), 2] = 400.0
        self.env.view.clock = self.env.view.clock + 1
        step = self.env.task.advance(self.env.view, self.env.memory)
        self.env.memory = step.memory
        return step

    def features(self) -> dict[str, Tensor]:
        self.show()
        return self.env.task.features(self.env.view, self.env.memory)


def seen_from(point, root, yaw):
    """A point from a root at a heading, by hand."""
    x, y, z = (p - r for p, r in zip(point, root))
    c, s = math.cos(yaw), math.sin(yaw)
    return [c * x + s * y, c * y - s * x, z]


def total(step: Advance) -> Tensor:
    """(N, A) reward."""
    return torch.stack(tuple(step.terms.values())).sum(0)
