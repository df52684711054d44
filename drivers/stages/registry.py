"""The registry of stages: each kind's settings, with which its driver is opened.

Adding a stage takes its folder `drivers/stages/<kind>` with a module `settings`, and its line in REGISTRY.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module

from drivers.plugins import plugins
from drivers.stages.settings import StageSettings

REGISTRY = {  # kind, as a configuration names it: class in the kind's module `settings`
    "pm16c": "PM16CSettings",
    "pi_gcs": "PiGcsSettings",
    "zaber": "ZaberSettings",
}
STAGES: Mapping[str, type[StageSettings]] = {
    **{kind: getattr(import_module(f"drivers.stages.{kind}.settings"), name) for kind, name in REGISTRY.items()},
    **plugins("stage", REGISTRY),
}
"""Kind -> the settings."""
