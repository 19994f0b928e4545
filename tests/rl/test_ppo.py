"""PPO against closed forms, autograd of the textbook loss, and permutations."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from rl.ppo import LOSSES, PAPER, PPO, PPOConfig, adapted_rate, gaussian_log_prob, surrogate_loss
from rl.rollout import Rollout
from rl.train import train
from tests.rl.toy import SMALL, A, B, Integrator, Q, R, optimal_cost, toy_config, toy_env


def filled_rollout(
    agent: PPO, rows: int, seed: int, spread: float | None = None
) -> tuple[Rollout, torch.Tensor]:
    """A rollout of made-up numbers, and its raw observations: unit normal ones, or all ``spread``
    around the same one."""
    g = torch.Generator().manual_seed(seed)
    r = agent.new_rollout(rows)
    raw = torch.randn(r.obs.shape, generator=g)
    if spread is not None:
        raw = torch.randn(r.obs.shape[-1], generator=g) + spread * raw
    with torch.no_grad():
        for t in range(r.steps):
            r.obs[t] = agent.prepare(raw[t])
            r.final_obs[t] = agent.prepare(torch.randn(raw[t].shape, generator=g))
            r.mean[t] = agent.actor(r.obs[t])
        r.action.copy_(r.mean + agent.sigma * torch.randn(r.mean.shape, generator=g))
        r.log_prob.copy_(gaussian_log_prob(r.action, r.mean, agent.sigma))
    r.reward.copy_(torch.randn(r.reward.shape, generator=g))
    r.terminated.copy_(torch.rand(r.reward.shape, generator=g) < 0.05)
    r.truncated.copy_((torch.rand(r.reward.shape, generator=g) < 0.05) & ~r.terminated)
    r.valid.copy_(torch.rand(r.reward.shape, generator=g) > 0.05)
    return r, raw


def test_reaches_the_optimum_of_a_linear_quadratic_problem(tmp_path):
    config = dataclasses.replace(SMALL, sigma_final=0.05, learning_rate=1e-3)
    run = toy_config(tmp_path, samples=70 * 64 * 16, ppo=config)
    envs = []
    train(run, environment=lambda c, s: envs.append(toy_env(c, s)) or envs[-1])
    from rl.policy import load_policy

    policy = load_policy(tmp_path, "toy")
    P, K = optimal_cost(config.gamma)
    rng = np.random.default_rng(1)
    x0 = rng.uniform(-1, 1, (200, 2))

    def cost(act) -> float:
        x, total = x0.copy(), 0.0
        for t in range(200):
            a = act(x)
            total += config.gamma**t * (((x @ Q) * x).sum(-1) + R[0, 0] * a[:, 0] ** 2)
            x = x @ A.T + a @ B.T
        return float(total.mean())

    best = float(np.einsum("ni,ij,nj->n", x0, P, x0).mean())
    assert cost(lambda x: -x @ K.T) == pytest.approx(best, rel=1e-3)  # the closed form itself
    learned = cost(lambda x: policy(torch.tensor(x, dtype=torch.float32)).double().numpy())
    idle = cost(lambda x: np.zeros((len(x), 1)))
    print(f"cost: optimal {best:.4f}, learned {learned:.4f}, idle {idle:.4f}")
    assert best * 0.999 <= learned <= 1.10 * best
    assert idle > 2.0 * best


def test_surrogate_gradient_is_that_of_the_textbook_case_distinction():
    g = torch.Generator().manual_seed(3)
    ratio = (1.0 + 0.5 * torch.randn(500, generator=g)).requires_grad_()
    advantage = torch.randn(500, generator=g)
    surrogate_loss(ratio, advantage, 0.2).sum().backward()
    r, a = ratio.detach(), advantage
    # Nothing is earned by moving on where the ratio has already left the trust interval on the
    # side that the advantage asks for; else the gradient is the advantage's.
    stopped = ((a > 0) & (r > 1.2)) | ((a < 0) & (r < 0.8))
    torch.testing.assert_close(ratio.grad, torch.where(stopped, 0.0, -a))


def test_log_prob_is_that_of_torch_distributions():
    g = torch.Generator().manual_seed(0)
    mean, action = torch.randn(2, 50, 7, generator=g)
    sigma = torch.tensor(0.3)
    expected = torch.distributions.Normal(mean, sigma).log_prob(action).sum(-1)
    torch.testing.assert_close(gaussian_log_prob(action, mean, sigma), expected)


def test_one_minibatch_step_is_the_reference_step():
    """One epoch of one minibatch: Adam's first step from autograd of the written-out objective."""
    config = PPOConfig(
        hidden=(16,), steps=5, minibatches=1, epochs=1, kl_band=None, grad_norm=1e9, sigma=0.2
    )
    agent, reference = (PPO(3, 2, config, seed=1) for _ in range(2))
    with torch.no_grad():  # means outside the bounds too, and a policy that has moved
        for a in (agent, reference):
            a.actor.head.bias += torch.tensor([1.1, -0.4])
    rollout, _ = filled_rollout(agent, 30, seed=5)
    rollout.mean.add_(0.05)
    rollout.log_prob.copy_(gaussian_log_prob(rollout.action, rollout.mean, agent.sigma))
    agent.update(rollout)

    keep = rollout.valid.flatten()
    obs = rollout.obs.flatten(0, 1)[keep]
    action, old = rollout.action.flatten(0, 1)[keep], rollout.mean.flatten(0, 1)[keep]
    advantage = rollout.advantages.flatten()[keep]
    advantage = (advantage - advantage.mean()) / advantage.std(unbiased=False)
    returns = rollout.returns.flatten()[keep]
    target = (returns - returns.mean()) / (returns.var(unbiased=False) + 1e-4).sqrt()
    mean = reference.actor(obs)
    new = torch.distributions.Normal(mean, 0.2).log_prob(action).sum(-1)
    was = torch.distributions.Normal(old, 0.2).log_prob(action).sum(-1)
    ratio = (new - was).exp()
    policy = torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    excess = (mean.abs() - 1.0).clamp(min=0.0).square().sum(-1).mean()
    critic = (reference.critic(obs).squeeze(-1) - target).square().mean()
    (-policy + 10.0 * excess + critic).backward()
    torch.optim.Adam(
        [
            {"params": reference.actor.parameters(), "lr": config.learning_rate},
            {"params": reference.critic.parameters(), "lr": config.critic_learning_rate},
        ]
    ).step()
    assert float(excess.detach()) > 0
    for part in ("actor", "critic"):
        ours, theirs = getattr(agent, part).state_dict(), getattr(reference, part).state_dict()
        for name in ours:
            torch.testing.assert_close(ours[name], theirs[name], rtol=1e-4, atol=2e-6)


