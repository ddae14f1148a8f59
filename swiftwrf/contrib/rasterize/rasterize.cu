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

// How many whole turns a distance in columns is away from at most half a turn. Adding and subtracting 1.5 * 2^23 rounds
// without the conversion unit, which the exponentials keep busy.
__device__ __forceinline__ float whole_turns(float columns, float turns_per_column) {
    const float shift = 12582912.0f;
    return fmaf(columns, turns_per_column, shift) - shift;
}

__device__ __forceinline__ float wrapped(float columns, float turn, float turns_per_column) {
    return fmaf(-turn, whole_turns(columns, turns_per_column), columns);
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
// reach the tile, and draws them 32 at a time: each thread prepares one of them and leaves it out if only the box around it
// reaches the tile, then all draw all that are left. The order in which primitives are collected follows from the bits alone.

constexpr int ROW_STEP = LANES / TILE_COLUMNS;  // rows between two pixels of a thread
constexpr int PIXELS = TILE_ROWS / ROW_STEP;    // of a thread
constexpr float HALF_COLUMNS = 0.5f * (TILE_COLUMNS - 1), HALF_ROWS = 0.5f * (TILE_ROWS - 1);  // from the centre to the last

// Adds `count` prepared primitives to the pixels of a thread, of which the first is (x, y) from the tile's centre.
__device__ __forceinline__ void draw(
    const float4 (*prepared)[2], int count, const bool any_wide, float x, float y, float turn, float least, float* re,
    float* im) {
#pragma unroll 2
    for (int j = 0; j < count; ++j) {
        const float4 c = prepared[j][0], r = prepared[j][1];
        float u = fmaf(c.y, x, c.x), v = fmaf(r.x, y, fmaf(c.w, x, c.z));
        if (any_wide) {
            const float dx = x - r.w, turned = wrapped(dx, turn, 1.0f / turn) - dx;
            u = fmaf(c.y, turned, u);
            v = fmaf(c.w, turned, v);
        }
#pragma unroll
        for (int k = 0; k < PIXELS; ++k) {
            const float v_k = k ? fmaf(r.x, static_cast<float>(k * ROW_STEP), v) : v;
            const float exponent = fmaf(-v_k, v_k, -u * u);
            if (!(exponent < least)) {
                const float kernel = exp2f(exponent);
                re[k] = fmaf(r.y, kernel, re[k]);
                im[k] = fmaf(r.z, kernel, im[k]);
            }
        }
    }
}

extern "C" __global__ void __launch_bounds__(THREADS, 5) rasterize(
    const float2* __restrict__ mean,       // (B, N) azimuth, elevation [rad]
    const float* __restrict__ cholesky,    // (N, 3) or (B, N, 3) [rad]
    const float2* __restrict__ weight,     // (B, N) real and imaginary part
    const unsigned* __restrict__ reached,  // (B, strips, words), from find_reach
    float* __restrict__ field,             // (B, 2, n_elevation, n_azimuth): A; with `magnitude` A / |A|, 0 where A is 0
    float* __restrict__ magnitude,         // (B, n_elevation, n_azimuth): |A|; one of both may be null
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

        // Prepare: each thread one. Between the tile's corners u and v lie in intervals, and no kernel is larger than their
        // least magnitudes allow; the slack is for rounding.
        bool kept = false, wide = false;
        float4 near = {}, rest = {};
        if (lane < count) {
            const size_t i = s_collected[warp][lane];
            const float2 angles = mean[first + i], psi = weight[first + i];
            const float3 l = factor(cholesky + 3 * (first_factor + i), grid);
            const Place azimuth = locate(angles.x, grid.azimuth), elevation = locate(angles.y, grid.elevation);
            const Whitening w = whiten(l);
            const float dx = wrapped(azimuth.pixel - centre_column, turn, turns_per_column) + azimuth.beyond;
            const float dy = elevation.pixel - centre_row + elevation.beyond;
            near = make_float4(-w.s1 * dx, w.s1, fmaf(-w.s3, dy, -w.s21 * dx), w.s21);
            rest = make_float4(w.s3, psi.x, psi.y, dx);
            const float u = fmaxf(fabsf(near.x) - HALF_COLUMNS * fabsf(w.s1), 0.0f);
            const float v = fmaxf(fabsf(near.z) - HALF_COLUMNS * fabsf(w.s21) - HALF_ROWS * fabsf(w.s3), 0.0f);
            wide = !(reach_columns(l, cutoff.reach) < 0.5f * (turn - TILE_COLUMNS));
            kept = wide || !(fmaf(u, u, v * v) > -1.001f * cutoff.least);
        }
        const unsigned keeping = __ballot_sync(WARP, kept);
        if (kept) {
            const int slot = __popc(keeping & ((1u << lane) - 1));
            s_prepared[warp][slot][0] = near;
            s_prepared[warp][slot][1] = rest;
        }
        // a tile may see a wide primitive from both directions
        const bool any_wide = __ballot_sync(WARP, wide);
        __syncwarp();

        if (any_wide) {
            draw(s_prepared[warp], __popc(keeping), true, x, y, turn, cutoff.least, re, im);
        } else {
            draw(s_prepared[warp], __popc(keeping), false, x, y, turn, cutoff.least, re, im);
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
// A block gathers the gradients of some primitives of one position, a thread those of one. The block goes over the grid in
// patches, of which it keeps the incoming gradient in shared memory. A warp lists the columns of the patch that its primitives
// reach, and each of its threads sums over one of them at a time, whatever primitive it belongs to. Sums of neighbouring
// threads for the same primitive are then added and given to the primitive's own thread.
//
// With z the kernel times the derivative by it, the sums over the footprint of z u, z v, z u^2, z u v, z v^2 give the
// gradients of mean and factor; u is constant in a column.

constexpr int PATCH_COLUMNS = LANES, PATCH_ROWS = 96;  // one row after the other, so that columns have banks of their own
constexpr int GATHERING_WARPS = 16, GATHERING_THREADS = GATHERING_WARPS * LANES;  // of a block, at most
constexpr int ROWS_AT_ONCE = 4, SUMS = 7;

// What a thread needs to know of a primitive.
struct Prepared {
    Whitening whitening;
    float rows_per_v;
    Place azimuth, elevation;
    float2 weight;
};

extern "C" __global__ void __launch_bounds__(GATHERING_THREADS, 2) rasterize_backward(
    const float* __restrict__ grad,      // (B, 2, n_elevation, n_azimuth), by A; by |A| without the 2 where `phase` is given
    const float* __restrict__ phase,     // (B, 2, n_elevation, n_azimuth): A / |A|, or null
    const float2* __restrict__ mean,     // (B, N)
    const float* __restrict__ cholesky,  // (N, 3) or (B, N, 3)
    const float2* __restrict__ weight,   // (B, N)
    float2* __restrict__ d_mean,         // (B, N)
    float* __restrict__ d_cholesky,      // (B, N, 3)
    float2* __restrict__ d_weight,       // (B, N)
    int n, int per_warp, int cholesky_per_position, Grid grid, Cutoff cutoff) {
    __shared__ float2 s_grad[PATCH_ROWS + ROWS_AT_ONCE - 1][PATCH_COLUMNS];  // by the real and by the imaginary part
    __shared__ Prepared s_prepared[GATHERING_WARPS][LANES];

    const int warps = blockDim.x / LANES, warp = threadIdx.x / LANES, lane = threadIdx.x % LANES;
    const int per_block = warps * per_warp, blocks = (n + per_block - 1) / per_block;  // for a position
    const int position = blockIdx.x / blocks;
    const int primitive = blockIdx.x % blocks * per_block + warp * per_warp + lane;
    const bool mine = lane < per_warp && primitive < n;
    const size_t i = static_cast<size_t>(position) * n + primitive;
    cholesky += 3 * (cholesky_per_position ? i : primitive);
    const int plane = grid.n_elevation * grid.n_azimuth;
    grad += static_cast<size_t>(phase ? 1 : 2) * plane * position;
    if (phase) phase += static_cast<size_t>(2) * plane * position;

    float columns = -1e30f, rows = -1e30f;  // how far the thread's primitive reaches
    if (mine) {
        const float3 l = factor(cholesky, grid);
        columns = reach_columns(l, cutoff.reach);
        rows = reach_rows(l, cutoff.reach);
        const Whitening w = whiten(l);
        s_prepared[warp][lane] = {
            w, 1.0f / w.s3, locate(mean[i].x, grid.azimuth), locate(mean[i].y, grid.elevation), weight[i]};
    }
    __syncwarp();
    const float turn = grid.n_azimuth, turns_per_column = 1.0f / turn;
    // a patch may see a wide primitive from both directions
    const bool wide = !(columns < 0.5f * (turn - PATCH_COLUMNS) - 1.0f);

    float sum[SUMS] = {};
    for (int patch_row = 0; patch_row < grid.n_elevation; patch_row += PATCH_ROWS)
        for (int patch_column = 0; patch_column < grid.n_azimuth; patch_column += PATCH_COLUMNS) {
            // List the columns: the thread's primitive has those from `begin` to `end` of the warp's list. From here on
            // columns and rows count from the patch's first.
            const int height = min(PATCH_ROWS, grid.n_elevation - patch_row);
            const int width = min(PATCH_COLUMNS, grid.n_azimuth - patch_column);
            int first = 0, begin = 0;
            if (mine) {
                const Place azimuth = s_prepared[warp][lane].azimuth, elevation = s_prepared[warp][lane].elevation;
                const float half = PATCH_COLUMNS / 2, y = elevation.pixel - patch_row + elevation.beyond;
                const float x = wrapped(azimuth.pixel - patch_column - half, turn, turns_per_column) + half;
                int last = width - 1;
                if (!wide) {
                    first = static_cast<int>(fmaxf(x + ceilf(azimuth.beyond - columns), 0.0f));
                    last = static_cast<int>(fminf(x + floorf(azimuth.beyond + columns), width - 1.0f));
                }
                if (!(y + rows < 0.0f) && !(y - rows > height - 1.0f)) begin = max(last - first + 1, 0);
            }
            int end = begin;
            for (int s = 1; s < LANES; s *= 2) {
                const int before = __shfl_up_sync(WARP, end, s);
                if (lane >= s) end += before;
            }
            begin = end - begin;
            const int listed = __shfl_sync(WARP, end, LANES - 1);

            if (!__syncthreads_or(listed)) continue;
#pragma unroll 2
            for (int row = warp; row < height + ROWS_AT_ONCE - 1; row += warps) {
                float2 g = make_float2(0.0f, 0.0f);
                if (lane < width && row < height) {
                    const int at = (patch_row + row) * grid.n_azimuth + patch_column + lane;
                    g = phase ? make_float2(grad[at] * phase[at], grad[at] * phase[at + plane])
                              : make_float2(grad[at], grad[at + plane]);
                }
                s_grad[row][lane] = g;
            }
            __syncthreads();

            for (int from = 0; from < listed; from += LANES) {
                const int entry = from + lane;
                int owner = 0;  // the last primitive whose columns begin here or before
                for (int s = LANES / 2; s; s /= 2)
                    if (__shfl_sync(WARP, begin, owner + s) <= entry) owner += s;
                const int column = entry + __shfl_sync(WARP, first - begin, owner);
                const int segment_end = min(__shfl_sync(WARP, end, owner) - from, LANES);
                const Prepared p = s_prepared[warp][owner];
                const float x = patch_column + column - p.azimuth.pixel, y = p.elevation.pixel - patch_row;  // whole numbers
                const float dx =
                    fmaf(-turn, whole_turns(x - p.azimuth.beyond, turns_per_column), x) - p.azimuth.beyond;
                const float u = p.whitening.s1 * dx, v_x = p.whitening.s21 * dx;

                // rows in which v^2 <= -least - u^2, with slack for rounding; further ones count as 0
                const float middle = p.elevation.beyond - v_x * p.rows_per_v;
                const float reach = 1.001f * sqrtf(fmaxf(-cutoff.least - u * u, 0.0f)) * fabsf(p.rows_per_v);
                const int top = static_cast<int>(fminf(fmaxf(y + ceilf(middle - reach), 0.0f), height));
                const float lowest = entry < listed ? height - 1.0f : -1.0f;
                const int bottom = static_cast<int>(fmaxf(fminf(y + floorf(middle + reach), lowest), -1.0f));
                float re = 0, im = 0, s_1 = 0, s_2 = 0;  // sums of kernel times gradient, z v, z v^2
                float dy = top - y - p.elevation.beyond;
                for (int row = top; row <= bottom; row += ROWS_AT_ONCE) {
                    const float v = fmaf(p.whitening.s3, dy, v_x);
#pragma unroll
                    for (int k = 0; k < ROWS_AT_ONCE; ++k) {
                        const float2 g = s_grad[row + k][column];
                        const float v_k = k ? fmaf(p.whitening.s3, static_cast<float>(k), v) : v;
                        const float exponent = fmaf(-v_k, v_k, -u * u);
                        const float kernel = exponent < cutoff.least ? 0.0f : exp2f(exponent);
                        const float z_v = kernel * fmaf(p.weight.x, g.x, p.weight.y * g.y) * v_k;
                        re = fmaf(kernel, g.x, re);
                        im = fmaf(kernel, g.y, im);
                        s_1 += z_v;
                        s_2 = fmaf(z_v, v_k, s_2);
                    }
                    dy += ROWS_AT_ONCE;
                }
                const float s_0 = fmaf(p.weight.x, re, p.weight.y * im);
                float part[SUMS] = {re, im, u * s_0, s_1, u * u * s_0, u * s_1, s_2};
                for (int s = 1; s < LANES; s *= 2) {
                    const bool same = lane + s < segment_end;
#pragma unroll
                    for (int k = 0; k < SUMS; ++k) {
                        const float other = __shfl_down_sync(WARP, part[k], s);
                        if (same) part[k] += other;
                    }
                }
                const bool given = max(begin, from) < min(end, from + LANES);
                const int segment = min(max(begin - from, 0), LANES - 1);
#pragma unroll
                for (int k = 0; k < SUMS; ++k) {
                    const float whole = __shfl_sync(WARP, part[k], segment);
                    if (given) sum[k] += whole;
                }
            }
        }

    if (mine) {
        // sums of first and second order in (u, v), in standard deviations: times sqrt(2 ln 2) and 2 ln 2
        const float3 l = factor(cholesky, grid);  // again, as there are few registers
        const float one = 1.1774100225154747f, two = 1.3862943611198906f;
        const float u_x = grid.azimuth.scale / l.x, v_x = -l.y * u_x / l.z, v_y = grid.elevation.scale / l.z;  // per radian
        d_weight[i] = make_float2(sum[0], sum[1]);
        d_mean[i] = make_float2(one * (u_x * sum[2] + v_x * sum[3]), one * v_y * sum[3]);
        d_cholesky[3 * i] = two * (u_x * sum[4] + v_x * sum[5]);
        d_cholesky[3 * i + 1] = two * v_y * sum[5];
        d_cholesky[3 * i + 2] = two * v_y * sum[6];
    }
}
