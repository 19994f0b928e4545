"""What a command says of the worlds to play in, as the engine's options. Light to import."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from sports.variation import Variation

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

DRAKE = Variation(friction=(0.8, 1.25), felt_share=0.8, cone_share=1.0, impratio=(2.0, 40.0))
"""Worlds that come as near to Drake as MuJoCo's do: feet stick, and contacts feel the damping."""

OTHER_PHYSICS = frozenset({"felt_damping", "timestep_divisor", "variation"})
"""Fields of results that were played in physics other than the task's own."""


class Worlds(Protocol):
    """Settings that several commands have."""

    @property
    def engine(self) -> str:
        """The physics engine."""
        ...

    @property
    def timestep_divisor(self) -> int:
        """2 halves the physics time step at the same control rate."""
        ...

    @property
    def felt_damping(self) -> bool:
        """Contacts feel the joints' damping."""
        ...

    @property
    def vary(self) -> bool:
        """The worlds differ."""
        ...

    @property
    def variation(self) -> Variation:
        """How."""
        ...

    @property
    def like_drake(self) -> bool:
        """They differ as in ``DRAKE``."""
        ...


S = TypeVar("S", bound="DataclassInstance")


def in_own_worlds(settings: S, **more: Any) -> S:
    """The same, but for the task's own worlds at its own time step; ``more`` changes besides."""
    usual = {"vary": False, "variation": Variation(), "like_drake": False, "felt_damping": False}
    return replace(settings, **usual, timestep_divisor=1, **more)


def mistakes(worlds: Worlds) -> Iterator[str]:
    """What cannot be, as sentences."""
    if worlds.timestep_divisor < 1:
        yield f"timestep-divisor must be at least 1, not {worlds.timestep_divisor}"
    if worlds.engine == "drake" and (worlds.vary or worlds.like_drake):
        yield "drake has worlds of its own: leave --vary and --like-drake out"
    if worlds.engine == "drake" and worlds.timestep_divisor != 1:
        yield "drake has time steps of its own: leave --timestep-divisor out"
    if worlds.engine == "drake" and worlds.felt_damping:
        yield "contacts always feel the joints' damping in drake: leave --felt-damping out"
    told = worlds.variation != Variation()
    if worlds.like_drake and (worlds.vary or told or worlds.felt_damping):
        yield (
            "--like-drake says how worlds differ: leave --vary, the --variation options and "
            "--felt-damping out"
        )
    elif told and not worlds.vary:
        yield "the --variation options are of worlds that vary: give --vary as well"
    if worlds.variation.own_stride != 1:
        yield "own-stride is the timestep-divisor: leave --variation.own-stride out"
    if worlds.variation.own_share and worlds.felt_damping:
        yield "own worlds do not feel damping: leave --variation.own-share or --felt-damping out"


def engine_options(worlds: Worlds, seed: int) -> dict[str, Any]:
    """The engine's options for such worlds, drawn with a seed."""
    options: dict[str, Any] = {"felt_damping": True} if worlds.felt_damping else {}
    if worlds.vary or worlds.like_drake:
        how = DRAKE if worlds.like_drake else worlds.variation
        variation = replace(how, own_stride=worlds.timestep_divisor)
        options |= {"variation": variation, "variation_seed": seed}
    return options


def are_own(worlds: Worlds) -> bool:
    """Whether they are all like the task's own, at its own time step."""
    return not other_physics(engine_options(worlds, 0), worlds.timestep_divisor)


def other_physics(options: Mapping[str, Any], timestep_divisor: int) -> dict[str, Any]:
    """``OTHER_PHYSICS`` of a result, from the engine's options; empty where it was the task's."""
    other: dict[str, Any] = {}
    if options.get("felt_damping"):
        other["felt_damping"] = True
    if timestep_divisor != 1:
        other["timestep_divisor"] = timestep_divisor
    if "variation" in options:
        other["variation"] = asdict(options["variation"])
    return other
