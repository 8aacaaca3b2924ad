// MuJoCo's control step of several worlds at once, a world a lane. Loops over bodies, joints and candidates for contacts
// are the same for all; only loops whose length depends on the data look at all lanes. A world's numbers do not depend
// on the other lanes.
#pragma once
#include "lanes_contacts.h"
#include "lanes_readouts.h"
#include "lanes_smooth.h"
#include "lanes_solver.h"

// The acceleration of (qpos, qvel); from the one before, where the solver starts. `last`: and what is read out.
FUNCTION void forward(Worlds& w, bool last) {
  enter_base_frame(w);
  outward(w);
  if constexpr (SERVOS) drive(w);
  if constexpr (FLUID) push_by_fluid(w);
  inward(w);
  find_constraints(w);
  newton(w, last);
  for (int i = 0; i < NV; ++i) w.acceleration[i] = w.a[i];
  if constexpr (HAS_FREE) {
    const Vec3 linear = w.attitude * vec(w.a[0], w.a[1], w.a[2]);
    w.acceleration[0] = linear.x, w.acceleration[1] = linear.y, w.acceleration[2] = linear.z;
  }
  if (last) read_out(w);
}

FUNCTION void advance_free_joint(const Num* start, const Num* velocity, Real time, Num* to) {
  for (int i = 0; i < 3; ++i) to[i] = start[i] + Num(time) * velocity[i];
  const Quat from = {start[3], start[4], start[5], start[6]};
  const Quat q = integrated(from, vec(velocity[3], velocity[4], velocity[5]), Num(time));
  to[3] = q.w, to[4] = q.x, to[5] = q.y, to[6] = q.z;
}

// qpos = start_qpos moved by `velocity` for `time` (engine_core_util.c, mj_integratePos).
FUNCTION void advance_qpos(Worlds& w, const Num* velocity, Real time) {
  if constexpr (HAS_FREE) advance_free_joint(w.start_qpos, velocity, time, w.qpos);
  for (int j = 0; j < NJOINTS; ++j) {
    const int q = JOINTS[j].qpos, d = JOINTS[j].dof;
    if (JOINTS[j].kind == FREE) advance_free_joint(w.start_qpos + q, velocity + d, time, w.qpos + q);
    else w.qpos[q] = w.start_qpos[q] + Num(time) * velocity[d];
  }
}

// Euler, implicit in the joints' damping: (M + h B) a = M qacc, as M qacc is all that acts (engine_forward.c, mj_Euler).
FUNCTION void euler_step(Worlds& w, bool last) {
  forward(w, last);
  for (int i = 0; i < NV; ++i) w.step[i] = w.acceleration[i];
  if constexpr (DAMPED) {
    times_M(w, w.a, w.Ma);
    copy_M(w);
    for (int i = 0; i < NV; ++i) {
      w.gradient[i] = -w.Ma[i];
      w.H[i][i] += Num(TIMESTEP * DAMPING[i]);
    }
    solve(w);
    if constexpr (HAS_FREE) {
      const Vec3 linear = w.attitude * vec(w.step[0], w.step[1], w.step[2]);
      w.step[0] = linear.x, w.step[1] = linear.y, w.step[2] = linear.z;
    }
  }
  for (int i = 0; i < NQ; ++i) w.start_qpos[i] = w.qpos[i];
  for (int i = 0; i < NV; ++i) w.qvel[i] += Num(TIMESTEP) * w.step[i];
  advance_qpos(w, w.qvel, TIMESTEP);
}

// Runge and Kutta's fourth order (engine_forward.c, mj_RungeKutta).
FUNCTION void runge_kutta_step(Worlds& w, bool last) {
  for (int i = 0; i < NQ; ++i) w.start_qpos[i] = w.qpos[i];
  for (int i = 0; i < NV; ++i) {
    w.start_qvel[i] = w.qvel[i];
    w.mean_velocity[i] = w.mean_acceleration[i] = Num(0);
  }
  for (int stage = 0; stage < 4; ++stage) {
    forward(w, last && stage == 3);
    const Num weight = Num(stage == 0 || stage == 3 ? Real(1) / 6 : Real(1) / 3);
    const Real ahead = stage == 2 ? TIMESTEP : TIMESTEP / 2;
    for (int i = 0; i < NV; ++i) {
      w.mean_velocity[i] += weight * w.qvel[i];
      w.mean_acceleration[i] += weight * w.acceleration[i];
    }
    if (stage == 3) break;
    advance_qpos(w, w.qvel, ahead);
    for (int i = 0; i < NV; ++i) w.qvel[i] = w.start_qvel[i] + Num(ahead) * w.acceleration[i];
  }
  advance_qpos(w, w.mean_velocity, TIMESTEP);
  for (int i = 0; i < NV; ++i) w.qvel[i] = w.start_qvel[i] + Num(TIMESTEP) * w.mean_acceleration[i];
}

FUNCTION void control_step(Worlds& w, long substeps) {
  for (long substep = 0; substep < substeps; ++substep) {
    const bool last = substep == substeps - 1 && !FORWARD;
    if constexpr (RUNGE_KUTTA) runge_kutta_step(w, last);
    else euler_step(w, last);
  }
  if constexpr (FORWARD) {
    for (int i = 0; i < NV; ++i) w.warmstart[i] = w.acceleration[i];
    forward(w, true);
    for (int i = 0; i < NV; ++i) w.acceleration[i] = w.warmstart[i];
  }
}
