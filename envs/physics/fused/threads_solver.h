// Newton's method on Gauss' cost; see threads.h.
#pragma once
#include "threads_contacts.h"

constexpr int LINE_SEARCH_STEPS = 12;
constexpr real IMPROVEMENT = sizeof(real) == 4 ? real(1e-9) : real(1e-12);  // as in lanes_solver.h

// M x of a lane's dof.
DEVICE real times_inertia(const World& w, const real* x, int dof) {
  const int first = first_column(dof);
  real y = 0;
  UNROLLED for (int j = 0; j < M_COLUMNS; j += 4) {
    const Four a = four_at(w.M + dof * M_WIDTH + j), b = four_at(x + first + j);
    y += a.x * b.x;
    if (first + j + 1 < NV) y += a.y * b.y;
    if (first + j + 2 < NV) y += a.z * b.z;
    if (first + j + 3 < NV) y += a.w * b.w;
  }
  return y;
}

// An entry of a branch's dof i: H[i][j] -= sum over k below i of H[k][i] H[k][j] / pivot k.
DEVICE void eliminate_entry(World& w, unsigned entry, int below, bool first_round) {
  const int i = entry & 255, j = entry >> 8 & 255;
  real pivot = w.H[i * WIDTH + i], value = w.H[i * WIDTH + j];
  const real* upper = w.H + i * WIDTH + i;
  const real* lower = w.H + i * WIDTH;
  for (int t = 1; t <= below; ++t) {
    lower += WIDTH;
    pivot -= upper[t] * lower[i];
    value -= upper[t] * lower[j];
  }
  const real inverse = reciprocal(pivot);
  if (entry >> 16) w.inverse[i] = inverse;
  if (!first_round) w.H[i * WIDTH + j] = value;
  if (j < NV) w.H[j * WIDTH + i] = value * inverse;
}

// Branches, from the leaves: each entry once.
DEVICE void eliminate_branches(World& w) {
  if constexpr (ROUNDS <= MOST_UNROLLED) {
    repeat<0, ROUNDS>([&](auto turn) {
      constexpr int round = turn;
      EACH_THREAD {
        UNROLLED for (int e = lane; e < ROUND_SIZE[round]; e += THREADS) {
          const unsigned entry = round_entry(ROUND_START[round] + e);
          eliminate_entry(w, entry, ROUND_EVEN[round] ? ROUND_BELOW[round] : dof_below(entry & 255), round == 0);
        }
      }
      MEET();
    });
  } else {
    ROLLED for (int round = 0; round < ROUNDS; ++round) {
      EACH_THREAD {
        ROLLED for (int e = round_start(round) + lane; e < round_start(round + 1); e += THREADS) {
          const unsigned entry = round_entry(e);
          eliminate_entry(w, entry, dof_below(entry & 255), round == 0);
        }
      }
      MEET();
    }
  }
}

// What branches leave of the trunk's triangle and right side.
DEVICE void pack_trunk(World& w) {
  EACH_THREAD {
    UNROLLED for (int e = lane; e < PACKED; e += THREADS) {
      const unsigned entry = trunk_entry(e);
      const int i = entry & 255, j = entry >> 8 & 255;
      real value = w.H[i * WIDTH + j];
      UNROLLED for (int k = TRUNK; k < NV; ++k) value -= w.H[i * WIDTH + k] * w.H[k * WIDTH + j];
      w.packed[e] = value;
    }
  }
  MEET();
}

DEVICE void load_packed(const World& w, real (&to)[PACKED + 4]) {
  UNROLLED for (int k = 0; k < PACKED; k += 4) {
    const Four four = four_at(w.packed + k);
    to[k] = four.x;
    to[k + 1] = four.y;
    to[k + 2] = four.z;
    to[k + 3] = four.w;
  }
}

