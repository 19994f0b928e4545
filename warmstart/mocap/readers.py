"""Which reader a file is for, and the one way in: :func:`read_capture`."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from pathlib import PurePosixPath

import numpy as np

from warmstart.mocap import skillmimic, smpl
from warmstart.mocap.asf import read_asf_amc
from warmstart.mocap.bvh import read_bvh
from warmstart.mocap.capture import Capture
from warmstart.mocap.deepmimic import read_deepmimic
from warmstart.mocap.skeleton import JointMap
from warmstart.mocap.source import MAX_BYTES, Recording
from warmstart.mocap.units import check_units
from warmstart.npz import read_member

_BROKEN = (
    *(OSError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError),
    *(SyntaxError, KeyError, IndexError, RecursionError, MemoryError, OverflowError, TypeError),
    *(struct.error, np.linalg.LinAlgError),
)
"""What the libraries below raise for a damaged file, beside ValueError."""


def read_capture(
    recording: Recording, fps: float | None = None, maps: tuple[JointMap, ...] = ()
) -> Capture:
    """The motion of a file. Raises ValueError, one sentence that names the file.

    ``fps``: frame rate of the recording where the file does not say it; a file's own rate and that
    of an ``index.csv`` count less.
    """
    fps = fps or _fps(recording)
    name = PurePosixPath(recording.name)
    suffix = name.suffix.lower()
    try:
        if suffix == ".npz":
            capture = _npz(recording.data, fps)
        elif suffix == ".bvh":
            capture = read_bvh(_text(recording.data), maps, fps)
        elif suffix == ".amc":
            asf = _text(recording.skeletons[_skeleton_of(recording)])
            capture = read_asf_amc(asf, _text(recording.data), fps, maps)
        elif suffix in (".json", ".txt"):
            capture = read_deepmimic(_text(recording.data), fps)
        else:
            raise ValueError(f"'{suffix}' is no format of motions that is known")
        check_units(capture)
    except ValueError as error:
        raise ValueError(f"{recording.label}: {str(error).splitlines()[0][:300]}") from error
    except _BROKEN as error:
        text = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise ValueError(f"{recording.label}: the file is damaged: {text}") from error
    meta = {**capture.meta, **_origin(recording)}
    object.__setattr__(capture, "meta", meta)
    return capture


def _origin(recording: Recording) -> dict[str, str]:
    """What a clip's metadata says about where it came from."""
    meta = {"file": recording.label}
    for ours, theirs in (
        ("source", "source"),
        ("description", "description"),
        ("sport", "sport_tag"),
        ("licence", "licence"),
    ):
        if recording.facts.get(theirs):
            meta[ours] = recording.facts[theirs]
    return meta


def _fps(recording: Recording) -> float | None:
    """The frame rate of an index, for files that do not say their own."""
    text = recording.facts.get("fps")
    if not text or not recording.name.lower().endswith(".amc"):
        return None
    try:
        return float(text)
    except ValueError as error:
        raise ValueError(f"{recording.label}: the index gives '{text[:20]}' for fps") from error


def _skeleton_of(recording: Recording) -> str:
    """The ASF file of an AMC file: of its subject (``02.asf`` of ``02_01.amc``), or the one."""
    stem = PurePosixPath(recording.name).stem
    by_stem = {PurePosixPath(path).stem: path for path in recording.skeletons}
    for candidate in (stem, stem.rpartition("_")[0]):
        if candidate and candidate in by_stem:
            return by_stem[candidate]
    if len(by_stem) == 1:
        return next(iter(by_stem.values()))
    raise ValueError(f"there is no ASF file beside it ({stem.rpartition('_')[0] or stem}.asf)")


def _text(data: bytes) -> str:
    if b"\0" in data[:4096]:
        raise ValueError("it is not a text file")
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _npz(data: bytes, fps: float | None) -> Capture:
    arrays = read_arrays(data)
    if skillmimic.ENTRIES[0] in arrays:
        return skillmimic.read_skillmimic(arrays, fps)
    if smpl.is_smpl(set(arrays)):
        return smpl.read_smpl_motion(arrays, fps)
    some = ", ".join(sorted(arrays)[:4]) or "none that is known"
    raise ValueError(f"its entries ({some[:80]}) are no layout of motions that is known")


def read_arrays(data: bytes) -> dict[str, np.ndarray]:
    """The numeric entries of an npz that a reader knows, as float64. No pickle is ever read.

    Raises ValueError for a file that is not a zip of arrays, or unpacks to too much.
    """
    if not data.startswith(b"PK"):
        what = "a pickle, which can run code, is refused" if data[:1] == b"\x80" else "damaged?"
        raise ValueError(f"it is not a zip of arrays ({what})")
    wanted = {*smpl.ENTRIES, *skillmimic.ENTRIES}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {i.filename: i for i in archive.infolist()}
        chosen = [i for n, i in members.items() if n.removesuffix(".npy") in wanted]
        total = sum(i.file_size for i in chosen)
        if total > MAX_BYTES:
            raise ValueError(f"it unpacks to {total / 2**20:.0f} MiB, the limit is 256 MiB")
        return {i.filename.removesuffix(".npy"): read_member(archive, i) for i in chosen}
