"""Motions of our own body written as files of every format, by code that shares none with readers.

Rotations go through scipy, kinematics through MuJoCo.
"""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from sports.humanoid import body as body_module
from sports.humanoid.body import Body, load_body
from sports.humanoid.mjcf import body_name, build_model
from warmstart.mocap.skeleton import JointMap

BODY = load_body("smpl")
SMPL_ORDER = (
    *("Pelvis", "L_Hip", "R_Hip", "Torso", "L_Knee", "R_Knee", "Spine", "L_Ankle", "R_Ankle"),
    *("Chest", "L_Toe", "R_Toe", "Neck", "L_Thorax", "R_Thorax", "Head", "L_Shoulder"),
    *("R_Shoulder", "L_Elbow", "R_Elbow", "L_Wrist", "R_Wrist", "L_Hand", "R_Hand"),
)
PELVIS = np.array([-0.0018, -0.2233, 0.0282])  # of SMPL's mean shape: trans is from there
# From y up, z forward, x left to ours.
AXES = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def motion(frames: int = 40, seed: int = 0, size: float = 0.4, body: Body = BODY) -> np.ndarray:
    """(T, 7 + n) qpos: every hinge swings, the root flies and turns; hands and toes at rest."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, frames)[:, None]
    n = body.num_dofs
    qpos = np.zeros((frames, 7 + n))
    qpos[:, :3] = [0.3, -0.2, 1.1] + t * [1.0, 0.5, 0.2]
    turn = Rotation.from_rotvec(t * [0.4, -0.9, 1.3] + [0.1, 0.2, -0.5])
    qpos[:, 3:7] = turn.as_quat(scalar_first=True)
    swing = size * rng.uniform(-1, 1, n) * np.sin(rng.uniform(2, 6, n) * t + rng.uniform(0, 6, n))
    moves = [not d.link.endswith(("Hand", "Toe")) and not is_hand(d.link) for d in body.dofs]
    qpos[:, 7:] = swing * np.array(moves)
    for side, sign in (("L", -1.0), ("R", 1.0)):  # arms lowered: it is no T-pose
        qpos[:, 7 + body.dof_index(f"{side}_Shoulder_x")] += 0.9 * sign
    return qpos


def is_hand(link: str) -> bool:
    return any(f in link for f in ("Index", "Middle", "Ring", "Pinky", "Thumb"))


def rotations(qpos: np.ndarray, body: Body = BODY) -> dict[str, Rotation]:
    """Link -> rotation against its parent; the root's against the world. Our axes."""
    out = {body.links[0].name: Rotation.from_quat(qpos[:, 3:7], scalar_first=True)}
    for i, link in enumerate(body.links[1:]):
        out[link.name] = Rotation.from_euler("XYZ", qpos[:, 7 + 3 * i : 10 + 3 * i])
    return out


def positions(qpos: np.ndarray, body: Body = BODY) -> dict[str, np.ndarray]:
    """Link -> (T, 3) origin by MuJoCo."""
    model = build_model(body)
    data = mujoco.MjData(model)
    ids = {link.name: model.body(body_name(0, link.name)).id for link in body.links}
    out = {name: np.empty((len(qpos), 3)) for name in ids}
    for t, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for name, i in ids.items():
            out[name][t] = data.xpos[i]
    return out


def npz(**arrays: object) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def smpl_pose(qpos: np.ndarray, z_up: bool) -> tuple[np.ndarray, np.ndarray]:
    """(T, 72) rotation vectors and (T, 3) pelvis in SMPL's axes; the root's in a z-up or y-up
    world."""
    local = rotations(qpos)
    axes = Rotation.from_matrix(AXES)
    parts = []
    for name in SMPL_ORDER:
        if name == "Pelvis":
            turn = local[name] * axes if z_up else axes.inv() * local[name] * axes
        else:
            turn = axes.inv() * local[name] * axes
        parts.append(turn.as_rotvec())
    place = qpos[:, :3] if z_up else qpos[:, :3] @ AXES
    return np.concatenate(parts, axis=1), place


