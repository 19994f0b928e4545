"""How human a motion looks: figures beside every score, never a reward.

Each figure is compared with that of people whom no training saw (``rl.likeness_reference``): jerk,
sliding feet and sinking into the ground by quantiles of their clips, torque, torque rate and power
with what a person has at most, and the distribution of 1 s windows by a Frechet distance and
by a fresh classifier, which are compared with what people come to among themselves.

    panel = likeness_of_policy("pretrained", "hurdling")
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rl import provenance
from rl.evaluate import evaluate, interval
from rl.likeness_features import window_features
from rl.likeness_motion import Motion, Seen, from_recording, seen_in_training, short_name
from rl.likeness_reference import FEWEST, FIGURES, Reference
from rl.likeness_terms import UNITS, figures
from rl.policy import Policy, load_policy
from rl.recording import Recording
from rl.two_sample import classifier_accuracy, frechet
from sports.registry import get_task

HUMAN_LIMITS = {"torque": 1.0, "torque_rate": 1.3, "power": 1.0}
"""Of figures in units of what a person has at most; those per kg say the same in other units. The
unit of ``torque_rate`` is an estimate for a joint held still, its limit is measured: what 95 of 100
held-out clips of people ask at most of the tracker that follows them (``rl.likeness_effort``,
results/likeness_effort.json)."""
ROUNDING = 1e-3
"""Of a limit: an athlete at his limit has not exceeded it."""
NOTHING = Seen(frozenset(), frozenset())
DISTRIBUTION = {"frechet": "feature units^2", "classifier": "fraction"}


def panel(
    motions: Sequence[Motion],
    reference: Reference,
    *,
    facts: Mapping[str, Any] | None = None,
    seen: Seen = NOTHING,
) -> dict[str, Any]:
    """The panel of some motions, plain JSON.

    Args:
        motions: of one policy or source.
        reference: people to compare with; clips that are among the motions are left out.
        facts: what decided the motions (task, policy, engine, ...), at the top of the result.
        seen: what training used; it is left out of the reference too.

    ``likeness`` has for each figure {"mean", "ci95", "n", "unit", "human": {"low", "high", "n"},
    "within"}; ``within`` tells whether the mean is at most ``high`` (less than a person's is no
    fault) and is None where there is no figure or nothing to compare it with. ``human_like`` counts
    them. Raises ValueError without motions, or when too little of the reference is left.
    """
    if not motions:
        raise ValueError("there is no motion to measure")
    apart = {*seen.clips, *(short_name(m.name) for m in motions)}
    used = reference.without(apart, seen.archives)
    rows = [figures(motion) for motion in motions]
    out: dict[str, Any] = {}
    for name, unit in UNITS.items():
        row = interval(np.array([r[name] for r in rows]), unit)
        if name in FIGURES:
            row["human"] = used.band(name, all(m.simulated for m in motions))
        elif name in HUMAN_LIMITS:
            row["human"] = {"low": 0.0, "high": HUMAN_LIMITS[name], "n": 0}
        out[name] = row
    windows = [window_features(motion) for motion in motions]
    names = [m.name for m, w in zip(motions, windows) for _ in w]
    features = np.concatenate(windows)
    for name, value in _distribution(features, names, used).items():
        floor = used.floors[name]
        low = min(floor["clips"], default=None)
        out[name] = {
            "mean": value,
            "ci95": None,
            "n": len(features),
            "unit": DISTRIBUTION[name],
            "human": {"low": low, "high": floor["high"], "n": len(used.features)},
        }
    for row in out.values():
        row["within"] = _within(row)
    verdicts = [row["within"] for row in out.values() if row["within"] is not None]
    left_out = sorted({*reference.names} - {*used.names})
    return {
        **(facts or {}),
        "motions": len(motions),
        "seconds": round(sum(m.seconds for m in motions), 2),
        "windows": len(features),
        "reference": {**used.card(), "left_out": left_out, "floors": used.floors},
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
        "human_like": {"within": sum(verdicts), "of": len(verdicts)},
        "likeness": out,
    }


def likeness_of_policy(
    policy: Policy | str | Path,
    task: str,
    reference: Reference | None = None,
    *,
    trials: int = 8,
    seed: int = 0,
    engine: str = "mujoco",
    strength: str | None = None,
    limits: str | None = None,
    options: dict[str, Any] | None = None,
    progress: Callable[[float, int], None] | None = None,
) -> dict[str, Any]:
    """The panel of a policy in a task; it plays ``trials`` episodes with its mean action.

    The reference is the shipped one by default; clips that the policy's card names are left out of
    it. Raises ValueError as ``evaluate`` and ``panel`` do.
    """
    if not isinstance(policy, Policy):
        policy = load_policy(policy, task)
    played = evaluate(
        policy,
        task,
        engine=engine,
        trials=trials,
        num_worlds=trials,
        seed=seed,
        strength=strength,
        limits=limits,
        options=options,
        record_worlds=tuple(range(max(trials, 0))),
        processes=1,
        progress=progress,
    )
    return likeness_of_episodes(played.result, played.recordings, policy.metadata, reference)


def likeness_of_episodes(
    result: Mapping[str, Any],
    recordings: Mapping[str, Recording],
    card: Mapping[str, Any],
    reference: Reference | None = None,
) -> dict[str, Any]:
    """The panel of episodes ``world_W`` that an evaluation recorded, with its result's facts."""
    episodes = {n: r for n, r in recordings.items() if n.startswith("world_")}
    motions = [
        motion
        for name, recording in episodes.items()
        if len(recording.qpos) >= 2
        for motion in from_recording(recording, f"{recording.task} {name}")
    ]
    if not motions:
        raise ValueError("no episode was recorded, or all ended at once: there is no motion")
    kept = ("task", "algo", "policy_sha256", "engine", "strength", "limits", "options")
    facts = {name: result[name] for name in kept} | {
        "timestep": result["timestep"],
        "substeps": result["substeps"],
        "trials": len(episodes),
        "seed": result["seed"],
        "main": _main(result),
    }
    return panel(
        motions,
        reference or Reference.load(),
        facts=facts,
        seen=seen_in_training(dict(card)),
    )


def _main(result: Mapping[str, Any]) -> dict[str, Any]:
    """The score beside which the panel stands: success or the task's main metric."""
    metrics = result["metrics"]
    name = "success" if "success" in metrics else get_task(result["task"]).main_metric
    return {"metric": name, **metrics[name]}


def _distribution(
    features: np.ndarray, names: Sequence[str], reference: Reference
) -> dict[str, float | None]:
    """Frechet distance and classifier's accuracy; None with too few windows or episodes."""
    if len(features) < FEWEST:
        return dict.fromkeys(DISTRIBUTION)
    accuracy = classifier_accuracy(reference.features, reference.window_names(), features, names)
    return {
        "frechet": frechet(features, reference.features),
        "classifier": None if math.isnan(accuracy) else accuracy,
    }


def _within(row: Mapping[str, Any]) -> bool | None:
    high = row.get("human", {}).get("high")
    if row["mean"] is None or high is None:
        return None
    return bool(row["mean"] <= high * (1.0 + ROUNDING))
