"""The latent prior as one artefact: decoder, prior, encoder and their observation normaliser.

``prior(s)`` says which latents z a person in state s is likely to use, ``decoder(s, z)`` turns one
into PD targets, ``encoder(s, goal)`` finds the one that follows a reference (PULSE; Luo et al.
2024). The state s is the athlete's own body (``sports.frames.proprioception``), alike in every
task; the normaliser is the one that the networks learned with, and never changes.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_safetensors
from safetensors.torch import save
from torch import Tensor, nn

from rl import pretrained
from rl.card import card_text
from rl.checkpoint import CheckpointError, checkpoints, load_checkpoint
from rl.networks import MLP
from rl.prior_pose import PosePart
from rl.provenance import portable
from rl.steady import BALANCE, Steady
from sports.frames import proprioception_slices
from sports.humanoid.body import Body, load_body
from warmstart.atomic import write_bytes, write_text

FORMAT = "olympics-opt prior 1"
FILE = "prior.safetensors"
"""Name of a prior in the folder of a run that made it, or uses it."""
SEARCH = "OLYMPICS_OPT_PRIORS"
"""Environment variable: folders in which priors are looked for."""
LOGVAR = (-5.0, 2.0)
"""Log variances are clamped to this (PULSE)."""
HEAD_GAIN = 0.1  # of the networks' last layers at first
_SIZES = ("obs_size", "self_size", "action_size", "latent")
_HIDDEN = ("encoder", "prior", "decoder")
MAX_WIDTH, MAX_LAYERS = 1 << 16, 64
_STEADY = "steady."


class PriorError(ValueError):
    """A prior cannot be used here; the message is a sentence with the remedy."""


@dataclass(frozen=True)
class Shape:
    """Sizes of the three networks."""

    obs_size: int
    """What the encoder sees: the body and the goal."""
    self_size: int
    """What prior and decoder see: the first numbers of it, the body alone."""
    action_size: int
    latent: int
    encoder: tuple[int, ...]
    """Hidden layers."""
    prior: tuple[int, ...]
    decoder: tuple[int, ...]
    activation: str = "silu"
    pose: bool = False
    """Decoder and encoder work around the pose (``rl.prior_pose``); the first priors did not."""

    @staticmethod
    def of(card: Mapping[str, Any]) -> Shape:
        """From a card. Raises ValueError where it does not hold one."""
        try:
            numbers: dict[str, Any] = {k: card[k] for k in _SIZES}
            hidden: dict[str, Any] = {k: tuple(card["hidden"][k]) for k in _HIDDEN}
            activation, pose = str(card["activation"]), card.get("pose", False)
        except (KeyError, TypeError) as error:
            raise ValueError(f"its sizes are missing ({error})") from None
        widths = [*numbers.values(), *(n for h in hidden.values() for n in h)]
        proper = all(type(n) is int and 0 < n < MAX_WIDTH for n in widths)
        if not proper or len(widths) > MAX_LAYERS:
            raise ValueError(f"its layer sizes {widths} are impossible")
        if not isinstance(pose, bool):
            raise ValueError(f"its 'pose' is neither true nor false ({str(pose)[:40]})")
        return Shape(**numbers, **hidden, activation=activation, pose=pose)

    def card(self) -> dict[str, Any]:
        """As it stands on a card."""
        numbers = {k: getattr(self, k) for k in _SIZES}
        hidden = {k: list(getattr(self, k)) for k in _HIDDEN}
        return {**numbers, "hidden": hidden, "activation": self.activation, "pose": self.pose}


class LatentNets(nn.Module):
    """Encoder, prior and decoder on normalised observations."""

    def __init__(self, shape: Shape, generator: torch.Generator | None = None) -> None:
        super().__init__()
        s, act = shape, shape.activation
        self.shape = shape
        self.part: PosePart | None = None
        """See ``see_pose``."""
        z2, seen = 2 * s.latent, s.obs_size + s.pose * s.action_size
        self.encoder = MLP(seen, s.encoder, z2, act, HEAD_GAIN, generator)  # type: ignore[arg-type]
        self.prior = MLP(s.self_size, s.prior, z2, act, HEAD_GAIN, generator)  # type: ignore[arg-type]
        inputs = s.self_size + s.latent
        self.decoder = MLP(inputs, s.decoder, s.action_size, act, HEAD_GAIN, generator)  # type: ignore[arg-type]

    def posterior(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """(..., D) -> mean and log variance (..., Z) of the latent that follows the goal."""
        if self.shape.pose:
            assert self.part is not None
            obs = torch.cat((obs, self.part.difference(obs).to(obs.dtype)), -1)
        return _split(self.encoder(obs))

    def expected(self, body: Tensor) -> tuple[Tensor, Tensor]:
        """(..., S) -> mean and log variance (..., Z) of the prior."""
        return _split(self.prior(body))

    def decode(self, body: Tensor, z: Tensor) -> Tensor:
        """(..., S), (..., Z) -> (..., n) PD targets in units of the body's action scale."""
        action = self.decoder(torch.cat((body, z.to(body.dtype)), -1))
        assert self.part is not None or not self.shape.pose
        return action if self.part is None else self.part.pose(body) + action

    def see_pose(self, body: Body, mean: Tensor, std: Tensor) -> None:
        """Says how observations of a ``body`` were normalised, (D,) or (S,): needed before the
        first use where ``shape.pose``, without effect elsewhere."""
        if self.shape.pose:
            own = proprioception_slices(body.num_links)["body_rot"]
            self.part = PosePart(body, own, mean, std).to(self.decoder.head.weight.device)


