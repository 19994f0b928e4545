"""Hurdling: 110 m over ten hurdles of 1.067 m, in one lane, on the feet.

Goal, reward and metrics are those of SMPLOlympics section 4: an episode runs 600 steps, also past
the finish at x = 110; the distance is the largest x of the root until then or until a fall. The
places of the hurdles, and that a toppling one yields to 36-40 N at its top, are those of the World
Athletics technical rules.

Beyond the paper's text:

* Progress is paid for new ground only. Paid for every step forward, and never charged for one
  back, it would reward running to and fro in front of a hurdle.
* A foot, a leg or the trunk that passes a hurdle's plane more than ``THROUGH`` below its top went
  beside it or through it, and the race is over; the technical rules disqualify for the former. At
  1/120 s MuJoCo lets legs through a board 0.05 m thick from 13 m/s on (measured). Arms may pass.
* Touching a hurdle is allowed, and so are a hand or a foot on it.
* Success is decided at the finish. A fall beyond it ends the count of the distance and takes
  nothing back; ``upright`` is the share that finished and stood to the end.

In training the athlete may start at any hurdle k: the whole start moves by k times the distance
between hurdles, so that the run-up is that of the race, and the hurdles before k are down. Nothing
that was given counts: distance and hurdles are counted from the start, time in whole races only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from sports import quaternion
from sports.humanoid.body import Body, Shape
from sports.physics.base import GRAVITY, PhysicsState
from sports.scene import Scene, SceneObject
from sports.task import Advance, Memory, Task, View, constant, length, nan_where

HURDLES = 10
FIRST_X, GAP = 13.72, 9.14
"""x of the first hurdle, and the distance from each to the next (m)."""
FINISH_X = 110.0
GOAL = (FINISH_X, 0.0, 1.0)
RACE_HEIGHT = 1.067
LANE_HALF_WIDTH, MIDDLE = 0.8, 0.15
"""How far off the middle of the lane the root may be (m), and how far off it still is the middle
for the option ``lane``."""
HALF_THICKNESS, HALF_WIDTH = 0.025, 1.0
"""Of a hurdle along x and y (m)."""
HALF_DEPTH = 0.65
"""Half of a solid hurdle's extent along z (m): it is sunk into the ground, never made smaller, and
reaches the ground at every height up to ``HIGHEST``."""
WAVES = 6
"""Sines and cosines in a gap for the option ``gap_seen``; the last pair repeats every 1.5 m."""
LOWEST_TOPPLING, HIGHEST_TOPPLING, HIGHEST = 0.3, 1.1, 1.2
"""Heights that the options allow (m)."""
DOWN_Z = -0.1
"""Where the top of a hurdle lies that is out of the race (m): toes do not meet it."""
THROUGH = 0.10
"""Nothing but an arm passes a hurdle's plane this far below its top (m)."""

# The curriculum: heights U(0, h_max), or U(``least`` x h_max, h_max). A hurdle near h_max that was
# cleared raises it.
LEAST_MAX, MOST_MAX, RAISE = 0.3, 1.167, 0.15
PROOF = 0.8
"""Share of h_max that the highest hurdle cleared must have had to count."""
SLOW = 4.0
"""Metres a second to a hurdle that earn no ``haste``."""

TAKE_OFF = (0.7, 2.5)
"""Metres before a hurdle in which a leap over it begins. Nearer, a thigh that hits the board is
thrown up by it, and a policy was seen that lived on that."""
CLEARANCE, LOW_ROOT = 0.45, 0.95
"""Height of the root over a hurdle's top that is enough to clear it with the legs tucked in, and
the height that running has without a leap (m)."""
SKIM = 0.2
"""Height of the root over a hurdle's top (m), and over ``LOW_ROOT`` where the hurdle is lower than
that, which is free of the charge for being too high."""

