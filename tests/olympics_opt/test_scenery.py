"""Paint and props: the rule books' figures, convex marks, waves that are those of the formula."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from olympics_opt import scenery
from olympics_opt.scenery import Mark, Terrain, dressed, ground_marks, link_color, shape_colors
from olympics_opt.scenery.golf import AREA_X, AREA_Y
from sports.hoop import hoop
from sports.humanoid.body import load_body
from sports.scene import Scene
from tests.olympics_opt.scenes import TASKS, scene_of

WHITE = "#ffffff"
FIELDS = {  # half extents (x, y) within which a sport's white lines lie, m
    "tennis": (11.885, 5.485),
    "fencing": (7.0, 1.0),
    "boxing": (2.5, 2.5),
    "soccer_1v1": (16.0, 10.0),
    "penalty_kick": (16.0, 10.0),
}


def lines(name: str) -> list[np.ndarray]:
    """Corners (n, 2) of the white marks of a task."""
    return [np.array(m.corners) for m in ground_marks(scene_of(name)) if m.color == WHITE]


def has_line(name: str, x: tuple[float, float], y: tuple[float, float]) -> bool:
    """Whether one white mark has exactly this extent."""
    want = np.array([[x[0], y[0]], [x[1], y[1]]])
    return any(
        np.allclose([c.min(0), c.max(0)], want, atol=1e-9) and len(c) == 4 for c in lines(name)
    )


def turns(mark: Mark) -> np.ndarray:
    """Cross products of a mark's neighbouring edges."""
    c = np.array(mark.corners)
    edges = np.roll(c, -1, axis=0) - c
    after = np.roll(edges, -1, axis=0)
    return edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]


@pytest.mark.parametrize("name", [*TASKS, "high_jump", "long_jump"])
def test_marks_are_convex_polygons(name: str) -> None:
    marks = ground_marks(scene_of(name))
    assert marks
    for mark in marks:
        turn = turns(mark)
        assert len(mark.corners) >= 3
        assert (turn > 1e-12).all() or (turn < -1e-12).all()


@pytest.mark.parametrize("name", FIELDS)
def test_lines_lie_in_their_field_and_reach_its_edges(name: str) -> None:
    corners = np.concatenate(lines(name))
    half = np.array(FIELDS[name])
    assert (np.abs(corners) <= half + 1e-9).all()
    assert np.allclose(np.abs(corners).max(0), half)


def test_tennis_court_of_the_itf() -> None:
    for s in (-1, 1):
        # Side lines of singles (8.23 m) and doubles (10.97 m), 5 cm, inside what they bound.
        for y in (4.115, 5.485):
            inner, outer = sorted((s * (y - 0.05), s * y))
            assert has_line("tennis", (-11.885, 11.885), (inner, outer))
        near, far = sorted((s * 6.35, s * 6.40))
        assert has_line("tennis", (near, far), (-4.115, 4.115))
        near, far = sorted((s * 11.785, s * 11.885))
        assert has_line("tennis", (near, far), (-5.485, 5.485))
        assert has_line("tennis", (near, far), (-0.025, 0.025))
    assert has_line("tennis", (-6.40, 6.40), (-0.025, 0.025))
    scene, _ = dressed(scene_of("tennis"))
    (posts,) = (o for o in scene.objects if o.name == "posts")
    assert {round(abs(s.center[1]), 3) for s in posts.shapes} == {5.029}
    (tape,) = (o for o in scene.objects if o.name == "tape")
    assert tape.shapes[0].center[2] + tape.shapes[0].size[2] == pytest.approx(1.0)


def test_table_of_the_ittf_is_painted_on_its_top() -> None:
    scene, _ = dressed(scene_of("table_tennis_1v1"))
    (paint,) = (o for o in scene.objects if o.name == "lines")
    low = np.min([np.subtract(s.center, s.size) for s in paint.shapes], axis=0)
    high = np.max([np.add(s.center, s.size) for s in paint.shapes], axis=0)
    assert np.allclose(high[:2], (1.37, 0.7625)) and np.allclose(low[:2], (-1.37, -0.7625))
    assert 0.759 < low[2] <= 0.76 < high[2] < 0.764
    widths = sorted(2 * min(s.size[:2]) for s in paint.shapes)
    assert widths[1:] == pytest.approx([0.02] * 4)


def test_piste_of_the_fie() -> None:
    for x in (-2.0, 2.0):
        assert has_line("fencing", (x - 0.02, x + 0.02), (-1.0, 1.0))
    last = [m for m in ground_marks(scene_of("fencing")) if m.color == "#cfb9ab"]
    extents = sorted(np.ptp(np.array(m.corners)[:, 0]) for m in last)
    assert extents == pytest.approx([2.0, 2.0])


def two_baskets() -> Scene:
    """A court of 29 m: rims 1.575 m before its end lines."""
    hoops = (*hoop("west", (-12.925, 0.0, 3.05), -1.0), *hoop("east", (12.925, 0.0, 3.05), 1.0))
    return Scene("basketball_1v1", load_body(), objects=hoops)


