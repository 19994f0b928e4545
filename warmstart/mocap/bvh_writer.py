"""Our own body's motion as a BVH file, for other programs and for the way back through a reader.

The skeleton is known to the reader as ``olympics_opt``: centimetres, y up, z forward, x left. Those
axes are a cyclic exchange of ours (our x, y, z are z, x, y there), so that our hinges, intrinsic
x-y-z, are the channels Zrotation Xrotation Yrotation as they are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sports.humanoid.body import Body, load_body
from warmstart import rotation
from warmstart.atomic import write_text
from warmstart.clip import Clip
from warmstart.mocap.capture import FROM_Y_UP
from warmstart.mocap.kinematics import matrix

UNIT = 0.01
"""Of the file (m)."""
END = 5.0
"""Length of the bones at the ends of limbs (file units), which nothing depends on."""


def bvh_text(clip: Clip) -> str:
    """The motion of a clip as the text of a BVH file."""
    body = load_body(clip.body)
    lines = ["HIERARCHY", *_hierarchy(body, body.link_names[0], 0)]
    columns = [clip.qpos[:, :3] @ FROM_Y_UP / UNIT, np.degrees(root_angles(clip.qpos[:, 3:7]))]
    columns.append(np.degrees(clip.qpos[:, 7:]))
    lines += ["MOTION", f"Frames: {clip.num_frames}", f"Frame Time: {1 / clip.fps:.9f}"]
    lines += [" ".join(f"{x:.7f}" for x in row) for row in np.concatenate(columns, axis=1)]
    return "\n".join(lines) + "\n"


def write_bvh(clip: Clip, path: str | Path) -> Path:
    """Writes a BVH file, atomically. Raises OSError when it cannot be written."""
    return write_text(path, bvh_text(clip))


def root_angles(quat: np.ndarray) -> np.ndarray:
    """(T, 3) intrinsic x-y-z angles (rad) of attitudes (T, 4) w x y z."""
    m = matrix(quat / np.linalg.norm(quat, axis=-1, keepdims=True))
    x = np.arctan2(-m[:, 1, 2], m[:, 2, 2])
    # z after x is known: well defined at the singular pose too.
    back = rotation.exp(-x[:, None] * np.array([1.0, 0.0, 0.0]))
    rest = matrix(rotation.multiply(back, quat))
    y = np.arctan2(rest[:, 0, 2], rest[:, 2, 2])
    return np.stack([x, y, np.arctan2(rest[:, 1, 0], rest[:, 1, 1])], axis=1)


def _hierarchy(body: Body, name: str, depth: int) -> list[str]:
    """A joint and all beyond it, in the order of the body's table."""
    link, pad = body.links[body.link_index(name)], "  " * depth
    offset = np.zeros(3) if depth == 0 else np.array(link.offset) @ FROM_Y_UP / UNIT
    moves = "6 Xposition Yposition Zposition" if depth == 0 else "3"
    lines = [
        f"{pad}{'ROOT' if depth == 0 else 'JOINT'} {name}",
        f"{pad}{{",
        f"{pad}  OFFSET {offset[0]:.7f} {offset[1]:.7f} {offset[2]:.7f}",
        f"{pad}  CHANNELS {moves} Zrotation Xrotation Yrotation",
    ]
    children = [other.name for other in body.links if other.parent == name]
    for child in children:
        lines += _hierarchy(body, child, depth + 1)
    if not children:
        end = f"{pad}    OFFSET {END} 0.0 0.0"
        lines += [f"{pad}  End Site", f"{pad}  {{", end, f"{pad}  }}"]
    return [*lines, f"{pad}}}"]
