"""The way to the ball: the steps by both engines' dynamics, the shipped episodes by the rules of
the task, and a kick that is aimed anew."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sports.env import Env, make_env, make_scene
from sports.penalty_kick import SPOT, START
from sports.soccer import BALL_RADIUS, HALF_LENGTH
from sports.starts import ELAPSED
from warmstart import aim, approach
from warmstart.bank import ClipBank, approach_files, demonstration_files
from warmstart.clip import Clip
from warmstart.inverse_dynamics import inverse_dynamics_drake, inverse_dynamics_mujoco
from warmstart.outcome import link_poses
from warmstart.solution import Solution

G = 9.81
NAMES = [p.stem for p in demonstration_files("penalty_kick") if "_step" not in p.stem]
"""Kicks from a stand: those to which steps are planned."""


@pytest.fixture(scope="module")
def kick() -> Clip:
    return Clip.load(next(p for p in demonstration_files("penalty_kick") if "16mps" in p.name))


@pytest.fixture(scope="module")
def steps(kick) -> Solution:
    return approach.plan(kick, detail=0.5)


def shipped(name: str) -> Clip:
    return Clip.load(next(path for path in approach_files("penalty_kick") if path.stem == name))


def metrics_of(env: Env, clip: Clip, first: int = 0) -> dict[str, float]:
    """Plays a clip's targets from one of its frames on, until the task ends the episode."""
    assert clip.ctrl is not None
    scale = env.physics.scene.body.action_scale()
    for step in range(first, env.max_steps):
        target = clip.ctrl[min(step, len(clip.ctrl) - 1)]
        action = torch.tensor((target - env.action_offset.numpy()) / scale, dtype=torch.float32)
        result = env.step(action[None, None])
        if bool(result.ended[0]):
            return {name: float(value[0]) for name, value in result.metrics.items()}
    raise AssertionError("the episode did not end")


# The steps.


def test_the_steps_lead_from_the_tasks_start_to_the_kick(kick, steps):
    """By the kinematics of the bodies: where the feet stand at both ends, and that one of them
    stands still whenever the other one moves."""
    body = steps.body
    world = make_scene("penalty_kick", strength="human").default_qpos()[None, : 7 + body.num_dofs]
    pos, _ = link_poses(body, np.concatenate([world, steps.qpos, kick.qpos[:1]]))
    feet = pos[:, [body.link_index(f"{side}_Toe") for side in "LR"]]
    ankles = pos[:2, [body.link_index(f"{side}_Ankle") for side in "LR"], :2]
    np.testing.assert_allclose(ankles[1], ankles[0], atol=approach.AT + 1e-6)
    np.testing.assert_allclose(feet[-2], feet[-1], atol=0.05)
    assert (feet[-1, :, 0] - feet[0, :, 0] > 0.25).all()
    np.testing.assert_allclose(steps.qvel[[0, -1]], 0.0, atol=1e-7)
    moved = np.linalg.norm(np.diff(feet[1:-1], axis=0), axis=2)
    assert moved.min(axis=1).max() < 1e-3
    assert np.linalg.norm(steps.qpos[0, :2] - START) < 0.05


def test_the_steps_obey_both_engines(steps):
    weight = steps.body.mass * G
    names = ("qpos", "qvel", "qacc", "contact_force")
    motion = {field: getattr(steps, field) for field in names}
    for compute in (inverse_dynamics_mujoco, inverse_dynamics_drake):
        tau = compute(steps, motion, steps.body)
        assert np.abs(tau[:, :6]).max() / weight < 1e-5
    assert (np.abs(steps.torque) / steps.body.array("effort")).max() <= 1.0
    assert steps.contact_force[..., 2].min() >= -1e-6 * weight


