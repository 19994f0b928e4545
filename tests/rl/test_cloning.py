"""Cloning of a demonstration: what it plays, labels and learns, and that it resumes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rl.checkpoint import checkpoints, load_checkpoint
from rl.cloning import LATER, Cloning, label_weights, reference
from rl.ppo import PPO, PPOConfig
from rl.rollout import collect
from rl.train import TrainConfig, train
from sports.env import make_env
from sports.humanoid.body import FINGERS
from warmstart.bank import thrown_files
from warmstart.clip import Clip

THROW = next(p for p in thrown_files("javelin") if "paper" in p.name)
SMALL = PPOConfig(hidden=(32,), steps=6, minibatches=2, epochs=2, sigma=0.03)


@pytest.fixture(scope="module")
def clip() -> Clip:
    return Clip.load(THROW)


@pytest.fixture
def env():
    made = make_env("javelin", num_worlds=4, training=False, physics_options={"threads": 1})
    yield made
    made.close()


def test_the_reference_played_in_the_task_is_the_throw(env, clip):
    actions = reference(clip, env)
    for step in range(env.max_steps):
        result = env.step(actions[min(step, len(actions) - 1)].expand(4, 1, -1))
        if result.ended.any():
            break
    distance = clip.meta["achieved"]["distance"]
    assert result.metrics["distance"].numpy() == pytest.approx(np.full(4, distance), abs=1e-3)


def test_a_reference_that_begins_late_is_cut_at_the_start_of_the_episode(env, clip):
    """Two frames more in front of the event ``start``: the same actions."""

    def longer(x: np.ndarray | None) -> np.ndarray | None:
        return None if x is None else np.concatenate([x[:1], x[:1], x])

    parts = {n: longer(getattr(clip, n)) for n in ("qpos", "qvel", "ctrl")}
    parts |= {n: longer(getattr(clip, n)) for n in ("object_qpos", "object_qvel")}
    late = replace(clip, **parts, meta=clip.meta | {"events": {"start": 2 / clip.fps}})
    assert torch.equal(reference(late, env), reference(clip, env))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ctrl": None}, "must have targets"),
        ({"meta": {}}, "the event 'start'"),
        ({"fps": 60.0}, "60 frames a second"),
        ({"meta": {"events": {"start": 100.0}}}, "outside of the clip"),
    ],
)
def test_clips_that_are_no_whole_episode_are_refused(env, clip, change, words):
    with pytest.raises(ValueError, match=words):
        reference(replace(clip, **change), env)


def test_a_clip_of_another_body_is_refused(clip):
    other = make_env("long_jump", num_worlds=2, physics_options={"threads": 1})
    with pytest.raises(ValueError, match="body 'smplx'"):
        reference(clip, other)
    other.close()


def test_two_clips_and_none_are_refused():
    for clips in ((), (THROW, THROW)):
        with pytest.raises(ValueError, match="one clip"):
            TrainConfig(task="javelin", clone=3, clips=clips)
    with pytest.raises(ValueError, match="negative"):
        TrainConfig(task="javelin", clone=-1, clips=(THROW,))


def cloning(env, clip: Clip, sigma: float = 0.03) -> Cloning:
    agent = PPO(env.obs_size, env.action_size, replace(SMALL, sigma=sigma), "cpu", 0)
    return Cloning(env, agent, clip, 10)


def test_half_of_the_worlds_are_led_and_all_are_labelled_by_their_clock(env, clip):
    """With noise of next to nothing: the label itself there, the actor's mean here."""
    learner = cloning(env, clip, sigma=1e-6)
    env.view.clock = torch.tensor([0, 7, 20, 10_000])
    obs = env._observe().flatten(0, 1)
    _, action, label, _ = learner.act(obs)
    played = reference(clip, env)
    assert torch.equal(label, played[[0, 7, 20, len(played) - 1]])
    mean = learner.agent.actor(learner.prepare(obs))
    torch.testing.assert_close(action[:2], label[:2], atol=1e-4, rtol=0)
    torch.testing.assert_close(action[2:], mean[2:], atol=1e-4, rtol=0)
    assert (label - mean).abs().max() > 0.1


