"""``olympics-opt render --all``: every task of the registry on one picture, one frame each.

A task with a shipped policy is shown at the height of an episode of it; any other one a moment
after its start, with the servos holding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from olympics_opt.camera import Stand, shot, shots, stand
from olympics_opt.episode import Episode, Player, decisive_window
from olympics_opt.moments import events
from olympics_opt.raycast import View
from olympics_opt.render import font, labels, picture, write_picture
from olympics_opt.scenery import ground_marks
from sports import hurdling

TILE, CAPTION = (480, 320), 30
"""Width and height of a picture, and of the strip under it (pixels)."""
COLUMNS = 5
HELD_STEPS = 14
"""Control steps after which a task without a policy is shown: a ball is on its way, and nobody
has fallen yet."""
BAR_X = 20.0
AHEAD, DOWN = math.radians(28.0), math.radians(11.0)
"""A solo athlete is seen from this far ahead of its side, and from this far above."""
_LANE = tuple((hurdling.FIRST_X + k * hurdling.GAP, 0.0, hurdling.RACE_HEIGHT) for k in range(2))
_STARTS = {
    "hurdling": Stand(azimuth=14.0, pitch=10.0, anchors=_LANE),
}
"""Where a start is seen from that would otherwise show an athlete and nothing else."""
TRIALS = 4
"""Episodes of a policy from which the best is taken."""


def shipped(task: str) -> str:
    """The policy with which a task is shown: the weakest athlete's that is shipped, or ``zero``."""
    from rl.pretrained import available

    have = [f"pretrained:{p['name']}-{p['strength']}" for p in available() if p["task"] == task]
    return min(have, key=lambda name: not name.endswith("-human")) if have else "zero"


def sample(task: str, policy: str, seed: int = 0) -> Any:
    """An episode of a task, or its beginning where no policy plays it."""
    if policy != "zero":
        from rl.evaluate import evaluate

        return evaluate(policy, task, trials=TRIALS, seed=seed, num_worlds=TRIALS, record=1).best
    return beginning(task, HELD_STEPS, seed)


def beginning(task: str, steps: int, seed: int = 0) -> Any:
    """The first control steps of an episode with action zero, as a recording."""
    import torch

    from rl.recording import Tape
    from sports.env import make_env

    env = make_env(task, num_worlds=1, seed=seed, training=False)
    try:
        tape = Tape(env, on=True)
        action = torch.zeros(1, env.num_agents, env.action_size)
        for _ in range(steps):
            result = env.step(action)
            tape.add(action, result)
            if bool(result.ended[0]) or not bool(result.valid[0]):
                break
        facts = {"task": task, "options": {}, "seed": seed}
        return tape.cut(0, 0, len(tape.steps), {}, facts)
    finally:
        env.close()


def highlight(player: Player) -> int:
    """The frame to show: in the jump (over the bar), what matters most, or the last one."""
    window = decisive_window(player.episode, player)
    if window.takeoff is not None and window.landing is not None:
        jump = player.qpos[window.takeoff : window.landing + 1, 0]
        if player.episode.task == "high_jump":
            return window.takeoff + int(np.abs(jump - BAR_X).argmin())
        return window.takeoff + len(jump) // 2
    happened = events(player)
    if happened and len(player) > HELD_STEPS:
        return max(happened, key=lambda e: (e.weight, -e.frame)).frame
    return len(player) - 1


def contact_sheet(
    episodes: Mapping[str, Episode],
    path: str | Path,
    *,
    notes: Mapping[str, str] | None = None,
    columns: int = COLUMNS,
    tile: tuple[int, int] = TILE,
) -> Path:
    """Draws one frame of each episode on one picture.

    Args:
        episodes: by the name that is written under the picture (a task's).
        path: PNG, JPEG or WebP file (`olympics_opt.render.write_picture`).
        notes: a few words beside a name.
        columns: pictures in a row.
        tile: width and height of a picture (pixels).

    Raises:
        ValueError: no episodes.
    """
    from PIL import Image, ImageDraw

    if not episodes:
        raise ValueError("a contact sheet needs at least one episode")
    columns = min(columns, len(episodes))
    rows = math.ceil(len(episodes) / columns)
    high = tile[1] + CAPTION
    sheet = Image.new("RGB", (columns * tile[0], rows * high), (255, 255, 255))
    ink = ImageDraw.Draw(sheet)
    for i, (name, episode) in enumerate(episodes.items()):
        player = Player(episode)
        frame = highlight(player)
        view, marks = _view(player, frame, tile), ground_marks(episode.scene)
        image = picture(player, frame, view, marks)
        labels(ImageDraw.Draw(image), view, marks)
        at = (i % columns * tile[0], i // columns * high)
        sheet.paste(image, at)
        ink.rectangle((*at, at[0] + tile[0] - 1, at[1] + tile[1] - 1), outline=(255, 255, 255))
        words = name.replace("_", " ")
        ink.text((at[0] + 8, at[1] + tile[1] + 4), words, font=font(18), fill=(20, 26, 32))
        note = (notes or {}).get(name, "")
        place = (at[0] + tile[0] - 8, at[1] + tile[1] + 8)
        ink.text(place, note, font=font(13), fill=(110, 118, 126), anchor="ra")
    return write_picture(sheet, path)


def _view(player: Player, frame: int, tile: tuple[int, int]) -> View:
    """As on a sheet, but solo athletes are seen half from ahead, and at a start from behind."""
    start = _STARTS.get(player.scene.name)
    if start is not None and len(player) <= HELD_STEPS:
        return shot(player, frame, *tile, own=start)
    view = shots(player, [frame], *tile)[0]
    if stand(player.scene) is None:
        view = replace(view, azimuth=view.azimuth - AHEAD, pitch=DOWN, height=1.1 * view.height)
    return view


def render_all(path: str | Path, seed: int = 0) -> Path:
    """Plays and draws every task of the registry."""
    from olympics_opt.progress import progress
    from sports.registry import task_names

    episodes: dict[str, Episode] = {}
    notes = {}
    with progress("drawing every task") as bar:
        names = task_names()
        for i, name in enumerate(names):
            bar.show(name, i, len(names))
            policy = shipped(name)
            episodes[name] = sample(name, policy, seed)
            notes[name] = policy.removeprefix("pretrained:") if policy != "zero" else "start"
        bar.show("drawing", len(names), len(names))
        written = contact_sheet(episodes, path, notes=notes)
        bar.finish(f"{len(names)} tasks")
    return written
