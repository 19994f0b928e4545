"""The command ``bench``: what ``meter.py`` measures of every task on every engine, as a table and
as JSON.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from olympics_opt import meter
from olympics_opt.meter import SIGMA, Row, measure
from olympics_opt.soak import STEPS, soak_shared
from olympics_opt.speeds import overflowed, rate
from rl import provenance
from sports.registry import get_task, task_names
from warmstart.atomic import write_json

Engine = Literal["mujoco", "warp", "drake"]
WORLDS = {"mujoco": (256, 1024), "warp": (8192,), "drake": (4,)}
"""Usual numbers of worlds. 256 is what training on a CPU takes; with more the fixed cost of a step
weighs less."""
ENVIRONMENT_SHARE, TRAINING_SHARE = 0.85, 0.75
"""What the environment and training should keep of the speed of bare physics; training is
judged on a GPU only, where the learner does not share the engine's processors."""


@dataclass(frozen=True)
class BenchConfig:
    """Measure bare physics, environment and training speed of each task on each engine."""

    out: Path = Path("runs/bench.json")
    """JSON file for the figures."""
    engine: tuple[Engine, ...] = ()
    """Engines; by default mujoco, and warp where there is a GPU."""
    task: tuple[str, ...] = ()
    """Tasks; by default all."""
    worlds: tuple[int, ...] = ()
    """Numbers of worlds; by default 256 and 1024 on mujoco, 8192 on warp, 4 on drake."""
    seconds: float = 30.0
    """Time of measurement for each row; at least three turns are taken."""
    turn_steps: int = meter.STEPS
    """Control steps of a turn; fewer for tasks of which a turn takes minutes."""
    training: bool = True
    """Measure training too."""
    seed: int = 0
    """Seed of actions, starts and networks."""
    soak: bool = False
    """Instead of speed, measure endurance: random actions for many steps, and what goes wrong."""
    steps: int = STEPS
    """Control steps of an endurance run."""
    minutes: float | None = None
    """Time limit of this call for each endurance run."""
    processes: int = 1
    """Processes that share out the worlds of an endurance run, each on a GPU of its own."""
    shares: tuple[int, ...] = ()
    """Of these processes only some, numbered from 0, the others in other calls with the same
    ``keep``: where there are fewer GPUs, or less time. The last of them gives the row."""
    keep: Path | None = None
    """Folder in which endurance runs keep their worlds, so that the same command goes on."""


def bench(
    out: str | Path,
    *,
    engines: Sequence[str] = (),
    tasks: Sequence[str] = (),
    worlds: Sequence[int] = (),
    seconds: float = 30.0,
    training: bool = True,
    seed: int = 0,
    turn_steps: int = meter.STEPS,
    quiet: bool = False,
) -> dict[str, Any]:
    """Measures every task on every engine, prints a table and writes the figures as JSON.

    The file is rewritten after each row, so that a stopped run keeps what it has.

    Args:
        out: JSON file.
        engines: by default ``mujoco``, and ``warp`` where there is a GPU.
        tasks: by default all.
        worlds: by default the engine's usual numbers.
        seconds: time of measurement for each row.
        training: measure training too.
        seed: of actions, starts and networks.
        turn_steps: control steps of a turn.
        quiet: print nothing.

    Returns:
        What the file holds: commit, versions, hardware and ``rows``.

    Raises:
        ValueError: unknown task or engine, or a time or steps that are not positive.
        RuntimeError: an engine cannot run here.
    """
    from rich.console import Console
    from rich.progress import Progress

    if not seconds > 0:
        raise ValueError(f"seconds must be positive, not {seconds}")
    engines = tuple(engines) or (("mujoco", "warp") if torch.cuda.is_available() else ("mujoco",))
    tasks = tuple(tasks) or task_names()
    for name in tasks:
        get_task(name)
    console = Console(quiet=quiet)
    result: dict[str, Any] = {
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
        "system": platform.platform(),
        "seed": seed,
        "seconds": seconds,
        "sigma": SIGMA,
        "steps_per_turn": turn_steps,
        "rows": [],
    }
    rows: list[Row] = []
    what = [
        (engine, task, count)
        for engine in engines
        for task in tasks
        for count in worlds or WORLDS.get(engine, (1,))
    ]
    with Progress(console=console, transient=True, disable=quiet) as progress:
        for engine, task, count in what:
            bar = progress.add_task(f"{task} on {engine}, {count} worlds", total=1.0)

            def show(turns: int, share: float, bar: Any = bar) -> None:
                progress.update(bar, completed=min(share, 1.0))

            rows.append(
                measure(
                    task,
                    engine,
                    worlds=count,
                    seconds=seconds,
                    training=training,
                    seed=seed,
                    steps=turn_steps,
                    on_turn=show,
                )
            )
            progress.remove_task(bar)
            result["rows"] = [asdict(row) for row in rows]
            write_json(out, result)
    console.print(_table(rows))
    console.print(f"{provenance.hardware()}; commit {provenance.commit()}; written to {out}")
    return result


