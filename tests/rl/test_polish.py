"""Whether a search over whole episodes finds a known optimum, and what it moves is what it says."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rl import curves, pretrained
from rl.directions import (
    Directions,
    phases,
    phases_of_part,
    scaled,
    shifts,
    towards,
    weights_of,
)
from rl.host import RANK_STEP
from rl.networks import MLP
from rl.policy import Policy, PolicyError, load_policy
from rl.polish import Aim, Crowd, Search, aims, met, polish, worth
from rl.polish_config import Polish
from rl.runlog import read_progress
from rl.trials import Share, opened, play_episodes, standing_starts
from sports.env import Env, make_env
from sports.humanoid.body import load_body
from sports.physics.variation import Variation

D, H, U = 6, 5, 3


def made(seed: int, hidden: int = H) -> Policy:
    """A small policy with statistics of its own."""
    generator = torch.Generator().manual_seed(seed)
    actor = MLP(D, (8, hidden), U, generator=generator).requires_grad_(False)
    mean = torch.randn(D, generator=generator)
    std = torch.rand(D, generator=generator) + 0.5
    card = {"observation_clip": 50.0, "activation": "silu", "action_size": U, "sha256": str(seed)}
    return Policy(actor, mean, std, card)


def played(policy: Policy, weights: dict[str, torch.Tensor], obs: torch.Tensor) -> torch.Tensor:
    """Actions of the policy's network with other weights."""
    actor = MLP(D, (8, H), U)
    actor.load_state_dict(weights)
    return replace(policy, actor=actor)(obs)


def test_the_whole_way_to_another_policy_is_that_policy_whatever_its_statistics():
    own, other = made(0), made(1)
    directions = Directions(weights_of(own), [towards(own, other)])
    obs = torch.randn(40, D)
    torch.testing.assert_close(played(own, directions.at(torch.zeros(1)), obs), own(obs))
    there = played(own, directions.at(torch.ones(1)), obs)
    torch.testing.assert_close(there, other(obs), atol=1e-4, rtol=0)
    quarter = Directions(weights_of(own), [scaled(towards(own, other), 0.25)])
    there = played(own, quarter.at(torch.full((1,), 4.0)), obs)
    torch.testing.assert_close(there, other(obs), atol=1e-4, rtol=0)
    with pytest.raises(PolicyError, match="one kind"):
        towards(own, made(2, hidden=7))


def test_a_shift_moves_one_action_by_its_unit():
    policy, unit, parts = made(0), 0.01, 2
    obs = torch.randn(4000, D)
    found = phases(policy, obs, parts)
    changes = shifts(policy, found, unit)
    assert len(changes) == U * (1 + parts)
    base = policy(obs)
    for k, change in enumerate(changes):
        action, part = divmod(k, 1 + parts)
        one = torch.nn.functional.one_hot(torch.tensor(k), len(changes)).float()
        moved = played(policy, Directions(weights_of(policy), changes).at(one), obs) - base
        others = [u for u in range(U) if u != action]
        assert moved[:, others].abs().max() == 0.0, change
        mean, size = float(moved[:, action].mean()), float(moved[:, action].square().mean().sqrt())
        assert size == pytest.approx(unit, rel=1e-3)
        assert mean == pytest.approx(unit if part == 0 else 0.0, abs=1e-5)
    # What follows one component does not follow the other.
    first, second = (played(policy, Directions(weights_of(policy), changes).at(e), obs) - base
                     for e in torch.eye(len(changes))[1:3])  # fmt: skip
    assert float((first[:, 0] * second[:, 0]).mean()) == pytest.approx(0.0, abs=1e-7)
    one = shifts(policy, found, unit, [1, 2])[0]["head.bias"]
    torch.testing.assert_close(one, torch.tensor([0.0, unit, 0.0]))
    with pytest.raises(ValueError, match="ways"):
        phases(policy, obs[:1].repeat(9, 1), 1)


