"""A kick after one step: a recorded solution by other code, the gate with feedback, the clips."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from olympics_opt.report.sections import certificate_section
from sports.humanoid.mjcf import build_model
from sports.penalty_kick import SPOT, PenaltyKick, scene
from sports.soccer import BALL_RADIUS
from warmstart import kick, strike
from warmstart.bank import demonstration_files
from warmstart.certificate import CLOSED_LOOP, Certificate, Check, certify
from warmstart.clip import Clip
from warmstart.demonstration import demonstrate, name_of, strike_clip
from warmstart.inverse_dynamics import inverse_dynamics_drake, inverse_dynamics_mujoco
from warmstart.outcome import link_poses
from warmstart.problems import jumper, kick_step, penalty_kick
from warmstart.replay import FEEDBACK, body_of, replay_all
from warmstart.solution import Solution

DATA = Path(__file__).parent / "data"
G = 9.81
START = np.array([*SPOT, BALL_RADIUS])
SHIPPED = [p for p in demonstration_files("penalty_kick") if "_step" in p.stem]


@pytest.fixture(scope="module")
def kicked() -> Solution:
    return Solution.load(DATA / "penalty_kick_step_16_human.npz")


def _phase(solution: Solution, name: str) -> slice:
    return next(slice(a, b + 1) for n, a, b, _ in solution.phases if n == name)


# The plan.


def test_the_motion_obeys_both_engines_at_every_knot(kicked):
    weight = kicked.body.mass * G
    motion = {n: getattr(kicked, n) for n in ("qpos", "qvel", "qacc", "contact_force")}
    for compute in (inverse_dynamics_mujoco, inverse_dynamics_drake):
        tau = compute(kicked, motion, kicked.body)
        assert np.abs(tau[:, :6]).max() / weight < 1e-5
        np.testing.assert_allclose(tau[:, 6:], kicked.torque, atol=1e-4)


def test_it_is_a_step(kicked):
    """By the kinematics of the body: the left foot comes from behind the right one and lands ahead
    of it beside the ball, over the ground in between, while the right one carries alone; then it
    stays where it is, and only the right one moves."""
    body = kicked.body
    pos, _ = link_poses(body, kicked.qpos)
    left, right = (pos[:, body.link_index(f"{side}_Ankle")] for side in "LR")
    landed = kicked.phases[2][1]
    assert [name for name, *_ in kicked.phases] == ["lean", "step", "plant", "swing", "follow"]
    assert left[landed, 0] - left[0, 0] == pytest.approx(0.5, abs=2 * kick_step.SLACK)
    assert left[0, 0] < right[0, 0] - 0.05 and left[landed, 0] > right[landed, 0] + 0.1
    assert np.ptp(left[landed:], axis=0).max() < 2e-3
    assert np.ptp(right[: kicked.phases[3][1] + 1], axis=0).max() < 2e-3
    points = [link for link, _ in kicked.contact_points]
    step = kicked.contact_force[_phase(kicked, "step")][1:-1]
    assert not step[:, [p.startswith("L_") for p in points]].any()
    height = left[_phase(kicked, "step"), 2] - left[0, 2]
    assert height.max() > kick_step.LIFT and height.min() > -1e-3
    toe = pos[:, body.link_index("L_Toe")]
    assert toe[landed, 1] > SPOT[1] + BALL_RADIUS
    np.testing.assert_allclose(kicked.qvel[0], 0.0, atol=1e-9)


def test_the_athlete_is_on_its_way_when_the_foot_lands(kicked):
    """One motion, not a step and then a kick: nothing comes to rest in between."""
    middle = slice(_phase(kicked, "step").start + 1, _phase(kicked, "follow").start)
    speed = np.linalg.norm(kicked.qvel[middle, 6:], axis=1)
    assert speed.min() > 0.5
    root = kicked.qvel[_phase(kicked, "step"), 0]
    assert root.max() > 0.2


def test_the_leg_that_steps_keeps_off_the_ball(kicked):
    """By MuJoCo's distances, until the kick."""
    world = scene(PenaltyKick(), kicked.body)
    model = build_model(world)
    data = mujoco.MjData(model)
    data.qpos[:] = world.default_qpos()
    ball = int(model.body("ball").geomadr[0])
    names = [f"agent0/L_{link}" for link in ("Knee", "Ankle", "Toe")]
    geoms = [int(model.body(name).geomadr[0]) for name in names]
    times = np.linspace(0.0, kicked.stats["event"]["time"], 60)
    for row in kicked.sample(times)["qpos"]:
        data.qpos[world.agent_qpos(0)] = row
        mujoco.mj_kinematics(model, data)
        gaps = [mujoco.mj_geomDistance(model, data, g, ball, 1.0, None) for g in geoms]
        assert min(gaps) > 0.02


