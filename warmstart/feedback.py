"""A planned motion followed by feedback: a time-varying linear-quadratic regulator around it.

A step loses its balance slowly when its torques are played open loop. Here the servos get

    tau = tau_plan + kp (q_plan - q) - K(t) (x - x_plan),    x = (q, v) of root and free hinges,

at every time step of the replay, clipped to the torque limits by the servos themselves. K is the
same in every engine and follows from the plan alone, so nothing is tuned to one of them:

1. Along the plan the equations of motion generated from the Drake plant (:mod:`rigid_body`), with
   the servos' stiffness and damping in them, are differentiated exactly. A foot that the plan has
   on the ground feels a linear spring and damper up and down at each contact point, and a damper
   along the ground, where a foot that has crept away is not drawn back; a foot in the air nothing.
2. They are made discrete for inputs held over a time step (matrix exponential; Van Loan 1978, IEEE
   Trans. Automatic Control 23(3)).
3. The finite-horizon Riccati recursion (Anderson and Moore, Optimal Control: Linear Quadratic
   Methods, 1990, section 2.4) gives K. It pays for deviations (:class:`Sizes`): of the state, of
   contact forces, of the torque, and around the event, where they count most, of the point that
   strikes.

Angles of the root are (pitch, roll, yaw) as in :mod:`rigid_body`; hinges that the plan does not
move are left to their servos.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.linalg import expm

from sports.physics.base import GRAVITY
from warmstart.replay import REPLAY_RATE
from warmstart.rigid_body import ReducedModel, from_full_state, load_tree, reduce_tree
from warmstart.solution import Solution

STIFFNESS = 2e4
"""Of a contact point that carries, up and down (N/m)."""
DAMPING = (2000.0, 2000.0, 300.0)
"""Of a contact point in the world (N s/m)."""
MOVES = 1e-9
"""A hinge is free when the plan moves it by more (rad)."""


@dataclass(frozen=True)
class Sizes:
    """Deviations from the plan that cost one each, per second; at the event, once."""

    place: float = 0.02
    """Of the root (m)."""
    attitude: float = 0.04
    """Of each of its angles (rad)."""
    hinge: float = 0.1
    """(rad)"""
    velocity: float = 0.2
    """Of the root (m/s)."""
    spin: float = 0.4
    """Of its angles (rad/s)."""
    rate: float = 2.0
    """Of a hinge (rad/s)."""
    torque: float = 0.1
    """Over the torque limit."""
    force: float = 0.15
    """At a contact point, over body weight."""
    event_place: float = 0.004
    """Of the point that strikes (m)."""
    event_velocity: float = 0.5
    """(m/s)"""
    event_axis: float = 0.03
    """Of its axis (rad)."""
    event_share: float = 0.2
    """The event counts as so many seconds, ``event_around`` s to either side of its time."""
    event_around: float = 0.006
    last: float = 0.1
    """The last state counts as so many seconds."""


SIZES = Sizes()


@dataclass(frozen=True)
class Linear:
    """Dynamics of small deviations x = (q, v) from a plan at T moments, N = 2 n of them.

    Torques on the m free hinges are the input; C contact points.
    """

    A: np.ndarray
    """(T, N, N) dx/dt = A x + B u."""
    B: np.ndarray
    """(T, N, m)"""
    force: np.ndarray
    """(T, 3 C, N) contact forces by x (N), world."""
    strike: np.ndarray
    """(T, 9, N) place (m), velocity (m/s) and axis of the event's point by x; (T, 0, N) of a plan
    without an event."""


@dataclass(frozen=True)
class Feedback:
    """Gains and reference of one plan, step by step at ``REPLAY_RATE``."""

    model: ReducedModel
    q: np.ndarray
    """(T + 1, n) planned coordinates at the beginning of each step, and at the end."""
    v: np.ndarray
    """(T + 1, n)"""
    gain: np.ndarray
    """(T, m, 2 n) K: torque (N m) by deviation (m, rad, m/s, rad/s)."""

    def torque(self, step: int, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """(num_dofs,) what the servos are asked for beyond the plan (N m) in a state
        (7 + num_dofs,), (6 + num_dofs,); zero after the last step."""
        out = np.zeros(self.model.tree.num_dofs)
        if step < len(self.gain):
            q, v = reduced_state(self.model, qpos, qvel)
            off = np.concatenate([q - self.q[step], v - self.v[step]])
            off[3:6] = (off[3:6] + np.pi) % (2.0 * np.pi) - np.pi
            out[self.model.free_index] = -self.gain[step] @ off
        return out


def follow(solution: Solution, sizes: Sizes = SIZES, rate: float = REPLAY_RATE) -> Feedback:
    """The feedback of a solution. The same solution gives the same gains.

    Raises ValueError for a motion whose hands hold or let go of something: only the ground's
    contacts are modelled.
    """
    hands = [link for link, _ in solution.contact_points if not link.endswith(("Ankle", "Toe"))]
    if hands or "payload" in solution.stats:
        raise ValueError("feedback follows motions in which only feet touch something")
    model = moving(solution)
    times = np.arange(math.floor(solution.duration * rate) + 1) / rate
    linear = linearised(solution, model, times)
    state, torque = _costs(solution, model, linear, times, sizes)
    steps = [discretised(A, B, 1.0 / rate) for A, B in zip(linear.A[:-1], linear.B[:-1])]
    A, B = (np.array(x) for x in zip(*steps))
    state[:-1] = state[:-1] / rate + _at_event(solution, linear, times, sizes)
    gain = riccati(A, B, state[:-1], torque, state[-1] * sizes.last)
    q, v, _ = _reference(solution, model, times)
    return Feedback(model, q, v, gain)


def moving(solution: Solution) -> ReducedModel:
    """The athlete with the hinges free that the plan moves, the others held where it has them."""
    body, hinges = solution.body, solution.qpos[:, 7:]
    free = [d.name for d, way in zip(body.dofs, np.ptp(hinges, axis=0)) if way > MOVES]
    pose = {d.name: float(angle) for d, angle in zip(body.dofs, hinges[0]) if d.name not in free}
    return reduce_tree(load_tree(body), free, pose)


def reduced_state(
    model: ReducedModel, qpos: np.ndarray, qvel: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) coordinates and rates of one full state: :func:`rigid_body.from_full_state` for use in
    every time step. R_WB = Ry(pitch) Rx(roll) Rz(yaw)."""
    w, x, y, z = qpos[3:7] / np.linalg.norm(qpos[3:7])
    pitch = math.atan2(2 * (x * z + w * y), 1 - 2 * (x * x + y * y))
    roll = math.asin(min(max(-2 * (y * z - w * x), -1.0), 1.0))
    yaw = math.atan2(2 * (x * y + w * z), 1 - 2 * (x * x + z * z))
    cr, sr, cy, sy = math.cos(roll), math.sin(roll), math.cos(yaw), math.sin(yaw)
    wx, wy, wz = qvel[3:6]
    rates = (sy * wx + cy * wy) / cr, cy * wx - sy * wy
    angles = [*rates, wz + sr * rates[0]]
    q = np.concatenate([qpos[:3], (pitch, roll, yaw), qpos[7 + model.free_index]])
    return q, np.concatenate([qvel[:3], angles, qvel[6 + model.free_index]])


