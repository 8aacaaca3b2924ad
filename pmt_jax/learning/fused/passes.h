// The forward and the backward pass of a network over a chunk of rows, and the gradients of its weights.
#pragma once
#include "mlp.h"

// The sum of a vector's numbers, half to half.
template <int BYTES> FUNCTION Real total_of(const void* numbers) {
  if constexpr (BYTES == sizeof(Real)) {
    return *(const Real*)numbers;
  } else {
    typedef Real Half __attribute__((vector_size(BYTES / 2)));
    Half low, high;
    memcpy(&low, numbers, sizeof low);
    memcpy(&high, (const char*)numbers + sizeof low, sizeof high);
    low += high;
    return total_of<BYTES / 2>(&low);
  }
}
FUNCTION Real total(Num x) { return total_of<sizeof(Num)>(&x); }

constexpr Real NORM_EPS = Real(1e-6);
constexpr int TOGETHER = 4;  // rows that do not wait for each other's sums

// Rows of a layer that is normalised: x to y, or the gradient with respect to y to that with respect to x.
struct Rows {
  const float *x, *ones, *scale, *offset;
  long count;       // of real columns
  float *moments;   // mean and 1 / sd of each row
};

// Zero mean and unit variance, then scale and offset.
template <int ROWS> FUNCTION void normalise(const Rows& rows, long first, float* y) {
  const long width = wide(rows.count);
  const Real share = Real(1) / Real(rows.count);
  const float* x = rows.x + first * width;
  Num mean[ROWS], spread[ROWS];
#pragma GCC unroll 4
  for (int r = 0; r < ROWS; ++r) mean[r] = spread[r] = Num(0);
  for (long j = 0; j < width; j += LANES) {
#pragma GCC unroll 4
    for (int r = 0; r < ROWS; ++r) mean[r] += load(x + r * width + j);
  }
#pragma GCC unroll 4
  for (int r = 0; r < ROWS; ++r) mean[r] = Num(total(mean[r]) * share);
  for (long j = 0; j < width; j += LANES) {
    const Num one = load(rows.ones + j);
#pragma GCC unroll 4
    for (int r = 0; r < ROWS; ++r) {
      const Num centred = load(x + r * width + j) - mean[r] * one;
      spread[r] += centred * centred;
    }
  }
#pragma GCC unroll 4
  for (int r = 0; r < ROWS; ++r) {
    spread[r] = Num(Real(1) / __builtin_sqrtf(total(spread[r]) * share + NORM_EPS));
    rows.moments[2 * (first + r)] = lane(mean[r], 0), rows.moments[2 * (first + r) + 1] = lane(spread[r], 0);
  }
  for (long j = 0; j < width; j += LANES) {
    const Num one = load(rows.ones + j), scale = load(rows.scale + j), offset = load(rows.offset + j);
#pragma GCC unroll 4
    for (int r = 0; r < ROWS; ++r) {
      store(y + (first + r) * width + j, (load(x + r * width + j) - mean[r] * one) * spread[r] * scale + offset);
    }
  }
}

