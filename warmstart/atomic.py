"""Files that are either whole or not there: written beside their place, then moved onto it."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any


def write_bytes(path: str | Path, data: bytes) -> Path:
    """Writes a file atomically, making its folder. Raises OSError; the old file then survives."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def write_text(path: str | Path, text: str) -> Path:
    """Writes UTF-8 text atomically."""
    return write_bytes(path, text.encode())


def write_json(path: str | Path, value: Any, indent: int | None = 2) -> Path:
    """Writes strict JSON atomically: a number that is not finite becomes null. ``indent`` None: on
    one line, for long lists of numbers."""
    separators = (",", ":") if indent is None else None
    text = json.dumps(_plain(value), indent=indent, separators=separators, allow_nan=False)
    return write_text(path, text + "\n")


def prepare(path: str | Path) -> Path:
    """Makes the folder of a file that will take long to earn. Raises ValueError for a folder in
    its place and for the card of weights, without which they are lost, OSError where nothing can be
    written."""
    path = Path(path)
    weights = path.with_suffix(".safetensors")
    if path.suffix == ".json" and weights.is_file():
        raise ValueError(f"{path} is the card of {weights.name}: give another file to write")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise ValueError(f"{path} is a folder, not a file to write")
    return path


def _plain(value: Any) -> Any:
    """Numpy and torch scalars and arrays, tuples and paths as plain JSON values."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, (str, bool, int)) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return str(value)
