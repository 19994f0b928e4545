"""The tracker's observation and reward against plain numbers, its episodes, and its training."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rl.motion import Reference
from rl.tracker import TrackingConfig, TrackingEnv, make_tracking_env
from rl.tracking_terms import (
    contact_mismatch,
    goal_features,
    residual_targets,
    tracking_errors,
    wrapped,
)
from sports.frames import Heading
from sports.humanoid.body import load_body
from sports.physics.base import PhysicsState
from tests.warmstart.clips_made import random_clip
from warmstart.bank import demonstration_files
from warmstart.clip import Clip
from warmstart.library import Library, pack

BODY = load_body("smpl")


def moving(count: int, seed: int) -> tuple[Reference, Rotation]:
    rng = np.random.default_rng(seed)
    turns = Rotation.random(24 * count, random_state=seed)
    rot = turns.as_matrix().reshape(count, 24, 3, 3)
    parts = (rng.normal(size=(count, 24, 3)), rot, *rng.normal(size=(2, count, 24, 3)))
    return Reference(*(torch.tensor(x).float() for x in parts)), turns


def library(*clips: Clip) -> Library:
    return pack((f"clip_{i}", c) for i, c in enumerate(clips))


def demonstration(problem: str) -> Clip:
    return Clip.load(demonstration_files(problem)[0])


def env_of(motions: Library, worlds: int, **options) -> TrackingEnv:
    config = TrackingConfig(split="all", **options.pop("config", {}))
    return make_tracking_env(motions, num_worlds=worlds, config=config, **options)


# Pure functions.


def test_observation_of_hand_made_states():
    body, _ = moving(3, 0)
    goal, _ = moving(3, 1)
    found = goal_features(Heading(body.rot[:, None, 0]), body, goal)
    sizes = {name: value.shape[1] for name, value in found.items()}
    assert list(sizes.values()) == [72, 144, 72, 72, 72, 144] and sum(sizes.values()) == 576
    for w in range(3):
        # With scipy, link by link: H is the rotation about z by the root's yaw.
        x_axis = body.rot[w, 0, :, 0].double().numpy()
        heading = Rotation.from_euler("z", math.atan2(x_axis[1], x_axis[0])).inv()
        own = Rotation.from_matrix(body.rot[w].double().numpy())
        wanted = Rotation.from_matrix(goal.rot[w].double().numpy())
        turn = (heading * wanted * own.inv() * heading.inv()).as_matrix()
        seen = (heading * wanted).as_matrix()

        def apart(name: str, w: int = w, heading: Rotation = heading) -> np.ndarray:
            one, two = (getattr(r, name)[w].double().numpy() for r in (goal, body))
            return heading.apply(one - two)

        root = body.pos[w, 0].double().numpy()
        expected = {
            "position_difference": apart("pos"),
            "rotation_difference": np.swapaxes(turn[..., :2], -1, -2),
            "velocity_difference": apart("linvel"),
            "spin_difference": apart("angvel"),
            "reference_position": heading.apply(goal.pos[w].double().numpy() - root),
            "reference_rotation": np.swapaxes(seen[..., :2], -1, -2),
        }
        for name, value in expected.items():
            np.testing.assert_allclose(found[name][w], value.ravel(), atol=2e-6, err_msg=name)


def test_the_observation_is_the_same_anywhere_and_in_any_direction():
    body, _ = moving(4, 2)
    goal, _ = moving(4, 3)
    yaw = torch.tensor(Rotation.from_euler("z", 1.234).as_matrix()).float()

    def moved(r: Reference) -> Reference:
        shift = torch.tensor([3.0, -5.0, 0.0])
        vectors = r.pos @ yaw.T + shift, yaw @ r.rot, r.linvel @ yaw.T, r.angvel @ yaw.T
        return Reference(*vectors)

    plain = goal_features(Heading(body.rot[:, None, 0]), body, goal)
    other = moved(body)
    turned = goal_features(Heading(other.rot[:, None, 0]), other, moved(goal))
    for name, value in plain.items():
        torch.testing.assert_close(value, turned[name], atol=1e-5, rtol=0)


def test_errors_of_hand_made_states():
    body, own = moving(3, 4)
    goal, wanted = moving(3, 5)
    found = tracking_errors(body, goal).numpy()
    angle = (wanted * own.inv()).magnitude().reshape(3, 24)
    np.testing.assert_allclose(found[:, 1], (angle**2).mean(1), rtol=1e-4)
    for k, name in ((0, "pos"), (2, "linvel"), (3, "angvel")):
        d = (getattr(body, name) - getattr(goal, name)).double().numpy()
        np.testing.assert_allclose(found[:, k], (d**2).sum(-1).mean(-1), rtol=1e-5)
    assert float(tracking_errors(body, body).abs().max()) < 1e-6


def test_contacts_that_differ_are_counted():
    reference = torch.tensor([[1.0, 1.0, -1.0, -1.0, 0.0, 0.0]])
    touching = torch.tensor([[True, False, True, False, True, False]])
    assert contact_mismatch(touching, reference).tolist() == [2.0]
    assert contact_mismatch(reference > 0, reference).tolist() == [0.0]
    assert contact_mismatch(reference <= 0, reference).tolist() == [4.0]


def test_targets_lie_near_the_joint_whatever_turn_it_is_in():
    q = torch.tensor([0.1, 3.0, -3.0, 7.0, -9.0])
    reference = torch.tensor([0.2, -3.1, 3.1, 0.5, -2.9])
    expected = q + torch.tensor(
        [0.1, 2 * math.pi - 6.1, 6.1 - 2 * math.pi, 2 * math.pi - 6.5, 6.1 - 2 * math.pi]
    )
    torch.testing.assert_close(residual_targets(q, reference, torch.zeros(5), 0.8), expected)
    moved = residual_targets(q, reference, torch.full((5,), -0.5), 0.8)
    torch.testing.assert_close(moved, expected - 0.4)
    assert float(wrapped(torch.tensor([5 * math.pi - 0.1]))) == pytest.approx(math.pi - 0.1, 1e-4)


# Episodes.


def put(env: TrackingEnv, frame: torch.Tensor) -> None:
    """Puts every world exactly into the reference's frame, as if it had moved there."""
    everyone = torch.ones(len(frame), dtype=torch.bool)
    qpos, qvel = env.tracking.tables.state(frame)
    env.physics.reset(everyone, PhysicsState(qpos, qvel, env.physics.mocap_pos.clone()))
    env.view.refresh()


