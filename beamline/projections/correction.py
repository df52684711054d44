"""Correction of a scan's frames with one plan: all at once, in batches, or one by one during the scan."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.sinks import Warn
from beamline.projections.open_beam import OpenBeam, Shadow, foreign_to_lines
from beamline.projections.preparation import Preparation
from beamline.projections.read import ViewFilters, ViewReader, reading_memory
from beamline.projections.references import current_scale
from beamline.projections.selection import ScanSelection
from beamline.projections.step import StepDone
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.scan import altered_sentence
from recon.prep import counts_plan
from recon.prep.correct import Plan, apply
from recon.prep.counts_plan import CorrectionPlan, UnlitViewsError
from recon.prep.lines_plan import LinesPlan
from recon.prep.projections import Projections, merge_and_empty

_COPIES = 3  # float32 copies of the projections that are corrected at once
_STEPS = 3  # steps per frame in the progress: reading, dividing by the flat, removing zingers
NO_VIEWS = np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class ScanCorrectionPlan:
    """How the frames of one scan are converted to line integrals, for the rows and the binning of a selection.

    Attributes:
        filters: filters of projections, with the rows and the binning.
        beam: the open beam; None: the frames are line integrals already.
        preparation: of the selection; logarithms if filters mix pixels.
        shadow: objects in the beam of all projections; None: not searched for.
    """

    filters: ViewFilters
    beam: OpenBeam | None
    preparation: Preparation
    shadow: Shadow | None = None

    @property
    def done(self) -> dict[str, StepDone]:
        """What each correction step did, by the name of the step."""
        asked = self.preparation
        return {asked.name: asked.done, **(self.beam.done if self.beam else {}), **self.filters.done}

    def of_rows(self, rows: slice | None) -> CorrectionPlan | LinesPlan:
        """The plan of some binned rows, with the margin that filters need; of all rows for None.

        Raises:
            ValueError: references that cannot be used.
        """
        read, beam = self.filters.within(rows), self.beam
        standing, foreign = (None, None) if self.shadow is None else (part[read] for part in self.shadow)
        if beam is None:
            return LinesPlan.of(self.preparation.zinger_threshold, foreign)
        references, photons, light = beam.references.rows(read), beam.photons, beam.light
        return counts_plan.survey(
            references, beam.settings, standing=standing, photons=photons, foreign=foreign, light=light
        )  # fmt: skip

    def in_shadow(self, source: ScanSource, views: NDArray[np.int64]) -> ScanCorrectionPlan:
        """The plan with the objects that stand in the beam of all projections of a finished scan, found in some of
        these.
        """
        read, n = self.filters.read(None), self.filters.selection.binning
        if not source.finished:
            return self
        if self.beam is None:
            return replace(self, shadow=foreign_to_lines(source, views, read, n))
        with refused(source, self.preparation):
            return replace(self, shadow=self.beam.shadow(source, views, read.start, n))


def survey(
    scan: ScanEvidence, selection: ScanSelection, warn: Warn, views: NDArray[np.int64] = NO_VIEWS
) -> ScanCorrectionPlan:
    """Read the reference frames that the scan has, and some projections of a finished scan.

    Groups of references with a fault are used only if no other group is left.

    Args:
        views: rows of the file: usable projections, in which objects that stand in the beam of all are searched for;
            empty: no search.

    Raises:
        ConfigError: rows or binning that do not fit the detector; counted photons of a scan without counts, or
            without the counts of a photon.
        DataError: references that cannot be used.
    """
    source, beam = scan.source, None
    filters = ViewFilters.of(source, selection)
    if filters.filters:
        selection = selection.with_steps(replace(selection.step(Preparation), noise="log", gain=None))
    asked = selection.step(Preparation)
    if source.table.altered.any():
        warn(altered_sentence(source))
    if source.quantity == "counts":
        beam = OpenBeam.of(scan, selection, filters.read(None), warn)
    elif asked.noise == "counts":
        raise ConfigError(f"Omit --noise counts: {source.path} contains line integrals, not counts.")
    elif asked.by_current:
        current_scale(scan)  # raises an error if the file has no ring current
    plan = ScanCorrectionPlan(filters, beam, asked)
    return plan.in_shadow(source, views) if views.size else plan


@contextmanager
def refused(source: ScanSource, asked: Preparation) -> Iterator[None]:
    """Turn a ValueError about the numbers into a DataError that names the file."""
    try:
        yield
    except UnlitViewsError as error:
        advice = "" if asked.judged else " (--flags judge leaves out frames that the monitor finds dark)"
        raise DataError(
            f"{source.path} cannot be corrected: {error}{advice}. If the sample covers these columns, give --air none"
        ) from error
    except ValueError as error:
        raise DataError(f"{source.path} cannot be corrected: {error}") from error


class ScanCorrection:
    """Converts frames of one scan to line integrals with its plan.

    `at_once` corrects frames that are all present. `feed` takes them in batches as they arrive. Both give
    bit-identical line integrals as long as the references and the air columns stay the same. `outdated` is True when
    they have changed; `renewed` then corrects with what is known now.
    """

    def __init__(
        self, scan: ScanEvidence, selection: ScanSelection, warn: Warn, views: NDArray[np.int64] = NO_VIEWS
    ) -> None:
        """Read references and some projections; arguments and errors are those of `survey`."""
        self.plan = survey(scan, selection, warn, views)
        self.rows, self.binning = selection.detector_rows, selection.binning
        self._scan, self.source, self._selection = scan, scan.source, selection
        references = None if self.plan.beam is None else self.plan.beam.references
        self._reader = ViewReader(scan, selection, self.plan.filters, references, warn)
        self._stream: CorrectionPlan | LinesPlan | None = None  # with the projections fed so far
        self._columns: set[tuple[int, int]] = set()  # air columns with which projections were corrected
        self._fed = NO_VIEWS

    def at_once(
        self,
        frames: NDArray[np.int64],
        rows: slice | None = None,
        progress: Callable[[int, int], None] = lambda n, total: None,
    ) -> Projections:
        """Line integrals of `frames` (rows of the file), without projections that have no finite pixel: see
        `view_ids`.

        Args:
            frames: rows of the file, in the order they were taken.
            rows: narrows the detector rows, in binned rows.
            progress: function that gets the number of frames done and their total number; each frame is read, divided
                by the flat, and cleared of zingers.

        Raises:
            DataError: frames that cannot be corrected; the message names the file.
        """
        steps = 1 if self.plan.beam is None else _STEPS
        data, usable = self._reader.read(frames, rows, lambda n, of: progress(n // steps, of))
        if rows is None:  # a band of rows does not show whether a projection is usable
            self._reader.tell_unlit(frames, usable)
        if not (n := usable.size):
            raise self._reader.no_view()
        with refused(self.source, self.plan.preparation):
            order, at = _by_angle(self.source.table, usable), usable.astype(np.float64)
            lines, _ = apply(
                data, at, self.plan.of_rows(rows), usable, progress=lambda done: progress((n + done) // _STEPS, n),
                order=order,
            )  # fmt: skip
        return self.plan.filters.apply(lines, rows)

    def in_batches(
        self, frames: NDArray[np.int64], out: NDArray[np.float32], batch: int, progress: Callable[[int, int], None]
    ) -> Projections:
        """Line integrals bit-identical to those of `at_once`, with at most `batch` frames in memory; the scan is read
        twice.

        Args:
            out: float32 [frame, row, col], at least so many: takes the line integrals.
            progress: how many of how many frames were read.

        Raises:
            DataError: as `at_once`; photons are counted: their weights would have to be in memory.
        """
        if self.plan.beam is not None and self.plan.beam.photons is not None:
            raise DataError(
                f"{self.source.path}: --noise counts needs all projections in memory. Give --noise log, "
                f"or --bin {2 * self.binning}."
            )
        in_time, frames = np.sort(frames), frames[_by_angle(self.source.table, frames)]
        parts, kept = np.split(frames, np.arange(batch, frames.size, batch)), list[Projections]()
        passes = 1 if self.plan.beam is None else 2

        def done(parts: int, before: int) -> None:
            progress(before * frames.size + min(parts * batch, frames.size), passes * frames.size)

        with refused(self.source, self.plan.preparation):
            plan = self.plan.of_rows(None)
            if isinstance(plan, CorrectionPlan):
                parts, plan = self._with_air_found(parts, plan, lambda n: done(n, 0))
            for n, part in enumerate(parts, 1):
                lines, plan = self._next(*self._reader.read(part, None), plan, last=n == len(parts))
                if lines is not None:
                    out[np.searchsorted(in_time, lines.view_ids)] = lines.data
                    kept.append(replace(lines, data=np.empty((0, *out.shape[1:]), np.float32)))
                    done(n, passes - 1)
        ids = np.sort(np.concatenate([part.view_ids for part in kept])) if kept else frames[:0]
        self._reader.tell_unlit(in_time, ids)
        if not ids.size:
            raise self._reader.no_view()
        for at, place in enumerate(np.searchsorted(in_time, ids)):  # without the projections that are left out
            if at != place:
                out[at] = out[place]
        masked = np.logical_and.reduce([part.masked for part in kept])
        found = merge_and_empty(kept, out[: ids.size])
        return replace(found, masked=masked, view_ids=ids, air=found.air[np.argsort(found.view_ids)])

    def _with_air_found(
        self, parts: list[NDArray[np.int64]], plan: CorrectionPlan, done: Callable[[int], None]
    ) -> tuple[list[NDArray[np.int64]], CorrectionPlan]:
        """The frames of each part that can be used, and the plan with the air columns of all of them."""
        usable = []
        for n, part in enumerate(parts, 1):
            data, some = self._reader.read(part, None)
            if some.size:
                usable.append(some)
                plan = plan.surveyed(plan.transmission(data, some.astype(np.float64), some))
            done(n)
        return usable, replace(plan, settings=replace(plan.settings, air=plan.air_columns), profiles=())

    def _next(
        self, data: NDArray[Any], frames: NDArray[np.int64], plan: Plan, last: bool
    ) -> tuple[Projections | None, Plan]:
        """Line integrals of the next frames, None if none is ready; and the plan of those that follow."""
        if not frames.size and not (last and plan.spots.waiting is not None):
            return None, plan
        lines, plan = apply(data, frames.astype(np.float64), plan, frames, last=last)
        return self.plan.filters.apply(lines, None), plan

    def feed(self, frames: NDArray[np.int64], *, last: bool) -> Projections | None:
        """Line integrals of the next frames; None while none is ready: the newest projection waits for the next one.

        Args:
            frames: rows of the file, those after the frames fed before; may be none if `last`.
            last: no frame will come after these.

        Raises:
            DataError: as `at_once`.
        """
        data, usable = self._reader.read(frames, None)
        self._reader.tell_unlit(frames, usable)
        self._fed = np.append(self._fed, usable)
        with refused(self.source, self.plan.preparation):
            lines, self._stream = self._next(data, usable, self._stream or self.plan.of_rows(None), last)
        if lines is None or not lines.view_ids.size:
            return None
        self._columns.add(lines.air_columns)
        return lines

    def newest(self) -> Projections | None:
        """Line integrals of the newest projection, which still waits for the next one, as if none followed.

        It keeps waiting, because all its zingers are found only if both neighbours are known.
        """
        none = np.empty((0, 0, 0), np.float32)
        return None if self._stream is None else self._next(none, NO_VIEWS, self._stream, last=True)[0]

    def open_beam(self, most: int) -> NDArray[np.float32]:
        """Line integrals [frame, row, col] of at most N consecutive flats, corrected like projections.

        They are scaled so that their noise is that of the exposure of a projection. No frames if the scan contains
        line integrals already.

        Raises:
            DataError: as `at_once`.
        """
        if self.plan.beam is None:
            return np.zeros((0, 0, 0), np.float32)
        flats = self._scan.used.flats[-1][:most]
        exposures = float(np.median(self.source.table.exposures[flats])) / self._scan.usual_exposure
        return self.quiet().at_once(flats).data * np.float32(math.sqrt(exposures) if exposures > 0 else 1.0)

    @property
    def outdated(self) -> bool:
        """True if projections already fed would now be corrected differently: references came later, the air columns
        changed, or neighbours in angle were not known then.
        """
        finds_spots = np.isfinite(self.plan.preparation.zinger_threshold)
        if finds_spots and (np.diff(_by_angle(self.source.table, self._fed)) != 1).any():
            return True
        if self.plan.beam is None or self._stream is None:
            return False
        then, now = ((table.darks.size, table.flats.size) for table in (self._scan.table, self.source.table))
        return then != now or self._columns != {self._stream.air_columns}

    def finds_shadow(self, views: NDArray[np.int64]) -> bool:
        """True if `feed` treated an object in the beam of all these projections of a finished scan as part of the
        sample.
        """
        shadow = None if self.plan.shadow is not None else self.plan.in_shadow(self.source, views).shadow
        return shadow is not None and any(part.any() for part in shadow)

    def quiet(self) -> ScanCorrection:
        """The same correction without warnings."""
        other = copy(self)
        other._reader = replace(self._reader, warn=lambda sentence: None)
        return other

    def renewed(self, views: NDArray[np.int64] = NO_VIEWS) -> ScanCorrection:
        """A correction with all references recorded by now; `views` as in `survey`."""
        return ScanCorrection(self._scan.renewed(), self._selection, self._reader.warn, views)


def line_integrals_of(scan: ScanEvidence, selection: ScanSelection, frames: NDArray[np.int64]) -> Projections:
    """Line integrals of some frames of a finished scan, corrected on their own and without a warning.

    Raises:
        ConfigError, DataError: as in `survey` and `ScanCorrection.at_once`.
    """
    return ScanCorrection(scan, selection, lambda sentence: None, frames).at_once(frames)


def _by_angle(table: FrameTable, frames: NDArray[np.int64]) -> NDArray[np.intp]:
    """The order of frames in which neighbours in angle follow one another.

    It is the order of the scan, unless that skips angles, or the sample is offset in some frames; these are then
    grouped.
    """
    angles, places = table.angles[frames], np.zeros(frames.size)
    if table.aside is not None:
        places = np.nan_to_num(table.aside[frames])
    steps = np.diff(np.unwrap(angles))
    in_time = ((steps >= 0).all() or (steps <= 0).all()) and not np.diff(places).any()
    return np.arange(frames.size) if in_time else np.lexsort((angles, places))


def at_once_memory(source: ScanSource, selection: ScanSelection, frames: int, rows: slice | None = None) -> int:
    """Memory in bytes that is needed to correct N frames at once, including the line integrals; `rows` as in `at_once`.

    Raises:
        ConfigError: the selection does not fit the scan.
    """
    read = ViewFilters.of(source, selection).read(rows)
    pixels = frames * (read.stop - read.start) * source.shape[1] // selection.binning**2
    return reading_memory(source, frames, read, selection.binning) + 4 * _COPIES * pixels
