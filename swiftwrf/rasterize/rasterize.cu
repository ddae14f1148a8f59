// Sum of complex 2D Gaussians on an angular grid that is periodic in azimuth: forward and backward, for many positions at
// once. No headers and no templates, so that NVRTC compiles it as it is; a test compiles it for the CPU.
//
//   A(az, el) = sum_n weight_n exp(-1/2 |L_n^-1 d_n|^2),   L = [[l1, 0], [l2, l3]],   d = (az - az_n wrapped, el - el_n)
//
// evaluated as 2^-(u^2 + v^2) with (u, v) = sqrt(log2(e) / 2) L^-1 d: no determinant is formed, the exponent is never
// positive, and one instruction of the GPU gives the power. Distances are in pixels.
//
// Nothing depends on the order in which threads run: every pixel adds its primitives in an order that follows from them
// alone, every gradient is summed by one group of threads in a fixed order, and positions do not know of each other. Hence
// the bits are the same every time and for any batch.
//
// Tests for what is out of reach are written `!(distance > reach)`, so that a mean that is not a number is drawn and seen.

constexpr unsigned WARP = 0xffffffffu;  // all of its threads take part
constexpr int LANES = 32, WARPS = 8;    // of a warp, of a block
constexpr int THREADS = WARPS * LANES;  // of a block

// pixel = angle * scale - start. Both factors are split into a float and the rest, because one float would lose the fraction
// of a pixel: `start` is a multiple of 1/2, so that it can be moved by whole pixels without rounding.
struct Axis {
    float scale, scale_rest, start, start_rest;
};

struct Grid {
    Axis azimuth, elevation;
    int n_azimuth, n_elevation;
};

// Kernel values below 2^least count as 0; `reach` is how many standard deviations that is.
struct Cutoff {
    float least, reach;
};

// An angle in pixels: the nearest pixel (a whole number) and how far beyond it.
struct Place {
    float pixel, beyond;
};

// u = s1 dx, v = s3 dy + s21 dx
struct Whitening {
    float s1, s21, s3;
};

__device__ __forceinline__ Place locate(float angle, const Axis& axis) {
    Place place;
    place.pixel = rintf(fmaf(angle, axis.scale, -axis.start));
    // the product is exact inside fmaf, so what is left is rounded relative to itself and not to the pixel's number
    place.beyond = fmaf(angle, axis.scale, -(axis.start + place.pixel)) + fmaf(angle, axis.scale_rest, -axis.start_rest);
    return place;
}

// A distance in columns, brought to at most half a turn. Adding and subtracting 1.5 * 2^23 rounds to a whole number
// without the conversion unit, which the exponentials keep busy.
__device__ __forceinline__ float wrapped(float columns, float turn, float turns_per_column) {
    const float shift = 12582912.0f;
    return fmaf(-turn, fmaf(columns, turns_per_column, shift) - shift, columns);
}

// A Cholesky factor in pixels.
__device__ __forceinline__ float3 factor(const float* __restrict__ cholesky, const Grid& grid) {
    return make_float3(
        cholesky[0] * grid.azimuth.scale, cholesky[1] * grid.elevation.scale, cholesky[2] * grid.elevation.scale);
}

__device__ __forceinline__ Whitening whiten(float3 l) {
    const float root = 0.84932180028801907f;  // sqrt(log2(e) / 2)
    Whitening w;
    w.s1 = root / l.x;
    w.s3 = root / l.z;
    w.s21 = -l.y / l.x * w.s3;
    return w;
}

// How far a kernel reaches: its covariance is L L^T.
__device__ __forceinline__ float reach_columns(float3 l, float reach) { return reach * fabsf(l.x); }
__device__ __forceinline__ float reach_rows(float3 l, float reach) { return reach * sqrtf(l.y * l.y + l.z * l.z); }

// ------------------------------------------------------------------------------------------------------------------ reach
//
// The grid is cut into tiles of 16 x 8 pixels. A primitive reaches a tile if it reaches the tile's columns and its rows, so
// one bit for each primitive and each strip of tiles (first the strips of columns, then those of rows) says everything.

constexpr int TILE_COLUMNS = 16, TILE_ROWS = 8;

__device__ __forceinline__ int tiles_across(const Grid& grid) { return (grid.n_azimuth + TILE_COLUMNS - 1) / TILE_COLUMNS; }
__device__ __forceinline__ int tiles_down(const Grid& grid) { return (grid.n_elevation + TILE_ROWS - 1) / TILE_ROWS; }

