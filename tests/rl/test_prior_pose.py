"""The pose that a latent prior reads from observations, against hinge angles of the engine's own;
targets on each joint's turn, against a twin on the other one."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rl.prior import LatentNets, LatentPrior, PriorError, load_prior, save_prior
from rl.prior_pose import SHOWN, PosePart, joint_angles, rotations
from rl.tracker import TrackingConfig, make_tracking_env
from rl.tracking_terms import least_turn, wrapped
from sports.env import make_env
from sports.frames import proprioception_slices
from sports.humanoid.body import load_body
from sports.physics.base import PhysicsState
from tests.rl.latent_made import golf, made_prior
from tests.warmstart.clips_made import random_clip
from warmstart.library import pack


def env_of(worlds: int = 6, action: str = "absolute", clips: tuple[str, ...] = ("golf", "random")):
    made = {"golf": golf(), "random": random_clip(0, 60)}
    library = pack([(name, made[name]) for name in clips])
    config = TrackingConfig(split="all", action=action)  # type: ignore[arg-type]
    return make_tracking_env(library, num_worlds=worlds, config=config, seed=3)


def part_of(env, seed: int = 0) -> PosePart:
    g = torch.Generator().manual_seed(seed)
    mean, std = torch.randn(env.obs_size, generator=g), 0.5 + torch.rand(env.obs_size, generator=g)
    body = env.physics.scene.body
    return PosePart(body, proprioception_slices(body.num_links)["body_rot"], mean, std)


def put(env, qpos: torch.Tensor, qvel: torch.Tensor) -> torch.Tensor:
    everyone = torch.ones(env.num_worlds, dtype=torch.bool)
    env.physics.reset(everyone, PhysicsState(qpos, qvel, env.physics.mocap_pos.clone()))
    env.view.refresh()
    return env._observe()


def test_the_pose_is_that_of_the_engines_hinges():
    env = env_of()
    part = part_of(env)
    g = torch.Generator().manual_seed(1)
    qpos = env.physics.qpos.clone()
    qpos[:, 7:] = 6.0 * torch.rand(6, 69, generator=g) - 3.0
    obs = put(env, qpos, torch.zeros(6, 75))
    found = part.pose((obs[:, 0] - part.mean) / part.std) * part.scale
    least = least_turn(qpos, torch.zeros(6, 75))[0][:, 7:]
    # The same joint, and but for triples about as near to zero as each other the same angles.
    one, two = (Rotation.from_euler("XYZ", x.reshape(-1, 3).numpy()) for x in (found, least))
    assert (one.inv() * two).magnitude().max() < 2e-3
    off = (found - least).abs().reshape(-1, 3).amax(-1)
    assert float((off < 5e-3).float().mean()) > 0.95
    env.close()


def test_the_difference_is_that_of_the_clips_hinges():
    env = env_of(8)
    part = part_of(env)
    obs = env.reset()
    x = (obs[:, 0] - part.mean) / part.std
    frame = env.memory["frame"]
    body = env.physics.qpos.clone()
    wanted = torch.cat((body[:, :7], env.tracking.tables.joints(frame + 1)), 1)
    own, goal = (least_turn(q, torch.zeros(8, 75))[0][:, 7:] for q in (body, wanted))
    expected = SHOWN * (goal - own) / part.scale
    close = (goal - own).abs().reshape(8, -1, 3).amax(-1) < 1.0
    assert float(close.float().mean()) > 0.8
    rows = close.repeat_interleave(3, -1)
    torch.testing.assert_close(part.difference(x)[rows], expected[rows], atol=3e-2, rtol=0)
    # None where the reference is the athlete's own pose.
    x[:, -144:] = ((obs[:, 0, 70:214]) - part.mean[-144:]) / part.std[-144:]
    assert float(part.difference(x).abs().max()) < 1e-2
    env.close()


def test_columns_that_are_no_rotation_become_one():
    g = torch.Generator().manual_seed(2)
    rot = torch.tensor(Rotation.random(50, rng=1).as_matrix()).float()
    columns = rot[..., :2].transpose(-1, -2).flatten(-2)
    torch.testing.assert_close(rotations(columns), rot, atol=1e-5, rtol=0)
    found = rotations(columns + 0.05 * torch.randn(50, 6, generator=g))
    torch.testing.assert_close(found @ found.mT, torch.eye(3).expand(50, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(50))
    assert torch.isfinite(rotations(torch.zeros(3, 6))).all()
    # A whole body turned is in the same pose.
    parents = torch.tensor([-1, 0, 1, 1])
    links = rot[:40].reshape(10, 4, 3, 3)
    angles = joint_angles(links, parents)
    torch.testing.assert_close(joint_angles(rot[40] @ links, parents), angles, atol=1e-4, rtol=0)
    local = links[:, [0, 1, 1]].mT @ links[:, 1:]
    back = Rotation.from_euler("XYZ", angles.reshape(-1, 3).numpy()).as_matrix()
    np.testing.assert_allclose(back, local.reshape(-1, 3, 3).numpy(), atol=1e-4)


def test_a_label_is_taken_on_the_turn_that_shows():
    env = env_of(4)
    part = part_of(env)
    obs = env.reset()
    x = (obs[:, 0] - part.mean) / part.std
    pose = part.pose(x)
    turned = (pose * part.scale).reshape(4, -1, 3) * torch.tensor([1, -1, 1]) + math.pi
    label = turned.flatten(1) / part.scale + 0.01
    expected = pose.reshape(4, -1, 3) + torch.tensor([0.01, -0.01, 0.01])
    expected = expected.flatten(1)
    knees = part.scale != part.scale[0]  # of another scale: 0.01 is the same in units of it
    found = part.as_seen(x, label)
    assert knees.any()
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=0)
    env.close()


# Targets on each joint's own turn.


def test_athletes_on_either_turn_do_the_same_under_the_same_actions():
    # In the air: contacts make much of the last bits of a float32.
    envs = [env_of(6, clips=("random",)) for _ in range(2)]
    g = torch.Generator().manual_seed(4)
    qpos, qvel = envs[0].physics.qpos.clone(), 0.1 * torch.randn(6, 75, generator=g)
    other, rates = qpos.clone(), qvel.clone()
    hinges = other[:, 7:].reshape(6, -1, 3)
    # Within the hinges' range, which ends at half a turn.
    other[:, 7:] = wrapped(hinges * torch.tensor([1.0, -1.0, 1.0]) + math.pi).flatten(1)
    rates[:, 7::3] *= -1.0
    action = 0.05 * torch.randn(6, 1, 69, generator=g) + (qpos[:, None, 7:] / envs[0].action_scale)
    for own in (True, False):
        seen = []
        for env, q, v in zip(envs, (qpos, other), (qvel, rates)):
            env.own_turns = own
            put(env, q, v)
            env.physics.step(env.targets(action).flatten(1))
            env.view.refresh()
            seen.append(env.physics.body_pos.clone())
        apart = float((seen[0] - seen[1]).abs().max())
        assert (apart < 1e-3) if own else (apart > 0.1), apart
    for env in envs:
        env.close()


def test_who_acts_by_rotations_has_targets_on_its_own_turns():
    assert env_of(1, "absolute").own_turns
    assert not env_of(1, "residual").own_turns


def test_each_of_two_athletes_has_its_own_turns():
    env = make_env("boxing", num_worlds=2)
    env.reset()
    zero = torch.zeros(2, 2, 69)
    plain = env.targets(zero)
    env.own_turns = True
    torch.testing.assert_close(env.targets(zero), plain, atol=1e-6, rtol=0)
    state = env.physics.qpos.clone()
    joint = env.physics.scene.agent_qpos(1).start + 7 + 3 * 4
    state[1, joint : joint + 3] += 2.0 * math.pi
    everyone, qvel = torch.ones(2, dtype=torch.bool), env.physics.qvel.clone()
    env.physics.reset(everyone, PhysicsState(state, qvel, env.physics.mocap_pos.clone()))
    moved = (env.targets(zero) - plain) / (2.0 * math.pi)
    expected = torch.zeros_like(plain)
    expected[1, 1, 12:15] = 1.0
    torch.testing.assert_close(moved, expected, atol=1e-6, rtol=0)
    # Of each athlete by itself: who plays by rotations may meet who does not.
    for second in (True, False):
        env.own_turns = torch.tensor([not second, second])
        moved = (env.targets(zero) - plain) / (2.0 * math.pi)
        torch.testing.assert_close(moved, second * expected, atol=1e-6, rtol=0)
    env.close()


def test_the_athlete_with_fingers_has_a_pose_too():
    body = load_body("smplx")
    size = 15 * body.num_links - 2
    own = proprioception_slices(body.num_links)["body_rot"]
    part = PosePart(body, own, torch.zeros(size), torch.ones(size))
    rng = np.random.default_rng(0)
    angle = rng.uniform(-1.0, 1.0, (body.num_links - 1, 3))
    rot = [Rotation.identity()]
    for parent, row in zip(body.parents()[1:], angle):
        rot.append(rot[parent] * Rotation.from_euler("XYZ", row))
    obs = torch.zeros(size)
    columns = np.stack([r.as_matrix()[:, :2].T.ravel() for r in rot])
    obs[own] = torch.tensor(columns.ravel()).float()
    found = (part.pose(obs) * part.scale).reshape(-1, 3)
    torch.testing.assert_close(found, torch.tensor(angle).float(), atol=1e-4, rtol=0)


# Priors of both kinds.


def with_pose(seed: int = 0) -> LatentPrior:
    plain = made_prior(seed=seed)
    shape = replace(plain.nets.shape, pose=True)
    nets = LatentNets(shape, torch.Generator().manual_seed(seed))
    mean, std = plain.mean, plain.std
    nets.see_pose(load_body("smpl"), mean, std)
    return LatentPrior(nets, mean, std, {**plain.card, **shape.card()}, encoder=True)


def test_a_prior_around_the_pose_comes_back_and_says_so(tmp_path):
    prior = with_pose()
    g = torch.Generator().manual_seed(2)
    obs, z = 2.0 * torch.randn(40, 1, 934, generator=g), torch.randn(40, 1, 6, generator=g)
    path = save_prior(prior, tmp_path / "p", half=False)
    back = load_prior(path)
    assert back.nets.shape.pose and back.digest == prior.digest
    assert torch.equal(back.decode(obs, z), prior.decode(obs, z))
    assert torch.equal(back.posterior(obs)[0], prior.posterior(obs)[0])
    part = load_prior(save_prior(prior, tmp_path / "part", half=False, encoder=False))
    assert torch.equal(part.decode(obs, z), prior.decode(obs, z))
    # What the decoder says is an offset.
    x = ((obs - prior.mean) / prior.std).clamp(-5, 5)
    assert prior.nets.part is not None
    offset = prior.nets.decoder(torch.cat((x[..., :358], z), -1))
    torch.testing.assert_close(prior.decode(obs, z), prior.nets.part.pose(x) + offset)


def test_a_card_cannot_change_what_the_decoder_says(tmp_path):
    path = save_prior(with_pose(), tmp_path / "p", half=False, encoder=False)
    place = path.with_suffix(".json")
    card = json.loads(place.read_text())
    place.write_text(json.dumps(card | {"pose": False}))
    with pytest.raises(PriorError, match="has been altered"):
        load_prior(path)
    place.write_text(json.dumps(card | {"pose": 3}))
    with pytest.raises(PriorError, match="neither true nor false"):
        load_prior(path)


def test_priors_of_before_still_load(tmp_path):
    prior = made_prior()
    path = save_prior(prior, tmp_path / "p", half=False)
    place = path.with_suffix(".json")
    card = json.loads(place.read_text())
    del card["pose"]
    place.write_text(json.dumps(card))
    back = load_prior(path)
    assert back.digest == prior.digest and not back.nets.shape.pose
