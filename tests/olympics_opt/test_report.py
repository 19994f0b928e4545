"""A report is one file: it refers to nothing outside itself, and a browser shows it in silence."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from olympics_opt.report import page as pages
from olympics_opt.report import plots, sections
from sports.env import make_scene

VOID = {"meta", "link", "br", "img", "line", "path", "input", "source", "hr"}


class Reader(HTMLParser):
    """Collects tags, attributes and texts; knows whether tags nest."""

    def __init__(self) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.scripts: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.stack and self.stack.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data):
        if self.stack and self.stack[-1] in ("script", "style"):
            self.scripts.append(data)
        else:
            self.text.append(data)


def read(html: str) -> Reader:
    reader = Reader()
    reader.feed(html)
    reader.close()
    assert not reader.stack, f"never closed: {reader.stack}"
    return reader


def assert_self_contained(html: str) -> Reader:
    """No attribute, style or script of the page names another file or host."""
    reader = read(html)
    for tag, attributes in reader.tags:
        for name in ("src", "href", "action", "poster", "data", "srcset", "xlink:href"):
            value = attributes.get(name) or ""
            assert not value or value.startswith(("#", "data:")), f"<{tag} {name}={value[:60]}>"
    for text in reader.scripts:
        assert not re.search(r"@import|url\((?!['\"]?data:)", text)
        assert not re.search(r"\bfetch\(|XMLHttpRequest|WebSocket|importScripts|import\(", text)
        hosts = set(re.findall(r"https?://([^\s\"'/]+)", text))
        assert hosts <= {"www.w3.org"}, hosts  # names of namespaces, never fetched
    return reader


def recording(frames: int = 60) -> SimpleNamespace:
    scene = make_scene("high_jump", options={"bar_height": 1.0})
    time = np.arange(frames) / 30.0
    qpos = np.tile(scene.default_qpos(), (frames, 1))
    qpos[:, 0] = 18.0 + 2.0 * time
    qpos[:, 2] = 0.94 + np.maximum(0.0, 4.0 * time - 4.9 * time**2)
    qvel = np.zeros((frames, scene.nv))
    qvel[:, 0], qvel[:, 2] = 2.0, 4.0 - 9.8 * time
    force = np.zeros((frames, 1, scene.body.num_links, 3))
    force[:10, 0, 3, 2] = 1500.0
    return SimpleNamespace(
        task="high_jump",
        scene=scene,
        qpos=qpos,
        qvel=qvel,
        mocap_pos=np.tile(scene.default_mocap_pos(), (frames, 1, 1)),
        ground_force=force,
        terms={"progress": np.full((frames, 1), 0.06), "height": np.zeros((frames, 1))},
        dt=1 / 30,
    )


def whole_page() -> pages.Page:
    checks = [
        {"name": "violation", "value": 3e-7, "limit": 1e-5, "unit": "1", "passed": True},
        {"name": "base residual", "value": 0.031, "limit": 0.02, "unit": "1", "passed": False},
    ]
    parity = [
        {
            "quantity": "mass matrix",
            "mujoco": 71.2,
            "drake": 71.2,
            "difference": 2e-15,
            "unit": "kg",
            "tolerance": 1e-9,
            "ok": True,
        }
    ]
    metric = {"mean": 0.9, "ci95": [0.8, 0.95], "n": 100, "unit": "fraction"}
    results = {"shipped": {"trials": 100, "metrics": {"success": metric}}}
    rng = np.random.default_rng(0)
    samples = {e: {"height": rng.normal(2, 0.1, 40)} for e in ("mujoco", "drake")}
    return pages.Page(
        "Study <of> a & b",
        [
            pages.Section(
                "Asked and achieved",
                [sections.asked_achieved_tiles({"bar_height": 1.0}, {"replay": 1.03}, "m")],
            ),
            sections.certificate_section({"checks": checks, "passed": False}),
            sections.parity_section(parity),
            pages.Section("Metrics", [sections.metric_table(results)]),
            pages.Section("Distributions", [sections.distribution_plots(samples, {"height": "m"})]),
            pages.Section("Motion", [sections.motion_plots(recording())]),
            sections.provenance_section({"commit": "abc", "versions": {"mujoco": "4.0.0"}}),
        ],
        "What a <script>alert(1)</script> does here.",
    )


def test_the_page_is_self_contained_and_escapes_texts(tmp_path: Path):
    html = pages.write_page(whole_page(), tmp_path / "report.html").read_text()
    reader = assert_self_contained(html)
    assert html.count("<script>") == 1
    text = " ".join(" ".join(reader.text).split())
    for words in ("<script>alert(1)</script>", "base residual 0.031", "90 [80, 95] %", "Drake"):
        assert words in text
    anchors = {a.get("id") for tag, a in reader.tags if tag == "section"}
    links = {a["href"][1:] for tag, a in reader.tags if tag == "a"}  # type: ignore[index]
    assert links == anchors


def test_the_checker_sees_outside_references():
    for html in ('<img src="x.png">', '<script>fetch("a")</script>', "<style>@import 'x'</style>"):
        with pytest.raises(AssertionError):
            assert_self_contained(html)


def test_a_plot_keeps_its_numbers_and_its_frame():
    x = np.linspace(0, 7, 1000)
    y = np.sin(x)
    y[100:120] = np.nan
    text = plots.svg(plots.Plot("Sine", "time (s)", "m", [plots.Series("sine", x, y)]))
    reader = read(text)
    numbers = json.loads(next(a["data-plot"] for tag, a in reader.tags if tag == "svg"))  # type: ignore[arg-type]
    series = numbers["series"][0]
    kept = [(a, b) for a, b in zip(series["x"], series["y"]) if b is not None]
    np.testing.assert_allclose([np.sin(a) for a, _ in kept], [b for _, b in kept], atol=1e-3)
    path = next(a["d"] for tag, a in reader.tags if tag == "path")
    points = np.array(re.findall(r"[ML]([\d.-]+) ([\d.-]+)", path), dtype=float)  # type: ignore[arg-type]
    left, right, top, bottom = numbers["box"]
    assert points[:, 0].min() == left and points[:, 0].max() == right
    assert top <= points[:, 1].min() < points[:, 1].max() <= bottom
    assert path.count("M") == 2  # type: ignore[union-attr]  # a gap where there is no number


@pytest.mark.parametrize("low, high", [(0, 1), (-3.3, 12.7), (0.001, 0.0013), (1e6, 9e6), (5, 5)])
def test_ticks_are_round_and_inside(low: float, high: float):
    values = plots.ticks(low, high)
    assert all(low - 1e-9 <= v <= high + 1e-9 for v in values) and 1 <= len(values) <= 11
    assert all(len(f"{v:.10g}".replace("-", "").replace(".", "").strip("0")) <= 3 for v in values)


def test_constant_empty_and_infinite_series():
    flat = plots.Series("flat", np.arange(3), np.ones(3))
    none = plots.Series("none", np.array([]), np.array([]))
    nan = plots.Series("nan", np.arange(3), np.full(3, np.nan))
    wild = plots.Series("wild", np.arange(3), np.array([1.0, np.inf, 2.0]))
    assert "NaN" not in plots.svg(plots.Plot("t", "x", "y", [flat, none, nan, wild]))
    assert plots.svg(plots.Plot("t", "x", "y", [none, nan])) == ""


def test_ecdf_is_the_share_below():
    values = np.array([3.0, 1.0, np.nan, 2.0, 2.0])
    s = plots.ecdf("s", values)
    for x in (1.0, 2.0, 3.0):
        assert s.y[np.flatnonzero(s.x <= x)[-1]] == np.mean(values[np.isfinite(values)] <= x)


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no Chromium on this machine")
def test_a_browser_opens_the_page_in_silence(tmp_path: Path):
    path = pages.write_page(whole_page(), tmp_path / "report.html")
    assert console_of(path, tmp_path) == []


def console_of(path: Path, scratch: Path) -> list[str]:
    """What headless Chromium prints to the console of a page on disk."""
    done = subprocess.run(
        [
            "chromium",
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            f"--user-data-dir={scratch / 'profile'}",
            "--enable-logging=stderr",
            "--v=0",
            "--virtual-time-budget=3000",
            "--dump-dom",
            path.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        stdin=subprocess.DEVNULL,
    )
    assert "</html>" in done.stdout
    return [line for line in done.stderr.splitlines() if "CONSOLE" in line]
