// What touches, and the rows of contacts and limits; see threads.h.
#pragma once
#include "threads_smooth.h"

// boxes.h for a single world.
typedef real Real;
typedef real Num;
typedef bool Mask;
#define FUNCTION DEVICE
DEVICE real select(bool which, real yes, real no) { return which ? yes : no; }
DEVICE bool any(bool truth) { return truth; }
DEVICE bool differ(bool a, bool b) { return a != b; }
DEVICE real size_of(real x) { return absolute(x); }
DEVICE real clip(real x, real low, real high) { return clamped(x, low, high); }
#include "box_pair.h"
#include "boxes.h"

// A lane's contact: its edges are the normal plus or minus each other direction, whose Jacobians are times friction.
struct Contact {
  bool exists;
  int candidate;
  real weight;                // D of an edge
  real residual[DIRECTIONS];  // J a - aref
  real change[DIRECTIONS];    // of it along the step
  Dofs dofs;                  // those that move the two bodies apart
};
constexpr int EDGES = 2 * (DIRECTIONS - 1);  // the most of a contact

// Directions after the normal.
DEVICE int frictions(const Contact& c) { return DIRECTIONS == 3 ? 2 : contact_dims(c.candidate) - 1; }

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

DEVICE Vec world_up(const World& w) { return FREE ? vec_at(w.base + 6) : vec(0, 0, 1); }
DEVICE Vec world_side(const World& w) { return FREE ? vec_at(w.base + 3) : vec(0, 1, 0); }

#if CORNER_POINTS
// Whether a corner that touches is one of the four at most that do, none of them of the upper half (mjc_PlaneBox).
DEVICE bool is_low_corner(const World& w, int point, Vec up, const Mat& R) {
  if (dot(up, mul(R, point_axis(point))) > 0) return false;
  int before = 0;
  for (int k = point - point_corner(point) + 1; k < point; ++k) {
    const Vec place = mul(R, point_centre(k)) + vec_at(w.pose[point_body(k)] + 9);
    const real height = dot(up, place) + (FREE ? w.qpos[2] : real(0)) - point_height(k);
    before += height <= contact_margin(k) && dot(up, mul(R, point_axis(k))) <= 0;
  }
  return before < 4;
}
#endif

// A point over the floor. mjc_PlaneSphere, mjc_PlaneCapsule: a capsule's axis is the first tangent.
DEVICE bool touches_floor(const World& w, int point, Touch& touch) {
  const real* pose = w.pose[point_body(point)];
  const Mat R = mat_at(pose);
  const Vec up = world_up(w), centre = mul(R, point_centre(point)) + vec_at(pose + 9);
  const real height = (FREE ? w.qpos[2] : real(0)) - point_height(point);
  touch.distance = dot(up, centre) + height - point_radius(point);
  if (!(touch.distance <= contact_margin(point))) return false;
#if CORNER_POINTS
  if (point_corner(point) && !is_low_corner(w, point, up, R)) return false;
#endif
  touch.normal = up;
  touch.point = centre - up * (point_radius(point) + real(0.5) * touch.distance);
  touch.tangent = point_round(point) ? world_side(w) : mul(R, point_axis(point));
  return true;
}

#if PAIRS > 0
// Where two segments come nearest: centre + half * x of each, |x| <= 1 (mjraw_CapsuleCapsule, mjraw_SphereCapsule).
struct Nearest {
  bool touches;
  Vec from, to;
};

DEVICE Nearest nearest(Vec a, Vec half_a, real x, Vec b, Vec half_b, real y, real reach) {
  const Vec from = a + half_a * x, to = b + half_b * y, gap = to - from;
  return {dot(gap, gap) <= reach * reach, from, to};
}

