"""Golf: a stroke off the tee with a prescribed club-head speed and loft, from chip to swing.

The athlete stands where the task puts it, facing across the line of play, with the club in place
of its right hand. It starts at rest at address, the head close behind the ball; takes the club
back (``back``, until the head turns round), swings it down to the ball (``swing``) and follows
through. At the impact the middle of the face is where the ball lies on its tee, moving at
``club_speed``, its normal raised by ``loft``. The left hand goes along near the grip and holds
nothing. Both feet stay where they stand; nothing but they touches the ground. The blow of the ball
is not in the plan: it comes after the event and is felt in the replays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from sports import golf
from sports.humanoid.body import Body, load_body
from warmstart import tee_shot
from warmstart.contact import Ball
from warmstart.phases import Phase
from warmstart.problems import clearance, jumper, striker
from warmstart.separation import axis_balls
from warmstart.solution import Solution
from warmstart.transcription import Transcription

LINK = golf.TOOL
FACE = (1.0, 0.0, 0.0)
"""Its normal, in the frame of the hand."""
AHEAD = golf.PLAYER_Y
"""How far before the middle between the feet the ball lies (m)."""
YAW = -math.pi / 2
"""The athlete faces -y; play is along +x, to its left."""
MARGIN = 0.008
"""What the head keeps off the ground at knots (m)."""
BEHIND = (0.06, 0.15)
"""How far behind its place at the impact the face is at address (m)."""
FEET = {"L": "flat", "R": "flat"}
CLOSING = 3.0
"""How many times shorter the steps next to the impact of a full swing are."""


@dataclass(frozen=True)
class Kind:
    """What differs between a chip and a full swing."""

    keys: str
    """Name of its key poses."""
    intervals: tuple[int, int, int]
    durations: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    """Of the phases back, swing and follow (s)."""
    guess: tuple[float, float, float]
    """The same of a first guess."""
    free: tuple[str, ...]
    held_limits: tuple[str, ...]
    closing: float
    """How many times shorter the steps next to the impact are."""
    share: float
    """Share of a torque limit that may be used at knots: in a full swing the grip is at its limit
    there, and needs more between two."""
    full: bool
    """Whether rows keep the club before the legs, and the arm off the waist."""


CHIP = Kind(
    keys="golf",
    intervals=(12, 18, 11),
    durations=((0.40, 0.65), (0.22, 0.40), (0.45, 0.75)),
    guess=(0.65, 0.35, 0.50),
    free=striker.FREE,
    held_limits=striker.HELD_LIMITS,
    closing=1.0,
    share=striker.SHARE,
    full=False,
)
SWING = Kind(
    keys="golf_swing",
    intervals=(18, 24, 13),
    durations=((0.40, 0.75), (0.20, 0.36), (0.45, 0.75)),
    guess=(0.75, 0.36, 0.45),
    free=(*striker.FREE, *striker.GIRDLE),
    held_limits=(
        *("L_Thorax_x", "L_Thorax_y", "L_Thorax_z", "Neck_x", "Neck_y", "Head_y"),
        *striker.HELD_LIMITS[3:],
    ),
    closing=CLOSING,
    share=0.87,
    full=True,
)
FAST = 15.0
"""A stroke above this speed (m/s) is a full swing, in which the shoulder girdle moves too."""


GAP = (0.03, 0.06)
"""Between the ball of the left hand and the right one (m)."""
CORNERS = 0.025
"""How far the corners of the left hand stick out of its ball (m)."""
HANDS = (np.array([-0.15, 0.72]), np.array([0.10, 0.92]))
"""Where the right hand may be at address, lowest and highest: to the left of the middle and above
the ground (m)."""
OVER = (-0.25, 0.15)
"""How far to the left of the ball it may be at the impact (m): it does not trail far behind."""
FINISH = (np.array([0.10, 1.0]), np.array([0.8, 1.8]))
"""Where it may be at the end: to the left of the middle, above the ground (m)."""
CLUB_UP, HEAD_UP = 0.8, 1.4
"""How high the head of the club and that of the athlete are at the end, at least (m)."""
UPRIGHT = {
    "z": (0.82, 1.02),
    "pitch": (-0.1, 0.3),
    "roll": (-0.15, 0.15),
    "Torso_x": (-0.12, 0.12),
    "Torso_y": (-0.15, 0.25),
    "Chest_y": (-0.1, 0.2),
}
"""Boxes of root and trunk (m, rad) at the end."""
STANCE = ((0.45, 0.65), (-0.05, 0.05))
"""How far the left foot stands to the left of and ahead of the right one (m)."""
FLARE = {"L": (-0.1, 0.4), "R": (-0.4, 0.1)}
"""Sine of the angle by which a foot points to the left of straight ahead."""
WAIST = 0.02
"""How far the right forearm keeps off pelvis and waist (m)."""
PLANE = 0.78
"""The club stays where height and distance ahead of the middle between the feet add up to more (m):
thighs and knees do not."""
BOTH = 0.3
"""Share of body weight that each foot carries at least: who stands on one topples in a replay."""
SPREAD = 0.02
"""Cost at one knot of the squared load of a sole point over body weight: a plan that stands on the
edge of a sole rolls over it in an engine, whose ground is soft."""
SHEAR = 2000.0
"""Weight of horizontal force on the feet."""
LOFTS = (0.0, 14.0)
"""Degrees. The head is a box 0.1 m deep: more tilted, it would dig in under a ball 5 cm up."""


@dataclass(frozen=True)
class Config(striker.Config):
    """Options of the golf problem."""

    club_speed: float = 9.0
    """Speed of the middle of the face at the impact (m/s)."""
    loft: float = 11.0
    """Of the face's normal above the horizontal at the impact (degrees)."""
    attack: float = 2.0
    """Of the velocity of the face above the horizontal at the impact (degrees)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 3.0 <= self.club_speed <= 60.0:
            raise ValueError(
                f"club_speed must lie between 3 and 60 m/s, not {self.club_speed}: long drivers "
                "reach 60 m/s"
            )
        if not LOFTS[0] <= self.loft <= LOFTS[1]:
            raise ValueError(
                f"loft must lie between {LOFTS[0]:g} and {LOFTS[1]:g} degrees, not {self.loft}: "
                "the head would meet the ground"
            )
        if not -5.0 <= self.attack <= 15.0:
            raise ValueError(f"attack must lie between -5 and 15 degrees, not {self.attack}")


def kind_of(config: Config) -> Kind:
    """Chip or full swing, by the asked speed."""
    return SWING if config.club_speed > FAST else CHIP


def club(body: Body) -> list[Ball]:
    """Balls around shaft and head, for clearances."""
    shaft, head = body.links[body.link_index(LINK)].shapes
    assert shaft.end is not None
    a, b = np.array(shaft.center), np.array(shaft.end)
    places = [a + share * (b - a) for share in (0.35, 0.65)]
    balls = [Ball(LINK, (float(x), float(y), float(z)), 0.02) for x, y, z in places]
    return [*balls, Ball(LINK, head.center, max(head.size))]


def make_event(config: Config, body: Body) -> striker.Event:
    """What the face does at the impact."""
    loft, attack = math.radians(config.loft), math.radians(config.attack)
    normal = (0.0, math.cos(loft), math.sin(loft))
    radius = golf.BALL.radius
    return striker.Event(
        LINK,
        tee_shot.face_point(body),
        FACE,
        (AHEAD, -radius * normal[1], tee_shot.LYING - radius * normal[2]),
        (0.0, config.club_speed * math.cos(attack), config.club_speed * math.sin(attack)),
        normal,
    )


def transcribe(
    config: Config, body: Body, event: striker.Event, elastic: bool = False
) -> Transcription:
    """The nonlinear program."""
    knots = jumper.scaled(config.detail)
    kind = kind_of(config)
    back, swing, follow = kind.durations
    counts = [knots(n) for n in kind.intervals]
    phases = [
        Phase("back", counts[0], back, FEET, closing=kind.closing),
        Phase("swing", counts[1], swing, FEET, closing=kind.closing),
        Phase("follow", counts[2], follow, FEET, grading=kind.closing),
    ]
    program = striker.transcribe(
        body,
        event,
        phases,
        config,
        free=kind.free,
        position=POSITION,
        held_limits=kind.held_limits,
        tool=club(body),
        feet=STANCE,
        bounds={"torque_share": kind.share},
        shear=SHEAR,
        comfort=COMFORT,
        elastic=elastic,
    )
    corners = [
        Ball(LINK, (float(x), float(y), float(z)), 0.0) for x, y, z in tee_shot.head_corners(body)
    ]
    program.ground(corners, np.arange(program.K), MARGIN)
    if kind.full:
        before_the_legs(program, body)
        off_the_waist(program, body)
    shape(program, event)
    hands_together(program, body)
    striker.both_feet(program, BOTH, SPREAD / config.detail)
    return program


def shape(program: Transcription, event: striker.Event) -> None:
    """The face behind the ball at the first knot, the hands low before the body; the head turns
    round at the end of ``back``; hands and club are up on the target's side at the last knot."""
    model = program.model
    link, point = model.tree.link(LINK), event.point
    feet = {side: model.tree.link(f"{side}_Ankle") for side in FLARE}
    x, y, z = event.place

    def behind(q, p):
        motion = model.motion(q)
        here, normal = motion.point(link, point), motion.R_WL[link] @ ca.DM(list(event.axis))
        return [
            ("behind the ball", y - here[1], *BEHIND),
            ("on the line", here[0] - x, -0.03, 0.03),
            ("at its height", here[2] - z, -0.03, 0.03),
            ("facing the target", normal[1], 0.95, np.inf),
            ("hands at address", motion.p_WL[link][1:], *HANDS),
            *((f"{s} foot square", motion.R_WL[i][1, 0], *FLARE[s]) for s, i in feet.items()),
        ]

    program.rows("address", [0], behind)

    def still(q, v, p):
        motion = model.motion(q, v)
        return [("turns round", motion.point_velocity(link, point)[1] / 5.0, 0.0, 0.0)]

    program.rows("top", [int(program.knots("back")[-1])], still, rates=True)

    def over(q, p):
        return [("hands over the ball", model.motion(q).p_WL[link][1], *OVER)]

    program.rows("over the ball", [int(program.knots("swing")[-1])], over)

    def through(q, p):
        motion = model.motion(q)
        return [
            ("hands through", motion.p_WL[link][1:], *FINISH),
            ("club up", motion.point(link, point)[2], CLUB_UP, np.inf),
            ("head up", motion.p_WL[model.tree.link("Head")][2], HEAD_UP, np.inf),
        ]

    program.rows("finish", [program.K - 1], through)
    for name, (low, high) in UPRIGHT.items():
        program.bound(program.q[-1, model.index(name)], low, high)


