"""A javelin throw that must go far with noise, too."""

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sports.humanoid.mjcf import body_name, build_model
from warmstart import javelin_throw, robust_javelin
from warmstart.clip import Clip
from warmstart.javelin_throw import (
    ALIGNED,
    ATTACK,
    BASE,
    BUMPED,
    BUMPS,
    OVER_ARM,
    UNITS,
    WATCHED,
    Flown,
    size_of,
    throw,
)
from warmstart.other_worlds import Other
from warmstart.performance import numbers_near
from warmstart.robust_javelin import WORST, Crowd, Search, main, search
from warmstart.tracking import Worlds

SHIPPED = Path(__file__).parents[2] / "warmstart" / "data" / "throws" / "javelin_paper.npz"


@pytest.fixture(scope="module")
def numbers() -> np.ndarray:
    found = numbers_near(SHIPPED, len(UNITS))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def crowd() -> Crowd:
    return Crowd("paper", 2, threads=2)


def test_without_noise_a_copy_in_the_worlds_of_the_task_is_the_throw_itself(monkeypatch, numbers):
    for name, value in (("COPIES", (Other(),)), ("NOISE", 0.0), ("START_NOISE", 0.0)):
        monkeypatch.setattr(robust_javelin, name, value)
    own = Crowd("paper", 2, threads=2)
    asked = np.stack([numbers, 0.5 * numbers])
    thrower = own.thrower
    (flown,) = own.fly(asked, seed=0)
    worlds = Worlds(thrower.scene, 1, 1)
    for row, far in zip(asked, flown.far):
        alone = thrower.fly(worlds, thrower.targets(row, 30)[None], thrower.scene.default_qpos())
        assert alone.far[0] == pytest.approx(far, abs=1e-9)
    free = 0.5 * (2.0 + math.tan(math.asin(2.0 / 8.0)) * np.maximum(flown.far, 0.0))
    wide = 0.1 * flown.aside + 1.5 * np.maximum(flown.aside - free, 0.0)
    expected = (1.0 + WORST) * (2.0 * flown.wrong - flown.far + wide)
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
    assert len(copies) == len(robust_javelin.COPIES)
    assert all(copy.far[0] > 15.0 for copy in copies)


def test_from_half_way_to_the_edge_of_the_sector_on_every_metre_aside_costs_more():
    """At 30 m the sector reaches 2 + 30 tan(asin(2 / 8)) = 9.75 m to either side."""
    aside = np.array([0.0, 4.0, 4.87, 5.87, 9.0])
    zero = np.zeros(5)
    cost = Flown(zero + 30.0, zero, aside).cost()
    np.testing.assert_allclose(cost[:3], 0.1 * aside[:3] - 30.0, atol=1e-9)
    np.testing.assert_allclose(np.diff(cost[2:]), [1.6, 1.6 * 3.13], atol=0.01)
    assert math.isnan(Flown(zero + math.nan, zero, aside).cost()[0])


def test_a_slung_throw_costs_what_it_goes_too_far(crowd, numbers, monkeypatch):
    """The hand's lowest height before the release, by the kinematics of the frames of the throw
    that the task played, is what the cost knows of it."""
    thrower = crowd.thrower
    start = thrower.scene.default_qpos()
    worlds = Worlds(thrower.scene, 1, 1)
    # The arm bent down in the last 0.3 s.
    slung = numbers.copy()
    bumps = slung[len(BASE) :].reshape(len(BUMPS), len(BUMPED))
    bumps[2:, [names[0] for names in BUMPED].index("R_Shoulder_x")] += 8.0
    clip = throw(thrower, slung)
    model = build_model(thrower.scene, sensors=False)
    data = mujoco.MjData(model)
    wrist, shoulder = (model.body(body_name(0, k)).id for k in ("R_Wrist", "R_Shoulder"))
    heights = []
    last = round(clip.meta["events"]["release"] * clip.fps)
    for qpos in clip.qpos[last - 4 : last + 1]:
        data.qpos[: len(qpos)] = qpos
        mujoco.mj_kinematics(model, data)
        palm = data.xpos[wrist] + data.xmat[wrist].reshape(3, 3) @ thrower.palm
        heights.append(palm[2] - data.xpos[shoulder, 2])
    low = -min(heights) - OVER_ARM
    assert low > 0.05
    ctrl = thrower.targets(slung, WATCHED)[None]
    cost = thrower.fly(worlds, ctrl, start).wrong[0]
    monkeypatch.setattr(javelin_throw, "SLUNG", 0.0)
    assert cost - thrower.fly(worlds, ctrl, start).wrong[0] >= 30.0 * low - 1e-6


def test_a_nose_off_the_path_costs_what_it_is_off(crowd, numbers, monkeypatch):
    """By the frame of the throw in which the task saw the release."""
    thrower = crowd.thrower
    clip = throw(thrower, numbers)
    frame = round(clip.meta["events"]["release"] * clip.fps)
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, clip.object_qpos[frame].reshape(-1)[3:7])
    speed = clip.object_qvel[frame].reshape(-1)[:3]
    off = np.arccos(turned.reshape(3, 3)[:, 0] @ speed / np.linalg.norm(speed))
    worlds, start = Worlds(thrower.scene, 1, 1), thrower.scene.default_qpos()
    ctrl = thrower.targets(numbers, WATCHED)[None]
    cost = thrower.fly(worlds, ctrl, start).wrong[0]
    monkeypatch.setattr(javelin_throw, "ATTACK", 0.0)
    charged = cost - thrower.fly(worlds, ctrl, start).wrong[0]
    assert off > 2 * ALIGNED
    np.testing.assert_allclose(charged, ATTACK * (off - ALIGNED), rtol=1e-3)


def test_a_search_gives_the_throw_of_its_middle_and_goes_on_from_it(numbers, tmp_path, capsys):
    told: list[tuple[int, float, bool]] = []
    settings = Search(candidates=4, rounds=2, spread=0.01, kept_every=1)
    clip = search(
        "paper",
        numbers,
        settings,
        threads=2,
        progress=lambda done, cost, clip: told.append((done, cost, clip is not None)),
    )
    assert [(done, kept) for done, _, kept in told] == [(1, True), (2, True)]
    assert told[0][1] < 0.0
    assert clip.meta["achieved"]["success"] == 1.0
    assert len(clip.meta["numbers"]) == len(UNITS)
    again = search("paper", numbers, settings, threads=1)
    assert again.meta["numbers"] == clip.meta["numbers"]
    near, out = tmp_path / "near.npz", tmp_path / "out.npz"
    clip.save(near)
    few = ["--rounds", "1", "--candidates", "4", "--spread", "0.001"]
    assert main(["--near", str(near), "--out", str(out), *few]) == 0
    assert "round 1:" in capsys.readouterr().out
    moved = np.abs(np.array(Clip.load(out).meta["numbers"]) - clip.meta["numbers"])
    assert 0.0 < moved.max() < 0.1


def test_a_clip_of_something_else_is_refused(tmp_path, capsys):
    other = SHIPPED.parents[1] / "free_throw_1.2m_human.npz"
    for near, words in ((other, "not a clip of this command"), (tmp_path / "none.npz", "none.npz")):
        assert main(["--near", str(near), "--out", str(tmp_path / "x.npz")]) == 2
        assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
