"""What happens in an episode, and which frames of it to look at.

Events are read off the recorded motion: a ball or javelin that leaves a hand, is struck, bounces
or comes down; a hurdle that is passed; a fall; a point. So they are the same for every engine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np

from olympics_opt.camera import things
from olympics_opt.episode import Player, Window
from sports.humanoid.mjcf import GROUND, body_name

FRAMES = 12
JUMP = 1.2
"""A change of a ball's velocity in one control step, beyond gravity's, that is an event (m/s)."""
TELEPORT = 1.5
"""A ball further than this (m) from where its velocity leads has been put there: a new ball."""
HELD, FREE = 0.05, 0.12
"""Distances (m) between a thing and a hand: held below the first, let go above the second."""
NEAR = 0.12
"""What is nearer to the ball than this (m) is what it touched."""
FALLEN = 0.45
"""Height of the root (m) under which an athlete lies on the ground."""
PRIZES = ("point", "goal", "basket", "bounce", "contact", "cleared")
"""Reward terms that begin when something counts."""
HANDS = ("Hand", "Wrist", "Index", "Middle", "Pinky", "Ring", "Thumb")


@dataclass(frozen=True)
class Event:
    """Something worth a picture."""

    frame: int
    word: str
    """What it was, in few words: ``ball: R_Toe``."""
    weight: float
    """How much it matters beside the others of its episode."""


def events(player: Player) -> list[Event]:
    """Everything that happened, in order of time."""
    found: list[Event] = []
    for name in things(player.scene):
        found += _struck(player, name)
        found += _released(player, name)
    found += _passed_hurdles(player)
    found += _falls(player)
    found += _paid(player)
    return sorted(found, key=lambda e: e.frame)


def _struck(player: Player, name: str) -> list[Event]:
    """Where a thing's velocity jumps: struck, bounced, caught; where a new one appears."""
    path, dt = player.thing(name), player.episode.dt
    if len(path) < 4:
        return []
    move = np.diff(path, axis=0) / dt  # (T - 1, 3) mean velocity between frames
    fall = np.array([0.0, 0.0, -9.81 * dt])
    blow = np.diff(move, axis=0) - fall  # at frames 1 .. T - 2
    jump = np.linalg.norm(blow, axis=1)
    found: list[Event] = []
    qvel = getattr(player.episode, "qvel", None)
    if qvel is not None and np.size(qvel):
        own = np.asarray(qvel)[:, player.scene.object_qvel(name)][:, :3]
        # The step's own velocities tell a new ball from a struck one.
        reach = np.linalg.norm(np.diff(path, axis=0), axis=1)
        fastest = np.maximum(np.linalg.norm(own[1:], axis=1), np.linalg.norm(own[:-1], axis=1))
        moved = np.flatnonzero(reach > fastest * dt * 1.3 + TELEPORT) + 1
    else:
        moved = np.flatnonzero(np.linalg.norm(move, axis=1) * dt > 4.0) + 1
    found += [Event(int(i), f"new {name}", 3.0) for i in moved]
    for i in moved:  # the jump into its new place is not a blow
        jump[max(0, i - 2) : i + 1] = 0.0
    last = -9
    for i in np.flatnonzero(jump > JUMP):
        # A blow between two frames shows in the two differences around it: take the larger.
        if jump[max(0, i - 1)] > jump[i] or jump[min(len(jump) - 1, i + 1)] > jump[i]:
            continue
        frame = int(i) + 1
        if frame - last < 2:
            continue
        touched = _touched(player, name, frame, blow[i])
        weight = (2.0 if touched not in ("", GROUND) else 1.0) * min(1.0, jump[i] / 6.0)
        if touched or jump[i] > 2 * JUMP:
            found.append(Event(frame, f"{name}: {touched or '?'}", 1.0 + weight))
            last = frame
    return found


def _touched(player: Player, name: str, frame: int, blow: np.ndarray) -> str:
    """What struck a thing around a frame, which changed its velocity by ``blow`` (3,): the nearest
    link or object; empty where nothing is near. A ball on the ground that goes off along it was
    struck by what else is near."""
    around = [f for f in (frame - 1, frame, frame + 1) if 0 <= f < len(player)]
    others = [owner for owner in set(_owners(player).values()) if owner not in (name, GROUND)]
    ground = min(_nearest(player, name, f, (GROUND,))[0] for f in around)
    away, other = min(_nearest(player, name, f, others) for f in around)
    upward = blow[2] > 2.0 * float(np.hypot(blow[0], blow[1]))
    if other and away < NEAR and not (upward and ground < NEAR):
        return other
    return GROUND if ground < NEAR else ""