// Parallel capsules may touch at both ends of where they lie side by side: the lower along the first, then the upper.
DEVICE Nearest nearest_parallel(Vec a, Vec half_a, Vec b, Vec half_b, const real (&c)[5], real reach, int which) {
  const real aa = c[0], ab = c[1], bb = c[2], u = c[3], v = c[4];
  const real end = (which == 0) == (ab <= 0) ? real(-1) : real(1);  // of the second
  const real along = (u - end * ab) / aa, x = clamped(along, -1, 1);
  const real y = x == along ? end : clamped((v - x * ab) / bb, -1, 1);
  return nearest(a, half_a, x, b, half_b, y, reach);
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
  if (!(det > PARALLEL * aa * bb)) {
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
  EACH_THREAD {
    for (int k = lane; k < SEGMENTS; k += THREADS) {
      const real* pose = w.pose[segment_body(k)];
      const Mat R = mat_at(pose);
      put(w.segment[k], mul(R, segment_centre(k)) + vec_at(pose + 9));
      put(w.segment[k] + 3, mul(R, segment_half(k)));
    }
  }
  MEET();
}

// A block as the base's frame has it: a point of that frame is at axes * point + shift of the block's.
struct BlockFrame {
  Mat axes;
  Vec shift;
};

DEVICE BlockFrame frame_of(const World& w, int block) {
  const int body = block_body(block);
  const Mat own = block_axes(block);
  const Vec offset = block_offset(block);
#if FREE
  if (body < 0) {  // fixed to the world, in which the root is; a place far from the origin keeps its digits
    return {mul(own, mat_at(w.base)), mul(own, vec_at(w.qpos)) - offset};
  }
#endif
  const Mat axes = mul(own, transposed(mat_at(w.pose[body])));
  return {axes, vec(0, 0, 0) - mul(axes, vec_at(w.pose[body] + 9)) - offset};
}

// Pairs of a block and a segment follow those of segments; where all pairs or none are so, the compiler knows. Those of
// two boxes are the last.
constexpr int ONE_BY_ONE = PAIRS - BOX_PAIRS;
DEVICE bool has_block(int pair) { return BLOCK_PAIRS > 0 && (BLOCK_PAIRS == PAIRS || pair >= ONE_BY_ONE - BLOCK_PAIRS); }

DEVICE Vec middle_of(const BlockFrame& in) { return vec(0, 0, 0) - mul_transposed(in.axes, in.shift); }

// Whether two bounding spheres touch, or one and a block.
DEVICE bool is_near(const World& w, int pair) {
  const unsigned parts = pair_segments(pair);
#if BOX_PAIRS > 0
  if (pair >= ONE_BY_ONE) {
    const Vec apart = middle_of(frame_of(w, parts & 65535)) - middle_of(frame_of(w, parts >> 16));
    return dot(apart, apart) <= pair_far(pair);
  }
#endif
  const Vec middle = vec_at(w.segment[parts >> 16]);
  if (!has_block(pair)) {
    const Vec between = vec_at(w.segment[parts & 65535]) - middle;
    return dot(between, between) <= pair_far(pair);
  }
  const BlockFrame in = frame_of(w, parts & 65535);
  real place[3], size[3];
  put(place, mul(in.axes, middle) + in.shift);
  put(size, block_size(parts & 65535));
  return square_outside(place, size) <= pair_far(pair);
}

// Lists the pairs from `first` to before `last` that may touch, and returns how many.
DEVICE int list_near(World& w, int first, int last) {
  int found = 0;
  ROLLED for (int start = first; start < last; start += THREADS) {
    PerLane<bool> near;
    EACH_THREAD {
      near[ME] = start + lane < last && is_near(w, start + lane);
    }
    const unsigned hits = ballot(near);
    EACH_THREAD if (near[ME]) w.near[found + count(hits & ((1u << lane) - 1u))] = short(start + lane);
    found += count(hits);
  }
  MEET();
  return found;
}

// What the first tangent on a normal follows (mju_makeFrame).
DEVICE Vec tangent_wanted(const World& w, Vec normal) {
  const Vec side = world_side(w);
  return absolute(dot(side, normal)) < real(0.5) ? side : world_up(w);
}

// mjraw_SphereSphere at the nearest places. Segments that cross have no normal: MuJoCo takes a product of two axes.
DEVICE bool touches_pair(const World& w, int pair, int which, Touch& touch) {
  const unsigned segments = pair_segments(pair);
  const int first = segments & 65535, second = segments >> 16;
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
  touch.distance = length - radii;
  touch.normal = normal;
  touch.point = found.from + normal * (segment_radius(first) + real(0.5) * touch.distance);
  touch.tangent = tangent_wanted(w, normal);
  return true;
}

// A block and a segment: a contact of each of the segment's spheres.
DEVICE bool touches_block(const World& w, int pair, int which, Touch& touch) {
  const unsigned parts = pair_segments(pair);
  const int segment = parts >> 16;
  const BlockFrame in = frame_of(w, parts & 65535);
  const Vec middle = vec_at(w.segment[segment]), half = vec_at(w.segment[segment] + 3);
  real size[3], out[3], centre[3], axis[3];
  put(size, block_size(parts & 65535));
  put(centre, mul(in.axes, middle) + in.shift);
  put(axis, mul(in.axes, half));
  real share = 0;
  if (dot(half, half) > 0) {
    const Spheres spheres = spheres_on_box(centre, axis, size);
    if (which && !spheres.two) return false;
    share = which ? spheres.second : spheres.first;
  } else if (which) {
    return false;
  }
  for (int k = 0; k < 3; ++k) centre[k] += axis[k] * share;
  touch.distance = sphere_on_box(centre, segment_radius(segment), size, out);
  if (!(touch.distance <= contact_margin(POINTS + pair))) return false;
  touch.normal = mul_transposed(in.axes, vec_at(out));
  touch.point = middle + half * share - touch.normal * (segment_radius(segment) + real(0.5) * touch.distance);
  touch.tangent = tangent_wanted(w, touch.normal);
  return true;
}
#endif

#if OWN_SLOTS
// Contacts in slots: each point has its own, its lane's. Returns how many there are.
DEVICE int collect_contacts(World& w, PerLane<Contact>& contacts, PerLane<Touch>& touch) {
  PerLane<bool> hit;
  EACH_LANE {
    hit[ME] = lane < POINTS && touches_floor(w, lane, touch[ME]);
    contacts[ME].exists = hit[ME];
    contacts[ME].candidate = lane;
  }
  return count(ballot(hit));
}
#else
// Puts what touches into the next free slots, in the order of the lanes. Returns how many there are then.
DEVICE int take(World& w, const PerLane<bool>& hit, const PerLane<int>& candidate, const PerLane<Touch>& touch,
                int found) {
  const unsigned hits = ballot(hit);
  EACH_THREAD {
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
  return found + count(hits);
}

#if BOX_PAIRS > 0
// A lane two boxes.
DEVICE void touch_boxes(const World& w, int pair, Touches& found, BlockFrame& in) {
  const unsigned parts = pair_segments(pair);
  const int one = parts & 65535, two = parts >> 16;
  in = frame_of(w, one);
  const BlockFrame other = frame_of(w, two);
  BoxPair boxes;
  const Vec rows1[3] = {in.axes.x, in.axes.y, in.axes.z}, rows2[3] = {other.axes.x, other.axes.y, other.axes.z};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) boxes.turn[i][j] = dot(rows1[i], rows2[j]);
  }
  put(boxes.apart, mul(in.axes, middle_of(other)) + in.shift);
  put(boxes.size1, block_size(one));
  put(boxes.size2, block_size(two));
  boxes.margin = contact_margin(POINTS + pair);
  touch_boxes(boxes, found);
}

