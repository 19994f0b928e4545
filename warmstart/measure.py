"""What an optimised motion costs and how it leaves the ground, in figures to compare motions by.

Everything is computed from the :class:`Solution` alone; heights and speeds are MuJoCo's.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from sports.humanoid.mjcf import build_model
from warmstart.solution import Solution


def joint_torque(solution: Solution) -> np.ndarray:
    """(K, num_dofs) torque at each hinge (N m): the servo's less the passive damping."""
    return solution.torque - solution.body.array("kd") * solution.qvel[:, 6:]


def effort(solution: Solution) -> float:
    """Integral of the summed squares of the servo torques, each over its limit (s), trapezoid."""
    share = solution.torque / solution.body.array("effort")
    return float(np.trapezoid((share**2).sum(axis=1), solution.times))


def peak_torques(solution: Solution) -> dict[str, float]:
    """Largest torque (N m, as a magnitude) at each hinge, by its name."""
    peak = np.abs(joint_torque(solution)).max(axis=0)
    return {dof.name: float(value) for dof, value in zip(solution.body.dofs, peak, strict=True)}


def center_of_mass(solution: Solution, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3) positions (m) and velocities (m/s) of the athlete's centre of mass, world frame."""
    motion = solution.sample(times)
    model = build_model(solution.body)
    data = mujoco.MjData(model)
    root = model.body_rootid[model.nbody - 1]
    position, velocity = [], []
    for qpos, qvel in zip(motion["qpos"], motion["qvel"], strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        position.append(data.subtree_com[root].copy())
        velocity.append(data.subtree_linvel[root].copy())
    return np.array(position), np.array(velocity)


def takeoff(solution: Solution) -> dict[str, float]:
    """How the motion leaves the ground; empty for one that has no flight after a stance.

    ``takeoff_speed`` (m/s) and ``takeoff_angle`` (degrees above the horizontal) of the centre of
    mass and its ``takeoff_height`` (m) at the first knot of the flight, ``entry_speed`` (m/s), its
    forward speed at the first knot of the motion, ``contact_time`` and ``flight_time`` (s).
    """
    for before, phase in zip(solution.phases, solution.phases[1:]):
        if before[3] and not phase[3]:
            _, first, last, _ = phase
            break
    else:
        return {}
    times = solution.times
    position, velocity = center_of_mass(solution, times[[0, first]])
    along, up = float(np.hypot(*velocity[1, :2])), float(velocity[1, 2])
    return {
        "takeoff_speed": math.hypot(along, up),
        "takeoff_angle": math.degrees(math.atan2(up, along)),
        "takeoff_height": float(position[1, 2]),
        "entry_speed": float(velocity[0, 0]),
        "contact_time": float(times[first] - times[0]),
        "flight_time": float(times[last] - times[first]),
    }


def figures(solution: Solution) -> dict[str, float]:
    """The figures of a table row: effort, peak torque, take-off, and what the solver reported.

    ``effort`` (s), ``peak_torque`` (N m) of any hinge, ``peak_share`` (largest servo torque over
    its limit), those of :func:`takeoff`, ``duration`` (s), and where the solver told them
    ``cost``, ``solve_s``, ``cpu_s``, ``iterations``, ``violation`` (scaled), ``variables``.
    """
    out = {
        "effort": effort(solution),
        "peak_torque": max(peak_torques(solution).values()),
        "peak_share": float(np.abs(solution.torque / solution.body.array("effort")).max()),
        "duration": solution.duration,
        **takeoff(solution),
    }
    told = {"objective": "cost", "max_violation": "violation"}
    told |= {name: name for name in ("solve_s", "cpu_s", "iterations", "variables")}
    for name, here in told.items():
        value = solution.stats.get(name)
        if isinstance(value, int | float) and math.isfinite(value):
            out[here] = value
    return out
