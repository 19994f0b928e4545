"""The faster pieces of MuJoCo Warp's step against C MuJoCo's own numbers."""

from __future__ import annotations

import re
import sys
from contextlib import nullcontext
from types import SimpleNamespace

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp
from mujoco_warp._src import passive, smooth, solver, support, types

from sports.env import make_scene
from sports.humanoid.mjcf import build_model
from sports.physics import warp_tree
from sports.physics.warp import WarpPhysics
from sports.physics.warp_pieces import TILE, faster, find_tiles
from sports.physics.warp_tree import trees

DEVICES = ["cpu", pytest.param("cuda:0", marks=pytest.mark.skipif(not torch.cuda.is_available(),
                                                               reason="needs a GPU"))]  # fmt: skip


def _crumpled(physics: WarpPhysics, seed: int = 0, spread: float = 0.3) -> torch.Tensor:
    """Other poses in every world."""
    noise = torch.Generator().manual_seed(seed)
    pose = physics.qpos.cpu() + spread * torch.randn(physics.qpos.shape, generator=noise)
    scene = physics.scene
    free = [scene.agent_qpos(a) for a in range(scene.num_agents)]
    free += [scene.object_qpos(item.name) for item in scene.free_objects]
    for part in free:
        turn = slice(part.start + 3, part.start + 7)
        pose[:, turn] = torch.nn.functional.normalize(pose[:, turn], dim=-1)
    return pose


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("task", ["long_jump", "javelin", "tennis_1v1"])
def test_systems_with_the_inertia_are_solved(task: str, device: str):
    """Against C MuJoCo in double precision, with and without more on the diagonal."""
    physics = WarpPhysics(make_scene(task), 3, device)
    model = build_model(physics.scene, sensors=False)
    data = mujoco.MjData(model)
    physics.qpos.copy_(_crumpled(physics))
    m, d = physics.m, physics.d
    noise = torch.Generator().manual_seed(1)
    force = torch.randn(3, model.nv, generator=noise)
    damping = torch.rand(3, model.nv, generator=noise)
    entry = torch.tensor(model.M_rowadr + model.M_rownnz - 1).long()
    with wp.ScopedDevice(device), faster(trees(model, 3)):
        smooth.kinematics(m, d)
        smooth.com_pos(m, d)
        smooth.crb(m, d)
        smooth.factor_m(m, d)  # not needed
        y = wp.array(force.numpy(), dtype=float)
        x, damped = wp.zeros((3, model.nv), dtype=float), wp.clone(d.M)
        wp.to_torch(damped)[:, entry.to(device)] += damping.to(device)
        smooth.solve_m(m, d, x, y)
        bare = x.numpy().copy()
        smooth.factor_solve_i(m, d, damped, None, None, x, y)
        product = wp.full((3, model.nv), 7.0, dtype=float)
        support.mul_m(m, d, product, y, wp.array([False, True, False], dtype=bool))
    assert (product.numpy()[1] == 7.0).all()  # told to skip it
    for world in range(3):
        data.qpos[:] = physics.qpos[world].cpu().numpy()
        mujoco.mj_forward(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        if world != 1:
            expected = inertia @ force.numpy()[world]
            assert np.abs(product.numpy()[world] - expected).max() < 1e-4 * np.abs(expected).max()
        for found, more in ((bare, 0.0), (x.numpy(), damping[world].double().numpy())):
            expected = np.linalg.solve(
                inertia + np.diag(more * np.ones(model.nv)), force.numpy()[world]
            )
            assert np.abs(found[world] - expected).max() < 1e-3 * np.abs(expected).max()
    physics.close()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("task", "room"), [("boxing", 44), ("basketball_1v1", 44), ("boxing", 3), ("long_jump", 0)]
)
def test_newton_s_direction(task: str, room: int, device: str, monkeypatch):
    """Against the Hessian of the engine's own rows in double precision, where half of the
    constraints push; with room for few rows that couple bodies the others weigh twice, on both."""
    monkeypatch.setattr(warp_tree, "COUPLED", max(room, 1))
    warp_tree._newton_kernel.cache_clear()
    scene, worlds = make_scene(task), 3
    physics = WarpPhysics(scene, worlds, device)
    model = build_model(scene, sensors=False)
    pose = _crumpled(physics, 3, 0.2)
    if scene.num_agents == 2:  # into one another
        first, second = (scene.agent_qpos(a) for a in range(2))
        pose[:, second][:, :2] = pose[:, first][:, :2] + 0.3
    pose[:, scene.agent_qpos(0)][:, 2] -= 0.1  # into the ground
    physics.qpos.copy_(pose)
    m, d, nv = physics.m, physics.d, model.nv
    with wp.ScopedDevice(device):
        own = trees(model, worlds)
        assert own.whole
        mjw.forward(m, d)
        counts, noise = d.nefc.numpy(), np.random.default_rng(0)
        state = noise.integers(0, 2, d.efc.state.shape).astype(np.int32)
        d.efc.state = wp.array(state, dtype=int)
        moved, smoothly, held = noise.normal(size=(3, worlds, nv)).astype(np.float32)
        d.efc.Ma, d.qfrc_smooth, d.qfrc_constraint = (
            wp.array(each, dtype=float) for each in (moved, smoothly, held)
        )
        gradient = moved - smoothly - held
        ctx = SimpleNamespace(
            done=wp.array([False, False, True], dtype=bool),
            state_changed_count=wp.array([1, 0, 1], dtype=int),
            alpha=wp.array([0.25, 0.25, 0.25], dtype=float),
            grad=wp.full((worlds, nv), 5.0, dtype=float),
            grad_dot=wp.full(worlds, 2.0, dtype=float),
            grad_scale=wp.full(worlds, 0.5, dtype=float),
            search_unchanged=wp.zeros(worlds, dtype=bool),
            search=wp.full((worlds, nv), 7.0, dtype=float),
            search_dot=wp.zeros(worlds, dtype=float),
            newton_decrement=wp.full(worlds, 4.0, dtype=float),
        )
        own.direction(m, d, ctx, True)
        # Nothing changed there, or it is done: left as it was, but shorter by the step's share.
        assert (ctx.search.numpy()[1:] == 7.0).all() and (ctx.grad.numpy()[1:] == 5.0).all()
        assert ctx.search_unchanged.numpy().tolist() == [False, True, True]
        assert ctx.grad_scale.numpy().tolist() == [1.0, 0.25, 0.5]
        assert ctx.grad_dot.numpy()[1:].tolist() == [0.5, 2.0]
        assert ctx.newton_decrement.numpy()[1:].tolist() == [1.0, 4.0]
        own.direction(m, d, ctx, False)
        assert not ctx.search_unchanged.numpy().any()
        assert np.allclose(ctx.grad.numpy()[:2], gradient[:2], atol=1e-6)
        assert np.allclose(ctx.grad_dot.numpy()[:2], (gradient[:2] ** 2).sum(-1), rtol=1e-5)
        found = -ctx.search.numpy().astype(float)
    assert (found[2] == -7.0).all()
    J, rows = d.efc.J.numpy()[:, 0], d.efc
    columns, starts, lengths = (
        each.numpy() for each in (rows.J_colind, rows.J_rowadr, rows.J_rownnz)
    )
    masses, entries = rows.D.numpy(), d.M.numpy()
    kinds, ids, geoms = rows.type.numpy(), rows.id.numpy(), d.contact.geom.numpy()
    tree = np.asarray(model.body_treeid)[np.asarray(model.geom_bodyid)]
    for world in range(2):
        moved = 0
        inertia = np.zeros((nv, nv))
        for k in range(nv):
            for e in range(model.M_rowadr[k], model.M_rowadr[k] + model.M_rownnz[k]):
                c = model.M_colind[e]
                inertia[k, c] = inertia[c, k] = entries[world, e]
        hessian = inertia.copy()
        for e in range(min(counts[world], d.njmax)):
            if not state[world, e]:
                continue
            j = np.zeros(nv)
            own_row = slice(starts[world, e], starts[world, e] + lengths[world, e])
            j[columns[world, 0, own_row]] = J[world, own_row]
            hessian += masses[world, e] * np.outer(j, j)
            limit = kinds[world, e] == int(types.ConstraintType.LIMIT_JOINT)
            both = not limit and (tree[geoms[ids[world, e]]] >= 0).all()
            moved += both
        step, g = np.linalg.solve(hessian, gradient[world, :nv]), gradient[world, :nv].astype(float)
        decrement = ctx.newton_decrement.numpy()[world]
        assert np.isclose(decrement, g @ found[world], rtol=1e-4)
        assert np.isclose(ctx.search_dot.numpy()[world], found[world] @ found[world], rtol=1e-4)
        if room == 44:
            assert 3 < moved <= room
            error = found[world] - step
            assert error @ hessian @ error < 1e-8 * (step @ hessian @ step)
        else:
            # A model of the cost that is nowhere below the true one: a shorter step that descends.
            assert 0.0 < decrement <= 1.0001 * (g @ step)
            assert found[world] @ hessian @ found[world] <= 1.0001 * decrement
    physics.close()
    warp_tree._newton_kernel.cache_clear()


