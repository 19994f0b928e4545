"""Clips against MuJoCo's own integrator, closed forms, mirrors, round trips and hostile files."""

from __future__ import annotations

import io
import json
import pickle
import zipfile

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from warmstart import rotation
from warmstart.clip import Clip, clip_from_solution, contact_events, finite_difference_qvel
from warmstart.solution import Solution

BODY = load_body("smpl")
N = BODY.num_dofs


def analytic(fps: float, duration: float = 1.0, seed: int = 0) -> Clip:
    """Hinges swing as sines, the root flies a parabola and turns at a constant spin."""
    rng = np.random.default_rng(seed)
    amplitude, phase = rng.uniform(-0.6, 0.6, N), rng.uniform(0, 6, N)
    rate = rng.uniform(1, 5, N)
    t = np.arange(round(duration * fps) + 1)[:, None] / fps
    w = np.array([0.7, -1.9, 0.4])
    start = rotation.exp(np.array([[0.3, 0.2, -0.5]]))
    qpos, qvel = np.zeros((len(t), 7 + N)), np.zeros((len(t), 6 + N))
    qpos[:, :3] = np.array([2.0, -1.0, 1.0]) + t * np.array([3.0, 0.5, 4.0])
    qpos[:, 2:3] -= 0.5 * 9.81 * t**2
    qpos[:, 3:7] = rotation.multiply(np.repeat(start, len(t), 0), rotation.exp(t * w))
    qpos[:, 7:] = amplitude * np.sin(rate * t + phase)
    qvel[:, :3] = (3.0, 0.5, 4.0)
    qvel[:, 2:3] -= 9.81 * t
    qvel[:, 3:6] = w
    qvel[:, 6:] = amplitude * rate * np.cos(rate * t + phase)
    return Clip(fps=fps, body="smpl", qpos=qpos, qvel=qvel, ctrl=qpos[:, 7:], meta={"asked": 1})


