"""High jump: run up, clear the bar, leave it on.

The bar's top is at height h over x = 20, between uprights at y = 4 and y = 8; the athlete starts
at the origin facing +x and must cross x = 20 between the uprights and over the bar. Source:
SMPLOlympics section 4 for the goal and reward; World Athletics technical rules for the bar
(2.0 kg; a trial fails when the bar does not stay on).

The height term pays for *new* ground gained over the bar, so that standing there earns nothing;
at 3 m/s it equals the paper's. Beyond the paper's terms a jump that counts earns
``HighJump.cleared`` once: without it nothing is paid for leaving the bar on, and PPO (93 M samples)
somersaulted 5 m over a 1.5 m bar and out of the field in 94 % of its trials, or at human strength
ran through the bar. The height term pays about 10 for each metre of the root's height over the bar,
so the prize must be worth several of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sports.humanoid.body import Body, Shape
from sports.physics.base import PhysicsState
from sports.scene import Scene, SceneObject
from sports.task import Advance, Memory, Task, View, clamp01, constant, nan_where, progress

BAR_X, BAR_Y = 20.0, 6.0
HALF_GAP = 2.0
BAR_RADIUS, BAR_LENGTH, BAR_MASS = 0.025, 4.1, 2.0
GOAL = (22.0, 6.0, 1.0)
CLEARED_X = 20.1
HEIGHTS = (0.5, 1.0, 1.5, 2.0)
EVALUATION_HEIGHTS = (1.0, 1.5)
HOLD_STEPS = 15
"""Steps the bar must stay on after the first ground contact beyond it."""
STALL_STEPS, STALL_SPEED = 15, 0.1
MAX_DROP, MAX_SHIFT, MAX_PUSH = 0.05, 0.10, 50.0

# Each upright holds the bar in a shallow groove of two balls; about 9 N sideways lifts it out.
PEG_RADIUS, PEG_ANGLE = 0.02, math.radians(25.0)
_PEG_X = (BAR_RADIUS + PEG_RADIUS) * math.sin(PEG_ANGLE)
# The soft contacts carry the bar's weight at this overlap (measured), so it starts at rest.
_OVERLAP = 5e-4
_PEG_Z = (BAR_RADIUS + PEG_RADIUS) * math.cos(PEG_ANGLE) - _OVERLAP


@dataclass(frozen=True)
class HighJump:
    """Options of the high jump."""

    bar_height: float | None = None
    """Height of the bar's top (m). None: the curriculum in training, 1.0 m and 1.5 m in turn in
    evaluation."""
    curriculum: bool = True
    """Raise each world's bar on success. False: 1.5 m from the start."""
    levels: tuple[float, ...] = HEIGHTS
    """Heights of the curriculum (m), rising. A weak athlete needs smaller steps."""
    cleared: float = 50.0
    """Reward of a jump that counts, once; 0 for the paper's terms alone."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", tuple(self.levels))  # JSON gives lists
        heights = self.levels if self.bar_height is None else (*self.levels, self.bar_height)
        for height in heights:
            if not 0.1 <= height <= 3.0:
                raise ValueError(f"a bar must be between 0.1 and 3.0 m high, not {height}")
        if not self.levels or list(self.levels) != sorted(set(self.levels)):
            raise ValueError(f"the levels must rise, not be {self.levels}")
        if self.cleared < 0.0:
            raise ValueError(f"the prize for a cleared bar must not be negative: {self.cleared}")


def scene(config: HighJump, body: Body) -> Scene:
    """Runway, two movable uprights, and the bar, a free body resting on them."""
    height = config.bar_height or EVALUATION_HEIGHTS[0]
    half = BAR_LENGTH / 2 - BAR_RADIUS
    bar = SceneObject(
        name="bar",
        shapes=(Shape("capsule", (0, -half, 0), (BAR_RADIUS,), BAR_MASS, end=(0, half, 0)),),
        motion="free",
        pos=(BAR_X, BAR_Y, height - BAR_RADIUS),
        rgba=(0.9, 0.15, 0.1, 1.0),
    )
    peg = (PEG_RADIUS,)
    uprights = tuple(
        SceneObject(
            name=name,
            shapes=(
                Shape("sphere", (-_PEG_X, 0, 0), peg, 0.1),
                Shape("sphere", (_PEG_X, 0, 0), peg, 0.1),
                Shape("capsule", (0, 0, -0.08), (0.03,), 1.0, end=(0, 0, -3.2)),
            ),
            motion="mocap",
            pos=(BAR_X, y, height - BAR_RADIUS - _PEG_Z),
            rgba=(0.3, 0.3, 0.35, 1.0),
            meets_ground=False,
        )
        for name, y in (("upright_right", BAR_Y - HALF_GAP), ("upright_left", BAR_Y + HALF_GAP))
    )
    return Scene(
        name="high_jump",
        body=body,
        objects=(bar, *uprights),
        contact_pairs=(("agent0", "bar"),),
        sites={"goal": GOAL},
    )


def curriculum(config: HighJump, num_worlds: int, device: torch.device) -> Memory:
    """Each world's level: an index into ``config.levels``."""
    return {"level": torch.zeros(num_worlds, dtype=torch.long, device=device)}