def test_labels_after_the_last_event_weigh_less(env, clip):
    """Release 0.7 s after the start: the steps until 0.8 s count in full, by hand and in a loss."""
    thrown = replace(clip, meta=clip.meta | {"events": {"start": 0.1, "release": 0.8}})
    wanted = [1.0] * 25 + [LATER] * 15
    torch.testing.assert_close(label_weights(thrown, 40), torch.tensor(wanted))
    started = replace(clip, meta=clip.meta | {"events": {"start": 0.0}})
    assert (label_weights(started, 40) == 1.0).all()
    learner = cloning(env, thrown)
    rollout = learner.agent.new_rollout(env.num_worlds)
    collect(env, learner, rollout, env.reset(), 0.99)
    clock = torch.arange(SMALL.steps)[:, None].expand(-1, env.num_worlds)
    learner._counts[:] = 0.0
    learner._counts[3] = 1.0  # only these labels are there: the others change nothing
    again = learner.agent.actor.head.weight.detach().clone()
    rollout.mean[clock != 3] = 5.0
    told = float(learner.update(rollout, 0)["clone_error"])
    assert 0.0 < told < 1.0 and (learner.agent.actor.head.weight != again).any()


def test_the_critic_learns_and_the_actor_learns_the_labels_alone(env, clip):
    """The update by rewards leaves the actor's bytes as they are; that by labels brings it nearer
    to them, and not the critic."""
    learner = cloning(env, clip)
    agent = learner.agent
    rollout = agent.new_rollout(env.num_worlds)
    obs = collect(env, learner, rollout, env.reset(), 0.99)
    agent.obs_norm.commit()
    collect(env, learner, rollout, obs, 0.99)
    agent.actor_weight.fill_(0.0)

    def copy(net):
        return [p.detach().clone() for p in net.parameters()]

    actor, critic = copy(agent.actor), copy(agent.critic)
    losses = agent.update(rollout)
    assert all(torch.isfinite(x) for x in losses.values())
    assert all(torch.equal(a, b) for a, b in zip(actor, agent.actor.parameters()))
    assert any(not torch.equal(a, b) for a, b in zip(critic, agent.critic.parameters()))
    critic = copy(agent.critic)
    errors = [float(learner.update(rollout, 0)["clone_error"]) for _ in range(12)]
    assert errors[-1] < 0.6 * errors[0]
    assert all(torch.equal(a, b) for a, b in zip(critic, agent.critic.parameters()))
    # The first error by hand: root mean square over all numbers of a rollout and its labels.
    with torch.no_grad():
        off = rollout.mean - agent.actor(rollout.obs)
    assert float(learner.update(rollout, 0)["clone_error"]) == pytest.approx(
        float(off.square().mean().sqrt()), rel=0.3
    )


def test_a_run_stopped_while_it_clones_goes_on_bit_for_bit(tmp_path: Path):
    def run(name: str, part: float = 1.0, resume: bool = False) -> dict[str, torch.Tensor]:
        config = TrainConfig(
            task="javelin",
            out=tmp_path / name,
            worlds=4,
            samples=6 * SMALL.steps * 4,
            clips=(THROW,),
            clone=4,
            ppo=SMALL,
            quiet=True,
            resume=resume,
            device="cpu",
            physics_options={"threads": 1},
        )
        train(config, part=part)
        return load_checkpoint(checkpoints(config.out)[-1])[1]

    whole = run("whole")
    run("parts", part=0.5)
    parts = run("parts", resume=True)
    assert whole.keys() == parts.keys()
    assert any(k.startswith("cloning/") for k in whole)
    for name, x in whole.items():
        torch.testing.assert_close(parts[name], x, rtol=0, atol=0, equal_nan=True, msg=name)


