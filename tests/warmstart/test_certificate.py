"""The gate on motions whose truth is known in closed form, and on the same ones spoiled."""

from __future__ import annotations

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from warmstart.certificate import (
    LIMITS,
    PROBLEM_LIMITS,
    Certificate,
    Check,
    certify,
    fine_times,
)
from warmstart.clip import Clip
from warmstart.contact import sole_points
from warmstart.demonstration import demonstrate, save_demonstration
from warmstart.inverse_dynamics import inverse_dynamics_drake, inverse_dynamics_mujoco
from warmstart.outcome import (
    cleared_height,
    flight_events,
    jump_length,
    link_poses,
    lowest,
    support,
)
from warmstart.replay import play
from warmstart.solution import Solution
from warmstart.tracking import Tracking

BODY = load_body("smpl", strength="human")
N = BODY.num_dofs
G = 9.81
POINTS = sole_points(BODY, "L") + sole_points(BODY, "R")
SOLE = BODY.standing_height(0.0)
"""Root height at which the zero pose's soles touch the ground."""


def thrown(problem: str = "high_jump", **changes: object) -> Solution:
    """The zero pose thrown over the bar: a parabola, which in free fall needs no torque."""
    t = np.linspace(0.0, 0.5, 11)
    qpos, qvel, qacc = (np.zeros((len(t), k)) for k in (7 + N, 6 + N, 6 + N))
    qpos[:, 0], qpos[:, 1] = 19.0 + 4.0 * t, 6.0
    qpos[:, 2] = 1.2 + SOLE + 0.25 * G * t - 0.5 * G * t**2  # soles rise from 1.2 to 1.51 m
    qpos[:, 3] = 1.0
    qvel[:, 0], qvel[:, 2] = 4.0, 0.25 * G - G * t
    qacc[:, 2] = -G
    fields = {
        "problem": problem,
        "body": BODY,
        "asked": {"bar_height": 1.0, "length": 3.0},
        "strength": "human",
        "times": t,
        "qpos": qpos,
        "qvel": qvel,
        "qacc": qacc,
        "torque": np.zeros((len(t), N)),
        "contact_points": POINTS,
        "contact_force": np.zeros((len(t), len(POINTS), 3)),
        "phases": (("flight", 0, 10, ()),),
        "stats": {"max_violation": 1e-8, "solve_s": 1.0},
    }
    return Solution(**(fields | changes))


def standing(lean: float = 0.0) -> Solution:
    """At rest on the soles: ground forces whose sum is the weight, under the centre of mass."""
    model = build_model(BODY)
    data = mujoco.MjData(model)
    qpos = np.zeros(7 + N)
    qpos[2], qpos[3] = SOLE, 1.0
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    com = data.subtree_com[1]
    pos, _ = link_poses(BODY, qpos[None])
    feet = np.array([pos[0, BODY.link_index(link)] + p for link, p in POINTS])
    rows = np.array([np.ones(len(feet)), feet[:, 0], feet[:, 1]])
    lift = np.linalg.lstsq(rows, BODY.mass * G * np.array([1, com[0] + lean, com[1]]), rcond=None)[
        0
    ]
    force = np.zeros((3, len(feet), 3))
    force[:, :, 2] = lift
    still = np.zeros((3, 6 + N))
    return thrown(
        times=np.array([0.0, 0.05, 0.1]),
        qpos=np.repeat(qpos[None], 3, 0),
        qvel=still,
        qacc=still,
        torque=np.zeros((3, N)),
        contact_force=force,
        phases=(("stance", 0, 2, tuple(range(len(feet)))),),
    )


def values(certificate: Certificate) -> dict[str, float]:
    return {c.name: c.value for c in certificate.checks}


@pytest.fixture(scope="module")
def good() -> Certificate:
    return certify(thrown())


def test_a_true_motion_passes_every_check(good):
    assert good.passed and good.failures == []
    found = values(good)
    assert set(found) == set(LIMITS) | set(PROBLEM_LIMITS["high_jump"])
    assert found["base force residual max, mujoco"] < 1e-9
    assert found["base moment residual max, drake"] < 1e-9
    assert found["needed torque, drake"] < 1e-9
    # In free fall both engines replay the parabola.
    assert found["replay in mujoco: root error"] < 0.02
    assert found["replay in drake: root error"] < 0.02


