// MuJoCo's control step, one warp of 32 threads a world.
//
// The tables of a model are written by threads.py: trees of hinges, slides and free joints; spheres, capsules and boxes
// on a floor and on each other; pyramids, limits, springs, servos, fluid; RK4, or Euler with implicit damping.
// threads_smooth.h, _contacts.h, _solver.h, _readouts.h and _step.h are the step in this order; this file is what a
// warp needs besides: lanes, algebra, sums.
//
// The same source compiles for a CPU, where EACH_LANE is a loop. Rules: in a phase (the body of EACH_LANE) no lane
// reads what another lane writes in it, and MEET ends a phase whose results other lanes need. What a lane keeps from
// one phase to another is a PerLane. A model with more than 32 items of a kind has 64 lanes, and a thread holds two.
//
// Everything inside an evaluation is in the base's frame: that of the free root, with its origin, or else the world's.
// Only the height of the base and the directions "up" and "world's y" enter: places far from the origin cost no bits.
#pragma once
#ifndef __CUDACC_RTC__
#include <math.h>
#endif

typedef REAL real;

#ifdef __CUDACC__
#define DEVICE static __device__ __forceinline__
#define MEMBER __device__ __forceinline__
#define APART static __device__ __noinline__  // what runs once a step stays out of the way of what runs twenty times
#define TABLE(type) static __device__ const __align__(16) type
#define CONSTANT static __device__ constexpr
#define MEET() __syncwarp()
#define UNROLLED _Pragma("unroll")
#define ROLLED _Pragma("unroll 1")
#else
#define DEVICE static inline
#define MEMBER inline
#define APART static
#define TABLE(type) static const type
#define CONSTANT static constexpr
#define MEET()
#define UNROLLED
#define ROLLED
#endif

// Loops whose index is a constant in their body, so that tables fold and small arrays stay in registers.
template <int I>
struct Index {
  static constexpr int value = I;
  MEMBER constexpr operator int() const { return I; }
};
template <int FROM, int TO, class Body>
DEVICE void repeat(const Body& body) {
  if constexpr (FROM < TO) {
    body(Index<FROM>{});
    repeat<FROM + 1, TO>(body);
  }
}

