"""The limit of what a run charges: by hand, in a run, and over a resume."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from rl.charges import Charge, ChargeLimit, ChargeWatch
from rl.config import PPOConfig
from rl.rate_watch import ITERATIONS
from rl.runlog import read_progress
from rl.train import TrainConfig, train


def made(limit: float | None) -> tuple[ChargeLimit, Charge, Charge]:
    """A limit and two charges of two worlds: one asks for 1 and 3, the other for 1 and 1."""
    env = SimpleNamespace(device=torch.device("cpu"))
    held = ChargeLimit(SimpleNamespace(charge_limit=limit), env)
    one = Charge(lambda result: torch.tensor([[-1.0], [-3.0]]) * result.valid[:, None], held)
    two = Charge(lambda result: torch.tensor([[-1.0], [-1.0]]) * result.valid[:, None], held)
    return held, one, two


def iteration(
    parts: tuple[ChargeLimit, Charge, Charge], reward: float, steps: int = 3
) -> tuple[torch.Tensor, float]:
    """Plays one as the loop does; (N, A) bonus of its last step and what the log tells."""
    for part in parts:
        part.schedule(0.0)
    bonus = torch.zeros(())
    for _ in range(steps):
        result = SimpleNamespace(reward=torch.full((2, 1), reward), valid=torch.ones(2).bool())
        bonus = sum((charge.bonus(result) for charge in parts[1:]), torch.zeros(()))
        for part in parts:
            part.watch(result)
    told = {k: float(x) for part in parts for k, x in part.learn(None, 0).items()}
    return bonus, told["cost/share"]


def test_charges_are_held_to_their_share_by_one_factor():
    parts = made(0.5)
    assert iteration(parts, 4.0)[0].flatten().tolist() == [-2.0, -4.0], "nothing is known at first"
    bonus, share = iteration(parts, 4.0)  # 3 are asked for on average, 2 may be taken
    torch.testing.assert_close(bonus, torch.tensor([[-2.0], [-4.0]]) * 2 / 3)
    assert share == pytest.approx(0.5)
    for _ in range(200):
        iteration(parts, 2.0)
    bonus, share = iteration(parts, 2.0)
    assert bonus.mean().item() == pytest.approx(-1.0, rel=1e-4), "half of what is paid now"


def test_what_lies_below_the_limit_is_charged_as_it_comes():
    parts, free = made(0.5), made(None)
    for _ in range(3):
        bonus, share = iteration(parts, 8.0)
        assert bonus.flatten().tolist() == [-2.0, -4.0] and share == pytest.approx(3 / 8)
        bonus, share = iteration(free, 2.0)
        assert bonus.flatten().tolist() == [-2.0, -4.0] and share == pytest.approx(3 / 2)


def test_where_nothing_is_paid_nothing_is_charged():
    for pay in (0.0, -3.0):
        parts = made(0.5)
        iteration(parts, pay)
        bonus, share = iteration(parts, pay)
        assert not bonus.any() and share == 0.0


@pytest.mark.parametrize("wild", [1e6, float("nan")])
def test_a_world_whose_engine_diverged_counts_on_neither_side(wild):
    parts = made(0.5)
    for part in parts:
        part.schedule(0.0)
    result = SimpleNamespace(
        reward=torch.tensor([[4.0], [wild]]), valid=torch.tensor([True, False])
    )
    for charge in parts[1:]:
        charge.bonus(result)
    parts[0].watch(result)
    parts[0].learn(None, 0)
    assert parts[0].means.tolist() == pytest.approx([2.0, 1.0])


def test_a_run_goes_on_where_its_means_were():
    through, stopped = made(0.5), made(0.5)
    for parts in (through, stopped):
        iteration(parts, 4.0)
        iteration(parts, 3.0)
    again = made(0.5)
    again[0].load({}, stopped[0].state_dict())
    assert torch.equal(iteration(through, 1.0)[0], iteration(again, 1.0)[0])
    older = made(0.5)
    older[0].load({}, {})
    assert iteration(older, 4.0)[0].flatten().tolist() == [-2.0, -4.0], "nothing is known of it"


def test_a_run_holds_its_limit(tmp_path):
    """The same run with and without: what would be three times the pay comes to a tenth of it."""
    small = PPOConfig(hidden=(8,), steps=6, minibatches=1, epochs=1)
    config = TrainConfig(
        task="long_jump", out=tmp_path / "free", worlds=4, samples=6 * 4 * 8, quiet=True, ppo=small
    )
    config = replace(config, torque_change=3.0, impact=0.1, impact_limit=0.0)
    train(config)
    train(replace(config, out=tmp_path / "held", charge_limit=0.1))
    free, held = (read_progress(tmp_path / name)[1:] for name in ("free", "held"))
    assert min(row["cost/share"] for row in free) > 1.0
    assert all(0.0 < row["cost/share"] <= 0.1001 for row in held[1:])
    assert all(row["cost/torque_change"] > 0.0 and row["cost/impact"] > 0.0 for row in held[1:])


def test_a_run_that_charges_too_much_is_warned_once():
    watch = ChargeWatch()
    assert [watch({"cost/share": 1.2}, 0.1) for _ in range(ITERATIONS - 1)] == [None] * (
        ITERATIONS - 1
    )
    told = watch({"cost/share": 1.234}, 0.1)
    assert told is not None and "123%" in told and "--charge-limit" in told
    assert all(watch({"cost/share": 1.2}, 0.1) is None for _ in range(2 * ITERATIONS))
    calm = ChargeWatch()
    rows = [{"cost/share": 0.5}, {"cost/share": 0.9}, {"loss": 0.0}]
    assert all(calm(row, 0.1) is None for _ in range(2 * ITERATIONS) for row in rows)


def test_a_limit_that_cannot_be_is_refused():
    for value in (0.0, 1.0, -0.5, float("nan")):
        with pytest.raises(ValueError, match="charge_limit must lie between 0 and 1"):
            TrainConfig(task="long_jump", charge_limit=value, impact=0.1)
    with pytest.raises(ValueError, match="give --impact, --sinking or --torque-change"):
        TrainConfig(task="long_jump", charge_limit=0.5)
