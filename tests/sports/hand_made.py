"""States made by hand: real kinematics of a pose, with contact forces as a test wants them."""

from __future__ import annotations

import torch

from sports.env import Env, make_env
from sports.physics import PhysicsState, default_state


class HandMade:
    """An environment whose next step is decided by the test, not by an engine."""

    def __init__(self, task: str, num_worlds: int = 1, **options: object) -> None:
        self.env: Env = make_env(
            task,
            num_worlds=num_worlds,
            training=False,
            options=options,
            physics_options={"threads": 1},
        )
        self.state: PhysicsState = default_state(self.env.physics.scene, num_worlds, "cpu")
        # The task's own start decides bars, hurdles and targets.
        self.state, self.context = self.env.task.start(
            self.env.view, self.state, {}, self.env.generator, False
        )

    def place(self, root: tuple[float, float, float], **joints: float) -> None:
        """Moves the athlete's root and sets joints (rad) in every world."""
        body = self.env.physics.scene.body
        self.state.qpos[:, :3] = torch.tensor(root)
        for name, angle in joints.items():
            self.state.qpos[:, 7 + body.dof_index(name)] = angle

    def drop_to_ground(self, link: str, depth: float = 0.0005) -> None:
        """Lifts or lowers the root until the lowest point of ``link`` is in the ground."""
        physics = self.env.physics
        self._apply()
        index = physics.scene.body.link_index(link)
        down = torch.tensor((0.0, 0.0, -1.0))
        lowest = -physics.extent(down)[:, 0, index]
        self.state.qpos[:, 2] -= lowest + depth

    def _apply(self) -> None:
        physics = self.env.physics
        everyone = torch.ones(self.env.num_worlds, dtype=torch.bool)
        physics.reset(everyone, self.state)
        self.env.view.refresh()

    def begin(self) -> None:
        """Starts an episode in the placed state."""
        self._apply()
        self.env.memory = self.env.task.begin(self.env.view, self.context)
        self.env.view.clock = torch.full((self.env.num_worlds,), 5)

    def advance(
        self,
        forces: dict[str, float] | None = None,
        pair: float | tuple[float, ...] = 0.0,
        velocity: float = 0.0,
    ):
        """One control step that ends in the placed state, with vertical ground forces (N) by
        link, contact forces of the named pairs, and a forward root velocity."""
        self.state.qvel[:, 0] = velocity
        self._apply()
        physics = self.env.physics
        for link, newtons in (forces or {}).items():
            physics.ground_force[:, 0, physics.scene.body.link_index(link), 2] = newtons
        physics.pair_force[:] = torch.tensor(pair)
        self.env.view.clock = self.env.view.clock + 1
        step = self.env.task.advance(self.env.view, self.env.memory)
        self.env.memory = step.memory
        return step
