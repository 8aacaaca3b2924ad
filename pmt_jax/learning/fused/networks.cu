// The passes of a network on an NVIDIA GPU, a kernel each: forward, gradients of the layers' outputs, and gradients of
// the weights in parts. Which network it is, "network.h" says: a block of 8 warps takes the same rows of every layer.
//
// Products are of tensor cores: each number is split into two of 11 significant bits, and three of their four products
// are summed, which leaves errors of float32's size. All sums have a fixed order.
#include "network.h"

constexpr int WARPS = 8, THREADS = 32 * WARPS, TAKEN = 16 * TILES;  // rows of a block
constexpr int HIGH_WARPS = TILES > 1 ? 2 : 1, WIDE_WARPS = WARPS / HIGH_WARPS;
constexpr float NORM_EPS = 1e-6f;
enum { RELU, TANH, ELU };

__host__ __device__ constexpr int least(int a, int b) { return a < b ? a : b; }
__host__ __device__ constexpr int most(int a, int b) { return a < b ? b : a; }
__host__ __device__ constexpr int parts(int all, int each) { return (all + each - 1) / each; }
constexpr int widest() {
  int width = WIDTH[LAYERS];
  for (int l = 1; l < LAYERS; ++l) width = most(width, WIDTH[l]);
  return INPUT_NORM ? most(width, WIDTH[0]) : width;
}
constexpr int PITCH = 32 * parts(widest(), 32) + 4;  // so that the rows of a fragment lie in different banks
constexpr int BLOCKS = parts(ROWS, TAKEN);

__device__ int lane() { return threadIdx.x % 32; }
__device__ int warp() { return threadIdx.x / 32; }

__device__ float total(float x) {
  for (int half = 16; half; half /= 2) x += __shfl_xor_sync(~0u, x, half);
  return x;
}

__device__ float activate(float x) {
  if (ACTIVATION == RELU) return x < 0 ? 0 : x;
  if (ACTIVATION == TANH) return tanhf(x);
  return x > 0 ? x : expm1f(x);
}
__device__ float slope(float active) {  // the derivative, from the activation itself
  if (ACTIVATION == RELU) return active > 0 ? 1 : 0;
  if (ACTIVATION == TANH) return 1 - active * active;
  return active > 0 ? 1 : active + 1;
}

// -- products --

template <int COUNT> struct Fragment {
  unsigned high[COUNT], low[COUNT];
  __device__ void set(int k, float x) {
    high[k] = __float_as_uint(x) & 0xffffe000u;
    low[k] = __float_as_uint(x - __uint_as_float(high[k]));
  }
};

__device__ void multiply_add(float (&c)[4], const unsigned (&a)[4], const unsigned (&b)[2]) {
  asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
}

// Of left times right this warp's tiles [16, 8]: HIGH from row `top` on, and WIDE, `step` columns apart, from `side` on.
template <int HIGH, int WIDE> struct Product {
  float sum[HIGH][WIDE][4];
  int top, side, step;

  template <class Left, class Right> __device__ void multiply(int depth, const Left& left, const Right& right) {
    const int row = top + lane() / 4, k = lane() % 4;
    for (int i = 0; i < HIGH; ++i)
      for (int j = 0; j < WIDE; ++j)
        for (int c = 0; c < 4; ++c) sum[i][j][c] = 0;
#pragma unroll 8
    for (int from = 0; from < depth; from += 8) {
      Fragment<4> a[HIGH];
#pragma unroll
      for (int i = 0; i < HIGH; ++i) {
        a[i].set(0, left(16 * i + row, from + k)), a[i].set(1, left(16 * i + row + 8, from + k));
        a[i].set(2, left(16 * i + row, from + k + 4)), a[i].set(3, left(16 * i + row + 8, from + k + 4));
      }
#pragma unroll
      for (int j = 0; j < WIDE; ++j) {
        Fragment<2> b;
        const int column = side + step * j + lane() / 4;
        b.set(0, right(from + k, column)), b.set(1, right(from + k + 4, column));
#pragma unroll
        for (int i = 0; i < HIGH; ++i) {
          multiply_add(sum[i][j], a[i].low, b.high);
          multiply_add(sum[i][j], a[i].high, b.low);
          multiply_add(sum[i][j], a[i].high, b.high);
        }
      }
    }
  }
  template <class Give> __device__ void give(const Give& to) const {
    const int row = top + lane() / 4, column = side + 2 * (lane() % 4);
#pragma unroll
    for (int i = 0; i < HIGH; ++i)
#pragma unroll
      for (int j = 0; j < WIDE; ++j)
#pragma unroll
        for (int c = 0; c < 4; ++c) to(row + 16 * i + 8 * (c / 2), column + step * j + c % 2, sum[i][j][c]);
  }
};

