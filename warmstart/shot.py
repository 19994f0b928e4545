"""A ball's way in a racket sport, by the project's ball law: machine, bounce, racket, target.

:func:`incoming` follows a machine's ball to the place where the athlete meets it;
:func:`stroke_to` finds the racket's face and velocity there that send it to a target. World frame
of the sport (net at x = 0, the athlete at x > 0 facing -x); positions are of the ball's centre; m,
s, rad. Source of the law: ``sports/ball_law``; nothing of it is written again here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares

from sports.ball import ball_of, launch
from sports.ball_law import flight
from sports.ball_law.play import tool_matrix
from sports.physics.game import build_game
from sports.rackets import Game
from sports.scene import Scene
from warmstart import rotation
from warmstart.replay import replay_states
from warmstart.solution import Solution
from warmstart.strike import Moment

STEP = 1 / 400
"""Step of a flight (s); the law's Runge-Kutta of order 4."""
LONGEST = 4.0
"""No flight here lasts longer (s)."""
LOST = 99.0
"""Said of a ball that does not get to the court (m)."""


@dataclass(frozen=True)
class Ball:
    """State of a ball at a time."""

    time: float
    """s since the launch, or since the stroke."""
    pos: np.ndarray
    linvel: np.ndarray
    angvel: np.ndarray


@dataclass(frozen=True)
class Stroke:
    """What a racket does at the impact, and what becomes of the ball."""

    normal: np.ndarray
    """(3,) unit, from the face towards the ball."""
    velocity: np.ndarray
    """(3,) of the face at the contact (m/s)."""
    struck: Ball
    """Right after the impact."""
    landed: Ball
    """When its centre comes down to the surface."""
    over_net: float
    """Between the top of the net and the lowest point of the ball (m)."""


def flown(law: str, ball: Ball, seconds: float) -> Ball:
    """The ball after a time in the air."""
    numbers, spin = ball_of(law).numbers(), tuple(ball.angvel)
    p, v = tuple(ball.pos), tuple(ball.linvel)
    steps = max(1, math.ceil(seconds / STEP))
    for _ in range(steps):
        p, v = flight.fly(p, v, spin, seconds / steps, numbers)
    return Ball(ball.time + seconds, np.array(p), np.array(v), ball.angvel)


def until(law: str, ball: Ball, axis: int, value: float, sense: float) -> Ball | None:
    """The ball when a coordinate first passes a value, rising (``sense`` 1) or falling (-1), in its
    flight; None if it never does."""
    numbers, spin = ball_of(law).numbers(), tuple(ball.angvel)
    p, v = tuple(ball.pos), tuple(ball.linvel)
    for k in range(round(LONGEST / STEP)):
        q, u = flight.fly(p, v, spin, STEP, numbers)
        if sense * p[axis] < sense * value <= sense * q[axis]:
            begun = Ball(ball.time + k * STEP, np.array(p), np.array(v), ball.angvel)
            return _refined(law, begun, axis, value)
        p, v = q, u
    return None


def _refined(law: str, ball: Ball, axis: int, value: float) -> Ball:
    """The passage within the next step, by Newton's method."""
    h = 0.0
    for _ in range(20):
        at = flown(law, ball, h) if h > 0.0 else ball
        move = (value - at.pos[axis]) / at.linvel[axis]
        h = min(max(h + move, 0.0), STEP)
        if abs(move) < 1e-12:
            break
    return flown(law, ball, h) if h > 0.0 else ball


def bounced(law: str, ball: Ball) -> Ball:
    """The ball after an impact on a horizontal surface."""
    kind = ball_of(law)
    v, spin = flight.bounce(
        tuple(ball.linvel),
        tuple(ball.angvel),
        (0.0, 0.0, 1.0),
        kind.ground_restitution,
        kind.friction,
        kind.numbers(),
    )
    return Ball(ball.time, ball.pos, np.array(v), np.array(spin))


def incoming(
    game: Game, start: np.ndarray, speed: float, bounce: tuple[float, float], x: float
) -> tuple[Ball, Ball]:
    """A machine's ball at its launch and when it comes to the plane at ``x`` after one bounce.

    ``start`` (3,), forward ``speed`` (m/s), x and y of the ``bounce`` (m). Raises ValueError where
    such a ball does not come there, or bounces twice.
    """
    court, radius = game.court, game.radius
    over = court.net_height + court.net_rise + game.serve.clear + radius
    spot = torch.tensor([[*bounce, court.height + radius]], dtype=torch.float32)
    origin = torch.tensor(np.asarray(start)[None], dtype=torch.float32)
    velocity = launch(
        game.law, origin, torch.tensor([speed]), spot, net=(0.0, over), apex=game.serve.apex
    )
    still = np.zeros(3)
    launched = Ball(0.0, np.array(start, float), velocity[0].double().numpy(), still)
    down = until(game.law, launched, 2, court.height + radius, -1.0)
    if down is None or not down.pos[0] < x:
        raise ValueError(f"the machine's ball of {speed:g} m/s does not bounce before x = {x:g} m")
    up = bounced(game.law, down)
    there = until(game.law, up, 0, x, 1.0)
    again = until(game.law, up, 2, court.height + radius, -1.0)
    if there is None or (again is not None and again.time < there.time):
        raise ValueError(
            f"the machine's ball of {speed:g} m/s bounces twice before it comes to x = {x:g} m"
        )
    return launched, there


