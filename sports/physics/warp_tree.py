"""Equations of trees of bodies, solved for MuJoCo Warp's step without a matrix.

Three times in a substep MuJoCo solves ``(M + B) x = b`` with the joint-space inertia M: for the
acceleration without constraints (B = 0), for the integrator (B: the dampers' and servos' share of
the diagonal), and in each iteration of Newton's method (B = J^T D J: the constraints that push).
Here a block of threads takes a world and goes along its trees, a lane for each of the bodies that
are equally far from their root: the articulated-body algorithm (Featherstone, Rigid Body Dynamics
Algorithms, 2008, section 7.3) in MuJoCo's coordinates, about the centre of mass of a tree, in which
inertias and forces of a child are added to its parent's as they are. It takes O(n) operations,
where a Cholesky factor of the Hessian takes O(n^3) (165 degrees of freedom: 11 thousand
multiplications instead of 1.5 million).

What B holds of constraints:

* a joint's limit adds D to the joint's diagonal;
* a contact with something that does not move pushes one body along a wrench W for each edge of the
  friction pyramid, and D W W^T is added to that body's inertia;
* a contact of two bodies that both move couples them. Its rows j are solved apart: let the rest be
  L^T P L with pivots P, and u = L^-T j, which is zero but along the paths from both bodies to their
  roots; then (1/D + u^T P^-1 u) z = u^T P^-1 L^-T b, and what is left to solve has L^-T b - u z in
  the place of L^-T b (Woodbury's formula; the small matrix is well conditioned, as 1/D is a share
  of what it is added to). Of more than ``COUPLED`` such rows in a world, the others are put on both
  bodies' inertias with twice their D, which is no less than what they are: Newton's direction still
  descends.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from string import Template
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco_warp._src import types

COUPLED = 44
"""Rows of contacts between two bodies that move that a world solves exactly."""
AGAIN = 128
"""Threads of a block for Newton's direction, but in the first iteration: few of the worlds that
iterate on are not coupled, and what couples them has more to do side by side than a level of a
tree."""
CREW = 200
"""Degrees of freedom for each 32 threads of the first iteration, for which most worlds have little
to do."""

ROOM = 48 * 1024
"""Bytes of shared memory that a block may have; two by two athletes with fingers take 47972."""

_COLUMNS = ("body", "parent", "root", "dof", "dofs", "child", "children")
"""Of the table of bodies: the body's own number; its parent's row (-1: none); the root's number;
first degree of freedom and their number; first child's row and their number."""

