"""What ``olympics-opt polish`` is told. Light to import."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from rl.worlds import are_own
from rl.worlds import mistakes as world_mistakes
from sports.variation import Variation


@dataclass(frozen=True)
class Polish:
    """Make a trained policy better by whole episodes, without rewards for single steps.

    CMA-ES moves its weights a little, along a few directions, and keeps what its episodes come to:
    what PPO cannot tell from its noise. Writes policy.safetensors after every generation; the
    same command goes on where one was stopped. On several GPUs: python -m torch.distributed.run
    --standalone --nproc-per-node GPUS -m olympics_opt polish TASK ..., and each of them plays
    --episodes of every candidate.
    """

    name: Positional[Annotated[str, arg(metavar="TASK")]]
    """Sport; see ``olympics-opt list``."""
    policy: str
    """A run folder, a policy file, or ``pretrained[:ALGO[-STRENGTH]]``."""
    out: Path
    """Folder for the result."""
    objective: str = ""
    """What counts, ``METRIC=WEIGHT@ZERO`` each: ``success=1 time=-0.3@18.2`` is a point for success
    and 0.3 for every second below 18.2. By default the task's main metric."""
    others: tuple[str, ...] = ()
    """Policies with the same network, other states of the training as a rule: one direction leads
    to each."""
    components: int = 4
    """Phases of the motion (principal components of the last hidden layer) in step with which
    every action may shift; -1 for no shifts at all."""
    part: tuple[float, float] | None = None
    """Shift in this part of the episodes above all (its begin and end, as shares of the longest
    episode), in step with what tells it from the rest, and nowhere always. A race that is lost at
    its last hurdles is better left alone before."""
    begin: tuple[float, float] | None = None
    """Episodes begin in states that the policy itself comes to in this part of them (shares of the
    longest one), with the noise of ``start_noise``: a race that is lost at its last hurdle is
    judged by its end alone, in a fifth of the time. The rules begin anew there: what was achieved
    before does not count."""
    worst: float | None = None
    """``begin`` takes its states from this share of the episodes alone, those worth least, for half
    of the starts; the others are whole episodes, without which a search gets good at states that
    it does not come to any more. Where one race in 300 is lost, one in ten of these is."""
    joints: tuple[str, ...] = ()
    """Shift these alone, by name (``R_Shoulder_*``, ``Torso_?``); by default every action. What a
    throw needs is in the trunk and one arm, not in 153 joints."""
    candidates: int = 23
    """Policies of a generation, besides the middle that they are drawn around."""
    episodes: int = 24
    """Of each candidate in a generation; all have the same starts, and the same worlds with
    ``vary``. With ``own_worlds`` so many in each kind."""
    generations: int | None = None
    """By default as many as the minutes allow."""
    minutes: float | None = None
    """Time limit; the generation under way is finished."""
    shift: float = 0.004
    """First spread of each shift (root mean square of the action; 1 is its bound)."""
    share: float = 0.2
    """First spread of the way to each other policy."""
    start_noise: float = 0.02
    """+- joint noise of the starts (rad). More than the 0.02 of an evaluation tells more about what
    hardly ever fails."""
    engine: Literal["mujoco", "warp", "drake"] = "mujoco"
    """Physics engine; ``warp`` needs a GPU."""
    timestep_divisor: int = 1
    """2 halves the physics time step at the same control rate."""
    felt_damping: bool = False
    """Contacts feel the joints' damping, as in Drake (docs/physics.md)."""
    vary: bool = False
    """Let the worlds of a candidate differ, as ``train --vary`` does: what counts is then what the
    policy is worth in all of them."""
    variation: Variation = field(default_factory=Variation)
    """How, with ``--vary``: ranges and shares of worlds."""
    like_drake: bool = False
    """The worlds of a candidate differ as with ``train --like-drake``."""
    own_worlds: bool = False
    """Every candidate plays as many episodes in the task's own worlds at its own time step as in
    the others, and both count alike: for what must hold in both. The log then has each metric
    three times, ``metrics/success`` of all, ``own/success`` and ``others/success``."""
    seed: int = 0
    """Seed of all randomness."""
    strength: Literal["paper", "human"] | None = None
    """Strength of the athlete; by default the one the policy was trained with."""
    limits: Literal["paper", "anatomical"] | None = None
    """Joint ranges; by default those the policy was trained with."""

    def __post_init__(self) -> None:
        if self.candidates < 4 or self.episodes < 1:
            raise ValueError("a search needs at least 4 candidates with 1 episode each")
        if self.components < -1 or (self.components < 0 and not self.others):
            raise ValueError("nothing to search: give components >= 0 or other policies")
        if self.part is not None:
            if not 0.0 <= self.part[0] < self.part[1] <= 1.0:
                raise ValueError(f"a part of the episodes is two shares of it, not {self.part}")
            if self.components < 1:
                raise ValueError("a part of the episodes needs --components of 1 or more")
        if self.begin is not None and not 0.0 <= self.begin[0] <= self.begin[1] <= 1.0:
            raise ValueError(f"episodes begin between two shares of the longest, not {self.begin}")
        if self.worst is not None:
            if not 0.0 < self.worst <= 1.0:
                raise ValueError(f"the worst are a share of the episodes, not {self.worst}")
            if self.begin is None:
                raise ValueError("the worst episodes give starts to --begin: say where it begins")
        if not 0.0 <= self.start_noise < 1.0:
            raise ValueError(f"the starts' noise must lie in [0, 1) rad, not {self.start_noise}")
        if self.shift <= 0.0 or self.share <= 0.0:
            raise ValueError("the first spreads must be positive")
        if self.joints and self.components < 0:
            raise ValueError("no action is shifted with components -1: leave --joints out")
        for mistake in world_mistakes(self):
            raise ValueError(mistake)
        if self.own_worlds and are_own(self):
            raise ValueError(
                "there are no worlds but the task's own: leave --own-worlds out, or give --vary"
            )
        if self.generations is None and self.minutes is None:
            raise ValueError("say for how many generations or minutes to search")

    @property
    def blocks(self) -> int:
        """The middle and its candidates."""
        return 1 + self.candidates

    @property
    def played(self) -> int:
        """Episodes of a generation."""
        return self.blocks * self.episodes * (2 if self.own_worlds else 1)

    def done(self, generation: int, minutes: float) -> float:
        """The share of the search that is done after so many, 0 to 1."""
        shares = ((generation, self.generations), (minutes, self.minutes))
        return min(1.0, max((n / of if of else 1.0) for n, of in shares if of is not None))

    def over(self, generation: int, minutes: float) -> bool:
        """Whether the search is done."""
        return self.done(generation, minutes) >= 1.0
