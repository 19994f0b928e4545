"""Both duels: on guard, the opponent seen, points by hand-made hits, symmetry, three engines."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sports import boxing, combat, fencing
from sports.env import make_env, make_scene
from sports.physics import PhysicsState, default_state, make_physics
from tests.sports.bout import Bout, swapped

pytestmark = pytest.mark.parametrize("task", ["fencing", "boxing"])
WEAPONS = {"boxing": boxing.GLOVES, "fencing": fencing.SWORD}


def scattered(env, seed: int) -> PhysicsState:
    """Athletes near each other in poses and motion of all kinds."""
    scene, n = env.physics.scene, env.num_worlds
    generator = torch.Generator().manual_seed(seed)
    state = default_state(scene, n, "cpu")
    for agent in range(2):
        q, v = scene.agent_qpos(agent), scene.agent_qvel(agent)
        own = state.qpos[:, q]
        own[:, :2] = 0.6 * torch.randn(n, 2, generator=generator)
        own[:, 3:7] = torch.nn.functional.normalize(
            own[:, 3:7] + 0.3 * torch.randn(n, 4, generator=generator)
        )
        own[:, 7:] += 0.3 * torch.randn(n, 69, generator=generator)
        state.qvel[:, v] = torch.randn(n, 75, generator=generator)
    return state


def test_the_guard_is_set_on_the_ground_and_faces_the_opponent(task):
    bout = Bout(task)
    bout.begin()
    physics = bout.env.physics
    low = -physics.extent(torch.tensor((0.0, 0.0, -1.0)))[0]
    feet = [bout.body.link_index(f"{side}_{foot}") for side in "LR" for foot in ("Ankle", "Toe")]
    assert low[:, feet].sub(0.005).abs().max() < 0.002
    ahead = bout.env.view.heading.local(physics.body_rot[:, :, 0, :, 0])
    assert torch.allclose(ahead, torch.tensor((1.0, 0.0, 0.0)).expand(1, 2, 3), atol=1e-6)
    assert physics.body_pos[0, :, 0, 0].tolist() == [-1.5, 1.5]


def test_action_zero_holds_the_guard(task):
    """10 s on their feet, also from starts with noise: nobody falls or leaves."""
    env = make_env(task, num_worlds=3, seed=2)
    env.age.zero_()
    start = env.physics.body_pos.clone()
    action = torch.zeros(3, 2, 69)
    for i in range(299):
        result = env.step(action)
        assert not result.ended.any(), i
        if i == 59:  # 2 s
            moved = (env.physics.body_pos - start).norm(dim=-1)
            assert moved[:, :, 0].max() < 0.05 and moved.max() < 0.15


def test_features_have_the_names_and_sizes_of_the_page(task):
    env = make_env(task, num_worlds=1)
    sizes = {name: s.stop - s.start for name, s in env.obs_slices.items() if "goal" in name}
    expected = {
        "goal/opponent_pos": 3,
        "goal/opponent_rot": 6,
        "goal/opponent_linvel": 3,
        "goal/opponent_body_pos": 72,
        "goal/opponent_body_linvel": 72,
        "goal/targets": 15 if task == "fencing" else 30,
        "goal/own_force": 24,
        "goal/opponent_force": 24,
    } | ({"goal/bounds": 4} if task == "fencing" else {})
    assert list(sizes.items()) == list(expected.items())
    assert sum(sizes.values()) == {"fencing": 223, "boxing": 234}[task]
    assert env.obs_size == 358 + sum(sizes.values())


def test_the_opponent_as_seen(task):
    """3 m ahead, turned by 180 degrees; its own left is the athlete's right."""
    bout = Bout(task)
    bout.move(0, 1.0, 0.5, 0.0)
    bout.move(1, -2.0, 0.25, 0.1)
    bout.begin()
    seen = {name: value[0] for name, value in bout.features().items()}
    head, foot = (bout.body.link_index(name) for name in ("Head", "L_Ankle"))
    pos = bout.env.physics.body_pos[0]
    views = (  # opponent's velocity, the same relative to the own, half a turn or none
        (0, (-2, 0.25, 0.1), (-3, -0.25, 0.1), 1),
        (1, (-1, -0.5, 0), (-3, -0.25, -0.1), -1),
    )
    for agent, velocity, relative, sign in views:
        assert seen["opponent_pos"][agent].tolist() == pytest.approx((3, 0, 0), abs=1e-5)
        assert seen["opponent_rot"][agent].tolist() == pytest.approx((-1, 0, 0, 0, -1, 0), abs=1e-5)
        assert seen["opponent_linvel"][agent].tolist() == pytest.approx(velocity, abs=1e-5)
        linvel = seen["opponent_body_linvel"][agent].view(24, 3)[head]
        assert linvel.tolist() == pytest.approx(relative, abs=1e-5)
        x, y, z = (pos[1 - agent, foot] - pos[agent, 0]).tolist()
        place = seen["opponent_body_pos"][agent].view(24, 3)[foot]
        assert place.tolist() == pytest.approx((sign * x, sign * y, z), abs=1e-5)


