// Contacts and limits: which some world has, their Jacobians, and their residuals at the warm start.
#pragma once
#include "lanes_state.h"
#include "box_pair.h"

// Keeps a world's contacts within its room, and reports where it had too little. Whether any world has the contact.
FUNCTION bool admit(Worlds& w, Mask& has) {
  if (!any(has)) return false;
  if constexpr (MOST_CONTACTS >= CANDIDATES) return true;
  w.contacts += select(has, Num(1), Num(0));
  const Mask over = has & (w.contacts > Num(MOST_CONTACTS));
  w.overflow = select(over, Num(1), w.overflow);
  has &= !over;
  return any(has);
}

FUNCTION Vec3 of_body(const Worlds& w, int b, const Real* place) {
  return HAS_FREE && b == 0 ? vec(place) : w.turn[b] * vec(place) + w.place[b];
}
FUNCTION Vec3 turned_with_body(const Worlds& w, int b, const Real* axis) {
  return HAS_FREE && b == 0 ? vec(axis) : w.turn[b] * vec(axis);
}

FUNCTION Frame frame_of(Vec3 place, Vec3 normal, Vec3 tangent, const ContactRow& contact) {
  const Vec3 along[3] = {normal, tangent, cross(normal, tangent)};
  Frame frame;
  frame.place = place;
  for (int x = 0; x < DIRECTIONS; ++x) frame.axes[x] = x ? along[x % 3] * Num(contact.friction[x - 1]) : normal;
  return frame;
}

// The weight of an edge and the contact's residuals, J (a + B v) + K imp position (engine_core_constraint.c,
// mj_makeImpedance and mj_referenceConstraint).
FUNCTION void finish_slot(Worlds& w, Slot& s, Mask has, Num distance, const ContactRow& contact) {
  const ImpedanceRow& row = contact.impedance;
  const Num position = distance - Num(contact.margin);
  const Num imp = impedance(position, Num(row.lowest), Num(row.highest), Num(row.inverse_width));
  for (int x = 0; x < DIRECTIONS; ++x) s.residual[x] = s.change[x] = Num(0);
  for (int k = 0; k < s.columns; ++k) {
    const int d = s.dofs[k];
    const Num wanted = w.a[d] + Num(row.damping) * w.velocity[d];
    for (int x = 0; x < DIRECTIONS; ++x) s.residual[x] += s.jacobian[k][x] * wanted;
  }
  s.residual[0] += Num(row.stiffness) * imp * position;
  s.has = has, s.dims = contact.dims;
  s.weight = select(has, imp * inverse(Num(contact.regularisation) * (Num(1) - imp)), Num(0));
}

FUNCTION void joint_columns(const Worlds& w, Slot& s, const Frame& frame, int from, const Real* signs) {
  Vec3 moments[3];
  for (int x = 0; x < 3; ++x) moments[x] = cross(frame.place, frame.axes[x]);
  for (int k = from; k < s.columns; ++k) {
    const Vec3 spin = w.axis_spin[s.dofs[k]], move = w.axis_move[s.dofs[k]];
    for (int x = 0; x < 3; ++x) {
      const Num entry = dot(spin, moments[x]) + dot(move, frame.axes[x]);
      s.jacobian[k][x] = signs ? Num(signs[k]) * entry : entry;
    }
    for (int x = 3; x < DIRECTIONS; ++x) {
      const Num entry = dot(spin, frame.axes[x]);
      s.jacobian[k][x] = signs ? Num(signs[k]) * entry : entry;
    }
  }
}

FUNCTION void root_columns(Slot& s, const Frame& frame) {
  for (int x = 0; x < 3; ++x) {
    const Vec3 axis = frame.axes[x], moment = cross(frame.place, axis);
    s.jacobian[0][x] = axis.x, s.jacobian[1][x] = axis.y, s.jacobian[2][x] = axis.z;
    s.jacobian[3][x] = moment.x, s.jacobian[4][x] = moment.y, s.jacobian[5][x] = moment.z;
  }
  for (int x = 3; x < DIRECTIONS; ++x) {
    const Vec3 axis = frame.axes[x];
    for (int k = 0; k < 3; ++k) s.jacobian[k][x] = Num(0);
    s.jacobian[3][x] = axis.x, s.jacobian[4][x] = axis.y, s.jacobian[5][x] = axis.z;
  }
}

