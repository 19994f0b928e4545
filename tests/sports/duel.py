"""The smallest sport for two: stay on your feet. For tests of what every such sport relies on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from sports import registry
from sports.humanoid.body import Body, Shape
from sports.scene import Scene, SceneObject, Start
from sports.task import Advance, Task, View, place_athlete, place_object

SERVE_STEP, SERVE = 3, (0.5, 2.0, 3.0)
STAND_STEP = 5


@dataclass(frozen=True)
class Duel:
    """Options."""

    reach: float = 3.0
    """Distance between the athletes (m)."""


def scene(config: Duel, body: Body) -> Scene:
    ball = SceneObject(
        "ball", (Shape("sphere", (0, 0, 0), (0.11,), 0.43),), "free", (0.0, 2.0, 0.11)
    )
    half = config.reach / 2
    return Scene(
        name="duel",
        body=body,
        agents=(Start(-half), Start(half, 0.0, math.pi, pose={"L_Elbow_z": -0.5})),
        objects=(ball,),
        contact_pairs=(("agent0/R_Hand:0", "agent1"), ("agent0/R_Hand", "agent1")),
        link_contacts=True,
    )


def begin(view: View, context: dict) -> dict:
    return {"steps": torch.zeros_like(view.root_pos[:, 0, 0])}


def features(view: View, memory: dict) -> dict:
    root = view.root_pos
    return {"opponent": view.heading.local(root.flip(1) - root)}


def advance(view: View, memory: dict) -> Advance:
    steps = memory["steps"] + 1
    n = len(steps)
    serve = torch.tensor(SERVE).expand(n, 3)
    move = place_object(view, steps == SERVE_STEP, "ball", serve, torch.zeros(n, 3))
    zero = torch.zeros(n)
    move = place_athlete(view, steps == STAND_STEP, 1, zero + 4.0, zero, zero, onto=move)
    return Advance(
        memory={"steps": steps},
        terms={"height": view.root_pos[..., 2]},
        terminated=view.fallen(),
        metrics={"steps": steps},
        success=torch.zeros(n, dtype=torch.bool),
        move=move,
    )


TASK = Task(
    name="duel",
    config=Duel,
    scene=scene,
    start=lambda view, state, context, generator, training: (state, {}),
    begin=begin,
    features=features,
    advance=advance,
    metrics={"steps": "steps"},
    main_metric="steps",
    max_steps=40,
)


def register(monkeypatch) -> None:
    monkeypatch.setitem(registry._TASKS, "duel", TASK)