def test_forces_are_shown_in_body_weights(task):
    bout = Bout(task)
    bout.begin()
    weight, chest = bout.body.mass * 9.81, bout.body.link_index("Chest")
    bout.env.physics.link_force[:, 1, chest] = torch.tensor((0.6, 0.0, -0.8)) * 2.0 * weight
    bout.env.physics.link_force[:, 0, 3, 1] = 50.0 * weight
    seen = bout.features()
    assert seen["own_force"][0, 1, chest] == pytest.approx(4.0, rel=1e-5)
    assert seen["opponent_force"][0, 0, chest] == pytest.approx(4.0, rel=1e-5)
    assert seen["own_force"][0, 0, 3] == seen["opponent_force"][0, 1, 3] == 100.0
    assert float(seen["own_force"].sum()) == pytest.approx(104.0, rel=1e-5)


@pytest.mark.parametrize("degrees", [0, 30, 90, 180])
def test_facing_falls_with_the_angle(task, degrees):
    """Turning the back, or lying with the head elsewhere, is paid little."""
    bout = Bout(task)
    bout.place(0, -1.0, yaw=math.radians(degrees))
    bout.begin()
    facing = bout.step().terms["facing"][0]
    expected = 0.1 * math.exp(-2 * (1 - math.cos(math.radians(degrees))))
    assert facing.tolist() == pytest.approx([expected, 0.1], abs=1e-6)


@pytest.mark.parametrize(
    ("velocity", "expected"),
    [
        ((-0.1, 0), 0.0),
        ((0.0, 0), 0.0),
        ((0.5, 0), 0.1 * math.exp(-1.0)),
        ((1.0, 0), 0.1),
        ((3.0, 0), 0.1),
        ((0.0, 2.0), 0.0),
        ((-1e-3, 2.0), 0.0),
    ],
)
def test_only_the_way_towards_the_opponent_is_paid(task, velocity, expected):
    """Walking round the opponent, or away from it, is not."""
    bout = Bout(task)
    bout.move(0, *velocity, 0.0)
    bout.begin()
    term = bout.step().terms["velocity"][0]
    assert term.tolist() == pytest.approx([expected, 0.0], abs=1e-6)


def test_the_way_is_that_to_the_opponent_wherever_one_looks(task):
    bout = Bout(task)
    bout.place(0, 0.0, 0.0, yaw=2.0)
    bout.place(1, 0.6, 0.8, yaw=0.3)
    bout.move(0, 0.6 * 0.7, 0.8 * 0.7, 0.5)
    bout.begin()
    assert bout.step().terms["velocity"][0, 0] == pytest.approx(0.1 * math.exp(-4 * 0.09), abs=1e-6)


@pytest.mark.parametrize(("distance", "target"), [(0.0, "Chest"), (0.2, "Head"), (0.5, "Pelvis")])
def test_strike_is_paid_by_the_nearest_target(task, distance, target):
    """The targets' origins lie apart, so the distance to the one that is aimed at is the least only
    where it is small; else the nearest is found by hand."""
    bout = Bout(task)
    bout.reach_out(distance, target)
    bout.begin()
    origins = bout.body.zero_pose_origins()
    aim = origins[bout.body.link_index(target)]
    others = [origins[bout.body.link_index(name)] - aim for name in combat.TARGETS]
    least = min(float(np.linalg.norm(np.add((distance, 0, 0), v))) for v in others)
    strike = bout.step().terms["strike"][0, 0]
    assert strike == pytest.approx(0.6 * math.exp(-10 * least**2), abs=2e-5)