// Whether `index` is below `count`, known while compiling where `count` fills whole tiles.
template <int COUNT, int TILE> __device__ bool below(int index) { return COUNT % TILE == 0 || index < COUNT; }

// The rows of a block times a matrix of so many columns.
template <int COLUMNS> struct RowsProduct : Product<TILES / HIGH_WARPS, parts(parts(COLUMNS, 8), WIDE_WARPS)> {
  __device__ RowsProduct() {
    this->top = warp() / WIDE_WARPS * (TAKEN / HIGH_WARPS);
    this->side = warp() % WIDE_WARPS * 8, this->step = WIDE_WARPS * 8;
  }
  __device__ static bool has(int column) { return below<COLUMNS, WIDE_WARPS * 8>(column); }
};

// -- the forward pass --

struct Rows {
  float (*tile)[PITCH];
  int first;
  __device__ bool real(int row) const { return below<ROWS, TAKEN>(first + row); }
};

// Zero mean and unit variance of each row, then scale and offset; keeps the mean and 1 / sd.
template <int L, class Read> __device__ void normalise(const Rows& rows, const float* w, float* saved, const Read& read) {
  constexpr int width = WIDTH[L];
  for (int row = warp(); row < TAKEN; row += WARPS) {
    if (!rows.real(row)) continue;
    float mean = 0, spread = 0;
    for (int j = lane(); j < width; j += 32) mean += read(row, j);
    mean = total(mean) / width;
    for (int j = lane(); j < width; j += 32) spread += (read(row, j) - mean) * (read(row, j) - mean);
    spread = 1 / sqrtf(total(spread) / width + NORM_EPS);
    const long at = rows.first + row;
    for (int j = lane(); j < width; j += 32) {
      const float y = (read(row, j) - mean) * spread * w[SCALE_AT[L] + j] + w[OFFSET_AT[L] + j];
      rows.tile[row][j] = y;
      if (GRADIENT) saved[INPUT_AT[L] + at * width + j] = y;
    }
    if (GRADIENT && lane() == 0) saved[MOMENTS_AT[L] + 2 * at] = mean, saved[MOMENTS_AT[L] + 2 * at + 1] = spread;
  }
}

template <int L> __device__ void forward_from(const Rows& rows, const float* w, const float* x, float* out, float* saved) {
  if constexpr (L < LAYERS) {
    constexpr int in = WIDTH[L], width = WIDTH[L + 1];
    RowsProduct<width> product;
    const auto left = [&](int row, int k) {
      if (!below<in, 8>(k)) return 0.f;
      return L > 0 || INPUT_NORM ? rows.tile[row][k] : rows.real(row) ? x[long(rows.first + row) * in + k] : 0.f;
    };
    const auto right = [&](int k, int column) {
      return below<in, 8>(k) && product.has(column) ? w[KERNEL_AT[L] + k * width + column] : 0.f;
    };
    product.multiply(in, left, right);
    __syncthreads();
    product.give([&](int row, int column, float sum) {
      if (!product.has(column)) return;
      const long at = long(rows.first + row) * width + column;
      sum += w[BIAS_AT[L] + column];
      if (L + 1 == LAYERS) {
        if (rows.real(row)) out[at] = sum;
        return;
      }
      sum = activate(sum);
      rows.tile[row][column] = sum;
      if (GRADIENT && rows.real(row)) saved[ACTIVE_AT[L + 1] + at] = sum;
    });
    __syncthreads();
    if constexpr (L + 1 < LAYERS) {
      if constexpr (NORMED[L + 1]) {
        normalise<L + 1>(rows, w, saved, [&](int row, int j) { return rows.tile[row][j]; });
        __syncthreads();
      }
      forward_from<L + 1>(rows, w, x, out, saved);
    }
  }
}

// Weights [P] and x [R, I] to out [R, O] and, for the gradients, what `saved` has of each layer.
#ifdef FORWARD
extern "C" __global__ void __launch_bounds__(THREADS)
mlp_forward(const float* __restrict__ w, const float* __restrict__ x, float* __restrict__ out, float* __restrict__ saved) {
  __shared__ float tile[TAKEN][PITCH];
  const long n = blockIdx.x / BLOCKS;
  const Rows rows = {tile, int(blockIdx.x % BLOCKS) * TAKEN};
  w += n * WEIGHTS, x += n * ROWS * WIDTH[0], out += n * ROWS * WIDTH[LAYERS], saved += n * SAVED;
  if constexpr (INPUT_NORM) {
    normalise<0>(rows, w, saved, [&](int row, int j) { return x[long(rows.first + row) * WIDTH[0] + j]; });
    __syncthreads();
  }
  forward_from<0>(rows, w, x, out, saved);
}
#endif

