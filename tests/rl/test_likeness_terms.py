from dataclasses import replace

import mujoco
import numpy as np
import pytest

from rl.evaluate import evaluate
from rl.likeness_motion import Drive, from_recording, moving_dofs
from rl.likeness_terms import (
    TORQUE_RISE,
    effort,
    figures,
    leg_power,
    log_dimensionless_jerk,
    path,
    skating,
)
from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from sports.physics.base import Geometry
from tests.rl.motions_still import BODY, lifted, slid, standing, swinging, turned
from warmstart.library import FPS

ARMS = ("L_Shoulder_x", "R_Shoulder_x")


def line(x: np.ndarray) -> np.ndarray:
    return np.stack((x, np.zeros_like(x), np.zeros_like(x)), 1)


def test_a_minimum_jerk_reach_has_the_jerk_of_its_formula() -> None:
    # Flash and Hogan 1985: the integral of squared jerk is 720 A^2 / D^5, the peak speed 15/8 A/D.
    t = np.linspace(0.0, 1.0, 3001)
    for reach, duration in ((0.4, 1.0), (3.0, 1.0), (0.4, 0.5)):
        x = reach * (10 * t**3 - 15 * t**4 + 6 * t**5)
        found = log_dimensionless_jerk(line(x), 3000.0 / duration)
        assert found == pytest.approx(np.log(720.0 / (15.0 / 8.0) ** 2), abs=5e-3)


def test_jitter_raises_the_jerk_by_the_factor_of_its_third_differences() -> None:
    t = np.arange(3001) / FPS
    slow, fast, amplitude = 1.0, 10.0, 0.003

    def third(hertz: float) -> float:
        return (2.0 * np.sin(np.pi * hertz / FPS)) ** 3

    smooth = 0.2 * np.sin(2 * np.pi * slow * t)
    rough = smooth + amplitude * np.sin(2 * np.pi * fast * t)
    factor = 1.0 + (amplitude * third(fast) / (0.2 * third(slow))) ** 2
    peaks = [np.abs(np.diff(x)).max() for x in (smooth, rough)]
    found = log_dimensionless_jerk(line(rough), FPS) - log_dimensionless_jerk(line(smooth), FPS)
    assert factor > 10.0
    assert found == pytest.approx(np.log(factor) - 2.0 * np.log(peaks[1] / peaks[0]), abs=0.01)


def test_what_rests_has_no_jerk() -> None:
    assert np.isnan(log_dimensionless_jerk(line(np.full(31, 1.0)), FPS))
    assert np.isnan(figures(standing())["jerk"])


def test_jerk_of_a_motion_does_not_depend_on_a_steady_run_and_grows_with_jitter() -> None:
    swing = swinging(standing(), 0.6, 1.0, ARMS)
    rough = swinging(swing, 0.02, 12.0, ARMS)
    still, running = figures(swing)["jerk"], figures(slid(swing, 9.0))["jerk"]
    assert running == pytest.approx(still, abs=1e-6)
    assert figures(rough)["jerk"] > still + 2.0


def test_a_foot_that_is_carried_slides_at_that_speed() -> None:
    assert figures(standing())["skating"] == 0.0
    for speed in (0.5, 2.0):
        moved = figures(slid(swinging(standing(), 0.6, 1.0, ARMS), speed))
        assert moved["skating"] == pytest.approx(speed, rel=1e-4)
    assert np.isnan(figures(slid(lifted(standing(), 0.02), 0.5))["skating"])


def test_a_foot_that_turns_on_a_point_does_not_slide() -> None:
    motion = standing()
    geometry = Geometry(BODY, "cpu")
    links = path(motion)
    import torch

    pos, quat = (torch.tensor(x[0], dtype=torch.float32) for x in (links.pos, links.quat))
    points = geometry.world_points(pos, quat).double().numpy()
    height = points[:, 2] - geometry.radii.double().numpy()
    left, right = (
        points[
            np.isin(geometry.owner, [BODY.link_index(s + n) for n in ("Ankle", "Toe")])
            & (height < 0.03)
        ]
        for s in ("L_", "R_")
    )
    pivot = left[0, :2]
    rate = 0.5
    chord = 2.0 * np.sin(rate / FPS / 2.0) * FPS
    nearest = np.linalg.norm(right[:, :2] - pivot, axis=1).min()
    found = skating(BODY, path(turned(motion, rate, pivot)))
    assert found == pytest.approx(
        chord * nearest / 2.0, rel=1e-3
    )  # mean of a still and a slid foot


