"""The body table against figures stated elsewhere: the spec, rule books, closed forms, mirrors."""

from __future__ import annotations

import csv
import math
from importlib import resources

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sports.humanoid.body import (
    Shape,
    equipment_names,
    load_body,
    strength_group,
    support_points,
)

BODIES = ("smpl", "smplx")


@pytest.fixture(params=BODIES)
def body(request):
    return load_body(request.param)


@pytest.mark.parametrize(
    ("name", "links", "dofs", "mass", "height"),
    [("smpl", 24, 69, 71.8, 0.942), ("smplx", 52, 153, 73.5, 0.955)],
)
def test_size_mass_and_height(name, links, dofs, mass, height):
    body = load_body(name)
    assert (body.num_links, body.num_dofs) == (links, dofs)
    assert body.mass == pytest.approx(mass, abs=0.05)
    assert body.standing_height() == pytest.approx(height, abs=5e-4)


def test_standing_height_by_hand():
    # Right leg of the SMPL table: hip, knee and ankle offsets, then the bottom of the ankle's box;
    # the toe's box ends higher. Soles 5 mm above the ground.
    right = 0.0905 + 0.3826 + 0.3984 + (0.0174 + 0.0478)
    left = 0.0914 + 0.3752 + 0.3980 + (0.0239 + 0.0464)
    assert load_body().standing_height() == pytest.approx(0.005 + max(left, right), abs=1e-12)


def test_links_come_depth_first(body):
    path: list[str] = []
    for link in body.links:
        if link.parent is None:
            assert not path, "a second root"
        else:
            while path[-1] != link.parent:
                path.pop()
        path.append(link.name)
    assert body.parents()[0] == -1
    assert all(parent < i for i, parent in enumerate(body.parents()))


def test_three_hinges_a_link_in_x_y_z_order(body):
    expected = [f"{link}_{axis}" for link in body.link_names[1:] for axis in "xyz"]
    assert [dof.name for dof in body.dofs] == expected
    assert [body.dof_index(name) for name in expected] == list(range(body.num_dofs))
    assert [body.link_index(name) for name in body.link_names] == list(range(body.num_links))


def test_left_and_right_are_nearly_mirrored():
    # The tables come from a fit to a scan, so only nearly; SMPL-X is off by 3.6 cm at the elbow.
    for name, tolerance in (("smpl", 0.01), ("smplx", 0.04)):
        body = load_body(name)
        for link in body.links:
            if link.name.startswith("L_"):
                other = body.links[body.link_index("R_" + link.name[2:])]
                mirrored = np.multiply(other.offset, [1, -1, 1])
                np.testing.assert_allclose(link.offset, mirrored, atol=tolerance)
                assert (link.kp, link.kd) == (other.kp, other.kd)


def test_gains_of_the_paper(body):
    for dof in body.dofs:
        assert dof.effort == 500.0
        assert dof.kp == 10 * dof.kd
        assert dof.armature == 0.02
    assert body.dofs[body.dof_index("L_Hip_y")].kp == 800
    assert body.dofs[body.dof_index("Torso_y")].kp == 1000


def test_action_scale(body):
    scale = dict(zip((d.name for d in body.dofs), body.action_scale(), strict=True))
    assert scale.pop("L_Knee_y") == scale.pop("R_Knee_y") == 5.0
    assert set(scale.values()) == {math.pi}


# ---- collisions ----------------------------------------------------------------------------


def test_excluded_pairs_are_parents_and_the_listed_ones():
    body = load_body()
    listed = [
        *[("L_Knee", "L_Toe"), ("L_Knee", "R_Toe"), ("L_Knee", "R_Ankle")],
        *[("R_Knee", "L_Toe"), ("R_Knee", "R_Toe"), ("R_Knee", "L_Ankle")],
        *[("Torso", "Chest"), ("Chest", "Head"), ("L_Shoulder", "Chest"), ("R_Shoulder", "Chest")],
    ]
    family = [(link.name, link.parent) for link in body.links if link.parent]
    expected = {frozenset(pair) for pair in listed + family}
    assert {frozenset(pair) for pair in body.excluded_pairs} == expected
    assert len(body.excluded_pairs) == len(expected) == 33


def test_fingers_ignore_their_own_hand_only():
    pairs = {frozenset(pair) for pair in load_body("smplx").excluded_pairs}
    assert frozenset(("L_Index3", "L_Thumb2")) in pairs
    assert frozenset(("R_Pinky1", "R_Wrist")) in pairs
    assert frozenset(("L_Index3", "R_Index3")) not in pairs
    assert frozenset(("L_Index3", "L_Elbow")) not in pairs


# ---- limits --------------------------------------------------------------------------------


