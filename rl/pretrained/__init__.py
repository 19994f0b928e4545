"""The shipped actors: ``rl/pretrained/TASK/ALGO-STRENGTH.safetensors`` and their cards.

One more of the same algorithm and strength, ``ALGO-varied-STRENGTH``, went on in worlds that vary:
not the best at the task's own step, but the one to train on for other physics.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
VARIED = "-varied"


def available() -> list[dict[str, Any]]:
    """What is shipped: one dict per policy with task, algo, strength, name and path, sorted."""
    found = []
    for path in sorted(FOLDER.glob("*/*.safetensors")):
        if path.parent.name == "prior":  # no policy, but what latent ones act through
            continue
        name, _, strength = path.stem.rpartition("-")
        found.append(
            {
                "task": path.parent.name,
                "algo": name.removesuffix(VARIED),
                "strength": strength,
                "name": name,
                "path": str(path),
            }
        )
    return found


def locate(task: str, name: str = "ppo") -> Path:
    """File of the shipped policy ``ALGO`` (strength paper first) or ``ALGO-STRENGTH`` of a task,
    or of its ``ALGO-varied``.

    Raises ValueError that lists what is shipped.
    """
    have = [p for p in available() if p["task"] == task]
    exact = [p for p in have if f"{p['name']}-{p['strength']}" == name]
    by_name = sorted((p for p in have if p["name"] == name), key=lambda p: p["strength"] != "paper")
    for p in exact + by_name:
        return Path(p["path"])
    names = ", ".join(f"pretrained:{p['name']}-{p['strength']}" for p in have) or "none"
    raise ValueError(f"there is no pretrained policy '{name}' for task '{task}'; shipped: {names}")


def card(path: Path) -> dict[str, Any]:
    """The JSON card of a shipped policy."""
    return json.loads(path.with_suffix(".json").read_text())