// All of the trunk by L D L', in every lane the same.
DEVICE void solve_trunk(const World& w, real (&x)[TRUNK + 1]) {
  real A[PACKED + 4];
  load_packed(w, A);
  real* y = A + TRUNK * (TRUNK + 1) / 2;
  real inverse[TRUNK + 1];
  repeat<0, TRUNK>([&](auto column) {
    constexpr int j = column;
    inverse[j] = reciprocal(A[j * (j + 1) / 2 + j]);
    repeat<j + 1, TRUNK>([&](auto row) {
      constexpr int i = row;
      const real l = A[i * (i + 1) / 2 + j] * inverse[j];
      repeat<j + 1, i + 1>([&](auto k) { A[i * (i + 1) / 2 + k] -= l * A[k * (k + 1) / 2 + j]; });
      y[i] -= l * y[j];
    });
  });
  repeat<0, TRUNK>([&](auto number) {
    constexpr int i = TRUNK - 1 - number;
    real z = y[i];
    repeat<i + 1, TRUNK>([&](auto k) { z -= A[k * (k + 1) / 2 + i] * x[k]; });
    x[i] = z * inverse[i];
  });
}

// x = inverse(H) y along the tree, y the last column of H; x of a dof in its lane. H has M's pattern.
DEVICE void solve_tree(World& w, PerLane<real>& x) {
  eliminate_branches(w);
  if constexpr (TRUNK > 0) pack_trunk(w);
  EACH_LANE {
    real trunk[TRUNK + 1];
    if constexpr (TRUNK > 0) solve_trunk(w, trunk);
    real value = 0;
    repeat<0, TRUNK>([&](auto k) { value = lane == k ? trunk[k] : value; });
    if (lane >= TRUNK && lane < NV) {
      value = w.H[lane * WIDTH + NV] * w.inverse[lane];
      repeat<0, TRUNK>([&](auto k) { value -= w.H[k * WIDTH + lane] * trunk[k]; });
    }
    x[ME] = value;
  }
  ROLLED for (int level = 0; level < BRANCH_LEVELS - 1; ++level) {
    PerLane<int> source;
    EACH_LANE source[ME] = lane < NV ? dof_on_branch(level * NV + lane) : lane;
    const PerLane<real> above = gathered(x, source);
    EACH_LANE if (source[ME] != lane) x[ME] -= w.H[source[ME] * WIDTH + lane] * above[ME];
  }
}

#if FILLS
// The same where a contact between two branches fills H: L D L' from the last dof. Leaves zeros where M has them.
DEVICE void solve_full(World& w, PerLane<real>& x) {
  ROLLED for (int k = NV - 1; k >= 0; --k) {
    const real inverse = reciprocal(w.H[k * WIDTH + k]);
    const real* row = w.H + k * WIDTH;
    EACH_THREAD {
      ROLLED for (int e = lane; e < k * (k + 1) / 2; e += THREADS) {
        const unsigned entry = full_entry(e);
        const int i = entry & 255, j = entry >> 8;
        w.H[i * WIDTH + j] -= row[i] * inverse * row[j];
      }
    }
    EACH_LANE {
      if (lane < k) w.H[lane * WIDTH + NV] -= row[lane] * inverse * row[NV];
      if (lane == k) w.inverse[k] = inverse;
    }
    MEET();
  }
  EACH_LANE x[ME] = lane < NV ? w.H[lane * WIDTH + NV] * w.inverse[lane] : real(0);
  ROLLED for (int k = 0; k < NV - 1; ++k) {
    PerLane<int> source;
    EACH_LANE source[ME] = k;
    const PerLane<real> above = gathered(x, source);
    EACH_LANE if (lane > k && lane < NV) x[ME] -= w.H[lane * WIDTH + k] * w.inverse[lane] * above[ME];
  }
  MEET();
  EACH_THREAD {
    ROLLED for (int e = lane; e < FILL_ENTRIES; e += THREADS) {
      const unsigned entry = fill_entry(e);
      w.H[(entry & 255) * WIDTH + (entry >> 8)] = 0;
    }
  }
}
#endif

