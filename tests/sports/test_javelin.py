"""The javelin's rules on states made by hand, with known answers."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from rl.cloning import reference
from sports import quaternion
from sports.env import make_env
from sports.humanoid.hold import JAVELIN_LENGTH, JAVELIN_RADIUS
from sports.javelin import RELEASE_STEPS
from sports.javelin import flight as rest_of_flight
from sports.physics import PhysicsState
from sports.starts import ELAPSED, Starts
from tests.sports.hand_made import HandMade
from warmstart import thrown
from warmstart.clip import Clip

SHIPPED = Path(__file__).parents[2] / "warmstart" / "data" / "throws" / "javelin_paper.npz"
STANDING = 0.9483
"""Root height with the soles just above the ground."""
HALF = JAVELIN_LENGTH / 2 - JAVELIN_RADIUS
UP = math.radians(30.0)
FAR = (1.0, -0.6, 4.0)
"""Out of every hand's reach."""
HOLD, THROW, LATE = 5, 25, 60
"""Control steps in the three stages, the last after the release must have been."""


class Throw(HandMade):
    """A javelin wherever a test wants it."""

    def __init__(self, **options: object) -> None:
        super().__init__("javelin", **options)
        scene = self.env.physics.scene
        self.q, self.v = scene.object_qpos("javelin"), scene.object_qvel("javelin")
        self.place((0.0, 0.0, STANDING))

    def javelin(self, pos, elevation=UP, velocity=(0.0, 0.0, 0.0), azimuth=0.0) -> None:
        """Centre, elevation and azimuth of the nose (rad), velocity; no spin."""
        yaw = torch.tensor((math.cos(azimuth / 2), 0.0, 0.0, math.sin(azimuth / 2)))
        pitch = torch.tensor((math.cos(elevation / 2), 0.0, -math.sin(elevation / 2), 0.0))
        self.state.qpos[:, self.q] = torch.cat((torch.tensor(pos), quaternion.multiply(yaw, pitch)))
        self.state.qvel[:, self.v] = torch.tensor((*velocity, 0.0, 0.0, 0.0))

    def palm(self) -> torch.Tensor:
        """(3,) middle of the right palm: of its box in the body table."""
        physics = self.env.physics
        self._apply()
        wrist = physics.scene.body.link_index("R_Wrist")
        center = torch.tensor((-0.0029, -0.0537, -0.0044))
        turned = quaternion.rotate(physics.body_quat[0, 0, wrist], center)
        return physics.body_pos[0, 0, wrist] + turned

    def at(self, clock: int) -> None:
        """Begins anew; the next step is number ``clock``."""
        self.begin()
        self.env.view.clock[:] = clock - 1

    def step(self, touched: float = 0.0, ground: float = 0.0, **forces: float):
        """Ends a step with forces (N) of the athlete and of the ground on the javelin."""
        return self.advance(forces, pair=(touched, ground))


def ended(step) -> bool:
    return bool(step.terminated[0, 0])


def released(world: Throw) -> None:
    """The javelin has left the hand, in the throwing stage."""
    world.javelin(FAR)
    world.at(THROW)
    assert not ended(world.step())
    assert world.env.memory["released"][0]


def test_features_are_seen_from_the_athlete():
    """An athlete who has turned by 90 degrees sees what it saw; the world's x is its right."""
    world = Throw()
    world.javelin((0.4, -0.5, 1.6), velocity=(3.0, 1.0, -2.0))
    world.at(HOLD)
    straight = {k: v.clone() for k, v in world.env.task.features(world.env.view, _m(world)).items()}
    assert sum(v.shape[-1] for v in straight.values()) == 19
    near = pytest.approx
    assert straight["javelin_pos"][0, 0].tolist() == near([0.4, -0.5, 1.6 - STANDING], abs=1e-5)
    assert straight["javelin_linvel"][0, 0].tolist() == near([3.0, 1.0, -2.0], abs=1e-5)
    pitch = [math.cos(UP / 2), 0.0, -math.sin(UP / 2), 0.0]
    assert straight["javelin_quat"][0, 0].tolist() == near(pitch, abs=1e-5)
    hand = (world.palm() - torch.tensor((0.0, 0.0, STANDING))).tolist()
    assert straight["hand"][0, 0].tolist() == near(hand, abs=1e-5)

    quarter = math.cos(math.pi / 4)
    world.state.qpos[:, 3:7] = torch.tensor((quarter, 0.0, 0.0, quarter))
    world.state.qpos[:, :2] = torch.tensor((0.3, 0.7))
    world.javelin((0.3 + 0.5, 0.7 + 0.4, 1.6), velocity=(-1.0, 3.0, -2.0), azimuth=math.pi / 2)
    world._apply()
    turned = world.env.task.features(world.env.view, _m(world))
    for name in ("javelin_pos", "javelin_quat", "javelin_linvel", "hand"):
        torch.testing.assert_close(turned[name], straight[name], rtol=0, atol=1e-5)
    assert turned["root"][0, 0].tolist() == near([0.7, -0.3, 0.0], abs=1e-5)


