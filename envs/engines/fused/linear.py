# mypy: disable-error-code="empty-body,valid-type"
"""Linear equations of one environment: sum of its constraint rows, Cholesky factorization, and solution.

On a GPU each thread has whole rows of the matrix in its registers, and threads exchange numbers by shuffles. In shared memory,
a factorization would wait at every step. L threads have R rows each, and N = L R is at least the number of rows.
"""

from mjx_dher.system.warp_setup import wp

_ON_A_GPU = """
    const unsigned group = threads == 32 ? ~0u : ((1u << threads) - 1u) << (threadIdx.x & 31 & ~(threads - 1));
    auto run = [&](auto& h, auto& counter) {
        constexpr int R = sizeof(counter), N = sizeof(h) / sizeof(float) / R, L = N / R;
        float b[R], mine[R], inverse[N];
        float gain = 0.0f;
        #pragma unroll
        for (int r = 0; r < R; ++r) {
            const int i = thread + r * L;
            const bool is_row = thread < L && i < n;
            b[r] = is_row ? solution.data[i] : 0.0f;
            #pragma unroll
            for (int j = 0; j < N; ++j) {
                h[r * N + j] = is_row && j <= i ? (summed ? factor : matrix).data[i * (i + 1) / 2 + j] : 0.0f;
            }
        }
        for (int row = 0; row < rows; ++row) {
            const float lacks = residual.data[row];
            if (row < equal || lacks < 0.0f) {
                const float* const j_row = jacobian.data + row * n;
                const float w = weight.data[row], left = w * lacks;
                #pragma unroll
                for (int r = 0; r < R; ++r) {
                    const int i = thread + r * L;
                    mine[r] = thread < L && i < n ? j_row[i] : 0.0f;
                    b[r] -= mine[r] * left;
                    mine[r] *= w;
                }
                if (stiff) {
                    #pragma unroll
                    for (int j = 0; j < N; ++j) {
                        if (j < n) {
                            const float other = j_row[j];
                            #pragma unroll
                            for (int r = 0; r < R; ++r) h[r * N + j] += mine[r] * other;
                        }
                    }
                }
            }
        }
        #pragma unroll
        for (int k = 0; k < N; ++k) {
            if (k < n) {
                const float inv = rsqrtf(fmaxf(__shfl_sync(group, h[k / L * N + k], k % L, threads), 1.0e-20f));
                const float y = inv * __shfl_sync(group, b[k / L], k % L, threads);
                inverse[k] = inv;
                gain += y * y;
                #pragma unroll
                for (int r = 0; r < R; ++r) {
                    const int i = thread + r * L;
                    h[r * N + k] *= inv;
                    b[r] = i == k ? y : i > k ? b[r] - h[r * N + k] * y : b[r];
                }
                #pragma unroll
                for (int j = k + 1; j < N; ++j) {
                    if (j < n) {
                        const float other = __shfl_sync(group, h[j / L * N + k], j % L, threads);
                        #pragma unroll
                        for (int r = 0; r < R; ++r) h[r * N + j] -= h[r * N + k] * other;
                    }
                }
            }
        }
        #pragma unroll
        for (int r = 0; r < R; ++r) {
            const int i = thread + r * L;
            #pragma unroll
            for (int j = 0; j < N; ++j) {
                if (thread < L && i < n && j < i) factor.data[i * (i + 1) / 2 + j] = h[r * N + j];
            }
        }
        __syncwarp(group);
        #pragma unroll
        for (int k = N - 1; k >= 0; --k) {
            if (k < n) {
                const float x = inverse[k] * __shfl_sync(group, b[k / L], k % L, threads);
                #pragma unroll
                for (int r = 0; r < R; ++r) {
                    const int i = thread + r * L;
                    if (thread < L && i < k) b[r] -= factor.data[k * (k + 1) / 2 + i] * x;
                    if (thread < L && i == k) solution.data[i] = x;
                }
            }
        }
        __syncwarp(group);
        return gain;
    };
    char r1[1], r2[2], r4[4], r8[8];
    if (n <= 16) {
        if (threads >= 16) { float h[16]; return run(h, r1); }
        if (threads == 8) { float h[32]; return run(h, r2); }
        float h[64]; return run(h, r4);
    }
    if (threads == 32) { float h[32]; return run(h, r1); }
    if (threads == 16) { float h[64]; return run(h, r2); }
    if (threads == 8) { float h[128]; return run(h, r4); }
    float h[256]; return run(h, r8);
"""
_ON_A_CPU = """
    float gain = 0.0f;
    const auto h = [&](int i, int j) -> float& { return factor.data[i * (i + 1) / 2 + j]; };
    for (int at = 0; at < n * (n + 1) / 2 && !summed; ++at) factor.data[at] = matrix.data[at];
    for (int row = 0; row < rows; ++row) {
        const float lacks = residual.data[row], w = weight.data[row], left = w * lacks;
        if (row < equal || lacks < 0.0f) {
            const float* const j_row = jacobian.data + row * n;
            for (int i = 0; i < n; ++i) {
                solution.data[i] -= j_row[i] * left;
                if (stiff) for (int j = 0; j <= i; ++j) h(i, j) += w * j_row[i] * j_row[j];
            }
        }
    }
    for (int k = 0; k < n; ++k) {
        const float pivot = h(k, k);
        const float inverse = 1.0f / sqrtf(pivot > 1.0e-20f ? pivot : 1.0e-20f);
        h(k, k) = inverse;
        solution.data[k] *= inverse;
        gain += solution.data[k] * solution.data[k];
        for (int i = k + 1; i < n; ++i) {
            h(i, k) *= inverse;
            solution.data[i] -= h(i, k) * solution.data[k];
            for (int j = k + 1; j <= i; ++j) h(i, j) -= h(i, k) * h(j, k);
        }
    }
    for (int k = n - 1; k >= 0; --k) {
        solution.data[k] *= h(k, k);
        for (int i = 0; i < k; ++i) solution.data[i] -= h(k, i) * solution.data[k];
    }
    return gain;
"""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
{_ON_A_GPU}
#else
{_ON_A_CPU}
#endif
""")
def direction(
    matrix: wp.array(dtype=float),
    jacobian: wp.array(dtype=float),
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    factor: wp.array(dtype=float),
    solution: wp.array(dtype=float),
    n: int,
    rows: int,
    equal: int,
    stiff: int,
    summed: int,
    thread: int,
    threads: int,
) -> float:
    """Solves (M + J' D J) x = right - J' D residual, without J' D J if `stiff` is 0.

    D is the weight of rows that act: the first `equal` ones, and those whose residual is below 0.

    Args:
      matrix: lower half of M, row by row, [n * (n + 1) / 2].
      jacobian: J [rows * n].
      weight, residual: [rows].
      factor: like `matrix`, to compute in; if `summed` is 1, it holds M.
      solution: the right side [n], in whose place x is written.

    Returns:
      x' (M + J' D J) x.
    """