def test_what_is_followed_is_both_one_after_the_other(kick, steps):
    wanted = approach.reference(steps, kick)
    world = make_scene("penalty_kick", strength="human")
    np.testing.assert_array_equal(wanted.qpos[0], world.default_qpos()[world.agent_qpos(0)])
    frame = wanted.num_frames - kick.resample(wanted.fps).num_frames
    assert frame / wanted.fps == pytest.approx(steps.duration, abs=1.0 / wanted.fps)
    np.testing.assert_allclose(wanted.qpos[frame], kick.qpos[0], atol=1e-9)
    late = wanted.meta["events"]["strike"] - kick.meta["events"]["strike"]
    assert late == pytest.approx(frame / wanted.fps)


# The episodes.


@pytest.mark.parametrize("name", NAMES)
def test_an_episode_kicks_the_ball_by_the_rules_of_the_task(name):
    """Played once more in the task, from the task's own start, by nothing but its targets."""
    clip = shipped(name)
    env = make_env("penalty_kick", num_worlds=1, strength="human", training=False, seed=5)
    scene, begin = env.physics.scene, env.snapshot()["qpos"][0].double().numpy()
    np.testing.assert_allclose(clip.qpos[0], begin[scene.agent_qpos(0)], atol=1e-6)
    found = metrics_of(env, clip)
    env.close()
    assert found["touched"] == found["kicked"] == 1.0 and found["handling"] == 0.0
    for metric in ("touched", "kicked", "goal", "handling"):
        assert clip.meta["achieved"][metric] == found[metric]
    asked = clip.meta["asked"]["ball_speed"]
    assert clip.meta["achieved"]["ball_speed"] == pytest.approx(asked, rel=0.1)


def test_they_walk_there_and_score_near_their_targets():
    for clip in (shipped(name) for name in NAMES):
        achieved = clip.meta["achieved"]
        assert achieved["goal"] == 1.0
        at = achieved["ball_y"], achieved["ball_z"]
        assert np.linalg.norm(np.subtract(at, clip.meta["options"]["target"])) < 0.5
        pos, _ = link_poses(approach.body_of(clip), clip.qpos)
        body = approach.body_of(clip)
        kicked = round(clip.meta["events"]["release"] * clip.fps)
        stand = pos[kicked, body.link_index("L_Ankle")] - pos[0, body.link_index("L_Ankle")]
        assert stand[0] > 0.4 and clip.qpos[: kicked + 1, 2].min() > 0.75
        assert clip.object_qpos is not None
        still = clip.object_qpos[: kicked + 1, :3] - (*SPOT, BALL_RADIUS)
        assert np.abs(still).max() <= approach.MOVED


def test_training_starts_in_the_midst_of_them():
    """Every frame before the kick is a start, with the clock of its episode; from one in the swing
    the targets still kick the ball."""
    clip = shipped(NAMES[0])
    bank = ClipBank([clip])
    starts = bank.starts(probability=1.0)
    kicked = round(clip.meta["events"]["release"] * clip.fps)
    elapsed = starts.context[ELAPSED].numpy()
    assert elapsed.max() == pytest.approx(kicked / clip.fps, abs=1e-6)
    frame = kicked - 6
    row = int(np.argmin(np.abs(elapsed - frame / clip.fps)))
    assert starts.object_qpos is not None and starts.object_qvel is not None
    one = replace(
        starts,
        qpos=starts.qpos[[row]],
        qvel=starts.qvel[[row]],
        context={k: v[[row]] for k, v in starts.context.items()},
        object_qpos=starts.object_qpos[[row]],
        object_qvel=starts.object_qvel[[row]],
    )
    env = make_env(
        "penalty_kick", num_worlds=1, strength="human", training=False, starts=one, seed=1
    )
    found = metrics_of(env, clip, first=frame)
    env.close()
    assert found["kicked"] == 1.0