def _m(world: Throw):
    return world.env.memory


def test_rewards_of_the_three_stages():
    world = Throw()
    palm = world.palm()
    grip = palm + torch.tensor((0.06, 0.0, 0.08))  # 0.1 m away
    world.javelin(tuple(grip.tolist()), elevation=UP + 0.2)
    world.at(17)
    step = world.step()
    terms = {k: float(v[0, 0]) for k, v in step.terms.items()}
    assert terms["grab"] == pytest.approx(0.9 * math.exp(-0.01), abs=1e-5)
    assert terms["attitude"] == pytest.approx(0.1 * math.exp(-0.04), abs=1e-4)
    assert terms["start"] == terms["goal"] == 0.0
    # Step 18 is 0.6 s: from here the javelin's way forward pays.
    world.place((0.3, 0.4, STANDING))
    world.javelin((float(grip[0]) + 0.7, -0.5, 1.6))
    step = world.step()
    terms = {k: float(v[0, 0]) for k, v in step.terms.items()}
    apart = math.dist(world.palm().tolist(), (float(grip[0]) + 0.7, -0.5, 1.6))
    assert terms["goal"] == pytest.approx(0.9 * 0.7, abs=1e-5)
    assert terms["start"] == pytest.approx(0.05 * math.exp(-0.25), abs=1e-5)
    assert terms["grab"] == pytest.approx(-0.05 * math.exp(-(apart**2)), abs=1e-5)
    assert terms["attitude"] == 0.0
    # From 1.2 s on the nose should point where the javelin flies: here 45 degrees down.
    for clock, late in ((35, False), (36, True)):
        world.javelin(FAR, elevation=-math.pi / 4 + 0.3)
        world.at(clock)
        world.javelin((2.0, -0.6, 3.0), elevation=-math.pi / 4 + 0.3, velocity=(9.0, 0.0, -9.0))
        terms = {k: float(v[0, 0]) for k, v in world.step().terms.items()}
        assert terms["goal"] == pytest.approx(0.9 * 1.0, abs=1e-5)
        assert terms["attitude"] == pytest.approx(0.1 * math.exp(-0.09) * late, abs=1e-4)


def test_an_opening_hand_is_paid_once_it_need_not_hold():
    """By the mean way of the fingertips from the line of the shaft, along which it may slide."""
    world = Throw(let_go=10.0)
    body = world.env.physics.scene.body
    names = ("Index", "Middle", "Ring", "Pinky", "Thumb")
    tips = [body.link_index(f"R_{name}3") for name in names]
    along = torch.tensor((math.cos(UP), 0.0, math.sin(UP)))

    def opening() -> float:
        """Each tip's way less what of it is along the shaft, at most 0.1 m."""
        physics = world.env.physics
        way = physics.body_pos[0, 0, tips] - physics.object_pos[0, 0]
        return float((way - (way @ along)[:, None] * along).norm(dim=-1).clamp(max=0.1).mean())

    palm = world.palm()
    world.javelin(tuple(palm.tolist()))
    world.at(HOLD)
    assert world.step(touched=20.0).terms["let_go"][0, 0] == 0.0
    closed = opening()
    assert 0.01 < closed < 0.095
    world.env.view.clock[:] = THROW
    world.javelin(tuple((palm + 0.2 * along).tolist()))  # slides
    assert world.step(touched=20.0).terms["let_go"][0, 0] == pytest.approx(0.0, abs=1e-5)
    world.javelin(tuple((palm + torch.tensor((0.0, 0.0, 0.03))).tolist()))
    paid = float(world.step(touched=20.0).terms["let_go"][0, 0])
    assert paid == pytest.approx(10.0 * max(opening() - closed, 0.0), abs=1e-4)
    world.javelin(FAR)
    paid += float(world.step().terms["let_go"][0, 0])
    assert paid == pytest.approx(10.0 * (0.1 - closed), abs=1e-4)
    assert world.step().terms["let_go"][0, 0] == 0.0
    with pytest.raises(ValueError, match="must not be negative"):
        make_env("javelin", num_worlds=1, options={"let_go": -1.0})