def test_the_achieved_height_is_that_of_the_soles_over_the_bar(good):
    # The zero pose's feet reach about 0.25 m along x: the bar must pass below the soles during
    # the time in which they are over it, around t = 0.25 s.
    t = np.linspace(0.15, 0.35, 400)
    soles = 1.2 + 0.25 * G * t - 0.5 * G * t**2
    for height in good.achieved.values():
        assert soles.min() - 0.06 < height < soles.max() + 0.002
    assert good.achieved["planned"] == pytest.approx(good.achieved["replay_drake"], abs=0.02)
    for engine in ("mujoco", "drake"):  # linear feedback holds the plan closer still
        assert good.achieved[f"feedback_{engine}"] == pytest.approx(
            good.achieved["planned"], abs=0.01
        )


def test_at_rest_the_ground_carries_the_weight_in_both_engines():
    solution = standing()
    motion = solution.sample(fine_times(solution))
    for inverse in (inverse_dynamics_mujoco, inverse_dynamics_drake):
        assert np.abs(inverse(solution, motion)[:, :6]).max() < 1e-6
    leaning = standing(lean=0.02)
    moment = 0.02 * BODY.mass * G  # the force acts 2 cm too far in front
    for inverse in (inverse_dynamics_mujoco, inverse_dynamics_drake):
        force = inverse(leaning, leaning.sample(np.zeros(1)))[0, :6]
        assert force[4] == pytest.approx(moment, rel=1e-6)
        assert np.abs(np.delete(force, 4)).max() < 1e-6
    found = values(certify(solution))
    # The table puts the heel 1.8 mm above the toes.
    assert found["height of loaded contacts"] < 0.002 and found["speed of loaded contacts"] < 1e-9
    assert found["friction"] <= 0.0 and found["depth below the ground"] < 1e-6


def test_inverse_dynamics_are_those_of_forward_dynamics():
    """Torques put into MuJoCo's forward dynamics come back from both inverse ones."""
    rng = np.random.default_rng(0)
    model = build_model(BODY)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(model)
    data.qpos[:] = thrown().qpos[0]
    data.qpos[3:7] = (0.8, 0.0, 0.36, 0.48)
    data.qpos[7:] = rng.uniform(-0.5, 0.5, N)
    data.qvel[:] = rng.normal(0, 2, 6 + N)
    torque = rng.normal(0, 50, N)
    data.qfrc_applied[6:] = torque
    data.ctrl[:] = data.qpos[7:]  # the servos push nothing
    mujoco.mj_forward(model, data)
    motion = {
        "qpos": data.qpos[None].copy(),
        "qvel": data.qvel[None].copy(),
        "qacc": data.qacc[None].copy(),
        "contact_force": np.zeros((1, len(POINTS), 3)),
    }
    for inverse in (inverse_dynamics_mujoco, inverse_dynamics_drake):
        force = inverse(thrown(), motion)[0]
        assert np.abs(force[:6]).max() < 1e-6
        assert np.abs(force[6:] - torque).max() < 1e-6


def spoiled() -> dict[str, tuple[Solution, str]]:
    good = thrown()
    dof = BODY.dof_index("L_Knee_y")

    def changed(name: str, rows: object, value: float) -> np.ndarray:
        array = getattr(good, name).copy()
        array[rows] += value
        return array

    tilted = good.qpos.copy()
    tilted[5, 3:7] = (np.cos(0.05), 0.0, np.sin(0.05), 0.0)
    bent = good.qpos.copy()
    bent[:, 7 + dof] = 1.2 * np.pi
    force = np.zeros_like(good.contact_force)
    force[3, 0] = (0.0, 0.0, 200.0)
    pull = np.zeros_like(good.contact_force)
    pull[3, 0] = (0.0, 0.0, -200.0)
    slide = np.zeros_like(good.contact_force)
    slide[3, 0] = (250.0, 0.0, 200.0)
    low = good.qpos - np.eye(7 + N)[2] * 1.3
    fall = "base force residual max, mujoco"
    return {
        "violation": (replace(good, stats={"max_violation": 2e-5}), "nlp violation"),
        "no violation": (replace(good, stats={}), "nlp violation"),
        "nan violation": (replace(good, stats={"max_violation": float("nan")}), "nlp violation"),
        "weightless": (thrown(qacc=np.zeros_like(good.qacc), qvel=good.qvel * 0 + good.qvel[0],
                              qpos=good.qpos + 0), fall),
        "tilted": (thrown(qpos=tilted), "base moment residual max, drake"),
        "torque": (thrown(torque=changed("torque", (4, dof), 301.0)), "planned torque"),
        "joint limit": (thrown(qpos=bent), "beyond a joint limit"),
        "self-contact": (thrown(qpos=changed("qpos", (slice(None), 7 + BODY.dof_index("L_Hip_x")),
                                             -0.5)), "depth of self-contact"),
        "push in the air": (thrown(contact_force=force), "height of loaded contacts"),
        "pull": (thrown(contact_force=pull), "pulling contact force"),
        "slide": (thrown(contact_force=slide), "friction"),
        "under the ground": (thrown(qpos=low), "depth below the ground"),
        "through the bar": (thrown(asked={"bar_height": 1.6}), "clearance over the bar"),
        "nothing asked": (thrown(asked={}), "clearance over the bar"),
        "unknown problem": (thrown(problem="croquet"), "problem is known"),
    }  # fmt: skip


