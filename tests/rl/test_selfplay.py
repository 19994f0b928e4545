"""Self-play: who plays whom, what is learned from, what stays frozen, a known optimum, resume."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from rl.checkpoint import checkpoints, load_checkpoint
from rl.graph import GraphedStep
from rl.networks import MLP
from rl.normalizer import Normalizer
from rl.policy import PolicyError, export_policy, load_policy
from rl.policy_stack import PolicyStack
from rl.ppo import PPO
from rl.rollout import collect
from rl.runlog import read_progress
from rl.selfplay import SelfPlay, SelfPlayConfig
from rl.train import train
from tests.rl.contest import FEW, SMALL, Contest, contest_config, contest_env, law
from tests.rl.test_train import same_bits

ROOT = Path(__file__).parents[2]
CPU = torch.device("cpu")
ALTERNATE = dataclasses.replace(FEW, scheme="alternate")


def begun(
    config: SelfPlayConfig = FEW, worlds: int = 48, half: int = 1, seed: int = 0
) -> tuple[Contest, PPO, SelfPlay]:
    env = Contest(worlds, seed, half)
    agent = PPO(env.obs_size, env.action_size, SMALL, "cpu", seed)
    agent.obs_norm.set_moments(1000, torch.tensor([0.1, 0.4]), torch.tensor([0.6, 0.3]))
    return env, agent, SelfPlay(env, agent, config, SMALL.steps, seed)


def iterate(env: Contest, play: SelfPlay, obs: torch.Tensor, samples: int) -> torch.Tensor:
    rollout = play.agent.new_rollout(env.num_worlds * env.num_agents)
    obs = collect(env, play, rollout, obs, SMALL.gamma, on_step=play.watch)
    play.learn(rollout)
    play.settle(samples, True)
    return obs


def test_stacked_opponents_act_as_each_one_alone():
    g = torch.Generator().manual_seed(0)
    actors = [MLP(9, (32, 16), 5, "silu", 1.0, g) for _ in range(6)]
    stack = PolicyStack(actors[0], 6, 5.0, CPU)
    norms = []
    for slot, actor in enumerate(actors):
        norm = Normalizer(9)
        norm.collect(2.0 * torch.randn(50, 9, generator=g) + slot)
        norm.commit()
        norms.append(norm)
        stack.write(slot, actor.state_dict(), norm.mean, norm.std)
    obs = 4.0 * torch.randn(6, 30, 9, generator=g)
    obs[2, 3, 4] = torch.nan
    told = stack(obs)
    with torch.no_grad():
        for slot, (actor, norm) in enumerate(zip(actors, norms)):
            alone = actor(norm.normalize(torch.nan_to_num(obs[slot])))
            assert (told[slot] - alone).abs().max() <= 1e-6


def test_stacked_opponents_multiply_as_ppo_does_in_bf16():
    """Against the network under autocast; what was written is read again."""
    g = torch.Generator().manual_seed(0)
    actors = [MLP(9, (32, 16), 5, "silu", 1.0, g) for _ in range(3)]
    stack = PolicyStack(actors[0], 3, 5.0, CPU, bf16=True)
    zero, one = torch.zeros(9), torch.ones(9)
    for slot, actor in enumerate(actors):
        stack.write(slot, actor.state_dict(), zero + slot, one)
    obs = torch.randn(3, 20, 9, generator=g)
    told = stack(obs)
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        for slot, actor in enumerate(actors):
            alone = actor((obs[slot] - slot).clamp(-5, 5).to(torch.bfloat16))
            assert (told[slot] - alone).abs().max() < 0.02  # steps of bf16 near 1 are 0.008
            kept, mean, std = stack.read(slot)
            assert torch.equal(mean, zero + slot) and torch.equal(std, one)
            assert torch.equal(kept["head.weight"], actor.head.weight)
            rounded = actor.get_parameter("trunk.0.weight").to(torch.bfloat16).float()
            assert torch.equal(kept["trunk.0.weight"], rounded)


@pytest.mark.parametrize("half", [1, 2])
def test_worlds_sides_and_opponents_have_their_shares(half):
    """Half of the worlds with frozen opponents, each slot as many, sides alike in the long run."""
    env, _, play = begun(worlds=96, half=half)
    assert play.frozen == 48 == len(play.worlds.unique())
    assert play.learned_rows == (96 + 48) * half
    obs, sides = env.reset(), []
    for _ in range(120):
        _, action, _, _ = play.act(obs.flatten(0, 1))
        t = play._step
        mine, theirs = play._mine[t], play._theirs[t]
        rows = torch.cat((play._alike, mine, theirs))
        assert torch.equal(rows.sort().values, torch.arange(96 * 2 * half))
        # A team is together: the learner's rows of a world are one half of its athletes.
        teams = mine.view(-1, half) // half
        assert (teams == teams[:, :1]).all()
        assert torch.equal(teams[:, 0] // 2, play.worlds)
        sides.append(teams[:, 0] % 2)
        result = env.step(action.unflatten(0, (96, 2 * half)))
        play.watch(result)
        obs = result.obs
    share = torch.stack(sides).float().mean()  # 30 episodes of 48 worlds
    assert abs(float(share) - 0.5) < 4 * 0.5 / (30 * 48) ** 0.5
    changes = torch.stack(sides).diff(dim=0).abs().sum(0)
    assert changes.min() > 3  # of 29 new episodes


def test_a_side_changes_only_between_episodes():
    env, _, play = begun()
    obs = env.reset()
    for _ in range(40):
        before = play.side.clone()
        result = env.step(play.act(obs.flatten(0, 1))[1].unflatten(0, (48, 2)))
        play.watch(result)
        changed = play.side != before
        assert result.ended[play.worlds][changed].all()
        obs = result.obs


def test_each_row_is_moved_by_its_own_policy():
    """Opponents by their snapshot and the same noise, all others as PPO alone would."""
    env, _, play = begun()
    _, twin, _ = begun()
    g = torch.Generator().manual_seed(4)
    snapshots = [MLP(2, (16,), 1, "silu", 1.0, g) for _ in play.league.slots]
    for slot, actor in enumerate(snapshots):
        play.stack.write(slot, actor.state_dict(), torch.full((2,), 0.1 * slot), torch.ones(2))
    obs = env.reset().flatten(0, 1)
    stored, action, mean, log_prob = play.act(obs)
    alone = twin.act(obs)
    theirs = play._theirs[0]
    others = torch.ones(96, dtype=torch.bool).index_fill(0, theirs, False)
    for got, want in zip((stored, action, mean, log_prob), alone):
        assert torch.equal(got[others], want[others])
    noise = alone[1] - alone[2]
    per_slot = theirs.view(len(snapshots), -1)
    with torch.no_grad():
        for slot, actor in enumerate(snapshots):
            for row in per_slot[slot].tolist():
                seen = (obs[row] - 0.1 * slot).clamp(-5, 5)
                assert float(action[row]) == pytest.approx(
                    float(actor(seen) + noise[row]), abs=1e-6
                )


def test_what_opponents_did_teaches_nothing():
    """Other rewards and actions in their rows change no weight, and their observations no mean."""
    states = []
    for poison in (False, True):
        env, agent, play = begun()
        rollout = agent.new_rollout(96)
        collect(env, play, rollout, env.reset(), SMALL.gamma, on_step=play.watch)
        pending = agent.obs_norm.state_dict()["pending"]
        assert float(pending[0]) == SMALL.steps * play.learned_rows
        if poison:
            at = (torch.arange(SMALL.steps)[:, None], play._theirs)
            rollout.reward[at] = 1e3
            rollout.action[at] = -3.0
            rollout.obs[at] = 2.0
        play.learn(rollout)
        states.append(agent.state_dict())
    for name, x in states[0].items():
        assert torch.equal(x, states[1][name]), name


def test_all_samples_of_the_latest_policy_are_learned_from_and_once_an_epoch():
    env, agent, play = begun()
    rollout = agent.new_rollout(96)
    collect(env, play, rollout, env.reset(), SMALL.gamma, on_step=play.watch)
    seen: list[torch.Tensor] = []
    assert isinstance(agent._step, GraphedStep)
    agent._step._step = seen.append
    play.learn(rollout)
    own = torch.ones(SMALL.steps, 96, dtype=torch.bool).scatter(1, play._theirs, False)
    assert torch.equal(rollout.valid, own)
    wanted = own.flatten().nonzero()[:, 0]
    per_epoch = len(seen) // SMALL.epochs
    for epoch in range(SMALL.epochs):
        rows = torch.cat(seen[epoch * per_epoch : (epoch + 1) * per_epoch])
        assert torch.equal(rows.sort().values, wanted)


def test_frozen_opponents_and_their_normalisers_never_change():
    env, agent, play = begun(dataclasses.replace(FEW, snapshot_samples=10**9, ladder=(10**9,)))
    before = {k: v.clone() for k, v in play.stack.state_dict().items()}
    actor = {k: v.clone() for k, v in agent.actor.state_dict().items()}
    obs = env.reset()
    for i in range(6):
        obs = iterate(env, play, obs, i + 1)
    for name, x in play.stack.state_dict().items():
        assert torch.equal(x, before[name])
    assert any(not torch.equal(x, actor[k]) for k, x in agent.actor.state_dict().items())
    assert not torch.equal(agent.obs_norm.mean, before["mean"][0, 0])


def test_a_snapshot_is_the_policy_of_its_moment():
    env, agent, play = begun(dataclasses.replace(FEW, snapshot_samples=3, ladder=(10**9,)))
    obs, kept = env.reset(), []
    for i in range(12):
        obs = iterate(env, play, obs, i + 1)
        if (i + 1) % 3 == 0:
            norm = agent.obs_norm
            kept.append((agent.actor.head.weight.detach().clone(), norm.mean.clone()))
    assert [e.samples for e in play.league.entries] == [0, 3, 6, 9, 12]
    for number, (head, mean) in enumerate(kept, start=1):
        slots = [s for s, e in enumerate(play.league.slots) if e == number]
        assert slots
        for slot in slots:
            actor, shown, _ = play.stack.read(slot)
            assert torch.equal(actor["head.weight"], head) and torch.equal(shown, mean)


def test_a_good_score_brings_a_snapshot_early():
    _, _, play = begun(dataclasses.replace(FEW, snapshot_samples=1000, ladder=(10**9,)))
    play.settle(1000, True)
    entry = play.league.entries[1]
    entry.results = [60.0, 10.0, 20.0]  # 0.72 of 90 games
    play.settle(1249, True)
    assert len(play.league.entries) == 2
    entry.results = [60.0, 10.0, 20.0]
    play.settle(1250, True)
    assert len(play.league.entries) == 3
    play.league.entries[1].results = play.league.entries[2].results = [40.0, 10.0, 40.0]
    play.settle(2249, True)
    assert len(play.league.entries) == 3


def test_results_are_counted_from_the_learners_side():
    """Hand-made outcomes: side 0 has won everywhere; the learner where it is side 0."""
    env, _, play = begun()
    obs = env.reset()
    env.age.fill_(env.max_steps - 1)
    side = play.side.clone()
    result = env.step(play.act(obs.flatten(0, 1))[1].unflatten(0, (48, 2)))
    result.outcome = torch.ones(48)
    play.rated[:4] = False  # their opponent is new
    play.watch(result)
    counts = play.counts.sum(0).tolist()
    mine = int((side[4:] == 0).sum())
    assert counts == [mine, 0, 20 - mine]
    assert play.rated.all()
    result.outcome = torch.zeros(48)
    result.valid = torch.zeros(48, dtype=torch.bool)
    play.watch(result)  # a world that diverged has no result
    assert play.counts.sum() == 20


def test_in_turns_one_policy_learns_while_the_other_rests_as_it_was():
    env, agent, play = begun(dataclasses.replace(ALTERNATE, ladder=(10**9,), swap=3))
    obs = env.reset()
    names = [k for k in play.rival if not k.startswith("adam.")]
    assert (play.side == 0).all() and play.frozen == 48
    resting = {k: play.rival[k].clone() for k in names}
    for turn in range(4):
        for i in range(3):
            for k in names:
                assert torch.equal(play.rival[k], resting[k]), k
            rival = next(i for i, e in enumerate(play.league.entries) if e.kind == "rival")
            for slot in (s for s, e in enumerate(play.league.slots) if e == rival):
                assert torch.equal(
                    play.stack.read(slot)[0]["head.weight"], resting["actor.head.weight"]
                )
            if i == 2:  # what the learner is when it goes to rest is what then rests
                rollout = agent.new_rollout(96)
                obs = collect(env, play, rollout, obs, SMALL.gamma, on_step=play.watch)
                play.learn(rollout)
                learned = {k: v.clone() for k, v in agent.state_dict().items()}
                play.settle(1, True)
            else:
                obs = iterate(env, play, obs, 1)
        now = agent.state_dict()
        actors = [k for k in names if k.startswith(("actor.", "obs_norm."))]
        for k in actors:
            assert torch.equal(now[k], resting[k]), k
        for k in names:
            assert torch.equal(play.rival[k], learned[k]), k
        assert (play.side == (turn + 1) % 2).all()
        resting = {k: learned[k] for k in names}


@pytest.mark.parametrize("config", [FEW, ALTERNATE], ids=["shared", "alternate"])
def test_the_best_answer_to_everybody_is_learned(tmp_path, config):
    """law(x) wins or draws against every policy; the ladder's first policy is left far behind."""
    run = contest_config(tmp_path, samples=60 * 576, selfplay=config)
    train(run, environment=contest_env)
    policy = load_policy(tmp_path, "contest")
    assert policy.metadata["algo"] == "selfplay"
    x = torch.linspace(-0.9, 0.9, 19)
    for clock in (0.0, 0.5):
        said = policy(torch.stack((x, torch.full_like(x, clock)), -1))[:, 0]
        assert (said - law(x)).abs().mean() < 0.08  # of 0.4 at the beginning
    rows = read_progress(tmp_path)
    last = rows[-1]
    assert last["selfplay/elo"] > 40.0 > abs(rows[0]["selfplay/elo"])  # type: ignore[operator]
    assert last["selfplay/score_ladder"] > 0.55  # type: ignore[operator]
    learned = 8 * (48 + 24) if config is FEW else 8 * 48
    assert rows[0]["samples"] == learned


