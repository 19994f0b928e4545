"""A recorded episode: every state, action, reward term and force of one world, as an npz.

It is cut from a ``Tape``, which runs along with all worlds of an environment.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sports.env import Env, make_scene
from sports.scene import Scene
from warmstart.atomic import write_bytes

FORMAT = "olympics-opt recording 1"


@dataclass(eq=False)
class Recording:
    """T control steps of one world. Row t holds what action t led to; the start is not a row."""

    task: str
    options: dict[str, Any]
    """The task's options."""
    qpos: np.ndarray
    """(T, nq) float32, after the step and before any reset."""
    qvel: np.ndarray
    """(T, nv)"""
    mocap_pos: np.ndarray
    """(T, M, 3)"""
    action: np.ndarray
    """(T, A, act), as the policy gave them, unclipped."""
    reward: np.ndarray
    """(T, A), unscaled."""
    terms: dict[str, np.ndarray]
    """(T, A) reward terms by name."""
    ground_force: np.ndarray
    """(T, A, B, 3) N, world frame."""
    metrics: dict[str, float]
    """Episode metrics; NaN where undefined."""
    seed: int
    world: int
    dt: float
    """Seconds between rows."""
    engine: str = "mujoco"
    strength: str = "paper"
    limits: str = "paper"
    timestep_divisor: int = 1
    shown: dict[str, np.ndarray] = field(default_factory=dict)
    """(T, ...) what pictures need to know of the field in this world, by name (``Task.shown``)."""
    meta: dict[str, Any] = field(default_factory=dict)
    """Plain JSON: commit, policy sha256, ..."""

    @cached_property
    def scene(self) -> Scene:
        """The scene it happened in, built again from the task and its options."""
        return make_scene(
            self.task,
            strength=self.strength,  # type: ignore[arg-type]
            limits=self.limits,  # type: ignore[arg-type]
            options=self.options,
            timestep_divisor=self.timestep_divisor,
        )

    def save(self, path: str | Path) -> None:
        """Writes an npz (no pickle)."""
        path = Path(path)
        names = ("task", "options", "metrics", "seed", "world", "dt", "engine", "strength")
        meta = {name: getattr(self, name) for name in names}
        meta |= {"format": FORMAT, "limits": self.limits, "meta": self.meta}
        meta |= {"timestep_divisor": self.timestep_divisor}
        meta |= {"terms": list(self.terms), "shown": list(self.shown)}
        arrays = {name: np.asarray(getattr(self, name), np.float32) for name in _ARRAYS}
        for prefix, tables in (("term", self.terms), ("shown", self.shown)):
            arrays |= {
                f"{prefix}_{i}": np.asarray(x, np.float32) for i, x in enumerate(tables.values())
            }
        data = io.BytesIO()
        np.savez_compressed(data, meta=np.array(json.dumps(meta)), **arrays)  # type: ignore[arg-type]
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, data.getvalue())

    @staticmethod
    def load(path: str | Path) -> Recording:
        """Reads an npz. Raises ValueError for anything that is not a recording."""
        try:
            with np.load(Path(path), allow_pickle=False) as data:
                meta = json.loads(str(data["meta"]))
                if not isinstance(meta, dict) or meta.pop("format", None) != FORMAT:
                    raise ValueError("it has another format")
                terms = {n: data[f"term_{i}"] for i, n in enumerate(meta.pop("terms"))}
                # Recordings of earlier versions show nothing.
                names = enumerate(meta.pop("shown", ()))
                shown = {n: data[f"shown_{i}"] for i, n in names}
                arrays = {name: data[name] for name in _ARRAYS}
            tables = (*arrays.values(), *terms.values(), *shown.values())
            if len({len(x) for x in tables}) != 1:
                raise ValueError("its arrays differ in length")
            return Recording(**meta, **arrays, terms=terms, shown=shown)
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"'{path}' is not a recording of this project: {error}") from error


_ARRAYS = ("qpos", "qvel", "mocap_pos", "action", "reward", "ground_force")


RECORDING_BYTES = 2 * 2**30
"""Episodes are kept for recordings up to this much memory; later ones are only counted."""


class Tape:
    """Every step of every world, on the host, up to RECORDING_BYTES."""

    def __init__(self, env: Env, on: bool) -> None:
        self.env, self.on = env, on
        self.steps: list[dict[str, np.ndarray]] = []
        self._bytes = 0
        env.keep_snapshot = on

    def add(self, action: torch.Tensor, result: Any) -> None:
        """Keeps the step just taken."""
        if not self.on or self._bytes > RECORDING_BYTES:
            return
        tensors: Mapping[str, torch.Tensor] = {
            **self.env.final_snapshot,
            "action": action,
            "reward": result.reward,
            **{f"terms/{n}": x for n, x in result.terms.items()},
        }
        # Copies: an engine may overwrite its tensors in the next step.
        row = {n: np.array(x.cpu().numpy(), dtype=np.float32) for n, x in tensors.items()}
        self._bytes += sum(x.nbytes for x in row.values())
        self.steps.append(row)

    def cut(
        self, world: int, start: int, end: int, metrics: dict[str, float], facts: Mapping[str, Any]
    ) -> Recording:
        """The steps [start, end) of one world; ``facts`` are the other fields of a Recording."""
        rows: dict[str, Any]
        rows = {n: np.stack([s[n][world] for s in self.steps[start:end]]) for n in self.steps[0]}
        terms = {n[6:]: rows.pop(n) for n in list(rows) if n.startswith("terms/")}
        shown = {n[6:]: rows.pop(n) for n in list(rows) if n.startswith("shown/")}
        return Recording(
            terms=terms,
            shown=shown,
            metrics=metrics,
            world=int(world),
            dt=self.env.physics.scene.control_timestep,
            **facts,
            **rows,
        )