@pytest.mark.parametrize(("away", "lost"), [(0.149, False), (0.151, True)])
def test_the_grip_must_hold_for_the_first_stage(away, lost):
    for clock, counts in ((17, True), (18, False)):
        world = Throw()
        palm = world.palm()
        along = torch.tensor((math.cos(UP), 0.0, math.sin(UP)))  # the shaft itself stays in hand
        world.javelin(tuple((palm + away * along).tolist()))
        world.at(clock)
        assert ended(world.step(touched=20.0)) is (lost and counts)


@pytest.mark.parametrize(("tilt", "lost"), [(0.49, False), (0.51, True), (-0.51, True)])
def test_the_attitude_must_hold_for_the_first_stage(tilt, lost):
    for clock, counts in ((17, True), (18, False)):
        world = Throw()
        world.javelin(tuple(world.palm().tolist()), elevation=UP + tilt)
        world.at(clock)
        assert ended(world.step(touched=20.0)) is (lost and counts)


@pytest.mark.parametrize(("away", "near"), [(0.149, True), (0.151, False)])
@pytest.mark.parametrize("part", ["middle", "tail"])
def test_the_hand_must_be_off_the_whole_shaft_at_one_and_a_half_seconds(away, near, part):
    for clock, counts in ((47, False), (48, True)):
        world = Throw()
        palm = world.palm()
        if part == "middle":  # half a metre of shaft on, and ``away`` above the hand
            pos = palm + torch.tensor((0.5, 0.0, away))
        else:  # beyond the end of the tail
            pos = palm + torch.tensor((HALF + away, 0.0, 0.0))
        world.javelin(tuple(pos.tolist()), elevation=0.0)
        world.at(clock)
        step = world.step()
        assert ended(step) is (near and counts)
        assert bool(world.env.memory["released"][0]) is not near
        assert not step.success[0]


def test_a_training_may_ask_for_an_earlier_release_but_not_for_a_later_one():
    for clock, over in ((43, False), (44, True)):
        world = Throw(deadline=44)
        world.javelin(tuple(world.palm().tolist()))
        world.at(clock)
        assert ended(world.step(touched=20.0)) is over
    for deadline in (36, 49):
        with pytest.raises(ValueError, match="deadline must be above 36 and at most 48"):
            Throw(deadline=deadline)


def test_what_the_athlete_still_touches_is_not_released():
    world = Throw()
    world.javelin(FAR)  # on the head, say
    world.at(THROW)
    assert not ended(world.step(touched=5.0))
    assert not world.env.memory["released"][0]
    assert not ended(world.step())
    assert world.env.memory["released"][0]


def test_nobody_catches_it_again_or_kicks_it_on():
    """Up to 1.6 s that is the same throw; from then on any touch ends it as a failure."""
    world = Throw()
    released(world)
    assert not ended(world.step(touched=5.0))
    for clock, over in ((47, False), (48, True), (120, True)):
        world.env.view.clock[:] = clock - 1
        step = world.step(touched=5.0)
        assert ended(step) is over and not step.success[0]


@pytest.mark.parametrize(
    ("x", "y", "out"),
    [(1.4, 0, 0), (2.01, 0, 1), (-1.99, 0, 0), (-2.01, 0, 1), (0, 1.99, 0), (0, 2.01, 1)]
    + [(0, -1.99, 0), (0, -2.01, 1)],
)
@pytest.mark.parametrize("stage", [HOLD, THROW, LATE])
def test_the_root_stays_within_two_metres_of_the_start(x, y, out, stage):
    world = Throw()
    if stage == LATE:
        released(world)
    world.place((x, y, 1.3))
    world.javelin(FAR if stage == LATE else tuple(world.palm().tolist()))
    world.env.view.clock[:] = stage - 1
    if stage != LATE:
        world.at(stage)
    step = world.step(touched=0.0 if stage == LATE else 20.0)
    assert ended(step) is bool(out)
    assert step.metrics["foul"][0] == out


def test_running_out_with_the_javelin_ends_the_throw():
    """Carried beyond the line it pays the way to the line at most, and never counts."""
    world = Throw()
    world.place((0.0, 0.0, 1.3))
    world.javelin(tuple(world.palm().tolist()))
    world.at(HOLD)
    world.env.view.clock[:] = THROW
    paid, steps = 0.0, 0
    for k in range(1, 40):
        world.place((0.1 * k, 0.0, 1.3))
        world.javelin(tuple(world.palm().tolist()))
        step = world.step(touched=20.0)
        paid, steps = paid + float(step.terms["goal"][0, 0]), k
        if ended(step):
            break
    assert steps == 21 and paid == pytest.approx(0.9 * 2.1, abs=1e-4)
    assert not step.success[0] and step.metrics["foul"][0] == 1.0


