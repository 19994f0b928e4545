"""The motion tracker: a policy that plays any clip of a library (PHC; Luo et al. 2023).

The policy sees its own body and, of each link, how it differs from the reference's next frame and
where the reference is; its action is a residual around the reference's pose. Observation and
reward (``rl.tracking_terms``) go on ``sports.env.Env`` as the task ``tracking``, so ``rl.train``
trains it as any other: ``olympics-opt train tracking --clips LIBRARY``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from rl.annealing import annealed
from rl.clip_sampling import ClipSampling
from rl.motion import MotionTables, Reference
from rl.tracking_terms import (
    contact_mismatch,
    goal_features,
    least_turn,
    residual_targets,
    tracking_errors,
    wrapped,
)
from sports.env import Env
from sports.humanoid.body import load_body
from sports.physics import Physics, PhysicsState, make_physics
from sports.scene import Scene, finer, humanoid_scene
from sports.task import Advance, Memory, Task, View
from warmstart.library import FPS, Library, load_library

NAME = "tracking"
LOST = 0.5
"""A mean distance of the links (m) beyond which a clip counts as not followed (PHC)."""
ROOT_SHARPNESS = 100.0
"""1/m^2, of the cost of the root's height."""
HORIZON = 300
"""Control steps of a training episode; a new one begins elsewhere."""


@dataclass(frozen=True)
class TrackingConfig:
    """Options of the tracker."""

    split: Literal["train", "held_out", "all"] = "train"
    """Clips of the library to train on; held-out ones are a tenth, by the hash of their names."""
    action: Literal["residual", "absolute"] = "residual"
    """residual moves the PD targets around the reference's pose; absolute are PD targets as in any
    other task, which is how a student of the tracker acts."""
    residual: float = 0.8
    """Radians by which an action of 1 moves a target off the reference's joint angle."""
    feed_forward: bool = False
    """Residual actions only: targets run ahead of the reference by what its motion costs in the
    joints' damping (strength ``paper``: a tenth of a second), so that action 0 does not lag."""
    tolerance: tuple[float, float] = (0.5, 0.25)
    """Distance (m) of any link but the feet at which an episode ends, first and last."""
    sharpness: tuple[float, float, float, float] = (25.0, 5.0, 0.5, 0.1)
    """Exponents of the reward in mean squares to begin with: position (1/m^2), rotation
    (1/rad^2), velocity (s^2/m^2), angular velocity (s^2/rad^2)."""
    sharpness_final: tuple[float, float, float, float] = (100.0, 10.0, 0.2, 0.1)
    """The same at the end of the curriculum."""
    weights: tuple[float, float, float, float] = (0.5, 0.3, 0.1, 0.1)
    """Shares of those four in the reward."""
    power: float = 2e-6
    """Cost of a watt of the servos, either sign. PHC's 5e-4 is too much for this athlete: at
    strength ``paper`` an explored high jump takes 7 kW, so that falling would be worth it."""
    action_rate: float = 0.02
    """Cost of the mean squared change of the action from step to step."""
    root_height: float = 0.05
    """Cost of a root far off the reference's height: times 1 - exp(-100/m^2 squared error)."""
    contact: float = 0.02
    """Cost of each link that touches the ground where the reference's is clearly off it, or does
    not where it clearly stands."""
    curriculum_share: float = 0.7
    """Part of the run over which tolerance and sharpness change."""
    uniform: float = 0.2
    """Share of episodes that start anywhere; the others where tracking fails."""
    mirror: bool = True
    """Half of the episodes follow mirrored motions."""
    bin_seconds: float = 0.5
    """Length of the pieces whose failures are counted (s)."""

    def __post_init__(self) -> None:
        numbers = (*self.tolerance, *self.sharpness, *self.sharpness_final, self.residual)
        costs = (self.power, self.action_rate, self.root_height, self.contact)
        if min(numbers) <= 0.0 or min(*self.weights, *costs) < 0.0:
            raise ValueError("tolerances, exponents and residual must be positive, weights not < 0")
        if not 0.0 < self.curriculum_share <= 1.0 or not 0.2 <= self.uniform <= 1.0:
            raise ValueError("curriculum_share must lie in (0, 1], uniform in [0.2, 1]")