// -- the gradient of each layer's outputs --

// The gradient with respect to a norm's input in place of that with respect to what it gives.
template <int L> __device__ void normalise_back(const Rows& rows, const float* w, const float* saved, const float* active) {
  constexpr int width = WIDTH[L];
  for (int row = warp(); row < TAKEN; row += WARPS) {
    if (!rows.real(row)) continue;
    const long at = rows.first + row;
    const float mean = saved[MOMENTS_AT[L] + 2 * at], spread = saved[MOMENTS_AT[L] + 2 * at + 1];
    float level = 0, tilt = 0;
    for (int j = lane(); j < width; j += 32) {
      const float each = rows.tile[row][j] * w[SCALE_AT[L] + j];
      level += each, tilt += each * (active[at * width + j] - mean) * spread;
    }
    level = total(level) / width, tilt = total(tilt) / width;
    for (int j = lane(); j < width; j += 32) {
      const float unit = (active[at * width + j] - mean) * spread;
      rows.tile[row][j] = spread * (rows.tile[row][j] * w[SCALE_AT[L] + j] - level - unit * tilt);
    }
  }
}

template <int L> __device__ void backward_to(const Rows& rows, const float* w, const float* saved, float* deltas) {
  if constexpr (L > 0 || INPUT_NORM) {
    constexpr int in = WIDTH[L], width = WIDTH[L + 1];
    RowsProduct<in> product;
    const auto left = [&](int row, int k) { return below<width, 8>(k) ? rows.tile[row][k] : 0.f; };
    const auto right = [&](int k, int column) {
      return below<width, 8>(k) && product.has(column) ? w[KERNEL_AT[L] + column * width + k] : 0.f;
    };
    product.multiply(width, left, right);
    __syncthreads();
    product.give([&](int row, int column, float sum) {
      if (!product.has(column)) return;
      rows.tile[row][column] = sum;
      if (NORMED[L] && rows.real(row)) deltas[NORMAL_AT[L] + long(rows.first + row) * in + column] = sum;
    });
    __syncthreads();
    if constexpr (L > 0) {
      const float* active = saved + ACTIVE_AT[L];
      if constexpr (NORMED[L]) {
        normalise_back<L>(rows, w, saved, active);
        __syncthreads();
      }
      for (int k = threadIdx.x; k < TAKEN * in; k += THREADS) {
        const int row = k / in, j = k % in;
        const long at = long(rows.first + row) * in + j;
        if (rows.real(row)) deltas[DELTA_AT[L - 1] + at] = rows.tile[row][j] *= slope(active[at]);
      }
      __syncthreads();
      backward_to<L - 1>(rows, w, saved, deltas);
    }
  }
}

// The gradient of the outputs [R, O], weights [P] and what the forward pass saved to the gradients of what each
// layer and norm gives.
#ifdef BACKWARD
extern "C" __global__ void __launch_bounds__(THREADS)
mlp_backward(const float* __restrict__ gradient, const float* __restrict__ w, const float* __restrict__ saved,
             float* __restrict__ deltas) {
  __shared__ float tile[TAKEN][PITCH];
  constexpr int width = WIDTH[LAYERS];
  const long n = blockIdx.x / BLOCKS;
  const Rows rows = {tile, int(blockIdx.x % BLOCKS) * TAKEN};
  gradient += n * ROWS * width, w += n * WEIGHTS, saved += n * SAVED, deltas += n * DELTAS;
  for (int k = threadIdx.x; k < TAKEN * width; k += THREADS) {
    const int row = k / width, j = k % width;
    tile[row][j] = rows.real(row) ? gradient[long(rows.first + row) * width + j] : 0;
  }
  __syncthreads();
  backward_to<LAYERS - 1>(rows, w, saved, deltas);
}
#endif

// -- the gradients of the weights --

// Blocks of a layer's kernel, and one more for its bias and the norm before it.
constexpr int HIGH = 64, WIDE = 64, GRADIENT_THREADS = 128;
__host__ __device__ constexpr int tiles(int l) { return parts(WIDTH[l], HIGH) * parts(WIDTH[l + 1], WIDE); }
constexpr int all_tiles() {
  int all = 0;
  for (int l = 0; l < LAYERS; ++l) all += tiles(l) + 1;
  return all;
}

struct Piece {  // what is read, the rows of a split, and where their share of the gradient goes
  const float *input, *active, *moments, *normal, *delta;
  int first, end;
  float* part;
};

