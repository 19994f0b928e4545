"""What happens in an episode, read off its motion, and which frames are drawn of it."""

from __future__ import annotations

import numpy as np
import pytest

from olympics_opt.episode import Player, Window, decisive_window
from olympics_opt.moments import chosen_frames, events
from tests.olympics_opt.scenes import scene_of, still, thrown


def words(player: Player, word: str) -> list[int]:
    return [e.frame for e in events(player) if word in e.word]


def test_a_kick_and_a_bounce_are_found_where_they_happen() -> None:
    scene = scene_of("penalty_kick")
    episode = thrown(scene, (5.0, 0.0, 3.0), start=10, frames=60)
    ball = scene.object_qpos("ball").start
    # The kicker's toe is at the ball when it leaves.
    episode.qpos[:, 0] = 4.0 - 0.32
    player = Player(episode)
    z = episode.qpos[:, ball + 2]
    bounces = [i for i in range(11, 59) if z[i] == z[8] and z[i - 1] > z[i] < z[i + 1]]
    assert bounces
    found = events(player)
    kicks = [e for e in found if "Toe" in e.word or "Ankle" in e.word]
    assert kicks and abs(kicks[0].frame - 9) <= 1
    ground = words(player, "ball: ground")
    assert ground and min(abs(g - bounces[0]) for g in ground) <= 1
    assert kicks[0].weight > max(e.weight for e in found if "ground" in e.word)


def test_a_ball_that_lies_still_or_flies_freely_is_no_event() -> None:
    scene = scene_of("free_throw")
    episode = thrown(scene, (3.7, 0.0, 6.9), start=0, frames=30)  # in the air from the start
    assert not words(Player(episode), "ball:")
    assert not events(Player(still(scene_of("soccer_1v1"))))


def test_a_ball_put_elsewhere_is_a_new_one_not_a_stroke() -> None:
    scene = scene_of("tennis")
    episode = still(scene, 40)
    ball = scene.object_qpos("ball")
    episode.qpos[20:, ball.start] = 12.0
    found = events(Player(episode))
    assert [(e.frame, e.word) for e in found] == [(20, "new ball")]


@pytest.mark.parametrize(("name", "thing"), [("free_throw", "ball"), ("javelin", "javelin")])
def test_letting_go_of_what_a_hand_holds_is_an_event(name: str, thing: str) -> None:
    scene = scene_of(name)
    episode = still(scene, 50)
    row = scene.object_qpos(thing).start
    for i in range(20, 50):  # slowly at first, so that no velocity jumps
        t = (i - 20) / 30
        episode.qpos[i, row + 2] += 0.9 * t * t
    found = events(Player(episode))
    assert [e.word for e in found] == [f"{thing} released"]
    gone = 0.9 * ((found[0].frame - 20) / 30) ** 2
    assert 0.1 < gone < 0.5
    # Held all the time, it is none.
    assert not events(Player(still(scene, 50)))


def test_hurdles_and_falls_and_prizes_are_events() -> None:
    scene = scene_of("hurdling")
    episode = still(scene, 100)
    episode.qpos[:, 0] = np.linspace(0, 33, 100)
    episode.qpos[90:, 2] = 0.2
    episode.terms = {  # type: ignore[attr-defined]
        "progress": np.ones((100, 1)),
        "point": np.eye(100)[:, 60:61],
    }
    found = {e.word: e.frame for e in events(Player(episode))}
    assert found["hurdle0"] == int(np.ceil(13.72 / 33 * 99))
    assert found["hurdle1"] == int(np.ceil(22.86 / 33 * 99)) and "hurdle3" not in found
    assert found["falls"] == 90 and found["point"] == 60 and "progress" not in found


def test_falls_say_who() -> None:
    scene = scene_of("boxing")
    episode = still(scene, 20)
    episode.qpos[12:, scene.agent_qpos(1).start + 2] = 0.2
    assert [(e.frame, e.word) for e in events(Player(episode))] == [(12, "1 falls")]


def test_frames_are_the_ends_the_events_and_what_lies_between() -> None:
    scene = scene_of("tennis")
    episode = still(scene, 300)
    ball = scene.object_qpos("ball")
    for i in (50, 130, 131, 250):
        episode.qpos[i:, ball.start] += 9.0
    player = Player(episode)
    window = decisive_window(episode, player)
    frames = chosen_frames(window, events(player))
    assert len(frames) == len(set(frames)) == 12 and frames == sorted(frames)
    assert {0, 299, 50, 130, 250} <= set(frames) and 131 not in frames
    assert np.diff(frames).max() < 80
    assert chosen_frames(Window(0, None, None, 4), []) == [0, 1, 2, 3, 4]
    assert len(chosen_frames(Window(0, None, None, 99), [])) == 12
