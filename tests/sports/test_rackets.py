"""What tennis and table tennis share: symmetry of the field, independence of the worlds, and play
on the engines."""

from __future__ import annotations

import math

import pytest
import torch

from sports import table_tennis, tennis
from sports.ball import landing
from sports.env import Env, make_env
from sports.physics import default_state
from tests.sports.rackets_made import HandMadeRally

GAMES = {"tennis": tennis.GAME, "table_tennis": table_tennis.GAME}
TASKS = ("tennis", "tennis_1v1", "table_tennis", "table_tennis_1v1")
SPEEDS = {"tennis": (20.0, 2.0, 6.0), "table_tennis": (5.0, 0.5, 2.0)}
"""Largest velocities of the ball in the tests (m/s)."""
N = 48
HALF_TURN = torch.tensor((-1.0, -1.0, 1.0))


def scramble(world: HandMadeRally, sport: str, seed: int) -> None:
    """Athletes in all attitudes about their places, the ball anywhere in play."""
    generator = torch.Generator().manual_seed(seed)
    n, scene = world.env.num_worlds, world.scene

    def some(*shape):
        return 2 * torch.rand(*shape, generator=generator) - 1

    for agent in range(scene.num_agents):
        q, v = world.state.qpos[:, scene.agent_qpos(agent)], world.state.qvel
        q[:, 0:2] += 0.5 * some(n, 2)
        q[:, 2] += 0.1 * some(n).abs()
        turn = torch.nn.functional.normalize(q[:, 3:7] + 0.2 * some(n, 4), dim=-1)
        q[:, 3:7] = turn
        q[:, 7:] = 0.3 * some(n, q.shape[1] - 7)
        v[:, scene.agent_qvel(agent)] = some(n, scene.body.num_dofs + 6)
    move_ball(world, sport, generator)


def move_ball(world: HandMadeRally, sport: str, generator: torch.Generator) -> None:
    court, n = GAMES[sport].court, world.env.num_worlds
    share = torch.rand(n, 6, generator=generator)
    wide = torch.tensor((court.half_length, court.half_width, court.ceiling / 2))
    pos = (2 * share[:, :3] - 1) * wide
    pos[:, 2] = court.height + pos[:, 2].abs()
    world.put_ball(pos, (2 * share[:, 3:] - 1) * torch.tensor(SPEEDS[sport]))


def random_touches(world: HandMadeRally, sport: str, generator: torch.Generator) -> None:
    """In some worlds the ball meets the surface or a racket, mostly by the rules."""
    court, physics, n = GAMES[sport].court, world.env.physics, world.env.num_worlds
    for name in ("ground" if sport == "tennis" else "table", "racket0", "racket1"):
        if name not in [s.name for s in world.scene.surfaces]:
            continue
        s = world.scene.surface_index(name)
        draw = torch.rand(n, 5, generator=generator)
        hit = draw[:, 0] < 0.3
        spot = (2 * draw[:, 1:4] - 1) * torch.tensor((court.half_length, court.half_width, 0.0))
        if name != "ground" and name != "table":
            spot[:, 0] = spot[:, 0].abs() * (1.0 if name == "racket0" else -1.0)
        spot[:, 2] = court.height + 0.02
        physics.ball_hits[:, s] = hit.int()
        physics.ball_hit_time[:, s] = torch.where(hit, 0.03 * draw[:, 4], torch.inf)
        physics.ball_hit_pos[:, s] = spot


def turn_round(there: HandMadeRally, here: HandMadeRally) -> None:
    """The state and touches of ``here`` with the field turned by 180 degrees about z and the
    athletes swapped."""
    scene, state = here.scene, here.state
    for agent in range(2):
        q, v = scene.agent_qpos(agent), scene.agent_qvel(agent)
        to_q, to_v = scene.agent_qpos(1 - agent), scene.agent_qvel(1 - agent)
        pose, speed = state.qpos[:, q].clone(), state.qvel[:, v].clone()
        pose[:, :3] *= HALF_TURN
        pose[:, 3:7] = half_turn(pose[:, 3:7])
        speed[:, :3] *= HALF_TURN  # the angular velocity is in the root's own frame
        there.state.qpos[:, to_q], there.state.qvel[:, to_v] = pose, speed
    q, v = scene.object_qpos("ball"), scene.object_qvel("ball")
    ball, speed = state.qpos[:, q].clone(), state.qvel[:, v].clone()
    ball[:, :3] *= HALF_TURN
    ball[:, 3:7] = half_turn(ball[:, 3:7])
    speed[:, :3] *= HALF_TURN
    there.state.qpos[:, q], there.state.qvel[:, v] = ball, speed
    names = [s.name for s in scene.surfaces]
    swapped = {"racket0": "racket1", "racket1": "racket0"}
    order = [names.index(swapped.get(name, name)) for name in names]
    a, b = here.env.physics, there.env.physics
    b.ball_hits, b.ball_hit_time = a.ball_hits[:, order], a.ball_hit_time[:, order]
    b.ball_hit_pos = a.ball_hit_pos[:, order] * HALF_TURN


