"""Evaluation: intervals against their definitions, fair counting, recordings, the schema."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from rl.evaluate import EvaluationResult, evaluate, interval
from rl.kept_shares import forget
from rl.policy import load_policy
from rl.recording import Recording
from rl.trials import Share, opened, play_share, ranked
from sports.env import make_env
from sports.registry import get_task

SCHEMA = [
    "task",
    "algo",
    "policy_sha256",
    "engine",
    "strength",
    "limits",
    "trials",
    "seed",
    "commit",
    "versions",
    "hardware",
    "metrics",
    "overflow",
    "nan_worlds",
]


@given(st.integers(1, 500), st.data())
def test_wilson_interval_is_scipys(n, data):
    k = data.draw(st.integers(0, n))
    values = np.array([1.0] * k + [0.0] * (n - k) + [np.nan] * 3)
    ours = interval(values, "fraction")
    theirs = stats.binomtest(k, n).proportion_ci(0.95, method="wilson")
    assert (ours["n"], ours["mean"]) == (n, pytest.approx(k / n))
    np.testing.assert_allclose(ours["ci95"], [theirs.low, theirs.high], atol=1e-9)


def test_mean_interval_is_the_textbooks_and_covers():
    ours = interval(np.array([1.0, 2.0, 4.0, np.nan]), "m")
    low, high = stats.t.interval(0.95, 2, loc=7 / 3, scale=stats.sem([1.0, 2.0, 4.0]))
    np.testing.assert_allclose(ours["ci95"], [low, high])
    assert (ours["n"], ours["unit"]) == (3, "m")
    rng = np.random.default_rng(0)
    ends = np.array([interval(rng.normal(5, 2, 8), "m")["ci95"] for _ in range(2000)])
    assert np.mean((ends[:, 0] < 5) & (ends[:, 1] > 5)) == pytest.approx(0.95, abs=0.015)


def test_undefined_metrics_have_no_figures():
    assert interval(np.full(4, np.nan), "m") == {"mean": None, "ci95": None, "n": 0, "unit": "m"}
    assert interval(np.array([2.0]), "m")["ci95"] is None


@pytest.fixture(scope="module")
def played() -> EvaluationResult:
    seen = []
    result = evaluate(
        "random",
        "high_jump",
        trials=23,
        num_worlds=6,
        seed=4,
        record=1,
        record_worlds=(2,),
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen[-1] == (23, 23)
    assert seen == sorted(seen)
    return result


def test_result_has_the_schema_and_is_json(played):
    result = json.loads(json.dumps(played.result, allow_nan=False))
    assert set(SCHEMA) <= set(result)
    task = get_task("high_jump")
    assert set(result["metrics"]) == set(task.metrics)
    for name, metric in result["metrics"].items():
        assert set(metric) == {"mean", "ci95", "n", "unit"}
        assert metric["unit"] == task.metrics[name]
        defined = played.trials[name][~np.isnan(played.trials[name])]
        assert metric["n"] == len(defined)
        if len(defined):
            assert metric["mean"] == pytest.approx(defined.mean())
    assert all(len(x) == 23 for x in played.trials.values())


def test_trials_under_way_are_told_of_too(monkeypatch):
    monkeypatch.setattr(sys.modules["rl.trials"], "REPORT_STEPS", 1)
    told = []
    played = evaluate(
        "zero",
        "high_jump",
        trials=6,
        num_worlds=3,
        seed=1,
        progress=lambda done, total: told.append(done),
    )
    steps, longest = played.trials["episode_steps"].reshape(2, 3), get_task("high_jump").max_steps
    assert told[0] == 0 and told[-1] == 6 and told == sorted(told)
    # After k steps: each world's first trial is done, or has come to k steps.
    for k in range(1, int(steps[0].min())):
        assert told[k] == pytest.approx(3 * k / longest)


def test_every_world_counts_as_often_as_another(played):
    """23 trials of 6 worlds: 4 each, the last world's last left out, and both bars in turn."""
    heights = played.trials["bar_height"]
    np.testing.assert_allclose(heights, np.resize([1.0, 1.5], 23))


