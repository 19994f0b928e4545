"""Episodes that begin before an earlier one failed."""

from __future__ import annotations

import pytest
import torch

from sports.env import SAVED, Env, make_env
from sports.registry import num_agents, task_names
from sports.retries import EVERY, SIZE, Failures, Retries

TENTH = 0.1
"""Seconds of a step here."""


def moments(worlds: int, step: int) -> dict[str, torch.Tensor]:
    """In which every number tells the step and the world."""
    at = torch.full((worlds,), step)
    return {
        "clock": at,
        "odd": at % 2 == 1,
        "place": (1000.0 * torch.arange(worlds) + step)[:, None, None].expand(-1, 2, 1),
    }


@pytest.mark.parametrize("fails_at", range(61, 61 + EVERY))
def test_a_moment_lies_as_long_before_the_failure_as_asked(fails_at):
    how, worlds = Retries(share=0.99, seconds=(1.5, 4.2)), 200
    failures, generator = Failures(how, moments(worlds, 0), TENTH), torch.Generator()
    nobody = torch.zeros(worlds, dtype=torch.bool)
    for step in range(1, fails_at + 1):
        failed = nobody if step < fails_at else torch.arange(worlds) < 150
        failures.watch(failed, failed, moments(worlds, step), generator)
    assert failures.count == 150
    again, past = failures.draw(~nobody, generator)
    assert 180 < again.sum() <= worlds
    lag = fails_at - past["clock"]
    kept = {n for n in range(15, 43) if (fails_at - n) % EVERY == 0}
    assert set(lag.tolist()) == kept
    assert torch.equal(past["odd"], past["clock"] % 2 == 1)
    world, step = past["place"][:, 0, 0] // 1000, past["place"][:, 0, 0] % 1000
    assert torch.equal(step.long(), past["clock"]) and world.max() < 150
    assert len(world.unique()) > 50 and past["place"].shape == (worlds, 2, 1)
    assert torch.equal(failures.retried, again) and not failures.since.any()


def test_who_fails_soon_after_a_retry_is_no_lesson_and_new_failures_replace_old_ones():
    worlds = 700
    failures = Failures(Retries(0.5, (0.0, 1.0)), moments(worlds, 0), TENTH)
    generator, everyone = torch.Generator(), torch.ones(worlds, dtype=torch.bool)
    steps, counts = [11, 21, 41], []  # since the last reset: 11, 10, 20
    for step in range(1, 42):
        failed = everyone if step in steps else ~everyone
        began_so = failures.retried.clone()
        failures.watch(failed, failed, moments(worlds, step), generator)
        if step in steps:
            counts.append(int(failures.count))
            if step == 21:
                assert 250 < began_so.sum() < 450
                # The rest has a moment of its own, begun at 11: that of step 20.
                assert counts[1] - counts[0] == (~began_so).sum()
                new = failures.bank[counts[0] : SIZE, 0][: counts[1] - counts[0]]
                assert (new == 20).all()
            failures.draw(everyone, generator)
    assert counts[0] == worlds and counts[2] == counts[1] + worlds
    _, past = failures.draw(everyone, generator)
    after = failures.bank[:SIZE, 0]
    # The last 700 are all of the last failure, and 324 places hold some of those before.
    assert (after == 40).sum() == worlds
    assert ((after == 10) | (after == 20)).sum() == SIZE - worlds
    assert (past["clock"] < 41).all()


@pytest.mark.parametrize("fails_after", range(2, 45))
def test_of_a_short_episode_moments_are_its_own(fails_after):
    """Begun at step 37, failed so many steps later, with moments asked from 1.5 to 4.2 s before."""
    worlds, began = 300, 37
    failures = Failures(Retries(0.99, (1.5, 4.2)), moments(worlds, 0), TENTH)
    generator, everyone = torch.Generator(), torch.ones(worlds, dtype=torch.bool)
    for step in range(1, began + fails_after + 1):
        over = everyone if step in (began, began + fails_after) else ~everyone
        failures.watch(over, over & (step > began), moments(worlds, step), generator)
        if step == began:
            failures.draw(everyone, generator)
            assert not failures.retried.any()
    own = range(began + 1, began + fails_after + 1)
    kept = {s for s in own if s % EVERY == 0 and 15 <= began + fails_after - s <= 42}
    assert failures.count == (worlds if kept else 0)
    if kept:
        _, past = failures.draw(everyone, generator)
        assert set(past["clock"].tolist()) == kept