// One warp for 32 primitives of one position.
extern "C" __global__ void __launch_bounds__(THREADS) find_reach(
    const float2* __restrict__ mean,     // (B, N) azimuth, elevation [rad]
    const float* __restrict__ cholesky,  // (N, 3) or (B, N, 3) [rad]
    unsigned* __restrict__ reached,      // (B, strips, words): bit i % 32 of word i / 32 is primitive i
    int n, int cholesky_per_position, Grid grid, Cutoff cutoff) {
    const int words = (n + LANES - 1) / LANES, blocks = (words + WARPS - 1) / WARPS;
    const int position = blockIdx.x / blocks, word = blockIdx.x % blocks * WARPS + threadIdx.x / LANES;
    const int lane = threadIdx.x % LANES, i = word * LANES + lane;
    if (word >= words) return;

    Place azimuth = {}, elevation = {};
    float columns = -1e30f, rows = 0.0f;  // beyond the last primitive: reaches nothing
    if (i < n) {
        const size_t at = static_cast<size_t>(position) * n + i;
        const float3 l = factor(cholesky + 3 * (cholesky_per_position ? at : i), grid);
        azimuth = locate(mean[at].x, grid.azimuth);
        elevation = locate(mean[at].y, grid.elevation);
        columns = reach_columns(l, cutoff.reach);
        rows = reach_rows(l, cutoff.reach);
    }
    const float turn = grid.n_azimuth, turns_per_column = 1.0f / turn;
    const int across = tiles_across(grid), down = tiles_down(grid);
    unsigned* out = reached + static_cast<size_t>(position) * (across + down) * words + word;
    for (int strip = 0; strip < across; ++strip, out += words) {
        const float centre = strip * TILE_COLUMNS + 0.5f * (TILE_COLUMNS - 1);
        const float dx = wrapped(azimuth.pixel - centre, turn, turns_per_column) + azimuth.beyond;
        const unsigned reach = __ballot_sync(WARP, !(fabsf(dx) > columns + 0.5f * (TILE_COLUMNS - 1)));
        if (lane == 0) *out = reach;
    }
    for (int strip = 0; strip < down; ++strip, out += words) {
        const float dy = elevation.pixel - (strip * TILE_ROWS + 0.5f * (TILE_ROWS - 1)) + elevation.beyond;
        const unsigned reach = __ballot_sync(WARP, !(fabsf(dy) > rows + 0.5f * (TILE_ROWS - 1)));
        if (lane == 0) *out = reach;
    }
}

// ---------------------------------------------------------------------------------------------------------------- forward
//
// A warp draws a tile, each of its threads four pixels of one column. It goes through the bits, collects the primitives that
// reach the tile, and draws them 32 at a time: each thread prepares one of them, then all draw all 32. The order in which
// primitives are collected follows from the bits alone.

constexpr int ROW_STEP = LANES / TILE_COLUMNS;  // rows between two pixels of a thread
constexpr int PIXELS = TILE_ROWS / ROW_STEP;    // of a thread

