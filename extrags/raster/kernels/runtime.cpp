#include "runtime.h"

#include <pthread.h>
#include <sched.h>
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdlib>
#include <exception>
#include <mutex>
#include <new>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace extrags {

void advise_huge_pages(void* data, size_t bytes) {
#if defined(__linux__)
  constexpr uintptr_t kHugePage = 2 << 20;
  const uintptr_t begin = (reinterpret_cast<uintptr_t>(data) + kHugePage - 1) / kHugePage * kHugePage;
  const uintptr_t end = (reinterpret_cast<uintptr_t>(data) + bytes) / kHugePage * kHugePage;
  // Advice only: where the system does not take it, pages stay small.
  if (end > begin) madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
#else
  (void)data;
  (void)bytes;
#endif
}

void reserve(Buffer* buffer, size_t bytes) {
  if (bytes <= buffer->capacity) return;
  const size_t wanted = (bytes + bytes / 4 + 4095) / 4096 * 4096;
  void* fresh = std::aligned_alloc(64, wanted);
  if (fresh == nullptr) throw std::bad_alloc();
  advise_huge_pages(fresh, wanted);
  std::free(buffer->data);
  buffer->data = fresh;
  buffer->capacity = wanted;
}

void release(Buffer* buffer) {
  std::free(buffer->data);
  *buffer = Buffer{nullptr, 0};
}

void check_countable(uint64_t count, const char* entries) {
  if (count <= UINT32_MAX) return;
  throw std::overflow_error(std::to_string(count) + " pairs of " + entries + ", and the kernels take at most " +
                            std::to_string(UINT32_MAX) + ": take fewer or smaller Gaussians, or a smaller image");
}

namespace {

void relax() {
#if defined(__x86_64__)
  _mm_pause();
#else
  std::this_thread::yield();
#endif
}

// Threads that claim tasks one by one. The caller works too and waits only for tasks somebody has claimed:
// when a neighbour holds the other cores it goes on alone instead of waiting at a barrier.
class Pool {
 public:
  void run(int threads, int count, Task task, void* context) {
    start_workers(threads - 1);
    task_ = task;
    context_ = context;
    done_.store(0, std::memory_order_relaxed);
    failed_.store(false, std::memory_order_relaxed);
    failure_ = nullptr;
    const uint64_t epoch = epoch_.load(std::memory_order_relaxed) + 1;
    helpers_.store(threads - 1, std::memory_order_relaxed);
    ticket_.store(pack(epoch, count, 0), std::memory_order_release);
    epoch_.store(epoch, std::memory_order_seq_cst);
    if (sleepers_.load(std::memory_order_seq_cst) > 0) {
      { std::lock_guard<std::mutex> lock(mutex_); }
      wake_.notify_all();
    }
    drain(epoch, 0);
    for (int spins = 0; done_.load(std::memory_order_acquire) < count; ++spins) {
      if (spins < 2000) {
        relax();
      } else {
        std::this_thread::yield();
      }
    }
    if (failed_.load(std::memory_order_acquire)) std::rethrow_exception(failure_);
  }

 private:
  // epoch:20 | count:22 | next:22. The epoch makes a late worker's claim fail.
  static uint64_t pack(uint64_t epoch, uint64_t count, uint64_t next) {
    return (epoch & 0xfffff) << 44 | count << 22 | next;
  }

  void start_workers(int wanted) {
    while (static_cast<int>(workers_.size()) < wanted) {
      const int slot = static_cast<int>(workers_.size()) + 1;
      workers_.emplace_back([this, slot] { work(slot); });
    }
  }

  void drain(uint64_t epoch, int slot) {
    uint64_t ticket = ticket_.load(std::memory_order_acquire);
    for (;;) {
      const uint64_t count = ticket >> 22 & 0x3fffff, next = ticket & 0x3fffff;
      if (ticket >> 44 != (epoch & 0xfffff) || next >= count) return;
      if (!ticket_.compare_exchange_weak(ticket, ticket + 1, std::memory_order_acq_rel)) continue;
      try {
        task_(context_, static_cast<int>(next), slot);
      } catch (...) {
        if (!failed_.exchange(true)) failure_ = std::current_exception();
      }
      done_.fetch_add(1, std::memory_order_acq_rel);
      ticket = ticket_.load(std::memory_order_acquire);
    }
  }

  void work(int slot) {
    uint64_t last = 0;
    for (;;) {
      wait_for_work(last);
      last = epoch_.load(std::memory_order_acquire);
      if (slot <= helpers_.load(std::memory_order_relaxed)) drain(last, slot);
    }
  }

  void wait_for_work(uint64_t last) {
    using clock = std::chrono::steady_clock;
    // Longer than what Python does between two kernels of a training step: being woken costs more than waiting.
    const auto give_up = clock::now() + std::chrono::microseconds(200);
    for (int spins = 1; epoch_.load(std::memory_order_acquire) == last; ++spins) {
      relax();
      if (spins % 64 != 0 || clock::now() < give_up) continue;
      std::unique_lock<std::mutex> lock(mutex_);
      sleepers_.fetch_add(1, std::memory_order_seq_cst);
      wake_.wait(lock, [&] { return epoch_.load(std::memory_order_seq_cst) != last; });
      sleepers_.fetch_sub(1, std::memory_order_seq_cst);
    }
  }

  std::atomic<uint64_t> ticket_{0}, epoch_{0};
  std::atomic<int> done_{0}, sleepers_{0}, helpers_{0};
  std::atomic<bool> failed_{false};
  std::exception_ptr failure_;
  Task task_ = nullptr;
  void* context_ = nullptr;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::vector<std::thread> workers_;
};

// Never destroyed: workers sleep in it until the process ends.
std::atomic<Pool*> pool{nullptr};
std::atomic_flag pool_busy = ATOMIC_FLAG_INIT;
std::atomic<int> thread_limit{0};

// A forked child has none of the threads; it starts its own.
void forget_pool() {
  pool.store(nullptr);
  pool_busy.clear();
}

int default_threads() {
  int cores = static_cast<int>(std::thread::hardware_concurrency());
#if defined(__linux__)
  cpu_set_t mask;
  if (sched_getaffinity(0, sizeof mask, &mask) == 0) cores = CPU_COUNT(&mask);
#endif
  return cores < 1 ? 1 : cores > 8 ? 8 : cores;
}

}  // namespace

double monotonic_seconds() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

void set_num_threads(int count) {
  thread_limit.store(count < 1 ? 1 : count > kMaxThreads ? kMaxThreads : count);
}

int num_threads() {
  static const int standard = default_threads();
  const int limit = thread_limit.load();
  return limit > 0 ? limit : standard;
}

void parallel_for(int count, Task task, void* context) {
  const int threads = num_threads() < count ? num_threads() : count;
  if (threads <= 1 || pool_busy.test_and_set(std::memory_order_acquire)) {
    for (int i = 0; i < count; ++i) task(context, i, 0);
    return;
  }
  struct Unlock {
    ~Unlock() { pool_busy.clear(std::memory_order_release); }
  } unlock;
  if (pool.load() == nullptr) {
    static const int registered = pthread_atfork(nullptr, nullptr, forget_pool);
    (void)registered;
    pool.store(new Pool);
  }
  pool.load()->run(threads, count, task, context);
}

}  // namespace extrags
