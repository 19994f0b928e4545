"""What following people takes: hand-made rows, a followed stroke, and the shipped figures."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rl.following import Follower
from rl.likeness import HUMAN_LIMITS
from rl.likeness_effort import NAMES, clip_of, measure, speed, summarise
from rl.likeness_reference import Reference
from rl.likeness_terms import TORQUE_RISE, measured
from sports.humanoid.body import load_body
from tests.rl.followed import backhand
from tests.rl.motions_still import BODY, slid, standing
from warmstart.clip import Clip, finite_difference_qvel
from warmstart.library import pack

SHIPPED = Path(__file__).parents[2] / "results" / "likeness_effort.json"


@pytest.fixture(scope="module")
def follower() -> Follower:
    return Follower("pretrained")


@pytest.fixture(scope="module")
def stroke() -> Clip:
    return backhand()


def test_the_rate_is_that_of_the_servos_of_a_human_athlete(follower, stroke):
    licences = ("MIT", "CC BY-NC 4.0")
    library = pack(
        (f"archive/clip{i}", replace(stroke, meta={"licence": x})) for i, x in enumerate(licences)
    )
    rows = measure(library, follower)
    assert [row["name"] for row in rows] == ["archive/clip0"]  # the other may not be used freely
    row = rows[0]
    assert row["followed"] and row["seconds"] == pytest.approx(stroke.duration, abs=1e-3)

    played = follower(clip_of(library, 0), 0.5)
    human = load_body("smpl", strength="human")
    kp, kd, most = (human.array(name) for name in ("kp", "kd", "effort"))
    torques = []
    for t in range(played.num_frames - 1):
        ends = [
            np.clip(kp * (played.ctrl[t] - played.qpos[i, 7:]), -most, most)
            - kd * played.qvel[i, 6:]
            for i in (t, t + 1)
        ]
        torques.append(sum(ends) / 2.0)
    judged = [i for i, dof in enumerate(human.dofs) if measured(dof.name)]
    change = np.abs(np.diff(torques, axis=0))[:, judged] * 30.0 / (TORQUE_RISE * most[judged])
    assert row["torque_rate"] == pytest.approx(np.quantile(change.max(1), 0.95), abs=1e-4)


def test_who_was_lost_does_not_count():
    row = {"tag": "run", "followed": True, **dict.fromkeys(NAMES, 0.5)}
    rows = [{**row, "split": "held_out", "torque_rate": k / 100.0} for k in range(101)]
    rows += [{**row, "split": "held_out", "followed": False, "torque_rate": 9.0}] * 20
    rows += [{**row, "split": "train", "torque_rate": 7.0, "jerk": None}]
    found = summarise(rows)
    held = found["held_out"]
    assert (held["clips"], held["followed"]) == (121, 101)
    expected = {"n": 101, "low": 0.05, "middle": 0.5, "high": 0.95, "most": 1.0}
    assert held["figures"]["torque_rate"] == pytest.approx(expected)
    assert found["train"]["figures"]["torque_rate"]["high"] == 7.0
    assert found["train"]["figures"]["jerk"] == {"n": 0}


def test_speed_is_along_the_ground():
    qpos = slid(standing(), 3.0).qpos.copy()
    qpos[:, 2] += 0.1 * np.arange(len(qpos))
    clip = Clip(30.0, "smpl", qpos, finite_difference_qvel(BODY, qpos, 30.0))
    assert speed(clip) == pytest.approx(3.0)


def test_the_panels_limit_is_what_held_out_people_came_to():
    shipped = json.loads(SHIPPED.read_text())
    assert shipped["strength"] == "human"
    held = [c for c in shipped["clips"] if c["split"] == "held_out"]
    assert {c["name"] for c in held} == set(Reference.load().names)
    rates = [c["torque_rate"] for c in held if c["followed"]]
    assert len(rates) >= 20
    assert HUMAN_LIMITS["torque_rate"] == pytest.approx(np.quantile(rates, 0.95), abs=0.02)
    assert shipped["splits"] == summarise(shipped["clips"])
