"""A sweep to look at: the table of its values and a picture of effort, torque and outcome."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from warmstart.atomic import write_bytes
from warmstart.job import Result

SHOWN = 4
"""Hinges in the plot of torques: those with the largest."""


def table(results: Sequence[Result], field: str, unit: str = "") -> Table:
    """The results as a rich table, one row a value."""
    of = f"\n({unit})" if unit else ""
    out = plain_table(
        *(field, f"asked{of}", f"planned{of}", f"MuJoCo{of}", f"Drake{of}", f"tracked{of}"),
        *("effort\n(s)", "peak torque\n(N m)", "solve\n(s)", "violation", "verdict"),
        caption="MuJoCo, Drake: the torques replayed open loop (a kick after a step: with "
        "feedback); tracked: with feedback, in MuJoCo",
    )
    for r in results:
        achieved = [
            number(r.achieved.get(name))
            for name in ("planned", "replay_mujoco", "replay_drake", "tracked")
        ]
        peak = r.figures.get("peak_torque")
        out.add_row(
            number(r.value),
            number(r.asked),
            *achieved,
            number(r.figures.get("effort")),
            f"{peak:.0f} {r.peak_hinge}" if peak is not None else "",
            number(r.figures.get("solve_s", r.seconds)),
            f"{r.figures['violation']:.1e}" if "violation" in r.figures else "",
            r.status,
        )
    return out


def plain_table(*columns: str, caption: str) -> Table:
    """A table without frames whose cells are not broken."""
    out = Table(box=SIMPLE_HEAD, caption=caption, caption_justify="left", padding=(0, 1, 0, 0))
    for name in columns:
        out.add_column(name, no_wrap=True)
    return out


def show(table: Table, results: Sequence[Result], console: Console) -> None:
    """Prints a table at its whole width, and beneath it what a cell has no room for: the reasons
    of what failed and the starts that are not a problem's own."""
    wide = console.options.update(width=1000)
    console.width = max(console.width, Measurement.get(console, wide, table).maximum)
    console.print(table)
    for r in results:
        start = f", from {r.start}" if r.start else ""
        if r.reason or start:
            line = f"{r.name}: {r.status}{start}{': ' if r.reason else ''}{r.reason}"
            console.print(line, markup=False, highlight=False, soft_wrap=True)


def number(value: float | None) -> str:
    """Three digits, or nothing."""
    return "" if value is None else f"{value:.3g}"


def plot(results: Sequence[Result], field: str, problem: Any, path: Path) -> Path:
    """Draws effort, peak torques and outcome against the swept value into a png file.

    ``problem`` has ``name``, ``outcome`` and ``unit``. Values without a motion are marked on the
    axis with their state; motions that the gate refused are hollow.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.9), layout="constrained")
    axes = figure.subplots(1, 3)
    rows = sorted(results, key=lambda r: r.value or 0.0)
    moved = [r for r in rows if r.figures]
    good = [r for r in moved if r.good]
    for axis in axes:
        axis.set_xlabel(field.replace("_", " "))
        axis.grid(alpha=0.3)

    def line(axis: Any, figure_of: Any, label: str, style: str = "o-") -> None:
        points = [(r.value, figure_of(r)) for r in good if figure_of(r) is not None]
        (drawn,) = axis.plot([p[0] for p in points], [p[1] for p in points], style, label=label)
        points = [(r.value, figure_of(r)) for r in moved if not r.good and figure_of(r) is not None]
        axis.plot(
            *([p[0] for p in points], [p[1] for p in points], "o"),
            fillstyle="none",
            color=drawn.get_color(),
        )

    line(axes[0], lambda r: r.figures.get("effort"), "effort")
    axes[0].set(title="Effort", ylabel="sum of squared shares of the limits (s)")
    axes[0].set_ylim(0, 1.1 * axes[0].get_ylim()[1])
    largest: dict[str, float] = {}
    for r in moved:
        for name, value in r.peaks.items():
            largest[name] = max(largest.get(name, 0.0), value)
    for name in sorted(largest, key=lambda n: -largest[n])[:SHOWN]:
        line(axes[1], lambda r, name=name: r.peaks.get(name), name.replace("_", " "))
    axes[1].set(title="Largest torques", ylabel="N m")
    axes[1].set_ylim(0, 1.1 * axes[1].get_ylim()[1])
    names = {"planned": "planned", "replay_mujoco": "MuJoCo, replayed"}
    names |= {"replay_drake": "Drake, replayed", "tracked": "MuJoCo, tracked"}
    for name, label in names.items():
        if any(name in r.achieved for r in moved):
            line(axes[2], lambda r, name=name: r.achieved.get(name) or None, label)
            color = axes[2].lines[-1].get_color()
            missed = [r.value for r in moved if r.achieved.get(name) == 0.0]
            axes[2].plot(missed, [0.0] * len(missed), "x", color=color)  # no valid attempt
    asked = [(r.value, r.asked) for r in rows if r.asked is not None]
    axes[2].plot([p[0] for p in asked], [p[1] for p in asked], "k:", label="asked")
    axes[2].set(title="Outcome", ylabel=f"{problem.outcome.replace('_', ' ')} ({problem.unit})")
    for r in rows:
        if not r.figures:
            axes[0].axvline(r.value or 0.0, color="0.6", linestyle="--")
            axes[0].annotate(
                f" {r.status}",
                (r.value or 0.0, 0.02),
                xycoords=("data", "axes fraction"),
                rotation=90,
                fontsize="small",
                color="0.4",
            )
    for axis in axes[1:]:
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize="small")
    failed = sum(not r.good for r in rows)
    hollow = f"; {failed} without a demonstration (hollow: refused by the gate)" if failed else ""
    figure.suptitle(f"{problem.name.replace('_', ' ')}: {len(rows)} values{hollow}")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return write_bytes(path, buffer.getvalue())