def degrees(body, name):
    dof = body.dofs[body.dof_index(name)]
    return math.degrees(dof.lower), math.degrees(dof.upper)


def test_limits_of_the_paper(body):
    for dof in body.dofs:
        span = 720 if dof.link.endswith(("Shoulder", "Elbow")) else 180
        assert degrees(body, dof.name) == pytest.approx((-span, span))


@pytest.mark.parametrize(
    ("dof", "lower", "upper"),
    [
        ("R_Hip_x", -90, 90),
        ("L_Knee_x", -5.6, 5.6),
        ("L_Knee_y", 0, 180),
        ("R_Ankle_x", -45, 45),
        ("R_Ankle_y", -90, 90),
        ("Spine_z", -60, 60),
        ("Neck_x", -5.6, 5.6),
        ("Head_y", -90, 90),
        ("L_Thorax_z", -5.6, 5.6),
        ("L_Elbow_z", -180, 0),
        ("R_Elbow_z", 0, 180),
        ("L_Toe_y", -180, 180),
        ("L_Shoulder_x", -720, 720),
    ],
)
def test_anatomical_limits(dof, lower, upper):
    assert degrees(load_body(limits="anatomical"), dof) == pytest.approx((lower, upper))


@pytest.mark.parametrize("name", BODIES)
def test_anatomical_limits_survive_a_mirror(name):
    # A mirror in the x-z plane turns the hinges about x and z around, not those about y.
    body = load_body(name, limits="anatomical")
    for dof in body.dofs:
        if dof.name.startswith("L_"):
            low, high = degrees(body, "R_" + dof.name[2:])
            expected = (low, high) if dof.axis == "y" else (-high, -low)
            assert degrees(body, dof.name) == pytest.approx(expected)


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("limits", ["paper", "anatomical"])
def test_the_zero_pose_is_within_the_limits(name, limits):
    body = load_body(name, limits=limits)
    assert np.all(body.array("lower") <= 0)
    assert np.all(body.array("upper") >= 0)


# ---- strength ------------------------------------------------------------------------------


def strength_rows():
    text = resources.files("sports.humanoid").joinpath("data", "strength_human.csv").read_text()
    return list(csv.DictReader(text.splitlines()))


@pytest.mark.parametrize("name", BODIES)
def test_human_torque_falls_to_zero_at_the_no_load_speed(name):
    rows = {(r["link"], r["axis"]): r for r in strength_rows()}
    paper = load_body(name)
    for dof, free in zip(load_body(name, strength="human").dofs, paper.dofs, strict=True):
        row = rows[strength_group(dof.link), dof.axis]
        torque, speed = float(row["torque_nm"]), float(row["no_load_speed_rad_s"])
        assert dof.effort == torque
        assert dof.effort - dof.kd * speed == pytest.approx(0.0, abs=1e-9)
        # The servo of the human body is never stiffer than the paper's, and saturates by 0.35 rad
        # wherever it is weaker.
        assert dof.kp <= free.kp
        assert dof.kp == free.kp or dof.kp * 0.35 == pytest.approx(torque)
        assert torque < free.effort


def test_legs_are_within_the_published_range():
    # Isometric maxima of men and of athletes: knee 270 N m and plantar flexion 140-330 N m
    # (sources in the table), hip extension above the knee's.
    body = load_body(strength="human")
    effort = dict(zip((d.name for d in body.dofs), body.array("effort"), strict=True))
    assert 240 <= effort["L_Knee_y"] <= 330
    assert 140 <= effort["L_Ankle_y"] <= 330
    assert effort["L_Hip_y"] >= 240
    assert effort["Neck_y"] == pytest.approx(51, abs=11)


def test_every_strength_names_its_source():
    rows = strength_rows()
    assert len({(r["link"], r["axis"]) for r in rows}) == len(rows) == 45
    for row in rows:
        assert "estimate" in row["source"] or any(
            str(year) in row["source"] for year in range(1980, 2027)
        ), row


def test_both_sides_are_equally_strong():
    body = load_body("smplx", strength="human")
    for dof in body.dofs:
        if dof.name.startswith("L_"):
            other = body.dofs[body.dof_index("R_" + dof.name[2:])]
            assert (dof.effort, dof.kp, dof.kd) == (other.effort, other.kp, other.kd)


# ---- equipment -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "tool_mass", "replaced"),
    [
        ("club", 0.45, ("R_Hand",)),
        ("racket", 0.31, ()),
        ("paddle", 0.17, ()),
        ("sword", 0.77, ("R_Hand",)),
        ("gloves", 2 * 0.284, ("L_Hand", "R_Hand")),
    ],
)
def test_equipment_changes_the_mass_by_its_own(name, tool_mass, replaced):
    bare, equipped = load_body(), load_body(equipment=[name])
    hands = sum(s.mass for link in bare.links if link.name in replaced for s in link.shapes)
    assert equipped.mass - bare.mass == pytest.approx(tool_mass - hands, abs=1e-9)
    assert equipped.num_dofs == bare.num_dofs
    assert equipped.link_names == bare.link_names
    assert equipped.equipment == (name,)


