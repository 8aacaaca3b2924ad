"""The ant in the corridor (Safe MAMuJoCo): model and task."""