@pytest.mark.parametrize("device", DEVICES)
def test_tiles_with_an_entry_are_found(device: str):
    size, worlds = 3 * TILE, 4
    hessian = np.zeros((worlds, size, size), dtype=np.float32)
    hessian[:, np.arange(size), np.arange(size)] = 1.0
    hessian[0, 3, TILE + 5] = 1e-30
    hessian[1, TILE + 1, TILE + 2] = -2.0
    hessian[1, TILE - 1, 3 * TILE - 1] = 1.0
    hessian[2:, 0, 1] = 1.0
    hessian[:, size - 1, 0] = 7.0  # below the diagonal: not looked at
    before = np.full((worlds, 3, 3), 9, dtype=np.int32)
    with wp.ScopedDevice(device):
        ctx = SimpleNamespace(
            done=wp.array([False, False, False, True], dtype=bool),
            h=wp.array(hessian, dtype=float),
            h_tile_nz=wp.array(before, dtype=int),
            quad_changed_count=wp.array([1, 1, 0, 1], dtype=int),
            state_changed_count=wp.array([1, 1, 1, 1], dtype=int),
        )
        find_tiles(None, SimpleNamespace(nworld=worlds), ctx, True, True)
        found = ctx.h_tile_nz.numpy()
    assert np.argwhere(found[0]).tolist() == [[0, 1]]
    assert np.argwhere(found[1]).tolist() == [[0, 2], [1, 1]]
    # Nothing changed there, or it is done: left as it was.
    assert (found[2:] == 9).all()


