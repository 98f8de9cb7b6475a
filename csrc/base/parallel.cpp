// The thread pool behind parallel_for: workers wait on a condition variable, so an idle pool costs nothing.
#include "base/parallel.h"

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <exception>
#include <memory>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

#if !defined(_WIN32)
#include <unistd.h>
#endif

namespace linprim {
namespace {

// A fixed number of threads, the calling one included, that take the items of a job from a shared counter.
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

  // Calls body(item, thread) for every item, and rethrows the first exception of a body.
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
    if (failure_) std::rethrow_exception(std::exchange(failure_, nullptr));
  }

 private:
  // Processes items until none is left.
  void drain(int thread) {
    try {
      for (int64_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < items_;) (*body_)(i, thread);
    } catch (...) {  // out of memory: the others finish their item; run() rethrows it on the caller's thread
      next_ = items_;
      std::lock_guard lock(mutex_);
      if (!failure_) failure_ = std::current_exception();
    }
  }
  // Loop of a worker: waits for a job, processes items, reports the end.
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
  std::atomic<int64_t> next_{0};  // item that is taken next
  int64_t items_ = 0;
  std::exception_ptr failure_;
  int busy_ = 0;      // workers that have not finished the job
  uint64_t job_ = 0;  // number of jobs so far
  bool stop_ = false;
};

int cores() { return int(std::max(1u, std::thread::hardware_concurrency())); }

// The pool and its lock, which serializes jobs. Deliberately leaked: joining threads while the process unloads its
// libraries can hang.
struct Shared {
  std::mutex mutex;
  std::unique_ptr<Pool> pool = std::make_unique<Pool>(cores());
};
Shared*& shared_pointer() {
  static Shared* instance = new Shared;
  return instance;
}
Shared& shared() {
#if !defined(_WIN32)
  // A forked child has the pool's memory but none of its threads, and perhaps a lock that no thread will release. It
  // gets a new pool and lock.
  static pid_t owner = getpid();
  if (owner != getpid()) {
    owner = getpid();
    shared_pointer() = new Shared;
  }
#endif
  return *shared_pointer();
}

}  // namespace

void set_threads(int count) {
  Shared& s = shared();
  std::lock_guard lock(s.mutex);
  if (count <= 0) count = cores();
  if (count != s.pool->count()) s.pool = std::make_unique<Pool>(count);
}

int threads() {
  Shared& s = shared();
  std::lock_guard lock(s.mutex);
  return s.pool->count();
}

void parallel_for(int64_t items, const std::function<void(int64_t, int)>& body) {
  Shared& s = shared();
  std::lock_guard lock(s.mutex);
  s.pool->run(items, body);
}

}  // namespace linprim
