// A batch of control steps over threads, as a function that XLA calls (its foreign-function interface in plain C, so no
// C++ library is needed). Arrays outside are float or double; inside all is Real.
#include <sched.h>
#include <stdlib.h>

#include "lanes.h"
#include "xla/ffi/api/c_api.h"

namespace {

enum { QPOS, QVEL, WARMSTART, CTRL, OPERANDS };
enum { NEW_QPOS, NEW_QVEL, NEW_WARMSTART, READOUTS, OVERFLOW_FLAG, RESULTS };
constexpr int OPERAND_SIZES[OPERANDS] = {NQ, NV, NV, NU};
constexpr int RESULT_SIZES[RESULTS] = {NQ, NV, NV, WIDTH, 1};

// -- a group of worlds --

template <class Outside> bool load(Worlds& w, int lane, const Outside* qpos, const Outside* qvel, const Outside* warm,
                                   const Outside* ctrl) {
  Real zero = 0;  // NaN if any input is not finite
  for (int k = 0; k < NQ; ++k) {
    set_lane(w.qpos[k], lane, qpos[k]);
    zero += 0 * Real(qpos[k]);
  }
  for (int k = 0; k < NV; ++k) {
    set_lane(w.qvel[k], lane, qvel[k]);
    set_lane(w.acceleration[k], lane, warm[k]);
    set_lane(w.motor[k], lane, 0);
    zero += 0 * (Real(qvel[k]) + Real(warm[k]));
  }
  for (int k = 0; k < NU; ++k) {
    const MotorRow& motor = MOTORS[k];
    const Real wanted = ctrl[k];
    const Real given = wanted < motor.low ? motor.low : wanted > motor.high ? motor.high : wanted;
    Num& force = w.motor[motor.dof];
    set_lane(force, lane, ::lane(force, lane) + motor.gain * given);
    zero += 0 * wanted;
  }
  set_lane(w.overflow, lane, 0);
  return zero == 0;
}

template <class Outside> void store(const Num* from, int lane, int size, Real broken, Outside* to) {
  for (int k = 0; k < size; ++k) to[k] = Outside(::lane(from[k], lane) + broken);
}

__attribute__((noinline)) void step(Worlds& w) { control_step(w); }

// -- a batch --

// Threads take groups of it until none is left. Who calls works, too, and waits only for groups that somebody works on:
// a busy pool makes it slower but cannot block it. Helpers may come late, so the last to leave frees it.
struct Job {
  long next, done, users;  // atomic
  long worlds, groups;
  bool single;
  const void* operands[OPERANDS];
  void* results[RESULTS];

  template <class Outside> const Outside* in(int which, long world) const {
    return (const Outside*)operands[which] + OPERAND_SIZES[which] * world;
  }
  template <class Outside> Outside* out(int which, long world) const {
    return (Outside*)results[which] + RESULT_SIZES[which] * world;
  }

  template <class Outside> void advance(long group) const {
    static thread_local Worlds w;
    const long first = group * LANES;
    bool sound[LANES];
    for (int i = 0; i < LANES; ++i) {  // an incomplete group is filled up with copies of its first world
      const long r = first + i < worlds ? first + i : first;
      sound[i] = load(w, i, in<Outside>(QPOS, r), in<Outside>(QVEL, r), in<Outside>(WARMSTART, r), in<Outside>(CTRL, r));
    }
    step(w);
    for (int i = 0; i < LANES && first + i < worlds; ++i) {
      const long r = first + i;
      const Real broken = sound[i] ? 0 : NAN;
      store(w.qpos, i, NQ, broken, out<Outside>(NEW_QPOS, r));
      store(w.qvel, i, NV, broken, out<Outside>(NEW_QVEL, r));
      store(w.acceleration, i, NV, broken, out<Outside>(NEW_WARMSTART, r));
      store(w.out, i, WIDTH, broken, out<Outside>(READOUTS, r));
      store(&w.overflow, i, 1, 0, out<Outside>(OVERFLOW_FLAG, r));
    }
  }

  void work() {
    for (long group; (group = __atomic_fetch_add(&next, 1, __ATOMIC_RELAXED)) < groups;) {
      if (single) advance<float>(group);
      else advance<double>(group);
      __atomic_fetch_add(&done, 1, __ATOMIC_RELEASE);
    }
  }

  void enter() { __atomic_fetch_add(&users, 1, __ATOMIC_RELAXED); }
  void leave() {
    if (__atomic_fetch_sub(&users, 1, __ATOMIC_ACQ_REL) == 1) free(this);
  }