def soak_all(
    out: str | Path,
    *,
    engines: Sequence[str] = (),
    tasks: Sequence[str] = (),
    worlds: Sequence[int] = (),
    steps: int = STEPS,
    seed: int = 0,
    minutes: float | None = None,
    keep: Path | None = None,
    processes: int = 1,
    shares: Sequence[int] = (),
    quiet: bool = False,
) -> dict[str, Any]:
    """Plays every task for a long time under random actions and writes what happened as JSON.

    What the file holds of other tasks, engines and numbers of worlds stays: a soak of all tasks
    takes hours and may be done in several goes. One task may be, too, with ``keep``: its row says
    how many steps it has come to. Each row says at which commit and on what it was measured last.

    Arguments as of :func:`bench`; ``steps``: control steps of each world; ``minutes``: of each task
    in this call; ``keep``: folder of the worlds of tasks that are to go on; ``processes``: that
    share out the worlds, each on a GPU of its own; ``shares``: those of them that play now (there
    is no row until all have).

    Raises:
        ValueError: unknown task or engine, or counts that are not positive.
        RuntimeError: an engine cannot run here.
    """
    from rich.console import Console
    from rich.progress import Progress

    engines = tuple(engines) or ("warp" if torch.cuda.is_available() else "mujoco",)
    tasks = tuple(tasks) or task_names()
    for name in tasks:
        get_task(name)
    out, kept = Path(out), {}
    if out.exists():
        for row in json.loads(out.read_text()).get("soak", []):
            kept[row["task"], row["engine"], row["worlds"]] = row
    console, result = Console(quiet=quiet), {"soak": list(kept.values())}
    with Progress(console=console, transient=True, disable=quiet) as progress:
        for engine in engines:
            for task in tasks:
                for count in worlds or WORLDS.get(engine, (1,))[:1]:
                    bar = progress.add_task(f"{task} on {engine}, {count} worlds", total=steps)

                    def show(step: int, bar: Any = bar) -> None:
                        progress.update(bar, completed=step)

                    found = soak_shared(
                        task,
                        engine,
                        worlds=count,
                        processes=processes,
                        steps=steps,
                        seed=seed,
                        on_step=show,
                        keep=None if keep is None else keep / f"{task}_{engine}_{count}",
                        minutes=minutes,
                        shares=shares,
                    )
                    progress.remove_task(bar)
                    if found is None:
                        console.print(
                            f"{task} on {engine}: kept in {keep}; go on with other --shares, "
                            f"until all of 0 to {processes - 1} are there"
                        )
                        continue
                    row = kept[task, engine, count] = asdict(found) | {
                        "clean": found.clean,
                        "seed": seed,
                        "commit": provenance.commit(),
                        "hardware": provenance.hardware(),
                    }
                    result["soak"] = list(kept.values())
                    write_json(out, result)
                    console.print(
                        f"{task} on {engine}: {'clean' if found.clean else 'NOT CLEAN'} after "
                        f"{found.steps} of {steps} steps; "
                        f"{found.episodes} episodes, {found.nan_worlds} worlds diverged, "
                        f"{overflowed(row)} overflowed, {found.bad_observations} and "
                        f"{found.bad_rewards} numbers not finite, "
                        f"{rate(found.steps_per_second)} steps/s"
                    )
    return result


def _table(rows: Sequence[Row]) -> Any:
    from rich.table import Table

    table = Table(
        title="Per second; shares of bare physics within the same turns",
        title_justify="left",
        box=None,
    )
    heads = ("task", "engine", "worlds", "physics", "env", "share", "train", "share")
    for name in (*heads, "GiB"):
        side = "left" if name in ("task", "engine") else "right"
        table.add_column(name, justify=side, no_wrap=True)

    def share(value: float | None, wanted: float | None) -> str:
        if value is None:
            return ""
        text = f"{100 * value:.0f} %"
        color = "" if wanted is None else "green" if value >= wanted else "red"
        return f"[{color}]{text}[/]" if color else text

    for r in rows:
        wanted = TRAINING_SHARE if r.engine == "warp" else None
        memory = f"{r.host_memory_gib:.1f}"
        if r.device_memory_gib is not None:
            memory += f"+{r.device_memory_gib:.1f}"
        table.add_row(
            r.task,
            r.engine,
            str(r.worlds),
            rate(r.bare_physics),
            rate(r.environment),
            share(r.environment_share, ENVIRONMENT_SHARE),
            rate(r.training) if r.training else "-",
            share(r.training_share, wanted),
            memory,
        )
    return table


def main(args: Sequence[str] | None = None) -> int:
    """The command ``olympics-opt bench``."""
    config = tyro.cli(
        Annotated[BenchConfig, tyro.conf.arg(name="")], args=args, prog="olympics-opt bench"
    )
    if config.soak:
        soak_all(
            config.out,
            engines=config.engine,
            tasks=config.task,
            worlds=config.worlds,
            steps=config.steps,
            seed=config.seed,
            minutes=config.minutes,
            keep=config.keep,
            processes=config.processes,
            shares=config.shares,
        )
        return 0
    bench(
        config.out,
        engines=config.engine,
        tasks=config.task,
        worlds=config.worlds,
        seconds=config.seconds,
        training=config.training,
        seed=config.seed,
        turn_steps=config.turn_steps,
    )
    return 0
