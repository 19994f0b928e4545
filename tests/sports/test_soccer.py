"""The rules of one against one and two against two on states made by hand, and who sees what."""

from __future__ import annotations

import math

import pytest
import torch

from sports import quaternion
from sports.env import make_env
from sports.physics import PhysicsState, default_state
from sports.task import Advance, Move
from tests.sports.pitch import Pitch, seen_from, total

STANDING = 0.9412
TASKS = ("soccer_1v1", "soccer_2v2")


def match(task="soccer_1v1", ball=(0.0, 0.0, 0.11), vel=(0.0, 0.0, 0.0), **options) -> Pitch:
    pitch = Pitch(task, **options)
    pitch.ball(ball, vel)
    pitch.begin()
    return pitch


def moved_by(step: Advance) -> Move:
    assert step.move is not None
    return step.move


def pos(pitch: Pitch, step: Advance, thing: int | str) -> torch.Tensor:
    """Where a move puts an athlete's root or the ball, world 0."""
    scene = pitch.scene
    at = scene.object_qpos("ball") if thing == "ball" else scene.agent_qpos(int(thing))
    return moved_by(step).qpos[0, at][:7]


# Starts.


@pytest.mark.parametrize("task", TASKS)
def test_the_kick_off(task):
    env = make_env(task, num_worlds=3, training=False)
    places = [(-3.0, 0.0), (3.0, 0.0)]
    if task == "soccer_2v2":
        places = [(-3.0, 0.0), (-8.0, -3.0), (3.0, 0.0), (8.0, 3.0)]
    root = env.physics.body_pos[:, :, 0, :2]
    assert (root - torch.tensor(places)).abs().max() < 1e-6
    ahead = env.physics.body_rot[:, :, 0, 0, 0]  # everybody faces the other half
    assert (ahead + torch.tensor(places)[:, 0].sign()).abs().max() < 1e-6
    assert (env.physics.object_pos - torch.tensor((0.0, 0.0, 0.11))).abs().max() < 1e-6
    assert env.max_steps == 3000 and env.reward_scale == 3.0


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("task", [*TASKS, "basketball_1v1"])
def test_a_ball_at_the_start_does_not_tell_whose_half_it_is(task, training):
    """It is turned in any direction alike: its mean is none, and so is that of any of its axes, in
    units of their spread (1/3 for the square of a component)."""
    env = make_env(task, num_worlds=400, seed=2, training=training)
    rot = quaternion.matrix(env.physics.object_quat[:, 0])
    error = rot.mean(0) / (1.0 / 3.0 / 400) ** 0.5
    assert error.abs().max() < 4.0
    assert ((rot.square().mean(0) - 1.0 / 3.0).abs() < 0.06).all()
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_starts_anywhere_are_on_the_field_and_apart(task):
    env = make_env(task, num_worlds=300, seed=4, options={"uniform": 1.0})
    things = torch.cat((env.physics.body_pos[:, :, 0], env.physics.object_pos), 1)[..., :2]
    assert (things[..., 0].abs() <= 13.0).all() and (things[..., 1].abs() <= 8.0).all()
    assert things[..., 0].abs().max() > 12.5 and things[..., 1].abs().max() > 7.5
    gaps = torch.cdist(things, things) + 99.0 * torch.eye(things.shape[1])
    assert 2.0 - 1e-3 <= gaps.min() < 2.3
    heading = env.view.heading
    yaw = torch.atan2(heading.sin, heading.cos)
    assert yaw.min() < -3.0 and yaw.max() > 3.0
    half = make_env(task, num_worlds=300, seed=4)  # half of them kick off
    kick_off = (half.physics.object_pos[:, 0, :2].norm(dim=-1) < 1e-6).float().mean()
    assert 0.4 < kick_off < 0.6
    with pytest.raises(ValueError, match="share of uniform starts"):
        make_env(task, num_worlds=1, options={"uniform": 1.5})


