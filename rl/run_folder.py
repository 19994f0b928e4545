"""What a run keeps in its folder, and how it goes on from there.

``config.json`` says what was asked for; each checkpoint holds the whole state and, for whoever
plays the policy, its card.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch.distributed as dist
from torch import Tensor

from rl import latent_run, provenance
from rl.assembly import Assembly
from rl.checkpoint import checkpoints, load_checkpoint, ranks_of, read_state, save_checkpoint
from rl.config import TrainConfig, config_from_dict, usual_options
from rl.policy import FORMAT as POLICY_FORMAT
from rl.policy import KEPT, export_policy, learned
from warmstart.atomic import write_text

FREE = {"out", "resume", "samples", "minutes", "until", "quiet", "checkpoint_minutes"}
FREE |= {"checkpoint_iterations", "keep_policies", "device", "cuda_graph", "physics_options"}
FREE |= {"profile"}
"""What a resumed run may change; everything else is the run's own."""
NOISY = ("agent", "env", "style", "selfplay")
"""What has noise of its own. A place in this list decides a seed: append only."""


@dataclass
class Progress:
    """How far a run is."""

    obs: Tensor
    """(N, A, D) observation to go on from."""
    warmup: int
    """Iterations at the beginning in which only the critic learns."""
    iteration: int = 0
    samples: int = 0
    """Of all ranks."""
    minutes: float = 0.0
    """Of all sessions."""
    metrics: dict[str, float] = field(default_factory=dict)
    """Episode metrics of the last iteration in which an episode ended."""


# -- settings -----------------------------------------------------------------------------------


def settle(config: TrainConfig) -> TrainConfig:
    """The run's own settings on a resume. Raises ValueError where the caller's contradict them."""
    if not config.task:
        raise ValueError("train needs the name of a task")
    saved = checkpoints(config.out)
    if saved and not config.resume:
        raise ValueError(
            f"{config.out} already holds a run: add --resume to continue it, or give another --out"
        )
    if not saved:
        return config
    stored = config_from_dict(read_state(saved[-1])["card"]["config"])
    plain = TrainConfig()
    changes = {}
    for f in dataclasses.fields(TrainConfig):
        if f.name == "task":
            continue
        given, own = getattr(config, f.name), getattr(stored, f.name)
        asked = given != getattr(plain, f.name)
        if f.name == "options":
            _same_options(config.task, given, own)
        elif f.name in FREE:
            kept = f.name in ("samples", "minutes", "until") and not asked
            changes[f.name] = own if kept else given
        elif asked and given != own:
            raise ValueError(
                f"{f.name} {given!r} differs from the run's {own!r}: a resumed run keeps its "
                "settings; leave it out, or start a new run in another --out"
            )
    if stored.task != config.task:
        raise ValueError(f"{config.out} is a run of task '{stored.task}', not of '{config.task}'")
    return replace(stored, **changes)


def _same_options(task: str, given: dict[str, Any], own: dict[str, Any]) -> None:
    """Raises ValueError where a task option that was asked for is not the run's.

    The command line gives every option of the task, asked for or not, so that one at its default
    asks for nothing; lists are what JSON made of the run's tuples.
    """
    plain = usual_options(task)
    for name, value in given.items():
        asked = json.loads(json.dumps(value))
        default = plain.get(name)
        if asked not in (default, own.get(name, default)):
            raise ValueError(
                f"{name} {value!r} differs from the run's {own.get(name, default)!r}: a resumed "
                "run keeps its settings; leave it out, or start a new run in another --out"
            )


def write_config(made: Assembly) -> None:
    """Begins the folder: ``config.json``, and the latent prior that the run acts through."""
    c = made.config
    c.out.mkdir(parents=True, exist_ok=True)
    if c.prior is not None:
        latent_run.keep_prior(made.env, c.out)
    data = {
        "config": dataclasses.asdict(replace(c, ppo=c.hyper, paper=False)),
        "paper": c.paper,
        "ranks": made.ranks,
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
    }
    write_text(c.out / "config.json", json.dumps(data, indent=1, default=str))


