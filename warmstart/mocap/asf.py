"""Acclaim skeletons (ASF) and motions (AMC).

Format: Lander, Working with Motion Capture File Formats (Game Developer, January 1998). A bone
turns by ``C M C^-1`` against its parent, with C its own axes and M the rotation of its degrees of
freedom, both extrinsic in the order x, y, z; it then reaches along ``direction * length``. With all
angles zero the figure stands in a T-pose (legs apart in the CMU set).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from warmstart.mocap.bvh import euler, numbers, place
from warmstart.mocap.capture import MAX_FRAMES, Capture
from warmstart.mocap.skeleton import JointMap, find_map

INCH = 0.0254
_DOFS = ("rx", "ry", "rz", "tx", "ty", "tz", "l")


@dataclass
class Bone:
    """One bone of a skeleton, lengths in metres, angles in radians."""

    name: str
    direction: np.ndarray = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    axis: np.ndarray = field(default_factory=lambda: np.zeros(3))
    dofs: tuple[str, ...] = ()
    parent: str = ""


@dataclass
class Skeleton:
    """Bones by name, a parent before its children; the first is ``root``."""

    bones: dict[str, Bone]
    metres: float
    degrees: bool
    position: np.ndarray


def read_asf_amc(
    asf: str, amc: str, fps: float | None, maps: tuple[JointMap, ...] = (), name: str = ""
) -> Capture:
    """The motion of an AMC file on its ASF skeleton.

    An AMC file does not say its frame rate: ``fps`` must be given. Raises ValueError, one sentence.
    """
    skeleton = parse_skeleton(asf)
    if fps is None:
        raise ValueError("an AMC file does not say its frame rate: give it with --source-fps")
    joint_map = find_map("asf", set(skeleton.bones), maps)
    values = parse_motion(amc, skeleton)
    origin, turn, names = forward(skeleton, values)
    return place(origin, turn, names, joint_map, fps)


def forward(
    skeleton: Skeleton, values: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Start of each bone (T, J, 3) in m, its rotation (T, J, 3, 3) and names.

    ``"lfoot end"`` is the far end of a bone.
    """
    frames = len(values["root"])
    origin: list[np.ndarray] = []
    turn: list[np.ndarray] = []
    names: list[str] = []
    ends: dict[str, np.ndarray] = {}
    turns: dict[str, np.ndarray] = {}
    for bone in skeleton.bones.values():
        motion = np.zeros((frames, 3))
        shift = np.zeros((frames, 3))
        for k, dof in enumerate(bone.dofs):
            if dof[0] == "r":
                motion[:, "xyz".index(dof[1])] = values[bone.name][:, k]
            elif dof[0] == "t":
                shift[:, "xyz".index(dof[1])] = values[bone.name][:, k] * skeleton.metres
        if skeleton.degrees:
            motion = np.radians(motion)
        own_axes = euler("zyx", bone.axis[None, ::-1])
        own = own_axes @ euler("zyx", motion[:, ::-1]) @ np.swapaxes(own_axes, -1, -2)
        if bone.parent:
            start, turns[bone.name] = ends[bone.parent], turns[bone.parent] @ own
        else:
            start, turns[bone.name] = skeleton.position * skeleton.metres + shift, own
        ends[bone.name] = start + turns[bone.name] @ (bone.direction * bone.length)
        for suffix, where in (("", start), (" end", ends[bone.name])):
            names.append(bone.name + suffix)
            origin.append(where)
            turn.append(turns[bone.name])
    return np.stack(origin, axis=1), np.stack(turn, axis=1), names


def parse_skeleton(text: str) -> Skeleton:
    """Reads an ASF file. Raises ValueError, one sentence."""
    sections = _sections(text)
    for needed in ("units", "root", "bonedata", "hierarchy"):
        if needed not in sections:
            raise ValueError(f"the ASF file has no section :{needed}")
    units = {line[0]: line[1] for line in sections["units"] if len(line) > 1}
    scale = _value(units.get("length", "1"))
    if scale <= 0:
        raise ValueError(f"the ASF file has a unit of length {scale:g}")
    degrees = units.get("angle", "deg").lower().startswith("deg")
    root = Bone("root", dofs=("tx", "ty", "tz", "rx", "ry", "rz"))
    position = np.zeros(3)
    for line in sections["root"]:
        if line[0] == "order":
            root.dofs = _dofs(line[1:])
        elif line[0] == "position":
            position = _vector(line[1:])
        elif line[0] == "orientation":
            root.axis = _angles(line[1:], degrees)
        elif line[0] == "axis" and line[1:] != ["xyz"]:
            raise ValueError(f"the ASF root turns in the order {' '.join(line[1:])[:20]}, not XYZ")
    metres = INCH / scale
    bones = {"root": root}
    for bone in _bones(sections["bonedata"], degrees):
        bone.length *= metres
        if bone.name in bones:
            raise ValueError(f"two bones are called '{bone.name[:40]}'")
        bones[bone.name] = bone
    order = ["root"]
    for line in sections["hierarchy"]:
        if line[0] in ("begin", "end"):
            continue
        for child in line[1:]:
            if line[0] not in order or child not in bones or child in order:
                raise ValueError(f"the hierarchy of '{child[:40]}' is broken")
            bones[child].parent = line[0]
            order.append(child)
    return Skeleton({name: bones[name] for name in order}, metres, degrees, position)