class Tracking:
    """The functions of the task, with the motions, the sampling and the curriculum they need.

    For evaluation ``assign`` says which clip each world plays, from its first frame on.
    """

    def __init__(self, tables: MotionTables, config: TrackingConfig, scene: Scene) -> None:
        body = scene.body
        self.tables, self.config = tables, config
        self.sampling = ClipSampling(tables, config.uniform, config.mirror, config.bin_seconds)
        self.assigned: Tensor | None = None
        device = tables.device

        def tensor(values: Any) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        feet = [name.endswith(("Ankle", "Toe")) for name in body.link_names]
        self._not_feet = ~torch.tensor(feet, device=device)
        self._kp, self._effort = tensor(body.array("kp")), tensor(body.array("effort"))
        # A target q + (kd / kp) dq makes a servo with passive damping pull by the differences of
        # angle and rate alone; held for a control step it aims at the step's middle.
        delay = body.array("kd") / body.array("kp") - 0.5 / FPS
        self._lead = tensor(delay) if config.feed_forward else None
        self._weights = tensor(config.weights)
        self._ends = tensor(config.sharpness), tensor(config.sharpness_final)
        self.sharpness = self._ends[0].clone()
        """(4,) exponents in force."""
        self.tolerance = tensor(config.tolerance[0])
        """() m, in force."""

    def schedule(self, share: float) -> None:
        """Sets tolerance and sharpness for a part 0..1 of the run that is done: geometrically
        from first to last."""
        x = min(share / self.config.curriculum_share, 1.0)
        first, last = self._ends
        self.sharpness.copy_(first * (last / first) ** x)
        self.tolerance.fill_(annealed(*self.config.tolerance, x))

    def targets(self, view: View, memory: Memory, action: Tensor) -> Tensor:
        """(N, 1, n) PD targets (rad) of actions in [-1, 1] around the next frame's pose."""
        qpos = view.physics.qpos[:, 7:]
        reference = self._aim(memory["frame"] + 1)
        return residual_targets(qpos, reference, action[:, 0], self.config.residual)[:, None]

    def _aim(self, frame: Tensor) -> Tensor:
        """(N, n) PD targets (rad) of action 0 on the way to frames (N,)."""
        angle = self.tables.joints(frame)
        if self._lead is None:
            return angle
        ahead = self._lead * self.tables.rates(frame)
        # Further off a servo pulls no more.
        most = self._effort / self._kp
        return angle + torch.minimum(torch.maximum(ahead, -most), most)

    def start(
        self,
        view: View,
        state: PhysicsState,
        context: Memory,
        generator: torch.Generator,
        training: bool,
    ) -> tuple[PhysicsState, Memory]:
        """Every world in a drawn frame of a motion, or at the beginning of the clip it plays."""
        worlds = len(state.qpos)
        if self.assigned is not None:
            frame = self.assigned
        else:
            frame = self.sampling.draw(worlds, generator)
        qpos, qvel = self.tables.state(frame)
        if self.config.action == "absolute":
            qpos, qvel = least_turn(qpos, qvel)
        return PhysicsState(qpos, qvel, state.mocap_pos, state.wave_phase), {"frame": frame}

    def begin(self, view: View, context: Memory) -> Memory:
        """Memory after a reset."""
        frame = context["frame"]
        zero = torch.zeros_like(frame, dtype=torch.float32)
        apart = self.apart(view, self.tables.at(frame))
        action = torch.zeros(len(frame), self.tables.num_dofs, device=frame.device)
        return {
            "frame": frame.clone(),
            "action": action,
            "apart": torch.stack((apart, apart), 1),
            "steps": zero,
            "distance": zero.clone(),
            "local_distance": zero.clone(),
            "jolt": zero.clone(),
        }

    @staticmethod
    def apart(view: View, reference: Reference) -> Tensor:
        """(N, B, 3) link positions minus the reference's."""
        return view.physics.body_pos[:, 0] - reference.pos

    @staticmethod
    def _body(view: View) -> Reference:
        p = view.physics
        return Reference(
            p.body_pos[:, 0], view.rotation[:, 0], p.body_linvel[:, 0], p.body_angvel[:, 0]
        )

    def features(self, view: View, memory: Memory) -> dict[str, Tensor]:
        """``goal_features`` of the next frame, (N, 1, k) each."""
        goal = self.tables.at(memory["frame"] + 1)
        found = goal_features(view.heading, self._body(view), goal)
        return {name: value[:, None] for name, value in found.items()}

    def advance(self, view: View, memory: Memory) -> Advance:
        """One control step: how well the reference's frame of now was met."""
        c, frame = self.config, memory["frame"] + 1
        reference, body = self.tables.at(frame), self._body(view)
        scores = self._weights * torch.exp(-self.sharpness * tracking_errors(body, reference))
        assert view.ctrl is not None
        ctrl = view.ctrl[:, 0]
        action = wrapped(ctrl - self._aim(frame)) / c.residual
        servo = self._kp * (ctrl - view.physics.qpos[:, 7:])
        torque = torch.minimum(torch.maximum(servo, -self._effort), self._effort)
        power = (torque * view.physics.qvel[:, 6:]).abs().sum(-1)
        names = ["position", "rotation", "velocity", "spin"]
        terms: dict[str, Tensor] = dict(zip(names, scores.unbind(-1)))
        terms["power"] = -c.power * power
        changed = (memory["steps"] > 0) * (action - memory["action"]).square().mean(-1)
        terms["action_rate"] = -c.action_rate * changed

        off = (body.pos[:, 0, 2] - reference.pos[:, 0, 2]).square()
        terms["root_height"] = -c.root_height * (1.0 - torch.exp(-ROOT_SHARPNESS * off))
        terms["contact"] = -c.contact * contact_mismatch(
            view.touching()[:, 0], self.tables.contact(frame)
        )

        apart = self.apart(view, reference)
        distance = torch.linalg.vector_norm(apart, dim=-1)  # (N, B)
        local = torch.linalg.vector_norm(apart - apart[:, :1], dim=-1)
        before, earlier = memory["apart"].unbind(1)
        jolt = torch.linalg.vector_norm(apart - 2.0 * before + earlier, dim=-1).mean(-1)
        steps = memory["steps"] + 1.0
        sums = {
            "distance": memory["distance"] + distance.mean(-1),
            "local_distance": memory["local_distance"] + local.mean(-1),
            "jolt": memory["jolt"] + jolt * (steps >= 2.0),
        }
        if self.assigned is None:
            lost = (distance * self._not_feet).amax(-1) > self.tolerance
        else:
            lost = distance.mean(-1) > LOST
        over = frame >= self.tables.last[frame]
        metrics = {
            "success": (~lost).float(),
            "mpjpe": 1e3 * sums["distance"] / steps,
            "mpjpe_local": 1e3 * sums["local_distance"] / steps,
            "acceleration_error": 1e3 * sums["jolt"] / (steps - 1.0).clamp(min=1.0),
        }
        fresh = {"frame": frame, "action": action, "apart": torch.stack((apart, before), 1)}
        return Advance(
            memory={**fresh, "steps": steps, **sums},
            terms={name: term[:, None] for name, term in terms.items()},
            terminated=lost[:, None],
            metrics=metrics,
            success=~lost,
            truncated=over & ~lost,
        )

    def promote(self, view: View, memory: Memory, step: Advance, ended: Tensor) -> Memory:
        """Counts failures and bins passed; there is no curriculum of each world."""
        if self.assigned is None:
            frame, bad = memory["frame"], view.physics.bad
            failed = step.terminated[:, 0] | bad
            bins = self.sampling.bin_of
            left = (bins[frame] != bins[frame - 1]) | (frame >= self.tables.last[frame])
            # A failure belongs where it happened, a passed bin is the one left behind.
            visited = torch.where(failed, frame, frame - 1)
            self.sampling.update(visited, failed, left & ~failed)
        return view.curriculum

    def task(self, body: str, max_steps: int) -> Task:
        """The record that ``sports.env.Env`` plays."""
        return Task(
            name=NAME,
            config=TrackingConfig,
            scene=lambda config, athlete: humanoid_scene(athlete),
            start=self.start,
            begin=self.begin,
            features=self.features,
            advance=self.advance,
            promote=self.promote,
            targets=self.targets if self.config.action == "residual" else None,
            metrics={
                "success": "fraction",
                "mpjpe": "mm",
                "mpjpe_local": "mm",
                "acceleration_error": "mm/frame^2",
            },
            main_metric="success",
            max_steps=max_steps,
            body=body,
            summary="Follow motions of people and of demonstrations.",
        )