def test_a_foot_beyond_the_line_is_a_foul_also_after_the_release():
    """The toes of the standing athlete: from the body table, hip to toe and half its length."""
    toe = -0.0213 - 0.0168 - 0.0202 + 0.119 + 0.0158 + 0.0495
    left = -0.026 - 0.0094 - 0.0319 + 0.1182 + 0.0256 + 0.0495
    furthest = max(toe, left)
    for beyond, foul in ((-0.01, False), (0.01, True)):
        world = Throw()
        released(world)
        world.place((2.0 - furthest + beyond, 0.0, STANDING))
        world.drop_to_ground("R_Toe")
        step = world.step(R_Toe=300.0, L_Toe=300.0)
        assert ended(step) is foul and step.metrics["foul"][0] == float(foul)
        # Off the ground at both ends of a step and touched in between: it is all beyond the line.
        world = Throw()
        released(world)
        world.place((1.95, 0.0, STANDING + 0.1))
        assert ended(world.step(R_Toe=80.0)) and not ended(world.step(R_Ankle=80.0))
        # Above the ground it is none.
        world = Throw()
        released(world)
        world.place((2.0 - furthest + beyond, 0.0, STANDING + 0.1))
        assert not ended(world.step())


def test_throwing_oneself_over_the_line_is_a_foul():
    """The root is behind the line, the hands of the falling athlete are not."""
    world = Throw()
    released(world)
    lying = math.cos(math.pi / 4)
    world.state.qpos[:, 3:7] = torch.tensor((lying, 0.0, lying, 0.0))  # face down, head to +x
    world.place((1.7, 0.0, 0.12))
    step = world.step(L_Wrist=200.0, Chest=400.0)
    assert ended(step) and step.metrics["foul"][0] == 1.0 and not step.success[0]
    # The same fall at the start, after the release, is allowed.
    world = Throw()
    released(world)
    world.state.qpos[:, 3:7] = torch.tensor((lying, 0.0, lying, 0.0))
    world.place((0.0, 0.0, 0.12))
    assert not ended(world.step(L_Wrist=200.0, Chest=400.0))


def test_a_fall_before_the_release_ends_the_throw():
    world = Throw()
    world.javelin(tuple(world.palm().tolist()))
    world.at(THROW)
    assert not ended(world.step(touched=20.0, L_Wrist=49.0))
    assert ended(world.step(touched=20.0, L_Wrist=51.0))


def fly(height: float, elevation: float, velocity) -> tuple[float, float]:
    """Time (s) and way forward (m) of a point until it has come down by ``height``, on a javelin
    that keeps its attitude: gravity and quadratic drag in steps of 10 us. 0.8 kg; skin friction
    0.004 of the whole surface along, 1.1 of the side view across, in air of 1.2 kg/m^3."""
    skin, side = math.pi * 0.025 * 2.7, 0.025 * 2.7
    nose = (math.cos(elevation), math.sin(elevation))
    x, z, (vx, _, vz), dt, steps = 0.0, height, velocity, 1e-5, 0
    while z > 0.0:
        along = vx * nose[0] + vz * nose[1]
        across = (vx - along * nose[0], vz - along * nose[1])
        k_along = 0.6 * 0.004 * skin * abs(along) * along
        k_across = 0.6 * 1.1 * side * math.hypot(*across)
        vx -= dt * (k_along * nose[0] + k_across * across[0]) / 0.8
        vz -= dt * ((k_along * nose[1] + k_across * across[1]) / 0.8 + 9.81)
        x, z, steps = x + vx * dt, z + vz * dt, steps + 1
    return steps * dt, x


def flight(elevation, height, velocity, x=20.0):
    """A released javelin comes down: the last step's rules."""
    world = Throw()
    released(world)
    world.javelin((x, 0.0, height), elevation=elevation, velocity=velocity)
    world.env.view.clock[:] = LATE
    assert not ended(world.step())
    world.javelin((x + 0.4, 0.0, 0.3), elevation=elevation, velocity=(1.0, 0.0, 0.5))
    return world.step(ground=40.0)


@pytest.mark.parametrize(("elevation", "tip"), [(-0.5, True), (0.5, False)])
def test_the_distance_is_where_the_first_end_meets_the_ground(elevation, tip):
    """Where that end comes down, whatever the javelin does after it."""
    velocity, height = (20.0, 0.0, -12.0), 0.3 + HALF * math.sin(0.5)
    step = flight(elevation, height, velocity)
    time, way = fly(height - HALF * math.sin(0.5) - JAVELIN_RADIUS, elevation, velocity)
    assert 0.01 < time < 1 / 30
    reach = HALF * math.cos(0.5) * (1 if tip else -1)
    assert ended(step) and step.success[0]
    assert step.metrics["distance"][0] == pytest.approx(20.0 + reach + way - 2.0, abs=2e-3)
    assert step.metrics["tip_first"][0] == float(tip)
    assert step.metrics["success"][0] == 1.0


