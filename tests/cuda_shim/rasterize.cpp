// The kernels of rasterize.cu, unchanged, for the CPU.
#include "cuda_on_cpu.h"
//
#include "rasterize.cu"

extern "C" int launch(const char* kernel, unsigned blocks, int threads, void** arguments) {
    const auto is = [=](const char* name) { return std::strcmp(kernel, name) == 0; };
    if (is("find_reach")) shim::launch(find_reach, blocks, threads, arguments);
    else if (is("rasterize")) shim::launch(rasterize, blocks, threads, arguments);
    else if (is("rasterize_backward")) shim::launch(rasterize_backward, blocks, threads, arguments);
    else return 1;
    return 0;
}
