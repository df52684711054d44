"""The registry of stages: the driver of each kind.

Adding a stage takes its folder `drivers/stages/<kind>`: a module `stage` with the driver, whose name DRIVERS of the
folder says.
"""

from __future__ import annotations

from importlib import import_module

from drivers.stages.settings import StageDriver, with_keys
from recon.base.registry import Registry, in_folders

STAGES: Registry[StageDriver] = Registry(
    "stage",
    {
        kind: getattr(import_module(f"drivers.stages.{kind}.stage"), name)
        for kind, name in in_folders("drivers.stages", "DRIVERS").items()
    },
    with_keys,
)
"""Kind, as a configuration names it -> the driver."""