FUNCTION void floor_contacts(Worlds& w) {
  Num corners = Num(0);  // of the box at hand that touch: four at most do, and none of its upper half
  for (int c = 0; c < NPOINTS; ++c) {
    const PointRow& point = POINTS[c];
    const int b = point.body;
    const Vec3 up = w.world.up, centre = of_body(w, b, point.centre);
    const Num radius = Num(point.radius);
    const Num distance = dot(up, centre) + w.height - Num(point.height) - radius;
    Mask has = distance <= Num(point.contact.margin);
    if (point.corner) {
      if (point.corner == 1) corners = Num(0);
      if (!any(has)) continue;
      has &= (dot(up, turned_with_body(w, b, point.axis)) <= Num(0)) & (corners < Num(4));
      corners += select(has, Num(1), Num(0));
    }
    if (!admit(w, has)) continue;
    const Vec3 first = point.capsule ? tangent(w.world, up, turned_with_body(w, b, point.axis)) : w.world.y;
    const Vec3 place = centre - up * (radius + Num(Real(.5)) * distance);
    const Frame frame = frame_of(place, up, first, point.contact);
    Slot& s = w.slots[w.slot_count++];
    s.dofs = CHAINS[b], s.columns = NCHAINS[b], s.place1 = 0, s.place2 = point.place;
    if constexpr (HAS_FREE) root_columns(s, frame);
    joint_columns(w, s, frame, FIRST, nullptr);
    if constexpr (READS_FORCES) s.frame = frame;
    finish_slot(w, s, has, distance, point.contact);
  }
}

FUNCTION void add_pair(Worlds& w, int c, Mask has, Num distance, Vec3 place, Vec3 normal, int place1, int place2) {
  const PairRow& pair = PAIRS[c];
  const Frame frame = frame_of(place, normal, tangent(w.world, normal), pair.contact);
  Slot& slot = w.slots[w.slot_count++];
  slot.dofs = PAIR_DOFS[c], slot.columns = pair.columns, slot.place1 = place1, slot.place2 = place2;
  if (HAS_FREE && pair.rooted) root_columns(slot, frame);
  joint_columns(w, slot, frame, pair.rooted ? FIRST : 0, PAIR_SIGNS[c]);
  if constexpr (READS_FORCES) slot.frame = frame;
  finish_slot(w, slot, has, distance, pair.contact);
  if constexpr (FILLS) {
    const Dofs one = 1;
    Dofs all = 0;
    for (int k = 0; k < pair.columns; ++k) all |= one << PAIR_DOFS[c][k];
    for (int k = 0; k < pair.columns; ++k) w.pattern[PAIR_DOFS[c][k]] |= all & ((one << PAIR_DOFS[c][k]) - 1);
  }
}

FUNCTION void pair_contact(Worlds& w, int c, const Segments& s, Num first, Num second, Mask wanted) {
  const PairRow& pair = PAIRS[c];
  const SegmentRow &one = SEGMENTS[pair.first], &two = SEGMENTS[pair.second];
  const Vec3 on_first = s.middle1 + s.half1 * first, apart = s.middle2 + s.half2 * second - on_first;
  const Num length = root(dot(apart, apart));
  Num distance = length - Num(one.radius + two.radius);
  Mask has = wanted & (distance <= Num(pair.contact.margin));
  if (!admit(w, has)) return;
  // A world without this contact must not see NaN: 0 * NaN would stay.
  distance = select(has, distance, Num(0));
  const Vec3 side1 = turned_with_body(w, one.body, one.side), side2 = turned_with_body(w, two.body, two.side);
  const Vec3 normal = select(has, normal_between(w.world, apart, length, side1, side2), w.world.x);
  const Vec3 surface = normal * (Num(one.radius) + Num(Real(.5)) * distance);
  add_pair(w, c, has, distance, select(has, on_first + surface, vec(0, 0, 0)), normal, one.place, two.place);
}

FUNCTION void pair_contacts(Worlds& w) {
  Vec3 middles[at_least_one(NSEGMENTS)], halves[at_least_one(NSEGMENTS)];
  for (int g = 0; g < NSEGMENTS; ++g) {
    middles[g] = of_body(w, SEGMENTS[g].body, SEGMENTS[g].centre);
    halves[g] = turned_with_body(w, SEGMENTS[g].body, SEGMENTS[g].half);
  }
  for (int c = 0; c < NSEGMENT_PAIRS; ++c) {
    const PairRow& pair = PAIRS[c];
    const int one = pair.first, two = pair.second;
    const Vec3 apart = middles[one] - middles[two];
    if (!any(dot(apart, apart) <= Num(pair.reach * pair.reach * Real(1.0001)))) continue;
    const Segments s = {middles[one], middles[two], halves[one], halves[two]};
    const Num none = dot(w.world.up, w.world.up) * Num(0);
    Nearest nearest = {none, none, mask_of(false), none, none};
    if (SEGMENTS[one].capsule) nearest = nearest_of_capsules(s);
    else if (SEGMENTS[two].capsule) nearest = nearest_of_sphere_and_capsule(s);
    for (int k = 0; k < 2; ++k) {  // one call: what is inlined once compiles sooner
      const Mask wanted = k ? nearest.two : mask_of(true);
      const Num first = k ? nearest.first_again : nearest.first, second = k ? nearest.second_again : nearest.second;
      if (any(wanted)) pair_contact(w, c, s, first, second, wanted);
    }
  }
}

