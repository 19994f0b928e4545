"""DeepMimic motions: JSON with frames of the 34-dof humanoid.

A frame is [duration (s), root position (3), root quaternion (w x y z), then for chest, neck, right
hip, right knee, right ankle, right shoulder, right elbow and the same on the left a quaternion or,
for knees and elbows, an angle (rad) about z]. Source: Peng et al., DeepMimic (2018), the format of
its motion files. Axes: x forward, y up, z right.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from warmstart.mocap.bvh import euler, place
from warmstart.mocap.capture import MAX_FRAMES, Capture
from warmstart.mocap.kinematics import matrix
from warmstart.mocap.skeleton import JointMap, packaged_maps

ORDER = (
    *(("root", 4), ("chest", 4), ("neck", 4)),
    *(
        (f"{side}_{joint}", 1 if joint in ("knee", "elbow") else 4)
        for side in ("right", "left")
        for joint in ("hip", "knee", "ankle", "shoulder", "elbow")
    ),
)
"""Joints in the order of a frame, with the numbers each takes."""
LOOSE = 0.6
"""A quaternion's length may be this far from 1: the published files hold blends of quaternions."""
WIDTH = 4 + sum(size for _, size in ORDER)


def read_deepmimic(text: str, fps: float | None = None) -> Capture:
    """The motion of a DeepMimic file. Raises ValueError for anything that is not one."""
    values = parse(text)
    steps = values[:-1, 0]
    if (steps <= 0).any():
        raise ValueError(f"frame {int(np.argmax(steps <= 0))} lasts {steps.min():g} s")
    step = float(np.median(steps))
    if np.abs(steps / step - 1).max() > 0.05:
        values = even(values, step)
    rate = fps or 1.0 / step
    joint_map = next(m for m in packaged_maps() if m.format == "deepmimic")
    return place(*forward(values, joint_map), list(joint_map.bones), joint_map, rate)


def parse(text: str) -> np.ndarray:
    """(T, 44) frames. Raises ValueError, one sentence."""
    try:
        value: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is not JSON: {str(error).splitlines()[0][:120]}") from error
    frames = value.get("Frames") if isinstance(value, dict) else None
    if not isinstance(frames, list) or not 2 <= len(frames) <= MAX_FRAMES:
        raise ValueError(f"it has no list 'Frames' of 2 to {MAX_FRAMES} frames")
    for i, row in enumerate(frames):
        if not isinstance(row, list) or len(row) != WIDTH:
            raise ValueError(f"frame {i} does not hold the {WIDTH} numbers of DeepMimic's humanoid")
        if not all(isinstance(x, int | float) and not isinstance(x, bool) for x in row):
            raise ValueError(f"frame {i} holds something that is not a number")
    try:
        table = np.array(frames, dtype=np.float64)
    except OverflowError as error:
        raise ValueError("it holds a number out of range") from error
    if not np.isfinite(table).all():
        raise ValueError(f"frame {np.argwhere(~np.isfinite(table))[0, 0]} is not finite")
    return table


def even(values: np.ndarray, step: float) -> np.ndarray:
    """Frames of one duration ``step`` (s), from frames that differ in it, between neighbours."""
    times = np.concatenate([[0.0], np.cumsum(values[:-1, 0])])
    if times[-1] / step > MAX_FRAMES:
        raise ValueError("its frames differ too much in duration")
    at = 4
    values = values.copy()
    for _, size in ORDER:
        part = values[:, at : at + size]
        at += size
        if size == 4:  # of q and -q, the one on the side of the frame before
            sign = np.sign((part[1:] * part[:-1]).sum(1))
            part[1:] *= np.cumprod(np.where(sign == 0, 1.0, sign))[:, None]
    grid = np.arange(int(times[-1] / step + 1e-6) + 1) * step
    return np.stack([np.interp(grid, times, column) for column in values.T], axis=1)


def forward(values: np.ndarray, joint_map: JointMap) -> tuple[np.ndarray, np.ndarray]:
    """Joint origins (T, J, 3) and rotations (T, J, 3, 3) in the order of the map's bones."""
    local: dict[str, np.ndarray] = {}
    at = 4
    for name, size in ORDER:
        part = values[:, at : at + size]
        at += size
        if size == 1:
            local[name] = euler("z", part)
            continue
        norm = np.linalg.norm(part, axis=1, keepdims=True)
        if (np.abs(norm - 1) > LOOSE).any():
            raise ValueError(f"the rotation of {name} is no unit quaternion")
        local[name] = matrix(part / norm)
    names = list(joint_map.bones)
    origin = np.empty((len(values), len(names), 3))
    turn = np.empty((len(values), len(names), 3, 3))
    for j, (name, (parent, *offset)) in enumerate(joint_map.bones.items()):
        if not parent:
            origin[:, j], turn[:, j] = values[:, 1:4], local[name]
            continue
        p = names.index(parent)
        origin[:, j] = origin[:, p] + turn[:, p] @ np.array(offset)
        turn[:, j] = turn[:, p] @ local[name] if name in local else turn[:, p]
    return origin, turn
