"""Styles of the high jump: what the shipped motions do over the bar, and the programs' rules."""

from __future__ import annotations

import numpy as np
import pytest

from sports import high_jump as task
from sports.humanoid.body import load_body
from warmstart import rotation
from warmstart.bank import demonstration_files
from warmstart.clip import Clip
from warmstart.outcome import cleared_height, link_poses
from warmstart.problems import high_jump, high_jump_styles
from warmstart.solution import Solution

BODY = load_body("smpl")


def links(qpos: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Positions (T, 3) and attitudes (T, 4) by link."""
    pos, quat = link_poses(BODY, qpos)
    names = [link.name for link in BODY.links]
    return (
        {n: pos[:, i] for i, n in enumerate(names)},
        {n: quat[:, i] for i, n in enumerate(names)},
    )


def up(quat: np.ndarray, axis: int) -> np.ndarray:
    """(T,) height of a unit axis of links with attitudes (T, 4)."""
    return rotation.rotate(quat, np.tile(np.eye(3)[axis], (len(quat), 1)))[:, 2]


def is_scissor(qpos: np.ndarray) -> bool:
    """One leg after the other, both nearly straight, under an upright trunk; the lead foot lands
    first. (Tucks clear a low bar one leg after the other too, with bent knees.)"""
    pos, quat = links(qpos)
    over = int(np.argmax(pos["Pelvis"][:, 0] > task.BAR_X))
    across = [int(np.argmax(pos[f"{s}_Ankle"][:, 0] > task.BAR_X)) for s in "RL"]
    knees = qpos[over, [7 + BODY.dof_index(f"{s}_Knee_y") for s in "RL"]]
    return bool(
        across[0] < over < across[1]
        and knees.max() < 1.25  # the program asks for 1.0 at the bar; a frame may come 33 ms later
        and up(quat["Chest"], 2)[over] > 0.7
        and pos["R_Ankle"][-1, 2] < pos["L_Ankle"][-1, 2]
    )


def is_flop(qpos: np.ndarray) -> bool:
    """Over the bar with the chest up and the head first, and down on the back before the feet."""
    pos, quat = links(qpos)
    over = int(np.argmax(pos["Pelvis"][:, 0] > task.BAR_X))
    feet = np.minimum(pos["L_Ankle"][:, 2], pos["R_Ankle"][:, 2])
    return bool(
        up(quat["Pelvis"], 0)[over] > 0.6
        and pos["Head"][over, 0] > task.BAR_X
        and max(pos["L_Ankle"][over, 0], pos["R_Ankle"][over, 0]) < task.BAR_X
        and pos["Chest"][-1, 2] < feet[-1] - 0.3
        and up(quat["Chest"], 0)[-1] > 0.5
    )


def test_shipped_motions_are_of_the_style_that_they_are_named_for():
    """A scissor is one, a flop is one, a tuck is neither, and all of them clear their bar."""
    found = {}
    for path in demonstration_files("high_jump"):
        clip = Clip.load(path)
        flight = clip.times <= clip.meta["events"]["landing"] + 1e-9
        qpos = clip.qpos[flight]
        found[path.stem] = is_scissor(qpos), is_flop(qpos)
        if path.stem.endswith(("_scissor", "_flop")):
            fine = clip.resample(240.0)
            cleared = cleared_height(BODY, fine.times, fine.qpos[: int(flight.sum()) * 8 - 7])
            assert cleared > clip.meta["asked"]["bar_height"]
    assert {"high_jump_1m_human_scissor", "high_jump_1m_human_flop"} <= set(found)
    for name, verdict in found.items():
        assert verdict == (name.endswith("_scissor"), name.endswith("_flop")), name


def test_styles_are_options_and_the_default_is_the_old_one():
    assert high_jump.Config().style == "tuck"
    with pytest.raises(ValueError, match="style must be tuck, scissor or flop, not roll"):
        high_jump.Config(style="roll")  # type: ignore[arg-type]
    tuck = high_jump.transcribe(high_jump.Config(detail=0.3))
    assert [p.name for p in tuck.phases] == ["flat", "toe", "flight"]


@pytest.mark.parametrize("style", ["scissor", "flop"])
def test_key_poses_show_the_style(style):
    """The start point of the solver, seen over the bar."""
    config = high_jump.Config(style=style, detail=0.4)
    program = high_jump.transcribe(config)
    x = high_jump_styles.first_guess(program, style, 1.0)
    q = x[program.q]
    over = program.knots("fall")[0]
    assert q[over, 0] == pytest.approx(task.BAR_X, abs=0.02)
    chest = program.model.motion(q[over]).R_WL[program.model.tree.link("Pelvis")]
    chest = np.array([[float(chest[i, j]) for j in range(3)] for i in range(3)])
    if style == "flop":  # lying on the back, head first
        assert chest[2, 0] > 0.8 and chest[0, 2] > 0.8
    else:
        assert chest[2, 2] > 0.9


@pytest.mark.slow
def test_a_coarse_scissor_is_solved_from_nothing():
    config = high_jump.Config(style="scissor", bar_height=0.9, detail=0.5)
    solution = high_jump.solve(config)
    assert solution.stats["max_violation"] < 1e-5 and solution.stats["style"] == "scissor"
    times = np.linspace(0.0, solution.duration, 5 * len(solution.times))
    qpos = solution.sample(times)["qpos"]
    assert is_scissor(qpos)
    assert cleared_height(BODY, times, qpos) > 0.9
    with pytest.raises(ValueError, match="the guess has phases"):
        high_jump.transcribe(high_jump.Config(detail=0.5)).guess_from(solution)
    assert isinstance(solution, Solution)
