"""The ball law inside the engines: the same ball in all of them, reactions, drag, book-keeping."""

import dataclasses
import functools
import math
from operator import attrgetter

import mujoco
import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from sports.ball_law import flight
from sports.ball_law.compiled import for_cpu, for_gpu
from sports.ball_law.play import STATE_NUMBERS
from sports.humanoid import load_body
from sports.humanoid.body import Shape
from sports.humanoid.mjcf import build_model
from sports.physics import Geometry, PhysicsState, default_state
from sports.physics.variation import Variation, draw
from sports.scene import Scene, SceneObject, Start
from tests.sports.courts import (
    CLUB,
    COURT,
    NET,
    RACKET,
    TABLE,
    WAVES,
    Law,
    court,
    engine,
    everyone,
    in_front_of_the_racket,
)

ENGINES = ("mujoco", "warp", "drake")


def place(state, scene, pos, linvel, angvel=(0.0, 0.0, 0.0)):
    """Puts the ball into a state, in every world."""
    q, v = scene.object_qpos("ball"), scene.object_qvel("ball")
    state.qpos[:, q] = torch.cat((torch.as_tensor(pos), torch.tensor((1.0, 0.0, 0.0, 0.0)))).float()
    state.qvel[:, v] = torch.cat((torch.as_tensor(linvel), torch.as_tensor(angvel))).float()


def test_a_shot_is_the_same_in_all_engines():
    """A serve with spin over the net, two bounces; balls and impacts compared step by step."""
    scene = court(surfaces=(COURT, NET), pos=(-12.0, 0.0, 1.2))
    kinds = [engine(name, scene, 1) for name in ENGINES]
    state = default_state(scene, 1, "cpu")
    place(state, scene, (-12.0, 0.5, 1.2), (22.0, 1.0, 4.6), (20.0, 150.0, -30.0))
    for physics in kinds:
        physics.reset(everyone(1), state)
    ctrl, bounces, worst, turned = torch.zeros(1, scene.nu), [[], [], []], 0.0, 0.0
    for step in range(60):
        for physics, found in zip(kinds, bounces):
            physics.step(ctrl)
            if physics.ball_hits[0, 0] > 0:
                time = step * scene.control_timestep + float(physics.ball_hit_time[0, 0])
                found.append((*physics.ball_hit_pos[0, 0].tolist(), time))
            assert physics.ball_hits[0, 1] == 0
        first = kinds[0]
        for physics in kinds[1:]:
            worst = max(worst, float((physics.object_pos - first.object_pos).norm()))
            overlap = (physics.object_quat * first.object_quat).sum().abs()
            turned = max(turned, 1 - float(overlap))
            assert (physics.object_angvel - first.object_angvel).norm() < 0.1
            assert (physics.object_linvel - first.object_linvel).norm() < 0.01
    print(f"largest distance between the balls of two engines {worst:.1e} m")
    assert len(bounces[0]) >= 2 and worst < 0.01 and turned < 1e-3
    for found in bounces[1:]:
        assert np.abs(np.array(found) - np.array(bounces[0])).max() < 0.01


