"""Videos of recorded episodes: MuJoCo's renderer where EGL or OSMesa exists, else our own."""

from __future__ import annotations

import importlib
import math
import os
import subprocess
import sys
from collections.abc import Generator
from functools import cache
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from olympics_opt.episode import Episode, Player, heading
from olympics_opt.raycast import SUN, View, draw
from olympics_opt.scenery import ground_marks, link_color, rgb
from sports.humanoid.mjcf import body_name, build_spec
from sports.scene import Scene

Pictures = Generator[np.ndarray, None, None]
"""(height, width, 3) uint8 frames."""

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
    # Shadows are sharp within this many metres (see the light's place in `_gl_frames`).
    spec.stat.extent = 5.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 40.0
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
        markrgb=rgb("#98a5ab"),
        width=128,
        height=128,
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
    light.dir = -SUN
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


def _gl_frames(episode: Episode, width: int, height: int) -> Pictures:
    """Pictures of every frame by MuJoCo's renderer; the camera follows the athlete's side."""
    player = Player(episode, _decorated(episode.scene))
    renderer = _gl_renderer(player.model, width, height)
    try:
        root = _smooth(player.qpos[:, :3], 0.25 / episode.dt)
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.distance, camera.elevation = 4.7, -9.0
        camera.azimuth = math.degrees(heading(player.qpos)) + 62.0
        for i in range(len(player)):
            player.show(i)
            mujoco.mj_comPos(player.model, player.data)
            # The sun travels along, so that its shadow map covers the athlete's surroundings.
            player.model.light_pos[0] = root[i] * (1.0, 1.0, 0.0) + 4.0 * SUN
            mujoco.mj_camlight(player.model, player.data)
            camera.lookat[:] = root[i] * (1.0, 1.0, 0.75) + (0.35, 0.0, 0.15)
            renderer.update_scene(player.data, camera)
            yield renderer.render()
    finally:
        renderer.close()


def _software_frames(episode: Episode, width: int, height: int) -> Pictures:
    """Pictures of every frame by the software renderer."""
    player = Player(episode)
    marks = ground_marks(episode.scene)
    root = _smooth(player.qpos[:, :3], 0.15 / episode.dt)
    metres = 3.2
    for i, p in enumerate(root):
        target = np.array([p[0], p[1], max(metres / 2 - 0.3, p[2] + 0.9 - metres / 2)])
        azimuth = heading(player.qpos) + math.pi / 2 - 0.3
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
