"""Guides: what tells the plan of a ridden scan and its frames' kinds and angles: tomoscan, numbers, a PandABox."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.plan.plan import Place
from beamline.storage.hdf5 import open_hdf5
from drivers.base.frame import FrameKind
from splatline_areadetector.arrays import ArrayFrame
from splatline_areadetector.config import (
    AttributeAngles,
    PandaAngles,
    PlanAngles,
    RideSection,
    TomoscanAngles,
)
from splatline_areadetector.plan import PlannedBlock, RidePlan
from splatline_areadetector.sorter import BY_ORDER, NOT_TOLD, Phase
from splatline_areadetector.variables import History, Variables

LOCATIONS = {"data_dark": FrameKind.DARK, "data_white": FrameKind.FLAT, "data": FrameKind.PROJECTION}
"""Last part of a path of Data Exchange -> kind; tomoscan's attribute HDF5FrameLocation has such paths."""
_WORDS = {
    **LOCATIONS, "darkfield": FrameKind.DARK, "flatfield": FrameKind.FLAT, "projection": FrameKind.PROJECTION,
    "dark": FrameKind.DARK, "flat": FrameKind.FLAT, "white": FrameKind.FLAT,
}  # fmt: skip
EXPOSURE = "AcquireTime"
"""Attribute with the exposure of a frame, s."""
_VIEWS = FrameKind.PROJECTION
_BEFORE, _AFTER = (Place.START, Place.BOTH), (Place.END, Place.BOTH)
_POLL = 0.1  # s between two looks at a file that grows
SKEW = 0.5  # s by which the clocks of two IOCs may differ and still count as set alike


class Guide(Protocol):
    """Tells what a scan plans, and of each frame its kind and angle. It only reads."""

    def plan(self) -> RidePlan:
        """The plan as it stands now. ConfigError where it cannot be."""

    def phase(self, frame: ArrayFrame) -> Phase:
        """What the scan did while the frame was taken."""

    def angle(self, frame: ArrayFrame, trigger: int) -> float:
        """Radians of a projection; NaN: nothing tells it."""

    def ended(self, seconds: float) -> bool:
        """Whether the scan had ended by this time of its IOC."""

    @property
    def status(self) -> str:
        """What the scan is doing, in words; "" where nothing tells."""

    def close(self) -> None: ...


class _Kinds:
    """The kinds of frames by an attribute; without one, by the planned order."""

    def __init__(self, name: str | None) -> None:
        self._name, self._is_told = name, False

    def __call__(self, frame: ArrayFrame) -> Phase:
        if self._name is None:
            return BY_ORDER
        if self._name not in frame.attributes and not self._is_told:
            raise ConfigError(_lacking("kinds", self._name, frame))
        word = frame.attributes.get(self._name)
        if word is None or not str(word).strip():  # of a variable that is not connected for a while
            return NOT_TOLD
        self._is_told = True
        return Phase(0, kind_of(word))


def _lacking(key: str, name: str, frame: ArrayFrame) -> str:
    return (
        f"ride.{key} is {name}, an attribute that the frames do not have; they have "
        f"{', '.join(frame.attributes) or 'none'}. Add it to the camera's NDAttributesFile, or change ride.{key}. "
        "Nothing was recorded."
    )


def kind_of(word: Any) -> FrameKind | None:
    """The kind that an attribute names: a path of Data Exchange, or a word such as FlatField; None: no kind."""
    return _WORDS.get(str(word).strip().rstrip("/").rpartition("/")[2].lower())


class _ByNumbers:
    """A scan whose plan stands in the configuration."""

    status, told_by = "", "plan"

    def __init__(self, ride: RideSection, angles: NDArray[np.float64]) -> None:
        self._ride, self._angles = ride, angles
        fields = ((FrameKind.DARK, ride.darks), (FrameKind.FLAT, ride.flats))
        before = [PlannedBlock(kind, each.count) for kind, each in fields if each.count and each.at in _BEFORE]
        after = [PlannedBlock(kind, each.count) for kind, each in fields if each.count and each.at in _AFTER]
        self._blocks = (*before, PlannedBlock(FrameKind.PROJECTION, len(angles)), *after[::-1])
        self._kinds = _Kinds(ride.kinds)

    def plan(self) -> RidePlan:
        seconds = {
            FrameKind.PROJECTION: self._ride.exposure_s,
            FrameKind.DARK: self._ride.darks.exposure_s,
            FrameKind.FLAT: self._ride.flats.exposure_s,
        }
        known = {kind: each for kind, each in seconds.items() if each is not None}
        return RidePlan(self._blocks, self._angles, known, self._ride.period_s, self.told_by)

    def phase(self, frame: ArrayFrame) -> Phase:
        return self._kinds(frame)

    def angle(self, frame: ArrayFrame, trigger: int) -> float:
        return float(self._angles[trigger])

    def ended(self, seconds: float) -> bool:
        return False

    def close(self) -> None:
        pass


