// Activation functions of hidden layers and their derivatives, by polynomials of Cephes (expf.c, tanhf.c).
#pragma once
#include "vector.h"

enum Activation { RELU, TANH, ELU };

FUNCTION Num exponential(Num x) {
  const Num rounder(Real(12582912.));  // x + it has round(x) in its low bits
  x = clip(x, Num(Real(-87)), Num(Real(88)));
  const Num turned = x * Num(Real(1.44269504088896341)) + rounder, whole = turned - rounder;
  Num r = x - whole * Num(Real(0.693359375));
  r = r + whole * Num(Real(2.12194440e-4));
  const Num p = Num(1) + r + r * r * polynomial(r, Real(5.0000001201e-1), Real(1.6666665459e-1), Real(4.1665795894e-2),
                                               Real(8.3334519073e-3), Real(1.3981999507e-3), Real(1.9875691500e-4));
  const Num scaled = (RealVector)((BitsVector)p.v + ((BitsVector)turned.v << 23));
  return scaled + Num(0) * x;  // what is not a number stays so
}

FUNCTION Num hyperbolic_tangent(Num x) {
  const Num size = size_of(x), z = x * x;
  const Num near = x + x * z * polynomial(z, Real(-3.33332819422e-1), Real(1.33314422036e-1), Real(-5.37397155531e-2),
                                          Real(2.06390887954e-2), Real(-5.70498872745e-3));
  const Num far = Num(1) - Num(2) / (exponential(size + size) + Num(1));
  return select(size < Num(Real(0.625)), near, flip_if(x < Num(0), far));
}

template <Activation WHICH> FUNCTION Num activate(Num x) {
  if constexpr (WHICH == RELU) return select(x < Num(0), Num(0), x);
  if constexpr (WHICH == TANH) return hyperbolic_tangent(x);
  return select(x > Num(0), x, exponential(x) - Num(1));
}

// The derivative, from the activation itself.
template <Activation WHICH> FUNCTION Num slope(Num active) {
  if constexpr (WHICH == RELU) return select(active > Num(0), Num(1), Num(0));
  if constexpr (WHICH == TANH) return Num(1) - active * active;
  return select(active > Num(0), Num(1), active + Num(1));
}
