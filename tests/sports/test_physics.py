"""Engines against closed forms, against each other, and against a permutation of the worlds."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

import sports.physics.mujoco as engine
from sports.env import make_env, make_scene
from sports.frames import Heading, proprioception
from sports.humanoid import load_body
from sports.humanoid.mjcf import build_model, let_rebound
from sports.physics import Geometry, PhysicsState, default_state, make_physics
from sports.physics.variation import REBOUND_SOLREF, Variation, contact_softness, draw
from sports.scene import Start, humanoid_scene
from warmstart.clip import Clip


def cpu(scene, n, **options):
    return make_physics("mujoco", scene, n, threads=2, **options)


def test_a_tossed_athlete_follows_the_parabola():
    """The centre of mass in flight, whatever the limbs do: closed form over the time steps."""
    scene = dataclasses.replace(humanoid_scene(load_body()), timestep=1 / 960, substeps=32)
    physics = cpu(scene, 2)
    state = default_state(scene, 2, "cpu")
    state.qpos[:, 2] += 4.0
    state.qvel[:, :3] = torch.tensor((3.0, 1.0, 2.0))
    physics.reset(torch.tensor([True, True]), state)
    geometry = Geometry(scene.body, "cpu")
    com, velocity = (x.clone() for x in geometry.center_of_mass(physics, 0))
    assert torch.allclose(velocity, torch.tensor((3.0, 1.0, 2.0)), atol=1e-5)
    generator = torch.Generator().manual_seed(1)
    steps = 20
    for _ in range(steps):
        physics.step(0.3 * torch.randn(2, scene.nu, generator=generator))
    now, now_velocity = geometry.center_of_mass(physics, 0)
    t = steps * scene.control_timestep
    # Semi-implicit Euler at step h falls g t (t + h) / 2.
    gravity = torch.tensor((0.0, 0.0, -9.81))
    expected = com + velocity * t + gravity * t * (t + scene.timestep) / 2
    assert (now - expected).abs().max() < 5e-3
    assert (now_velocity - velocity - gravity * t).abs().max() < 2e-2


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_nobody_swims_through_the_air(engine):
    """Full-strength flailing in flight: the centre of mass keeps its momentum and its parabola,
    and the angular momentum about it stays. Independent: summed over links by plain formulas."""
    if engine == "warp":
        pytest.importorskip("mujoco_warp")
    scene = make_scene("long_jump")
    options = {"device": "cpu"} if engine == "warp" else {"threads": 2}
    n = 2
    physics = make_physics(engine, scene, n, **options)
    state = default_state(scene, n, "cpu")
    state.qpos[:, 2] += 20.0
    state.qvel[:, 0] = 8.0
    state.qvel[:, 4] = torch.tensor((0.0, 3.0))
    physics.reset(torch.tensor([True, True]), state)
    geometry = Geometry(scene.body, "cpu")
    model = build_model(scene.body)

    def angular_momentum() -> torch.Tensor:
        """(N, 3) about the centre of mass, from MuJoCo's own subtree sensor."""
        rows = []
        for i in range(n):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = physics.qpos[i].numpy(), physics.qvel[i].numpy()
            mujoco.mj_forward(model, data)
            mujoco.mj_subtreeVel(model, data)
            rows.append(data.subtree_angmom[1].copy())
        return torch.tensor(np.array(rows))

    position, velocity = (x.clone() for x in geometry.center_of_mass(physics, 0))
    spin = angular_momentum()
    generator = torch.Generator().manual_seed(1)
    steps = 12
    for _ in range(steps):
        physics.step(1.5 * torch.randn(n, scene.nu, generator=generator))
    now, now_velocity = geometry.center_of_mass(physics, 0)
    t = steps * scene.control_timestep
    gravity = torch.tensor((0.0, 0.0, -9.81))
    drift = (now_velocity - velocity - gravity * t).abs().max()
    off = (now - position - velocity * t - gravity * t * (t + scene.timestep) / 2).abs().max()
    turned = (angular_momentum() - spin).abs().max()
    print(f"{engine}: drift {drift:.1e} m/s, {off:.1e} m, {turned:.1e} N m s after {t:.1f} s")
    assert drift < 1e-3 and off < 1e-3 and turned < 0.05