@pytest.mark.parametrize("name", ENGINES)
def test_a_hit_in_mid_air_keeps_the_momentum_of_athlete_and_ball(name):
    """The athlete flies and flails; a ball at 30 m/s meets the racket. What the ball gives, the
    athlete takes: momentum (gravity accounted for) and angular momentum about the vertical. In
    Drake, where nothing keeps the momentum of who flails, the athlete holds still."""
    scene = court(surfaces=(RACKET,), agents=(Start(),))
    n = 2
    physics = engine(name, scene, n)
    games = {"mujoco": "_worlds.game.ball", "drake": "_game.ball"}
    law_ball = attrgetter(games[name])(physics) if name in games else physics._game["ball"]
    law_ball[flight.AIR] = 0.0
    state = default_state(scene, n, "cpu")
    state.qpos[:, 2] += 20.0
    state.qvel[:, :3] = torch.tensor(((1.0, 2.0, 3.0), (-2.0, 0.0, 5.0)))
    q, v = scene.object_qpos("ball"), scene.object_qvel("ball")
    state.qpos[:, q][:, :3] = in_front_of_the_racket(physics, state, 0.9)
    state.qvel[:, v][:, :3] = state.qvel[:, :3] + torch.tensor((-30.0, 0.0, 0.0))
    state.qvel[:, v][:, 3:] = torch.tensor((10.0, -50.0, 80.0))
    physics.reset(everyone(n), state)
    geometry, model = Geometry(scene.body, "cpu"), build_model(scene.body)
    ball = Law(scene, 1).ball
    inertia = ball.shell * ball.mass * ball.radius**2

    def momenta():
        """(N, 3) momentum, (N,) angular momentum about the world's vertical, both of all."""
        p = ball.mass * physics.object_linvel[:, 0] + torch.zeros(n, 3)
        spin = inertia * physics.object_angvel[:, 0]
        turn = torch.linalg.cross(physics.object_pos[:, 0], p) + spin
        com, speed = geometry.center_of_mass(physics, 0)
        own = scene.body.mass * speed
        for i in range(n):
            data = mujoco.MjData(model)
            athlete = scene.agent_qpos(0), scene.agent_qvel(0)
            data.qpos[:] = physics.qpos[i, athlete[0]].numpy()
            data.qvel[:] = physics.qvel[i, athlete[1]].numpy()
            mujoco.mj_forward(model, data)
            mujoco.mj_subtreeVel(model, data)
            turn[i] += torch.tensor(data.subtree_angmom[1]) + torch.linalg.cross(com[i], own[i])
        return p + own, turn[:, 2], p

    before, turn_before, ball_before = momenta()
    generator = torch.Generator().manual_seed(3)
    hits, steps = 0, 6
    for _ in range(steps):
        flailing = 0.3 * torch.randn(n, scene.nu, generator=generator)
        still = torch.zeros(n, scene.nu)
        still[:, scene.body.dof_index("R_Wrist_y")] = math.pi / 2
        physics.step(still if name == "drake" else flailing)
        hits = hits + physics.ball_hits[:, 0]
    after, turn_after, ball_after = momenta()
    weight = torch.tensor((0.0, 0.0, -9.81)) * (scene.body.mass + ball.mass)
    lost = after - before - weight * steps * scene.control_timestep
    given = (ball_after - ball_before).norm(dim=1)
    turned = (turn_after - turn_before).abs()
    print(
        f"{name}: momentum of the ball changed by {given.min():.2f} N s, of all by "
        f"{lost.abs().max():.1e} N s, their angular momentum by {turned.max():.1e} N m s"
    )
    assert (hits >= 1).all() and (given > 1.5).all()
    rough = 20.0 if name == "drake" else 1.0
    assert lost.abs().max() < 0.002 * rough and turned.max() < 0.005 * rough


@pytest.mark.parametrize("name", ENGINES)
def test_drag_of_an_object_is_its_equation(name):
    """A rod that flies nose-up: along and across its axis, against scipy."""
    attitude = Rotation.from_euler("y", -0.4)
    quat = tuple(attitude.as_quat(scalar_first=True).tolist())
    rod = Shape("capsule", (-1.3, 0.0, 0.0), (0.012,), 0.8, end=(1.3, 0.0, 0.0))
    drag, mass = (0.004, 0.06), 0.8
    thing = SceneObject("rod", (rod,), "free", (0.0, 0.0, 30.0), quat, drag=drag)
    scene = Scene("field", load_body(), objects=(thing,))
    physics = engine(name, scene, 1)
    state = default_state(scene, 1, "cpu")
    start = np.array((22.0, 3.0, 6.0))
    state.qvel[:, scene.object_qvel("rod")] = torch.tensor((*start, 0.0, 0.0, 0.0)).float()
    physics.reset(everyone(1), state)
    axis = attitude.apply((1.0, 0.0, 0.0))

    def rate(_, y):
        along = y[3:] @ axis
        aside = y[3:] - along * axis
        force = -drag[0] * abs(along) * along * axis - drag[1] * np.linalg.norm(aside) * aside
        return [*y[3:], *(force / mass + (0.0, 0.0, -9.81))]

    time = 30 * scene.control_timestep
    exact = solve_ivp(rate, (0, time), [0.0, 0.0, 30.0, *start], rtol=1e-9, atol=1e-9).y[:, -1]
    for _ in range(30):
        physics.step(torch.zeros(1, scene.nu))
    free = start + np.array((0.0, 0.0, -9.81)) * time
    slowed = np.linalg.norm(free - exact[3:])
    off = np.linalg.norm(physics.object_linvel[0, 0].numpy() - exact[3:])
    print(f"{name}: drag took {slowed:.2f} m/s, the engine is {off:.3f} m/s off")
    assert slowed > 4.0 and off < 0.01 * slowed
    # Semi-implicit steps fall g t h / 2 further.
    assert np.linalg.norm(physics.object_pos[0, 0].numpy() - exact[:3]) < 0.08
    assert physics.ball_hits.shape == (1, 0)


