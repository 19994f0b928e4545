"""Does the panel tell faults from people? Known faults put into clips of people, one at a time.

    python -m rl.likeness_faults --clips LIBRARY --out FILE.json

takes the clips of a library that its reference does not hold (those of the split ``train``; no
policy is measured here, so nobody has trained on them), measures them by archive as they are, and
with each fault of ``FAULTS``. A mirror image is no fault: it must be measured like the original.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from rl import provenance
from rl.likeness import panel
from rl.likeness_motion import Motion, from_library
from rl.likeness_reference import Reference, people_of
from sports.humanoid.body import Body, load_body
from warmstart.atomic import prepare, write_json
from warmstart.clip import Clip, finite_difference_qvel
from warmstart.library import FPS, Library

CLIPS = 60
"""Clips at most of an archive, and in each fault, evenly taken."""


def sliding(motion: Motion) -> Motion:
    """Carried along x at 0.5 m/s."""
    qpos = motion.qpos.copy()
    qpos[:, 0] += 0.5 * np.arange(len(qpos)) / FPS
    return replace(motion, qpos=qpos)


def sunk(motion: Motion) -> Motion:
    """2 cm deeper."""
    qpos = motion.qpos.copy()
    qpos[:, 2] -= 0.02
    return replace(motion, qpos=qpos)


def jittering(motion: Motion) -> Motion:
    """Every hinge trembles by 0.02 rad at 12 Hz, each with its own phase."""
    phase = 2.399963 * np.arange(motion.qpos.shape[1] - 7)  # the golden angle
    qpos = motion.qpos.copy()
    time = np.arange(len(qpos))[:, None] / FPS
    qpos[:, 7:] += 0.02 * np.sin(2 * np.pi * 12.0 * time + phase)
    return replace(motion, qpos=qpos)


def hasty(motion: Motion) -> Motion:
    """Three times as fast."""
    return replace(motion, qpos=motion.qpos[::3].copy())


def stiff(motion: Motion) -> Motion:
    """A statue in the pose of the middle frame that is moved about as the pelvis was."""
    qpos = motion.qpos.copy()
    qpos[:, 7:] = qpos[len(qpos) // 2, 7:]
    return replace(motion, qpos=qpos)


def wheeling(motion: Motion) -> Motion:
    """Both arms circle at the shoulder, twice a second."""
    body = _table(motion.body)
    qpos = motion.qpos.copy()
    turn = 2 * np.pi * 2.0 * np.arange(len(qpos)) / FPS
    for side, sign in (("L", 1.0), ("R", -1.0)):
        qpos[:, 7 + body.dof_index(f"{side}_Shoulder_y")] += sign * turn
    return replace(motion, qpos=qpos)


def fallen(motion: Motion) -> Motion:
    """On its back: turned by a right angle about the heading's side, on the ground."""
    qpos = motion.qpos.copy()
    half = np.sqrt(0.5)
    w, x, y, z = qpos[:, 3:7].T
    # The root's attitude followed by a turn of -90 degrees about its own y axis.
    qpos[:, 3:7] = half * np.stack((w + y, x + z, y - w, z - x), 1)
    qpos[:, 2] = 0.12 + 0.1 * (qpos[:, 2] - qpos[:, 2].min())
    return replace(motion, qpos=qpos)


def mirrored(motion: Motion) -> Motion:
    """Left and right exchanged."""
    speeds = finite_difference_qvel(_table(motion.body), motion.qpos, FPS)
    clip = Clip(fps=FPS, body=motion.body, qpos=motion.qpos, qvel=speeds)
    return replace(motion, qpos=clip.mirrored().qpos)


FAULTS: dict[str, Callable[[Motion], Motion]] = {
    f.__name__: f for f in (mirrored, sliding, sunk, jittering, hasty, stiff, wheeling, fallen)
}


def measure(library: Library, reference: Reference) -> dict[str, dict]:
    """Panels of each archive as it is, and of the openly licensed clips with each fault."""
    train = library.split("train")
    origins = train.origins
    shown = people_of(train)
    panels = {}
    for archive in sorted({origins[i].archive for i in shown}):
        mine = _evenly([i for i in shown if origins[i].archive == archive])
        panels[archive] = panel(from_library(train.chosen(mine)), reference)
    free = _evenly(people_of(train, open_only=True))
    clips = from_library(train.chosen(free))
    panels["people"] = panel(clips, reference)
    for name, fault in FAULTS.items():
        panels[name] = panel([fault(c) for c in clips if len(c.qpos) > 5], reference)
    return panels


def main(args: Sequence[str] | None = None) -> None:
    """Measures and writes one JSON file; prints a row for each archive and fault."""
    import argparse

    parser = argparse.ArgumentParser(prog="python -m rl.likeness_faults", description=__doc__)
    parser.add_argument("--clips", required=True, help="a library that `mocap pack` wrote")
    parser.add_argument("--out", required=True, help="JSON file for the result")
    asked = parser.parse_args(args)
    library, reference = Library.load(asked.clips), Reference.load()
    out = prepare(asked.out)
    panels = measure(library, reference)
    kept = ("motions", "seconds", "windows", "human_like", "likeness")
    result = {
        "library": library.split("train").card(),
        "reference": reference.card(),
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
        "panels": {name: {k: p[k] for k in kept} for name, p in panels.items()},
    }
    write_json(out, result)
    for name, found in panels.items():
        rows = found["likeness"]
        cells = (
            f"{n} {row['mean']:.3g}{'*' if row['within'] is False else ''}"
            for n, row in rows.items()
            if row["mean"] is not None
        )
        print(f"{name}: {found['windows']} windows; {', '.join(cells)}")


def _evenly(clips: list[int]) -> list[int]:
    step = max(1.0, len(clips) / CLIPS)
    return [clips[int(i * step)] for i in range(min(CLIPS, len(clips)))]


@cache
def _table(name: str) -> Body:
    return load_body(name)


if __name__ == "__main__":
    main()
