"""The high jump's rules on states made by hand, with known answers."""

import math

import pytest
import torch

from sports.env import make_env
from sports.high_jump import HEIGHTS
from sports.registry import get_task, make_config
from tests.sports.hand_made import HandMade

HIGH = 1.9  # root height at which the whole T-pose is above a 1 m bar


def at(x: float, y: float = 6.0, z: float = HIGH, bar: float = 0.8) -> HandMade:
    world = HandMade("high_jump", bar_height=bar)
    world.place((x, y, z))
    world.begin()
    return world


def move_bar(world: HandMade, dx: float = 0.0, dz: float = 0.0) -> None:
    start = world.env.physics.scene.object_qpos("bar").start
    world.state.qpos[:, start] += dx
    world.state.qpos[:, start + 2] += dz


def test_clearing_landing_and_waiting_is_a_success():
    world = at(19.8)
    world.place((20.3, 6.0, HIGH))
    assert not world.advance().terminated[0]
    world.place((20.6, 6.0, 0.9412))
    steps = [world.advance({"L_Toe": 800.0}) for _ in range(16)]
    assert [bool(s.terminated[0]) for s in steps] == [False] * 15 + [True]
    assert steps[-1].success[0]
    assert [float(s.terms["cleared"][0, 0]) for s in steps] == [0.0] * 15 + [50.0]
    assert steps[-1].metrics["height"][0] == pytest.approx(HIGH, abs=1e-5)


def test_clearance_is_that_of_the_jump_not_of_the_landing():
    """Lowest point of the T-pose over the bar is a heel, 0.9367 m below the root; after the
    landing the athlete walks back under the bar's plane, which does not count."""
    world = at(19.8)
    for x in (19.95, 20.0, 20.05, 20.3):
        world.place((x, 6.0, HIGH))
        world.advance()
    over_bar = float(world.env.memory["lowest_over_bar"][0])
    assert over_bar == pytest.approx(HIGH - 0.9367, abs=2e-3)
    world.place((20.6, 6.0, 0.9412))
    world.advance({"L_Toe": 800.0})
    world.place((20.15, 6.0, 0.9412))
    world.advance({"L_Toe": 800.0})
    assert float(world.env.memory["lowest_over_bar"][0]) == over_bar


@pytest.mark.parametrize(("newtons", "over"), [(49.0, False), (51.0, True)])
def test_the_bar_may_be_brushed_but_not_pushed(newtons: float, over: bool):
    world = at(19.0)
    assert bool(world.advance(pair=newtons).terminated[0]) is over


@pytest.mark.parametrize(
    ("dx", "dz", "over"),
    [
        (0.0, -0.049, False),
        (0.0, -0.051, True),
        (0.099, 0.0, False),
        (0.101, 0.0, True),
        (0.0, 0.2, False),
    ],
)
def test_the_bar_must_stay_where_it_rests(dx: float, dz: float, over: bool):
    world = at(19.0)
    move_bar(world, dx, dz)
    assert bool(world.advance().terminated[0]) is over


def test_a_bar_that_falls_after_the_landing_spoils_the_jump():
    world = at(19.8)
    world.place((20.3, 6.0, HIGH))
    world.advance()
    world.place((20.6, 6.0, 0.9412))
    for _ in range(10):
        assert not world.advance({"L_Toe": 800.0}).terminated[0]
    move_bar(world, dz=-0.06)
    step = world.advance({"L_Toe": 800.0})
    assert step.terminated[0] and not step.success[0]


@pytest.mark.parametrize(
    ("y", "z", "ends"),
    [
        (6.0, HIGH, False),
        (4.05, HIGH, False),
        (3.95, HIGH, True),
        (7.95, HIGH, False),
        (6.0, 0.75, True),
    ],
)
def test_only_over_the_bar_between_the_uprights(y: float, z: float, ends: bool):
    world = at(19.9, y=y, z=z)
    world.place((20.1, y, z))
    assert bool(world.advance().terminated[0]) is ends


def test_the_crossing_is_interpolated_within_the_step():
    """Rising through the bar's height: below it at x = 20, above it at the end of the step."""
    world = at(19.9, z=0.60, bar=0.8)
    world.place((20.3, 6.0, 1.2))  # z at x = 20 is 0.75
    assert world.advance().terminated[0]
    world = at(19.9, z=0.70, bar=0.8)
    world.place((20.3, 6.0, 1.2))  # z at x = 20 is 0.825
    assert not world.advance().terminated[0]


