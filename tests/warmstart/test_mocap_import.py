"""Whole sources made into clips: archives, resume, records, the command, and the real archives."""

from __future__ import annotations

import io
import json
import os
import tarfile
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from olympics_opt import cli
from tests.warmstart import mocap_files as files
from warmstart.clip import Clip
from warmstart.mocap.importer import Options, import_motions, summaries
from warmstart.mocap.readers import read_capture
from warmstart.mocap.retarget import retarget
from warmstart.mocap.source import recordings
from warmstart.outcome import lowest

ARCHIVES = os.environ.get("OLYMPICS_OPT_MOCAP", "")
"""Folder with archives of real recordings; without it they are not tested."""


def standing(frames: int = 40, height: float = 0.0, seed: int = 0) -> bytes:
    """AMASS file of a person who waves and stands ``height`` too high."""
    qpos = np.zeros((frames, 7 + files.BODY.num_dofs))
    qpos[:, 2], qpos[:, 3] = 0.95 + height, 1.0
    t = np.arange(frames) / 30
    for side, sign in (("L", -1), ("R", 1)):
        qpos[:, 7 + files.BODY.dof_index(f"{side}_Shoulder_x")] = sign * (
            1 + 0.3 * np.sin(t + seed)
        )
    return files.amass(qpos)


