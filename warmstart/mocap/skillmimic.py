"""SkillMimic-style npz: positions of the links of an SMPL-X figure, Z up.

Entries: ``body_position`` (T, 53, 3) m, ``root_rotvec`` (T, 3) rad, ``fps``; ``root_position``
(T, 3) and the ball's entries may be there. Links are in depth-first order: ours of SMPL-X with one
more in the spine. Source: Wang et al., SkillMimic (2024), its humanoid model.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sports.humanoid.body import load_body
from warmstart.mocap.capture import FROM_Y_UP, Capture
from warmstart.mocap.kinematics import exp

EXTRA = "Spine2"
ENTRIES = ("body_position", "root_rotvec", "fps")
_BODY = ("Pelvis", "Neck", "Head")
_SIDED = ("Hip", "Knee", "Ankle", "Toe", "Shoulder", "Elbow", "Wrist")


def link_order() -> tuple[str, ...]:
    """The 53 links in the file's order."""
    names = list(load_body("smplx").link_names)
    names.insert(names.index("Spine") + 1, EXTRA)
    return tuple(names)


def read_skillmimic(arrays: Mapping[str, np.ndarray], fps: float | None = None) -> Capture:
    """The motion of a SkillMimic-style file. Raises ValueError for anything that is not one."""
    names = link_order()
    position = arrays["body_position"]
    if position.ndim != 3 or position.shape[1:] != (len(names), 3):
        raise ValueError(f"body_position has shape {position.shape}, not (frames, 53, 3)")
    if fps is None:
        if "fps" not in arrays or arrays["fps"].size != 1:
            raise ValueError("it does not say its frame rate: give it with --source-fps")
        fps = float(arrays["fps"].reshape(()))
    turns = {}
    if "root_rotvec" in arrays:
        root = arrays["root_rotvec"]
        if root.shape != (len(position), 3):
            raise ValueError(f"root_rotvec has shape {root.shape}, not ({len(position)}, 3)")
        turns["Pelvis"] = exp(root) @ FROM_Y_UP.T
    wanted = (*_BODY, *(f"{s}_{joint}" for s in "LR" for joint in _SIDED))
    points = {name: position[:, names.index(name)] for name in wanted}
    return Capture(fps, points, turns, "t_pose", meta={"skeleton": "skillmimic"})
