"""``olympics-opt mocap track``: clips made physical, played by the simulated athlete."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from olympics_opt.progress import progress

COLUMNS = (
    ("seconds", "s", "{:.2f}", 1.0),
    ("kept", "kept", "{:.2f}", 1.0),
    ("joint_error", "err cm", "{:.1f}", 100.0),
    ("root_error", "root cm", "{:.1f}", 100.0),
    ("left_over", "unphys %", "{:.1f}", 100.0),
    ("push", "push", "{:.1f}", 1.0),
    ("saturated", "limit %", "{:.1f}", 100.0),
    ("sunk", "sunk %", "{:.1f}", 100.0),
)
"""Figure of a clip, heading of its column, form, and factor."""


@dataclass(frozen=True)
class Track:
    """Track clips in MuJoCo and write what the simulated athlete did: physical, with PD targets.

    By a search in the simulation, or with ``--tracker`` by a policy, a hundred times as fast.
    Stopped at any moment, the same command goes on with the next clip. Motions that cannot be
    followed are cut before the fall or left out; track.json says why.
    """

    clips: Positional[Annotated[Path, arg(metavar="CLIPS")]]
    """A clip (.npz), or a folder of clips as ``mocap import`` writes them."""
    out: Path
    """Folder for the tracked clips and track.json."""
    tracker: str = ""
    """A motion tracker instead of the search: a run, a policy file, or ``pretrained``."""
    strength: Literal["paper", "human"] | None = None
    """Strength of the athlete; by default paper, and with a tracker the tracker's."""
    start: float = 0.0
    """Track each clip from this second on."""
    seconds: float | None = None
    """Track at most so much of each clip (s)."""
    worlds: int = 96
    """Candidates simulated at once: more follow closer and take longer."""
    seed: int = 0
    """Seed of the candidates."""
    keep_rejected: bool = False
    """Write the motions that are not good enough too."""
    result: Path | None = None
    """JSON file for the figures."""


def run_track(config: Track) -> int:
    """The command: 0 done, 1 when some files could not be read. Raises ValueError for a source
    without clips, or a bad option."""
    from warmstart.mocap.tracked import Entry, Options, summary, track_clips

    player = _player(config)
    strength = (config.strength or "paper") if player is None else player.strength
    name = "" if player is None else str(player)
    options = Options(strength, config.start, config.seconds, config.keep_rejected, name)
    options = replace(
        options, settings=replace(options.settings, worlds=config.worlds, seed=config.seed)
    )
    done: list[Entry] = []
    with progress("clips") as bar:

        def show(entries: list[Entry]) -> None:
            done[:] = entries

        def step(file: str, now: int, total: int) -> None:
            bar.show(f"{file} ({len(done)} clips before)", now, total)

        entries = track_clips(config.clips, config.out, options, show, step, player)
        clips = sum(e.status == "clip" for e in entries)
        bar.finish(f"{clips} clips of {len(entries)} files")
    print_table(entries)
    figures = summary(entries)
    if figures["joint_error_cm"] is not None:
        print(
            f"{figures['seconds_kept']} of {figures['seconds']} s kept, joints "
            f"{figures['joint_error_cm']:.1f} cm from the recordings, "
            f"{figures['compute_seconds_per_second']:.1f} s of computing a second of motion"
        )
    print(f"wrote {sum(e.clip is not None for e in entries)} clips to {config.out}")
    if config.result is not None:
        write_result(config, options, entries, figures)
    return 1 if any(e.status == "unreadable" for e in entries) else 0


def _player(config: Track) -> Any:
    """The motion tracker that was asked for, or None. Raises ValueError for none, or another
    strength than its own."""
    if not config.tracker:
        return None
    from rl.following import Follower

    player = Follower(config.tracker)
    if config.strength not in (None, player.strength):
        raise ValueError(
            f"the tracker is of strength '{player.strength}' and cannot follow clips with an "
            f"athlete of strength '{config.strength}'"
        )
    return player


def print_table(entries: list[Any]) -> None:
    """One row a clip, and under it why one was left out."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, padding=(0, 0, 0, 1))
    table.add_column("clip", overflow="fold")
    for _, heading, _, _ in COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for entry in entries:
        if entry.measured:
            row = (form.format(f * entry.measured[key]) for key, _, form, f in COLUMNS)
            table.add_row(entry.file.removesuffix(".npz"), *row)
    Console().print(table)
    for entry in entries:
        if entry.reasons:
            words = "; ".join(entry.reasons)
            print(words if entry.status == "unreadable" else f"{entry.file}: {words}")


def write_result(config: Track, options: Any, entries: list[Any], figures: dict[str, Any]) -> None:
    """All figures with their origin, for ``results/``."""
    from rl.provenance import commit, hardware, versions
    from warmstart.atomic import write_json

    assert config.result is not None
    cut = "" if config.seconds is None else f" --seconds {config.seconds:g}"
    start = f" --start {config.start:g}" if config.start else ""
    if options.player:
        words = f"--tracker {Path(config.tracker).name}"
    else:
        words = f"--strength {options.strength} --worlds {config.worlds} --seed {config.seed}"
    value = {
        "command": f"olympics-opt mocap track {config.clips.name} {words}{start}{cut}",
        "strength": options.strength,
        "tracker": options.player or None,
        "commit": commit(),
        "versions": versions(),
        "hardware": hardware(),
        "summary": figures,
        "clips": [
            {
                "file": e.file,
                "status": e.status,
                "reasons": e.reasons,
                **{k: round(v, 4) if isinstance(v, float) else v for k, v in e.measured.items()},
                "compute_seconds": e.compute_seconds,
            }
            for e in entries
        ],
    }
    write_json(config.result, value)
    print(f"wrote {config.result}")
