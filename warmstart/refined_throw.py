"""Is a refined free throw still the one that was certified? Measured on the clip, in both engines.

What is certified of a free throw is its plan, with the ball rigid on a hand. The clip beside the
certificate is another motion: :mod:`warmstart.refine` changed the plan's targets until MuJoCo's
task counted a basket, or :mod:`warmstart.robust_throw` for both engines. So the clip is played
again with the real ball, from the task's own start and by the task's own rules, in MuJoCo and in
Drake. The ball's release is compared with the shot that was asked for: the one from where the ball
is let go that rises to the asked apex and falls through the middle of the ring. The clip is called
certified only where its plan is, and speed and direction keep the gate's limits for a throw in both
engines. What noise on its targets does to it is recorded beside that.

``python -m warmstart.refined_throw warmstart/data/free_throw_*.npz`` measures clips and writes what
it finds into them and into their certificates.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sports.env import Env
from sports.free_throw import FREE_STEPS, RIM
from sports.physics.base import GRAVITY
from warmstart import strike, thrown
from warmstart.certificate import Certificate
from warmstart.clip import Clip
from warmstart.judged import RULES
from warmstart.performance import perform

TASK = "free_throw"
MOTION = "refined in MuJoCo from a certified throw"
"""What a clip is, in its own ``meta`` and in ``list``, that does not say so itself."""
ENGINES = ("mujoco", "drake")
NOISE, THROWS = 1e-3, 8
"""Standard deviation of what is added to every target of every control step (rad), and how often,
to see whether a throw is one by luck."""


def limits() -> dict[str, float]:
    """The gate's limits: ``speed_off`` (of the asked speed) and ``direction_off`` (deg)."""
    gate = strike.limits(RULES[TASK])
    names = {"speed_off": "speed off", "direction_off": "direction off"}
    return {name: gate[f"replay in mujoco: {words}"][1] for name, words in names.items()}


def measure(clip: Clip, engine: str) -> dict[str, float]:
    """The throw of a clip's targets with the real ball in an engine, from the task's own start.

    All at the first control step (1/30 s) at whose end the ball has been free for the whole of it:
    ``release_time`` (s), ``release_height`` (m), ``release_speed`` (m/s), ``angle`` above the
    horizontal (deg); ``asked_speed`` and ``asked_angle`` of the shot from there with the asked
    apex; ``speed_off`` (of the asked speed), ``direction_off`` (deg, in space); ``apex`` above the
    rim and ``miss`` of the ring's middle by the parabola (m); ``basket``: 1 where the task counts
    one. Raises ValueError for a clip without targets and where the ball is not thrown, RuntimeError
    when the simulation diverges.
    """
    if clip.ctrl is None:
        raise ValueError("the clip has no targets to play")
    ctrl = clip.ctrl.astype(np.float32).astype(float)  # as its file has them
    played = perform(TASK, clip.meta["strength"], "ball", ctrl, _thrown, engine=engine)
    if True not in played.seen:
        raise ValueError(f"the ball does not leave the hands in {engine}")
    # seen[k] is after step k, whose end is frame k + 1; the throw is settled FREE_STEPS later.
    frame = played.seen.index(True) + 2 - FREE_STEPS
    assert played.clip.object_qpos is not None and played.clip.object_qvel is not None
    place, velocity = played.clip.object_qpos[frame, :3], played.clip.object_qvel[frame, :3]
    rim = np.array(RIM)
    asked = thrown.shot(place, rim, clip.meta["asked"]["apex"])
    flight = thrown.fall(place, velocity, rim)
    speed, wanted = float(np.linalg.norm(velocity)), float(np.linalg.norm(asked))
    cosine = np.clip(velocity @ asked / (speed * wanted), -1.0, 1.0)
    found = {
        "release_time": frame / played.clip.fps,
        "release_height": float(place[2]),
        "release_speed": speed,
        "angle": elevation(velocity),
        "asked_speed": wanted,
        "asked_angle": elevation(asked),
        "speed_off": abs(speed / wanted - 1.0),
        "direction_off": float(np.degrees(np.arccos(cosine))),
        "apex": flight["apex"],
        "miss": flight["miss"],
        "basket": played.metrics["success"],
    }
    return {name: round(value, 4) for name, value in found.items()}


def perturbed(clip: Clip, engine: str) -> dict[str, float]:
    """What noise on its targets makes of a clip's throw in an engine: of ``THROWS`` throws how many
    keep the gate's limits (``kept``) and how many are ``baskets``; the largest ``speed_off`` and
    ``direction_off`` (deg) of those in which the ball is thrown at all."""
    generator, limit = np.random.default_rng(0), limits()
    out = dict.fromkeys(("kept", "baskets", *limit), 0.0)
    if clip.ctrl is None:
        return out
    for _ in range(THROWS):
        noise = NOISE * generator.standard_normal(clip.ctrl.shape)
        try:
            found = measure(replace(clip, ctrl=clip.ctrl + noise), engine)
        except (RuntimeError, ValueError):
            continue
        out["kept"] += all(found[name] <= limit[name] for name in limit)
        out["baskets"] += found["basket"] == 1.0
        out |= {name: max(out[name], found[name]) for name in limit}
    return out


