"""Correction of a scan's frames: line integrals as they are read, at once or in batches while the scan still runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.sinks import Warn
from beamline.core.text import count, frames_text
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.corrections.references import current_scale
from beamline.projections.open_beam import SHADOW_VIEWS, OpenBeam, count_references
from beamline.projections.read import ViewFilters, read_binned, reading_memory, tell_damaged
from beamline.projections.selection import Selection
from beamline.projections.step import StepDone
from beamline.projections.usable_views import gap_sentence
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.references import ViewLight, usual_exposure
from beamline.storage.rules.scan import altered_sentence
from recon.base.arrays import Mask
from recon.base.views import spread
from recon.prep.correct import (
    Correction,
    LineIntegralCorrection,
    Projections,
    UnlitViewsError,
    merge_and_empty,
    provisional,
)
from recon.prep.counts import Photons
from recon.prep.spots import Transmission
from recon.prep.unmeasured import foreign_rows

_COPIES = 3  # float32 copies of the views that are corrected at once
_STEPS = 3  # of a frame: it is read, divided by the flat, and freed of spots


class NoViewError(DataError):
    """None of the requested views can be used."""


class ScanCorrection:
    """Converts frames of one scan to line integrals, in the rows and with the binning of a selection.

    `at_once` corrects frames that are all there. `feed` takes them in batches as they come. It gives the same line
    integrals to the bit, as long as the references and the air columns stay the same. `outdated` says when they did
    not. Then `renewed` corrects by what is known now.
    """

    def __init__(self, source: ScanSource, selection: Selection, warn: Warn) -> None:
        """Read the reference frames that the scan has; groups with a fault only where no other is left.

        Raises:
            ConfigError: rows or binning that do not fit the detector; counted photons of a scan without counts, or
                without the counts of a photon.
            DataError: references that cannot be used.
        """
        self._filters = ViewFilters.of(source, selection)
        self.rows, self.binning = self._filters.rows, selection.binning
        if self._filters.filters:
            selection = selection.with_steps(replace(selection.step(Preparation), noise="log", gain=None))
        self._source, self._selection, self._warn = source, selection, warn
        if source.table.altered.any():
            warn(altered_sentence(source))
        self._beam: OpenBeam | None = None
        self._shadow: tuple[Mask, Mask] | None = None  # as of `OpenBeam.shadow`; None: not looked for
        self._fed_by: tuple[Mask, Mask] | None = None  # that which `feed` corrects for
        if source.quantity == "counts":
            self._beam = OpenBeam.of(source, selection, self._filters.read(None), self.rows, warn)
        elif selection.step(Preparation).noise == "counts":
            raise ConfigError(f"--noise counts: {source.path} contains line integrals, not counts. Leave it out.")
        elif selection.step(Preparation).by_current:
            current_scale(source)  # refuses a file without any
        self._named_unlit: set[int] = set()  # views without light that were named
        self._light = ViewLight.of(source, None if self._beam is None else self._beam.used)
        self._stream: Correction | LineIntegralCorrection | None = None
        self._columns: set[tuple[int, int]] = set()  # air columns by which views were corrected
        self._fed = np.zeros(0, np.int64)

    @property
    def photons(self) -> Photons | None:
        """The photon statistics of the pixels; None if they do not count photons or if logarithms are taken."""
        return None if self._beam is None else self._beam.photons

    def at_once(
        self,
        frames: NDArray[np.int64],
        rows: slice | None = None,
        progress: Callable[[int, int], None] = lambda n, total: None,
    ) -> Projections:
        """Line integrals of `frames` (rows of the file), without views that have no finite pixel: see `view_ids`.

        Args:
            frames: rows of the file, in the order they were taken.
            rows: narrows the detector rows, in binned rows.
            progress: how many of how many frames are done; each is read, divided by the flat, and freed of spots.

        Raises:
            DataError: frames that cannot be corrected; the message names the file.
        """
        self._look_for_shadow(frames)
        steps = 1 if self._beam is None else _STEPS
        asked = frames
        data, frames = self._read(frames, rows, lambda n, of: progress(n // steps, of))
        if rows is None:  # in a band it says nothing of the views
            self._tell_unlit(asked, frames)
        if not frames.size:
            raise self._no_view()
        return self._corrected(
            self._correction(rows), data, frames, last=True, rows=rows, progress=progress, whole=True
        )

    def in_batches(
        self, frames: NDArray[np.int64], out: NDArray[np.float32], batch: int, progress: Callable[[int, int], None]
    ) -> Projections:
        """The same bits as `at_once`, with at most `batch` frames in memory; the scan is read twice.

        Args:
            out: float32 [frame, row, col], at least so many: takes the line integrals.
            progress: how many of how many frames were read.

        Raises:
            DataError: as `at_once`; photons are counted: their weights would have to be in memory.
        """
        if self.photons is not None:
            raise DataError(
                f"{self._source.path}: --noise counts needs all views in memory. Give --noise log, or --bin "
                f"{2 * self.binning}."
            )
        self._look_for_shadow(frames)
        in_time, frames = np.sort(frames), frames[self._by_angle(frames)]
        parts, passes = np.split(frames, np.arange(batch, frames.size, batch)), 1 if self._beam is None else 2
        stream, alive, kept, begun = self._correction(None), [], [], (passes - 1) * frames.size
        if self._beam is not None:
            for done, part in enumerate(parts):
                data, usable = self._read(part, None)
                alive.append(usable)
                if usable.size:
                    stream.survey(self._transmission(stream, data, usable))
                progress(min((done + 1) * batch, frames.size), passes * frames.size)
            columns = stream.air_columns
            settings = replace(self._beam.settings, air=columns if any(columns) else "none")
            stream = Correction(
                self._beam.references, settings, stream.masked, foreign=self._shadow and self._shadow[1]
            )
            parts = [usable for usable in alive if usable.size]
        for done, part in enumerate(parts):
            last = done == len(parts) - 1
            data, usable = self._read(part, None)
            if not usable.size and not (last and stream.spots.waiting):
                continue
            corrected = self._corrected(stream, data, usable, last)
            out[np.searchsorted(in_time, corrected.view_ids)] = corrected.data
            kept.append(replace(corrected, data=np.empty((0, *out.shape[1:]), np.float32)))
            progress(begun + min((done + 1) * batch, frames.size), passes * frames.size)
        ids = np.sort(np.concatenate([part.view_ids for part in kept])) if kept else frames[:0]
        self._tell_unlit(in_time, ids)
        if not ids.size:
            raise self._no_view()
        for at, place in enumerate(np.searchsorted(in_time, ids)):  # without the views that are left out
            if at != place:
                out[at] = out[place]
        masked = np.logical_and.reduce([part.masked for part in kept])
        found = merge_and_empty(kept, out[: ids.size])
        return replace(found, masked=masked, view_ids=ids, air=found.air[np.argsort(found.view_ids)])

    def feed(self, frames: NDArray[np.int64], *, last: bool) -> Projections | None:
        """Line integrals of the next frames; None while none is ready: the newest view waits for its successor.

        Args:
            frames: rows of the file, those after the frames fed before; may be none where `last`.
            last: no frame will come after these.

        Raises:
            DataError: as `at_once`.
        """
        asked, (data, frames) = frames, self._read(frames, None)
        self._tell_unlit(asked, frames)
        self._fed = np.append(self._fed, frames)
        if self._stream is None:
            self._stream, self._fed_by = self._correction(None), self._shadow
        if not frames.size and not (last and self._stream is not None and self._stream.spots.waiting):
            return None
        part = self._corrected(self._stream, data, frames, last)
        if not part.view_ids.size:
            return None
        self._columns.add(part.air_columns)
        return part

    def newest(self) -> Projections | None:
        """Line integrals of the newest view, which still waits for its successor, as if none followed."""
        part = None if self._stream is None else provisional(self._stream)
        return None if part is None else self._filters.apply(part, None)

    def open_beam(self, most: int) -> NDArray[np.float32]:
        """Line integrals [frame, row, col] of at most so many flats that follow one another, corrected as views are.

        They are scaled so that their noise is that of the exposure of a view. No frame where the scan has line
        integrals already.

        Raises:
            DataError: as `at_once`.
        """
        if self._beam is None:
            return np.zeros((0, 0, 0), np.float32)
        flats = self._beam.used.flats[-1][:most]
        exposures = float(np.median(self._source.table.exposures[flats])) / usual_exposure(self._source)
        return self.quiet().at_once(flats).data * np.float32(math.sqrt(exposures) if exposures > 0 else 1.0)

    @property
    def done(self) -> dict[str, StepDone]:
        """What each correction step did, by the name of the step."""
        asked = self._selection.step(Preparation)
        return {asked.name: asked.done, **(self._beam.done if self._beam else {}), **self._filters.done}

    @property
    def outdated(self) -> bool:
        """Whether views already fed would now be corrected differently: by references that came later, other air
        columns, or neighbours in angle that were not taken beside them.
        """
        finds_spots = np.isfinite(self._selection.step(Preparation).zinger_threshold)
        if finds_spots and (np.diff(self._by_angle(self._fed)) != 1).any():
            return True
        if self._beam is None or self._stream is None:
            return False
        more = count_references(self._source) != self._beam.n_references
        return more or self._columns != {self._stream.air_columns}

    def finds_shadow(self, views: NDArray[np.int64]) -> bool:
        """Whether an object stands in the beam of these views of a finished scan that `feed` took for sample."""
        self._look_for_shadow(views)
        found = self._shadow
        return found is not None and found is not self._fed_by and any(part.any() for part in found)

    def quiet(self) -> ScanCorrection:
        """A correction with the same references for a few views, without warnings."""
        other = copy(self)
        other._warn, other._shadow = lambda sentence: None, None
        return other

    def renewed(self) -> ScanCorrection:
        """A correction of the same views with all references recorded by now."""
        return ScanCorrection(self._source, self._selection, self._warn)

    def _read(
        self,
        frames: NDArray[np.int64],
        rows: slice | None,
        progress: Callable[[int, int], None] = lambda n, total: None,
    ) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Pixels [frame, row, col] of the frames that hold a finite one and are not damaged, and these frames."""
        data = read_binned(self._source, frames, self._filters.read(rows), self.binning, progress)
        lost = tell_damaged(self._source, self._selection, frames, self._warn)
        data, frames = (data[~lost], frames[~lost]) if lost.any() else (data, frames)
        alive = np.isfinite(data).any(axis=(1, 2))
        if not alive.all():
            dark = frames[~alive]
            if rows is None:  # in a band it says nothing of the views
                self._warn(
                    f"{dark.size} of {self._source.table.views.size} views hold no finite pixel (first: frame "
                    f"{dark[0]}): left out."
                )
            data, frames = data[alive], frames[alive]
        lit = np.ones(len(frames), np.bool_)
        part, beam = self._filters.within(rows), self._beam
        references = (None, None) if beam is None else (beam.references.dark[part], beam.references.flats[0][1][part])
        for at in np.flatnonzero(self._light.suspect(data, *references)):
            lit[at] = not self._light.unlit(int(frames[at]))
        if not lit.all():
            data, frames = data[lit], frames[lit]
        if rows is None and self._beam is not None:
            self._warn_of_copies(data, frames)
        return data, frames

    def _warn_of_copies(self, data: NDArray[Any], frames: NDArray[np.int64]) -> None:
        """Warn of views that equal the one before pixel by pixel: no camera takes the same counts twice."""
        middle = data.shape[1] // 2
        alike = np.flatnonzero((data[1:, middle] == data[:-1, middle]).all(axis=1))  # soon tells most of them apart
        copies = [int(frames[at + 1]) for at in alike if np.array_equal(data[at], data[at + 1])]
        if copies and 2 * len(copies) < len(frames):  # where most are, they were computed
            self._warn(
                f"{count(len(copies), 'view')} of {self._source.table.views.size} ({frames_text(copies)}) with the "
                "pixels of the view before: the camera or its driver gave an image twice. Such angles are wrong for "
                "what is shown: leave them out with --views or --flags judge, or repeat them."
            )

    def _no_view(self) -> NoViewError:
        beside_flats = (
            ""
            if self._light.flat is None
            else f" The brightest have {self._light.usual:.2g} of the flats' light. Where views were divided by their "
            "flats already, say --quantity transmission, or line-integrals."
        )
        return NoViewError(
            f"{self._source.path}: no chosen view can be used. Their pixels cannot be read, are not finite, have no "
            f"light, or differ from their checksums.{beside_flats}"
        )

    def _tell_unlit(self, asked: NDArray[np.int64], lit: NDArray[np.int64]) -> None:
        """Name the views without light among those asked for, once, and the gap that they leave."""
        unlit = np.array([row for row in asked.tolist() if self._light.known.get(row) is False], np.int64)
        if (news := np.setdiff1d(unlit, sorted(self._named_unlit))).size == 0:
            return
        gap = f", and{gap_text}" if (gap_text := gap_sentence(self._source, asked, lit)) else ""
        self._named_unlit.update(news.tolist())
        self._warn(
            f"{count(news.size, 'view')} of {self._source.table.views.size} ({frames_text(news)}) without "
            "light: the shutter was closed, the beam was gone, or the file was never written there. Such views are "
            f"left out{gap}."
        )

    def _look_for_shadow(self, views: NDArray[np.int64]) -> None:
        """Find what stands in the beam of all views of a finished scan, by some of these; once."""
        if self._shadow is not None or not self._source.finished:
            return
        read, some = self._filters.read(None), spread(views, SHADOW_VIEWS)
        if self._beam is not None:
            try:
                self._shadow = self._beam.shadow(self._source, views, read.start, self.binning)
            except ValueError as error:
                raise self._refusal(error) from error
        elif views.size >= SHADOW_VIEWS:
            given = read_binned(self._source, some, read, self.binning)
            lines = LineIntegralCorrection(np.inf).transmission(given, some.astype(np.float64), some).data
            foreign = foreign_rows(np.exp(-lines), self._source.table.angles[some])
            self._shadow = np.zeros(lines.shape[1:], np.bool_), foreign

    def _by_angle(self, frames: NDArray[np.int64]) -> NDArray[np.intp]:
        """The order of frames in which neighbours are beside each other: as taken, unless that skips angles or has the
        sample aside in some, which then come together.
        """
        angles, aside = self._source.table.angles[frames], self._source.table.aside
        places = np.zeros(frames.size) if aside is None else np.nan_to_num(aside[frames])
        steps = np.diff(np.unwrap(angles))
        in_time = ((steps >= 0).all() or (steps <= 0).all()) and not np.diff(places).any()
        return np.arange(frames.size) if in_time else np.lexsort((angles, places))

    def _correction(self, rows: slice | None) -> Correction | LineIntegralCorrection:
        if self._beam is None:
            foreign = None if self._shadow is None else self._shadow[1][self._filters.within(rows)]
            return LineIntegralCorrection(self._selection.step(Preparation).zinger_threshold, foreign)
        try:
            return self._beam.correction(self._filters.within(rows), self._shadow)
        except ValueError as error:
            raise self._refusal(error) from error

    def _corrected(
        self,
        correction: Correction | LineIntegralCorrection,
        data: NDArray[Any],
        frames: NDArray[np.int64],
        last: bool,
        rows: slice | None = None,
        progress: Callable[[int, int], None] = lambda n, total: None,
        whole: bool = False,
    ) -> Projections:
        """Line integrals; `whole`: no other frames come, and these have their neighbours by angle."""
        n, order = frames.size, self._by_angle(frames) if whole else None
        try:
            views = None
            if n:
                views = self._transmission(correction, data, frames, lambda done: progress((n + done) // _STEPS, n))
                correction.survey(views)
            lines = correction.line_integrals(views, last, lambda done: progress((2 * n + done) // _STEPS, n), order)
            return self._filters.apply(lines, rows)
        except UnlitViewsError as error:
            judged = self._selection.step(Preparation).judged
            advice = "" if judged else " (--flags judge leaves out what the monitor finds dark)"
            raise DataError(
                f"{self._refusal(error)}{advice}; if the sample covers these columns, --air none"
            ) from error
        except ValueError as error:
            raise self._refusal(error) from error

    def _transmission(
        self,
        correction: Correction | LineIntegralCorrection,
        data: NDArray[Any],
        frames: NDArray[np.int64],
        progress: Callable[[int], None] = lambda done: None,
    ) -> Transmission:
        try:
            views = correction.transmission(data, frames.astype(np.float64), frames, progress)
        except ValueError as error:
            raise self._refusal(error) from error
        if self._beam is not None and self._beam.light is not None:
            light = self._beam.light[frames].astype(np.float32)[:, None, None]
            np.multiply(views.data, light, out=views.data)
            if views.beam is not None:
                np.divide(views.beam, light, out=views.beam)
        return views

    def _refusal(self, error: ValueError) -> DataError:
        return DataError(f"{self._source.path} cannot be corrected: {error}")


def at_once_memory(source: ScanSource, selection: Selection, frames: int, rows: slice | None = None) -> int:
    """Memory in bytes for correcting so many frames at once, line integrals included; `rows` as in `at_once`.

    Raises:
        ConfigError: the selection does not fit the scan.
    """
    read = ViewFilters.of(source, selection).read(rows)
    pixels = frames * (read.stop - read.start) * source.shape[1] // selection.binning**2
    return reading_memory(source, frames, read, selection.binning) + 4 * _COPIES * pixels