def test_standing_weighs_what_the_table_says():
    """Momentum theorem: the mean ground force over time is m (g + change of velocity / time)."""
    scene = dataclasses.replace(humanoid_scene(load_body()), substeps=1)
    physics = cpu(scene, 1)
    geometry = Geometry(scene.body, "cpu")
    for _ in range(120):
        physics.step(torch.zeros(1, scene.nu))
    before = geometry.center_of_mass(physics, 0)[1].clone()
    total = torch.zeros(3)
    for _ in range(120):
        physics.step(torch.zeros(1, scene.nu))
        total += physics.ground_force[0].sum((0, 1))
    change = geometry.center_of_mass(physics, 0)[1] - before
    expected = scene.body.mass * (torch.tensor((0.0, 0.0, 9.81)) + change[0] / 1.0)
    assert (total / 120 - expected).abs().max() < 2.0
    assert {
        scene.body.link_names[i] for i in physics.ground_force[0, 0].norm(dim=-1).nonzero()[:, 0]
    } <= {"L_Ankle", "R_Ankle", "L_Toe", "R_Toe"}


def test_link_velocities_are_the_derivatives_of_link_positions():
    scene = dataclasses.replace(humanoid_scene(load_body()), timestep=1e-4, substeps=1)
    physics = cpu(scene, 2)
    state = default_state(scene, 2, "cpu")
    state.qpos[:, 2] += 2.0
    state.qvel = torch.randn(2, scene.nv, generator=torch.Generator().manual_seed(3))
    physics.reset(torch.tensor([True, True]), state)
    before = physics.body_pos.clone()
    physics.step(torch.zeros(2, scene.nu))
    difference = (physics.body_pos - before) / scene.timestep
    # Semi-implicit Euler moves with the new velocity; float32 positions resolve 2.4e-3 m/s.
    assert (difference - physics.body_linvel).abs().max() < 1e-2


def thrown(physics, seed):
    """Athletes in random attitudes and motion, as shown after a reset; their states."""
    n, scene = physics.num_worlds, physics.scene
    generator = torch.Generator().manual_seed(seed)
    state = default_state(scene, n, "cpu")
    state.qpos[:, :3] = 3.0 * torch.randn(n, 3, generator=generator)
    state.qpos[:, 3:7] = torch.nn.functional.normalize(torch.randn(n, 4, generator=generator))
    state.qpos[:, 7:] = torch.randn(n, scene.nu, generator=generator)
    state.qvel[:] = 3.0 * torch.randn(n, scene.nv, generator=generator)
    physics.reset(torch.ones(n, dtype=torch.bool), state)
    return state


@pytest.mark.parametrize("name", ["smpl", "smplx"])
def test_links_are_where_mujoco_has_them(name):
    """The compiled kinematics of the CPU engine, against mj_forward link by link."""
    scene = humanoid_scene(load_body(name))
    physics = cpu(scene, 3)
    state = thrown(physics, 3)
    model = build_model(scene)
    for i in range(3):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = state.qpos[i].numpy(), state.qvel[i].numpy()
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        for b, link in enumerate(scene.body.link_names):
            body, twist = model.body(f"agent0/{link}").id, np.zeros(6)
            kind = mujoco.mjtObj.mjOBJ_XBODY
            mujoco.mj_objectVelocity(model, data, kind, body, twist, 0)
            close = {
                "body_pos": data.xpos[body],
                "body_quat": data.xquat[body],
                "body_rot": data.xmat[body].reshape(3, 3),
                "body_angvel": twist[:3],
                "body_linvel": twist[3:],
            }
            for field, expected in close.items():
                got = getattr(physics, field)[i, 0, b]
                np.testing.assert_allclose(got, expected, rtol=1e-6, atol=2e-6, err_msg=field)
        whole = np.concatenate((data.subtree_com[1], data.subtree_linvel[1]))
        np.testing.assert_allclose(physics.whole[i, 0], whole, rtol=1e-6, atol=2e-6)


def test_what_is_felt_is_what_the_tensors_say():
    """The compiled proprioception against the batched one of the other engines."""
    physics = cpu(humanoid_scene(load_body()), 4)
    thrown(physics, 8)
    heading = Heading(physics.body_rot[:, :, 0])
    quick = proprioception(physics, heading)
    physics.felt = None
    torch.testing.assert_close(quick, proprioception(physics, heading), rtol=1e-5, atol=2e-5)


def test_points_of_the_links_are_those_of_the_table():
    """Compiled and batched ``Geometry`` against the support points in the world."""
    scene = humanoid_scene(load_body(equipment=("racket",)))
    physics = cpu(scene, 5)
    thrown(physics, 2)
    compiled, plain = physics.geometry, Geometry(scene.body, "cpu")
    pos, rot = physics.body_pos[:, 0], physics.body_rot[:, 0]
    points = plain.world_points(physics.body_pos, physics.body_quat)[:, 0]
    x, bottom = points[..., 0], points[..., 2] - plain.radii
    of = [plain.owner == i for i in range(plain.num_links)]
    rear = torch.stack([(x - plain.radii)[:, i].amin(1) for i in of], 1)
    # In the second case no world has a point near the ground, or near the plane.
    for below, plane in ((float(bottom.median()), float(x.median())), (-20.0, 50.0)):
        low, near = bottom < below, (x - plane).abs() < 0.3
        assert bool(low.any()) == bool(near.any()) == (below > -20.0)
        standing = torch.stack([low[:, i].any(1) for i in of], 1)
        ends = x.masked_fill(~low, torch.inf).amin(1), x.masked_fill(~low, -torch.inf).amax(1)
        lowest = bottom.masked_fill(~near, torch.inf).amin(1)
        for geometry in (compiled, plain):
            marks = geometry.marks(pos, rot, below)
            assert (marks.standing == standing).all()
            for got, expected in zip(marks[1:], (rear, *ends), strict=True):
                torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)
            got = geometry.lowest_near(pos, rot, plane, 0.3)
            torch.testing.assert_close(got, lowest, rtol=1e-5, atol=1e-5)