// Puts the contacts of two boxes into the next free slots. Returns how many there are then.
DEVICE int collect_boxes(World& w, PerLane<Touch>& touch, int found) {
  const int near = list_near(w, ONE_BY_ONE, PAIRS);
  ROLLED for (int start = 0; start < near; start += THREADS) {
    PerLane<Touches> touches;
    PerLane<BlockFrame> in;
    PerLane<int> candidate;
    EACH_THREAD {
      touches[ME].count = 0;
      candidate[ME] = POINTS + (start + lane < near ? w.near[start + lane] : 0);
      if (start + lane < near) touch_boxes(w, candidate[ME] - POINTS, touches[ME], in[ME]);
    }
    ROLLED for (int k = 0; k < MOST_TOUCHES; ++k) {
      PerLane<bool> hit = {};
      EACH_THREAD {
        const Touches& all = touches[ME];
        hit[ME] = k < all.count;
        if (hit[ME]) {
          Touch& one = touch[ME];
          one.normal = mul_transposed(in[ME].axes, vec_at(all.normal));
          one.point = mul_transposed(in[ME].axes, vec_at(all.place[k]) - in[ME].shift);
          one.distance = all.distance[k];
          one.tangent = tangent_wanted(w, one.normal);
        }
      }
      if (any(hit)) found = take(w, hit, candidate, touch, found);
    }
  }
  return found;
}
#endif

