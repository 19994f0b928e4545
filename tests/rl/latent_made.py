"""Small trackers and latent priors, made up or hardly trained."""

from __future__ import annotations

from pathlib import Path

import torch

from rl.ppo import PPOConfig
from rl.prior import FORMAT, LatentNets, LatentPrior, Shape, body_digest, self_layout
from rl.train import TrainConfig, train
from sports.humanoid.body import load_body
from warmstart.bank import demonstration_files
from warmstart.clip import Clip
from warmstart.library import pack

OPTIONS = {"split": "all", "latent": 6, "encoder": (32,), "prior": (32,), "decoder": (32,)}
OPTIONS |= {"steps": 4, "minibatches": 2, "epochs": 2}


def made_prior(body: str = "smpl", seed: int = 0, latent: int = 6) -> LatentPrior:
    """Random networks, wide awake, with a random normaliser."""
    table = load_body(body)
    layout = self_layout(table.num_links)
    size = layout["body_angvel"][1]
    shape = Shape(size + 24 * table.num_links, size, table.num_dofs, latent, (24,), (16,), (40, 24))
    g = torch.Generator().manual_seed(seed)
    nets = LatentNets(shape, g)
    for net in (nets.encoder, nets.prior, nets.decoder):
        net.head.weight.data *= 3.0
        net.head.bias.data.normal_(0.0, 0.1, generator=g)
    mean = torch.randn(shape.obs_size, generator=g)
    std = 0.5 + torch.rand(shape.obs_size, generator=g)
    card = {
        "format": FORMAT,
        "task": "prior",
        "body": body,
        "body_digest": body_digest(table),
        "layout": layout,
        "observation_clip": 5.0,
        "strength": "paper",
        "limits": "paper",
        **shape.card(),
    }
    return LatentPrior(nets, mean, std, card, encoder=True)


def golf() -> Clip:
    return Clip.load(next(f for f in demonstration_files("golf") if "12mps" in f.name))


def golf_library(folder: Path) -> Path:
    path = folder / "golf.npz"
    pack([("golf", golf())]).save(path)
    return path


def teacher_run(folder: Path) -> Path:
    """A tracker after three updates."""
    clips = golf_library(folder)
    config = TrainConfig(
        task="tracking",
        out=folder / "tracker",
        clips=(clips,),
        options={"split": "all"},
        worlds=8,
        samples=4 * 8 * 4,
        quiet=True,
        ppo=PPOConfig(hidden=(32,), steps=4, minibatches=2, epochs=1, sigma=0.1),
    )
    train(config)
    return config.out


def prior_config(folder: Path, name: str = "prior", **changes) -> TrainConfig:
    """A run of the task ``prior`` that learns from ``teacher_run`` in the same folder."""
    plain = {"worlds": 8, "samples": 4 * 8 * 4, "quiet": True, "options": OPTIONS}
    return TrainConfig(
        task="prior",
        out=folder / name,
        tracker=str(folder / "tracker"),
        clips=(folder / "golf.npz",),
        **{**plain, **changes},
    )
