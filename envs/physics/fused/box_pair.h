// Where two boxes touch (engine_collision_box.c, mjc_BoxBox): in which direction they overlap least, and there one
// contact of two edges, or those of a face that is cut to the shape of the face below it. A single pair's numbers, in the
// frame of the first box: few pairs are ever near, and their ways part too much for lanes. Both schedules include it,
// after they have defined Real, FUNCTION and APART.
#pragma once

constexpr int MOST_TOUCHES = 8;  // a face of four corners, cut by four sides
// What rounding leaves: of sums of sizes, of the squared sine between parallel edges, of a direction's entry, and of the
// squared distance between corners, relative to a face.
constexpr Real OF_SIZES = sizeof(Real) == 4 ? Real(1e-6) : Real(1e-13);
constexpr Real OF_EDGES = sizeof(Real) == 4 ? Real(1e-7) : Real(1e-16);
constexpr Real OF_SIGNS = sizeof(Real) == 4 ? Real(1e-5) : Real(1e-9);
constexpr Real OF_CORNERS = sizeof(Real) == 4 ? Real(1e-10) : Real(1e-14);

struct BoxPair {
  Real turn[3][3];  // columns are the second box's axes
  Real apart[3];    // its middle
  Real size1[3], size2[3], margin;
};

struct Touches {
  int count;
  Real normal[3], place[MOST_TOUCHES][3], distance[MOST_TOUCHES];
};

FUNCTION Real magnitude(Real x) { return x < 0 ? -x : x; }
FUNCTION Real limited(Real x, Real most) { return x < -most ? -most : x > most ? most : x; }
FUNCTION Real square_root(Real x) { return sizeof(Real) == 4 ? Real(sqrtf(float(x))) : Real(sqrt(double(x))); }

// The middle of the first box along axis j of the second.
FUNCTION Real apart_along(const BoxPair& p, int j) {
  return -(p.turn[0][j] * p.apart[0] + p.turn[1][j] * p.apart[1] + p.turn[2][j] * p.apart[2]);
}

// Axis i of the first box cross axis j of the second, made a unit; its entry i is 0. False if they are parallel.
FUNCTION bool crossed(const BoxPair& p, int i, int j, Real* axis) {
  const int i1 = (i + 1) % 3, i2 = (i + 2) % 3;
  const Real x = -p.turn[i2][j], y = p.turn[i1][j], square = x * x + y * y;
  if (square < OF_EDGES) return false;
  const Real scale = 1 / square_root(square);
  axis[i] = 0, axis[i1] = x * scale, axis[i2] = y * scale;
  return true;
}

FUNCTION Real along_second(const BoxPair& p, const Real* axis, int j) {
  return axis[0] * p.turn[0][j] + axis[1] * p.turn[1][j] + axis[2] * p.turn[2][j];
}

// How far the boxes are apart along a crossed axis.
FUNCTION Real edges_apart(const BoxPair& p, int i, int j, const Real* axis) {
  const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
  const Real first = p.size1[i1] * magnitude(axis[i1]) + p.size1[i2] * magnitude(axis[i2]);
  const Real second =
      p.size2[j1] * magnitude(along_second(p, axis, j1)) + p.size2[j2] * magnitude(along_second(p, axis, j2));
  return magnitude(axis[i1] * p.apart[i1] + axis[i2] * p.apart[i2]) - first - second;
}

// The face whose normal has the boxes furthest apart: 0 to 2 of the first box, 3 to 5 of the second; -1: they are apart.
FUNCTION int furthest_face(const BoxPair& p, Real most, Real* apart) {
  int face = -1;
  for (int k = 0; k < 6; ++k) {
    const int a = k % 3;
    Real reach = 0;
    for (int x = 0; x < 3; ++x) {
      reach += k < 3 ? magnitude(p.turn[a][x]) * p.size2[x] : magnitude(p.turn[x][a]) * p.size1[x];
    }
    const Real gap = k < 3 ? magnitude(p.apart[a]) - p.size1[a] - reach
                           : magnitude(apart_along(p, a)) - p.size2[a] - reach;
    if (gap > most) return -1;
    if (face < 0 || gap > *apart) *apart = gap, face = k;
  }
  return face;
}

// The direction in which they are furthest apart: a face, or 6 + 3 i + j of edges i and j; -1: they do not touch. A face
// is preferred to edges that are nearly its normal and hardly better.
FUNCTION int furthest_apart(const BoxPair& p, Real most) {
  Real of_face = 0;
  const int face = furthest_face(p, most, &of_face);
  if (face < 0) return -1;
  int found = face;
  Real best = of_face, axis[3];
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      if (!crossed(p, i, j, axis)) continue;
      const Real gap = edges_apart(p, i, j, axis);
      if (gap > most) return -1;
      if (gap - Real(1e-6) * magnitude(gap) > best && gap > of_face) best = gap, found = 6 + 3 * i + j;
    }
  }
  if (found < 6) return found;
  crossed(p, (found - 6) / 3, (found - 6) % 3, axis);
  const Real aligned = magnitude(face < 3 ? axis[face] : along_second(p, axis, face - 3));
  const bool hardly = best < of_face + Real(0.05) * magnitude(of_face) + Real(1e-15);
  return aligned > Real(0.99) && hardly ? face : found;
}

