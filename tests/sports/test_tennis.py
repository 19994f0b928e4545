"""Tennis on states made by hand, with known answers; launches against another integration."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from sports import rackets, table_tennis, tennis
from sports.env import make_env, make_scene
from sports.humanoid.mjcf import build_model
from tests.sports.rackets_made import HandMadeRally, flights, launched, made, where_through

STANDING = 0.9412
RALLY = ((-10.0, 0.0, 1.0), (20.0, 0.0, 3.0))
"""A ball of the machine on its way."""
RACKET = (
    # From the root at the zero pose: offsets of the right arm's links, and the racket's 0.35 m.
    -0.0267 + 0.0011 + 0.0254 - 0.0386 - 0.0091 - 0.0214 - 0.0056,
    -0.0025 + 0.0055 + 0.0015 - 0.0818 - 0.0960 - 0.2537 - 0.2553 - 0.35,
    0.1090 + 0.1352 + 0.0529 + 0.1188 + 0.0326 - 0.0133 + 0.0078,
)
STROKE = (10.0, 1.0, 1.0)


def rally(bounced: bool = True, num_worlds: int = 1, **options) -> HandMadeRally:
    """The machine's ball is on its way to a standing athlete, by default after its bounce."""
    world = made("tennis", num_worlds, **options)
    world.put_ball(*RALLY)
    world.start()
    if bounced:
        world.touch("ground", (8.0, 0.0, 0.032))
        step = world.go((8.3, 0.0, 0.4), (15.0, 0.0, 5.0))
        assert not step.terminated.any() and world.env.memory["bounced"].all()
    return world


def stroke(world: HandMadeRally, linvel=(-20.0, 0.0, 5.0), pos=(9.5, 1.0, 1.2)):
    world.touch("racket0", STROKE)
    return world.go(pos, linvel)


def far(step) -> bool:
    return bool(step.terminated[0, 0])


# Rewards.


def test_before_contact_the_racket_is_led_to_the_ball():
    world = rally()
    racket = np.array((13.0 - RACKET[0], -RACKET[1], STANDING + RACKET[2]))  # faces -x
    for offset in ((0.3, 0.0, 0.0), (-0.5, 0.4, 0.3)):
        step = world.go(tuple(racket + offset))
        expected = math.exp(-sum(x * x for x in offset))
        assert step.terms["approach"][0, 0] == pytest.approx(expected, abs=2e-4)
        assert step.terms["landing"][0, 0] == 0.0 and step.terms["bounce"][0, 0] == 0.0


def test_reaching_is_paid_by_the_metre_and_once():
    """Of the last four metres, whatever the way; a stroke and a new ball begin anew."""
    world = rally(reach=2.0)
    racket = (13.0 - RACKET[0], -RACKET[1], STANDING + RACKET[2])
    world.env.memory["nearest"] *= 0.0  # the bounce of ``rally`` was within 4 m already
    paid = []
    for d in (5.0, 3.0, 1.0, 2.0, 1.0, 0.5):
        step = world.go((racket[0] - d, racket[1], racket[2]), (0.0, 0.0, -1.0))
        paid.append(float(step.terms["reach"][0, 0]))
    assert paid == pytest.approx([0.0, 2.0, 4.0, 0.0, 0.0, 1.0], abs=4e-3)
    assert stroke(world).terms["reach"][0, 0] == 0.0
    assert world.env.memory["nearest"][0, 0] == 0.0
    assert "reach" not in rally().go((11.0, 0.0, 1.0)).terms
    for sport in ("tennis", "table_tennis"):
        with pytest.raises(ValueError, match="must not be negative"):
            make_env(sport, num_worlds=1, options={"reach": -1.0})


