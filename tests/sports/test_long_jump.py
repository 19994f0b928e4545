"""The long jump's rules on states made by hand, with known answers."""

import math

import pytest
import torch

from sports.long_jump import FLIGHT, LANDED, RUN, length_bound
from tests.sports.hand_made import HandMade

STANDING = 0.9412


def mode(world: HandMade) -> int:
    return int(world.env.memory["mode"][0])


def jump(world: HandMade, landing_x: float, link: str = "L_Ankle", **joints: float):
    """Take off at 20.3, land on ``link``, stay for the marks; returns the steps after landing."""
    world.place((19.0, 0, STANDING))
    world.begin()
    world.place((20.3, 0, 1.3))
    world.advance()
    assert mode(world) == FLIGHT
    world.place((landing_x, 0, 0.9), **joints)
    world.drop_to_ground(link)
    return [world.advance({link: 400.0}) for _ in range(10)]


def test_a_legal_jump_is_measured_to_the_nearest_mark():
    world = HandMade("long_jump")
    steps = jump(world, 25.0)
    assert mode(world) == LANDED
    assert [bool(s.terminated[0]) for s in steps] == [False] * 9 + [True]
    # Independent: the rearmost heel of the T-pose from the body table's right leg (offsets of
    # hip, knee and ankle, then the box's centre and half-length).
    heel = 25.0 - 0.0043 - 0.0089 - 0.0423 + 0.0256 - 0.0865
    assert steps[-1].metrics["length"][0] == pytest.approx(heel - 20.0, abs=1e-4)
    assert steps[-1].metrics["success"][0] == 1.0
    assert steps[-1].terms["length"][0, 0] == pytest.approx(30 * (heel - 20.0), abs=3e-3)
    assert all(s.terms["length"][0, 0] == 0.0 for s in steps[:-1])


def test_sitting_back_shortens_the_jump():
    feet = jump(HandMade("long_jump"), 25.0)[-1].metrics["length"][0]
    world = HandMade("long_jump")
    world.place((19.0, 0, STANDING))
    world.begin()
    world.place((20.3, 0, 1.3))
    world.advance()
    world.place((25.0, 0, 0.9))
    world.drop_to_ground("L_Ankle")
    world.advance({"L_Ankle": 400.0})
    # Sits down with the pelvis half a metre further back: the mark moves with it.
    world.place((24.4, 0, 0.07))
    last = [world.advance({"Pelvis": 900.0}) for _ in range(9)][-1]
    assert last.success[0]
    assert last.metrics["length"][0] < feet - 0.5


def test_marks_after_nine_steps_do_not_count():
    world = HandMade("long_jump")
    steps = jump(world, 25.0)
    assert steps[9].terminated[0] and not steps[8].terminated[0]


def test_a_foot_on_the_line_is_a_foul_and_one_behind_it_is_not():
    toe_tip = -0.0068 - 0.0045 - 0.0437 + 0.1193 + 0.0248 + 0.0496  # of the left toe, from the root
    for beyond, foul in ((-0.002, False), (0.002, True)):
        world = HandMade("long_jump")
        world.place((18.0, 0, STANDING))
        world.begin()
        world.place((20.0 - toe_tip + beyond, 0, STANDING))
        world.drop_to_ground("L_Toe")
        step = world.advance({"L_Toe": 300.0})
        assert bool(step.terminated[0]) is foul
        assert step.metrics["foul"][0] == float(foul)
        assert not step.success[0]


def test_a_touch_beyond_the_line_within_one_step_is_a_foul():
    world = HandMade("long_jump")
    world.place((20.2, 0, 1.1))
    world.begin()
    world.env.memory["mode"][:] = RUN
    world.place((20.4, 0, 1.1))  # off the ground at both ends of the step, touched in between
    step = world.advance({"R_Toe": 80.0})
    assert step.terminated[0] and step.metrics["foul"][0] == 1.0


def test_flight_needs_the_root_beyond_the_line_and_no_contact():
    world = HandMade("long_jump")
    world.place((19.0, 0, 1.3))
    world.begin()
    world.place((19.9, 0, 1.3))
    world.advance()
    assert mode(world) == RUN
    world.place((20.05, 0, 1.3))
    world.advance()
    assert mode(world) == FLIGHT


def test_hands_on_the_runway_end_the_run():
    world = HandMade("long_jump")
    world.place((10.0, 0, STANDING))
    world.begin()
    world.place((10.2, 0, STANDING))
    assert not world.advance({"L_Toe": 700.0}).terminated[0]
    assert not world.advance({"L_Hand": 49.0}).terminated[0]
    assert world.advance({"L_Hand": 51.0}).terminated[0]


