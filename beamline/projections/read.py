"""Reads pixels of a scan and bins them, finds projections that cannot be used, and applies the filters of
projections.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.sinks import Warn
from beamline.core.text import count, frames_text, spans
from beamline.projections.preparation import Preparation
from beamline.projections.protocols import ViewFilter, ViewStep
from beamline.projections.registry import in_order
from beamline.projections.selection import SelectedScan
from beamline.projections.step import StepDone
from beamline.projections.usable_views import new_gap
from beamline.storage.datasets import HELD
from beamline.storage.readers.base import ScanSource, read_known
from beamline.storage.rules.evidence import ScanEvidence
from recon.prep.projections import Projections
from recon.prep.references import References

BATCH_BYTES = 64 * 2**20  # bytes of raw pixels that are read together


def read_binned(
    source: ScanSource,
    frames: NDArray[np.int64],
    rows: slice,
    binning: int,
    progress: Callable[[int, int], None] = lambda n, total: None,
) -> NDArray[Any]:
    """Read frames [frame, row, col], averaged into bins; NaN is excluded from the averages.

    Integer counts keep their type if they are not binned (half the memory); everything else becomes float32. Trailing
    columns that do not fill a bin are dropped. If a frame is spread over more compressed chunks than are kept in
    memory, a few rows of all frames are read at a time; otherwise all rows of a few frames.
    """
    height, width = (rows.stop - rows.start) // binning, source.shape[1] // binning
    keeps_integers = binning == 1 and source.dtype.kind in "ui"
    out = np.empty((len(frames), height, width), source.dtype.newbyteorder("=") if keeps_integers else np.float32)
    row_bytes, by_rows = source.shape[1] * source.dtype.itemsize, _read_by_rows(source)
    batch = len(frames) if by_rows else max(1, BATCH_BYTES // max(1, (rows.stop - rows.start) * row_bytes))
    n_rows = max(1, BATCH_BYTES // max(1, batch * row_bytes * binning)) if by_rows else max(1, height)
    for top, start in product(range(0, height, n_rows), range(0, len(frames), max(1, batch))):
        end = min(top + n_rows, height)
        raw = read_known(source, frames[start : start + batch], slice(*(rows.start + n * binning for n in (top, end))))
        if binning > 1:
            raw = _mean_bins(raw[..., : width * binning].astype(np.float32), binning)
        out[start : start + batch, top:end] = raw
        progress(len(frames) * end // height if by_rows else min(start + batch, len(frames)), len(frames))
    return out


def _read_by_rows(source: ScanSource) -> bool:
    """True if a frame shares its chunks in the file with other frames, and there are more chunks than are kept in
    memory.
    """
    frame = source.shape[0] * source.shape[1] * source.dtype.itemsize * source.frames_per_view
    return source.frame_bytes > max(HELD, 2 * frame)


def reading_memory(source: ScanSource, frames: int, rows: slice, binning: int) -> int:
    """Memory in bytes that `read_binned` needs, including its result."""
    pixels, itemsize = (rows.stop - rows.start) * source.shape[1], source.dtype.itemsize
    at_once = min(frames, max(1, BATCH_BYTES // max(1, pixels * itemsize))) * pixels
    of_file = min(source.frame_bytes, HELD)
    if binning == 1:
        return frames * pixels * (itemsize if source.dtype.kind in "ui" else 4) + at_once * itemsize + of_file
    # as float32, with a mask of the finite values
    return 4 * frames * pixels // binning**2 + at_once * (itemsize + 4 + 2) + of_file


def _mean_bins(raw: NDArray[np.float32], binning: int) -> NDArray[np.float32]:
    n_frames, rows, cols = raw.shape
    blocks = raw.reshape(n_frames, rows // binning, binning, cols // binning, binning)
    finite = np.isfinite(blocks)
    if finite.all():
        return blocks.mean(axis=(2, 4), dtype=np.float32)
    count = finite.sum(axis=(2, 4))
    total = np.where(finite, blocks, 0).sum(axis=(2, 4), dtype=np.float32)
    return np.where(count > 0, total / np.maximum(count, 1), np.float32(np.nan)).astype(np.float32)


def damaged_frames(scan: SelectedScan, frames: NDArray[np.int64]) -> tuple[NDArray[np.bool_], list[str]]:
    """The frames that are left out after reading, and sentences that list them. Unreadable frames are left out, and
    also frames that differ from their checksum, unless the selection uses all frames.
    """
    source = scan.source
    unreadable, sentences = np.isin(frames, sorted(source.unreadable)), list[str]()
    if unreadable.any():
        first_frame = int(frames[unreadable].min())
        how_many = count(int(unreadable.sum()), "frame")
        reason = source.unreadable[first_frame]
        are = "is" if unreadable.sum() == 1 else "are"
        lost_frames = spans(np.sort(frames[unreadable]).tolist())
        sentences.append(f"{how_many} cannot be read and {are} left out: {lost_frames}. {reason}")
    damaged = np.isin(frames, sorted(source.damaged)) & ~unreadable
    used = scan.selection.step(Preparation).uses_flags
    if damaged.any():
        which = frames_text(np.sort(frames[damaged]))
        differ, are = ("differs", "is") if damaged.sum() == 1 else ("differ", "are")
        are_taken = f"{are} left out" if used else f"{are} used anyway (--flags ignore)"
        sentences.append(
            f"Look for an intact copy of {source.path}: {which} {differ} from the stored checksum and {are_taken}."
        )
    return unreadable | damaged if used else unreadable, sentences


def spoilt_frames(source: ScanSource, use_damaged: bool) -> list[int]:
    """The rows read so far that cannot be used, because they are unreadable or differ from their checksum."""
    return sorted({*source.unreadable} | (set() if use_damaged else source.damaged))


@dataclass(frozen=True, eq=False)
class ViewFilters:
    """The filters for one scan, in the order in which they are applied.

    Attributes:
        filters: the filters in this order.
        done: what each step does, by name.
        scan: the scan with the selected rows and binning.
    """

    filters: tuple[ViewFilter, ...]
    done: dict[str, StepDone]
    scan: SelectedScan

    @classmethod
    def of(cls, scan: SelectedScan) -> ViewFilters:
        """The filters of a selection.

        Raises:
            ConfigError: a filter would mix pixels whose photons are counted.
        """
        selection = scan.selection
        outcomes = {step.name: step.on(scan) for step in in_order(selection) if isinstance(step, ViewStep)}
        filters = tuple(each for each, _ in outcomes.values() if each is not None)
        if filters and selection.step(Preparation).noise == "counts":
            filter_mixes = filters[-1].mixes
            raise ConfigError(
                f"Omit --noise counts or the filter: {filter_mixes} neighbouring pixels, and the counts of mixed "
                "pixels have no known likelihood."
            )
        done = {name: each for name, (_, each) in outcomes.items()}
        return cls(filters, done, scan)

    def read(self, rows: slice | None) -> slice:
        """Detector rows to read for some binned rows (None: all), with the margin that filters need."""
        return self._widened(rows)[0]

    def within(self, rows: slice | None) -> slice:
        """These binned rows as a slice of the data that are read for all rows."""
        first, part = self.read(None).start, self.read(rows)
        return slice(*((edge - first) // self.scan.selection.binning for edge in (part.start, part.stop)))

    def apply(self, views: Projections, rows: slice | None) -> Projections:
        """Apply all filters to the projections, and return the requested rows."""
        if not self.filters or not views.view_ids.size:
            return views
        read, inner_rows = self._widened(rows)
        for each in self.filters:
            views = each.apply(views, read.start)
        return replace(views, data=np.ascontiguousarray(views.data[:, inner_rows]), masked=views.masked[inner_rows])

    def _widened(self, rows: slice | None) -> tuple[slice, slice]:
        """The detector rows to read, and the requested rows among them, in binned rows."""
        n, reach = self.scan.selection.binning, sum(each.reach for each in self.filters)
        first, end = self.scan.selection.detector_rows.start, self.scan.selection.detector_rows.stop
        if rows is not None:
            start, stop, _ = rows.indices((end - first) // n)
            first, end = first + start * n, first + stop * n
        above = min(reach, first // n)
        below = min(reach, (self.scan.selection.shape[0] - end) // n)
        return slice(first - above * n, end + below * n), slice(above, above + (end - first) // n)


class NoViewError(DataError):
    """None of the requested projections can be used."""


def read_views(
    filters: ViewFilters,
    references: References | None,
    frames: NDArray[np.int64],
    rows: slice | None,
    warn: Warn | None = None,
    progress: Callable[[int, int], None] = lambda n, total: None,
) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """The usable frames, and their pixels [frame, row, col]. A usable frame has a finite pixel, has beam, and is not
    damaged. `rows` are binned rows; None: all rows.

    Args:
        references: darks and flats of the rows that `filters` read, binned; None: the frames are line integrals.
        warn: function that gets sentences about frames that are copies, and about frames that are left out, except if
            they have no beam (see `no_beam_sentence`).
    """
    evidence, source = filters.scan.evidence, filters.scan.source
    data = read_binned(source, frames, filters.read(rows), filters.scan.selection.binning, progress)
    left_out, reported = damaged_frames(filters.scan, frames)
    data, frames = (data[~left_out], frames[~left_out]) if left_out.any() else (data, frames)
    has_finite_pixel = np.isfinite(data).any(axis=(1, 2))
    if not has_finite_pixel.all():
        without_pixels = frames[~has_finite_pixel]
        if rows is None:  # a band of rows is not enough to decide whether a projection is usable
            first_frame = without_pixels[0]
            have = "has" if without_pixels.size == 1 else "have"
            are = "is" if without_pixels.size == 1 else "are"
            reported.append(
                f"{without_pixels.size} of {source.table.views.size} projections {have} no finite pixel and {are} left "
                f"out (first: frame {first_frame})."
            )
        data, frames = data[has_finite_pixel], frames[has_finite_pixel]
    exposed, part = np.ones(len(frames), np.bool_), filters.within(rows)
    beam = None if references is None else (references.dark[part], references.flats[0][1][part])
    for view in np.flatnonzero(evidence.illumination.suspect(data, beam)):
        exposed[view] = not evidence.illumination.without_beam(int(frames[view]))
    if not exposed.all():
        data, frames = data[exposed], frames[exposed]
    if warn is not None:
        if rows is None and references is not None:
            reported += _copies(evidence, data, frames)
        for sentence in reported:
            warn(sentence)
    return data, frames


def _copies(scan: ScanEvidence, data: NDArray[Any], frames: NDArray[np.int64]) -> list[str]:
    """A sentence about projections whose pixels are all equal to those of the projection before, because no camera
    takes the same counts twice.
    """
    middle = data.shape[1] // 2
    # the middle row is enough to distinguish most projections quickly
    alike = np.flatnonzero((data[1:, middle] == data[:-1, middle]).all(axis=1))
    copies = [int(frames[view + 1]) for view in alike if np.array_equal(data[view], data[view + 1])]
    if not copies or 2 * len(copies) >= len(frames):  # if most projections are equal, the images were computed
        return []
    are = "is" if len(copies) == 1 else "are"
    return [
        "Omit these frames with --views or --flags judge, or repeat these projections: "
        f"{count(len(copies), 'projection')} of {scan.source.table.views.size} ({frames_text(copies)}) {are} "
        "identical to the projection before. The camera or its driver delivered an image twice, so the angle of the "
        "copy is wrong."
    ]


def no_beam_sentence(scan: ScanEvidence, requested: NDArray[np.int64], exposed: NDArray[np.int64]) -> str:
    """A sentence about requested projections without beam, and the gap in angle if they are left out; empty if none is
    known to be without beam.

    Args:
        requested: frames of the projections that were requested.
        exposed: those of them that can be used.
    """
    without_beam = np.intersect1d(
        np.setdiff1d(requested, exposed), np.array(scan.illumination.known_without_beam, np.int64)
    )
    if not without_beam.size:
        return ""
    gap = f", which leaves {gap_text}" if (gap_text := new_gap(scan, requested, exposed)) else ""
    these_are = "This projection is" if without_beam.size == 1 else "These projections are"
    return (
        f"{count(without_beam.size, 'projection')} of {scan.source.table.views.size} ({frames_text(without_beam)}) had "
        "no beam: the shutter was closed, the beam was lost, or these frames were never written to the file. "
        f"{these_are} left out{gap}."
    )


def no_view(scan: ScanEvidence, references: References | None) -> NoViewError:
    """The error if none of the projections can be used."""
    beside_flats = (
        ""
        if references is None
        else f" The brightest projections have {scan.illumination.brightest:.2g} of the intensity of the flats. If the "
        "projections were already divided by their flats, give --quantity transmission or "
        "line-integrals."
    )
    return NoViewError(
        f"{scan.source.path}: none of the chosen projections can be used. Their pixels are "
        f"unreadable, not finite, without beam, or differ from their checksums.{beside_flats}"
    )
