"""Basketball, one against one and two against two: the rules on states made by hand."""

from __future__ import annotations

import math

import pytest
import torch

from sports.basketball import HALF_LENGTH, HALF_WIDTH, LIMBS
from sports.env import make_env
from sports.humanoid.body import load_body
from sports.humanoid.hold import BASKETBALL, load_hold
from sports.physics import PhysicsState, default_state, make_physics
from sports.scene import Scene
from tests.sports.pitch import Pitch, seen_from, total
from tests.sports.test_soccer import swapped_pairs, turned

STANDING = 0.9548
TASKS = ("basketball_1v1", "basketball_2v2")
EAST, WEST = (12.925, 0.0, 3.05), (-12.925, 0.0, 3.05)


def match(task="basketball_1v1", ball=(0.0, 3.0, 1.0), vel=(0.0, 0.0, 0.0), **options) -> Pitch:
    pitch = Pitch(task, **options)
    pitch.ball(ball, vel)
    pitch.begin()
    return pitch


def limb(agent: int, name: str) -> str:
    return f"agent{agent}/{name}/"


# Starts.


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("task", TASKS)
def test_the_ball_is_beside_any_player(task, training):
    env = make_env(task, num_worlds=120, seed=3, training=training)
    root, ball = env.physics.body_pos[:, :, 0, :2], env.physics.object_pos
    away = (root - ball[..., :2]).norm(dim=-1)
    nearest = away.min(1)
    assert (nearest.values >= 0.3 - 1e-5).all() and (nearest.values <= 1.0 + 1e-5).all()
    assert nearest.values.min() < 0.35 and nearest.values.max() > 0.95
    shares = nearest.indices.bincount(minlength=env.num_agents) / 120
    assert (shares - 1.0 / env.num_agents).abs().max() < 0.15
    assert (ball[..., 2] == 1.0).all()
    assert (ball[..., 0].abs() < HALF_LENGTH).all() and (ball[..., 1].abs() < HALF_WIDTH).all()
    tip_off = (root[:, 0] - torch.tensor((-2.0, 0.0))).norm(dim=-1) < 1e-6
    assert (0.35 < tip_off.float().mean() < 0.65) if training else tip_off.all()
    gaps = torch.cdist(root, root) + 99.0 * torch.eye(env.num_agents)
    assert gaps.min() > 2.0 - 1e-4
    assert env.max_steps == 3000 and env.reward_scale == 3.0
    with pytest.raises(ValueError, match="share of uniform starts"):
        make_env(task, num_worlds=1, options={"uniform": -0.1})


def test_nobody_starts_on_the_ball():
    """Two steps later the ball has only fallen."""
    env = make_env("basketball_2v2", num_worlds=40, seed=8)
    for _ in range(2):
        env.step(torch.zeros(40, 4, env.action_size))
    touched = (env.physics.pair_force > 0).any()
    assert not touched and (env.physics.object_linvel[:, 0, :2].abs() < 1e-4).all()


# Who sees what.


@pytest.mark.parametrize(("task", "size"), [("basketball_1v1", 36), ("basketball_2v2", 66)])
def test_everybody_sees_ball_rims_mates_and_opponents(task, size):
    pitch = match(task)
    places = [(-3.0, 1.0, 0.4), (3.0, 2.0, 2.5)]
    if task == "basketball_2v2":
        places = [(-3.0, 1.0, 0.4), (-8.0, -3.0, -1.0), (3.0, 2.0, 2.5), (8.0, 3.0, 3.0)]
    for agent, (x, y, yaw) in enumerate(places):
        pitch.stand(agent, x, y, yaw)
    pitch.ball((2.0, -4.0, 0.5), (3.0, 1.0, -2.0))
    got = pitch.features()
    assert sum(v.shape[-1] for v in got.values()) == size
    half = len(places) // 2
    for agent, (x, y, yaw) in enumerate(places):
        root, own = (x, y, STANDING), WEST if agent < half else EAST
        other = EAST if agent < half else WEST
        counterpart = places[(agent + half) % len(places)]
        want = {
            "ball_position": seen_from((2.0, -4.0, 0.5), root, yaw),
            "ball_velocity": seen_from((3.0, 1.0, -2.0), (0, 0, 0), yaw) + [0.0] * 3,
            "own_rim": seen_from(own, root, yaw),
            "other_rim": seen_from(other, root, yaw),
            "opponent1_position": seen_from((*counterpart[:2], STANDING), root, yaw),
        }
        for name, values in want.items():
            assert got[name][0, agent].tolist() == pytest.approx(values, abs=2e-3), (agent, name)


