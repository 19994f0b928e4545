"""Files that are not what they say: one sentence, and nothing is written."""

from __future__ import annotations

import io
import json
import pickle
import re
import tarfile
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from olympics_opt import cli
from tests.warmstart import mocap_files as files
from warmstart.mocap.bvh import read_bvh
from warmstart.mocap.capture import Capture
from warmstart.mocap.importer import Options, import_motions
from warmstart.mocap.readers import read_capture
from warmstart.mocap.source import Recording, recordings

QPOS = files.motion(6)
ASF, AMC = files.asf_amc(QPOS)
OWN = (files.own_map("bvh", 0.01), files.own_map("asf"))
GOOD = {
    "a.bvh": files.bvh(QPOS).encode(),
    "a.amc": AMC.encode(),
    "amass.npz": files.amass(QPOS),
    "wham.npz": files.wham(QPOS),
    "gvhmr.npz": files.gvhmr(QPOS),
    "tram.npz": files.tram(QPOS),
    "skillmimic.npz": files.skillmimic(files.motion(6, body=files.load_body("smplx")))[0],
    "a.txt": files.deepmimic(6)[0].encode(),
}


def record(name: str, data: bytes) -> Recording:
    return Recording("", name, data, {"a.asf": ASF.encode()} if name.endswith("amc") else {})


def sentence(name: str, data: bytes, fps: float | None = 30.0) -> str:
    with pytest.raises(ValueError) as error:
        read_capture(record(name, data), fps, OWN)
    text = str(error.value)
    assert "\n" not in text and name in text
    return text


@pytest.mark.parametrize("name", GOOD)
def test_the_good_file_is_read(name: str):
    assert read_capture(record(name, GOOD[name]), 30.0, OWN).num_frames == 6


def damaged(raw: bytes, data: st.DataObject) -> bytes:
    """Cut off, bytes changed, parts doubled or left out, words replaced."""
    at = data.draw(st.integers(0, len(raw)))
    kind = data.draw(st.sampled_from(["cut", "bytes", "drop", "double", "words"]))
    if kind == "cut":
        return raw[:at]
    if kind == "bytes":
        new = data.draw(st.binary(min_size=1, max_size=8))
        return raw[:at] + new + raw[at + len(new) :]
    size = data.draw(st.integers(1, 200))
    if kind == "drop":
        return raw[:at] + raw[at + size :]
    if kind == "double":
        return raw[: at + size] + raw[at:]
    word = data.draw(st.sampled_from([b"nan", b"1e999", b"-1", b"{", b"}", b"End Site", b":"]))
    words = raw.split(b" ")
    words[data.draw(st.integers(0, len(words) - 1))] = word
    return b" ".join(words)


@pytest.mark.parametrize("name", GOOD)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_a_damaged_file_is_a_motion_or_a_sentence(name: str, data: st.DataObject):
    raw = damaged(GOOD[name], data)
    try:
        capture = read_capture(record(name, raw), 30.0, OWN)
    except ValueError as error:
        assert "\n" not in str(error) and str(error).startswith(name)
    else:
        assert all(np.isfinite(p).all() for p in capture.points.values())


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_a_damaged_skeleton_is_a_motion_or_a_sentence(data: st.DataObject):
    asf = damaged(ASF.encode(), data)
    try:
        read_capture(Recording("", "a.amc", AMC.encode(), {"a.asf": asf}), 30.0, OWN)
    except ValueError as error:
        assert "\n" not in str(error)


def boxes() -> dict[str, bytes]:
    """The same file in archives of three kinds."""
    out = {}
    for mode in ("xz", "gz"):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode=f"w:{mode}") as archive:
            info = tarfile.TarInfo("a.bvh")
            info.size = len(GOOD["a.bvh"])
            archive.addfile(info, io.BytesIO(GOOD["a.bvh"]))
        out[f"tar.{mode}"] = buffer.getvalue()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.bvh", GOOD["a.bvh"])
    return {**out, "zip": buffer.getvalue()}


BOXES = boxes()


@pytest.mark.parametrize("kind", BOXES)
@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_a_damaged_archive_is_recordings_or_a_sentence(kind: str, data, tmp_path: Path):
    path = tmp_path / f"box.{kind}"
    path.write_bytes(damaged(BOXES[kind], data))
    try:
        assert [r.label for r in recordings(path)]
    except ValueError as error:
        assert "\n" not in str(error) and str(path) in str(error)


