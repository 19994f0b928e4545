"""What is here: ``olympics-opt list`` and ``olympics-opt leaderboard``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from olympics_opt.cli import Leaderboard, List


def catalogue() -> dict[str, list[dict[str, Any]]]:
    """Tasks, problems, pretrained policies and demonstrations, as plain JSON values."""
    return {
        "tasks": _tasks(),
        "problems": _problems(),
        "pretrained": _pretrained(),
        "demonstrations": _demonstrations(),
    }


def run_list(config: List) -> int:
    """Prints the catalogue as tables or as JSON, or writes the pages of the demonstrations."""
    if config.previews is not None:
        from olympics_opt.previews import write_previews

        for path in write_previews(config.previews):
            print(f"wrote {path}")
        return 0
    found = catalogue()
    if config.json:
        print(json.dumps(found, indent=2))
        return 0
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for title, rows in found.items():
        if not rows:
            console.print(f"[bold]{title}[/bold]: none\n")
            continue
        table = Table(title=title, title_justify="left", title_style="bold", box=None)
        short = [_short(row) for row in rows]
        for name in short[0]:
            table.add_column(name, overflow="fold")
        for row in short:
            table.add_row(*(_cell(value) for value in row.values()))
        console.print(table)
        console.print()
    return 0


def run_leaderboard(config: Leaderboard) -> int:
    """Rebuilds the tables of results and names the files it wrote."""
    from olympics_opt.leaderboard import rebuild

    for path in rebuild(config.results, config.readme):
        print(f"wrote {path}")
    return 0


def _tasks() -> list[dict[str, Any]]:
    import dataclasses

    from sports.env import make_env
    from sports.registry import get_task, task_names

    rows = []
    for name in task_names():
        task = get_task(name)
        env = make_env(name, num_worlds=1)
        rows.append(
            {
                "name": name,
                "body": task.body,
                "agents": env.num_agents,
                "obs": env.obs_size,
                "act": env.action_size,
                "metrics": dict(task.metrics),
                "options": [f.name for f in dataclasses.fields(task.config)],
                "summary": task.summary,
            }
        )
        env.close()
    return rows


def _problems() -> list[dict[str, Any]]:
    from warmstart.problems import PROBLEMS

    return [
        {
            "name": p.name,
            "outcome": p.outcome,
            "unit": p.unit,
            "sweep": list(p.sweep),
            "summary": p.summary,
        }
        for p in PROBLEMS.values()
    ]


def _pretrained() -> list[dict[str, Any]]:
    from rl import pretrained

    return pretrained.available()


def _demonstrations() -> list[dict[str, Any]]:
    from warmstart.bank import list_demonstrations

    return list_demonstrations()


def _short(row: dict[str, Any]) -> dict[str, Any]:
    """A row for a table: of what a demonstration achieved, what was asked for and its success; a
    refined throw in words beside its motion."""
    if "throw" in row:
        row = dict(row)
        if throw := row.pop("throw"):
            from warmstart.refined_throw import shown

            reason = f". Not certified: {throw['why_not']}" if throw["why_not"] else ""
            row["motion"] = f"{row['motion']} ({shown(throw)}){reason}"
    asked, achieved = row.get("asked"), row.get("achieved")
    if not isinstance(asked, dict) or not isinstance(achieved, dict):
        return row
    return row | {"achieved": {k: v for k, v in achieved.items() if k in asked or k == "success"}}


def _cell(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(
            f"{k} {v:.4g}" if isinstance(v, float) else f"{k} ({v})" for k, v in value.items()
        )
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "–"
    return str(value)