def test_the_point_of_the_sword_is_a_shape_of_its_own():
    """One blade of 0.98 m in two shapes: it balances in its middle, and the last 0.05 m score."""
    body = load_body(equipment=["sword"])
    blade, point = body.links[body.link_index("R_Hand")].shapes
    assert blade.end == point.center == (0, -0.93, 0) and point.end == (0, -0.98, 0)
    assert blade.size == point.size == (0.01,)
    moment = blade.mass * 0.93 / 2 + point.mass * (0.93 + 0.98) / 2
    assert moment / (blade.mass + point.mass) == pytest.approx(0.49, abs=1e-5)


def test_equipment_list_is_complete():
    assert set(equipment_names()) == {
        "club",
        "racket",
        "paddle",
        "sword",
        "gloves",
        "javelin",
        "basketball",
        "basketball_two_hands",
    }


# ---- shapes --------------------------------------------------------------------------------

coordinate = st.floats(-2, 2)
point = st.tuples(coordinate, coordinate, coordinate)
extent = st.floats(0.01, 1)
direction = point.filter(lambda d: np.linalg.norm(d) > 0.1)


def reach(shape, towards):
    """Largest coordinate along a unit vector over the balls of support_points."""
    return max(float(p @ towards) + radius for p, radius in support_points(shape))


@given(center=point, half=st.tuples(extent, extent, extent), towards=direction)
def test_box_reach(center, half, towards):
    d = np.array(towards) / np.linalg.norm(towards)
    expected = np.dot(center, d) + np.abs(d) @ np.array(half)
    assert reach(Shape("box", center, half, 1.0), d) == pytest.approx(expected, abs=1e-9)


@given(center=point, radius=extent, towards=direction)
def test_sphere_reach(center, radius, towards):
    d = np.array(towards) / np.linalg.norm(towards)
    shape = Shape("sphere", center, (radius,), 1.0)
    assert reach(shape, d) == pytest.approx(np.dot(center, d) + radius, abs=1e-9)


@given(center=point, end=point, radius=extent, towards=direction)
def test_capsule_reach(center, end, radius, towards):
    d = np.array(towards) / np.linalg.norm(towards)
    shape = Shape("capsule", center, (radius,), 1.0, end)
    expected = max(np.dot(center, d), np.dot(end, d)) + radius
    assert reach(shape, d) == pytest.approx(expected, abs=1e-9)


@given(center=point, axis=direction, radius=extent, towards=direction)
def test_cylinder_reach_is_an_inscribed_octagon(center, axis, radius, towards):
    d = np.array(towards) / np.linalg.norm(towards)
    end = tuple(np.add(center, axis))
    along = np.array(axis) / np.linalg.norm(axis)
    ends = max(np.dot(center, d), np.dot(end, d))
    rim = radius * float(np.linalg.norm(np.cross(along, d)))
    found = reach(Shape("cylinder", center, (radius,), 1.0, end), d)
    assert ends + math.cos(math.pi / 8) * rim - 1e-9 <= found <= ends + rim + 1e-9


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("box", (0, 0, 0), (0.1,), 1.0), "cannot have size"),
        (("sphere", (0, 0, 0), (0.0,), 1.0), "cannot have size"),
        (("capsule", (0, 0, 0), (0.1,), 1.0), "lacks an end"),
        (("sphere", (0, 0, 0), (0.1,), 1.0, (0, 0, 1)), "has an end"),
    ],
)
def test_impossible_shapes(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        Shape(*arguments)


# ---- mistakes ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"name": "smplh"}, "unknown body 'smplh'; known: smpl, smplx"),
        ({"strength": "hulk"}, "strength must be 'paper' or 'human', not 'hulk'"),
        ({"limits": "none"}, "limits must be 'paper' or 'anatomical', not 'none'"),
        ({"equipment": ["spoon"]}, "unknown equipment 'spoon'; known: club, racket"),
        ({"name": "smplx", "equipment": ["sword"]}, "'sword' needs a link 'R_Hand'"),
    ],
)
def test_mistakes_get_a_sentence(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        load_body(**arguments)


def test_unknown_names_get_a_sentence(body):
    with pytest.raises(KeyError, match="no link 'Tail'"):
        body.link_index("Tail")
    with pytest.raises(KeyError, match="no dof 'Tail_x'"):
        body.dof_index("Tail_x")