// The nearest places of two edges: the first along axis i through `corner1`, the second along axis j through `corner2`,
// which is in the second's frame. Returns the squared distance.
FUNCTION Real nearest_on_edges(const BoxPair& p, int i, int j, const Real* corner1, const Real* corner2, Real* place1,
                               Real* place2) {
  Real gap[3], along = 0, square = 0;
  for (int x = 0; x < 3; ++x) {
    place1[x] = corner1[x];
    place2[x] = p.apart[x];
    for (int k = 0; k < 3; ++k) place2[x] += p.turn[x][k] * corner2[k];
    gap[x] = place2[x] - place1[x];
    along += p.turn[x][j] * gap[x];
  }
  const Real b = p.turn[i][j], rest = 1 - b * b;
  const Real s = limited(rest < Real(1e-15) ? 0 : (gap[i] - b * along) / rest, p.size1[i]);
  const Real t = limited(b * s - along, p.size2[j]);
  place1[i] += limited(gap[i] + b * t, p.size1[i]);
  for (int x = 0; x < 3; ++x) {
    place2[x] += t * p.turn[x][j];
    square += (place2[x] - place1[x]) * (place2[x] - place1[x]);
  }
  return square;
}

// A contact of two edges. Where an entry of the direction is nothing, either of two edges of a box may be the one.
FUNCTION void touch_edges(const BoxPair& p, int i, int j, Real most, Touches& found) {
  const int on1[2] = {(i + 1) % 3, (i + 2) % 3}, on2[2] = {(j + 1) % 3, (j + 2) % 3};
  Real axis[3], second[3], corner1[3], corner2[3], from[3] = {0, 0, 0}, to[3] = {0, 0, 0}, best = Real(1e10);
  crossed(p, i, j, axis);
  const bool back = axis[0] * p.apart[0] + axis[1] * p.apart[1] + axis[2] * p.apart[2] < 0;
  for (int x = 0; x < 3; ++x) axis[x] = back ? -axis[x] : axis[x];
  for (int x = 0; x < 3; ++x) second[x] = along_second(p, axis, x);
  int either1 = -1, either2 = -1;
  for (int k = 1; k >= 0; --k) {
    if (magnitude(axis[on1[k]]) < OF_SIGNS) either1 = on1[k];
    if (magnitude(second[on2[k]]) < OF_SIGNS) either2 = on2[k];
  }
  for (int way = 0; way < 4; ++way) {
    if ((way & 2 && either1 < 0) || (way & 1 && either2 < 0)) continue;
    corner1[i] = corner2[j] = 0;
    for (int k = 0; k < 2; ++k) {
      corner1[on1[k]] = axis[on1[k]] >= 0 ? p.size1[on1[k]] : -p.size1[on1[k]];
      corner2[on2[k]] = second[on2[k]] >= 0 ? -p.size2[on2[k]] : p.size2[on2[k]];
    }
    if (way & 2) corner1[either1] = -corner1[either1];
    if (way & 1) corner2[either2] = -corner2[either2];
    Real place1[3], place2[3];
    const Real square = nearest_on_edges(p, i, j, corner1, corner2, place1, place2);
    if (!(square < best)) continue;
    best = square;
    for (int x = 0; x < 3; ++x) from[x] = place1[x], to[x] = place2[x];
  }
  Real distance = 0;
  for (int x = 0; x < 3; ++x) {
    distance += (to[x] - from[x]) * axis[x];
    found.normal[x] = axis[x];
    found.place[0][x] = Real(.5) * (from[x] + to[x]);
  }
  found.distance[0] = distance;
  found.count = distance <= most ? 1 : 0;
}

// Cuts a polygon at sign * entry `on` <= limit (Sutherland and Hodgman). Returns its corners.
FUNCTION int cut(Real (*corners)[3], int count, int on, Real sign, Real limit) {
  Real in[MOST_TOUCHES][3], beyond[MOST_TOUCHES];
  for (int k = 0; k < count; ++k) {
    beyond[k] = sign * corners[k][on] - limit;
    for (int x = 0; x < 3; ++x) in[k][x] = corners[k][x];
  }
  int kept = 0;
  for (int k = 0; k < count; ++k) {
    const int next = k + 1 == count ? 0 : k + 1;
    if (beyond[k] <= 0 && kept < MOST_TOUCHES) {
      for (int x = 0; x < 3; ++x) corners[kept][x] = in[k][x];
      ++kept;
    }
    const bool crosses = (beyond[k] < 0 && beyond[next] > 0) || (beyond[k] > 0 && beyond[next] < 0);
    if (crosses && kept < MOST_TOUCHES) {
      const Real share = beyond[k] / (beyond[k] - beyond[next]);
      for (int x = 0; x < 3; ++x) corners[kept][x] = in[k][x] + share * (in[next][x] - in[k][x]);
      ++kept;
    }
  }
  return kept;
}