_SOLVE = """
#if defined(__CUDA_ARCH__)
    #define SHARED __shared__
    #define ADD(x, v) atomicAdd(&(x), (v))
    #define TAKE(x) atomicAdd(&(x), 1)
#else
    #define SHARED
    #define ADD(x, v) ((x) += (v))
    #define TAKE(x) ((x)++)
#endif
#define AT(r, c) ((r) * (11 - (r)) / 2 + (c))
#define ROW(i) ((i) * ((i) + 1) / 2)
    SHARED float slot[BODIES * 27];  // of a body: inertia (21), force (6), then acceleration
    SHARED float along[DOFS * 7];    // of a degree of freedom: inertia along it (6), 1 / pivot
    SHARED float push[DOFS];
    const size_t world = w;
    const float* inertias = (const float*)((const char*)inertia.data + world * inertia.strides[0]);
    const float* axes = (const float*)((const char*)axis.data + world * axis.strides[0]);
    const float* rotors = (const float*)((const char*)armature.data
        + (world % armature.shape[0]) * armature.strides[0]);
    const float* before = (const float*)((const char*)bare.data + world * bare.strides[0]);
    const float* after = (const float*)((const char*)damped.data + world * damped.strides[0]);
    const int* rows = table.data;
    for (int e = lane; e < BODIES * 27; e += lanes)
        slot[e] = 0.0f;
    for (int k = lane; k < DOFS; k += lanes) {
        const int entry = diagonal.data[k];
        along[k * 7 + 6] = rotors[k] + (after[entry] - before[entry]);
        $right
    }
$constraints
    for (int level = levels - 1; level >= 0; --level) {
        const int end = begin.data[level + 1];
        int i = begin.data[level] + lane;
        float I[21], P[6], S[18];
        // What of a body needs nothing of its children comes first: it is waited for together.
        auto fetch = [&]() {
            const int* row = rows + 7 * i;
            const float* own = inertias + 10 * row[0];
            for (int e = 0; e < 21; ++e)
                I[e] = 0.0f;
            I[AT(0, 0)] = own[0]; I[AT(1, 1)] = own[1]; I[AT(2, 2)] = own[2];
            I[AT(0, 1)] = own[3]; I[AT(0, 2)] = own[4]; I[AT(1, 2)] = own[5];
            I[AT(0, 4)] = -own[8]; I[AT(0, 5)] = own[7]; I[AT(1, 3)] = own[8];
            I[AT(1, 5)] = -own[6]; I[AT(2, 3)] = -own[7]; I[AT(2, 4)] = own[6];
            I[AT(3, 3)] = own[9]; I[AT(4, 4)] = own[9]; I[AT(5, 5)] = own[9];
            const float* s = axes + 6 * (row[3] + row[4] - 1);
            for (int q = 0; q < 3; ++q)
                for (int e = 0; e < 6; ++e)
                    S[6 * q + e] = q < row[4] ? s[e - 6 * q] : 0.0f;
        };
        auto take = [&](int k, const float* s) {
            float U[6], pivot = along[k * 7 + 6], u = push[k];
            for (int r = 0; r < 6; ++r) {
                float sum = 0.0f;
                for (int c = 0; c < 6; ++c)
                    sum += I[r < c ? AT(r, c) : AT(c, r)] * s[c];
                U[r] = sum;
                pivot += sum * s[r];
                u -= s[r] * P[r];
            }
            const float inverse = 1.0f / pivot, share = u * inverse;
            for (int r = 0; r < 6; ++r) {
                const float scaled = U[r] * inverse;
                for (int c = r; c < 6; ++c)
                    I[AT(r, c)] -= scaled * U[c];
                P[r] += U[r] * share;
                along[k * 7 + r] = U[r];
            }
            along[k * 7 + 6] = inverse;
            push[k] = u;
        };
        if (i < end)
            fetch();
        WP_TILE_SYNC();
        while (i < end) {
            const int* row = rows + 7 * i;
            for (int e = 0; e < 21; ++e)
                I[e] += slot[i * 27 + e];
            for (int e = 0; e < 6; ++e)
                P[e] = 0.0f;
            for (int j = row[5]; j < row[5] + row[6]; ++j) {
                for (int e = 0; e < 21; ++e)
                    I[e] += slot[j * 27 + e];
                for (int e = 0; e < 6; ++e)
                    P[e] += slot[j * 27 + 21 + e];
            }
            const int last = row[3] + row[4] - 1;
            for (int q = 0; q < 3; ++q)
                if (q < row[4])
                    take(last - q, S + 6 * q);
            for (int k = last - 3; k >= row[3]; --k)
                take(k, axes + 6 * k);
            for (int e = 0; e < 21; ++e)
                slot[i * 27 + e] = I[e];
            for (int e = 0; e < 6; ++e)
                slot[i * 27 + 21 + e] = P[e];
            i += lanes;
            if (i < end)
                fetch();
        }
    }
    WP_TILE_SYNC();
$coupling
    for (int level = 0; level < levels; ++level) {
        for (int i = begin.data[level] + lane; i < begin.data[level + 1]; i += lanes) {
            const int* row = rows + 7 * i;
            float A[6], S[18];
            for (int q = 0; q < 3; ++q)
                for (int e = 0; e < 6; ++e)
                    S[6 * q + e] = q < row[4] ? axes[6 * (row[3] + q) + e] : 0.0f;
            auto give = [&](int k, const float* s) {
                float x = push[k];
                for (int e = 0; e < 6; ++e)
                    x -= along[k * 7 + e] * A[e];
                x *= along[k * 7 + 6];
                for (int e = 0; e < 6; ++e)
                    A[e] += s[e] * x;
                push[k] = x;
            };
            for (int e = 0; e < 6; ++e)
                A[e] = row[1] < 0 ? 0.0f : slot[row[1] * 27 + 21 + e];
            for (int q = 0; q < 3; ++q)
                if (q < row[4])
                    give(row[3] + q, S + 6 * q);
            for (int k = row[3] + 3; k < row[3] + row[4]; ++k)
                give(k, axes + 6 * k);
            for (int e = 0; e < 6; ++e)
                slot[i * 27 + 21 + e] = A[e];
        }
        WP_TILE_SYNC();
    }
    float* result = (float*)((char*)solution.data + world * solution.strides[0]);
$output
#undef SHARED
#undef ADD
#undef TAKE
#undef AT
#undef ROW
"""