@pytest.mark.parametrize("name", GOOD)
@settings(max_examples=20, deadline=None)
@given(raw=st.binary(max_size=300))
def test_noise_is_a_sentence(name: str, raw: bytes):
    sentence(name, raw)


@given(lines=st.lists(st.sampled_from(GOOD["a.bvh"].decode().splitlines()[:40]), max_size=30))
@settings(max_examples=60, deadline=None)
def test_lines_of_bvh_in_any_order_are_a_sentence(lines: list[str]):
    with pytest.raises(ValueError):
        read_bvh("\n".join(lines), OWN)


def changed(name: str, **arrays: object) -> bytes:
    with np.load(io.BytesIO(GOOD[name])) as old:
        value = {k: old[k] for k in old.files}
    value.update(arrays)
    return files.npz(**{k: v for k, v in value.items() if v is not None})


def test_nan_is_told_with_its_frame():
    pose = np.zeros((6, 72))
    pose[4, 10] = np.nan
    assert "frame 4" in sentence("amass.npz", changed("amass.npz", poses=pose))
    text = GOOD["a.bvh"].decode().splitlines()
    text[-2] = "nan " + text[-2].split(" ", 1)[1]
    assert "'nan' is not a number" in sentence("a.bvh", "\n".join(text).encode())
    frames = json.loads(GOOD["a.txt"])["Frames"]
    frames[2][5] = float("nan")
    assert "frame 2" in sentence("a.txt", json.dumps({"Frames": frames}).encode())


@pytest.mark.parametrize("frames", [0, 1])
def test_too_few_frames(frames: int):
    arrays = {"poses": np.zeros((frames, 72)), "trans": np.zeros((frames, 3))}
    assert f"{frames} frame" in sentence("amass.npz", changed("amass.npz", **arrays))
    assert "frame" in sentence("a.bvh", files.bvh(QPOS[:frames]).encode())
    rows = json.loads(GOOD["a.txt"])["Frames"][:frames]
    assert "2 to" in sentence("a.txt", json.dumps({"Frames": rows}).encode())
    amc = files.asf_amc(QPOS[:1])[1] if frames else ":FULLY-SPECIFIED\n:DEGREES\n"
    assert "frame" in sentence("a.amc", amc.encode())


@pytest.mark.parametrize("rate", [0.0, -30.0, np.nan, np.inf, 1e9, 0.5])
def test_absurd_frame_rates(rate: float):
    assert "frames a second" in sentence(
        "amass.npz", changed("amass.npz", mocap_framerate=rate), None
    )


@pytest.mark.parametrize("step", ["0", "-0.1", "1e-9", "100", "inf"])
def test_absurd_frame_times(step: str):
    lines = GOOD["a.bvh"].decode().splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("Frame Time"))
    lines[at] = f"Frame Time: {step}"
    sentence("a.bvh", "\n".join(lines).encode(), None)


@pytest.mark.parametrize("unit", [1.0, 0.0001])
def test_wrong_units_are_told(unit: float):
    with pytest.raises(ValueError, match="unit of length is wrong"):
        read_bvh(files.bvh(QPOS), (files.own_map("bvh", unit),))


LENGTHS = {
    "amass.npz": ("trans",),
    "wham.npz": ("trans_world",),
    "gvhmr.npz": ("transl",),
    "tram.npz": ("pred_trans", "world_cam_T"),
}
"""Entries in metres of each layout of SMPL parameters."""


def in_unit(name: str, metres: float) -> bytes:
    """A good file whose lengths are in units of so many metres."""
    with np.load(io.BytesIO(GOOD[name])) as old:
        return changed(name, **{key: old[key] / metres for key in LENGTHS[name]})


@pytest.mark.parametrize("metres", [0.01, 0.001, 0.0254])
@pytest.mark.parametrize("name", LENGTHS)
def test_a_translation_in_another_unit_is_told(name: str, metres: float):
    assert "the unit of length is wrong" in sentence(name, in_unit(name, metres))


def test_a_root_in_another_unit_is_told_in_every_format():
    value = json.loads(GOOD["a.txt"])
    for row in value["Frames"]:
        row[1:4] = [100 * x for x in row[1:4]]
    assert "unit of length is wrong" in sentence("a.txt", json.dumps(value).encode())
    text = files.bvh(np.concatenate([QPOS[:, :2] * 50, QPOS[:, 2:] * 1.0], axis=1))
    assert "unit of length is wrong" in sentence("a.bvh", text.encode())


