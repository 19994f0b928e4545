"""Pictures: the software renderer against MuJoCo's ray casting, and what a sheet shows."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from olympics_opt import episode as episode_of
from olympics_opt import raycast, render
from olympics_opt.decor import decorated
from olympics_opt.moments import sheet_frames
from olympics_opt.raycast import Solid, View, draw, intersect
from olympics_opt.scenery import Mark, Terrain, dressed, ground_marks, link_color, rgb
from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from sports.scene import Scene
from tests.olympics_opt.episodes import bar_scene, jump
from tests.olympics_opt.scenes import TASKS, scene_of, still, thrown

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


def test_a_net_shows_its_strings_and_what_is_behind_it() -> None:
    ball = Solid("sphere", np.array([0.0, 0.5, 1.0]), np.eye(3), np.array([0.3]), (1.0, 0.0, 0.0))
    net = Solid(
        "box", np.array([0.0, 0.0, 1.0]), np.eye(3), np.array([1.0, 0.01, 1.0]), (0.1, 0.1, 0.1),
        alpha=0.3, mesh=0.12,
    )  # fmt: skip
    view = View(np.array([0.0, 0.0, 1.0]), math.pi / 2, 0.05, 1.2, 240, 240)
    bare, netted = (draw(s, view).astype(int) for s in ([ball], [ball, net]))
    red = (bare[..., 0] > 90) & (bare[..., 1] < 60)
    still_red = (netted[..., 0] > 60) & (netted[..., 0] > 2 * netted[..., 1])
    assert red.sum() > 1000 and 0.6 < still_red[red].mean() < 0.98
    # Strings every 12 cm: 24 pixels apart, seen as dark columns over the plain background.
    row = netted[10, :, 0] - bare[10, :, 0]
    dark = np.flatnonzero(row < -60)
    centers = [c.mean() for c in np.split(dark, np.flatnonzero(np.diff(dark) > 2) + 1)]
    assert np.diff(centers) == pytest.approx(24.0, abs=1.1)


def test_what_is_half_opaque_lets_half_through() -> None:
    wall = Solid("box", np.array([0.0, 1.0, 1.0]), np.eye(3), np.full(3, 0.6), (1.0, 0.0, 0.0))
    pane = Solid(
        "box", np.array([0.0, -1.0, 1.0]), np.eye(3), np.full(3, 0.5), (0.0, 0.0, 1.0), alpha=0.5
    )
    view = View(np.array([0.0, 0.0, 1.0]), math.pi / 2, 0.0, 2.0, 64, 64)
    red, blue, both = (draw(s, view)[32, 32].astype(int) for s in ([wall], [pane], [pane, wall]))
    solid = Solid("box", pane.pos, pane.rot, pane.size, pane.color)
    full = draw([solid], view)[32, 32].astype(int)
    assert np.abs(both - (red + full) / 2).max() <= 2
    assert blue[2] < full[2] or blue[0] > full[0]


@pytest.mark.parametrize("azimuth", [0.0, 1.2, math.pi / 2])
def test_no_line_of_a_field_gets_lost_in_a_wide_picture(azimuth: float) -> None:
    """A line of 5 cm is a third of a pixel here, and lies across the view's tilt."""
    view = View(np.zeros(3), azimuth, 0.3, 40.0, 300, 200, horizon=80.0)
    grass = Mark(((-50, -50), (50, -50), (50, 50), (-50, 50)), "#507050")
    lines = [Mark(((-9, y), (9, y), (9, y + 0.05), (-9, y + 0.05)), "#ffffff") for y in (-7.0, 0.3)]
    lines += [
        Mark(((x, -7), (x + 0.05, -7), (x + 0.05, 0.3), (x, 0.3)), "#ffffff") for x in (-9, 5)
    ]
    bare, painted = draw([], view, [grass]), draw([], view, [grass, *lines])
    brighter = (painted.astype(int) - bare).max(-1) > 12
    for mark in lines:
        a, b = np.array(mark.corners)[0], np.array(mark.corners)[1]
        if np.linalg.norm(b - a) < 1:
            b = np.array(mark.corners)[2]
        for share in np.linspace(0.02, 0.98, 60):
            x, y = view.project(np.array([*(a + share * (b - a)), 0.0])).round().astype(int)
            assert brighter[y - 2 : y + 3, x - 2 : x + 3].any(), (mark, share)
    assert brighter.mean() < 0.03