@pytest.mark.parametrize("task", TASKS)
def test_a_ball_may_start_beside_one_of_the_athletes(task):
    far = {}
    for share in (0.0, 0.75, 1.0):
        env = make_env(task, num_worlds=400, seed=4, options={"uniform": 1.0, "beside": share})
        athletes, ball = env.physics.body_pos[:, :, 0, :2], env.physics.object_pos[:, 0, :2]
        gaps = (athletes - ball[:, None]).norm(dim=-1)
        assert gaps.min() > 2.0 - 1e-3
        assert (ball[:, 0].abs() <= 13.0).all() and (ball[:, 1].abs() <= 8.0).all()
        far[share] = float((gaps.min(1).values > 3.0 + 1e-3).float().mean())
    assert far[1.0] == 0.0 and far[0.75] == pytest.approx(0.25 * far[0.0], abs=0.07)
    nearest = gaps.argmin(1)
    share_of_each = nearest.bincount(minlength=gaps.shape[1]) / len(gaps)
    assert (share_of_each - 1.0 / gaps.shape[1]).abs().max() < 0.08
    way = ball - torch.take_along_dim(athletes, nearest[:, None, None], 1)[:, 0]
    assert (way.sign().mean(0).abs() < 0.2).all()  # on every side of it
    with pytest.raises(ValueError, match="share beside the ball"):
        make_env(task, num_worlds=1, options={"beside": -0.1})


# Who sees what.


def test_everybody_sees_ball_goals_mates_and_opponents():
    pitch = match("soccer_2v2")
    places = [(-3.0, 1.0, 0.4), (-8.0, -3.0, -1.0), (3.0, 2.0, 2.5), (8.0, 3.0, 3.0)]
    for agent, (x, y, yaw) in enumerate(places):
        pitch.stand(agent, x, y, yaw)
        pitch.state.qvel[:, pitch.scene.agent_qvel(agent).start] = 1.0 + agent
    pitch.ball((2.0, -4.0, 0.5), (3.0, 1.0, -2.0))
    got = pitch.features()
    roots = [(x, y, STANDING) for x, y, _ in places]
    for viewer, mate, near, far in ((0, 1, 2, 3), (1, 0, 3, 2), (2, 3, 0, 1), (3, 2, 1, 0)):
        root, yaw = roots[viewer], places[viewer][2]
        side = 1.0 if viewer < 2 else -1.0

        def local(v, yaw=yaw):
            return seen_from(v, (0, 0, 0), yaw)

        def posts(side, root=root, yaw=yaw):
            right = seen_from((16 * side, -2 * side, 0), root, yaw)[:2]
            return right + seen_from((16 * side, 2 * side, 0), root, yaw)[:2]

        want = {
            "ball_position": seen_from((2.0, -4.0, 0.5), root, yaw),
            "ball_rotation": local((1, 0, 0)) + local((0, 1, 0)),
            "ball_velocity": local((3.0, 1.0, -2.0)) + [0.0] * 3,
            "own_goal": posts(-side),
            "other_goal": posts(side),
        }
        for name, other in (("mate1", mate), ("opponent1", near), ("opponent2", far)):
            c, s = math.cos(places[other][2]), math.sin(places[other][2])
            want[f"{name}_position"] = seen_from(roots[other], root, yaw)
            want[f"{name}_rotation"] = local((c, s, 0)) + local((-s, c, 0))
            want[f"{name}_velocity"] = local((1.0 + other, 0, 0)) + [0.0] * 3
        assert list(got) == list(want)
        for name, values in want.items():
            assert got[name][0, viewer].tolist() == pytest.approx(values, abs=2e-3), (viewer, name)


def turned(state: PhysicsState, scene) -> PhysicsState:
    """The field turned by 180 degrees about z, the teams exchanged."""
    out, size = state.clone(), scene.num_agents // 2
    half_turn = torch.tensor((0.0, 0.0, 0.0, 1.0))
    swaps = [(a, (a + size) % (2 * size)) for a in range(2 * size)]
    pairs = [(scene.agent_qpos(a), scene.agent_qpos(b)) for a, b in swaps]
    speeds = [(scene.agent_qvel(a), scene.agent_qvel(b)) for a, b in swaps]
    pairs.append((scene.object_qpos("ball"),) * 2)
    speeds.append((scene.object_qvel("ball"),) * 2)
    for source, target in pairs:
        rows = state.qpos[:, source].clone()
        rows[:, :2] *= -1.0
        rows[:, 3:7] = quaternion.multiply(half_turn.expand(len(rows), 4), rows[:, 3:7])
        out.qpos[:, target] = rows
    for source, target in speeds:
        rows = state.qvel[:, source].clone()
        rows[:, :2] *= -1.0  # the angular velocity is in the body's own frame
        out.qvel[:, target] = rows
    return out


