// The step itself; see threads.h. MODEL is the file of tables that threads.py writes.
#pragma once
#include "threads.h"
#include MODEL

// Rows of shared memory that lanes read at a stride: whole fours that meet all banks, or an odd number of singles.
constexpr int fours(int n) { return (n + 3) / 4 % 2 ? (n + 3) / 4 * 4 : (n + 3) / 4 * 4 + 4; }

constexpr int WIDTH = (NV + 1) | 1;  // of a row of H: its last column is the right side
constexpr int M_WIDTH = fours(NV);
constexpr int PACKED = TRUNK * (TRUNK + 1) / 2 + TRUNK;  // the trunk's lower triangle, then its right side
constexpr int J_WIDTH = fours(4 * COLUMNS);  // of a contact's Jacobian: normal, two tangents and a gap for each column
constexpr int D_WIDTH = 12;
constexpr int MOTION = 7;  // an angular and a linear part
constexpr int FRAME = 13;
constexpr int LINK = 17;   // a joint: rotation, anchor, axis, speed
constexpr int SUMS = 15;   // of what hangs on a body: first moment, inertia, force, moment
constexpr int LINE_SEARCH_STEPS = 12;
#ifndef UNROLL_ROUNDS
#define UNROLL_ROUNDS (ROUNDS <= 3)
#endif
#ifndef UNROLL_DEPTH
#define UNROLL_DEPTH 3
#endif
constexpr int BASE_DOFS = FREE ? 6 : 0;   // joint j moves dof BASE_DOFS + j,
constexpr int BASE_QPOS = FREE ? 7 : 0;   // and its qpos is BASE_QPOS + j

// What the lanes of a world share.
struct alignas(16) World {
  union {  // kinematics, then forces, then the solver
    real joint[JOINTS + 1][LINK];
    real momentum[NV][MOTION];
    struct {
      alignas(16) real packed[PACKED + 4];
      alignas(16) real step[(NV + 3) / 4 * 4];
      real inverse[NV];  // of the pivots
    };
  };
  alignas(16) real acceleration[(NV + 3) / 4 * 4];  // the solver's qacc, in the base's frame
  alignas(16) real M[NV * M_WIDTH];
  alignas(16) real J[SLOTS * J_WIDTH];
  alignas(16) real D[SLOTS * D_WIDTH];  // a contact's weights nn n1 n2 11 22 and, from the ninth, its force n 1 2
  real H[NV * WIDTH];                   // above its diagonal it holds the factor L, transposed
  real qacc[NV];                        // in MuJoCo's coordinates; the start of the next solve
  real qpos[NQ], qvel[NV], actuator[NV];
  real start_qpos[NQ], start_qvel[NV], sum_velocity[NV], sum_acceleration[NV], rate[NV];
  real velocity[NV];  // qvel in the base's frame
  real smooth[NV];    // forces without constraints
  real limit_weight[NV], limit_force[NV];
  real base[9];
  real pose[BODIES][FRAME];
  real sums[BODIES][SUMS];
  real axis[NV][MOTION];
#if FLUID
  real motion[BODIES][7];
  real drag[BOXES][7];
#endif
#if PAIRS > 0
  real segment[SEGMENTS][7];  // middle, and half of the length
  short near[PAIRS];          // pairs that may touch
#endif
#if !OWN_SLOTS
  real contact[SLOTS][11];
  int candidate[SLOTS];
  unsigned touching[NV];  // contacts that a dof moves
  unsigned moved[SLOTS];  // dofs that a contact moves with
#endif
};

// Four numbers at once.
#ifdef __CUDACC__
typedef float4 Four;
DEVICE Four four_at(const real* from) { return *reinterpret_cast<const float4*>(from); }
DEVICE void put_four(real* to, real a, real b, real c) { *reinterpret_cast<float4*>(to) = make_float4(a, b, c, 0); }
#else
struct Four {
  real x, y, z, w;
};
DEVICE Four four_at(const real* from) { return {from[0], from[1], from[2], from[3]}; }
DEVICE void put_four(real* to, real a, real b, real c) {
  to[0] = a;
  to[1] = b;
  to[2] = c;
}
#endif

// A lane's contact: its four edges are normal +- first, normal +- second; the tangents' Jacobians are times friction.
struct Contact {
  bool exists;
  int candidate;
  real weight;             // D of an edge
  real normal, first, second;     // J a - aref
  real d_normal, d_first, d_second;  // its change along the step
  unsigned dofs;           // those that move the two bodies apart
  unsigned active;         // edges
};

struct Limit {
  real weight, residual, change, sign;
};

struct Touch {
  Vec point, normal, tangent;
  real distance;
};

DEVICE real impedance_at(real violation, real lowest, real highest, real inverse_width) {
  const real x = absolute(violation) * inverse_width;
  if (x >= real(1)) return highest;
  const real y = x <= real(0.5) ? real(2) * x * x : real(1) - real(2) * (real(1) - x) * (real(1) - x);
  return lowest + y * (highest - lowest);
}

// ---- kinematics and forces ----------------------------------------------------------------------------------------
// A lane a joint: what it turns and moves by, in its parent's frame. Also velocities in the base's frame.
DEVICE void place_joints(World& w) {
  EACH_LANE {
#if FREE
    const Mat base = rotation(w.qpos[3], w.qpos[4], w.qpos[5], w.qpos[6]);
    if (lane == LANES - 1) put(w.base, base);
    if (lane == LANES - 2) put(w.velocity, mul_transposed(base, vec_at(w.qvel)));
    if (lane == LANES - 3) put(w.acceleration, mul_transposed(base, vec_at(w.qacc)));
#endif
    if (FREE ? lane >= 3 && lane < NV : lane < NV) {
      w.velocity[lane] = w.qvel[lane];
      w.acceleration[lane] = w.qacc[lane];
    }
    if (lane < JOINTS) {
      const real at = w.qpos[BASE_QPOS + lane] - joint_reference(lane);
      const Vec axis = joint_axis(lane);
      const int kind = joint_kind(lane);
      Vec anchor = joint_anchor(lane);
      Mat R = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
      if (kind == HINGE) R = rotation(axis, at);
      if (kind == SLIDE) anchor = anchor + axis * at;
      if constexpr (TURNED_JOINTS) R = mul(R, joint_rotation(lane));
      real* to = w.joint[lane];
      put(to, R);
      put(to + 9, anchor);
      put(to + 12, axis);
      to[15] = w.qvel[BASE_DOFS + lane];
    }
  }
  MEET();
}

// A body's place and motion while a lane walks down its chain; accelerations are those of qacc = 0, and gravity upwards.
struct Walk {
  Mat R;
  Vec p, spin, spin_rate, rate, velocity;
  MEMBER void move(Vec r) {
    rate = rate + cross(spin_rate, r) + cross(spin, cross(spin, r));
    if constexpr (FLUID) velocity = velocity + cross(spin, r);
    p = p + r;
  }
};

