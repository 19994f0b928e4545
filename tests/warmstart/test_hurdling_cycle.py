"""A stride cycle over a hurdle: a recorded solution by other code, the gate, the second opinion.

``data/hurdling_cycle_1.067_human.npz`` was written by ``Solution.save``. Make it again when the
body table or the strengths change.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sports import hurdling as task
from sports.humanoid.body import load_body
from sports.humanoid.mjcf import body_name, build_model
from sports.physics.base import GRAVITY
from sports.scene import humanoid_scene
from tests.warmstart.hurdle_gap import gap_to_hurdle
from tests.warmstart.test_hurdling_problem import hop
from warmstart.bank import demonstration_files
from warmstart.certificate import Certificate, certify, required
from warmstart.clip import Clip
from warmstart.demonstration import name_of
from warmstart.drake_nlp import second_opinion
from warmstart.outcome import OUTCOMES, cleared_hurdle
from warmstart.solution import Solution
from warmstart.stance_program import StanceProgram, stances, take_off

BODY = load_body("smpl")
ASKED = {"hurdle_height": 0.45, "run_speed": 2.0 / 0.6, "stride_cycle": 1.0}


@pytest.fixture(scope="module")
def cycle() -> Solution:
    return Solution.load(Path(__file__).parent / "data" / "hurdling_cycle_1.067_human.npz")


def feet_down(qpos: np.ndarray, depth: float) -> list[str]:
    """Per frame, which feet are nearer to the ground than ``depth`` (m), by MuJoCo's collisions;
    ``X`` for any other link."""
    scene = humanoid_scene(BODY)
    model = build_model(scene)
    data = mujoco.MjData(model)
    plane = next(g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE)
    sides = {}
    for link in BODY.link_names:
        i = model.body(body_name(0, link)).id
        side = link[0] if link[2:] in ("Ankle", "Toe") else "X"
        first = model.body_geomadr[i]
        sides |= dict.fromkeys(range(first, first + model.body_geomnum[i]), side)
    out = []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        near = {
            side
            for geom, side in sides.items()
            if mujoco.mj_geomDistance(model, data, plane, geom, 1.0, None) < depth
        }
        out.append("".join(sorted(near)))
    return out


def whole(solution: Solution, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3) place (m) and velocity (m/s) of the centre of mass, by MuJoCo."""
    model = build_model(BODY)
    data = mujoco.MjData(model)
    motion, rows = solution.sample(times), []
    for q, v in zip(motion["qpos"], motion["qvel"], strict=True):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        rows.append((data.subtree_com[1].copy(), data.subtree_linvel[1].copy()))
    place, velocity = (np.array(x) for x in zip(*rows, strict=True))
    return place, velocity


def at(solution: Solution, phase: str) -> tuple[float, float]:
    """Begin and end of a phase (s)."""
    return next(
        (solution.times[a], solution.times[b]) for n, a, b, _ in solution.phases if n == phase
    )


def test_it_is_a_whole_cycle_from_foot_to_foot(cycle):
    """Left, air, right, air, left: what stands is nearer than 1 mm to the ground in MuJoCo, and
    nothing but feet comes within 2 cm of it."""
    middle = 0.5 * (cycle.times[1:] + cycle.times[:-1])
    down = feet_down(cycle.sample(middle)["qpos"], 1e-3)
    order = [side for i, side in enumerate(down) if i == 0 or side != down[i - 1]]
    assert order == ["L", "", "R", ""]
    assert all("X" not in side for side in feet_down(cycle.sample(middle)["qpos"], 0.02))
    last = cycle.sample(cycle.times[-1:])["qpos"]
    assert feet_down(last, 5e-3) == ["L"]


def test_it_runs_on_at_its_speed_and_clear_of_the_hurdle(cycle):
    times = np.linspace(0.0, cycle.duration, 400)
    gap = gap_to_hurdle(BODY, cycle.sample(times)["qpos"], cycle.asked["hurdle_height"])
    _, velocity = whole(cycle, np.array([0.0, at(cycle, "land")[0], cycle.duration]))
    print(f"least distance {gap.min():.4f} m, speeds {velocity[:, 0].round(2)} m/s")
    assert gap.min() > 0.0
    assert abs(velocity[0, 0] - cycle.asked["run_speed"]) < 0.051
    assert (np.abs(velocity[1:, 0] - cycle.asked["run_speed"]) < 0.401).all()
    place, _ = whole(cycle, np.array([0.0, cycle.duration]))
    assert place[0, 0] < task.FIRST_X - 1.5 and place[1, 0] > task.FIRST_X + 2.0


def test_the_ground_pushes_as_hard_as_the_momentum_changes(cycle):
    """Impulse of the contact forces and of the weight in the stance of the lead leg against the
    change of MuJoCo's momentum; both are linear in between, so trapezoids are exact."""
    begin, end = at(cycle, "land")
    times = np.unique(np.concatenate([cycle.times, [begin, end]]))
    times = times[(times >= begin) & (times <= end)]
    force = cycle.sample(times)["contact_force"].sum(1)
    impulse = np.trapezoid(force, times, axis=0) - [0, 0, BODY.mass * GRAVITY * (end - begin)]
    _, velocity = whole(cycle, np.array([begin, end]))
    np.testing.assert_allclose(impulse, BODY.mass * (velocity[1] - velocity[0]), atol=1.0)
    assert impulse[2] > BODY.mass * 0.5  # it is thrown up again
    right = [link.startswith("R_Toe") for link, _ in cycle.contact_points]
    inside = cycle.sample(0.5 * (times[1:] + times[:-1]))["contact_force"]
    assert np.abs(inside[:, ~np.array(right)]).max() == 0.0  # on the ball of the foot


