// Products of small matrices: tiles of rows and columns that stay in registers. Matrices lie in rows of `stride`
// numbers, a multiple of ALIGNED, filled up with zeros.
#pragma once
#include "vector.h"

FUNCTION Num load(const float* from) {
  Num x;
  memcpy(&x, from, sizeof x);
  return x;
}
FUNCTION void store(float* to, Num x) { memcpy(to, &x, sizeof x); }
// The padding does not depend on the machine, as arrays' shapes do not.
constexpr long ALIGNED = 16;
FUNCTION long wide(long width) { return (width + ALIGNED - 1) / ALIGNED * ALIGNED; }
FUNCTION long least(long a, long b) { return a < b ? a : b; }

// Half of the registers hold sums of products, or more where there are 32.
constexpr int PANEL = LANES >= 16 ? 4 : 2;             // vectors side by side, the most columns of a tile
constexpr int TALL = LANES >= 16 ? 12 : LANES >= 8 ? 6 : 4;  // rows of a tile
constexpr int rows_of(int vectors) { return vectors > 2 || (LANES < 16 && vectors > 1) ? (LANES >= 16 ? 6 : TALL) : TALL; }

// c [ROWS, VECTORS * LANES] (+)= sum over k of a(i, k) * b(k, :), a(i, k) = a[i * row + k * column].
template <int ROWS, int VECTORS>
FUNCTION void tile(const float* a, long row, long column, const float* b, long b_stride, float* c, long c_stride,
                   long depth, bool add) {
  Num sum[ROWS][VECTORS];
#pragma GCC unroll 16
  for (int i = 0; i < ROWS; ++i) {
#pragma GCC unroll 4
    for (int j = 0; j < VECTORS; ++j) sum[i][j] = add ? load(c + i * c_stride + j * LANES) : Num(0);
  }
  for (long k = 0; k < depth; ++k) {
    Num wide[VECTORS];
#pragma GCC unroll 4
    for (int j = 0; j < VECTORS; ++j) wide[j] = load(b + k * b_stride + j * LANES);
#pragma GCC unroll 16
    for (int i = 0; i < ROWS; ++i) {
      const Num one = Num(a[i * row + k * column]);
#pragma GCC unroll 4
      for (int j = 0; j < VECTORS; ++j) sum[i][j] += one * wide[j];
    }
  }
#pragma GCC unroll 16
  for (int i = 0; i < ROWS; ++i) {
#pragma GCC unroll 4
    for (int j = 0; j < VECTORS; ++j) store(c + i * c_stride + j * LANES, sum[i][j]);
  }
}

// The same for any number of rows, in columns of one panel.
template <int VECTORS>
__attribute__((noinline)) void strip(const float* a, long row, long column, const float* b, long b_stride, float* c,
                                     long c_stride, long rows, long depth, bool add) {
  constexpr int ROWS = rows_of(VECTORS);
  long i = 0;
  for (; i + ROWS <= rows; i += ROWS) {
    tile<ROWS, VECTORS>(a + i * row, row, column, b, b_stride, c + i * c_stride, c_stride, depth, add);
  }
  for (; ROWS > 4 && i + 4 <= rows; i += 4) {
    tile<4, VECTORS>(a + i * row, row, column, b, b_stride, c + i * c_stride, c_stride, depth, add);
  }
  for (; i + 2 <= rows; i += 2) {
    tile<2, VECTORS>(a + i * row, row, column, b, b_stride, c + i * c_stride, c_stride, depth, add);
  }
  if (i < rows) tile<1, VECTORS>(a + i * row, row, column, b, b_stride, c + i * c_stride, c_stride, depth, add);
}

inline void strip(long vectors, const float* a, long row, long column, const float* b, long b_stride, float* c,
                  long c_stride, long rows, long depth, bool add) {
  switch (vectors) {
    case 1: return strip<1>(a, row, column, b, b_stride, c, c_stride, rows, depth, add);
    case 2: return strip<2>(a, row, column, b, b_stride, c, c_stride, rows, depth, add);
    case 3: return strip<3>(a, row, column, b, b_stride, c, c_stride, rows, depth, add);
    default: return strip<4>(a, row, column, b, b_stride, c, c_stride, rows, depth, add);
  }
}

// c [rows, width] = a [rows, depth] * packed [depth, width], whose panels lie one after the other (see `pack`).
inline void multiply(const float* a, long a_stride, const float* packed, float* c, long rows, long depth, long width) {
  for (long first = 0; first < width; first += PANEL * LANES) {
    const long columns = least(PANEL * LANES, width - first);
    strip(columns / LANES, a, a_stride, 1, packed + first * depth, columns, c + first, width, rows, depth, false);
  }
}

// A matrix [depth, width], or its transpose's transpose, as panels of columns that are read from one end to the other.
inline void pack(const float* from, long row, long column, long depth, long width, float* packed) {
  const long stride = wide(width);
  for (long first = 0; first < stride; first += PANEL * LANES) {
    const long columns = least(PANEL * LANES, stride - first);
    float* to = packed + first * depth;
    const long real = least(columns, width - first);
    for (long k = 0; column == 1 && k < depth; ++k) {
      memcpy(to + k * columns, from + k * row + first, real * sizeof(float));
      for (long j = real; j < columns; ++j) to[k * columns + j] = 0;
    }
    for (long k = 0; column != 1 && k < depth; ++k) {
      for (long j = 0; j < columns; ++j) {
        to[k * columns + j] = j < real ? from[k * row + (first + j) * column] : 0;
      }
    }
  }
}

// Some rows and columns of a' b, summed over all rows of a [rows, ...] and of b [rows, ...]: a block of BLOCK rows at
// most, in columns of one panel.
constexpr long BLOCK = 24, DEEP = 64;
inline void multiply_rows(const float* a, long a_stride, const float* b, long b_stride, long rows, long height,
                          long columns, float* sum) {
  for (long r = 0; r < rows; r += DEEP) {
    strip(columns / LANES, a + r * a_stride, 1, a_stride, b + r * b_stride, b_stride, sum, columns, height,
          least(DEEP, rows - r), r > 0);
  }
}

// Memory of a thread, kept for its next task.
inline float* memory(long size) {
  static thread_local float* block;
  static thread_local long held;
  if (held < size) {
    free(block);
    block = (float*)aligned_alloc(64, (size * sizeof(float) + 63) / 64 * 64);
    held = block ? size : 0;
  }
  return block;
}