@pytest.mark.parametrize("task", TASKS)
def test_a_turned_court_with_exchanged_sides_is_the_same_game(task):
    n, generator = 16, torch.Generator().manual_seed(3)
    envs = [make_env(task, num_worlds=n, training=False) for _ in range(2)]
    scene = envs[0].physics.scene
    size = scene.num_agents // 2
    swap = [(a + size) % (2 * size) for a in range(2 * size)]

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    def scattered(places: torch.Tensor) -> PhysicsState:
        state = default_state(scene, n, "cpu")
        state.qvel = noise(n, scene.nv)
        ball = scene.object_qpos("ball").start
        state.qpos[:, ball : ball + 3] = places
        state.qpos[:, ball + 3 : ball + 7] = torch.nn.functional.normalize(noise(n, 4), dim=-1)
        for a in range(2 * size):
            rows = state.qpos[:, scene.agent_qpos(a)]
            rows[:, :2] = places[:, :2] + 0.7 * noise(n, 2)
            rows[:, 2] = 0.5 + noise(n).abs()
            rows[:, 3:7] = torch.nn.functional.normalize(noise(n, 4), dim=-1)
            rows[:, 7:] = 0.3 * noise(n, scene.body.num_dofs)
        return state

    before = noise(n, 3) * torch.tensor((9.0, 6.0, 0.5))
    before[:, 2] = before[:, 2].abs() + 0.12
    after = before + 0.2 * noise(n, 3)
    before[0], after[0] = torch.tensor((12.9, 0.1, 3.2)), torch.tensor((12.95, 0.1, 2.9))
    states = [scattered(places) for places in (before, after)]
    order = [scene.contact_pairs.index(p) for p in swapped_pairs(scene)]
    touch = torch.rand(n, len(order), generator=generator) < 0.1
    touch[0] = False
    steps, features = [], []
    for k, env in enumerate(envs):
        first, second = (turned(s, scene) if k else s for s in states)
        everyone = torch.ones(n, dtype=torch.bool)
        env.physics.reset(everyone, first)
        env.view.refresh()
        env.memory = env.task.begin(env.view, {})
        for agent in range(2 * size):
            env.memory["down"][:, swap[agent] if k else agent] = 40.0 + agent
        env.physics.reset(everyone, second)
        env.view.clock = env.view.clock + 5
        env.view.refresh()
        env.physics.pair_force[:] = (touch[:, order] if k else touch).float()
        steps.append(env.task.advance(env.view, env.memory))
        features.append(env.task.features(env.view, env.memory))
    a, b = steps
    assert a.terms["basket"][0].tolist() == [10.0] * size + [-10.0] * size
    assert all(float(v.abs().max()) > 0 for v in a.terms.values())
    for name, value in features[0].items():
        torch.testing.assert_close(value[:, swap], features[1][name], rtol=0, atol=1e-5)
    for name, value in a.terms.items():
        torch.testing.assert_close(value[:, swap], b.terms[name], rtol=0, atol=1e-5, msg=name)
    assert torch.equal(a.terminated[:, swap], b.terminated)
    assert torch.equal(a.metrics["baskets_for"], b.metrics["baskets_against"])
    assert torch.equal(a.move.mask, b.move.mask) and a.move.mask.sum() > n / 3
    moved = turned(PhysicsState(a.move.qpos, a.move.qvel, states[1].mocap_pos), scene)
    rows = a.move.mask
    places = [scene.agent_qpos(i).start for i in range(2 * size)]
    for q in [*places, scene.object_qpos("ball").start]:
        here, there = moved.qpos[rows, q : q + 3], b.move.qpos[rows, q : q + 3]
        torch.testing.assert_close(here, there, rtol=0, atol=1e-4)


