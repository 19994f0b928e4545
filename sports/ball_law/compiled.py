"""Compiles the functions of the ball law for CPUs (numba) and for GPUs (Warp).

Each compiler gets copies of the same functions with its own globals, in which the copies find each
other. Neither compiler is imported before it is asked for: a training host with a GPU has no
numba, and one without has no Warp.
"""

from __future__ import annotations

import os
import types
from collections.abc import Callable
from functools import cache
from typing import Any

from sports.ball_law import contact, flight, play, shots

_MODULES = (flight, contact, play, shots)


def _names() -> dict[str, Any]:
    """All names of the law."""
    return {name: value for module in _MODULES for name, value in vars(module).items()}


def _copies(globals_: dict[str, Any], file: str | None = None) -> dict[str, Callable[..., Any]]:
    """The law's functions with other globals, as if they were from ``file``."""
    copies = {}
    for module in _MODULES:
        for name, function in vars(module).items():
            own = getattr(function, "__module__", None) == module.__name__
            if own and isinstance(function, types.FunctionType):
                code = function.__code__.replace(co_filename=file or function.__code__.co_filename)
                copy = types.FunctionType(code, globals_, name, function.__defaults__)
                copy.__annotations__, copy.__doc__ = function.__annotations__, function.__doc__
                copy.__module__ = function.__module__
                copies[name] = copy
    return copies


@cache
def for_cpu() -> types.SimpleNamespace:
    """The law as machine code: each function is compiled at its first call and kept on disk, beside
    the law or, where that cannot be written, in the user's cache folder."""
    import numba

    globals_ = _names()
    # Numba keeps a function until the file that it is from changes, whatever it calls.
    files = [module.__file__ or "" for module in _MODULES]
    newest = max(files, key=lambda file: os.stat(file).st_mtime_ns)
    options = {"error_model": "numpy", "nogil": True}
    for name, copy in _copies(globals_, newest).items():
        try:
            globals_[name] = numba.njit(cache=True, **options)(copy)
        except RuntimeError:  # neither folder can be written
            globals_[name] = numba.njit(**options)(copy)
    return types.SimpleNamespace(**globals_)


@cache
def for_gpu() -> types.SimpleNamespace:
    """The law as functions and kernels of Warp, single precision. ``Game`` is a structure whose
    fields are arrays; the kernels run one thread a world."""
    import warp as wp

    row, matrix, cube = wp.array(dtype=float), wp.array2d(dtype=float), wp.array3d(dtype=float)
    integers, bits = wp.array2d(dtype=int), wp.array(dtype=bool)
    arrays = {"Row": row, "Matrix": matrix, "Cube": cube, "IntMatrix": integers, "Bits": bits}
    vectors = {"vec": wp.vec3, "Vector": wp.vec3, "quat": wp.vec4, "Quat": wp.vec4}
    module = wp.get_module("sports.ball_law")
    module.options["enable_backward"] = False
    fields = {k: arrays[kind.__forward_arg__] for k, kind in contact.Game.__annotations__.items()}
    game_type = wp.struct(type("Game", (), {"__annotations__": fields, "__module__": __name__}))
    globals_ = _names() | arrays | vectors | {"Game": game_type}
    for name, copy in _copies(globals_).items():
        if name not in vectors and not name.endswith("_worlds"):
            globals_[name] = wp.func(copy, module=module)
    law = types.SimpleNamespace(**globals_)
    begin_world, push_world, finish_world = law.begin_world, law.push_world, law.finish_world
    turn_world = law.turn_world
    land_world, meet_world = law.land_world, law.meet_world
    path_world, aim_world = law.path_world, law.aim_world
    land_on_waves_world = law.land_on_waves_world

    # Types as values, so that Warp finds them.
    def kernel(function: Callable[..., None], **types_: Any) -> Any:
        function.__annotations__ = types_
        return wp.kernel(function, module=module)

    def begin_worlds(game, qpos, qvel):
        begin_world(game, wp.tid(), qpos, qvel)

    def push_worlds(game, timestep, qpos, qvel):
        w = wp.tid()
        push_world(game, w, timestep[w % timestep.shape[0]], qpos, qvel)

    def turn_worlds(game, timestep, qpos, qvel):
        w = wp.tid()
        turn_world(game, w, timestep[w % timestep.shape[0]], qpos, qvel)

    def finish_worlds(game, timestep, qpos, qvel):
        w = wp.tid()
        finish_world(game, w, timestep[w % timestep.shape[0]], qpos, qvel)

    def land_worlds(p, v, spin, height, limit, ball, pos, time):
        land_world(wp.tid(), p, v, spin, height, limit, ball, pos, time)

    def meet_worlds(p, v, spin, x, limit, ball, pos, time):
        meet_world(wp.tid(), p, v, spin, x, limit, ball, pos, time)

    def land_on_waves_worlds(
        p, v, spin, phases, amplitude, k, inner, outer, limit, wanted, ball, pos, time
    ):
        land_on_waves_world(
            wp.tid(), p, v, spin, phases, amplitude, k, inner, outer, limit, wanted, ball, pos, time
        )

    def path_worlds(p, v, spin, times_, floor, restitution, friction, ball, path):
        path_world(wp.tid(), p, v, spin, times_, floor, restitution, friction, ball, path)

    def aim_worlds(p, speed, target, net, clear, apex, wanted, ball, linvel):
        aim_world(wp.tid(), p, speed, target, net, clear, apex, wanted, ball, linvel)

    state = dict(qpos=matrix, qvel=matrix)
    law.begin_worlds = kernel(begin_worlds, game=game_type, **state)
    law.turn_worlds = kernel(turn_worlds, game=game_type, timestep=row, **state)
    law.push_worlds = kernel(push_worlds, game=game_type, timestep=row, **state)
    law.finish_worlds = kernel(finish_worlds, game=game_type, timestep=row, **state)
    moving = dict(p=matrix, v=matrix, spin=matrix)
    law.land_worlds = kernel(
        land_worlds, **moving, height=row, limit=float, ball=row, pos=matrix, time=row
    )
    law.meet_worlds = kernel(
        meet_worlds, **moving, x=float, limit=float, ball=row, pos=matrix, time=row
    )
    swell = dict(phases=matrix, amplitude=float, k=float, inner=float, outer=float, limit=float)
    law.land_on_waves_worlds = kernel(
        land_on_waves_worlds, **moving, **swell, wanted=bits, ball=row, pos=matrix, time=row
    )
    bounds = dict(floor=float, restitution=float, friction=float)
    law.path_worlds = kernel(path_worlds, **moving, times_=row, **bounds, ball=row, path=cube)
    aims = dict(p=matrix, speed=row, target=matrix, net=float, clear=float, apex=float)
    law.aim_worlds = kernel(aim_worlds, **aims, wanted=bits, ball=row, linvel=matrix)
    return law
