"""What a motion achieved, measured on its geometry: no optimiser and no engine is asked.

The same functions measure a planned motion, its replays and tracked clips, from frames alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from sports import high_jump, hurdling, long_jump
from sports.humanoid.body import Body
from sports.humanoid.mjcf import build_model
from sports.physics.base import Geometry
from sports.scene import Scene
from warmstart import rotation

TOUCH = 0.005
"""A support point this close to the ground (m) touches it; one that carries load has sunk in."""
KEPT = 0.9
"""A hurdle is cleared at speed if this share of the run's is left at the landing."""
FLIGHT = 0.005
"""Without a support point below this height (m) the athlete flies."""


@dataclass(frozen=True)
class Outcome:
    """How one problem's outcome is measured and ruled."""

    field: str
    """Key in ``Solution.asked`` and name of the outcome (m)."""
    measure: Callable[[Body, np.ndarray, np.ndarray], float]
    """(body, times (T,), qpos (T, 7 + n)) -> outcome (m); NaN without a legal attempt."""
    rules: Callable[[Body, np.ndarray, np.ndarray, dict[str, float]], dict[str, float]]
    """(body, times, qpos, asked) -> figures of the problem's own checks."""
    judge: Callable[[Body, np.ndarray, np.ndarray, dict[str, float]], dict[str, float]] | None = (
        None
    )
    """The same -> ``success`` and other metrics of a tracked motion whose task decides something
    else (one hurdle is no race); None where the task's own rules decide."""
    after: int = 12
    """Control steps beyond the motion in which it is decided, at most."""


def link_poses(body: Body, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, B, 3) positions and (T, B, 4) attitudes of the links, by forward kinematics."""
    joints = rotation.from_hinges(qpos[:, 7:].reshape(len(qpos), -1, 3))
    pos = np.zeros((len(qpos), body.num_links, 3))
    quat = np.zeros((len(qpos), body.num_links, 4))
    hinged = 0
    for i, parent in enumerate(body.parents()):
        if parent < 0:
            pos[:, i], quat[:, i] = qpos[:, :3], qpos[:, 3:7]
            continue
        offset = np.broadcast_to(np.array(body.links[i].offset), (len(qpos), 3))
        pos[:, i] = pos[:, parent] + rotation.rotate(quat[:, parent], offset)
        quat[:, i] = rotation.multiply(quat[:, parent], joints[:, hinged])
        hinged += 1
    return pos, quat


def support(body: Body, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, K, 3) support points of all links in the world and their radii (K,), m."""
    pos, quat = (torch.from_numpy(x) for x in link_poses(body, qpos))
    geometry = Geometry(body, "cpu")
    geometry.points = geometry.points.double()
    return geometry.world_points(pos, quat).numpy(), geometry.radii.double().numpy()


def lowest(body: Body, qpos: np.ndarray) -> np.ndarray:
    """(T,) height of the lowest point of the athlete (m)."""
    points, radii = support(body, qpos)
    return (points[..., 2] - radii).min(1)


class _Obstacle:
    """Distance between the athlete and a bar or hurdle of any height, by MuJoCo's collisions.

    The obstacle stays where its scene has it; the athlete is moved up or down instead.
    """

    def __init__(self, scene: Scene, name: str, top: float) -> None:
        self.model = build_model(scene)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = scene.default_qpos()
        self.agent, self.top = scene.agent_qpos(0), top
        root = self.model.body(f"agent0/{scene.body.links[0].name}").id
        mine = self.model.body_rootid[self.model.geom_bodyid] == root
        self.geoms = np.flatnonzero(mine)
        self.geom = int(self.model.body(name).geomadr[0])

    def gap(self, qpos: np.ndarray, height: float, enough: float = 1.0) -> float:
        """Smallest signed distance (m) of any frame to an obstacle whose top is at ``height``; at
        most ``enough``."""
        best = enough
        for row in qpos:
            self.data.qpos[self.agent] = row
            self.data.qpos[self.agent.start + 2] += self.top - height
            mujoco.mj_kinematics(self.model, self.data)
            for geom in self.geoms:
                found = mujoco.mj_geomDistance(
                    self.model, self.data, int(geom), self.geom, best, None
                )
                best = min(best, found)
        return best

    def cleared(self, qpos: np.ndarray) -> float:
        """Top (m, to 2 mm) of the highest one that no frame touches; NaN below 0.1 m."""
        low, high = 0.1, None
        for height in np.arange(low, 3.2, 0.15):
            if self.gap(qpos, float(height), 0.05) < 0.0:
                high = float(height)
                break
            low = float(height)
        if high is None or high <= 0.1:
            return float("nan")
        while high - low > 0.002:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self.gap(qpos, middle, 0.05) < 0.0 else (middle, high)
        return low