def test_who_follows_exactly_earns_one_and_never_ends():
    clip = random_clip(0, 50)
    clip.qpos[:, 2] += 3.0  # nothing touches the ground, so nothing is lifted
    env = env_of(library(clip), 2, assigned=[0, 0])
    tracking, memory = env.tracking, env.memory
    tracking.assigned = None  # the criterion of training, at its strictest
    tracking.schedule(1.0)
    for frame in range(1, 50):
        now = torch.tensor([frame, frame])
        put(env, now)
        # Servos at rest: each target is the angle that the joint has.
        env.view.ctrl = env.physics.qpos[:, None, 7:].clone()
        step = tracking.advance(env.view, memory)
        memory = step.memory
        follows = sum(step.terms[n] for n in ("position", "rotation", "velocity", "spin"))
        torch.testing.assert_close(follows, torch.ones(2, 1), atol=2e-3, rtol=0)
        assert float(step.terms["power"].abs().max()) < 1e-4
        for name in ("action_rate", "root_height", "contact"):
            assert float(step.terms[name].abs().max()) < 1e-6
        assert not step.terminated.any()
        assert step.truncated is not None and bool(step.truncated.all()) == (frame == 49)
        assert float(step.metrics["mpjpe"].max()) < 0.01
        assert float(step.metrics["acceleration_error"].max()) < 0.01
    env.close()


