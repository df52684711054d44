"""Settings of a stage: the values that every driver takes, and how a configuration writes each of them.

A driver's settings are a frozen dataclass in radians and seconds. Each field declares by `setting` how a configuration
file writes it: its unit, which ends the key's name, its legal values and its meaning.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

from drivers.base.clock import Clock
from drivers.base.protocols import RotationStage, StageLimits
from recon.base.setting import CheckedSettings, setting, settings_of

FARTHEST = 1e9  # rad
MOST = 2.0**53  # counts; the largest whole number that a float represents exactly


def with_settings(name: str, driver: Any) -> Any:
    """Check the driver of another package, and return it. Raises AttributeError or TypeError if it has no dataclass of
    settings."""
    settings_of(driver.Settings)
    return driver


@dataclass(frozen=True, kw_only=True)
class StageFigures(CheckedSettings):
    """Base class of a stage's settings, with its limits: counts for 2π, rad/s, rad/s², soft limits in rad.

    Raises:
        ValueError: a value is impossible for a stage.
    """

    stand_in: ClassVar[str] = ""
    """The kind of stage that is simulated instead of this one; "": this kind has its own simulated controller."""
    counts_per_turn: int = setting(
        doc="Motor pulses or encoder counts per 360 deg. Triggers are possible only at whole counts.", gt=0
    )
    max_speed: float = setting(unit="deg_s", gt=0)
    acceleration: float = setting(unit="deg_s2", gt=0)
    low: float = setting(-5.0, unit="deg")
    high: float = setting(365.0, "Limits of the stage: it never moves beyond low_deg and high_deg.", unit="deg")

    def __post_init__(self) -> None:
        super().__post_init__()
        for meaning, rate, unit in (("speed", self.max_speed, "deg/s"), ("acceleration", self.acceleration, "deg/s²")):
            if not rate * self.per_radian < MOST:
                raise ValueError(
                    f"check the settings of the stage: its {meaning} cannot be {math.degrees(rate):g} {unit}"
                )
        if not -FARTHEST <= self.low < self.high <= FARTHEST:
            low, high = math.degrees(self.low), math.degrees(self.high)
            raise ValueError(
                f"high_deg must be above low_deg, so that the stage can move; got low_deg {low:g} and high_deg {high:g}"
            )
        if not (self.high - self.low) * self.per_radian < MOST:
            n_counts = (self.high - self.low) * self.per_radian
            raise ValueError(f"the travel has {n_counts:g} counts, more than a float can resolve")

    @property
    def per_radian(self) -> float:
        """Counts per radian."""
        return self.counts_per_turn / (2 * math.pi)

    def limits_with(
        self,
        acceleration: float,
        pulse_spacing: float,
        *,
        run_up: int = 0,
        interval_unit: int = 1,
        tolerance: int = 0,
    ) -> StageLimits:
        """The limits with a trigger output; arguments as in `StageLimits`.

        Raises:
            ValueError: pulses cannot have this spacing.
        """
        if not 0 <= pulse_spacing * self.max_speed * self.per_radian < MOST:
            raise ValueError(f"pulses cannot be {pulse_spacing:g} s apart")
        return StageLimits(
            self.counts_per_turn,
            self.max_speed,
            acceleration,
            self.low,
            self.high,
            True,
            run_up,
            pulse_spacing,
            interval_unit,
            tolerance,
        )


@dataclass(frozen=True, kw_only=True)
class Wiring(CheckedSettings):
    """Base class of the settings of a stage on a serial line; times in s.

    The baud rate is that of the controller; over USB and TCP it has no effect.
    """

    timeout: float = setting(1.0, "Longest wait for a reply.", unit="s", gt=0)
    baudrate: int = setting(115_200, gt=0)
    pulse_width: float | None = setting(
        None,
        "Width of the trigger pulses in s; null: the driver chooses the width, or the controller has a fixed width.",
        unit="s",
        gt=0,
    )
    active_high: bool = setting(
        True,
        "true: trigger pulses are high; false: low. The driver stops with an error if the controller does not "
        "support this polarity.",
    )
    transcript: Path | None = setting(
        None, "File to which every byte to and from the controller is appended with its time; null: no file."
    )


class StageSettings(Protocol):
    """Settings of a driver, and the limits that are computed from them: a dataclass that derives from
    `StageFigures`."""

    stand_in: ClassVar[str]

    @property
    def max_speed(self) -> float: ...

    @property
    def low(self) -> float: ...

    @property
    def high(self) -> float: ...

    @property
    def pulse_width(self) -> float | None: ...

    @property
    def active_high(self) -> bool: ...

    @property
    def pulse_output(self) -> int | None:
        """Number of the digital output of the trigger pulses; None if no output can be set."""

    def limits(self) -> StageLimits:
        """The stage's limits, as far as they are known before it is connected."""


class StageDriver(Protocol):
    """The class of a driver. The folder of each stage has one, and `beamline.config.stages` lists them.

    Attributes:
        Settings: the class of its settings.
    """

    Settings: type[StageSettings]

    def __call__(self, url: str, settings: Any, clock: Clock) -> RotationStage:
        """The driver, connected to a pyserial URL. Nothing moves.

        Raises:
            DeviceRefused: the settings do not match the controller, or the stage is moving.
            DeviceError, DeviceTimeout: there is no connection.
        """

    def halt(self, url: str, settings: Any, clock: Clock) -> None:
        """Stop the stage, also during a move of a program that has died. It may still be slowing down when this
        returns.

        Raises:
            DeviceError, DeviceTimeout: there is no connection.
        """
