"""A second opinion on an optimised take-off: Drake's MathematicalProgram with SNOPT.

Everything that CasADi + IPOPT did is done again with other tools: rigid-body terms from a reduced
Drake plant through AutoDiff instead of a hand-written recursion, another solver, another way to
write the program. The question asked is about the part of a jump where effort and forces decide,
the stance before its longest flight (:func:`warmstart.stance_program.take_off`), or any other one:

    Given the state and acceleration with which the athlete enters this stance and those with
    which it leaves the ground (hence the same flight, the same bar or the same length), and the
    same timing, which torques need the least effort?

By the principle of optimality the stance of an optimal jump must solve this problem. So it must
be feasible here and stationary by Drake's derivatives, and SNOPT started from it should hardly
better it. A cold start, from a cubic between the two states, is offered too but is hard for
SNOPT: for a bar of 1.0 m it was feasible after 120 iterations and still dearer, for a length of
5 m it was not feasible by then. Clearances other than between a swinging sole and the ground are
left out: where they decide, SNOPT may save effort by passing one limb through another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from warmstart.problems.jumper import HELD_LIMITS
from warmstart.solution import Solution
from warmstart.stance_program import Stance, StanceProgram
from warmstart.transcription import Bounds, Weights


@dataclass(frozen=True)
class SecondOpinion:
    """What SNOPT says about a stance."""

    problem: str
    asked: dict[str, float]
    start: str
    """``solution`` (the optimised motion) or ``cold`` (a cubic between the end states)."""
    knots: int
    variables: int
    status: str
    solve_s: float
    reference_violation: float
    """Largest violation of the optimised motion in this program (rows scaled to about 1)."""
    stationarity: float
    """How far the optimised motion is from optimal by Drake's derivatives: the share of the
    cost gradient that no combination of active constraints balances."""
    start_violation: float
    """Largest violation of SNOPT's start."""
    violation: float
    """Largest violation after SNOPT."""
    reference_cost: float
    """Cost of the optimised motion in this program."""
    cost: float
    effort_reference: float
    """Integral of the squared torque over its limit (s) of the optimised motion."""
    effort: float

    @property
    def improvement(self) -> float:
        """Share of the reference cost that SNOPT saved; negative if it ended dearer."""
        return 1.0 - self.cost / self.reference_cost

    @property
    def agrees(self) -> bool:
        """The motion is feasible and stationary here, and SNOPT ends within 5 % of its cost."""
        return (
            self.reference_violation < 1e-4
            and self.stationarity < 0.02
            and self.violation < 1e-4
            and abs(self.improvement) < 0.05
        )

    def sentence(self) -> str:
        """One line for a report."""
        verdict = "agrees" if self.agrees else "does not agree"
        return (
            f"Drake {verdict} with the take-off: violation {self.reference_violation:.1e}, "
            f"stationarity {self.stationarity:.1e}; SNOPT from the {self.start} start: violation "
            f"{self.start_violation:.1e} -> {self.violation:.1e}, cost {self.cost:.4f} against "
            f"{self.reference_cost:.4f}, {self.variables} variables, {self.solve_s:.0f} s, "
            f"{self.status}"
        )


def second_opinion(
    solution: Solution,
    cold: bool = False,
    iterations: int = 200,
    weights: Weights | None = None,
    bounds: Bounds | None = None,
    held_limits: Sequence[str] = HELD_LIMITS,
    stance: Stance | None = None,
) -> SecondOpinion:
    """Solves a ``stance`` of a solution, by default its take-off, again with SNOPT.

    ``cold`` starts from a cubic between the end states instead of the solution. ``weights``,
    ``bounds`` and ``held_limits`` (held hinges whose torque is limited) must be those of the
    problem; by default those in the solution's stats, and the held hinges of the jumps. Solutions
    of before the boxes were in the stats get those of the jumps, which others may not keep: a
    hurdler's hips turn further (0.2 rad beyond them, which SNOPT called infeasible).
    Raises ValueError when the solution has no stance before a flight.
    """
    program = StanceProgram(solution, weights, bounds, held_limits, stance)
    reference = program.reference_point()
    start = program.cold_point() if cold else reference
    x, status, elapsed = program.solve(start, iterations)
    return SecondOpinion(
        problem=solution.problem,
        asked=dict(solution.asked),
        start="cold" if cold else "solution",
        knots=program.K,
        variables=program.program.num_vars(),
        status=status,
        solve_s=elapsed,
        reference_violation=program.violation(reference),
        stationarity=program.stationarity(reference),
        start_violation=program.violation(start),
        violation=program.violation(x),
        reference_cost=program.cost(reference),
        cost=program.cost(x),
        effort_reference=program.effort(reference),
        effort=program.effort(x),
    )