def test_extent_agrees_with_the_support_points():
    scene = humanoid_scene(load_body(equipment=("racket",)))
    physics = cpu(scene, 3)
    state = default_state(scene, 3, "cpu")
    state.qpos[:, 7:] = torch.randn(3, scene.nu, generator=torch.Generator().manual_seed(0))
    physics.reset(torch.ones(3, dtype=torch.bool), state)
    direction = torch.nn.functional.normalize(torch.tensor((0.3, -0.8, 0.5)), dim=0)
    reach = physics.extent(direction)
    geometry = physics.geometry
    points = geometry.world_points(physics.body_pos, physics.body_quat)
    along = points @ direction + geometry.radii
    for link in range(scene.body.num_links):
        best = along[..., geometry.owner == link].amax(-1)
        assert torch.allclose(reach[..., link], best, atol=1e-5)


def test_mujoco_and_warp_stand_together():
    """2 s of standing under PD with contacts and with the bar resting: |dqpos| < 1e-5."""
    pytest.importorskip("mujoco_warp")
    scene = make_scene("high_jump")
    c = cpu(scene, 2)
    w = make_physics("warp", scene, 2, device="cpu")
    ctrl = torch.zeros(2, scene.nu)
    worst = 0.0
    for _ in range(60):
        c.step(ctrl)
        w.step(ctrl)
        worst = max(worst, float((c.qpos - w.qpos).abs().max()))
    print(f"mujoco against warp, 2 s standing: |dqpos| = {worst:.1e}")
    assert worst < 1e-5
    assert (c.body_linvel - w.body_linvel).abs().max() < 1e-3
    assert (c.ground_force - w.ground_force).abs().max() < 0.1
    assert int(w.overflow) == 0 and int(w.nan_worlds) == 0


def test_warp_sums_contacts_as_the_sensors_of_mujoco_do():
    """An athlete thrown onto the bar and one dropped on the ground: forces by link and by pair."""
    pytest.importorskip("mujoco_warp")
    scene = make_scene("high_jump", options={"bar_height": 1.0})
    c = cpu(scene, 2)
    w = make_physics("warp", scene, 2, device="cpu", iterations=50, line_search=50)
    state = default_state(scene, 2, "cpu")
    state.qpos[1, :3] = torch.tensor((19.8, 6.0, 1.1))
    state.qvel[1, 0] = 3.0
    ctrl = torch.zeros(2, scene.nu)
    both = torch.tensor([True, True])
    pushed = 0.0
    for physics in (c, w):
        physics.reset(both, state)
    for _ in range(6):
        c.step(ctrl)
        w.step(ctrl)
        pushed = max(pushed, float(c.pair_force[1, 0]))
        assert (c.pair_force - w.pair_force).abs().max() < 0.01 + 1e-3 * c.pair_force.max()
        assert (c.ground_force - w.ground_force).abs().max() < 0.5
    assert pushed > 1000.0


def test_a_buffer_that_overflows_is_named_and_its_world_is_bad():
    """An athlete on its feet needs more than 4 rows; one in the air needs none."""
    pytest.importorskip("mujoco_warp")
    scene = make_scene("long_jump")
    small = make_physics("warp", dataclasses.replace(scene, rows_per_world=4), 2, device="cpu")
    state = default_state(scene, 2, "cpu")
    state.qpos[1, 2] += 5.0
    small.reset(torch.tensor([True, True]), state)
    ctrl = torch.zeros(2, scene.nu)
    lost = 0
    for _ in range(6):
        small.step(ctrl)
        lost += int(small.bad[0])
        assert not small.bad[1]
    assert int(small.overflow) == lost > 0 and small.overflows() == {"nefc": lost}
    assert cpu(scene, 1).overflows() == {}