def scattered(scene, places: torch.Tensor, seed: int) -> PhysicsState:
    """Athletes in any attitude and motion about a ball at (n, 3), some lying, some beside it."""
    n = len(places)
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    state = default_state(scene, n, "cpu")
    state.qvel = noise(n, scene.nv)
    ball = scene.object_qpos("ball")
    state.qpos[:, ball.start : ball.start + 3] = places
    state.qvel[:, scene.object_qvel("ball")] *= 6.0
    for a in range(scene.num_agents):
        rows = state.qpos[:, scene.agent_qpos(a)]
        rows[:, :2] = places[:, :2] + 0.7 * noise(n, 2)
        rows[:, 2] = 0.5 + noise(n).abs()
        rows[:, 3:7] = torch.nn.functional.normalize(noise(n, 4), dim=-1)
        rows[:, 7:] = 0.3 * noise(n, 69)
    return state


@pytest.mark.parametrize("task", TASKS)
def test_a_turned_field_with_exchanged_sides_is_the_same_game(task):
    n = 24
    envs = [make_env(task, num_worlds=n, training=False) for _ in range(2)]
    scene = envs[0].physics.scene
    size = scene.num_agents // 2
    swap = [(a + size) % (2 * size) for a in range(2 * size)]
    generator = torch.Generator().manual_seed(3)
    before = torch.randn(n, 3, generator=generator) * torch.tensor((9.0, 6.0, 0.1))
    before[:, 2] = before[:, 2].abs() + 0.11
    after = before + 0.2 * torch.randn(n, 3, generator=generator)
    before[0], after[0] = torch.tensor((15.8, 1.0, 0.5)), torch.tensor((16.4, 1.1, 0.5))
    states = [scattered(scene, places, seed) for seed, places in ((1, before), (2, after))]
    ball = scene.object_qpos("ball")
    steps, features = [], []
    order = [scene.contact_pairs.index(p) for p in swapped_pairs(scene)]
    touch = torch.rand(n, len(order), generator=torch.Generator().manual_seed(5)) < 0.05
    touch[0] = False
    for k, env in enumerate(envs):
        first, second = (turned(s, scene) if k else s for s in states)
        everyone = torch.ones(n, dtype=torch.bool)
        env.physics.reset(everyone, first)
        env.view.refresh()
        env.memory = env.task.begin(env.view, {})
        # Of two that lie equally long the first is helped up first: here none do.
        for agent in range(2 * size):
            env.memory["down"][:, swap[agent] if k else agent] = 40.0 + agent
        env.physics.reset(everyone, second)
        env.view.clock = env.view.clock + 5
        env.view.refresh()
        env.physics.pair_force[:] = (touch[:, order] if k else touch).float()
        steps.append(env.task.advance(env.view, env.memory))
        features.append(env.task.features(env.view, env.memory))
    a, b = steps
    assert a.terms["goal"][0].tolist() == [10.0] * size + [-10.0] * size
    assert all(float(v.abs().max()) > 0 for v in a.terms.values())
    for name, value in features[0].items():
        torch.testing.assert_close(value[:, swap], features[1][name], rtol=0, atol=1e-5)
    for name, value in a.terms.items():
        torch.testing.assert_close(value[:, swap], b.terms[name], rtol=0, atol=1e-5, msg=name)
    assert torch.equal(a.terminated[:, swap], b.terminated)
    assert torch.equal(a.metrics["goals_for"], b.metrics["goals_against"])
    # What moves, moves to the same places.
    assert torch.equal(moved_by(a).mask, moved_by(b).mask)
    assert moved_by(a).mask.sum() > n / 3, moved_by(a).mask
    moved = turned(PhysicsState(moved_by(a).qpos, moved_by(a).qvel, states[1].mocap_pos), scene)
    rows = moved_by(a).mask
    for q in [scene.agent_qpos(i).start for i in range(2 * size)] + [ball.start]:
        here, there = moved.qpos[rows, q : q + 3], moved_by(b).qpos[rows, q : q + 3]
        torch.testing.assert_close(here, there, rtol=0, atol=1e-4)


