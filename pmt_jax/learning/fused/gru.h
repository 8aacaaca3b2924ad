// A gated recurrent unit over whole sequences (`maths/gru.py`): all its steps in one call, and their gradient. A task
// has some sequences of one network; what the other weights need is summed by XLA afterwards.
#pragma once
#include "activations.h"
#include "matmul.h"
#include "native.h"

namespace gru {

constexpr long SEQUENCES = 6;  // of a task

// Arrays have a leading [networks]. saved: r, z, n and what r multiplies, [sequences, steps, 4, width].
struct Call {
  long networks, sequences, steps, width;
  const float *gates, *hidden, *going, *kernel, *bias;
  const float *gradient, *states, *saved;
  float *new_states, *new_saved, *gate_gradient, *inner_gradient, *packed;

  long tasks() const { return (sequences + SEQUENCES - 1) / SEQUENCES; }
  long packed_size() const { return 3 * width * wide(width); }
};

FUNCTION Num part(const float* from, long count) {
  Num x(0);
  memcpy(&x, from, least(count, LANES) * sizeof(float));
  return x;
}
FUNCTION void put(float* to, Num x, long count) { memcpy(to, &x, least(count, LANES) * sizeof(float)); }
FUNCTION Num sigmoid(Num x) {
  const Num half(Real(0.5));
  return half + half * hyperbolic_tangent(half * x);
}

// The kernel of each gate, or its transpose, as products read them.
inline void pack_task(const Call& call, long index, bool turned) {
  const long n = index / 3, gate = index % 3, h = call.width;
  const float* from = call.kernel + n * 3 * h * h + gate * h;
  pack(from, turned ? 1 : 3 * h, turned ? 3 * h : 1, h, h, call.packed + n * call.packed_size() + gate * h * wide(h));
}

inline void add_product(const float* a, const float* packed, float* c, long rows, long width) {
  const long stride = wide(width);
  for (long first = 0; first < stride; first += PANEL * LANES) {
    const long columns = least(PANEL * LANES, stride - first);
    strip(columns / LANES, a, stride, 1, packed + first * width, columns, c + first, stride, rows, width, true);
  }
}

inline void forward(const Call& call, long n, long first, long rows, float* block) {
  const long h = call.width, stride = wide(h), size = rows * stride;
  float *state = block, *inner = block + size;
  for (long r = 0; r < rows; ++r) {
    const float* from = call.hidden + (n * call.sequences + first + r) * h;
    for (long j = 0; j < stride; ++j) state[r * stride + j] = j < h ? from[j] : 0;
  }
  for (long t = 0; t < call.steps; ++t) {
    for (long g = 0; g < 3; ++g) {
      multiply(state, stride, call.packed + n * call.packed_size() + g * h * stride, inner + g * size, rows, h, stride);
    }
    for (long r = 0; r < rows; ++r) {
      const long at = (n * call.sequences + first + r) * call.steps + t;
      const float *gates = call.gates + at * 3 * h, *bias = call.bias + n * h;
      float* saved = call.new_saved + at * 4 * h;
      for (long j = 0; j < h; j += LANES) {
        const long k = r * stride + j, count = h - j;
        const Num reset = sigmoid(part(gates + j, count) + load(inner + k));
        const Num update = sigmoid(part(gates + h + j, count) + load(inner + size + k));
        const Num own = load(inner + 2 * size + k) + part(bias + j, count);
        const Num fresh = hyperbolic_tangent(part(gates + 2 * h + j, count) + reset * own);
        const Num after = (Num(1) - update) * fresh + update * load(state + k);
        put(saved + j, reset, count), put(saved + h + j, update, count);
        put(saved + 2 * h + j, fresh, count), put(saved + 3 * h + j, own, count);
        put(call.new_states + at * h + j, after, count);
        store(state + k, call.going[at] != 0 ? after : Num(0));
      }
    }
  }
}

inline void backward(const Call& call, long n, long first, long rows, float* block) {
  const long h = call.width, stride = wide(h), size = rows * stride;
  float *later = block, *inner = block + size;
  for (long k = 0; k < 4 * size; ++k) block[k] = 0;
  for (long t = call.steps - 1; t >= 0; --t) {
    for (long r = 0; r < rows; ++r) {
      const long sequence = n * call.sequences + first + r, at = sequence * call.steps + t;
      const float *saved = call.saved + at * 4 * h, *before = t ? call.states + (at - 1) * h : call.hidden + sequence * h;
      const bool begins = t && call.going[at - 1] == 0, ends = call.going[at] == 0;
      float* gates = call.gate_gradient + at * 3 * h;
      for (long j = 0; j < h; j += LANES) {
        const long k = r * stride + j, count = h - j;
        const Num reset = part(saved + j, count), update = part(saved + h + j, count);
        const Num fresh = part(saved + 2 * h + j, count), own = part(saved + 3 * h + j, count);
        const Num old = begins ? Num(0) : part(before + j, count);
        const Num all = part(call.gradient + at * h + j, count) + (ends ? Num(0) : load(later + k));
        const Num to_fresh = all * (Num(1) - update) * (Num(1) - fresh * fresh);
        const Num to_update = all * (old - fresh) * update * (Num(1) - update);
        const Num to_reset = to_fresh * own * reset * (Num(1) - reset), to_own = to_fresh * reset;
        put(gates + j, to_reset, count), put(gates + h + j, to_update, count), put(gates + 2 * h + j, to_fresh, count);
        put(call.inner_gradient + at * h + j, to_own, count);
        store(inner + k, to_reset), store(inner + size + k, to_update), store(inner + 2 * size + k, to_own);
        store(later + k, all * update);
      }
    }
    for (long g = 0; g < 3; ++g) {
      add_product(inner + g * size, call.packed + n * call.packed_size() + g * h * stride, later, rows, h);
    }
  }
}

inline void fill_nan(float* to, long count) {
  for (long i = 0; i < count; ++i) to[i] = NAN;
}

inline void task(void* data, int phase, long index) {
  const Call& call = *(const Call*)data;
  const bool back = call.gradient;
  if (phase == 0) return pack_task(call, index, back);
  const long first = index % call.tasks() * SEQUENCES, rows = least(SEQUENCES, call.sequences - first);
  float* block = memory(4 * SEQUENCES * wide(call.width));
  float* result = back ? call.gate_gradient : call.new_states;
  const long each = call.steps * call.width * (back ? 3 : 1), from = index / call.tasks() * call.sequences + first;
  if (!block) return fill_nan(result + from * each, rows * each);
  (back ? backward : forward)(call, index / call.tasks(), first, rows, block);
}

// The sizes, from gates or their gradient [..., sequences, steps, 3 width]; false if that has no such shape.
inline bool sizes(const XLA_FFI_Buffer* gates, Call& call) {
  if (gates->rank < 3) return false;
  const int64_t* last = gates->dims + gates->rank - 3;
  call.sequences = last[0], call.steps = last[1], call.width = last[2] / 3;
  const long each = last[0] * last[1] * last[2];
  call.networks = each ? native::size_of_array(gates) / each : 0;
  return each > 0;
}

}  // namespace gru
