"""Whole archives made into clips, with a record of every file: :func:`import_motions`.

The record, ``import.json`` beside the clips, says of each file what became of it and why, and lets
an import that was stopped go on where it was.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from warmstart.mocap.readers import read_capture
from warmstart.mocap.record import read_record, write_record
from warmstart.mocap.retarget import retarget
from warmstart.mocap.skeleton import JointMap
from warmstart.mocap.source import Recording, recordings

RECORD = "import.json"
FORMAT = "olympics-opt mocap import 1"
EVERY = 25
"""The record is written after so many files."""
Status = Literal["clip", "rejected", "unreadable"]


@dataclass(frozen=True)
class Options:
    """What decides how a file is imported; a change of it imports the file again."""

    body: Literal["smpl", "smplx"] = "smpl"
    source_fps: float | None = None
    fps: float | None = None
    cutoff: float | None = None
    keep_rejected: bool = False


@dataclass
class Entry:
    """What became of one file."""

    file: str
    archive: str
    digest: str
    status: Status
    reasons: list[str] = field(default_factory=list)
    clip: str | None = None
    """The clip's path inside the folder, where one was written."""
    quality: dict[str, float] = field(default_factory=dict)
    cpu_seconds: float = 0.0
    """Processor time of reading, retargeting and writing."""


def import_motions(
    source: str | Path | Iterable[Recording],
    out: str | Path,
    options: Options | None = None,
    maps: tuple[JointMap, ...] = (),
    show: Callable[[list[Entry]], None] | None = None,
) -> list[Entry]:
    """Makes clips of all motion files of a source (file, folder, archive) in the folder ``out``.

    Clips that fail their quality report are left out, with their reasons in the record. A file that
    cannot be read is recorded; when none can, nothing is written and ValueError is raised with the
    first file's sentence. ``show`` is called after each file with all entries so far. Raises
    ValueError as :func:`warmstart.mocap.source.recordings` does, OSError when writing fails.
    """
    options = options or Options()
    _check(options)
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file, not a folder for clips")
    key = json.dumps([FORMAT, options.__dict__, [m.__dict__ for m in maps]], sort_keys=True)
    before = read_record(out / RECORD, FORMAT, Entry)
    entries: list[Entry] = []
    taken: set[str] = set()
    wrote = False
    found = recordings(source) if isinstance(source, str | Path) else source
    for recording in found:
        digest = hashlib.sha256(key.encode())
        for part in (
            recording.data,
            *(recording.skeletons[k] for k in sorted(recording.skeletons)),
        ):
            digest.update(part)
        name = _clip_name(recording, taken)
        old = before.get(recording.label)
        if old and old.digest == digest.hexdigest() and _still_there(old, out):
            entries.append(old)
        else:
            entries.append(_one(recording, digest.hexdigest(), out, name, options, maps))
        wrote = wrote or entries[-1].status != "unreadable"
        if wrote and len(entries) % EVERY == 0:
            write_record(out / RECORD, FORMAT, entries, before)
        if show is not None:
            show(entries)
    if not wrote:
        raise ValueError(entries[0].reasons[0] if entries else "there is no motion to import")
    write_record(out / RECORD, FORMAT, entries, before)
    return entries


def _check(options: Options) -> None:
    for name, value, low, high in (
        ("the source's frame rate", options.source_fps, 5.0, 1000.0),
        ("the clips' frame rate", options.fps, 5.0, 1000.0),
        ("the cutoff", options.cutoff, 0.1, 1000.0),
    ):
        if value is not None and not low <= value <= high:
            raise ValueError(f"{name} must lie in [{low:g}, {high:g}], not {value:g}")


