"""Table tennis on states made by hand, with known answers; launches against another integration."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from sports import rackets, table_tennis
from sports.humanoid.mjcf import build_model
from tests.sports.rackets_made import HandMadeRally, flights, launched, made, where_through

STANDING = 0.9412
PADDLE = (
    # From the root at the zero pose: offsets of the right arm's links, and the paddle's 0.12 m.
    -0.0267 + 0.0011 + 0.0254 - 0.0386 - 0.0091 - 0.0214 - 0.0056,
    -0.0025 + 0.0055 + 0.0015 - 0.0818 - 0.0960 - 0.2537 - 0.2553 - 0.12,
    0.1090 + 0.1352 + 0.0529 + 0.1188 + 0.0326 - 0.0133 + 0.0078,
)
STROKE = (1.3, 0.3, 1.0)
HIT_FROM = (1.25, 0.3, 1.05)


def rally(bounced: bool = True, num_worlds: int = 1, **options) -> HandMadeRally:
    """A ball on its way to a standing athlete, by default after its bounce on the near half."""
    world = made("table_tennis", num_worlds, **options)
    world.put_ball((-0.5, 0.0, 1.2), (4.0, 0.0, 0.0))
    world.start()
    if bounced:
        world.touch("table", (0.8, 0.2, 0.78))
        assert not world.go((0.9, 0.2, 0.9), (3.5, 0.0, 1.5)).terminated.any()
    return world


def aimed(x: float, y: float) -> tuple[float, float, float]:
    """Velocity that carries a ball from ``HIT_FROM`` to a place on the table's plane: read off a
    fan of shots that differ in their slopes."""
    up = np.linspace(-1.0, 4.0, 300)
    way = HIT_FROM[0] - x
    fan = np.stack((0 * up - 5.0, 0 * up + 5.0 * (y - HIT_FROM[1]) / way, up), 1)
    spots = where_through(flights("table_tennis", 0 * fan + HIT_FROM, fan), 2, 0.78)[:, 0]
    return float(fan[0, 0]), float(fan[0, 1]), float(np.interp(-x, -spots, up))


def stroke(world: HandMadeRally, linvel=None, pos=HIT_FROM):
    world.touch("racket0", STROKE)
    return world.go(pos, linvel or aimed(-0.8, 0.0))


def far(step) -> bool:
    return bool(step.terminated[0, 0])


def play_return(world: HandMadeRally, spot=(-0.8, 0.0)):
    """Stroke and bounce on the far half."""
    stroke(world)
    world.touch("table", (*spot, 0.78))
    return world.go((spot[0] - 0.1, spot[1], 0.9), (-3.0, 0.0, 1.5))


# Rewards.


def test_before_contact_the_paddle_is_led_to_the_ball():
    world = rally()
    paddle = np.array((2.0 - PADDLE[0], -PADDLE[1], STANDING + PADDLE[2]))  # faces -x
    for offset in ((0.3, 0.0, 0.0), (-0.2, 0.4, -0.3)):
        step = world.go(tuple(paddle + offset))
        expected = math.exp(-4.0 * sum(x * x for x in offset))
        assert step.terms["approach"][0, 0] == pytest.approx(expected, abs=5e-4)
        assert step.terms["landing"][0, 0] == 0.0


def test_following_the_ball_may_earn_nothing():
    """Without ``shadow`` only what is nearer than ever to this ball is paid: the sum is the best
    of the way, whatever the way; the next ball pays anew."""
    world = rally(shadow=False)
    paddle = tuple(a + b for a, b in zip((2.0, 0.0, STANDING), (-PADDLE[0], -PADDLE[1], PADDLE[2])))
    paid = []
    for d in (0.5, 0.3, 0.4, 0.3, 0.2):
        step = world.go((paddle[0] - d, paddle[1], paddle[2]), (0.0, 0.0, 0.0))
        paid.append(float(step.terms["approach"][0, 0]))
    value = {d: math.exp(-4.0 * d * d) for d in (0.5, 0.3, 0.2)}
    assert paid[2] == paid[3] == 0.0
    assert paid[1] == pytest.approx(value[0.3] - value[0.5], abs=2e-3)
    assert paid[4] == pytest.approx(value[0.2] - value[0.3], abs=2e-3)
    stroke(world)
    assert world.env.memory["nearest"][0, 0] == 0.0


def test_after_contact_it_pays_for_the_landing_and_for_the_returns_so_far():
    world = rally()
    for returns in range(3):
        target = world.env.memory["target"][0, 0].numpy()
        linvel = aimed(-0.9, -0.2)
        step = stroke(world, linvel)
        miss = (-0.9 - target[0]) ** 2 + (-0.2 - target[1]) ** 2
        expected = 1.0 + math.exp(-miss) + returns
        assert step.terms["landing"][0, 0] == pytest.approx(expected, abs=2e-3)
        world.touch("table", (-0.9, -0.2, 0.78))
        step = world.go((-1.0, -0.2, 0.9), (-3.0, 0.0, 1.5))
        assert all(term[0, 0] == 0.0 for term in step.terms.values())
        assert step.metrics["hits"][0] == returns + 1
        assert launched(world.go((-1.6, 0.0, 0.9)))
        world.touch("table", (0.8, 0.2, 0.78))
        assert not far(world.go((0.9, 0.2, 0.9), (3.5, 0.0, 1.5)))


@pytest.mark.parametrize(
    ("x", "y", "good"),
    [(-1.36, 0.0, True), (-1.42, 0.0, False), (-0.7, 0.75, True), (-0.7, 0.81, False)],
)
def test_a_stroke_that_will_miss_the_table_earns_nothing(x, y, good):
    term = stroke(rally(), aimed(x, y)).terms["landing"][0, 0]
    assert (term >= 1.0) if good else (term == 0.0)


def test_a_stroke_into_the_net_earns_nothing():
    """Shots that would land on the far half if there were no net, one just over its top."""
    up = np.linspace(-1.0, 1.0, 200)
    shots = np.stack((0 * up - 5.0, 0 * up, up), 1)
    way = flights("table_tennis", 0 * shots + HIT_FROM, shots)
    spots = where_through(way, 2, 0.78)[:, 0]
    height = where_through(way, 0, 0.0)[:, 2] - 0.9125 - 0.02
    on = spots < -0.01
    over, under = height[on & (height > 1e-3)].min(), height[on & (height < -1e-3)].max()
    assert over - under < 0.05
    for edge, good in ((over, True), (under, False)):
        shot = tuple(shots[height == edge][0])
        assert (stroke(rally(), shot).terms["landing"][0, 0] >= 1.0) == good


# Balls.


def test_the_first_ball_is_let_go_over_the_net():
    world = made("table_tennis", 64)
    q, v = world.scene.object_qpos("ball"), world.scene.object_qvel("ball")
    assert (world.state.qpos[:, q][:, :3] == torch.tensor((0.0, 0.0, 1.4))).all()
    speed = world.state.qvel[:, v][:, :3]
    assert speed[:, 0].min() >= 2.0 and speed[:, 0].max() <= 3.0
    assert speed[:, 1].abs().max() <= 0.4 and (speed[:, 2] == 0.0).all()
    assert speed[:, 0].max() > 2.9 and speed[:, 1].min() < -0.3 and speed[:, 1].max() > 0.3
    spot = where_through(
        flights("table_tennis", np.tile((0, 0, 1.4), (64, 1)), speed.numpy()), 2, 0.78
    )
    assert spot[:, 0].min() > 0.5 and spot[:, 0].max() < 1.3  # on the near half of the table


def test_later_balls_land_in_the_box_over_the_net_and_under_the_roof():
    n = 400
    luck = torch.rand(n, 9, generator=torch.Generator().manual_seed(3))
    pos, linvel = rackets.served(table_tennis.GAME, luck, torch.ones(n, dtype=torch.bool))
    way = flights("table_tennis", pos.double().numpy(), linvel.double().numpy())
    spot = where_through(way, 2, 0.78)
    assert spot[:, 0].min() > 0.35 - 0.01 and spot[:, 0].max() < 1.2 + 0.01
    assert np.abs(spot[:, 1]).max() < 0.6 + 0.01
    at_net = np.array([way[way[:, i, 0] < 0.0, i][-1, 2] for i in range(n)])
    assert at_net.min() - 0.02 > 0.9125 + 0.04 and way[..., 2].max() < 2.5
    speed = linvel[:, 0]
    assert speed.min() > 3.49 and speed.max() < 5.01
    assert (pos[:, 0] == -1.37).all() and pos[:, 1].abs().max() <= 0.7
    assert pos[:, 2].min() >= 1.3 - 1e-6 and pos[:, 2].max() <= 1.6 + 1e-6
    assert spot[:, 0].min() < 0.4 and spot[:, 0].max() > 1.15 and speed.max() > 4.9


@pytest.mark.parametrize(
    ("ball", "again"),
    [((-1.49, 0.0, 0.9), False), ((-1.51, 0.0, 0.9), True), ((-0.9, 1.0, 0.49), True)],
)
def test_the_next_ball_comes_when_the_return_is_gone(ball, again):
    world = rally()
    assert not far(play_return(world))
    step = world.go(ball, (-3.0, 0.0, -1.0))
    assert launched(step) is again and not far(step)


def test_the_next_ball_comes_when_the_return_has_bounced_twice():
    world = rally()
    play_return(world)
    world.touch("table", (-1.1, 0.0, 0.78))
    step = world.go((-1.2, 0.0, 0.85))
    assert launched(step) and not far(step) and step.metrics["hits"][0] == 1.0


# How a point is lost.


def test_a_ball_that_is_not_returned_is_lost():
    for ball, lost in (
        ((3.45, 0.9, 1.0), False),
        ((3.55, 0.9, 1.0), True),  # past the athlete
        ((1.5, 0.9, 0.52), False),
        ((1.5, 0.9, 0.48), True),  # below the table
    ):
        assert far(rally().go(ball)) is lost
    world = rally()
    world.touch("table", (1.2, 0.2, 0.78))
    assert far(world.go((1.3, 0.2, 0.8)))  # bounced twice


def test_a_ball_may_not_be_hit_before_it_has_bounced():
    world = rally(bounced=False)
    step = stroke(world)
    assert far(step) and step.terms["landing"][0, 0] == 0.0
    assert not far(stroke(rally()))


def test_a_return_must_not_bounce_on_the_own_half():
    for x, lost in ((0.3, True), (-0.3, False)):
        world = rally()
        stroke(world)
        world.touch("table", (x, 0.0, 0.78))
        step = world.go((x - 0.1, 0.0, 0.85), (-4.0, 0.0, 1.0))
        assert far(step) is lost
        assert step.metrics["hits"][0] == float(not lost)


def test_a_return_beside_the_table_is_lost():
    world = rally()
    stroke(world)
    assert not far(world.go((-1.0, 0.9, 0.6), (-4.0, 0.0, -2.0)))
    assert far(world.go((-1.1, 0.9, 0.45), (-4.0, 0.0, -2.0)))


def test_a_ball_over_two_and_a_half_metres_is_lost():
    for height, lost in ((2.49, False), (2.51, True)):
        world = rally()
        stroke(world)
        assert far(world.go((0.5, 0.0, height), (-1.0, 0.0, 0.0))) is lost


def test_balancing_the_ball_on_the_paddle_is_lost():
    world = rally()
    assert not far(stroke(world))
    assert far(stroke(world))


def test_the_ball_must_not_meet_the_body():
    for y, lost in ((0.0, True), (0.6, False)):
        world = rally()
        world.go((1.6, y, 1.0), (9.0, 0.0, 0.0))
        assert far(world.go((1.9, y, 1.0), (9.0, 0.0, 0.0))) is lost


@pytest.mark.parametrize(
    ("forces", "lost"),
    [
        ((0, 0, 0, 0), False),
        ((30, 30, 0, 0), False),  # the hand with the paddle, alone on the table
        ((30, 0, 0, 0), True),
        ((30, 12, 0, 0), True),  # something else besides
        ((0, 0, 5, 5), False),
        ((0, 0, 5, 0), True),  # the net
    ],
)
def test_table_and_net_are_not_leant_on(forces, lost):
    world = rally()
    world.lean(forces)
    assert far(world.go((0.95, 0.2, 0.95), (3.5, 0.0, 1.2))) is lost


def test_of_two_athletes_the_one_who_leans_loses_the_point():
    for agent in range(2):
        world = made("table_tennis_1v1")
        world.put_ball((0.0, 0.0, 1.4), (-2.5, 0.0, 0.0))
        world.start()
        forces = [0.0] * 8
        forces[4 * agent] = 20.0
        world.lean(forces)
        step = world.go((-0.1, 0.0, 1.4), (-2.5, 0.0, -0.3))
        won = step.metrics["points_for" if agent else "points_against"]
        assert step.terminated.all() and won[0] == 1.0


def test_whoever_lies_on_the_table_leans_on_it():
    """In the engine: a trunk on the table, and a paddle alone that is pressed on it."""
    bent = {"L_Hip_y": -1.4, "R_Hip_y": -1.4}
    world = made("table_tennis")
    table = world.scene.contact_pairs.index(("agent0", "table"))

    def pressed(height: float, x: float, **joints: float) -> tuple[bool, bool]:
        world.restore()
        world.place((x, 0.0, height), **joints)
        world.start()
        touching = leaning = False
        for _ in range(12):
            world.env.physics.step(world.env.targets(torch.zeros(1, 1, 69)).flatten(1))
            world.env.view.refresh()
            touching |= bool(world.env.physics.pair_force[0, table] > 0.0)
            leaning |= bool(rackets.leaning(world.env.view)[0, 0])
        return touching, leaning

    assert pressed(0.95, 1.55, **bent) == (True, True)
    assert pressed(0.95, 2.2) == (False, False)


def test_features_are_seen_from_the_athlete():
    world = rally(ball_path=True)
    world.go((0.5, 0.3, 1.0), (4.0, 0.5, 1.0))
    seen = torch.tensor((1.5, -0.3, 1.0 - STANDING))
    assert torch.allclose(world.goal("ball")[0, 0], seen, atol=1e-3)
    assert torch.allclose(world.goal("racket")[0, 0], torch.tensor(PADDLE), atol=1e-3)
    target = world.env.memory["target"][0, 0]
    assert -1.2 < target[0] < -0.3 and target[1].abs() < 0.6 and target[2] == pytest.approx(0.76)
    way = flights("table_tennis", np.array([(0.5, 0.3, 1.0)]), np.array([(4.0, 0.5, 1.0)]))[:, 0]
    path = world.goal("ball_path")[0, 0].view(10, 3)
    for k in range(6):  # it comes down to the table after 0.35 s
        x, y, z = way[50 * (k + 1)]
        expected = torch.tensor((2.0 - x, -y, z - STANDING), dtype=torch.float32)
        assert torch.allclose(path[k], expected, atol=2e-3), k
    assert world.env.obs_size == 358 + 12 + 30


def test_table_and_net_are_solid_and_stand_where_the_rules_say():
    model = build_model(made("table_tennis").scene)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def top(x: float, y: float) -> float:
        """Height of what lies under (x, y, 1.3)."""
        above, down, geom = np.array((x, y, 1.3)), np.array((0.0, 0.0, -1.0)), np.zeros(1, "i")
        return 1.3 - mujoco.mj_ray(model, data, above, down, None, True, -1, geom)

    assert top(1.0, 0.5) == pytest.approx(0.76, abs=1e-6)
    assert top(1.365, 0.76) == pytest.approx(0.76, abs=1e-6)
    assert top(1.375, 0.0) == pytest.approx(0.0, abs=1e-6)
    assert top(0.0, 0.9) == pytest.approx(0.9125, abs=1e-6)
    assert top(0.0, 0.92) == pytest.approx(0.0, abs=1e-6)


# Two athletes.


def test_a_point_is_fed_to_either_side_and_won_by_one():
    world = made("table_tennis_1v1")
    world.put_ball((0.0, 0.0, 1.4), (-2.5, 0.2, 0.0))
    world.start()
    world.touch("table", (-0.8, 0.1, 0.78))
    step = world.go((-0.9, 0.1, 0.9), (-2.4, 0.2, 2.0))
    assert not step.terminated.any() and step.terms["approach"][0, 0] == 0.0
    world.touch("racket1", (-1.6, 0.2, 1.0))
    step = world.go(
        (-1.25, -0.3, 1.05), tuple(-v if i < 2 else v for i, v in enumerate(aimed(-0.8, 0.0)))
    )
    assert step.terms["landing"][0, 1] >= 1.0 and step.terms["landing"][0, 0] == 0.0
    world.touch("table", (0.8, 0.0, 0.78))
    world.go((0.9, 0.0, 0.9), (4.0, 0.0, 2.0))
    step = world.go((3.55, 0.9, 0.9))
    assert step.terminated.all()
    assert step.metrics["points_against"][0] == 1.0 and step.metrics["points_for"][0] == 0.0
    assert step.metrics["rally"][0] == 1.0 and step.metrics["hits"][0] == 1.0
    assert not step.success[0]  # agent 1 has won


def test_a_second_return_is_worth_more_to_its_own_side_alone():
    world = made("table_tennis_1v1")
    world.put_ball((0.0, 0.0, 1.4), (2.5, 0.0, 0.0))
    world.start()
    shot = aimed(-0.8, 0.0)
    shots = {0: shot, 1: (-shot[0], -shot[1], shot[2])}
    side = {0: 1.0, 1: -1.0}
    worth = []
    for who in (0, 1, 0):
        s = side[who]
        world.touch("table", (0.8 * s, 0.0, 0.78))
        world.go((0.9 * s, 0.0, 0.9))
        world.touch(f"racket{who}", (1.3 * s, 0.3 * s, 1.0))
        target = world.env.memory["target"][0, who].clone()
        step = world.go((HIT_FROM[0] * s, HIT_FROM[1] * s, HIT_FROM[2]), shots[who])
        miss = (-0.8 * s - target[0]) ** 2 + target[1] ** 2
        worth.append(float(step.terms["landing"][0, who] - 1.0 - math.exp(-miss)))
    assert worth == pytest.approx([0.0, 0.0, 1.0], abs=3e-3)
