"""Tracking a hop that was simulated elsewhere, at a finer step and with targets set every ms."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from sports.physics import PhysicsState, make_physics
from sports.scene import humanoid_scene
from warmstart.clip import Clip
from warmstart.replay import play, scene_of
from warmstart.tracking import Tracking, Worlds, track

BODY = load_body("smpl", strength="human")
LIGHT = Tracking(worlds=24, horizon=8, knot_every=2, iterations=2, noise=0.2)


@pytest.fixture(scope="module")
def hop() -> Clip:
    """A squat, an extension and a flight at 960 Hz, kept at 30 Hz."""
    model = build_model(humanoid_scene(BODY, timestep=1 / 960, substeps=1))
    data = mujoco.MjData(model)
    index, rows = BODY.dof_index, []
    for step in range(1025):
        t, ctrl = step / 960, np.zeros(BODY.num_dofs)
        down = min(1.0, t / 0.3)
        crouch = np.interp(t, [0, 0.35, 0.45, 0.6], [0, 1, 1, 0])
        ctrl[index("L_Shoulder_x")], ctrl[index("R_Shoulder_x")] = -1.2 * down, 1.2 * down
        for side in "LR":
            ctrl[index(f"{side}_Hip_y")] = -1.1 * crouch
            ctrl[index(f"{side}_Knee_y")] = 1.7 * crouch
            ctrl[index(f"{side}_Ankle_y")] = -0.75 * crouch + 0.6 * (0.52 < t < 0.75)
        if step % 32 == 0:
            rows.append((data.qpos.copy(), data.qvel.copy(), ctrl))
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data)
    qpos, qvel, ctrl = (np.array(x) for x in zip(*rows))
    return Clip(30.0, "smpl", qpos, qvel, ctrl, {"strength": "human", "problem": "hop"})


@pytest.fixture(scope="module")
def tracked(hop):
    steps = []
    result = track(hop, settings=LIGHT, progress=lambda done, total: steps.append((done, total)))
    return result, steps


def test_the_reference_is_a_jump(hop):
    assert hop.qpos[:, 2].max() > 1.3 and hop.qpos[:, 2].min() < 0.7


def test_closed_loop_follows_closer_than_the_same_targets_open_loop(hop, tracked):
    open_loop = track(hop, settings=Tracking(worlds=2, iterations=0))
    result, _ = tracked
    assert result.link_error < 0.8 * open_loop.link_error
    assert result.root_error < 0.9 * open_loop.root_error
    # The height of the jump, which nothing but the take-off decides.
    assert result.clip.qpos[:, 2].max() == pytest.approx(hop.qpos[:, 2].max(), abs=0.05)


def test_progress_counts_every_control_step(hop, tracked):
    _, steps = tracked
    assert steps == [(i, hop.num_frames - 1) for i in range(1, hop.num_frames)]


def test_every_frame_follows_from_the_one_before_in_the_engine(tracked):
    """The worlds that candidates are simulated in are those that an environment has."""
    clip = tracked[0].clip
    scene = scene_of(clip)
    physics = make_physics("mujoco", scene, clip.num_frames - 1)
    state = PhysicsState(
        torch.tensor(clip.qpos[:-1], dtype=torch.float32),
        torch.tensor(clip.qvel[:-1], dtype=torch.float32),
        torch.zeros(clip.num_frames - 1, 0, 3),
    )
    physics.reset(torch.ones(clip.num_frames - 1, dtype=torch.bool), state)
    physics.step(torch.tensor(clip.ctrl[:-1], dtype=torch.float32))
    # The solver starts cold here: contact forces agree to its tolerance only.
    assert np.abs(physics.qpos.numpy() - clip.qpos[1:]).max() < 1e-3
    physics.close()


def test_a_flight_in_the_worlds_has_one_ballistic_path():
    """Thrown up and flailing: the momentum that tracking reads is that of a thrown stone."""
    scene = humanoid_scene(BODY)
    worlds = Worlds(scene, 2, threads=1)
    qpos, qvel = scene.default_qpos(), np.zeros(scene.nv)
    qpos[2], qvel[0], qvel[2] = 3.0, 2.0, 2.0
    start = worlds.kinematics(qpos[None], qvel[None])[2][0]
    worlds.put(2, qpos, qvel, np.zeros(scene.nv))
    rng = np.random.default_rng(0)
    for step in range(1, 19):
        worlds.step(rng.uniform(-1.5, 1.5, (2, BODY.num_dofs)))
        t = step * scene.control_timestep
        fallen = start[:6] + np.array([*start[3:5] * t, 0.0, 0.0, 0.0, -9.81 * t])
        fallen[2] += start[5] * t - 4.905 * t * (t + scene.timestep)  # semi-implicit steps
        measured = worlds.kinematics(worlds.qpos, worlds.qvel)[2]
        assert np.abs(measured[:, :3] - fallen[:3]).max() < 1e-3
        assert np.abs(measured[:, 3:6] - fallen[3:]).max() < 1e-3
        assert np.abs(measured - worlds.whole).max() < 1e-3


def test_targets_are_actions_that_a_policy_can_take(tracked):
    assert (np.abs(tracked[0].clip.ctrl) <= BODY.action_scale() + 1e-12).all()


def test_the_same_seed_gives_the_same_motion(hop):
    short = hop.cut(0.0, 0.2)
    one, two = (track(short, settings=LIGHT, threads=n).clip for n in (1, 2))
    assert np.array_equal(one.qpos, two.qpos) and np.array_equal(one.ctrl, two.ctrl)


def test_wrong_body_is_refused(hop):
    with pytest.raises(ValueError, match="of body 'smpl'"):
        track(hop, scene=humanoid_scene(load_body("smplx")))


def test_play_measures_by_the_rules_of_the_task(hop):
    """Standing still in front of the bar clears nothing; the task ends the episode itself."""
    still = hop.cut(0.0, 0.2).moved(x=18.0, y=6.0)
    clip, metrics = play(still, "high_jump", {"bar_height": 1.0}, BODY)
    assert metrics["success"] == 0.0 and metrics["bar_height"] == 1.0
    assert clip.num_frames > 10 and np.abs(clip.qpos[0] - still.qpos[0]).max() < 1e-5
