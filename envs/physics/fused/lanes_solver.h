// Newton's method on the constrained acceleration (engine_solver.c): the cost is quadratic between the places where an
// edge's residual changes sign, so a full step that changes none ends at the minimum.
#pragma once
#include "lanes_state.h"

constexpr Real IMPROVEMENT = SINGLE ? Real(1e-9) : Real(1e-12);  // the least worth a step, scaled as MuJoCo scales it
constexpr int EDGES = 2 * (DIRECTIONS - 1);                      // the most of a contact
constexpr Real SLOPE_LEFT = Real(0.1);                           // of the line search, as a share of the slope at its start

// -- M and H, whose pattern is the tree's --

FUNCTION void times_M(const Worlds& w, const Num* x, Num* out) {
  if constexpr (UNROLLED) {
    Num sum[NV];
    repeat<0, NV>([&](auto i) INLINE {
      Num own = w.M[i][i] * x[i];
      repeat<0, NANCESTORS[i]>([&](auto k) INLINE {
        constexpr int j = ANCESTORS[decltype(i)::value][k];
        own += w.M[i][j] * x[j];
        sum[j] += w.M[i][j] * x[i];
      });
      sum[i] = own;
    });
    repeat<0, NV>([&](auto i) INLINE { out[i] = sum[i]; });
  } else {
    for (int i = 0; i < NV; ++i) {
      Num own = w.M[i][i] * x[i];
      for (int k = 0; k < NANCESTORS[i]; ++k) {
        const int j = ANCESTORS[i][k];
        own += w.M[i][j] * x[j];
        out[j] += w.M[i][j] * x[i];
      }
      out[i] = own;
    }
  }
}

FUNCTION void copy_M(Worlds& w) {
  if constexpr (UNROLLED) {
    repeat<0, NV>([&](auto i) INLINE {
      w.H[i][i] = w.M[i][i];
      repeat<0, NANCESTORS[i]>([&](auto k) INLINE {
        constexpr int j = ANCESTORS[decltype(i)::value][k];
        w.H[i][j] = w.M[i][j];
      });
    });
    return;
  }
  for (int i = 0; i < NV; ++i) {
    if constexpr (FILLS) {
      for (int j = 0; j < i; ++j) w.H[i][j] = Num(0);
    }
    w.H[i][i] = w.M[i][i];
    for (int k = 0; k < NANCESTORS[i]; ++k) w.H[i][ANCESTORS[i][k]] = w.M[i][ANCESTORS[i][k]];
  }
}

// step = -inverse(H) gradient by H = L' D L in place, from the leaves: without fill-in (Featherstone). The gradient is
// eliminated on the way.
FUNCTION void solve_unrolled(Worlds& w) {
  Num s[NV];
  repeat<0, NV>([&](auto i) INLINE { s[i] = -w.gradient[i]; });
  repeat<0, NV>([&](auto reversed) INLINE {
    constexpr int k = NV - 1 - decltype(reversed)::value;
    const Num scale = inverse(w.H[k][k]), own = s[k];
    repeat<0, NANCESTORS[k]>([&](auto x) INLINE {
      constexpr int i = ANCESTORS[k][decltype(x)::value];
      const Num share = w.H[k][i] * scale;
      repeat<decltype(x)::value, NANCESTORS[k]>([&](auto y) INLINE {
        constexpr int j = ANCESTORS[k][decltype(y)::value];
        w.H[i][j] -= share * w.H[k][j];
      });
      w.H[k][i] = share;
      s[i] -= share * own;
    });
    s[k] = own * scale;
  });
  repeat<0, NV>([&](auto i) INLINE {
    Num x = s[i];
    repeat<0, NANCESTORS[i]>([&](auto y) INLINE {
      constexpr int j = ANCESTORS[decltype(i)::value][decltype(y)::value];
      x -= w.H[i][j] * s[j];
    });
    s[i] = x;
    w.step[i] = x;
  });
}

