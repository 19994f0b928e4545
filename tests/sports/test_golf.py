"""Golf's rules on states made by hand, its turf against closed forms, and strokes in the engine."""

import math

import numpy as np
import pytest
import torch

from sports.ball import BALLS, landing, landing_on_waves
from sports.ball import path as ball_path
from sports.ball_law.compiled import for_gpu
from sports.env import Env, make_env
from sports.golf import HEAD, SHAFT, TEE, TURF, WAVES, head_pos, turf_height
from sports.humanoid import load_body
from sports.physics import PhysicsState
from sports.task import Advance
from tests.sports.hand_made import HandMade

STANDING = 0.9417
ON_TEE = (0.0, 0.0, 0.05 + 0.02135)
FACING_MINUS_Y = (math.cos(-math.pi / 4), 0.0, 0.0, math.sin(-math.pi / 4))


class Stroke(HandMade):
    """An athlete at its place, a ball and its hits as the test wants them."""

    def __init__(self, num_worlds: int = 1, **options: object) -> None:
        chosen = {"terrain": "flat", "distance": 10.0} | options
        super().__init__("golf", num_worlds, **chosen)
        self.hits: dict[int, float] = {}
        self.hit_at = (0.0, 0.0, 0.0)

    def ball(self, pos: tuple[float, float, float], linvel=(0.0, 0.0, 0.0)) -> None:
        scene = self.env.physics.scene
        self.state.qpos[:, scene.object_qpos("ball")][:, :3] = torch.tensor(pos)
        self.state.qvel[:, scene.object_qvel("ball")][:, :3] = torch.tensor(linvel)

    def _apply(self) -> None:
        super()._apply()
        physics = self.env.physics
        for surface, time in self.hits.items():
            physics.ball_hits[:, surface] = 1
            physics.ball_hit_time[:, surface] = time
            physics.ball_hit_pos[:, surface] = torch.tensor(self.hit_at)

    def step(self, hits=(), at=(0.0, 0.0, 0.0), forces=None):
        """A control step in which the ball met these surfaces, at one place: 0.01 s after it began
        or when a dict says."""
        self.hits = dict(hits) if isinstance(hits, dict) else dict.fromkeys(hits, 0.01)
        self.hit_at = at
        step = self.advance(forces)
        self.hits = {}
        return step


def addressed(**options: object) -> Stroke:
    stroke = Stroke(1, **options)
    stroke.begin()
    return stroke


def struck(**options: object) -> Stroke:
    """A ball just hit, 0.5 m on its way."""
    stroke = addressed(**options)
    stroke.ball((0.5, 0.0, 0.3), (12.0, 0.0, 4.0))
    assert not stroke.step([HEAD]).terminated[0, 0]
    return stroke


def paid_on(step: Advance) -> bool:
    assert step.remaining_paid is not None
    return bool(step.remaining_paid[0])


# The turf.


def test_the_turf_is_what_its_statement_says():
    generator = torch.Generator().manual_seed(0)
    phases = 2 * math.pi * torch.rand(50, 2, generator=generator)
    angle = torch.linspace(0, 2 * math.pi, 40)
    near = 2.0 * torch.linspace(0, 1, 40)
    assert (turf_height(near * angle.cos(), near * angle.sin(), phases[:1]) == 0).all()
    # Outside 6 m two waves 10 m long, 1 m from crest to trough.
    away = 6.0 + 30.0 * torch.rand(50, 3000, generator=generator)
    turn = 2 * math.pi * torch.rand(50, 3000, generator=generator)
    x, y = away * turn.cos(), away * turn.sin()
    a, b = phases[:, :1], phases[:, 1:]
    k = 2 * math.pi / 10
    wave = 0.25 * (torch.cos(k * x + a) + torch.cos(k * y + b))
    height = turf_height(x, y, phases)
    torch.testing.assert_close(height, wave, rtol=0, atol=1e-6)
    assert float(height.max() - height.min()) == pytest.approx(1.0, abs=0.01)
    # Half-way, at 4 m, half of it.
    four = torch.full((50,), 4.0)
    half = turf_height(four, 0 * four, phases)
    torch.testing.assert_close(half, 0.125 * (torch.cos(4 * k + a) + torch.cos(b))[:, 0])


