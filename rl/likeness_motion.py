"""Motions whose likeness to people is measured: of policies, recordings, demonstrations, people.

Every motion is a path of one athlete at 30 frames a second. Speeds come from differences of that
path, whatever else its source knows: an engine's own velocities would tell a simulated motion from
a captured one. Torques are those of simulated motions; a captured one has none.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rl.recording import Recording
from sports.humanoid.body import Body, Strength, is_finger, load_body
from sports.registry import get_task
from warmstart.clip import Clip, finite_difference_qvel
from warmstart.library import FPS, Library, Origin, load_library

CAPTURED_NOT = ("demonstrations",)
"""Archives of a library that are no recordings of people."""


@dataclass(frozen=True, eq=False)
class Drive:
    """What the joints did in K control steps, n dofs without fingers: at the start and at the end
    of each step, with the state of that moment and the PD targets of the step."""

    torque: np.ndarray
    """(K, 2, n) N m: the servo within its limits, less the passive damping."""
    speed: np.ndarray
    """(K, 2, n) rad/s"""
    dt: float
    """Seconds of a step."""


@dataclass(frozen=True, eq=False)
class Motion:
    """One athlete's motion, frames at ``FPS``."""

    name: str
    group: str
    """What it may share habits with: the archive of a clip, the task of an episode."""
    body: str
    qpos: np.ndarray
    """(T, 7 + n), T >= 2: place (m), attitude (w x y z), hinge angles (rad)."""
    drive: Drive | None = None
    """None for a motion without known torques."""
    licence: str = ""
    simulated: bool = False
    """Whether an engine's ground carried it."""

    @property
    def seconds(self) -> float:
        return (len(self.qpos) - 1) / FPS


def from_clip(clip: Clip, name: str, group: str = "", licence: str = "") -> Motion:
    """A captured or optimised clip; the latter has torques where it has PD targets.

    Raises ValueError for a clip that is shorter than a frame at ``FPS``.
    """
    drive = None
    if clip.ctrl is not None and clip.num_frames > 1:
        strength: Strength = "human" if clip.meta.get("strength") == "human" else "paper"
        body = _body(clip.body, strength)
        drive = _drive(body, clip.qpos, clip.qvel, clip.ctrl[:-1], 1.0 / clip.fps)
    shown = clip if clip.fps == FPS else clip.resample(FPS)
    meta = clip.meta
    group = group or str(meta.get("archive") or meta.get("problem") or "files")
    licence = licence or str(meta.get("licence") or "unknown")
    return Motion(name, group, clip.body, shown.qpos, drive, licence, simulated=drive is not None)


def from_library(library: Library) -> list[Motion]:
    """The clips of a library, by their names."""
    return [
        Motion(o.name, o.archive, library.body, library.qpos(c), None, o.licence)
        for c, o in enumerate(library.origins)
    ]


def captured(origin: Origin) -> bool:
    """Whether a clip of a library shows a person, not the result of an optimisation."""
    return origin.archive not in CAPTURED_NOT


def from_recording(recording: Recording, name: str = "") -> list[Motion]:
    """The motion of each agent of an episode.

    Torques are worked out from the actions, so there are none for a task that turns actions into
    PD targets in its own way. Raises ValueError for an episode of less than two steps.
    """
    if len(recording.qpos) < 2:
        raise ValueError("an episode of one step is no motion: there is nothing to measure")
    scene = recording.scene
    body, rate = scene.body, 1.0 / recording.dt
    plain = get_task(recording.task).targets is None
    motions = []
    for agent in range(scene.num_agents):
        qpos = recording.qpos[:, scene.agent_qpos(agent)].astype(float)
        qvel = recording.qvel[:, scene.agent_qvel(agent)].astype(float)
        drive = None
        if plain:
            action = np.clip(recording.action[1:, agent].astype(float), -1.0, 1.0)
            targets = scene.action_offset() + action * body.action_scale()
            drive = _drive(body, qpos, qvel, targets, recording.dt)
        if rate != FPS:
            speeds = finite_difference_qvel(body, qpos, rate)
            qpos = Clip(fps=rate, body=body.name, qpos=qpos, qvel=speeds).resample(FPS).qpos
        label = name or f"{recording.task} seed {recording.seed} world {recording.world}"
        label += f" agent {agent}" if scene.num_agents > 1 else ""
        motions.append(Motion(label, recording.task, body.name, qpos, drive, simulated=True))
    return motions


