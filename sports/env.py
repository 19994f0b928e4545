"""The batched environment: a task's rules on an engine's physics, with automatic resets.

Nothing in a step waits for the device: resets are masked, counters are tensors. All randomness
comes from one generator, so a seed decides every start.
"""

from __future__ import annotations

import contextlib
import dataclasses
from dataclasses import dataclass
from functools import reduce
from typing import Any, Protocol, cast

import torch
from torch import Tensor

from sports.frames import proprioception, proprioception_slices
from sports.humanoid.body import Limits, Strength, load_body
from sports.physics import Physics, PhysicsState, default_state, make_physics
from sports.registry import get_task, make_config
from sports.retries import Failures, Retries
from sports.scene import Scene, finer
from sports.starts import ELAPSED, Starts, Stock, add_noise
from sports.task import Memory, Task, View, falling_forces, falling_heights
from sports.turns import nearest_turn

no_autograd = getattr(torch._C, "_AutoDispatchBelowAutograd", contextlib.nullcontext)
"""Nothing in a step has a gradient. Without torch's book-keeping for them its many small operations
take a tenth less time on a CPU (a GPU does not wait for them); unlike those of
``torch.inference_mode`` the results are plain tensors."""

_PHYSICS = tuple(f.name for f in dataclasses.fields(PhysicsState))
SAVED = "saved"
"""Metric of episodes that begin before a failure: whether they end in success."""


@dataclass
class StepResult:
    """What a step returns. N worlds, A agents."""

    obs: Tensor
    """(N, A, obs) after the automatic reset."""
    final_obs: Tensor
    """(N, A, obs) before it: the state to bootstrap a truncation from."""
    reward: Tensor
    """(N, A), unscaled."""
    terms: dict[str, Tensor]
    """Reward terms by name, (N, A)."""
    terminated: Tensor
    """(N, A) bool: the sport ended the agent's episode; no bootstrap."""
    truncated: Tensor
    """(N, A) bool: the time limit or another agent's end cut it off; bootstrap."""
    valid: Tensor
    """(N,) bool: false where the engine diverged; mask the sample, the world is already reset."""
    remaining_paid: Tensor
    """(N,) steps for which this step's reward is paid on (0 for most)."""
    metrics: dict[str, Tensor]
    """(N,) episode metrics, to be read where the episode ended."""
    outcome: Tensor | None = None
    """(N,) of a contest 1, 0 or -1: side 0 (the first half of the agents) has won, drawn or lost,
    to be read where the episode ended. None for a task without sides."""

    @property
    def ended(self) -> Tensor:
        """(N,) bool: the world began a new episode, but where it diverged (``valid``)."""
        return (self.terminated | self.truncated).any(-1)


class ActionLayer(Protocol):
    """What may stand between a policy's action and the athlete's, such as a decoder of latents."""

    size: int
    """Numbers in the policy's action."""

    def __call__(self, obs: Tensor, action: Tensor, /) -> Tensor:
        """(N, A, obs) as last shown, (N, A, size) -> (N, A, act) actions of the task."""
        ...


