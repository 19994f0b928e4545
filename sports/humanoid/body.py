"""The humanoid as one table: links, shapes, joints, gains, torque limits and equipment.

Everything an engine needs to build the athlete is in a :class:`Body`; the MJCF writer
(`mjcf.py`) and the Drake writer (`drake_plant.py`) read the same rows and nothing else.

Frames: x forward, y left, z up. At the zero pose the athlete stands in a T-pose facing +x.
Every link but the root hangs on three hinges at its origin, in the order x, y, z, so that
``R_parent_link = Rx(q0) Ry(q1) Rz(q2)`` (intrinsic X-Y-Z). Units: m, kg, s, rad, N m.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from typing import Literal

import numpy as np

Strength = Literal["paper", "human"]
Limits = Literal["paper", "anatomical"]

AXES = ("x", "y", "z")
ARMATURE = 0.02
"""Rotor inertia added to every joint (kg m^2); with it the PD is stable at 1/60 s."""
PAPER_TORQUE = 500.0
"""Stiffness-servo limit of the SMPLOlympics paper on every dof (N m)."""
GRIP_ERROR = 0.35
"""At strength ``human`` a servo saturates at this joint error (rad): kp = torque / GRIP_ERROR."""


@dataclass(frozen=True)
class Shape:
    """One rigid convex shape fixed to a link or to a scene object.

    ``kind`` and ``size`` (m), in the frame of the owner:
      * ``box``: ``center``, half-extents ``size`` (3)
      * ``sphere``: ``center``, radius ``size[0]``
      * ``capsule`` and ``cylinder``: from ``center`` to ``end``, radius ``size[0]``
    """

    kind: Literal["box", "sphere", "capsule", "cylinder"]
    center: tuple[float, float, float]
    size: tuple[float, ...]
    mass: float
    end: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if (self.end is not None) != (self.kind in ("capsule", "cylinder")):
            raise ValueError(f"a {self.kind} shape {'lacks' if self.end is None else 'has'} an end")
        if len(self.size) != (3 if self.kind == "box" else 1) or min(self.size) <= 0:
            raise ValueError(f"a {self.kind} shape cannot have size {self.size}")


@dataclass(frozen=True)
class Link:
    """One row of the body table: a link, where it hangs, and what it is made of."""

    name: str
    parent: str | None
    offset: tuple[float, float, float]
    """Origin in the parent's frame (m); for the root (0, 0, 0)."""
    shapes: tuple[Shape, ...]
    kp: float
    kd: float


@dataclass(frozen=True)
class Dof:
    """One actuated hinge."""

    name: str
    link: str
    axis: Literal["x", "y", "z"]
    kp: float
    """Servo stiffness (N m/rad)."""
    kd: float
    """Passive joint damping (N m s/rad). At strength ``human`` it is the slope of the
    torque-speed line: torque / no-load speed."""
    effort: float
    """Limit of the stiffness servo (N m)."""
    lower: float
    upper: float
    armature: float = ARMATURE


@dataclass(frozen=True)
class Body:
    """The athlete: links in depth-first order, three dofs per link but the root.

    ``dofs`` order is the order of ``qpos[7:]``, ``qvel[6:]`` and ``ctrl`` on every engine.
    """

    name: str
    links: tuple[Link, ...]
    dofs: tuple[Dof, ...]
    excluded_pairs: tuple[tuple[str, str], ...]
    """Pairs of links that never collide (parent-child pairs included)."""
    strength: Strength
    limits: Limits
    equipment: tuple[str, ...] = ()

    @property
    def link_names(self) -> tuple[str, ...]:
        return tuple(link.name for link in self.links)

    @property
    def num_links(self) -> int:
        return len(self.links)

    @property
    def num_dofs(self) -> int:
        return len(self.dofs)

    @property
    def mass(self) -> float:
        """Total mass (kg)."""
        return sum(shape.mass for link in self.links for shape in link.shapes)

    def link_index(self, name: str) -> int:
        """Index of a link in ``links``. Raises KeyError naming the link."""
        try:
            return self.link_names.index(name)
        except ValueError:
            raise KeyError(f"body '{self.name}' has no link '{name}'") from None

    def dof_index(self, name: str) -> int:
        """Index of a dof (``"L_Knee_y"``) in ``dofs``. Raises KeyError naming the dof."""
        for i, dof in enumerate(self.dofs):
            if dof.name == name:
                return i
        raise KeyError(f"body '{self.name}' has no dof '{name}'")

    def parents(self) -> np.ndarray:
        """(num_links,) index of each link's parent, -1 for the root."""
        index = {name: i for i, name in enumerate(self.link_names)}
        return np.array([-1 if link.parent is None else index[link.parent] for link in self.links])

    def subtree(self, name: str) -> tuple[str, ...]:
        """A link and all beyond it, as a hand with its fingers. Raises KeyError naming the link."""
        first = self.link_index(name)
        beyond = [name]
        for link in self.links[first + 1 :]:
            if link.parent not in beyond:
                break
            beyond.append(link.name)
        return tuple(beyond)

    def array(self, field: str) -> np.ndarray:
        """(num_dofs,) of a :class:`Dof` field: kp, kd, effort, lower, upper, armature."""
        return np.array([getattr(dof, field) for dof in self.dofs], dtype=float)

    def action_scale(self) -> np.ndarray:
        """(num_dofs,) radians per unit action: pi, knee flexion 5 (sports.md, Common)."""
        return np.array(
            [5.0 if d.link.endswith("Knee") and d.axis == "y" else math.pi for d in self.dofs]
        )

    def standing_height(self, clearance: float = 0.005) -> float:
        """Root z (m) at which the zero pose has its lowest point ``clearance`` above ground."""
        origin = self.zero_pose_origins()
        lowest = min(
            float(point[2] - radius + origin[i, 2])
            for i, link in enumerate(self.links)
            for shape in link.shapes
            for point, radius in support_points(shape)
        )
        return clearance - lowest

    def zero_pose_origins(self) -> np.ndarray:
        """(num_links, 3) link origins relative to the root at the zero pose (m)."""
        origins = np.zeros((self.num_links, 3))
        for i, parent in enumerate(self.parents()):
            if parent >= 0:
                origins[i] = origins[parent] + self.links[i].offset
        return origins