def test_a_second_flight_is_never_measured():
    world = HandMade("long_jump")
    first = jump(world, 23.0)
    assert first[-1].terminated[0]
    world = HandMade("long_jump")
    world.place((19.0, 0, STANDING))
    world.begin()
    world.place((20.3, 0, 1.3))
    world.advance()
    world.place((23.0, 0, 0.9))
    world.drop_to_ground("L_Ankle")
    world.advance({"L_Ankle": 4000.0})
    # Bounces on: four metres further in the air, then a second landing.
    world.place((25.0, 0, 1.5))
    for _ in range(4):
        world.advance()
    world.place((27.0, 0, 0.9))
    world.drop_to_ground("L_Ankle")
    last = [world.advance({"L_Ankle": 400.0}) for _ in range(5)][-1]
    assert last.success[0]
    assert last.metrics["length"][0] < 3.0


@pytest.mark.parametrize(
    ("x", "y", "out"), [(10, 0.49, 0), (10, 0.51, 1), (21, 1.4, 0), (21, 1.6, 1)]
)
def test_the_track_is_narrow_and_the_pit_is_wider(x: float, y: float, out: int):
    world = HandMade("long_jump")
    world.place((x - 0.2, y, 1.3))
    world.begin()
    world.place((x, y, 1.3))
    assert bool(world.advance().terminated[0]) is bool(out)


def test_reward_terms_match_the_formulas():
    world = HandMade("long_jump")
    world.place((10.0, 0, STANDING))
    world.begin()
    world.place((10.3, 0, STANDING))
    step = world.advance({"L_Toe": 700.0}, velocity=9.0)
    before = math.dist((10.0, 0, STANDING), (30, 0, 1))
    now = math.dist((10.3, 0, STANDING), (30, 0, 1))
    assert step.terms["progress"][0, 0] == pytest.approx(before - now, abs=1e-5)
    assert step.terms["speed"][0, 0] == pytest.approx(0.09, abs=1e-6)
    assert step.terms["flight"][0, 0] == 0.0
    world.place((20.3, 0, 1.3))
    assert world.advance().terms["flight"][0, 0] == pytest.approx(0.13, abs=1e-6)


def test_a_somersault_is_told_by_its_rotation():
    """Ten steps in the air at 6 rad/s about the lateral axis turn the athlete by 2 rad."""
    world = HandMade("long_jump")
    world.place((19.0, 0, STANDING))
    world.begin()
    world.place((20.3, 0, 1.5))
    world.state.qvel[:, 4] = 6.0
    for _ in range(10):
        world.advance()
    world.state.qvel[:, 4] = 0.0
    world.place((23.0, 0, 0.9))
    world.drop_to_ground("L_Ankle")
    last = [world.advance({"L_Ankle": 400.0}) for _ in range(10)][-1]
    assert last.metrics["rotation"][0] == pytest.approx(10 / 30 * 6.0, abs=1e-4)


@pytest.mark.parametrize(
    ("turned", "allowed", "counts"),
    [
        (85, False, True),
        (-85, False, True),
        (95, False, False),
        (-95, False, False),
        (95, True, True),
    ],
)
def test_who_turns_over_in_flight_has_failed_where_somersaults_are_not_allowed(
    turned: int, allowed: bool, counts: bool
):
    """Tipped forward and back, and sideways by the same angle; in the sand it is no matter."""
    for axis in (2, 1):  # of the quaternion: y, x
        world = HandMade("long_jump", somersaults=allowed)
        world.place((19.0, 0, STANDING))
        world.begin()
        upright = world.state.qpos[:, 3:7].clone()
        half = math.radians(turned) / 2
        world.place((20.3, 0, 1.5))
        world.state.qpos[:, 3:7] = 0.0
        world.state.qpos[:, 3], world.state.qpos[:, 3 + axis] = math.cos(half), math.sin(half)
        step = world.advance()
        assert bool(step.terminated[0]) is not counts
        assert bool(step.metrics["foul"][0]) is not counts
        if not counts:
            continue
        world.state.qpos[:, 3:7] = upright
        world.place((23.0, 0, 0.9))
        world.drop_to_ground("L_Ankle")
        world.advance({"L_Ankle": 400.0})
        world.state.qpos[:, 3:7] = torch.tensor([0.0, 0.0, 1.0, 0.0])  # head down in the sand
        world.drop_to_ground("L_Ankle")
        assert bool([world.advance() for _ in range(9)][-1].success[0])


def test_length_bound_is_the_best_ballistic_range():
    """Independent: the range maximised over the angle by brute force."""
    speed, drop, g = 9.5, 0.6, 9.81
    best = 0.0
    for degrees in torch.linspace(5, 60, 2000):
        angle = math.radians(float(degrees))
        vx, vz = speed * math.cos(angle), speed * math.sin(angle)
        best = max(best, vx * (vz + math.sqrt(vz * vz + 2 * g * drop)) / g)
    bound = length_bound(torch.tensor([speed]), torch.tensor([1.1]), torch.tensor([0.5]))
    assert float(bound[0]) == pytest.approx(best + 1.2, abs=1e-3)