def test_teams_of_two_learn_too(tmp_path):
    run = contest_config(tmp_path, samples=30 * 1152)
    train(run, environment=lambda c, seed: Contest(c.num_worlds, seed, half=2))
    policy = load_policy(tmp_path, "contest")
    x = torch.linspace(-0.9, 0.9, 19)
    said = policy(torch.stack((x, torch.full_like(x, 0.5)), -1))[:, 0]
    assert (said - law(x)).abs().mean() < 0.12


def test_a_frozen_opponent_of_a_run_is_the_run_as_it_was(tmp_path):
    """Against runs that ended there: by samples; and in turns the rival, when the places have just
    been changed, against one that has not changed them."""
    obs = torch.rand(50, 2, generator=torch.Generator().manual_seed(2))

    def said(name: str, samples: int, config: SelfPlayConfig, which: str = "") -> torch.Tensor:
        run = contest_config(tmp_path / name, samples=samples, selfplay=config)
        train(run, environment=contest_env)
        return load_policy(f"{run.out}{which}", "contest")(obs)

    now = said("long", 6 * 576, FEW, "@2304")
    assert torch.equal(now, said("short", 4 * 576, FEW))
    early = load_policy(f"{tmp_path / 'long'}@2304", "contest")
    assert early.metadata["samples"] == 2304
    shipped = load_policy(export_policy(f"{tmp_path / 'long'}@2304", tmp_path / "early"), "contest")
    torch.testing.assert_close(shipped(obs), now, atol=5e-3, rtol=5e-3)
    assert not torch.equal(now, load_policy(tmp_path / "long", "contest")(obs))
    # The first iteration only shows; three of learning make a turn.
    rested = said("turned", 4 * 384, dataclasses.replace(ALTERNATE, swap=3), "@rival")
    assert torch.equal(rested, said("still", 4 * 384, dataclasses.replace(ALTERNATE, swap=99)))
    with pytest.raises(PolicyError, match="it has @0, @2304"):
        load_policy(f"{tmp_path / 'long'}@17", "contest")


