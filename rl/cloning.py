"""Behavioural cloning of one demonstration before reinforcement learning begins.

A throw is a second of exact timing: an actor of random weights drops the ball, and nothing that it
earns says how to throw. A demonstration of a whole episode has the targets of every control step,
and PD targets are a feedback themselves: played open loop they throw from a start that is a little
different, too. So for the first iterations of a run half of the worlds play the demonstration's
targets with the policy's noise, half play the actor (DAgger, Ross et al. 2011: the states that it
gets itself into), and all are labelled with the targets of their step. The actor learns the labels,
the critic learns from the task's rewards as ever.

What counts is done at the clip's last event, the release: what follows is most of an episode, is
seen again and again, and changes little. Its labels weigh ``LATER``. Until then a target may go
from one bound to the other within a step, and what was left of the error was there (javelin, body,
at the release: 0.16, elsewhere 0.002 to 0.02).

What a hand does in a throw is timing alone, and noise spoils what reinforcement learns of it: a
javelin thrower that is paid for each metre holds on until the noise of its fingers shakes the
javelin loose, and without noise never lets go. ``fingers`` keeps the fingers at the
demonstration's targets for the whole run: without noise that rewards could follow, outside of the
policy gradient, and with their divergence from the labels among the losses (``PPO.noisy``,
``PPO.labels``). Lessons between PPO's updates are not enough: both move the layers that fingers and
arm share, and the fingers leave the clip within 20 iterations. The rest of the body learns by
reward.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from rl.annealing import annealed
from rl.ppo import PPO, gaussian_log_prob
from rl.rollout import Rollout
from sports.humanoid.body import is_finger
from warmstart.bank import START, elapsed
from warmstart.clip import Clip

RATES = (1e-3, 1e-5)
"""Learning rates at the beginning and the end of the cloning, geometric between. At 1e-4 Adam's own
noise keeps the error at 0.006 to 0.009, and a javelin a metre short."""
LED = 0.5
"""Share of the worlds in which the demonstration is played."""
FOLLOW, LATER = 0.1, 0.1
"""Seconds after the clip's last event that count in full, and the weight of a label after them."""
STATISTIC = "clone_error"
"""Root mean square difference of the actor's actions from the demonstration's (action units), each
weighed as its label is."""


def reference(clip: Clip, env: Any) -> Tensor:
    """(T, act) actions of an environment that play a clip's targets, by step of the episode.

    Raises ValueError for a clip without targets, of another body or rate, or that does not say
    when its episode began.
    """
    body = env.physics.scene.body
    if clip.body != body.name:
        raise ValueError(f"the clip to clone is of body '{clip.body}', the task's is '{body.name}'")
    if clip.ctrl is None or START not in clip.meta.get("events", {}):
        raise ValueError(
            "a clip to clone must have targets (ctrl) and the event 'start': it is a whole episode "
            "of the task, like those in warmstart/data/throws"
        )
    if abs(clip.fps * env.physics.scene.control_timestep - 1.0) > 1e-6:
        raise ValueError(
            f"the clip to clone has {clip.fps:g} frames a second: it must have one a control step"
        )
    first = round(float(-elapsed(clip)[0]) * clip.fps)
    if not 0 <= first < clip.num_frames:
        raise ValueError("the episode of the clip to clone begins outside of the clip")
    targets = torch.tensor(np.asarray(clip.ctrl[first:]), dtype=torch.float32, device=env.device)
    return ((targets - env.action_offset) / env.action_scale).clamp(-1.0, 1.0)


def label_weights(clip: Clip, steps: int) -> Tensor:
    """(steps,) how much the label of each step of the episode counts: 1 until ``FOLLOW`` after the
    clip's last event, then ``LATER``; 1 everywhere for a clip without an event after its start."""
    events = clip.meta["events"]
    last = max(events.values()) - events[START]
    counts = torch.arange(steps) <= round((last + FOLLOW) * clip.fps)
    return torch.where(counts, 1.0, LATER) if last > 0.0 else torch.ones(steps)