def test_the_foot_meets_the_ball_where_it_lies(kicked):
    event = kicked.stats["event"]
    normal = np.array(event["normal"])
    np.testing.assert_allclose(np.array(event["place"]) + BALL_RADIUS * normal, START, atol=1e-9)
    way = kick.direction(kicked.asked["ball_speed"], kicked.stats["target"])
    np.testing.assert_allclose(normal, way, atol=1e-9)
    times = event["time"] + np.arange(-10, 11) / 480.0
    found = strike.moment(kicked.body, event, times, kicked.sample(times)["qpos"], nearest=False)
    assert found.miss < 1e-4 and found.speed_off(event) < 1e-3 and found.face_off(event) < 0.1


# The gate.


def test_it_is_certified_with_feedback_and_says_so(kicked, tmp_path: Path):
    certificate = certify(kicked)
    assert certificate.passed, certificate.failures
    values = {c.name: c.value for c in certificate.checks}
    for engine in ("mujoco", "drake"):
        head = f"replay in {engine}: "
        assert values[f"{head}miss"] < 0.03 and values[f"{head}speed off"] < 0.10
        assert values[f"{head}step"] == pytest.approx(0.5, abs=0.04)
        assert values[f"{head}ball: speed"] == pytest.approx(16.0, rel=0.15)
        assert 0.0 < values[f"{head}feedback torque"] < 1.0
    certificate.to_json(tmp_path / "certificate.json")
    text = json.loads((tmp_path / "certificate.json").read_text())
    assert text["stats"]["replay"] == CLOSED_LOOP and "closed loop" in CLOSED_LOOP
    notes = {c["note"] for c in text["checks"] if c["name"].startswith("replay in ")}
    assert notes == {"with feedback"}
    read = Certificate.from_json(tmp_path / "certificate.json")
    assert read.passed
    short = tuple(c for c in read.checks if "feedback torque" not in c.name)
    assert not replace(read, checks=short).passed  # the figures of feedback must be there
    found = demonstrate(kicked, certificate=certificate)
    assert found.passed and found.clip is not None
    assert found.clip.meta["source"].endswith("replayed in MuJoCo with feedback")
    assert name_of(kicked) == "penalty_kick_16mps_step_human"
    (path,) = (p for p in SHIPPED if p.stem == name_of(kicked))  # made of this plan
    np.testing.assert_allclose(found.clip.qpos, Clip.load(path).qpos, atol=1e-3)
    assert CLOSED_LOOP in certificate_section(text).text


@pytest.mark.parametrize("engine", ["mujoco", "drake"])
def test_pushed_at_the_start_it_still_meets_the_ball(kicked, engine):
    """Forward at 0.1 m/s, 1.5 cm back and aside: open loop the foot does not come near."""
    qpos, qvel = kicked.qpos[0].copy(), kicked.qvel[0].copy()
    qpos[:2] += (-0.015, 0.015)
    qvel[0] += 0.1
    event, miss = kicked.stats["event"], []
    for on in (True, False):
        solution = replace(kicked, stats=kicked.stats | {FEEDBACK: on})
        played = replay_all(solution, engine, hold=0.1, start=(qpos, qvel))
        found = strike.moment(kicked.body, event, played.times, played.qpos)
        miss.append(found.miss)
    assert miss[0] < 0.01 and miss[1] > 0.1


def test_the_clip_has_the_targets_that_were_played(kicked):
    """Of each frame: the mean of its eight steps of the replay."""
    outcome = Check("replay in mujoco: outcome", 16.0, ">=", 0.0, "m/s")
    clip = strike_clip(
        kicked, Certificate("penalty_kick", kicked.asked, "human", {}, (outcome,), {})
    )
    played = replay_all(kicked, "mujoco", hold=0.0)
    assert clip.ctrl is not None
    frame = 40
    wanted = played.ctrl[8 * frame : 8 * frame + 8].mean(0)
    np.testing.assert_allclose(clip.ctrl[frame], wanted, atol=2e-3)
    np.testing.assert_allclose(clip.qpos[frame], played.qpos[8 * frame], atol=1e-6)


