"""Newton's direction in MuJoCo Warp's solver: one block of threads a world, in shared memory.

MuJoCo Warp factors the solver's Hessian H = M + J^T D J in tiles of 16 x 16 by one warp a world:
of a control step of SMPL-X that is a third, and its launches last as long for a few worlds as for
thousands. Here a block holds the lower triangle of a world's H in shared memory and eliminates the
degrees of freedom from the last to the first, H = L^T D L as for the inertia of a tree, where a
tree has no fill-in; pairs with a zero are skipped. Then L^T y = g, z = y / D, L x = z. H itself is
left alone: the solver changes it as constraints come and go. Sources: Featherstone (2008), section
6.5, for the order; Golub and Van Loan, Matrix Computations, section 4.1, for L D L^T.
"""

# No postponed annotations: Warp reads the size of a tile from one.
from functools import cache
from typing import Any

import warp as wp

LANES = 128
"""Threads of a block on a GPU: four warps."""
MOST = 200
"""Degrees of freedom of the largest model that is solved here: 80 kB of a block's 227 kB."""

_DIRECTION = """
    const int n = NV;
    float* rows = storage.data.ptr;
    float* rhs = rows + n * (n + 1) / 2;
    const size_t world = w;
    const float* H = (const float*)((const char*)hessian.data + world * hessian.strides[0]);
    const int ld = hessian.strides[1] / sizeof(float);
    const float* g = (const float*)((const char*)gradient.data + world * gradient.strides[0]);
    float* direction = (float*)((char*)search.data + world * search.strides[0]);
    const float least = 1e-15f;
#if defined(__CUDA_ARCH__)
    const int warps = lanes / 32, high = lane / 32, across = lane % 32;
    for (int r = high; r < n; r += warps)
        for (int c = r + across; c < n; c += 32)
            rows[c * (c + 1) / 2 + r] = H[r * ld + c];
    for (int i = lane; i < n; i += lanes)
        rhs[i] = g[i];
    WP_TILE_SYNC();
    for (int k = n - 1; k > 0; --k) {
        // Every warp keeps the whole row k in its registers, and which entries are not zero.
        const float* row = rows + k * (k + 1) / 2;
        const float inverse = 1.0f / fmaxf(row[k], least);
        float v[CHUNKS];
        unsigned filled[CHUNKS];
#pragma unroll
        for (int c = 0; c < CHUNKS; ++c) {
            const int j = across + 32 * c;
            v[c] = j < k ? row[j] : 0.0f;
            filled[c] = __ballot_sync(0xffffffffu, v[c] != 0.0f);
        }
        if (high == 0) {
            const float f = rhs[k] * inverse;
#pragma unroll
            for (int c = 0; c < CHUNKS; ++c)
                if (v[c] != 0.0f)
                    rhs[across + 32 * c] -= f * v[c];
        }
        int count = 0;
#pragma unroll
        for (int a = 0; a < CHUNKS; ++a) {
            unsigned bits = filled[a];
            while (bits != 0u) {
                const int b = __ffs(bits) - 1;
                bits &= bits - 1u;
                const bool mine = count % warps == high;
                ++count;
                if (!mine)
                    continue;
                const int i = 32 * a + b;
                const float f = __shfl_sync(0xffffffffu, v[a], b) * inverse;
                float* target = rows + i * (i + 1) / 2;
#pragma unroll
                for (int c = 0; c <= a; ++c) {
                    const int j = across + 32 * c;
                    if (v[c] != 0.0f && j <= i)
                        target[j] -= f * v[c];
                }
            }
        }
        WP_TILE_SYNC();
    }
    if (high == 0) {
        float left[CHUNKS];
#pragma unroll
        for (int c = 0; c < CHUNKS; ++c)
            left[c] = across + 32 * c < n ? rhs[across + 32 * c] : 0.0f;
#pragma unroll
        for (int a = 0; a < CHUNKS; ++a) {
            for (int b = 0; b < 32 && 32 * a + b < n; ++b) {
                const int k = 32 * a + b;
                const float pivot = fmaxf(rows[k * (k + 1) / 2 + k], least);
                const float x = __shfl_sync(0xffffffffu, left[a], b) / pivot;
                if (across == b)
                    left[a] = x;
#pragma unroll
                for (int c = a; c < CHUNKS; ++c) {
                    const int i = across + 32 * c;
                    if (i > k && i < n)
                        left[c] -= rows[i * (i + 1) / 2 + k] * x;
                }
            }
        }
        float square = 0.0f, product = 0.0f;
#pragma unroll
        for (int c = 0; c < CHUNKS; ++c) {
            const int i = across + 32 * c;
            if (i < n) {
                direction[i] = -left[c];
                square += left[c] * left[c];
                product += left[c] * g[i];
            }
        }
        for (int half = 16; half > 0; half /= 2) {
            square += __shfl_xor_sync(0xffffffffu, square, half);
            product += __shfl_xor_sync(0xffffffffu, product, half);
        }
        if (across == 0) {
            squares.data[w] = square;
            decrements.data[w] = product;
        }
    }
    WP_TILE_SYNC();
#else
    for (int r = 0; r < n; ++r)
        for (int c = r; c < n; ++c)
            rows[c * (c + 1) / 2 + r] = H[r * ld + c];
    for (int i = 0; i < n; ++i)
        rhs[i] = g[i];
    for (int k = n - 1; k > 0; --k) {
        const float* row = rows + k * (k + 1) / 2;
        const float inverse = 1.0f / (row[k] > least ? row[k] : least);
        for (int i = 0; i < k; ++i) {
            if (row[i] == 0.0f)
                continue;
            const float f = row[i] * inverse;
            rhs[i] -= f * rhs[k];
            for (int j = 0; j <= i; ++j)
                rows[i * (i + 1) / 2 + j] -= f * row[j];
        }
    }
    float square = 0.0f, product = 0.0f;
    for (int i = 0; i < n; ++i) {
        const float* row = rows + i * (i + 1) / 2;
        float x = rhs[i];
        for (int j = 0; j < i; ++j)
            x -= row[j] * rhs[j];
        x /= row[i] > least ? row[i] : least;
        rhs[i] = x;
        direction[i] = -x;
        square += x * x;
        product += x * g[i];
    }
    squares.data[w] = square;
    decrements.data[w] = product;
#endif
"""


