"""Voltage control on distribution grids: power flow, profiles, task, reference policies."""
