"""The hurdling problem: a coarse solution against independent geometry, its mirror, its rules."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from rl.config import load_starts
from sports import hurdling as task
from sports.env import make_env
from sports.humanoid.body import load_body
from tests.warmstart.hurdle_gap import gap_to_hurdle
from warmstart import rotation
from warmstart.bank import demonstration_files, load_demonstrations
from warmstart.clip import Clip
from warmstart.outcome import OUTCOMES, cleared_hurdle, link_poses
from warmstart.problems import Infeasible, hurdling, jumper
from warmstart.solution import Solution

BODY = load_body("smpl")
COARSE = hurdling.Config(detail=0.5, cycle=False)


@pytest.fixture(scope="module")
def stride() -> Solution:
    """A coarse stride over a hurdle of 1.067 m, solved from nothing."""
    solution = hurdling.solve(COARSE)
    print(jumper.shown(solution))
    return solution


def finer(solution: Solution) -> np.ndarray:
    """Five times as many times as the optimiser had."""
    k = np.arange(5 * (len(solution.times) - 1) + 1) / 5
    return np.interp(k, np.arange(len(solution.times)), solution.times)


def test_every_point_of_the_athlete_is_clear_of_the_hurdle(stride):
    """At five times finer times, by another computation than the program's and the gate's."""
    qpos = stride.sample(finer(stride))["qpos"]
    gap = gap_to_hurdle(stride.body, qpos, stride.asked["hurdle_height"])
    print(f"least distance {gap.min():.4f} m")
    assert gap.min() > 0.0
    # The hurdle is lower than the athlete's own legs are long: it went over it, not past it.
    assert stride.qpos[0, 0] < task.FIRST_X - 1.0 and stride.qpos[-1, 0] > task.FIRST_X + 0.5
    assert np.abs(stride.qpos[:, 1]).max() < 0.35
    cleared = cleared_hurdle(stride.body, finer(stride), qpos)
    raised = gap_to_hurdle(stride.body, qpos, cleared + 0.004)
    assert gap_to_hurdle(stride.body, qpos, cleared).min() > 0.0 > raised.min()


def test_speed_is_the_asked_one_before_and_kept_after(stride):
    """Of the centre of mass, from finite differences of link positions."""
    body = stride.body
    for t, low, high in ((0.0, -0.06, 0.06), (stride.duration - 1e-4, -0.41, 0.41)):
        pos, quat = link_poses(body, stride.sample(np.array([t, t + 1e-4]))["qpos"])
        com = np.zeros((2, 3))
        for i, link in enumerate(body.links):
            for shape in link.shapes:
                middle = np.array([shape.center, shape.end or shape.center]).mean(0)
                com += (
                    shape.mass
                    / body.mass
                    * (pos[:, i] + rotation.rotate(quat[:, i], middle[None].repeat(2, 0)))
                )
        speed = (com[1] - com[0]) / 1e-4
        assert low < speed[0] - stride.asked["run_speed"] < high
    assert stride.stats["max_violation"] < 1e-5


@pytest.mark.slow
def test_the_mirrored_problem_costs_the_same(stride):
    """The left leg leads, solved from nothing. The problem has several optima, and rounding decides
    which one a coarse solve finds: mirrored motions were 1.7 cm apart (cost 1.035 of the other's),
    and 13 cm (1.076) after the terms of the objective had been written in another order."""
    other = hurdling.solve(replace(COARSE, lead="left"))
    cost = other.stats["objective"] / stride.stats["objective"]
    share = np.linspace(0.0, 1.0, 41)
    rows = []
    for solution, mirror in ((stride, True), (other, False)):
        motion = solution.sample(share * solution.duration)
        clip = Clip(60.0, "smpl", motion["qpos"], motion["qvel"])
        rows.append(link_poses(BODY, (clip.mirrored() if mirror else clip).qpos)[0])
    far = np.linalg.norm(rows[0] - rows[1], axis=2)
    print(f"cost {cost:.3f} of the other's, links {far.mean():.3f} m apart")
    assert 0.9 < cost < 1.1
    assert other.duration == pytest.approx(stride.duration, rel=0.05)
    assert far.mean() < 0.2
    assert {link for link, _ in other.contact_points} == {"R_Ankle", "R_Toe"}


def test_impossible_options_are_one_sentence():
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"hurdle_height": 2.0}, r"hurdle_height must lie between 0\.3 and 1\.2 m, not 2\.0"),
        ({"run_speed": 15.0}, r"run_speed must lie between 3 and 10 m/s, not 15"),
        ({"speed_loss": 0.0}, "speed_loss must lie between"),
        ({"clearance": -0.1}, "clearance must lie between"),
        ({"lead": "both"}, "lead must be right or left, not both"),
        ({"detail": 9.0}, "detail must lie between"),
    )
    for wrong, words in cases:
        with pytest.raises(ValueError, match=words) as found:
            hurdling.Config(**wrong)
        assert "\n" not in str(found.value)


@pytest.mark.slow
def test_a_hurdle_at_a_creep_is_infeasible_and_says_why():
    config = hurdling.Config(
        hurdle_height=1.2,
        run_speed=3.0,
        speed_loss=0.05,
        cycle=False,
        detail=0.3,
        max_iterations=60,
    )
    with pytest.raises(Infeasible, match=r"a hurdle of 1\.2 m at 3 m/s.*('.+' is not met| %)"):
        hurdling.solve(config)


def hop(feet: str, height: float = 0.5, x: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Straight legs carried over the hurdle with the soles at ``height``: the first frame on the
    foot ``feet[0]``, the last on ``feet[1]``, the other knee bent around it; ``B`` bends none."""
    t = np.linspace(0.0, 0.6, 61)
    qpos = np.zeros((61, 7 + BODY.num_dofs))
    qpos[:, 0] = task.FIRST_X + x + 2.0 * (t / 0.6 - 0.5)
    qpos[:, 2] = BODY.standing_height(0.0) + height * (1 - np.abs(t / 0.3 - 1) ** 8)
    qpos[:, 3] = 1.0
    for rows, foot in ((slice(12), feet[0]), (slice(-12, None), feet[1])):
        for other in set("LR") - set(foot) if foot != "B" else ():
            qpos[rows, 7 + BODY.dof_index(f"{other}_Knee_y")] = 1.0
    return t, qpos


def test_hand_made_strides_are_measured_and_ruled():
    """Soles carried over at 0.5 m clear 0.5 m, from one foot to the other and not otherwise."""
    for feet in ("LR", "RL"):
        assert cleared_hurdle(BODY, *hop(feet)) == pytest.approx(0.5, abs=0.004)
    for feet in ("LL", "RR", "BR", "LB"):
        assert np.isnan(cleared_hurdle(BODY, *hop(feet)))
    assert np.isnan(cleared_hurdle(BODY, *hop("LR", x=3.0)))  # never crosses it
    judge, asked = OUTCOMES["hurdling"].judge, {"hurdle_height": 0.45, "run_speed": 2.0 / 0.6}
    assert judge is not None
    t, qpos = hop("LR")
    t, qpos = np.append(t, 0.61), np.append(qpos, qpos[-1:], axis=0)
    found = judge(BODY, t, qpos, asked)
    assert found["success"] == 1.0
    assert found["clearance"] == pytest.approx(0.05, abs=2e-3)
    assert found["landing_speed"] == pytest.approx(2.0 / 0.6, abs=0.05)
    assert judge(BODY, t, qpos, asked | {"hurdle_height": 0.55})["success"] == 0.0
    assert judge(BODY, t, qpos, asked | {"run_speed": 5.0})["success"] == 0.0
    lying = qpos.copy()
    lying[-1, 2] = 0.1
    assert judge(BODY, t, lying, asked)["success"] == 0.0


def test_training_starts_from_its_frames_among_hurdles_of_its_height():
    """As ``train hurdling --clips`` has it: ten hurdles of the label's height, the athlete before
    or over the first of them, and no episode over at its first step."""
    files = demonstration_files("hurdling")
    labels = {Clip.load(f).meta["achieved"]["hurdle_height"] for f in files}
    assert 1.067 in labels
    env = make_env("hurdling", num_worlds=64, training=True, starts=load_starts(tuple(files), 1.0))
    tops = env.physics.mocap_pos[:, :, 2]
    assert torch.allclose(tops, tops[:, :1].expand_as(tops))
    assert {round(float(z), 3) for z in tops[:, 0]} == {round(z, 3) for z in labels}
    x = env.physics.qpos[:, 0]
    assert (x > task.FIRST_X - 3.0).all() and (x < task.FIRST_X + 2.0).all()
    assert (x < task.FIRST_X).any() and (x > task.FIRST_X).any()
    step = env.step(torch.zeros(64, 1, 69))
    assert not step.terminated.any() and step.valid.all()
    env.close()


def test_shipped_demonstrations_clear_their_hurdle_by_the_same_other_computation():
    for clip in load_demonstrations("hurdling"):
        end = clip.meta["events"]["landing"]
        fine = clip.resample(240.0)
        rows = fine.times <= end
        gap = gap_to_hurdle(load_body("smpl"), fine.qpos[rows], clip.meta["asked"]["hurdle_height"])
        assert gap.min() > -0.005  # frames between those that MuJoCo gave are interpolated
        assert clip.meta["achieved"]["success"] == 1.0 and clip.meta["certified"] is True