def _split(moments: Tensor) -> tuple[Tensor, Tensor]:
    mean, logvar = moments.chunk(2, -1)
    return mean, logvar.clamp(*LOGVAR)


def body_digest(body: Body) -> str:
    """sha256 of what a prior knows of a body: its links and how they hang together, the order of
    its hinges and the radians of their actions. Gains, torques and equipment do not count."""
    links = [(link.name, link.parent, [round(x, 6) for x in link.offset]) for link in body.links]
    scale = [round(float(x), 6) for x in body.action_scale()]
    whole = json.dumps([body.name, links, [d.name for d in body.dofs], scale])
    return hashlib.sha256(whole.encode()).hexdigest()


def self_layout(num_links: int) -> dict[str, list[int]]:
    """Where the parts of the athlete's own body lie in an observation, for a card."""
    return {k: [s.start, s.stop] for k, s in proprioception_slices(num_links).items()}


def check_layout(layout: Mapping[str, Sequence[int]], slices: Mapping[str, slice]) -> None:
    """Raises PriorError unless observations begin with that ``layout`` of the own body."""
    for name, (start, stop) in layout.items():
        found = slices.get(name)
        if found is None or (found.start, found.stop) != (start, stop):
            raise PriorError(
                f"the prior sees '{name}' of the athlete in places {start} to {stop} of an "
                "observation, this task shows it elsewhere: distil a prior with this version"
            )


