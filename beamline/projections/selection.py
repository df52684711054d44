"""Selection: which part of a scan is used, with its views, rows, rotation axis and geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.projections.step import NamedStep
from recon.base.declared_types import check_settings
from recon.base.geometry import Geometry, unseen_axis
from recon.base.views import parse_views

if TYPE_CHECKING:
    from beamline.storage.readers.base import ScanSource

S = TypeVar("S", bound=NamedStep)

_PIXEL_SIZES_UM = 1e-6, 1e6  # far beyond any detector's on either side


@dataclass(frozen=True)
class Selection:
    """Which part of a scan to use, and the corrections that differ from their defaults.

    Attributes:
        views: a view selection, see recon.base.views.parse_views.
        rows: (first, end) detector rows; None is all.
        binning: pixels averaged per side.
        axis_col: rotation axis in columns of the full detector; None finds it.
        sample_width: across the beam, where the sample is wider than the field, in mm (in px where the pixel size is
            unknown); None takes the file's, or measures it.
        pixel_size_mm: at the sample (of a cone: on the detector); None takes the file's.
        cone: mm from the source to the rotation axis and to the detector; None takes the file's, or a parallel beam.
        central_row: row of the full detector that the central ray of a cone meets, also off it; None: the middle.
        seed: of random view selections.
        axis_rows: (first, end) detector rows by which the axis is found; None: those of `rows`.
        steps: corrections that are to do something else than their defaults, see `beamline.projections.corrections`.
    """

    views: str = "all"
    rows: tuple[int, int] | None = None
    binning: int = 1
    axis_col: float | None = None
    sample_width: float | None = None
    pixel_size_mm: float | None = None
    cone: tuple[float, float] | None = None
    central_row: float | None = None
    seed: int = 0
    axis_rows: tuple[int, int] | None = None
    steps: tuple[NamedStep, ...] = ()

    def __post_init__(self) -> None:
        check_settings(self)
        for name in ("rows", "cone", "axis_rows"):  # a pair from a list or an array is the same pair
            if (pair := getattr(self, name)) is not None:
                object.__setattr__(self, name, tuple(getattr(pair, "tolist", lambda pair=pair: pair)()))

    def step(self, kind: type[S]) -> S:
        """The step of this class: the given one, or else one with default settings."""
        return next((step for step in self.steps if isinstance(step, kind)), None) or kind()

    def with_steps(self, *steps: NamedStep) -> Selection:
        """The same selection with these steps, each replacing the one of its class."""
        kinds = {type(step) for step in steps}
        return replace(self, steps=(*(step for step in self.steps if type(step) not in kinds), *steps))


def choose_views(
    source: ScanSource, frames: NDArray[np.int64], selection: Selection, period: float = math.pi
) -> NDArray[np.int64]:
    """Rows in `frames` of the views that the selection names; at least two.

    Args:
        period: radians after which views see the same rays, see `Geometry.period`.

    Raises:
        ConfigError: the selection is not legal, or leaves fewer than two views.
    """
    try:
        chosen = parse_views(selection.views, source.table.angles[frames], selection.seed, period=period)
    except ValueError as error:
        raise ConfigError(f"--views: {error}") from error
    if chosen.size < 2:
        raise ConfigError(
            f"--views {selection.views} leaves {chosen.size} of the {frames.size} views of {source.path}; a volume "
            "needs at least 2."
        )
    return chosen


def rows_of(source: ScanSource, selection: Selection) -> slice:
    """The detector rows to read, cropped to whole bins.

    Raises:
        ConfigError: rows outside the detector, or bins larger than what is left.
    """
    height, width = source.shape
    first, end = selection.rows or (0, height)
    if not 0 <= first < end <= height:
        raise ConfigError(f"--rows {first}:{end} is out of range: the detector has rows 0:{height}.")
    n = selection.binning
    if not 1 <= n <= min(end - first, width):
        raise ConfigError(f"--bin {n} does not fit into {end - first} rows of {width} columns.")
    return slice(first, first + (end - first) // n * n)


def check_axis(source: ScanSource, axis_col: float) -> None:
    """Raise ConfigError if the axis lies outside the detector."""
    if sentence := unseen_axis(axis_col, source.shape[1]):
        raise ConfigError(sentence)


def unbinned(column: float, binning: int) -> float:
    """A binned column converted to columns of the full detector."""
    return column * binning + (binning - 1) / 2


def geometry_of(source: ScanSource, selection: Selection, axis_col: float, angles: NDArray[np.float64]) -> Geometry:
    """Geometry of views at `angles` in the rows and with the binning of `selection`; pitch 1 if it is unknown.

    Raises:
        ConfigError: a cone beam has no known pixel size, or impossible distances; a central row of a parallel beam.
    """
    rows = rows_of(source, selection)
    full = (rows.stop - rows.start, source.shape[1])
    pitch = pixel_size(source, selection)
    if (cone := cone_of(source, selection)) is not None:
        if pitch is None:
            raise ConfigError(
                f"{source.path} does not state its pixel size, which a cone beam needs: give --pixel-size-um (on the "
                "detector)."
            )
        # The central ray meets the same row of the detector, whatever rows are read.
        meets = (source.shape[0] - 1) / 2 if selection.central_row is None else selection.central_row
        axis_row = meets - rows.start
        try:
            geometry = Geometry.cone(angles, full, pitch, *cone, axis_col=axis_col, axis_row=axis_row)
        except ValueError as error:
            raise ConfigError(f"{source.path}: {error}. Give the right ones with --cone SOD:SDD.") from error
        return geometry.binned(selection.binning)
    if selection.central_row is not None:
        raise ConfigError(
            f"--central-row is for a cone beam; {source.path} is a parallel one. Leave it out, or give --cone."
        )
    return Geometry.parallel(angles, full, pixel_pitch=1.0 if pitch is None else pitch, axis_col=axis_col).binned(
        selection.binning
    )


def pivot_of(source: ScanSource, selection: Selection) -> float:
    """The middle row of the detector, binned and relative to the first row used."""
    middle, binning = (source.shape[0] - 1) / 2, selection.binning
    return (middle - rows_of(source, selection).start - (binning - 1) / 2) / binning


def with_pivot(geometry: Geometry, pivot: float) -> Geometry:
    """The geometry whose views roll and tilt about the row `pivot`."""
    # A parallel beam's z = 0 is the middle of its rows, but those views lean about the detector's middle.
    return geometry if geometry.is_straight or geometry.is_cone else replace(geometry, axis_row=pivot)


def cone_of(source: ScanSource, selection: Selection) -> tuple[float, float] | None:
    """(sod, sdd) in mm; None for a parallel beam."""
    return source.cone if selection.cone is None else selection.cone


def pixel_size(source: ScanSource, selection: Selection) -> float | None:
    """Pixel size in mm, from the selection or the file; None if neither states it.

    Raises:
        ConfigError: no detector has such pixels.
    """
    size_mm = source.pixel_size_mm if selection.pixel_size_mm is None else selection.pixel_size_mm
    low, high = _PIXEL_SIZES_UM
    if size_mm is not None and not low <= size_mm * 1e3 <= high:
        whose = source.path if selection.pixel_size_mm is None else "--pixel-size-um"
        raise ConfigError(
            f"{whose}: a pixel size of {size_mm * 1e3:.4g} um; expected {low:g} to {high:g} um. Give the right one "
            "with --pixel-size-um."
        )
    return size_mm
