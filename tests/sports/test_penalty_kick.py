"""The penalty kick's rules on states made by hand, with known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sports.env import make_env
from sports.penalty_kick import velocity_lacking
from tests.sports.pitch import Pitch, seen_from, total

STANDING = 0.9412
BALL = (4.0, 0.0, 0.11)
TARGET = (16.0, 1.0, 1.0)


def kicker(
    root=(3.0, 0.14), target=TARGET, ball=BALL, vel=(0.0, 0.0, 0.0), clock=5, **options
) -> Pitch:
    pitch = Pitch("penalty_kick", **options)
    pitch.stand(0, *root)
    pitch.ball(ball, vel)
    pitch.begin(clock, target=torch.tensor([target]))
    return pitch


def shot(at, *, touched=True, target=TARGET, before=(-0.4, 0.0, 0.0), vel=(24.0, 0.0, 0.0)):
    """A step in which the ball passes the goal plane at ``at`` (y, z), in the middle of it."""
    plane = (16.0, *at)
    pitch = kicker(ball=tuple(p + b for p, b in zip(plane, before)), target=target)
    pitch.env.memory["touched"][:] = touched
    pitch.ball(tuple(p - b for p, b in zip(plane, before)), vel)
    return pitch.advance()


def test_the_start_is_the_spot_and_the_targets_are_in_the_goal():
    env = make_env("penalty_kick", num_worlds=256, seed=3)
    root = env.physics.body_pos[:, 0, 0]
    assert (root[:, :2] - torch.tensor((3.0, 0.14))).abs().max() < 1e-6
    assert (env.physics.object_pos[:, 0] - torch.tensor(BALL)).abs().max() < 1e-6
    target = env.memory["target"]
    assert (target[:, 0] == 16.0).all()
    for axis, low, high in ((1, -1.8, 1.8), (2, 0.2, 1.8)):
        values = target[:, axis]
        assert low <= values.min() < low + 0.1 and high - 0.1 < values.max() <= high
    assert (env.age == 0).all() and env.max_steps == 120 and env.reward_scale == 10.0


def test_the_features_are_what_a_turned_kicker_sees():
    pitch = kicker()
    yaw, root = 0.7, (2.0, -1.0, STANDING)
    pitch.stand(0, root[0], root[1], yaw)
    pitch.ball((5.0, 1.0, 0.5), (3.0, -2.0, 1.0))
    got = {k: v[0, 0].tolist() for k, v in pitch.features().items()}
    assert sum(map(len, got.values())) == 24
    here = (0.0, 0.0, 0.0)
    want = {
        "ball_position": seen_from((5.0, 1.0, 0.5), root, yaw),
        # The ball is not turned: its x axis and y axis as seen from the heading.
        "ball_rotation": seen_from((1, 0, 0), here, yaw) + seen_from((0, 1, 0), here, yaw),
        "ball_velocity": seen_from((3.0, -2.0, 1.0), here, yaw) + [0.0, 0.0, 0.0],
        "target": seen_from(TARGET, (5.0, 1.0, 0.5), yaw),
        "goal": seen_from((16, -2, 0), root, yaw)[:2] + seen_from((16, 2, 0), root, yaw)[:2],
        "spot": seen_from((4, 0, 0), root, yaw)[:2],
    }
    assert list(got) == list(want)
    for name, values in want.items():
        assert got[name] == pytest.approx(values, abs=2e-3), name


def test_before_the_kick_walking_to_the_ball_pays():
    pitch = kicker()
    before = math.dist((3.0, 0.14, STANDING), BALL)
    pitch.stand(0, 3.2, 0.14)
    step = pitch.advance()
    gained = before - math.dist((3.2, 0.14, STANDING), BALL)
    assert step.terms["approach"][0, 0] == pytest.approx(0.4 * gained, abs=1e-4)
    assert total(step)[0, 0] == pytest.approx(0.4 * gained, abs=1e-4)
    pitch.stand(0, 3.0, 0.14)
    assert pitch.advance().terms["approach"][0, 0] == pytest.approx(-0.4 * gained, abs=1e-4)


def test_a_foot_is_led_to_the_ball_by_the_metre_and_once():
    """By the nearer ankle, until the ball is kicked."""
    pitch = kicker(reach=2.0)
    body = pitch.env.physics.scene.body
    ankles = [body.link_index(name) for name in ("L_Ankle", "R_Ankle")]

    def nearest() -> float:
        feet = pitch.env.physics.body_pos[0, 0, ankles] - torch.tensor(BALL)
        return float(feet.norm(dim=-1).min())

    begin = nearest()
    paid = 0.0
    for x in (3.2, 3.0, 3.4):
        pitch.stand(0, x, 0.14)
        paid += float(pitch.advance().terms["reach"][0, 0])
    assert paid == pytest.approx(2.0 * (begin - nearest()), abs=1e-4)
    pitch.stand(0, 3.5, 0.14)
    assert pitch.advance("agent0/R_Toe").terms["reach"][0, 0] > 0.0
    pitch.stand(0, 3.6, 0.14)
    assert pitch.advance().terms["reach"][0, 0] == 0.0
    assert "reach" not in kicker().advance().terms
    with pytest.raises(ValueError, match="must not be negative"):
        make_env("penalty_kick", num_worlds=1, options={"reach": -1.0})


@pytest.mark.parametrize(("link", "pays"), [("R_Toe", True), ("Pelvis", False), ("L_Hand", False)])
def test_a_touch_against_the_rules_pays_nothing_for_the_ball(link, pays):
    """PPO slid into the ball with its pelvis for the reward of that one step (78 M samples)."""
    pitch = kicker()
    pitch.ball((4.3, 0.02, 0.2), (12.0, 1.0, 2.0))
    terms = pitch.advance(f"agent0/{link}").terms
    for name in ("progress", "speed", "aim"):
        assert (float(terms[name][0, 0]) > 0.0) is pays, name


def test_rounding_is_no_approach_of_the_ball():
    for moved, closer in ((0.0008, False), (0.0012, True)):
        pitch = kicker(target=(16.0, 0.0, 0.11))
        pitch.stand(0, 3.2, 0.14)
        pitch.ball((4.0 + moved, 0.0, 0.11), (0.1, 0.0, 0.0))
        step = pitch.advance()
        assert (step.terms["approach"][0, 0] == 0.0) == closer
        assert (step.terms["progress"][0, 0] > 0.0) == closer


def test_a_ball_on_its_way_pays_by_the_formula():
    pitch = kicker(ball=(9.0, 0.4, 0.8))
    pos, vel = (9.5, 0.43, 0.9), (15.0, 1.0, 3.0)
    pitch.ball(pos, vel)
    step = pitch.advance("agent0/R_Toe")
    gain = math.dist((9.0, 0.4, 0.8), TARGET) - math.dist(pos, TARGET)
    way = [t - p for t, p in zip(TARGET, pos)]
    speed = sum(v * w for v, w in zip(vel, way)) / math.hypot(*way) / 30.0
    time = (16.0 - 9.5) / 15.0
    entry = (16.0, 0.43 + time, 0.9 + 3.0 * time - 9.81 / 2 * time**2)
    want = {
        "approach": 0.0,
        "progress": 0.1 * gain,
        "speed": 0.1 * speed,
        "aim": 0.8 * math.exp(-5.0 * math.dist(entry, TARGET) ** 2),
        "line": 0.0,
    }
    assert set(step.terms) == set(want)
    for name, value in want.items():
        assert step.terms[name][0, 0] == pytest.approx(value, abs=1e-5), name


def test_a_ball_that_would_fall_short_is_expected_on_the_ground():
    target = (16.0, 0.0, 0.3)
    pitch = kicker(ball=(6.0, 0.0, 0.3), target=target)
    pitch.ball((6.3, 0.0, 0.3), (9.0, 0.0, 0.0))
    step = pitch.advance("agent0/R_Toe")
    assert step.terms["aim"][0, 0] == pytest.approx(0.8 * math.exp(-5 * 0.19**2), abs=1e-5)


def test_a_wider_aim_is_felt_from_further_away():
    """1.5 m beside the target: nothing by the paper's width, exp(-9/4) of it by one of 1 m."""
    off = math.hypot(1.5, 0.19)
    for width, paid in ((None, math.exp(-5.0 * off**2)), (1.0, math.exp(-(off**2)))):
        options = {} if width is None else {"aim_width": width}
        pitch = kicker(ball=(6.0, 1.5, 0.3), target=(16.0, 0.0, 0.3), **options)
        pitch.ball((6.3, 1.5, 0.3), (9.0, 0.0, 0.0))
        step = pitch.advance("agent0/R_Toe")
        assert step.terms["aim"][0, 0] == pytest.approx(0.8 * paid, abs=1e-6)
    with pytest.raises(ValueError, match="positive"):
        make_env("penalty_kick", num_worlds=1, options={"aim_width": 0.0})