class LatentPrior:
    """Frozen networks with their normaliser. Observations are raw; everything in float32."""

    def __init__(
        self,
        nets: LatentNets,
        mean: Tensor,
        std: Tensor,
        card: dict[str, Any],
        encoder: bool,
        steady: Steady | None = None,
    ) -> None:
        """Args:
        nets: the networks; they are frozen here.
        mean: (D,) of the observations, or (S,) without an encoder.
        std: likewise.
        card: see ``save_prior``.
        encoder: whether ``nets`` has one that learned.
        steady: what moves the prior's mean so that it stays on its feet, if it has learned to.
        """
        self.nets = nets.float().requires_grad_(False)
        self.mean, self.std, self.card, self.encoder = mean, std, card, encoder
        self.clip = float(card["observation_clip"])
        self.size = nets.shape.self_size
        """S, numbers of the athlete's own body, the first of every observation."""
        self.latent = nets.shape.latent
        self.steady = steady

    def to(self, device: torch.device | str) -> LatentPrior:
        """The same on a device (moved in place)."""
        self.nets.to(device)
        self.mean, self.std = self.mean.to(device), self.std.to(device)
        if self.steady is not None:
            self.steady.to(device)
        return self

    def _normalized(self, obs: Tensor, size: int) -> Tensor:
        x = (torch.nan_to_num(obs[..., :size]) - self.mean[:size]) / self.std[:size]
        return x.clamp(-self.clip, self.clip)

    @torch.no_grad()
    def moments(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """(..., D >= S) observations -> mean and standard deviation (..., Z) of the prior."""
        mean, logvar = self.nets.expected(self._normalized(obs, self.size))
        sigma = (0.5 * logvar).exp()
        if self.steady is not None:
            mean = mean + sigma * self.steady(obs[..., : self.size])
        return mean, sigma

    @torch.no_grad()
    def posterior(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """(..., D) observations with a goal -> mean and standard deviation (..., Z)."""
        if not self.encoder:
            raise PriorError("this prior was saved without its encoder: it cannot follow clips")
        mean, logvar = self.nets.posterior(self._normalized(obs, self.nets.shape.obs_size))
        return mean, (0.5 * logvar).exp()

    @torch.no_grad()
    def decode(self, obs: Tensor, z: Tensor) -> Tensor:
        """(..., D >= S), (..., Z) -> (..., n) PD targets over the body's action scale."""
        return self.nets.decode(self._normalized(obs, self.size), z)

    @cached_property
    def digest(self) -> str:
        """sha256 of all that a task's policy depends on: decoder, prior and their normaliser."""
        whole = hashlib.sha256(json.dumps(self.clip).encode())
        if self.nets.shape.pose:
            whole.update(b"pose")
        weights = self.nets.state_dict()
        for name in sorted(k for k in weights if not k.startswith("encoder.")):
            whole.update(name.encode() + weights[name].cpu().contiguous().numpy().tobytes())
        for row in (self.mean, self.std):
            whole.update(row[: self.size].cpu().contiguous().numpy().tobytes())
        if self.steady is not None:
            whole.update(json.dumps(self.steady.card()).encode())
            for name, value in sorted(self.steady.state_dict().items()):
                whole.update(name.encode() + value.cpu().contiguous().numpy().tobytes())
        return whole.hexdigest()


def save_prior(prior: LatentPrior, out: Path | str, *, half: bool, encoder: bool = True) -> Path:
    """Writes ``OUT.safetensors`` and its card ``OUT.json``; returns the former.

    Args:
        prior: what to write.
        out: target; any suffix becomes ``.safetensors``.
        half: weights in fp16; the normaliser stays in float32.
        encoder: keep the encoder, without which clips cannot be followed.

    Raises PriorError for weights that do not fit fp16.
    """
    if half:
        prior = halved(prior)
    keep = encoder and prior.encoder
    weights = {k: v for k, v in prior.nets.state_dict().items() if keep or "encoder" not in k}
    if prior.steady is not None:
        weights |= {f"{_STEADY}{k}": v for k, v in prior.steady.net.state_dict().items()}
    kind = torch.float16 if half else torch.float32
    tensors = {k: v.detach().cpu().to(kind).contiguous() for k, v in weights.items()}
    size = prior.nets.shape.obs_size if keep else prior.size
    for name in ("mean", "std"):
        row = getattr(prior, name)[:size]
        tensors[f"normalizer.{name}"] = row.detach().float().cpu().contiguous().clone()
        if prior.steady is not None:
            tensors[f"{_STEADY}{name}"] = getattr(prior.steady, name).cpu().contiguous()
    data = save(tensors)
    digest = hashlib.sha256(data).hexdigest()
    precision = "float16" if half else "float32"
    card = {**prior.card, "precision": precision, "sha256": digest, "digest": prior.digest}
    if isinstance(card.get("config"), dict):
        card["config"] = portable(card["config"])
    path = Path(out).with_suffix(".safetensors")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, data)
    write_text(path.with_suffix(".json"), card_text(card))
    return path


def halved(prior: LatentPrior) -> LatentPrior:
    """The prior with weights rounded to fp16, as its file will hold them. Raises PriorError for
    weights that do not fit."""
    nets = LatentNets(prior.nets.shape)
    weights = {k: v.cpu().half().float() for k, v in prior.nets.state_dict().items()}
    if not all(torch.isfinite(v).all() for v in weights.values()):
        raise PriorError("the weights of the prior do not fit fp16: write it in float32")
    nets.load_state_dict(weights)
    mean, std = prior.mean.cpu(), prior.std.cpu()
    nets.see_pose(load_body(str(prior.card["body"])), mean, std)
    card = {**prior.card, "precision": "float16"}
    steady = prior.steady
    if steady is not None:
        steady = deepcopy(steady).cpu()
        steady.net.half().float()
    return LatentPrior(nets, mean, std, card, prior.encoder, steady)


def load_prior(source: str | Path) -> LatentPrior:
    """A prior from ``FILE.safetensors`` with ``FILE.json`` beside it, from the folder of a run of
    the task ``prior`` (its last checkpoint, rounded to fp16 as its file is), or ``pretrained``.

    Raises PriorError when it is missing, truncated, altered, or of another kind, version or body.
    """
    path = Path(source)
    if str(source) == "pretrained":
        found = sorted((pretrained.FOLDER / "prior").glob("*.safetensors"))
        if not found:
            raise PriorError("this version ships no prior: distil one with `train prior`")
        path = found[0]
    if path.is_dir():
        return _from_run(path)
    if path.suffix == ".json":
        path = path.with_suffix(".safetensors")
    if not path.is_file():
        raise PriorError(f"there is no prior '{source}': give a file, or a run of `train prior`")
    try:
        data = path.read_bytes()
        tensors = load_safetensors(data)
    except (OSError, SafetensorError, ValueError) as error:
        raise PriorError(
            f"'{path}' is not a prior: it is no whole safetensors file ({error})"
        ) from error
    card = read_card(path)
    if card.get("sha256") != hashlib.sha256(data).hexdigest():
        raise PriorError(f"'{path}' does not belong to its card: the sha256 differs")
    prior = _build(card, tensors, str(path))
    if card.get("digest") != prior.digest:
        raise PriorError(f"the card of prior '{path}' has been altered: its digest differs")
    return prior


def read_card(path: Path) -> dict[str, Any]:
    """The card beside a prior's file. Raises PriorError where there is none of this version."""
    place = path.with_suffix(".json")
    try:
        card = json.loads(place.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise PriorError(f"the prior's card '{place}' cannot be read ({error})") from error
    kind = str(card.get("format", "")) if isinstance(card, dict) else ""
    if kind != FORMAT:
        if kind.startswith("olympics-opt prior"):
            raise PriorError(
                f"'{path}' is a prior of another version ('{kind[:40]}', this one reads "
                f"'{FORMAT}'): distil it again"
            )
        raise PriorError(f"'{place}' is not the card of a prior of this project")
    return card


def _from_run(run: Path) -> LatentPrior:
    saved = checkpoints(run)
    if not saved:
        raise PriorError(f"the run '{run}' has no checkpoint yet: train it for longer")
    try:
        state, tensors = load_checkpoint(saved[-1])
        card = dict(state["card"])
    except (CheckpointError, KeyError, TypeError, ValueError) as error:
        raise PriorError(f"the run '{run}' cannot be used: {error}") from error
    if card.get("task") == BALANCE:
        from rl.balance import steadied

        return halved(steadied(run))
    if card.get("format") != FORMAT:
        raise PriorError(
            f"the run '{run}' is of task '{card.get('task')}', not of 'prior': it holds no prior"
        )
    start = "agent/nets."
    weights = {k[len(start) :]: v for k, v in tensors.items() if k.startswith(start)}
    for name in ("mean", "std"):
        weights[f"normalizer.{name}"] = tensors[f"agent/normalizer.{name}"]
    return halved(_build(card, weights, str(run)))


def _build(card: dict[str, Any], tensors: dict[str, Tensor], where: str) -> LatentPrior:
    """Networks from a card. Raises PriorError naming what is wrong."""
    try:
        shape = Shape.of(card)
        body = load_body(str(card.get("body")))
        with torch.device("meta"):  # no memory before the weights are known to fit
            nets = LatentNets(shape)
    except ValueError as error:
        raise PriorError(f"the card of prior '{where}' is not usable: {error}") from None
    if card.get("body_digest") != body_digest(body):
        raise PriorError(
            f"the prior '{where}' was made for another build of body '{body.name}': distil it "
            "again with this version"
        )
    if card.get("layout") != self_layout(body.num_links):
        raise PriorError(
            f"the prior '{where}' sees its body in another layout than this version shows it: "
            "distil it again"
        )
    others = ("normalizer.", _STEADY)
    weights = {k: v.float() for k, v in tensors.items() if not k.startswith(others)}
    encoder = any(k.startswith("encoder.") for k in weights)
    if not encoder:
        empty = nets.encoder.state_dict()
        weights |= {f"encoder.{k}": torch.zeros(v.shape) for k, v in empty.items()}
    try:
        nets.load_state_dict(weights, assign=True)
        mean, std = tensors["normalizer.mean"].float(), tensors["normalizer.std"].float()
        clip = float(card["observation_clip"])
        steady = _build_steady(card, tensors, shape)
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        why = " ".join(str(error).split())
        raise PriorError(f"the weights of prior '{where}' do not fit its card: {why}") from None
    size = shape.obs_size if encoder else shape.self_size
    finite = all(torch.isfinite(x).all() for x in (mean, std, *weights.values()))
    if mean.shape != (size,) or std.shape != (size,) or not finite or (std <= 0).any() or clip <= 0:
        raise PriorError(f"the prior '{where}' holds numbers that are missing or not finite")
    nets.see_pose(body, mean, std)
    return LatentPrior(nets, mean, std, card, encoder, steady)


def _build_steady(card: dict[str, Any], tensors: dict[str, Tensor], shape: Shape) -> Steady | None:
    """Raises ValueError, KeyError or RuntimeError where card and weights do not fit."""
    own = {k[len(_STEADY) :]: v.float() for k, v in tensors.items() if k.startswith(_STEADY)}
    if ("steady" in card) != bool(own):
        raise ValueError("its card and its weights differ on whether it has learned to balance")
    if not own:
        return None
    steady = Steady.of(card["steady"], shape.self_size, shape.latent)
    rows = {name: own.pop(name) for name in ("mean", "std")}
    steady.load_state_dict({f"net.{k}": v for k, v in own.items()} | rows)
    finite = all(torch.isfinite(x).all() for x in steady.state_dict().values())
    if not finite or (steady.std <= 0).any():
        raise ValueError("its 'steady' part holds numbers that are not finite")
    return steady


def find_prior(digest: str, near: Iterable[Path]) -> LatentPrior:
    """The prior of a digest, from the folders ``near``, those that ``OLYMPICS_OPT_PRIORS`` names,
    and what is shipped. Raises PriorError where none of them has it."""
    named = [Path(p) for p in os.environ.get(SEARCH, "").split(os.pathsep) if p]
    folders = [*near, *named, pretrained.FOLDER / "prior"]
    for folder in folders:
        for path in sorted(folder.glob("*.safetensors")):
            try:
                if read_card(path).get("digest") == digest:
                    return load_prior(path)
            except PriorError:
                continue  # another kind of file
    places = ", ".join(f"'{f}'" for f in dict.fromkeys(folders))
    raise PriorError(
        f"the policy needs the latent prior {digest[:12]}..., which is in none of {places}: put "
        f"the prior's two files there, or name their folder in {SEARCH}"
    )
