"""A scene's ball, the surfaces that it can hit, and the drag of objects, as arrays of the ball law.

Used by every engine that has a ball of the law or an object with drag; see ``sports.ball_law``.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from sports.ball import BallLaw, ball_of
from sports.ball_law.contact import (
    AXES,
    BALL_RADIUS,
    BEND,
    BOX,
    CENTER,
    DISC,
    FRICTION,
    KIND,
    PLANE,
    REACH,
    RESTITUTION,
    ROLLING,
    SIZE,
    SURFACE_NUMBERS,
    TOOL,
    TOOL_CENTER,
    TOOL_COMPLIANCE,
    TOOL_MASS,
    TOOL_NUMBERS,
    WAVES,
    Game,
)
from sports.ball_law.play import STATE_NUMBERS
from sports.humanoid.body import Body
from sports.scene import Scene, SceneObject, Surface

_KINDS = {"plane": PLANE, "box": BOX, "disc": DISC, "waves": WAVES}
_NO_BALL = ball_of("tennis")
"""Stands for the numbers of a ball where a scene has only objects with drag."""


def has_game(scene: Scene) -> bool:
    """Whether a scene has a ball of the ball law or an object with drag."""
    return scene.ball is not None or any(o.drag is not None for o in scene.objects)


def build_game(
    scene: Scene, model: mujoco.MjModel, num_worlds: int, wrench: np.ndarray | None = None
) -> Game:
    """The arrays of N worlds for a scene that ``has_game``, in double precision. What is shown
    (``phases``, ``hit_time``, ``hit_pos``) is single in every scene: so the law is compiled once.

    ``model``: the scene's model of ``mjcf``, for masses. ``wrench``: MuJoCo's ``xfrc_applied``
    (N, bodies, 6), whose bodies are then meant; None for an engine without it: one row for each
    tool, then one for each object with drag. Raises ValueError for a surface on an unknown link.
    """
    ball, n = scene.ball, num_worlds
    law = ball_of(ball.law) if ball is not None and ball.law is not None else _NO_BALL
    links = list(dict.fromkeys(s.link for s in scene.surfaces if s.link is not None))
    for link in links:
        agent, _, name = link.partition("/")
        known = agent in [f"agent{a}" for a in range(scene.num_agents)]
        if not known or name not in scene.body.link_names:
            raise ValueError(f"scene '{scene.name}': a surface is on '{link}', which is no link")
    dragged = [o for o in scene.objects if o.drag is not None]
    bodies = [*links, *(o.name for o in dragged)]
    if wrench is None:
        wrench, numbers = np.zeros((n, len(bodies), 6)), list(range(len(bodies)))
    else:
        numbers = [model.body(name).id for name in bodies]
    agents = [int(link.partition("/")[0].removeprefix("agent")) for link in links]
    tools, surfaces = len(links), len(scene.surfaces)
    chains, offsets = _chains(scene, links, agents)
    places = [] if ball is None else [_place(scene, ball.name)]
    rows = np.array([_numbers(s, law) for s in scene.surfaces]).reshape(-1, SURFACE_NUMBERS)
    for k, surface in enumerate(scene.surfaces):
        rows[k, TOOL] = links.index(surface.link) if surface.link else -1
    found = [(number, *_place(scene, o.name)) for number, o in zip(numbers[tools:], dragged)]
    return Game(
        ball=law.numbers(),
        surfaces=rows,
        tools=np.array([_tool(model, link) for link in links]).reshape(-1, TOOL_NUMBERS),
        phases=np.zeros((n, 2), np.float32),
        before=np.zeros((n, tools, 7)),
        after=np.zeros((n, tools, 7)),
        pending=np.zeros((n, tools, 6)),
        state=np.zeros((n, STATE_NUMBERS)),
        clock=np.zeros(n),
        hits=np.zeros((n, surfaces), np.int32),
        hit_time=np.full((n, surfaces), np.inf, np.float32),
        hit_pos=np.zeros((n, surfaces, 3), np.float32),
        places=_integers(places, 2),
        chains=chains,
        offsets=offsets,
        bodies=_integers(list(zip(numbers, agents)), 2),
        dragged=_integers(found, 3),
        drags=np.array([top(model, o) for o in dragged]).reshape(-1, 4),
        tops=np.zeros((n, len(dragged), 11)),
        wrench=wrench,
        applied=np.zeros((n, scene.num_agents, 6)),
    )


def _integers(rows: list[tuple[int, ...]], width: int) -> np.ndarray:
    return np.array(rows, np.int32).reshape(-1, width)


def _place(scene: Scene, name: str) -> tuple[int, int]:
    """Where an object's numbers begin in qpos and qvel."""
    return scene.object_qpos(name).start, scene.object_qvel(name).start


