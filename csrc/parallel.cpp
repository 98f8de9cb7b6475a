// The thread pool behind parallel_for: workers wait on a condition variable, so an idle pool costs nothing.
#include "parallel.h"

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

namespace linprim {
namespace {

class Pool {
 public:
  explicit Pool(int count) : count_(count) {
    for (int t = 1; t < count; ++t) workers_.emplace_back([this, t] { work(t); });
  }
  ~Pool() {
    {
      std::lock_guard lock(mutex_);
      stop_ = true;
    }
    wake_.notify_all();
    for (std::thread& worker : workers_) worker.join();
  }
  int count() const { return count_; }

  void run(int64_t items, const std::function<void(int64_t, int)>& body) {
    if (count_ == 1 || items <= 1) {
      for (int64_t i = 0; i < items; ++i) body(i, 0);
      return;
    }
    {
      std::lock_guard lock(mutex_);
      body_ = &body, items_ = items, next_ = 0, busy_ = count_ - 1, ++job_;
    }
    wake_.notify_all();
    drain(0);
    std::unique_lock lock(mutex_);
    done_.wait(lock, [this] { return busy_ == 0; });
  }

 private:
  void drain(int thread) {
    for (int64_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < items_;) (*body_)(i, thread);
  }
  void work(int thread) {
    uint64_t seen = 0;
    std::unique_lock lock(mutex_);
    for (;;) {
      wake_.wait(lock, [&] { return stop_ || job_ != seen; });
      if (stop_) return;
      seen = job_;
      lock.unlock();
      drain(thread);
      lock.lock();
      if (--busy_ == 0) done_.notify_one();
    }
  }

  const int count_;
  std::vector<std::thread> workers_;
  std::mutex mutex_;
  std::condition_variable wake_, done_;
  const std::function<void(int64_t, int)>* body_ = nullptr;
  std::atomic<int64_t> next_{0};
  int64_t items_ = 0;
  int busy_ = 0;
  uint64_t job_ = 0;
  bool stop_ = false;
};

std::mutex pool_mutex;
std::unique_ptr<Pool>& pool() {
  // Deliberately leaked: joining threads while the process unloads its libraries can hang.
  static auto* instance = new std::unique_ptr<Pool>(new Pool(int(std::max(1u, std::thread::hardware_concurrency()))));
  return *instance;
}

}  // namespace

void set_threads(int count) {
  std::lock_guard lock(pool_mutex);
  if (count <= 0) count = int(std::max(1u, std::thread::hardware_concurrency()));
  if (count != pool()->count()) pool() = std::make_unique<Pool>(count);
}

int threads() {
  std::lock_guard lock(pool_mutex);
  return pool()->count();
}

void parallel_for(int64_t items, const std::function<void(int64_t, int)>& body) {
  std::lock_guard lock(pool_mutex);
  pool()->run(items, body);
}

}  // namespace linprim