@pytest.mark.parametrize(("x", "counts"), [(1.9, False), (2.1, True), (-5.0, False)])
def test_a_javelin_that_comes_down_behind_the_line_does_not_count(x, counts):
    nose = HALF * math.cos(0.5)
    step = flight(-0.5, HALF * math.sin(0.5) + JAVELIN_RADIUS + 1e-4, (0.0, 0.0, -5.0), x - nose)
    assert ended(step) and bool(step.success[0]) is counts
    assert math.isnan(step.metrics["distance"][0]) is not counts
    if counts:
        assert step.metrics["distance"][0] == pytest.approx(0.1, abs=1e-3)


def test_resting_it_on_the_ground_is_no_throw():
    """A held javelin whose nose reaches the ground beyond the line, and one laid down."""
    world = Throw()
    world.place((1.0, 0.0, STANDING))
    world.javelin((1.2, -0.5, 0.5), elevation=-0.3)  # the nose is at x = 2.5
    world.at(THROW)
    step = world.step(touched=10.0, ground=5.0)
    assert ended(step) and not step.success[0]
    assert math.isnan(step.metrics["distance"][0])
    # Let go of and on the ground within one step: nobody saw it fly.
    world = Throw()
    world.javelin((1.2, -0.5, 0.05), elevation=0.0)
    world.at(THROW)
    step = world.step(ground=5.0)
    assert ended(step) and not step.success[0]


def test_the_release_speed_is_that_of_the_release():
    world = Throw()
    world.javelin(tuple(world.palm().tolist()))
    world.at(THROW)
    world.step(touched=20.0)
    world.javelin(FAR, velocity=(12.0, 0.0, 9.0))
    world.step()
    world.javelin((20.0, 0.0, 1.0), elevation=-0.5, velocity=(12.0, 0.0, -14.0))
    world.env.view.clock[:] = LATE
    world.step()
    world.javelin((20.3, 0.0, 0.5), elevation=-0.5, velocity=(1.0, 0.0, 0.0))
    step = world.step(ground=40.0)
    assert step.success[0]
    assert step.metrics["release_speed"][0] == pytest.approx(15.0, abs=1e-4)


@pytest.mark.parametrize("engine", ["mujoco", "drake"])
def test_a_flying_javelin_is_measured_where_its_tail_lands(engine):
    """Thrown by hand in mid-episode and left to the engine: without spin it keeps its attitude,
    nose up, and the tail comes to the ground as a point with drag does."""
    # Nothing is held: Drake need not take the small steps of hands.
    options = {"timestep": 1 / 480} if engine == "drake" else {}
    env = make_env("javelin", engine=engine, num_worlds=1, training=False, physics_options=options)
    scene, physics = env.physics.scene, env.physics
    slot, speed = scene.object_qpos("javelin"), scene.object_qvel("javelin")
    velocity, height = (11.0, 0.0, 6.0), 2.6
    qpos, qvel = physics.qpos.clone(), torch.zeros_like(physics.qvel)
    quat = (math.cos(UP / 2), 0.0, -math.sin(UP / 2), 0.0)
    qpos[:, slot] = torch.tensor((1.0, -0.6, height, *quat))
    qvel[:, speed] = torch.tensor((*velocity, 0.0, 0.0, 0.0))
    physics.reset(torch.ones(1, dtype=torch.bool), PhysicsState(qpos, qvel, physics.mocap_pos))
    env.view.refresh()
    env.memory = env.task.begin(env.view, {})
    env.view.clock[:] = THROW
    for _ in range(80):
        result = env.step(torch.zeros(1, 1, env.action_size))
        if result.ended[0]:
            break
    _, way = fly(height - HALF * math.sin(UP) - JAVELIN_RADIUS, UP, velocity)
    expected = 1.0 - HALF * math.cos(UP) + way - 2.0
    assert result.terminated[0, 0] and result.metrics["success"][0] == 1.0
    assert result.metrics["distance"][0] == pytest.approx(expected, abs=0.05)
    assert result.metrics["tip_first"][0] == 0.0
    env.close()


@pytest.mark.parametrize("strength", ["paper", "human"])
def test_action_zero_holds_the_javelin_until_it_should_have_been_thrown(strength):
    env = make_env("javelin", num_worlds=4, seed=1, strength=strength)
    for step in range(1, 49):
        result = env.step(torch.zeros(4, 1, env.action_size))
        assert result.terminated.all() == (step == 48), step
        if step < 18:
            assert (result.reward > 0.98).all()
    env.close()


# Starts in the middle of a throw.


