"""Selection: which part of a scan is used, with its projections, rows, rotation axis and geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.projections.step import NamedStep
from recon.base.declared_types import check_settings
from recon.base.geometry import Geometry, unseen_axis
from recon.base.views import parse_views

if TYPE_CHECKING:
    from beamline.storage.frame_table import FrameTable
    from beamline.storage.readers.base import ScanSource
    from beamline.storage.rules.evidence import ScanEvidence

S = TypeVar("S", bound=NamedStep)

_PIXEL_SIZES_UM = 1e-6, 1e6  # limits far beyond any detector


@dataclass(frozen=True)
class Selection:
    """Which part of a scan to use, and the corrections that differ from their defaults.

    Attributes:
        views: a selection of projections, see recon.base.views.parse_views.
        rows: (first, end) detector rows; None: all.
        binning: number of pixels averaged along each side.
        axis_col: rotation axis in columns of the full detector; None: it is searched for.
        sample_width: width of the sample across the beam, if it is wider than the field of view, in mm (in px if the
            pixel size is unknown); None: the value in the file, or estimated from the projections.
        pixel_size_mm: size of a pixel at the sample (for a cone beam: on the detector); None: the value in the file.
        cone: distances from the source to the rotation axis and to the detector, in mm; None: the values in the file,
            or a parallel beam if the file states no distances.
        central_row: for a cone beam, detector row at which the ray perpendicular to the rotation axis meets the
            detector; it may lie outside the detector; None: the middle row.
        seed: seed of random selections of projections.
        axis_rows: (first, end) detector rows from which the axis is found; None: those of `rows`.
        steps: corrections whose settings differ from the defaults, see `beamline.projections.corrections`.
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
        # a pair from a list or an array must equal the same pair given as a tuple
        for name in ("rows", "cone", "axis_rows"):
            if (pair := getattr(self, name)) is not None:
                object.__setattr__(self, name, tuple(getattr(pair, "tolist", lambda pair=pair: pair)()))

    def step(self, kind: type[S]) -> S:
        """The correction step of the class `kind`, with default settings if the selection does not contain it."""
        return next((step for step in self.steps if isinstance(step, kind)), None) or kind()

    def with_steps(self, *steps: NamedStep) -> Self:
        """A copy of this selection with the given correction steps. Each given step replaces the step of the same
        class."""
        kinds = {type(step) for step in steps}
        return replace(self, steps=(*(step for step in self.steps if type(step) not in kinds), *steps))

    def of(self, source: ScanSource) -> ScanSelection:
        """Apply the selection to a scan: check it, and fill in pixel size, distances and sample width from the scan
        file.

        Raises:
            ConfigError: the rows lie outside the detector, a bin is larger than the selected rows or the width of
                the detector, or the pixel size lies outside the allowed range.
        """
        size_mm, whose = self.pixel_size_mm, "--pixel-size-um"
        if size_mm is None:
            size_mm, whose = source.pixel_size_mm, str(source.path)
        low, high = _PIXEL_SIZES_UM
        if size_mm is not None and not low <= size_mm * 1e3 <= high:
            size_um = size_mm * 1e3
            raise ConfigError(
                f"{whose}: a pixel size of {size_um:.4g} um is impossible; expected {low:g} to {high:g} um. Give the "
                "right pixel size with --pixel-size-um."
            )
        width = source.attributes.get("sample_diameter_mm") if size_mm is not None else None
        width = width if self.sample_width is None else self.sample_width
        cone, width = self.cone or source.cone, None if width is None else float(width)
        stated = {"pixel_size_mm": size_mm, "cone": cone, "sample_width": width}
        own_fields = {each.name: getattr(self, each.name) for each in fields(Selection)}
        return ScanSelection(**{**own_fields, **stated}, asked=self, shape=source.shape, path=source.path)