def test_the_turf_is_smooth_and_nowhere_too_steep_for_a_ball_to_rest():
    """Finite differences: no jump of slope at 2 m and 6 m, and gravity pulls a ball along the
    steepest slope of any waves with less than the 3 m/s^2 that hold it."""
    phases = 2 * math.pi * torch.rand(40, 2, generator=torch.Generator().manual_seed(1)).double()
    along = torch.linspace(-12, 12, 161, dtype=torch.float64)
    x, y = (v.flatten().expand(40, -1) for v in torch.meshgrid(along, along, indexing="ij"))
    h = 1e-5

    def slope(x, y):
        dx = turf_height(x + h, y, phases) - turf_height(x - h, y, phases)
        dy = turf_height(x, y + h, phases) - turf_height(x, y - h, phases)
        return torch.stack((dx, dy)) / (2 * h)

    steepest = float(slope(x, y).norm(dim=0).max())
    pull = 9.81 * math.sin(math.atan(steepest))
    print(f"steepest slope {steepest:.3f}, pull {pull:.2f} m/s^2")
    assert pull < 3.0
    for radius in (2.0, 6.0):
        angle = torch.linspace(0, 2 * math.pi, 60, dtype=torch.float64).expand(40, -1)
        inside, outside = (
            slope((radius + e) * angle.cos(), (radius + e) * angle.sin()) for e in (-1e-4, 1e-4)
        )
        assert (inside - outside).abs().max() < 1e-3


# What is seen.


def test_features_are_ball_head_target_and_heights_in_this_order():
    stroke = Stroke(terrain="waves", distance=12.0)
    stroke.begin()
    env = stroke.env
    seen = env.task.features(env.view, env.memory)
    assert [(k, v.shape[-1]) for k, v in seen.items()] == [
        ("ball", 3),
        ("head", 3),
        ("target", 3),
        ("heights", 1024),
    ]
    # Facing -y: ahead is -y, left is +x.
    ball, target = seen["ball"][0, 0], seen["target"][0, 0]
    at_target = turf_height(torch.tensor([12.0]), torch.zeros(1), stroke.context["phases"])
    expected = torch.tensor((1.0, 0.0, ON_TEE[2] - STANDING))
    torch.testing.assert_close(ball, expected, rtol=0, atol=1e-3)
    expected = torch.tensor((1.0, 12.0, float(at_target) - STANDING))
    torch.testing.assert_close(target, expected, rtol=0, atol=1e-3)
    # The T-pose: the club points to the right, 1.14 m beyond the hand.
    body = load_body(equipment=["club"])
    hand = body.zero_pose_origins()[body.link_index("R_Hand")]
    expected = torch.tensor((hand[0], hand[1] - 1.14, hand[2]), dtype=torch.float32)
    torch.testing.assert_close(seen["head"][0, 0], expected, rtol=0, atol=1e-4)
    for i, j in ((0, 0), (31, 0), (0, 31), (17, 5), (31, 31)):
        x, y = torch.tensor([20.0 * i / 31]), torch.tensor([-10.0 + 20.0 * j / 31])
        height = turf_height(x, y, stroke.context["phases"])
        assert float(seen["heights"][0, 0, 32 * i + j]) == pytest.approx(float(height), abs=1e-5)


def test_flat_turf_is_seen_flat():
    stroke = addressed()
    seen = stroke.env.task.features(stroke.env.view, stroke.env.memory)
    assert (seen["heights"] == 0).all() and stroke.env.memory["target"][0, 2] == 0


def test_targets_are_drawn_from_their_ranges():
    for training, least in ((True, 1.0), (False, 0.0)):
        env = make_env("golf", num_worlds=600, training=training, physics_options={"threads": 2})
        x = env.memory["target"][:, 0]
        assert least <= x.min() < least + 0.2 and 19.8 < x.max() <= 20.0
        assert float(x.mean()) == pytest.approx((least + 20) / 2, abs=0.8)
        phases = env.memory["phases"]
        assert 0 <= phases.min() and phases.max() < 2 * math.pi and phases.std() > 1.5
        env.close()


# Rewards.