@pytest.mark.parametrize(("newtons", "counts"), [(49.0, 0.0), (51.0, 1.0)])
def test_a_touch_needs_50_newtons(task, newtons, counts):
    bout = Bout(task)
    bout.reach_out(0.2)
    bout.begin()
    step = bout.step((0, newtons))
    assert step.terms["point"][0].tolist() == [counts, -counts]
    assert step.metrics["touches_for"][0] == counts and step.metrics["touches_against"][0] == 0.0


@pytest.mark.parametrize(("distance", "counts"), [(0.315, 1.0), (0.318, 0.0)])
def test_a_touch_needs_the_point_near_the_target(task, distance, counts):
    bout = Bout(task)
    bout.reach_out(distance)
    bout.begin()
    assert bout.step((0, 500.0)).terms["point"][0].tolist() == [counts, -counts]
    # Near the chest is not near the pelvis.
    bout.begin()
    assert bout.step((0, 500.0, "Pelvis")).terms["point"][0, 0] == 0.0


def test_a_blow_that_is_off_again_counts(task):
    """The force is that of any substep: near at either end of the step will do."""
    bout = Bout(task)
    bout.reach_out(0.3)
    bout.begin()
    bout.reach_out(0.5)
    assert bout.step((0, 500.0)).terms["point"][0, 0] == 1.0
    assert bout.step((0, 500.0)).terms["point"][0, 0] == 0.0


@pytest.mark.parametrize("target", combat.TARGETS)
def test_every_target_counts_for_both(task, target):
    """Also where both touch in one step: then nobody gains."""
    for agents in ((0,), (1,), (0, 1)):
        bout = Bout(task)
        bout.begin()
        bout.env.memory["squares"].zero_()  # near before the step
        point = bout.step(*((agent, 80.0, target) for agent in agents)).terms["point"][0]
        expected = [float(0 in agents) - float(1 in agents)]
        assert point.tolist() == [expected[0], -expected[0]]
        assert bout.env.memory["touches"][0].tolist() == [float(a in agents) for a in range(2)]


@pytest.mark.parametrize(("free", "counts"), [(12, 0.0), (14, 0.0), (15, 1.0), (18, 1.0)])
def test_the_next_point_needs_half_a_second_without_contact(task, free, counts):
    """0.4 s and 0.47 s are too short, 0.5 s and 0.6 s are not."""
    bout = Bout(task)
    bout.reach_out(0.2)
    bout.begin()
    assert bout.step((0, 200.0)).terms["point"][0, 0] == 1.0
    for _ in range(free):
        assert bout.step().terms["point"][0, 0] == 0.0
    assert bout.step((0, 200.0)).terms["point"][0, 0] == counts


def test_pushing_scores_once(task):
    """Two seconds of contact, with breaks that are too short, and then touched lightly: one point.
    A light touch before the first point does no harm."""
    bout = Bout(task)
    bout.reach_out(0.2)
    bout.begin()
    points = [float(bout.step((0, 30.0)).terms["point"][0, 0])]
    for i in range(60):
        hits = [(0, 300.0)] if i % 10 < 6 else []
        points.append(float(bout.step(*hits).terms["point"][0, 0]))
    for _ in range(20):
        points.append(float(bout.step((0, 5.0)).terms["point"][0, 0]))
    points.append(float(bout.step((0, 300.0)).terms["point"][0, 0]))
    assert points[:2] == [0.0, 1.0] and sum(points) == 1.0


def test_who_holds_earns_nothing_until_both_have_stepped_apart(task):
    """A second of closeness without a pause is holding; a little more distance does not end it."""

    def place(distance: float) -> None:
        for athlete in range(2):
            bout.place(athlete, (athlete - 0.5) * distance, yaw=athlete * math.pi)

    def at(distance: float, steps: int) -> None:
        place(distance)
        for _ in range(steps):
            bout.step()

    def struck(distance: float) -> tuple[bool, bool]:
        """Whether nearness pays both there, and whether a blow is a point."""
        bout.env.memory["wait"][:] = 0.0
        bout.env.memory["squares"][:] = 0.01  # so that a blow is one at any distance
        place(distance)
        step = bout.step((0, 60.0))
        paid = step.terms["strike"][0] > 0.0
        assert paid[0] == paid[1]
        return bool(paid[0]), bool(step.terms["point"][0, 0] > 0.0)

    bout = Bout(task)
    place(1.0)
    bout.begin()
    at(0.59, 29)
    at(0.61, 1)
    at(0.59, 28)
    for distance, free in (
        (0.59, True),
        (0.59, False),  # a second
        (0.7, False),
        (0.89, False),
        (0.91, True),
        (0.59, True),
    ):
        assert struck(distance) == (free, free), distance


