"""What one does with a policy: ``train``, ``export``, ``evaluate`` and ``render`` it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from olympics_opt.progress import progress
from warmstart import atomic

if TYPE_CHECKING:
    from torch import Tensor

    from olympics_opt.cli import Evaluate, Export, Render, Verify
    from rl.evaluate import EvaluationResult
    from rl.likeness_reference import Reference
    from rl.policy import Policy

SHOWN = 8
"""Worlds whose first episodes are looked at for likeness."""


def athlete(
    policy: str, task: str, strength: str | None = None, limits: str | None = None
) -> tuple[str, str]:
    """Strength and limits with which a policy is played: as asked, else as it was trained.

    Raises PolicyError for a policy that cannot be used with the task.
    """
    from rl.policy import as_trained, load_policy
    from sports.registry import get_task

    get_task(task)
    return as_trained(load_policy(policy, task), task, strength, limits)[:2]


def asked(config: Evaluate | Render | Verify) -> dict[str, Any]:
    """What a command line says about its trials, as arguments of ``play`` and ``verify``.

    Raises ValueError for an unknown task and PolicyError for a policy that cannot be used with
    it, before anything is played or written.
    """
    from olympics_opt.cli import chosen_options

    athlete(config.policy, config.name)
    return {
        "task": config.name,
        "policy": config.policy,
        "trials": config.trials,
        "seed": config.seed,
        "strength": config.strength,
        "limits": config.limits,
        "options": chosen_options(config, "task"),
        "processes": config.processes,
    }


def training_step(policy: str, task: str) -> str:
    """A sentence where a policy was trained at another time step than it is played at, else "".

    Every trial is played at the task's own step, whatever the policy's card says: results must be
    comparable. Raises PolicyError like ``athlete``.
    """
    from olympics_opt.report.sections import step_text
    from rl.policy import load_policy
    from sports.env import make_scene

    trained = load_policy(policy, task).metadata.get("config")
    trained = trained if isinstance(trained, dict) else {}
    divisor = trained.get("timestep_divisor", 1)
    if not isinstance(divisor, int) or divisor <= 1:
        return ""
    own, finer = make_scene(task), make_scene(task, timestep_divisor=divisor)
    usual = step_text(own.timestep, own.substeps)
    some = f" (some of its worlds at {usual})" if trained.get("vary") else ""
    return (
        f"the policy was trained at {step_text(finer.timestep, finer.substeps)}{some}; it is "
        f"played at the task's own step, {usual}, like every policy"
    )


def play(
    task: str,
    policy: str,
    *,
    engine: str = "mujoco",
    trials: int,
    seed: int = 0,
    worlds: int | None = None,
    strength: str | None = None,
    limits: str | None = None,
    options: dict[str, Any] | None = None,
    timestep_divisor: int = 1,
    processes: int = 1,
    record: bool = False,
    record_worlds: tuple[int, ...] = (),
    label: str = "",
    physics_options: dict[str, Any] | None = None,
    parts: Path | None = None,
) -> EvaluationResult:
    """``rl.evaluate.evaluate`` with a line of progress; its errors and its result.

    ``processes`` is for Drake, which steps its worlds one after another; ``parts`` too.
    """
    from rl.evaluate import evaluate
    from sports.registry import get_task

    with progress(f"playing {task}, {label or engine}") as bar:
        played = evaluate(
            policy,
            task,
            engine=engine,
            trials=trials,
            seed=seed,
            num_worlds=worlds,
            strength=strength,
            limits=limits,
            options=options,
            timestep_divisor=timestep_divisor,
            physics_options=physics_options,
            record=int(record),
            record_worlds=record_worlds,
            processes=processes,
            progress=lambda done, total: bar.show(f"{int(done)} of {total} trials", done, total),
            parts=parts,
        )
        metrics = played.result["metrics"]
        name = "success" if "success" in metrics else get_task(task).main_metric
        mean, share = metrics[name]["mean"], metrics[name]["unit"] == "fraction"
        text = "-" if mean is None else f"{mean:.0%}" if share else f"{mean:.3g}"
        bar.finish(f"{trials} trials, {name} {text}")
    return played


def run_evaluate(config: Evaluate) -> int:
    """The command: prints the metrics and writes the result schema."""
    from rl.kept_shares import forget
    from rl.worlds import engine_options, mistakes

    trials = asked(config)
    for mistake in mistakes(config):
        raise ValueError(mistake)
    if config.trials >= 1:  # else the evaluation says what is wrong
        atomic.prepare(config.out)
    reference = None
    if config.likeness is not None:
        from olympics_opt.likeness import load_reference

        reference = load_reference([config.likeness])
    worlds = tuple(range(SHOWN)) if reference is not None else ()
    parts = config.out.with_name(f"{config.out.name}.parts")
    played = play(
        **trials,
        engine=config.engine,
        worlds=config.worlds,
        record_worlds=worlds,
        timestep_divisor=config.timestep_divisor,
        physics_options=engine_options(config, config.seed),
        parts=parts,
    )
    print_metrics(played.result)
    print_training_step(config)
    if reference is not None:
        _add_likeness(config, played, reference)
    print(f"wrote {atomic.write_json(config.out, played.result)}")
    forget(parts)
    return 0


def _add_likeness(config: Evaluate, played: EvaluationResult, reference: Reference) -> None:
    """Prints the panel of human-likeness and puts it into the result."""
    from olympics_opt.likeness import print_table
    from rl.likeness import likeness_of_episodes
    from rl.policy import load_policy

    card = load_policy(config.policy, config.name).metadata
    panel = likeness_of_episodes(played.result, played.recordings, card, reference)
    print_table({f"{config.name} {played.result['algo']}": panel})
    kept = ("motions", "seconds", "windows", "reference", "human_like", "likeness")
    played.result["likeness"] = {name: panel[name] for name in kept}


def print_training_step(config: Evaluate | Render | Verify) -> None:
    """Says on the terminal where a policy is played at another step than it was trained at."""
    if note := training_step(config.policy, config.name):
        print(f"note: {note}", flush=True)


def print_metrics(result: dict[str, Any]) -> None:
    """The metrics of a result as a table on the terminal."""
    from rich.console import Console
    from rich.table import Table

    from olympics_opt.report.page import number
    from olympics_opt.report.sections import step_text

    title = (
        f"{result['task']}, {result['algo']}, strength {result['strength']}, "
        f"{result['engine']} at {step_text(result['timestep'], result['substeps'])}, "
        f"{result['trials']} trials, seed {result['seed']}"
    )
    table = Table(box=None)
    for name in ("metric", "mean", "95 % interval", "n", "unit"):
        table.add_column(name, justify="left" if name in ("metric", "unit") else "right")
    for name, m in result["metrics"].items():
        low, high = m["ci95"] or (None, None)
        table.add_row(
            name, number(m["mean"]), f"[{number(low)}, {number(high)}]", str(m["n"]), m["unit"]
        )
    console = Console()
    console.print(title, style="italic", soft_wrap=True, highlight=False)
    console.print(table)
    for name in ("nan_worlds", "overflow"):
        if result[name]:
            console.print(f"[red]{name}: {result[name]} worlds[/red]")


def check_pictures(video: Path | None, sheet: Path | None) -> None:
    """Raises ValueError for a file to draw whose name does not end as its kind must."""
    for path, suffixes in ((video, (".mp4",)), (sheet, (".png", ".jpg", ".webp"))):
        if path is not None and path.suffix.lower() not in suffixes:
            raise ValueError(f"{path} must end in {' or '.join(suffixes)}")


def run_render(config: Render) -> int:
    """The command. Raises ValueError without anything to write, RuntimeError without GL."""
    from olympics_opt.render import render_sheet, render_video
    from rl import provenance

    if config.all:
        return _render_all(config)
    if not config.name or not config.policy:
        raise ValueError("give a task and --policy, or --all --out sheet.png for every task")
    if config.out is None and config.sheet is None:
        raise ValueError("give --out FILE.mp4 for a video, --sheet FILE.png for a sheet, or both")
    check_pictures(config.out, config.sheet)
    played = play(**asked(config), engine=config.engine, record=True)
    print_training_step(config)
    written: list[Path] = []
    if config.sheet is not None:
        episodes: dict[str, Any] = {"best": played.best, "median": played.median}
        written.append(render_sheet(episodes, config.sheet, commit=provenance.commit()))
    if config.out is not None:
        best: Any = played.best
        written.append(render_video(best, config.out, renderer=config.renderer, progress=True))
    for path in written:
        print(f"wrote {path}")
    return 0


def _render_all(config: Render) -> int:
    """``render --all``. Raises ValueError for what does not go with it."""
    from olympics_opt.gallery import render_all

    if config.name or config.policy or config.sheet is not None:
        raise ValueError("--all draws every task: give no task, no --policy and no --sheet")
    if config.out is None:
        raise ValueError("give --all a picture to write: --out sheet.png")
    check_pictures(None, config.out)
    print(f"wrote {render_all(config.out, config.seed)}")
    return 0


def run_train(args: list[str]) -> int:
    """The command: ``rl.train`` under this program's name. Asked to stop, it saves and is done."""
    from rl.train import parse_args, train

    summary = train(parse_args(args, prog="olympics-opt train"))
    if summary.rank == 0:
        print(summary.sentence())
    return 0


