"""Trained policies as files: an actor in safetensors, fp16 or int8, and a JSON card that says what
it is.

``load_policy`` accepts such a file, a run's folder, a frozen opponent of a run of self-play
(``RUN@SAMPLES``, ``RUN@rival``), ``pretrained[:ALGO[-STRENGTH]]``, and the baselines ``zero`` and
``random``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_safetensors
from safetensors.torch import save
from torch import Tensor

from rl import pretrained
from rl.card import card_text
from rl.checkpoint import CheckpointError, checkpoints, load_checkpoint
from rl.int8 import fitted, packed, unpacked
from rl.latent_action import LatentActions, LatentConfig, as_told
from rl.networks import MLP
from rl.policy_stack import unstacked
from rl.prior import LatentPrior, PriorError, find_prior
from rl.provenance import portable
from sports.registry import get_task
from warmstart.atomic import write_bytes, write_text

FORMAT = "olympics-opt policy 1"
BASELINES = ("zero", "random")
ALGORITHMS = ("ppo", "amp", "selfplay", "latent", "latent-amp", "latent-selfplay")
"""Those whose actor turns an observation into PD targets, which is what a policy is here, or into
latents of a prior (``latent``), which it is told of by its card."""
KEPT = "policies"
"""Folder in a run's of the policies of its checkpoints (``train --keep-policies``)."""
MAX_WIDTH, MAX_LAYERS = 1 << 16, 32
_REQUIRED = {
    "format": str,
    "task": str,
    "algo": str,
    "body": str,
    "strength": str,
    "limits": str,
    "obs_size": int,
    "action_size": int,
    "hidden": list,
    "activation": str,
    "observation_clip": float,
    "obs_mean": list,
    "obs_std": list,
    "obs_count": float,
    "sha256": str,
}


class PolicyError(ValueError):
    """A policy cannot be used here; the message is a sentence with the remedy."""


@dataclass
class Policy:
    """A deterministic policy: its mean action.

    Call it with raw observations (N, A, obs); returns actions (N, A, act), unclipped.
    """

    actor: MLP | None
    """None for a baseline."""
    mean: Tensor
    """(obs,) observation statistics."""
    std: Tensor
    metadata: dict[str, Any]
    """The card: task, algo, body, strength, limits, sizes, obs_layout, config, samples, minutes,
    hardware, metrics, sha256."""
    extra: dict[str, Tensor] = field(default_factory=dict)
    """Critic state, where the source has it (a run's folder)."""
    prior: LatentPrior | None = None
    """Of a latent policy."""
    layer: LatentActions | None = None
    """Makes actions of its latents, unless the environment does; ``check`` sets it."""
    _random: torch.Generator | None = None
    _noise_seed: int = 0

    @torch.no_grad()
    def __call__(self, obs: Tensor) -> Tensor:
        """(..., obs) -> (..., act)."""
        if self.actor is None:
            shape = (*obs.shape[:-1], self.metadata["action_size"])
            if self.metadata["algo"] == "zero":
                return torch.zeros(shape, device=obs.device)
            if self._random is None or self._random.device != obs.device:
                self._random = torch.Generator(obs.device).manual_seed(self._noise_seed)
            return 2.0 * torch.rand(shape, device=obs.device, generator=self._random) - 1.0
        action = self.actor(self.inputs(obs))
        return action if self.layer is None else self.layer(obs, action)

    def inputs(self, obs: Tensor) -> Tensor:
        """(..., obs) raw observations as the network gets them."""
        clip = self.metadata["observation_clip"]
        return ((torch.nan_to_num(obs) - self.mean) / self.std).clamp(-clip, clip)

    def to(self, device: torch.device | str) -> Policy:
        """The same policy on a device (moved in place)."""
        if self.actor is not None:
            self.actor.to(device)
        if self.prior is not None:
            self.prior.to(device)
        self.mean, self.std = self.mean.to(device), self.std.to(device)
        return self

    def seed(self, seed: int) -> None:
        """Starts the noise of the ``random`` baseline anew."""
        self._noise_seed, self._random = seed, None

    def check(self, env: Any) -> None:
        """Raises PolicyError where the policy does not fit an environment.

        A latent policy learns here what its latents mean to the environment's athlete.
        """
        m = self.metadata
        if self.actor is None:
            m["action_size"] = env.action_size
            return
        size = env.action_size if self.prior is None else self._check_latent(env)
        for name, have in (("obs_size", env.obs_size), ("action_size", size)):
            if m[name] != have:
                raise PolicyError(
                    f"the policy has {name} {m[name]}, but task '{env.task.name}' with these "
                    f"options has {have}: use a policy trained on it"
                )
        layout = {k: [s.start, s.stop] for k, s in env.obs_slices.items()}
        if m.get("obs_layout") not in (None, layout):
            raise PolicyError(
                f"the policy was trained on another layout of the observations of "
                f"'{env.task.name}': train it again with this version"
            )

    @property
    def own_turns(self) -> bool:
        """Whether it asks for rotations, on whatever turn a joint is; see ``Env.own_turns``."""
        return self.layer is not None

    def _check_latent(self, env: Any) -> int:
        """Numbers of the action of a latent policy in an environment, which gets a layer to play
        it, or has the very one (in training)."""
        assert self.prior is not None
        own = self.metadata["latent"]
        if getattr(env, "layer", None) is not None:
            if env.layer.card != as_told(own):
                raise PolicyError(
                    "the policy acts through another latent prior, or in another way, than this "
                    "run: give the run the prior and the --latent options of the policy"
                )
            return env.layer.size
        scene = env.physics.scene
        try:
            config = LatentConfig(**{k: v for k, v in own.items() if k != "prior_digest"})
            self.layer = LatentActions(self.prior, config, scene, env.task.tools, env.device)
            self.layer.check(env.obs_slices)
            env.own_turns = True  # as in training, where the environment has the layer
        except (ValueError, TypeError) as error:
            raise PolicyError(f"the policy's latents mean nothing here: {error}") from error
        return self.layer.size


