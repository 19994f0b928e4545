"""Reference tables against MuJoCo, against differences of positions, and in a mirror."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rl.motion import link_motion
from sports.humanoid.body import load_body
from sports.physics import default_state, make_physics
from sports.scene import humanoid_scene
from tests.rl.motions_made import tables
from tests.warmstart.clips_made import random_clip
from warmstart.bank import demonstration_files
from warmstart.clip import Clip
from warmstart.replay import body_of

BODY = load_body("smpl")


def test_links_of_a_frame_are_those_of_mujoco_in_the_frame_s_state():
    motions = tables(random_clip(0), random_clip(1, 25))
    frame = torch.tensor([0, 7, 39, 41, 50, 70, 100])
    scene = humanoid_scene(BODY)
    physics = make_physics("mujoco", scene, len(frame))
    state = default_state(scene, len(frame), "cpu")
    state.qpos, state.qvel = motions.state(frame)
    physics.reset(torch.ones(len(frame), dtype=torch.bool), state)
    reference = motions.at(frame)
    torch.testing.assert_close(reference.pos, physics.body_pos[:, 0], atol=2e-6, rtol=0)
    torch.testing.assert_close(reference.rot, physics.body_rot[:, 0], atol=2e-6, rtol=0)
    torch.testing.assert_close(reference.linvel, physics.body_linvel[:, 0], atol=2e-4, rtol=0)
    torch.testing.assert_close(reference.angvel, physics.body_angvel[:, 0], atol=2e-4, rtol=0)
    physics.close()


def test_kept_velocities_are_those_of_mujoco_in_the_frame_and_in_the_mirror():
    made = random_clip(8)
    qvel = np.random.default_rng(8).normal(0, 3, made.qvel.shape)
    clip = Clip(30.0, "smpl", made.qpos, qvel, ctrl=made.qpos[:, 7:])
    motions = tables(clip)
    frame = torch.tensor([0, 7, 38, 39, 41, 60, 80])
    scene = humanoid_scene(BODY)
    physics = make_physics("mujoco", scene, len(frame))
    state = default_state(scene, len(frame), "cpu")
    state.qpos, state.qvel = motions.state(frame)
    seen = clip.mirrored().qvel[[0, 19, 39]]  # each clip has a frame more behind it
    kept = torch.tensor(np.concatenate([qvel[[0, 7, 38, 39]], seen]))
    torch.testing.assert_close(state.qvel, kept.float(), rtol=2**-11, atol=1e-6)
    physics.reset(torch.ones(len(frame), dtype=torch.bool), state)
    reference = motions.at(frame)
    torch.testing.assert_close(reference.linvel, physics.body_linvel[:, 0], atol=2e-4, rtol=0)
    torch.testing.assert_close(reference.angvel, physics.body_angvel[:, 0], atol=2e-4, rtol=0)
    physics.close()


def test_a_jump_s_own_targets_lead_along_it_from_its_first_frame():
    # From differences of its path instead of its velocities they lead 0.6 m elsewhere.
    clip = Clip.load(demonstration_files("long_jump_5m")[0])
    assert clip.ctrl is not None and clip.fps == 30.0
    motions = tables(clip)
    physics = make_physics("mujoco", humanoid_scene(body_of(clip)), 1)
    state = default_state(physics.scene, 1, "cpu")
    state.qpos, state.qvel = motions.state(torch.tensor([0]))
    physics.reset(torch.ones(1, dtype=torch.bool), state)
    for t in range(1, clip.num_frames):
        physics.step(torch.tensor(clip.ctrl[t - 1 : t], dtype=torch.float32))
        off = physics.body_pos[0, 0] - motions.at(torch.tensor([t])).pos[0]
        # The rounding of the first velocities grows in every contact of the landing.
        bound = 0.012 if t <= clip.meta["events"]["landing"] * clip.fps else 0.05
        assert torch.linalg.vector_norm(off, dim=-1).mean() < bound
    physics.close()


def test_velocities_are_the_differences_of_places_and_rotations():
    path = random_clip(2, frames=400, fps=300.0).qpos
    motion = link_motion(BODY, path, 300.0)
    linear = (motion.pos[2:401] - motion.pos[:399]) * 150.0
    np.testing.assert_allclose(motion.linvel[1:400][:-1], linear[:-1], atol=5e-3)
    quat = motion.quat[:400][:, :, [1, 2, 3, 0]]
    for link in (0, 4, 12, 23):
        turn = Rotation.from_quat(quat[2:, link]) * Rotation.from_quat(quat[:-2, link]).inv()
        np.testing.assert_allclose(motion.angvel[1:399, link], turn.as_rotvec() * 150.0, atol=2e-2)


def test_a_hinge_that_jumps_a_turn_changes_nothing():
    clip = random_clip(3)
    jumps = clip.qpos.copy()
    jumps[11::3, 7:] += 2 * np.pi
    plain, jumped = tables(clip), tables(Clip(30.0, "smpl", jumps, clip.qvel))
    frames = torch.arange(40)
    for one, two in zip(plain.at(frames), jumped.at(frames)):
        torch.testing.assert_close(one, two, atol=5e-3, rtol=0)
    torch.testing.assert_close(plain.state(frames)[1], jumped.state(frames)[1], atol=1e-2, rtol=0)


def test_mirrored_frames_are_the_others_seen_in_a_mirror():
    motions = tables(random_clip(4), random_clip(5, 15))
    count = motions.num_frames
    assert count == 41 + 16
    frame = torch.tensor([0, 13, 40, 41, 56])
    plain, mirrored = motions.at(frame), motions.at(frame + count)
    swap = {"L": "R", "R": "L"}
    names = BODY.link_names
    other = [names.index(swap[n[0]] + n[1:] if n[1] == "_" else n) for n in names]
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0]))
    # The body itself is not quite alike on both sides: links differ by up to 2 cm in length.
    torch.testing.assert_close(mirrored.pos, plain.pos[:, other] @ mirror, atol=0.03, rtol=0)
    torch.testing.assert_close(mirrored.linvel, plain.linvel[:, other] @ mirror, atol=0.2, rtol=0)
    torch.testing.assert_close(mirrored.pos[:, 0], plain.pos[:, 0] @ mirror, atol=1e-6, rtol=0)
    # Angular velocity is an axial vector: a mirror turns the signs of the others round.
    torch.testing.assert_close(mirrored.angvel, -plain.angvel[:, other] @ mirror, atol=1e-3, rtol=0)
    rot = mirror @ plain.rot[:, other] @ mirror
    torch.testing.assert_close(mirrored.rot, rot, atol=1e-5, rtol=0)
    assert motions.last[frame].tolist() == [39, 39, 39, 55, 55]
    assert motions.last[frame + count].tolist() == [count + i for i in (39, 39, 39, 55, 55)]


def test_the_frame_behind_the_last_goes_on_as_it_went():
    path = random_clip(6, 200, fps=30.0).qpos
    cut = link_motion(BODY, path[:120], 30.0)
    whole = link_motion(BODY, path, 30.0)
    step = np.linalg.norm(whole.pos[120] - whole.pos[119], axis=-1).max()
    missed = np.linalg.norm(cut.pos[120] - whole.pos[120], axis=-1).max()
    assert len(cut.pos) == 121 and missed < 0.35 * step


def test_who_starts_in_the_ground_is_lifted_onto_it():
    clip = random_clip(7)
    sunk = clip.qpos.copy()
    sunk[:, 2] -= 1.0
    motions = tables(Clip(30.0, "smpl", sunk, clip.qvel))
    scene = humanoid_scene(BODY)
    physics = make_physics("mujoco", scene, 40)
    state = default_state(scene, 40, "cpu")
    state.qpos, state.qvel = motions.state(torch.arange(40))
    physics.reset(torch.ones(40, dtype=torch.bool), state)
    lowest = -physics.extent(torch.tensor([0.0, 0.0, -1.0])).amax(-1)[:, 0]
    assert (lowest > -1e-5).all()
    lifted = state.qpos[:, 2] - torch.tensor(sunk[:, 2]).float() > 1e-5
    assert lifted.any()
    torch.testing.assert_close(lowest[lifted], torch.zeros(int(lifted.sum())), atol=1e-5, rtol=0)
    physics.close()


def test_who_stands_touches_with_the_feet_and_who_hovers_or_slides_does_not():
    still = np.zeros((9, 76))
    still[:, 2], still[:, 3] = BODY.standing_height(clearance=0.0), 1.0
    frames = np.arange(9)[:, None]
    high, gliding = still.copy(), still.copy()
    high[:, 2:3] += 0.06
    gliding[:, :1] = 0.5 / 30.0 * frames
    motions = tables(*(Clip(30.0, "smpl", q, np.zeros((9, 75))) for q in (still, high, gliding)))
    standing, hovering, sliding = motions.contact(torch.tensor([4, 14, 24]))
    feet = [n.endswith(("Ankle", "Toe")) for n in BODY.link_names]
    assert standing.tolist() == [1.0 if f else -1.0 for f in feet]
    assert hovering.tolist() == [-1.0] * 24
    assert sliding.tolist() == [0.0 if f else -1.0 for f in feet]
