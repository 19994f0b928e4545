"""Where recordings lie: a file, a folder, or an archive (tar, also compressed, or zip).

An archive is read member by member, never unpacked to disk: names in it cannot lead anywhere, and
sizes are bounded before memory is asked for.
"""

from __future__ import annotations

import csv
import io
import lzma
import tarfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

MAX_BYTES = 256 * 2**20
"""Largest file that is read (bytes, unpacked)."""
MAX_MEMBERS = 100_000
SUFFIXES = (".amc", ".bvh", ".npz", ".json", ".txt")
"""Endings of motion files. A ``.txt`` is one when it is JSON (DeepMimic's)."""
ARCHIVES = (".tar", ".tar.xz", ".txz", ".tar.gz", ".tgz", ".tar.bz2", ".zip")
INDEX = "index.csv"
_DAMAGE = (OSError, EOFError, tarfile.TarError, zipfile.BadZipFile, lzma.LZMAError, zlib.error)


@dataclass(frozen=True)
class Recording:
    """One motion file in memory."""

    archive: str
    """Name of the archive or folder it came from; ``""`` for a file by itself."""
    name: str
    """Path inside the archive or folder, with ``/``."""
    data: bytes
    skeletons: Mapping[str, bytes] = field(default_factory=dict)
    """ASF files of the same archive, by path."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """The row of an ``index.csv``: description, fps, source, sport_tag, licence."""

    @property
    def label(self) -> str:
        return f"{self.archive}/{self.name}" if self.archive else self.name


def is_archive(path: Path) -> bool:
    """Whether a file is taken for an archive, by its name."""
    return path.name.lower().endswith(ARCHIVES)


def recordings(source: str | Path) -> Iterator[Recording]:
    """All motion files of a source, in order of their names.

    A folder gives its files, those of its folders, and those of the archives in it. Raises
    ValueError, one sentence, for a source that is not there, holds no motion or is damaged.
    """
    path = Path(source)
    if not path.exists():
        raise ValueError(f"there is nothing at {path}")
    found = False
    for recording in _of_path(path):
        found = True
        yield recording
    if not found:
        raise ValueError(f"{path} holds no motion file ({', '.join(SUFFIXES)})")


def _of_path(path: Path) -> Iterator[Recording]:
    facts = _index(path if path.is_dir() else path.parent)
    if not path.is_dir():
        if is_archive(path):
            yield from _of_archive(path, facts)
        else:
            skeletons = {
                p.name: read_file(p)
                for p in sorted(path.parent.iterdir())
                if path.suffix.lower() == ".amc" and p.suffix.lower() == ".asf"
            }
            yield Recording("", path.name, read_file(path), skeletons, facts.get(path.name, {}))
        return
    files = sorted(p for p in path.rglob("*") if p.is_file() and not p.name.startswith("."))
    skeletons = {
        p.relative_to(path).as_posix(): read_file(p) for p in files if p.suffix.lower() == ".asf"
    }
    for file in files:
        name = file.relative_to(path).as_posix()
        if is_archive(file):
            yield from _of_archive(file, facts)
        elif file.suffix.lower() in SUFFIXES:
            row = facts.get(name, facts.get(f"{path.name}/{name}", {}))
            data = read_file(file)
            if _is_motion(name, data):
                yield Recording(path.name, name, data, skeletons, row)


def _of_archive(path: Path, facts: Mapping[str, Mapping[str, str]]) -> Iterator[Recording]:
    label = path.name.split(".")[0]
    try:
        members = dict(_members(path))
    except _DAMAGE as error:
        text = str(error).strip().splitlines()
        raise ValueError(
            f"{path} is a damaged archive: {text[0] if text else 'cut off'}"
        ) from error
    skeletons = {name: data for name, data in members.items() if name.lower().endswith(".asf")}
    for name in sorted(members):
        if name.lower().endswith(SUFFIXES) and _is_motion(name, members[name]):
            short = name.removeprefix(f"{label}/")
            row = facts.get(name, facts.get(f"{label}/{short}", {}))
            yield Recording(label, short, members[name], skeletons, row)


def _is_motion(name: str, data: bytes) -> bool:
    """Whether a file among others is meant: a text or JSON file may be about anything."""
    return not name.lower().endswith((".txt", ".json")) or b'"Frames"' in data


def _members(path: Path) -> Iterator[tuple[str, bytes]]:
    """Name and content of the members that matter."""
    wanted = (*SUFFIXES, ".asf")
    total = 0
    count = 0
    if path.name.lower().endswith(".zip"):
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                if info.is_dir() or not info.filename.lower().endswith(wanted):
                    continue
                total = _room(path, total, info.file_size)
                try:
                    yield info.filename, archive.read(info)
                except (RuntimeError, NotImplementedError) as error:
                    raise ValueError(f"{path} cannot be unpacked: {error}") from error
        return
    with tarfile.open(path, "r:*") as archive:
        for info in archive:
            count += 1
            if count > MAX_MEMBERS:
                raise ValueError(f"{path} has more than {MAX_MEMBERS} members")
            if not info.isfile() or not info.name.lower().endswith(wanted):
                continue
            total = _room(path, total, info.size)
            file = archive.extractfile(info)
            if file is not None:
                yield info.name.removeprefix("./"), file.read()


def _room(path: Path, total: int, size: int) -> int:
    if size > MAX_BYTES or total + size > 8 * MAX_BYTES:
        raise ValueError(
            f"{path} unpacks to more than is sensible ({(total + size) / 2**20:.0f} MiB)"
        )
    return total + size


def read_file(path: Path) -> bytes:
    """A file's content. Raises ValueError for one that is too large or cannot be read."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"{path} is larger than {MAX_BYTES / 2**20:.0f} MiB")
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error


def _index(folder: Path) -> dict[str, dict[str, str]]:
    """Rows of the folder's ``index.csv`` by file, where there is one."""
    path = folder / INDEX
    if not path.is_file():
        return {}
    try:
        rows = csv.DictReader(io.StringIO(read_file(path).decode()))
        return {r["file"]: {k: v for k, v in r.items() if k and v} for r in rows if r.get("file")}
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a readable table: {error}") from error