def parse_motion(text: str, skeleton: Skeleton) -> dict[str, np.ndarray]:
    """Bone -> (T, dofs) values of an AMC file. Raises ValueError, one sentence."""
    moving = {name: len(b.dofs) for name, b in skeleton.bones.items() if b.dofs}
    words: dict[str, list[str]] = {name: [] for name in moving}
    frames = 0
    seen: set[str] = set(moving)
    for line in text.splitlines():
        parts = line.split()
        if not parts or parts[0][0] in "#:":
            continue
        if len(parts) == 1 and parts[0].isdigit():
            if len(seen) != len(moving):
                missing = sorted(set(moving) - seen)[0]
                raise ValueError(f"the AMC file has no {missing} in frame {frames}")
            frames += 1
            if frames > MAX_FRAMES:
                raise ValueError(f"the AMC file has more than {MAX_FRAMES} frames")
            seen = set()
            continue
        name = parts[0].lower()
        if name not in moving:
            raise ValueError(f"the ASF file has no moving bone '{name[:40]}'")
        if frames == 0 or name in seen or len(parts) - 1 != moving[name]:
            raise ValueError(f"'{name[:40]}' of the AMC file is malformed in frame {frames}")
        seen.add(name)
        words[name] += parts[1:]
    if frames == 0 or len(seen) != len(moving):
        raise ValueError(f"the AMC file ends within frame {frames}")
    return {name: numbers(words[name]).reshape(frames, moving[name]) for name in moving}


def _sections(text: str) -> dict[str, list[list[str]]]:
    """Section -> its lines, split into lower-case words; bone names keep their case."""
    out: dict[str, list[list[str]]] = {}
    current: list[list[str]] = []
    for line in text.splitlines():
        line = line.partition("#")[0].strip()
        if not line:
            continue
        if line.startswith(":"):
            name, _, rest = line[1:].partition(" ")
            current = out.setdefault(name.strip().lower(), [])
            if rest.strip():
                current.append(rest.split())
        else:
            parts = line.split()
            keep = parts[0].lower() == "name"
            current.append(parts if keep else [p.lower() for p in parts])
    return out


def _bones(lines: list[list[str]], degrees: bool) -> list[Bone]:
    bones: list[Bone] = []
    bone: Bone | None = None
    for line in lines:
        key = line[0].lower()
        if key == "begin":
            bone = Bone("")
        elif bone is None:
            raise ValueError("the ASF file has bone data outside begin and end")
        elif key == "end":
            if not bone.name:
                raise ValueError("the ASF file has a bone without a name")
            bones.append(bone)
            bone = None
        elif key == "name" and len(line) > 1:
            bone.name = line[1].lower()
        elif key == "direction":
            bone.direction = _vector(line[1:4])
        elif key == "length" and len(line) > 1:
            bone.length = _value(line[1])
        elif key == "axis":
            if line[4:] not in (["xyz"], []):
                raise ValueError(f"bone '{bone.name[:40]}' has axes in another order than XYZ")
            bone.axis = _angles(line[1:4], degrees)
        elif key == "dof":
            bone.dofs = _dofs(line[1:])
    if bone is not None:
        raise ValueError("the ASF file ends within a bone")
    return bones


def _dofs(words: list[str]) -> tuple[str, ...]:
    for word in words:
        if word not in _DOFS:
            raise ValueError(f"unknown degree of freedom '{word[:40]}'")
    turns = [w for w in words if w[0] == "r"]
    if turns != sorted(turns) or len(set(words)) != len(words):
        raise ValueError(f"rotations in the order {' '.join(turns)}, not x, y, z")
    return tuple(words)


def _vector(words: list[str]) -> np.ndarray:
    if len(words) != 3:
        raise ValueError("the ASF file has a vector without three numbers")
    return numbers(words)


def _angles(words: list[str], degrees: bool) -> np.ndarray:
    return np.radians(_vector(words)) if degrees else _vector(words)


def _value(word: str) -> float:
    value = float(numbers([word])[0])
    if not math.isfinite(value):
        raise ValueError(f"'{word[:40]}' is not a number")
    return value
