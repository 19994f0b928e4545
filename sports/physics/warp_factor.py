"""Faster pieces for MuJoCo Warp's step, put in the place of its own while a step is recorded.

* MuJoCo Warp factors the joint-space inertia of a tree of more than 64 degrees of freedom with one
  kernel for every level of the tree, each passing over the memory of all worlds: 70 launches a
  substep, 45 % of a control step of SMPL-X on an H200 and 39 % of SMPL's. Here a block of threads
  takes a tree of a world into its shared memory and goes through all levels. The algorithm is the
  same: L^T D L along the ancestors of each degree of freedom; Featherstone, Rigid Body Dynamics
  Algorithms (2008), section 6.5.
* Of more than 96 degrees of freedom it asks which 16 x 16 tiles of the solver's Hessian are zero,
  with half a million blocks of threads that mostly have nothing to do (13 %). Here a block takes a
  world.
* Where a cylinder (a racket) is deep in a box (a hand, a foot), the search for the depth has room
  for 24 edges of a polytope's horizon, and gives up with an overflow in one of 8000 random poses
  that overlap; its world is reset for it. Here there is room for ``EDGES``. Three of twelve such
  poses then have C MuJoCo's depth, the others no contact, as without an overflow one in 2000 that
  is more than 2 cm deep (float32). Fewer rounds of the search overflow less, but miss more: 16
  instead of 35, 4 in 1000.

Tried on an H200 and slower (4096 worlds, steps/s of long jump and javelin; the library's own pieces
242 k and 21.8 k, these 333 k and 32.8 k): factor and solution in one launch with rows in registers,
321 k and 32.3 k; with it Newton's direction by a block a world in shared memory, 211 k and 22.7 k.

This module alone depends on MuJoCo Warp's inner names (4.0); ``tests/sports/test_warp_factor.py``
says whether another version still has them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco_warp._src import collision_convex, smooth, solver, types

LANES = 128
"""Threads of a block: four rows of 32."""
SMALL = int(types.M_BLOCK_DENSE_MAX)
"""Trees of at most so many degrees of freedom are not factored here."""
TILE = int(types.TILE_SIZE_JTDAJ_DENSE)
MANY = int(solver._SPARSE_BLOCK_CHOLESKY_DIM)
"""Models of more degrees of freedom have their Hessian's tiles looked at."""
EDGES = 64
"""Room for a horizon in the search for a depth."""

_FACTOR = """
#if defined(__CUDA_ARCH__)
    __shared__ float rows[SIZE];
    __shared__ unsigned short targets[SIZE];
#else
    float rows[SIZE];
    unsigned short targets[SIZE];
#endif
    const int first = tree[0], last = tree[1], base = begin.data[first];
    const int size = begin.data[last] + length.data[last] - base;
    const size_t world = w;
    const float* source = (const float*)((const char*)inertia.data + world * inertia.strides[0]);
    float* result = (float*)((char*)factor.data + world * factor.strides[0]);
    float* inverses = (float*)((char*)diagonal.data + world * diagonal.strides[0]);
    for (int e = lane; e < size; e += lanes) {
        rows[e] = source[base + e];
        targets[e] = (unsigned short)(begin.data[column.data[base + e]] - base);
    }
    WP_TILE_SYNC();
    const int width = lanes < 32 ? lanes : 32;
    const int high = lane / width, across = lane % width, stride = lanes / width;
    for (int k = last; k >= first; --k) {
        const int row = begin.data[k] - base, ancestors = length.data[k] - 1;
        const float scale = 1.0f / rows[row + ancestors];
        for (int a = high; a < ancestors; a += stride) {
            const float share = rows[row + a] * scale;
            float* target = rows + targets[row + a];
            for (int b = across; b <= a; b += width)
                target[b] -= share * rows[row + b];
        }
        WP_TILE_SYNC();
    }
    for (int k = first + high; k <= last; k += stride) {
        const int row = begin.data[k] - base, ancestors = length.data[k] - 1;
        const float pivot = rows[row + ancestors], scale = 1.0f / pivot;
        for (int a = across; a < ancestors; a += width)
            result[base + row + a] = rows[row + a] * scale;
        if (across == 0) {
            result[base + row + ancestors] = pivot;
            inverses[k] = scale;
        }
    }
    WP_TILE_SYNC();
"""


