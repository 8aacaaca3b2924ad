// Fields of mjData after the last evaluation, in the world's frame. cinert, cvel and cfrc_ext are about the centre of
// mass of a body's tree (engine_core_smooth.c, mj_comPos, mj_comVel, mj_rnePostConstraint).
#pragma once
#include "lanes_state.h"

FUNCTION Vec3 to_world(const Worlds& w, Vec3 v) { return HAS_FREE ? w.attitude * v : v; }

FUNCTION Vec3 origin(const Worlds& w) {
  if constexpr (HAS_FREE) return vec(w.qpos[0], w.qpos[1], w.qpos[2]);
  Vec3 shift = vec(0, 0, 0);
  for (int j = 0; j < NJOINTS; ++j) {
    const JointRow& joint = JOINTS[j];
    if (joint.kind == SHIFT) shift = shift + vec(joint.axis) * (w.qpos[joint.qpos] - Num(joint.reference));
  }
  return shift;
}

// Where a point of a body of the model is; one that no joint moves is where it is in the world.
FUNCTION Vec3 point_of(const Worlds& w, const PlaceRow& place, const Real* point) {
  if (place.body < (HAS_FREE ? 0 : 1)) return vec(point);
  return origin(w) + to_world(w, w.place[place.body] + w.turn[place.body] * vec(point));
}

FUNCTION Mat3 turn_of(const Worlds& w, const PlaceRow& place) {
  const Mat3 own = mat(place.rotation);
  if (place.body < 0) return own;
  const Mat3 turn = w.turn[place.body] * own;
  return HAS_FREE ? w.attitude * turn : turn;
}

// The product of the quaternions along the chain, as MuJoCo has it: a matrix would lose its sign.
FUNCTION void attitudes(const Worlds& w, Quat* found) {
  const Real none[4] = {1, 0, 0, 0};
  found[0] = HAS_FREE ? Quat{w.qpos[3], w.qpos[4], w.qpos[5], w.qpos[6]} : quat(none);
  for (int b = 1; b < NBODIES; ++b) {
    found[b] = found[BODIES[b].parent];
    for (int j = BODIES[b].first_joint; j < BODIES[b].last_joint; ++j) {
      const JointRow& joint = JOINTS[j];
      const Num angle = w.qpos[joint.qpos] - Num(joint.reference);
      if (joint.kind == FREE) {
        const Num* q = w.qpos + joint.qpos + 3;
        found[b] = {q[0], q[1], q[2], q[3]};
      }
      if (joint.kind == HINGE) found[b] = found[b] * quat_about(vec(joint.axis), angle);
      if (joint.turns) found[b] = found[b] * quat(joint.quat);
    }
    found[b] = normalised(found[b]);
  }
}

FUNCTION Vec3 centre_of_tree(const Worlds& w, int body) {
  return w.first_moment[body] * Num(Real(1) / BODIES[body].subtree_mass);
}

FUNCTION Num* put(Num* out, Vec3 v) {
  out[0] = v.x, out[1] = v.y, out[2] = v.z;
  return out + 3;
}
FUNCTION Num* put(Num* out, const Mat3& m) { return put(put(put(out, m.r0), m.r1), m.r2); }

// Whether a joint moves a body of the model.
FUNCTION bool is_moved(const PlaceRow& place) { return place.root >= 0 && (HAS_FREE || place.body > 0); }

FUNCTION Num* put_inertia(const Worlds& w, Num* out, const PlaceRow& place) {
  if (!is_moved(place)) {
    for (int k = 0; k < 10; ++k) out[k] = Num(0);
    return out + 10;
  }
  const int b = place.body;
  const Num mass = Num(place.mass);
  const Vec3 com = w.place[b] + w.turn[b] * vec(place.com);
  const Vec3 offset = to_world(w, com - centre_of_tree(w, place.root));
  const Mat3 turn = HAS_FREE ? w.attitude * w.turn[b] : w.turn[b];
  const Sym3 I = turned(turn, sym(place.inertia)) + diagonal_and_outer(mass * dot(offset, offset), -mass, offset);
  out[0] = I.xx, out[1] = I.yy, out[2] = I.zz, out[3] = I.xy, out[4] = I.xz, out[5] = I.yz;
  put(out + 6, offset * mass)[0] = mass;
  return out + 10;
}