def aimed(x: float, y: float) -> tuple[float, float, float]:
    """Velocity that carries a ball from (9.5, 1, 1.2) to a place on the ground: read off a fan of
    shots that differ in their slopes."""
    up = np.linspace(3.0, 9.0, 300)
    fan = np.stack((0 * up - 18.0, 0 * up + 18.0 * (y - 1.0) / (9.5 - x), up), 1)
    reached = where_through(flights("tennis", 0 * fan + (9.5, 1.0, 1.2), fan), 2, 0.032)[:, 0]
    return float(fan[0, 0]), float(fan[0, 1]), float(np.interp(-x, -reached, up))


def test_a_stroke_is_paid_by_how_far_it_will_carry():
    """In its step alone, by the share of the way from the ball to the target; a ball hit backwards
    and a second contact earn nothing."""
    world = rally(drive=3.0)
    target = torch.tensor((-8.0, 3.0, 0.0))
    world.env.memory["target"][:] = target
    linvel = aimed(-9.0, 1.0)
    step = stroke(world, linvel)
    share = 1.0 - math.hypot(1.0, 2.0) / math.hypot(17.5, 2.0)
    assert step.terms["drive"][0, 0] == pytest.approx(3.0 * share, abs=0.01)
    assert world.go((9.0, 1.0, 1.4), linvel).terms["drive"][0, 0] == 0.0
    assert stroke(world, linvel).terms["drive"][0, 0] == 0.0  # a second contact
    assert stroke(rally(drive=3.0), (20.0, 0.0, 5.0)).terms["drive"][0, 0] == 0.0
    assert "drive" not in stroke(rally()).terms


def test_a_stroke_is_paid_once_by_how_near_to_its_target_it_will_land():
    """A factor of e less for every ``aim_width``; nothing for strokes out or into the net."""
    target = torch.tensor((-8.0, 3.0, 0.0))

    def paid(linvel, **options) -> float:
        world = rally(aim=3.0, **options)
        world.env.memory["target"][:] = target
        first = float(stroke(world, linvel).terms["aim"][0, 0])
        assert world.go((9.0, 1.0, 1.4), linvel).terms["aim"][0, 0] == 0.0
        return first

    miss = math.hypot(1.0, 0.5)
    linvel = aimed(-9.0, 2.5)
    assert paid(linvel) == pytest.approx(3.0 * math.exp(-miss / 0.2), abs=0.002)
    assert paid(linvel, aim_width=2.0) == pytest.approx(3.0 * math.exp(-miss / 2.0), abs=0.01)
    assert paid((-20.0, 0.0, 12.0)) == 0.0 and paid((-20.0, 0.0, 0.0)) == 0.0
    assert "aim" not in stroke(rally()).terms
    for bad in ({"aim": -1.0}, {"aim_width": 0.0}):
        with pytest.raises(ValueError, match="aim"):
            make_env("tennis", num_worlds=1, options=bad)


def test_a_stroke_that_rises_above_the_apex_is_paid_less():
    """By the height to which its vertical speed would carry it without air: v^2 / 2g above the
    ball. The lower of two strokes is paid in full, and what the ball does is not changed."""
    linvel = (-12.0, 0.0, 9.0)
    rise = 1.2 + 9.0**2 / (2 * 9.81)
    pay = {"drive": 2.0, "aim": 2.0, "aim_width": 5.0}
    plain, low = (stroke(rally(**pay, apex=apex), linvel) for apex in (0.0, 3.0))
    factor = math.exp(-(rise - 3.0) / 2.0)
    for term in ("landing", "drive", "aim"):
        assert plain.terms[term][0, 0] > 0.1
        assert low.terms[term][0, 0] == pytest.approx(factor * float(plain.terms[term][0, 0]))
    high = stroke(rally(**pay, apex=rise + 0.01), linvel)
    assert all(torch.equal(high.terms[name], term) for name, term in plain.terms.items())
    assert not low.terminated.any()
    with pytest.raises(ValueError, match="apex"):
        make_env("tennis", num_worlds=1, options={"apex": -1.0})


