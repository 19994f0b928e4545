"""Throws that hold in both engines: other worlds against the engine's own, the correction by Drake
against a Drake that is known, the shipped clips where noise and friction are others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sports.env import make_scene
from sports.free_throw import RIM
from sports.physics import default_state, make_physics
from warmstart import robust_throw
from warmstart.bank import demonstration_files
from warmstart.certificate import Certificate
from warmstart.clip import Clip
from warmstart.other_worlds import Other, OtherWorlds
from warmstart.refine import UNITS, Flight
from warmstart.refined_throw import measure
from warmstart.robust_throw import FIRM, Crowd, main, total
from warmstart.solution import Solution

DATA = Path(__file__).parent / "data"
CLIPS = demonstration_files("free_throw")
G = 9.81


def flown(worlds: OtherWorlds, ctrl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3,) place and velocity of the ball after targets (K, n) from the task's start."""
    scene = worlds.scene
    worlds.put(1, scene.default_qpos(), np.zeros(scene.nv), np.zeros(scene.nv))
    for row in ctrl:
        worlds.step(row[None])
    place = worlds.qpos[0, scene.object_qpos("ball")][:3]
    return place.copy(), worlds.qvel[0, scene.object_qvel("ball")][:3].copy()


@pytest.mark.parametrize("felt", [False, True])
def test_other_worlds_are_those_of_the_engine(felt):
    """Without changes the task's, and with felt damping the engine's with felt damping."""
    clip = Clip.load(CLIPS[1])
    assert clip.ctrl is not None
    ctrl = clip.ctrl[: round(clip.meta["events"]["release"] * clip.fps) + 3]
    scene = make_scene("free_throw", strength="human")
    place, velocity = flown(OtherWorlds(scene, 1, 1, Other(felt=felt)), ctrl)
    physics = make_physics("mujoco", scene, 1, threads=1, felt_damping=felt)
    physics.reset(torch.ones(1, dtype=torch.bool), default_state(scene, 1, physics.device))
    for row in ctrl:
        physics.step(torch.tensor(row[None], dtype=torch.float32))
    assert place[0] > 0.4  # it flies
    np.testing.assert_allclose(place, physics.object_pos[0, 0], atol=0.01)
    np.testing.assert_allclose(velocity, physics.object_linvel[0, 0], atol=0.05)
    physics.close()


def test_worlds_that_cannot_be_are_one_sentence():
    scene = make_scene("free_throw", strength="human")
    with pytest.raises(ValueError, match="raise finer"):
        OtherWorlds(scene, 1, 1, Other(hold_time=0.002))
    for bad in ({"friction": 0.0}, {"finer": 0}):
        with pytest.raises(ValueError, match="friction above 0"):
            Other(**bad)


def test_stand_ins_are_corrected_by_what_drake_does(monkeypatch):
    """A Drake that is a stand-in blown off by a known wind: once it was visited, the copies of the
    stand-ins are judged as if blown off too."""
    solution = Solution.load(DATA / "free_throw_0.9_human.npz")
    monkeypatch.setattr(robust_throw, "make_physics", lambda *_: None)
    monkeypatch.setattr(robust_throw, "COPIES", ((FIRM, (0.0,)),))
    monkeypatch.setattr(robust_throw, "DRAKES", (0.0,))
    crowd = Crowd(solution, 2, 1)
    wind = np.array([[0.1, -0.2, 0.05], [0.3, 0.1, -0.4]])
    ours: list[Flight] = []

    def blown(ctrl: np.ndarray, _: robust_throw.Noise) -> Flight:
        flight = crowd.thrower.fly(crowd.worlds[0][0], ctrl[None])
        ours.append(
            replace(
                flight,
                place=flight.place + wind[0],
                velocity=flight.velocity + wind[1],
                before=flight.before + wind[1],
            )
        )
        return ours[-1]

    monkeypatch.setattr(crowd, "thrown", blown)
    numbers = np.zeros(len(UNITS))
    before = crowd.judge(numbers[None], 0)
    visited = crowd.visit(numbers, 0)
    np.testing.assert_allclose(crowd.drift, wind, atol=1e-9)
    after = crowd.judge(np.stack([numbers, numbers]), 0)
    np.testing.assert_allclose(after[0], crowd.thrower.cost(ours[0])[0], atol=1e-9)
    np.testing.assert_allclose(visited, after[0, :1], atol=1e-9)
    assert abs(after[0, 0] - before[0, 0]) > 0.01


