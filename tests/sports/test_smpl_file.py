"""from_smpl on a small model file made here: a stick figure whose joints and volumes are known.

Every link has skin at the eight corners of a box of known size centred on its joint, so joints
are exact means, bounding boxes are the boxes, and hull volumes are their volumes.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import sys
import types

import numpy as np
import pytest
import scipy.sparse
from hypothesis import example, given
from hypothesis import strategies as st

from sports.humanoid import smpl_pickle
from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from sports.humanoid.smpl_file import JOINT_LINKS, from_smpl, read_smpl

TO_SMPL = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Ours (x forward, y left, z up) to SMPL's (x left, y up, z forward), written out by hand."""
HALF = np.array([0.02, 0.03, 0.025])
"""Half-extents of every link's skin (m), our axes."""
SHANK_STRETCH = 0.05
"""What the second shape coefficient adds to the left shank (m)."""


def joint_positions(family):
    """(J, 3) joints in our axes: the packaged table's, jaw and eyes put into the head."""
    body = load_body(family)
    origin = dict(zip(body.link_names, body.zero_pose_origins(), strict=True))
    return np.array([origin[name] for name in JOINT_LINKS[family]])


def parents(family):
    names = JOINT_LINKS[family]
    parent_of = {link.name: link.parent for link in load_body(family).links}
    row = []
    for joint, name in enumerate(names):
        if name == "Head" and joint != names.index("Head"):
            row.append(names.index("Head"))
        else:
            row.append(2**32 - 1 if parent_of[name] is None else names.index(parent_of[name]))
    return row


def model_fields(family="smpl"):
    names, joints = JOINT_LINKS[family], joint_positions(family)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF
    vertices = (joints[:, None] + corners[None]).reshape(-1, 3) @ TO_SMPL.T
    count, num = len(vertices), len(joints)
    owner = np.repeat(np.arange(num), 8)
    weights = np.full((count, num), 0.2 / num)
    weights[np.arange(count), owner] += 0.8
    regressor = np.zeros((num, count))
    regressor[owner, np.arange(count)] = 1.0 / 8.0
    dirs = np.zeros((count, 3, 12))
    dirs[:, :, 0] = 0.1 * vertices  # a larger body
    foot = np.isin(owner, [names.index("L_Ankle"), names.index("L_Toe")])
    dirs[foot, 1, 1] = -SHANK_STRETCH  # SMPL's y is up
    return {
        "v_template": vertices,
        "shapedirs": dirs,
        "J_regressor": regressor,
        "kintree_table": np.array([parents(family), range(num)], dtype=np.uint32),
        "weights": weights,
        "f": np.zeros((4, 3), dtype=np.uint32),
    }


def write_npz(path, fields):
    np.savez(path, **fields)
    return path


def write_pickle(path, fields, protocol=2):
    path.write_bytes(pickle.dumps(fields, protocol=protocol))
    return path


@pytest.fixture
def npz(tmp_path):
    return write_npz(tmp_path / "stick.npz", model_fields())


@pytest.mark.parametrize(("family", "links", "dofs"), [("smpl", 24, 69), ("smplx", 52, 153)])
def test_mean_shape_has_the_skeleton_of_the_file(tmp_path, family, links, dofs):
    body = from_smpl(write_npz(tmp_path / "stick.npz", model_fields(family)))
    table = load_body(family)
    assert (body.num_links, body.num_dofs) == (links, dofs)
    assert body.link_names == table.link_names
    assert [d.name for d in body.dofs] == [d.name for d in table.dofs]
    np.testing.assert_allclose(body.zero_pose_origins(), table.zero_pose_origins(), atol=1e-12)
    assert body.excluded_pairs == table.excluded_pairs
    np.testing.assert_array_equal(body.array("kp"), table.array("kp"))
    assert [link.shapes[0].kind for link in body.links] == [
        link.shapes[0].kind for link in table.links
    ]


def shape_volume(shape):
    if shape.kind == "box":
        return 8 * math.prod(shape.size)
    length = math.dist(shape.center, shape.end)
    return math.pi * shape.size[0] ** 2 * length + 4 / 3 * math.pi * shape.size[0] ** 3