def test_who_has_played_is_paid_for_standing_ready():
    """1 for the start itself, from the step after a stroke until the next ball is on its way."""
    world = rally(recover=2.0)
    q = world.scene.agent_qpos(0).start
    assert stroke(world).terms["recover"][0, 0] == 0.0

    def paid(*, dx=0.0, dy=0.0, dz=0.0, yaw=math.pi, pitch=0.0) -> float:
        half, lean = 0.5 * yaw, 0.5 * pitch
        turned = (math.cos(half) * math.cos(lean), -math.sin(half) * math.sin(lean))
        turned += (math.cos(half) * math.sin(lean), math.sin(half) * math.cos(lean))
        root = (13.0 + dx, dy, STANDING + dz, *turned)
        world.state.qpos[:, q : q + 7] = torch.tensor(root)
        return float(world.go((9.0, 1.0, 1.4), (-20.0, 0.0, 5.0)).terms["recover"][0, 0])

    assert paid() == pytest.approx(2.0, abs=1e-3) and paid(dz=0.1) == pytest.approx(2.0, abs=1e-3)
    assert paid(dx=-3.0) == paid(dy=3.0) == pytest.approx(2.0 * math.exp(-0.5), abs=1e-3)
    assert paid(dz=-0.2) == pytest.approx(2.0 * math.exp(-0.5), abs=5e-3)
    assert paid(yaw=0.0) == pytest.approx(0.0, abs=1e-5)
    assert paid(yaw=math.pi / 2) == pytest.approx(1.0, abs=1e-3)
    tilted = math.cos(0.5) * 0.5 * (1.0 + math.cos(0.5))
    assert paid(pitch=0.5) == pytest.approx(2.0 * tilted, abs=1e-3)
    assert rally(recover=2.0).go((11.0, 0.0, 1.0)).terms["recover"][0, 0] == 0.0
    assert "recover" not in stroke(rally()).terms
    with pytest.raises(ValueError, match="must not be negative"):
        make_env("tennis", num_worlds=1, options={"recover": -1.0})


@pytest.mark.parametrize("sport", ["tennis", "table_tennis"])
def test_narrower_launches_are_those_of_the_sport_nearer_to_the_middle(sport):
    rules = {"tennis": tennis.GAME, "table_tennis": table_tennis.GAME}[sport]
    luck = torch.rand(400, 9, generator=torch.Generator().manual_seed(1))
    every = torch.ones(400, dtype=torch.bool)
    wide, narrow = (
        rackets.served(rackets.narrowed(rules, width), luck, every) for width in (1.0, 0.25)
    )
    assert torch.equal(wide[0], rackets.served(rules, luck, every)[0])
    torch.testing.assert_close(narrow[0][:, 1], 0.25 * wide[0][:, 1])
    torch.testing.assert_close(narrow[0][:, [0, 2]], wide[0][:, [0, 2]])
    env = make_env(sport, num_worlds=64, seed=1, options={"width": 0.1})
    y = env.physics.object_pos[:, 0, 1].abs()
    assert y.max() <= 0.1 * max(rules.serve.y[1], 1e-6) + 1e-6
    for width in (0.0, 1.5):
        with pytest.raises(ValueError, match="width"):
            make_env(sport, num_worlds=1, options={"width": width})
    with pytest.raises(ValueError, match="must not be negative"):
        make_env(sport, num_worlds=1, options={"drive": -1.0})


