"""The simulated controller of the stage."""

from __future__ import annotations

from simulators.wires.zaber.wire import ZaberBuild


class SiteBuild(ZaberBuild):
    """Its simulated controller."""
