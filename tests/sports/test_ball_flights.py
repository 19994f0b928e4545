"""Flights of the ball law: against closed forms, scipy and CasADi; landings, paths, launches."""

import math
from typing import Any

import casadi as ca
import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from sports import ball
from sports.ball_law import flight
from tests.sports.courts import Law, court

STEPS = (1 / 60, 1 / 120, 1 / 240, 1 / 480)


def reference(law, pos, linvel, angvel, height):
    """Where and when a ball falls through a height, by an integrator with a tolerance of 1e-9."""
    numbers = ball.BALLS[law].numbers()

    def rate(_, y):
        return [*y[3:], *flight.acceleration(tuple(y[3:]), tuple(angvel), numbers)]

    def above(_, y):
        return y[2] - height

    above.terminal, above.direction = True, -1
    start = [*pos, *linvel]
    found = solve_ivp(
        rate, (0, 10), start, method="DOP853", rtol=1e-9, atol=1e-9, events=above, max_step=0.02
    )
    return found.y_events[0][0][:3], found.t_events[0][0]


def reference_at(law, pos, linvel, x):
    """State of a ball without spin where it passes a plane across the x axis."""
    numbers = ball.BALLS[law].numbers()

    def rate(_, y):
        return [*y[3:], *flight.acceleration(tuple(y[3:]), (0.0, 0.0, 0.0), numbers)]

    def across(_, y):
        return y[0] - x

    across.terminal = True
    start = [*pos.tolist(), *linvel.tolist()]
    found = solve_ivp(
        rate, (0, 5), start, method="DOP853", rtol=1e-9, atol=1e-9, events=across, max_step=0.05
    )
    return found.y_events[0][0][:3], found.t_events[0][0]


@pytest.mark.parametrize("law", ball.BALLS)
def test_acceleration_is_drag_and_lift_of_the_table(law):
    """Closed forms: terminal velocity, the lift of a spinning ball, gravity alone in a vacuum."""
    own = ball.BALLS[law]
    numbers, area = own.numbers(), math.pi * own.radius**2
    still = (0.0, 0.0, 0.0)
    for speed, drag in ((5.0, own.drag[0]), (40.0, own.drag[1]), (19.5, sum(own.drag) / 2)):
        a = flight.acceleration((speed, 0.0, 0.0), still, numbers)
        force = -0.5 * ball.AIR_DENSITY * area * drag * speed**2
        assert a[0] == pytest.approx(force / own.mass, rel=1e-9) and a[1] == 0.0
        assert a[2] == pytest.approx(-9.81)
        whirl = 300.0
        lifted = flight.acceleration((speed, 0.0, 0.0), (0.0, -whirl, 0.0), numbers)  # backspin
        lift = 1 / (2 + speed / (own.radius * whirl))
        force = 0.5 * ball.AIR_DENSITY * area * lift * speed**2
        assert lifted[2] - a[2] == pytest.approx(force / own.mass, rel=1e-6)


@pytest.mark.parametrize("law", ball.BALLS)
def test_landings_are_those_of_a_reference_integration(law):
    """``landing`` and the impact that the substeps find, at every engine step, within 1 cm."""
    rng = np.random.default_rng(1)
    n = 6
    pos = np.array([0.0, 0.0, 1.2]) + rng.uniform(-0.3, 0.3, (n, 3))
    linvel = np.array([25.0, 0.0, 5.0]) + rng.normal(size=(n, 3)) * (8.0, 3.0, 3.0)
    angvel = rng.normal(size=(n, 3)) * 150.0
    radius = ball.BALLS[law].radius
    expected = [reference(law, *row, radius) for row in zip(pos, linvel, angvel)]
    where, when = (np.array(x) for x in zip(*expected))
    tensors = (torch.tensor(x, dtype=torch.float32) for x in (pos, linvel, angvel))
    got, time = ball.landing(law, *tensors, height=radius)
    off = np.abs(got.numpy() - where).max()
    print(f"{law}: landing() is {off:.1e} m from the reference")
    assert off < 2e-3 and np.abs(time.numpy() - when).max() < 2e-4
    for dt in STEPS:
        alone = Law(court(law), n)
        alone.pos[:], alone.linvel[:], alone.angvel[:] = pos, linvel, angvel
        while (alone.game.hits == 0).any():
            alone.step(dt)
        off = np.abs(alone.game.hit_pos[:, 0] - where).max()
        print(f"{law} at 1/{1 / dt:.0f} s: {off:.1e} m from the reference")
        assert off < 1e-2
        assert np.abs(alone.game.hit_time[:, 0] - when).max() < 1e-3


