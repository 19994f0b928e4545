"""Features of motion against the engine's own kinematics, and demonstrations that cannot serve."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rl.config import load_placed_starts, load_starts
from rl.style_features import Athletes, StyleFeatures, load_demonstrations
from rl.train import main
from sports.env import make_env
from sports.humanoid.body import load_body
from sports.physics import PhysicsState
from warmstart.bank import demonstration_files
from warmstart.clip import Clip, finite_difference_qvel

CLIP = next(f for f in demonstration_files("long_jump") if "5m" in f.name)


def random_state(env, seed: int) -> PhysicsState:
    """Athletes in the air in any attitude, at any speed."""
    rng = np.random.default_rng(seed)
    scene, n = env.physics.scene, env.num_worlds
    qpos, qvel = np.tile(scene.default_qpos(), (n, 1)), np.zeros((n, scene.nv))
    for a in range(env.num_agents):
        q, v = scene.agent_qpos(a), scene.agent_qvel(a)
        k = q.stop - q.start - 7
        root = Rotation.random(n, random_state=seed + a).as_quat()[:, [3, 0, 1, 2]]
        place = rng.normal([9.0 * a, 0.0, 5.0], 0.5, (n, 3))
        qpos[:, q] = np.hstack((place, root, rng.normal(0.0, 0.6, (n, k))))
        qvel[:, v] = rng.normal(0.0, 2.0, (n, 6 + k))
    mocap = torch.tensor(np.tile(scene.default_mocap_pos(), (n, 1, 1))).float()
    return PhysicsState(torch.tensor(qpos).float(), torch.tensor(qvel).float(), mocap)


def expected(env, agent: int, world: int) -> np.ndarray:
    """The features from the engine's link poses and velocities, with scipy's rotations."""
    p = env.physics
    body = p.scene.body
    pos, quat, linear, angular = (
        x[world, agent].double().numpy()
        for x in (p.body_pos, p.body_quat, p.body_linvel, p.body_angvel)
    )
    links = Rotation.from_quat(quat[:, [1, 2, 3, 0]])
    ahead = links[0].apply([1.0, 0.0, 0.0])
    back = Rotation.from_euler("z", np.arctan2(ahead[1], ahead[0])).inv()

    def two_columns(rotation: Rotation) -> np.ndarray:
        return np.concatenate((rotation.apply([1.0, 0, 0]), rotation.apply([0, 1.0, 0])))

    parents = body.parents()
    fingers = ("Index", "Middle", "Pinky", "Ring", "Thumb")
    shown = [i for i, n in enumerate(body.link_names) if i and n[2:-1] not in fingers]
    joints = [two_columns(links[int(parents[i])].inv() * links[i]) for i in shown]
    rates = p.qvel[world, p.scene.agent_qvel(agent)][6:].double().numpy()
    hinges = [rates[3 * (i - 1) : 3 * i] for i in shown]
    hand = "Hand" if "L_Hand" in body.link_names else "Middle1"
    names = [s + n for s in ("L_", "R_") for n in ("Ankle", "Toe", "Wrist", hand)]
    keys = [back.apply(pos[body.link_index(n)] - pos[0]) for n in names]
    root = (two_columns(back * links[0]), back.apply(linear[0]), back.apply(angular[0]))
    return np.concatenate((*root, *joints, *hinges, *keys))


@pytest.mark.parametrize("task", ["long_jump", "boxing", "javelin"])
def test_features_are_those_of_the_engines_kinematics(task):
    """Of every athlete: one, two, and one with fingers."""
    env = make_env(task, num_worlds=3)
    athletes = Athletes(env, "cpu")
    env.physics.reset(torch.ones(3, dtype=torch.bool), random_state(env, 5))
    env.final_snapshot = env.snapshot()
    states = athletes.state()
    assert states.shape == (3 * env.num_agents, athletes.state_size)
    found = athletes.features(states)
    assert found.shape[-1] == athletes.features.size
    for world in range(3):
        for agent in range(env.num_agents):
            row = found[world * env.num_agents + agent]
            np.testing.assert_allclose(row, expected(env, agent, world), atol=2e-4)
    env.close()


def test_place_and_heading_do_not_matter_and_other_things_do():
    env = make_env("long_jump", num_worlds=1)
    features = Athletes(env, "cpu").features
    clip = Clip.load(CLIP)

    def of(c: Clip) -> torch.Tensor:
        return features(torch.tensor(np.concatenate((c.qpos, c.qvel), -1)).float())

    plain = of(clip)
    for place in ((3.0, -7.0, 0.0), (0.0, 0.0, 2.5), (-40.0, 12.0, -1.9)):
        torch.testing.assert_close(of(clip.moved(*place)), plain, rtol=1e-4, atol=2e-4)
    higher = dataclasses.replace(clip, qpos=clip.qpos + np.eye(1, 76, 2))
    torch.testing.assert_close(of(higher), plain)  # the root's height is left out
    for column in (3, 7, 40):  # attitude, a joint
        bent = clip.qpos.copy()
        bent[:, column] += 0.3
        bent[:, 3:7] /= np.linalg.norm(bent[:, 3:7], axis=1, keepdims=True)
        assert (of(dataclasses.replace(clip, qpos=bent)) - plain).abs().max() > 0.1
    env.close()


def test_velocities_are_the_stored_ones_and_no_difference_quotients():
    """A clip that stands still but says that it moves shows what it says."""
    env = make_env("long_jump", num_worlds=1)
    features = Athletes(env, "cpu").features
    qpos = torch.tensor(env.physics.scene.default_qpos()).float()
    qvel = torch.arange(75.0) * 0.1
    shown = features(torch.cat((qpos, qvel)).repeat(4, 1))
    n, links = 69, 24
    at = 12 + 6 * (links - 1)
    torch.testing.assert_close(shown[0, at : at + n], qvel[6:])
    torch.testing.assert_close(shown[0, 6:9], qvel[:3])  # it stands along x
    torch.testing.assert_close(shown[0, 9:12], qvel[3:6])
    env.close()


def test_a_motion_repeated_by_the_engine_shows_what_its_clip_shows():
    """The discriminator must not know simulated from stored velocities: played with its own
    targets, a demonstration has the features of its clip. Difference quotients would not do."""
    env = make_env("long_jump", num_worlds=1, strength="human", training=False)
    athletes, physics = Athletes(env, "cpu"), env.physics
    clip = Clip.load(CLIP)
    assert clip.ctrl is not None and clip.fps == 30.0
    state = PhysicsState(physics.qpos.clone(), physics.qvel.clone(), physics.mocap_pos.clone())
    state.qpos[0], state.qvel[0] = torch.tensor(clip.qpos[0]), torch.tensor(clip.qvel[0])
    physics.reset(torch.ones(1, dtype=torch.bool), state)
    found = []
    for target in clip.ctrl[:20]:
        physics.step(torch.tensor(target[None]).float())
        env.final_snapshot = env.snapshot()
        found.append(athletes.features(athletes.state())[0])
    env.close()

    def of(qvel: np.ndarray) -> torch.Tensor:
        states = np.concatenate((clip.qpos, qvel), -1)[1:21]
        return athletes.features(torch.tensor(states).float())

    torch.testing.assert_close(torch.stack(found), of(clip.qvel), rtol=1e-4, atol=1e-3)
    quotients = finite_difference_qvel(physics.scene.body, clip.qpos, clip.fps)
    assert (torch.stack(found) - of(quotients)).abs().max() > 1.0


def test_demonstrations_are_windows_at_the_control_rate(tmp_path):
    env = make_env("long_jump", num_worlds=1)
    clip = Clip.load(CLIP)
    captured = Clip(fps=60.0, body="smpl", qpos=clip.qpos[:30], qvel=clip.qvel[:30])
    captured.save(tmp_path / "captured.npz")
    found = load_demonstrations((CLIP, tmp_path / "captured.npz"), env, 5, mirror=False)
    # 30 frames at 60 a second are 15 at 30 a second: 11 windows of 5
    assert int((~found.optimised).sum()) == 11
    landing = clip.meta["events"]["landing"]
    first = int((found.begins[~found.optimised]).min())
    assert first / 30.0 <= landing + 2 / 30.0  # what comes after it is not shown
    assert int(found.optimised.sum()) == first - 4
    rows = found.begins[found.optimised]
    np.testing.assert_array_equal(rows, np.arange(first - 4))
    np.testing.assert_allclose(found.states[3, :76], clip.at(0.1)["qpos"], atol=1e-5)
    np.testing.assert_allclose(found.states[3, 76:], clip.at(0.1)["qvel"], atol=1e-4)
    both = load_demonstrations((CLIP,), env, 5, mirror=True)
    assert len(both.begins) == 2 * int(found.optimised.sum())
    features = Athletes(env, "cpu").features
    left, right = features(both.states).chunk(2)
    # velocity to the left, and the left ankle's place, become those of the right with y turned
    np.testing.assert_allclose(left[:, 7], -right[:, 7], atol=1e-4)
    sides = 12 + 6 * 23 + 69
    flipped = left[:, sides : sides + 12].unflatten(-1, (4, 3)) * torch.tensor([1.0, -1.0, 1.0])
    # The two legs of the table differ by 15 mm: the mirror image is another body's.
    np.testing.assert_allclose(flipped, right[:, sides + 12 :].unflatten(-1, (4, 3)), atol=0.05)
    env.close()


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("none", "--clips"),
        ("body", "is a motion of body 'smplx', but task 'long_jump' has body 'smpl'"),
        ("short", "is too short for a window of 10 frames: it has 6 at 30 frames a second"),
        ("file", "is not a readable clip file"),
    ],
)
def test_clips_that_cannot_serve_are_refused_in_one_sentence(case, words, tmp_path, capsys):
    path = tmp_path / "clip.npz"
    if case == "body":
        still = np.tile(np.eye(1, 160, 3), (40, 1))
        Clip(fps=30.0, body="smplx", qpos=still, qvel=np.zeros((40, 159))).save(path)
    elif case == "short":
        Clip.load(CLIP).resample(30.0).cut(0.0, 5.01 / 30.0).save(path)
    elif case == "file":
        path.write_text("no clip")
    clips = [] if case == "none" else ["--clips", str(path)]
    small = ["--worlds", "2", "--ppo.hidden", "8", "--samples", "8", "--quiet"]
    start = ["--start-probability", "0", "0"]
    out = ["--algo", "amp", "--out", str(tmp_path / "run")]
    assert main(["long_jump", *out, *small, *start, *clips]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ") and words in message
    assert message.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_fingers_do_not_show():
    """A grasp is the task's: no clip has it."""
    body = load_body("smplx")
    features = StyleFeatures(body)
    n = body.num_dofs
    rows = [i for i, d in enumerate(body.dofs) if d.link[2:] in ("Index1", "Thumb2", "Ring3")]
    assert len(rows) == 18
    straight = torch.zeros(13 + 2 * n)
    straight[3] = 1.0
    bent = straight.clone()
    bent[[7 + i for i in rows]] = 0.8
    bent[[13 + n + i for i in rows]] = 3.0
    assert torch.equal(features(bent), features(straight))
    bent[7 + body.dof_index("L_Wrist_x")] = 0.8
    assert not torch.equal(features(bent), features(straight))


def test_captured_clips_start_no_episode(tmp_path):
    """They are not in the task's world; those of an optimisation are."""
    clip = Clip.load(CLIP)
    captured = tmp_path / "captured.npz"
    dataclasses.replace(clip, meta={"source": "somebody"}).save(captured)
    assert load_placed_starts((captured,), 0.5) is None
    both = load_placed_starts((captured, CLIP), 0.5)
    assert both is not None
    assert torch.equal(both.qpos, load_starts((CLIP,), 0.5).qpos)


def test_options_of_the_style_need_the_style(tmp_path, capsys):
    args = ["long_jump", "--out", str(tmp_path / "run"), "--amp.style", "0.3"]
    assert main(args) == 2
    assert "--algo amp" in capsys.readouterr().err
