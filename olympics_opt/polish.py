"""``olympics-opt polish``: a trained policy made better by its whole episodes."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rl.polish_config import Polish


def run_polish(config: Polish) -> int:
    """The command. Raises ValueError for a mistake, before anything is written."""
    from olympics_opt.cli import chosen_options
    from rl.polish import POLICY, polish

    rows = polish(config, chosen_options(config, "task"))
    if os.environ.get("RANK", "0") != "0":  # the first process tells
        return 0
    if not rows:
        print("nothing left to do: give more --generations or --minutes")
    print(f"wrote {config.out / POLICY}")
    print(f"next: olympics-opt evaluate {config.name} --policy {config.out / POLICY} --out FILE")
    return 0
