"""Stages: a configured rotation stage becomes its driver, or, without a word to it, the figures that it will have.

Each driver is imported where it is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, TypedDict

from beamline.config.devices import StageOutputShutter
from beamline.config.stages import PiGcsStageConfig, PM16CStageConfig, StageConfig, ZaberStageConfig
from beamline.core.errors import ConfigError
from drivers.clock import Clock
from drivers.protocols import RotationStage, StageLimits
from drivers.shutter import DigitalOutput, OutputShutter

_REFERENCES: Mapping[str, Literal["FRF", "FNL", "FPL"]] = {
    "switch": "FRF",
    "negative_limit": "FNL",
    "positive_limit": "FPL",
}


class _Figures(TypedDict):
    """What a stage is limited to, as every driver takes it: counts, rad/s, rad/s², rad."""

    counts_per_turn: int
    max_speed: float
    acceleration: float
    low: float
    high: float


class _Wiring(TypedDict):
    """How a stage is connected, as every driver takes it; s."""

    clock: Clock
    timeout: float
    baudrate: int
    pulse_width: float | None
    active_high: bool
    transcript: Path | None


def make_stage(config: StageConfig, url: str, clock: Clock) -> RotationStage:
    """The driver of the configured controller, connected at `url`. Nothing moves.

    Raises:
        DeviceError: it does not answer, or refuses the settings.
    """
    wiring, figures = _wiring(config, clock), _figures(config)
    match config:
        case PM16CStageConfig():
            from drivers.stages.pm16c.stage import PM16CStage

            home, speed = (None if v is None else math.radians(v) for v in (config.home_deg, config.home_speed_deg_s))
            return PM16CStage(
                url,
                channel=config.channel,
                first_pulse=config.first_pulse,
                home=home,
                home_speed=speed,
                **wiring,
                **figures,
            )
        case PiGcsStageConfig():
            from drivers.stages.pi_gcs.stage import PiGcsStage

            return PiGcsStage(
                url,
                axis=config.axis,
                trigger_line=config.trigger_line,
                reference=_REFERENCES[config.reference],
                first_pulse=config.first_pulse,
                firmware_pulse=config.firmware_pulse_s,
                tolerance=config.tolerance_counts,
                settle=config.settle_s,
                **wiring,
                **figures,
            )
        case ZaberStageConfig():
            from drivers.stages.zaber.stage import ZaberStage

            return ZaberStage(
                url,
                device=config.device,
                axis=config.axis,
                output=config.output,
                toggle=config.toggle,
                speed_unit=config.speed_unit,
                pulses=config.pulses(),
                **wiring,
                **figures,
            )


def stage_limits(config: StageConfig) -> StageLimits:
    """What the driver will say of the stage, as far as that is known before it is connected.

    Raises:
        ValueError: figures that the controller does not have.
    """
    figures = _figures(config)
    match config:
        case PM16CStageConfig():
            from drivers.stages.pm16c import limits as pm16c_limits
            from drivers.stages.pm16c import train as pm16c_train

            begin = pm16c_train.FirstPulse(config.first_pulse)
            return pm16c_limits.limits_of(**figures, first_pulse=begin, pulse_width=config.pulse_width_s)
        case PiGcsStageConfig():
            from drivers.stages.pi_gcs import limits as pi_gcs_limits
            from drivers.stages.pi_gcs import train as pi_gcs_train

            begins = pi_gcs_train.FirstPulse(config.first_pulse)
            return pi_gcs_limits.limits_of(**figures, first_pulse=begins, firmware_pulse=config.firmware_pulse_s)
        case ZaberStageConfig():
            from drivers.stages.zaber import limits as zaber_limits

            return zaber_limits.limits_of(**figures, pulses=config.pulses(), speed_unit=config.speed_unit)


def output_of(config: StageConfig, stage: RotationStage, number: int) -> DigitalOutput:
    """A digital output of the stage's controller.

    Raises:
        ConfigError: it has none that can be set. DeviceRefused: it is the one of the trigger pulses.
    """
    from drivers.stages.pi_gcs.stage import PiGcsStage
    from drivers.stages.zaber.stage import ZaberStage

    if isinstance(stage, PiGcsStage | ZaberStage):
        return stage.digital_output(number)
    raise ConfigError(f"devices.shutter: the controller of a {config.kind} stage has no digital output to set")


def output_shutter(
    config: StageConfig, shutter: StageOutputShutter, stage: RotationStage, clock: Clock
) -> OutputShutter:
    """A shutter on an output of the stage's controller. Raises as `output_of` does."""
    output = output_of(config, stage, shutter.output)
    return OutputShutter(output, clock, open_high=shutter.open_high, settle=shutter.settle_s)


def _figures(config: StageConfig) -> _Figures:
    return {
        "counts_per_turn": config.counts_per_turn,
        "max_speed": math.radians(config.max_speed_deg_s),
        "acceleration": math.radians(config.acceleration_deg_s2),
        "low": math.radians(config.low_deg),
        "high": math.radians(config.high_deg),
    }


def _wiring(config: StageConfig, clock: Clock) -> _Wiring:
    return {
        "clock": clock,
        "timeout": config.timeout_s,
        "baudrate": config.baudrate,
        "pulse_width": config.pulse_width_s,
        "active_high": config.active_high,
        "transcript": None if config.transcript is None else Path(config.transcript),
    }
