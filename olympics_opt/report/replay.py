"""A 3-D replay inside a page: motions, scene and player in one piece of HTML.

The fragment needs no library, no WebGL and no network: the states are packed as 16-bit numbers,
the page computes the link poses (``replay_scene.js``), draws them on a canvas
(``replay_draw.js``) and has a player's controls (``replay.js``).
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from html import escape
from importlib import resources
from types import SimpleNamespace
from typing import Any

import numpy as np

from olympics_opt.camera import focus, stand, things
from olympics_opt.episode import Player
from olympics_opt.scenery import (
    Terrain,
    complete_qpos,
    dressed,
    ground_marks,
    is_net,
    shape_colors,
    terrain,
)
from olympics_opt.scenery.golf import FAIRWAY
from sports.humanoid.body import Shape
from sports.scene import Scene, SceneObject

MAX_RATE = 60.0
"""Frames per second kept; faster recordings are resampled."""
COLORS = ("#5b6673", "#c2408f", "#1c8a5a", "#8a63d2", "#b58900", "#0f8b8d")
"""Colours of the tracks; the first track's athlete is drawn in its limb colours."""
TURF_STEP = 0.8
"""Distance of the points of a drawn terrain (m)."""
LENS, ASPECT = 2.1, 1.9
"""Of the page's camera (``replay_draw.js``) and its canvas."""


@dataclass(frozen=True)
class ReplayTrack:
    """One motion of the scene."""

    name: str
    """What the legend calls it."""
    qpos: np.ndarray
    """(T, nq) of the scene, or (T, 7 + num_dofs) of its first athlete alone."""
    dt: float
    """Seconds between frames."""
    mocap_pos: np.ndarray | None = None
    """(T, M, 3) positions of the movable fixtures; None where the scene puts them."""
    ground_force: np.ndarray | None = None
    """(T, A, B, 3) force of the ground on each link (N), drawn as arrows on request."""
    start: float = 0.0
    """Time of the first frame on the common clock (s)."""
    shown: Mapping[str, np.ndarray] = field(default_factory=dict)
    """What the recording says of the field (``Task.shown``)."""

    def __post_init__(self) -> None:
        qpos = np.atleast_2d(np.asarray(self.qpos, dtype=float))
        if len(qpos) == 0 or not np.isfinite(qpos).all():
            raise ValueError(f"replay track '{self.name}': qpos is empty or not finite")
        if not self.dt > 0:
            raise ValueError(f"replay track '{self.name}': dt must be positive, not {self.dt}")
        object.__setattr__(self, "qpos", qpos)

    @classmethod
    def from_episode(cls, episode: Any, name: str) -> ReplayTrack:
        """A track of a recorded episode (`rl.evaluate.Recording`)."""
        return cls(
            name,
            episode.qpos,
            episode.dt,
            mocap_pos=episode.mocap_pos,
            ground_force=episode.ground_force,
            shown=getattr(episode, "shown", {}),
        )

    @classmethod
    def from_clip(cls, clip: Any, name: str) -> ReplayTrack:
        """A track of a motion clip (`warmstart.clip.Clip`), with what the athlete handles."""
        things = getattr(clip, "object_qpos", None)  # the scene's last coordinates
        qpos = clip.qpos if things is None else np.hstack((clip.qpos, things))
        return cls(name, qpos, 1.0 / clip.fps)


def aligned(tracks: Iterable[ReplayTrack], x: float = 20.0) -> list[ReplayTrack]:
    """Tracks shifted in time so that the athlete passes ``x`` (m) at the same moment in all.

    A track that never passes it ends with the others' passing. The earliest starts at 0.
    """
    tracks = list(tracks)
    passing = []
    for track in tracks:
        beyond = np.flatnonzero(track.qpos[:, 0] >= x)
        passing.append((beyond[0] if len(beyond) else len(track.qpos) - 1) * track.dt)
    latest = max(passing, default=0.0)
    return [replace(track, start=latest - when) for track, when in zip(tracks, passing)]