def _bar(body: Body) -> _Obstacle:
    return _Obstacle(high_jump.scene(high_jump.HighJump(bar_height=1.0), body), "bar", 1.0)


def _hurdle(body: Body) -> _Obstacle:
    config = hurdling.Hurdling(height=hurdling.RACE_HEIGHT)
    return _Obstacle(hurdling.scene(config, body), "hurdle0", hurdling.RACE_HEIGHT)


def cleared_height(body: Body, times: np.ndarray, qpos: np.ndarray) -> float:
    """Top (m, to 2 mm) of the highest bar over x = 20 that the motion clears without touching.

    NaN when the athlete does not cross the bar's plane between the uprights.
    """
    x = qpos[:, 0]
    crossing = np.flatnonzero((x[:-1] < high_jump.BAR_X) & (x[1:] >= high_jump.BAR_X))
    if not crossing.size or abs(qpos[crossing[0], 1] - high_jump.BAR_Y) > high_jump.HALF_GAP:
        return float("nan")
    return _bar(body).cleared(qpos[np.abs(x - high_jump.BAR_X) < 1.5])


def _bar_rules(
    body: Body, times: np.ndarray, qpos: np.ndarray, asked: dict[str, float]
) -> dict[str, float]:
    """Smallest distance to the bar that was asked for; the root must pass over it."""
    height = asked["bar_height"]
    x, z = qpos[:, 0], qpos[:, 2]
    over = np.abs(x - high_jump.BAR_X) < 0.05
    if x[0] > high_jump.BAR_X or x[-1] < high_jump.BAR_X or not over.any():
        return {}
    if z[over].min() < height:
        return {}
    return {"clearance over the bar": _bar(body).gap(qpos, height, 0.5)}


def _flight(body: Body, times: np.ndarray, qpos: np.ndarray) -> tuple[int, int] | None:
    """First frame of the longest flight and first frame after it; None without one."""
    flying = lowest(body, qpos) > FLIGHT
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flying, [False]]).astype(int)))
    runs = [(a, b) for a, b in edges.reshape(-1, 2) if times[min(b, len(times) - 1)] > times[a]]
    return max(runs, key=lambda r: times[min(r[1], len(times) - 1)] - times[r[0]], default=None)


def flight_events(body: Body, times: np.ndarray, qpos: np.ndarray) -> dict[str, float]:
    """``takeoff``: the last frame on the ground before the longest flight, and ``landing``: the
    first one after it (s); empty without a flight, no landing when it ends in the air."""
    flight = _flight(body, times, qpos)
    if flight is None:
        return {}
    events = {"takeoff": float(times[max(flight[0] - 1, 0)])}
    if flight[1] < len(times):
        events["landing"] = float(times[flight[1]])
    return events


def jump_length(body: Body, times: np.ndarray, qpos: np.ndarray) -> float:
    """Smallest x (m) of a ground contact within 0.3 s of the landing, minus the line at 20.

    NaN without a flight, without a landing, or after a foul.
    """
    flight = _flight(body, times, qpos)
    if flight is None or flight[1] >= len(qpos):
        return float("nan")
    points, radii = support(body, qpos)
    touch = points[..., 2] - radii < TOUCH
    x = points[..., 0]
    if np.where(touch[: flight[0]], x[: flight[0]], -np.inf).max() >= long_jump.LINE_X:
        return float("nan")
    end = times[flight[1]] + long_jump.MARK_STEPS / 30.0
    rows = (np.arange(len(times)) >= flight[1]) & (times <= end + 1e-9)
    return float(np.where(touch[rows], x[rows], np.inf).min()) - long_jump.LINE_X