DEVICE void pass_joint(World& w, Walk& walk, int joint, bool own) {
  const real* at = w.joint[joint];
  const real speed = at[15];
  real* to = w.axis[BASE_DOFS + joint];
  walk.move(mul(walk.R, vec_at(at + 9)));
  const Vec axis = mul(walk.R, vec_at(at + 12));
  if (ALL_HINGES || joint_kind(joint) == HINGE) {
    walk.R = mul(walk.R, mat_at(at));
    walk.spin_rate = walk.spin_rate + cross(walk.spin, axis) * speed;
    walk.spin = walk.spin + axis * speed;
    if (own) {
      put(to, axis);
      put(to + 3, cross(walk.p, axis));
    }
    if constexpr (OFFSET_JOINTS) walk.move(mul(walk.R, joint_position(joint) * real(-1)));
  } else {
    walk.rate = walk.rate + cross(walk.spin, axis) * (real(2) * speed);
    if constexpr (FLUID) walk.velocity = walk.velocity + axis * speed;
    if constexpr (TURNED_JOINTS) walk.R = mul(walk.R, mat_at(at));
    if (own) {
      put(to, vec(0, 0, 0));
      put(to + 3, axis);
    }
  }
}

DEVICE Sym body_inertia_in(const Mat& R, int body) {
#if ROUND_BODIES
  return outer(body_across(body), body_along(body), mul(R, body_round_axis(body)));
#else
  return turned(R, body_inertia(body));
#endif
}

// A lane a body: its place, and the force and inertia about the base's origin (Newton and Euler).
DEVICE void place_bodies(World& w) {
  EACH_LANE if (lane < BODIES) {
    Walk walk = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, {0, 0, 0}, {0, 0, 0}, {0, 0, 0}, {0, 0, GRAVITY}, {0, 0, 0}};
#if FREE
    walk.spin = vec_at(w.velocity + 3);
    walk.rate = vec_at(w.base + 6) * GRAVITY;
    walk.velocity = vec_at(w.velocity);
#endif
    const auto pass = [&](int level) {
      const int link = chain_link(level * BODIES + lane);
      if (link >= 0) pass_joint(w, walk, link >> 1, link & 1);
    };
    if constexpr (DEPTH <= UNROLL_DEPTH) {
      UNROLLED for (int level = 0; level < DEPTH; ++level) pass(level);
    } else {
      ROLLED for (int level = 0; level < DEPTH; ++level) pass(level);
    }
    put(w.pose[lane], walk.R);
    put(w.pose[lane] + 9, walk.p);
    const real mass = body_mass(lane);
    const Vec arm = mul(walk.R, body_com(lane)), com = walk.p + arm;
    const Sym I = body_inertia_in(walk.R, lane);
    const Vec force =
        (walk.rate + cross(walk.spin_rate, arm) + cross(walk.spin, cross(walk.spin, arm))) * mass;
    const Vec moment = mul(I, walk.spin_rate) + cross(walk.spin, mul(I, walk.spin)) + cross(com, force);
    const Sym about_base = I + outer(mass * dot(com, com), -mass, com);
    real* sums = w.sums[lane];
    put(sums, com * mass);
    put(sums + 3, vec(about_base.xx, about_base.yy, about_base.zz));
    put(sums + 6, vec(about_base.xy, about_base.xz, about_base.yz));
    put(sums + 9, force);
    put(sums + 12, moment);
#if FLUID
    put(w.motion[lane], walk.spin);
    put(w.motion[lane] + 3, walk.velocity);
#endif
  }
  MEET();
}

#if FLUID
// A lane a box: drag and viscous resistance (mj_inertiaBoxFluidModel), as a force to overcome.
DEVICE void add_fluid(World& w) {
  EACH_LANE if (lane < BOXES) {
    const int body = box_body(lane);
    const Mat R = mat_at(w.pose[body]), E = transposed(mul(R, box_axes(lane)));
    const Vec arm = mul(R, box_centre(lane)), centre = vec_at(w.pose[body] + 9) + arm;
    const Vec spin = vec_at(w.motion[body]), velocity = vec_at(w.motion[body] + 3) + cross(spin, arm);
    const Vec u = mul(E, spin), v = mul(E, velocity), b = box_size(lane);
    const real pi = real(3.14159265358979323846), d = (b.x + b.y + b.z) / 3;
    const Vec b4 = {b.x * b.x * b.x * b.x, b.y * b.y * b.y * b.y, b.z * b.z * b.z * b.z};
    Vec moment = u * (pi * d * d * d * VISCOSITY), force = v * (3 * pi * d * VISCOSITY);
    force = force + vec(b.y * b.z * absolute(v.x) * v.x, b.x * b.z * absolute(v.y) * v.y,
                        b.x * b.y * absolute(v.z) * v.z) *
                        (real(0.5) * DENSITY);
    moment = moment + vec(b.x * (b4.y + b4.z) * absolute(u.x) * u.x, b.y * (b4.x + b4.z) * absolute(u.y) * u.y,
                          b.z * (b4.x + b4.y) * absolute(u.z) * u.z) *
                          (DENSITY / 64);
    force = mul_transposed(E, force);
    moment = mul_transposed(E, moment) + cross(centre, force);
    put(w.drag[lane], force);
    put(w.drag[lane] + 3, moment);
  }
  MEET();
}
#endif

// A lane one of the sums: adds what hangs on each body, from the leaves to the base.
DEVICE void sum_subtrees(World& w) {
#if FLUID
  add_fluid(w);
#endif
  EACH_LANE if (lane < SUMS) {
    real x[BODIES];
    repeat<0, BODIES>([&](auto body) { x[body] = w.sums[body][lane]; });
#if FLUID
    if (lane >= 9) repeat<0, BOXES>([&](auto box) { x[BOX_BODY[box]] += w.drag[box][lane - 9]; });
#endif
    repeat<1, BODIES>([&](auto number) {
      constexpr int body = BODIES - number;
      x[BODY_PARENT[body]] += x[body];
    });
    repeat<0, BODIES>([&](auto body) {
      if constexpr (BODY_CHANGES[body]) w.sums[body][lane] = x[body];
    });
  }
  MEET();
}

