"""Is an optimised motion true? A fail-closed gate with every figure listed.

The optimiser says a motion is feasible at its knots, by its own equations. Here the motion between
the knots is sampled five times finer and everything is computed again from other sources: inverse
dynamics by MuJoCo's and by Drake's own algorithms on models built from the body table, geometry by
MuJoCo's collision routines, contact from the links' own motion, and at last both engines replay
the torques: open loop, unless the certificate says that feedback was used (``stats["replay"]``).
What is missing, not finite or could not be computed fails.

Between knots the motion is the one of :meth:`Solution.sample`: joint accelerations, torques and
forces linear in time, so positions are cubics. That is what the trapezoid rule on accelerations
integrates exactly. Full dynamics hold only at the knots; what is left between them is the residual
listed here. Over the whole motion the residual acts like an unknown outside force, so the gate
that the specification sets (2 % of body weight) is on its root mean square, which bounds the
impulse it can give; its peak, always in the middle of one interval around a contact change, is
listed too and may be five times as large.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sports.humanoid.body import Body
from sports.humanoid.mjcf import body_name, build_model
from sports.physics.base import GRAVITY
from sports.scene import humanoid_scene
from warmstart import strike
from warmstart.atomic import write_text
from warmstart.inverse_dynamics import (
    inverse_dynamics_drake,
    inverse_dynamics_mujoco,
    needed,
)
from warmstart.judged import RULES
from warmstart.outcome import OUTCOMES, is_cycle, support
from warmstart.replay import FEEDBACK, replay
from warmstart.solution import Solution

FINER = 5
"""Samples per interval of the optimiser."""
FEET = ("Ankle", "Toe")
"""Links whose contact points are on the ground."""
LOADED = 0.01
"""A contact point counts as loaded from this share of body weight on."""

LIMITS: dict[str, tuple[str, float, str]] = {
    "nlp violation": ("<=", 1e-5, "scaled"),
    "velocity is the rate of position": ("<=", 1e-3, "m/s, rad/s"),
    "acceleration is the rate of velocity": ("<=", 5e-2, "m/s^2, rad/s^2"),
    "base force residual rms, mujoco": ("<=", 0.02, "body weight"),
    "base force residual max, mujoco": ("<=", 0.10, "body weight"),
    "base moment residual rms, mujoco": ("<=", 0.02, "body weight x m"),
    "base moment residual max, mujoco": ("<=", 0.10, "body weight x m"),
    "base force residual rms, drake": ("<=", 0.02, "body weight"),
    "base force residual max, drake": ("<=", 0.10, "body weight"),
    "base moment residual rms, drake": ("<=", 0.02, "body weight x m"),
    "base moment residual max, drake": ("<=", 0.10, "body weight x m"),
    "inverse dynamics, mujoco against drake": ("<=", 1e-6, "of the largest or of body weight"),
    "planned torque": ("<=", 1.0 + 1e-5, "of the limit"),
    "needed torque, mujoco": ("<=", 1.02, "of the limit"),
    "needed torque, drake": ("<=", 1.02, "of the limit"),
    "friction": ("<=", 1e-3, "body weight"),
    "pulling contact force": ("<=", 1e-3, "body weight"),
    "height of loaded contacts": ("<=", 0.005, "m"),
    "speed of loaded contacts": ("<=", 0.05, "m/s"),
    "depth below the ground": ("<=", 0.005, "m"),
    "depth of self-contact": ("<=", 0.02, "m"),
    "beyond a joint limit": ("<=", 1e-6, "rad"),
    "planned outcome": (">=", 0.0, "m"),
    "replay in mujoco: outcome": ("recorded", math.nan, "m"),
    "replay in drake: outcome": ("recorded", math.nan, "m"),
    "replay in mujoco: root error": ("recorded", math.nan, "m"),
    "replay in drake: root error": ("recorded", math.nan, "m"),
}
"""Every check of every problem: sense, limit, unit. A recorded figure must only exist."""
PROBLEM_LIMITS: dict[str, dict[str, tuple[str, float, str]]] = {
    "high_jump": {"clearance over the bar": (">=", 0.0, "m")},
    "long_jump": {
        "foremost contact behind the line": (">=", 0.0, "m"),
        "touch-down: momentum residual": ("<=", 1e-3, "m/s"),
        "touch-down: friction": ("<=", 1e-3, "m/s"),
        "touch-down: energy gained": ("<=", 0.0, "J"),
        "touch-down: upward speed gained": ("<=", 0.81, "m/s"),
    },
    "hurdling": {
        "clearance over the hurdle": (">=", 0.0, "m"),
        "landing beyond the hurdle": (">=", 0.3, "m"),
        "speed at the landing": (">=", 0.9, "of the run's"),
    },
}
CYCLE_LIMITS = {
    "clearance after the landing": (">=", 0.0, "m"),
    "stance of the lead leg": (">=", 0.05, "s"),
    "length of the next step": (">=", 0.5, "m"),
    "speed after the next step": (">=", 0.9, "of the run's"),
}
"""Of a stride over a hurdle that goes on to the end of its cycle."""


OPEN_LOOP, CLOSED_LOOP = (
    "open loop: the planned torques",
    "closed loop: the planned torques and linear feedback of the simulated state, with the same "
    "gains in both engines (warmstart/feedback.py)",
)
"""What a certificate says of its replays (``stats["replay"]``)."""


def required(
    problem: str, feedback: bool = False, cycle: bool = False
) -> dict[str, tuple[str, float, str]]:
    """What a certificate of a problem must list, where its replays are open loop or with feedback,
    and of a stride over a hurdle with or without the rest of its ``cycle``; one of an unknown
    problem cannot pass, nor one with feedback where only open loops count."""
    rules = RULES.get(problem)
    if rules is None:
        out = LIMITS | PROBLEM_LIMITS.get(problem, {"problem is known": ("<=", 0.0, "")})
        out |= CYCLE_LIMITS if cycle else {}
    else:
        out = LIMITS | strike.limits(rules, feedback)
    if feedback and (rules is None or rules.closed is None):
        out |= {"replay must be open loop": ("<=", 0.0, "")}  # never computed: it fails
    return out


@dataclass(frozen=True)
class Check:
    """One figure against its limit."""

    name: str
    value: float
    """NaN where it could not be computed."""
    sense: str
    """``<=``, ``>=``, or ``recorded``: any finite figure passes."""
    limit: float
    unit: str
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the figure is finite and inside its limit."""
        if not math.isfinite(self.value):
            return False
        if self.sense == "recorded":
            return True
        if not math.isfinite(self.limit) or self.sense not in ("<=", ">="):
            return False
        return self.value <= self.limit if self.sense == "<=" else self.value >= self.limit


