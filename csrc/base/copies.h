// Selects between the copies of a function in files that are compiled once per instruction set (name_scalar, name_v2,
// ...).
#pragma once

#include <cstring>
#include <initializer_list>

#include "linprim.h"

#if defined(__x86_64__) || defined(_M_X64)
#define LINPRIM_COPIES(name)                                                             \
  {                                                                                      \
    {"scalar", name##_scalar}, {"v2", name##_v2}, {"v3", name##_v3}, { "v4", name##_v4 } \
  }
#else
#define LINPRIM_COPIES(name)                           \
  {                                                    \
    {"scalar", name##_scalar}, { "neon", name##_neon } \
  }
#endif

namespace linprim {

// A function that returns a kernel, and the instruction set that it is compiled for.
template <class Kernel>
struct Copy {
  const char* instruction_set;
  Kernel (*kernel)();
};

// Returns the kernel in `copies`, which is LINPRIM_COPIES(name), for the instruction set in use.
template <class Kernel>
Kernel kernel_in_force(std::initializer_list<Copy<Kernel>> copies) {
  for (const Copy<Kernel>& copy : copies)
    if (std::strcmp(copy.instruction_set, instruction_set()) == 0) return copy.kernel();
  return copies.begin()->kernel();
}

}  // namespace linprim