// A lane a dof: the momentum of what hangs on it per unit of its speed, and the force without constraints.
DEVICE void find_forces(World& w) {
  EACH_LANE if (lane < NV) {
    real force = w.actuator[lane] - dof_damping(lane) * w.velocity[lane];
    if (SPRINGS && lane >= BASE_DOFS) force -= dof_stiffness(lane) * (w.qpos[lane - BASE_DOFS + BASE_QPOS] - dof_spring(lane));
    if (FREE && lane < 6) {
      w.smooth[lane] = force - w.sums[0][9 + lane];
    } else {
      const int body = dof_body(lane);
      const real* sums = w.sums[body];
      const Vec angular = vec_at(w.axis[lane]), linear = vec_at(w.axis[lane] + 3), moment = vec_at(sums);
      const Sym I = {sums[3], sums[4], sums[5], sums[6], sums[7], sums[8]};
      const Vec push = linear * body_subtree_mass(body) + cross(angular, moment);
      const Vec turn = mul(I, angular) + cross(moment, linear);
      put(w.momentum[lane], turn);
      put(w.momentum[lane] + 3, push);
      w.smooth[lane] = force - dot(angular, vec_at(sums + 12)) - dot(linear, vec_at(sums + 9));
      if constexpr (FREE) {
        const real row[6] = {push.x, push.y, push.z, turn.x, turn.y, turn.z};
        UNROLLED for (int k = 0; k < 6; ++k) {
          w.M[lane * M_WIDTH + k] = row[k];
          w.M[k * M_WIDTH + lane] = row[k];
        }
      }
    }
    w.limit_weight[lane] = w.limit_force[lane] = 0;
  }
  MEET();
}

// The entries of M that change: pairs of dofs on one chain, and the base's block.
DEVICE void find_inertia(World& w) {
  EACH_LANE {
    UNROLLED for (int e = lane; e < PAIR_ENTRIES; e += LANES) {
      const unsigned entry = pair_entry(e);
      const int i = entry & 255, j = entry >> 8;
      const real* a = w.axis[j];
      const real* b = w.momentum[i];
      real y = i == j ? dof_armature(i) : real(0);
      UNROLLED for (int k = 0; k < 6; ++k) y += a[k] * b[k];
      w.M[i * M_WIDTH + j] = y;
      w.M[j * M_WIDTH + i] = y;
    }
    if (FREE && lane < BASE_ENTRIES) {
      const unsigned entry = base_entry(lane);  // i, j, which of the sums, whether its sign changes
      const int i = entry & 255, j = entry >> 8 & 255;
      const real x = w.sums[0][entry >> 16 & 255];
      const real y = (entry >> 24 ? -x : x) + (i == j ? dof_armature(i) : real(0));
      w.M[i * M_WIDTH + j] = y;
      w.M[j * M_WIDTH + i] = y;
    }
  }
}

// What is the same in all evaluations of a step, and what is never written.
DEVICE void clear(World& w) {
  EACH_LANE {
    ROLLED for (int k = lane; k < NV * M_WIDTH; k += LANES) w.M[k] = 0;
    ROLLED for (int k = lane; k < NV * WIDTH; k += LANES) w.H[k] = 0;
    if (lane < 4) w.acceleration[(NV + 3) / 4 * 4 - 4 + lane] = 0;
  }
  MEET();
#if FREE
  EACH_LANE if (lane < 3) w.M[lane * M_WIDTH + lane] = body_subtree_mass(0) + dof_armature(lane);
  MEET();
#endif
}

// Of all motors on a dof, at controls clipped to their ranges.
DEVICE real motor_force(const real* ctrl, int dof) {
  real force = 0;
  ROLLED for (int m = 0; m < NU; ++m) {
    if (motor_dof(m) == dof) force += motor_gain(m) * clamped(ctrl[m], motor_low(m), motor_high(m));
  }
  return force;
}

// ---- contacts -----------------------------------------------------------------------------------------------------
DEVICE Vec world_up(const World& w) { return FREE ? vec_at(w.base + 6) : vec(0, 0, 1); }
DEVICE Vec world_side(const World& w) { return FREE ? vec_at(w.base + 3) : vec(0, 1, 0); }

// A point over the floor. mjc_PlaneSphere, mjc_PlaneCapsule: a capsule's axis is the first tangent.
DEVICE bool touches_floor(const World& w, int point, Touch& touch) {
  const real* pose = w.pose[point_body(point)];
  const Mat R = mat_at(pose);
  const Vec up = world_up(w), centre = mul(R, point_centre(point)) + vec_at(pose + 9);
  const real height = (FREE ? w.qpos[2] : real(0)) - point_height(point);
  touch.distance = dot(up, centre) + height - point_radius(point);
  if (!(touch.distance <= contact_margin(point))) return false;
  touch.normal = up;
  touch.point = centre - up * (point_radius(point) + real(0.5) * touch.distance);
  touch.tangent = point_round(point) ? world_side(w) : mul(R, point_axis(point));
  return true;
}

#if PAIRS > 0
// Where two segments come nearest: centre + half * x of each, |x| <= 1 (mjraw_CapsuleCapsule, mjraw_SphereCapsule).
// Parallel capsules have up to two places: the first two of the four ends that touch.
struct Nearest {
  bool touches;
  Vec from, to;
};

DEVICE Nearest nearest(Vec a, Vec half_a, real x, Vec b, Vec half_b, real y, real reach) {
  const Vec from = a + half_a * x, to = b + half_b * y, gap = to - from;
  return {dot(gap, gap) <= reach * reach, from, to};
}

DEVICE Nearest nearest_parallel(Vec a, Vec half_a, Vec b, Vec half_b, const real (&c)[5], real reach, int which) {
  const real aa = c[0], ab = c[1], bb = c[2], u = c[3], v = c[4];
  Nearest found = {false, a, b};
  int seen = 0;
  ROLLED for (int end = 0; end < 4; ++end) {
    const real side = end & 1 ? real(-1) : real(1);
    const real x = end < 2 ? side : clamped((u - side * ab) / aa, -1, 1);
    const real y = end < 2 ? clamped((v - side * ab) / bb, -1, 1) : side;
    const Nearest place = nearest(a, half_a, x, b, half_b, y, reach);
    if (place.touches && seen++ == which) found = place;
  }
  return found;
}

DEVICE Nearest nearest_of(Vec a, Vec half_a, Vec b, Vec half_b, real reach, int which) {
  const Vec between = a - b;
  const real aa = dot(half_a, half_a), ab = -dot(half_a, half_b), bb = dot(half_b, half_b);
  const real u = -dot(half_a, between), v = dot(half_b, between);
  if (aa == 0 || bb == 0) {
    const real x = aa > 0 ? clamped(u / aa, -1, 1) : real(0);
    const real y = bb > 0 ? clamped(v / bb, -1, 1) : real(0);
    Nearest found = nearest(a, half_a, x, b, half_b, y, reach);
    found.touches = found.touches && which == 0;
    return found;
  }
  // By products that do not cancel: aa bb - ab ab, and so on.
  const Vec across = cross(half_a, half_b);
  const real det = dot(across, across);
  if (!(det >= PARALLEL * aa * bb + real(1e-15))) {
    const real c[5] = {aa, ab, bb, u, v};
    return nearest_parallel(a, half_a, b, half_b, c, reach, which);
  }
  real x = dot(across, cross(half_b, between)) / det, y = dot(across, cross(half_a, between)) / det;
  if (x > 1) {
    x = 1;
    y = (v - ab) / bb;
  } else if (x < -1) {
    x = -1;
    y = (v + ab) / bb;
  }
  if (y > 1) {
    y = 1;
    x = clamped((u - ab) / aa, -1, 1);
  } else if (y < -1) {
    y = -1;
    x = clamped((u + ab) / aa, -1, 1);
  }
  Nearest found = nearest(a, half_a, x, b, half_b, y, reach);
  found.touches = found.touches && which == 0;
  return found;
}

