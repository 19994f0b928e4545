"""Clip files corrected physically: tracked one after the other, kept or left out with reasons."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from warmstart.clip import Clip, clip_files
from warmstart.correction import LIGHT, Bounds, Player, correct
from warmstart.mocap.record import read_record, write_record
from warmstart.tracking import Tracking

RECORD = "track.json"
FORMAT = "olympics-opt mocap track 1"
Status = Literal["clip", "rejected", "unreadable"]


@dataclass(frozen=True)
class Options:
    """What decides how a clip is tracked; a change of it tracks the clip again."""

    strength: Literal["paper", "human"] = "paper"
    start: float = 0.0
    """Second of each clip from which it is tracked."""
    seconds: float | None = None
    """At most so much of each clip; None for all of it."""
    keep_rejected: bool = False
    player: str = ""
    """What follows the clips, by name; empty for the search of ``settings``."""
    settings: Tracking = LIGHT
    bounds: Bounds = field(default_factory=Bounds)

    def __post_init__(self) -> None:
        if not 0.0 <= self.start < 1e5:
            raise ValueError(f"clips cannot be tracked from second {self.start:g} on")
        if self.seconds is not None and not self.seconds >= 0.1:
            raise ValueError(f"at least 0.1 s of a clip can be tracked, not {self.seconds:g}")


@dataclass
class Entry:
    """What became of one clip file."""

    file: str
    digest: str
    status: Status
    reasons: list[str] = field(default_factory=list)
    clip: str | None = None
    """The tracked clip's path inside the folder, where one was written."""
    measured: dict[str, Any] = field(default_factory=dict)
    compute_seconds: float = 0.0


def track_clips(
    source: str | Path,
    out: str | Path,
    options: Options | None = None,
    show: Callable[[list[Entry]], None] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    player: Player | None = None,
) -> list[Entry]:
    """Tracks the clips of a file or folder and writes those that are good, with ``track.json``.

    Clips that are recorded there and unchanged are not tracked again. ``show`` is called after each
    file with all entries so far, ``progress(file, step, steps)`` within one; ``player`` is the one
    that the options name. Raises ValueError for
    a source without clips, one of which none can be read (nothing is written then), or an ``out``
    that is a file or the source itself; OSError when writing fails.
    """
    options, out = options or Options(), Path(out)
    found = clip_files(source)
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file, not a folder for clips")
    home = Path(source) if Path(source).is_dir() else Path(source).parent
    if out.resolve() == home.resolve():
        raise ValueError(f"{out} holds the clips themselves: choose another folder for --out")
    key = json.dumps([FORMAT, asdict(options)], sort_keys=True).encode()
    before, entries, wrote = read_record(out / RECORD, FORMAT, Entry), [], False
    for path, name in found:
        digest = hashlib.sha256(key + path.read_bytes()).hexdigest()
        old = before.get(name)
        if old and old.digest == digest and (old.clip is None or (out / old.clip).is_file()):
            entries.append(old)
        else:
            report = None if progress is None else _named(progress, name)
            entries.append(_one(path, name, digest, out, options, report, player))
        wrote = wrote or entries[-1].status != "unreadable"
        if wrote:
            write_record(out / RECORD, FORMAT, entries, before)
        if show is not None:
            show(entries)
    if not wrote:
        raise ValueError(entries[0].reasons[0])
    return entries


def _named(progress: Callable[[str, int, int], None], name: str) -> Callable[[int, int], None]:
    return lambda step, steps: progress(name, step, steps)


def _one(
    path: Path,
    name: str,
    digest: str,
    out: Path,
    options: Options,
    progress: Callable[[int, int], None] | None,
    player: Player | None,
) -> Entry:
    entry = Entry(name, digest, "unreadable")
    try:
        clip = Clip.load(path)
        end = clip.duration if options.seconds is None else options.start + options.seconds
        if options.start > 0 or end < clip.duration:
            if options.start >= clip.duration:
                raise ValueError(f"{path} ends before second {options.start:g}")
            clip = clip.cut(options.start, end)
        how = (options.strength, options.settings, options.bounds)
        done = correct(clip, *how, player=player, progress=progress)
    except ValueError as error:
        text = str(error)
        entry.reasons = [text if str(path) in text else f"{path}: {text}"]
        return entry
    except RuntimeError as error:
        entry.status, entry.reasons = "rejected", [str(error)]
        return entry
    entry.reasons, entry.measured = done.reasons, asdict(done.measured)
    entry.status = "rejected" if entry.reasons else "clip"
    entry.compute_seconds = round(done.compute_seconds, 3)
    if entry.reasons and not options.keep_rejected:
        (out / name).unlink(missing_ok=True)  # of an earlier run with other options
    else:
        done.clip.save(out / name)
        entry.clip = name
    return entry


def summary(entries: Iterable[Entry]) -> dict[str, Any]:
    """Figures of all clips that could be read; lengths in cm, errors over those that were kept."""
    entries = list(entries)
    read = [e for e in entries if e.measured]
    kept = [e for e in read if e.status == "clip"]
    seconds = np.array([e.measured["kept"] for e in kept])
    tracked = sum(e.measured["seconds"] for e in read)

    def mean(name: str, scale: float = 100.0) -> float | None:
        if not kept:
            return None
        values = np.array([e.measured[name] for e in kept])
        return round(scale * float((values * seconds).sum() / seconds.sum()), 3)

    return {
        "files": len(entries),
        "clips": len(kept),
        "rejected": sum(e.status == "rejected" for e in entries),
        "unreadable": sum(e.status == "unreadable" for e in entries),
        "stay_up_percent": _percent(sum(not e.measured["fell"] for e in read), len(read)),
        "seconds": round(tracked, 2),
        "seconds_kept": round(float(seconds.sum()), 2),
        "joint_error_cm": mean("joint_error"),
        "joint_error_worst_clip_cm": round(100 * max(e.measured["joint_error"] for e in kept), 3)
        if kept
        else None,
        "left_over_percent_of_weight": mean("left_over"),
        "saturated_percent": mean("saturated"),
        "sunk_frames_percent": mean("sunk"),
        "compute_seconds_per_second": round(sum(e.compute_seconds for e in read) / tracked, 2)
        if tracked
        else None,
    }


def _percent(part: int, whole: int) -> float | None:
    return round(100 * part / whole, 1) if whole else None
