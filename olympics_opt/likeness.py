"""``olympics-opt likeness``: how human motions look, as a table, JSON and a chart."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from olympics_opt.progress import progress

if TYPE_CHECKING:
    from olympics_opt.cli import Likeness
    from rl.likeness_reference import Reference

COLUMNS = (
    ("jerk", "jerk ln", 1.0),
    ("skating", "slides m/s", 1.0),
    ("penetration", "sinks cm", 100.0),
    ("torque", "torque", 1.0),
    ("torque_rate", "its rate", 1.0),
    ("power", "power", 1.0),
    ("frechet", "Frechet", 1.0),
    ("classifier", "told %", 100.0),
)
"""Figure, heading of its column, factor. Torque, its rate and power in a person's limits."""
SHIPPED = "reference"
"""Word for the shipped reference, where a library of clips may be given."""


def run_likeness(config: Likeness) -> int:
    """The command. Raises ValueError for a source, a task or clips that cannot be used."""
    from warmstart.atomic import prepare, write_json

    if config.trials < 1:
        raise ValueError(f"trials must be at least 1, not {config.trials}")
    if config.chart is not None and config.chart.suffix.lower() not in (".png", ".svg"):
        raise ValueError(f"{config.chart} must end in .png or .svg")
    sources = _sources(config)
    one_file = config.out is not None and config.out.suffix == ".json"
    if one_file and len(sources) > 1:
        raise ValueError(
            f"there are {len(sources)} panels: give a folder with --out, not {config.out}"
        )
    reference = load_reference(config.clips)
    targets: list[Path] = []
    for label, _, _ in sources if config.out is not None else ():
        assert config.out is not None
        file = config.out if one_file else config.out / f"likeness_{label}.json"
        targets.append(prepare(file))
    if config.chart is not None:
        prepare(config.chart)
    panels: dict[str, dict[str, Any]] = {}
    for i, (label, source, task) in enumerate(sources):
        panels[label] = _measure(config, label, source, task, reference)
        if targets:
            write_json(targets[i], panels[label])
    print_table(panels)
    if config.chart is not None:
        chart(panels, config.chart)
    for path in [*targets, *([config.chart] if config.chart is not None else [])]:
        print(f"wrote {path}")
    return 0


def load_reference(clips: Sequence[Path]) -> Reference:
    """The held-out clips of a library or of clip files; the shipped reference without any."""
    from rl.likeness_reference import Reference, reference_of_library
    from warmstart.library import load_library

    if not clips or [str(c) for c in clips] == [SHIPPED]:
        return Reference.load()
    return reference_of_library(load_library(clips))


def _sources(config: Likeness) -> list[tuple[str, str, str]]:
    """(label, source, task) of each panel; the task is empty for a file of motions."""
    from rl.pretrained import available
    from sports.registry import get_task, task_names

    for task in config.task:
        get_task(task)
    found: list[tuple[str, str, str]] = []
    for source in config.motions or ("pretrained",):
        word, _, kind = source.partition(":")
        if word == "pretrained":
            shipped = [
                (
                    f"{p['task']}_{p['name']}_{p['strength']}",
                    f"pretrained:{p['name']}-{p['strength']}",
                    p["task"],
                )
                for p in available()
                if p["task"] in (config.task or task_names())  # the tracker plays no sport
                and kind in ("", p["name"], f"{p['name']}-{p['strength']}")
            ]
            if not shipped:
                raise ValueError(f"no policy '{source}' is shipped for {', '.join(config.task)}")
            found += shipped
        elif source in ("zero", "random"):
            if not config.task:
                raise ValueError(f"'{source}' plays any task: say which with --task")
            found += [(f"{task}_{source}", source, task) for task in config.task]
        elif _holds_motions(Path(source)):
            found.append((Path(source).stem, source, ""))
        else:
            found.append((Path(source).stem, source, _task_of(source, config.task)))
    labels = [label for label, _, _ in found]
    again = {label for label in labels if labels.count(label) > 1}
    return [
        (f"{label}_{i}" if label in again else label, source, task)
        for i, (label, source, task) in enumerate(found)
    ]


def _holds_motions(path: Path) -> bool:
    """Whether a file or folder holds motions; else it is a policy's."""
    if path.is_file():
        return path.suffix == ".npz"
    return path.is_dir() and not (path / "config.json").exists() and any(path.rglob("*.npz"))


def _task_of(source: str, tasks: Sequence[str]) -> str:
    """The one task asked for, else that of the policy's card. Raises ValueError for neither."""
    import json

    if len(tasks) > 1:
        raise ValueError(f"the policy '{source}' is of one task: give one with --task")
    if tasks:
        return tasks[0]
    path = Path(source)
    card = path / "config.json" if path.is_dir() else path.with_suffix(".json")
    try:
        said = json.loads(card.read_text(encoding="utf-8"))
        return str((said["config"] if path.is_dir() else said)["task"])
    except (OSError, ValueError, KeyError, TypeError):
        raise ValueError(
            f"'{source}' is no policy, run or file of motions that says its task: give a "
            "run's folder, a .safetensors file, recordings or clips (.npz), or --task"
        ) from None


