"""The rules of a rally: by hand on both sides of every threshold, and against a scalar umpire."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch

from sports import table_tennis, tennis
from sports.humanoid import load_body
from sports.physics import Geometry, make_physics
from sports.rackets import BODY_DISTANCE, HAND
from sports.rally import Court, Touches, met, play
from sports.scene import humanoid_scene

TENNIS, TABLE = tennis.GAME.court, table_tennis.GAME.court
NOWHERE = (0.0, 0.0, 0.0)


def step(
    court: Court = TENNIS,
    hitter: float = -1.0,
    bounced: bool = False,
    bounces: int = 0,
    bounce: tuple[float, tuple[float, float, float]] = (math.inf, NOWHERE),
    strokes: tuple[tuple[float, tuple[float, float, float]] | None, ...] = (None,),
    ball: tuple[float, float, float] = (5.0, 0.0, 1.0),
    late: tuple[bool, ...] | None = None,
):
    """One world, one step. ``bounce`` and each of ``strokes`` are a time (s) and a place."""
    if bounce[0] < math.inf and bounces == 0:
        bounces = 1
    struck = [s or (math.inf, NOWHERE) for s in strokes]
    touch = Touches(
        torch.tensor([bounces], dtype=torch.int32),
        torch.tensor([bounce[0]]),
        torch.tensor([bounce[1]]),
        torch.tensor([[int(s is not None) for s in strokes]], dtype=torch.int32),
        torch.tensor([[s[0] for s in struck]]),
        torch.tensor([[s[1] for s in struck]]),
    )
    return play(
        court,
        torch.tensor([hitter]),
        torch.tensor([bounced]),
        touch,
        torch.tensor([ball]),
        torch.tensor([late or (False,) * len(strokes)]),
    )


def lost(point) -> tuple[bool, bool]:
    """By the side at x > 0, by the other one."""
    a, b = point.lost[0].tolist()
    return a, b


def ground(x: float, y: float = 0.0, time: float = 0.01):
    return time, (x, y, 0.032)


def board(x: float, y: float = 0.0, time: float = 0.01, z: float = 0.78):
    return time, (x, y, z)


NOBODY, NEAR, FAR = (False, False), (True, False), (False, True)


@pytest.mark.parametrize(
    ("x", "y", "good"),
    [
        (-8.0, 0.0, True),
        (-11.885 - 0.031, 0.0, True),  # the ball overlaps the base line by 1 mm
        (-11.885 - 0.033, 0.0, False),
        (-8.0, 4.115 + 0.031, True),
        (-8.0, 4.115 + 0.033, False),
        (-8.0, -4.115 - 0.031, True),
        (-8.0, -4.115 - 0.033, False),
        (-0.02, 0.0, True),
        (0.02, 0.0, False),  # on the own side: over the net it never came
        (8.0, 0.0, False),
    ],
)
def test_the_first_bounce_of_a_return_must_be_in_the_far_court(x, y, good):
    point = step(hitter=1.0, bounce=ground(x, y))
    assert bool(point.landed[0]) is good and bool(point.bounced[0]) is good
    assert lost(point) == (NOBODY if good else NEAR)
    assert point.landed_by[0] == 1.0 or not good


@pytest.mark.parametrize(
    ("x", "y", "z", "good"),
    [
        (-0.5, 0.0, 0.78, True),
        (-1.37 - 0.015, 0.0, 0.77, True),  # on the edge
        (-1.37 - 0.018, 0.0, 0.755, False),  # against the side of the table
        (-0.5, 0.7625 + 0.01, 0.77, True),
        (-0.5, 0.0, 0.71, False),  # from below
        (0.1, 0.0, 0.78, False),  # own half first: no return
    ],
)
def test_a_return_at_the_table_must_meet_the_top_of_the_far_half(x, y, z, good):
    point = step(TABLE, hitter=1.0, bounce=board(x, y, z=z), ball=(x, y, 0.8))
    assert bool(point.landed[0]) is good
    assert lost(point) == (NOBODY if good else NEAR)


def test_a_second_bounce_is_lost_by_who_should_have_hit_the_ball():
    assert lost(step(hitter=-1.0, bounced=True, bounce=ground(12.5))) == NEAR
    assert lost(step(hitter=1.0, bounced=True, bounce=ground(-12.5))) == FAR
    # Twice in one step, as a ball that hardly rises.
    assert lost(step(hitter=-1.0, bounces=2, bounce=ground(6.0))) == NEAR
    assert lost(step(hitter=-1.0, bounces=1, bounce=ground(6.0))) == NOBODY


def test_bounce_and_stroke_in_one_step_count_in_their_order():
    # A half-volley: bounce, then stroke.
    point = step(bounce=ground(10.0, time=0.01), strokes=((0.02, (10.3, 0, 0.3)),))
    assert lost(point) == NOBODY and point.struck[0, 0]
    assert point.hitter[0] == 1.0 and not point.bounced[0]
    assert point.landed_by[0] == -1.0  # that bounce was of the machine's ball
    # Stroke, then into the ground before the net.
    point = step(bounced=True, bounce=ground(10.0, time=0.02), strokes=((0.01, (10.3, 0, 0.3)),))
    assert lost(point) == NEAR and point.struck[0, 0] and not point.landed[0]
    # A smash from the net that lands at once.
    smash = (0.01, (0.2, 0, 1.4))
    point = step(strokes=(smash,), bounce=ground(-0.3, time=0.03), ball=(-0.4, 0, 0.1))
    assert lost(point) == NOBODY and point.landed[0] and point.landed_by[0] == 1.0
    # The second bounce came before the stroke.
    point = step(bounced=True, bounce=ground(12.0, time=0.01), strokes=((0.02, (12.2, 0, 0.2)),))
    assert lost(point) == NEAR and not point.struck[0, 0]
    # Bounce, stroke and bounce: the last is on the own side.
    point = step(bounces=2, bounce=ground(10.0), strokes=((0.02, (10.3, 0, 0.3)),))
    assert lost(point) == NEAR


def test_a_second_contact_is_a_foul_until_the_other_side_has_hit_the_ball():
    """The ball carried or balanced on the racket."""
    stroke = (0.01, (10.0, 0, 1.0))
    assert lost(step(hitter=-1.0, bounced=True, strokes=(stroke,))) == NOBODY
    point = step(hitter=1.0, strokes=(stroke,))
    assert lost(point) == NEAR and not point.struck[0, 0]
    other = (0.01, (-10.0, 0, 1.0))
    assert lost(step(hitter=1.0, bounced=True, strokes=(None, other))) == NOBODY
    assert lost(step(hitter=-1.0, strokes=(None, other))) == FAR


@pytest.mark.parametrize(("x", "foul"), [(0.05, False), (-0.05, True)])
def test_a_racket_may_not_meet_the_ball_beyond_the_net(x, foul):
    assert lost(step(bounced=True, strokes=((0.01, (x, 0, 1.2)),))) == (NEAR if foul else NOBODY)
    mirrored = step(hitter=1.0, bounced=True, strokes=(None, (0.01, (-x, 0, 1.2))))
    assert lost(mirrored) == (FAR if foul else NOBODY)


def test_volleys_are_for_tennis():
    stroke = (0.01, (1.3, 0, 1.0))
    assert lost(step(TENNIS, strokes=(stroke,))) == NOBODY
    assert lost(step(TABLE, strokes=(stroke,), ball=(1.2, 0, 1.0))) == NEAR
    assert lost(step(TABLE, bounced=True, strokes=(stroke,), ball=(1.2, 0, 1.0))) == NOBODY
    # Bounced earlier in the same step.
    point = step(TABLE, bounce=board(1.2), strokes=((0.02, (1.3, 0, 0.9)),), ball=(1.2, 0, 1.0))
    assert lost(point) == NOBODY
    # Behind the end of the table a ball that has not bounced is out, whoever touches it.
    for x, loser in ((1.36, NEAR), (1.38, FAR)):
        point = step(TABLE, strokes=((0.01, (x, 0, 1.0)), None), ball=(1.2, 0, 1.0))
        assert lost(point) == loser


@pytest.mark.parametrize(
    ("court", "inside", "outside"),
    [
        (TENNIS, (15.89, 0, 1), (15.91, 0, 1)),
        (TENNIS, (-15.89, 0, 1), (-15.91, 0, 1)),
        (TABLE, (3.49, 0, 1), (3.51, 0, 1)),
        (TABLE, (1.8, 0, 0.51), (1.8, 0, 0.49)),
    ],
)
def test_a_ball_that_leaves_is_lost_by_the_receiver_after_a_good_bounce(court, inside, outside):
    for hitter, receiver_loses, hitter_loses in ((-1.0, NEAR, FAR), (1.0, FAR, NEAR)):
        assert lost(step(court, hitter, bounced=True, ball=inside)) == NOBODY
        assert lost(step(court, hitter, bounced=True, ball=outside)) == receiver_loses
        assert lost(step(court, hitter, bounced=False, ball=outside)) == hitter_loses


@pytest.mark.parametrize(("court", "height"), [(TENNIS, 8.0), (TABLE, 2.5)])
def test_a_ball_hit_too_high_is_lost(court, height):
    assert lost(step(court, hitter=1.0, ball=(1, 0, height - 0.01))) == NOBODY
    assert lost(step(court, hitter=1.0, ball=(1, 0, height + 0.01))) == NEAR


def test_what_has_no_time_counts_where_no_impact_has_decided():
    assert lost(step(late=(True,))) == NEAR
    # The return was already out when the athlete fell.
    out = step(hitter=-1.0, strokes=(None, None), bounce=ground(12.5), late=(True, False))
    assert lost(out) == FAR
    assert lost(step(strokes=(None, None), late=(True, True))) == (True, True)


def test_nothing_happens_where_nothing_is_touched():
    point = step(hitter=1.0, bounced=True, ball=(-12.0, 0, 1))
    assert lost(point) == NOBODY and point.hitter[0] == 1.0 and point.bounced[0]
    assert not point.struck.any() and not point.landed.any()


# Random steps of two athletes, judged by an umpire who takes one event after the other.


def random_touches(n: int, generator: torch.Generator) -> tuple:
    def some(*shape):
        return torch.rand(*shape, generator=generator)

    strokes = (some(n, 2) < 0.4).int()
    bounces = torch.randint(0, 3, (n,), generator=generator).int()
    spread = torch.tensor((2.0, 1.2, 0.0))

    def places(*shape):
        spots = (2 * some(*shape, 3) - 1) * spread
        spots[..., 2] = 0.7 + 0.15 * some(*shape)
        return spots

    time = 0.03 * some(n, 3)
    touch = Touches(
        bounces,
        time[:, 0].masked_fill(bounces == 0, torch.inf),
        places(n),
        strokes,
        time[:, 1:].masked_fill(strokes == 0, torch.inf),
        places(n, 2),
    )
    hitter = torch.where(some(n) < 0.5, 1.0, -1.0)
    ball = places(n) * torch.tensor((2.2, 1.0, 1.0))
    ball[:, 2] = 3.0 * some(n)
    return hitter, some(n) < 0.5, touch, ball, some(n, 2) < 0.2


def umpire(court: Court, hitter, bounced, touch: Touches, ball, late, i: int) -> dict:
    """World ``i``, event by event."""
    side_of = (1.0, -1.0)
    state = {"hitter": float(hitter[i]), "bounced": bool(bounced[i])}
    events = []
    times = touch.stroke_time[i].tolist()
    first_stroke = min(times)
    for k in range(int(touch.bounces[i])):
        # The place of the first bounce alone is known; a second one follows at once or, where a
        # stroke came between them, after it and on the striker's side.
        start = float(touch.bounce_time[i])
        after = k > 0 and start < first_stroke < math.inf
        place = None if after else touch.bounce_pos[i].tolist()
        events.append((1.0 if after else start + 1e-6 * k, "bounce", place))
    for agent in range(2):
        if touch.strokes[i, agent]:
            events.append((times[agent], agent, touch.stroke_pos[i, agent].tolist()))
    lost = {1.0: False, -1.0: False}
    struck, landed, landed_by = [False, False], False, 0.0
    fouls: list[float] = []
    for _, what, place in sorted(events, key=lambda e: e[0]):
        if any(lost.values()) or (fouls and what == "bounce"):
            break
        receiver = -state["hitter"]
        if what == "bounce":
            if state["bounced"]:
                lost[receiver] = True
            else:
                good = place is not None and (
                    abs(place[0]) <= court.half_length + court.line
                    and abs(place[1]) <= court.half_width + court.line
                    and place[2] >= court.height
                    and place[0] * receiver > 0
                )
                if good:
                    state["bounced"], landed, landed_by = True, True, state["hitter"]
                else:
                    lost[state["hitter"]] = True
            continue
        side = side_of[what]
        fresh_volley = not court.volleys and not state["bounced"] and side == receiver
        if fresh_volley and abs(place[0]) > court.half_length:
            lost[state["hitter"]] = True
        elif side != receiver or place[0] * side < 0 or fresh_volley:
            fouls.append(side)
            state["hitter"], state["bounced"] = side, False
        else:
            struck[what] = True
            state["hitter"], state["bounced"] = side, False
    for side in fouls:
        lost[side] = True
    if not any(lost.values()):
        x, _, z = ball[i].tolist()
        high = z > court.ceiling
        if high or z < court.floor or abs(x) > court.behind:
            loser = -state["hitter"] if state["bounced"] and not high else state["hitter"]
            lost[loser] = True
        for agent in range(2):
            lost[side_of[agent]] |= bool(late[i, agent])
    return {
        "lost": (lost[1.0], lost[-1.0]),
        "struck": tuple(struck),
        "landed": landed,
        "landed_by": landed_by,
        "hitter": state["hitter"],
        "bounced": state["bounced"],
    }


@pytest.mark.parametrize("court", [TENNIS, TABLE, dataclasses.replace(TABLE, volleys=True)])
def test_the_batch_agrees_with_an_umpire_who_takes_one_event_after_the_other(court):
    n = 4000
    situation = random_touches(n, torch.Generator().manual_seed(5))
    touch = situation[2]
    point = play(court, *situation)
    # Two strokes and a bounce within 33 ms do not happen: rackets are metres apart.
    crowd = (touch.strokes.sum(1) == 2) & ((touch.bounces > 0) | ~torch.tensor(court.volleys))
    wins = 0
    for i in (~crowd).nonzero()[:, 0].tolist():
        said = umpire(court, *situation, i)
        assert tuple(point.lost[i].tolist()) == said["lost"], (i, said)
        assert bool(point.landed[i]) == said["landed"], (i, said)
        if said["landed"]:
            assert point.landed_by[i] == said["landed_by"], (i, said)
        if not any(said["lost"]):
            assert tuple(point.struck[i].tolist()) == said["struck"], (i, said)
            assert point.hitter[i] == said["hitter"] and bool(point.bounced[i]) == said["bounced"]
        wins += said["lost"] in (NEAR, FAR)
    assert wins > 1000  # the comparison was about something


def turned(touch: Touches) -> Touches:
    """The court turned by 180 degrees, the athletes swapped."""
    half_turn = torch.tensor((-1.0, -1.0, 1.0))
    return Touches(
        touch.bounces,
        touch.bounce_time,
        touch.bounce_pos * half_turn,
        touch.strokes.flip(1),
        touch.stroke_time.flip(1),
        touch.stroke_pos.flip(1) * half_turn,
    )


@pytest.mark.parametrize("court", [TENNIS, TABLE])
def test_the_rules_are_the_same_for_both_sides(court):
    hitter, bounced, touch, ball, late = random_touches(2000, torch.Generator().manual_seed(6))
    here = play(court, hitter, bounced, touch, ball, late)
    half_turn = torch.tensor((-1.0, -1.0, 1.0))
    there = play(court, -hitter, bounced, turned(touch), ball * half_turn, late.flip(1))
    assert torch.equal(here.lost, there.lost.flip(1))
    assert torch.equal(here.struck, there.struck.flip(1))
    assert torch.equal(here.landed, there.landed) and torch.equal(here.bounced, there.bounced)
    assert torch.equal(here.hitter, -there.hitter)


@pytest.mark.parametrize("court", [TENNIS, TABLE])
def test_worlds_do_not_know_of_each_other(court):
    situation = random_touches(500, torch.Generator().manual_seed(7))
    order = torch.randperm(500, generator=torch.Generator().manual_seed(8))
    hitter, bounced, touch, ball, late = situation
    shuffled = Touches(*(t[order] for t in touch))
    here = play(court, *situation)
    there = play(court, hitter[order], bounced[order], shuffled, ball[order], late[order])
    for name, value in vars(here).items():
        assert torch.equal(value[order], getattr(there, name)), name


# The ball and the body.


@pytest.fixture(scope="module")
def standing():
    """An athlete with a racket in the T-pose at the origin, facing +x."""
    body = load_body(equipment=("racket",))
    physics = make_physics("mujoco", humanoid_scene(body), 1, threads=1)
    return SimpleNamespace(physics=physics, geometry=Geometry(body, "cpu"))


def bumped(standing, *way: tuple[float, float, float]) -> bool:
    return bool(met(standing, torch.tensor([way]), BODY_DISTANCE, HAND)[0, 0])


def test_a_ball_that_flies_through_the_body_has_met_it(standing):
    pelvis = standing.physics.body_pos[0, 0, 0].tolist()
    z = pelvis[2]
    assert bumped(standing, (-0.4, 0, z), (0.4, 0, z))  # 24 m/s: at neither end near
    assert not bumped(standing, (-0.9, 0, z), (-0.4, 0, z))
    assert not bumped(standing, (0.4, 0, z), (0.9, 0, z))
    # Round the corner: straight from the first to the last point it would have missed.
    assert bumped(standing, (-0.9, 0, z), (-0.1, 0, z), (-0.9, 0.3, z))
    assert not bumped(standing, (-0.9, 0, z), (-0.9, 0.1, z), (-0.9, 0.3, z))


def test_the_distance_to_the_body_is_measured_to_origins_and_centres_of_links(standing):
    body = standing.physics.scene.body
    knee = standing.physics.body_pos[0, 0, body.link_index("L_Knee")].tolist()
    for gap, near in ((0.149, True), (0.151, False)):
        # Past the knee in front of it, downwards no nearer to anything else.
        x = knee[0] + gap
        assert bumped(standing, (x, knee[1] - 0.3, knee[2]), (x, knee[1] + 0.3, knee[2])) is near
    head = standing.physics.body_pos[0, 0, body.link_index("Head")].tolist()
    assert bumped(standing, (head[0] + 0.5, head[1], head[2] + 0.15), (head[0], head[1], 1.7))


def test_the_racket_and_the_hand_that_holds_it_may_meet_the_ball(standing):
    body = standing.physics.scene.body
    wrist = standing.physics.body_pos[0, 0, body.link_index("R_Wrist")]
    for reach in (0.1, 0.35):  # hand, middle of the strings; from above
        x, y, z = (wrist + torch.tensor((0.0, -reach, 0.03))).tolist()
        assert not bumped(standing, (x, y, z + 0.5), (x, y, z))
    elbow = standing.physics.body_pos[0, 0, body.link_index("R_Elbow")].tolist()
    assert bumped(standing, (elbow[0], elbow[1], elbow[2] + 0.5), (elbow[0], elbow[1], elbow[2]))
