"""Pictures of recorded episodes: a sheet of frames for looking, and (`video.py`) a video.

The sheet needs no GL library: it is drawn by `raycast.py`.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from olympics_opt.camera import inset, must_show, reach, shots, stand, things
from olympics_opt.episode import Episode, Player, Window, decisive_window, touching
from olympics_opt.moments import Event, chosen_frames, events, sheet_frames
from olympics_opt.raycast import View, draw
from olympics_opt.scenery import LIMBS, Mark, ground_marks
from olympics_opt.scenery.athletes import SHIRTS
from olympics_opt.video import render_video
from warmstart.atomic import write_bytes

__all__ = ["picture", "render_sheet", "render_video"]

PANEL, WIDE_PANEL = (480, 330), (640, 400)
"""Width and height of a panel (pixels), and of one that shows a field."""
TRAIL, TRAIL_SECONDS = (190, 60, 30), 3.0
"""Colour of a ball's path, and how much of it is drawn (s)."""
SMALL = 5.0
"""A ball of a smaller radius (pixels) gets a ring around it."""
RULER_BELOW = math.radians(13.0)
"""Cameras tilted further than this see the ground, not the ruler behind the athlete."""


def font(size: int) -> Any:
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


def picture(player: Player, frame: int, view: View, marks: Sequence[Mark], since: int = 0) -> Any:
    """One frame as a PIL image: the scene, the way of the ball from frame ``since`` until now, and
    where the picture is wide an athlete from near in its corner."""
    from PIL import Image, ImageDraw

    solids, ruler = player.solids(frame), view.pitch < RULER_BELOW
    image = Image.fromarray(draw(solids, view, marks, ground=player.ground, ruler=ruler))
    ink = ImageDraw.Draw(image)
    ways = [player.thing(name)[since : frame + 1] for name in things(player.scene)]
    for name, way in zip(things(player.scene), ways):
        _trail(ink, view, way, reach(player.scene, name))
    close = inset(player, frame, view)
    if close is not None:
        small = Image.fromarray(draw(solids, close, marks, ground=player.ground, ruler=False))
        seen = view.project(np.concatenate((must_show(player, frame, view), *ways)))
        at = _free_corner(seen, view, small.size)
        image.paste(small, at)
        edge = (at[0] - 1, at[1] - 1, at[0] + small.width, at[1] + small.height)
        ink.rectangle(edge, outline=(255, 255, 255), width=2)
    return image


def _trail(ink: Any, view: View, path: np.ndarray, size: float) -> None:
    """The way of a ball as dots, one a step, joined where it did not jump to a new place; a ring
    around a ball of radius ``size`` (m) that is too small to be seen."""
    points = view.project(path)
    for i, (a, b) in enumerate(pairwise(points)):
        if np.linalg.norm(path[i + 1] - path[i]) < 2.0:
            ink.line((*a, *b), fill=TRAIL, width=1)
    for x, y in points[:-1]:
        ink.ellipse((x - 1.5, y - 1.5, x + 1.5, y + 1.5), fill=TRAIL)
    if len(points) and size * view.scale < SMALL:
        x, y = points[-1]
        r = SMALL + 2.0
        ink.ellipse((x - r, y - r, x + r, y + r), outline=TRAIL, width=1)


def _free_corner(seen: np.ndarray, view: View, size: tuple[int, int]) -> tuple[int, int]:
    """Where in a wide picture an inset hides the fewest of the points ``seen`` (K, 2); the upper
    right corner where all are as good."""
    width, height = view.width_px, view.height_px
    edge, top = 8, 26
    places = [
        (width - size[0] - edge, top),
        (edge, top),
        (width - size[0] - edge, height - size[1] - top),
        (edge, height - size[1] - top),
    ]

    def hidden(at: tuple[int, int]) -> float:
        middle = np.array(at) + np.array(size) / 2
        room = np.array(size) / 2 + 6
        return sum(float((np.abs(p - middle) < room).all()) for p in seen)

    return min(places, key=hidden)


