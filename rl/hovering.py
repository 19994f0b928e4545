"""Clips in which the athlete hovers: off the ground, and not falling.

Who stood on a chair, on steps or on a hand rail was recorded without it, and a clip may be wrong
in time. Nobody can follow either: without contact the centre of mass falls with 9.81 m/s^2.
"""

from __future__ import annotations

import numpy as np
import torch

from rl.motion import link_motion
from sports.humanoid.body import load_body
from sports.physics.base import GRAVITY, Geometry
from warmstart import rotation
from warmstart.library import FPS, Library

AIRBORNE = 0.05
"""m; who is higher than this in three frames touched nothing in between."""
TOLERANCE = 5.0
"""m/s^2, between the acceleration of the centre of mass and that of a fall. Recordings miss by
1 to 3, simulated clips by less than 1."""
LONGEST = 0.15
"""Seconds of hovering that a clip may have: a frame or two are noise."""


def hovering(body_name: str, qpos: np.ndarray, fps: float) -> float:
    """Seconds of a path (T, 7 + n) in which the athlete's lowest point is above ``AIRBORNE`` in
    three frames one after the other and the centre of mass does not fall."""
    if len(qpos) < 3:
        return 0.0
    body = load_body(body_name)
    geometry = Geometry(body, "cpu")
    motion = link_motion(body, qpos, fps)
    pos, quat = motion.pos[: len(qpos)], motion.quat[: len(qpos)]
    down = torch.tensor([0.0, 0.0, -1.0])
    places = torch.tensor(pos, dtype=torch.float32), torch.tensor(quat, dtype=torch.float32)
    lowest = -geometry.extent(*places, down).amax(-1).numpy()
    mass, center = (x.double().numpy() for x in (geometry.mass, geometry.center))
    arms = rotation.rotate(quat, np.broadcast_to(center, pos.shape))
    com = np.einsum("b,tbk->tk", mass / mass.sum(), pos + arms)
    acceleration = (com[2:] - 2.0 * com[1:-1] + com[:-2]) * fps**2
    miss = np.linalg.norm(acceleration + [0.0, 0.0, GRAVITY], axis=1)
    high = lowest > AIRBORNE
    airborne = high[:-2] & high[1:-1] & high[2:]
    return float((airborne & (miss > TOLERANCE)).sum()) / fps


def supported(library: Library) -> tuple[Library, list[tuple[str, float]]]:
    """The clips that hover for at most ``LONGEST``, and names and seconds of hovering of those
    left out. Raises ValueError where no clip is left."""
    seconds = [hovering(library.body, library.qpos(c), FPS) for c in range(len(library.lengths))]
    kept = [c for c, s in enumerate(seconds) if s <= LONGEST]
    out = [(library.origins[c].name, s) for c, s in enumerate(seconds) if s > LONGEST]
    return library.chosen(kept), out
