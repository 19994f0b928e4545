"""Two processes that train together on the CPU, through gloo: what they share is one process's."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from safetensors.torch import load_file

from rl.checkpoint import checkpoints, load_checkpoint
from rl.host import join_ranks
from rl.runlog import read_progress
from rl.train import main, train
from tests.rl import rank_work
from tests.rl.toy import toy_config, toy_env
from tests.warmstart.clips_made import random_clip
from warmstart.library import pack

ROOT = Path(__file__).resolve().parents[2]
LAUNCH = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
LAUNCH += ["--local-addr", "127.0.0.1"]


def launch(*args: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [*LAUNCH, *args], cwd=ROOT, env=env, capture_output=True, text=True, timeout=200
    )


@pytest.fixture(scope="module")
def together(tmp_path_factory) -> Path:
    """Folder with what two ranks wrote."""
    folder = tmp_path_factory.mktemp("ranks")
    done = launch(str(Path(rank_work.__file__)), str(folder))
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.fixture(scope="module")
def ranks(together) -> list[dict[str, torch.Tensor]]:
    return [load_file(together / f"{r}.safetensors") for r in (0, 1)]


def test_all_ranks_hold_the_same_bits(ranks):
    zero, one = ranks
    assert zero.keys() == one.keys()
    for name, x in zero.items():
        if not name.endswith("/own"):
            assert torch.equal(x, one[name]), name
    # though each saw motion of its own
    assert not torch.equal(zero["style/own"], one["style/own"])


def test_charges_are_held_to_the_mean_pay_of_all_ranks(ranks):
    """4 are paid in the mean and 3 asked for: 2 may be taken, two thirds of each own."""
    for rank, found in enumerate(ranks):
        torch.testing.assert_close(found["charges/factor"], torch.tensor(2 / 3))
        torch.testing.assert_close(found["charges/share"], torch.tensor(0.5))
        own = torch.full((3, 1), -(1.0 + 4.0 * rank) * 2 / 3)
        torch.testing.assert_close(found["charges/own"], own)


def test_the_mean_gradient_is_that_of_one_process_with_all_worlds(ranks):
    alone = rank_work.gradient(slice(None))
    names = [k for k in alone if k.startswith("gradient/")]
    assert len(names) == 12 and all(float(alone[k].abs().max()) > 1e-5 for k in names)
    for name, x in alone.items():
        torch.testing.assert_close(ranks[0][f"learn/{name}"], x, rtol=1e-5, atol=1e-6, msg=name)


def test_merged_statistics_are_those_of_all_the_data(ranks):
    torch.testing.assert_close(
        ranks[0]["normaliser/total"], rank_work.normaliser(slice(None))["total"], rtol=1e-12, atol=0
    )
    data = torch.randn(2, rank_work.ROWS, 4, generator=torch.Generator().manual_seed(3))
    data = data * 3.0 + 100.0
    data[:, rank_work.ROWS // 2 :] += 50.0
    count, mean, squares = ranks[0]["normaliser/total"].split([1, 4, 4])
    flat = data.flatten(0, 1).double()
    assert float(count) == len(flat)
    torch.testing.assert_close(mean, flat.mean(0))
    torch.testing.assert_close(squares / count, flat.var(0, correction=0))


def test_failures_of_all_ranks_count_as_if_one_had_seen_them(ranks):
    alone = rank_work.sampling(0, 1)["failure"]
    torch.testing.assert_close(ranks[0]["sampling/failure"], alone, rtol=1e-12, atol=0)
    assert ((alone[:4] > 0.0) & (alone[:4] < 1.0)).all()


def test_sums_and_means_go_in_one_message(ranks):
    assert ranks[1]["message/sums"].tolist() == [3.0, 4.0]
    assert ranks[1]["message/means"].tolist() == [2.0]


def test_a_signal_to_one_rank_and_the_clock_stop_all(together):
    assert [(together / f"stopped{r}").read_text() for r in (0, 1)] == ["signal 3"] * 2
    timed = [(together / f"timed{r}").read_text() for r in (0, 1)]
    assert timed[0] == timed[1] and timed[0].startswith("minutes ")


def test_a_run_of_two_ranks_goes_on(together):
    rows = read_progress(together / "run")
    assert [r["iteration"] for r in rows] == [1, 2, 3, 4, 5, 6]
    assert [r["samples"] for r in rows] == [2048 * n for n in range(1, 7)]
    assert json.loads((together / "run" / "config.json").read_text())["ranks"] == 2
    last = checkpoints(together / "run")[-1]
    zero, one = (load_checkpoint(last, r)[1] for r in (0, 1))
    for name, x in zero.items():
        if name.startswith("agent/") and name != "agent/generator":
            assert torch.equal(x, one[name]), name
    assert not torch.equal(zero["env/x"], one["env/x"])
    assert not torch.equal(zero["agent/generator"], one["agent/generator"])


def test_a_run_of_two_ranks_goes_on_with_one_and_back(together, tmp_path):
    """The learner is kept; a rank without a state of its own takes another's worlds, not its
    noise."""
    shutil.copytree(together / "run", tmp_path / "run")
    for part in checkpoints(tmp_path / "run")[-1].glob("rank1*"):  # not needed for it
        part.unlink()
    before = load_checkpoint(checkpoints(tmp_path / "run")[-1])[1]
    alone = train(toy_config(tmp_path / "run", samples=7 * 2048, resume=True), environment=toy_env)
    assert alone.samples == 7 * 2048 and alone.iterations == 8  # 1024 each now
    after, state = load_checkpoint(alone.checkpoint)[1], json.loads
    assert (
        float(after["agent/obs_norm.total"][0]) == float(before["agent/obs_norm.total"][0]) + 2048
    )
    assert state((alone.checkpoint / "state.json").read_text())["ranks"] == 1
    script = tmp_path / "again.py"
    script.write_text(
        "import sys, pathlib, torch\n"
        "from rl.train import train\n"
        "from tests.rl.toy import toy_config, toy_env\n"
        "torch.set_num_threads(1)\n"
        "run = toy_config(pathlib.Path(sys.argv[1]), samples=9 * 2048, resume=True, quiet=False)\n"
        "train(run, environment=toy_env)\n"
    )
    done = launch(str(script), str(tmp_path / "run"))
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.count("worlds of 1 processes: the others begin with copies") == 1
    zero, one = (load_checkpoint(checkpoints(tmp_path / "run")[-1], r)[1] for r in (0, 1))
    assert torch.equal(zero["agent/actor.head.weight"], one["agent/actor.head.weight"])
    assert not torch.equal(zero["env/x"], one["env/x"])
    assert not torch.equal(zero["agent/generator"], one["agent/generator"])


def test_the_log_tells_own_worlds_from_others(together):
    """Of ranks that play the task's own worlds and of the others, apart and together."""
    rows = read_progress(together / "both")
    assert len(rows) == 2 and json.loads((together / "both" / "config.json").read_text())
    told = [r for r in rows if r["own/distance"] is not None and r["others/distance"] is not None]
    assert told, "episodes ended in both"
    for row in told:
        both, own, others = (float(row[f"{k}/distance"]) for k in ("metrics", "own", "others"))  # type: ignore[arg-type]
        assert min(own, others) <= both <= max(own, others) and own != others
    last = checkpoints(together / "both")[-1]
    zero, one = (load_checkpoint(last, r)[1] for r in (0, 1))
    assert torch.equal(zero["agent/actor.head.weight"], one["agent/actor.head.weight"])


