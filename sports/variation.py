"""What a command says of how worlds may differ. Light to import; ``sports.physics.variation`` draws
them."""

from __future__ import annotations

from dataclasses import dataclass

RANGES = ("friction", "stiffness", "damping", "contact_time", "contact_damping")
RANGES += ("contact_impedance",)
FELT = ("contact_time", "contact_damping", "contact_impedance")


@dataclass(frozen=True)
class Variation:
    """Ranges drawn once per world, uniformly."""

    friction: tuple[float, float] = (0.6, 1.6)
    """Factor of every friction coefficient."""
    stiffness: tuple[float, float] = (0.9, 1.1)
    """Factor of every servo stiffness."""
    damping: tuple[float, float] = (0.9, 1.1)
    """Factor of every joint damping."""
    uneven: float = 0.0
    """Stiffness and damping of the joints of one side are greater by up to this share, those of the
    other side smaller by as much; 0 for two sides alike. Who runs in such worlds must steer: a
    policy that learned where both sides are alike runs straight by itself, in other engines to one
    side (docs/physics.md)."""
    contact_time: tuple[float, float] = (0.006, 0.025)
    """Time constant of the contacts of athletes and ground (s). MuJoCo does not go below two time
    steps."""
    contact_damping: tuple[float, float] = (0.5, 1.5)
    """Damping ratio of the same contacts."""
    contact_impedance: tuple[float, float] = (0.4, 0.8)
    """Their impedance: the less, the more they yield to load."""
    coarse_share: float = 0.5
    """Share of worlds that take several substeps in one: 2, 4, ... as often as leaves them
    4 of them in a control step, the usual number. With ``timestep_divisor=4`` these run at the
    usual time step or at half of it, and the others at a quarter."""
    felt_share: float = 0.5
    """Share of worlds whose contacts feel the joints' damping, as Drake's do. The ground that they
    need is firmer; its ranges are:"""
    felt_contact_time: tuple[float, float] = (0.01, 0.03)
    felt_contact_damping: tuple[float, float] = (0.7, 1.3)
    felt_contact_impedance: tuple[float, float] = (0.85, 0.98)
    hold_time: tuple[float, float] = (0.002, 0.0125)
    """Time constant of the contacts of athletes with what they can hold (s). Under the 100 N of a
    finger that throws a ball sinks in by 8 mm at the model's 1/120 s, by less at 2 ms and in
    Drake."""
    cone_share: float = 0.0
    """Share of worlds in which friction has a round cone, as in Drake, instead of a pyramid inside
    it, which gives less where a foot slips across its axes. On a GPU all worlds or none."""
    impratio: tuple[float, float] = (1.0, 1.0)
    """How many times stiffer friction is than the normal force (MuJoCo's ``impratio``), drawn
    log-uniformly. At 1, as in the model, feet that are loaded sideways creep, so that heel and
    toes and the two feet hardly push against each other; at 30 with a round cone they do as in
    Drake (docs/physics.md)."""
    rebound_share: float = 0.0
    """Share of worlds in which what touches ``rebound_links`` bounces off, by now less and now more
    than it came with; in the others, as in MuJoCo's model, it stays. None of them is coarse. Meant
    for a ``timestep_divisor`` of 4, where duels of policies that had not met it ended as in Drake
    (docs/physics.md)."""
    rebound_links: tuple[str, ...] = ("R_Hand",)
    """Links of athletes; a sword is ``R_Hand``, boxing gloves are ``L_Hand`` and ``R_Hand``."""
    own_share: float = 0.0
    """Share of worlds that are the task's own, in which nothing is drawn and contacts do not feel
    the damping: for a policy that must also hold there."""
    own_cone: bool = False
    """``cone_share`` is of the task's own worlds as well. With both shares 1 all are the task's own
    but for the round cone: a policy that is another one there leans on the corners of the pyramid
    (docs/physics.md, "A pyramid or a cone")."""
    own_stride: int = 1
    """Substeps that those take in one: the ``timestep_divisor``, so that theirs is the task's own
    time step."""

    def __post_init__(self) -> None:
        for name in (*RANGES, *(f"felt_{name}" for name in FELT), "hold_time", "impratio"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high:
                raise ValueError(f"variation: {name} must be 0 < low <= high, not {low}, {high}")
        for name in ("coarse_share", "felt_share", "cone_share", "rebound_share", "own_share"):
            share = getattr(self, name)
            if not 0.0 <= share <= 1.0:
                raise ValueError(f"variation: {name} must be in [0, 1], not {share}")
        if not 0.0 <= self.uneven < 1.0:
            raise ValueError(f"variation: uneven must be in [0, 1), not {self.uneven}")
        if self.own_stride < 1:
            raise ValueError(f"variation: own_stride must be at least 1, not {self.own_stride}")
