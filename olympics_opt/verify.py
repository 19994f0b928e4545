"""Does a result hold in another engine? The same policy in MuJoCo, at half its step, and in Drake.

Order of the argument: first the parity table (are the two models the same body?), then the
scores. A result passes when Drake keeps at least 90 % of MuJoCo's success. Where it does not, but
MuJoCo at half the time step loses as much, the loss belongs to the policy (it leans on the time
step), not to the engine; the report says so. Numbers that overflowed or became NaN fail.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warmstart import atomic

if TYPE_CHECKING:
    from olympics_opt.cli import Verify

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


def run_verify(config: Verify) -> int:
    """The command: 0 when the result holds, 1 when it does not."""
    from olympics_opt.play import asked, print_training_step
    from olympics_opt.report.page import Page, write_page
    from olympics_opt.report.verification import verification_sections
    from rl.kept_shares import forget

    if config.trials < 1:
        raise ValueError(f"trials must be at least 1, not {config.trials}")
    if config.parting_steps < 0:
        raise ValueError(f"parting-steps must not be negative, not {config.parting_steps}")
    trials = asked(config)
    atomic.prepare(config.out / "report.json")
    parts = config.out / "drake.parts"
    report, recordings = verify(**trials, parting_steps=config.parting_steps, parts=parts)
    atomic.write_json(config.out / "report.json", report)
    page = Page(
        f"{config.name.replace('_', ' ').capitalize()}: does the result hold in Drake?",
        verification_sections(report, recordings),
        f"The policy {config.policy} in MuJoCo, in MuJoCo at half the time step, and in Drake.",
    )
    path = write_page(page, config.out / "report.html")
    print(verdict_text(report))
    print_training_step(config)
    print(f"wrote {path} and {config.out / 'report.json'}")
    forget(parts)
    return 0 if report["verdict"]["passed"] else 1


def verify(
    task: str,
    policy: str,
    *,
    trials: int,
    seed: int = 0,
    strength: str | None = None,
    limits: str | None = None,
    options: dict[str, Any] | None = None,
    processes: int = 2,
    parting_steps: int = 0,
    parts: Path | None = None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Parity table first, then the same trials in the three runs, then ``parting_steps`` control
    steps of a few worlds from the same states in two (``rl.parting``). Finished shares of Drake's
    trials are kept in ``parts``, and taken from there.

    Returns the report as JSON values and one recording per run (the median episode). Stops after
    the parity table when the two models differ. Raises ValueError for an unknown task or option,
    PolicyError for a policy that cannot be used, RuntimeError where Drake is missing.
    """
    from olympics_opt.play import athlete, play
    from rl import provenance

    strength, limits = athlete(policy, task, strength, limits)
    parity = parity_rows(task, strength, limits)
    report: dict[str, Any] = {
        "task": task,
        "policy": policy,
        "strength": strength,
        "limits": limits,
        "options": options or {},
        "trials": trials,
        "seed": seed,
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
        "parity": parity,
        "results": {},
        "samples": {},
        "parting": None,
    }
    if not all(row["ok"] for row in parity):
        verdict = Verdict(False, ("the MuJoCo and the Drake model differ (parity table)",))
        return {**report, "verdict": dataclasses.asdict(verdict)}, {}
    recordings = {}
    for run in RUNS:
        played = play(
            task,
            policy,
            engine="drake" if run == "drake" else "mujoco",
            trials=trials,
            seed=seed,
            strength=strength,
            limits=limits,
            options=options,
            timestep_divisor=2 if run == "mujoco-half-step" else 1,
            processes=processes,
            record=True,
            label=run,
            parts=parts,
        )
        report["results"][run] = played.result
        report["options"] = played.result["options"]  # with those of the policy's card
        report["samples"][run] = {k: np.asarray(v).tolist() for k, v in played.trials.items()}
        recordings[run] = played.median
    if parting_steps:
        report["parting"] = _parting(report, parting_steps)
    return {**report, **compare(report["results"], report["samples"])}, recordings


def _parting(report: Mapping[str, Any], steps: int) -> dict[str, Any]:
    from olympics_opt.progress import progress
    from rl.parting import find_parting
    from rl.policy import load_policy

    with progress(f"playing {report['task']}, step by step in both engines") as bar:
        found = find_parting(
            load_policy(report["policy"], report["task"]),
            report["task"],
            steps=steps,
            seed=report["seed"],
            strength=report["strength"],
            limits=report["limits"],
            options=report["options"],
        )
        bar.finish(f"{found.steps} steps, {found.velocity:.2f} rad/s apart")
    return dataclasses.asdict(found)


def compare(
    results: Mapping[str, Mapping[str, Any]], samples: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Success differences, metric comparisons and the verdict of three runs, as JSON values.

    ``results`` are results of the schema by run, ``samples`` run -> metric -> (trials,) values.
    """
    reference = {k: np.asarray(v, dtype=float) for k, v in samples["mujoco"].items()}
    success, metrics = {}, {}
    for run in RUNS[1:]:
        other = {k: np.asarray(v, dtype=float) for k, v in samples[run].items()}
        difference = success_difference(reference["success"], other["success"])
        success[run] = {**dataclasses.asdict(difference), "difference": difference.difference}
        pairs = [
            compare_metric(name, reference[name], other[name])
            for name in reference
            if name != "success" and name in other
        ]
        metrics[run] = [dataclasses.asdict(p) for p in pairs if p is not None]
    rates = {run: float(np.mean(np.asarray(samples[run]["success"]) > 0.5)) for run in RUNS}
    bad = {
        run: int(results[run].get("overflow") or 0) + int(results[run].get("nan_worlds") or 0)
        for run in RUNS
    }
    return {
        "success": success,
        "comparisons": metrics,
        "verdict": dataclasses.asdict(judge(rates, bad, parity_ok=True)),
    }


def verdict_text(report: Mapping[str, Any]) -> str:
    """The verdict in a sentence or two."""
    verdict = report["verdict"]
    kept = verdict.get("kept")
    start = "The result holds" if verdict["passed"] else "The result does not hold"
    figure = f": Drake keeps {kept:.0%} of MuJoCo's success" if kept is not None else ""
    rest = [*verdict["reasons"], *verdict["notes"]]
    return f"{start}{figure}." + "".join(f" {text[0].upper()}{text[1:]}." for text in rest)
