"""Finished shares of a long evaluation, kept in a folder until the whole of it is written.

A share's files are named by all that decides its trials (policy, task, engine, seed, commit,
versions of the engines), so a share of another evaluation is never taken for one of this: first
its recordings, ``NAME-TRIAL.npz``, then, when they are whole, ``NAME.npz``.
"""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rl import provenance
from rl.policy import Policy
from rl.recording import Recording
from rl.trials import Played, Share
from warmstart.npz import read_npz, write_npz

_FIGURES = ("overflow", "nan_worlds", "timestep", "substeps")


class KeptShares:
    """The folder; ``None`` keeps nothing. It is made when the first share is kept."""

    def __init__(self, folder: Path | None, policy: Policy) -> None:
        self._folder = folder
        self._facts: dict[str, Any] = {}
        if folder is not None:
            self._facts = {
                "policy": policy.metadata["sha256"],
                "prior": policy.prior.digest if policy.prior is not None else None,
                "commit": provenance.commit(),
                "versions": provenance.versions(),
            }

    def find(self, share: Share) -> Played | None:
        """What a share came to, if it is here and whole."""
        path = self._path(share)
        if path is None or not path.is_file():
            return None
        try:
            arrays, about = read_npz(path, ("table",), what="share")
            table = arrays["table"]
            trials = {name: table[i] for i, name in enumerate(about["columns"])}
            if table.shape != (len(trials), share.trials):
                return None
            recordings = {t: Recording.load(_beside(path, t)) for t in about["recordings"]}
            return Played(trials, recordings, **{k: about[k] for k in _FIGURES})
        except (ValueError, KeyError, IndexError, TypeError):
            return None  # not one of ours, or damaged: it is played again

    def keep(self, share: Share, played: Played) -> None:
        """Writes a finished share, atomically. Raises OSError when it cannot be written."""
        path = self._path(share)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            for trial, recording in played.recordings.items():
                recording.save(_beside(path, trial))
            figures = {k: getattr(played, k) for k in _FIGURES}
            about = figures | {"columns": list(played.trials), "recordings": [*played.recordings]}
            table = np.stack([np.asarray(x, dtype=float) for x in played.trials.values()])
            write_npz(path, {"table": table}, about)

    def _path(self, share: Share) -> Path | None:
        if self._folder is None:
            return None
        facts = json.dumps(self._facts | asdict(share), sort_keys=True, default=str)
        return self._folder / f"{hashlib.sha256(facts.encode()).hexdigest()[:24]}.npz"


def _beside(path: Path, trial: int) -> Path:
    return path.with_name(f"{path.stem}-{trial}.npz")


def forget(folder: Path) -> None:
    """Removes the shares in a folder, and the folder if nothing else is in it."""
    for path in folder.glob("*.npz"):
        path.unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()