@pytest.mark.parametrize("linvel", [(3.7, 0.0, 0.0), (9.0, 1.0, 4.0), (15.0, -2.0, 0.5)])
def test_what_a_ball_lacks_to_fly_to_its_target(linvel):
    """The least change of velocity, by scipy over all times of flight; none on the way there."""
    from scipy.optimize import minimize_scalar

    ball, target = np.array([4.0, 0.0, 0.11]), np.array(TARGET)

    def wanted(time: float) -> np.ndarray:
        return (target - ball) / time + (0.0, 0.0, 9.81 / 2 * time)

    def lacks(place: np.ndarray, velocity: np.ndarray) -> float:
        rows = (torch.tensor(x, dtype=torch.float32)[None] for x in (place, velocity, target))
        return float(velocity_lacking(*rows))

    least = minimize_scalar(
        lambda time: np.linalg.norm(wanted(time) - linvel), bounds=(0.05, 2.5), method="bounded"
    )
    assert lacks(ball, np.array(linvel)) == pytest.approx(least.fun, abs=0.1)
    assert least.fun <= lacks(ball, np.array(linvel)) + 1e-5
    fly = wanted(1.1)
    for t in (0.0, 0.3, 0.7, 1.0):
        place = ball + fly * t - (0.0, 0.0, 9.81 / 2 * t**2)
        assert lacks(place, fly - (0.0, 0.0, 9.81 * t)) < 0.06 * np.linalg.norm(fly)


