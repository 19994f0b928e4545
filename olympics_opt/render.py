"""Pictures of recorded episodes: a sheet of frames for looking, and a video.

The sheet needs no GL library: it is drawn by `raycast.py`. The video comes from MuJoCo's own
renderer where EGL or OSMesa exists; ``renderer="software"`` draws it as the sheet is drawn.
"""

from __future__ import annotations

import importlib
import io
import math
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, Protocol

import mujoco
import numpy as np

from olympics_opt.atomic import write_bytes
from olympics_opt.raycast import Solid, View, draw
from olympics_opt.scenery import complete_qpos, ground_marks, link_color, rgb
from sports.humanoid.mjcf import body_name, build_model, build_spec
from sports.scene import Scene

FRAMES = 12
BEFORE, AFTER = 0.7, 0.6
"""Seconds shown before a take-off and after the landing."""
TOUCH = 1.0
"""Ground force above which a link counts as touching (N)."""


class Episode(Protocol):
    """What is drawn: the fields of `rl.evaluate.Recording` that pictures need."""

    task: str
    scene: Scene
    qpos: np.ndarray
    """(T, nq) or, for a motion without its objects, (T, 7 + num_dofs)."""
    mocap_pos: np.ndarray
    """(T, M, 3)"""
    ground_force: np.ndarray
    """(T, A, B, 3) N, world frame."""
    metrics: dict[str, float]
    seed: int
    world: int
    dt: float


@dataclass(frozen=True)
class Window:
    """The part of an episode that decides it."""

    start: int
    takeoff: int | None
    landing: int | None
    stop: int
    """Last frame, included."""


class Player:
    """Puts an episode's frames into a MuJoCo model, one at a time."""

    def __init__(self, episode: Episode, model: mujoco.MjModel | None = None) -> None:
        self.episode = episode
        self.scene = scene = episode.scene
        self.model = model if model is not None else build_model(scene)
        self.data = mujoco.MjData(self.model)
        self.qpos = complete_qpos(scene, episode.qpos)
        mocap = getattr(episode, "mocap_pos", None)
        count = len(scene.mocap_objects)
        if mocap is None or np.size(mocap) == 0:
            mocap = np.broadcast_to(scene.default_mocap_pos(), (len(self.qpos), count, 3))
        self.mocap = np.asarray(mocap, dtype=float)
        self._rows = [self.model.body(o.name).mocapid[0] for o in scene.mocap_objects]
        colors = {
            self.model.body(body_name(agent, name)).id: rgb(link_color(name))
            for agent in range(scene.num_agents)
            for name in scene.body.link_names
        }
        self._colors = [
            colors.get(int(self.model.geom_bodyid[g]), tuple(self.model.geom_rgba[g][:3]))
            for g in range(self.model.ngeom)
        ]

    def __len__(self) -> int:
        return len(self.qpos)

    def show(self, frame: int) -> mujoco.MjData:
        """Kinematics of a frame; the same MjData every time."""
        self.data.qpos[:] = self.qpos[frame]
        for k, row in enumerate(self._rows):
            self.data.mocap_pos[row] = self.mocap[frame, k]
        mujoco.mj_kinematics(self.model, self.data)
        return self.data

    def solids(self, frame: int) -> list[Solid]:
        """Shapes of a frame for the software renderer."""
        data, model, kinds = self.show(frame), self.model, mujoco.mjtGeom
        names = {
            int(kinds.mjGEOM_BOX): ("box", 3),
            int(kinds.mjGEOM_SPHERE): ("sphere", 1),
            int(kinds.mjGEOM_CAPSULE): ("capsule", 2),
            int(kinds.mjGEOM_CYLINDER): ("cylinder", 2),
        }
        return [
            Solid(
                names[int(model.geom_type[g])][0],
                data.geom_xpos[g].copy(),
                data.geom_xmat[g].reshape(3, 3).copy(),
                model.geom_size[g][: names[int(model.geom_type[g])][1]],
                self._colors[g],
            )
            for g in range(model.ngeom)
            if int(model.geom_type[g]) in names
        ]

    def lowest(self, frame: int) -> float:
        """Height of the lowest point of the first athlete (m)."""
        data, model, low = self.show(frame), self.model, math.inf
        root = model.body(body_name(0, self.scene.body.links[0].name)).id
        for g in range(model.ngeom):
            if model.body_rootid[model.geom_bodyid[g]] != root:
                continue
            down = data.geom_xmat[g].reshape(3, 3)[2]
            size, kind = model.geom_size[g], model.geom_type[g]
            if kind == mujoco.mjtGeom.mjGEOM_BOX:
                reach = float(np.abs(down) @ size)
            else:  # a cylinder is taken for a capsule here
                reach = size[0] + (
                    0.0 if kind == mujoco.mjtGeom.mjGEOM_SPHERE else abs(down[2]) * size[1]
                )
            low = min(low, data.geom_xpos[g][2] - reach)
        return low