def test_the_library_is_as_before_outside_the_block():
    def inner() -> tuple:
        return (
            passive.passive,
            smooth.factor_m,
            smooth.factor_solve_i,
            smooth.solve_m,
            solver._cholesky_factorize_solve,
            solver._create_solver_context,
            solver._update_gradient,
            solver._update_gradient_incremental,
        )

    own = inner()
    model = build_model(make_scene("long_jump"))
    with wp.ScopedDevice("cpu"), pytest.raises(ZeroDivisionError), faster(trees(model, 1)):
        assert not set(inner()) & set(own)
        raise ZeroDivisionError
    assert inner() == own


@pytest.mark.skipif(sys.platform == "darwin", reason="Warp knows no GPU there")
def test_the_native_code_compiles_for_a_gpu_and_fits_it(tmp_path):
    """Of the largest model, without a GPU, for an old one."""
    with wp.ScopedDevice("cpu"):
        own = trees(build_model(make_scene("basketball_2v2"), sensors=False), 1)
    assert own.plain and own.whole
    sizes = own.bodies, own.dofs
    wanted = {
        warp_tree._newton_kernel(*sizes): warp_tree.room(*sizes, warp_tree.COUPLED),
        warp_tree._solve_kernel(*sizes): warp_tree.room(*sizes),
        warp_tree._multiply_kernel(own.bodies): 4 * 6 * own.bodies,
    }
    declared = re.compile(r"\.shared\s+\.align \d+ \.([a-z])(\d+) \w+(?:\[(\d+)\])?;")
    for kernel, size in wanted.items():
        folder, before = tmp_path / kernel.key, dict(kernel.module.options)
        kernel.module.options["block_dim"] = max(own.lanes, warp_tree.AGAIN)
        wp.compile_aot_module(kernel.module, arch=75, module_dir=str(folder), use_ptx=True)
        kernel.module.options.update(before)
        (ptx,) = (path.read_text() for path in folder.iterdir() if path.suffix == ".ptx")
        shared = sum(int(bits) // 8 * int(n or 1) for _, bits, n in declared.findall(ptx))
        assert size <= shared <= 48 * 1024
        assert shared - size in (0, 512)  # Warp's own


def test_a_world_without_room_for_its_trees_keeps_the_library_s_own_pieces(monkeypatch):
    model = build_model(make_scene("long_jump"))
    theirs = smooth.solve_m, solver._update_gradient
    with wp.ScopedDevice("cpu"):
        monkeypatch.setattr(warp_tree, "ROOM", 4 * (27 * 24 + 8 * 75))  # for the inertia alone
        own = trees(model, 1)
        assert (own.bodies, own.dofs, own.plain, own.whole) == (24, 75, True, False)
        with faster(own):
            assert smooth.solve_m != theirs[0] and solver._update_gradient == theirs[1]
        monkeypatch.setattr(warp_tree, "ROOM", 0)
        with faster(trees(model, 1)):
            assert (smooth.solve_m, solver._update_gradient) == theirs


@pytest.mark.parametrize("task", ["long_jump", "javelin", "tennis_1v1", "basketball_1v1"])
def test_a_step_is_the_same_with_the_library_s_own_pieces(task: str, monkeypatch):
    """Three flailing control steps of 4 worlds, to rounding of single precision."""
    ends = []
    for own in (True, False):
        with monkeypatch.context() as patch:
            if not own:
                patch.setattr("sports.physics.warp.faster", lambda trees: nullcontext())
            physics = WarpPhysics(make_scene(task), 4, "cpu")
            offset = torch.tensor(physics.scene.action_offset(), dtype=torch.float32)
            noise = torch.Generator().manual_seed(1)
            targets = offset.repeat(physics.scene.num_agents)
            for _ in range(3):
                shake = torch.randn(4, len(targets), generator=noise)
                physics.step(targets + 0.2 * shake)
            ends.append(physics.qpos.clone())
            physics.close()
    assert (ends[0] - ends[1]).abs().max() < 2e-4
    assert (ends[0] - ends[0][:1]).abs().max() > 1e-2


@pytest.mark.parametrize("device", DEVICES)
def test_a_racket_deep_in_a_box_does_not_overflow(device: str):
    """Where the library alone runs out of room; a depth that is found is C MuJoCo's."""
    spec = """<mujoco><worldbody>
      <body><freejoint/><geom type="cylinder" size="0.075 0.01"/></body>
      <body><freejoint/><geom type="box" size="0.06 0.1 0.04"/></body>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(spec)
    data = mujoco.MjData(model)
    drawn, count = np.random.default_rng(0), 100_000
    poses = np.zeros((count, 14), dtype=np.float32)
    poses[:, 7:10] = drawn.uniform(-0.2, 0.2, (count, 3)) * drawn.uniform(0, 1, (count, 1))
    for first in (3, 10):
        turn = drawn.normal(size=(count, 4))
        poses[:, first : first + 4] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    # Found by playing all of them.
    poses = poses[
        [16270, 16299, 17001, 24139, 25996, 26605, 32326, 35204, 56385, 76651, 82170, 95626]
    ]
    missed, depths = [], []
    with wp.ScopedDevice(device):
        m = mjw.put_model(model)
        m.opt.warn_overflow = 0
        for room in (nullcontext(), faster(trees(model, 1))):
            d = mjw.put_data(model, data, nworld=len(poses), nconmax=16, njmax=64)
            wp.copy(d.qpos, wp.array(poses, dtype=float))
            with room:
                mjw.kinematics(m, d)
                mjw.collision(m, d)
            missed.append((d.overflow.numpy() != 0).sum())
            count = d.nacon.numpy()[0]
            depths = np.zeros(len(poses))
            worlds = d.contact.worldid.numpy()[:count]
            np.minimum.at(depths, worlds, d.contact.dist.numpy()[:count])
    assert missed[1] == 0 < missed[0]
    found = 0
    for pose, depth in zip(poses, depths, strict=True):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        if depth < 0.0:
            found += 1
            assert abs(data.contact.dist.min() - depth) < 1e-3 and depth < -0.01
    assert found >= 2