@pytest.mark.parametrize("config", [FEW, ALTERNATE], ids=["shared", "alternate"])
def test_a_resumed_run_repeats_the_uninterrupted_one_bit_for_bit(tmp_path, config):
    base = contest_config(tmp_path / "whole", samples=11 * 576, selfplay=config)
    train(base, environment=contest_env)

    class Interrupted(Exception):
        pass

    def stop(row: Any) -> None:
        if row["iteration"] == 7:
            raise Interrupted

    halves = dataclasses.replace(base, out=tmp_path / "halves", checkpoint_iterations=6)
    with pytest.raises(Interrupted):
        train(halves, environment=contest_env, on_iteration=stop)
    plain = dataclasses.replace(base, out=tmp_path / "halves", resume=True)
    train(plain, environment=contest_env)
    same_bits(tmp_path / "whole", tmp_path / "halves")
    states = [
        load_checkpoint(checkpoints(tmp_path / n)[-1])[0]["selfplay"] for n in ("whole", "halves")
    ]
    assert states[0] == states[1] and len(states[0]["league"]["entries"]) >= 3


def test_kill_at_any_moment_then_resume_is_the_uninterrupted_run(tmp_path):
    train(contest_config(tmp_path / "whole", samples=40 * 576), environment=contest_env)
    killed = tmp_path / "killed"
    command = [sys.executable, "-m", "tests.rl.contest", str(killed), str(10**9)]
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, cwd=ROOT, env=env, text=True, stdout=pipe, stderr=pipe)
    while not checkpoints(killed) or checkpoints(killed)[-1].name < "step_0000006":
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    assert process.wait(60) == -signal.SIGKILL
    if int(checkpoints(killed)[-1].name[5:]) >= 40:
        pytest.skip("this machine was too quick to be killed in time")
    train(contest_config(killed, samples=40 * 576, resume=True), environment=contest_env)
    same_bits(tmp_path / "whole", killed)


