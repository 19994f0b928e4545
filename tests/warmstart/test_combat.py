"""Punches and lunges against MuJoCo's kinematics and inverse dynamics, and hand-made replays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest

from sports import boxing as ring
from sports import combat
from sports import fencing as piste
from sports.env import make_scene
from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from warmstart import strike
from warmstart.bank import demonstration_files, load_demonstrations
from warmstart.certificate import certify, required
from warmstart.demonstration import name_of, strike_clip
from warmstart.inverse_dynamics import inverse_dynamics_drake, inverse_dynamics_mujoco
from warmstart.judged import RULES
from warmstart.problems import boxing, fencing, guard, jumper, striker
from warmstart.replay import Replayed, body_of
from warmstart.solution import Solution

DATA = Path(__file__).parent / "data"
G = 9.81
BOTH = ("jab", "cross", "lunge")


@pytest.fixture(scope="module")
def jab() -> Solution:
    return Solution.load(DATA / "boxing_jab_6_human.npz")


@pytest.fixture(scope="module")
def cross() -> Solution:
    return Solution.load(DATA / "boxing_cross_6_human.npz")


@pytest.fixture(scope="module")
def lunge() -> Solution:
    return Solution.load(DATA / "fencing_2.1_human.npz")


class Kinematics:
    """Points of links by MuJoCo, and how fast they move."""

    def __init__(self, solution: Solution) -> None:
        self.body = solution.body
        self.model = build_model(solution.body)
        self.data = mujoco.MjData(self.model)

    def put(self, qpos: np.ndarray, qvel: np.ndarray | None = None) -> None:
        self.data.qpos[:] = qpos
        self.data.qvel[:] = 0.0 if qvel is None else qvel
        mujoco.mj_forward(self.model, self.data)

    def turn(self, link: str) -> np.ndarray:
        return self.data.xmat[1 + self.body.link_index(link)].reshape(3, 3)

    def at(self, link: str, point: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
        return self.data.xpos[1 + self.body.link_index(link)] + self.turn(link) @ np.array(point)

    def velocity(self, link: str, point: tuple[float, float, float]) -> np.ndarray:
        jac = np.zeros((3, self.model.nv))
        i = 1 + self.body.link_index(link)
        mujoco.mj_jac(self.model, self.data, jac, None, self.at(link, point), i)
        return jac @ self.data.qvel


def finer(solution: Solution, first: float = 0.0, last: float | None = None) -> np.ndarray:
    """Times every 2 ms (s)."""
    return np.arange(first, (solution.duration if last is None else last) - 1e-9, 0.002)


# Where the target is.


@pytest.mark.parametrize(
    ("task", "module", "config", "link"),
    [
        ("boxing", ring, boxing.Config(punch="jab"), "Head"),
        ("boxing", ring, boxing.Config(punch="cross", target="chest"), "Chest"),
        ("fencing", piste, fencing.Config(), "Chest"),
        ("fencing", piste, fencing.Config(target="head", reach=2.0), "Head"),
    ],
)
def test_the_target_is_on_the_front_of_the_opponent_of_the_task(task, module, config, link):
    """In MuJoCo's model of the task at its start: the foremost point of the geom of that link."""
    scene = make_scene(task, strength="human")
    model = build_model(scene)
    data = mujoco.MjData(model)
    data.qpos[:] = scene.default_qpos()
    mujoco.mj_kinematics(model, data)
    geom = int(model.body(f"agent1/{link}").geomadr[0])
    depth = model.geom_size[geom, 0]
    front = data.geom_xpos[geom] - np.array([depth, 0.0, 0.0])
    problem: ModuleType = boxing if task == "boxing" else fencing
    event = problem.make_event(config, scene.body)
    ahead = guard.between_feet(scene.body, module.GUARD, module.GUARD_Z)
    if task == "boxing":
        start = combat.HALF_DISTANCE - config.distance
        surface = np.array(event.place) + boxing.GLOVE * np.array(event.normal)
    else:
        start = front[0] - config.reach
        surface = np.array(event.place)
    np.testing.assert_allclose(surface + np.array([start + ahead, 0.0, 0.0]), front, atol=1e-6)