def same_attitude(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return rotation.log(rotation.multiply(rotation.conjugate(a), b))


def test_resample_follows_the_analytic_motion():
    coarse, fine = analytic(30.0), analytic(240.0)
    again = coarse.resample(240.0)
    assert again.num_frames == fine.num_frames and again.duration == pytest.approx(1.0)
    assert np.abs(again.qpos[:, :3] - fine.qpos[:, :3]).max() < 1e-12  # cubics hold a parabola
    assert np.abs(same_attitude(again.qpos[:, 3:7], fine.qpos[:, 3:7])).max() < 1e-9
    # Hermite cubic: the error is at most h^4 / 384 max |q''''| (about 5^4 * 0.6 rad/s^4).
    assert np.abs(again.qpos[:, 7:] - fine.qpos[:, 7:]).max() < 1.1 * 0.6 * 5**4 / 384 / 30**4
    assert np.abs(again.qvel - fine.qvel).max() < 5e-3


def test_resample_to_the_same_rate_keeps_the_frames_and_down_keeps_every_other():
    clip = analytic(30.0)
    assert np.abs(clip.resample(30.0).qpos - clip.qpos).max() < 1e-12
    half = clip.resample(15.0)
    assert np.abs(half.qpos - clip.qpos[::2]).max() < 1e-12
    assert half.ctrl is not None and np.array_equal(half.ctrl, clip.ctrl[::2])


def test_ctrl_is_held_over_its_frame():
    clip = analytic(30.0)
    held = clip.at(np.array([4.0, 4.01, 4.99]) / 30.0)["ctrl"]
    assert np.array_equal(held, np.repeat(clip.ctrl[4:5], 3, 0))
    assert clip.at(0.2)["qpos"].shape == (7 + N,)
    with pytest.raises(ValueError, match="times must lie"):
        clip.at(1.01)


def test_finite_differences_agree_with_mujocos_own():
    model = build_model(BODY)
    clip = analytic(200.0)
    ours = finite_difference_qvel(BODY, clip.qpos, clip.fps)
    theirs, steps = np.zeros(model.nv), []
    for a, b in zip(clip.qpos[:-2], clip.qpos[2:]):
        mujoco.mj_differentiatePos(model, theirs, 2 / clip.fps, a, b)
        steps.append(theirs.copy())
    # MuJoCo differences hinge angles, we rotations: both are second order.
    assert np.abs(ours[1:-1] - np.array(steps)).max() < 2e-3
    assert np.abs(ours - clip.qvel).max() < 3e-2 and np.abs(ours - clip.qvel)[1:-1].max() < 3e-3


def test_a_hinge_that_wraps_by_a_whole_turn_does_not_spike():
    clip = analytic(60.0)
    wrapped = clip.qpos.copy()
    wrapped[20:40, 7 + BODY.dof_index("L_Shoulder_x")] += 2 * np.pi
    plain = finite_difference_qvel(BODY, clip.qpos, 60.0)
    assert np.abs(finite_difference_qvel(BODY, wrapped, 60.0) - plain).max() < 1e-9
    fine = Clip(60.0, "smpl", wrapped, clip.qvel).resample(480.0)
    assert np.abs(fine.joint_quat * np.sign(fine.joint_quat[..., :1])).max() <= 1 + 1e-9
    expected = clip.resample(480.0).joint_quat
    assert np.abs(same_attitude(fine.joint_quat, expected)).max() < 1e-9


def test_joint_rotations_are_those_of_mujocos_kinematics():
    model = build_model(BODY)
    data = mujoco.MjData(model)
    clip = analytic(30.0, duration=0.2)
    parents = BODY.parents()
    for frame in (0, 3):
        data.qpos[:] = clip.qpos[frame]
        data.qvel[:] = clip.qvel[frame]
        mujoco.mj_forward(model, data)
        quat, spin = data.xquat[1:], data.cvel[1:, :3]
        relative = rotation.multiply(rotation.conjugate(quat[parents[1:]]), quat[1:])
        assert np.abs(same_attitude(relative, clip.joint_quat[frame])).max() < 1e-9
        turned = rotation.rotate(rotation.conjugate(quat[1:]), spin[1:] - spin[parents[1:]])
        rates = rotation.hinge_rates(clip.qpos[frame, 7:].reshape(-1, 3), turned)
        assert np.abs(rates.ravel() - clip.qvel[frame, 6:]).max() < 1e-9


def test_hinge_spin_is_the_way_back_from_the_rates():
    rng = np.random.default_rng(3)
    angles, spin = rng.uniform(-3, 3, (200, 5, 3)), rng.normal(0, 5, (200, 5, 3))
    rates = rotation.hinge_rates(angles, spin)
    regular = np.abs(np.cos(angles[..., 1])) > 0.1  # nearer to the singular pose they are damped
    back = rotation.hinge_spin(angles, rates)
    np.testing.assert_allclose(back[regular], spin[regular], atol=1e-9)
    assert regular.mean() > 0.9


def test_joint_spin_matches_the_hinge_rates():
    clip = analytic(400.0)
    rates = rotation.hinge_rates(clip.qpos[:, 7:].reshape(-1, N // 3, 3), clip.joint_spin)
    assert np.abs(rates.reshape(-1, N) - clip.qvel[:, 6:])[1:-1].max() < 1e-3


def test_mirror_twice_is_the_identity():
    clip = analytic(30.0)
    twice = clip.mirrored(1.5).mirrored(1.5)
    for name in ("qpos", "qvel", "ctrl"):
        assert np.abs(getattr(twice, name) - getattr(clip, name)).max() < 1e-15
    assert twice.meta == clip.meta and clip.mirrored().meta["mirrored"]


def test_mirror_reflects_every_link_in_the_world():
    model = build_model(BODY)
    data = mujoco.MjData(model)
    # The packaged body is not exactly symmetric (mean shape): compare attitudes, not positions.
    clip = analytic(30.0, duration=0.2)
    other = clip.mirrored()
    names = BODY.link_names
    swap = [names.index(n.replace("L_", "?").replace("R_", "L_").replace("?", "R_")) for n in names]
    flip = np.diag([1.0, -1.0, 1.0])

    def state(c: Clip) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        data.qpos[:], data.qvel[:] = c.qpos[2], c.qvel[2]
        mujoco.mj_forward(model, data)
        return data.xmat[1:].reshape(-1, 3, 3).copy(), data.cvel[1:, :3].copy(), data.xpos[1].copy()

    (mat, spin, root), (mat_m, spin_m, root_m) = state(clip), state(other)
    assert np.abs(flip @ mat[swap] @ flip - mat_m).max() < 1e-12
    assert np.abs(spin[swap] @ -flip - spin_m).max() < 1e-12  # a spin is an axial vector
    assert np.abs(flip @ root - root_m).max() < 1e-12


def test_moved_turns_and_shifts_rigidly():
    clip = analytic(30.0)
    moved = clip.moved(x=1.0, y=2.0, yaw=0.7)
    back = moved.moved(-1.0, -2.0).moved(yaw=-0.7)
    assert np.abs(back.qpos - clip.qpos).max() < 1e-12
    assert np.abs(back.qvel - clip.qvel).max() < 1e-12
    # The velocities are those of the moved positions.
    qvel = finite_difference_qvel(BODY, moved.resample(400.0).qpos, 400.0)
    assert np.abs(qvel[1:-1, :6] - moved.resample(400.0).qvel[1:-1, :6]).max() < 1e-3


def test_cut_keeps_the_moment_of_events():
    clip = analytic(30.0)
    clip.meta["events"] = {"takeoff": 0.5}
    part = clip.cut(0.2, 0.8)
    assert part.duration == pytest.approx(0.6)
    assert part.meta["events"]["takeoff"] == pytest.approx(0.3)
    assert np.array_equal(part.qpos[0], clip.qpos[6])


def test_file_round_trip(tmp_path):
    clip = analytic(30.0)
    clip.meta.update(problem="high_jump", achieved={"bar_height": 1.02}, source="test")
    clip.save(tmp_path / "a.npz")
    read = Clip.load(tmp_path / "a.npz")
    assert (read.fps, read.body, read.meta) == (clip.fps, clip.body, clip.meta)
    for name in ("qpos", "qvel", "ctrl"):
        assert np.abs(getattr(read, name) - getattr(clip, name)).max() < 1e-6
    read.save(tmp_path / "b.npz")
    assert np.array_equal(Clip.load(tmp_path / "b.npz").qpos, read.qpos)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]  # no temporary left


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    clip = analytic(30.0)
    clip.save(tmp_path / "a.npz")
    before = (tmp_path / "a.npz").read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="No space"):
        clip.save(tmp_path / "a.npz")
    assert (tmp_path / "a.npz").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fps": 0.0}, "fps must lie"),
        ({"fps": float("nan")}, "fps must lie"),
        ({"body": "cat"}, "unknown body 'cat'"),
        ({"qpos": np.zeros((31, 75))}, r"qpos has shape \(31, 75\)"),
        ({"qvel": np.zeros((30, 75))}, "differ in their number of frames"),
        ({"qpos": np.zeros((31, 76))}, "quaternion of frame 0 has length 0.000"),
        ({"ctrl": np.full((31, 69), np.inf)}, "ctrl is not finite at frame 0"),
    ],
)
def test_what_is_not_a_motion_is_refused(change, message):
    clip = analytic(30.0)
    fields = {k: getattr(clip, k) for k in ("fps", "body", "qpos", "qvel", "ctrl")} | change
    with pytest.raises(ValueError, match=message):
        Clip(**fields)