def before_the_legs(program: Transcription, body: Body) -> None:
    """Shaft and head stay before a plane that rises backwards over the legs: a distance has no
    sign, and the club might pass through a leg between two knots."""
    model, balls = program.model, club(body)

    def before(q, p):
        motion = model.motion(q)
        points = [motion.point(model.tree.link(b.link), b.center) for b in balls]
        gaps = [point[0] + point[2] - PLANE - b.radius for point, b in zip(points, balls)]
        return [("before the legs", ca.vertcat(*gaps) / 0.1, 0.0, np.inf)]

    program.rows("before the legs", np.arange(program.K), before)


def off_the_waist(program: Transcription, body: Body) -> None:
    """The right forearm keeps off pelvis and waist."""
    pelvis = [replace(b, radius=b.radius + CORNERS) for b in axis_balls(body, "Pelvis")]
    arm = [*axis_balls(body, "R_Elbow", 3), *axis_balls(body, "R_Wrist")]
    waist = [*pelvis, *axis_balls(body, "Torso"), *axis_balls(body, "Spine")]
    pairs = [(a, b) for a in arm for b in waist]
    clearance.keep_off(program, pairs, np.arange(program.K), WAIST)


def hands_together(program: Transcription, body: Body) -> None:
    """The left hand stays beside the right one, as in a grip, without touching the right arm."""
    model = program.model
    left, wrist = axis_balls(body, "L_Hand")[-1], axis_balls(body, "R_Wrist", 3)
    wide = replace(left, radius=left.radius + CORNERS)
    arm, near = axis_balls(body, "R_Elbow", 3), axis_balls(body, "L_Wrist")
    pairs = [(wide, b) for b in arm] + [(a, b) for a in near for b in (*arm, *wrist)]
    clearance.keep_off(program, pairs, np.arange(program.K), 0.005)

    def beside(q, p):
        motion = model.motion(q)
        a, b = (motion.point(model.tree.link(x.link), x.center) for x in (left, wrist[1]))
        low, high = (left.radius + wrist[1].radius + gap for gap in GAP)
        return [("hands together", ca.sumsqr(a - b) / 0.05, low**2 / 0.05, high**2 / 0.05)]

    program.rows("hands", np.arange(program.K), beside)