def test_shapes_keep_the_volume_of_the_skin_and_the_density_of_the_table(npz):
    for link, row in zip(from_smpl(npz).links, load_body().links, strict=True):
        (shape,) = link.shapes
        assert shape_volume(shape) == pytest.approx(8 * math.prod(HALF), rel=1e-9)
        density = row.shapes[0].mass / shape_volume(row.shapes[0])
        assert shape.mass == pytest.approx(density * 8 * math.prod(HALF), rel=1e-9)
        if shape.kind == "box":
            np.testing.assert_allclose(shape.center, 0.0, atol=1e-12)
            np.testing.assert_allclose(shape.size, HALF, atol=1e-12)
        else:  # the packaged capsules lie on the same bones, to the table's four decimals
            np.testing.assert_allclose(shape.center, row.shapes[0].center, atol=2e-4)
            np.testing.assert_allclose(shape.end, row.shapes[0].end, atol=2e-4)


def skin_of(shape, rng):
    """Points on the surface of a shape (n, 3): enough that their hull nearly fills it."""
    if shape.kind == "box":
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return np.asarray(shape.center) + corners * np.asarray(shape.size)
    ball = rng.normal(size=(600, 3))
    ball *= shape.size[0] / np.linalg.norm(ball, axis=1, keepdims=True)
    axis = np.subtract(shape.end, shape.center)
    return np.where((ball @ axis > 0)[:, None], shape.end, shape.center) + ball


@pytest.mark.parametrize("family", ["smpl", "smplx"])
def test_a_file_whose_skin_is_the_packaged_body_gives_it_back(tmp_path, family):
    table, names, rng = load_body(family), JOINT_LINKS[family], np.random.default_rng(0)
    joints = joint_positions(family)
    skins = [
        joints[i] + skin_of(table.links[table.link_index(name)].shapes[0], rng)
        for i, name in enumerate(names)
    ]
    owner = np.repeat(np.arange(len(names)), [len(skin) for skin in skins])
    ours = np.concatenate(skins)
    regressor = np.zeros((len(names), len(ours)))
    for i, skin in enumerate(skins):  # weights that sum to one and mean to the joint
        system = np.vstack([np.ones(len(skin)), (skin - joints[i]).T])
        regressor[i, owner == i] = np.linalg.lstsq(system, np.eye(4)[0], rcond=None)[0]
    fields = model_fields(family) | {
        "v_template": ours @ TO_SMPL.T,
        "shapedirs": np.zeros((len(ours), 3, 10)),
        "J_regressor": regressor,
        "weights": np.eye(len(names))[owner],
    }
    body = from_smpl(write_npz(tmp_path / "table.npz", fields))
    for link, row in zip(body.links, table.links, strict=True):
        (found,), (wanted,) = link.shapes, row.shapes
        np.testing.assert_allclose(link.offset, row.offset, atol=1e-9)
        if wanted.kind == "box":
            np.testing.assert_allclose(found.center, wanted.center, atol=1e-9)
            np.testing.assert_allclose(found.size, wanted.size, atol=1e-9)
        else:  # a hull of 600 points lacks 2 % of a capsule; a fingertip ends where its skin does
            assert found.mass == pytest.approx(wanted.mass, rel=0.15 if "3" in row.name else 0.04)
            assert found.size[0] == pytest.approx(
                wanted.size[0], rel=0.1 if "3" in row.name else 0.03
            )
    assert body.mass == pytest.approx(table.mass, rel=0.02)
    assert body.standing_height() == pytest.approx(table.standing_height(), abs=1e-9)


def test_first_coefficient_scales_everything(npz):
    mean = from_smpl(npz)
    for beta in (-2.0, 0.5, 3.0):
        body = from_smpl(npz, [beta])
        scale = 1.0 + 0.1 * beta
        np.testing.assert_allclose(
            body.zero_pose_origins(), scale * mean.zero_pose_origins(), atol=1e-12
        )
        assert body.mass == pytest.approx(scale**3 * mean.mass, rel=1e-9)
        assert body.standing_height(0.0) == pytest.approx(scale * mean.standing_height(0.0))


