"""Pages of the shipped demonstrations."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

import numpy as np
import pytest

from olympics_opt.cli import main
from olympics_opt.previews import write_previews
from olympics_opt.report.page import Text
from olympics_opt.report.replay import ReplayTrack
from olympics_opt.report.sections import certificate_section
from warmstart.bank import demonstration_files
from warmstart.clip import Clip
from warmstart.replay import scene_of


def test_every_demonstration_has_a_page_with_its_checks(tmp_path: Path, capsys) -> None:
    assert main(["list", "--previews", str(tmp_path / "pages")]) == 0
    written = re.findall(r"wrote (.*)", capsys.readouterr().out)
    assert [Path(name).stem for name in written] == [path.stem for path in demonstration_files()]
    for path in demonstration_files():
        page = (tmp_path / "pages" / f"{path.stem}.html").read_text()
        page = html.unescape(page)
        facts = json.loads(path.with_suffix(".json").read_text())
        for check in facts["checks"]:
            assert check["name"] in page, (path.stem, check["name"])
        assert ("this motion is a demonstration" in page) == ("clip" not in facts)
        if "clip" in facts:
            assert ("it is certified too." in page) is facts["clip"]["certified"]
            pushed = facts["clip"] | {"certified": False, "why_not": "it was pushed"}
            verdict = certificate_section(facts | {"clip": pushed}).blocks[0]
            assert isinstance(verdict, Text)
            assert verdict.text.endswith("not certified, it was pushed.")


def test_a_thrown_ball_is_in_the_replay() -> None:
    (path,) = (p for p in demonstration_files() if p.stem == "free_throw_0.9m_human")
    clip = Clip.load(path)
    scene = scene_of(clip)
    track = ReplayTrack.from_clip(clip, "throw")
    assert track.qpos.shape == (clip.num_frames, len(scene.default_qpos()))
    ball = track.qpos[:, scene.object_qpos("ball")][:, :3]
    rim = np.array((4.5, 0.0, 3.05))
    down = np.flatnonzero((ball[:-1, 2] > rim[2]) & (ball[1:, 2] <= rim[2]))
    assert len(down) and np.linalg.norm(ball[down[0], :2] - rim[:2]) < 0.4


def test_mistakes(tmp_path: Path) -> None:
    bad = tmp_path / "bad.npz"
    bad.write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"bad\.npz"):
        write_previews(tmp_path / "out", [bad])
    assert not (tmp_path / "out").exists()