def begun(elapsed: list[float], probability: float = 1.0, worlds: int = 8, place=None):
    """Worlds that start from the hold, so long (s) after the beginning of their episodes, with the
    javelin in the hand or elsewhere (m)."""
    probe = make_env("javelin", num_worlds=1, training=False, physics_options={"threads": 1})
    scene, n = probe.physics.scene, len(elapsed)
    state = probe.physics.qpos[0], probe.physics.qvel[0]
    starts = Starts(
        qpos=state[0][scene.agent_qpos(0)].repeat(n, 1),
        qvel=state[1][scene.agent_qvel(0)].repeat(n, 1),
        context={ELAPSED: torch.tensor(elapsed)},
        probability=probability,
        object_qpos=state[0][scene.object_qpos("javelin")].repeat(n, 1),
        object_qvel=state[1][scene.object_qvel("javelin")].repeat(n, 1),
    )
    probe.close()
    assert starts.object_qpos is not None
    if place is not None:
        starts.object_qpos[:, :3] = torch.tensor(place)
    return make_env(
        "javelin", num_worlds=worlds, seed=3, starts=starts, physics_options={"threads": 1}
    )


def test_a_start_in_the_middle_of_a_throw_goes_on_with_its_clock():
    """At 0.5 s the javelin must be held for three more steps; at 1.5 s it must be off the hand in
    three; without a label the clock starts at 0."""
    for elapsed, left in ((0.5, None), (1.5, RELEASE_STEPS - 45), (math.nan, None)):
        env = begun([elapsed])
        steps = 0 if math.isnan(elapsed) else round(30 * elapsed)
        assert env.view.clock.tolist() == env.age.tolist() == [steps] * 8
        assert torch.equal(env.memory["start"][:, :2], torch.zeros(8, 2))
        hold = torch.zeros(8, 1, env.action_size)
        for step in range(1, 5):
            result = env.step(hold)
            assert result.terminated.all() == (step == left)
            if step == left:  # and the next episodes begin at 1.5 s too
                assert env.view.clock.tolist() == env.age.tolist() == [steps] * 8
                break
            assert not result.terminated.any()
            assert env.view.clock.tolist() == [steps + step] * 8
        env.close()


def test_a_javelin_out_of_the_hand_is_lost_only_while_it_must_be_held():
    for elapsed, lost in ((0.0, True), (0.5, True), (0.6, False), (math.nan, True)):
        env = begun([elapsed], place=FAR)
        result = env.step(torch.zeros(8, 1, env.action_size))
        assert result.terminated.all() == result.terminated.any() == lost
        assert env.memory["released"].all() != lost
        env.close()


def test_clocks_of_mixed_starts_survive_automatic_resets_and_a_checkpoint():
    """Starts are worked out ahead of need: each world must get the clock of its own frame."""
    env = begun([1.0, 1.4], probability=0.7, worlds=16)
    clocks = set()
    hold = torch.zeros(16, 1, env.action_size)
    for _ in range(60):
        before = env.view.clock.clone()
        result = env.step(hold)
        fresh = env.view.clock[result.ended]
        clocks |= set(fresh.tolist())
        assert (env.view.clock == before + 1)[~result.ended].all()
        assert (before[result.ended] + 1 >= RELEASE_STEPS).all()
    assert clocks == {0, 30, 42}
    saved = env.state_dict()
    twin = begun([1.0, 1.4], probability=0.7, worlds=16)
    twin.load_state_dict(saved)
    for _ in range(50):
        ours, theirs = env.step(hold), twin.step(hold)
        assert torch.equal(ours.ended, theirs.ended)
        assert torch.equal(env.view.clock, twin.view.clock)
        assert torch.equal(env.age, twin.age)
    env.close()
    twin.close()


@pytest.mark.parametrize("sling", [False, True])
@pytest.mark.parametrize(
    ("low", "since", "over"),
    [(False, 0, 1.0), (True, 0, 0.0), (True, 4, 0.0), (True, 5, 1.0), (True, 7, 1.0)],
)
def test_a_hand_that_swings_below_the_shoulder_slings_the_javelin(low, since, over, sling):
    """``since``: steps with the hand up again before the release, in which it is up too. Down is a
    straight arm that hangs, up one at the height of the shoulder, as in a T-pose. What is slung
    counts only where that was asked for."""
    world = Throw(sling=sling)
    arm = {f"R_{joint}_{axis}": 0.0 for joint in ("Thorax", "Shoulder", "Elbow") for axis in "xyz"}
    shoulder = world.env.physics.scene.body.link_index("R_Shoulder")

    def pose(down: bool) -> float:
        world.place((0.0, 0.0, STANDING), **arm | {"R_Shoulder_x": 1.4 if down else 0.0})
        palm = world.palm()[2]
        return float(palm - world.env.physics.body_pos[0, 0, shoulder, 2])

    assert pose(True) < -0.4 and abs(pose(False)) < 0.15
    world.javelin((0.3, -0.6, 1.5))
    world.at(THROW)
    for down in [low] * 8 + [False] * since:
        pose(down)
        world.javelin((0.3, -0.6, 1.5))
        assert not ended(world.step(touched=5.0))
    world.javelin(FAR)
    assert not ended(world.step())
    pose(True)  # what the hand does after the release does not matter
    world.javelin((22.0, 0.0, 0.15), elevation=-0.1, velocity=(20.0, 0.0, -12.0))
    assert not ended(world.step())
    world.javelin((22.4, 0.0, 0.1), elevation=-0.1, velocity=(1.0, 0.0, 0.5))
    step = world.step(ground=40.0)
    counts = over == 1.0 or sling
    assert step.success[0] == counts and not step.metrics["foul"][0]
    assert bool(step.metrics["distance"].isfinite()[0]) == counts
    assert step.metrics["over_arm"][0] == over


