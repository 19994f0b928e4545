"""``olympics-opt match``: one policy against another, or a round robin of several."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from olympics_opt.progress import progress

if TYPE_CHECKING:
    from olympics_opt.cli import Match
    from rl.match import Setting

DRAWN = 20
"""Games from which the best and the median are drawn."""


def run_match(config: Match) -> int:
    """The command. Raises ValueError for policies or a task that cannot be used."""
    from olympics_opt.cli import chosen_options
    from olympics_opt.play import check_pictures
    from rl.match import Setting, play_ladder, play_match, task_of
    from warmstart.atomic import prepare, write_json

    names = config.policies
    if len(names) < 2 or (len(names) > 2 and not config.ladder):
        raise ValueError("give two policies, or --ladder and two or more")
    task = task_of(names, config.sport)
    setting = Setting(
        task=task,
        trials=config.trials,
        engine=config.engine,
        seed=config.seed,
        worlds=config.worlds,
        strength=config.strength,
        limits=config.limits,
        options=chosen_options(config, "task"),
    )
    out = prepare(config.out) if config.out is not None else None
    check_pictures(config.video, config.sheet)
    if config.ladder and (config.video is not None or config.sheet is not None):
        raise ValueError("a ladder is not drawn: leave --sheet and --video out")
    with progress(f"{task}, {config.engine}") as bar:

        def show(done: float, total: int) -> None:
            bar.show(f"{int(done)} of {total} games", done, total)

        if config.ladder:
            result = play_ladder(names, setting, progress=show)
        else:
            result = play_match(names[0], names[1], setting, progress=show)
        bar.finish("played")
    if config.ladder:
        print_ladder(result)
    else:
        print_match(result)
    if out is not None:
        print(f"wrote {write_json(out, result)}")
    if config.sheet is not None or config.video is not None:
        _draw(config, setting)
    return 0


def find_task(args: Sequence[str]) -> str | None:
    """The task whose options a command line may set: the one it names, else, where it has such
    options, that of the first policy with a card.

    Raises ValueError where it has options and nothing says of what, PolicyError for a policy that
    cannot be read.
    """
    from olympics_opt.cli import Match, words_and_values

    policies, values = words_and_values(Match, args)
    named = values.get("task", "")
    if named or not any(word.startswith("--task.") for word in args):
        return named or None
    from rl.match import task_of

    return task_of(policies, "")


def _draw(config: Match, setting: Setting) -> None:
    """The sheet and the video, of games with the first policy on side 0."""
    from olympics_opt.render import render_sheet, render_video
    from rl import provenance
    from rl.evaluate import evaluate
    from rl.match import Pair
    from rl.policy import load_policy

    first, second = (load_policy(name, setting.task) for name in config.policies)
    played = evaluate(
        Pair(first, second),
        setting.task,
        engine=setting.engine,
        trials=min(DRAWN, setting.trials),
        seed=setting.seed,
        num_worlds=setting.worlds,
        strength=setting.strength,
        limits=setting.limits,
        options=setting.options,
        record=1,
    )
    if config.sheet is not None:
        episodes: dict[str, Any] = {"best": played.best, "median": played.median}
        print(f"wrote {render_sheet(episodes, config.sheet, commit=provenance.commit())}")
    if config.video is not None:
        best: Any = played.best
        path = render_video(best, config.video, renderer=config.renderer, progress=True)
        print(f"wrote {path}")


def print_match(result: dict[str, Any]) -> None:
    """Outcome, Elo difference, and both policies' metrics side by side."""
    from rich.console import Console
    from rich.table import Table

    own, other = result["metrics"], result["opponent_metrics"]
    table = Table(box=None)
    for heading in ("metric", result["policy"], result["opponent"]["policy"], "unit"):
        left = heading in ("metric", "unit")
        table.add_column(heading, justify="left" if left else "right", overflow="fold")
    for name, metric in own.items():
        told = _told(other[name]) if name in other else ""
        table.add_row(name, _told(metric), told, metric["unit"])
    console = Console()
    console.print(_title(result), style="italic", soft_wrap=True, highlight=False)
    console.print(table)
    if result["unrated"]:
        console.print(f"[red]the engine diverged in {result['unrated']} games[/red]")


def print_ladder(result: dict[str, Any]) -> None:
    """One row a policy, the strongest first."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None)
    for heading in ("policy", "Elo", "score", "wins", "draws", "losses"):
        table.add_column(heading, justify="left" if heading == "policy" else "right")
    for row in result["players"]:
        counts = (str(row[name]) for name in ("wins", "draws", "losses"))
        table.add_row(row["policy"], _told(row["elo"], "{:.0f}"), f"{row['score']:.2f}", *counts)
    console = Console()
    console.print(_title(result), style="italic", soft_wrap=True, highlight=False)
    console.print(table)


def _title(result: dict[str, Any]) -> str:
    games = "games a pair" if result["kind"] == "ladder" else "games"
    return (
        f"{result['task']}, strength {result['strength']}, {result['engine']}, "
        f"{result['trials']} {games}, seed {result['seed']}"
    )


def _told(metric: dict[str, Any], form: str = "{:.3g}") -> str:
    """Mean and interval; what is not finite as infinite, what is unknown as a dash."""
    if metric["mean"] is None:
        return "-"
    mean = form.format(metric["mean"])
    if metric["ci95"] is None:
        return mean
    low, high = (form.format(x) for x in metric["ci95"])
    return f"{mean} [{low}, {high}]"
