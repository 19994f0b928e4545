"""The drake engine against MuJoCo, closed forms, permutations and round trips."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("pydrake")

from sports import high_jump
from sports.humanoid.body import Shape, load_body
from sports.physics import default_state, make_physics
from sports.physics.base import PhysicsState
from sports.scene import Scene, SceneObject, Start, humanoid_scene

BAR = SceneObject(
    "bar",
    (Shape("cylinder", (0, -2.05, 0), (0.025,), 2.0, end=(0, 2.05, 0)),),
    "free",
    (20.0, 6.0, 0.975),
)
UPRIGHTS = tuple(
    SceneObject(
        f"upright{i}",
        (Shape("box", (0, 0, -0.5), (0.04, 0.03, 0.5), 10.0),),
        "mocap",
        (20.0, y, 0.95),
        meets_ground=False,
    )
    for i, y in enumerate((4.0, 8.0))
)
BALL = SceneObject("ball", (Shape("sphere", (0, 0, 0), (0.11,), 0.43),), "free", (3.0, 1.0, 30.0))


def bar_scene() -> Scene:
    return Scene(
        "bar",
        load_body(),
        objects=(BAR, *UPRIGHTS),
        contact_pairs=(("agent0", "bar"), ("bar", "upright0"), ("upright1", "bar")),
    )


def raised(scene: Scene, heights: list[float]) -> PhysicsState:
    """One world per bar height (top of the bar, m)."""
    state = default_state(scene, len(heights), "cpu")
    lift = torch.tensor(heights) - 1.0
    state.mocap_pos[..., 2] += lift[:, None]
    state.qpos[:, scene.object_qpos("bar").start + 2] += lift
    return state


def random_state(scene: Scene, worlds: int, seed: int, spread: float = 0.6) -> PhysicsState:
    generator = torch.Generator().manual_seed(seed)
    state = default_state(scene, worlds, "cpu")

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    for a in range(scene.num_agents):
        qpos = state.qpos[:, scene.agent_qpos(a)]
        qpos[:, :3] += noise(worlds, 3) + torch.tensor([0.0, 0.0, 3.0])
        qpos[:, 3:7] = torch.nn.functional.normalize(noise(worlds, 4), dim=-1)
        qpos[:, 7:] = spread * noise(worlds, scene.body.num_dofs)
    for obj in scene.free_objects:
        quat = slice(scene.object_qpos(obj.name).start + 3, scene.object_qpos(obj.name).stop)
        state.qpos[:, quat] = torch.nn.functional.normalize(noise(worlds, 4), dim=-1)
    state.qvel.copy_(noise(worlds, scene.nv))
    state.mocap_pos += noise(*state.mocap_pos.shape)
    return state


EVERY = torch.ones(1, dtype=torch.bool)
KINEMATICS = ["qpos", "qvel", "mocap_pos", "body_pos", "body_quat", "body_linvel", "body_angvel"]
KINEMATICS += ["object_pos", "object_quat", "object_linvel", "object_angvel"]


def test_every_kinematic_tensor_is_mujocos():
    """Two athletes, a ball, a bar, two movable uprights, random states: all tensors agree."""
    scene = Scene(
        "two", load_body(), agents=(Start(), Start(x=4.0, yaw=2.0)), objects=(BALL, BAR, *UPRIGHTS)
    )
    state = random_state(scene, 3, seed=1)
    everywhere = torch.ones(3, dtype=torch.bool)
    engines = [make_physics("mujoco", scene, 3, threads=1), make_physics("drake", scene, 3)]
    for engine in engines:
        engine.reset(everywhere, state)
    torch.testing.assert_close(engines[1].qpos, state.qpos, atol=1e-6, rtol=0)
    torch.testing.assert_close(engines[1].qvel, state.qvel, atol=1e-6, rtol=0)
    for name in KINEMATICS:
        a, b = (getattr(engine, name) for engine in engines)
        if name.endswith("quat"):  # q and -q are the same rotation
            b = b * torch.sign((a * b).sum(-1, keepdim=True))
        torch.testing.assert_close(b, a, atol=2e-5, rtol=1e-5, msg=lambda m, n=name: f"{n}: {m}")
    down = torch.tensor([0.0, 0.0, -1.0])
    torch.testing.assert_close(engines[1].extent(down), engines[0].extent(down), atol=1e-5, rtol=0)


def test_reset_touches_masked_worlds_only():
    scene = humanoid_scene(load_body())
    drake = make_physics("drake", scene, 2)
    before = drake.qpos.clone()
    state = random_state(scene, 2, seed=5)
    drake.reset(torch.tensor([False, True]), state)
    assert torch.equal(drake.qpos[0], before[0])
    torch.testing.assert_close(drake.qpos[1], state.qpos[1], atol=1e-6, rtol=0)
    assert drake.ground_force.abs().sum() == 0


def test_free_fall_is_the_closed_form():
    """Semi-implicit Euler: z = z0 + v t - g t (t + h) / 2, for an athlete and a ball."""
    scene = Scene("fall", load_body(), objects=(BALL,))
    drake = make_physics("drake", scene, 1)
    state = default_state(scene, 1, "cpu")
    state.qpos[:, 2], state.qvel[:, 2], state.qvel[:, 0] = 20.0, 2.0, 3.0
    drake.reset(EVERY, state)
    for _ in range(30):
        drake.step(torch.zeros(1, scene.nu))
    t, h = 1.0, drake.timestep
    drop = 9.81 * t * (t + h) / 2
    expected = torch.tensor([3.0, 0.0, 20.0 + 2.0 - drop])
    torch.testing.assert_close(drake.qpos[0, :3], expected, atol=1e-4, rtol=0)
    assert abs(drake.object_pos[0, 0, 2].item() - (30.0 - drop)) < 1e-4
    assert drake.qpos[0, scene.agent_qpos(0)][7:].abs().max() < 1e-5


def test_standing_follows_mujoco(capsys):
    """2 s of the zero pose under PD: joints, root height and the weight on the ground."""
    scene = humanoid_scene(load_body())
    engines = [make_physics("mujoco", scene, 1, threads=1), make_physics("drake", scene, 1)]
    for engine in engines:
        engine.reset(EVERY, default_state(scene, 1, "cpu"))
    for _ in range(60):
        for engine in engines:
            engine.step(torch.zeros(1, scene.nu))
    gap = engines[1].qpos - engines[0].qpos
    rms = gap[0, 7:].square().mean().sqrt().item()
    force = engines[1].ground_force.sum(dim=(0, 1, 2))
    weight = scene.body.mass * 9.81
    with capsys.disabled():
        print(
            f"\nstanding 2 s, drake at {engines[1].timestep * 1e3:.2f} ms against mujoco: joints "
            f"{rms:.1e} rad rms, root {gap[0, :3].abs().max().item() * 1e3:.1f} mm, "
            f"ground force {force[2].item() / weight:.4f} body weights"
        )
    assert rms < 3e-3
    assert abs(gap[0, 2].item()) < 2e-3
    assert gap[0, :2].abs().max().item() < 0.02
    assert abs(force[2].item() / weight - 1) < 0.03
    feet = [scene.body.link_index(n) for n in ("L_Ankle", "R_Ankle", "L_Toe", "R_Toe")]
    others = [i for i in range(scene.body.num_links) if i not in feet]
    assert engines[1].ground_force[0, 0, others].abs().max() == 0


@pytest.mark.parametrize("bar", ["flat uprights", "high jump"])
def test_resting_bar_stays_on_its_uprights(bar, capsys):
    """2 s at two heights in one batch; the high jump's own bar lies in a shallow groove."""
    if bar == "high jump":
        scene = high_jump.scene(high_jump.HighJump(bar_height=1.0), load_body())
    else:
        scene = bar_scene()
    drake = make_physics("drake", scene, 2)
    start = raised(scene, [0.8, 1.5])
    drake.reset(torch.ones(2, dtype=torch.bool), start)
    for _ in range(60):
        drake.step(torch.zeros(2, scene.nu))
    gap = drake.object_pos[:, 0] - start.qpos[:, scene.object_qpos("bar")][:, :3]
    with capsys.disabled():
        print(f"\nbar on {bar}: moved {gap.abs().max().item() * 1e3:.2f} mm in 2 s in drake")
    assert gap.abs().max().item() < 1e-3
    assert drake.object_linvel.abs().max().item() < 1e-3
    assert drake.pair_force[:, 0].abs().max() == 0  # the athlete does not touch it
    # Two supports carry half of 2 kg each.
    np.testing.assert_allclose(drake.pair_force[:, 1:].numpy(), 9.81, rtol=0.03)


