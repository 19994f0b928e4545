"""Recorded motions made physical: forces with known answers, and clips whose fate is known."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from olympics_opt import cli
from olympics_opt.clip_sheet import clip_sheet
from sports.humanoid.body import load_body
from sports.physics import PhysicsState, make_physics
from sports.scene import humanoid_scene
from tests.warmstart import mocap_files as files
from tests.warmstart.replayed import next_states
from warmstart.bank import demonstration_files
from warmstart.clip import Clip, finite_difference_qvel
from warmstart.correction import Bounds, correct, floor_push, joint_errors
from warmstart.feed_forward import FRICTION, GRAVITY, forces_of, with_targets
from warmstart.mocap.bvh import read_bvh
from warmstart.mocap.bvh_writer import bvh_text, write_bvh
from warmstart.mocap.readers import read_capture
from warmstart.mocap.retarget import retarget
from warmstart.mocap.source import recordings
from warmstart.mocap.tracked import Options, summary, track_clips
from warmstart.outcome import lowest
from warmstart.tracking import Tracking

BODY = load_body("smpl")
WEIGHT = BODY.mass * GRAVITY
FEW = Tracking(worlds=16, horizon=8, iterations=2, knot_every=2, noise=0.2)


def posed(frames: int = 16, fps: float = 30.0, height: float = 0.0, wave: float = 0.3) -> Clip:
    """A person who stands, arms lowered, and waves; ``height`` above the floor."""
    t = np.arange(frames) / fps
    qpos = np.zeros((frames, 7 + BODY.num_dofs))
    qpos[:, 2], qpos[:, 3] = BODY.standing_height(0.0) + height, 1.0
    for side, sign in (("L", -1), ("R", 1)):
        qpos[:, 7 + BODY.dof_index(f"{side}_Shoulder_x")] = sign * (1 + wave * np.sin(5 * t))
    return Clip(fps, "smpl", qpos, finite_difference_qvel(BODY, qpos, fps), meta={"licence": "MIT"})


@pytest.fixture(scope="module")
def standing():
    return correct(posed(), settings=FEW)


def test_the_floor_carries_the_weight_of_who_stands_still():
    forces = forces_of(posed(wave=0.0), BODY)
    assert np.abs(forces.floor[:, 2] / WEIGHT - 1).max() < 1e-3
    assert np.abs(forces.floor[:, :2]).max() < 1e-3 * WEIGHT
    assert np.linalg.norm(forces.left_over[:, :3], axis=1).max() < 1e-3 * WEIGHT


def test_a_thrown_body_needs_no_force_and_one_that_hovers_needs_its_weight():
    t = np.arange(16) / 30
    hover = posed(height=1.0, wave=0.0)
    qpos, qvel = hover.qpos.copy(), hover.qvel.copy()
    qpos[:, 0] += 2.0 * t
    qpos[:, 2] += 2.0 * t - 0.5 * GRAVITY * t**2
    qvel[:, 0], qvel[:, 2] = 2.0, 2.0 - GRAVITY * t
    thrown = forces_of(replace(hover, qpos=qpos, qvel=qvel), BODY)
    inner = slice(3, -3)  # the smoothing of velocities bends their line at the ends
    assert np.abs(thrown.left_over[inner, :3]).max() < 1e-3 * WEIGHT
    assert np.abs(thrown.torque[inner]).max() < 0.5  # N m: nothing hangs in free fall
    left = forces_of(hover, BODY).left_over[:, :3]
    assert np.allclose(left, [0, 0, WEIGHT], atol=1e-3 * WEIGHT)


def test_the_floor_pushes_up_and_within_friction():
    """Sideways at 2 g while standing: only what friction allows is given."""
    clip = posed(wave=0.0)
    qvel = clip.qvel.copy()
    qvel[:, 1] = 2 * GRAVITY * clip.times
    force = forces_of(replace(clip, qvel=qvel), BODY).floor
    assert (force[:, 2] >= -1e-9).all()
    assert (np.abs(force[:, :2]).max(1) <= FRICTION * force[:, 2] + 1e-6).all()


def test_targets_give_the_torques_of_an_engine_that_knows_nothing_of_them():
    """Feed-forward alone keeps a standing athlete where bare joint angles sag."""
    clip = posed(10, wave=0.0)
    ready, _ = with_targets(clip, BODY)
    scene = humanoid_scene(BODY)
    drop = []
    for ctrl in (ready.ctrl, clip.qpos[:, 7:]):
        physics = make_physics("mujoco", scene, 1)
        q, v = np.float32(clip.qpos[:1]), np.float32(clip.qvel[:1])
        state = PhysicsState(torch.tensor(q), torch.tensor(v), torch.zeros(1, 0, 3))
        physics.reset(torch.ones(1, dtype=torch.bool), state)
        for row in ctrl[:-1]:
            physics.step(torch.tensor(np.float32(row))[None])
        drop.append(np.abs(physics.qpos[0, 7:].numpy() - clip.qpos[-1, 7:]).max())
        physics.close()
    assert drop[0] < 0.5 * drop[1]


def test_who_stands_stays(standing):
    m = standing.measured
    assert not standing.reasons and not m.fell
    assert m.kept == pytest.approx(m.seconds) and m.joint_error < 0.03
    assert m.push < 2.0 and m.left_over < 0.01
    meta = standing.clip.meta
    assert meta["licence"] == "MIT" and meta["strength"] == "paper"
    assert meta["source"].endswith("tracked in MuJoCo") and meta["corrected"]["fell"] is False


def test_every_frame_of_a_corrected_clip_follows_from_the_one_before(standing):
    clip = standing.clip
    assert np.abs(next_states(clip, BODY) - clip.qpos[1:]).max() < 2e-3


def test_a_person_who_floats_a_little_is_pulled_to_the_floor():
    clip = posed(20, height=0.05)
    done = correct(clip, settings=FEW)
    assert lowest(BODY, clip.qpos).min() > 0.049
    assert np.abs(lowest(BODY, done.clip.qpos)[-5:]).max() < 0.02
    assert not done.reasons and done.measured.left_over == pytest.approx(1.0, abs=0.01)


def test_a_person_who_hovers_is_rejected():
    done = correct(posed(20, height=1.0), settings=replace(FEW, worlds=4, iterations=1))
    assert done.measured.fell and done.measured.kept < 0.5
    assert any("could not be followed beyond" in reason for reason in done.reasons)
    assert done.clip.num_frames < 15


def test_bounds_say_why(standing):
    m = replace(standing.measured, joint_error=0.2, push=30.0, kept=0.1)
    text = "; ".join(m.reasons(Bounds()))
    assert "joints 20.0 cm" in text and "30 times the weight" in text and "0.10 of 0.50 s" in text


def test_the_push_of_the_floor_is_that_of_newton():
    """A body that is only moved upward at 1 g: the floor would push with two weights."""
    clip = posed(10, wave=0.0)
    assert floor_push(clip, BODY) == pytest.approx(1.0, abs=1e-6)
    qvel = clip.qvel.copy()
    qvel[:, 2] = GRAVITY * clip.times
    assert floor_push(replace(clip, qvel=qvel), BODY) == pytest.approx(2.0, abs=1e-6)


def test_joint_errors_of_a_shifted_motion_are_the_shift():
    clip = posed(5)
    assert np.allclose(joint_errors(clip.moved(x=0.3, y=0.4), clip), 0.5)
    with pytest.raises(ValueError, match="differ"):
        joint_errors(clip, replace(clip, fps=60.0))


def test_bad_input_ends_in_a_sentence():
    with pytest.raises(ValueError, match=r"only 0\.033 s long"):
        correct(posed(2))
    with pytest.raises(ValueError, match="not of 'smplx'"):
        forces_of(posed(3), load_body("smplx"))
    with pytest.raises(ValueError, match="lost"):
        Tracking(lost=0.0)
    for bad in ({"start": -1.0}, {"start": math.nan}, {"seconds": 0.0}, {"seconds": math.nan}):
        with pytest.raises(ValueError):
            Options(**bad)


def _folder(tmp_path: Path) -> Path:
    root = tmp_path / "clips"
    posed(8).save(root / "walks" / "a.npz")
    posed(20, height=1.0).save(root / "b.npz")
    (root / "c.npz").write_bytes(b"PK not a clip")
    return root


LIGHT = Options(settings=replace(FEW, worlds=4, iterations=1), bounds=Bounds(duration=0.2))


def test_a_folder_is_tracked_and_an_interrupted_run_gives_the_same_files(tmp_path: Path):
    source, whole, cut = _folder(tmp_path), tmp_path / "whole", tmp_path / "cut"
    entries = track_clips(source, whole, LIGHT)
    assert {e.file: e.status for e in entries} == {
        "b.npz": "rejected",
        "c.npz": "unreadable",
        "walks/a.npz": "clip",
    }
    assert not (whole / "b.npz").exists() and (whole / "walks" / "a.npz").is_file()

    def stop(entries: list) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        track_clips(source, cut, LIGHT, show=stop)
    steps: list[str] = []
    track_clips(source, cut, LIGHT, progress=lambda file, *_: steps.append(file))
    assert set(steps) == {"walks/a.npz"}  # b was done before
    one, two = (Clip.load(folder / "walks" / "a.npz") for folder in (whole, cut))
    assert np.array_equal(one.qpos, two.qpos) and np.array_equal(one.ctrl, two.ctrl)
    assert one.meta == two.meta
    steps.clear()
    track_clips(source, cut, LIGHT, progress=lambda file, *_: steps.append(file))
    assert not steps  # nothing left to do
    other = replace(LIGHT, settings=replace(LIGHT.settings, seed=1))
    track_clips(source, cut, other, progress=lambda file, *_: steps.append(file))
    assert set(steps) == {"walks/a.npz", "b.npz"}
    figures = summary(entries)
    assert figures["clips"] == 1 and figures["rejected"] == 1 and figures["unreadable"] == 1
    assert figures["stay_up_percent"] == 50.0


def test_the_command(tmp_path: Path, capsys):
    posed(8).save(tmp_path / "a.npz")
    words = ["mocap", "track", str(tmp_path / "a.npz"), "--out", str(tmp_path / "out")]
    few = ["--worlds", "4", "--seconds", "0.2", "--keep-rejected"]
    assert cli.main([*words, *few, "--result", str(tmp_path / "r.json")]) == 0
    clip = Clip.load(tmp_path / "out" / "a.npz")
    assert clip.ctrl is not None and clip.duration == pytest.approx(0.2)
    # Too short a cut to be called a motion: said, not hidden.
    assert "no longer than 0.20 of 0.20 s" in capsys.readouterr().out
    value = json.loads((tmp_path / "r.json").read_text())
    assert value["summary"]["files"] == 1 and "hardware" in value and "commit" in value


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nothing.npz", "--out", "out"], "there is nothing at"),
        (["empty", "--out", "out"], "holds no clip"),
        (["bad.npz", "--out", "out"], "bad.npz is not a readable"),
        (["good.npz", "--out", "bad.npz"], "is a file, not a folder"),
        (["good.npz", "--out", "."], "choose another folder"),
        (["good.npz", "--out", "out", "--seconds", "0"], "at least 0.1 s"),
        (["good.npz", "--out", "out", "--start", "9"], "ends before second 9"),
        (["good.npz", "--out", "out", "--worlds", "1"], "at least 2 worlds"),
    ],
)
def test_mistakes_end_in_one_sentence_and_nothing_is_written(
    tmp_path: Path, monkeypatch, capsys, words: list[str], sentence: str
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.npz").write_bytes(b"\x80\x04 a pickle")
    posed(5).save(tmp_path / "good.npz")
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(["mocap", "track", *words]) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_our_motion_as_bvh_comes_back():
    """Written by the hinges, read by the hierarchy; a second writer agrees on where joints are."""
    clip = Clip.load(demonstration_files("long_jump")[0])
    ours = read_bvh(bvh_text(clip))
    theirs = read_bvh(files.bvh(clip.qpos), (files.own_map("bvh", 0.01),))
    where = files.positions(clip.qpos)
    for name, points in ours.points.items():
        assert np.abs(points - where[name]).max() < 1e-6
        assert np.abs(points - theirs.points[name]).max() < 1e-6
        assert np.abs(ours.turns[name] - theirs.turns[name]).max() < 1e-6


def test_a_written_file_is_read_without_a_map_and_retargets_to_itself(tmp_path: Path):
    qpos = files.motion(20)
    clip = Clip(30.0, "smpl", qpos, finite_difference_qvel(BODY, qpos, 30.0))
    capture = read_capture(next(recordings(write_bvh(clip, tmp_path / "m.bvh"))))
    assert capture.meta["skeleton"] == "olympics_opt"
    back = retarget(capture, grounded=False).clip
    assert joint_errors(replace(back, fps=30.0), clip).max() < 1e-5


def test_a_sheet_shows_each_clip_in_its_row(tmp_path: Path):
    clip = posed(10)
    path = clip_sheet({"a": clip, "b": clip}, tmp_path / "s.png", columns=3, panel=(80, 100))
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    assert image.shape == (2 * 130, 240, 3)
    rows = image[30:130], image[160:260]
    assert np.array_equal(*rows)  # the same motion, the same views
    assert (np.abs(rows[0][50:, 20:60] - rows[0][-1, 0]).sum(-1) > 100).any()  # somebody is there
    with pytest.raises(ValueError, match="at least one clip"):
        clip_sheet({}, path)
