"""Guides: sources for the plan, the kinds and the angles of another program's scan: tomoscan, frame numbers, or a
PandABox."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.text import count
from beamline.plan.plan import Place
from beamline.storage.hdf5 import open_hdf5, readable
from drivers.base.frame import FrameKind
from splatline_areadetector.arrays import ArrayFrame
from splatline_areadetector.config import (
    AttributeAngles,
    PandaAngles,
    PlanAngles,
    RideSection,
    TomoscanAngles,
)
from splatline_areadetector.frame_places import BY_ORDER, UNKNOWN_KIND, BlockKey
from splatline_areadetector.plan import PlannedBlock, RidePlan
from splatline_areadetector.variables import History, Variables

LOCATIONS = {"data_dark": FrameKind.DARK, "data_white": FrameKind.FLAT, "data": FrameKind.PROJECTION}
"""For the last part of a path of Data Exchange, the kind of frame.

Tomoscan's attribute HDF5FrameLocation has such paths.
"""
_WORDS = {
    **LOCATIONS, "darkfield": FrameKind.DARK, "flatfield": FrameKind.FLAT, "projection": FrameKind.PROJECTION,
    "dark": FrameKind.DARK, "flat": FrameKind.FLAT, "white": FrameKind.FLAT,
}  # fmt: skip
EXPOSURE = "AcquireTime"
"""Attribute with the exposure time of a frame, s."""
_VIEWS = FrameKind.PROJECTION
_BEFORE, _AFTER = (Place.START, Place.BOTH), (Place.END, Place.BOTH)
_POLL = 0.1  # s between two reads of a growing file
MOST, MOST_DEGREES = 1_000_000, 1e6  # largest number of frames of a kind, and of degrees, as in a configuration
_FEW, _NEAR = 3, 0.02  # fewest rows for a step; relative tolerance for steps that add up to 180° or 360° in radians
SKEW = 0.5  # s: if the clocks of two IOCs differ by less, they count as equal


class Guide(Protocol):
    """A source for the plan of a scan, and for the kind and angle of each frame. A guide only reads."""

    def plan(self) -> RidePlan:
        """The present plan. Raises ConfigError if no plan is possible."""

    def phase(self, frame: ArrayFrame) -> BlockKey:
        """The phase of the scan in which the frame was taken."""

    unknown_angle: str
    """The reason why `angle` is NaN, as a part of a sentence."""

    def angle(self, frame: ArrayFrame, trigger: int) -> float:
        """Angle of a projection in radians; NaN: not known."""

    def ended(self, seconds: float) -> bool:
        """Whether the scan had ended at this time of its IOC."""

    @property
    def status(self) -> str:
        """Text on what the scan is doing; "" if this is not known."""

    def close(self) -> None: ...


class _Kinds:
    """The kinds of frames from an attribute; without an attribute, from the planned order."""

    def __init__(self, name: str | None) -> None:
        self._name, self._is_reported = name, False

    def __call__(self, frame: ArrayFrame) -> BlockKey:
        if self._name is None:
            return BY_ORDER
        if self._name not in frame.attributes and not self._is_reported:
            raise ConfigError(_lacking("kinds", self._name, frame))
        word = frame.attributes.get(self._name)
        if word is None or not str(word).strip():  # while its variable is not connected
            return UNKNOWN_KIND
        self._is_reported = True
        return BlockKey(0, kind_of(word))


def _lacking(key: str, name: str, frame: ArrayFrame) -> str:
    return (
        f"The frames have no attribute {name} (ride.{key}); they have {', '.join(frame.attributes) or 'none'}. Add "
        f"{name} to the camera's NDAttributesFile, or change ride.{key}. Earlier frames, if there were any, are in "
        "the file."
    )


def seconds_of(value: Any) -> float | None:
    """The time in s that an attribute or a variable holds; None if it holds no time."""
    return float(value) if isinstance(value, int | float) and 0 < value <= MOST else None


def kind_of(word: Any) -> FrameKind | None:
    """The kind that an attribute names: a path of Data Exchange, or a word such as FlatField; None: neither."""
    return _WORDS.get(str(word).strip().rstrip("/").rpartition("/")[2].lower())


class _ByNumbers:
    """A scan whose plan is in the configuration."""

    status, angle_source, unknown_angle = "", "plan", "the angle is not known"

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
        return RidePlan(self._blocks, self._angles, known, self._ride.period_s, self.angle_source)

    def phase(self, frame: ArrayFrame) -> BlockKey:
        return self._kinds(frame)

    def angle(self, frame: ArrayFrame, trigger: int) -> float:
        return float(self._angles[trigger])

    def ended(self, seconds: float) -> bool:
        return False

    def close(self) -> None:
        pass


class PlanGuide(_ByNumbers):
    """A scan with equal steps, counted from the first projection."""

    def __init__(self, ride: RideSection, angles: PlanAngles) -> None:
        steps = np.arange(angles.views, dtype=np.float64)
        super().__init__(ride, np.radians(angles.start_deg + angles.step_deg * steps))


class AttributeGuide(_ByNumbers):
    """A step scan whose frames have an attribute with the angle."""

    angle_source = "attribute"

    def __init__(self, ride: RideSection, angles: AttributeAngles) -> None:
        super().__init__(ride, np.full(angles.views, np.nan))
        self._name, self._seen = angles.name, False
        self.unknown_angle = f"the attribute {angles.name} with the angle is missing, or is not an angle in degrees"

    def phase(self, frame: ArrayFrame) -> BlockKey:
        self._seen = self._seen or self._name in frame.attributes
        return super().phase(frame)

    def angle(self, frame: ArrayFrame, trigger: int) -> float:
        """ConfigError: neither this projection nor any frame before it has the attribute."""
        if not self._seen:
            raise ConfigError(_lacking("angles.name", self._name, frame))
        try:
            return _angle(float(frame.attributes[self._name]))
        except (KeyError, TypeError, ValueError):
            return math.nan


def _angle(degrees: float) -> float:
    """Radians; NaN if the value cannot be the position of a stage."""
    return math.radians(degrees) if abs(degrees) <= MOST_DEGREES else math.nan


class PandaGuide(_ByNumbers):
    """A fly scan whose angles are in the file of a PandABox: row n belongs to trigger n.

    Args:
        wait: time in s to wait for a row that the file does not have yet.

    Raises:
        ConfigError: the file exists, but its rows are not angles in degrees, at most one for each projection.
    """

    angle_source = "panda"

    def __init__(self, ride: RideSection, angles: PandaAngles, wait: float = 2.0) -> None:
        super().__init__(ride, np.full(angles.views, np.nan))
        self._settings, self._wait, self._path = angles, wait, Path(angles.file)
        self._rows, self._waited_at = np.empty(0), -1  # number of rows when a further row did not come in time
        if (problem := self._look()) and self._path.exists():
            raise ConfigError(f"{problem}. Nothing was started.")

    @property
    def status(self) -> str:  # type: ignore[override]
        """A sentence with the number of rows, and the first and the last angle. With it the operator can see whether
        the file belongs to this scan."""
        if not self._rows.size:
            return f"{self._path} {'has no rows' if self._path.exists() else 'does not exist'} yet"
        ends = " to ".join(f"{math.degrees(self._radians(i)):.6g}°" for i in (0, -1))
        rows = count(self._rows.size, "row")
        return (
            f"{self._path} has {rows}, with angles {ends}. The scan gets these angles, unless the PandABox writes "
            "the file again"
        )

    def plan(self) -> RidePlan:
        self._rows, self._waited_at, deadline = np.empty(0), -1, time.monotonic() + self._wait
        while (problem := self._look()) and time.monotonic() < deadline:
            time.sleep(_POLL)
        # otherwise the file may come only after darks and flats
        begins = self._blocks[0].kind is _VIEWS and self._ride.kinds is None
        if problem and (begins or self._path.exists()):
            raise ConfigError(f"{problem}. Nothing was recorded.")
        return super().plan()

    def angle(self, frame: ArrayFrame, trigger: int) -> float:
        deadline = time.monotonic() + self._wait
        while trigger >= self._rows.size:
            problem = self._look()
            if trigger >= (n := self._rows.size) and (n == self._waited_at or time.monotonic() > deadline):
                self._waited_at = n
                if problem and not n:
                    raise DataError(f"No projection has an angle: {problem}. Earlier frames are in the file.")
                return math.nan
            if trigger >= n:
                time.sleep(_POLL)
        return self._radians(trigger)

    def _radians(self, row: int) -> float:
        return _angle(self._settings.offset_deg + self._settings.deg_per_unit * float(self._rows[row]))

    def _look(self) -> str:
        """Read the present rows of the file. Returns the fault of the file, without a full stop; "" if it has no
        fault."""
        name, views = self._settings.dataset, self._settings.views
        if not self._path.exists():
            return f"{self._path} (ride.angles.file) does not exist"
        try:
            with closing(open_hdf5(self._path)) as file, readable(self._path):
                rows = file.get(name)
                problem, n = _panda_problem(rows), getattr(rows, "size", 0) or 0
                if not problem:
                    self._rows = np.asarray(rows[:views], np.float64)
                    problem = _unit_problem(self._rows, self._settings)
        except DataError as error:
            return str(error).removesuffix(".")
        if n > views and not problem:
            problem = (
                f"has {n} rows, but ride.angles.views is {views}. If the file belongs to another scan, move the "
                "file away; otherwise correct ride.angles.views"
            )
        return problem and f"{self._path}: {name} {problem}"


def _panda_problem(rows: Any) -> str:
    """Why a dataset cannot hold the positions at the triggers, as the end of a sentence; "" if it can."""
    if not isinstance(rows, h5py.Dataset):
        what = "does not exist" if rows is None else "is a group"
    elif rows.dtype.kind not in "iuf":
        what = f"holds {'text' if rows.dtype.kind in 'SO' else rows.dtype}, not numbers"
    elif rows.ndim != 1:
        what = f"has the shape {rows.shape}, not one number for each trigger"
    else:
        return ""
    return (
        f"{what}; set ride.angles.dataset to the dataset with the positions, such as "
        f"{PandaAngles.model_fields['dataset'].default}"
    )


def _unit_problem(rows: NDArray[np.float64], settings: PandaAngles) -> str:
    """Why rows are not degrees, as the end of a sentence; "" if they can be, or if the configuration states their
    unit."""
    known = rows[np.isfinite(rows)]
    degrees = settings.offset_deg + settings.deg_per_unit * known
    if known.size and (np.abs(degrees) > MOST_DEGREES).all():
        return (
            f"gives angles that are all more than {MOST_DEGREES:g} degrees from zero (positions {known.min():.7g} "
            f"to {known.max():.7g}). If the positions are encoder counts, set ride.angles.deg_per_unit; set "
            "ride.angles.offset_deg to bring the first angle near zero"
        )
    if rows.size < _FEW or "deg_per_unit" in settings.model_fields_set:
        return ""
    step = 0.0 if known.size < _FEW else float(np.median(np.abs(np.diff(known))))
    if not step:
        whole = rows.size == settings.views
        if not whole:
            return ""
        some = f"only {known.size} positions" if known.size < _FEW else "the same position"
        return f"has {some} in its {rows.size} rows"
    spans = step * np.array([[settings.views], [settings.views - 1]])
    if (np.abs(spans / (math.pi * np.array([1, 2])) - 1) < _NEAR).any():
        return (
            f"has steps of {step:.4g}, which look like radians; set ride.angles.deg_per_unit to "
            f"{math.degrees(1):.7g} (or, if the positions are degrees, to 1)"
        )
    if step > 180 or (spans[0] > 400 and not (known % 1).any()):
        return (
            f"has steps of {step:.6g}, which look like encoder counts; set ride.angles.deg_per_unit to 360 / counts "
            "per turn (or, if the positions are degrees, to 1)"
        )
    return ""


_NEEDED = ("RotationStart", "RotationStep", "NumAngles", "ScanStatus")
_TOMOSCAN = (
    *_NEEDED, "NumDarkFields", "DarkFieldMode", "NumFlatFields", "FlatFieldMode", "ExposureTime", "FlatExposureTime",
    "DifferentFlatExposure", "FrameType",
)  # fmt: skip
_KINDS = {"dark": FrameKind.DARK, "flat": FrameKind.FLAT, "proj": FrameKind.PROJECTION}
_COLLECTING = "collecting "
_PREPARING = ("programming", "taxi", "moving", "homing", "setting")
"""Beginnings of ScanStatus between two blocks, or within a block. Any other status ends the block."""


class TomoscanGuide:
    """A scan run by tomoscan: its status gives the kinds, its numbers the plan. ScanStatus changes before the first and
    after the last frame of a block, so the time of a frame gives its kind.

    Args:
        now: clock, for tests.

    Raises:
        DeviceTimeout: tomoscan does not answer.
    """

    unknown_angle = "tomoscan's plan has no angle for this frame"

    def __init__(self, ride: RideSection, angles: TomoscanAngles, now: Callable[[], float] = time.time) -> None:
        self._ride, self._prefix = ride, angles.prefix
        self._kinds = None if ride.kinds is None else _Kinds(ride.kinds)
        self._variables = Variables(angles.prefix, _TOMOSCAN, _NEEDED, now)
        self._delay, self._longest = math.inf, -math.inf  # s, shortest and longest delay of a frame
        self._angles = np.empty(0)

    @property
    def status(self) -> str:
        return self._variables.text("ScanStatus")

    def plan(self) -> RidePlan:
        number, text = self._variables.number, self._variables.text
        views, start, step = (number(name) or 0.0 for name in ("NumAngles", "RotationStart", "RotationStep"))
        darks, flats = (number(f"Num{name}Fields") or 0.0 for name in ("Dark", "Flat"))
        numbers = all(abs(angle) <= MOST_DEGREES for angle in (start, step))
        numbers = numbers and all(0 <= n <= MOST for n in (darks, flats, views))
        if not numbers or views < 1 or (views > 1 and step == 0.0):
            raise ConfigError(
                f"tomoscan's settings give no angles: {self._prefix}NumAngles is {views:g}, RotationStep {step:g}, "
                f"RotationStart {start:g}, NumDarkFields {darks:g}, NumFlatFields {flats:g}. Set these variables in "
                "tomoscan before the scan begins. Nothing was recorded."
            )
        self._angles = np.radians(start + step * np.arange(int(views), dtype=np.float64))
        counts = {
            FrameKind.DARK: (int(darks), text("DarkFieldMode")),
            FrameKind.FLAT: (int(flats), text("FlatFieldMode")),
        }
        before = [PlannedBlock(kind, n) for kind, (n, mode) in counts.items() if n and mode in ("Start", "Both")]
        after = [PlannedBlock(kind, n) for kind, (n, mode) in counts.items() if n and mode in ("End", "Both")]
        exposure = number("ExposureTime")
        flat = number("FlatExposureTime") if text("DifferentFlatExposure") == "Different" else None
        exposures = {FrameKind.PROJECTION: self._ride.exposure_s or exposure, FrameKind.FLAT: flat}
        return RidePlan(
            (*before, PlannedBlock(FrameKind.PROJECTION, int(views)), *after[::-1]),
            self._angles,
            {kind: seconds for kind, seconds in exposures.items() if seconds},
            self._ride.period_s,
            "tomoscan",
        )

    def phase(self, frame: ArrayFrame) -> BlockKey:
        if not frame.is_current:
            delay = frame.received - frame.time
            self._delay, self._longest = min(self._delay, delay), max(self._longest, delay)
        serial, kind = self._collecting(frame.time)
        if kind is None or self._kinds is None:
            return BlockKey(serial, kind)
        told_kind = self._kinds(frame)
        return BlockKey(serial, kind if told_kind == UNKNOWN_KIND else told_kind.kind)

    def _collecting(self, seconds: float) -> tuple[int, FrameKind | None]:
        """The number of the status message that was valid at this time of the camera's IOC, and the kind it names."""
        statuses = [str(each).strip().lower() for each in self._at(self._variables.histories["ScanStatus"], seconds)]
        for i in range(len(statuses), 0, -1):
            if statuses[i - 1].startswith(_COLLECTING):
                word = statuses[i - 1].removeprefix(_COLLECTING)[:4]
                return i, self._agreed(_KINDS.get(word), seconds)
            if not statuses[i - 1].startswith(_PREPARING):
                break
        return 0, None

    def _agreed(self, kind: FrameKind | None, seconds: float) -> FrameKind | None:
        """The kind, unless FrameType contradicts it. It does so between two blocks, and while darks are taken again
        during streaming."""
        types = self._at(self._variables.histories["FrameType"], seconds)
        return kind if not types or kind_of(types[-1]) in (kind, None) else None

    def _at(self, history: History, seconds: float) -> list[Any]:
        """The values until a time of the camera's IOC, whose clock may differ from that of tomoscan. The clocks count
        as different only if they differ by more than the delays of frames do. On a busy computer the delays differ a
        lot, and values also come late."""
        skew = 0.0 if history.delay is None or math.isinf(self._delay) else self._delay - history.delay
        return [*history.until(seconds + (skew if abs(skew) > SKEW + self._longest - self._delay else 0.0))]

    def angle(self, frame: ArrayFrame, trigger: int) -> float:
        return float(self._angles[trigger]) if trigger < self._angles.size else math.nan

    def ended(self, seconds: float) -> bool:
        last = self.status.strip().lower()
        over = not last.startswith((_COLLECTING, *_PREPARING))
        return over and self._variables.histories["ScanStatus"].changed_at <= seconds

    def close(self) -> None:
        self._variables.close()


def guide_of(ride: RideSection) -> Guide:
    """The guide that the configuration asks for, connected."""
    match ride.angles:
        case TomoscanAngles():
            return TomoscanGuide(ride, ride.angles)
        case AttributeAngles():
            return AttributeGuide(ride, ride.angles)
        case PandaAngles():
            return PandaGuide(ride, ride.angles)
    return PlanGuide(ride, ride.angles)
