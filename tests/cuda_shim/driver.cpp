// A stand-in for the CUDA driver, libcuda.so.1: it runs the kernels on the CPU and checks the arguments of every call.
#include <cstdint>
#include <cstring>

extern "C" {

int launch(const char* kernel, unsigned blocks, int threads, void** arguments);

static void* const CONTEXT = reinterpret_cast<void*>(uintptr_t{0x7f0000000007});  // does not survive a cut to 32 bits
static void* const MODULE = reinterpret_cast<void*>(uintptr_t{0x7e0000000000});
static void* const STREAM = reinterpret_cast<void*>(uintptr_t{0x123456789abc});
static bool current = false;

int cuInit(unsigned flags) { return flags != 0; }
int cuDeviceGet(int* device, int ordinal) { return *device = ordinal + 7, 0; }
int cuDevicePrimaryCtxRetain(void** context, int device) { return *context = CONTEXT, device != 7; }
int cuCtxSetCurrent(void* context) { return current = true, context != CONTEXT; }

int cuModuleLoadData(void** module, const void* image) {
    *module = MODULE;
    return !current || std::memcmp(image, "\x7f" "ELF", 4) != 0;
}

int cuModuleGetFunction(void** function, void* module, const char* name) {
    static const char* const known[] = {"find_reach", "rasterize", "rasterize_backward"};
    for (const char* kernel : known)
        if (std::strcmp(name, kernel) == 0) return *function = const_cast<char*>(kernel), module != MODULE;
    return 500;
}

int cuLaunchKernel(
    void* function, unsigned blocks, unsigned y, unsigned z, unsigned threads, unsigned ty, unsigned tz, unsigned shared,
    void* stream, void** arguments, void** extra) {
    if (!current || y != 1 || z != 1 || ty != 1 || tz != 1 || shared != 0 || stream != STREAM || extra != nullptr) return 1;
    return launch(static_cast<const char*>(function), blocks, static_cast<int>(threads), arguments);
}

// The only exported function: cuda.bindings asks it for every other one by name, also for those that are not here.
__attribute__((visibility("default")))
int cuGetProcAddress_v2(const char* symbol, void** function, int version, uint64_t flags, int* status) {
    static const struct { const char* name; void* address; } known[] = {
        {"cuInit", (void*)cuInit}, {"cuDeviceGet", (void*)cuDeviceGet},
        {"cuDevicePrimaryCtxRetain", (void*)cuDevicePrimaryCtxRetain}, {"cuCtxSetCurrent", (void*)cuCtxSetCurrent},
        {"cuModuleLoadData", (void*)cuModuleLoadData}, {"cuModuleGetFunction", (void*)cuModuleGetFunction},
        {"cuLaunchKernel", (void*)cuLaunchKernel},
    };
    for (const auto& entry : known)
        if (std::strcmp(symbol, entry.name) == 0) return *function = entry.address, 0;
    return *function = nullptr, 500;
}

}  // extern "C"
