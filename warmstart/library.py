"""Many clips in one small file, to be carried to the machine that trains on them.

Of each clip the path is kept (root and hinge angles, 30 frames a second). Velocities of recordings
follow from it, by differences of rotations; those of simulated clips (which have PD targets) are
kept: at a take-off differences over a thirtieth of a second miss them by 0.7 m/s and 5 rad/s, and
from such a state the clip's own targets lead elsewhere. An hour takes about 15 MB of recordings.
Each clip keeps its name, archive, sport, licence and origin, so that what is learned from it can
say so.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sports.humanoid.body import load_body
from warmstart.clip import Clip, clip_files
from warmstart.npz import read_npz, write_npz

FORMAT = "olympics-opt clip library 1"
FPS = 30.0
"""Frames per second: one a control step."""
ANGLE = 1e-4
"""Hinge angles are whole multiples of this (rad) in the file: +- 3.2767 holds a turn."""
HELD_OUT = 10
"""Per cent of the clips, by name, that training never sees."""
SHORTEST = 8
"""Frames below which a clip is left out: nothing can be followed in it."""
Split = Literal["train", "held_out", "all"]


@dataclass(frozen=True)
class Origin:
    """Where a clip of a library came from."""

    name: str
    """Path of the clip file in its folder, without the suffix; unique in a library."""
    archive: str
    tag: str
    """Sport or kind of motion."""
    licence: str
    source: str

    @property
    def held_out(self) -> bool:
        """Whether the clip belongs to the split ``held_out`` (else to ``train``): by the hash of
        its name, so the same on every machine and whatever else is in the library."""
        return int(hashlib.sha256(self.name.encode()).hexdigest(), 16) % 100 < HELD_OUT


@dataclass(frozen=True, eq=False)
class Library:
    """Paths of many clips of one body at ``FPS``, one after the other.

    Raises ValueError where lengths, shapes or names do not fit each other.
    """

    body: str
    origins: tuple[Origin, ...]
    lengths: np.ndarray
    """(C,) frames of each clip, at least 2."""
    root: np.ndarray
    """(F, 7) position (m) and quaternion (w, x, y, z) of the root."""
    joints: np.ndarray
    """(F, n) hinge angles (rad) within half a turn."""
    velocities: np.ndarray | None = None
    """(F, 6 + n) qvel of the simulated clips, NaN in all frames of the others; None for none."""

    def __post_init__(self) -> None:
        frames, dofs = len(self.root), load_body(self.body).num_dofs
        lengths = np.asarray(self.lengths)
        if len(lengths) != len(self.origins) or not len(lengths):
            raise ValueError("the library names another number of clips than it holds")
        if (lengths < 2).any() or lengths.sum() != frames:
            raise ValueError("the lengths of the library's clips do not add up to its frames")
        if self.root.shape != (frames, 7) or self.joints.shape != (frames, dofs):
            raise ValueError(f"the library's frames are not those of body '{self.body}'")
        if not (np.isfinite(self.root).all() and np.isfinite(self.joints).all()):
            raise ValueError("the library holds numbers that are not finite")
        if np.abs(np.linalg.norm(self.root[:, 3:], axis=1) - 1.0).max() > 1e-2:
            raise ValueError("the library holds a root quaternion that is not of length 1")
        if len({o.name for o in self.origins}) != len(self.origins):
            raise ValueError("two clips of the library have one name")
        lengths = lengths.astype(int)
        if self.velocities is not None:
            if self.velocities.shape != (frames, 6 + dofs):
                raise ValueError(f"the library's velocities are not those of body '{self.body}'")
            firsts = np.cumsum(lengths) - lengths
            missing = np.repeat(np.isnan(self.velocities[firsts, 0]), lengths)
            if not np.array_equal(
                np.isfinite(self.velocities),
                np.broadcast_to(~missing[:, None], self.velocities.shape),
            ):
                raise ValueError("the library holds velocities that are not finite")
        object.__setattr__(self, "lengths", lengths)

    @property
    def minutes(self) -> float:
        """Duration of all clips."""
        return float((self.lengths - 1).sum() / FPS / 60.0)

    @property
    def digest(self) -> str:
        """sha256 of the motions: two libraries of one digest train alike."""
        whole = hashlib.sha256(self.body.encode())
        for origin, length in zip(self.origins, self.lengths):
            whole.update(f"{origin.name}:{length}\n".encode())
        whole.update(np.ascontiguousarray(self.root, np.float32).tobytes())
        whole.update(np.round(self.joints / ANGLE).astype(np.int16).tobytes())
        if self.velocities is not None:
            whole.update(np.ascontiguousarray(self.velocities, np.float16).tobytes())
        return whole.hexdigest()

    def qpos(self, clip: int) -> np.ndarray:
        """(T, 7 + n) path of a clip, float64."""
        rows = self._rows(clip)
        return np.concatenate([self.root[rows], self.joints[rows]], axis=1).astype(float)

    def qvel(self, clip: int) -> np.ndarray | None:
        """(T, 6 + n) velocities of a simulated clip, float64; None where they follow from the
        path."""
        if self.velocities is None:
            return None
        own = self.velocities[self._rows(clip)].astype(float)
        return None if np.isnan(own[0, 0]) else own

    def _rows(self, clip: int) -> slice:
        end = int(self.lengths[: clip + 1].sum())
        return slice(end - int(self.lengths[clip]), end)

    def chosen(self, clips: Sequence[int]) -> Library:
        """A library of some clips, by index. Raises ValueError for none."""
        if not len(clips):
            raise ValueError("no clip of the library is left")
        ends = np.cumsum(self.lengths)
        rows = np.concatenate([np.arange(ends[c] - self.lengths[c], ends[c]) for c in clips])
        return replace(
            self,
            origins=tuple(self.origins[c] for c in clips),
            lengths=self.lengths[list(clips)],
            root=self.root[rows],
            joints=self.joints[rows],
            velocities=_known(None if self.velocities is None else self.velocities[rows]),
        )

    def split(self, name: Split) -> Library:
        """The clips of a split. Raises ValueError for an unknown one or one without clips."""
        if name == "all":
            return self
        if name not in ("train", "held_out"):
            raise ValueError(f"unknown split '{name}'; known: train, held_out, all")
        wanted = [i for i, o in enumerate(self.origins) if o.held_out == (name == "held_out")]
        if not wanted:
            raise ValueError(f"none of the {len(self.origins)} clips is in the split '{name}'")
        return self.chosen(wanted)

    def only(self, archives: Sequence[str]) -> Library:
        """The clips of some archives, which stay in their splits. Raises ValueError for one that
        is not there."""
        have = sorted({o.archive for o in self.origins})
        for name in archives:
            if name not in have:
                raise ValueError(f"there is no archive '{name}'; there are: {', '.join(have)}")
        return self.chosen([i for i, o in enumerate(self.origins) if o.archive in archives])

    def card(self) -> dict[str, Any]:
        """What a model says about its data: archives with clips, minutes and licences; digest."""
        archives: dict[str, dict[str, Any]] = {}
        for origin, length in zip(self.origins, self.lengths):
            row = archives.setdefault(origin.archive, {"clips": 0, "minutes": 0.0, "licences": []})
            row["clips"] += 1
            row["minutes"] = round(row["minutes"] + (int(length) - 1) / FPS / 60.0, 4)
            row["licences"] = sorted({*row["licences"], origin.licence})
        return {"digest": self.digest, "body": self.body, "archives": archives}

    def save(self, path: str | Path) -> None:
        """Writes one npz, atomically."""
        head = {
            "format": FORMAT,
            "fps": FPS,
            "body": self.body,
            "clips": [vars(o) for o in self.origins],
        }
        arrays = {
            "lengths": self.lengths.astype(np.int32),
            "root": self.root.astype(np.float32),
            "joints": np.round(self.joints / ANGLE).astype(np.int16),
        }
        if self.velocities is not None:
            arrays["velocities"] = self.velocities.astype(np.float16)
        write_npz(path, arrays, head)

    @staticmethod
    def load(path: str | Path) -> Library:
        """Reads what :meth:`save` wrote. Raises ValueError naming the file and what is wrong."""
        names = ("lengths", "root", "joints")
        arrays, head = read_npz(path, names, ("velocities",), what="clip library")
        if head.get("format") != FORMAT or head.get("fps") != FPS:
            raise ValueError(
                f"{path} is not a readable clip library: its format is "
                f"{str(head.get('format'))[:40]!r}, expected '{FORMAT}'"
            )
        try:
            origins = tuple(Origin(**{k: str(v) for k, v in row.items()}) for row in head["clips"])
            lengths, joints = arrays["lengths"], arrays["joints"] * ANGLE
            root, velocities = arrays["root"], arrays.get("velocities")
            return Library(str(head["body"])[:40], origins, lengths, root, joints, velocities)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} is not a readable clip library: {error}") from error
        except (ValueError, IndexError) as error:
            raise ValueError(f"{path}: {error}") from error


def pack(named: Iterable[tuple[str, Clip]]) -> Library:
    """A library of clips, each with its name (``cmu/02_01``: the first folder is the archive).

    Clips are resampled to ``FPS`` and moved to begin at x = y = 0; those shorter than ``SHORTEST``
    frames are left out. Velocities of clips with PD targets are kept. Raises ValueError for clips
    of two bodies, or none that is long enough.
    """
    origins, roots, joints, velocities, bodies = [], [], [], [], {}
    for name, clip in named:
        bodies.setdefault(clip.body, name)
        if len(bodies) > 1:
            (one, first), (two, second) = bodies.items()
            raise ValueError(
                f"a library holds clips of one body: '{first}' is of '{one}', '{second}' of '{two}'"
            )
        if clip.duration * FPS + 1e-6 < SHORTEST - 1:
            continue
        state = clip.resample(FPS)
        path = state.qpos
        path[:, :2] -= path[0, :2].copy()
        origins.append(origin_of(name, clip))
        roots.append(path[:, :7])
        turns = 2 * np.pi
        joints.append(path[:, 7:] - turns * np.round(path[:, 7:] / turns))
        # Without targets nobody simulated it: its velocities are differences themselves.
        velocities.append(np.full_like(state.qvel, np.nan) if clip.ctrl is None else state.qvel)
    if not origins:
        raise ValueError(f"none of the clips has {SHORTEST} frames at {FPS:g} a second")
    lengths = np.array([len(r) for r in roots])
    rounded = np.round(np.concatenate(joints) / ANGLE) * ANGLE
    root = np.concatenate(roots).astype(np.float32).astype(float)
    rates = np.concatenate(velocities).astype(np.float16).astype(float)
    return Library(next(iter(bodies)), tuple(origins), lengths, root, rounded, _known(rates))


def _known(velocities: np.ndarray | None) -> np.ndarray | None:
    """Velocities (F, 6 + n), or None where none is known."""
    return None if velocities is None or np.isnan(velocities).all() else velocities


def origin_of(name: str, clip: Clip) -> Origin:
    """Where a clip came from, by its metadata and its name."""
    meta = clip.meta
    folder = name.split("/")[0] if "/" in name else ""
    problem = str(meta.get("problem") or "")
    return Origin(
        name=name,
        archive=str(meta.get("archive") or ("demonstrations" if problem else folder or "files")),
        tag=str(meta.get("sport") or problem or "other"),
        licence=str(meta.get("licence") or "unknown"),
        source=str(meta.get("source") or "unknown"),
    )


def pack_files(sources: Iterable[str | Path]) -> Library:
    """A library of clip files and folders of them. Raises ValueError for what is no clip, or two
    clips of one name."""
    named: list[tuple[str, Path]] = []
    for source in sources:
        named += [(name.removesuffix(".npz"), path) for path, name in clip_files(source)]
    names = [name for name, _ in named]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(f"two clips are named '{twice[0]}': rename one, or its folder")
    return pack((name, Clip.load(path)) for name, path in named)


def load_library(sources: Sequence[str | Path]) -> Library:
    """A packed library, or one made of clip files and folders of them.

    Raises ValueError for nothing, and for what is neither.
    """
    if not sources:
        raise ValueError("there are no clips to track: give --clips")
    if len(sources) == 1 and Path(sources[0]).is_file():
        try:
            return Library.load(sources[0])
        except ValueError as library_error:
            try:
                return pack_files(sources)
            except ValueError as clip_error:
                raise ValueError(f"{library_error}; nor a clip: {clip_error}") from clip_error
    return pack_files(sources)
