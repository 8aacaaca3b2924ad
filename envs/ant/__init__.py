"""The ant in the corridor (Safe MAMuJoCo): model and task. Importing this imports neither JAX nor MuJoCo."""

from ..columns import Column

COLUMNS = {
    "outside": Column(
        "outside",
        "share of steps beyond a wall; reference walls do not block, nor is it costly behind their bands",
        0,
        1,
    )
}
