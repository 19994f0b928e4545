"""A training host has no Drake, no CasADi and no display: what it imports must not need them."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

BLOCK = """
import importlib, sys

class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {blocked}:
            raise ImportError(name + " is blocked in this test")
        return None

sys.meta_path.insert(0, Block())
for name in {modules}:
    importlib.import_module(name)
loaded = {blocked} & set(name.split(".")[0] for name in sys.modules)
assert not loaded, loaded
print("imported", len({modules}))
"""

DRAKE_ENGINE = ("sports.physics.drake", "sports.humanoid.drake_plant", "sports.humanoid.parity")
WARP_ENGINE = ("sports.physics.warp",)
MUJOCO_ENGINE = tuple(
    f"sports.physics.{name}"
    for name in ("athletes", "momentum", "mujoco", "results", "surface", "worlds")
)
HEADLESS = {"pydrake", "casadi", "OpenGL", "glfw", "ray", "tkinter"}


def run_blocked(modules: list[str], blocked: set[str]) -> subprocess.CompletedProcess[str]:
    code = BLOCK.format(modules=modules, blocked=blocked)
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=240,
        stdin=subprocess.DEVNULL,
    )


def modules_below(package: str, but: tuple[str, ...]) -> list[str]:
    """Every module of a package but an engine's own, by file name, without importing anything."""
    names = []
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if not name.startswith(but) and parts[-1] != "__main__":
            names.append(name)
    return names


def test_the_blocker_blocks():
    done = run_blocked(["pydrake"], {"pydrake"})
    assert done.returncode != 0
    assert "pydrake is blocked" in done.stderr


@pytest.mark.parametrize("package", ["sports", "rl"])
def test_training_packages_import_without_drake_casadi_and_display(package):
    modules = modules_below(package, DRAKE_ENGINE + WARP_ENGINE)
    assert modules
    done = run_blocked(modules, HEADLESS)
    assert done.returncode == 0, done.stderr[-2000:]


def test_cli_imports_without_drake_casadi_and_display():
    if importlib.util.find_spec("olympics_opt.cli") is None:
        pytest.fail("olympics_opt.cli does not exist: the console script has no target")
    done = run_blocked(["olympics_opt.cli"], HEADLESS)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("package", ["sports", "rl", "olympics_opt"])
def test_without_warp_everything_else_imports(package):
    # Warp is the extra [gpu]: the engine that needs it says so when it is asked for.
    done = run_blocked(modules_below(package, WARP_ENGINE), {"warp", "mujoco_warp"})
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("package", ["sports", "rl", "olympics_opt"])
def test_without_numba_everything_but_the_cpu_engine_imports(package):
    # Training on a GPU does without it.
    pytest.importorskip("mujoco_warp")
    modules = modules_below(package, MUJOCO_ENGINE + DRAKE_ENGINE)
    assert package != "sports" or set(WARP_ENGINE) <= set(modules)
    done = run_blocked(modules, {"numba", "llvmlite"})
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_cpu_engine_without_numba_says_so():
    code = """
import sys
sys.modules["numba"] = None
from sports.env import make_env
try:
    make_env("long_jump", num_worlds=1)
except RuntimeError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=240
    )
    assert "engine 'mujoco' needs numba (pip install numba)" in done.stdout, done.stderr[-2000:]
