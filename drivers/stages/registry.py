"""The stages that there are: each kind's settings, which are what its driver is opened with."""

from __future__ import annotations

from collections.abc import Mapping

from drivers.stages.pi_gcs.settings import PiGcsSettings
from drivers.stages.pm16c.settings import PM16CSettings
from drivers.stages.settings import StageSettings
from drivers.stages.zaber.settings import ZaberSettings

STAGES: Mapping[str, type[StageSettings]] = {
    "pm16c": PM16CSettings,
    "pi_gcs": PiGcsSettings,
    "zaber": ZaberSettings,
}
"""Kind, as a configuration names it -> the settings."""