@pytest.mark.parametrize("anywhere", [False, True])
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("degrees", "inside"), [(14.4, True), (14.55, False)])
def test_the_sector_opens_from_the_centre_of_the_arc(degrees, inside, side, anywhere):
    """By the angle at the centre of an arc of 8 m whose ends are 4 m apart, on the foul line: up to
    asin(2 / 8) = 14.48 degrees to either side. The javelin drifts by half a metre in its last
    control step."""
    world = Throw(anywhere=anywhere)
    velocity = (20.0, side * 15.0, -12.0)

    def thrown(y: float):
        released(world)
        world.javelin((22.0, y, 0.15), elevation=0.0, velocity=velocity)
        assert not ended(world.step())
        world.javelin((22.4, y, 0.1), elevation=0.0, velocity=(1.0, 0.0, 0.5))
        return world.step(ground=40.0)

    # Both ends come down at once, by (0.15 - radius) m at 12 m/s.
    time = (0.15 - JAVELIN_RADIUS) / 12.0
    x = {end: 22.0 + end * HALF + 20.0 * time for end in (-1.0, 1.0)}
    far = min(x.values(), key=lambda x: abs(x - 2.0 - float(thrown(0.0).metrics["distance"][0])))
    centre = 2.0 - 8.0 * math.cos(math.asin(2.0 / 8.0))
    y = (far - centre) * math.tan(math.radians(degrees)) - 15.0 * time
    step = thrown(side * y)
    assert step.metrics["distance"].isfinite()[0] == (inside or anywhere)
    assert step.success[0] == (inside or anywhere) and not step.metrics["foul"][0]
    assert step.metrics["in_sector"][0] == inside


def test_an_episode_that_ends_with_the_release_earns_what_a_whole_one_does():
    """The shipped throw played twice: one ends in the air with what the other has once landed."""
    clip = Clip.load(SHIPPED)
    env = make_env("javelin", num_worlds=2, training=False, options={"release_ends": 0.5})
    actions, paid, ends = reference(clip, env), torch.zeros(2), {}
    env.reset()
    for step in range(env.task.max_steps):
        result = env.step(actions[min(step, len(actions) - 1)].expand(2, 1, -1))
        paid += torch.tensor([k not in ends for k in range(2)]) * result.reward[:, 0]
        for k in result.terminated[:, 0].nonzero().flatten().tolist():
            ends.setdefault(k, (step, {n: float(x[k]) for n, x in result.metrics.items()}))
        if len(ends) == 2:
            break
    (early, told), (late, is_so) = ends[0], ends[1]
    assert early < 30 < 60 < late
    assert told["success"] == is_so["success"] == told["tip_first"] == is_so["tip_first"] == 1.0
    assert is_so["distance"] > 35.0
    assert told["distance"] == pytest.approx(is_so["distance"], abs=0.6)
    assert told["release_speed"] == pytest.approx(is_so["release_speed"], rel=1e-3)
    assert float(paid[0]) == pytest.approx(float(paid[1]), rel=0.02)
    env.close()


@pytest.mark.parametrize(
    ("aside", "valid"), [(0.0, True), (3.0, True), (9.0, False), (-9.0, False)]
)
def test_a_flight_may_be_paid_only_where_the_throw_will_count(aside, valid):
    def release(**options) -> tuple[float, bool]:
        world = Throw(release_ends=1.0, **options)
        world.javelin(tuple(world.palm().tolist()))
        world.at(THROW)
        world.step(touched=20.0)
        azimuth = math.atan2(aside, 15.0)
        world.javelin(FAR, elevation=0.6, velocity=(15.0, aside, 9.0), azimuth=azimuth)
        step = world.step()
        assert ended(step) and bool(step.metrics["in_sector"][0]) == valid
        return float(sum(step.terms[k][0, 0] for k in ("goal", "attitude"))), bool(step.success[0])

    paid, counted = release()
    only, likewise = release(counts=True)
    assert counted == likewise == valid and paid > 15.0
    assert only == pytest.approx(paid) if valid else only < 2.0
    # One who does not ask for the sector is paid wherever it comes down.
    assert release(counts=True, anywhere=True) == (pytest.approx(paid), True)
    with pytest.raises(ValueError, match="release_ends"):
        Throw(counts=True)