def pack(table: np.ndarray) -> dict[str, Any]:
    """A (T, K) table as 16-bit steps between each column's least and greatest value.

    Columns that never change are stored once. The error is at most half a step:
    (greatest - least) / 131070.
    """
    table = np.asarray(table, dtype=float)
    low, high = table.min(0), table.max(0)
    columns = np.flatnonzero(high - low > 1e-7)
    step = (high - low)[columns] / 65535.0
    whole = np.rint((table[:, columns] - low[columns]) / step).astype("<u2")
    return {
        "frames": len(table),
        "base": [float(f"{v:.7g}") for v in low],
        "columns": columns.tolist(),
        "step": [float(f"{v:.9g}") for v in step],
        "data": base64.b64encode(whole.tobytes()).decode("ascii"),
    }


def unpack(packed: dict[str, Any]) -> np.ndarray:
    """(T, K) the table that :func:`pack` stored; the page's script does the same."""
    columns = packed["columns"]
    whole = np.frombuffer(base64.b64decode(packed["data"]), dtype="<u2")
    table = np.tile(np.array(packed["base"], dtype=float), (packed["frames"], 1))
    table[:, columns] += whole.reshape(packed["frames"], len(columns)) * np.array(packed["step"])
    return table


def _continuous(qpos: np.ndarray, scene: Scene) -> np.ndarray:
    """Quaternions of neighbouring frames on the same side, so that they can be interpolated."""
    qpos = qpos.copy()
    starts = [scene.agent_qpos(a).start + 3 for a in range(scene.num_agents)]
    starts += [scene.object_qpos(o.name).start + 3 for o in scene.free_objects]
    for start in starts:
        quat = qpos[:, start : start + 4]
        flips = np.cumprod(np.where((quat[1:] * quat[:-1]).sum(1) < 0, -1.0, 1.0))
        quat[1:] *= flips[:, None]
    return qpos


def _resampled(table: np.ndarray, dt: float) -> tuple[np.ndarray, float]:
    """A table at no more than 60 frames per second, linear between its frames."""
    if len(table) < 2 or 1.0 / dt <= MAX_RATE * 1.01:
        return table, dt
    times = np.arange(len(table)) * dt
    count = max(2, int(times[-1] * MAX_RATE) + 1)
    wanted = np.linspace(0.0, times[-1], count)
    flat = table.reshape(len(table), -1)
    columns = np.stack([np.interp(wanted, times, column) for column in flat.T], axis=1)
    return columns.reshape(count, *table.shape[1:]), float(wanted[1])


def _track(scene: Scene, track: ReplayTrack, color: str) -> dict[str, Any]:
    qpos, dt = _resampled(_continuous(complete_qpos(scene, track.qpos), scene), track.dt)
    packed: dict[str, Any] = {
        "name": track.name,
        "color": color,
        "start": round(track.start, 5),
        "dt": dt,
        "qpos": pack(qpos),
    }
    player = Player(_episode(scene, track))
    if player.mocap.shape[1]:
        mocap, _ = _resampled(player.mocap, track.dt)
        packed["mocap"] = pack(np.reshape(mocap, (len(mocap), -1)))
    if track.ground_force is not None and np.size(track.ground_force):
        force, _ = _resampled(np.asarray(track.ground_force, dtype=float), track.dt)
        force = np.where(np.linalg.norm(force, axis=-1, keepdims=True) > 20.0, force, 0.0)
        packed["force"] = pack(np.reshape(force, (len(force), -1)))
    if stand(scene) is not None:
        path, away = focus(player, LENS, ASPECT)
        packed["focus"] = pack(_resampled(path, track.dt)[0])
        packed["distance"] = round(float(away.max()), 2)
    return packed


def _episode(scene: Scene, track: ReplayTrack) -> Any:
    """A track as the camera and the player of pictures want it."""
    mocap = np.zeros(0) if track.mocap_pos is None else track.mocap_pos
    return SimpleNamespace(
        task=scene.name,
        scene=scene,
        qpos=track.qpos,
        mocap_pos=mocap,
        ground_force=np.zeros(0),
        dt=track.dt,
        shown=track.shown,
    )


