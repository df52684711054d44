"""The registry of simulated controllers: the other end of each stage's wire, by the stage's kind."""

from __future__ import annotations

from importlib import import_module

from drivers.flat import flat_fields
from recon.base.registry import Registry
from simulators.wires.wire import Build

REGISTRY = {  # kind, as in `drivers.stages.registry`: class in the kind's module `wire`
    "pm16c": "PM16CBuild",
    "pi_gcs": "PiGcsBuild",
    "zaber": "ZaberBuild",
    "epics": "EpicsBuild",
}


def _fitting(name: str, found: type[Build]) -> type[Build]:
    """The class, if an option of it can be read."""
    _ = flat_fields(found), found.matching
    return found


WIRES: Registry[type[Build]] = Registry(
    "wire",
    {kind: getattr(import_module(f"simulators.wires.{kind}.wire"), name) for kind, name in REGISTRY.items()},
    _fitting,
)
"""Kind -> how its simulated controller is built."""
