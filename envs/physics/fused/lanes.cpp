// A batch of control steps over threads, as a function that XLA calls. Arrays outside are float or double; inside all
// is Real.
#include "lanes.h"
#include "native.h"

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
    set_lane(w.drive[k], lane, motor.gain * given);
    if (!SERVOS) {
      Num& force = w.motor[motor.dof];
      set_lane(force, lane, ::lane(force, lane) + motor.gear * motor.gain * given);
    }
    zero += 0 * wanted;
  }
  set_lane(w.overflow, lane, 0);
  return zero == 0;
}

template <class Outside> void store(const Num* from, int lane, int size, Real broken, Outside* to) {
  for (int k = 0; k < size; ++k) to[k] = Outside(::lane(from[k], lane) + broken);
}

__attribute__((noinline)) void step(Worlds& w, long substeps) { control_step(w, substeps); }

// -- a batch --

struct Batch {
  long worlds, substeps;
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
    step(w, substeps);
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
};

void advance(void* data, int, long group) {
  const Batch& batch = *(const Batch*)data;
  if (batch.single) batch.advance<float>(group);
  else batch.advance<double>(group);
}

// The memory of an array [worlds, size] of the batch, of any rank; null if it is not one.
void* memory_of(const XLA_FFI_Buffer* buffer, int size, XLA_FFI_DataType dtype, long worlds) {
  return buffer->dtype == dtype && native::size_of_array(buffer) == worlds * size ? buffer->data : nullptr;
}

}  // namespace

// Operands qpos, qvel, warm start and controls; results: the new ones, readouts and overflow; attributes `substeps` and
// `threads`.
EXPORTED XLA_FFI_Error* fused_step(XLA_FFI_CallFrame* frame) {
  if (native::is_query(frame)) return nullptr;
  if (frame->args.size != OPERANDS || frame->rets.size != RESULTS || frame->attrs.size != 2 ||
      frame->attrs.types[0] != XLA_FFI_AttrType_SCALAR || frame->attrs.types[1] != XLA_FFI_AttrType_SCALAR) {
    return native::failure(frame->api, "fused_step: wrong arguments");
  }
  const XLA_FFI_Buffer* qpos = (const XLA_FFI_Buffer*)frame->args.args[0];
  Batch batch = {1, native::attribute(frame, 0), qpos->dtype == XLA_FFI_DataType_F32, {}, {}};
  for (long d = 0; d + 1 < qpos->rank; ++d) batch.worlds *= qpos->dims[d];
  const XLA_FFI_DataType dtype = batch.single ? XLA_FFI_DataType_F32 : XLA_FFI_DataType_F64;
  bool right = true;
  for (int k = 0; k < OPERANDS; ++k) {
    batch.operands[k] = memory_of((const XLA_FFI_Buffer*)frame->args.args[k], OPERAND_SIZES[k], dtype, batch.worlds);
    right &= batch.operands[k] || !OPERAND_SIZES[k] || !batch.worlds;
  }
  for (int k = 0; k < RESULTS; ++k) {
    batch.results[k] = memory_of((const XLA_FFI_Buffer*)frame->rets.rets[k], RESULT_SIZES[k], dtype, batch.worlds);
    right &= batch.results[k] || !RESULT_SIZES[k] || !batch.worlds;
  }
  if (!right) return native::failure(frame->api, "fused_step: wrong shapes or types");
  return native::run(frame, advance, &batch, {(batch.worlds + LANES - 1) / LANES}, native::attribute(frame, 1));
}
