// Poses, velocities, the mass matrix and all forces but the constraints': engine_core_smooth.c, in the base's frame. There
// the root's columns need no products, and far from the world's origin no digits are lost.
#pragma once
#include "lanes_state.h"

FUNCTION void enter_base_frame(Worlds& w) {
  for (int i = 0; i < NV; ++i) {
    w.velocity[i] = w.qvel[i];
    w.a[i] = w.acceleration[i];
  }
  w.world = {vec(1, 0, 0), vec(0, 1, 0), vec(0, 0, 1)};
  w.height = Num(0);
  w.turn[0] = {w.world.x, w.world.y, w.world.up};
  w.place[0] = w.spin[0] = w.spin_rate[0] = w.drift[0] = vec(0, 0, 0);
  if constexpr (HAS_FREE) {
    w.attitude = rotation(Quat{w.qpos[3], w.qpos[4], w.qpos[5], w.qpos[6]});
    w.world = {w.attitude.r0, w.attitude.r1, w.attitude.r2};
    w.height = w.qpos[2];
    const Vec3 velocity = transposed_times(w.attitude, vec(w.qvel[0], w.qvel[1], w.qvel[2]));
    const Vec3 a = transposed_times(w.attitude, vec(w.acceleration[0], w.acceleration[1], w.acceleration[2]));
    w.velocity[0] = velocity.x, w.velocity[1] = velocity.y, w.velocity[2] = velocity.z;
    w.a[0] = a.x, w.a[1] = a.y, w.a[2] = a.z;
    w.spin[0] = vec(w.qvel[3], w.qvel[4], w.qvel[5]);
    w.drift[0] = velocity;
  }
  w.rate[0] = w.world.up * Num(GRAVITY);  // as if the world accelerated upwards
}

struct Motion {
  Mat3 turn;
  Vec3 place, spin, spin_rate, rate, drift;  // drift: velocity of the body's point at the base's origin
};

// Moves on to a point of the same body.
FUNCTION void carry(Motion& m, Vec3 offset) {
  m.rate = m.rate + cross(m.spin_rate, offset) + cross(m.spin, cross(m.spin, offset));
  m.place = m.place + offset;
}

// A free joint: its place and attitude are its own, and it has no parent but the world.
FUNCTION void pass_free_joint(Worlds& w, Motion& m, const JointRow& joint) {
  const Num* qpos = w.qpos + joint.qpos;
  const Num* velocity = w.velocity + joint.dof;
  m.turn = rotation(normalised(Quat{qpos[3], qpos[4], qpos[5], qpos[6]}));
  m.place = vec(qpos[0], qpos[1], qpos[2]);
  m.spin = m.turn * vec(velocity[3], velocity[4], velocity[5]);
  const Vec3 columns[3] = {vec(m.turn.r0.x, m.turn.r1.x, m.turn.r2.x), vec(m.turn.r0.y, m.turn.r1.y, m.turn.r2.y),
                           vec(m.turn.r0.z, m.turn.r1.z, m.turn.r2.z)};
  const Vec3 along[3] = {w.world.x, w.world.y, w.world.up};
  for (int k = 0; k < 3; ++k) {
    w.axis_spin[joint.dof + k] = vec(0, 0, 0);
    w.axis_move[joint.dof + k] = along[k];
    w.axis_spin[joint.dof + 3 + k] = columns[k];
    w.axis_move[joint.dof + 3 + k] = cross(m.place, columns[k]);
  }
  if constexpr (FLUID || reads(CVEL)) {
    for (int k = 0; k < 6; ++k) m.drift = m.drift + w.axis_move[joint.dof + k] * velocity[k];
  }
}