def _axes(quat: np.ndarray) -> np.ndarray:
    """(3, 3) rotation matrix of a unit quaternion."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _numbers(surface: Surface, law: BallLaw) -> np.ndarray:
    """(SURFACE_NUMBERS,) of a surface."""
    own, tool = np.zeros(SURFACE_NUMBERS), surface.link is not None
    axes = _axes(np.array(surface.quat) / np.linalg.norm(surface.quat))
    own[KIND], own[BALL_RADIUS] = _KINDS[surface.kind], law.radius
    own[CENTER : CENTER + 3] = surface.center
    own[AXES : AXES + 9] = axes.T.ravel()
    own[SIZE : SIZE + len(surface.size)] = surface.size
    usual = law.tool_restitution if tool else law.ground_restitution
    own[RESTITUTION] = usual if surface.restitution is None else surface.restitution
    own[FRICTION] = law.friction if surface.friction is None else surface.friction
    own[ROLLING] = law.rolling_waves if surface.kind == "waves" else law.rolling
    reach = np.linalg.norm(surface.size) if surface.kind in ("box", "disc") else math.inf
    own[REACH] = np.linalg.norm(surface.center) + reach
    if surface.kind == "waves":
        amplitude, k, inner, outer = surface.size
        # Second derivatives of the waves, of the smoothstep (at most 6 / width^2, and its slope,
        # 1.5 / width, by the distance) and of both (slopes 1 and 1.5 / width).
        width = outer - inner
        steep = 6.0 / width**2 + 1.5 / (width * inner)
        own[BEND] = amplitude * (k**2 + 2.0 * steep + 2.0 * math.sqrt(2.0) * k * 1.5 / width)
    return own


def _tool(model: mujoco.MjModel, link: str) -> np.ndarray:
    """(TOOL_NUMBERS,) of a link."""
    body = model.body(link).id
    turn = _axes(model.body_iquat[body])
    inverse = turn @ np.diag(1.0 / model.body_inertia[body]) @ turn.T
    own = np.zeros(TOOL_NUMBERS)
    own[TOOL_MASS] = model.body_mass[body]
    own[TOOL_CENTER : TOOL_CENTER + 3] = model.body_ipos[body]
    own[TOOL_COMPLIANCE : TOOL_COMPLIANCE + 3] = np.diag(inverse)
    own[TOOL_COMPLIANCE + 3 :] = inverse[0, 1], inverse[0, 2], inverse[1, 2]
    return own


def top(model: mujoco.MjModel, dragged: SceneObject) -> tuple[float, ...]:
    """A row of ``Game.drags``. Raises ValueError for an object that is not symmetric about its x
    axis."""
    assert dragged.drag is not None
    body = model.body(dragged.name).id
    turn = _axes(model.body_iquat[body])
    inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
    axial, across = inertia[0, 0], inertia[1, 1]
    if not np.allclose(inertia, np.diag([axial, across, across]), atol=1e-6 * across) or any(
        abs(model.body_ipos[body]) > 1e-9
    ):
        raise ValueError(
            f"'{dragged.name}' has drag and must be a body of revolution about its x axis, with "
            "its centre of mass at the origin"
        )
    return (*dragged.drag, float(model.body_mass[body]), axial / across)


def _chains(scene: Scene, links: list[str], agents: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """(T, L) and (T, L, 3) as ``Game.chains`` and ``Game.offsets``."""
    ways = [_way(scene.body, link.partition("/")[2]) for link in links]
    longest = max(map(len, ways), default=1)
    chains = np.full((len(links), longest), -1, np.int32)
    offsets = np.zeros((len(links), longest, 3))
    for t, (way, agent) in enumerate(zip(ways, agents)):
        start = scene.agent_qpos(agent).start
        for j, i in enumerate(way):
            chains[t, j] = start if j == 0 else start + 4 + 3 * i
            offsets[t, j] = scene.body.links[i].offset
    return chains, offsets


def _way(body: Body, link: str) -> list[int]:
    """The links from the root to a link."""
    parents, way = body.parents(), [body.link_index(link)]
    while parents[way[0]] >= 0:
        way.insert(0, int(parents[way[0]]))
    return way
