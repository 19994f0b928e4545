"""One physics protocol, three engines: ``mujoco`` (CPU threads), ``warp`` (GPU), ``drake``."""

from __future__ import annotations

from sports.physics.base import Geometry, Physics, PhysicsState, default_state
from sports.scene import Scene

ENGINES = ("mujoco", "warp", "drake")

__all__ = ["ENGINES", "Geometry", "Physics", "PhysicsState", "default_state", "make_physics"]


def make_physics(engine: str, scene: Scene, num_worlds: int, **options: object) -> Physics:
    """A batch of ``num_worlds`` worlds of ``scene`` on an engine.

    Options: ``mujoco`` takes ``threads``; ``warp`` takes ``device``; ``drake`` takes
    ``timestep``; ``mujoco`` and ``warp`` take ``variation`` and ``variation_seed``. Raises
    ValueError for an unknown engine or world count, RuntimeError when the engine cannot run here
    (its package or its GPU is missing).
    """
    if num_worlds < 1:
        raise ValueError(f"the number of worlds must be at least 1, not {num_worlds}")
    if engine == "mujoco":
        try:
            from sports.physics.mujoco import MujocoPhysics
        except ImportError as error:
            raise RuntimeError(
                f"engine 'mujoco' needs numba (pip install numba): {error}"
            ) from error
        return MujocoPhysics(scene, num_worlds, **options)  # type: ignore[arg-type]
    if engine == "warp":
        try:
            from sports.physics.warp import WarpPhysics
        except ImportError as error:
            raise RuntimeError(
                f"engine 'warp' needs the extra [gpu] (pip install 'olympics-opt[gpu]'): {error}"
            ) from error
        return WarpPhysics(scene, num_worlds, **options)  # type: ignore[arg-type]
    if engine == "drake":
        try:
            from sports.physics.drake import DrakePhysics
        except ImportError as error:
            raise RuntimeError(
                f"engine 'drake' needs drake (pip install drake): {error}"
            ) from error
        return DrakePhysics(scene, num_worlds, **options)  # type: ignore[arg-type]
    raise ValueError(f"unknown engine '{engine}'; known: {', '.join(ENGINES)}")
