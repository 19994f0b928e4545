"""Plays a latent prior alone: latents drawn from it, decoded, and nothing else to steer by.

An athlete who stays on its feet for ten seconds shows that prior and decoder know how to move from
any state that they lead to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from rl.host import one_torch_thread
from rl.motion import MotionTables
from rl.prior import LatentPrior, body_digest, check_layout
from rl.tracking_terms import least_turn
from sports.env import Env
from sports.humanoid.body import load_body
from sports.physics import PhysicsState, make_physics
from sports.scene import humanoid_scene
from sports.task import Advance, Memory, Task, View
from warmstart.library import FPS, Library

Kind = Literal["each", "held", "smooth", "mean"]


@dataclass(frozen=True)
class Sampler:
    """How latents z = mu + temperature x sigma x noise are drawn from the prior of each state."""

    kind: Kind = "each"
    """each: new noise every step, as a variational autoencoder is sampled; held: the same noise
    for ``hold`` steps; smooth: noise that forgets within about ``hold`` steps; mean: none."""
    hold: int = 10
    """Control steps."""
    temperature: float = 1.0
    """Times the prior's standard deviation."""

    def __post_init__(self) -> None:
        if self.kind not in ("each", "held", "smooth", "mean"):
            raise ValueError(f"unknown sampler '{self.kind}'; known: each, held, smooth, mean")
        if self.hold < 1 or self.temperature < 0.0:
            raise ValueError("hold must be at least 1, temperature not negative")

    def noise(self, last: Tensor | None, step: int, fresh: Tensor) -> Tensor:
        """(N, Z) of a step from that of the last and from ``fresh`` standard normal numbers; of
        unit variance but for ``mean``."""
        if self.kind == "mean":
            return torch.zeros_like(fresh)
        if last is None or self.kind == "each":
            return fresh
        if self.kind == "held":
            return fresh if step % self.hold == 0 else last
        keep = math.exp(-1.0 / self.hold)
        return keep * last + math.sqrt(1.0 - keep * keep) * fresh


@dataclass(frozen=True)
class Played:
    """What came of playing a prior alone in N worlds."""

    upright: np.ndarray
    """(N,) seconds before a fall; the whole time without one."""
    seconds: float
    speed: np.ndarray
    """(N,) mean horizontal speed of the root while upright (m/s)."""
    qpos: np.ndarray
    """(W, T, 7 + n) states of the first worlds."""
    qvel: np.ndarray
    """(W, T, 6 + n)"""
    trouble: dict[str, int] = field(default_factory=dict)
    """``nan_worlds`` and ``overflow`` of the engine."""

    @property
    def standing(self) -> np.ndarray:
        """(N,) bool: never fell."""
        return self.upright >= self.seconds


def upright_frames(tables: MotionTables) -> Tensor:
    """(K,) frames of the clips, mirrored ones too, in which a person is on its feet: one of them on
    the ground, nothing else low or touching. Raises ValueError where there is none."""
    body = load_body(tables.library.body)
    feet = torch.tensor([n.endswith(("Ankle", "Toe")) for n in body.link_names])
    frames = torch.arange(len(tables.last), device=tables.device)
    contact, height = tables.contact(frames), tables.at(frames).pos[..., 2]
    feet = feet.to(tables.device)
    others = ~feet & ((contact > 0) | (height < 0.3))
    behind = frames > tables.last  # the frame added behind a clip
    on_feet = (contact[:, feet] > 0).any(-1) & ~others.any(-1) & ~behind
    found = on_feet.nonzero()[:, 0]
    if not len(found):
        raise ValueError("no clip shows a person on its feet: give another library")
    return found


def free_task(tables: MotionTables, frames: Tensor, body: str) -> Task:
    """An athlete alone, who begins in one of the ``frames``; nothing ends an episode."""

    def start(
        view: View, state: PhysicsState, context: Memory, generator: torch.Generator, training: bool
    ) -> tuple[PhysicsState, Memory]:
        draw = torch.rand(len(state.qpos), generator=generator, device=frames.device)
        chosen = frames[(draw * len(frames)).long().clamp(max=len(frames) - 1)]
        qpos, qvel = least_turn(*tables.state(chosen))
        return PhysicsState(qpos, qvel, state.mocap_pos, state.wave_phase), {}

    def advance(view: View, memory: Memory) -> Advance:
        no = torch.zeros_like(view.fallen())
        return Advance(memory, {"none": no.float()}, no, {}, no[:, 0])

    return Task(
        name="prior",
        config=Sampler,
        scene=lambda config, athlete: humanoid_scene(athlete),
        start=start,
        begin=lambda view, context: {},
        features=lambda view, memory: {},
        advance=advance,
        metrics={},
        main_metric="",
        max_steps=1 << 30,
        body=body,
    )