def _shape(shape: Shape) -> dict[str, Any]:
    row = {"kind": shape.kind, "center": shape.center, "size": shape.size}
    return row if shape.end is None else {**row, "end": shape.end}


def _object(o: SceneObject, prop: bool) -> dict[str, Any]:
    channels = (round(255 * min(max(c, 0.0), 1.0)) for c in o.rgba[:3])
    row: dict[str, Any] = {
        "motion": o.motion,
        "pos": o.pos,
        "quat": o.quat,
        "color": "#" + "".join(f"{c:02x}" for c in channels),
        "shapes": [_shape(s) for s in o.shapes],
    }
    if o.rgba[3] < 1.0:
        row["alpha"] = round(float(o.rgba[3]), 3)
    if is_net(o.name):
        row["net"] = True
    if prop:
        row["over"] = 0.3  # paint on a thing: drawn after it
    return row


def _scene(scene: Scene, shown: Mapping[str, np.ndarray]) -> dict[str, Any]:
    full, _ = dressed(scene, shown)
    ground = terrain(scene, shown)
    colors = [shape_colors(scene, agent) for agent in range(scene.num_agents)]
    balls = [scene.object_qpos(name).start for name in things(scene)]
    roots = [scene.agent_qpos(agent).start for agent in range(scene.num_agents)]
    solo = stand(scene) is None
    return {
        "agents": scene.num_agents,
        "links": [
            {
                "name": link.name,
                "parent": int(parent),
                "offset": link.offset,
                "shapes": [_shape(s) for s in link.shapes],
            }
            for link, parent in zip(scene.body.links, scene.body.parents())
        ],
        "colors": [[own[link] for link in scene.body.link_names] for own in colors],
        "objects": [_object(o, i >= len(scene.objects)) for i, o in enumerate(full.objects)],
        "marks": _marks(scene, ground),
        "terrain": None if ground is None else _turf(ground),
        "trails": balls + (roots if solo or not balls else []),
        "subject": {"at": balls[0] if balls else 0, "name": things(scene)[0] if balls else ""},
    }


def _marks(scene: Scene, ground: Terrain | None) -> list[dict[str, Any]]:
    """Marks with their corners on the ground; the turf of a terrain is drawn by itself."""
    found = []
    for m in ground_marks(scene):
        if ground is None:
            corners: list[Any] = [[round(c, 4) for c in corner] for corner in m.corners]
        elif m.color == FAIRWAY:
            continue
        else:
            xy = np.array(m.corners)
            z = ground.height(xy[:, 0], xy[:, 1])
            corners = np.c_[xy, z + 0.01].round(4).tolist()
        found.append({"corners": corners, "color": m.color, "label": m.label})
    return found


def _turf(ground: Terrain) -> dict[str, Any]:
    """A terrain as rows of heights over a rectangle."""
    mesh = ground.mesh(TURF_STEP)
    return {
        "low": mesh[0, 0, :2].tolist(),
        "high": mesh[-1, -1, :2].tolist(),
        "heights": mesh[..., 2].round(3).tolist(),
        "color": FAIRWAY,
    }


def replay_data(
    scene: Scene,
    tracks: Sequence[ReplayTrack],
    *,
    poster: float | None = None,
) -> dict[str, Any]:
    """Everything the page's player needs, as plain JSON values.

    Args:
        scene: athletes and objects; all tracks share it.
        tracks: at least one motion.
        poster: time of the picture before playing starts (s); by default the highest moment of
            the first track.

    Raises:
        ValueError: no tracks, or a track that does not fit the scene.
    """
    if not tracks:
        raise ValueError("a replay needs at least one track")
    first = tracks[0]
    scenery = _scene(scene, first.shown)
    if poster is None:
        height = complete_qpos(scene, first.qpos)[:, scenery["subject"]["at"] + 2]
        poster = first.start + float(height.argmax()) * first.dt
    way = first.qpos[-1, :2] - first.qpos[0, :2]
    heading = math.atan2(way[1], way[0]) if np.hypot(*way) > 0.5 else 0.0
    yaw, pitch, own = heading + math.radians(64), 0.16, stand(scene)
    if own is not None:
        yaw, pitch = math.radians(own.azimuth), math.radians(own.pitch)
        heading = yaw - math.pi / 2  # the side view is the sport's own
    return {
        "scene": scenery,
        "tracks": [_track(scene, t, COLORS[i % len(COLORS)]) for i, t in enumerate(tracks)],
        "poster": round(poster, 4),
        "heading": round(heading, 4),
        "yaw": round(yaw, 4),
        "pitch": round(pitch, 4),
    }


