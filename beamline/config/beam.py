"""Configuration of devices in the beam: beam monitor, shutters, monochromator, and devices with named positions."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from beamline.config.section import Section
from beamline.config.stages import StageConfig
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.base.protocols import BeamMonitor, ConnectedFilter, ConnectedMonochromator, ConnectedShutter
from drivers.in_beam import INSIDE, OUTSIDE, PlacedStage, StagePlaces, StageSampleMover
from recon.base.setting import Setting, setting

Name = Annotated[str, Setting(min_length=1, max_length=80)]


class MotorSection(Section):
    """A separate motor, of any kind of stage. For a linear axis, every key with deg in its name is in the unit of the
    axis (such as mm).
    """

    speed_deg_s: float | None = setting(None, "null: the stage's max_speed_deg_s.", gt=0)
    stage: Annotated[StageConfig, Field(discriminator="kind")]

    def refuse_unreachable(self, places: Mapping[str, float]) -> None:
        figures = self.stage.settings
        low, high, fastest = (math.degrees(rad) for rad in (figures.low, figures.high, figures.max_speed))
        for name, place in places.items():
            if not low - 1e-9 <= place <= high + 1e-9:
                raise ValueError(
                    f"{name} {place:g} is beyond the limits of the stage of this device, {low:g} ... {high:g}"
                )
        if self.speed_deg_s is not None and self.speed_deg_s > fastest * (1 + 1e-9):
            raise ValueError(f"speed_deg_s {self.speed_deg_s:g} is above max_speed_deg_s of the stage of this device")

    def _places(self, degrees: Mapping[str, float], failed: str) -> StagePlaces:
        speed = self.stage.settings.max_speed if self.speed_deg_s is None else math.radians(self.speed_deg_s)
        return StagePlaces({name: math.radians(place) for name, place in degrees.items()}, speed, failed)

    def _connected(self, name: str, places: StagePlaces, clock: Clock, url: str | None) -> PlacedStage:
        try:
            return PlacedStage(self.stage.connect(clock, url), places, clock, name)
        except DeviceError as cause:
            raise cause.told_by(name, cause.problem) from cause


class StageMover(MotorSection):
    """A motor that moves the sample out of the beam for flats, between two positions."""

    kind: Literal["stage"]
    in_deg: float = setting(doc="Position of the sample in the beam.")
    out_deg: float = setting(doc="Position of the sample while flats are taken.")
    mm_per_deg: float | None = setting(
        None,
        "Distance in mm that the sample moves across the beam if the position of the mover changes by one unit; "
        "positive: towards higher columns of the frame. null: unknown, or the sample does not move across the beam.",
        ge=-1e3,
        le=1e3,
    )

    @model_validator(mode="after")
    def _places_can_be_reached(self) -> Self:
        self.refuse_unreachable({"in_deg": self.in_deg, "out_deg": self.out_deg})
        if self.in_deg == self.out_deg:
            raise ValueError(f"in_deg and out_deg are both {self.in_deg:g}, so flats would show the sample")
        return self

    def connect(self, clock: Clock, url: str | None = None) -> StageSampleMover:
        """Connect the mover at its port, or at `url`. Nothing moves.

        Raises: DeviceError: the stage of the mover does not answer, or is of the wrong kind.
        """
        places = self._places({INSIDE: self.in_deg, OUTSIDE: self.out_deg}, "the sample did not move")
        rad_per_mm = math.radians(1 / self.mm_per_deg) if self.mm_per_deg else math.nan
        return StageSampleMover(self._connected("sample mover", places, clock, url), rad_per_mm)


class NoFilter(Section):
    kind: Literal["none"] = "none"
    places: ClassVar[Sequence[str]] = ()


class NamedFilter(Section):
    """A filter whose positions have only names. Either the filter is simulated, without an effect on the intensity, or
    the operator changes it by hand."""

    kind: Literal["simulated", "manual"]
    places: Annotated[tuple[Name, ...], Setting(min_length=1)]

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        if twice := [name for name in dict.fromkeys(self.places) if self.places.count(name) > 1]:
            repeated = ", ".join(twice)
            raise ValueError(f"places lists {repeated} more than once; each place needs its own name")
        return self


class MotorFilter(MotorSection):
    """Filters on a motor."""

    kind: Literal["stage"]
    places: dict[Name, float] = setting(doc="Name: deg.", min_length=1)

    @model_validator(mode="after")
    def _places_can_be_reached(self) -> Self:
        self.refuse_unreachable(self.places)
        refuse_equal(self.places)
        return self

    def connect(self, clock: Clock, url: str | None = None) -> PlacedStage:
        """Connect the motor; see `StageMover.connect`."""
        return self._connected("filter", self._places(self.places, "the filter did not move to"), clock, url)


class FoundFilter(Section):
    """Filters of a family of devices, see `beamline.config.families`."""

    if TYPE_CHECKING:
        kind: str
        places: Mapping[str, float | str]

    def connect(self, clock: Clock) -> ConnectedFilter:
        """Connect the filter; see `StageMover.connect`."""
        raise NotImplementedError


def refuse_equal(places: Mapping[str, float | str]) -> None:
    """Raise ValueError if two positions have the same value."""
    if len(set(places.values())) < len(places):
        raise ValueError("two positions have the same value; give each position a different value")


class BeamMonitorSection(Section):
    """Keys that all beam monitors share. Each kind is listed in BEAM_MONITORS of a folder of `beamline.config`."""

    counterpart: ClassVar[str | None] = None
    """Name of the simulated counterpart, whose port is sim:// with this name; None if there is no simulated
    counterpart."""

    unit: str
    scale: float = setting(1.0, "Factor that converts the reading to `unit`.", gt=0)
    timeout_s: float = setting(2.0, gt=0, le=1e6)
    period_s: float = setting(
        1.0, "Time in s between two readings during a scan. The readings are stored in the scan file.", gt=0, le=1e6
    )
    pause_below: float | None = setting(
        None, "The scan pauses if the reading falls below this value, in the unit of the key `unit`; null: never.", gt=0
    )
    resume_above: float | None = setting(
        None,
        "A paused scan continues when the reading reaches this value, in the unit of the key `unit`; null: 1.1 times "
        "pause_below.",
        gt=0,
    )
    settle_s: float = setting(5.0, "Time in s for which the beam must be back before the scan continues.", ge=0)

    @model_validator(mode="after")
    def _resumes_where_it_would_not_pause(self) -> Self:
        if self.pause_below is None and self.resume_above is not None:
            raise ValueError("resume_above needs pause_below: set both, or neither")
        if self.pause_below is not None and self.resumes_at < self.pause_below:
            raise ValueError(f"resume_above {self.resumes_at:g} is below pause_below {self.pause_below:g}")
        return self

    @property
    def resumes_at(self) -> float:
        """Intensity in `unit` above which a paused scan resumes."""
        return self.resume_above or 1.1 * (self.pause_below or 0.0)

    @property
    def simulated(self) -> bool:
        return False

    @abstractmethod
    def connect(self, clock: Clock, url: str | None = None) -> BeamMonitor:
        """Connect the beam monitor, or its simulated counterpart at `url`. Raises DeviceError if it cannot be
        opened."""


class NoBeamMonitor(Section):
    kind: Literal["none"] = "none"
    counterpart: ClassVar[None] = None
    simulated: ClassVar[bool] = False


class StageOutputShutter(Section):
    """A shutter on a digital output of the controller of the stage. The controller must have outputs that can be
    set."""

    kind: Literal["stage_output"]
    output: int = setting(
        doc="Number of the digital output that moves the blade. The output of the trigger pulses cannot be used.", gt=0
    )
    open_high: bool = setting(True, "true: a high output opens the shutter.")
    settle_s: float = setting(0.1, "Time in s that the blade needs to open or close.", ge=0)


class FoundShutter(Section):
    """A shutter of a family of devices, see `beamline.config.families`."""

    if TYPE_CHECKING:
        kind: str

    def connect(self, clock: Clock) -> ConnectedShutter:
        """Connect the shutter. Nothing moves. Raises DeviceError if it does not answer."""
        raise NotImplementedError


Kev = Annotated[float, Setting(gt=0, le=1e6)]


class NoMonochromator(Section):
    kind: Literal["none"] = "none"


class _Monochromator(Section):
    range_kev: tuple[Kev, Kev] | None = setting(None, "Lowest and highest energy that a scan may set; null: no limits.")

    @model_validator(mode="after")
    def _range_rises(self) -> Self:
        if self.range_kev is not None and self.range_kev[0] > self.range_kev[1]:
            low, high = self.range_kev
            raise ValueError(f"range_kev is {low:g} ... {high:g}; expected the lower energy first")
        return self


class SceneMonochromator(_Monochromator):
    """Sets the energy of the simulated beam. At the start it is the energy of the scene."""

    kind: Literal["simulated"]
    settle_s: float = setting(1.0, "Time that each move takes.", ge=0, le=1e6)


class HandMonochromator(_Monochromator):
    """A monochromator that the operator sets on request."""

    kind: Literal["manual"]


class FoundMonochromator(_Monochromator):
    """A monochromator of a family of devices, see `beamline.config.families`."""

    kind: str

    @property
    def stops(self) -> bool:
        """True if the monochromator can be stopped."""
        raise NotImplementedError

    def connect(self, clock: Clock) -> ConnectedMonochromator:
        """Connect the monochromator. Nothing moves. Raises DeviceError if it does not answer."""
        raise NotImplementedError

    def halt(self, clock: Clock) -> None:
        """Stop the monochromator. Raises DeviceError."""
        with closing(self.connect(clock)) as connected:
            connected.stop()