def test_basketball_court_of_fiba() -> None:
    corners = [np.array(m.corners) for m in ground_marks(two_baskets()) if m.color == WHITE]
    every = np.concatenate(corners)
    assert np.abs(every).max(0) == pytest.approx([14.5, 7.5])
    rim = np.array([12.925, 0.0])
    # The three-point line: outer edge 6.75 m from under the rim, then 0.90 m from the side line.
    away = [np.linalg.norm(c - rim, axis=1) for c in corners]
    arcs = [c for c, r in zip(corners, away) if np.isclose(r.max(), 6.75) and len(c) == 4]
    assert len(arcs) > 10 and all(c[:, 0].max() < 14.5 for c in arcs)
    straight = [c for c in corners if np.isclose(c[:, 1].max(), 6.60) and np.ptp(c[:, 1]) < 0.06]
    assert any(np.isclose(c[:, 0].max(), 14.5) for c in straight)
    bend = rim[0] - math.sqrt(6.75**2 - 6.60**2)
    assert any(np.isclose(c[:, 0].min(), bend) for c in straight)
    # The free-throw line: its far edge 5.80 m from the end line; the key 4.90 m wide.
    line = 14.5 - 5.80
    extents = [np.array([c.min(0), c.max(0)]) for c in corners]
    want = np.array([[line, -2.45], [line + 0.05, 2.45]])
    assert any(np.allclose(e, want) for e in extents)
    assert any(np.allclose(e, -want[::-1]) for e in extents)  # and at the other end
    circle = [c for c in corners if np.isclose(np.linalg.norm(c, axis=1).max(), 1.80)]
    assert len(circle) == 48
    # Of the free throw: under a rim at x = 4.5 the same line is 0.275 m before the athlete.
    assert has_line("free_throw", (0.275, 0.325), (-2.45, 2.45))


def test_cords_hang_from_the_ring_and_the_square_is_on_the_boards_face() -> None:
    scene = two_baskets()
    full, _ = dressed(scene)
    props = {o.name: o for o in full.objects[len(scene.objects) :]}
    assert set(props) == {
        f"{end}_{x}" for end in ("west", "east") for x in ("cords", "square", "post")
    }
    for end, side in (("west", -1.0), ("east", 1.0)):
        tops = np.array([s.center for s in props[f"{end}_cords"].shapes])
        assert np.allclose(np.hypot(tops[:, 0] - side * 12.925, tops[:, 1]), 0.23)
        assert (tops[:, 2] == 3.05).all()
        face = side * (12.925 + 0.375)  # FIBA: 0.15 m behind the ring's inside, which is 0.225 m
        for shape in props[f"{end}_square"].shapes:
            assert 0.0 <= side * (face - shape.center[0]) < 0.005
        low = min(s.center[2] - s.size[2] for s in props[f"{end}_square"].shapes)
        assert low == pytest.approx(3.05, abs=0.03)
        for shape in props[f"{end}_post"].shapes:  # behind the board, out of the ball's way
            assert side * shape.center[0] > side * face and shape.end is not None
            assert side * shape.end[0] > side * face


def test_football_field_of_the_task() -> None:
    corners = lines("penalty_kick")
    spot = [c for c in corners if np.allclose(c.mean(0), (4.0, 0.0))]
    assert len(spot) == 1 and np.ptp(spot[0][:, 0]) == pytest.approx(0.2)
    assert not [c for c in lines("soccer_2v2") if np.allclose(c.mean(0), (4.0, 0.0))]
    circle = [c for c in corners if np.isclose(np.linalg.norm(c, axis=1).max(), 3.0)]
    assert len(circle) == 48
    scene, _ = dressed(scene_of("soccer_2v2"))
    nets = [o for o in scene.objects if scenery.is_net(o.name)]
    assert len(nets) == 8
    for net in nets:
        center, half = np.array(net.shapes[0].center), np.array(net.shapes[0].size)
        assert np.abs(center[0]) - half[0] >= 16.0  # behind the goal line
        assert np.abs(center[1]) - half[1] <= 2.06 and center[2] - half[2] <= 2.06
    one, _ = dressed(scene_of("penalty_kick"))
    assert len([o for o in one.objects if scenery.is_net(o.name)]) == 4


