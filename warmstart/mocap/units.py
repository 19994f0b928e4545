"""Whether a recording's lengths are metres: :func:`check_units`.

Files of rotations and a translation (SMPL, DeepMimic) take their bones from a table, so legs of the
right length say nothing about the translation. Its unit shows in how high and how fast the pelvis
is, and in feet that slide far more than the legs move. Bounds are on medians over the frames: a
jump of the recording is for the quality report.
"""

from __future__ import annotations

import numpy as np

from warmstart.mocap.capture import SIDES, Capture

WINDOW = 0.25
"""Velocities and accelerations are means over this time (s), so that noise of a recording does not
count."""
SHORTEST = 0.1
"""Shortest window (s), in clips that are short themselves, from which an acceleration is taken."""
HEIGHT = 30.0
"""Largest median distance (m) of the pelvis from the floor z = 0. Recordings of ours: 1.1; a person
who stands, in centimetres: 90."""
SPEED = 25.0
"""Largest median speed of the pelvis (m/s). Recordings of ours: 5.5; a sprinter: 12.4."""
ACCELERATION = 40.0
"""Largest median acceleration of the pelvis (m/s^2). Recordings of ours: 16; a fall: 9.8."""
SLIP = (0.5, 30.0)
"""The lesser slip of both feet is wrong from the first (m/s) and from so many times the motion of
the foot against the pelvis on. Recordings of ours: 2.4 times; the same in centimetres: 70."""
SMALLER = (0.01, 0.001)
"""Centimetres and millimetres (m)..."""
EXPLAINED = 0.7
"""... of which one makes the feet slip less than this share of their motion against the pelvis.
Without it a still person on skis would count as one in another unit."""


def check_units(capture: Capture) -> None:
    """Raises ValueError, one sentence, for a recording whose lengths are evidently not metres."""
    p = capture.points
    pelvis = (p["L_Hip"] + p["R_Hip"]) / 2
    height = abs(float(np.median(pelvis[:, 2])))
    speed = _speed(pelvis, capture.fps)
    acceleration = _acceleration(pelvis, capture.fps)
    wrong = "the unit of length is wrong"
    if height > HEIGHT:
        what = f"its pelvis is {height:.0f} m above or below the floor"
    elif speed > SPEED:
        what, wrong = f"its pelvis moves at {speed:.0f} m/s", f"{wrong}, or the frame rate"
    elif acceleration > ACCELERATION:
        what = f"its pelvis speeds up or slows down at {acceleration:.0f} m/s^2"
        wrong += ", or the frame rate"
    elif _slips(pelvis, [p[side + "Ankle"] for side in SIDES], capture.fps):
        what = "its feet slide far more than its legs move"
    else:
        return
    raise ValueError(f"{what} for most of its time: {wrong}; positions must be in metres")


def _window(frames: int, fps: float) -> int:
    """Frames of :data:`WINDOW`, but so few that two jumps of a recording leave its medians."""
    return max(1, min(round(WINDOW * fps), frames // 12))


def _speed(points: np.ndarray, fps: float) -> float:
    """Median speed (m/s) of a point (T, 3)."""
    size = _window(len(points), fps)
    return float(np.median(np.linalg.norm(points[size:] - points[:-size], axis=1))) * fps / size


def _acceleration(points: np.ndarray, fps: float) -> float:
    """Median acceleration (m/s^2) of a point (T, 3); 0 for a clip too short to tell."""
    size = _window(len(points), fps)
    if len(points) <= 2 * size or size < SHORTEST * fps:
        return 0.0
    second = points[2 * size :] - 2 * points[size:-size] + points[: -2 * size]
    return float(np.median(np.linalg.norm(second, axis=1))) * (fps / size) ** 2


def _slips(pelvis: np.ndarray, ankles: list[np.ndarray], fps: float) -> bool:
    """Whether the feet would stand only if the pelvis (T, 3) moved a fraction as far."""
    size = _window(len(pelvis), fps)
    moves = pelvis[size:] - pelvis[:-size]
    steps = [(a - pelvis)[size:] - (a - pelvis)[:-size] for a in ankles]

    def slip(unit: float) -> float:
        """Median over the windows of the lesser slip of both feet (m)."""
        feet = [np.linalg.norm(unit * moves + step, axis=1) for step in steps]
        return float(np.median(np.minimum(*feet)))

    as_it_is, still = slip(1.0), slip(0.0)
    if as_it_is < SLIP[0] * size / fps or as_it_is < SLIP[1] * still:
        return False
    return min(slip(unit) for unit in SMALLER) < EXPLAINED * still