def _panel(player: Player, window: Window, frame: int, image: Any, view: View, words: str) -> Any:
    """A picture with its captions."""
    from PIL import ImageDraw

    ink = ImageDraw.Draw(image)
    large, small = font(15), font(12)
    dark = (30, 38, 46)
    zero = window.takeoff if window.takeoff is not None else 0
    seconds = (frame - zero) * player.episode.dt
    around: dict[str, Any] = {"stroke_width": 2, "stroke_fill": (240, 240, 240)}
    ink.text((8, 6), f"{seconds:+.2f} s", font=large, fill=dark, **around)
    at = (view.width_px - 8, 8)
    around["stroke_width"] = 1
    ink.text(at, _facts(player, frame), font=small, fill=dark, anchor="ra", **around)
    tone = (150, 30, 20) if words not in ("", "in the air") else dark
    ink.text((8, view.height_px - 20), words, font=small, fill=tone, **around)
    ink.rectangle((0, 0, view.width_px - 1, view.height_px - 1), outline=(255, 255, 255))
    return image


def _facts(player: Player, frame: int) -> str:
    """Where the ball is and how fast, or where the athlete is."""
    names = things(player.scene)
    p = player.thing(names[0])[frame] if names else player.qpos[frame, :3]
    text = f"x {p[0]:.2f}  y {p[1]:.2f}  z {p[2]:.2f} m"
    if not names:
        return text
    qvel = np.asarray(getattr(player.episode, "qvel", np.zeros(0)))
    if qvel.size:
        v = qvel[frame, player.scene.object_qvel(names[0])][:3]
        text += f"  {np.linalg.norm(v):.1f} m/s"
    return f"{names[0]}  {text}"


def labels(ink: Any, view: View, marks: Sequence[Mark]) -> None:
    """Names of the marks below them."""
    small, taken = font(12), []
    for mark in marks:
        if not mark.label:
            continue
        corner = max(mark.corners, key=lambda c: -view.project(np.array([*c, 0.0]))[1])
        at = view.project(np.array([*corner, 0.0]))
        if not (0 < at[0] < view.width_px and 0 < at[1] < view.height_px):
            continue
        nearest = max(view.project(np.array([*c, 0.0]))[1] for c in mark.corners)
        place = (at[0], min(nearest + 2, view.height_px - 16))
        half = ink.textlength(mark.label, font=small) / 2 + 3
        if any(abs(x - at[0]) < half + w and abs(y - place[1]) < 13 for x, y, w in taken):
            continue
        taken.append((*place, half))
        ink.text(place, mark.label, font=small, fill=(90, 80, 60), anchor="ma")


def _words(player: Player, window: Window, frame: int, happened: Sequence[Event]) -> str:
    """What happens in a frame: its events; for one athlete alone also what touches the ground."""
    near = [e.word for e in happened if abs(e.frame - frame) <= 1]
    words = ", ".join(dict.fromkeys(near))
    episode = player.episode
    alone = player.scene.num_agents == 1 and not things(player.scene)
    if alone and np.size(getattr(episode, "ground_force", ())):
        touch = touching(episode, frame)
        ground = "ground: " + ", ".join(touch) if touch else "in the air"
        words = f"{words}   {ground}".strip()
    if frame == window.landing:
        words = f"{words}  (landing)".strip()
    return words


