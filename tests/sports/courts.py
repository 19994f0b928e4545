"""Scenes with a ball of the ball law, and the law alone without an engine, for tests."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from sports.ball import ball_of
from sports.ball_law.compiled import for_cpu
from sports.ball_law.play import ANGVEL, ATTITUDE, LINVEL, POS
from sports.humanoid import load_body
from sports.humanoid.body import Shape
from sports.humanoid.mjcf import build_model
from sports.physics import make_physics
from sports.physics.game import build_game
from sports.scene import Scene, SceneObject, Start, Surface

COURT = Surface("court", "plane")
NET = Surface("net", "box", center=(0.0, 0.0, 0.5), size=(0.01, 5.0, 0.5), restitution=0.1)
TABLE = Surface("table", "box", center=(0.0, 0.0, 0.73), size=(1.37, 0.7625, 0.03))
RACKET = Surface(
    "racket", "disc", center=(0.0, -0.35, 0.0), size=(0.15, 0.01), link="agent0/R_Wrist"
)
CLUB = Surface(
    "club", "box", center=(0.0, -1.14, 0.0), size=(0.05, 0.025, 0.02), link="agent0/R_Hand"
)
WAVES = Surface("turf", "waves", size=(0.25, 2 * math.pi / 10, 2.0, 6.0))
EQUIPMENT = {"racket": "racket", "club": "club"}


def court(
    law: str = "tennis",
    surfaces: tuple[Surface, ...] = (COURT,),
    pos: tuple[float, float, float] = (0.0, 0.0, 1.0),
    **fields: object,
) -> Scene:
    """A ball among surfaces; the athlete, 30 m away, holds the tools."""
    equipment = [EQUIPMENT[s.name] for s in surfaces if s.name in EQUIPMENT]
    ball = ball_of(law)
    shape = Shape("sphere", (0.0, 0.0, 0.0), (ball.radius,), ball.mass)
    scene = Scene(
        name="court",
        body=load_body(equipment=equipment),
        agents=(Start(0.0, 30.0, 0.0),),
        objects=(SceneObject("ball", (shape,), "ball", pos, law=law),),
        surfaces=surfaces,
    )
    return dataclasses.replace(scene, **fields)  # type: ignore[arg-type]


class Law:
    """N balls of a scene by the law alone, double precision; tools go where the test puts them."""

    def __init__(self, scene: Scene, num_worlds: int) -> None:
        self.scene, self.n = scene, num_worlds
        self.model = build_model(scene)
        self.game = build_game(scene, self.model, num_worlds)
        self.game.state[:, ATTITUDE] = 1.0
        for pose in (self.game.before, self.game.after):
            pose[..., 3] = 1.0
            pose[..., 0] = 1e3  # out of the way
        self.law = for_cpu()
        assert scene.ball is not None and scene.ball.law is not None
        self.ball = ball_of(scene.ball.law)

    @property
    def pos(self) -> np.ndarray:
        return self.game.state[:, POS : POS + 3]

    @property
    def linvel(self) -> np.ndarray:
        return self.game.state[:, LINVEL : LINVEL + 3]

    @property
    def angvel(self) -> np.ndarray:
        return self.game.state[:, ANGVEL : ANGVEL + 3]

    def energy(self) -> np.ndarray:
        """(N,) kinetic and potential, J."""
        m, r = self.ball.mass, self.ball.radius
        spin = 0.5 * self.ball.shell * m * r**2 * (self.angvel**2).sum(1)
        return 0.5 * m * (self.linvel**2).sum(1) + spin + m * 9.81 * self.pos[:, 2]

    def step(self, dt: float) -> None:
        """A substep of every world, after which the tools are where they went."""
        for w in range(self.n):
            self.law.play(self.game, w, dt)
        self.game.before[:] = self.game.after


def engine(name, scene, n, **options):
    if name == "warp":
        pytest.importorskip("mujoco_warp")
        options["device"] = "cpu"
    if name == "mujoco":
        options["threads"] = 2
    return make_physics(name, scene, n, **options)


def everyone(n):
    return torch.ones(n, dtype=torch.bool)


def in_front_of_the_racket(physics, state, away):
    """World positions (N, 3) at a distance along +x of the middle of the racket's face, which the
    wrist has turned to x; ``state`` is put into ``physics``."""
    scene = physics.scene
    state.qpos[:, 7 + scene.body.dof_index("R_Wrist_y")] = math.pi / 2
    physics.reset(everyone(physics.num_worlds), state)
    link = scene.body.link_index("R_Wrist")
    face = physics.body_pos[:, 0, link] + physics.body_rot[:, 0, link] @ torch.tensor(RACKET.center)
    return face + torch.tensor((away, 0.0, 0.0))