def test_waves_are_met_where_the_formula_puts_them() -> None:
    ground = Terrain((1.0, 2.0))
    view = View(np.array([8.0, 0.0, 0.0]), 0.9, 0.4, 12.0, 60, 40)
    into = view.axes[2]
    back = view.origins(slice(None), slice(None)) - raycast.FAR * into
    t = raycast._waves(view, ground, back)
    p = back + t[..., None] * into
    assert np.isfinite(t).all()
    assert np.abs(p[..., 2] - ground.height(p[..., 0], p[..., 1])).max() < 2e-3
    # Nothing of the ground lies before it on the way.
    for step in np.arange(0.05, 4.0, 0.05):
        q = back + (t - step)[..., None] * into
        assert (q[..., 2] - ground.height(q[..., 0], q[..., 1]) > -2e-3).all()
    flat = draw([], view)
    assert np.abs(draw([], view, ground=ground).astype(int) - flat).mean() > 1


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
        frames = sheet_frames(window)
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
    for suffix, kind in ((".jpg", "JPEG"), (".webp", "WEBP")):
        page = tmp_path / f"s{suffix}"
        small = Image.open(render.render_sheet({"best": episode}, page, panel=(200, 140)))
        assert small.format == kind and small.size == (2 * 200, (62 + 3 * 140) // 2)
        # In grey: both keep colours at half the resolution of brightness.
        first = image.convert("L").crop((0, 0, 800, 62 + 3 * 140)).resize(small.size)
        likeness, seen = (np.asarray(x).astype(int) for x in (first, small.convert("L")))
        gap, mirrored = (np.abs(likeness - seen[:, ::way]).mean() for way in (1, -1))
        assert gap < 0.3 * mirrored, (suffix, gap, mirrored)
    assert not list(tmp_path.glob("*.tmp"))
    with pytest.raises(ValueError, match="at least one"):
        render.render_sheet({}, tmp_path / "t.png")


@pytest.mark.parametrize("name", ["soccer_2v2", "table_tennis_1v1", "boxing", "javelin"])
def test_a_sheet_of_several_athletes_or_a_ball(name: str, tmp_path: Path) -> None:
    from PIL import Image

    scene = scene_of(name)
    has_ball = any(o.name == "ball" for o in scene.objects)
    episode = thrown(scene, (7.0, 1.0, 4.0)) if has_ball else still(scene, 45)
    episode.shown = {"target": np.tile([[[-0.8, 0.3, 0.76]]], (45, 1, 1))}
    path = render.render_sheet({"best": episode}, tmp_path / "s.png", panel=(240, 150))
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    assert image.shape == (62 + 4 * 150, 3 * 240, 3)
    if scene.num_agents > 1:
        for i in range(12):
            part = image[62 + i // 3 * 150 :, i % 3 * 240 :][20:130, :240]
            blue = (part[..., 2] > part[..., 0] + 60).sum()
            red = (part[..., 0] > part[..., 2] + 60).sum()
            assert blue > 8 and red > 8, f"panel {i}: both teams are to be seen"


def test_the_ball_leaves_a_trail_and_its_way_is_not_drawn_through_a_new_serve() -> None:
    scene = scene_of("tennis")
    flight = thrown(scene, (14.0, 0.0, 4.0), start=1, frames=20)
    player = episode_of.Player(flight)
    view = View(np.array([0.0, 0.0, 2.0]), math.pi / 2, 0.2, 16.0, 640, 400)
    image = np.asarray(render.picture(player, 15, view, [])).astype(int)
    trail = np.abs(image - render.TRAIL).max(-1) < 40
    for frame in range(15):
        x, y = view.project(player.thing("ball")[frame]).round().astype(int)
        assert trail[y - 2 : y + 3, x - 2 : x + 3].any(), frame
    flight.qpos[8:, scene.object_qpos("ball").start] += 9.0
    jumped = np.asarray(render.picture(episode_of.Player(flight), 15, view, [])).astype(int)
    a, b = (view.project(episode_of.Player(flight).thing("ball")[i]) for i in (7, 8))
    x, y = ((a + b) / 2).round().astype(int)
    assert (np.abs(jumped[y - 3 : y + 4, x - 3 : x + 4] - render.TRAIL).max(-1) > 40).all()


@pytest.mark.parametrize("name", TASKS)
def test_the_decorated_model_keeps_the_state_and_touches_nothing(name: str) -> None:
    scene, _ = dressed(scene_of(name))
    model = decorated(scene)
    plain = build_model(scene_of(name))
    assert (model.nq, model.nv, model.nmocap) == (plain.nq, plain.nv, plain.nmocap)
    for k in range(model.njnt):
        assert model.joint(k).name == plain.joint(k).name
    # Marks as geoms of the world: as many as are painted, and none that collides.
    marks = ground_marks(scene)
    own = [g for g in range(model.ngeom) if model.geom_bodyid[g] == 0 and model.geom(g).name == ""]
    assert len(own) == len(marks)
    assert not model.geom_contype[own].any() and not model.geom_conaffinity[own].any()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for k in range(model.nmesh):  # faces look outwards, or they would be dark
        first, count = model.mesh_vertadr[k], model.mesh_vertnum[k]
        points = model.mesh_vert[first : first + count]
        rows = slice(model.mesh_faceadr[k], model.mesh_faceadr[k] + model.mesh_facenum[k])
        a, b, c = (points[model.mesh_face[rows][:, i]] for i in range(3))
        out = np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) / 3 - points.mean(0))
        assert (out > -1e-12).all()
    for g, mark in zip(own, marks):
        middle = (np.max(mark.corners, axis=0) + np.min(mark.corners, axis=0)) / 2
        reach = np.linalg.norm(np.array(mark.corners) - middle, axis=1).max()
        assert np.linalg.norm(data.geom_xpos[g][:2] - middle) < 0.5 * reach + 1e-6
        assert model.geom_rbound[g] == pytest.approx(reach, rel=0.5, abs=0.02)


def test_the_decorated_waves_have_the_heights_of_the_formula() -> None:
    ground = Terrain((0.4, 1.9))
    model = decorated(scene_of("golf"), ground)
    assert model.nhfield == 1
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    g = int(np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)[0])
    rng = np.random.default_rng(0)
    for x, y in rng.uniform((-7, -13), (31, 13), size=(40, 2)):
        start = np.array([x, y, 5.0])
        down = np.array([0.0, 0.0, -1.0])
        far = mujoco.mj_rayHfield(model, data, g, start, down)
        assert 5.0 - far == pytest.approx(float(ground.height(x, y)), abs=0.02)


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
