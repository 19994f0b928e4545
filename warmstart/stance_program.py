"""The least-effort stance before a flight, as a Drake MathematicalProgram.

Variables are states, accelerations, torques and forces at the knots of a :class:`Solution`;
accelerations are linear between knots, so with the timing given the integration rows are linear.
Rigid-body terms come from a :class:`ReducedPlant` through AutoDiff. State and acceleration at both
ends are given. Left out are clearances other than between a sole that does not stand, or a raised
heel, and the ground.
"""

# The stubs of Drake type arrays more narrowly than they are.
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff
from pydrake.solvers import (
    BoundingBoxConstraint,
    EvaluatorBase,
    MathematicalProgram,
    SnoptSolver,
    SolverOptions,
)

from sports.physics.base import GRAVITY
from warmstart.contact import sole_points
from warmstart.problems.jumper import HELD_LIMITS, POSITION, RATE, boxes
from warmstart.reduced_plant import ReducedPlant
from warmstart.rigid_body import from_full_state, load_tree, reduce_tree
from warmstart.solution import Solution
from warmstart.transcription import Bounds, Weights

ACCELERATION_SCALE, RATE_SCALE = 50.0, 5.0
"""rad/s^2 (m/s^2) and rad/s (m/s) per unit of the solver's variables."""


@dataclass(frozen=True)
class Stance:
    """A stance before a flight, cut from a :class:`Solution`."""

    first: int
    last: int
    """Knots of the solution, both included."""
    active: tuple[tuple[int, ...], ...]
    """Contact points that push, per knot; none at the first, where the foot only touches."""


def stances(solution: Solution) -> tuple[Stance, ...]:
    """Every uninterrupted contact before a flight, in order. Empty where no flight follows one."""
    contact = [bool(active) for *_, active in solution.phases]
    out = []
    for end in range(len(contact) - 1):
        if not contact[end] or contact[end + 1]:
            continue
        begin = end
        while begin > 0 and contact[begin - 1]:
            begin -= 1
        first, last = solution.phases[begin][1], solution.phases[end][2]
        active = []
        for k in range(first, last + 1):
            points = set(range(len(solution.contact_points)))
            for _, a, b, pushing in solution.phases:
                if a <= k <= b:
                    points &= set(pushing)
            active.append(tuple(sorted(points)) if k > first else ())
        out.append(Stance(first, last, tuple(active)))
    return tuple(out)


def take_off(solution: Solution) -> Stance:
    """The stance before the longest flight of a solution: the one that decides it.

    Raises ValueError when no flight follows a stance.
    """
    found = stances(solution)
    if not found:
        raise ValueError(f"solution of '{solution.problem}' has no flight after a stance")
    ends = [stance.first for stance in found[1:]] + [len(solution.times) - 1]
    flights = [solution.times[end] - solution.times[s.last] for s, end in zip(found, ends)]
    return found[int(np.argmax(flights))]