def _one(
    recording: Recording,
    digest: str,
    out: Path,
    name: str,
    options: Options,
    maps: tuple[JointMap, ...],
) -> Entry:
    start = time.process_time()
    entry = Entry(recording.label, recording.archive, digest, "unreadable")
    try:
        capture = read_capture(recording, options.source_fps, maps)
        done = retarget(capture, options.body, cutoff=options.cutoff)
        clip = done.clip if options.fps is None else done.clip.resample(options.fps)
    except ValueError as error:
        text = str(error)
        label = recording.label
        entry.reasons = [text if text.startswith(label) else f"{label}: {text}"]
        return entry
    entry.quality, entry.reasons = done.quality.to_json(), done.reasons
    entry.status = "rejected" if entry.reasons else "clip"
    path = out / name
    if entry.reasons and not options.keep_rejected:
        path.unlink(missing_ok=True)  # of an earlier import with other options
    else:
        clip.save(path)
        entry.clip = name
    entry.cpu_seconds = time.process_time() - start
    return entry


def summaries(entries: Iterable[Entry]) -> dict[str, dict[str, Any]]:
    """Figures of each archive and of ``all``; lengths in cm, over the clips that were kept.

    Means are over frames, the contact height is the median over clips; the rate is frames of all
    read files by the processor time that they took, in the same run as the errors.
    """
    groups: dict[str, list[Entry]] = {}
    for entry in entries:
        groups.setdefault(entry.archive or "files", []).append(entry)
    if len(groups) > 1:
        groups["all"] = [e for group in groups.values() for e in group]
    return {name: _summary(group) for name, group in groups.items()}


def _summary(entries: list[Entry]) -> dict[str, Any]:
    read = [e for e in entries if e.status != "unreadable"]
    kept = [e for e in read if e.status == "clip"]
    frames = np.array([e.quality["frames"] for e in kept])

    def mean(key: str, scale: float = 1.0) -> float | None:
        if not kept:
            return None
        values = np.array([e.quality[key] for e in kept])
        return round(scale * float((values * frames).sum() / frames.sum()), 4)

    def over_clips(key: str, function: Callable, scale: float = 1.0) -> float | None:
        return round(scale * float(function([e.quality[key] for e in kept])), 4) if kept else None

    seconds = sum(e.cpu_seconds for e in read)
    total = sum(int(e.quality["frames"]) for e in read)
    return {
        "files": len(entries),
        "clips": len(kept),
        "rejected": len(read) - len(kept),
        "unreadable": len(entries) - len(read),
        "frames": total,
        "minutes": round(sum(e.quality["seconds"] for e in read) / 60, 2),
        "joint_error_cm": mean("joint_error", 100),
        "joint_error_worst_clip_cm": over_clips("joint_error", max, 100),
        "bone_error_deg": mean("bone_error"),
        "scaled_distance_cm": mean("scaled_distance", 100),
        "contact_height_cm": over_clips("contact_height", np.median, 100),
        "contact_height_p95_cm": mean("contact_height_worst", 100),
        "skating_cm_s": mean("skating", 100),
        "sunk_frames_percent": mean("sunk_frames", 100),
        "deepest_cm": over_clips("deepest", max, 100),
        "jerk_m_s3": mean("jerk"),
        "jerk_source_m_s3": mean("jerk_source"),
        "frames_per_cpu_second": round(total / seconds, 1) if seconds else None,
    }


def _still_there(entry: Entry, out: Path) -> bool:
    return entry.clip is None or (out / entry.clip).is_file()


def _clip_name(recording: Recording, taken: set[str]) -> str:
    """Path of the clip inside the folder: the file's, with nothing that could lead out of it."""
    path = PurePosixPath(recording.name)
    parts = [recording.archive, *path.parts[:-1], path.stem]
    clean = [re.sub(r"[^\w.+-]", "_", part).lstrip(".") for part in parts]
    name = "/".join(part for part in clean if part) or "clip"
    if f"{name}.npz" in taken:
        name += f"_{path.suffix.lstrip('.')}"
    while f"{name}.npz" in taken:
        name += "_"
    taken.add(f"{name}.npz")
    return f"{name}.npz"