def test_smooth_parts_take_casadi_expressions():
    """Acceleration, a step of flight and a bounce: CasADi against numba, sliding and sticking."""
    numbers = ball.BALLS["golf"].numbers()
    compiled = Law(court("golf"), 1).law
    v, w = ca.SX.sym("v", 3), ca.SX.sym("w", 3)
    vs, ws = (v[0], v[1], v[2]), (w[0], w[1], w[2])
    up, still = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
    symbols = {
        "acceleration": flight.acceleration(vs, ws, numbers),
        "fly": sum(flight.fly(still, vs, ws, 0.1, numbers), ()),
        "bounce": sum(flight.bounce(vs, ws, up, 0.45, 0.4, numbers), ()),
    }
    functions = {k: ca.Function(k, [v, w], [ca.vertcat(*x)]) for k, x in symbols.items()}
    slopes = {k: ca.Function(k, [v, w], [ca.jacobian(f(v, w), v)]) for k, f in functions.items()}
    rng = np.random.default_rng(4)
    cases = rng.normal(size=(20, 2, 3)) * ((10.0, 10.0, 10.0), (100.0, 100.0, 100.0))
    for a, b in [*cases, np.zeros((2, 3)), np.array(((0.1, 0.0, -9.0), still))]:
        a[2] = -abs(a[2])
        av, bv = tuple(map(float, a)), tuple(map(float, b))
        expected = {
            "acceleration": compiled.acceleration(av, bv, numbers),
            "fly": sum(compiled.fly(still, av, bv, 0.1, numbers), ()),
            "bounce": sum(compiled.bounce(av, bv, up, 0.45, 0.4, numbers), ()),
        }
        for name, function in functions.items():
            got = np.array(function(a, b))[:, 0]
            np.testing.assert_allclose(got, expected[name], rtol=1e-9, atol=1e-9)
            assert np.isfinite(np.array(slopes[name](a, b))).all(), name


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_launches_meet_their_target_and_clear_the_net(way):
    """Tennis and table tennis serves of sports.md; with drag, both ways along x."""
    generator = torch.Generator().manual_seed(3)
    n = 64
    cases = {
        "tennis": (12.5, 6.0, 1.2, (18.0, 25.0), (6.0, 11.0), 3.0, 1.0 + 0.25, 4.0, 0.0),
        "table_tennis": (1.37, 1.4, 1.5, (3.5, 5.0), (0.35, 1.2), 0.6, 0.9125 + 0.05, 9.0, 0.76),
    }
    for law, (x, wide, z, speeds, far, side, net, apex, floor) in cases.items():
        r = ball.BALLS[law].radius
        u = torch.rand(4, n, generator=generator)
        pos = torch.stack((torch.full((n,), -x), wide * (u[0] - 0.5), torch.full((n,), z)), -1)
        speed = speeds[0] + (speeds[1] - speeds[0]) * u[1]
        height = torch.full((n,), floor + r)
        target = (far[0] + (far[1] - far[0]) * u[2], side * (2 * u[3] - 1), height)
        target = torch.stack(target, -1)
        for v in (pos, target):
            v[:, 0] *= way
        linvel = ball.launch(law, pos, way * speed, target, net=(0.0, net + r), apex=apex)
        still = torch.zeros_like(linvel)
        landed, time = ball.landing(law, pos, linvel, still, height=floor + r)
        assert (landed - target).norm(dim=-1).max() < 2e-3
        assert (linvel[:, 0] * way <= speed * (1 + 1e-6)).all()
        for k in range(n):
            at, _ = reference_at(law, pos[k], linvel[k], 0.0)
            assert at[2] > net + r - 1e-4
        moments = [0.02 * k for k in range(150)]
        flown = ball.path(law, pos, linvel, still, moments)
        there = torch.tensor(moments) < time[:, None]
        assert flown[..., 2].masked_fill(~there, 0.0).max() < apex
        slower = (linvel[:, 0] * way < speed * 0.99).float().mean()
        print(f"{law}: {slower:.0%} of the launches had to be slower than asked")


