// A pool of threads that sleep between jobs, and parallel loops over it.
//
// Results never depend on the number of threads: the items of a job are independent, and each writes its own output.
#pragma once

#include <algorithm>
#include <cstdint>
#include <functional>

namespace linprim {

// Number of threads that jobs use, at least 1; 0 selects one per core. Must not be called while a job runs.
void set_threads(int count);
int threads();

// Calls body(item, thread) once for each item in [0, items), on up to threads() threads, and returns when all are done.
// If a body throws (only running out of memory can), the remaining items are skipped and the exception is thrown here.
// `thread` is less than threads(). Items start in order. Concurrent calls from several threads run one after another.
void parallel_for(int64_t items, const std::function<void(int64_t item, int thread)>& body);

// Calls body(row) once for each row in [0, rows), in items of 4096 rows: for work that is cheap per row.
template <class Body>
void for_rows(int64_t rows, const Body& body) {
  constexpr int64_t kRowsPerItem = 4096;
  parallel_for((rows + kRowsPerItem - 1) / kRowsPerItem, [&](int64_t item, int) {
    const int64_t end = std::min((item + 1) * kRowsPerItem, rows);
    for (int64_t row = item * kRowsPerItem; row < end; ++row) body(row);
  });
}

}  // namespace linprim