def test_a_referee_parts_who_hold_and_the_bout_goes_on(task):
    """In the world that held for a second, and there alone; points stay, a blow counts again."""
    options = {"part": True, "reach": 2.0}
    env = make_env(task, num_worlds=2, options=options, training=False)
    env.reset()
    scene, physics = env.physics.scene, env.physics
    guard = physics.qpos.clone()
    bent = 0.8 * torch.randn(2, scene.body.num_dofs, generator=torch.Generator().manual_seed(0))
    state = PhysicsState(guard.clone(), torch.full_like(physics.qvel, 0.1), physics.mocap_pos)
    for agent in range(2):
        at = scene.agent_qpos(agent)
        state.qpos[0, at.start] = (agent - 0.5) * 0.5
        state.qpos[0, at.start + 7 : at.stop] += bent[agent]
    physics.reset(torch.ones(2, dtype=torch.bool), state)
    env.view.refresh()
    env.memory = env.task.begin(env.view, {}) | {"touches": torch.tensor([[2.0, 1.0]] * 2)}
    steps = [env.task.advance(env.view, env.memory) for _ in range(1)]
    for _ in range(29):
        assert not steps[-1].move.mask.any()
        env.memory = steps[-1].memory
        steps.append(env.task.advance(env.view, env.memory))
    last = steps[-1]
    assert last.move.mask.tolist() == [True, False]
    physics.move(last.move.mask, last.move.qpos, last.move.qvel)
    start = default_state(scene, 2, "cpu").qpos
    for agent in range(2):  # back on guard but for 0.03 of the way, 0.02 rad at most
        at = scene.agent_qpos(agent)
        start[0, at.start + 7 : at.stop] += (0.03 * bent[agent]).clamp(-0.02, 0.02)
    torch.testing.assert_close(physics.qpos[0], start[0])
    assert torch.equal(physics.qpos[1], state.qpos[1]) and (physics.qvel[0] == 0.0).all()
    assert torch.equal(physics.qvel[1], state.qvel[1])
    env.view.refresh()
    env.memory = last.memory
    physics.pair_force[:] = 300.0
    after = env.task.advance(env.view, env.memory)
    assert not after.move.mask.any() and after.terms["point"][0].abs().max() == 0.0  # out of reach
    assert after.memory["touches"].tolist() == [[2.0, 1.0]] * 2
    assert after.memory["close_steps"][0] == 0.0 and not after.memory["holding"].any()
    # The way back on guard is no step away, nor is the way from there one that was gone before.
    assert last.memory["gap"][0].isinf().all() and after.memory["gap"].isfinite().all()
    assert not last.terms["reach"][0].any() and not after.terms["reach"][0].any()


def test_each_athlete_has_its_own_half_second(task):
    bout = Bout(task)
    bout.begin()
    bout.env.memory["squares"].zero_()
    assert bout.step((0, 100.0)).terms["point"][0].tolist() == [1.0, -1.0]
    bout.env.memory["squares"].zero_()
    assert bout.step((1, 100.0)).terms["point"][0].tolist() == [-1.0, 1.0]


def test_only_weapons_on_the_opponent_are_asked_about(task):
    """Neither feet nor the own body nor a blade's side can score: no pair names them."""
    scene = make_scene(task)
    weapons = {"fencing": ["R_Hand:1"], "boxing": ["L_Hand", "R_Hand"]}[task]
    expected = {
        (f"agent{a}/{weapon}", f"agent{1 - a}/{target}")
        for a in range(2)
        for weapon in weapons
        for target in ("Pelvis", "Torso", "Spine", "Chest", "Head")
    }
    assert set(scene.contact_pairs) == expected
    assert len(scene.contact_pairs) == len(expected) == (10 if task == "fencing" else 20)


