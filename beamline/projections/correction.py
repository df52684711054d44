"""Correction of a scan's frames: line integrals as they are read, at once or in batches while the scan still runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from beamline.core.errors import ConfigError, DataError
from beamline.core.text import count, spans
from beamline.projections.read import (
    current_scale,
    open_beam,
    photons_of,
    read_binned,
    read_references,
    use_current,
    with_dynamic_flats,
)
from beamline.projections.selection import Selection, rows_of
from beamline.projections.steps.air import Air
from beamline.projections.steps.counts import CountModel
from beamline.projections.steps.defects import Defects
from beamline.projections.steps.flags import Flags
from beamline.projections.steps.flats import Flats
from beamline.projections.steps.references import ReferenceCheck
from beamline.projections.steps.step import StepDone, ViewFilter, ViewStep
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.references import reference_groups
from beamline.storage.rules.validate import altered_said
from drivers.base.frame import FrameKind
from recon.base.arrays import Mask
from recon.prep.correct import Correction, CorrectionSettings, Projections, References, Transmission, UnlitViewsError
from recon.prep.counts import Photons
from recon.prep.defects import SHADOW_REACH, shadowed

_LEAST_VIEWS, _SHADOW_VIEWS, _BAND = 8, 16, 64  # by which a shadow is found, and rows at a time
_STEPS = 3  # of a frame: it is read, divided by the flat, and freed of zingers

Warn = Callable[[str], None]
"""Takes a sentence about something that is wrong though work goes on."""


class ScanCorrection:
    """Reads frames of one scan as line integrals, in the rows and with the binning of a selection.

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
        self.rows, self.binning = rows_of(source, selection), selection.binning
        counted = selection.step(CountModel).noise == "counts"
        self._filters: list[ViewFilter] = []
        self._filtered: dict[str, StepDone] = {}
        for step in selection.in_order:
            if isinstance(step, ViewStep):
                found, self._filtered[step.name] = step.on(source, selection)
                self._filters += [] if found is None else [found]
        if self._filters:
            if counted:
                raise ConfigError(
                    f"{self._filters[-1].mixes} neighbouring pixels, so that --noise counts has no likelihood for them."
                )
            selection = selection.having(CountModel("log"))
        self._source, self._selection, self._warn = source, selection, warn
        if source.altered:
            warn(altered_said(source))
        defects = selection.step(Defects)
        self._settings = CorrectionSettings(
            defects.floor, defects.hot_threshold, defects.zinger_threshold, selection.step(Air).columns
        )
        self._current_factor = current_scale(source) if use_current(selection) else None  # [frame], by the ring current
        wide, _ = self._widened(None)
        self._n_references = _count_references(source)
        self._references: References | None = None
        self._shadow: Mask | None = None  # [row, col] of the rows read, binned; None: not looked for
        self.photons: Photons | None = None
        if counted and source.quantity != "counts":
            raise ConfigError(f"--noise counts: {source.path} holds line integrals, not counts. Leave it out.")
        if source.quantity == "counts":
            groups = reference_groups(source)
            used = groups if selection.step(ReferenceCheck).accepted else groups.good()
            self._references = read_references(source, used, wide, selection)
            if selection.step(Flats).fields == "dynamic":
                self._references = with_dynamic_flats(source, used, self._references, wide, selection)
            self._tell_damaged(np.concatenate([*used.darks, *used.flats]))
            self._tell_parts_without_flats(self._references)
            self.photons = photons_of(source, used, self._references, self.rows, selection)
        self._stream: Correction | None = None
        self._columns: set[tuple[int, int]] = set()  # air columns by which views were corrected

    def at_once(
        self,
        frames: NDArray[np.int64],
        rows: slice | None = None,
        progress: Callable[[int, int], None] = lambda n, total: None,
    ) -> Projections:
        """Line integrals of `frames` (rows of the file), without those that hold no finite pixel: see `view_ids`.

        Args:
            frames: rows of the file, in the order they were taken.
            rows: narrows the detector rows, in binned rows.
            progress: how many of how many frames are done; each is read, divided by the flat, and freed of zingers.

        Raises:
            DataError: frames that cannot be corrected; the message names the file.
        """
        self._look_for_shadow(frames)
        steps = 1 if self._references is None else _STEPS
        data, frames = self._read(frames, rows, lambda n, of: progress(n // steps, of))
        if not frames.size:
            raise self._no_view()
        if self._references is None:
            return self._filtered_views(_as_given(data, frames), rows)
        return self._corrected(self._correction(rows), data, frames, last=True, rows=rows, progress=progress)

    def in_batches(
        self, frames: NDArray[np.int64], out: NDArray[np.float32], batch: int, progress: Callable[[int, int], None]
    ) -> Projections:
        """As `at_once`, to the bit, with no more than `batch` frames in memory; the scan is read twice.

        Args:
            out: float32 [frame, row, col], at least so many: takes the line integrals.
            progress: how many of how many frames were read.

        Raises:
            DataError: as `at_once`; photons are counted: their weights would have to be in memory.
        """
        if self.photons is not None:
            raise DataError(
                f"{self._source.path}: photons are counted, which needs all views in "
                f"memory. Give --noise log, or --bin {2 * self.binning}."
            )
        self._look_for_shadow(frames)
        parts, passes = np.split(frames, np.arange(batch, frames.size, batch)), 1 if self._references is None else 2
        stream, columns, alive = None, (0, 0), []
        if self._references is not None:
            survey = self._correction(None)
            for done, part in enumerate(parts):
                data, found = self._read(part, None)
                alive.append(found)
                if found.size:
                    survey.survey(self._transmission(survey, data, found))
                progress(min((done + 1) * batch, frames.size), passes * frames.size)
            columns = survey.air_columns
            settings = replace(self._settings, air=columns if any(columns) else "none")
            stream = Correction(self._references, settings, masked=survey.masked)
            parts = [found for found in alive if found.size]
        at, kept, begun = 0, [], (passes - 1) * frames.size
        for done, part in enumerate(parts):
            last = done == len(parts) - 1
            data, found = self._read(part, None)
            if stream is not None:
                corrected = self._corrected(stream, data, found, last)
            elif found.size:
                corrected = self._filtered_views(_as_given(data, found), None)
            else:
                continue
            n = len(corrected.data)
            out[at : at + n] = corrected.data
            at += n
            kept.append(replace(corrected, data=np.empty((0, *out.shape[1:]), np.float32)))
            progress(begun + min((done + 1) * batch, frames.size), passes * frames.size)
        if not at:
            raise self._no_view()
        return _joined(kept, out[:at])

    def feed(self, frames: NDArray[np.int64], *, last: bool) -> Projections | None:
        """Line integrals of the next frames; None where there are none yet, since the newest view waits for the next.

        Args:
            frames: rows of the file, those after the frames fed before; may be none where `last`.
            last: no frame will come after these.

        Raises:
            DataError: as `at_once`.
        """
        data, frames = self._read(frames, None)
        if self._references is None:
            return self._filtered_views(_as_given(data, frames), None) if frames.size else None
        if self._stream is None:
            self._stream = self._correction(None)
        if not frames.size and not (last and self._stream.waiting):
            return None
        part = self._corrected(self._stream, data, frames, last)
        if not part.view_ids.size:
            return None
        self._columns.add(part.air_columns)
        return part

    def newest(self) -> Projections | None:
        """Line integrals of the newest view while it waits for the next, as if none came after it."""
        part = None if self._stream is None else self._stream.provisional()
        return None if part is None else self._filtered_views(part, None)

    @property
    def done(self) -> dict[str, StepDone]:
        """What each step did, by name."""
        if self._references is None:
            return {**{name: StepDone(parameters={}) for name in ("flats", "defects", "noise")}, **self._filtered}
        flats, noise, settings = self._flats, self._noise, asdict(self._settings)
        recorded = {name: value if isinstance(value, float) else str(value) for name, value in settings.items()}
        return {
            "defects": StepDone(parameters={f"correction_{name}": value for name, value in recorded.items()}),
            "flats": StepDone(flats, {"flats": flats or self._selection.step(Flats).fields}),
            "noise": StepDone(noise, {"noise": noise or "logarithms of counts"}),
            **self._filtered,
        }

    @property
    def _flats(self) -> str:
        """What was done about changes of the beam, in words; empty where nothing was asked."""
        said = []
        if self._current_factor is not None:
            currents = 1 / self._current_factor[self._source.image_key == FrameKind.PROJECTION]
            said.append(
                f"Ring current of the views: {currents.min():.3f} to {currents.max():.3f} times its median; corrected."
            )
        if self._references is not None and self._references.dynamic is not None:
            n = len(self._references.dynamic.components)
            said.append(
                f"Flats: {count(n, 'component')} of their changes, weighed for each view (dynamic)."
                if n
                else "Flats: they do not differ by more than noise; their mean is used."
            )
        return " ".join(said)

    def _look_for_shadow(self, views: NDArray[np.int64]) -> None:
        """Find what stands in the beam of all views of a finished scan, by some of these; once."""
        known = self._references is None or self._shadow is not None
        if known or not self._source.finished or views.size < _LEAST_VIEWS:
            return
        assert self._references is not None
        references, first = replace(self._references, dynamic=None), self._widened(None)[0].start
        found = np.zeros(self._references.dark.shape, np.bool_)
        views = views[np.linspace(0, views.size - 1, min(views.size, _SHADOW_VIEWS)).astype(int)]
        for start in range(0, len(found), _BAND):
            rows = slice(max(0, start - SHADOW_REACH), min(len(found), start + _BAND + SHADOW_REACH))
            read = slice(first + rows.start * self.binning, first + rows.stop * self.binning)
            data = np.nan_to_num(read_binned(self._source, views, read, self.binning))
            plain = Correction(references.rows(rows), replace(self._settings, air="none"))
            light = plain.transmission(data, views.astype(np.float64)).data
            found[start : start + _BAND] = shadowed(light, self._settings.floor)[start - rows.start :][:_BAND]
        self._shadow = np.zeros_like(found) if found.all() else found

    @property
    def _noise(self) -> str:
        """How counts become line integrals, in words; empty where they are logarithms."""
        if self.photons is None or self._references is None:
            return ""
        light, readout = open_beam(self._references, self.photons), self.photons.variance**0.5
        return (
            f"Photons are counted: {light:.3g} a pixel in the open beam, {self.photons.gain:.3g} counts each, readout "
            f"noise {readout:.3g} counts"
        )

    @property
    def outdated(self) -> bool:
        """Views that were fed would be corrected otherwise now: by references that came later, or other air columns."""
        if self._references is None or self._stream is None:
            return False
        return _count_references(self._source) != self._n_references or self._columns != {self._stream.air_columns}

    def renewed(self) -> ScanCorrection:
        """A correction of the same views by all references that are there now."""
        return ScanCorrection(self._source, self._selection, self._warn)

    def _read(
        self,
        frames: NDArray[np.int64],
        rows: slice | None,
        progress: Callable[[int, int], None] = lambda n, total: None,
    ) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Pixels [frame, row, col] of the frames that hold a finite one and are not damaged, and these frames."""
        data = read_binned(self._source, frames, self._widened(rows)[0], self.binning, progress)
        alive = np.isfinite(data).any(axis=(1, 2))
        if not alive.all():
            lost = frames[~alive]
            self._warn(f"{lost.size} of {len(frames)} views hold no finite pixel (first: frame {lost[0]}): left out.")
            data, frames = data[alive], frames[alive]
        if (damaged := self._tell_damaged(frames)).any() and self._selection.step(Flags).used:
            data, frames = data[~damaged], frames[~damaged]
        return data, frames

    def _tell_damaged(self, frames: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the frames are not what was written, as far as they were read; a warning names them."""
        damaged = np.isin(frames, sorted(self._source.damaged))
        if damaged.any():
            taken = "left out" if self._selection.step(Flags).used else "used as they are (--flags ignore)"
            self._warn(
                f"Frames {spans(np.sort(frames[damaged]).tolist())} do not have the pixels that were written, by their "
                f"checksums: {taken}. Look for a good copy of {self._source.path}."
            )
        return damaged

    def _tell_parts_without_flats(self, references: References) -> None:
        """A warning for each part of the scan whose views are corrected by the flats of another part."""
        starts = self._source.part_starts
        flats = [position for position, _ in references.flats]
        for start, end in zip(starts, [*starts[1:], self._source.image_key.size], strict=True):
            has_views = (self._source.image_key[start:end] == FrameKind.PROJECTION).any()
            if has_views and not any(start <= position < end for position in flats):
                self._warn(
                    f"Frames {start}-{end - 1}, a part of the scan, have no flats of their own that can be used. The "
                    f"nearest flats of another part correct their views, though the beam may have changed."
                )

    def _no_view(self) -> DataError:
        return DataError(
            f"{self._source.path}: none of the views chosen can be used: their pixels are not finite, or not those "
            "that were written."
        )

    def _correction(self, rows: slice | None) -> Correction:
        assert self._references is not None
        first = self._widened(None)[0].start
        part = self._widened(rows)[0]
        within = slice((part.start - first) // self.binning, (part.stop - first) // self.binning)
        references = self._references.rows(within)
        try:
            found = Correction(references, self._settings, photons=self.photons)
            if self._shadow is not None and (shadow := self._shadow[within]).any():
                found = Correction(references, self._settings, found.masked | shadow, self.photons)
            return found
        except ValueError as error:
            raise self._refusal(error) from error

    def _widened(self, rows: slice | None) -> tuple[slice, slice]:
        """Detector rows to read for some binned rows (None: all), with the rows around that a filter or new pixels
        need. Then which of the rows read are wanted, in binned rows."""
        first, end = self.rows.start, self.rows.stop
        if rows is not None:
            start, stop, _ = rows.indices((end - first) // self.binning)
            first, end = first + start * self.binning, first + stop * self.binning
        n, reach = self.binning, sum(each.reach for each in self._filters)
        above = min(reach, first // n)
        below = min(reach, (self._source.shape[0] - end) // n)
        return slice(first - above * n, end + below * n), slice(above, above + (end - first) // n)

    def _filtered_views(self, part: Projections, rows: slice | None) -> Projections:
        """The views through the filters of the steps, in the rows wanted."""
        if not self._filters or not part.view_ids.size:
            return part
        read, wanted = self._widened(rows)
        for each in self._filters:
            part = each.apply(part, read.start)
        return replace(part, data=np.ascontiguousarray(part.data[:, wanted]), masked=part.masked[wanted])

    def _corrected(
        self,
        correction: Correction,
        data: NDArray[Any],
        frames: NDArray[np.int64],
        last: bool,
        rows: slice | None = None,
        progress: Callable[[int, int], None] = lambda n, total: None,
    ) -> Projections:
        n = frames.size
        try:
            views = None
            if n:
                views = self._transmission(correction, data, frames, lambda done: progress((n + done) // _STEPS, n))
                correction.survey(views)
            lines = correction.line_integrals(views, last, lambda done: progress((2 * n + done) // _STEPS, n))
            return self._filtered_views(lines, rows)
        except UnlitViewsError as error:
            judged = self._selection.step(Flags).judged
            advice = "" if judged else " (--flags judge leaves out what the monitor finds dark)"
            raise DataError(
                f"{self._refusal(error)}{advice}; if the sample covers these columns, --air none"
            ) from error
        except ValueError as error:
            raise self._refusal(error) from error

    def _transmission(
        self,
        correction: Correction,
        data: NDArray[Any],
        frames: NDArray[np.int64],
        progress: Callable[[int], None] = lambda done: None,
    ) -> Transmission:
        try:
            views = correction.transmission(data, frames.astype(np.float64), frames, progress)
        except ValueError as error:
            raise self._refusal(error) from error
        if self._current_factor is not None:
            light = self._current_factor[frames].astype(np.float32)[:, None, None]
            np.multiply(views.data, light, out=views.data)
            if views.beam is not None:
                np.divide(views.beam, light, out=views.beam)
        return views

    def _refusal(self, error: ValueError) -> DataError:
        return DataError(f"{self._source.path} cannot be corrected: {error}")


def _count_references(source: ScanSource) -> int:
    return int(np.isin(source.image_key, (FrameKind.DARK, FrameKind.FLAT)).sum())


def _joined(parts: list[Projections], data: NDArray[np.float32]) -> Projections:
    """Batches as one, with their line integrals in `data`; a pixel is masked where it is in all of them."""
    n = np.array([part.view_ids.size for part in parts], np.float64)
    share = n / n.sum()
    floored, replaced = (float(share @ [getattr(part, name) for part in parts]) for name in ("floored", "replaced"))
    ids, air = (np.concatenate([getattr(part, name) for part in parts]) for name in ("view_ids", "air"))
    masked = np.logical_and.reduce([part.masked for part in parts])
    return Projections(data, ids, floored, air, masked, parts[-1].air_columns, replaced)


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
