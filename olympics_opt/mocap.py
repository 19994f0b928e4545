"""``olympics-opt mocap``: recordings of people made into clips of the athlete."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from olympics_opt.mocap_track import Track, run_track
from olympics_opt.progress import progress

COLUMNS = (
    ("clips", "clips", "{:d}"),
    ("rejected", "bad", "{:d}"),
    ("unreadable", "unread", "{:d}"),
    ("frames", "frames", "{:d}"),
    ("joint_error_cm", "err cm", "{:.2f}"),
    ("contact_height_cm", "sole cm", "{:.2f}"),
    ("skating_cm_s", "cm/s", "{:.1f}"),
    ("sunk_frames_percent", "sunk %", "{:.2f}"),
    ("frames_per_cpu_second", "fr/s", "{:.0f}"),
)
"""Figure of a summary, heading of its column, and form."""
SHOWN = 8
"""Files left out that are named one by one after the table."""


@dataclass(frozen=True)
class Import:
    """Make clips of recorded motions: ASF/AMC, BVH, SMPL npz (AMASS, TRAM, WHAM, GVHMR),
    DeepMimic JSON, SkillMimic npz.

    Stopped at any moment, the same command goes on where it was. Clips that are not good enough are
    left out; import.json says why.
    """

    source: Positional[Annotated[Path, arg(metavar="SOURCE")]]
    """A motion file, an archive (tar, zip), or a folder of these."""
    out: Path
    """Folder for the clips and import.json."""
    body: Literal["smpl", "smplx"] = "smpl"
    """Athlete that the clips are for."""
    source_fps: float | None = None
    """Frame rate of the recordings where a file does not say it (AMC)."""
    fps: float | None = None
    """Frame rate of the clips; by default that of each recording."""
    cutoff: float | None = None
    """Smooth with this cutoff (Hz); by default only motions from video are smoothed, at 6 Hz."""
    joint_map: tuple[Path, ...] = ()
    """Joint maps (JSON) of skeletons that are not known."""
    keep_rejected: bool = False
    """Write the clips that are not good enough too."""
    result: Path | None = None
    """JSON file for the figures of each archive."""


@dataclass(frozen=True)
class Pack:
    """Put many clips into one small file, to be carried to the machine that trains on them.

    Paths at 30 frames a second with each clip's name, archive, sport, licence and origin; an hour
    takes about 15 MB. A tenth of the clips, by their names, is held out from training.
    """

    clips: Positional[tuple[Annotated[Path, arg(metavar="CLIPS")], ...]]
    """Clips (.npz) and folders of them, as ``mocap import``, ``mocap track`` and ``solve`` write
    them."""
    out: Path
    """The library, one npz."""
    archives: tuple[str, ...] = ()
    """Keep only these archives, as for a model without non-commercial data; by default all.
    Demonstrations of ``solve`` are the archive ``demonstrations``."""
    supported: bool = False
    """Leave out clips in which the athlete hovers: more than 5 cm off the ground, and not falling,
    for more than 0.15 s. Nobody can follow them."""


def main(args: Sequence[str]) -> int:
    """``olympics-opt mocap ...``: 0 done, 1 when some files could not be read.

    When none could, ValueError is raised, which the command line ends with exit code 2.
    """
    import tyro

    words = list(args)
    if not words or words[0] in ("-h", "--help"):
        print(
            "usage: olympics-opt mocap import SOURCE --out DIR [options]\n"
            "       olympics-opt mocap track CLIPS --out DIR [options]\n"
            "       olympics-opt mocap pack CLIPS... --out FILE.npz\n\n"
            "import  makes clips of recorded motions\n"
            "track   makes clips physical: the simulated athlete plays them\n"
            "pack    puts clips into one file, for training the motion tracker\n\n"
            "olympics-opt mocap import --help lists the options of a command"
        )
        return 0 if words else 2
    if words[0] == "import":
        return run_import(tyro.cli(Import, args=words[1:], prog="olympics-opt mocap import"))
    if words[0] == "track":
        return run_track(tyro.cli(Track, args=words[1:], prog="olympics-opt mocap track"))
    if words[0] == "pack":
        return run_pack(tyro.cli(Pack, args=words[1:], prog="olympics-opt mocap pack"))
    raise ValueError(f"mocap has no command '{words[0]}'; it has: import, track, pack")


def run_pack(config: Pack) -> int:
    """The command. Raises ValueError for sources without clips, or with clips of two bodies."""
    from rl.hovering import supported
    from warmstart.atomic import prepare
    from warmstart.library import pack_files

    library = pack_files(config.clips)
    if config.archives:
        library = library.only(config.archives)
    if config.supported:
        library, hovering = supported(library)
        for name, seconds in hovering:
            print(f"left out: {name} hovers for {seconds:.2f} s")
    out = prepare(config.out)
    library.save(out)
    for archive, row in library.card()["archives"].items():
        licences = "; ".join(row["licences"])
        print(f"{archive}: {row['clips']} clips, {row['minutes']:.1f} minutes, {licences}")
    held = sum(o.held_out for o in library.origins)
    print(
        f"wrote {out}: {len(library.lengths)} clips ({held} held out), {library.minutes:.1f} "
        f"minutes, {out.stat().st_size / 1e6:.1f} MB"
    )
    return 0


def run_import(config: Import) -> int:
    """The command. Raises ValueError for a source with nothing to import, or a bad option."""
    from warmstart.mocap.importer import Entry, Options, import_motions, summaries
    from warmstart.mocap.skeleton import read_joint_map

    options = Options(
        config.body, config.source_fps, config.fps, config.cutoff, config.keep_rejected
    )
    maps = tuple(read_joint_map(path) for path in config.joint_map)
    with progress("motions") as bar:

        def show(entries: list[Entry]) -> None:
            clips = sum(e.status == "clip" for e in entries)
            bar.show(f"{entries[-1].file}: {clips} clips of {len(entries)} files")

        entries = import_motions(config.source, config.out, options, maps, show)
        clips = sum(e.status == "clip" for e in entries)
        bar.finish(f"{clips} clips of {len(entries)} files")
    found = summaries(entries)
    print_table(found)
    left_out = [e for e in entries if e.status != "clip"]
    for entry in left_out[:SHOWN]:
        sentence = "; ".join(entry.reasons)
        print(sentence if entry.status == "unreadable" else f"{entry.file}: {sentence}")
    if len(left_out) > SHOWN:
        print(f"and {len(left_out) - SHOWN} more; import.json has all reasons")
    print(f"wrote {clips} clips to {config.out}")
    if config.result is not None:
        write_result(config, found)
    return 1 if any(e.status == "unreadable" for e in entries) else 0


def write_result(config: Import, found: dict[str, dict[str, Any]]) -> None:
    """The figures of each archive with their origin, for ``results/``."""
    from rl.provenance import commit, hardware, versions
    from warmstart.atomic import write_json

    assert config.result is not None
    value = {
        "command": f"olympics-opt mocap import {config.source.name} --body {config.body}",
        "commit": commit(),
        "versions": versions(),
        "hardware": hardware(),
        "body": config.body,
        "archives": found,
    }
    write_json(config.result, value)
    print(f"wrote {config.result}")


def print_table(found: dict[str, dict[str, Any]]) -> None:
    """One row an archive."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, padding=(0, 0, 0, 1))
    table.add_column("archive", no_wrap=True)
    for _, heading, _ in COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for name, figures in found.items():
        cells = (
            "-" if figures[key] is None else form.format(figures[key]) for key, _, form in COLUMNS
        )
        table.add_row(name, *cells)
    Console().print(table)