def seen_options(policy: Policy, task: str) -> dict[str, Any]:
    """The task's options without which the policy would not see what it learned from (the task's
    ``sees``), as its card has them."""
    config = policy.metadata.get("config")
    chosen = config.get("options") if isinstance(config, dict) else None
    if policy.metadata.get("task") != task or not isinstance(chosen, dict):
        return {}
    spec = get_task(task)
    default = spec.config()
    return {
        name: chosen[name]
        for name in spec.sees
        if name in chosen and chosen[name] != getattr(default, name)
    }


class Athlete(NamedTuple):
    """As whom, and with which options of the task, a policy is played."""

    strength: str
    limits: str
    options: dict[str, Any]


def as_trained(
    policy: Policy,
    task: str,
    strength: str | None = None,
    limits: str | None = None,
    options: dict[str, Any] | None = None,
) -> Athlete:
    """The athlete of a policy's card, and ``seen_options``, except for what is asked for."""
    card = policy.metadata
    return Athlete(
        strength or str(card.get("strength", "paper")),
        limits or str(card.get("limits", "paper")),
        seen_options(policy, task) | dict(options or {}),
    )


def load_policy(source: str | Path, task: str) -> Policy:
    """A policy for a task.

    Args:
        source: ``FILE.safetensors`` with ``FILE.json`` beside it, a run's folder (its last
            checkpoint), ``RUN@SAMPLES`` or ``RUN@rival``, ``pretrained``, ``pretrained:ALGO``,
            ``pretrained:ALGO-STRENGTH``, ``zero`` (PD target zero) or ``random`` (uniform).
        task: the task that it must be trained on.

    Raises PolicyError when it is missing, truncated, altered, not a policy, or another task's.
    """
    policy = read_policy(source, task)
    found = policy.metadata["task"]
    if found != task:
        raise PolicyError(f"the policy '{source}' is of task '{found}', not of '{task}'")
    return policy


def read_policy(source: str | Path, task: str) -> Policy:
    """As ``load_policy``, of whatever task a run or a file is; ``task`` says which shipped one is
    meant and which task a baseline is for. Raises PolicyError."""
    text = str(source)
    if text in BASELINES:
        metadata = {"task": task, "algo": text, "action_size": 0, "sha256": ""}
        return Policy(None, torch.zeros(0), torch.ones(0), metadata)
    if text == "pretrained" or text.startswith("pretrained:"):
        try:
            path = pretrained.locate(task, text.partition(":")[2] or "ppo")
        except ValueError as error:
            raise PolicyError(str(error)) from error
    else:
        path = Path(source)
    if path.is_dir():
        return _from_run(path)
    if path.is_file():
        return _from_file(path)
    run, at, which = text.rpartition("@")
    if at and Path(run).is_dir():
        return _from_pool(Path(run), which)
    raise PolicyError(
        f"there is no policy '{source}': give a run's folder, a .safetensors file, "
        f"'pretrained' or one of {', '.join(BASELINES)}"
    )


def _from_run(run: Path) -> Policy:
    saved = checkpoints(run)
    if not saved:
        raise PolicyError(f"the run '{run}' has no checkpoint yet: train it for longer")
    try:
        state, tensors = load_checkpoint(saved[-1])
        card = dict(state["card"])
    except (CheckpointError, KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"the run '{run}' cannot be used: {error}") from error
    agent = {k.removeprefix("agent/"): v for k, v in tensors.items() if k.startswith("agent/")}
    return _with_prior(learned(card, agent, str(run)), run)