# Rewards.


def test_the_terms_are_the_formulas():
    """Both have had a hand on the ball within the second; both see the same ball."""
    pitch = match(ball=(4.0, 1.0, 2.0))
    pitch.stand(0, 3.7, 1.0)
    pitch.stand(1, 4.6, 1.2, math.pi)
    pitch.advance(limb(0, "L_Wrist"), limb(1, "R_Wrist"))
    at, velocity = (4.2, 1.1, 2.1), (5.0, 0.5, 4.0)
    pitch.ball(at, velocity)
    step = pitch.advance()
    body = pitch.scene.body
    for agent, rim in ((0, EAST), (1, WEST)):
        up = math.sqrt(2 * 9.81 * (3.95 - at[2]))
        time = up / 9.81 + math.sqrt(1.8 / 9.81)
        best = ((rim[0] - at[0]) / time, -at[1] / time, up)
        way = [r - b for r, b in zip(rim, at)]
        speed = sum(w * v for w, v in zip(way, velocity)) / math.dist(at, rim) / 30.0
        gaps = []
        for wrist in ("L_Wrist", "R_Wrist"):
            palm = torch.tensor(body.links[body.link_index(wrist)].shapes[0].center)
            turn = -1.0 if agent else 1.0  # in the T-pose every link faces as the root does
            link = pitch.env.physics.body_pos[0, agent, body.link_index(wrist)]
            place = link + palm * torch.tensor((turn, turn, 1.0))
            gaps.append(math.dist(place.tolist(), at))
        want = {
            "hands": 0.1 * math.exp(-5.0 * sum(gaps) / 2),
            "progress": 0.3 * (math.dist((4.0, 1.0, 2.0), rim) - math.dist(at, rim)),
            "aim": 0.4 * math.exp(-0.1 * math.dist(velocity, best) ** 2),
            "toward": 0.3 * min(max(speed, 0.0), 1.0),
            "basket": 0.0,
        }
        for name, value in want.items():
            assert step.terms[name][0, agent] == pytest.approx(value, abs=1e-5), (agent, name)
        assert want["hands"] > 1e-4


@pytest.mark.parametrize("hand", ["L_Wrist", "R_Wrist"])
def test_aim_counts_for_a_second_after_the_own_hands_touch(hand):
    pitch = match(ball=(8.0, 0.0, 3.0), vel=(5.0, 0.0, 4.3))
    first = pitch.advance()
    assert first.terms["aim"].abs().max() == 0.0
    steps = [pitch.advance(limb(0, hand))]
    steps += [pitch.advance() for _ in range(30)]
    assert [bool(s.terms["aim"][0, 0] > 0.1) for s in steps] == [True] * 30 + [False]
    assert all(s.terms["aim"][0, 1] == 0.0 for s in steps)


def test_a_foot_on_the_ball_earns_nothing_for_a_second_and_is_counted():
    for foot in ("L_Ankle", "R_Ankle"):
        pitch = match(ball=(8.0, 0.0, 3.0), vel=(5.0, 0.0, 4.3))
        assert (total(pitch.advance(limb(0, "L_Wrist")))[0, 0] > 0.1).all()
        steps = [pitch.advance(limb(0, foot), limb(0, "L_Wrist"), limb(1, "L_Wrist"))]
        steps += [pitch.advance() for _ in range(30)]
        paid = [float(total(s)[0, 0]) for s in steps]
        assert paid[:30] == [0.0] * 30 and paid[30] > 0.0
        assert float(total(steps[0])[0, 1]) > 0.0
        assert steps[-1].metrics["fouls"][0] == 1.0  # the second step of it is none of its own
        again = pitch.advance(limb(0, foot))
        assert again.metrics["fouls"][0] == 2.0
        assert pitch.advance(limb(0, foot)).metrics["fouls"][0] == 2.0


