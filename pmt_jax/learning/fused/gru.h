// A gated recurrent unit over whole sequences (`maths/gru.py`): all its steps in one call, and their gradients. A task
// has some sequences of one network, or some of the kernel's gradient.
#pragma once
#include "activations.h"
#include "matmul.h"
#include "native.h"

namespace gru {

// A task's sequences: few, as a minibatch may have no more than eight; more where sequences are short.
constexpr long FEW = 4, MOST = 32;

// Arrays have a leading [networks]. saved: r, z, n and what r multiplies, [sequences, steps, 4, width].
struct Call {
  long networks, sequences, steps, width;
  const float *gates, *hidden, *going, *kernel, *bias;
  const float *gradient, *states, *saved;
  float *new_states, *new_saved, *gate_gradient, *kernel_gradient, *bias_gradient, *packed, *scratch;

  long together() const { return steps * FEW > MOST ? FEW : MOST / steps; }
  long tasks() const { return (sequences + together() - 1) / together(); }
  long packed_size() const { return 3 * width * wide(width); }
  // Of the backward pass, rows of padded widths: the hidden states before each step, the gradients of their products.
  long rows() const { return sequences * steps; }
  long scratch_size() const { return 4 * rows() * wide(width); }
  float* before(long n) const { return scratch + n * scratch_size(); }
  float* inner(long n) const { return before(n) + rows() * wide(width); }
  // The kernel's gradient in parts: blocks of its rows in panels of each gate's columns.
  long blocks() const { return (width + BLOCK - 1) / BLOCK; }
  long panels() const { return (wide(width) + PANEL * LANES - 1) / (PANEL * LANES); }
  long gradient_tasks() const { return 3 * blocks() * panels(); }
};

FUNCTION Num part(const float* from, long count) {
  if (count >= LANES) return load(from);
  Num x(0);
  memcpy(&x, from, count * sizeof(float));
  return x;
}
FUNCTION void put(float* to, Num x, long count) {
  if (count >= LANES) return store(to, x);
  memcpy(to, &x, count * sizeof(float));
}
FUNCTION Num sigmoid(Num x) { return Num(1) / (Num(1) + exponential(Num(0) - x)); }

// The kernel of each gate, or its transpose, as products read them.
inline void pack_task(const Call& call, long index, bool turned) {
  const long n = index / 3, gate = index % 3, h = call.width;
  const float* from = call.kernel + n * 3 * h * h + gate * h;
  pack(from, turned ? 1 : 3 * h, turned ? 3 * h : 1, h, h, call.packed + n * call.packed_size() + gate * h * wide(h));
}

inline void add_product(const float* a, long row, const float* packed, float* c, long rows, long width) {
  const long stride = wide(width);
  for (long first = 0; first < stride; first += PANEL * LANES) {
    const long columns = least(PANEL * LANES, stride - first);
    strip(columns / LANES, a, row, 1, packed + first * width, columns, c + first, stride, rows, width, true);
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
      float* saved = call.new_saved ? call.new_saved + at * 4 * h : nullptr;
      for (long j = 0; j < h; j += LANES) {
        const long k = r * stride + j, count = h - j;
        const Num reset = sigmoid(part(gates + j, count) + load(inner + k));
        const Num update = sigmoid(part(gates + h + j, count) + load(inner + size + k));
        const Num own = load(inner + 2 * size + k) + part(bias + j, count);
        const Num fresh = hyperbolic_tangent(part(gates + 2 * h + j, count) + reset * own);
        const Num after = (Num(1) - update) * fresh + update * load(state + k);
        if (call.new_saved) {
          put(saved + j, reset, count), put(saved + h + j, update, count);
          put(saved + 2 * h + j, fresh, count), put(saved + 3 * h + j, own, count);
        }
        put(call.new_states + at * h + j, after, count);
        store(state + k, call.going[at] != 0 ? after : Num(0));
      }
    }
  }
}

inline void backward(const Call& call, long n, long first, long rows, float* block) {
  const long h = call.width, stride = wide(h), size = rows * stride;
  float *later = block, *olds = call.before(n) + first * call.steps * stride;
  float* inner = call.inner(n) + first * call.steps * 3 * stride;
  for (long k = 0; k < size; ++k) later[k] = 0;
  for (long t = call.steps - 1; t >= 0; --t) {
    for (long r = 0; r < rows; ++r) {
      const long sequence = n * call.sequences + first + r, at = sequence * call.steps + t;
      const float *saved = call.saved + at * 4 * h, *before = t ? call.states + (at - 1) * h : call.hidden + sequence * h;
      const bool begins = t && call.going[at - 1] == 0, ends = call.going[at] == 0;
      float *gates = call.gate_gradient + at * 3 * h, *to = inner + (r * call.steps + t) * 3 * stride;
      for (long j = h / LANES * LANES; j < stride; j += LANES) {  // the padding
        for (long g = 0; g < 3; ++g) store(to + g * stride + j, Num(0));
        store(olds + (r * call.steps + t) * stride + j, Num(0));
      }
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
        store(to + j, to_reset), store(to + stride + j, to_update), store(to + 2 * stride + j, to_own);
        store(olds + (r * call.steps + t) * stride + j, old), store(later + k, all * update);
      }
    }
    for (long g = 0; g < 3; ++g) {
      const float* packed = call.packed + n * call.packed_size() + g * h * stride;
      add_product(inner + t * 3 * stride + g * stride, call.steps * 3 * stride, packed, later, rows, h);
    }
  }
}

// A part of the kernel's gradient, or the bias's.
inline void weight_gradient(const Call& call, long n, long part) {
  const long h = call.width, stride = wide(h);
  if (part == call.gradient_tasks()) {
    float* sum = call.bias_gradient + n * h;
    for (long j = 0; j < h; ++j) sum[j] = 0;
    for (long r = 0; r < call.rows(); ++r) {
      const float* row = call.inner(n) + (3 * r + 2) * stride;
      for (long j = 0; j < h; ++j) sum[j] += row[j];
    }
    return;
  }
  const long row = part % call.blocks() * BLOCK, gate = part / call.blocks() % 3;
  const long first = part / call.blocks() / 3 * PANEL * LANES, columns = least(PANEL * LANES, stride - first);
  float sum[BLOCK * PANEL * LANES];
  const long height = least(BLOCK, h - row);
  multiply_rows(call.before(n) + row, stride, call.inner(n) + gate * stride + first, 3 * stride, call.rows(), height,
                columns, sum);
  for (long i = 0; i < height; ++i) {
    float* to = call.kernel_gradient + ((n * h + row + i) * 3 + gate) * h + first;
    memcpy(to, sum + i * columns, least(columns, h - first) * sizeof(float));
  }
}

inline void fill_nan(float* to, long count) {
  for (long i = 0; i < count; ++i) to[i] = NAN;
}

inline void task(void* data, int phase, long index) {
  const Call& call = *(const Call*)data;
  const bool back = call.gradient;
  if (phase == 0) return pack_task(call, index, back);
  const long parts = 1 + call.gradient_tasks();
  if (phase == 2) return weight_gradient(call, index / parts, index % parts);
  const long first = index % call.tasks() * call.together(), rows = least(call.together(), call.sequences - first);
  float* block = memory(4 * call.together() * wide(call.width));
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
