// The rasterizer's pipeline. Forward: project, sort by depth, bin into tiles, blend. Backward: blend backward per tile,
// sum the gradients of each primitive over its tiles, apply the chain rule of the projection.
#include <algorithm>
#include <array>
#include <bit>
#include <chrono>
#include <memory>
#include <mutex>
#include <new>
#include <utility>
#include <vector>

#include "raster/content_hash.h"
#include "raster/instruction_set.h"
#include "linprim.h"
#include "base/parallel.h"

namespace linprim {
namespace {

constexpr int64_t kPrimitivesPerTask = 512;  // of projection and of its chain rule

// Measures the milliseconds between calls of lap().
class Stopwatch {
 public:
  double lap() {
    const auto now = std::chrono::steady_clock::now();
    const double ms = std::chrono::duration<double, std::milli>(now - last_).count();
    last_ = now;
    return ms;
  }

 private:
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

Statistics last_statistics{};  // of the latest forward pass and the backward passes since

// A cache line: unit of memory for records of any kind and for scratch.
struct alignas(64) Line {
  char bytes[64];
};

// Intermediate data of one view: projected primitives, their depth order, tile lists and gradient sums. Buffers only
// grow, so a view after the first allocates nothing unless it needs more.
template <class Real>
struct Frame {
  uint64_t hash = 0, used = 0;  // content hash of the inputs, 0 for none; clock of the cache at the last use
  int tiles_x = 0, tiles_y = 0;
  int64_t rows = 0, visible = 0, pair_count = 0;
  const SolidKernels<Real>* solid = nullptr;
  std::vector<Line> records;
  std::vector<std::array<std::array<Real, 3>, 4>> normals;
  std::vector<Footprint> footprints;
  std::vector<Real> key;
  std::vector<uint32_t> order, order_swap, keys, keys_swap;
  // Result of a projection task: number of visible rows, first gradient slot, and the range of its pairs in the list of
  // the thread that ran it.
  struct Task {
    uint32_t visible, first_slot;
    int thread;
    int64_t pairs_begin, pairs;
  };
  std::vector<Task> tasks;
  std::vector<std::vector<LoosePair>> loose;  // pairs, one list per thread
  std::vector<int64_t> loose_count;           // pairs in each of these lists
  std::vector<uint32_t> tile_count;           // threads x tiles
  std::vector<uint32_t> chunk_tile;           // chunks x tiles: counts, then write positions
  std::vector<uint32_t> tile_begin, first_slot, slot_count;
  std::vector<uint32_t> pair_primitive, pair_slot, pair_blocks;
  std::vector<Real> pair_weight, sums, background_sums;
  std::vector<uint32_t> pair_pixels;
  std::vector<Line> scratch;  // one part per thread

  int tiles() const { return tiles_x * tiles_y; }

  // Projects the primitives, sorts the visible ones by depth and builds the tile lists. Writes `color`, and times and
  // counts to `stats`.
  void build(const View& view, const Primitives<Real>& p, bool geometry, Real* color, Statistics& stats) {
    Stopwatch watch;
    tiles_x = (view.width + kTile - 1) / kTile, tiles_y = (view.height + kTile - 1) / kTile;
    solid = &kernels<Real>().solids[int(p.kind)][int(view.rays)];
    grow(records, (p.n * solid->record_bytes + 63) / 64);
    grow(footprints, p.n), grow(key, p.n), grow(first_slot, p.n), grow(slot_count, p.n);
    if (geometry) grow(normals, p.n);
    const ProjectParams<Real> project{view,
                                      p,
                                      records.data(),
                                      footprints.data(),
                                      key.data(),
                                      color,
                                      geometry ? reinterpret_cast<Real(*)[4][3]>(normals.data()) : nullptr};
    rows = p.n;
    grow(order, p.n), grow(order_swap, p.n), grow(keys, p.n), grow(keys_swap, p.n);
    tasks.resize(size_t((p.n + kPrimitivesPerTask - 1) / kPrimitivesPerTask));
    if (int(loose.size()) < threads()) loose.resize(threads());
    loose_count.assign(threads(), 0), tile_count.assign(size_t(threads()) * tiles(), 0u);
    parallel_for(int64_t(tasks.size()), [&](int64_t task, int thread) {
      const int64_t begin = task * kPrimitivesPerTask, end = std::min(p.n, begin + kPrimitivesPerTask);
      solid->project(project, begin, end);
      collect(task, begin, end, thread);
    });
    stats.project_ms = watch.lap();
    sort();
    stats.sort_ms = watch.lap();
    bin();
    stats.bin_ms = watch.lap();
    stats.primitives = p.n, stats.visible = visible, stats.pairs = pair_count;
    stats.working_set_bytes = bytes();
  }

