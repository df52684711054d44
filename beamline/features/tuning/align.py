"""Align: finds rotation axis, tilt and focus from two opposite projections, before a scan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import rotate

from beamline.config.load import Config
from beamline.config.planned import plan_of
from beamline.core.errors import ConfigError, QualityError
from beamline.core.events import Sink
from beamline.core.stop import StopRequest
from beamline.core.text import degrees
from beamline.features.tuning.tune import mean_counts, static_block, take
from beamline.instrument.connect import ConnectedDevices
from beamline.plan.plan import Block, Mode
from drivers.base.frame import Frame, FrameKind
from recon.base.arrays import F64
from recon.prep.align import AxisError, AxisEstimate, axis_from_pair, mirror_mismatch
from recon.prep.axis_wedge import FEWEST_BANDS
from recon.prep.tilt import TiltEstimate, line_through

BANDS = 12  # Largest number of bands of rows; no band has fewer than FEWEST_ROWS
FEWEST_ROWS = 8
ROUNDS = 3


def align_pair(p0: NDArray[np.floating], p180: NDArray[np.floating]) -> tuple[AxisEstimate, TiltEstimate | None]:
    """The rotation axis from two projections 180° apart, and its tilt; None if bands of rows do not determine the tilt.

    Args:
        p0, p180: float [row, col], line integrals.

    Raises: ValueError: the shapes differ, or values are not finite. AxisError: there is no axis in the middle three
    quarters of the columns.
    """
    tilt, line = 0.0, None
    for _ in range(ROUNDS):
        a, b = (_levelled(view, tilt) for view in (p0, p180))
        whole = axis_from_pair(a, b)
        rows = np.array_split(np.arange(len(a)), max(1, min(BANDS, len(a) // FEWEST_ROWS)))
        if len(rows) < FEWEST_BANDS:
            break
        curves = np.stack([mirror_mismatch(a[band], b[band], whole.candidates) for band in rows])
        heights = np.array([band.mean() for band in rows]) - (len(a) - 1) / 2
        try:
            line = line_through(whole.candidates, curves, heights)
        except ValueError:
            line = None
            break
        tilt += line.tilt
    if line is None:
        return replace(axis_from_pair(p0, p180), confident=whole.confident), None
    return whole, replace(line, tilt=tilt)


def finest_structure(first_image: NDArray[np.floating], second_image: NDArray[np.floating]) -> float:
    """Width in pixels of the finest structure in a projection: the contrast divided by the slope. Both are computed
    from two frames of the same projection, so that noise cancels.

    The sharper the image, the smaller this width, for the same sample at the same angle. NaN if there is only noise.

    Args:
        first_image, second_image: float [row, col], two frames of the same projection.
    """
    contrast = float(np.mean((first_image - first_image.mean()) * (second_image - second_image.mean())))
    slope = sum(float(np.mean(np.diff(first_image, axis=axis) * np.diff(second_image, axis=axis))) for axis in range(2))
    return math.sqrt(contrast / slope) if contrast > 0 and slope > 0 else math.nan


def _levelled(view: NDArray[np.floating], tilt: float) -> F64:
    """The projection, rotated about its middle so that an axis with this tilt becomes vertical."""
    data = np.asarray(view, np.float64)
    return data if tilt == 0 else rotate(data, -math.degrees(tilt), reshape=False, order=1, mode="nearest")


N = 4
"""Darks, and flats."""
TWICE = 2
"""Number of frames at each angle. They differ only in their noise."""
STRAIGHT = 0.5
"""In columns: a smaller offset of the axis, or a smaller displacement from the first to the last row, need not be
corrected."""
_ROUNDING = 1e-9  # rad


@dataclass(frozen=True)
class Alignment:
    """The results from two opposite projections. Lengths are in mm at the sample, angles in rad."""

    axis_col: float  # column of the axis at the middle row
    offset: float  # columns from the frame's middle to the axis; positive to the right, where columns are higher
    offset_mm: float
    tilt: float  # the column of the axis grows by tan(tilt) per row; NaN: not known
    uncertainty: float  # uncertainty of the tilt, one standard deviation
    # width in pixels of the finest structure, without noise: smaller is sharper. NaN: there is only noise
    detail: float
    angle: float  # angle of the first projection
    rows: int  # number of rows of the frame

    @property
    def lean(self) -> float:
        """Difference of the column of the axis between the first and the last row."""
        return math.tan(self.tilt) * (self.rows - 1)

    def lines(self) -> list[str]:
        """The results as lines of text, each with what to correct."""
        side, way = ("right", "lower") if self.offset > 0 else ("left", "higher")
        move = f"; move the axis {abs(self.offset_mm):.4g} mm towards {way} columns, or set"
        axis = (
            f"column {self.axis_col:.2f}, {abs(self.offset):.2f} px = {abs(self.offset_mm):.4g} mm {side} of the middle"
            f"{move if abs(self.offset) > STRAIGHT else ':'} optics.axis_col={self.axis_col:.2f}"
        )
        if math.isnan(self.tilt):
            tilt = "not known: too few bands of rows show the sample"
        else:
            turn, uncertainty = math.degrees(self.tilt), math.degrees(self.uncertainty)
            tilt = f"{turn:.3f}° ± {uncertainty:.3f}°, {abs(self.lean):.2f} px between the first and the last row; "
            # the lower end of the axis is to the right of its upper end
            way = "clockwise" if turn > 0 else "anticlockwise"
            turned = (
                f"rotate the axis by {abs(turn):.3f}° {way} as seen in the frame, or the camera by the same angle "
                "in the other direction"
            )
            tilt += turned if abs(self.lean) > STRAIGHT else "no correction"
        detail = (
            "not known: the projection shows only noise"
            if math.isnan(self.detail)
            else (
                f"{self.detail:.3g} px is the width of the finest detail in the projection at {degrees(self.angle)}; "
                "focus until this width is smallest"
            )
        )
        return [f"{name:<8}{text}" for name, text in (("axis", axis), ("tilt", tilt), ("detail", detail))]


def align(
    config: Config, instrument: ConnectedDevices, stop: StopRequest, sink: Sink, angle: float | None = None
) -> Alignment:
    """Take darks, flats and two projections 180° apart, and evaluate them. No file is written.

    At the end, as after a scan, the shutter is closed, and stage and sample are back at their first positions.

    Args:
        angle: angle of the first projection in rad. None: the first angle of the plan, or 180° before it if the limits
            of the stage require this.

    Raises: ConfigError: the stage cannot reach both angles. QualityError: the projections do not show the axis.
        ScanStopped: a stop was requested. InstrumentError, DeviceError: a device failed.
    """
    plan, limits = plan_of(config), instrument.devices.stage.limits
    first = float(plan.angles[0]) if angle is None else angle
    pair = [first, first + math.pi if first + math.pi <= limits.high else first - math.pi]
    if not all(limits.low - _ROUNDING <= each <= limits.high + _ROUNDING for each in pair):
        two_angles = " and ".join(map(degrees, pair))
        raise ConfigError(
            f"The projections would be at {two_angles}, but the stage can only go from {degrees(limits.low)} to "
            f"{degrees(limits.high)}. Choose another --angle. Nothing was started."
        )
    frames, _ = take(_blocks(plan.exposure, pair), config, instrument, stop, sink)
    return evaluate(frames, config.optics.pixel_size_um * 1e-3 * config.devices.camera.binning)


def evaluate(frames: Sequence[Frame], pixel_size: float) -> Alignment:
    """Evaluate darks, flats, and two frames of each of the two projections.

    Args:
        pixel_size: mm, of a (binned) pixel at the sample.

    Raises:
        QualityError: the projections do not show the axis.
    """
    darks, flats, views = (
        [frame for frame in frames if frame.kind is kind]
        for kind in (FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION)
    )
    dark = mean_counts(darks)
    intensity = np.maximum(mean_counts(flats) - dark, 1.0)
    integrals = [-np.log(np.maximum(frame.counts - dark, 1.0) / intensity) for frame in views]
    first_image, second_image = (np.mean(integrals[i : i + TWICE], axis=0) for i in (0, TWICE))
    try:
        axis, tilt = align_pair(first_image, second_image)
    except AxisError as error:
        raise QualityError(f"The two projections do not show the axis: {error}") from error
    if not axis.confident:
        raise QualityError(
            f"The two projections do not match: the axis is perhaps near column {axis.value:.1f}, but this column is "
            "not certain. Use a sample with more contrast that stays in the field of view, and check the flats."
        )
    offset = axis.value - (dark.shape[1] - 1) / 2
    return Alignment(
        axis_col=axis.value,
        offset=offset,
        offset_mm=offset * pixel_size,
        tilt=math.nan if tilt is None else tilt.tilt,
        uncertainty=math.nan if tilt is None else tilt.uncertainty,
        detail=finest_structure(integrals[0], integrals[1]),
        angle=views[0].angle,
        rows=dark.shape[0],
    )


def _blocks(exposure: float, pair: Sequence[float]) -> list[Block]:
    static = [static_block(kind, N, exposure) for kind in (FrameKind.DARK, FrameKind.FLAT)]
    return [*static, Block(FrameKind.PROJECTION, Mode.STEP, 0, np.repeat(pair, TWICE), exposure, exposure)]
