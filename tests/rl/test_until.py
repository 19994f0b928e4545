"""Whether a run ends when a figure of its log has come to a level, and then only."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from rl.train import TrainConfig, main, train
from rl.until import ITERATIONS, Until
from tests.rl.toy import toy_config, toy_env


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_mean_of_the_last_values_decides(sign):
    """Against a convolution over random values, of which some are missing."""
    draw = np.random.default_rng(3)
    values = np.where(draw.random(200) < 0.3, np.nan, draw.normal(size=200).cumsum() / 4)
    until = Until("metrics/success>=1.5" if sign > 0 else "metrics/success<=-1.5")
    told = [until({"metrics/success": None if np.isnan(x) else float(sign * x)}) for x in values]
    known = values[~np.isnan(values)]
    means = np.convolve(known, np.ones(ITERATIONS) / ITERATIONS, mode="valid")
    count = np.cumsum(~np.isnan(values))
    want = [n >= ITERATIONS and means[n - ITERATIONS] >= 1.5 for n in count]
    assert told == want
    assert any(want) and not all(want[ITERATIONS * 2 :])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("metrics/success", "a number"),
        ("metrics/success>0.5", "a number"),
        ("metrics/success>=1.2.3", "a number"),
        ("samples>=5", "not at 'samples'"),
        ("kl<=1", "not at 'kl'"),
    ],
)
def test_what_is_no_condition_is_refused(text, words):
    with pytest.raises(ValueError, match=words):
        TrainConfig(task="toy", until=text)


def test_a_run_ends_as_soon_as_it_is_there(tmp_path):
    """The same run without it: its log says when that was."""
    train(toy_config(tmp_path / "whole", samples=24 * 1024), environment=toy_env)
    with open(tmp_path / "whole" / "progress.csv", newline="") as f:
        log = [float(row["metrics/final_distance"]) for row in csv.DictReader(f)]
    means = np.convolve(log, np.ones(ITERATIONS) / ITERATIONS, mode="valid")
    level = float(means[len(means) // 2]) + 1e-9  # sums of another order may differ by less
    want = ITERATIONS + int(np.argmax(means <= level))
    assert want < len(log)
    config = toy_config(
        tmp_path / "part", samples=24 * 1024, until=f"metrics/final_distance<={level!r}"
    )
    summary = train(config, environment=toy_env)
    assert (summary.stopped_by, summary.iterations) == ("until", want)


def test_a_column_that_the_log_does_not_have_is_named(tmp_path, capsys):
    args = ["high_jump", "--out", str(tmp_path), "--worlds", "2", "--ppo.steps", "4"]
    assert main([*args, "--ppo.hidden", "8", "--until", "metrics/speed>=3"]) == 2
    told = capsys.readouterr().err
    assert "there is no metrics/speed in this log; it has: " in told and "metrics/success" in told