@dataclass(frozen=True)
class Certificate:
    """Every check of one motion, and the outcome that it achieves."""

    problem: str
    asked: dict[str, float]
    strength: str
    achieved: dict[str, float]
    """``planned``, ``replay_mujoco``, ``replay_drake``: the outcome (m; m/s of a strike or
    throw); 0 for a replay that made no valid attempt (open loop, a jump may fall), missing if it
    could not be computed. Of jumps also ``feedback_mujoco``, ``feedback_drake``: with the feedback
    of :mod:`warmstart.feedback`."""
    checks: tuple[Check, ...]
    stats: dict[str, Any]
    clip: dict[str, Any] = field(default_factory=dict)
    """What was measured of the clip beside it, where that is another motion than the certified one
    (:func:`warmstart.refined_throw.record`); else empty. ``passed`` is of the plan alone."""

    @property
    def required(self) -> dict[str, tuple[str, float, str]]:
        """What a certificate of this problem must list."""
        return required(self.problem, bool(self.stats.get(FEEDBACK)), is_cycle(self.asked))

    @property
    def passed(self) -> bool:
        """True only if every required check is listed with its limit and passes, and all others."""
        listed = {(c.name, c.sense, c.unit) for c in self.checks if self._strict(c)}
        wanted = {(name, sense, unit) for name, (sense, _, unit) in self.required.items()}
        return wanted <= listed and all(c.passed for c in self.checks)

    def _strict(self, check: Check) -> bool:
        limit = self.required.get(check.name, (None, None, None))[1]
        return check.sense == "recorded" or check.limit == limit

    @property
    def failures(self) -> list[str]:
        """One sentence for each check that failed or is missing."""
        out = [
            f"{c.name} is {c.value:.4g} {c.unit}, must be {c.sense} {c.limit:.4g}"
            + (f" ({c.note})" if c.note else "")
            for c in self.checks
            if not c.passed
        ]
        listed = {c.name for c in self.checks}
        return out + [f"{name} is missing" for name in self.required if name not in listed]

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON; figures that are not finite become null."""

        def clean(x: Any) -> Any:
            if isinstance(x, dict):
                return {str(k): clean(v) for k, v in x.items()}
            if isinstance(x, list | tuple):
                return [clean(v) for v in x]
            if isinstance(x, np.generic):
                x = x.item()
            return None if isinstance(x, float) and not math.isfinite(x) else x

        return clean(
            {
                "format": "olympics-opt certificate 1",
                "passed": self.passed,
                "problem": self.problem,
                "asked": self.asked,
                "achieved": self.achieved,
                "strength": self.strength,
                "checks": [asdict(c) | {"passed": c.passed} for c in self.checks],
                "stats": self.stats,
            }
            | ({"clip": self.clip} if self.clip else {})
        )

    def to_json(self, path: str | Path) -> None:
        """Writes ``certificate.json`` atomically."""
        write_text(path, json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n")

    @staticmethod
    def from_json(path: str | Path) -> Certificate:
        """Reads a certificate; ``passed`` is computed anew, what the file says is not believed.

        Raises ValueError naming the file.
        """
        try:
            data = json.loads(Path(path).read_text())
            checks = tuple(
                Check(
                    name=str(c["name"]),
                    value=math.nan if c["value"] is None else float(c["value"]),
                    sense=str(c["sense"]),
                    limit=math.nan if c["limit"] is None else float(c["limit"]),
                    unit=str(c["unit"]),
                    note=str(c["note"]),
                )
                for c in data["checks"]
            )
            return Certificate(
                problem=str(data["problem"]),
                asked=dict(data["asked"]),
                strength=str(data["strength"]),
                achieved={k: float(v) for k, v in data["achieved"].items() if v is not None},
                checks=checks,
                stats=dict(data["stats"]),
                clip=dict(data.get("clip", {})),
            )
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} is not a readable certificate: {error}") from error


def certify(solution: Solution) -> Certificate:
    """Computes every check of a motion. Never raises for a bad motion: what breaks, fails."""
    figures: dict[str, float] = {}
    notes: dict[str, str] = {}
    achieved: dict[str, float] = {}
    groups: list[tuple[str, Callable[[], dict[str, float]]]] = [
        ("nlp", lambda: {"nlp violation": float(solution.stats["max_violation"])}),
        ("interpolation", lambda: _interpolation(solution)),
        ("dynamics", lambda: _dynamics(solution, notes)),
        ("contact", lambda: _contact(solution)),
        ("geometry", lambda: _geometry(solution, notes)),
        ("outcome", lambda: _outcome(solution, achieved)),
        ("touch-down", lambda: _touch_down(solution)),
        ("replay in mujoco", lambda: _replay(solution, "mujoco", achieved)),
        ("replay in drake", lambda: _replay(solution, "drake", achieved)),
        ("feedback in mujoco", lambda: _feedback(solution, "mujoco", achieved)),
        ("feedback in drake", lambda: _feedback(solution, "drake", achieved)),
    ]
    broken = []
    for name, compute in groups:
        try:
            figures |= compute()
        except Exception as error:  # fail-closed: whatever goes wrong, the check is missing
            broken.append(f"{name}: {type(error).__name__}: {error}")
    feedback = bool(solution.stats.get(FEEDBACK))
    listed = required(solution.problem, feedback, is_cycle(solution.asked))
    if feedback:
        notes |= {name: "with feedback" for name in listed if name.startswith("replay in ")}
    checks = tuple(
        Check(name, float(figures.get(name, math.nan)), sense, limit, unit, notes.get(name, ""))
        for name, (sense, limit, unit) in listed.items()
    )
    stats = {k: v for k, v in solution.stats.items() if isinstance(v, int | float | str | bool)}
    stats["replay"] = CLOSED_LOOP if feedback else OPEN_LOOP
    return Certificate(
        problem=solution.problem,
        asked=dict(solution.asked),
        strength=solution.strength,
        achieved={k: v for k, v in achieved.items() if math.isfinite(v)},
        checks=checks,
        stats=stats | ({"not computed": broken} if broken else {}),
    )


def fine_times(solution: Solution) -> np.ndarray:
    """Every knot and ``FINER - 1`` times inside each interval (s)."""
    share = np.arange(FINER) / FINER
    steps = np.diff(solution.times)[:, None]
    return np.append((solution.times[:-1, None] + share * steps).ravel(), solution.times[-1])


def _interpolation(solution: Solution) -> dict[str, float]:
    """Finite differences of the sampled motion inside every interval."""
    model = build_model(solution.body)
    middle, e = 0.5 * (solution.times[1:] + solution.times[:-1]), 1e-5
    before, at, after = (solution.sample(middle + d) for d in (-e, 0.0, e))
    rate, worst = np.zeros(model.nv), 0.0
    for k in range(len(middle)):
        mujoco.mj_differentiatePos(model, rate, 2 * e, before["qpos"][k], after["qpos"][k])
        worst = max(worst, float(np.abs(rate - at["qvel"][k]).max()))
    acceleration = (after["qvel"] - before["qvel"]) / (2 * e)
    return {
        "velocity is the rate of position": worst,
        "acceleration is the rate of velocity": float(np.abs(acceleration - at["qacc"]).max()),
    }


def _dynamics(solution: Solution, notes: dict[str, str]) -> dict[str, float]:
    """Residual wrench on the root and servo torques needed, by both engines."""
    weight = solution.body.mass * GRAVITY
    effort = solution.body.array("effort")
    asked = {
        "mujoco": needed(inverse_dynamics_mujoco, solution, fine_times(solution)),
        "drake": needed(inverse_dynamics_drake, solution, fine_times(solution)),
    }
    scale = max(float(np.abs(asked["mujoco"]).max()), weight)
    difference = np.abs(asked["mujoco"] - asked["drake"]).max() / scale
    out = {"inverse dynamics, mujoco against drake": float(difference)}
    for engine, force in asked.items():
        share = np.abs(force[:, 6:]) / effort
        k, dof = np.unravel_index(int(np.argmax(share)), share.shape)
        name = f"needed torque, {engine}"
        out[name] = float(share.max())
        notes[name] = f"{solution.body.dofs[dof].name} at {fine_times(solution)[k]:.3f} s"
        for part, rows in (("force", slice(0, 3)), ("moment", slice(3, 6))):
            residual = np.linalg.norm(force[:, rows], axis=1) / weight
            duration = np.gradient(fine_times(solution))
            mean_square = np.sum(residual**2 * duration) / np.sum(duration)
            out[f"base {part} residual rms, {engine}"] = float(np.sqrt(mean_square))
            name = f"base {part} residual max, {engine}"
            out[name] = float(residual.max())
            notes[name] = f"at {fine_times(solution)[int(residual.argmax())]:.3f} s"
    share = np.abs(solution.torque) / effort
    dof = int(share.max(0).argmax())
    out["planned torque"] = float(share.max())
    notes["planned torque"] = solution.body.dofs[dof].name
    return out


def _contact(solution: Solution) -> dict[str, float]:
    """Forces inside the friction cone, pushing only, at the feet's points, which rest on the
    ground; what hands do to each other is no contact with it."""
    motion = solution.sample(fine_times(solution))
    scene = humanoid_scene(solution.body)
    model = build_model(scene)
    data = mujoco.MjData(model)
    weight = solution.body.mass * GRAVITY
    feet = [c for c, (link, _) in enumerate(solution.contact_points) if link.endswith(FEET)]
    force = motion["contact_force"][:, feet] / weight
    tangent = np.linalg.norm(force[:, :, :2], axis=2)
    loaded = np.linalg.norm(force, axis=2) > LOADED
    points = [solution.contact_points[c] for c in feet]
    links = [model.body(body_name(0, link)).id for link, _ in points]
    height, speed, jac = 0.0, 0.0, np.zeros((3, model.nv))
    for t in np.flatnonzero(loaded.any(1)):
        data.qpos[:], data.qvel[:] = motion["qpos"][t], motion["qvel"][t]
        mujoco.mj_forward(model, data)
        for c in np.flatnonzero(loaded[t]):
            point = np.array(points[c][1])
            where = data.xpos[links[c]] + data.xmat[links[c]].reshape(3, 3) @ point
            mujoco.mj_jac(model, data, jac, None, where, links[c])
            height = max(height, abs(float(where[2])))
            speed = max(speed, float(np.linalg.norm(jac @ data.qvel)))
    return {
        "friction": float((tangent - scene.ground_friction * force[:, :, 2]).max(initial=0.0)),
        "pulling contact force": float((-force[:, :, 2]).max(initial=0.0)),
        "height of loaded contacts": height,
        "speed of loaded contacts": speed,
    }


def _geometry(solution: Solution, notes: dict[str, str]) -> dict[str, float]:
    """Ground, self-contact and joint limits on the fine grid."""
    times = fine_times(solution)
    qpos = solution.sample(times)["qpos"]
    holds = solution.loaded(times) > 0.0
    depth, own = 0.0, 0.0
    for body, rows in ((solution.body, holds), (solution.empty_handed, ~holds)):
        if not rows.any():
            continue
        points, radii = support(body, qpos[rows])
        depth = max(depth, float((radii - points[..., 2]).max()))
        overlap, where = _overlap(body, times[rows], qpos[rows])
        if overlap > own:
            own, notes["depth of self-contact"] = overlap, where
    hinges = qpos[:, 7:]
    beyond = np.maximum(
        hinges - solution.body.array("upper"), solution.body.array("lower") - hinges
    )
    return {
        "depth below the ground": depth,
        "depth of self-contact": own,
        "beyond a joint limit": max(float(beyond.max()), 0.0),
    }


def _overlap(body: Body, times: np.ndarray, qpos: np.ndarray) -> tuple[float, str]:
    """How far (m) two links of a body are inside each other at most, which, and when."""
    model = build_model(body)
    data = mujoco.MjData(model)
    own, pair = 0.0, ""
    for t, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        for contact in data.contact:
            a, b = (model.geom_bodyid[g] for g in contact.geom)
            if 0 not in (a, b) and -contact.dist > own:
                own = -float(contact.dist)
                names = " and ".join(model.body(i).name.split("/")[-1] for i in (a, b))
                pair = f"{names} at {times[t]:.3f} s"
    return own, pair


def _touch_down(solution: Solution) -> dict[str, float]:
    """The impact before the first state, by MuJoCo: M (v - v before) = J' impulse.

    Empty without an impact. Hinges that the motion holds are held through it too.
    """
    strike = solution.stats.get("touch_down")
    if strike is None:
        return {}
    model = build_model(solution.body)
    data = mujoco.MjData(model)
    data.qpos[:] = solution.qpos[0]
    mujoco.mj_forward(model, data)
    mass, change = solution.body.mass, solution.qvel[0] - np.array(strike["qvel"])
    momentum = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, momentum, change)
    impulses = np.array(strike["impulse"])
    here = [c for c in solution.contact_points if c[0].startswith(strike["side"])]
    jac = np.zeros((3, model.nv))
    for (link, point), impulse in zip(here, impulses, strict=True):
        i = 1 + solution.body.link_index(link)
        where = data.xpos[i] + data.xmat[i].reshape(3, 3) @ np.array(point)
        mujoco.mj_jac(model, data, jac, None, where, i)
        momentum -= jac.T @ impulse
    free = np.ptp(solution.qpos[:, 7:], axis=0) > 1e-9
    scale = np.repeat([mass, 0.5 * mass, 0.05 * mass], [3, 3, model.nv - 6])
    residual = (np.abs(momentum) / scale)[np.concatenate([np.full(6, True), free])]
    energy = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, energy, solution.qvel[0] + np.array(strike["qvel"]))
    slope = humanoid_scene(solution.body).ground_friction
    tangent = np.linalg.norm(impulses[:, :2], axis=1)
    return {
        "touch-down: momentum residual": float(residual.max()),
        "touch-down: friction": float((tangent - slope * impulses[:, 2]).max()) / mass,
        "touch-down: energy gained": 0.5 * float(change @ energy),
        "touch-down: upward speed gained": float(impulses[:, 2].sum()) / mass,
    }


def _outcome(solution: Solution, achieved: dict[str, float]) -> dict[str, float]:
    if solution.problem in RULES:
        found = strike.planned(RULES[solution.problem], solution, fine_times(solution))
        achieved["planned"] = found["planned outcome"]
        return found
    outcome = OUTCOMES[solution.problem]
    times = fine_times(solution)
    motion = solution.sample(times)
    achieved["planned"] = outcome.measure(solution.body, times, motion["qpos"])
    return {
        "planned outcome": achieved["planned"],
        **outcome.rules(solution.body, times, motion["qpos"], solution.asked),
    }


def _replay(solution: Solution, engine: str, achieved: dict[str, float]) -> dict[str, float]:
    if solution.problem in RULES:
        times, qpos, found = strike.replayed(RULES[solution.problem], solution, engine)
        achieved[f"replay_{engine}"] = found[f"replay in {engine}: outcome"]
        return found | _root_error(solution, engine, times, qpos)
    times, qpos = replay(solution, engine)
    outcome = OUTCOMES[solution.problem].measure(solution.body, times, qpos)
    outcome = outcome if math.isfinite(outcome) else 0.0  # a failed attempt achieves nothing
    achieved[f"replay_{engine}"] = outcome
    found = {f"replay in {engine}: outcome": outcome}
    return found | _root_error(solution, engine, times, qpos)


def _feedback(solution: Solution, engine: str, achieved: dict[str, float]) -> dict[str, float]:
    """The outcome of a jump whose torques are corrected by feedback: recorded, no check."""
    if solution.problem in OUTCOMES and not solution.stats.get(FEEDBACK):
        closed = replace(solution, stats=solution.stats | {FEEDBACK: True})
        outcome = OUTCOMES[solution.problem].measure(solution.body, *replay(closed, engine))
        achieved[f"feedback_{engine}"] = outcome if math.isfinite(outcome) else 0.0
    return {}


def _root_error(
    solution: Solution, engine: str, times: np.ndarray, qpos: np.ndarray
) -> dict[str, float]:
    """Largest distance of a replay's root from the planned one."""
    inside = times <= solution.duration
    planned = solution.sample(solution.times[0] + times[inside])["qpos"]
    error = np.linalg.norm(qpos[inside, :3] - planned[:, :3], axis=1)
    return {f"replay in {engine}: root error": float(error.max())}