def test_trials_that_come_to_the_same_are_ranked_by_their_error_then_by_return():
    nan = float("nan")
    values = {
        get_task("golf").main_metric: np.array((1.0, 1.0, 0.0, 1.0, nan)),
        "error": np.array((7.0, 0.5, nan, 0.5, nan)),
        "return": np.array((9.0, 1.0, 5.0, 2.0, 0.0)),
    }
    assert ranked("golf", values, range(5)) == [4, 2, 0, 1, 3]
    jumps = {"success": np.array((1.0, 0.0, 1.0)), "return": np.array((2.0, 3.0, 1.0))}
    jumps[get_task("long_jump").main_metric] = jumps["success"]
    assert ranked("long_jump", jumps, (0, 1, 2)) == [1, 2, 0]


def test_trials_differ_but_a_seed_repeats_them(played):
    again = evaluate("random", "high_jump", trials=23, num_worlds=6, seed=4)
    other = evaluate("random", "high_jump", trials=23, num_worlds=6, seed=5)
    np.testing.assert_array_equal(again.trials["return"], played.trials["return"])
    assert len(np.unique(played.trials["return"])) > 20
    assert (other.trials["return"] != played.trials["return"]).mean() > 0.9
    assert again.recordings == {}
    zero = evaluate("zero", "high_jump", trials=6, num_worlds=6, seed=4)
    assert len(np.unique(zero.trials["return"])) == 6  # by the start noise alone


def test_no_two_trials_begin_alike():
    """A thousand starts drawn out of 4096, as they once were, are 887 different ones."""
    noise, worlds = 0.02, 1000
    share = Share("free_throw", "mujoco", worlds, worlds, 0, "human", "paper", {})
    with opened(load_policy("zero", "free_throw"), share) as env:
        scene = env.physics.scene
        assert env.starts is not None
        env.starts.blocks = 2
        begun = []
        for _ in range(2):
            env.reset()
            begun.append(env.physics.qpos[:, scene.agent_qpos(0)].clone())
        rest = torch.tensor(scene.default_qpos()[scene.agent_qpos(0)], dtype=torch.float32)
    for rows in begun:
        assert torch.equal(rows[:500], rows[500:])
    joints = torch.cat([rows[:500, 7:] for rows in begun]) - rest[7:]
    assert torch.equal(begun[0][:, :7], rest[:7].expand(worlds, 7))
    assert len(joints.unique(dim=0)) == 1000
    loose = torch.tensor([dof.name not in scene.steady for dof in scene.body.dofs])
    assert 0 < loose.sum() < len(loose) and (joints[:, ~loose] == 0.0).all()
    drawn = joints[:, loose].double().flatten().numpy() / (2 * noise) + 0.5
    assert stats.kstest(drawn, "uniform").pvalue > 1e-4


def test_every_athlete_begins_anew():
    share = Share("boxing", "mujoco", 60, 60, 0, "human", "paper", {})
    with opened(load_policy("zero", "boxing"), share) as env:
        env.reset()
        scene = env.physics.scene
        at = [env.physics.qpos[:, scene.agent_qpos(agent)][:, 7:] for agent in range(2)]
        both = torch.stack([q - q.mean(0) for q in at])
    assert ((both.abs().amax(1) > 0.01) & (both.abs().amax(1) < 0.03)).all()
    assert float((both[0] * both[1]).mean() / both.square().mean()) < 0.05