def test_launches_are_made_only_where_they_are_wanted():
    pos, target = torch.tensor([[-12.5, 0.0, 1.2]] * 3), torch.tensor([[8.0, 1.0, 0.032]] * 3)
    speed, mask = torch.full((3,), 20.0), torch.tensor([True, False, True])
    linvel = ball.launch("tennis", pos, speed, target, mask=mask)
    assert (linvel[1] == 0).all() and (linvel[0] == linvel[2]).all() and linvel[0, 0] == 20.0


def test_launches_are_slower_for_a_high_net_and_faster_under_a_ceiling():
    pos, target = torch.tensor([[-10.0, 0.0, 1.0]]), torch.tensor([[8.0, 1.0, 0.032]])
    speeds = {}
    cases: dict[str, dict[str, Any]] = {
        "free": {},
        "high net": {"net": (0.0, 2.8)},
        "ceiling": {"apex": 1.6},
        "both, in vain": {"net": (0.0, 2.8), "apex": 1.6},
    }
    for name, bounds in cases.items():
        linvel = ball.launch("tennis", pos, torch.tensor([20.0]), target, **bounds)
        landed, _ = ball.landing("tennis", pos, linvel, torch.zeros(1, 3), height=0.032)
        assert (landed - target).norm() < 2e-3
        speeds[name] = float(linvel[0, 0])
    high, low = speeds["high net"], speeds["ceiling"]
    assert speeds["free"] == 20.0 and low > 20.0
    steps = math.log(high / 20.0) / math.log(0.97)
    assert steps > 1 and steps == pytest.approx(round(steps), abs=1e-4)
    assert speeds["both, in vain"] == high
    for speed, clears in ((high, True), (high / 0.97, False)):
        v = torch.tensor([[speed, speed / 18.0, 0.0]])
        v[0, 2] = ball.launch("tennis", pos, torch.tensor([speed]), target)[0, 2]
        assert (reference_at("tennis", pos[0], v[0], 0.0)[0][2] >= 2.8) == clears


def test_paths_bounce_where_the_ball_does():
    """``path`` with a ground against the law's own substeps, over several bounces."""
    n = 5
    rng = np.random.default_rng(6)
    alone = Law(court("tennis"), n)
    alone.pos[:] = rng.normal(size=(n, 3)) * 0.2 + (0.0, 0.0, 1.5)
    alone.linvel[:] = rng.normal(size=(n, 3)) * (8.0, 3.0, 2.0)
    alone.angvel[:] = rng.normal(size=(n, 3)) * 100.0
    start = np.stack((alone.pos, alone.linvel, alone.angvel))
    pos, linvel, angvel = torch.tensor(start, dtype=torch.float32)
    moments = [0.1 * k for k in range(1, 16)]
    flown = ball.path("tennis", pos, linvel, angvel, moments, ground=0.0).numpy()
    for k in range(len(moments)):
        for _ in range(24):
            alone.step(1 / 240)
        assert np.abs(alone.pos - flown[:, k]).max() < 5e-3
    assert (alone.game.hits[:, 0] >= 1).all() and alone.game.hits.sum() >= 8


def test_a_landing_that_is_not_is_never():
    where, when = ball.landing(
        "tennis",
        torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 0.5]]),
        torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]),
        torch.zeros(2, 3),
        height=torch.tensor([0.2, 0.8]),
        limit=1.0,
    )
    assert torch.isfinite(when).tolist() == [True, False]
    assert where[0, 2] == pytest.approx(0.2, abs=1e-5) and where[1, 2] < 0.5
