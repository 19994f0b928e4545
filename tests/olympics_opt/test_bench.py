"""The benchmark measures what it says: steps by the engine's own clock, time by ours."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from olympics_opt import bench
from olympics_opt.meter import Meter, measure, summary
from olympics_opt.soak import soak, soak_shared
from rl.checkpoint import checkpoints
from rl.ppo import PPOConfig
from sports.env import Env, make_env
from sports.humanoid.mjcf import build_model

SMALL = PPOConfig(hidden=(16,), steps=6, minibatches=2, epochs=1)


@pytest.fixture
def meter():
    env = make_env("high_jump", num_worlds=4, seed=3, physics_options={"threads": 2})
    ticks = itertools.count()
    # A clock that advances one second between two looks: a block takes exactly one.
    yield Meter(env, steps=12, hyper=SMALL, clock=lambda: float(next(ticks)))
    env.close()


def test_bare_physics_and_environment_take_the_same_steps(meter: Meter) -> None:
    """Both go as far as they report, bare physics each time from a state of the environment."""
    env, bare = meter.env, meter._bare
    period = env.physics.scene.control_timestep
    time, qpos = bare.batch.bind("time"), bare.batch.bind("qpos")
    stepped, env_step = bare.step, env.step
    taken, steps = 0.0, 0
    went: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # before, after, not ended

    def counted_env(action: torch.Tensor):
        before, clock = env.physics.extra_state()["qpos"].numpy(), env.view.clock.clone()
        result = env_step(action)
        ended = result.ended | ~result.valid
        assert (env.view.clock == torch.where(ended, 0, clock + 1)).all()
        went.append((before, env.physics.extra_state()["qpos"].numpy(), ~ended.numpy()))
        return result

    def counted(targets: torch.Tensor) -> None:
        nonlocal taken, steps
        before, after, goes_on = went[steps]
        steps += 1
        clock = time.copy()
        np.testing.assert_array_equal(qpos, before)
        stepped(targets)
        taken += float((time - clock).sum())
        # Without contacts that differ and momentum that drifts both have gone the same way.
        assert np.abs(qpos - after)[goes_on].max() < 0.05

    bare.step, env.step = counted, counted_env
    rates = meter.pair()
    # 12 blocks of one control step, one second of our clock each.
    assert rates == {"bare_physics": pytest.approx(4), "environment": pytest.approx(4)}
    assert taken == pytest.approx(4 * 12 * period) and steps == len(went) == 12
    np.testing.assert_array_equal(went[-1][1], env.physics.extra_state()["qpos"].numpy())


def plain_mujoco(physics, qpos, qvel, controls: torch.Tensor) -> torch.Tensor:
    """(N, nq) after one control step of ``mj_step`` in a loop, without this project's engines."""
    model, rows = build_model(physics.scene), []
    data = mujoco.MjData(model)
    for world, control in enumerate(controls.numpy()):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[world], qvel[world], control
        for k, o in enumerate(physics.scene.mocap_objects):
            data.mocap_pos[model.body(o.name).mocapid[0]] = physics.mocap_pos[world, k]
        for _ in range(physics.scene.substeps):
            mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    return torch.from_numpy(np.array(rows)).float()


def test_bare_physics_is_mujoco_and_nothing_else(meter: Meter) -> None:
    """The benchmark's yardstick leads where ``mj_step`` leads, on the environment's own model."""
    env, bare = meter.env, meter._bare
    assert bare.batch.nthread == env.physics.threads == 2
    state, controls = env.physics.extra_state(), meter._controls[0]
    want = plain_mujoco(env.physics, state["qpos"], state["qvel"], controls)
    bare.load(bare.save())
    bare.step(controls)
    got = torch.from_numpy(bare.batch.bind("qpos").copy()).float()
    assert torch.allclose(got, want, atol=1e-6)
    assert not torch.allclose(want, state["qpos"].float())
    after = env.physics.extra_state()
    for name, value in state.items():
        torch.testing.assert_close(after[name], value, rtol=0, atol=0, equal_nan=True)


def test_training_counts_its_samples(meter: Meter) -> None:
    env = meter.env
    steps = 0
    step = env.step

    def counted(action: torch.Tensor):
        nonlocal steps
        steps += 1
        return step(action)

    env.step = counted
    weights = meter.agent.actor.head.weight.detach().clone()
    assert meter.training() == {"training": pytest.approx(4 * 6)}
    assert steps == 6
    meter.training()
    assert not torch.equal(weights, meter.agent.actor.head.weight)


def test_shares_are_taken_within_a_turn() -> None:
    # The machine slows down tenfold in the second turn; the ratio does not care.
    turns = [
        {"bare_physics": 1000.0, "environment": 900.0, "training": 800.0},
        {"bare_physics": 100.0, "environment": 90.0},
        {"bare_physics": 1000.0, "environment": 910.0, "training": 780.0},
    ]
    row = summary(turns)
    assert row["environment_share"] == pytest.approx(0.9)
    assert row["training_share"] == pytest.approx(0.79)
    assert row["spread"]["bare_physics"] == [100.0, 1000.0]
    assert summary([t for t in turns if "training" not in t])["training"] is None


