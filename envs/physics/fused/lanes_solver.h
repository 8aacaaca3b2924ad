// Newton's method on the constrained acceleration (engine_solver.c): the cost is quadratic between the places where an
// edge's residual changes sign, so a full step that changes none ends at the minimum.
#pragma once
#include "lanes_state.h"

constexpr Real IMPROVEMENT = SINGLE ? Real(1e-9) : Real(1e-12);  // the least worth a step, scaled as MuJoCo scales it
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

// The same by bits of the pattern, with the fill-in of contacts between branches. A world without such a contact has
// zeros there, which change nothing.
FUNCTION void solve_pattern(Worlds& w) {
  Num* s = w.step;
  for (int i = 0; i < NV; ++i) s[i] = -w.gradient[i];
  for (int k = NV - 1; k >= 0; --k) {
    const Num scale = inverse(w.H[k][k]), own = s[k];
    for (unsigned rows = w.pattern[k]; rows;) {
      const int i = highest(rows);
      const Num share = w.H[k][i] * scale;
      for (unsigned columns = rows; columns;) {
        const int j = highest(columns);
        w.H[i][j] -= share * w.H[k][j];
        columns ^= 1u << j;
      }
      w.H[k][i] = share;
      s[i] -= share * own;
      rows ^= 1u << i;
    }
    s[k] = own * scale;
  }
  for (int i = 0; i < NV; ++i) {
    Num x = s[i];
    for (unsigned columns = w.pattern[i]; columns;) {
      const int j = highest(columns);
      x -= w.H[i][j] * s[j];
      columns ^= 1u << j;
    }
    s[i] = x;
  }
}

// Adds to the pattern what elimination fills in.
FUNCTION void complete_pattern(Worlds& w) {
  for (int k = NV - 1; k >= 0; --k) {
    for (unsigned rows = w.pattern[k]; rows;) {
      const int i = highest(rows);
      rows ^= 1u << i;
      w.pattern[i] |= rows;
    }
  }
}

FUNCTION void solve(Worlds& w) {
  if constexpr (UNROLLED) solve_unrolled(w);
  else solve_pattern(w);
}

// -- gradient and Hessian --

// What an edge set adds: the force along the contact's axes, and the matrix between them.
struct Edges {
  Num force[3], normal, normal_first, normal_second, first, second;
};

FUNCTION void add_column(Worlds& w, const Slot& s, const Edges& e, int j, int dof, Num* along) {
  const Num normal = s.jacobian[j][0], first = s.jacobian[j][1], second = s.jacobian[j][2];
  w.gradient[dof] += normal * e.force[0] + first * e.force[1] + second * e.force[2];
  along[0] = e.normal * normal + e.normal_first * first + e.normal_second * second;
  along[1] = e.normal_first * normal + e.first * first;
  along[2] = e.normal_second * normal + e.second * second;
}

// Contacts with N columns; where all are the root's too, its columns are the first.
template <int N> FUNCTION void add_contact(Worlds& w, const Slot& s, const Edges& e) {
  constexpr auto known = [](int column) { return ROOTED && column < FIRST; };
  repeat<0, N>([&](auto j) INLINE {
    Num along[3];
    const int dof = known(j) ? int(j) : s.dofs[j];
    add_column(w, s, e, j, dof, along);
    repeat<decltype(j)::value, N>([&](auto i) INLINE {
      const Num* row = s.jacobian[i];
      w.H[known(i) ? int(i) : s.dofs[i]][dof] += row[0] * along[0] + row[1] * along[1] + row[2] * along[2];
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
    Num along[3];
    add_column(w, s, e, j, s.dofs[j], along);
    for (int i = j; i < s.columns; ++i) {
      const Num* row = s.jacobian[i];
      w.H[s.dofs[i]][s.dofs[j]] += row[0] * along[0] + row[1] * along[1] + row[2] * along[2];
    }
  }
}

// The residuals of the pyramid's edges: normal plus or minus a tangent.
FUNCTION void edges_of(const Num* residual, Num* edge) {
  edge[0] = residual[0] + residual[1], edge[1] = residual[0] - residual[1];
  edge[2] = residual[0] + residual[2], edge[3] = residual[0] - residual[2];
}

FUNCTION void add_contacts(Worlds& w) {
  for (int c = 0; c < w.slot_count; ++c) {
    Slot& s = w.slots[c];
    Num edge[4], weight[4], force[4];
    edges_of(s.residual, edge);
    for (int k = 0; k < 4; ++k) s.active[k] = (edge[k] < Num(0)) & s.has;
    if (!any(s.active[0] | s.active[1] | s.active[2] | s.active[3])) continue;
    for (int k = 0; k < 4; ++k) {
      weight[k] = select(s.active[k], s.weight, Num(0));
      force[k] = weight[k] * edge[k];
    }
    const Edges e = {{force[0] + force[1] + force[2] + force[3], force[0] - force[1], force[2] - force[3]},
                     weight[0] + weight[1] + weight[2] + weight[3],
                     weight[0] - weight[1],
                     weight[2] - weight[3],
                     weight[0] + weight[1],
                     weight[2] + weight[3]};
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
    Num after[3], edge[4];
    for (int x = 0; x < 3; ++x) s.change[x] = Num(0);
    for (int k = 0; k < s.columns; ++k) {
      const Num step = w.step[s.dofs[k]];
      for (int x = 0; x < 3; ++x) s.change[x] += s.jacobian[k][x] * step;
    }
    for (int x = 0; x < 3; ++x) after[x] = s.residual[x] + s.change[x];
    edges_of(after, edge);
    for (int k = 0; k < 4; ++k) changed |= s.has & differ(edge[k] < Num(0), s.active[k]);
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
    Num residual[3], edge[4], change[4];
    for (int x = 0; x < 3; ++x) residual[x] = s.residual[x] + alpha * s.change[x];
    edges_of(residual, edge);
    edges_of(s.change, change);
    for (int k = 0; k < 4; ++k) add_edge(edge[k], change[k], s.weight, slope, curvature);
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
    for (int x = 0; x < 3; ++x) w.slots[c].residual[x] += alpha * w.slots[c].change[x];
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
