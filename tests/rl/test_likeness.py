import dataclasses
import hashlib
import json

import numpy as np
import pytest

from rl.evaluate import evaluate
from rl.likeness import likeness_of_episodes, likeness_of_policy, panel
from rl.likeness_motion import from_recording, read_motions, seen_in_training
from rl.likeness_reference import (
    FIGURES,
    SHIPPED,
    Reference,
    non_commercial,
    reference_of_library,
)
from rl.two_sample import classifier_accuracy, frechet
from tests.rl.motions_still import BODY, lifted, slid, standing, swinging
from warmstart.clip import Clip
from warmstart.library import Origin, pack

ARMS = ("L_Shoulder_x", "R_Shoulder_x", "L_Elbow_z", "R_Elbow_z")


@pytest.fixture(scope="module")
def people() -> Reference:
    return Reference.load()


def held_out(people: Reference, name: str) -> bool:
    return Origin(name, "", "", "", "").held_out


def test_shipped_reference_is_of_open_recordings_that_are_held_out(people: Reference) -> None:
    card = json.loads(SHIPPED.with_suffix(".json").read_text())
    assert card["sha256"] == hashlib.sha256(SHIPPED.read_bytes()).hexdigest()
    assert card["split"] == "held_out" and all(held_out(people, name) for name in people.names)
    assert not any(non_commercial(licence) for licence in people.licences)
    assert "demonstrations" not in people.groups
    assert SHIPPED.stat().st_size < 300_000
    assert set(card["archives"]) == set(people.groups)
    fresh = dataclasses.replace(people, known_floors=None).floors  # the file's are not just claimed
    for name, row in fresh.items():
        for kind in ("archives", "halves", "clips"):
            assert row[kind] == pytest.approx(
                people.floors[name][kind], abs=0.05 if name == "classifier" else 0.1
            )


def test_held_out_people_pass_among_themselves(people: Reference) -> None:
    # Divided by clip the classifier can but guess; each archive is as near to the others as
    # allowed, but for one of tumbling in 15 windows.
    assert np.mean(people.floors["classifier"]["clips"]) == pytest.approx(0.5, abs=0.1)
    passed = {}
    for archive in sorted(set(people.groups)):
        mine = np.array([people.groups[i] == archive for i in people.clip_of])
        if mine.sum() < 8:
            continue
        others = people.without((), [archive])
        passed[archive] = (
            frechet(people.features[mine], others.features) < (people.floors["frechet"]["high"])
        )
    assert sum(passed.values()) >= len(passed) - 1 and len(passed) >= 5
    for name in FIGURES:
        band = people.band(name)
        inside = people.table[:, FIGURES.index(name)] <= band["high"]
        assert inside.mean() > 0.85


@pytest.fixture(scope="module")
def jumps() -> dict:
    played = evaluate("pretrained", "long_jump", trials=3, num_worlds=3, record_worlds=(0, 1, 2))
    return {"result": played.result, "recordings": played.recordings}


def test_a_policy_that_exploits_is_told_from_people(jumps: dict, people: Reference) -> None:
    found = likeness_of_episodes(jumps["result"], jumps["recordings"], {}, people)
    rows = found["likeness"]
    for name in ("jerk", "skating", "penetration", "torque", "torque_rate", "frechet"):
        assert rows[name]["within"] is False, name
    assert rows["classifier"]["within"] is False and rows["classifier"]["mean"] > 0.95
    # Much further from people than any of their archives is from the others.
    assert rows["frechet"]["mean"] > 2.0 * max(people.floors["frechet"]["archives"])
    assert found["human_like"]["within"] <= 2
    assert found["main"]["metric"] == "success" and found["trials"] == 3
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_panel_tells_made_up_faults_one_by_one(people: Reference) -> None:
    fine = swinging(swinging(standing(), 0.5, 1.0, ARMS), 0.3, 0.5, ("Chest_z", "Head_z"))
    faults = {
        "": fine,
        "jerk": swinging(fine, 0.02, 12.0, ARMS),
        "skating": slid(fine, 1.0),
        "penetration": lifted(fine, -0.02),
    }
    for fault, motion in faults.items():
        rows = panel([motion], people)["likeness"]
        wrong = {name for name in FIGURES if rows[name]["within"] is False}
        assert wrong == ({fault} if fault else set()), fault
    rows = panel([fine], people)["likeness"]
    assert rows["torque"]["mean"] is None and rows["torque"]["within"] is None  # no forces known


