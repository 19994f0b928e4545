import dataclasses

import numpy as np
import pytest

from rl.likeness_features import (
    BANDS,
    LEAST,
    PROJECTIONS,
    SIZE,
    channels,
    projection,
    shown_joints,
    window_features,
)
from rl.likeness_motion import from_clip
from rl.likeness_terms import WINDOW
from sports.humanoid.body import load_body
from tests.rl.motions_still import lifted, slid, standing, swinging
from warmstart.bank import demonstration_files
from warmstart.clip import Clip
from warmstart.library import FPS


def kick() -> Clip:
    return Clip.load(demonstration_files("penalty_kick")[0])


def test_where_and_which_way_do_not_matter() -> None:
    here = window_features(from_clip(kick(), "kick"))
    there = window_features(from_clip(kick().moved(3.0, -2.0, 2.4), "kick"))
    assert here.shape[1] == SIZE and len(here) >= 1
    np.testing.assert_allclose(here, there, atol=1e-4)


def test_a_film_that_runs_backwards_has_the_same_energies_and_another_shape() -> None:
    motion = from_clip(kick(), "kick")
    rows = motion.qpos[:WINDOW]
    once = window_features(dataclasses.replace(motion, qpos=rows))
    back = window_features(dataclasses.replace(motion, qpos=rows[::-1].copy()))
    np.testing.assert_allclose(once[:, PROJECTIONS:], back[:, PROJECTIONS:], atol=1e-2)
    assert np.abs(once[:, :PROJECTIONS] - back[:, :PROJECTIONS]).max() > 0.3


def test_jitter_shows_in_its_band_with_its_energy() -> None:
    hertz, amplitude = 10.0, 0.01
    still = window_features(standing(61))
    shaken = window_features(swinging(standing(61), amplitude, hertz, ("L_Knee_y", "R_Knee_y")))
    spins = slice(PROJECTIONS, PROJECTIONS + len(BANDS))
    np.testing.assert_allclose(still[:, spins], np.log10(LEAST[0]), atol=1e-6)
    # Mean square of a central difference of the sine, in two of all the joints' components.
    rate = amplitude * np.sin(2 * np.pi * hertz / FPS) * FPS
    energy = 2 * rate**2 / 2 / (3 * len(shown_joints(load_body("smpl"))))
    found = 10 ** shaken[:, spins] - LEAST[0]
    assert found[:, 3] == pytest.approx(energy, rel=0.2)
    assert (found[:, 3] > 0.8 * found.sum(1)).all()


def test_a_lifted_and_a_running_athlete_differ_by_height_and_speed_alone() -> None:
    sway = swinging(standing(61), 0.4, 1.0, ("L_Shoulder_x",))
    for changed, family in ((lifted(sway, 0.2), "height"), (slid(sway, 3.0), "velocity")):
        before, after = channels(sway)[0], channels(changed)[0]
        for name in before:
            assert np.allclose(before[name], after[name], atol=1e-6) == (name != family), name


def test_projection_is_of_signs_and_keeps_lengths_in_the_mean() -> None:
    rows = projection(800)
    assert rows.shape == (PROJECTIONS, 800) and set(np.unique(rows)) == {-1.0, 1.0}
    np.testing.assert_array_equal(rows[:, :100], projection(100))
    x = np.random.default_rng(0).normal(size=(200, 800))
    ratio = ((x @ rows.T) ** 2).sum(1) / (PROJECTIONS * (x**2).sum(1))
    assert ratio.mean() == pytest.approx(1.0, abs=0.1)


def test_both_bodies_have_the_same_channels() -> None:
    names = []
    for body in map(load_body, ("smpl", "smplx")):
        names.append([body.link_names[i] for i in shown_joints(body)])
        qpos = np.zeros((WINDOW, 7 + body.num_dofs))
        qpos[:, 3] = 1.0
        still = dataclasses.replace(standing(), body=body.name, qpos=qpos)
        assert window_features(still).shape == (1, SIZE)
    assert names[0] == names[1] and len(names[0]) == 21


def test_what_is_shorter_than_a_second_has_no_window() -> None:
    assert window_features(standing(WINDOW - 1)).shape == (0, SIZE)
    assert window_features(standing(WINDOW)).shape == (1, SIZE)
