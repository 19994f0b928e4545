"""A javelin throw that must go far with noise, too."""

from pathlib import Path

import numpy as np
import pytest

from warmstart import robust_javelin
from warmstart.javelin_throw import UNITS, size_of
from warmstart.other_worlds import Other
from warmstart.performance import numbers_near
from warmstart.robust_javelin import WORST, Crowd, Search, main, search

SHIPPED = Path(__file__).parents[2] / "warmstart" / "data" / "throws" / "javelin_paper.npz"


@pytest.fixture(scope="module")
def numbers() -> np.ndarray:
    found = numbers_near(SHIPPED, len(UNITS))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def crowd() -> Crowd:
    return Crowd("paper", 3, threads=2)


def test_without_noise_a_copy_in_the_worlds_of_the_task_is_the_throw_itself(monkeypatch, numbers):
    for name, value in (("COPIES", (Other(),)), ("NOISE", 0.0), ("START_NOISE", 0.0)):
        monkeypatch.setattr(robust_javelin, name, value)
    own = Crowd("paper", 3, threads=2)
    asked = np.stack([numbers, 0.5 * numbers])
    thrower = own.thrower
    (flown,) = own.fly(asked, seed=0)
    for row, far in zip(asked, flown.far):
        thrower.judge(row[None])
        alone = thrower.fly(
            thrower.worlds, thrower.targets(row, 30)[None], thrower.scene.default_qpos()
        )
        assert alone.far[0] == pytest.approx(far, abs=1e-9)
    expected = (1.0 + WORST) * (2.0 * flown.wrong - flown.far + 0.2 * flown.aside)
    got = own.judge(asked, seed=0, strict=2.0)
    np.testing.assert_allclose(got, expected + size_of(asked), rtol=1e-12)


def test_all_candidates_of_a_round_meet_the_same_noise_and_rounds_meet_others(crowd, numbers):
    same = crowd.judge(np.stack([numbers] * 3), seed=1, strict=1.0)
    assert np.ptp(same) < 1e-9
    other = crowd.judge(np.stack([numbers] * 3), seed=2, strict=1.0)
    assert abs(other[0] - same[0]) > 1e-3
    assert np.array_equal(crowd.judge(np.stack([numbers] * 3), seed=1, strict=1.0), same)


def test_the_shipped_throw_goes_far_with_noise_and_in_firm_hands(crowd, numbers):
    copies = crowd.fly(numbers[None], seed=3)
    assert len(copies) == 3
    assert all(copy.far[0] > 15.0 for copy in copies)


def test_a_search_gives_the_throw_of_its_middle(numbers):
    told: list[tuple[int, float]] = []
    clip = search(
        "paper",
        numbers,
        Search(candidates=6, rounds=1, spread=0.01),
        threads=2,
        progress=lambda done, cost: told.append((done, cost)),
    )
    assert [done for done, _ in told] == [1]
    assert told[0][1] < 0.0
    assert clip.meta["achieved"]["success"] == 1.0
    assert len(clip.meta["numbers"]) == len(UNITS)


def test_a_clip_of_something_else_is_refused(tmp_path, capsys):
    other = SHIPPED.parents[1] / "free_throw_1.2m_human.npz"
    assert main(["--near", str(other), "--out", str(tmp_path / "x.npz")]) == 2
    assert "not a clip of this command" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