def smpl_chain(poses: np.ndarray, trans: np.ndarray) -> dict[str, np.ndarray]:
    """Link -> (T, 3) joint of poses (T, 72) along SMPL's chain from ``trans`` (m), by the offsets
    of the body table; the world's axes are the file's."""
    table = Path(body_module.__file__).parent / "data" / "body_smpl.csv"
    turn, place = {}, {}
    for row in csv.DictReader(table.open()):
        name, parent = row["body"], row["parent"]
        j = SMPL_ORDER.index(name)
        own = Rotation.from_rotvec(poses[:, 3 * j : 3 * j + 3])
        off = np.array([float(row[f"offset_{a}"]) for a in "xyz"]) @ AXES  # to y up
        turn[name] = turn[parent] * own if parent else own
        place[name] = place[parent] + turn[parent].apply(off) if parent else trans
    return place


def amass(qpos: np.ndarray, width: int = 72, fps: float = 30.0) -> bytes:
    pose, place = smpl_pose(qpos, z_up=True)
    full = np.zeros((len(pose), width))
    full[:, :66] = pose[:, :66]
    if width == 72:
        full = pose
    return npz(
        poses=full, trans=place - PELVIS, betas=np.zeros(16), mocap_framerate=fps, gender="neutral"
    )


def amass_split(qpos: np.ndarray) -> bytes:
    pose, place = smpl_pose(qpos, z_up=True)
    return npz(
        root_orient=pose[:, :3],
        pose_body=pose[:, 3:66],
        trans=place - PELVIS,
        mocap_frame_rate=60.0,
    )


def wham(qpos: np.ndarray) -> bytes:
    pose, place = smpl_pose(qpos, z_up=False)
    return npz(pose_world=pose, trans_world=place - PELVIS, fps=30.0)


def gvhmr(qpos: np.ndarray) -> bytes:
    pose, place = smpl_pose(qpos, z_up=False)
    return npz(global_orient=pose[:, :3], body_pose=pose[:, 3:66], transl=place - PELVIS)


def tram(qpos: np.ndarray, seed: int = 1) -> bytes:
    """Seen by a camera that moves and turns."""
    pose, place = smpl_pose(qpos, z_up=False)
    frames, rng = len(pose), np.random.default_rng(seed)
    camera = Rotation.from_rotvec(rng.uniform(-1, 1, (frames + 3, 3)))
    where = rng.uniform(-2, 2, (frames + 3, 3))
    rows = np.arange(frames) + 2
    turn = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix().reshape(frames, 24, 3, 3)
    turn[:, 0] = camera[rows].inv().as_matrix() @ turn[:, 0]
    seen = camera[rows].inv().apply(place - where[rows]) - PELVIS
    return npz(
        pred_rotmat=turn,
        pred_trans=seen[:, None],
        frame=rows,
        world_cam_R=camera.as_matrix(),
        world_cam_T=where,
        fps=30.0,
    )


def bvh(qpos: np.ndarray, body: Body = BODY, order: str = "ZXY", unit: float = 0.01) -> str:
    """Our own skeleton as a BVH file, y up, z forward."""
    local, axes = rotations(qpos, body), Rotation.from_matrix(AXES)
    children = {
        link.name: [c.name for c in body.links if c.parent == link.name] for link in body.links
    }
    offset = {link.name: np.array(link.offset) @ AXES / unit for link in body.links}
    lines, columns = ["HIERARCHY"], []

    def write(name: str, depth: int) -> None:
        pad = "  " * depth
        root = depth == 0
        lines.append(f"{pad}{'ROOT' if root else 'JOINT'} {name}")
        lines.append(f"{pad}{{")
        lines.append(f"{pad}  OFFSET {' '.join(f'{x:.12f}' for x in offset[name])}")
        turns = [f"{axis}rotation" for axis in order]
        moves = ["Xposition", "Yposition", "Zposition"] if root else []
        lines.append(f"{pad}  CHANNELS {len(turns) + len(moves)} {' '.join(moves + turns)}")
        if root:
            columns.append(qpos[:, :3] @ AXES / unit)
        columns.append((axes.inv() * local[name] * axes).as_euler(order, degrees=True))
        for child in children[name]:
            write(child, depth + 1)
        if not children[name]:
            lines.extend([f"{pad}  End Site", f"{pad}  {{", f"{pad}    OFFSET 1 2 3", f"{pad}  }}"])
        lines.append(f"{pad}}}")

    write(body.links[0].name, 0)
    table = np.concatenate(columns, axis=1)
    lines += ["MOTION", f"Frames: {len(table)}", f"Frame Time: {1 / 30:.12f}"]
    lines += [" ".join(f"{x:.12f}" for x in row) for row in table]
    return "\n".join(lines) + "\n"


