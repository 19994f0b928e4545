"""The contact sheet: one picture for each task, whatever tasks there are."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from olympics_opt import gallery
from olympics_opt.episode import Player
from sports.humanoid.body import load_body
from sports.registry import task_names
from sports.scene import Scene, Start
from tests.olympics_opt.episodes import bar_scene, jump
from tests.olympics_opt.scenes import TASKS, scene_of, still, thrown


def pixels(path: Path) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def test_one_tile_for_each_task(tmp_path: Path) -> None:
    episodes = {"high_jump": jump(bar_scene(), "high_jump")}
    episodes |= {name: still(scene_of(name), 3) for name in TASKS}
    episodes["a sport to come"] = still(Scene("any", load_body(), agents=(Start(), Start(2.0))), 3)
    episodes["free_throw"] = thrown(scene_of("free_throw"), (3.7, 0.0, 6.9), frames=20)
    tile = (150, 100)
    path = gallery.contact_sheet(episodes, tmp_path / "all.png", tile=tile)
    found = pixels(path)
    rows = math.ceil(len(episodes) / 5)
    assert found.shape == (rows * (100 + gallery.CAPTION), 5 * 150, 3)
    for i in range(5 * rows):
        y, x = i // 5 * (100 + gallery.CAPTION), i % 5 * 150
        picture, caption = found[y : y + 100, x : x + 150], found[y + 100 : y + 128, x : x + 150]
        there = i < len(episodes)
        assert (picture.reshape(-1, 3).std(0).max() > 8) == there, f"tile {i}"
        assert ((caption < 100).all(-1).sum() > 20) == there, f"caption {i}"
    assert not list(tmp_path.glob("*.tmp"))


def test_few_tasks_make_a_narrow_sheet(tmp_path: Path) -> None:
    episodes = {name: still(scene_of(name), 2) for name in ("fencing", "boxing")}
    path = gallery.contact_sheet(episodes, tmp_path / "two.png", tile=(120, 80))
    assert pixels(path).shape == (80 + gallery.CAPTION, 240, 3)
    path = gallery.contact_sheet(episodes, tmp_path / "two.webp", tile=(120, 80))
    assert pixels(path).shape == ((80 + gallery.CAPTION) // 2, 120, 3)
    with pytest.raises(ValueError, match="at least one"):
        gallery.contact_sheet({}, tmp_path / "none.png")


def test_every_task_of_the_registry_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the starts alone: playing the shipped policies is what `sample` does."""
    drawn = {}

    def keep(episodes, path, **options):
        drawn.update(episodes)
        return path

    monkeypatch.setattr(gallery, "contact_sheet", keep)
    monkeypatch.setattr(gallery, "shipped", lambda task: "zero")
    assert gallery.render_all(tmp_path / "all.png") == tmp_path / "all.png"
    assert tuple(drawn) == task_names()
    for name, episode in drawn.items():
        assert episode.task == name and 1 <= len(episode.qpos) <= gallery.HELD_STEPS


def test_shipped_policies_are_preferred_and_the_weaker_athlete_first() -> None:
    assert gallery.shipped("high_jump") == "pretrained:latent-human"
    assert gallery.shipped("no_such_task") == "zero"


def test_the_frame_shown_is_over_the_bar_or_what_matters_most() -> None:
    episode = jump(bar_scene(), "high_jump", takeoff=30)
    frame = gallery.highlight(Player(episode))
    assert abs(episode.qpos[frame, 0] - 20.0) < 0.3
    kick = thrown(scene_of("penalty_kick"), (14.0, -1.0, 3.0), start=25, frames=40)
    assert abs(gallery.highlight(Player(kick)) - 24) <= 1
    assert gallery.highlight(Player(still(scene_of("fencing"), 9))) == 8
