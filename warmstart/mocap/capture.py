"""What every reader gives: named joints of a person over time, in our world.

World: x forward, y left, z up; m, s. Joints carry the names of our links (``L_Knee`` is the joint
between thigh and shin), whatever the file calls them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

FROM_Y_UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""(3, 3) from axes with y up, z forward, x left (SMPL, ASF, BVH) to ours."""

SIDES = ("L_", "R_")
REQUIRED = (
    *(side + joint for side in SIDES for joint in ("Hip", "Knee", "Ankle")),
    "Neck",
    *(side + joint for side in SIDES for joint in ("Shoulder", "Elbow", "Wrist")),
)
"""Joints without which a motion cannot be put on our body."""
KEY_JOINTS = (*REQUIRED, "L_Toe", "R_Toe", "Head")
"""Joints that are fitted, where the file has them, and over which the joint error is a mean."""
LEG = (0.4, 1.3)
"""Shortest and longest leg, hip to ankle along the bones, that is taken for one in metres."""
FPS = (5.0, 1000.0)
"""Lowest and highest frame rate of a recording."""
MAX_FRAMES = 400_000
T_POSE = {"arm": 0.93, "leg": 0.966}
"""Cosine of the angle within which a limb counts as stretched in a T-pose: 21 and 15 degrees (the
forearms of some skeletons point forward a little in theirs)."""


@dataclass(frozen=True, eq=False)
class Capture:
    """A recorded motion. Raises ValueError, one sentence, for one that cannot be of a person."""

    fps: float
    points: Mapping[str, np.ndarray]
    """Joint name -> (T, 3) position (m)."""
    turns: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Link name -> (T, 3, 3) rotation of that part of the skeleton, world <- part."""
    rest: Literal["t_pose", "unknown"] = "unknown"
    """``t_pose``: turns are the identity when the person stands in our zero pose. ``unknown``: each
    part has axes of its own, fixed in it."""
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.fps) and FPS[0] <= self.fps <= FPS[1]):
            raise ValueError(
                f"{self.fps:.6g} frames a second: a recording has {FPS[0]:.0f} to {FPS[1]:.0f}"
            )
        missing = [name for name in REQUIRED if name not in self.points]
        if missing:
            raise ValueError(f"the skeleton has no joint for {missing[0]}")
        frames = self.num_frames
        if not 2 <= frames <= MAX_FRAMES:
            raise ValueError(
                f"{frames} frame{'' if frames == 1 else 's'}: a motion has 2 to {MAX_FRAMES}"
            )
        for name, values in (*self.points.items(), *self.turns.items()):
            if len(values) != frames:
                raise ValueError(f"{name} has {len(values)} frames, the other joints {frames}")
            if not np.isfinite(values).all():
                frame = int(np.argwhere(~np.isfinite(values))[0, 0])
                raise ValueError(f"{name} is not a number at frame {frame}")
            if np.abs(values).max() > 1e5:
                raise ValueError(f"{name} is {np.abs(values).max():.3g} m from the origin")
        leg = self.leg
        if not LEG[0] <= leg <= LEG[1]:
            raise ValueError(
                f"its legs are {leg:.3g} m long: the unit of length is wrong, or this is no person"
            )

    @property
    def num_frames(self) -> int:
        return len(self.points["Neck"])

    @property
    def leg(self) -> float:
        """Length of a leg, hip to ankle along the bones (m): mean of both, median of frames."""
        p = self.points
        bones = [
            np.linalg.norm(p[side + a] - p[side + b], axis=1)
            for side in SIDES
            for a, b in (("Hip", "Knee"), ("Knee", "Ankle"))
        ]
        return float(np.median(sum(bones)) / 2)

    def rows(self, keep: slice) -> Capture:
        """The same recording with some of its frames."""
        return replace(
            self,
            points={name: values[keep] for name, values in self.points.items()},
            turns={name: values[keep] for name, values in self.turns.items()},
        )


def unit(vector: np.ndarray) -> np.ndarray:
    """(..., 3) of length 1; zero stays zero."""
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12)


def without_t_pose(capture: Capture) -> Capture:
    """The recording from the first frame on that is not the T-pose of a calibration.

    A T-pose: both arms stretched sideways and both legs downward. Raises ValueError when fewer than
    2 frames are left.
    """
    p = capture.points
    across = unit(p["L_Shoulder"] - p["R_Shoulder"])
    down = unit(p["L_Ankle"] + p["R_Ankle"] - 2 * p["Neck"])
    still = np.ones(capture.num_frames, dtype=bool)
    for side, sign in zip(SIDES, (1.0, -1.0)):
        for a, b in (("Shoulder", "Elbow"), ("Elbow", "Wrist")):
            bone = unit(p[side + b] - p[side + a])
            still &= sign * (bone * across).sum(1) > T_POSE["arm"]
        for a, b in (("Hip", "Knee"), ("Knee", "Ankle")):
            still &= (unit(p[side + b] - p[side + a]) * down).sum(1) > T_POSE["leg"]
    first = capture.num_frames if still.all() else int(np.argmin(still))
    if first == 0:
        return capture
    if capture.num_frames - first < 2:
        raise ValueError("every frame is the T-pose of a calibration: there is no motion in it")
    return capture.rows(slice(first, None))
