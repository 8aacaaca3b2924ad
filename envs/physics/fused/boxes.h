// Where spheres and capsules touch a box (mjraw_SphereBox, mjraw_CapsuleBox). Both schedules include it, after they have
// defined Real, Num, Mask and FUNCTION, and select, any, differ, clip, size_of and root of them.
//
// All is in the box's frame, in which its corners are at +- size. A point of a capsule's axis is middle + share * half,
// |share| <= 1. MuJoCo takes a capsule for two spheres at most: one where its axis is nearest to the box, and one further
// along the axis, if the axis goes on over the box from there.
#pragma once

// Squares in m2 that MuJoCo takes for nothing (mjMINVAL), what rounding leaves of a distance in m, and more than any has.
constexpr Real LEAST = Real(1e-15), ON_SURFACE = sizeof(Real) == 4 ? Real(2e-6) : Real(1e-15), FURTHEST = Real(1e30);

struct Spheres {
  Num first, second;  // shares of the half axis
  Mask two;
};

// Where an axis is nearest to a box.
struct NearestOnBox {
  Num square, share;  // of the distance
  Mask face, corner;  // an end of the axis is over a face or inside, or a corner is nearest; else the inside of an edge
  Mask axis[3];       // the face's normal (none inside), or the edge's direction
  Num sign[3];        // the side of the box that a corner or edge is on; of the edge's direction: where its end is
  Num along;          // place on the edge
};

FUNCTION Num square_outside(const Num* point, const Real* size) {
  Num square = Num(0);
  for (int k = 0; k < 3; ++k) {
    const Num outside = size_of(point[k]) - Num(size[k]);
    square += select(outside > Num(0), outside * outside, Num(0));
  }
  return square;
}

// Ends of the axis that are over a face or inside; the lower first.
FUNCTION void try_end(const Num* middle, const Num* half, const Real* size, Num end, NearestOnBox& nearest) {
  Num tip[3], beyond = Num(0);
  Mask out[3];
  for (int k = 0; k < 3; ++k) {
    tip[k] = middle[k] + half[k] * end;
    out[k] = size_of(tip[k]) > Num(size[k]);
    beyond += select(out[k], Num(1), Num(0));
  }
  const Num square = square_outside(tip, size);
  const Mask nearer = (beyond < Num(2)) & (square < nearest.square);
  nearest.square = select(nearer, square, nearest.square);
  nearest.share = select(nearer, end, nearest.share);
  nearest.face = nearest.face | nearer;
  for (int k = 0; k < 3; ++k) nearest.axis[k] = (nearer & out[k]) | (!nearer & nearest.axis[k]);
}

// An edge along axis `j`; `sign` of its sides, whose entry j does not count.
FUNCTION void try_edge(const Num* middle, const Num* half, const Real* size, int j, const Real* sign,
                       NearestOnBox& nearest) {
  const int a = (j + 1) % 3, b = (j + 2) % 3;
  const Num whole = Num(size[j]), one = Num(1);
  const Num apart_a = Num(sign[a] * size[a]) - middle[a], apart_b = Num(sign[b] * size[b]) - middle[b];
  const Num across = half[a] * half[a] + half[b] * half[b];  // 0 of an axis along the edge
  const Mask turned = across * Num(size[j] * size[j]) > Num(LEAST);
  const Num toward = apart_a * half[a] + apart_b * half[b];
  Num share = toward / select(turned, across, one), along = middle[j] + half[j] * share;
  // Beyond an end of the edge: from there to the axis. Then, beyond an end of the axis: from there to the edge.
  Mask high = along > whole, low = along < -whole;
  const Num end = clip(along, -whole, whole);
  share = select(high | low, (toward + (end - middle[j]) * half[j]) / (across + half[j] * half[j]), share);
  const Mask clipped = size_of(share) > one;
  share = clip(share, -one, one);
  const Num beside = middle[j] + half[j] * share;
  const Mask above = clipped & (beside > whole), below = clipped & (beside < -whole);
  along = select(clipped, clip(beside, -whole, whole), end);
  high = (high & !below) | above;  // as MuJoCo has it, who still takes an end for nearest where it no longer is
  low = (low & !above) | below;
  const Num x = apart_a - half[a] * share, y = apart_b - half[b] * share, z = along - beside;
  const Num square = x * x + y * y + z * z;
  const Mask nearer = turned & (square < nearest.square - Num(LEAST));
  nearest.square = select(nearer, square, nearest.square);
  nearest.share = select(nearer, share, nearest.share);
  nearest.along = select(nearer, along, nearest.along);
  nearest.face = nearest.face & !nearer;
  nearest.corner = (nearer & (high | low)) | (!nearer & nearest.corner);
  nearest.axis[j] = nearest.axis[j] | nearer;
  nearest.axis[a] = nearest.axis[a] & !nearer;
  nearest.axis[b] = nearest.axis[b] & !nearer;
  nearest.sign[j] = select(nearer, select(high, one, -one), nearest.sign[j]);
  nearest.sign[a] = select(nearer, Num(sign[a]), nearest.sign[a]);
  nearest.sign[b] = select(nearer, Num(sign[b]), nearest.sign[b]);
}

FUNCTION Num smaller(Num a, Num b) { return select(a < b, a, b); }