@dataclass(frozen=True, kw_only=True)
class ScanSelection(Selection):
    """A selection applied to one scan. Pixel size, cone and sample width are the values in the file unless the
    selection states them.

    Attributes:
        rows: the rows that are read; whole bins.
        asked: the selection that the user gave.
        shape: (height, width) of the detector.
        path: path of the file.
    """

    asked: Selection
    shape: tuple[int, int]
    path: Path

    def __post_init__(self) -> None:
        super().__post_init__()
        height, width = self.shape
        (first, end), n = self.rows or (0, height), self.binning
        if not 0 <= first < end <= height:
            raise ConfigError(f"--rows {first}:{end} is out of range: the detector has rows 0:{height}.")
        if not 1 <= n <= min(end - first, width):
            n_rows = end - first
            raise ConfigError(f"--bin {n} does not fit into {n_rows} rows of {width} columns.")
        object.__setattr__(self, "rows", (first, first + (end - first) // n * n))

    @property
    def detector_rows(self) -> slice:
        """The rows that are read."""
        assert self.rows is not None
        return slice(*self.rows)

    @property
    def n_rows(self) -> int:
        """Number of binned rows."""
        return (self.detector_rows.stop - self.detector_rows.start) // self.binning

    @property
    def pivot(self) -> float:
        """The middle row of the detector, binned and relative to the first row used."""
        return ((self.shape[0] - 1) / 2 - self.detector_rows.start - (self.binning - 1) / 2) / self.binning

    def geometry(self, axis_col: float, angles: NDArray[np.float64]) -> Geometry:
        """Geometry of projections at `angles` with the selected rows and binning. The pitch is 1 if the pixel size is
        unknown.

        Raises:
            ConfigError: for a cone beam, the pixel size is unknown or the distances are impossible; or a central row
                was given for a parallel beam.
        """
        rows, pitch = self.detector_rows, self.pixel_size_mm
        unbinned_shape = (rows.stop - rows.start, self.shape[1])
        if self.cone is not None:
            if pitch is None:
                raise ConfigError(
                    f"Give --pixel-size-um (on the detector): a cone beam needs the pixel size, and {self.path} does "
                    "not state it."
                )
            # The central ray meets the same detector row whatever rows are read.
            central_row = (self.shape[0] - 1) / 2 if self.central_row is None else self.central_row
            try:
                if self.cone[1] < (width := unbinned_shape[1] * pitch) / math.sqrt(2):
                    sdd = self.cone[1]
                    raise ValueError(f"the source would be only {sdd:g} mm from a detector that is {width:.4g} mm wide")
                geometry = Geometry.cone(
                    angles, unbinned_shape, pitch, *self.cone, axis_col=axis_col, axis_row=central_row - rows.start
                )  # fmt: skip
            except ValueError as error:
                raise ConfigError(f"{self.path}: {error}. Give the right distances with --cone SOD:SDD.") from error
            return geometry.binned(self.binning)
        if self.central_row is not None:
            raise ConfigError(
                f"Omit --central-row, or give --cone: --central-row is for a cone beam, and {self.path} "
                "is a parallel-beam scan."
            )
        pitch = 1.0 if pitch is None else pitch
        return Geometry.parallel(angles, unbinned_shape, pixel_pitch=pitch, axis_col=axis_col).binned(self.binning)


@dataclass(frozen=True, eq=False)
class SelectedScan:
    """A scan and its selection. `beamline.projections.views.select` makes it once per job.

    Attributes:
        evidence: facts that darks, flats and some projections of the scan show.
        selection: the selection applied to this scan.
    """

    evidence: ScanEvidence
    selection: ScanSelection

    @property
    def source(self) -> ScanSource:
        """Reads the frames."""
        return self.evidence.source

    @property
    def table(self) -> FrameTable:
        """The table of the frames at the time when the evidence was created."""
        return self.evidence.table

    def part(self, **changes: Any) -> SelectedScan:
        """The same scan with another selection. The arguments are fields of the selection."""
        return replace(self, selection=replace(self.selection, **changes))

    def with_steps(self, *steps: NamedStep) -> SelectedScan:
        """The same scan with these correction steps. Each step replaces the step of the same class."""
        return replace(self, selection=self.selection.with_steps(*steps))

    def selecting(self, selection: Selection) -> SelectedScan:
        """The same scan with another selection from the user. Its settings for references and flags must be the same.

        Raises:
            ConfigError: as `Selection.of`.
        """
        return replace(self, selection=selection.of(self.source))

    def renewed(self) -> SelectedScan:
        """The scan with all frames that have been recorded until now."""
        return replace(self, evidence=self.evidence.renewed())


def choose_views(scan: SelectedScan, frames: NDArray[np.int64], period: float = math.pi) -> NDArray[np.int64]:
    """The rows among `frames` of the projections that the selection names; at least two.

    Args:
        period: radians after which projections measure the same rays, see `Geometry.period`.

    Raises:
        ConfigError: the selection is wrong, or leaves fewer than two projections.
    """
    source, selection = scan.source, scan.selection
    try:
        chosen = parse_views(selection.views, source.table.angles[frames], selection.seed, period=period)
    except ValueError as error:
        raise ConfigError(f"--views: {error}") from error
    if chosen.size < 2:
        raise ConfigError(
            f"--views {selection.views} selects only {chosen.size} of the {frames.size} projections of "
            f"{source.path}; a volume needs at least 2."
        )
    return chosen


def check_axis(source: ScanSource, axis_col: float) -> None:
    """Raise ConfigError if the axis lies outside the detector."""
    if sentence := unseen_axis(axis_col, source.shape[1]):
        raise ConfigError(sentence)


def unbinned(column: float, binning: int) -> float:
    """A binned column converted to columns of the full detector."""
    return column * binning + (binning - 1) / 2


def with_pivot(geometry: Geometry, pivot: float) -> Geometry:
    """The geometry whose projections roll and tilt about the row `pivot`."""
    # In a parallel beam z = 0 is the middle of the rows used, but these projections roll and tilt about the middle of
    # the detector.
    return geometry if geometry.is_straight or geometry.is_cone else replace(geometry, axis_row=pivot)