def test_errors_of_an_athlete_who_lags_a_known_way_behind():
    clip = random_clip(1, 30)
    clip.qpos[:, 2] += 3.0
    env = env_of(library(clip), 1, assigned=[0])
    memory, offsets = env.memory, [0.0]
    for frame in range(1, 12):
        put(env, torch.tensor([frame]))
        qpos = env.physics.qpos.clone()
        offsets.append(0.03 * math.sin(frame))
        qpos[:, 0] += offsets[-1]
        env.physics.reset(
            torch.ones(1, dtype=torch.bool),
            PhysicsState(qpos, env.physics.qvel.clone(), env.physics.mocap_pos.clone()),
        )
        env.view.refresh()
        env.view.ctrl = env.physics.qpos[:, None, 7:].clone()
        step = env.tracking.advance(env.view, memory)
        memory = step.memory
    x = np.array(offsets)
    assert float(step.metrics["mpjpe"]) == pytest.approx(1e3 * np.abs(x[1:]).mean(), abs=0.01)
    assert float(step.metrics["mpjpe_local"]) == pytest.approx(0.0, abs=0.01)
    jolt = 1e3 * np.abs(x[2:] - 2 * x[1:-1] + x[:-2]).mean()
    assert float(step.metrics["acceleration_error"]) == pytest.approx(jolt, abs=0.02)
    assert float(step.terms["root_height"]) == pytest.approx(0.0, abs=1e-6)
    k = env.tracking.sharpness[0]
    expected = 0.5 * torch.exp(-k * offsets[-1] ** 2)
    torch.testing.assert_close(step.terms["position"][0, 0], expected, atol=1e-4, rtol=0)
    env.close()


def test_power_and_change_of_action_cost_what_they_say():
    clip = random_clip(2, 30)
    clip.qpos[:, 2] += 3.0
    env = env_of(library(clip), 1, assigned=[0], config={"power": 1e-3, "action_rate": 0.5})
    memory, rng = env.memory, np.random.default_rng(0)
    kp, effort = BODY.array("kp"), BODY.array("effort")
    before = None
    for frame in (1, 2, 3):
        put(env, torch.tensor([frame]))
        action = rng.uniform(-1, 1, 69)
        q, v = (env.physics.qpos[0, 7:].numpy(), env.physics.qvel[0, 6:].numpy())
        ctrl = q + 0.8 * action  # the athlete is where the reference is
        env.view.ctrl = torch.tensor(ctrl).float()[None, None]
        step = env.tracking.advance(env.view, memory)
        memory = step.memory
        watts = np.abs(np.clip(kp * 0.8 * action, -effort, effort) * v).sum()
        assert float(step.terms["power"]) == pytest.approx(-1e-3 * watts, rel=1e-4)
        rate = 0.0 if before is None else 0.5 * ((action - before) ** 2).mean()
        assert float(step.terms["action_rate"]) == pytest.approx(-rate, rel=1e-4, abs=1e-9)
        before = action
    env.close()


def test_a_turning_wrist_lags_by_its_damping_and_with_feed_forward_does_not():
    # In free fall, where nothing pulls at the joints. A target that is held at the next frame's
    # angle leads by half a step; the servo's pull kp (target - q) balances kd dq.
    rate, frames = 2.0, 25
    t = np.arange(frames) / 30.0
    qpos = np.zeros((frames, 76))
    qpos[:, 2], qpos[:, 3] = 20.0 - 0.5 * 9.81 * t**2, 1.0
    hinge = [dof.name for dof in BODY.dofs].index("L_Wrist_x")
    qpos[:, 7 + hinge] = rate * t - 0.8
    delay = BODY.array("kd")[hinge] / BODY.array("kp")[hinge] - 0.5 / 30.0
    lags = []
    for feed_forward in (False, True):
        env = env_of(
            library(Clip(30.0, "smpl", qpos, np.zeros((frames, 75)))),
            1,
            assigned=[0],
            config={"feed_forward": feed_forward},
        )
        for _ in range(frames - 5):
            env.step(torch.zeros(1, 1, 69))
        frame = env.memory["frame"]
        lag = env.tracking.tables.joints(frame) - env.physics.qpos[:, 7:]
        lags.append(float(lag[0, hinge]))
        env.close()
    assert lags[0] == pytest.approx(rate * delay, rel=0.1)  # 9 degrees
    assert abs(lags[1]) < 0.1 * rate * delay


