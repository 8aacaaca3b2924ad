// Adam's step of all weights of a network, its gradient scaled down to a bound of its norm.
#pragma once
#include "matmul.h"
#include "native.h"

namespace adam {

constexpr long MOST_LEAVES = 4 * 16 + 16, PART = 4096;  // numbers that a thread takes at once
constexpr float FIRST = 0.9f, SECOND = 0.999f, EPS = 1e-5f;

struct Call {
  long networks, leaves, parts, size[MOST_LEAVES], part_of[MOST_LEAVES];  // the first part of each leaf
  const float *rate, *bound, *from[4][MOST_LEAVES];                       // weights, moments, gradients
  const int32_t* count;
  float *to[3][MOST_LEAVES], *norm, *squares;
  int32_t* next_count;
};

// The leaf and the first number of a part.
inline long leaf_of(const Call& call, long part, long* first) {
  long leaf = 0;
  while (leaf + 1 < call.leaves && call.part_of[leaf + 1] <= part) ++leaf;
  *first = (part - call.part_of[leaf]) * PART;
  return leaf;
}

inline void task(void* data, int phase, long index) {
  const Call& call = *(const Call*)data;
  const long n = index / call.parts, part = index % call.parts;
  long first;
  const long leaf = leaf_of(call, part, &first), size = call.size[leaf], count = least(PART, size - first);
  const long at = n * size + first;
  const float* g = call.from[3][leaf] + at;
  if (phase == 0) {
    float sums[64] = {};
    long i = 0;
    for (; i + 64 <= count; i += 64) {
      for (int k = 0; k < 64; ++k) sums[k] += g[i + k] * g[i + k];
    }
    for (int k = 0; i < count; ++i, ++k) sums[k] += g[i] * g[i];
    for (int half = 32; half; half /= 2) {
      for (int k = 0; k < half; ++k) sums[k] += sums[k + half];
    }
    call.squares[n * call.parts + part] = sums[0];
    return;
  }
  float squares = 0;
  for (long k = 0; k < call.parts; ++k) squares += call.squares[n * call.parts + k];
  const float norm = __builtin_sqrtf(squares), bound = call.bound[n] / (norm < 1e-12f ? 1e-12f : norm);
  const float shrink = bound < 1 ? bound : bound != bound ? bound : 1;
  const int32_t steps = call.count[n] < INT32_MAX ? call.count[n] + 1 : INT32_MAX;
  const float first_share = 1 - __builtin_powf(FIRST, (float)steps), second_share = 1 - __builtin_powf(SECOND, (float)steps);
  const float rate = call.rate[n], first_scale = 1 / first_share, second_scale = 1 / second_share;
  const float *p = call.from[0][leaf] + at, *m = call.from[1][leaf] + at, *v = call.from[2][leaf] + at;
  float *to_p = call.to[0][leaf] + at, *to_m = call.to[1][leaf] + at, *to_v = call.to[2][leaf] + at;
#pragma GCC ivdep
  for (long i = 0; i < count; ++i) {
    const float each = g[i] * shrink;
    const float mean = (1 - FIRST) * each + FIRST * m[i], square = (1 - SECOND) * (each * each) + SECOND * v[i];
    to_m[i] = mean, to_v[i] = square;
    to_p[i] = p[i] - rate * (mean * first_scale / (__builtin_sqrtf(square * second_scale) + EPS));
  }
  if (part == 0) call.norm[n] = norm, call.next_count[n] = steps;
}

inline XLA_FFI_Error* call(XLA_FFI_CallFrame* frame) {
  Call call;
  const auto in = [&](long k) { return (const XLA_FFI_Buffer*)frame->args.args[k]; };
  const auto out = [&](long k) { return (const XLA_FFI_Buffer*)frame->rets.rets[k]; };
  const long leaves = call.leaves = (frame->args.size - 3) / 4;
  if (leaves < 1 || leaves > MOST_LEAVES || frame->args.size != 3 + 4 * leaves || frame->rets.size != 3 * leaves + 3) {
    return native::failure(frame->api, "adam_step: wrong arguments");
  }
  call.networks = native::size_of_array(in(0)), call.parts = 0;
  bool right = true;
  for (long k = 0; k < 3 + 4 * leaves; ++k) {
    right &= in(k)->dtype == (k == 2 ? XLA_FFI_DataType_S32 : XLA_FFI_DataType_F32);
    right &= native::size_of_array(in(k)) == (k < 3 ? call.networks : native::size_of_array(in(3 + (k - 3) % leaves)));
  }
  for (long leaf = 0; leaf < leaves; ++leaf) {
    call.size[leaf] = native::size_of_array(in(3 + leaf)) / call.networks;
    call.part_of[leaf] = call.parts;
    call.parts += (call.size[leaf] + PART - 1) / PART;
    for (int which = 0; which < 4; ++which) call.from[which][leaf] = (const float*)in(3 + which * leaves + leaf)->data;
    for (int which = 0; which < 3; ++which) call.to[which][leaf] = (float*)out(which * leaves + leaf)->data;
  }
  call.rate = (const float*)in(0)->data, call.bound = (const float*)in(1)->data, call.count = (const int32_t*)in(2)->data;
  call.next_count = (int32_t*)out(3 * leaves)->data, call.norm = (float*)out(3 * leaves + 1)->data;
  call.squares = (float*)out(3 * leaves + 2)->data;
  right &= native::size_of_array(out(3 * leaves + 2)) == call.networks * call.parts;
  if (!right) return native::failure(frame->api, "adam_step: wrong shapes or types");
  const long tasks = call.networks * call.parts;
  return native::run(frame, task, &call, {tasks, tasks}, 0);
}

}  // namespace adam
