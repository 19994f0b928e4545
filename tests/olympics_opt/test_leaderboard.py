"""Tables of results: every figure comes from a file, and a broken file is named."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from olympics_opt import leaderboard
from olympics_opt.bench import bench, soak_all
from olympics_opt.speeds import overflowed
from rl.scaling import Point, ScalingConfig, write_points


def result(**changes) -> dict:
    return {
        "task": "high_jump",
        "algo": "ppo",
        "policy_sha256": "ab" * 32,
        "engine": "mujoco",
        "strength": "paper",
        "limits": "paper",
        "trials": 1000,
        "seed": 0,
        "commit": "0123456789abcdef",
        "versions": {},
        "hardware": "a machine",
        "metrics": {
            "success_1.0m": {"mean": 0.875, "ci95": [0.853, 0.894], "n": 1000, "unit": "fraction"},
            "height_1.0m": {"mean": 1.625, "ci95": [1.5, 1.75], "n": 875, "unit": "m"},
        },
        "overflow": 0,
        "nan_worlds": 0,
        **changes,
    }


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "a.json").write_text(json.dumps(result(engine="drake", trials=100)))
    (tmp_path / "b.json").write_text(json.dumps(result()))
    (tmp_path / "bench.json").write_text(json.dumps({"steps_per_s": 1}))
    return tmp_path


def test_the_page_has_our_figures_and_the_papers(folder: Path):
    page = leaderboard.results_page(leaderboard.read_results(folder))
    rows = [line for line in page.splitlines() if line.startswith("| ppo")]
    assert ["mujoco" in rows[0], "drake" in rows[1]] == [True, True]
    assert "87.5 [85.3, 89.4] %" in page
    paper = next(line for line in page.splitlines() if line.startswith("| PPO, paper"))
    assert "100 %" in paper and "4.08 m" in paper  # sports page: 100 % / 4.08 at 1 m
    assert all(line.count(" | ") == rows[0].count(" | ") for line in (paper, rows[1]))


def test_the_front_page_keeps_its_text(folder: Path):
    front = folder / "front.md"
    text = f"# Title\n\n{leaderboard.BEGIN}\nold\n{leaderboard.END}\n\nThe end.\n"
    front.write_text(text)
    leaderboard.rebuild(folder, front)
    once = front.read_text()
    assert once.startswith("# Title\n") and once.endswith("\nThe end.\n") and "old" not in once
    leaderboard.rebuild(folder, front)
    assert front.read_text() == once


@pytest.mark.parametrize(
    ("algo", "height"), [("ppo", "4.08"), ("selfplay", "4.08"), ("latent", "2.01 m (PULSE)")]
)
def test_a_method_stands_beside_the_papers_own(algo: str, height: str):
    row = leaderboard.summary_table([result(algo=algo)]).splitlines()[2]
    assert f"height_1.0m {height}" in row.split("|")[-2]


def test_a_task_that_the_paper_has_no_figures_of_stands_alone():
    goals = {"goals_for": {"mean": 0.2, "ci95": [0.1, 0.3], "n": 9, "unit": "goals"}}
    row = {"task": "soccer_1v1", "algo": "latent", "strength": "human", "engine": "mujoco"}
    line = leaderboard.summary_table([{**row, "trials": 9, "metrics": goals}]).splitlines()[-1]
    assert line.replace(" ", "").endswith("|goals_for0.2[0.1,0.3]goals||")


def test_a_front_page_without_marks_changes_nothing(folder: Path):
    front = folder / "front.md"
    front.write_text("# Title\n")
    with pytest.raises(ValueError, match="marks"):
        leaderboard.rebuild(folder, front)
    assert front.read_text() == "# Title\n" and not (folder / "README.md").exists()


@pytest.mark.parametrize(
    "other", [{"felt_damping": True}, {"timestep_divisor": 4}, {"variation": {"own_share": 0.0}}]
)
def test_other_physics_is_left_out(folder: Path, other: dict[str, object]):
    before = leaderboard.read_results(folder)
    (folder / "other.json").write_text(json.dumps(result(**other)))
    assert leaderboard.read_results(folder) == before


@pytest.mark.parametrize("text", ['{"task": ', '{"task": "x", "metrics": {}}'])
def test_a_broken_result_is_named(folder: Path, text: str):
    (folder / "broken.json").write_text(text)
    with pytest.raises(ValueError, match=r"broken\.json"):
        leaderboard.read_results(folder)


def test_the_papers_table_is_whole():
    paper = leaderboard.paper_results()
    assert paper["long_jump"]["success"]["PPO"] == pytest.approx(0.536)
    assert paper["table_tennis"]["error"]["PULSE + AMP"] == pytest.approx(0.23)
    for task, metrics in paper.items():
        for name, row in metrics.items():
            values = [row[a] for a in leaderboard.PAPER_COLUMNS if row[a] is not None]
            assert values, (task, name)
            assert row["unit"] != "fraction" or all(0 <= v <= 1 for v in values), (task, name)


def test_our_metrics_have_the_papers_names():
    """The comparison is by name: a renamed metric would drop out of the table in silence."""
    from sports.registry import get_task, task_names

    paper = leaderboard.paper_results()
    for task in set(task_names()) & set(paper):
        units = get_task(task).metrics
        for name, row in paper[task].items():
            assert re.fullmatch(re.escape(row["unit"]), units[name]), (task, name)


def test_scaling_has_a_table(folder: Path):
    points = [
        Point(n, 8192, samples, samples / 3e5, samples / 3e5 / n, 0.5, 0.1, 50, 30.0)
        for n, samples in ((4, 1.14e6), (1, 3e5))
    ]
    config = ScalingConfig("long_jump", out=folder / "scaling.json")
    write_points(config, ["--vary"], points)
    leaderboard.rebuild(folder, None)
    page = (folder / "README.md").read_text()
    rows = [line for line in page.splitlines() if "[scaling.json]" in line]
    assert rows[0].startswith("| long_jump | warp | 8192 | 1 | 300.0 k | 1.00 |")
    assert rows[1].startswith("| long_jump | warp | 8192 | 4 | 1140.0 k | 3.80 |")
    head = next(line for line in page.splitlines() if "| times one |" in line)
    assert head.count(" | ") == rows[0].count(" | ")


def test_speeds_and_endurance_have_tables(folder: Path):
    """From what ``bench`` writes, itself on a small task."""
    bench(folder / "speed.json", engines=["mujoco"], tasks=["long_jump"], worlds=[2], seconds=0.01)
    soak_all(folder / "soak.json", engines=["mujoco"], tasks=["long_jump"], worlds=[2], steps=20)
    leaderboard.rebuild(folder, None)
    page = (folder / "README.md").read_text()
    speed = json.loads((folder / "speed.json").read_text())["rows"][0]
    row = next(line for line in page.splitlines() if "[speed.json]" in line)
    assert "| long_jump | mujoco | 2 | 4 x 1/120 s |" in row
    assert f"| {100 * speed['environment_share']:.0f} % |" in row
    row = next(line for line in page.splitlines() if "[soak.json]" in line)
    assert row.startswith("| long_jump | mujoco | 2 | 20 |")
    assert overflowed({"overflow": 3, "overflows": {"nefc": 1, "ccd": 2}}) == "3 (ccd, nefc)"
    assert overflowed({"overflow": 3}) == "3", "a row of before the kinds were counted"
    heads = [line for line in page.splitlines() if line.startswith("| task |")]
    assert len(heads) == 2 and heads[1].count(" | ") == row.count(" | ")
    (folder / "other.json").write_text(json.dumps({"rows": [{"height": 1.0}]}))
    leaderboard.rebuild(folder, None)
    broken = {"rows": [{"task": "long_jump"}], "steps_per_turn": 24}
    (folder / "speed.json").write_text(json.dumps(broken))
    with pytest.raises(ValueError, match=r"speed\.json: a row of 'rows' lacks"):
        leaderboard.rebuild(folder, None)
