// One control step of each world: block b of 32 threads steps world b. See threads_step.h.
#include "threads_step.h"

DEVICE bool is_sound(const float* x, int size, int lane) {
  bool sound = true;
  ROLLED for (int i = lane; i < size; i += THREADS) sound = sound && is_finite(x[i]);
  return sound;
}

// Arguments: the arrays' addresses, batches of rows. Readouts follow in the order of the tables.
// Of wide models memory has room for few worlds at a time, so their threads may have more registers.
extern "C" __global__ void __launch_bounds__(THREADS, BLOCKS * THREADS / LANES)
fused_step(const float* __restrict__ qpos, const float* __restrict__ qvel, const float* __restrict__ warmstart,
           const float* __restrict__ ctrl, float* new_qpos, float* new_qvel, float* new_warmstart,
           float* overflow READING_PARAMETERS) {
  __shared__ World w;
  const int lane = int(threadIdx.x);
  const long long world = blockIdx.x;
  qpos += world * NQ;
  qvel += world * NV;
  warmstart += world * NV;
  ctrl += world * NU;
  new_qpos += world * NQ;
  new_qvel += world * NV;
  new_warmstart += world * NV;
  const Outputs out = {{READING_ADDRESSES}};
  const bool sound = is_sound(qpos, NQ, lane) && is_sound(qvel, NV, lane) && is_sound(warmstart, NV, lane) &&
                     is_sound(ctrl, NU, lane);
  if (!__all_sync(0xffffffffu, sound)) {  // broken before the step: all of it is not a number, and nothing else is
    const float nan = __int_as_float(0x7fc00000);
    ROLLED for (int i = lane; i < NQ; i += THREADS) new_qpos[i] = nan;
    ROLLED for (int i = lane; i < NV; i += THREADS) new_qvel[i] = new_warmstart[i] = nan;
    repeat<0, READINGS>([&](auto r) {
      ROLLED for (int i = lane; i < READING_COUNT[r] * READING_WIDTH[r]; i += THREADS) out.reading[r][i] = nan;
    });
    if (lane == 0) overflow[world] = 0;
    return;
  }
  clear(w);
  ROLLED for (int i = lane; i < NQ; i += THREADS) w.qpos[i] = qpos[i];
  EACH_LANE if (lane < NV) {
    w.qvel[lane] = qvel[lane];
    w.qacc[lane] = warmstart[lane];
  }
  load_controls(w, ctrl);
  MEET();
  bool lost = false;
  control_step(w, out, lost);
  ROLLED for (int i = lane; i < NQ; i += THREADS) new_qpos[i] = w.qpos[i];
  EACH_LANE if (lane < NV) {
    new_qvel[lane] = w.qvel[lane];
    new_warmstart[lane] = w.qacc[lane];
  }
  if (lane == 0) overflow[world] = lost ? 1.0f : 0.0f;
}