POSITION = {
    **striker.GIRDLE_POSITION,
    "R_Shoulder_z": (-0.9, 2.1),
    "R_Elbow_z": (0.05, 2.4),
    "R_Elbow_y": (-1.5, 1.5),
    "R_Wrist_x": (-1.0, 1.0),
    "L_Shoulder_x": (-1.45, 0.9),
    "L_Shoulder_z": (-2.1, 0.9),
    "L_Elbow_z": (-2.4, 0.0),
    "Torso_y": (-0.25, 0.6),
    "Chest_y": (-0.2, 0.5),
}
"""Pose boxes (rad) that differ from those of all strokes."""
COMFORT = {"pitch": 0.3, "roll": 0.0, "Torso_x": 0.0, "Torso_y": 0.15, "Chest_y": 0.1} | {
    f"{side}_Hip_{axis}": 0.0 for side in "LR" for axis in "xz"
}
"""Angles (rad) to which a small price draws the posture: bent forward from the hips."""


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort stroke. See :meth:`warmstart.problems.Problem.solve`."""
    body = load_body("smpl", strength=config.strength, equipment=["club"])
    event = make_event(config, body)
    kind = kind_of(config)
    return striker.solve(
        "golf",
        {"club_speed": config.club_speed},
        event,
        lambda elastic: transcribe(config, body, event, elastic),
        lambda program: striker.key_guess(program, kind.keys, kind.guess),
        guess,
        config,
        progress,
        f"a stroke of {config.club_speed:g} m/s with a loft of {config.loft:g} degrees",
        (0.0, AHEAD, YAW),
    )
