"""Times of nested parts by a clock that the test turns, a made-up trace, and a profiled run."""

from __future__ import annotations

import gzip
import json
from types import SimpleNamespace

import pytest

import rl.profiling
from rl.checkpoint import checkpoints
from rl.profiling import Phases, lines, read_trace
from rl.train import main, train
from tests.rl.toy import toy_config, toy_env


def test_the_time_of_a_part_is_without_the_parts_inside(monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(rl.profiling.time, "perf_counter", lambda: clock.now)

    class Inner:
        def work(self, seconds: float) -> float:
            clock.now += seconds
            return 2.0 * seconds

    class Outer:
        inner = Inner()

        def work(self) -> float:
            clock.now += 1.0
            done = self.inner.work(4.0)
            clock.now += 0.5
            return done

    outer, phases = Outer(), Phases(on_gpu=False)
    phases.wrap(outer, "work", "outer")
    phases.wrap(outer.inner, "work", "inner")
    for turn in range(2):
        clock.now += 0.25
        assert outer.work() == 8.0
        outer.inner.work(seconds=0.125)
        assert phases.seconds() == {"the loop": 0.25, "outer": 1.5, "inner": 4.125}, turn


def test_a_trace_is_read_for_work_and_waits(tmp_path):
    def event(kind: str, name: str, begin: float, length: float) -> dict:
        return {"ph": "X", "cat": kind, "name": name, "ts": begin, "dur": length}

    events = [
        event("user_annotation", "rollout", 0.0, 50.0),
        event("gpu_user_annotation", "rollout", 0.0, 100.0),
        event("kernel", "a", 10.0, 20.0),
        event("gpu_memcpy", "b", 20.0, 20.0),  # overlaps by 10
        event("kernel", "c", 90.0, 10.0),
        event("cuda_runtime", "cudaStreamSynchronize", 30.0, 1.0),
        event("cuda_runtime", "cudaStreamSynchronize", 60.0, 1.0),  # after the rollout
        event("cuda_runtime", "cudaLaunchKernel", 31.0, 1.0),
        {"ph": "i", "name": "no duration", "ts": 500.0},
    ]
    path = tmp_path / "trace.json.gz"
    path.write_bytes(gzip.compress(json.dumps({"traceEvents": events}).encode()))
    found = read_trace(path)
    assert found.device_busy == pytest.approx(0.4)
    assert found.waits == {"cudaStreamSynchronize": 1}
    figures = {
        **{"task": "golf", "engine": "warp", "worlds": 2, "ranks": 1, "samples_per_s": 1e5},
        **{"seconds_per_update": {"update": 0.5}, "waits_in_rollouts": {}, "updates_traced": 2},
        **{"trace_device_busy": found.device_busy, "trace_waits": found.waits},
    }
    assert "  1 x cudaStreamSynchronize" in lines(figures, cuda=True)
    quiet = figures | {"trace_waits": {}}
    assert "nothing in the rollout waits for the device" in lines(quiet, cuda=True)


def test_a_profiled_run_tells_its_parts_and_trains_nothing(tmp_path, capsys):
    out = tmp_path / "run"
    small = ["--worlds", "2", "--ppo.hidden", "8", "--ppo.steps", "4", "--ppo.minibatches", "1"]
    assert main(["long_jump", "--out", str(out), *small, "--profile"]) == 0
    told = capsys.readouterr().out
    assert sorted(p.name for p in out.iterdir()) == ["profile.json", "trace.json.gz"]
    found = json.loads((out / "profile.json").read_text())
    parts = found["seconds_per_update"]
    for name in ("simulation", "observations, rewards, resets", "policy", "update"):
        assert parts[name] > 0.0 and name in told
    assert "values and advantages" in parts
    events = json.loads(gzip.decompress((out / "trace.json.gz").read_bytes()))["traceEvents"]
    names = [e["name"] for e in events if e.get("cat") == "user_annotation"]
    assert names.count("rollout") == found["updates_traced"]
    assert names.count("simulation") == 4 * found["updates_traced"]
    # The same folder takes the training afterwards.
    assert main(["long_jump", "--out", str(out), *small, "--samples", "8", "--quiet"]) == 0


def test_profiling_a_run_leaves_it_as_it_was(tmp_path):
    train(toy_config(tmp_path, samples=2048), environment=toy_env)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    summary = train(toy_config(tmp_path, resume=True, profile=True), environment=toy_env)
    assert summary.stopped_by == "profile" and summary.checkpoint.name == "trace.json.gz"
    assert [p.name for p in checkpoints(tmp_path)] == ["step_0000002"]
    assert all(p.read_bytes() == data for p, data in before.items())
