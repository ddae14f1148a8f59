// Enough of CUDA C++ to compile a kernel with a C++ compiler and run it on the CPU, one block after the other: every thread
// of a block is a fiber, and a barrier hands over to the next fiber until all have come. Slow, deterministic, and open to
// the sanitizers.
#pragma once

#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <vector>

#define __global__
#define __device__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __shared__ static  // one block at a time

using std::max;
using std::min;

struct float2 { float x, y; };
struct float3 { float x, y, z; };
struct float4 { float x, y, z, w; };
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float3 make_float3(float x, float y, float z) { return {x, y, z}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

struct Index { unsigned x; };
inline Index threadIdx, blockIdx, blockDim;

namespace shim {

constexpr int LANES = 32;

struct Barrier {
    int size = 0, arrived = 0;
    unsigned generation = 0;
};

struct Fiber {
    ucontext_t context;
    std::vector<char> stack = std::vector<char>(1 << 16);
    bool running = false;
};

inline std::vector<Fiber> fibers;
inline std::vector<Barrier> warps;
inline Barrier block;
inline bool any;  // of the threads' votes
inline std::vector<uint32_t> exchange;  // what each lane shows the others of its warp
inline std::function<void()> body;
inline ucontext_t scheduler;
inline int current;

inline void hand_over() {
    const int me = current;
    swapcontext(&fibers[me].context, &scheduler);
}

inline void wait(Barrier& barrier) {
    if (++barrier.arrived == barrier.size) {
        barrier.arrived = 0;
        ++barrier.generation;
        return;
    }
    for (const unsigned now = barrier.generation; barrier.generation == now;) hand_over();
}

inline void wait_for_warp() { wait(warps[current / LANES]); }

inline void run_fiber() {
    body();
    fibers[current].running = false;
    hand_over();
}

inline void run_block(int threads) {
    fibers.resize(std::max<size_t>(fibers.size(), threads));
    warps.assign((threads + LANES - 1) / LANES, Barrier{LANES});
    block = Barrier{threads};
    blockDim.x = threads;
    exchange.assign(warps.size() * LANES, 0);
    for (int i = 0; i < threads; ++i) {
        Fiber& fiber = fibers[i];
        getcontext(&fiber.context);
        fiber.context.uc_stack.ss_sp = fiber.stack.data();
        fiber.context.uc_stack.ss_size = fiber.stack.size();
        makecontext(&fiber.context, run_fiber, 0);
        fiber.running = true;
    }
    // up and down, so that a thread that relies on another one without a barrier sees it too late or too early
    bool any = true;
    for (int pass = 0; any; ++pass) {
        any = false;
        for (int i = 0; i < threads; ++i) {
            current = pass % 2 ? threads - 1 - i : i;
            if (!fibers[current].running) continue;
            any = true;
            threadIdx.x = current;
            swapcontext(&scheduler, &fibers[current].context);
        }
    }
}

template <class T>
T from_lane(T value, int lane) {
    static_assert(sizeof(T) == sizeof(uint32_t));
    uint32_t* shown = &exchange[current / LANES * LANES];
    std::memcpy(&shown[current % LANES], &value, sizeof value);
    wait_for_warp();
    std::memcpy(&value, &shown[lane], sizeof value);
    wait_for_warp();
    return value;
}

// Calls a kernel as the driver does, with a pointer to each argument.
template <class... Arguments, size_t... I>
void call(void (*kernel)(Arguments...), void** arguments, std::index_sequence<I...>) {
    kernel(*static_cast<std::remove_reference_t<Arguments>*>(arguments[I])...);
}

template <class... Arguments>
void launch(void (*kernel)(Arguments...), unsigned blocks, int threads, void** arguments) {
    body = [=] { call(kernel, arguments, std::index_sequence_for<Arguments...>()); };
    for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x) run_block(threads);
}

}  // namespace shim

inline void __syncwarp() { shim::wait_for_warp(); }
inline void __syncthreads() { shim::wait(shim::block); }

inline int __syncthreads_or(int vote) {
    if (vote) shim::any = true;
    __syncthreads();
    const int any = shim::any;
    __syncthreads();
    shim::any = false;
    __syncthreads();
    return any;
}
inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int __ffs(unsigned bits) { return __builtin_ffs(bits); }

template <class T>
T __shfl_sync(unsigned, T value, int lane) {
    return shim::from_lane(value, lane % shim::LANES);
}

template <class T>
T __shfl_up_sync(unsigned, T value, int lanes) {
    return shim::from_lane(value, max(shim::current % shim::LANES - lanes, 0));
}

template <class T>
T __shfl_down_sync(unsigned, T value, int lanes) {
    return shim::from_lane(value, min(shim::current % shim::LANES + lanes, shim::LANES - 1));
}

inline unsigned __ballot_sync(unsigned, bool vote) {
    uint32_t* shown = &shim::exchange[shim::current / shim::LANES * shim::LANES];
    shown[shim::current % shim::LANES] = vote;
    shim::wait_for_warp();
    unsigned ballot = 0;
    for (int lane = 0; lane < shim::LANES; ++lane) ballot |= shown[lane] << lane;
    shim::wait_for_warp();
    return ballot;
}