_MULTIPLY = """
#if defined(__CUDA_ARCH__)
    __shared__ float slot[BODIES * 6];  // of a body: acceleration, then force
#else
    float slot[BODIES * 6];
#endif
    const size_t world = w;
    const float* inertias = (const float*)((const char*)inertia.data + world * inertia.strides[0]);
    const float* axes = (const float*)((const char*)axis.data + world * axis.strides[0]);
    const float* given = (const float*)((const char*)factor.data + world * factor.strides[0]);
    const float* rotors = (const float*)((const char*)armature.data
        + (world % armature.shape[0]) * armature.strides[0]);
    float* result = (float*)((char*)product.data + world * product.strides[0]);
    const int* rows = table.data;
    for (int level = 0; level < levels; ++level) {
        for (int i = begin.data[level] + lane; i < begin.data[level + 1]; i += lanes) {
            const int* row = rows + 7 * i;
            float A[6];
            for (int e = 0; e < 6; ++e)
                A[e] = row[1] < 0 ? 0.0f : slot[row[1] * 6 + e];
            for (int k = row[3]; k < row[3] + row[4]; ++k)
                for (int e = 0; e < 6; ++e)
                    A[e] += axes[6 * k + e] * given[k];
            for (int e = 0; e < 6; ++e)
                slot[i * 6 + e] = A[e];
        }
        WP_TILE_SYNC();
    }
    for (int level = levels - 1; level >= 0; --level) {
        for (int i = begin.data[level] + lane; i < begin.data[level + 1]; i += lanes) {
            const int* row = rows + 7 * i;
            const float* I = inertias + 10 * row[0];
            const float* A = slot + i * 6;
            float F[6];
            F[0] = I[0] * A[0] + I[3] * A[1] + I[4] * A[2] - I[8] * A[4] + I[7] * A[5];
            F[1] = I[3] * A[0] + I[1] * A[1] + I[5] * A[2] + I[8] * A[3] - I[6] * A[5];
            F[2] = I[4] * A[0] + I[5] * A[1] + I[2] * A[2] - I[7] * A[3] + I[6] * A[4];
            F[3] = I[8] * A[1] - I[7] * A[2] + I[9] * A[3];
            F[4] = I[6] * A[2] - I[8] * A[0] + I[9] * A[4];
            F[5] = I[7] * A[0] - I[6] * A[1] + I[9] * A[5];
            for (int j = row[5]; j < row[5] + row[6]; ++j)
                for (int e = 0; e < 6; ++e)
                    F[e] += slot[j * 6 + e];
            for (int k = row[3]; k < row[3] + row[4]; ++k) {
                float sum = rotors[k] * given[k];
                for (int e = 0; e < 6; ++e)
                    sum += axes[6 * k + e] * F[e];
                result[k] = sum;
            }
            for (int e = 0; e < 6; ++e)
                slot[i * 6 + e] = F[e];
        }
        WP_TILE_SYNC();
    }
"""

_CONSTRAINTS = """
    SHARED int coupled[COUPLED];
    SHARED int many;
    SHARED float sums[3];
    if (lane == 0) {
        many = 0;
        sums[0] = sums[1] = sums[2] = 0.0f;
    }
    WP_TILE_SYNC();
    const int* states = (const int*)((const char*)state.data + world * state.strides[0]);
    const int* kinds = (const int*)((const char*)kind.data + world * kind.strides[0]);
    const int* ids = (const int*)((const char*)id.data + world * id.strides[0]);
    const float* masses = (const float*)((const char*)mass.data + world * mass.strides[0]);
    const int* starts = (const int*)((const char*)start.data + world * start.strides[0]);
    const int* columns = (const int*)((const char*)column.data + world * column.strides[0]);
    const float* jacobian = (const float*)((const char*)entries.data + world * entries.strides[0]);
    const float* centres = (const float*)((const char*)centre.data + world * centre.strides[0]);
    // The wrench, about the centre of mass of a body's tree, of a row of a contact.
    auto wrench = [&](int e, int i, float* W) {
        const int contact = ids[e];
        const float* frame = (const float*)frames.data + 9 * (size_t)contact;
        const float* point = (const float*)points.data + 3 * (size_t)contact;
        const float* com = centres + 3 * rows[7 * i + 2];
        float d[3], r[3];
        for (int x = 0; x < 3; ++x) {
            d[x] = frame[x];
            r[x] = point[x] - com[x];
        }
        if (kinds[e] == PYRAMID) {
            const int edge = e - ((const int*)((const char*)address.data
                + (size_t)contact * address.strides[0]))[0];
            const float mu = ((const float*)friction.data)[5 * (size_t)contact + edge / 2];
            const float share = edge % 2 ? -mu : mu;
            for (int x = 0; x < 3; ++x)
                d[x] += share * frame[3 * (edge / 2 + 1) + x];
        }
        W[0] = r[1] * d[2] - r[2] * d[1];
        W[1] = r[2] * d[0] - r[0] * d[2];
        W[2] = r[0] * d[1] - r[1] * d[0];
        W[3] = d[0]; W[4] = d[1]; W[5] = d[2];
    };
    const int count = number.data[world] < most ? number.data[world] : most;
    for (int e = lane; e < count; e += lanes) {
        if (states[e] != QUADRATIC)
            continue;
        if (kinds[e] == LIMIT) {
            const float j = jacobian[starts[e]];
            ADD(along[columns[starts[e]] * 7 + 6], masses[e] * j * j);
            continue;
        }
        const int* geoms = (const int*)pairs.data + 2 * (size_t)ids[e];
        const int a = where.data[geoms[0]], b = where.data[geoms[1]];
        float scale = masses[e];
        if (a >= 0 && b >= 0) {
            const int place = TAKE(many);
            if (place < COUPLED) {
                coupled[place] = e;
                continue;
            }
            scale *= 2.0f;
        }
        for (int side = 0; side < 2; ++side) {
            const int i = side ? b : a;
            if (i < 0)
                continue;
            float W[6];
            wrench(e, i, W);
            for (int r = 0; r < 6; ++r)
                for (int c = r; c < 6; ++c)
                    ADD(slot[i * 27 + AT(r, c)], scale * W[r] * W[c]);
        }
    }
"""