FUNCTION Num* put_velocity(const Worlds& w, Num* out, const PlaceRow& place) {
  if (!is_moved(place)) return put(put(out, vec(0, 0, 0)), vec(0, 0, 0));
  const Vec3 spin = w.spin[place.body], velocity = w.drift[place.body];
  return put(put(out, to_world(w, spin)), to_world(w, velocity + cross(spin, centre_of_tree(w, place.root))));
}

// Forces of contacts on all bodies, [moment, force] each.
FUNCTION void contact_forces(const Worlds& w, Num (*on)[6]) {
  for (int b = 0; b < NPLACES; ++b) put(put(on[b], vec(0, 0, 0)), vec(0, 0, 0));
  for (int c = 0; c < w.slot_count; ++c) {
    const Slot& s = w.slots[c];
    const Num* r = s.residual;
    Num along[DIRECTIONS];
    for (int k = 0; k < DIRECTIONS; ++k) along[k] = Num(0);
    for (int k = 1; k <= s.frictions(); ++k) {
      const Num up = r[0] + r[k], down = r[0] - r[k];
      const Num first = select(up < Num(0), -s.weight * up, Num(0));
      const Num second = select(down < Num(0), -s.weight * down, Num(0));
      along[0] += first + second;
      along[k] = first - second;
    }
    const Vec3* axes = s.frame.axes;
    const Vec3 force = axes[0] * along[0] + axes[1] * along[1] + axes[2] * along[2];
    Vec3 couple = vec(0, 0, 0);
    for (int k = 3; k < DIRECTIONS; ++k) couple = couple + axes[k] * along[k];
    for (int side = 0; side < 2; ++side) {
      const int b = side ? s.place2 : s.place1;
      if (!b || !is_moved(PLACES[b])) continue;
      const Vec3 pushed = side ? force : -force;
      const Vec3 arm = s.frame.place - centre_of_tree(w, PLACES[b].root);
      const Vec3 moment = to_world(w, cross(arm, pushed) + (side ? couple : -couple)), pull = to_world(w, pushed);
      on[b][0] += moment.x, on[b][1] += moment.y, on[b][2] += moment.z;
      on[b][3] += pull.x, on[b][4] += pull.y, on[b][5] += pull.z;
    }
  }
}

FUNCTION void read_out(Worlds& w) {
  Quat attitude[NBODIES];
  Num forces[READS_FORCES ? NPLACES : 1][6];
  if constexpr (reads(XQUAT)) attitudes(w, attitude);
  if constexpr (READS_FORCES) contact_forces(w, forces);
  Num* out = w.out;
  for (int k = 0; k < NREADINGS; ++k) {
    const int row = READINGS[k].row;
    const PlaceRow& place = PLACES[row < NPLACES ? row : 0];
    switch (READINGS[k].field) {
      case XPOS: out = put(out, point_of(w, place, place.position)); break;
      case XIPOS: out = put(out, point_of(w, place, place.com)); break;
      case XMAT: out = put(out, turn_of(w, place)); break;
      case XQUAT: {
        const Quat own = quat(place.quat), q = place.body < 0 ? own : attitude[place.body] * own;
        out[0] = q.w, out[1] = q.x, out[2] = q.y, out[3] = q.z;
        out += 4;
        break;
      }
      case SUBTREE_COM: out = put(out, origin(w) + to_world(w, centre_of_tree(w, place.body))); break;
      case CINERT: out = put_inertia(w, out, place); break;
      case CVEL: out = put_velocity(w, out, place); break;
      case CFRC_EXT:
        for (int x = 0; x < 6; ++x) *out++ = forces[row][x];
        break;
      case QACC: *out++ = w.acceleration[row]; break;
      default: *out++ = w.motor[row];
    }
  }
}