def test_a_foot_that_is_down_for_two_frames_only_counts_not() -> None:
    qpos = lifted(slid(standing(), 3.0), 0.1).qpos
    for frames, slides in ((2, False), (3, True)):
        path_ = qpos.copy()
        path_[40 : 40 + frames, 2] -= 0.1
        found = figures(replace(standing(), qpos=path_))["skating"]
        assert np.isnan(found) != slides
        if slides:
            assert found == pytest.approx(3.0, rel=1e-3)


def test_sinking_is_measured_in_metres() -> None:
    assert figures(standing())["penetration"] < 1e-6
    assert figures(lifted(standing(), -0.02))["penetration"] == pytest.approx(0.02, abs=1e-5)
    assert figures(lifted(standing(), 0.3))["penetration"] == 0.0


def test_effort_is_measured_in_the_limits_of_the_human_table() -> None:
    human = load_body("smpl", strength="human")
    limit = human.array("effort")
    knee = human.dof_index("L_Knee_y")
    torque, speed = np.zeros((40, 2, 69)), np.zeros((40, 2, 69))
    torque[::2, :, knee] = 150.0
    found = effort(BODY, Drive(torque, speed, 1 / 30))
    assert found["torque"] == pytest.approx(150.0 / 300.0)
    assert found["torque_rate"] == pytest.approx(150.0 * 30.0 / (TORQUE_RISE * limit[knee]))
    assert found["torque_per_kg"] == pytest.approx(150.0 / human.mass)
    assert found["power"] == 0.0

    # All extensors at half of their no-load speeds on the torque-speed line: the limit itself.
    table = {"Hip": (300.0, 18.0), "Knee": (300.0, 20.0), "Ankle": (220.0, 18.0)}
    torque, speed = np.zeros((40, 2, 69)), np.zeros((40, 2, 69))
    for side in ("L_", "R_"):
        for name, (strength, fastest) in table.items():
            dof = human.dof_index(f"{side}{name}_y")
            torque[..., dof], speed[..., dof] = strength / 2.0, fastest / 2.0
    found = effort(BODY, Drive(torque, speed, 1 / 30))
    assert found["power"] == pytest.approx(1.0)
    assert found["torque"] == pytest.approx(1.0)
    assert leg_power("smpl") == pytest.approx(2 * (300 * 18 + 300 * 20 + 220 * 18) / 4)
    backwards = effort(BODY, Drive(torque, -speed, 1 / 30))  # it brakes: no power is given
    assert backwards["power"] == 0.0


@pytest.mark.parametrize("strength", ["paper", "human"])
def test_torques_of_an_episode_are_those_that_mujoco_applies(strength: str) -> None:
    played = evaluate(
        "random",
        "long_jump",
        trials=1,
        num_worlds=1,
        strength=strength,
        record_worlds=(0,),
    )
    recording = played.recordings["world_0"]
    (motion,) = from_recording(recording)
    drive = motion.drive
    assert drive is not None
    body = recording.scene.body
    model = build_model(body)
    data = mujoco.MjData(model)
    scale, offset = body.action_scale(), recording.scene.action_offset()
    for step in range(len(drive.torque)):
        for end in (0, 1):
            data.qpos[:] = recording.qpos[step + end, : model.nq]
            data.qvel[:] = recording.qvel[step + end, : model.nv]
            data.ctrl[:] = offset + scale * np.clip(recording.action[step + 1, 0], -1, 1)
            mujoco.mj_forward(model, data)
            want = (data.qfrc_actuator + data.qfrc_damper)[6:]
            np.testing.assert_allclose(
                drive.torque[step, end], want[moving_dofs(body)], rtol=1e-4, atol=1e-3
            )
    share = figures(motion)["torque"]
    assert share <= 1.0 + 1e-6 if strength == "human" else share > 2.0


def test_hands_and_ligaments_do_not_judge_the_torque() -> None:
    human = load_body("smpl", strength="human")
    torque, speed = np.zeros((40, 2, 69)), np.zeros((40, 2, 69))
    for name in ("L_Hand_x", "R_Toe_y", "L_Knee_x"):
        torque[..., human.dof_index(name)] = 400.0
    assert effort(BODY, Drive(torque, speed, 1 / 30))["torque"] == 0.0
    torque[..., human.dof_index("R_Wrist_x")] = 30.0
    assert effort(BODY, Drive(torque, speed, 1 / 30))["torque"] == pytest.approx(1.5)
