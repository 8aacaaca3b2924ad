// Where bodies are, and forces without constraints; see threads.h.
#pragma once
#include "threads.h"

// Rows of shared memory that lanes read at a stride: whole fours that meet all banks, or an odd number of singles.
constexpr int fours(int n) { return (n + 3) / 4 % 2 ? (n + 3) / 4 * 4 : (n + 3) / 4 * 4 + 4; }

constexpr int WIDTH = (NV + 1) | 1;  // of a row of H: its last column is the right side
constexpr int M_WIDTH = fours(M_COLUMNS);
constexpr int PACKED = TRUNK * (TRUNK + 1) / 2 + TRUNK;  // the trunk's lower triangle, then its right side
constexpr int MORE = DIRECTIONS > 3;  // of contacts: spin and rolling
constexpr int COLUMN = 4 + 4 * MORE;  // of a contact's Jacobian: normal, two tangents, a gap; spin, rolling, a gap
constexpr int J_WIDTH = fours(COLUMN * COLUMNS);
constexpr int D_WIDTH = 12 + 12 * MORE;
constexpr int MOTION = 7;  // an angular and a linear part
constexpr int FRAME = 13;
constexpr int LINK = 17;   // a joint: rotation, anchor, axis, speed
constexpr int SUMS = 15;   // of what hangs on a body: first moment, inertia, force, moment
constexpr int MOST_UNROLLED = 3;  // turns of a loop: more code than a multiprocessor keeps is slower than a loop
constexpr int BASE_DOFS = FREE ? 6 : 0;   // of the root

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
  alignas(16) real M[NV * M_WIDTH];  // see at_M
  alignas(16) real J[SLOTS * J_WIDTH];
  // A contact's weights nn n1 n2 11 22 and, from the ninth, its force n 1 2; then of spin and rolling n3 n4 n5 33 44 55
  // and, from the twenty-first, their moments.
  alignas(16) real D[SLOTS * D_WIDTH];
  real H[NV * WIDTH];                   // above its diagonal it holds the factor L, transposed
  real qacc[NV];                        // in MuJoCo's coordinates; the start of the next solve
  real qpos[NQ], qvel[NV], actuator[NV];
  real start_qpos[NQ], start_qvel[NV], sum_velocity[NV], sum_acceleration[NV], rate[NV];
  real velocity[NV];  // qvel in the base's frame
  real smooth[NV];    // forces without constraints
#if SERVOS
  real drive[NU], motor[NU];  // forces of actuators by their controls, and of all
#endif
#if FORWARD
  real warmstart[NV];
#endif
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
  real segment[SEGMENTS + 1][7];  // middle, and half of the length
  short near[PAIRS];          // pairs that may touch
#endif
#if !OWN_SLOTS
  real contact[SLOTS][11];
  int candidate[SLOTS];
  unsigned touching[NV];  // contacts that a dof moves
  Dofs moved[SLOTS];      // dofs that a contact moves with
#endif
};

// Where M has an entry. Of a wide model's rows only the columns of the dof's own tree are kept.
DEVICE int at_M(int i, int j) { return i * M_WIDTH + j - first_column(i); }

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
      const int address = joint_qpos(lane);
      const real at = w.qpos[address] - joint_reference(lane);
      const Vec axis = joint_axis(lane);
      const int kind = joint_kind(lane);
      Vec anchor = joint_anchor(lane);
      Mat R = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
      if (kind == HINGE) R = rotation(axis, at);
      if (kind == SLIDE) anchor = anchor + axis * at;
#if FREE_JOINTS
      if (kind == FREE_JOINT) {
        const real* q = w.qpos + address + 3;
        const real scale = inverse_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        R = rotation(q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale);
        anchor = vec_at(w.qpos + address);
      }
#endif
      if constexpr (TURNED_JOINTS) R = mul(R, joint_rotation(lane));
      real* to = w.joint[lane];
      put(to, R);
      put(to + 9, anchor);
      put(to + 12, axis);
      to[15] = w.qvel[joint_dof(lane)];
    }
  }
  MEET();
}

// A body's place and motion while a lane walks down its chain. Accelerations are those of qacc = 0, gravity upwards.
struct Walk {
  Mat R;
  Vec p, spin, spin_rate, rate, velocity;
  MEMBER void move(Vec r) {
    rate = rate + cross(spin_rate, r) + cross(spin, cross(spin, r));
    if constexpr (FLUID) velocity = velocity + cross(spin, r);
    p = p + r;
  }
};

#if FREE_JOINTS
// A free joint: its place and attitude are its own, and it has no parent but the world.
DEVICE void pass_free_joint(World& w, Walk& walk, int joint, bool own) {
  const int dof = joint_dof(joint);
  walk.R = mat_at(w.joint[joint]);
  walk.p = vec_at(w.joint[joint] + 9);
  walk.spin = mul(walk.R, vec_at(w.qvel + dof + 3));
  walk.velocity = vec_at(w.qvel + dof);
  if (!own) return;
  const Mat columns = transposed(walk.R);
  for (int k = 0; k < 3; ++k) {
    const Vec axis = k == 0 ? columns.x : k == 1 ? columns.y : columns.z;
    put(w.axis[dof + k], vec(0, 0, 0));
    put(w.axis[dof + k] + 3, vec(k == 0, k == 1, k == 2));
    put(w.axis[dof + 3 + k], axis);
    put(w.axis[dof + 3 + k] + 3, cross(walk.p, axis));
  }
}
#endif

