"""The cross-entropy method on functions with known answers."""

from __future__ import annotations

import numpy as np
import pytest

from warmstart.cross_entropy import CrossEntropy


def test_the_search_finds_the_bottom_of_a_bowl():
    """Of a quadratic with axes of different lengths, hidden away from the start."""
    bottom = np.array([1.0, -0.5, 0.3, 2.0])
    stretch = np.array([1.0, 3.0, 0.5, 1.0])
    search = CrossEntropy(4, 32, seed=1)
    for _ in range(60):
        search.tell(((stretch * (search.ask() - bottom)) ** 2).sum(1))
    np.testing.assert_allclose(search.best, bottom, atol=0.05)
    assert search.least < 0.01
    again = CrossEntropy(4, 32, near=bottom)
    np.testing.assert_array_equal(again.ask()[:2], [bottom, bottom])


def test_a_lucky_round_does_not_stay_where_costs_are_noisy():
    """A cost that no candidate can earn again: the exact search keeps its candidate, the noisy one
    asks for the middle. Both spread as they are told to."""
    for noisy in (False, True):
        search = CrossEntropy(3, 2000, seed=2, spread=2.0, noisy=noisy)
        asked = search.ask().copy()
        assert asked[2:].std(0) == pytest.approx([2.0] * 3, rel=0.1)
        cost = (asked**2).sum(1)
        cost[7] = -1e9
        search.tell(cost)
        again = search.ask()
        np.testing.assert_array_equal(again[0], again[1] if noisy else asked[7])
        assert np.array_equal(again[1], asked[7]) is False