// A lane a segment: where it is.
DEVICE void place_segments(World& w) {
  EACH_LANE {
    for (int k = lane; k < SEGMENTS; k += LANES) {
      const real* pose = w.pose[segment_body(k)];
      const Mat R = mat_at(pose);
      put(w.segment[k], mul(R, segment_centre(k)) + vec_at(pose + 9));
      put(w.segment[k] + 3, mul(R, segment_half(k)));
    }
  }
  MEET();
}

// Lists the pairs whose bounding spheres touch, and returns how many.
DEVICE int list_near(World& w) {
  int found = 0;
  ROLLED for (int start = 0; start < PAIRS; start += LANES) {
    PerLane<bool> near;
    EACH_LANE {
      const int pair = start + lane;
      near[ME] = false;
      if (pair < PAIRS) {
        const unsigned segments = pair_segments(pair);
        const Vec between = vec_at(w.segment[segments & 255]) - vec_at(w.segment[segments >> 8]);
        near[ME] = dot(between, between) <= pair_far(pair);
      }
    }
    const unsigned hits = ballot(near);
    EACH_LANE if (near[ME]) w.near[found + count(hits & ((1u << lane) - 1u))] = short(start + lane);
    found += count(hits);
  }
  MEET();
  return found;
}

// mjraw_SphereSphere at the nearest places. Segments that cross have no normal: MuJoCo takes a product of two axes.
DEVICE bool touches_pair(const World& w, int pair, int which, Touch& touch) {
  const unsigned segments = pair_segments(pair);
  const int first = segments & 255, second = segments >> 8;
  const real radii = segment_radius(first) + segment_radius(second), reach = radii + contact_margin(POINTS + pair);
  const Nearest found = nearest_of(vec_at(w.segment[first]), vec_at(w.segment[first] + 3), vec_at(w.segment[second]),
                                   vec_at(w.segment[second] + 3), reach, which);
  if (!found.touches) return false;
  const Vec gap = found.to - found.from;
  const real length = root(dot(gap, gap));
  Vec normal = gap * (real(1) / length);
  if (length < CROSSING) {
    normal = cross(mul(mat_at(w.pose[segment_body(first)]), segment_side(first)),
                   mul(mat_at(w.pose[segment_body(second)]), segment_side(second)));
    const real size = root(dot(normal, normal));
    normal = size < real(1e-15) ? vec(1, 0, 0) : normal * (real(1) / size);
  }
  const Vec side = world_side(w);
  touch.distance = length - radii;
  touch.normal = normal;
  touch.point = found.from + normal * (segment_radius(first) + real(0.5) * touch.distance);
  touch.tangent = absolute(dot(side, normal)) < real(0.5) ? side : world_up(w);
  return true;
}
#endif

// Contacts in slots: a point's own lane, or the next that is free. Returns how many there are.
DEVICE int collect_contacts(World& w, PerLane<Contact>& contacts, PerLane<Touch>& touch) {
#if OWN_SLOTS
  PerLane<bool> hit;
  EACH_LANE {
    hit[ME] = lane < POINTS && touches_floor(w, lane, touch[ME]);
    contacts[ME].exists = hit[ME];
    contacts[ME].candidate = lane;
  }
  return count(ballot(hit));
#else
  int found = 0;
  const auto take = [&](const PerLane<bool>& hit, const PerLane<int>& candidate) {
    const unsigned hits = ballot(hit);
    EACH_LANE {
      const int slot = found + count(hits & ((1u << lane) - 1u));
      if (hit[ME] && slot < SLOTS) {
        real* to = w.contact[slot];
        put(to, touch[ME].point);
        put(to + 3, touch[ME].normal);
        put(to + 6, touch[ME].tangent);
        to[9] = touch[ME].distance;
        w.candidate[slot] = candidate[ME];
      }
    }
    found += count(hits);
  };
  PerLane<bool> hit;
  PerLane<int> candidate;
  ROLLED for (int start = 0; start < POINTS; start += LANES) {
    EACH_LANE {
      candidate[ME] = start + lane;
      hit[ME] = start + lane < POINTS && touches_floor(w, start + lane, touch[ME]);
    }
    take(hit, candidate);
  }
#if PAIRS > 0
  place_segments(w);
  const int near = list_near(w);  // parallel capsules touch twice
  ROLLED for (int start = 0; start < 2 * near; start += LANES) {
    EACH_LANE {
      const int item = start + lane, pair = item < 2 * near ? w.near[item >> 1] : 0;
      candidate[ME] = POINTS + pair;
      hit[ME] = item < 2 * near && touches_pair(w, pair, item & 1, touch[ME]);
    }
    take(hit, candidate);
  }
#endif
  MEET();
  EACH_LANE {
    contacts[ME].exists = lane < found && lane < SLOTS;
    if (contacts[ME].exists) {
      const real* from = w.contact[lane];
      touch[ME] = {vec_at(from), vec_at(from + 3), vec_at(from + 6), from[9]};
      contacts[ME].candidate = w.candidate[lane];
    }
  }
  return found;
#endif
}

// A column of a contact's Jacobian: how fast a dof moves the bodies apart along the normal and the scaled tangents.
struct Directions {
  Vec normal, first, second;              // forces
  Vec normal_turn, first_turn, second_turn;  // their moments about the base's origin
};

DEVICE void put_column(World& w, int slot, int column, const real (&row)[3], real rate, Contact& contact) {
  put_four(w.J + slot * J_WIDTH + 4 * column, row[0], row[1], row[2]);
  contact.normal += row[0] * rate;
  contact.first += row[1] * rate;
  contact.second += row[2] * rate;
}

// The columns of the dofs that move the contact, in their order.
DEVICE void put_columns(World& w, int slot, const Directions& d, real damping, Contact& contact) {
  int column = 0;
#if FREE
  if (contact.dofs & 1u) {
    const Vec n[2] = {d.normal, d.normal_turn}, t[2] = {d.first, d.first_turn}, u[2] = {d.second, d.second_turn};
    UNROLLED for (int k = 0; k < 6; ++k) {
      const Vec a = n[k / 3], b = t[k / 3], c = u[k / 3];
      const int axis = k % 3;
      const real row[3] = {axis == 0 ? a.x : axis == 1 ? a.y : a.z, axis == 0 ? b.x : axis == 1 ? b.y : b.z,
                           axis == 0 ? c.x : axis == 1 ? c.y : c.z};
      put_column(w, slot, k, row, w.acceleration[k] + damping * w.velocity[k], contact);
    }
    column = 6;
  }
#endif
#if PAIRS > 0
  const unsigned opposite = contact_opposite(contact.candidate);
#endif
  for (unsigned dofs = contact.dofs & OUTER_DOFS; dofs; dofs &= dofs - 1) {
    const int dof = lowest(dofs);
    const Vec angular = vec_at(w.axis[dof]), linear = vec_at(w.axis[dof] + 3);
    real row[3] = {dot(angular, d.normal_turn) + dot(linear, d.normal),
                   dot(angular, d.first_turn) + dot(linear, d.first),
                   dot(angular, d.second_turn) + dot(linear, d.second)};
#if PAIRS > 0
    if (opposite >> dof & 1u) {
      UNROLLED for (int k = 0; k < 3; ++k) row[k] = -row[k];
    }
#endif
    put_column(w, slot, column++, row, w.acceleration[dof] + damping * w.velocity[dof], contact);
  }
}

