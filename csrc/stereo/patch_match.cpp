#include "stereo/patch_match.h"

#include "base/copies.h"
#include "base/parallel.h"

namespace linprim {
namespace {

// Runs one step of the kernel for all rows, in parallel.
void for_each_row(const PatchMatch& match, PatchMatchStep step, int number) {
  const PatchMatchKernel run = kernel_in_force<PatchMatchKernel>(LINPRIM_COPIES(patch_match_kernel));
  parallel_for(match.height, [&](int64_t row, int) { run(match, step, number, int(row)); });
}

}  // namespace

void patch_match_begin(const PatchMatch& match) { for_each_row(match, PatchMatchStep::kBegin, 0); }

void patch_match_iterate(const PatchMatch& match, int number) {
  for_each_row(match, PatchMatchStep::kEven, number);
  for_each_row(match, PatchMatchStep::kOdd, number);
}

}  // namespace linprim
