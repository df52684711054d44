"""Check: the interface of the checks of the monitor, with their input (ScanContext) and their result (CheckResult).

A check is a frozen dataclass whose fields are its limits; `beamline.monitor.checks` lists all of them. It looks at one
frame after another and carries what it needs to remember as an immutable state, so that a scan can be replayed.
"""

from __future__ import annotations

import math
from dataclasses import Field, dataclass
from enum import StrEnum
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from beamline.core.flag import Flag as Flag
from beamline.core.flag import Level as Level
from beamline.monitor.change import SampleChange
from beamline.monitor.digest import FrameDigest
from beamline.monitor.view import NO_SPOTS, CellGrid, CellView, Spots
from drivers.base.frame import Frame

State = TypeVar("State")


class Policy(StrEnum):
    """Effect of a check's alarms on the scan."""

    LOG = "log"  # write it down: file, events, report
    WARN = "warn"  # and print it on the terminal
    PAUSE = "pause"  # and hold the scan until the operator or the check says that it may go on
    STOP = "stop"  # and end the scan cleanly, as the first Ctrl-C does


@dataclass(frozen=True, eq=False)
class ScanContext:
    """Input of the checks: the scan, the references so far, and quantities of the frame that several checks need.

    Attributes:
        saturation: the count from which a pixel is saturated.
        pixels: of a frame.
        period: s between the triggers of a fly scan; None where frames come when the stage is ready (step scan).
        step: rad from a view to the next, as planned: the median, with its sign; NaN: not known, or they do not turn
            one way.
        frames_per_view: at each angle; only the first of a view is compared with views before.
        stored: views that are in an earlier file of the scan.
        cone: the beam is one; else it is parallel.
        axis_col: the axis as the scan states it, in columns of pixels; None where it does not.
        integrals: frames were line integrals, and are judged as counts of a beam without flats of its own.
        dark, flat: float32 [preview row, preview col] mean of the latest group of darks and of flats, None before any.
        flat_exposure: s of these flats, which may have an exposure of their own.
        grid: the cells of the views; None before the first projection.
        spots: bright pixels of views and flats that the previous frame lacks.
        follows: checks may compare it with the previous view, its neighbour in angle. False for repeated views, at a
            new pass, and after views of another file: such checks begin anew there. True for the first view, and where
            `step` is not known.
        light_left: of this view, over the last good one, see beamline.monitor.view.light_left; 1 where it is no
            projection.
        view: the frame on this grid; None where it is no projection, or has no light, or is not its view's first.
        truncated: the sample is wider than the field, in this view or earlier ones; or flats are missing.
        dimmer: logarithm of the light that the beam has lost since the flats, as air beside the sample shows it; NaN
            where none has shown it yet.
        shake: pixels across and down by which a view stands beside the sample's way at random, standard deviations; 0
            where noise alone may give as much.
        change: the part that turning since the views before does not explain; None where these are too few, or at
            uneven steps.
    """

    saturation: float
    pixels: int
    period: float | None = None
    step: float = math.nan
    frames_per_view: int = 1
    stored: frozenset[int] = frozenset()
    cone: bool = False
    axis_col: float | None = None
    integrals: bool = False
    dark: NDArray[np.float32] | None = None
    flat: NDArray[np.float32] | None = None
    flat_exposure: float = math.nan
    grid: CellGrid | None = None
    spots: Spots = NO_SPOTS
    follows: bool = True
    light_left: float = 1.0
    view: CellView | None = None
    truncated: bool = False
    dimmer: float = math.nan
    shake: tuple[float, float] = (0.0, 0.0)
    change: SampleChange | None = None


AGAIN = "With `monitor.retake: true` in the configuration, the scan takes such projections again at its end."
"""Advice for alarms that usually do not occur again when the projection is repeated."""


def again_by(check: str) -> str:
    """Advice for warnings of a check: how to have such projections taken again."""
    return f"With `monitor.retake: [{check}]` in the configuration, the scan takes such projections again at its end."


def light(preview: NDArray[np.float32], context: ScanContext) -> NDArray[np.float32]:
    """Counts above the dark [preview row, preview col]; the raw counts where no dark was seen."""
    return preview if context.dark is None else preview - context.dark


def at_edges(context: ScanContext) -> tuple[float, float]:
    """Line integrals of matter at the left and the right edge of the field, corrected for a weakening beam."""
    assert context.view is not None
    left, right = context.view.edges
    dimmer = 0.0 if math.isnan(context.dimmer) else context.dimmer
    return left - dimmer, right - dimmer


def more_light(context: ScanContext, exposure: float) -> float:
    """Light of an `exposure` (s) without a sample, relative to that of the flats, whose exposure may differ."""
    return exposure / context.flat_exposure


@dataclass(frozen=True, eq=False)
class CheckResult(Generic[State]):
    """Result of a check of one frame: the check's state after it, and its finding (None: nothing to report)."""

    state: State
    flag: Flag | None = None


class Logged:
    """A check whose alarms are only logged, unless the configuration says otherwise."""

    policy: ClassVar[Policy] = Policy.LOG


class Check(Protocol):
    """One check of the monitor: a frozen dataclass whose fields are its limits, each with a default.

    The type of a field, with what `recon.base.setting.setting` declares of it, is what the configuration
    `monitor.<check>.<limit>` accepts (see beamline.config.monitor).

    Attributes:
        name: in the configuration, in events and in the legend of a file.
        bit: in the bitmask of a frame in a file, 0 ... 15 or 32 ... 47. Never changed and never used again: old files
            hold it.
        unit: of the score and, unless a limit says otherwise, of the limits.
        meaning: what the flag says of a frame, one sentence for the legend of a file.
        policy: what its alarms do to a scan, unless the configuration says otherwise.
    """

    name: ClassVar[str]
    bit: ClassVar[int]
    unit: ClassVar[str]
    meaning: ClassVar[str]
    policy: ClassVar[Policy]
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def start(self) -> Any:
        """The state before the first frame."""

    def look(self, state: Any, frame: Frame, digest: FrameDigest, context: ScanContext) -> CheckResult[Any]:
        """Check the next frame. Costs at most O(pixels of the preview)."""