def support_points(shape: Shape) -> list[tuple[np.ndarray, float]]:
    """Points and radii (owner frame, m) whose swept balls span a shape.

    Box: its 8 corners with radius 0; capsule: its 2 ends; sphere: its centre; cylinder: 8
    points on each rim with radius 0. They are the only points that can touch a plane first.
    """
    center = np.asarray(shape.center, dtype=float)
    if shape.kind == "sphere":
        return [(center, shape.size[0])]
    if shape.kind == "box":
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        return [(center + corner * np.asarray(shape.size), 0.0) for corner in corners]
    end = np.asarray(shape.end, dtype=float)
    if shape.kind == "capsule":
        return [(center, shape.size[0]), (end, shape.size[0])]
    axis = (end - center) / np.linalg.norm(end - center)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    rim = [math.cos(a) * side + math.sin(a) * other for a in np.arange(8) * math.pi / 4]
    return [(base + shape.size[0] * r, 0.0) for base in (center, end) for r in rim]


def _read(name: str) -> list[dict[str, str]]:
    text = resources.files("sports.humanoid").joinpath("data", name).read_text()
    return list(csv.DictReader(text.splitlines()))


def _shape(row: dict[str, str]) -> Shape:
    g = [float(row[f"g{i}"]) if row[f"g{i}"] else 0.0 for i in range(6)]
    mass = float(row["mass"])
    center, rest = (g[0], g[1], g[2]), (g[3], g[4], g[5])
    match row["geom"]:
        case "box":
            return Shape("box", center, rest, mass)
        case "sphere":
            return Shape("sphere", center, (float(row["radius"]),), mass)
        case "capsule":
            return Shape("capsule", center, (float(row["radius"]),), mass, end=rest)
        case "cylinder":
            return Shape("cylinder", center, (float(row["radius"]),), mass, end=rest)
        case other:
            raise ValueError(f"body table: unknown geom '{other}'")


FINGERS = ("Index", "Middle", "Pinky", "Ring", "Thumb")


def is_finger(link: str) -> bool:
    """Whether a link is a part of a finger. Fingers meet objects and nothing else (the palms meet
    bodies and ground): a third of a flailing athlete's contacts were those of its own fingers."""
    return link.removeprefix("L_").removeprefix("R_").startswith(FINGERS)


def strength_group(link: str) -> str:
    """Row of the human strength table for a link: side dropped, all fingers together."""
    return "Finger" if is_finger(link) else link.removeprefix("L_").removeprefix("R_")


@cache
def _human_strength() -> dict[tuple[str, str], tuple[float, float]]:
    return {
        (r["link"], r["axis"]): (float(r["torque_nm"]), float(r["no_load_speed_rad_s"]))
        for r in _read("strength_human.csv")
    }


@cache
def _anatomical() -> dict[str, dict[str, tuple[float, float]]]:
    return {
        r["link"]: {
            a: (
                math.radians(float(r[f"{a}_lower_deg"])),
                math.radians(float(r[f"{a}_upper_deg"])),
            )
            for a in AXES
        }
        for r in _read("limits_anatomical.csv")
    }


def _paper_range(link: str) -> float:
    wide = link.endswith(("Shoulder", "Elbow"))
    return math.radians(720.0 if wide else 180.0)