def play_prior(
    prior: LatentPrior,
    library: Library,
    *,
    engine: str = "mujoco",
    num_worlds: int = 64,
    seconds: float = 10.0,
    sampler: Sampler | None = None,
    seed: int = 0,
    keep: int = 0,
    physics_options: dict[str, Any] | None = None,
) -> Played:
    """Starts every world in a drawn frame of a person on its feet and samples the prior.

    Args:
        prior: what to play, with the athlete that it was made for.
        library: clips whose frames begin it.
        engine: ``mujoco``, ``warp`` or ``drake``.
        num_worlds: N.
        seconds: of each world.
        sampler: see Sampler; new noise every step by default.
        seed: of starts and latents.
        keep: worlds W whose states are returned.
        physics_options: the engine's options.

    A fall is that of every sport (``View.fallen``); a world that diverges has fallen.
    Raises ValueError for clips of another body or settings that cannot be.
    """
    sampler = sampler or Sampler()
    steps = round(seconds * FPS)
    if num_worlds < 1 or steps < 1:
        raise ValueError("there must be at least one world and one control step")
    card = prior.card
    strength, limits = str(card.get("strength", "paper")), str(card.get("limits", "paper"))
    body = load_body(library.body, strength=strength, limits=limits)  # type: ignore[arg-type]
    if body_digest(body) != card["body_digest"]:
        raise ValueError(f"the prior is of body '{card['body']}', the clips of '{library.body}'")
    physics = make_physics(engine, humanoid_scene(body), num_worlds, **(physics_options or {}))
    tables = MotionTables(library, physics.device)
    task = free_task(tables, upright_frames(tables), library.body)
    env = Env(task, sampler, physics, seed=seed, training=False)
    env.own_turns = True
    try:
        check_layout(card["layout"], env.obs_slices)
        prior.to(env.device)
        with one_torch_thread(env.device), torch.no_grad():
            return _play(prior, env, steps, sampler, seed, min(keep, num_worlds))
    finally:
        env.close()


def _play(
    prior: LatentPrior, env: Env, steps: int, sampler: Sampler, seed: int, keep: int
) -> Played:
    generator = torch.Generator(env.device).manual_seed(seed)
    env.keep_snapshot = keep > 0
    obs = env.reset()
    standing = torch.ones(env.num_worlds, dtype=torch.bool, device=env.device)
    held = torch.zeros(env.num_worlds, device=env.device)
    way = torch.zeros(env.num_worlds, device=env.device)
    noise, states = None, []
    size = (env.num_worlds, prior.latent)
    for step in range(steps):
        fresh = torch.randn(size, generator=generator, device=env.device)
        noise = sampler.noise(noise, step, fresh)
        mean, sigma = prior.moments(obs)
        latent = mean + sampler.temperature * sigma * noise[:, None]
        result = env.step(prior.decode(obs, latent) - env.action_offset / env.action_scale)
        obs = result.obs
        standing &= result.valid & ~env.view.fallen()[:, 0]
        held += standing
        way += standing * torch.linalg.vector_norm(env.view.root_linvel[:, 0, :2], dim=-1)
        if keep:
            last = env.final_snapshot
            states.append(torch.cat((last["qpos"][:keep], last["qvel"][:keep]), 1).cpu())
    physics = env.physics
    path = torch.stack(states, 1).double().numpy() if states else np.zeros((0, 0, 1))
    split = physics.qpos.shape[1]
    return Played(
        upright=(held / FPS).double().cpu().numpy(),
        seconds=steps / FPS,
        speed=(way / held.clamp(min=1.0)).double().cpu().numpy(),
        qpos=path[..., :split],
        qvel=path[..., split:],
        trouble={"nan_worlds": int(physics.nan_worlds), "overflow": int(physics.overflow)},
    )
