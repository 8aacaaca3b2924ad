// The step itself; see threads.h. MODEL is the file of tables that threads.py writes.
#pragma once
#include "threads.h"
#include MODEL

constexpr int WIDTH = (NV + 1) | 1;  // of a row of H: its last column is the right side; odd, for shared memory's banks
constexpr int PACKED = TRUNK * (TRUNK + 1) / 2 + TRUNK;  // the trunk's lower triangle, then its right side
constexpr int COLUMNS = (3 * NV) | 1;  // of a contact's Jacobian: normal and two tangents of each dof
constexpr int MOTION = 7;              // an angular and a linear part, and one to keep banks apart
constexpr int FRAME = 13;
constexpr int SUMS = 15;  // of what hangs on a body: first moment, inertia, force, moment
constexpr int LINE_SEARCH_STEPS = 12;

// Rows that agree with the floats of a world's shared memory.
struct World {
  alignas(16) real packed[PACKED + 4];
  alignas(16) real qacc[NV];  // in MuJoCo's coordinates; the start of the next solve
  real qpos[NQ], qvel[NV], actuator[NV];
  real start_qpos[NQ], start_qvel[NV], sum_velocity[NV], sum_acceleration[NV], rate[NV];
  real velocity[NV], acceleration[NV];  // qvel and the solver's qacc in the base's frame
  real smooth[NV];                      // forces without constraints
  real inverse[NV];                     // of the pivots
  real step[NV];
  real limit_weight[NV], limit_force[NV];
  real base[9];
  real joint[JOINTS + 1][FRAME];
  real pose[BODIES][FRAME];
  real sums[BODIES][SUMS];
  real axis[NV][MOTION], momentum[NV][MOTION];
  real M[NV * WIDTH], H[NV * WIDTH];  // above its diagonal H holds the factor L, transposed
  real J[SLOTS][COLUMNS];
  real D[SLOTS][9];  // a contact's weights nn n1 n2 11 22, and its force n 1 2
  real contact[SLOTS][11];
  int candidate[SLOTS];
  unsigned touching[NV];  // contacts that a dof moves
#if FLUID
  real motion[BODIES][7];
  real drag[BOXES][7];
#endif
};

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
      const real at = w.qpos[joint_qpos(lane)] - joint_reference(lane);
      const Vec axis = joint_axis(lane);
      const int kind = joint_kind(lane);
      Vec anchor = joint_anchor(lane);
      Mat R = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
      if (kind == HINGE) R = rotation(axis, at);
      if (kind == SLIDE) anchor = anchor + axis * at;
      if constexpr (TURNED_JOINTS) R = mul(R, joint_rotation(lane));
      put(w.joint[lane], R);
      put(w.joint[lane] + 9, anchor);
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
  const int dof = joint_dof(joint);
  const real speed = w.velocity[dof];
  walk.move(mul(walk.R, vec_at(at + 9)));
  const Vec axis = mul(walk.R, joint_axis(joint));
  if (ALL_HINGES || joint_kind(joint) == HINGE) {
    walk.R = mul(walk.R, mat_at(at));
    walk.spin_rate = walk.spin_rate + cross(walk.spin, axis) * speed;
    walk.spin = walk.spin + axis * speed;
    if (own) {
      put(w.axis[dof], axis);
      put(w.axis[dof] + 3, cross(walk.p, axis));
    }
    if constexpr (OFFSET_JOINTS) walk.move(mul(walk.R, joint_position(joint) * real(-1)));
  } else {
    walk.rate = walk.rate + cross(walk.spin, axis) * (real(2) * speed);
    if constexpr (FLUID) walk.velocity = walk.velocity + axis * speed;
    if constexpr (TURNED_JOINTS) walk.R = mul(walk.R, mat_at(at));
    if (own) {
      put(w.axis[dof], vec(0, 0, 0));
      put(w.axis[dof] + 3, axis);
    }
  }
}

DEVICE Sym body_inertia_in(const Mat& R, int body) {
  if constexpr (ROUND_BODIES) return outer(body_across(body), body_along(body), mul(R, body_round_axis(body)));
  return turned(R, body_inertia(body));
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
    ROLLED for (int level = 0; level < DEPTH; ++level) {
      const int joint = chain_joint(level * BODIES + lane);
      if (joint >= 0) pass_joint(w, walk, joint, joint_body(joint) == lane);
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
    if constexpr (SPRINGS) force -= dof_stiffness(lane) * (w.qpos[dof_qpos(lane)] - dof_spring(lane));
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
          w.M[lane * WIDTH + k] = row[k];
          w.M[k * WIDTH + lane] = row[k];
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
      w.M[i * WIDTH + j] = y;
      w.M[j * WIDTH + i] = y;
    }
    if (FREE && lane < BASE_ENTRIES) {
      const unsigned entry = base_entry(lane);  // i, j, which of the sums, whether its sign changes
      const int i = entry & 255, j = entry >> 8 & 255;
      const real x = w.sums[0][entry >> 16 & 255];
      const real y = (entry >> 24 ? -x : x) + (i == j ? dof_armature(i) : real(0));
      w.M[i * WIDTH + j] = y;
      w.M[j * WIDTH + i] = y;
    }
  }
}

