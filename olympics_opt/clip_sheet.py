"""Clips on one picture: a row for each, the same moments above one another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from olympics_opt.camera import side_views
from olympics_opt.episode import Player
from olympics_opt.raycast import draw
from olympics_opt.render import font, write_picture
from sports.humanoid.body import load_body
from sports.scene import Scene, humanoid_scene
from warmstart.clip import Clip

TITLE = 30
"""Height of the strip above a row (pixels)."""


def clip_sheet(
    clips: Mapping[str, Clip],
    path: str | Path,
    *,
    columns: int = 6,
    panel: tuple[int, int] = (200, 240),
) -> Path:
    """Draws ``columns`` moments of each clip, from its beginning to the end of the shortest, seen
    from the side; no GL library is needed. All rows share the views of the first clip.

    Args:
        clips: by the words that are written above the row.
        path: PNG, JPEG or WebP file (`olympics_opt.render.write_picture`).
        columns: pictures in a row, at least 2.
        panel: width and height of a picture (pixels).

    Raises:
        ValueError: no clips, or fewer than 2 columns.
    """
    from PIL import Image, ImageDraw

    if not clips or columns < 2:
        raise ValueError("a sheet needs at least one clip and two columns")
    times = np.linspace(0.0, min(clip.duration for clip in clips.values()), columns)
    sheet = Image.new("RGB", (columns * panel[0], len(clips) * (TITLE + panel[1])), (255, 255, 255))
    ink, views = ImageDraw.Draw(sheet), None
    for row, (words, clip) in enumerate(clips.items()):
        scene = humanoid_scene(load_body(clip.body))
        player = Player(_episode(scene, clip.at(times)["qpos"], float(times[1])))
        views = views or side_views(player, range(columns), *panel)
        top = row * (TITLE + panel[1])
        ink.text((8, top + 5), words, font=font(16), fill=(20, 26, 32))
        for k, view in enumerate(views):
            image = Image.fromarray(draw(player.solids(k), view, (), ground=None, ruler=False))
            at = (k * panel[0], top + TITLE)
            sheet.paste(image, at)
            ink.text((at[0] + 6, at[1] + 4), f"{times[k]:.2f} s", font=font(13), fill=(40, 48, 56))
    return write_picture(sheet, path)


def _episode(scene: Scene, qpos: np.ndarray, dt: float) -> Any:
    """Frames as the player of pictures wants them."""
    nothing = np.zeros(0)
    return SimpleNamespace(
        task=scene.name, scene=scene, qpos=qpos, mocap_pos=nothing, ground_force=nothing, dt=dt
    )