  // Maps a key to an unsigned integer with the same order; -0 maps to the same integer as 0.
  static uint32_t ordered_bits(float key) {
    const uint32_t bits = std::bit_cast<uint32_t>(key + 0.0f);
    return bits ^ ((bits >> 31) ? 0xffffffffu : 0x80000000u);
  }

  // Does the part of sorting and binning for the rows of one projection task, while their footprints are in the cache.
  // Writes the visible rows and their keys to the beginning of the task's rows of `order` and `keys`, and appends their
  // pairs to the list of the thread.
  void collect(int64_t index, int64_t begin, int64_t end, int thread) {
    Task& task = tasks[index];
    int64_t count = begin;
    for (int64_t i = begin; i < end; ++i) {
      slot_count[i] = 0;
      order[count] = uint32_t(i);
      if constexpr (sizeof(Real) == 4) keys[count] = ordered_bits(key[i]);
      count += footprints[i].x0 <= footprints[i].x1;
    }
    std::vector<LoosePair>& list = loose[thread];
    task.visible = uint32_t(count - begin), task.thread = thread, task.pairs_begin = loose_count[thread];
    const BinParams params{footprints.data(), order.data(), tiles_x, slot_count.data(),
                           &tile_count[int64_t(thread) * tiles()]};
    for (int64_t at = begin;;) {
      int64_t written = 0;
      at = kernels<Real>().bin(params, at, count, list.data() + loose_count[thread],
                               int64_t(list.size()) - loose_count[thread], &written);
      loose_count[thread] += written;
      if (at == count) break;
      list.resize(list.size() * 2 + 2 * size_t(tiles()));
    }
    task.pairs = loose_count[thread] - task.pairs_begin;
  }

  // Sorts the visible primitives by ascending key; ties keep the order of input.
  void sort() {
    int64_t at = 0;
    for (int64_t t = 0; t < int64_t(tasks.size()); ++t) {  // close the gaps between the tasks
      const int64_t begin = t * kPrimitivesPerTask;
      std::copy_n(order.begin() + begin, tasks[t].visible, order.begin() + at);
      if constexpr (sizeof(Real) == 4) std::copy_n(keys.begin() + begin, tasks[t].visible, keys.begin() + at);
      at += tasks[t].visible;
    }
    visible = at;
    if constexpr (sizeof(Real) == 8) {
      std::stable_sort(order.begin(), order.begin() + visible, [&](uint32_t a, uint32_t b) { return key[a] < key[b]; });
      return;
    }
    // Radix sort of the keys minus the lowest one, in the fewest passes of at most kMaxBits bits each.
    constexpr int kMaxBits = 11, kMaxPasses = 3;
    uint32_t low = ~0u, high = 0;
    for (int64_t i = 0; i < visible; ++i) low = std::min(low, keys[i]), high = std::max(high, keys[i]);
    const int width = visible ? std::bit_width(high - low) : 0, passes = (width + kMaxBits - 1) / kMaxBits;
    if (passes == 0) return;
    const int bits = (width + passes - 1) / passes;
    const uint32_t mask = (1u << bits) - 1;
    static thread_local uint32_t histogram[kMaxPasses][1 << kMaxBits];
    for (int pass = 0; pass < passes; ++pass) std::fill_n(histogram[pass], mask + 1, 0u);
    for (int64_t i = 0; i < visible; ++i) {
      keys[i] -= low;
      for (int pass = 0; pass < passes; ++pass) ++histogram[pass][keys[i] >> (bits * pass) & mask];
    }
    for (int pass = 0; pass < passes; ++pass) {
      uint32_t total = 0, *next = histogram[pass];
      for (uint32_t b = 0; b <= mask; ++b) total += std::exchange(next[b], total);
      for (int64_t i = 0; i < visible; ++i) {
        const uint32_t to = next[keys[i] >> (bits * pass) & mask]++;
        keys_swap[to] = keys[i], order_swap[to] = order[i];
      }
      keys.swap(keys_swap), order.swap(order_swap);
    }
  }