def learned(card: dict[str, Any], agent: Mapping[str, Tensor], where: str) -> Policy:
    """The policy in a learner's state, on the CPU, with its critic; without the latent prior that
    it may need to play. Raises PolicyError naming what is wrong with the card."""
    weights = {k.removeprefix("actor."): v for k, v in agent.items() if k.startswith("actor.")}
    policy = _signed(card, weights, where)
    policy.extra = {k: v for k, v in agent.items() if k.startswith(("critic.", "value_norm."))}
    return policy


def _from_pool(run: Path, which: str) -> Policy:
    """A frozen opponent in the last checkpoint of a run of self-play."""
    learner = _from_run(run)
    state, tensors = load_checkpoint(checkpoints(run)[-1])
    league = state.get("selfplay", {}).get("league", {"entries": [], "slots": []})
    names = [
        "rival" if entry["kind"] == "rival" else str(entry["samples"])
        for entry in league["entries"]
    ]
    if which not in names:
        have = f"it has {', '.join('@' + name for name in names)}" if names else "it has none"
        raise PolicyError(f"the run '{run}' has no opponent '@{which}': {have}")
    slot = league["slots"].index(names.index(which))
    stack = {k.removeprefix("selfplay/stack."): x for k, x in tensors.items() if "/stack." in k}
    weights, mean, std = unstacked(stack, slot)
    card = {
        **learner.metadata,
        "samples": int(league["entries"][names.index(which)]["samples"]),
        "metrics": {},
        "obs_mean": mean.tolist(),
        "obs_std": std.tolist(),
    }
    policy = _signed(card, weights, f"{run}@{which}")
    policy.prior = learner.prior
    return policy


def _signed(card: dict[str, Any], weights: dict[str, Tensor], where: str) -> Policy:
    """Of weights that are in no file of their own: the card gets their sha256."""
    return _build({**card, "sha256": hashlib.sha256(save(weights)).hexdigest()}, weights, where)


def _from_file(path: Path) -> Policy:
    if path.suffix == ".json":
        path = path.with_suffix(".safetensors")
    card_path = path.with_suffix(".json")
    try:
        data = path.read_bytes()
        weights = load_safetensors(data)
    except (OSError, SafetensorError, ValueError) as error:
        raise PolicyError(
            f"'{path}' is not a policy: it is no whole safetensors file ({error})"
        ) from error
    try:
        card = json.loads(card_path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise PolicyError(f"the policy's card '{card_path}' cannot be read ({error})") from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise PolicyError(f"'{card_path}' is not the card of a policy of this project")
    if card.get("sha256") != hashlib.sha256(data).hexdigest():
        raise PolicyError(f"'{path}' does not belong to its card: the sha256 differs")
    try:
        weights = unpacked(weights)
    except ValueError as error:
        raise PolicyError(f"the weights of policy '{path}' are damaged: {error}") from None
    extra = {k: v for k, v in weights.items() if k.startswith(("critic.", "value_norm."))}
    actor = {k: v.float() for k, v in weights.items() if k not in extra}
    policy = _build(card, actor, str(path))
    policy.extra = {k: v.float() if k.startswith("critic.") else v for k, v in extra.items()}
    run = [path.parent.parent] if path.parent.name == KEPT else []
    return _with_prior(policy, path.parent, *run)


def _with_prior(policy: Policy, *folders: Path) -> Policy:
    """The policy with its latent prior, from its own folders or where priors are. Raises
    PolicyError where there is none."""
    latent = policy.metadata["algo"].startswith("latent")
    card = policy.metadata.get("latent")
    if latent != isinstance(card, dict):
        raise PolicyError("the policy's card does not say through which latent prior it acts")
    if latent and card is not None:
        try:
            policy.prior = find_prior(str(card["prior_digest"]), folders)
        except (PriorError, KeyError) as error:
            raise PolicyError(str(error)) from error
    return policy


def _build(card: dict[str, Any], weights: dict[str, Tensor], where: str) -> Policy:
    """Network and statistics from a card. Raises PolicyError naming what is wrong with it."""
    algo = card.get("algo")
    if isinstance(algo, str) and algo not in ALGORITHMS:
        raise PolicyError(
            f"the policy '{where}' is of algorithm '{algo}', which cannot be played or "
            f"trained on here: use one of {', '.join(ALGORITHMS)}"
        )
    for name, kind in _REQUIRED.items():
        value = card.get(name)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind):
            raise PolicyError(f"the card of policy '{where}' lacks a proper '{name}'")
    sizes = [card["obs_size"], *card["hidden"], card["action_size"]]
    if len(sizes) > MAX_LAYERS or not all(isinstance(n, int) and 0 < n < MAX_WIDTH for n in sizes):
        raise PolicyError(f"the card of policy '{where}' has impossible layer sizes {sizes}")
    try:
        mean = torch.tensor(card["obs_mean"], dtype=torch.float32)
        std = torch.tensor(card["obs_std"], dtype=torch.float32)
        with torch.device("meta"):  # no memory before the weights are known to fit
            actor = MLP(sizes[0], sizes[1:-1], sizes[-1], card["activation"])
        actor.load_state_dict(weights, assign=True)
    except (RuntimeError, ValueError, TypeError) as error:
        raise PolicyError(f"the weights of policy '{where}' do not fit its card: {error}") from None
    finite = all(torch.isfinite(x).all() for x in (mean, std, *weights.values()))
    if mean.shape != (sizes[0],) or std.shape != (sizes[0],) or not finite or (std <= 0).any():
        raise PolicyError(f"the policy '{where}' holds numbers that are missing or not finite")
    actor.float().requires_grad_(False)
    return Policy(actor, mean, std, card)


