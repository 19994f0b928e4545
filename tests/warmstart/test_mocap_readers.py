"""Readers of recorded motion: our own motions written in each format come back as they were."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sports.humanoid import body as body_module
from tests.warmstart import mocap_files as files
from warmstart.clip import Clip
from warmstart.mocap.asf import read_asf_amc
from warmstart.mocap.bvh import read_bvh
from warmstart.mocap.capture import Capture, without_t_pose
from warmstart.mocap.deepmimic import read_deepmimic
from warmstart.mocap.readers import read_arrays, read_capture
from warmstart.mocap.retarget import retarget
from warmstart.mocap.skeleton import packaged_maps, read_joint_map
from warmstart.mocap.source import Recording

QPOS = files.motion()
WHERE = files.positions(QPOS)
NPZ = {
    "smpl": files.amass(QPOS, 72),
    "smplh": files.amass(QPOS, 156),
    "smplx": files.amass(QPOS, 165),
    "split": files.amass_split(QPOS),
    "wham": files.wham(QPOS),
    "gvhmr": files.gvhmr(QPOS),
    "tram": files.tram(QPOS),
}


def capture_of(kind: str) -> Capture:
    if kind == "bvh":
        return read_bvh(files.bvh(QPOS), (files.own_map("bvh", 0.01),))
    if kind == "asf":
        return read_asf_amc(*files.asf_amc(QPOS), 30.0, (files.own_map("asf"),))
    return read_capture(Recording("", f"{kind}.npz", NPZ[kind]))


def away(a: np.ndarray, b: np.ndarray) -> float:
    """Largest angle (rad) between the links of two motions, by scipy."""
    mine, theirs = files.rotations(a), files.rotations(b)
    return max(float((mine[k].inv() * theirs[k]).magnitude().max()) for k in mine)


@pytest.mark.parametrize("kind", ["bvh", "asf", *NPZ])
def test_our_own_motion_comes_back_from_every_format(kind: str):
    capture = capture_of(kind)
    assert capture.num_frames == len(QPOS)
    for name, points in capture.points.items():
        assert np.abs(points - WHERE[name]).max() < 1e-6, name
    clip = retarget(capture, grounded=False, cutoff=1e3).clip
    # A cutoff far over the frame rate smooths nothing: video formats are smoothed by default.
    assert np.abs(clip.qpos[:, :3] - QPOS[:, :3]).max() < 1e-6
    assert away(clip.qpos, QPOS) < 1e-6
    assert np.abs(clip.qpos[:, 7:] - QPOS[:, 7:]).max() < 1e-6


@pytest.mark.parametrize("order", ["XYZ", "ZXY", "YZX", "ZYX"])
def test_bvh_turns_in_the_order_of_its_channels(order: str):
    capture = read_bvh(files.bvh(QPOS, order=order), (files.own_map("bvh", 0.01),))
    assert np.abs(capture.points["L_Wrist"] - WHERE["L_Wrist"]).max() < 1e-6


def test_amass_joints_lie_along_the_chain_of_the_body_table():
    """An implementation of its own: SMPL's chain, offsets of the table, betas 0."""
    motion = np.load(io.BytesIO(NPZ["smpl"]))
    place = files.smpl_chain(motion["poses"], motion["trans"])
    capture = capture_of("smpl")
    for name in place:
        ours = capture.points[name] - capture.points["Pelvis"]
        assert np.abs(ours - (place[name] - place["Pelvis"])).max() < 1e-6


def test_skillmimic_links_come_back_by_name():
    qpos = files.motion(body=body_module.load_body("smplx"))
    data, where = files.skillmimic(qpos)
    capture = read_capture(Recording("", "shot.npz", data))
    assert capture.fps == 30
    for name, points in capture.points.items():
        assert np.abs(points - where[name]).max() < 1e-6, name
    root = Rotation.from_quat(qpos[:, 3:7], scalar_first=True).as_matrix()
    assert np.abs(capture.turns["Pelvis"] - root).max() < 1e-6


