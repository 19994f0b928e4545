"""Phases, knots and contacts -> a structured nonlinear program -> a :class:`Solution`.

Full inverse dynamics at every knot (root wrench zero, joint torque = u - kd rate), linear
accelerations between knots:

    v[k+1] = v[k] + h/2 (a[k] + a[k+1]),   q[k+1] = q[k] + h v[k] + h^2/6 (2 a[k] + a[k+1]),

so that the motion between knots is the cubic that passes through them and no interpolation is
invented afterwards. A standing foot is placed once, at the first knot of its contact, and held
by its velocity at every knot after that. At a knot where a contact begins or ends the force of
its points is zero, which makes accelerations and torques continuous across phases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict

import casadi as ca
import numpy as np

from sports.humanoid.body import Body
from sports.physics.base import GRAVITY
from warmstart.contact import Ball, sole_points
from warmstart.nlp import Program, Result
from warmstart.phases import ELASTIC_PRICE, ELASTIC_REACH, MODES, Bounds, Grip, Phase, Weights
from warmstart.rigid_body import ReducedModel, from_full_state, to_full_state
from warmstart.solution import Solution


class Transcription:
    """The program of one multi-phase motion; problems add rows through :meth:`rows`."""

    def __init__(
        self,
        body: Body,
        model: ReducedModel,
        phases: Sequence[Phase],
        bounds: Bounds,
        weights: Weights | None = None,
        held_limits: Sequence[str] = (),
        flight_limits: Sequence[str] = (),
        parameters: int = 0,
        elastic: bool = False,
        standing: bool = False,
        unloaded: ReducedModel | None = None,
        grip: Grip | None = None,
    ) -> None:
        self.grip = grip
        self.standing = standing
        self.unloaded = unloaded or model
        self.body, self.model, self.phases = body, model, tuple(phases)
        self.bounds, self.weights = bounds, weights or Weights()
        self.held_limits, self.flight_limits = tuple(held_limits), tuple(flight_limits)
        self.program = Program(parameters)
        self.elastic = elastic
        self.ends = np.cumsum([0, *(p.intervals for p in phases)])
        self.K = int(self.ends[-1]) + 1
        self.weight = model.tree.total_mass * GRAVITY
        self.effort = model.tree.effort[model.free_index] * bounds.torque_share
        self.sides = tuple(s for s in "LR" if any(s in p.feet for p in phases))
        self.before: np.ndarray | None = None
        self.impulse: np.ndarray | None = None
        self._add_variables()
        self._add_dynamics()
        self._add_intervals()
        self._add_contacts()
        self._add_grip()

    # -- structure ---------------------------------------------------------------------------
    def knots(self, name: str) -> np.ndarray:
        """Knots of a phase, both ends included. Raises KeyError for an unknown name."""
        for i, phase in enumerate(self.phases):
            if phase.name == name:
                return np.arange(self.ends[i], self.ends[i + 1] + 1)
        raise KeyError(f"no phase '{name}'")

    def mode_points(self, side: str, knot: int) -> tuple[int, ...]:
        """Sole points of a side that may push at a knot: both neighbours agree.

        A motion that does not begin ``standing`` begins in the air: at the first knot a foot
        touches but does not push yet.
        """
        active = set(range(6)) if knot or self.standing else set()
        for i, phase in enumerate(self.phases):
            if self.ends[i] <= knot <= self.ends[i + 1]:
                active &= set(MODES[phase.feet[side]] if side in phase.feet else ())
        return tuple(sorted(active))

    def contact_runs(self, side: str) -> list[tuple[int, int]]:
        """(first knot, last knot) of each uninterrupted contact of a side."""
        runs: list[tuple[int, int]] = []
        for i, phase in enumerate(self.phases):
            if side not in phase.feet:
                continue
            first, last = int(self.ends[i]), int(self.ends[i + 1])
            if runs and runs[-1][1] == first:
                runs[-1] = (runs[-1][0], last)
            else:
                runs.append((first, last))
        return runs

    def model_at(self, knot: int) -> ReducedModel:
        """The athlete at a knot: with what it holds where all phases there are loaded."""
        here = [p for i, p in enumerate(self.phases) if self.ends[i] <= knot <= self.ends[i + 1]]
        return self.model if all(p.loaded for p in here) else self.unloaded

    def interval_phase(self) -> np.ndarray:
        """(K-1,) phase of each interval."""
        return np.repeat(np.arange(len(self.phases)), [p.intervals for p in self.phases])

    def spacing(self) -> np.ndarray:
        """(K-1,) length of each interval over the mean of its phase."""
        return np.concatenate([p.spacing() for p in self.phases])

    # -- variables ---------------------------------------------------------------------------
    def _box(self, boxes: Mapping[str, tuple[float, float]], default: float):
        low, high = np.full(self.model.n, -default), np.full(self.model.n, default)
        for name, (a, b) in boxes.items():
            index = self.model.index(name)
            low[index], high[index] = a, b
        return low, high

    def _add_variables(self) -> None:
        P, K, n = self.program, self.K, self.model.n
        self.q = P.variable((K, n), *self._box(self.bounds.position, 50.0), 1.0)
        self.v = P.variable((K, n), *self._box(self.bounds.rate, self.bounds.hinge_rate), 5.0)
        limit = np.full(n, self.bounds.acceleration)
        self.a = P.variable((K, n), -limit, limit, 50.0)
        reach = self.effort * (ELASTIC_REACH if self.elastic else 1.0)
        self.u = P.variable((K, n - 6), -reach, reach, self.effort)
        if self.elastic:
            self._add_slack()
        self.h = P.variable(
            (len(self.phases),),
            [p.duration[0] / p.intervals for p in self.phases],
            [p.duration[1] / p.intervals for p in self.phases],
            0.01,
        )
        self.f: dict[str, dict[int, np.ndarray]] = {}
        for side in self.sides:
            self.f[side] = {}
            for first, last in self.contact_runs(side):
                for k in range(first, last + 1):
                    high = np.zeros((6, 3))
                    low = np.zeros((6, 3))
                    active = list(self.mode_points(side, k))
                    high[active] = 6 * self.weight
                    low[active, :2] = -6 * self.weight
                    self.f[side][k] = P.variable((6, 3), low, high, self.weight / 4)
            for k in self.toe_flat_knots(side):
                self.fix(self.v[k, self.model.index(f"{side}_Toe_y")], 0.0)
        if self.grip is not None:
            most = self.grip.most
            self.held = np.array([k for k in range(self.K) if self.model_at(k) is self.model])
            self.press = np.zeros((self.K, 3), dtype=int)
            self.press[self.held] = P.variable((len(self.held), 3), -most, most, 20.0)

    def _add_slack(self) -> None:
        """Torque limits may stretch, at a price: one factor per joint for the whole motion."""
        self.slack = self.program.variable((self.model.n - 6,), 0.0, ELASTIC_REACH - 1.0)
        effort = ca.DM(self.effort)

        def build(u, s, p):
            return 0.0, [
                ("torque limit", ca.vertcat(u / effort - s, -u / effort - s), -np.inf, 1.0)
            ]

        self.program.block("elastic", [self.u, np.tile(self.slack, (self.K, 1))], build)
        self.program.block(
            "slack", [self.slack[None]], lambda s, p: (ELASTIC_PRICE * ca.sum1(s), [])
        )

    def stretched(self, x: np.ndarray) -> list[tuple[str, float]]:
        """Joints of an elastic program that needed more than their limit: (dof, share)."""
        order = np.argsort(-x[self.slack])
        return [
            (self.model.free[i], 1.0 + float(x[self.slack[i]]))
            for i in order
            if x[self.slack[i]] > 0.005
        ]

    def toe_flat_knots(self, side: str) -> list[int]:
        """Knots at which the toe joint of a flat foot must not move."""
        return sorted(
            {
                int(k)
                for i, phase in enumerate(self.phases)
                if phase.feet.get(side) == "flat"
                for k in range(self.ends[i], self.ends[i + 1] + 1)
            }
        )

    def bound(self, index, low=None, high=None) -> None:
        """Tightens the bounds of variables."""
        for i in np.atleast_1d(index).ravel():
            if low is not None:
                self.program.lower[i] = max(self.program.lower[i], float(low))
            if high is not None:
                self.program.upper[i] = min(self.program.upper[i], float(high))

    def fix(self, index, value: float) -> None:
        """Fixes variables to a value."""
        self.bound(index, value, value)

    # -- rows --------------------------------------------------------------------------------
    def _add_dynamics(self) -> None:
        """Root wrench zero, joint torque = u - kd v, friction cones; limits of held joints
        where they matter (more of them in stance than in flight)."""
        tree = self.model.tree
        damping = ca.DM(tree.damping[self.model.free_index])
        effort = ca.DM(self.effort)
        groups: dict[tuple[tuple[str, ...], bool], list[int]] = {}
        for k in range(self.K):
            sides = tuple(side for side in self.sides if k in self.f[side])
            groups.setdefault((sides, self.model_at(k) is self.model), []).append(k)
        for (sides, loaded), knots in groups.items():
            model = self.model if loaded else self.unloaded
            points = [point for side in sides for point in sole_points(self.body, side)]

            limited = self.held_limits if points else self.flight_limits
            held = [tree.dofs.index(d) for d in limited if d not in model.free]

            gripped = self.grip is not None and loaded

            def build(q, v, a, u, *rest, points=points, held=held, model=model, gripped=gripped):
                forces, rows = [], []
                if gripped:  # the last of the rest are the parameters
                    forces = self._grip_forces(rest[-2])
                if points:
                    f = ca.reshape(rest[0], 3, len(points))
                    forces += [(tree.link(link), p, f[:, i]) for i, (link, p) in enumerate(points)]
                    fx, fy, fz = (f[i, :].T / self.weight for i in range(3))
                    mx, my = self.bounds.friction_x, self.bounds.friction_y
                    cone = ca.vertcat(fx - mx * fz, -fx - mx * fz, fy - my * fz, -fy - my * fz)
                    rows.append(("friction", cone, -np.inf, 0.0))
                tau = model.inverse_dynamics(q, v, a, forces)
                joint = tau[(6 + model.free_index).tolist()]
                rows += [
                    ("base force", tau[:3] / self.weight, 0.0, 0.0),
                    ("base moment", tau[3:6] / (0.5 * self.weight), 0.0, 0.0),
                    ("torque", (joint + damping * v[6:] - u) / effort, 0.0, 0.0),
                ]
                if held:
                    limit = ca.DM(tree.effort[held] * self.bounds.torque_share)
                    rows.append(("held torque", tau[[6 + i for i in held]] / limit, -1.0, 1.0))
                return 0.0, rows

            ks = np.array(knots)
            inputs = [self.q[ks], self.v[ks], self.a[ks], self.u[ks]]
            if points:
                inputs.append(
                    np.array([np.hstack([self.f[s][k].ravel() for s in sides]) for k in knots])
                )
            if gripped:
                inputs.append(self.press[ks])
            self.program.block(f"dynamics {'+'.join(sides) or 'flight'}", inputs, build)

    def _grip_forces(self, press) -> list[tuple[int, tuple[float, float, float], object]]:
        """On both hands, of the force (3x1, N) with which the second one pushes what is held."""
        assert self.grip is not None
        first, second = (self.model.tree.link(b) for b in (self.grip.first, self.grip.second))
        return [(first, self.grip.point, press), (second, self.grip.other, -press)]

    def _add_grip(self) -> None:
        """Neither hand moves against the other while they hold something, nor drifts by what the
        velocities at the knots leave over; the force of the second one costs a little, so that it
        is unique."""
        if self.grip is None:
            return
        model, grip, w = self.model, self.grip, self.weights
        first, second = (model.tree.link(b) for b in (grip.first, grip.second))

        def still(q, v, p):
            motion = model.motion(q, v)
            apart = motion.point_velocity(second, grip.other)
            apart -= motion.point_velocity(first, grip.point)
            turn = motion.R_WL[second] @ motion.w[second] - motion.R_WL[first] @ motion.w[first]
            return 0.0, [("hands together", apart / 0.5, 0.0, 0.0), ("turn", turn / 5, 0.0, 0.0)]

        def place(q, p):
            motion = model.motion(q)
            apart = motion.point(second, grip.other) - motion.point(first, grip.point)
            turn = motion.R_WL[first].T @ motion.R_WL[second] @ ca.DM(grip.turned).T
            skew = ca.vertcat(turn[2, 1], turn[0, 2], turn[1, 0]) - ca.vertcat(
                turn[1, 2], turn[2, 0], turn[0, 1]
            )
            limit = np.repeat([grip.drift, grip.drift / 0.1], 3)
            return [("hands drift", ca.vertcat(apart, skew / 2), -limit, limit)]

        self.program.block("grip", [self.q[self.held], self.v[self.held]], still)
        self.rows("grip drift", self.held[1:], place)
        pairs = np.array([k for k in self.held if k + 1 in self.held])
        h = self.h[self.interval_phase()][pairs][:, None]

        def rate(f0, f1, h, p):
            size = 20.0
            level = w.press * h * p[-1] * ca.sumsqr(f0 / size)
            return level + w.press_rate * ca.sumsqr((f1 - f0) / size) / (h * p[-1]), []

        inputs = [self.press[pairs], self.press[pairs + 1], h]
        self.program.block("press", inputs, rate, self.spacing()[pairs][:, None])

    def _add_intervals(self) -> None:
        """Integration defects and the running cost."""
        w, effort = self.weights, ca.DM(self.effort)

        def build(q0, v0, a0, u0, q1, v1, a1, u1, h, p):
            h = h * p[-1]
            rows = [
                ("velocity", (v1 - v0 - h / 2 * (a0 + a1)) / 0.5, 0.0, 0.0),
                ("position", (q1 - q0 - h * v0 - h**2 / 6 * (2 * a0 + a1)) / 0.1, 0.0, 0.0),
            ]
            running = sum(
                w.effort * ca.sumsqr(u / effort) + w.acceleration * ca.sumsqr(a[6:] / 50)
                for u, a in ((u0, a0), (u1, a1))
            )
            rate = w.torque_rate * ca.sumsqr((u1 - u0) / effort)
            rate += w.acceleration_rate * ca.sumsqr((a1 - a0)[6:] / 50)
            return h / 2 * running + p[-2] * rate / h, rows

        k = np.arange(self.K - 1)
        h = self.h[self.interval_phase()][:, None]
        inputs = [x[k + i] for i in (0, 1) for x in (self.q, self.v, self.a, self.u)]
        spacing = self.spacing()[:, None]
        steady = np.array([not self.phases[i].abrupt for i in self.interval_phase()])
        data = np.hstack([steady[:, None].astype(float), spacing])
        self.program.block("interval", [*inputs, h], build, data)
        for side in self.sides:
            pairs = [k for k in self.f[side] if k + 1 in self.f[side] and steady[k]]

            def force_rate(f0, f1, h, p):
                cost = w.force_rate * ca.sumsqr((f1 - f0) / self.weight) / (h * p[-1])
                if w.shear:
                    level = ca.reshape((f0 + f1) / (2 * self.weight), 3, 6)[:2, :]
                    cost += w.shear * h * p[-1] * ca.sumsqr(level)
                return cost, []

            f0 = np.array([self.f[side][k].ravel() for k in pairs])
            f1 = np.array([self.f[side][k + 1].ravel() for k in pairs])
            self.program.block(f"force rate {side}", [f0, f1, h[pairs]], force_rate, spacing[pairs])

    def _add_contacts(self) -> None:
        """Placement at the first knot of a contact, then no motion of the toe link."""
        model = self.model
        for side in self.sides:
            toe = model.tree.link(f"{side}_Toe")
            sole = sole_points(self.body, side)[2][1]

            def place(q, v, a, p, toe=toe, sole=sole):
                motion = model.motion(q, v, a)
                R = motion.R_WL[toe]
                gravity = ca.DM([0, 0, GRAVITY])
                return 0.0, [
                    ("sole height", motion.point(toe, sole)[2] / 0.1, 0.0, 0.0),
                    ("sole tilt", R[:2, 2], 0.0, 0.0),
                    ("sole acceleration", (R @ motion.acc[toe] - gravity) / 50, 0.0, 0.0),
                    ("sole spin-up", motion.alpha[toe] / 50, 0.0, 0.0),
                ]

            def still(q, v, p, toe=toe):
                motion = model.motion(q, v)
                return 0.0, [
                    ("sole velocity", motion.v[toe] / 0.5, 0.0, 0.0),
                    ("sole spin", motion.w[toe] / 5, 0.0, 0.0),
                ]

            runs = self.contact_runs(side)
            starts = np.array([first for first, _ in runs])
            held = np.concatenate([np.arange(a, b + 1) for a, b in runs])
            self.program.block(
                f"placement {side}", [self.q[starts], self.v[starts], self.a[starts]], place
            )
            for first in starts:
                if first in self.toe_flat_knots(side):  # else it lands with its heel up
                    self.fix(self.q[first, model.index(f"{side}_Toe_y")], 0.0)
            self.program.block(f"stance {side}", [self.q[held], self.v[held]], still)

    def touch_down(self, side: str, foot_speed: float, lift: float) -> None:
        """The first state follows from a plastic impact of a foot that comes down.

        Adds the rates ``before`` (n,) and the ``impulse`` (6, 3) at the sole points (N s, world),

            M (v[0] - before) = J' impulse

        in the rows of the root and of the free hinges (held ones are held through the impact
        too), the impulse inside the friction pyramid, every sole point coming down at no more
        than ``foot_speed`` (m/s) before; the centre of mass gains at most ``lift`` (m/s) upward.
        The foot stands still afterwards (contact rows), so the impact only takes energy
        (Featherstone, Rigid Body Dynamics Algorithms, chapter 11).
        """
        model, points = self.model, sole_points(self.body, side)
        mass = model.tree.total_mass
        rates = self._box(self.bounds.rate, self.bounds.hinge_rate)
        self.before = self.program.variable((model.n,), *rates, 5.0)
        reach = 3.0 * mass
        low = np.tile([-reach, -reach, 0.0], (6, 1))
        self.impulse = self.program.variable((6, 3), low, reach, 0.3 * mass)
        self.touching = side

        def build(q, after, before, impulse, p):
            f = ca.reshape(impulse, 3, len(points))
            change = after - before
            change[2] -= GRAVITY  # the recursion adds it
            forces = [(model.tree.link(link), at, f[:, i]) for i, (link, at) in enumerate(points)]
            tau = model.inverse_dynamics(q, None, change, forces)
            motion = model.motion(q, before)
            falling = [motion.point_velocity(model.tree.link(b), at)[2] for b, at in points]
            fx, fy, fz = (f[i, :].T / mass for i in range(3))
            mx, my = self.bounds.friction_x, self.bounds.friction_y
            cone = ca.vertcat(fx - mx * fz, -fx - mx * fz, fy - my * fz, -fy - my * fz)
            joints = tau[(6 + model.free_index).tolist()]
            return 0.0, [
                ("impulse", tau[:3] / mass, 0.0, 0.0),
                ("turning impulse", tau[3:6] / (0.5 * mass), 0.0, 0.0),
                ("joint impulse", joints / (0.05 * mass), 0.0, 0.0),
                ("impulse friction", cone, -np.inf, 0.0),
                ("lift", ca.sum1(fz), 0.0, lift),
                ("foot comes down", ca.vertcat(*falling), -foot_speed, 0.0),
            ]

        inputs = [self.q[:1], self.v[:1], self.before[None], self.impulse[None]]
        self.program.block(f"touch-down {side}", inputs, build)

    def rows(self, name: str, knots, build: Callable, rates: bool = False) -> None:
        """Rows on the positions (and rates) of knots: ``build(q[, v], p) -> [(row, ...)]``."""
        knots = np.atleast_1d(knots)
        inputs = [self.q[knots], self.v[knots]] if rates else [self.q[knots]]
        self.program.block(name, inputs, lambda *x: (0.0, build(*x)))

    def cost(self, name: str, knots, build: Callable) -> None:
        """A cost on positions and rates of knots: ``build(q, v, p) -> scalar``."""
        knots = np.atleast_1d(knots)
        self.program.block(name, [self.q[knots], self.v[knots]], lambda *x: (build(*x), []))

    def ground(self, balls: Sequence[Ball], knots, margin: float = 0.01) -> None:
        """Every ball stays ``margin`` above the ground at the knots."""
        model = self.model

        def build(q, p):
            motion = model.motion(q)
            heights = [
                motion.point(model.tree.link(b.link), b.center)[2] - b.radius - margin
                for b in balls
            ]
            return [("ground clearance", ca.vertcat(*heights) / 0.1, 0.0, np.inf)]

        self.rows("ground", knots, build)

    # -- guess and result ----------------------------------------------------------------------
    def guess(self, q: np.ndarray, durations: Sequence[float]) -> np.ndarray:
        """A start point from positions (K, n) and phase durations (s)."""
        h = np.array([d / p.intervals for d, p in zip(durations, self.phases, strict=True)])
        t = self._times(h)
        v = np.gradient(q, t, axis=0)
        x = np.zeros(len(self.program.lower))
        x[self.q], x[self.v], x[self.h] = q, v, h
        x[self.a] = np.gradient(v, t, axis=0)
        for side in self.sides:
            for k, index in self.f[side].items():
                active = self.mode_points(side, k)
                for point in active:
                    feet = len(self.sides) if self.standing else 0.5  # a take-off: twice the weight
                    x[index[point, 2]] = self.weight / feet / len(active)
        return self._guess_rest(x)

    def _guess_rest(self, x: np.ndarray) -> np.ndarray:
        """Fills in the variables that neither key poses nor a solution have."""
        if self.elastic:
            x[self.slack] = 1.0
        if self.before is not None:
            x[self.before] = x[self.v[0]]
        return x

    def guess_from(self, solution: Solution) -> np.ndarray:
        """A start point from a solution of the same problem, phase by phase.

        Knot counts may differ. Raises ValueError when the phases have other names.
        """
        names = [name for name, *_ in solution.phases]
        if names != [p.name for p in self.phases]:
            raise ValueError(
                f"the guess has phases {names}, the problem {[p.name for p in self.phases]}"
            )
        t, h = [], []
        for i, (_, k0, k1, _) in enumerate(solution.phases):
            steps = np.concatenate([[0.0], np.cumsum(self.phases[i].spacing())])
            share = np.minimum(steps / self.phases[i].intervals, 1.0)
            knots = solution.times[k0] + share * (solution.times[k1] - solution.times[k0])
            t.extend(knots if i == 0 else knots[1:])
            h.append((knots[-1] - knots[0]) / self.phases[i].intervals)
        s = solution.sample(np.array(t))
        q, v, a = from_full_state(self.model, s["qpos"], s["qvel"], s["qacc"])
        x = np.zeros(len(self.program.lower))
        x[self.q], x[self.v], x[self.a], x[self.h] = q, v, a, h
        x[self.u] = s["torque"][:, self.model.free_index]
        points = {point: i for i, point in enumerate(solution.contact_points)}
        for side in self.sides:
            for i, point in enumerate(sole_points(self.body, side)):
                if point in points:
                    for k, index in self.f[side].items():
                        x[index[i]] = s["contact_force"][k, points[point]]
        if self.grip is not None:
            x[self.press[self.held]] = -s["contact_force"][self.held, -1]
        self._guess_rest(x)
        strike = solution.stats.get("touch_down")
        if self.before is not None and strike:
            qvel = np.array([strike["qvel"]])
            _, v, _ = from_full_state(self.model, s["qpos"][:1], qvel, np.zeros_like(qvel))
            x[self.before], x[self.impulse] = v[0], strike["impulse"]
        return x

    def times(self, x: np.ndarray) -> np.ndarray:
        """(K,) knot times of a point of the program (s)."""
        return self._times(x[self.h])

    def _times(self, h: np.ndarray) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum(h[self.interval_phase()] * self.spacing())])

    def nominal_times(self, durations: Sequence[float]) -> np.ndarray:
        """(K,) knot times (s) for given phase durations (s)."""
        pairs = zip(durations, self.phases, strict=True)
        return self._times(np.array([d / p.intervals for d, p in pairs]))

    def full_torque(self, x: np.ndarray) -> np.ndarray:
        """(K, num_dofs) servo torque of all joints, held ones by inverse dynamics (N m)."""
        model, points = self.model, [p for s in self.sides for p in sole_points(self.body, s)]
        q, v, a = (ca.SX.sym(name, model.n) for name in "qva")
        f = ca.SX.sym("f", 3, len(points))
        forces = [(model.tree.link(link), p, f[:, i]) for i, (link, p) in enumerate(points)]
        press = ca.SX.sym("press", 3)
        grips = self._grip_forces(press) if self.grip is not None else []
        functions = [
            ca.Function("tau", [q, v, a, f, press], [m.inverse_dynamics(q, v, a, every)])
            for m, every in ((self.model, forces + grips), (self.unloaded, forces))
        ]
        force = self.forces(x)
        torque = np.zeros((self.K, model.tree.num_dofs))
        for k in range(self.K):
            tau = functions[self.model_at(k) is not self.model]
            push = force[k, : len(points)].T
            state = x[self.q[k]], x[self.v[k]], x[self.a[k]]
            out = np.array(tau(*state, push, -force[k, -1])).ravel()
            torque[k] = out[6:]
        torque[:, model.free_index] += model.tree.damping[model.free_index] * x[self.v[:, 6:]]
        return torque

    def forces(self, x: np.ndarray) -> np.ndarray:
        """(K, C, 3) contact forces (N, world): sides in order, six points each, then what both
        hands of a grip feel."""
        feet = 6 * len(self.sides)
        out = np.zeros((self.K, feet + (2 if self.grip is not None else 0), 3))
        for i, side in enumerate(self.sides):
            for k, index in self.f[side].items():
                out[k, 6 * i : 6 * i + 6] = x[index]
        if self.grip is not None:
            out[self.held, feet], out[self.held, feet + 1] = (
                sign * x[self.press[self.held]] for sign in (1.0, -1.0)
            )
        return out

    def contact_points(self) -> tuple[tuple[str, tuple[float, float, float]], ...]:
        """The C points (link, place in its frame (m)) of :meth:`forces`."""
        grip = self.grip
        feet = tuple(p for s in self.sides for p in sole_points(self.body, s))
        if grip is None:
            return feet
        return (*feet, (grip.first, grip.point), (grip.second, grip.other))

    def _touch_down_stats(self, x: np.ndarray) -> dict[str, object]:
        """The rates before the touch-down (qvel) and the impulse at the sole points (N s)."""
        if self.before is None or self.impulse is None:
            return {}
        q, v = x[self.q[:1]], x[self.before][None]
        _, qvel, _ = to_full_state(self.model, q, v, np.zeros_like(v))
        impulse = x[self.impulse]
        return {
            "touch_down": {
                "side": self.touching,
                "qvel": qvel[0].tolist(),
                "impulse": impulse.tolist(),
            }
        }

    def solution(
        self, problem: str, asked: dict[str, float], result: Result, **stats: object
    ) -> Solution:
        """The full-body motion of a converged point."""
        x = result.x
        qpos, qvel, qacc = to_full_state(self.model, x[self.q], x[self.v], x[self.a])
        phases = []
        for i, phase in enumerate(self.phases):
            active = [
                6 * j + point
                for j, side in enumerate(self.sides)
                if side in phase.feet
                for point in MODES[phase.feet[side]]
            ]
            if self.grip is not None and phase.loaded:
                active += [6 * len(self.sides), 6 * len(self.sides) + 1]
            phases.append((phase.name, int(self.ends[i]), int(self.ends[i + 1]), tuple(active)))
        return Solution(
            problem=problem,
            body=self.body,
            asked=asked,
            strength=self.body.strength,
            times=self.times(x),
            qpos=qpos,
            qvel=qvel,
            qacc=qacc,
            torque=self.full_torque(x),
            contact_points=self.contact_points(),
            contact_force=self.forces(x),
            phases=tuple(phases),
            stats={
                "solve_s": round(result.solve_s, 2),
                "cpu_s": round(result.cpu_s, 2),
                "iterations": result.iterations,
                "max_violation": result.max_violation,
                "objective": result.objective,
                "status": result.status,
                "variables": len(self.program.lower),
                "weights": asdict(self.weights),
                "bounds": self.bounds.limits(),
                "boxes": self.bounds.boxes(),
                **self._touch_down_stats(x),
                **stats,
            },
        )
