"""The clip library: windows, labels, the floor, and what is shipped."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from sports.env import make_env
from sports.humanoid.body import load_body
from warmstart.bank import (
    ClipBank,
    Window,
    demonstration_files,
    label,
    list_demonstrations,
    load_demonstrations,
)
from warmstart.certificate import Certificate
from warmstart.clip import Clip

BODY = load_body("smpl")


def clip(x: float = 0.0, frames: int = 31, sink: float = 0.0, **meta: object) -> Clip:
    """Standing at x, the first frame ``sink`` below the ground."""
    qpos, qvel = np.zeros((frames, 76)), np.zeros((frames, 75))
    qpos[:, 0], qpos[:, 2], qpos[:, 3] = x, BODY.standing_height(0.0), 1.0
    qpos[:, 1] = np.arange(frames) / 100  # tells the frames apart
    qpos[0, 2] -= sink
    return Clip(30.0, "smpl", qpos, qvel, meta=meta)


def test_frames_of_the_window_with_the_labels_of_their_clip():
    bank = ClipBank(
        [
            clip(
                1.0, problem="high_jump", achieved={"bar_height": 1.02}, asked={"bar_height": 1.0}
            ),
            clip(2.0, 11, problem="high_jump", asked={"bar_height": 1.5}, events={"takeoff": 0.1}),
            clip(3.0, 5),
        ]
    )
    assert bank.seconds == pytest.approx(1 + 10 / 30 + 4 / 30)
    starts = bank.starts(Window(start=0.04, end=0.21, before="takeoff"), probability=0.25)
    rows = starts.qpos[:, 0], starts.qpos[:, 1] * 100
    expected = [(1, i) for i in range(2, 7)] + [(2, 2), (2, 3)] + [(3, i) for i in range(2, 5)]
    assert [(round(float(a)), round(float(b))) for a, b in zip(*rows)] == expected
    heights = starts.context["bar_height"]
    assert heights[:7].tolist() == pytest.approx([1.02] * 5 + [1.5] * 2)
    assert torch.isnan(heights[7:]).all()  # a clip without a label: the task draws its own
    assert starts.probability == 0.25 and starts.qvel.shape == (10, 75)


def test_frames_below_the_ground_are_left_out():
    starts = ClipBank([clip(sink=0.03)]).starts()
    assert len(starts.qpos) == 30 and float(starts.qpos[:, 1].min()) > 0
    assert len(ClipBank([clip(sink=0.01)]).starts().qpos) == 31
    assert len(ClipBank([clip(sink=0.03)]).starts(floor=0.04).qpos) == 31
    with pytest.raises(ValueError, match="no frame of 1 clips"):
        ClipBank([clip(sink=0.03)]).starts(Window(end=0.0))


def test_by_default_nothing_after_the_landing_serves_as_a_start():
    bank = ClipBank([clip(events={"takeoff": 0.2, "landing": 0.5})])
    assert len(bank.starts().qpos) == 16
    assert len(bank.starts(Window(before="takeoff")).qpos) == 7
    assert len(bank.starts(Window(before=None)).qpos) == 31


def test_frames_of_an_episode_know_how_old_it_is():
    """Also after a cut; a clip that is of no episode has NaN."""
    played = clip(frames=11, events={"start": 0.0, "release": 0.2})
    bank = ClipBank([played, clip(2.0, 4), played.cut(0.1, 0.3)])
    ages = bank.starts().context["elapsed"].numpy()
    cut = np.arange(3, 10) / 30
    expected = np.concatenate([np.arange(11) / 30, np.full(4, np.nan), cut])
    np.testing.assert_allclose(ages, expected, atol=1e-6)
    assert not ClipBank([clip()]).starts().context


def test_what_makes_no_bank_is_refused():
    with pytest.raises(ValueError, match="at least one clip"):
        ClipBank([])
    smplx = load_body("smplx").num_dofs
    other = np.zeros((2, 7 + smplx))
    other[:, 3] = 1
    with pytest.raises(ValueError, match="one body"):
        ClipBank([clip(), Clip(30.0, "smplx", other, other[:, :-1])])
    with pytest.raises(ValueError, match="is empty"):
        Window(start=1.0, end=0.5)
    with pytest.raises(ValueError, match="not a number"):
        label(clip(asked={"bar_height": "high"}), "bar_height")


def test_an_environment_starts_from_the_frames_and_their_bar():
    bank = ClipBank([clip(18.0, problem="high_jump", achieved={"bar_height": 1.3})])
    env = make_env("high_jump", num_worlds=8, training=True, starts=bank.starts(probability=1.0))
    assert torch.allclose(env.physics.qpos[:, 0], torch.tensor(18.0))
    bar = env.physics.object_pos[:, 0, 2]
    assert torch.allclose(bar, torch.tensor(1.3 - 0.025), atol=1e-4)
    env.close()


def test_unknown_problem_is_refused():
    with pytest.raises(ValueError, match="unknown problem 'shot_put'; known: high_jump, long_jump"):
        load_demonstrations("shot_put")


def test_shipped_demonstrations_are_small_and_certified():
    files = demonstration_files()
    assert len(list_demonstrations()) == len(files)
    for path, row in zip(files, list_demonstrations()):
        assert path.stat().st_size < 200_000
        certificate = Certificate.from_json(path.with_suffix(".json"))
        assert certificate.passed, certificate.failures
        assert row["plan_certified"] and row["problem"] == certificate.problem
        # Only what was refined after its plan was certified may be no certified motion itself.
        assert row["certified"] or row["throw"]["why_not"]
        assert (row["throw"] is not None) == row["motion"].startswith("refined in MuJoCo")
        assert (row["throw"] is not None) == (row["problem"] == "free_throw")
        assert certificate.clip == (row["throw"] or {})
        assert json.loads(path.with_suffix(".json").read_text())["asked"] == row["asked"]