// ---- algebra ------------------------------------------------------------------------------------------------------
struct Vec {
  real x, y, z;
  MEMBER Vec operator+(Vec b) const { return {x + b.x, y + b.y, z + b.z}; }
  MEMBER Vec operator-(Vec b) const { return {x - b.x, y - b.y, z - b.z}; }
  MEMBER Vec operator*(real s) const { return {x * s, y * s, z * s}; }
};
DEVICE Vec vec(real x, real y, real z) { return {x, y, z}; }
DEVICE real dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
DEVICE Vec cross(Vec a, Vec b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

struct Mat {  // by rows
  Vec x, y, z;
};
DEVICE Vec mul(const Mat& m, Vec v) { return {dot(m.x, v), dot(m.y, v), dot(m.z, v)}; }
DEVICE Vec mul_transposed(const Mat& m, Vec v) { return m.x * v.x + m.y * v.y + m.z * v.z; }
DEVICE Mat mul(const Mat& a, const Mat& b) {
  return {mul_transposed(b, a.x), mul_transposed(b, a.y), mul_transposed(b, a.z)};
}
DEVICE Mat transposed(const Mat& m) {
  return {{m.x.x, m.y.x, m.z.x}, {m.x.y, m.y.y, m.z.y}, {m.x.z, m.y.z, m.z.z}};
}

struct Sym {  // a symmetric matrix
  real xx, yy, zz, xy, xz, yz;
  MEMBER Sym operator+(Sym b) const { return {xx + b.xx, yy + b.yy, zz + b.zz, xy + b.xy, xz + b.xz, yz + b.yz}; }
};
DEVICE Vec mul(const Sym& m, Vec v) {
  return {m.xx * v.x + m.xy * v.y + m.xz * v.z, m.xy * v.x + m.yy * v.y + m.yz * v.z,
          m.xz * v.x + m.yz * v.y + m.zz * v.z};
}
// e E + k u u'
DEVICE Sym outer(real e, real k, Vec u) {
  const Vec v = u * k;
  return {e + v.x * u.x, e + v.y * u.y, e + v.z * u.z, v.x * u.y, v.x * u.z, v.y * u.z};
}
// R I R'
DEVICE Sym turned(const Mat& R, const Sym& I) {
  const Vec a = mul(I, R.x), b = mul(I, R.y), c = mul(I, R.z);
  return {dot(R.x, a), dot(R.y, b), dot(R.z, c), dot(R.x, b), dot(R.x, c), dot(R.y, c)};
}

#ifdef __CUDACC__
// Arguments are a few radians, so no slow path for huge ones.
DEVICE void sine_cosine(real x, real* sine, real* cosine) {
  const real turns = rintf(x * real(0.636619772));
  const real r = fmaf(turns, real(4.37113883e-8), fmaf(turns, real(-1.57079637), x));
  const int quadrant = int(turns);
  const real r2 = r * r;
  const real s = r + r * r2 *
                         (real(-1.66666667e-1) +
                          r2 * (real(8.3333310e-3) + r2 * real(-1.98393348e-4) + r2 * r2 * real(2.7183114e-6)));
  const real c = real(1) + r2 * (real(-0.5) + r2 * (real(4.16666418e-2) +
                                                    r2 * (real(-1.38873162e-3) + r2 * real(2.44331571e-5))));
  const bool swapped = quadrant & 1;
  const real first = swapped ? c : s;
  const real second = swapped ? s : c;
  *sine = quadrant & 2 ? -first : first;
  *cosine = (quadrant + 1) & 2 ? -second : second;
}
// One unit in the last place, and no slow path: the exact division takes a tenth of the step.
DEVICE real reciprocal(real x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
DEVICE real inverse_root(real x) { return rsqrtf(x); }
DEVICE real root(real x) { return sqrtf(x); }
DEVICE bool is_finite(real x) { return fabsf(x) <= 3.4028235e38f; }
#else
DEVICE void sine_cosine(real x, real* sine, real* cosine) {
  *sine = sin(x);
  *cosine = cos(x);
}
DEVICE real reciprocal(real x) { return real(1) / x; }
DEVICE real inverse_root(real x) { return real(1) / real(sqrt(x)); }
DEVICE real root(real x) { return real(sqrt(x)); }
DEVICE bool is_finite(real x) { return isfinite(x); }
#endif
DEVICE real absolute(real x) { return x < 0 ? -x : x; }
DEVICE real clamped(real x, real lo, real hi) { return x < lo ? lo : x > hi ? hi : x; }

// The rotation by an angle around a unit vector (Rodrigues).
DEVICE Mat rotation(Vec a, real angle) {
  real s, c;
  sine_cosine(angle, &s, &c);
  const Vec k = a * (real(1) - c);
  return {{c + k.x * a.x, k.x * a.y - s * a.z, k.x * a.z + s * a.y},
          {k.x * a.y + s * a.z, c + k.y * a.y, k.y * a.z - s * a.x},
          {k.x * a.z - s * a.y, k.y * a.z + s * a.x, c + k.z * a.z}};
}
DEVICE Mat rotation(real w, real x, real y, real z) {  // of a unit quaternion
  return {{w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)},
          {2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)},
          {2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z}};
}

DEVICE void put(real* to, Vec v) {
  to[0] = v.x;
  to[1] = v.y;
  to[2] = v.z;
}
DEVICE void put(real* to, const Mat& m) {
  put(to, m.x);
  put(to + 3, m.y);
  put(to + 6, m.z);
}
DEVICE Vec vec_at(const real* from) { return {from[0], from[1], from[2]}; }
DEVICE Mat mat_at(const real* from) { return {vec_at(from), vec_at(from + 3), vec_at(from + 6)}; }