extern "C" __global__ void __launch_bounds__(THREADS, 5) rasterize(
    const float2* __restrict__ mean,       // (B, N) azimuth, elevation [rad]
    const float* __restrict__ cholesky,    // (N, 3) or (B, N, 3) [rad]
    const float2* __restrict__ weight,     // (B, N) real and imaginary part
    const unsigned* __restrict__ reached,  // (B, strips, words), from find_reach
    float* __restrict__ field,             // (B, 2, n_elevation, n_azimuth): A; with `magnitude` A / |A|, 0 where A is 0
    float* __restrict__ magnitude,         // (B, n_elevation, n_azimuth): |A|; either may be null
    unsigned n_positions, int n, int cholesky_per_position, Grid grid, Cutoff cutoff) {
    __shared__ int s_collected[WARPS][2 * LANES];   // indices: fewer than 32 wait while up to 32 come
    __shared__ float4 s_prepared[WARPS][LANES][2];  // u at the tile's centre, s1, v there, s21; s3, weight, column

    const int warp = threadIdx.x / LANES, lane = threadIdx.x % LANES;
    const int across = tiles_across(grid), down = tiles_down(grid);
    const unsigned task = blockIdx.x * WARPS + warp;
    const unsigned position = task / (across * down);
    const int tile = task % (across * down);
    if (position >= n_positions) return;
    const int tile_column = tile % across * TILE_COLUMNS, tile_row = tile / across * TILE_ROWS;
    const float centre_column = tile_column + 0.5f * (TILE_COLUMNS - 1), centre_row = tile_row + 0.5f * (TILE_ROWS - 1);
    const float x = lane % TILE_COLUMNS - 0.5f * (TILE_COLUMNS - 1), y = lane / TILE_COLUMNS - 0.5f * (TILE_ROWS - 1);
    const float turn = grid.n_azimuth, turns_per_column = 1.0f / turn;
    const size_t first = static_cast<size_t>(position) * n, first_factor = cholesky_per_position ? first : 0;
    const int words = (n + LANES - 1) / LANES;
    const unsigned* strips = reached + static_cast<size_t>(position) * (across + down) * words;
    const unsigned* by_column = strips + static_cast<size_t>(tile % across) * words;
    const unsigned* by_row = strips + static_cast<size_t>(across + tile / across) * words;

    float re[PIXELS] = {}, im[PIXELS] = {};
    int begin = 0, waiting = 0, count;
    unsigned left = 0;  // of the 32 primitives of the thread's word, those not given yet
    do {
        // Collect at least 32, or what is left: every thread that has primitives left gives one.
        while (waiting < LANES) {
            const unsigned giving = __ballot_sync(WARP, left != 0);
            if (giving) {
                const int slot = waiting + __popc(giving & ((1u << lane) - 1));
                if (left) s_collected[warp][slot] = (begin - LANES + lane) * LANES + __ffs(left) - 1;
                left &= left - 1;
                waiting += __popc(giving);
            } else if (begin < words) {
                left = begin + lane < words ? by_column[begin + lane] & by_row[begin + lane] : 0;
                begin += LANES;
            } else {
                break;
            }
        }
        count = min(waiting, LANES);
        __syncwarp();

        // Prepare: each thread one.
        bool wide = false;
        if (lane < count) {
            const size_t i = s_collected[warp][lane];
            const float2 angles = mean[first + i], psi = weight[first + i];
            const float3 l = factor(cholesky + 3 * (first_factor + i), grid);
            const Place azimuth = locate(angles.x, grid.azimuth), elevation = locate(angles.y, grid.elevation);
            const Whitening w = whiten(l);
            const float dx = wrapped(azimuth.pixel - centre_column, turn, turns_per_column) + azimuth.beyond;
            const float dy = elevation.pixel - centre_row + elevation.beyond;
            s_prepared[warp][lane][0] = make_float4(-w.s1 * dx, w.s1, fmaf(-w.s3, dy, -w.s21 * dx), w.s21);
            s_prepared[warp][lane][1] = make_float4(w.s3, psi.x, psi.y, dx);
            wide = !(reach_columns(l, cutoff.reach) < 0.5f * (turn - TILE_COLUMNS));
        }
        // a tile may see a wide primitive from both directions
        const bool any_wide = __ballot_sync(WARP, wide);
        __syncwarp();

        // Draw all of them.
#pragma unroll 1
        for (int j = 0; j < count; ++j) {
            const float4 c = s_prepared[warp][j][0], r = s_prepared[warp][j][1];
            float u = fmaf(c.y, x, c.x), v = fmaf(r.x, y, fmaf(c.w, x, c.z));
            if (any_wide) {
                const float dx = x - r.w, turned = wrapped(dx, turn, turns_per_column) - dx;
                u = fmaf(c.y, turned, u);
                v = fmaf(c.w, turned, v);
            }
#pragma unroll
            for (int k = 0; k < PIXELS; ++k) {
                const float v_k = k ? fmaf(r.x, static_cast<float>(k * ROW_STEP), v) : v;
                const float exponent = fmaf(-v_k, v_k, -u * u);
                if (!(exponent < cutoff.least)) {
                    const float kernel = exp2f(exponent);
                    re[k] = fmaf(r.y, kernel, re[k]);
                    im[k] = fmaf(r.z, kernel, im[k]);
                }
            }
        }
        waiting -= count;
        if (lane < waiting) s_collected[warp][lane] = s_collected[warp][LANES + lane];
        __syncwarp();
    } while (count == LANES);

    const size_t plane = static_cast<size_t>(grid.n_elevation) * grid.n_azimuth;
    const int column = tile_column + lane % TILE_COLUMNS, row = tile_row + lane / TILE_COLUMNS;
    const size_t pixel = static_cast<size_t>(row) * grid.n_azimuth + column;
#pragma unroll
    for (int k = 0; k < PIXELS; ++k) {
        if (row + k * ROW_STEP < grid.n_elevation && column < grid.n_azimuth) {
            const size_t at = pixel + static_cast<size_t>(k) * ROW_STEP * grid.n_azimuth;
            float unit = 1.0f;  // what the field is divided by
            if (magnitude) {
                const float length = hypotf(re[k], im[k]);
                magnitude[plane * position + at] = length;
                unit = length == 0.0f ? 1.0f : length;
            }
            if (field) {
                field[2 * plane * position + at] = re[k] / unit;
                field[2 * plane * position + plane + at] = im[k] / unit;
            }
        }
    }
}

