"""SMPL parameters in npz files: AMASS and what video reconstruction tools give.

Layouts, by the entries that a file has (T frames; others are ignored; no pickle is read):

* **AMASS** (Z up): ``poses`` (T, 72) SMPL, (T, 156) SMPL-H or (T, 165) SMPL-X, or ``root_orient``
  (T, 3) with ``pose_body`` (T, 63); ``trans`` (T, 3); ``mocap_framerate`` or ``mocap_frame_rate``.
* **GVHMR** (Y up, 30 frames/s): ``global_orient`` (T, 3), ``body_pose`` (T, 63), ``transl``
  (T, 3): the tool's ``smpl_params_global`` saved with ``np.savez``; ``fps`` may be added.
* **WHAM** (Y up): ``pose_world`` (T, 72), ``trans_world`` (T, 3), ``fps``: one subject of
  the tool's result saved with ``np.savez``.
* **TRAM** (Y up): ``pred_rotmat`` (T, 24, 3, 3) and ``pred_trans`` (T, 1, 3) in the camera,
  ``frame`` (T,), and of its camera file ``world_cam_R`` (F, 3, 3) and ``world_cam_T`` (F, 3):
  ``X_world = R[frame] X_camera + T[frame]``; ``fps``.

Poses are rotation vectors (rad) of the joints in SMPL's order; the first 22 are the same joints in
all three models. Fingers, jaw and eyes are left out. Shape coefficients are not used: without the
licensed model file a body's bones are those of our table (the mean shape).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sports.humanoid.body import load_body
from sports.humanoid.smpl_file import JOINT_LINKS
from warmstart.mocap.capture import FROM_Y_UP, Capture
from warmstart.mocap.kinematics import Chain, exp

BODY_JOINTS = 22
PELVIS = np.array([-0.0018, -0.2233, 0.0282])
"""Pelvis of SMPL's mean shape (m, file axes): a pose turns about it, ``trans`` moves it from there.
Only TRAM needs it, where the camera turns about another point; elsewhere it is a constant shift."""
ENTRIES = (
    *("poses", "trans", "root_orient", "pose_body", "mocap_framerate", "mocap_frame_rate"),
    *("global_orient", "body_pose", "transl", "pose_world", "trans_world", "fps"),
    *("pred_rotmat", "pred_trans", "frame", "world_cam_R", "world_cam_T"),
)


def is_smpl(names: set[str]) -> bool:
    """Whether a file with these entries is one of the layouts."""
    return any(
        wanted <= names
        for wanted in (
            {"poses", "trans"},
            {"root_orient", "pose_body", "trans"},
            {"global_orient", "body_pose", "transl"},
            {"pose_world", "trans_world"},
            {"pred_rotmat", "pred_trans"},
        )
    )


def read_smpl_motion(arrays: Mapping[str, np.ndarray], fps: float | None = None) -> Capture:
    """The motion of a person with the bones of our ``smpl`` table. Raises ValueError."""
    names = set(arrays)
    rate = _rate(arrays, ("mocap_framerate", "mocap_frame_rate", "fps"))
    if {"pred_rotmat", "pred_trans"} <= names:
        tool, up = "TRAM", FROM_Y_UP
        turn, pelvis = _tram(arrays)
    else:
        if {"pose_world", "trans_world"} <= names:
            tool, up = "WHAM", FROM_Y_UP
            pose, trans = arrays["pose_world"], arrays["trans_world"]
        elif {"global_orient", "body_pose", "transl"} <= names:
            tool, up = "GVHMR", FROM_Y_UP
            parts = [_table(arrays, "global_orient", 3), _table(arrays, "body_pose", None)]
            pose, trans = _join(parts), arrays["transl"]
            rate = rate or 30.0
        else:
            tool, up = "AMASS", np.eye(3)
            trans = arrays["trans"]
            if "poses" in names:
                pose = arrays["poses"]
            else:
                pose = _join([_table(arrays, "root_orient", 3), _table(arrays, "pose_body", None)])
        if pose.ndim != 2 or pose.shape[1] < 3 * BODY_JOINTS or pose.shape[1] % 3:
            raise ValueError(
                f"the poses have shape {pose.shape}: expected (frames, 66 or more), 3 a joint"
            )
        if trans.shape != (len(pose), 3):
            raise ValueError(f"the translation has shape {trans.shape}, not ({len(pose)}, 3)")
        _check(pose, "the pose")
        turn = exp(pose[:, : 3 * BODY_JOINTS].reshape(len(pose), BODY_JOINTS, 3))
        hands = pose[:, 66:72].reshape(len(pose), 2, 3) if pose.shape[1] == 72 else None
        tail = np.broadcast_to(np.eye(3), (len(pose), 2, 3, 3)) if hands is None else exp(hands)
        turn = np.concatenate([turn, tail], axis=1)
        pelvis = trans + PELVIS
    rate = fps or rate
    if rate is None:
        raise ValueError(f"a {tool} file without fps: give it with --source-fps")
    return on_our_bones(turn, pelvis, up, rate, {"skeleton": "smpl", "layout": tool})


def on_our_bones(
    turn: np.ndarray, pelvis: np.ndarray, up: np.ndarray, fps: float, meta: dict[str, str]
) -> Capture:
    """A capture from joint rotations (T, 24, 3, 3) in SMPL's order and axes, parent <- joint, and
    the pelvis (T, 3) in a world that ``up`` (3, 3) takes to ours."""
    _check(turn, "the pose")
    _check(pelvis, "the translation")
    chain = Chain(load_body("smpl"))
    local = np.empty((len(turn), len(chain.names), 3, 3))
    for j, link in enumerate(JOINT_LINKS["smpl"]):
        own = FROM_Y_UP @ turn[:, j] @ FROM_Y_UP.T
        local[:, chain.index[link]] = own if j else up @ turn[:, j] @ FROM_Y_UP.T
    frames = chain.frames(pelvis @ up.T, local)
    points = {name: frames.origin[:, i] for i, name in enumerate(chain.names)}
    turns = {name: frames.turn[:, i] for i, name in enumerate(chain.names)}
    return Capture(fps, points, turns, "t_pose", meta)


def _tram(arrays: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Joint rotations and pelvis in the world, from those in the moving camera."""
    turn, trans = arrays["pred_rotmat"], arrays["pred_trans"]
    if turn.ndim != 4 or turn.shape[1:] != (24, 3, 3) or trans.size != 3 * len(turn):
        raise ValueError(f"pred_rotmat has shape {turn.shape}, not (frames, 24, 3, 3) with trans")
    for name in ("frame", "world_cam_R", "world_cam_T"):
        if name not in arrays:
            raise ValueError(f"a TRAM file needs '{name}', the camera's motion in the world")
    camera, place, frame = arrays["world_cam_R"], arrays["world_cam_T"], arrays["frame"]
    if camera.ndim != 3 or camera.shape[1:] != (3, 3) or place.shape != (len(camera), 3):
        raise ValueError(f"world_cam_R has shape {camera.shape}, not (frames, 3, 3) with T")
    if frame.shape != (len(turn),) or not np.isin(frame, np.arange(len(camera))).all():
        raise ValueError("frame does not name a frame of the camera for each pose")
    for name, value in (("pred_rotmat", turn), ("world_cam_R", camera)):
        _check(value, name)
        error = np.abs(value @ np.swapaxes(value, -1, -2) - np.eye(3)).max()
        if error > 1e-2 or (np.linalg.det(value) < 0).any():
            raise ValueError(f"{name} holds matrices that are not rotations")
    rows = frame.astype(int)
    pelvis = (camera[rows] @ (trans.reshape(-1, 3) + PELVIS)[..., None])[..., 0] + place[rows]
    turn = turn.copy()
    turn[:, 0] = camera[rows] @ turn[:, 0]
    return turn, pelvis


def _rate(arrays: Mapping[str, np.ndarray], names: tuple[str, ...]) -> float | None:
    for name in names:
        if name in arrays:
            if arrays[name].size != 1:
                raise ValueError(f"{name} is not one number")
            return float(arrays[name].reshape(()))
    return None


def _table(arrays: Mapping[str, np.ndarray], name: str, width: int | None) -> np.ndarray:
    """An entry as (T, width), of which GVHMR also writes (T, joints, 3)."""
    value = arrays[name]
    value = value.reshape(len(value), -1) if value.ndim else value
    if value.ndim != 2 or (width is not None and value.shape[1] != width):
        raise ValueError(f"{name} has shape {arrays[name].shape}")
    return value


def _join(parts: list[np.ndarray]) -> np.ndarray:
    if len(parts[0]) != len(parts[1]):
        raise ValueError("root and body poses differ in their number of frames")
    return np.concatenate(parts, axis=1)


def _check(value: np.ndarray, what: str) -> None:
    if not np.isfinite(value).all():
        raise ValueError(
            f"{what} is not a number at frame {np.argwhere(~np.isfinite(value))[0, 0]}"
        )
