"""On a GPU only: a step of the tracker waits for nothing, and its tables are those of the host."""

from __future__ import annotations

import pytest
import torch

from rl.motion import MotionTables
from rl.tracker import TrackingConfig, make_tracking_env
from tests.warmstart.clips_made import random_clip
from warmstart.library import pack

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


def test_a_step_never_waits_for_the_device():
    motions = pack((f"clip_{i}", random_clip(i, 40)) for i in range(4))
    config = TrackingConfig(split="all")
    env = make_tracking_env(motions, engine="warp", num_worlds=64, config=config)
    action = torch.zeros(64, 1, 69, device=env.device)
    env.reset()
    for _ in range(3):  # captures, allocations, first calls
        env.step(action)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for share in (0.1, 0.5):
            env.schedule(share)
            result = env.step(action)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert bool(result.reward.isfinite().all())
    env.close()


def test_frames_are_the_same_on_host_and_device():
    motions = pack([("a", random_clip(0, 50))])
    host, device = MotionTables(motions, "cpu"), MotionTables(motions, "cuda")
    frame = torch.tensor([0, 30, 49, 80])
    for one, two in zip(host.at(frame), device.at(frame.cuda())):
        torch.testing.assert_close(one, two.cpu(), atol=1e-6, rtol=0)