// The column of a dof in a contact's Jacobian.
DEVICE int column_of(const World& w, int slot, int dof) {
#if OWN_SLOTS
  return dof_column(dof);
#else
  return count(w.moved[slot] & ((1u << dof) - 1u));
#endif
}

// The first tangent times friction (mju_makeFrame).
DEVICE Vec first_tangent(const Touch& touch, int candidate) {
  const Vec t = touch.tangent - touch.normal * dot(touch.normal, touch.tangent);
  return t * (contact_friction(candidate) * inverse_root(dot(t, t) + real(1e-30)));
}

// Jacobians, weights (mj_makeImpedance) and residuals J a - aref of contacts and limits at the solver's start.
DEVICE unsigned find_constraints(World& w, PerLane<Contact>& contacts, PerLane<Limit>& limits, bool& lost) {
  PerLane<Touch> touch;
  PerLane<bool> exists;
  const int found = collect_contacts(w, contacts, touch);
  lost = lost || found > SLOTS;
  EACH_LANE {
    Contact& contact = contacts[ME];
    contact.weight = contact.normal = contact.first = contact.second = 0;
    contact.d_normal = contact.d_first = contact.d_second = 0;
    contact.dofs = 0;
    exists[ME] = contact.exists;
    if (contact.exists) {
      const int c = contact.candidate;
      const Vec n = touch[ME].normal, r = touch[ME].point;
      const Vec first = first_tangent(touch[ME], c), second = cross(n, first);
      const Directions directions = {n, first, second, cross(r, n), cross(r, first), cross(r, second)};
      contact.dofs = contact_dofs(c);
      put_columns(w, lane, directions, contact_damping(c), contact);
      const real violation = touch[ME].distance - contact_margin(c);
      const real impedance = impedance_at(violation, contact_lowest(c), contact_highest(c), contact_inverse_width(c));
      contact.weight = impedance * reciprocal(contact_regularisation(c) * (real(1) - impedance));
      contact.normal += contact_stiffness(c) * impedance * violation;
#if !OWN_SLOTS
      w.moved[lane] = contact.dofs;
#endif
    }
    Limit& limit = limits[ME];
    limit.weight = limit.residual = limit.sign = limit.change = 0;
#if LIMITS > 0
    if (lane < LIMITS) {
      const int dof = limit_dof(lane);
      const real q = w.qpos[dof - BASE_DOFS + BASE_QPOS], low = q - limit_low(lane), high = limit_high(lane) - q;
      const real violation = (low < high ? low : high) - limit_margin(lane);
      if (violation < 0) {
        const real impedance =
            impedance_at(violation, limit_lowest(lane), limit_highest(lane), limit_inverse_width(lane));
        limit.sign = low < high ? real(1) : real(-1);
        limit.weight = impedance * reciprocal(limit_inverse_weight(lane) * (real(1) - impedance));
        limit.residual = limit.sign * (w.acceleration[dof] + limit_damping(lane) * w.velocity[dof]) +
                         limit_stiffness(lane) * impedance * violation;
      }
    }
#endif
  }
  const unsigned existing = ballot(exists);
#if !OWN_SLOTS
  if (existing) {
    ROLLED for (int dof = 0; dof < NV; ++dof) {
      PerLane<bool> moved;
      EACH_LANE moved[ME] = contacts[ME].dofs >> dof & 1u;
      const unsigned slots = ballot(moved);
      EACH_LANE if (lane == dof) w.touching[dof] = slots;
    }
  }
#endif
  return existing;
}

// ---- the solver ---------------------------------------------------------------------------------------------------
// M x of a lane's dof.
DEVICE real times_inertia(const World& w, const real* x, int dof) {
  real y = 0;
  UNROLLED for (int j = 0; j < NV; j += 4) {
    const Four a = four_at(w.M + dof * M_WIDTH + j), b = four_at(x + j);
    y += a.x * b.x;
    if (j + 1 < NV) y += a.y * b.y;
    if (j + 2 < NV) y += a.z * b.z;
    if (j + 3 < NV) y += a.w * b.w;
  }
  return y;
}

// An entry of a branch's dof i: H[i][j] -= sum over k below i of H[k][i] H[k][j] / pivot k.
DEVICE void eliminate_entry(World& w, unsigned entry, int below, bool first_round) {
  const int i = entry & 255, j = entry >> 8 & 255;
  real pivot = w.H[i * WIDTH + i], value = w.H[i * WIDTH + j];
  const real* upper = w.H + i * WIDTH + i;
  const real* lower = w.H + i * WIDTH;
  for (int t = 1; t <= below; ++t) {
    lower += WIDTH;
    pivot -= upper[t] * lower[i];
    value -= upper[t] * lower[j];
  }
  const real inverse = reciprocal(pivot);
  if (entry >> 16) w.inverse[i] = inverse;
  if (!first_round) w.H[i * WIDTH + j] = value;
  if (j < NV) w.H[j * WIDTH + i] = value * inverse;
}

// Branches, from the leaves: each entry once.
DEVICE void eliminate_branches(World& w) {
#if UNROLL_ROUNDS
  repeat<0, ROUNDS>([&](auto turn) {
    constexpr int round = turn;
    EACH_LANE {
      UNROLLED for (int e = lane; e < ROUND_SIZE[round]; e += LANES) {
        const unsigned entry = round_entry(ROUND_START[round] + e);
        eliminate_entry(w, entry, ROUND_EVEN[round] ? ROUND_BELOW[round] : dof_below(entry & 255), round == 0);
      }
    }
    MEET();
  });
#else
  ROLLED for (int round = 0; round < ROUNDS; ++round) {
    EACH_LANE {
      ROLLED for (int e = round_start(round) + lane; e < round_start(round + 1); e += LANES) {
        const unsigned entry = round_entry(e);
        eliminate_entry(w, entry, dof_below(entry & 255), false);
      }
    }
    MEET();
  }
#endif
}

