"""A body of one's own shape: from an SMPL or SMPL-X model file to a :class:`Body`.

The model files are licensed and not part of this project; this module reads the one that a
user has. It gives the same links, gains and structure as the packaged tables, with lengths,
shapes and masses of the body that the file describes.

Source of the format: Loper et al. 2015 (SMPL) and Pavlakos et al. 2019 (SMPL-X): vertices are
``v_template + shapedirs . betas`` and joints ``J_regressor . vertices``, in metres, y up, z
forward, x left. Ours is x forward, y left, z up: ``v_ours = AXES_FROM_SMPL v``.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sports.humanoid import smpl_pickle
from sports.humanoid.body import Body, Limits, Link, Shape, Strength, make_body, table_links

AXES_FROM_SMPL = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""(3, 3) rotation from the axes of an SMPL file to ours."""

_BODY_JOINTS = (
    *("Pelvis", "L_Hip", "R_Hip", "Torso", "L_Knee", "R_Knee", "Spine", "L_Ankle", "R_Ankle"),
    *("Chest", "L_Toe", "R_Toe", "Neck", "L_Thorax", "R_Thorax", "Head", "L_Shoulder"),
    *("R_Shoulder", "L_Elbow", "R_Elbow", "L_Wrist", "R_Wrist"),
)
_FINGER_JOINTS = tuple(
    f"{side}_{finger}{i}"
    for side in "LR"
    for finger in ("Index", "Middle", "Pinky", "Ring", "Thumb")
    for i in (1, 2, 3)
)
JOINT_LINKS: dict[str, tuple[str, ...]] = {
    "smpl": (*_BODY_JOINTS, "L_Hand", "R_Hand"),
    "smplx": (*_BODY_JOINTS, "Head", "Head", "Head", *_FINGER_JOINTS),
}
"""Our link for each joint in the file's order: 24 of SMPL, 55 of SMPL-X. Jaw and eyes of SMPL-X
are part of the head."""

_TRUNK = ("Torso", "Spine", "Chest")
_SHORT_SPAN, _LONG_SPAN = (0.45, 0.55), (0.2, 0.8)
"""Ends of a capsule as shares of the bone, as in the packaged tables: trunk, other links."""
_MIN_HALF_EXTENT = 0.004
"""Smallest half-extent and radius of a fitted shape (m)."""
_FIELDS = ("v_template", "shapedirs", "J_regressor", "kintree_table", "weights")


@dataclass(frozen=True)
class SmplModel:
    """What a model file holds, checked, still in the file's axes (m, y up)."""

    family: Literal["smpl", "smplx"]
    v_template: np.ndarray
    """(V, 3) vertices of the mean shape in the T-pose."""
    shapedirs: np.ndarray
    """(V, 3, B) displacement per unit of each shape coefficient."""
    joint_regressor: np.ndarray
    """(J, V) joints as weighted means of vertices."""
    weights: np.ndarray
    """(V, J) skinning weights."""

    @property
    def num_betas(self) -> int:
        return self.shapedirs.shape[2]

    def vertices(self, betas: np.ndarray) -> np.ndarray:
        """(V, 3) vertices of a shape (m, file axes); betas (b,), b <= num_betas."""
        return self.v_template + self.shapedirs[:, :, : len(betas)] @ betas


def from_smpl(
    path: str | Path,
    betas: Sequence[float] | np.ndarray | None = None,
    *,
    strength: Strength = "paper",
    limits: Limits = "paper",
    equipment: Iterable[str] = (),
) -> Body:
    """The athlete of an SMPL (24 joints) or SMPL-X (55 joints, 52 links) model file.

    ``betas``: shape coefficients, as many as wanted up to the file's; none for the mean shape.
    Links, gains and torque limits are those of the packaged table; offsets come from the file's
    joints, boxes and capsules from the skin of each link, masses from the table's densities.

    Raises FileNotFoundError for a missing file and ValueError, in one sentence, for a file that
    is not an SMPL model, is damaged, would run code, or for betas that do not fit.
    """
    model = read_smpl(path)
    shape = _checked_betas(betas, model.num_betas)
    vertices = model.vertices(shape) @ AXES_FROM_SMPL.T
    joints = model.joint_regressor @ vertices
    stature = float(np.ptp(vertices[:, 2]))
    if not 0.5 < stature < 3.0:
        raise ValueError(
            f"the body of '{path}' is {stature:.3g} m tall with these betas: "
            "expected metres, y up, between 0.5 and 3"
        )
    links = fit_links(model.family, vertices, joints, model.weights)
    name = f"{model.family}_{Path(path).stem}"
    return make_body(name, links, strength=strength, limits=limits, equipment=equipment)


