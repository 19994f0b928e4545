"""Structured programs, solutions and the jump problems against independent computations."""

import casadi as ca
import mujoco
import numpy as np
import pytest

from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from warmstart.contact import outline, sole_points
from warmstart.nlp import Program, Result
from warmstart.problems import PROBLEMS, Infeasible, get_problem, high_jump, jumper, long_jump
from warmstart.solution import Solution


@pytest.fixture(scope="module")
def jump() -> Solution:
    """A coarse high jump over 0.9 m, solved from nothing."""
    calls = []
    config = high_jump.Config(bar_height=0.9, detail=0.5)
    solution = high_jump.solve(config, progress=lambda i, f: calls.append((i, f)))
    assert calls and all(np.isfinite(f) for _, f in calls)
    print(jumper.shown(solution))
    return solution


def test_block_derivatives_agree_with_one_big_graph():
    """Jacobian and Hessian scattered from blocks equal CasADi's own of the naive graph."""
    program = Program(parameters=1)
    x = program.variable((5, 2), -5, 5, [1.0, 3.0])
    h = program.variable((1,), 0.05, 0.5, 0.1)
    data = np.arange(4.0)[:, None]

    def build(a, b, h, p):
        rows = [
            ("defect", b[0] - a[0] - h * a[1] * b[1] * p[1], 0, 0),
            ("bend", a[0] ** 2 * b, -1, 9),
        ]
        return h[0] * ca.sin(a[1]) ** 2 * p[0], rows

    program.block("interval", [x[:-1], x[1:], np.repeat(h[None], 4, 0)], build, data)
    program.block("ends", [x[[0, -1]]], lambda e, p: (e[0] ** 2 * e[1], [("s", ca.exp(e), -9, 9)]))
    program.block("price", [x[:, 0][None]], lambda e, p: (3 * ca.sum1(e), []))
    solver = program.solver({"ipopt.max_iter": 0})

    y, p = ca.MX.sym("y", 11), ca.MX.sym("p", 1)
    X = y * ca.DM(program.scale)
    f, g = 3 * ca.sum1(X[0:10:2]), []
    for k in range(4):
        a, b = X[2 * k : 2 * k + 2], X[2 * k + 2 : 2 * k + 4]
        f += X[10] * ca.sin(a[1]) ** 2 * p
        g += [b[0] - a[0] - X[10] * a[1] * b[1] * k, a[0] ** 2 * b]
    for k in (0, 4):
        e = X[2 * k : 2 * k + 2]
        f += e[0] ** 2 * e[1]
        g.append(ca.exp(e))
    g = ca.vertcat(*g)
    lam_f, lam_g = ca.MX.sym("lf"), ca.MX.sym("lg", g.numel())
    hess = ca.triu(ca.hessian(lam_f * f + ca.dot(lam_g, g), y)[0])
    rng = np.random.default_rng(0)
    y0, lam = rng.normal(size=11), rng.normal(size=g.numel())
    naive = ca.Function(
        "naive", [y, p, lam_f, lam_g], [f, ca.gradient(f, y), g, ca.jacobian(g, y), hess]
    )
    f1, df1, g1, dg1, h1 = (np.array(v) for v in naive(y0, 2.0, 1.5, lam))
    f2, df2 = (np.array(v) for v in solver.get_function("nlp_grad_f")(y0, 2.0))
    g2, dg2 = (np.array(v) for v in solver.get_function("nlp_jac_g")(y0, 2.0))
    h2 = np.array(solver.get_function("nlp_hess_l")(y0, 2.0, 1.5, lam))
    for ours, theirs in ((f2, f1), (df2, df1), (g2, g1), (dg2, dg1), (h2, h1)):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


def test_the_jump_obeys_mujoco_at_every_knot(jump):
    """mj_inverse with the contact forces: no force on the root, torques as stored and allowed."""
    body, model = jump.body, build_model(jump.body)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)
    weight, effort = body.mass * 9.81, body.array("effort")
    worst_root = worst_torque = 0.0
    for k in range(len(jump.times)):
        data.qpos[:], data.qvel[:], data.qacc[:] = jump.qpos[k], jump.qvel[k], jump.qacc[k]
        mujoco.mj_inverse(model, data)  # passive damping included: servo torque
        tau = np.array(data.qfrc_inverse)
        for (link, point), force in zip(jump.contact_points, jump.contact_force[k], strict=True):
            i = 1 + body.link_index(link)
            jac = np.zeros((3, model.nv))
            p_W = data.xpos[i] + data.xmat[i].reshape(3, 3) @ np.array(point)
            mujoco.mj_jac(model, data, jac, None, p_W, i)
            tau -= jac.T @ force
        worst_root = max(worst_root, np.abs(tau[:6]).max() / weight)
        worst_torque = max(worst_torque, np.abs(tau[6:] - jump.torque[k]).max())
    free = [body.dof_index(name) for name in jumper.FREE]
    share = np.abs(jump.torque[:, free]).max(axis=0) / effort[free]
    print(
        f"root {worst_root:.1e} body weights, torque {worst_torque:.1e} N m, "
        f"share {share.max():.3f}"
    )
    assert jump.stats["max_violation"] < 1e-5
    assert worst_root < 1e-5
    assert worst_torque < 1e-6
    assert share.max() <= 0.9701


