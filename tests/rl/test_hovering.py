"""Who hovers: motions of a known acceleration, and the certified jumps, who fall as they should."""

from __future__ import annotations

import numpy as np
import pytest

from olympics_opt.cli import main
from rl.hovering import hovering, supported
from sports.humanoid.body import load_body
from tests.warmstart.clips_made import random_clip
from warmstart.bank import demonstration_files
from warmstart.clip import Clip
from warmstart.library import Library, pack

BODY = load_body("smpl")


def still(height: float, acceleration: float, frames: int = 31) -> np.ndarray:
    """(T, 76) upright, its lowest point at first ``height`` (m) up, on a parabola."""
    t = np.arange(frames) / 30.0
    qpos = np.zeros((frames, 76))
    qpos[:, 3] = 1.0
    qpos[:, 2] = BODY.standing_height(clearance=0.0) + height + 0.5 * acceleration * t**2
    return qpos


def test_who_falls_or_stands_does_not_hover_and_who_stays_up_does():
    assert hovering("smpl", still(6.0, -9.81), 30.0) == 0.0
    assert hovering("smpl", still(6.0, -9.81 + 4.5), 30.0) == 0.0
    assert hovering("smpl", still(0.0, 0.0), 30.0) == 0.0
    assert hovering("smpl", still(0.045, 0.0), 30.0) == 0.0
    # All frames that have two neighbours.
    assert hovering("smpl", still(0.055, 0.0), 30.0) == pytest.approx(29 / 30)
    assert hovering("smpl", still(6.0, -9.81 + 5.5), 30.0) == pytest.approx(29 / 30)
    assert hovering("smpl", still(1.0, 0.0)[:2], 30.0) == 0.0


def test_swinging_limbs_do_not_make_a_fall_a_hovering():
    # The root jerks about the centre of mass, which falls all the same: as simulated.
    for path in [*demonstration_files("long_jump"), *demonstration_files("high_jump")]:
        clip = Clip.load(path)
        assert hovering("smpl", clip.qpos, clip.fps) == 0.0, path.name
        lifted = clip.qpos.copy()
        lifted[:, 2] += 0.3
        assert hovering("smpl", lifted, clip.fps) > 0.15, path.name


def clip_of(qpos: np.ndarray) -> Clip:
    return Clip(30.0, "smpl", qpos, np.zeros((len(qpos), 75)))


def test_hovering_clips_are_left_out_and_named(tmp_path, capsys):
    clips = {"falls": still(6.0, -9.81), "stands": still(0.0, 0.0), "hovers": still(0.5, 0.0)}
    library = pack((f"a/{n}", clip_of(q)) for n, q in clips.items())
    kept, out = supported(library)
    assert [o.name for o in kept.origins] == ["a/falls", "a/stands"]
    assert [n for n, _ in out] == ["a/hovers"] and out[0][1] == pytest.approx(29 / 30)
    with pytest.raises(ValueError, match="no clip of the library is left"):
        supported(library.chosen([2]))
    for name, qpos in clips.items():
        clip_of(qpos).save(tmp_path / "a" / f"{name}.npz")
    target = tmp_path / "library.npz"
    command = ["mocap", "pack", str(tmp_path / "a"), "--out", str(target)]
    assert main(command) == 0 and len(Library.load(target).lengths) == 3
    assert main([*command, "--supported"]) == 0
    assert [o.name for o in Library.load(target).origins] == ["falls", "stands"]
    assert "left out: hovers hovers for 0.97 s" in capsys.readouterr().out


def test_a_path_and_its_mirror_image_hover_as_long():
    clip = random_clip(1, 60)
    one, two = (hovering("smpl", c.qpos, 30.0) for c in (clip, clip.mirrored()))
    # The body is not quite alike on both sides: a frame may differ.
    assert one > 0.5 and two == pytest.approx(one, abs=0.05)