def read_smpl(path: str | Path) -> SmplModel:
    """Reads and checks an SMPL or SMPL-X model: npz without object arrays, or a pickle.

    The pickle is read as data: see :mod:`sports.humanoid.smpl_pickle`. Raises as
    :func:`from_smpl` does.
    """
    raw = Path(path).read_bytes()
    try:
        if raw.startswith(b"PK"):
            fields = _npz_fields(raw)
        else:
            fields = _pickle_fields(raw)
    except smpl_pickle.Forbidden as error:
        raise ValueError(f"'{path}' is refused, nothing of it was run: {error}") from None
    except ValueError as error:
        raise ValueError(f"'{path}' is not a readable SMPL model file: {error}") from None
    try:
        return _checked_model(fields)
    except ValueError as error:
        raise ValueError(f"'{path}' is not a usable SMPL model: {error}") from None


def _npz_fields(raw: bytes) -> dict[str, np.ndarray]:
    fields = {}
    try:
        with np.load(io.BytesIO(raw), allow_pickle=False) as file:
            present = set(file.files)
            _require(present)
            for name in _FIELDS:
                try:
                    fields[name] = file[name]
                except ValueError as error:
                    if "allow_pickle" not in str(error):
                        raise
                    raise ValueError(
                        f"its '{name}' is an array of Python objects, which can hide code: "
                        f"save it again as numbers, np.savez(file, {name}=np.asarray(..., float))"
                    ) from None
    except ValueError:
        raise
    except zipfile.BadZipFile:
        raise ValueError("truncated or damaged npz") from None
    except Exception as error:  # zlib, struct, end of file: all mean a damaged archive
        raise ValueError(f"truncated or damaged npz ({type(error).__name__})") from None
    return fields


def _pickle_fields(raw: bytes) -> dict[str, np.ndarray]:
    data = smpl_pickle.load_data(raw)
    if not isinstance(data, dict):
        raise ValueError(f"it holds a {type(data).__name__}, not a dictionary of arrays")
    _require({key for key in data if isinstance(key, str)})
    fields = {}
    for name in _FIELDS:
        try:
            fields[name] = smpl_pickle.as_array(data[name])
        except smpl_pickle.Forbidden:
            raise
        except Exception as error:
            raise ValueError(f"its '{name}' cannot be read: {error}") from None
    return fields


def _require(present: Iterable[Any]) -> None:
    missing = [name for name in _FIELDS if name not in set(present)]
    if missing:
        raise ValueError(f"it lacks {', '.join(missing)}")


def _checked_model(fields: dict[str, np.ndarray]) -> SmplModel:
    for name, array in fields.items():
        if array.dtype.kind not in "biuf":
            raise ValueError(f"its '{name}' holds {array.dtype}, not numbers")
        if not np.all(np.isfinite(array)):
            raise ValueError(f"its '{name}' holds NaN or infinity")
    tree = fields["kintree_table"].astype(np.int64)
    if tree.ndim != 2 or tree.shape[0] != 2:
        raise ValueError(f"its 'kintree_table' has shape {tree.shape}, expected (2, joints)")
    num_joints = tree.shape[1]
    family = {24: "smpl", 55: "smplx"}.get(num_joints)
    if family is None:
        raise ValueError(f"it has {num_joints} joints, expected 24 (SMPL) or 55 (SMPL-X)")
    _check_tree(family, tree)
    template, dirs = fields["v_template"].astype(float), fields["shapedirs"].astype(float)
    count = len(template) if template.ndim else 0
    for name, array, shape in (
        ("v_template", template, (count, 3)),
        ("shapedirs", dirs, (count, 3, dirs.shape[-1] if dirs.ndim == 3 else 0)),
        ("J_regressor", fields["J_regressor"], (num_joints, count)),
        ("weights", fields["weights"], (count, num_joints)),
    ):
        if array.shape != shape:
            raise ValueError(f"its '{name}' has shape {array.shape}, expected {shape}")
    if family == "smplx":
        # The last directions of SMPL-X are facial expressions: 100 of 400, or all after ten.
        dirs = dirs[:, :, : 300 if dirs.shape[2] >= 400 else 10]
    regressor = fields["J_regressor"].astype(float)
    if np.abs(regressor.sum(axis=1) - 1.0).max() > 0.01:
        raise ValueError("its 'J_regressor' is not a set of means: a row does not sum to 1")
    return SmplModel(family, template, dirs, regressor, fields["weights"].astype(float))  # type: ignore[arg-type]


def _check_tree(family: str, tree: np.ndarray) -> None:
    """Raises ValueError where a joint does not hang where SMPL's does."""
    names = JOINT_LINKS[family]
    parent_of = {link.name: link.parent for link in table_links(family)}
    position = {int(joint): i for i, joint in enumerate(tree[1])}
    for joint in range(1, len(names)):
        column = position.get(joint)
        parent = -1 if column is None else int(tree[0, column])
        known = 0 <= parent < len(names)
        head_part = names[joint] == "Head" and joint != names.index("Head")
        expected = "Head" if head_part else parent_of[names[joint]]
        if not known or names[parent] != expected:
            raise ValueError(f"its joint {joint} ({names[joint]}) does not hang on {expected}")