def test_standing_at_the_bar_pays_nothing_and_ends():
    world = at(19.7, z=0.9412)
    steps = [world.advance({"L_Toe": 700.0}) for _ in range(15)]
    assert all(float(sum(s.terms.values())[0, 0]) == 0.0 for s in steps)
    assert [bool(s.terminated[0]) for s in steps] == [False] * 14 + [True]


def test_height_is_paid_for_new_ground_only():
    world = at(19.6)
    world.place((19.8, 6.0, HIGH))
    assert world.advance().terms["height"][0, 0] == pytest.approx(HIGH * 2.0, rel=1e-5)
    world.place((19.7, 6.0, HIGH))
    assert world.advance().terms["height"][0, 0] == 0.0
    world.place((19.85, 6.0, HIGH))
    assert world.advance().terms["height"][0, 0] == pytest.approx(HIGH * 0.5, rel=1e-4)


def test_progress_is_clamped_metres():
    world = at(10.0, z=0.9412)
    world.place((10.25, 6.0, 0.9412))
    goal = (22.0, 6.0, 1.0)
    expected = math.dist((10.0, 6.0, 0.9412), goal) - math.dist((10.25, 6.0, 0.9412), goal)
    assert world.advance().terms["progress"][0, 0] == pytest.approx(expected, abs=1e-5)
    world.place((9.0, 6.0, 0.9412))
    assert world.advance().terms["progress"][0, 0] == 0.0


def test_hands_before_the_bar_are_a_fall_and_beyond_it_are_not():
    world = at(15.0, z=0.9412)
    assert world.advance({"R_Hand": 51.0}).terminated[0]
    world = at(20.5)
    assert not world.advance({"R_Hand": 51.0}).terminated[0]


def test_the_field_ends():
    for x, y in ((-0.6, 1.0), (5.0, -0.6), (5.0, 8.1)):
        assert at(x, y=y, z=1.5).advance().terminated[0]


def test_worlds_are_promoted_only_by_clearing_their_own_level():
    world = HandMade("high_jump", num_worlds=4, bar_height=1.0)
    env = world.env
    world.place((19.8, 6.0, HIGH))
    world.begin()
    env.view.curriculum = {"level": torch.tensor([1, 2, 1, 1])}
    env.memory["standing"][3] = False  # started in the flight of a demonstration
    step = world.advance()
    step.success = torch.tensor([True, True, False, True])
    levels = env.task.promote(env.view, env.memory, step, torch.ones(4, dtype=torch.bool))
    assert levels["level"].tolist() == [2, 2, 1, 1]
    assert HEIGHTS == (0.5, 1.0, 1.5, 2.0)
    env.view.curriculum = {"level": torch.tensor([3, 3, 3, 3])}
    step.success[:] = True
    env.memory["bar_height"][:] = 2.0
    top = env.task.promote(env.view, env.memory, step, torch.ones(4, dtype=torch.bool))
    assert top["level"].tolist() == [3, 3, 3, 3]


def test_levels_of_ones_own():
    env = make_env("high_jump", num_worlds=64, options={"levels": [0.4, 0.6, 0.9]})
    env.view.curriculum = {"level": torch.full((64,), 2)}
    env.reset()
    drawn = env.memory["bar_height"].unique().tolist()
    assert drawn == pytest.approx([0.4, 0.6, 0.9])
    for bad in ([], [0.9, 0.6], [0.5, 0.5], [0.0], [9.0]):
        with pytest.raises(ValueError, match=r"bar must be|levels must rise"):
            make_config(get_task("high_jump"), {"levels": bad})
    with pytest.raises(ValueError, match="not be negative"):
        make_config(get_task("high_jump"), {"cleared": -1.0})


def test_the_bar_rests_on_its_uprights_for_three_seconds():
    """A physical test: nobody touches it, it stays within a millimetre at every height."""
    from sports.physics import default_state, make_physics

    world = HandMade("high_jump", num_worlds=2, bar_height=1.5)
    scene = world.env.physics.scene
    physics = make_physics("mujoco", scene, 2, threads=1)
    state = default_state(scene, 2, "cpu")
    for i, height in enumerate((0.5, 2.0)):
        bar = scene.object_qpos("bar").start
        lift = height - 1.5
        state.qpos[i, bar + 2] += lift
        state.mocap_pos[i, :, 2] += lift
    physics.reset(torch.tensor([True, True]), state)
    rest = physics.object_pos.clone()
    for _ in range(90):
        physics.step(torch.zeros(2, scene.nu))
    assert (physics.object_pos - rest).abs().max() < 1e-3