def _reference(
    solution: Solution, model: ReducedModel, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    motion = solution.sample(solution.times[0] + times)
    return from_full_state(model, motion["qpos"], motion["qvel"], motion["qacc"])


def linearised(solution: Solution, model: ReducedModel, times: np.ndarray) -> Linear:
    """The dynamics of small deviations from a solution at times (T,) s from its first knot.

    From r(q, v, a, f) = u - kp q, with the forces f of the contact points that carry there:
    a = -(dr/da)^-1 (dr/dq + kp + dr/df df/dq) q - ... + (dr/da)^-1 u.
    """
    body, n = solution.body, model.n
    q, v, a = _reference(solution, model, times)
    force = solution.sample(solution.times[0] + times)["contact_force"]
    derivatives = _derivatives(solution, model)
    kp, kd = (body.array(name)[model.free_index] for name in ("kp", "kd"))
    carries = np.repeat(loaded(solution, times), 3, axis=1).astype(float)
    spring = np.tile([0.0, 0.0, STIFFNESS], force.shape[1])
    damper = np.tile(DAMPING, force.shape[1])
    A, B = np.zeros((len(times), 2 * n, 2 * n)), np.zeros((len(times), 2 * n, n - 6))
    pushes, strikes = [], []
    A[:, :n, n:] = np.eye(n)
    for t in range(len(times)):
        out = [np.array(x) for x in derivatives(q[t], v[t], a[t], force[t].T)]
        r_q, r_v, r_a, r_f, p_q, pd_q, strike = out
        f_v = -(carries[t] * damper)[:, None] * p_q
        f_q = -carries[t][:, None] * (spring[:, None] * p_q + damper[:, None] * pd_q)
        r_q, r_v = r_q + r_f @ f_q, r_v + r_f @ f_v
        r_q[6:, 6:] += np.diag(kp)
        r_v[6:, 6:] += np.diag(kd)
        inverse = np.linalg.inv(r_a)
        A[t, n:, :n], A[t, n:, n:], B[t, n:] = -inverse @ r_q, -inverse @ r_v, inverse[:, 6:]
        pushes.append(np.hstack([f_q, f_v]))
        strikes.append(strike)
    return Linear(A, B, np.array(pushes), np.array(strikes))


def loaded(solution: Solution, times: np.ndarray) -> np.ndarray:
    """(T, C) contact points on the ground in the plan, at times (T,) s from its first knot; where
    two phases meet, those of the later one."""
    ends = solution.times[[last for _, _, last, _ in solution.phases]]
    at = solution.times[0] + np.asarray(times)
    phase = np.minimum(np.searchsorted(ends, at, side="right"), len(ends) - 1)
    points = len(solution.contact_points)
    table = np.array([np.isin(np.arange(points), active) for *_, active in solution.phases])
    return table[phase]


def _derivatives(solution: Solution, model: ReducedModel) -> ca.Function:
    """(q, v, a, f (3, C)) -> derivatives of the needed forces r (6 of the root, then free hinges)
    by q, v, a, f; of the points' places by q and velocities by q; and those of the event."""
    points = [(model.tree.link(link), p) for link, p in solution.contact_points]
    q, v, a = (ca.SX.sym(name, model.n) for name in "qva")
    f = ca.SX.sym("f", 3, len(points))
    motion = model.motion(q, v, a)
    forces = [(link, p, f[:, i]) for i, (link, p) in enumerate(points)]
    tau = model.inverse_dynamics(q, v, a, forces, motion)
    r = ca.vertcat(tau[:6], tau[(6 + model.free_index).tolist()])
    place = ca.vertcat(*(motion.point(*point) for point in points))
    speed = ca.vertcat(*(motion.point_velocity(*point) for point in points))
    event = solution.stats.get("event")
    done = ca.SX(0, 1)
    if event is not None:
        link = model.tree.link(event["link"])
        done = ca.vertcat(
            motion.point(link, event["point"]),
            motion.point_velocity(link, event["point"]),
            motion.R_WL[link] @ ca.DM(list(event["axis"])),
        )
    of = [(r, q), (r, v), (r, a), (r, ca.vec(f)), (place, q), (speed, q), (done, ca.vertcat(q, v))]
    return ca.Function("derivatives", [q, v, a, f], [ca.densify(ca.jacobian(*x)) for x in of])


def discretised(A: np.ndarray, B: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """(N, N), (N, m) of x[k+1] = A x[k] + B u[k] for inputs held over ``dt`` (s), from those of
    dx/dt = A x + B u (Van Loan 1978)."""
    size, inputs = B.shape
    both = np.zeros((size + inputs, size + inputs))
    both[:size, :size], both[:size, size:] = A, B
    step = expm(both * dt)
    return step[:size, :size], step[:size, size:]


def riccati(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, last: np.ndarray
) -> np.ndarray:
    """(T, m, N) gains K of u = -K x that minimise sum x'Q x + u'R u, and x'(last) x at the end.

    A (T, N, N), B (T, N, m) of x[k+1] = A x + B u, Q (T, N, N), R (m, m), last (N, N). Raises
    numpy.linalg.LinAlgError where R + B'PB is singular.
    """
    gain, P = np.zeros((len(A), B.shape[2], B.shape[1])), last
    for k in range(len(A) - 1, -1, -1):
        forward = B[k].T @ P
        gain[k] = np.linalg.solve(R + forward @ B[k], forward @ A[k])
        P = Q[k] + A[k].T @ P @ (A[k] - B[k] @ gain[k])
        P = 0.5 * (P + P.T)
    return gain


def _costs(
    solution: Solution, model: ReducedModel, linear: Linear, times: np.ndarray, sizes: Sizes
) -> tuple[np.ndarray, np.ndarray]:
    """(T, N, N) price per second of a squared state, (m, m) of a squared torque over a step."""
    m, dt = len(model.free), float(times[1] - times[0])
    unit = np.repeat(
        [sizes.place, sizes.attitude, sizes.hinge, sizes.velocity, sizes.spin, sizes.rate],
        [3, 3, m, 3, 3, m],
    )
    weight = model.tree.total_mass * GRAVITY
    pushes = linear.force / (sizes.force * weight)
    state = np.diag(unit**-2.0) + np.swapaxes(pushes, 1, 2) @ pushes
    effort = solution.body.array("effort")[model.free_index]
    return state, np.diag((sizes.torque * effort) ** -2.0) * dt


def _at_event(solution: Solution, linear: Linear, times: np.ndarray, sizes: Sizes) -> np.ndarray:
    """(T - 1, N, N) price of the state at the event, where there is one, at each step."""
    event, out = solution.stats.get("event"), np.zeros_like(linear.A[:-1])
    if event is None:
        return out
    near = np.flatnonzero(np.abs(times[:-1] - event["time"]) < sizes.event_around)
    unit = np.repeat([sizes.event_place, sizes.event_velocity, sizes.event_axis], 3)
    rows = linear.strike[near] / unit[:, None]
    out[near] = np.swapaxes(rows, 1, 2) @ rows * sizes.event_share / max(len(near), 1)
    return out