def half_turn(quat: torch.Tensor) -> torch.Tensor:
    """A half turn about z after a rotation."""
    w, x, y, z = quat.unbind(-1)
    return torch.stack((-z, -y, x, w), -1)


@pytest.mark.parametrize("sport", ["tennis", "table_tennis"])
def test_both_ends_of_the_court_are_alike(sport):
    """Field turned by 180 degrees, athletes swapped: observations, rewards and results swap."""
    here, there = HandMadeRally(f"{sport}_1v1", N), HandMadeRally(f"{sport}_1v1", N)
    generator = torch.Generator().manual_seed(2)
    scramble(here, sport, 1)
    luck = here.luck(3)
    turn_round(there, here)
    here.start(luck)
    there.start(luck[..., [0, 1, 2, 3, 4, 7, 8, 5, 6]])
    seen = {"struck": 0, "over": 0, "paid": 0}
    for _ in range(8):
        assert torch.allclose(here.observe(), there.observe().flip(1), atol=1e-5)
        move_ball(here, sport, generator)
        random_touches(here, sport, generator)
        turn_round(there, here)
        steps = []
        for world in (here, there):
            world._apply()
            world.env.view.clock = world.env.view.clock + 1
            step = world.env.task.advance(world.env.view, world.env.memory)
            world.env.memory = step.memory
            steps.append(step)
        a, b = steps
        assert torch.equal(a.terminated, b.terminated.flip(1))
        assert torch.equal(a.success, b.success)
        for name, term in a.terms.items():
            assert torch.allclose(term, b.terms[name].flip(1), atol=1e-5), name
        for name, value in a.metrics.items():
            other = {"points_0": "points_1", "points_1": "points_0"}.get(name, name)
            assert torch.allclose(value, b.metrics[other], atol=1e-5, equal_nan=True), name
        seen["struck"] += int(a.memory["strokes"].sum())
        seen["over"] += int(a.terminated.sum())
        seen["paid"] += int((a.terms["landing"] > 0).sum())
    assert min(seen.values()) > 5, seen  # the comparison was about something


@pytest.mark.parametrize("task", TASKS)
def test_a_permutation_of_the_worlds_permutes_everything(task):
    sport = task.removesuffix("_1v1")
    here, there = HandMadeRally(task, N), HandMadeRally(task, N)
    order = torch.randperm(N, generator=torch.Generator().manual_seed(4))
    generator = torch.Generator().manual_seed(5)
    scramble(here, sport, 6)
    luck = here.luck(7)

    def copy() -> None:
        there.state.qpos, there.state.qvel = here.state.qpos[order], here.state.qvel[order]
        a, b = here.env.physics, there.env.physics
        for name in ("ball_hits", "ball_hit_time", "ball_hit_pos"):
            setattr(b, name, getattr(a, name)[order])

    copy()
    here.start(luck)
    there.start(luck[order])
    again = 0
    for _ in range(8):
        # Cosines of the headings of two athletes differ in the last bit with their place in memory.
        assert torch.allclose(here.observe()[order], there.observe(), rtol=0, atol=1e-5)
        move_ball(here, sport, generator)
        random_touches(here, sport, generator)
        copy()
        steps = []
        for world in (here, there):
            world._apply()
            world.env.view.clock = world.env.view.clock + 1
            step = world.env.task.advance(world.env.view, world.env.memory)
            world.env.memory = step.memory
            steps.append(step)
        a, b = steps
        assert torch.equal(a.terminated[order], b.terminated)
        for kind in ("terms", "metrics", "memory"):
            for name, value in getattr(a, kind).items():
                pair = value[order], getattr(b, kind)[name]
                assert torch.equal(*(torch.nan_to_num(x, 7.0) for x in pair)), (kind, name)
        if a.move is not None:
            assert b.move is not None and torch.equal(a.move.mask[order], b.move.mask)
            assert torch.equal(a.move.qpos[order], b.move.qpos)
            assert torch.equal(a.move.qvel[order], b.move.qvel)
            again += int(a.move.mask.sum())
    assert again > 0 or task.endswith("1v1")


# On the engines: a ball that meets a racket held still in its way.

SHOTS = {
    # Place of the athlete, tilt of the racket (rad), speed of the ball (m/s).
    "tennis": ((4.0, 0.0), math.radians(75.0), 18.0),
    "table_tennis": ((2.0, -0.5), math.radians(80.0), 9.0),
}


