"""How far an athlete is from a hurdle, by another computation than the program's and the gate's."""

from __future__ import annotations

import numpy as np

from sports import hurdling as task
from sports.humanoid.body import Body
from warmstart import rotation
from warmstart.outcome import link_poses


def gap_to_hurdle(body: Body, qpos: np.ndarray, height: float) -> np.ndarray:
    """(T,) distance of the athlete from the hurdle: points sampled in every shape, less the
    radius of a capsule, against the distance from a box in closed form."""
    pos, quat = link_poses(body, qpos)
    half = np.array([task.HALF_THICKNESS, task.HALF_WIDTH, height / 2])
    middle = np.array([task.FIRST_X, 0.0, height / 2])
    best = np.full(len(qpos), np.inf)
    for i, link in enumerate(body.links):
        for shape in link.shapes:
            center = np.array(shape.center)
            if shape.end is None:
                grid = np.linspace(-1.0, 1.0, 9)
                cube = np.stack(np.meshgrid(grid, grid, grid), -1).reshape(-1, 3)
                points, radius = center + cube * np.array(shape.size), 0.0
            else:
                share = np.linspace(0.0, 1.0, 41)[:, None]
                points, radius = center + share * (np.array(shape.end) - center), shape.size[0]
            for point in points:
                p_W = pos[:, i] + rotation.rotate(quat[:, i], np.tile(point, (len(qpos), 1)))
                d = np.abs(p_W - middle) - half
                outside = np.linalg.norm(np.maximum(d, 0.0), axis=1)
                best = np.minimum(best, outside + np.minimum(d.max(1), 0.0) - radius)
    return best