class Cloning:
    """An actor (see ``rl.rollout.Actor``) that plays and labels; ``update`` learns the labels."""

    def __init__(
        self,
        env: Any,
        agent: PPO,
        clip: Clip,
        iterations: int,
        fingers: bool = False,
        rates: tuple[float, float] = RATES,
    ) -> None:
        """Args:
        env: of one athlete a world.
        agent: whose actor learns.
        clip: a whole episode from the task's own start; see :func:`reference`.
        iterations: how long, for the learning rate.
        fingers: they go on learning their labels afterwards.
        rates: learning rates at the beginning and the end.

        Raises ValueError for a task of several athletes and for fingers that the body has not.
        """
        if env.num_agents != 1:
            raise ValueError("cloning is for tasks of one athlete")
        self.env, self.agent, self.iterations, self.rates = env, agent, iterations, rates
        self.device = agent.device
        self.actions = reference(clip, env).to(self.device)
        self.weights = label_weights(clip, len(self.actions)).to(self.device)
        self._counts = torch.zeros(agent.config.steps, env.num_worlds, device=self.device)
        self.led = torch.arange(env.num_worlds, device=self.device) < LED * env.num_worlds
        self.rate = torch.tensor(rates[0], device=self.device)
        cuda = self.device.type == "cuda"
        self.optimizer = torch.optim.Adam(
            agent.actor.parameters(), lr=self.rate, fused=True, capturable=cuda
        )
        self.leading = True
        """Whether the demonstration is played, or only its fingers' labels are kept in mind."""
        self.fingers: Tensor | None = None
        if fingers:
            dofs = env.physics.scene.body.dofs
            found = [i for i, dof in enumerate(dofs) if is_finger(dof.link)]
            if not found:
                raise ValueError("the task's body has no fingers whose targets could be kept")
            self.fingers = torch.tensor(found, device=self.device)
            shape = (agent.config.steps, env.num_worlds, len(dofs))
            agent.labels = self._kept = torch.zeros(shape, device=self.device)
        self._step = 0

    def labels(self) -> Tensor:
        """(N, act) the demonstration's actions at the worlds' control steps; after its end the
        last ones."""
        return self.actions[self._clock()]

    def _clock(self) -> Tensor:
        """(N,) the control step of the demonstration that each world is at."""
        return self.env.view.clock.to(self.device).clamp(max=len(self.actions) - 1)

    def prepare(self, obs: Tensor) -> Tensor:
        """(M, D) raw observations -> as stored."""
        return self.agent.prepare(obs)

    @torch.no_grad()
    def act(self, obs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """obs (M, D) raw -> stored obs, action, label (in the mean's place), log-prob of the action
        by the actor: the critic's update, which comes first, then finds ratios of 1."""
        row = self._step % len(self._counts)
        self._step += 1
        self._counts[row] = self.weights[self._clock()]
        if not self.leading and self.fingers is not None:
            self.agent.noisy[self.fingers] = 0.0  # no noise that rewards could follow
            self._kept[row] = self.labels()
        stored, action, mean, log_prob = self.agent.act(obs)
        if not self.leading:
            return stored, action, mean, log_prob
        label, noise = self.labels(), action - mean
        action = torch.where(self.led[:, None], label, mean) + noise
        return stored, action, label, gaussian_log_prob(action, mean, self.agent.sigma)

    def update(self, rollout: Rollout, done: int) -> dict[str, Tensor]:
        """Learns the labels of a rollout; ``done`` iterations were before. After its turn PPO has
        learned those of the fingers. Returns the error before either learned from them."""
        c = self.agent.config
        if not self.leading:
            off = (rollout.mean - self._kept)[..., self.fingers].square().mean(-1)
            weight = rollout.valid.float()
            return {STATISTIC: ((weight * off).sum() / weight.sum().clamp(min=1.0)).sqrt()}
        self.rate.fill_(annealed(*self.rates, done / max(self.iterations, 1)))
        obs, label = rollout.obs.flatten(0, 1), rollout.mean.flatten(0, 1)
        weight = (self._counts * rollout.valid).flatten()
        error, size = torch.zeros((), device=self.device), len(obs)
        for epoch in range(c.epochs):
            order = torch.randperm(size, device=self.device, generator=self.agent.generator)
            for rows in order.split(size // c.minibatches)[: c.minibatches]:
                with self.agent.autocast():
                    mean = self.agent.actor(obs[rows])
                squared = (weight[rows, None] * (mean - label[rows]).square()).mean()
                self.optimizer.zero_grad(set_to_none=True)
                (squared / self.agent.sigma.square()).backward()
                if dist.is_initialized():
                    grads = [p.grad for p in self.agent.actor.parameters() if p.grad is not None]
                    for grad in grads:
                        dist.all_reduce(grad)
                        grad /= self.agent.world_size
                torch.nn.utils.clip_grad_norm_(self.agent.actor.parameters(), c.grad_norm)
                self.optimizer.step()
                if epoch == 0:
                    error += squared.detach() / c.minibatches
        return {STATISTIC: error.sqrt()}

    def state_dict(self) -> dict[str, Tensor]:
        """Moments of the optimiser, by parameter."""
        state = {}
        for name, p in self.agent.actor.named_parameters():
            for key, value in self.optimizer.state.get(p, {}).items():
                state[f"{name}.{key}"] = value.clone()
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes the moments back."""
        for name, p in self.agent.actor.named_parameters():
            keys = ("step", "exp_avg", "exp_avg_sq")
            own = {k: state[f"{name}.{k}"].clone() for k in keys if f"{name}.{k}" in state}
            if own:
                self.optimizer.state[p] = {k: x.to(self.device) for k, x in own.items()}
