import numpy as np
import pytest
import scipy.linalg

from rl.two_sample import classifier_accuracy, frechet, frechet_of_moments


def groups(count: int, each: int) -> list[str]:
    return [f"g{i}" for i in range(count) for _ in range(each)]


def test_distance_of_normals_of_diagonal_covariance_is_that_of_their_axes() -> None:
    mean, a, b = np.array([3.0, -4.0]), np.array([4.0, 9.0]), np.array([1.0, 16.0])
    want = 25.0 + (2.0 - 1.0) ** 2 + (3.0 - 4.0) ** 2
    found = frechet_of_moments(mean, np.diag(a), np.zeros(2), np.diag(b))
    assert found == pytest.approx(want)
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s], [s, c]])
    turned = [turn @ np.diag(x) @ turn.T for x in (a, b)]
    assert frechet_of_moments(turn @ mean, turned[0], np.zeros(2), turned[1]) == pytest.approx(want)


def test_distance_agrees_with_scipys_square_root() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(80, 6)) @ rng.normal(size=(6, 6)), rng.normal(size=(50, 6)) + 1.0
    ca, cb = np.cov(a.T), np.cov(b.T)
    root = np.real(scipy.linalg.sqrtm(ca @ cb))
    want = ((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(ca + cb - 2 * root)
    assert frechet(a, b) == pytest.approx(want, rel=1e-6)
    assert frechet(b, a) == pytest.approx(want, rel=1e-6)


def test_distance_of_a_shifted_sample_is_the_shift_squared() -> None:
    a = np.random.default_rng(1).normal(size=(20, 32))  # fewer windows than features
    assert frechet(a, a) == pytest.approx(0.0, abs=1e-6)
    assert frechet(a, a + 0.5) == pytest.approx(32 * 0.25, rel=1e-6)
    with pytest.raises(ValueError, match="two windows"):
        frechet(a[:1], a)


def test_classifier_tells_nothing_from_two_draws_of_one_law() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(300, 8)), rng.normal(size=(300, 8))
    found = classifier_accuracy(a, groups(30, 10), b, groups(30, 10))
    assert found == pytest.approx(0.5, abs=0.08)


def test_classifier_tells_a_shift_and_also_a_spread() -> None:
    rng = np.random.default_rng(3)
    a = rng.normal(size=(200, 8))
    far = rng.normal(size=(200, 8)) + 2.0
    wide = 4.0 * rng.normal(size=(200, 8))
    assert classifier_accuracy(a, groups(20, 10), far, groups(20, 10)) > 0.98
    assert classifier_accuracy(a, groups(20, 10), wide, groups(20, 10)) > 0.85


def test_windows_of_one_clip_are_never_on_both_sides_of_a_fold() -> None:
    # Windows of a clip are all the same and clips are drawn from one law: who saw a clip could
    # name its side at once, who did not can only guess.
    rng = np.random.default_rng(4)
    a, b = (np.repeat(rng.normal(size=(40, 8)), 10, axis=0) for _ in range(2))
    found = classifier_accuracy(a, groups(40, 10), b, groups(40, 10))
    assert found == pytest.approx(0.5, abs=0.15)


def test_a_few_windows_weigh_as_much_as_many() -> None:
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(500, 8)), rng.normal(size=(30, 8))
    assert classifier_accuracy(a, groups(50, 10), b, groups(10, 3)) == pytest.approx(0.5, abs=0.15)
    assert np.isnan(classifier_accuracy(a, groups(50, 10), b, ["one"] * 30))