def test_after_contact_it_pays_how_near_to_the_target_the_ball_will_land():
    for x, y in ((-9.0, 1.0), (-8.0, -2.5), (-10.5, 2.5)):
        world = rally()
        target = world.env.memory["target"][0, 0].numpy()
        linvel = aimed(x, y)
        step = stroke(world, linvel)
        way = flights("tennis", np.array([(9.5, 1.0, 1.2)]), np.array([linvel]))
        spot = where_through(way, 2, 0.032)[0]
        assert spot == pytest.approx((x, y, 0.032), abs=0.05)  # the test's own shot
        miss = np.sum((spot[:2] - target[:2]) ** 2)
        assert step.terms["landing"][0, 0] == pytest.approx(1.0 + math.exp(-miss), abs=1e-3)
        assert step.terms["approach"][0, 0] == 0.0
        # And so in every step until the bounce.
        later = world.go(tuple(way[33, 0]), tuple((way[34, 0] - way[32, 0]) / 2e-3))
        expected = pytest.approx(1.0 + math.exp(-miss), abs=2e-3)
        assert later.terms["landing"][0, 0] == expected


@pytest.mark.parametrize(
    ("x", "y", "good"),
    [
        (-11.89, 0.0, True),
        (-11.94, 0.0, False),
        (-8.0, 4.12, True),
        (-8.0, 4.17, False),
        (-8.0, -4.17, False),
    ],
)
def test_a_stroke_that_will_land_out_earns_nothing(x, y, good):
    term = stroke(rally(), aimed(x, y)).terms["landing"][0, 0]
    assert (term >= 1.0) if good else (term == 0.0)


@pytest.mark.parametrize("net", ["level", "rules"])
def test_a_stroke_into_the_net_earns_nothing(net):
    """Shots that would land in the far court if there were no net, one just over its top."""
    top = 1.0 if net == "level" else 0.914 + (1.07 - 0.914) * 1.0 / 5.029  # they fly at y = 1
    up = np.linspace(1.0, 3.2, 80)
    shots = np.stack((0 * up - 25.0, 0 * up, up), 1)
    way = flights("tennis", 0 * shots + (9.5, 1.0, 1.2), shots)
    spots = where_through(way, 2, 0.032)
    assert -11.8 < spots[:, 0].min() and spots[:, 0].max() < -0.1
    height = where_through(way, 0, 0.0)[:, 2] - top - 0.032
    over, under = height[height > 0.002].min(), height[height < -0.002].max()
    assert over - under < 0.1
    for edge, good in ((over, True), (under, False)):
        shot = tuple(shots[height == edge][0])
        assert (stroke(rally(net=net), shot).terms["landing"][0, 0] >= 1.0) == good


def test_round_the_post_there_is_no_net():
    """ITF rule 25: a return may pass outside the posts below the height of the net."""
    from_wide, v = (6.0, 7.8, 1.0), (-22.0, -7.5, 1.0)
    way = flights("tennis", np.array([from_wide]), np.array([v]))
    at_net, spot = where_through(way, 0, 0.0)[0], where_through(way, 2, 0.032)[0]
    assert at_net[1] > 5.1 and at_net[2] < 0.95 and abs(spot[1]) < 4.0 and -11 < spot[0] < 0
    world = rally()
    world.touch("racket0", (6.2, 7.8, 1.0))
    assert world.go(from_wide, v).terms["landing"][0, 0] >= 1.0


def test_a_bounce_in_the_court_pays_once_and_the_wait_for_the_next_ball_nothing():
    world = rally()
    stroke(world)
    world.touch("ground", (-8.0, 0.5, 0.032))
    step = world.go((-8.3, 0.5, 0.2), (-12.0, 0.0, 4.0))
    assert step.terms["bounce"][0, 0] == 1.0 and step.terms["landing"][0, 0] == 0.0
    step = world.go((-9.0, 0.5, 0.9), (-12.0, 0.0, 2.0))
    assert all(term[0, 0] == 0.0 for term in step.terms.values())
    assert not far(step) and step.success[0]


# The machine's next ball.


def returned(num_worlds: int = 1) -> HandMadeRally:
    world = rally(num_worlds=num_worlds)
    stroke(world)
    world.touch("ground", (-8.0, 0.5, 0.032))
    world.go((-8.3, 0.5, 0.2), (-12.0, 0.0, 4.0))
    return world


