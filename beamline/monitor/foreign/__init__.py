"""Checks for objects beside the sample: fog, crumbs far from the axis, and what a reconstruction does not explain."""

from __future__ import annotations

CHECKS = {
    "beamline.monitor.foreign.floater": "FloaterCheck",
    "beamline.monitor.foreign.ghost": "GhostCheck",
    "beamline.monitor.foreign.model": "ModelCheck",
}