def test_second_coefficient_stretches_one_shank_linearly(npz):
    mean, longer = from_smpl(npz), from_smpl(npz, [0.0, 2.0])
    for before, after in zip(mean.links, longer.links, strict=True):
        moved = np.subtract(after.offset, before.offset)
        expected = [0, 0, -2 * SHANK_STRETCH] if after.name == "L_Ankle" else [0, 0, 0]
        np.testing.assert_allclose(moved, expected, atol=1e-12)


def test_mujoco_builds_the_body(npz):
    body = from_smpl(npz, [1.0, 2.0])
    model = build_model(body)
    assert model.nu == body.num_dofs
    assert model.body_mass.sum() == pytest.approx(body.mass)


def test_strength_limits_and_equipment_as_in_a_packaged_body(npz):
    body = from_smpl(npz, strength="human", limits="anatomical", equipment=["sword"])
    table = load_body(strength="human", limits="anatomical", equipment=["sword"])
    for field in ("kp", "kd", "effort", "lower", "upper"):
        np.testing.assert_array_equal(body.array(field), table.array(field))
    sword = body.links[body.link_index("R_Hand")].shapes
    assert sword == table.links[table.link_index("R_Hand")].shapes


# ---- pickles -------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize(
    "regressor", [np.asarray, scipy.sparse.csc_matrix, scipy.sparse.csr_matrix]
)
def test_pickle_and_npz_give_the_same_body(tmp_path, npz, protocol, regressor):
    fields = model_fields()
    fields["J_regressor"] = regressor(fields["J_regressor"])
    fields["bs_type"] = "lrotmin"
    path = write_pickle(tmp_path / "stick.pkl", fields, protocol)
    assert from_smpl(path, [1.0, -1.0]) == from_smpl(npz, [1.0, -1.0])


@pytest.fixture
def chumpy(monkeypatch):
    """Stand-ins for the chumpy classes that a published model file names."""
    reordering = types.ModuleType("chumpy.reordering")
    ch = types.ModuleType("chumpy.ch")
    for module, name in ((ch, "Ch"), (reordering, "Select")):
        made = type(name, (), {"__module__": module.__name__})
        setattr(module, name, made)
    package = types.ModuleType("chumpy")
    for name, module in (("", package), (".ch", ch), (".reordering", reordering)):
        monkeypatch.setitem(sys.modules, f"chumpy{name}", module)
    return types.SimpleNamespace(Ch=ch.Ch, Select=reordering.Select)


