"""What the motions of people ask of the athlete's joints: the tracker follows their clips.

A captured clip tells no torques, and how fast a person's torques change was an estimate for a joint
held still (``rl.likeness_terms.TORQUE_RISE``). So the shipped motion tracker, an athlete
of human strength, follows clips that its training did not see, and what its joints gave is
measured as that of any policy.

    python -m rl.likeness_effort --clips LIBRARY --out FILE.json

measures the openly licensed clips of both splits of a library; of each split those count that were
followed to the end. The limit of the panel, ``rl.likeness.HUMAN_LIMITS``, comes from the held-out
ones. What a tracker needs to stay with its clip is in these figures, so they are more than the
person's own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rl import provenance
from rl.following import Follower
from rl.likeness import HUMAN_LIMITS
from rl.likeness_motion import from_clip
from rl.likeness_reference import BAND, people_of
from rl.likeness_terms import PERCENTILE, figures
from rl.tracker import LOST
from rl.tracker_evaluation import number
from sports.humanoid.body import load_body
from warmstart.atomic import prepare, write_json
from warmstart.clip import Clip, finite_difference_qvel
from warmstart.library import FPS, Library

NAMES = (*HUMAN_LIMITS, "penetration", "jerk")
"""Figures that are kept."""
QUANTILES = {"low": BAND[0], "middle": 0.5, "high": BAND[1], "most": 1.0}


def measure(
    library: Library, follower: Follower, progress: Callable[[int, int], None] | None = None
) -> list[dict[str, Any]]:
    """One row for each openly licensed clip of a library that shows a person.

    A row has the clip's name, tag and split, whether it was ``followed`` to its end, its ``speed``
    (m/s of the pelvis along the ground, which one frame of twenty exceeds), and the figures of
    what was played; those of a clip that was lost are of the part before.
    """
    rows = []
    wanted = people_of(library, open_only=True)
    for done, i in enumerate(wanted):
        origin, clip = library.origins[i], clip_of(library, i)
        played = follower(clip, LOST)
        played = replace(played, meta={**played.meta, "strength": follower.strength})
        found = figures(from_clip(played, origin.name))
        rows.append(
            {
                "name": origin.name,
                "tag": origin.tag,
                "split": "held_out" if origin.held_out else "train",
                "followed": played.num_frames == clip.num_frames,
                "seconds": round(played.duration, 3),
                "speed": round(speed(clip), 3),
                **{name: number(found[name], 4) for name in NAMES},
            }
        )
        if progress is not None:
            progress(done + 1, len(wanted))
    return rows


def clip_of(library: Library, index: int) -> Clip:
    """A clip of a library, in double precision."""
    qpos, qvel = library.qpos(index).astype(float), library.qvel(index)
    if qvel is None:
        qvel = finite_difference_qvel(load_body(library.body), qpos, FPS)
    return Clip(fps=FPS, body=library.body, qpos=qpos, qvel=qvel.astype(float))


def speed(clip: Clip) -> float:
    """m/s of the pelvis along the ground that one frame of twenty exceeds."""
    step = np.linalg.norm(np.diff(clip.qpos[:, :2], axis=0), axis=1) * clip.fps
    return float(np.percentile(step, PERCENTILE))


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Of each split: clips, those ``followed``, and quantiles over these of each figure."""
    out: dict[str, Any] = {}
    for split in ("held_out", "train"):
        mine = [row for row in rows if row["split"] == split]
        whole = [row for row in mine if row["followed"]]
        figures_: dict[str, Any] = {}
        for name in NAMES:
            values = [row[name] for row in whole if row[name] is not None]
            figures_[name] = {"n": len(values)}
            if values:
                found = {k: float(np.quantile(values, q)) for k, q in QUANTILES.items()}
                figures_[name] |= {k: round(v, 4) for k, v in found.items()}
        out[split] = {"clips": len(mine), "followed": len(whole), "figures": figures_}
    return out


def main(args: Sequence[str] | None = None) -> None:
    """Measures, writes one JSON file and prints the quantiles."""
    import argparse

    parser = argparse.ArgumentParser(prog="python -m rl.likeness_effort", description=__doc__)
    parser.add_argument("--clips", required=True, help="a library that `mocap pack` wrote")
    parser.add_argument("--out", required=True, help="JSON file for the result")
    parser.add_argument("--tracker", default="pretrained", help="who follows them")
    asked = parser.parse_args(args)
    library, follower = Library.load(asked.clips), Follower(asked.tracker)
    out = prepare(asked.out)

    def show(done: int, clips: int) -> None:
        print(f"\rclip {done} of {clips}", end="\n" if done == clips else "", flush=True)

    rows = measure(library, follower, show)
    result = {
        "library": library.card(),
        "tracker": str(follower),
        "strength": follower.strength,
        "lost": LOST,
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
        "splits": summarise(rows),
        "clips": rows,
    }
    write_json(out, result, indent=None)
    for split, found in result["splits"].items():
        print(f"{split}: {found['followed']} of {found['clips']} clips followed")
        for name, row in found["figures"].items():
            print(f"  {name}: " + ", ".join(f"{k} {v}" for k, v in row.items()))


if __name__ == "__main__":
    main()
