"""``olympics-opt polish``: a trained policy made better by its whole episodes."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

from olympics_opt.progress import progress

if TYPE_CHECKING:
    from olympics_opt.cli import Polish
    from rl.polish import Generation


def run_polish(config: Polish) -> int:
    """The command. Raises ValueError for a mistake, before anything is written."""
    from olympics_opt.cli import chosen_options
    from rl.polish import POLICY, Polishing, polish

    same = {f.name for f in fields(Polishing)} - {"task"}
    search = Polishing(task=config.name, **{name: getattr(config, name) for name in same})
    with progress(f"polishing {config.name}") as bar:

        def show(now: Generation) -> None:
            bar.show(sentence(now), now.minutes, config.minutes)

        told = polish(search, config.out, chosen_options(config, "task"), show)
        bar.finish(sentence(told[-1]) if told else "nothing left to do")
    print(f"wrote {config.out / POLICY}")
    print(f"next: olympics-opt evaluate {config.name} --policy {config.out / POLICY} --out FILE")
    return 0


def sentence(now: Generation) -> str:
    """What a generation came to, in one line."""
    return (
        f"generation {now.number}, {now.episodes:,} episodes, worth {now.middle:.4g} in the middle "
        f"and {now.candidates:.4g} around it, spread {now.spread:.2g} of the first"
    )