// What branches leave of the trunk's triangle and right side.
DEVICE void pack_trunk(World& w) {
  EACH_LANE {
    UNROLLED for (int e = lane; e < PACKED; e += LANES) {
      const unsigned entry = trunk_entry(e);
      const int i = entry & 255, j = entry >> 8 & 255;
      real value = w.H[i * WIDTH + j];
      UNROLLED for (int k = TRUNK; k < NV; ++k) value -= w.H[i * WIDTH + k] * w.H[k * WIDTH + j];
      w.packed[e] = value;
    }
  }
  MEET();
}

DEVICE void load_packed(const World& w, real (&to)[PACKED + 4]) {
  UNROLLED for (int k = 0; k < PACKED; k += 4) {
    const Four four = four_at(w.packed + k);
    to[k] = four.x;
    to[k + 1] = four.y;
    to[k + 2] = four.z;
    to[k + 3] = four.w;
  }
}

// All of the trunk by L D L', in every lane the same.
DEVICE void solve_trunk(const World& w, real (&x)[TRUNK + 1]) {
  real A[PACKED + 4];
  load_packed(w, A);
  real* y = A + TRUNK * (TRUNK + 1) / 2;
  real inverse[TRUNK + 1];
  repeat<0, TRUNK>([&](auto column) {
    constexpr int j = column;
    inverse[j] = reciprocal(A[j * (j + 1) / 2 + j]);
    repeat<j + 1, TRUNK>([&](auto row) {
      constexpr int i = row;
      const real l = A[i * (i + 1) / 2 + j] * inverse[j];
      repeat<j + 1, i + 1>([&](auto k) { A[i * (i + 1) / 2 + k] -= l * A[k * (k + 1) / 2 + j]; });
      y[i] -= l * y[j];
    });
  });
  repeat<0, TRUNK>([&](auto number) {
    constexpr int i = TRUNK - 1 - number;
    real z = y[i];
    repeat<i + 1, TRUNK>([&](auto k) { z -= A[k * (k + 1) / 2 + i] * x[k]; });
    x[i] = z * inverse[i];
  });
}

// x = inverse(H) y along the tree, y the last column of H; x of a dof in its lane. H has M's pattern.
DEVICE void solve_tree(World& w, PerLane<real>& x) {
  eliminate_branches(w);
  if constexpr (TRUNK > 0) pack_trunk(w);
  EACH_LANE {
    real trunk[TRUNK + 1];
    if constexpr (TRUNK > 0) solve_trunk(w, trunk);
    real value = 0;
    repeat<0, TRUNK>([&](auto k) { value = lane == k ? trunk[k] : value; });
    if (lane >= TRUNK && lane < NV) {
      value = w.H[lane * WIDTH + NV] * w.inverse[lane];
      repeat<0, TRUNK>([&](auto k) { value -= w.H[k * WIDTH + lane] * trunk[k]; });
    }
    x[ME] = value;
  }
  ROLLED for (int level = 0; level < BRANCH_LEVELS - 1; ++level) {
    PerLane<int> source;
    EACH_LANE source[ME] = lane < NV ? dof_on_branch(level * NV + lane) : lane;
    const PerLane<real> above = gathered(x, source);
    EACH_LANE if (source[ME] != lane) x[ME] -= w.H[source[ME] * WIDTH + lane] * above[ME];
  }
}

#if FILLS
// The same where a contact between two branches fills H: L D L' from the last dof. H's pattern is clear again behind it.
DEVICE void solve_full(World& w, PerLane<real>& x) {
  ROLLED for (int k = NV - 1; k >= 0; --k) {
    const real inverse = reciprocal(w.H[k * WIDTH + k]);
    const real* row = w.H + k * WIDTH;
    EACH_LANE {
      ROLLED for (int e = lane; e < k * (k + 1) / 2; e += LANES) {
        const unsigned entry = full_entry(e);
        const int i = entry & 255, j = entry >> 8;
        w.H[i * WIDTH + j] -= row[i] * inverse * row[j];
      }
      if (lane < k) w.H[lane * WIDTH + NV] -= row[lane] * inverse * row[NV];
      if (lane == k) w.inverse[k] = inverse;
    }
    MEET();
  }
  EACH_LANE x[ME] = lane < NV ? w.H[lane * WIDTH + NV] * w.inverse[lane] : real(0);
  ROLLED for (int k = 0; k < NV - 1; ++k) {
    PerLane<int> source;
    EACH_LANE source[ME] = k;
    const PerLane<real> above = gathered(x, source);
    EACH_LANE if (lane > k && lane < NV) x[ME] -= w.H[lane * WIDTH + k] * w.inverse[lane] * above[ME];
  }
  MEET();
  EACH_LANE {
    ROLLED for (int e = lane; e < FILL_ENTRIES; e += LANES) {
      const unsigned entry = fill_entry(e);
      w.H[(entry & 255) * WIDTH + (entry >> 8)] = 0;
    }
  }
}
#endif

// Which edges and limits push; their weights and forces for the lanes that sum them. Returns the contacts that push.
DEVICE unsigned find_active(World& w, PerLane<Contact>& contacts, PerLane<Limit>& limits, PerLane<unsigned>& active) {
  PerLane<bool> pushes;
  EACH_LANE {
    const Contact& c = contacts[ME];
    const real edge[4] = {c.normal + c.first, c.normal - c.first, c.normal + c.second, c.normal - c.second};
    unsigned bits = 0;
    if (c.exists) {
      real d[4], f[4];
      UNROLLED for (int k = 0; k < 4; ++k) {
        const bool on = edge[k] < 0;
        bits |= unsigned(on) << k;
        d[k] = on ? c.weight : real(0);
        f[k] = -d[k] * edge[k];
      }
      if (bits) {
        real* to = w.D + lane * D_WIDTH;
        put_four(to, d[0] + d[1] + d[2] + d[3], d[0] - d[1], d[2] - d[3]);
        put_four(to + 4, d[0] + d[1], d[2] + d[3], 0);
        put_four(to + 8, f[0] + f[1] + f[2] + f[3], f[0] - f[1], f[2] - f[3]);
      }
    }
    pushes[ME] = bits != 0;
#if LIMITS > 0
    if (lane < LIMITS) {
      const Limit& l = limits[ME];
      const bool on = l.residual < 0;
      const int dof = limit_dof(lane);
      bits |= unsigned(on) << 4;
      w.limit_weight[dof] = on ? l.weight : real(0);
      w.limit_force[dof] = on ? -l.weight * l.residual * l.sign : real(0);
    }
#endif
    active[ME] = bits;
  }
  const unsigned pushing = ballot(pushes);
  MEET();
  return pushing;
}

// The contacts that move with a dof.
DEVICE unsigned touching(const World& w, int dof) {
#if OWN_SLOTS
  return dof_slots(dof);
#else
  return w.touching[dof];
#endif
}

DEVICE int candidate_of(const World& w, int slot) {
#if OWN_SLOTS
  return slot;
#else
  return w.candidate[slot];
#endif
}

