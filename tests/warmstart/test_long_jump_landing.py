"""A long jump reaches its length to the nearest mark, when planned and when tracked."""

from dataclasses import replace

import casadi as ca
import mujoco
import numpy as np
import pytest
import torch

from sports import long_jump as rules
from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from sports.physics import make_physics
from sports.physics.base import Geometry, default_state
from sports.scene import humanoid_scene
from warmstart import demonstration
from warmstart.bank import demonstration_files
from warmstart.certificate import Certificate
from warmstart.clip import Clip
from warmstart.problems import long_jump
from warmstart.replay import scene_of
from warmstart.solution import Solution
from warmstart.tracking import Tracked, Worlds
from warmstart.tracking_cost import JumpRules, Placed, Weights, weights_of

FILES = demonstration_files("long_jump")
BODY = load_body("smpl", strength="human")


def fall(height: float, rate: tuple[float, float, float], radius: float) -> float:
    """x where MuJoCo's free ball meets the plane, in steps of 0.1 ms, started at x = 2."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.0001" gravity="0 0 -9.81"/><worldbody><body><freejoint/>
        <geom type="sphere" size="{radius}" mass="1" contype="0" conaffinity="0"/>
        </body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qpos[:3], data.qvel[:3] = (2.0, 0.0, height), rate
    while data.qpos[2] > radius:
        mujoco.mj_step(model, data)
    return float(data.qpos[0])


@pytest.mark.parametrize("rate", [(7.0, 0.3, -4.0), (7.0, 0.0, 0.0), (-1.0, 0.0, 2.5)])
def test_what_nothing_holds_falls_where_a_free_ball_does(rate):
    found = float(long_jump.fallen(ca.DM([2.0, 0.0, 0.9]), ca.DM(list(rate)), 0.1))
    assert found == pytest.approx(fall(0.9, rate, 0.1), abs=2e-3)


def test_a_ball_on_the_ground_has_fallen():
    assert float(long_jump.fallen(ca.DM([2.0, 0.0, 0.1]), ca.DM([5.0, 0.0, -3.0]), 0.1)) == 2.0


def test_a_margin_that_is_no_margin_is_a_sentence():
    with pytest.raises(ValueError, match=r"margin must lie between 0 and 1 m, not -0\.1"):
        long_jump.Config(margin=-0.1)


def contacts(clip: Clip) -> list[list[tuple[float, float]]]:
    """x (m) and penetration (m) of MuJoCo's own contacts with the ground, frame by frame."""
    model = build_model(humanoid_scene(BODY))
    data, frames = mujoco.MjData(model), []
    for qpos in clip.qpos:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        ground = [c for c in data.contact if 0 in model.geom_bodyid[list(c.geom)]]
        frames.append([(float(c.pos[0]), float(-c.dist)) for c in ground if c.dist < 0.0])
    return frames


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_shipped_jump_is_as_long_as_it_was_asked_to_be(path):
    """By the engine's contacts in the frames that the clip holds, not by the table of support
    points that the task and the tracker measure with."""
    clip = Clip.load(path)
    asked = clip.meta["asked"]["length"]
    assert clip.meta["achieved"]["success"] == 1.0
    assert clip.meta["achieved"]["length"] >= asked
    found = contacts(clip)
    stood = next(t for t, frame in enumerate(found) if frame)  # the foot comes down as it begins
    assert stood <= 1
    flown = [t for t, frame in enumerate(found) if not frame and t > stood]
    landing = next(t for t in range(flown[0], len(found)) if found[t])
    assert landing - flown[0] >= 12  # 0.4 s in the air
    marks = [x for frame in found[landing : landing + rules.MARK_STEPS + 1] for x, _ in frame]
    assert min(marks) - rules.LINE_X >= asked
    before = [x for frame in found[: flown[0]] for x, _ in frame]
    assert max(before) < rules.LINE_X


def test_the_shipped_lengths_are_those_that_are_named():
    assert sorted(Clip.load(p).meta["asked"]["length"] for p in FILES) == [3.0, 5.0, 7.0]


def rules_at(mark: float) -> JumpRules:
    return JumpRules(takeoff=0, mark=mark, body=BODY, weights=Weights())


def upright(jump: JumpRules, x: list[float], height: float = 0.0) -> Placed:
    """Candidates that stand or hover upright, their pelvis at x (m), the soles at a height (m)."""
    standing = BODY.zero_pose_origins() + [0.0, 0.0, BODY.standing_height(height)]
    pos = np.stack([standing + [place, 0.0, 0.0] for place in x])
    return jump.placed(pos, np.broadcast_to(np.eye(3), (len(x), BODY.num_links, 3, 3)))