@pytest.mark.parametrize("agent", [0, 1])
def test_who_falls_has_lost_and_the_other_is_cut_off(task, agent):
    """Whoever leads gains nothing by lying down."""
    bout = Bout(task)
    bout.begin()
    bout.env.memory["touches"][:, agent] = 3.0
    standing = bout.step(ground={(agent, "L_Hand"): 49.0, (agent, "L_Toe"): 900.0})
    assert not standing.terminated.any()
    assert standing.metrics["success"][0] == float(agent == 0)
    assert standing.metrics["draw"][0] == 0.0
    step = bout.step(ground={(agent, "L_Hand"): 51.0})
    assert step.terminated[0].tolist() == [agent == 0, agent == 1]
    assert step.metrics["success"][0] == float(agent == 1) == float(step.success[0])
    assert step.metrics["fell"][0] == float(agent == 0)
    assert step.metrics["opponent_fell"][0] == float(agent == 1)


def test_the_environment_cuts_the_other_off(task):
    env = make_env(task, num_worlds=2, training=False)
    action = torch.zeros(2, 2, 69)
    env.step(action)
    qpos, q = env.physics.qpos.clone(), env.physics.scene.agent_qpos(1)
    qpos[1, q.start + 2] = 0.1
    env.physics.move(torch.tensor([False, True]), qpos, env.physics.qvel.clone())
    result = env.step(action)
    assert result.terminated.tolist() == [[False, False], [False, True]]
    assert result.truncated.tolist() == [[False, False], [True, False]]
    assert result.metrics["success"].tolist() == [0.0, 1.0]


def test_more_touches_win_and_as_many_are_a_draw(task):
    bout = Bout(task, num_worlds=4)
    bout.begin()
    bout.env.memory["touches"][:] = torch.tensor([[2.0, 1.0], [1.0, 1.0], [0.0, 1.0], [2.0, 1.0]])
    bout.show()
    bout.env.physics.ground_force[3, :, 0, 2] = 500.0  # both fall: the touches decide
    bout.env.view.clock += 1
    step = bout.env.task.advance(bout.env.view, bout.env.memory)
    assert step.metrics["success"].tolist() == [1.0, 0.0, 0.0, 1.0]
    assert step.metrics["draw"].tolist() == [0.0, 1.0, 0.0, 0.0]
    assert step.terminated.tolist() == [[False, False]] * 3 + [[True, True]]