def test_a_kick_pays_for_the_velocity_that_it_gives_the_ball_and_once():
    """From what a ball at rest lacks, sqrt(g (d + z)) for a target d away and z above it, down to
    nothing; not for a ball that slows, nor later than a fifth of a second after the touch."""
    target = (16.0, 0.0, 0.11)
    rest = math.sqrt(9.81 * 12.0)
    time = 12.0 / 9.0
    best = (9.0, 0.0, 9.81 / 2 * time)
    half = tuple(0.5 * v for v in best)

    def pays(pitch: Pitch, linvel, *touching: str) -> float:
        pitch.ball((4.0, 0.0, 0.11), linvel)
        return float(pitch.advance(*touching).terms["flight"][0, 0])

    pitch = kicker(target=target, flight=2.0)
    first = pays(pitch, half, "agent0/R_Toe")
    assert pays(pitch, (0.0, 0.0, 0.0)) == 0.0
    assert pays(pitch, half) == 0.0
    spacing = 0.05 * math.hypot(*best)  # of the times of flight that are compared
    assert first + pays(pitch, best) == pytest.approx(2.0 * rest, abs=2.0 * spacing)
    late = kicker(target=target, flight=2.0)
    pays(late, (0.0, 0.0, 0.0), "agent0/R_Toe")
    for _ in range(6):
        assert pays(late, (0.0, 0.0, 0.0)) == 0.0
    assert pays(late, best) == 0.0
    by_hand = kicker(target=target, flight=2.0)
    assert pays(by_hand, best, "agent0/R_Wrist") == 0.0
    with pytest.raises(ValueError, match="flight"):
        make_env("penalty_kick", num_worlds=1, options={"flight": -1.0})


