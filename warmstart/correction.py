"""Physical correction: a recorded motion is tracked in MuJoCo, and what MuJoCo did replaces it.

A retargeted clip floats a little, slides a little and has no forces. Tracked in closed loop it
becomes a motion of the simulated athlete, with PD targets that a policy could have played. The
paper does this step with a learned tracker (PHC; Luo et al. 2023): ``player`` is one, see
:mod:`rl.following`; without one :mod:`warmstart.tracking` does it, which needs no training. What
cannot be followed is cut short or rejected, with the reason.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Literal

import mujoco
import numpy as np

from sports.humanoid.body import Body, load_body
from sports.humanoid.mjcf import build_model
from sports.scene import humanoid_scene
from warmstart.clip import Clip
from warmstart.feed_forward import GRAVITY, with_targets
from warmstart.mocap.capture import KEY_JOINTS
from warmstart.mocap.kinematics import Chain, Frames
from warmstart.mocap.quality import SUNK
from warmstart.mocap.retarget import local_rotations
from warmstart.tracking import Tracking, track

LIGHT = Tracking(worlds=96, horizon=12, iterations=2, noise=0.2)
"""Tracking with feed-forward needs half the rounds of the tracking of take-offs."""


Player = Callable[[Clip, float], Clip]
"""Plays a clip at the control rate until the mean distance of the links exceeds a length (m):
returns what the athlete did, from the clip's first frame on, with PD targets."""


@dataclass(frozen=True)
class Bounds:
    """When a motion is lost, and when what is left of it is not kept."""

    lost: float = 0.3
    """Mean distance of the links from the reference's (m) at which tracking ends: a fall."""
    back: float = 0.3
    """Seconds cut away before the last frame that was still close: they lead to the fall."""
    share: float = 0.5
    """Least share of the clip's duration that must be kept."""
    duration: float = 0.5
    """Shortest motion (s)."""
    joint_error: float = 0.08
    """Mean distance of joints from the reference's (m)."""
    push: float = 12.0
    """Largest force of the floor, mean over a control step (weights of the body). Triple jumpers
    are pushed with up to 15 at an instant (Perttunen et al. 2000, J. Sports Sciences 18, 363)."""


@dataclass(frozen=True)
class Measured:
    """How a tracked motion compares with its reference; lengths in m."""

    seconds: float
    """Duration of the reference (s)."""
    kept: float
    """Duration of what is kept (s)."""
    fell: bool
    """Whether tracking lost the reference before its end."""
    joint_error: float
    """Mean over frames and key joints of the distance from the reference, in the world."""
    joint_error_worst: float
    """95th percentile over frames of the mean over joints."""
    root_error: float
    """Largest distance of the root from the reference's."""
    left_over: float
    """Mean force at the reference's root that no push of the floor explains (weights of the
    body): how far the recording was from physics."""
    push: float
    """Largest force of the floor on the tracked athlete, mean over a control step (weights)."""
    saturated: float
    """Share of the servos, over all steps, that were asked for all they can give."""
    sunk_before: float
    """Share of the reference's frames with a point more than 2 cm under the floor."""
    sunk: float
    """The same of the tracked motion."""

    def reasons(self, bounds: Bounds | None = None) -> list[str]:
        """Why the tracked motion is rejected; empty when it is good."""
        bounds = bounds or Bounds()
        found = []
        if self.kept < max(bounds.share * self.seconds, bounds.duration) - 1e-9:
            how = "could not be followed beyond" if self.fell else "is no longer than"
            found.append(f"{how} {self.kept:.2f} of {self.seconds:.2f} s")
        if self.joint_error > bounds.joint_error:
            found.append(f"joints {100 * self.joint_error:.1f} cm from the recording")
        if self.push > bounds.push:
            found.append(f"the floor pushes with {self.push:.0f} times the weight")
        return found


@dataclass(frozen=True, eq=False)
class Corrected:
    """A clip that MuJoCo played, and how far it went."""

    clip: Clip
    """At the control rate, with targets; ends before the fall where there was one."""
    measured: Measured
    reasons: list[str] = field(default_factory=list)
    """Why it is rejected; empty when it is good."""
    compute_seconds: float = 0.0