def _nearest(
    player: Player, name: str, frame: int, only: Sequence[str] | None = None, far: float = 0.5
) -> tuple[float, str]:
    """Distance (m, at most ``far``) from a thing to the nearest other shape, and whose it is.

    ``only``: names of links or objects, or the ground; without them any shape counts.
    """
    data, model = player.show(frame), player.model
    ids = _owners(player)
    best, word = far, ""
    own = [g for g, owner in ids.items() if owner == name]
    at = data.geom_xpos[own[0]]
    for g, owner in ids.items():
        if owner == name or (only is not None and owner not in only):
            continue
        if owner == GROUND:
            if player.ground is not None:
                continue
        elif np.linalg.norm(data.geom_xpos[g] - at) > model.geom_rbound[g] + 3.0 + far:
            continue
        for b in own:
            away = mujoco.mj_geomDistance(model, data, b, g, best, None)
            if away < best:
                best, word = away, owner
    if player.ground is not None and (only is None or GROUND in only):
        x, y, z = at
        high = z - float(player.ground.height(x, y)) - float(model.geom_rbound[own[0]])
        if high < best:
            best, word = high, GROUND
    return best, word


def _owners(player: Player) -> dict[int, str]:
    """What each shape belongs to: an athlete's link, an object of the episode, the ground."""
    model, scene, found = player.model, player.episode.scene, {}
    names = {model.body(o.name).id: o.name for o in scene.objects}
    many = scene.num_agents > 1
    for agent in range(scene.num_agents):
        for link in scene.body.link_names:
            names[model.body(body_name(agent, link)).id] = f"{agent}/{link}" if many else link
    for g in range(model.ngeom):
        body = int(model.geom_bodyid[g])
        if body in names:
            found[g] = names[body]
        elif model.geom(g).name == GROUND:
            found[g] = GROUND
    return found


def _released(player: Player, name: str) -> list[Event]:
    """Where a hand lets go of a thing for good."""
    links = player.scene.body.link_names
    hands = [link for link in links if link.split("_")[-1].rstrip("0123456789") in HANDS]
    many = player.scene.num_agents > 1
    if many or not hands:
        return []
    far = FREE + 0.03
    first = _nearest(player, name, 0, hands, far)[0]
    if first > HELD:
        return []
    for frame in range(1, len(player)):
        if _nearest(player, name, frame, hands, far)[0] > FREE:
            return [Event(frame, f"{name} released", 4.0)]
    return []


def _passed_hurdles(player: Player) -> list[Event]:
    """Where the first athlete's root passes each hurdle."""
    x = player.qpos[:, 0]
    found = []
    for o in player.episode.scene.objects:
        if o.name.startswith("hurdle"):
            passed = np.flatnonzero((x[1:] > o.pos[0]) & (x[:-1] <= o.pos[0]))
            if len(passed):
                found.append(Event(int(passed[0]) + 1, o.name, 2.0))
    return found


def _falls(player: Player) -> list[Event]:
    """Where an athlete first lies on the ground."""
    found = []
    for agent, z in enumerate(player.roots()[:, :, 2].T):
        low = np.flatnonzero(z < FALLEN)
        if len(low) and low[0] > 0:
            who = f"{agent} falls" if player.scene.num_agents > 1 else "falls"
            found.append(Event(int(low[0]), who, 1.5))
    return found


def _paid(player: Player) -> list[Event]:
    """Where a point, a goal, a basket begins to be paid."""
    found = []
    for name, table in getattr(player.episode, "terms", {}).items():
        if name in PRIZES:
            paid = np.abs(np.asarray(table, dtype=float)).reshape(len(table), -1).max(1) > 1e-6
            begins = np.flatnonzero(paid & ~np.r_[False, paid[:-1]])
            found += [Event(int(i), name, 3.0) for i in begins]
    return found


def chosen_frames(window: Window, happened: Sequence[Event], count: int = FRAMES) -> list[int]:
    """Frames to look at: the first and the last of the window, its landing, the events that
    matter most, and evenly what is left. Shorter windows repeat no frame; they give fewer."""
    length = window.stop - window.start + 1
    if length <= count:
        return list(range(window.start, window.stop + 1))
    if not happened:
        return sheet_frames(window, count)
    chosen = {window.start, window.stop}
    if window.landing is not None:
        chosen.add(window.landing)
    gap = max(2, length // (4 * count))
    # Two thirds for events: what comes between them is needed to understand them.
    room = len(chosen) + round((count - len(chosen)) * 2 / 3)
    for event in sorted(happened, key=lambda e: (-e.weight, e.frame)):
        if len(chosen) >= room:
            break
        inside = window.start <= event.frame <= window.stop
        if inside and min(abs(event.frame - f) for f in chosen) >= gap:
            chosen.add(event.frame)
    while len(chosen) < count:
        order = sorted(chosen)
        a, b = max(pairwise(order), key=lambda pair: pair[1] - pair[0])
        if b - a < 2:
            break
        chosen.add((a + b) // 2)
    return sorted(chosen)


def sheet_frames(window: Window, count: int = FRAMES) -> list[int]:
    """Frames evenly spread over the window, the landing among them.

    Shorter windows repeat no frame; they give fewer.
    """
    frames = np.unique(np.linspace(window.start, window.stop, count).round().astype(int))
    if window.landing is not None and len(frames) > 2 and window.landing not in frames:
        nearest = int(np.abs(frames[1:-1] - window.landing).argmin()) + 1
        frames[nearest] = window.landing
    return sorted({int(f) for f in frames})
