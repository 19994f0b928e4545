"""The one motion format: an optimised jump, a recorded rollout and a mocap clip are all Clips.

A file is an npz without pickle: ``qpos (T, 7 + n)``, ``qvel (T, 6 + n)``, optional ``ctrl (T, n)``
(float32), optional ``object_qpos (T, 7 k)`` and ``object_qvel (T, 6 k)`` of what the athlete
handles, and ``meta``, a JSON text. State convention (MuJoCo's): qpos = [p_WB (m), quaternion
w x y z, hinges in ``body.dofs`` order (rad)], qvel = [v_W (m/s), w_B in the root's frame (rad/s),
hinge rates (rad/s)].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sports.humanoid.body import Body, load_body
from warmstart import rotation
from warmstart.npz import read_npz, write_npz
from warmstart.solution import Solution

FORMAT = "olympics-opt clip 1"


@cache
def _table(name: str) -> Body:
    return load_body(name)


@dataclass(frozen=True, eq=False)
class Clip:
    """Motion of one athlete at a fixed frame rate, in the task's world coordinates.

    Raises ValueError, one sentence, for anything that is not a motion of the named body.
    """

    fps: float
    """Frames per second, in [1, 2000]."""
    body: str
    """Name of the body table: ``smpl`` or ``smplx``."""
    qpos: np.ndarray
    """(T, 7 + n) with T >= 2."""
    qvel: np.ndarray
    """(T, 6 + n)."""
    ctrl: np.ndarray | None = None
    """(T, n) PD targets (rad): row t is held from frame t to frame t + 1, so the last row acts
    after the end. None for a motion without actuation."""
    meta: dict[str, Any] = field(default_factory=dict)
    """Plain JSON. Used by the project: problem, asked, achieved, source, licence, strength,
    events (name -> seconds from the first frame)."""
    object_qpos: np.ndarray | None = None
    """(T, 7 k) place (m) and attitude (w x y z) of the k free objects of the task's scene, in its
    order: a throw is no start without what is thrown. None for a motion of the athlete alone."""
    object_qvel: np.ndarray | None = None
    """(T, 6 k) their velocities: linear in the world (m/s), angular in their own frames (rad/s)."""

    def __post_init__(self) -> None:
        body = _table(self.body)
        if not (isinstance(self.fps, int | float) and 1.0 <= self.fps <= 2000.0):
            raise ValueError(f"clip: fps must lie in [1, 2000], not {self.fps!r}")
        object.__setattr__(self, "fps", float(self.fps))
        n = body.num_dofs
        for name, width in (("qpos", 7 + n), ("qvel", 6 + n), ("ctrl", n)):
            array = getattr(self, name)
            if array is None and name == "ctrl":
                continue
            array = np.array(array, dtype=np.float64)
            if array.ndim != 2 or array.shape[1] != width:
                raise ValueError(
                    f"clip: {name} has shape {array.shape}, but body '{self.body}' with {n} dofs "
                    f"needs (frames, {width})"
                )
            if not np.isfinite(array).all():
                frame = int(np.argwhere(~np.isfinite(array))[0, 0])
                raise ValueError(f"clip: {name} is not finite at frame {frame}")
            object.__setattr__(self, name, array)
        frames = len(self.qpos)
        if frames < 2:
            raise ValueError(f"clip: a motion needs at least 2 frames, this one has {frames}")
        if len(self.qvel) != frames or (self.ctrl is not None and len(self.ctrl) != frames):
            raise ValueError("clip: qpos, qvel and ctrl differ in their number of frames")
        self._check_objects()
        norm = np.linalg.norm(self.qpos[:, 3:7], axis=1)
        if np.abs(norm - 1.0).max() > 1e-2:
            frame = int(np.abs(norm - 1.0).argmax())
            raise ValueError(
                f"clip: the root quaternion of frame {frame} has length {norm[frame]:.3f}, not 1"
            )
        self.qpos[:, 3:7] /= norm[:, None]

    def _check_objects(self) -> None:
        if (self.object_qpos is None) != (self.object_qvel is None):
            raise ValueError("clip: object_qpos and object_qvel come together")
        if self.object_qpos is None or self.object_qvel is None:
            return
        qpos, qvel = (np.array(x, dtype=np.float64) for x in (self.object_qpos, self.object_qvel))
        count = qpos.shape[-1] // 7 if qpos.ndim == 2 else 0
        frames = len(self.qpos)
        if count < 1 or qpos.shape != (frames, 7 * count) or qvel.shape != (frames, 6 * count):
            raise ValueError(
                f"clip: object_qpos {qpos.shape} and object_qvel {qvel.shape} are not 7 and 6 "
                f"numbers of each object in {frames} frames"
            )
        if not (np.isfinite(qpos).all() and np.isfinite(qvel).all()):
            raise ValueError("clip: an object's state is not finite")
        quat = qpos.reshape(frames, count, 7)[..., 3:]
        norm = np.linalg.norm(quat, axis=-1, keepdims=True)
        if np.abs(norm - 1.0).max() > 1e-2:
            raise ValueError("clip: an object's quaternion is not of length 1")
        quat /= norm
        object.__setattr__(self, "object_qpos", qpos)
        object.__setattr__(self, "object_qvel", qvel)

    @property
    def num_objects(self) -> int:
        """Free objects whose states the clip has."""
        return 0 if self.object_qpos is None else self.object_qpos.shape[1] // 7

    @property
    def num_frames(self) -> int:
        return len(self.qpos)

    @property
    def duration(self) -> float:
        """Seconds from the first to the last frame."""
        return (self.num_frames - 1) / self.fps

    @property
    def times(self) -> np.ndarray:
        """(T,) seconds from the first frame."""
        return np.arange(self.num_frames) / self.fps

    @property
    def joint_quat(self) -> np.ndarray:
        """(T, J, 4) rotation of each link but the root against its parent, in link order."""
        return rotation.from_hinges(self.qpos[:, 7:].reshape(self.num_frames, -1, 3))

    @property
    def joint_spin(self) -> np.ndarray:
        """(T, J, 3) angular velocity of each link against its parent (rad/s, child's frame).

        Differences of rotations: hinge angles may wrap without a spike.
        """
        return rotation.spin(self.joint_quat, self.fps)

    def at(self, time: float | np.ndarray) -> dict[str, np.ndarray]:
        """State at ``time`` (s), a number or (K,), inside the clip.

        Returns ``qpos`` (K, 7 + n), ``qvel`` (K, 6 + n) and, where the clip has it, ``ctrl``
        (K, n) as it is held, ``object_qpos`` and ``object_qvel``; without the axis K for a number.
        Cubic through the positions and velocities of both neighbours; the attitude by the cubic
        rotation vector. Raises ValueError
        outside ``[0, duration]``.
        """
        t = np.atleast_1d(np.asarray(time, dtype=np.float64))
        if not (np.all(t >= -1e-9) and np.all(t <= self.duration + 1e-9)):
            raise ValueError(f"clip: times must lie in [0, {self.duration:.4f}] s")
        x = np.clip(t * self.fps, 0.0, self.num_frames - 1)
        near = np.abs(x - np.round(x)) < 1e-6  # exactly on a frame in spite of rounding
        x = np.where(near, np.round(x), x)
        k = np.minimum(np.floor(x).astype(int), self.num_frames - 2)
        s, h = (x - k)[:, None], 1.0 / self.fps
        qpos = np.empty((len(t), self.qpos.shape[1]))
        qvel = np.empty((len(t), self.qvel.shape[1]))
        for p, v, wraps in (
            (slice(0, 3), slice(0, 3), False),
            (slice(7, None), slice(6, None), True),
        ):
            q0, q1 = self.qpos[k, p], self.qpos[k + 1, p]
            v0, v1 = self.qvel[k, v], self.qvel[k + 1, v]
            step = q1 - q0
            if wraps:  # a hinge may jump by whole turns between frames without turning
                step = step - 2 * np.pi * np.round((step - 0.5 * h * (v0 + v1)) / (2 * np.pi))
            qpos[:, p], qvel[:, v] = _cubic(q0, step, v0, v1, h, s)
        ends = [self.qpos[i, 3:7] for i in (k, k + 1)] + [self.qvel[i, 3:6] for i in (k, k + 1)]
        qpos[:, 3:7], qvel[:, 3:6] = _turning(ends[0], ends[1], ends[2], ends[3], h, s)
        out = {"qpos": qpos, "qvel": qvel}
        if self.object_qpos is not None and self.object_qvel is not None:
            places, rates = np.empty((len(t), self.num_objects * 7)), []
            for i in range(self.num_objects):
                q, v = self.object_qpos[:, 7 * i :], self.object_qvel[:, 6 * i :]
                places[:, 7 * i : 7 * i + 3], moving = _cubic(
                    q[k, :3], q[k + 1, :3] - q[k, :3], v[k, :3], v[k + 1, :3], h, s
                )
                places[:, 7 * i + 3 : 7 * i + 7], turning = _turning(
                    q[k, 3:7], q[k + 1, 3:7], v[k, 3:6], v[k + 1, 3:6], h, s
                )
                rates += [moving, turning]
            out |= {"object_qpos": places, "object_qvel": np.concatenate(rates, axis=1)}
        if self.ctrl is not None:
            out["ctrl"] = self.ctrl[np.floor(x).astype(int)]
        return out if np.ndim(time) else {name: rows[0] for name, rows in out.items()}

    def resample(self, fps: float) -> Clip:
        """The same motion at another rate, from the first frame on; never longer than this one."""
        if not 1.0 <= fps <= 2000.0:
            raise ValueError(f"clip: fps must lie in [1, 2000], not {fps!r}")
        frames = math.floor(self.duration * fps + 1e-6) + 1
        if frames < 2:
            raise ValueError(
                f"clip: {self.duration:.3f} s are shorter than one frame at {fps} frames a second"
            )
        state = self.at(np.minimum(np.arange(frames) / fps, self.duration))
        return replace(self, fps=fps, **state)

    def cut(self, start: float, end: float) -> Clip:
        """The frames with start <= time <= end (s). Events keep their moment in the motion."""
        first = max(0, math.ceil(start * self.fps - 1e-6))
        last = min(self.num_frames - 1, math.floor(end * self.fps + 1e-6))
        rows = slice(first, last + 1)
        meta = dict(self.meta)
        if "events" in meta:
            meta["events"] = {k: v - first / self.fps for k, v in meta["events"].items()}
        ctrl = None if self.ctrl is None else self.ctrl[rows]
        arrays = {name: x[rows] for name, x in self._objects().items()}
        return replace(
            self, qpos=self.qpos[rows], qvel=self.qvel[rows], ctrl=ctrl, meta=meta, **arrays
        )

    def _objects(self) -> dict[str, np.ndarray]:
        """Copies of the objects' arrays, by name; empty without objects."""
        names = ("object_qpos", "object_qvel") if self.num_objects else ()
        return {name: getattr(self, name).copy() for name in names}

    def mirrored(self, y: float = 0.0) -> Clip:
        """Left and right exchanged: the motion seen in a mirror on the plane at ``y`` (m)."""
        body = _table(self.body)
        dofs = _mirror_order(body)
        sign = np.tile([-1.0, 1.0, -1.0], len(dofs) // 3)
        qpos, qvel = self.qpos.copy(), self.qvel.copy()
        qpos[:, 1] = 2 * y - qpos[:, 1]
        qpos[:, 3:7] *= (1.0, -1.0, 1.0, -1.0)
        qvel[:, :6] *= (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
        qpos[:, 7:], qvel[:, 6:] = qpos[:, 7:][:, dofs] * sign, qvel[:, 6:][:, dofs] * sign
        ctrl = None if self.ctrl is None else self.ctrl[:, dofs] * sign
        objects = self._objects()
        for i in range(self.num_objects):
            place, rate = (x[:, w * i : w * (i + 1)] for x, w in zip(objects.values(), (7, 6)))
            place[:, 1] = 2 * y - place[:, 1]
            place[:, 3:7] *= (1.0, -1.0, 1.0, -1.0)
            rate *= (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
        meta = {**self.meta, "mirrored": not self.meta.get("mirrored", False)}
        if not meta["mirrored"]:
            del meta["mirrored"]
        return replace(self, qpos=qpos, qvel=qvel, ctrl=ctrl, meta=meta, **objects)

    def moved(self, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Clip:
        """The motion turned by ``yaw`` (rad) about the world's z axis, then shifted (m)."""
        turn = rotation.exp(np.array([0.0, 0.0, yaw]))
        qpos, qvel = self.qpos.copy(), self.qvel.copy()
        qpos[:, :3] = rotation.rotate(turn, qpos[:, :3]) + np.array([x, y, 0.0])
        qpos[:, 3:7] = rotation.multiply(np.broadcast_to(turn, (len(qpos), 4)), qpos[:, 3:7])
        qvel[:, :3] = rotation.rotate(turn, qvel[:, :3])
        objects = self._objects()
        for i in range(self.num_objects):
            place, rate = (a[:, w * i : w * (i + 1)] for a, w in zip(objects.values(), (7, 6)))
            place[:, :3] = rotation.rotate(turn, place[:, :3]) + np.array([x, y, 0.0])
            place[:, 3:7] = rotation.multiply(np.broadcast_to(turn, (len(place), 4)), place[:, 3:7])
            rate[:, :3] = rotation.rotate(turn, rate[:, :3])
        return replace(self, qpos=qpos, qvel=qvel, **objects)

    def save(self, path: str | Path) -> None:
        """Writes an npz without pickle, atomically, numbers as float32."""
        arrays = {"qpos": self.qpos, "qvel": self.qvel, **self._objects()}
        if self.ctrl is not None:
            arrays["ctrl"] = self.ctrl
        head = {"format": FORMAT, "fps": self.fps, "body": self.body, "meta": self.meta}
        write_npz(path, {k: v.astype(np.float32) for k, v in arrays.items()}, head)

    @staticmethod
    def load(path: str | Path) -> Clip:
        """Reads what :meth:`save` wrote. Raises ValueError naming the file and what is wrong."""
        arrays, head = read_npz(path, ("qpos", "qvel"), ("ctrl", "object_qpos", "object_qvel"))
        if head.get("format") != FORMAT:
            raise ValueError(
                f"{path} is not a readable clip file: its format is "
                f"{str(head.get('format'))[:40]!r}, expected '{FORMAT}'"
            )
        meta, fps = head.get("meta"), head.get("fps")
        if not isinstance(meta, dict):
            raise ValueError(f"{path} is not a readable clip file: its meta is not a JSON object")
        if isinstance(fps, bool) or not isinstance(fps, int | float):
            raise ValueError(f"{path} is not a readable clip file: its fps is {str(fps)[:40]!r}")
        try:
            return Clip(fps=fps, body=str(head.get("body"))[:40], meta=meta, **arrays)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def clip_files(source: str | Path) -> list[tuple[Path, str]]:
    """Clip files of a source, a file or a folder, each with its name inside the source.

    Raises ValueError where there is nothing, or no npz.
    """
    source = Path(source)
    if not source.exists():
        raise ValueError(f"there is nothing at {source}")
    if source.is_file():
        return [(source, source.name)]
    files = [p for p in sorted(source.rglob("*.npz")) if p.is_file() and not p.name.startswith(".")]
    if not files:
        raise ValueError(f"{source} holds no clip (.npz)")
    return [(p, p.relative_to(source).as_posix()) for p in files]


def finite_difference_qvel(body: Body, qpos: np.ndarray, fps: float) -> np.ndarray:
    """(T, 6 + n) velocities in MuJoCo's convention of frames ``qpos`` (T, 7 + n), T >= 2.

    Second order in the frame time. Joint rates come from the joints' rotations, never from
    differences of hinge angles, so that a hinge which wraps by a whole turn does not spike.
    Raises ValueError for a wrong shape.
    """
    qpos = np.asarray(qpos, dtype=np.float64)
    if qpos.ndim != 2 or qpos.shape[1] != 7 + body.num_dofs or len(qpos) < 2:
        raise ValueError(
            f"qpos has shape {qpos.shape}, expected at least 2 frames of {7 + body.num_dofs}"
        )
    linear = np.gradient(qpos[:, :3], 1.0 / fps, axis=0, edge_order=2 if len(qpos) > 2 else 1)
    angles = qpos[:, 7:].reshape(len(qpos), -1, 3)
    joints = rotation.hinge_rates(angles, rotation.spin(rotation.from_hinges(angles), fps))
    root = rotation.spin(qpos[:, 3:7], fps)
    return np.concatenate([linear, root, joints.reshape(len(qpos), -1)], axis=1)


def clip_from_solution(solution: Solution, fps: float = 30.0) -> Clip:
    """The optimised motion at a frame rate, with the PD targets that carry its torques.

    ``ctrl`` of frame t = q + torque / kp, both averaged over the frame in which it is held.
    """
    frames = math.floor(solution.duration * fps + 1e-6) + 1
    start = float(solution.times[0])
    times = start + np.arange(frames) / fps
    state = solution.sample(np.minimum(times, solution.times[-1]))
    parts = 8
    inner = times[:, None] + (np.arange(parts) + 0.5) / (parts * fps)
    held = solution.sample(np.minimum(inner.ravel(), solution.times[-1]))
    target = held["qpos"][:, 7:] + held["torque"] / solution.body.array("kp")
    return Clip(
        fps=fps,
        body=solution.body.name,
        qpos=state["qpos"],
        qvel=state["qvel"],
        ctrl=target.reshape(frames, parts, -1).mean(1),
        meta={
            "problem": solution.problem,
            "asked": dict(solution.asked),
            "strength": solution.strength,
            **({"equipment": list(equipment)} if (equipment := solution.body.equipment) else {}),
            "source": "trajectory optimisation",
            "licence": "Apache-2.0",
            "events": contact_events(solution),
        },
    )


def contact_events(solution: Solution) -> dict[str, float]:
    """Seconds at which the last contact ends before the longest flight, and at which it lands.

    ``{"takeoff": t, "landing": t}``; landing only when a contact follows, empty without a flight.
    """
    t = solution.times - solution.times[0]
    flights = [(a, b, i) for i, (_, a, b, c) in enumerate(solution.phases) if not c]
    if not flights:
        return {}
    first, last, index = max(flights, key=lambda f: t[f[1]] - t[f[0]])
    events = {"takeoff": float(t[first])}
    if index + 1 < len(solution.phases):
        events["landing"] = float(t[last])
    return events


def _turning(
    q0: np.ndarray, q1: np.ndarray, w0: np.ndarray, w1: np.ndarray, h: float, s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Attitude (K, 4) and angular velocity (K, 3) at the fraction s of a frame: the cubic rotation
    vector through both ends."""
    phi1 = rotation.log(rotation.multiply(rotation.conjugate(q0), q1))
    end = np.linalg.solve(rotation.right_jacobian(phi1), w1[..., None])[..., 0]
    phi, rate = _cubic(np.zeros_like(phi1), phi1, w0, end, h, s)
    spin = (rotation.right_jacobian(phi) @ rate[..., None])[..., 0]
    return rotation.multiply(q0, rotation.exp(phi)), spin


def _cubic(
    q0: np.ndarray, step: np.ndarray, v0: np.ndarray, v1: np.ndarray, h: float, s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity at the fraction s of a frame that moves by ``step``."""
    d = step / h
    c2, c3 = 3 * d - 2 * v0 - v1, v0 + v1 - 2 * d
    return q0 + h * s * (v0 + s * (c2 + s * c3)), v0 + s * (2 * c2 + 3 * s * c3)


@cache
def _mirror_names(names: tuple[str, ...]) -> tuple[int, ...]:
    other = {"L_": "R_", "R_": "L_"}
    return tuple(names.index(other.get(n[:2], n[:2]) + n[2:]) for n in names)


def _mirror_order(body: Body) -> np.ndarray:
    """(n,) index of the dof on the other side of each dof."""
    return np.array(_mirror_names(tuple(dof.name for dof in body.dofs)))
