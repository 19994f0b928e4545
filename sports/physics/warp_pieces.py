"""Faster pieces for MuJoCo Warp's step, put in the place of its own while a step is recorded.

* Systems with the joint-space inertia, and Newton's direction where friction has a pyramid, are
  solved along the trees of bodies, without a matrix (``sports/physics/warp_tree.py``). MuJoCo Warp
  has a Cholesky factor of the Hessian for them, and a factor of the inertia in one launch for every
  level of the tree.
* With a round cone for friction it asks, of more than 96 degrees of freedom, which 16 x 16 tiles of
  the Hessian are zero, with half a million blocks of threads that mostly have nothing to do (13 %
  of a control step of SMPL-X). Here a block takes a world.
* Nothing is computed that nobody asks for: the inertia's entries beside its diagonal, what lifts
  bodies against gravity where nothing does, and the servos' moments, which never change.
* Where a cylinder (a racket) is deep in a box (a hand, a foot), the search for the depth has room
  for 24 edges of a polytope's horizon, and gives up with an overflow in one of 8000 random poses
  that overlap; its world is reset for it. Here there is room for ``EDGES``. Three of twelve such
  poses then have C MuJoCo's depth, the others no contact, as without an overflow one in 2000 that
  is more than 2 cm deep (float32). Fewer rounds of the search overflow less, but miss more: 16
  instead of 35, 4 in 1000.

This module and ``warp_tree*.py`` alone depend on MuJoCo Warp's inner names (4.0);
``tests/sports/test_warp_pieces.py`` says whether another version still has them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from functools import cache
from typing import Any

import warp as wp
from mujoco_warp._src import collision_convex, derivative, passive, smooth, solver, support, types

from sports.physics.warp_tree import Trees, block

LANES = 128
"""Threads of a block that looks for tiles: four rows of 32."""
TILE = int(types.TILE_SIZE_JTDAJ_DENSE)
MANY = int(solver._SPARSE_BLOCK_CHOLESKY_DIM)
"""Models of more degrees of freedom have their Hessian's tiles looked at."""
EDGES = 64
"""Room for a horizon in the search for a depth."""


@wp.func_native(snippet="WP_TILE_SYNC();")
def _wait(): ...


