// Numbers of several worlds at once: Num is a scalar of each, Mask a truth of each. WORLDS is 1 on a GPU, where a
// Num is a plain Real; on a CPU it is the width of the machine's vectors, by the vector extensions of GCC and Clang.
#pragma once
#ifndef __CUDACC_RTC__
#include <math.h>
#include <stdint.h>
#include <string.h>
#endif
#if defined(__AVX__) && !defined(__CUDACC__)
#include <immintrin.h>
#endif

#ifndef REAL
#define REAL double
#endif
typedef REAL Real;

#ifdef __CUDACC__
#define INLINE __forceinline__
#define MEMBER __device__ __forceinline__
#define FUNCTION static __device__ __forceinline__
#define APART static __device__ __noinline__
#else
#define INLINE __attribute__((always_inline))
#define MEMBER inline __attribute__((always_inline))
#define FUNCTION static inline __attribute__((always_inline))
#define APART static __attribute__((noinline, unused))
#endif

#ifndef WORLDS
#if defined(__CUDACC__)
#define WORLDS 1
#elif defined(__AVX512F__)
#define WORLDS (64 / sizeof(Real))
#elif defined(__AVX__)
#define WORLDS (32 / sizeof(Real))
#else
#define WORLDS (16 / sizeof(Real))
#endif
#endif

constexpr bool SINGLE = sizeof(Real) == 4;

#if defined(__CUDACC__)
typedef Real Num;
typedef bool Mask;
typedef int Bits;  // a CUDA build computes in float
FUNCTION Num select(Mask which, Num yes, Num no) { return which ? yes : no; }
FUNCTION bool any(Mask mask) { return mask; }
FUNCTION Mask differ(Mask a, Mask b) { return a != b; }
FUNCTION Mask mask_of(bool truth) { return truth; }
FUNCTION Num root(Num x) { return sqrtf(x); }
FUNCTION Num size_of(Num x) { return fabsf(x); }
FUNCTION Mask has_bit(Num x, Bits bit) { return (__float_as_int(x) & bit) != 0; }
#else

template <int BYTES> struct BitsOf { typedef int32_t type; };
template <> struct BitsOf<8> { typedef int64_t type; };
typedef BitsOf<sizeof(Real)>::type Bits;
constexpr int LANES = WORLDS;
typedef Real RealVector __attribute__((vector_size(LANES * sizeof(Real))));
typedef Bits BitsVector __attribute__((vector_size(LANES * sizeof(Real))));

struct Mask {
  BitsVector v;  // all bits of a lane that is true
  friend MEMBER Mask operator&(Mask a, Mask b) { return {a.v & b.v}; }
  friend MEMBER Mask operator|(Mask a, Mask b) { return {a.v | b.v}; }
  friend MEMBER Mask operator!(Mask a) { return {~a.v}; }
  MEMBER Mask& operator|=(Mask b) { v |= b.v; return *this; }
  MEMBER Mask& operator&=(Mask b) { v &= b.v; return *this; }
};

struct Num {
  RealVector v;
  Num() = default;
  MEMBER Num(RealVector x) : v(x) {}
  MEMBER Num(Real x) : v(x - RealVector{}) {}
  MEMBER Num(int x) : v(Real(x) - RealVector{}) {}
  friend MEMBER Num operator+(Num a, Num b) { return a.v + b.v; }
  friend MEMBER Num operator-(Num a, Num b) { return a.v - b.v; }
  friend MEMBER Num operator*(Num a, Num b) { return a.v * b.v; }
  friend MEMBER Num operator/(Num a, Num b) { return a.v / b.v; }
  MEMBER Num operator-() const { return -v; }
  MEMBER Num& operator+=(Num b) { v += b.v; return *this; }
  MEMBER Num& operator-=(Num b) { v -= b.v; return *this; }
  MEMBER Num& operator*=(Num b) { v *= b.v; return *this; }
  friend MEMBER Mask operator<(Num a, Num b) { return {(BitsVector)(a.v < b.v)}; }
  friend MEMBER Mask operator>(Num a, Num b) { return {(BitsVector)(a.v > b.v)}; }
  friend MEMBER Mask operator<=(Num a, Num b) { return {(BitsVector)(a.v <= b.v)}; }
  friend MEMBER Mask operator>=(Num a, Num b) { return {(BitsVector)(a.v >= b.v)}; }
};

FUNCTION Num select(Mask which, Num yes, Num no) { return which.v ? yes.v : no.v; }
FUNCTION Mask differ(Mask a, Mask b) { return {a.v ^ b.v}; }
FUNCTION Mask mask_of(bool truth) { return {BitsVector{} - Bits(truth)}; }

template <class Part> FUNCTION Part part_of(const BitsVector& v, int index) {
  Part part;
  memcpy(&part, (const char*)&v + index * sizeof part, sizeof part);
  return part;
}