@pytest.mark.parametrize("spin", [0.0, 40.0, -250.0])
@pytest.mark.parametrize("name", ENGINES)
def test_a_thrown_rod_keeps_its_angular_momentum(name, spin):
    """A rod that spins about its axis, fast as a javelin does, while the axis turns slowly: against
    Euler's equations, by scipy. Then it lands: what is touched is the engine's."""
    attitude = Rotation.from_euler("y", -0.4)
    quat = tuple(attitude.as_quat(scalar_first=True).tolist())
    half, radius, mass = 1.3, 0.012, 0.8
    rod = Shape("capsule", (-half, 0.0, 0.0), (radius,), mass, end=(half, 0.0, 0.0))
    thing = SceneObject("rod", (rod,), "free", (0.0, 0.0, 6.0), quat, drag=(0.0005, 0.004))
    scene = Scene("field", load_body(), objects=(thing,))
    physics = engine(name, scene, 1)
    model = build_model(scene)
    inertia = model.body_inertia[model.body("rod").id]
    axial, across = inertia.min(), inertia.max()
    state = default_state(scene, 1, "cpu")
    rates = np.array((spin, 1.1, -0.7))
    start = torch.tensor((12.0, 0.0, 3.0, *rates)).float()
    state.qvel[:, scene.object_qvel("rod")] = start
    physics.reset(everyone(1), state)
    steps = 30

    def rate(_, y):
        w, own = y[:3], Rotation.from_quat(y[3:], scalar_first=True)
        turning = (axial - across) / across
        q = np.concatenate([[0.0], own.apply(w)])
        quat = y[3:]
        dq = 0.5 * np.concatenate(
            [[-q[1:] @ quat[1:]], quat[0] * q[1:] + np.cross(q[1:], quat[1:])]
        )
        return [0.0, -turning * w[0] * w[2], turning * w[0] * w[1], *dq]

    time = steps * scene.control_timestep
    exact = solve_ivp(rate, (0, time), [*rates, *quat], rtol=1e-10, atol=1e-12).y[:, -1]
    nose = Rotation.from_quat(exact[3:], scalar_first=True).apply((1.0, 0.0, 0.0))
    for _ in range(steps):
        physics.step(torch.zeros(1, scene.nu))
    found = physics.qvel[0, scene.object_qvel("rod")][3:].numpy().copy()
    turned = Rotation.from_quat(physics.object_quat[0, 0].numpy(), scalar_first=True)
    off = np.linalg.norm(turned.apply((1.0, 0.0, 0.0)) - nose)
    print(f"{name}: axis {off:.1e} off after {time:.1f} s, spin {found[0]:.1f} rad/s")
    assert np.linalg.norm(nose - attitude.apply((1.0, 0.0, 0.0))) > 1.0
    assert off < 2e-3 and found[0] == pytest.approx(spin, abs=1e-3)
    np.testing.assert_allclose(found[1:], exact[1:3], atol=0.02)
    for _ in range(30):
        physics.step(torch.zeros(1, scene.nu))
    assert physics.object_pos[0, 0, 2] < 1.5 and not physics.bad.any()
    assert np.linalg.norm(physics.qvel[0, scene.object_qvel("rod")][3:].numpy() - found) > 0.1