def test_the_jump_clears_the_bar_and_stands_on_its_foot(jump):
    """Every outline ball misses the bar; loaded sole points neither move nor leave the ground."""
    body, model = jump.body, build_model(jump.body)
    data = mujoco.MjData(model)
    balls, height = outline(body), jump.asked["bar_height"]
    gap, slip, sink = np.inf, 0.0, 0.0
    for k in range(len(jump.times)):
        data.qpos[:], data.qvel[:] = jump.qpos[k], jump.qvel[k]
        mujoco.mj_forward(model, data)
        for ball in balls:
            i = 1 + body.link_index(ball.link)
            p_W = data.xpos[i] + data.xmat[i].reshape(3, 3) @ np.array(ball.center)
            gap = min(gap, np.hypot(p_W[0] - 20, p_W[2] - height + 0.025) - ball.radius - 0.025)
        for (link, point), force in zip(jump.contact_points, jump.contact_force[k], strict=True):
            assert force[2] >= -1e-3
            assert np.hypot(*force[:2]) <= force[2] + 1e-3
            if force[2] > 1.0:
                i = 1 + body.link_index(link)
                p_W = data.xpos[i] + data.xmat[i].reshape(3, 3) @ np.array(point)
                jac = np.zeros((3, model.nv))
                mujoco.mj_jac(model, data, jac, None, p_W, i)
                slip = max(slip, np.abs(jac @ data.qvel).max())
                sink = max(sink, abs(p_W[2]))
    print(f"bar gap {gap:.4f} m, slip {slip:.1e} m/s, sole off the ground {sink:.1e} m")
    assert gap > 0.0
    assert slip < 1e-5
    assert sink < 2e-3
    assert jump.qpos[-1, 0] > 20.1
    air = jump.phases[-1]
    assert np.all(jump.contact_force[air[1] :] == 0.0)


def test_sample_is_the_derivative_of_itself(jump):
    """qvel is the rate of qpos and qacc the rate of qvel between knots; knots are met."""
    t = np.linspace(jump.times[0] + 1e-4, jump.times[-1] - 1e-4, 37)
    h = 1e-6
    before, now, after = (jump.sample(t + d) for d in (-h, 0.0, h))
    np.testing.assert_allclose(
        (after["qvel"] - before["qvel"]) / (2 * h), now["qacc"], rtol=1e-3, atol=2e-2
    )
    keep = np.r_[0:3, 7 : 7 + jump.body.num_dofs]
    rate = (after["qpos"] - before["qpos"])[:, keep] / (2 * h)
    np.testing.assert_allclose(rate, now["qvel"][:, np.r_[0:3, 6 : 6 + 69]], atol=1e-4)
    model = build_model(jump.body)
    for k in range(len(t)):
        step = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, step, 2 * h, before["qpos"][k], after["qpos"][k])
        np.testing.assert_allclose(step[3:6], now["qvel"][k, 3:6], atol=1e-3)
    knots = jump.sample(jump.times)
    np.testing.assert_allclose(knots["qpos"], jump.qpos, atol=1e-9)
    np.testing.assert_allclose(knots["qacc"][:, 6:], jump.qacc[:, 6:], atol=1e-2)


def test_solution_file_round_trip_and_bad_files(jump, tmp_path):
    path = tmp_path / "jump.npz"
    jump.save(path)
    again = Solution.load(path)
    assert again.phases == jump.phases and again.contact_points == jump.contact_points
    assert again.body == jump.body and again.asked == jump.asked
    np.testing.assert_array_equal(again.contact_force, jump.contact_force)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ValueError, match=r"jump\.npz is not a readable solution"):
        Solution.load(path)
    with pytest.raises(ValueError, match="no solution file"):
        Solution.load(tmp_path / "none.npz")
    with pytest.raises(ValueError, match="sample times"):
        jump.sample(np.array([jump.times[-1] + 1.0]))