// A block as the base's frame has it: a point of that frame is at axes * point + shift of the block's.
struct BlockFrame {
  Mat3 axes;  // rows are the block's axes
  Vec3 shift;
};

FUNCTION BlockFrame frame_of(const Worlds& w, const BlockRow& block) {
  const Mat3 own = mat(block.axes);
  const Vec3 offset = vec(block.offset);
  if (block.body < 0) {  // fixed to the world, in which the root is; a place far from the origin keeps its digits
    return {own * w.attitude, own * vec(w.qpos[0], w.qpos[1], w.qpos[2]) - offset};
  }
  if (block.body == 0) return {own, -offset};
  const Mat3& turn = w.turn[block.body];
  const Mat3 axes = {turn * own.r0, turn * own.r1, turn * own.r2};
  return {axes, -(axes * w.place[block.body]) - offset};
}

FUNCTION void block_contact(Worlds& w, int c, const BlockRow& block, const BlockFrame& in, Vec3 place, Mask wanted) {
  const PairRow& pair = PAIRS[c];
  const SegmentRow& segment = SEGMENTS[pair.second];
  const Vec3 inside = in.axes * place + in.shift;
  const Num centre[3] = {inside.x, inside.y, inside.z};
  Num out[3];
  Num distance = sphere_on_box(centre, Num(segment.radius), block.size, out);
  Mask has = wanted & (distance <= Num(pair.contact.margin));
  if (!admit(w, has)) return;
  distance = select(has, distance, Num(0));
  const Vec3 normal = select(has, transposed_times(in.axes, vec(out[0], out[1], out[2])), w.world.x);
  const Vec3 surface = normal * (Num(segment.radius) + Num(Real(.5)) * distance);
  add_pair(w, c, has, distance, select(has, place - surface, vec(0, 0, 0)), normal, block.place, segment.place);
}

FUNCTION void block_pair(Worlds& w, int c, const BlockRow& block, const BlockFrame& in) {
  const SegmentRow& segment = SEGMENTS[PAIRS[c].second];
  const Vec3 place = of_body(w, segment.body, segment.centre), inside = in.axes * place + in.shift;
  const Num middle[3] = {inside.x, inside.y, inside.z};
  const Mask near = square_outside(middle, block.size) <= Num(PAIRS[c].reach * PAIRS[c].reach * Real(1.0001));
  if (!any(near)) return;
  const Vec3 axis = turned_with_body(w, segment.body, segment.half), inside_axis = in.axes * axis;
  Spheres spheres = {Num(0), Num(0), mask_of(false)};
  if (segment.capsule) {
    const Num half[3] = {inside_axis.x, inside_axis.y, inside_axis.z};
    spheres = spheres_on_box(middle, half, block.size);
  }
  for (int k = 0; k < 2; ++k) {  // one call: what is inlined once compiles sooner
    const Mask wanted = k ? near & spheres.two : near;
    if (any(wanted)) block_contact(w, c, block, in, place + axis * (k ? spheres.second : spheres.first), wanted);
  }
}

FUNCTION void block_contacts(Worlds& w) {
  for (int k = 0; k < NBLOCKS; ++k) {
    const BlockRow& block = BLOCKS[k];
    const BlockFrame in = frame_of(w, block);
    const Num base[3] = {in.shift.x, in.shift.y, in.shift.z};
    if (block.reach > 0 && !any(square_outside(base, block.size) <= Num(block.reach * block.reach))) continue;
    for (int c = block.first_pair; c < block.last_pair; ++c) block_pair(w, c, block, in);
  }
}

FUNCTION Vec3 middle_of(const BlockFrame& in) { return -transposed_times(in.axes, in.shift); }

// The contacts of two boxes in a world whose boxes are near.
FUNCTION void touch_boxes(int lane, const PairRow& pair, const BlockFrame& first, const BlockFrame& second, Vec3 apart,
                          Touches& found) {
  BoxPair boxes;
  const Vec3 rows1[3] = {first.axes.r0, first.axes.r1, first.axes.r2};
  const Vec3 rows2[3] = {second.axes.r0, second.axes.r1, second.axes.r2};
  const Num places[3] = {apart.x, apart.y, apart.z};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) boxes.turn[i][j] = ::lane(dot(rows1[i], rows2[j]), lane);
    boxes.apart[i] = ::lane(places[i], lane);
    boxes.size1[i] = BLOCKS[pair.first].size[i], boxes.size2[i] = BLOCKS[pair.second].size[i];
  }
  boxes.margin = pair.contact.margin;
  touch_boxes(boxes, found);
}

