"""One control step in two engines: an engine against itself, weights, and a known cause."""

from __future__ import annotations

import numpy as np
import pytest

from rl.parting import _Steps, _summary, find_parting
from rl.policy import load_policy
from sports.env import make_scene
from sports.physics.base import GRAVITY


def test_an_engine_does_not_part_from_itself():
    policy = load_policy("pretrained:ppo", "golf")
    found = find_parting(policy, "golf", engine="mujoco", worlds=3, steps=6, divisor=1)
    assert found.steps == 18 and found.timestep == pytest.approx(1 / 120)
    # Its states pass through single precision on the way, no more.
    assert found.velocity < 1e-3 and max(w.velocity for w in found.worst) < 0.1
    assert {f.link for f in found.forces} >= {"L_Toe", "R_Hand"}
    for force in found.forces:
        assert force.other == pytest.approx(force.mujoco, rel=1e-3, abs=1.0)


def test_a_coarser_step_parts_from_a_finer_one():
    policy = load_policy("pretrained:ppo", "golf")
    own, finer = (
        find_parting(policy, "golf", engine="mujoco", worlds=3, steps=6, divisor=d) for d in (1, 4)
    )
    assert finer.velocity > 20 * own.velocity
    assert finer.velocity_p95 >= finer.velocity > 0


def test_the_ground_carries_who_stands_in_both_engines():
    found = find_parting(load_policy("zero", "high_jump"), "high_jump", worlds=2, steps=12)
    weight = GRAVITY * make_scene("high_jump").body.mass
    assert {f.link[2:] for f in found.forces} == {"Ankle", "Toe"}
    # The largest forces of the substeps, not all at once: never less than the weight in the mean.
    for engine in ("other", "mujoco"):
        total = sum(f.touching * getattr(f, engine) for f in found.forces)
        assert 0.95 * weight < total < 2.5 * weight


def test_the_club_on_the_turf_is_found():
    """What docs/physics.md tells of golf: from the first step in which the club meets the turf, it
    is there that the engines part, by two body weights and more."""
    found = find_parting(load_policy("pretrained:ppo", "golf"), "golf", worlds=4, steps=6)
    club = next(f for f in found.forces if f.link == "R_Hand")
    assert club.other_peak > 2 * club.mujoco_peak
    hardest = max(found.worst, key=lambda w: abs(w.other - w.mujoco))
    assert hardest.link == "R_Hand" and hardest.other > hardest.mujoco


def test_steps_and_links_are_told_in_order():
    """Made-up steps: link 1 of athlete 1 differs by 100 N in the steps that part, link 0 of
    athlete 0 always by 10 N, link 2 touches nothing."""
    velocity = np.array([0.1, 2.0, 0.2, 1.0])
    other, mujoco = np.zeros((4, 2, 3)), np.zeros((4, 2, 3))
    other[:, 0, 0], mujoco[:, 0, 0] = 50.0, 40.0
    other[[1, 3], 1, 1], mujoco[[1, 3], 1, 1] = 300.0, 200.0
    steps = _Steps(np.arange(4), np.array([0.1, 0.2, 0.3, 0.4]), velocity, other, mujoco)
    found = _summary(steps, "drake", 1 / 480, ("Pelvis", "R_Toe", "Head"))
    assert [(f.athlete, f.link) for f in found.forces] == [(1, "R_Toe"), (0, "Pelvis")]
    toe, pelvis = found.forces
    assert (toe.touching, toe.other, toe.mujoco) == (0.5, 300.0, 200.0)
    assert pelvis.touching == 1.0 and pelvis.blame == 0.0
    assert toe.blame == pytest.approx(np.corrcoef([0, 1, 0, 1], velocity)[0, 1])
    assert [w.world for w in found.worst] == [1, 3, 2, 0]
    assert [w.link for w in found.worst] == ["R_Toe", "R_Toe", "Pelvis", "Pelvis"]
    assert found.velocity == pytest.approx(0.6)


def test_a_referee_who_moves_athletes_is_no_parting(monkeypatch):
    """An engine against itself, with somebody who carries every world's root off in one step."""
    from sports.env import Env

    own = Env.step

    def carried(env, action):
        result = own(env, action)
        if float(env.view.clock[0]) == 3:
            env.final_snapshot["qpos"][:, 0] += 1.0
            env.final_snapshot["qvel"] += 5.0
        return result

    monkeypatch.setattr(Env, "step", carried)
    policy = load_policy("zero", "high_jump")
    found = find_parting(policy, "high_jump", engine="mujoco", worlds=2, steps=5, divisor=1)
    assert found.steps == 2 * 4 and found.worst[0].velocity < 0.1


def test_nothing_to_compare_is_said():
    none = np.zeros(0)
    with pytest.raises(ValueError, match="no control step could be compared"):
        _summary(_Steps(none, none, none, np.zeros((0, 1, 1)), np.zeros((0, 1, 1))), "drake", 1, ())
    with pytest.raises(ValueError, match="must be positive, not 0"):
        find_parting(load_policy("zero", "high_jump"), "high_jump", worlds=0)