FPS = 60.0
TIME = np.arange(241) / FPS
STEP = files.motion(241)
"""Four seconds: every hinge swings a little, the pelvis goes 1.1 m."""


def placed(x: np.ndarray | float, z: np.ndarray | float, pose: np.ndarray = STEP) -> Capture:
    """The motion with the pelvis at (x, 0, z) m."""
    qpos = pose.copy()
    qpos[:, 0], qpos[:, 1], qpos[:, 2] = x, 0.0, z
    return read_capture(Recording("", "a.npz", files.amass(qpos, fps=FPS)))


def jitter(size: float) -> np.ndarray:
    return size * np.random.default_rng(0).normal(size=len(TIME))


PLAUSIBLE = {
    "sprint": (13.0 * TIME, 1.0 + 0.05 * np.sin(25 * TIME)),
    "sprint from the blocks": (np.minimum(5.0 * TIME**2, 13.0 * TIME), 1.0),
    "fall of a second": (0.0, 6.0 - 4.9 * np.minimum(TIME, 1.0) ** 2),
    "trampoline": (0.0, 1.0 + 4.9 * (TIME % 1.8) * (1.8 - TIME % 1.8)),
    "stairs": (0.6 * TIME, 1.0 + 0.4 * TIME),
    "floor 9 m down": (TIME, 10.0),
    "floor 9 m up": (TIME, -8.0),
    "a hall of 100 m": (100.0, 1.0),
    "two jumps of the recording": (25.0 * (TIME > 1) + 25.0 * (TIME > 3), 1.0),
    "a noisy video": (TIME + jitter(0.05), 1.0 + jitter(0.05)),
    "lying still": (jitter(1e-4), 0.1),
}


@pytest.mark.parametrize("kind", PLAUSIBLE)
def test_what_people_do_is_in_metres(kind: str):
    assert placed(*PLAUSIBLE[kind]).num_frames == len(TIME)


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.02])
def test_a_still_skier_is_in_metres(noise: float):
    """The feet slide at 15 m/s and the legs hardly move."""
    still = np.repeat(STEP[:1], len(TIME), axis=0)
    still[:, 7:] += noise * np.sin(np.outer(TIME, np.linspace(2, 9, still.shape[1] - 7)))
    assert placed(15.0 * TIME, 1.0, still).num_frames == len(TIME)


@pytest.mark.parametrize("unit", [100, 1000])
def test_small_steps_in_another_unit_are_told_by_the_feet(unit: float):
    """A slow knee bend about the origin: too slow for the bounds of the pelvis alone."""
    bend = 0.5 + 0.3 * np.sin(0.5 * TIME)
    qpos = np.repeat(STEP[:1], len(TIME), axis=0)
    qpos[:, 3:7] = [1.0, 0.0, 0.0, 0.0]
    qpos[:, 7:] = 0.0
    for side in "LR":
        for joint, sign in (("Hip", -1.0), ("Knee", 2.0), ("Ankle", -1.0)):
            qpos[:, 7 + files.BODY.dof_index(f"{side}_{joint}_y")] = sign * bend
    where = files.positions(qpos)
    height = where["Pelvis"][:, 2] - where["L_Ankle"][:, 2]
    assert placed(0.0, height, qpos).num_frames == len(TIME)
    with pytest.raises(ValueError, match="feet slide" if unit == 100 else "unit of length"):
        placed(0.0, unit * (height - height.mean()), qpos)


def test_an_unknown_skeleton_lists_the_known_ones():
    text = files.bvh(QPOS).replace("L_Knee", "knie_links")
    with pytest.raises(ValueError, match=r"unknown skeleton .* bandai_namco.*--joint-map"):
        read_bvh(text, OWN)


def test_a_pickle_is_refused_and_never_run(tmp_path: Path):
    class Bomb:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    raw = pickle.dumps(Bomb())
    assert "pickle" in sentence("amass.npz", raw)
    buffer = io.BytesIO()
    array = np.empty(1, dtype=object)
    array[0] = Bomb()
    np.savez(buffer, poses=array, trans=np.zeros((1, 3)), allow_pickle=True)
    assert "not plain numbers" in sentence("amass.npz", buffer.getvalue())
    assert not (tmp_path / "ran").exists()


