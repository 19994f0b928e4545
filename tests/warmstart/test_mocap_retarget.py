"""Retargeting: kinematics against MuJoCo, limbs and hinges in closed form, feet on a floor."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from tests.warmstart import mocap_files as files
from warmstart.mocap.bvh import read_bvh
from warmstart.mocap.capture import KEY_JOINTS, REQUIRED, Capture
from warmstart.mocap.fit import Aim, _Plan, fit
from warmstart.mocap.ground import find_contacts, ground
from warmstart.mocap.guess import first_guess
from warmstart.mocap.kinematics import Chain, exp, log, matrix, quaternion, swing
from warmstart.mocap.limbs import limb_of, move_end
from warmstart.mocap.quality import Limits, Quality
from warmstart.mocap.retarget import hinge_angles, local_rotations, retarget, smooth
from warmstart.outcome import lowest

BODY = files.BODY
CHAIN = Chain(BODY)
QPOS = files.motion(30, size=1.0)


def posed(qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return qpos[:, :3], local_rotations(BODY, qpos)


def random_turns(seed: int, count: int) -> np.ndarray:
    return Rotation.random(count, random_state=seed).as_matrix()


def test_links_lie_where_mujoco_puts_them():
    frames = CHAIN.frames(*posed(QPOS))
    for name, where in files.positions(QPOS).items():
        assert np.abs(frames.origin[:, CHAIN.index[name]] - where).max() < 1e-12
    assert np.abs(CHAIN.local(frames.turn) - posed(QPOS)[1]).max() < 1e-12


def test_the_lowest_point_is_the_one_of_the_other_implementation():
    heights = CHAIN.heights(CHAIN.frames(*posed(QPOS))).min(1)
    # MuJoCo holds a capsule as centre, attitude and half length: nine digits are left.
    assert np.abs(heights - lowest(BODY, QPOS)).max() < 1e-8


def test_rotations_agree_with_scipy():
    turn = random_turns(1, 200)
    half = Rotation.from_rotvec([[np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi]]).as_matrix()
    turn = np.concatenate([turn, half, np.eye(3)[None]])
    theirs = Rotation.from_matrix(turn)
    assert np.abs(matrix(quaternion(turn)) - turn).max() < 1e-14
    assert np.abs(np.linalg.norm(log(turn), axis=1) - theirs.magnitude()).max() < 1e-7
    assert np.abs(exp(theirs.as_rotvec()) - turn).max() < 1e-12


@pytest.mark.parametrize("seed", range(3))
def test_swing_takes_one_direction_to_the_other_the_short_way(seed: int):
    rng = np.random.default_rng(seed)
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in rng.normal(size=(2, 50, 3)))
    b[0], b[1] = -a[0], a[1]
    turn = swing(a, b)
    assert np.abs((turn @ a[..., None])[..., 0] - b).max() < 1e-12
    angle = Rotation.from_matrix(turn).magnitude()
    assert np.abs(angle - np.arccos(np.clip((a * b).sum(1), -1, 1))).max() < 1e-7


def test_the_jacobian_of_the_fit_is_the_derivative():
    root, local = (x[:1] for x in posed(QPOS))
    links = [n for n in CHAIN.names if n != "L_Hand"]
    rng = np.random.default_rng(0)
    targets = {name: rng.normal(size=(1, 3)) for name in KEY_JOINTS}
    weights = {name: 1.0 + k for k, name in enumerate(KEY_JOINTS)}
    plan = _Plan(CHAIN, Aim(targets, weights, dict.fromkeys(links, 0.1)))
    jacobian = plan.jacobian(CHAIN.frames(root, local))[0]
    step = 1e-6

    def joints(delta: np.ndarray) -> np.ndarray:
        moved = local.copy()
        moved[:, plan.links] = moved[:, plan.links] @ exp(delta[3:].reshape(1, -1, 3))
        frames = CHAIN.frames(root + delta[:3], moved)
        return (frames.origin[0, plan.joints] * plan.weight[:, None]).ravel()

    for k in rng.choice(plan.width, 20, replace=False):
        d = np.zeros(plan.width)
        d[k] = step
        numeric = (joints(d) - joints(-d)) / (2 * step)
        assert np.abs(numeric - jacobian[:, k]).max() < 1e-7


def test_the_fit_finds_a_pose_from_its_joints():
    goal = CHAIN.frames(*posed(QPOS))
    start = posed(files.motion(30, size=0.8))
    targets = {name: goal.origin[:, CHAIN.index[name]] for name in KEY_JOINTS}
    weights = dict.fromkeys(KEY_JOINTS, 1.0)
    aim = Aim(targets, weights, dict.fromkeys(CHAIN.names, 0.0001))
    root, local = fit(CHAIN, *start, aim, steps=60)
    found = CHAIN.frames(root, local)
    error = [np.linalg.norm(found.origin[:, CHAIN.index[n]] - targets[n], axis=1) for n in targets]
    assert np.max(error) < 1e-4


def test_hinge_angles_come_back_through_the_singular_pose():
    """Knees bend to 140 degrees, past 90, where their hinges lock."""
    qpos = files.motion(200, seed=2)
    for name, end in (("L_Knee_y", 2.5), ("R_Knee_y", -2.5)):
        k = 7 + BODY.dof_index(name)
        qpos[:, k] = np.linspace(0, end, 200)
        qpos[99:101, k] = np.sign(end) * np.pi / 2  # exactly locked
        qpos[:, [k - 1, k + 1]] = [0.3, 0.1]
    angles = hinge_angles(BODY, local_rotations(BODY, qpos))
    assert np.abs(angles - qpos[:, 7:]).max() < 1e-9


def test_hinges_run_on_and_stay_in_their_range():
    """A wrist that turns three times round wraps; a shoulder has room for two turns."""
    qpos = np.zeros((400, 7 + BODY.num_dofs))
    qpos[:, 3] = 1
    turns = np.linspace(0, 6 * np.pi, 400)
    wrist, shoulder = (7 + BODY.dof_index(n) for n in ("L_Wrist_x", "L_Shoulder_x"))
    qpos[:, wrist], qpos[:, shoulder] = turns, turns / 2
    angles = hinge_angles(BODY, local_rotations(BODY, qpos))
    assert (angles <= BODY.array("upper") + 1e-9).all()
    assert (angles >= BODY.array("lower") - 1e-9).all()
    assert np.allclose(angles[:, shoulder - 7], turns / 2)
    whole = (angles[:, wrist - 7] - turns) / (2 * np.pi)
    assert np.allclose(whole, np.round(whole), atol=1e-9)


@pytest.mark.parametrize("kind", ["leg", "arm"])
@pytest.mark.parametrize("side", ["L_", "R_"])
def test_the_end_of_a_limb_goes_where_it_is_sent_and_keeps_its_turn(kind: str, side: str):
    qpos = files.motion(30)
    limb = limb_of(side, kind)
    axis, sign = ("y", 1) if kind == "leg" else ("z", -1 if side == "L_" else 1)
    qpos[:, 7 + BODY.dof_index(f"{limb[1]}_{axis}")] = sign * np.linspace(0.6, 2.0, 30)
    root, local = posed(qpos)
    frames = CHAIN.frames(root, local)
    rng = np.random.default_rng(4)
    shift = rng.uniform(-0.03, 0.03, (30, 3))
    shift[0] = 0
    moved = local.copy()
    move_end(CHAIN, frames, moved, limb, shift)
    after = CHAIN.frames(root, moved)
    end = CHAIN.index[limb[2]]
    assert np.abs(after.origin[:, end] - frames.origin[:, end] - shift).max() < 1e-9
    assert np.abs(after.turn[:, end] - frames.turn[:, end]).max() < 1e-9
    assert np.abs(moved[0] - local[0]).max() < 1e-12  # nothing asked, nothing done


def test_a_limb_out_of_reach_points_there_stretched():
    qpos = files.motion(3)
    root, local = posed(qpos)
    frames = CHAIN.frames(root, local)
    moved = local.copy()
    move_end(CHAIN, frames, moved, limb_of("L_", "leg"), np.full((3, 3), [0.0, 0.0, -5.0]))
    after = CHAIN.frames(root, moved)
    hip, ankle = CHAIN.index["L_Hip"], CHAIN.index["L_Ankle"]
    span = after.origin[:, ankle] - after.origin[:, hip]
    goal = frames.origin[:, ankle] + [0, 0, -5] - frames.origin[:, hip]
    cosine = (span * goal).sum(1) / np.linalg.norm(span, axis=1) / np.linalg.norm(goal, axis=1)
    assert (cosine > 1 - 1e-9).all()


def standing(frames: int, fps: float, height: float, bob: float = 0.0) -> np.ndarray:
    """(T, 76) qpos: knees bent, arms down, hips going up and down over feet that are held."""
    qpos = np.zeros((frames, 7 + BODY.num_dofs))
    qpos[:, 3] = 1
    bend = 0.5 + bob * np.sin(2 * np.pi * np.arange(frames) / fps)
    for side, sign in (("L", -1), ("R", 1)):
        qpos[:, 7 + BODY.dof_index(f"{side}_Hip_y")] = -bend
        qpos[:, 7 + BODY.dof_index(f"{side}_Knee_y")] = 2 * bend
        qpos[:, 7 + BODY.dof_index(f"{side}_Ankle_y")] = -bend
        qpos[:, 7 + BODY.dof_index(f"{side}_Shoulder_x")] = 1.3 * sign
    frames_ = CHAIN.frames(*posed(qpos))
    qpos[:, 2] += height - CHAIN.heights(frames_).min(1)
    ankle = 0.5 * sum(frames_.origin[:, CHAIN.index[f"{s}_Ankle"], :2] for s in "LR")
    qpos[:, :2] -= ankle
    return qpos


@pytest.mark.parametrize("height", [-0.15, 0.0, 0.3])
def test_a_person_who_stands_is_put_on_the_floor(height: float):
    qpos = standing(60, 30.0, height, bob=0.2)
    done = ground(CHAIN, *posed(qpos), 30.0)
    surface = CHAIN.heights(CHAIN.frames(done.root, done.local))
    assert done.contacts.foot.all()
    assert np.abs(surface.min(1)).max() < 2e-3
    assert np.abs(done.moved + height).max() < 5e-3


def test_a_motion_that_stands_well_is_left_alone():
    """Only one foot bears weight: both soles are not equally far from the hips."""
    qpos = standing(60, 30.0, 0.0)
    lift = 7 + BODY.dof_index("L_Hip_y"), 7 + BODY.dof_index("L_Knee_y")
    qpos[:, lift[0]], qpos[:, lift[1]] = -1.2, 1.8
    qpos[:, 2] -= CHAIN.heights(CHAIN.frames(*posed(qpos))).min(1)
    root, local = posed(qpos)
    done = ground(CHAIN, root, local, 30.0)
    assert done.contacts.foot[:, 1].all() and not done.contacts.foot[:, 0].any()
    assert np.abs(done.root - root).max() < 1e-6
    assert np.abs(done.local - local).max() < 1e-6


def test_a_flight_keeps_its_arc():
    """Take-off and landing stand 10 and 6 cm too high; between them gravity alone acts."""
    fps, air = 60.0, 24
    low, high = standing(40, fps, 0.10), standing(40, fps, 0.06)
    t = np.arange(1, air + 1) / fps
    duration = (air + 1) / fps
    flight = np.repeat(low[-1:], air, axis=0)
    flight[:, 2] += 0.5 * 9.81 * t * (duration - t) - 0.04 * t / duration
    qpos = np.concatenate([low, flight, high])
    done = ground(CHAIN, *posed(qpos), fps)
    assert not done.contacts.foot[45:59].any()
    inner = slice(47, 57)
    fall = np.diff(done.root[:, 2], n=2)[inner] * fps**2
    assert np.abs(fall + 9.81).max() < 0.2
    assert np.abs(CHAIN.heights(CHAIN.frames(done.root, done.local)).min(1)[:38]).max() < 2e-3


def test_feet_that_slide_are_held():
    """A person who stands drifts sideways by 8 cm within a second."""
    fps = 30.0
    qpos = standing(31, fps, 0.0, bob=0.1)
    qpos[:, 1] += np.linspace(0, 0.08, 31)
    before = CHAIN.frames(*posed(qpos))
    done = ground(CHAIN, *posed(qpos), fps)
    after = CHAIN.frames(done.root, done.local)
    for name in ("L_Ankle", "R_Ankle"):
        i = CHAIN.index[name]
        drift = [np.ptp(f.origin[4:-4, i, 1]) for f in (before, after)]
        assert drift[0] > 0.05 and drift[1] < 0.01


@pytest.mark.parametrize("roll", [-0.4, 0.4])
def test_feet_that_lean_are_laid_flat(roll: float):
    qpos = standing(31, 30.0, 0.0)
    for side in "LR":
        qpos[:, 7 + BODY.dof_index(f"{side}_Ankle_x")] = roll
    done = ground(CHAIN, *posed(qpos), 30.0)
    turn = CHAIN.frames(done.root, done.local).turn
    for side in "LR":
        across = turn[:, CHAIN.index[f"{side}_Ankle"], 2, 1]
        assert np.abs(across).max() < 1e-6


def test_a_jump_on_the_spot_is_no_contact_at_its_height():
    fps = 30.0
    qpos = standing(31, fps, 0.0)
    t = np.arange(31) / fps - 0.5
    qpos[:, 2] += np.maximum(0.0, 0.45 - 0.5 * 9.81 * t**2)
    contacts = find_contacts(CHAIN, CHAIN.frames(*posed(qpos)), fps)
    assert not contacts.foot[8:23].any()
    assert contacts.foot[:4].all()


def scaled_skeleton(qpos: np.ndarray) -> str:
    """BVH of somebody else: longer legs, shorter arms, narrower shoulders, axes of its own."""
    factors = {"Knee": 1.15, "Ankle": 1.1, "Elbow": 0.85, "Wrist": 0.9, "Thorax": 0.8, "Hip": 1.1}
    links = []
    for link in BODY.links:
        k = factors.get(link.name.removeprefix("L_").removeprefix("R_"), 1.0)
        links.append(replace(link, offset=tuple(k * x for x in link.offset)))
    return files.bvh(qpos, replace(BODY, links=tuple(links)))


@pytest.mark.parametrize("rest", ["t_pose", "unknown"])
@pytest.mark.parametrize("seed", range(3))
def test_another_persons_motion_keeps_its_directions(rest: str, seed: int):
    qpos = files.motion(60, seed)
    for side, sign in (("L", -1), ("R", 1)):  # limbs that bend as limbs do
        qpos[:, 7 + BODY.dof_index(f"{side}_Knee_y")] = np.linspace(0.2, 1.4, 60)
        qpos[:, 7 + BODY.dof_index(f"{side}_Elbow_z")] = sign * np.linspace(1.6, 0.3, 60)
    joint_map = replace(files.own_map("bvh", 0.01), rest=rest)
    capture = read_bvh(scaled_skeleton(qpos), (joint_map,))
    done = retarget(capture, grounded=False)
    assert done.quality.joint_error < 0.02
    assert done.quality.bone_error < 5.0
    ours = CHAIN.frames(*posed(done.clip.qpos))
    for name in ("Pelvis", "Chest"):
        theirs = files.rotations(qpos)
        turn = theirs["Pelvis"]
        if name == "Chest":
            turn = turn * theirs["Torso"] * theirs["Spine"] * theirs["Chest"]
        mine = Rotation.from_matrix(ours.turn[:, CHAIN.index[name]])
        assert np.degrees((turn.inv() * mine).magnitude()).mean() < 20


def test_positions_alone_are_enough():
    body = load_body("smplx")
    qpos = files.motion(60, 1, body=body)
    for side, sign in (("L", -1), ("R", 1)):
        qpos[:, 7 + body.dof_index(f"{side}_Knee_y")] = np.linspace(0.4, 1.4, 60)
        qpos[:, 7 + body.dof_index(f"{side}_Elbow_z")] = sign * np.linspace(1.6, 0.5, 60)
    where = files.positions(qpos, body)
    capture = Capture(30.0, {name: where[name] for name in KEY_JOINTS})
    done = retarget(capture, "smplx", grounded=False)
    assert done.quality.joint_error < 0.02
    hands = [k for k, d in enumerate(body.dofs) if files.is_hand(d.link)]
    assert np.abs(done.clip.qpos[:, 7:][:, hands]).max() < 1e-12  # hands at rest


@pytest.mark.parametrize("body", ["smpl", "smplx"])
def test_velocities_are_the_derivative_of_the_state(body: str):
    capture = read_bvh(files.bvh(files.motion(60)), (files.own_map("bvh", 0.01),))
    clip = retarget(capture, body, grounded=False).clip
    model = build_model(load_body(body))
    out = np.zeros(model.nv)
    for t in range(5, 50):
        mujoco.mj_differentiatePos(model, out, 2 / clip.fps, clip.qpos[t - 1], clip.qpos[t + 1])
        assert np.abs(out - clip.qvel[t]).max() < 0.02 * max(1.0, np.abs(out).max())


def test_turned_and_moved_input_gives_turned_and_moved_output():
    """Heading and place in the world are nobody's business but the root's."""
    capture = read_bvh(scaled_skeleton(files.motion(40, 5)), (files.own_map("bvh", 0.01),))
    yaw = Rotation.from_euler("z", 2.1).as_matrix()
    moved = Capture(
        capture.fps,
        {k: v @ yaw.T + [3.0, -7.0, 0.0] for k, v in capture.points.items()},
        {k: yaw @ v for k, v in capture.turns.items()},
        capture.rest,
    )
    a, b = retarget(capture).clip, retarget(moved).clip
    assert np.abs(a.qpos[:, 7:] - b.qpos[:, 7:]).max() < 1e-6
    assert np.abs(a.qpos[:, 2] - b.qpos[:, 2]).max() < 1e-9


def test_smoothing_keeps_what_is_slow_and_takes_what_is_fast():
    fps, cutoff = 120.0, 6.0
    t = np.arange(600) / fps
    for frequency, kept in ((1.0, 0.99), (cutoff, np.sqrt(0.5)), (30.0, 0.0)):
        root = np.stack([np.sin(2 * np.pi * frequency * t)] * 3, axis=1)
        local = exp(0.2 * root)[:, None]
        place, turn = smooth(root, local, fps, cutoff)
        middle = slice(150, 450)
        assert np.ptp(place[middle, 0]) / 2 == pytest.approx(kept, abs=0.02)
        assert np.ptp(log(turn)[middle, 0, 0]) / 0.4 == pytest.approx(kept, abs=0.02)


def test_a_clip_is_rejected_with_every_reason():
    good = Quality(100, 3.3, 0.01, 0.02, 1, 0.05, 0.9, 0.001, 0.002, 0.01, 0, 0, 500, 450, 5, 0.05)
    assert good.reasons() == []
    bad = replace(good, joint_error=0.08, skating=0.3, seconds=0.1, sunk_frames=0.1, moved=0.5)
    text = " ".join(bad.reasons())
    for word in ("8.0 cm from", "30 cm/s", "0.10 s long", "10.0 %", "uneven by 50 cm"):
        assert word in text
    assert replace(good, jerk=9000.0).reasons() == ["8550 m/s^3 jerkier"]
    assert replace(good, contact_height=0.03).reasons(Limits(contact_height=0.05)) == []


points = arrays(
    np.float64,
    (3, len(REQUIRED) + 3, 3),
    elements=st.floats(-1.5, 1.5) | st.sampled_from([0.0, 1.0, 1e4]),
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(values=points)
def test_any_points_are_a_clip_or_a_sentence(values: np.ndarray):
    """Joints that coincide, lie on one line or far away."""
    try:
        capture = Capture(30.0, {n: values[:, k] for k, n in enumerate(KEY_JOINTS)})
        done = retarget(capture)
    except ValueError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(done.clip.qpos).all() and np.isfinite(done.clip.qvel).all()


def test_an_exact_source_is_copied_and_another_is_not():
    own = read_bvh(files.bvh(QPOS), (files.own_map("bvh", 0.01),))
    guess = first_guess(CHAIN, own)
    assert np.abs(guess.root - QPOS[:, :3]).max() < 1e-9
    other = read_bvh(scaled_skeleton(QPOS), (files.own_map("bvh", 0.01),))
    assert first_guess(CHAIN, other).targets["L_Ankle"] is not other.points["L_Ankle"]
