"""Strikes and throws against closed forms, the compiled ball law and MuJoCo's inverse dynamics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sports import tennis as court
from sports.ball import BALLS, landing, path
from sports.env import make_env
from sports.humanoid.body import load_body
from sports.humanoid.hold import JAVELIN_RADIUS, load_hold
from sports.humanoid.mjcf import build_model
from sports.javelin import END, LINE_X
from sports.physics import PhysicsState
from warmstart import rotation, shot, strike, thrown
from warmstart.certificate import certify, required
from warmstart.demonstration import name_of, strike_clip
from warmstart.inverse_dynamics import inverse_dynamics_drake, inverse_dynamics_mujoco, needed
from warmstart.judged import RULES
from warmstart.outcome import link_poses
from warmstart.phases import Phase
from warmstart.problems import Infeasible, javelin, jumper, striker, tennis
from warmstart.problems import get_problem as problem_of
from warmstart.replay import body_of, scene_of
from warmstart.solution import Solution

DATA = Path(__file__).parent / "data"
GAME = court.GAME
START = np.array([GAME.serve.x, 0.0, GAME.serve.z[0]])
G = 9.81


@pytest.fixture(scope="module")
def forehand() -> Solution:
    return Solution.load(DATA / "tennis_24_human.npz")


@pytest.fixture(scope="module")
def throw() -> Solution:
    return Solution.load(DATA / "javelin_12_human.npz")


@pytest.fixture(scope="module")
def fast_throw() -> Solution:
    return Solution.load(DATA / "javelin_18_human.npz")


@pytest.fixture(scope="module")
def racket() -> np.ndarray:
    body = load_body("smpl", strength="human", equipment=["racket"])
    return shot.tool_numbers(tennis.scene(body))


# The ball's way.


def test_the_machines_ball_is_the_one_of_the_compiled_law():
    """Flight, bounce and flight by plain Python agree with the law as the engines run it."""
    launched, there = shot.incoming(GAME, START, 20.0, (7.5, 0.5), 12.5)
    assert there.pos[0] == pytest.approx(12.5, abs=1e-9)
    state = [torch.tensor(x[None], dtype=torch.float32) for x in (launched.pos, launched.linvel)]
    times = [0.3, 0.9, float(there.time)]
    where = path("tennis", *state, torch.zeros(1, 3), times, ground=0.0)[0].double().numpy()
    for time, expected in zip(times, where, strict=True):
        ball = shot.state_at("tennis", GAME, launched, time)
        np.testing.assert_allclose(ball.pos, expected, atol=5e-3)
    np.testing.assert_allclose(where[-1], there.pos, atol=5e-3)


def test_machines_balls_that_never_come_are_refused():
    with pytest.raises(ValueError, match="bounces twice"):
        shot.incoming(GAME, START, 18.0, (5.0, 0.0), 16.0)
    with pytest.raises(ValueError, match="does not bounce before"):
        shot.incoming(GAME, START, 20.0, (7.5, 0.0), 6.0)
    _, there = shot.incoming(GAME, START, 22.0, (9.0, 0.0), 12.5)  # bounces once, fast
    assert there.pos[2] > 1.0


@pytest.mark.parametrize("mass", [0.3, 1e9])
def test_a_central_blow_conserves_momentum_and_gives_back_restitution(mass):
    """Ball at v on the centre of a face at u: the textbook's central impact."""
    ball = shot.Ball(0.0, np.array([0.0, 0.0, 1.0]), np.array([7.0, 0.0, 0.0]), np.zeros(3))
    tool = np.zeros(10)
    tool[0], tool[1:4], tool[4:7] = mass, (0.1, 0.0, 0.0), 1.0 / (mass * 0.01)
    u, normal = np.array([-15.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0])
    after = shot.impact(GAME.law, ball, u, normal, tool, np.eye(3), np.array([0.1, 0.0, 0.0]))
    m, e = BALLS["tennis"].mass, BALLS["tennis"].tool_restitution
    common = (m * 7.0 + mass * -15.0) / (m + mass)
    own = common - e * mass / (m + mass) * (7.0 + 15.0)
    np.testing.assert_allclose(after.linvel, [own, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(after.angvel, 0.0, atol=1e-6)


def test_a_stroke_lands_on_its_target_by_the_compiled_law(racket):
    _, ball = shot.incoming(GAME, START, 20.0, (7.5, 0.0), 12.5)
    point = np.array([0.0, -0.35, -0.01])
    stroke = shot.stroke_to(GAME, ball, (-9.5, 1.5), 24.0, 0.35, racket, (0, 0, -1.0), point)
    assert np.linalg.norm(stroke.struck.linvel) == pytest.approx(24.0, abs=2e-3)
    assert stroke.over_net > 0.0
    values = (stroke.struck.pos, stroke.struck.linvel, stroke.struck.angvel)
    state = [torch.tensor(x[None], dtype=torch.float32) for x in values]
    spot, _ = landing("tennis", *state, GAME.court.height + GAME.radius)
    np.testing.assert_allclose(spot[0, :2], (-9.5, 1.5), atol=1e-2)


def test_a_mirrored_target_asks_for_the_mirrored_stroke(racket):
    """With a racket that is the same on all sides of the contact; a real one has a handle."""
    tool = racket.copy()
    tool[1:4], tool[4:7], tool[7:] = (0.0, -0.35, 0.0), 100.0, 0.0
    point = np.array([0.0, -0.35, -0.01])
    strokes = []
    for side in (1.0, -1.0):
        _, ball = shot.incoming(GAME, START, 20.0, (7.5, side * 0.4), 12.5)
        target = (-9.0, side * 2.0)
        strokes.append(shot.stroke_to(GAME, ball, target, 22.0, 0.2, tool, (0, 0, -1.0), point))
    left, right = strokes
    mirror = np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(left.normal, mirror * right.normal, atol=1e-5)
    np.testing.assert_allclose(left.velocity, mirror * right.velocity, atol=1e-3)


def test_a_stroke_into_the_net_or_out_of_reach_is_refused(racket):
    ball = shot.Ball(0.0, np.array([12.5, 0.0, 0.5]), np.array([7.0, 0.0, 0.0]), np.zeros(3))
    point = np.array([0.0, -0.35, -0.01])
    with pytest.raises(ValueError, match=r"net|no stroke"):
        shot.stroke_to(GAME, ball, (-3.0, 0.0), 45.0, 0.0, racket, (0, 0, -1.0), point)
    with pytest.raises(ValueError, match="no stroke sends the ball"):
        shot.stroke_to(GAME, ball, (-11.0, 0.0), 12.0, 0.0, racket, (0, 0, -1.0), point)


# The javelin's way.


@pytest.mark.parametrize("angle", [20.0, 36.0, 45.0])
def test_a_throw_in_a_vacuum_is_the_parabola(angle):
    """v cos a / g (v sin a + sqrt(v^2 sin^2 a + 2 g h)), from the nose's height and place."""
    a, v, height = np.radians(angle), 18.0, 1.8
    nose = np.array([1.0, 0.0, 0.0])  # level, so that both ends come down together
    velocity = v * np.array([np.cos(a), 0.0, np.sin(a)])
    place = np.array([0.2, 0.0, height])
    fall = height - JAVELIN_RADIUS
    flight = (v * np.sin(a) + np.sqrt((v * np.sin(a)) ** 2 + 2 * G * fall)) / G
    expected = 0.2 + v * np.cos(a) * flight - LINE_X
    up = np.array([np.cos(1e-6), 0.0, np.sin(1e-6)])  # the tail comes down first
    found = thrown.distance(place, velocity, up, drag=False)
    assert found == pytest.approx(expected - END, abs=1e-4)
    assert thrown.distance(place, velocity, nose, drag=False) == pytest.approx(expected, abs=1e-6)


def test_drag_takes_energy_from_a_javelin_that_flies_along_itself():
    """Thrown straight down along its axis only the drag along it acts: a hair's breadth less far
    than in a vacuum, on a way that leans by one degree."""
    lean = np.radians(1.0)
    nose = np.array([np.sin(lean), 0.0, -np.cos(lean)])
    place = np.array([0.0, 0.0, 50.0])
    free = thrown.distance(place, 30.0 * nose, nose, drag=False)
    assert free - 0.05 < thrown.distance(place, 30.0 * nose, nose) < free + 0.05


def test_javelins_that_do_not_turn_fly_as_in_the_integration_of_one():
    rng = np.random.default_rng(4)
    nose = rng.normal(size=(8, 3)) * (0.3, 0.2, 0.3) + (1.0, 0.0, 0.2)
    nose /= np.linalg.norm(nose, axis=1, keepdims=True)
    place = rng.uniform((-1.0, -1.0, 1.5), (1.0, 1.0, 2.5), (8, 3))
    velocity = rng.uniform((5.0, -4.0, -3.0), (24.0, 4.0, 14.0), (8, 3))
    expected = [thrown.distance(*row) for row in zip(place, velocity, nose)]
    assert min(expected) < 6.0 and max(expected) > 20.0
    landing = thrown.fly(place, velocity, nose, np.zeros((8, 3)))
    np.testing.assert_allclose(landing.far, expected, atol=5e-3)
    np.testing.assert_allclose(landing.elevation, np.arcsin(nose[:, 2]), atol=1e-9)
    velocity[3, 0] = np.nan
    again = thrown.fly(place, velocity, nose, np.zeros((8, 3)))
    assert np.isnan(again.far[3]) and np.isfinite(np.delete(again.far, 3)).all()


@pytest.mark.parametrize("spin", [0.0, 180.0])
def test_a_javelin_that_turns_lands_where_the_simulation_says(spin):
    """Nose up and turning down by 0.5 and to the left by 0.4 rad/s: without a spin the nose goes on
    so; with one it circles."""
    env = make_env("javelin", num_worlds=1, training=False, physics_options={"threads": 1})
    scene, physics = env.physics.scene, env.physics
    model = build_model(scene)
    inertia = model.body_inertia[model.body("javelin").id]
    half = np.radians(15.0)
    quat = np.array([np.cos(half), 0.0, -np.sin(half), 0.0])
    place, velocity = np.array([1.0, -0.6, 2.6]), np.array([15.0, 1.0, 9.0])
    qpos, qvel = physics.qpos.clone(), torch.zeros_like(physics.qvel)
    own = (spin, 0.5, 0.4)
    qpos[:, scene.object_qpos("javelin")] = torch.tensor([*place, *quat]).float()
    qvel[:, scene.object_qvel("javelin")] = torch.tensor([*velocity, *own]).float()
    physics.reset(torch.ones(1, dtype=torch.bool), PhysicsState(qpos, qvel, physics.mocap_pos))
    env.view.refresh()
    env.memory = env.task.begin(env.view, {})
    env.view.clock[:] = 25
    for _ in range(100):
        last = physics.object_pos[0, 0].numpy().copy()
        result = env.step(torch.zeros(1, 1, env.action_size))
        if result.ended[0]:
            break
    frame = Rotation.from_quat(quat, scalar_first=True)
    nose = frame.apply((1.0, 0.0, 0.0))
    momentum = (inertia.min() / inertia.max() * spin, *own[1:])
    landing = thrown.fly(place[None], velocity[None], nose[None], frame.apply(momentum)[None])
    assert result.metrics["distance"][0] == pytest.approx(landing.far[0], abs=0.1)
    assert bool(result.metrics["tip_first"][0]) == (landing.elevation[0] < 0.0)
    reach = END * np.cos(landing.elevation[0]) + 0.5  # of a control step's way
    assert abs(landing.aside[0] - last[1]) < reach
    straight = thrown.fly(place[None], velocity[None], nose[None], np.zeros((1, 3)))
    assert abs(straight.far[0] - landing.far[0]) > 0.3
    env.close()


def test_the_planned_javelin_lies_in_the_hand_like_the_held_one():
    """Nose along the wrist's -x, as in the hold found by simulation with fingers."""
    hold, body = load_hold("javelin"), load_body("smplx")
    qpos = np.zeros((1, 7 + body.num_dofs))
    qpos[0, 2:4] = hold.root_height, 1.0
    for name, angle in hold.angles.items():
        qpos[0, 7 + body.dof_index(name)] = angle
    _, quat = link_poses(body, qpos)
    back = rotation.conjugate(quat[0, body.link_index("R_Wrist")])
    nose = rotation.rotate(rotation.multiply(back, np.array(hold.quat)), np.array([1.0, 0, 0]))
    assert nose @ np.array(javelin.NOSE) > np.cos(np.radians(20.0))
    own = load_body("smpl", equipment=["javelin"])
    (shaft,) = [s for s in own.links[own.link_index("R_Wrist")].shapes if s.mass == 0.8]
    middle = (np.array(shaft.center) + np.array(shaft.end)) / 2
    np.testing.assert_allclose(middle, javelin.GRIP, atol=1e-12)
    assert np.linalg.norm(np.array(shaft.center) - np.array(shaft.end)) == pytest.approx(2 * END)


# Moments.


def test_a_moment_of_a_turning_body_is_the_circle():
    """The T-pose turned about z at a constant rate: place and velocity of the racket's centre."""
    body = load_body("smpl", equipment=["racket"])
    rate, late = 9.0, 0.004
    t = np.arange(0.0, 0.3, 1 / 480)
    qpos = np.zeros((len(t), 7 + body.num_dofs))
    angle = rate * (t - 0.15 - late)
    qpos[:, 2], qpos[:, 3], qpos[:, 6] = 1.0, np.cos(angle / 2), np.sin(angle / 2)
    zero = np.zeros((1, 7 + body.num_dofs))
    zero[0, 3] = 1.0
    pos, _ = link_poses(body, zero)
    arm = pos[0, body.link_index("R_Wrist")] + np.array([0.0, -0.35, 0.0])
    event = {
        "time": 0.15,
        "link": "R_Wrist",
        "point": [0.0, -0.35, 0.0],
        "axis": [0.0, 0.0, 1.0],
        "place": (arm + np.array([0.0, 0.0, 1.0])).tolist(),
        "velocity": np.cross([0, 0, 2 * rate], arm).tolist(),
        "normal": [0.0, 0.0, 1.0],
    }
    found = strike.moment(body, event, t, qpos)
    assert found.time == pytest.approx(0.15 + late, abs=2e-4)
    assert found.miss < 1e-4 * rate
    np.testing.assert_allclose(found.velocity, np.cross([0, 0, rate], arm), atol=2e-2)
    assert found.speed_off(event) == pytest.approx(0.5, abs=1e-3)
    assert found.face_off(event) == pytest.approx(0.0, abs=1e-6)
    clock = strike.moment(body, event, t, qpos, nearest=False)
    assert clock.time == 0.15
    assert clock.miss == pytest.approx(2 * np.sin(rate * late / 2) * np.hypot(*arm[:2]), rel=1e-3)
    with pytest.raises(ValueError, match="do not cover"):
        strike.moment(body, event, t[:40], qpos[:40])


def test_a_placed_motion_needs_the_same_torques(forehand):
    """Turning and shifting the world changes no torque; unplacing comes back."""
    local = striker.unplaced(forehand)
    assert np.linalg.norm(local.qpos[0, :2]) < 0.4
    again = striker.placed(local, *forehand.stats["placed"])
    np.testing.assert_allclose(again.qpos, forehand.qpos, atol=1e-9)
    times = forehand.times[[3, 30, 40]]
    both = [needed(inverse_dynamics_mujoco, s, times) for s in (forehand, local)]
    np.testing.assert_allclose(both[0][:, 6:], both[1][:, 6:], atol=1e-6)


# Solutions, checked by other code.


@pytest.mark.parametrize("name", ["forehand", "throw", "fast_throw"])
def test_the_motion_obeys_both_engines_at_every_knot(name, request):
    """No force on the root, torques as stored and allowed; with the javelin until the release."""
    solution = request.getfixturevalue(name)
    weight = solution.body.mass * G
    effort = solution.body.array("effort")
    names = ("qpos", "qvel", "qacc", "contact_force")
    motion = {field: getattr(solution, field) for field in names}
    load = solution.loaded(solution.times)[:, None]
    for compute in (inverse_dynamics_mujoco, inverse_dynamics_drake):
        tau = load * compute(solution, motion, solution.body)
        tau += (1 - load) * compute(solution, motion, solution.empty_handed)
        assert np.abs(tau[:, :6]).max() / weight < 1e-5
        np.testing.assert_allclose(tau[:, 6:], solution.torque, atol=1e-4)
    assert (np.abs(solution.torque) / effort).max() <= striker.SHARE + 1e-5
    assert set(np.unique(np.round(load, 9))) == ({1.0} if name == "forehand" else {0.0, 1.0})


@pytest.mark.parametrize("name", ["forehand", "throw", "fast_throw"])
def test_the_point_does_what_the_event_says(name, request):
    """By MuJoCo's kinematics at the knot of the event; feet stand still all the time."""
    solution = request.getfixturevalue(name)
    event, body = solution.stats["event"], solution.body
    model = build_model(body)
    data = mujoco.MjData(model)
    k = int(np.argmin(np.abs(solution.times - event["time"])))
    data.qpos[:], data.qvel[:] = solution.qpos[k], solution.qvel[k]
    mujoco.mj_forward(model, data)
    i = 1 + body.link_index(event["link"])
    turn = data.xmat[i].reshape(3, 3)
    where = data.xpos[i] + turn @ np.array(event["point"])
    jac = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jac, None, where, i)
    np.testing.assert_allclose(where, event["place"], atol=1e-5)
    np.testing.assert_allclose(jac @ data.qvel, event["velocity"], atol=1e-4)
    np.testing.assert_allclose(turn @ np.array(event["axis"]), event["normal"], atol=1e-5)
    pos, _ = link_poses(body, solution.qpos)
    for side in "LR":
        toe = pos[:, body.link_index(f"{side}_Toe")]
        assert np.ptp(toe, axis=0).max() < 1e-3
    np.testing.assert_allclose(solution.qvel[0], 0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["forehand", "throw", "fast_throw"])
def test_it_is_certified_and_says_what_it_achieved(name, request):
    solution = request.getfixturevalue(name)
    certificate = certify(solution)
    assert certificate.passed, certificate.failures
    rules = RULES[solution.problem]
    asked = solution.asked[rules.outcome]
    assert certificate.achieved["planned"] == pytest.approx(asked, rel=2e-3)
    for engine in ("mujoco", "drake"):
        assert certificate.achieved[f"replay_{engine}"] == pytest.approx(asked, rel=0.1)
    values = {c.name: c.value for c in certificate.checks}
    if solution.problem == "tennis":
        for engine in ("mujoco", "drake"):  # the engine's own ball, by the law in the engine
            speed = values[f"replay in {engine}: ball: speed"]
            assert speed == pytest.approx(asked, rel=0.1)
            assert values[f"replay in {engine}: ball: over the net"] > 0.0
    clip = strike_clip(solution, certificate)
    assert clip.meta["achieved"][rules.outcome] == pytest.approx(
        certificate.achieved["replay_mujoco"], abs=1e-5
    )
    assert clip.meta["link_error"] < 0.06
    assert body_of(clip).equipment == solution.body.equipment
    assert scene_of(clip).body.name == clip.body
    assert name_of(solution).startswith(solution.problem)


def test_a_spoiled_strike_is_refused(forehand, monkeypatch):
    """Another speed asked, no event, no ball, no replay: each fails by its own check."""
    monkeypatch.setattr("warmstart.certificate._replay", lambda *_: {})
    event = dict(forehand.stats["event"])
    faster = event | {"velocity": [1.2 * v for v in event["velocity"]]}
    for stats, words in (
        (forehand.stats | {"event": faster}, "planned speed off"),
        ({k: v for k, v in forehand.stats.items() if k != "event"}, "planned miss"),
        ({k: v for k, v in forehand.stats.items() if k != "ball"}, "planned outcome"),
    ):
        found = certify(replace(forehand, stats=stats))
        assert not found.passed
        assert any(words in f for f in found.failures)
        assert any("replay in drake: miss" in f for f in found.failures)
    assert set(required("tennis")) > set(required("javelin")) & set(required("high_jump"))


def test_a_javelin_that_is_never_let_go_is_refused(throw, monkeypatch):
    """The stored torques after the release are those of an empty hand."""
    monkeypatch.setattr("warmstart.certificate._replay", lambda *_: {})
    kept = {k: v for k, v in throw.stats.items() if k != "payload"}
    failures = certify(replace(throw, stats=kept)).failures
    assert any(f.startswith("base force residual") for f in failures)


def test_no_limb_passes_through_the_javelin_between_two_knots(fast_throw):
    """By MuJoCo's collision routines every 2 ms: the javelin touches nothing while it is held."""
    model = build_model(fast_throw.body)
    data = mujoco.MjData(model)
    hand = 1 + fast_throw.body.link_index("R_Wrist")
    times = np.arange(0.0, fast_throw.stats["event"]["time"], 0.002)
    for row in fast_throw.sample(times)["qpos"]:
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        met = [model.geom_bodyid[c.geom] for c in data.contact]
        assert not any(hand in pair and 0 not in pair for pair in met)


def test_the_wrist_stays_within_its_limit_while_the_hand_opens(fast_throw):
    """By Drake, at 21 moments between the two knots, where the mass changes with the motion."""
    payload, body = fast_throw.stats["payload"], fast_throw.body
    times = np.linspace(payload["held"], payload["gone"], 21)
    wrist = [body.dof_index(f"R_Wrist_{axis}") for axis in "xyz"]
    torque = needed(inverse_dynamics_drake, fast_throw, times)[:, 6:][:, wrist]
    assert (np.abs(torque) / body.array("effort")[wrist]).max() < 1.02


def test_steps_shrink_before_an_event_as_they_grow_after_one():
    """``closing`` is ``grading`` seen in a mirror; lengths add up to what they were."""
    for count in (14, 26):
        early = Phase("a", count, (0.2, 0.4), grading=4.0).spacing()
        late = Phase("a", count, (0.2, 0.4), closing=4.0).spacing()
        np.testing.assert_allclose(late, early[::-1])
        assert late.sum() == pytest.approx(count) and late[-1] == pytest.approx(late[0] / 4.0)
        np.testing.assert_allclose(Phase("a", count, (0.2, 0.4)).spacing(), 1.0)


# The optimisers themselves, on coarse grids.


def test_a_coarse_forehand_from_nothing():
    calls = []
    config = tennis.Config(ball_speed=20.0, detail=0.4)
    solution = tennis.solve(config, progress=lambda i, f: calls.append((i, f)))
    print(jumper.shown(solution))
    assert calls and solution.stats["max_violation"] < 1e-5
    event = solution.stats["event"]
    launched = solution.stats["ball"]["launch"]
    met = shot.state_at(
        "tennis",
        GAME,
        shot.Ball(0.0, np.array(launched["pos"]), np.array(launched["linvel"]), np.zeros(3)),
        solution.stats["ball"]["met"],
    )
    # The face is where the ball is.
    apart = met.pos - np.array(event["place"])
    np.testing.assert_allclose(apart, GAME.radius * np.array(event["normal"]), atol=1e-4)
    assert solution.qpos[0, 0] > 12.0  # behind the ball, facing the net
    faster = tennis.solve(replace(config, ball_speed=21.0), guess=solution)
    assert faster.stats["iterations"] < 60
    assert faster.stats["objective"] > solution.stats["objective"]


def test_a_coarse_throw_from_nothing():
    solution = javelin.solve(javelin.Config(release_speed=10.0, angle=30.0, detail=0.4))
    print(jumper.shown(solution))
    event = solution.stats["event"]
    assert event["place"][2] == pytest.approx(1.75, abs=1e-6)
    np.testing.assert_allclose(
        event["velocity"], 10.0 * np.array([np.cos(np.pi / 6), 0.0, 0.5]), atol=1e-9
    )
    names = [name for name, *_ in solution.phases]
    assert names == ["draw", "swing", "release", "follow"]
    assert solution.empty_handed.mass == pytest.approx(solution.body.mass - 0.8)


def test_impossible_options_are_one_sentence():
    for options, words in (
        ({"ball_speed": 99.0}, "ball_speed must lie between"),
        ({"side": "volley"}, "side must be"),
        ({"target": (3.0, 0.0)}, "does not lie in the far half"),
        ({"bounce": (-2.0, 0.0)}, "does not lie in the near half"),
        ({"brush": 2.0}, "brush must lie"),
        ({"machine_speed": 5.0}, "machine_speed must lie"),
        ({"detail": 9.0}, "detail must lie"),
    ):
        with pytest.raises(ValueError, match=words):
            tennis.Config(**options)
    for options, words in (
        ({"release_speed": 60.0}, "release_speed must lie"),
        ({"angle": 80.0}, "angle must lie"),
        ({"height": 3.0}, "height must lie"),
    ):
        with pytest.raises(ValueError, match=words):
            javelin.Config(**options)
    assert problem_of("tennis").unit == "m/s"
    assert issubclass(Infeasible, RuntimeError)
