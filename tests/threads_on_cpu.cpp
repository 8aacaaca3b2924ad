// threads_step.h on a CPU, for tests: lanes are loops. REAL and MODEL come from the command line.
#include "threads_step.h"

static World w;

static void load(const real* qpos, const real* qvel, const real* warmstart, const real* ctrl) {
  clear(w);
  for (int i = 0; i < NQ; ++i) w.qpos[i] = qpos[i];
  for (int i = 0; i < NV; ++i) {
    w.qvel[i] = qvel[i];
    w.qacc[i] = warmstart[i];
  }
  load_controls(w, ctrl);
}

static Outputs outputs(real* readings) {
  Outputs out = {};
  for (int k = 0; k < READINGS; ++k) {
    out.reading[k] = readings;
    readings += READING_COUNT[k] * READING_WIDTH[k];
  }
  return out;
}

extern "C" {
int world_bytes() { return sizeof(World); }

// A world after a world. `whole`: a control step; else only qacc of the state, into new_warmstart.
void run(int n, int whole, const real* qpos, const real* qvel, const real* warmstart, const real* ctrl, real* new_qpos,
         real* new_qvel, real* new_warmstart, real* overflow, real* readings, int width) {
  for (int k = 0; k < n; ++k) {
    load(qpos + k * NQ, qvel + k * NV, warmstart + k * NV, ctrl + k * NU);
    bool lost = false;
    const Outputs out = outputs(readings + k * width);
    if (whole)
      control_step(w, out, lost);
    else
      evaluate(w, true, out, lost);
    for (int i = 0; i < NQ; ++i) new_qpos[k * NQ + i] = w.qpos[i];
    for (int i = 0; i < NV; ++i) {
      new_qvel[k * NV + i] = w.qvel[i];
      new_warmstart[k * NV + i] = w.qacc[i];
    }
    overflow[k] = lost ? 1 : 0;
  }
}
}