@pytest.mark.parametrize(("x", "again"), [(-12.89, False), (-12.91, True)])
def test_the_next_ball_comes_when_the_return_is_gone(x, again):
    world = returned()
    before = world.env.memory["target"].clone()
    step = world.go((x, 0.5, 1.0), (-10.0, 0.0, 0.0))
    assert step.move is not None and launched(step) is again and not far(step)
    memory = world.env.memory
    assert memory["hitter"][0] == (-1.0 if again else 1.0)
    assert bool((memory["target"] != before).any()) is again
    if again:
        q, v = world.scene.object_qpos("ball"), world.scene.object_qvel("ball")
        assert step.move.qpos[0, q][0] == -12.5 and step.move.qpos[0, q][2] == pytest.approx(1.2)
        assert 17.9 < step.move.qvel[0, v][0] < 25.1
        assert torch.equal(memory["ball"][0], step.move.qpos[0, q][:3])
        assert not memory["bounced"][0]
        # And can be returned as the first one.
        world.touch("ground", (8.0, 0.0, 0.032))
        assert not far(world.go((8.3, 0.0, 0.3), (15.0, 0.0, 4.0)))
        stroke(world)
        world.touch("ground", (-9.0, 0.0, 0.032))
        step = world.go((-9.3, 0.0, 0.3))
        assert step.metrics["hits"][0] == 2.0


def test_the_next_ball_comes_when_the_return_has_bounced_twice():
    world = returned()
    world.touch("ground", (-10.0, 0.5, 0.032))
    step = world.go((-10.2, 0.5, 0.2))
    assert launched(step) and not far(step) and step.metrics["hits"][0] == 1.0


def test_a_return_out_of_court_brings_no_next_ball():
    world = rally()
    stroke(world)
    assert not launched(world.go((-12.95, 0.0, 1.0), (-20.0, 0.0, -2.0)))
    world.touch("ground", (-14.0, 0.0, 0.032))
    step = world.go((-14.2, 0.0, 0.2))
    assert far(step) and not launched(step) and step.metrics["hits"][0] == 0.0


def test_launches_land_in_the_box_over_the_net_and_under_the_roof():
    n = 400
    luck = torch.rand(n, 9, generator=torch.Generator().manual_seed(3))
    pos, linvel = rackets.served(tennis.GAME, luck, torch.ones(n, dtype=torch.bool))
    way = flights("tennis", pos.double().numpy(), linvel.double().numpy())
    spot = where_through(way, 2, 0.032)
    assert spot[:, 0].min() > 6 - 0.01 and spot[:, 0].max() < 11 + 0.01
    assert np.abs(spot[:, 1]).max() < 3 + 0.01
    before = np.array([way[way[:, i, 0] < 0.0, i][-1, 2] for i in range(n)])
    assert before.min() - 0.032 > 1.0 + 0.25 - 0.01
    assert way[..., 2].max() < 4.0 + 0.01
    speed = linvel[:, 0]
    assert speed.min() > 17.99 and speed.max() < 25.01
    assert (pos[:, 0] == -12.5).all() and pos[:, 1].abs().max() < 3.0
    # They fill the box and the range of speeds.
    assert spot[:, 0].min() < 6.2 and spot[:, 0].max() > 10.8 and np.abs(spot[:, 1]).max() > 2.9
    assert speed.min() < 18.3 and speed.max() > 24.5


# How a point is lost.


def test_a_ball_that_is_not_returned_is_lost():
    world = rally()
    world.touch("ground", (12.0, 0.0, 0.032))
    step = world.go((12.2, 0.0, 0.2))
    assert far(step) and step.metrics["hits"][0] == 0.0 and torch.isnan(step.metrics["error"][0])
    assert not step.success[0]


@pytest.mark.parametrize(("x", "lost"), [(15.85, False), (15.95, True)])
def test_a_ball_behind_the_athlete_is_lost(x, lost):
    assert far(rally().go((x, 3.0, 1.0))) is lost


