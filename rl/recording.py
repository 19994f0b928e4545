"""A recorded episode: every state, action, reward term and force of one world, as an npz."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sports.env import make_scene
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
        meta |= {"timestep_divisor": self.timestep_divisor, "terms": list(self.terms)}
        arrays = {name: np.asarray(getattr(self, name), np.float32) for name in _ARRAYS}
        arrays |= {
            f"term_{i}": np.asarray(x, np.float32) for i, x in enumerate(self.terms.values())
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
                arrays = {name: data[name] for name in _ARRAYS}
            if len({len(x) for x in (*arrays.values(), *terms.values())}) != 1:
                raise ValueError("its arrays differ in length")
            return Recording(**meta, **arrays, terms=terms)
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"'{path}' is not a recording of this project: {error}") from error


_ARRAYS = ("qpos", "qvel", "mocap_pos", "action", "reward", "ground_force")