def test_javelin_sector_of_world_athletics() -> None:
    marks = ground_marks(scene_of("javelin"))
    # The foul line: 0.07 m wide, its far edge counts, 0.75 m beyond the sector's sides.
    foul = [c for c in lines("javelin") if np.allclose((c[:, 0].min(), c[:, 0].max()), (1.93, 2.0))]
    beyond = 2.0 + 0.75
    assert len(foul) == 1 and np.abs(foul[0][:, 1]) == pytest.approx([beyond] * 4)
    (sector,) = (m for m in marks if m.color == "#a9c99a")
    x, y = np.array(sector.corners).T
    centre = 2.0 - math.sqrt(8.0**2 - 2.0**2)  # of an arc through the runway's sides
    angle = 2 * math.atan2(y.max(), x.max() - centre)
    assert math.degrees(angle) == pytest.approx(28.96, abs=0.01)
    tens = {m.label: float(np.mean(np.array(m.corners)[:, 0])) for m in marks if " m" in m.label}
    assert tens["10 m"] == pytest.approx(12.0) and tens["90 m"] == pytest.approx(92.0)


def test_hurdles_stand_on_their_ticks() -> None:
    scene = scene_of("hurdling")
    ticks = [m for m in ground_marks(scene) if m.color == "#3f6fa5"]
    at = sorted(float(np.mean(np.array(m.corners)[:, 0])) for m in ticks)
    assert at == pytest.approx(sorted(o.pos[0] for o in scene.objects))
    assert at == pytest.approx([13.72 + 9.14 * k for k in range(10)])


def test_waves_are_those_of_the_formula() -> None:
    a, b = 0.7, 2.9
    ground = Terrain((a, b))
    k = 2 * math.pi / 10.0

    def height(x: float, y: float) -> float:
        r = math.hypot(x, y)
        share = (
            0.0 if r <= 2 else 1.0 if r >= 6 else 3 * ((r - 2) / 4) ** 2 - 2 * ((r - 2) / 4) ** 3
        )
        return 0.25 * (math.cos(k * x + a) + math.cos(k * y + b)) * share

    mesh = ground.mesh(1.0)
    assert mesh.shape == (29, 41, 3)
    assert tuple(mesh[0, 0, :2]) == (AREA_X[0], AREA_Y[0])
    assert tuple(mesh[-1, -1, :2]) == (AREA_X[1], AREA_Y[1])
    for x, y, z in mesh.reshape(-1, 3):
        assert z == pytest.approx(height(x, y), abs=1e-12)
    near = np.hypot(mesh[..., 0], mesh[..., 1]) <= 2
    assert near.any() and (mesh[near, 2] == 0).all()
    assert 0.9 < np.ptp(ground.mesh()[..., 2]) <= 2 * ground.highest == 1.0
    x, y = np.array([8.0]), np.array([3.0])
    n = ground.normal(x, y)[0]
    slope = -0.25 * k * np.array([math.sin(k * 8 + a), math.sin(k * 3 + b)])
    assert np.allclose(-n[:2] / n[2], slope, atol=1e-4)


def test_props_leave_the_state_as_it_is_and_stand_where_the_target_is() -> None:
    for name in TASKS:
        scene = scene_of(name)
        target = np.array([[[1.0, 2.0, 0.3]], [[4.0, 5.0, 0.6]]])
        full, places = dressed(scene, {"target": target})
        assert full.nq == scene.nq
        for drawn, own in zip(full.objects, scene.objects):
            walls = own.name == "walls"  # seen through, or they would hide the ball
            assert replace(drawn, rgba=own.rgba) == own and (drawn == own) != walls
        count = len(full.mocap_objects) - len(scene.mocap_objects)
        assert places.shape[1] == count
        if name in ("golf", "tennis", "table_tennis", "penalty_kick"):
            assert count > 0 and np.allclose(places[:, 0], target[:, 0])
    both = np.arange(12.0).reshape(2, 2, 3)
    _, places = dressed(scene_of("tennis_1v1"), {"target": both})
    assert np.allclose(places, both)
    assert dressed(scene_of("tennis"), {})[1].shape[1] == 0


def test_a_scene_of_no_sport_stays_bare() -> None:
    scene = Scene("any", load_body())
    assert dressed(scene)[0].objects == () and ground_marks(scene) == []
    assert ground_marks(scene_of("soccer_1v1")) == ground_marks(scene_of("soccer_2v2"))


def test_teams_wear_shirts_and_tools_their_own_colours() -> None:
    scene = scene_of("soccer_2v2")
    assert scenery.teams(scene) == (0, 0, 1, 1)
    own = [shape_colors(scene, agent) for agent in range(4)]
    assert own[0] == own[1] and own[2] == own[3]
    for link in scene.body.link_names:
        red, _, blue = (np.array(scenery.rgb(own[a][link][0])) for a in (0, 1, 2))
        assert red[2] > red[0] and blue[0] > blue[2], link  # team 0 blue, team 1 red
    assert link_color("L_Hand", 0) != link_color("R_Hand", 0) != link_color("R_Toe", 0)
    golfer = load_body(equipment=("club",))
    colors = shape_colors(Scene("any", golfer), 0)
    assert len(colors["R_Hand"]) == 2 and link_color("R_Hand") not in colors["R_Hand"]
    player = shape_colors(scene_of("tennis"), 0)["R_Wrist"]
    assert player[0] == link_color("R_Wrist") and len(set(player)) == len(player) == 3