def test_rewards_before_the_contact():
    stroke = addressed()
    head = head_pos(stroke.env.view)[0]
    stroke.ball(tuple((head + torch.tensor((0.06, 0.08, 0.0))).tolist()))
    step = stroke.step()
    assert step.terms["approach"][0, 0] == pytest.approx(math.exp(-100 * 0.01), rel=1e-3)
    assert all(v[0, 0] == 0 for name, v in step.terms.items() if name != "approach")
    assert "reach" not in step.terms


def test_rewards_after_the_contact():
    """A contact in this step is an "after": 1, the progress, and both distances to the target."""
    for squared in (False, True):
        stroke = addressed(squared=squared)
        stroke.ball((0.4, 0.3, 0.3), (0.0, 0.0, -1.0))
        step = stroke.step([HEAD])
        gained = math.dist(ON_TEE, (10, 0, 0)) - math.dist((0.4, 0.3, 0.3), (10, 0, 0))
        aside = math.hypot(9.6, 0.3)
        assert step.terms["approach"][0, 0] == 0 and step.terms["contact"][0, 0] == 1
        assert step.terms["progress"][0, 0] == pytest.approx(gained, abs=1e-5)
        # It falls straight down, so that it will land where it is.
        for name in ("ball", "landing"):
            near = math.exp(-0.1 * (aside**2 if squared else aside))
            assert step.terms[name][0, 0] == pytest.approx(near, rel=1e-3)
        # A step later it has come to a halt in the air, further from the target: no loss.
        stroke.ball((0.3, 0.3, 0.3))
        assert stroke.step().terms["progress"][0, 0] == 0


def test_the_first_landing_counts_and_not_the_place_after_it():
    stroke = struck()
    before = stroke.env.memory["landing"][0, :2].clone()
    assert before[0] > 3.0 and before[1] == 0  # predicted in the air
    stroke.ball((7.0, 0.5, 0.2), (3.0, 0.0, 1.0))
    step = stroke.step([TURF], at=(6.0, 0.4, 0.02135))
    aside = math.hypot(4.0, 0.4)
    assert step.terms["landing"][0, 0] == pytest.approx(math.exp(-0.1 * aside), rel=1e-5)
    assert step.metrics["landing_error"][0] == pytest.approx(math.hypot(aside, 0.02135), rel=1e-5)
    assert step.metrics["carry"][0] == pytest.approx(math.hypot(6.0, 0.4), rel=1e-5)
    stroke.ball((9.0, 0.5, 0.2), (3.0, 0.0, 1.0))
    step = stroke.step([TURF], at=(8.0, 0.4, 0.02135))  # the second one
    assert step.terms["landing"][0, 0] == pytest.approx(math.exp(-0.1 * aside), rel=1e-5)
    assert step.terms["ball"][0, 0] == pytest.approx(math.exp(-0.1 * math.hypot(1, 0.5)), rel=1e-5)
    assert step.metrics["error"][0] == pytest.approx(math.dist((9, 0.5, 0.2), (10, 0, 0)), rel=1e-5)


def test_reach_pays_for_every_new_metre_once():
    stroke = addressed(reach=2.0)
    first = float(stroke.env.memory["nearest"][0])
    assert first == pytest.approx(2.55, abs=0.01)
    head = head_pos(stroke.env.view)[0]
    total = 0.0
    for away in (2.0, 3.0, 2.0, 1.0):
        stroke.ball(tuple((head + torch.tensor((away, 0.0, 0.0))).tolist()))
        total += float(stroke.step().terms["reach"][0, 0])
    assert total == pytest.approx(2 * (first - 1.0), abs=1e-4)
    stroke.ball(tuple((head + torch.tensor((0.1, 0.0, 0.0))).tolist()))
    assert stroke.step([HEAD]).terms["reach"][0, 0] == 0


def test_aim_pays_for_every_metre_to_the_target_and_charges_every_metre_from_it():
    stroke = addressed(aim=3.0)
    target = torch.tensor([10.0, 0.0, 0.0])
    assert stroke.step().terms["aim"][0, 0] == 0  # not hit yet
    places = ((0.5, 0.0, 0.3), (8.0, 1.0, 0.5), (14.0, 2.0, 0.02), (90.0, 2.0, 0.02))
    off = math.dist(ON_TEE, target)
    for place in places:
        stroke.ball(place, (12.0, 0.0, 0.0))
        paid = float(stroke.step([HEAD] if place == places[0] else []).terms["aim"][0, 0])
        now = min(math.dist(place, target), 40.0)
        assert paid == pytest.approx(3.0 * (off - now), rel=1e-5)
        off = now
    stroke.ball((95.0, 2.0, 0.02), (12.0, 0.0, 0.0))
    assert stroke.step().terms["aim"][0, 0] == 0  # as far as it gets
    assert "aim" not in struck().step().terms


