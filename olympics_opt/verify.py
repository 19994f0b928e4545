"""Does a result hold in another engine? The same policy in MuJoCo, at half its step, and in Drake.

Order of the argument: first the parity table (are the two models the same body?), then the
scores. A result passes when Drake keeps at least 90 % of MuJoCo's success. Where it does not, but
MuJoCo at half the time step loses as much, the loss belongs to the policy (it leans on the time
step), not to the engine; the report says so. Numbers that overflowed or became NaN fail.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from olympics_opt import atomic

if TYPE_CHECKING:
    from olympics_opt.cli import Verify
    from rl.evaluate import EvaluationResult

KEEP = 0.9
"""Share of MuJoCo's success that must remain in Drake."""
CONFIDENCE = 0.95
RUNS = ("mujoco", "mujoco-half-step", "drake")


@dataclass(frozen=True)
class SuccessDifference:
    """Success rate of another run minus that of the reference run."""

    reference: float
    other: float
    low: float
    """Lower end of the 95 % interval of ``other - reference``."""
    high: float

    @property
    def difference(self) -> float:
        return self.other - self.reference


@dataclass(frozen=True)
class MetricComparison:
    """Two samples of one metric."""

    metric: str
    reference_mean: float
    other_mean: float
    permutation_p: float
    """Two-sided permutation test of equal means."""
    ks: float
    """Kolmogorov-Smirnov distance: largest gap of the two distribution functions."""
    ks_p: float


@dataclass(frozen=True)
class Verdict:
    """Whether a result holds, and why."""

    passed: bool
    reasons: tuple[str, ...]
    """Why it failed; empty when it passed."""
    notes: tuple[str, ...] = ()
    """What a reader must know although it passed."""
    kept: float | None = None
    """Drake's success over MuJoCo's; None where MuJoCo has none."""
    kept_half_step: float | None = None


def success_difference(reference: np.ndarray, other: np.ndarray) -> SuccessDifference:
    """Difference of two success rates with Newcombe's 95 % interval.

    ``reference`` and ``other`` are (n,) of 0 and 1. Source: Newcombe 1998, method 10 (square and
    add, from the Wilson intervals of both rates). Raises ValueError for an empty sample.
    """
    from scipy.stats import binomtest

    if len(reference) == 0 or len(other) == 0:
        raise ValueError("a success rate needs at least one trial in each run")

    def wilson(sample: np.ndarray) -> tuple[float, float, float]:
        hits, n = int(np.sum(np.asarray(sample) > 0.5)), len(sample)
        ci = binomtest(hits, n).proportion_ci(CONFIDENCE, method="wilson")
        return hits / n, float(ci.low), float(ci.high)

    p1, l1, u1 = wilson(reference)
    p2, l2, u2 = wilson(other)
    d = p2 - p1
    return SuccessDifference(
        reference=p1,
        other=p2,
        low=d - math.hypot(p2 - l2, u1 - p1),
        high=d + math.hypot(u2 - p2, p1 - l1),
    )


def compare_metric(
    metric: str, reference: np.ndarray, other: np.ndarray, seed: int = 0
) -> MetricComparison | None:
    """Means, permutation test and KS distance of two samples; None with fewer than 2 values each.

    Values that are NaN (the metric is undefined in that trial) are left out.
    """
    from scipy.stats import ks_2samp, permutation_test

    a, b = (np.asarray(s, dtype=float) for s in (reference, other))
    a, b = a[np.isfinite(a)], b[np.isfinite(b)]
    if len(a) < 2 or len(b) < 2:
        return None

    def gap(x: np.ndarray, y: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.mean(x, axis=axis) - np.mean(y, axis=axis)

    test = permutation_test(
        (a, b), gap, n_resamples=4999, vectorized=True, rng=np.random.default_rng(seed)
    )
    ks = ks_2samp(a, b)
    return MetricComparison(
        metric=metric,
        reference_mean=float(a.mean()),
        other_mean=float(b.mean()),
        permutation_p=float(test.pvalue),
        ks=float(ks.statistic),  # type: ignore[attr-defined]
        ks_p=float(ks.pvalue),  # type: ignore[attr-defined]
    )


def judge(success: Mapping[str, float], bad: Mapping[str, int], parity_ok: bool) -> Verdict:
    """The verdict from success rates, counts of bad worlds (NaN and overflow) and parity.

    ``success`` and ``bad`` have the keys of ``RUNS``.
    """
    reasons, notes = [], []
    if not parity_ok:
        reasons.append("the MuJoCo and the Drake model differ (parity table)")
    for run, count in bad.items():
        if count:
            reasons.append(f"{count} worlds overflowed or became NaN in {run}")
    reference, half, drake = (success[run] for run in RUNS)
    if reference == 0:
        reasons.append("the policy never succeeds in MuJoCo, so there is nothing to verify")
        return Verdict(False, tuple(reasons))
    kept, kept_half = drake / reference, half / reference
    if kept < KEEP:
        text = f"Drake keeps {kept:.0%} of MuJoCo's success ({drake:.0%} of trials)"
        if half <= drake:
            notes.append(
                f"{text}, and so does MuJoCo at half the time step ({kept_half:.0%}): the policy "
                "leans on the time step; train it with a randomised time step, friction and gains"
            )
        else:
            reasons.append(
                f"{text}, less than {KEEP:.0%}; at half the step it keeps {kept_half:.0%}"
            )
    elif kept_half < KEEP:
        notes.append(f"at half the time step MuJoCo keeps only {kept_half:.0%} of its success")
    return Verdict(not reasons, tuple(reasons), tuple(notes), kept, kept_half)


def parity_rows(task: str, strength: str, limits: str) -> list[dict[str, Any]]:
    """The parity table of a task's athlete, as plain rows. Needs drake."""
    from sports.env import make_scene
    from sports.humanoid.parity import format_table, parity_table

    body = make_scene(task, strength=strength, limits=limits).body  # type: ignore[arg-type]
    rows = parity_table(body)
    print(format_table(rows), flush=True)
    return [{**dataclasses.asdict(row), "ok": row.ok} for row in rows]
