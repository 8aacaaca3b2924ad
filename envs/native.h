// What C++ code needs that XLA calls (its foreign-function interface in plain C, so no C++ library is needed): the
// version of the interface, errors, arrays, and work that the threads of XLA's pool share.
#pragma once
#include <sched.h>
#include <stdint.h>
#include <stdlib.h>
#include <time.h>

#include "xla/ffi/api/c_api.h"

#define EXPORTED extern "C" __attribute__((visibility("default")))

namespace native {

inline XLA_FFI_Error* failure(const XLA_FFI_Api* api, const char* text) {
  XLA_FFI_Error_Create_Args args = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, nullptr, text,
                                    XLA_FFI_Error_Code_INVALID_ARGUMENT};
  return api->XLA_FFI_Error_Create(&args);
}

// Whether a call failed; its error is dropped.
inline bool failed(const XLA_FFI_Api* api, XLA_FFI_Error* error) {
  if (!error) return false;
  XLA_FFI_Error_Destroy_Args args = {XLA_FFI_Error_Destroy_Args_STRUCT_SIZE, nullptr, error};
  api->XLA_FFI_Error_Destroy(&args);
  return true;
}

// XLA asks for the version of the interface when the function is registered.
inline bool is_query(XLA_FFI_CallFrame* frame) {
  for (auto* base = frame->extension_start; base; base = base->next) {  // whose type has two names
    if (base->type != XLA_FFI_Extension_Metadata) continue;
    XLA_FFI_Metadata* metadata = ((XLA_FFI_Metadata_Extension*)base)->metadata;
    metadata->api_version.major_version = XLA_FFI_API_MAJOR;
    metadata->api_version.minor_version = XLA_FFI_API_MINOR;
    metadata->traits = 0;
    return true;
  }
  return false;
}

inline long size_of_array(const XLA_FFI_Buffer* buffer) {
  long total = 1;
  for (long d = 0; d < buffer->rank; ++d) total *= buffer->dims[d];
  return total;
}

// A call's attribute, a whole number; they lie in the order of their names.
inline long attribute(const XLA_FFI_CallFrame* frame, long which) {
  return *(const int64_t*)((const XLA_FFI_Scalar*)frame->attrs.attrs[which])->value;
}

inline long pool_size(XLA_FFI_CallFrame* frame) {
  int64_t size = 1;
  XLA_FFI_ThreadPool_NumThreads_Args args = {XLA_FFI_ThreadPool_NumThreads_Args_STRUCT_SIZE, nullptr, frame->ctx, &size};
  return failed(frame->api, frame->api->XLA_FFI_ThreadPool_NumThreads(&args)) ? 1 : size;
}

// Phases of tasks that threads take until none is left. Who calls works, too, and waits only for tasks that somebody
// works on: a busy pool makes it slower but cannot block it. Helpers may come late, so the last to leave frees it.
struct Job {
  static constexpr int MOST = 4;
  struct Phase {
    long next, done;  // atomic
    long tasks;
  };
  long users;  // atomic
  int phases;
  Phase phase[MOST];
  void (*task)(void* data, int phase, long index);
  void* data;  // read only by those who have a task

  void work() {
    for (int p = 0; p < phases; ++p) {
      for (long index; (index = __atomic_fetch_add(&phase[p].next, 1, __ATOMIC_RELAXED)) < phase[p].tasks;) {
        task(data, p, index);
        __atomic_fetch_add(&phase[p].done, 1, __ATOMIC_RELEASE);
      }
      for (long turn = 0; __atomic_load_n(&phase[p].done, __ATOMIC_ACQUIRE) < phase[p].tasks; ++turn) {
        if (turn > 1000) sched_yield();
      }
    }
  }
  void leave() {
    if (__atomic_fetch_sub(&users, 1, __ATOMIC_ACQ_REL) == 1) free(this);
  }
};