def swapped_pairs(scene):
    size = scene.num_agents // 2
    for side, ball in scene.contact_pairs:
        agent, _, link = side.partition("/")
        other = f"agent{(int(agent[5:]) + size) % (2 * size)}"
        yield (f"{other}/{link}" if link else other, ball)


# Rewards and goals.


@pytest.mark.parametrize(("x", "plays"), [(0.49, True), (0.51, False)])
def test_who_plays_the_ball_is_paid_for_bringing_it_on(x, plays):
    pitch = match(ball=(0.0, 0.0, 0.11))
    for agent, side in ((0, -1.0), (1, 1.0)):
        pitch.stand(agent, 0.2 + side * x, 0.0, 0.0 if agent == 0 else math.pi)
    pitch.ball((0.2, 0.0, 0.11), (6.0, 2.0, 0.0))
    step = pitch.advance()
    for agent, goal in ((0, (16.0, 0.0, 1.0)), (1, (-16.0, 0.0, 1.0))):
        gained = math.dist((0.0, 0.0, 0.11), goal) - math.dist((0.2, 0.0, 0.11), goal)
        way = [g - b for g, b in zip(goal, (0.2, 0.0, 0.11))]
        speed = max(6.0 * way[0] / math.hypot(*way) / 30.0, 0.0)
        start = 3.0
        before = math.hypot(start, STANDING - 0.11)
        now = math.hypot(x, STANDING - 0.11)
        want = {
            "approach": 0.05 * min(before - now, 1.0),
            "dribble": 0.2 * gained * plays,
            "shot": 0.3 * speed * plays,
            "goal": 0.0,
        }
        for name, value in want.items():
            assert step.terms[name][0, agent] == pytest.approx(value, abs=1e-4), (agent, name)


def test_stepping_back_from_the_ball_costs_nothing():
    pitch = match()
    pitch.stand(0, -4.0, 0.0)
    assert pitch.advance().terms["approach"][0].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("no_circling", [False, True])
def test_who_circles_beside_the_ball_may_earn_nothing(no_circling):
    """Athlete 0 goes round a circle beside the ball, athlete 1 straight to it."""
    pitch, earned = match(no_circling=no_circling), torch.zeros(2)
    for k in range(81):
        turn = 2.0 * math.pi * k / 40
        pitch.stand(0, -3.0 - math.sin(turn), 1.0 - math.cos(turn))
        pitch.stand(1, 3.0 - 0.03 * k, 0.0)
        earned += pitch.advance().terms["approach"][0]
    far, near = (math.hypot(x, STANDING - 0.11) for x in (3.0, 0.6))
    assert earned[1] == pytest.approx(0.05 * (far - near), abs=1e-4)
    if no_circling:
        assert earned[0] == pytest.approx(0.0, abs=1e-4)
    else:
        assert earned[0] > 1.5 * earned[1]


def test_a_ball_that_leaves_costs_nothing_and_one_that_comes_earns_nothing_without_circling():
    pitch = match(no_circling=True)
    for x in (1.0, -2.0):
        pitch.ball((x, 0.0, 0.11))
        assert pitch.advance().terms["approach"][0].tolist() == pytest.approx([0.0, 0.0], abs=1e-6)
    pitch.stand(0, -2.5, 0.0)
    before, now = (math.hypot(x, STANDING - 0.11) for x in (1.0, 0.5))
    earned = pitch.advance().terms["approach"][0]
    assert earned.tolist() == pytest.approx([0.05 * (before - now), 0.0], abs=1e-4)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("at", "goal"), [((1.99, 0.5), 1), ((2.01, 0.5), 0), ((0.0, 1.99), 1), ((0.0, 2.01), 0)]
)
def test_a_goal_counts_at_either_end_for_those_who_attack_it(side, at, goal):
    pitch = match("soccer_2v2", ball=(15.7 * side, *at))
    pitch.ball((16.3 * side, *at), (18.0 * side, 0.0, 0.0))
    step = pitch.advance()
    points = [10.0 * goal * side] * 2 + [-10.0 * goal * side] * 2
    assert step.terms["goal"][0].tolist() == points
    assert step.terminated[0].tolist() == [bool(goal)] * 4
    assert step.metrics["goals_for"][0] == float(goal and side > 0)
    assert step.metrics["goals_against"][0] == float(goal and side < 0)
    assert step.success[0] == bool(goal and side > 0)


