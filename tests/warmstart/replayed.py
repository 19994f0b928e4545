"""A clip's PD targets put into the engine again, state by state."""

from __future__ import annotations

import numpy as np
import torch

from sports.humanoid.body import Body
from sports.physics import PhysicsState, make_physics
from sports.scene import humanoid_scene
from warmstart.clip import Clip


def next_states(clip: Clip, body: Body) -> np.ndarray:
    """(T - 1, 7 + n) qpos to which the targets of each frame but the last lead from its state.

    Contact forces start cold here: they agree with those of the run to the solver's tolerance only.
    """
    assert clip.ctrl is not None
    worlds = clip.num_frames - 1
    physics = make_physics("mujoco", humanoid_scene(body), worlds)
    state = PhysicsState(
        torch.tensor(np.float32(clip.qpos[:-1])),
        torch.tensor(np.float32(clip.qvel[:-1])),
        torch.zeros(worlds, 0, 3),
    )
    physics.reset(torch.ones(worlds, dtype=torch.bool), state)
    physics.step(torch.tensor(np.float32(clip.ctrl[:-1])))
    reached = physics.qpos.numpy().copy()
    physics.close()
    return reached
