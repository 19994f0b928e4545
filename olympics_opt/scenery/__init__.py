"""What a sport looks like beyond its physics: paint, props, terrain, and the athletes' colours.

Shared by every renderer (`raycast.py`, `video.py`, `viewer.py`, `report/replay.py`); nothing here
touches physics. World frame, z up, play along +x; m.

A scene is looked up by its name, which is its task's; `tennis_1v1` looks like `tennis`. What
differs between worlds comes from the recording: ``shown`` holds, by name, what the sport says of
the field in that world (``Task.shown``): ``target`` (T, 3) or (T, A, 3) m, of each athlete, and
the ``phases`` of golf's waves, (T, 2) rad.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from olympics_opt.scenery import athletics, courts, fields, golf
from olympics_opt.scenery.athletes import LIMBS, link_color, shape_colors, teams
from olympics_opt.scenery.golf import Terrain
from olympics_opt.scenery.paint import Mark, rectangle, rgb
from olympics_opt.scenery.props import is_net, plate, prop
from sports.scene import Scene, SceneObject

__all__ = [
    "LIMBS",
    "Mark",
    "Terrain",
    "complete_qpos",
    "dressed",
    "ground_marks",
    "is_net",
    "link_color",
    "rgb",
    "shape_colors",
    "teams",
    "terrain",
]

WALLS = 0.35
"""Opacity of walls around a field."""
Shown = Mapping[str, np.ndarray]
Painter = Callable[[Scene], list[Mark]]
Dresser = Callable[[Scene], list[SceneObject]]


def _nothing(scene: Scene) -> list[SceneObject]:
    return []


def _spot(scene: Scene) -> list[SceneObject]:
    """A flat disc where the ball should come down."""
    disc = plate((0.0, 0.0, 0.004), (0.0, 0.0, 0.010), 0.30)
    return [prop("target_spot", "#f2c230", [disc], alpha=0.85, motion="mocap")]


def _small_spot(scene: Scene) -> list[SceneObject]:
    disc = plate((0.0, 0.0, 0.002), (0.0, 0.0, 0.006), 0.10)
    return [prop("target_spot", "#f2c230", [disc], alpha=0.85, motion="mocap")]


def _bull(scene: Scene) -> list[SceneObject]:
    """An upright disc in the goal: where a penalty should enter it."""
    disc = plate((-0.01, 0.0, 0.0), (0.01, 0.0, 0.0), 0.16)
    return [prop("target_disc", "#f2c230", [disc], alpha=0.85, motion="mocap")]


@dataclass(frozen=True)
class Look:
    """How one sport is painted and furnished."""

    marks: Painter
    props: Dresser = _nothing
    target: Dresser = _nothing
    """What stands at the target; drawn where the recording says where that is."""


_LOOKS = {
    "high_jump": Look(athletics.high_jump),
    "long_jump": Look(athletics.long_jump),
    "hurdling": Look(athletics.hurdling),
    "javelin": Look(athletics.javelin),
    "golf": Look(golf.marks, golf.tee, golf.flag),
    "tennis": Look(courts.tennis, courts.tennis_props, _spot),
    "table_tennis": Look(courts.table_tennis, courts.table_tennis_props, _small_spot),
    "fencing": Look(courts.fencing),
    "boxing": Look(courts.boxing, courts.boxing_props),
    "penalty_kick": Look(fields.penalty_kick, fields.goal_nets, _bull),
    "soccer": Look(fields.soccer, fields.goal_nets),
    "free_throw": Look(fields.basketball, fields.baskets),
    "basketball": Look(fields.basketball, fields.baskets),
}


def look(scene: Scene) -> Look | None:
    """The look of a scene's sport; None for one that has none."""
    return _LOOKS.get(re.sub(r"_\dv\d$", "", scene.name))


def ground_marks(scene: Scene) -> list[Mark]:
    """Marks painted on a scene's ground: its sport's, then its named sites on the ground."""
    found = look(scene)
    marks = found.marks(scene) if found else []
    for name, (x, y, _z) in scene.sites.items():
        marks.append(rectangle(x - 0.06, x + 0.06, y - 0.06, y + 0.06, "#b0563c", name))
    return marks


def terrain(scene: Scene, shown: Shown | None = None) -> Terrain | None:
    """The waves of a golf course, where the recording says how they lie; None on flat ground."""
    phases = np.asarray((shown or {}).get("phases", np.zeros(0)), dtype=float)
    if not phases.size or not np.isfinite(phases).all():
        return None
    a, b = phases.reshape(-1, 2)[0].tolist()
    for surface in scene.surfaces:
        if surface.kind == "waves":
            return Terrain((a, b), *surface.size)
    return None


def dressed(scene: Scene, shown: Shown | None = None) -> tuple[Scene, np.ndarray]:
    """The scene with its props, for drawing: the same ``qpos``, more fixtures. Walls are seen
    through: the ball often lies behind one.

    Returns the scene, and (T, K, 3) or (1, K, 3) positions of the props that move, which are the
    last of its mocap objects.
    """
    found, places = look(scene), np.zeros((1, 0, 3))
    if found is None:
        return scene, places
    props, target = found.props(scene), np.asarray((shown or {}).get("target", ()), dtype=float)
    if target.size:
        spots = target.reshape(len(target), -1, 3)  # (T, A, 3), of one or each athlete
        flags = found.target(scene)
        props = [
            *props,
            *(replace(o, name=f"{o.name}{a}") for a in range(spots.shape[1]) for o in flags),
        ]
        places = np.repeat(spots, len(flags), axis=1)
    own = [
        replace(o, rgba=(*o.rgba[:3], WALLS)) if o.name.startswith("wall") else o
        for o in scene.objects
    ]
    return replace(scene, objects=(*own, *props)), places


def complete_qpos(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """(T, nq) positions of a whole scene from positions of a whole scene or of its first athlete.

    Missing athletes and objects stay where the scene puts them. Raises ValueError for any other
    width.
    """
    qpos = np.atleast_2d(np.asarray(qpos, dtype=float))
    if qpos.shape[1] == scene.nq:
        return qpos
    agent = scene.agent_qpos(0)
    if qpos.shape[1] != agent.stop:
        raise ValueError(
            f"qpos has {qpos.shape[1]} columns; scene '{scene.name}' needs {scene.nq}, "
            f"or {agent.stop} for its first athlete alone"
        )
    full = np.tile(scene.default_qpos(), (len(qpos), 1))
    full[:, agent] = qpos
    return full
