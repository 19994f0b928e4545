"""Packed clips against the clips themselves; what is refused."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from sports.humanoid.body import load_body
from tests.warmstart.clips_made import random_clip
from warmstart.bank import demonstration_files
from warmstart.clip import Clip
from warmstart.library import Library, load_library, pack, pack_files
from warmstart.npz import write_npz

BODY = load_body("smpl")


def named(count: int, **meta) -> list[tuple[str, Clip]]:
    return [(f"arch{i % 3}/clip_{i}", random_clip(i, 20 + i, **meta)) for i in range(count)]


def test_a_file_gives_the_motions_back(tmp_path):
    clips = named(5, licence="MIT", sport="run", source="a studio")
    library = pack(clips)
    library.save(tmp_path / "motions.npz")
    again = Library.load(tmp_path / "motions.npz")
    assert again.digest == library.digest
    for i, (name, clip) in enumerate(clips):
        qpos = again.qpos(i)
        assert len(qpos) == clip.num_frames
        moved = clip.qpos[:, :3] - [*clip.qpos[0, :2], 0.0]
        np.testing.assert_allclose(qpos[:, :3], moved, atol=1e-6)
        np.testing.assert_allclose(qpos[:, 3:7], clip.qpos[:, 3:7], atol=1e-6)
        # Half a unit of rounding is 5e-5 rad.
        np.testing.assert_allclose(qpos[:, 7:], clip.qpos[:, 7:], atol=5.1e-5)
        origin = again.origins[i]
        assert (origin.name, origin.archive) == (name, name.split("/")[0])
        assert (origin.licence, origin.tag, origin.source) == ("MIT", "run", "a studio")
    card = again.card()["archives"]
    assert sum(row["clips"] for row in card.values()) == 5
    assert all(row["licences"] == ["MIT"] for row in card.values())


def test_hinges_beyond_half_a_turn_keep_their_rotation():
    clip = random_clip(0)
    qpos = clip.qpos.copy()
    qpos[10:, 7:] += 2 * np.pi * np.random.default_rng(0).integers(-2, 3, BODY.num_dofs)
    path = pack([("a", Clip(30.0, "smpl", qpos, clip.qvel))]).qpos(0)
    assert np.abs(path[:, 7:]).max() <= np.pi + 1e-4
    np.testing.assert_allclose(np.exp(1j * path[:, 7:]), np.exp(1j * qpos[:, 7:]), atol=1e-4)


def test_clips_of_other_rates_are_resampled():
    clip = random_clip(3, frames=121, fps=120.0)
    path = pack([("a", clip)]).qpos(0)
    assert len(path) == 31
    np.testing.assert_allclose(path[:, 7:], clip.qpos[::4, 7:], atol=1e-3)


def test_the_split_is_by_the_hash_of_the_name():
    library = pack([(f"a/{i}", random_clip(i % 4, 9)) for i in range(300)])
    train, held = library.split("train"), library.split("held_out")
    names = {o.name for o in held.origins}
    assert names == {
        n
        for n in (f"a/{i}" for i in range(300))
        if int.from_bytes(hashlib.sha256(n.encode()).digest(), "big") % 100 < 10
    }
    assert names.isdisjoint(o.name for o in train.origins)
    assert len(train.origins) + len(held.origins) == 300
    # 10 per cent of 300, within four standard deviations.
    assert abs(len(names) - 30) < 4 * np.sqrt(300 * 0.1 * 0.9)
    # Fewer clips: each stays in its split, with its own motion.
    some = library.chosen([7, 2, 150])
    assert [o.held_out for o in some.origins] == [library.origins[i].held_out for i in (7, 2, 150)]
    np.testing.assert_array_equal(some.qpos(1), library.qpos(2))


def test_some_archives_can_be_kept():
    library = pack(named(6))
    some = library.only(["arch2", "arch0"])
    assert [o.name for o in some.origins] == [f"arch{i % 3}/clip_{i}" for i in (0, 2, 3, 5)]
    np.testing.assert_array_equal(some.qpos(3), library.qpos(5))
    with pytest.raises(ValueError, match="no archive 'arch9'; there are: arch0, arch1, arch2"):
        library.only(["arch0", "arch9"])


def test_an_hour_fits_thirty_megabytes(tmp_path):
    # Noise cannot be compressed: no motion takes more.
    rng = np.random.default_rng(0)
    frames = 2 * 60 * 30 + 1
    quat = rng.normal(size=(frames, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    root = np.concatenate([rng.normal(size=(frames, 3)), quat], axis=1)
    origins = pack(named(1)).origins
    library = Library("smpl", origins, np.array([frames]), root, rng.uniform(-3, 3, (frames, 69)))
    library.save(tmp_path / "noise.npz")
    assert (tmp_path / "noise.npz").stat().st_size * 30 < 30e6


def test_velocities_of_simulated_clips_are_kept_and_of_recordings_are_not(tmp_path):
    recorded, clip = random_clip(0, 25), random_clip(1, 41, fps=60.0)
    # Other velocities than differences would give; targets say that it was simulated.
    qvel = clip.qvel + np.random.default_rng(0).normal(0, 3, clip.qvel.shape)
    simulated = Clip(60.0, "smpl", clip.qpos, qvel, ctrl=clip.qpos[:, 7:])
    library = pack([("a", recorded), ("b", simulated), ("c", random_clip(2, 30))])
    library.save(tmp_path / "motions.npz")
    again = Library.load(tmp_path / "motions.npz")
    assert again.digest == library.digest
    assert again.qvel(0) is None and again.qvel(2) is None
    found = again.qvel(1)
    assert found is not None and found.shape == (21, 75)
    # Half precision: 11 bits.
    np.testing.assert_allclose(found, qvel[::2], rtol=2**-11, atol=1e-6)
    # A choice keeps them with their clip; one of recordings alone has none.
    turned = again.chosen([2, 1])
    np.testing.assert_array_equal(turned.qvel(1), found)
    assert turned.qvel(0) is None and again.chosen([0, 2]).velocities is None
    # Other velocities are another motion.
    other = pack([("a", recorded), ("b", replace(simulated, qvel=clip.qvel))])
    assert other.digest != library.chosen([0, 1]).digest


def test_shipped_demonstrations_pack_with_licence_and_sport():
    library = pack_files([demonstration_files("high_jump")[0], demonstration_files("tennis")[0]])
    assert {o.tag for o in library.origins} == {"high_jump", "tennis"}
    assert {o.licence for o in library.origins} == {"Apache-2.0"}
    assert {o.archive for o in library.origins} == {"demonstrations"}


def test_a_folder_a_file_and_a_library_read_alike(tmp_path):
    for name, clip in named(4):
        clip.save(tmp_path / "clips" / f"{name}.npz")
    folder = load_library([tmp_path / "clips"])
    folder.save(tmp_path / "library.npz")
    assert load_library([tmp_path / "library.npz"]).digest == folder.digest
    one = load_library([tmp_path / "clips" / "arch0" / "clip_0.npz"])
    assert len(one.origins) == 1 and one.origins[0].name == "clip_0"


def test_wrong_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="there are no clips to track"):
        load_library([])
    with pytest.raises(ValueError, match="there is nothing at"):
        load_library([tmp_path / "none"])
    (tmp_path / "text.npz").write_text("no zip")
    with pytest.raises(ValueError, match=r"text\.npz is not a readable clip library"):
        load_library([tmp_path / "text.npz"])
    with pytest.raises(ValueError, match=r"'smpl'.*'smplx'"):
        pack([("a", random_clip(0)), ("b", random_clip(0, body="smplx"))])
    with pytest.raises(ValueError, match="none of the clips has 8 frames"):
        pack([("a", random_clip(0, frames=5))])
    random_clip(0).save(tmp_path / "one" / "x.npz")
    with pytest.raises(ValueError, match="two clips are named 'x'"):
        pack_files([tmp_path / "one", tmp_path / "one"])
    with pytest.raises(ValueError, match="unknown split 'test'"):
        pack(named(3)).split("test")  # type: ignore[arg-type]


def test_a_damaged_library_is_refused(tmp_path):
    library = pack(named(3))
    some = np.zeros((int(library.lengths.sum()), 75), np.float16)
    some[5] = np.nan
    arrays = {
        "lengths": library.lengths.astype(np.int32),
        "root": library.root.astype(np.float32),
        "joints": np.round(library.joints * 1e4).astype(np.int16),
    }
    head = {
        "format": "olympics-opt clip library 1",
        "fps": 30.0,
        "body": "smpl",
        "clips": [vars(o) for o in library.origins],
    }
    path = tmp_path / "damaged.npz"
    for change, sentence in (
        ({"lengths": arrays["lengths"] + 1}, "do not add up"),
        ({"root": arrays["root"][:-1]}, "do not add up|frames are not"),
        ({"joints": arrays["joints"][:, :-1]}, "frames are not those of body 'smpl'"),
        ({"root": np.full_like(arrays["root"], np.nan)}, "not finite"),
        ({"root": 0 * arrays["root"]}, "not of length 1"),
        ({"velocities": some}, "velocities that are not finite"),
        ({"velocities": some[:, 1:]}, "velocities are not those of body 'smpl'"),
    ):
        write_npz(path, arrays | change, head)
        with pytest.raises(ValueError, match=sentence):
            Library.load(path)
    for change, sentence in (
        ({"body": "robot"}, "damaged.npz"),
        ({"format": "olympics-opt clip 1"}, "its format is"),
        ({"fps": 60.0}, "not a readable clip library"),
        ({"clips": [{"name": "a"}] * 3}, "not a readable clip library"),
        ({"clips": head["clips"][:2]}, "another number of clips"),
    ):
        write_npz(path, arrays, head | change)
        with pytest.raises(ValueError, match=sentence):
            Library.load(path)
