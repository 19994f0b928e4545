"""What an optimisation problem returns: a motion with its torques and contact forces.

A :class:`Solution` is a trajectory at the knots of the optimiser. Between knots the
accelerations, torques and forces are linear in time and positions and velocities follow from
them; :meth:`Solution.sample` evaluates exactly that curve.
"""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sports.humanoid.body import Body, load_body
from warmstart.atomic import write_bytes

if TYPE_CHECKING:
    from warmstart.feedback import Feedback

_ARRAYS = {
    "times": 1,
    "qpos": 2,
    "qvel": 2,
    "qacc": 2,
    "torque": 2,
    "contact_force": 3,
}


@dataclass(frozen=True)
class Solution:
    """One optimised motion of one athlete on the full state (MuJoCo's convention).

    The joint torque is ``torque - kd * hinge rate`` with ``|torque| <= effort``: at strength
    ``human`` this is the torque-speed line of the body table.
    """

    problem: str
    """Registry name of the problem, e.g. ``high_jump``."""
    body: Body
    asked: dict[str, float]
    """The prescribed outcome and options, e.g. ``{"bar_height": 1.0}`` (m)."""
    strength: str
    times: np.ndarray
    """(K,) s, strictly increasing from 0; knots are denser in contact than in flight."""
    qpos: np.ndarray
    """(K, nq) p_WB (m), quaternion wxyz, hinges (rad)."""
    qvel: np.ndarray
    """(K, nv) v_W (m/s), w_B in the root's frame (rad/s), hinge rates (rad/s)."""
    qacc: np.ndarray
    """(K, nv) time derivative of ``qvel``."""
    torque: np.ndarray
    """(K, num_dofs) servo torque before passive damping (N m)."""
    contact_points: tuple[tuple[str, tuple[float, float, float]], ...]
    """C entries (link, point in the link's frame (m))."""
    contact_force: np.ndarray
    """(K, C, 3) force of the ground on the body at each point, world frame (N)."""
    phases: tuple[tuple[str, int, int, tuple[int, ...]], ...]
    """(name, first knot, last knot, active contact indices); neighbours share a knot, and
    there the force of a point that is not active on both sides is zero."""
    stats: dict[str, Any] = field(default_factory=dict)
    """solve_s, iterations, max_violation, objective, status, variables, ..."""

    def __post_init__(self) -> None:
        knots, dofs, points = len(self.times), self.body.num_dofs, len(self.contact_points)
        shapes = {
            "times": (knots,),
            "qpos": (knots, 7 + dofs),
            "qvel": (knots, 6 + dofs),
            "qacc": (knots, 6 + dofs),
            "torque": (knots, dofs),
            "contact_force": (knots, points, 3),
        }
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape:
                raise ValueError(f"solution: {name} has shape {array.shape}, expected {shape}")
            if not np.all(np.isfinite(array)):
                raise ValueError(f"solution: {name} holds a value that is not finite")
        if knots < 2 or np.any(np.diff(self.times) <= 0):
            raise ValueError("solution: times must be strictly increasing with at least 2 knots")

    @property
    def duration(self) -> float:
        """Seconds from the first to the last knot."""
        return float(self.times[-1] - self.times[0])

    @cached_property
    def following(self) -> Feedback:
        """The feedback that holds a simulation on this motion. It takes seconds, and a certificate
        replays a motion several times. Raises ValueError where :func:`warmstart.feedback.follow`
        does."""
        from warmstart.feedback import follow

        return follow(self)

    def loaded(self, times: np.ndarray) -> np.ndarray:
        """(T,) share of what is thrown that is in the hand: 1, then 0; 1 for ever without a throw.

        ``stats["payload"]`` = ``{"equipment", "held", "gone"}``: the name of what is thrown, and
        the times (s) between which the hand opens.
        """
        payload = self.stats.get("payload")
        if payload is None:
            return np.ones(len(times))
        held, gone = payload["held"], payload["gone"]
        return np.clip((gone - np.asarray(times)) / (gone - held), 0.0, 1.0)

    @property
    def empty_handed(self) -> Body:
        """The athlete without what it throws."""
        thrown = self.stats.get("payload", {}).get("equipment")
        return load_body(
            self.body.name,
            strength=self.body.strength,
            limits=self.body.limits,
            equipment=[name for name in self.body.equipment if name != thrown],
        )

    def sample(self, times: np.ndarray) -> dict[str, np.ndarray]:
        """The motion at any times (T,) s inside ``[times[0], times[-1]]``.

        Returns ``qpos, qvel, qacc, torque, contact_force`` with T rows. Torques, forces and
        accelerations are linear between knots; hinges and root position are the cubics that
        match position and velocity at both knots (their acceleration is linear and equals
        ``qacc`` at the knots to the NLP tolerance); the attitude is the cubic rotation vector
        that matches attitude and angular velocity at both knots. Raises ValueError outside.
        """
        t = np.atleast_1d(np.asarray(times, dtype=float))
        if t.min() < self.times[0] - 1e-9 or t.max() > self.times[-1] + 1e-9:
            raise ValueError(
                f"sample times must lie in [{self.times[0]:.3f}, {self.times[-1]:.3f}] s"
            )
        k = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2)
        h = (self.times[k + 1] - self.times[k])[:, None]
        s = np.clip((t - self.times[k])[:, None] / h, 0.0, 1.0)

        def linear(x: np.ndarray) -> np.ndarray:
            w = s.reshape((-1,) + (1,) * (x.ndim - 1))
            return (1 - w) * x[k] + w * x[k + 1]

        qpos = np.empty((len(t), self.qpos.shape[1]))
        qvel = np.empty((len(t), self.qvel.shape[1]))
        qacc = np.empty((len(t), self.qvel.shape[1]))
        for p, v in ((slice(0, 3), slice(0, 3)), (slice(7, None), slice(6, None))):
            qpos[:, p], qvel[:, v], qacc[:, v] = _hermite(
                self.qpos[k, p], self.qpos[k + 1, p], self.qvel[k, v], self.qvel[k + 1, v], h, s
            )
        quat0, w0, w1 = self.qpos[k, 3:7], self.qvel[k, 3:6], self.qvel[k + 1, 3:6]
        phi1 = _quat_log(_quat_mul(_quat_conj(quat0), self.qpos[k + 1, 3:7]))
        phi, dphi, ddphi = _hermite(
            np.zeros_like(phi1), phi1, w0, _solve3(_right_jacobian(phi1), w1), h, s
        )
        jac = _right_jacobian(phi)
        qpos[:, 3:7] = _quat_mul(quat0, _quat_exp(phi))
        qvel[:, 3:6] = _apply(jac, dphi)
        step = 1e-6
        djac = _right_jacobian(phi + step * dphi) - _right_jacobian(phi - step * dphi)
        qacc[:, 3:6] = _apply(jac, ddphi) + _apply(djac / (2 * step), dphi)
        return {
            "qpos": qpos,
            "qvel": qvel,
            "qacc": qacc,
            "torque": linear(self.torque),
            "contact_force": linear(self.contact_force),
        }

    def save(self, path: str | Path) -> None:
        """Writes an npz without pickle, atomically. The body is stored by name and options."""
        path = Path(path)
        meta = {
            "format": "olympics-opt solution 1",
            "problem": self.problem,
            "asked": self.asked,
            "strength": self.strength,
            "body": {
                "name": self.body.name,
                "strength": self.body.strength,
                "limits": self.body.limits,
                "equipment": list(self.body.equipment),
            },
            "contact_points": [[link, list(point)] for link, point in self.contact_points],
            "phases": [[n, a, b, list(c)] for n, a, b, c in self.phases],
            "stats": self.stats,
        }
        buffer = io.BytesIO()
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        np.savez_compressed(buffer, meta=np.array(json.dumps(meta)), **arrays)
        write_bytes(path, buffer.getvalue())

    @staticmethod
    def load(path: str | Path) -> Solution:
        """Reads what :meth:`save` wrote. Raises ValueError naming the file and what is wrong."""
        path = Path(path)
        if not path.is_file():
            raise ValueError(f"no solution file at {path}")
        try:
            with np.load(path, allow_pickle=False) as data:
                arrays = {name: np.asarray(data[name], dtype=float) for name in _ARRAYS}
                meta = json.loads(str(data["meta"]))
            body = load_body(
                meta["body"]["name"],
                strength=meta["body"]["strength"],
                limits=meta["body"]["limits"],
                equipment=meta["body"]["equipment"],
            )
            return Solution(
                problem=meta["problem"],
                body=body,
                asked=meta["asked"],
                strength=meta["strength"],
                contact_points=tuple((link, tuple(p)) for link, p in meta["contact_points"]),
                phases=tuple((n, a, b, tuple(c)) for n, a, b, c in meta["phases"]),
                stats=meta["stats"],
                **arrays,
            )
        except (KeyError, TypeError, ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} is not a readable solution file: {error}") from error