def render_sheet(
    recordings: dict[str, Episode] | Sequence[Episode],
    path: str | Path,
    *,
    commit: str = "",
    columns: int | None = None,
    panel: tuple[int, int] | None = None,
) -> Path:
    """Draws 12 frames of each recording on one picture, without any GL library.

    Args:
        recordings: episodes by label (``{"best": ..., "median": ...}``), or in that order.
        path: PNG file, or a JPEG or WebP (``.jpg``, ``.webp``) of half the width for a page;
            written atomically.
        commit: the project's commit, printed with the seed.
        columns: panels in a row; by default as many as suit the sport.
        panel: width and height of a panel (pixels); likewise.

    Returns:
        The path.

    Raises:
        ValueError: no recordings, or a recording without frames.
    """
    from PIL import Image

    if not isinstance(recordings, dict):
        recordings = dict(zip(("best", "median", *map(str, range(2, 99))), recordings))
    if not recordings:
        raise ValueError("a sheet needs at least one recording; evaluate with record > 0")
    strips = []
    for label, episode in recordings.items():
        if len(episode.qpos) == 0:
            raise ValueError(f"recording '{label}' of '{episode.task}' has no frames")
        strips.append(_strip(Player(episode), _title(episode, label, commit), columns, panel))
    sheet = Image.new(
        "RGB", (max(s.width for s in strips), sum(s.height for s in strips)), (255, 255, 255)
    )
    y = 0
    for strip in strips:
        sheet.paste(strip, (0, y))
        y += strip.height
    return write_picture(sheet, path)


def write_picture(image: Any, path: str | Path) -> Path:
    """Writes a picture (`PIL.Image`) as its name says: PNG, or for a page a JPEG or WebP of half
    the width; atomically."""
    from PIL import Image

    buffer = io.BytesIO()
    suffix = Path(path).suffix.lower()
    if suffix in (".jpg", ".webp"):
        half = image.resize((image.width // 2, image.height // 2), Image.Resampling.LANCZOS)
        if suffix == ".jpg":
            half.save(buffer, "JPEG", quality=65, optimize=True)
        else:
            half.save(buffer, "WEBP", quality=70, method=6)
    else:
        image.save(buffer, "PNG", optimize=True)
    return write_bytes(path, buffer.getvalue())


def _strip(player: Player, title: str, columns: int | None, panel: tuple[int, int] | None) -> Any:
    """The frames of one recording under their title."""
    from PIL import Image, ImageDraw

    episode = player.episode
    wide = stand(player.scene) is not None
    columns = columns or (3 if wide else 4)
    panel = panel or (WIDE_PANEL if wide else PANEL)
    window = decisive_window(episode, player)
    happened = [] if window.takeoff is not None else events(player)
    frames = chosen_frames(window, happened) if happened else sheet_frames(window)
    marks = ground_marks(episode.scene)
    panels = []
    for frame, view in zip(frames, shots(player, frames, *panel)):
        since = max(window.start, frame - round(TRAIL_SECONDS / episode.dt))
        image = picture(player, frame, view, marks, since=since)
        labels(ImageDraw.Draw(image), view, marks)
        words = _words(player, window, frame, happened)
        panels.append(_panel(player, window, frame, image, view, words))
    rows = math.ceil(len(panels) / columns)
    strip = Image.new("RGB", (columns * panel[0], 62 + rows * panel[1]), (255, 255, 255))
    ink = ImageDraw.Draw(strip)
    ink.text((10, 6), title, font=font(21), fill=(20, 26, 32))
    facts = "   ".join(f"{k} {_number(v)}" for k, v in episode.metrics.items())
    ink.text((10, 36), facts, font=font(15), fill=(80, 88, 96))
    _legend(ink, strip.width, player.scene.num_agents)
    for i, image in enumerate(panels):
        strip.paste(image, (i % columns * panel[0], 62 + i // columns * panel[1]))
    return strip


def _legend(ink: Any, width: int, agents: int) -> None:
    """Names the limb colours, or the teams', in the upper right corner."""
    x, small = width - 10, font(13)
    teams = {"team 0 (towards +x)": SHIRTS[0], "team 1": SHIRTS[1]}
    for name, color in reversed((LIMBS if agents == 1 else teams).items()):
        label = name.replace("_", " ")
        x -= int(ink.textlength(label, font=small))
        ink.text((x, 9), label, font=small, fill=(60, 68, 76))
        x -= 17
        ink.ellipse((x, 10, x + 13, 23), fill=color)
        x -= 12
