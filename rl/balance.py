"""The task ``balance``: a latent prior learns to stay on its feet, by falling.

``olympics-opt train balance --prior RUN --clips LIBRARY`` plays the prior alone, as ``prior check``
does: latents drawn from it, new noise every step, from frames of people on their feet. A step on
its feet pays 1 and a fall ends the episode. PPO learns where the mean should lie, in standard
deviations of the prior; its own noise, of 1, is the prior's. That network joins the prior
(``rl.steady``), and ``prior export RUN`` writes both as one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from rl.motion import MotionTables
from rl.policy import PolicyError, load_policy
from rl.prior import LatentPrior, PriorError
from rl.prior_play import free_task, upright_frames
from rl.steady import BALANCE, Steady
from sports.env import Env
from sports.humanoid.body import load_body
from sports.physics import make_physics
from sports.scene import finer, humanoid_scene
from sports.task import Advance, Memory, View
from warmstart.library import FPS, load_library


@dataclass(frozen=True)
class BalanceConfig:
    """Options of the task."""

    split: Literal["train", "held_out", "all"] = "train"
    """Clips of the library in whose frames episodes begin."""
    seconds: float = 10.0
    """Of an episode without a fall."""

    def __post_init__(self) -> None:
        if not self.seconds > 0.0:
            raise ValueError(f"seconds must be positive, not {self.seconds}")


def advance(view: View, memory: Memory) -> Advance:
    """1 for every step on one's feet; a fall ends it. ``success``: none so far."""
    fell = view.fallen()
    upright = (~fell).float()
    metrics = {"success": upright[:, 0], "seconds": view.clock * view.control_timestep}
    return Advance(memory, {"upright": upright}, fell, metrics, ~fell[:, 0])


def make_balance_env(config: Any, seed: int, physics_options: dict[str, Any]) -> Env:
    """Worlds for a run (TrainConfig) of the task ``balance``.

    Raises ValueError without clips.
    """
    options = BalanceConfig(**config.options)
    if not config.clips:
        raise ValueError("balance begins in frames of clips: give --clips LIBRARY")
    library = load_library(config.clips).split(options.split)
    body = load_body(library.body, strength=config.strength, limits=config.limits)
    scene = finer(humanoid_scene(body), config.timestep_divisor)
    physics = make_physics(config.engine, scene, config.num_worlds, **physics_options)
    tables = MotionTables(library, physics.device)
    task = replace(
        free_task(tables, upright_frames(tables), library.body),
        name=BALANCE,
        config=BalanceConfig,
        advance=advance,
        metrics={"success": "fraction", "seconds": "s"},
        main_metric="success",
        max_steps=max(1, round(options.seconds * FPS)),
    )
    return Env(task, options, physics, seed=seed, training=True)


def check_unsteady(prior: LatentPrior, config: Any) -> None:
    """Raises PriorError for a prior that has learned to balance already, ValueError for one whose
    athlete is not that of the run (TrainConfig)."""
    if prior.steady is not None:
        raise PriorError(
            f"the prior '{config.prior}' has learned to balance already: give the one it came from"
        )
    for name in ("strength", "limits"):
        value = str(prior.card.get(name, "paper"))
        if getattr(config, name) != value:
            raise ValueError(f"the prior's athlete is one of {name} '{value}': give --{name}")


def steadied(run: Path) -> LatentPrior:
    """The prior that a run of ``balance`` began with, with what it has learned since.

    Raises PriorError for a run that cannot be used.
    """
    try:
        policy = load_policy(run, BALANCE)
    except PolicyError as error:
        raise PriorError(f"the run '{run}' cannot be used: {error}") from error
    prior, card = policy.prior, policy.metadata
    assert prior is not None and policy.actor is not None
    steady = Steady.of(card, prior.size, prior.latent)
    steady.load_state_dict(
        {f"net.{k}": v for k, v in policy.actor.state_dict().items()}
        | {"mean": policy.mean, "std": policy.std}
    )
    learned = {k: card.get(k) for k in ("samples", "minutes", "commit", "metrics")}
    more = {"steady": {**steady.card(), "learned": learned}}
    own = {k: v for k, v in prior.card.items() if k not in ("sha256", "digest")}
    return LatentPrior(prior.nets, prior.mean, prior.std, own | more, prior.encoder, steady)
