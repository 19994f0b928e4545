"""BVH files of any hierarchy, with a joint map.

Format: Meredith and Maddock, Motion Capture File Formats Explained (University of Sheffield,
2001). Rotation channels are degrees about the joint's own axes, in the order they are listed
(intrinsic); position channels replace the offset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warmstart.mocap.capture import Capture
from warmstart.mocap.skeleton import JointMap, find_map

MAX_JOINTS = 1000
_AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """Joints in file order, a parent before its children, and the motion of their channels."""

    names: tuple[str, ...]
    """An end site has the name of its joint and `` end``."""
    parent: tuple[int, ...]
    offset: np.ndarray
    channels: tuple[tuple[str, ...], ...]
    fps: float
    motion: np.ndarray
    """(T, C) values of all channels in order (file units, degrees)."""


def read_bvh(
    text: str, maps: tuple[JointMap, ...] = (), fps: float | None = None, name: str = ""
) -> Capture:
    """The motion of a BVH file. Raises ValueError for anything that is not one."""
    tree = parse(text)
    joint_map = find_map("bvh", set(tree.names), maps)
    for joint, offset in joint_map.offsets.items():
        if joint in tree.names:
            tree.offset[tree.names.index(joint)] = offset
    return place(*forward(tree), list(tree.names), joint_map, fps or tree.fps)


def place(
    origin: np.ndarray, turn: np.ndarray, names: list[str], joint_map: JointMap, fps: float
) -> Capture:
    """A capture from joint origins (T, J, 3) and rotations (T, J, 3, 3) in a file's axes."""
    to_ours = joint_map.matrix
    assert to_ours is not None
    index = {name: i for i, name in enumerate(names)}
    missing = sorted({*joint_map.joints.values(), *joint_map.carriers.values()} - set(index))
    if missing:
        raise ValueError(f"the skeleton has no joint '{missing[0]}'")
    points = {
        ours: origin[:, index[theirs]] @ (to_ours.T * joint_map.metres)
        for ours, theirs in joint_map.joints.items()
    }
    turns = {}
    for ours, theirs in joint_map.carriers.items():
        world = to_ours @ turn[:, index[theirs]]
        turns[ours] = world @ to_ours.T if joint_map.rest == "t_pose" else world
        if ours in joint_map.rest_turns:
            x, y, z = np.radians(joint_map.rest_turns[ours])
            turns[ours] = turns[ours] @ euler("xyz", np.array([[x, y, z]]))
    rest = "t_pose" if joint_map.rest == "t_pose" else "unknown"
    return Capture(fps, points, turns, rest, meta={"skeleton": joint_map.name})


def parse(text: str) -> Hierarchy:
    """Reads the hierarchy and the motion. Raises ValueError, one sentence."""
    head, found, tail = text.partition("MOTION")
    words = head.split()
    if not words or words[0].upper() != "HIERARCHY" or not found:
        raise ValueError("it has no HIERARCHY followed by MOTION")
    names: list[str] = []
    parent: list[int] = []
    offset: list[list[float]] = []
    channels: list[tuple[str, ...]] = []
    stack: list[int] = []
    at = 1
    while at < len(words):
        word = words[at].upper()
        if word in ("ROOT", "JOINT", "END"):
            if (word == "ROOT") == bool(stack):
                raise ValueError(f"a {word} in the wrong place of the hierarchy")
            if at + 2 >= len(words) or words[at + 2] != "{":
                raise ValueError(f"a {word} without a block")
            if len(names) >= MAX_JOINTS:
                raise ValueError(f"more than {MAX_JOINTS} joints")
            names.append(words[at + 1] if word != "END" else f"{names[stack[-1]]} end")
            parent.append(stack[-1] if stack else -1)
            offset.append([0.0, 0.0, 0.0])
            channels.append(())
            stack.append(len(names) - 1)
            at += 3
        elif word == "OFFSET" and stack:
            offset[stack[-1]] = [_number(w) for w in _take(words, at + 1, 3)]
            at += 4
        elif word == "CHANNELS" and stack:
            count = _number(_take(words, at + 1, 1)[0])
            if count not in range(7):
                raise ValueError(f"a joint with {count:g} channels")
            kinds = tuple(w.lower() for w in _take(words, at + 2, int(count)))
            for kind in kinds:
                if kind[:1] not in _AXES or kind[1:] not in ("position", "rotation"):
                    raise ValueError(f"unknown channel '{kind[:40]}'")
            channels[stack[-1]] = kinds
            at += 2 + int(count)
        elif word == "}" and stack:
            stack.pop()
            at += 1
        else:
            raise ValueError(f"'{words[at][:40]}' in the wrong place of the hierarchy")
    if stack or not names:
        raise ValueError("its hierarchy is not closed")
    if len(set(names)) != len(names) or parent.count(-1) != 1:
        raise ValueError("its hierarchy has several roots, or two joints of one name")
    fps, motion = _motion(tail, sum(map(len, channels)))
    return Hierarchy(tuple(names), tuple(parent), np.array(offset), tuple(channels), fps, motion)