@cache
def factor_kernel(size: int) -> wp.Kernel:
    """L and 1/D of the inertia of trees with at most ``size`` entries: a row for each degree of
    freedom, a column for each of its ancestors and itself."""

    @wp.func_native(snippet=_FACTOR.replace("SIZE", str(size)))
    def factor_tree(
        w: int,
        lane: int,
        lanes: int,
        tree: wp.vec2i,
        length: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        column: wp.array(dtype=int),  # type: ignore[valid-type]
        inertia: wp.array2d(dtype=float),  # type: ignore[valid-type]
        factor: wp.array2d(dtype=float),  # type: ignore[valid-type]
        diagonal: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ): ...

    @wp.kernel(module="unique", enable_backward=False)
    def factor_trees(
        trees: wp.array(dtype=wp.vec2i),  # type: ignore[valid-type]
        length: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        column: wp.array(dtype=int),  # type: ignore[valid-type]
        inertia: wp.array2d(dtype=float),  # type: ignore[valid-type]
        factor: wp.array2d(dtype=float),  # type: ignore[valid-type]
        diagonal: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ):
        w, t, lane = wp.tid()
        lanes = wp.block_dim()
        factor_tree(w, lane, lanes, trees[t], length, begin, column, inertia, factor, diagonal)

    return factor_trees


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


@dataclass(frozen=True)
class Pieces:
    """The pieces for one model."""

    trees: wp.array
    """(T,) first and last degree of freedom of the trees that are factored here."""
    size: int
    """Entries of the inertia of the largest one."""

    def factor(self, m: Any, d: Any, M: wp.array, L: wp.array, D: wp.array) -> None:
        """In place of ``smooth._factor_i_sparse``."""
        lanes = LANES if wp.get_device().is_cuda else 1
        wp.launch(
            factor_kernel(self.size),
            dim=(d.nworld, self.trees.shape[0], lanes),
            inputs=[self.trees, m.M_rownnz, m.M_rowadr, m.M_colind, M],
            outputs=[L, D],
            block_dim=lanes,
        )


def pieces(model: mujoco.MjModel) -> Pieces:
    """For a model, on Warp's current device."""
    starts = np.asarray(model.tree_dofadr)
    last = starts + np.asarray(model.tree_dofnum) - 1
    large = np.flatnonzero(last - starts >= SMALL)
    entry = np.asarray(model.M_rowadr), np.asarray(model.M_rownnz)
    sizes = [entry[0][last[t]] + entry[1][last[t]] - entry[0][starts[t]] for t in large]
    trees = np.stack((starts[large], last[large]), 1).astype(np.int32)
    return Pieces(wp.array(trees, dtype=wp.vec2i), int(max(sizes, default=0)))


def find_tiles(m: Any, d: Any, ctx: Any, skip_unchanged: bool, skip_noflip: bool) -> None:
    """Marks the Hessian's tiles that are not zero in ``ctx.h_tile_nz``."""
    lanes = LANES if wp.get_device().is_cuda else 1
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


@contextmanager
def faster(own: Pieces) -> Iterator[None]:
    """MuJoCo Warp works with the pieces of this module inside the block."""
    theirs, room = smooth._factor_i_sparse, collision_convex.MJ_MAX_EPAHORIZON
    try:
        collision_convex.MJ_MAX_EPAHORIZON = max(room, EDGES)
        if own.size:
            smooth._factor_i_sparse = own.factor
        solver._cholesky_factorize_solve = solve_direction
        yield
    finally:
        smooth._factor_i_sparse = theirs
        solver._cholesky_factorize_solve = _their_direction
        collision_convex.MJ_MAX_EPAHORIZON = room
