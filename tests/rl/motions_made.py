"""Reference tables of made-up clips."""

from __future__ import annotations

from rl.motion import MotionTables
from warmstart.clip import Clip
from warmstart.library import pack


def tables(*clips: Clip) -> MotionTables:
    return MotionTables(pack((f"clip_{i}", c) for i, c in enumerate(clips)), "cpu")
