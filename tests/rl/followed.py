"""What the tests of following share: a stroke of a demonstration, as if it had been captured."""

from __future__ import annotations

from dataclasses import replace

from warmstart.bank import demonstration_files
from warmstart.clip import Clip

BACKHAND = next(f for f in demonstration_files("table_tennis") if "backhand" in f.name)


def backhand() -> Clip:
    """At 30 frames a second, without the ball and without what is known of its making."""
    demonstration = Clip.load(BACKHAND)
    return replace(demonstration, meta={}, object_qpos=None, object_qvel=None).resample(30.0)