def test_a_touched_bar_reports_the_force_and_falls():
    """An athlete's hand dropped on the bar: the pair force is seen and the bar leaves."""
    scene = high_jump.scene(high_jump.HighJump(bar_height=1.0), load_body())
    drake = make_physics("drake", scene, 1)
    state = default_state(scene, 1, "cpu")
    state.qpos[:, :3] = torch.tensor([19.8, 6.0, 1.3])
    state.qvel[:, 0] = 3.0
    drake.reset(EVERY, state)
    largest = 0.0
    for _ in range(30):
        drake.step(torch.zeros(1, scene.nu))
        largest = np.maximum(largest, drake.pair_force[0, 0].item())
    assert largest > 50.0
    assert drake.object_pos[0, 0, 2].item() < 0.9


def test_pushed_bar_leaves_its_groove_as_in_mujoco():
    """At 0.3 m/s sideways it rolls back, at 0.7 m/s it falls, on the same path in both engines.

    How high it bounces on the ground is another matter: there they may differ.
    """
    scene = high_jump.scene(high_jump.HighJump(bar_height=1.0), load_body())
    state = default_state(scene, 2, "cpu")
    state.qvel[:, scene.object_qvel("bar").start] = torch.tensor([0.3, 0.7])
    paths = []
    for engine in ("mujoco", "drake"):
        physics = make_physics(engine, scene, 2)
        physics.reset(torch.ones(2, dtype=torch.bool), state)
        path = []
        for _ in range(26):
            physics.step(torch.zeros(2, scene.nu))
            path.append(physics.object_pos[:, 0].clone())
        paths.append(torch.stack(path))
    mujoco, drake = paths
    falling = int((mujoco[:, 1, 2] > 0.1).sum())
    assert falling >= 10
    torch.testing.assert_close(drake[:falling], mujoco[:falling], atol=0.02, rtol=0)
    assert drake[-1, 0, 2].item() > 0.97 and drake[-1, 1, 2].item() < 0.06
    torch.testing.assert_close(drake[-1], mujoco[-1], atol=0.02, rtol=0)


