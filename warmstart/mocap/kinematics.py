"""Forward kinematics of our body over many frames, and the points of it that can touch a floor."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sports.humanoid.body import Body, support_points
from warmstart import rotation


@dataclass(frozen=True, eq=False)
class Frames:
    """Where every link is: ``origin`` (T, B, 3) in m, ``turn`` (T, B, 3, 3) world <- link."""

    origin: np.ndarray
    turn: np.ndarray


class Chain:
    """The tree of links of a body, with everything about it that is constant."""

    def __init__(self, body: Body) -> None:
        self.body = body
        self.names = body.link_names
        self.index = {name: i for i, name in enumerate(self.names)}
        self.parent = body.parents()
        self.offset = np.array([link.offset for link in body.links])
        self.rest = body.zero_pose_origins()
        owners, points, radii = [], [], []
        for i, link in enumerate(body.links):
            for shape in link.shapes:
                for point, radius in support_points(shape):
                    owners.append(i)
                    points.append(point)
                    radii.append(radius)
        self.surface_link = np.array(owners)
        self.surface_point = np.array(points)
        self.surface_radius = np.array(radii)

    @cached_property
    def ancestors(self) -> list[list[int]]:
        """For each link, its parent, the parent's parent and so on up to the root."""
        out: list[list[int]] = []
        for parent in self.parent:
            out.append([] if parent < 0 else [int(parent), *out[parent]])
        return out

    def length(self, a: str, b: str) -> float:
        """Distance of two joints in the zero pose (m)."""
        return float(np.linalg.norm(self.rest[self.index[b]] - self.rest[self.index[a]]))

    def frames(self, root: np.ndarray, local: np.ndarray) -> Frames:
        """From the root's position (T, 3) and ``local`` (T, B, 3, 3), parent <- link.

        The root's entry of ``local`` is its rotation in the world.
        """
        origin = np.empty((*local.shape[:2], 3))
        turn = np.empty_like(local)
        for i, parent in enumerate(self.parent):
            if parent < 0:
                origin[:, i], turn[:, i] = root, local[:, i]
            else:
                origin[:, i] = origin[:, parent] + turn[:, parent] @ self.offset[i]
                turn[:, i] = turn[:, parent] @ local[:, i]
        return Frames(origin, turn)

    def local(self, turn: np.ndarray) -> np.ndarray:
        """(T, B, 3, 3) parent <- link of world rotations; the root's stays as it is."""
        out = turn.copy()
        for i, parent in enumerate(self.parent):
            if parent >= 0:
                out[:, i] = np.swapaxes(turn[:, parent], -1, -2) @ turn[:, i]
        return out

    def heights(self, frames: Frames) -> np.ndarray:
        """(T, S) height of the lowest point of each swept ball of the surface (m)."""
        z = frames.turn[:, self.surface_link, 2]
        height = frames.origin[:, self.surface_link, 2] + (z * self.surface_point).sum(-1)
        return height - self.surface_radius


def skew(vector: np.ndarray) -> np.ndarray:
    """(..., 3, 3) matrix of the cross product with a vector."""
    out = np.zeros((*vector.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = (
        -vector[..., 2],
        vector[..., 1],
        -vector[..., 0],
    )
    return out - np.swapaxes(out, -1, -2)


def exp(phi: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotation matrix of a rotation vector (..., 3), rad (Rodrigues)."""
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    cross = skew(phi)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    one = np.where(small, 1.0 - angle**2 / 6, np.sin(safe) / safe)
    two = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    return np.eye(3) + one * cross + two * (cross @ cross)


def log(turn: np.ndarray) -> np.ndarray:
    """(..., 3) rotation vector (rad), of length at most pi, of a rotation matrix."""
    return rotation.log(quaternion(turn))


def quaternion(turn: np.ndarray) -> np.ndarray:
    """(..., 4) w x y z of a rotation matrix: the largest of its four components leads.

    Source: Shepperd, Journal of Guidance and Control 1 (1978), 223.
    """
    m = turn
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    lead = np.stack([trace, m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], axis=-1).argmax(-1)
    d = [m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]]
    s = [m[..., 2, 1] + m[..., 1, 2], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 0] + m[..., 0, 1]]
    own = [1 + 2 * m[..., i, i] - trace for i in range(3)]
    rows = np.stack(
        [
            np.stack([1 + trace, d[0], d[1], d[2]], axis=-1),
            np.stack([d[0], own[0], s[2], s[1]], axis=-1),
            np.stack([d[1], s[2], own[1], s[0]], axis=-1),
            np.stack([d[2], s[1], s[0], own[2]], axis=-1),
        ],
        axis=-2,
    )
    quat = np.take_along_axis(rows, lead[..., None, None], axis=-2)[..., 0, :]
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def matrix(quat: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotation matrix of a unit quaternion w x y z."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def nearest_rotation(m: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotation closest to a matrix (polar decomposition)."""
    u, _, vt = np.linalg.svd(m)
    flip = np.linalg.det(u @ vt) < 0
    u = np.where(flip[..., None, None], u * np.array([1.0, 1.0, -1.0]), u)
    return u @ vt


def swing(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(..., 3, 3) smallest rotation that takes unit vectors ``a`` to ``b`` (..., 3)."""
    axis = np.cross(a, b)
    cosine = (a * b).sum(-1)[..., None, None]
    cross = skew(axis)
    turn = np.eye(3) + cross + cross @ cross / np.maximum(1 + cosine, 1e-9)
    # Opposite vectors: half a turn about any axis across them.
    if (cosine < -1 + 1e-7).any():
        side = np.cross(a, np.array([1.0, 0.0, 0.0]))
        side = np.where(
            np.linalg.norm(side, axis=-1, keepdims=True) > 0.1,
            side,
            np.cross(a, np.array([0.0, 1.0, 0.0])),
        )
        side /= np.linalg.norm(side, axis=-1, keepdims=True)
        half = 2 * side[..., :, None] * side[..., None, :] - np.eye(3)
        turn = np.where(cosine < -1 + 1e-7, half, turn)
    return turn