def test_the_rest_of_a_flight_is_that_of_turning_tops():
    """20 throws against the search's flight, written apart from it, in numpy and finer steps."""
    draw = np.random.default_rng(2)
    world, rows = Throw(), []
    for _ in range(20):
        up, azimuth = draw.uniform(0.2, 0.9), draw.normal(0.0, 0.2)
        place = (0.0, 0.0, draw.uniform(1.2, 2.2))
        velocity = draw.uniform(8.0, 24.0) * np.array((math.cos(up), 0.1 * azimuth, math.sin(up)))
        world.javelin(place, elevation=up + 0.1, velocity=velocity, azimuth=azimuth)
        spin = draw.normal(0.0, 0.5, 3)
        nose = np.array((math.cos(azimuth), math.sin(azimuth))) * math.cos(up + 0.1)
        nose = np.array((*nose, math.sin(up + 0.1)))
        turn = spin - spin @ nose * nose
        # MuJoCo has angular velocities in the body's frame.
        quat = world.state.qpos[0, world.q][3:]
        spun = torch.tensor(turn + 40.0 * nose, dtype=torch.float32)
        local = quaternion.rotate(quaternion.conjugate(quat), spun)
        world.state.qvel[:, world.v][:, 3:] = local
        world._apply()
        view = world.env.view
        told = rest_of_flight(view, torch.tensor(nose[None], dtype=torch.float32), 1 / 30)
        landing = thrown.fly(*(np.array(v, float)[None] for v in (place, velocity, nose, turn)))
        nose_first, elevation = bool(told.nose_first[0]), float(landing.elevation[0])
        rows.append((float(told.x[0]) - 2.0, float(told.y[0]), nose_first))
        assert rows[-1][:2] == pytest.approx((landing.far[0], landing.aside[0]), abs=0.15)
        assert nose_first == (elevation < 0.0) or abs(elevation) < 0.05
        assert 0.0 < float(told.attitude[0]) < 30 * 4.0
    assert {row[2] for row in rows} == {False, True} and max(rows)[0] > 15.0
    with pytest.raises(ValueError, match="share"):
        Throw(release_ends=1.5)


def test_a_foretold_turn_to_the_left_is_one_of_the_javelin():
    """One that turns so, and one that is told to: the same flight. And each world has its own."""
    world = Throw()
    nose = torch.tensor([[math.cos(0.6), 0.0, math.sin(0.6)]])
    told = []
    for own, more in ((1.3, 0.0), (-0.2, 1.5), (-0.2, 0.0)):
        world.javelin((0.0, 0.0, 2.0), elevation=0.6, velocity=(17.0, 0.0, 11.0))
        quat = world.state.qpos[0, world.q][3:]
        spin = quaternion.rotate(quaternion.conjugate(quat), torch.tensor([0.0, 0.0, own]))
        world.state.qvel[:, world.v][:, 3:] = spin
        world._apply()
        told.append(rest_of_flight(world.env.view, nose, 1 / 30, torch.tensor([more])))
    for a, b in zip(told[0], told[1], strict=True):
        torch.testing.assert_close(a, b)
    assert float(told[2].x[0]) > float(told[0].x[0]) + 2.0  # who turns aside has more drag
    clip = Clip.load(SHIPPED)
    options = {"release_ends": 1.0, "release_turn": (-1.5, 1.5)}
    env = make_env("javelin", num_worlds=6, training=False, options=options)
    actions = reference(clip, env)
    env.reset()
    for step in range(40):
        result = env.step(actions[min(step, len(actions) - 1)].expand(6, 1, -1))
        if result.terminated.any():
            break
    assert result.terminated.all()
    far = result.metrics["distance"]
    assert len(set(far.round(decimals=2).tolist())) == 6 and float(far.max() - far.min()) > 2.0
    env.close()
    with pytest.raises(ValueError, match="release_ends"):
        make_env("javelin", num_worlds=1, options={"release_turn": (-1.0, 0.0)})
    # A run that goes on has read its options from JSON, where a pair is a list.
    make_env("javelin", num_worlds=1, options={"release_turn": [0.0, 0.0]}).close()