@pytest.mark.parametrize("task", ["high_jump", "long_jump"])
def test_permuting_the_worlds_permutes_every_output(task):
    n = 6
    order = torch.tensor([3, 0, 5, 1, 4, 2])
    options = {"bar_height": 1.0} if task == "high_jump" else {}
    straight = make_env(task, num_worlds=n, training=False, options=options)
    permuted = make_env(task, num_worlds=n, training=False, options=options)
    scene = straight.physics.scene
    state = default_state(scene, n, "cpu")
    generator = torch.Generator().manual_seed(7)
    state.qpos[:, 7:76] = 0.1 * torch.randn(n, 69, generator=generator)
    state.qpos[:, 0] = torch.linspace(0.0, 21.0, n)
    everyone = torch.ones(n, dtype=torch.bool)
    for env, rows in ((straight, torch.arange(n)), (permuted, order)):
        rows_state = PhysicsState(state.qpos[rows], state.qvel[rows], state.mocap_pos[rows])
        env.physics.reset(everyone, rows_state)
        context = {"bar_height": torch.full((n,), 1.0), "standing": everyone}
        env.memory = env.task.begin(env.view, context)
    for _ in range(12):
        action = 0.3 * torch.randn(n, 1, 69, generator=generator)
        a, b = straight.step(action), permuted.step(action[order])
        for name in ("obs", "final_obs", "reward", "terminated", "truncated", "valid"):
            assert torch.equal(getattr(a, name)[order], getattr(b, name)), name
        for name, value in a.terms.items():
            assert torch.equal(value[order], b.terms[name]), name
        for name, value in a.metrics.items():
            assert torch.equal(value[order].nan_to_num(-1), b.metrics[name].nan_to_num(-1)), name


def test_a_broken_world_is_counted_reset_and_alone():
    env = make_env("long_jump", num_worlds=4, training=False)
    clean = make_env("long_jump", num_worlds=4, training=False)
    action = torch.zeros(4, 1, 69)
    env.step(action), clean.step(action)
    state = PhysicsState(env.physics.qpos.clone(), env.physics.qvel.clone(), env.physics.mocap_pos)
    state.qvel[2, 10] = 1e6
    env.physics.reset(torch.tensor([False, False, True, False]), state)
    result, reference = env.step(action), clean.step(action)
    assert result.valid.tolist() == [True, True, False, True]
    assert env.physics.nan_worlds == 1
    assert torch.isfinite(result.obs).all() and torch.isfinite(result.reward).all()
    others = torch.tensor([0, 1, 3])
    assert torch.equal(result.obs[others], reference.obs[others])
    for _ in range(3):
        assert env.step(action).valid.all()


@pytest.mark.parametrize("cone", [False, True])
def test_worlds_that_vary_are_the_same_on_both_engines(cone):
    pytest.importorskip("mujoco_warp")
    scene = make_scene("long_jump", timestep_divisor=4)
    uneven = Variation(own_share=0.3, own_stride=4, uneven=0.2)
    if cone:
        uneven = Variation(cone_share=1.0, uneven=0.2)
    options = {"variation": uneven, "variation_seed": 3}
    c = cpu(scene, 4, **options)
    w = make_physics("warp", scene, 4, device="cpu", **options)
    plain = cpu(scene, 4)
    for i in range(10):
        ctrl = 0.1 * torch.sin(torch.arange(scene.nu) + 0.3 * i).expand(4, -1).clone()
        for physics in (c, w, plain):
            physics.step(ctrl)
    assert (c.qpos - w.qpos).abs().max() < 1e-4
    assert ((c.qpos - plain.qpos).abs().amax(-1) > 1e-4).all()


