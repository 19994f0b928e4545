"""Bouts made by hand: two athletes in poses, motion and contact forces as a test wants them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from sports.combat import TARGETS
from sports.env import Env, StepResult, make_env
from sports.physics import default_state
from sports.scene import Scene
from sports.task import Advance


class Bout:
    """An environment whose next step is decided by the test, not by an engine."""

    def __init__(self, task: str, num_worlds: int = 1, engine: str = "mujoco") -> None:
        self.env: Env = make_env(
            task,
            engine=engine,
            num_worlds=num_worlds,
            training=False,
            physics_options={"device": "cpu"} if engine == "warp" else {},
        )
        self.scene, self.body = self.env.physics.scene, self.env.physics.scene.body
        self.state = default_state(self.scene, num_worlds, "cpu")

    def place(
        self,
        agent: int,
        x: float,
        y: float = 0.0,
        yaw: float = 0.0,
        z: float = 0.9,
        pose: dict[str, float] | None = None,
    ) -> None:
        """Puts an athlete's root somewhere, in a ``pose`` (rad by dof) or as it is."""
        own = self.state.qpos[:, self.scene.agent_qpos(agent)]
        own[:, :7] = torch.tensor((x, y, z, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)))
        if pose is not None:
            own[:, 7:] = 0.0
            for name, angle in pose.items():
                own[:, 7 + self.body.dof_index(name)] = angle

    def move(self, agent: int, *velocity: float) -> None:
        """Gives an athlete's root a velocity (m/s, world)."""
        at = self.scene.agent_qvel(agent).start
        self.state.qvel[:, at : at + 3] = torch.tensor(velocity)

    def show(self) -> None:
        """Makes the placed state the engine's; contact forces become zero."""
        everyone = torch.ones(self.env.num_worlds, dtype=torch.bool)
        self.env.physics.reset(everyone, self.state)
        self.env.view.refresh()

    def begin(self) -> None:
        """Starts a bout in the placed state."""
        self.show()
        self.env.memory = self.env.task.begin(self.env.view, {})
        self.env.view.clock = torch.full((self.env.num_worlds,), 5)

    def features(self) -> dict[str, Tensor]:
        """Goal features by name, (N, A, k)."""
        return self.env.task.features(self.env.view, self.env.memory)

    def hits(self, agent: int, newtons: float, target: str = "Chest", weapon: int = -1) -> None:
        """Sets the force of an athlete's weapon (by default that in the right hand) on a target of
        its opponent, after ``show``."""
        weapons = self.env.physics.pair_force.shape[1] // (2 * len(TARGETS))
        row = (agent * weapons + weapon % weapons) * len(TARGETS) + TARGETS.index(target)
        self.env.physics.pair_force[:, row] = newtons

    def step(self, *hits: tuple, ground: dict[tuple[int, str], float] | None = None) -> Advance:
        """One control step that ends in the placed state, with ``hits`` (their arguments) and
        vertical forces (N) of the ground by athlete and link."""
        self.show()
        for hit in hits:
            self.hits(*hit)
        for (agent, link), newtons in (ground or {}).items():
            self.env.physics.ground_force[:, agent, self.body.link_index(link), 2] = newtons
        self.env.view.clock = self.env.view.clock + 1
        step = self.env.task.advance(self.env.view, self.env.memory)
        self.env.memory = step.memory
        return step

    def play(self, steps: int) -> Iterator[StepResult]:
        """The engine's own steps from where the bout stands; the joints stay as they are placed."""
        env, scene = self.env, self.scene
        joints = [self.state.qpos[:, scene.agent_qpos(a)][:, 7:] for a in range(2)]
        action = (torch.stack(joints, dim=1) - env.action_offset) / env.action_scale
        for _ in range(steps):
            yield env.step(action)

    def reach_out(self, distance: float, target: str = "Chest") -> None:
        """Both in T-pose, athlete 0 at the origin with its right arm along +x, and the opponent's
        target ``distance`` (m) beyond the weapon's point; summed from the body table."""
        length = 0.98 if self.env.task.name == "fencing" else 0.0
        origins = self.body.zero_pose_origins()
        hand, aim = (origins[self.body.link_index(name)] for name in ("R_Hand", target))
        # Turned by 90 degrees, the athlete's -y is +x and its x is +y.
        x, y, z = -hand[1] + length + distance, hand[0], hand[2]
        self.place(0, 0.0, yaw=math.pi / 2, pose={})
        self.place(1, x - aim[0], y - aim[1], z=0.9 + z - aim[2], pose={})


def swapped(states: Tensor, velocities: Tensor, scene: Scene) -> tuple[Tensor, Tensor]:
    """States (N, nq), (N, nv) turned by 180 degrees about +z with the athletes exchanged."""
    qpos, qvel = states.clone(), velocities.clone()
    for agent in range(2):
        q, v = scene.agent_qpos(agent), scene.agent_qvel(agent)
        other_q, other_v = scene.agent_qpos(1 - agent), scene.agent_qvel(1 - agent)
        own, motion = states[:, other_q].clone(), velocities[:, other_v].clone()
        own[:, :2] *= -1.0
        w, x, y, z = states[:, other_q][:, 3:7].unbind(1)
        own[:, 3:7] = torch.stack((-z, -y, x, w), 1)  # (0, 0, 0, 1) times the quaternion
        motion[:, :2] *= -1.0
        qpos[:, q], qvel[:, v] = own, motion
    return qpos, qvel