def promote(view: View, memory: Memory, step: Advance, ended: Tensor) -> Memory:
    """One level up for a world that cleared the bar of its level from the standing start: a
    demonstration's flight is no proof that the world can get there by itself."""
    level = view.curriculum["level"]
    heights = constant(view.config.levels, level.device)
    at_level = memory["bar_height"] >= heights[level] - 1e-4
    up = ended & step.success & at_level & memory["standing"]
    return {"level": (level + up.long()).clamp(max=heights.shape[0] - 1)}


def _heights(view: View, n: int, generator: torch.Generator, training: bool) -> Tensor:
    config: HighJump = view.config
    device = view.clock.device
    if config.bar_height is not None:
        return torch.full((n,), config.bar_height, device=device)
    if not training:
        turn = torch.arange(n, device=device) % len(EVALUATION_HEIGHTS)
        return constant(EVALUATION_HEIGHTS, device)[turn]
    if not config.curriculum:
        return torch.full((n,), EVALUATION_HEIGHTS[-1], device=device)
    # Half of the episodes at the world's own level, half at any it has reached: none forgotten.
    level = view.curriculum["level"]
    draw = torch.rand(n, 2, device=device, generator=generator)
    lower = (draw[:, 1] * (level + 1)).long()
    lower = torch.minimum(lower, level)
    return constant(config.levels, device)[torch.where(draw[:, 0] < 0.5, level, lower)]