// The edges whose residual is negative, a bit each.
DEVICE unsigned pushing_edges(const real (&residual)[DIRECTIONS], int frictions) {
  unsigned bits = 0;
  UNROLLED for (int k = 1; k < DIRECTIONS; ++k) {
    if (k > frictions) break;
    bits |= unsigned(residual[0] + residual[k] < 0) << (2 * k - 2) | unsigned(residual[0] - residual[k] < 0) << (2 * k - 1);
  }
  return bits;
}

// Weights and forces of the edges that push, between the contact's directions; see World.
DEVICE void put_weights(real* to, const Contact& c, unsigned bits) {
  real whole = 0, force[DIRECTIONS] = {0}, mixed[DIRECTIONS] = {0}, own[DIRECTIONS] = {0};
  UNROLLED for (int k = 1; k < DIRECTIONS; ++k) {
    const real first = bits >> (2 * k - 2) & 1u ? c.weight : real(0);
    const real second = bits >> (2 * k - 1) & 1u ? c.weight : real(0);
    const real up = -first * (c.residual[0] + c.residual[k]), down = -second * (c.residual[0] - c.residual[k]);
    whole += first + second;
    mixed[k] = first - second;
    own[k] = first + second;
    force[0] += up + down;
    force[k] = up - down;
  }
  put_four(to, whole, mixed[1], mixed[2]);
  put_four(to + 4, own[1], own[2], 0);
  put_four(to + 8, force[0], force[1], force[2]);
#if DIRECTIONS > 3
  put_four(to + 12, mixed[3], mixed[4], mixed[5]);
  put_four(to + 16, own[3], own[4], own[5]);
  put_four(to + 20, force[3], force[4], force[5]);
#endif
}

// Which edges and limits push; their weights and forces for the lanes that sum them. Returns the contacts that push.
DEVICE unsigned find_active(World& w, PerLane<Contact>& contacts, PerLane<Limit>& limits, PerLane<unsigned>& active) {
  PerLane<bool> pushes;
  EACH_LANE {
    const Contact& c = contacts[ME];
    unsigned bits = 0;
    if (c.exists) {
      bits = pushing_edges(c.residual, frictions(c));
      if (bits) put_weights(w.D + lane * D_WIDTH, c, bits);
    }
    pushes[ME] = bits != 0;
#if LIMITS > 0
    if (lane < LIMITS) {
      const Limit& l = limits[ME];
      const bool on = l.residual < 0;
      const int dof = limit_dof(lane);
      bits |= unsigned(on) << EDGES;
      w.limit_weight[dof] = on ? l.weight : real(0);
      w.limit_force[dof] = on ? -l.weight * l.residual * l.sign : real(0);
    }
#endif
    active[ME] = bits;
  }
  const unsigned pushing = ballot(pushes);
  MEET();
  return pushing;
}

// The contacts that move with a dof.
DEVICE unsigned touching(const World& w, int dof) {
#if OWN_SLOTS
  return dof_slots(dof);
#else
  return w.touching[dof];
#endif
}

DEVICE int candidate_of(const World& w, int slot) {
#if OWN_SLOTS
  return slot;
#else
  return w.candidate[slot];
#endif
}

// J' D J of an entry, over the contacts that push and move with both dofs. Columns: of slots that are a point's own.
DEVICE real contact_entry(const World& w, int i, int j, int column_i, int column_j, unsigned slots) {
  real y = 0;
  for (; slots; slots &= slots - 1) {
    const int slot = lowest(slots);
    const real* J = w.J + slot * J_WIDTH;
    const real* A = J + COLUMN * (OWN_SLOTS ? column_i : column_of(w, slot, i));
    const real* B = J + COLUMN * (OWN_SLOTS ? column_j : column_of(w, slot, j));
    const real* D = w.D + slot * D_WIDTH;
    const Four a = four_at(A), b = four_at(B), n = four_at(D), t = four_at(D + 4);
    y += a.x * (n.x * b.x + n.y * b.y + n.z * b.z) + a.y * (n.y * b.x + t.x * b.y) + a.z * (n.z * b.x + t.y * b.z);
#if DIRECTIONS > 3
    const Four c = four_at(A + 4), d = four_at(B + 4), m = four_at(D + 12), o = four_at(D + 16);
    y += a.x * (m.x * d.x + m.y * d.y + m.z * d.z) + c.x * (m.x * b.x + o.x * d.x) + c.y * (m.y * b.x + o.y * d.y) +
         c.z * (m.z * b.x + o.z * d.z);
#endif
  }
  return y;
}

