"""Joint maps: which joint of a file is which of ours. Data files, one for each skeleton met.

A map is a JSON object:

* ``name``, ``format`` (``bvh``, ``asf``, ``deepmimic``, ``skillmimic``) and ``source``;
* ``metres``: length of the file's unit;
* ``axes``: the file's directions forward, left and up, as ``["z", "x", "y"]`` or
  ``["x", "-z", "y"]``;
* ``rest``: ``t_pose`` when all rotations are zero in our zero pose, ``unknown`` when they are not;
* ``joints``: our joint -> the file's joint. ``"lFoot end"`` is the end site of ``lFoot``;
* ``turns``: our link -> the file's joint whose rotation carries it. Left out: as ``joints``;
* ``rest_turns``: link -> (x, y, z) degrees, the rotation of our link from the T-pose to the file's
  zero pose, about our axes, where the two differ;
* ``offsets`` (BVH): the file's joint -> the offset (file units and axes) that it has instead;
* ``bones`` (DeepMimic): joint -> parent and offset, in the file's axes.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from warmstart.mocap.capture import REQUIRED

FORMATS = ("bvh", "asf", "deepmimic", "skillmimic")


@dataclass(frozen=True)
class JointMap:
    """A skeleton's names in our terms. Raises ValueError for a map that cannot be used."""

    name: str
    format: str
    joints: dict[str, str]
    metres: float = 1.0
    axes: tuple[str, ...] = ("z", "x", "y")
    rest: str = "unknown"
    turns: dict[str, str] | None = None
    rest_turns: dict[str, list[float]] = field(default_factory=dict)
    offsets: dict[str, list[float]] = field(default_factory=dict)
    bones: dict[str, Any] = field(default_factory=dict)
    source: str = ""

    def __post_init__(self) -> None:
        if self.format not in FORMATS:
            raise ValueError(f"format '{self.format}' is none of {', '.join(FORMATS)}")
        if not isinstance(self.joints, dict) or not all(
            isinstance(k, str) and isinstance(v, str) for k, v in self.joints.items()
        ):
            raise ValueError("joints must name a joint of the file for each of ours")
        missing = [name for name in REQUIRED if name not in self.joints]
        if missing:
            raise ValueError(f"joints lacks {missing[0]}")
        if isinstance(self.metres, bool) or not isinstance(self.metres, int | float):
            raise ValueError("metres must be a number")
        if not 1e-4 <= self.metres <= 10:
            raise ValueError(f"a unit of {self.metres} m")
        for what, table in (("rest_turns", self.rest_turns), ("offsets", self.offsets)):
            if not isinstance(table, dict) or not all(map(_is_triple, table.values())):
                raise ValueError(f"{what} must give three numbers for each name")
        if self.rest not in ("t_pose", "unknown"):
            raise ValueError(f"rest is '{self.rest}', not t_pose or unknown")
        if self.matrix is None:
            raise ValueError(f"axes {self.axes} are not forward, left and up of one frame")

    @property
    def matrix(self) -> np.ndarray | None:
        """(3, 3) ours <- file; None when the axes are not a right-handed frame."""
        rows = np.zeros((3, 3))
        if len(self.axes) != 3:
            return None
        for row, axis in zip(rows, self.axes):
            if not isinstance(axis, str) or axis.lstrip("-") not in ("x", "y", "z"):
                return None
            row["xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
        return rows if np.linalg.det(rows) > 0.5 else None

    @property
    def carriers(self) -> dict[str, str]:
        """Our link -> the file's joint whose rotation it follows."""
        if self.turns is not None:
            return self.turns
        return {k: v for k, v in self.joints.items() if not v.endswith(" end")}

    def wanted(self) -> set[str]:
        """Names of the file's joints that this map needs."""
        names = {*self.joints.values(), *self.carriers.values()}
        return {name.removesuffix(" end") for name in names}


def _is_triple(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(isinstance(x, int | float) and math.isfinite(x) for x in value)
    )


def read_joint_map(path: str | Path) -> JointMap:
    """A user's own map. Raises ValueError naming the file and what is wrong."""
    path = Path(path)
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"no joint map can be read from {path}") from error
    try:
        return _parse(text)
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is not a joint map: {str(error).splitlines()[0]}") from error


@cache
def packaged_maps() -> tuple[JointMap, ...]:
    """The maps of the skeletons that are known."""
    folder = resources.files("warmstart.mocap").joinpath("skeletons")
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".json")), key=lambda f: f.name)
    return tuple(_parse(file.read_text()) for file in files)


def find_map(format: str, names: set[str], extra: tuple[JointMap, ...] = ()) -> JointMap:
    """The first map of a format whose joints are all there. Raises ValueError listing the maps."""
    maps = [m for m in (*extra, *packaged_maps()) if m.format == format]
    for candidate in maps:
        if candidate.wanted() <= names:
            return candidate
    known = ", ".join(m.name for m in maps)
    some = ", ".join(sorted(names)[:4])
    raise ValueError(
        f"unknown skeleton with joints {some[:80]}, ...: known are {known}; "
        "a joint map file (--joint-map) can add it"
    )


def _parse(text: str) -> JointMap:
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("it is not a JSON object")
    known = set(JointMap.__dataclass_fields__)
    unknown = sorted(set(value) - known)
    if unknown:
        raise ValueError(f"unknown entry '{unknown[0]}'")
    if "axes" in value:
        value["axes"] = tuple(value["axes"])
    return JointMap(**value)
