"""Voltage control on distribution grids: power flow, profiles, task, baselines, map. Importing this imports no JAX."""

from ..columns import Column

COLUMNS = {
    "totally_controllable_ratio": Column("CR", "share of steps with every bus in the band", 0, 1),
    "total_line_loss": Column("PL", "losses in lines, MW", 0),
}