def test_permuting_the_worlds_permutes_everything():
    scene = bar_scene()
    order = torch.tensor([2, 0, 1])
    state = random_state(scene, 3, seed=3, spread=0.2)
    state.qpos[:, :7] = torch.as_tensor(scene.default_qpos()[:7], dtype=torch.float32)
    generator = torch.Generator().manual_seed(0)
    plans = [0.3 * torch.randn(3, scene.nu, generator=generator) for _ in range(6)]
    everywhere = torch.ones(3, dtype=torch.bool)
    a, b = make_physics("drake", scene, 3), make_physics("drake", scene, 3)
    a.reset(everywhere, state)
    b.reset(
        everywhere,
        PhysicsState(state.qpos[order], state.qvel[order], state.mocap_pos[order]),
    )
    for plan in plans:
        a.step(plan)
        b.step(plan[order])
    for name in [*KINEMATICS, "ground_force", "pair_force", "bad"]:
        assert torch.equal(getattr(a, name)[order], getattr(b, name)), name
    assert a.ground_force.abs().sum() > 0


def test_a_bad_world_is_counted_and_does_not_spread():
    scene = humanoid_scene(load_body())
    both, alone = make_physics("drake", scene, 2), make_physics("drake", scene, 1)
    ctrl = torch.zeros(2, scene.nu)
    ctrl[1, 3] = float("nan")
    both.step(ctrl)
    alone.step(ctrl[:1])
    assert both.bad.tolist() == [False, True]
    assert both.nan_worlds == 1
    assert torch.equal(both.qpos[0], alone.qpos[0])
    assert torch.isfinite(both.qpos).all() and torch.isfinite(both.body_pos).all()
    both.step(torch.zeros(2, scene.nu))
    assert not both.bad.any()


def test_flailing_on_the_ground_stays_finite_and_above_it():
    """Slamming limbs of 500 N m sink into Drake's ground less than into MuJoCo's softer one."""
    scene = humanoid_scene(load_body())
    depth = {}
    for engine in ("mujoco", "drake"):
        physics = make_physics(engine, scene, 1)
        physics.reset(EVERY, default_state(scene, 1, "cpu"))
        generator = torch.Generator().manual_seed(2)
        down, deepest = torch.tensor([0.0, 0.0, -1.0]), -np.inf
        for _ in range(45):
            physics.step(0.8 * torch.randn(1, scene.nu, generator=generator))
            assert not physics.bad.any()
            deepest = max(deepest, physics.extent(down).max().item())
        depth[engine] = deepest
    assert 0.0 < depth["drake"] < min(depth["mujoco"], 0.05)


def test_effort_limit_holds():
    """A saturated elbow does not feel a tenfold target, and speeds up as it does in MuJoCo."""
    scene = humanoid_scene(load_body(strength="human"))
    state = default_state(scene, 2, "cpu")
    state.qpos[:, 2] = 5.0
    elbow = scene.body.dof_index("L_Elbow_z")
    ctrl = torch.zeros(2, scene.nu)
    ctrl[0, elbow], ctrl[1, elbow] = 20.0, 200.0
    speed = {}
    for engine in ("mujoco", "drake"):
        physics = make_physics(engine, scene, 2)
        physics.reset(torch.ones(2, dtype=torch.bool), state)
        physics.step(ctrl)
        speed[engine] = physics.qvel[:, 6 + elbow]
        torch.testing.assert_close(physics.qvel[0], physics.qvel[1], atol=1e-5, rtol=0)
    assert speed["drake"][0].item() > 0.5
    assert abs(speed["drake"][0].item() / speed["mujoco"][0].item() - 1) < 0.05


@pytest.mark.parametrize(("timestep", "ok"), [(1 / 240, True), (1 / 700.5, False), (0.0, False)])
def test_time_step_must_divide(timestep, ok):
    scene = humanoid_scene(load_body())
    if ok:
        assert make_physics("drake", scene, 1, timestep=timestep).substeps == 8
        return
    with pytest.raises(ValueError, match="must divide"):
        make_physics("drake", scene, 1, timestep=timestep)