def read_motions(source: str | Path) -> list[Motion]:
    """The motions of a file or folder: recordings of episodes, clips, or a clip library.

    Raises ValueError, one sentence, for anything else.
    """
    path = Path(source)
    if path.is_file():
        problems = []
        for read in (_recording, _clip, _library):
            try:
                return read(path)
            except ValueError as error:
                problems.append(str(error))
        raise ValueError(
            f"{path} is no recording, no clip and no clip library ({problems[0]}; {problems[1]})"
        )
    if not path.is_dir():
        raise ValueError(f"there is nothing at {path}")
    files = sorted(p for p in path.rglob("*.npz") if not p.name.startswith("."))
    if not files:
        raise ValueError(f"{path} holds no recording and no clip (.npz)")
    return [motion for file in files for motion in read_motions(file)]


@dataclass(frozen=True)
class Seen:
    """What training used, by a policy's card."""

    clips: frozenset[str]
    """Names of clip files without folder and suffix."""
    archives: frozenset[str]
    """Archives of which also the held-out clips were used."""


def seen_in_training(card: dict[str, Any]) -> Seen:
    """Clips and archives that a policy's card, or that of a model inside it, says it saw.

    A tracker's library is told by its archives: of those training leaves out the held-out clips,
    unless the card's split says otherwise. Raises ValueError where the card does not say which
    clips a style was learned from.
    """
    clips: set[str] = set()
    archives: set[str] = set()
    for part in _parts(card):
        config = part.get("config")
        config = config if isinstance(config, dict) else {}
        library = part.get("library")
        options = config.get("options")
        split = options.get("split", "train") if isinstance(options, dict) else "train"
        if isinstance(library, dict) and split != "train":
            archives |= set(library.get("archives", ()))
        for file in config.get("clips") or ():
            name = Path(str(file)).name
            if not name.endswith(".npz") and part.get("algo", "ppo") != "ppo":
                raise ValueError(
                    f"the policy learned from the clips of a folder '{name}', and its card does "
                    "not say which: its likeness cannot be measured against clips that it may have "
                    "seen"
                )
            clips.add(name.removesuffix(".npz"))
    return Seen(frozenset(clips), frozenset(archives))


def _parts(card: dict[str, Any]) -> Iterable[dict[str, Any]]:
    """A card and the cards within it (a prior's, a tracker's)."""
    yield card
    for name, value in card.items():
        if isinstance(value, dict) and name not in ("config", "library"):
            yield from _parts(value)


def short_name(name: str) -> str:
    """A clip's name without its folders: that by which cards name clips."""
    return name.split("/")[-1].removesuffix(".npz")


def _recording(path: Path) -> list[Motion]:
    return from_recording(Recording.load(path), path.stem)


def _clip(path: Path) -> list[Motion]:
    return [from_clip(Clip.load(path), path.stem)]


def _library(path: Path) -> list[Motion]:
    return from_library(load_library([path]))


@cache
def _body(name: str, strength: Strength) -> Body:
    return load_body(name, strength=strength)


def moving_dofs(body: Body) -> np.ndarray:
    """Indices of the dofs that are no fingers'."""
    return np.array([i for i, dof in enumerate(body.dofs) if not is_finger(dof.link)])


def _drive(body: Body, qpos: np.ndarray, qvel: np.ndarray, targets: np.ndarray, dt: float) -> Drive:
    """Of frames (T, ...) and the targets (T - 1, n) held between them."""
    dofs = moving_dofs(body)
    kp, kd, effort = (body.array(f)[dofs] for f in ("kp", "kd", "effort"))
    angle, speed = qpos[:, 7:][:, dofs], qvel[:, 6:][:, dofs]
    both_angle, both_speed = (np.stack((x[:-1], x[1:]), 1) for x in (angle, speed))
    torque = joint_torque((kp, kd, effort), targets[:, None, dofs], both_angle, both_speed)
    return Drive(torque, both_speed, dt)


def joint_torque(gains: tuple[Any, Any, Any], target: Any, angle: Any, speed: Any) -> Any:
    """N m of joints: the servo within its limits, less the passive damping. Of arrays or tensors;
    ``gains`` are kp, kd and effort."""
    kp, kd, effort = gains
    return (kp * (target - angle)).clip(-effort, effort) - kd * speed