# Baskets.


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("aside", "basket"), [(0.22, True), (0.24, False)])
def test_a_basket_counts_at_either_end_for_those_who_attack_it(task, side, aside, basket):
    pitch = match(task, ball=(side * 12.925, aside, 3.2))
    pitch.ball((side * 12.925, aside, 2.95), (0.0, 0.0, -6.0))
    step = pitch.advance()
    half = pitch.scene.num_agents // 2
    points = [10.0 * basket * side] * half + [-10.0 * basket * side] * half
    assert step.terms["basket"][0].tolist() == points
    assert step.terminated[0].tolist() == [basket] * 2 * half
    assert step.metrics["baskets_for"][0] == float(basket and side > 0)
    assert step.metrics["baskets_against"][0] == float(basket and side < 0)
    assert bool(step.success[0]) is (basket and side > 0)


def test_a_ball_from_below_is_no_basket_until_it_was_outside():
    pitch = match(ball=(12.925, 0.0, 2.9))
    for z in (3.2, 2.9):  # up through the ring and down again
        pitch.ball((12.925, 0.0, z))
        assert not pitch.advance().terminated.any()
    for x, z in ((11.9, 2.9), (11.9, 3.2), (12.925, 3.2)):  # up beside it, and over it
        pitch.ball((x, 0.0, z))
        assert not pitch.advance().terminated.any()
    pitch.ball((12.925, 0.0, 2.9))
    assert pitch.advance().terms["basket"][0].tolist() == [10.0, -10.0]


@pytest.mark.parametrize(("steps", "void"), [(29, True), (30, False)])
def test_a_basket_within_a_second_of_a_kick_is_void(steps, void):
    pitch = match(ball=(12.0, 0.0, 3.3), vel=(0.0, 1.0, 0.0))
    pitch.advance(limb(0, "R_Ankle"))
    for _ in range(steps - 2):
        pitch.advance()
    pitch.ball((12.9, 0.0, 3.3))
    pitch.advance()
    pitch.ball((12.925, 0.0, 2.9), (0.0, 0.0, -6.0))
    step = pitch.advance()
    assert step.terminated.all()
    assert step.terms["basket"][0].tolist() == ([0.0, 0.0] if void else [10.0, -10.0])
    assert step.metrics["baskets_for"][0] == float(not void)


def test_a_kick_does_not_save_a_side_its_loss():
    pitch = match(ball=(12.925, 0.0, 3.2))
    pitch.ball((12.925, 0.0, 2.9), (0.0, 0.0, -6.0))
    assert pitch.advance(limb(1, "L_Ankle")).terms["basket"][0].tolist() == [10.0, -10.0]


def test_holding_the_ball_for_ever_is_worth_less_than_a_basket():
    """Between the hands where the free throw begins, to the discount of training (0.99)."""
    pitch, hold = match(), load_hold("basketball")
    own = pitch.state.qpos[:, pitch.scene.agent_qpos(0)]
    for dof, angle in hold.angles.items():
        own[:, 7 + pitch.scene.body.dof_index(dof)] = angle
    pitch.stand(0, 0.0, 0.0, z=hold.root_height)
    pitch.ball(hold.pos)
    pitch.advance(limb(0, "L_Wrist"))
    step = pitch.advance(limb(0, "L_Wrist"), limb(0, "R_Wrist"))
    paid = {name: float(term[0, 0]) for name, term in step.terms.items()}
    assert paid["hands"] == pytest.approx(0.1 * math.exp(-5.0 * 0.14), abs=3e-3)
    assert 0.0 < sum(paid.values()) / (1.0 - 0.99) < 10.0 / 1.5


