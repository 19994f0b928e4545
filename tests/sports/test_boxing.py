"""Boxing: both gloves as one weapon, the ropes, and what a blow and a kick are worth."""

import math

import pytest
import torch

from sports.boxing import HALF_RING
from sports.env import make_env
from tests.sports.bout import Bout


def test_both_gloves_are_seen_the_left_first():
    bout = Bout("boxing")
    bout.reach_out(0.3)
    bout.begin()
    left, right = bout.features()["targets"][0, 0].view(2, 5, 3)
    assert right[3].tolist() == pytest.approx((0.0, -0.3, 0.0), abs=1e-5)
    # From the left hand to the right one it is the span of the arms further.
    origins = bout.body.zero_pose_origins()
    hands = [origins[bout.body.link_index(f"{side}_Hand")] for side in "LR"]
    span = (hands[0] - hands[1]).tolist()
    assert left[3].tolist() == pytest.approx((-span[0], -0.3 - span[1], -span[2]), abs=1e-5)


@pytest.mark.parametrize("weapon", [0, 1])
def test_either_glove_scores_and_strikes(weapon: int):
    bout = Bout("boxing")
    bout.begin()
    bout.env.memory["squares"].zero_()
    assert bout.step((0, 60.0, "Head", weapon)).terms["point"][0, 0] == 1.0


def test_both_gloves_together_are_one_point():
    """And one glove that holds keeps the other from scoring."""
    bout = Bout("boxing")
    bout.begin()

    def step(*hits):
        bout.env.memory["squares"].zero_()
        return float(bout.step(*hits).terms["point"][0, 0])

    assert step((0, 200.0, "Head", 0), (0, 200.0, "Chest", 1)) == 1.0
    for _ in range(20):
        assert step((0, 20.0, "Chest", 0)) == 0.0
    assert step((0, 20.0, "Chest", 0), (0, 200.0, "Head", 1)) == 0.0
    for _ in range(15):
        assert step() == 0.0
    assert step((0, 200.0, "Head", 1)) == 1.0


def test_the_nearer_glove_strikes():
    """Arms bent alike: the right glove nearer by turning, then the left one; the same pay."""
    bout = Bout("boxing")
    bout.begin()
    physics, pay = bout.env.physics, []
    for side in "LR":
        bout.begin()
        hand = physics.body_pos[0, 0, bout.body.link_index(f"{side}_Hand")]
        head = physics.body_pos[0, 1, bout.body.link_index("Head")]
        x, y, z = (hand + torch.tensor((0.2, 0.0, 0.0)) - head).tolist()
        bout.place(1, 1.5 + x, y, math.pi, z=0.9 + z)
        pay.append(float(bout.step().terms["strike"][0, 0]))
        bout.place(1, 1.5, 0.0, math.pi)
    assert pay == pytest.approx([0.6 * math.exp(-10 * 0.04)] * 2, abs=1e-5)


def test_a_kick_scores_nothing():
    """A horizontal leg whose foot meets the pelvis."""
    bout = Bout("boxing")
    bout.place(0, 0.0, pose={"L_Hip_y": -math.pi / 2})
    bout.show()
    physics = bout.env.physics
    foot = physics.body_pos[0, 0, bout.body.link_index("L_Toe")]
    depth = bout.body.links[0].shapes[0].size[0]
    bout.place(1, float(foot[0]) + depth, float(foot[1]), math.pi, z=float(foot[2]), pose={})
    bout.move(0, 2.0, 0.0, 0.0)
    bout.begin()
    kicked = 0.0
    for result in bout.play(2):
        kicked = max(kicked, float(physics.link_force[0, 1, 0].norm()))
        assert result.terms["point"][0].tolist() == [0.0, 0.0]
    assert kicked > 50.0 and float(physics.pair_force.abs().max()) == 0.0


def test_a_glove_on_the_ground_is_a_fall():
    bout = Bout("boxing")
    bout.begin()
    assert not bout.step(ground={(1, "R_Hand"): 49.0}).terminated.any()
    assert bout.step(ground={(1, "R_Hand"): 51.0}).terminated[0].tolist() == [False, True]


@pytest.mark.parametrize("degrees", [0, 45, 90, 200])
def test_the_ropes_hold_an_athlete_in(degrees: int):
    """Thrown at 3 m/s from the middle, also into a corner: never outside, whatever it then does."""
    env = make_env("boxing", num_worlds=1, training=False)
    physics = env.physics
    qpos, qvel = physics.qpos.clone(), physics.qvel.clone()
    angle = math.radians(degrees)
    heading = torch.tensor((math.cos(angle), math.sin(angle)))
    qpos[0, :2] = 0.9 * heading
    qpos[0, 3:7] = torch.tensor((math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)))
    qpos[0, 76:78] = -1.5 * heading
    qvel[0, :2] = 3.0 * heading
    physics.move(torch.tensor([True]), qpos, qvel)
    ctrl = env.targets(torch.zeros(1, 2, 69)).flatten(1)
    touched = furthest = 0.0
    for _ in range(60):
        physics.step(ctrl)
        furthest = max(furthest, float(physics.body_pos[0, 0, 0, :2].abs().max()))
        touched = max(touched, float(physics.link_force[0, 0].norm(dim=-1).max()))
    assert HALF_RING - 0.6 < furthest < HALF_RING and touched > 100.0


def test_the_weapon_is_the_middle_of_the_glove():
    bout = Bout("boxing")
    bout.begin()
    for link in ("L_Hand", "R_Hand"):
        (glove,) = bout.body.links[bout.body.link_index(link)].shapes
        assert (glove.kind, glove.center, glove.size) == ("sphere", (0, 0, 0), (0.08,))
