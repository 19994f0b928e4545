"""``olympics-opt polish``: a trained policy made better by its whole episodes."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from olympics_opt.cli import Polish


def run_polish(config: Polish) -> int:
    """The command. Raises ValueError for a mistake, before anything is written."""
    from olympics_opt.cli import chosen_options
    from rl.polish import POLICY, Polishing, polish

    same = {f.name for f in fields(Polishing)} - {"task"}
    search = Polishing(task=config.name, **{name: getattr(config, name) for name in same})
    if not polish(search, config.out, chosen_options(config, "task")):
        print("nothing left to do: give more --generations or --minutes")
    print(f"wrote {config.out / POLICY}")
    print(f"next: olympics-opt evaluate {config.name} --policy {config.out / POLICY} --out FILE")
    return 0