def test_what_is_shifted_in_a_part_is_what_stands_out_there():
    policy, unit = made(0), 0.01
    draw = torch.Generator().manual_seed(0)
    obs = torch.randn(6000, D, generator=draw)
    part = torch.arange(len(obs)) % 3 == 0
    obs[part] += torch.randn(D, generator=draw)
    found = phases_of_part(policy, obs, part, 2)
    changes = shifts(policy, found, unit, always=False)
    assert len(changes) == U * 2
    base, size = policy(obs), []
    for k, one in enumerate(torch.eye(len(changes))):
        moved = played(policy, Directions(weights_of(policy), changes).at(one), obs) - base
        action = k // 2
        within, rest = (float(moved[w, action].square().mean().sqrt()) for w in (part, ~part))
        assert within == pytest.approx(unit, rel=1e-3)
        size.append(rest / within)
        assert moved[:, [u for u in range(U) if u != action]].abs().max() == 0.0
    assert size[0] < size[1]
    hidden = policy.actor.trunk((obs - policy.mean) / policy.std) - found.middle  # type: ignore[union-attr]
    for axis in torch.randn(200, H, generator=draw):  # none of these keeps more out of the rest
        value = hidden @ axis
        assert value[~part].norm() / value[part].norm() * 2**-0.5 > size[0] - 0.01
    for wrong in (part & False, part | True):
        with pytest.raises(ValueError, match="beside it"):
            phases_of_part(policy, obs, wrong, 1)
    with pytest.raises(ValueError, match=f"{H + 1} ways"):
        phases_of_part(policy, obs, part, H + 1)


def test_a_part_is_told_by_the_clock_of_each_episode(tmp_path: Path):
    config = replace(CONFIG, part=(0.0, 0.1), out=tmp_path, generations=1)
    polish(config, quiet=True)
    card = load_policy(tmp_path / "policy.safetensors", "long_jump").metadata
    assert card["polish"]["part"] == [0.0, 0.1]
    with pytest.raises(ValueError, match="another search"):
        polish(replace(config, part=(0.0, 0.2), generations=2))
    # An episode of a long jump is over long before its last tenth.
    with pytest.raises(ValueError, match="something in it"):
        polish(replace(config, part=(0.99, 1.0), out=tmp_path / "late"), quiet=True)