@pytest.mark.parametrize("protocol", range(6))
def test_chumpy_arrays_are_read_as_data(tmp_path, npz, chumpy, protocol):
    fields = model_fields()
    template, dirs = chumpy.Ch(), chumpy.Select()
    template.x = fields["v_template"]
    wide = np.concatenate([fields["shapedirs"], np.ones_like(fields["shapedirs"])], axis=2)
    count, _, total = wide.shape
    inner = chumpy.Ch()
    inner.x = wide
    dirs.a = inner
    dirs.idxs = np.arange(wide.size).reshape(wide.shape)[:, :, : total // 2].ravel()
    dirs.preferred_shape = (count, 3, total // 2)
    fields |= {"v_template": template, "shapedirs": dirs}
    path = write_pickle(tmp_path / "stick.pkl", fields, protocol)
    assert from_smpl(path, [0.3, 0.7]) == from_smpl(npz, [0.3, 0.7])


def test_arrays_pickled_by_python_2(tmp_path):
    values = np.array([1.5, -2.0, 1e300])
    head = (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85U\x01btR"
        b"(K\x01K\x03\x85cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R"
        b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U\x18"
    )
    raw = head + values.tobytes() + b"tb."
    np.testing.assert_array_equal(smpl_pickle.as_array(smpl_pickle.load_data(raw)), values)


@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<f4", "<i4", ">u2", "?", "i1"])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_every_number_type_survives(dtype, order, protocol):
    array = np.asarray(np.arange(24).reshape(2, 3, 4) % 5, dtype=dtype, order=order)
    read = smpl_pickle.as_array(smpl_pickle.load_data(pickle.dumps(array, protocol=protocol)))
    np.testing.assert_array_equal(read, array)


# ---- pickles that attack --------------------------------------------------------------------


class Calls:
    """Pickles to a call of any function when a common unpickler reads it."""

    def __init__(self, function, *args):
        self.call = (function, args)

    def __reduce__(self):
        return self.call


def attacks(marker):
    command = f"touch {marker}"
    code = f"open({str(marker)!r}, 'w').close()"
    return {
        "os.system": Calls(os.system, command),
        "eval": Calls(eval, f"__import__('os').system({command!r})"),
        "exec": Calls(exec, code),
        "getattr": Calls(getattr, "", "join"),
        "open": Calls(open, str(marker), "w"),
        "numpy.save": Calls(np.save, str(marker), [1.0]),
        "numpy.load": Calls(np.load, str(marker)),
        "import": Calls(__import__, "antigravity"),
        "range": Calls(range, 3),
    }


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize("name", sorted(attacks("m")))
@pytest.mark.parametrize("place", ["top", "shapedirs", "extra", "in a list"])
def test_a_pickle_that_calls_functions_is_refused_and_not_run(tmp_path, name, protocol, place):
    marker = tmp_path / "it_ran"
    attack = attacks(marker)[name]
    fields = model_fields()
    if place == "top":
        fields = attack
    elif place == "in a list":
        fields["v_template"] = [attack, [attack]]
    else:
        fields[place] = attack
    path = write_pickle(tmp_path / "evil.pkl", fields, protocol)
    with pytest.raises(ValueError, match=r"is refused, nothing of it was run: it asks for '"):
        from_smpl(path)
    assert not marker.exists()


def test_the_attack_is_real(tmp_path):
    marker = tmp_path / "it_ran"
    pickle.loads(pickle.dumps(attacks(marker)["os.system"]))
    assert marker.exists()


@pytest.mark.parametrize(
    "raw",
    [
        b"\x80\x04\x8c\x05numpy\x8c\x10ndarray.__class__\x93.",  # a dotted name
        b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x04true\x85R.",
        b"cos\nsystem\n(S'true'\ntR.",
        b"ccopyreg\n_reconstructor\n(c__builtin__\nset\nc__builtin__\nobject\nNtR.",
        b"c_codecs\nencode\n(Vabc\nVrot13\ntR.",
        b"(S'true'\nios\nsystem\n.",  # the INST opcode
        b"\x80\x02cchumpy.ch\nCh\n}U\x01aK\x01sb.",  # a state for the class itself
        b"\x80\x02c_codecs\nencode\nN}U\x0c__defaults__K\x01s\x86b.",
        b"cpersistent\n",
        b"Pid\n.",
        b"\x82\x01.",
    ],
)
def test_hand_made_pickles_are_refused(tmp_path, raw):
    path = tmp_path / "evil.pkl"
    path.write_bytes(raw)
    with pytest.raises(ValueError, match=r"evil\.pkl"):
        from_smpl(path)


# ---- files that are not models ----------------------------------------------------------------


def broken(**changes):
    fields = model_fields()
    for name, change in changes.items():
        fields[name] = change(fields[name])
    return fields


def with_nan(array):
    array = array.copy()
    array.flat[7] = np.nan
    return array


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"a": np.zeros(3)}, "lacks v_template, shapedirs"),
        (broken(v_template=with_nan), "'v_template' holds NaN"),
        (broken(weights=lambda w: w[:, :-1]), r"'weights' has shape \(192, 23\)"),
        (broken(v_template=lambda v: v[:-1]), "has shape"),
        (broken(v_template=lambda v: v.ravel()), "'v_template' has shape"),
        (broken(shapedirs=lambda d: d[0]), "'shapedirs' has shape"),
        (broken(kintree_table=lambda t: t[:, :20]), "20 joints, expected 24"),
        (broken(kintree_table=lambda t: t[0]), "'kintree_table' has shape"),
        (broken(kintree_table=lambda t: t[:, ::-1] * 0), "does not hang on"),
        (broken(J_regressor=lambda j: 2 * j), "a row does not sum to 1"),
        (broken(v_template=lambda v: 100 * v), "m tall"),
        (broken(v_template=lambda v: v * [1, 1e-9, 1]), "m tall"),
        (broken(weights=lambda w: np.eye(24)[np.zeros(len(w), int)]), "0 vertices of skin"),
        (broken(v_template=lambda v: v.astype("U8")), "holds <U8, not numbers"),
    ],
)
def test_an_npz_that_is_no_model_gets_one_sentence(tmp_path, fields, sentence):
    path = write_npz(tmp_path / "wrong.npz", fields)
    with pytest.raises(ValueError, match=sentence) as caught:
        from_smpl(path)
    assert "\n" not in str(caught.value)


