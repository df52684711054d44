"""Checks for objects other than the sample: shadows and reflections, and loose particles."""

CHECKS = {
    "FloaterCheck": "beamline.monitor.foreign.floater",
    "GhostCheck": "beamline.monitor.foreign.ghost",
}
