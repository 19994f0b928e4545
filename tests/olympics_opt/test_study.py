"""A study that is stopped continues; one whose settings change redoes only what follows."""

from __future__ import annotations

from pathlib import Path

import pytest

from olympics_opt.stages import Stage, run_stages


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


def line(log: Log, number: int = 1) -> list[Stage]:
    return [
        log.stage("solve", settings={"bar": number}),
        log.stage("train", ("solve",), continues=True),
        log.stage("other"),
        log.stage("report", ("train", "other")),
    ]


def test_done_stages_are_not_run_again(tmp_path: Path):
    log, quiet = Log(), lambda text: None
    first = run_stages(tmp_path, line(log), quiet)
    assert log.ran == ["solve", "train", "other", "report"]
    again = run_stages(tmp_path, line(log), quiet)
    assert log.ran == ["solve", "train", "other", "report"]
    assert {n: d.facts for n, d in first.items()} == {n: d.facts for n, d in again.items()}
    assert all(d.reused for d in again.values())


def test_a_stopped_stage_runs_again_and_only_it_may_keep_its_parts(tmp_path: Path):
    log, quiet = Log(), lambda text: None
    for name, kept in (("train", ["part.txt"]), ("other", [])):
        log.fail, log.ran = name, []
        with pytest.raises(RuntimeError, match="stopped"):
            run_stages(tmp_path, line(log), quiet)
        assert log.ran[-1] == name
        log.fail, log.ran = "", []
        done = run_stages(tmp_path, line(log), quiet)
        assert log.ran[0] == name
        assert done[name].facts["seen"] == kept
        for folder in tmp_path.iterdir():  # next round starts from nothing
            (folder / "stage.json").unlink()
            (folder / "started.json").unlink()


def test_a_changed_setting_redoes_what_depends_on_it(tmp_path: Path):
    log, quiet = Log(), lambda text: None
    run_stages(tmp_path, line(log, 1), quiet)
    log.ran = []
    done = run_stages(tmp_path, line(log, 2), quiet)
    # What training wrote came out the same, so that the report still stands.
    assert log.ran == ["solve", "train"]
    assert done["train"].facts["seen"] == []  # parts of other inputs are not continued


def test_a_damaged_output_is_made_again(tmp_path: Path):
    log, quiet = Log(), lambda text: None
    run_stages(tmp_path, line(log), quiet)
    log.ran = []
    (tmp_path / "other" / "result.txt").write_text("damaged")
    run_stages(tmp_path, line(log), quiet)
    # Made again, byte for byte as before: the report that read it still stands.
    assert log.ran == ["other"]


def test_a_torn_manifest_counts_as_not_done(tmp_path: Path):
    log, quiet = Log(), lambda text: None
    run_stages(tmp_path, line(log), quiet)
    log.ran = []
    (tmp_path / "report" / "stage.json").write_text('{"inputs": ')
    run_stages(tmp_path, line(log), quiet)
    assert log.ran == ["report"]