# -- checkpoints --------------------------------------------------------------------------------


def policy_card(made: Assembly, now: Progress) -> dict[str, Any]:
    """What the policy file says about itself; see rl.policy."""
    c, env, norm = made.config, made.env, made.agent.obs_norm
    return {
        "format": POLICY_FORMAT,
        "task": c.task,
        "algo": c.method,
        "body": getattr(getattr(env, "task", None), "body", "none"),
        "strength": c.strength,
        "limits": c.limits,
        "obs_size": env.obs_size,
        "action_size": env.action_size,
        "obs_layout": {k: [s.start, s.stop] for k, s in env.obs_slices.items()},
        "hidden": list(c.hyper.hidden),
        "activation": c.hyper.activation,
        "observation_clip": c.hyper.observation_clip,
        "obs_mean": norm.mean.tolist(),
        "obs_std": norm.std.tolist(),
        "obs_count": float(norm.count),
        "config": json.loads(json.dumps(dataclasses.asdict(c), default=str)),
        "samples": now.samples,
        "minutes": now.minutes,
        "hardware": provenance.hardware(),
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "metrics": dict(now.metrics),
        **getattr(env, "card", {}),
        **latent_run.card(env, made.agent),
    }


def save(made: Assembly, now: Progress) -> Path:
    """Writes a checkpoint, together with the other ranks; returns its folder."""
    state: dict[str, Any] = {
        "samples": now.samples,
        "minutes": now.minutes,
        "ranks": made.ranks,
        "warmup": now.warmup,
        "card": policy_card(made, now),
    }
    owners = {"agent": made.agent, "env": made.env, "meter": made.meter}
    owners |= {part.name: part for part in made.parts}
    tensors = {
        f"{name}/{key}": value
        for name, owner in owners.items()
        for key, value in owner.state_dict().items()
    }
    tensors["obs"] = now.obs
    state |= {part.name: own for part in made.parts if (own := part.state())}
    barrier = dist.barrier if made.ranks > 1 else None
    return save_checkpoint(made.config.out, now.iteration, state, tensors, made.rank, barrier)


def keep_policy(made: Assembly, now: Progress) -> Path:
    """The policy as it is now as a file of its own, to choose from or to average."""
    out = made.config.out
    agent = {name: x.cpu() for name, x in made.agent.state_dict().items()}
    policy = learned(policy_card(made, now), agent, str(out))
    return export_policy(policy, out / KEPT / f"{now.samples:012d}", critic=True)


def restore(made: Assembly) -> Progress:
    """Takes the last checkpoint back.

    A rank that has none, of a run that was begun with fewer, takes the worlds of another.
    """
    path = checkpoints(made.config.out)[-1]
    saved = ranks_of(path)
    state, tensors = load_checkpoint(path, made.rank % saved)

    def part_of(name: str) -> dict[str, Tensor]:
        start = f"{name}/"
        return {k.removeprefix(start): v for k, v in tensors.items() if k.startswith(start)}

    for name, owner in (("agent", made.agent), ("env", made.env), ("meter", made.meter)):
        owner.load_state_dict(part_of(name))
    for part in made.parts:
        part.load(state.get(part.name, {}), part_of(part.name))
    now = Progress(
        obs=tensors["obs"].to(made.env.device),
        **{name: state[name] for name in ("iteration", "samples", "minutes", "warmup")},
        metrics=state["card"]["metrics"],
    )
    if saved < made.ranks and made.rank == 0 and not made.config.quiet:
        print(
            f"{path} has the worlds of {saved} processes: the others begin with copies of them",
            flush=True,
        )
    if made.rank >= saved:  # the worlds of another rank, but not its future
        _reseed(made, now.iteration)
    return now


def _reseed(made: Assembly, iteration: int) -> None:
    owners = {"agent": made.agent, "env": made.env} | {part.name: part for part in made.parts}
    part_of_run = 1_000_003 * made.rank + iteration
    for k, name in enumerate(NOISY):
        generator = getattr(owners.get(name), "generator", None)
        if generator is not None:
            generator.manual_seed(made.config.seed + 7919 * k + part_of_run)
