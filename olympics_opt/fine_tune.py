"""Fine-tuning a trained policy for a few minutes on a CPU, so that it does not get worse.

A good policy has seen a hundred million samples; a few minutes here give a few hundred thousand.
What keeps them from doing harm: steps so small that the noise of so little data cannot carry the
policy away, rollouts as long as an episode, little noise in the actions, and a critic that has
learned to judge the policy before the policy moves. Of the states saved on the way the best is
kept, by trials from other starts than those that are reported.

Measured on a long jumper that won 99.3 % of 400 trials with a mean return of 136.6. The KL control
of training (band 0.008 to 0.03, 104 k samples) left it 43 %; a band of 0.002 to 0.006 (240 k) 100 %
but a return of 119; a constant rate of 2e-6 (188 k) 100 % and 131 at a noise of 0.07, 100 % and
136.2 at 0.04; a rate of 8e-6 at 0.04 99.5 % and 141.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warmstart import atomic

if TYPE_CHECKING:
    from rl.ppo import PPOConfig
    from rl.train import TrainConfig

CANDIDATES, POLICY = "candidates", "policy.safetensors"


@dataclass(frozen=True)
class FineTuning:
    """How carefully a policy is tuned."""

    steps: int = 128
    """Control steps of a rollout: about an episode, so that each update sees all of its phases
    although all worlds began at once."""
    minibatches: int = 4
    epochs: int = 2
    learning_rate: float = 5e-6
    """Constant: the KL control would raise it until the noise moves the policy."""
    critic_warmup: int = 6
    """Iterations in which only the critic learns, if the policy comes without one."""
    start_probability: float = 0.25
    """Share of episodes that start from a state of a demonstration."""
    sigma: float = 0.04
    """Largest noise of the actions; less where the policy ended its own training with less. At
    the last noise of its training a policy unlearns what only its mean action can do."""
    shares: tuple[float, ...] = (0.55, 0.7, 0.85, 1.0)
    """Parts of the training time after which the policy is saved as a candidate."""
    trials: int = 50
    """Episodes of each candidate."""
    seed_offset: int = 1_000_003
    """Added to the seed in those episodes, so that the reported ones are others."""


def hyper_parameters(card: dict[str, Any], tuning: FineTuning) -> PPOConfig:
    """PPO for a policy with this card: its own network, horizon and last noise; small steps."""
    from rl.ppo import PPOConfig

    trained = card.get("config")
    ppo = trained.get("ppo") if isinstance(trained, dict) else None
    ppo = ppo if isinstance(ppo, dict) else {}
    own: dict[str, Any] = {name: float(ppo[name]) for name in ("gamma", "lam") if ppo.get(name)}
    last = ppo.get("sigma_final") or ppo.get("sigma")
    return PPOConfig(
        **own,
        hidden=tuple(card["hidden"]),
        activation=card["activation"],
        observation_clip=card["observation_clip"],
        sigma=min(tuning.sigma, float(last)) if last else tuning.sigma,
        steps=tuning.steps,
        minibatches=tuning.minibatches,
        epochs=tuning.epochs,
        learning_rate=tuning.learning_rate,
        kl_band=None,
        critic_warmup=tuning.critic_warmup,
    )


def fine_tune(config: TrainConfig, folder: Path, tuning: FineTuning) -> dict[str, Any]:
    """Trains from ``config.init`` and writes the best candidate as ``folder/policy.safetensors``.

    ``config`` says all but ``ppo`` and ``start_probability``; its ``minutes`` are the whole time.
    Stopped at any moment, the same call continues. Returns facts for a report. Raises
    KeyboardInterrupt where training was asked to stop, and what ``rl.train.train`` raises.
    """
    from rl.policy import export_policy, load_policy
    from rl.train import train

    assert config.init is not None
    card = load_policy(config.init, config.task).metadata
    config = replace(
        config,
        resume=True,
        strength=card["strength"],
        limits=card["limits"],
        ppo=hyper_parameters(card, tuning),
        start_probability=(tuning.start_probability, tuning.start_probability),
    )
    candidates: list[Path] = []
    for share in tuning.shares:
        summary = train(config, part=share)
        if summary.stopped_by == "signal":
            raise KeyboardInterrupt
        path = folder / CANDIDATES / f"iteration_{summary.iterations:05d}.safetensors"
        if path not in candidates:  # else this part of the time had passed before
            candidates.append(export_policy(config.out, path))
    played = [_played(path, config, tuning) for path in candidates]
    best = max(range(len(played)), key=lambda i: (played[i]["success"], played[i]["return"]))
    for suffix in (".safetensors", ".json"):
        data = candidates[best].with_suffix(suffix).read_bytes()
        atomic.write_bytes((folder / POLICY).with_suffix(suffix), data)
    return {
        "samples": summary.samples,
        "minutes": summary.minutes,
        "iterations": summary.iterations,
        "candidates": played,
        "kept": best,
        "selection": {"trials": tuning.trials, "seed": config.seed + tuning.seed_offset},
    }


def _played(path: Path, config: TrainConfig, tuning: FineTuning) -> dict[str, Any]:
    """What a candidate comes to in the trials by which it is chosen."""
    from olympics_opt.play import play

    iteration = int(path.stem.rpartition("_")[2])
    played = play(
        config.task,
        str(path),
        trials=tuning.trials,
        seed=config.seed + tuning.seed_offset,
        options=config.options,
        label=f"candidate after {iteration} iterations",
    )
    return {
        "iteration": iteration,
        "success": played.result["metrics"]["success"]["mean"],
        "return": float(played.trials["return"].mean()),
    }
