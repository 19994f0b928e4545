"""A study that is stopped continues; one whose settings change redoes only what follows."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from olympics_opt import cli
from olympics_opt.fine_tune import FineTuning
from olympics_opt.stages import Stage, run_stages
from sports.humanoid.body import load_body
from warmstart.certificate import Certificate
from warmstart.solution import Solution
from warmstart.tracking import track


class Log:
    """Stages that count how often they ran."""

    def __init__(self) -> None:
        self.ran: list[str] = []
        self.fail = ""

    def stage(self, name: str, needs: tuple[str, ...] = (), **kwargs) -> Stage:
        def run(folder: Path) -> dict:
            self.ran.append(name)
            seen = sorted(p.name for p in folder.iterdir() if p.suffix != ".json")
            (folder / "part.txt").write_text(name)
            if self.fail == name:
                raise RuntimeError("stopped")
            (folder / "result.txt").write_text(f"{name} {kwargs.get('settings')}")
            return {"seen": seen}

        return Stage(name, name, run, needs=needs, **kwargs)


def four(log: Log, number: int = 1) -> list[Stage]:
    return [
        log.stage("solve", settings={"bar": number}),
        log.stage("train", ("solve",), continues=True),
        log.stage("other"),
        log.stage("report", ("train", "other")),
    ]


def test_done_stages_are_not_run_again(tmp_path: Path):
    log, quiet = Log(), lambda text: None
    first = run_stages(tmp_path, four(log), quiet)
    assert log.ran == ["solve", "train", "other", "report"]
    again = run_stages(tmp_path, four(log), quiet)
    assert log.ran == ["solve", "train", "other", "report"]
    assert {n: d.facts for n, d in first.items()} == {n: d.facts for n, d in again.items()}
    assert all(d.reused for d in again.values())


def test_a_stopped_stage_runs_again_and_only_it_may_keep_its_parts(tmp_path: Path):
    log, quiet = Log(), lambda text: None
    for name, kept in (("train", ["part.txt"]), ("other", [])):
        log.fail, log.ran = name, []
        with pytest.raises(RuntimeError, match="stopped"):
            run_stages(tmp_path, four(log), quiet)
        assert log.ran[-1] == name
        log.fail, log.ran = "", []
        done = run_stages(tmp_path, four(log), quiet)
        assert log.ran[0] == name
        assert done[name].facts["seen"] == kept
        for folder in tmp_path.iterdir():  # next round starts from nothing
            (folder / "stage.json").unlink()
            (folder / "started.json").unlink()


def test_a_changed_setting_redoes_what_depends_on_it(tmp_path: Path):
    log, quiet = Log(), lambda text: None
    run_stages(tmp_path, four(log, 1), quiet)
    log.ran = []
    done = run_stages(tmp_path, four(log, 2), quiet)
    # What training wrote came out the same, so that the report still stands.
    assert log.ran == ["solve", "train"]
    assert done["train"].facts["seen"] == []  # parts of other inputs are not continued


def test_a_damaged_output_is_made_again(tmp_path: Path):
    log, quiet = Log(), lambda text: None
    run_stages(tmp_path, four(log), quiet)
    log.ran = []
    (tmp_path / "other" / "result.txt").write_text("damaged")
    run_stages(tmp_path, four(log), quiet)
    # Made again, byte for byte as before: the report that read it still stands.
    assert log.ran == ["other"]


def test_a_torn_manifest_counts_as_not_done(tmp_path: Path):
    log, quiet = Log(), lambda text: None
    run_stages(tmp_path, four(log), quiet)
    log.ran = []
    (tmp_path / "report" / "stage.json").write_text('{"inputs": ')
    run_stages(tmp_path, four(log), quiet)
    assert log.ran == ["report"]


def standing(problem: str, config, out: Path) -> Solution:
    """In place of the optimiser: an athlete that stands still for a third of a second."""
    body = load_body("smpl", strength="human")
    times = np.linspace(0.0, 0.33, 12)
    qpos = np.zeros((12, 7 + body.num_dofs))
    qpos[:, 2:4] = body.standing_height(), 1.0
    solution = Solution(
        problem=problem,
        body=body,
        asked={"bar_height": config.bar_height},
        strength="human",
        times=times,
        qpos=qpos,
        qvel=np.zeros((12, 6 + body.num_dofs)),
        qacc=np.zeros((12, 6 + body.num_dofs)),
        torque=np.zeros((12, body.num_dofs)),
        contact_points=(("L_Ankle", (0.0, 0.0, -0.05)),),
        contact_force=np.zeros((12, 1, 3)),
        phases=(("stand", 0, 11, (0,)),),
        stats={"solve_s": 0.0},
    )
    solution.save(out / "solution.npz")
    return solution


def track_once(solution, settings, *, attempts, threads, progress):
    """One attempt of few candidates is enough for an athlete that stands."""
    few = replace(settings, worlds=8, horizon=4, iterations=1)
    return track(solution, settings=few, threads=threads, progress=progress)


def no_gl(*args, **kwargs):
    raise RuntimeError("install libegl1")


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A study of the smallest size, of a policy that has hardly begun to learn."""
    from rl.ppo import PPOConfig
    from rl.train import TrainConfig, train

    run = tmp_path_factory.mktemp("policy") / "run"
    small = PPOConfig(hidden=(16, 16), steps=8)
    train(TrainConfig("high_jump", run, worlds=2, samples=32, ppo=small, quiet=True))
    return [
        *("study", "high_jump", "--policy", str(run), "--minutes", "0.01", "--worlds", "4"),
        *("--trials", "2", "--drake-trials", "2", "--processes", "1"),
    ]