def test_weapons_are_those_of_the_tasks():
    body = load_body("smpl", equipment=["gloves"])
    for side, weapon in zip("LR", ring.GLOVES, strict=True):
        (glove,) = body.links[body.link_index(f"{side}_Hand")].shapes
        assert weapon.link == f"{side}_Hand"
        assert glove.kind == "sphere" and glove.size[0] == boxing.GLOVE
        np.testing.assert_allclose(glove.center, 0.0, atol=1e-12)
    body = load_body("smpl", equipment=["sword"])
    point = body.links[body.link_index(fencing.LINK)].shapes[-1].end
    assert point is not None
    np.testing.assert_allclose(point, (0.0, -fencing.LENGTH, 0.0), atol=1e-12)


# Solutions, checked by other code.


@pytest.mark.parametrize("name", BOTH)
def test_the_motion_obeys_both_engines_at_every_knot(name, request):
    """No force on the root, torques as stored and allowed, with what the hands hold."""
    solution = request.getfixturevalue(name)
    weight = solution.body.mass * G
    names = ("qpos", "qvel", "qacc", "contact_force")
    motion = {field: getattr(solution, field) for field in names}
    for compute in (inverse_dynamics_mujoco, inverse_dynamics_drake):
        tau = compute(solution, motion, solution.body)
        assert np.abs(tau[:, :6]).max() / weight < 1e-5
        np.testing.assert_allclose(tau[:, 6:], solution.torque, atol=1e-4)
        bare = compute(solution, motion, load_body("smpl", strength="human"))
        assert np.abs(bare[:, :6]).max() / weight > 0.01  # it was not planned without them
    assert (np.abs(solution.torque) / solution.body.array("effort")).max() <= striker.SHARE + 1e-5


@pytest.mark.parametrize("name", BOTH)
def test_the_point_does_what_the_event_says(name, request):
    """By MuJoCo's kinematics at the knot of the event, from rest near the task's guard."""
    solution = request.getfixturevalue(name)
    event, see = solution.stats["event"], Kinematics(solution)
    k = int(np.argmin(np.abs(solution.times - event["time"])))
    see.put(solution.qpos[k], solution.qvel[k])
    link, point = event["link"], tuple(event["point"])
    np.testing.assert_allclose(see.at(link, point), event["place"], atol=1e-5)
    np.testing.assert_allclose(see.velocity(link, point), event["velocity"], atol=1e-4)
    np.testing.assert_allclose(see.turn(link) @ event["axis"], event["normal"], atol=1e-5)
    np.testing.assert_allclose(solution.qvel[0], 0.0, atol=1e-9)
    pose = (piste if name == "lunge" else ring).GUARD
    for dof, angle in zip(solution.body.dofs, solution.qpos[0, 7:], strict=True):
        assert abs(angle - pose.get(dof.name, 0.0)) <= 0.12 + 1e-6


@pytest.mark.parametrize(("name", "side"), [("jab", "L"), ("cross", "R")])
def test_a_punch_is_straight_and_the_other_hand_stays_up(name, side, request):
    """Between the knots, by MuJoCo: the fist within 7 cm of the line from where it starts on guard
    to the target, never far behind its start, the elbow under it; feet where they were."""
    solution = request.getfixturevalue(name)
    event, see = solution.stats["event"], Kinematics(solution)
    other = "R" if side == "L" else "L"
    see.put(guard.figure(solution.body, ring.GUARD, ring.GUARD_Z)[0])
    feet = [see.at(f"{s}_Ankle")[0] for s in "LR"]
    start = see.at(f"{side}_Hand") + [solution.stats["placed"][0] - np.mean(feet), 0.0, 0.0]
    way = np.array(event["place"]) - start
    along = way / np.linalg.norm(way)
    toes = []
    for qpos in solution.sample(finer(solution))["qpos"]:
        see.put(qpos)
        toes.append([see.at(f"{s}_Toe") for s in "LR"])
        assert see.at(f"{other}_Hand")[2] > 1.18  # over the chest
    assert np.ptp(np.array(toes), axis=0).max() < 2e-3
    for qpos in solution.sample(finer(solution, last=event["time"]))["qpos"]:
        see.put(qpos)
        off = see.at(f"{side}_Hand") - start
        assert np.linalg.norm(off - along * (off @ along)) < 0.07
        assert -0.06 < off @ along < np.linalg.norm(way) + 1e-3
        assert see.at(f"{side}_Elbow")[2] < see.at(f"{side}_Hand")[2]
    see.put(solution.qpos[-1])  # on its way back
    assert (see.at(f"{side}_Hand") - start) @ along < 0.75 * np.linalg.norm(way)