// The gradient M a - smooth - J' f, also the right side of H = M + J' D J.
DEVICE void assemble(World& w, unsigned pushing, bool full, const PerLane<real>& excess, PerLane<real>& gradient) {
  EACH_LANE {
    gradient[ME] = 0;
    if (lane < NV) {
      real y = excess[ME] - w.limit_force[lane];
      for (unsigned slots = pushing & touching(w, lane); slots; slots &= slots - 1) {
        const int slot = lowest(slots);
        const real* column = w.J + slot * J_WIDTH + COLUMN * column_of(w, slot, lane);
        const Four J = four_at(column), f = four_at(w.D + slot * D_WIDTH + 8);
        y -= J.x * f.x + J.y * f.y + J.z * f.z;
#if DIRECTIONS > 3
        const Four K = four_at(column + 4), g = four_at(w.D + slot * D_WIDTH + 20);
        y -= K.x * g.x + K.y * g.y + K.z * g.z;
#endif
      }
      gradient[ME] = y;
      w.H[lane * WIDTH + NV] = y;
    }
  }
  EACH_THREAD {
    UNROLLED for (int e = lane; e < ENTRIES; e += THREADS) {
      const unsigned entry = hessian_entry(e);
      const int i = entry & 255, j = entry >> 8 & 255;
      real y = w.M[at_M(i, j)];
      if (pushing) {
        const unsigned slots = pushing & (OWN_SLOTS ? entry_slots(e) : touching(w, i) & touching(w, j));
        y += contact_entry(w, i, j, entry >> 16 & 255, entry >> 24, slots);
      }
      if (i == j) y += w.limit_weight[i];
      w.H[i * WIDTH + j] = y;
    }
#if FILLS
    if (full) {
      ROLLED for (int e = lane; e < FILL_ENTRIES; e += THREADS) {
        const unsigned entry = fill_entry(e);
        const int i = entry & 255, j = entry >> 8 & 255;
        w.H[i * WIDTH + j] = contact_entry(w, i, j, 0, 0, pushing & touching(w, i) & touching(w, j));
      }
    }
#endif
  }
  MEET();
}

// Changes of the residuals along the step, and whether its full length changes which edges and limits push.
DEVICE bool find_changes(World& w, PerLane<Contact>& contacts, PerLane<Limit>& limits,
                         const PerLane<unsigned>& active) {
  PerLane<bool> differs;
  EACH_LANE {
    Contact& c = contacts[ME];
    unsigned bits = 0;
    if (c.exists) {
      real after[DIRECTIONS] = {0};
      const real* J = w.J + lane * J_WIDTH;
      const auto add = [&](int dof) {
        const Four column = four_at(J);
        const real step = w.step[dof];
        after[0] += column.x * step;
        after[1] += column.y * step;
        after[2] += column.z * step;
#if DIRECTIONS > 3
        const Four more = four_at(J + 4);
        after[3] += more.x * step;
        after[4] += more.y * step;
        after[5] += more.z * step;
#endif
        J += COLUMN;
      };
#if FREE
      if (c.dofs & 1u) {
        UNROLLED for (int k = 0; k < 6; ++k) add(k);
      }
#endif
      for (Dofs dofs = c.dofs & OUTER_DOFS; dofs; dofs &= dofs - 1) add(lowest(dofs));
      UNROLLED for (int k = 0; k < DIRECTIONS; ++k) {
        c.change[k] = after[k];
        after[k] += c.residual[k];
      }
      bits = pushing_edges(after, frictions(c));
    }
#if LIMITS > 0
    if (lane < LIMITS) {
      Limit& l = limits[ME];
      l.change = l.sign * w.step[limit_dof(lane)];
      bits |= unsigned(l.residual + l.change < 0) << EDGES;
    }
#endif
    differs[ME] = bits != active[ME];
  }
  return any(differs);
}

