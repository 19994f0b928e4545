"""The record of a long run over files: what became of each, so that a stopped run can go on."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Protocol, TypeVar

from warmstart.atomic import write_json


class Row(Protocol):
    """What became of one file."""

    file: str


T = TypeVar("T", bound=Row)


def write_record(path: Path, kind: str, entries: Iterable[T], before: dict[str, T]) -> None:
    """Writes the record of a ``kind`` of run: these entries, and those of files that this run has
    not come to."""
    files = {**before, **{e.file: e for e in entries}}
    write_json(path, {"format": kind, "files": [e.__dict__ for e in files.values()]})


def read_record(path: Path, kind: str, entry: Callable[..., T]) -> dict[str, T]:
    """Entries by file; none where there is no record of that ``kind`` that can be read."""
    try:
        value: Any = json.loads(path.read_text())
        if value["format"] != kind:
            return {}
        return {row["file"]: entry(**row) for row in value["files"]}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
