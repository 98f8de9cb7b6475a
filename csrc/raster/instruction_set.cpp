// Selects, at run time, one of the kernel builds that this processor can run.
#include "raster/instruction_set.h"

#include <atomic>
#include <cstdlib>
#include <cstring>

#include "linprim.h"

namespace linprim {
namespace {

struct Choice {  // kernels of one instruction set
  const Kernels<float>* kernels;
  const ImageKernels* image;
};

constexpr int kChoices = 5;  // capacity of the list of choices

// Lists the builds that this processor can run, best first, and returns their number.
int available(Choice (&out)[kChoices]) {
  int count = 0;
#if defined(__x86_64__) || defined(_M_X64)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd") &&
      __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("fma") &&
      __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2") && __builtin_cpu_supports("popcnt"))
    out[count++] = {&kernels_v4(), &image_kernels_v4()};
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
      __builtin_cpu_supports("bmi2") && __builtin_cpu_supports("popcnt"))
    out[count++] = {&kernels_v3(), &image_kernels_v3()};
  if (__builtin_cpu_supports("sse4.2") && __builtin_cpu_supports("popcnt"))
    out[count++] = {&kernels_v2(), &image_kernels_v2()};
#else
  out[count++] = {&kernels_neon(), &image_kernels_neon()};
#endif
  out[count++] = {&kernels_scalar<float>(), &image_kernels_scalar()};
  return count;
}

// Returns the build of that name, or the best one for "auto"; null if the processor cannot run it or it does not exist.
const Choice* find(const char* name) {
  static Choice choices[kChoices];
  static const int count = available(choices);
  if (std::strcmp(name, "auto") == 0) return &choices[0];
  for (int i = 0; i < count; ++i)
    if (std::strcmp(choices[i].kernels->name, name) == 0) return &choices[i];
  return nullptr;
}

// Returns the selected build: at first that of LINPRIM_GEO_ISA, or the best one if that is not set or not available.
std::atomic<const Choice*>& current() {
  static std::atomic<const Choice*> choice = [] {
    const char* wanted = std::getenv("LINPRIM_GEO_ISA");
    const Choice* found = wanted ? find(wanted) : nullptr;
    return found ? found : find("auto");
  }();
  return choice;
}

}  // namespace

bool set_instruction_set(const char* name) {
  const Choice* found = find(name);
  if (found) current() = found;
  return found != nullptr;
}
const char* instruction_set() { return current().load()->kernels->name; }

template <>
const Kernels<float>& kernels<float>() {
  return *current().load()->kernels;
}
template <>
const Kernels<double>& kernels<double>() {
  return kernels_scalar<double>();
}
const ImageKernels& image_kernels() { return *current().load()->image; }
Limits measure_limits() { return image_kernels().limits(); }

}  // namespace linprim
