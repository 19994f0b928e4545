"""Plots as SVG text: no library on the page, colours from the page's style sheet.

A plot takes its colours from CSS classes (``s0`` .. ``s5``), so that it follows the reader's
light or dark setting, and carries its own numbers, so that a few lines of script in the page can
show the values under the pointer.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np

WIDTH, HEIGHT = 560, 240
LEFT, RIGHT, TOP, BOTTOM = 58, 14, 14, 40
MAX_POINTS = 400
COLOURS = 6


@dataclass(frozen=True)
class Series:
    """One line of a plot."""

    name: str
    x: np.ndarray
    """(K,) increasing."""
    y: np.ndarray
    """(K,); values that are not finite leave a gap."""
    step: bool = False
    """Draws a staircase (for empirical distributions)."""


@dataclass(frozen=True)
class Plot:
    """A line plot with its labels; units belong in the labels."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    marks: dict[str, float] = field(default_factory=dict)
    """Vertical marks: text -> x."""
    levels: dict[str, float] = field(default_factory=dict)
    """Horizontal marks: text -> y."""
    y_range: tuple[float, float] | None = None
    """Fixed range of y (a rate: 0 to 1); None to fit the numbers."""


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About ``count`` round numbers (1, 2, 2.5 or 5 times a power of ten) in [low, high]."""
    span = high - low
    if not (math.isfinite(span) and span > 0):
        return [low]
    power = 10.0 ** math.floor(math.log10(span / count))
    step = min((m * power for m in (1, 2, 2.5, 5, 10)), key=lambda s: abs(span / s - count))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def svg(plot: Plot) -> str:
    """The plot as one ``<figure>`` element. Empty string when no series has a finite point."""
    drawn = [_thin(s) for s in plot.series]
    drawn = [s for s in drawn if len(s.x) and np.isfinite(s.y).any()]
    if not drawn:
        return ""
    x0, x1 = _range(
        [v for s in drawn for v in (s.x.min(), s.x.max())] + list(plot.marks.values()), 0
    )
    y0, y1 = plot.y_range or _range(
        [v for s in drawn for v in (np.nanmin(_finite(s.y)), np.nanmax(_finite(s.y)))]
        + list(plot.levels.values()),
        0.06,
    )

    def px(x: float) -> float:
        return LEFT + (x - x0) / (x1 - x0) * (WIDTH - LEFT - RIGHT)

    def py(y: float) -> float:
        return HEIGHT - BOTTOM - (y - y0) / (y1 - y0) * (HEIGHT - TOP - BOTTOM)

    parts: list[str] = []
    for value in ticks(y0, y1):
        y = py(value)
        parts.append(
            f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
        )
        parts.append(
            f'<text class="tick" x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">'
            f"{_number(value)}</text>"
        )
    for value in ticks(x0, x1, 6):
        x = px(value)
        parts.append(
            f'<text class="tick" x="{x:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">'
            f"{_number(value)}</text>"
        )
    base = HEIGHT - BOTTOM
    parts.append(f'<line class="axis" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{base}" y2="{base}"/>')
    for text, value in plot.marks.items():
        x = px(value)
        parts.append(f'<line class="mark" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{base}"/>')
        anchor, shift = ("end", -4) if x > WIDTH / 2 else ("start", 4)
        parts.append(
            f'<text class="tick" x="{x + shift:.1f}" y="{TOP + 10}" text-anchor="{anchor}">'
            f"{escape(text)}</text>"
        )
    for text, value in plot.levels.items():
        y = py(value)
        parts.append(
            f'<line class="mark" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
        )
        parts.append(
            f'<text class="tick" x="{WIDTH - RIGHT - 4}" y="{y - 4:.1f}" text-anchor="end">'
            f"{escape(text)}</text>"
        )
    for i, s in enumerate(drawn):
        parts.append(f'<path class="line s{i % COLOURS}" d="{_path(s, px, py)}"/>')
    parts.append(
        f'<text class="label" x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 6}" '
        f'text-anchor="middle">{escape(plot.x_label)}</text>'
    )
    parts.append(
        f'<text class="label" transform="translate(13 {(TOP + base) / 2}) rotate(-90)" '
        f'text-anchor="middle">{escape(plot.y_label)}</text>'
    )
    numbers = {
        "box": [LEFT, WIDTH - RIGHT, TOP, base],
        "x": [x0, x1],
        "xLabel": plot.x_label,
        "series": [{"name": s.name, "x": _rounded(s.x), "y": _rounded(s.y)} for s in drawn],
    }
    legend = "".join(
        f'<span class="key"><i class="swatch s{i % COLOURS}"></i>{escape(s.name)}</span>'
        for i, s in enumerate(drawn)
    )
    shown = f'<div class="legend">{legend}</div>' if len(drawn) > 1 else ""
    return (
        f'<figure class="plot"><figcaption>{escape(plot.title)}</figcaption>{shown}'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(plot.title)}" '
        f'data-plot="{escape(json.dumps(numbers))}">{"".join(parts)}</svg></figure>'
    )


def ecdf(name: str, values: np.ndarray) -> Series:
    """Empirical distribution function of a sample (K,) as a staircase."""
    x = np.sort(np.asarray(values, dtype=float))
    x = x[np.isfinite(x)]
    y = np.arange(1, len(x) + 1) / max(len(x), 1)
    if len(x):
        x, y = np.concatenate(([x[0]], x)), np.concatenate(([0.0], y))
    return Series(name, x, y, step=True)


def _thin(s: Series) -> Series:
    x, y = np.asarray(s.x, dtype=float), np.asarray(s.y, dtype=float)
    keep = np.isfinite(x)
    x, y = x[keep], y[keep]
    if len(x) > MAX_POINTS:
        pick = np.unique(np.linspace(0, len(x) - 1, MAX_POINTS).round().astype(int))
        x, y = x[pick], y[pick]
    return Series(s.name, x, y, s.step)


def _finite(y: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(y), y, np.nan)


def _range(values: list[float], margin: float) -> tuple[float, float]:
    low, high = float(min(values)), float(max(values))
    if high - low < 1e-12 * max(1.0, abs(high)):
        pad = 0.5 * abs(high) or 0.5
        return low - pad, high + pad
    pad = margin * (high - low)
    return low - pad, high + pad


def _number(value: float) -> str:
    if value and (abs(value) >= 1e5 or abs(value) < 1e-3):
        return f"{value:.3g}".replace("e+0", "e").replace("e+", "e").replace("e-0", "e-")
    return f"{value:.10g}" if abs(value) > 1e-12 else "0"


def _rounded(values: np.ndarray) -> list[float | None]:
    return [float(f"{v:.5g}") if math.isfinite(v) else None for v in values]


def _path(s: Series, px, py) -> str:
    commands, pen, before = [], False, 0.0
    for x, y in zip(s.x, s.y):
        if not math.isfinite(y):
            pen = False
            continue
        if pen and s.step:
            commands.append(f"L{px(x):.1f} {py(before):.1f}")
        commands.append(f"{'L' if pen else 'M'}{px(x):.1f} {py(y):.1f}")
        pen, before = True, y
    return "".join(commands)