def test_a_return_into_the_net_is_lost_when_it_comes_down():
    world = rally()
    stroke(world)
    world.touch("net", (0.05, 0.0, 0.8))
    step = world.go((0.2, 0.0, 0.6), (0.5, 0.0, -2.0))
    assert not far(step) and step.terms["landing"][0, 0] == 0.0
    world.touch("ground", (0.3, 0.0, 0.032))
    assert far(world.go((0.3, 0.0, 0.05)))


def test_a_net_cord_is_played_on():
    world = rally()
    stroke(world)
    world.touch("net", (0.03, 0.0, 1.0))
    assert not far(world.go((-0.2, 0.0, 1.05), (-3.0, 0.0, 0.5)))
    world.touch("ground", (-2.0, 0.0, 0.032))
    step = world.go((-2.1, 0.0, 0.05))
    assert not far(step) and step.terms["bounce"][0, 0] == 1.0


def test_carrying_the_ball_on_the_racket_is_lost_and_earns_nothing():
    world = rally()
    assert not far(stroke(world))
    step = stroke(world)
    assert far(step) and step.terms["landing"][0, 0] == 0.0


def test_a_lob_over_eight_metres_is_lost():
    for height, lost in ((7.99, False), (8.01, True)):
        world = rally()
        stroke(world)
        assert far(world.go((5.0, 0.0, height), (-5.0, 0.0, 0.0))) is lost


def test_the_racket_may_not_reach_over_the_net():
    for x, lost in ((0.1, False), (-0.1, True)):
        world = rally(bounced=False)
        world.touch("racket0", (x, 0.0, 1.3))
        step = world.go((x - 0.3, 0.0, 1.3), (-10.0, 0.0, 0.0))
        assert far(step) is lost
        if lost:
            assert step.terms["landing"][0, 0] == 0.0


def test_nobody_crosses_the_net():
    for x, lost in ((0.1, False), (-0.1, True)):
        world = rally()
        world.place((x, 7.0, STANDING))
        assert far(world.go((9.0, 0.0, 1.0), (15.0, 0.0, 5.0))) is lost


def test_the_ball_must_not_meet_the_body():
    for y, lost in ((0.0, True), (0.6, False)):
        world = rally()
        # 24 m/s past the hips, under the arm: at neither end of the step near the body.
        world.go((12.6, y, 0.9), (24.0, 0.0, 0.0))
        assert far(world.go((13.4, y, 0.9), (24.0, 0.0, 0.0))) is lost


def test_a_fall_loses_the_point_but_the_racket_may_touch_the_ground():
    world = rally()
    ball = (9.0, 0.0, 1.0), (15.0, 0.0, 5.0)
    assert not far(world.go(*ball, {"L_Toe": 700.0, "R_Wrist": 200.0}))
    assert not far(world.go(*ball, {"L_Hand": 49.0}))
    assert far(world.go(*ball, {"L_Hand": 51.0}))


# Measures.


def test_hits_error_and_contact_rate():
    world = rally()
    stroke(world)
    target = world.env.memory["target"][0, 0].tolist()
    world.touch("ground", (target[0] + 0.3, target[1] - 0.4, 0.032))
    step = world.go((-9.0, 0.0, 0.2), (-12.0, 0.0, 4.0))
    assert step.metrics["hits"][0] == 1.0
    assert step.metrics["error"][0] == pytest.approx(0.5, abs=1e-4)
    step = world.go((-13.0, 0.0, 1.0))
    assert launched(step)
    target = world.env.memory["target"][0, 0].tolist()
    world.touch("ground", (8.0, 0.0, 0.032))
    world.go((8.3, 0.0, 0.4))
    stroke(world)
    world.touch("ground", (target[0] + 0.5, target[1] + 1.2, 0.032))
    step = world.go((-9.0, 0.0, 0.2))
    assert step.metrics["hits"][0] == 2.0 and step.metrics["contacts"][0] == 2.0
    assert step.metrics["error"][0] == pytest.approx((0.5 + 1.3) / 2, abs=1e-4)
    assert step.metrics["contact_rate"][0] == 1.0
    world.go((-13.0, 0.0, 1.0))
    world.touch("ground", (8.0, 0.0, 0.032))
    world.go((8.3, 0.0, 0.4))
    step = world.go((15.95, 3.0, 1.0))
    assert far(step) and step.metrics["contact_rate"][0] == pytest.approx(2 / 3)
    assert step.metrics["hits"][0] == 2.0 and step.success[0]


