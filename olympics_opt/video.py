"""Videos of recorded episodes: MuJoCo's renderer where EGL or OSMesa exists, else our own."""

from __future__ import annotations

import importlib
import math
import os
import subprocess
import sys
from collections.abc import Generator
from functools import cache, partial
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from olympics_opt.camera import focus, smooth, stand, tracking
from olympics_opt.decor import decorated
from olympics_opt.episode import Episode, Player, heading
from olympics_opt.raycast import SUN, draw
from olympics_opt.scenery import ground_marks, terrain

Pictures = Generator[np.ndarray, None, None]
"""(height, width, 3) uint8 frames."""

NEAREST = 4.7
"""Least distance of the camera (m)."""
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


def _gl_frames(episode: Episode, width: int, height: int) -> Pictures:
    """Pictures of every frame by MuJoCo's renderer; the camera follows what matters."""
    ground = terrain(episode.scene, getattr(episode, "shown", {}))
    player = Player(episode, partial(decorated, ground=ground))
    own = stand(player.scene)
    lens = 1.0 / math.tan(math.radians(player.model.vis.global_.fovy) / 2)
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    if own is None:
        root = smooth(player.qpos[:, :3], 0.25 / episode.dt)
        looks = root * (1.0, 1.0, 0.75) + (0.35, 0.0, 0.15)
        away = np.full(len(player), NEAREST)
        camera.azimuth, camera.elevation = math.degrees(heading(player.qpos)) + 62.0, -9.0
    else:
        looks, away = focus(player, lens, width / height)
        away = np.maximum(away, NEAREST)
        camera.azimuth, camera.elevation = own.azimuth, -own.pitch
        # The extent of the scene decides how far shadows reach; a near plane far from the eye
        # tells thin layers of paint from each other. The renderer must be made after that.
        extent = player.model.stat.extent = max(5.0, float(away.max()))
        player.model.vis.map.znear = 0.2 * float(away.min()) / extent
    renderer = _gl_renderer(player.model, width, height)
    try:
        sun = 0.8 * player.model.stat.extent
        for i in range(len(player)):
            player.show(i)
            mujoco.mj_comPos(player.model, player.data)
            # The sun travels along, so that its shadow map covers the athletes' surroundings.
            player.model.light_pos[0] = looks[i] * (1.0, 1.0, 0.0) + sun * SUN
            mujoco.mj_camlight(player.model, player.data)
            camera.lookat[:], camera.distance = looks[i], away[i]
            renderer.update_scene(player.data, camera)
            yield renderer.render()
    finally:
        renderer.close()


def _software_frames(episode: Episode, width: int, height: int) -> Pictures:
    """Pictures of every frame by the software renderer."""
    player = Player(episode)
    marks = ground_marks(episode.scene)
    for i, view in enumerate(tracking(player, width, height)):
        yield draw(player.solids(i), view, marks, ground=player.ground)


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
            fps=1.0 / recording.dt,  # type: ignore[arg-type]
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