def test_no_policy_gradient_where_the_action_has_no_noise():
    """Several minibatches: from the second on a mean without noise is not the action any more, and
    a plain ratio would push it further, down or up as the advantage says."""
    config = PPOConfig(hidden=(16,), steps=5, minibatches=3, epochs=4, sigma=0.2)
    agent = PPO(3, 4, config, seed=1)
    agent.noisy[2:] = 0.0
    rollout, raw = filled_rollout(agent, 30, seed=5)
    drawn = [agent.act(x) for x in raw]
    for name, k in (("action", 1), ("mean", 2), ("log_prob", 3)):
        getattr(rollout, name).copy_(torch.stack([step[k] for step in drawn]))
    assert torch.equal(rollout.action[..., 2:], rollout.mean[..., 2:])
    assert (rollout.action - rollout.mean)[..., :2].std() == pytest.approx(0.2, rel=0.2)
    before = agent.actor.head.weight.detach().clone()
    stats = agent.update(rollout)
    moved = (agent.actor.head.weight - before).abs().amax(1)
    assert (moved[:2] > 0).all() and torch.equal(moved[2:], torch.zeros(2))
    mean = agent.actor(rollout.obs).detach()
    apart = (mean - rollout.mean)[..., :2] / agent.sigma  # the hidden layer moved the others, too
    assert 0 < float(stats["kl"]) < 4 * float(0.5 * apart.square().sum(-1).mean())


def test_permuted_worlds_learn_the_same():
    config = PPOConfig(hidden=(16,), steps=4, minibatches=1, epochs=3)
    agents = [PPO(3, 2, config, seed=1) for _ in range(2)]
    rollout, _ = filled_rollout(agents[0], 40, seed=2)
    permuted, _ = filled_rollout(agents[1], 40, seed=2)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(0))
    for name, x in vars(permuted).items():
        if isinstance(x, torch.Tensor):
            x.copy_(getattr(rollout, name)[:, order])
    for agent, r in zip(agents, (rollout, permuted)):
        agent.update(r)
    for a, b in zip(agents[0].actor.parameters(), agents[1].actor.parameters()):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_invalid_samples_teach_nothing():
    """Whatever stands in a masked sample, the weights after the update are the same bits."""
    config = PPOConfig(hidden=(16,), steps=4, minibatches=2, epochs=2)
    results = []
    for junk in (0.0, 37.0):
        agent = PPO(3, 2, config, seed=1)
        rollout, _ = filled_rollout(agent, 40, seed=2)
        bad = ~rollout.valid
        rollout.reward[bad] = junk
        rollout.final_obs[bad] = junk
        agent.update(rollout)
        results.append(agent.actor.head.weight.detach().clone())
    assert bad.any()
    torch.testing.assert_close(results[0], results[1], rtol=0, atol=0)


