"""Closed-loop tracking of a reference motion in MuJoCo by sampling PD targets.

An optimised motion replayed open loop drifts off at the first contact that is a little different.
Here the PD targets are planned again at every control step: a batch of worlds starts from the
present state, each plays the reference's targets (feed-forward torque included) plus a random
spline, and the best decide what is played next. The result is a motion that MuJoCo really
produced, with targets held over each control step as a policy holds them, so that it can seed
training; its outcome is measured by the task's own rules.

Method: sampling-based predictive control with rank-weighted elites (Howell 2022, Predictive
Sampling, section 3; Williams 2017, Model Predictive Path Integral Control, for the averaging).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from mujoco.batch import Batch

from sports.ball_law.compiled import for_cpu
from sports.ball_law.contact import Game
from sports.humanoid.mjcf import body_name, build_spec
from sports.physics.game import build_game, has_game
from sports.physics.momentum import AthleteKeeper, rows_of
from sports.registry import task_names
from sports.scene import Scene
from warmstart.clip import Clip, clip_from_solution
from warmstart.outcome import OUTCOMES, flight_events
from warmstart.replay import play, scene_of, scene_options
from warmstart.solution import Solution
from warmstart.tracking_cost import JumpRules, Reference, Weights, jump_rules, weights_of

_VEL = int(mujoco.mjtStage.mjSTAGE_VEL)
_State = tuple[np.ndarray, np.ndarray, np.ndarray]  # qpos, qvel, the solver's warm start


@dataclass(frozen=True)
class Tracking:
    """Settings of the sampling. Raises ValueError when nothing could be sampled with them."""

    worlds: int = 96
    """Candidates simulated at once."""
    horizon: int = 14
    """Control steps looked ahead."""
    knot_every: int = 3
    """Control steps between the knots of a random spline."""
    iterations: int = 4
    """Rounds of sampling per control step."""
    after: int = 12
    """Control steps planned beyond the reference where a task decides its outcome there: the
    long jump's marks count for 10, an athlete may fall back onto the bar."""
    noise: float = 0.15
    """Standard deviation of the targets' spline, as a share of the servo's range effort / kp."""
    elites: int = 10
    """Candidates that are averaged, by rank."""
    lost: float = math.inf
    """Mean distance of the links from the reference's (m) beyond which the rest is given up."""
    seed: int = 0
    weights: Weights | None = None
    """None: those of the motion's problem (``weights_of``)."""

    def __post_init__(self) -> None:
        if not self.lost > 0:
            raise ValueError(f"tracking cannot be lost from {self.lost} m on")
        if self.worlds < 2 or min(self.horizon, self.knot_every, self.elites) < 1:
            raise ValueError(
                "tracking needs at least 2 worlds, and horizon, knot_every and elites of at least 1"
            )


@dataclass(frozen=True)
class Tracked:
    """A tracked motion and how close it came."""

    clip: Clip
    """What MuJoCo did, at the control rate, from the first frame to the end of the outcome."""
    link_error: float
    """Root mean square distance of the links from the reference's over its duration (m)."""
    root_error: float
    """Largest distance of the root from the reference's (m)."""
    seconds: float

    @property
    def success(self) -> bool:
        """Whether the task called the motion a success."""
        return self.clip.meta.get("achieved", {}).get("success") == 1.0

    @property
    def share(self) -> float:
        """The outcome over the one asked for, at most 1; 1 where a task measures no such thing."""
        meta = self.clip.meta
        name = OUTCOMES[meta["problem"]].field if meta.get("problem") in OUTCOMES else ""
        asked, achieved = (meta.get(which, {}).get(name) for which in ("asked", "achieved"))
        return min(achieved / asked, 1.0) if asked and achieved else 1.0