@pytest.mark.parametrize("even", [False, True])
def test_moments_that_are_saved_now_and_then_come_most(even):
    """Three moments: nobody is saved from the first, everybody from the third, half from the
    second. What an episode does after its moment was replaced says nothing of the new one."""
    worlds, generator = 300, torch.Generator().manual_seed(0)
    failures = Failures(Retries(0.99, (0.0, 1.0), even=even), moments(worlds, 0), TENTH)
    everyone, nobody = torch.ones(worlds, dtype=torch.bool), torch.zeros(worlds, dtype=torch.bool)
    for step in range(1, 22):
        failed = torch.arange(worlds) < (3 if step == 21 else 0)
        failures.watch(failed, failed, moments(worlds, step), generator)
    assert failures.count == 3
    came = torch.zeros(3)
    for step in range(40):
        again, _ = failures.draw(everyone, generator)
        place = failures.place
        came += (torch.bincount(place, minlength=3) if step >= 20 else torch.zeros(3)).float()
        fails = (place == 0) | ((place == 1) & (torch.arange(worlds) % 2 == 0))
        failures.watch(everyone, fails & again, moments(worlds, 22), generator)
    share = came / came.sum()
    if even:
        assert ((share - 1 / 3).abs() < 0.03).all()
    else:
        assert share[1] > 0.95 and (share > 0).all()
    p = (failures.saves / failures.tries)[:3]
    assert p[0] == 0 and p[2] == 1 and 0.4 < p[1] < 0.6

    failures.draw(everyone, generator)
    tries = failures.tries.clone()
    failures.number[1] += SIZE  # replaced meanwhile
    failures.watch(everyone, nobody, moments(worlds, 22), generator)
    grown = (failures.tries - tries)[:3]
    assert grown[1] == 0 and grown[[0, 2]].sum() == ((failures.place != 1) & failures.retried).sum()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_nothing_waits_for_a_gpu():
    worlds, generator = 200, torch.Generator("cuda").manual_seed(0)

    def told(step: int) -> dict[str, torch.Tensor]:
        return {name: value.cuda() for name, value in moments(worlds, step).items()}

    steps = [told(step) for step in range(61)]
    failures = Failures(Retries(0.99, (1.5, 4.2)), steps[0], TENTH)
    everyone = torch.ones(worlds, dtype=torch.bool, device="cuda")
    torch.cuda.set_sync_debug_mode("error")
    try:
        for step in range(1, 61):
            over = everyone if step == 60 else ~everyone
            failures.watch(over, over, steps[step], generator)
        again, past = failures.draw(everyone, generator)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert again.sum() > 180 and failures.count == worlds
    assert set((60 - past["clock"]).tolist()) == {20, 30, 40}


def test_times_that_hold_no_moment_are_refused():
    for seconds in ((0.5, 1.3), (2.0, 2.5)):
        with pytest.raises(ValueError, match="a moment is kept every 1 s"):
            Failures(Retries(0.5, seconds), moments(2, 0), TENTH)
    for wrong in (dict(share=1.0), dict(share=-0.1), dict(seconds=(-1.0, 2.0))):
        with pytest.raises(ValueError, match="retries"):
            Retries(**wrong)
    with pytest.raises(ValueError, match="before a failure, not 3"):
        Retries(0.5, (3.0, 2.0))


def hurdlers(seed: int = 3) -> Env:
    env = make_env("hurdling", num_worlds=16, seed=seed, options={"height": 0.5})
    env.retry(Retries(0.9, (0.1, 0.45)))
    return env


