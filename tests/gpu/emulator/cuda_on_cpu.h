// Enough of CUDA to run our kernels on the CPU: one fiber per thread, one block after another. For tests only.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <setjmp.h>
#include <ucontext.h>
#include <vector>

#define __device__
#define __global__
#define __forceinline__ inline
#define __noinline__
#define __launch_bounds__(...)

struct float2 { float x, y; };
struct float3 { float x, y, z; };
struct alignas(16) float4 { float x, y, z, w; };
struct int3 { int x, y, z; };
struct int4 { int x, y, z, w; };
struct alignas(8) uint2 { unsigned x, y; };
struct uchar4 { unsigned char x, y, z, w; };
struct Index { unsigned x; };
static inline float2 make_float2(float x, float y) { return {x, y}; }
static inline uint2 make_uint2(unsigned x, unsigned y) { return {x, y}; }
static inline float3 make_float3(float x, float y, float z) { return {x, y, z}; }
static inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
static inline int4 make_int4(int x, int y, int z, int w) { return {x, y, z, w}; }
using std::max;
using std::min;

namespace emulator {
struct Barrier { int arrived = 0, generation = 0; };
struct Warp { Barrier barrier; uint32_t values[2][32]; };
struct Fiber {
    std::vector<char> stack;
    ucontext_t start;
    jmp_buf state;
    bool started = false, done = false;
    const int* waits_for = nullptr;
    int seen = 0;
};
static std::vector<Fiber> fibers;
static std::vector<Warp> warps;
static Barrier block;
static jmp_buf scheduler;
static ucontext_t scheduler_start;
static int current, count;
static void (*entry)();
}  // namespace emulator

static Index threadIdx, blockIdx, blockDim;

namespace emulator {
static void wait(Barrier& barrier, int members) {
    if (++barrier.arrived == members) {
        barrier.arrived = 0;
        barrier.generation++;
        return;
    }
    Fiber& self = fibers[current];
    self.waits_for = &barrier.generation;
    self.seen = barrier.generation;
    if (!_setjmp(self.state)) _longjmp(scheduler, 1);
}

static void run_fiber() {
    entry();
    fibers[current].done = true;
    _longjmp(scheduler, 1);
}

static void run_block() {
    block = {};
    for (auto& warp : warps) warp.barrier = {};
    for (auto& fiber : fibers) fiber.started = fiber.done = false, fiber.waits_for = nullptr;
    for (volatile int left = count; left;) {
        for (volatile int k = 0; k < count; k++) {
            Fiber& fiber = fibers[k];
            if (fiber.done || (fiber.waits_for && *fiber.waits_for == fiber.seen)) continue;
            fiber.waits_for = nullptr;
            current = k;
            threadIdx.x = k;
            if (!_setjmp(scheduler)) {
                if (fiber.started) _longjmp(fiber.state, 1);
                fiber.started = true;
                fiber.stack.resize(256 * 1024);
                getcontext(&fiber.start);
                fiber.start.uc_stack.ss_sp = fiber.stack.data();
                fiber.start.uc_stack.ss_size = fiber.stack.size();
                makecontext(&fiber.start, run_fiber, 0);
                setcontext(&fiber.start);
            }
            if (fibers[k].done) left = left - 1;
        }
    }
}

static void launch(void (*kernel)(), int blocks, int threads) {
    entry = kernel;
    count = threads;
    fibers.resize(threads);
    warps.resize((threads + 31) / 32);
    blockDim.x = threads;
    for (int b = 0; b < blocks; b++) {
        blockIdx.x = b;
        run_block();
    }
}

// All lanes give a value; returns where all 32 lie.
static const uint32_t* exchange(uint32_t value) {
    Warp& warp = warps[current / 32];
    uint32_t* values = warp.values[warp.barrier.generation & 1];
    values[current % 32] = value;
    wait(warp.barrier, std::min(32, count - current / 32 * 32));
    return values;
}
template <class T> static uint32_t word(T x) { uint32_t w; memcpy(&w, &x, 4); return w; }
template <class T> static T value(uint32_t w) { T x; memcpy(&x, &w, 4); return x; }
}  // namespace emulator

static void __syncthreads() { emulator::wait(emulator::block, emulator::count); }
static void __syncwarp() { emulator::exchange(0); }
template <class T> static T __shfl_sync(unsigned, T x, int lane) {
    return emulator::value<T>(emulator::exchange(emulator::word(x))[lane & 31]);
}
static double __shfl_sync(unsigned mask, double x, int lane) {
    uint32_t half[2];
    memcpy(half, &x, 8);
    for (auto& h : half) h = __shfl_sync(mask, h, lane);
    memcpy(&x, half, 8);
    return x;
}
template <class T> static T __shfl_up_sync(unsigned, T x, int step) {
    int lane = emulator::current % 32;
    return emulator::value<T>(emulator::exchange(emulator::word(x))[lane >= step ? lane - step : lane]);
}
template <class T> static T __shfl_xor_sync(unsigned, T x, int mask) {
    int lane = emulator::current % 32;
    return emulator::value<T>(emulator::exchange(emulator::word(x))[lane ^ mask]);
}
static unsigned __ballot_sync(unsigned, int x) {
    const uint32_t* values = emulator::exchange(x != 0);
    unsigned bits = 0;
    for (int k = 0; k < 32; k++) bits |= values[k] << k;
    return bits;
}
static bool __any_sync(unsigned mask, int x) { return __ballot_sync(mask, x); }
template <class T> static T __reduce_min_sync(unsigned, T x) {
    const uint32_t* values = emulator::exchange(emulator::word(x));
    for (int k = 0; k < 32; k++) x = std::min(x, emulator::value<T>(values[k]));
    return x;
}
template <class T> static T __reduce_max_sync(unsigned, T x) {
    const uint32_t* values = emulator::exchange(emulator::word(x));
    for (int k = 0; k < 32; k++) x = std::max(x, emulator::value<T>(values[k]));
    return x;
}
template <class T> static T atomicMin(T* at, T x) { T old = *at; *at = std::min(old, x); return old; }
template <class T> static T atomicMax(T* at, T x) { T old = *at; *at = std::max(old, x); return old; }
template <class T> static T atomicAdd(T* at, T x) { T old = *at; *at += x; return old; }
static int __float_as_int(float x) { return emulator::value<int>(emulator::word(x)); }
static unsigned __float_as_uint(float x) { return emulator::word(x); }
static float __int_as_float(int x) { return emulator::value<float>(emulator::word(x)); }
static float __uint_as_float(unsigned x) { return emulator::value<float>(x); }
static float __frcp_rn(float x) { return 1.f / x; }
static float __fdividef(float x, float y) { return x / y; }
static float __fmul_rn(float x, float y) { return x * y; }
static float __fsub_rn(float x, float y) { return x - y; }
static int __ffs(unsigned x) { return __builtin_ffs((int)x); }