def test_deepmimic_joints_lie_where_its_skeleton_puts_them():
    text, where = files.deepmimic(dt=1 / 24)
    capture = read_deepmimic(text)
    assert capture.fps == pytest.approx(24)
    names = {"Pelvis": "root", "Neck": "neck", "L_Hip": "left_hip", "R_Wrist": "right_wrist"}
    names |= {"L_Knee": "left_knee", "R_Ankle": "right_ankle", "L_Elbow": "left_elbow"}
    names |= {"R_Shoulder": "right_shoulder", "L_Wrist": "left_wrist", "L_Ankle": "left_ankle"}
    for ours, theirs in names.items():
        assert np.abs(capture.points[ours] - where[theirs]).max() < 1e-6, ours


def test_deepmimic_hanging_arms_point_along_our_arm_links():
    """The turn of an upper arm takes our bone (+-y) to the source's bone."""
    capture = read_deepmimic(files.deepmimic()[0])
    for side, sign in (("L_", 1.0), ("R_", -1.0)):
        for a, b in (("Shoulder", "Elbow"), ("Elbow", "Wrist")):
            bone = capture.points[side + b] - capture.points[side + a]
            bone /= np.linalg.norm(bone, axis=1, keepdims=True)
            assert np.abs(capture.turns[side + a] @ [0, sign, 0] - bone).max() < 1e-9


def test_frames_of_different_duration_are_brought_to_one():
    text, where = files.deepmimic(frames=31)
    value = json.loads(text)
    kept = [0, 1, 2, 3, 5, 6, 7, 8, *range(9, 31)]  # one frame is missing: the one before is long
    rows = [list(value["Frames"][k]) for k in kept]
    rows[3][0] *= 2
    capture = read_deepmimic(json.dumps({"Frames": rows}))
    assert capture.num_frames == 31
    assert np.abs(capture.points["L_Wrist"] - where["left_wrist"]).max() < 5e-3


def test_a_person_who_faces_z_faces_our_x():
    """Hands made by hand: left hand at the file's +x, toes at its +z."""
    axes = {m.name: m.matrix for m in packaged_maps()}
    for name in ("daz", "bandai_namco", "motion_builder", "character_creator", "cmu"):
        assert np.array_equal(axes[name] @ [0, 0, 1], [1, 0, 0])  # forward
        assert np.array_equal(axes[name] @ [1, 0, 0], [0, 1, 0])  # left
        assert np.array_equal(axes[name] @ [0, 1, 0], [0, 0, 1])  # up
    assert np.array_equal(axes["deepmimic"] @ [1, 0, 0], [1, 0, 0])
    assert np.array_equal(axes["deepmimic"] @ [0, 0, 1], [0, -1, 0])  # its z is to the right


def test_every_packaged_map_is_used_by_its_format_and_complete():
    names = [m.name for m in packaged_maps()]
    assert len(set(names)) == len(names)
    for joint_map in packaged_maps():
        left = {k[2:] for k in joint_map.joints if k.startswith("L_")}
        right = {k[2:] for k in joint_map.joints if k.startswith("R_")}
        assert left == right and joint_map.source


def test_an_amc_file_needs_a_rate_and_takes_it_from_the_index():
    asf, amc = files.asf_amc(QPOS[:5])
    recording = Recording("a", "07_01.amc", amc.encode(), {"07.asf": asf.encode()})
    maps = (files.own_map("asf"),)
    with pytest.raises(ValueError, match=r"a/07_01.amc: .*--source-fps"):
        read_capture(recording, None, maps)
    told = Recording("a", "07_01.amc", amc.encode(), {"07.asf": asf.encode()}, {"fps": "60"})
    assert read_capture(told, None, maps).fps == 60
    assert read_capture(told, 24.0, maps).fps == 24


