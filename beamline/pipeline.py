"""From the frames of a scan to line integrals and their geometry: only the views and rows asked for are ever held."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from beamline.errors import ConfigError, DataError
from beamline.reading import read_binned, read_references
from beamline.storage.finding import Finding
from beamline.storage.scan_source import ScanSource
from beamline.storage.validate import beam_present, quantity_said, references_present, source_findings
from drivers.frame import FrameKind
from recon.align import AxisEstimate, find_axis
from recon.correct import CorrectionSettings, Projections, References, correct
from recon.geometry import Geometry
from recon.views import parse_views

Warn = Callable[[str], None]

_AXIS_VIEWS = 360  # more views do not sharpen the axis, they only cost reading
_AXIS_ROWS = 64
_HELD_OUT_VIEWS = 16


@dataclass(frozen=True)
class Selection:
    """Which part of a scan to use, and how.

    Attributes:
        views: a view selection, see recon.views.parse_views.
        rows: (first, end) detector rows; None is all.
        binning: pixels averaged per side.
        axis_col: rotation axis in columns of the full detector; None finds it.
        pixel_size_mm: at the sample; None takes the file's.
        correction: of counts to line integrals.
        seed: of random view selections.
    """

    views: str = "all"
    rows: tuple[int, int] | None = None
    binning: int = 1
    axis_col: float | None = None
    pixel_size_mm: float | None = None
    correction: CorrectionSettings = field(default_factory=CorrectionSettings)
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Prepared:
    """Line integrals ready for reconstruction.

    Attributes:
        projections: of the views used; view_ids are their rows in the file.
        geometry: of these views, binned; mm, or px where the pixel size is unknown.
        axis_col: rotation axis in columns of the full detector.
        axis: how it was found; None where it was given.
        held_out: line integrals of some views that are not used, and their geometry; None where all are used.
        n_projections: how many views the scan has.
        length_unit: "mm" or "px".
        quantity: what the pixels were: "counts", which were corrected, or "line_integrals".
    """

    projections: Projections
    geometry: Geometry
    axis_col: float
    axis: AxisEstimate | None
    held_out: tuple[NDArray[np.float32], Geometry] | None
    n_projections: int
    length_unit: str
    quantity: str


class Corrector:
    """Reads frames of one scan as line integrals, in the rows and with the binning asked for."""

    def __init__(self, source: ScanSource, selection: Selection, warn: Warn) -> None:
        """Read the reference frames of a scan that `refuse` has nothing against.

        Raises:
            ConfigError: rows or binning that do not fit the detector.
        """
        self._source, self._settings, self._warn = source, selection.correction, warn
        self.rows, self.binning = rows_of(source, selection), selection.binning
        self.references: References | None = None
        if source.quantity == "counts":
            self.references = read_references(source, self.rows, self.binning)

    def line_integrals(
        self, frames: NDArray[np.int64], rows: slice | None = None, settings: CorrectionSettings | None = None
    ) -> Projections:
        """Line integrals of `frames` (rows of the file), without those that hold no finite pixel: see `view_ids`.

        Args:
            frames: rows of the file.
            rows: narrows the detector rows, in binned rows.
            settings: other than the selection's.

        Raises:
            DataError: frames that cannot be corrected; the message names the file.
        """
        first, end = self.rows.start, self.rows.stop
        if rows is not None:
            start, stop, _ = rows.indices((end - first) // self.binning)
            first, end = first + start * self.binning, first + stop * self.binning
        data = read_binned(self._source, frames, slice(first, end), self.binning)
        alive = np.isfinite(data).any(axis=(1, 2))
        if not alive.any():
            raise DataError(f"{self._source.path}: none of the pixels of the {len(frames)} views is a finite number.")
        if not alive.all():
            lost = frames[~alive]
            self._warn(f"{lost.size} of {len(frames)} views hold no finite pixel (first: frame {lost[0]}): left out.")
            data, frames = data[alive], frames[alive]
        if self.references is None:
            return _as_given(data, frames)
        references = self.references if rows is None else _narrowed(self.references, rows)
        try:
            return correct(data, frames.astype(np.float64), references, settings or self._settings, view_ids=frames)
        except ValueError as error:
            raise DataError(f"{self._source.path} cannot be corrected: {error}") from error


def prepare(source: ScanSource, selection: Selection, warn: Warn) -> Prepared:
    """Read, correct and align what `selection` asks for.

    Args:
        source: a finished scan.
        selection: what to use.
        warn: is told, in a sentence, of everything that is not as it should be though work goes on.

    Raises:
        DataError: the scan cannot be reconstructed; the message says why and what to do.
        ConfigError: the selection does not fit the scan.
    """
    findings = source_findings(source)
    refuse(source, findings)
    for finding in findings:
        if finding.severity == "warning":
            warn(finding.message)
    scan_frames = np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    choose_views(source, scan_frames, selection)  # what is wrong with the words is told before any frame is read
    corrector = Corrector(source, selection, warn)
    axis_col, axis = selection.axis_col, None
    if axis_col is None:
        axis_col, axis = locate_axis(source, corrector, scan_frames, warn)
    check_axis(source, axis_col)
    period = geometry_of(source, selection, axis_col, source.angles[scan_frames]).period
    chosen = choose_views(source, scan_frames, selection, period)
    projections = corrector.line_integrals(scan_frames[chosen])
    report_defects(projections, warn)
    if projections.view_ids.size < 2:
        raise DataError(
            f"{source.path}: only {projections.view_ids.size} of the views chosen can be used, 2 are needed."
        )
    if not projections.data.any():
        raise DataError(f"{source.path}: the views chosen are zero everywhere; there is nothing in the beam.")
    rest = np.setdiff1d(np.arange(scan_frames.size), chosen)
    held_out = None
    if rest.size:
        others = corrector.line_integrals(scan_frames[_spread(rest, _HELD_OUT_VIEWS)])
        held_out = others.data, geometry_of(source, selection, axis_col, source.angles[others.view_ids])
    return Prepared(
        projections=projections,
        geometry=geometry_of(source, selection, axis_col, source.angles[projections.view_ids]),
        axis_col=axis_col,
        axis=axis,
        held_out=held_out,
        n_projections=int(scan_frames.size),
        length_unit="px" if pixel_size(source, selection) is None else "mm",
        quantity=source.quantity,
    )


def refuse(source: ScanSource, findings: Iterable[Finding]) -> None:
    """Raises DataError for the first error among the findings, with what to do about it."""
    for finding in findings:
        if finding.severity != "error":
            continue
        raise DataError(f"{source.path} cannot be reconstructed. {finding.message}")


def correction_blockers(source: ScanSource) -> list[Finding]:
    """Why the frames of a scan that is still growing cannot be corrected."""
    return [finding for rule in (quantity_said, references_present, beam_present) for finding in rule(source)]


def choose_views(
    source: ScanSource, frames: NDArray[np.int64], selection: Selection, period: float = math.pi
) -> NDArray[np.int64]:
    """Indices into `frames` of the views that the selection names; at least two.

    Args:
        period: radians after which views see the same rays, see `Geometry.period`.

    Raises:
        ConfigError: the selection is not legal, or leaves fewer than two views.
    """
    try:
        chosen = parse_views(selection.views, source.angles[frames], selection.seed, period=period)
    except ValueError as error:
        raise ConfigError(f"--views: {error}") from error
    if chosen.size < 2:
        raise ConfigError(
            f"--views {selection.views} leaves {chosen.size} of the {frames.size} views of {source.path}; a volume "
            "needs at least 2."
        )
    return chosen


def rows_of(source: ScanSource, selection: Selection) -> slice:
    """The detector rows to read, cut to whole bins.

    Raises:
        ConfigError: rows outside the detector, or bins larger than what is left.
    """
    height, width = source.shape
    first, end = selection.rows or (0, height)
    if not 0 <= first < end <= height:
        raise ConfigError(f"--rows {first}:{end} do not lie in the detector's 0:{height}.")
    n = selection.binning
    if not 1 <= n <= min(end - first, width):
        raise ConfigError(f"--bin {n} does not fit into {end - first} rows of {width} columns.")
    return slice(first, first + (end - first) // n * n)


def locate_axis(
    source: ScanSource, corrector: Corrector, frames: NDArray[np.int64], warn: Warn
) -> tuple[float, AxisEstimate]:
    """The rotation axis in columns of the full detector, from a band of rows of views spread over `frames`.

    An estimate without a clear optimum gives way to what the file states, if it states it.

    Raises:
        DataError: no axis in the search range explains the views.
    """
    height = (corrector.rows.stop - corrector.rows.start) // corrector.binning
    start = max(0, (height - _AXIS_ROWS) // 2)
    frames = frames[_spread(np.arange(frames.size), _AXIS_VIEWS)]
    band = corrector.line_integrals(frames, slice(start, min(height, start + _AXIS_ROWS)))
    try:
        estimate = find_axis(band.data, source.angles[band.view_ids])
    except ValueError as error:
        raise DataError(
            f"{source.path}: the rotation axis was not found: {error}. Give it with --axis COLUMN (0 is the centre of "
            "the first column)."
        ) from error
    found = unbinned(estimate.value, corrector.binning)
    if estimate.confident:
        return found, estimate
    if source.axis_col is not None:
        warn(
            f"The rotation axis found, column {found:.2f}, is not a clear optimum: the file's {source.axis_col:.2f} is "
            "used. Check the slices, or give --axis COLUMN."
        )
        return source.axis_col, estimate
    warn(
        f"The rotation axis found, column {found:.2f}, is not a clear optimum. Check the slices for doubled edges, or "
        "give --axis COLUMN."
    )
    return found, estimate


def check_axis(source: ScanSource, axis_col: float) -> None:
    """Raises ConfigError where the axis lies outside the detector."""
    if not -0.5 <= axis_col <= source.shape[1] - 0.5:
        raise ConfigError(
            f"The rotation axis, column {axis_col:g}, lies outside the detector's columns 0 to {source.shape[1] - 1}."
        )


def unbinned(column: float, binning: int) -> float:
    """A binned column in columns of the full detector."""
    return column * binning + (binning - 1) / 2


def geometry_of(source: ScanSource, selection: Selection, axis_col: float, angles: NDArray[np.float64]) -> Geometry:
    """Geometry of views at `angles` in the rows and with the binning of `selection`; pitch 1 where it is not known."""
    rows = rows_of(source, selection)
    full = (rows.stop - rows.start, source.shape[1])
    pitch = pixel_size(source, selection)
    return Geometry.parallel(angles, full, 1.0 if pitch is None else pitch, axis_col).binned(selection.binning)


def pixel_size(source: ScanSource, selection: Selection) -> float | None:
    return source.pixel_size_mm if selection.pixel_size_mm is None else selection.pixel_size_mm


def report_defects(projections: Projections, warn: Warn) -> None:
    """Tell of what correction had to repair, where it is more than a stray pixel in a thousand."""
    masked = float(projections.masked.mean())
    if masked > 1e-3:
        warn(f"{masked:.1%} of the detector's pixels are dead or hot and were filled from their neighbours.")
    if projections.replaced > 1e-3:
        warn(f"{projections.replaced:.1%} of the pixels were zingers or not finite: filled from their neighbours.")
    if projections.floored > 1e-3:
        warn(
            f"{projections.floored:.1%} of the pixels let less light through than the floor; their attenuation is at "
            "least what the volume says."
        )


def _spread(items: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """At most `n` of the items, evenly spread, with the first and the last."""
    if items.size <= n:
        return items
    return items[np.unique(np.linspace(0, items.size - 1, n).round().astype(np.int64))]


def _narrowed(references: References, rows: slice) -> References:
    return References(references.dark[rows], tuple((position, flat[rows]) for position, flat in references.flats))


def _as_given(data: NDArray[Any], frames: NDArray[np.int64]) -> Projections:
    """Line integrals that need no correction; a pixel that is not finite takes the value of the nearest that is."""
    data = data.astype(np.float32, copy=False)
    bad = ~np.isfinite(data)
    for view in np.flatnonzero(bad.any(axis=(1, 2))):
        nearest = ndimage.distance_transform_edt(bad[view], return_distances=False, return_indices=True)
        data[view] = data[view][tuple(nearest)]
    ones = np.ones(len(frames), np.float32)
    return Projections(
        data, frames, floored=0.0, air=ones, masked=np.asarray(bad.all(axis=0)), replaced=float(bad.mean())
    )