FUNCTION void pass_joint(Worlds& w, Motion& m, const JointRow& joint) {
  if (joint.kind == FREE) return pass_free_joint(w, m, joint);
  const Vec3 local = vec(joint.axis), axis = m.turn * local;
  const Num position = w.qpos[joint.qpos] - Num(joint.reference), velocity = w.velocity[joint.dof];
  Vec3 anchor = vec(joint.anchor);
  if (joint.kind == SLIDE) anchor = anchor + local * position;
  carry(m, m.turn * anchor);
  if (joint.kind == HINGE) {
    const Mat3 turn = rotation(local, position);
    m.turn = m.turn * (joint.turns ? turn * mat(joint.rotation) : turn);
    w.axis_spin[joint.dof] = axis;
    w.axis_move[joint.dof] = cross(m.place, axis);
    m.spin_rate = m.spin_rate + cross(m.spin, axis) * velocity;
    m.spin = m.spin + axis * velocity;
    if (joint.moves) carry(m, -(m.turn * vec(joint.position)));
  } else {
    if (joint.turns) m.turn = m.turn * mat(joint.rotation);
    w.axis_spin[joint.dof] = vec(0, 0, 0);
    w.axis_move[joint.dof] = axis;
    m.rate = m.rate + cross(m.spin, axis) * (Num(2) * velocity);
  }
  if constexpr (FLUID || reads(CVEL)) m.drift = m.drift + w.axis_move[joint.dof] * velocity;
}

// Inertia of a body and the force that its motion takes, about the base's origin.
FUNCTION void weigh(Worlds& w, int b) {
  const BodyRow& body = BODIES[b];
  const Num mass = Num(body.mass);
  const Mat3& turn = w.turn[b];
  const Vec3 offset = turn * vec(body.com), com = w.place[b] + offset;
  const Vec3 spin = w.spin[b], spin_rate = w.spin_rate[b];
  const Sym3 inertia = body.axial ? diagonal_and_outer(Num(body.across), Num(body.along), turn * vec(body.axis))
                                  : turned(turn, sym(body.inertia));
  w.force[b] = (w.rate[b] + cross(spin_rate, offset) + cross(spin, cross(spin, offset))) * mass;
  w.moment[b] = inertia * spin_rate + cross(spin, inertia * spin) + cross(com, w.force[b]);
  w.first_moment[b] = com * mass;
  w.inertia[b] = inertia + diagonal_and_outer(mass * dot(com, com), -mass, com);
}

FUNCTION void outward(Worlds& w) {
  for (int b = 0; b < NBODIES; ++b) {
    const int parent = BODIES[b].parent;
    Motion m = {w.turn[parent], w.place[parent], w.spin[parent], w.spin_rate[parent], w.rate[parent], w.drift[parent]};
    for (int j = BODIES[b].first_joint; j < BODIES[b].last_joint; ++j) pass_joint(w, m, JOINTS[j]);
    w.turn[b] = m.turn, w.place[b] = m.place, w.spin[b] = m.spin;
    w.spin_rate[b] = m.spin_rate, w.rate[b] = m.rate, w.drift[b] = m.drift;
    weigh(w, b);
  }
}

FUNCTION void push_by_fluid(Worlds& w) {
  for (int k = 0; k < NBOXES; ++k) {
    const BoxRow& box = BOXES[k];
    const int b = box.body;
    const Mat3 axes = w.turn[b] * mat(box.axes);
    const Vec3 centre = w.place[b] + w.turn[b] * vec(box.centre);
    const Vec3 velocity = transposed_times(axes, w.drift[b] + cross(w.spin[b], centre));
    Vec3 force, moment;
    fluid_on_box(vec(box.size), velocity, transposed_times(axes, w.spin[b]), Num(DENSITY), Num(VISCOSITY), &force,
                 &moment);
    force = axes * force;
    w.force[b] = w.force[b] - force;
    w.moment[b] = w.moment[b] - axes * moment - cross(centre, force);
  }
}

// What a unit of a motor's force at a site does along a degree of freedom.
FUNCTION Num site_share(const Worlds& w, const MotorRow& motor, int d) {
  const Mat3& turn = w.turn[motor.body];
  const Vec3 push = turn * vec(motor.push), arm = w.place[motor.body] + turn * vec(motor.place);
  return dot(w.axis_spin[d], cross(arm, push) + turn * vec(motor.turn)) + dot(w.axis_move[d], push);
}