# What is put elsewhere.


def ball_after(pitch: Pitch, step) -> list[float]:
    at = pitch.scene.object_qpos("ball")
    return step.move.qpos[0, at][:3].tolist()


@pytest.mark.parametrize(
    ("ball", "inside"),
    [
        ((14.49, 3.0, 1.0), None),
        ((14.51, 3.0, 1.0), (14.0, 3.0, 2.5)),
        ((-14.6, 3.0, 4.0), (-14.0, 3.0, 2.5)),
        ((2.0, 7.49, 1.0), None),
        ((2.0, 7.51, 0.12), (2.0, 7.0, 2.5)),
        ((-15.0, -8.0, 0.12), (-14.0, -7.0, 2.5)),
    ],
)
def test_a_ball_off_the_court_is_dropped_inside(ball, inside):
    pitch = match(ball=ball, vel=(3.0, 3.0, 0.0))
    step = pitch.advance()
    assert not step.terminated.any()
    assert bool(step.move.mask[0]) is (inside is not None)
    if inside is None:
        return
    assert ball_after(pitch, step) == pytest.approx(inside)
    assert step.move.qvel[0, pitch.scene.object_qvel("ball")].abs().max() == 0.0
    # The next step's progress begins where it was dropped.
    pitch.ball(inside)
    assert pitch.advance().terms["progress"].abs().max() < 1e-5


@pytest.mark.parametrize(("speed", "z", "stuck"), [(0.05, 3.2, 1), (0.2, 3.2, 0), (0.05, 1.0, 0)])
def test_a_ball_that_lies_on_a_ring_is_dropped_below_it(speed, z, stuck):
    pitch = match(ball=(13.1, 0.0, z), vel=(speed, 0.0, 0.0))
    moves = [pitch.advance() for _ in range(30)]
    assert [bool(m.move.mask[0]) for m in moves] == [False] * 29 + [bool(stuck)]
    if stuck:
        assert ball_after(pitch, moves[-1]) == pytest.approx((13.1, 0.0, 2.5))
        assert not moves[-1].terminated.any()
        pitch.ball((13.1, 0.0, 2.5), (0.0, 0.0, 0.0))
        assert not pitch.advance().terminated.any()  # falling from there is no basket


@pytest.mark.parametrize("seconds", [0.0, 0.5])
def test_a_ball_on_the_floor_may_be_dropped_again(seconds):
    """Rolling or not, after as long without leaving it; one that bounces is not."""
    pitch = match(ball=(3.0, 2.0, 0.12), vel=(1.0, 0.0, 0.0), jump_ball=seconds)
    wanted = [False] * 14 + [seconds > 0.0]
    for again in range(2):
        steps = [pitch.advance() for _ in range(15)]
        assert [bool(s.move.mask[0]) for s in steps] == wanted, again
    if seconds:
        assert ball_after(pitch, steps[-1]) == pytest.approx((3.0, 2.0, 2.5))
        assert not steps[-1].terminated.any()
    for k in range(40):
        pitch.ball((3.0, 2.0, 0.12 if k % 10 else 0.3))
        assert not pitch.advance().move.mask.any()
    with pytest.raises(ValueError, match="must not be negative"):
        match(jump_ball=-1.0)


def test_a_fall_costs_what_is_asked():
    assert "fall" not in match().advance(down=(0,)).terms
    pitch = match(fall=0.5)
    costs = [pitch.advance(down=down).terms["fall"][0].tolist() for down in ((), (0,), (0, 1), ())]
    assert costs == [[0.0, 0.0], [-0.5, 0.0], [0.0, -0.5], [0.0, 0.0]]