def _hermite(p0, p1, v0, v1, h, s):
    """Cubic through two positions and velocities: position, velocity, acceleration at s."""
    d = (p1 - p0) / h
    c2 = 3 * d - 2 * v0 - v1
    c3 = v0 + v1 - 2 * d
    position = p0 + h * s * (v0 + s * (c2 + s * c3))
    velocity = v0 + s * (2 * c2 + 3 * s * c3)
    acceleration = (2 * c2 + 6 * s * c3) / h
    return position, velocity, acceleration


def _quat_mul(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    w = a[:, :1] * b[:, :1] - np.sum(a[:, 1:] * b[:, 1:], axis=1, keepdims=True)
    v = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.hstack([w, v])


def _quat_conj(a: np.ndarray) -> np.ndarray:
    return a * np.array([1.0, -1.0, -1.0, -1.0])


def _quat_exp(phi: np.ndarray) -> np.ndarray:
    half = 0.5 * np.linalg.norm(phi, axis=1, keepdims=True)
    return np.hstack([np.cos(half), 0.5 * phi * np.sinc(half / np.pi)])


def _quat_log(quat: np.ndarray) -> np.ndarray:
    quat = np.where(quat[:, :1] < 0, -quat, quat)
    norm = np.linalg.norm(quat[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(norm, quat[:, :1])
    return quat[:, 1:] * np.where(norm > 1e-9, angle / np.maximum(norm, 1e-12), 2.0)


def _right_jacobian(phi: np.ndarray) -> np.ndarray:
    """(T, 3, 3) maps the rate of a rotation vector to body angular velocity (Chirikjian 2011)."""
    angle = np.linalg.norm(phi, axis=1)[:, None, None]
    a2 = angle * angle
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    one = np.where(small, 0.5 - a2 / 24, (1 - np.cos(safe)) / safe**2)
    two = np.where(small, 1 / 6 - a2 / 120, (safe - np.sin(safe)) / safe**3)
    cross = np.zeros((len(phi), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -phi[:, 2], phi[:, 1], -phi[:, 0]
    cross -= cross.transpose(0, 2, 1)
    return np.eye(3) - one * cross + two * (cross @ cross)


def _solve3(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.linalg.solve(matrix, vector[..., None])[..., 0]


def _apply(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return (matrix @ vector[..., None])[..., 0]