def test_where_a_ball_went_that_flew_on_a_known_path(kick):
    """Ten frames at rest, then straight on at (20, 1, 2) m/s: 12 m further it is 0.6 m aside."""
    velocity, fps = np.array([20.0, 1.0, 2.0]), 30.0
    t = np.maximum(np.arange(40) - 10, 0) / fps
    place = np.array([*SPOT, BALL_RADIUS]) + t[:, None] * velocity
    ball = np.hstack([place, np.tile([1.0, 0.0, 0.0, 0.0], (40, 1))])
    rate = np.hstack([np.where(t[:, None] > 0, velocity, 0.0), np.zeros((40, 3))])
    clip = Clip(
        fps=fps,
        body=kick.body,
        qpos=np.repeat(kick.qpos[:1], 40, axis=0),
        qvel=np.repeat(kick.qvel[:1], 40, axis=0),
        object_qpos=ball,
        object_qvel=rate,
    )
    found, events = approach.ball_of(clip, (0.3, BALL_RADIUS + 1.2))
    assert events == {"release": pytest.approx(10 / fps)}
    assert found["ball_speed"] == pytest.approx(np.linalg.norm(velocity))
    assert found["ball_y"] == pytest.approx((HALF_LENGTH - SPOT[0]) / 20.0)
    assert found["ball_z"] == pytest.approx(BALL_RADIUS + 1.2)
    assert found["ball_off_target"] == pytest.approx(0.3)
    lies = replace(clip, object_qpos=np.repeat(ball[:1], 40, axis=0), object_qvel=0.0 * rate)
    assert approach.ball_of(lies) == ({}, {})


# The aim.


def test_a_bump_rises_and_falls_in_a_straight_line():
    """One number of size 2 on one joint: a triangle of 2 UNIT, zero two steps from its middle."""
    numbers = np.zeros((len(aim.MIDDLES), len(aim.BUMPED)))
    numbers[1, 3] = 2.0
    rows = aim.bumps(numbers.ravel(), list(range(10, 10 + len(aim.BUMPED))), 30)
    middle = aim.BEFORE - 1 + aim.MIDDLES[1]
    expected = np.zeros_like(rows)
    expected[middle - 1 : middle + 2, 13] = aim.UNIT * np.array([1.0, 2.0, 1.0])
    np.testing.assert_allclose(rows, expected, atol=1e-12)


def test_a_kick_is_aimed_at_another_target(kick):
    """A metre further to the middle than where the shipped one passes, played by the task."""
    clip = shipped(NAMES[1])
    here = np.array([clip.meta["achieved"]["ball_y"], clip.meta["achieved"]["ball_z"]])
    goal = (float(here[0] - np.sign(here[0])), 0.7)
    other = replace(kick, meta=kick.meta | {"options": {"target": goal}})
    assert clip.ctrl is not None
    before = approach.episode(other, clip.ctrl)
    assert before.meta["achieved"]["ball_off_target"] > 0.9
    found = aim.aim(before, goal, lambda ctrl: approach.episode(other, ctrl), threads=1)
    achieved = found.meta["achieved"]
    at = np.array([achieved["ball_y"], achieved["ball_z"]])
    assert achieved["goal"] == 1.0 and np.linalg.norm(at - goal) < 0.5
    assert achieved["ball_off_target"] == pytest.approx(np.linalg.norm(at - goal), abs=1e-5)


def test_a_ball_that_was_not_kicked_cannot_be_aimed():
    clip = shipped(NAMES[0])
    still = replace(clip, meta=clip.meta | {"events": {"start": 0.0}})
    assert aim.aim(still, (0.0, 1.0), lambda ctrl: pytest.fail("nothing to play")) is still


# Mistakes.


def test_a_clip_that_is_no_kick_is_refused_in_a_sentence(tmp_path: Path, capsys):
    out = tmp_path / "clip.npz"
    other = demonstration_files("tennis")[0]
    assert approach.main([str(other), "--out", str(out)]) == 2
    assert approach.main([str(tmp_path / "none.npz"), "--out", str(out)]) == 2
    assert capsys.readouterr().err.count("\n") == 2 and not out.exists()


@pytest.mark.slow
def test_steps_and_kick_followed_from_the_tasks_start(kick):
    clip = approach.approached(kick, approach.plan(kick))
    assert clip.meta["achieved"]["kicked"] == 1.0
    assert clip.meta["achieved"]["ball_off_target"] < 1.0