// A row's part of the cost's first and second derivative along the step, at a length of it.
DEVICE void add_row(real residual, real change, real weight, real& first, real& second) {
  if (residual < 0) {
    first += weight * residual * change;
    second += weight * change * change;
  }
}

// The length of the step where the cost's slope is a tenth of that at 0: Newton's method between bounds.
DEVICE real search_line(const PerLane<Contact>& contacts, const PerLane<Limit>& limits, real linear, real quadratic,
                        real slope) {
  real length = 1, below = 0, above = -1;
  ROLLED for (int k = 0; k < LINE_SEARCH_STEPS; ++k) {
    PerLane<real> first, second;
    EACH_LANE {
      real a = 0, b = 0;
      const Contact& c = contacts[ME];
      const real n = c.residual[0] + length * c.change[0];
      UNROLLED for (int k = 1; k < DIRECTIONS; ++k) {
        if (!c.exists || k > frictions(c)) break;
        const real t = c.residual[k] + length * c.change[k];
        add_row(n + t, c.change[0] + c.change[k], c.weight, a, b);
        add_row(n - t, c.change[0] - c.change[k], c.weight, a, b);
      }
      const Limit& l = limits[ME];
      add_row(l.residual + length * l.change, l.change, l.weight, a, b);
      first[ME] = a;
      second[ME] = b;
    }
    const real d1 = linear + length * quadratic + sum(first), d2 = quadratic + sum(second);
    if (!(absolute(d1) > real(-0.1) * slope)) break;
    (d1 < 0 ? below : above) = length;
    real next = length - d1 * reciprocal(d2);
    if (above > 0 && !(next > below && next < above)) next = real(0.5) * (below + above);
    length = next;
  }
  return length;
}

// qacc that minimises Gauss' cost (mj_solNewton). A full step that leaves the pushing rows as they are is exact.
DEVICE void solve_constraints(World& w, PerLane<Contact>& contacts, PerLane<Limit>& limits, bool full) {
  PerLane<real> excess, gradient, x;  // M a - smooth
  PerLane<unsigned> active;
  EACH_LANE excess[ME] = lane < NV ? times_inertia(w, w.acceleration, lane) - w.smooth[lane] : real(0);
  bool done = false;
  ROLLED for (int iteration = 0; iteration < ITERATIONS && !done; ++iteration) {
    const unsigned pushing = find_active(w, contacts, limits, active);
    assemble(w, pushing, full, excess, gradient);
#if FILLS
    if (full)
      solve_full(w, x);
    else
#endif
      solve_tree(w, x);
    EACH_LANE if (lane < NV) w.step[lane] = -x[ME];
    MEET();
    done = !find_changes(w, contacts, limits, active);
    real length = 1, slope = 0;
    if (!done) {
      PerLane<real> falls;
      EACH_LANE falls[ME] = -x[ME] * gradient[ME];
      slope = sum(falls);
      done = !(-slope * IMPROVEMENT_SCALE > IMPROVEMENT);  // also of what is not a number
    }
    if (!done) {
      PerLane<real> change, one, two;
      EACH_LANE {
        change[ME] = lane < NV ? times_inertia(w, w.step, lane) : real(0);
        one[ME] = -x[ME] * excess[ME];
        two[ME] = -x[ME] * change[ME];
      }
      length = search_line(contacts, limits, sum(one), sum(two), slope);
      EACH_LANE excess[ME] += length * change[ME];
    }
    EACH_LANE {
      if (lane < NV) w.acceleration[lane] -= length * x[ME];
      Contact& c = contacts[ME];
      UNROLLED for (int k = 0; k < DIRECTIONS; ++k) c.residual[k] += length * c.change[k];
      limits[ME].residual += length * limits[ME].change;
    }
    MEET();
  }
}