def test_an_athlete_begins_where_another_was_and_its_metrics_are_apart():
    env = hurdlers()
    generator = torch.Generator().manual_seed(0)
    been: dict[tuple[int, ...], dict[str, torch.Tensor]] = {}
    begun = saved = ended = 0
    for _ in range(150):
        action = 0.3 * torch.randn(16, 1, env.action_size, generator=generator)
        before = env._failures.retried.clone()
        result = env.step(action)
        assert torch.equal(result.metrics[SAVED].isnan(), ~before)
        assert result.metrics["distance"].isnan().equal(before)
        saved += int(result.metrics[SAVED].nan_to_num().sum())
        ended += int((result.ended & before).sum())
        fresh = (result.ended & env._failures.retried).nonzero()[:, 0].tolist()
        now = env.state_dict()
        for w in fresh:
            past = been[tuple(now["qpos"][w, :3].view(torch.int32).tolist())]
            for name, value in past.items():
                torch.testing.assert_close(now[name][w], value, rtol=0, atol=0, equal_nan=True)
            assert env.age[w] == env.view.clock[w]
            begun += 1
        for w in range(16):
            if not result.ended[w]:
                row = {k: now[k][w].clone() for k in now if k.startswith("memory/")}
                row |= {k: now[k][w].clone() for k in ("qpos", "qvel", "mocap_pos", "clock")}
                been[tuple(now["qpos"][w, :3].view(torch.int32).tolist())] = row
    assert begun > 20 and ended > 10 and saved == 0  # nobody comes to the finish
    env.close()


def test_a_state_that_is_taken_back_goes_on_alike():
    env, other = hurdlers(), hurdlers(seed=4)
    generator = torch.Generator().manual_seed(0)
    actions = 0.3 * torch.randn(160, 16, 1, env.action_size, generator=generator)
    for action in actions[:100]:
        env.step(action)
    assert env._failures.count > 0
    other.load_state_dict(env.state_dict())
    for action in actions[100:]:
        assert torch.equal(env.step(action).obs, other.step(action).obs)
    banks = (each._failures.bank for each in (env, other))
    torch.testing.assert_close(*banks, rtol=0, atol=0, equal_nan=True)
    plain = make_env("hurdling", num_worlds=16, seed=3)
    with pytest.raises(ValueError, match="the failures are of another task"):
        env.load_state_dict(plain.state_dict())
    for each in (env, other, plain):
        each.close()


@pytest.mark.parametrize("task", [name for name in task_names() if num_agents(name) == 1])
def test_an_episode_of_any_sport_goes_on_in_another_world(task, monkeypatch):
    """As it does where it was, but for the solver's first guess."""
    env, other = (make_env(task, num_worlds=4, seed=seed) for seed in (1, 2))
    generator, shape = torch.Generator().manual_seed(0), (4, 1, env.action_size)
    for _ in range(12):
        env.step(0.3 * torch.randn(shape, generator=generator))
    other.retry(Retries(0.5))
    moment, everyone = env._moment(), torch.ones(4, dtype=torch.bool)
    there = {name: value.roll(1, 0) for name, value in moment.items()}
    monkeypatch.setattr(other._failures, "draw", lambda mask, generator: (everyone, there))
    seen = other.reset()
    torch.testing.assert_close(seen, env._observe().roll(1, 0), rtol=1e-5, atol=1e-5)
    for _ in range(3):
        action = 0.3 * torch.randn(shape, generator=generator)
        left, right = env.step(action), other.step(action.roll(1, 0))
        assert torch.equal(right.terminated, left.terminated.roll(1, 0))
        if left.terminated.any():
            break
        for name, value in left.terms.items():
            torch.testing.assert_close(
                right.terms[name], value.roll(1, 0), rtol=1e-3, atol=1e-3, msg=name
            )
    env.close(), other.close()


def test_retries_are_for_one_athlete():
    env = make_env("boxing", num_worlds=2)
    with pytest.raises(ValueError, match="retries are for one"):
        env.retry(Retries(0.5))
    env.close()