def test_a_mark_behind_the_asked_one_costs_and_one_beyond_does_not():
    """The athlete stands upright, first on the mark's far side, then on its near side."""
    jump = rules_at(25.0)
    here = upright(jump, [26.0, 24.0, 23.0])
    cost = jump.cost(20, here, here, here.standing)
    assert cost[0] == 0.0
    assert cost[2] - cost[1] == pytest.approx(Weights().mark * 1.0, rel=1e-6)


def test_a_link_that_touched_and_is_off_again_costs_where_its_rear_was():
    """Hovering upright 1 m above the ground, the arms held out, 0.3 m further than a step before:
    hands and feet are boxes, behind the mark then and beyond it now."""
    jump, links = rules_at(25.0), BODY.num_links
    here, before = upright(jump, [25.2], 1.0), upright(jump, [24.9], 1.0)
    assert not here.standing.any()
    nothing = np.zeros((1, links), dtype=bool)
    assert jump.cost(20, here, before, nothing)[0] == 0.0
    assert jump.cost(0, here, before, nothing)[0] == 0.0
    for name in ("R_Hand", "L_Ankle"):
        touched = nothing.copy()
        touched[0, BODY.link_index(name)] = True
        (box,) = BODY.links[BODY.link_index(name)].shapes
        assert box.kind == "box"
        origin = BODY.zero_pose_origins()[BODY.link_index(name), 0]
        rear = 24.9 + origin + box.center[0] - box.size[0]
        assert rear < 25.0 < rear + 0.3
        wanted = Weights().mark * (25.0 - rear)
        assert jump.cost(20, here, before, touched)[0] == pytest.approx(wanted, rel=1e-5)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_tracker_sees_the_marks_that_the_task_sees(path):
    """The shipped jump, played in the tracker's worlds and in the engine of the task: the same
    links touch in each step, are on the ground after it and have their rear at the same x."""
    clip = Clip.load(path)
    assert clip.ctrl is not None
    scene = scene_of(clip)
    jump, geometry = rules_at(25.0), Geometry(BODY, "cpu")
    worlds, physics = Worlds(scene, 1, threads=1, feel=True), make_physics("mujoco", scene, 1)
    state = default_state(scene, 1, "cpu")
    state.qpos[:], state.qvel[:] = (torch.tensor(x[:1]) for x in (clip.qpos, clip.qvel))
    physics.reset(torch.ones(1, dtype=torch.bool), state)
    worlds.put(1, state.qpos.double().numpy(), state.qvel.double().numpy(), np.zeros(scene.nv))
    landing, seen = clip.meta["events"]["landing"] * clip.fps, set()
    for step, ctrl in enumerate(clip.ctrl[:-1], 1):
        worlds.step(ctrl[None])
        physics.step(torch.tensor(ctrl[None], dtype=torch.float32))
        felt = physics.ground_force[0, 0].square().sum(-1) > 0
        np.testing.assert_array_equal(worlds.touched[0], felt.numpy())
        here = jump.placed(worlds.link_pos, worlds.link_mat)
        marks = geometry.marks(physics.body_pos[:, 0], physics.body_rot[:, 0], rules.TOUCH)
        np.testing.assert_array_equal(here.standing, marks.standing.numpy())
        np.testing.assert_allclose(here.rear, marks.rear.numpy(), atol=1e-4)
        if step > landing:
            seen.update(np.flatnonzero(worlds.touched[0] & ~here.standing[0]))
    assert seen  # something touched and was off again: what this is about
    physics.close()


def test_only_the_long_jump_wants_its_spin_kept_so_closely():
    assert weights_of("long_jump").spin > weights_of("high_jump").spin == Weights().spin
    assert replace(weights_of("long_jump"), spin=Weights().spin) == Weights()


@pytest.mark.parametrize(("length", "passed"), [(5.02, True), (4.98, False)])
def test_a_jump_that_falls_short_is_no_demonstration(monkeypatch, length, passed):
    clip = Clip.load(FILES[1])
    achieved = {"success": 1.0, "length": length}
    clip = replace(clip, meta=clip.meta | {"asked": {"length": 5.0}, "achieved": achieved})
    monkeypatch.setattr(demonstration, "track_best", lambda *_, **__: Tracked(clip, 0.1, 0.1, 1.0))
    certificate = Certificate("long_jump", {"length": 5.0}, "human", {}, (), {})
    monkeypatch.setattr(Certificate, "passed", property(lambda self: True))
    solution = Solution.load("tests/warmstart/data/long_jump_5.0_human.npz")
    found = demonstration.demonstrate(solution, certificate=certificate)
    assert found.passed == passed
    assert ("99.6 %" in found.reason) == (not passed)