class Env:
    """N worlds of one task on one engine. Use :func:`make_env`."""

    def __init__(
        self,
        task: Task,
        config: Any,
        physics: Physics,
        *,
        seed: int = 0,
        training: bool = True,
        starts: Starts | None = None,
    ) -> None:
        self.task, self.config, self.physics = task, config, physics
        self.training = training
        scene = physics.scene
        self.num_worlds, self.num_agents = physics.num_worlds, scene.num_agents
        self.device = physics.device
        self.reward_scale, self.max_steps = task.reward_scale, task.max_steps
        self.metric_names = tuple(task.metrics)
        self.starts = starts.to(self.device) if starts is not None else None
        self.generator = torch.Generator(self.device)
        self.generator.manual_seed(seed)
        body = scene.body
        self.action_size = body.num_dofs
        self.layer: ActionLayer | None = None
        """Makes the athlete's actions of those that ``step`` takes; see ``act_through``."""
        self.action_scale = torch.tensor(
            body.action_scale(), dtype=torch.float32, device=self.device
        )
        """(act,) rad per unit action."""
        self.action_offset = torch.tensor(
            scene.action_offset(), dtype=torch.float32, device=self.device
        )
        """(act,) PD targets of action 0 (rad)."""
        self.own_turns: bool | Tensor = False
        """Take targets on the turn that each joint is on: of a policy that learned rotations, not
        on which of its two triples of angles a joint stands, which no observation shows. A tensor
        (A,) says so of each athlete."""
        foot = [name.endswith(("Ankle", "Toe")) or name in task.tools for name in body.link_names]
        n = self.num_worlds
        self.age = torch.zeros(n, dtype=torch.long, device=self.device)
        """Steps counted towards truncation."""
        self.memory: Memory = {}
        self.view = View(
            physics=physics,
            geometry=physics.geometry,
            config=config,
            curriculum=task.curriculum(config, n, self.device) if task.curriculum else {},
            clock=torch.zeros(n, dtype=torch.long, device=self.device),
            control_timestep=scene.control_timestep,
            lowest=torch.tensor(falling_heights(body.link_names, foot), device=self.device),
            heaviest=torch.tensor(falling_forces(foot), device=self.device).square(),
        )
        self._default = default_state(scene, n, self.device)
        self._stocks = hasattr(physics, "prepare")
        self._stock: Stock | None = None
        self.final_snapshot: dict[str, Tensor] = {}
        """State before the automatic reset of the last step, filled if ``keep_snapshot``."""
        self.keep_snapshot = False
        self.obs_slices: dict[str, slice] = {}
        self._shown = torch.zeros(0, device=self.device)
        self._failures: Failures | None = None
        obs = self.reset()
        self.obs_size = obs.shape[-1]

    @property
    def curriculum(self) -> Memory:
        """Curriculum state by name, (N,) tensors; empty for a task without one."""
        return self.view.curriculum

    def act_through(self, layer: ActionLayer | None) -> None:
        """From now on ``step`` takes the layer's actions, ``action_size`` says how many, on each
        joint's own turn; None for the athlete's own."""
        self.layer, self.own_turns = layer, layer is not None
        self.action_size = self.physics.scene.body.num_dofs if layer is None else layer.size

    def retry(self, how: Retries) -> None:
        """From now on a share of the episodes begins before an earlier one failed. The metrics are
        those of the others, and ``SAVED`` that of these. Raises ValueError for several athletes in
        a world, and for times that hold no moment."""
        if self.num_agents > 1:
            raise ValueError("one athlete's failure is another's success: retries are for one")
        self._failures = Failures(how, self._moment(), self.view.control_timestep)
        self._stock = None
        self.metric_names = (*self.metric_names, SAVED)

    def reset(self) -> Tensor:
        """Resets every world; (N, A, obs)."""
        everyone = torch.ones(self.num_worlds, dtype=torch.bool, device=self.device)
        self._reset(everyone)
        self._stock = None
        if self.training and self.task.age_at_start:
            # Once, so that worlds do not all reach the time limit together.
            draw = torch.rand(self.num_worlds, device=self.device, generator=self.generator)
            self.age = (draw * self.max_steps).long()
        self._shown = self._observe()
        return self._shown

    def step(self, action: Tensor) -> StepResult:
        """One control step of (N, A, act) actions in [-1, 1] (clipped here), or of a layer's.

        Raises ValueError for an action of another shape and, on a CPU, for one that is not finite.
        On a GPU, which is not waited for, the worlds of such an action diverge (``valid``).
        """
        if action.shape != (self.num_worlds, self.num_agents, self.action_size):
            raise ValueError(
                f"action has shape {tuple(action.shape)}, expected "
                f"{(self.num_worlds, self.num_agents, self.action_size)}"
            )
        if self.device.type == "cpu" and not action.isfinite().all():
            worlds = (~action.isfinite()).flatten(1).any(1).nonzero()[:, 0].tolist()
            raise ValueError(f"the action is not finite in {len(worlds)} worlds: {worlds[:8]}")
        with no_autograd() if self._stocks else contextlib.nullcontext():
            if self.layer is not None:
                action = self.layer(self._shown, action)
            result = self._step(action)
        self._shown = result.obs
        return result

    def targets(self, action: Tensor) -> Tensor:
        """(..., act) PD targets (rad) of actions (..., act), which are clipped to [-1, 1]; of a
        task with its own, and with ``own_turns``, actions (N, A, act) of the present state."""
        limited = action.to(torch.float32).clamp(-1.0, 1.0)
        if self.task.targets is not None:
            return self.task.targets(self.view, self.memory, limited)
        targets = torch.addcmul(self.action_offset, limited, self.action_scale)
        if self.own_turns is False:
            return targets
        whole = 7 + self.physics.scene.body.num_dofs
        athletes = self.physics.qpos[:, : self.num_agents * whole]
        hinges = athletes.unflatten(1, (self.num_agents, whole))[..., 7:]
        nearest = nearest_turn(targets, hinges)[0]
        if self.own_turns is True:
            return nearest
        return torch.where(self.own_turns[:, None], nearest, targets)

    def _step(self, action: Tensor) -> StepResult:
        ctrl = self.targets(action)
        self.physics.step(ctrl.flatten(1))
        self.view.ctrl = ctrl
        self.view.clock = self.view.clock + 1
        self.age = self.age + 1
        self.view.refresh()

        step = self.task.advance(self.view, self.memory)
        self.memory = step.memory
        bad, valid = self.physics.bad, ~self.physics.bad
        lost = bad[:, None]
        terms = {k: v.masked_fill(lost, 0.0) for k, v in step.terms.items()}
        reward = reduce(torch.add, terms.values())
        terminated = step.terminated & valid[:, None]
        over = terminated.any(-1) | (self.age >= self.max_steps)
        if step.truncated is not None:
            over = over | step.truncated
        over = over & valid
        truncated = over[:, None] & ~terminated
        ended = over | bad
        if step.move is not None:
            self.physics.move(step.move.mask & ~ended, step.move.qpos, step.move.qvel)
            self.view.refresh()
        final_obs = self._observe()
        if self.keep_snapshot:
            self.final_snapshot = self.snapshot()
        remaining = torch.zeros(self.num_worlds, device=self.device)
        if step.remaining_paid is not None:
            left = (self.max_steps - self.view.clock).clamp(min=0).float()
            remaining = torch.where(step.remaining_paid & terminated.all(-1), left, remaining)
        metrics, counted = step.metrics, over
        if self._failures is not None:
            retried = self._failures.retried
            counted = over & ~retried
            metrics = {k: v.masked_fill(retried, torch.nan) for k, v in metrics.items()}
            metrics[SAVED] = step.success.float().masked_fill(~retried, torch.nan)
            failed = terminated.any(-1) & ~step.success
            self._failures.watch(over, failed, self._moment(), self.generator)
        if self.task.promote is not None:
            self.view.curriculum = self.task.promote(self.view, self.memory, step, counted)

        # On a CPU, asking which worlds ended costs nothing and saves the work.
        worlds = ended.nonzero()[:, 0] if self._stocks else None
        if worlds is not None and not worlds.numel():
            obs = final_obs
        elif worlds is not None and self._failures is None:
            obs = self._restart(ended, worlds, final_obs)
        else:
            self._reset(ended)
            obs = self._observe()
        return StepResult(
            obs=obs,
            final_obs=final_obs,
            reward=reward,
            terms=terms,
            terminated=terminated,
            truncated=truncated,
            valid=valid,
            remaining_paid=remaining,
            metrics=metrics,
            outcome=step.outcome,
        )

    def _reset(self, mask: Tensor) -> None:
        state, context = self._draw()
        begun, past = self._clock(context), {}
        if self._failures is not None:
            again, past = self._failures.draw(mask, self.generator)
            drawn = {k: v for k, v in vars(state).items() if v is not None}
            state = PhysicsState(**_renewed(again, {k: past[k] for k in drawn}, drawn))
            begun = torch.where(again, past["clock"], begun)
        self.physics.reset(mask, state)
        self.view.clock = torch.where(mask, begun, self.view.clock)
        self.age = torch.where(mask, begun, self.age)
        self.view.refresh()
        fresh = self.task.begin(self.view, context)
        if past:
            fresh = _renewed(again, {k: past[f"memory/{k}"] for k in fresh}, fresh)
        self.memory = _renewed(mask, fresh, self.memory or fresh)

    def _moment(self) -> Memory:
        """What an episode can go on from in any world of the task: (N, ...) by name."""
        names = (k for k, v in vars(self._default).items() if v is not None)
        physics = {k: getattr(self.physics, k) for k in names}
        memory = {f"memory/{k}": v for k, v in self.memory.items()}
        return {**physics, "clock": self.view.clock, **memory}

    def _restart(self, mask: Tensor, worlds: Tensor, obs: Tensor) -> Tensor:
        """Resets worlds, as a mask and by index, from the stock; ``obs`` with their new rows."""
        stock = self._stock
        if stock is None or not stock.serves(worlds, self.curriculum):
            stock = self._stock = self._prepare(*self._draw())
        stock.used.numpy()[worlds.numpy()] = True
        cast(Any, self.physics).restart(worlds, stock.shown)
        self.view.clock = self.view.clock.index_copy(0, worlds, stock.clock[worlds])
        self.age = self.age.index_copy(0, worlds, stock.clock[worlds])
        self.view.refresh()
        self.memory = _renewed(mask, stock.memory, self.memory)
        # On a CPU, where alone this is called, numpy is three times as quick with a few rows.
        rows, obs = worlds.numpy(), obs.clone()
        obs.numpy()[rows] = stock.obs.numpy()[rows]
        return obs

    def _prepare(self, state: PhysicsState, context: Memory) -> Stock:
        shown = cast(Any, self.physics).prepare(state)
        clock = self._clock(context)
        view = dataclasses.replace(self.view, physics=shown, clock=clock)
        view.refresh()
        fresh = self.task.begin(view, context)
        return Stock(
            state=state,
            context=context,
            clock=clock,
            shown=shown,
            memory={k: v.to(self.memory[k].dtype) for k, v in fresh.items()},
            obs=self._observe(view, fresh),
            curriculum=dict(self.curriculum),
            used=torch.zeros(self.num_worlds, dtype=torch.bool),
        )

    def _draw(self) -> tuple[PhysicsState, Memory]:
        """The start of an episode in every world, and the context of ``Task.begin``."""
        state, scene = self._default.clone(), self.physics.scene
        if self.training:
            add_noise(state, scene, self.generator)
        labels = self.starts.draw(state, scene, self.generator) if self.starts else {}
        state, context = self.task.start(self.view, state, labels, self.generator, self.training)
        if ELAPSED in labels:
            context = context | {ELAPSED: labels[ELAPSED]}
        return state, context

    def _clock(self, context: Memory) -> Tensor:
        """(N,) control steps since the rules' beginning of the episodes that start so."""
        if ELAPSED not in context:
            return torch.zeros_like(self.view.clock)
        steps = (context[ELAPSED] / self.view.control_timestep).nan_to_num(0.0)
        return steps.round().long()

    def _observe(self, view: View | None = None, memory: Memory | None = None) -> Tensor:
        """(n, A, obs) of a view's worlds; by default of all."""
        view, memory = view or self.view, memory or self.memory
        goal = self.task.features(view, memory)
        if not self.obs_slices:
            slices = proprioception_slices(self.physics.scene.body.num_links)
            at = slices["body_angvel"].stop
            for name, value in goal.items():
                slices[f"goal/{name}"] = slice(at, at + value.shape[-1])
                at += value.shape[-1]
            self.obs_slices = slices
        return proprioception(view.physics, view.heading, tuple(goal.values())).nan_to_num_()

    def snapshot(self) -> dict[str, Tensor]:
        """Copies of qpos, qvel, mocap_pos and ground_force, for recordings, and of what the task
        shows (``shown/NAME``)."""
        physics = self.physics
        shown = {k: self.memory[k].clone() for k in self.task.shown if k in self.memory}
        return {
            **{f"shown/{name}": value for name, value in shown.items()},
            "qpos": physics.qpos.clone(),
            "qvel": physics.qvel.clone(),
            "mocap_pos": physics.mocap_pos.clone(),
            "ground_force": physics.ground_force.clone(),
        }

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that decides the future: physics, clocks, memory, curriculum, generator."""
        state = {k: v.clone() for k, v in self._moment().items()}
        state |= {"age": self.age.clone(), "generator": self.generator.get_state()}
        extra = getattr(self.physics, "extra_state", None)
        if extra is not None:
            state |= {f"physics/{k}": v for k, v in extra().items()}
        if self._stock is not None:
            state |= {f"stock/{k}": v for k, v in self._stock.state_dict().items()}
        if self._failures is not None:
            state |= {f"failures/{k}": v for k, v in self._failures.state_dict().items()}
        state |= {f"curriculum/{k}": v.clone() for k, v in self.curriculum.items()}
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> Tensor:
        """Continues where :meth:`state_dict` was taken; returns the observation (N, A, obs).

        Raises ValueError for the state of another task or world count.
        """
        if "qpos" not in state or state["qpos"].shape != self.physics.qpos.shape:
            raise ValueError("the environment state is of another task or number of worlds")
        moved = {k: v if k == "generator" else v.to(self.device) for k, v in state.items()}
        everyone = torch.ones(self.num_worlds, dtype=torch.bool, device=self.device)
        physics_state = PhysicsState(**{k: moved[k] for k in _PHYSICS if k in moved})
        self.physics.reset(everyone, physics_state)
        load_extra = getattr(self.physics, "load_extra_state", None)
        if load_extra is not None:
            prefix = "physics/"
            load_extra({k[len(prefix) :]: v for k, v in moved.items() if k.startswith(prefix)})
        self.view.clock, self.age = moved["clock"].clone(), moved["age"].clone()
        self.memory = {k[7:]: v.clone() for k, v in moved.items() if k.startswith("memory/")}
        self._load_stock({k[6:]: v for k, v in moved.items() if k.startswith("stock/")})
        if self._failures is not None:
            found = {k[9:]: v for k, v in moved.items() if k.startswith("failures/")}
            self._failures.load_state_dict(found)
        self.generator.set_state(moved["generator"].cpu())
        self.view.curriculum = {k[11:]: v for k, v in moved.items() if k.startswith("curriculum/")}
        self.view.refresh()
        self._shown = self._observe()
        return self._shown

    def _load_stock(self, state: dict[str, Tensor]) -> None:
        """Works the stock of :meth:`state_dict` out again."""
        self._stock = None
        if not state or not self._stocks:
            return

        def part(prefix: str) -> Memory:
            return {k[len(prefix) :]: v.clone() for k, v in state.items() if k.startswith(prefix)}

        start = PhysicsState(**{k: state[k].clone() for k in _PHYSICS if k in state})
        self.view.curriculum = part("curriculum/")
        self._stock = self._prepare(start, part("context/"))
        self._stock.used = state["used"].clone()

    def close(self) -> None:
        """Frees the engine."""
        self.physics.close()


def _renewed(mask: Tensor, fresh: Memory, memory: Memory) -> Memory:
    """The ``memory`` with the worlds of a mask (N,) as in ``fresh``."""
    return {
        k: torch.where(mask.view(-1, *[1] * (v.dim() - 1)), v, memory[k]) for k, v in fresh.items()
    }


def make_scene(
    task: str,
    *,
    strength: Strength = "paper",
    limits: Limits = "paper",
    options: dict[str, Any] | None = None,
    timestep_divisor: int = 1,
) -> Scene:
    """The scene of a task at a strength. ``timestep_divisor`` 2 halves the time step at the same
    control rate. Raises ValueError for an unknown task, option, strength or limits."""
    record = get_task(task)
    body = load_body(record.body, strength=strength, limits=limits, equipment=record.equipment)
    return finer(record.scene(make_config(record, options), body), timestep_divisor)


def make_env(
    task: str,
    *,
    engine: str = "mujoco",
    num_worlds: int = 256,
    seed: int = 0,
    strength: Strength = "paper",
    limits: Limits = "paper",
    training: bool = True,
    options: dict[str, Any] | None = None,
    physics_options: dict[str, Any] | None = None,
    starts: Starts | None = None,
    timestep_divisor: int = 1,
) -> Env:
    """An environment of ``num_worlds`` worlds of a task on an engine.

    ``options`` are the fields of the task's config, ``physics_options`` those of the engine.
    Raises ValueError for an unknown task, option, strength or engine or a number of worlds below
    1, RuntimeError when the engine cannot run here.
    """
    record = get_task(task)
    config = make_config(record, options)
    scene = make_scene(
        task,
        strength=strength,
        limits=limits,
        options=options,
        timestep_divisor=timestep_divisor,
    )
    physics = make_physics(engine, scene, num_worlds, **(physics_options or {}))
    return Env(record, config, physics, seed=seed, training=training, starts=starts)
