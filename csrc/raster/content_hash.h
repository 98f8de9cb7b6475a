// A hash that identifies a view of some primitives; a backward pass finds its forward pass by it.
#pragma once

#include <algorithm>
#include <bit>
#include <cstdint>
#include <cstring>
#include <vector>

#include "base/parallel.h"
#include "linprim.h"

namespace linprim {

// 64-bit content hash: four interleaved multiply-xor lanes over 8-byte words (the finaliser is Stafford's variant 13).
inline uint64_t hash_bytes(uint64_t seed, const void* data, size_t bytes) {
  constexpr uint64_t kOdd = 0x9e3779b97f4a7c15ull;
  const char* p = static_cast<const char*>(data);
  uint64_t lane[4] = {seed ^ kOdd, seed + 1, seed + 2, seed + 3};
  size_t i = 0;
  for (; i + 32 <= bytes; i += 32)
    for (int l = 0; l < 4; ++l) {
      uint64_t word;
      std::memcpy(&word, p + i + 8 * l, 8);
      lane[l] = std::rotl(lane[l] ^ word, 29) * kOdd;
    }
  uint64_t h = bytes;
  for (uint64_t l : lane) h = (std::rotl(h, 17) ^ l) * kOdd;
  for (; i < bytes; ++i) h = (h ^ uint8_t(p[i])) * 0x100000001b3ull;
  h = (h ^ (h >> 30)) * 0xbf58476d1ce4e5b9ull;
  h = (h ^ (h >> 27)) * 0x94d049bb133111ebull;
  return h ^ (h >> 31);
}

// Returns the hash of all inputs of the forward pass.
template <class Real>
uint64_t content_hash(const View& view, const Primitives<Real>& p, bool geometry, const Real* color) {
  const double numbers[] = {view.fx,
                            view.fy,
                            view.cx,
                            view.cy,
                            double(view.width),
                            double(view.height),
                            view.near,
                            view.stop,
                            view.level,
                            double(p.n),
                            double(geometry),
                            double(sizeof(Real)),
                            view.screen_filter,
                            double(view.rays),
                            double(view.order),
                            double(p.kind)};
  constexpr int64_t kPerTask = 4096;
  std::vector<uint64_t> parts(size_t((p.n + kPerTask - 1) / kPerTask) + 2);
  parts[0] = hash_bytes(1, view.world_to_camera, sizeof view.world_to_camera);
  parts[1] = hash_bytes(2, numbers, sizeof numbers);
  parallel_for(int64_t(parts.size()) - 2, [&](int64_t task, int) {  // memory-bound
    const int64_t begin = task * kPerTask, rows = std::min(p.n - begin, kPerTask);
    uint64_t h = 3;
    auto add = [&](const Real* values, int columns) {
      h = hash_bytes(h, values + begin * columns, size_t(rows) * columns * sizeof(Real));
    };
    add(p.center, 3), add(p.rotation, 4), add(p.extent, p.extents()), add(p.density, 1), add(color, 3);
    parts[size_t(task) + 2] = h;
  });
  return hash_bytes(4, parts.data(), parts.size() * sizeof parts[0]);
}

}  // namespace linprim