def _line_rules(
    body: Body, times: np.ndarray, qpos: np.ndarray, asked: dict[str, float]
) -> dict[str, float]:
    """How far behind the line the foremost contact before the flight is."""
    flight = _flight(body, times, qpos)
    if flight is None or flight[0] == 0:
        return {}
    points, radii = support(body, qpos[: flight[0]])
    touch = points[..., 2] - radii < TOUCH
    front = np.where(touch, points[..., 0], -np.inf).max()
    return {"foremost contact behind the line": long_jump.LINE_X - float(front)}


def _stride(body: Body, times: np.ndarray, qpos: np.ndarray) -> tuple[int, int] | None:
    """First frame of the flight over the first hurdle and first frame after it.

    None where the root does not cross the hurdle in flight, or where anything but one foot leaves
    the ground last, or anything but the other foot lands first.
    """
    flight = _flight(body, times, qpos)
    if flight is None or flight[0] == 0 or flight[1] >= len(qpos):
        return None
    off, down = flight
    if not qpos[off, 0] < hurdling.FIRST_X < qpos[down, 0]:
        return None
    feet = [_feet(body, qpos[off - 1]), _feet(body, qpos[down])]
    return (off, down) if feet in (["L", "R"], ["R", "L"]) else None


def _feet(body: Body, row: np.ndarray) -> str | None:
    """Side of the foot on which a frame (7 + n,) stands, ``LR`` for both; None where something else
    touches the ground or nothing does."""
    points, radii = support(body, row[None])
    owner = Geometry(body, "cpu").owner.tolist()
    low = np.flatnonzero(points[0, :, 2] - radii < TOUCH + 1e-6)
    touching = {body.links[owner[i]].name for i in low}
    if not touching or not all(name.endswith(("Ankle", "Toe")) for name in touching):
        return None
    return "".join(sorted({name[0] for name in touching}))


def _next_step(
    body: Body, times: np.ndarray, qpos: np.ndarray, down: int
) -> tuple[int, int] | None:
    """First frame of the flight after the landing beyond the hurdle, in frame ``down``, and first
    frame after it.

    None where the next flight is not one from the lead foot alone to the other one, or where
    anything else touches the ground before it.
    """
    flight = _flight(body, times[down:], qpos[down:])
    if flight is None or flight[0] == 0 or down + flight[1] >= len(qpos):
        return None
    off, end = down + flight[0], down + flight[1]
    lead = _feet(body, qpos[down])
    if any(_feet(body, row) != lead for row in qpos[down:off]):
        return None
    return (off, end) if {lead, _feet(body, qpos[end])} == {"L", "R"} else None


def cleared_hurdle(body: Body, times: np.ndarray, qpos: np.ndarray) -> float:
    """Top (m, to 2 mm) of the highest first hurdle that one flight clears without touching.

    NaN where the root does not cross the hurdle in one flight from one foot to the other. What
    happens after the landing is not the clearance (of a cycle it is a check of its own).
    """
    stride = _stride(body, times, qpos)
    if stride is None:
        return float("nan")
    return _hurdle(body).cleared(qpos[: stride[1] + 1])


def _hurdle_rules(
    body: Body, times: np.ndarray, qpos: np.ndarray, asked: dict[str, float]
) -> dict[str, float]:
    """Distance to the hurdle that was asked for, where the lead foot lands, and the speed of
    the centre of mass before the landing as a share of the run's."""
    stride = _stride(body, times, qpos)
    if stride is None:
        return {}
    _, down = stride
    points, radii = support(body, qpos[down : down + 1])
    touch = points[0, :, 2] - radii < TOUCH + 1e-6
    whole = qpos[: down + 1]
    found = {
        "clearance over the hurdle": _hurdle(body).gap(whole, asked["hurdle_height"], 0.5),
        "landing beyond the hurdle": float(points[0, touch, 0].min()) - hurdling.FIRST_X,
        "speed at the landing": _speed(body, times, qpos, down) / asked["run_speed"],
    }
    return found | (_step_rules(body, times, qpos, asked) if is_cycle(asked) else {})