def test_an_athlete_that_lies_is_put_on_its_feet_after_a_second():
    pitch = match()
    pitch.stand(0, 5.0, 1.0, 2.0, z=0.1)
    for k in range(30):
        step = pitch.advance(down=(0,))
        assert bool(step.move.mask[0]) == (k == 29), k
    root = step.move.qpos[0, pitch.scene.agent_qpos(0)][:7].tolist()
    assert root[:3] == pytest.approx([5.0, 1.0, STANDING], abs=1e-3)
    assert root[3:] == pytest.approx([math.cos(1.0), 0.0, 0.0, math.sin(1.0)], abs=1e-4)
    assert step.metrics["falls"][0] == 1.0 and not step.terminated.any()


def test_possession_goes_by_hands():
    pitch = match()
    assert pitch.advance(limb(0, "L_Ankle")).metrics["possession"].isnan().all()
    pitch.advance(limb(0, "L_Wrist"))
    pitch.advance()
    assert pitch.advance(limb(1, "R_Wrist")).metrics["possession"][0] == pytest.approx(2 / 3)


# Contacts.


@pytest.mark.parametrize(("engine", "options"), [("mujoco", {}), ("warp", {}), ("drake", {})])
def test_a_hand_with_its_fingers_and_a_foot_feel_the_ball(engine, options):
    """A ball dropped on a fingertip, on a wrist, on a toe and on nothing."""
    pytest.importorskip({"warp": "mujoco_warp", "drake": "pydrake"}.get(engine, "mujoco"))
    if engine == "warp":
        options = {"device": "cpu"}
    body = load_body("smplx")
    sides = ("agent0", *(f"agent0/{name}/" for name in LIMBS), "agent0/R_Wrist")
    scene = Scene(
        name="touch",
        body=body,
        objects=(BASKETBALL,),
        contact_pairs=tuple((side, "ball") for side in sides),
        timestep=1 / 240,
        substeps=8,
    )
    physics = make_physics(engine, scene, 4, **options)
    state = default_state(scene, 4, "cpu")
    physics.reset(torch.ones(4, dtype=torch.bool), state)
    index, at = body.link_index, scene.object_qpos("ball").start
    above = (("R_Middle3", -0.08, 0.112), ("L_Wrist", 0.05, 0.135), ("R_Toe", 0.0, 0.15))
    for world, (link, left, up) in enumerate((*above, ("Head", 0.0, 0.5))):
        place = physics.body_pos[world, 0, index(link)] + torch.tensor((0.0, left, up))
        state.qpos[world, at : at + 3] = place
    physics.reset(torch.ones(4, dtype=torch.bool), state)
    felt = torch.zeros(4, len(sides), dtype=torch.bool)
    for _ in range(3):
        physics.step(torch.zeros(4, scene.nu))
        felt |= physics.pair_force > 0
    physics.close()
    right_fingers, left_wrist, right_toe, nothing = felt.tolist()
    assert right_fingers == [True, False, True, False, False, False]
    assert left_wrist == [True, True, False, False, False, False]
    assert right_toe == [True, False, False, False, True, False]
    assert nothing == [False] * 6


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_warp_plays_as_many_joints_as_that(task):
    """Up to 642 degrees of freedom: where MuJoCo is, and no buffer overflows."""
    pytest.importorskip("mujoco_warp")
    engines = (("mujoco", {"threads": 1}), ("warp", {"device": "cpu"}))
    envs = [make_env(task, engine=e, num_worlds=1, physics_options=o) for e, o in engines]
    for _ in range(10):
        mine, other = (env.step(torch.zeros(1, env.num_agents, env.action_size)) for env in envs)
    torch.testing.assert_close(envs[0].physics.qpos, envs[1].physics.qpos, rtol=0, atol=1e-4)
    assert mine.valid.all() and other.valid.all() and int(envs[1].physics.overflow) == 0
    for env in envs:
        env.close()