def export_policy(
    run: Path | str | Policy,
    out: Path | str,
    *,
    metrics: dict[str, Any] | None = None,
    metrics_of: str = "",
    looks: str = "",
    critic: bool = False,
    precision: Literal["float16", "int8"] = "float16",
    observed: Callable[[Policy], Tensor] | None = None,
) -> Path:
    """Writes an actor as ``OUT.safetensors`` and ``OUT.json``; returns the former.

    Args:
        run: a run's folder, of which the last checkpoint is taken, ``RUN@SAMPLES``, a policy
            file, or a policy.
        out: target; any suffix becomes ``.safetensors``.
        metrics: an evaluation's metrics for the card; the run's last ones if None.
        metrics_of: sha256 of the policy that was evaluated, where it is known: it must be the
            run's (its last checkpoint) or that of this export.
        looks: what the motion looks like, in words.
        critic: keep the critic too, so that fine-tuning need not begin without one.
        precision: of the weights; int8 takes half the room, matrices row by row (``rl/int8.py``).
        observed: gives observations (..., obs) of the policy; int8 weights are rounded so that its
            actions there change least, instead of each by itself.

    Raises PolicyError when there is no readable checkpoint or policy, when its weights do not fit
    fp16, and for metrics of another policy.
    """
    policy = run if isinstance(run, Policy) else read_policy(run, "")
    name = policy.metadata["task"] if isinstance(run, Policy) else run
    if policy.actor is None:
        raise PolicyError(f"'{name}' is a baseline: it has no weights to export")
    weights = dict(policy.actor.state_dict())
    if critic:
        weights |= policy.extra
    try:
        kept = _halves(weights)
    except ValueError as error:
        raise PolicyError(f"the weights of run '{name}' {error}") from None
    if precision == "int8":
        kept = packed(kept)
        if observed is not None:
            kept |= fitted(policy.actor, policy.inputs(observed(policy)).flatten(0, -2))
    data = save(kept)
    digest = hashlib.sha256(data).hexdigest()
    if metrics_of and metrics_of not in (policy.metadata["sha256"], digest):
        raise PolicyError(
            f"the metrics are of another policy ({metrics_of[:12]}...) than the last checkpoint "
            f"of '{name}': evaluate that one"
        )
    card: dict[str, Any] = {**policy.metadata, "precision": precision}
    if metrics is not None:
        card["metrics"] = metrics
    if looks:
        card["looks"] = looks
    return write_policy(data, card, out)


def packed_weights(weights: dict[str, Tensor]) -> bytes:
    """The content of a policy's weight file in float16. Raises ValueError where they do not fit."""
    return save(_halves(weights))


def _halves(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weights in float16. Raises ValueError where they do not fit."""
    halves = {  # running moments stay in float64
        k: v.contiguous() if k.startswith("value_norm.") else v.half().contiguous()
        for k, v in weights.items()
    }
    if not all(torch.isfinite(v).all() for v in halves.values()):
        raise ValueError("do not fit fp16")
    return halves


def write_policy(data: bytes, card: dict[str, Any], out: Path | str) -> Path:
    """Writes ``packed_weights`` and their card, which gets their sha256 and keeps no path of this
    machine; returns the path, whose suffix is always ``.safetensors``."""
    digest = hashlib.sha256(data).hexdigest()
    card = {**card, "sha256": digest, "config": portable(card.get("config", {}))}
    path = Path(out).with_suffix(".safetensors")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, data)
    write_text(path.with_suffix(".json"), card_text(card))
    return path
