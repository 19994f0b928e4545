"""Contacts that feel the joints' damping: against MuJoCo's own explicit step, against refinement of
the time step, in the air, and in worlds that differ."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

import sports.physics.mujoco as engine
from sports.env import make_scene
from sports.humanoid.mjcf import build_model, firm_ground
from sports.physics import Physics, PhysicsState, default_state, make_physics
from sports.physics.variation import Variation, draw, split_damping

FINEST = 32
"""The reference is at 1/3840 s, finer than any joint forgets its motion."""
OURS = {"contact_time": 1 / 60, "contact_damping": 0.7, "contact_impedance": 0.6}


def neutral(felt_share: float, coarse_share: float = 0.0) -> Variation:
    """Worlds with the numbers of the model that yields, all of them, felt or not."""
    one = (1.0, 1.0)
    ground = {f"{prefix}{name}": (x, x) for name, x in OURS.items() for prefix in ("", "felt_")}
    plain = Variation(one, one, one, felt_share=felt_share, coarse_share=coarse_share)
    return dataclasses.replace(plain, **ground)


def runners(worlds: int, height: float) -> tuple[PhysicsState, Tensor]:
    """States of athletes who come down at 3 to 8 m/s forward, legs anyhow, and targets
    (4, worlds, nu) that throw the limbs about."""
    scene = make_scene("long_jump")
    generator = torch.Generator().manual_seed(7)
    state = default_state(scene, worlds, "cpu")
    state.qpos[:, 2] += height
    state.qvel[:, 0] = 3.0 + 5.0 * torch.rand(worlds, generator=generator)
    state.qvel[:, 2] = -2.0
    noise = 0.3 * torch.randn(5, worlds, scene.nu, generator=generator)
    state.qpos[:, scene.agent_qpos(0)][:, 7:] = noise[0]
    return state, noise[1:]


def played(physics: Physics, state: PhysicsState, targets: Tensor) -> tuple[Tensor, Tensor]:
    """(worlds, nq) after the targets, (worlds, 3) velocity of the centre of mass."""
    physics.reset(torch.ones(len(state.qpos), dtype=torch.bool), state.clone())
    for ctrl in targets:
        physics.step(ctrl)
    velocity = physics.geometry.center_of_mass(physics, 0)[1].clone()
    qpos = physics.qpos.clone()
    physics.close()
    return qpos, velocity


def of_mujoco(worlds: int, divisor: int = 1, **options: object) -> Physics:
    scene = make_scene("long_jump", timestep_divisor=divisor)
    return make_physics("mujoco", scene, worlds, threads=1, **options)


def test_it_is_the_explicit_step_with_the_damping_in_the_inertia(monkeypatch):
    """The same from MuJoCo itself: Euler's explicit step of a model whose armature has h D."""
    n = 6
    state, targets = runners(n, 0.0)
    felt = played(of_mujoco(n, felt_damping=True), state, targets)[0]

    def heavier(scene):
        model = build_model(scene)
        firm_ground(model)
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        model.dof_armature[:] += model.opt.timestep * model.dof_damping
        return model

    monkeypatch.setattr(engine, "build_model", heavier)
    explicit = played(of_mujoco(n), state, targets)[0]
    assert (felt - explicit).abs().max() < 1e-6


def test_in_the_air_nothing_is_felt():
    n = 4
    state, targets = runners(n, 3.0)
    state.qpos[:, 7:] *= 0.2  # no limb meets another
    targets *= 0.5
    plain = played(of_mujoco(n), state, targets)[0]
    felt = played(of_mujoco(n, felt_damping=True), state, targets)[0]
    assert (plain[:, 7:] - state.qpos[:, 7:]).abs().max() > 0.1
    assert (plain - felt).abs().max() < 1e-6