def test_what_has_drag_must_be_a_body_of_revolution():
    plank = Shape("box", (0.0, 0.0, 0.0), (1.0, 0.1, 0.02), 1.0)
    thing = SceneObject("plank", (plank,), "free", (0.0, 0.0, 6.0), drag=(0.0, 0.0))
    with pytest.raises(ValueError, match="body of revolution"):
        engine("mujoco", Scene("field", load_body(), objects=(thing,)), 1)


def random_tables(seed):
    """Balls around all kinds of surfaces, half of them on tools in motion: (scene, Law, poses)."""
    rng = np.random.default_rng(seed)
    n = 400
    scene = court("golf", (COURT, TABLE, NET, WAVES, RACKET, CLUB))
    alone = Law(scene, n)
    game = alone.game
    game.phases[:] = rng.uniform(0.0, 2 * math.pi, (n, 2))
    alone.pos[:] = rng.normal(size=(n, 3)) * (2.0, 1.0, 0.3) + (0.0, 0.0, 0.6)
    alone.linvel[:] = rng.normal(size=(n, 3)) * 15.0
    alone.angvel[:] = rng.normal(size=(n, 3)) * 100.0
    attitude = Rotation.random(2 * n, rng=rng)
    turn = Rotation.from_rotvec(rng.normal(size=(2 * n, 3)) * 0.1)
    origin = np.repeat(alone.pos, 2, axis=0) + rng.normal(size=(2 * n, 3)) * 0.1
    origin -= attitude.apply(np.resize((RACKET.center, CLUB.center), (2 * n, 3)))
    for pose, o, r in (
        (game.before, origin, attitude),
        (game.after, origin + rng.normal(size=origin.shape) * 0.05, turn * attitude),
    ):
        pose[..., :3] = o.reshape(n, 2, 3)
        pose[..., 3:] = r.as_quat(scalar_first=True).reshape(n, 2, 4)
    return alone


def on_warp(alone, dt):
    """The same substep by Warp on its CPU device, from the same numbers; a Game of arrays."""
    wp = pytest.importorskip("warp")
    law, arrays = for_gpu(), {}
    game = law.Game()
    for name, array in alone.game._asdict().items():
        single = array.astype(np.int32 if array.dtype == np.int32 else np.float32)
        arrays[name] = wp.array(single, device="cpu")
        setattr(game, name, arrays[name])
    kernel = functools.partial(wp.launch, dim=alone.n, device="cpu")
    play = law.play

    @wp.kernel(module="unique")
    def play_worlds(game: law.Game, dt: float):
        play(game, wp.tid(), dt)

    kernel(play_worlds, inputs=[game, dt])
    return {name: array.numpy() for name, array in arrays.items()}


def test_numba_and_warp_are_one_law():
    """One substep of 400 random worlds with six surfaces, double against single precision."""
    alone = random_tables(1)
    for name in ("state", "before", "after", "phases"):  # numbers that both can hold
        array = getattr(alone.game, name)
        array[:] = array.astype(np.float32)
    got = on_warp(alone, 1 / 120)
    for w in range(alone.n):
        for_cpu().play(alone.game, w, 1 / 120)
    hits = alone.game.hits
    # A graze may be a touch for one and a miss for the other; a world with many impacts diverges.
    same = (got["hits"] == hits).all(1)
    few = same & (hits.sum(1) <= 2)
    assert same.mean() > 0.97 and few.sum() > 300 and (hits.sum(0) >= 5).all()
    off = np.abs(got["state"] - alone.game.state)[few]
    print(f"{few.sum()} worlds with {hits[few].sum()} impacts: position {off[:, :3].max():.1e} m, "
          f"velocity {off[:, 7:10].max():.1e} m/s")  # fmt: skip
    assert off[:, :3].max() < 1e-5
    scaled = off / (1.0 + np.abs(alone.game.state[few]))
    fixed = (hits[few, 4:] == 0).all(1)
    print(f"without tools {scaled[fixed].max():.1e}, with tools {scaled.max():.1e} of the numbers")
    assert scaled[fixed].max() < 1e-5
    # A tool's velocity is the difference of two poses: 1e-6 m in single precision, in 1/120 s.
    assert scaled.max() < 1e-3 and np.quantile(scaled[~fixed], 0.99) < 1e-4
    assert np.abs(got["pending"] - alone.game.pending)[few].max() < 1e-3


