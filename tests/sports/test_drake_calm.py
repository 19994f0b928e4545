"""Where nobody is near the ball Drake steps coarsely: what comes of it is what fine steps bring."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sports.env import make_scene
from sports.physics import default_state, make_physics

pytest.importorskip("pydrake")

FINE = 1.0 / 3840.0
SCENE = make_scene("soccer_1v1")
CTRL = torch.tensor(np.tile(SCENE.action_offset(), SCENE.num_agents), dtype=torch.float32)[None]


def engines():
    """Both plants as it chooses, and every step at 1/3840 s."""
    return [make_physics("drake", SCENE, 1, **o) for o in ({}, {"timestep": FINE})]


def throw(physics, pos, vel, spin=(0.0, 0.0, 0.0)):
    state = default_state(SCENE, 1, "cpu")
    q, v = SCENE.object_qpos("ball").start, SCENE.object_qvel("ball").start
    state.qpos[:, q : q + 3] = torch.tensor(pos)
    state.qvel[:, v : v + 6] = torch.tensor((*vel, *spin))
    physics.reset(torch.ones(1, dtype=torch.bool), state)


def watch(monkeypatch, physics):
    """Of every control step to come, what was tried: "fine", "coarse", "coarse fine"."""
    tried, advance, step = [], physics._advance, physics.step

    def told(plant, world, targets):
        tried[-1] += " fine" if plant is physics._plant else " coarse"
        return advance(plant, world, targets)

    def counted(ctrl):
        tried.append("")
        step(ctrl)

    monkeypatch.setattr(physics, "_advance", told)
    monkeypatch.setattr(physics, "step", counted)
    return tried


def test_a_ball_rolls_as_in_fine_steps_and_as_exp(monkeypatch):
    mixed, fine = engines()
    tried = watch(monkeypatch, mixed)
    for physics in (mixed, fine):
        throw(physics, (0.0, 2.0, 0.11), (3.0, 2.0, 0.0), (-2.0 / 0.11, 3.0 / 0.11, 0.0))
    for _ in range(30):
        mixed.step(CTRL)
        fine.step(CTRL)
        assert (mixed.object_pos - fine.object_pos).abs().max() < 2e-3
        assert (mixed.object_linvel - fine.object_linvel).abs().max() < 2e-3
    assert set(tried) == {" coarse"}
    assert (mixed.body_pos - fine.body_pos).abs().max() < 5e-3
    way = 3.0 / 0.5 * (1.0 - np.exp(-0.5))  # rolling costs half of its speed a second
    assert float(mixed.object_pos[0, 0, 0]) == pytest.approx(way, abs=5e-3)
    assert float(mixed.object_pos[0, 0, 2]) == pytest.approx(0.11, abs=1e-5)


def test_a_kick_is_made_in_fine_steps_alone(monkeypatch):
    """At 10 m/s at an athlete from 0.7 m away: bit by bit the same until it flies off."""
    mixed, fine = engines()
    tried = watch(monkeypatch, mixed)
    at = float(SCENE.default_qpos()[SCENE.agent_qpos(1).start]) - 0.7
    for physics in (mixed, fine):
        throw(physics, (at, 0.1, 0.4), (10.0, 0.0, 1.0))
    speeds = []
    while len(tried) < 6 and all(x == " fine" for x in tried):
        mixed.step(CTRL)
        fine.step(CTRL)
        if tried[-1] == " fine":
            assert torch.equal(mixed.qpos, fine.qpos) and torch.equal(mixed.qvel, fine.qvel)
            speeds.append(float(mixed.object_linvel[0, 0, 0]))
    assert min(speeds) < 0.0  # it came back
    assert len(speeds) >= 3


@pytest.mark.parametrize("what", ["wall", "bounce", "athlete"])
def test_a_coarse_step_in_which_the_ball_met_something_is_made_again(what, monkeypatch):
    """A rebound from the wall, a bounce, and an athlete whom the forecast is told to overlook."""
    mixed, fine = engines()
    tried = watch(monkeypatch, mixed)
    pos, vel = {
        "wall": ((0.0, 9.6, 0.5), (0.0, 15.0, 0.0)),
        "bounce": ((0.0, 3.0, 0.2), (4.0, 0.0, -5.0)),
        "athlete": ((-2.5, 0.1, 0.4), (-12.0, 0.0, 0.0)),
    }[what]
    monkeypatch.setattr(mixed._calm, "soon", lambda *_: False)
    for physics in (mixed, fine):
        throw(physics, pos, vel)
        physics.step(CTRL)
    assert tried == [" coarse fine"]
    assert torch.equal(mixed.qpos, fine.qpos) and torch.equal(mixed.qvel, fine.qvel)
    assert torch.equal(mixed.ground_force, fine.ground_force)
    assert torch.equal(mixed.pair_force, fine.pair_force)
    turned = mixed.object_linvel[0, 0] * torch.tensor(vel)
    assert float(turned.min()) < 0.0


def test_carried_over_and_back_is_the_same():
    """On the ground, in it, and in the air; where it is pressed the force is the same in both."""
    calm = engines()[0]._calm
    obj, soft = calm._fine.free[0], calm.coarse.free[0]
    q, v = calm._fine.state(0)
    for sunk in (0.0, 5e-5, -1e-3, -1.0):
        there = q.copy()
        there[obj.joint.position_start() + 6] = obj.reach - sunk
        over, _ = calm.to_coarse(there, v)
        back, _ = calm.to_fine(over, v)
        assert np.allclose(back, there, rtol=0.0, atol=1e-12)
        if sunk > 0.0:
            pressed = (soft.reach - over[obj.joint.position_start() + 6]) * soft.stiffness
            assert pressed == pytest.approx(sunk * obj.stiffness)
    assert calm.coarse.timestep == pytest.approx(1.0 / 480.0)
    assert calm._fine.timestep == pytest.approx(FINE)
