"""Starts from policies of other tasks: same actions, blind to the opponent, refusals."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from rl.checkpoint import checkpoints, load_checkpoint
from rl.evaluate import evaluate
from rl.latent_action import LatentActions, LatentConfig
from rl.match import Setting, play_match
from rl.networks import MLP
from rl.normalizer import Normalizer
from rl.policy import FORMAT, PolicyError, read_policy
from rl.ppo import PPOConfig
from rl.prior import LatentPrior, save_prior
from rl.train import TrainConfig, train
from rl.warm_start import load_start
from sports.env import make_env
from sports.humanoid.body import is_finger, load_body
from tests.rl.contest import Contest
from tests.rl.latent_made import made_prior
from warmstart.atomic import write_json

HIDDEN = (8, 8)


def policy_file(
    folder: Path, of: str, options: dict[str, Any] | None = None, **changes: object
) -> str:
    """A made-up policy of a task, with statistics of its own, as a file."""
    env = make_env(of, num_worlds=1, options=options)
    g = torch.Generator().manual_seed(5)
    actor = MLP(env.obs_size, HIDDEN, env.action_size, "silu", 1.0, g)
    path = folder / f"{of}.safetensors"
    save_file(dict(actor.state_dict()), path)
    card = {
        "format": FORMAT,
        "task": of,
        "algo": "ppo",
        "body": env.task.body,
        "strength": "paper",
        "limits": "paper",
        "obs_size": env.obs_size,
        "action_size": env.action_size,
        "obs_layout": {k: [s.start, s.stop] for k, s in env.obs_slices.items()},
        "hidden": list(HIDDEN),
        "activation": "silu",
        "observation_clip": 5.0,
        "obs_mean": torch.randn(env.obs_size, generator=g).tolist(),
        "obs_std": (0.5 + torch.rand(env.obs_size, generator=g)).tolist(),
        "obs_count": 1000.0,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        **changes,
    }
    write_json(path.with_suffix(".json"), card)
    return str(path)


@pytest.mark.parametrize(
    ("solo", "duel", "opponent"),
    [
        ("tennis", "tennis_1v1", 9),
        ("table_tennis", "table_tennis_1v1", 9),
        ("soccer_1v1", "soccer_2v2", 30),
    ],
)
def test_it_acts_as_before_whatever_the_opponent_does(tmp_path, solo, duel, opponent):
    source = policy_file(tmp_path, solo)
    own, env = make_env(solo, num_worlds=1), make_env(duel, num_worlds=2, seed=1)
    before, unseen = load_start(source, own, solo)
    assert not unseen.any()
    policy, unseen = load_start(source, env, duel)
    assert int(unseen.sum()) == opponent == env.obs_size - own.obs_size
    obs = env.reset()[0, 0] + 0.1
    narrow = torch.zeros(own.obs_size)
    for name, at in own.obs_slices.items():
        narrow[at] = obs[env.obs_slices[name]]
    assert (policy(obs) - before(narrow)).abs().max() < 1e-6
    other = obs.clone()
    other[unseen] += 3.0
    assert torch.equal(policy(other), policy(obs))
    policy.check(env)


def test_options_may_show_more_of_the_same_task_but_not_less(tmp_path):
    plain = make_env("hurdling", num_worlds=1)
    env = make_env("hurdling", num_worlds=2, seed=1, options={"lane_seen": True})
    source = policy_file(tmp_path, "hurdling")
    before, _ = load_start(source, plain, "hurdling")
    policy, unseen = load_start(source, env, "hurdling")
    lane = env.obs_slices["goal/lane"]
    assert unseen.nonzero().flatten().tolist() == list(range(lane.start, lane.stop))
    obs = env.reset()[0, 0] + 0.1
    assert (policy(obs) - before(obs[~unseen])).abs().max() < 1e-6
    with pytest.raises(PolicyError, match=f"obs_size {plain.obs_size}"):
        before.check(env)  # nobody is judged by what he cannot see
    sees = policy_file(tmp_path, "hurdling", {"lane_seen": True})
    with pytest.raises(PolicyError, match=f"obs_size {env.obs_size}"):
        load_start(sees, plain, "hurdling")


@pytest.mark.parametrize(
    ("task", "option"),
    [("hurdling", "lane_seen"), ("hurdling", "gap_seen"), ("tennis", "ball_path")],
)
def test_a_policy_is_played_with_what_it_learned_to_look_at(tmp_path, task, option):
    """Its card tells, not the caller; other options of its training are not taken over."""
    card = {"config": {"options": {option: True, "finish_ends": True, "reach": 3.0}}}
    with pytest.raises(PolicyError, match="obs_size"):  # a card that does not tell
        evaluate(policy_file(tmp_path, task, {option: True}), task, trials=1)
    sees = policy_file(tmp_path, task, {option: True}, **card)
    assert evaluate(sees, task, trials=1).result["options"] == {option: True}
    plain = policy_file(tmp_path, task, config={"options": {option: False}})
    assert evaluate(plain, task, trials=1).result["options"] == {}


def test_a_match_is_played_with_what_both_learned_to_look_at(tmp_path):
    task, options = "table_tennis_1v1", {"ball_path": True}
    sees = policy_file(tmp_path, task, options, config={"options": options})
    setting = Setting(task, trials=2)
    assert play_match(sees, "zero", setting)["options"] == options
    (tmp_path / "plain").mkdir()
    plain = policy_file(tmp_path / "plain", task)
    with pytest.raises(PolicyError, match="obs_size"):
        play_match(sees, plain, setting)
    assert play_match(plain, "zero", setting)["options"] == {}


def test_other_names_for_the_same_thing(tmp_path):
    """A kicker's goal is the other goal of a match; a thrower's ball has its velocities apart."""
    for solo, duel, pairs in (
        ("penalty_kick", "soccer_1v1", {"goal/other_goal": "goal/goal"}),
        ("free_throw", "basketball_1v1", {"goal/ball_position": "goal/ball_pos"}),
    ):
        env, own = make_env(duel, num_worlds=1), make_env(solo, num_worlds=1)
        policy, unseen = load_start(policy_file(tmp_path, solo), env, duel)
        card = json.loads((tmp_path / f"{solo}.json").read_text())
        for name, old in pairs.items():
            assert not unseen[env.obs_slices[name]].any()
            told = policy.mean[env.obs_slices[name]].tolist()
            assert told == pytest.approx(card["obs_mean"][own.obs_slices[old]])
        velocity = env.obs_slices["goal/ball_velocity"]
        assert not unseen[velocity].any()
        assert unseen[env.obs_slices["goal/opponent1_position"]].all()


def test_the_same_joint_angles_are_asked_for_around_another_guard(tmp_path):
    source = policy_file(tmp_path, "fencing")
    fencing, boxing = make_env("fencing", num_worlds=1), make_env("boxing", num_worlds=1)
    assert (fencing.action_offset - boxing.action_offset).abs().max() > 0.5
    before, _ = load_start(source, fencing, "fencing")
    policy, _ = load_start(source, boxing, "boxing")
    narrow, obs = torch.zeros(fencing.obs_size), boxing.reset()[0, 0]
    for name, at in fencing.obs_slices.items():
        own = boxing.obs_slices.get(name)
        if own is not None and own.stop - own.start == at.stop - at.start:
            narrow[at] = obs[own]
        else:  # what a boxer does not see is at its mean
            narrow[at] = before.mean[at]
    angles = fencing.action_offset + fencing.action_scale * before(narrow)
    same = boxing.action_offset + boxing.action_scale * policy(obs)
    torch.testing.assert_close(same, angles, rtol=1e-5, atol=1e-5)


def test_another_athlete_is_refused_with_a_sentence(tmp_path):
    boxing = make_env("boxing", num_worlds=1)
    with pytest.raises(PolicyError, match="its body is 'smplx', not 'smpl'"):
        load_start(policy_file(tmp_path, "free_throw"), boxing, "boxing")
    with pytest.raises(PolicyError, match="are around the clips' poses"):
        tracker = policy_file(tmp_path, "boxing", task="tracking")
        load_start(tracker, boxing, "boxing")
    with pytest.raises(PolicyError, match="has 69 actions, the task 1"):
        contest = Contest(2)
        contest.task.body = "smpl"
        load_start(policy_file(tmp_path, "tennis"), contest, "contest")
    with pytest.raises(PolicyError, match="does not say what it observes"):
        source = policy_file(tmp_path, "tennis", obs_layout=None)
        load_start(source, make_env("tennis_1v1", num_worlds=1), "tennis_1v1")
    with pytest.raises(ValueError, match="baseline"):
        load_start("zero", boxing, "boxing")


def latent_file(folder: Path, of: str) -> tuple[str, LatentPrior]:
    """A made-up policy of a task for athletes without fingers, in latents, beside its prior."""
    prior = made_prior("smpl")
    save_prior(prior, folder / "prior.safetensors", half=False)
    latent = {"prior_digest": prior.digest, **asdict(LatentConfig())}
    env = make_env(of, num_worlds=1)
    actor = MLP(env.obs_size, HIDDEN, prior.latent, "silu", 1.0, torch.Generator().manual_seed(6))
    env.close()
    path = Path(policy_file(folder, of, algo="latent", action_size=prior.latent, latent=latent))
    save_file(dict(actor.state_dict()), path)
    card = json.loads(path.with_suffix(".json").read_text())
    card["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    write_json(path.with_suffix(".json"), card)
    return str(path), prior


def test_a_footballer_in_latents_begins_as_an_athlete_with_fingers(tmp_path):
    """What it read of a link it reads of the same, and of a hand as of the wrist."""
    source, prior = latent_file(tmp_path, "soccer_1v1")
    env = make_env("basketball_1v1", num_worlds=1)
    scene = env.physics.scene
    with pytest.raises(PolicyError, match="its body is 'smpl', not 'smplx'"):
        load_start(source, env, "basketball_1v1")  # there is no layer
    env.act_through(LatentActions(prior, LatentConfig(), scene, (), env.device))
    policy, unseen = load_start(source, env, "basketball_1v1")
    before = read_policy(source, "soccer_1v1")
    assert policy.metadata["body"] == "smplx" and policy.metadata["task"] == "basketball_1v1"
    known, body = load_body("smpl"), scene.body
    where = {k: slice(*v) for k, v in before.metadata["obs_layout"].items()}

    # In units of the normaliser: any posture whose hands are turned as the wrists.
    g = torch.Generator().manual_seed(1)
    old = torch.randn(5, before.metadata["obs_size"], generator=g)
    new = torch.randn(5, env.obs_size, generator=g)
    new[:, 0] = old[:, 0]
    for name in ("own_goal", "other_goal"):  # there are rims
        old[:, where[f"goal/{name}"]] = 0.0
    for name in env.obs_slices:
        if name.startswith(("goal/ball", "goal/opponent")):
            new[:, env.obs_slices[name]] = old[:, where[name]]
    for name, width in (("body_pos", 3), ("body_rot", 6), ("body_linvel", 3), ("body_angvel", 3)):
        first = int(name == "body_pos")

        def of(links, which, link, name=name, width=width, first=first):
            at = which[name].start + width * (links.link_index(link) - first)
            return slice(at, at + width)

        for link in known.link_names[first:]:
            here = of(known, where, link)
            if link in body.link_names:
                new[:, of(body, env.obs_slices, link)] = old[:, here]
            else:
                wrist = of(known, where, link.replace("Hand", "Wrist"))
                old[:, here] = old[:, wrist] * before.std[wrist] / before.std[here]
    torch.testing.assert_close(policy.actor(new), before.actor(old), atol=1e-5, rtol=1e-5)
    fingers = [i for i, link in enumerate(body.link_names) if is_finger(link)]
    rot = env.obs_slices["body_rot"].start
    assert all(unseen[rot + 6 * i : rot + 6 * i + 6].all() for i in fingers)
    assert int(unseen[: 15 * body.num_links - 2].sum()) == 15 * len(fingers)
    env.act_through(LatentActions(made_prior("smpl", seed=1), LatentConfig(), scene, (), "cpu"))
    with pytest.raises(PolicyError, match="its body is 'smpl', not 'smplx'"):
        load_start(source, env, "basketball_1v1")  # another prior's latents
    env.close()


def test_numbers_that_a_policy_in_latents_lacks_begin_with_0(tmp_path):
    """An arm's own share and the hands'; also from a card that is older than these. Whose arm has
    another share acts in another way."""
    source, prior = latent_file(tmp_path, "soccer_1v1")
    card = json.loads(Path(source).with_suffix(".json").read_text())
    del card["latent"]["hands"]
    write_json(Path(source).with_suffix(".json"), card)
    env = make_env("javelin", num_worlds=1)
    found = []
    for options in ({}, {"hands": True}, {"hands": True, "arm_residual": 0.3}):
        config = LatentConfig(**options)
        env.act_through(LatentActions(prior, config, env.physics.scene, (), env.device))
        policy, _ = load_start(source, env, "javelin")
        assert asdict(LatentConfig()) | policy.metadata["latent"] == env.layer.card
        assert policy.metadata["action_size"] == env.action_size
        found.append(policy.actor(torch.ones(3, env.obs_size)))
    plain, hands, both = found
    assert [x.shape[1] - plain.shape[1] for x in found] == [0, 2, 2 + 12]
    for x in (hands, both):
        assert torch.equal(x[:, : plain.shape[1]], plain)
        assert float(x[:, plain.shape[1] :].abs().max()) == 0.0
    card["latent"]["arm_residual"] = 0.1
    write_json(Path(source).with_suffix(".json"), card)
    with pytest.raises(PolicyError, match="actions"):
        load_start(source, env, "javelin")
    env.close()


def test_new_features_take_the_statistics_of_what_is_seen_first():
    """Against numpy's mean and variance; known features merge as they always do."""
    g = torch.Generator().manual_seed(0)
    seen = 3.0 + 2.0 * torch.randn(500, 4, generator=g)
    columns = torch.tensor([False, True, False, True])
    norm, plain = Normalizer(4), Normalizer(4)
    for n in (norm, plain):
        n.set_moments(1e6, torch.tensor([0.0, 9.0, 1.0, 9.0]), torch.tensor([1.0, 7.0, 2.0, 7.0]))
        n.collect(seen)
    norm.adopt(columns)
    norm.commit()
    plain.commit()
    assert torch.equal(norm.mean[~columns], plain.mean[~columns])
    assert torch.equal(norm.std[~columns], plain.std[~columns])
    expected = seen.double()[:, columns]
    torch.testing.assert_close(norm.mean[columns].double(), expected.mean(0), rtol=1e-6, atol=1e-6)
    spread = (expected.var(0, unbiased=False) + norm.epsilon).sqrt()
    torch.testing.assert_close(norm.std[columns].double(), spread, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("algo", ["ppo", "selfplay"])
def test_a_run_begins_with_it(tmp_path, algo):
    """With rate 0 the weights stay; the first rollout only shows the opponent's features."""
    small = PPOConfig(steps=4, minibatches=1, epochs=1, learning_rate=0.0, kl_band=None)
    source = policy_file(tmp_path, "tennis")
    run = TrainConfig(task="tennis_1v1", algo=algo, worlds=8, init=source, quiet=True, ppo=small)
    run = TrainConfig(**{**vars(run), "out": tmp_path / "run", "samples": 2 * 4 * 16})
    if algo == "selfplay":
        from rl.selfplay import SelfPlayConfig

        few = SelfPlayConfig(pool=4, ladder=(1000,))
        run = TrainConfig(**{**vars(run), "selfplay": few, "samples": 2 * 4 * 12})
    train(run)
    tensors = load_checkpoint(checkpoints(tmp_path / "run")[-1])[1]
    env = make_env("tennis_1v1", num_worlds=1)
    policy, unseen = load_start(source, env, "tennis_1v1")
    assert policy.actor is not None
    for name, x in policy.actor.state_dict().items():
        assert torch.equal(tensors[f"agent/actor.{name}"], x)
    count, mean = (
        tensors["agent/obs_norm.total"][0],
        tensors["agent/obs_norm.total"][1:][: len(unseen)],
    )
    assert float(count) == 1000.0 + run.samples  # type: ignore[operator]
    kept = tensors["agent/obs_norm.kept"]
    assert torch.equal(kept, ~unseen)
    torch.testing.assert_close(mean[kept].float(), policy.mean[kept])
    # The opponent is 26 m away, behind the net: the mean of its place is not that of nothing.
    ahead = env.obs_slices["goal/opponent"].start
    assert float(mean[ahead]) > 20.0
    if algo == "selfplay":
        assert torch.equal(
            tensors["selfplay/stack.mean"][0, 0, ahead], tensors["selfplay/stack.mean"][3, 0, ahead]
        )
        assert float(tensors["selfplay/stack.mean"][0, 0, ahead]) > 20.0