// Contacts in slots, a lane's each: points, then pairs. Returns how many there are, those without a slot among them.
DEVICE int collect_contacts(World& w, PerLane<Contact>& contacts, PerLane<Touch>& touch) {
  PerLane<bool> hit;
  PerLane<int> candidate;
  int found = 0;
  ROLLED for (int start = 0; start < POINTS; start += THREADS) {
    EACH_THREAD {
      candidate[ME] = start + lane;
      hit[ME] = start + lane < POINTS && touches_floor(w, start + lane, touch[ME]);
    }
    found = take(w, hit, candidate, touch, found);
  }
#if PAIRS > 0
  place_segments(w);
  const int near = list_near(w, 0, ONE_BY_ONE);  // parallel capsules touch twice
  ROLLED for (int start = 0; start < 2 * near; start += THREADS) {
    EACH_THREAD {
      const int item = start + lane, pair = item < 2 * near ? w.near[item >> 1] : 0;
      candidate[ME] = POINTS + pair;
      hit[ME] = item < 2 * near && (has_block(pair) ? touches_block(w, pair, item & 1, touch[ME])
                                                    : touches_pair(w, pair, item & 1, touch[ME]));
    }
    found = take(w, hit, candidate, touch, found);
  }
#endif
#if BOX_PAIRS > 0
  MEET();
  found = collect_boxes(w, touch, found);
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
}
#endif

// A contact's directions: forces, and their moments about the base's origin; of spin and rolling, moments alone.
struct Directions {
  Vec force[3], moment[DIRECTIONS];
};

// A column of a contact's Jacobian: how fast a dof moves the bodies apart along each direction.
DEVICE void put_column(World& w, int slot, int column, const real (&row)[DIRECTIONS], real rate, Contact& contact) {
  real* to = w.J + slot * J_WIDTH + COLUMN * column;
  put_four(to, row[0], row[1], row[2]);
#if DIRECTIONS > 3
  put_four(to + 4, row[3], row[4], row[5]);
#endif
  UNROLLED for (int k = 0; k < DIRECTIONS; ++k) contact.residual[k] += row[k] * rate;
}

