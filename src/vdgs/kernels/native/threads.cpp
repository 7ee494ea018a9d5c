#include "threads.h"

#include <pthread.h>

#include <atomic>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <system_error>
#include <thread>

#if defined(__SSE__)
#include <xmmintrin.h>
#endif

namespace vdgs {
namespace {

// While it lives, numbers nearer to 0 than the least normal one (1.2e-38) count as 0 on this thread: a
// processor takes some ten times as long for each of them, and moments of what no view shows any more
// end there.
class DenormalsAreZero {
 public:
  DenormalsAreZero() : before_(get()) { set(before_ | kFlush); }
  ~DenormalsAreZero() { set(before_); }
  DenormalsAreZero(const DenormalsAreZero&) = delete;
  DenormalsAreZero& operator=(const DenormalsAreZero&) = delete;

 private:
#if defined(__SSE__)
  static constexpr unsigned kFlush = 0x8040;  // results and operands
  static unsigned get() { return _mm_getcsr(); }
  static void set(unsigned state) { _mm_setcsr(state); }
  unsigned before_;
#elif defined(__aarch64__)
  static constexpr uint64_t kFlush = 1u << 24;
  static uint64_t get() {
    uint64_t state;
    asm volatile("mrs %0, fpcr" : "=r"(state));
    return state;
  }
  static void set(uint64_t state) { asm volatile("msr fpcr, %0" : : "r"(state)); }
  uint64_t before_;
#else
  static constexpr int kFlush = 0;
  static int get() { return 0; }
  static void set(int) {}
  int before_;
#endif
};

struct Job {
  int64_t n_tasks;
  detail::Task task;
  const void* body;
  int helpers_wanted;
  int helpers_working = 0;  // guarded by Pool::mutex
  std::atomic<int64_t> next{0};
  std::exception_ptr error{};  // guarded by Pool::mutex
};

struct Pool {
  std::mutex one_call;  // held by the thread whose call the pool serves
  std::mutex mutex;
  std::condition_variable work_arrived, helpers_left;
  Job* job = nullptr;
  uint64_t job_number = 0;
  int workers = 0;
};

std::atomic<int> thread_limit{1};

// Never destroyed: workers sleep in it until the process ends, whichever way that is.
std::atomic<Pool*> pool{nullptr};
thread_local bool inside_task = false;

void work(Pool& p, Job& job) {
  const DenormalsAreZero zero;
  inside_task = true;
  try {
    for (int64_t i; (i = job.next.fetch_add(1, std::memory_order_relaxed)) < job.n_tasks;)
      job.task(job.body, i);
  } catch (...) {
    job.next.store(job.n_tasks, std::memory_order_relaxed);
    const std::lock_guard<std::mutex> lock(p.mutex);
    if (!job.error) job.error = std::current_exception();
  }
  inside_task = false;
}

void worker_loop(Pool& p) {
  uint64_t seen = 0;
  std::unique_lock<std::mutex> lock(p.mutex);
  for (;;) {
    p.work_arrived.wait(lock, [&] { return p.job && p.job_number != seen; });
    seen = p.job_number;
    Job& job = *p.job;
    if (job.helpers_working >= job.helpers_wanted) continue;
    ++job.helpers_working;
    lock.unlock();
    work(p, job);
    lock.lock();
    if (--job.helpers_working == 0) p.helpers_left.notify_one();
  }
}

void start_workers(Pool& p, int wanted) {
  for (; p.workers < wanted; ++p.workers) {
    try {
      std::thread(worker_loop, std::ref(p)).detach();
    } catch (const std::system_error&) {
      return;  // no more threads to be had: those that there are do the work
    }
  }
}

// A fork copies only the calling thread. The child leaves the old pool, whose workers it lacks and
// whose locks may be held, and makes another when it needs one.
void forget_pool_in_child() {
  pool.store(nullptr);
  inside_task = false;
}

Pool& the_pool() {
  static const int registered = pthread_atfork(nullptr, nullptr, forget_pool_in_child);
  static_cast<void>(registered);
  Pool* p = pool.load();
  if (!p) {
    Pool* fresh = new Pool;
    if (pool.compare_exchange_strong(p, fresh)) return *fresh;
    delete fresh;
  }
  return *p;
}

void run_alone(int64_t n_tasks, detail::Task task, const void* body) {
  const DenormalsAreZero zero;
  for (int64_t i = 0; i < n_tasks; ++i) task(body, i);
}

}  // namespace

void set_threads(int count) { thread_limit.store(std::max(1, count)); }
int threads() { return thread_limit.load(); }

void detail::run(int64_t n_tasks, Task task, const void* body) {
  const int helpers = static_cast<int>(std::min<int64_t>(threads(), n_tasks)) - 1;
  if (helpers <= 0 || inside_task) return run_alone(n_tasks, task, body);
  Pool& p = the_pool();
  const std::unique_lock<std::mutex> served(p.one_call, std::try_to_lock);
  if (!served.owns_lock()) return run_alone(n_tasks, task, body);

  Job job{n_tasks, task, body, helpers};
  {
    const std::lock_guard<std::mutex> lock(p.mutex);
    start_workers(p, helpers);
    p.job = &job;
    ++p.job_number;
  }
  if (helpers == 1)
    p.work_arrived.notify_one();
  else
    p.work_arrived.notify_all();
  work(p, job);
  {
    // From here nobody may join; only those who did are waited for, so that a worker that the
    // system has not woken yet never delays the call.
    std::unique_lock<std::mutex> lock(p.mutex);
    p.job = nullptr;
    p.helpers_left.wait(lock, [&] { return job.helpers_working == 0; });
  }
  if (job.error) std::rethrow_exception(job.error);
}

}  // namespace vdgs