def test_a_coarse_world_is_a_plain_world():
    """Several substeps in one, then some of length zero, against worlds that all have that time
    step. In the air, where only the instant of the momentum's correction differs."""
    neutral = Variation((1, 1), (1, 1), (1, 1), coarse_share=0.7)
    n = 6
    fine = make_scene("long_jump", timestep_divisor=4)
    strides = draw(neutral, n, fine.substeps, 4).stride
    assert set(strides.tolist()) == {1, 2, 4}
    varied = cpu(fine, n, variation=neutral, variation_seed=4)
    plain = {s: cpu(make_scene("long_jump", timestep_divisor=4 // s), n) for s in (1, 2, 4)}
    for physics in (varied, *plain.values()):
        state = default_state(fine, n, "cpu")
        state.qpos[:, 2] += 3.0
        physics.reset(torch.ones(n, dtype=torch.bool), state)
    generator = torch.Generator().manual_seed(0)
    for _ in range(8):
        ctrl = (0.2 * torch.randn(fine.nu, generator=generator)).expand(n, -1)
        for physics in (varied, *plain.values()):
            physics.step(ctrl)
    apart = (plain[1].qpos - plain[4].qpos).abs().max()
    for stride, physics in plain.items():
        off = (varied.qpos - physics.qpos)[torch.tensor(strides == stride)].abs()
        assert off.max() < 2e-3 and off[:, :3].max() < 1e-4 and off.max() < 0.2 * apart
    with pytest.raises(ValueError, match="friction must be 0 < low <= high"):
        Variation(friction=(1.0, 0.5))


@pytest.mark.parametrize("divisor", [1, 2])
def test_a_share_of_the_worlds_that_vary_is_the_task_s_own(divisor):
    """With ground, hands and ball: bit for bit where the time step is not divided. The others are
    drawn as ever."""
    n, task = 8, "free_throw"
    scene = make_scene(task, timestep_divisor=divisor)
    mixed = Variation(own_share=0.5, own_stride=divisor)
    drawn, before = (draw(v, n, scene.substeps, 2) for v in (mixed, Variation()))
    own, others = np.flatnonzero(drawn.own), np.flatnonzero(~drawn.own)
    assert len(own) >= 2 and len(others) >= 2 and not before.own.any()
    for name in ("friction", "stiffness", "damping", "stride", "felt"):
        values, usual = getattr(drawn, name), getattr(before, name)
        assert np.array_equal(values[others], usual[others])
        expected = {"stride": divisor, "felt": False}.get(name, 1.0)
        assert (values[own] == expected).all()
    varied = cpu(scene, n, variation=mixed, variation_seed=2)
    plain = cpu(make_scene(task), n)
    body, torque = scene.body, torch.Generator().manual_seed(0)
    rest = torch.tensor(scene.action_offset(), dtype=torch.float32)
    for _ in range(6):
        ctrl = (rest + 0.05 * torch.randn(body.num_dofs, generator=torque)).expand(n, -1)
        varied.step(ctrl)
        plain.step(ctrl)
    off = (varied.qpos - plain.qpos).abs().amax(-1)
    assert (off[own] == 0.0).all() if divisor == 1 else (off[own] < 1e-3).all()
    assert (off[others] > 10.0 * off[own].max() + 1e-6).all()
    felt = draw(mixed, n, scene.substeps, 2, all_felt=True)
    assert felt.felt.all() and not felt.own.any()
    for wrong in ({"own_share": -0.1}, {"own_share": 1.1}, {"own_stride": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Variation(**wrong)
    with pytest.raises(ValueError, match="does not divide"):
        draw(Variation(own_stride=3), n, scene.substeps, 0)


def test_a_share_of_the_worlds_that_vary_has_a_round_cone_of_friction(monkeypatch):
    """Bit for bit what MuJoCo does whose model says so; on a GPU all of them or none."""
    scene, n = make_scene("long_jump"), 6
    plain = Variation((1, 1), (1, 1), (1, 1), cone_share=0.5, felt_share=0.0)
    drawn = dataclasses.replace(draw(plain, n, scene.substeps, 1), own=np.ones(n, dtype=bool))
    round_ones = torch.tensor(drawn.cone)
    assert 0 < drawn.cone.sum() < n
    assert not draw(Variation(own_share=1.0, cone_share=1.0), n, scene.substeps, 0).cone.any()
    own = Variation(own_share=1.0, cone_share=1.0, own_cone=True)
    assert draw(own, n, scene.substeps, 0).cone.all()
    monkeypatch.setattr(engine, "draw", lambda *_: drawn)
    varied, pyramids = cpu(scene, n, variation=plain), cpu(scene, n)
    model = build_model(scene)
    model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    monkeypatch.setattr(engine, "build_model", lambda _: model)
    cones = cpu(scene, n)
    generator = torch.Generator().manual_seed(0)
    for _ in range(8):
        ctrl = (0.5 * torch.randn(scene.nu, generator=generator)).expand(n, -1)
        for physics in (varied, pyramids, cones):
            physics.step(ctrl)
    assert torch.equal(varied.qpos[round_ones], cones.qpos[round_ones])
    assert torch.equal(varied.qpos[~round_ones], pyramids.qpos[~round_ones])
    assert (cones.qpos[0] - pyramids.qpos[0]).abs().max() > 1e-4
    pytest.importorskip("mujoco_warp")
    with pytest.raises(ValueError, match="in all worlds or in none"):
        make_physics("warp", scene, 8, device="cpu", variation=Variation(cone_share=0.5))


def test_uneven_sides_are_a_mirror_image_of_the_other_way_round(monkeypatch):
    """In the air, with the same targets for both sides: the world whose left side is the stiffer
    one is what a mirror shows of the world whose right side is, but for the body's own sides. In
    the task's own worlds both are alike."""
    scene, n = make_scene("long_jump"), 3
    one = Variation((1, 1), (1, 1), (1, 1), uneven=0.3)
    drawn = draw(one, n, scene.substeps, 0)
    assert (np.abs(drawn.side) <= 0.3).all() and len(set(drawn.side)) == n
    assert np.array_equal(drawn.felt, draw(Variation(), n, scene.substeps, 0).felt)
    own = draw(dataclasses.replace(one, own_share=0.5), 64, scene.substeps, 0)
    assert (own.side[own.own] == 0.0).all() and (own.side[~own.own] != 0.0).all()

    sides = np.array([0.3, -0.3, 0.0])
    alike = dataclasses.replace(drawn, side=sides, felt=np.zeros(n, dtype=bool))
    monkeypatch.setattr(engine, "draw", lambda *_: alike)
    physics = cpu(scene, n, variation=one)
    state = default_state(scene, n, "cpu")
    state.qpos[:, 2] += 5.0
    physics.reset(torch.ones(n, dtype=torch.bool), state)
    rest = state.qpos.double().numpy()
    generator = np.random.default_rng(0)
    for _ in range(6):
        ctrl = 0.6 * np.tile(generator.standard_normal(scene.nu), (n, 1))
        seen = Clip(fps=30.0, body="smpl", qpos=rest, qvel=np.zeros((n, scene.nv)), ctrl=ctrl)
        physics.step(torch.tensor(0.5 * (ctrl + seen.mirrored().ctrl), dtype=torch.float32))
    qpos = physics.qpos.double().numpy()
    mirror = Clip(fps=30.0, body="smpl", qpos=qpos, qvel=np.zeros((n, scene.nv))).mirrored().qpos
    uneven = np.abs(mirror[0] - qpos[0]).max()
    assert uneven > 0.05
    assert np.abs(mirror[0] - qpos[1]).max() < 0.2 * uneven
    assert np.abs(mirror[2] - qpos[2]).max() < 0.2 * uneven
    with pytest.raises(ValueError, match="uneven must be in"):
        Variation(uneven=1.0)


def test_resets_are_decided_by_the_seed():
    a, b, c = (make_env("high_jump", num_worlds=3, seed=s) for s in (5, 5, 6))
    assert torch.equal(a.physics.qpos, b.physics.qpos) and torch.equal(a.age, b.age)
    assert not torch.equal(a.physics.qpos, c.physics.qpos)


def test_a_saved_state_continues_bit_for_bit():
    """Through falls and new starts, of which some are drawn before the state is saved."""
    generator = torch.Generator().manual_seed(2)
    actions = 0.2 * torch.randn(90, 4, 1, 69, generator=generator)
    first = make_env("high_jump", num_worlds=4, seed=1)
    falls = torch.zeros(2)
    for action in actions[:45]:
        falls[0] += first.step(action).terminated.sum()
    saved = first.state_dict()
    kept = {k: v.clone() for k, v in saved.items()}
    second = make_env("high_jump", num_worlds=4, seed=9)
    second.load_state_dict(saved)
    for action in actions[45:]:
        a, b = first.step(action), second.step(action)
        falls[1] += a.terminated.sum()
        assert torch.equal(a.obs, b.obs) and torch.equal(a.reward, b.reward)
    assert (falls >= 4).all()
    for name, value in kept.items():
        torch.testing.assert_close(saved[name], value, rtol=0, atol=0, equal_nan=True)


def test_a_start_worked_out_ahead_is_a_reset():
    """``prepare`` and ``restart`` of some worlds against ``reset`` of the same ones."""
    scene = make_scene("high_jump")
    generator = torch.Generator().manual_seed(5)
    state = default_state(scene, 5, "cpu")
    state.qpos[:, 7:76] += 0.2 * torch.randn(5, 69, generator=generator)
    state.qvel += torch.randn(state.qvel.shape, generator=generator)
    ahead, plain = cpu(scene, 5), cpu(scene, 5)
    ctrl = 0.3 * torch.randn(5, scene.nu, generator=generator)
    for physics in (ahead, plain):
        for _ in range(3):
            physics.step(ctrl)
    prepared = ahead.prepare(state)
    ahead.restart(torch.tensor([4, 1]), prepared)
    plain.reset(torch.tensor([False, True, False, False, True]), state)
    for _ in range(2):
        for name in ("qpos", "qvel", "mocap_pos", "body_pos", "body_quat", "body_rot", "felt"):
            assert torch.equal(getattr(ahead, name), getattr(plain, name)), name
        for name in ("body_linvel", "body_angvel", "ground_force", "pair_force", "object_pos"):
            assert torch.equal(getattr(ahead, name), getattr(plain, name)), name
        for name, value in plain.extra_state().items():
            got = ahead.extra_state()[name]
            torch.testing.assert_close(got, value, rtol=0, atol=0, equal_nan=True)
        ahead.step(ctrl)
        plain.step(ctrl)


def test_every_episode_starts_as_the_first():
    """Without noise the observation after a fall is that of the reset; with it, each is new."""
    env = make_env("long_jump", num_worlds=3, training=False)
    noisy = make_env("long_jump", num_worlds=3, seed=4)
    first = env.reset()
    actions = 0.5 * torch.randn(60, 3, 1, 69, generator=torch.Generator().manual_seed(0))
    starts, falls = [], 0
    for action in actions:
        result = env.step(action)
        falls += int(result.terminated.sum())
        over = result.ended
        assert torch.equal(result.obs[over], first[over])
        assert torch.equal(result.obs[~over], result.final_obs[~over])
        assert (env.view.clock[over] == 0).all()
        result = noisy.step(action)
        starts += list(result.obs[result.ended].flatten(1))
    assert falls >= 6 and len(starts) >= 6
    starts = torch.stack(starts)
    assert (torch.cdist(starts, starts) + 10 * torch.eye(len(starts)) > 0.05).all()


def test_two_athletes_share_a_world():
    """The agent axis: far apart, each does what one alone does, in its own heading frame."""
    body = load_body()
    alone = cpu(humanoid_scene(body), 1)
    pair = cpu(
        dataclasses.replace(humanoid_scene(body), agents=(Start(0, 0, 0), Start(5, 3, 2.0))), 1
    )
    generator = torch.Generator().manual_seed(4)
    for physics in (alone, pair):  # in the air: friction's pyramid has a direction
        state = default_state(physics.scene, 1, "cpu")
        for agent in range(physics.scene.num_agents):
            state.qpos[:, physics.scene.agent_qpos(agent).start + 2] += 3.0
        physics.reset(torch.tensor([True]), state)
    for _ in range(10):
        ctrl = 0.2 * torch.randn(1, body.num_dofs, generator=generator)
        alone.step(ctrl)
        pair.step(torch.cat((ctrl, ctrl), dim=1))
    one = proprioception(alone, Heading(alone.body_rot[:, :, 0]))
    two = proprioception(pair, Heading(pair.body_rot[:, :, 0]))
    assert two.shape == (1, 2, 358)
    assert (two[:, 0] - one[:, 0]).abs().max() < 1e-3
    assert (two[:, 1] - one[:, 0]).abs().max() < 1e-3


def test_wrong_use_is_one_sentence():
    with pytest.raises(ValueError, match="unknown task 'curling'; known: high_jump"):
        make_env("curling")
    with pytest.raises(ValueError, match="no option 'bar'; it has: bar_height, curriculum"):
        make_env("high_jump", options={"bar": 1.0})
    with pytest.raises(ValueError, match=r"between 0\.1 and 3\.0"):
        make_env("high_jump", options={"bar_height": 30.0})
    with pytest.raises(ValueError, match="at least 1, not 0"):
        make_env("high_jump", num_worlds=0)
    with pytest.raises(ValueError, match="unknown engine 'bullet'"):
        make_env("high_jump", engine="bullet")
    with pytest.raises(ValueError, match="action has shape"):
        make_env("long_jump", num_worlds=2).step(torch.zeros(2, 69))
    if not torch.cuda.is_available():
        pytest.importorskip("mujoco_warp")
        with pytest.raises(RuntimeError, match="found no GPU"):
            make_env("long_jump", engine="warp", num_worlds=2)


def test_what_links_touch_rebounds_in_a_share_of_the_worlds_that_vary():
    """Only there, only those links, as the mixing of MuJoCo has it; balls keep their own law."""
    scene, n = make_scene("boxing", timestep_divisor=4), 32
    usual = Variation(own_share=0.3, own_stride=4)
    gloves = dataclasses.replace(usual, rebound_share=0.5, rebound_links=("L_Hand", "R_Hand"))
    drawn, before = (draw(v, n, scene.substeps, 5) for v in (gloves, usual))
    assert 4 <= drawn.rebound.sum() < n and not (drawn.rebound & drawn.own).any()
    assert (drawn.stride[drawn.rebound] == 1).all()
    model, plain = build_model(scene), build_model(scene)
    let_rebound(model, scene, gloves.rebound_links)
    solref, solimp = contact_softness(model, drawn)
    hands = [model.body(f"agent{a}/{h}").id for a in (0, 1) for h in gloves.rebound_links]
    glove = np.isin(model.geom_bodyid, hands)
    assert glove.sum() == 4
    bounces = drawn.rebound[:, None] & glove
    assert np.allclose(solref[bounces], REBOUND_SOLREF)
    for got, expected in zip((solref, solimp), contact_softness(plain, before)):
        assert np.array_equal(got[~bounces], expected[~bounces])
    # A glove that lies in the other's chest: the contact has the glove's numbers, not a mean.
    world = int(np.flatnonzero(drawn.rebound)[0])
    model.geom_solref[:] = solref[world]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    gap = data.body("agent1/Chest").xpos - data.body("agent0/L_Hand").xpos
    data.qpos[:3] += gap - (0.1, 0.0, 0.0)
    mujoco.mj_forward(model, data)
    touching = [c for c in data.contact if glove[c.geom].sum() == 1]
    assert touching and all(np.allclose(c.solref, REBOUND_SOLREF) for c in touching)

    football = make_scene("penalty_kick")
    model = build_model(football)
    let_rebound(model, football, ("R_Toe",))
    fine = dataclasses.replace(gloves, coarse_share=0.0, own_stride=1)
    own = contact_softness(model, draw(fine, 4, football.substeps, 1))[0]
    ball = model.geom_bodyid == model.body("ball").id
    assert (own[:, ball] == build_model(football).geom_solref[ball]).all() and ball.any()
    assert (model.geom_priority[ball] > model.geom_priority[~ball].max()).all()
    with pytest.raises(ValueError, match="rebound_links has 'Sword', which is no link"):
        cpu(scene, 2, variation=Variation(rebound_share=1.0, rebound_links=("Sword",)))
    with pytest.raises(ValueError, match="rebound_share must be in"):
        Variation(rebound_share=1.5)


def test_links_rebound_alike_on_both_engines():
    """A fencer runs the blade into the other's chest: other motion than in worlds that do not."""
    pytest.importorskip("mujoco_warp")
    scene = make_scene("fencing", timestep_divisor=4)
    one = (1.0, 1.0)
    plain = Variation(one, one, one, coarse_share=0.0, felt_share=0.0)
    rebound = dataclasses.replace(plain, rebound_share=1.0)
    worlds = [
        cpu(scene, 2, variation=plain),
        cpu(scene, 2, variation=rebound),
        make_physics("warp", scene, 2, device="cpu", variation=rebound),
    ]
    state = default_state(scene, 2, "cpu")
    state.qpos[:, :2] += torch.tensor([1.3, 0.16])
    state.qvel[:, 0] = 2.0
    for physics in worlds:
        physics.reset(torch.ones(2, dtype=torch.bool), state)
    rest = torch.tensor(scene.action_offset(), dtype=torch.float32).repeat(2, 2)
    for _ in range(6):
        for physics in worlds:
            physics.step(rest)
    stays, leaves, on_gpu = (physics.qpos for physics in worlds)
    assert (leaves - on_gpu).abs().max() < 2e-3
    assert (leaves - stays).abs().max() > 2e-2


def test_feet_that_are_pushed_apart_creep_less_where_friction_is_stiffer():
    """Legs that press outwards move standing feet apart, with stiff friction hardly, alike on both
    engines; a share of the worlds is the task's own, and draws span the range."""
    pytest.importorskip("mujoco_warp")
    scene, n = make_scene("long_jump"), 2
    one = (1.0, 1.0)
    soft = Variation(one, one, one, coarse_share=0.0, felt_share=0.0, cone_share=1.0)
    stiff = dataclasses.replace(soft, impratio=(30.0, 30.0))
    worlds = [
        cpu(scene, n, variation=soft),
        cpu(scene, n, variation=stiff),
        make_physics("warp", scene, n, device="cpu", variation=stiff),
    ]
    feet = [scene.body.link_index(f"{side}_Ankle") for side in "LR"]
    apart = torch.tensor(scene.action_offset(), dtype=torch.float32).repeat(n, 1)
    for name, sign in (("L_Hip_x", 1.0), ("R_Hip_x", -1.0)):
        apart[:, scene.body.dof_index(name)] += 0.1 * sign
    crept = []
    for physics in worlds:
        distance = []
        for _ in range(30):
            physics.step(apart)
            distance.append(float(physics.body_pos[0, 0, feet].diff(dim=0).norm()))
        crept.append(distance[-1] - distance[11])  # they stand by then
    yields, sticks, on_gpu = crept
    print(f"feet creep {yields:.4f} m, with an impratio of 30 {sticks:.4f} m")
    assert yields > 0.005 and sticks < 0.1 * yields
    assert sticks == pytest.approx(on_gpu, abs=5e-4)

    drawn = draw(Variation(impratio=(1.0, 30.0), own_share=0.3), 400, scene.substeps, 3)
    usual = draw(Variation(own_share=0.3), 400, scene.substeps, 3)
    assert (drawn.impratio[drawn.own] == 1.0).all() and (usual.impratio == 1.0).all()
    others = drawn.impratio[~drawn.own]
    assert others.min() >= 1.0 and others.max() <= 30.0
    assert np.median(others) == pytest.approx(np.sqrt(30.0), rel=0.2)
    assert all(
        np.array_equal(getattr(drawn, name), value)
        for name, value in vars(usual).items()
        if name != "impratio"
    )
    with pytest.raises(ValueError, match="impratio must be 0 < low <= high"):
        Variation(impratio=(0.0, 1.0))
