"""The faster pieces of MuJoCo Warp's step against C MuJoCo's own numbers."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp
from mujoco_warp._src import smooth, solver

from sports.env import make_scene
from sports.humanoid.mjcf import build_model
from sports.physics.warp import WarpPhysics
from sports.physics.warp_factor import TILE, faster, find_tiles, pieces

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(),
                                                               reason="needs a GPU"))]  # fmt: skip


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("task", ["long_jump", "javelin", "tennis_1v1"])
def test_the_inertia_of_every_world_is_factored_and_solved(task: str, device: str):
    """Against C MuJoCo in double precision, at other poses in every world."""
    scene = make_scene(task)
    physics = WarpPhysics(scene, 3, device)
    model = build_model(scene, sensors=False)
    data = mujoco.MjData(model)
    noise = torch.Generator().manual_seed(0)
    pose = physics.qpos.cpu() + 0.3 * torch.randn(physics.qpos.shape, generator=noise)
    pose[:, 3:7] = torch.nn.functional.normalize(pose[:, 3:7], dim=-1)
    physics.qpos.copy_(pose)
    m, d = physics.m, physics.d
    factors = []
    force = torch.randn(3, model.nv, generator=noise)
    with wp.ScopedDevice(device), faster(pieces(model)):
        smooth.kinematics(m, d)
        smooth.com_pos(m, d)
        smooth.crb(m, d)
        solved = []
        for solve in (False, True):
            wp.to_torch(d.qLD).fill_(torch.nan)
            wp.to_torch(d.qLDiagInv).fill_(torch.nan)
            if solve:
                x, y = wp.zeros((3, model.nv), dtype=float), wp.array(force.numpy(), dtype=float)
                smooth.factor_solve_i(m, d, d.M, d.qLD, d.qLDiagInv, x, y)
                solved = x.numpy()
            else:
                smooth.factor_m(m, d)
            factors.append((d.qLD.numpy()[:, m.qLD_block_total :], d.qLDiagInv.numpy()))
    sparse = m.qLD_block_adr.numpy() == -1
    assert sparse.sum() == (150 if task == "tennis_1v1" else scene.body.num_dofs + 6)
    for world in range(3):
        data.qpos[:] = physics.qpos[world].cpu().numpy()
        mujoco.mj_forward(model, data)
        for factor, inverse in factors:
            assert np.abs(inverse[world] / data.qLDiagInv - 1)[sparse].max() < 1e-4
            for k in np.flatnonzero(sparse):
                row = slice(model.M_rowadr[k], model.M_rowadr[k] + model.M_rownnz[k] - 1)
                assert np.allclose(factor[world, row], data.qLD[row], atol=5e-4)
        expected = np.zeros((1, model.nv))
        mujoco.mj_solveM(model, data, expected, force[world : world + 1].double().numpy())
        assert np.abs(solved[world] - expected).max() < 1e-3 * np.abs(expected).max()
    physics.close()


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
        return smooth._factor_i_sparse, solver._cholesky_factorize_solve

    own = inner()
    with pytest.raises(ZeroDivisionError), faster(pieces(build_model(make_scene("long_jump")))):
        assert not set(inner()) & set(own)
        raise ZeroDivisionError
    assert inner() == own


@pytest.mark.parametrize("task", ["long_jump", "javelin", "tennis_1v1", "basketball_1v1"])
def test_a_step_is_the_same_with_the_library_s_own_pieces(task: str, monkeypatch):
    """Three flailing control steps of 4 worlds, to rounding of single precision."""
    ends = []
    for own in (True, False):
        with monkeypatch.context() as patch:
            if not own:
                patch.setattr("sports.physics.warp.faster", lambda pieces: nullcontext())
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
        for room in (nullcontext(), faster(pieces(model))):
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