def state_at(law: str, game: Game, launched: Ball, time: float) -> Ball:
    """The machine's ball some time after its launch, before or after its first bounce."""
    down = until(law, launched, 2, game.court.height + game.radius, -1.0)
    if down is None or time <= down.time:
        return flown(law, launched, time) if time > 0.0 else launched
    return flown(law, bounced(law, down), time - down.time)


def tool_numbers(scene: Scene) -> np.ndarray:
    """(TOOL_NUMBERS,) of the racket or club of a scene, as the law reads them."""
    from sports.humanoid.mjcf import build_model

    return build_game(scene, build_model(scene), 1).tools[0]


def impact(
    law: str,
    ball: Ball,
    face_velocity: np.ndarray,
    normal: np.ndarray,
    tool: np.ndarray,
    rotation: np.ndarray,
    contact: np.ndarray,
) -> Ball:
    """The ball after a racket or club has met it.

    ``law`` names the kind of ball; ``face_velocity`` (3,) of the face at the contact, ``normal``
    (3,) unit towards the ball; ``tool``: :func:`tool_numbers`, ``rotation`` (3, 3) R_world_tool,
    ``contact`` (3,) in the tool's frame (m).
    """
    kind = ball_of(law)
    numbers, n = kind.numbers(), rotation.T @ normal
    slip = ball.linvel - kind.radius * np.cross(ball.angvel, normal) - face_velocity
    diagonal, mixed = flight.ball_matrix(tuple(n), numbers)
    more, mingled = tool_matrix(tool[None], 0, tuple(contact))
    push = rotation @ np.array(
        flight.impulse(
            tuple(rotation.T @ slip),
            tuple(n),
            flight.add(diagonal, more),
            flight.add(mixed, mingled),
            kind.tool_restitution,
            kind.friction,
        )
    )
    v, spin = flight.struck(
        tuple(ball.linvel), tuple(ball.angvel), tuple(normal), tuple(push), numbers
    )
    return Ball(0.0, ball.pos, np.array(v), np.array(spin))


def ball_after(game: Game, struck: Ball) -> tuple[Ball, float] | None:
    """Where a struck ball lands, and by how much it clears the net (m); None if it does not come
    down or does not come to the net."""
    landed = until(game.law, struck, 2, game.court.height + game.radius, -1.0)
    over = until(game.law, struck, 0, 0.0, -1.0)
    if landed is None or over is None:
        return None
    top = game.court.net_height + game.court.net_rise / game.court.net_half_width * abs(over.pos[1])
    return landed, float(over.pos[2] - game.radius - top)