def test_feed_forward_reaches_no_further_than_the_servo_pulls():
    clip = random_clip(4, 30)
    fast = Clip(30.0, "smpl", clip.qpos, np.full_like(clip.qvel, 50.0), ctrl=clip.qpos[:, 7:])
    env = env_of(library(fast), 1, assigned=[0], config={"feed_forward": True})
    frame = env.memory["frame"]
    ctrl = env.tracking.targets(env.view, env.memory, torch.zeros(1, 1, 69))[:, 0]
    ahead = ctrl - env.tracking.tables.joints(frame + 1)
    expected = torch.tensor(BODY.array("effort") / BODY.array("kp")).float()
    torch.testing.assert_close(ahead[0], expected, atol=1e-4, rtol=0)
    # What was done is known again from the targets.
    action = 0.3 * torch.randn(1, 1, 69, generator=torch.Generator().manual_seed(0))
    env.view.ctrl = env.tracking.targets(env.view, env.memory, action)
    step = env.tracking.advance(env.view, env.memory)
    torch.testing.assert_close(step.memory["action"], action[:, 0], atol=1e-4, rtol=0)
    env.close()


def test_episodes_end_off_the_reference_and_feet_may_be():
    clip = random_clip(3, 30)
    clip.qpos[:, 2] += 3.0
    env = env_of(library(clip), 1, assigned=[0])
    tracking, start = env.tracking, env.memory
    reference = tracking.tables.at(torch.tensor([1]))

    class Physics:
        qpos, qvel = env.physics.qpos, env.physics.qvel
        body_rot = reference.rot[:, None]
        ground_force = env.physics.ground_force
        body_linvel, body_angvel = reference.linvel[:, None], reference.angvel[:, None]

    def advance(link: str, metres: float):
        Physics.body_pos = reference.pos[:, None].clone()
        Physics.body_pos[0, 0, BODY.link_index(link), 1] += metres
        view = dataclasses.replace(env.view, physics=Physics(), ctrl=env.physics.qpos[:, None, 7:])
        return bool(tracking.advance(view, start).terminated)

    tracking.assigned = None
    for share, bound in ((0.0, 0.5), (0.35, 0.5 / math.sqrt(2)), (0.7, 0.25), (1.0, 0.25)):
        tracking.schedule(share)
        assert not advance("Head", bound - 0.01) and advance("Head", bound + 0.01)
        assert not advance("L_Toe", 2.0) and not advance("R_Ankle", 2.0)
    # Evaluation asks for the mean distance of all links instead.
    tracking.assigned = torch.tensor([0])
    assert not advance("Head", 24 * 0.49) and advance("Head", 24 * 0.51)
    env.close()


def test_the_curriculum_goes_from_soft_to_sharp():
    env = env_of(library(random_clip(0)), 1)
    soft, sharp = torch.tensor([25.0, 5.0, 0.5, 0.1]), torch.tensor([100.0, 10.0, 0.2, 0.1])
    for share, part in ((0.0, 0.0), (0.35, 0.5), (0.7, 1.0), (1.0, 1.0)):
        env.schedule(share)
        expected = soft ** (1 - part) * sharp**part
        torch.testing.assert_close(env.tracking.sharpness, expected)
    env.close()


