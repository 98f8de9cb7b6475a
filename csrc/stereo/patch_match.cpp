#include "stereo/patch_match.h"

#include <cstring>

#include "base/parallel.h"
#include "linprim.h"

namespace linprim {
namespace {

PatchMatchKernel kernel() {
  const char* name = instruction_set();
#if defined(__x86_64__) || defined(_M_X64)
  if (std::strcmp(name, "v4") == 0) return patch_match_kernel_v4();
  if (std::strcmp(name, "v3") == 0) return patch_match_kernel_v3();
  if (std::strcmp(name, "v2") == 0) return patch_match_kernel_v2();
#else
  if (std::strcmp(name, "neon") == 0) return patch_match_kernel_neon();
#endif
  return patch_match_kernel_scalar();
}

void for_each_row(const PatchMatch& match, PatchMatchStep step, int number) {
  const PatchMatchKernel run = kernel();
  parallel_for(match.height, [&](int64_t row, int) { run(match, step, number, int(row)); });
}

}  // namespace

void patch_match_begin(const PatchMatch& match) { for_each_row(match, PatchMatchStep::kBegin, 0); }

void patch_match_iterate(const PatchMatch& match, int number) {
  for_each_row(match, PatchMatchStep::kEven, number);
  for_each_row(match, PatchMatchStep::kOdd, number);
}

}  // namespace linprim