// The sign bits of all lanes.
FUNCTION unsigned signs(Mask mask) {
#if defined(__AVX512DQ__)
  if constexpr (sizeof mask == 64 && SINGLE) return _mm512_movepi32_mask(part_of<__m512i>(mask.v, 0));
  if constexpr (sizeof mask == 64 && !SINGLE) return _mm512_movepi64_mask(part_of<__m512i>(mask.v, 0));
#endif
#if defined(__AVX__)
  if constexpr (sizeof mask == 32 && SINGLE) return _mm256_movemask_ps(part_of<__m256>(mask.v, 0));
  if constexpr (sizeof mask == 32 && !SINGLE) return _mm256_movemask_pd(part_of<__m256d>(mask.v, 0));
#endif
  unsigned found = 0;
  for (int i = 0; i < LANES; ++i) found |= unsigned(mask.v[i] & 1) << i;
  return found;
}
FUNCTION bool any(Mask mask) { return signs(mask) != 0; }

FUNCTION Real lane(const Num& x, int i) {
  Real value;
  memcpy(&value, (const char*)&x + i * sizeof value, sizeof value);
  return value;
}
FUNCTION void set_lane(Num& x, int i, Real value) { memcpy((char*)&x + i * sizeof value, &value, sizeof value); }

FUNCTION Num root(Num x) {
  Real values[LANES];
  memcpy(values, &x, sizeof values);
  for (int i = 0; i < LANES; ++i) {
    if constexpr (SINGLE) values[i] = __builtin_sqrtf(values[i]);
    else values[i] = __builtin_sqrt(values[i]);
  }
  memcpy(&x, values, sizeof values);
  return x;
}
FUNCTION Num size_of(Num x) {
  constexpr Bits all_but_sign = SINGLE ? Bits(0x7fffffff) : Bits(0x7fffffffffffffff);
  return (RealVector)((BitsVector)x.v & all_but_sign);
}
FUNCTION Mask has_bit(Num x, Bits bit) { return {(BitsVector)(((BitsVector)x.v & bit) != 0)}; }
#endif

#ifdef __CUDACC__
FUNCTION Num inverse(Num x) {  // 1 unit in the last place, without the slow path of a division
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
FUNCTION Num inverse_root(Num x) { return rsqrtf(x); }
#else
FUNCTION Num inverse(Num x) { return Num(1) / x; }
FUNCTION Num inverse_root(Num x) { return Num(1) / root(x); }
#endif
FUNCTION Num clip(Num x, Num low, Num high) { return select(x < low, low, select(x > high, high, x)); }
FUNCTION Num flip_if(Mask which, Num x) { return select(which, -x, x); }

// A polynomial, its constant coefficient first (Horner).
FUNCTION Num polynomial(Num, Real last) { return Num(last); }
template <class... Rest> FUNCTION Num polynomial(Num x, Real first, Rest... rest) {
  return Num(first) + x * polynomial(x, rest...);
}

// Sine and cosine of angles up to some 1e4 rad: reduced by pi / 2 in three parts, then the polynomials of Cephes
// (sinf.c, cosf.c, sin.c).
FUNCTION void sine_cosine(Num angle, Num* sine, Num* cosine) {
  const Real rounder = SINGLE ? Real(12582912.) : Real(6755399441055744.);  // x + it has round(x) in its low bits
  const Num turned = angle * Num(Real(0.636619772367581343)) + Num(rounder);
  const Num quarters = turned - Num(rounder);
  const Mask odd = has_bit(turned, 1), half = has_bit(turned, 2);
  Num s, c;
  if constexpr (SINGLE) {
    Num r = angle - quarters * Num(Real(1.5703125));
    r = r - quarters * Num(Real(4.837512969970703e-4));
    r = r - quarters * Num(Real(7.549789948768648e-8));
    const Num z = r * r;
    s = r + r * z * polynomial(z, Real(-1.6666654611e-1), Real(8.3321608736e-3), Real(-1.9515295891e-4));
    c = Num(1) - Num(Real(.5)) * z +
        z * z * polynomial(z, Real(4.166664568298827e-2), Real(-1.388731625493765e-3), Real(2.443315711809948e-5));
  } else {
    Num r = angle - quarters * Num(Real(1.57079625129699707031));
    r = r - quarters * Num(Real(7.54978941586159635335e-8));
    r = r - quarters * Num(Real(5.39030285815811905290e-15));
    const Num z = r * r;
    s = r + r * z * polynomial(z, Real(-1.66666666666666307295e-1), Real(8.33333333332211858878e-3),
                               Real(-1.98412698295895385996e-4), Real(2.75573136213857245213e-6),
                               Real(-2.50507477628578072866e-8), Real(1.58962301576546568060e-10));
    c = Num(1) - Num(Real(.5)) * z +
        z * z * polynomial(z, Real(4.16666666666665929218e-2), Real(-1.38888888888730564116e-3),
                           Real(2.48015872888517045348e-5), Real(-2.75573141792967388112e-7),
                           Real(2.08757008419747316778e-9), Real(-1.13585365213876817300e-11));
  }
  *sine = flip_if(half, select(odd, c, s));
  *cosine = flip_if(differ(odd, half), select(odd, s, c));
}