def own_map(format: str, unit: float = 1.0) -> JointMap:
    """The joint map of our own skeleton."""
    names = {name.lower() if format == "asf" else name: name for name in BODY.link_names}
    joints = {ours: theirs for theirs, ours in names.items()}
    if format == "asf":
        joints["Pelvis"] = "root"
        joints = {k: v if k == "Pelvis" else f"{v} end" for k, v in joints.items()}
    return JointMap(
        name="own",
        format=format,
        joints=joints,
        turns=None
        if format == "bvh"
        else {k: f"m_{k.lower()}" for k in BODY.link_names[1:]} | {"Pelvis": "root"},
        metres=unit,
        rest="t_pose",
    )


def asf_amc(qpos: np.ndarray) -> tuple[str, str]:
    """Our own skeleton in Acclaim's files.

    A joint of ours is the far end of a bone that does not turn (``l_knee`` reaches from the hip to
    the knee and turns with the hip), followed by a bone of no length that turns (``m_l_knee``).
    Each bone has axes of its own, which must cancel.
    """
    local, axes = rotations(qpos), Rotation.from_matrix(AXES)
    rng = np.random.default_rng(5)
    scale = 0.45
    bones, tree, rows = [], [], {}
    for link in BODY.links[1:]:
        name = link.name.lower()
        offset = np.array(link.offset) @ AXES
        length = np.linalg.norm(offset)
        parent = "root" if link.parent == "Pelvis" else f"m_{link.parent.lower()}"
        own = rng.uniform(-90, 90, 3)
        c = Rotation.from_euler("xyz", own, degrees=True)
        m = c.inv() * axes.inv() * local[link.name] * axes * c
        rows[f"m_{name}"] = m.as_euler("xyz", degrees=True)
        bones.append((name, offset / length, length * scale / 0.0254, np.zeros(3), False))
        bones.append((f"m_{name}", np.array([0.0, 0, 1]), 0.0, own, True))
        tree += [f"{parent} {name}", f"{name} m_{name}"]
    lines = [
        ":version 1.10",
        ":name own",
        ":units",
        "  mass 1.0",
        f"  length {scale}",
        "  angle deg",
    ]
    lines += [":root", "  order TX TY TZ RX RY RZ", "  axis XYZ", "  position 0 0 0"]
    lines += ["  orientation 0 0 0", ":bonedata"]
    for k, (name, direction, length, own, moves) in enumerate(bones):
        lines += ["  begin", f"    id {k + 1}", f"    name {name}"]
        lines += [f"    direction {' '.join(f'{x:.15f}' for x in direction)}"]
        lines += [f"    length {length:.15f}", f"    axis {' '.join(f'{x:.12f}' for x in own)} XYZ"]
        lines += ["    dof rx ry rz"] if moves else []
        lines += ["  end"]
    lines += [":hierarchy", "  begin", *(f"    {line}" for line in tree), "  end"]
    root = (axes.inv() * local["Pelvis"] * axes).as_euler("xyz", degrees=True)
    place = qpos[:, :3] @ AXES * scale / 0.0254
    amc = ["#!OML:ASF own.asf", ":FULLY-SPECIFIED", ":DEGREES"]
    for t in range(len(qpos)):
        amc.append(str(t + 1))
        amc.append("root " + " ".join(f"{x:.12f}" for x in (*place[t], *root[t])))
        amc += [f"{name} " + " ".join(f"{x:.12f}" for x in row[t]) for name, row in rows.items()]
    return "\n".join(lines) + "\n", "\n".join(amc) + "\n"


