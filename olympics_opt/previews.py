"""``olympics-opt list --previews DIR``: a page for every shipped demonstration.

The page of ``solve`` shows an optimisation just made. This one shows what was shipped: the clip in
a 3-D replay with what it handles, what was asked and achieved, every check of its certificate.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from olympics_opt.report import sections
from olympics_opt.report.page import Fragment, Page, Section, write_page
from olympics_opt.report.replay import ReplayTrack, replay_html
from warmstart.bank import demonstration_files
from warmstart.clip import Clip
from warmstart.problems import get_problem
from warmstart.replay import scene_of


def write_previews(folder: str | Path, files: Sequence[Path] | None = None) -> list[Path]:
    """Writes ``NAME.html`` for each demonstration into a folder and returns the pages.

    ``files`` are the clips, each with its certificate (``.json``) beside it; by default those that
    are shipped. Raises OSError, and ValueError for a file that is no clip.
    """
    folder = Path(folder)
    found = demonstration_files() if files is None else files
    return [preview(path, folder / f"{path.stem}.html") for path in found]


def preview(path: Path, out: Path) -> Path:
    """The page of one demonstration."""
    clip = Clip.load(path)
    meta, certificate = clip.meta, path.with_suffix(".json")
    facts = json.loads(certificate.read_text()) if certificate.is_file() else None
    title = f"{str(meta['problem']).replace('_', ' ').capitalize()}: {path.stem}"
    unit = get_problem(meta["problem"]).unit
    achieved = facts["achieved"] if facts else meta.get("achieved", {})
    track = ReplayTrack.from_clip(clip, "demonstration")
    replay = replay_html(scene_of(clip), [track], title=title, element_id="replay-demonstration")
    known = ("problem", "asked", "achieved", "strength", "source", "licence", "options")
    provenance = {name: meta[name] for name in known if name in meta}
    blocks = [
        Section(
            "Asked and achieved", [sections.asked_achieved_tiles(meta["asked"], achieved, unit)]
        ),
        Section("Replay", [Fragment(replay)]),
        Section("The motion over time", [sections.body_plots(clip.times, clip.qpos, clip.qvel)]),
        *([sections.certificate_section(facts)] if facts else []),
        sections.provenance_section(provenance | {"clip's achievement": meta.get("achieved", {})}),
    ]
    lead = "A demonstration as it is shipped: its states start episodes of training."
    return write_page(Page(title, blocks, lead), out)