@pytest.mark.parametrize("frames", [0, 1])
def test_too_few_frames_are_refused(frames):
    clip = analytic(30.0)
    with pytest.raises(ValueError, match="at least 2 frames"):
        Clip(30.0, "smpl", clip.qpos[:frames], clip.qvel[:frames])


def saved(tmp_path, **arrays: np.ndarray) -> bytes:
    """Bytes of a valid file with some entries replaced (meta: JSON text)."""
    clip = analytic(30.0, duration=0.2)
    head = {"format": "olympics-opt clip 1", "fps": 30.0, "body": "smpl", "meta": {}}
    entries = {"qpos": clip.qpos, "qvel": clip.qvel, "meta": np.array(json.dumps(head))} | arrays
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{k: v for k, v in entries.items() if v is not None})
    return buffer.getvalue()


def one_sentence(path) -> str:
    with pytest.raises(ValueError) as caught:
        Clip.load(path)
    text = str(caught.value)
    assert "\n" not in text and path.name in text
    return text


def test_nan_in_a_file(tmp_path):
    bad = analytic(30.0, duration=0.2).qpos
    bad[3, 9] = np.nan
    (tmp_path / "c.npz").write_bytes(saved(tmp_path, qpos=bad))
    assert "not finite at frame 3" in one_sentence(tmp_path / "c.npz")


def test_pickle_inside_is_never_run(tmp_path):
    fired = tmp_path / "fired"

    class Bomb:
        def __reduce__(self):
            return (open, (str(fired), "w"))

    (tmp_path / "c.npz").write_bytes(saved(tmp_path, qpos=np.array([Bomb()], dtype=object)))
    assert "not plain numbers" in one_sentence(tmp_path / "c.npz")
    (tmp_path / "d.npz").write_bytes(pickle.dumps(Bomb()))
    one_sentence(tmp_path / "d.npz")
    assert not fired.exists()


