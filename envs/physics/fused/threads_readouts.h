// What tasks read of the last evaluation: fields of mjData, in the world's frame; see threads.h.
#pragma once
#include "threads_solver.h"

struct Outputs {
  real* reading[READINGS + 1];
};

// From the base's frame to the world's.
DEVICE Vec turned_out(const World& w, Vec v) { return FREE ? mul(mat_at(w.base), v) : v; }

// Where a point of a moving body is in the world; -1 is the world itself.
DEVICE Vec world_point(const World& w, int body, Vec local) {
  if (body < 0) return local;
  const Vec inside = mul(mat_at(w.pose[body]), local) + vec_at(w.pose[body] + 9);
#if FREE
  return turned_out(w, inside) + vec_at(w.qpos);
#else
  Vec shift = {0, 0, 0};
  if (body > 0) {
    ROLLED for (int j = 0; j < JOINTS; ++j) {
      if (joint_kind(j) == SHIFT) shift = shift + joint_axis(j) * (w.qpos[joint_qpos(j)] - joint_reference(j));
    }
  }
  return inside + shift;
#endif
}

DEVICE Mat world_rotation(const World& w, int body) {
  if (body < 0) return {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  const Mat R = mat_at(w.pose[body]);
#if FREE
  return mul(mat_at(w.base), R);
#else
  return R;
#endif
}

// The centre of mass of what hangs on a moving body, in the base's frame.
DEVICE Vec subtree_com(const World& w, int body) {
  return vec_at(w.sums[body]) * (real(1) / body_subtree_mass(body));
}

struct Quat {
  real w;
  Vec v;
};
DEVICE Quat product(Quat a, Quat b) { return {a.w * b.w - dot(a.v, b.v), b.v * a.w + a.v * b.w + cross(a.v, b.v)}; }

DEVICE Quat world_quat(const World& w, int body, Quat own) {
  Quat q = {1, {0, 0, 0}};
  if (body >= 0) {
#if FREE
    q = {w.qpos[3], vec_at(w.qpos + 4)};
#endif
    ROLLED for (int level = 0; level < DEPTH; ++level) {
      const int joint = chain_link(level * BODIES + body) >> 1;
      if (joint < 0) continue;
#if FREE_JOINTS
      if (joint_kind(joint) == FREE_JOINT) q = {w.qpos[joint_qpos(joint) + 3], vec_at(w.qpos + joint_qpos(joint) + 4)};
#endif
      if (joint_kind(joint) == HINGE) {
        real s, c;
        sine_cosine(real(0.5) * (w.qpos[joint_qpos(joint)] - joint_reference(joint)), &s, &c);
        q = product(q, {c, joint_axis(joint) * s});
      }
      q = product(q, {joint_quat_w(joint), joint_quat_v(joint)});
    }
  }
  q = product(q, own);
  const real scale = inverse_root(q.w * q.w + dot(q.v, q.v));
  return {q.w * scale, q.v * scale};
}

DEVICE void put_inertia(const World& w, int row, real* to) {
  const int body = place_body(row), tree = place_root(row);
  Sym I = {0, 0, 0, 0, 0, 0};
  Vec moment = {0, 0, 0};
  const real mass = tree < 0 ? real(0) : place_mass(row);
  if (tree >= 0) {
    const Vec inside = mul(mat_at(w.pose[body]), place_com(row)) + vec_at(w.pose[body] + 9);
    const Vec arm = turned_out(w, inside - subtree_com(w, tree));
    I = turned(world_rotation(w, body), place_inertia(row)) + outer(mass * dot(arm, arm), -mass, arm);
    moment = arm * mass;
  }
  put(to, vec(I.xx, I.yy, I.zz));
  put(to + 3, vec(I.xy, I.xz, I.yz));
  put(to + 6, moment);
  to[9] = mass;
}

DEVICE void put_velocity(const World& w, int row, real* to) {
  const int body = place_body(row), tree = place_root(row);
  Vec angular = {0, 0, 0}, linear = {0, 0, 0};
  if (tree >= 0) {
#if FREE
    linear = vec_at(w.velocity);
    angular = vec_at(w.velocity + 3);
#endif
    for (Dofs dofs = body_dofs(body) & OUTER_DOFS; dofs; dofs &= dofs - 1) {
      const int dof = lowest(dofs);
      angular = angular + vec_at(w.axis[dof]) * w.velocity[dof];
      linear = linear + vec_at(w.axis[dof] + 3) * w.velocity[dof];
    }
    linear = linear + cross(angular, subtree_com(w, tree));
  }
  put(to, turned_out(w, angular));
  put(to + 3, turned_out(w, linear));
}

// A lane's contact: its moment about the base's origin and its force, on the second body, in the world's axes.
DEVICE void put_wrench(World& w, int slot, const Contact& c) {
  real f[DIRECTIONS] = {0};
  UNROLLED for (int k = 1; k < DIRECTIONS; ++k) {
    if (k > frictions(c)) break;
    const real up = c.residual[0] + c.residual[k], down = c.residual[0] - c.residual[k];
    const real first = up < 0 ? -c.weight * up : real(0), second = down < 0 ? -c.weight * down : real(0);
    f[0] += first + second;
    f[k] = first - second;
  }
  Touch touch;
#if OWN_SLOTS
  touches_floor(w, slot, touch);
#else
  const real* from = w.contact[slot];
  touch = {vec_at(from), vec_at(from + 3), vec_at(from + 6), from[9]};
#endif
  const Vec n = touch.normal, t = first_tangent(touch), u = cross(n, t);
  const real mu = contact_friction(c.candidate);
  const Vec force = n * f[0] + t * (mu * f[1]) + u * (mu * f[2]);
  Vec moment = cross(touch.point, force);
#if DIRECTIONS > 3
  const real roll = contact_roll(c.candidate);
  moment = moment + n * (contact_spin(c.candidate) * f[3]) + t * (roll * f[4]) + u * (roll * f[5]);
#endif
  put(w.J + slot * J_WIDTH, moment);
  put(w.J + slot * J_WIDTH + 3, force);
}

DEVICE void put_contact_force(const World& w, int row, unsigned existing, real* to) {
  Vec moment = {0, 0, 0}, force = {0, 0, 0};
  const int tree = place_root(row);
  if (tree >= 0) {
    for (unsigned slots = existing; slots; slots &= slots - 1) {
      const int slot = lowest(slots);
      const int candidate = candidate_of(w, slot);
      const real sign = real(contact_second_place(candidate) == row) - real(contact_first_place(candidate) == row);
      if (sign != 0) {
        moment = moment + vec_at(w.J + slot * J_WIDTH) * sign;
        force = force + vec_at(w.J + slot * J_WIDTH + 3) * sign;
      }
    }
    moment = moment - cross(subtree_com(w, tree), force);
  }
  put(to, turned_out(w, moment));
  put(to + 3, turned_out(w, force));
}

template <int FIELD>
DEVICE void put_row(const World& w, int row, unsigned existing, real* to) {
  if constexpr (FIELD == QFRC_ACTUATOR) {
    to[0] = w.actuator[row];
  } else if constexpr (FIELD == QACC) {
    to[0] = w.qacc[row];
  } else if constexpr (FIELD == CFRC_EXT) {
    put_contact_force(w, row, existing, to);
  } else if constexpr (FIELD == CINERT) {
    put_inertia(w, row, to);
  } else if constexpr (FIELD == CVEL) {
    put_velocity(w, row, to);
  } else if constexpr (FIELD == XPOS) {
    put(to, world_point(w, place_body(row), place_position(row)));
  } else if constexpr (FIELD == XIPOS) {
    put(to, world_point(w, place_body(row), place_com(row)));
  } else if constexpr (FIELD == XMAT) {
    put(to, mul(world_rotation(w, place_body(row)), place_rotation(row)));
  } else if constexpr (FIELD == XQUAT) {
    const Quat q = world_quat(w, place_body(row), {place_quat_w(row), place_quat_v(row)});
    to[0] = q.w;
    put(to + 1, q.v);
  } else if constexpr (FIELD == SUBTREE_COM) {
    const int body = place_body(row);
    const Mat R = mat_at(w.pose[body]);
    put(to, world_point(w, body, mul_transposed(R, subtree_com(w, body) - vec_at(w.pose[body] + 9))));
  }
}

APART void read_rows(World& w, unsigned existing, const Outputs out) {
  repeat<0, READINGS>([&](auto number) {
    constexpr int reading = number;
    EACH_THREAD {
      ROLLED for (int k = lane; k < READING_COUNT[reading]; k += THREADS) {
        const int row = reading_row(READING_START[reading] + k);
        put_row<READING_FIELD[reading]>(w, row, existing, out.reading[reading] + k * READING_WIDTH[reading]);
      }
    }
  });
}

DEVICE void read_out(World& w, const PerLane<Contact>& contacts, unsigned existing, const Outputs& out) {
  if constexpr (READS_FORCES) {
    MEET();
    EACH_LANE if (contacts[ME].exists) put_wrench(w, lane, contacts[ME]);
    MEET();
  }
  read_rows(w, existing, out);
}