def is_cycle(asked: Mapping[str, float]) -> bool:
    """Whether more than the stride over the hurdle is asked for: the next step as well."""
    return bool(asked.get("stride_cycle"))


def _step_rules(
    body: Body, times: np.ndarray, qpos: np.ndarray, asked: dict[str, float]
) -> dict[str, float]:
    """Of the step after the hurdle: distance to the hurdle from the landing on, how long the lead
    foot stands, how far its toes are from where the other foot's land, the speed before that as a
    share of the run's."""
    stride = _stride(body, times, qpos)
    step = None if stride is None else _next_step(body, times, qpos, stride[1])
    if stride is None or step is None:
        return {}
    (_, down), (off, end) = stride, step
    pos, _ = link_poses(body, qpos[[off - 1, end]])
    toes = [body.link_index(f"{_feet(body, qpos[k])}_Toe") for k in (off - 1, end)]
    after = qpos[down : end + 1]
    return {
        "clearance after the landing": _hurdle(body).gap(after, asked["hurdle_height"], 0.5),
        "stance of the lead leg": float(times[off] - times[down]),
        "length of the next step": float(pos[1, toes[1], 0] - pos[0, toes[0], 0]),
        "speed after the next step": _speed(body, times, qpos, end) / asked["run_speed"],
    }


def _hurdle_judge(
    body: Body, times: np.ndarray, qpos: np.ndarray, asked: dict[str, float]
) -> dict[str, float]:
    """Success: the asked hurdle is not touched, the other foot lands first at ``KEPT`` of the
    asked speed, and nothing but feet has touched the ground when the motion ends. Of a cycle also:
    the next step is one from foot to foot, ends at that speed and does not touch the hurdle."""
    found = _hurdle_rules(body, times, qpos, asked)
    if not found:
        return {"success": 0.0}
    gap, kept = found["clearance over the hurdle"], found["speed at the landing"]
    step = {}
    if "speed after the next step" in found:
        step["next_step"] = found["length of the next step"]
        step["next_speed"] = found["speed after the next step"] * asked["run_speed"]
        gap = min(gap, found["clearance after the landing"])
    on = step.get("next_speed", 0.0) >= KEPT * asked["run_speed"] or not is_cycle(asked)
    _, down = _flight(body, times, qpos) or (0, 0)
    points, radii = support(body, qpos[down:])
    owner = np.array([link.name[2:] in ("Ankle", "Toe") for link in body.links])
    others = ~owner[Geometry(body, "cpu").owner.numpy()]
    fell = bool((points[:, others, 2] - radii[others] < TOUCH).any()) or len(points) <= 1
    return {
        "success": float(gap >= 0.0 and kept >= KEPT and on and not fell),
        "clearance": gap,
        "hurdle_height": asked["hurdle_height"],
        "landing_speed": kept * asked["run_speed"],
        **step,
    }


def _speed(body: Body, times: np.ndarray, qpos: np.ndarray, at: int) -> float:
    """Mean forward speed (m/s) of the centre of mass over the 0.1 s before a frame."""
    first = int(np.searchsorted(times, times[at] - 0.1))
    pos, quat = link_poses(body, qpos[[first, at]])
    x = np.zeros(2)
    for i, link in enumerate(body.links):
        for shape in link.shapes:
            middle = np.array([shape.center, shape.end or shape.center]).mean(0)
            places = pos[:, i] + rotation.rotate(quat[:, i], np.tile(middle, (2, 1)))
            x += shape.mass / body.mass * places[:, 0]
    return float((x[1] - x[0]) / (times[at] - times[first]))


OUTCOMES: dict[str, Outcome] = {
    "high_jump": Outcome("bar_height", cleared_height, _bar_rules),
    "long_jump": Outcome("length", jump_length, _line_rules),
    "hurdling": Outcome("hurdle_height", cleared_hurdle, _hurdle_rules, _hurdle_judge, after=4),
}
