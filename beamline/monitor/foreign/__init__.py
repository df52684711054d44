"""Checks for objects beside the sample: fog, and crumbs far from the axis."""

CHECKS = {
    "FloaterCheck": "beamline.monitor.foreign.floater",
    "GhostCheck": "beamline.monitor.foreign.ghost",
}