  // Builds the tile lists, each in the order of `order`. The gradient slots of a primitive are consecutive; primitives
  // have theirs in the order of input.
  void bin() {
    int64_t pairs_in_all = 0;
    for (const Task& task : tasks) pairs_in_all += task.pairs;
    if (pairs_in_all >= int64_t(1) << 32)
      throw std::bad_alloc();  // slot indices have 32 bits; 2^32 slots take more than 200 GiB
    pair_count = pairs_in_all;
    uint32_t slot = 0;
    for (int64_t t = 0, i = 0; t < int64_t(tasks.size()); ++t) {
      tasks[t].first_slot = slot;
      for (const int64_t end = std::min(i + kPrimitivesPerTask, int64_t(rows)); i < end; ++i)
        first_slot[i] = slot, slot += slot_count[i];
    }
    // Counting sort by tile: chunks of `order` are written to the lists in parallel. In each tile's list, a chunk
    // begins where the chunks before it end.
    const int chunks = threads() == 1 ? 1 : 4 * threads();
    auto begin_of = [&](int64_t chunk) { return visible * chunk / chunks; };
    auto pairs_of = [&](uint32_t primitive) {
      const Task& task = tasks[primitive / kPrimitivesPerTask];
      return loose[task.thread].data() + task.pairs_begin + (first_slot[primitive] - task.first_slot);
    };
    auto each_pair = [&](int64_t chunk, auto body) {
      // Prefetch distances in primitives: `order` visits memory at random.
      constexpr int64_t kFar = 24, kNear = 12;
      const int64_t end = begin_of(chunk + 1);
      for (int64_t i = begin_of(chunk); i < end; ++i) {
        if (i + kFar < end)
          __builtin_prefetch(&first_slot[order[i + kFar]]), __builtin_prefetch(&slot_count[order[i + kFar]]);
        if (i + kNear < end) __builtin_prefetch(pairs_of(order[i + kNear]));
        const uint32_t primitive = order[i], first = first_slot[primitive], count = slot_count[primitive];
        const LoosePair* pairs = pairs_of(primitive);
        for (uint32_t k = 0; k < count; ++k) body(pairs[k], primitive, first + k);
      }
    };
    grow(chunk_tile, int64_t(chunks) * tiles()), grow(tile_begin, tiles() + 1);
    if (chunks > 1)
      parallel_for(chunks, [&](int64_t chunk, int) {
        uint32_t* counts = &chunk_tile[chunk * tiles()];
        std::fill(counts, counts + tiles(), 0u);
        each_pair(chunk, [&](const LoosePair& pair, uint32_t, uint32_t) { ++counts[pair.tile]; });
      });
    else
      std::copy_n(tile_count.begin(), tiles(), chunk_tile.begin());
    uint32_t total = 0;
    for (int tile = 0; tile < tiles(); ++tile) {
      tile_begin[tile] = total;
      for (int chunk = 0; chunk < chunks; ++chunk)
        total += std::exchange(chunk_tile[int64_t(chunk) * tiles() + tile], total);
    }
    tile_begin[tiles()] = total;
    grow(pair_primitive, pair_count), grow(pair_slot, pair_count), grow(pair_blocks, pair_count);
    parallel_for(chunks, [&](int64_t chunk, int) {
      uint32_t* position = &chunk_tile[chunk * tiles()];
      each_pair(chunk, [&](const LoosePair& pair, uint32_t primitive, uint32_t slot) {
        const uint32_t at = position[pair.tile]++;
        pair_primitive[at] = primitive, pair_slot[at] = slot, pair_blocks[at] = pair.blocks;
      });
    });
  }

  // Calls body(tile, thread, scratch) for every tile in parallel; `scratch` belongs to the calling thread.
  template <class Body>
  void each_tile(int64_t scratch_bytes, Body body) {
    const int64_t lines = (scratch_bytes + 63) / 64;
    grow(scratch, lines * threads());
    parallel_for(tiles(), [&](int64_t tile, int thread) { body(int(tile), thread, scratch.data() + lines * thread); });
  }
  // Returns the number of pairs of the longest tile list.
  int64_t longest_list() const {
    uint32_t longest = 0;
    for (int tile = 0; tile < tiles(); ++tile) longest = std::max(longest, tile_begin[tile + 1] - tile_begin[tile]);
    return longest;
  }