// --------------------------------------------------------------------------------------------------------------- backward
//
// A group of 8, 16 or 32 threads gathers the gradient of one primitive at one position: it walks the box around the
// footprint, columns over the threads, rows in a loop. With z the kernel times the derivative by it, the sums over the
// footprint of z u, z v, z u^2, z u v, z v^2 give the gradients of mean and factor; u is constant in a column.

__device__ __forceinline__ void gather(
    const float* __restrict__ grad, const float* __restrict__ phase,
    const float2* __restrict__ mean, const float* __restrict__ cholesky, const float2* __restrict__ weight,
    float2* __restrict__ d_mean, float* __restrict__ d_cholesky, float2* __restrict__ d_weight,
    int n, int group, int cholesky_per_position, const Grid& grid, const Cutoff& cutoff) {
    const int groups = THREADS / group, member = threadIdx.x % group;
    const int blocks = (n + groups - 1) / groups;  // for a position
    const int position = blockIdx.x / blocks, primitive = blockIdx.x % blocks * groups + threadIdx.x / group;
    const size_t i = static_cast<size_t>(position) * n + primitive;

    float3 l = make_float3(1.0f, 0.0f, 1.0f);
    float d_re = 0, d_im = 0, z_u = 0, z_v = 0, z_uu = 0, z_uv = 0, z_vv = 0;
    if (primitive < n) {
        l = factor(cholesky + 3 * (cholesky_per_position ? i : primitive), grid);
        const Whitening w = whiten(l);
        const Place azimuth = locate(mean[i].x, grid.azimuth), elevation = locate(mean[i].y, grid.elevation);
        const float2 psi = weight[i];
        const int plane = grid.n_elevation * grid.n_azimuth;
        // the gradient by A = re + j im, itself or as the gradient by |A| times A / |A|
        grad += static_cast<size_t>(phase ? 1 : 2) * plane * position;
        if (phase) phase += static_cast<size_t>(2) * plane * position;

        // columns counted from the mean's, at most one turn; rows clipped to the grid
        const float turn = grid.n_azimuth;
        const float columns = fminf(reach_columns(l, cutoff.reach), 0.5f * turn), rows = reach_rows(l, cutoff.reach);
        const int first_column = static_cast<int>(ceilf(azimuth.beyond - columns));
        const int last_column =
            min(static_cast<int>(floorf(azimuth.beyond + columns)), first_column + grid.n_azimuth - 1);
        const int first_row =
            static_cast<int>(fminf(fmaxf(elevation.pixel + ceilf(elevation.beyond - rows), 0.0f), 1.0f * grid.n_elevation));
        const int last_row = static_cast<int>(
            fmaxf(fminf(elevation.pixel + floorf(elevation.beyond + rows), grid.n_elevation - 1.0f), -1.0f));

        int c = static_cast<int>(azimuth.pixel - turn * floorf(azimuth.pixel / turn)) + first_column + member;
        c %= grid.n_azimuth;
        c += c < 0 ? grid.n_azimuth : 0;
        for (int column = first_column + member; column <= last_column; column += group) {
            const float dx = column - azimuth.beyond;
            const float u = w.s1 * dx, v_x = w.s21 * dx;
            float dy = first_row - elevation.pixel - elevation.beyond;
            float s_0 = 0, s_1 = 0, s_2 = 0;  // sums over the column of z, z v, z v^2
            int at = first_row * grid.n_azimuth + c;
#pragma unroll 2
            for (int row = first_row; row <= last_row; ++row) {
                const float g_re = phase ? grad[at] * phase[at] : grad[at];
                const float g_im = phase ? grad[at] * phase[at + plane] : grad[at + plane];
                const float v = fmaf(w.s3, dy, v_x);
                const float exponent = fmaf(-v, v, -u * u);
                if (!(exponent < cutoff.least)) {
                    const float kernel = exp2f(exponent);
                    const float z = kernel * fmaf(psi.x, g_re, psi.y * g_im);
                    const float z_times_v = z * v;
                    d_re = fmaf(kernel, g_re, d_re);
                    d_im = fmaf(kernel, g_im, d_im);
                    s_0 += z;
                    s_1 += z_times_v;
                    s_2 = fmaf(z_times_v, v, s_2);
                }
                dy += 1.0f;
                at += grid.n_azimuth;
            }
            z_u = fmaf(u, s_0, z_u);
            z_v += s_1;
            z_uu = fmaf(u * u, s_0, z_uu);
            z_uv = fmaf(u, s_1, z_uv);
            z_vv += s_2;
            c += group;
            while (c >= grid.n_azimuth) c -= grid.n_azimuth;
        }
    }

    for (int s = group / 2; s; s /= 2) {
        d_re += __shfl_xor_sync(WARP, d_re, s);
        d_im += __shfl_xor_sync(WARP, d_im, s);
        z_u += __shfl_xor_sync(WARP, z_u, s);
        z_v += __shfl_xor_sync(WARP, z_v, s);
        z_uu += __shfl_xor_sync(WARP, z_uu, s);
        z_uv += __shfl_xor_sync(WARP, z_uv, s);
        z_vv += __shfl_xor_sync(WARP, z_vv, s);
    }
    if (primitive < n && member == 0) {
        // sums of first and second order in (u, v), in standard deviations: times sqrt(2 ln 2) and 2 ln 2
        const float first = 1.1774100225154747f, second = 1.3862943611198906f;
        const float u_x = grid.azimuth.scale / l.x, v_x = -l.y * u_x / l.z, v_y = grid.elevation.scale / l.z;  // per radian
        d_weight[i] = make_float2(d_re, d_im);
        d_mean[i] = make_float2(first * (u_x * z_u + v_x * z_v), first * v_y * z_v);
        d_cholesky[3 * i] = second * (u_x * z_uu + v_x * z_uv);
        d_cholesky[3 * i + 1] = second * v_y * z_uv;
        d_cholesky[3 * i + 2] = second * v_y * z_vv;
    }
}

