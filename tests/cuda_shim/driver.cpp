// A stand-in for the CUDA driver that runs the kernels on the CPU and is strict about what it is called with.
#include <cstdint>
#include <cstring>

extern "C" {

int launch(const char* kernel, unsigned blocks, int threads, void** arguments);

static void* const CONTEXT = reinterpret_cast<void*>(uintptr_t{0x7f0000000007});  // cut to 32 bits these would not match
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
    static const char* const known[] = {"find_reach", "rasterize", "rasterize_backward", "magnitude_backward"};
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

int cuGetErrorString(int status, const char** text) {
    return *text = status == 500 ? "named symbol not found" : "invalid argument", 0;
}

}  // extern "C"