_COUPLING = """
    const int n = many < COUPLED ? many : COUPLED;
    if (n > 0) {
        SHARED float K[COUPLED * (COUPLED + 1) / 2];  // the lower triangle, row by row
        SHARED float z[COUPLED];
        SHARED int ends[COUPLED][3];  // rows of both bodies, length of what their paths share
        float* V = (float*)((char*)scratch.data + world * scratch.strides[0]);
        for (int e = lane; e < DOFS * n; e += lanes)
            V[e] = 0.0f;
        WP_TILE_SYNC();
        for (int c = lane; c < n; c += lanes) {
            const int e = coupled[c];
            const int* geoms = (const int*)pairs.data + 2 * (size_t)ids[e];
            int a = where.data[geoms[0]], b = where.data[geoms[1]];
            float P[2][6];
            wrench(e, a, P[0]);
            wrench(e, b, P[1]);
            for (int x = 0; x < 6; ++x)
                P[1][x] = -P[1][x];
            ends[c][0] = a;
            ends[c][1] = b;
            ends[c][2] = 0;
            while (a >= 0 || b >= 0) {
                if (a == b) {
                    for (int x = 0; x < 6; ++x)
                        P[0][x] += P[1][x];
                    ends[c][2] = stops.data[a + 1] - stops.data[a];
                    b = -1;
                }
                const int side = b > a, i = side ? b : a;
                const int* row = rows + 7 * i;
                float Q[6];
                for (int x = 0; x < 6; ++x)
                    Q[x] = side ? P[1][x] : P[0][x];
                for (int k = row[3] + row[4] - 1; k >= row[3]; --k) {
                    const float* s = axes + 6 * k;
                    float u = 0.0f;
                    for (int x = 0; x < 6; ++x)
                        u -= s[x] * Q[x];
                    const float share = u * along[k * 7 + 6];
                    for (int x = 0; x < 6; ++x)
                        Q[x] += along[k * 7 + x] * share;
                    V[k * n + c] = u;
                }
                for (int x = 0; x < 6; ++x)
                    if (side)
                        P[1][x] = Q[x];
                    else
                        P[0][x] = Q[x];
                if (side)
                    b = row[1];
                else
                    a = row[1];
            }
        }
        WP_TILE_SYNC();
        // K and the right side: u_i is not zero along two paths.
        for (int e = lane; e < n * (n + 3) / 2; e += lanes) {
            int i = (int)((sqrtf(8.0f * e + 9.0f) - 3.0f) * 0.5f);
            while ((i + 1) * (i + 4) / 2 <= e)
                ++i;
            while (i * (i + 3) / 2 > e)
                --i;
            const int j = e - i * (i + 3) / 2 - 1;
            float sum = i == j ? 1.0f / masses[coupled[i]] : 0.0f;
            for (int side = 0; side < 2; ++side) {
                const int body = ends[i][side];
                const int from = stops.data[body] + (side ? ends[i][2] : 0);
                const int to = stops.data[body + 1];
                for (int x = from; x < to; ++x) {
                    const int k = paths.data[x];
                    sum += V[k * n + i] * along[k * 7 + 6] * (j < 0 ? push[k] : V[k * n + j]);
                }
            }
            if (j < 0)
                z[i] = sum;
            else
                K[ROW(i) + j] = sum;
        }
        WP_TILE_SYNC();
        for (int p = 0; p < n; ++p) {
            const float pivot = 1.0f / K[ROW(p) + p];
            const int left = n - 1 - p;
            for (int e = lane; e < left * (left + 1); e += lanes) {
                const int i = p + 1 + e / (left + 1), j = p + e % (left + 1);
                if (j == p)
                    z[i] -= K[ROW(i) + p] * pivot * z[p];
                else if (j <= i)
                    K[ROW(i) + j] -= K[ROW(i) + p] * pivot * K[ROW(j) + p];
            }
            WP_TILE_SYNC();
        }
        for (int p = n - 1; p >= 0; --p) {
            const float solved = z[p] / K[ROW(p) + p];
            for (int i = lane; i < p; i += lanes)
                z[i] -= K[ROW(p) + i] * solved;
            WP_TILE_SYNC();
            if (lane == 0)
                z[p] = solved;
        }
        WP_TILE_SYNC();
        for (int k = lane; k < DOFS; k += lanes) {
            float u = push[k];
            for (int c = 0; c < n; ++c)
                u -= z[c] * V[k * n + c];
            push[k] = u;
        }
        WP_TILE_SYNC();
    }
"""