def test_rate_follows_the_divergence_within_its_limits():
    config = PPOConfig()
    low, high = config.kl_band
    rate = torch.tensor(1e-4)
    assert adapted_rate(rate, torch.tensor(2 * high), config) < rate
    assert adapted_rate(rate, torch.tensor(low / 2), config) > rate
    assert adapted_rate(rate, torch.tensor((low + high) / 2), config) == rate
    for kl, limit in ((1.0, config.learning_rate_limits[0]), (0.0, config.learning_rate_limits[1])):
        x = rate
        for _ in range(50):
            x = adapted_rate(x, torch.tensor(kl), config)
        assert float(x) == pytest.approx(limit)
    fixed = dataclasses.replace(config, kl_band=None)
    assert adapted_rate(rate, torch.tensor(1.0), fixed) == rate


def test_the_band_moves_geometrically_and_the_control_follows_it():
    config = PPOConfig(kl_band=(0.04, 0.1), kl_band_final=(0.01, 0.025), learning_rate=1e-4)
    agent = PPO(3, 2, config)
    # A divergence below the first band and above the last one.
    stats = torch.tensor([0.03, *(len(LOSSES) - 1) * [0.0]])
    for share, low, direction in ((0.0, 0.04, 1), (0.5, 0.02, 0), (1.0, 0.01, -1)):
        agent.schedule(share)
        assert agent.kl_band.tolist() == pytest.approx([low, 2.5 * low])
        agent.learning_rate.fill_(1e-4)
        for p in agent._named_parameters().values():
            p.grad = torch.zeros_like(p)
        agent._descend(stats)
        assert float(agent.learning_rate) == pytest.approx(1e-4 * 1.5**direction)
    with pytest.raises(ValueError, match="needs a kl_band"):
        PPOConfig(kl_band=None, kl_band_final=(0.01, 0.02))


def test_control_keeps_the_divergence_of_a_run_near_its_band(tmp_path):
    """From a hundred times too small a rate the control finds the band; a fixed one stays idle."""
    seen = {}
    for name, band in (("adaptive", (0.008, 0.03)), ("fixed", None)):
        config = dataclasses.replace(
            SMALL, learning_rate=1e-5, kl_band=band, learning_rate_limits=(1e-5, 1e-2)
        )
        rows = []
        run = toy_config(tmp_path / name, samples=15 * 64 * 16, ppo=config)
        train(run, environment=toy_env, on_iteration=rows.append)
        seen[name] = np.mean([row["kl"] for row in rows[8:]])
    print(seen)
    assert 0.004 < seen["adaptive"] < 0.06
    assert seen["fixed"] < 0.1 * seen["adaptive"]


def test_an_actor_that_begins_as_another_keeps_what_it_knows():
    """The divergence of the first update, measured from the means and the definition. Rewards and
    noise are made up: nothing is there to be learned, so all of it is damage. All athletes stand
    at the same start."""
    teacher = PPO(40, 28, PPOConfig(hidden=(256, 128)), seed=1)

    def damage(rate: float | None) -> float:
        agent = PPO(40, 28, PPOConfig(hidden=(256, 128), sigma=0.02), seed=2)
        agent.load_policy(teacher.actor, torch.zeros(40), torch.ones(40), 1e6)
        if rate is not None:
            agent.learning_rate.fill_(rate)
        rollout, raw = filled_rollout(agent, 64, seed=3, spread=0.1)
        before = rollout.mean.clone()
        agent.update(rollout)
        with torch.no_grad():
            after = agent.actor(agent.prepare(raw))
        return float(((after - before) ** 2).sum(-1).mean() / (2 * 0.02**2))

    gentle, sudden = damage(None), damage(PPOConfig().learning_rate)
    print(f"{gentle:.4f} nats, from the rate of a fresh run {sudden:.4f}")
    assert gentle < 0.2 * sudden
    fixed = PPO(40, 28, PPOConfig(hidden=(256, 128), kl_band=None))
    fixed.load_policy(teacher.actor, torch.zeros(40), torch.ones(40), 1e6)
    assert float(fixed.learning_rate) == pytest.approx(PPOConfig().learning_rate)


