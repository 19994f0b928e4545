"""What is seen of long work where there is no terminal."""

from __future__ import annotations

from types import SimpleNamespace

from olympics_opt import progress as module
from olympics_opt.progress import progress


def test_without_a_terminal_a_line_is_printed_each_minute(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with progress("playing soccer_1v1, drake") as bar:
        for second in range(0, 200, 20):
            now[0] = float(second)
            bar.show(f"{second} of 200 trials", second, 200)
        bar.finish("200 trials, success 20%")
    lines = [line.strip() for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert lines[:3] == [
        f"playing soccer_1v1, drake: {second} of 200 trials" for second in (60, 120, 180)
    ]
    assert len(lines) == 4 and "success 20%" in lines[3]


def test_what_is_under_way_is_told_as_a_share_of_all(capsys, monkeypatch):
    """Where games take minutes, "0 of 20 trials" alone would look like a program that hangs."""
    now = [0.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with progress("playing soccer_1v1, drake") as bar:
        now[0] = 61.0
        bar.show("0 of 20 trials", 0.5, 20)
    assert "playing soccer_1v1, drake: 0 of 20 trials (2%)" in capsys.readouterr().out
