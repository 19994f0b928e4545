"""Checkpoints of a run: named tensors in safetensors shards, and a JSON state beside them.

``RUN/checkpoints/step_000123/`` holds ``state.json`` and ``rank0_000.safetensors``, ... A
checkpoint is written under a temporary name and renamed when it is whole, so whoever finds
``step_*`` finds all of it; the last two are kept.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from warmstart.atomic import write_bytes

FORMAT = "olympics-opt checkpoint 1"
SHARD_BYTES = 15 * 2**20
"""No file of a checkpoint is larger."""
_HEADER_ROOM = 2**18
KEEP = 2


class CheckpointError(RuntimeError):
    """A checkpoint could not be written or read; the message is a sentence with the remedy."""


def checkpoints(run: Path) -> list[Path]:
    """The whole checkpoints of a run, oldest first."""
    return sorted((run / "checkpoints").glob("step_*"))


def ranks_of(path: Path) -> int:
    """Processes whose part is in a checkpoint. Rank 0's part alone is enough to go on from."""
    found = 0
    while (path / f"rank{found}.json").is_file():
        found += 1
    return max(found, 1)


def save_checkpoint(
    run: Path,
    iteration: int,
    state: dict[str, Any],
    tensors: dict[str, Tensor],
    rank: int = 0,
    barrier: Any = None,
) -> Path:
    """Writes ``RUN/checkpoints/step_ITERATION`` and removes all but the last two.

    Args:
        run: the run's folder.
        iteration: names the checkpoint.
        state: plain JSON (rank 0's is kept).
        tensors: this rank's tensors by name, any dtype and device.
        rank: of this process; every rank calls this at the same time.
        barrier: waits for all ranks, or None when there is one.

    Raises CheckpointError when the disk is full or not writable; earlier checkpoints survive.
    """
    folder = run / "checkpoints"
    final = folder / f"step_{iteration:07d}"
    part = folder / f".step_{iteration:07d}.part"
    try:
        if rank == 0:
            for stale in folder.glob(".step_*.part"):  # of a run that was killed while saving
                shutil.rmtree(stale, ignore_errors=True)
            part.mkdir(parents=True)
        if barrier is not None:
            barrier()
        index = _write_shards(part, rank, tensors)
        write_bytes(part / f"rank{rank}.json", json.dumps(index).encode())
        if barrier is not None:
            barrier()
        if rank == 0:
            text = json.dumps({"format": FORMAT, "iteration": iteration, **state}, indent=1)
            write_bytes(part / "state.json", text.encode())
            if final.exists():  # saved before at this iteration, for instance by a signal
                shutil.rmtree(final)
            os.replace(part, final)
            _sync_folder(folder)
            for old in checkpoints(run)[:-KEEP]:
                shutil.rmtree(old, ignore_errors=True)
        if barrier is not None:  # nobody looks for it before it has its name
            barrier()
    except OSError as error:
        shutil.rmtree(part, ignore_errors=True)
        have = checkpoints(run)
        kept = f"the last checkpoint, {have[-1]}, is whole" if have else "there is no earlier one"
        raise CheckpointError(
            f"the checkpoint of iteration {iteration} could not be written under {folder} "
            f"({error.strerror or error}); {kept}: free some space and go on with --resume"
        ) from error
    return final


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _write_shards(folder: Path, rank: int, tensors: dict[str, Tensor]) -> dict[str, Any]:
    """Packs tensors, large ones in pieces, into files of at most SHARD_BYTES; returns the index."""
    index: dict[str, Any] = {"tensors": {}, "sha256": {}}
    shard: dict[str, Tensor] = {}
    room = limit = SHARD_BYTES - _HEADER_ROOM

    def flush() -> None:
        if shard:
            name = f"rank{rank}_{len(index['sha256']):03d}.safetensors"
            data = save(shard)
            write_bytes(folder / name, data)
            index["sha256"][name] = hashlib.sha256(data).hexdigest()
            shard.clear()

    for name, tensor in tensors.items():
        flat = tensor.detach().cpu().contiguous().flatten()
        entry = {"shape": list(tensor.shape), "pieces": 0}
        per_piece = max(1, limit // flat.element_size())
        for piece in flat.split(per_piece) if flat.numel() else (flat,):
            size = piece.numel() * piece.element_size() + 200  # its line in the header
            if size > room:
                flush()
                room = limit
            shard[f"{name}#{entry['pieces']}"] = piece.clone()
            entry["pieces"] += 1
            room -= size
        index["tensors"][name] = entry
    flush()
    return index


def load_checkpoint(path: Path, rank: int = 0) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """State and this rank's tensors (CPU) of one checkpoint folder.

    Raises CheckpointError for anything missing, truncated or altered.
    """
    state = read_state(path)
    try:
        index = json.loads((path / f"rank{rank}.json").read_text())
        pieces: dict[str, Tensor] = {}
        for name, digest in index["sha256"].items():
            if hashlib.sha256((path / name).read_bytes()).hexdigest() != digest:
                raise CheckpointError(f"{path / name} is damaged: its content has changed")
            pieces |= load_file(path / name)
        tensors = {}
        for name, entry in index["tensors"].items():
            flat = torch.cat([pieces[f"{name}#{i}"] for i in range(entry["pieces"])])
            if flat.numel() != math.prod(entry["shape"]):
                raise CheckpointError(f"{path} is damaged: '{name}' has lost some numbers")
            tensors[name] = flat.reshape(entry["shape"])
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"the checkpoint {path} cannot be read ({error}): remove it to go on from an earlier "
            "one"
        ) from error
    return state, tensors


def read_state(path: Path) -> dict[str, Any]:
    """The JSON state of a checkpoint folder. Raises CheckpointError if it is not one."""
    try:
        state = json.loads((path / "state.json").read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} is not a whole checkpoint ({error})") from error
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise CheckpointError(f"{path} is not a checkpoint of this project")
    return state