def block_lanes() -> int:
    """Threads of a block on Warp's current device; on a CPU it has one."""
    return LANES if wp.get_device().is_cuda else 1


@cache
def direction_kernel(dofs: int, skip_noflip: bool) -> wp.Kernel:
    """Search direction -H^-1 g of worlds that ask for one, the square of its length, and its
    product with g (positive)."""
    size = dofs * (dofs + 1) // 2 + dofs
    snippet = _DIRECTION.replace("CHUNKS", str(-(-dofs // 32))).replace("NV", str(dofs))

    @wp.func_native(snippet=snippet)
    def find_direction(
        w: int,
        lane: int,
        lanes: int,
        storage: wp.tile[float, size],  # type: ignore[valid-type]
        hessian: wp.array3d(dtype=float),  # type: ignore[valid-type]
        gradient: wp.array2d(dtype=float),  # type: ignore[valid-type]
        search: wp.array2d(dtype=float),  # type: ignore[valid-type]
        squares: wp.array(dtype=float),  # type: ignore[valid-type]
        decrements: wp.array(dtype=float),  # type: ignore[valid-type]
    ): ...

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def find_directions(
        done: wp.array(dtype=bool),  # type: ignore[valid-type]
        flipped: wp.array(dtype=int),  # type: ignore[valid-type]
        hessian: wp.array3d(dtype=float),  # type: ignore[valid-type]
        gradient: wp.array2d(dtype=float),  # type: ignore[valid-type]
        search: wp.array2d(dtype=float),  # type: ignore[valid-type]
        squares: wp.array(dtype=float),  # type: ignore[valid-type]
        decrements: wp.array(dtype=float),  # type: ignore[valid-type]
    ):
        w, lane = wp.tid()
        if done[w]:
            return
        # No constraint changed its state: the direction is the one before.
        if wp.static(skip_noflip):
            if flipped[w] == 0:
                return
        storage = wp.tile_empty(shape=size, dtype=float, storage="shared")
        lanes = wp.block_dim()
        find_direction(w, lane, lanes, storage, hessian, gradient, search, squares, decrements)

    return find_directions


def find_direction(m: Any, d: Any, ctx: Any, skip_noflip: bool) -> None:
    """Newton's direction of every world into ``ctx.search``."""
    lanes = block_lanes()
    wp.launch(
        direction_kernel(m.nv, skip_noflip),
        dim=(d.nworld, lanes),
        inputs=[ctx.done, ctx.state_changed_count if skip_noflip else d.nefc, ctx.h, ctx.grad],
        outputs=[ctx.search, ctx.search_dot, ctx.newton_decrement],
        block_dim=lanes,
    )
