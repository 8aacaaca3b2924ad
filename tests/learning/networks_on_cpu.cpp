// networks.cu on a CPU, for tests: a block's threads are fibers that take turns at each barrier.
#include <ucontext.h>

#include <cmath>
#include <cstring>
#include <functional>
#include <memory>
#include <vector>

#define __global__
#define __device__
#define __host__
#define __launch_bounds__(threads)
#define __shared__ static

struct Index {
  int x;
};
static Index threadIdx, blockIdx;

constexpr int STACK = 1 << 16, MOST_THREADS = 256;
static ucontext_t scheduler, fibers[MOST_THREADS];
static std::unique_ptr<char[]> stacks(new char[STACK * MOST_THREADS]);
static bool ended[MOST_THREADS];
static std::function<void()> body;
static int together;  // threads of a block

struct Barrier {
  int arrived = 0, turn = 0;
  void wait(int count) {
    const int turn_now = turn, me = threadIdx.x;
    if (++arrived == count) {
      arrived = 0, ++turn;
      return;
    }
    while (turn == turn_now) swapcontext(&fibers[me], &scheduler);
  }
};
static Barrier of_block, of_warp[MOST_THREADS / 32];
static void __syncthreads() { of_block.wait(together); }
static void sync_warp() { of_warp[threadIdx.x / 32].wait(32); }

static unsigned __float_as_uint(float x) {
  unsigned bits;
  memcpy(&bits, &x, sizeof bits);
  return bits;
}
static float __uint_as_float(unsigned bits) {
  float x;
  memcpy(&x, &bits, sizeof x);
  return x;
}

struct Lane {
  float number;
  unsigned a[4], b[2];
};
static Lane lanes[MOST_THREADS];

static float __shfl_xor_sync(unsigned, float x, int other) {
  lanes[threadIdx.x].number = x;
  sync_warp();
  const float found = lanes[threadIdx.x ^ other].number;
  sync_warp();
  return found;
}

// mma.sync.m16n8k8 of TF32, with the fragments of the PTX manual: the unit reads 19 of a number's 32 bits.
static void tensor_core(float (&c)[4], const unsigned (&a)[4], const unsigned (&b)[2]) {
  const int me = threadIdx.x, warp = me / 32 * 32, lane = me % 32;
  memcpy(lanes[me].a, a, sizeof a), memcpy(lanes[me].b, b, sizeof b);
  sync_warp();
  const auto read = [](unsigned bits) { return __uint_as_float(bits & 0xffffe000u); };
  for (int i = 0; i < 4; ++i) {
    const int row = lane / 4 + 8 * (i / 2), column = 2 * (lane % 4) + i % 2;
    for (int k = 0; k < 8; ++k) {
      const float left = read(lanes[warp + row % 8 * 4 + k % 4].a[row / 8 + 2 * (k / 4)]);
      c[i] += left * read(lanes[warp + column * 4 + k % 4].b[k / 4]);
    }
  }
  sync_warp();
}

#include "networks_for_cpu.cu"

static void enter() {
  body();
  ended[threadIdx.x] = true;
  swapcontext(&fibers[threadIdx.x], &scheduler);
}

static void launch(int blocks, int threads, std::function<void()> kernel) {
  body = kernel, together = threads;
  for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x) {
    for (int k = 0; k < threads; ++k) {
      getcontext(&fibers[k]);
      fibers[k].uc_stack.ss_sp = stacks.get() + k * STACK, fibers[k].uc_stack.ss_size = STACK;
      makecontext(&fibers[k], enter, 0);
      ended[k] = false;
    }
    for (bool going = true; going;) {
      going = false;
      for (int k = 0; k < threads; ++k) {
        if (ended[k]) continue;
        threadIdx.x = k, going = true;
        swapcontext(&scheduler, &fibers[k]);
      }
    }
  }
}

extern "C" {
void forward(int blocks, const float* w, const float* x, float* out, float* saved) {
  launch(blocks, THREADS, [=] { mlp_forward(w, x, out, saved); });
}
void backward(int blocks, const float* gradient, const float* w, const float* saved, float* deltas) {
  launch(blocks, THREADS, [=] { mlp_backward(gradient, w, saved, deltas); });
}
void gradients(int blocks, const float* gradient, const float* x, const float* saved, const float* deltas, float* out) {
  launch(blocks, GRADIENT_THREADS, [=] { mlp_gradients(gradient, x, saved, deltas, out); });
}
void sum(int blocks, const float* shares, float* out) {
  launch(blocks, THREADS, [=] { mlp_sum(shares, out); });
}
}