def skillmimic(qpos: np.ndarray) -> tuple[bytes, dict[str, np.ndarray]]:
    """Link positions of a motion of our SMPL-X body, and these by name."""
    body = load_body("smplx")
    where = positions(qpos, body)
    names = list(body.link_names)
    rows = [where[name] for name in names]
    rows.insert(names.index("Spine") + 1, 0.5 * (where["Spine"] + where["Chest"]))
    root = Rotation.from_quat(qpos[:, 3:7], scalar_first=True) * Rotation.from_matrix(AXES)
    data = npz(
        body_position=np.stack(rows, axis=1),
        root_position=qpos[:, :3],
        root_rotvec=root.as_rotvec(),
        ball_position=np.zeros((len(qpos), 3)),
        fps=30,
    )
    return data, where


def deepmimic(frames: int = 30, seed: int = 3, dt: float = 1 / 30) -> tuple[str, dict]:
    """A DeepMimic file of random smooth joints, and where its joints are, in our axes.

    Lengths of the 34-dof humanoid: hips 0.084887 m from the middle, thigh 0.421546, shin 0.40987,
    chest 0.236151, neck 0.223894 above it, upper arm 0.274788, forearm 0.258947.
    """
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, frames)[:, None]

    def ball() -> Rotation:
        return Rotation.from_rotvec(
            0.6 * np.sin(3 * t + rng.uniform(0, 6, 3)) * rng.uniform(0, 1, 3)
        )

    place = np.concatenate([t, 0.9 + 0.1 * np.sin(3 * t), -0.5 * t], axis=1)
    root, chest, neck = ball(), ball(), ball()
    columns = [np.full((frames, 1), dt), place]
    columns += [r.as_quat(scalar_first=True) for r in (root, chest, neck)]
    y = np.array([0.0, 1, 0])
    where = {"root": place, "chest": place + root.apply(0.236151 * y)}
    upper = root * chest
    where["neck"] = where["chest"] + upper.apply(0.223894 * y)
    for side, sign in (("right", 1.0), ("left", -1.0)):
        hip, knee, ankle = ball(), -1.0 + 0.5 * np.sin(4 * t), ball()
        shoulder, elbow = ball(), 1.0 + 0.5 * np.sin(5 * t)
        columns += [hip.as_quat(scalar_first=True), knee, ankle.as_quat(scalar_first=True)]
        columns += [shoulder.as_quat(scalar_first=True), elbow]
        turn = root * hip
        where[f"{side}_hip"] = place + root.apply([0, 0, 0.084887 * sign])
        where[f"{side}_knee"] = where[f"{side}_hip"] + turn.apply(-0.421546 * y)
        turn = turn * Rotation.from_euler("z", knee)
        where[f"{side}_ankle"] = where[f"{side}_knee"] + turn.apply(-0.40987 * y)
        turn = upper * shoulder
        where[f"{side}_shoulder"] = where["chest"] + upper.apply([-0.02405, 0.2435, 0.18311 * sign])
        where[f"{side}_elbow"] = where[f"{side}_shoulder"] + turn.apply(-0.274788 * y)
        turn = turn * Rotation.from_euler("z", elbow)
        where[f"{side}_wrist"] = where[f"{side}_elbow"] + turn.apply(-0.258947 * y)
    rows = np.concatenate(columns, axis=1).tolist()
    ours = {k: np.stack([v[:, 0], -v[:, 2], v[:, 1]], axis=1) for k, v in where.items()}
    return json.dumps({"Loop": "none", "Frames": rows}), ours
