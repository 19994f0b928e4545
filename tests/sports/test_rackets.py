"""What tennis and table tennis share: symmetry of the field, independence of the worlds, and play
on the engines."""

from __future__ import annotations

import pytest
import torch

from sports import table_tennis, tennis
from tests.sports.rackets_made import HandMadeRally, made

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