def elevation(velocity: np.ndarray) -> float:
    """Angle of a velocity (3,) above the horizontal (deg)."""
    return float(np.degrees(np.arctan2(velocity[2], np.hypot(velocity[0], velocity[1]))))


def record(clip: Clip, certificate: Certificate) -> dict[str, Any]:
    """What a certificate says of the clip beside it: what motion it is, the plan's release, its
    own throw in each engine (:func:`measure`; a sentence under ``failed`` where there was none),
    the limits, whether it is certified and, where it is not, why not. ``perturbed`` says what noise
    does to it in each engine (:func:`perturbed`); that is recorded and no limit."""
    motion = clip.meta.get("motion", MOTION)
    out: dict[str, Any] = {"motion": motion, "planned": planned(certificate), "limits": limits()}
    for engine in ENGINES:
        try:
            out[engine] = measure(clip, engine)
        except (RuntimeError, ValueError) as error:
            out[engine] = {"failed": str(error)}
    shaken: dict[str, Any] = {"noise": NOISE, "throws": THROWS}
    out["perturbed"] = shaken | {engine: perturbed(clip, engine) for engine in ENGINES}
    reasons = breaches(out, certificate)
    return out | {"certified": not reasons, "why_not": "; ".join(reasons)}


def planned(certificate: Certificate) -> dict[str, float]:
    """The plan's release by its certificate: ``release_height`` (m), ``release_speed`` (m/s) and
    ``angle`` above the horizontal (deg), from the upward speed that reaches the planned apex."""
    values = {c.name: c.value for c in certificate.checks}
    height, speed = values["planned height"], values["planned release speed"]
    rise = max(RIM[2] + values["planned outcome"] - height, 0.0)
    angle = np.degrees(np.arcsin(min(np.sqrt(2 * GRAVITY * rise) / speed, 1.0)))
    found = {"release_height": height, "release_speed": speed, "angle": float(angle)}
    return {name: round(value, 4) for name, value in found.items()}


def breaches(found: dict[str, Any], certificate: Certificate) -> list[str]:
    """Why a clip with such a record is not certified, one clause for each reason."""
    reasons = [] if certificate.passed else ["the plan itself is not certified"]
    limit = found["limits"]
    for engine in ENGINES:
        figures = found[engine]
        if "failed" in figures:
            reasons.append(f"in {engine} there is no throw: {figures['failed']}")
            continue
        if not figures["speed_off"] <= limit["speed_off"]:
            reasons.append(
                f"in {engine} the ball's speed is {100 * figures['speed_off']:.1f} % off that of "
                f"the asked shot, of {100 * limit['speed_off']:g} % allowed"
            )
        if not figures["direction_off"] <= limit["direction_off"]:
            reasons.append(
                f"in {engine} the ball leaves {figures['direction_off']:.1f} degrees off the asked "
                f"shot, of {limit['direction_off']:g} allowed"
            )
    return reasons


def labelled(clip: Clip, certificate: Certificate) -> tuple[Clip, Certificate]:
    """The clip and its certificate with what is measured of the clip."""
    found = record(clip, certificate)
    meta = {k: v for k, v in clip.meta.items() if k not in ("certified", "motion", "why_not")}
    meta |= {name: found[name] for name in ("motion", "certified", "why_not")}
    meta["planned"] = certificate.achieved.get("planned")
    return replace(clip, meta=meta), replace(certificate, clip=found)


def shown(found: dict[str, Any]) -> str:
    """The throws of a record in few words: speed (m/s), angle (deg) and basket in each engine."""
    parts = []
    for engine in ENGINES:
        x = found[engine]
        if "failed" in x:
            parts.append(f"{engine}: no throw")
            continue
        basket = "basket" if x["basket"] == 1.0 else "no basket"
        parts.append(f"{engine}: {x['release_speed']:.2f} m/s, {x['angle']:.1f} deg, {basket}")
    return "; ".join(parts)


def _thrown(env: Env) -> bool:
    return bool(env.memory["thrown"][0])


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures clips and labels them and their certificates; 2 for a bad file."""
    parser = argparse.ArgumentParser(prog="python -m warmstart.refined_throw", description=__doc__)
    parser.add_argument("clips", nargs="+", type=Path)
    for path in parser.parse_args(arguments).clips:
        beside = path.with_suffix(".json")
        try:
            clip, certificate = Clip.load(path), Certificate.from_json(beside)
            if certificate.problem != TASK:
                raise ValueError(f"{path} is a clip of '{certificate.problem}', not of '{TASK}'")
        except ValueError as error:
            print(error, file=sys.stderr)
            return 2
        clip, certificate = labelled(clip, certificate)
        clip.save(path)
        certificate.to_json(beside)
        verdict = (
            "certified" if clip.meta["certified"] else f"not certified: {clip.meta['why_not']}"
        )
        print(f"{path.stem}: {shown(certificate.clip)}; {verdict}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
