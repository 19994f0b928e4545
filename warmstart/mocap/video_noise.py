"""Errors like those of motions reconstructed from video, put on a clip.

Such a reconstruction is off in two ways: it drifts around the truth for tenths of a second, where a
limb was hidden or its depth misjudged, and it jitters from frame to frame. Both are drawn here for
every hinge and for the root, the drift as white noise through a Gaussian in time, so that clips of
known truth show what a method makes of bad ones. Velocities are those of the disturbed positions,
as in any motion that was not simulated.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from sports.humanoid.body import load_body
from warmstart import rotation
from warmstart.clip import Clip, clip_files, finite_difference_qvel


@dataclass(frozen=True)
class VideoNoise:
    """Standard deviations of the errors. With the default ones links are some 5 cm off, the error
    that reconstructions report against motion capture."""

    drift: float = 0.04
    """Of each hinge, slow (rad)."""
    jitter: float = 0.003
    """Of each hinge, from frame to frame (rad)."""
    root_drift: float = 0.02
    """Of the root's place, slow (m)."""
    root_jitter: float = 0.001
    """Of the root's place, from frame to frame (m)."""
    turn_drift: float = 0.03
    """Of the root's attitude about each axis, slow (rad)."""
    turn_jitter: float = 0.0015
    """Of the root's attitude about each axis, from frame to frame (rad)."""
    width: float = 0.15
    """Standard deviation of the Gaussian that makes the drift slow (s)."""

    def __post_init__(self) -> None:
        values = asdict(self)
        for name, value in values.items():
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"video noise: {name} must be 0 or more, not {value!r}")


def disturbed(clip: Clip, noise: VideoNoise | None = None, seed: int = 0) -> Clip:
    """The clip with errors. Objects stay where they were; PD targets are dropped, since they carry
    the motion as it was."""
    c, rng, n = noise or VideoNoise(), np.random.default_rng(seed), clip.num_frames
    body = load_body(clip.body)

    def errors(drift: float, jitter: float, count: int) -> np.ndarray:
        slow = rng.standard_normal((n, count))
        if c.width > 0.0:
            # Reflected at the ends, a filtered row keeps its variance but for this factor.
            width = c.width * clip.fps
            slow = gaussian_filter1d(slow, width, axis=0, mode="reflect") / _gain(width)
        return drift * slow + jitter * rng.standard_normal((n, count))

    qpos = clip.qpos.copy()
    qpos[:, :3] += errors(c.root_drift, c.root_jitter, 3)
    turn = rotation.exp(errors(c.turn_drift, c.turn_jitter, 3))
    qpos[:, 3:7] = rotation.multiply(qpos[:, 3:7], turn)
    qpos[:, 7:] += errors(c.drift, c.jitter, body.num_dofs)
    qvel = finite_difference_qvel(body, qpos, clip.fps)
    meta = {**clip.meta, "video_noise": asdict(c) | {"seed": seed}}
    return replace(clip, qpos=qpos, qvel=qvel, ctrl=None, meta=meta)


def _gain(width: float) -> float:
    """Standard deviation of white noise of 1 after a Gaussian filter of ``width`` samples."""
    impulse = np.zeros(2 * int(5 * width) + 3)
    impulse[len(impulse) // 2] = 1.0
    return float(np.linalg.norm(gaussian_filter1d(impulse, width)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Disturbs clips; 2 for what is no clip."""
    parser = argparse.ArgumentParser(prog="python -m warmstart.mocap.video_noise")
    parser.add_argument("clips", type=Path, nargs="+", help="clips, or folders of them")
    parser.add_argument("--out", type=Path, required=True, help="folder for the disturbed ones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--copies", type=int, default=1, help="of each clip, with other errors")
    options = parser.parse_args(arguments)
    try:
        found = [path for source in options.clips for path, _ in clip_files(source)]
        made = [
            (f"{path.stem}_{k}.npz", disturbed(Clip.load(path), seed=options.seed + 1000 * k + i))
            for i, path in enumerate(found)
            for k in range(options.copies)
        ]
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    options.out.mkdir(parents=True, exist_ok=True)
    for name, clip in made:
        clip.save(options.out / name)
    print(f"{options.out}: {len(made)} clips")
    return 0


if __name__ == "__main__":
    sys.exit(main())
