"""A kick that MuJoCo played, made to send the ball where it was meant to go.

The ball has no friction with the foot, so a face of the foot that is 5 degrees off sends it a metre
aside at the goal. The targets of the kicking leg and the trunk get small bumps in the last steps
before the impact, sought by the cross-entropy method (Rubinstein 1999): candidates are simulated
from a state shortly before it, and judged by where the ball, in free flight, passes the goal plane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sports.env import make_scene
from warmstart import kick
from warmstart.clip import Clip
from warmstart.cross_entropy import CrossEntropy
from warmstart.tracking import Worlds

BUMPED = (
    *(f"R_{j}" for j in ("Hip_x", "Hip_y", "Hip_z", "Knee_y", "Ankle_x", "Ankle_y")),
    "Torso_z",
)
"""Joints whose targets get bumps."""
MIDDLES = (-5, -3, -1)
"""Middles of the bumps, in control steps from the last one before the impact; each falls to zero
over :data:`WIDTH`."""
WIDTH = 2.0
UNIT = 0.1
"""Height of a bump of size 1 (rad)."""
BEFORE, AFTER = 8, 3
"""Control steps that a candidate is simulated before and after the impact."""
PRICE = 0.005
"""Of the squared size of the bumps (m)."""
SLOW, SLOWNESS = 0.05, 5.0
"""A ball may be slower than asked by this share of its speed; what is more costs so much (m)."""


@dataclass(frozen=True)
class Search:
    """Settings of the search."""

    worlds: int = 24
    """Candidates of a round."""
    rounds: int = 20
    searches: int = 4
    """Each starts from the episode that the one before found."""
    near: float = 0.5
    """A candidate that costs no more than this (m) is played in the task; the last one always."""
    enough: float = 0.25
    """A played goal that costs no more than this (m) ends the search."""
    seed: int = 0


def bumps(numbers: np.ndarray, columns: list[int], dofs: int) -> np.ndarray:
    """(BEFORE + AFTER, dofs) what the numbers (P,) add to the targets (rad); the row BEFORE - 1 is
    the last step before the impact."""
    step = np.arange(BEFORE + AFTER) - (BEFORE - 1)
    shape = np.maximum(0.0, 1.0 - np.abs(step[:, None] - np.array(MIDDLES)) / WIDTH)
    out = np.zeros((BEFORE + AFTER, dofs))
    out[:, columns] = UNIT * shape @ numbers.reshape(len(MIDDLES), len(BUMPED))
    return out


def aim(
    clip: Clip,
    target: tuple[float, float],
    play: Callable[[np.ndarray], Clip],
    settings: Search | None = None,
    *,
    threads: int = 0,
) -> Clip:
    """The episode ``clip``, or one played with other targets whose ball passes nearer to ``target``
    (y, z; m), about as fast as asked.

    ``play`` plays targets (K, n) from the task's start; its clips say in ``meta`` when the ball was
    kicked (``release``), how fast it left and how far off it passed (``ball_speed``,
    ``ball_off_target``), and how fast it was to be (``asked``). A clip whose ball was not
    kicked is returned as it is.
    """
    settings = settings or Search()
    if "release" not in clip.meta["events"] or clip.ctrl is None:
        return clip
    for index in range(settings.searches):
        if _rank(clip) <= (0.0, settings.enough):
            break
        assert clip.ctrl is not None
        again = replace(settings, seed=settings.seed + index)
        clip = _search(clip, clip.ctrl, target, play, again, threads)
    return clip


def _search(
    clip: Clip,
    base: np.ndarray,
    target: tuple[float, float],
    play: Callable[[np.ndarray], Clip],
    settings: Search,
    threads: int,
) -> Clip:
    """One search around the targets ``base`` (K, n) of an episode."""
    assert clip.object_qpos is not None and clip.object_qvel is not None
    scene = make_scene("penalty_kick", strength=clip.meta["strength"])
    body, ball, rate = scene.body, scene.object_qpos("ball"), scene.object_qvel("ball")
    columns = [body.dof_index(name) for name in BUMPED]
    limit = body.action_scale()
    first = max(round(clip.meta["events"]["release"] * clip.fps) - BEFORE, 0)
    rows = np.minimum(np.arange(first, first + BEFORE + AFTER), len(base) - 1)
    qpos, qvel = scene.default_qpos(), np.zeros(scene.nv)
    qpos[scene.agent_qpos(0)], qpos[ball] = clip.qpos[first], clip.object_qpos[first]
    qvel[scene.agent_qvel(0)], qvel[rate] = clip.qvel[first], clip.object_qvel[first]
    worlds = Worlds(scene, settings.worlds, threads)
    search = CrossEntropy(len(BUMPED) * len(MIDDLES), settings.worlds, settings.seed)
    best, miss = clip, np.full(settings.worlds, np.inf)

    def played(numbers: np.ndarray) -> np.ndarray:
        ctrl = base.copy()
        more = bumps(numbers, columns, body.num_dofs)[: len(ctrl) - first]
        ctrl[first : first + len(more)] += more
        return np.clip(ctrl, -limit, limit)

    for left in reversed(range(settings.rounds)):
        numbers = search.ask()
        worlds.put(settings.worlds, qpos, qvel, np.zeros(scene.nv))
        added = np.stack([bumps(row, columns, body.num_dofs) for row in numbers])
        for k, row in enumerate(rows):
            worlds.step(np.clip(base[row] + added[:, k], -limit, limit))
        for i in range(settings.worlds):
            at = kick.passes(worlds.qpos[i, ball][:3], worlds.qvel[i, rate][:3])
            off = float(np.nan_to_num(np.linalg.norm(at - np.array(target)), nan=kick.LOST))
            speed = float(np.linalg.norm(worlds.qvel[i, rate][:3]))
            miss[i] = off + _slow(speed, clip)
        better = search.tell(miss + PRICE * (numbers**2).sum(1))
        if (better is not None and miss[better] <= settings.near) or not left:
            now = play(played(search.best))
            if _rank(now) < _rank(best):
                best = now
            if _rank(best) <= (0.0, settings.enough):
                break
    return best


def _slow(speed: float, clip: Clip) -> float:
    """Cost (m) of a ball that is slower than asked (m/s)."""
    return SLOWNESS * max(1.0 - SLOW - speed / clip.meta["asked"]["ball_speed"], 0.0)


def _rank(clip: Clip) -> tuple[float, float]:
    """Goals first, then what is paid for being off the target and slow (m)."""
    achieved = clip.meta["achieved"]
    off = achieved.get("ball_off_target", kick.LOST)
    return 1.0 - achieved.get("goal", 0.0), off + _slow(achieved.get("ball_speed", 0.0), clip)