FUNCTION int highest(unsigned bits) { return 31 - __builtin_clz(bits); }
FUNCTION int highest(unsigned long long bits) { return 63 - __builtin_clzll(bits); }
FUNCTION int highest(unsigned __int128 bits) {
  const unsigned long long high = bits >> 64, low = bits;
  return high ? 64 + highest(high) : highest(low);
}

// The same by bits of the pattern, with the fill-in of contacts between branches. A world without such a contact has
// zeros there, which change nothing.
FUNCTION void solve_pattern(Worlds& w) {
  Num* s = w.step;
  for (int i = 0; i < NV; ++i) s[i] = -w.gradient[i];
  for (int k = NV - 1; k >= 0; --k) {
    const Num scale = inverse(w.H[k][k]), own = s[k];
    for (Dofs rows = w.pattern[k]; rows;) {
      const int i = highest(rows);
      const Num share = w.H[k][i] * scale;
      for (Dofs columns = rows; columns;) {
        const int j = highest(columns);
        w.H[i][j] -= share * w.H[k][j];
        columns ^= Dofs(1) << j;
      }
      w.H[k][i] = share;
      s[i] -= share * own;
      rows ^= Dofs(1) << i;
    }
    s[k] = own * scale;
  }
  for (int i = 0; i < NV; ++i) {
    Num x = s[i];
    for (Dofs columns = w.pattern[i]; columns;) {
      const int j = highest(columns);
      x -= w.H[i][j] * s[j];
      columns ^= Dofs(1) << j;
    }
    s[i] = x;
  }
}

// Adds to the pattern what elimination fills in.
FUNCTION void complete_pattern(Worlds& w) {
  for (int k = NV - 1; k >= 0; --k) {
    for (Dofs rows = w.pattern[k]; rows;) {
      const int i = highest(rows);
      rows ^= Dofs(1) << i;
      w.pattern[i] |= rows;
    }
  }
}

FUNCTION void solve(Worlds& w) {
  if constexpr (UNROLLED) solve_unrolled(w);
  else solve_pattern(w);
}

// -- gradient and Hessian --

// What an edge set adds: the force along the contact's axes, and the matrix between them: the normal's own entry, those
// of the normal with the others, and the others' own.
struct Edges {
  Num force[DIRECTIONS], normal, mixed[DIRECTIONS], own[DIRECTIONS];
};

FUNCTION void add_column(Worlds& w, const Slot& s, const Edges& e, int j, int dof, Num* along) {
  const Num* row = s.jacobian[j];
  Num pull = row[0] * e.force[0];
  along[0] = e.normal * row[0];
  for (int k = 1; k < DIRECTIONS; ++k) {
    pull += row[k] * e.force[k];
    along[0] += e.mixed[k] * row[k];
    along[k] = e.mixed[k] * row[0] + e.own[k] * row[k];
  }
  w.gradient[dof] += pull;
}

FUNCTION Num product(const Num* a, const Num* b) {
  Num sum = a[0] * b[0];
  for (int k = 1; k < DIRECTIONS; ++k) sum += a[k] * b[k];
  return sum;
}

// Contacts with N columns; where all are the root's too, its columns are the first.
template <int N> FUNCTION void add_contact(Worlds& w, const Slot& s, const Edges& e) {
  constexpr auto known = [](int column) { return ROOTED && column < FIRST; };
  repeat<0, N>([&](auto j) INLINE {
    Num along[DIRECTIONS];
    const int dof = known(j) ? int(j) : s.dofs[j];
    add_column(w, s, e, j, dof, along);
    repeat<decltype(j)::value, N>([&](auto i) INLINE {
      w.H[known(i) ? int(i) : s.dofs[i]][dof] += product(s.jacobian[i], along);
    });
  });
}

FUNCTION void add_contact(Worlds& w, const Slot& s, const Edges& e) {
  if constexpr (UNROLLED) {
    repeat<1, MOST_COLUMNS + 1>([&](auto n) INLINE {
      if constexpr (!ROOTED || decltype(n)::value >= FIRST) {
        if (s.columns == n) add_contact<decltype(n)::value>(w, s, e);
      }
    });
    return;
  }
  for (int j = 0; j < s.columns; ++j) {
    Num along[DIRECTIONS];
    add_column(w, s, e, j, s.dofs[j], along);
    for (int i = j; i < s.columns; ++i) w.H[s.dofs[i]][s.dofs[j]] += product(s.jacobian[i], along);
  }
}

