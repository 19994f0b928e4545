"""An athlete with fingers, seen as one without: against the engine's own account of that body."""

from __future__ import annotations

import pytest
import torch

from rl.latent_action import LatentActions, LatentConfig
from rl.prior import PriorError, load_prior
from rl.prior_body import SeenAs, counterparts
from sports.env import make_env
from sports.frames import Heading, proprioception
from sports.humanoid.body import is_finger, load_body
from sports.physics import default_state, make_physics
from sports.scene import humanoid_scene
from tests.rl.latent_made import made_prior

SMPL, SMPLX = load_body("smpl"), load_body("smplx")


def felt(body, root, angles, speeds):
    """Proprioception (N, 1, D) of a body in postures: ``root`` (N, 13) position, quaternion and
    velocities, angles and speeds (N,) by name of a dof; 0 for the others."""
    scene = humanoid_scene(body)
    physics = make_physics("mujoco", scene, len(root))
    state = default_state(scene, len(root), "cpu")
    state.qpos[:, :7], state.qvel[:, :6] = root[:, :7], root[:, 7:]
    for i, dof in enumerate(body.dofs):
        if dof.name in angles:
            state.qpos[:, 7 + i], state.qvel[:, 6 + i] = angles[dof.name], speeds[dof.name]
    physics.reset(torch.ones(len(root), dtype=torch.bool), state)
    obs = proprioception(physics, Heading(physics.body_rot[:, :, 0]))
    physics.close()
    return obs


def test_fingers_or_not_the_same_posture_is_seen_alike():
    """MuJoCo's own links of the body that the prior knows, posed and moving as the athlete."""
    g = torch.Generator().manual_seed(3)
    n, shared = 6, [d.name for d in SMPL.dofs if not d.link.endswith("Hand")]
    root = torch.randn(n, 13, generator=g)
    root[:, 2] = 0.9 + 0.1 * root[:, 2].abs()
    root[:, 3:7] /= root[:, 3:7].norm(dim=1, keepdim=True)
    angles = {name: 0.5 * torch.randn(n, generator=g) for name in shared}
    speeds = {name: 2.0 * torch.randn(n, generator=g) for name in shared}
    curled = [d.name for d in SMPLX.dofs if is_finger(d.link)]
    bent = {name: 0.3 * torch.randn(n, generator=g) for name in curled}
    athlete = felt(SMPLX, root, angles | bent, speeds | bent)
    legs = SMPL.standing_height() - SMPLX.standing_height()
    assert -0.05 < legs < 0.0  # who has fingers has longer legs here
    raised = root.clone()
    raised[:, 2] += legs
    same = felt(SMPL, raised, angles, speeds)
    seen = SeenAs(SMPL, SMPLX, "cpu").state(athlete)
    torch.testing.assert_close(seen, same, atol=2e-5, rtol=1e-5)
    own = SeenAs(SMPL, SMPL, "cpu")
    torch.testing.assert_close(own.state(same), same, atol=2e-5, rtol=1e-5)


def test_targets_are_the_same_angles():
    seen = SeenAs(SMPL, SMPLX, "cpu")
    decoded = torch.randn(4, 1, 69, generator=torch.Generator().manual_seed(0))
    radians = decoded * torch.tensor(SMPL.action_scale()).float()
    told = seen.targets(decoded) * torch.tensor(SMPLX.action_scale()).float()
    for i, dof in enumerate(SMPLX.dofs):
        if is_finger(dof.link):
            assert not told[..., i].any()
        else:
            torch.testing.assert_close(told[..., i], radians[..., SMPL.dof_index(dof.name)])


def test_a_prior_without_fingers_moves_an_athlete_with_them_and_keeps_its_grasp():
    """The layer in the javelin, whose grasp is no zero pose, against the prior asked by hand."""
    prior, env = made_prior("smpl"), make_env("javelin", num_worlds=2)
    body, scene = env.physics.scene.body, env.physics.scene
    layer = LatentActions(prior, LatentConfig(span=2.0), scene, env.task.tools, env.device)
    layer.check(env.obs_slices)
    obs = env.reset()
    a = torch.randn(2, 1, 6, generator=torch.Generator().manual_seed(0))
    state = SeenAs(SMPL, body, "cpu").state(obs)
    mean, sigma = prior.moments(state)
    z = mean + 2.0 * sigma * torch.tanh(a)
    torch.testing.assert_close(layer.latent(obs, a), z)
    wanted = SeenAs(SMPL, body, "cpu").targets(prior.decode(state, z)) * env.action_scale
    env.act_through(layer)
    env.step(a)
    finger = torch.tensor([is_finger(d.link) for d in body.dofs])
    held = env.action_offset.expand(2, 1, -1)
    assert torch.equal(env.view.ctrl[..., finger], held[..., finger])
    reach = torch.stack(
        (env.action_offset - env.action_scale, env.action_offset + env.action_scale)
    )
    torch.testing.assert_close(
        env.view.ctrl[..., ~finger], wanted.clamp(*reach)[..., ~finger], atol=2e-6, rtol=0
    )
    env.close()


def test_the_shipped_prior_keeps_an_athlete_with_fingers_on_its_feet():
    """Whom its targets for a T-pose would not: two seconds of the prior's own mean."""
    env = make_env("basketball_1v1", num_worlds=4, strength="human", training=False)
    scene = env.physics.scene
    layer = LatentActions(load_prior("pretrained"), LatentConfig(), scene, env.task.tools, "cpu")
    env.act_through(layer)
    env.reset()
    fallen = torch.zeros(4, 2, dtype=torch.bool)
    for _ in range(60):
        env.step(torch.zeros(4, 2, layer.size))
        fallen |= env.view.fallen()
    assert not fallen.any()
    assert float(env.view.root_pos[..., 2].min()) > 0.85
    env.close()


def test_who_has_other_joints_is_refused():
    with pytest.raises(ValueError, match="body 'smpl' has no link 'L_Index1'"):
        counterparts(SMPLX, SMPL)
    assert counterparts(SMPL, SMPL) == list(range(24))
    env = make_env("javelin", num_worlds=1)
    prior = made_prior("smpl")
    prior.card["body_digest"] = "0" * 64  # of another build of it
    with pytest.raises(PriorError, match="or of the same without fingers"):
        LatentActions(prior, LatentConfig(), env.physics.scene, (), "cpu")
    env.close()