FUNCTION void box_pair(Worlds& w, int c, const BlockFrame& first, const BlockFrame& second, Mask near) {
  const PairRow& pair = PAIRS[c];
  const Vec3 apart = first.axes * middle_of(second) + first.shift;
  const unsigned wanted = signs(near);
  Touches found[LANES];
  int most = 0;
  for (int i = 0; i < LANES; ++i) {
    found[i].count = 0;
    if (wanted >> i & 1) touch_boxes(i, pair, first, second, apart, found[i]);
    most = found[i].count > most ? found[i].count : most;
  }
  for (int k = 0; k < most; ++k) {
    Num place[3], normal[3], distance = Num(0), number = Num(-1);
    for (int x = 0; x < 3; ++x) place[x] = normal[x] = Num(0);
    for (int i = 0; i < LANES; ++i) {
      if (k >= found[i].count) continue;
      set_lane(distance, i, found[i].distance[k]);
      set_lane(number, i, Real(k));
      for (int x = 0; x < 3; ++x) {
        set_lane(place[x], i, found[i].place[k][x]);
        set_lane(normal[x], i, found[i].normal[x]);
      }
    }
    Mask has = number >= Num(0);
    if (!admit(w, has)) continue;
    const Vec3 inside = vec(place[0], place[1], place[2]) - first.shift;
    const Vec3 out = transposed_times(first.axes, vec(normal[0], normal[1], normal[2]));
    const Vec3 at = select(has, transposed_times(first.axes, inside), vec(0, 0, 0));
    add_pair(w, c, has, select(has, distance, Num(0)), at, select(has, out, w.world.x), BLOCKS[pair.first].place,
             BLOCKS[pair.second].place);
  }
}

FUNCTION void box_contacts(Worlds& w) {
  BlockFrame frames[at_least_one(NBLOCKS)];
  Vec3 middles[at_least_one(NBLOCKS)];
  for (int k = 0; k < NBLOCKS; ++k) {
    frames[k] = frame_of(w, BLOCKS[k]);
    middles[k] = middle_of(frames[k]);
  }
  for (int c = NPAIRS - NBOX_PAIRS; c < NPAIRS; ++c) {
    const PairRow& pair = PAIRS[c];
    const Vec3 apart = middles[pair.first] - middles[pair.second];
    const Mask near = dot(apart, apart) <= Num(pair.reach * pair.reach * Real(1.0001));
    if (any(near)) box_pair(w, c, frames[pair.first], frames[pair.second], near);
  }
}

FUNCTION void limits(Worlds& w) {
  w.limit_count = 0;
  for (int k = 0; k < NLIMITS; ++k) {
    const LimitRow& limit = LIMITS[k];
    const Num qpos = w.qpos[limit.qpos], above = qpos - Num(limit.low), below = Num(limit.high) - qpos;
    const Mask low = above < below;
    const Num position = select(low, above, below) - Num(limit.margin);
    const Mask beyond = position < Num(0);
    if (!any(beyond)) continue;
    w.limits[w.limit_count++] = k;
    const ImpedanceRow& row = limit.impedance;
    const Num sign = select(low, Num(1), Num(-1));
    const Num imp = impedance(position, Num(row.lowest), Num(row.highest), Num(row.inverse_width));
    const Num wanted = w.a[limit.dof] + Num(row.damping) * w.velocity[limit.dof];
    const Num residual = sign * wanted + Num(row.stiffness) * imp * position;
    w.limit_sign[k] = select(beyond, sign, Num(0));
    w.limit_weight[k] = select(beyond, imp * inverse(Num(limit.inverse_weight) * (Num(1) - imp)), Num(0));
    w.limit_residual[k] = select(beyond, residual, Num(0));
  }
}

FUNCTION void find_constraints(Worlds& w) {
  w.slot_count = 0;
  w.contacts = Num(0);
  if constexpr (FILLS) {
    for (int i = 0; i < NV; ++i) {
      w.pattern[i] = 0;
      for (int k = 0; k < NANCESTORS[i]; ++k) w.pattern[i] |= Dofs(1) << ANCESTORS[i][k];
    }
  }
  floor_contacts(w);
  if constexpr (NSEGMENT_PAIRS > 0) pair_contacts(w);
  if constexpr (NBLOCK_PAIRS > 0) block_contacts(w);
  if constexpr (NBOX_PAIRS > 0) box_contacts(w);
  limits(w);
}