def test_features_are_seen_from_the_athlete():
    world = rally()
    world.go((9.0, 1.5, 1.0), (15.0, 2.0, 5.0))
    # It faces -x: what is at smaller x is ahead, what is at smaller y is to the left.
    assert torch.allclose(
        world.goal("ball")[0, 0], torch.tensor((4.0, -1.5, 1.0 - STANDING)), atol=1e-3
    )
    assert torch.allclose(
        world.goal("ball_velocity")[0, 0], torch.tensor((-15.0, -2.0, 5.0)), atol=1e-4
    )
    assert torch.allclose(world.goal("racket")[0, 0], torch.tensor(RACKET), atol=1e-3)
    target = world.env.memory["target"][0, 0]
    seen = torch.stack((13.0 - target[0], -target[1], -torch.tensor(STANDING)))
    assert torch.allclose(world.goal("target")[0, 0], seen, atol=1e-3)
    assert target[0] < -8 and target[0] > -11 and target[1].abs() < 3 and target[2] == 0.0
    sizes = {k: v.stop - v.start for k, v in world.env.obs_slices.items() if k.startswith("goal")}
    assert sum(sizes.values()) == 12 and world.env.obs_size == 358 + 12


def test_the_ball_path_shows_the_coming_second():
    world = rally(ball_path=True)
    assert world.env.obs_size == 358 + 12 + 30
    world.go((5.0, 0.5, 1.5), (18.0, -1.0, 0.0))
    seen = world.goal("ball_path")[0, 0].view(10, 3)
    way = flights("tennis", np.array([(5.0, 0.5, 1.5)]), np.array([(18.0, -1.0, 0.0)]))[:, 0]
    for k in range(5):  # it bounces after 0.56 s
        x, y, z = way[100 * (k + 1)]
        expected = torch.tensor((13.0 - x, -y, z - STANDING), dtype=torch.float32)
        assert torch.allclose(seen[k], expected, atol=2e-3), k
    assert seen[9, 2] > -STANDING + 0.3  # and has risen again


# Two athletes.


def duel(num_worlds: int = 1, towards: float = 1.0, **options) -> HandMadeRally:
    """A ball fed to agent 0, or with -1 to agent 1."""
    world = made("tennis_1v1", num_worlds, **options)
    world.put_ball((0.0, 0.0, 2.5), (11.0 * towards, 0.0, 0.0))
    world.start()
    return world


def test_a_point_is_fed_to_either_side():
    world = made("tennis_1v1", 64)
    q, v = world.scene.object_qpos("ball"), world.scene.object_qvel("ball")
    speed = world.state.qvel[:, v][:, 0]
    assert (world.state.qpos[:, q][:, :3] == torch.tensor((0.0, 0.0, 2.5))).all()
    assert (speed.abs() >= 10).all() and (speed.abs() <= 12).all()
    assert 10 < (speed > 0).sum() < 54
    way = flights(
        "tennis", np.tile((0.0, 0.0, 2.5), (64, 1)), world.state.qvel[:, v][:, :3].numpy()
    )
    spot = where_through(way, 2, 0.032)
    assert (np.abs(spot[:, 0]) > 6).all() and (np.abs(spot[:, 0]) < 9).all()


