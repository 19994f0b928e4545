"""A run is told once when its learning rate cannot follow its divergence."""

from dataclasses import replace

import pytest

from rl.ppo import PPOConfig
from rl.rate_watch import ITERATIONS, RateWatch
from rl.train import train
from tests.rl.toy import SMALL, toy_config, toy_env


def rows(kl: float, rate: float, number: int) -> list[dict[str, float | int | None]]:
    return [{"kl": kl, "learning_rate": rate} for _ in range(number)]


CONFIG = PPOConfig(kl_band=(0.004, 0.016), kl_band_final=(0.001, 0.004))


@pytest.mark.parametrize(
    ("kl", "rate", "share", "told"),
    [
        (0.020, 1e-6, 0.0, True),
        (0.020, 2e-6, 0.0, False),  # the rate can still fall
        (0.010, 1e-6, 0.0, False),  # in the band
        (0.010, 1e-6, 0.5, True),  # halfway the band ends at 0.008
        (0.000, 1e-6, 0.0, False),  # the critic learns alone
    ],
)
def test_it_speaks_at_the_least_rate_above_the_band(kl, rate, share, told):
    watch = RateWatch(CONFIG)
    said = [watch(row, share) for row in rows(kl, rate, 2 * ITERATIONS)]
    assert [i for i, words in enumerate(said) if words] == ([ITERATIONS - 1] if told else [])


def test_one_good_iteration_starts_the_count_again():
    watch = RateWatch(CONFIG)
    played = [*rows(0.02, 1e-6, ITERATIONS - 1), *rows(0.01, 1e-6, 1), *rows(0.02, 1e-6, 5)]
    assert not any(watch(row, 0.0) for row in played)
    assert not any(RateWatch(PPOConfig(kl_band=None))(r, 0.0) for r in rows(1.0, 1e-6, 30))
    assert not any(watch({"kl": None, "learning_rate": 1e-6}, 0.0) for _ in range(30))


def test_a_run_says_so(tmp_path, capsys):
    """A band that no step of the least rate can keep."""
    ppo = replace(SMALL, kl_band=(1e-12, 1e-11), learning_rate=1e-4, learning_rate_limits=(1e-4, 1))
    samples = (ITERATIONS + 3) * 64 * 16
    config = toy_config(tmp_path, samples=samples, ppo=ppo, quiet=False)
    train(config, environment=toy_env)
    said = capsys.readouterr().err
    assert said.count("warning: the divergence has been above 1e-11 for 20 iterations") == 1