@cache
def _text(name: str) -> str:
    return resources.files("olympics_opt.report").joinpath(name).read_text(encoding="utf-8")


_CONTROLS = """\
<div class="replay-picture">
<canvas data-replay="canvas" role="img" aria-label="{title}"></canvas>
<output class="replay-facts" data-replay="facts"></output>
</div>
<div class="replay-bar">
<button type="button" data-replay="play" aria-label="Play">▶</button>
<input type="range" data-replay="scrub" step="any" aria-label="Time">
<output class="replay-time" data-replay="time"></output>
<label>Speed <select data-replay="speed">
<option value="0.1">0.1×</option><option value="0.25">0.25×</option>
<option value="0.5">0.5×</option><option value="1" selected>1×</option>
<option value="2">2×</option></select></label>
<label>View <select data-replay="look">
<option value="start">three-quarter</option><option value="side">side</option>
<option value="front">front</option><option value="behind">behind</option>
<option value="top">top</option></select></label>
</div>
<div class="replay-bar">
<div class="replay-legend" data-replay="legend"></div>
<label><input type="checkbox" data-replay="split"> side by side</label>
<label><input type="checkbox" data-replay="follow" checked> follow</label>
<label><input type="checkbox" data-replay="trails" checked> path</label>
<label><input type="checkbox" data-replay="forces"> ground forces</label>
<span class="replay-help">drag to turn · click, then wheel to zoom · space plays · ← → step</span>
</div>
"""


def replay_html(
    scene: Scene,
    tracks: Sequence[ReplayTrack],
    *,
    title: str,
    element_id: str,
    poster: float | None = None,
) -> str:
    """A replay as a self-contained HTML fragment: style, picture, controls, data and script.

    Args:
        scene: athletes and objects; all tracks share it.
        tracks: motions, overlaid or side by side; the first leads the camera and is drawn in
            limb colours (left blue, right orange).
        title: read out for the picture.
        element_id: id of the fragment's outer element, unique on the page.
        poster: time of the first picture (s); default: highest moment of the first track.

    Returns:
        HTML text. A page may hold several; the script is guarded against running twice.

    Raises:
        ValueError: no tracks, a track that does not fit the scene, or an unfit id.
    """
    if not element_id.replace("-", "").replace("_", "").isalnum():
        raise ValueError(f"element id '{element_id}' may hold letters, digits, - and _ only")
    data = replay_data(scene, tracks, poster=poster)
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    script = "".join(map(_text, ("replay_scene.js", "replay_draw.js", "replay.js")))
    return (
        f'<div class="replay" id="{element_id}" tabindex="0" role="group" '
        f'aria-label="3-D replay: {escape(title)}">\n'
        f"<style>{_text('replay.css')}</style>\n"
        f"{_CONTROLS.format(title=escape(title))}"
        f'<script type="application/json" data-replay="data">{text}</script>\n'
        "<script>\n"
        f"window.OlympicsReplay ??= (() => {{{script}\nreturn Replay;}})();\n"
        f'{{const root = document.getElementById("{element_id}");\n'
        "root.replay = window.OlympicsReplay.mount("
        "root, JSON.parse(root.querySelector('[data-replay=\"data\"]').textContent));}\n"
        "</script>\n</div>"
    )