def test_a_neighbour_is_a_start_point(jump):
    """A solution read back as a guess satisfies the program it came from."""
    program = high_jump.transcribe(high_jump.Config(bar_height=0.9, detail=0.5))
    x = program.guess_from(jump)
    again = program.solution("high_jump", {}, _result(x))
    np.testing.assert_allclose(again.qpos, jump.qpos, atol=1e-6)
    # Accelerations are differentiated from the samples: 2 % of the limits of the trunk in flight.
    np.testing.assert_allclose(again.torque, jump.torque, atol=5.0)
    wrong = long_jump.transcribe(long_jump.Config(detail=0.3))
    assert wrong.K != program.K and wrong.guess_from(jump).shape == (len(wrong.program.lower),)


def _result(x, violation=0.0, status="Solve_Succeeded", success=True):
    return Result(
        x, np.zeros(1), 0.0, violation, status, 3, 1.0, 1.0, success, (("dynamics.torque", 1.0),)
    )


def test_infeasible_names_the_limiting_joint():
    """The elastic program reports the joints whose torque limit was stretched."""
    program = high_jump.transcribe(high_jump.Config(detail=0.3), elastic=True)
    x = np.zeros(len(program.program.lower))
    x[program.slack[program.model.index("L_Knee_y") - 6]] = 0.5
    failed = _result(x, 0.1, "Infeasible_Problem_Detected", False)
    with pytest.raises(Infeasible, match=r"a bar at 2 m is infeasible.*L_Knee_y 150 %"):
        jumper.check(failed, "a bar at 2 m", lambda: (program, _result(x)))
    with pytest.raises(Infeasible, match=r"'dynamics\.torque' is not met"):
        jumper.check(failed, "a bar at 2 m", lambda: (program, failed))
    jumper.check(_result(x), "a bar at 2 m", lambda: pytest.fail("not asked"))


@pytest.mark.parametrize("stuck", [None, 1.25])
def test_a_high_bar_is_reached_from_lower_ones(jump, monkeypatch, stuck):
    """Each bar starts from the one below; a step that fails leaves the last one that did not."""
    bars: list[tuple[float, bool]] = []

    def run(program, start, parameters, neighbour, *rest) -> Result:
        height = round(parameters[0] - config.clearance, 6)
        bars.append((height, neighbour))
        return _result(start, violation=1.0 if height == stuck else 0.0)

    monkeypatch.setattr(jumper, "run", run)
    config = high_jump.Config(bar_height=1.33, detail=0.3)
    solution = high_jump.solve(config)
    below = [1.2, 1.25] if stuck else [1.2, 1.25, 1.3]
    assert bars == [(height, height > 1.2) for height in (*below, 1.33)]
    assert solution.asked == {"bar_height": 1.33}
    assert solution.stats["iterations"] == 3 * len(bars) and solution.stats["solve_s"] == len(bars)
    bars.clear()
    high_jump.solve(config, guess=jump)
    assert bars == [(1.33, True)]
    bars.clear()
    high_jump.solve(high_jump.Config(bar_height=1.2, detail=0.3))
    assert bars == [(1.2, False)]


@pytest.mark.slow
def test_a_bar_that_nobody_clears_is_infeasible_and_says_why():
    """Solved for real: neither the strength of a human nor four times it is found to do."""
    config = high_jump.Config(bar_height=2.2, detail=0.4, max_iterations=80)
    with pytest.raises(
        Infeasible, match=r"a bar at 2\.2 m.*'human'.*('.+' is not met| %)"
    ) as found:
        high_jump.solve(config)
    print(found.value)


def test_impossible_options_are_one_sentence():
    with pytest.raises(ValueError, match=r"bar_height must lie between 0\.3 and 2\.6 m, not 9"):
        high_jump.Config(bar_height=9.0)
    with pytest.raises(ValueError, match="length must lie between"):
        long_jump.Config(length=-1.0)
    with pytest.raises(ValueError, match="detail"):
        long_jump.Config(detail=99.0)
    with pytest.raises(ValueError, match="unknown problem 'shot_put'; known: high_jump, long_jump"):
        get_problem("shot_put")
    for problem in PROBLEMS.values():
        for value in problem.sweep:
            assert getattr(problem.config(**{problem.outcome: value}), problem.outcome) == value


@pytest.mark.parametrize("name", ["smpl", "smplx"])
def test_soles_are_flat_on_the_ground(name):
    """The six sole points of a foot are the lowest corners of the body at the zero pose."""
    body = load_body(name)
    origin = body.zero_pose_origins()
    lowest = -body.standing_height(0.0)
    for side in "LR":
        heights = [origin[body.link_index(link)][2] + p[2] for link, p in sole_points(body, side)]
        assert len(heights) == 6
        assert max(heights) - min(heights) < 2e-2
        assert min(heights) >= lowest - 1e-12
