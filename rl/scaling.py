"""Training speed against the number of processes: ``python -m rl.scaling TASK --gpus 1 2 4``.

For each number a whole training is started through torchrun, as a user starts one. Its speed is
read from its progress.csv: samples of all processes over rank 0's clock, after the warm-up. Each
process has as many worlds as the only one of the first row (weak scaling).
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from rl import provenance
from rl.config import DEFAULT_WORLDS, parse_args
from rl.runlog import Row, read_progress
from warmstart.atomic import prepare, write_json

SKIPPED = 4
"""First iterations that never count: they compile, allocate, capture and reach a usual mix."""
FEWEST = 3
"""Iterations that a figure needs."""


@dataclass(frozen=True)
class ScalingConfig:
    """Measure how training speed grows with processes, one for each GPU. Options of ``train`` come
    after ``--``."""

    task: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="TASK")]]
    """Sport, or ``tracking``."""
    gpus: tuple[int, ...] = (1, 2, 4)
    """Numbers of processes, each with a GPU of its own; on a machine without any they share its
    processor."""
    worlds: int | None = None
    """Worlds per process; None for the engine's usual number."""
    seconds: float = 30.0
    """Time of measurement for each number."""
    warm_up: float = 15.0
    """Seconds of training before it."""
    engine: Literal["mujoco", "warp", "drake"] = "warp"
    """Physics engine."""
    out: Path = Path("results/scaling.json")
    """JSON file for the figures."""
    runs: Path | None = None
    """Keep the runs in this folder."""

    @property
    def num_worlds(self) -> int:
        """Worlds per process."""
        return self.worlds or DEFAULT_WORLDS[self.engine]


@dataclass(frozen=True)
class Point:
    """Speed with one number of processes."""

    processes: int
    worlds: int
    """Per process."""
    samples_per_s: float
    """Of all processes."""
    ratio: float | None
    """To one process; None where that was not measured."""
    efficiency: float | None
    """Ratio over processes."""
    rollout_s: float
    """Median, rank 0's."""
    update_s: float
    """Median, rank 0's; with the messages between the ranks."""
    iterations: int
    """That the figure is of."""
    seconds: float
    """That it was measured over."""


def speed(rows: Sequence[Row], warm_up: float) -> dict[str, Any]:
    """Samples per second after the warm-up (s), and medians of an iteration's parts.

    Raises ValueError where too few iterations are left.
    """

    def at(row: Row, name: str) -> float:
        return float(row[name] or 0.0)

    late = [r for r in rows[SKIPPED:] if 60.0 * at(r, "minutes") >= warm_up]
    if len(late) <= FEWEST:
        raise ValueError(
            f"{max(0, len(late) - 1)} iterations after the warm-up are too few for a figure: give "
            "more --seconds, or fewer --worlds"
        )
    first, last, counted = late[0], late[-1], late[1:]
    seconds = 60.0 * (at(last, "minutes") - at(first, "minutes"))
    return {
        "samples_per_s": (at(last, "samples") - at(first, "samples")) / seconds,
        "rollout_s": statistics.median(at(r, "rollout_s") for r in counted),
        "update_s": statistics.median(at(r, "update_s") for r in counted),
        "iterations": len(counted),
        "seconds": seconds,
    }


def command(config: ScalingConfig, processes: int, run: Path, more: Sequence[str]) -> list[str]:
    """The training of one row."""
    minutes = (config.warm_up + config.seconds) / 60.0
    launch = ["-m", "torch.distributed.run", "--standalone", "--local-addr", "127.0.0.1"]
    launch += ["--nproc-per-node", str(processes)]
    return [
        *(sys.executable, *launch, "-m", "rl.train", config.task, "--out", str(run)),
        *("--engine", config.engine, "--worlds", str(config.num_worlds)),
        *("--minutes", f"{minutes:.4f}"),
        *("--checkpoint-minutes", "1e9", "--quiet", *more),
    ]


def measure(config: ScalingConfig, more: Sequence[str] = ()) -> list[Point]:
    """Trains with each number of processes and writes the JSON file after each.

    ``more``: further options of ``train``. Raises ValueError for numbers that cannot be, or a
    training that ends too early, RuntimeError for one that fails.
    """
    if not config.gpus or min(config.gpus) < 1 or config.seconds <= 0.0:
        raise ValueError("give numbers of processes of at least 1, and seconds above 0")
    words = command(config, 1, config.out, more)
    asked = parse_args(words[words.index("rl.train") + 1 :])  # mistakes, before anything starts
    gpus = torch.cuda.device_count()
    if asked.device != "cpu" and 0 < gpus < max(config.gpus):
        raise ValueError(f"this machine has {gpus} GPUs: --gpus {max(config.gpus)} is too many")
    prepare(config.out)
    root = str(Path(__file__).resolve().parents[1])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    env["OLYMPICS_OPT_COMMIT"] = provenance.commit()
    points: list[Point] = []
    with tempfile.TemporaryDirectory() as temporary:
        for processes in sorted(set(config.gpus)):
            run = (config.runs or Path(temporary)) / f"{config.task}_{processes}"
            args = command(config, processes, run, more)
            done = subprocess.run(args, env=env, stderr=subprocess.PIPE, text=True)
            if done.returncode != 0:
                lines = [s for s in done.stderr.splitlines() if s.startswith("error: ")]
                tail = lines[0] if lines else done.stderr[-2000:]
                raise RuntimeError(f"training with {processes} processes failed: {tail}")
            found = speed(read_progress(run), config.warm_up)
            alone = next((p.samples_per_s for p in points if p.processes == 1), None)
            if processes == 1:
                alone = found["samples_per_s"]
            ratio = found["samples_per_s"] / alone if alone else None
            efficiency = ratio / processes if ratio else None
            point = Point(processes, config.num_worlds, ratio=ratio, efficiency=efficiency, **found)
            points.append(point)
            write_points(config, more, points)
            print(_line(point), flush=True)
    return points


def write_points(config: ScalingConfig, more: Sequence[str], points: Sequence[Point]) -> None:
    """The JSON file of what was measured, with where and of which commit."""
    data = {
        "task": config.task,
        "engine": config.engine,
        "options": list(more),
        "warm_up_s": config.warm_up,
        "rows": [asdict(p) for p in points],
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
    }
    write_json(config.out, data)


def _line(p: Point) -> str:
    of_one = "" if p.ratio is None else f", {p.ratio:.2f} times one ({p.efficiency:.0%} each)"
    return (
        f"{p.processes} processes: {p.samples_per_s:,.0f} samples/s{of_one}; rollout "
        f"{p.rollout_s:.3f} s, update {p.update_s:.3f} s"
    )


def main(args: Sequence[str] | None = None) -> int:
    """The command line: 0, or 2 with a sentence for what could not be measured."""
    own = list(sys.argv[1:] if args is None else args)
    more: list[str] = []
    if "--" in own:
        cut = own.index("--")
        own, more = own[:cut], own[cut + 1 :]
    try:
        measure(tyro.cli(ScalingConfig, args=own, prog="python -m rl.scaling"), more)
    except (ValueError, RuntimeError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
