"""What the ground gives a running athlete is the same in MuJoCo and in Drake.

On MuJoCo's default ground this fails: its contacts lift loaded feet, unless they feel the damping
of the joints, as Drake's do (docs/physics.md).
"""

from __future__ import annotations

import torch
from torch import Tensor

from rl.policy import load_policy
from sports.env import make_env, make_scene
from sports.humanoid.body import Strength
from sports.physics import PhysicsState, make_physics
from sports.physics.variation import Variation

WORLDS, STEPS, MOMENTS = 24, 4, (40, 55)


def sprint(strength: Strength) -> tuple[PhysicsState, Tensor]:
    """States of a shipped long jumper in its run-up and the targets (M, STEPS, nu) it chose."""
    policy = load_policy(f"pretrained:ppo-{strength}", "long_jump")
    env = make_env("long_jump", num_worlds=WORLDS, strength=strength, seed=5)
    obs, physics = env.reset(), env.physics
    env.age[:] = 0
    qpos, qvel, targets = [], [], []
    running = torch.ones(WORLDS, dtype=torch.bool)
    for _ in range(MOMENTS[-1] + STEPS):
        qpos.append(physics.qpos.clone())
        qvel.append(physics.qvel.clone())
        action = policy(obs).clamp(-1.0, 1.0)
        targets.append((action * env.action_scale).flatten(1))
        result = env.step(action)
        running &= ~result.ended
        obs = result.obs
    mocap = physics.mocap_pos[running].repeat(len(MOMENTS), 1, 1)
    env.close()
    assert int(running.sum()) > WORLDS // 2
    state = PhysicsState(
        torch.cat([qpos[t][running] for t in MOMENTS]),
        torch.cat([qvel[t][running] for t in MOMENTS]),
        mocap,
    )
    assert float(state.qvel[:, 0].mean()) > 5.0, "these are states of a sprint"
    chosen = [torch.stack(targets[t : t + STEPS], 1)[running] for t in MOMENTS]
    return state, torch.cat(chosen)


def com_velocity(
    engine: str, strength: Strength, state: PhysicsState, targets: Tensor, **options: object
) -> Tensor:
    """(M, 3) velocity of the centre of mass after the targets."""
    return motion(engine, strength, state, targets, **options)[0]


def motion(
    engine: str,
    strength: Strength,
    state: PhysicsState,
    targets: Tensor,
    divisor: int = 1,
    **options: object,
) -> tuple[Tensor, Tensor]:
    """(M, 3) velocity of the centre of mass and (M, 3) spin of the pelvis after the targets."""
    scene = make_scene("long_jump", strength=strength, timestep_divisor=divisor)
    physics = make_physics(engine, scene, len(targets), **options)
    physics.reset(torch.ones(len(targets), dtype=torch.bool), state.clone())
    for k in range(STEPS):
        physics.step(targets[:, k])
    velocity = physics.geometry.center_of_mass(physics, 0)[1].clone()
    spin = physics.body_angvel[:, 0, 0].clone()
    physics.close()
    return velocity, spin


def show(name: str, difference: Tensor) -> None:
    mean, rms = difference.mean(0), difference.square().mean(0).sqrt()
    print(name, "mean", mean.tolist(), "rms", rms.tolist())


def test_a_sprint_takes_the_same_impulse_from_the_ground():
    state, targets = sprint("human")
    velocity = (com_velocity(e, "human", state, targets) for e in ("mujoco", "drake"))
    difference = next(velocity) - next(velocity)
    show("human", difference)
    assert float(difference.mean(0).abs().max()) < 0.12  # 0.27 forward, 0.30 up by default
    assert float(difference.norm(dim=-1).median()) < 0.25


def test_so_does_one_at_strength_paper_where_contacts_feel_the_damping():
    """At 1/120 s, on MuJoCo's own contacts: no number of it is fitted to Drake."""
    state, targets = sprint("paper")
    drake = com_velocity("drake", "paper", state, targets)
    plain, felt = (
        com_velocity("mujoco", "paper", state, targets, felt_damping=felt) - drake
        for felt in (False, True)
    )
    show("plain", plain)
    show("felt", felt)
    assert float(felt.mean(0).abs().max()) < 0.12
    assert float(felt.norm(dim=-1).median()) < 0.25
    assert float(felt.square().mean()) < 0.25 * float(plain.square().mean())


def test_firm_ground_that_is_felt_at_a_finer_step_is_a_stand_in_for_drake():
    """The worlds of docs/physics.md in which a runner learns to run in Drake, with a pyramid of
    friction and with a round cone."""
    state, targets = sprint("paper")
    drake = motion("drake", "paper", state, targets)

    def off(**options: object) -> list[float]:
        found = motion("mujoco", "paper", state, targets, **options)
        return [float((a - b).norm(dim=-1).median()) for a, b in zip(found, drake)]

    one = (1.0, 1.0)
    ground = {"felt_contact_time": (0.01, 0.01), "felt_contact_damping": one}
    ground |= {"felt_contact_impedance": (0.9, 0.9)}
    plain = off()
    for cone in (0.0, 1.0):
        like = Variation(one, one, one, coarse_share=0.0, felt_share=1.0, cone_share=cone, **ground)
        near = off(divisor=4, variation=like)
        print("cone", cone, "as it is", plain, "stand-in", near)
        assert near[0] < 0.15 and near[0] < 0.3 * plain[0] and near[1] < 0.3 * plain[1]
