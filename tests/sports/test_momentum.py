"""The momentum keeper on plain MuJoCo, against the engine and against sums over the links."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from sports.env import make_scene
from sports.humanoid import load_body
from sports.humanoid.mjcf import build_model, build_spec
from sports.physics import default_state, make_physics
from sports.physics.momentum import AthleteKeeper, rows_of

ROOT = "agent0/Pelvis"


def by_links(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """(9,) centre of mass, its velocity and the angular momentum about it, link by link."""
    mass, com = model.body_mass, data.xipos
    velocity, spin = np.zeros((model.nbody, 3)), np.zeros((model.nbody, 3))
    own = np.zeros(3)
    for b in range(model.nbody):
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, b, twist, 0)
        spin[b], velocity[b] = twist[:3], twist[3:]  # at the link's centre of mass
        axes = data.ximat[b].reshape(3, 3)
        own += axes @ (model.body_inertia[b] * (axes.T @ spin[b]))
    center = mass @ com / mass.sum()
    mean = mass @ velocity / mass.sum()
    orbit = np.cross(com - center, mass[:, None] * (velocity - mean)).sum(0)
    return np.concatenate((center, mean, own + orbit))


def test_measured_is_the_sum_over_links():
    model = build_model(load_body())
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    keeper = AthleteKeeper(model, rows_of(data), ROOT)
    for _ in range(5):
        data.qpos[7:], data.qvel[:] = 0.5 * rng.standard_normal(model.nu), rng.standard_normal(75)
        data.qpos[:7] = (3.0, -2.0, 5.0, *(q := rng.standard_normal(4)) / np.linalg.norm(q))
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(keeper.measured()[0], by_links(model, data), atol=1e-9)


@pytest.mark.parametrize("forces", [True, False])
def test_plain_mujoco_with_the_keeper_is_the_engine(forces):
    """A flailing athlete who lands: ``mj_step`` and the keeper follow the engine, with or without
    the contact sensors."""
    scene = make_scene("long_jump")
    spec = build_spec(scene)
    if not forces:
        for sensor in list(spec.sensors):
            if sensor.type == mujoco.mjtSensor.mjSENS_CONTACT:
                spec.delete(sensor)
    model = spec.compile()
    data = mujoco.MjData(model)
    physics = make_physics("mujoco", scene, 1, threads=1)
    state = default_state(scene, 1, "cpu")
    state.qpos[:, 2] += 0.3
    state.qvel[:, :3] = torch.tensor((2.0, 0.5, 1.0))
    physics.reset(torch.tensor([True]), state)
    data.qpos[:], data.qvel[:] = state.qpos[0].numpy(), state.qvel[0].numpy()
    keeper = AthleteKeeper(model, rows_of(data), ROOT)
    generator = torch.Generator().manual_seed(4)
    touched = False
    for _ in range(20):
        ctrl = 0.5 * torch.randn(1, scene.nu, generator=generator)
        physics.step(ctrl)
        data.ctrl[:] = ctrl[0].numpy()
        for substep in range(scene.substeps):
            mujoco.mj_step(model, data)
            last = substep == scene.substeps - 1
            if last:
                mujoco.mj_step1(model, data)
            _, shift = keeper.correct(current=last)
        extra = physics.extra_state()
        # The engine's own kinematics are in single precision; MuJoCo's here in double.
        np.testing.assert_allclose(data.qpos, extra["qpos"][0], atol=1e-6)
        np.testing.assert_allclose(data.qvel, extra["qvel"][0], atol=1e-4)
        pos = data.xpos[[model.body(f"agent0/{n}").id for n in scene.body.link_names]] + shift
        np.testing.assert_allclose(pos, physics.body_pos[0, 0], atol=1e-5)
        touched |= bool(physics.ground_force.any())
        # What the keeper says of the state is what the state is.
        check = mujoco.MjData(model)
        check.qpos[:], check.qvel[:] = data.qpos, data.qvel
        mujoco.mj_forward(model, check)
        np.testing.assert_allclose(keeper.whole()[0], by_links(model, check), atol=1e-6)
    assert touched


def test_a_model_without_the_sensors_gets_a_sentence():
    model = build_model(load_body(), sensors=False)
    with pytest.raises(ValueError, match="no sensor 'subtreeangmom:agent0/Pelvis'"):
        AthleteKeeper(model, rows_of(mujoco.MjData(model)), ROOT)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_loading_a_state_leaves_the_callers_arrays_alone(engine):
    """The engine must not write into a state that somebody keeps, nor follow its changes."""
    if engine == "warp":
        pytest.importorskip("mujoco_warp")
    options = {"device": "cpu"} if engine == "warp" else {"threads": 1}
    physics = make_physics(engine, make_scene("long_jump"), 2, **options)
    ctrl = torch.zeros(2, physics.scene.nu)
    physics.step(ctrl)
    saved = physics.extra_state()
    kept = {k: v.clone() for k, v in saved.items()}
    physics.load_extra_state(saved)
    physics.step(ctrl)
    state = default_state(physics.scene, 2, "cpu")
    physics.reset(torch.tensor([True, False]), state)
    for name, value in kept.items():
        torch.testing.assert_close(saved[name], value, rtol=0, atol=0, equal_nan=True)
    physics.load_extra_state(saved)
    for value in saved.values():
        value.zero_()
    again = physics.extra_state()
    for name, value in kept.items():
        torch.testing.assert_close(again[name], value, rtol=0, atol=0, equal_nan=True)