def test_recordings_are_the_episodes_they_name(played):
    returns = played.trials["return"]
    order = np.argsort(returns)  # no trial succeeds, so the return decides
    for name, trial in (("best", order[-1]), ("median", order[len(order) // 2]), ("world_2", 2)):
        recording = played.recordings[name]
        assert recording.world == trial % 6
        assert len(recording.qpos) == played.trials["episode_steps"][trial]
        assert recording.reward.sum() == pytest.approx(returns[trial], abs=1e-4)
        np.testing.assert_allclose(sum(recording.terms.values()), recording.reward, atol=1e-5)
        assert recording.metrics["bar_height"] == pytest.approx(1.0 if trial % 2 == 0 else 1.5)


def test_a_recording_replays_in_the_engine(played):
    """From each recorded state, the recorded action leads to the next recorded state."""
    recording = played.recordings["world_2"]
    steps = len(recording.qpos) - 1
    env = make_env("high_jump", num_worlds=steps, training=False)
    env.reset()
    from sports.physics.base import PhysicsState

    def rows(x: np.ndarray) -> torch.Tensor:
        return torch.tensor(x[:-1])

    state = PhysicsState(rows(recording.qpos), rows(recording.qvel), rows(recording.mocap_pos))
    env.physics.reset(torch.ones(steps, dtype=torch.bool), state)
    action = torch.tensor(recording.action[1:])[:, 0].clamp(-1, 1) * env.action_scale
    env.physics.step(action)
    # float32 states and a solver started cold: not bit for bit
    error = (env.physics.qpos - torch.tensor(recording.qpos[1:])).abs().amax(-1)
    assert error.median() < 1e-3
    env.close()


def test_recording_round_trip_and_scene(played, tmp_path):
    played.best.save(tmp_path / "a" / "best.npz")
    loaded = Recording.load(tmp_path / "a" / "best.npz")
    for name, value in vars(played.best).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(loaded, name), value)
    assert loaded.terms.keys() == played.best.terms.keys()
    assert loaded.scene.nq == loaded.qpos.shape[1]
    assert loaded.scene.control_timestep == pytest.approx(loaded.dt)
    np.testing.assert_equal(loaded.metrics, played.best.metrics)


@given(st.binary(max_size=300), st.booleans())
def test_what_is_no_recording_is_refused(played, tmp_path_factory, content, cut):
    path = tmp_path_factory.mktemp("rec") / "x.npz"
    played.best.save(path)
    path.write_bytes(path.read_bytes()[: len(content) * 40] if cut else content)
    with pytest.raises(ValueError, match="not a recording"):
        Recording.load(path)


def test_half_the_time_step_and_options_reach_the_engine():
    result = evaluate(
        "zero", "high_jump", trials=2, timestep_divisor=2, options={"bar_height": 1.2}
    )
    assert result.result["timestep"] == pytest.approx(1 / 240)
    assert result.result["substeps"] == 8
    np.testing.assert_allclose(result.trials["bar_height"], 1.2)


def test_a_tasks_own_metrics_are_not_hidden():
    """Long jump has a metric "length" (m), undefined where nobody jumped."""
    result = evaluate("zero", "long_jump", trials=3)
    assert np.isnan(result.trials["length"]).all()
    assert (result.trials["episode_steps"] > 0).all()
    assert result.result["metrics"]["length"] == {"mean": None, "ci95": None, "n": 0, "unit": "m"}


def test_mistakes_are_sentences():
    with pytest.raises(ValueError, match="unknown task"):
        evaluate("zero", "chess")
    with pytest.raises(ValueError, match="no option 'height'"):
        evaluate("zero", "high_jump", options={"height": 1})
    with pytest.raises(ValueError, match="trials"):
        evaluate("zero", "high_jump", trials=0)
    with pytest.raises(ValueError, match="process"):
        evaluate("zero", "high_jump", engine="drake", trials=4, processes=0)
    with pytest.raises(ValueError, match="engine"):
        evaluate("zero", "high_jump", engine="bullet", trials=1)


def test_a_recording_keeps_what_its_task_shows(tmp_path):
    """Golf's target and waves: those of the episode, also after the world has begun another."""
    played = evaluate("zero", "golf", trials=2, num_worlds=2, seed=4, record=1)
    first, second = played.recordings["best"], played.recordings["median"]
    for recording in (first, second):
        steps = len(recording.qpos)
        assert recording.shown["target"].shape == (steps, 3)
        assert recording.shown["phases"].shape == (steps, 2)
        for table in recording.shown.values():
            assert (table == table[0]).all()  # golf's do not change in an episode
        assert 0.0 <= recording.shown["target"][0, 0] <= 20.0
        recording.save(tmp_path / "golf.npz")
        loaded = Recording.load(tmp_path / "golf.npz")
        assert set(loaded.shown) == {"target", "phases"}
        for name, table in recording.shown.items():
            np.testing.assert_array_equal(loaded.shown[name], table)
    if first.world != second.world:
        assert (first.shown["phases"][0] != second.shown["phases"][0]).all()


@pytest.fixture(scope="module")
def drake_trials():
    """Six trials in Drake, two processes: three shares of two worlds."""
    pytest.importorskip("pydrake")
    done = []
    played = evaluate(
        "zero",
        "high_jump",
        engine="drake",
        trials=6,
        processes=2,
        record=1,
        progress=lambda n, total: done.append((n, total)),
    )
    assert done == sorted(done) and done[0] == (0, 6) and done[-1] == (6, 6)
    return played


def test_drake_trials_in_processes(drake_trials):
    result = drake_trials
    assert result.result["metrics"]["success"]["n"] == 6
    np.testing.assert_allclose(result.trials["bar_height"], [1.0, 1.5] * 3)
    assert len(result.median.qpos) in result.trials["episode_steps"]
    assert result.result["timestep"] == pytest.approx(1 / 480)  # Drake's own, not the task's
    assert result.result["timestep"] * result.result["substeps"] == pytest.approx(1 / 30)
    # standing at PD target zero ends by the stall rule at the same step in both engines
    mujoco = evaluate("zero", "high_jump", trials=6)
    np.testing.assert_array_equal(mujoco.trials["episode_steps"], result.trials["episode_steps"])


def test_how_many_processes_play_drake_does_not_change_its_trials(drake_trials):
    done = []
    here = evaluate(
        "zero",
        "high_jump",
        engine="drake",
        trials=6,
        processes=1,
        progress=lambda n, _: done.append(n),
    )
    returns = here.trials["return"]
    np.testing.assert_array_equal(returns, drake_trials.trials["return"])
    assert len(set(returns.tolist())) == 6  # a start of its own for each
    assert done == sorted(done) and done[-1] == 6


def test_an_evaluation_that_was_stopped_goes_on(drake_trials, tmp_path, monkeypatch):
    """Killed in its third share: two are not played again, and the result is that of one go."""
    module, play = sys.modules["rl.evaluate"], play_share
    played = []

    def counted(policy, share, report=None):
        if len(played) == 2:
            raise KeyboardInterrupt
        played.append(share.seed)
        return play(policy, share, report)

    def again(seed=0, **options):
        options = {
            "engine": "drake",
            "trials": 6,
            "processes": 1,
            "record": 1,
            "seed": seed,
        } | options
        return evaluate("zero", "high_jump", parts=tmp_path / "out.parts", **options)

    monkeypatch.setattr(module, "play_share", counted)
    with pytest.raises(KeyboardInterrupt):
        again()
    files = sorted((tmp_path / "out.parts").glob("*.npz"))
    whole_files = [path for path in files if "-" not in path.stem]
    assert len(whole_files) == 2 and len(files) == 6  # each with two episodes
    played.clear()
    done = []
    whole = again(progress=lambda n, _: done.append(n))
    assert len(played) == 1 and done[0] == 4
    for name, values in drake_trials.trials.items():
        np.testing.assert_array_equal(whole.trials[name], values, name)
    assert whole.result["metrics"] == drake_trials.result["metrics"]
    assert whole.result["substeps"] == drake_trials.result["substeps"]
    np.testing.assert_array_equal(whole.median.qpos, drake_trials.median.qpos)
    assert whole.best.metrics == pytest.approx(drake_trials.best.metrics, nan_ok=True)
    assert whole.best.meta == drake_trials.best.meta
    # Of another seed they are no part; one that was cut off is played again.
    played.clear()
    with pytest.raises(KeyboardInterrupt):
        again(seed=1)
    assert len(played) == 2
    for path in (
        whole_files[0],
        next(p for p in files if p.stem.startswith(f"{whole_files[1].stem}-")),
    ):
        path.write_bytes(path.read_bytes()[:100])
    played.clear()
    again()
    assert len(played) == 2
    (tmp_path / "out.parts" / "mine.txt").write_text("kept")
    forget(tmp_path / "out.parts")
    assert [path.name for path in (tmp_path / "out.parts").iterdir()] == ["mine.txt"]
    (tmp_path / "out.parts" / "mine.txt").unlink()
    forget(tmp_path / "out.parts")
    forget(tmp_path / "out.parts")  # nothing there is no mistake
    assert not (tmp_path / "out.parts").exists()
