"""What a run writes while it learns: progress.csv, TensorBoard events, a line or a panel."""

from __future__ import annotations

import csv
import io
import math
import sys
from pathlib import Path
from typing import Any

from warmstart.atomic import write_text

Row = dict[str, float | int | None]
KINDS = ("own", "others")
"""Of worlds, the task's own and others, where a run has both: a metric has a column of each,
``own/success``."""


class RunLog:
    """One row per iteration, to the CSV (flushed), TensorBoard and the screen."""

    def __init__(self, out: Path, columns: list[str], after: int, quiet: bool) -> None:
        """Args:
        out: the run's folder.
        columns: of the CSV.
        after: rows of later iterations, left by a run that was killed, are dropped.
        quiet: write files only.
        """
        self.path, self.columns, self.quiet = out / "progress.csv", columns, quiet
        rows = [r for r in _raw_rows(out) if int(r["iteration"]) <= after] if after else []
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_text(self.path, text.getvalue())
        self._file = open(self.path, "a", newline="")
        self._csv = csv.DictWriter(self._file, columns, lineterminator="\n")
        self._events = _event_writer(out / "tensorboard", after)
        self._live: Any = None
        if not quiet and sys.stdout.isatty():
            from rich.live import Live

            self._live = Live(refresh_per_second=4)
            self._live.start()

    def write(self, row: Row, share: float) -> None:
        """Adds a row. ``share`` of the run is done, 0..1, for the screen. Raises OSError."""
        self._csv.writerow({k: row.get(k) for k in self.columns})
        self._file.flush()
        if self._events is not None:
            for name, value in row.items():
                if value is not None and name not in ("iteration", "samples"):
                    section = name if "/" in name else f"train/{name}"
                    self._events.add_scalar(section, value, row["samples"])
        if self.quiet:
            return
        if self._live is not None:
            self._live.update(_panel(row, share))
        else:
            print(_line(row, share), flush=True)

    def close(self) -> None:
        """Flushes and ends the display."""
        if self._live is not None:
            self._live.stop()
        self._file.close()
        if self._events is not None:
            self._events.close()


def read_progress(run: Path | str) -> list[Row]:
    """Rows of a run's progress.csv as numbers; an empty cell is None."""
    return [
        {k: (int(v) if k in ("iteration", "samples") else float(v)) if v else None for k, v in r}
        for r in (raw.items() for raw in _raw_rows(Path(run)))
    ]


def _raw_rows(run: Path) -> list[dict[str, str]]:
    """Rows as text. A line torn by a kill, or one that is not numbers, is left out."""
    path = run / "progress.csv"
    if not path.is_file():
        return []
    rows = []
    with open(path, newline="") as f:
        for raw in csv.DictReader(f):
            try:
                for value in raw.values():
                    float(value or 0.0)
                int(raw["iteration"])
            except (ValueError, KeyError, TypeError):
                continue
            if None not in raw.values():
                rows.append(raw)
    return rows


def _event_writer(folder: Path, after: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        print("tensorboard is not installed: no events are written", file=sys.stderr)
        return None
    return SummaryWriter(str(folder), flush_secs=30)


def _text(value: float | int | None) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


_SHOWN = (
    "samples",
    "minutes",
    "samples_per_s",
    "return",
    "episode_steps",
    "action_error",
    "kl",
    "active",
    "learning_rate",
    "sigma",
    "middle",
    "candidates",
    "spread",
)


def _line(row: Row, share: float) -> str:
    words = [f"{share:4.0%}", f"iteration {row['iteration']}"]
    words += [f"{name} {_text(row[name])}" for name in _SHOWN if name in row]
    words += [f"{k[8:]} {_text(v)}" for k, v in row.items() if k.startswith("metrics/")]
    kinds = tuple(f"{kind}/" for kind in KINDS)
    words += [f"{k.replace('/', ' ')} {_text(v)}" for k, v in row.items() if k.startswith(kinds)]
    return " | ".join(words)


def _panel(row: Row, share: float) -> Any:
    from rich.columns import Columns
    from rich.panel import Panel
    from rich.progress_bar import ProgressBar
    from rich.table import Table

    def table(title: str, names: list[str]) -> Table:
        grid = Table(title=title, title_justify="left", show_header=False, box=None)
        for name in (n for n in names if n in row):
            grid.add_row(name.partition("/")[2] or name, _text(row.get(name)))
        return grid

    groups = [table("learning", [*_SHOWN, "explained_variance", "episodes"])]
    for section in ("metrics", *KINDS, "terms", "curriculum"):
        names = [k for k in row if k.startswith(section + "/")]
        if names:
            groups.append(table(section, names))
    outer = Table.grid()
    outer.add_row(ProgressBar(total=1.0, completed=min(share, 1.0), width=60))
    outer.add_row(Columns(groups, padding=(0, 4)))
    return Panel(outer, title=f"iteration {row['iteration']}")