def touching(episode: Episode, frame: int) -> list[str]:
    """Links of the first athlete that the ground pushed in a frame."""
    force = np.linalg.norm(np.asarray(episode.ground_force)[frame, 0], axis=-1)
    return [n for n, f in zip(episode.scene.body.link_names, force) if f > TOUCH]


def airborne(episode: Episode, player: Player) -> np.ndarray:
    """(T,) whether nothing of the first athlete touches the ground.

    From the recorded ground force; from the shapes' lowest point (more than 2 cm up) where an
    episode has no forces.
    """
    force = np.asarray(getattr(episode, "ground_force", np.zeros(0)))
    if force.size:
        return ~(np.linalg.norm(force[:, 0], axis=-1) > TOUCH).any(-1)
    return np.array([player.lowest(i) > 0.02 for i in range(len(player))])


def decisive_window(episode: Episode, player: Player) -> Window:
    """The jump of a jumping task: from 0.7 s before its take-off to 0.6 s after its landing.

    The jump is the flight that crosses x = 20 (the bar, the line); an episode that never gets
    there, and any other task, is shown whole, or for its last 3 s if it never jumped.
    """
    last = len(player) - 1
    if not episode.task.startswith(("long_jump", "high_jump")):
        return Window(0, None, None, last)
    x, air = player.qpos[:, 0], airborne(episode, player)
    before, after = round(BEFORE / episode.dt), round(AFTER / episode.dt)
    edges = np.flatnonzero(np.diff(np.r_[0, air.astype(int), 0]))
    flights = [(a, b) for a, b in zip(edges[::2], edges[1::2]) if x[min(b, last)] > 20.0]
    if not flights:
        return Window(max(0, last - round(3.0 / episode.dt)), None, None, last)
    # The first flight that ends beyond the mark and lasts: stumbling hops come after it.
    takeoff, landing = max(flights[:3], key=lambda f: f[1] - f[0])
    return Window(
        max(0, takeoff - before),
        int(takeoff),
        int(min(landing, last)),
        int(min(last, landing + after)),
    )


def _heading(qpos: np.ndarray) -> float:
    """Direction of travel over some frames (rad); +x for somebody who stays in place."""
    way = qpos[-1, :2] - qpos[0, :2]
    return math.atan2(way[1], way[0]) if np.linalg.norm(way) > 1.0 else 0.0


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
    azimuth = _heading(chosen) + math.pi / 2
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
        return "–"
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
    from olympics_opt.scenery import LIMBS

    x, font = width - 10, _font(13)
    for name, color in reversed(LIMBS.items()):
        label = name.replace("_", " ")
        x -= int(ink.textlength(label, font=font))
        ink.text((x, 9), label, font=font, fill=(60, 68, 76))
        x -= 17
        ink.ellipse((x, 10, x + 13, 23), fill=color)
        x -= 12


INSTALL_GL = (
    "no GL library works on this machine: `apt-get install libosmesa6` (or libegl1) gives "
    "MuJoCo's renderer one; the software renderer (--renderer software) needs none"
)


def _gl_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """MuJoCo's renderer on the first GL library that works: ``MUJOCO_GL``, else EGL, else OSMesa.

    MuJoCo decides for a library when it is imported, so the choice is put in its place here.
    Raises RuntimeError that says what to install.
    """
    from mujoco.rendering.classic import gl_context

    failures = []
    for name in [os.environ["MUJOCO_GL"]] if os.environ.get("MUJOCO_GL") else ["egl", "osmesa"]:
        try:
            _probe_gl(name)
            if name in ("egl", "osmesa"):
                os.environ["PYOPENGL_PLATFORM"] = name
                gl_context.GLContext = importlib.import_module(f"mujoco.{name}").GLContext
            return mujoco.Renderer(model, height, width)
        except Exception as error:
            failures.append(f"{name}: {error}")
    raise RuntimeError(f"{INSTALL_GL} ({'; '.join(failures)})")


