"""Where a number comes from: commit, versions, hardware. Beside every result and every run."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import torch

PACKAGES = ("mujoco", "mujoco-warp", "warp-lang", "drake", "casadi", "torch", "numpy")


@cache
def commit() -> str:
    """The project's commit, with ``+`` where files differ from it; ``unknown`` outside git.

    A copy without its repository (a training host) may be told by OLYMPICS_OPT_COMMIT.
    """
    told = os.environ.get("OLYMPICS_OPT_COMMIT", "")
    if told:
        return told
    root = Path(__file__).resolve().parents[1]

    def git(*args: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(root), *args], capture_output=True, text=True, timeout=20
        )
        return done.stdout.strip() if done.returncode == 0 else ""

    try:
        if git("rev-parse", "--show-toplevel") != str(root):
            return "unknown"  # installed inside somebody else's repository
        head = git("rev-parse", "--short=12", "HEAD")
        changed = git("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return f"{head}{'+' if changed else ''}" if head else "unknown"


@cache
def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide numbers, where installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


@cache
def hardware() -> str:
    """One line: accelerator if there is one, processor, cores usable."""
    cpu = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                cpu = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    line = f"{cpu}, {cores} cores"
    if torch.cuda.is_available():
        names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
        line = f"{len(names)} x {names[0]}, {line}"
    return line


def portable(config: dict[str, Any]) -> dict[str, Any]:
    """A run's settings without what is only true on the machine where it ran."""
    config = {k: v for k, v in config.items() if k not in ("out", "resume", "quiet", "device")}
    if isinstance(config.get("clips"), list):
        config["clips"] = [Path(p).name for p in config["clips"]]
    for name in ("init", "prior", "tracker"):
        if config.get(name):
            config[name] = Path(config[name]).name
    return config
