"""The shipped actors: ``rl/pretrained/TASK/ALGO-STRENGTH.safetensors`` and their cards."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent


def available() -> list[dict[str, Any]]:
    """What is shipped: one dict per policy with task, algo, strength and path, sorted."""
    found = []
    for path in sorted(FOLDER.glob("*/*.safetensors")):
        if path.parent.name == "prior":  # no policy, but what latent ones act through
            continue
        algo, _, strength = path.stem.rpartition("-")
        found.append(
            {"task": path.parent.name, "algo": algo, "strength": strength, "path": str(path)}
        )
    return found


def locate(task: str, name: str = "ppo") -> Path:
    """File of the shipped policy ``ALGO`` (strength paper first) or ``ALGO-STRENGTH`` of a task.

    Raises ValueError that lists what is shipped.
    """
    have = [p for p in available() if p["task"] == task]
    exact = [p for p in have if f"{p['algo']}-{p['strength']}" == name]
    by_algo = sorted((p for p in have if p["algo"] == name), key=lambda p: p["strength"] != "paper")
    for p in exact + by_algo:
        return Path(p["path"])
    names = ", ".join(f"pretrained:{p['algo']}-{p['strength']}" for p in have) or "none"
    raise ValueError(f"there is no pretrained policy '{name}' for task '{task}'; shipped: {names}")


def card(path: Path) -> dict[str, Any]:
    """The JSON card of a shipped policy."""
    return json.loads(path.with_suffix(".json").read_text())