template <int L> __device__ void kernel_gradient(const Piece& piece, int tile) {
  constexpr int in = WIDTH[L], width = WIDTH[L + 1], across = parts(width, WIDE);
  Product<HIGH / 32, WIDE / 16> product;
  product.top = tile / across * HIGH + warp() / 2 * (HIGH / 2);
  product.side = tile % across * WIDE + warp() % 2 * (WIDE / 2), product.step = 8;
  if (product.top >= in || product.side >= width) return;
  const auto left = [&](int i, int row) {
    row += piece.first;
    return below<ROWS, SPLIT_ROWS>(row) && below<in, HIGH>(i) ? piece.input[row * in + i] : 0.f;
  };
  const auto right = [&](int row, int column) {
    row += piece.first;
    return below<ROWS, SPLIT_ROWS>(row) && below<width, WIDE>(column) ? piece.delta[row * width + column] : 0.f;
  };
  product.multiply(SPLIT_ROWS, left, right);
  product.give([&](int i, int column, float sum) {
    if (below<in, HIGH>(i) && below<width, WIDE>(column)) piece.part[KERNEL_AT[L] + i * width + column] = sum;
  });
}

template <int L> __device__ void vector_gradients(const Piece& piece) {
  constexpr int in = WIDTH[L], width = WIDTH[L + 1];
  for (int j = threadIdx.x; j < width; j += GRADIENT_THREADS) {
    float sum = 0;
#pragma unroll 16
    for (int row = piece.first; row < piece.end; ++row) sum += piece.delta[long(row) * width + j];
    piece.part[BIAS_AT[L] + j] = sum;
  }
  if constexpr (NORMED[L]) {
    for (int j = threadIdx.x; j < in; j += GRADIENT_THREADS) {
      float scale = 0, offset = 0;
#pragma unroll 16
      for (int row = piece.first; row < piece.end; ++row) {
        const float each = piece.normal[long(row) * in + j];
        const float unit = (piece.active[long(row) * in + j] - piece.moments[2 * row]) * piece.moments[2 * row + 1];
        scale += each * unit, offset += each;
      }
      piece.part[SCALE_AT[L] + j] = scale, piece.part[OFFSET_AT[L] + j] = offset;
    }
  }
}

template <int L>
__device__ void gradient_of(int job, const float* gradient, const float* x, const float* saved, const float* deltas,
                            Piece piece) {
  if constexpr (L < LAYERS) {
    if (job > tiles(L)) return gradient_of<L + 1>(job - tiles(L) - 1, gradient, x, saved, deltas, piece);
    piece.input = L == 0 && !INPUT_NORM ? x : saved + (NORMED[L] ? INPUT_AT[L] : ACTIVE_AT[L]);
    piece.active = L == 0 ? x : saved + ACTIVE_AT[L], piece.moments = saved + MOMENTS_AT[L];
    piece.normal = deltas + NORMAL_AT[L], piece.delta = L + 1 == LAYERS ? gradient : deltas + DELTA_AT[L];
    if (job < tiles(L)) kernel_gradient<L>(piece, job);
    else vector_gradients<L>(piece);
  }
}

// The gradient of the outputs, x, and what both passes gave to shares of the gradient of the weights [SPLITS, P].
#ifdef WEIGHT_GRADIENTS
extern "C" __global__ void __launch_bounds__(GRADIENT_THREADS)
mlp_gradients(const float* __restrict__ gradient, const float* __restrict__ x, const float* __restrict__ saved,
              const float* __restrict__ deltas, float* __restrict__ out) {
  constexpr int jobs = all_tiles();
  const int job = blockIdx.x % jobs, split = blockIdx.x / jobs % SPLITS;
  const long n = blockIdx.x / (jobs * SPLITS);
  gradient += n * ROWS * WIDTH[LAYERS], x += n * ROWS * WIDTH[0], saved += n * SAVED, deltas += n * DELTAS;
  Piece piece = {};
  piece.first = split * SPLIT_ROWS, piece.end = least(ROWS, piece.first + SPLIT_ROWS);
  piece.part = out + (n * SPLITS + split) * WEIGHTS;
  gradient_of<0>(job, gradient, x, saved, deltas, piece);
}
#endif

// Shares [SPLITS, P] to the gradient of the weights [P].
#ifdef SUM
extern "C" __global__ void __launch_bounds__(THREADS) mlp_sum(const float* __restrict__ shares, float* __restrict__ out) {
  constexpr int blocks = parts(WEIGHTS, THREADS);
  const long n = blockIdx.x / blocks;
  const int k = blockIdx.x % blocks * THREADS + threadIdx.x;
  if (k >= WEIGHTS) return;
  float sum = 0;
#pragma unroll 16
  for (int split = 0; split < SPLITS; ++split) sum += shares[(n * SPLITS + split) * WEIGHTS + k];
  out[n * WEIGHTS + k] = sum;
}
#endif