@pytest.mark.parametrize("case", list(spoiled()))
def test_a_spoiled_motion_fails_where_it_is_wrong(case, monkeypatch):
    solution, name = spoiled()[case]
    # The replays are tested above; here they only take time.
    monkeypatch.setattr("warmstart.certificate._replay", lambda *_: {})
    certificate = certify(solution)
    assert not certificate.passed
    failed = [c.name for c in certificate.checks if not c.passed and not c.name.startswith("repl")]
    assert name in failed
    assert any(sentence.startswith(name) for sentence in certificate.failures)


def test_a_missing_replay_fails(monkeypatch):
    def broken(*_: object) -> None:
        raise RuntimeError("no engine here")

    monkeypatch.setattr("warmstart.certificate._replay", broken)
    certificate = certify(thrown())
    assert not certificate.passed and len(certificate.failures) == 4
    assert "no engine here" in certificate.stats["not computed"][0]


def test_file_round_trip_and_a_file_that_lies(good, tmp_path):
    path = tmp_path / "certificate.json"
    good.to_json(path)
    again = Certificate.from_json(path)
    assert again.passed and again.checks[0] == good.checks[0]
    assert [p.name for p in tmp_path.iterdir()] == ["certificate.json"]
    data = json.loads(path.read_text())

    def rewritten(change) -> Certificate:
        copy = json.loads(json.dumps(data))
        change(copy)
        path.write_text(json.dumps(copy))
        return Certificate.from_json(path)

    def loosened(c):
        c["checks"][0] |= {"limit": 1.0, "value": 0.5, "passed": True}

    assert not rewritten(lambda c: c["checks"].pop(3)).passed
    assert not rewritten(lambda c: c["checks"][2].update(value=None, passed=True)).passed
    assert not rewritten(loosened).passed
    assert not rewritten(lambda c: c.update(checks=[], passed=True)).passed
    assert not rewritten(lambda c: c.update(problem="croquet")).passed
    path.write_text('{"checks": 3}')
    with pytest.raises(ValueError, match=r"certificate\.json is not a readable certificate"):
        Certificate.from_json(path)


@pytest.mark.parametrize(
    ("value", "sense", "limit", "passed"),
    [
        (1.0, "<=", 1.0, True),
        (1.1, "<=", 1.0, False),
        (-1.0, ">=", 0.0, False),
        (float("nan"), "<=", 1.0, False),
        (float("inf"), ">=", 0.0, False),
        (float("nan"), "recorded", float("nan"), False),
        (3.0, "recorded", float("nan"), True),
        (3.0, "<=", float("nan"), False),
        (3.0, "about", 3.0, False),
    ],
)
def test_a_check_fails_closed(value, sense, limit, passed):
    assert Check("x", value, sense, limit, "m").passed is passed