def test_episodes_begin_where_the_policy_is_in_a_part_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Without noise every start is what 33 steps of the policy lead to, clock and all."""
    policy = load_policy(CONFIG.policy, CONFIG.name)
    env = make_env(CONFIG.name, num_worlds=1, training=False)
    obs = env.reset()
    for _ in range(33):
        obs = env.step(policy(obs)).obs
    qpos, qvel, at = env.physics.qpos[0].clone(), env.physics.qvel[0].clone(), 33 / env.max_steps
    env.close()
    begun: list[Env] = []

    def play(policy, share: Share, env: Env, report=None):
        if env.starts is not None:
            env.reset()
            assert (env.physics.qpos - qpos).abs().max() < 1e-4
            assert (env.physics.qvel - qvel).abs().max() < 1e-3
            assert (env.view.clock == 33).all()
            begun.append(env)
        return play_episodes(policy, share, env, report)

    monkeypatch.setattr("rl.polish.play_episodes", play)
    config = replace(CONFIG, begin=(at, at), start_noise=0.0, generations=1)
    whole = polish(replace(config, begin=None, out=tmp_path / "whole"), quiet=True)[0]
    late = polish(replace(config, out=tmp_path / "late"), quiet=True)[0]
    assert len(begun) == 1
    assert late["middle"] == pytest.approx(whole["middle"], abs=0.02)  # it lands where it did
    assert float(late["samples"] or 0) < float(whole["samples"] or 0) - 5 * 20
    card = load_policy(tmp_path / "late" / "policy.safetensors", "long_jump").metadata
    assert card["polish"]["stages"][0]["worlds"]["begin"] == [at, at]
    common = {"engine": "mujoco", "trials": 2, "worlds": 2, "seed": 0, "options": {}}
    share = Share(CONFIG.name, strength="paper", limits="paper", start_noise=0.05, **common)
    env = make_env(CONFIG.name, num_worlds=2, training=False)
    env.starts = met(policy, share, env, (at, at))
    env.reset()
    moved = (env.physics.qpos - qpos)[:, 7:].abs()
    assert 0.03 < float(moved.max()) < 0.051
    assert (env.physics.qvel - qvel).abs().max() < 1e-3
    env.close()
    with pytest.raises(ValueError, match="begin earlier"):
        polish(replace(config, begin=(0.99, 1.0), out=tmp_path / "never"), quiet=True)
    duel = {"name": "boxing", "policy": "pretrained:selfplay", "objective": "success=1"}
    with pytest.raises(ValueError, match="opponent"):
        polish(replace(config, out=tmp_path / "never", **duel), quiet=True)
    assert not (tmp_path / "never").exists()


def test_half_of_the_starts_come_from_the_worst_episodes():
    """Two rounds in three worlds, of which the last trial is one too many; three policies will play
    there, but whose states they are is one."""
    step, policy = 33, load_policy(CONFIG.policy, CONFIG.name)
    share = Share(CONFIG.name, "mujoco", 5, 3, 0, "paper", "paper", {}, start_noise=0.0, blocks=3)
    states: list[list[torch.Tensor]] = [[], [], []]

    def look(obs: torch.Tensor) -> torch.Tensor:
        for world in torch.nonzero(env.view.clock == step).flatten().tolist():
            states[world].append(env.physics.qpos[world].clone())
        return policy(obs)

    with opened(policy, share) as env:
        env.starts = standing_starts(env, 0.08)
        length = np.nan_to_num(play_episodes(look, share, env).trials["length"])
    every = torch.stack([states[trial % 3][trial // 3] for trial in range(5)])
    last = every[length.argsort()[:2]]  # 0.3 of five are two
    with opened(policy, share) as env:
        env.starts = replace(standing_starts(env, 0.08), blocks=3)
        at = step / env.max_steps
        starts = met(policy, share, env, (at, at), aims("length=1", CONFIG.name), worst=0.3)
        with pytest.raises(ValueError, match="begin earlier"):
            met(policy, share, env, (0.9, 1.0), aims("length=1", CONFIG.name), worst=0.3)
    assert (len(starts.qpos), starts.blocks) == (4, 3)
    near = torch.cdist(starts.qpos[:2].double(), last.double()) < 1e-4
    assert near.any(0).all() and near.sum() == 2
    elapsed = starts.context["elapsed"]
    torch.testing.assert_close(elapsed[:2], torch.full((2,), step * env.view.control_timestep))
    assert elapsed[2:].isnan().all()
    # The other half begin as every episode does, moved by the same noise.
    with opened(policy, share) as env:
        env.reset()
        rules = env.physics.qpos.clone(), env.physics.qvel.clone()
        env.starts = replace(starts, blocks=1, noise=0.0)
        drawn = [whole_starts(env, rules) for _ in range(20)]
    assert 0.2 < np.mean(drawn) < 0.8


def whole_starts(env: Env, rules: tuple[torch.Tensor, torch.Tensor]) -> float:
    """The share of worlds at the start of the rules after a reset; the others are far from it."""
    env.reset()
    same = (env.physics.qpos - rules[0]).abs().amax(1) < 1e-6
    assert ((env.physics.qvel - rules[1])[same].abs() < 1e-6).all()
    assert torch.equal(env.view.clock == 0, same)
    return float(same.float().mean())


def test_everyone_in_a_crowd_plays_in_its_own_block():
    policy, others = made(0), [made(1), made(2)]
    crowd = Crowd(policy, 3)
    ways = Directions(weights_of(policy), [towards(policy, other) for other in others])
    for slot, numbers in enumerate(([0.0, 0.0], [1.0, 0.0], [0.0, 1.0])):
        crowd.write(slot, ways.at(torch.tensor(numbers)))
    obs = torch.randn(12, 2, D)  # 3 blocks of 4 worlds, 2 agents
    action = crowd(obs)
    for slot, one in enumerate((policy, *others)):
        rows = slice(4 * slot, 4 * slot + 4)
        torch.testing.assert_close(action[rows], one(obs[rows]), atol=1e-4, rtol=0)


def test_the_search_finds_a_known_optimum_in_noise():
    goal = np.linspace(-2.0, 2.0, 8)
    noise = np.random.default_rng(0)

    def judge(numbers: np.ndarray) -> tuple[np.ndarray, None]:
        return -((numbers - goal) ** 2).sum(1) + noise.normal(0.0, 0.05, len(numbers)), None

    search = Search(np.zeros(8), np.ones(8), candidates=16, seed=0)
    first = judge(search.middle[None])[0]
    for _ in range(60):
        values, _ = search.advance(judge)
    assert np.abs(search.middle - goal).max() < 0.2
    assert values[0] > -0.2 > first[0]
    assert (search.spreads < 0.5).all()


def test_aims_are_read_and_paid():
    wanted = aims("success=1 time=-0.3@18.2", "hurdling")
    assert wanted == [Aim("success", 1.0, 0.0), Aim("time", -0.3, 18.2)]
    trials = {"success": np.array([1.0, 0.0]), "time": np.array([17.2, np.nan])}
    np.testing.assert_allclose(worth(trials, wanted), [1.3, 0.0])
    assert aims("", "javelin")[0].weight == 1.0
    for text, said in (
        ("success", "no aim"),
        ("success=one", "no aim"),
        ("time=nan", "finite"),
        ("gold=1", "no metric 'gold'; it has: success"),
    ):
        with pytest.raises(ValueError, match=said):
            aims(text, "hurdling")


CONFIG = Polish(
    name="long_jump",
    policy="pretrained",
    out=Path("unused"),
    components=1,
    objective="length=1",
    candidates=4,
    episodes=1,
    generations=2,
)


def test_a_search_that_was_stopped_goes_on_and_its_middle_is_what_was_written(tmp_path: Path):
    told = polish(replace(CONFIG, out=tmp_path / "whole"), quiet=True)
    assert [row["iteration"] for row in told] == [1, 2]
    assert told[-1]["episodes"] == 2 * 5 and np.isfinite(float(told[-1]["middle"] or np.nan))
    for row, read in zip(told, read_progress(tmp_path / "whole"), strict=True):
        assert read == pytest.approx(row)
    written = load_policy(tmp_path / "whole" / "policy.safetensors", "long_jump")
    own = load_policy("pretrained", "long_jump")
    assert written.metadata["polish"]["of"] == own.metadata["sha256"]
    moved = (weights_of(written)["head.bias"] - weights_of(own)["head.bias"]).abs()
    assert 0.0 < float(moved.max()) < 0.1
    same = weights_of(own)["trunk.0.weight"]
    torch.testing.assert_close(weights_of(written)["trunk.0.weight"], same, atol=1e-4, rtol=2e-3)

    played_in = {"engine": "mujoco", "start_noise": 0.02, "timestep_divisor": 1}
    assert written.metadata["polish"]["stages"] == [{"episodes": 2 * 5, "worlds": played_in}]
    assert curves.main([str(tmp_path / "whole"), str(tmp_path / "curve.json")]) == 0
    curve = json.loads((tmp_path / "curve.json").read_text())
    digits = f".{curves.DIGITS}g"
    assert curve["rows"]["middle"] == [float(format(row["middle"], digits)) for row in told]
    assert curve["commit"] == written.metadata["polish"]["commit"]
    assert curve["config"]["of"] == own.metadata["sha256"]

    parts = replace(CONFIG, out=tmp_path / "parts")
    polish(replace(parts, generations=1), quiet=True)
    assert [row["iteration"] for row in polish(parts, quiet=True)] == [2]
    assert polish(parts, quiet=True) == []  # nothing left to do
    kept = read_progress(tmp_path / "parts")
    assert [row["iteration"] for row in kept] == [1, 2]
    assert kept[0]["samples"] == told[0]["samples"]
    for name in ("samples", "minutes"):
        assert float(kept[1][name] or 0) > float(kept[0][name] or 0) > 0, name
    again = load_policy(parts.out / "policy.safetensors", "long_jump").metadata["polish"]
    assert again["stages"] == written.metadata["polish"]["stages"]
    elsewhere = replace(parts, generations=3, episodes=2, felt_damping=True)
    assert polish(elsewhere, quiet=True)[0]["episodes"] == 10 + 10
    on = load_policy(parts.out / "policy.safetensors", "long_jump").metadata["polish"]
    felt = {"episodes": 10, "worlds": {**played_in, "felt_damping": True}}
    assert (on["episodes"], on["stages"]) == (20, [*again["stages"], felt])
    with pytest.raises(ValueError, match="another search"):
        polish(replace(parts, shift=0.1))


def test_mistakes_are_told_before_anything_is_played(tmp_path: Path):
    for change, said in (
        ({"generations": None}, "generations or minutes"),
        ({"components": -1}, "nothing to search"),
        ({"candidates": 2}, "at least 4"),
        ({"share": 0.0}, "positive"),
        ({"start_noise": -0.1}, "noise"),
        ({"part": (0.8, 0.2)}, "two shares"),
        ({"part": (0.8, 0.9), "components": 0}, "--components of 1"),
        ({"begin": (0.8, 1.2)}, "begin between two shares"),
        ({"begin": (0.1, 0.2), "worst": 0.0}, "share of the episodes, not 0.0"),
        ({"worst": 0.1}, "say where it begins"),
        ({"variation": Variation(uneven=0.1)}, "--vary as well"),
        ({"vary": True, "engine": "drake"}, "drake has worlds of its own"),
        ({"joints": ("R_*",), "components": -1, "others": ("zero",)}, "--joints"),
    ):
        with pytest.raises(ValueError, match=said):
            replace(CONFIG, **change)
    with pytest.raises(PolicyError, match="baseline"):
        polish(replace(CONFIG, policy="zero", out=tmp_path))
    with pytest.raises(PolicyError, match="not of 'long_jump'"):
        polish(replace(CONFIG, policy=shipped("high_jump"), out=tmp_path))
    with pytest.raises(ValueError, match="no joint is called 'Tail_x'; there are L_Hip_x"):
        polish(replace(CONFIG, joints=("R_Hip_*", "Tail_x"), out=tmp_path))
    with pytest.raises(ValueError, match="in latents"):
        through = {"name": "hurdling", "policy": "pretrained:latent", "objective": "success=1"}
        polish(replace(CONFIG, joints=("R_*",), out=tmp_path, **through))
    assert not list(tmp_path.iterdir())


VARIED = replace(
    CONFIG,
    joints=("R_Shoulder_*", "Torso_y"),
    episodes=3,
    generations=1,
    vary=True,
    timestep_divisor=2,
    variation=Variation(own_share=0.4, felt_share=0.5),
)


def test_candidates_meet_the_same_starts_in_the_same_worlds(monkeypatch: pytest.MonkeyPatch):
    class Seen(Exception):
        pass

    def look(policy: Policy, share: Share, env: Env) -> torch.Tensor:
        shown = [env.reset()]
        generator = torch.Generator().manual_seed(0)
        for _ in range(12):  # as long as nobody falls
            action = 0.3 * torch.randn(1, 3, 1, env.action_size, generator=generator)
            shown.append(env.step(action.expand(5, -1, -1, -1).flatten(0, 1)).obs)
        for obs in shown:
            blocks = obs.view(5, 3, -1)
            assert torch.equal(blocks, blocks[:1].expand(5, -1, -1))
        first, last = shown[0][:3, 0], shown[-1][:3, 0]
        assert (first[1:] - first[0]).abs().amax(1).min() > 1e-3  # one's starts differ
        assert (last[1:] - last[0]).abs().amax(1).min() > 0.1
        raise Seen

    monkeypatch.setattr("rl.polish.watched", look)
    with pytest.raises(Seen):
        polish(VARIED, quiet=True)


def test_joints_that_are_not_named_keep_their_actions(tmp_path: Path):
    polish(replace(VARIED, out=tmp_path, shift=0.05), quiet=True)
    own = weights_of(load_policy("pretrained", "long_jump"))["head.bias"]
    new = weights_of(load_policy(tmp_path / "policy.safetensors", "long_jump"))["head.bias"]
    names = [dof.name for dof in load_body("smpl").dofs]
    moved = {name for name, x in zip(names, (new - own).abs(), strict=True) if x > 2e-3}
    assert moved and moved <= {"R_Shoulder_x", "R_Shoulder_y", "R_Shoulder_z", "Torso_y"}


def shipped(task: str, name: str = "ppo") -> str:
    """File of a shipped policy."""
    path = pretrained.locate(task, name)
    assert json.loads(path.with_suffix(".json").read_text())["task"] == task
    return str(path)


def test_with_own_worlds_half_of_what_counts_is_what_it_is_without_others(tmp_path: Path):
    """Along a direction that no engine has to be asked for, the candidates of one generation are
    the same in three searches."""
    ways = {"others": ("pretrained:ppo-human",), "components": -1, "generations": 1, "share": 0.05}
    plain = replace(CONFIG, episodes=2, objective="length=1", **ways)
    like = replace(plain, like_drake=True, timestep_divisor=2)
    both = replace(like, own_worlds=True)
    own, others, two = (
        polish(replace(config, out=tmp_path / name), quiet=True)[0]
        for name, config in (("plain", plain), ("like", like), ("both", both))
    )
    assert own["metrics/length"] != others["metrics/length"]
    for name in ("length", "flight_time"):
        assert two[f"own/{name}"] == own[f"metrics/{name}"]
        assert two[f"others/{name}"] == others[f"metrics/{name}"]
        mean = (float(own[f"metrics/{name}"]) + float(others[f"metrics/{name}"])) / 2  # type: ignore[arg-type]
        assert two[f"metrics/{name}"] == pytest.approx(mean)
    for name in ("middle", "candidates"):
        assert two[name] == pytest.approx((float(own[name]) + float(others[name])) / 2)  # type: ignore[arg-type]
    for name in ("samples", "episodes"):
        assert two[name] == own[name] + others[name]  # type: ignore[operator]
    assert read_progress(tmp_path / "both")[0] == pytest.approx(two)
    card = load_policy(tmp_path / "both" / "policy.safetensors", "long_jump").metadata["polish"]
    [stage] = card["stages"]
    assert stage["worlds"]["own_worlds"] and stage["worlds"]["like_drake"]
    assert stage["episodes"] == card["episodes"] == 2 * 2 * 5
    # Others are told by their weights, wherever they lie.
    other = shipped("long_jump", "ppo-human")
    assert card["others"] == [load_policy(other, "long_jump").metadata["sha256"]]
    on = replace(plain, out=tmp_path / "plain", generations=2)
    with pytest.raises(ValueError, match="another search"):
        polish(replace(on, others=(str(tmp_path / "both" / "policy.safetensors"),)))
    assert len(polish(replace(on, others=(other,)), quiet=True)) == 1
    with pytest.raises(ValueError, match="no worlds but the task's own"):
        replace(plain, own_worlds=True)


two_gpus = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")


@pytest.mark.parametrize("engine", ["mujoco", pytest.param("warp", marks=two_gpus)])
def test_processes_share_a_search_each_from_starts_of_its_own(tmp_path: Path, engine: str):
    """The middle of the first generation is the policy itself, whose worth two searches of one
    process each tell of the same starts; the second generation comes of what both have seen."""
    told = replace(CONFIG, episodes=2, components=-1, others=("pretrained:ppo-human",))
    told = replace(told, engine=engine)  # type: ignore[arg-type]
    alone = [
        polish(replace(told, seed=seed, generations=1, out=tmp_path / str(seed)), quiet=True)[0]
        for seed in (0, RANK_STEP)
    ]
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    launch += ["--local-addr", "127.0.0.1", "--nproc-per-node"]
    words = ["2", "-m", "olympics_opt", "polish", "long_jump", "--policy", "pretrained"]
    words += [
        "--engine",
        engine,
        "--objective",
        CONFIG.objective,
        "--components",
        "1",
        "--shift",
        str(CONFIG.shift),
    ]
    words += ["--candidates", "4", "--episodes", "2", "--generations", "2"]
    words += ["--others", "pretrained:ppo-human", "--out", str(tmp_path / "two")]
    done = subprocess.run([*launch, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.count("wrote ") == 1, "the first process tells"
    rows = read_progress(tmp_path / "two")
    assert [row["iteration"] for row in rows] == [1, 2]
    assert [row["episodes"] for row in rows] == [2 * 2 * 5, 2 * 2 * 2 * 5]
    worths = [float(row["middle"] or np.nan) for row in alone]
    assert worths[0] != worths[1] and rows[0]["middle"] == pytest.approx(np.mean(worths))
    card = load_policy(tmp_path / "two" / "policy.safetensors", "long_jump").metadata
    assert [stage["worlds"]["processes"] for stage in card["polish"]["stages"]] == [2]
