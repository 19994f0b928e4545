"""Ratings against closed forms and simulated players of known strength."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rl.elo import difference, expected, fit, performance, score
from rl.league import FROZEN_SHARE, MOST_GAMES, WINDOW, League


def test_the_logistic_law():
    """400 points are 10 to 1; the inverse is exact; sides are symmetric."""
    assert expected(0.0) == 0.5
    assert expected(400.0) == pytest.approx(10.0 / 11.0, rel=1e-12)
    for d in (-700.0, -35.0, 0.0, 120.0):
        assert difference(expected(d)) == pytest.approx(d, abs=1e-9)
        assert expected(d) + expected(-d) == pytest.approx(1.0, rel=1e-12)
    assert difference(0.0) == -math.inf and difference(1.0) == math.inf


@pytest.mark.parametrize(
    ("wins", "draws", "losses"), [(40, 0, 60), (20, 40, 40), (3, 0, 1), (0, 0, 9)]
)
def test_the_interval_is_wilsons(wins, draws, losses):
    """At its ends the score found is 1.96 standard deviations away (Wilson 1927)."""
    found, n = score(wins, draws, losses), wins + draws + losses
    assert found.mean == (wins + draws / 2) / n
    for end in (found.low, found.high):
        away = 1.959964 * math.sqrt(end * (1.0 - end) / n)
        assert abs(end - found.mean) == pytest.approx(away, rel=1e-5, abs=1e-12)
    assert found.low <= found.mean < found.high
    other = score(losses, draws, wins)
    assert (other.low, other.high) == pytest.approx((1.0 - found.high, 1.0 - found.low))


def test_who_won_everything_is_better_by_a_finite_margin_at_least():
    everything = score(10, 0, 0).elo
    assert everything[0] == everything[2] == math.inf and math.isfinite(everything[1])
    with pytest.raises(ValueError, match="no games"):
        score(0, 0, 0)


@pytest.mark.parametrize("true", [-250.0, 0.0, 120.0])
def test_intervals_hold_the_true_difference_as_often_as_they_say(true):
    rng = np.random.default_rng(7)
    wins = rng.binomial(200, expected(true), size=400)
    held = [
        low <= true <= high for _, low, high in (score(int(w), 0, int(200 - w)).elo for w in wins)
    ]
    # 95 % of 400 and four standard deviations of that count.
    assert 0.95 - 4 * math.sqrt(0.95 * 0.05 / 400) <= np.mean(held) <= 1.0


def test_a_round_robin_recovers_the_strengths_it_was_drawn_from():
    true = np.array([0.0, 150.0, -90.0, 310.0])
    rng = np.random.default_rng(3)
    games = np.full((4, 4), 3000.0) - 3000.0 * np.eye(4)
    scores = np.zeros((4, 4))
    for i in range(4):
        for j in range(i + 1, 4):
            scores[i, j] = rng.binomial(3000, expected(true[i] - true[j]))
            scores[j, i] = 3000 - scores[i, j]
    ratings, half = fit(scores, games)
    assert ratings[0] == half[0] == 0.0
    assert (np.abs(ratings - true)[1:] < 1.6 * half[1:]).all() and half.max() < 20.0
    # Names do not matter: the same players in another order, all relative to the first one.
    order = [2, 0, 3, 1]
    turned, _ = fit(scores[np.ix_(order, order)], games[np.ix_(order, order)])
    np.testing.assert_allclose(turned, ratings[order] - ratings[2], atol=1e-6)


def test_two_players_have_a_closed_form():
    """One drawn game is added; the interval is 1.96 / (rate sqrt(n p (1 - p)))."""
    ratings, half = fit(
        np.array([[0.0, 30.0], [70.0, 0.0]]), np.array([[0.0, 100.0], [100.0, 0.0]])
    )
    p = 70.5 / 101
    assert ratings[1] == pytest.approx(difference(p), abs=1e-6)
    rate = math.log(10) / 400
    assert half[1] == pytest.approx(1.959964 / (rate * math.sqrt(101 * p * (1 - p))), rel=1e-5)
    with pytest.raises(ValueError, match="do not connect"):
        fit(np.zeros((2, 2)), np.zeros((2, 2)))


@pytest.mark.parametrize(("won", "rating"), [(10, -60.0), (0, 35.0), (100, 200.0)])
def test_performance_against_one_opponent_has_a_closed_form(won, rating):
    found = performance([won, 0.0], [100, 0], [rating, 1e6])  # nobody met the other one
    assert found == pytest.approx(rating + difference((won + 0.5) / 101), abs=1e-6)


def test_performance_against_several_is_the_strength_that_played():
    rng, true, ratings = np.random.default_rng(5), 130.0, [0.0, 90.0, 310.0]
    scores = [float(rng.binomial(4000, expected(true - r))) for r in ratings]
    assert performance(scores, [4000.0] * 3, ratings) == pytest.approx(true, abs=10.0)
    with pytest.raises(ValueError, match="no games"):
        performance([0.0], [0.0], [0.0])


def played(league: League, strength: float, strengths: list[float], games: int, rng) -> list:
    """(slots, 3) results of a policy of a strength against entries of known strengths."""
    counts = []
    for entry in league.slots:
        wins = int(rng.binomial(games, expected(strength - strengths[entry])))
        counts.append([wins, 0, games - wins])
    return counts


@pytest.mark.parametrize("true", [-80.0, 200.0])
def test_the_rating_on_the_fly_finds_a_known_strength(true):
    """Against a ladder of one at 0; the mean of the last ratings, K 0.5."""
    league, rng, seen = League(4, 0.5), np.random.default_rng(11), []
    league.enter("ladder", 0)
    for _ in range(600):
        league.record(played(league, true, [0.0], 8, rng))
        seen.append(league.rating)
    assert league.entries[0].rating == 0.0  # the yardstick does not move
    assert np.mean(seen[200:]) == pytest.approx(true, abs=12.0)


def test_what_ratings_gain_and_lose():
    """K times games, 32 of an entry at most, times the surprise; the pool at a tenth."""
    league = League(2, 0.5)
    league.enter("ladder", 0)
    assert league.enter("pool", 10) == [1]
    league.record([[0, 0, 0], [6, 2, 0]])
    assert league.rating == pytest.approx(0.5 * 8 * (7 / 8 - 0.5))
    assert league.entries[1].rating == pytest.approx(-FROZEN_SHARE * league.rating)
    assert league.score("pool") == (7 / 8, 8.0) and league.score("ladder") == (None, 0.0)
    before = league.rating
    league.record([[1000, 0, 0], [0, 0, 0]])
    assert league.rating - before == pytest.approx(
        0.5 * MOST_GAMES * (1.0 - expected(before)), rel=1e-9
    )
    league.record([[0, 0, 0], [0, 0, 3 * WINDOW]])
    assert league.score("pool")[0] == 0.0  # as many games as are remembered: older ones are gone


def test_the_weakest_of_the_pool_makes_room_and_the_ladder_stays():
    league = League(4, 0.5)
    assert league.enter("ladder", 0) == [0, 1, 2, 3]
    for samples, rating in ((1, 50.0), (2, 20.0)):
        league.rating = rating
        league.enter("pool", samples)
    league.rating = -10.0
    league.enter("ladder", 3)
    assert sorted(league.slots) == [0, 1, 2, 3]
    league.rating = 90.0
    slot = league.enter("pool", 4)
    assert [(e.kind, e.samples) for e in league.entries] == [
        ("ladder", 0),
        ("pool", 1),
        ("ladder", 3),
        ("pool", 4),
    ]
    assert league.slots[slot[0]] == 3 and sorted(league.slots) == [0, 1, 2, 3]
    again = League(4, 0.5)
    again.load(league.state())
    assert again.state() == league.state()
    with pytest.raises(ValueError, match="slots"):
        League(3, 0.5).load(league.state())
