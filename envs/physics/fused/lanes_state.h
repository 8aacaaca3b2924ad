// What a step of several worlds works on. MODEL is the file that header.py wrote.
#pragma once
#include "formulae.h"
#include MODEL

constexpr int FIRST = HAS_FREE ? 6 : 0;  // degree of freedom of the first joint
constexpr int CORNERS = 8;  // of a box, and the most contacts of two boxes
constexpr int CANDIDATES = NPOINTS + 2 * (NPAIRS - NBOX_PAIRS) + CORNERS * NBOX_PAIRS;
constexpr int MOST_SLOTS = CANDIDATES < MOST_CONTACTS * LANES ? CANDIDATES : MOST_CONTACTS * LANES;
// Loops over small trees are unrolled, so that indices are constants and small arrays stay in registers.
constexpr bool UNROLLED = NV <= 16 && !FILLS;

constexpr bool reads(int field) {
  for (int k = 0; k < NREADINGS; ++k) {
    if (READINGS[k].field == field) return true;
  }
  return false;
}
constexpr int NSEGMENT_PAIRS = NPAIRS - NBLOCK_PAIRS - NBOX_PAIRS;  // they are the first, those of two boxes the last
constexpr bool FLUID = NBOXES > 0;
constexpr bool READS_FORCES = reads(CFRC_EXT);

constexpr int at_least_one(int size) { return size > 0 ? size : 1; }

template <bool FIRST, class A, class B> struct Chosen { typedef A type; };
template <class A, class B> struct Chosen<false, A, B> { typedef B type; };

template <int I> struct Index {
  static constexpr int value = I;
  constexpr operator int() const { return I; }
};
template <int FROM, int TO, class Body> FUNCTION void repeat(const Body& body) {
  if constexpr (FROM < TO) {
    body(Index<FROM>{});
    repeat<FROM + 1, TO>(body);
  }
}

// A contact's place and axes: the normal, and both tangents times friction; the axes of spin and rolling, times theirs.
struct Frame {
  Vec3 place, axes[DIRECTIONS];
};

typedef Chosen<(NV > 64), unsigned __int128, unsigned long long>::type WideDofs;
typedef Chosen<(NV > 32), WideDofs, unsigned>::type Dofs;  // a bit for each

// A contact that at least one world has.
struct Slot {
  Num jacobian[MOST_COLUMNS][DIRECTIONS];  // of the frame's axes, by the degrees of freedom in `dofs`
  Num weight;                              // D of each edge; 0 in worlds without the contact
  Num residual[DIRECTIONS];                // acceleration along the axes, less the reference's
  Num change[DIRECTIONS];                  // of it by a full Newton step
  Mask has, active[2 * (DIRECTIONS - 1)];  // edges whose residual is negative: two for each axis after the normal
  Frame frame;                    // for the forces on bodies
  const int* dofs;
  int columns, place1, place2, dims;
  MEMBER int frictions() const { return DIRECTIONS == 3 ? 2 : dims - 1; }  // axes after the normal
};

struct alignas(64) Worlds {
  // The state and its integration.
  Num qpos[NQ], qvel[NV], start_qpos[NQ], start_qvel[NV], mean_velocity[NV], mean_acceleration[NV];
  Num acceleration[NV], motor[NV], warmstart[NV];
  Num drive[at_least_one(NU)];  // forces of actuators by their controls
  // The frame of the base, in which all below is.
  World world;
  Mat3 attitude;     // of the base in the world
  Num height;        // of the base's origin
  Num velocity[NV];  // the root's first three in the base's frame
  // Bodies: pose, motion without joint accelerations; force, moment and inertia about the base's origin, which become
  // those of the subtree.
  Mat3 turn[NBODIES];
  Vec3 place[NBODIES], spin[NBODIES], spin_rate[NBODIES], rate[NBODIES], drift[NBODIES];
  Vec3 force[NBODIES], moment[NBODIES], first_moment[NBODIES];
  Sym3 inertia[NBODIES];
  Vec3 axis_spin[NV], axis_move[NV];  // motion by a unit velocity of a joint, of the point at the origin
  // The problem: minimise (a - smooth) M (a - smooth) / 2 and the constraints' cost.
  Num M[NV][NV], H[NV][NV], smooth[NV];
  Num a[NV], Ma[NV], gradient[NV], step[NV], M_step[NV];
  Slot slots[at_least_one(MOST_SLOTS)];
  int slot_count, limit_count, limits[at_least_one(NLIMITS)];  // those that some world has
  Num limit_weight[at_least_one(NLIMITS)], limit_residual[at_least_one(NLIMITS)];
  Num limit_change[at_least_one(NLIMITS)], limit_sign[at_least_one(NLIMITS)];
  Mask limit_active[at_least_one(NLIMITS)];
  Dofs pattern[NV];  // H's entries below the diagonal, a bit each, where contacts fill it
  // What leaves.
  Num contacts, overflow;
  Num out[at_least_one(WIDTH)];
};
