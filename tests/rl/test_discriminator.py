"""The discriminator against closed forms, and the replay against what was put in."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import nn

from rl.amp import AMP, AMPConfig, style_bonus
from rl.discriminator import Replay, discriminator_losses, style_reward
from rl.networks import MLP
from rl.ppo import PPO, PPOConfig
from rl.style_features import Demonstrations
from tests.rl.frames import Draws, step_result


def test_gradient_penalty_of_a_linear_discriminator_is_its_squared_weight():
    """D = w x + b: the gradient is w wherever the demonstrations are, and so is its own 2 w."""
    net = MLP(6, (), 1, "relu", 1.0)
    w = torch.tensor([0.5, -1.0, 2.0, 0.0, 0.25, -3.0])
    with torch.no_grad():
        net.head.weight.copy_(w)
    x = torch.randn(50, 6, generator=torch.Generator().manual_seed(0))
    losses = discriminator_losses(net, x, torch.ones(50), 3.0 * x + 7.0)
    assert losses.gradient.detach().item() == pytest.approx(float(w.square().sum()), rel=1e-6)
    losses.gradient.backward()
    torch.testing.assert_close(net.head.weight.grad[0], 2.0 * w)


def test_gradient_penalty_of_a_quadratic_logit():
    """D = |x|^2: the gradient is 2 x, the penalty the mean of 4 |x|^2 of demonstrations alone."""

    class Bowl(nn.Module):
        def forward(self, x):
            return x.square().sum(-1, keepdim=True)

    x = torch.randn(64, 3, generator=torch.Generator().manual_seed(1))
    losses = discriminator_losses(Bowl(), 100.0 * x, torch.ones(64), x)
    assert float(losses.gradient.detach()) == pytest.approx(4.0 * float(x.square().sum(-1).mean()))


def test_cross_entropies_and_accuracies_count_only_what_counts():
    """D = x of one number, by hand."""
    net = MLP(1, (), 1, "relu", 1.0)
    with torch.no_grad():
        net.head.weight.fill_(1.0)
    agent = torch.tensor([[-1.0], [2.0], [50.0]])
    shown = torch.tensor([[1.0], [-2.0]])
    losses = discriminator_losses(net, agent, torch.tensor([1.0, 1.0, 0.0]), shown)
    p = [1 / (1 + math.exp(-x)) for x in (-1.0, 2.0, 1.0, -2.0)]
    assert float(losses.agent.detach()) == pytest.approx(
        -(math.log(1 - p[0]) + math.log(1 - p[1])) / 2
    )
    assert float(losses.demonstration.detach()) == pytest.approx(
        -(math.log(p[2]) + math.log(p[3])) / 2
    )
    assert float(losses.accuracy_agent) == 0.5
    assert float(losses.accuracy_demonstration) == 0.5
    nothing = discriminator_losses(net, agent, torch.zeros(3), shown)
    assert float(nothing.agent) == 0.0


def test_style_reward_is_the_formula():
    x = torch.linspace(-8.0, 30.0, 39, dtype=torch.float64)
    formula = -2.0 * torch.log(torch.clamp(1.0 - torch.sigmoid(x), min=1e-4))
    torch.testing.assert_close(style_reward(x), formula)


def test_two_gaussians_reach_the_optimum_of_the_closed_form():
    """Agent N(0, 1), demonstrations N(1, 1): the best logit is log p_d / p_a = x - 1/2, so the
    best reward is -2 log(p_a / (p_a + p_d)), from the same batches that a run would draw."""
    g = torch.Generator().manual_seed(3)
    shown = torch.randn(20000, 1, generator=g) + 1.0
    config = AMPConfig(
        frames=1,
        hidden=(32,),
        batch=1024,
        steps=20,
        replay=4096,
        replay_share=1.0,
        learning_rate=3e-3,
        gradient_penalty=0.0,
        logit_decay=0.0,
        weight_decay=0.0,
    )
    source = Draws(256, 1, seed=4)
    begins = torch.arange(len(shown))
    kinds = torch.ones(len(shown), dtype=torch.bool)
    amp = AMP(source, Demonstrations(shown, begins, kinds), 256, 8, config, seed=0)
    rollout = PPO(1, 1, PPOConfig(hidden=(4,), steps=8)).new_rollout(256)
    statistics = {}
    for turn in range(60):
        if turn == 45:
            amp.optimizer.param_groups[0]["lr"].fill_(3e-4)
        for _ in range(8):
            source.draw()
            amp.watch(step_result(256, 1))
        amp.pay(rollout, 1.0)
        statistics = amp.update()
    x = torch.linspace(-1.5, 2.5, 41)[:, None]
    with torch.no_grad():
        found = style_reward(amp.net(amp.norm.normalize(x)).squeeze(-1)).numpy()
    p_a, p_d = stats.norm.pdf(x[:, 0], 0.0), stats.norm.pdf(x[:, 0], 1.0)
    best = -2.0 * np.log(np.maximum(p_a / (p_a + p_d), 1e-4))
    np.testing.assert_allclose(found, best, atol=0.2)
    # the expected reward of the agent, and the accuracy Phi(1/2) on both sides, are the optimum's
    grid = np.linspace(-6.0, 7.0, 4001)
    a, d = stats.norm.pdf(grid, 0.0), stats.norm.pdf(grid, 1.0)
    optimum = np.trapezoid(-2.0 * a * np.log(a / (a + d)), grid)
    assert float(statistics["style/reward"]) == pytest.approx(optimum, abs=0.06)
    for side in ("agent", "demonstration"):
        right = float(statistics[f"style/accuracy_{side}"])
        assert right == pytest.approx(stats.norm.cdf(0.5), abs=0.03)


@pytest.mark.parametrize("ceiling, least", [(0.9, 0.3), (1.0, 0.0)])
def test_a_discriminator_below_its_ceiling_leaves_something_to_be_paid(ceiling, least):
    """Agent N(0, 1), demonstrations N(6, 1): all can be told apart. Without a ceiling the reward
    of the agent goes to nothing; with one the net stops where it is right often enough, where a
    logit of a few units is what it takes, and the demonstrations' side still looks better."""
    g = torch.Generator().manual_seed(3)
    shown = torch.randn(5000, 1, generator=g) + 6.0
    plain = {"gradient_penalty": 0.0, "logit_decay": 0.0, "weight_decay": 0.0, "frames": 1}
    plain |= {"hidden": (32,), "batch": 512, "steps": 20, "replay": 4096, "learning_rate": 1e-3}
    config = AMPConfig(**plain, replay_share=1.0, ceiling=ceiling)
    source = Draws(256, 1, seed=4)
    kinds = torch.ones(len(shown), dtype=torch.bool)
    amp = AMP(source, Demonstrations(shown, torch.arange(5000), kinds), 256, 8, config, seed=0)
    rollout = PPO(1, 1, PPOConfig(hidden=(4,), steps=8)).new_rollout(256)
    statistics = {}
    for _ in range(40):
        for _ in range(8):
            source.draw()
            amp.watch(step_result(256, 1))
        amp.pay(rollout, 1.0)
        statistics = amp.update()
    paid = float(statistics["style/reward"])
    assert paid >= least and (least or paid < 0.02)
    with torch.no_grad():
        x = torch.tensor([[0.0], [6.0]])
        agent, demonstration = amp.net(amp.norm.normalize(x)).squeeze(-1).tolist()
    assert agent < demonstration