// The forces of motors, which depend on places and speeds (engine_forward.c, mj_fwdActuation).
FUNCTION void drive(Worlds& w) {
  for (int i = 0; i < NV; ++i) w.motor[i] = Num(0);
  for (int k = 0; k < NU; ++k) {
    const MotorRow& motor = MOTORS[k];
    const bool at_site = motor.dof < 0;
    const int* dofs = at_site ? CHAINS[motor.body] : &motor.dof;
    const int count = at_site ? NCHAINS[motor.body] : 1;
    Num share[MOST_COLUMNS], speed = Num(0);
    for (int c = 0; c < count; ++c) {
      share[c] = at_site ? site_share(w, motor, dofs[c]) : Num(motor.gear);
      speed += share[c] * w.velocity[dofs[c]];
    }
    const Num length = at_site ? Num(0) : Num(motor.gear) * w.qpos[motor.qpos];
    Num force = w.drive[k] + Num(motor.bias[0]) + Num(motor.bias[1]) * length + Num(motor.bias[2]) * speed;
    force = clip(force, Num(motor.weakest), Num(motor.strongest));
    for (int c = 0; c < count; ++c) w.motor[dofs[c]] += share[c] * force;
  }
}

FUNCTION void root_rows(Worlds& w) {
  const Num zero = Num(0), mass = Num(BODIES[0].subtree_mass);
  const Vec3 h = w.first_moment[0];
  const Sym3 I = w.inertia[0];
  w.M[0][0] = w.M[1][1] = w.M[2][2] = mass;
  w.M[1][0] = w.M[2][0] = w.M[2][1] = zero;
  w.M[3][0] = zero, w.M[3][1] = -h.z, w.M[3][2] = h.y;
  w.M[4][0] = h.z, w.M[4][1] = zero, w.M[4][2] = -h.x;
  w.M[5][0] = -h.y, w.M[5][1] = h.x, w.M[5][2] = zero;
  w.M[3][3] = I.xx, w.M[4][4] = I.yy, w.M[5][5] = I.zz;
  w.M[4][3] = I.xy, w.M[5][3] = I.xz, w.M[5][4] = I.yz;
  w.smooth[0] = -w.force[0].x, w.smooth[1] = -w.force[0].y, w.smooth[2] = -w.force[0].z;
  w.smooth[3] = -w.moment[0].x, w.smooth[4] = -w.moment[0].y, w.smooth[5] = -w.moment[0].z;
  // The world's axes are those of the linear dofs, but a root's damping and armature are the same along each.
  for (int i = 0; i < 6; ++i) {
    w.M[i][i] += Num(ARMATURE[i]);
    w.smooth[i] -= Num(DAMPING[i]) * w.velocity[i];
  }
}

// Row d of M by the inertia of all that joint d moves, and the force on it.
FUNCTION void joint_row(Worlds& w, int b, int d) {
  const Vec3 spin = w.axis_spin[d], move = w.axis_move[d];
  const Vec3 linear = move * Num(BODIES[b].subtree_mass) + cross(spin, w.first_moment[b]);
  const Vec3 angular = w.inertia[b] * spin + cross(w.first_moment[b], move);
  w.M[d][d] = dot(spin, angular) + dot(move, linear) + Num(ARMATURE[d]);
  for (int k = 0; k < NANCESTORS[d] - FIRST; ++k) {
    const int j = ANCESTORS[d][k];
    w.M[d][j] = dot(w.axis_spin[j], angular) + dot(w.axis_move[j], linear);
  }
  if constexpr (HAS_FREE) {
    w.M[d][0] = linear.x, w.M[d][1] = linear.y, w.M[d][2] = linear.z;
    w.M[d][3] = angular.x, w.M[d][4] = angular.y, w.M[d][5] = angular.z;
  }
  Num force = w.motor[d] - Num(DAMPING[d]) * w.velocity[d] - dot(spin, w.moment[b]) - dot(move, w.force[b]);
  if constexpr (SPRINGS) force -= Num(STIFFNESS[d]) * (w.qpos[QPOS_OF_DOF[d]] - Num(SPRING[d]));
  w.smooth[d] = force;
}

FUNCTION void inward(Worlds& w) {
  for (int b = NBODIES - 1; b > 0; --b) {
    for (int j = BODIES[b].last_joint - 1; j >= BODIES[b].first_joint; --j) {
      for (int k = JOINTS[j].kind == FREE ? 5 : 0; k >= 0; --k) joint_row(w, b, JOINTS[j].dof + k);
    }
    const int parent = BODIES[b].parent;
    w.first_moment[parent] = w.first_moment[parent] + w.first_moment[b];
    w.inertia[parent] = w.inertia[parent] + w.inertia[b];
    w.force[parent] = w.force[parent] + w.force[b];
    w.moment[parent] = w.moment[parent] + w.moment[b];
  }
  if constexpr (HAS_FREE) root_rows(w);
}