  // Returns the parameters of the tile kernels for this frame.
  RasterParams<Real> raster(const View& view, const Real* background, const Planes<Real>& out) {
    return {view,
            tiles_x,
            tiles_y,
            records.data(),
            key.data(),
            reinterpret_cast<const Real(*)[4][3]>(normals.data()),
            {tile_begin.data(), pair_primitive.data(), pair_slot.data(), pair_blocks.data()},
            background,
            out,
            pair_weight.data(),
            pair_pixels.data(),
            {},
            sums.data(),
            background_sums.data()};
  }

  template <class T>
  static void grow(std::vector<T>& v, int64_t size) {
    if (int64_t(v.size()) < size) v.resize(size);
  }
  // Returns the memory that the buffers take.
  int64_t bytes() const {
    auto of = [](const auto& v) { return int64_t(v.capacity() * sizeof(v[0])); };
    int64_t total = of(records) + of(normals) + of(footprints) + of(key) + of(order) + of(order_swap) + of(keys) +
                    of(keys_swap) + of(tasks) + of(tile_count) + of(chunk_tile) + of(tile_begin) + of(first_slot) +
                    of(slot_count) + of(pair_primitive) + of(pair_slot) + of(pair_blocks) + of(scratch) +
                    of(pair_weight) + of(sums) + of(background_sums) + of(pair_pixels);
    for (const auto& list : loose) total += of(list);
    return total;
  }
};

// The frames of the last views, so that a backward pass finds the tile lists of its forward pass. Guarded by `mutex`.
template <class Real>
struct Cache {
  std::mutex mutex;
  uint64_t clock = 0;
  std::array<std::unique_ptr<Frame<Real>>, 2> frames;

