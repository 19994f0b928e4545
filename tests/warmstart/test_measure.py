"""Figures of a motion against the laws of a flight and closed forms."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sports.physics.base import GRAVITY
from warmstart.measure import center_of_mass, effort, figures, joint_torque, peak_torques, takeoff
from warmstart.solution import Solution

DATA = Path(__file__).parent / "data"


@pytest.mark.parametrize("name", ["high_jump_1.0_human", "long_jump_5.0_human"])
def test_the_flight_follows_from_the_take_off(name: str):
    """Whatever the limbs do, the centre of mass flies on the parabola of speed, angle, height."""
    solution = Solution.load(DATA / f"{name}.npz")
    off = takeoff(solution)
    first, last = next((a, b) for phase, a, b, _ in solution.phases if phase == "flight")
    times = solution.times[first : last + 1]
    position, _ = center_of_mass(solution, times)
    t, angle = times - times[0], math.radians(off["takeoff_angle"])
    rise = off["takeoff_speed"] * math.sin(angle)
    along = off["takeoff_speed"] * math.cos(angle)
    height = off["takeoff_height"] + rise * t - 0.5 * GRAVITY * t**2
    np.testing.assert_allclose(position[:, 2], height, atol=2e-3)
    ground = np.hypot(*(position - position[0])[:, :2].T)
    np.testing.assert_allclose(ground, along * t, atol=5e-3)
    assert off["flight_time"] == pytest.approx(t[-1])
    assert off["contact_time"] == pytest.approx(times[0] - solution.times[0])


def test_effort_and_torques_of_known_motions():
    solution = Solution.load(DATA / "high_jump_1.0_human.npz")
    body, still = solution.body, np.zeros_like(solution.qvel)
    half = np.tile(0.5 * body.array("effort"), (len(solution.times), 1))
    half[:, 0] *= -1.0
    made = replace(solution, qvel=still, torque=half)
    assert effort(made) == pytest.approx(0.25 * body.num_dofs * solution.duration)
    peaks = peak_torques(made)
    assert peaks[body.dofs[0].name] == pytest.approx(0.5 * body.dofs[0].effort)
    assert len(peaks) == body.num_dofs
    assert figures(made)["peak_share"] == pytest.approx(0.5)
    # A hinge that turns with 2 rad/s loses 2 kd of its servo's torque.
    turning = replace(made, qvel=still + 2.0)
    lost = joint_torque(made) - joint_torque(turning)
    np.testing.assert_allclose(lost, np.broadcast_to(2.0 * body.array("kd"), lost.shape))


def test_twice_the_torque_is_four_times_the_effort():
    solution = Solution.load(DATA / "long_jump_5.0_human.npz")
    twice = replace(solution, torque=2.0 * solution.torque)
    assert effort(twice) == pytest.approx(4.0 * effort(solution))


def test_a_motion_without_a_flight_has_no_take_off():
    solution = Solution.load(DATA / "high_jump_1.0_human.npz")
    standing = replace(solution, phases=tuple((n, a, b, (0,)) for n, a, b, _ in solution.phases))
    assert takeoff(standing) == {}
    assert "takeoff_speed" not in figures(standing)
