"""On GPUs only, on two or both on one: ranks agree bit for bit, captured and plain steps too."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(torch.cuda.device_count() < 1, reason="needs a GPU")


@pytest.mark.parametrize("gpus", ["0,1", "0"])
def test_two_processes_learn_the_same_with_and_without_graphs(tmp_path, gpus):
    if torch.cuda.device_count() < len(gpus.split(",")):
        pytest.skip("needs two GPUs")
    script = str(Path(__file__).with_name("rank_work_gpu.py"))
    launch = ["-m", "torch.distributed.run", "--standalone", "--local-addr", "127.0.0.1"]
    launch += ["--nproc-per-node", "2"]
    done = subprocess.run(
        [sys.executable, *launch, script, str(tmp_path)],
        cwd=ROOT,
        env={
            **os.environ,
            "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}",
            "CUDA_VISIBLE_DEVICES": gpus,
        },
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "without a CUDA graph" not in done.stderr
    zero, one = (load_file(tmp_path / f"{r}.safetensors") for r in (0, 1))
    for name, x in zero.items():
        assert torch.equal(x, one[name]), name
        if name.startswith("captured/actor"):
            plain = zero[name.replace("captured", "plain")]
            torch.testing.assert_close(x, plain, rtol=1e-3, atol=1e-4)
    count, mean, _ = zero["moments/total"].split([1, 3, 3])
    assert float(count) == 4.0
    torch.testing.assert_close(mean, torch.tensor([6.5, 7.5, 8.5], dtype=torch.float64))
