"""`olympics-opt play` without a window: the session behind the viewer, the browser's pages."""

from __future__ import annotations

import contextlib
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from olympics_opt import viewer
from olympics_opt.cli import main
from olympics_opt.viewer import Pages, Session, server, watch
from tests.olympics_opt.episodes import Episode, bar_scene, jump


@pytest.fixture
def session() -> Iterator[Session]:
    found = Session("high_jump", "zero", seed=3)
    yield found
    found.close()


class Window:
    """A viewer's handle that closes after some pictures, and presses keys before some of them."""

    def __init__(self, session: Session, pictures: int, keys: dict[int, int] | None = None) -> None:
        self.session, self.left, self.keys = session, pictures, keys or {}
        self.cam = mujoco.MjvCamera()
        self.seen: list[np.ndarray] = []

    def is_running(self) -> bool:
        if len(self.seen) in self.keys:
            self.session.key(self.keys.pop(len(self.seen)))
        self.left -= 1
        return self.left >= 0

    def lock(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def sync(self) -> None:
        self.seen.append(self.session.data.qpos.copy())

    def update_hfield(self, number: int) -> None:
        raise AssertionError("the high jump has no waves")


def run(session: Session, pictures: int, keys: dict[int, int] | None = None) -> Window:
    window, waits = Window(session, pictures, keys), []
    watch(session, window, say=lambda text: None, sleep=waits.append)
    assert len(waits) == pictures
    return window


def test_the_viewer_shows_the_environments_states(session: Session) -> None:
    window = run(session, 5)
    assert session.steps == 5
    want = session.env.physics.qpos[0].numpy()
    assert np.allclose(window.seen[-1], want, atol=1e-6)
    assert not np.allclose(window.seen[0], window.seen[-1], atol=1e-6)
    model = session.model
    assert (model.nq, model.nv) == (session.env.physics.scene.nq, session.env.physics.scene.nv)
    mocap = session.env.physics.mocap_pos[0].numpy()
    assert np.allclose(session.data.mocap_pos, mocap, atol=1e-6)
    assert window.cam.type == mujoco.mjtCamera.mjCAMERA_TRACKING


def test_keys_pause_step_slow_down_and_begin_anew(session: Session) -> None:
    run(session, 6, {2: viewer.SPACE})
    assert session.paused and session.steps == 2
    run(session, 4, {1: viewer.RIGHT, 3: viewer.RIGHT})
    assert session.paused and session.steps == 4
    run(session, 3, {1: viewer.SPACE})
    assert not session.paused and session.steps == 6
    run(session, 2, {1: viewer.BACKSPACE})
    assert session.steps == 0 and session.episodes == 0
    plain = session.dt
    for _ in range(9):
        session.key(viewer.MINUS)
    assert session.dt == pytest.approx(10 * plain)
    for _ in range(9):
        session.key(viewer.EQUAL)
    assert session.dt == pytest.approx(plain / 2)


def test_the_end_of_an_episode_is_told_and_the_next_one_begins(session: Session) -> None:
    told: list[str] = []
    waits: list[float] = []
    session.env.max_steps = 4
    watch(session, Window(session, 9), say=told.append, sleep=waits.append)
    assert session.episodes == 2 and session.steps == 1
    assert [text.split(":")[0] for text in told] == ["episode 1", "episode 2"]
    assert "success" in told[0]
    assert sum(w > 0.5 for w in waits) == 2  # its last state stays for a moment


def test_a_policy_that_does_not_fit_is_told() -> None:
    with pytest.raises(ValueError, match="no pretrained policy"):
        Session("high_jump", "pretrained:nothing")


def episode_pages() -> Pages:
    def trial(number: int) -> Episode:
        episode = jump(bar_scene(), "high_jump", frames=10, takeoff=4, seed=number)
        episode.metrics = {"success": 1.0, "height": float(number)}
        return episode

    return Pages("high_jump", trial, "zero")


def test_the_browser_gets_an_episode_and_a_link_to_the_next() -> None:
    with server(episode_pages(), 0) as serving:
        thread = threading.Thread(target=serving.serve_forever, daemon=True)
        thread.start()
        host, port = serving.server_address[:2]
        assert host == "127.0.0.1"  # nobody else's browser
        url = f"http://127.0.0.1:{port}/"
        first = urllib.request.urlopen(url).read().decode()
        third = urllib.request.urlopen(f"{url}?episode=3").read().decode()
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{url}favicon.ico")
        serving.shutdown()
        thread.join()
    assert 'data-replay="play"' in first and "?episode=1" in first and "episode 0" in first
    assert "?episode=4" in third and "<td" in third


def test_without_a_display_one_sentence_and_code_2(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viewer.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["play", "high_jump", "--policy", "zero", "--viewer", "mujoco"]) == 2
    told = capsys.readouterr().err.strip()
    assert told.count("\n") == 0 and "no display" in told and "--viewer browser" in told
    # A display that is named but not there must not hang the viewer either.
    monkeypatch.setenv("DISPLAY", ":93")
    assert viewer.display_error() is not None


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("play", "TASK"),
        ("play no_such_task", "unknown task"),
        ("play high_jump --policy pretrained:nothing", "no pretrained policy"),
        ("play high_jump --out page.png", "must end in .html"),
        ("play high_jump --viewer mujoco --out page.html", "--viewer mujoco"),
    ],
)
def test_mistakes_get_a_sentence(line: str, word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(line.split()) == 2
    assert word in capsys.readouterr().err


def test_the_page_can_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "page.html"
    assert main(["play", "high_jump", "--policy", "zero", "--out", str(path)]) == 0
    text = path.read_text()
    assert 'data-replay="play"' in text and "?episode" not in text
    assert "wrote" in capsys.readouterr().out