@pytest.mark.parametrize(("clock", "pays"), [(88, True), (90, False)])
def test_the_aim_counts_only_if_the_ball_arrives_in_time(clock, pays):
    """10 m at 10 m/s take 30 steps; after the step 31 or 29 are left."""
    target = (16.0, 0.0, 0.11)
    pitch = kicker(ball=(5.8, 0.0, 0.11), target=target, clock=clock)
    pitch.ball((6.0, 0.0, 0.11), (10.0, 0.0, 0.0))
    assert (pitch.advance("agent0/R_Toe").terms["aim"][0, 0] > 0.7) == pays


def test_running_past_the_spot_costs():
    for x, cost in ((3.9, 0.0), (5.0, 1 - math.exp(-0.2)), (5.9, 1 - math.exp(-0.2 * 1.9**2))):
        pitch = kicker(root=(x, 0.14))
        assert pitch.advance().terms["line"][0, 0] == pytest.approx(-cost, abs=1e-5)


@pytest.mark.parametrize(("x", "out"), [(5.98, False), (6.02, True)])
def test_the_kicker_may_not_run_on(x, out):
    pitch = kicker(root=(x, 3.0))
    assert bool(pitch.advance().terminated[0, 0]) is out


def test_a_fall_ends_it_only_before_the_kick():
    for touched in (False, True):
        pitch = kicker()
        pitch.env.memory["touched"][:] = touched
        assert bool(pitch.advance(down=(0,)).terminated[0, 0]) is not touched


@pytest.mark.parametrize(("steps", "ends"), [(30, False), (31, True)])
def test_a_second_touch_ends_it(steps, ends):
    """The first touch may last, or be two steps on the ball, for 1.0 s."""
    pitch = kicker()
    assert not pitch.advance("agent0/R_Toe").terminated[0, 0]
    for _ in range(steps - 1):
        assert not pitch.advance().terminated[0, 0]
        pitch.env.memory["rest"][:] = 0.0
    assert bool(pitch.advance("agent0/R_Toe").terminated[0, 0]) is ends


@pytest.mark.parametrize(("link", "foul"), [("R_Toe", 0), ("L_Hand", 1), ("R_Elbow", 1)])
def test_hands_and_arms_may_not_play_the_ball(link, foul):
    step = kicker().advance(f"agent0/{link}")
    assert bool(step.terminated[0, 0]) == bool(foul)
    assert step.metrics["handling"][0] == float(foul)
    assert step.metrics["touched"][0] == 1.0 and step.metrics["kicked"][0] == 1.0 - foul


@pytest.mark.parametrize("link", ["Pelvis", "Chest", "Head"])
def test_a_kick_is_done_with_a_leg(link):
    """Who sits down on the ball has not kicked it; after the kick it may bounce off the body."""
    step = kicker().advance(f"agent0/{link}")
    assert step.terminated[0, 0] and step.metrics["kicked"][0] == 0.0
    pitch = kicker()
    step = pitch.advance("agent0/L_Knee", f"agent0/{link}")
    assert not step.terminated[0, 0] and step.metrics["kicked"][0] == 1.0
    step = pitch.advance(f"agent0/{link}")
    assert not step.terminated[0, 0] and step.metrics["kicked"][0] == 1.0


@pytest.mark.parametrize(
    ("at", "success"), [((1.0, 1.49), 1), ((1.0, 1.51), 0), ((0.51, 1.0), 1), ((0.49, 1.0), 0)]
)
def test_success_is_within_half_a_metre_of_the_target(at, success):
    step = shot(at)
    assert step.terminated[0, 0] and step.metrics["goal"][0] == 1.0
    assert step.success[0] == bool(success) == bool(step.metrics["success"][0])
    if success:
        miss = math.dist((16.0, *at), TARGET)
        assert step.metrics["error"][0] == pytest.approx(miss, abs=1e-4)
    else:
        assert step.metrics["error"].isnan().all()
    assert step.remaining_paid is not None and step.remaining_paid[0]