# A hurdle that topples: a closed board, so that nobody crawls under it, on two rails that point
# towards the runner, with weights on them that are moved so that the force below overturns it.
MASS, BOARD_MASS, RAIL_MASS = 10.0, 2.8, 0.9
RAIL_LENGTH, RAIL_RADIUS, RAIL_Y = 0.7, 0.02, 0.55
WEIGHT_RADIUS, BOARD_BOTTOM = 0.03, 0.05
OVERTURNING = 37.0
"""Force at the top of a hurdle that overturns it (N)."""
MOVED, KNOCKED = 0.05, 0.3
"""A hurdle whose top has moved this far (m) bars nobody's way; whose top has come down this far
(m) has been knocked over."""
ASIDE_Y = 4.0
"""Where a toppling hurdle stands that is out of the race (m)."""

# Room on a GPU. Athletes thrown on a hurdle made 23 contacts and 92 rows at most (60 and 240 with
# ten toppling hurdles, which stand on 4 contacts each); falls without limits of the joints, 156.
CONTACTS, ROWS, CONTACTS_EACH, ROWS_EACH = 60, 240, 4, 16


@dataclass(frozen=True)
class Hurdling:
    """Options of the hurdles."""

    height: float | None = None
    """Height of all hurdles (m). None: the curriculum in training, 1.067 m in evaluation."""
    curriculum: bool = True
    """In training: heights that grow with success, and starts at any hurdle. False: every episode
    is the race."""
    races: float = 0.1
    """Share of training episodes that are the race itself; the others start at any hurdle. Without
    them a policy whose curriculum had come to 0.32 m (PPO, 29 M samples: 37 m a race) had never
    seen a hurdle of 1.067 m: its normalised observations lay at their bounds, and it fell over at
    the start. With 1, as without the curriculum, all worlds run side by side until the time limit
    has parted them, after 600 steps: before that every update learns from one part of the race, so
    let the critic learn alone (``--ppo.critic-warmup``). Whoever starts at hurdle k sees the boards
    before it on the ground, and what it learns there is not all of use in the race, which has them
    standing behind it (docs/runs.md, "Two races in one task")."""
    toppling: bool = False
    """Hurdles are free bodies that fall when hit. Their height is then that of the race or
    ``height`` in training too: a hurdle that stands on the ground cannot be sunk into it."""
    lower: float = 0.0
    """Metres by which a world's heights fall with an episode that ended before the finish and
    raised nothing; 0 for heights that only rise. One lucky hurdle raises them for good: at h_max
    0.7 m a policy was seen that runs over nine hurdles of 0.3 m and one of 0.5 m. With 0.02 they
    stay where one episode in eight or nine raises them."""
    least: float = 0.0
    """Share of a world's h_max below which none of its hurdles are drawn; 0 draws them from the
    ground on, as the paper does. Half of those are no lesson: the same policy that stood still at
    h_max 0.6 m went from 20 to 41 m over hurdles of 0.42 m in 0.4 M samples."""
    pace: float = 0.0
    """Metres a second, from a hurdle to the next or to the finish, below which a hurdle that was
    cleared raises no heights; 0 counts it at any pace. Heights that rise with an athlete that has
    only just learned to run are learned at a walk: a policy in latents came to 1.167 m at 4.1 m/s,
    with a squat before and after each, hardly ever fell, and had run 81 m when 20 s were over."""
    haste: float = 0.0
    """Reward for each second by which the way from a standing start to the first hurdle, from one
    hurdle to the next, or to the finish takes less than at ``SLOW``; 0 for none, as in the paper.
    Paid for metres alone at a discount of 0.99, who runs safely gains nothing from running faster:
    a policy in latents that came to the race's boards with a ``pace`` of 5 m/s ran at 4.9 m/s for
    160 M samples more, and had run 95 m when 20 s were over. With 40 it ran 110 m in 19.3 s after
    130 M."""
    first_max: float = LEAST_MAX
    """``h_max`` (m) of every world when training begins: what the lesson before this one came to.
    ``--init`` takes an actor over and no heights."""
    landing: float = 0.0
    """Metres behind a hurdle in which progress is paid only at their end; 0 pays every metre, as
    the paper does. Who trips over a hurdle gains two metres as well: whom no hurdle of that height
    lets pass otherwise learns to dive, 18 m far into the race (PPO in latents, 230 M samples). With
    2.5 a fall there pays nothing, and a landing on the feet all of it."""
    leap: float = 0.0
    """Reward for each metre by which the athlete, ``TAKE_OFF`` m before a hurdle, has come nearer
    to rising ``CLEARANCE`` above it with its root than ever before at this one; 0 for none. A
    runner steps over hurdles of half a metre by lifting its knees a little more; one who does that
    at 0.6 m trips all the same, and nothing tells it to leap."""
    skim: float = 0.0
    """Charged in each control step for each metre by which the root is more than ``SKIM`` over the
    top of the nearest hurdle; 0 for nothing. Who learned to leap is higher than it needs to be,
    longer in the air than a person (0.58 s, the root 1.38 m high over boards of 1.067 m), and lands
    the harder for it."""
    lane: float = 0.0
    """Charged in each control step for each metre by which the root is more than ``MIDDLE`` off the
    middle of the lane; 0 for nothing, as in the paper. A policy that nobody charges runs along the
    lane's edge in MuJoCo and over it in Drake: all of 8 races there ended so, and none with a fall
    (PPO, 314 M samples in varied worlds)."""
    aside: float = 0.0
    """In training the athlete starts up to this far (m) to either side of the middle of the lane,
    so that every race is a lesson in keeping it."""
    run_up: float = 0.0
    """In training the run-up to the first hurdle is longer or shorter by up to this (m), so that
    the athlete learns to come to a hurdle on any step. Otherwise every race has the same steps: in
    Drake, where each is a little longer, a policy took off a metre too late by the fourth."""
    taller: float = 0.0
    """In training the boards stand up to this much (m) higher than the athlete sees them, each by
    an amount of its own, so that it learns to leave room. A policy that had cleared every board of
    MuJoCo by nothing (233 M samples in varied worlds) met those of Drake with pelvis and thighs,
    3 m/s slower after it, and fell before the next: 9 races of 10."""
    unseen: float = 0.0
    """Metres by which all boards stand higher than the athlete sees them, in every episode and not
    in training alone: a trial of the room that it leaves. A policy in latents that loses one race
    in a hundred loses 2 % of them over boards 0.02 m higher, 4 % at 0.04 m, 12 % at 0.07 m and 53 %
    at 0.10 m, so that a search by whole races (``polish``) sees what is wrong more often."""
    lane_seen: bool = False
    """The athlete also sees where in its lane it is: how far its root is off the middle, at what
    speed that grows, and the sine of the angle between its heading and the lane. The paper's
    observation tells this only as differences of the marks' places, of which the nearest is metres
    and the finish a hundred metres away, so that half a metre off the middle is a twentieth of a
    standard deviation."""
    gap_seen: bool = False
    """The athlete also sees where between two hurdles it is: sine and cosine of one to ``WAVES``
    times its share of the gap. The paper's observation tells it only as the places of ten marks,
    each an input of its own with a standard deviation of 30 m, so that what is learned of the step
    before one hurdle says nothing of the next, and 0.05 m are two thousandths of such a deviation;
    here they are 0.03 of one and more, at every hurdle the same."""
    finish: float = 0.0
    """Reward at the finish; 0 for none, as in the paper. Progress alone is worth less and less as
    the race ends, and a fall costs less: the policies in latents lose their races at the last
    hurdles, where they are fastest, and two per cent of speed are worth seven races of a hundred
    to them (1.6 M samples of PPO: 18.2 to 18.0 s and 96 to 62 %)."""
    finish_ends: bool = False
    """End the episode at the finish, or at the end of the run-out: training is spared idle steps.
    The paper's distance needs the whole 600."""
    run_out: float = 0.0
    """Metres beyond the finish that are paid for like those before it; 0 for none, as in the paper.
    A policy that never saw the far side of the finish falls there: 89 of 100 races won in MuJoCo,
    5 of them on the feet at the end (Drake: 17 of 20), and 139 m run instead of 162."""

    def __post_init__(self) -> None:
        low, high, kind = 0.0, HIGHEST, "hurdle"
        if self.toppling:
            low, high, kind = LOWEST_TOPPLING, HIGHEST_TOPPLING, "toppling hurdle"
        if self.lower < 0.0:
            raise ValueError(f"heights fall by 0 m or more, not {self.lower}")
        if self.pace < 0.0:
            raise ValueError(f"a pace that counts is 0 m/s or more, not {self.pace}")
        if self.haste < 0.0:
            raise ValueError(f"the reward for haste must not be negative: {self.haste}")
        if not LEAST_MAX <= self.first_max <= MOST_MAX:
            text = f"the first h_max must lie in [{LEAST_MAX}, {MOST_MAX}] m, not {self.first_max}"
            raise ValueError(text)
        if self.leap < 0.0:
            raise ValueError(f"the reward for leaping must not be negative: {self.leap}")
        if self.skim < 0.0:
            raise ValueError(f"the charge for height must not be negative: {self.skim}")
        if self.lane < 0.0:
            raise ValueError(f"the charge for leaving the middle must not be negative: {self.lane}")
        if self.finish < 0.0:
            raise ValueError(f"the prize at the finish must not be negative: {self.finish}")
        if self.run_out < 0.0:
            raise ValueError(f"the run-out must not be shorter than 0 m: {self.run_out}")
        if not 0.0 <= self.races <= 1.0:
            raise ValueError(f"the share of whole races must lie in [0, 1], not {self.races}")
        if not 0.0 <= self.run_up < GAP / 2:
            raise ValueError(f"a run-up may differ by 0 m to {GAP / 2} m, not {self.run_up}")
        for more in (self.taller, self.unseen):
            if more < 0.0:
                raise ValueError(f"boards stand higher than they look, not lower: {more}")
        more = self.taller + self.unseen
        highest = MOST_MAX if self.height is None else self.height
        if highest + more > 2.0 * HALF_DEPTH:
            raise ValueError(f"boards that stand {more} m higher hang off the ground")
        if more > 0.0 and self.toppling:
            text = "a hurdle that topples is as high as it looks: leave taller and unseen out"
            raise ValueError(text)
        if not 0.0 <= self.aside < LANE_HALF_WIDTH:
            raise ValueError(f"who starts {self.aside} m aside is not in the lane")
        if not 0.0 <= self.least < 1.0:
            raise ValueError(f"the least share of h_max must lie in [0, 1), not {self.least}")
        if not 0.0 <= self.landing < GAP:
            raise ValueError(f"a landing takes 0 m to less than {GAP} m, not {self.landing}")
        if self.height is not None and not low <= self.height <= high:
            raise ValueError(f"a {kind} must be {low} to {high} m high, not {self.height}")


