"""On two GPUs only: ranks agree bit for bit, captured and plain steps too."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")


def test_two_gpus_learn_the_same_with_and_without_graphs(tmp_path):
    script = str(Path(__file__).with_name("rank_work_gpu.py"))
    launch = ["-m", "torch.distributed.run", "--standalone", "--local-addr", "127.0.0.1"]
    launch += ["--nproc-per-node", "2"]
    done = subprocess.run(
        [sys.executable, *launch, script, str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"},
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