def test_worlds_in_another_order_do_the_same():
    motions = library(demonstration("high_jump"), demonstration("tennis"), random_clip(0))
    order = [2, 0, 1, 0]
    generator = torch.Generator().manual_seed(0)
    actions = 0.1 * torch.randn(8, 3, 1, 69, generator=generator)
    one, two = env_of(motions, 3, assigned=[0, 1, 2]), env_of(motions, 4, assigned=order)
    torch.testing.assert_close(one.reset()[order], two.reset(), atol=0, rtol=0)
    for action in actions:
        a, b = one.step(action), two.step(action[order])
        torch.testing.assert_close(a.final_obs[order], b.final_obs, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(a.reward[order], b.reward, atol=1e-5, rtol=0)
    one.close()
    two.close()


def test_in_the_mirror_the_same_actions_earn_the_same():
    motions = library(demonstration("high_jump"))
    env = env_of(motions, 2, assigned=[0, 0])
    count = env.tracking.tables.num_frames
    env.tracking.assigned = torch.tensor([20, 20 + count])
    env.reset()
    rng = np.random.default_rng(0)
    for _ in range(6):
        plain = rng.uniform(-0.3, 0.3, (2, 69))
        still = np.zeros((2, 76))
        still[:, 3] = 1.0
        still[:, 7:] = plain
        seen = Clip(30.0, "smpl", still, np.zeros((2, 75))).mirrored().qpos[0, 7:]
        action = torch.tensor(np.stack([plain[0], seen])).float()[:, None]
        result = env.step(action)
        # The body is not quite alike on both sides.
        for name in ("position", "rotation", "velocity", "spin"):
            left, right = result.terms[name][:, 0]
            assert float(left) == pytest.approx(float(right), abs=0.02), name
    env.close()


def test_a_failure_is_counted_where_it_happened():
    env = env_of(library(demonstration("high_jump")), 16, seed=1)
    tracking = env.tracking
    env.step(torch.zeros(16, 1, 69))
    before = tracking.sampling.failure.clone()
    tracking.tolerance.fill_(1e-6)  # everybody is lost in the next step
    frame = env.memory["frame"] + 1
    bins = tracking.sampling.bin_of[frame].unique()
    ended = env.step(torch.zeros(16, 1, 69))
    assert bool(ended.terminated.all())
    after = tracking.sampling.failure
    expected = before.clone()
    visits = torch.bincount(tracking.sampling.bin_of[frame], minlength=len(before))[bins]
    expected[bins] = 1.0 - 0.95**visits * (1.0 - before[bins])
    torch.testing.assert_close(after, expected)
    env.close()


def test_steps_do_not_depend_on_where_they_run():
    pytest.importorskip("mujoco_warp")
    motions = library(demonstration("high_jump"))
    one = env_of(motions, 2, assigned=[0, 0])
    two = env_of(motions, 2, assigned=[0, 0], engine="warp", physics_options={"device": "cpu"})
    torch.testing.assert_close(one.reset(), two.reset(), atol=1e-3, rtol=0)
    for _ in range(2):
        a, b = (env.step(torch.full((2, 1, 69), 0.05)) for env in (one, two))
        torch.testing.assert_close(a.reward, b.reward, atol=0.03, rtol=0)
    one.close()
    two.close()


def test_wrong_athletes_and_options_are_refused():
    motions = library(random_clip(0))
    env = env_of(motions, 1)
    other = pack([("a", random_clip(0, body="smplx"))])
    with pytest.raises(ValueError, match="clips are of body 'smplx', the athlete is 'smpl'"):
        TrackingEnv(other, TrackingConfig(), env.physics)
    env.close()
    with pytest.raises(ValueError, match="2 worlds need as many clips, not 1"):
        env_of(motions, 2, assigned=[0])
    with pytest.raises(ValueError, match="uniform in"):
        TrackingConfig(uniform=0.1)
    with pytest.raises(ValueError, match="must be positive"):
        TrackingConfig(tolerance=(0.5, 0.0))