def _height(config: Hurdling) -> float:
    return RACE_HEIGHT if config.height is None else config.height


def toppling_shapes(height: float) -> tuple[Shape, ...]:
    """A hurdle of ``height`` (m) that ``OVERTURNING`` at its top turns over the ends of its rails.

    Its frame is on the ground under the board. With the centre of mass a distance d behind the
    ends of the rails, the force is M g d / height.
    """
    half = (height - BOARD_BOTTOM) / 2
    front, rear = HALF_THICKNESS - RAIL_RADIUS, HALF_THICKNESS - RAIL_LENGTH + RAIL_RADIUS
    lever = OVERTURNING * height / (MASS * GRAVITY)
    weight = (MASS - BOARD_MASS - 2 * RAIL_MASS) / 2
    weight_x = (MASS * (front - lever) - RAIL_MASS * (front + rear)) / (2 * weight)
    weight_z = 2 * RAIL_RADIUS + WEIGHT_RADIUS
    board = (HALF_THICKNESS, HALF_WIDTH, half)
    shapes = [Shape("box", (0.0, 0.0, BOARD_BOTTOM + half), board, BOARD_MASS)]
    for y in (-RAIL_Y, RAIL_Y):
        start, end = (rear, y, RAIL_RADIUS), (front, y, RAIL_RADIUS)
        shapes += [
            Shape("capsule", start, (RAIL_RADIUS,), RAIL_MASS, end=end),
            Shape("sphere", (weight_x, y, weight_z), (WEIGHT_RADIUS,), weight),
        ]
    return tuple(shapes)