class StanceProgram:
    """The least-effort stance between two states as a MathematicalProgram."""

    def __init__(
        self,
        solution: Solution,
        weights: Weights | None = None,
        bounds: Bounds | None = None,
        held_limits: Sequence[str] = HELD_LIMITS,
        stance: Stance | None = None,
    ) -> None:
        """``stance``: the one of :func:`take_off` by default."""
        self.solution, self.stance = solution, stance or take_off(solution)
        self.weights = weights or Weights(**solution.stats.get("weights", {}))
        limits = solution.stats.get("bounds", {})
        table = solution.stats.get("boxes", {"position": boxes(POSITION), "rate": boxes(RATE)})
        self.bounds = bounds or Bounds(**table, **limits)
        stance = self.stance
        keep = slice(stance.first, stance.last + 1)
        hinges = solution.qpos[:, 7:]
        moving = np.ptp(hinges, axis=0) + np.abs(solution.qvel[:, 6:]).max(axis=0) > 1e-9
        names = [dof.name for dof in solution.body.dofs]
        free = [name for name, moves in zip(names, moving, strict=True) if moves]
        pose = {n: float(hinges[0, i]) for i, n in enumerate(names) if not moving[i]}
        self.model = ReducedPlant(solution.body, free, pose, watched=held_limits)
        reduced = reduce_tree(load_tree(solution.body), free, pose)
        self.q_ref, self.v_ref, self.a_ref = from_full_state(
            reduced, solution.qpos[keep], solution.qvel[keep], solution.qacc[keep]
        )
        index = [names.index(name) for name in self.model.names[self.model.num_root :]]
        self.u_ref = solution.torque[keep][:, index]
        self.f_ref = solution.contact_force[keep]
        self.times = solution.times[keep]
        self.K = len(self.times)
        self.weight = self.model.mass * GRAVITY
        self.share = self.bounds.torque_share
        self._build()

    def _build(self) -> None:
        model, K, n = self.model, self.K, self.model.n
        prog = self.program = MathematicalProgram()
        self.q = prog.NewContinuousVariables(K, n, "q")
        self.v = prog.NewContinuousVariables(K, n, "v")  # / RATE_SCALE
        self.a = prog.NewContinuousVariables(K, n, "a")  # / ACCELERATION_SCALE
        self.u = prog.NewContinuousVariables(K, n - model.num_root, "u")  # / effort
        self.f = [
            prog.NewContinuousVariables(len(points), 3, f"f{k}")  # / (weight / 4)
            for k, points in enumerate(self.stance.active)
        ]
        self._add_bounds()
        self._add_dynamics()
        self._add_stance()
        self._add_intervals()

    def _add_bounds(self) -> None:
        """The two end states, torque and acceleration limits, friction, pose boxes."""
        prog, K = self.program, self.K
        for k in (0, K - 1):
            rate, acceleration = self.v_ref[k] / RATE_SCALE, self.a_ref[k] / ACCELERATION_SCALE
            prog.AddBoundingBoxConstraint(self.q_ref[k], self.q_ref[k], self.q[k])
            prog.AddBoundingBoxConstraint(rate, rate, self.v[k])
            prog.AddBoundingBoxConstraint(acceleration, acceleration, self.a[k])
        positions, rates = (
            self._box(self.bounds.position),
            self._box(self.bounds.rate, self.bounds.hinge_rate),
        )
        for k in range(1, K - 1):
            prog.AddBoundingBoxConstraint(*positions, self.q[k])
            prog.AddBoundingBoxConstraint(*(rate / RATE_SCALE for rate in rates), self.v[k])
        limit = self.bounds.acceleration / ACCELERATION_SCALE
        prog.AddBoundingBoxConstraint(-limit, limit, self.a[1:-1].ravel())
        prog.AddBoundingBoxConstraint(-1.0, 1.0, self.u.ravel())
        mx, my = self.bounds.friction_x, self.bounds.friction_y
        cone = np.array([[1, 0, -mx], [-1, 0, -mx], [0, 1, -my], [0, -1, -my]])
        for forces in self.f:
            for force in forces:
                prog.AddBoundingBoxConstraint(0.0, 24.0, force[2])
                prog.AddLinearConstraint(cone, np.full(4, -np.inf), np.zeros(4), force)

    def _box(self, table: Mapping[str, tuple[float, float]], default: float = 50.0):
        """Lower and upper bounds of the coordinates by name."""
        rows = [table.get(name, (-default, default)) for name in self.model.names]
        return np.array(rows).T

    def _add_dynamics(self) -> None:
        """Root wrench zero, joint torque = u - kd rate, holding torques within their limits.

        At every knot, by Drake AutoDiff; holding torques only where a foot pushes.
        """
        model, n = self.model, self.model.n
        effort, hold = model.effort * self.share, model.watched_effort * self.share
        root = np.array([1.0 if s in "xyz" else 0.5 for s in model.names[: model.num_root]])
        for k, points in enumerate(self.stance.active):
            where = [self.solution.contact_points[i] for i in points]

            def rows(x: np.ndarray, where=where) -> np.ndarray:
                q, v = x[:n], RATE_SCALE * x[n : 2 * n]
                a, u = ACCELERATION_SCALE * x[2 * n : 3 * n], x[3 * n : 4 * n - model.num_root]
                f = (self.weight / 4) * x[4 * n - model.num_root :].reshape(-1, 3)
                forces = [(*place, f[i]) for i, place in enumerate(where)]
                tau = model.inverse_dynamics(q, v, a, forces)
                joint = tau[model.num_root : n] + model.damping * v[model.num_root :]
                wrench = tau[: model.num_root] / (root * self.weight)
                return np.concatenate([wrench, joint / effort - u, tau[n:] / hold])

            variables = [self.q[k], self.v[k], self.a[k], self.u[k], self.f[k].ravel()]
            slack = np.zeros(n + len(hold))
            slack[n:] = 1.0 if points else 1e3
            self.program.AddConstraint(rows, -slack, slack, np.concatenate(variables))

    def _add_stance(self) -> None:
        """The toe link of a pushing foot does not move; a swinging sole stays above ground."""
        model, n = self.model, self.model.n
        solution, stance = self.solution, self.stance
        pushing = {solution.contact_points[i][0] for points in stance.active for i in points}
        for k in range(1, self.K - 1):
            x = np.concatenate([self.q[k], self.v[k]])
            # A side stands at a knot if it pushes in a phase on either side of that knot.
            phases = [p for p in solution.phases if p[1] <= stance.first + k <= p[2]]
            touching = {solution.contact_points[i][0] for *_, points in phases for i in points}
            standing = {link[0] for link in touching}
            for side in sorted(standing):

                def still(x: np.ndarray, link: str = f"{side}_Toe") -> np.ndarray:
                    V = model.link_velocity(x[:n], RATE_SCALE * x[n:], link)
                    return np.concatenate([V[:3] / 5.0, V[3:] / 0.5])

                self._equal(still, 6, x)
                toe = f"{side}_Toe_y"
                if f"{side}_Ankle" in touching and toe in model.names:  # a flat foot is rigid
                    self.program.AddBoundingBoxConstraint(0, 0, self.v[k, model.names.index(toe)])
            for side in sorted({"L", "R"} - standing):
                self._add_clearance(k, sole_points(model.body, side), 0.01)
            for side in sorted(standing):
                if f"{side}_Ankle" not in pushing:  # it stands on its toes all the time
                    self._add_clearance(k, sole_points(model.body, side)[:2], 0.0)

    def _add_clearance(
        self, k: int, points: Sequence[tuple[str, tuple[float, float, float]]], margin: float
    ) -> None:
        """Points of a foot stay ``margin`` (m) above the ground, or where they are below that."""
        model = self.model
        floor = np.minimum(model.heights(self.q_ref[k], points), margin)

        def height(q: np.ndarray) -> np.ndarray:
            return model.heights(q, points) / 0.1

        self.program.AddConstraint(height, floor / 0.1, np.full(len(points), 50.0), self.q[k])

    def _add_intervals(self) -> None:
        """Linear acceleration between knots (linear rows, as the timing is given), and the cost."""
        prog, w = self.program, self.weights
        n, h = self.model.n, np.diff(self.times)
        one = np.eye(n)
        sv, sa = RATE_SCALE, ACCELERATION_SCALE
        for k, step in enumerate(h):
            A = np.block([[-one * sv, one * sv, -step / 2 * sa * one, -step / 2 * sa * one]]) / 0.5
            x = np.concatenate([self.v[k], self.v[k + 1], self.a[k], self.a[k + 1]])
            prog.AddLinearEqualityConstraint(A, np.zeros(n), x)
            A = np.block(
                [
                    [
                        -one,
                        one,
                        -step * sv * one,
                        -(step**2) / 3 * sa * one,
                        -(step**2) / 6 * sa * one,
                    ]
                ]
            )
            x = np.concatenate([self.q[k], self.q[k + 1], self.v[k], self.a[k], self.a[k + 1]])
            prog.AddLinearEqualityConstraint(A / 0.1, np.zeros(n), x)
        width = np.zeros(self.K)
        width[:-1] += h / 2
        width[1:] += h / 2
        m = self.model.num_root
        for k in range(self.K):
            self._square(w.effort * width[k], self.u[k])
            self._square(w.acceleration * width[k], self.a[k, m:])
        for k, step in enumerate(h):
            self._square(w.torque_rate / step, self.u[k + 1], self.u[k])
            self._square(w.acceleration_rate / step, self.a[k + 1, m:], self.a[k, m:])
            self._force_rate(k, w.force_rate / step / 16.0)

    def _square(self, weight: float, x: np.ndarray, y: np.ndarray | None = None) -> None:
        """Adds weight |x|^2 or weight |x - y|^2."""
        A = np.eye(len(x)) * np.sqrt(weight)
        variables = x
        if y is not None:
            A, variables = np.hstack([A, -A]), np.concatenate([x, y])
        self.program.Add2NormSquaredCost(A, np.zeros(len(x)), variables)

    def _force_rate(self, k: int, weight: float) -> None:
        now = dict(zip(self.stance.active[k], self.f[k], strict=True))
        then = dict(zip(self.stance.active[k + 1], self.f[k + 1], strict=True))
        for point in now.keys() | then.keys():
            pair = [f[point] for f in (now, then) if point in f]
            self._square(weight, *pair)

    def _equal(self, rows: Callable, count: int, variables: np.ndarray) -> None:
        self.program.AddConstraint(rows, np.zeros(count), np.zeros(count), variables)

    # ---- points ---------------------------------------------------------------------------

    def point(self, q, v, a, u, f) -> np.ndarray:
        """A decision vector from physical arrays; ``f`` is (K, C, 3) over all contact points."""
        x = np.zeros(self.program.num_vars())

        def put(variables: np.ndarray, values: np.ndarray) -> None:
            x[self.program.FindDecisionVariableIndices(variables.ravel())] = np.ravel(values)

        put(self.q, q)
        put(self.v, np.asarray(v) / RATE_SCALE)
        put(self.a, np.asarray(a) / ACCELERATION_SCALE)
        put(self.u, np.asarray(u) / (self.model.effort * self.share))
        for k, points in enumerate(self.stance.active):
            if points:
                put(self.f[k], f[k][list(points)] / (self.weight / 4))
        return x

    def reference_point(self) -> np.ndarray:
        """The optimised motion."""
        return self.point(self.q_ref, self.v_ref, self.a_ref, self.u_ref, self.f_ref)

    def cold_point(self) -> np.ndarray:
        """Cubics between the two end states, no torque, weight shared by the pushing points."""
        t, T = self.times - self.times[0], self.times[-1] - self.times[0]
        s = (t / T)[:, None]
        q0, q1, v0, v1 = self.q_ref[0], self.q_ref[-1], self.v_ref[0] * T, self.v_ref[-1] * T
        c2, c3 = 3 * (q1 - q0) - 2 * v0 - v1, 2 * (q0 - q1) + v0 + v1
        q = q0 + s * (v0 + s * (c2 + s * c3))
        v = (v0 + s * (2 * c2 + 3 * s * c3)) / T
        a = (2 * c2 + 6 * s * c3) / T**2
        f = np.zeros_like(self.f_ref)
        for k, points in enumerate(self.stance.active):
            for point in points:
                f[k, point, 2] = self.weight / len(points)
        return self.point(q, v, a, np.zeros_like(self.u_ref), f)

    def violation(self, x: np.ndarray) -> float:
        """Largest violation over all rows and bounds (scaled)."""
        worst = 0.0
        for binding in self.program.GetAllConstraints():
            y = self.program.EvalBinding(binding, x)
            lower, upper = binding.evaluator().lower_bound(), binding.evaluator().upper_bound()
            worst = np.maximum(worst, np.maximum(lower - y, y - upper).max(initial=0.0))
        return float(worst)

    def stationarity(self, x: np.ndarray, near: float = 1e-3) -> float:
        """Relative first-order residual |g - J' lam| / |g| at a point, by Drake's AutoDiff.

        g is the cost gradient over the variables that are not at a bound, J the rows that are
        active within ``near`` (equalities always; interior-point solutions keep a small
        distance), lam the multipliers of least squares. Zero at an optimum. Needs no solver
        (Nocedal and Wright, Numerical Optimization, section 12.3); the signs of the multipliers
        are left to SNOPT.
        """
        program = self.program
        g, at_bound = np.zeros(len(x)), np.zeros(len(x), dtype=bool)
        for binding in program.GetAllCosts():
            i = program.FindDecisionVariableIndices(binding.variables())
            _, gradient = _linearise(binding.evaluator(), x[i])
            np.add.at(g, i, gradient[0])
        rows = []
        for binding in program.GetAllConstraints():
            i = program.FindDecisionVariableIndices(binding.variables())
            evaluator = binding.evaluator()
            lower, upper = evaluator.lower_bound(), evaluator.upper_bound()
            if isinstance(evaluator, BoundingBoxConstraint):
                at_bound[i] |= np.minimum(x[i] - lower, upper - x[i]) < near
                continue
            y, jacobian = _linearise(evaluator, x[i])
            active = np.minimum(y - lower, upper - y) < near
            block = np.zeros((int(active.sum()), len(x)))
            block[:, i] = jacobian[active]
            rows.append(block)
        free = ~at_bound
        J = np.vstack(rows)[:, free]
        lam = np.linalg.lstsq(J.T, g[free], rcond=1e-10)[0]
        return float(np.linalg.norm(g[free] - J.T @ lam) / np.linalg.norm(g[free]))

    def cost(self, x: np.ndarray) -> float:
        """Cost of a point."""
        return float(sum(self.program.EvalBinding(b, x)[0] for b in self.program.GetAllCosts()))

    def effort(self, x: np.ndarray) -> float:
        """Integral of the squared torque over its limit (s), trapezoid over the knots."""
        u = x[self.program.FindDecisionVariableIndices(self.u.ravel())].reshape(self.u.shape)
        return float(np.trapezoid((u**2).sum(axis=1), self.times))

    def solve(self, start: np.ndarray, iterations: int = 200) -> tuple[np.ndarray, str, float]:
        """SNOPT from a start: (point, status, seconds). Never raises for lack of convergence."""
        options = SolverOptions()
        solver = SnoptSolver.id()
        options.SetOption(solver, "Major iterations limit", iterations)
        options.SetOption(solver, "Major feasibility tolerance", 1e-5)
        options.SetOption(solver, "Major optimality tolerance", 1e-5)
        options.SetOption(solver, "Superbasics limit", 3000)
        begin = time.perf_counter()
        result = SnoptSolver().Solve(self.program, start, options)
        elapsed = time.perf_counter() - begin
        status = f"{result.get_solution_result().name} (SNOPT {result.get_solver_details().info})"
        return result.GetSolution(), status, elapsed


def _linearise(evaluator: EvaluatorBase, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value and Jacobian of a cost or constraint; rows that are constant have no derivatives."""
    y = np.ravel(evaluator.Eval(InitializeAutoDiff(x).ravel()))
    jacobian = np.zeros((len(y), len(x)))
    for row, entry in zip(jacobian, y, strict=True):
        if entry.derivatives().size:
            row[:] = entry.derivatives()
    return ExtractValue(y).ravel(), jacobian