def run_export(config: Export) -> int:
    """The command. Raises ValueError for a run or a result that cannot be used, OSError where the
    file cannot be written."""
    from rl.averaging import mean_policy
    from rl.policy import export_policy, read_policy

    runs = (config.run, *config.mean)
    for run in runs:
        if not Path(str(run).partition("@")[0]).exists():
            raise ValueError(
                f"there is no run '{run}': give the folder that `train` wrote, or a policy file"
            )
    if config.shares and not config.mean:
        raise ValueError("--shares are those of a mean: give the other policies with --mean")
    if config.out.suffix != ".safetensors":
        raise ValueError(f"{config.out} must end in .safetensors")
    metrics, of = None, ""
    if config.result is not None:
        metrics, of = _measured(config.result)
    atomic.prepare(config.out)
    path = export_policy(
        mean_policy([read_policy(run, "") for run in runs], config.shares or None)
        if config.mean
        else config.run,
        config.out,
        metrics=metrics,
        metrics_of=of,
        looks=config.looks,
        critic=config.critic,
        precision=config.precision,
        observed=_observed if config.fit else None,
    )
    print(f"wrote {path} ({path.stat().st_size / 2**20:.1f} MiB) and {path.with_suffix('.json')}")
    return 0


def _observed(policy: Policy) -> Tensor:
    """What the policy meets in its own task, which takes a while."""
    from rl.calibration import observed

    print(
        f"playing {policy.metadata['task']}, to round the weights for what the policy meets there"
    )
    return observed(policy)


def _measured(path: Path) -> tuple[dict[str, Any], str]:
    """Metrics of a result file and the sha256 of its policy. Raises ValueError if it is none."""
    try:
        result = json.loads(path.read_text())
        return dict(result["metrics"]), str(result["policy_sha256"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a result of `evaluate` ({error!r})") from error