def _paid_by_the_action(agent: PPO, updates: int) -> float:
    """Updates where the action itself is the reward and ends the episode; the mean's way."""
    agent.load_policy(PPO(3, 1, agent.config, seed=4).actor, torch.zeros(3), torch.ones(3), 1e6)
    rollout, raw = filled_rollout(agent, 512, seed=5, spread=0.0)
    g = torch.Generator().manual_seed(6)
    begun = float(rollout.mean.mean())
    for _ in range(updates):
        with torch.no_grad():
            rollout.mean.copy_(agent.actor(agent.prepare(raw)))
        noise = torch.randn(rollout.mean.shape, generator=g)
        rollout.action.copy_(rollout.mean + agent.sigma * noise)
        rollout.log_prob.copy_(gaussian_log_prob(rollout.action, rollout.mean, agent.sigma))
        rollout.reward.copy_(rollout.action.squeeze(-1))
        rollout.terminated.fill_(True)
        rollout.valid.fill_(True)
        agent.update(rollout)
    with torch.no_grad():
        return float(agent.actor(agent.prepare(raw)).mean()) - begun


def test_an_anchored_actor_stops_where_the_closed_form_says():
    """Paid by a itself, the advantage of unit deviation is (a - mean) / sigma, whose policy
    gradient is 1 / sigma; the anchor's is weight (mean - first) / sigma^2: they meet at
    sigma / weight."""
    config = PPOConfig(
        hidden=(16,), steps=4, minibatches=1, epochs=1, kl_band=None, learning_rate=1e-3, sigma=0.1
    )
    ways = {}
    for weight in (0.0, 1.0, 4.0):
        agent = PPO(3, 1, dataclasses.replace(config, anchor=weight), seed=4)
        ways[weight] = _paid_by_the_action(agent, 150)
    print(ways)
    assert ways[1.0] == pytest.approx(0.1, rel=0.1)
    assert ways[4.0] == pytest.approx(0.025, rel=0.15)
    assert ways[0.0] > 0.3


def test_an_anchor_survives_a_checkpoint():
    config = PPOConfig(hidden=(16,), steps=4, minibatches=2, epochs=2, anchor=0.5)
    agent, resumed = PPO(3, 2, config, seed=1), PPO(3, 2, config, seed=7)
    agent.load_policy(PPO(3, 2, config, seed=2).actor, torch.zeros(3), torch.ones(3), 1e6)
    rollout, _ = filled_rollout(agent, 40, seed=2)
    assert float(agent.update(rollout)["anchor_loss"]) > 0.0
    resumed.load_state_dict({name: x.clone() for name, x in agent.state_dict().items()})
    after = [{k: float(x) for k, x in a.update(rollout).items()} for a in (agent, resumed)]
    assert after[0] == after[1]
    free = PPO(3, 2, dataclasses.replace(config, anchor=0.0), seed=2)
    assert float(free.update(rollout)["anchor_loss"]) == 0.0


def test_an_anchor_that_cannot_hold_is_refused(tmp_path):
    with pytest.raises(ValueError, match="anchor must not be negative"):
        PPOConfig(anchor=-1.0)
    with pytest.raises(ValueError, match="moving_statistics would move the anchor"):
        PPOConfig(anchor=1.0, moving_statistics=True)
    with pytest.raises(ValueError, match="give --init"):
        toy_config(tmp_path, ppo=PPOConfig(anchor=1.0))


def test_paper_preset_is_the_papers_table():
    assert (PAPER.learning_rate, PAPER.kl_band, PAPER.sigma) == (5e-4, None, 0.05)
    assert (PAPER.clip_ratio, PAPER.gamma, PAPER.hidden) == (0.2, 0.99, (2048, 1024, 512))
    assert PAPER.steps * 2048 / PAPER.minibatches == 1024


def test_critic_warmup_leaves_the_actor_alone():
    config = PPOConfig(hidden=(16,), steps=4, minibatches=2, epochs=2)
    agent = PPO(3, 2, config, seed=1)
    rollout, _ = filled_rollout(agent, 40, seed=2)
    actor, critic = agent.actor.head.weight.clone(), agent.critic.head.weight.clone()
    agent.actor_weight.fill_(0.0)
    agent.update(rollout)
    assert torch.equal(actor, agent.actor.head.weight)
    assert not torch.equal(critic, agent.critic.head.weight)


def test_too_few_samples_for_the_minibatches_is_said():
    agent = PPO(2, 1, PPOConfig(hidden=(8,), steps=1, minibatches=8))
    with pytest.raises(ValueError, match="minibatches"):
        agent.new_rollout(4)


def test_the_toy_really_follows_its_matrices():
    env = Integrator(5)
    env.reset()
    before = env.x.double().numpy()
    action = torch.full((5, 1, 1), 0.3)
    result = env.step(action)
    np.testing.assert_allclose(result.final_obs[:, 0].numpy(), before @ A.T + 0.3 * B.T, atol=1e-6)