def test_turf_charges_for_the_club_on_the_ground_and_for_nothing_else():
    stroke = addressed(turf=2.0)
    weight = 9.81 * stroke.env.physics.scene.body.mass
    for link, force, owed in (
        ("R_Hand", 1200.0, 1200.0),
        ("R_Hand", 100 * weight, 30 * weight),  # as bad as it gets
        ("L_Toe", 1200.0, 0.0),
        ("R_Hand", 0.0, 0.0),
    ):
        paid = float(stroke.step(forces={link: force}).terms["turf"][0, 0])
        assert paid == pytest.approx(-2.0 * owed / weight, rel=1e-5)
    assert "turf" not in struck().step().terms


# Ends.


@pytest.mark.parametrize(("x", "foul"), [(-0.049, False), (-0.051, True)])
def test_a_ball_may_not_go_backwards(x: float, foul: bool):
    stroke = addressed()
    stroke.ball((x, 0.0, 0.05), (-1.0, 0.0, 0.0))
    step = stroke.step([HEAD])
    assert bool(step.terminated[0, 0]) is foul
    assert step.metrics["contact"][0] == 1 and step.metrics["foul"][0] == foul
    assert bool(step.success[0]) is not foul and not paid_on(step)


def test_a_ball_that_has_landed_may_roll_back():
    stroke = struck()
    stroke.ball((-0.04, 0.0, 0.03), (-3.0, 0.0, 0.0))
    assert not stroke.step([TURF], at=(0.02, 0.0, 0.02135)).terminated[0, 0]
    stroke.ball((-0.4, 0.0, 0.03), (-3.0, 0.0, 0.0))
    assert not stroke.step([TURF]).terminated[0, 0]
    # In the step of the landing it counts where the ball landed, not where it then rolled.
    for x, foul in ((-0.04, False), (-0.06, True)):
        stroke = struck()
        stroke.ball((-0.2, 0.0, 0.03), (-3.0, 0.0, 0.0))
        step = stroke.step([TURF], at=(x, 0.0, 0.02135))
        assert bool(step.terminated[0, 0]) is foul


def test_a_ball_that_bounces_on_its_tee_has_not_landed():
    stroke = addressed()
    stroke.ball((0.0, 0.0, 0.08), (0.0, 0.0, 0.3))
    assert not stroke.step([HEAD, TEE]).terminated[0, 0]
    assert not stroke.env.memory["landed"][0]


def test_the_ball_must_be_met_within_two_seconds():
    stroke = addressed()
    stroke.env.view.clock[:] = 58
    assert not stroke.step().terminated[0, 0]  # the end of step 59
    step = stroke.step()
    assert step.terminated[0, 0] and not step.success[0] and not paid_on(step)
    assert step.metrics["contact"][0] == 0 and step.metrics["error"][0].isnan()
    stroke = addressed()
    stroke.env.view.clock[:] = 59
    stroke.ball((0.1, 0.0, 0.1), (3.0, 0.0, 1.0))
    assert not stroke.step([HEAD]).terminated[0, 0]
    assert not stroke.step().terminated[0, 0]


@pytest.mark.parametrize(("surface", "foul"), [(HEAD, True), (SHAFT, True), (TURF, False)])
def test_a_second_contact_of_the_club_is_a_foul(surface: int, foul: bool):
    """The first one was 0.01 s after its step began; a step is 1/30 s."""
    for later, too_late in ((0.0099, False), (0.0101, foul)):
        stroke = struck()
        stroke.ball((1.0, 0.0, 0.4), (12.0, 0.0, 4.0))
        step = stroke.step({surface: later}, at=(0.9, 0.0, 0.02135))
        assert bool(step.terminated[0, 0]) is too_late
        assert bool(step.success[0]) is not too_late and not paid_on(step)
        assert step.metrics["hit_rate"][0] == 1 - too_late and step.metrics["contact"][0] == 1
        assert bool(step.metrics["error"][0].isnan()) is too_late


