"""Fencing: the piste, the sword, and what a thrust, a slash and a kick are worth in the engine."""

import math

import pytest
import torch

from sports.fencing import GUARD
from tests.sports.bout import Bout


def on_guard_with_the_point_at_the_chest(beyond: float, aside: float = 0.0) -> Bout:
    """Athlete 0 on guard, its point ``beyond`` (m) the front of the opponent's chest along x and
    ``aside`` of its middle along y; placed by where the engine shows both. The opponent is in
    T-pose."""
    bout = Bout("fencing")
    bout.place(1, 1.5, 0.0, math.pi, z=0.94, pose={})
    bout.begin()
    physics, body = bout.env.physics, bout.body
    hand, chest = body.link_index("R_Hand"), body.link_index("Chest")
    tip = physics.body_pos[0, 0, hand] - 0.98 * physics.body_rot[0, 0, hand, :, 1]
    # Chest: a capsule of 0.1 m, 0.019 behind its origin; the opponent faces -x.
    middle = physics.body_pos[0, 1, chest] + torch.tensor((0.019, -0.001, 0.0))
    front = float(middle[0]) - 0.1002
    x = -1.5 + front + beyond - float(tip[0])
    bout.place(0, x, float(middle[1] - tip[1]) + aside)
    bout.begin()
    return bout


def test_a_thrust_scores_once_however_long_one_pushes():
    bout = on_guard_with_the_point_at_the_chest(-0.03)
    bout.move(0, 1.5, 0.0, 0.0)
    bout.begin()
    results = list(bout.play(14))
    points = [float(r.terms["point"][0, 0]) for r in results]
    assert sum(points) == 1.0
    assert [float(r.terms["point"][0, 1]) for r in results] == [-p for p in points]
    assert results[-1].metrics["touches_for"][0] == 1.0
    assert not any(bool(r.ended.any()) for r in results)


def test_two_who_thrust_alike_touch_alike():
    """Both on guard, one reach apart, moving on each other: nobody gains."""
    bout = Bout("fencing")
    bout.place(0, -0.77, 0.082)
    bout.place(1, 0.77, -0.082, math.pi)
    bout.move(0, 1.0, 0.0, 0.0)
    bout.move(1, -1.0, 0.0, 0.0)
    bout.begin()
    results = list(bout.play(8))
    assert not any(float(r.terms["point"].abs().max()) for r in results)
    last = results[-1].metrics
    assert last["touches_for"][0] == last["touches_against"][0] == last["draw"][0] == 1.0


def test_without_reaching_there_is_no_point():
    bout = on_guard_with_the_point_at_the_chest(-0.2)
    assert not any(float(r.terms["point"].abs().max()) for r in bout.play(10))


def test_the_side_of_the_blade_scores_nothing():
    """The blade's middle struck against the trunk, its point 0.4 m beyond."""
    bout = on_guard_with_the_point_at_the_chest(0.4, aside=0.12)
    bout.move(0, 0.0, -2.0, 0.0)
    bout.begin()
    trunk = [bout.body.link_index(name) for name in ("Torso", "Spine", "Chest")]
    pressed = 0.0
    for result in bout.play(4):
        pressed = max(pressed, float(bout.env.physics.link_force[0, 1, trunk].norm(dim=-1).max()))
        assert result.terms["point"][0].tolist() == [0.0, 0.0]
        assert float(bout.env.physics.pair_force.abs().max()) == 0.0
    assert pressed > 50.0