def forward(tree: Hierarchy) -> tuple[np.ndarray, np.ndarray]:
    """Origins (T, J, 3) in file units and rotations (T, J, 3, 3), world <- joint, file axes."""
    frames = len(tree.motion)
    origin = np.empty((frames, len(tree.names), 3))
    turn = np.empty((frames, len(tree.names), 3, 3))
    at = 0
    for j, parent in enumerate(tree.parent):
        place, order, angles = np.tile(tree.offset[j], (frames, 1)), "", []
        for kind in tree.channels[j]:
            values = tree.motion[:, at]
            at += 1
            if kind.endswith("position"):
                place[:, _AXES[kind[0]]] = values
            else:
                order += kind[0]
                angles.append(np.radians(values))
        own = euler(order, np.stack(angles, axis=1)) if order else np.eye(3)
        if parent < 0:
            origin[:, j], turn[:, j] = place, own
        else:
            origin[:, j] = origin[:, parent] + (turn[:, parent] @ place[..., None])[..., 0]
            turn[:, j] = turn[:, parent] @ own
    return origin, turn


def euler(order: str, angles: np.ndarray) -> np.ndarray:
    """(T, 3, 3) of rotations (T, len(order)) rad about own axes, one after the other."""
    turn = np.broadcast_to(np.eye(3), (len(angles), 3, 3))
    for k, axis in enumerate(order):
        i, j = [(1, 2), (2, 0), (0, 1)][_AXES[axis]]
        c, s = np.cos(angles[:, k]), np.sin(angles[:, k])
        one = np.zeros((len(angles), 3, 3))
        one[:, _AXES[axis], _AXES[axis]] = 1.0
        one[:, i, i] = one[:, j, j] = c
        one[:, j, i], one[:, i, j] = s, -s
        turn = turn @ one
    return turn


def _motion(text: str, width: int) -> tuple[float, np.ndarray]:
    """Frame rate and the table of channel values."""
    words = text.split(None, 5)
    head = [w.lower() for w in words[:5]]
    if len(head) < 5 or head[0] != "frames:" or head[2:4] != ["frame", "time:"]:
        raise ValueError("its MOTION has no 'Frames:' and 'Frame Time:'")
    count, step = _number(words[1]), _number(words[4])
    if not step > 0:
        raise ValueError(f"a frame time of {step:g} s")
    values = words[5].split() if len(words) > 5 else []
    if width == 0:
        raise ValueError("its joints have no channels")
    if count != len(values) / width:
        raise ValueError(
            f"it says {count:g} frames of {width} channels and holds {len(values)} numbers"
        )
    return 1.0 / step, numbers(values).reshape(-1, width)


def numbers(words: list[str]) -> np.ndarray:
    """Words as floats. Raises ValueError naming one that is no finite number."""
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError:
        values = np.array([_number(word) for word in words])
    if not np.isfinite(values).all():
        raise ValueError(f"'{words[int(np.argmin(np.isfinite(values)))][:40]}' is not a number")
    return values


def _number(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        raise ValueError(f"'{word[:40]}' is not a number") from None
    if not math.isfinite(value):
        raise ValueError(f"'{word[:40]}' is not a number")
    return value


def _take(words: list[str], start: int, count: int) -> list[str]:
    if start + count > len(words):
        raise ValueError("it ends within its hierarchy")
    return words[start : start + count]