def test_a_baseline_cannot_be_fine_tuned(tmp_path: Path, capsys):
    assert cli.main(["study", "high_jump", "--policy", "zero", "--out", str(tmp_path / "s")]) == 2
    assert "baseline" in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


def test_a_motion_that_is_not_certified_ends_the_study(
    tmp_path: Path, line: list[str], monkeypatch, capsys
):
    monkeypatch.setattr("olympics_opt.solve.optimise", standing)
    assert cli.main([*line, "--out", str(tmp_path)]) == 2
    assert "not certified" in capsys.readouterr().err
    assert (tmp_path / "certify" / "certificate.json").is_file()
    assert not (tmp_path / "warm_start").exists()


def test_a_whole_study_and_the_same_again(tmp_path: Path, line: list[str], monkeypatch, capsys):
    """Every stage but the optimiser and its gate for real, at the smallest size."""
    monkeypatch.setattr("olympics_opt.solve.optimise", standing)
    monkeypatch.setattr(Certificate, "passed", property(lambda self: True))
    monkeypatch.setattr("warmstart.demonstration.track_best", track_once)
    monkeypatch.setattr("olympics_opt.render.render_video", no_gl)
    monkeypatch.setattr("olympics_opt.study.TUNING", FineTuning(steps=8, trials=2))
    assert cli.main([*line, "--out", str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text()
    assert "No video: install libegl1" in page  # and the rest of the report is whole
    for words in ("Summary", "Certificate", "Learning", "Shipped and fine-tuned", "Verdict"):
        assert f">{words}</h2>" in page
    tuned = json.loads((tmp_path / "evaluate" / "fine-tuned.json").read_text())
    assert (tuned["trials"], tuned["options"]) == (2, {"bar_height": 1.0})
    # The athlete that stands cleared no bar, so its motion is no demonstration.
    assert not (tmp_path / "warm_start" / "demo.npz").exists()
    capsys.readouterr()

    monkeypatch.setattr("olympics_opt.solve.optimise", None)  # nothing may run again
    (tmp_path / "report.html").unlink()
    assert cli.main([*line, "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out.count("done before") == 7
    assert (tmp_path / "report.html").read_text() == page

    # More trials: played and reported anew, nothing else.
    assert cli.main([*line, "--out", str(tmp_path), "--trials", "3"]) == 0
    assert capsys.readouterr().out.count("done before") == 5
    tuned = json.loads((tmp_path / "evaluate" / "fine-tuned.json").read_text())
    assert tuned["trials"] == 3
