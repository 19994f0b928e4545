"""The tasks by name. A new sport adds one line here (docs/new_sport.md)."""

from __future__ import annotations

import dataclasses
from typing import Any

from sports import (
    basketball,
    boxing,
    fencing,
    free_throw,
    golf,
    high_jump,
    hurdling,
    javelin,
    long_jump,
    penalty_kick,
    soccer,
    table_tennis,
    tennis,
)
from sports.humanoid.body import load_body
from sports.task import Task

_ALL = (
    high_jump.TASK,
    long_jump.TASK,
    hurdling.TASK,
    javelin.TASK,
    golf.TASK,
    tennis.TASK,
    tennis.DUEL,
    table_tennis.TASK,
    table_tennis.DUEL,
    fencing.TASK,
    boxing.TASK,
    penalty_kick.TASK,
    soccer.SOCCER_1V1,
    soccer.SOCCER_2V2,
    free_throw.TASK,
    basketball.BASKETBALL_1V1,
    basketball.BASKETBALL_2V2,
)
_TASKS: dict[str, Task] = {task.name: task for task in _ALL}


def task_names() -> tuple[str, ...]:
    """Names of all tasks, in the order of the sports' page."""
    return tuple(_TASKS)


def get_task(name: str) -> Task:
    """The task of that name. Raises ValueError that lists the known ones."""
    if name not in _TASKS:
        raise ValueError(f"unknown task '{name}'; known: {', '.join(_TASKS)}")
    return _TASKS[name]


def num_agents(name: str) -> int:
    """Athletes in a world of that task."""
    task = get_task(name)
    return task.scene(task.config(), load_body(task.body, equipment=task.equipment)).num_agents


def make_config(task: Task, options: dict[str, Any] | None = None) -> Any:
    """The task's config with ``options`` set. Raises ValueError naming an unknown option."""
    options = dict(options or {})
    known = [f.name for f in dataclasses.fields(task.config)]
    for key in options:
        if key not in known:
            have = ", ".join(known) or "none"
            raise ValueError(f"task '{task.name}' has no option '{key}'; it has: {have}")
    return task.config(**options)