// How far the axis goes on over the box, as a share with its direction: from an end over a face, to where it leaves the
// face's edges.
FUNCTION Num onward_from_face(const Num* middle, const Num* half, const Real* size, const NearestOnBox& nearest) {
  const Num direction = select(nearest.share < Num(0), Num(1), Num(-1));
  Num length = Num(2);
  for (int k = 0; k < 3; ++k) {
    const Num tip = middle[k] - half[k] * direction;
    for (int side = 1; side >= -1; side -= 2) {
      const Num leaves = (Num(side * size[k]) - tip) * direction / half[k];  // an axis along the edge never does
      length = select(!nearest.axis[k] & (leaves > Num(0)) & (leaves < length), leaves, length);
    }
  }
  return length * direction;
}

// From a corner: `inward` are the directions in which the axis goes over the box.
FUNCTION Num onward_from_corner(const Num* half, const Real* size, const NearestOnBox& nearest, const Mask* inward,
                                Mask one_inward) {
  const Num direction = select(one_inward, Num(1), Num(-1));
  Num whole = Num(0), own = Num(0), edge = Num(0), face = Num(FURTHEST);
  for (int k = 0; k < 3; ++k) {
    const Mask alone = !differ(inward[k], one_inward);  // of the three directions the one that is unlike the others
    const Num square = half[k] * half[k], room = Num(2 * size[k]) / size_of(half[k]);
    whole += square;
    own = select(alone, square, own);
    edge = select(alone, room, edge);
    face = select(alone, face, smaller(face, room));
  }
  const Num along_edge = smaller(Num(1) - direction * nearest.share, edge);
  const Num over_face = -smaller(Num(1) + direction * nearest.share, face);
  return direction * select(own > Num(Real(.5)) * whole, along_edge, over_face);
}

// From the inside of the edge along axis j, over the face that it makes the smaller angle with. `crosses`: if it does.
FUNCTION Num onward_from_edge(const Num* half, const Real* size, const NearestOnBox& nearest, const Mask* inward, int j,
                              Mask* crosses) {
  const int a = (j + 1) % 3, b = (j + 2) % 3;
  *crosses = differ(inward[a], inward[b]);
  const Mask first = size_of(half[a]) > size_of(half[b]);
  const Mask forward = (first & inward[a]) | (!first & inward[b]);
  const Num direction = select(forward, Num(1), Num(-1));
  const Num room = select(first, Num(2 * size[a]) / size_of(half[a]), Num(2 * size[b]) / size_of(half[b]));
  const Mask rises = !differ(half[j] > Num(0), forward);
  const Num left = Num(size[j]) + select(rises, -nearest.along, nearest.along);
  const Num length = smaller(Num(1) - direction * nearest.share, room);
  return direction * smaller(length, left / size_of(half[j]));
}

FUNCTION Spheres spheres_on_box(const Num* middle, const Num* half, const Real* size) {
  const Mask never = size_of(middle[0]) < Num(0);
  NearestOnBox nearest = {Num(FURTHEST), Num(0), never, never, {never, never, never}, {Num(1), Num(1), Num(1)}, Num(0)};
  try_end(middle, half, size, Num(-1), nearest);
  try_end(middle, half, size, Num(1), nearest);
  for (int corner = 0; corner < 8; ++corner) {
    const Real sign[3] = {Real(corner & 1 ? 1 : -1), Real(corner & 2 ? 1 : -1), Real(corner & 4 ? 1 : -1)};
    for (int j = 0; j < 3; ++j) {
      if (!(corner >> j & 1)) try_edge(middle, half, size, j, sign, nearest);
    }
  }
  Mask inward[3];
  Num count = Num(0);
  for (int k = 0; k < 3; ++k) {
    inward[k] = differ(half[k] > Num(0), nearest.sign[k] > Num(0));
    count += select(inward[k], Num(1), Num(0));
  }
  const Mask mixed = (count > Num(0)) & (count < Num(3));
  const Mask on_edge = !nearest.face & !nearest.corner;
  Num onward = select(nearest.face, onward_from_face(middle, half, size, nearest),
                      onward_from_corner(half, size, nearest, inward, count < Num(2)));
  Mask two = (nearest.face & (nearest.axis[0] | nearest.axis[1] | nearest.axis[2])) | (nearest.corner & mixed);
  for (int j = 0; j < 3; ++j) {
    Mask crosses;
    const Num along = onward_from_edge(half, size, nearest, inward, j, &crosses);
    onward = select(on_edge & nearest.axis[j], along, onward);
    two = two | (on_edge & nearest.axis[j] & crosses);
  }
  return {nearest.share, nearest.share + onward, two};
}

// The distance of a sphere from the box, and the normal out of the box. From a centre inside it is the nearest face's.
FUNCTION Num sphere_on_box(const Num* centre, Num radius, const Real* size, Num* normal) {
  Num gap[3], square = Num(0);
  for (int k = 0; k < 3; ++k) {
    gap[k] = centre[k] - clip(centre[k], Num(-size[k]), Num(size[k]));
    square += gap[k] * gap[k];
  }
  const Num length = root(square);
  const Mask inside = length <= Num(ON_SURFACE);
  const Num scale = Num(1) / select(inside, Num(1), length);
  for (int k = 0; k < 3; ++k) normal[k] = gap[k] * scale;
  if (!any(inside)) return length - radius;
  Num depth = Num(FURTHEST), out[3] = {Num(0), Num(0), Num(0)};
  for (int k = 0; k < 3; ++k) {
    for (int side = -1; side <= 1; side += 2) {
      const Num below = size_of(Num(side * size[k]) - centre[k]);
      const Mask nearer = below < depth;
      depth = select(nearer, below, depth);
      for (int x = 0; x < 3; ++x) out[x] = select(nearer, Num(x == k ? side : 0), out[x]);
    }
  }
  for (int k = 0; k < 3; ++k) normal[k] = select(inside, out[k], normal[k]);
  return select(inside, -depth, length) - radius;
}