_PLAIN_RIGHT = "push[k] = ((const float*)((const char*)right.data + world * right.strides[0]))[k];"

_NEWTON_RIGHT = """
        const float g = ((const float*)((const char*)moved.data + world * moved.strides[0]))[k]
            - ((const float*)((const char*)smooth.data + world * smooth.strides[0]))[k]
            - ((const float*)((const char*)held.data + world * held.strides[0]))[k];
        ((float*)((char*)gradient.data + world * gradient.strides[0]))[k] = push[k] = g;
"""

_PLAIN_OUTPUT = """
    for (int k = lane; k < DOFS; k += lanes)
        result[k] = push[k];
"""

_NEWTON_OUTPUT = """
    const float* slope = (const float*)((const char*)gradient.data + world * gradient.strides[0]);
    float square = 0.0f, decrement = 0.0f, steepness = 0.0f;
    for (int k = lane; k < DOFS; k += lanes) {
        const float x = push[k], g = slope[k];
        result[k] = -x;
        square += x * x;
        decrement += x * g;
        steepness += g * g;
    }
    ADD(sums[0], square);
    ADD(sums[1], decrement);
    ADD(sums[2], steepness);
    WP_TILE_SYNC();
    if (lane == 0) {
        squares.data[world] = sums[0];
        decrements.data[world] = sums[1];
        steepnesses.data[world] = sums[2];
    }
"""