// ---- lanes ----------------------------------------------------------------------------------------------------------
#include MODEL  // the tables, which say how many lanes there are

#define THREADS 32  // of a block
#ifndef __CUDACC__
#define HELD LANES  // lanes whose values a thread holds
#define ME lane     // where it holds this lane's
#define EACH_LANE for (int lane = 0; lane < LANES; ++lane)
#define EACH_THREAD for (int lane = 0; lane < THREADS; ++lane)  // the first 32 lanes, which take several items each
#elif LANES == THREADS
#define HELD 1
#define ME 0
#define EACH_LANE if (const int lane = int(threadIdx.x); true)
#define EACH_THREAD EACH_LANE
#else
#define HELD (LANES / THREADS)
#define ME held
#define EACH_LANE                                  \
  UNROLLED for (int held = 0; held < HELD; ++held) \
    if (const int lane = int(threadIdx.x) + THREADS * held; true)
#define EACH_THREAD if (const int held = 0, lane = int(threadIdx.x); true)
#endif

template <class X>
struct PerLane {
  X value[HELD];
  MEMBER X& operator[](int held) { return value[held]; }
  MEMBER const X& operator[](int held) const { return value[held]; }
};

// Across lanes. Every sum has one order, so that runs repeat bit for bit. A ballot is of the first 32 lanes: the others
// have no contact.
#ifdef __CUDACC__
DEVICE real sum(const PerLane<real>& x) {
  real y = x[0];
  UNROLLED for (int k = 1; k < HELD; ++k) y += x[k];
  UNROLLED for (int offset = THREADS / 2; offset; offset >>= 1) y += __shfl_xor_sync(0xffffffffu, y, offset);
  return y;
}
DEVICE unsigned ballot(const PerLane<bool>& x) { return __ballot_sync(0xffffffffu, x[0]); }
DEVICE bool any(const PerLane<bool>& x) {
  bool y = x[0];
  UNROLLED for (int k = 1; k < HELD; ++k) y = y || x[k];
  return __any_sync(0xffffffffu, y);
}
DEVICE PerLane<real> gathered(const PerLane<real>& x, const PerLane<int>& source) {
  PerLane<real> y;
  UNROLLED for (int k = 0; k < HELD; ++k) {
    y[k] = __shfl_sync(0xffffffffu, x[0], source[k]);  // of the thread that holds it: modulo 32
    UNROLLED for (int from = 1; from < HELD; ++from) {
      const real other = __shfl_sync(0xffffffffu, x[from], source[k]);
      if (source[k] / THREADS == from) y[k] = other;
    }
  }
  return y;
}
DEVICE int lowest(unsigned bits) { return __ffs(bits) - 1; }
DEVICE int lowest(unsigned long long bits) { return __ffsll(bits) - 1; }
DEVICE int count(unsigned bits) { return __popc(bits); }
DEVICE int count(unsigned long long bits) { return __popcll(bits); }
#else
DEVICE real sum(const PerLane<real>& x) {
  real y[LANES];
  for (int i = 0; i < LANES; ++i) y[i] = x[i];
  for (int half = LANES / 2; half; half >>= 1)
    for (int i = 0; i < half; ++i) y[i] += y[i + half];
  return y[0];
}
DEVICE unsigned ballot(const PerLane<bool>& x) {
  unsigned bits = 0;
  for (int i = 0; i < THREADS; ++i) bits |= unsigned(x[i]) << i;
  return bits;
}
DEVICE bool any(const PerLane<bool>& x) {
  for (int i = 0; i < LANES; ++i) {
    if (x[i]) return true;
  }
  return false;
}
DEVICE PerLane<real> gathered(const PerLane<real>& x, const PerLane<int>& source) {
  PerLane<real> y;
  for (int i = 0; i < LANES; ++i) y[i] = x[source[i]];
  return y;
}
DEVICE int lowest(unsigned long long bits) { return __builtin_ctzll(bits); }
DEVICE int count(unsigned long long bits) { return __builtin_popcountll(bits); }
#endif
