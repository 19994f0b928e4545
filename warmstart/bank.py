"""The clip library: frames from which training starts, and the demonstrations that are shipped.

Clips are in the task's world already (a demonstration crosses the bar at x = 20), so a frame is a
start as it is. Frames that would start inside the ground are left out.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sports.env import Starts
from sports.humanoid.body import load_body
from sports.starts import ELAPSED
from warmstart.clip import Clip
from warmstart.outcome import lowest
from warmstart.problems import get_problem

DATA = "data"
CONTEXT = {"high_jump": ("bar_height",), "hurdling": ("hurdle_height",)}
"""Labels of a clip that its task understands as context of a start, by task."""

START = "start"
"""Event of a clip: when the episode began that it is of, by the task's own start."""


@dataclass(frozen=True)
class Window:
    """Which part of each clip serves as starts (s). Raises ValueError when it is empty."""

    start: float = 0.0
    """From this time after the clip's first frame."""
    end: float | None = None
    """Until this time; None for the end."""
    before: str | None = "landing"
    """Until an event of the clip's metadata: ``takeoff`` keeps the approach, ``landing`` the
    flight too; None, and a clip without the event, keep all. After the landing a demonstration
    only falls: nothing to learn from, and for a task an outcome that somebody else earned. So is
    the flight of what was thrown: unless None, a clip with objects ends at its ``release``."""

    def __post_init__(self) -> None:
        if self.start < 0 or (self.end is not None and self.end < self.start):
            raise ValueError(f"a window from {self.start} s to {self.end} s is empty")

    def rows(self, clip: Clip) -> np.ndarray:
        """Indices of the clip's frames inside the window."""
        end = clip.duration if self.end is None else self.end
        if self.before is not None:
            ends = [self.before, *(["release"] if clip.num_objects else [])]
            end = min(end, *(float(clip.meta.get("events", {}).get(e, end)) for e in ends))
        inside = (clip.times >= self.start - 1e-9) & (clip.times <= end + 1e-9)
        return np.flatnonzero(inside)


class ClipBank:
    """Clips of one body, as starts for reference-state initialisation.

    Raises ValueError when there is no clip, or when their bodies differ.
    """

    def __init__(self, clips: Iterable[Clip]) -> None:
        self.clips = tuple(clips)
        if not self.clips:
            raise ValueError("a clip bank needs at least one clip")
        bodies = sorted({clip.body for clip in self.clips})
        if len(bodies) > 1:
            raise ValueError(f"the clips of a bank must be of one body, not of {bodies}")
        self.body = bodies[0]

    @property
    def seconds(self) -> float:
        """Total duration of the clips."""
        return sum(clip.duration for clip in self.clips)

    def starts(
        self,
        window: Window | None = None,
        probability: float = 0.5,
        context: Iterable[str] = (),
        floor: float = 0.02,
    ) -> Starts:
        """Frames of all clips as start states, each with the labels of its clip.

        ``context`` names labels besides those of the clips' tasks; a clip without one has NaN
        there, which a task reads as "draw your own". Where a clip has an event ``start``, its
        frames carry how long ago that was (``ELAPSED``). Frames that reach more than ``floor`` (m)
        below the ground are left out; a loaded foot sinks up to 1 cm at a take-off. Raises
        ValueError when no frame is left, a label is not a number or the clips differ in objects.
        """
        window = window or Window()
        body = load_body(self.body)
        names = list(context)
        for clip in self.clips:
            own = CONTEXT.get(clip.meta.get("problem", ""), ())
            own += (ELAPSED,) if START in clip.meta.get("events", {}) else ()
            names += [n for n in own if n not in names]
        qpos, qvel, labels, things = [], [], [], []
        counts = {clip.num_objects for clip in self.clips} - {0}
        if len(counts) > 1:
            raise ValueError(f"the clips of a bank must have the same objects, not {counts}")
        count = max(counts, default=0)
        for clip in self.clips:
            rows = window.rows(clip)
            rows = rows[lowest(body, clip.qpos[rows]) >= -floor] if rows.size else rows
            qpos.append(clip.qpos[rows])
            qvel.append(clip.qvel[rows])
            shared = np.tile([label(clip, name) for name in names], (len(rows), 1))
            if ELAPSED in names:
                shared[:, names.index(ELAPSED)] = elapsed(clip)[rows]
            labels.append(shared)
            if clip.object_qpos is not None and clip.object_qvel is not None:
                things.append(np.hstack([clip.object_qpos[rows], clip.object_qvel[rows]]))
            else:
                things.append(np.full((len(rows), 13 * count), np.nan))
        frames = np.concatenate(qpos)
        if not len(frames):
            raise ValueError(
                f"no frame of {len(self.clips)} clips lies in the window and above the ground"
            )

        def tensor(rows: np.ndarray) -> torch.Tensor:
            return torch.tensor(rows, dtype=torch.float32)

        values, objects = np.concatenate(labels), np.concatenate(things)
        return Starts(
            qpos=tensor(frames),
            qvel=tensor(np.concatenate(qvel)),
            context={name: tensor(values[:, i]) for i, name in enumerate(names)},
            probability=probability,
            object_qpos=tensor(objects[:, : 7 * count]) if count else None,
            object_qvel=tensor(objects[:, 7 * count :]) if count else None,
        )


