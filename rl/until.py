"""Ends a run, or a lesson of several, once a figure of its log has come to a level."""

from __future__ import annotations

import re
from collections import deque

from rl.runlog import Row

ITERATIONS = 12
"""Of how many the mean is taken: those that tell the figure at all."""
GROUPS = ("metrics/", "curriculum/")
ALONE = ("return", "episode_steps")
"""Columns that say how well it goes, and are the same in all processes."""


NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


class Until:
    """A condition such as ``curriculum/h_max>=0.55``, and whether a run has met it.

    The level is compared with the mean of the column's last ``ITERATIONS`` values. A run that is
    resumed begins to count anew.
    """

    def __init__(self, text: str) -> None:
        """Raises ValueError for what is no condition, and for columns that say nothing of skill."""
        found = re.fullmatch(rf"\s*([\w/]+)\s*(>=|<=)\s*({NUMBER})\s*", text)
        if found is None:
            raise ValueError(
                f"until must be a column of progress.csv, >= or <=, and a number, such as "
                f"metrics/success>=0.9: not '{text}'"
            )
        self.column, self.above, self.level = found[1], found[2] == ">=", float(found[3])
        if not _tells(self.column):
            known = ", ".join((*(f"{group}NAME" for group in GROUPS), *ALONE))
            raise ValueError(f"until looks at {known}: not at '{self.column}'")
        self._values: deque[float] = deque(maxlen=ITERATIONS)

    def __call__(self, row: Row) -> bool:
        """Whether the run has come there with this row. Raises ValueError, naming the columns that
        there are, where the log has no such one."""
        if self.column not in row:
            known = ", ".join(filter(_tells, row))
            raise ValueError(f"there is no {self.column} in this log; it has: {known}")
        value = row[self.column]
        if value is not None:
            self._values.append(float(value))
        if len(self._values) < ITERATIONS:
            return False
        mean = sum(self._values) / ITERATIONS
        return mean >= self.level if self.above else mean <= self.level


def _tells(column: str) -> bool:
    """Whether a column says how well it goes."""
    return column.startswith(GROUPS) or column in ALONE