# Two steps from the task's own start.


@pytest.fixture(scope="module")
def walked() -> Solution:
    return Solution.load(DATA / "penalty_kick_from_start_16_human.npz")


def _tasks_start(solution: Solution) -> np.ndarray:
    return scene(PenaltyKick(), solution.body).default_qpos()[: 7 + solution.body.num_dofs]


def test_it_begins_as_the_task_does_and_takes_two_steps(walked):
    """By the kinematics of the body: the root within 1 cm, hinges within 0.03 rad, and then one
    foot moves at a time."""
    body, start = walked.body, _tasks_start(walked)
    np.testing.assert_allclose(walked.qpos[0, :3], start[:3], atol=0.01)
    np.testing.assert_allclose(walked.qpos[0, 7:], start[7:], atol=kick_step.OFF + 1e-6)
    np.testing.assert_allclose(walked.qvel[0], 0.0, atol=1e-9)
    pos, _ = link_poses(body, walked.qpos)
    left, right = (pos[:, body.link_index(f"{side}_Ankle")] for side in "LR")
    for name, moves, stays in (("right", right, left), ("step", left, right)):
        knots = _phase(walked, name)
        assert moves[knots][-1, 0] - moves[knots][0, 0] > 0.25
        assert np.ptp(stays[knots], axis=0).max() < 2e-3
        assert moves[knots, 2].max() - moves[knots, 2].min() > kick_step.LIFT
    for name in ("start", "lean", "plant"):
        knots = _phase(walked, name)
        assert max(np.ptp(foot[knots], axis=0).max() for foot in (left, right)) < 2e-3


@pytest.mark.slow
def test_both_engines_certify_the_two_steps(walked):
    """As the one step is above."""
    certificate = certify(walked)
    assert certificate.passed, certificate.failures
    assert certificate.stats["replay"] == CLOSED_LOOP and certificate.asked["steps"] == 2
    assert name_of(walked) == "penalty_kick_16mps_steps_human"


@pytest.mark.parametrize("engine", ["mujoco", "drake"])
def test_from_the_tasks_own_state_the_foot_meets_the_ball(walked, engine):
    """Not from the plan's first state: the task drops the athlete by 5 mm onto straight legs."""
    event = walked.stats["event"]
    start = _tasks_start(walked), np.zeros(6 + walked.body.num_dofs)
    played = replay_all(walked, engine, hold=0.1, start=start)
    found = strike.moment(walked.body, event, played.times, played.qpos)
    assert found.miss < 0.03 and found.speed_off(event) < 0.1


# What is shipped, and mistakes.


def test_shipped_kicks_after_a_step():
    assert len(SHIPPED) >= 1
    for path in SHIPPED:
        clip, certificate = Clip.load(path), Certificate.from_json(path.with_suffix(".json"))
        assert certificate.passed and certificate.stats["replay"] == CLOSED_LOOP
        assert clip.meta["certified"] is True and "with feedback" in clip.meta["source"]
        length = clip.meta["asked"].get("approach", 0.5)
        pos, _ = link_poses(body_of(clip), clip.qpos)
        left = pos[:, body_of(clip).link_index("L_Ankle"), 0]
        strike_frame = round(clip.meta["events"]["strike"] * clip.fps)
        assert left[strike_frame] - left[0] == pytest.approx(length, abs=0.04)
        assert abs(clip.meta["achieved"]["ball_speed"] / clip.meta["asked"]["ball_speed"] - 1) < 0.1


@pytest.mark.parametrize("length", [0.1, 1.5, -0.5])
def test_a_step_that_nobody_takes_is_one_sentence(length):
    with pytest.raises(ValueError, match=r"approach must be 0, or a step of 0\.3 to 0\.8 m"):
        penalty_kick.Config(approach=length)


def test_two_kinds_of_approach_are_one_too_many():
    with pytest.raises(ValueError, match="leave approach at 0"):
        penalty_kick.Config(approach=0.5, from_start=True)


@pytest.mark.slow
def test_a_step_of_another_length(kicked):
    config = penalty_kick.Config(ball_speed=16.0, approach=0.45, max_iterations=200)
    solution = penalty_kick.solve(config, guess=kicked)
    print(jumper.shown(solution))
    assert solution.stats["max_violation"] < 1e-5 and solution.stats[FEEDBACK] is True