def test_a_lunge_steps_with_the_front_foot_alone(lunge):
    """Its sole is in the air and carries nothing while it flies, lands ahead and stays; the rear
    foot never moves; the tip is ``reach`` ahead of where the root was."""
    see = Kinematics(lunge)
    phase = {name: (lunge.times[a], lunge.times[b]) for name, a, b, _ in lunge.phases}
    assert lunge.stats["event"]["time"] == pytest.approx(phase["swing"][1])
    off, down = phase["swing"][0], phase["follow"][0]
    front = [i for i, (link, _) in enumerate(lunge.contact_points) if link.startswith("R_")]
    motion = lunge.sample(finer(lunge))
    where: dict[str, list[np.ndarray]] = {"L": [], "R": []}
    soles = []
    for qpos in motion["qpos"]:
        see.put(qpos)
        for side, rows in where.items():
            rows.append(see.at(f"{side}_Toe"))
        soles.append(min(see.at(*lunge.contact_points[i])[2] for i in front))
    t, left, right = finer(lunge), np.array(where["L"]), np.array(where["R"])
    flight = (t > off + 1e-6) & (t < down - 1e-6)
    assert np.abs(motion["contact_force"][flight][:, front]).max() < 1e-6
    assert max(np.array(soles)[flight]) > 0.02
    assert min(np.array(soles)[flight]) > -1e-3
    assert np.ptp(left, axis=0).max() < 2e-3
    assert np.ptp(right[t <= off], axis=0).max() < 2e-3
    assert np.ptp(right[t >= down], axis=0).max() < 2e-3
    assert right[-1, 0] - right[0, 0] > 0.3
    see.put(lunge.sample(np.array([lunge.stats["event"]["time"]]))["qpos"][0])
    tip = see.at(fencing.LINK, (0.0, -fencing.LENGTH, 0.0))
    apart = np.linalg.norm(tip[:2] - lunge.qpos[0, :2])
    assert apart == pytest.approx(lunge.asked["reach"], abs=2e-3)


@pytest.mark.parametrize("name", BOTH)
def test_it_is_certified_and_says_what_it_achieved(name, request):
    solution = request.getfixturevalue(name)
    certificate = certify(solution)
    assert certificate.passed, certificate.failures
    rules = RULES[solution.problem]
    asked = solution.asked[rules.outcome]
    assert certificate.achieved["planned"] == pytest.approx(asked, rel=2e-3)
    for engine in ("mujoco", "drake"):
        assert certificate.achieved[f"replay_{engine}"] == pytest.approx(asked, rel=0.1)
    clip = strike_clip(solution, certificate)
    assert clip.meta["achieved"][rules.outcome] == pytest.approx(
        certificate.achieved["replay_mujoco"], abs=1e-5
    )
    assert clip.meta["link_error"] < 0.1
    assert body_of(clip).equipment == solution.body.equipment
    assert name_of(solution).startswith({"lunge": "fencing_2.1m"}.get(name, f"boxing_{name}_6mps"))


def test_falls_and_lunges_without_a_step_are_refused(lunge, monkeypatch):
    """Each by its own check; the replays are hand-made."""

    def fake(times: np.ndarray, qpos: np.ndarray):
        def states(solution, engine, hold=0.5, scene=None, objects=None):
            rest = np.zeros((len(qpos) - 1, solution.body.num_dofs))
            rates = np.zeros((len(qpos), qpos.shape[1] - 1))
            return Replayed(times, qpos, rates, rest, rest)

        monkeypatch.setattr(strike, "replay_all", states)

    t = np.arange(0.0, lunge.duration, 1 / 480)
    planned = lunge.sample(t)["qpos"]
    fake(t, planned)
    _, _, found = strike.replayed(RULES["fencing"], lunge, "drake")
    assert found["replay in drake: step"] > 0.3 and found["replay in drake: miss"] < 1e-3
    assert found["replay in drake: lowest but feet"] > 0.15
    assert found["replay in drake: rear foot moves"] < 2e-3
    lying = planned.copy()
    lying[-1, 2] = 0.1
    fake(t, lying)
    _, _, found = strike.replayed(RULES["fencing"], lunge, "drake")
    assert found["replay in drake: lowest but feet"] < 0.15
    planted = planned.copy()
    planted[-1] = planned[0]
    fake(t, planted)
    _, _, found = strike.replayed(RULES["fencing"], lunge, "drake")
    assert found["replay in drake: step"] == 0.0
    for name, limit in (("lowest but feet", 0.15), ("step", 0.2), ("rear foot moves", 0.1)):
        assert required("fencing")[f"replay in drake: {name}"][1] == limit


