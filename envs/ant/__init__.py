"""The ant in the corridor (Safe MAMuJoCo): model and task. Importing this imports neither JAX nor MuJoCo."""

from ..columns import Column

COLUMNS = {
    "outside": Column(
        "outside",
        "share of steps beyond a wall; reference walls do not block, and behind their bands nothing costs",
        0,
        1,
    )
}