class TrackingEnv(Env):
    """N athletes who follow clips of a library. Its sampling is part of its state."""

    def __init__(
        self,
        library: Library,
        config: TrackingConfig,
        physics: Physics,
        *,
        seed: int = 0,
        training: bool = True,
        clips: Sequence[int] | None = None,
    ) -> None:
        """Args:
        library: the motions, all of which are used.
        config: see TrackingConfig (its ``split`` is the caller's business).
        physics: worlds of ``humanoid_scene`` for the library's body, at ``FPS`` control steps.
        seed: of the starts.
        training: whether episodes begin at random ages.
        clips: for evaluation, (N,) the clip that each world plays from its beginning, to its end
            or until it is lost; None to draw starts.

        Raises ValueError for a library of another body, or another rate of control.
        """
        scene = physics.scene
        if scene.body.name != library.body:
            raise ValueError(
                f"the clips are of body '{library.body}', the athlete is '{scene.body.name}'"
            )
        if abs(scene.control_timestep * FPS - 1.0) > 1e-6:
            raise ValueError(f"the tracker needs {FPS:g} control steps a second")
        self.tracking = Tracking(MotionTables(library, physics.device), config, scene)
        steps = HORIZON
        if clips is not None:
            self.assign(clips)
            steps = int(library.lengths.max()) + 1
        self.card = {"library": library.card()}
        """What a model says about its data."""
        self._digest = bytes.fromhex(library.digest)
        task = self.tracking.task(library.body, steps)
        super().__init__(task, config, physics, seed=seed, training=training and clips is None)
        self.own_turns = config.action == "absolute"

    def assign(self, clips: Sequence[int]) -> None:
        """Says which clip each world plays after the next ``reset``."""
        first = self.tracking.tables.first
        self.tracking.assigned = first[torch.as_tensor(list(clips), device=first.device)]

    def distance(self) -> Tensor:
        """(N,) mean distance of the links from the reference's (m), now."""
        apart = Tracking.apart(self.view, self.tracking.tables.at(self.memory["frame"]))
        return torch.linalg.vector_norm(apart, dim=-1).mean(-1)

    def schedule(self, share: float) -> None:
        """Sets the curriculum for the part of the run that is done."""
        self.tracking.schedule(share)

    def merge_ranks(self) -> None:
        """Several ranks learn from each other's failures; each calls this after a rollout."""
        self.tracking.sampling.merge_ranks()

    def state_dict(self) -> dict[str, Tensor]:
        """As of Env, with failure rates, curriculum and the library's digest."""
        own = {
            "failure": self.tracking.sampling.failure.clone(),
            "sharpness": self.tracking.sharpness.clone(),
            "tolerance": self.tracking.tolerance.clone(),
            "library": torch.tensor(list(self._digest), dtype=torch.uint8),
        }
        return super().state_dict() | {f"tracking/{k}": v for k, v in own.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> Tensor:
        """As of Env. Raises ValueError for the state of another library too."""
        digest = state.get("tracking/library")
        if digest is None or bytes(digest.tolist()) != self._digest:
            raise ValueError("the run was trained on another clip library: resume it with that one")
        self.tracking.sampling.restore(state["tracking/failure"])
        self.tracking.sharpness.copy_(state["tracking/sharpness"])
        self.tracking.tolerance.copy_(state["tracking/tolerance"])
        return super().load_state_dict(state)


def make_tracking_env(
    clips: Library | Sequence[str | Path],
    *,
    engine: str = "mujoco",
    num_worlds: int = 256,
    seed: int = 0,
    strength: str = "paper",
    limits: str = "paper",
    training: bool = True,
    config: TrackingConfig | None = None,
    assigned: Sequence[int] | None = None,
    physics_options: dict[str, Any] | None = None,
    timestep_divisor: int = 1,
) -> TrackingEnv:
    """An environment of ``num_worlds`` athletes who follow clips.

    ``clips``: a library, or files and folders as ``load_library`` reads them; training uses the
    split that the config names. ``assigned``: for evaluation, see TrackingEnv. Raises ValueError
    for clips that cannot be used, RuntimeError when the engine cannot run here.
    """
    config = config or TrackingConfig()
    library = clips if isinstance(clips, Library) else load_library(clips)
    if assigned is None:
        library = library.split(config.split)
    elif len(assigned) != num_worlds:
        raise ValueError(f"{num_worlds} worlds need as many clips, not {len(assigned)}")
    body = load_body(library.body, strength=strength, limits=limits)  # type: ignore[arg-type]
    scene = finer(humanoid_scene(body), timestep_divisor)
    physics = make_physics(engine, scene, num_worlds, **(physics_options or {}))
    return TrackingEnv(library, config, physics, seed=seed, training=training, clips=assigned)
