"""How the strikes and throws are judged, by problem."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from sports import boxing, combat, fencing, penalty_kick, table_tennis, tennis
from sports.free_throw import RIM
from sports.humanoid.body import Body
from sports.humanoid.mjcf import build_model
from sports.rackets import Game
from sports.scene import Scene
from warmstart import duel, held_ball, kick, shot, tee_shot, thrown
from warmstart.outcome import link_poses
from warmstart.replay import Replayed
from warmstart.solution import Solution
from warmstart.strike import Moment, Rules

Checks = dict[str, tuple[str, float, str]]
_RECORDED = ("recorded", float("nan"))


def _tennis(body: Body) -> Scene:
    return tennis.scene(tennis.Tennis(), body)


def _table_tennis(body: Body) -> Scene:
    return table_tennis.scene(table_tennis.TableTennis(), body)


def _ball(off: float) -> Checks:
    """Checks of a stroke whose planned ball may land ``off`` (m) its target."""
    return {
        "planned landing off target": ("<=", off, "m"),
        "planned over the net": (">=", 0.0, "m"),
        **{
            f"replay in {engine}: {name}": (*_RECORDED, unit)
            for engine in ("mujoco", "drake")
            for name, unit in (
                ("landing off target", "m"),
                ("over the net", "m"),
                ("ball: speed", "m/s"),
                ("ball: landing off target", "m"),
                ("ball: over the net", "m"),
            )
        },
    }


def _strokes(
    game: Game,
    scene: Callable[[Body], Scene],
    checks: Checks,
    also: Callable[[Solution], dict[str, float]] | None = None,
) -> Rules:
    """Rules of a racket sport."""
    return Rules(
        "ball_speed",
        "m/s",
        nearest=True,
        follow=lambda solution, found: shot.followed(game, scene(solution.body), solution, found),
        play=lambda solution, engine: shot.played(game, scene(solution.body), solution, engine),
        checks=checks,
        also=also,
    )


def depth_in(
    solution: Solution, scene: Scene, name: str, rate: float = 240.0, until: float = np.inf
) -> float:
    """How deep (m) the planned athlete reaches into an object of a scene at most before a time (s
    from the first knot), by MuJoCo."""
    model = build_model(scene)
    data = mujoco.MjData(model)
    body = model.body(name).id
    data.qpos[:] = scene.default_qpos()
    times = np.arange(0.0, min(solution.duration, until), 1.0 / rate)
    deepest = 0.0
    for row in solution.sample(solution.times[0] + times)["qpos"]:
        data.qpos[scene.agent_qpos(0)] = row
        mujoco.mj_fwdPosition(model, data)
        for contact in data.contact:
            if body in model.geom_bodyid[contact.geom]:
                deepest = max(deepest, -float(contact.dist))
    return deepest


def _over_the_table(solution: Solution) -> dict[str, float]:
    return {"planned depth in the table": depth_in(solution, _table_tennis(solution.body), "table")}


def _javelin(solution: Solution, found: Moment) -> dict[str, float]:
    return {
        "outcome": float(np.linalg.norm(found.velocity)),
        "height": float(found.place[2]),
        "distance": thrown.distance(found.place, found.velocity, found.normal),
    }


def _golf() -> Checks:
    """Checks of a stroke off the tee."""
    ball = (("launch speed", "m/s"), ("launch angle", "deg"), ("carry", "m"), ("aside", "m"))
    face = (("loft", "deg"), ("attack", "deg"))
    out: Checks = {
        "planned loft off": ("<=", 0.5, "deg"),
        "planned head over the ground": (">=", 0.0, "m"),
    }
    for head in ("planned ", "replay in mujoco: ", "replay in drake: "):
        out |= {f"{head}{name}": (*_RECORDED, unit) for name, unit in face + ball}
    for head in ("replay in mujoco: ", "replay in drake: "):
        out |= {
            f"{head}loft off": ("<=", 3.0, "deg"),
            f"{head}head over the ground": (">=", 0.0, "m"),
            f"{head}ball: launch speed off": ("<=", 0.10, "of the planned speed"),
        }
        out |= {f"{head}ball: {name}": (*_RECORDED, unit) for name, unit in ball}
    return out


def on_its_feet(solution: Solution, qpos: np.ndarray) -> dict[str, float]:
    """Height (m) of the lowest link in any frame, feet and hands left out: tasks call it a fall
    when one is below 0.15 m."""
    pos, _ = link_poses(solution.body, qpos)
    names = solution.body.link_names
    counts = [not name.endswith(("Ankle", "Toe", "Wrist", "Hand")) for name in names]
    return {"lowest but feet": float(pos[:, counts, 2].min())}


def _stepped(solution: Solution, qpos: np.ndarray) -> dict[str, float]:
    """How far (m) the front foot is ahead of where it stood, at the end, and the rear one of where
    it stood, at any time."""
    pos, _ = link_poses(solution.body, qpos)
    feet = [pos[:, solution.body.link_index(f"{side}_Ankle"), :2] for side in "RL"]
    front, rear = (np.linalg.norm(foot - foot[0], axis=1) for foot in feet)
    return {"step": float(front[-1]), "rear foot moves": float(rear.max())}


def _lunge(solution: Solution, found: Moment) -> dict[str, float]:
    """How far over the ground the point is from where the root was at the start."""
    return {
        "outcome": float(np.linalg.norm(found.place[:2] - solution.qpos[0, :2])),
        "tip speed": float(np.linalg.norm(found.velocity)),
    }


_REPLAYS = ("replay in mujoco: ", "replay in drake: ")
_DUEL: Checks = {
    f"{head}{name}": limit
    for head in _REPLAYS
    for name, limit in (
        ("lowest but feet", (">=", 0.15, "m")),
        ("opponent: force", (">=", combat.TOUCH_FORCE, "N")),
        ("opponent: late", (*_RECORDED, "s")),
    )
}
"""Whoever strikes stays on its feet, and the opponent of the task is touched."""


def _free_throw(solution: Solution, found: Moment) -> dict[str, float]:
    flight = thrown.fall(found.place, found.velocity, np.array(RIM))
    return {
        "outcome": flight["apex"],
        "release speed": float(np.linalg.norm(found.velocity)),
        "height": float(found.place[2]),
        "miss of the ring's middle": flight["miss"],
        "entry angle": flight["entry"],
        "basket": flight["basket"],
    }


_FLIGHT = (
    ("release speed", "m/s"),
    ("height", "m"),
    ("miss of the ring's middle", "m"),
    ("entry angle", "deg"),
    ("basket", "0 or 1"),
)
_BALL = (
    ("ball: late", "s"),
    ("ball: release speed", "m/s"),
    ("ball: speed off", "of the asked speed"),
    ("ball: direction off", "deg"),
    ("ball: apex", "m"),
    ("ball: miss of the ring's middle", "m"),
    ("ball: basket", "0 or 1"),
)


def _throw_at_the_basket(play: Callable[[Solution, str], dict[str, float]] | None = None) -> Rules:
    """Rules of a throw at the basket: planned, the ball goes in."""
    checks: Checks = {
        f"{head}{name}": (*_RECORDED, unit)
        for head in ("planned ", *_REPLAYS)
        for name, unit in _FLIGHT
    }
    if play is not None:
        checks |= {f"{head}{name}": (*_RECORDED, u) for head in _REPLAYS for name, u in _BALL}
    checks["planned basket"] = (">=", 1.0, "0 or 1")
    return Rules("apex", "m", nearest=False, follow=_free_throw, play=play, checks=checks)


def _before_the_ball(solution: Solution) -> dict[str, float]:
    world = penalty_kick.scene(penalty_kick.PenaltyKick(), solution.body)
    until = float(solution.stats["event"]["time"])
    depth = depth_in(solution, world, "ball", rate=960.0, until=until)
    return {"planned depth in the ball before the impact": depth}


def _approached(solution: Solution, played: Replayed) -> dict[str, float]:
    """Of a kick with a step: how far (m) the left foot has come when the ball is kicked, whether
    the athlete stays on its feet while the plan lasts, and the largest torque that feedback asked
    for, over its limit."""
    body = solution.body
    until = played.times <= solution.duration
    pos, _ = link_poses(body, played.qpos[until])
    foot = pos[:, body.link_index("L_Ankle"), :2]
    at = int(np.searchsorted(played.times, solution.stats["event"]["time"]))
    share = np.abs(played.feedback) / body.array("effort")
    return {
        "step": float(np.linalg.norm(foot[at] - foot[0])),
        "feedback torque": float(share.max()),
        **on_its_feet(solution, played.qpos[until]),
    }


def _penalty_kick() -> Rules:
    checks: Checks = {
        "planned depth in the ball before the impact": ("<=", 0.002, "m"),
        "planned off target": ("<=", 0.25, "m"),
        "planned effective mass": (*_RECORDED, "kg"),
    }
    for engine in ("mujoco", "drake"):
        checks |= {
            f"replay in {engine}: {name}": (*_RECORDED, unit)
            for name, unit in (
                ("off target", "m"),
                ("ball: speed", "m/s"),
                ("ball: off target", "m"),
            )
        }
    return Rules(
        "ball_speed",
        "m/s",
        nearest=True,
        follow=kick.followed,
        play=kick.played,
        also=_before_the_ball,
        checks=checks,
        closed=_approached,
        closed_checks={
            f"{head}{name}": limit
            for head in _REPLAYS
            for name, limit in (
                ("step", (">=", 0.2, "m")),
                ("lowest but feet", (">=", 0.15, "m")),
                ("feedback torque", (*_RECORDED, "of the limit")),
            )
        },
    )


RULES: dict[str, Rules] = {
    "boxing": Rules(
        "fist_speed",
        "m/s",
        nearest=True,
        whole=on_its_feet,
        play=lambda solution, engine: duel.met(solution, engine, boxing.GLOVES),
        checks=_DUEL,
    ),
    "fencing": Rules(
        "reach",
        "m",
        nearest=True,
        follow=_lunge,
        whole=lambda solution, qpos: on_its_feet(solution, qpos) | _stepped(solution, qpos),
        play=lambda solution, engine: duel.met(solution, engine, fencing.SWORD),
        checks=_DUEL
        | {f"{head}tip speed": (*_RECORDED, "m/s") for head in ("planned ", *_REPLAYS)}
        | {f"{head}step": (">=", 0.2, "m") for head in _REPLAYS}
        | {f"{head}rear foot moves": ("<=", 0.1, "m") for head in _REPLAYS},
    ),
    "free_throw": _throw_at_the_basket(held_ball.figures),
    "golf": Rules(
        "club_speed",
        "m/s",
        nearest=True,
        follow=tee_shot.followed,
        play=tee_shot.played,
        also=tee_shot.swept,
        checks=_golf(),
    ),
    "javelin": Rules(
        "release_speed",
        "m/s",
        nearest=False,
        follow=_javelin,
        checks={
            f"{head}{name}": (*_RECORDED, "m")
            for head in ("planned ", "replay in mujoco: ", "replay in drake: ")
            for name in ("height", "distance")
        },
    ),
    "set_shot": _throw_at_the_basket(),
    "penalty_kick": _penalty_kick(),
    "table_tennis": _strokes(
        table_tennis.GAME,
        _table_tennis,
        _ball(0.1) | {"planned depth in the table": ("<=", 0.002, "m")},
        _over_the_table,
    ),
    "tennis": _strokes(tennis.GAME, _tennis, _ball(0.5)),
}
"""By problem."""
