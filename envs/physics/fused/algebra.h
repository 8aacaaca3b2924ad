// Vectors, matrices and quaternions of Num.
#pragma once
#include "vector.h"

struct Vec3 {
  Num x, y, z;
};
FUNCTION Vec3 vec(Num x, Num y, Num z) { return {x, y, z}; }
FUNCTION Vec3 vec(const Real* p) { return {Num(p[0]), Num(p[1]), Num(p[2])}; }
FUNCTION Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
FUNCTION Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
FUNCTION Vec3 operator-(Vec3 a) { return {-a.x, -a.y, -a.z}; }
FUNCTION Vec3 operator*(Vec3 a, Num s) { return {a.x * s, a.y * s, a.z * s}; }
FUNCTION Num dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
FUNCTION Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
FUNCTION Vec3 select(Mask which, Vec3 yes, Vec3 no) {
  return {select(which, yes.x, no.x), select(which, yes.y, no.y), select(which, yes.z, no.z)};
}

struct Mat3 {
  Vec3 r0, r1, r2;  // rows
};
FUNCTION Mat3 mat(const Real* p) { return {vec(p), vec(p + 3), vec(p + 6)}; }
FUNCTION Vec3 operator*(const Mat3& m, Vec3 v) { return {dot(m.r0, v), dot(m.r1, v), dot(m.r2, v)}; }
FUNCTION Vec3 transposed_times(const Mat3& m, Vec3 v) { return m.r0 * v.x + m.r1 * v.y + m.r2 * v.z; }
FUNCTION Mat3 operator*(const Mat3& a, const Mat3& b) {
  return {transposed_times(b, a.r0), transposed_times(b, a.r1), transposed_times(b, a.r2)};
}

struct Sym3 {  // a symmetric matrix
  Num xx, yy, zz, xy, xz, yz;
};
FUNCTION Sym3 sym(const Real* p) { return {Num(p[0]), Num(p[1]), Num(p[2]), Num(p[3]), Num(p[4]), Num(p[5])}; }
FUNCTION Sym3 operator+(Sym3 a, Sym3 b) {
  return {a.xx + b.xx, a.yy + b.yy, a.zz + b.zz, a.xy + b.xy, a.xz + b.xz, a.yz + b.yz};
}
FUNCTION Vec3 operator*(const Sym3& m, Vec3 v) {
  return {m.xx * v.x + m.xy * v.y + m.xz * v.z, m.xy * v.x + m.yy * v.y + m.yz * v.z,
          m.xz * v.x + m.yz * v.y + m.zz * v.z};
}
// diagonal * E + factor * u u'
FUNCTION Sym3 diagonal_and_outer(Num diagonal, Num factor, Vec3 u) {
  const Vec3 v = u * factor;
  return {diagonal + v.x * u.x, diagonal + v.y * u.y, diagonal + v.z * u.z, v.x * u.y, v.x * u.z, v.y * u.z};
}
// R I R'
FUNCTION Sym3 turned(const Mat3& R, const Sym3& I) {
  const Vec3 a = I * R.r0, b = I * R.r1, c = I * R.r2;
  return {dot(R.r0, a), dot(R.r1, b), dot(R.r2, c), dot(R.r0, b), dot(R.r0, c), dot(R.r1, c)};
}

// Rotation about a unit axis (Rodrigues).
FUNCTION Mat3 rotation(Vec3 axis, Num angle) {
  Num s, c;
  sine_cosine(angle, &s, &c);
  const Vec3 k = axis * (Num(1) - c);
  return {{c + k.x * axis.x, k.x * axis.y - s * axis.z, k.x * axis.z + s * axis.y},
          {k.x * axis.y + s * axis.z, c + k.y * axis.y, k.y * axis.z - s * axis.x},
          {k.x * axis.z - s * axis.y, k.y * axis.z + s * axis.x, c + k.z * axis.z}};
}

struct Quat {
  Num w, x, y, z;
};
FUNCTION Quat quat(const Real* p) { return {Num(p[0]), Num(p[1]), Num(p[2]), Num(p[3])}; }
FUNCTION Quat operator*(Quat a, Quat b) {
  return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
          a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}
FUNCTION Quat normalised(Quat q) {
  const Num scale = inverse_root(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
  return {q.w * scale, q.x * scale, q.y * scale, q.z * scale};
}
FUNCTION Mat3 rotation(Quat q) {
  const Num two = Num(2);
  const Num ww = q.w * q.w, xx = q.x * q.x, yy = q.y * q.y, zz = q.z * q.z;
  return {{ww + xx - yy - zz, two * (q.x * q.y - q.w * q.z), two * (q.x * q.z + q.w * q.y)},
          {two * (q.x * q.y + q.w * q.z), ww - xx + yy - zz, two * (q.y * q.z - q.w * q.x)},
          {two * (q.x * q.z - q.w * q.y), two * (q.y * q.z + q.w * q.x), ww - xx - yy + zz}};
}
FUNCTION Quat quat_about(Vec3 axis, Num angle) {
  Num s, c;
  sine_cosine(angle * Num(Real(.5)), &s, &c);
  return {c, axis.x * s, axis.y * s, axis.z * s};
}
// q turned by the angular velocity `spin` (its own frame) for `time` (mju_quatIntegrate), and normalised.
FUNCTION Quat integrated(Quat q, Vec3 spin, Num time) {
  const Num square = dot(spin, spin) + Num(Real(1e-30));
  const Num scale = inverse_root(square);
  Num s, c;
  sine_cosine(Num(Real(.5)) * time * square * scale, &s, &c);
  s *= scale;
  return normalised(q * Quat{c, spin.x * s, spin.y * s, spin.z * s});
}