def start(
    view: View,
    state: PhysicsState,
    context: Memory,
    generator: torch.Generator,
    training: bool,
) -> tuple[PhysicsState, Memory]:
    """Sets the bar: the drawn height, or that of the demonstration a world starts from."""
    n = state.qpos.shape[0]
    height = _heights(view, n, generator, training)
    standing = torch.ones(n, dtype=torch.bool, device=height.device)
    if "bar_height" in context:
        label = context["bar_height"]
        standing = torch.isnan(label)
        height = torch.where(standing, height, label)
    bar = view.physics.scene.object_qpos("bar")
    state.qpos[:, bar.start + 2] = height - BAR_RADIUS
    state.mocap_pos[:, :, 2] = (height - BAR_RADIUS - _PEG_Z)[:, None]
    return state, {"bar_height": height, "standing": standing}


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset: where the root and the bar are, and nothing jumped yet."""
    root = view.root_pos[:, 0]
    zero = torch.zeros_like(root[:, 0])
    return {
        "bar_height": context["bar_height"],
        "standing": context["standing"],
        "bar_rest": view.physics.object_pos[:, 0].clone(),
        "root": root.clone(),
        "x_max": root[:, 0].clone(),
        "stalled": zero.clone(),
        "landed": zero.clone(),
        "height_sum": zero.clone(),
        "height_count": zero.clone(),
        "crossing_z": torch.full_like(zero, torch.nan),
        "lowest_over_bar": torch.full_like(zero, torch.inf),
    }


def features(view: View, memory: Memory) -> dict[str, Tensor]:
    """Bar and goal as seen from the athlete (6)."""
    root = view.root_pos
    marks = constant((BAR_X, BAR_Y, -BAR_RADIUS, *GOAL), root.device).view(2, 3)
    rises = constant((0.0, 0.0, 1.0, 0.0, 0.0, 0.0), root.device).view(2, 3)
    marks = torch.addcmul(marks, memory["bar_height"][:, None, None], rises)  # (N, 2, 3)
    bar, goal = view.heading.local(marks[:, None] - root[:, :, None]).unbind(2)
    return {"bar": bar, "goal": goal}


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    root, before = view.root_pos[:, 0], memory["root"]
    goal = constant(GOAL, root.device)
    x, y, z = root.unbind(-1)
    before_x = before[:, 0]
    height = memory["bar_height"]

    gained = (x - memory["x_max"]).clamp(min=0.0)
    over = (x > BAR_X - 0.5) & (x < BAR_X + 0.5)
    approach = progress(before, root, goal)
    terms = {
        "progress": clamp01(approach),
        "height": z * gained / 0.1 * over,
    }

    # Crossing the plane of the bar, interpolated within the step.
    crosses = (before_x < BAR_X) & (x >= BAR_X)
    along = ((BAR_X - before_x) / (x - before_x).clamp(min=1e-6)).clamp(0.0, 1.0)
    _, at_y, at_z = torch.lerp(before, root, along[:, None]).unbind(-1)
    beside = (at_y - BAR_Y).abs() > HALF_GAP
    wrong_side = crosses & (beside | (at_z < height))

    bar = view.physics.object_pos[:, 0]
    aside = bar - memory["bar_rest"]
    aside_x, aside_y, aside_z = aside.unbind(-1)
    displaced = (
        (aside_z < -MAX_DROP)
        | (torch.hypot(aside_x, aside_y) > MAX_SHIFT)
        | (view.physics.pair_force[:, 0] > MAX_PUSH)
    )
    outside = (y < -0.5) | (y > 8.0) | (x < -0.5)
    short = x < CLEARED_X
    slow = (approach < STALL_SPEED * view.control_timestep) & short
    stalled = (memory["stalled"] + 1) * slow
    fell = view.fallen()[:, 0] & short

    beyond = view.physics.body_pos[:, 0, :, 0] > CLEARED_X
    touch = (view.touching()[:, 0] & beyond).any(-1) & (x > CLEARED_X)
    down = memory["landed"] > 0
    landed = memory["landed"] + (down | touch)
    failed = displaced | wrong_side | outside | fell | (stalled >= STALL_STEPS)
    success = (landed > HOLD_STEPS) & ~failed

    terms["cleared"] = view.config.cleared * success
    near = (x - BAR_X).abs() < 0.1
    height_sum = memory["height_sum"] + z * near
    height_count = memory["height_count"] + near
    crossing_z = torch.where(crosses, at_z, memory["crossing_z"])
    # An arm that swings back over the bar's plane after the landing is not the jump.
    links = view.physics.body_pos[:, 0], view.rotation[:, 0]
    low_now = view.geometry.lowest_near(*links, BAR_X, 0.05).masked_fill(down, torch.inf)
    lowest = torch.minimum(memory["lowest_over_bar"], low_now)

    mean_height = torch.where(height_count > 0, height_sum / height_count.clamp(min=1), crossing_z)
    lost, success_share = ~success, success.float()
    metrics = {
        "success": success_share,
        "height": nan_where(lost, mean_height),
        "clearance": nan_where(lost | lowest.isinf(), lowest - height),
        "bar_height": height,
        "knocked": displaced.float(),
    }
    elsewhere = (height - constant(EVALUATION_HEIGHTS, height.device)[:, None]).abs() >= 1e-4
    for name in ("success", "height"):
        of_heights = nan_where(elsewhere, metrics[name].expand(elsewhere.shape)).unbind()
        metrics |= {f"{name}_{h}m": v for h, v in zip(EVALUATION_HEIGHTS, of_heights)}
    memory = {
        **memory,
        "root": root.clone(),
        "x_max": torch.maximum(memory["x_max"], x),
        "stalled": stalled,
        "landed": landed,
        "height_sum": height_sum,
        "height_count": height_count,
        "crossing_z": crossing_z,
        "lowest_over_bar": lowest,
    }
    return Advance(
        memory=memory,
        terms={name: term[:, None] for name, term in terms.items()},
        terminated=(failed | success)[:, None],
        metrics=metrics,
        success=success,
    )


TASK = Task(
    name="high_jump",
    config=HighJump,
    scene=scene,
    start=start,
    begin=begin,
    features=features,
    advance=advance,
    curriculum=curriculum,
    promote=promote,
    metrics={
        "success": "fraction",
        "success_1.0m": "fraction",
        "success_1.5m": "fraction",
        "height": "m",
        "height_1.0m": "m",
        "height_1.5m": "m",
        "clearance": "m",
        "bar_height": "m",
        "knocked": "fraction",
    },
    main_metric="success",
    max_steps=300,
    summary="Run up 20 m and clear a bar that must stay on.",
)