def _measure(
    config: Likeness, label: str, source: str, task: str, reference: Reference
) -> dict[str, Any]:
    from rl.likeness import likeness_of_policy, panel
    from rl.likeness_motion import read_motions

    if not task:
        motions = read_motions(source)
        return panel(motions, reference, facts={"source": Path(source).name})
    with progress(f"playing {label}") as bar:
        out = likeness_of_policy(
            source,
            task,
            reference,
            trials=config.trials,
            seed=config.seed,
            engine=config.engine,
            strength=config.strength,
            limits=config.limits,
            progress=lambda done, total: bar.show(f"{int(done)} of {total} trials", done, total),
        )
        bar.finish(f"{config.trials} trials, {out['seconds']:.0f} s of motion")
    return out


def print_table(panels: dict[str, dict[str, Any]]) -> None:
    """One row for people and one for each panel; what no person's motion shows is red and has a
    star."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, padding=(0, 0, 0, 1))
    table.add_column("motion", no_wrap=True)
    table.add_column("score", no_wrap=True)
    for _, heading, _ in COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("human", justify="right", no_wrap=True)
    bands: list[tuple[str, ...]] = []
    for label, panel in panels.items():
        rows = panel["likeness"]
        band = tuple(_most(rows[name], factor) for name, _, factor in COLUMNS)
        if not bands or band != bands[-1]:
            bands.append(band)
            table.add_row("[dim]people, at most", "", *(f"[dim]{b}" for b in band), "")
        cells = [_cell(rows[name], factor) for name, _, factor in COLUMNS]
        like = panel["human_like"]
        table.add_row(label, _score(panel), *cells, f"{like['within']} of {like['of']}")
    console = Console()
    console.width = max(console.width, 130)
    console.print(table)


def _most(row: dict[str, Any], factor: float) -> str:
    high = row["human"]["high"]
    return "-" if high is None else f"{factor * high:.3g}"


def _cell(row: dict[str, Any], factor: float) -> str:
    if row["mean"] is None:
        return "-"
    text = f"{factor * row['mean']:.3g}"
    return f"[red]{text}*[/red]" if row["within"] is False else f"{text} "


def _score(panel: dict[str, Any]) -> str:
    main = panel.get("main")
    if main is None or main["mean"] is None:
        return ""
    share = main["unit"] == "fraction"
    value = f"{100.0 * main['mean']:.0f} %" if share else f"{main['mean']:.3g} {main['unit']}"
    return f"{main['metric']} {value}"


def chart(panels: dict[str, dict[str, Any]], path: Path) -> Path:
    """Draws each figure of each panel beside the range of people."""
    from matplotlib.figure import Figure

    labels = list(panels)
    figure = Figure(figsize=(13.0, 1.6 + 0.56 * len(labels)), layout="constrained")
    axes = figure.subplots(2, 4, sharey=True)
    places = range(len(labels))
    for axis, (name, _, factor) in zip(axes.flat, COLUMNS):
        rows = [panels[label]["likeness"][name] for label in labels]
        highs = [row["human"]["high"] for row in rows if row["human"]["high"] is not None]
        lows = [row["human"]["low"] or 0.0 for row in rows]
        if highs:
            axis.axvspan(factor * min(lows), factor * min(highs), color="#8fbf8f", alpha=0.4, lw=0)
        for y, row in zip(places, rows):
            if row["mean"] is None:
                continue
            colour = "#b03030" if row["within"] is False else "#206020"
            low, high = row["ci95"] or (row["mean"], row["mean"])
            axis.plot([factor * low, factor * high], [y, y], color=colour, lw=1.5)
            axis.plot([factor * row["mean"]], [y], "o", color=colour, ms=5)
        values = [factor * row["mean"] for row in rows if row["mean"]]
        if values and highs and max(values) > 8.0 * factor * min(highs):
            axis.set_xscale("symlog", linthresh=factor * min(highs))
        axis.set_title(_TITLES[name], fontsize=9)
        axis.grid(axis="x", alpha=0.3)
        axis.tick_params(labelsize=8)
    axes[0, 0].set_yticks(list(places), labels)
    axes[0, 0].invert_yaxis()
    figure.suptitle("Green: people whom no training saw; limits of strength for effort", fontsize=9)
    figure.savefig(path, dpi=110)
    return path


_TITLES = {
    "jerk": "log dimensionless jerk",
    "skating": "sliding feet (m/s)",
    "penetration": "below the ground (cm)",
    "torque": "torque (human limits)",
    "torque_rate": "torque rate (human limits)",
    "power": "power (human limits)",
    "frechet": "Frechet distance of windows",
    "classifier": "told from people (%)",
}
