"""Faster pieces for MuJoCo Warp's step, put in the place of its own while a step is recorded.

* MuJoCo Warp factors the joint-space inertia of a tree of more than 64 degrees of freedom with one
  kernel for every level of the tree, each passing over the memory of all worlds: 70 launches a
  substep, 45 % of a control step of SMPL-X on an H200 and 39 % of SMPL's. Here a block of threads
  takes a tree of a world into its shared memory, goes through all levels and solves at once. The
  algorithm is the same: L^T D L along the ancestors of each degree of freedom; Featherstone, Rigid
  Body Dynamics Algorithms (2008), section 6.5.
* Newton's direction: ``warp_newton.py``, for up to 200 degrees of freedom.
* Of more than 96 degrees of freedom it asks which 16 x 16 tiles of the solver's Hessian are zero,
  with half a million blocks of threads that mostly have nothing to do (13 %). Here a block takes a
  world; for models that are too large for the direction above.

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
from mujoco_warp._src import smooth, solver, types

from sports.physics.warp_newton import MOST, block_lanes, find_direction

SMALL = int(types.M_BLOCK_DENSE_MAX)
"""Trees of at most so many degrees of freedom are not factored here."""
TILE = int(types.TILE_SIZE_JTDAJ_DENSE)
FEW = int(solver._BLOCK_CHOLESKY_DIM)
"""Models of at most so many degrees of freedom are left to MuJoCo Warp."""

_FACTOR = """
#if defined(__CUDA_ARCH__)
    __shared__ float rows[SIZE], rhs[DOFS];
    __shared__ unsigned short columns[SIZE], starts[DOFS + 1];
#define WAIT_WARP() __syncwarp()
#else
    float rows[SIZE], rhs[DOFS];
    unsigned short columns[SIZE], starts[DOFS + 1];
#define WAIT_WARP()
#endif
    const int first = tree[0], dofs = tree[1] - first + 1, base = begin.data[first];
    const int size = begin.data[tree[1]] + length.data[tree[1]] - base;
    const size_t world = w;
    const float* source = (const float*)((const char*)inertia.data + world * inertia.strides[0]);
    float* result = (float*)((char*)factor.data + world * factor.strides[0]);
    float* inverses = (float*)((char*)diagonal.data + world * diagonal.strides[0]);
    for (int e = lane; e < size; e += lanes) {
        rows[e] = source[base + e];
        columns[e] = (unsigned short)(column.data[base + e] - first);
    }
    for (int k = lane; k < dofs; k += lanes)
        starts[k] = (unsigned short)(begin.data[first + k] - base);
#if SOLVE
    const float* right = (const float*)((const char*)force.data + world * force.strides[0]);
    float* solution = (float*)((char*)solved.data + world * solved.strides[0]);
    for (int k = lane; k < dofs; k += lanes)
        rhs[k] = right[first + k];
#endif
    if (lane == 0)
        starts[dofs] = (unsigned short)size;
    WP_TILE_SYNC();
    const int width = lanes < 32 ? lanes : 32, stride = lanes / width;
    const int high = lane / width, across = lane % width;
    for (int k = dofs - 1; k >= 0; --k) {
        const int row = starts[k], ancestors = starts[k + 1] - row - 1;
        const float scale = 1.0f / rows[row + ancestors];
#if SOLVE
        if (high == 0) {
            const float known = rhs[k] * scale;
            for (int a = across; a < ancestors; a += width)
                rhs[columns[row + a]] -= rows[row + a] * known;
        }
#endif
        for (int b = across; b < ancestors; b += width) {
            const float share = rows[row + b] * scale;
            // All lanes of a row of 32 go through the same rows a >= b, four of them at a time.
            const int skipped = (b - across - high + stride - 1) / stride;
            const int start = high + (skipped > 0 ? skipped : 0) * stride;
            for (int a = start; a < ancestors; a += 4 * stride) {
                float value[4];
                int place[4];
#pragma unroll
                for (int j = 0; j < 4; ++j) {
                    const int c = a + j * stride;
                    place[j] = c >= b && c < ancestors ? starts[columns[row + c]] + b : -1;
                    if (place[j] >= 0)
                        value[j] = rows[place[j]] - share * rows[row + c];
                }
#pragma unroll
                for (int j = 0; j < 4; ++j)
                    if (place[j] >= 0)
                        rows[place[j]] = value[j];
            }
        }
        WP_TILE_SYNC();
    }
#if SOLVE
    // What a degree of freedom has found is taken from its descendants, which follow it.
    if (high == 0) {
        for (int k = 0; k < dofs; ++k) {
            const int depth = starts[k + 1] - starts[k] - 1, end = ends.data[first + k] - first;
            const float x = rhs[k] / rows[starts[k] + depth];
            WAIT_WARP();
            for (int i = k + 1 + across; i < end; i += width)
                rhs[i] -= rows[starts[i] + depth] * x;
            if (across == 0)
                solution[first + k] = x;
            WAIT_WARP();
        }
    }
#endif
    for (int k = high; k < dofs; k += stride) {
        const int row = starts[k], ancestors = starts[k + 1] - row - 1;
        const float pivot = rows[row + ancestors], scale = 1.0f / pivot;
        for (int a = across; a < ancestors; a += width)
            result[base + row + a] = rows[row + a] * scale;
        if (across == 0) {
            result[base + row + ancestors] = pivot;
            inverses[first + k] = scale;
        }
    }
    WP_TILE_SYNC();
