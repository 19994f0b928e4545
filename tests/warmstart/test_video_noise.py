"""Errors like a video reconstruction's: of the size asked, slow and fast, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sports.humanoid.body import load_body
from warmstart.bank import demonstration_files
from warmstart.clip import Clip, finite_difference_qvel
from warmstart.mocap.video_noise import VideoNoise, disturbed, main

NONE = VideoNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def still(frames: int) -> Clip:
    """An athlete who stands upright."""
    body = load_body("smpl")
    qpos = np.zeros((frames, 7 + body.num_dofs))
    qpos[:, 2], qpos[:, 3] = 0.95, 1.0
    return Clip(60.0, "smpl", qpos, np.zeros((frames, 6 + body.num_dofs)))


def test_errors_are_as_large_and_as_slow_as_asked() -> None:
    clip = still(20_000)
    slow = disturbed(clip, replace(NONE, drift=0.12, root_drift=0.03, width=0.15), seed=1)
    angles = slow.qpos[:, 7:]
    assert angles.std() == pytest.approx(0.12, rel=0.03)
    assert slow.qpos[:, :3].std(0) == pytest.approx(0.03, rel=0.15)
    # White noise through a Gaussian of width w has the autocorrelation exp(-t^2 / 4 w^2).
    lag = round(0.15 * 60)
    found = (angles[lag:] * angles[:-lag]).mean() / angles.var()
    assert found == pytest.approx(np.exp(-0.25), abs=0.03)
    fast = disturbed(clip, replace(NONE, jitter=0.03), seed=1).qpos[:, 7:]
    assert fast.std() == pytest.approx(0.03, rel=0.03)
    assert abs((fast[1:] * fast[:-1]).mean() / fast.var()) < 0.02
    turned = disturbed(clip, replace(NONE, turn_jitter=0.02), seed=1).qpos[:, 3:7]
    assert 2 * np.arccos(turned[:, 0].clip(-1, 1)).mean() == pytest.approx(
        0.02 * np.sqrt(8 / np.pi),
        rel=0.03,  # mean length of three normal numbers
    )


def test_velocities_follow_the_disturbed_positions_and_targets_are_gone() -> None:
    files = {p.stem: p for p in demonstration_files("table_tennis")}
    clip = Clip.load(files["table_tennis_forehand_7mps_human"])
    assert clip.ctrl is not None
    found = disturbed(clip, seed=3)
    assert found.ctrl is None and found.num_frames == clip.num_frames
    body = load_body(clip.body)
    expected = finite_difference_qvel(body, found.qpos, clip.fps)
    assert np.allclose(found.qvel, expected, atol=1e-9)
    assert found.meta["video_noise"]["seed"] == 3
    again, other = disturbed(clip, seed=3), disturbed(clip, seed=4)
    assert np.array_equal(found.qpos, again.qpos) and not np.array_equal(found.qpos, other.qpos)
    nothing = disturbed(clip, NONE)
    assert np.allclose(nothing.qpos, clip.qpos, atol=1e-12)


def test_noise_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="drift must be 0 or more"):
        VideoNoise(drift=-1.0)
    with pytest.raises(ValueError, match="jitter must be 0 or more"):
        VideoNoise(jitter=float("nan"))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "still.npz"
    still(30).save(source)
    assert main([str(source), "--out", str(tmp_path / "raw"), "--copies", "2"]) == 0
    one, two = (Clip.load(tmp_path / "raw" / f"still_{k}.npz") for k in (0, 1))
    assert not np.array_equal(one.qpos, two.qpos)
    (tmp_path / "bad.npz").write_bytes(b"no clip")
    assert main([str(tmp_path / "bad.npz"), "--out", str(tmp_path / "none")]) == 2
    assert "bad.npz" in capsys.readouterr().err and not (tmp_path / "none").exists()
