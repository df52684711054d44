"""Check: the interface of the checks of the monitor, with their input (ScanContext) and their result (CheckResult).

A check is a frozen dataclass whose fields are its limits; `beamline.monitor.checks` lists all of them. A check looks at
one frame after another. What it must remember between frames is an immutable state, so that a scan can be replayed.
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

    LOG = "log"  # record it in file, events and report
    WARN = "warn"  # also print it on the terminal
    PAUSE = "pause"  # also pause the scan, until the operator or the check lets it continue
    STOP = "stop"  # also end the scan cleanly, as the first Ctrl-C does


@dataclass(frozen=True, eq=False)
class ScanContext:
    """Input of the checks: facts about the scan, the darks and flats so far, and quantities of the frame that several
    checks need.

    Attributes:
        saturation: counts from which a pixel is saturated.
        pixels: number of pixels in a frame.
        period: time in s between the triggers of a fly scan; None for a step scan.
        step: planned angular step in rad between projections (median, with its sign); NaN if it is not known, or if
            the angles are not in one direction.
        frames_per_view: number of frames at each angle; only the first one is compared with earlier projections.
        stored: projections that are in an earlier file of the scan.
        cone: True for a cone beam, False for a parallel beam.
        axis_col: rotation axis that the scan states, in pixel columns; None if it states none.
        integrals: True if the frames were line integrals. They are checked in the same way as counts of a beam without
            flats.
        dark, flat: float32 [preview row, preview col], mean of the latest group of darks and of flats; None if there
            are none yet.
        flat_exposure: exposure of these flats in s; it may differ from that of the projections.
        grid: the cells of the projections; None before the first projection.
        spots: bright pixels of projections and flats that are not in the previous frame.
        follows: True if the previous projection is the neighbour in angle, so that checks may compare with it. False
            for repeated projections, at the start of a pass, and after projections of another file; checks that compare
            projections then start again. True for the first projection, and if `step` is not known.
        light_left: intensity relative to the last good projection, see
            beamline.monitor.view.remaining_intensity; 1 if the frame is not a projection.
        view: the frame on the grid; None if it is not a projection, has no beam, or is not the first one at its angle.
        truncated: True if the sample is wider than the field of view, in this projection or an earlier one, or if
            flats are missing.
        dimmer: logarithm of the loss of beam intensity since the flats, measured in air next to the sample; NaN if no
            air was seen yet.
        shake: standard deviations of the random shifts of the sample, in pixels, horizontal and vertical; 0 if they
            can be explained by noise.
        change: the change that the rotation since the previous projections does not explain; None if these are too
            few, or at uneven steps.
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


AGAIN = "With `monitor.retake: true` in the configuration, the scan takes projections with an alarm again at its end."
"""Advice for alarms that usually do not occur again when the projection is repeated."""


def again_by(check: str) -> str:
    """Advice for warnings of a check: how to have such projections taken again."""
    return (
        f"With `monitor.retake: [{check}]` in the configuration, the scan takes projections with a warning of this "
        "check again at its end."
    )


def intensity(preview: NDArray[np.float32], context: ScanContext) -> NDArray[np.float32]:
    """Counts above the dark [preview row, preview col]. If there was no dark yet, raw counts."""
    return preview if context.dark is None else preview - context.dark


def at_edges(context: ScanContext) -> tuple[float, float]:
    """Line integrals at the left and right edge of the field of view, corrected for the loss of beam intensity."""
    assert context.view is not None
    left, right = context.view.edges
    dimmer = 0.0 if math.isnan(context.dimmer) else context.dimmer
    return left - dimmer, right - dimmer


def exposure_ratio(context: ScanContext, exposure: float) -> float:
    """Intensity without a sample for this exposure (s), relative to the intensity of the flats. (The exposure of the
    flats may differ.)"""
    return exposure / context.flat_exposure


@dataclass(frozen=True, eq=False)
class CheckResult(Generic[State]):
    """Result of a check for one frame: the new state of the check, and its flag (None: nothing to report)."""

    state: State
    flag: Flag | None = None


class Logged:
    """A check whose alarms are only recorded, unless the configuration sets another policy."""

    policy: ClassVar[Policy] = Policy.LOG


class Check(Protocol):
    """One check of the monitor: a frozen dataclass whose fields are its limits, each with a default.

    The configuration `monitor.<check>.<limit>` accepts values according to the type of the field and to its
    `recon.base.setting.setting` (see beamline.config.monitor).

    Attributes:
        name: name of the check in the configuration, in events and in the legend of a file.
        bit: its bit in the bitmask of a frame in a file, 0 ... 15 or 32 ... 47. A bit is never changed and never used
            again, because old files contain it.
        unit: unit of the score, and of the limits unless a limit states another one.
        meaning: meaning of the flag, one sentence for the legend of a file.
        policy: effect of its alarms on a scan, unless the configuration sets another one.
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
        """Check the next frame. The effort is at most O(pixels of the preview)."""
