"""Tables of what was measured of speed: each task on each engine, and endurance (``bench``), and
training on several GPUs (``rl.scaling``).

They stand in ``results/README.md`` beside the results; every figure comes from a file.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Measured:
    """What a folder holds: each row with ``file``, ``hardware`` and ``commit``."""

    speeds: Rows
    soaks: Rows
    scalings: Rows


def read_measured(folder: str | Path) -> Measured:
    """Every row that ``bench``, ``bench --soak`` and ``rl.scaling`` wrote into files of a folder,
    by task, engine and number of worlds, those of ``rl.scaling`` by number of processes, too.
    Raises ValueError naming a row that lacks what a table needs."""
    speeds, soaks, scalings = [], [], []
    for path in sorted(Path(folder).glob("*.json")):
        data = json.loads(path.read_text())
        if not isinstance(data, dict):
            continue
        names = ("commit", "hardware", "task", "engine")
        origin = {"commit": "", "hardware": ""} | {n: data[n] for n in names if n in data}
        for key, mark, found, needed in (  # files of other kinds have rows, too
            ("rows", "steps_per_turn", speeds, "environment"),
            ("rows", "warm_up_s", scalings, "processes"),
            ("soak", "soak", soaks, "steps_per_second"),
        ):
            rows = data.get(key)
            if not isinstance(rows, list) or mark not in data:
                continue
            for row in rows:
                whole = {**origin, **row} if isinstance(row, dict) else {}
                if "task" not in whole or needed not in whole:
                    raise ValueError(f"{path}: a row of '{key}' lacks its task or '{needed}'")
                found.append({**whole, "file": path.name})

    def order(row: Mapping[str, Any]) -> tuple[Any, ...]:
        return row["task"], row["engine"], row["worlds"], row["file"], row.get("processes", 0)

    return Measured(*(sorted(rows, key=order) for rows in (speeds, soaks, scalings)))


SPEED = (
    "Control steps of all worlds a second, by `olympics-opt bench`. *Physics* is the library's own "
    "stepping of the same model; on a GPU the environment's has faster pieces (docs/physics.md), "
    "hence shares above 100 %."
)
ENDURANCE = (
    "Random actions for so many control steps of each world, by `olympics-opt bench --soak`."
)
SCALING = (
    "Training with `torchrun`, a process for each GPU with so many worlds, by "
    "`python -m rl.scaling`: samples of all of them a second, and how many times one's."
)


def sections(measured: Measured) -> list[tuple[str, str, list[str], list[list[str]]]]:
    """Title, explanation, head and cells of each table that has rows."""
    out = []
    if measured.speeds:
        head = ["task", "engine", "worlds", "time step", "physics /s", "environment /s"]
        head += ["share", "training /s", "GPU GiB", "hardware", "commit", "file"]
        out.append(("Speed", SPEED, head, [_speed(row) for row in measured.speeds]))
    if measured.soaks:
        head = ["task", "engine", "worlds", "steps", "episodes", "not finite", "diverged"]
        head += ["overflow", "GPU GiB, then", "steps/s", "hardware", "commit", "file"]
        out.append(("Endurance", ENDURANCE, head, [_soak(row) for row in measured.soaks]))
    if measured.scalings:
        head = ["task", "engine", "worlds of each", "processes", "samples/s", "times one"]
        head += ["rollout s", "update s", "hardware", "commit", "file"]
        out.append(("Several GPUs", SCALING, head, [_scaling(row) for row in measured.scalings]))
    return out


def _speed(row: Mapping[str, Any]) -> list[str]:
    share = row.get("environment_share")
    return [
        *_which(row),
        f"{row['substeps']} x 1/{1 / row['timestep']:.0f} s",
        rate(row["bare_physics"]),
        rate(row["environment"]),
        "–" if share is None else f"{100 * share:.0f} %",
        rate(row.get("training")),
        _gib([row.get("device_memory_gib")]),
        *_origin(row),
    ]


def _soak(row: Mapping[str, Any]) -> list[str]:
    return [
        *_which(row),
        str(row["steps"]),
        str(row["episodes"]),
        str(row["bad_observations"] + row["bad_rewards"]),
        str(row["nan_worlds"]),
        overflowed(row),
        _gib(row.get("device_memory_gib") or [None]),
        rate(row["steps_per_second"]),
        *_origin(row),
    ]


def _scaling(row: Mapping[str, Any]) -> list[str]:
    ratio = row.get("ratio")
    return [
        *_which(row),
        str(row["processes"]),
        rate(row["samples_per_s"]),
        "–" if ratio is None else f"{ratio:.2f}",
        f"{row['rollout_s']:.3f}",
        f"{row['update_s']:.3f}",
        *_origin(row),
    ]


def overflowed(row: Mapping[str, Any]) -> str:
    """How many worlds overflowed in a soak, and which buffers: ``3 (epa_horizon)``."""
    kinds = ", ".join(sorted(row.get("overflows", ())))
    return f"{row['overflow']} ({kinds})" if kinds else str(row["overflow"])


def _which(row: Mapping[str, Any]) -> list[str]:
    return [row["task"], row["engine"], str(row["worlds"])]


def _origin(row: Mapping[str, Any]) -> list[str]:
    return [row["hardware"], str(row["commit"])[:9], f"[{row['file']}]({row['file']})"]


def rate(value: float | None) -> str:
    """A number a second, as tables show it."""
    if value is None:
        return "–"
    return f"{value / 1000:.1f} k" if value >= 1000 else f"{value:.0f}"


def _gib(values: Sequence[float | None]) -> str:
    return ", ".join("–" if value is None else f"{value:.1f}" for value in values)
