"""Pictures: the software renderer against MuJoCo's ray casting, and what a sheet shows."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from olympics_opt import episode as episode_of
from olympics_opt import render
from olympics_opt.raycast import Solid, View, draw, intersect
from olympics_opt.scenery import Mark, link_color, rgb
from sports.humanoid.body import load_body
from sports.scene import Scene
from tests.olympics_opt.episodes import bar_scene, jump

KINDS = {
    "box": [0.3, 0.2, 0.1],
    "sphere": [0.25],
    "capsule": [0.1, 0.3],
    "cylinder": [0.2, 0.15],
}


@pytest.mark.parametrize("kind", KINDS)
def test_intersection_agrees_with_mujoco_rays(kind: str) -> None:
    rng = np.random.default_rng(4)
    quat = rng.normal(size=4)
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(pos=(0.1, -0.2, 0.3), quat=quat / np.linalg.norm(quat))
    geom = body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"))
    geom.size[: len(KINDS[kind])] = KINDS[kind]
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solid = Solid(
        kind,
        data.geom_xpos[0].copy(),
        data.geom_xmat[0].reshape(3, 3).copy(),
        np.array(KINDS[kind]),
        (1.0, 1.0, 1.0),
    )
    direction = np.array([0.4, 0.7, -0.5]) / np.linalg.norm([0.4, 0.7, -0.5])
    origins = solid.pos - 3 * direction + rng.uniform(-0.5, 0.5, size=(400, 3))
    t, n = intersect(solid, origins, direction)
    hits = 0
    for i, origin in enumerate(origins):
        normal = np.zeros(3)
        want = mujoco.mj_ray(
            model, data, origin, direction, None, True, -1, np.zeros(1, np.int32), normal
        )
        assert np.isfinite(t[i]) == (want >= 0)
        if want >= 0:
            hits += 1
            assert t[i] == pytest.approx(want, abs=1e-9)
            assert np.abs(n[i] - normal).max() < 1e-6
    assert hits > 40


def test_picture_shows_a_ball_where_it_projects_and_its_shadow() -> None:
    ball = Solid("sphere", np.array([0.0, 0.0, 1.0]), np.eye(3), np.array([0.2]), (1.0, 0.0, 0.0))
    view = View(np.array([0.0, 0.0, 0.8]), math.pi / 2, 0.2, 2.4, 240, 200)
    bare = draw([], view, [Mark(((-9, -9), (9, -9), (9, 9), (-9, 9)), "#ffffff")]).astype(int)
    with_ball = draw([ball], view, [Mark(((-9, -9), (9, -9), (9, 9), (-9, 9)), "#ffffff")])
    red = (with_ball[..., 0] > 60) & (with_ball[..., 1] < 60)
    rows, cols = np.nonzero(red)
    center = view.project(ball.pos)
    assert np.allclose([cols.mean() + 0.5, rows.mean() + 0.5], center, atol=0.7)
    # Area of a disc of 0.2 m at the view's scale.
    assert red.sum() == pytest.approx(math.pi * (0.2 * view.scale) ** 2, rel=0.06)
    darker = (bare - with_ball.astype(int)).min(-1) > 30
    shadow = darker & ~red & (np.arange(200)[:, None] > center[1])
    assert shadow.sum() > 50


def test_nearer_shapes_hide_farther_ones() -> None:
    near = Solid("box", np.array([0.0, -1.0, 1.0]), np.eye(3), np.full(3, 0.3), (0.0, 1.0, 0.0))
    far = Solid("box", np.array([0.0, 1.0, 1.0]), np.eye(3), np.full(3, 0.3), (1.0, 0.0, 0.0))
    view = View(np.array([0.0, 0.0, 1.0]), math.pi / 2, 0.0, 2.0, 64, 64)
    for order in ([near, far], [far, near]):
        pixel = draw(order, view)[32, 32].astype(int)
        assert pixel[1] > pixel[0] + 50


def test_decisive_window_finds_the_flight_over_the_mark() -> None:
    for task, takeoff in (("long_jump", 30), ("high_jump", 40)):
        episode = jump(bar_scene(), task, takeoff=takeoff, frames=100)
        # A hop before and a stumble after the jump must not be taken for it.
        episode.ground_force[5:8] = 0.0
        episode.ground_force[90:93] = 0.0
        window = episode_of.decisive_window(episode, episode_of.Player(episode))
        assert window.takeoff == takeoff + 1
        assert window.landing is not None
        airtime = (window.landing - window.takeoff) / 30
        assert airtime == pytest.approx(2 * 4.0 / 9.81, abs=2 / 30)
        frames = render.sheet_frames(window)
        assert len(frames) == 12 and window.landing in frames
        assert frames[0] == window.takeoff - 21


def test_flight_from_shapes_agrees_with_flight_from_forces() -> None:
    episode = jump(bar_scene(), "long_jump")
    episode.qpos[:, 7:76] = 0.0
    player = episode_of.Player(episode)
    by_force = episode_of.airborne(episode, player)
    episode.ground_force = np.zeros(0)
    by_shape = episode_of.airborne(episode, player)
    assert (by_force != by_shape).sum() <= 1


def test_an_episode_without_a_jump_is_shown_by_its_end() -> None:
    episode = jump(bar_scene(), "long_jump", takeoff=140, frames=140)
    window = episode_of.decisive_window(episode, episode_of.Player(episode))
    assert window.takeoff is None and window.stop == 139 and window.start == 49


def test_lowest_point_matches_the_standing_height() -> None:
    scene = Scene("any", load_body())
    episode = jump(bar_scene(), "high_jump")
    episode.scene, episode.qpos = scene, scene.default_qpos()[None]
    episode.mocap_pos = np.zeros((1, 0, 3))
    assert episode_of.Player(episode).lowest(0) == pytest.approx(0.005, abs=1e-6)


def test_sheet_has_twelve_panels_for_each_recording(tmp_path: Path) -> None:
    from PIL import Image

    episode = jump(bar_scene(), "high_jump")
    path = render.render_sheet(
        {"best": episode, "median": episode}, tmp_path / "s.png", commit="abc1234", panel=(200, 140)
    )
    image = Image.open(path)
    assert image.size == (4 * 200, 2 * (62 + 3 * 140))
    # Limbs of both sides are to be seen in every panel of the first recording.
    pixels = np.asarray(image.convert("RGB")).astype(int)
    for i in range(12):
        y, x = 62 + i // 4 * 140, i % 4 * 200
        part = pixels[y + 20 : y + 120, x : x + 200]
        blue = (part[..., 2] > part[..., 0] + 70).sum()
        red = (part[..., 0] > part[..., 2] + 70).sum()
        assert blue > 15 and red > 15, f"panel {i}"
    assert not list(tmp_path.glob("*.tmp"))
    with pytest.raises(ValueError, match="at least one"):
        render.render_sheet({}, tmp_path / "t.png")


def test_hands_and_feet_have_their_own_colours() -> None:
    ends = [f"{side}_{part}" for side in "LR" for part in ("Hand", "Toe", "Shoulder", "Knee")]
    assert len({link_color(name) for name in ends}) == len(ends)
    assert link_color("L_Index1") == link_color("L_Hand") == link_color("L_Wrist")
    assert rgb("#ff0080") == (1.0, 0.0, pytest.approx(128 / 255))


def test_software_video_has_every_frame(tmp_path: Path) -> None:
    import imageio_ffmpeg

    episode = jump(bar_scene(), "high_jump", frames=6, takeoff=2)
    path = render.render_video(
        episode, tmp_path / "v.mp4", renderer="software", width=160, height=96
    )
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert frames == 6 and seconds == pytest.approx(0.2, abs=0.05)
    assert [p.name for p in tmp_path.iterdir()] == ["v.mp4"]


def test_without_gl_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "off")
    episode = jump(bar_scene(), "high_jump", frames=3, takeoff=1)
    with pytest.raises(RuntimeError, match="apt-get install libosmesa6"):
        render.render_video(episode, tmp_path / "v.mp4", width=64, height=64)
    assert not list(tmp_path.iterdir())
