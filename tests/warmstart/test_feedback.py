"""Feedback: gains by closed forms and other solvers, dynamics by MuJoCo, starts that come back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from warmstart import feedback, strike
from warmstart.certificate import CLOSED_LOOP, OPEN_LOOP, certify, required
from warmstart.inverse_dynamics import inverse_dynamics_mujoco
from warmstart.replay import FEEDBACK, replay_all, replay_states
from warmstart.rigid_body import from_full_state, to_full_state
from warmstart.solution import Solution

DATA = Path(__file__).parent / "data"
NUMBERS = np.random.default_rng(5)


@pytest.fixture(scope="module")
def kick() -> Solution:
    """A kick from a stand, planned without any thought of feedback."""
    solution = Solution.load(DATA / "penalty_kick_15_human.npz")
    return replace(solution, stats=solution.stats | {FEEDBACK: True})


@pytest.fixture(scope="module")
def follower(kick) -> feedback.Feedback:
    return feedback.follow(kick)


# The regulator.


def _system(size: int, inputs: int) -> tuple[np.ndarray, ...]:
    A, B = NUMBERS.normal(size=(size, size)) / np.sqrt(size), NUMBERS.normal(size=(size, inputs))
    root = NUMBERS.normal(size=(size, size))
    return A, B, root @ root.T + np.eye(size), np.diag(NUMBERS.uniform(0.5, 2.0, inputs))


def test_a_long_horizon_gives_scipys_infinite_one():
    A, B, Q, R = _system(7, 3)
    P = solve_discrete_are(A, B, Q, R)
    expected = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    As, Bs, Qs = (np.repeat(x[None], 300, axis=0) for x in (A, B, Q))
    found = feedback.riccati(As, Bs, Qs, R, np.zeros((7, 7)))
    np.testing.assert_allclose(found[0], expected, rtol=1e-9, atol=1e-12)


def test_a_short_horizon_gives_the_inputs_that_least_squares_find():
    """Of a system that changes from step to step: all inputs at once, as one quadratic program."""
    size, inputs, steps = 4, 2, 6
    systems = [_system(size, inputs) for _ in range(steps)]
    R, last, start = np.diag([0.7, 1.3]), 3.0 * np.eye(size), NUMBERS.normal(size=size)
    state, moved = start, np.zeros((size, inputs * steps))  # x[k] = state + moved @ inputs
    hessian, linear = np.kron(np.eye(steps), R), np.zeros(inputs * steps)
    for k, (A, B, Q, _) in enumerate(systems):
        hessian += moved.T @ Q @ moved
        linear += moved.T @ Q @ state
        moved, state = A @ moved, A @ state
        moved[:, inputs * k : inputs * (k + 1)] += B
    hessian += moved.T @ last @ moved
    linear += moved.T @ last @ state
    wanted = np.linalg.solve(hessian, -linear).reshape(steps, inputs)
    A, B, Q, _ = (np.array(x) for x in zip(*systems, strict=True))
    gain, state = feedback.riccati(A, B, Q, R, last), start
    for k in range(steps):
        u = -gain[k] @ state
        np.testing.assert_allclose(u, wanted[k], rtol=1e-8, atol=1e-10)
        state = A[k] @ state + B[k] @ u


def test_a_mass_on_a_line():
    """d^2x/dt^2 = u: x + dt v + dt^2/2 u exactly; for x^2 + u^2 the gains are 1 and sqrt(2)."""
    dt, steps = 1e-3, 20000
    A, B = feedback.discretised(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), dt)
    np.testing.assert_allclose(A, [[1.0, dt], [0.0, 1.0]], atol=1e-15)
    np.testing.assert_allclose(B, [[dt**2 / 2], [dt]], atol=1e-15)
    As, Bs, Qs = (np.repeat(x[None], steps, axis=0) for x in (A, B, np.diag([dt, 0.0])))
    gain = feedback.riccati(As, Bs, Qs, np.array([[dt]]), np.zeros((2, 2)))
    np.testing.assert_allclose(gain[0], [[1.0, np.sqrt(2.0)]], rtol=2e-3)


# The dynamics.


def test_the_state_is_that_of_the_optimiser(kick, follower):
    motion = kick.sample(NUMBERS.uniform(0.0, kick.duration, 20))
    q, v, _ = from_full_state(follower.model, motion["qpos"], motion["qvel"], motion["qacc"])
    for k in range(20):
        found = feedback.reduced_state(follower.model, motion["qpos"][k], -motion["qvel"][k])
        np.testing.assert_allclose(found[0][6:], q[k, 6:], atol=1e-12)
        apart = (found[0][:6] - q[k, :6] + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(apart, 0.0, atol=1e-10)
        np.testing.assert_allclose(found[1], -v[k], atol=1e-10)


@pytest.mark.parametrize("share", [0.2, 0.6, 0.9])
def test_small_deviations_obey_mujoco(kick, follower, share):
    """The state deviates by x, the servos by u: with the acceleration A x + B u and the forces of
    the ground that belong to x, MuJoCo's inverse dynamics asks for the servos' torques and for
    nothing at the root."""
    at, model = np.array([share * kick.duration]), follower.model
    linear, size = feedback.linearised(kick, model, at), 1e-5
    motion = kick.sample(at)
    q, v, a = from_full_state(model, *(motion[name] for name in ("qpos", "qvel", "qacc")))
    x, u = NUMBERS.normal(size=2 * model.n) * size, NUMBERS.normal(size=len(model.free)) * size
    rate = linear.A[0] @ x + linear.B[0] @ u
    np.testing.assert_allclose(rate[: model.n], x[model.n :], atol=1e-15)

    def needed(sign: float) -> np.ndarray:
        moved = (q + sign * x[: model.n], v + sign * x[model.n :], a + sign * rate[model.n :])
        full = dict(zip(("qpos", "qvel", "qacc"), to_full_state(model, *moved), strict=True))
        push = sign * (linear.force[0] @ x).reshape(motion["contact_force"].shape)
        return inverse_dynamics_mujoco(
            kick, full | {"contact_force": motion["contact_force"] + push}
        )[0]

    change = (needed(1.0) - needed(-1.0)) / 2.0
    kp = kick.body.array("kp")[model.free_index]
    wanted = u - kp * x[6 : model.n]
    scale = np.abs(wanted).max()
    np.testing.assert_allclose(change[:6] / scale, 0.0, atol=1e-4)
    np.testing.assert_allclose(change[6 + model.free_index] / scale, wanted / scale, atol=1e-4)


def test_feet_feel_the_ground_where_the_plan_has_them_on_it(kick):
    name, first, last, active = kick.phases[1]
    middle = kick.times[first : last + 1].mean()
    assert name == "swing"
    for time, points in ((middle, active), (0.0, kick.phases[0][3]), (kick.times[first], active)):
        loaded = feedback.loaded(kick, np.array([time]))
        assert tuple(np.flatnonzero(loaded[0])) == points
    linear = feedback.linearised(kick, feedback.moving(kick), np.array([middle]))
    pushed = np.abs(linear.force[0]).reshape(len(kick.contact_points), -1).max(1) > 0.0
    assert tuple(np.flatnonzero(pushed)) == active


# Replays.


def _miss(solution: Solution, engine: str, start=None) -> float:
    event = solution.stats["event"]
    played = replay_all(solution, engine, hold=0.1, start=start)
    return strike.moment(solution.body, event, played.times, played.qpos).miss


@pytest.mark.parametrize("engine", ["mujoco", "drake"])
def test_a_start_that_is_off_comes_back(kick, engine):
    """2 cm to the front, an ankle off by 0.02 rad, and the whole body at 0.1 m/s to one side."""
    qpos, qvel = kick.qpos[0].copy(), kick.qvel[0].copy()
    qpos[0] += 0.02
    qpos[7 + kick.body.dof_index("L_Ankle_y")] += 0.02
    qvel[1] += 0.1
    open_loop = replace(kick, stats=kick.stats | {FEEDBACK: False})
    assert _miss(kick, engine, (qpos, qvel)) < 0.01
    assert _miss(open_loop, engine, (qpos, qvel)) > 0.03
    assert _miss(kick, engine) < 0.005


def test_feedback_is_what_is_added_to_the_plan_and_ends_with_it(kick, follower):
    played = replay_all(kick, "mujoco", hold=0.1)
    bare = replay_all(replace(kick, stats=kick.stats | {FEEDBACK: False}), "mujoco", hold=0.1)
    steps, kp = len(follower.gain), kick.body.array("kp")
    assert not bare.feedback.any() and not played.feedback[steps:].any()
    np.testing.assert_allclose(played.ctrl - bare.ctrl, played.feedback / kp, atol=1e-12)
    k = steps // 2
    np.testing.assert_array_equal(
        played.feedback[k], follower.torque(k, played.qpos[k], played.qvel[k])
    )
    for found, again in zip(replay_states(kick, "mujoco", 0.1), (played.times, played.qpos)):
        np.testing.assert_array_equal(found, again)


def test_on_the_plan_there_is_nothing_to_add(kick, follower):
    motion = kick.sample(np.array([240 / 480.0]))
    torque = follower.torque(240, motion["qpos"][0], motion["qvel"][0])
    np.testing.assert_allclose(torque, 0.0, atol=1e-6)
    turned = motion["qpos"][0] * np.repeat([1.0, -1.0, 1.0], [3, 4, kick.body.num_dofs])
    np.testing.assert_allclose(follower.torque(240, turned, motion["qvel"][0]), torque, atol=1e-9)


def test_a_file_gives_the_same_gains(kick, follower, tmp_path: Path):
    kick.save(tmp_path / "kick.npz")
    again = feedback.follow(Solution.load(tmp_path / "kick.npz"))
    np.testing.assert_array_equal(again.gain, follower.gain)
    np.testing.assert_array_equal(again.q, follower.q)


# Where it is allowed.


def test_what_hands_hold_is_not_followed():
    for name in ("javelin_12_human", "free_throw_0.9_human"):
        with pytest.raises(ValueError, match="only feet touch"):
            feedback.follow(Solution.load(DATA / f"{name}.npz"))


@pytest.mark.parametrize("name", ["tennis_24_human", "high_jump_1.0_human"])
def test_the_gate_refuses_feedback_where_the_rules_ask_for_an_open_loop(name, monkeypatch):
    monkeypatch.setattr("warmstart.certificate._replay", lambda *_: {})
    motion = Solution.load(DATA / f"{name}.npz")
    found = certify(replace(motion, stats=motion.stats | {FEEDBACK: True}))
    assert not found.passed
    assert any("replay must be open loop" in f for f in found.failures)
    assert "replay must be open loop" not in required(motion.problem)
    assert certify(motion).stats["replay"] == OPEN_LOOP


def test_the_gate_takes_feedback_in_a_kick_and_asks_for_more(kick, monkeypatch):
    monkeypatch.setattr("warmstart.certificate._replay", lambda *_: {})
    assert certify(kick).stats["replay"] == CLOSED_LOOP
    more = set(required("penalty_kick", feedback=True)) - set(required("penalty_kick"))
    assert {"replay in drake: feedback torque", "replay in mujoco: step"} <= more
    assert set(required("penalty_kick")) < set(required("penalty_kick", feedback=True))
