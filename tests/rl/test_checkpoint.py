"""Checkpoints: round trips of anything, shards, damage, full disks."""

from __future__ import annotations

import errno
import json
import os

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import rl.checkpoint as module
from rl.checkpoint import CheckpointError, checkpoints, load_checkpoint, save_checkpoint

DTYPES = [torch.float32, torch.float64, torch.bfloat16, torch.int64, torch.uint8, torch.bool]


@given(
    st.lists(
        st.tuples(st.sampled_from(DTYPES), st.lists(st.integers(0, 7), max_size=3)), max_size=6
    )
)
def test_any_tensors_come_back(tmp_path_factory, specs):
    run = tmp_path_factory.mktemp("run")
    tensors = {
        f"part/{i}": (torch.rand(shape) * 200).to(dtype) for i, (dtype, shape) in enumerate(specs)
    }
    path = save_checkpoint(run, 3, {"note": "x"}, tensors)
    state, found = load_checkpoint(path)
    assert state["note"] == "x"
    assert state["iteration"] == 3
    assert set(found) == set(tensors)
    for name, x in tensors.items():
        assert found[name].dtype == x.dtype
        assert found[name].shape == x.shape
        assert torch.equal(found[name], x)


def test_shards_stay_below_their_limit_and_join(tmp_path):
    big = torch.arange(10_000_000, dtype=torch.float32)  # 40 MB
    tensors = {"small": torch.ones(3), "big": big.reshape(100, -1), "last": torch.zeros(2)}
    path = save_checkpoint(tmp_path, 1, {}, tensors)
    sizes = [f.stat().st_size for f in path.glob("*.safetensors")]
    assert len(sizes) >= 3
    assert max(sizes) <= 15 * 2**20
    _, found = load_checkpoint(path)
    assert torch.equal(found["big"], tensors["big"])


def test_the_last_two_are_kept(tmp_path):
    for i in (1, 2, 10, 11):
        save_checkpoint(tmp_path, i, {}, {"x": torch.tensor(float(i))})
    assert [int(p.name[5:]) for p in checkpoints(tmp_path)] == [10, 11]
    save_checkpoint(tmp_path, 11, {}, {"x": torch.tensor(12.0)})  # again, by a signal say
    assert load_checkpoint(checkpoints(tmp_path)[-1])[1]["x"] == 12.0


@pytest.mark.parametrize("after", [0, 1, 2, 3])
def test_a_full_disk_leaves_the_last_checkpoint(tmp_path, monkeypatch, after):
    save_checkpoint(tmp_path, 1, {}, {"x": torch.ones(3)})
    real, calls = os.fsync, []

    def fsync(handle: int) -> None:
        calls.append(handle)
        if len(calls) > after:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(handle)

    monkeypatch.setattr(module.os, "fsync", fsync)
    if after < 3:
        with pytest.raises(CheckpointError, match=r"No space left.*step_0000001.*--resume"):
            save_checkpoint(tmp_path, 2, {}, {"x": torch.zeros(3)})
        assert [p.name for p in checkpoints(tmp_path)] == ["step_0000001"]
        assert torch.equal(load_checkpoint(checkpoints(tmp_path)[-1])[1]["x"], torch.ones(3))
    else:  # the fourth is only the folder's own: the checkpoint is whole by then
        with pytest.raises(CheckpointError):
            save_checkpoint(tmp_path, 2, {}, {"x": torch.zeros(3)})
        assert torch.equal(load_checkpoint(checkpoints(tmp_path)[-1])[1]["x"], torch.zeros(3))
    assert not list((tmp_path / "checkpoints").glob(".*"))


def test_what_a_killed_save_left_is_ignored_and_removed(tmp_path):
    save_checkpoint(tmp_path, 1, {}, {"x": torch.ones(3)})
    torn = tmp_path / "checkpoints" / ".step_0000002.part"
    torn.mkdir()
    (torn / "rank0_000.safetensors").write_bytes(b"half")
    assert [p.name for p in checkpoints(tmp_path)] == ["step_0000001"]
    save_checkpoint(tmp_path, 2, {}, {"x": torch.ones(3)})
    assert not torn.exists()


@given(st.sampled_from(["state.json", "rank0.json", "rank0_000.safetensors"]), st.data())
def test_damage_is_a_sentence(tmp_path_factory, name, data):
    run = tmp_path_factory.mktemp("run")
    path = save_checkpoint(run, 1, {"samples": 3}, {"x": torch.arange(10.0), "y": torch.ones(2)})
    file = path / name
    content = file.read_bytes()
    how = data.draw(st.sampled_from(["cut", "noise", "gone", "list"]))
    if how == "gone":
        file.unlink()
    elif how == "list":
        file.write_bytes(b"[1, 2]")
    elif how == "cut":
        file.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    else:
        file.write_bytes(data.draw(st.binary(max_size=200)))
    with pytest.raises(CheckpointError):
        load_checkpoint(path)


def test_a_foreign_folder_is_a_sentence(tmp_path):
    folder = tmp_path / "checkpoints" / "step_0000001"
    folder.mkdir(parents=True)
    (folder / "state.json").write_text(json.dumps({"format": "something else"}))
    with pytest.raises(CheckpointError, match="not a checkpoint of this project"):
        load_checkpoint(folder)
