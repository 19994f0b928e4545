"""Pictures of recorded episodes: a sheet of frames for looking, and (`video.py`) a video.

The sheet needs no GL library: it is drawn by `raycast.py`.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from olympics_opt.episode import Episode, Player, Window, decisive_window, heading, touching
from olympics_opt.raycast import View, draw
from olympics_opt.scenery import LIMBS, ground_marks
from olympics_opt.video import render_video
from warmstart.atomic import write_bytes

__all__ = ["render_sheet", "render_video", "sheet_frames", "side_views"]

FRAMES = 12


def side_views(
    player: Player, frames: Sequence[int], width: int, height: int, max_metres: float = 3.8
) -> list[View]:
    """Side views at one scale, from the right of the direction of travel, following the athlete.

    The ground stays in the picture as long as ``max_metres`` allow; higher flights are followed.
    """
    agent = player.qpos[:, :7]
    chosen = agent[list(frames)]
    top = float(chosen[:, 2].max()) + 1.0
    metres = min(max(2.4, top + 0.2), max_metres)
    azimuth = heading(chosen) + math.pi / 2
    lowest = metres / 2 - 0.3
    return [
        View(
            np.array([p[0], p[1], max(lowest, p[2] + 1.0 - metres / 2)]),
            azimuth,
            math.radians(7.0),
            metres,
            width,
            height,
        )
        for p in chosen
    ]


def _font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size)


def _number(value: float) -> str:
    if not math.isfinite(value):
        return "-"  # the font has no dash
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _title(episode: Episode, label: str, commit: str) -> str:
    parts = [label, episode.task]
    for name in ("engine", "strength"):
        value = getattr(episode, name, "")
        parts += [f"strength {value}" if name == "strength" else value] if value else []
    parts += [f"seed {episode.seed}", f"world {episode.world}"]
    parts += [f"commit {commit}"] if commit else []
    return "  ·  ".join(parts)


def _panel(
    player: Player, window: Window, frame: int, view: View, marks: list, touch: list[str] | None
) -> Any:
    """One frame with its captions, as a PIL image."""
    from PIL import Image, ImageDraw

    picture = draw(player.solids(frame), view, marks)
    image = Image.fromarray(picture)
    ink = ImageDraw.Draw(image)
    font, small = _font(15), _font(12)
    dark = (30, 38, 46)
    zero = window.takeoff if window.takeoff is not None else 0
    seconds = (frame - zero) * player.episode.dt
    p = player.qpos[frame, :3]
    ink.text((8, 6), f"{seconds:+.2f} s", font=font, fill=dark)
    text = f"x {p[0]:.2f}  y {p[1]:.2f}  z {p[2]:.2f} m"
    ink.text((view.width_px - 8, 8), text, font=small, fill=dark, anchor="ra")
    for mark in marks:
        if not mark.label:
            continue
        corner = max(mark.corners, key=lambda c: -view.project(np.array([*c, 0.0]))[1])
        at = view.project(np.array([*corner, 0.0]))
        if 0 < at[0] < view.width_px and 0 < at[1] < view.height_px:
            nearest = max(view.project(np.array([*c, 0.0]))[1] for c in mark.corners)
            ink.text((at[0], min(nearest + 2, view.height_px - 16)), mark.label, font=small,
                     fill=(90, 80, 60), anchor="ma")  # fmt: skip
    words = "" if touch is None else "ground: " + ", ".join(touch) if touch else "in the air"
    if frame == window.landing:
        words = f"{words}  (landing)".strip()
    tone = (150, 30, 20) if touch else dark
    at = (8, view.height_px - 20)
    ink.text(at, words, font=small, fill=tone, stroke_width=2, stroke_fill=(240, 240, 240))
    ink.rectangle((0, 0, view.width_px - 1, view.height_px - 1), outline=(255, 255, 255))
    return image


def sheet_frames(window: Window, count: int = FRAMES) -> list[int]:
    """Frames of a sheet: evenly spread over the window, the landing among them.

    Shorter windows repeat no frame; they give fewer.
    """
    frames = np.unique(np.linspace(window.start, window.stop, count).round().astype(int))
    if window.landing is not None and len(frames) > 2 and window.landing not in frames:
        nearest = int(np.abs(frames[1:-1] - window.landing).argmin()) + 1
        frames[nearest] = window.landing
    return sorted({int(f) for f in frames})


def render_sheet(
    recordings: dict[str, Episode] | Sequence[Episode],
    path: str | Path,
    *,
    commit: str = "",
    columns: int = 4,
    panel: tuple[int, int] = (480, 330),
) -> Path:
    """Draws 12 frames of each recording on one PNG, without any GL library.

    Args:
        recordings: episodes by label (``{"best": ..., "median": ...}``), or in that order.
        path: PNG file, written atomically.
        commit: the project's commit, printed with the seed.
        columns: panels in a row.
        panel: width and height of a panel (pixels).

    Returns:
        The path.

    Raises:
        ValueError: no recordings, or a recording without frames.
    """
    from PIL import Image, ImageDraw

    if not isinstance(recordings, dict):
        recordings = dict(zip(("best", "median", *map(str, range(2, 99))), recordings))
    if not recordings:
        raise ValueError("a sheet needs at least one recording; evaluate with record > 0")
    strips = []
    for label, episode in recordings.items():
        if len(episode.qpos) == 0:
            raise ValueError(f"recording '{label}' of '{episode.task}' has no frames")
        player = Player(episode)
        window = decisive_window(episode, player)
        frames = sheet_frames(window)
        marks = ground_marks(episode.scene)
        has_force = np.size(getattr(episode, "ground_force", ())) > 0
        panels = [
            _panel(player, window, f, view, marks, touching(episode, f) if has_force else None)
            for f, view in zip(frames, side_views(player, frames, *panel))
        ]
        rows = math.ceil(len(panels) / columns)
        strip = Image.new("RGB", (columns * panel[0], 62 + rows * panel[1]), (255, 255, 255))
        ink = ImageDraw.Draw(strip)
        ink.text((10, 6), _title(episode, label, commit), font=_font(21), fill=(20, 26, 32))
        facts = "   ".join(f"{k} {_number(v)}" for k, v in episode.metrics.items())
        ink.text((10, 36), facts, font=_font(15), fill=(80, 88, 96))
        _legend(ink, strip.width)
        for i, image in enumerate(panels):
            strip.paste(image, (i % columns * panel[0], 62 + i // columns * panel[1]))
        strips.append(strip)
    sheet = Image.new(
        "RGB", (max(s.width for s in strips), sum(s.height for s in strips)), (255, 255, 255)
    )
    y = 0
    for strip in strips:
        sheet.paste(strip, (0, y))
        y += strip.height
    buffer = io.BytesIO()
    sheet.save(buffer, "PNG", optimize=True)
    return write_bytes(path, buffer.getvalue())


def _legend(ink: Any, width: int) -> None:
    """Names the limb colours in the upper right corner."""
    x, font = width - 10, _font(13)
    for name, color in reversed(LIMBS.items()):
        label = name.replace("_", " ")
        x -= int(ink.textlength(label, font=font))
        ink.text((x, 9), label, font=font, fill=(60, 68, 76))
        x -= 17
        ink.ellipse((x, 10, x + 13, 23), fill=color)
        x -= 12
