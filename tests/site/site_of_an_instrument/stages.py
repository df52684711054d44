"""A stage: one of ours with another setting."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.stages.pi_gcs.settings import PiGcsSettings
from drivers.stages.pi_gcs.stage import PiGcsStage
from recon.base.setting import setting


@dataclass(frozen=True)
class SiteStageSettings(PiGcsSettings):
    """The site's stage: a PI with a brake."""

    brake: float = setting(0.1, "How long its brake takes.", unit="s", ge=0)


class SiteStage(PiGcsStage):
    Settings = SiteStageSettings