// The columns of the dofs that move the contact, in their order.
DEVICE void put_columns(World& w, int slot, const Directions& d, real damping, Contact& contact) {
  int column = 0;
#if FREE
  if (contact.dofs & 1u) {
    UNROLLED for (int k = 0; k < 6; ++k) {
      real row[DIRECTIONS];
      UNROLLED for (int x = 0; x < DIRECTIONS; ++x) {
        const Vec part = k >= 3 ? d.moment[x] : x < 3 ? d.force[x] : vec(0, 0, 0);
        row[x] = k % 3 == 0 ? part.x : k % 3 == 1 ? part.y : part.z;
      }
      put_column(w, slot, k, row, w.acceleration[k] + damping * w.velocity[k], contact);
    }
    column = 6;
  }
#endif
#if PAIRS > 0
  const Dofs opposite = contact_opposite(contact.candidate);
#endif
  for (Dofs dofs = contact.dofs & OUTER_DOFS; dofs; dofs &= dofs - 1) {
    const int dof = lowest(dofs);
    const Vec angular = vec_at(w.axis[dof]), linear = vec_at(w.axis[dof] + 3);
    real row[DIRECTIONS];
    UNROLLED for (int x = 0; x < DIRECTIONS; ++x) {
      row[x] = dot(angular, d.moment[x]);
      if (x < 3) row[x] += dot(linear, d.force[x]);
    }
#if PAIRS > 0
    if (opposite >> dof & 1u) {
      UNROLLED for (int x = 0; x < DIRECTIONS; ++x) row[x] = -row[x];
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
  return count(w.moved[slot] & ((Dofs(1) << dof) - 1));
#endif
}

// The first tangent (mju_makeFrame).
DEVICE Vec first_tangent(const Touch& touch) {
  const Vec t = touch.tangent - touch.normal * dot(touch.normal, touch.tangent);
  return t * inverse_root(dot(t, t) + real(1e-30));
}

// A lane's contact: its Jacobian, its weight (mj_makeImpedance) and its residual J a - aref at the solver's start.
DEVICE void start_contact(World& w, int slot, const Touch& touch, Contact& contact) {
  contact.weight = 0;
  UNROLLED for (int k = 0; k < DIRECTIONS; ++k) contact.residual[k] = contact.change[k] = 0;
  contact.dofs = 0;
  if (!contact.exists) return;
  const int c = contact.candidate;
  const Vec n = touch.normal, r = touch.point, t = first_tangent(touch);
  const Vec first = t * contact_friction(c), second = cross(n, first);
  contact.dofs = contact_dofs(c);
  Directions d = {{n, first, second}, {cross(r, n), cross(r, first), cross(r, second)}};
#if DIRECTIONS > 3
  d.moment[3] = n * contact_spin(c);
  d.moment[4] = t * contact_roll(c);
  d.moment[5] = cross(n, t) * contact_roll(c);
#endif
  put_columns(w, slot, d, contact_damping(c), contact);
  const real violation = touch.distance - contact_margin(c);
  const real impedance = impedance_at(violation, contact_lowest(c), contact_highest(c), contact_inverse_width(c));
  contact.weight = impedance * reciprocal(contact_regularisation(c) * (real(1) - impedance));
  contact.residual[0] += contact_stiffness(c) * impedance * violation;
#if !OWN_SLOTS
  w.moved[slot] = contact.dofs;
#endif
}

// The same of a lane's joint, if it is beyond its range.
DEVICE void start_limit(const World& w, int lane, Limit& limit) {
  limit.weight = limit.residual = limit.sign = limit.change = 0;
#if LIMITS > 0
  if (lane >= LIMITS) return;
  const int dof = limit_dof(lane);
  const real q = w.qpos[limit_qpos(lane)], low = q - limit_low(lane), high = limit_high(lane) - q;
  const real violation = (low < high ? low : high) - limit_margin(lane);
  if (!(violation < 0)) return;
  const real impedance = impedance_at(violation, limit_lowest(lane), limit_highest(lane), limit_inverse_width(lane));
  limit.sign = low < high ? real(1) : real(-1);
  limit.weight = impedance * reciprocal(limit_inverse_weight(lane) * (real(1) - impedance));
  limit.residual = limit.sign * (w.acceleration[dof] + limit_damping(lane) * w.velocity[dof]) +
                   limit_stiffness(lane) * impedance * violation;
#endif
}

// Finds contacts and limits at the solver's start. Returns the slots in use.
DEVICE unsigned find_constraints(World& w, PerLane<Contact>& contacts, PerLane<Limit>& limits, bool& lost) {
  PerLane<Touch> touch;
  PerLane<bool> exists;
  const int found = collect_contacts(w, contacts, touch);
  lost = lost || found > SLOTS;
  EACH_LANE {
    exists[ME] = contacts[ME].exists;
    start_contact(w, lane, touch[ME], contacts[ME]);
    start_limit(w, lane, limits[ME]);
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