// A face, of either box, and the other box's face that is most opposed to it: its middle and half edges as entries along
// the two sides of the first face, and height over it.
struct Faces {
  bool first;         // the face is the first box's
  int a, x, y;        // its axis, and those of its sides
  Real sign;          // the side of its box that it is on
  Real size[3];       // its box's
  Real corners[MOST_TOUCHES][3];
};

FUNCTION Real entry(const BoxPair& p, const Faces& f, int row, int column) {  // of the other's axes in the face's box
  return f.first ? p.turn[row][column] : p.turn[column][row];
}

FUNCTION void meet_face(const BoxPair& p, int face, Faces& f) {
  f.first = face < 3, f.a = face % 3, f.x = (f.a + 1) % 3, f.y = (f.a + 2) % 3;
  Real middle[3], other[3];
  for (int k = 0; k < 3; ++k) {
    f.size[k] = f.first ? p.size1[k] : p.size2[k];
    other[k] = f.first ? p.size2[k] : p.size1[k];
    middle[k] = f.first ? p.apart[k] : apart_along(p, k);
  }
  f.sign = middle[f.a] >= 0 ? Real(1) : Real(-1);
  int opposed = 0;
  for (int k = 1; k < 3; ++k) {
    if (magnitude(entry(p, f, f.a, k)) > magnitude(entry(p, f, f.a, opposed))) opposed = k;
  }
  const Real side = f.sign * entry(p, f, f.a, opposed) > 0 ? Real(-1) : Real(1);
  const int u = (opposed + 1) % 3, v = (opposed + 2) % 3, rows[3] = {f.x, f.y, f.a};
  for (int k = 0; k < 4; ++k) {  // around the face
    const Real along_u = k == 0 || k == 3 ? other[u] : -other[u], along_v = k < 2 ? other[v] : -other[v];
    for (int r = 0; r < 3; ++r) {
      const int row = rows[r];
      const Real at = middle[row] + side * other[opposed] * entry(p, f, row, opposed) + along_u * entry(p, f, row, u) +
                      along_v * entry(p, f, row, v);
      f.corners[k][r] = r == 2 ? f.sign * at - f.size[f.a] : at;
    }
  }
}

// Contacts of a face with what lies over it: corners within the margin, but for those that are one but for rounding.
FUNCTION void touch_face(const BoxPair& p, int face, Touches& found) {
  Faces f;
  meet_face(p, face, f);
  int count = 4;
  for (int k = 0; k < 4; ++k) count = cut(f.corners, count, k / 2, k % 2 ? Real(-1) : Real(1), f.size[k / 2 ? f.y : f.x]);
  const Real same = OF_CORNERS * (f.size[f.x] * f.size[f.x] + f.size[f.y] * f.size[f.y]);
  int kept = 0;
  for (int k = 0; k < count; ++k) {
    bool fresh = f.corners[k][2] <= p.margin;
    for (int q = 0; q < kept; ++q) {
      const Real x = f.corners[q][0] - f.corners[k][0], y = f.corners[q][1] - f.corners[k][1];
      fresh = fresh && !(x * x + y * y < same);
    }
    if (!fresh) continue;
    for (int x = 0; x < 3; ++x) f.corners[kept][x] = f.corners[k][x];
    ++kept;
  }
  found.count = kept;
  for (int x = 0; x < 3; ++x) {
    found.normal[x] = f.first ? (x == f.a ? f.sign : 0) : -f.sign * p.turn[x][f.a];
  }
  for (int k = 0; k < kept; ++k) {
    Real local[3];
    local[f.x] = f.corners[k][0], local[f.y] = f.corners[k][1];
    local[f.a] = f.sign * (f.size[f.a] + Real(.5) * f.corners[k][2]);
    found.distance[k] = f.corners[k][2];
    for (int x = 0; x < 3; ++x) {
      found.place[k][x] =
          f.first ? local[x] : p.apart[x] + p.turn[x][0] * local[0] + p.turn[x][1] * local[1] + p.turn[x][2] * local[2];
    }
  }
}

APART void touch_boxes(const BoxPair& p, Touches& found) {
  Real sizes = 0;
  for (int k = 0; k < 3; ++k) sizes += p.size1[k] + p.size2[k];
  const Real most = p.margin + OF_SIZES * sizes;
  const int direction = furthest_apart(p, most);
  found.count = 0;
  if (direction >= 6) touch_edges(p, (direction - 6) / 3, (direction - 6) % 3, most, found);
  else if (direction >= 0) touch_face(p, direction, found);
}