def rally(n, scatter=0.08):
    """A scene with a racket, and a state in which balls come at it and at the ground."""
    scene = court(surfaces=(COURT, NET, RACKET))
    state = default_state(scene, n, "cpu")
    generator = torch.Generator().manual_seed(5)
    physics = engine("mujoco", scene, n)
    q, v = scene.object_qpos("ball"), scene.object_qvel("ball")
    noise = scatter * torch.randn(2, n, 3, generator=generator)
    state.qpos[:, q][:, :3] = in_front_of_the_racket(physics, state, 0.8) + noise[0]
    linvel = torch.tensor((-20.0, 0.0, 1.0)) + 10.0 * noise[1]
    state.qvel[:, v] = torch.cat((linvel, 50 * torch.randn(n, 3, generator=generator)), -1)
    return scene, physics, state


def test_permuting_the_worlds_permutes_balls_and_hits():
    n = 6
    scene, physics, state = rally(n)
    other = engine("mujoco", scene, n)
    order = torch.tensor([3, 0, 5, 1, 4, 2])
    physics.reset(everyone(n), state)
    permuted = PhysicsState(state.qpos[order], state.qvel[order], state.mocap_pos[order])
    other.reset(everyone(n), permuted)
    generator = torch.Generator().manual_seed(1)
    total = torch.zeros(3)
    for _ in range(15):
        ctrl = 0.2 * torch.randn(n, scene.nu, generator=generator)
        physics.step(ctrl)
        other.step(ctrl[order])
        total += physics.ball_hits.sum(0)
        for name in ("qpos", "qvel", "object_pos", "ball_hits", "ball_hit_time", "ball_hit_pos"):
            assert torch.equal(getattr(physics, name)[order], getattr(other, name)), name
    assert total[0] > 0 and total[2] >= 3