// J' D J of an entry, over the contacts that push and move with both dofs. Columns: of slots that are a point's own.
DEVICE real contact_entry(const World& w, int i, int j, int column_i, int column_j, unsigned slots) {
  real y = 0;
  for (; slots; slots &= slots - 1) {
    const int slot = lowest(slots);
    const real* J = w.J + slot * J_WIDTH;
    const Four a = four_at(J + 4 * (OWN_SLOTS ? column_i : column_of(w, slot, i)));
    const Four b = four_at(J + 4 * (OWN_SLOTS ? column_j : column_of(w, slot, j)));
    const Four n = four_at(w.D + slot * D_WIDTH), t = four_at(w.D + slot * D_WIDTH + 4);
    y += a.x * (n.x * b.x + n.y * b.y + n.z * b.z) + a.y * (n.y * b.x + t.x * b.y) + a.z * (n.z * b.x + t.y * b.z);
  }
  return y;
}

// The gradient M a - smooth - J' f, also the right side of H = M + J' D J.
DEVICE void assemble(World& w, unsigned pushing, bool full, const PerLane<real>& excess, PerLane<real>& gradient) {
  EACH_LANE {
    gradient[ME] = 0;
    if (lane < NV) {
      real y = excess[ME] - w.limit_force[lane];
      for (unsigned slots = pushing & touching(w, lane); slots; slots &= slots - 1) {
        const int slot = lowest(slots);
        const Four J = four_at(w.J + slot * J_WIDTH + 4 * column_of(w, slot, lane));
        const Four f = four_at(w.D + slot * D_WIDTH + 8);
        y -= J.x * f.x + J.y * f.y + J.z * f.z;
      }
      gradient[ME] = y;
      w.H[lane * WIDTH + NV] = y;
    }
    UNROLLED for (int e = lane; e < ENTRIES; e += LANES) {
      const unsigned entry = hessian_entry(e);
      const int i = entry & 255, j = entry >> 8 & 255;
      real y = w.M[i * M_WIDTH + j];
      if (pushing) {
        const unsigned slots = pushing & (OWN_SLOTS ? entry_slots(e) : touching(w, i) & touching(w, j));
        y += contact_entry(w, i, j, entry >> 16 & 255, entry >> 24, slots);
      }
      if (i == j) y += w.limit_weight[i];
      w.H[i * WIDTH + j] = y;
    }
#if FILLS
    if (full) {
      ROLLED for (int e = lane; e < FILL_ENTRIES; e += LANES) {
        const unsigned entry = fill_entry(e);
        const int i = entry & 255, j = entry >> 8 & 255;
        w.H[i * WIDTH + j] = contact_entry(w, i, j, 0, 0, pushing & touching(w, i) & touching(w, j));
      }
    }
#endif
  }
  MEET();
}

// Changes of the residuals along the step, and whether its full length changes which edges and limits push.
DEVICE bool find_changes(World& w, PerLane<Contact>& contacts, PerLane<Limit>& limits, const PerLane<unsigned>& active) {
  PerLane<bool> differs;
  EACH_LANE {
    Contact& c = contacts[ME];
    unsigned bits = 0;
    if (c.exists) {
      real n = 0, t = 0, u = 0;
      const real* J = w.J + lane * J_WIDTH;
      const auto add = [&](int dof) {
        const Four column = four_at(J);
        const real step = w.step[dof];
        n += column.x * step;
        t += column.y * step;
        u += column.z * step;
        J += 4;
      };
#if FREE
      if (c.dofs & 1u) {
        UNROLLED for (int k = 0; k < 6; ++k) add(k);
      }
#endif
      for (unsigned dofs = c.dofs & OUTER_DOFS; dofs; dofs &= dofs - 1) add(lowest(dofs));
      c.d_normal = n;
      c.d_first = t;
      c.d_second = u;
      n += c.normal;
      t += c.first;
      u += c.second;
      bits = unsigned(n + t < 0) | unsigned(n - t < 0) << 1 | unsigned(n + u < 0) << 2 | unsigned(n - u < 0) << 3;
    }
#if LIMITS > 0
    if (lane < LIMITS) {
      Limit& l = limits[ME];
      l.change = l.sign * w.step[limit_dof(lane)];
      bits |= unsigned(l.residual + l.change < 0) << 4;
    }
#endif
    differs[ME] = bits != active[ME];
  }
  return any(differs);
}

// A row's part of the cost's first and second derivative along the step, at a length of it.
DEVICE void add_row(real residual, real change, real weight, real& first, real& second) {
  if (residual < 0) {
    first += weight * residual * change;
    second += weight * change * change;
  }
}

// The length of the step where the cost's slope is a tenth of that at 0: Newton's method between bounds.
DEVICE real search_line(const PerLane<Contact>& contacts, const PerLane<Limit>& limits, real linear, real quadratic,
                        real slope) {
  real length = 1, below = 0, above = -1;
  ROLLED for (int k = 0; k < LINE_SEARCH_STEPS; ++k) {
    PerLane<real> first, second;
    EACH_LANE {
      real a = 0, b = 0;
      const Contact& c = contacts[ME];
      const real n = c.normal + length * c.d_normal, t = c.first + length * c.d_first;
      const real u = c.second + length * c.d_second;
      add_row(n + t, c.d_normal + c.d_first, c.weight, a, b);
      add_row(n - t, c.d_normal - c.d_first, c.weight, a, b);
      add_row(n + u, c.d_normal + c.d_second, c.weight, a, b);
      add_row(n - u, c.d_normal - c.d_second, c.weight, a, b);
      const Limit& l = limits[ME];
      add_row(l.residual + length * l.change, l.change, l.weight, a, b);
      first[ME] = a;
      second[ME] = b;
    }
    const real d1 = linear + length * quadratic + sum(first), d2 = quadratic + sum(second);
    if (!(absolute(d1) > real(-0.1) * slope)) break;
    (d1 < 0 ? below : above) = length;
    real next = length - d1 * reciprocal(d2);
    if (above > 0 && !(next > below && next < above)) next = real(0.5) * (below + above);
    length = next;
  }
  return length;
}