def test_only_who_has_the_ball_to_play_is_paid():
    world = duel()
    racket = (13.0 - RACKET[0], -RACKET[1], STANDING + RACKET[2])
    world.touch("ground", (7.5, 0.0, 0.032))
    step = world.go(racket)
    assert step.terms["approach"].tolist() == [pytest.approx([1.0, 0.0], abs=1e-4)]
    assert not step.terms["bounce"].any()  # a feed is nobody's stroke
    world.touch("racket0", STROKE)
    step = world.go((9.5, 1.0, 1.2), (-20.0, 0.0, 5.0))
    assert step.terms["landing"][0, 0] >= 1.0 and step.terms["landing"][0, 1] == 0.0
    assert step.terms["approach"][0, 0] == 0.0
    world.touch("ground", (-8.0, 0.5, 0.032))
    mirrored = tuple(x * s for x, s in zip(racket, (-1, -1, 1)))
    step = world.go(mirrored)
    assert step.terms["bounce"].tolist() == [[1.0, 0.0]]
    assert step.terms["approach"].tolist() == [pytest.approx([0.0, 1.0], abs=1e-4)]
    before = world.env.memory["target"].clone()
    world.touch("racket1", (-10.0, 0.0, 1.0))
    step = world.go((-9.5, 0.0, 1.2), (20.0, 0.0, 5.0))
    assert step.terms["landing"][0, 1] >= 1.0 and step.terms["landing"][0, 0] == 0.0
    assert step.metrics["rally"][0] == 2.0 and not step.terminated.any()
    after = world.env.memory["target"]
    assert (after[0, 0] != before[0, 0]).any() and torch.equal(after[0, 1], before[0, 1])


def test_a_decided_point_ends_the_episode_of_both():
    world = duel()
    world.touch("ground", (7.5, 0.0, 0.032))
    world.go((7.8, 0.0, 0.3))
    world.touch("ground", (11.0, 0.0, 0.032))
    step = world.go((11.2, 0.0, 0.3))
    assert step.terminated.tolist() == [[True, True]]
    assert step.metrics["points_for"][0] == 0.0 and step.metrics["points_against"][0] == 1.0
    world = duel(towards=-1.0)
    world.touch("ground", (-7.5, 0.0, 0.032))
    world.go((-7.8, 0.0, 0.3))
    world.touch("racket1", (-10.0, 0.0, 1.0))
    world.go((-9.5, 0.0, 1.2), (25.0, 0.0, 5.0))
    world.touch("ground", (12.5, 0.0, 0.032))
    step = world.go((12.8, 0.0, 0.3))
    assert step.terminated.all() and step.metrics["points_for"][0] == 1.0
    assert step.metrics["points_against"][0] == 0.0 and step.success[0]


def test_the_solo_policy_finds_its_features_first_in_a_duel():
    solo, pair = made("tennis").env.obs_slices, made("tennis_1v1").env.obs_slices
    assert all(pair[name] == where for name, where in solo.items())
    more = [name for name in pair if name not in solo]
    assert more == ["goal/opponent", "goal/opponent_velocity", "goal/opponent_racket"]


def test_both_options_of_the_net_stand_where_the_rules_say():
    for net, heights in (("level", (1.0, 1.0)), ("rules", (0.914 + 0.0031, 1.07))):
        model = build_model(make_scene("tennis", options={"net": net}))
        tops = []
        for y in (0.1, 5.0285):
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            above, down, geom = (
                np.array((0.0, y, 3.0)),
                np.array((0.0, 0.0, -1.0)),
                np.zeros(1, "i"),
            )
            tops.append(3.0 - mujoco.mj_ray(model, data, above, down, None, True, -1, geom))
        assert tops == pytest.approx(heights, abs=1e-3)
    with pytest.raises(ValueError, match="net must be"):
        make_env("tennis", num_worlds=1, options={"net": "high"})
