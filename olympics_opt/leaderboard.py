"""Tables of results made from files: ``results/*.json`` beside the paper's numbers.

No number in a table is typed: ours come from the JSON files that ``evaluate`` wrote, the paper's
from ``paper_results.csv`` (arXiv 2407.00187, tables 1 to 4; 1000 trials each).
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from olympics_opt.speeds import Measured, read_measured, sections
from rl.worlds import OTHER_PHYSICS
from warmstart import atomic

BEGIN, END = "<!-- results -->", "<!-- /results -->"
REQUIRED = ("task", "algo", "engine", "strength", "trials", "seed", "commit", "metrics")
PAPER_COLUMNS = ("PPO", "AMP", "PULSE", "PULSE + AMP")
PAPER_METHOD = {"amp": "AMP", "latent": "PULSE", "latent-amp": "PULSE + AMP"}
"""The paper's method beside which an algorithm of ours stands; PPO for the others."""


def read_results(folder: str | Path) -> list[dict[str, Any]]:
    """Every result in a folder, sorted by task, strength, algorithm and engine.

    Files of other kinds (a benchmark) and results of other physics than the task's own are left
    out. Raises ValueError naming a file that is not JSON, or a result that lacks a field.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"no folder of results at {folder}")
    results = []
    for path in sorted(folder.glob("*.json")):
        try:
            result = json.loads(path.read_text())
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise ValueError(f"{path} is not a readable result file: {error}") from error
        if not isinstance(result, dict) or "task" not in result or "metrics" not in result:
            continue
        if result.keys() & OTHER_PHYSICS:
            continue
        missing = [name for name in REQUIRED if name not in result]
        if missing:
            raise ValueError(f"{path} is not a whole result: it lacks {', '.join(missing)}")
        results.append({**result, "file": path.name})
    order = {"mujoco": 0, "warp": 1, "drake": 2}
    return sorted(
        results,
        key=lambda r: (
            r["task"],
            r["strength"] != "paper",
            r["algo"],
            order.get(r["engine"], 9),
            -r["trials"],
            r["file"],
        ),
    )


def paper_results() -> dict[str, dict[str, dict[str, Any]]]:
    """task -> metric -> {"unit", algorithm: value or None} of the paper."""
    text = resources.files("olympics_opt").joinpath("paper_results.csv").read_text()
    table: dict[str, dict[str, dict[str, Any]]] = {}
    for row in csv.DictReader(text.splitlines()):
        values: dict[str, Any] = {a: float(row[a]) if row[a] else None for a in PAPER_COLUMNS}
        table.setdefault(row["task"], {})[row["metric"]] = {"unit": row["unit"], **values}
    return table


def results_page(results: Sequence[Mapping[str, Any]], measured: Measured | None = None) -> str:
    """``results/README.md``: one table a task, ours first, the paper's beneath; then what ``bench``
    ``measured``."""
    lines = [
        "# Results",
        "",
        "Written by `olympics-opt leaderboard` from the JSON files in this folder; do not edit.",
        "Mean [95 % interval] over the trials of one policy. The paper is SMPLOlympics "
        "(arXiv 2407.00187), 1000 trials each.",
        "",
    ]
    if not results:
        lines += ["No results yet.", ""]
    paper = paper_results()
    for task in dict.fromkeys(r["task"] for r in results):
        rows = [r for r in results if r["task"] == task]
        metrics = list(dict.fromkeys(m for r in rows for m in r["metrics"]))
        head = ["algorithm", "strength", "engine", "trials", *metrics, "commit", "file"]
        table = [
            [
                r["algo"],
                r["strength"],
                r["engine"],
                str(r["trials"]),
                *(_ours(r["metrics"].get(m)) for m in metrics),
                str(r["commit"])[:9],
                f"[{r['file']}]({r['file']})",
            ]
            for r in rows
        ]
        table += [
            [f"{a}, paper", "paper", "Isaac Gym", "1000", *cells, "", ""]
            for a, cells in _paper_rows(paper.get(task, {}), metrics)
        ]
        lines += [f"## {task}", "", *_markdown(head, table), ""]
    for title, text, head, table in sections(measured) if measured else ():
        lines += [f"## {title}", "", text, "", *_markdown(head, table), ""]
    return "\n".join(lines)


def summary_table(results: Sequence[Mapping[str, Any]]) -> str:
    """The short table of the front page: the metrics that the paper has, one row a result."""
    paper = paper_results()
    rows = []
    for r in results:
        known = paper.get(r["task"], {})
        ours = [m for m in r["metrics"] if m in known] or list(r["metrics"])[:2]
        beside = PAPER_METHOD.get(r["algo"], "PPO")
        rows.append(
            [
                r["task"],
                r["algo"],
                r["strength"],
                r["engine"],
                str(r["trials"]),
                "; ".join(f"{m} {_ours(r['metrics'][m])}" for m in ours),
                "; ".join(
                    f"{m} {_value(known[m][beside], known[m]['unit'])}" for m in ours if m in known
                )
                + (f" ({beside})" if known and beside != "PPO" else ""),
            ]
        )
    head = [
        "task",
        "algorithm",
        "strength",
        "engine",
        "trials",
        "result",
        "paper (PPO, or as said)",
    ]
    return "\n".join(_markdown(head, rows)) if rows else "No results yet."


def update_section(text: str, table: str, where: str) -> str:
    """``text`` with the part between the two result marks replaced by ``table``.

    Raises ValueError naming ``where`` when the marks are missing or out of order.
    """
    start, end = text.find(BEGIN), text.find(END)
    if start < 0 or end < start:
        raise ValueError(f"{where} lacks the marks {BEGIN} and {END} around its table of results")
    return f"{text[: start + len(BEGIN)]}\n{table}\n{text[end:]}"


def rebuild(results: str | Path = "results", readme: str | Path | None = "README.md") -> list[Path]:
    """Writes ``README.md`` of the results folder and the section of the front page.

    Returns the files written. Raises ValueError for a broken result or a front page without marks.
    """
    found, measured = read_results(results), read_measured(results)
    front = Path(readme) if readme is not None else None
    updated = None
    if front is not None and front.is_file():
        updated = update_section(front.read_text(), summary_table(found), str(front))
    written = [atomic.write_text(Path(results) / "README.md", results_page(found, measured))]
    if front is not None and updated is not None:
        written.append(atomic.write_text(front, updated))
    return written


def _paper_rows(known: Mapping[str, Mapping[str, Any]], metrics: Sequence[str]):
    for algo in PAPER_COLUMNS:
        values = [known.get(m, {}).get(algo) for m in metrics]
        if any(v is not None for v in values):
            yield (
                algo,
                [_value(v, known.get(m, {}).get("unit", "")) for m, v in zip(metrics, values)],
            )


def _value(value: float | None, unit: str) -> str:
    if value is None:
        return "–"
    return f"{100 * value:.4g} %" if unit == "fraction" else f"{value:.4g} {unit}"


def _ours(metric: Mapping[str, Any] | None) -> str:
    if not metric or metric.get("mean") is None:
        return "–"
    scale, unit = (100, "%") if metric["unit"] == "fraction" else (1, metric["unit"])
    low, high = metric["ci95"] if metric.get("ci95") else (None, None)
    text = f"{scale * metric['mean']:.4g}"
    if low is not None and high is not None:
        text += f" [{scale * low:.4g}, {scale * high:.4g}]"
    return f"{text} {unit}".strip()


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(c.replace("|", "\\|") for c in cells) + " |"

    return [line(head), "|" + "---|" * len(head), *(line(r) for r in rows)]
