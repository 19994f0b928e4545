"""Learning curves for ``results/curves/``: a run's ``progress.csv`` thinned out, with its origin.

``python -m rl.curves RUN OUT.json`` for a run here; a policy file with its card beside its curve
(``NAME.safetensors``, ``NAME.json``, ``NAME.csv``) does as well.
"""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rl import provenance
from rl.config import TrainConfig, task_options
from rl.runlog import KINDS
from warmstart.atomic import write_json

POINTS = 20
"""Rows that are kept, the first and the last among them."""
DIGITS = 4
"""Of every number that is not whole: more are noise, and most of the file."""
KEPT = ("samples", "minutes", "return", "episode_steps", "samples_per_s", "nan_worlds", "overflow")
KEPT += ("middle", "candidates")
GROUPS = ("metrics/", *(f"{kind}/" for kind in KINDS), "curriculum/", "cost/")
ORIGIN = ("task", "algo", "strength", "limits", "commit", "hardware", "versions", "config")


def record_curve(
    progress: str | Path, card: dict[str, Any], out: str | Path, points: int = POINTS
) -> Path:
    """Writes one curve.

    Args:
        progress: ``progress.csv`` of a run.
        card: of the policy it ended with; its origin is copied.
        out: JSON file, written atomically, on one line: the origin, of its settings those that are
            not ``train``'s usual ones as of ``usual_of``, a commit; and ``rows``, a list of numbers
            (null where there was none) for each column: samples, minutes, mean return and length of
            episodes, speed, broken worlds, and every metric, curriculum and charge; of a policy
            that was polished what ``olympics-opt polish`` wrote, with the origin of that search.
        points: rows to keep, evenly spread.

    Raises ValueError for a file without rows or columns of a curve.
    """
    with open(progress, newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows or "samples" not in rows[0]:
        raise ValueError(f"{progress} is no learning curve: it needs rows and a column 'samples'")
    last = len(rows) - 1
    picked = sorted({round(i * last / max(points - 1, 1)) for i in range(points)} | {last})
    names = [k for k in rows[0] if k in KEPT or k.startswith(GROUPS)]
    columns = {name: [_number(rows[i][name]) for i in picked] for name in names}
    origin = {name: card[name] for name in ORIGIN if name in card}
    if "middle" in rows[0] and "polish" in card:
        search = dict(card["polish"])
        origin |= {name: search.pop(name) for name in ("commit", "hardware")} | {"config": search}
    elif "config" in origin:
        origin["config"] = differing(origin["config"], usual_settings(card["task"]))
        origin["usual_of"] = provenance.commit()
    curve = {"format": "olympics-opt curve 1", **origin, "rows": columns}
    return write_json(out, curve, indent=None)


def usual_settings(task: str) -> dict[str, Any]:
    """What ``train TASK`` is told by default, as JSON has it."""
    plain = TrainConfig(options=asdict(task_options(task)()))
    return json.loads(json.dumps(asdict(plain), default=str))


def differing(settings: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that are not the usual ones, in groups likewise; empty groups are left out."""
    told: dict[str, Any] = {}
    for name, value in settings.items():
        common = usual.get(name)
        if isinstance(value, Mapping) and isinstance(common, Mapping):
            if some := differing(value, common):
                told[name] = some
        elif name not in usual or value != common:
            told[name] = value
    return told


def _number(text: str | None) -> float | None:
    value = float(text) if text else math.nan
    if not math.isfinite(value):
        return None
    return int(value) if value.is_integer() else float(f"{value:.{DIGITS}g}")


def main(args: Sequence[str]) -> int:
    """The command; 2 for a mistake, told in a sentence."""
    from rl.policy import export_policy

    try:
        if len(args) != 2:
            raise ValueError("give a run's folder or a policy file, and the JSON file to write")
        source, out = Path(args[0]), Path(args[1])
        if (source / "search.npz").exists():  # of olympics-opt polish
            policy, progress = source / "policy.safetensors", source / "progress.csv"
        elif source.is_dir():
            policy = export_policy(source, source / "policy.safetensors")
            progress = source / "progress.csv"
        else:
            policy, progress = source, source.with_suffix(".csv")
        card = json.loads(policy.with_suffix(".json").read_text())
        print(f"wrote {record_curve(progress, card, out)}")
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