"""


@cache
def factor_kernel(size: int, dofs: int, solve: bool) -> wp.Kernel:
    """L and 1/D of the inertia of trees with at most ``size`` entries: a row for each of at most
    ``dofs`` degrees of freedom, a column for each of its ancestors and itself. With ``solve`` also
    the accelerations (``solved``) that forces give such an inertia. ``ends``: for each degree of
    freedom the first one after it that does not hang on it."""
    snippet = _FACTOR.replace("SIZE", str(size)).replace("DOFS", str(dofs))

    @wp.func_native(snippet=snippet.replace("SOLVE", str(int(solve))))
    def factor_tree(
        w: int,
        lane: int,
        lanes: int,
        tree: wp.vec2i,
        length: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        column: wp.array(dtype=int),  # type: ignore[valid-type]
        ends: wp.array(dtype=int),  # type: ignore[valid-type]
        inertia: wp.array2d(dtype=float),  # type: ignore[valid-type]
        force: wp.array2d(dtype=float),  # type: ignore[valid-type]
        factor: wp.array2d(dtype=float),  # type: ignore[valid-type]
        diagonal: wp.array2d(dtype=float),  # type: ignore[valid-type]
        solved: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ): ...

    @wp.kernel(module="unique", enable_backward=False)
    def factor_trees(
        trees: wp.array(dtype=wp.vec2i),  # type: ignore[valid-type]
        length: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        column: wp.array(dtype=int),  # type: ignore[valid-type]
        ends: wp.array(dtype=int),  # type: ignore[valid-type]
        inertia: wp.array2d(dtype=float),  # type: ignore[valid-type]
        force: wp.array2d(dtype=float),  # type: ignore[valid-type]
        factor: wp.array2d(dtype=float),  # type: ignore[valid-type]
        diagonal: wp.array2d(dtype=float),  # type: ignore[valid-type]
        solved: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ):
        w, t, lane = wp.tid()
        lanes = wp.block_dim()
        factor_tree(
            w, lane, lanes, trees[t], length, begin, column, ends,
            inertia, force, factor, diagonal, solved,
        )  # fmt: skip

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
    ends: wp.array
    """(nv,) for each degree of freedom the first one after it that does not hang on it."""
    size: int
    """Entries of the inertia of the largest tree."""
    dofs: int
    """Its degrees of freedom."""

    def factor(self, m: Any, d: Any, M: wp.array, L: wp.array, D: wp.array) -> None:
        """In place of ``smooth._factor_i_sparse``."""
        self._launch(m, d, M, L, D)

    def factor_and_solve(
        self, m: Any, d: Any, M: wp.array, L: wp.array, D: wp.array, x: wp.array, y: wp.array
    ) -> None:
        """In place of ``smooth.factor_solve_i``: M x = y. Small trees are MuJoCo Warp's."""
        if m.M_tiles:
            smooth._factor_solve_blocks(m, d, M, L, D, x, y)
        self._launch(m, d, M, L[:, m.qLD_block_total :], D, x, y)

    def _launch(
        self, m: Any, d: Any, M: wp.array, L: wp.array, D: wp.array, *solve: wp.array
    ) -> None:
        lanes = block_lanes()
        solved, force = solve or (D, D)
        wp.launch(
            factor_kernel(self.size, self.dofs, bool(solve)),
            dim=(d.nworld, self.trees.shape[0], lanes),
            inputs=[self.trees, m.M_rownnz, m.M_rowadr, m.M_colind, self.ends, M, force],
            outputs=[L, D, solved],
            block_dim=lanes,
        )


def pieces(model: mujoco.MjModel) -> Pieces:
    """For a model, on Warp's current device."""
    starts = np.asarray(model.tree_dofadr)
    last = starts + np.asarray(model.tree_dofnum) - 1
    large = np.flatnonzero(last - starts >= SMALL)
    begin, length = np.asarray(model.M_rowadr), np.asarray(model.M_rownnz)
    sizes = [begin[last[t]] + length[last[t]] - begin[starts[t]] for t in large]
    trees = np.stack((starts[large], last[large]), 1).astype(np.int32)
    dofs = trees[:, 1] - trees[:, 0] + 1
    ends = np.arange(1, model.nv + 1)
    for k in reversed(range(model.nv)):
        parent = model.dof_parentid[k]
        if parent >= 0:
            ends[parent] = max(ends[parent], ends[k])
    return Pieces(
        wp.array(trees, dtype=wp.vec2i),
        wp.array(ends.astype(np.int32), dtype=int),
        int(max(sizes, default=0)),
        int(dofs.max(initial=0)),
    )


def find_tiles(m: Any, d: Any, ctx: Any, skip_unchanged: bool, skip_noflip: bool) -> None:
    """Marks the Hessian's tiles that are not zero in ``ctx.h_tile_nz``."""
    lanes = block_lanes()
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
    """In place of ``solver._cholesky_factorize_solve``. Larger models than ``warp_newton`` takes
    have their tiles found by one block a world; the rest is MuJoCo Warp's."""
    if FEW < m.nv <= MOST:
        find_direction(m, d, ctx, skip_noflip)
        return
    if m.nv <= FEW:
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
    theirs = smooth._factor_i_sparse, smooth.factor_solve_i
    try:
        if own.size:
            smooth._factor_i_sparse, smooth.factor_solve_i = own.factor, own.factor_and_solve
        solver._cholesky_factorize_solve = solve_direction
        yield
    finally:
        smooth._factor_i_sparse, smooth.factor_solve_i = theirs
        solver._cholesky_factorize_solve = _their_direction
