"""``olympics-opt tracker``: how well a motion tracker follows clips."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from olympics_opt.progress import progress

if TYPE_CHECKING:
    from olympics_opt.cli import Tracker

COLUMNS = (
    ("success", "followed %", 100.0),
    ("mpjpe", "mpjpe mm", 1.0),
    ("mpjpe_local", "local mm", 1.0),
    ("acceleration_error", "acc mm/fr^2", 1.0),
)
"""Figure, heading of its column, factor."""


def run_tracker(config: Tracker) -> int:
    """The command. Raises ValueError for clips or a policy that cannot be used."""
    from rl.tracker_evaluation import evaluate_tracker
    from warmstart.atomic import prepare, write_json
    from warmstart.library import load_library

    library = load_library(config.clips).split(config.split)
    out = prepare(config.out)
    with progress("clips") as bar:
        result = evaluate_tracker(
            config.policy,
            library,
            engine=config.engine,
            num_worlds=config.worlds,
            seed=config.seed,
            strength=config.strength,
            limits=config.limits,
            progress=lambda done, total: bar.show("", done, total),
        )
        bar.finish(f"{result['trials']} clips")
    write_json(out, result)
    print_table(result["splits"])
    print(f"wrote {out}")
    return 0


def print_table(splits: dict[str, Any]) -> None:
    """One row for each split, archive and sport."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, padding=(0, 0, 0, 1))
    table.add_column("clips", no_wrap=True)
    table.add_column("n", justify="right", no_wrap=True)
    for _, heading, _ in COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for split, groups in splits.items():
        rows = {split: groups["all"]}
        for kind in ("archives", "tags"):
            rows |= {f"  {kind[:-1]} {name}": row for name, row in groups[kind].items()}
        for name, row in rows.items():
            means = [row[key]["mean"] for key, _, _ in COLUMNS]
            cells = (
                "-" if mean is None else f"{factor * mean:.1f}"
                for mean, (_, _, factor) in zip(means, COLUMNS)
            )
            table.add_row(name, str(row["success"]["n"]), *cells)
    Console().print(table)
