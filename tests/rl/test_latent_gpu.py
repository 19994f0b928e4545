"""On a GPU only: the captured update of the student is the plain one, acting and decoding wait for
nothing."""

from __future__ import annotations

import pytest
import torch

from rl.latent import Distiller
from rl.latent_action import LatentActions, LatentConfig
from rl.latent_config import PriorConfig
from rl.networks import MLP
from rl.policy import Policy
from rl.tracker import TrackingConfig, TrackingEnv, make_tracking_env
from sports.env import make_env
from tests.rl.latent_made import golf, made_prior
from warmstart.library import pack

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
SMALL = PriorConfig(split="all", encoder=(64,), prior=(64,), decoder=(64,), steps=4, minibatches=2)


def worlds() -> TrackingEnv:
    config = TrackingConfig(split="all", action="absolute")
    library = pack([("golf", golf())])
    return make_tracking_env(library, engine="warp", num_worlds=64, config=config)


def learner(env: TrackingEnv, graph: bool) -> Distiller:
    card = {"obs_size": 934, "action_size": 69, "observation_clip": 5.0, "obs_count": 1.0}
    card |= {"sha256": "made up", "algo": "ppo"}
    actor = MLP(934, (32,), 69, generator=torch.Generator().manual_seed(0)).requires_grad_(False)
    teacher = Policy(actor, torch.zeros(934), torch.ones(934), card)
    return Distiller(env, teacher, SMALL, "cuda", cuda_graph=graph, bf16=False)


def test_the_captured_update_is_the_plain_one():
    env = worlds()
    one, two = learner(env, True), learner(env, False)
    g = torch.Generator("cuda").manual_seed(0)
    obs = torch.randn(4, 64, 934, device="cuda", generator=g)
    label = 0.3 * torch.randn(4, 64, 69, device="cuda", generator=g)
    rollouts = [x.new_rollout(64) for x in (one, two)]
    for share in (0.0, 0.2, 0.4, 0.6):
        told = []
        for student, rollout in zip((one, two), rollouts):
            rollout.obs.copy_(obs)
            rollout.mean.copy_(label)
            rollout.valid.fill_(True)
            student.schedule(share)
            told.append(student.update(rollout))
        for name, value in told[0].items():
            torch.testing.assert_close(value, told[1][name], rtol=1e-3, atol=1e-4)
    assert one._step.graph is not None and two._step.graph is None
    env.close()


def test_acting_and_stepping_wait_for_nothing():
    env = worlds()
    student = learner(env, False)
    sport = make_env("hurdling", engine="warp", num_worlds=64)
    scene = sport.physics.scene
    sport.act_through(LatentActions(made_prior(), LatentConfig(), scene, (), sport.device))
    latent = torch.zeros(64, 1, 6, device="cuda")
    obs = env.reset()
    sport.reset()
    for _ in range(3):  # captures, allocations, first calls
        obs = env.step(student.act(obs[:, 0])[1][:, None]).obs
        sport.step(latent)
    torch.cuda.set_sync_debug_mode("error")
    try:
        _, action, label, _ = student.act(obs[:, 0])
        env.step(action[:, None])
        result = sport.step(latent)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert bool(label.isfinite().all()) and bool(result.reward.isfinite().all())
    env.close()
    sport.close()