// The residuals of the pyramid's edges: normal plus or minus another axis.
FUNCTION void edges_of(const Num* residual, int frictions, Num* edge) {
  for (int k = 0; k < frictions; ++k) {
    edge[2 * k] = residual[0] + residual[k + 1];
    edge[2 * k + 1] = residual[0] - residual[k + 1];
  }
}

FUNCTION void add_contacts(Worlds& w) {
  for (int c = 0; c < w.slot_count; ++c) {
    Slot& s = w.slots[c];
    Num edge[EDGES];
    Mask pushes = mask_of(false);
    edges_of(s.residual, s.frictions(), edge);
    for (int k = 0; k < 2 * s.frictions(); ++k) {
      s.active[k] = (edge[k] < Num(0)) & s.has;
      pushes |= s.active[k];
    }
    if (!any(pushes)) continue;
    Edges e;
    e.normal = e.force[0] = Num(0);
    for (int k = 1; k < DIRECTIONS; ++k) e.force[k] = e.mixed[k] = e.own[k] = Num(0);
    for (int k = 1; k <= s.frictions(); ++k) {
      const Num first = select(s.active[2 * k - 2], s.weight, Num(0)), up = first * edge[2 * k - 2];
      const Num second = select(s.active[2 * k - 1], s.weight, Num(0)), down = second * edge[2 * k - 1];
      e.normal += first + second, e.force[0] += up + down;
      e.mixed[k] = first - second, e.own[k] = first + second, e.force[k] = up - down;
    }
    add_contact(w, s, e);
  }
}

FUNCTION void add_limits(Worlds& w) {
  for (int n = 0; n < w.limit_count; ++n) {
    const int k = w.limits[n], d = LIMITS[k].dof;
    w.limit_active[k] = w.limit_residual[k] < Num(0);
    if (!any(w.limit_active[k])) continue;
    const Num weight = select(w.limit_active[k], w.limit_weight[k], Num(0));
    w.H[d][d] += weight;
    w.gradient[d] += weight * w.limit_residual[k] * w.limit_sign[k];
  }
}

// -- a step --

// How a full step changes the residuals; which worlds have an edge that changes sign.
FUNCTION Mask change_residuals(Worlds& w) {
  Mask changed = mask_of(false);
  for (int c = 0; c < w.slot_count; ++c) {
    Slot& s = w.slots[c];
    Num after[DIRECTIONS], edge[EDGES];
    for (int x = 0; x < DIRECTIONS; ++x) s.change[x] = Num(0);
    for (int k = 0; k < s.columns; ++k) {
      const Num step = w.step[s.dofs[k]];
      for (int x = 0; x < DIRECTIONS; ++x) s.change[x] += s.jacobian[k][x] * step;
    }
    for (int x = 0; x < DIRECTIONS; ++x) after[x] = s.residual[x] + s.change[x];
    edges_of(after, s.frictions(), edge);
    for (int k = 0; k < 2 * s.frictions(); ++k) changed |= s.has & differ(edge[k] < Num(0), s.active[k]);
  }
  for (int n = 0; n < w.limit_count; ++n) {
    const int k = w.limits[n];
    w.limit_change[k] = w.limit_sign[k] * w.step[LIMITS[k].dof];
    changed |= differ(w.limit_residual[k] + w.limit_change[k] < Num(0), w.limit_active[k]);
  }
  return changed;
}

FUNCTION void add_edge(Num residual, Num change, Num weight, Num* slope, Num* curvature) {
  const Num pull = select(residual < Num(0), weight, Num(0)) * change;
  *slope += pull * residual;
  *curvature += pull * change;
}