@dataclass(frozen=True)
class Trees:
    """The trees of a model, on a Warp device."""

    table: wp.array
    """(B, 7) rows of ``_COLUMNS`` of the bodies that move, those nearer to their root first,
    children of one parent side by side."""
    begin: wp.array
    """(L + 1,) first row of each level."""
    where: wp.array
    """(G,) row of the body of each geom; -1 where it does not move."""
    stops: wp.array
    """(B + 1,) where the path of each body begins in ``paths``."""
    paths: wp.array
    """Degrees of freedom from the root to a body, of one body after the other."""
    diagonal: wp.array
    """(nv,) where M keeps its diagonal."""
    each: wp.array
    """(nv,) all degrees of freedom."""
    above: wp.array
    """(nv,) parents of the degrees of freedom of trees of one body; -1 for the others."""
    bodies: int
    dofs: int
    lanes: int
    """Threads of a block: no fewer than the bodies of a level."""
    whole: bool
    """Newton's direction is found here too: all constraints are limits of joints and contacts with
    a pyramid for friction, and a block has room for it."""
    plain: bool
    """Nothing but the joints' own armature, damping and servos is on M's and the integrator's
    diagonals, nothing lifts bodies, and a block has room: all is solved here."""
    geared: list[Any]
    """Data that know the servos' moments, which never change."""
    scratch: wp.array
    """(N, nv COUPLED) where each world notes its coupled rows."""

    @property
    def levels(self) -> int:
        return self.begin.shape[0] - 1

    def solve(self, m: Any, d: Any, damped: wp.array, x: wp.array, y: wp.array) -> None:
        """``(M + B) x = y``, B the diagonal by which ``damped`` is more than ``d.M``."""
        wp.launch(
            _solve_kernel(self.bodies, self.dofs),
            dim=(d.nworld, _block(self.lanes)),
            inputs=[*self._inertias(m, d), d.M, damped, y],
            outputs=[x],
            block_dim=_block(self.lanes),
        )

    def multiply(self, m: Any, d: Any, y: wp.array, x: wp.array, skip: wp.array) -> None:
        """``y = M x`` in the worlds that do not ``skip``."""
        lanes = _block(self.lanes)
        tables = [self.table, self.begin, self.levels]
        wp.launch(
            _multiply_kernel(self.bodies),
            dim=(d.nworld, lanes),
            inputs=[skip, *tables, d.cinert, d.cdof, m.dof_armature, x],
            outputs=[y],
            block_dim=lanes,
        )

    def direction(self, m: Any, d: Any, ctx: Any, again: bool) -> None:
        """The gradient of the cost and Newton's direction; ``again``: after the step ``ctx.alpha``
        along the one before, and anew only in worlds in which a constraint's state has changed."""
        contact, rows = d.contact, d.efc
        lanes = _block(max(self.lanes, AGAIN if again else 32 * -(-self.dofs // CREW)))
        wp.launch(
            _newton_kernel(self.bodies, self.dofs),
            dim=(d.nworld, lanes),
            inputs=[
                ctx.done,
                ctx.state_changed_count if again else d.nefc,
                again,
                ctx.alpha,
                *self._inertias(m, d),
                d.M,
                d.M,
                rows.Ma,
                d.qfrc_smooth,
                d.qfrc_constraint,
                self.where,
                self.stops,
                self.paths,
                d.subtree_com,
                d.nefc,
                d.njmax,
                rows.state,
                rows.type,
                rows.id,
                rows.D,
                rows.J_rowadr,
                rows.J_colind,
                rows.J,
                contact.geom,
                contact.pos,
                contact.frame,
                contact.friction,
                contact.efc_address,
            ],
            outputs=[
                self.scratch,
                ctx.grad,
                ctx.search,
                ctx.search_dot,
                ctx.newton_decrement,
                ctx.grad_dot,
                ctx.grad_scale,
                ctx.search_unchanged,
            ],
            block_dim=lanes,
        )

    def _inertias(self, m: Any, d: Any) -> list[Any]:
        tables = [self.table, self.begin, self.levels, self.diagonal]
        return [*tables, d.cinert, d.cdof, m.dof_armature]


def _block(lanes: int) -> int:
    return lanes if wp.get_device().is_cuda else 1


def trees(model: mujoco.MjModel, num_worlds: int) -> Trees:
    """Of a model, on Warp's current device."""
    parent, depth = np.asarray(model.body_parentid), np.zeros(model.nbody, dtype=int)
    moving = np.asarray(model.body_treeid) >= 0
    for b in range(1, model.nbody):
        depth[b] = depth[parent[b]] + 1 if moving[parent[b]] else 0
    order: list[int] = []
    level = [b for b in range(1, model.nbody) if moving[b] and depth[b] == 0]
    begin = [0]
    while level:
        order += level
        begin.append(len(order))
        level = [c for b in level for c in range(b + 1, model.nbody) if parent[c] == b]
    row = np.full(model.nbody, -1)
    row[order] = np.arange(len(order))
    table = np.zeros((len(order), len(_COLUMNS)), dtype=np.int32)
    for i, b in enumerate(order):
        children = [row[c] for c in order if parent[c] == b]
        table[i] = (
            b,
            row[parent[b]],
            model.body_rootid[b],
            max(model.body_dofadr[b], 0),
            model.body_dofnum[b],
            min(children, default=0),
            len(children),
        )
    paths: list[list[int]] = []
    for _, up, _, dof, dofs, _, _ in table.tolist():
        paths.append((paths[up] if up >= 0 else []) + list(range(dof, dof + dofs)))
    room = 4 * (27 * len(order) + 8 * model.nv)
    room_of_rows = 4 * (COUPLED * (COUPLED + 1) // 2 + 5 * COUPLED + 4)
    contacts_known = (
        model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
        and model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
        and {*np.asarray(model.geom_condim), *np.asarray(model.pair_dim)} <= {1, 3}
        and not (model.neq or model.ntendon or model.nflex)
        and not np.any(np.asarray(model.dof_frictionloss))
        and room + room_of_rows <= ROOM
    )
    driven = np.asarray(model.jnt_type)[np.asarray(model.actuator_trnid)[:, 0]]
    members = np.bincount(np.asarray(model.body_treeid)[moving], minlength=model.ntree)
    alone = members[np.asarray(model.dof_treeid)] == 1
    width = int(np.diff(begin).max())
    return Trees(
        table=wp.array(table.reshape(-1), dtype=int),
        begin=wp.array(np.array(begin, dtype=np.int32), dtype=int),
        where=wp.array(row[np.asarray(model.geom_bodyid)].astype(np.int32), dtype=int),
        stops=wp.array(np.cumsum([0, *map(len, paths)]).astype(np.int32), dtype=int),
        paths=wp.array(np.array([k for path in paths for k in path], dtype=np.int32), dtype=int),
        diagonal=wp.array(
            (np.asarray(model.M_rowadr) + np.asarray(model.M_rownnz) - 1).astype(np.int32),
            dtype=int,
        ),
        each=wp.array(np.arange(model.nv, dtype=np.int32), dtype=int),
        above=wp.array(np.where(alone, model.dof_parentid, -1).astype(np.int32), dtype=int),
        bodies=len(order),
        dofs=model.nv,
        lanes=32 * -(-width // 32),
        whole=bool(contacts_known),
        plain=not (
            np.any(np.asarray(model.body_gravcomp))
            or model.opt.density
            or model.opt.viscosity
            or model.nflex
            or model.ntendon
            or np.any(np.asarray(model.actuator_armature))
            or np.any(np.asarray(model.actuator_trntype) != int(mujoco.mjtTrn.mjTRN_JOINT))
            or np.any(driven < int(mujoco.mjtJoint.mjJNT_SLIDE))
            or room > ROOM
        ),
        geared=[],
        scratch=wp.empty((num_worlds, model.nv * COUPLED if contacts_known else 0), dtype=float),
    )


@cache
def _solve_kernel(bodies: int, dofs: int) -> wp.Kernel:
    """``(M + B) x = y`` with a diagonal B, in every world."""

    @wp.func_native(snippet=_text(bodies, dofs))
    def solve_trees(
        w: int,
        lane: int,
        lanes: int,
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        diagonal: wp.array(dtype=int),  # type: ignore[valid-type]
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        bare: wp.array2d(dtype=float),  # type: ignore[valid-type]
        damped: wp.array2d(dtype=float),  # type: ignore[valid-type]
        right: wp.array2d(dtype=float),  # type: ignore[valid-type]
        solution: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ): ...

    @wp.kernel(module="unique", enable_backward=False)
    def tree_solution(
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        diagonal: wp.array(dtype=int),  # type: ignore[valid-type]
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        bare: wp.array2d(dtype=float),  # type: ignore[valid-type]
        damped: wp.array2d(dtype=float),  # type: ignore[valid-type]
        right: wp.array2d(dtype=float),  # type: ignore[valid-type]
        solution: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ):
        w, lane = wp.tid()
        lanes = wp.block_dim()
        solve_trees(
            w, lane, lanes, table, begin, levels, diagonal, inertia, axis, armature, bare, damped,
            right, solution,
        )  # fmt: skip

    return tree_solution


@cache
def _multiply_kernel(bodies: int) -> wp.Kernel:
    """``M x``; the length of ``skip`` may be 0."""

    @wp.func_native(snippet=_fill(_MULTIPLY, {"BODIES": bodies}))
    def multiply_trees(
        w: int,
        lane: int,
        lanes: int,
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        factor: wp.array2d(dtype=float),  # type: ignore[valid-type]
        product: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ): ...

    @wp.kernel(module="unique", enable_backward=False)
    def tree_product(
        skip: wp.array(dtype=bool),  # type: ignore[valid-type]
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        factor: wp.array2d(dtype=float),  # type: ignore[valid-type]
        product: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ):
        w, lane = wp.tid()
        if skip.shape[0] > 0:
            if skip[w]:
                return
        lanes = wp.block_dim()
        multiply_trees(
            w, lane, lanes, table, begin, levels, inertia, axis, armature, factor, product
        )

    return tree_product


@cache
def _newton_kernel(bodies: int, dofs: int) -> wp.Kernel:
    """The gradient and Newton's direction in every world that is not done; ``again``: where
    something has ``changed``."""

    @wp.func_native(snippet=_text(bodies, dofs, newton=True))
    def solve_trees(
        w: int,
        lane: int,
        lanes: int,
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        diagonal: wp.array(dtype=int),  # type: ignore[valid-type]
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        bare: wp.array2d(dtype=float),  # type: ignore[valid-type]
        damped: wp.array2d(dtype=float),  # type: ignore[valid-type]
        moved: wp.array2d(dtype=float),  # type: ignore[valid-type]
        smooth: wp.array2d(dtype=float),  # type: ignore[valid-type]
        held: wp.array2d(dtype=float),  # type: ignore[valid-type]
        where: wp.array(dtype=int),  # type: ignore[valid-type]
        stops: wp.array(dtype=int),  # type: ignore[valid-type]
        paths: wp.array(dtype=int),  # type: ignore[valid-type]
        centre: wp.array2d(dtype=wp.vec3),  # type: ignore[valid-type]
        number: wp.array(dtype=int),  # type: ignore[valid-type]
        most: int,
        state: wp.array2d(dtype=int),  # type: ignore[valid-type]
        kind: wp.array2d(dtype=int),  # type: ignore[valid-type]
        id: wp.array2d(dtype=int),  # type: ignore[valid-type]
        mass: wp.array2d(dtype=float),  # type: ignore[valid-type]
        start: wp.array2d(dtype=int),  # type: ignore[valid-type]
        column: wp.array3d(dtype=int),  # type: ignore[valid-type]
        entries: wp.array3d(dtype=float),  # type: ignore[valid-type]
        pairs: wp.array(dtype=wp.vec2i),  # type: ignore[valid-type]
        points: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
        frames: wp.array(dtype=wp.mat33),  # type: ignore[valid-type]
        friction: wp.array(dtype=types.vec5),  # type: ignore[valid-type]
        address: wp.array2d(dtype=int),  # type: ignore[valid-type]
        scratch: wp.array2d(dtype=float),  # type: ignore[valid-type]
        gradient: wp.array2d(dtype=float),  # type: ignore[valid-type]
        solution: wp.array2d(dtype=float),  # type: ignore[valid-type]
        squares: wp.array(dtype=float),  # type: ignore[valid-type]
        decrements: wp.array(dtype=float),  # type: ignore[valid-type]
        steepnesses: wp.array(dtype=float),  # type: ignore[valid-type]
    ): ...

    @wp.kernel(module="unique", enable_backward=False)
    def newton_direction(
        done: wp.array(dtype=bool),  # type: ignore[valid-type]
        changed: wp.array(dtype=int),  # type: ignore[valid-type]
        again: bool,
        step: wp.array(dtype=float),  # type: ignore[valid-type]
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        diagonal: wp.array(dtype=int),  # type: ignore[valid-type]
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        bare: wp.array2d(dtype=float),  # type: ignore[valid-type]
        damped: wp.array2d(dtype=float),  # type: ignore[valid-type]
        moved: wp.array2d(dtype=float),  # type: ignore[valid-type]
        smooth: wp.array2d(dtype=float),  # type: ignore[valid-type]
        held: wp.array2d(dtype=float),  # type: ignore[valid-type]
        where: wp.array(dtype=int),  # type: ignore[valid-type]
        stops: wp.array(dtype=int),  # type: ignore[valid-type]
        paths: wp.array(dtype=int),  # type: ignore[valid-type]
        centre: wp.array2d(dtype=wp.vec3),  # type: ignore[valid-type]
        number: wp.array(dtype=int),  # type: ignore[valid-type]
        most: int,
        state: wp.array2d(dtype=int),  # type: ignore[valid-type]
        kind: wp.array2d(dtype=int),  # type: ignore[valid-type]
        id: wp.array2d(dtype=int),  # type: ignore[valid-type]
        mass: wp.array2d(dtype=float),  # type: ignore[valid-type]
        start: wp.array2d(dtype=int),  # type: ignore[valid-type]
        column: wp.array3d(dtype=int),  # type: ignore[valid-type]
        entries: wp.array3d(dtype=float),  # type: ignore[valid-type]
        pairs: wp.array(dtype=wp.vec2i),  # type: ignore[valid-type]
        points: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
        frames: wp.array(dtype=wp.mat33),  # type: ignore[valid-type]
        friction: wp.array(dtype=types.vec5),  # type: ignore[valid-type]
        address: wp.array2d(dtype=int),  # type: ignore[valid-type]
        scratch: wp.array2d(dtype=float),  # type: ignore[valid-type]
        gradient: wp.array2d(dtype=float),  # type: ignore[valid-type]
        solution: wp.array2d(dtype=float),  # type: ignore[valid-type]
        squares: wp.array(dtype=float),  # type: ignore[valid-type]
        decrements: wp.array(dtype=float),  # type: ignore[valid-type]
        steepnesses: wp.array(dtype=float),  # type: ignore[valid-type]
        scales: wp.array(dtype=float),  # type: ignore[valid-type]
        unchanged: wp.array(dtype=bool),  # type: ignore[valid-type]
    ):
        w, lane = wp.tid()
        same = again and changed[w] == 0
        if lane == 0:
            unchanged[w] = same or (again and done[w])
        if done[w]:
            return
        if same:
            # The cost was a parabola along the whole step: the gradient is as it was but for its
            # length, of which the step took its share, and so is the direction.
            if lane == 0:
                scale = scales[w]
                left = scale - step[w]
                share = wp.where(scale != 0.0, left / scale, 0.0)
                decrements[w] = decrements[w] * share * share
                steepnesses[w] = steepnesses[w] * share * share
                scales[w] = left
            return
        if lane == 0:
            scales[w] = 1.0
        lanes = wp.block_dim()
        solve_trees(
            w, lane, lanes, table, begin, levels, diagonal, inertia, axis, armature, bare, damped,
            moved, smooth, held, where, stops, paths, centre, number, most, state, kind, id, mass,
            start, column, entries, pairs, points, frames, friction, address, scratch, gradient,
            solution, squares, decrements, steepnesses,
        )  # fmt: skip

    return newton_direction


def _text(bodies: int, dofs: int, newton: bool = False) -> str:
    """The native code for a model's sizes."""
    text = Template(_SOLVE).substitute(
        constraints=_CONSTRAINTS if newton else "",
        coupling=_COUPLING if newton else "",
        right=_NEWTON_RIGHT.strip() if newton else _PLAIN_RIGHT,
        output=_NEWTON_OUTPUT if newton else _PLAIN_OUTPUT,
    )
    names = {
        "BODIES": bodies,
        "DOFS": dofs,
        "COUPLED": COUPLED,
        "QUADRATIC": int(types.ConstraintState.QUADRATIC),
        "LIMIT": int(types.ConstraintType.LIMIT_JOINT),
        "PYRAMID": int(types.ConstraintType.CONTACT_PYRAMIDAL),
    }
    return _fill(text, names)


def _fill(text: str, names: dict[str, int]) -> str:
    """The text with numbers in the place of names."""
    return re.sub("|".join(rf"\b{name}\b" for name in names), lambda f: str(names[f[0]]), text)