// The gradient with respect to x in place of that with respect to y; adds that of scale and of offset to their sums.
template <int ROWS>
FUNCTION void normalise_back(const Rows& rows, long first, float* gradient, float* scale_sum, float* offset_sum) {
  const long width = wide(rows.count);
  const Real share = Real(1) / Real(rows.count);
  const float* x = rows.x + first * width;
  float* g = gradient + first * width;
  Num mean[ROWS], spread[ROWS], level[ROWS], tilt[ROWS];
#pragma GCC unroll 4
  for (int r = 0; r < ROWS; ++r) {
    mean[r] = Num(rows.moments[2 * (first + r)]), spread[r] = Num(rows.moments[2 * (first + r) + 1]);
    level[r] = tilt[r] = Num(0);
  }
  for (long j = 0; j < width; j += LANES) {
    const Num one = load(rows.ones + j), scale = load(rows.scale + j);
    Num scales = load(scale_sum + j), offsets = load(offset_sum + j);
#pragma GCC unroll 4
    for (int r = 0; r < ROWS; ++r) {
      const Num unit = (load(x + r * width + j) - mean[r] * one) * spread[r], each = load(g + r * width + j);
      scales += each * unit, offsets += each;
      level[r] += each * scale, tilt[r] += each * scale * unit;
    }
    store(scale_sum + j, scales), store(offset_sum + j, offsets);
  }
#pragma GCC unroll 4
  for (int r = 0; r < ROWS; ++r) level[r] = Num(total(level[r]) * share), tilt[r] = Num(total(tilt[r]) * share);
  for (long j = 0; j < width; j += LANES) {
    const Num one = load(rows.ones + j), scale = load(rows.scale + j);
#pragma GCC unroll 4
    for (int r = 0; r < ROWS; ++r) {
      const Num unit = (load(x + r * width + j) - mean[r] * one) * spread[r];
      store(g + r * width + j, spread[r] * (load(g + r * width + j) * scale - level[r] * one - unit * tilt[r]));
    }
  }
}

// Kernels as products read them, and vectors with padding. `turned` is needed where a
// gradient passes the layer.
inline void pack_layer(const Shape& shape, const Layer& layer, const Norm& before, const Packed& saved, long l) {
  pack(layer.kernel, layer.out, 1, layer.in, layer.out, saved.packed[l]);
  if (shape.gradient && (l > 0 || shape.to_input())) {
    pack(layer.kernel, 1, layer.out, layer.out, layer.in, saved.turned[l]);
  }
  for (long j = 0; j < wide(layer.out); ++j) saved.bias[l][j] = j < layer.out ? layer.bias[j] : 0;
  for (long j = 0; j < wide(layer.in); ++j) {
    const bool real = j < layer.in, normed = shape.normed(l - 1);
    saved.ones[l][j] = real;
    saved.scale[l][j] = real && normed ? before.scale[j] : 0;
    saved.offset[l][j] = real && normed ? before.bias[j] : 0;
  }
}

FUNCTION Rows rows_of(const Shape& shape, const Saved& saved, long l) {
  return {saved.active[l], saved.ones[l], saved.scale[l], saved.offset[l], shape.width[l], saved.moments[l]};
}

// The activations of a layer's outputs [rows, width], and their norm.
template <Activation WHICH>
void finish(const Shape& shape, const Saved& saved, long l, long first, long rows) {
  const long width = wide(shape.width[l]), end = first + rows;
  for (long r = first; l > 0 && r < end; ++r) {
    float* x = saved.active[l] + r * width;
    for (long j = 0; j < width; j += LANES) store(x + j, activate<WHICH>(load(x + j) + load(saved.bias[l - 1] + j)));
  }
  if (!shape.normed(l - 1)) return;
  const Rows each = rows_of(shape, saved, l);
  long r = first;
  for (; r + TOGETHER <= end; r += TOGETHER) normalise<TOGETHER>(each, r, saved.input[l]);
  for (; r < end; ++r) normalise<1>(each, r, saved.input[l]);
}

// Rows `first` and on of x [R, in] to those of out [R, out].
template <Activation WHICH>
void forward(const Shape& shape, const Saved& saved, const float* x, float* out, long first, long rows) {
  const long last = shape.layers, in = shape.width[0], outputs = shape.width[last];
  for (long r = first; r < first + rows; ++r) {
    float* row = saved.active[0] + r * wide(in);
    for (long j = 0; j < wide(in); ++j) row[j] = j < in ? x[r * in + j] : 0;
  }
  finish<WHICH>(shape, saved, 0, first, rows);
  for (long l = 0; l + 1 < last; ++l) {
    const long depth = shape.width[l], width = wide(shape.width[l + 1]);
    multiply(saved.input[l] + first * wide(depth), wide(depth), saved.packed[l], saved.active[l + 1] + first * width,
             rows, depth, width);
    finish<WHICH>(shape, saved, l + 1, first, rows);
  }
  const long depth = shape.width[last - 1], width = wide(outputs);
  float* head = saved.head + first * width;
  multiply(saved.input[last - 1] + first * wide(depth), wide(depth), saved.packed[last - 1], head, rows, depth, width);
  for (long r = 0; r < rows; ++r) {
    for (long j = 0; j < outputs; ++j) out[(first + r) * outputs + j] = head[r * width + j] + saved.bias[last - 1][j];
  }
}

