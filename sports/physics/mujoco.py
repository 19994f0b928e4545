"""C MuJoCo on native threads: the engine that runs everywhere."""

from __future__ import annotations

import os

import numpy as np
import torch
from torch import Tensor

from sports.humanoid.mjcf import build_model, firm_ground, let_rebound
from sports.physics.athletes import tree_of
from sports.physics.base import PhysicsState, default_state
from sports.physics.results import Results, Shown, show
from sports.physics.surface import CompiledGeometry
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
        felt_damping: bool = False,
        variation_blocks: int = 1,
    ) -> None:
        """``threads``: 0 for all cores. ``variation``: let the worlds differ. ``felt_damping``: let
        contacts feel the joints' damping, on firm ground (``sports.physics.variation``).
        ``variation_blocks``: the worlds differ alike in each of so many blocks."""
        self.scene = scene
        self.num_worlds = n = num_worlds
        self.threads = threads = threads or os.cpu_count() or 1
        self.device = torch.device("cpu")
        self.model = model = build_model(scene)
        self._trees = [tree_of(model, scene, agent) for agent in range(scene.num_agents)]
        self.geometry = CompiledGeometry(scene.body, self.device)
        drawn = None
        if variation is not None:
            if variation.rebound_share:
                let_rebound(model, scene, variation.rebound_links)
            drawn = draw(
                variation, n, scene.substeps, variation_seed, felt_damping, variation_blocks
            )
        elif felt_damping:
            firm_ground(model)
        self._out = out = Results(scene, n)
        self._worlds = Worlds(scene, model, self._trees, threads, out, drawn, felt_damping)
        shown = Shown(scene, self.geometry, out)
        self.qpos, self.qvel, self.mocap_pos = shown.qpos, shown.qvel, shown.mocap_pos
        self.body_pos, self.body_quat, self.body_rot = (
            shown.body_pos,
            shown.body_quat,
            shown.body_rot,
        )
        self.body_linvel, self.body_angvel = shown.body_linvel, shown.body_angvel
        self.felt, self.whole = shown.felt, shown.whole
        self.object_pos, self.object_quat = shown.object_pos, shown.object_quat
        self.object_linvel, self.object_angvel = shown.object_linvel, shown.object_angvel
        self.ground_force, self.pair_force = shown.ground_force, shown.pair_force
        self.link_force = shown.link_force
        self.ball_hits, self.ball_hit_time = shown.ball_hits, shown.ball_hit_time
        self.ball_hit_pos, self.wave_phase = shown.ball_hit_pos, shown.wave_phase
        self.bad = torch.from_numpy(out.bad)
        self.nan_worlds = 0
        self.overflow = 0

    def step(self, ctrl: Tensor) -> None:
        if self._worlds.step(ctrl.numpy()):
            self.nan_worlds += int(self.bad.sum())
            safe = default_state(self.scene, self.num_worlds, self.device)
            safe.mocap_pos = self.mocap_pos.clone()
            safe.wave_phase = None
            self.reset(self.bad, safe)

    def overflows(self) -> dict[str, int]:
        return {}

    def reset(self, mask: Tensor, state: PhysicsState) -> None:
        worlds = mask.nonzero()[:, 0]
        if worlds.numel():
            self.restart(worlds, self.prepare(state))

    def prepare(self, state: PhysicsState) -> Shown:
        """What every world would show after a reset to its row of ``state``, for ``restart``."""
        out = Results(self.scene, self.num_worlds)
        qpos, qvel = state.qpos.double().numpy(), state.qvel.double().numpy()
        show(self.scene, self._trees, qpos, qvel, out)
        out.mocap_pos[:] = state.mocap_pos.permute(1, 2, 0).numpy()
        phase = self.wave_phase if state.wave_phase is None else state.wave_phase
        out.wave_phase[:] = phase.numpy()
        return Shown(self.scene, self.geometry, out)

    def restart(self, worlds: Tensor, prepared: Shown) -> None:
        """Resets worlds (n,), by index, to what was prepared."""
        ids = worlds.numpy()
        self._out.put(ids, prepared.results)
        self._worlds.take(ids)

    def move(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        worlds = mask.nonzero()[:, 0]
        if worlds.numel():
            self._worlds.move(worlds.numpy(), qpos[worlds].numpy(), qvel[worlds].numpy())

    def extent(self, direction: Tensor) -> Tensor:
        return self.geometry.extent(self.body_pos, self.body_quat, direction)

    def extra_state(self) -> dict[str, Tensor]:
        """Double-precision state and the solver's warm start: with them a resumed run repeats
        the interrupted one bit for bit."""
        worlds, keepers = self._worlds, self._worlds.keepers
        arrays = {
            "qpos": worlds.qpos.copy(),
            "qvel": worlds.qvel.copy(),
            "qacc_warmstart": worlds.warmstart.copy(),
            "target": np.stack([keeper.target for keeper in keepers]),
            "path": np.stack([keeper.path for keeper in keepers]),
        }
        if worlds.game is not None:
            arrays["pending"] = worlds.game.pending.copy()
        return {name: torch.from_numpy(array) for name, array in arrays.items()}

    def load_extra_state(self, state: dict[str, Tensor]) -> None:
        """Restores :meth:`extra_state`; call after ``reset``."""
        names = ("qpos", "qvel", "qacc_warmstart", "target", "path")
        self._worlds.load(*(state[name].numpy() for name in names))
        if self._worlds.game is not None:
            self._worlds.game.pending[:] = state["pending"].numpy()

    def close(self) -> None:
        self.__dict__.pop("_worlds", None)
