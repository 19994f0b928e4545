"""Stages that survive being stopped: each has a folder, and a manifest written when it is done.

A stage is done when its manifest names the inputs it would have now and its files are the ones
that it wrote. Inputs are the stage's settings and the files of the stages before it, so a changed
setting redoes that stage and those whose inputs change by it, and nothing else.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warmstart import atomic

MANIFEST, STARTED = "stage.json", "started.json"


@dataclass(frozen=True)
class Stage:
    """One step of a longer work."""

    name: str
    """Name of its folder."""
    title: str
    """What a person reads while it runs."""
    run: Callable[[Path], dict[str, Any]]
    """Does the work in its folder; returns facts (JSON) for the report."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Everything but other stages' files that decides the result."""
    needs: tuple[str, ...] = ()
    """Names of the stages whose files it reads."""
    continues: bool = False
    """Whether ``run`` continues from the files of a run that was stopped."""


@dataclass(frozen=True)
class Done:
    """A finished stage."""

    name: str
    folder: Path
    facts: dict[str, Any]
    seconds: float
    """Time it took, added up over stops."""
    outputs: dict[str, str]
    """File -> SHA-256."""
    reused: bool = False
    """Whether it was finished before this call."""


def run_stages(
    root: str | Path,
    stages: Sequence[Stage],
    say: Callable[[str], None] = print,
) -> dict[str, Done]:
    """Runs the stages in order, skipping those that are done; returns them by name.

    Raises whatever a stage raises; the stages before it stay done. Raises OSError when the place
    is not writable.
    """
    root = Path(root)
    root.mkdir(parents=True, exist_ok=True)
    done: dict[str, Done] = {}
    for number, stage in enumerate(stages, start=1):
        label = f"[{number}/{len(stages)}] {stage.title}"
        folder = root / stage.name
        inputs = _inputs(stage, done)
        finished = _finished(stage.name, folder, inputs)
        if finished is not None:
            say(f"{label}: done before ({finished.seconds:.0f} s)")
            done[stage.name] = finished
            continue
        before = _prepare(stage, folder, inputs)
        say(f"{label}{' (continues)' if before else ''} ...")
        started = time.monotonic()
        try:
            facts = stage.run(folder)
        except BaseException:
            spent = before + time.monotonic() - started
            atomic.write_json(folder / STARTED, {"inputs": inputs, "seconds": spent})
            raise
        seconds = before + time.monotonic() - started
        outputs = {
            str(p.relative_to(folder)): file_hash(p)
            for p in sorted(folder.rglob("*"))
            if p.is_file() and p.name not in (MANIFEST, STARTED)
        }
        manifest = {"inputs": inputs, "seconds": seconds, "facts": facts, "outputs": outputs}
        atomic.write_json(folder / MANIFEST, manifest)
        say(f"{label}: done in {seconds:.0f} s")
        facts = json.loads((folder / MANIFEST).read_text())["facts"]
        done[stage.name] = Done(stage.name, folder, facts, seconds, outputs)
    return done


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _inputs(stage: Stage, done: dict[str, Done]) -> str:
    facts = {
        "settings": stage.settings,
        "needs": {name: done[name].outputs for name in stage.needs},
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()


def _finished(name: str, folder: Path, inputs: str) -> Done | None:
    manifest = _read(folder / MANIFEST)
    if manifest is None or manifest.get("inputs") != inputs:
        return None
    outputs = manifest["outputs"]
    for file, digest in outputs.items():
        if not (folder / file).is_file() or file_hash(folder / file) != digest:
            return None
    return Done(name, folder, manifest["facts"], manifest["seconds"], outputs, reused=True)


def _prepare(stage: Stage, folder: Path, inputs: str) -> float:
    """Makes or keeps the stage's folder; returns the seconds already spent there."""
    started = _read(folder / STARTED)
    keep = stage.continues and started is not None and started.get("inputs") == inputs
    if not keep and folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MANIFEST).unlink(missing_ok=True)
    spent = float(started["seconds"]) if keep and started is not None else 0.0
    atomic.write_json(folder / STARTED, {"inputs": inputs, "seconds": spent})
    return spent


def _read(path: Path) -> dict[str, Any] | None:
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return value if isinstance(value, dict) else None
