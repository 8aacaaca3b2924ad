// MuJoCo's control step of a world; see threads.h.
#pragma once
#include "threads_readouts.h"

// qacc of (qpos, qvel), which is also where the solver starts. `last`: also the readouts.
DEVICE void evaluate(World& w, bool last, const Outputs& out, bool& lost) {
  PerLane<Contact> contacts;
  PerLane<Limit> limits;
  place_joints(w);
  place_bodies(w);
  sum_subtrees(w);
#if SERVOS
  find_drives(w);
#endif
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

// A free joint's qpos, its first at address q, advanced by the rates from its first dof d on.
DEVICE void advance_free_joint(World& w, int q, int d) {
  const Vec spin = vec_at(w.rate + d + 3);
  const real squared = dot(spin, spin);
  real qw = w.start_qpos[q + 3];
  Vec v = vec_at(w.start_qpos + q + 4);
  if (squared > real(1e-30)) {
    const real inverse = inverse_root(squared);
    real s, c;
    sine_cosine(real(0.5) * TIMESTEP * squared * inverse, &s, &c);
    const Vec b = spin * (s * inverse);
    const real turned = qw * c - dot(v, b);
    v = b * qw + v * c + cross(v, b);
    qw = turned;
  }
  const real norm = inverse_root(qw * qw + dot(v, v));
  w.qpos[q + 3] = qw * norm;
  put(w.qpos + q + 4, v * norm);
}

// qpos = start_qpos advanced by a time step of `rate` (mj_integratePos).
DEVICE void advance(World& w) {
  EACH_LANE {
    if (lane < JOINTS) {
      const int q = joint_qpos(lane), d = joint_dof(lane);
#if FREE_JOINTS
      if (joint_kind(lane) == FREE_JOINT) {
        put(w.qpos + q, vec_at(w.start_qpos + q) + vec_at(w.rate + d) * TIMESTEP);
        advance_free_joint(w, q, d);
      } else
#endif
        w.qpos[q] = w.start_qpos[q] + TIMESTEP * w.rate[d];
    }
#if FREE
    if (lane >= LANES - 3) {
      const int k = lane - (LANES - 3);
      w.qpos[k] = w.start_qpos[k] + TIMESTEP * w.rate[k];
    }
    if (lane == LANES - 4) advance_free_joint(w, 0, 0);
#endif
  }
  MEET();
}

DEVICE void start_step(World& w) {
  EACH_THREAD {
    UNROLLED for (int i = lane; i < NQ; i += THREADS) w.start_qpos[i] = w.qpos[i];
  }
  EACH_LANE if (lane < NV) {
    w.start_qvel[lane] = w.qvel[lane];
    w.sum_velocity[lane] = w.sum_acceleration[lane] = 0;
  }
  MEET();
}

#if RK4
DEVICE void take_substeps(World& w, const Outputs& out, bool& lost) {
  ROLLED for (int e = 0; e < 4 * SUBSTEPS; ++e) {
    const int stage = e & 3;
    if (stage == 0) start_step(w);
    evaluate(w, !FORWARD && e == 4 * SUBSTEPS - 1, out, lost);
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
  EACH_THREAD {
    UNROLLED for (int e = lane; e < ENTRIES; e += THREADS) {
      const unsigned entry = hessian_entry(e);
      const int i = entry & 255, j = entry >> 8 & 255;
      w.H[i * WIDTH + j] = w.M[at_M(i, j)] + (i == j ? TIMESTEP * dof_damping(i) : real(0));
    }
  }
  EACH_LANE if (lane < NV) w.H[lane * WIDTH + NV] = times_inertia(w, w.acceleration, lane);
  MEET();
  solve_tree(w, x);
}

DEVICE void take_substeps(World& w, const Outputs& out, bool& lost) {
  ROLLED for (int e = 0; e < SUBSTEPS; ++e) {
    start_step(w);
    evaluate(w, !FORWARD && e == SUBSTEPS - 1, out, lost);
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

DEVICE void control_step(World& w, const Outputs& out, bool& lost) {
  take_substeps(w, out, lost);
#if FORWARD
  EACH_LANE if (lane < NV) w.warmstart[lane] = w.qacc[lane];
  MEET();
  evaluate(w, true, out, lost);
  EACH_LANE if (lane < NV) w.qacc[lane] = w.warmstart[lane];
  MEET();
#endif
}
