"""The simulated controller of the stage."""

from __future__ import annotations

from simulators.wires.pi_gcs.wire import PiGcsBuild


class SiteBuild(PiGcsBuild):
    """Its simulated controller."""
