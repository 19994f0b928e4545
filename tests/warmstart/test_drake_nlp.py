"""The second opinion: a reduced Drake plant against the CasADi recursion, SNOPT against IPOPT.

``data/*.npz`` are solutions of the two problems (bar 1.0 m, length 5 m, strength human), written
by ``Solution.save``; the limits they were solved with are frozen here. Make them again when the
body table or the strengths change.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

ca = pytest.importorskip("casadi")
pytest.importorskip("pydrake")

# ruff: noqa: E402
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff

from sports.humanoid.body import load_body
from warmstart.drake_nlp import second_opinion
from warmstart.reduced_plant import ReducedPlant
from warmstart.rigid_body import load_tree, reduce_tree, root_rate_matrix
from warmstart.solution import Solution
from warmstart.stance_program import StanceProgram, take_off
from warmstart.transcription import Weights

DATA = Path(__file__).parent / "data"
HELD = (
    *(f"{side}_Knee_{axis}" for side in "LR" for axis in "xz"),
    *(f"{side}_Thorax_{axis}" for side in "LR" for axis in "xyz"),
    *(f"{side}_{dof}" for side in "LR" for dof in ("Ankle_z", "Toe_x", "Toe_z")),
    *("Spine_x", "Spine_y", "Spine_z", "Chest_x", "Chest_z", "Neck_y", "Head_y"),
)
"""Held hinges whose torque the two problems limited."""
FREE = ("L_Hip_x", "L_Hip_y", "L_Knee_y", "R_Hip_y", "R_Hip_z", "Torso_y", "L_Shoulder_y")
FREE += ("R_Elbow_z", "L_Toe_y")
POSE = {"L_Shoulder_x": -1.2, "L_Shoulder_z": 0.4, "R_Elbow_y": 0.3, "R_Hip_x": 0.2}
WATCHED = ("L_Hip_z", "R_Hip_x", "L_Ankle_y", "Spine_x", "R_Elbow_y")
FORCES = (("L_Toe", (0.05, 0.02, -0.03)), ("R_Wrist", (0.0, -0.05, 0.01)))


@pytest.fixture(scope="module", params=["high_jump_1.0", "long_jump_5.0"])
def solution(request) -> Solution:
    return Solution.load(DATA / f"{request.param}_human.npz")


def random_motion(n: int, seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.7, 0.7, n), rng.normal(size=n), 5 * rng.normal(size=n)


def test_reduced_plant_is_the_casadi_recursion(capsys):
    """Generalised forces with contact forces, held hinges before, between and after free ones."""
    body = load_body()
    plant = ReducedPlant(body, FREE, POSE, watched=WATCHED)
    recursion = reduce_tree(load_tree(body), FREE, POSE)
    assert plant.names == recursion.names
    x = [ca.SX.sym(name, recursion.n) for name in "qva"]
    f = ca.SX.sym("f", 3, len(FORCES))
    applied = [(recursion.tree.link(b), p, f[:, i]) for i, (b, p) in enumerate(FORCES)]
    function = ca.Function("tau", [*x, f], [recursion.inverse_dynamics(*x, applied)])
    worst = 0.0
    for seed in range(20):
        q, v, a = random_motion(plant.n, seed)
        forces = np.random.default_rng(seed).normal(scale=300.0, size=(len(FORCES), 3))
        tau = plant.inverse_dynamics(
            q, v, a, [(*where, force) for where, force in zip(FORCES, forces, strict=True)]
        )
        full = np.array(function(q, v, a, forces.T)).ravel()
        # The recursion gives the root moment in B; its power in (pitch, roll, yaw) rates is E' n.
        E = np.array(ca.DM(root_rate_matrix(ca.SX(q[4]), ca.SX(q[5]))))
        held = full[[6 + recursion.tree.dofs.index(name) for name in plant.watched]]
        expected = np.concatenate([full[:3], E.T @ full[3:6], full[6 + recursion.free_index], held])
        worst = np.maximum(worst, np.abs(tau - expected).max() / np.abs(expected).max())
    with capsys.disabled():
        print(f"\nreduced Drake plant against the CasADi recursion, 20 states: {worst:.1e}")
    assert worst < 1e-9


def test_sagittal_plant_is_the_full_one_in_its_plane():
    body = load_body()
    free = ("L_Hip_y", "L_Knee_y", "R_Hip_y", "R_Ankle_y", "Torso_y")
    plane = ReducedPlant(body, free, {}, root=("x", "z", "pitch"))
    space = ReducedPlant(body, free, {})
    keep = [space.names.index(name) for name in plane.names]
    q, v, a = random_motion(plane.n, 3)
    big = [np.zeros(space.n) for _ in range(3)]
    for full, part in zip(big, (q, v, a), strict=True):
        full[keep] = part
    np.testing.assert_allclose(
        plane.inverse_dynamics(q, v, a), space.inverse_dynamics(*big)[keep], atol=1e-9
    )


def test_autodiff_gradient_is_the_finite_difference():
    plant = ReducedPlant(load_body(), FREE, POSE)
    n = plant.n
    x = np.concatenate(random_motion(n, 1))

    def tau(x):
        return plant.inverse_dynamics(x[:n], x[n : 2 * n], x[2 * n :])

    gradient = ExtractGradient(tau(InitializeAutoDiff(x).ravel()))
    h, rng = 1e-6, np.random.default_rng(0)
    for _ in range(3):
        d = rng.normal(size=3 * n)
        difference = (tau(x + h * d) - tau(x - h * d)) / (2 * h)
        np.testing.assert_allclose(gradient @ d, difference, atol=1e-4 * np.abs(difference).max())


def test_the_take_off_is_optimal_by_drakes_derivatives_and_by_snopt(solution, capsys):
    opinion = second_opinion(solution, held_limits=HELD)
    with capsys.disabled():
        print(f"\n{solution.problem} {solution.asked}: {opinion.sentence()}")
    assert opinion.reference_violation < 1e-5
    assert opinion.stationarity < 1e-2
    assert opinion.violation < 1e-5
    assert abs(opinion.improvement) < 0.01
    assert opinion.agrees


def test_another_cost_is_told_apart(solution):
    """Negative control: with other weights the same motion is not stationary."""
    own = StanceProgram(solution, held_limits=HELD)
    other = StanceProgram(
        solution, Weights(torque_rate=2e-2, acceleration_rate=1e-3), held_limits=HELD
    )
    figures = [p.stationarity(p.reference_point()) for p in (own, other)]
    assert figures[1] > 5 * figures[0]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_cold_start_finds_nothing_cheaper():
    """From cubics and no torque SNOPT becomes feasible, and does not beat the optimised motion.

    The high jump only: on the long jump it is not feasible within these iterations.
    """
    solution = Solution.load(DATA / "high_jump_1.0_human.npz")
    opinion = second_opinion(solution, cold=True, iterations=120, held_limits=HELD)
    assert opinion.start_violation > 0.1
    assert opinion.violation < 1e-3
    assert opinion.improvement < 0.02


def test_wrong_torques_do_not_pass(solution):
    stance = StanceProgram(replace(solution, torque=1.05 * solution.torque))
    assert stance.violation(stance.reference_point()) > 1e-2


def test_a_solution_without_flight_is_refused(solution):
    standing = replace(solution, phases=(("flat", 0, len(solution.times) - 1, (0, 1)),))
    with pytest.raises(ValueError, match="no flight after a stance"):
        take_off(standing)


def test_unknown_hinge_is_named():
    with pytest.raises(ValueError, match="no hinge 'Tail_x'"):
        ReducedPlant(load_body(), ("Tail_x",), {})