def make_dofs(links: Iterable[Link], strength: Strength, limits: Limits) -> tuple[Dof, ...]:
    """Three dofs per link but the root, with gains, efforts and ranges.

    Strength ``human``: effort from ``strength_human.csv``; kd = effort / no-load speed, which
    makes effort - kd * speed the torque-speed line (zero at the no-load speed, above effort
    when lengthening); kp = min(table kp, effort / 0.35 rad).
    """
    dofs = []
    for link in links:
        if link.parent is None:
            continue
        for axis in AXES:
            kp, kd, effort = link.kp, link.kd, PAPER_TORQUE
            if strength == "human":
                effort, speed = _human_strength()[strength_group(link.name), axis]
                kp, kd = min(kp, effort / GRIP_ERROR), effort / speed
            span = _paper_range(link.name)
            lower, upper = -span, span
            if limits == "anatomical":
                lower, upper = _anatomical().get(link.name, {}).get(axis, (lower, upper))
            dofs.append(Dof(f"{link.name}_{axis}", link.name, axis, kp, kd, effort, lower, upper))
    return tuple(dofs)


def excluded_pairs(links: Iterable[Link]) -> tuple[tuple[str, str], ...]:
    """Link pairs without self-collision: parent-child, the table's, and a hand's own parts."""
    links = list(links)
    names = {link.name for link in links}
    pairs = {tuple(sorted((link.name, link.parent))) for link in links if link.parent is not None}
    for row in _read("self_collision.csv"):
        if row["link_a"] in names and row["link_b"] in names:
            pairs.add(tuple(sorted((row["link_a"], row["link_b"]))))
    for side in "LR":
        fingers = [n for n in names if n.startswith(tuple(f"{side}_{f}" for f in FINGERS))]
        if fingers:
            hand = sorted([*fingers, f"{side}_Wrist"])
            pairs.update((a, b) for i, a in enumerate(hand) for b in hand[i + 1 :])
    return tuple(sorted(pairs))  # type: ignore[arg-type]


def equipment_names() -> tuple[str, ...]:
    """Names accepted by ``load_body(equipment=...)``."""
    return tuple(dict.fromkeys(row["equipment"] for row in _read("equipment.csv")))


def with_equipment(links: Iterable[Link], equipment: Iterable[str]) -> tuple[Link, ...]:
    """Links with rigid equipment added to, or in place of, the shapes of a hand.

    Raises ValueError for an unknown name or for a body that lacks the link.
    """
    by_name = {link.name: link for link in links}
    for name in equipment:
        rows = [row for row in _read("equipment.csv") if row["equipment"] == name]
        if not rows:
            known = ", ".join(equipment_names())
            raise ValueError(f"unknown equipment '{name}'; known: {known}")
        cleared = set()
        for row in rows:
            if row["link"] not in by_name:
                raise ValueError(f"equipment '{name}' needs a link '{row['link']}' on the body")
            link = by_name[row["link"]]
            keep = link.shapes
            if row["mode"] == "replace" and link.name not in cleared:
                keep = ()
                cleared.add(link.name)
            by_name[link.name] = replace(link, shapes=(*keep, _shape(row)))
    return tuple(by_name.values())


def make_body(
    name: str,
    links: Iterable[Link],
    *,
    strength: Strength = "paper",
    limits: Limits = "paper",
    equipment: Iterable[str] = (),
) -> Body:
    """A Body from bare links: adds equipment, dofs and collision exclusions.

    Raises ValueError for an unknown strength, limits or equipment name.
    """
    if strength not in ("paper", "human"):
        raise ValueError(f"strength must be 'paper' or 'human', not '{strength}'")
    if limits not in ("paper", "anatomical"):
        raise ValueError(f"limits must be 'paper' or 'anatomical', not '{limits}'")
    equipment = tuple(equipment)
    links = with_equipment(links, equipment)
    return Body(
        name=name,
        links=links,
        dofs=make_dofs(links, strength, limits),
        excluded_pairs=excluded_pairs(links),
        strength=strength,
        limits=limits,
        equipment=equipment,
    )


def table_links(name: str) -> tuple[Link, ...]:
    """Links of a packaged table, ``smpl`` or ``smplx``. Raises ValueError for another name."""
    if name not in ("smpl", "smplx"):
        raise ValueError(f"unknown body '{name}'; known: smpl, smplx")
    return tuple(
        Link(
            name=row["body"],
            parent=row["parent"] or None,
            offset=(float(row["offset_x"]), float(row["offset_y"]), float(row["offset_z"])),
            shapes=(_shape(row),),
            kp=float(row["kp"] or 0),
            kd=float(row["kd"] or 0),
        )
        for row in _read(f"body_{name}.csv")
    )


def load_body(
    name: str = "smpl",
    *,
    strength: Strength = "paper",
    limits: Limits = "paper",
    equipment: Iterable[str] = (),
) -> Body:
    """The packaged SMPL (24 links, 69 dofs) or SMPL-X (52 links, 153 dofs) athlete.

    Source: body tables of the SMPLOlympics humanoids (mean shape). Raises ValueError for an
    unknown body, strength, limits or equipment.
    """
    return make_body(name, table_links(name), strength=strength, limits=limits, equipment=equipment)