def scene(config: Hurdling, body: Body) -> Scene:
    """The lane and ten hurdles: fixtures that are moved up and down, or free bodies."""
    height = _height(config)
    if config.toppling:
        shapes, z = toppling_shapes(height), 0.0
    else:
        size = (HALF_THICKNESS, HALF_WIDTH, HALF_DEPTH)
        shapes, z = (Shape("box", (0.0, 0.0, -HALF_DEPTH), size, MASS),), height or DOWN_Z
    hurdles = tuple(
        SceneObject(
            name=f"hurdle{k}",
            shapes=shapes,
            motion="free" if config.toppling else "mocap",
            pos=(FIRST_X + GAP * k, 0.0, z),
            rgba=(0.92, 0.92, 0.95, 1.0),
            meets_ground=config.toppling,
        )
        for k in range(HURDLES)
    )
    standing = HURDLES if config.toppling else 0
    return Scene(
        name="hurdling",
        body=body,
        objects=hurdles,
        contacts_per_world=CONTACTS + CONTACTS_EACH * standing,
        rows_per_world=ROWS + ROWS_EACH * standing,
        sites={"start": (0.0, 0.0, 0.0), "finish": GOAL},
    )


def curriculum(config: Hurdling, num_worlds: int, device: torch.device) -> Memory:
    """Each world's ``h_max`` (m): its hurdles are drawn between the ground and that."""
    first = config.first_max if curriculum_grows(config) else MOST_MAX
    return {"h_max": torch.full((num_worlds,), first, device=device)}


