"""On a GPU only: AMP's captured step is the plain one, and nothing waits for the device."""

from __future__ import annotations

import itertools
import time
from types import SimpleNamespace

import pytest
import torch

from rl.amp import AMP, AMPConfig
from rl.ppo import PPO, PPOConfig
from rl.style_features import Demonstrations, StyleFeatures
from sports.humanoid.body import load_body

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


class Random:
    """Athletes in random states, worked out on the GPU."""

    def __init__(self, rows: int) -> None:
        self.features = StyleFeatures(load_body("smpl"), "cuda")
        self.state_size, self.rows = 13 + 2 * 69, rows
        self.generator = torch.Generator("cuda").manual_seed(0)
        self.kept: torch.Tensor | None = None

    def state(self) -> torch.Tensor:
        if self.kept is not None:
            return self.kept
        shape = (self.rows, self.state_size)
        return torch.randn(shape, device="cuda", generator=self.generator)

    def result(self) -> SimpleNamespace:
        draw = torch.rand(self.rows, device="cuda", generator=self.generator)
        return SimpleNamespace(reward=draw[:, None], ended=draw < 0.02, valid=draw < 0.999)


def make(rows: int, config: AMPConfig, graph: bool, seed: int = 0) -> AMP:
    source = Random(rows)
    states = torch.randn(500, source.state_size, generator=torch.Generator().manual_seed(9))
    begins = torch.arange(500 - config.frames)
    kinds = begins < 100
    shown = Demonstrations(states, begins, kinds)
    return AMP(source, shown, rows, 24, config, "cuda", seed, graph, bf16=True)


def play(amp: AMP, rollout) -> dict[str, torch.Tensor]:
    for _ in range(24):
        amp.watch(amp.source.result())  # type: ignore[attr-defined]
    amp.pay(rollout, 10.0)
    return amp.update()


CONFIG = AMPConfig(hidden=(64, 32), batch=256, replay=2000, replay_share=0.1)


def test_captured_step_is_the_plain_step():
    amps = [make(128, CONFIG, graph) for graph in (True, False)]
    ppo = PPO(20, 7, PPOConfig(hidden=(8,)), "cuda")
    for _ in range(4):
        told = [play(amp, ppo.new_rollout(128)) for amp in amps]
        for name, x in told[0].items():
            torch.testing.assert_close(x, told[1][name], rtol=2e-2, atol=2e-3)
    assert amps[0]._train.graph is not None and amps[1]._train.graph is None
    for a, b in zip(amps[0].net.parameters(), amps[1].net.parameters()):
        torch.testing.assert_close(a, b, rtol=1e-2, atol=1e-3)


def test_nothing_waits_for_the_device():
    amp, ppo = make(128, CONFIG, True), PPO(20, 7, PPOConfig(hidden=(8,)), "cuda")
    rollout = ppo.new_rollout(128)
    for _ in range(2):
        play(amp, rollout)
    torch.cuda.set_sync_debug_mode("error")
    try:
        play(amp, rollout)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_prints_what_the_style_costs():
    amp, ppo = make(8192, AMPConfig(), True), PPO(364, 69, PPOConfig(), "cuda")
    rollout = ppo.new_rollout(8192)
    source = amp.source
    source.kept = source.state()  # type: ignore[attr-defined]
    for turn in range(5):
        torch.cuda.synchronize()
        marks = [time.perf_counter()]
        for _ in range(24):
            amp.watch(source.result())  # type: ignore[attr-defined]
        torch.cuda.synchronize()
        marks.append(time.perf_counter())
        amp.pay(rollout, 10.0)
        torch.cuda.synchronize()
        marks.append(time.perf_counter())
        amp.update()
        torch.cuda.synchronize()
        marks.append(time.perf_counter())
        watch, pay, update = (b - a for a, b in itertools.pairwise(marks))
        print(f"turn {turn}: watching {watch:.4f} s, paying {pay:.4f} s, learning {update:.4f} s")
    print(f"memory {torch.cuda.max_memory_allocated() / 2**30:.1f} GiB")
