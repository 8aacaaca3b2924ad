// MuJoCo's formulae of contacts, constraints and fluid, which do not depend on the schedule.
#pragma once
#include "algebra.h"
#include "boxes.h"

// Segments are parallel where the square of the sine between them is below this, and centres are one below TINY (mjMINVAL).
// MuJoCo 3.17 has 1e-8 and 1e-15; rounding in float makes as much of what is zero in double.
constexpr Real PARALLEL = SINGLE ? Real(1e-6) : Real(1e-8);
constexpr Real TINY = SINGLE ? Real(2e-6) : Real(1e-15);

// Impedance at a distance beyond the margin: a power of 2 with its midpoint at a half (engine_core_constraint.c,
// getimpedance).
FUNCTION Num impedance(Num position, Num lowest, Num highest, Num inverse_width) {
  const Num one = Num(1), two = Num(2);
  const Num x = size_of(position) * inverse_width;
  const Num rising = two * x * x, falling = one - two * (one - x) * (one - x);
  const Num y = select(x <= Num(Real(.5)), rising, falling);
  return select(x >= one, highest, lowest + y * (highest - lowest));
}

// What a contact's frame is in: the world's axes, as seen from the frame that all is computed in.
struct World {
  Vec3 x, y, up;
};

// The first tangent on a normal, from a direction wanted for it (engine_util_spatial.c, mju_makeFrame).
FUNCTION Vec3 tangent(const World& world, Vec3 normal, Vec3 wanted) {
  const Vec3 flat = wanted - normal * dot(normal, wanted);
  const Num square = dot(flat, flat);
  const Mask found = square > Num(TINY * TINY);
  return select(found, flat * inverse_root(select(found, square, Num(1))), world.x);
}
FUNCTION Vec3 tangent(const World& world, Vec3 normal) {
  const Mask level = size_of(dot(world.y, normal)) < Num(Real(.5));
  return tangent(world, normal, select(level, world.y, world.up));
}

// Where two segments are nearest: shares of their half axes, -1 to 1. Where they are parallel, both ends of the stretch
// that they share (mjraw_CapsuleCapsule).
struct Nearest {
  Num first, second;
  Mask two;  // worlds with another contact, at these shares
  Num first_again, second_again;
};

struct Segments {
  Vec3 middle1, middle2, half1, half2;
};

FUNCTION Nearest nearest_of_sphere_and_capsule(const Segments& s) {
  const Num none = dot(s.half1, s.half1) * Num(0);
  const Num share = dot(s.half2, s.middle1 - s.middle2) / dot(s.half2, s.half2);
  return {none, clip(share, Num(-1), Num(1)), mask_of(false), none, none};
}

FUNCTION Nearest nearest_of_capsules(const Segments& s) {
  const Num one = Num(1), less = Num(-1);
  const Vec3 apart = s.middle1 - s.middle2;
  const Num aa = dot(s.half1, s.half1), ab = -dot(s.half1, s.half2), bb = dot(s.half2, s.half2);
  const Num u = -dot(s.half1, apart), v = dot(s.half2, apart);
  const Num determinant = aa * bb - ab * ab;
  const Mask parallel = determinant < Num(PARALLEL) * aa * bb;
  const Num divisor = select(parallel, one, determinant);  // a world whose capsules are parallel must not see NaN
  Num first = (bb * u - ab * v) / divisor, second = (aa * v - ab * u) / divisor;
  second = select(first > one, (v - ab) / bb, select(first < less, (v + ab) / bb, second));
  first = clip(first, less, one);
  const Num of_end = (u - ab) / aa, of_start = (u + ab) / aa;  // of the second, on the first
  first = select(second > one, clip(of_end, less, one), select(second < less, clip(of_start, less, one), first));
  second = clip(second, less, one);
  Nearest found = {first, second, parallel, first, second};
  if (!any(parallel)) return found;
  // An end of the second where it is beside the first, else the end of the first that it is beyond.
  const Num on_first[2] = {clip(of_end, less, one), clip(of_start, less, one)};
  Num on_second[2] = {one, less};
  for (int k = 0; k < 2; ++k) {
    const Mask beyond = size_of(k ? of_start : of_end) > one;
    on_second[k] = select(beyond, clip((v - ab * on_first[k]) / bb, less, one), on_second[k]);
  }
  found.first = select(parallel, on_first[0], found.first);
  found.second = select(parallel, on_second[0], found.second);
  found.first_again = on_first[1];
  found.second_again = on_second[1];
  return found;
}

// The normal from one centre to another, `apart` and `distance` long; where they are one, a cross product of the geoms'
// x axes (mjraw_SphereSphere).
FUNCTION Vec3 normal_between(const World& world, Vec3 apart, Num distance, Vec3 side1, Vec3 side2) {
  const Mask clear = distance > Num(TINY);
  const Vec3 along = apart * inverse(select(clear, distance, Num(1)));
  if (!any(!clear)) return along;
  const Vec3 across = cross(side1, side2);
  const Num square = dot(across, across);
  const Mask crossing = square > Num(TINY * TINY);
  const Vec3 instead = select(crossing, across * inverse_root(select(crossing, square, Num(1))), world.x);
  return select(clear, along, instead);
}

// Force and moment (about the box's centre) of a fluid at rest on a box that moves and spins, in the box's axes
// (engine_passive.c, mj_inertiaBoxFluidModel).
FUNCTION void fluid_on_box(Vec3 size, Vec3 velocity, Vec3 spin, Num density, Num viscosity, Vec3* force, Vec3* moment) {
  const Num pi = Num(Real(3.14159265358979323846));
  const Num diameter = (size.x + size.y + size.z) / Num(3);
  const Num xx = size.x * size.x, yy = size.y * size.y, zz = size.z * size.z;
  const Num x4 = xx * xx, y4 = yy * yy, z4 = zz * zz;
  const Num half = density / Num(2), sixtyfourth = density / Num(64);
  const Vec3 drag = vec(half * size.y * size.z * size_of(velocity.x) * velocity.x,
                        half * size.x * size.z * size_of(velocity.y) * velocity.y,
                        half * size.x * size.y * size_of(velocity.z) * velocity.z);
  const Vec3 turning = vec(sixtyfourth * size.x * (y4 + z4) * size_of(spin.x) * spin.x,
                           sixtyfourth * size.y * (x4 + z4) * size_of(spin.y) * spin.y,
                           sixtyfourth * size.z * (x4 + y4) * size_of(spin.z) * spin.z);
  *force = velocity * (Num(-3) * pi * diameter * viscosity) - drag;
  *moment = spin * (-pi * diameter * diameter * diameter * viscosity) - turning;
}