# The optimisers themselves, on coarse grids.


def test_a_coarse_jab_from_nothing_and_a_faster_one_from_it():
    calls = []
    config = boxing.Config(fist_speed=5.0, detail=0.4)
    solution = boxing.solve(config, progress=lambda i, f: calls.append((i, f)))
    print(jumper.shown(solution))
    assert calls and solution.stats["max_violation"] < 1e-5
    velocity = np.array(solution.stats["event"]["velocity"])
    assert np.linalg.norm(velocity) == pytest.approx(5.0)
    assert velocity[0] > 4.0  # towards the opponent, ahead along x
    faster = boxing.solve(replace(config, fist_speed=5.5), guess=solution)
    print(jumper.shown(faster))
    assert faster.stats["iterations"] < 80
    assert faster.stats["objective"] > solution.stats["objective"]


def test_a_coarse_lunge_from_nothing():
    solution = fencing.solve(fencing.Config(reach=1.9, detail=0.4))
    print(jumper.shown(solution))
    assert solution.stats["max_violation"] < 1e-5
    assert [name for name, *_ in solution.phases] == ["load", "swing", "land", "follow"]
    place, start = solution.stats["event"]["place"], solution.qpos[0]
    assert place[0] - start[0] == pytest.approx(1.9, abs=1e-6)
    lifted = [name for name, *_, active in solution.phases if len(active) == 6]
    assert lifted == ["swing", "land"]  # on one foot


def test_impossible_options_are_one_sentence():
    cases: tuple[tuple[Any, dict[str, Any], str], ...] = (
        (boxing.Config, {"fist_speed": 40.0}, "fist_speed must lie between 1 and 14 m/s, not 40"),
        (boxing.Config, {"punch": "hook"}, "punch must be 'jab' or 'cross', not 'hook'"),
        (boxing.Config, {"target": "belt"}, "target must be 'head' or 'chest'"),
        (boxing.Config, {"distance": 3.0}, "distance must lie between"),
        (fencing.Config, {"reach": 4.0}, "reach must lie between 1.5 and 2.8 m, not 4"),
        (fencing.Config, {"tip_speed": 0.0}, "tip_speed must lie between"),
        (fencing.Config, {"target": "foot"}, "target must be 'chest' or 'head'"),
        (fencing.Config, {"detail": 9.0}, "detail must lie"),
    )
    for make, options, words in cases:
        with pytest.raises(ValueError, match=words) as found:
            make(**options)
        assert "\n" not in str(found.value)


# What is shipped.


@pytest.mark.parametrize("problem", ["boxing", "fencing"])
def test_shipped_demonstrations_meet_the_opponent_of_the_task(problem):
    """The clip's own frames, by MuJoCo in the task's world: the weapon's point comes within 5 cm of
    the target's surface, and the athlete stays up."""
    assert len(demonstration_files(problem)) >= 2
    scene = make_scene(problem, strength="human")
    model = build_model(scene)
    data = mujoco.MjData(model)
    data.qpos[:] = scene.default_qpos()
    own = scene.agent_qpos(0)
    for clip in load_demonstrations(problem):
        options = clip.meta["options"]
        side = "L" if options.get("punch") == "jab" else "R"
        mine = model.body(f"agent0/{side}_Hand")
        weapon = int(mine.geomadr[0] + mine.geomnum[0] - 1)
        target = int(model.body(f"agent1/{options['target'].title()}").geomadr[0])
        near, strike_time = [], clip.meta["events"]["strike"]
        for time in np.arange(strike_time - 0.03, strike_time + 0.03, 0.001):
            data.qpos[own] = clip.at(time)["qpos"]
            mujoco.mj_kinematics(model, data)
            near.append(mujoco.mj_geomDistance(model, data, weapon, target, 1.0, None))
        assert min(near) < 0.03
        assert near[0] > 0.01  # it comes from outside
        assert clip.meta["certified"] is True and clip.qpos[:, 2].min() > 0.5