def test_clips_that_training_saw_are_left_out(people: Reference) -> None:
    name = people.names[0]
    folderless = name.split("/")[-1]
    card = {"algo": "amp", "config": {"clips": ["x.npz", f"/somewhere/{folderless}.npz"]}}
    found = panel([standing()], people, seen=seen_in_training(card))
    assert found["reference"]["left_out"] == [name]
    assert found["reference"]["clips"] == len(people.names) - 1
    # So is a clip that is measured itself: it is no evidence for itself.
    found = panel([dataclasses.replace(standing(), name=name)], people)
    assert found["reference"]["left_out"] == [name]
    assert name not in people.without({folderless}).window_names()


def test_archives_are_left_out_whose_held_out_clips_training_used(people: Reference) -> None:
    library = {"digest": "d", "archives": {"cmu": {}, "mass": {}}}
    plain = {"library": library, "config": {"options": {"split": "train"}, "clips": ["lib.npz"]}}
    assert seen_in_training(plain).archives == frozenset()
    every = {"library": library, "config": {"options": {"split": "all"}, "clips": ["lib.npz"]}}
    for card in (every, {"algo": "latent", "prior": {"tracker": every}}):
        seen = seen_in_training(card)
        assert seen.archives == {"cmu", "mass"}
        left = people.without(seen.clips, seen.archives)
        assert not {"cmu", "mass"} & set(left.groups) and len(left.features) < len(people.features)
    with pytest.raises(ValueError, match="folder 'clips'"):
        seen_in_training({"algo": "amp", "config": {"clips": ["clips"]}})
    with pytest.raises(ValueError, match="nearly all"):
        people.without((), set(people.groups))


def clips_of(kind: str, count: int) -> list[tuple[str, Clip]]:
    """Swinging athletes of an archive, whose names are such that all are held out."""
    found, i = [], 0
    while len(found) < count:
        name, i = f"{kind}/{i}", i + 1
        if Origin(name, "", "", "", "").held_out:
            motion = swinging(standing(61), 0.3 + 0.02 * len(found), 1.0 + 0.1 * len(found), ARMS)
            still = np.zeros((61, 6 + BODY.num_dofs))
            meta = {"licence": "MIT" if kind != "closed" else "CC BY-NC 4.0"}
            clip = Clip(30.0, "smpl", motion.qpos, still, meta=meta)
            found.append((name, clip))
    return found


def test_reference_of_a_library_takes_held_out_people_only(tmp_path) -> None:
    named = [*clips_of("open", 8), *clips_of("closed", 4)]
    seen = [(f"open/seen{i}", c) for i, (_, c) in enumerate(named[:6])]
    seen = [(n, c) for n, c in seen if not Origin(n, "", "", "", "").held_out]
    (where, clip) = clips_of("demonstrations", 1)[0]
    made = dataclasses.replace(clip, meta={"problem": "golf"})
    library = pack([*named, *seen, (where, made)])
    full = reference_of_library(library)
    assert sorted(full.names) == sorted(n for n, _ in named)
    kept = reference_of_library(library, open_only=True)
    assert set(kept.groups) == {"open"} and set(kept.licences) == {"MIT"}
    kept.save(tmp_path / "r.npz")
    again = Reference.load(tmp_path / "r.npz")
    np.testing.assert_allclose(again.features, kept.features, rtol=1e-6)
    assert again.names == kept.names and again.floors == kept.floors
    assert again.band("jerk")["high"] == pytest.approx(kept.band("jerk")["high"], rel=1e-6)
    with pytest.raises(ValueError, match="held_out"):
        reference_of_library(pack(seen))
    (tmp_path / "r.npz").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="not a readable"):
        Reference.load(tmp_path / "r.npz")