def test_a_ball_that_comes_back_out_of_the_plane_is_no_second_goal():
    pitch = match(ball=(16.2, 0.0, 0.5))
    pitch.ball((16.6, 0.0, 0.5))
    assert not pitch.advance().terminated.any()


@pytest.mark.parametrize(("steps", "void"), [(29, True), (30, False)])
def test_a_goal_after_handling_is_void(steps, void):
    pitch = match(ball=(15.0, 0.0, 0.5))
    pitch.stand(0, 14.6, 0.0)
    step = pitch.advance("agent0/L_Hand")
    assert step.metrics["handling"][0] == 1.0
    for _ in range(steps - 1):
        pitch.advance()
    pitch.ball((16.3, 0.0, 0.5), (20.0, 0.0, 0.0))
    step = pitch.advance()
    assert step.terminated.all()
    assert step.terms["goal"][0].tolist() == ([0.0, 0.0] if void else [10.0, -10.0])
    assert step.metrics["goals_for"][0] == float(not void)


def test_handling_by_the_other_side_does_not_save_its_goal():
    pitch = match(ball=(15.9, 0.0, 0.5))
    pitch.ball((16.3, 0.0, 0.5), (20.0, 0.0, 0.0))
    assert pitch.advance("agent1/R_Wrist").terms["goal"][0].tolist() == [10.0, -10.0]


def test_handling_earns_nothing_for_a_second():
    pitch = match()
    pitch.stand(0, -0.3, 0.0)
    pitch.advance("agent0/R_Hand")
    earned = []
    for k in range(31):
        pitch.ball((0.01 * k, 0.0, 0.11), (6.0, 0.0, 0.0))
        pitch.stand(0, -0.3 + 0.01 * k, 0.0)
        earned.append(float(total(pitch.advance())[0, 0]) > 0)
    assert earned == [False] * 29 + [True] * 2
    # It was one touch; a foot is none.
    assert pitch.advance("agent0/R_Toe").metrics["handling"][0] == 1.0
    assert pitch.advance("agent0/R_Hand").metrics["handling"][0] == 2.0


def test_possession_is_the_share_of_time_since_a_team_touched_it():
    pitch = match()
    assert pitch.advance().metrics["possession"].isnan().all()
    pitch.advance("agent0")
    pitch.advance()
    pitch.advance("agent1")
    step = pitch.advance("agent0", "agent1")  # contested: it stays theirs
    assert step.metrics["possession"][0] == pytest.approx(2 / 4)
    assert pitch.advance("agent0").metrics["possession"][0] == pytest.approx(3 / 5)


# What is put elsewhere.


def test_an_athlete_that_lies_is_put_on_its_feet_after_a_second():
    pitch = match()
    pitch.stand(1, 5.0, 1.0, 2.0, z=0.1)
    for k in range(30):
        step = pitch.advance(down=(1,))
        assert bool(moved_by(step).mask[0]) == (k == 29), k
    root = pos(pitch, step, 1)
    assert root[:3].tolist() == pytest.approx([5.0, 1.0, STANDING], abs=1e-3)
    assert root[3:].tolist() == pytest.approx([math.cos(1.0), 0, 0, math.sin(1.0)], abs=1e-4)
    speeds = moved_by(step).qvel[0, pitch.scene.agent_qvel(1)]
    joints = moved_by(step).qpos[0, pitch.scene.agent_qpos(1)][7:]
    assert speeds.abs().max() == 0.0 and joints.abs().max() == 0.0
    # The other one and the ball stay; who stands does not wait to get up.
    assert pos(pitch, step, 0)[:3].tolist() == pytest.approx([-3.0, 0.0, STANDING], abs=1e-3)
    assert step.metrics["falls"][0] == 0.0  # those of team 0
    # The way to the ball is measured anew from where it stands.
    to_ball = math.dist((5.0, 1.0, STANDING), (0.0, 0.0, 0.11))
    assert step.memory["to_ball"][0, 1] == pytest.approx(to_ball, abs=1e-3)
    assert pitch.env.memory["down"][0].tolist() == [0.0, 0.0]


