"""The shipped motion tracker makes clips physical: what it plays obeys the engine, anywhere."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from olympics_opt import cli
from rl.following import Follower
from rl.policy import PolicyError
from sports.humanoid.body import load_body
from tests.rl.followed import BACKHAND, backhand
from tests.warmstart.replayed import next_states
from warmstart.clip import Clip
from warmstart.correction import correct, joint_errors


@pytest.fixture(scope="module")
def follower() -> Follower:
    return Follower("pretrained")


@pytest.fixture(scope="module")
def stroke() -> Clip:
    return backhand()


def test_every_frame_follows_from_the_one_before(follower, stroke):
    """The PD targets, put into the engine again state by state, lead to the next state."""
    played = follower(stroke, 0.3)
    assert played.num_frames == stroke.num_frames and played.ctrl is not None
    body = load_body("smpl", strength=follower.strength)
    assert np.abs(next_states(played, body) - played.qpos[1:]).max() < 2e-3


def test_it_stays_with_a_stroke_wherever_that_is_played(follower, stroke):
    shift = np.array([5.0, -3.0])
    away = replace(stroke, qpos=stroke.qpos + np.concatenate((shift, np.zeros(74))))
    here, there = follower(stroke, 0.3), follower(away, 0.3)
    assert joint_errors(here, stroke).mean() < 0.03
    np.testing.assert_allclose(there.qpos[:, :2] - shift, here.qpos[:, :2], atol=1e-3)
    np.testing.assert_allclose(there.qpos[:, 2:], here.qpos[:, 2:], atol=1e-2)


def test_it_gives_up_where_nobody_could_follow(follower, stroke):
    """The same stroke while the whole body glides through the air at 6 m/s."""
    path = stroke.qpos.copy()
    path[:, 0] += 6.0 * stroke.times
    path[:, 2] += 1.0
    played = follower(replace(stroke, qpos=path, ctrl=None), 0.3)
    assert 1 < played.num_frames < stroke.num_frames


def test_a_corrected_clip_names_its_tracker_and_strength(follower, stroke):
    done = correct(stroke, "human", player=follower)
    assert done.reasons == [] and not done.measured.fell
    assert done.clip.meta["corrected"]["tracker"] == str(follower)
    assert "seed" not in done.clip.meta["corrected"]
    assert done.clip.meta["strength"] == follower.strength == "human"


def test_the_command_and_its_mistakes(tmp_path: Path, stroke, capsys):
    (tmp_path / "in").mkdir()
    stroke.save(tmp_path / "in" / "stroke.npz")
    args = ["mocap", "track", str(tmp_path / "in"), "--tracker", "pretrained"]
    assert cli.main([*args, "--out", str(tmp_path / "no"), "--strength", "paper"]) == 2
    assert "of strength 'human'" in capsys.readouterr().err
    assert cli.main([*args[:-1], str(BACKHAND), "--out", str(tmp_path / "no")]) == 2
    assert not (tmp_path / "no").exists()
    result = tmp_path / "result.json"
    assert cli.main([*args, "--out", str(tmp_path / "out"), "--result", str(result)]) == 0
    found = json.loads(result.read_text())
    assert found["tracker"].startswith("ppo ") and found["strength"] == "human"
    assert found["summary"]["clips"] == 1
    kept = Clip.load(tmp_path / "out" / "stroke.npz")
    assert kept.ctrl is not None and joint_errors(kept, stroke).mean() < 0.05


def test_another_policy_is_refused():
    with pytest.raises(PolicyError):
        Follower("pretrained:amp")