  // Returns the frame with that content hash, or null.
  Frame<Real>* find(uint64_t hash) {
    for (auto& frame : frames)
      if (frame && frame->hash == hash) return frame->used = ++clock, frame.get();
    return nullptr;
  }
  // Returns an unused frame, or the least recently used one, to be overwritten.
  Frame<Real>& oldest() {
    std::unique_ptr<Frame<Real>>* chosen = &frames[0];
    for (auto& frame : frames)
      if (!frame || (*chosen && frame->used < (*chosen)->used)) chosen = &frame;
    if (!*chosen) *chosen = std::make_unique<Frame<Real>>();
    (*chosen)->used = ++clock;
    (*chosen)->hash = 0;
    return **chosen;
  }
};
// One cache per precision, never destroyed.
template <class Real>
Cache<Real>& cache() {
  static auto* instance = new Cache<Real>;
  return *instance;
}

}  // namespace

Statistics statistics() { return last_statistics; }

template <class Real>
void rasterize(const View& view, const Primitives<Real>& primitives, const Real* background, bool geometry,
               const Planes<Real>& out, Real* color, Real* max_weight, int32_t* pixels) {
  std::lock_guard lock(cache<Real>().mutex);
  Statistics stats{};
  Frame<Real>& frame = cache<Real>().oldest();
  frame.build(view, primitives, geometry, color, stats);
  Stopwatch watch;
  if (geometry) frame.grow(frame.pair_weight, frame.pair_count), frame.grow(frame.pair_pixels, frame.pair_count);
  const RasterParams<Real> params = frame.raster(view, background, out);
  std::vector<Counts> counts(threads(), Counts{});
  frame.each_tile(frame.solid->scratch_bytes(view.order, geometry, frame.longest_list()),
                  [&](int tile, int thread, void* scratch) {
                    const Counts c = frame.solid->forward[int(view.order)][geometry](params, tile, scratch);
                    counts[thread].visited_lanes += c.visited_lanes, counts[thread].hit_lanes += c.hit_lanes;
                  });
  for (const Counts& c : counts)
    stats.visited_lanes += int64_t(c.visited_lanes), stats.hit_lanes += int64_t(c.hit_lanes);
  if (geometry) {
    for (int64_t i = 0; i < primitives.n; ++i) {
      Real largest = 0;
      uint32_t sum = 0;
      for (uint32_t s = 0; s < frame.slot_count[i]; ++s) {
        largest = std::max(largest, frame.pair_weight[frame.first_slot[i] + s]);
        sum += frame.pair_pixels[frame.first_slot[i] + s];
      }
      max_weight[i] = largest, pixels[i] = int32_t(sum);
    }
  }
  stats.forward_ms = watch.lap();
  frame.hash = content_hash(view, primitives, geometry, color);
  last_statistics = stats;
}

template <class Real>
void rasterize_grad(const View& view, const Primitives<Real>& primitives, const Real* background, bool geometry,
                    const Planes<Real>& out, const Real* color, const Planes<Real>& grad,
                    const PrimitiveGradients<Real>& gradients, Real* background_grad) {
  std::lock_guard lock(cache<Real>().mutex);
  Statistics stats = last_statistics;
  const uint64_t hash = content_hash(view, primitives, geometry, color);
  Frame<Real>* frame = cache<Real>().find(hash);
  if (!frame) {
    frame = &cache<Real>().oldest();
    std::vector<Real> scratch(size_t(primitives.n) * 3);
    frame->build(view, primitives, geometry, scratch.data(), stats);
    frame->hash = hash;
  }
  Stopwatch watch;
  const int per_slot = frame->solid->sums_per_slot[int(view.order)][geometry];
  frame->grow(frame->sums, frame->pair_count * per_slot),
      frame->grow(frame->background_sums, int64_t(frame->tiles()) * 3);
  RasterParams<Real> params = frame->raster(view, background, out);
  params.grad = grad;
  frame->each_tile(
      frame->solid->scratch_bytes(view.order, geometry, frame->longest_list()),
      [&](int tile, int, void* scratch) { frame->solid->backward[int(view.order)][geometry](params, tile, scratch); });
  double total[3] = {0, 0, 0};
  for (int tile = 0; tile < frame->tiles(); ++tile)
    for (int k = 0; k < 3; ++k) total[k] += double(frame->background_sums[3 * tile + k]);
  for (int k = 0; k < 3; ++k) background_grad[k] = Real(total[k]);
  stats.backward_ms = watch.lap();
  const ProjectBackwardParams<Real> backward{view,
                                             primitives,
                                             frame->footprints.data(),
                                             color,
                                             frame->first_slot.data(),
                                             frame->slot_count.data(),
                                             frame->sums.data(),
                                             per_slot,
                                             gradients};
  parallel_for((primitives.n + kPrimitivesPerTask - 1) / kPrimitivesPerTask, [&](int64_t task, int) {
    const int64_t begin = task * kPrimitivesPerTask;
    frame->solid->project_backward(backward, begin, std::min(primitives.n, begin + kPrimitivesPerTask));
  });
  stats.project_backward_ms = watch.lap();
  last_statistics = stats;
}

template <class Real>
void level_depth(const View& view, const Primitives<Real>& primitives, Real* depth, Real* opacity) {
  std::lock_guard lock(cache<Real>().mutex);
  Statistics stats{};
  Frame<Real>& frame = cache<Real>().oldest();
  std::vector<Real> color(size_t(primitives.n) * 3);
  frame.build(view, primitives, false, color.data(), stats);
  Planes<Real> out{};
  out.depth_median = depth, out.opacity = opacity;
  const RasterParams<Real> params = frame.raster(view, nullptr, out);
  frame.each_tile(frame.longest_list() * 3 * kBlocks * int64_t(sizeof(Real)), [&](int tile, int, void* scratch) {
    frame.solid->level_depth(params, tile, static_cast<Real*>(scratch));
  });
}

template <class Real>
bool has_kernels(PrimitiveKind kind, RayModel rays, Order order) {
  return kernels<Real>().solids[int(kind)][int(rays)].forward[int(order)][0] != nullptr;
}

#define LINPRIM_INSTANTIATE(Real)                                                                                    \
  template void rasterize<Real>(const View&, const Primitives<Real>&, const Real*, bool, const Planes<Real>&, Real*, \
                                Real*, int32_t*);                                                                    \
  template bool has_kernels<Real>(PrimitiveKind, RayModel, Order);                                                   \
  template void level_depth<Real>(const View&, const Primitives<Real>&, Real*, Real*);                               \
  template void rasterize_grad<Real>(const View&, const Primitives<Real>&, const Real*, bool, const Planes<Real>&,   \
                                     const Real*, const Planes<Real>&, const PrimitiveGradients<Real>&, Real*);
LINPRIM_INSTANTIATE(float)
LINPRIM_INSTANTIATE(double)

}  // namespace linprim