// A thread that has helped stays for a moment, as waking one takes longer than many calls do. It sits where callers find
// it; a caller that leaves a job there leaves a use of it, too.
constexpr int SEATS = 64;
constexpr long MOMENT = 60000;  // nanoseconds
struct Seat {
  long taken;  // atomic
  Job* job;    // atomic
};
static Seat seats[SEATS];

inline long nanoseconds() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return now.tv_sec * 1000000000L + now.tv_nsec;
}

inline void pause_a_little() {
#if defined(__x86_64__)
  for (int k = 0; k < 16; ++k) __builtin_ia32_pause();
#endif
}

// Does the job that somebody left at a seat, if there is one.
inline bool serve(Seat& seat) {
  Job* job = __atomic_exchange_n(&seat.job, nullptr, __ATOMIC_ACQ_REL);
  if (!job) return false;
  job->work();
  job->leave();
  return true;
}

inline void help(void* data) {
  Job* job = (Job*)data;
  job->work();
  job->leave();
  for (Seat& seat : seats) {
    if (__atomic_exchange_n(&seat.taken, 1, __ATOMIC_ACQ_REL)) continue;
    for (long until = nanoseconds() + MOMENT; nanoseconds() < until; pause_a_little()) {
      if (serve(seat)) until = nanoseconds() + MOMENT;
      else sched_yield();
    }
    __atomic_store_n(&seat.taken, 0, __ATOMIC_RELEASE);
    serve(seat);
    return;
  }
}

// Leaves the job at up to `count` seats where threads wait; returns at how many.
inline long leave_at_seats(Job* job, long count) {
  long left = 0;
  for (int k = 0; k < SEATS && left < count; ++k) {
    Job* nothing = nullptr;
    if (!__atomic_load_n(&seats[k].taken, __ATOMIC_ACQUIRE)) continue;
    __atomic_fetch_add(&job->users, 1, __ATOMIC_RELAXED);
    if (__atomic_compare_exchange_n(&seats[k].job, &nothing, job, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED)) ++left;
    else job->leave();
  }
  return left;
}

// Takes back what nobody has found.
inline void clear_seats(Job* job) {
  for (Seat& seat : seats) {
    Job* mine = job;
    if (__atomic_load_n(&seat.job, __ATOMIC_RELAXED) != job) continue;
    if (__atomic_compare_exchange_n(&seat.job, &mine, nullptr, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED)) job->leave();
  }
}

// Runs all tasks of each phase after those of the phase before, on up to `threads` of XLA's pool, all of them if 0.
template <int PHASES>
XLA_FFI_Error* run(XLA_FFI_CallFrame* frame, void (*task)(void*, int, long), void* data, const long (&tasks)[PHASES],
                   long threads) {
  static_assert(PHASES <= Job::MOST);
  Job* job = (Job*)calloc(1, sizeof(Job));
  if (!job) return failure(frame->api, "no memory");
  job->users = 1, job->phases = PHASES, job->task = task, job->data = data;
  const long pool = pool_size(frame);
  long helpers = 0;
  for (int p = 0; p < PHASES; ++p) {
    job->phase[p].tasks = tasks[p];
    if (helpers < tasks[p]) helpers = tasks[p];
  }
  if (threads <= 0 || threads > pool) threads = pool;
  if (helpers > threads) helpers = threads;
  for (long k = 1 + leave_at_seats(job, helpers - 1); k < helpers; ++k) {
    __atomic_fetch_add(&job->users, 1, __ATOMIC_RELAXED);
    XLA_FFI_ThreadPool_Schedule_Args args = {XLA_FFI_ThreadPool_Schedule_Args_STRUCT_SIZE, nullptr, frame->ctx, help,
                                             job};
    if (failed(frame->api, frame->api->XLA_FFI_ThreadPool_Schedule(&args))) job->leave();
  }
  job->work();
  clear_seats(job);
  job->leave();
  return nullptr;
}

}  // namespace native