def test_a_ball_squeezed_on_its_tee_is_met_once():
    """5 ms, across the end of a control step."""
    stroke = addressed()
    stroke.ball((0.1, 0.0, 0.1), (3.0, 0.0, 1.0))
    step = stroke.step({HEAD: 0.03, TEE: 0.031})
    assert not step.terminated[0, 0] and step.success[0]
    step = stroke.step({HEAD: 0.002, TEE: 0.001})
    assert not step.terminated[0, 0] and step.success[0]


def test_the_shaft_is_no_head():
    """Alone or first; a ball that comes off the head on the shaft was struck with the head."""
    for hits, foul in (
        ({SHAFT: 0.02}, True),
        ({SHAFT: 0.019, HEAD: 0.02}, True),
        ({SHAFT: 0.021, HEAD: 0.02}, False),
    ):
        stroke = addressed()
        stroke.ball((0.1, 0.0, 0.1), (3.0, 0.0, 1.0))
        step = stroke.step(hits)
        assert bool(step.terminated[0, 0]) is foul and bool(step.success[0]) is not foul
        assert step.metrics["contact"][0] == (HEAD in hits)


@pytest.mark.parametrize(("link", "kick"), [("L_Toe", True), ("R_Hand", False), ("Head", True)])
def test_no_link_but_the_tool_comes_near_the_ball(link: str, kick: bool):
    for away, foul in ((0.149, kick), (0.151, False)):
        stroke = struck()
        physics = stroke.env.physics
        at = physics.body_pos[0, 0, physics.scene.body.link_index(link)]
        side = torch.tensor((-0.6, -0.8, 0.0)) if link == "L_Toe" else torch.tensor((0, -0.6, 0.8))
        stroke.ball(tuple((at + away * side).tolist()))
        step = stroke.step([TURF], at=(6.0, 0.0, 0.02135))
        assert bool(step.terminated[0, 0]) is foul
        assert bool(step.success[0]) is not foul


def test_a_fall_ends_the_wait_for_the_ball_but_not_its_flight():
    for newtons, falls in ((49.0, False), (51.0, True)):
        stroke = addressed()
        step = stroke.step(forces={"L_Knee": newtons})
        assert bool(step.terminated[0, 0]) is falls and not step.success[0]
    stroke = addressed()
    assert not stroke.step(forces={"R_Hand": 400.0}).terminated[0, 0]  # the club on the ground
    stroke = struck()
    stroke.ball((1.0, 0.0, 0.4), (12.0, 0.0, 4.0))
    assert not stroke.step(forces={"Pelvis": 900.0}).terminated[0, 0]


def test_a_ball_at_rest_ends_the_episode_and_is_paid_on():
    for speed, rests in ((0.019, True), (0.021, False)):
        stroke = struck()
        stroke.ball((8.0, 1.0, 0.02135), (0.0, speed, 0.0))
        steps = [stroke.step([TURF], at=(6.0, 0.0, 0.02135)) for _ in range(3)]
        assert [bool(s.terminated[0, 0]) for s in steps] == [False, False, rests]
        last = steps[-1]
        assert paid_on(last) is rests and last.success[0]
        assert last.metrics["error"][0] == pytest.approx(math.dist((8, 1, 0.02135), (10, 0, 0)))
    # On its tee it waits for the club.
    stroke = addressed()
    assert not any(stroke.step([TEE]).terminated[0, 0] for _ in range(10))


def test_a_ball_that_is_only_touched_is_not_hit():
    """It stays on its tee, or comes to rest there."""
    stroke = addressed()
    steps = [stroke.step([HEAD] if k == 0 else []) for k in range(3)]
    assert [bool(s.terminated[0, 0]) for s in steps] == [False, False, True]
    assert not paid_on(steps[-1]) and not steps[-1].success[0]


def test_a_ball_at_the_top_of_its_path_does_not_rest():
    stroke = struck()
    for velocity in (0.33, 0.0, -0.33, 0.01, 0.0):
        stroke.ball((8.0, 1.0, 0.3), (0.0, 0.0, velocity))
        assert not stroke.step().terminated[0, 0]


