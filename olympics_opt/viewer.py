"""``olympics-opt play``: watch a policy at work, in MuJoCo's own viewer or in a browser.

MuJoCo's viewer steps one world of the environment and shows it as it goes; keys pause it, slow it
down and begin anew. The browser gets a page with the 3-D replay of an episode and a link to the
next one: it needs no display on this machine.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlparse

import mujoco
import numpy as np

from olympics_opt.camera import stand
from olympics_opt.decor import decorated
from olympics_opt.scenery import dressed, terrain

if TYPE_CHECKING:
    from olympics_opt.cli import Play

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0)
"""Of the viewer's clock, against real time."""
REST = 0.8
"""Seconds for which the end of an episode is shown."""
SPACE, MINUS, EQUAL, BACKSPACE, RIGHT = 32, 45, 61, 259, 262
"""Keys, as the viewer numbers them (GLFW)."""
KEYS = "space pauses, - and = change the speed, right arrow steps, backspace begins anew"
NO_DISPLAY = (
    "there is no display here for MuJoCo's viewer: `--viewer browser` serves the episode as a "
    "page, `olympics-opt render` makes a video or a picture"
)


def display_error() -> str | None:
    """Why MuJoCo's viewer cannot open a window here, as a sentence; None where it can."""
    if sys.platform == "linux" and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        return NO_DISPLAY
    if sys.platform == "darwin":
        return None  # MuJoCo itself says there that the program must be run by mjpython
    # In another process: a window that cannot be opened there would hang the viewer here.
    code = (
        "import glfw, sys; ok = glfw.init(); glfw.window_hint(glfw.VISIBLE, 0); "
        "sys.exit(0 if ok and glfw.create_window(8, 8, '', None, None) else 1)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60)
    return None if done.returncode == 0 else NO_DISPLAY


class Session:
    """One world that a policy plays, and what the person at the keys wants of it."""

    def __init__(
        self,
        task: str,
        policy: str,
        *,
        seed: int = 0,
        strength: str | None = None,
        limits: str | None = None,
        options: dict[str, Any] | None = None,
    ) -> None:
        from rl.evaluate import standing_starts
        from rl.policy import as_trained, load_policy
        from sports.env import make_env
        from sports.registry import get_task
        from sports.starts import START_NOISE

        get_task(task)
        self.policy = load_policy(policy, task)
        strength, limits, options = as_trained(self.policy, task, strength, limits, options)
        self.env = make_env(
            task,
            num_worlds=1,
            seed=seed,
            strength=strength,  # type: ignore[arg-type]
            limits=limits,  # type: ignore[arg-type]
            training=False,
            options=options,
        )
        self.policy.check(self.env)
        self.policy.seed(seed)
        self.env.starts = standing_starts(self.env, START_NOISE)
        self.env.keep_snapshot = True
        self.paused = False
        self._speed = SPEEDS.index(1.0)
        self._again = self._once = False
        self.episodes = self.steps = 0
        self.metrics: dict[str, float] = {}
        """Of the last episode that ended."""
        self.begin()
        scene = self.env.physics.scene
        self.scene, _ = dressed(scene, self._shown())
        self.model = decorated(self.scene, terrain(scene, self._shown()))
        self.data = mujoco.MjData(self.model)
        self._rows = [self.model.body(o.name).mocapid[0] for o in self.scene.mocap_objects]
        self.into(self.data)

    @property
    def speed(self) -> float:
        """Of the clock, against real time."""
        return SPEEDS[self._speed]

    @property
    def dt(self) -> float:
        """Seconds between two pictures."""
        return self.env.physics.scene.control_timestep / self.speed

    def begin(self) -> None:
        """Starts an episode."""
        self.obs = self.env.reset()
        self.frame = self.env.snapshot()
        self.steps = 0

    def step(self) -> bool:
        """One control step; whether it ended the episode, of which the last state is kept for
        looking at."""
        if self.steps == 0:
            self.metrics = {}
        result = self.env.step(self.policy(self.obs))
        self.obs, self.frame = result.obs, self.env.final_snapshot
        self.steps += 1
        ended = bool(result.ended[0]) or not bool(result.valid[0])
        if ended:
            self.metrics = {k: float(v[0]) for k, v in result.metrics.items()}
            self.episodes, self.steps = self.episodes + 1, 0
        return ended

    def tick(self) -> bool:
        """What is due at the next picture; whether an episode ended."""
        if self._again:
            self._again = False
            self.begin()
            return False
        if self.paused and not self._once:
            return False
        self._once = False
        return self.step()

    def key(self, code: int) -> None:
        """A key was pressed (called by the viewer's own thread: nothing is done here)."""
        if code == SPACE:
            self.paused = not self.paused
        elif code == BACKSPACE:
            self._again = True
        elif code == RIGHT:
            self.paused = self._once = True
        elif code in (MINUS, EQUAL):
            change = 1 if code == EQUAL else -1
            self._speed = min(max(self._speed + change, 0), len(SPEEDS) - 1)

    def into(self, data: mujoco.MjData) -> None:
        """Puts what is to be seen into MuJoCo's data (of :attr:`model`)."""
        data.qpos[:] = self.frame["qpos"][0].cpu().numpy()
        shown = self._shown()
        mocap = self.frame["mocap_pos"][0].cpu().numpy().reshape(-1, 3)
        places = dressed(self.env.physics.scene, shown)[1][0]
        for row, place in zip(self._rows, np.concatenate((mocap, places))):
            data.mocap_pos[row] = place
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_camlight(self.model, data)

    def turf(self) -> bool:
        """Sets the drawn waves to those of the episode; whether there are any."""
        ground = terrain(self.env.physics.scene, self._shown())
        if ground is None or self.model.nhfield == 0:
            return False
        heights = ground.mesh()[..., 2]
        self.model.hfield_data[:] = ((heights / ground.highest + 1) / 2).ravel()
        return True

    def _shown(self) -> dict[str, np.ndarray]:
        return {
            name[6:]: value[:1].cpu().numpy()
            for name, value in self.frame.items()
            if name.startswith("shown/")
        }

    def close(self) -> None:
        """Frees the engine."""
        self.env.close()


def watch(
    session: Session,
    viewer: Any,
    *,
    say: Callable[[str], None] = print,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Steps a session and shows it until its window (a viewer's handle) is closed."""
    _aim(session, viewer.cam)
    waves = -1
    while viewer.is_running():
        begun = time.perf_counter()
        ended = session.tick()
        if waves != session.episodes and session.turf():
            viewer.update_hfield(0)
        waves = session.episodes
        with viewer.lock():
            session.into(session.data)
        viewer.sync()
        if ended:
            facts = ", ".join(f"{k} {v:.3g}" for k, v in session.metrics.items() if v == v)
            say(f"episode {session.episodes}: {facts}")
        wait = REST if ended else session.dt
        sleep(max(0.0, wait - (time.perf_counter() - begun)))


def _aim(session: Session, camera: mujoco.MjvCamera) -> None:
    """Points the camera at the field, or lets it follow a solo athlete."""
    own = stand(session.scene)
    roots = [
        session.data.qpos[session.scene.agent_qpos(a)][:3] for a in range(session.scene.num_agents)
    ]
    camera.lookat[:] = np.mean(roots, axis=0)
    if own is None:
        camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        camera.trackbodyid = session.model.body(f"agent0/{session.scene.body.links[0].name}").id
        camera.distance, camera.azimuth, camera.elevation = 5.5, 62.0, -9.0
        return
    points = [*roots, *(np.array(a) for a in own.anchors)]
    camera.lookat[:] = (np.max(points, axis=0) + np.min(points, axis=0)) / 2
    camera.distance = max(6.0, 1.6 * float(np.ptp(points, axis=0).max()))
    camera.azimuth, camera.elevation = own.azimuth, -own.pitch


@dataclass(frozen=True)
class Pages:
    """Episodes as pages, each played when it is first asked for."""

    task: str
    trial: Callable[[int], Any]
    """Number of the episode -> its recording."""
    policy: str = ""

    def page(self, number: int, link: bool = True) -> str:
        """HTML of an episode, with a link to the next one."""
        from olympics_opt.report.page import Fragment, Page, Section, Table, render_page
        from olympics_opt.report.replay import ReplayTrack, replay_html

        episode = self.trial(number)
        title = f"{self.task}, episode {number}"
        track = ReplayTrack.from_episode(episode, self.policy or self.task)
        replay = replay_html(episode.scene, [track], title=title, element_id="replay", poster=0.0)
        blocks: list[Any] = [Fragment(replay)]
        if link:
            blocks.append(Fragment(f'<p><a href="/?episode={number + 1}">another episode</a></p>'))
        blocks.append(
            Table(("metric", "value"), [(k, float(v)) for k, v in episode.metrics.items()])
        )
        return render_page(Page(title, [Section(f"policy {self.policy}", blocks)]))


def server(pages: Pages, port: int) -> ThreadingHTTPServer:
    """Serves the pages on this machine only. ``port`` 0 takes a free one."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            address = urlparse(self.path)
            if address.path != "/":
                self.send_error(404)
                return
            text = parse_qs(address.query).get("episode", ["0"])[0]
            body = pages.page(int(text) if text.isdecimal() else 0).encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """The terminal is for the person."""

    return ThreadingHTTPServer(("127.0.0.1", port), Handler)


def run_play(config: Play) -> int:
    """The command. Raises RuntimeError without a display, ValueError for a policy or task that
    cannot be used."""
    from olympics_opt.cli import chosen_options
    from olympics_opt.gallery import shipped
    from olympics_opt.play import athlete, play
    from warmstart import atomic

    policy = config.policy or shipped(config.name)
    athlete(policy, config.name)
    options = chosen_options(config, "task")
    if config.out is not None and config.out.suffix != ".html":
        raise ValueError(f"{config.out} must end in .html")
    viewer = config.viewer or ("browser" if config.out or display_error() else "mujoco")
    if viewer == "mujoco":
        if config.out is not None:
            raise ValueError("--out writes the browser's page: leave --viewer mujoco away")
        if error := display_error():
            raise RuntimeError(error)
        return _in_mujoco(config, policy, options)

    def trial(number: int) -> Any:
        return play(
            config.name,
            policy,
            trials=1,
            seed=config.seed + number,
            strength=config.strength,
            limits=config.limits,
            options=options,
            record=True,
        ).best

    pages = Pages(config.name, trial, policy)
    if config.out is not None:
        print(f"wrote {atomic.write_text(config.out, pages.page(0, link=False))}")
        return 0
    with server(pages, config.port) as serving:
        url = f"http://127.0.0.1:{serving.server_address[1]}/"
        print(f"{config.name} with {policy}: open {url} (Ctrl-C ends it)", flush=True)
        if not display_error():
            import webbrowser

            webbrowser.open(url)
        try:
            serving.serve_forever()
        except KeyboardInterrupt:
            print()
    return 0


def _in_mujoco(config: Play, policy: str, options: dict[str, Any]) -> int:
    import mujoco.viewer

    session = Session(
        config.name,
        policy,
        seed=config.seed,
        strength=config.strength,
        limits=config.limits,
        options=options,
    )
    print(f"{config.name} with {policy}: {KEYS}", flush=True)
    try:
        with mujoco.viewer.launch_passive(
            session.model,
            session.data,
            key_callback=session.key,
            show_left_ui=False,
            show_right_ui=False,
        ) as window:
            watch(session, window)
    except KeyboardInterrupt:
        print()
    finally:
        session.close()
    return 0