def _checked_betas(betas: Sequence[float] | np.ndarray | None, available: int) -> np.ndarray:
    shape = np.zeros(0) if betas is None else np.asarray(betas, dtype=float)
    if shape.ndim != 1:
        raise ValueError(f"betas have shape {shape.shape}, expected a list of numbers")
    if len(shape) > available:
        raise ValueError(f"{len(shape)} betas given, the model has {available}")
    if not np.all(np.isfinite(shape)):
        raise ValueError("betas hold NaN or infinity")
    return shape


def fit_links(
    family: Literal["smpl", "smplx"],
    vertices: np.ndarray,
    joints: np.ndarray,
    weights: np.ndarray,
) -> tuple[Link, ...]:
    """Links in the packaged table's order, with shapes fitted to the skin.

    ``vertices`` (V, 3) and ``joints`` (J, 3) in our axes (m), ``weights`` (V, J). A vertex is
    skin of the link with its largest weight. Links that are boxes in the table get the bounding
    box of their skin; the others a capsule along the bone (20-80 % of it, trunk 45-55 %) with
    the volume of the skin's convex hull. Mass = volume x the density of the table's link.

    Raises ValueError for a link without enough skin to have a volume.
    """
    names = JOINT_LINKS[family]
    table = table_links(family)
    owner = np.array([names[j] for j in weights.argmax(axis=1)])
    origin = {name: joints[names.index(name)] for name in dict.fromkeys(names)}
    links = []
    for row in table:
        skin = vertices[owner == row.name] - origin[row.name]
        if len(skin) < 4:
            raise ValueError(f"link '{row.name}' has {len(skin)} vertices of skin: at least 4")
        offset = np.zeros(3) if row.parent is None else origin[row.name] - origin[row.parent]
        children = [origin[c.name] - origin[row.name] for c in table if c.parent == row.name]
        kind = row.shapes[0].kind
        if kind == "box":
            shape = _box(skin)
        else:
            bone = np.mean(children, axis=0) if children else _tip(offset, skin)
            shape = _capsule(row.name, bone, skin)
        mass = row.shapes[0].mass / volume(row.shapes[0]) * volume(shape)
        fitted = Shape(shape.kind, shape.center, shape.size, mass, shape.end)
        links.append(Link(row.name, row.parent, _triple(offset), (fitted,), row.kp, row.kd))
    return tuple(links)


def volume(shape: Shape) -> float:
    """Volume of a shape (m^3)."""
    if shape.kind == "box":
        return 8.0 * math.prod(shape.size)
    radius = shape.size[0]
    ball = 4.0 / 3.0 * math.pi * radius**3
    if shape.kind == "sphere":
        return ball
    length = float(np.linalg.norm(np.subtract(shape.end, shape.center)))  # type: ignore[arg-type]
    return math.pi * radius**2 * length + (ball if shape.kind == "capsule" else 0.0)


def _box(skin: np.ndarray) -> Shape:
    low, high = skin.min(axis=0), skin.max(axis=0)
    half = np.maximum((high - low) / 2.0, _MIN_HALF_EXTENT)
    return Shape("box", _triple((low + high) / 2.0), _triple(half), 0.0)


def _capsule(name: str, bone: np.ndarray, skin: np.ndarray) -> Shape:
    start, end = (share * bone for share in (_SHORT_SPAN if name in _TRUNK else _LONG_SPAN))
    length = float(np.linalg.norm(end - start))
    if length < 1e-6:
        raise ValueError(f"link '{name}' has a bone of no length")
    radius = _radius(length, _hull_volume(name, skin))
    return Shape("capsule", _triple(start), (max(radius, _MIN_HALF_EXTENT),), 0.0, _triple(end))


def _radius(length: float, enclosed: float) -> float:
    """The radius r with pi r^2 length + 4/3 pi r^3 = enclosed: its one positive root."""
    roots = np.roots([4.0 / 3.0 * math.pi, math.pi * length, 0.0, -enclosed])
    return float(max(root.real for root in roots if abs(root.imag) < 1e-9))


def _hull_volume(name: str, skin: np.ndarray) -> float:
    from scipy.spatial import ConvexHull, QhullError  # not needed on a training host

    try:
        return float(ConvexHull(skin).volume)
    except QhullError:
        raise ValueError(f"the skin of link '{name}' is flat: it has no volume") from None


def _tip(offset: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """End of a link without children: straight on from its parent, as far as its skin goes."""
    direction = offset / max(float(np.linalg.norm(offset)), 1e-9)
    return direction * float((skin @ direction).max())


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
