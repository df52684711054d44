"""Checks for objects beside the sample: fog, crumbs far from the axis, and what a reconstruction does not explain."""

from __future__ import annotations

CHECKS = {
    "FloaterCheck": "beamline.monitor.foreign.floater",
    "GhostCheck": "beamline.monitor.foreign.ghost",
    "ModelCheck": "beamline.monitor.foreign.model",
}
