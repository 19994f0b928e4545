"""Ring, board and the shot that would go in, against closed forms and FIBA's measures."""

import math

import numpy as np
import pytest
import torch

from sports.hoop import (
    BOARD_BEHIND,
    RIM_HEIGHT,
    RING_RADIUS,
    aim,
    arrival,
    crossing,
    hoop,
    shot,
)
from sports.humanoid.body import load_body
from sports.humanoid.hold import BASKETBALL
from sports.physics import default_state, make_physics
from sports.scene import Scene, Start

RIM = torch.tensor((4.5, 0.0, 3.05))
LINE = torch.tensor((0.35, 0.0, 1.5))


def fly(pos, velocity, time: float) -> torch.Tensor:
    """Where a ball is after a time in free flight."""
    drop = torch.tensor((0.0, 0.0, -4.905 * time * time))
    return pos + time * velocity + drop


def test_the_shot_has_the_numbers_of_the_specification():
    velocity = shot(LINE, RIM)
    forward, _, up = velocity.tolist()
    assert forward == pytest.approx(3.7, abs=0.05) and up == pytest.approx(6.9, abs=0.05)
    time = up / 9.81 + math.sqrt(1.8 / 9.81)
    torch.testing.assert_close(fly(LINE, velocity, time), RIM, rtol=0, atol=1e-5)
    entry = math.degrees(math.atan2(9.81 * math.sqrt(1.8 / 9.81), forward))
    assert entry == pytest.approx(49.0, abs=0.1)
    apex = fly(LINE, velocity, up / 9.81)
    assert float(apex[2]) == pytest.approx(3.95, abs=1e-5)


@pytest.mark.parametrize("place", [(0.0, 3.0, 0.2), (9.0, -4.0, 2.9), (4.5, 1.0, 3.9)])
def test_a_shot_from_anywhere_arrives(place):
    ball = torch.tensor(place)
    velocity = shot(ball, RIM)
    time = float(velocity[2]) / 9.81 + math.sqrt(1.8 / 9.81)
    torch.testing.assert_close(fly(ball, velocity, time), RIM, rtol=0, atol=1e-5)


def test_a_shot_from_above_the_apex_falls_from_there():
    ball = torch.tensor((3.5, 0.0, 5.0))
    velocity = shot(ball, RIM)
    assert float(velocity[2]) == 0.0
    landed = fly(ball, velocity, math.sqrt(2 * 1.95 / 9.81))
    torch.testing.assert_close(landed, RIM, rtol=0, atol=1e-5)


def test_aim_is_the_formula():
    velocity = torch.tensor((3.0, 0.5, 6.0))
    error = velocity - shot(LINE, RIM)
    wanted = math.exp(-0.1 * float(error.norm()) ** 2)
    assert float(aim(LINE, velocity, RIM)) == pytest.approx(wanted, rel=1e-5)
    assert float(aim(LINE, shot(LINE, RIM), RIM)) == 1.0


def test_a_crossing_is_where_a_parabola_crosses():
    """A shot at v*: at the middle of the rim, at 49 degrees, in the step in which it comes down."""
    velocity = shot(LINE, RIM)
    seen = 0
    for k in range(40):
        before, now = (fly(LINE, velocity, (k + d) / 30) for d in (0.3, 1.3))
        cross = crossing(before, now, RIM, 1 / 30)
        time = 6.933 / 9.81 + math.sqrt(1.8 / 9.81)
        assert bool(cross.down) is ((k + 0.3) / 30 < time <= (k + 1.3) / 30)
        rise = 6.933 / 9.81 - math.sqrt(1.8 / 9.81)
        assert bool(cross.up) is ((k + 0.3) / 30 <= rise < (k + 1.3) / 30)
        if cross.down:
            seen += 1
            assert bool(cross.inside) and float(cross.miss) < 2e-3
            assert math.degrees(float(cross.angle)) == pytest.approx(49.0, abs=0.2)
    assert seen == 1