DEVICE void pass_joint(World& w, Walk& walk, int joint, bool own) {
#if FREE_JOINTS
  if (joint_kind(joint) == FREE_JOINT) return pass_free_joint(w, walk, joint, own);
#endif
  const real* at = w.joint[joint];
  const real speed = at[15];
  real* to = w.axis[joint_dof(joint)];
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
    if constexpr (DEPTH <= MOST_UNROLLED) {
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
    if (SPRINGS && lane >= BASE_DOFS) {
      force -= dof_stiffness(lane) * (w.qpos[dof_qpos(lane)] - dof_spring(lane));
    }
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
          w.M[at_M(lane, k)] = row[k];
          w.M[at_M(k, lane)] = row[k];
        }
      }
    }
    w.limit_weight[lane] = w.limit_force[lane] = 0;
  }
  MEET();
}

// The entries of M that change: pairs of dofs on one chain, and the base's block.
DEVICE void find_inertia(World& w) {
  EACH_THREAD {
    UNROLLED for (int e = lane; e < PAIR_ENTRIES; e += THREADS) {
      const unsigned entry = pair_entry(e);
      const int i = entry & 255, j = entry >> 8;
      const real* a = w.axis[j];
      const real* b = w.momentum[i];
      real y = i == j ? dof_armature(i) : real(0);
      UNROLLED for (int k = 0; k < 6; ++k) y += a[k] * b[k];
      w.M[at_M(i, j)] = y;
      w.M[at_M(j, i)] = y;
    }
    if (FREE && lane < BASE_ENTRIES) {
      const unsigned entry = base_entry(lane);  // i, j, which of the sums, whether its sign changes
      const int i = entry & 255, j = entry >> 8 & 255;
      const real x = w.sums[0][entry >> 16 & 255];
      const real y = (entry >> 24 ? -x : x) + (i == j ? dof_armature(i) : real(0));
      w.M[at_M(i, j)] = y;
      w.M[at_M(j, i)] = y;
    }
  }
}

// What is the same in all evaluations of a step, and what is never written.
DEVICE void clear(World& w) {
  EACH_THREAD {
    ROLLED for (int k = lane; k < NV * M_WIDTH; k += THREADS) w.M[k] = 0;
    ROLLED for (int k = lane; k < NV * WIDTH; k += THREADS) w.H[k] = 0;
    if (lane < 4) w.acceleration[(NV + 3) / 4 * 4 - 4 + lane] = 0;
  }
  MEET();
#if FREE
  EACH_LANE if (lane < 3) w.M[at_M(lane, lane)] = body_subtree_mass(0) + dof_armature(lane);
  MEET();
#endif
}

// What motors do by their controls, clipped to their ranges.
DEVICE real motor_drive(const real* ctrl, int m) {
  return motor_gain(m) * clamped(ctrl[m], motor_low(m), motor_high(m));
}

#if SERVOS
// What a unit of a motor's force does along a dof.
DEVICE real motor_share(const World& w, int m, int dof) {
  if (motor_dof(m) >= 0) return motor_dof(m) == dof ? motor_gear(m) : real(0);
  const int body = motor_body(m);
  if (!(body_dofs(body) >> dof & 1u)) return 0;
  const Mat R = mat_at(w.pose[body]);
  const Vec push = mul(R, motor_push(m)), arm = mul(R, motor_place(m)) + vec_at(w.pose[body] + 9);
  const Vec turn = cross(arm, push) + mul(R, motor_turn(m));
  return dot(vec_at(w.axis[dof]), turn) + dot(vec_at(w.axis[dof] + 3), push);
}

// The forces of motors, which depend on places and speeds (mj_fwdActuation): a lane a motor, then a lane a dof.
DEVICE void find_drives(World& w) {
  EACH_LANE if (lane < NU) {
    real speed = 0;
    ROLLED for (int dof = 0; dof < NV; ++dof) speed += motor_share(w, lane, dof) * w.velocity[dof];
    const real place = motor_dof(lane) >= 0 ? motor_gear(lane) * w.qpos[motor_qpos(lane)] : real(0);
    const real force = w.drive[lane] + motor_bias_x(lane) + motor_bias_y(lane) * place + motor_bias_z(lane) * speed;
    w.motor[lane] = clamped(force, motor_weakest(lane), motor_strongest(lane));
  }
  MEET();
  EACH_LANE if (lane < NV) {
    real force = 0;
    ROLLED for (int m = 0; m < NU; ++m) force += motor_share(w, m, lane) * w.motor[m];
    w.actuator[lane] = force;
  }
  MEET();
}
#endif

DEVICE void load_controls(World& w, const real* ctrl) {
#if SERVOS
  EACH_LANE if (lane < NU) w.drive[lane] = motor_drive(ctrl, lane);
#else
  EACH_LANE if (lane < NV) {
    real force = 0;
    ROLLED for (int m = 0; m < NU; ++m) {
      if (motor_dof(m) == lane) force += motor_gear(m) * motor_drive(ctrl, m);
    }
    w.actuator[lane] = force;
  }
#endif
}