def test_the_gate_asks_more_of_a_cycle_and_passes_this_one(cycle):
    certificate = certify(cycle)
    figures = {c.name: c.value for c in certificate.checks}
    more = set(required("hurdling", cycle=True)) - set(required("hurdling"))
    print({name: round(figures[name], 3) for name in more}, certificate.achieved)
    assert certificate.passed, certificate.failures
    assert len(more) == 4 and more < set(figures)
    land, step = at(cycle, "land"), at(cycle, "step")
    assert land[1] - land[0] < figures["stance of the lead leg"] < land[1] - land[0] + 0.06
    model, toes = build_model(BODY), []
    for time, foot in ((land[0], "R_Toe"), (step[1], "L_Toe")):
        data = mujoco.MjData(model)
        data.qpos[:] = cycle.sample(np.array([time]))["qpos"][0]
        mujoco.mj_kinematics(model, data)
        toes.append(data.xpos[model.body(body_name(0, foot)).id, 0])
    assert figures["length of the next step"] == pytest.approx(toes[1] - toes[0], abs=0.01)
    assert name_of(cycle) == "hurdling_1.067m_cycle_human"


def test_a_cycle_that_stops_at_the_landing_does_not_pass(cycle):
    """Cut off there it is a stride, and no certificate of a cycle."""
    last = cycle.phases[2][2]
    fields = ("times", "qpos", "qvel", "qacc", "torque", "contact_force")
    cut = {name: getattr(cycle, name)[: last + 1] for name in fields}
    stride = replace(cycle, **cut, phases=cycle.phases[:3])
    rules = OUTCOMES["hurdling"].rules
    qpos = stride.sample(stride.times)["qpos"]
    found = rules(BODY, stride.times, qpos, cycle.asked)
    assert set(found) == set(rules(BODY, stride.times, qpos, {**cycle.asked, "stride_cycle": 0.0}))
    cleared = cleared_hurdle(BODY, stride.times, qpos)
    whole_motion = cleared_hurdle(BODY, cycle.times, cycle.qpos)
    assert cleared == pytest.approx(whole_motion, abs=0.003)


def step_after(feet: str, lift: float = 0.1, x: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """A hop over the hurdle from foot to foot, and one more: of ``feet`` (3) in order."""
    t, qpos = hop(feet[:2])
    more = np.arange(1, 41) / 100
    after = np.repeat(qpos[-1:], len(more), axis=0)
    after[:, 0] += x * more / 0.6
    air = (more > 0.12) & (more < 0.3)
    after[air, 2] += lift
    landed = after[more >= 0.3]
    landed[:, 7:] = 0.0
    for other in set("LR") - set(feet[2]):
        landed[:, 7 + BODY.dof_index(f"{other}_Knee_y")] = 1.0
    after[more >= 0.3] = landed
    return np.concatenate([t, t[-1] + more]), np.concatenate([qpos, after])


def test_hand_made_steps_after_a_hurdle_are_ruled():
    judge = OUTCOMES["hurdling"].judge
    assert judge is not None
    for feet in ("LRL", "RLR"):
        t, qpos = step_after(feet)
        found = judge(BODY, t, qpos, ASKED)
        assert found["success"] == 1.0
        assert found["next_speed"] == pytest.approx(2.0 / 0.6, abs=0.05)
        assert found["next_step"] == pytest.approx(2.0 / 0.6 * 0.18, abs=0.04)
    for t, qpos in (step_after("LRR"), step_after("LRL", lift=0.0), step_after("LRL", x=1.0)):
        assert judge(BODY, t, qpos, ASKED)["success"] == 0.0
        stride = {k: v for k, v in ASKED.items() if k != "stride_cycle"}
        assert judge(BODY, t, qpos, stride)["success"] == 1.0


def test_both_stances_are_optimal_by_drakes_derivatives(cycle):
    """And the take-off broke the pose boxes of the jumps, which SNOPT was given before."""
    both = stances(cycle)
    assert [s.first for s in both] == [0, cycle.phases[3][1]] and take_off(cycle) == both[0]
    for stance in both:
        program = StanceProgram(cycle, stance=stance)
        x = program.reference_point()
        assert program.violation(x) < 1e-5
        assert program.stationarity(x) < 2e-2
    jumps = replace(cycle, stats={k: v for k, v in cycle.stats.items() if k != "boxes"})
    program = StanceProgram(jumps)
    assert program.violation(program.reference_point()) > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1])
def test_snopt_betters_neither_stance(cycle, which, capsys):
    opinion = second_opinion(cycle, stance=stances(cycle)[which])
    with capsys.disabled():
        print(f"\n{opinion.sentence()}")
    assert opinion.agrees and opinion.violation < 1e-5 and abs(opinion.improvement) < 0.01


def test_shipped_cycles_run_on_in_mujoco():
    """The clips, by MuJoCo's collisions and closed-form distances."""
    files = [path for path in demonstration_files("hurdling") if "_cycle_" in path.stem]
    assert files
    for path in files:
        clip, certificate = Clip.load(path), Certificate.from_json(path.with_suffix(".json"))
        assert certificate.passed and clip.meta["certified"] is True
        achieved = clip.meta["achieved"]
        assert achieved["success"] == 1.0
        down = feet_down(clip.qpos, 5e-3)
        down = down[down.index("") - 1 :]  # from the last frame on the take-off foot
        order = [side for i, side in enumerate(down) if i == 0 or side != down[i - 1]]
        assert order[:5] == ["L", "", "R", "", "L"]
        gap = gap_to_hurdle(BODY, clip.resample(240.0).qpos, clip.meta["asked"]["hurdle_height"])
        assert gap.min() > -0.005
        place = clip.qpos[-1, 0] - clip.qpos[0, 0]
        assert place / clip.duration > 0.8 * clip.meta["asked"]["run_speed"]