def test_a_foul_is_not_paid_on_by_rest():
    stroke = struck()
    stroke.ball((8.0, 0.0, 0.02135))
    for _ in range(2):
        stroke.step([TURF], at=(6.0, 0.0, 0.02135))
    step = stroke.step([HEAD])
    assert step.terminated[0, 0] and not paid_on(step) and not step.success[0]


def test_options_are_checked():
    for options, words in (
        ({"terrain": "sand"}, "must be 'waves' or 'flat'"),
        ({"distance": 21.0}, "between 0 and 20 m away, not 21.0"),
        ({"reach": -1.0}, "must not be negative"),
        ({"aim": -1.0}, "must not be negative"),
        ({"turf": -1.0}, "must not be negative"),
    ):
        with pytest.raises(ValueError, match=words):
            make_env("golf", num_worlds=1, options=options)


# Landings that the reward predicts.


def test_a_landing_on_waves_is_the_first_touch():
    """Independent: the flight every 2 ms, and the distance to the turf along its normal by finite
    differences."""
    n, size = 60, WAVES
    generator = torch.Generator().manual_seed(5)
    draw = torch.rand(n, 8, generator=generator)
    phases = 2 * math.pi * draw[:, :2]
    linvel = torch.stack((2 + 28 * draw[:, 2], 6 * draw[:, 3] - 3, 12 * draw[:, 4]), -1)
    pos = torch.tensor((0.3, 0.0, 0.1)).repeat(n, 1)
    spin = 200 * draw[:, 5:] - 100
    where, when = landing_on_waves("golf", pos, linvel, spin, size, phases)
    assert when.isfinite().all()
    times = torch.arange(1, 2000) * 0.002
    path = ball_path("golf", pos, linvel, spin, times.tolist()).double()
    x, y, z = path.unbind(-1)

    def height(x, y):
        return turf_height(x, y, phases.double())

    h = 1e-4
    slope = (height(x + h, y) - height(x - h, y)) / (2 * h)
    aside = (height(x, y + h) - height(x, y - h)) / (2 * h)
    gap = z - height(x, y) - 0.02135 * (1 + slope**2 + aside**2).sqrt()
    first = (gap <= 0).int().argmax(1)
    late = times[first] - when
    print(f"landings from {where[:, 0].min():.1f} to {where[:, 0].max():.1f} m")
    assert (late > -1e-4).all() and (late < 0.0021).all()
    world = torch.arange(n)
    moved = (path[world, first] - where).norm(dim=1)
    assert (moved < 0.0021 * 40).all()
    some = draw[:, 0] < 0.5
    masked, never = landing_on_waves("golf", pos, linvel, spin, size, phases, some)
    assert torch.equal(masked[some], where[some]) and torch.equal(masked[~some], pos[~some])
    assert never[~some].isinf().all()


def test_a_landing_on_flat_turf_is_that_on_a_plane():
    n = 20
    draw = torch.rand(n, 6, generator=torch.Generator().manual_seed(6))
    linvel = torch.stack((2 + 28 * draw[:, 0], 6 * draw[:, 1] - 3, 12 * draw[:, 2]), -1)
    pos, spin = torch.tensor((0.3, 0.0, 0.1)).repeat(n, 1), 200 * draw[:, 3:] - 100
    flat = (0.0, *WAVES[1:])
    where, when = landing_on_waves("golf", pos, linvel, spin, flat, torch.zeros(n, 2))
    plane, then = landing("golf", pos, linvel, spin, 0.02135)
    torch.testing.assert_close(where, plane, rtol=0, atol=1e-3)
    torch.testing.assert_close(when, then, rtol=0, atol=1e-4)