def test_more_processes_than_gpus_are_refused_with_a_sentence(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("WORLD_SIZE", "4")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(ValueError, match="4 processes need 4 GPUs, and this machine has 2"):
        join_ranks()
    with pytest.raises(ValueError, match="cuda:1 names one GPU for 4 processes"):
        join_ranks("cuda:1")
    assert main(["long_jump", "--out", str(tmp_path / "run")]) == 2
    assert "--nproc-per-node 2" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("gpus", "rank", "own", "backend"), [(1, 1, 0, "gloo"), (2, 3, 1, "gloo"), (4, 3, 3, "nccl")]
)
def test_processes_that_may_share_take_gpus_in_turn(monkeypatch, gpus, rank, own, backend):
    """As those of both worlds do: NCCL refuses two processes on one GPU."""
    monkeypatch.setenv("WORLD_SIZE", "4")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    monkeypatch.setenv("LOCAL_RANK", str(rank))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    taken, groups = [], []
    monkeypatch.setattr(torch.cuda, "set_device", taken.append)
    monkeypatch.setattr(dist, "init_process_group", lambda kind, **_: groups.append(kind))
    assert join_ranks(share=True)
    assert taken == [torch.device("cuda", own)] and groups == [backend]


def test_trackers_of_two_ranks_learn_from_each_others_failures(tmp_path):
    """The command line itself."""
    clips = tmp_path / "clips.npz"
    pack([("one", random_clip(0)), ("two", random_clip(1, 40))]).save(clips)
    run = tmp_path / "run"
    small = [
        "--ppo.hidden",
        "16",
        "--ppo.steps",
        "8",
        "--ppo.minibatches",
        "1",
        "--ppo.epochs",
        "1",
    ]
    args = ["tracking", "--clips", str(clips), "--task.split", "all", "--worlds", "8"]
    done = launch("-m", "rl.train", *args, *small, "--out", str(run), "--samples", "512")
    assert done.returncode == 0, done.stderr[-3000:]
    assert "2 processes with 8 worlds each" in done.stdout
    assert done.stdout.count("stopped by samples after 512 samples") == 1
    zero, one = (load_checkpoint(checkpoints(run)[-1], r)[1] for r in (0, 1))
    assert torch.equal(zero["env/tracking/failure"], one["env/tracking/failure"])
    assert float(zero["env/tracking/failure"].min()) < 1.0
    assert not torch.equal(zero["env/qpos"], one["env/qpos"])