def test_two_ranks_meet_the_same_opponents(tmp_path):
    """gloo on the CPU: worlds and sides differ, opponents, ratings and weights do not."""
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    script = str(Path(__file__).with_name("contest.py"))
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *launch, script, str(tmp_path), str(10 * 1152)],
        cwd=ROOT,
        env=env,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert [r["samples"] for r in read_progress(tmp_path)] == [1152 * (i + 1) for i in range(10)]
    # Two episodes of 24 worlds on each rank; later some have an opponent exchanged.
    assert read_progress(tmp_path)[0]["selfplay/games"] == 2 * 2 * 24
    path = checkpoints(tmp_path)[-1]
    state, zero = load_checkpoint(path, 0)
    one = load_checkpoint(path, 1)[1]
    assert len(state["selfplay"]["league"]["entries"]) > 3
    alike = [k for k in zero if k.startswith(("selfplay/stack.", "agent/actor."))]
    assert all(torch.equal(zero[k], one[k]) for k in alike)
    assert not torch.equal(zero["selfplay/worlds"], one["selfplay/worlds"])


def test_what_cannot_be_is_refused_with_a_sentence(tmp_path):
    from rl.train import TrainConfig

    solo = TrainConfig(task="long_jump", algo="selfplay", worlds=16, out=tmp_path)
    with pytest.raises(ValueError, match="needs a task for two sides"):
        train(solo)
    with pytest.raises(ValueError, match="use more worlds"):
        train(contest_config(tmp_path, worlds=4), environment=contest_env)
    with pytest.raises(ValueError, match="--algo selfplay"):
        TrainConfig(task="fencing", selfplay=FEW)
    bad: tuple[dict[str, Any], ...] = (
        {"share": 0.0},
        {"pool": 0},
        {"snapshot_score": 0.3},
        {"ladder": (5, 3)},
    )
    for options in bad:
        with pytest.raises(ValueError, match="selfplay: "):
            SelfPlayConfig(**options)
    assert not tmp_path.joinpath("config.json").exists()