def test_the_worst_copy_counts():
    off = np.array([[0.1, 0.0], [0.1, 0.0], [0.1, 0.3]])
    evenly, once = total(off)
    assert evenly == pytest.approx(0.15) and once == pytest.approx(0.25)


def assert_as_asked(clip: Clip, place: np.ndarray, velocity: np.ndarray) -> None:
    """Within the gate's limits of the parabola with the asked apex through the ring's middle."""
    apex = clip.meta["asked"]["apex"]
    up = np.sqrt(2 * G * (RIM[2] + apex - place[2]))
    time = (up + np.sqrt(2 * G * apex)) / G
    asked = np.array([(RIM[0] - place[0]) / time, (RIM[1] - place[1]) / time, up])
    speed, wanted = np.linalg.norm(velocity), np.linalg.norm(asked)
    assert speed == pytest.approx(wanted, rel=0.1)
    assert np.degrees(np.arccos(velocity @ asked / (speed * wanted))) < 3.0


def until_release(path: Path) -> tuple[Clip, np.ndarray]:
    """A clip and its targets (K, n) until the ball is free."""
    clip = Clip.load(path)
    found = Certificate.from_json(path.with_suffix(".json")).clip["mujoco"]
    assert clip.ctrl is not None
    return clip, clip.ctrl[: round(found["release_time"] * clip.fps) + 1]


@pytest.mark.parametrize("path", CLIPS, ids=lambda p: p.stem)
@pytest.mark.parametrize("friction", [0.9, 1.1])
def test_a_shipped_throw_forgives_other_friction(path, friction):
    clip, ctrl = until_release(path)
    scene = make_scene("free_throw", strength="human")
    assert_as_asked(clip, *flown(OtherWorlds(scene, 1, 1, Other(friction=friction)), ctrl))


def test_a_shipped_throw_forgives_friction_and_noise_in_drake():
    """With 0.9 of all friction, noise on the first pose and on every target."""
    clip, ctrl = until_release(CLIPS[1])
    scene, rng = make_scene("free_throw", strength="human"), np.random.default_rng(7)
    objects = [
        replace(o, friction=0.9 * o.friction, grip=o.grip and 0.9 * o.grip) for o in scene.objects
    ]
    scene = replace(scene, objects=tuple(objects), ground_friction=0.9 * scene.ground_friction)
    physics = make_physics("drake", scene, 1)
    state = default_state(scene, 1, physics.device)
    state.qpos[0, 7 : 7 + scene.nu] += 1e-3 * torch.tensor(rng.standard_normal(scene.nu)).float()
    physics.reset(torch.ones(1, dtype=torch.bool), state)
    for row in ctrl + 1e-3 * rng.standard_normal(ctrl.shape):
        physics.step(torch.tensor(row[None], dtype=torch.float32))
    place, velocity = (
        x[0, 0].double().numpy() for x in (physics.object_pos, physics.object_linvel)
    )
    assert place[0] > 0.4  # it flies
    assert_as_asked(clip, place, velocity)
    physics.close()


@pytest.mark.parametrize("path", CLIPS, ids=lambda p: p.stem)
def test_a_shipped_throw_forgives_noise_in_mujoco(path):
    """Other noise than that of its record; not every such throw goes in."""
    clip, rng = Clip.load(path), np.random.default_rng(7)
    assert clip.ctrl is not None
    baskets = 0.0
    for _ in range(6):
        noisy = replace(clip, ctrl=clip.ctrl + 1e-3 * rng.standard_normal(clip.ctrl.shape))
        found = measure(noisy, "mujoco")
        assert found["speed_off"] < 0.1 and found["direction_off"] < 3.0
        baskets += found["basket"]
    assert baskets >= 2


def test_only_plans_of_free_throws_are_refined(tmp_path, capsys):
    other = DATA / "set_shot_0.9_human.npz"
    assert main([str(other), "--out", str(tmp_path)]) == 2
    assert "is a motion of 'set_shot', not of 'free_throw'" in capsys.readouterr().err
    plan = str(DATA / "free_throw_0.9_human.npz")
    assert main([plan, "--out", str(tmp_path), "--near", str(CLIPS[0].parent / "none.npz")]) == 2
    assert "none.npz" in capsys.readouterr().err