def test_half_a_turn_with_the_athletes_exchanged_changes_nothing(task):
    """Observations and rewards of states of all kinds, with contacts made up."""
    env = make_env(task, num_worlds=16, options={"part": True}, training=False)
    scene, physics = env.physics.scene, env.physics
    state, everyone = scattered(env, 5), torch.ones(16, dtype=torch.bool)
    state.qpos[3, 2] = 0.2  # has fallen
    qpos, qvel = swapped(state.qpos, state.qvel, scene)
    generator = torch.Generator().manual_seed(1)
    forces = 100.0 * torch.rand(16, 2, len(scene.contact_pairs) // 2, generator=generator)
    forces = forces * (torch.rand(forces.shape, generator=generator) < 0.2)
    felt = 500.0 * torch.randn(16, 2, 24, 3, generator=generator)
    half = torch.tensor((-1.0, -1.0, 1.0))
    results = []
    for turn, (q, v) in enumerate(((state.qpos, state.qvel), (qpos, qvel))):
        physics.reset(everyone, PhysicsState(q, v, state.mocap_pos))
        env.view.refresh()
        env.memory = env.task.begin(env.view, {})
        env.memory["squares"][:8] = 0.0  # every contact is near enough
        physics.pair_force[:] = (forces.flip(1) if turn else forces).flatten(1)
        physics.link_force[:] = felt.flip(1) * half if turn else felt
        env.view.clock = torch.full((16,), 5)
        env.memory["close_steps"][:4] = 40.0
        step = env.task.advance(env.view, env.memory)
        assert step.move is not None and step.move.mask.any()
        moved = (step.move.qpos, step.move.qvel)
        results.append((env._observe(), step.terms, step.terminated, moved))
    (obs, terms, terminated, moved), (other_obs, other_terms, other_terminated, other) = results
    other = swapped(*other, scene)
    for agent in range(2):  # a rotation has two quaternions
        at = scene.agent_qpos(agent).start + 3
        quats, turned = moved[0][:, at : at + 4], other[0][:, at : at + 4]
        turned *= (quats * turned).sum(-1, keepdim=True).sign()
    for mine, others in zip(moved, other):
        torch.testing.assert_close(mine, others, atol=1e-5, rtol=1e-5)
    assert (obs - other_obs.flip(1)).abs().max() < 1e-5
    for name, term in terms.items():
        assert (term - other_terms[name].flip(1)).abs().max() < 1e-5, name
    assert torch.equal(terminated, other_terminated.flip(1)) and terminated.any()
    assert terms["point"].abs().sum() > 0 and terms["velocity"].max() > 0.01


def test_random_play_stays_within_bounds(task):
    """What one gains the other loses; the other terms are between 0 and their weights."""
    env = make_env(task, num_worlds=16, seed=1)
    generator = torch.Generator().manual_seed(4)
    largest = 0.0
    for _ in range(80):
        result = env.step(0.15 * torch.randn(16, 2, 69, generator=generator))
        for name, weight in (("facing", 0.1), ("velocity", 0.1), ("strike", 0.6)):
            term = result.terms[name]
            assert float(term.min()) >= 0.0 and float(term.max()) <= weight + 1e-6
        assert (result.terms["point"].sum(1) == 0).all()
        largest = max(largest, float(result.obs.abs().max()))
    assert largest < 200.0 and env.physics.nan_worlds == 0


def test_mujoco_and_warp_stand_on_guard_together(task):
    """1 s under PD: |dqpos| < 1e-5, and the same tensors."""
    pytest.importorskip("mujoco_warp")
    scene = make_scene(task)
    c = make_physics("mujoco", scene, 2, threads=1)
    w = make_physics("warp", scene, 2, device="cpu")
    state, both = default_state(scene, 2, "cpu"), torch.tensor([True, True])
    ctrl = state.qpos[:, [i for a in range(2) for i in range(76 * a + 7, 76 * a + 76)]]
    worst = 0.0
    for physics in (c, w):
        physics.reset(both, state)
    for _ in range(30):
        c.step(ctrl)
        w.step(ctrl)
        worst = max(worst, float((c.qpos - w.qpos).abs().max()))
    print(f"{task}: mujoco against warp, 1 s on guard: |dqpos| = {worst:.1e}")
    assert worst < 1e-5
    assert (c.body_linvel - w.body_linvel).abs().max() < 1e-3
    assert (c.ground_force - w.ground_force).abs().max() < 0.5
    assert int(w.overflow) == 0 and int(w.nan_worlds) == 0


@pytest.mark.parametrize("engine", ["mujoco", "warp", "drake"])
def test_a_blow_scores_once(task, engine):
    """The opponent's chest just beyond the weapon of an athlete that comes on at 1.5 m/s, on every
    engine; then the weapon is pushed on."""
    pytest.importorskip({"mujoco": "mujoco", "warp": "mujoco_warp", "drake": "pydrake"}[engine])
    bout = Bout(task, engine=engine)
    bout.reach_out(0.12 if task == "fencing" else 0.2)
    bout.move(0, 1.5, 0.0, 0.0)
    bout.begin()
    results = list(bout.play(8))
    assert sum(float(r.terms["point"][0, 0]) for r in results) == 1.0
    assert results[-1].metrics["touches_against"][0] == 0.0


@pytest.mark.parametrize("agent", [0, 1])
@pytest.mark.parametrize(
    ("newtons", "wait", "credited"), [(1.0, 0, 1.0), (1.0, 29, 1.0), (1.0, 30, 0.0), (0.0, 0, 0.0)]
)
def test_a_fall_is_credited_within_a_second_of_contact(task, agent, newtons, wait, credited):
    """Contact of the other's weapon in one step, then ``wait`` steps, then the fall: 30 Hz."""
    bout = Bout(task)
    bout.env.view.config = type(bout.env.view.config)(knock_down=2.0)
    bout.begin()
    bout.step((1 - agent, newtons))
    for _ in range(wait):
        bout.step()
    step = bout.step(ground={(agent, "L_Hand"): 51.0})
    assert step.terminated[0, agent]
    gain = 2.0 * credited * (1.0 if agent == 1 else -1.0)
    assert step.terms["knock_down"][0].tolist() == [gain, -gain]
    assert step.metrics["knock_down"][0] == credited * (agent == 1)
    assert step.outcome is not None and step.outcome[0] == (1.0 if agent == 1 else -1.0)


def test_a_contact_in_a_clinch_brings_no_credit(task):
    bout = Bout(task)
    bout.env.view.config = type(bout.env.view.config)(knock_down=2.0)
    bout.begin()
    bout.env.memory["holding"][:] = True
    bout.place(0, -0.4, pose={})
    bout.place(1, 0.4, yaw=math.pi, pose={})
    bout.step((0, 500.0))
    step = bout.step(ground={(1, "L_Hand"): 51.0})
    assert step.terms["knock_down"].abs().sum() == 0.0


def test_rewards_as_the_options_say(task):
    bout = Bout(task)
    config = type(bout.env.view.config)
    bout.env.view.config = config(point=5.0)
    bout.reach_out(0.2)
    bout.begin()
    assert bout.step((0, 500.0)).terms["point"][0].tolist() == [5.0, -5.0]
    bout.env.view.config = config(point=5.0, conceded=0.4)
    bout.begin()
    assert bout.step((0, 500.0)).terms["point"][0].tolist() == [5.0, -2.0]
    for name in ("point", "conceded", "reach", "knock_down"):
        with pytest.raises(ValueError, match=f"'{name}' must not be negative"):
            config(**{name: -1.0})


def least_square(bout: Bout, task: str, distance: float) -> float:
    """Least squared distance (m^2) of athlete 0's weapons from the targets, reaching out so far."""
    bout.reach_out(distance)
    bout.show()
    squares = combat.gaps(bout.env.view, WEAPONS[task]).square().sum(-1)
    return float(squares[0, 0].min())


def test_a_weapon_that_stays_near_may_earn_nothing(task):
    """Without the shadow a way towards the opponent is paid once, and again after half a second
    without contact: by what is nearer than where the weapon was then."""
    bout = Bout(task)
    bout.env.view.config = type(bout.env.view.config)(shadow=False)

    def at(distance: float, *hits: tuple) -> float:
        bout.reach_out(distance)
        return float(bout.step(*hits).terms["strike"][0, 0])

    def worth(distance: float) -> float:
        return 0.6 * math.exp(-10.0 * least_square(bout, task, distance))

    bout.reach_out(0.5)
    bout.begin()
    assert at(0.5) == 0.0  # where it began
    assert at(0.3) == pytest.approx(worth(0.3) - worth(0.5), abs=1e-6)
    assert at(0.3) == at(0.4) == 0.0
    assert at(0.25) == pytest.approx(worth(0.25) - worth(0.3), abs=1e-6)
    assert at(0.2, (0, 200.0)) == pytest.approx(worth(0.2) - worth(0.25), abs=1e-6)
    # No way is paid while it cannot score; then what is nearer than at the end of that time.
    paid = [at(0.1 if i < 10 else 0.4) for i in range(15)]
    assert paid == [0.0] * 15 and bout.env.memory["wait"][0, 0] == 0.0
    assert at(0.3) == pytest.approx(worth(0.3) - worth(0.4), abs=1e-6)


def test_each_metre_towards_the_opponent_may_be_paid(task):
    """By what is nearer than ever, from where the weapon was when it could score again."""
    bout = Bout(task)
    bout.env.view.config = type(bout.env.view.config)(reach=3.0)

    def at(distance: float, *hits: tuple) -> float:
        bout.reach_out(distance)
        return float(bout.step(*hits).terms["reach"][0, 0])

    def gap(distance: float) -> float:
        return math.sqrt(least_square(bout, task, distance))

    bout.reach_out(0.9)
    bout.begin()
    assert at(0.9) == 0.0
    assert at(0.6) == pytest.approx(3.0 * (gap(0.9) - gap(0.6)), abs=1e-5)
    assert at(0.8) == at(0.6) == 0.0
    assert at(0.3, (0, 200.0)) == pytest.approx(3.0 * (gap(0.6) - gap(0.3)), abs=1e-5)
    paid = [at(0.1 if i < 10 else 0.4) for i in range(15)]
    assert paid == [0.0] * 15 and bout.env.memory["wait"][0, 0] == 0.0
    assert at(0.3) == pytest.approx(3.0 * (gap(0.4) - gap(0.3)), abs=1e-5)