def test_file_holds_rows_and_where_they_come_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "bench.json"
    status = bench.main(
        ["--out", str(out), "--task", "long_jump", "--worlds", "2", "--seconds", "0.01"]
        + ["--engine", "mujoco", "--no-training", "--turn-steps", "2"]
    )
    assert status == 0
    result = json.loads(out.read_text())
    assert result["steps_per_turn"] == 2
    assert {"commit", "versions", "hardware", "seed", "rows"} <= set(result)
    (row,) = result["rows"]
    assert row["task"] == "long_jump" and row["worlds"] == 2 and row["training"] is None
    assert row["turns"] >= 3 and row["environment"] > 0
    assert "long_jump" in capsys.readouterr().out


def test_mistakes_get_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown task"):
        bench.bench(tmp_path / "b.json", tasks=("swimming",))
    with pytest.raises(ValueError, match="seconds"):
        bench.bench(tmp_path / "b.json", seconds=0)
    with pytest.raises(ValueError, match="one control step"):
        bench.bench(tmp_path / "b.json", tasks=("long_jump",), worlds=(1,), turn_steps=0)
    if not torch.cuda.is_available():
        with pytest.raises(RuntimeError, match="GPU"):
            measure("long_jump", "warp", worlds=1)
    assert not list(tmp_path.iterdir())


def test_bare_warp_is_mujoco() -> None:
    """Warp's CPU device: the benchmark's substeps lead where ``mj_step`` leads."""
    pytest.importorskip("mujoco_warp")
    env = make_env("long_jump", engine="warp", num_worlds=2, physics_options={"device": "cpu"})
    try:
        meter = Meter(env, training=False, steps=2)
        qpos, qvel = env.physics.qpos.clone(), env.physics.qvel.clone()
        env.load_state_dict(env.state_dict())  # making the meter has stepped the engine
        want = plain_mujoco(env.physics, qpos, qvel, meter._controls[0])
        before = env.state_dict()
        meter._bare.step(meter._controls[0])
        assert torch.allclose(env.physics.qpos, want, atol=1e-5)
        assert not torch.allclose(want, qpos, atol=1e-3)
        meter._bare.load(before)
        for name, value in env.state_dict().items():
            torch.testing.assert_close(value, before[name], rtol=0, atol=0, equal_nan=True)
    finally:
        env.close()


def test_an_endurance_run_in_two_goes_is_the_same_as_in_one(tmp_path: Path) -> None:
    whole = soak("long_jump", "mujoco", worlds=3, steps=90)
    keep = tmp_path / "worlds"
    first = soak("long_jump", "mujoco", worlds=3, steps=50, keep=keep)
    both = soak("long_jump", "mujoco", worlds=3, steps=90, keep=keep)
    assert first.steps == 50 and first.episodes < both.episodes
    for name in ("steps", "episodes", "largest_observation", "largest_reward", "nan_worlds"):
        assert getattr(both, name) == getattr(whole, name), name
    assert soak("long_jump", "mujoco", worlds=3, steps=90, keep=keep).episodes == both.episodes
    with pytest.raises(ValueError, match="another endurance run"):
        soak("long_jump", "mujoco", worlds=3, steps=90, seed=1, keep=keep)
    short = soak("long_jump", "mujoco", worlds=3, steps=10_000, minutes=1e-6)
    assert short.steps == 100  # looked at each hundredth
    with pytest.raises(ValueError, match="minutes"):
        soak("long_jump", "mujoco", worlds=3, minutes=0.0)


