"""A stage: one of ours with another setting."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.stages.zaber.settings import ZaberSettings
from drivers.stages.zaber.stage import ZaberStage
from recon.base.setting import setting


@dataclass(frozen=True)
class SiteStageSettings(ZaberSettings):
    """The site's stage: a Zaber with a brake."""

    brake: float = setting(0.1, "How long its brake takes.", unit="s", ge=0)


class SiteStage(ZaberStage):
    Settings = SiteStageSettings