// Slope and curvature of the constraints' cost along the step, `alpha` of it away.
FUNCTION void constraint_slope(const Worlds& w, Num alpha, Num* slope, Num* curvature) {
  for (int c = 0; c < w.slot_count; ++c) {
    const Slot& s = w.slots[c];
    Num residual[DIRECTIONS], edge[EDGES], change[EDGES];
    for (int x = 0; x < DIRECTIONS; ++x) residual[x] = s.residual[x] + alpha * s.change[x];
    edges_of(residual, s.frictions(), edge);
    edges_of(s.change, s.frictions(), change);
    for (int k = 0; k < 2 * s.frictions(); ++k) add_edge(edge[k], change[k], s.weight, slope, curvature);
  }
  for (int n = 0; n < w.limit_count; ++n) {
    const int k = w.limits[n];
    const Num residual = w.limit_residual[k] + alpha * w.limit_change[k];
    add_edge(residual, w.limit_change[k], w.limit_weight[k], slope, curvature);
  }
}

// The share of the step that minimises the cost in the worlds `on`: Newton's method, held between the bounds found.
FUNCTION Num line_search(Worlds& w, Num alpha, Num slope_at_start, Mask on) {
  times_M(w, w.step, w.M_step);
  Num linear = Num(0), quadratic = Num(0);
  for (int i = 0; i < NV; ++i) {
    linear += w.step[i] * (w.Ma[i] - w.smooth[i]);
    quadratic += w.step[i] * w.M_step[i];
  }
  Num low = Num(0), high = Num(-1);
  for (int k = 0; k < LINE_SEARCH; ++k) {
    Num slope = linear + alpha * quadratic, curvature = quadratic;
    constraint_slope(w, alpha, &slope, &curvature);
    on &= size_of(slope) > Num(-SLOPE_LEFT) * slope_at_start;
    if (!any(on)) break;
    const Mask before = slope < Num(0);
    low = select(on & before, alpha, low);
    high = select(on & !before, alpha, high);
    Num next = alpha - slope * inverse(curvature);
    const Mask outside = (high > Num(0)) & !((next > low) & (next < high));
    next = select(outside, Num(Real(.5)) * (low + high), next);
    alpha = select(on, next, alpha);
  }
  for (int i = 0; i < NV; ++i) w.Ma[i] += alpha * w.M_step[i];
  return alpha;
}

// Moves `alpha` along the step. A world that is done does not move, so none depends on its neighbours.
FUNCTION void move(Worlds& w, Num alpha, Mask todo, bool residuals_of_contacts, bool residuals_of_limits) {
  for (int i = 0; i < NV; ++i) w.a[i] = select(todo, w.a[i] + alpha * w.step[i], w.a[i]);
  for (int c = 0; c < w.slot_count && residuals_of_contacts; ++c) {
    for (int x = 0; x < DIRECTIONS; ++x) w.slots[c].residual[x] += alpha * w.slots[c].change[x];
  }
  for (int n = 0; n < w.limit_count && residuals_of_limits; ++n) {
    w.limit_residual[w.limits[n]] += alpha * w.limit_change[w.limits[n]];
  }
}

// The acceleration into `a`, from where `a` is. `last`: residuals are left at the solution, for the contacts' forces.
FUNCTION void newton(Worlds& w, bool last) {
  if constexpr (FILLS) complete_pattern(w);
  times_M(w, w.a, w.Ma);
  Mask todo = mask_of(true);
  for (int iteration = 0; iteration < ITERATIONS; ++iteration) {
    for (int i = 0; i < NV; ++i) w.gradient[i] = w.Ma[i] - w.smooth[i];
    copy_M(w);
    add_contacts(w);
    add_limits(w);
    solve(w);
    Num slope = Num(0);
    for (int i = 0; i < NV; ++i) slope += w.step[i] * w.gradient[i];
    // A broken world (NaN) compares false and is done.
    const Mask worth = -slope * Num(IMPROVEMENT_SCALE) > Num(IMPROVEMENT);
    const Mask more = todo & change_residuals(w) & worth;
    const bool again = any(more);
    Num alpha = select(todo, Num(1), Num(0));
    if (again) alpha = line_search(w, alpha, slope, more);
    move(w, alpha, todo, again || last, again);
    todo = more;
    if (!again) break;
  }
}
