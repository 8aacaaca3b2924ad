"""Voltage control on 141 buses in which every agent observes all of the grid, not only its own region."""

from __future__ import annotations

import dataclasses

import numpy as np

from envs.voltage.control import VoltageControl, load_scenario
from envs.voltage.profiles import load_profiles


def make() -> VoltageControl:
    """`voltage_141` with one region of all buses but the slack; data, costs and rewards are the same."""
    regions = load_scenario("case141")
    profiles = load_profiles("simbench", regions.name, regions.table)
    whole = {**regions.table, "zone": np.minimum(regions.table["zone"], 1)}
    return VoltageControl(dataclasses.replace(regions, name="case141_whole", table=whole), data=profiles)