class Worlds:
    """A batch that plays candidates from one state, by the physics of the ``mujoco`` engine.

    Like the engine it keeps the athlete's momentum and the flight of a javelin; unlike it, it
    simulates as many worlds as are asked for, in double precision, and reads no forces.
    """

    def __init__(self, scene: Scene, worlds: int, threads: int, feel: bool = False) -> None:
        """``feel``: notes which links touch the ground, see ``touched``."""
        names = scene.body.link_names
        root = body_name(0, names[0])
        ground = [f"ground:{body_name(0, name)}" for name in names] if feel else []
        spec = build_spec(scene)
        for sensor in list(spec.sensors):  # nobody reads other forces here, and they cost time
            if sensor.type == mujoco.mjtSensor.mjSENS_CONTACT and sensor.name not in ground:
                spec.delete(sensor)
        self.scene, self.model, self._root = scene, self._compiled(spec), root
        self.batch = Batch(self.model, nsim=worlds, nthread=threads)
        bind = self.batch.bind
        self.qpos, self.qvel, self.ctrl = bind("qpos"), bind("qvel"), bind("ctrl")
        self.warm = bind("qacc_warmstart")
        self.xpos, self.xquat, self.xmat = bind("xpos"), bind("xquat"), bind("xmat")
        self.links = np.array([self.model.body(body_name(0, name)).id for name in names])
        first = [self.model.sensor(name).adr[0] for name in ground]
        self._ground = np.add.outer(first, np.arange(3)).astype(int)  # columns of their forces
        self._sensors = bind("sensordata")
        self.touched = np.zeros((worlds, len(ground)), dtype=bool)
        """(N, B) links that touched the ground in any substep of the last control step; (N, 0) if
        that is not felt."""
        self._keepers: dict[int, AthleteKeeper] = {}
        self._flying: Game | None = None
        """A javelin, whose flight is that of the engine."""
        if scene.ball is None and has_game(scene):
            self._flying = build_game(scene, self.model, worlds, bind("xfrc_applied"))
        self._even = np.full(worlds, scene.timestep)

    def put(self, count: int, qpos: np.ndarray, qvel: np.ndarray, warm: np.ndarray) -> None:
        """Puts the first ``count`` worlds into one state."""
        self.ids = np.arange(count)
        if count not in self._keepers:
            self._keepers[count] = AthleteKeeper(self.model, self.batch.bind, self._root, count)
        self.keeper = self._keepers[count]
        self.keeper.forget()
        self.qpos[:count], self.qvel[:count], self.warm[:count] = qpos, qvel, warm
        self.batch.forward(ids=self.ids, stage=_VEL)
        self._shift = np.zeros((count, 3))

    def step(self, ctrl: np.ndarray) -> None:
        """One control step of the worlds that were put."""
        self.ctrl[self.ids] = ctrl
        self.touched = np.zeros((len(self.ids), len(self._ground)), dtype=bool)
        for substep in range(self.scene.substeps):
            last = substep == self.scene.substeps - 1
            if self._flying is not None:
                for_cpu().push_worlds(self._flying, self._even, self.qpos, self.qvel)
            self._substep(_VEL if last else 0)
            if self._flying is not None:
                for_cpu().turn_worlds(self._flying, self._even, self.qpos, self.qvel)
            self.touched |= self._sensors[: len(self.ids), self._ground].any(2)
            _, self._shift = self.keeper.correct(current=last)

    def _compiled(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """The model of all worlds; worlds of another kind change it here."""
        return spec.compile()

    def _substep(self, stage: int) -> None:
        """One time step of the worlds that were put, up to a stage of MuJoCo's."""
        self.batch.step(ids=self.ids, stage=stage)

    @property
    def link_pos(self) -> np.ndarray:
        """(N, B, 3) positions of the links (m)."""
        return self.xpos[: len(self.ids), self.links] + self._shift[:, None]

    @property
    def link_mat(self) -> np.ndarray:
        """(N, B, 3, 3) rotation matrices of the links."""
        return self.xmat[: len(self.ids), self.links].reshape(len(self.ids), -1, 3, 3)

    @property
    def whole(self) -> np.ndarray:
        """(N, 9) centre of mass (m), its velocity (m/s), angular momentum about it (N m s)."""
        return self.keeper.whole()

    def kinematics(self, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, ...]:
        """Of T frames: link positions (T, B, 3), attitudes (T, B, 4) and ``whole`` (T, 9)."""
        data = mujoco.MjData(self.model)
        keeper = AthleteKeeper(self.model, rows_of(data), self._root)
        rows = []
        for p, v in zip(qpos, qvel):
            data.qpos[self.scene.agent_qpos(0)] = p
            data.qvel[self.scene.agent_qvel(0)] = v
            mujoco.mj_forward(self.model, data)
            rows.append((data.xpos[self.links], data.xquat[self.links], keeper.measured()[0]))
        return tuple(np.array(x) for x in zip(*rows))


def track(
    reference: Clip | Solution,
    scene: Scene | None = None,
    settings: Tracking | None = None,
    *,
    threads: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Tracked:
    """Follows a reference in MuJoCo in closed loop; the clip holds the motion that came out.

    Without a scene, that of the reference's problem is used (``meta["problem"]``, with its
    ``asked`` options that the task knows), or the athlete alone where no task has that name.
    ``progress(step, steps)`` is called after every control step. Where the reference ends, its
    last targets are held until the task has decided the outcome. Raises ValueError when the
    reference is not of the scene's body, RuntimeError when the simulation diverges.
    """
    settings = settings or Tracking()
    clip = clip_from_solution(reference) if isinstance(reference, Solution) else reference
    if scene is None:
        scene = scene_of(clip)
    if scene.body.name != clip.body:
        raise ValueError(f"the clip is of body '{clip.body}', the scene of '{scene.body.name}'")
    begin = time.perf_counter()
    jumps = clip.meta.get("problem") == "long_jump"
    worlds = Worlds(scene, settings.worlds, threads, feel=jumps)
    frames = _reference(clip, worlds)
    weights = settings.weights or weights_of(clip.meta.get("problem", ""))
    steps, rules = len(frames.ctrl) - 1, None
    outcome = OUTCOMES.get(clip.meta.get("problem", ""))
    if clip.meta.get("problem") in task_names():
        after = settings.after if outcome is None else min(settings.after, outcome.after)
        frames = frames.held(after)  # the bar and the mark are lost after the landing
    if jumps:
        rules = jump_rules(clip, scene, weights)
    qpos, qvel, ctrl = _follow(frames, steps, worlds, settings, weights, rules, progress)
    tracked = replace(
        clip,
        fps=1.0 / scene.control_timestep,
        qpos=qpos,
        qvel=qvel,
        ctrl=ctrl,
        object_qpos=None,
        object_qvel=None,
        meta={**clip.meta, "source": f"{clip.meta.get('source', 'clip')}, tracked in MuJoCo"},
    )
    if clip.meta.get("problem") in task_names():
        judge = None if outcome is None else outcome.judge
        tracked, achieved = play(
            tracked,
            clip.meta["problem"],
            scene_options(clip),
            scene.body,
            hold=judge is None,
        )
        if judge is not None:
            achieved |= judge(scene.body, tracked.times, tracked.qpos, clip.meta["asked"])
            achieved["success"] *= len(tracked.qpos) == len(qpos)  # else the task broke it off
        tracked.meta["achieved"] = achieved
        tracked.meta["events"] = flight_events(scene.body, tracked.times, tracked.qpos)
    links, *_ = worlds.kinematics(tracked.qpos[: steps + 1], tracked.qvel[: steps + 1])
    root = np.linalg.norm(tracked.qpos[: steps + 1, :3] - frames.qpos[: len(links), :3], axis=1)
    error = np.linalg.norm(links - frames.link_pos[: len(links)], axis=2)
    return Tracked(
        clip=tracked,
        link_error=float(np.sqrt(np.mean(error**2))),
        root_error=float(root.max()),
        seconds=time.perf_counter() - begin,
    )


def track_best(
    reference: Clip | Solution,
    settings: Tracking | None = None,
    *,
    attempts: int = 3,
    threads: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Tracked:
    """Tracks in the task's scene until the task calls it a success with the outcome that was asked
    for that does not touch the bar; else the best of all ``attempts``: a
    success, then the outcome, then a bar that was not touched, then the error of the links.

    Each attempt draws other noise, the later ones more of it. Raises ValueError for a reference
    whose problem is no task, RuntimeError when every attempt diverged.
    """
    settings = settings or Tracking()
    clip = clip_from_solution(reference) if isinstance(reference, Solution) else reference
    if clip.meta.get("problem") not in task_names():
        raise ValueError(
            f"the clip's problem {clip.meta.get('problem')!r} is no task to succeed in"
        )
    best, reason = None, ""
    for attempt in range(attempts):
        drawn = replace(
            settings, seed=settings.seed + attempt, noise=settings.noise * (1 + 0.5 * (attempt % 3))
        )
        try:
            found = track(clip, settings=drawn, threads=threads, progress=progress)
        except RuntimeError as error:
            reason = str(error)
            continue
        if best is None or _rank(found) > _rank(best):
            best = found
        if best.success and best.share >= 1.0 and _clear(best):
            return best
    if best is None:
        raise RuntimeError(f"none of {attempts} attempts could be simulated: {reason}")
    return best


def _clear(tracked: Tracked) -> bool:
    """Whether the athlete passed over the bar without touching it; true where there is none."""
    return tracked.clip.meta["achieved"].get("clearance", 0.0) >= 0.0


def _rank(tracked: Tracked) -> tuple[bool, float, bool, float]:
    return tracked.success, tracked.share, _clear(tracked), -tracked.link_error


def _reference(clip: Clip, worlds: Worlds) -> Reference:
    scene = worlds.scene
    rate = 1.0 / scene.control_timestep
    if abs(clip.fps - rate) > 1e-6:
        clip = clip.resample(rate)
    limit = scene.body.action_scale()
    ctrl = clip.ctrl if clip.ctrl is not None else clip.qpos[:, 7:]
    kinematics = worlds.kinematics(clip.qpos, clip.qvel)
    return Reference(clip.qpos, clip.qvel, np.clip(ctrl, -limit, limit), *kinematics)


def _spline(knots: np.ndarray, steps: int, every: int) -> np.ndarray:
    """(..., steps, n) piecewise linear curve through knots (..., K, n) ``every`` steps apart."""
    x = np.arange(steps) / every
    k = np.minimum(x.astype(int), knots.shape[-2] - 2)
    s = (x - k)[:, None]
    return (1 - s) * knots[..., k, :] + s * knots[..., k + 1, :]


def _follow(
    frames: Reference,
    end: int,
    worlds: Worlds,
    settings: Tracking,
    weights: Weights,
    rules: JumpRules | None,
    progress: Callable[[int, int], None] | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The receding horizon loop: qpos (T, 7 + n), qvel (T, 6 + n) and ctrl (T, n)."""
    scene, body, n = worlds.scene, worlds.scene.body, settings.worlds
    rng = np.random.default_rng(settings.seed)
    unit = np.minimum(body.array("effort") / body.array("kp"), 0.5)
    limit = body.action_scale()
    q, v = scene.agent_qpos(0), scene.agent_qvel(0)
    state_q, state_v = scene.default_qpos(), np.zeros(scene.nv)
    state_q[q], state_v[v] = frames.qpos[0], frames.qvel[0]
    warm = np.zeros(scene.nv)
    steps, every = len(frames.ctrl) - 1, settings.knot_every
    knots = (settings.horizon - 1) // every + 2
    plan = np.zeros((settings.horizon, body.num_dofs))  # added to the reference's targets
    elites = min(settings.elites, n)
    ranks = np.log(elites + 0.5) - np.log(np.arange(1, elites + 1))
    ranks /= ranks.sum()
    out_q, out_v, out_u = [state_q[q].copy()], [state_v[v].copy()], []

    def cost_of(offset: np.ndarray, ahead: np.ndarray, state: _State) -> np.ndarray:
        targets = np.clip(frames.ctrl[ahead] + offset[:, : len(ahead)], -limit, limit)
        cost = _rollout(frames, end, worlds, targets, int(ahead[0]), state, weights, rules)
        return cost + weights.effort * np.mean((offset / unit) ** 2, axis=(1, 2)) * len(ahead)

    for now in range(steps):
        ahead = np.arange(now, min(now + settings.horizon, steps))
        state = (state_q, state_v, warm)
        known = [plan, np.zeros_like(plan)]
        for round_ in range(settings.iterations):
            scale = settings.noise * 0.6**round_ * unit
            noise = rng.standard_normal((n, knots, body.num_dofs)) * scale
            offset = plan + _spline(noise, settings.horizon, every)
            offset[: len(known)] = known
            best = np.argsort(cost_of(offset, ahead, state), kind="stable")[: settings.elites]
            plan = np.einsum("e,ehn->hn", ranks[: len(best)], offset[best])
            known = [plan, offset[best[0]]]
        # An average of good candidates need not be good: play the better one.
        plan = known[int(np.argmin(cost_of(np.array(known), ahead, state)))]
        control = np.clip(frames.ctrl[now] + plan[0], -limit, limit)
        worlds.put(1, *state)
        worlds.step(control[None])
        state_q, state_v, warm = worlds.qpos[0].copy(), worlds.qvel[0].copy(), worlds.warm[0].copy()
        if not np.isfinite(state_q).all() or np.abs(state_v).max() > 200.0:
            raise RuntimeError(f"the simulation diverged at step {now} of the tracked clip")
        out_q.append(state_q[q].copy())
        out_v.append(state_v[v].copy())
        out_u.append(control)
        plan = np.concatenate([plan[1:], plan[-1:]])
        if progress is not None:
            progress(now + 1, steps)
        away = np.linalg.norm(worlds.link_pos[0] - frames.link_pos[now + 1], axis=1).mean()
        if away > settings.lost:
            break
    out_u.append(frames.ctrl[len(out_u)])
    return np.array(out_q), np.array(out_v), np.array(out_u)


def _rollout(
    frames: Reference,
    end: int,
    worlds: Worlds,
    targets: np.ndarray,
    now: int,
    state: _State,
    weights: Weights,
    rules: JumpRules | None,
) -> np.ndarray:
    """(N,) cost of N target sequences (N, H, n) from one state."""
    scene = worlds.scene
    v = scene.agent_qvel(0)
    has_bar = any(o.name == "bar" for o in scene.free_objects)
    bar = scene.object_qpos("bar") if has_bar else slice(0)
    bar_rate = scene.object_qvel("bar") if has_bar else slice(0)
    rest = scene.default_qpos()[bar][:3]
    count = len(targets)
    worlds.put(count, *state)
    cost = np.zeros(count)
    before = rules.placed(worlds.link_pos, worlds.link_mat) if rules is not None else None
    for k in range(targets.shape[1]):
        worlds.step(targets[:, k])
        at = now + k + 1
        pos, quat = worlds.link_pos, worlds.xquat[:count, worlds.links]
        rate = worlds.qvel[:count, v][:, 6:] - frames.qvel[at, 6:]
        whole = (worlds.whole - frames.whole[at]) ** 2
        distance = np.sum((pos - frames.link_pos[at]) ** 2, axis=2).mean(1)
        dot = np.einsum("nbi,bi->nb", quat, frames.link_quat[at])
        step = (
            weights.link_position * distance
            + weights.link_rotation * (4.0 * (1.0 - dot**2)).mean(1)
            + weights.com_position * whole[:, :3].sum(1)
            + weights.momentum * whole[:, 3:6].sum(1)
            + weights.spin * whole[:, 6:].sum(1)
            + weights.joint_rate * np.mean(rate**2, axis=1)
        )
        if at > end:
            step *= weights.after
        if rules is not None and before is not None:
            here = rules.placed(pos, worlds.link_mat)
            step += rules.cost(at, here, before, worlds.touched)
            before = here
        if has_bar:
            shift = np.linalg.norm(worlds.qpos[:count, bar][:, :3] - rest, axis=1)
            speed = np.linalg.norm(worlds.qvel[:count, bar_rate][:, :3], axis=1)
            step += weights.bar * np.maximum(shift + 0.1 * speed - 0.005, 0.0)
        cost += step
    return np.nan_to_num(cost, nan=1e9, posinf=1e9)