def test_observations_are_read_alike_from_the_half_of_the_cloning_on(tmp_path: Path):
    """What a cloned actor does hangs on how it sees: PPO's new samples must not move that."""

    def statistics(iterations: int, moving: bool = False) -> torch.Tensor:
        config = TrainConfig(
            task="javelin",
            out=tmp_path / f"{iterations}{moving}",
            worlds=4,
            samples=iterations * SMALL.steps * 4,
            clips=(THROW,),
            clone=4,
            ppo=replace(SMALL, moving_statistics=moving),
            quiet=True,
            device="cpu",
            physics_options={"threads": 1},
        )
        train(config)
        total = load_checkpoint(checkpoints(config.out)[-1])[1]["agent/obs_norm.total"]
        size = (len(total) - 1) // 2
        return torch.cat((total[1 : 1 + size], total[1 + size :] / total[0]))

    half, end, later = (statistics(n) for n in (2, 4, 6))
    torch.testing.assert_close(end, half, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(later, half, rtol=1e-9, atol=1e-12)
    assert not torch.allclose(statistics(1), half) and not torch.allclose(statistics(6, True), half)


def test_fingers_go_on_learning_their_labels_while_other_joints_stay(env, clip):
    """After the cloning, without rewards: fingers come nearer to the clip, no other output is
    pulled to it, and nobody plays the clip."""
    agent = PPO(env.obs_size, env.action_size, SMALL, "cpu", 0)
    learner = Cloning(env, agent, clip, 0, fingers=True)
    learner.leading = False
    rollout = agent.new_rollout(env.num_worlds)
    obs, names = env.reset(), env.physics.scene.body.dofs
    for _ in range(2):
        obs = collect(env, learner, rollout, obs, 0.99)
        agent.obs_norm.commit()
    labels, played = agent.labels.clone(), reference(clip, env)
    # The first step of the second rollout is number 6 of the episode (nobody has lost it yet).
    assert torch.equal(labels[0], played[6].expand(4, -1))
    fingers = [i for i, dof in enumerate(names) if dof.link[2:].startswith(FINGERS)]
    others = [i for i in range(len(names)) if i not in fingers]
    assert len(fingers) == 90 and learner.fingers.tolist() == fingers
    noise = rollout.action - rollout.mean
    assert noise[..., fingers].abs().max() == 0.0
    assert noise[..., others].std() == pytest.approx(SMALL.sigma, rel=0.1)
    z = (noise[..., others] / SMALL.sigma).square().sum(-1)
    wanted = -0.5 * z - len(names) * (math.log(SMALL.sigma) + 0.5 * math.log(2.0 * math.pi))
    torch.testing.assert_close(rollout.log_prob, wanted)

    def error(joints: list[int], target: torch.Tensor) -> float:
        with torch.no_grad():
            return float((agent.actor(rollout.obs) - target)[..., joints].square().mean().sqrt())

    before, head = rollout.mean.clone(), agent.actor.head.weight.detach().clone()
    first, apart = error(fingers, labels), error(others, labels)
    told = float(learner.update(rollout, 0)["clone_error"])
    assert told == pytest.approx(float((before - labels)[..., fingers].square().mean().sqrt()))
    assert torch.equal(head, agent.actor.head.weight)  # it is PPO that learns them
    rollout.reward.zero_()
    agent.learning_rate.fill_(1e-3)
    for _ in range(20):
        # Nothing to gain: what is left of the policy's loss is the lesson.
        agent._compute_advantages = lambda r: (r.advantages.zero_(), r.returns.zero_())[0]
        agent.update(rollout)
        agent.learning_rate.fill_(1e-3)
    assert error(fingers, labels) < 0.7 * first
    assert (agent.actor.head.weight - head)[others].abs().max() == 0.0
    assert error(others, before) < 0.2 * apart
    assert (rollout.mean - labels).abs().max() > 0.1  # the mean, not the label, is what PPO sees


def test_a_body_without_fingers_has_none_to_keep(clip):
    other = make_env("long_jump", num_worlds=2, physics_options={"threads": 1})
    body = Clip(30.0, "smpl", *(x[:, : k + 69] for x, k in ((clip.qpos, 7), (clip.qvel, 6))))
    whole = replace(body, ctrl=np.zeros((clip.num_frames, 69)), meta={"events": {"start": 0.0}})
    agent = PPO(other.obs_size, other.action_size, SMALL, "cpu", 0)
    with pytest.raises(ValueError, match="no fingers"):
        Cloning(other, agent, whole, 1, fingers=True)
    other.close()
    with pytest.raises(ValueError, match="--clone as well"):
        TrainConfig(task="javelin", clips=(THROW,), clone_fingers=True)


def test_a_rate_that_learns_nothing_is_refused():
    with pytest.raises(ValueError, match="clone-rates must be above 0"):
        TrainConfig(task="javelin", clips=(THROW,), clone=1, clone_rates=(1e-3, 0.0))
