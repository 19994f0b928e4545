"""The camera: everybody and the ball are in the picture, on sheets, in videos, in perspective."""

from __future__ import annotations

import numpy as np
import pytest

from olympics_opt import camera
from olympics_opt.episode import Player
from olympics_opt.raycast import View
from tests.olympics_opt.episodes import Episode, bar_scene, jump
from tests.olympics_opt.scenes import PLAIN, plain_scene, still, thrown

FIELD = [name for name in PLAIN if name != "hurdling"]


def scattered(name: str, seed: int = 0, frames: int = 40) -> Episode:
    """Athletes that walk about on their field, and a ball that flies over it."""
    rng = np.random.default_rng(seed)
    scene = plain_scene(name)
    half = (15.0, 9.0) if name.startswith("soccer") else (3.0, 2.0)
    has_ball = any(o.name == "ball" for o in scene.objects)
    episode = thrown(scene, (6.0, 1.0, 5.0), frames=frames) if has_ball else still(scene, frames)
    for agent in range(scene.num_agents):
        own = scene.agent_qpos(agent)
        way = np.cumsum(rng.normal(size=(frames, 2)) * 0.12, axis=0)
        episode.qpos[:, own.start : own.start + 2] += np.clip(way, -np.array(half), half)
    return episode


def inside(view: View, points: np.ndarray) -> bool:
    px = view.project(points)
    return bool(((px >= 0) & (px <= (view.width_px, view.height_px))).all())


@pytest.mark.parametrize("name", FIELD)
def test_a_picture_holds_every_athlete_and_the_ball(name: str) -> None:
    episode = scattered(name)
    player = Player(episode)
    frames = [0, 9, 20, 39]
    for frame, view in zip(frames, camera.shots(player, frames, 640, 400)):
        roots = player.roots()[frame]
        bodies = [roots + (0.0, 0.0, z) for z in (-0.95, 0.0, 0.8)]
        balls = [player.thing(n)[frame][None] for n in camera.things(episode.scene)]
        assert inside(view, np.concatenate((*bodies, *balls)))
        # And no larger than it need be: something comes near an edge.
        px = view.project(camera.must_show(player, frame, view))
        room = np.array([*px.min(0), *((640, 400) - px.max(0))])
        if view.height > camera.SMALLEST and view.height == min(
            v.height for v in camera.shots(player, [frame], 640, 400)
        ):
            assert room.min() < 0.1 * 640


@pytest.mark.parametrize("name", ["soccer_2v2", "tennis", "javelin", "boxing"])
def test_a_video_holds_them_in_every_frame_without_jerks(name: str) -> None:
    player = Player(scattered(name, seed=3))
    views = camera.tracking(player, 960, 540)
    assert len(views) == len(player)
    for frame, view in enumerate(views):
        names = camera.things(player.scene)
        balls = [player.thing(n)[frame][None] for n in names]
        assert inside(view, np.concatenate((player.roots()[frame], *balls)))
    steps = np.diff([v.target for v in views], axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 0.9
    assert np.abs(np.diff([v.height for v in views])).max() < 0.9


@pytest.mark.parametrize("name", ["soccer_2v2", "tennis_1v1", "basketball_2v2", "penalty_kick"])
def test_a_perspective_camera_sees_them_from_its_distance(name: str) -> None:
    player = Player(scattered(name, seed=1))
    lens, aspect = 2.1, 1.9
    looks, away = camera.focus(player, lens, aspect)
    own = camera.stand(player.scene)
    assert own is not None
    plain = View(np.zeros(3), np.radians(own.azimuth), np.radians(own.pitch), 1.0, 2, 2)
    right, up, into = plain.axes
    for frame in range(0, len(player), 7):
        eye = looks[frame] - away[frame] * into
        points = player.roots()[frame] - eye
        depth = points @ into
        assert (depth > 0).all()
        assert (np.abs(points @ right) * lens / aspect < depth).all()
        assert (np.abs(points @ up) * lens < depth).all()


def test_near_pictures_share_a_scale_and_wide_ones_have_their_own() -> None:
    scene = plain_scene("free_throw")
    episode = still(scene, 30)
    ball = scene.object_qpos("ball")
    episode.qpos[15:, ball.start] = 40.0
    views = camera.shots(Player(episode), [0, 5, 20, 25], 640, 400)
    heights = [v.height for v in views]
    assert heights[0] == heights[1] < 7.0 < heights[2] == heights[3]
    player = Player(episode)
    assert camera.inset(player, 0, views[0]) is None
    close = camera.inset(player, 20, views[2])
    assert close is not None and close.height < 4
    assert inside(close, player.roots()[20] + (0.0, 0.0, 0.8))


def test_the_inset_shows_the_athlete_nearest_to_the_ball() -> None:
    scene = plain_scene("soccer_2v2")
    episode = still(scene)
    ball = scene.object_qpos("ball")
    for agent, start in enumerate(scene.agents):
        episode.qpos[agent, ball.start : ball.start + 2] = (start.x + 0.4, start.y)
    player = Player(episode)
    assert [camera.leading(player, i) for i in range(4)] == [0, 1, 2, 3]


def test_a_solo_athlete_is_followed_as_before() -> None:
    player = Player(jump(bar_scene(), "high_jump"))
    assert camera.stand(player.scene) is None
    frames = [0, 20, 40]
    views = camera.shots(player, frames, 480, 330)
    for frame, view in zip(frames, views):
        assert np.allclose(view.target[:2], player.qpos[frame, :2])
        assert view.azimuth == pytest.approx(np.pi / 2, abs=0.05)
    assert len({v.height for v in views}) == 1