def test_resets_and_moves_begin_without_impacts_and_a_saved_state_goes_on():
    """A reset forgets the impact and its reaction in that world only; a ball served elsewhere goes
    on from there; the extra state holds what the racket is still to feel."""
    n = 3
    scene, physics, state = rally(n, scatter=0.0)
    physics.reset(everyone(n), state)
    for _ in range(2):
        physics.step(torch.zeros(n, scene.nu))
    kept = physics.ball_hits.clone()
    assert (kept[:, 2] > 0).all() and torch.isfinite(physics.ball_hit_time[:, 2]).all()
    physics.reset(torch.tensor([False, True, False]), state)
    assert (physics.ball_hits[1] == 0).all() and torch.isinf(physics.ball_hit_time[1]).all()
    assert (physics.ball_hit_pos[1] == 0).all()
    assert torch.equal(physics.ball_hits[::2], kept[::2])
    # Until the racket has just been hit in the last substep of a control step.
    scene, physics, state = rally(1, scatter=0.0)
    game, start = physics._worlds.game, state.qpos[:, scene.object_qpos("ball")].clone()
    for away in torch.linspace(-0.4, 0.4, 40):
        state.qpos[:, scene.object_qpos("ball")][:, 0] = start[:, 0] + away
        physics.reset(everyone(1), state)
        physics.step(torch.zeros(1, scene.nu))
        if np.abs(game.pending).max() > 0:
            break
    assert np.abs(game.pending).max() > 0.5
    saved, extra = (
        PhysicsState(physics.qpos.clone(), physics.qvel.clone(), physics.mocap_pos.clone()),
        physics.extra_state(),
    )
    again = engine("mujoco", scene, 1)
    again.reset(everyone(1), saved)
    again.load_extra_state({k: v.clone() for k, v in extra.items()})
    without = engine("mujoco", scene, 1)
    without.reset(everyone(1), saved)
    for one in (physics, again, without):
        one.step(torch.zeros(1, scene.nu))
    assert torch.equal(physics.qpos, again.qpos) and torch.equal(physics.qvel, again.qvel)
    assert not torch.allclose(physics.qvel, without.qvel, atol=1e-2)
    # A new serve.
    qpos, qvel = physics.qpos.clone(), physics.qvel.clone()
    qpos[:, scene.object_qpos("ball")] = torch.tensor((-5.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0))
    qvel[:, scene.object_qvel("ball")] = torch.tensor((3.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    physics.move(everyone(1), qpos, qvel)
    physics.step(torch.zeros(1, scene.nu))
    t = scene.control_timestep
    expected = torch.tensor((-5.0 + 3.0 * t, 0.0, 2.0 - 9.81 * t**2 / 2))
    assert (physics.object_pos[0, 0] - expected).abs().max() < 1e-3


def test_coarse_and_fine_worlds_play_the_same_ball():
    """Worlds that take several substeps in one, then none: as in a scene with that step."""
    n, divisor = 4, 4
    coarse = court(surfaces=(COURT, NET))
    fine = dataclasses.replace(coarse, timestep=coarse.timestep / divisor, substeps=4 * divisor)
    variation = Variation(coarse_share=0.5)
    strides = draw(variation, n, fine.substeps, 3).stride
    assert len(set(strides)) > 1
    varied = engine("mujoco", fine, n, variation=variation, variation_seed=3)
    plain = engine("mujoco", coarse, n)
    state = default_state(coarse, n, "cpu")
    place(state, coarse, (-3.0, 0.0, 1.0), (12.0, 1.0, 3.0), (0.0, 100.0, 0.0))
    for physics in (varied, plain):
        physics.reset(everyone(n), state)
    bounces = torch.zeros(n)
    for _ in range(30):
        for physics in (varied, plain):
            physics.step(torch.zeros(n, coarse.nu))
        assert (varied.object_pos - plain.object_pos).abs().max() < 5e-3
        assert torch.equal(varied.ball_hits > 0, plain.ball_hits > 0)
        bounces += varied.ball_hits[:, 0]
        met = plain.ball_hits[:, 0] > 0
        off = (varied.ball_hit_time - plain.ball_hit_time)[:, 0].masked_fill(~met, 0.0)
        assert off.abs().max() < 2e-3
    assert (bounces >= 1).all()


@pytest.mark.parametrize("name", ENGINES)
def test_each_world_has_waves_of_its_own(name):
    """Phases arrive with a reset and stay with one that names none; a ball dropped on a slope rests
    on it, exactly still, at the height of the formula."""
    n = 2
    scene = court("golf", (WAVES,), pos=(7.0, 1.0, 1.0))
    physics = engine(name, scene, n)
    state = default_state(scene, n, "cpu")
    state.wave_phase = torch.tensor(((0.3, 2.0), (1.5, 4.0)))
    place(state, scene, (7.0, 1.0, 0.6), (0.0, 0.0, 0.0))
    physics.reset(everyone(n), state)
    plain = PhysicsState(state.qpos, state.qvel, state.mocap_pos)
    physics.reset(torch.tensor([True, False]), plain)
    assert torch.equal(physics.wave_phase, state.wave_phase)
    for _ in range(90):
        physics.step(torch.zeros(n, scene.nu))
    lying = physics.object_pos.clone()
    assert (physics.object_linvel == 0).all() and (physics.object_angvel == 0).all()
    physics.step(torch.zeros(n, scene.nu))
    assert torch.equal(physics.object_pos, lying) and (physics.ball_hits == 0).all()
    law, radius = for_cpu(), Law(scene, 1).ball.radius
    for w in range(n):
        x, y, z = lying[w, 0].tolist()
        h, sx, sy = law.wave(x, y, *WAVES.size, *state.wave_phase[w].tolist())
        assert z == pytest.approx(h + radius * math.sqrt(1 + sx**2 + sy**2), abs=1e-4)
    assert (lying[0, 0] - lying[1, 0]).abs().max() > 0.01


def test_a_scene_without_a_ball_has_no_hits():
    scene = Scene("alone", load_body())
    physics = engine("mujoco", scene, 2)
    physics.step(torch.zeros(2, scene.nu))
    assert physics.ball_hits.shape == (2, 0) and physics.ball_hit_pos.shape == (2, 0, 3)
    assert STATE_NUMBERS == 13