def translated(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    qpos = np.zeros((len(x), 7 + N))
    qpos[:, 0], qpos[:, 2], qpos[:, 3] = x, z + SOLE, 1.0
    return qpos


def test_jump_length_of_a_stiff_jumper():
    """The zero pose slides to the line, flies and lands: only its soles mark the ground."""
    t = np.arange(0, 1.2, 1 / 240)
    x = 17.0 + 5.0 * t
    z = np.maximum(np.where((t > 0.4) & (t < 0.9), (t - 0.4) * (0.9 - t) * 8, 0.0), 0.0)
    qpos = translated(x, z)
    points, radii = support(BODY, translated(np.zeros(1), np.zeros(1)))
    soles = points[0][points[0][:, 2] - radii < 0.005][:, 0]
    # The mark: the heels in the first frame within 5 mm of the ground, at about t = 0.9 s.
    length = jump_length(BODY, t, qpos)
    assert length == pytest.approx(17.0 + 5.0 * 0.9 + soles.min() - 20.0, abs=0.03)
    events = flight_events(BODY, t, qpos)
    assert events["takeoff"] == pytest.approx(0.4, abs=0.01)
    assert events["landing"] == pytest.approx(0.9, abs=0.01)
    assert flight_events(BODY, t, translated(x, 0 * z)) == {}
    assert np.isnan(jump_length(BODY, t, qpos + np.eye(7 + N)[0] * 1.2))  # a foot over the line
    assert np.isnan(jump_length(BODY, t[:200], qpos[:200]))  # it never lands
    assert np.isnan(jump_length(BODY, t, translated(x, 0 * z)))  # it never flies


def test_under_or_beside_the_bar_is_no_height():
    t = np.linspace(0, 1, 101)
    over = translated(19.0 + 2.0 * t, np.full(101, 1.0))
    over[:, 1] = 6.0
    assert cleared_height(BODY, t, over) == pytest.approx(1.0, abs=0.004)
    assert np.isnan(cleared_height(BODY, t, over - np.eye(7 + N)[1] * 3.0))
    assert np.isnan(cleared_height(BODY, t[:40], over[:40]))
    low = translated(19.0 + 2.0 * t, np.full(101, 0.05))
    low[:, 1] = 6.0
    assert np.isnan(cleared_height(BODY, t, low))  # it walks through any bar that can be set


def test_kinematics_are_mujocos():
    rng = np.random.default_rng(1)
    model = build_model(BODY)
    data = mujoco.MjData(model)
    qpos = translated(np.array([1.0, 2.0]), np.array([0.3, 0.4]))
    qpos[:, 3:7] = (0.6, 0.0, 0.8, 0.0)
    qpos[:, 7:] = rng.uniform(-1, 1, (2, N))
    pos, quat = link_poses(BODY, qpos)
    for t in range(2):
        data.qpos[:] = qpos[t]
        mujoco.mj_forward(model, data)
        assert np.abs(pos[t] - data.xpos[1:]).max() < 1e-12
        assert np.abs(np.abs(np.sum(quat[t] * data.xquat[1:], 1)) - 1).max() < 1e-12
    # The lowest support point is where MuJoCo's plane contact finds it.
    sunk = translated(np.zeros(1), np.full(1, -0.01))
    data.qpos[:] = sunk[0]
    mujoco.mj_forward(model, data)
    deepest = min(contact.dist for contact in data.contact if 0 in contact.geom)
    assert lowest(BODY, sunk)[0] == pytest.approx(deepest, abs=1e-6)


QUICK = Tracking(worlds=4, horizon=4, iterations=1)


def test_a_certified_motion_that_succeeds_in_its_task_is_a_demonstration(tmp_path):
    """Thrown over the bar, the athlete lands beyond it, and the task says that the bar stayed."""
    found = demonstrate(thrown(), QUICK)
    assert found.passed and found.clip is not None and found.reason == ""
    assert found.clip.meta["achieved"]["bar_height"] == 1.0
    assert found.clip.duration > 0.5  # past the plan's end, until the task had decided
    save_demonstration(found, tmp_path / "demo.npz", tmp_path / "certificate.json")
    assert Certificate.from_json(tmp_path / "certificate.json").passed
    clip = Clip.load(tmp_path / "demo.npz")
    again, metrics = play(clip, "high_jump", {"bar_height": 1.0}, BODY)
    assert metrics["success"] == 1.0 and again.num_frames == clip.num_frames


def test_what_the_gate_refuses_is_not_tracked():
    found = demonstrate(thrown(asked={"bar_height": 1.6}), QUICK)
    assert not found.passed and found.clip is None
    assert "clearance over the bar" in found.reason