@cache
def tiles_kernel(skip_unchanged: bool, skip_noflip: bool) -> wp.Kernel:
    """Which tiles of the Hessian's upper triangle have an entry beside the diagonal, of worlds
    that ask for it."""

    @wp.kernel(module="unique", enable_backward=False)
    def find_tiles(
        done: wp.array(dtype=bool),  # type: ignore[valid-type]
        hessian: wp.array3d(dtype=float),  # type: ignore[valid-type]
        changed: wp.array(dtype=int),  # type: ignore[valid-type]
        flipped: wp.array(dtype=int),  # type: ignore[valid-type]
        filled: wp.array3d(dtype=int),  # type: ignore[valid-type]
    ):
        w, lane = wp.tid()
        if done[w]:
            return
        if wp.static(skip_noflip):
            if flipped[w] == 0:
                return
        if wp.static(skip_unchanged):
            if changed[w] == 0:
                return
        lanes = wp.block_dim()
        tiles, size = filled.shape[1], hessian.shape[1]
        for e in range(lane, tiles * tiles, lanes):
            filled[w, e // tiles, e % tiles] = 0
        _wait()
        width = wp.min(lanes, 32)
        for r in range(lane // width, size, lanes // width):
            for c in range(r + 1 + lane % width, size, width):
                if hessian[w, r, c] != 0.0:
                    filled[w, r // wp.static(TILE), c // wp.static(TILE)] = 1

    return find_tiles


def find_tiles(m: Any, d: Any, ctx: Any, skip_unchanged: bool, skip_noflip: bool) -> None:
    """Marks the Hessian's tiles that are not zero in ``ctx.h_tile_nz``."""
    lanes = block(LANES)
    changed = ctx.quad_changed_count if skip_unchanged else d.nefc
    flipped = ctx.state_changed_count if skip_noflip else changed
    wp.launch(
        tiles_kernel(skip_unchanged, skip_noflip),
        dim=(d.nworld, lanes),
        inputs=[ctx.done, ctx.h, changed, flipped],
        outputs=[ctx.h_tile_nz],
        block_dim=lanes,
    )


def solve_direction(
    m: Any, d: Any, ctx: Any, skip_unchanged: bool = False, skip_noflip: bool = False
) -> None:
    """In place of ``solver._cholesky_factorize_solve`` for models of many degrees of freedom: the
    tiles are found by one block a world, the rest is MuJoCo Warp's."""
    if m.nv <= MANY:
        _their_direction(m, d, ctx, skip_unchanged, skip_noflip)
        return
    changed = ctx.quad_changed_count if skip_unchanged else d.nefc
    flipped = ctx.state_changed_count if skip_noflip else changed
    find_tiles(m, d, ctx, skip_unchanged, skip_noflip)
    wp.launch(
        solver._symbolic_h_tile_cholesky(m.nv_pad // TILE, skip_unchanged, skip_noflip),
        dim=d.nworld,
        inputs=[ctx.done, ctx.h_tile_nz, changed, flipped],
        outputs=[ctx.h_row_mask, ctx.h_col_mask, ctx.h_tile_is_diag],
    )
    wp.launch(
        solver._prepare_h_rhs_work(TILE, m.nv, skip_unchanged, skip_noflip),
        dim=(d.nworld, m.nv_pad),
        inputs=[ctx.done, ctx.grad, ctx.h, ctx.h_tile_is_diag, changed, flipped],
        outputs=[ctx.hfactor, ctx.h_rhs_work],
    )
    gradient = ctx.grad.reshape(shape=(d.nworld, ctx.grad.shape[1], 1))
    masks = [ctx.h_row_mask, ctx.h_col_mask, ctx.h_tile_is_diag]
    inputs = [ctx.done, gradient, ctx.h_rhs_work, ctx.h, *masks]
    if skip_unchanged:
        kernel = solver._update_gradient_cholesky_blocked_sparse_tiles_skip_unchanged(
            TILE, m.nv_pad, m.nv, skip_noflip
        )
        inputs += [ctx.quad_changed_count, flipped]
    else:
        kernel = solver._update_gradient_cholesky_blocked_sparse_tiles(TILE, m.nv_pad, m.nv)
    search = ctx.search.reshape(shape=(d.nworld, m.nv, 1))
    wp.launch_tiled(
        kernel,
        dim=d.nworld,
        inputs=[*inputs, ctx.hfactor],
        outputs=[search, ctx.search_dot, ctx.newton_decrement],
        block_dim=m.block_dim.update_gradient_cholesky_blocked,
    )


_their_direction = solver._cholesky_factorize_solve
_their_context = solver._create_solver_context
_their_passive, _their_multiply = passive.passive, support.mul_m
_their_inertia, _their_transmission = smooth.crb, smooth.transmission
_their_derivative = derivative.deriv_smooth_vel


def _context(m: Any, d: Any, inplace_cholesky: bool = False) -> Any:
    """In place of ``solver._create_solver_context``: without room for a Hessian and its factor."""
    newton = m.opt.solver
    try:
        m.opt.solver = types.SolverType.CG
        ctx = _their_context(m, d)
    finally:
        m.opt.solver = newton
    ctx.quad_changed_ids = wp.empty((d.nworld, d.njmax), dtype=int)
    ctx.quad_changed_count = wp.empty((d.nworld,), dtype=int)
    ctx.state_changed_count = wp.empty((d.nworld,), dtype=int)
    return ctx


def _passive(m: Any, d: Any) -> None:
    """In place of ``passive.passive`` where gravity acts on all bodies: it would ask each for its
    share of each degree of freedom (two by two athletes with fingers: 135 thousand a world)."""
    few = copy(m)
    few.nbody = 1
    _their_passive(few, d)


@wp.kernel(enable_backward=False)
def _joint_lengths(
    joint: wp.array(dtype=wp.vec2i),  # type: ignore[valid-type]
    coordinate: wp.array(dtype=int),  # type: ignore[valid-type]
    gear: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
    qpos: wp.array2d(dtype=float),  # type: ignore[valid-type]
    length: wp.array2d(dtype=float),  # type: ignore[valid-type]
):
    w, a = wp.tid()
    length[w, a] = qpos[w, coordinate[joint[a][0]]] * gear[w % gear.shape[0], a][0]


@contextmanager
def faster(own: Trees) -> Iterator[None]:
    """MuJoCo Warp works with the pieces of this module inside the block."""

    def update_gradient(m: Any, d: Any, ctx: Any, compact: bool = False) -> None:
        own.direction(m, d, ctx, False)

    def update_again(m: Any, d: Any, ctx: Any, stable_fast: bool = False) -> None:
        own.direction(m, d, ctx, stable_fast)

    def solve_m(m: Any, d: Any, x: wp.array, y: wp.array, x_scratch: Any = None) -> None:
        own.solve(m, d, d.M, x, y)

    def factor_solve(m: Any, d: Any, M: wp.array, L: Any, D: Any, x: wp.array, y: wp.array) -> None:
        own.solve(m, d, M, x, y)

    def multiply(
        m: Any, d: Any, res: wp.array, vec: wp.array, skip: Any = None, M: Any = None
    ) -> None:
        if M is None:
            own.multiply(m, d, res, vec, wp.empty(0, dtype=bool) if skip is None else skip)
        else:
            _their_multiply(m, d, res, vec, skip, M)

    def inertia(m: Any, d: Any) -> None:
        few = copy(m)
        few.dof_parentid = own.above
        _their_inertia(few, d)

    def derivative_of_forces(m: Any, d: Any, out: wp.array) -> None:
        few = copy(m)
        few.M_fullm_i = few.M_fullm_j = own.each
        _their_derivative(few, d, out)

    def transmission(m: Any, d: Any) -> None:
        if not any(known is d for known in own.geared):
            _their_transmission(m, d)
            own.geared.append(d)
        wp.launch(
            _joint_lengths,
            dim=(d.nworld, m.nactuator),
            inputs=[m.actuator_trnid, m.jnt_qposadr, m.actuator_gear, d.qpos],
            outputs=[d.actuator_length],
        )

    here: list[tuple[Any, str, Any]] = [
        (collision_convex, "MJ_MAX_EPAHORIZON", max(collision_convex.MJ_MAX_EPAHORIZON, EDGES)),
        (solver, "_cholesky_factorize_solve", solve_direction),
    ]
    if own.plain:
        here += [
            (smooth, "factor_m", lambda m, d: None),
            (smooth, "solve_m", solve_m),
            (smooth, "factor_solve_i", factor_solve),
            (smooth, "transmission", transmission),
            (support, "mul_m", multiply),
            (passive, "passive", _passive),
            (derivative, "deriv_smooth_vel", derivative_of_forces),
        ]
    if own.plain and own.whole:  # nobody asks for the rest of M
        here += [
            (smooth, "crb", inertia),
            (solver, "_create_solver_context", _context),
            (solver, "_update_gradient", update_gradient),
            (solver, "_update_gradient_incremental", update_again),
        ]
    theirs = [(module, name, getattr(module, name)) for module, name, _ in here]
    try:
        for module, name, value in here:
            setattr(module, name, value)
        yield
    finally:
        for module, name, value in theirs:
            setattr(module, name, value)
