"""C MuJoCo on native threads: the engine that runs everywhere.

The worlds are shared out to two Python threads, each with its own native ones: what Python does
for one half of the worlds after a substep costs nothing while the other half is being simulated.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from sports.humanoid.mjcf import build_model
from sports.physics.base import Geometry, PhysicsState, default_state, diverged
from sports.physics.kinematics import Kinematics
from sports.physics.results import Display, Results, Shown
from sports.physics.variation import Variation, draw
from sports.physics.worlds import Worlds
from sports.scene import Scene


class MujocoPhysics:
    """The ``mujoco`` engine; see :class:`sports.physics.base.Physics` for the tensors."""

    engine = "mujoco"

    def __init__(
        self,
        scene: Scene,
        num_worlds: int,
        threads: int = 0,
        variation: Variation | None = None,
        variation_seed: int = 0,
    ) -> None:
        """``threads``: 0 for all cores. ``variation``: let the worlds differ."""
        self.scene = scene
        self.num_worlds = n = num_worlds
        self.threads = threads = threads or os.cpu_count() or 1
        self.device = torch.device("cpu")
        self.model = model = build_model(scene)
        self._kinematics = kinematics = Kinematics(model, scene.body)
        self.geometry = Geometry(scene.body, self.device)
        out = Results.zeros(scene, n)
        drawn = None
        if variation is not None:
            drawn = draw(variation, n, scene.substeps, variation_seed)
        self._out, self._display = out, Display(scene, kinematics, out)
        self._parts: list[tuple[slice, Worlds]] = []
        for rows, native in _share_out(n, threads):
            own = drawn.of(rows) if drawn is not None else None
            worlds = Worlds(scene, model, kinematics, native, out.of(rows), own)
            self._parts.append((rows, worlds))
        self._pool = ThreadPoolExecutor(len(self._parts), "mujoco")
        shown = Shown(scene, self.geometry, out)
        self.qpos, self.qvel, self.mocap_pos = shown.qpos, shown.qvel, shown.mocap_pos
        self.body_pos, self.body_quat, self.body_rot = (
            shown.body_pos,
            shown.body_quat,
            shown.body_rot,
        )
        self.body_linvel, self.body_angvel, self.felt = (
            shown.body_linvel,
            shown.body_angvel,
            shown.felt,
        )
        self.object_pos, self.object_quat = shown.object_pos, shown.object_quat
        self.object_linvel, self.object_angvel = shown.object_linvel, shown.object_angvel
        self.ground_force, self.pair_force = shown.ground_force, shown.pair_force
        self.bad = torch.zeros(n, dtype=torch.bool)
        self.nan_worlds = 0
        self.overflow = 0

    def step(self, ctrl: Tensor) -> None:
        targets = ctrl.numpy()
        self._each(lambda rows, worlds: worlds.step(targets[rows]))
        self.bad = diverged(self.qpos, self.qvel)
        if self.bad.any():
            self.nan_worlds += int(self.bad.sum())
            safe = default_state(self.scene, self.num_worlds, self.device)
            safe.mocap_pos = self.mocap_pos.clone()
            self.reset(self.bad, safe)

    def reset(self, mask: Tensor, state: PhysicsState) -> None:
        ids = np.flatnonzero(mask.numpy())
        if ids.size:
            rows = [x.numpy()[ids] for x in (state.qpos, state.qvel, state.mocap_pos)]
            self._put(ids, *rows)
            self._display.state(ids, *rows)
            self._out.ground_force[..., ids] = 0.0
            self._out.pair_force[..., ids] = 0.0

    def prepare(self, state: PhysicsState) -> Shown:
        """What every world would show after a reset to its row of ``state``, for ``restart``:
        for all together this costs little more than for a few."""
        out = Results.zeros(self.scene, self.num_worlds)
        arrays = (x.numpy() for x in (state.qpos, state.qvel, state.mocap_pos))
        Display(self.scene, self._kinematics, out).state(slice(None), *arrays)
        return Shown(self.scene, self.geometry, out)

    def restart(self, worlds: Tensor, prepared: Shown) -> None:
        """Resets worlds (n,), by index, to what was prepared."""
        ids, out = worlds.numpy(), prepared.results
        self._put(ids, out.qpos[ids], out.qvel[ids], out.mocap_pos[ids])
        self._out.take(ids, out)

    def _put(self, ids: np.ndarray, *rows: np.ndarray) -> None:
        """States (n, ...) of worlds, not yet shown."""
        for part, worlds in self._parts:
            own = (ids >= part.start) & (ids < part.stop)
            worlds.put(ids[own] - part.start, *(x[own] for x in rows))

    def extent(self, direction: Tensor) -> Tensor:
        return self.geometry.extent(self.body_pos, self.body_quat, direction)

    def extra_state(self) -> dict[str, Tensor]:
        """Double-precision state and the solver's warm start: with them a resumed run repeats
        the interrupted one bit for bit."""
        parts = [worlds for _, worlds in self._parts]
        keepers = [[k.expected for k in worlds.keepers] for worlds in parts]
        arrays = {
            "qpos": np.concatenate([w.qpos for w in parts]),
            "qvel": np.concatenate([w.qvel for w in parts]),
            "qacc_warmstart": np.concatenate([w.warmstart for w in parts]),
            "target": np.concatenate([[k.target for k in ks] for ks in keepers], axis=1),
            "path": np.concatenate([[k.path for k in ks] for ks in keepers], axis=1),
        }
        return {name: torch.from_numpy(array) for name, array in arrays.items()}

    def load_extra_state(self, state: dict[str, Tensor]) -> None:
        """Restores :meth:`extra_state`; call after ``reset``."""
        arrays = {name: value.numpy() for name, value in state.items()}
        for rows, worlds in self._parts:
            worlds.load(
                arrays["qpos"][rows],
                arrays["qvel"][rows],
                arrays["qacc_warmstart"][rows],
                arrays["target"][:, rows],
                arrays["path"][:, rows],
            )

    def close(self) -> None:
        self._pool.shutdown()
        self._parts = []

    def _each(self, work: Callable[[slice, Worlds], None]) -> None:
        """Does it for every part, at the same time."""
        others = [self._pool.submit(work, *part) for part in self._parts[1:]]
        work(*self._parts[0])
        for other in others:
            other.result()


def _share_out(num_worlds: int, threads: int) -> list[tuple[slice, int]]:
    """Worlds and native threads of each part, in proportion."""
    if min(num_worlds, threads) < 2:
        return [(slice(0, num_worlds), threads)]
    first = threads // 2
    split = max(1, num_worlds * first // threads)
    return [(slice(0, split), first), (slice(split, num_worlds), threads - first)]
