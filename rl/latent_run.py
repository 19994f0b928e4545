"""What ``rl.train`` does for runs that make a latent prior, or act through one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from rl.checkpoint import checkpoints, read_state
from rl.config import BALANCE, TrainConfig
from rl.latent import Distiller
from rl.latent_action import LatentActions, LatentConfig
from rl.prior import FILE, LatentPrior, PriorError, load_prior, read_card, save_prior


def make_distiller(
    config: TrainConfig, env: Any, device: torch.device, bf16: bool | None
) -> Distiller:
    """The learner of a run of the task ``prior``."""
    from rl.distillation import teacher_of
    from rl.latent_config import options_of

    how = (config.seed, config.cuda_graph, bf16)
    return Distiller(env, teacher_of(config), options_of(config.options), device, *how)


def write_prior(run: Path) -> Path:
    """Writes what a run of the task ``prior`` has learned as ``RUN/prior.safetensors``, in fp16."""
    return save_prior(load_prior(run), run / FILE, half=True)


def act_through_prior(env: Any, config: TrainConfig) -> None:
    """From now on the actions of ``env`` are latents of the run's prior: of its own copy, once it
    has one. Raises PriorError for a prior that cannot be used, or has changed."""
    assert config.prior is not None
    own = config.out / FILE
    saved = checkpoints(config.out)
    resumed = config.resume and bool(saved)
    prior = load_prior(own if resumed and own.is_file() else config.prior)
    if resumed:
        wanted = read_state(saved[-1])["card"].get("latent", {}).get("prior_digest")
        if prior.digest != wanted:
            raise PriorError(
                f"the run {config.out} acts through the prior {str(wanted)[:12]}..., not "
                f"{prior.digest[:12]}...: give that one"
            )
    if config.task == BALANCE:
        from rl.balance import check_unsteady

        check_unsteady(prior, config)
    how = LatentConfig("scaled", span=1.0) if config.task == BALANCE else config.latent
    layer = LatentActions(prior, how, env.physics.scene, env.task.tools, env.device)
    layer.check(env.obs_slices)
    env.act_through(layer)


def keep_prior(env: Any, out: Path) -> None:
    """Puts the prior that ``env`` acts through into the run's folder, so that it can go on, and be
    played, wherever it is carried."""
    prior: LatentPrior = env.layer.prior
    try:
        if read_card(out / FILE).get("digest") == prior.digest:
            return
    except PriorError:
        pass  # none yet
    save_prior(prior, out / FILE, half=prior.card.get("precision") == "float16")


def card(env: Any, agent: Any) -> dict[str, Any]:
    """What these runs add to a model's card."""
    layer = getattr(env, "layer", None)
    more = {} if layer is None else {"latent": layer.card}
    return more | getattr(agent, "card", {})