// What is the same in all evaluations of a step, and what is never written.
DEVICE void clear(World& w) {
  EACH_LANE {
    for (int k = lane; k < NV * WIDTH; k += LANES) w.M[k] = w.H[k] = 0;
  }
  MEET();
#if FREE
  EACH_LANE if (lane < 3) w.M[lane * WIDTH + lane] = body_subtree_mass(0) + dof_armature(lane);
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

// mjraw_SphereSphere at the nearest places. Segments that cross have no normal: MuJoCo takes a product of two axes.
DEVICE bool touches_pair(const World& w, int pair, Touch& touch) {
  const real* pose_a = w.pose[segment_body(pair_first(pair))];
  const real* pose_b = w.pose[segment_body(pair_second(pair))];
  const int first = pair_first(pair), second = pair_second(pair);
  const Mat Ra = mat_at(pose_a), Rb = mat_at(pose_b);
  const Vec a = mul(Ra, segment_centre(first)) + vec_at(pose_a + 9);
  const Vec b = mul(Rb, segment_centre(second)) + vec_at(pose_b + 9), between = a - b;
  const real margin = contact_margin(POINTS + pair);
  const real radii = segment_radius(first) + segment_radius(second), reach = radii + margin;
  const real far = reach + segment_length(first) + segment_length(second);
  if (!(dot(between, between) <= far * far * real(1.0001))) return false;
  const Nearest found = nearest_of(a, mul(Ra, segment_half(first)), b, mul(Rb, segment_half(second)), reach,
                                   pair_which(pair));
  if (!found.touches) return false;
  const Vec gap = found.to - found.from;
  const real length = root(dot(gap, gap));
  Vec normal = gap * (real(1) / length);
  if (length < CROSSING) {
    normal = cross(mul(Ra, segment_side(first)), mul(Rb, segment_side(second)));
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

DEVICE bool touches(const World& w, int candidate, Touch& touch) {
#if PAIRS > 0
  if (candidate >= POINTS) return touches_pair(w, candidate - POINTS, touch);
#endif
  return touches_floor(w, candidate, touch);
}

// Slots of a fixed number: a candidate's own lane, or the next that is free. Returns how many contacts there are.
DEVICE int collect_contacts(World& w, PerLane<Contact>& contacts, PerLane<Touch>& touch) {
#if OWN_SLOTS
  PerLane<bool> hit;
  EACH_LANE {
    hit[ME] = lane < CANDIDATES && touches(w, lane, touch[ME]);
    contacts[ME].exists = hit[ME];
    contacts[ME].candidate = lane;
  }
  return count(ballot(hit));
#else
  int found = 0;
  ROLLED for (int start = 0; start < CANDIDATES; start += LANES) {
    PerLane<bool> hit;
    EACH_LANE hit[ME] = start + lane < CANDIDATES && touches(w, start + lane, touch[ME]);
    const unsigned hits = ballot(hit);
    EACH_LANE {
      const int slot = found + count(hits & ((1u << lane) - 1u));
      if (hit[ME] && slot < SLOTS) {
        real* to = w.contact[slot];
        put(to, touch[ME].point);
        put(to + 3, touch[ME].normal);
        put(to + 6, touch[ME].tangent);
        to[9] = touch[ME].distance;
        w.candidate[slot] = start + lane;
      }
    }
    found += count(hits);
  }
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

DEVICE void put_column(World& w, int slot, int dof, const real (&row)[3], real rate, Contact& contact) {
  real* to = w.J[slot] + 3 * dof;
  to[0] = row[0];
  to[1] = row[1];
  to[2] = row[2];
  contact.normal += row[0] * rate;
  contact.first += row[1] * rate;
  contact.second += row[2] * rate;
}

DEVICE void put_columns(World& w, int slot, const Directions& d, real damping, Contact& contact) {
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
    put_column(w, slot, dof, row, w.acceleration[dof] + damping * w.velocity[dof], contact);
  }
}

// Jacobians, weights (mj_makeImpedance) and residuals J a - aref of contacts and limits at the solver's start.
DEVICE unsigned find_constraints(World& w, PerLane<Contact>& contacts, PerLane<Limit>& limits, bool last, bool& lost) {
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
      Vec t = touch[ME].tangent - n * dot(n, touch[ME].tangent);
      t = t * inverse_root(dot(t, t) + real(1e-30));
      const Vec first = t * contact_friction(c), second = cross(n, first);
      const Directions directions = {n, first, second, cross(r, n), cross(r, first), cross(r, second)};
      contact.dofs = contact_dofs(c);
      put_columns(w, lane, directions, contact_damping(c), contact);
      const real violation = touch[ME].distance - contact_margin(c);
      const real impedance = impedance_at(violation, contact_lowest(c), contact_highest(c), contact_inverse_width(c));
      contact.weight = impedance * reciprocal(contact_regularisation(c) * (real(1) - impedance));
      contact.normal += contact_stiffness(c) * impedance * violation;
      if (last) {
        put(w.contact[lane], r);
        put(w.contact[lane] + 3, n);
        put(w.contact[lane] + 6, first);
      }
    }
    Limit& limit = limits[ME];
    limit.weight = limit.residual = limit.sign = limit.change = 0;
#if LIMITS > 0
    if (lane < LIMITS) {
      const int dof = limit_dof(lane);
      const real q = w.qpos[limit_qpos(lane)], low = q - limit_low(lane), high = limit_high(lane) - q;
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
  UNROLLED for (int j = 0; j < NV; ++j) y += w.M[dof * WIDTH + j] * x[j];
  return y;
}

// Branches, from the leaves: each entry once, H[i][j] -= sum over k below i of H[k][i] H[k][j] / pivot k.
DEVICE void eliminate_branches(World& w) {
  repeat<0, ROUNDS>([&](auto turn) {
    constexpr int round = turn;
    EACH_LANE {
      UNROLLED for (int e = lane; e < ROUND_SIZE[round]; e += LANES) {
        const unsigned entry = round_entry(ROUND_START[round] + e);
        const int i = entry & 255, j = entry >> 8 & 255;
        real pivot = w.H[i * WIDTH + i], value = w.H[i * WIDTH + j];
        UNROLLED for (int t = 1; t <= ROUND_BELOW[round]; ++t) {
          if (ROUND_EVEN[round] || t <= dof_below(i)) {
            const real l = w.H[i * WIDTH + i + t];
            pivot -= l * w.H[(i + t) * WIDTH + i];
            value -= l * w.H[(i + t) * WIDTH + j];
          }
        }
        const real inverse = reciprocal(pivot);
        if (entry >> 16) w.inverse[i] = inverse;
        if (round > 0) w.H[i * WIDTH + j] = value;
        if (j < NV) w.H[j * WIDTH + i] = value * inverse;
      }
    }
    MEET();
  });
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
#ifdef __CUDACC__
  UNROLLED for (int k = 0; k < PACKED; k += 4) {
    const float4 four = *reinterpret_cast<const float4*>(w.packed + k);
    to[k] = four.x;
    to[k + 1] = four.y;
    to[k + 2] = four.z;
    to[k + 3] = four.w;
  }
#else
  for (int k = 0; k < PACKED; ++k) to[k] = w.packed[k];
#endif
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
// The same for a full H: Cholesky, a row a lane. Leaves H's pattern to be cleared.
DEVICE void solve_full(World& w, PerLane<real>& x) {
#ifdef __CUDACC__
  const int lane = int(threadIdx.x);
  const unsigned all = 0xffffffffu;
  real h[NV];
  UNROLLED for (int j = 0; j < NV; ++j) h[j] = lane < NV && j <= lane ? w.H[lane * WIDTH + j] : real(0);
  real y = lane < NV ? w.H[lane * WIDTH + NV] : real(0), inverse = 0;
  UNROLLED for (int j = 0; j < NV; ++j) {
    const real scale = inverse_root(__shfl_sync(all, h[j], j));
    const real l = h[j] * scale;
    h[j] = l;
    if (lane == j) inverse = scale;
    UNROLLED for (int k = j + 1; k < NV; ++k) h[k] -= l * __shfl_sync(all, l, k);
    const real yj = __shfl_sync(all, y, j) * scale;
    y = lane == j ? yj : lane > j ? y - l * yj : y;
  }
  MEET();
  if (lane < NV) {
    UNROLLED for (int j = 0; j < NV; ++j) {
      if (j <= lane) w.H[lane * WIDTH + j] = h[j];
    }
  }
  MEET();
  UNROLLED for (int j = NV - 1; j >= 0; --j) {
    const real xj = __shfl_sync(all, y * inverse, j);
    y = lane == j ? xj : lane < j ? y - w.H[j * WIDTH + lane] * xj : y;
  }
  x[0] = lane < NV ? y : real(0);
#else
  real* H = w.H;
  for (int j = 0; j < NV; ++j)
    for (int i = j; i < NV; ++i) {
      real y = H[i * WIDTH + j];
      for (int k = 0; k < j; ++k) y -= H[i * WIDTH + k] * H[j * WIDTH + k];
      H[i * WIDTH + j] = i == j ? real(sqrt(y)) : y / H[j * WIDTH + j];
    }
  for (int i = 0; i < NV; ++i) {
    real y = H[i * WIDTH + NV];
    for (int k = 0; k < i; ++k) y -= H[i * WIDTH + k] * x[k];
    x[i] = y / H[i * WIDTH + i];
  }
  for (int i = NV - 1; i >= 0; --i) {
    real y = x[i];
    for (int k = i + 1; k < NV; ++k) y -= H[k * WIDTH + i] * x[k];
    x[i] = y / H[i * WIDTH + i];
  }
  for (int i = NV; i < LANES; ++i) x[i] = 0;
#endif
  MEET();
  EACH_LANE {
    for (int e = lane; e < FILL_ENTRIES; e += LANES) {
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
        real* to = w.D[lane];
        to[0] = d[0] + d[1] + d[2] + d[3];
        to[1] = d[0] - d[1];
        to[2] = d[2] - d[3];
        to[3] = d[0] + d[1];
        to[4] = d[2] + d[3];
        to[5] = f[0] + f[1] + f[2] + f[3];
        to[6] = f[0] - f[1];
        to[7] = f[2] - f[3];
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

DEVICE unsigned touching(const World& w, int dof) { return OWN_SLOTS ? dof_slots(dof) : w.touching[dof]; }

// J' D J of an entry, over the contacts that push and move with both dofs.
DEVICE real contact_entry(const World& w, int i, int j, unsigned slots) {
  real y = 0;
  for (; slots; slots &= slots - 1) {
    const int slot = lowest(slots);
    const real* a = w.J[slot] + 3 * i;
    const real* b = w.J[slot] + 3 * j;
    const real* D = w.D[slot];
    y += a[0] * (D[0] * b[0] + D[1] * b[1] + D[2] * b[2]) + a[1] * (D[1] * b[0] + D[3] * b[1]) +
         a[2] * (D[2] * b[0] + D[4] * b[2]);
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
        const real* J = w.J[slot] + 3 * lane;
        const real* f = w.D[slot] + 5;
        y -= J[0] * f[0] + J[1] * f[1] + J[2] * f[2];
      }
      gradient[ME] = y;
      w.H[lane * WIDTH + NV] = y;
    }
    UNROLLED for (int e = lane; e < ENTRIES; e += LANES) {
      const unsigned entry = hessian_entry(e);
      const int i = entry & 255, j = entry >> 8 & 255;
      real y = w.M[i * WIDTH + j];
      y += contact_entry(w, i, j, pushing & (OWN_SLOTS ? entry_slots(e) : touching(w, i) & touching(w, j)));
      if (i == j) y += w.limit_weight[i];
      w.H[i * WIDTH + j] = y;
    }
#if FILLS
    if (full) {
      ROLLED for (int e = lane; e < FILL_ENTRIES; e += LANES) {
        const unsigned entry = fill_entry(e);
        const int i = entry & 255, j = entry >> 8 & 255;
        w.H[i * WIDTH + j] = contact_entry(w, i, j, pushing & touching(w, i) & touching(w, j));
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
      for (unsigned dofs = c.dofs; dofs; dofs &= dofs - 1) {
        const int dof = lowest(dofs);
        const real* J = w.J[lane] + 3 * dof;
        n += J[0] * w.step[dof];
        t += J[1] * w.step[dof];
        u += J[2] * w.step[dof];
      }
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
    PerLane<real> falls;
    EACH_LANE {
      if (lane < NV) w.step[lane] = -x[ME];
      falls[ME] = -x[ME] * gradient[ME];
    }
    const real slope = sum(falls);
    MEET();
    const bool differs = find_changes(w, contacts, limits, active);
    done = !(differs && -slope * IMPROVEMENT_SCALE > real(1e-9));  // also of what is not a number
    real length = 1;
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
  const unsigned existing = find_constraints(w, contacts, limits, last, lost);
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
    if (lane < JOINTS) w.qpos[joint_qpos(lane)] = w.start_qpos[joint_qpos(lane)] + TIMESTEP * w.rate[joint_dof(lane)];
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
      w.H[i * WIDTH + j] = w.M[i * WIDTH + j] + (i == j ? TIMESTEP * dof_damping(i) : real(0));
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
