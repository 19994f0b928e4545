"""On a GPU only: the ball law in the captured graph, and the questions of tasks."""

import pytest
import torch

from sports import ball
from sports.physics import PhysicsState, default_state, make_physics
from tests.sports.courts import COURT, NET, RACKET, court, engine, everyone, in_front_of_the_racket

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


def test_a_gpu_plays_the_ball_of_a_cpu():
    """A rally in the captured graph, and the questions of tasks, which wait for nothing."""
    n = 8
    scene = court(surfaces=(COURT, NET, RACKET))
    state = default_state(scene, n, "cpu")
    kinds = [engine("mujoco", scene, n), make_physics("warp", scene, n)]
    noise = 0.08 * torch.randn(2, n, 3, generator=torch.Generator().manual_seed(5))
    q, v = scene.object_qpos("ball"), scene.object_qvel("ball")
    state.qpos[:, q][:, :3] = in_front_of_the_racket(kinds[0], state, 0.8) + noise[0]
    state.qvel[:, v][:, :3] = torch.tensor((-20.0, 0.0, 1.0)) + 10.0 * noise[1]
    total = torch.zeros(3)
    for physics in kinds:
        own = PhysicsState(
            *(x.to(physics.device) for x in (state.qpos, state.qvel, state.mocap_pos))
        )
        physics.reset(everyone(n).to(physics.device), own)
    for _ in range(45):
        for physics in kinds:
            physics.step(torch.zeros(n, scene.nu, device=physics.device))
        cpu, gpu = kinds
        assert torch.equal(cpu.ball_hits, gpu.ball_hits.cpu())
        assert (cpu.object_pos - gpu.object_pos.cpu()).abs().max() < 5e-3
        total += cpu.ball_hits.sum(0)
    assert total[0] > 0 and total[2] >= 3
    pos = torch.tensor([[-12.5, 0.5, 1.2]], device="cuda").expand(n, 3).contiguous()
    target = torch.tensor([[8.0, -1.0, 0.032]], device="cuda").expand(n, 3).contiguous()
    speed = torch.linspace(18.0, 25.0, n, device="cuda")
    ball.launch("tennis", pos, speed, target, net=(0.0, 1.282))  # makes its constants
    torch.cuda.set_sync_debug_mode("error")
    linvel = ball.launch("tennis", pos, speed, target, net=(0.0, 1.282))
    landed, _ = ball.landing("tennis", pos, linvel, torch.zeros_like(linvel), height=0.032)
    torch.cuda.set_sync_debug_mode("default")
    assert (landed - target).norm(dim=-1).max() < 2e-3
    slow = ball.launch("tennis", pos.cpu(), speed.cpu(), target.cpu(), net=(0.0, 1.282))
    assert (slow - linvel.cpu()).abs().max() < 1e-3
