"""The registry of simulated controllers: the other end of each stage's wire, by the stage's kind.

Adding one takes its folder `simulators/wires/<kind>`: a module `wire` with the class, whose name CONTROLLERS of the
folder says.
"""

from __future__ import annotations

from importlib import import_module

from recon.base.registry import Registry, in_folders
from simulators.wires.wire import Build

WIRES: Registry[type[Build]] = Registry(
    "wire",
    {
        kind: getattr(import_module(f"simulators.wires.{kind}.wire"), name)
        for kind, name in in_folders("simulators.wires", "CONTROLLERS").items()
    },
)
"""Kind -> how its simulated controller is built."""