extern "C" __global__ void __launch_bounds__(THREADS, 4) rasterize_backward(
    const float* __restrict__ grad,      // (B, 2, n_elevation, n_azimuth), by A
    const float2* __restrict__ mean,     // (B, N)
    const float* __restrict__ cholesky,  // (N, 3) or (B, N, 3)
    const float2* __restrict__ weight,   // (B, N)
    float2* __restrict__ d_mean,         // (B, N)
    float* __restrict__ d_cholesky,      // (B, N, 3)
    float2* __restrict__ d_weight,       // (B, N)
    int n, int group, int cholesky_per_position, Grid grid, Cutoff cutoff) {
    gather(grad, nullptr, mean, cholesky, weight, d_mean, d_cholesky, d_weight, n, group, cholesky_per_position, grid, cutoff);
}

extern "C" __global__ void __launch_bounds__(THREADS, 4) magnitude_backward(
    const float* __restrict__ grad,      // (B, n_elevation, n_azimuth), by |A|
    const float* __restrict__ phase,     // (B, 2, n_elevation, n_azimuth): A / |A|, 0 where A is 0
    const float2* __restrict__ mean,     // (B, N)
    const float* __restrict__ cholesky,  // (N, 3) or (B, N, 3)
    const float2* __restrict__ weight,   // (B, N)
    float2* __restrict__ d_mean,         // (B, N)
    float* __restrict__ d_cholesky,      // (B, N, 3)
    float2* __restrict__ d_weight,       // (B, N)
    int n, int group, int cholesky_per_position, Grid grid, Cutoff cutoff) {
    gather(grad, phase, mean, cholesky, weight, d_mean, d_cholesky, d_weight, n, group, cholesky_per_position, grid, cutoff);
}
