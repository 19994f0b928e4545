"""The trouble of the student's worlds: pushes and falls of the size and rate that they say."""

from __future__ import annotations

import math

import pytest
import torch

from rl.distillation import DROP, GRACE, TILT, trouble
from rl.latent_config import PriorConfig
from rl.tracker import TrackingConfig, TrackingEnv, make_tracking_env
from sports import quaternion
from tests.rl.latent_made import golf
from tests.warmstart.clips_made import random_clip
from warmstart.clip import Clip
from warmstart.library import pack


def env_of(worlds: int, seed: int = 0, clip: Clip | None = None, **options) -> TrackingEnv:
    library = pack([("clip", clip or golf())])
    config = TrackingConfig(split="all", action="absolute", tolerance=(0.5, 0.5))
    env = make_tracking_env(library, num_worlds=worlds, config=config, seed=seed)
    plain = {"fallen": 0.0, "push_seconds": 0.0}
    return trouble(env, PriorConfig(**{**plain, **options}))


def still(env: TrackingEnv) -> torch.Tensor:
    """Actions that hold every joint where it is."""
    return (env.physics.qpos[:, None, 7:] - env.action_offset) / env.action_scale


def test_without_trouble_the_worlds_are_the_trackers():
    env = env_of(4)
    plain = make_tracking_env(
        pack([("golf", golf())]),
        num_worlds=4,
        config=TrackingConfig(split="all", action="absolute", tolerance=(0.5, 0.5)),
        assigned=[0] * 4,
    )
    env.assign([0] * 4)
    assert torch.equal(env.reset(), plain.reset())
    for _ in range(10):
        one, two = env.step(still(env)), plain.step(still(plain))
        assert torch.equal(one.final_obs, two.final_obs)
        assert torch.equal(one.reward, two.reward)
    env.close()
    plain.close()


def test_some_athletes_begin_with_a_fall():
    env = env_of(400, fallen=0.3, seed=1)
    falls = env.memory["grace"] > 0
    assert 0.2 < float(falls.float().mean()) < 0.4
    qpos, qvel = env.physics.qpos, env.physics.qvel
    torch.testing.assert_close(qpos[falls, 2], torch.full((int(falls.sum()),), DROP))
    assert float(qvel[falls].abs().max()) == 0.0 and float(qvel[~falls].abs().max()) > 0.1
    # Tilted off the pose of the clip by 60 to 120 degrees, about an axis in the ground's plane.
    frame = env.memory["frame"]
    wanted = env.tracking.tables.at(frame).rot[:, 0]
    turn = quaternion.matrix(qpos[:, 3:7]) @ wanted.transpose(1, 2)
    angle = torch.acos(((turn.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1))
    assert float(angle[~falls].max()) < 1e-2
    assert float(angle[falls].min()) > TILT[0] - 1e-2 and float(angle[falls].max()) < TILT[1] + 1e-2
    upright = turn[falls][:, 2, 2]  # where the vertical goes: cos of the tilt
    torch.testing.assert_close(upright, angle[falls].cos(), atol=1e-3, rtol=0)
    # Nobody begins inside the ground: the lowest point of every link is above it.
    reach = env.physics.extent(torch.tensor([0.0, 0.0, -1.0]))[:, 0]
    assert float((-reach[falls]).min()) > -0.3
    env.close()


def test_who_falls_is_spared_for_a_while():
    env = env_of(16, fallen=1.0, seed=2, clip=random_clip(0, 400))
    env.age.zero_()
    begun = env.memory["frame"].clone()
    last = env.tracking.tables.last[begun]
    for step in range(1, GRACE + 2):
        result = env.step(torch.zeros(16, 1, 69))
        # Far from a reference in the air they go on, until the clip ends.
        whole = begun + step < last
        if step <= GRACE:
            assert not result.ended[whole].any()
            assert bool(result.truncated[begun + step == last].all())
    assert int(whole.sum()) > 5
    assert bool(result.terminated[whole].all())  # lost, now that it counts
    env.close()


def test_pushes_are_as_strong_and_as_many_as_they_say():
    env = env_of(256, push_seconds=0.5, push=0.7, seed=3)
    twin = env_of(256, seed=3)
    kicks = []
    for _ in range(30):
        # The same state in both, stepped alike; what differs then is the push.
        state = env.state_dict()
        twin.load_state_dict({k: v.clone() for k, v in state.items()})
        action = still(env)
        env.keep_snapshot = twin.keep_snapshot = True
        result = env.step(action)
        twin.step(action)
        kick = env.final_snapshot["qvel"][:, :6] - twin.final_snapshot["qvel"][:, :6]
        running = ~result.ended & result.valid
        kicks.append(kick[running])
    kick = torch.cat(kicks)
    pushed = kick.abs().amax(-1) > 1e-6
    # One in 0.5 s, 15 control steps.
    assert float(pushed.float().mean()) == pytest.approx(1 / 15, rel=0.15)
    assert float(kick[pushed][:, 2:].abs().max()) < 1e-5
    size = kick[pushed][:, :2]
    assert float(size.abs().max()) <= 0.7 + 1e-5
    assert float(size.std()) == pytest.approx(0.7 / math.sqrt(3.0), rel=0.1)
    env.close()
    twin.close()
