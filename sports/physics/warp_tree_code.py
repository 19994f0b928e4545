"""Native code for ``sports/physics/warp_tree.py``: for a GPU and, a thread a world, for a CPU.

A row of the table of bodies is ``warp_tree.COLUMNS``. A symmetric matrix of a body (6, 6) is kept
as its upper triangle, row by row (``AT``), of n coupled rows as the lower one (``ROW``). Spatial
vectors are MuJoCo's: rotation first, about the centre of mass of the tree.
"""

from __future__ import annotations

import re
from string import Template

from mujoco_warp._src import types

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
    const int* rows = table.data;
    for (int e = lane; e < BODIES * 27; e += lanes)
        slot[e] = 0.0f;
    for (int k = lane; k < DOFS; k += lanes) {
        along[k * 7 + 6] = rotors[k];
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

_PLAIN_RIGHT = """
        const int entry = diagonal.data[k];
        const char* after = (const char*)damped.data + world * damped.strides[0];
        const char* before = (const char*)bare.data + world * bare.strides[0];
        along[k * 7 + 6] += ((const float*)after)[entry] - ((const float*)before)[entry];
        push[k] = ((const float*)((const char*)right.data + world * right.strides[0]))[k];
"""

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


def solution(bodies: int, dofs: int) -> str:
    """``(M + B) x = y`` with a diagonal B, of models with so many bodies that move and degrees of
    freedom."""
    text = Template(_SOLVE).substitute(
        constraints="", coupling="", right=_PLAIN_RIGHT.strip(), output=_PLAIN_OUTPUT
    )
    return _fill(text, {"BODIES": bodies, "DOFS": dofs})


def direction(bodies: int, dofs: int, coupled: int) -> str:
    """Newton's direction, with room for so many coupled rows."""
    text = Template(_SOLVE).substitute(
        constraints=_CONSTRAINTS,
        coupling=_COUPLING,
        right=_NEWTON_RIGHT.strip(),
        output=_NEWTON_OUTPUT,
    )
    names = {
        "BODIES": bodies,
        "DOFS": dofs,
        "COUPLED": coupled,
        "QUADRATIC": int(types.ConstraintState.QUADRATIC),
        "LIMIT": int(types.ConstraintType.LIMIT_JOINT),
        "PYRAMID": int(types.ConstraintType.CONTACT_PYRAMIDAL),
    }
    return _fill(text, names)


def product(bodies: int) -> str:
    """``M x``."""
    return _fill(_MULTIPLY, {"BODIES": bodies})


def _fill(text: str, names: dict[str, int]) -> str:
    """The text with numbers in the place of names."""
    return re.sub("|".join(rf"\b{name}\b" for name in names), lambda f: str(names[f[0]]), text)