  void wait() const {
    for (long turn = 0; __atomic_load_n(&done, __ATOMIC_ACQUIRE) < groups; ++turn) {
      if (turn > 1000) sched_yield();
    }
  }
};

void help(void* data) {
  Job* job = (Job*)data;
  job->work();
  job->leave();
}

// -- XLA --

XLA_FFI_Error* failure(const XLA_FFI_Api* api, const char* text) {
  XLA_FFI_Error_Create_Args args = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, nullptr, text,
                                    XLA_FFI_Error_Code_INVALID_ARGUMENT};
  return api->XLA_FFI_Error_Create(&args);
}

// Whether a call failed; its error is dropped.
bool failed(const XLA_FFI_Api* api, XLA_FFI_Error* error) {
  if (!error) return false;
  XLA_FFI_Error_Destroy_Args args = {XLA_FFI_Error_Destroy_Args_STRUCT_SIZE, nullptr, error};
  api->XLA_FFI_Error_Destroy(&args);
  return true;
}

// XLA asks for the version of the interface when the function is registered.
bool is_query(XLA_FFI_CallFrame* frame) {
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

// The memory of an array [worlds, size] of the batch, of any rank; null if it is not one.
void* memory_of(const XLA_FFI_Buffer* buffer, int size, XLA_FFI_DataType dtype, long worlds) {
  long total = 1;
  for (long d = 0; d < buffer->rank; ++d) total *= buffer->dims[d];
  return buffer->dtype == dtype && total == worlds * size ? buffer->data : nullptr;
}

long pool_size(XLA_FFI_CallFrame* frame) {
  int64_t size = 1;
  XLA_FFI_ThreadPool_NumThreads_Args args = {XLA_FFI_ThreadPool_NumThreads_Args_STRUCT_SIZE, nullptr, frame->ctx, &size};
  return failed(frame->api, frame->api->XLA_FFI_ThreadPool_NumThreads(&args)) ? 1 : size;
}

void run(XLA_FFI_CallFrame* frame, Job* job, long threads) {
  const long pool = pool_size(frame);
  long helpers = threads > 0 && threads < pool ? threads : pool;
  if (helpers > job->groups) helpers = job->groups;
  for (long k = 1; k < helpers; ++k) {
    job->enter();
    XLA_FFI_ThreadPool_Schedule_Args args = {XLA_FFI_ThreadPool_Schedule_Args_STRUCT_SIZE, nullptr, frame->ctx, help,
                                             job};
    if (failed(frame->api, frame->api->XLA_FFI_ThreadPool_Schedule(&args))) job->leave();
  }
  job->work();
  job->wait();
  job->leave();
}

}  // namespace

// Operands qpos, qvel, warm start and controls; results: the new ones, readouts and overflow; attribute `threads`.
extern "C" __attribute__((visibility("default"))) XLA_FFI_Error* fused_step(XLA_FFI_CallFrame* frame) {
  if (is_query(frame)) return nullptr;
  if (frame->args.size != OPERANDS || frame->rets.size != RESULTS || frame->attrs.size != 1 ||
      frame->attrs.types[0] != XLA_FFI_AttrType_SCALAR) {
    return failure(frame->api, "fused_step: wrong arguments");
  }
  const XLA_FFI_Buffer* qpos = (const XLA_FFI_Buffer*)frame->args.args[0];
  long worlds = 1;
  for (long d = 0; d + 1 < qpos->rank; ++d) worlds *= qpos->dims[d];
  Job* job = (Job*)calloc(1, sizeof(Job));
  if (!job) return failure(frame->api, "fused_step: no memory");
  job->users = 1, job->worlds = worlds, job->groups = (worlds + LANES - 1) / LANES;
  job->single = qpos->dtype == XLA_FFI_DataType_F32;
  const XLA_FFI_DataType dtype = job->single ? XLA_FFI_DataType_F32 : XLA_FFI_DataType_F64;
  bool right = true;
  for (int k = 0; k < OPERANDS; ++k) {
    job->operands[k] = memory_of((const XLA_FFI_Buffer*)frame->args.args[k], OPERAND_SIZES[k], dtype, worlds);
    right &= job->operands[k] || !OPERAND_SIZES[k] || !worlds;
  }
  for (int k = 0; k < RESULTS; ++k) {
    job->results[k] = memory_of((const XLA_FFI_Buffer*)frame->rets.rets[k], RESULT_SIZES[k], dtype, worlds);
    right &= job->results[k] || !RESULT_SIZES[k] || !worlds;
  }
  if (!right) {
    job->leave();
    return failure(frame->api, "fused_step: wrong shapes or types");
  }
  run(frame, job, *(const int64_t*)((const XLA_FFI_Scalar*)frame->attrs.attrs[0])->value);
  return nullptr;
}