def test_same_motions_are_near_and_shifted_ones_are_told(people: Reference) -> None:
    # Halves of the reference by clip, and the same halves with one of them moved.
    rng = np.random.default_rng(0)
    side = rng.permutation(len(people.names)) % 2 == 0
    rows = side[people.clip_of]
    a, b = people.features[rows], people.features[~rows]
    names = np.asarray(people.window_names())
    near = classifier_accuracy(a, list(names[rows]), b, list(names[~rows]))
    far = classifier_accuracy(a, list(names[rows]), b + 3.0, list(names[~rows]))
    assert near < 0.75 and far > 0.97
    assert frechet(a, b + 3.0) > 5.0 * frechet(a, b)


def test_motions_are_read_from_recordings_clips_libraries_and_folders(jumps, tmp_path) -> None:
    recording = jumps["recordings"]["world_0"]
    recording.save(tmp_path / "episode.npz")
    (read,) = read_motions(tmp_path / "episode.npz")
    (direct,) = from_recording(recording)
    np.testing.assert_allclose(read.qpos, direct.qpos, atol=1e-6)
    assert read.drive is not None and direct.drive is not None
    np.testing.assert_allclose(read.drive.torque, direct.drive.torque, rtol=1e-3, atol=1e-2)
    clips = clips_of("open", 2)
    clips[0][1].save(tmp_path / "clip.npz")
    pack(clips).save(tmp_path / "two.npz")
    assert len(read_motions(tmp_path / "clip.npz")) == 1
    assert [m.name for m in read_motions(tmp_path / "two.npz")] == [n for n, _ in clips]
    assert len(read_motions(tmp_path)) == 4
    (tmp_path / "bad.npz").write_bytes(b"bad")
    with pytest.raises(ValueError, match="no recording, no clip"):
        read_motions(tmp_path / "bad.npz")
    with pytest.raises(ValueError, match="nothing at"):
        read_motions(tmp_path / "none")


def test_frame_rate_of_the_control_does_not_change_the_figures(jumps) -> None:
    recording = jumps["recordings"]["world_0"]
    (plain,) = from_recording(recording)
    from rl.likeness_motion import from_clip
    from warmstart.clip import finite_difference_qvel

    qpos = plain.qpos[:100]
    clip = Clip(30.0, "smpl", qpos, finite_difference_qvel(BODY, qpos, 30.0))
    fine = from_clip(clip.resample(120.0), "fine")
    assert fine.qpos.shape == qpos.shape
    np.testing.assert_allclose(fine.qpos[:, :7], qpos[:, :7], atol=1e-5)


def test_episodes_too_short_for_windows_have_no_distribution(people: Reference) -> None:
    found = likeness_of_policy("random", "long_jump", people, trials=2)
    rows = found["likeness"]
    assert rows["frechet"]["mean"] is None and rows["classifier"]["within"] is None
    assert rows["torque"]["within"] is False
    assert found["human_like"]["of"] < 8


def test_a_simulated_ground_may_yield_as_it_does_under_the_demonstrations(
    people: Reference,
) -> None:
    from rl.likeness_motion import from_clip
    from rl.likeness_reference import GROUND, PAD
    from rl.likeness_terms import figures
    from warmstart.bank import demonstration_files

    assert people.band("penetration")["high"] == PAD
    assert people.band("penetration", simulated=True)["high"] == GROUND
    deepest = 0.0
    for file in demonstration_files("high_jump"):
        motion = from_clip(Clip.load(file), file.stem)
        assert motion.simulated
        deepest = max(deepest, figures(motion)["penetration"])
        row = panel([motion], people)["likeness"]["penetration"]
        assert row["within"] and row["human"]["high"] == GROUND
    assert PAD < deepest < GROUND