def test_flat_skin_has_no_volume(tmp_path):
    fields = model_fields()
    hip = slice(8, 16)  # the skin of L_Hip, the second joint
    fields["v_template"][hip, 0] = fields["v_template"][hip, 0].mean()
    with pytest.raises(ValueError, match="skin of link 'L_Hip' is flat"):
        from_smpl(write_npz(tmp_path / "flat.npz", fields))


def test_object_arrays_in_an_npz_get_a_remedy(tmp_path):
    fields = model_fields()
    fields["shapedirs"] = np.array([{"a": 1}], dtype=object)
    with pytest.raises(
        ValueError, match=r"'shapedirs' is an array of Python objects.*save it again"
    ):
        from_smpl(write_npz(tmp_path / "object.npz", fields))


def test_object_arrays_that_nobody_needs_do_no_harm(tmp_path, npz):
    fields = model_fields() | {"joint2num": np.array({"Pelvis": 0}, dtype=object)}
    assert from_smpl(write_npz(tmp_path / "stick.npz", fields)) == from_smpl(npz)


@pytest.mark.parametrize(
    ("betas", "sentence"),
    [
        (np.zeros(13), "13 betas given, the model has 12"),
        ([float("nan")], "NaN"),
        (np.zeros((1, 10)), r"shape \(1, 10\)"),
        ([-9.9], "m tall"),
    ],
)
def test_betas_that_do_not_fit(npz, betas, sentence):
    with pytest.raises(ValueError, match=sentence):
        from_smpl(npz, betas)


@pytest.mark.parametrize(("width", "available"), [(400, 300), (20, 10), (10, 10), (5, 5)])
def test_expressions_of_smplx_are_not_shape(tmp_path, width, available):
    fields = model_fields("smplx")
    fields["shapedirs"] = np.zeros((len(fields["v_template"]), 3, width))
    assert read_smpl(write_npz(tmp_path / "stick.npz", fields)).num_betas == available


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        from_smpl(tmp_path / "nowhere.npz")


def whole_files():
    small = {k: v for k, v in model_fields().items() if k != "f"}
    small["shapedirs"] = small["shapedirs"][:, :, :1]
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **small)
    return buffer.getvalue(), pickle.dumps(small, protocol=4)


NPZ, PICKLE = whole_files()


def reads_or_says_why(raw, path):
    path.write_bytes(raw)
    try:
        read_smpl(path)
    except ValueError as error:
        assert path.name in str(error)


@given(data=st.data(), whole=st.sampled_from([NPZ, PICKLE]))
def test_truncated_files_get_a_sentence(tmp_path, data, whole):
    length = data.draw(st.integers(0, len(whole) - 1))
    path = tmp_path / "cut.bin"
    path.write_bytes(whole[:length])
    with pytest.raises(ValueError, match=r"cut\.bin"):
        read_smpl(path)


@given(data=st.data(), whole=st.sampled_from([NPZ, PICKLE]))
def test_damaged_bytes_read_or_get_a_sentence(tmp_path, data, whole):
    raw = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 8))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    reads_or_says_why(bytes(raw), tmp_path / "bits.bin")


@given(raw=st.binary(max_size=400), head=st.sampled_from([b"", b"PK\x03\x04", b"\x80\x04"]))
@example(raw=b"", head=b"")
def test_random_bytes_get_a_sentence(tmp_path, raw, head):
    path = tmp_path / "noise.bin"
    path.write_bytes(head + raw)
    with pytest.raises(ValueError, match=r"noise\.bin"):
        read_smpl(path)