@cache
def _probe_gl(name: str) -> None:
    """Tries a GL library in another process: a failed import of one spoils the next in this."""
    code = (
        "import mujoco; m = mujoco.MjModel.from_xml_string('<mujoco/>'); "
        "mujoco.Renderer(m, 8, 8).render()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "MUJOCO_GL": name, "PYOPENGL_PLATFORM": name},
        capture_output=True,
        text=True,
        timeout=120,
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["failed"]
        raise RuntimeError(lines[-1].strip())


def _decorated(scene: Scene) -> mujoco.MjModel:
    """The scene's model with light, sky, a grid on the ground, marks and limb colours."""
    spec = build_spec(scene)
    spec.visual.headlight.ambient[:] = (0.38, 0.38, 0.38)
    spec.visual.headlight.diffuse[:] = (0.30, 0.30, 0.30)
    spec.visual.headlight.specular[:] = (0.1, 0.1, 0.1)
    spec.visual.quality.shadowsize = 4096
    spec.visual.map.znear = 0.005
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=rgb("#9dbfdd"),
        rgb2=rgb("#eef3f7"),
        width=256,
        height=1536,
    )
    texture = spec.add_texture(
        name="grid",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=rgb("#d5dbdd"),
        rgb2=rgb("#d5dbdd"),
        markrgb=rgb("#b9c2c6"),
        width=512,
        height=512,
    )
    assert texture is not None
    material = spec.add_material(name="grid", texrepeat=(1.0, 1.0), texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    ground = spec.geom("ground")
    ground.material = "grid"
    ground.rgba = (1.0, 1.0, 1.0, 1.0)
    light = spec.worldbody.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=True,
        diffuse=(0.55, 0.55, 0.52),
        specular=(0.2, 0.2, 0.2),
    )
    light.dir = (0.28, 0.42, -0.86)
    for i, mark in enumerate(ground_marks(scene)):
        corners = np.asarray(mark.corners)
        low, high = corners.min(0), corners.max(0)
        thickness = 0.001 + 0.0002 * i  # paint over paint
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=(*(low + high) / 2, 0.0),
            size=(*(high - low) / 2, thickness),
            contype=0,
            conaffinity=0,
            rgba=(*rgb(mark.color), 1.0),
        )
    for agent in range(scene.num_agents):
        for name in scene.body.link_names:
            for geom in spec.body(body_name(agent, name)).geoms:
                geom.rgba = (*rgb(link_color(name)), 1.0)
    return spec.compile()


def _smooth(values: np.ndarray, sigma: float) -> np.ndarray:
    """(T, k) values smoothed over time by a Gaussian of ``sigma`` frames."""
    reach = math.ceil(3 * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    return np.stack(
        [np.convolve(column, kernel / kernel.sum(), mode="valid") for column in padded.T], axis=1
    )


def _gl_frames(episode: Episode, width: int, height: int) -> Iterator[np.ndarray]:
    """Pictures of every frame by MuJoCo's renderer; the camera follows the athlete's side."""
    player = Player(episode, _decorated(episode.scene))
    renderer = _gl_renderer(player.model, width, height)
    try:
        root = _smooth(player.qpos[:, :3], 0.25 / episode.dt)
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.distance, camera.elevation = 5.2, -9.0
        camera.azimuth = math.degrees(_heading(player.qpos)) + 62.0
        for i in range(len(player)):
            player.show(i)
            mujoco.mj_comPos(player.model, player.data)
            mujoco.mj_camlight(player.model, player.data)
            camera.lookat[:] = root[i] * (1.0, 1.0, 0.75) + (0.35, 0.0, 0.15)
            renderer.update_scene(player.data, camera)
            yield renderer.render()
    finally:
        renderer.close()


def _software_frames(episode: Episode, width: int, height: int) -> Iterator[np.ndarray]:
    """Pictures of every frame by the software renderer."""
    player = Player(episode)
    marks = ground_marks(episode.scene)
    root = _smooth(player.qpos[:, :3], 0.15 / episode.dt)
    metres = 3.2
    for i, p in enumerate(root):
        target = np.array([p[0], p[1], max(metres / 2 - 0.3, p[2] + 0.9 - metres / 2)])
        azimuth = _heading(player.qpos) + math.pi / 2 - 0.3
        view = View(target, azimuth, math.radians(9.0), metres, width, height)
        yield draw(player.solids(i), view, marks)


def render_video(
    recording: Episode,
    path: str | Path,
    *,
    renderer: Literal["gl", "software"] = "gl",
    width: int = 960,
    height: int = 540,
    progress: bool = False,
) -> Path:
    """Writes an episode as an H.264 mp4 in real time.

    Args:
        recording: the episode.
        path: mp4 file, written atomically.
        renderer: ``gl`` for MuJoCo's renderer on EGL or OSMesa (``MUJOCO_GL`` decides which),
            ``software`` for the renderer of the sheets, which needs neither and is slower.
        width: pixels, a multiple of 16.
        height: pixels; rounded to a multiple of 2.
        progress: show a progress bar.

    Returns:
        The path.

    Raises:
        RuntimeError: no GL library works; the sentence says what to install.
        ValueError: unknown renderer, or a recording without frames.
    """
    import imageio_ffmpeg
    from rich.progress import track

    if renderer not in ("gl", "software"):
        raise ValueError(f"unknown renderer '{renderer}'; known: gl, software")
    if len(recording.qpos) == 0:
        raise ValueError(f"the recording of '{recording.task}' has no frames")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.{os.getpid()}.tmp.mp4")
    pictures = (_gl_frames if renderer == "gl" else _software_frames)(recording, width, height)
    try:
        first = next(pictures)
        writer = imageio_ffmpeg.write_frames(
            str(partial),
            (width, height),
            fps=1.0 / recording.dt,
            quality=8,
            macro_block_size=2,
            ffmpeg_log_level="error",
        )
        writer.send(None)
        writer.send(np.ascontiguousarray(first))
        total = len(recording.qpos) - 1
        for picture in track(pictures, "rendering", total=total, disable=not progress):
            writer.send(np.ascontiguousarray(picture))
        writer.close()
        os.replace(partial, path)
    finally:
        pictures.close()
        partial.unlink(missing_ok=True)
    return path