def elapsed(clip: Clip) -> np.ndarray:
    """(T,) seconds since the beginning of the episode that the clip is of, NaN without one."""
    begun = float(clip.meta.get("events", {}).get(START, np.nan))
    return clip.times - begun


def label(clip: Clip, name: str) -> float:
    """The achieved value of a label, else the asked one, else NaN. Raises ValueError if it is not
    a number."""
    for key in ("achieved", "asked"):
        values = clip.meta.get(key)
        if isinstance(values, dict) and values.get(name) is not None:
            value = values[name]
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ValueError(f"the label {name} of a clip is {value!r}, not a number")
            return float(value)
    return float("nan")


def data_folder(*parts: str) -> Path:
    """Where the shipped demonstrations lie, or a folder in there."""
    return Path(str(resources.files("warmstart").joinpath(DATA, *parts)))


def demonstration_files(problem: str | None = None) -> list[Path]:
    """The shipped npz files, of one problem or of all, by name."""
    files = sorted(data_folder().glob("*.npz"))
    return [f for f in files if problem is None or f.name.startswith(f"{problem}_")]


def thrown_files(task: str) -> list[Path]:
    """The shipped throws of a task that were searched in MuJoCo and have no plan, one for each
    strength: ``warmstart/data/throws/TASK_STRENGTH.npz``."""
    return sorted(data_folder("throws").glob(f"{task}_*.npz"))


def approach_files(task: str) -> list[Path]:
    """The shipped episodes of a task that lead from its own start to a certified demonstration and
    through it, as MuJoCo played them: ``warmstart/data/approaches/NAME.npz``."""
    return sorted(data_folder("approaches").glob(f"{task}_*.npz"))


def load_demonstrations(problem: str, strength: str | None = None) -> list[Clip]:
    """Shipped demonstrations of a problem, of certified plans, played in MuJoCo and labelled with
    what they achieved; ``meta["certified"]`` says whether the motion itself is certified, which a
    refined free throw need not be. ``strength`` keeps those of one strength.

    Raises ValueError for an unknown problem, or when none is shipped.
    """
    get_problem(problem)
    clips = [Clip.load(path) for path in demonstration_files(problem)]
    clips = [c for c in clips if strength is None or c.meta.get("strength") == strength]
    if not clips:
        at = f" at strength '{strength}'" if strength else ""
        raise ValueError(f"no demonstration of '{problem}'{at} is shipped; run `solve {problem}`")
    return clips


def list_demonstrations() -> list[dict[str, Any]]:
    """One row per shipped demonstration, for ``list``: name, problem, asked, achieved, strength,
    seconds, ``motion`` (how the clip was made of the plan), ``plan_certified`` (its certificate
    passed), ``certified`` (that, and the clip itself is labelled so) and ``throw`` (what the
    certificate says of a refined free throw, else None)."""
    rows = []
    for path in demonstration_files():
        clip = Clip.load(path)
        certificate = path.with_suffix(".json")
        facts = json.loads(certificate.read_text()) if certificate.is_file() else {}
        passed = facts.get("passed") is True
        source = str(clip.meta.get("source")).removeprefix("trajectory optimisation, ")
        rows.append(
            {
                "name": path.stem,
                "problem": clip.meta.get("problem"),
                "asked": clip.meta.get("asked"),
                "achieved": clip.meta.get("achieved"),
                "strength": clip.meta.get("strength"),
                "seconds": round(clip.duration, 3),
                "motion": clip.meta.get("motion", source),
                "plan_certified": passed,
                "certified": passed and clip.meta.get("certified") is True,
                "throw": facts.get("clip"),
            }
        )
    return rows