class PlanGuide(_ByNumbers):
    """Equal steps from the first projection."""

    def __init__(self, ride: RideSection, angles: PlanAngles) -> None:
        steps = np.arange(angles.views, dtype=np.float64)
        super().__init__(ride, np.radians(angles.start_deg + angles.step_deg * steps))


class AttributeGuide(_ByNumbers):
    """The angle of each frame of a step scan by an attribute."""

    told_by = "attribute"

    def __init__(self, ride: RideSection, angles: AttributeAngles) -> None:
        super().__init__(ride, np.full(angles.views, np.nan))
        self._name = angles.name

    def phase(self, frame: ArrayFrame) -> Phase:
        if self._name not in frame.attributes:
            raise ConfigError(_lacking("angles.name", self._name, frame))
        return super().phase(frame)

    def angle(self, frame: ArrayFrame, trigger: int) -> float:
        try:
            return math.radians(float(frame.attributes[self._name]))
        except (KeyError, TypeError, ValueError):
            return math.nan


class PandaGuide(_ByNumbers):
    """The angle of each frame of a fly scan by a PandABox's file: row n is trigger n.

    Args:
        wait: s for a row that the file does not have yet.
    """

    told_by = "panda"

    def __init__(self, ride: RideSection, angles: PandaAngles, wait: float = 2.0) -> None:
        super().__init__(ride, np.full(angles.views, np.nan))
        self._settings, self._wait, self._rows = angles, wait, np.empty(0)

    def angle(self, frame: ArrayFrame, trigger: int) -> float:
        deadline = time.monotonic() + self._wait
        while trigger >= self._rows.size:
            self._refresh()
            if time.monotonic() > deadline:
                return math.nan
            if trigger >= self._rows.size:
                time.sleep(_POLL)
        settings = self._settings
        return math.radians(settings.offset_deg + settings.deg_per_unit * float(self._rows[trigger]))

    def _refresh(self) -> None:
        path, name = Path(self._settings.file), self._settings.dataset
        if not path.exists():
            return
        with closing(open_hdf5(path)) as file:
            if name not in file:
                raise DataError(f"{path} has no {name}; ride.angles.dataset names the position at each trigger.")
            self._rows = np.asarray(file[name][()], np.float64)


_NEEDED = ("RotationStart", "RotationStep", "NumAngles", "ScanStatus")
_TOMOSCAN = (
    *_NEEDED, "NumDarkFields", "DarkFieldMode", "NumFlatFields", "FlatFieldMode", "ExposureTime", "FlatExposureTime",
    "DifferentFlatExposure", "FrameType",
)  # fmt: skip
_KINDS = {"dark": FrameKind.DARK, "flat": FrameKind.FLAT, "proj": FrameKind.PROJECTION}
_COLLECTING = "collecting "
_PREPARING = ("programming", "taxi", "moving", "homing", "setting")
"""Beginnings of what ScanStatus says between two blocks, or within one; all else ends it."""