def test_a_landing_on_waves_is_the_same_on_the_gpus_compiler():
    wp = pytest.importorskip("warp")
    wp.init()
    n = 30
    draw = torch.rand(n, 8, generator=torch.Generator().manual_seed(7))
    phases = 2 * math.pi * draw[:, :2]
    linvel = torch.stack((2 + 28 * draw[:, 2], 6 * draw[:, 3] - 3, 12 * draw[:, 4]), -1)
    pos, spin = torch.tensor((0.3, 0.0, 0.1)).repeat(n, 1), 200 * draw[:, 5:] - 100
    where, when = landing_on_waves("golf", pos, linvel, spin, WAVES, phases)
    numbers = torch.tensor(BALLS["golf"].numbers(), dtype=torch.float32)
    place, time = torch.empty(n, 3), torch.empty(n)
    wanted = torch.ones(n, dtype=torch.bool)
    given = (pos, linvel, spin, phases, *WAVES, 5.0, wanted, numbers, place, time)
    inputs = [wp.from_torch(v) if isinstance(v, torch.Tensor) else v for v in given]
    wp.launch(for_gpu().land_on_waves_worlds, dim=n, inputs=inputs, device="cpu")
    torch.testing.assert_close(place, where, rtol=0, atol=1e-3)
    torch.testing.assert_close(time, when, rtol=0, atol=1e-4)


# Strokes in the engine.

SWINGS = ((0.79, -1.34, 0.47, 2.88), (0.82, -1.35, 0.81, 3.01), (0.94, -0.57, 0.77, 2.64))
"""Tilt of the plane of the swing (rad), turn of the club about itself on the way down (rad),
seconds, angle of the swing (rad); found by a random search for legal hits that go far, go less far,
stay on the ground. The T-pose is the top of the backswing."""


def turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix (Rodrigues)."""
    x, y, z = axis
    cross = np.array(((0, -z, y), (z, 0, -x), (-y, x, 0)))
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def swing(env: Env, seconds: float, swings=SWINGS) -> torch.Tensor:
    """(N, 1, 69) actions of the right shoulder alone, each world by one of the swings in turn."""
    action = torch.zeros(env.num_worlds, 1, env.action_size)
    body = env.physics.scene.body
    shoulder = [body.dof_index(f"R_Shoulder_{axis}") for axis in "xyz"]
    for world in range(env.num_worlds):
        tilt, twist, duration, angle = swings[world % len(swings)]
        done = min(seconds / duration, 1.0)
        plane = turn(np.array((math.sin(tilt), 0.0, math.cos(tilt))), angle * done)
        r = plane @ turn(np.array((0.0, 1.0, 0.0)), twist * min(2 * done, 1.0))
        # Intrinsic x, y, z.
        angles = math.atan2(-r[1, 2], r[2, 2]), math.asin(r[0, 2]), math.atan2(-r[0, 1], r[0, 0])
        action[world, 0, shoulder] = torch.tensor(angles) / math.pi
    return action


@pytest.mark.parametrize("terrain", ["flat", "waves"])
def test_a_swing_sends_the_ball_off_and_it_comes_to_rest(terrain: str):
    """Until the club comes it lies on its tee to the last bit; it lands where the law said when it
    was hit; it comes to rest on the turf, which ends the episode and is paid on."""
    n = 2 * len(SWINGS)
    options = {"terrain": terrain, "distance": 10.0}
    env = make_env("golf", num_worlds=n, training=False, seed=4, options=options)
    env.keep_snapshot = True
    place = env.physics.scene.object_qpos("ball")
    phases, target = env.memory["phases"], env.memory["target"]
    over, off, path = torch.zeros(n, dtype=torch.bool), [], []
    for k in range(env.max_steps):
        before = env.memory
        step = env.step(swing(env, (k + 1) / 30))
        ball = env.final_snapshot["qpos"][:, place][:, :3]
        path.append(ball)
        waits = ~over & (step.metrics["contact"] == 0)
        assert (ball[waits] == torch.tensor(ON_TEE)).all()
        flew = ~over & before["met_at"].isfinite() & ~before["landed"] & env.memory["landed"]
        off += (before["landing"] - env.memory["landing"]).norm(dim=1)[flew].tolist()
        ends = ~over & step.ended
        assert (step.metrics["success"][ends] == 1).all() and step.terminated[ends].all()
        assert (step.remaining_paid[ends] == env.max_steps - (k + 1)).all()
        error = (ball - target).norm(dim=1)
        torch.testing.assert_close(step.metrics["error"][ends], error[ends])
        # The ball touches the turf: as far from it as it is thick, along the normal.
        height = turf_height(ball[:, 0], ball[:, 1], phases) if terrain == "waves" else 0 * error
        above = (ball[:, 2] - height)[ends]
        assert (above > 0.0213).all() and (above < 0.0225).all()
        assert (ball[ends, 0] > 2.0).all() and (step.metrics["carry"][ends] > 0.3).all()
        assert ((path[-1] - path[max(-3, -len(path))])[ends].abs() < 1e-3).all()
        over |= ends
        if over.all():
            break
    print(f"{terrain}: at rest after {k + 1} steps; landings predicted to {max(off):.1e} m")
    assert over.all() and len(off) == n and max(off) < 0.005
    env.close()


def test_a_ball_at_rest_on_a_slope_stays():
    """On the steepest places of 40 different waves, for 2 s."""
    n = 40
    env = make_env("golf", num_worlds=n, training=False, seed=2)
    along = torch.linspace(-10, 10, 81)
    x, y = (v.flatten().expand(n, -1) for v in torch.meshgrid(along, along, indexing="ij"))
    phases, h = env.memory["phases"], 1e-2
    dx = turf_height(x + h, y, phases) - turf_height(x - h, y, phases)
    dy = turf_height(x, y + h, phases) - turf_height(x, y - h, phases)
    slope, place = (torch.hypot(dx, dy) / (2 * h)).max(1)
    world = torch.arange(n)
    x, y = x[world, place], y[world, place]
    physics = env.physics
    ball = physics.scene.object_qpos("ball").start
    qpos, qvel = physics.qpos.clone(), physics.qvel.clone()
    above = 0.02135 * (1 + slope**2).sqrt()
    qpos[:, ball : ball + 3] = torch.stack((x, y, turf_height(x, y, phases) + above), -1)
    state = PhysicsState(qpos, qvel, physics.mocap_pos.clone(), physics.wave_phase.clone())
    physics.reset(torch.ones(n, dtype=torch.bool), state)
    for _ in range(60):
        physics.step(torch.zeros(n, physics.scene.nu))
    moved = (physics.object_pos[:, 0] - qpos[:, ball : ball + 3]).norm(dim=1)
    print(f"slopes up to {slope.max():.3f}: moved {moved.max():.1e} m")
    assert slope.min() > 0.22 and moved.max() < 1e-3
    env.close()


def test_two_engines_play_the_same_stroke():
    """C MuJoCo and MuJoCo Warp on its CPU device, 30 steps: athlete, flight, rewards."""
    pytest.importorskip("mujoco_warp")
    envs = [
        make_env("golf", engine=engine, num_worlds=3, training=False, seed=3, physics_options=o)
        for engine, o in (("mujoco", {"threads": 1}), ("warp", {"device": "cpu"}))
    ]
    ball = envs[0].physics.scene.object_qpos("ball").start
    for k in range(30):
        mine, other = (env.step(swing(env, (k + 1) / 30)) for env in envs)
        p, q = (env.physics.qpos for env in envs)
        torch.testing.assert_close(p[:, :ball], q[:, :ball], rtol=0, atol=1e-5)
        flight = slice(ball, ball + 3)  # a spinning ball's attitude tells a rounding sooner
        torch.testing.assert_close(p[:, flight], q[:, flight], rtol=0, atol=1e-3)
        assert torch.equal(envs[0].physics.ball_hits, envs[1].physics.ball_hits)
        torch.testing.assert_close(mine.reward, other.reward, rtol=0, atol=1e-3)
        assert torch.equal(mine.ended, other.ended)
    assert (mine.metrics["contact"] == 1).all()
    for env in envs:
        env.close()


def test_an_interrupted_stroke_goes_on_where_it_was():
    """Over waves that the other environment has never had."""
    options = {"threads": 1}
    first, second = (
        make_env("golf", num_worlds=3, seed=s, physics_options=options) for s in (1, 2)
    )
    for k in range(15):
        first.step(swing(first, (k + 1) / 30))
    second.load_state_dict(first.state_dict())
    for k in range(15, 60):
        mine, other = (env.step(swing(env, (k + 1) / 30)) for env in (first, second))
        assert torch.equal(mine.obs, other.obs) and torch.equal(mine.reward, other.reward)
    assert (first.memory["met_at"].isfinite() | mine.ended).any()