def correct(
    clip: Clip,
    strength: Literal["paper", "human"] = "paper",
    settings: Tracking = LIGHT,
    bounds: Bounds | None = None,
    *,
    player: Player | None = None,
    threads: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Corrected:
    """Tracks a clip in MuJoCo on a flat floor and measures what came out.

    ``player`` follows the clip (an athlete of ``strength``); None for ``settings``'s search.
    ``progress(step, steps)`` is called after every control step. The same clip and settings give
    the same motion. Raises ValueError for a clip shorter than two control steps, RuntimeError
    when the simulation diverges.
    """
    bounds = bounds or Bounds()
    body = load_body(clip.body, strength=strength)
    scene = humanoid_scene(body)
    begin = time.perf_counter()
    reference = replace(clip, meta={}).resample(1.0 / scene.control_timestep)
    if reference.num_frames < 3:
        raise ValueError(f"the clip is only {clip.duration:.3f} s long: there is nothing to track")
    recorded = reference
    reference, forces = with_targets(reference, body)
    if player is not None:
        found = player(recorded, bounds.lost)
    else:
        lost = replace(settings, lost=bounds.lost)
        found = track(reference, scene, lost, threads=threads, progress=progress).clip
    chain = Chain(body)
    fell = found.num_frames < reference.num_frames
    end = found.num_frames
    wanted = _frames(chain, reference.qpos)
    got = _frames(chain, found.qpos)
    error = _distances(chain, got, Frames(wanted.origin[:end], wanted.turn[:end]))
    if fell:
        close = np.flatnonzero(error.mean(1) <= bounds.joint_error)
        end = max(2, int(close[-1]) + 1 - round(bounds.back * found.fps)) if len(close) else 2
    kept = replace(
        found,
        qpos=found.qpos[:end],
        qvel=found.qvel[:end],
        ctrl=None if found.ctrl is None else found.ctrl[:end],
    )
    error = error[:end]
    weight = body.mass * GRAVITY
    root = np.linalg.norm(kept.qpos[:, :3] - reference.qpos[:end, :3], axis=1)
    measured = Measured(
        seconds=reference.duration,
        kept=kept.duration,
        fell=fell,
        joint_error=float(error.mean()),
        joint_error_worst=float(np.percentile(error.mean(1), 95)),
        root_error=float(root.max()),
        left_over=float(np.linalg.norm(forces.left_over[:, :3], axis=1).mean() / weight),
        push=floor_push(kept, body),
        saturated=_saturated(kept, body),
        sunk_before=float((chain.heights(wanted).min(1) < -SUNK).mean()),
        sunk=float((chain.heights(got)[:end].min(1) < -SUNK).mean()),
    )
    record = {k: round(v, 5) if isinstance(v, float) else v for k, v in asdict(measured).items()}
    by = {"seed": settings.seed} if player is None else {"tracker": str(player)}
    meta = {
        **clip.meta,
        "strength": strength,
        "source": f"{clip.meta.get('source', 'clip')}, tracked in MuJoCo",
        "corrected": {"engine": "mujoco", **by, **record},
    }
    return Corrected(
        clip=replace(kept, meta=meta),
        measured=measured,
        reasons=measured.reasons(bounds),
        compute_seconds=time.perf_counter() - begin,
    )


def joint_errors(clip: Clip, reference: Clip) -> np.ndarray:
    """(T, J) distances (m) of the key joints of two clips of one body, frame by frame, over the
    frames that both have. Raises ValueError for clips of two bodies or two rates."""
    if clip.body != reference.body or abs(clip.fps - reference.fps) > 1e-6:
        raise ValueError("the clips differ in body or frame rate")
    chain = Chain(load_body(clip.body))
    end = min(clip.num_frames, reference.num_frames)
    return _distances(chain, *(_frames(chain, c.qpos[:end]) for c in (clip, reference)))


def floor_push(clip: Clip, body: Body) -> float:
    """Largest force of the floor, mean over a frame, in weights of the body: by the change of the
    momentum of the centre of mass (Newton), from positions and velocities alone."""
    momentum = whole_momentum(clip, body)
    force = np.diff(momentum, axis=0) * clip.fps + body.mass * GRAVITY * np.array([0.0, 0.0, 1.0])
    return float(np.linalg.norm(force, axis=1).max() / (body.mass * GRAVITY))


def whole_momentum(clip: Clip, body: Body) -> np.ndarray:
    """(T, 3) linear momentum of the athlete (N s), world axes, by MuJoCo."""
    model = build_model(body)
    data = mujoco.MjData(model)
    out = np.empty((clip.num_frames, 3))
    for t in range(clip.num_frames):
        data.qpos[:], data.qvel[:] = clip.qpos[t], clip.qvel[t]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        out[t] = data.subtree_linvel[0] * body.mass
    return out


def _frames(chain: Chain, qpos: np.ndarray) -> Frames:
    return chain.frames(qpos[:, :3], local_rotations(chain.body, qpos))


def _distances(chain: Chain, one: Frames, two: Frames) -> np.ndarray:
    joints = [chain.index[name] for name in KEY_JOINTS]
    return np.linalg.norm(one.origin[:, joints] - two.origin[:, joints], axis=-1)


def _saturated(clip: Clip, body: Body) -> float:
    """Share of the servos at their limit, at the beginning of each step, where the targets of
    :mod:`warmstart.tracking` are furthest away."""
    assert clip.ctrl is not None
    asked = np.abs(body.array("kp") * (clip.ctrl - clip.qpos[:, 7:]))
    return float((asked >= body.array("effort")).mean())