def test_a_kick_scores_nothing():
    """A horizontal leg whose foot meets the pelvis."""
    bout = Bout("fencing")
    bout.place(0, 0.0, pose={"L_Hip_y": -math.pi / 2})
    bout.show()
    physics, body = bout.env.physics, bout.body
    foot = physics.body_pos[0, 0, body.link_index("L_Toe")]
    pelvis = body.links[0].shapes[0]
    # The toes' box is 0.02 m thick to either side, and soles are now fronts.
    bout.place(
        1, float(foot[0]) + pelvis.size[0], float(foot[1]), z=float(foot[2]), yaw=math.pi, pose={}
    )
    bout.move(0, 2.0, 0.0, 0.0)
    bout.begin()
    kicked = 0.0
    for result in bout.play(2):
        kicked = max(kicked, float(physics.link_force[0, 1, 0].norm()))
        assert result.terms["point"][0].tolist() == [0.0, 0.0]
    assert kicked > 50.0 and float(physics.pair_force.abs().max()) == 0.0


@pytest.mark.parametrize(
    ("x", "y", "out"),
    [(6.99, 0, 0), (7.01, 0, 1), (-6.99, 0, 0), (-7.01, 0, 1)]
    + [(0, 0.99, 0), (0, 1.01, 1), (3, -0.99, 0), (3, -1.01, 1)],
)
@pytest.mark.parametrize("agent", [0, 1])
def test_who_leaves_the_piste_has_lost(agent: int, x: float, y: float, out: int):
    bout = Bout("fencing")
    bout.begin()
    bout.place(agent, x, y)
    step = bout.step()
    assert step.terminated[0].tolist() == [bool(out) and agent == 0, bool(out) and agent == 1]
    assert step.metrics["out"][0] == out * (agent == 0)
    assert step.metrics["opponent_out"][0] == out * (agent == 1)
    assert step.metrics["success"][0] == out * (agent == 1)
    assert step.metrics["draw"][0] == 1 - out and step.metrics["fell"][0] == 0.0


def test_a_sword_on_the_ground_is_no_fall():
    bout = Bout("fencing")
    bout.begin()
    assert not bout.step(ground={(0, "R_Hand"): 300.0}).terminated.any()
    assert bout.step(ground={(0, "R_Wrist"): 51.0}).terminated[0].tolist() == [True, False]


def test_the_piste_as_seen():
    """Its corners ahead on the left and behind on the right, from where one stands and looks."""
    bout = Bout("fencing")
    bout.place(0, 2.0, 0.5, yaw=math.pi / 2)
    bout.begin()
    bounds = bout.features()["bounds"][0]
    # Athlete 0 looks along +y: ahead is y, left is -x.
    assert bounds[0].tolist() == pytest.approx((0.5, -5.0, -1.5, 9.0), abs=1e-5)
    # Athlete 1 stands at (1.5, 0) and looks along -x.
    assert bounds[1].tolist() == pytest.approx((8.5, 1.0, -5.5, -1.0), abs=1e-5)


def test_targets_as_seen_from_the_point():
    """Chest 0.3 m beyond the point of a sword held to the right."""
    bout = Bout("fencing")
    bout.reach_out(0.3)
    bout.begin()
    targets = bout.features()["targets"][0, 0].view(5, 3)
    assert targets[3].tolist() == pytest.approx((0.0, -0.3, 0.0), abs=1e-5)
    # The head is above the chest by the offsets of neck and head.
    above = (-0.0429 + 0.0513, -0.0028 + 0.0052, 0.2139 + 0.065)
    x, y, z = above  # of an opponent that faces +x, seen by one that faces +y
    assert targets[4].tolist() == pytest.approx((y, -0.3 - x, z), abs=1e-5)


def test_the_guard_points_at_the_opponent():
    """The line of the blade passes the middle of the opponent's chest by less than 0.12 m."""
    bout = Bout("fencing")
    bout.begin()
    physics, body = bout.env.physics, bout.body
    hand, chest = body.link_index("R_Hand"), body.link_index("Chest")
    blade = -physics.body_rot[0, 0, hand, :, 1]
    away = physics.body_pos[0, 1, chest] + torch.tensor((0, 0, 0.07)) - physics.body_pos[0, 0, hand]
    assert float(torch.linalg.cross(blade, away).norm()) < 0.12
    assert set(GUARD) <= {dof.name for dof in body.dofs}