def test_an_amc_file_takes_the_skeleton_of_its_subject():
    asf, amc = files.asf_amc(QPOS[:5])
    maps, data = (files.own_map("asf"),), amc.encode()
    two = {"07.asf": asf.encode(), "08.asf": b"broken"}
    assert read_capture(Recording("", "07_01.amc", data, two), 30.0, maps).num_frames == 5
    with pytest.raises(ValueError, match=r"no ASF file beside it \(09.asf\)"):
        read_capture(Recording("", "09_01.amc", data, two), 30.0, maps)


def test_metadata_of_an_index_reaches_the_clip():
    facts = {"licence": "MIT", "source": "us", "sport_tag": "jump", "description": "a jump"}
    recording = Recording("box", "a.npz", NPZ["smpl"], {}, facts)
    clip = retarget(read_capture(recording), grounded=False).clip
    assert clip.meta["file"] == "box/a.npz" and clip.meta["licence"] == "MIT"
    assert clip.meta["sport"] == "jump" and clip.meta["quality"]["joint_error"] < 1e-6


def test_leading_t_pose_frames_are_left_out():
    rest = np.zeros((7, QPOS.shape[1]))
    rest[:, 2], rest[:, 3] = 0.95, 1.0
    text = files.bvh(np.concatenate([rest, QPOS]))
    capture = read_bvh(text, (files.own_map("bvh", 0.01),))
    assert without_t_pose(capture).num_frames <= len(QPOS)
    assert np.allclose(without_t_pose(capture).points["Head"][-1], WHERE["Head"][-1])
    with pytest.raises(ValueError, match="T-pose"):
        without_t_pose(read_bvh(files.bvh(rest), (files.own_map("bvh", 0.01),)))


def test_a_joint_map_of_a_users_own(tmp_path: Path):
    path = tmp_path / "own.json"
    joints = {name: name for name in files.BODY.link_names}
    value = {"name": "own", "format": "bvh", "joints": joints, "metres": 0.01, "rest": "t_pose"}
    path.write_text(json.dumps(value))
    capture = read_bvh(files.bvh(QPOS), (read_joint_map(path),))
    assert np.abs(capture.points["Head"] - WHERE["Head"]).max() < 1e-6


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"format": "fbx"}, "format 'fbx'"),
        ({"joints": {}}, "joints lacks L_Hip"),
        ({"joints": [1]}, "joints must name"),
        ({"metres": 0}, "a unit of 0 m"),
        ({"metres": "cm"}, "metres must be a number"),
        ({"rest": "a_pose"}, "rest is 'a_pose'"),
        ({"axes": ["x", "y", "y"]}, "axes"),
        ({"axes": ["y", "x", "z"]}, "axes"),  # left-handed
        ({"offsets": {"a": [1, 2]}}, "offsets must give three numbers"),
        ({"rest_turns": {"a": ["x", 0, 0]}}, "rest_turns must give three numbers"),
        ({"colour": "red"}, "unknown entry 'colour'"),
    ],
)
def test_a_joint_map_that_cannot_be_used_says_why(change: dict, word: str, tmp_path: Path):
    joints = {name: name for name in files.BODY.link_names}
    value = {"name": "own", "format": "bvh", "joints": joints, **change}
    path = tmp_path / "own.json"
    path.write_text(json.dumps(value))
    with pytest.raises(ValueError, match=word) as error:
        read_joint_map(path)
    assert "own.json" in str(error.value) and "\n" not in str(error.value)


def test_arrays_are_read_without_pickle_and_only_the_known_ones():
    big = {"poses": np.zeros((3, 72)), "video": np.zeros((10, 10)), "trans": np.zeros((3, 3))}
    assert set(read_arrays(files.npz(**big))) == {"poses", "trans"}


def test_a_clip_from_a_file_is_one_that_clip_reads(tmp_path: Path):
    clip = retarget(capture_of("smpl")).clip
    clip.save(tmp_path / "a.npz")
    assert np.abs(Clip.load(tmp_path / "a.npz").qpos - clip.qpos).max() < 1e-5