class TomoscanGuide:
    """A scan by tomoscan: its status tells kinds, its numbers the plan. ScanStatus changes before a block's first
    frame and after its last, so that a frame's kind is that of its time.

    Args:
        now: for tests.

    Raises:
        DeviceTimeout: tomoscan does not answer.
    """

    def __init__(self, ride: RideSection, angles: TomoscanAngles, now: Callable[[], float] = time.time) -> None:
        self._ride, self._prefix = ride, angles.prefix
        self._kinds = None if ride.kinds is None else _Kinds(ride.kinds)
        self._variables = Variables(angles.prefix, _TOMOSCAN, _NEEDED, now)
        self._delay = math.inf  # of frames
        self._angles = np.empty(0)

    @property
    def status(self) -> str:
        return self._variables.text("ScanStatus")

    def plan(self) -> RidePlan:
        number, text = self._variables.number, self._variables.text
        views = int(number("NumAngles") or 0)
        start, step = number("RotationStart") or 0.0, number("RotationStep") or 0.0
        if views < 1 or (views > 1 and step == 0.0):
            raise ConfigError(
                f"{self._prefix}NumAngles is {views}, RotationStep {step:g}: no angles follow from them. Set them in "
                "tomoscan before its scan begins. Nothing was recorded."
            )
        self._angles = np.radians(start + step * np.arange(views, dtype=np.float64))
        counts = {
            kind: (int(number(f"Num{name}Fields") or 0), text(f"{name}FieldMode"))
            for kind, name in ((FrameKind.DARK, "Dark"), (FrameKind.FLAT, "Flat"))
        }
        before = [PlannedBlock(kind, n) for kind, (n, mode) in counts.items() if n and mode in ("Start", "Both")]
        after = [PlannedBlock(kind, n) for kind, (n, mode) in counts.items() if n and mode in ("End", "Both")]
        exposure = number("ExposureTime")
        flat = number("FlatExposureTime") if text("DifferentFlatExposure") == "Different" else None
        exposures = {FrameKind.PROJECTION: self._ride.exposure_s or exposure, FrameKind.FLAT: flat}
        return RidePlan(
            (*before, PlannedBlock(FrameKind.PROJECTION, views), *after[::-1]),
            self._angles,
            {kind: seconds for kind, seconds in exposures.items() if seconds},
            self._ride.period_s,
            "tomoscan",
        )

    def phase(self, frame: ArrayFrame) -> Phase:
        if not frame.is_current:
            self._delay = min(self._delay, frame.received - frame.time)
        serial, kind = self._collecting(frame.time)
        if kind is None or self._kinds is None:
            return Phase(serial, kind)
        told = self._kinds(frame)
        return Phase(serial, kind if told == NOT_TOLD else told.kind)

    def _collecting(self, seconds: float) -> tuple[int, FrameKind | None]:
        """The number of the status that said what is collected at this time of the camera's IOC, and of what kind."""
        statuses = [str(each).strip().lower() for each in self._at(self._variables.histories["ScanStatus"], seconds)]
        for i in range(len(statuses), 0, -1):
            if statuses[i - 1].startswith(_COLLECTING):
                word = statuses[i - 1].removeprefix(_COLLECTING)[:4]
                return i, self._agreed(_KINDS.get(word), seconds)
            if not statuses[i - 1].startswith(_PREPARING):
                break
        return 0, None

    def _agreed(self, kind: FrameKind | None, seconds: float) -> FrameKind | None:
        """The kind, unless FrameType contradicts it: it does between two blocks, and in a stream while darks are
        taken again."""
        types = self._at(self._variables.histories["FrameType"], seconds)
        return kind if not types or kind_of(types[-1]) in (kind, None) else None

    def _at(self, history: History, seconds: float) -> list[Any]:
        """The values until a time of the camera's IOC, whose clock may be another than tomoscan's."""
        skew = 0.0 if history.delay is None or math.isinf(self._delay) else self._delay - history.delay
        return [*history.until(seconds + (skew if abs(skew) > SKEW else 0.0))]

    def angle(self, frame: ArrayFrame, trigger: int) -> float:
        return float(self._angles[trigger]) if trigger < self._angles.size else math.nan

    def ended(self, seconds: float) -> bool:
        last = self.status.strip().lower()
        over = not last.startswith((_COLLECTING, *_PREPARING))
        return over and self._variables.histories["ScanStatus"].changed_at <= seconds

    def close(self) -> None:
        self._variables.close()


def guide_of(ride: RideSection) -> Guide:
    """The guide that the configuration names, connected."""
    match ride.angles:
        case TomoscanAngles():
            return TomoscanGuide(ride, ride.angles)
        case AttributeAngles():
            return AttributeGuide(ride, ride.angles)
        case PandaAngles():
            return PandaGuide(ride, ride.angles)
    return PlanGuide(ride, ride.angles)