def test_an_endurance_run_that_is_killed_has_kept_its_worlds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step of every world is said to diverge, so that what is counted twice shows."""
    step = Env.step

    def diverging(env: Env, action: torch.Tensor):
        result = step(env, action)
        env.physics.nan_worlds += 1
        if kills and env.physics.nan_worlds == 70:
            raise KeyboardInterrupt
        return result

    monkeypatch.setattr(Env, "step", diverging)
    kills = False
    whole = soak("long_jump", "mujoco", worlds=3, steps=100)
    monkeypatch.setattr("olympics_opt.soak.KEPT_MINUTES", 1e-9)  # after each hundredth
    kills, keep = True, tmp_path / "worlds"
    with pytest.raises(KeyboardInterrupt):
        soak("long_jump", "mujoco", worlds=3, steps=100, keep=keep)
    assert [path.name for path in checkpoints(keep)] == ["step_0000068", "step_0000069"]
    kills = False
    both = soak("long_jump", "mujoco", worlds=3, steps=100, keep=keep)
    assert both.nan_worlds == whole.nan_worlds == 100
    for name in ("episodes", "largest_observation", "largest_reward"):
        assert getattr(both, name) == getattr(whole, name), name


def test_an_endurance_run_shared_out_is_the_sum_of_its_shares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []
    common = {"worlds": 5, "processes": 2, "steps": 90, "seed": 3, "on_step": seen.append}
    monkeypatch.setattr("olympics_opt.soak.LOOK_SECONDS", 0.01)
    shared = soak_shared("long_jump", "mujoco", **common)
    assert seen == sorted(seen) and any(0 < step < 90 for step in seen)
    shares = [
        soak("long_jump", "mujoco", worlds=3, steps=90, seed=3),
        soak("long_jump", "mujoco", worlds=2, steps=90, seed=4),
    ]
    assert (shared.worlds, shared.processes, shared.steps) == (5, 2, 90)
    assert shared.episodes == sum(each.episodes for each in shares) > 5
    for name in ("largest_observation", "largest_reward"):
        assert getattr(shared, name) == max(getattr(each, name) for each in shares), name
    assert shared.clean and shared.device_memory_gib is None
    two = {"worlds": 5, "processes": 2, "seed": 3, "keep": tmp_path / "worlds"}
    assert soak_shared("long_jump", "mujoco", steps=50, **two).steps == 50
    assert soak_shared("long_jump", "mujoco", steps=90, **two).episodes == shared.episodes
    with pytest.raises(ValueError, match="the shares of 2 processes, not of 3"):
        soak_shared("long_jump", "mujoco", **{**two, "processes": 3})
    for count in (0, 6):
        with pytest.raises(ValueError, match="cannot be shared out"):
            soak_shared("long_jump", "mujoco", worlds=5, processes=count)


def test_shares_played_one_after_another_are_those_played_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    apart = [
        soak("long_jump", "mujoco", worlds=3, steps=40, seed=3),
        soak("long_jump", "mujoco", worlds=2, steps=40, seed=4),
    ]
    keep, out = tmp_path / "worlds", tmp_path / "soak.json"
    words = ["--soak", "--task", "long_jump", "--engine", "mujoco", "--worlds", "5", "--steps"]
    words += ["40", "--seed", "3", "--processes", "2", "--out", str(out), "--keep", str(keep)]
    assert bench.main([*words, "--shares", "1"]) == 0
    assert not out.exists() and "until all of 0 to 1" in " ".join(capsys.readouterr().out.split())
    assert bench.main([*words, "--shares", "0"]) == 0
    (row,) = json.loads(out.read_text())["soak"]
    assert (row["worlds"], row["processes"], row["steps"]) == (5, 2, 40)
    assert row["episodes"] == sum(each.episodes for each in apart) > 0
    for name in ("largest_observation", "largest_reward"):
        assert row[name] == max(getattr(each, name) for each in apart), name
    kept = {"worlds": 5, "seed": 3, "keep": keep / "long_jump_mujoco_5", "shares": (0,)}
    with pytest.raises(ValueError, match="the shares of 2 processes, not of 3"):
        soak_shared("long_jump", "mujoco", processes=3, **kept)
    with pytest.raises(ValueError, match="share_1_of_2' keeps another endurance run"):
        soak_shared("long_jump", "mujoco", processes=2, **(kept | {"seed": 4}))  # at once
    with pytest.raises(ValueError, match="must be kept"):
        soak_shared("long_jump", "mujoco", processes=2, **(kept | {"keep": None}))
    with pytest.raises(ValueError, match="are 0 to 1, not"):
        soak_shared("long_jump", "mujoco", processes=2, **(kept | {"shares": (2,)}))


def test_a_soak_counts_what_goes_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A task that gives NaN in one of its features now and then, and a reward that is infinite."""
    from sports import long_jump, registry

    def features(view, memory):
        found = long_jump.features(view, memory)
        late = (view.clock == 3)[:, None, None]
        return found | {"goal": found["goal"].masked_fill(late, float("nan"))}

    def advance(view, memory):
        step = long_jump.advance(view, memory)
        late = (view.clock == 5)[:, None]
        step.terms["speed"] = step.terms["speed"].masked_fill(late, float("inf"))
        return step

    broken = replace(long_jump.TASK, name="broken", features=features, advance=advance)
    monkeypatch.setitem(registry._TASKS, "broken", broken)
    found = soak("broken", "mujoco", worlds=3, steps=6)
    assert found.bad_observations == 3 * 3 and found.bad_rewards == 3 and not found.clean
    out = tmp_path / "soak.json"
    common = ["--soak", "--out", str(out), "--worlds", "2", "--steps", "40"]
    assert bench.main([*common, "--task", "broken"]) == 0
    assert bench.main([*common, "--task", "long_jump", "high_jump"]) == 0
    rows = {row["task"]: row for row in json.loads(out.read_text())["soak"]}
    assert list(rows) == ["broken", "long_jump", "high_jump"]
    assert not rows["broken"]["clean"] and rows["high_jump"]["clean"]
    assert rows["high_jump"]["episodes"] >= 2 and rows["high_jump"]["commit"]
    with pytest.raises(ValueError, match="must be positive"):
        soak("long_jump", "mujoco", worlds=0)