@pytest.mark.parametrize(("aside", "inside"), [(0.0, True), (0.228, True), (0.232, False)])
def test_the_balls_middle_must_be_inside_the_ring(aside: float, inside: bool):
    before = RIM + torch.tensor((0.0, aside, 0.1))
    now = RIM + torch.tensor((0.0, aside, -0.1))
    cross = crossing(before, now, RIM, 1 / 30)
    assert bool(cross.down) and not cross.up and bool(cross.inside) is inside
    assert float(cross.miss) == pytest.approx(aside, abs=1e-5)
    back = crossing(now, before, RIM, 1 / 30)
    assert bool(back.up) and not back.down


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_ring_and_board_have_their_measures(side: float):
    ring, board = hoop("east", (side * 12.925, 0.0, RIM_HEIGHT), side)
    *pieces, bracket = ring.shapes
    # Along every piece: from the rim's axis to its inner side.
    gaps, tops = [], []
    for piece in pieces:
        start, end = np.array(piece.center), np.array(piece.end)
        for share in np.linspace(0.0, 1.0, 11):
            point = start + share * (end - start)
            gaps.append(np.hypot(point[0], point[1]) - piece.size[0])
            tops.append(point[2] + piece.size[0])
    assert abs(np.array(gaps) - RING_RADIUS).max() < 0.0025
    assert np.allclose(tops, 0.0)
    # FIBA: inner diameter 450 to 459 mm, metal 16 to 20 mm thick.
    assert 0.45 - 0.005 < 2 * np.mean(gaps) < 0.465
    (plate,) = board.shapes
    middle, half = np.array(plate.center) + np.array(board.pos), np.array(plate.size)
    assert abs(middle[0]) - half[0] == pytest.approx(12.925 + BOARD_BEHIND)
    assert np.sign(middle[0]) == side
    assert (2 * half[1], 2 * half[2]) == (pytest.approx(1.8), pytest.approx(1.05))
    assert middle[2] - half[2] == pytest.approx(2.90)
    # The bracket fills the gap between the two and no more.
    ends = abs(bracket.center[0]) + bracket.size[0] * np.array([-1.0, 1.0])
    assert ends == pytest.approx([RING_RADIUS + 0.018, BOARD_BEHIND])


def test_a_ball_passes_the_ring_only_where_it_fits():
    """Dropped over the ring: in the middle, near the metal inside and near it outside. Where it
    goes through, 0.11 m are left between its middle and that of the ring."""
    scene = Scene(
        name="drop",
        body=load_body("smplx"),
        agents=(Start(x=-3.0),),
        objects=(BASKETBALL, *hoop("hoop", (4.5, 0.0, RIM_HEIGHT), 1.0)),
        timestep=1 / 240,
        substeps=8,
    )
    physics = make_physics("mujoco", scene, 3, threads=1)
    state = default_state(scene, 3, "cpu")
    ball = scene.object_qpos("ball").start
    aside = torch.tensor([[0.0, 0.05, 0.3], [-0.2, 0.0, 0.3], [-0.29, 0.0, 0.3]])
    state.qpos[:, ball : ball + 3] = RIM + aside
    physics.reset(torch.ones(3, dtype=torch.bool), state)
    before, miss = physics.object_pos[:, 0].clone(), torch.full((3,), torch.nan)
    for _ in range(25):
        physics.step(torch.zeros(3, scene.nu))
        cross = crossing(before, physics.object_pos[:, 0], RIM, 1 / 30)
        miss = torch.where(cross.down, cross.miss, miss)
        before = physics.object_pos[:, 0].clone()
    assert (miss[:2] < 0.115).all() and miss[2] > RING_RADIUS
    physics.close()


def test_where_a_ball_would_arrive_is_where_it_does():
    """Against the path of every millisecond; a ball that stays below the rim arrives nowhere."""
    rim = torch.tensor((4.5, 0.0, 3.05))
    for place, velocity in (
        ((0.4, 0.1, 1.7), (3.5, 0.2, 7.0)),
        ((0.4, 0.0, 1.7), (2.0, -0.3, 8.0)),
        ((3.0, 0.5, 3.6), (2.0, 0.0, -1.0)),
    ):
        pos, vel = torch.tensor(place, dtype=torch.float64), torch.tensor(velocity).double()
        t = torch.arange(0.0, 3.0, 1e-3, dtype=torch.float64)[:, None]
        path = pos + t * vel - torch.tensor((0.0, 0.0, 9.81 / 2)) * t * t
        last = int((path[:, 2] > rim[2]).nonzero().max())
        miss = float((path[last, :2] - rim[:2]).norm())
        assert float(arrival(pos, vel, rim).miss) == pytest.approx(miss, abs=6e-3)
    low = arrival(torch.tensor((0.4, 0.0, 1.7)), torch.tensor((4.0, 0.0, 5.0)), rim).miss
    assert low == torch.inf


def test_a_clean_ball_comes_down_inside_the_ring_seen_along_its_path():
    """Straight down a ball of 0.12 m has 0.11 m to each side; at 30 degrees the ring of 0.23 m is
    0.115 m high as the ball sees it, and none goes in clean."""
    rim = torch.tensor((4.5, 0.0, 3.05))
    above = torch.tensor([(4.5 + x, 0.0, 4.0) for x in (0.1, 0.12)])
    down = arrival(above, torch.zeros(2, 3), rim)
    assert down.angle.tolist() == pytest.approx([math.pi / 2] * 2)
    assert down.clean(0.12).tolist() == [True, False]
    velocity = torch.tensor((math.sqrt(3.0), 0.0, -1.0), dtype=torch.float64)
    flat = arrival(rim - 1e-6 * velocity, velocity, rim.double())
    assert float(flat.angle) == pytest.approx(math.pi / 6, abs=1e-4)
    assert not flat.clean(0.12) and flat.clean(0.114)
