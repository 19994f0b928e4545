"""A cost of torques that jump from step to step, for motion without flutter.

People's movements come near to those whose torques change least (Uno, Kawato and Suzuki 1989, Biol
Cybern 61:89), and no muscle turns its torque on or off within a control step.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rl.likeness_motion import joint_torque
from rl.likeness_terms import measured

MOST = 2.0
"""Limits by which a torque can change between two steps, from one end to the other; what the
damping adds to that counts no more."""


class TorqueChangeCost:
    """-weight x the squared change of each dof's torque beyond what is free, in shares of its
    limit, summed.

    The torque of a step is the mean of those at its start and its end, as in the panel of
    human-likeness (``rl.likeness_terms.effort``): the servo within its limit, less the damping,
    with the body's own gains also in worlds that vary. Dofs whose limits are guesses (hands, toes
    and others) do not count.
    """

    def __init__(self, env: Any, weight: float, free: float = 0.0) -> None:
        """Args:
        env: environment whose athletes are watched.
        weight: unscaled reward per step and squared limit.
        free: change from step to step, in shares of the limit, that costs nothing.
        """
        self.env, self.weight, self.free = env, weight, free
        body = env.physics.scene.body
        self.agents, self.dofs = env.num_agents, body.num_dofs
        kp, kd, limit = (
            torch.tensor(body.array(name), dtype=torch.float32, device=env.device)
            for name in ("kp", "kd", "effort")
        )
        self.gains, self.limit = (kp, kd, limit), limit
        self.counted = torch.tensor([measured(dof.name) for dof in body.dofs], device=env.device)
        """(n,) bool"""
        self.angle, self.speed = self._hinges()
        """(N, A, n) rad and rad/s at the start of the next step."""
        self.torque = torch.zeros_like(self.angle)
        """(N, A, n) N m, mean of the step before."""
        self.known = torch.zeros(env.num_worlds, dtype=torch.bool, device=env.device)
        """(N,) whether the episode had one."""

    def __call__(self, result: Any) -> Tensor:
        """(N, A) bonus, never positive, of the step just taken; 0 in the first step of an episode,
        and where the world was reset."""
        angle, speed = self._hinges()
        ctrl = self.env.view.ctrl
        start = joint_torque(self.gains, ctrl, self.angle, self.speed)
        torque = 0.5 * (start + joint_torque(self.gains, ctrl, angle, speed))
        change = ((torque - self.torque) / self.limit).abs().clamp(max=MOST).nan_to_num()
        running = ~result.ended & result.valid
        counts = (running & self.known)[:, None]
        self.angle, self.speed, self.torque, self.known = angle, speed, torque, running
        beyond = (change - self.free).clamp(min=0.0)
        return -self.weight * (beyond.square() * self.counted).sum(-1) * counts

    def state_dict(self) -> dict[str, Tensor]:
        """What the next step is compared with, but for the state of the environment."""
        return {"torque": self.torque.clone(), "known": self.known.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes it back, after the environment has taken its own."""
        self.torque, self.known = (state[k].to(self.env.device) for k in ("torque", "known"))
        self.angle, self.speed = self._hinges()

    def _hinges(self) -> tuple[Tensor, Tensor]:
        """(N, A, n) angles and speeds, copied: the engine writes over its own."""
        physics = self.env.physics

        def of_athletes(x: Tensor, root: int) -> Tensor:
            whole = root + self.dofs
            return (
                x[:, : self.agents * whole].unflatten(1, (self.agents, whole))[..., root:].clone()
            )

        return of_athletes(physics.qpos, 7), of_athletes(physics.qvel, 6)
