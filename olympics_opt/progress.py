"""The one progress display: a spinner, a bar, the time, and a word about where the work is."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

LINE_SECONDS = 60.0
"""Without a terminal a line is printed at most this often."""


class Bar:
    """One line of the display."""

    def __init__(self, display, description: str) -> None:
        self._display, self._description = display, description
        self._task = display.add_task(description, total=None, detail="")
        self._printed = time.monotonic()

    def show(self, detail: str, done: float | None = None, total: float | None = None) -> None:
        """Sets the words at the end, and how much of the work is done where that is known."""
        self._display.update(self._task, detail=detail, completed=done, total=total)
        now = time.monotonic()
        if not self._display.console.is_terminal and now - self._printed >= LINE_SECONDS:
            self._printed = now
            share = f" ({done / total:.0%})" if done and total and done % 1 else ""
            self._display.console.print(f"  {self._description}: {detail}{share}", highlight=False)

    def finish(self, detail: str) -> None:
        """Ends the line with what came out."""
        self._display.update(self._task, detail=detail, completed=1, total=1)


@contextmanager
def progress(description: str) -> Iterator[Bar]:
    """Shows a line while the body runs; without a terminal its final state is printed, and before
    that a line each minute."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (
        SpinnerColumn(finished_text=" "),
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        TimeElapsedColumn(),
        TextColumn("{task.fields[detail]}"),
    )
    # A notebook is no terminal either: rich would want ipywidgets there, or draw every frame.
    console = Console(force_jupyter=False, force_terminal=sys.stdout.isatty())
    with Progress(*columns, console=console, refresh_per_second=4) as display:
        yield Bar(display, description)