def stroke_to(
    game: Game,
    ball: Ball,
    target: tuple[float, float],
    speed: float,
    brush: float,
    tool: np.ndarray,
    face: tuple[float, float, float],
    contact: np.ndarray,
) -> Stroke:
    """The stroke after which the ball has a ``speed`` (m/s) and lands at ``target`` (x, y).

    The face moves upward across its normal by ``brush`` (rad), which gives topspin. ``face`` is the
    direction of the tool's frame that becomes the normal, ``contact`` (3,) the place of the contact
    there; the tool's -y axis is taken to be level. Raises ValueError where no stroke does it, or
    only one into the net.
    """
    toward = np.array([*target, 0.0]) - ball.pos
    yaw = math.atan2(toward[1], toward[0])

    def attitude(n: np.ndarray) -> np.ndarray:
        """R_world_tool with the face along n and the handle level."""
        handle = np.cross(n, [0.0, 0.0, 1.0])
        handle /= np.linalg.norm(handle)
        own = np.array(face)
        columns = np.stack([own, [0.0, -1.0, 0.0], np.cross(own, [0.0, -1.0, 0.0])], 1)
        world = np.stack([n, handle, np.cross(n, handle)], 1)
        return world @ columns.T

    def strike(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, Ball]:
        elevation, aside, pace = x
        n = _direction(elevation, yaw + aside)
        velocity = pace * _direction(elevation + brush, yaw + aside)
        return n, velocity, impact(game.law, ball, velocity, n, tool, attitude(n), contact)

    def miss(x: np.ndarray) -> np.ndarray:
        struck = strike(x)[2]
        found = ball_after(game, struck)
        if found is None:
            return np.array([10.0, 10.0, 10.0])
        spot = found[0].pos[:2] - np.array(target)
        return np.array([*spot, np.linalg.norm(struck.linvel) - speed])

    best = None
    for elevation in (0.0, 0.15, 0.3):
        found = least_squares(
            miss,
            [elevation, 0.0, 0.6 * speed],
            diff_step=1e-5,
            xtol=1e-12,
            ftol=1e-14,
            max_nfev=20,
        )
        if np.abs(found.fun).max() < 1e-3 and (best is None or found.x[0] < best[0]):
            best = found.x
    if best is None:
        raise ValueError(
            f"no stroke sends the ball to ({target[0]:g}, {target[1]:g}) at {speed:g} m/s; "
            "ask for another speed or target"
        )
    n, velocity, struck = strike(best)
    after = ball_after(game, struck)
    assert after is not None  # it lands at the target
    landed, over = after
    if over < 0.0:
        raise ValueError(
            f"a ball of {speed:g} m/s to ({target[0]:g}, {target[1]:g}) goes into the net "
            f"({-over:.2f} m too low); ask for less speed or more brush"
        )
    return Stroke(n, velocity, struck, landed, over)


def _direction(elevation: float, yaw: float) -> np.ndarray:
    """Unit vector."""
    return np.array(
        [
            math.cos(elevation) * math.cos(yaw),
            math.cos(elevation) * math.sin(yaw),
            math.sin(elevation),
        ]
    )


# What becomes of the ball of a solved stroke.


def followed(game: Game, scene: Scene, solution: Solution, found: Moment) -> dict[str, float]:
    """The ball's speed after the impact (``outcome``, m/s), how far from the target it lands (m)
    and by how much it clears the net (m), by the ball law from the racket's motion. A ball that
    does not get to the court is ``LOST`` metres off."""
    event, told = solution.stats["event"], solution.stats["ball"]
    launched = _launched(told)
    met = state_at(game.law, game, launched, told["met"])
    struck = impact(
        game.law,
        met,
        found.velocity,
        found.normal,
        tool_numbers(scene),
        found.rotation,
        np.array(event["point"]),
    )
    return _judged(game, solution, struck)


def played(game: Game, scene: Scene, solution: Solution, engine: str) -> dict[str, float]:
    """The same of a replay with the machine's ball in the engine, blow and recoil included."""
    told = solution.stats["ball"]
    ball = state_at(game.law, game, _launched(told), told["met"] - solution.stats["event"]["time"])
    qpos = np.concatenate([ball.pos, [1.0, 0.0, 0.0, 0.0]])
    qvel = np.concatenate([ball.linvel, ball.angvel])
    _, where, rates = replay_states(solution, engine, 0.0, scene, (qpos, qvel))
    at, spin = 7 + solution.body.num_dofs, 6 + solution.body.num_dofs
    towards = np.sign(rates[:, spin])
    after = np.flatnonzero(towards == -towards[0])
    if not after.size:
        return {"ball: speed": 0.0, "ball: landing off target": LOST, "ball: over the net": -LOST}
    k = min(after[0] + 1, len(where) - 1)  # the step of the impact has ended
    struck = Ball(
        0.0, where[k, at : at + 3], rates[k, spin : spin + 3], _spin(where[k], rates[k], at, spin)
    )
    found = _judged(game, solution, struck)
    return {f"ball: {'speed' if n == 'outcome' else n}": value for n, value in found.items()}


def _spin(qpos: np.ndarray, qvel: np.ndarray, at: int, spin: int) -> np.ndarray:
    """(3,) angular velocity of the ball in the world; the engine has it in the ball's frame."""
    return rotation.rotate(qpos[at + 3 : at + 7], qvel[spin + 3 : spin + 6])


def _launched(told: dict) -> Ball:
    launch = told["launch"]
    return Ball(0.0, np.array(launch["pos"]), np.array(launch["linvel"]), np.zeros(3))


def _judged(game: Game, solution: Solution, struck: Ball) -> dict[str, float]:
    after = ball_after(game, struck)
    target = np.array(solution.stats["ball"]["target"])
    if after is None:
        off, over = LOST, -LOST
    else:
        off, over = float(np.linalg.norm(after[0].pos[:2] - target)), after[1]
    return {
        "outcome": float(np.linalg.norm(struck.linvel)),
        "landing off target": min(off, LOST),
        "over the net": max(over, -LOST),
    }
