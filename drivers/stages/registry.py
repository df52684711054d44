"""The registry of stages: the driver of each kind.

Adding a stage takes its folder `drivers/stages/<kind>` with a module `stage`, and its line in REGISTRY.
"""

from __future__ import annotations

from importlib import import_module

from drivers.stages.settings import StageDriver, with_keys
from recon.base.registry import Registry

REGISTRY = {  # kind, as a configuration names it: class in the kind's module `stage`
    "pm16c": "PM16CStage",
    "pi_gcs": "PiGcsStage",
    "zaber": "ZaberStage",
    "epics": "EpicsStage",
}
STAGES: Registry[StageDriver] = Registry(
    "stage",
    {kind: getattr(import_module(f"drivers.stages.{kind}.stage"), name) for kind, name in REGISTRY.items()},
    with_keys,
)
"""Kind -> the driver."""