def curriculum_grows(config: Hurdling) -> bool:
    """Whether heights follow what the athlete clears."""
    return config.curriculum and config.height is None and not config.toppling


def times_hurdles(config: Hurdling) -> bool:
    """Whether how long an athlete takes from hurdle to hurdle is of use."""
    return config.pace > 0.0 or config.haste > 0.0


def promote(view: View, memory: Memory, step: Advance, ended: Tensor) -> Memory:
    """Higher hurdles for a world whose athlete cleared one near its height and ran on to the next
    hurdle or the finish, from wherever it started standing: a demonstration is no proof. Asked for
    the finish as well, which three in four do not reach, heights rose from 0.3 to 0.6 m in 43 M
    samples of PPO."""
    h_max = view.curriculum["h_max"]
    own = ended & memory["standing"]
    up = own & (memory["highest"] >= PROOF * h_max)
    h_max = h_max + RAISE * up
    if view.config.lower > 0.0 and curriculum_grows(view.config):
        down = own & ~up & ~memory["finished"]
        h_max = (h_max - view.config.lower * down).clamp(min=LEAST_MAX)
    return {"h_max": h_max.clamp(max=MOST_MAX)}


def start(
    view: View,
    state: PhysicsState,
    context: Memory,
    generator: torch.Generator,
    training: bool,
) -> tuple[PhysicsState, Memory]:
    """Sets the hurdles and, in training, moves the athlete to one of them. A demonstration starts
    where it is, among hurdles of its ``hurdle_height``."""
    config: Hurdling = view.config
    n, device = state.qpos.shape[0], state.qpos.device
    draw = torch.rand(n, 2 + HURDLES, device=device, generator=generator)
    heights = torch.full((n, HURDLES), _height(config), device=device)
    first = torch.zeros(n, device=device)
    if training and config.curriculum:
        race = draw[:, 1] < config.races
        first = (HURDLES * draw[:, 0]).floor().masked_fill(race, 0.0)
        if curriculum_grows(config):
            share = config.least + (1.0 - config.least) * draw[:, 2:]
            grown = share * view.curriculum["h_max"][:, None]
            heights = torch.where(race[:, None], heights, grown)
    standing = torch.ones(n, dtype=torch.bool, device=device)
    if "hurdle_height" in context:
        label = context["hurdle_height"]
        standing = torch.isnan(label)
        first = first * standing
        heights = torch.where(standing[:, None], heights, label[:, None])

    numbers = torch.arange(HURDLES, device=device)
    behind = numbers < first[:, None]
    heights = heights.masked_fill(behind, 0.0)
    state.qpos[:, 0] += GAP * first
    for axis, most in ((1, config.aside), (0, config.run_up)):
        if training and most > 0.0:
            share = 2.0 * torch.rand(n, device=device, generator=generator) - 1.0
            state.qpos[:, axis] += most * share
    if config.toppling:
        y = view.physics.scene.object_qpos("hurdle0").start + 1 + 7 * numbers
        state.qpos[:, y] = ASIDE_Y * behind
    else:
        tops = heights + config.unseen
        if training and config.taller > 0.0:
            tops = tops + config.taller * torch.rand(n, HURDLES, device=device, generator=generator)
        state.mocap_pos[:, :, 2] = torch.where(heights > 0.0, tops, DOWN_Z)
    marks = torch.zeros(n, HURDLES + 1, 3, device=device)
    marks[:, :HURDLES, 0] = FIRST_X + GAP * numbers
    marks[:, :HURDLES, 2] = heights
    marks[:, HURDLES] = constant(GOAL, device)
    return state, {"marks": marks, "standing": standing, "first": first}


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset: where the athlete is and what stands before it; nothing passed yet."""
    links = view.physics.body_pos[:, 0]
    root = links[:, 0]
    behind = hurdles_behind(links[..., 0])
    zero = torch.zeros_like(root[:, 0])
    left = length(root - constant(GOAL, root.device)) + withheld(root[:, 0], view.config.landing)
    shaping = {"rises": zero.clone()} if view.config.leap > 0.0 else {}
    if times_hurdles(view.config):
        shaping["passed_clock"] = torch.zeros_like(view.clock)
    return {
        **shaping,
        "marks": context["marks"],
        "standing": context["standing"],
        "whole": context["standing"] & (context["first"] == 0.0),
        "left": left,
        "links": links.clone(),
        "behind": behind,
        "start_x": root[:, 0].clone(),
        "given": torch.maximum(behind[:, 0], context["first"]),
        "x_max": root[:, 0].clone(),
        "passed": behind[:, 0].clone(),
        "over": zero.clone(),
        "highest": zero.clone(),
        "finished": zero.bool(),
        "time": torch.full_like(zero, torch.nan),
        "top_speed": zero.clone(),
    }


def features(view: View, memory: Memory) -> dict[str, Tensor]:
    """Tops of the ten hurdles (30) and finish (3) as seen from the athlete; with ``lane_seen`` its
    place in the lane (3): metres off the middle, m/s off it, sine of the heading; with ``gap_seen``
    its place between two hurdles (2 x WAVES): sines, then cosines, which are 0 and 1 over each."""
    marks = memory["marks"]
    if view.config.toppling:
        marks = torch.cat((_tops(view), marks[:, HURDLES:]), dim=1)
    seen = view.heading.local(marks[:, None] - view.root_pos[:, :, None]).flatten(2)
    parts = {"hurdles": seen[..., : 3 * HURDLES], "finish": seen[..., 3 * HURDLES :]}
    if view.config.lane_seen:
        aside, drift = view.root_pos[..., 1], view.root_linvel[..., 1]
        parts["lane"] = torch.stack((aside, drift, view.heading.sin), dim=-1)
    if view.config.gap_seen:
        waves = constant(tuple(range(1, WAVES + 1)), marks.device)
        phase = 2.0 * torch.pi * ((view.root_pos[..., :1] - FIRST_X) / GAP * waves)
        parts["gap"] = torch.cat((phase.sin(), phase.cos()), dim=-1)
    return parts


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    root = view.root_pos[:, 0]
    x, y, _ = root.unbind(-1)
    left = length(root - constant(GOAL, root.device)) + withheld(x, view.config.landing)
    terms = {"progress": (memory["left"] - left).clamp(0.0, 1.0 + view.config.landing)}

    heights, knocked = memory["marks"][:, :HURDLES, 2], torch.zeros_like(x)
    if view.config.toppling:
        stood, tops = memory["marks"][:, :HURDLES], _tops(view)
        knocked = (tops[..., 2] < heights - KNOCKED).sum(-1).float()
        heights = heights.masked_fill(length(tops - stood) > MOVED, 0.0)
    if view.config.lane > 0.0:
        terms["lane"] = -view.config.lane * (y.abs() - MIDDLE).clamp(min=0.0)

    if view.config.skim > 0.0:
        terms["skim"] = -view.config.skim * too_high(root, heights)

    # The links that pass a hurdle's plane, and how high they do, interpolated within the step.
    links, before = view.physics.body_pos[:, 0], memory["links"]
    (along, _, up), (was_along, _, was_up) = links.unbind(-1), before.unbind(-1)
    behind = hurdles_behind(along)
    number = torch.maximum(behind, memory["behind"]).clamp_(min=1.0) - 1.0
    share = (FIRST_X + GAP * number - was_along) / (along - was_along)
    height = heights.gather(1, number.long())  # (N, B)
    margin = constant(_margins(view.physics.scene.body.link_names), root.device)
    low = torch.lerp(was_up, up, share) < height - margin
    through = (low & (behind != memory["behind"])).any(-1)

    fell = view.fallen()[:, 0]
    failed = fell | through | (y.abs() > LANE_HALF_WIDTH)
    arrives = (x > FINISH_X) & ~failed & ~memory["finished"]
    finished = memory["finished"] | arrives
    if view.config.finish > 0.0:
        terms["finish"] = view.config.finish * arrives
    was_x = was_along[:, 0]
    end = FINISH_X + view.config.run_out
    if view.config.run_out > 0.0:
        new = x.clamp(max=end) - memory["x_max"].clamp(min=FINISH_X)
        terms["run_out"] = new.clamp(0.0, 1.0) * finished
    ended = failed | (finished & (x > end)) if view.config.finish_ends else failed
    steps = view.clock - 1 + (FINISH_X - was_x) / (x - was_x)
    time = torch.where(arrives, steps * view.control_timestep, memory["time"])

    shaping: Memory = {}
    if view.config.leap > 0.0:
        rises = torch.maximum(memory["rises"], leap(view, memory))
        # For each hurdle anew.
        rises = rises.masked_fill(behind[:, 0] > memory["passed"], 0.0)
        terms["leap"] = view.config.leap * (rises - memory["rises"]).clamp(min=0.0)
        shaping["rises"] = rises

    x_max = torch.maximum(memory["x_max"], x)
    passed = torch.maximum(memory["passed"], behind[:, 0])
    # A hurdle is cleared when the next one is reached, or the finish.
    further = passed != memory["passed"]
    cleared = memory["over"].masked_fill(~(further | arrives), 0.0)
    if times_hurdles(view.config):
        seconds = (view.clock - memory["passed_clock"]) * view.control_timestep
        apart = torch.where(arrives, FINISH_X - (FIRST_X + GAP * (HURDLES - 1)), GAP)
        cleared = cleared.masked_fill(apart < view.config.pace * seconds, 0.0)
        if view.config.haste > 0.0:
            # The way to its first hurdle begins where and when it stood, if it did.
            opens = memory["standing"] & (memory["passed"] == memory["given"])
            opening = FIRST_X + GAP * memory["passed"] - memory["start_x"]
            apart = torch.where(opens, opening, apart)
            seconds = torch.where(opens, view.clock * view.control_timestep, seconds)
            ran = (further | arrives) & (opens | (memory["passed"] > memory["given"])) & ~failed
            terms["haste"] = view.config.haste * (apart / SLOW - seconds).clamp(min=0.0) * ran
        shaping["passed_clock"] = torch.where(further, view.clock, memory["passed_clock"])
    over = torch.where(further, height[:, 0], memory["over"])
    success = finished.float()
    top_speed = torch.maximum(memory["top_speed"], view.root_linvel[:, 0, 0])
    metrics = {
        "success": success,
        "distance": x_max - memory["start_x"],
        "time": nan_where(~memory["whole"], time),
        "hurdles": (passed - memory["given"]).clamp_(min=0.0),
        "knocked": knocked,
        "top_speed": top_speed,
        "upright": success.masked_fill(failed, 0.0),
    }
    memory = {
        **memory,
        "left": torch.minimum(memory["left"], left),
        "links": links.clone(),
        "behind": behind,
        "x_max": x_max,
        "passed": passed,
        "over": over,
        "highest": torch.maximum(memory["highest"], cleared),
        "finished": finished,
        "time": time,
        "top_speed": top_speed,
        **shaping,
    }
    return Advance(
        memory=memory,
        terms={name: term[:, None] for name, term in terms.items()},
        terminated=ended[:, None],
        metrics=metrics,
        success=finished,
    )


def hurdles_behind(x: Tensor) -> Tensor:
    """How many of the hurdles' planes lie at or behind x (m), 0 to 10, as a float; 0 for NaN, of a
    world that diverged."""
    return ((x + (GAP - FIRST_X)) / GAP).floor_().nan_to_num_(0.0).clamp_(0.0, HURDLES)


def leap(view: View, memory: Memory) -> Tensor:
    """(N,) metres above ``LOW_ROOT`` to which the root will rise in free flight, as far as the
    hurdle that comes next asks for it, ``TAKE_OFF`` before it; 0 elsewhere."""
    root, up = view.root_pos[:, 0], view.root_linvel[:, 0, 2].clamp(min=0.0)
    behind = hurdles_behind(root[:, 0])
    number = behind.clamp(max=HURDLES - 1.0)
    tops = memory["marks"][:, :HURDLES, 2].gather(1, number.long()[:, None])[:, 0]
    ahead = FIRST_X + GAP * number - root[:, 0]
    apex = root[:, 2] + up.square() / (2.0 * GRAVITY)
    wanted = (tops + CLEARANCE - LOW_ROOT).clamp(min=0.0)
    rises = torch.minimum((apex - LOW_ROOT).clamp(min=0.0), wanted)
    return rises.masked_fill((ahead < TAKE_OFF[0]) | (ahead > TAKE_OFF[1]), 0.0)


def too_high(root: Tensor, heights: Tensor) -> Tensor:
    """(N,) metres by which roots (N, 3) are more than ``SKIM`` over the top of the nearest of the
    hurdles, whose ``heights`` (N, 10) are in m, and over the height that running has."""
    nearest = hurdles_behind(root[:, 0] + GAP / 2).clamp_(min=1.0) - 1.0
    top = heights.gather(1, nearest.long()[:, None])[:, 0]
    return (root[:, 2] - top.clamp(min=LOW_ROOT) - SKIM).clamp(min=0.0)


def withheld(x: Tensor, landing: float) -> Tensor:
    """(N,) metres at x (m) that are not yet paid for: those since the last hurdle, up to
    ``landing``, at whose end none are."""
    behind = hurdles_behind(x)
    since = x - (FIRST_X + GAP * (behind - 1.0))
    return since.masked_fill((behind < 1.0) | (since >= landing), 0.0)


def least_time(distance: Tensor, top_speed: Tensor) -> Tensor:
    """(N,) time (s) below which no athlete covers a distance (m) without ever being faster than
    ``top_speed`` (m/s): whatever pushed it."""
    return distance / top_speed.clamp(min=1e-6)


@cache
def _margins(link_names: tuple[str, ...]) -> tuple[float, ...]:
    """How far below a hurdle's top each link may pass its plane (m): an arm as far as it likes."""
    arms = ("Shoulder", "Elbow", "Wrist", "Hand")
    return tuple(torch.inf if any(arm in name for arm in arms) else THROUGH for name in link_names)


def _tops(view: View) -> Tensor:
    """(N, 10, 3) middles of the upper edges of hurdles that can move (m)."""
    pos, quat = view.physics.object_pos, view.physics.object_quat
    up = constant((0.0, 0.0, _height(view.config)), pos.device)
    return pos + quaternion.rotate(quat, up)


TASK = Task(
    name="hurdling",
    config=Hurdling,
    scene=scene,
    start=start,
    begin=begin,
    features=features,
    advance=advance,
    curriculum=curriculum,
    promote=promote,
    metrics={
        "success": "fraction",
        "distance": "m",
        "time": "s",
        "hurdles": "of 10",
        "knocked": "of 10",
        "top_speed": "m/s",
        "upright": "fraction",
    },
    main_metric="distance",
    max_steps=600,
    sees=("lane_seen", "gap_seen"),
    summary="Run 110 m over ten hurdles.",
)
