"""Balls of the engines' own contact: bounce, friction and rolling against closed forms."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from sports.humanoid.body import Shape, load_body
from sports.humanoid.mjcf import build_model
from sports.physics import default_state, make_physics
from sports.physics.variation import Variation, draw
from sports.scene import Scene, SceneObject

G = 9.81
FOOTBALL: dict[str, Any] = dict(radius=0.11, mass=0.43, restitution=0.8, rolling=0.5)
BASKETBALL: dict[str, Any] = dict(radius=0.12, mass=0.6, restitution=0.85, rolling=0.3, grip=0.8)


def ball_scene(radius, mass, restitution, timestep=1 / 120, substeps=1, friction=1.0, **more):
    ball = SceneObject(
        "ball",
        (Shape("sphere", (0, 0, 0), (radius,), mass),),
        "free",
        (3.0, 3.0, radius),
        restitution=restitution,
        friction=friction,
        **more,
    )
    return Scene("ball", load_body(), objects=(ball,), timestep=timestep, substeps=substeps)


def engine(name, scene, n, **options):
    if name == "warp":
        pytest.importorskip("mujoco_warp")
        options["device"] = "cpu"
    if name == "drake":
        pytest.importorskip("pydrake")
    if name == "mujoco":
        options["threads"] = 1
    return make_physics(name, scene, n, **options)


def throw(physics, pos, vel, spin=None, aloft=20.0):
    scene, n = physics.scene, physics.num_worlds
    state = default_state(scene, n, "cpu")
    state.qpos[:, 2] += aloft  # an athlete who meets nothing costs less
    q, v = scene.object_qpos("ball").start, scene.object_qvel("ball").start
    state.qpos[:, q : q + 3] = torch.as_tensor(pos, dtype=torch.float32)
    state.qvel[:, v : v + 3] = torch.as_tensor(vel, dtype=torch.float32)
    if spin is not None:
        state.qvel[:, v + 3 : v + 6] = torch.as_tensor(spin, dtype=torch.float32)
    physics.reset(torch.ones(n, dtype=torch.bool), state)


def watch(physics, steps):
    """(steps, N, 9) position, velocity and spin of the ball."""
    rows = []
    for _ in range(steps):
        physics.step(torch.zeros(physics.num_worlds, physics.scene.nu))
        parts = (physics.object_pos, physics.object_linvel, physics.object_angvel)
        rows.append(torch.cat([p[:, 0] for p in parts], -1))
    return torch.stack(rows)


@pytest.mark.parametrize("ball", [FOOTBALL, BASKETBALL], ids=["football", "basketball"])
@pytest.mark.parametrize(("name", "off"), [("mujoco", 0.02), ("warp", 0.02), ("drake", 0.05)])
def test_a_dropped_ball_rebounds_to_e_squared_of_its_height(name, off, ball):
    """From 1 m, 2 m and between, so that the ground is met at any instant of a time step."""
    h = np.array([1.0, 2.0, 1.003, 1.009, 1.31, 1.5, 1.77])
    if name == "drake":
        h = h[:3]
    timestep = 1 / 120 if ball is FOOTBALL else 1 / 240
    physics = engine(name, ball_scene(**ball, timestep=timestep), len(h))
    pos = np.zeros((len(h), 3)) + 3.0
    pos[:, 2] = ball["radius"] + h
    throw(physics, pos, np.zeros((len(h), 3)))
    path = watch(physics, round(0.75 / timestep)).numpy()  # from 2 m it falls for 0.64 s
    for i, height in enumerate(h):
        z, vz = path[:, i, 2] - ball["radius"], path[:, i, 5]
        top = int(np.argmax((z > 0.0) & (vz > 0.0)))  # on its way up
        apex = z[top] + vz[top] ** 2 / (2 * G)
        assert apex == pytest.approx(ball["restitution"] ** 2 * height, rel=off), height


def test_a_football_rebounds_alike_at_all_speeds_in_drake():
    """The ground's own contact took up to a tenth of the speed of a fast ball, the more the finer
    the time step; see ``add_kick_surfaces``."""
    speed = torch.tensor([3.0, 8.0, 14.0, 20.0])
    physics = engine("drake", ball_scene(**FOOTBALL), 4)
    down = torch.zeros(4, 3)
    down[:, 2] = -speed
    throw(physics, torch.tensor([3.0, 3.0, 0.41]).repeat(4, 1), down)
    path = watch(physics, 15)
    z, vz = path[..., 2] - FOOTBALL["radius"], path[..., 5]
    energy = G * z + vz.square() / 2
    rising = ((z > 0.0) & (vz > 0.0)).float().argmax(0)
    after = energy.gather(0, rising[None])[0]
    before = speed.square() / 2 + G * 0.3
    assert (after / before).sqrt().numpy() == pytest.approx(FOOTBALL["restitution"], abs=0.015)


def kicked_at(name, substeps, **options):
    """Velocity of a football 0.1 s after a stiff athlete in flight at 8 m/s was about to meet it
    with the foot."""
    scene = ball_scene(**FOOTBALL, timestep=0.1 / substeps, substeps=substeps)
    physics = engine(name, scene, 1, **options)
    foot = physics.body_pos[0, 0, scene.body.link_index("R_Ankle")]
    state = default_state(scene, 1, "cpu")
    q = scene.object_qpos("ball").start
    state.qpos[:, 2] += 0.05
    state.qpos[:, q : q + 3] = torch.tensor([float(foot[0]) + 0.38, float(foot[1]), 0.11])
    state.qvel[:, 0] = 8.0
    physics.reset(torch.ones(1, dtype=torch.bool), state)
    physics.step(state.qpos[:, 7 : 7 + scene.nu])
    return physics.object_linvel[0, 0].numpy()


def test_a_kick_in_drake_is_that_of_mujoco_at_a_fine_step():
    """The softness that 1/960 s asks for lifts the ball at 2 m/s more."""
    fine = kicked_at("mujoco", 192, felt_damping=True)
    assert kicked_at("drake", 12) == pytest.approx(fine, abs=0.5)
    assert abs(kicked_at("drake", 12, timestep=1 / 960) - fine).max() > 1.5


@pytest.mark.parametrize("name", ["mujoco", "warp", "drake"])
def test_a_sliding_ball_rolls_at_five_sevenths(name):
    """Coulomb: slip falls by 7/2 mu g t, and a solid ball that slid at v rolls at 5/7 v, after
    2 v / (7 mu g) s. It never leaves the ground."""
    scene = ball_scene(0.11, 0.43, 0.8, timestep=1 / 240, friction=0.5)
    physics = engine(name, scene, 1)
    throw(physics, [[3.0, 3.0, 0.11]], [[0.0, 5.0, 0.0]])
    path = watch(physics, 168)[:, 0]
    slide = 2 * 5.0 / (7 * 0.5 * G)
    half = round(slide / 2 * 240) - 1
    assert path[half, 4] == pytest.approx(5.0 - 0.5 * G * (half + 1) / 240, abs=0.02)
    assert path[-1, 4] == pytest.approx(5.0 * 5 / 7, abs=0.03)
    assert -path[-1, 6] * 0.11 == pytest.approx(float(path[-1, 4]), abs=0.03)
    assert (path[:, 2] - 0.11).abs().max() < 2e-3
    assert path[:, 3].abs().max() < 1e-3


@pytest.mark.parametrize(("friction", "rolls"), [(0.1, False), (0.8, True)])
def test_a_slanting_bounce_follows_coulomb(friction, rolls):
    """At 15 m/s ahead and 5 m/s down: friction takes mu (1 + e) 5 m/s, or what makes it roll."""
    physics = engine("mujoco", ball_scene(0.11, 0.43, 0.8, friction=friction), 1)
    throw(physics, [[3.0, 3.0, 0.111]], [[15.0, 0.0, -5.0]])
    after = watch(physics, 2)[1, 0]
    down = 5.0 + G / 120
    taken = 2 / 7 * 15.0 if rolls else friction * 1.8 * down
    assert after[3] == pytest.approx(15.0 - taken, abs=0.03)
    assert after[7] * 0.11 == pytest.approx(2.5 * taken, abs=0.1)
    assert after[5] == pytest.approx(0.8 * down, abs=0.12)


@pytest.mark.parametrize("name", ["mujoco", "warp", "drake"])
def test_a_rolling_ball_stops_after_v_over_rate(name):
    """3.2 m/s is what a ramp of 1 m gives it (FIFA's ball roll test: 4 to 8 m on good grass)."""
    fast = 3.2 if name == "mujoco" else 1.0
    seconds = {"mujoco": 16, "warp": 4, "drake": 2}[name]  # Drake: 9 ms a step
    physics = engine(name, ball_scene(**FOOTBALL, timestep=1 / 120, substeps=4), 1)
    throw(physics, [[3.0, 3.0, 0.11]], [[fast, 0.0, 0.0]], [[0.0, fast / 0.11, 0.0]])
    path = watch(physics, 30 * seconds)[:, 0]
    fading = 1.0 - math.exp(-0.5 * seconds)
    assert path[-1, 0] - 3.0 == pytest.approx(fast / 0.5 * fading, rel=0.02)
    assert path[-1, 3] == pytest.approx(fast * (1 - fading), abs=0.01)


def test_a_dropped_ball_comes_to_rest():
    physics = engine("mujoco", ball_scene(**FOOTBALL, substeps=4), 1)
    throw(physics, [[3.0, 3.0, 1.11]], [[0.0, 0.0, 0.0]])
    last = watch(physics, 180)[-30:, 0]
    assert last[:, 3:].abs().max() < 1e-3
    assert (last[:, 2] - 0.11).abs().max() < 1e-3


@pytest.mark.parametrize("speed", [5.0, 15.0, 30.0])
@pytest.mark.parametrize("ball", [FOOTBALL, BASKETBALL], ids=["football", "basketball"])
def test_a_ball_that_hits_an_athlete_never_gains_energy(ball, speed):
    """Servos, joint damping and gravity off, so that only contacts act; any part of the body."""
    timestep = 1 / 120 if ball is FOOTBALL else 1 / 240
    scene = ball_scene(**ball, timestep=timestep)
    model = build_model(scene, sensors=False)
    model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0.0
    model.dof_damping[:] = model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    q, v = scene.object_qpos("ball").start, scene.object_qvel("ball").start
    rng = np.random.default_rng(1)
    before, hits = ball["mass"] * speed**2 / 2, 0
    for _ in range(40):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = scene.default_qpos()
        data.qpos[2] += 0.02
        at = 1.0 + rng.uniform(0, speed * timestep), rng.uniform(-0.15, 0.15), rng.uniform(0.2, 1.5)
        data.qpos[q : q + 3], data.qvel[v] = at, -speed
        for _ in range(round(1.5 / speed / timestep)):
            mujoco.mj_step(model, data)
            mujoco.mj_energyVel(model, data)
            assert data.energy[1] < 1.005 * before
        hits += data.qvel[v] > -0.99 * speed
    assert hits > 20


def test_a_ball_at_15_m_s_does_not_pass_through_a_leg():
    """At 1/120 s it moves 12.5 cm in a time step; ball and shin are 16 cm to the middle."""
    scene = ball_scene(**FOOTBALL)
    physics = engine("mujoco", scene, 24)
    knee = physics.body_pos[0, 0, scene.body.link_index("L_Knee")]
    x = float(knee[0]) + torch.linspace(0.5, 0.625, 24)
    pos = torch.stack((x, knee[1].expand(24), (knee[2] - 0.15).expand(24)), -1)
    throw(physics, pos, torch.tensor([-15.0, 0.0, 0.0]).expand(24, 3), aloft=0.0)
    path = watch(physics, 12)
    assert (path[-1, :, 0] > float(knee[0])).all()
    assert (path[-1, :, 3] > 0.0).all()
    assert path[..., 3:6].norm(dim=-1).max() < 15.5


@pytest.mark.parametrize(("grip", "rolls"), [(0.0, False), (1.0, True)])
def test_friction_with_athletes_is_the_grip(grip, rolls):
    """A ball on a fixed head, gravity turned by 15 degrees: without grip it slides at g sin, with
    it it rolls at 5/7 of that."""
    scene = ball_scene(0.12, 0.6, 0.85, timestep=1 / 240, grip=grip)
    model = build_model(scene)
    assert model.body("ball").geomnum[0] == 1 + rolls
    assert model.body("ball").mass[0] == pytest.approx(0.6)
    tilt = math.radians(15)
    model.opt.gravity[:] = (G * math.sin(tilt), 0.0, -G * math.cos(tilt))
    model.dof_damping[: scene.nv - 6] = 1e9
    data = mujoco.MjData(model)
    data.qpos[:] = scene.default_qpos()
    mujoco.mj_forward(model, data)
    head = model.geom("agent0/Head:0").id
    top = data.geom_xpos[head] + (-0.03, 0.0, model.geom_size[head, 2] + 0.1199)
    q = scene.object_qpos("ball").start
    data.qpos[q : q + 3] = top
    for _ in range(36):
        mujoco.mj_step(model, data)
    fast = G * math.sin(tilt) * 0.15 * (5 / 7 if rolls else 1.0)
    assert data.qvel[scene.object_qvel("ball").start] == pytest.approx(fast, rel=0.03)


def test_coarse_worlds_bounce_as_the_others():
    """A world that takes two time steps in one has a bounce of that step."""
    neutral = Variation((1, 1), (1, 1), (1, 1), coarse_share=0.5)
    scene = ball_scene(**FOOTBALL, timestep=1 / 480, substeps=16)
    n = 8
    strides = draw(neutral, n, scene.substeps, 4).stride
    assert len(set(strides.tolist())) > 1
    for name in ("mujoco", "warp"):
        physics = engine(name, scene, n, variation=neutral, variation_seed=4)
        throw(physics, np.tile([3.0, 3.0, 1.11], (n, 1)), np.zeros((n, 3)))
        path = watch(physics, 16)[-1]
        apex = path[:, 2] - 0.11 + path[:, 5] ** 2 / (2 * G)
        assert (path[:, 5] > 0).all()
        assert (apex / 0.64 - 1).abs().max() < 0.03


def test_mujoco_and_warp_move_a_ball_alike():
    scene = ball_scene(**FOOTBALL, substeps=4)
    pos = [[3.0, 3.0, 0.5], [1.0, 0.1, 0.1099], [0.8, -0.1, 0.6]]
    vel = [[4.0, 1.0, -3.0], [-6.0, 0.0, 0.0], [-8.0, 0.0, 1.0]]
    paths = []
    for name in ("mujoco", "warp"):
        physics = engine(name, scene, 3)
        throw(physics, pos, vel, [[0.0, 20.0, 5.0]] * 3)
        paths.append(watch(physics, 12))
    assert (paths[0] - paths[1]).abs().max() < 2e-3


def test_wrong_balls_are_refused():
    sphere = (Shape("sphere", (0, 0, 0), (0.1,), 0.4),)
    with pytest.raises(ValueError, match="restitution must be in"):
        SceneObject("ball", sphere, "free", (0, 0, 1), restitution=1.2)
    with pytest.raises(ValueError, match="only a free ball"):
        SceneObject("ball", sphere, "fixed", (0, 0, 1), restitution=0.8)
    with pytest.raises(ValueError, match="need a restitution"):
        SceneObject("ball", sphere, "free", (0, 0, 1), rolling=0.5)