def teleport(frames: int = 40) -> bytes:
    """The same person, five metres aside from one frame to the next."""
    with np.load(io.BytesIO(standing(frames))) as old:
        value = {k: old[k] for k in old.files}
    value["trans"][frames // 2 :, 0] += 5.0
    return files.npz(**value)


def folder(tmp_path: Path) -> Path:
    """A tar.xz, a zip, a plain file, one to reject, one that is broken, and other things."""
    root = tmp_path / "in"
    (root / "more").mkdir(parents=True)
    with tarfile.open(root / "box.tar.xz", "w:xz") as archive:
        for name in ("box/a.npz", "box/b.npz", "box/LICENSE"):
            data = standing(seed=ord(name[4])) if name.endswith("npz") else b"free"
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    with zipfile.ZipFile(root / "bag.zip", "w") as archive:
        archive.writestr("c.npz", standing(height=0.15))
        archive.writestr("readme.txt", "not a motion")
    (root / "more" / "d.npz").write_bytes(teleport())
    (root / "more" / "e.bvh").write_text("HIERARCHY")
    (root / "notes.json").write_text("{}")
    (root / "index.csv").write_text(
        "file,description,fps,licence,sport_tag\nbox/a.npz,a wave,30,MIT,other\n"
    )
    return root


def test_a_folder_of_everything(tmp_path: Path):
    source, out = folder(tmp_path), tmp_path / "clips"
    shown: list[int] = []
    entries = import_motions(source, out, show=lambda so_far: shown.append(len(so_far)))
    status = {e.file: e.status for e in entries}
    assert status == {
        "bag/c.npz": "clip",
        "box/a.npz": "clip",
        "box/b.npz": "clip",
        "in/more/d.npz": "rejected",
        "in/more/e.bvh": "unreadable",
    }
    assert shown == [1, 2, 3, 4, 5]
    clips = sorted(p.relative_to(out).as_posix() for p in out.rglob("*.npz"))
    assert clips == ["bag/c.npz", "box/a.npz", "box/b.npz"]
    meta = Clip.load(out / "box" / "a.npz").meta
    assert meta["licence"] == "MIT" and meta["description"] == "a wave"
    record = {r["file"]: r for r in json.loads((out / "import.json").read_text())["files"]}
    assert "a joint at 150 m/s" in record["in/more/d.npz"]["reasons"]
    assert record["in/more/e.bvh"]["reasons"][0].startswith("in/more/e.bvh: ")


def test_a_second_import_does_only_what_is_left(tmp_path: Path):
    source, out = folder(tmp_path), tmp_path / "clips"
    first = import_motions(source, out)
    stamp = {p: p.stat().st_mtime_ns for p in out.rglob("*.npz")}
    (out / "box" / "b.npz").unlink()
    (source / "more" / "e.bvh").unlink()
    again = import_motions(source, out)
    assert [e.cpu_seconds for e in again if e.file != "box/b.npz"] == [
        e.cpu_seconds for e in first if e.file not in ("box/b.npz", "in/more/e.bvh")
    ]
    assert {p for p in stamp if p.stat().st_mtime_ns != stamp[p]} == {out / "box" / "b.npz"}
    other = import_motions(source, out, Options(fps=60.0))
    assert all(e.cpu_seconds != f.cpu_seconds for e, f in zip(other, again))
    assert Clip.load(out / "box" / "a.npz").fps == 60


def test_an_import_that_is_stopped_goes_on(tmp_path: Path, monkeypatch):
    source, out = folder(tmp_path), tmp_path / "clips"
    monkeypatch.setattr("warmstart.mocap.importer.EVERY", 1)

    class Stop(Exception):
        pass

    def stop(entries: list) -> None:
        if len(entries) == 2:
            raise Stop

    with pytest.raises(Stop):
        import_motions(source, out, show=stop)
    assert len(json.loads((out / "import.json").read_text())["files"]) == 2
    before = (out / "box" / "a.npz").stat().st_mtime_ns
    assert len(import_motions(source, out)) == 5
    assert (out / "box" / "a.npz").stat().st_mtime_ns == before


def test_a_broken_record_is_begun_again(tmp_path: Path):
    source, out = folder(tmp_path), tmp_path / "clips"
    out.mkdir()
    for text in ("{", "[]", '{"format": 1}', '{"format": "olympics-opt mocap import 1"}'):
        (out / "import.json").write_text(text)
        assert len(import_motions(source, out)) == 5


def test_the_feet_of_a_clip_are_on_the_floor(tmp_path: Path):
    entries = {e.file: e for e in import_motions(folder(tmp_path), tmp_path / "clips")}
    quality = entries["bag/c.npz"].quality
    assert quality["contact_share"] == 1 and quality["contact_height"] < 1e-3
    assert quality["sunk_frames"] == 0 and quality["skating"] < 1e-3


def test_summaries_weigh_clips_by_their_frames(tmp_path: Path):
    entries = import_motions(folder(tmp_path), tmp_path / "clips")
    for entry in entries:
        if entry.status == "clip":
            entry.quality["joint_error"], entry.quality["frames"] = 0.01, 10
            entry.cpu_seconds = 1.0
    entries[1].quality["joint_error"], entries[1].quality["frames"] = 0.05, 30
    found = summaries(entries)
    assert found["box"]["joint_error_cm"] == pytest.approx((5 * 30 + 1 * 10) / 40)
    assert found["box"]["frames_per_cpu_second"] == pytest.approx(40 / 2)
    assert (found["in"]["rejected"], found["in"]["unreadable"]) == (1, 1)
    assert found["in"]["joint_error_cm"] is None
    assert found["all"]["files"] == 5 and found["all"]["clips"] == 3


def test_the_command_prints_a_table_and_reasons(tmp_path: Path, capsys):
    source, out = folder(tmp_path), tmp_path / "clips"
    result = tmp_path / "result.json"
    args = ["mocap", "import", str(source), "--out", str(out), "--result", str(result)]
    assert cli.main(args) == 1  # one file could not be read
    text = capsys.readouterr().out
    assert "in/more/d.npz: " in text and "a joint at 150 m/s" in text
    assert "in/more/e.bvh: " in text
    assert "wrote 3 clips" in text
    value = json.loads(result.read_text())
    assert value["archives"]["all"]["clips"] == 3 and value["commit"] and value["hardware"]
    assert str(tmp_path) not in result.read_text()
    (source / "more" / "e.bvh").unlink()
    assert cli.main(args) == 0


@pytest.mark.parametrize("words", [[], ["--help"], ["import", "--help"]])
def test_help_of_the_command(words: list[str], capsys):
    assert cli.main(["mocap", *words]) == (0 if words else 2)
    assert "olympics-opt mocap import" in capsys.readouterr().out


def test_an_unknown_command_of_mocap(capsys):
    assert cli.main(["mocap", "export"]) == 2
    assert "mocap has no command 'export'" in capsys.readouterr().err


real = pytest.mark.skipif(not ARCHIVES, reason="OLYMPICS_OPT_MOCAP names no folder of archives")


@real
def test_one_kick_in_two_formats_is_one_motion():
    """A kick of the CMU database, as ASF/AMC and as BVH on another skeleton, a frame apart."""
    qpos = []
    for archive, name in (("cmu", "11_01.amc"), ("cmu_bvh", "11_01.bvh")):
        path = Path(ARCHIVES) / f"{archive}.tar.xz"
        recording = next(r for r in recordings(path) if r.name == name)
        qpos.append(retarget(read_capture(recording)).clip.qpos)
    a, b = qpos[0][1:], qpos[1]
    mine, theirs = files.positions(a), files.positions(b)
    apart = np.stack([mine[k] - theirs[k] for k in mine], axis=1)
    apart -= apart.mean((0, 1))  # the origin of the room
    assert np.linalg.norm(apart, axis=-1).mean() < 0.035
    one, two = files.rotations(a), files.rotations(b)
    turns = [r["Pelvis"] * r["Torso"] * r["Spine"] * r["Chest"] for r in (one, two)]
    assert np.degrees((one["Pelvis"].inv() * two["Pelvis"]).magnitude()).mean() < 5
    assert np.degrees((turns[0].inv() * turns[1]).magnitude()).mean() < 5
    for side in "LR":
        legs = [r["Pelvis"] * r[f"{side}_Hip"] * r[f"{side}_Knee"] for r in (one, two)]
        assert np.degrees((legs[0].inv() * legs[1]).magnitude()).mean() < 7


@real
def test_real_amass_joints_lie_along_the_chain_of_the_body_table():
    """Every clip of ``asap_smpl`` by the implementation of its own in ``mocap_files``."""
    found = 0
    for recording in recordings(Path(ARCHIVES) / "asap_smpl.tar.xz"):
        with np.load(io.BytesIO(recording.data)) as motion:
            place = files.smpl_chain(motion["poses"], motion["trans"] + files.PELVIS)
        points = read_capture(recording).points
        for name in place:
            assert np.abs(points[name] - place[name]).max() < 1e-6, (recording.label, name)
        found += 1
    assert found > 40


@real
def test_real_amass_clips_in_other_units_are_refused(tmp_path: Path, capsys):
    """Every clip of ``asap_smpl`` with ``trans`` in cm or mm, also from a place of its own."""
    for k, recording in enumerate(recordings(Path(ARCHIVES) / "asap_smpl.tar.xz")):
        with np.load(io.BytesIO(recording.data)) as old:
            value = {key: old[key] for key in old.files}
        for unit in (100, 1000):
            for start in (0.0, value["trans"][0]):
                other = files.npz(**{**value, "trans": unit * (value["trans"] - start)})
                with pytest.raises(ValueError, match="unit of length is wrong"):
                    read_capture(replace(recording, data=other))
        if k == 0:
            (tmp_path / "mm.npz").write_bytes(other)
    assert (
        cli.main(["mocap", "import", str(tmp_path / "mm.npz"), "--out", str(tmp_path / "o")]) == 2
    )
    assert not (tmp_path / "o").exists()
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@real
def test_the_real_archives_hold_the_bounds(tmp_path: Path):
    """Every tenth file of each archive."""
    for path in sorted(Path(ARCHIVES).glob("*.tar.xz")):
        sample = [r for k, r in enumerate(recordings(path)) if k % 10 == 0]
        entries = import_motions(sample, tmp_path / "clips")
        found = summaries(entries)[path.name.split(".")[0]]
        assert found["unreadable"] == 0 and found["clips"] >= 0.9 * found["files"], path.name
        assert found["joint_error_cm"] <= 3.5
        assert found["contact_height_cm"] <= 1.0
        assert found["sunk_frames_percent"] <= 0.5
        low = [  # by MuJoCo's shapes
            lowest(files.BODY, Clip.load(tmp_path / "clips" / e.clip).qpos)
            for e in entries
            if e.clip is not None
        ]
        assert (np.concatenate(low) < -0.02).mean() <= 0.005