def test_what_the_ground_gives_depends_less_on_the_time_step(capsys):
    """Landings at strength paper, four control steps at 1/120 s against 1/3840 s. With the damping
    the solver errs by a third of what it does without, and less than at a quarter of the step."""
    n = 24
    state, targets = runners(n, 0.02)
    reference = played(of_mujoco(n, FINEST), state, targets)[1]

    def error(divisor: int, felt: bool) -> float:
        physics = of_mujoco(n, divisor, variation=neutral(float(felt)))
        velocity = played(physics, state, targets)[1]
        return float((velocity - reference).square().sum(-1).mean().sqrt())

    plain, quarter, felt = error(1, False), error(4, False), error(1, True)
    with capsys.disabled():
        print(
            f"\nlandings against 1/3840 s, velocity of the centre of mass: {plain:.3f} m/s at "
            f"1/120 s, {quarter:.3f} at 1/480 s, {felt:.3f} at 1/120 s with felt damping"
        )
    assert felt < plain / 3
    assert felt < quarter
    # Both go to the same limit: it is the same physics.
    assert error(FINEST, True) < 0.1 * plain


def test_split_is_the_implicit_step():
    """(M + h D) dv = h (f - D v) of one joint, whatever the split does with D."""
    damping = np.array([[0.0, 80.0, 3.0], [0.0, 80.0, 3.0]])
    joints, felt = np.array([False, True, False]), np.array([True, False])
    h = np.array([1 / 120, 1 / 240])
    inertia, rate, push = 0.03, 2.0, 10.0
    split = split_damping(damping, joints, felt, h)
    step = h[:, None]
    change = step * (push - (split.force + split.own) * rate)
    change = change / (inertia + split.armature + step * split.own)
    expected = step * (push - damping * rate) / (inertia + step * damping)
    np.testing.assert_allclose(change, expected, rtol=1e-12)
    assert split.armature[0].tolist() == [0.0, 80.0 / 120, 0.0] and not split.armature[1].any()
    assert split.own[0].tolist() == [0.0, 0.0, 3.0] and split.own[1].tolist() == [0.0, 80.0, 3.0]


@pytest.mark.parametrize("divisor", [1, 2])
def test_worlds_that_vary_feel_it_or_do_not(divisor):
    """Neutral worlds of both kinds, and of both time steps, are the plain and the felt world."""
    n, mixed = 24, neutral(0.5, coarse_share=0.5)
    scene = make_scene("long_jump", timestep_divisor=divisor)
    drawn = draw(mixed, n, scene.substeps, 1)
    kinds = {(int(s), bool(f)) for s, f in zip(drawn.stride, drawn.felt)}
    assert len(kinds) == 2 * divisor
    state, targets = runners(n, 0.02)
    varied = played(of_mujoco(n, divisor, variation=mixed, variation_seed=1), state, targets)[1]
    for stride, felt in kinds:
        own = torch.tensor((drawn.stride == stride) & (drawn.felt == felt))
        alone = of_mujoco(n, divisor // stride, variation=neutral(float(felt)))
        off = (varied - played(alone, state, targets)[1])[own].abs().max()
        # The momentum of a coarse world is corrected at another instant.
        assert off < (1e-5 if stride == 1 else 0.05), (stride, felt)


def test_both_mujocos_feel_the_same():
    pytest.importorskip("mujoco_warp")
    n, scene = 6, make_scene("long_jump")
    state, targets = runners(n, 0.02)
    felt, plain = (
        played(of_mujoco(n, felt_damping=f), state, targets[:1])[0] for f in (True, False)
    )
    warp = make_physics("warp", scene, n, device="cpu", felt_damping=True)
    off = (played(warp, state, targets[:1])[0] - felt).abs().amax(-1)
    assert off.median() < 1e-4 < (plain - felt).abs().amax(-1).median()


def test_a_share_is_between_none_and_all():
    with pytest.raises(ValueError, match="felt_contact_time must be 0 < low <= high"):
        Variation(felt_contact_time=(0.02, 0.01))
    with pytest.raises(ValueError, match=r"felt_share must be in \[0, 1\], not 1.5"):
        Variation(felt_share=1.5)
