"""How well a tracker follows clips: each from beginning to end, by split, archive and sport.

A clip is followed if the mean distance of the links from the reference never exceeds 0.5 m. Of
those the errors are given: ``mpjpe`` (mean distance of the links, world frame), ``mpjpe_local``
(the same seen from the root) and ``acceleration_error``, the second difference of the distance
from frame to frame (Luo et al. 2023, section 4). The policy plays its mean action.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rl import provenance
from rl.config import TRACKING
from rl.evaluate import interval
from rl.host import one_torch_thread
from rl.policy import Policy, PolicyError, load_policy
from rl.student import Student
from rl.tracker import TrackingConfig, TrackingEnv, make_tracking_env
from warmstart.library import Library, Origin

UNITS = {
    "success": "fraction",
    "mpjpe": "mm",
    "mpjpe_local": "mm",
    "acceleration_error": "mm/frame^2",
    "followed": "fraction",
}
"""Figures of a clip; ``followed`` is the part of it before the athlete was lost."""
DEFAULT_WORLDS = {"mujoco": 64, "warp": 1024, "drake": 2}
ASK = 10
"""Steps between looks at whether all worlds are done."""


def evaluate_tracker(
    policy: Policy | Student | str | Path,
    library: Library,
    *,
    engine: str = "mujoco",
    num_worlds: int | None = None,
    seed: int = 0,
    strength: str | None = None,
    limits: str | None = None,
    physics_options: dict[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Plays every clip of a library once; JSON with the figures and what decides them.

    Args:
        policy: a loaded policy, a student of one, or what ``load_policy`` accepts; ``zero`` plays
            the reference's poses as PD targets.
        library: clips of both splits or of one.
        engine: ``mujoco``, ``warp`` or ``drake``.
        num_worlds: worlds at once; None for the engine's default.
        seed: of the policy ``random``; nothing else is random.
        strength: torque limits; None for those that the policy was trained with.
        limits: joint limits; likewise.
        physics_options: the engine's options.
        progress: called with (clips done, clips).

    Raises PolicyError for a policy that does not fit, ValueError for clips of another body.
    """
    if isinstance(policy, (str, Path)):
        policy = load_policy(policy, TRACKING)
    card = policy.metadata
    config = tracking_config(card)
    clips = len(library.lengths)
    worlds = min(num_worlds or DEFAULT_WORLDS.get(engine, 64), clips)
    order = np.argsort(library.lengths, kind="stable").tolist()
    batches = [order[i : i + worlds] for i in range(0, clips, worlds)]
    strength = strength or str(card.get("strength", "paper"))
    limits = limits or str(card.get("limits", "paper"))
    env = make_tracking_env(
        library,
        engine=engine,
        num_worlds=worlds,
        strength=strength,
        limits=limits,
        training=False,
        config=config,
        assigned=_padded(batches[0], worlds),
        physics_options=physics_options,
    )
    rows = np.full((clips, len(UNITS)), np.nan)
    try:
        policy.check(env)
        policy.to(env.device)
        policy.seed(seed)
        with one_torch_thread(env.device), torch.no_grad():
            for i, batch in enumerate(batches):
                rows[batch] = _play(policy, env, _padded(batch, worlds))[: len(batch)]
                if progress is not None:
                    progress(min((i + 1) * worlds, clips), clips)
        trouble = {"overflow": int(env.physics.overflow), "nan_worlds": int(env.physics.nan_worlds)}
    finally:
        env.close()
    return {
        "task": TRACKING,
        "algo": card["algo"],
        "policy_sha256": card["sha256"],
        "engine": engine,
        "strength": strength,
        "limits": limits,
        "residual": config.residual,
        "library": library.card(),
        "trials": clips,
        "seed": seed,
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
        "splits": summarise(library.origins, rows),
        "clips": [
            {"name": o.name, **{n: number(x) for n, x in zip(UNITS, row)}}
            for o, row in zip(library.origins, rows)
        ],
        **trouble,
    }


def summarise(origins: Iterable[Origin], rows: np.ndarray) -> dict[str, Any]:
    """Figures of each split: of ``all`` its clips, of its ``archives`` and its ``tags``.

    ``rows`` (C, 5) in the order of ``UNITS``. Errors are means over the clips that were followed.
    """
    origins = list(origins)
    out: dict[str, Any] = {}
    for split in ("train", "held_out"):
        mine = [i for i, o in enumerate(origins) if o.held_out == (split == "held_out")]
        if not mine:
            continue
        out[split] = {"all": _figures(rows[mine])}
        for name, kind in (("archives", "archive"), ("tags", "tag")):
            groups: dict[str, list[int]] = {}
            for i in mine:
                groups.setdefault(getattr(origins[i], kind), []).append(i)
            out[split][name] = {k: _figures(rows[v]) for k, v in sorted(groups.items())}
    return out


def _figures(rows: np.ndarray) -> dict[str, Any]:
    followed = rows[:, 0] == 1.0
    return {
        name: interval(rows[:, k] if unit == "fraction" else rows[followed, k], unit)
        for k, (name, unit) in enumerate(UNITS.items())
    }


def _play(policy: Policy | Student, env: TrackingEnv, clips: list[int]) -> np.ndarray:
    """(N, 5) figures of the first episode of each world."""
    env.assign(clips)
    obs = env.reset()
    lengths = env.tracking.tables.lengths[torch.tensor(clips, device=env.device)]
    names = list(UNITS)[:4]
    found = torch.full((len(clips), len(UNITS)), torch.nan, device=env.device)
    open_ = torch.ones(len(clips), dtype=torch.bool, device=env.device)
    for step in range(1, int(lengths.max())):
        result = env.step(policy(obs))
        obs = result.obs
        bad = ~result.valid
        now = open_ & (result.ended | bad)
        values = torch.stack([result.metrics[n] for n in names], 1)
        values = torch.where(bad[:, None], torch.nan, values)
        values[:, 0] = torch.where(bad, 0.0, values[:, 0])
        part = step / (lengths - 1).float()
        values = torch.cat((values, part[:, None]), 1)
        found = torch.where(now[:, None], values, found)
        open_ = open_ & ~now
        if step % ASK == 0 and not open_.any():
            break
    return found.double().cpu().numpy()


def _padded(clips: list[int], worlds: int) -> list[int]:
    """As many clips as worlds: the last one again."""
    return clips + [clips[-1]] * (worlds - len(clips))


def tracking_config(card: dict[str, Any]) -> TrackingConfig:
    """The options that a policy was trained with; the defaults for a baseline."""
    options = card.get("config", {}).get("options", {})
    try:
        return TrackingConfig(**options)
    except (TypeError, ValueError) as error:
        raise PolicyError(f"the policy's card has no options of a tracker: {error}") from error


def number(value: float, digits: int = 5) -> float | None:
    """A figure for a result, rounded; None where there is none."""
    return round(float(value), digits) if math.isfinite(value) else None