FUNCTION void add_rows(const float* from, long rows, long width, float* sum) {
  for (long j = 0; j < width; j += LANES) {
    Num column(0);
    for (long r = 0; r < rows; ++r) column += load(from + r * width + j);
    store(sum + j, column);
  }
}

// The gradient of a layer's outputs, of every layer, for some rows.
template <Activation WHICH>
void backward(const Shape& shape, const Saved& saved, const Deltas& deltas, const float* gradient, long first,
              long rows) {
  const long chunk = first / CHUNK, last = shape.layers - 1, outputs = shape.width[last + 1];
  for (long r = first; r < first + rows; ++r) {
    float* row = deltas.delta[last] + r * wide(outputs);
    for (long j = 0; j < wide(outputs); ++j) row[j] = j < outputs ? gradient[r * outputs + j] : 0;
  }
  for (long l = last; l >= 0; --l) {
    const long in = wide(shape.width[l]), out = shape.width[l + 1];
    const float* delta = deltas.delta[l] + first * wide(out);
    add_rows(delta, rows, wide(out), deltas.bias[l] + chunk * wide(out));
    if (l == 0 && !shape.to_input()) break;
    float* before = l > 0 ? deltas.delta[l - 1] : deltas.input;
    multiply(delta, wide(out), saved.turned[l], before + first * in, rows, out, in);
    float *scale_sum = deltas.scale[l] + chunk * in, *offset_sum = deltas.offset[l] + chunk * in;
    for (long j = 0; j < in; ++j) scale_sum[j] = offset_sum[j] = 0;
    if (shape.normed(l - 1)) {
      const Rows each = rows_of(shape, saved, l);
      long r = first;
      for (; r + TOGETHER <= first + rows; r += TOGETHER) {
        normalise_back<TOGETHER>(each, r, before, scale_sum, offset_sum);
      }
      for (; r < first + rows; ++r) normalise_back<1>(each, r, before, scale_sum, offset_sum);
    }
    const float* active = saved.active[l] + first * in;
    float* g = before + first * in;
    for (long j = 0; l > 0 && j < rows * in; j += LANES) store(g + j, load(g + j) * slope<WHICH>(load(active + j)));
  }
}

// Some columns of the gradient of a kernel [in, out], input' delta over all rows, or of its transpose if `turned`:
// rows from `row` on, in the columns of the panel at `first`.
inline void kernel_gradient(const Shape& shape, const Saved& saved, const Deltas& deltas, long l, long row, long first,
                            bool turned, float* gradient) {
  const long in = shape.width[l], out = shape.width[l + 1], height = turned ? out : in, width = turned ? in : out;
  const float *tall = turned ? deltas.delta[l] : saved.input[l], *broad = turned ? saved.input[l] : deltas.delta[l];
  const long rows = least(BLOCK, height - row), columns = least(PANEL * LANES, wide(width) - first);
  float sum[BLOCK * PANEL * LANES];
  multiply_rows(tall + row, wide(height), broad + first, wide(width), shape.rows, rows, columns, sum);
  const long row_step = turned ? 1 : out, column_step = turned ? out : 1;
  for (long i = 0; i < rows; ++i) {
    for (long j = 0; j < least(columns, width - first); ++j) {
      gradient[(row + i) * row_step + (first + j) * column_step] = sum[i * columns + j];
    }
  }
}

// The sum of what the chunks left [chunks, width].
FUNCTION void add_chunks(const float* parts, long chunks, long count, float* sum) {
  for (long j = 0; j < count; ++j) {
    float column = 0;
    for (long c = 0; c < chunks; ++c) column += parts[c * wide(count) + j];
    sum[j] = column;
  }
}