def bomb() -> bytes:
    """A small npz that unpacks to 300 MiB."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("poses.npy", "w", force_zip64=True) as member:
            for _ in range(300):
                member.write(bytes(2**20))
        archive.writestr("trans.npy", b"")
    return buffer.getvalue()


def test_a_zip_bomb_is_refused_before_it_unpacks():
    raw = bomb()
    assert len(raw) < 2**20
    assert "300 MiB" in sentence("amass.npz", raw)


def test_a_forged_shape_is_refused():
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.zeros((6, 72)))
    forged = buffer.getvalue().replace(b"(6, 72)", b"(9999999, 7272)"[:15].ljust(7))
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("poses.npy", forged)
        archive.writestr("trans.npy", b"")
    sentence("amass.npz", out.getvalue())


@pytest.mark.parametrize(
    ("name", "change", "word"),
    [
        ("amass.npz", {"poses": np.zeros((6, 30))}, "66 or more"),
        ("amass.npz", {"trans": np.zeros((5, 3))}, "translation has shape"),
        ("amass.npz", {"trans": None}, "no layout"),
        ("amass.npz", {"mocap_framerate": np.zeros(3)}, "not one number"),
        ("wham.npz", {"fps": None}, "--source-fps"),
        ("tram.npz", {"world_cam_R": None}, "needs 'world_cam_R'"),
        ("tram.npz", {"frame": np.arange(6) + 90}, "frame does not name"),
        ("tram.npz", {"pred_rotmat": np.ones((6, 24, 3, 3))}, "not rotations"),
        ("gvhmr.npz", {"body_pose": np.zeros((5, 63))}, "differ in their number"),
        ("skillmimic.npz", {"body_position": np.zeros((6, 24, 3))}, "not (frames, 53, 3)"),
        ("skillmimic.npz", {"fps": None}, "frame rate"),
        ("skillmimic.npz", {"body_position": np.zeros((6, 53, 3))}, "legs are 0 m"),
    ],
)
def test_malformed_arrays_say_what_is_wrong(name: str, change: dict, word: str):
    assert word in sentence(name, changed(name, **change), None)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("JOINT L_Knee", "JOINT L_Hip", "two joints of one name"),
        ("CHANNELS 3", "CHANNELS 99", "99 channels"),
        ("Zrotation", "Wrotation", "unknown channel"),
        ("MOTION", "NOTION", "no HIERARCHY followed by MOTION"),
        ("Frames: 6", "Frames: 7", "it says 7 frames"),
        ("Frames: 6", "Frames: six", "'six' is not a number"),
        ("Frame Time:", "Time:", "no 'Frames:'"),
        ("ROOT Pelvis", "JOINT Pelvis", "wrong place"),
    ],
)
def test_malformed_bvh_says_what_is_wrong(old: str, new: str, word: str):
    text = GOOD["a.bvh"].decode()
    assert old in text
    assert word in sentence("a.bvh", text.replace(old, new).encode())


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("m_l_knee ", "m_l_shin ", "no moving bone 'm_l_shin'"),
        ("\n2\n", "\n", "malformed in frame 1"),
        (":DEGREES\n1\n", ":DEGREES\n", "malformed in frame 0"),
    ],
)
def test_malformed_amc_says_what_is_wrong(old: str, new: str, word: str):
    assert old in AMC
    assert word in sentence("a.amc", AMC.replace(old, new).encode())


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        (":bonedata", ":bones", "no section :bonedata"),
        ("dof rx ry rz", "dof rz ry rx", "not x, y, z"),
        ("m_l_hip l_knee", "nobody l_knee", "'l_knee' is broken"),
        ("length 0.45", "length 0", "unit of length 0"),
        ("axis XYZ", "axis ZYX", "not XYZ"),
        ("name l_hip\n", "name l_knee\n", "two bones"),
        ("    direction ", "    direction x ", "is not a number"),
    ],
)
def test_malformed_asf_says_what_is_wrong(old: str, new: str, word: str):
    assert old in ASF
    recording = Recording("", "a.amc", AMC.encode(), {"a.asf": ASF.replace(old, new, 1).encode()})
    with pytest.raises(ValueError) as error:
        read_capture(recording, 30.0, OWN)
    assert word in str(error.value)


def archive_of(path: Path, members: dict[str, bytes]) -> Path:
    with tarfile.open(path, "w:xz") as archive:
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return path


def sources(folder: Path) -> dict[str, Path]:
    """Sources with nothing to import, by what is wrong."""
    good = archive_of(folder / "good.tar.xz", {"a.npz": GOOD["amass.npz"]})
    out = {"missing": folder / "missing", "empty": folder / "empty"}
    out["empty"].mkdir()
    out["cut"] = folder / "cut.tar.xz"
    out["cut"].write_bytes(good.read_bytes()[:-400])
    out["noise"] = folder / "noise.zip"
    out["noise"].write_bytes(b"PK\x03\x04 no zip")
    out["text"] = folder / "text.bvh"
    out["text"].write_text("HIERARCHY")
    out["pickle"] = folder / "pickle.npz"
    out["pickle"].write_bytes(pickle.dumps({"poses": 1}))
    out["format"] = folder / "film.mp4"
    out["format"].write_bytes(b"film")
    out["other"] = archive_of(folder / "other.tar.xz", {"LICENSE": b"text"})
    return out


def bad_files() -> dict[str, tuple[str, bytes, str]]:
    """Motion files that cannot be read, by what is wrong: name, content, word of the sentence."""
    pose = np.zeros((6, 72))
    pose[4, 10] = np.nan
    rows = json.loads(GOOD["a.txt"])["Frames"]
    gap = [list(row) for row in rows]
    gap[2][5] = float("nan")
    zeros = {k: {"poses": np.zeros((k, 72)), "trans": np.zeros((k, 3))} for k in (0, 1)}
    bvh = GOOD["a.bvh"].decode()
    time = next(line for line in bvh.splitlines() if line.startswith("Frame Time"))
    head = bvh.rstrip().rpartition(" ")[0]
    empty = ":FULLY-SPECIFIED\n:DEGREES\n"
    inner = files.npz(poses=np.array([{}], dtype=object), trans=np.zeros((1, 3)))
    out = {
        "cut npz": ("a.npz", GOOD["amass.npz"][:-300], "damaged"),
        "nan": ("a.npz", changed("amass.npz", poses=pose), "frame 4"),
        "nan in json": ("a.json", json.dumps({"Frames": gap}).encode(), "frame 2"),
        "nan in bvh": ("a.bvh", f"{head} nan\n", "'nan' is not a number"),
        "nan in amc": ("a.amc", re.sub(r"root \S+", "root nan", AMC, count=1), "not a number"),
        "skeleton": ("a.bvh", bvh.replace("L_Knee", "knie_links"), "unknown skeleton"),
        "pickle inside": ("a.npz", inner, "not plain numbers"),
        "0 frames": ("a.npz", changed("amass.npz", **zeros[0]), "0 frames"),
        "1 frame": ("a.npz", changed("amass.npz", **zeros[1]), "1 frame:"),
        "0 frames in bvh": ("a.bvh", files.bvh(QPOS[:0]), "frame"),
        "1 frame in bvh": ("a.bvh", files.bvh(QPOS[:1]), "frame"),
        "0 frames in amc": ("a.amc", empty, "frame"),
        "1 frame in amc": ("a.amc", files.asf_amc(QPOS[:1])[1], "frame"),
        "1 frame in json": ("a.json", json.dumps({"Frames": rows[:1]}).encode(), "2 to"),
        "fps 0": ("a.npz", changed("amass.npz", mocap_framerate=0.0), "0 frames a second"),
        "fps 1e9": ("a.npz", changed("amass.npz", mocap_framerate=1e9), "1e+09 frames a second"),
        "fps nan": ("a.npz", changed("amass.npz", mocap_framerate=np.nan), "nan frames a second"),
        "frame time 1e-9 s": ("a.bvh", bvh.replace(time, "Frame Time: 1e-9"), "frames a second"),
        "frame time 0 s": ("a.bvh", bvh.replace(time, "Frame Time: 0"), "a frame time of 0 s"),
        "bvh in m": ("a.bvh", files.bvh(QPOS, unit=1.0), "unit of length is wrong"),
        "bvh in mm": ("a.bvh", files.bvh(QPOS, unit=0.001), "unit of length is wrong"),
        "bomb": ("a.npz", bomb(), "300 MiB"),
    }
    for name in LENGTHS:
        for unit, metres in (("cm", 0.01), ("mm", 0.001)):
            out[f"{name} in {unit}"] = (name, in_unit(name, metres), "unit of length is wrong")
    return {k: (n, d.encode() if isinstance(d, str) else d, w) for k, (n, d, w) in out.items()}


KINDS = ("missing", "empty", "cut", "noise", "text", "pickle", "format", "other")
BAD = bad_files()


def refused(source: Path, folder: Path, capsys, *options: str) -> str:
    """The one sentence with which the command refuses a source; it has written nothing."""
    out, result = folder / "clips", folder / "result.json"
    args = ["mocap", "import", str(source), "--out", str(out), "--result", str(result)]
    assert cli.main([*args, *options]) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("olympics-opt mocap: ") and "\n" not in error
    assert not out.exists() and not result.exists()
    return error


@pytest.mark.parametrize("kind", KINDS)
def test_the_command_says_one_sentence_and_writes_nothing(kind: str, tmp_path: Path, capsys):
    refused(sources(tmp_path)[kind], tmp_path, capsys)


@pytest.mark.parametrize("kind", BAD)
def test_the_command_refuses_a_bad_file(kind: str, tmp_path: Path, capsys):
    name, data, word = BAD[kind]
    (tmp_path / name).write_bytes(data)
    options = []
    if name.endswith("amc"):
        (tmp_path / "a.asf").write_text(ASF)
        (tmp_path / "own.json").write_text(json.dumps(asdict(OWN[1])))
        options = ["--joint-map", str(tmp_path / "own.json"), "--source-fps", "30"]
    error = refused(tmp_path / name, tmp_path, capsys, *options)
    assert name in error and word in error


def test_the_command_refuses_a_folder_of_nothing_but_bad_files(tmp_path: Path, capsys):
    for name in LENGTHS:
        (tmp_path / "in").mkdir(exist_ok=True)
        (tmp_path / "in" / name).write_bytes(in_unit(name, 0.001))
    assert "in/amass.npz: " in refused(tmp_path / "in", tmp_path, capsys)


def test_a_good_file_beside_a_bad_one_is_imported(tmp_path: Path, capsys):
    source, out = tmp_path / "in", tmp_path / "clips"
    source.mkdir()
    (source / "bad.npz").write_bytes(in_unit("amass.npz", 0.001))
    (source / "good.npz").write_bytes(GOOD["amass.npz"])
    args = ["mocap", "import", str(source), "--out", str(out), "--keep-rejected"]
    assert cli.main(args) == 1
    assert "in/bad.npz: its pelvis" in capsys.readouterr().out
    status = {
        r["file"]: r["status"] for r in json.loads((out / "import.json").read_text())["files"]
    }
    assert status["in/bad.npz"] == "unreadable" and status["in/good.npz"] != "unreadable"
    assert [p.name for p in out.rglob("*.npz")] == ["good.npz"]


@pytest.mark.parametrize(
    "options",
    [["--fps", "0"], ["--source-fps", "1e9"], ["--cutoff", "-1"], ["--joint-map", "nowhere.json"]],
)
def test_bad_options_are_one_sentence(options: list[str], tmp_path: Path, capsys):
    (tmp_path / "a.npz").write_bytes(GOOD["amass.npz"])
    out = tmp_path / "clips"
    args = ["mocap", "import", str(tmp_path / "a.npz"), "--out", str(out), *options]
    assert cli.main(args) == 2
    assert "\n" not in capsys.readouterr().err.strip()
    assert not out.exists()


def test_a_name_in_an_archive_cannot_lead_out_of_the_folder(tmp_path: Path):
    names = ("../../evil.npz", "/abs.npz", "a/../../b.npz", "x/.hidden.npz")
    path = archive_of(tmp_path / "in.tar.xz", dict.fromkeys(names, GOOD["amass.npz"]))
    out = tmp_path / "deep" / "clips"
    entries = import_motions(path, out, Options(keep_rejected=True))
    assert len(entries) == 4
    written = set(tmp_path.rglob("*.npz"))
    assert len(written) == 4 and all(p.is_relative_to(out) for p in written)


def test_an_archive_of_too_much_is_refused(tmp_path: Path, monkeypatch):
    path = archive_of(tmp_path / "in.tar.xz", {"a.bvh": bytes(5000), "b.bvh": bytes(5000)})
    monkeypatch.setattr("warmstart.mocap.source.MAX_BYTES", 4000)
    with pytest.raises(ValueError, match="more than is sensible"):
        list(recordings(path))
