"""Learning curves that are kept: which rows and columns, where they came from, mistakes."""

from __future__ import annotations

import csv
import itertools
import json
from dataclasses import asdict
from pathlib import Path

import pytest

from rl import provenance
from rl.config import config_from_dict, parse_args
from rl.curves import main, record_curve, usual_settings

CARD = {"task": "golf", "commit": "abc", "hardware": "a lathe", "config": {"seed": 3}, "obs": [1]}


def progress(folder: Path, rows: int) -> Path:
    """Row k has k thousand samples; the metric is missing in odd rows, a column is no metric."""
    path = folder / "p.csv"
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("iteration", "samples", "return", "kl", "metrics/hit_rate"))
        for k in range(rows):
            writer.writerow((k, 1000 * k, k * k, 0.02, "" if k % 2 else k / 100))
    return path


@pytest.mark.parametrize(("rows", "points", "kept"), [(1, 60, 1), (7, 60, 7), (1001, 11, 11)])
def test_rows_are_thinned_out_evenly_with_both_ends(tmp_path, rows, points, kept):
    out = record_curve(progress(tmp_path, rows), CARD, tmp_path / "c.json", points)
    curve = json.loads(out.read_text())
    samples = curve["rows"]["samples"]
    assert len(samples) == kept and samples[0] == 0 and samples[-1] == 1000 * (rows - 1)
    steps = {b - a for a, b in itertools.pairwise(samples)}
    assert len(steps) <= 1
    assert curve["rows"]["return"] == [(s / 1000) ** 2 for s in samples]
    hits = [None if s // 1000 % 2 else s / 1e5 for s in samples]
    assert curve["rows"]["metrics/hit_rate"] == hits
    assert set(curve["rows"]) == {"samples", "return", "metrics/hit_rate"}
    assert all(isinstance(s, int) for s in samples)
    assert curve["config"] == {"seed": 3} and curve["commit"] == "abc" and "obs" not in curve


def test_numbers_that_are_not_whole_are_rounded(tmp_path):
    (tmp_path / "p.csv").write_text("samples,return,metrics/success\n196608,1234567.5,0.66666667\n")
    curve = json.loads(record_curve(tmp_path / "p.csv", CARD, tmp_path / "c.json").read_text())
    assert curve["rows"] == {
        "samples": [196608],
        "return": [1235000.0],
        "metrics/success": [0.6667],
    }


def test_of_the_settings_those_are_kept_that_are_not_the_usual_ones(tmp_path):
    """What is left out comes back: the usual settings with those that were kept are the card's."""
    words = ["golf", "--seed", "3", "--ppo.sigma", "0.1", "--task.reach", "20", "--vary"]
    words += ["--variation.friction", "0.8", "1.2", "--retries.share", "0.5", "--clips", "a", "b"]
    config = parse_args(words)
    card = CARD | {"config": json.loads(json.dumps(asdict(config), default=str))}
    curve = json.loads(record_curve(progress(tmp_path, 2), card, tmp_path / "c.json").read_text())
    kept = curve["config"]
    assert curve["usual_of"] == provenance.commit()
    assert kept["ppo"] == {"sigma": 0.1} and kept["variation"] == {"friction": [0.8, 1.2]}
    assert set(kept) == {"task", "seed", "ppo", "options", "vary", "variation", "retries", "clips"}
    whole = usual_settings("golf")
    for name, value in kept.items():
        whole[name] = {**whole[name], **value} if isinstance(value, dict) else value
    assert config_from_dict(whole) == config


def test_the_command_takes_a_policy_with_its_curve(tmp_path, capsys):
    progress(tmp_path, 3)
    (tmp_path / "p.json").write_text(json.dumps(CARD))
    assert main([str(tmp_path / "p.safetensors"), str(tmp_path / "deep" / "c.json")]) == 0
    assert json.loads((tmp_path / "deep" / "c.json").read_text())["task"] == "golf"


def test_mistakes_are_told_in_a_sentence(tmp_path, capsys):
    assert main([]) == 2
    assert main([str(tmp_path / "none.safetensors"), str(tmp_path / "c.json")]) == 2
    (tmp_path / "p.json").write_text(json.dumps(CARD))
    (tmp_path / "p.csv").write_text("a,b\n1,2\n")
    assert main([str(tmp_path / "p.safetensors"), str(tmp_path / "c.json")]) == 2
    assert capsys.readouterr().err.count("\n") == 3 and not (tmp_path / "c.json").exists()