def test_getting_up_by_itself_starts_the_clock_again():
    pitch = match()
    for _ in range(29):
        pitch.advance(down=(0,))
    assert not moved_by(pitch.advance()).mask.any()
    step = pitch.advance(down=(0,))
    assert not moved_by(step).mask.any() and step.metrics["falls"][0] == 2.0


def test_a_fall_costs_what_is_asked_once_and_whoever_falls():
    assert "fall" not in match().advance(down=(0,)).terms
    pitch = match(fall=1.5)
    costs = [pitch.advance(down=down).terms["fall"][0].tolist() for down in ((), (0,), (0, 1), ())]
    assert costs == [[0.0, 0.0], [-1.5, 0.0], [0.0, -1.5], [0.0, 0.0]]
    with pytest.raises(ValueError, match="must not be negative"):
        match(fall=-1.0)


def test_it_stands_up_where_nobody_is():
    """An opponent at its side, then also the ball at the nearest place beside."""
    for ball in ((0.0, 5.0, 0.11), (4.0 - 1.8, 0.0, 0.11)):
        pitch = match(ball=ball)
        pitch.stand(0, 4.0, 0.0, z=0.1)
        pitch.stand(1, 4.8, 0.0)
        pitch.env.memory["down"][:, 0] = 29.0
        step = pitch.advance(down=(0,))
        x, y = pos(pitch, step, 0)[:2].tolist()
        assert math.hypot(x - 4.0, y) == pytest.approx(1.8, abs=1e-3)
        assert math.hypot(x - 4.8, y) >= 1.8 and math.hypot(x - ball[0], y - ball[1]) >= 0.6


def test_it_stands_up_inside_the_field():
    pitch = match()
    pitch.stand(0, 15.9, 9.8, z=0.1)
    pitch.env.memory["down"][:, 0] = 29.0
    step = pitch.advance(down=(0,))
    assert pos(pitch, step, 0)[:2].tolist() == pytest.approx([15.0, 9.0], abs=1e-4)


def test_two_that_lie_get_up_one_after_the_other():
    pitch = match("soccer_2v2")
    for agent in (1, 3):
        pitch.stand(agent, 6.0 + 0.2 * agent, 0.0, z=0.1)
    pitch.env.memory["down"][:, 1] = 29.0
    pitch.env.memory["down"][:, 3] = 29.0
    first = pitch.advance(down=(1, 3))
    assert first.memory["down"][0].tolist() == [0.0, 0.0, 0.0, 30.0]
    pitch.state.qpos[:] = moved_by(first).qpos
    pitch.state.qvel[:] = moved_by(first).qvel
    second = pitch.advance(down=(3,))
    assert second.memory["down"][0].tolist() == [0.0] * 4
    places = [pos(pitch, second, a)[:2] for a in (1, 3)]
    assert float((places[0] - places[1]).norm()) >= 1.79


@pytest.mark.parametrize("ends", [False, True])
def test_a_fall_ends_the_episode_only_if_asked(ends):
    pitch = match(terminate_on_fall=ends)
    assert pitch.advance(down=(1,)).terminated[0].tolist() == [False, ends]


@pytest.mark.parametrize(
    ("ball", "inside"),
    [
        ((5.0, 10.3, 0.8), None),  # in front of the wall's middle, pressed into it
        ((5.0, 10.3, 1.2), (5.0, 9.78)),  # over it
        ((5.0, -10.6, 0.3), (5.0, -9.78)),  # behind it
        ((16.6, 3.0, 0.3), (15.78, 3.0)),
        ((-16.2, 0.0, 2.5), (-15.78, 0.0)),  # over the bar
        ((15.9, 9.9, 3.0), None),
    ],
)
def test_a_ball_over_a_wall_is_dropped_inside(ball, inside):
    pitch = match(ball=ball)
    pitch.ball(ball, (0.0, 3.0, 1.0))
    step = pitch.advance()
    assert not step.terminated.any()
    assert bool(moved_by(step).mask[0]) == (inside is not None)
    if inside is not None:
        assert pos(pitch, step, "ball")[:3].tolist() == pytest.approx([*inside, 2.0], abs=1e-4)
        assert moved_by(step).qvel[0, pitch.scene.object_qvel("ball")].abs().max() == 0.0
        assert step.memory["ball"][0].tolist() == pytest.approx([*inside, 2.0], abs=1e-4)
