"""Arrays in a zip without pickle: written atomically, read with suspicion.

``np.load`` trusts an array's header: a forged shape makes it ask for terabytes. Here sizes are
checked before anything is allocated, so that a foreign or damaged file ends in one sentence.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warmstart.atomic import write_bytes

MAX_BYTES = 256 * 2**20
"""Largest file, unpacked, that is read: three hours of motion at 30 Hz."""
_KINDS = "fiub"


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Writes named arrays and a JSON object, atomically: a full disk leaves the old file.

    Raises ValueError when ``meta`` is not JSON (NaN included), OSError when it cannot be written.
    """
    path = Path(path)
    try:
        text = json.dumps(meta, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: the metadata is not plain JSON: {error}") from error
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, meta=np.array(text), **dict(arrays))
    write_bytes(path, buffer.getvalue())


def read_npz(
    path: str | Path, required: tuple[str, ...], optional: tuple[str, ...] = (), what: str = "clip"
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Numeric arrays by name (float64) and the JSON object that :func:`write_npz` wrote.

    Arrays that are neither required nor optional are refused. Raises ValueError, one sentence
    with the file's name, for anything that is not such a file.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no {what} file at {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename: info for info in archive.infolist()}
            total = sum(info.file_size for info in members.values())
            if total > MAX_BYTES:
                raise ValueError(f"it unpacks to {total / 2**20:.0f} MiB, the limit is 256 MiB")
            names = {name.removesuffix(".npy") for name in members if name.endswith(".npy")}
            if "meta" not in names:
                raise ValueError("it has no metadata, so it is not one of ours")
            unknown = sorted(set(members) - {f"{n}.npy" for n in (*required, *optional, "meta")})
            if unknown:
                raise ValueError(f"it holds an unknown entry '{unknown[0][:40]}'")
            missing = [name for name in required if name not in names]
            if missing:
                raise ValueError(f"it lacks '{missing[0]}'")
            arrays = {name: read_member(archive, members[f"{name}.npy"]) for name in sorted(names)}
        meta = json.loads(str(arrays.pop("meta")))
        if not isinstance(meta, dict):
            raise ValueError("its metadata is not a JSON object")
    except ValueError as error:
        raise ValueError(f"{path} is not a readable {what} file: {_sentence(error)}") from error
    except (
        OSError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
        NotImplementedError,
        RuntimeError,
        SyntaxError,
        KeyError,
        RecursionError,
        MemoryError,
        OverflowError,
    ) as error:
        raise ValueError(f"{path} is not a readable {what} file: {_sentence(error)}") from error
    return arrays, meta


def _sentence(error: BaseException) -> str:
    """First line of an error's text, at most 200 characters."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """One array of a zip, after its header and its length have been found to agree.

    Raises ValueError for an array of objects, a forged shape or a member that is cut off.
    """
    with archive.open(info) as member:
        data = member.read(MAX_BYTES + 1)
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"entry '{info.filename}' has array format {version}")
    read_header = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, fortran, dtype = read_header(stream)
    text = info.filename == "meta.npy"
    if dtype.hasobject or dtype.kind not in ("U" if text else _KINDS) or dtype.subdtype:
        raise ValueError(f"entry '{info.filename}' has type {dtype}, not plain numbers")
    if text and shape != ():
        raise ValueError("its metadata is not one text")
    if any(n < 0 for n in shape) or math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError(f"entry '{info.filename}' is shorter or longer than its header says")
    flat = np.frombuffer(data, dtype=dtype, offset=stream.tell())
    array = flat.reshape(shape, order="F" if fortran else "C")
    return array if text else array.astype(np.float64)
