"""Compiles the functions of :mod:`sports.ball_law` for CPUs (numba) and for GPUs (Warp).

Each compiler gets copies of the same functions with its own globals: the copies call each other.
Neither compiler is imported before it is asked for: a training host with a GPU has no numba, and
one without has no Warp.
"""

from __future__ import annotations

import types
from collections.abc import Callable
from functools import cache
from typing import Any

from sports import ball_law

LOOPS = ("land_worlds", "path_worlds", "aim_worlds")
"""Functions that only a CPU needs."""


def _copies(globals_: dict[str, Any]) -> dict[str, Callable[..., Any]]:
    """The law's functions, with ``globals_`` for the names in them."""
    copies = {}
    for name, function in vars(ball_law).items():
        if isinstance(function, types.FunctionType) and function.__module__ == ball_law.__name__:
            copy = types.FunctionType(function.__code__, globals_, name, function.__defaults__)
            copy.__annotations__ = function.__annotations__
            copy.__module__, copy.__doc__ = function.__module__, function.__doc__
            copies[name] = copy
    return copies


@cache
def for_cpu() -> types.SimpleNamespace:
    """The law as machine code; compiled at the first call of each function and kept on disk
    beside ``ball_law.py`` or, where that cannot be written, in the user's cache folder."""
    import numba

    globals_ = dict(vars(ball_law))
    options = {"error_model": "numpy", "nogil": True}
    for name, copy in _copies(globals_).items():
        try:
            globals_[name] = numba.njit(cache=True, **options)(copy)
        except RuntimeError:  # neither folder can be written
            globals_[name] = numba.njit(**options)(copy)
    return types.SimpleNamespace(**globals_)


@cache
def for_gpu() -> types.SimpleNamespace:
    """The law as functions and kernels of Warp, single precision."""
    import warp as wp

    module = wp.get_module("sports.ball_law")
    module.options["enable_backward"] = False
    globals_ = dict(vars(ball_law))
    globals_ |= {
        "vec": wp.vec3,
        "quat": wp.vec4,
        "Vector": wp.vec3,
        "Quat": wp.vec4,
        "Row": wp.array(dtype=float),
        "Matrix": wp.array2d(dtype=float),
        "Cube": wp.array3d(dtype=float),
        "IntMatrix": wp.array2d(dtype=int),
        "Bits": wp.array(dtype=bool),
    }
    for name, copy in _copies(globals_).items():
        if name not in (*LOOPS, "vec", "quat"):
            globals_[name] = wp.func(copy, module=module)
    law = types.SimpleNamespace(**globals_)
    land_world, path_world, aim_world = law.land_world, law.path_world, law.aim_world

    @wp.kernel(module=module)
    def land_worlds(
        p: wp.array2d(dtype=float),  # type: ignore[valid-type]
        v: wp.array2d(dtype=float),  # type: ignore[valid-type]
        spin: wp.array2d(dtype=float),  # type: ignore[valid-type]
        height: wp.array(dtype=float),  # type: ignore[valid-type]
        limit: float,
        ball: wp.array(dtype=float),  # type: ignore[valid-type]
        pos: wp.array2d(dtype=float),  # type: ignore[valid-type]
        time: wp.array(dtype=float),  # type: ignore[valid-type]
    ):
        land_world(wp.tid(), p, v, spin, height, limit, ball, pos, time)

    @wp.kernel(module=module)
    def path_worlds(
        p: wp.array2d(dtype=float),  # type: ignore[valid-type]
        v: wp.array2d(dtype=float),  # type: ignore[valid-type]
        spin: wp.array2d(dtype=float),  # type: ignore[valid-type]
        times_: wp.array(dtype=float),  # type: ignore[valid-type]
        floor: float,
        restitution: float,
        friction: float,
        ball: wp.array(dtype=float),  # type: ignore[valid-type]
        path: wp.array3d(dtype=float),  # type: ignore[valid-type]
    ):
        path_world(wp.tid(), p, v, spin, times_, floor, restitution, friction, ball, path)

    @wp.kernel(module=module)
    def aim_worlds(
        p: wp.array2d(dtype=float),  # type: ignore[valid-type]
        speed: wp.array(dtype=float),  # type: ignore[valid-type]
        target: wp.array2d(dtype=float),  # type: ignore[valid-type]
        net: float,
        clear: float,
        apex: float,
        wanted: wp.array(dtype=bool),  # type: ignore[valid-type]
        ball: wp.array(dtype=float),  # type: ignore[valid-type]
        linvel: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ):
        aim_world(wp.tid(), p, speed, target, net, clear, apex, wanted, ball, linvel)

    law.land_worlds, law.path_worlds, law.aim_worlds = land_worlds, path_worlds, aim_worlds
    return law