@pytest.mark.parametrize(
    ("at", "goal"),
    [((1.99, 1.0), 1), ((2.01, 1.0), 0), ((-1.99, 1.0), 1), ((1.0, 1.99), 1), ((1.0, 2.01), 0)],
)
def test_the_goal_is_4_by_2_metres(at, goal):
    step = shot(at)
    assert step.terminated[0, 0]
    assert step.metrics["goal"][0] == float(goal)
    assert step.remaining_paid is not None and bool(step.remaining_paid[0]) == bool(goal)


def test_the_crossing_is_interpolated_within_the_step():
    """It passes the plane a quarter of the way through the step, where it is 0.30 m from the
    target; at either end of the step it is further off."""
    before = (-0.2, -0.15, 0.1)
    after = tuple(-3 * b for b in before)
    plane = (16.0, 1.0, 1.3)
    pitch = kicker(ball=tuple(p + b for p, b in zip(plane, before)))
    pitch.env.memory["touched"][:] = True
    pitch.ball(tuple(p + a for p, a in zip(plane, after)), (24.0, 18.0, -12.0))
    step = pitch.advance()
    assert step.success[0]
    assert step.metrics["error"][0] == pytest.approx(0.3, abs=1e-4)
    # The reward of that step, which is paid on, is that of the place where it crossed.
    assert step.terms["aim"][0, 0] == pytest.approx(0.8 * math.exp(-5 * 0.3**2), abs=1e-4)
    assert step.terms["approach"][0, 0] == 0.0 and total(step)[0, 0] > 0.5


def test_a_ball_that_nobody_kicked_is_no_goal():
    step = shot((1.0, 1.0), touched=False)
    assert not step.success[0] and step.metrics["goal"][0] == 0.0


@pytest.mark.parametrize(
    ("ball", "out"),
    [((9.0, 9.9, 0.3), 0), ((9.0, 10.1, 0.3), 1), ((-15.9, 0, 0.3), 0), ((-16.1, 0, 0.3), 1)],
)
def test_a_ball_off_the_field_ends_it(ball, out):
    pitch = kicker(ball=(ball[0], ball[1] * 0.99, ball[2]))
    pitch.ball(ball, (0.0, 5.0, 0.0))
    step = pitch.advance("agent0/R_Toe")
    assert bool(step.terminated[0, 0]) == bool(out)
    assert step.remaining_paid is not None and not step.remaining_paid[0]


def test_a_ball_at_rest_ends_it_after_half_a_second():
    pitch = kicker()
    pitch.advance("agent0/R_Toe")
    ends = []
    for k in range(20):
        pitch.ball(BALL, (0.09 if k else 0.11, 0.0, 0.0))
        ends.append(bool(pitch.advance().terminated[0, 0]))
    assert ends == [False] * 15 + [True] * 5
    # In the air at the top of its flight it is not at rest, and untouched it lies where it lay.
    pitch = kicker(ball=(8.0, 0.0, 2.0))
    pitch.advance("agent0/R_Toe")
    assert not any(bool(pitch.advance().terminated[0, 0]) for _ in range(20))
    pitch = kicker()
    assert not any(bool(pitch.advance().terminated[0, 0]) for _ in range(20))


def test_random_kickers_for_200_steps():
    env = make_env("penalty_kick", num_worlds=32, seed=2, physics_options={"threads": 1})
    generator = torch.Generator().manual_seed(0)
    ended, touched = 0, 0.0
    for _ in range(200):
        result = env.step(0.5 * torch.randn(32, 1, 69, generator=generator))
        assert torch.isfinite(result.obs).all() and torch.isfinite(result.reward).all()
        assert result.valid.all()
        ended += int(result.ended.sum())
        touched += float(result.metrics["touched"][result.ended].sum())
    assert env.physics.nan_worlds == 0
    assert ended > 50 and touched > 0