def test_replay_keeps_the_newest_and_draws_each_alike():
    replay = Replay(
        windows=20, steps=4, frames=3, size=1, device=torch.device("cpu"), dtype=torch.float32
    )
    assert replay.pieces == 5
    g = torch.Generator().manual_seed(0)
    for piece in range(0, 8, 2):  # two at a time, numbered; 5 fit
        both = torch.arange(6.0)[:, None] + 100.0 * torch.tensor([piece, piece + 1])
        replay.add(both[..., None], torch.ones(4, 2, dtype=torch.bool))
    picks = replay.draw(40_000, g)
    windows, counts = replay.windows(picks, torch.arange(3))
    assert counts.all()
    first = windows[:, 0, 0]
    torch.testing.assert_close(windows[:, :, 0], first[:, None] + torch.arange(3.0))
    names, found = np.unique(first.numpy(), return_counts=True)
    kept = [100 * piece + t for piece in range(3, 8) for t in range(4)]
    np.testing.assert_array_equal(names, kept)
    assert stats.chisquare(found).pvalue > 1e-3
    # before it is full, only what is there
    replay = Replay(20, 4, 3, 1, torch.device("cpu"), torch.float32)
    replay.add(torch.full((6, 2, 1), 7.0), torch.ones(4, 2, dtype=torch.bool))
    windows, _ = replay.windows(replay.draw(500, g), torch.arange(3))
    assert (windows == 7.0).all()


def test_a_multiplied_style_never_pays_for_prolonging():
    """Whatever the style, a step without task reward is worth nothing and a cost stays a cost."""
    g = torch.Generator().manual_seed(0)
    style = 18.4 * torch.rand(1000, generator=g)
    multiplied, added = AMPConfig(), AMPConfig(combine="additive")
    nothing = torch.zeros(1000)
    assert (style_bonus(nothing, style, multiplied) == 0.0).all()
    assert (style_bonus(-torch.rand(1000, generator=g), style, multiplied) == 0.0).all()
    earned = torch.rand(1000, generator=g)
    torch.testing.assert_close(
        earned + style_bonus(earned, style, multiplied), earned * (1.0 + 0.2 * style)
    )
    assert (style_bonus(nothing, style, added) == 0.2 * style).all()
    # An episode that has earned its reward is worth the same, however long it is drawn out.
    for length in (0, 10, 1000):
        task = torch.cat((earned, torch.zeros(length)))
        looks = torch.cat((style, torch.full((length,), 18.4)))
        total = (task + style_bonus(task, looks, multiplied)).sum()
        assert float(total) == pytest.approx(float((earned * (1.0 + 0.2 * style)).sum()), rel=1e-5)


@pytest.mark.parametrize(
    "wrong",
    [
        {"frames": 0},
        {"batch": 0},
        {"style": -0.1},
        {"optimised_share": 1.5},
        {"replay_share": 0.0},
        {"weight_decay": -1.0},
    ],
)
def test_settings_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        AMPConfig(**wrong)