// qacc that minimises Gauss' cost (mj_solNewton). A full step that leaves the pushing rows as they are is exact.
DEVICE void solve_constraints(World& w, PerLane<Contact>& contacts, PerLane<Limit>& limits, bool full) {
  PerLane<real> excess, gradient, x;  // M a - smooth
  PerLane<unsigned> active;
  EACH_LANE excess[ME] = lane < NV ? times_inertia(w, w.acceleration, lane) - w.smooth[lane] : real(0);
  bool done = false;
  ROLLED for (int iteration = 0; iteration < ITERATIONS && !done; ++iteration) {
    const unsigned pushing = find_active(w, contacts, limits, active);
    assemble(w, pushing, full, excess, gradient);
#if FILLS
    if (full)
      solve_full(w, x);
    else
#endif
      solve_tree(w, x);
    EACH_LANE if (lane < NV) w.step[lane] = -x[ME];
    MEET();
    done = !find_changes(w, contacts, limits, active);
    real length = 1, slope = 0;
    if (!done) {
      PerLane<real> falls;
      EACH_LANE falls[ME] = -x[ME] * gradient[ME];
      slope = sum(falls);
      done = !(-slope * IMPROVEMENT_SCALE > real(1e-9));  // also of what is not a number
    }
    if (!done) {
      PerLane<real> change, one, two;
      EACH_LANE {
        change[ME] = lane < NV ? times_inertia(w, w.step, lane) : real(0);
        one[ME] = -x[ME] * excess[ME];
        two[ME] = -x[ME] * change[ME];
      }
      length = search_line(contacts, limits, sum(one), sum(two), slope);
      EACH_LANE excess[ME] += length * change[ME];
    }
    EACH_LANE {
      if (lane < NV) w.acceleration[lane] -= length * x[ME];
      Contact& c = contacts[ME];
      c.normal += length * c.d_normal;
      c.first += length * c.d_first;
      c.second += length * c.d_second;
      limits[ME].residual += length * limits[ME].change;
    }
    MEET();
  }
}

#include "threads_readouts.h"

// qacc of (qpos, qvel), which is also where the solver starts. `last`: also the readouts.
DEVICE void evaluate(World& w, bool last, const Outputs& out, bool& lost) {
  PerLane<Contact> contacts;
  PerLane<Limit> limits;
  place_joints(w);
  place_bodies(w);
  sum_subtrees(w);
  find_forces(w);
  find_inertia(w);
  const unsigned existing = find_constraints(w, contacts, limits, lost);
  bool full = false;
#if FILLS
  PerLane<bool> couples;
  EACH_LANE couples[ME] = contacts[ME].exists && contact_fills(contacts[ME].candidate);
  full = any(couples);
#endif
  MEET();
  solve_constraints(w, contacts, limits, full);
  EACH_LANE {
#if FREE
    if (lane < 3) w.qacc[lane] = dot(vec_at(w.base + 3 * lane), vec_at(w.acceleration));
#endif
    if (lane >= (FREE ? 3 : 0) && lane < NV) w.qacc[lane] = w.acceleration[lane];
  }
  if (last) read_out(w, contacts, existing, out);
  MEET();
}

// ---- integration --------------------------------------------------------------------------------------------------
// qpos = start_qpos advanced by a time step of `rate` (mj_integratePos).
DEVICE void advance(World& w) {
  EACH_LANE {
    if (lane < JOINTS)
      w.qpos[BASE_QPOS + lane] = w.start_qpos[BASE_QPOS + lane] + TIMESTEP * w.rate[BASE_DOFS + lane];
#if FREE
    if (lane >= LANES - 3) {
      const int k = lane - (LANES - 3);
      w.qpos[k] = w.start_qpos[k] + TIMESTEP * w.rate[k];
    }
    if (lane == LANES - 4) {
      const Vec spin = vec_at(w.rate + 3);
      const real squared = dot(spin, spin);
      real qw = w.start_qpos[3];
      Vec q = vec_at(w.start_qpos + 4);
      if (squared > real(1e-30)) {
        const real inverse = inverse_root(squared);
        real s, c;
        sine_cosine(real(0.5) * TIMESTEP * squared * inverse, &s, &c);
        const Vec b = spin * (s * inverse);
        const real w1 = qw * c - dot(q, b);
        const Vec q1 = b * qw + q * c + cross(q, b);
        const real norm = inverse_root(w1 * w1 + dot(q1, q1));
        qw = w1 * norm;
        q = q1 * norm;
      }
      w.qpos[3] = qw;
      put(w.qpos + 4, q);
    }
#endif
  }
  MEET();
}

DEVICE void start_step(World& w) {
  EACH_LANE {
    UNROLLED for (int i = lane; i < NQ; i += LANES) w.start_qpos[i] = w.qpos[i];
    if (lane < NV) {
      w.start_qvel[lane] = w.qvel[lane];
      w.sum_velocity[lane] = w.sum_acceleration[lane] = 0;
    }
  }
  MEET();
}

#if RK4
DEVICE void control_step(World& w, const Outputs& out, bool& lost) {
  ROLLED for (int e = 0; e < 4 * SUBSTEPS; ++e) {
    const int stage = e & 3;
    if (stage == 0) start_step(w);
    evaluate(w, e == 4 * SUBSTEPS - 1, out, lost);
    const bool outer_stage = stage == 0 || stage == 3;
    const real share = outer_stage ? real(1) / 6 : real(1) / 3, ahead = stage == 2 ? real(1) : real(0.5);
    EACH_LANE if (lane < NV) {
      const real v = w.qvel[lane], a = w.qacc[lane];
      const real velocity = w.sum_velocity[lane] + share * v, acceleration = w.sum_acceleration[lane] + share * a;
      w.sum_velocity[lane] = velocity;
      w.sum_acceleration[lane] = acceleration;
      w.rate[lane] = stage == 3 ? velocity : ahead * v;
      w.qvel[lane] = w.start_qvel[lane] + TIMESTEP * (stage == 3 ? acceleration : ahead * a);
    }
    MEET();
    advance(w);
  }
}
#else
// Implicit in the damping: (M + h diag(damping)) a = M qacc, because M qacc is all forces at the solver's solution.
DEVICE void damp(World& w, PerLane<real>& x) {
  EACH_LANE {
    UNROLLED for (int e = lane; e < ENTRIES; e += LANES) {
      const unsigned entry = hessian_entry(e);
      const int i = entry & 255, j = entry >> 8 & 255;
      w.H[i * WIDTH + j] = w.M[i * M_WIDTH + j] + (i == j ? TIMESTEP * dof_damping(i) : real(0));
    }
    if (lane < NV) w.H[lane * WIDTH + NV] = times_inertia(w, w.acceleration, lane);
  }
  MEET();
  solve_tree(w, x);
}

DEVICE void control_step(World& w, const Outputs& out, bool& lost) {
  ROLLED for (int e = 0; e < SUBSTEPS; ++e) {
    start_step(w);
    evaluate(w, e == SUBSTEPS - 1, out, lost);
    PerLane<real> x;
    if constexpr (DAMPED)
      damp(w, x);
    else
      EACH_LANE x[ME] = lane < NV ? w.acceleration[lane] : real(0);
    EACH_LANE if (lane < NV) w.step[lane] = x[ME];
    MEET();
    EACH_LANE if (lane < NV) {
      real a = w.step[lane];
#if FREE
      if (lane < 3) a = dot(vec_at(w.base + 3 * lane), vec_at(w.step));
#endif
      w.qvel[lane] += TIMESTEP * a;
      w.rate[lane] = w.qvel[lane];
    }
    MEET();
    advance(w);
  }
}
#endif
