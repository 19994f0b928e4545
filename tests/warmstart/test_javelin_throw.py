"""The javelin throw of the task's own athlete: kinematics and torques by other means, and the
shipped throws by the rules of the task."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from sports.env import make_env, make_scene
from sports.humanoid.body import load_body
from sports.humanoid.hold import load_hold
from sports.humanoid.mjcf import body_name, build_model
from sports.javelin import AIM, HOLD_STEPS, RELEASE_STEPS
from sports.scene import humanoid_scene
from sports.starts import ELAPSED
from warmstart.bank import ClipBank, Window, thrown_files
from warmstart.clip import Clip
from warmstart.javelin_throw import BASE, UNITS, Thrower


@pytest.fixture(scope="module")
def thrower() -> Thrower:
    return Thrower("paper")


@pytest.fixture(scope="module")
def shipped() -> list[Clip]:
    return [Clip.load(path) for path in thrown_files("javelin")]


# The plan.


def test_the_hand_goes_along_the_line_without_turning(thrower):
    """By MuJoCo's kinematics of the poses: place of the palm and attitude of the hand."""
    scene, line = thrower.scene, thrower.line
    model = build_model(scene, sensors=False)
    data = mujoco.MjData(model)
    wrist = model.body(body_name(0, "R_Wrist")).id
    data.qpos[:] = scene.default_qpos()
    mujoco.mj_kinematics(model, data)
    first, attitude = data.xpos[wrist].copy(), data.xmat[wrist].copy()
    for along in (-0.7, -0.45, -0.2, 0.0):
        data.qpos[7 + line.dofs] = line.at(np.array([along]))[0]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.xpos[wrist] - first, along * np.array(AIM), atol=0.01)
        np.testing.assert_allclose(data.xmat[wrist], attitude, atol=0.05)


def test_the_torques_make_the_motion(thrower):
    """Newton's law from its parts: inertia times acceleration, bias and damping, the javelin in
    the hand and the root held still."""
    rng = np.random.default_rng(0)
    n = thrower.scene.body.num_dofs
    qpos, qvel, qacc = (s * rng.standard_normal((1, n)) for s in (0.05, 0.5, 5.0))
    torque = thrower.rig.torque(qpos, qvel, qacc)[0]
    body = load_body("smplx", equipment=["javelin"])
    model = build_model(humanoid_scene(body), sensors=False)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(model)
    data.qpos[:] = *thrower.scene.default_qpos()[:7], *qpos[0]
    data.qvel[6:] = qvel[0]
    mujoco.mj_forward(model, data)
    asked, inertial = np.concatenate([np.zeros(6), qacc[0]]), np.zeros(model.nv)
    mujoco.mj_mulM(model, data, inertial, asked)
    wanted = (inertial + data.qfrc_bias - data.qfrc_passive)[6:]
    np.testing.assert_allclose(torque, wanted, rtol=1e-6, atol=1e-6)


def test_the_targets_begin_in_the_hold_and_stay_in_reach_of_the_actions(thrower):
    body = thrower.scene.body
    hold = load_hold("javelin").targets(body)
    targets = thrower.targets(np.zeros(len(UNITS)), 40)
    offset, scale = thrower.scene.action_offset(), body.action_scale()
    assert (np.abs(targets - offset) <= scale + 1e-9).all()
    off = np.abs(targets[0] - [hold.get(dof.name, 0.0) for dof in body.dofs])
    assert off.max() < 0.1
    opens = round(30 * (BASE[1] + BASE[2] + BASE[5]))
    bent = thrower.fingers
    before, after = targets[opens - 3, bent], targets[opens + 2, bent]
    assert (np.abs(after) < np.abs(before)).all()
    idle = np.setdiff1d(thrower.idle, thrower.fingers)
    np.testing.assert_allclose(targets[:, idle], np.tile(offset[idle], (40, 1)), atol=1e-12)


# The shipped throws.


def test_the_shipped_throws_are_throws_of_the_task(shipped):
    assert shipped
    for clip in shipped:
        achieved, events = clip.meta["achieved"], clip.meta["events"]
        print(clip.meta["strength"], achieved, events)
        assert achieved["success"] == achieved["tip_first"] == 1.0 and achieved["foul"] == 0.0
        assert achieved["over_arm"] == 1.0
        assert achieved["distance"] >= 5.0
        assert HOLD_STEPS / 30 <= events["release"] < RELEASE_STEPS / 30
        assert clip.body == "smplx" and clip.fps == pytest.approx(30.0)
        scene = make_scene("javelin", strength=clip.meta["strength"])
        assert clip.object_qpos is not None
        np.testing.assert_allclose(
            np.concatenate([clip.qpos[0], clip.object_qpos[0]]), scene.default_qpos(), atol=1e-6
        )


def played_on(clip: Clip, worlds: int) -> tuple[np.ndarray, np.ndarray]:
    """(N,) frames that episodes started from, drawn as training draws them, and how far they
    threw (m) when the targets of the clip were played on; NaN for no throw."""
    assert clip.ctrl is not None
    env = make_env(
        "javelin",
        num_worlds=worlds,
        seed=1,
        strength=clip.meta["strength"],
        training=False,
        starts=ClipBank([clip]).starts(probability=1.0),
        physics_options={"threads": 1},
    )
    rows = env.view.clock.numpy().copy()
    offset, scale = env.physics.scene.action_offset(), env.physics.scene.body.action_scale()
    far, over = np.full(worlds, np.nan), np.zeros(worlds, bool)
    for step in range(clip.num_frames + 20):
        at = np.minimum(rows + step, clip.num_frames - 1)
        action = torch.tensor((clip.ctrl[at] - offset) / scale, dtype=torch.float32)
        result = env.step(action[:, None])
        now = result.ended.numpy() & ~over
        far[now] = result.metrics["distance"].numpy()[now]
        over |= now
        if over.all():
            break
    env.close()
    assert over.all()
    return rows, far


def test_training_can_start_from_frames_of_the_throws(shipped):
    """From frames in which the javelin is held, by the clock of the frame: most are throws again.
    What a start leaves out are the solver's forces of the frame before."""
    for clip in shipped:
        last = round(clip.meta["events"]["release"] * clip.fps)
        assert Window().rows(clip)[-1] == last
        rows, far = played_on(clip, 24)
        assert len(set(rows.tolist())) > 8 and rows.max() <= last
        print(clip.meta["strength"], dict(zip(rows.tolist(), far.round(2).tolist())))
        assert np.isfinite(far).mean() >= 0.8
        assert np.nanmedian(far) > 0.7 * clip.meta["achieved"]["distance"]


def test_a_start_has_the_javelin_in_the_hand(shipped):
    for clip in shipped:
        starts = ClipBank([clip]).starts(probability=0.5)
        assert set(starts.context) == {ELAPSED}
        env = make_env(
            "javelin",
            num_worlds=32,
            seed=1,
            starts=starts,
            strength=clip.meta["strength"],
            physics_options={"threads": 1},
        )
        wrist = env.physics.scene.body.link_index("R_Wrist")
        away = env.physics.object_pos[:, 0] - env.physics.body_pos[:, 0, wrist]
        assert (away.norm(dim=-1) < 0.25).all()
        assert 4 < int((env.view.clock == 0).sum()) < 28
        env.close()