def test_zip_bombs_and_forged_headers(tmp_path):
    path = tmp_path / "c.npz"
    path.write_bytes(saved(tmp_path, extra=np.zeros(10)))
    assert "unknown entry 'extra.npy'" in one_sentence(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("qpos.npy", b"\0" * (300 * 2**20))
        archive.writestr("meta.npy", b"")
    assert path.stat().st_size < 2**20
    assert "300 MiB" in one_sentence(path)
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        buffer, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 76)}
    )
    source = zipfile.ZipFile(io.BytesIO(saved(tmp_path)))
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("qvel.npy", "meta.npy"):
            archive.writestr(name, source.read(name))
        archive.writestr("qpos.npy", buffer.getvalue())
    assert "shorter or longer than its header" in one_sentence(path)


def test_missing_parts(tmp_path):
    path = tmp_path / "c.npz"
    assert "no clip file at" in one_sentence(path)
    path.write_bytes(saved(tmp_path, qvel=None))
    assert "lacks 'qvel'" in one_sentence(path)
    path.write_bytes(saved(tmp_path, meta=None))
    assert "no metadata" in one_sentence(path)
    path.write_bytes(saved(tmp_path, meta=np.array("[1]")))
    assert "not a JSON object" in one_sentence(path)
    path.write_bytes(saved(tmp_path, meta=np.array('{"format": "other"}')))
    assert "expected 'olympics-opt clip 1'" in one_sentence(path)
    path.write_bytes(b"not a zip at all")
    one_sentence(path)
    path.write_bytes(b"")
    one_sentence(path)


@given(data=st.data())
def test_damaged_files_never_crash_the_reader(tmp_path, data):
    """Truncated and altered bytes end in the one sentence, or, unnoticed, in a valid clip."""
    blob = bytearray(saved(tmp_path))
    for _ in range(data.draw(st.integers(0, 4))):
        at = data.draw(st.integers(0, len(blob) - 1))
        blob[at] = data.draw(st.integers(0, 255))
    blob = blob[: data.draw(st.integers(0, len(blob)))]
    path = tmp_path / "c.npz"
    path.write_bytes(bytes(blob))
    try:
        clip = Clip.load(path)
    except ValueError as error:
        assert "\n" not in str(error) and "c.npz" in str(error)
    else:
        assert np.isfinite(clip.qpos).all() and clip.num_frames == 7


@given(
    head=st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=8),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(st.sampled_from(["format", "fps", "body", "meta"]), inner, max_size=4)
        ),
    )
)
def test_foreign_metadata_never_crashes_the_reader(tmp_path, head):
    if isinstance(head, dict):
        head["format"] = "olympics-opt clip 1"
    path = tmp_path / "c.npz"
    path.write_bytes(saved(tmp_path, meta=np.array(json.dumps(head))))
    with pytest.raises(ValueError) as caught:
        Clip.load(path)
    assert "\n" not in str(caught.value)


@given(rows=st.integers(0, 3), width=st.integers(0, 80), kind=st.sampled_from("fiubUSc"))
def test_foreign_arrays_never_crash_the_reader(tmp_path, rows, width, kind):
    array = np.zeros((rows, width), dtype={"U": "U3", "S": "S3", "b": "?"}.get(kind, kind + "8"))
    path = tmp_path / "c.npz"
    path.write_bytes(saved(tmp_path, qpos=array))
    with pytest.raises(ValueError) as caught:
        Clip.load(path)
    assert "\n" not in str(caught.value)


def test_clip_of_a_solution_carries_its_torques():
    """Held targets: kp (target - q) averaged over a frame is the torque averaged over it."""
    clip = analytic(10.0)
    knots, kp = clip.num_frames, BODY.array("kp")
    torque = np.linspace(0, 1, knots)[:, None] * np.arange(N)
    points = (("L_Toe", (0.0, 0.0, 0.0)),)
    solution = Solution(
        problem="high_jump",
        body=BODY,
        asked={"bar_height": 1.0},
        strength="paper",
        times=clip.times,
        qpos=clip.qpos,
        qvel=clip.qvel,
        qacc=np.zeros_like(clip.qvel),
        torque=torque,
        contact_points=points,
        contact_force=np.zeros((knots, 1, 3)),
        phases=(("stance", 0, 3, (0,)), ("flight", 3, 8, ()), ("stance", 8, knots - 1, (0,))),
    )
    events = contact_events(solution)
    assert events["takeoff"] == pytest.approx(0.3) and events["landing"] == pytest.approx(0.8)
    made = clip_from_solution(solution, 30.0)
    assert made.num_frames == 31 and made.meta["asked"] == {"bar_height": 1.0}
    inner = np.linspace(10 / 30, 11 / 30, 2001)
    hinges = solution.sample(inner)["qpos"][:, 7:].mean(0)
    middle = np.arange(N) * (10.5 / 30)  # the torque is linear: its mean is that of the middle
    assert np.abs(kp * (made.ctrl[10] - hinges) - middle).max() < 0.2