def block(task: str, engine: str = "mujoco", **options) -> tuple[Env, torch.Tensor]:
    """An athlete with the right arm stretched out and a ball flying at the racket; the action that
    holds the pose."""
    sport = task.removesuffix("_1v1")
    place, tilt, speed = SHOTS[sport]
    env = make_env(task, engine=engine, num_worlds=1, training=False, physics_options=options)
    physics = env.physics
    scene, body = physics.scene, physics.scene.body
    wrist = body.dof_index("R_Wrist_y")
    state = default_state(scene, 1, "cpu")
    state.qpos[:, :2] = torch.tensor(place)
    state.qpos[:, 7 + wrist] = tilt
    q, v = scene.object_qpos("ball"), scene.object_qvel("ball")
    racket = torch.tensor((place[0] + 0.07, place[1] + 0.683 + GAMES[sport].reach, 1.384))
    state.qpos[:, q.start : q.start + 3] = racket - torch.tensor((speed / 15, 0.0, 0.0))
    state.qvel[:, v.start : v.start + 3] = torch.tensor((speed, 0.0, 0.3))
    physics.reset(torch.tensor([True]), state)
    env.view.refresh()
    luck = torch.rand(1, 16, 9, generator=torch.Generator().manual_seed(1))
    env.memory = env.task.begin(env.view, {"luck": luck})
    env.memory["bounced"][:] = True
    action = torch.zeros(1, env.num_agents, env.action_size)
    action[0, 0, wrist] = tilt / math.pi
    return env, action


@pytest.mark.parametrize("sport", ["tennis", "table_tennis"])
def test_a_block_is_a_return_and_the_machine_plays_on(sport):
    env, action = block(sport, threads=1)
    physics, game = env.physics, GAMES[sport]
    spots, bounced_at, again = [], None, None
    for _ in range(90):
        step = env.step(action)
        assert not step.terminated.any()
        if step.terms["landing"][0, 0] > 0:
            assert step.terms["landing"][0, 0] >= 1.0 and step.terms["approach"][0, 0] == 0.0
            flight = [physics.object_pos, physics.object_linvel, physics.object_angvel]
            height = game.court.height + game.radius
            spots.append(landing(game.law, *(x[:, 0] for x in flight), height)[0][0])
        if physics.ball_hits[0, 0] and bounced_at is None:
            bounced_at = physics.ball_hit_pos[0, 0].clone()
            assert step.metrics["hits"][0] == 1.0
        if env.memory["balls"][0] == 2:
            again = physics.object_pos[0, 0].clone()
            break
    assert bounced_at is not None and len(spots) > 15
    for spot in spots:  # what the reward looked ahead to is what came
        assert torch.allclose(spot, bounced_at, atol=0.01)
    assert again is not None and again[0] == game.serve.x
    # The next ball comes down where the machine aimed.
    q, bounces = physics.scene.object_qpos("ball"), 0
    for _ in range(60):
        step = env.step(action)
        if physics.ball_hits[0, 0]:
            bounces += 1
            spot = physics.ball_hit_pos[0, 0]
            (near, far), (right, left) = game.serve.land_x, game.serve.land_y
            assert near - 0.01 < spot[0] < far + 0.01 and right - 0.01 < spot[1] < left + 0.01
            break
    assert bounces == 1 and q.start > 0


@pytest.mark.parametrize("sport", ["tennis", "table_tennis"])
def test_a_ball_that_rests_on_the_racket_is_lost(sport):
    """Dropped on a level racket: it bounces up, legally so far, and comes down on it again."""
    env, action = block(sport, threads=1)
    physics, scene = env.physics, env.physics.scene
    state = default_state(scene, 1, "cpu")
    state.qpos[:, 0] = 5.0
    q = scene.object_qpos("ball")
    reach = GAMES[sport].reach
    state.qpos[0, q.start : q.start + 3] = torch.tensor((5.075, 0.683 + reach, 1.384 + 0.15))
    if sport == "table_tennis":  # beside the table's end, so that nothing else is in the way
        state.qpos[0, 0], state.qpos[0, q.start] = 2.5, 2.575
    physics.reset(torch.tensor([True]), state)
    env.view.refresh()
    env.memory["ball"] = physics.object_pos[:, 0].clone()
    contacts, paid = 0, 0.0
    for _ in range(40):
        step = env.step(torch.zeros_like(action))
        paid += float(step.terms["landing"].sum())
        contacts += 1
        if step.terminated[0, 0]:
            break
    assert step.terminated[0, 0] and step.metrics["contacts"][0] == 1.0
    assert 5 < contacts < 30 and paid == 0.0 and step.metrics["hits"][0] == 0.0


@pytest.mark.parametrize("task", ["tennis", "table_tennis_1v1"])
def test_both_mujocos_play_the_same_second(task):
    """A stroke and what follows: impacts, rewards and the ball's place after 30 steps."""
    pytest.importorskip("mujoco_warp")
    runs = []
    for engine, options in (("mujoco", {"threads": 1}), ("warp", {"device": "cpu"})):
        env, action = block(task, engine, **options)
        rewards, hits = [], []
        for _ in range(30):
            step = env.step(action)
            rewards.append(step.reward[0].clone())
            hits.append(env.physics.ball_hits[0].clone())
        runs.append((torch.stack(rewards), torch.stack(hits), env.physics.object_pos[0, 0].clone()))
        env.close()
    (reward, hits, ball), (other_reward, other_hits, other_ball) = runs
    assert torch.equal(hits, other_hits) and hits[:, -env.num_agents].sum() >= 1
    assert torch.allclose(reward, other_reward, atol=2e-3) and reward.max() >= 1.0
    assert torch.allclose(ball, other_ball, atol=5e-3)
