"""Frequencies of starts against closed forms, failure rates against a plain loop."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rl.clip_sampling import ClipSampling
from tests.rl.motions_made import tables
from tests.warmstart.clips_made import random_clip


def sampling(**options) -> ClipSampling:
    # 40 frames: starts in 0..38 in bins of 15, 15, 9; 20 frames: 41..59 in bins of 15, 4.
    return ClipSampling(tables(random_clip(0, 40), random_clip(1, 20)), **options)


def test_bins_are_half_seconds_of_each_clip():
    s = sampling()
    assert s.first.tolist() == [0, 15, 30, 41, 56]
    assert s.count.tolist() == [15, 15, 9, 15, 4]
    assert s.following.tolist() == [1, 2, 2, 4, 4]
    bins = [0] * 15 + [1] * 15 + [2] * 11 + [3] * 15 + [4] * 6
    assert s.bin_of.tolist() == bins * 2


def test_starts_come_as_often_as_failures_say():
    s = sampling(uniform=0.3, mirror=False)
    s.failure.zero_()
    s.failure[1] = 0.8
    count, least = np.array([15, 15, 9, 15, 4]), 1e-3
    weight = count * np.array([0.4, 0.4, least, least, least])
    expected = 0.3 * count / count.sum() + 0.7 * weight / weight.sum()
    np.testing.assert_allclose(s.probabilities().numpy(), expected, rtol=1e-12)
    number = 200_000
    frames = s.draw(number, torch.Generator().manual_seed(0))
    seen = np.bincount(s.bin_of[frames].numpy(), minlength=5)
    spread = np.sqrt(number * expected * (1 - expected))
    assert (np.abs(seen - number * expected) < 5 * spread).all()
    # Within a bin all frames alike, the last frame of a clip and the one behind it never.
    each = np.bincount(frames.numpy(), minlength=62)
    assert each[[39, 40, 60, 61]].sum() == 0
    share = np.repeat(expected / count, count)
    each = np.delete(each, [39, 40, 60, 61])
    assert (np.abs(each - number * share) < 5 * np.sqrt(number * share) + 1).all()


def test_without_knowledge_or_failures_starts_are_uniform():
    s = sampling(uniform=0.2)
    even = np.array([15, 15, 9, 15, 4]) / 58
    np.testing.assert_allclose(s.probabilities().numpy(), even)
    s.failure.zero_()
    np.testing.assert_allclose(s.probabilities().numpy(), even)
    s.failure[4] = 1.0
    assert (s.probabilities().numpy() >= 0.2 * even).all()


def test_half_of_the_starts_are_mirrored():
    s = sampling()
    frames = s.draw(100_000, torch.Generator().manual_seed(1))
    share = float((frames >= s.num_frames).float().mean())
    assert abs(share - 0.5) < 5 * 0.5 / np.sqrt(100_000)
    assert int(frames.max()) < 2 * s.num_frames
    plain = sampling(mirror=False).draw(1000, torch.Generator().manual_seed(1))
    assert int(plain.max()) < s.num_frames


def test_failure_rates_follow_each_visit():
    s = sampling(rate=0.1)
    rng = np.random.default_rng(0)
    expected = np.ones(5)
    for _ in range(50):
        frame = rng.integers(0, 124, 16)
        outcome = rng.integers(0, 3, 16)  # 0 still on its way, 1 passed, 2 failed
        s.update(torch.tensor(frame), torch.tensor(outcome == 2), torch.tensor(outcome == 1))
        for b in range(5):
            visits = [o == 2 for f, o in zip(frame, outcome) if o and int(s.bin_of[f]) == b]
            for _ in visits:  # each pulls a tenth towards the mean of the step's visits
                expected[b] += 0.1 * (np.mean(visits) - expected[b])
    np.testing.assert_allclose(s.failure.numpy(), expected, rtol=1e-9)


def test_mistakes_are_told():
    with pytest.raises(ValueError, match="uniform and rate"):
        sampling(uniform=1.5)
    with pytest.raises(ValueError, match="shorter than a frame"):
        sampling(bin_seconds=0.01)
