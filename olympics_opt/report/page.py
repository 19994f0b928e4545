"""A report page: titled sections of tiles, tables, plots, replays and video in one HTML file.

The page holds its style, script, pictures and numbers. It opens from disk without a network and
refers to nothing outside itself.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from typing import Literal, Protocol

from olympics_opt.report.plots import Plot, svg
from warmstart import atomic

Tone = Literal["", "good", "bad", "warn"]
VIDEO_LIMIT = 8 * 2**20
"""Bytes; a longer video is named, not embedded."""


class Block(Protocol):
    """A piece of a section that knows its own HTML."""

    def html(self) -> str: ...


@dataclass(frozen=True)
class Tile:
    """One headline figure."""

    name: str
    value: str
    detail: str = ""
    tone: Tone = ""


@dataclass(frozen=True)
class Tiles:
    """Headline figures side by side."""

    tiles: Sequence[Tile]

    def html(self) -> str:
        cells = "".join(
            f'<div class="tile"><div class="name">{escape(t.name)}</div>'
            f'<div class="value {t.tone}">{escape(t.value)}</div>'
            f'<div class="detail">{escape(t.detail)}</div></div>'
            for t in self.tiles
        )
        return f'<div class="tiles">{cells}</div>'


@dataclass(frozen=True)
class Table:
    """Rows of text; columns whose cells are all numbers are set right."""

    columns: Sequence[str]
    rows: Sequence[Sequence[object]]
    caption: str = ""
    tones: dict[int, Tone] | None = None
    """Row -> tone of its last cell."""

    def html(self) -> str:
        texts = [[number(cell) for cell in row] for row in self.rows]
        right = [
            bool(self.rows) and all(_is_numeric(row[j]) for row in texts if j < len(row))
            for j in range(len(self.columns))
        ]

        def cell(tag: str, j: int, text: str, tone: str = "") -> str:
            names = " ".join(n for n in ("num" if j < len(right) and right[j] else "", tone) if n)
            attribute = f' class="{names}"' if names else ""
            return f"<{tag}{attribute}>{escape(text)}</{tag}>"

        head = "".join(cell("th", j, text) for j, text in enumerate(self.columns))
        body = ""
        for i, row in enumerate(texts):
            tone = (self.tones or {}).get(i, "")
            last = len(row) - 1
            cells = "".join(cell("td", j, t, tone if j == last else "") for j, t in enumerate(row))
            body += f"<tr>{cells}</tr>"
        caption = f"<caption>{escape(self.caption)}</caption>" if self.caption else ""
        return (
            f'<div class="scroll"><table>{caption}<thead><tr>{head}</tr></thead>'
            f"<tbody>{body}</tbody></table></div>"
        )


@dataclass(frozen=True)
class Plots:
    """Line plots side by side; those without data are left out."""

    plots: Sequence[Plot]

    def html(self) -> str:
        figures = "".join(svg(p) for p in self.plots)
        return f'<div class="plots">{figures}</div>' if figures else ""


@dataclass(frozen=True)
class Text:
    """A sub-heading, a paragraph, or a verdict."""

    text: str
    kind: Literal["heading", "note", "verdict", "code"] = "note"
    tone: Tone = ""

    def html(self) -> str:
        text = escape(self.text)
        if self.kind == "heading":
            return f"<h3>{text}</h3>"
        if self.kind == "code":
            return f"<pre>{text}</pre>"
        return f'<p class="{self.kind} {self.tone}">{text}</p>'


@dataclass(frozen=True)
class Fragment:
    """HTML made by this project (the 3-D replay); it is not escaped."""

    markup: str

    def html(self) -> str:
        return self.markup


@dataclass(frozen=True)
class Video:
    """An mp4 inside the page, when it is small enough."""

    path: Path

    def html(self) -> str:
        data = self.path.read_bytes()
        if len(data) > VIDEO_LIMIT:
            return Text(f"The video {self.path.name} lies beside this page.").html()
        text = base64.b64encode(data).decode()
        return f'<video controls muted loop playsinline src="data:video/mp4;base64,{text}"></video>'


@dataclass(frozen=True)
class Section:
    """A titled part of the page."""

    title: str
    blocks: Sequence[Block]
    text: str = ""

    @property
    def anchor(self) -> str:
        """The section's id in the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


@dataclass(frozen=True)
class Page:
    """A whole report."""

    title: str
    sections: Sequence[Section]
    lead: str = ""


def number(value: object) -> str:
    """A cell's text: floats with four significant digits, None as a dash."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if value != value:
            return "–"
        size = abs(value)
        if size == 0:
            return "0"
        if size >= 1e6 or size < 1e-3:
            return f"{value:.2e}"
        return f"{value:.0f}" if size >= 1e4 else f"{value:.4g}"
    return str(value)


def _is_numeric(text: str) -> bool:
    return bool(re.fullmatch(r"[-+–]?[\d.,]*(e[-+]?\d+)?( ?±.*)?( ?%)?", text.strip()))


def render_page(page: Page) -> str:
    """The page as HTML text."""
    from jinja2 import Environment
    from markupsafe import Markup

    files = resources.files("olympics_opt.report")
    env = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = env.from_string(files.joinpath("page.html.j2").read_text())
    sections = [
        {
            "title": s.title,
            "anchor": s.anchor,
            "text": s.text,
            "blocks": [Markup(block.html()) for block in s.blocks],  # blocks escape their texts
        }
        for s in page.sections
    ]
    return template.render(
        page={"title": page.title, "lead": page.lead, "sections": sections},
        style=Markup(files.joinpath("style.css").read_text()),
        script=Markup(files.joinpath("plots.js").read_text()),
    )


def write_page(page: Page, path: str | Path) -> Path:
    """Writes the page atomically. Raises OSError when the disk is full or not writable."""
    return atomic.write_text(path, render_page(page))
