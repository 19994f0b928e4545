"""Is a latent prior sound? The health checks that go before any sport (``prior check``).

Information: the KL divergence of posterior from prior, and how many dimensions carry any of it.
Ability: the share of clips that the student follows, against its teacher. Prior: ten seconds of
latents drawn from it alone, without a fall.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rl import provenance
from rl.config import TRACKING
from rl.evaluate import interval
from rl.host import one_torch_thread
from rl.latent import ACTIVE
from rl.latent_terms import gaussian_kl
from rl.policy import Policy, load_policy
from rl.prior import LatentPrior
from rl.prior_play import Sampler, play_prior
from rl.student import Student
from rl.tracker import TrackingConfig, make_tracking_env
from rl.tracker_evaluation import evaluate_tracker
from warmstart.library import Library

KL_NATS = (5.0, 30.0)
"""Nats of the posterior from the prior: below, the latent says nothing; above, the prior is of no
help."""
ACTIVE_SHARE = 20 / 32
"""Of the dimensions that must carry something: 20 of 32."""
OF_TEACHER = 0.93
"""Of the tracker's success that the student must reach."""
STANDING = 0.8
"""Share of the worlds without a fall."""
SECONDS = 10.0
STEPS = 150
"""Control steps of the student over which its latents are looked at."""
DEFAULT_WORLDS = {"mujoco": 64, "warp": 1024, "drake": 2}

Say = Callable[[str], None]


def latent_divergence(
    prior: LatentPrior,
    library: Library,
    *,
    engine: str = "mujoco",
    num_worlds: int = 64,
    steps: int = STEPS,
    seed: int = 0,
    physics_options: dict[str, Any] | None = None,
) -> Tensor:
    """(Z,) mean KL divergence (nats) of the posterior from the prior, dimension by dimension, where
    the student follows clips from frames drawn anywhere."""
    student = Student(prior)
    config = replace(
        TrackingConfig(), action="absolute", split="all", uniform=1.0, tolerance=(0.5, 0.5)
    )
    env = make_tracking_env(
        library,
        engine=engine,
        num_worlds=num_worlds,
        seed=seed,
        config=config,
        strength=str(prior.card.get("strength", "paper")),
        limits=str(prior.card.get("limits", "paper")),
        physics_options=physics_options,
    )
    try:
        student.check(env)
        student.to(env.device)
        total = torch.zeros(prior.latent, dtype=torch.float64, device=env.device)
        count = torch.zeros((), dtype=torch.float64, device=env.device)
        obs = env.reset()
        with one_torch_thread(env.device), torch.no_grad():
            for _ in range(steps):
                (mean, sigma), (mean_p, sigma_p) = prior.posterior(obs), prior.moments(obs)
                nats = gaussian_kl(mean, 2.0 * sigma.log(), mean_p, 2.0 * sigma_p.log())
                result = env.step(prior.decode(obs, mean))
                total += (nats[:, 0].double() * result.valid[:, None]).sum(0)
                count += result.valid.sum()
                obs = result.obs
        return (total / count.clamp(min=1.0)).cpu()
    finally:
        env.close()


def check_prior(
    prior: LatentPrior,
    library: Library,
    *,
    tracker: Policy | str | Path | None = None,
    engine: str = "mujoco",
    num_worlds: int | None = None,
    seconds: float = SECONDS,
    sampler: Sampler | None = None,
    seed: int = 0,
    physics_options: dict[str, Any] | None = None,
    say: Say | None = None,
) -> dict[str, Any]:
    """All health checks; JSON with ``checks``: {name: {"value", "required", "passed"}}.

    Args:
        prior: with its encoder, else only the prior is played and ``passed`` of the others is
            None.
        library: clips of both splits or of one.
        tracker: the teacher; None leaves the comparison with it out (``passed`` None).
        engine: ``mujoco``, ``warp`` or ``drake``.
        num_worlds: worlds at once; None for the engine's default.
        seconds: of playing the prior alone.
        sampler: see rl.prior_play.
        seed: of all that is drawn.
        physics_options: the engine's options.
        say: called with what is being done.

    Raises PolicyError and ValueError for a tracker or clips that do not fit.
    """
    say, sampler = say or (lambda text: None), sampler or Sampler()
    worlds = num_worlds or DEFAULT_WORLDS.get(engine, 64)
    how: dict[str, Any] = {"engine": engine, "seed": seed, "physics_options": physics_options}
    if tracker is not None and not isinstance(tracker, Policy):
        tracker = load_policy(tracker, TRACKING)
    say("playing the prior alone")
    alone = play_prior(prior, library, num_worlds=worlds, seconds=seconds, sampler=sampler, **how)
    checks: dict[str, dict[str, Any]] = {}
    details: dict[str, Any] = {}
    if prior.encoder:
        say("looking at its latents")
        nats = latent_divergence(prior, library, num_worlds=worlds, **how)
        total, active = float(nats.sum()), int((nats > ACTIVE).sum())
        details["nats"] = [round(x, 5) for x in sorted(nats.tolist(), reverse=True)]
        low, high = KL_NATS
        required = f"{low:g} to {high:g} nats"
        checks["kl"] = _check(total, required, low <= total <= high)
        least = ACTIVE_SHARE * prior.latent
        required = f"more than {least:g} of {prior.latent}"
        checks["active"] = _check(active, required, active > least)
    else:
        for name in ("kl", "active"):
            checks[name] = _check(None, "needs the encoder", None)
    required = f"at least {OF_TEACHER:.0%} of the tracker's"
    checks["student"] = _check(None, required, None)
    if prior.encoder:
        say("following clips")
        follow = {"num_worlds": num_worlds, **how}
        one = evaluate_tracker(Student(prior), library, **follow)
        details["student"] = one["splits"]
        if tracker is not None:
            say("following clips with the tracker")
            two = evaluate_tracker(tracker, library, **follow)
            details["tracker"] = two["splits"]
            ratio = _success(one) / max(_success(two), 1e-9)
            checks["student"] = _check(ratio, required, ratio >= OF_TEACHER)
    share = float(alone.standing.mean())
    required = f"at least {STANDING:.0%} of the worlds on their feet for {seconds:g} s"
    checks["standing"] = _check(share, required, share >= STANDING)
    passed = [c["passed"] for c in checks.values()]
    return {
        "kind": "prior check",
        "prior_digest": prior.digest,
        "body": prior.card["body"],
        "engine": engine,
        "seed": seed,
        "worlds": worlds,
        "sampler": vars(sampler),
        "library": library.card(),
        "checks": checks,
        "passed": all(p is not False for p in passed),
        "complete": None not in passed,
        "alone": {
            "upright": interval(alone.upright, "s"),
            "speed": interval(alone.speed, "m/s"),
            "standing": interval(alone.standing.astype(float), "fraction"),
            **alone.trouble,
        },
        **details,
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
    }


def _check(value: float | None, required: str, passed: bool | None) -> dict[str, Any]:
    rounded = None if value is None else round(float(value), 5)
    return {"value": rounded, "required": required, "passed": passed}


def _success(result: dict[str, Any]) -> float:
    return float(np.mean([row["success"] or 0.0 for row in result["clips"]]))
