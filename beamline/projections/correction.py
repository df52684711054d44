"""Corrects the frames of a scan: `survey` makes a plan, and `apply` uses the plan to convert frames to line
integrals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.sinks import Warn
from beamline.projections.open_beam import Shadow, noise_sentence, photons_of, shadow_on_counts, shadow_on_lines
from beamline.projections.preparation import Preparation
from beamline.projections.protocols import CountsStep
from beamline.projections.read import (
    ViewFilters,
    damaged_frames,
    no_beam_sentence,
    no_view,
    read_views,
    reading_memory,
)
from beamline.projections.references import (
    current_factors,
    flats_sentence,
    intensity_factors_of,
    parts_without_flats,
    read_references,
    with_dynamic_flats,
)
from beamline.projections.registry import in_order
from beamline.projections.selection import SelectedScan
from beamline.projections.step import StepDone
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.scan import altered_sentence
from recon.base.arrays import F64
from recon.prep import correct, counts_plan
from recon.prep.correct import Plan
from recon.prep.counts import Photons
from recon.prep.counts_plan import CorrectionPlan, CorrectionSettings, ViewsWithoutBeamError
from recon.prep.lines_plan import LinesPlan
from recon.prep.projections import Projections, merge_and_empty
from recon.prep.references import References

_COPIES = 3  # number of float32 copies of the projections that are corrected together
_STEPS = 3  # steps per frame in the progress: reading, dividing by the flat, removing zingers
NO_VIEWS = np.empty(0, np.int64)
Done = Callable[[int, int], None]  # (n, N): n of N frames are done


@dataclass(frozen=True, eq=False)
class ScanCorrectionPlan:
    """How the frames of one scan are converted to line integrals, for the rows and the binning of a selection.

    Attributes:
        filters: filters of projections, with the rows and the binning.
        settings: settings of the conversion of counts.
        references: darks and flats of the rows that are read, binned; None: the frames are already line integrals.
        photons: how pixels count photons; None: logarithms are taken.
        intensity_factors: float64 [frame], factor that scales the frame to the usual exposure and, on request, to the
            median ring current; None: 1 for all.
        shadow: objects in the beam of all projections; None: not searched for, or too few projections.
        beam_done: what was done about flats, defects and noise, as texts by name.
        warnings: sentences on damaged references, on zingers in them, and on parts of the scan without flats.
    """

    filters: ViewFilters
    settings: CorrectionSettings
    references: References | None = None
    photons: Photons | None = None
    intensity_factors: F64 | None = None
    shadow: Shadow | None = None
    beam_done: Mapping[str, StepDone] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def scan(self) -> SelectedScan:
        """The scan at the time when the plan was made, with its rows, binning and steps."""
        return self.filters.scan

    @property
    def source(self) -> ScanSource:
        """Reads the frames."""
        return self.scan.source

    @property
    def done(self) -> dict[str, StepDone]:
        """What each correction step did, by the name of the step."""
        preparation = self.scan.selection.step(Preparation)
        return {preparation.name: preparation.done, **self.beam_done, **self.filters.done}

    def of_rows(self, rows: slice | None) -> Plan:
        """The plan for some binned rows, with the margin that filters need. None: for all rows.

        Raises:
            ValueError: references that cannot be used.
        """
        read = self.filters.within(rows)
        shadow, foreign = (None, None) if self.shadow is None else (part[read] for part in self.shadow)
        if self.references is None:
            return LinesPlan.of(self.settings.zinger_threshold, foreign)
        return counts_plan.survey(
            self.references.rows(read),
            self.settings,
            shadow=shadow,
            photons=self.photons,
            foreign=foreign,
            intensity_factors=self.intensity_factors,
        )


def survey(scan: SelectedScan, views: NDArray[np.int64] = NO_VIEWS) -> ScanCorrectionPlan:
    """Read the reference frames that the scan has, and some projections of a finished scan.

    Groups of references with a fault are used only if no other group is left.

    Args:
        views: rows of the usable projections. In them, objects that stand in the beam of all projections are searched
            for; empty: no search.

    Raises:
        ConfigError: rows or binning do not fit the detector; photon counting was requested, but the scan has no counts
            or the counts per photon are unknown; there are too few flats for dynamic flats; or the ring current is
            missing.
        DataError: references that cannot be used.
    """
    source, settings = scan.source, CorrectionSettings()
    for step in in_order(scan.selection):
        settings = step.settings(settings) if isinstance(step, CountsStep) else settings
    altered = (altered_sentence(source),) if source.table.altered.any() else ()
    plan = ScanCorrectionPlan(ViewFilters.of(scan), settings, warnings=altered)
    preparation = scan.selection.step(Preparation)
    if plan.filters.filters:  # these steps mix pixels, so the likelihood of the counts is no longer known
        preparation = replace(preparation, noise="log", gain=None)
    if source.quantity == "counts":
        plan = _with_references(plan, scan.with_steps(preparation))
    elif preparation.noise == "counts":
        raise ConfigError(f"Omit --noise counts: {source.path} contains line integrals, not counts.")
    elif preparation.by_current:
        current_factors(scan.evidence)  # raises an error if the file has no ring current
    return with_shadow(plan, views) if views.size else plan


def _with_references(plan: ScanCorrectionPlan, scan: SelectedScan) -> ScanCorrectionPlan:
    """The plan with the darks and flats in the file, and the facts about the beam that they show. `scan` has the noise
    model.
    """
    read, preparation, evidence = plan.filters.read(None), scan.selection.step(Preparation), scan.evidence
    scaled = preparation.by_current or evidence.views_differ
    factors = intensity_factors_of(evidence, preparation.by_current) if scaled else None
    references, note = read_references(scan, read)
    if preparation.flat_fields == "dynamic":
        references = with_dynamic_flats(scan, references, read)
    _, damaged = damaged_frames(
        scan, np.concatenate([*evidence.used_references.darks, *evidence.used_references.flats])
    )
    photons = photons_of(scan, references)
    flats, noise = flats_sentence(evidence, references, preparation.by_current), noise_sentence(references, photons)
    stated_settings = {
        name: each if isinstance(each, float) else str(each) for name, each in asdict(plan.settings).items()
    }
    del stated_settings["sample_from"]  # the line follows from --air
    done = {
        "defects": StepDone(parameters={f"correction_{name}": value for name, value in stated_settings.items()}),
        "flats": StepDone(flats, {"flats": flats or preparation.flat_fields}),
        "noise": StepDone(noise, {"noise": noise or "logarithms of counts"}),
    }
    warnings = (*plan.warnings, *([note] if note else []), *damaged, *parts_without_flats(evidence, references))
    return replace(
        plan, references=references, photons=photons, intensity_factors=factors, beam_done=done, warnings=warnings
    )


def with_shadow(plan: ScanCorrectionPlan, views: NDArray[np.int64]) -> ScanCorrectionPlan:
    """The plan with the objects that stand in the beam of all projections of a finished scan, found in some of these
    (rows of the file).
    """
    pixels = plan.source, views, plan.filters.read(None), plan.scan.selection.binning
    if not plan.source.finished:
        return plan
    if plan.references is None:
        return replace(plan, shadow=shadow_on_lines(*pixels))
    with as_data_error(plan):
        return replace(plan, shadow=shadow_on_counts(*pixels, plan.references, plan.settings))


def with_filters_of(plan: ScanCorrectionPlan, scan: SelectedScan, views: NDArray[np.int64]) -> ScanCorrectionPlan:
    """The plan with the filters of another selection of the same rows, of the same scan.

    Frames are read again in two cases: the filters need other rows than before, or they mix pixels whose photons were
    counted.
    """
    filters, before = ViewFilters.of(scan), plan.filters
    if filters.read(None) == before.read(None) and (not filters.filters or plan.photons is None):
        return replace(plan, filters=filters)
    return survey(scan, views)


@contextmanager
def as_data_error(plan: ScanCorrectionPlan) -> Iterator[None]:
    """Turn a ValueError about the numbers into a DataError that names the file."""
    try:
        yield
    except ViewsWithoutBeamError as error:
        judged = plan.scan.selection.step(Preparation).judged
        advice = "" if judged else " (--flags judge leaves out frames that the monitor finds dark)"
        raise DataError(
            f"{plan.source.path} cannot be corrected: {error}{advice}. If the sample covers these columns, give "
            "--air none"
        ) from error
    except ValueError as error:
        raise DataError(f"{plan.source.path} cannot be corrected: {error}") from error


def apply(
    plan: ScanCorrectionPlan,
    frames: NDArray[np.int64],
    rows: slice | None = None,
    warn: Warn | None = None,
    progress: Done = lambda n, total: None,
) -> Projections:
    """Line integrals of `frames` (rows of the file). Projections without a finite pixel are left out; `view_ids` lists
    the others.

    Args:
        frames: rows of the file, in the order they were taken.
        rows: narrows the detector rows, in binned rows.
        warn: function that gets sentences about frames that are left out, and about frames that are copies.
        progress: function that gets the number of frames done and their total number; each frame is read, divided
            by the flat, and cleared of zingers.

    Raises:
        DataError: frames cannot be corrected; the message names the file.
    """
    steps = 1 if plan.references is None else _STEPS
    data, usable = read_usable(plan, frames, rows, warn, lambda n, total: progress(n // steps, total))
    if not (n := usable.size):
        raise no_view(plan.scan.evidence, plan.references)
    with as_data_error(plan):
        order, positions = by_angle(plan.source.table, usable), usable.astype(np.float64)
        lines, _ = correct.apply(
            data, positions, plan.of_rows(rows), usable, progress=lambda done: progress((n + done) // _STEPS, n),
            order=order,
        )  # fmt: skip
    return plan.filters.apply(lines, rows)


def apply_in_batches(
    plan: ScanCorrectionPlan, frames: NDArray[np.int64], out: NDArray[np.float32], batch: int, warn: Warn | None,
    progress: Done,
) -> Projections:  # fmt: skip
    """Line integrals that are bit-identical to those of `apply`, computed with at most `batch` frames in memory. A scan
    in counts is read twice.

    Args:
        out: float32 [frame, row, col], with room for all frames: receives the line integrals.
        warn: as in `apply`.
        progress: function that gets the number of frames read and their total number.

    Raises:
        DataError: as for `apply`; also if photons are counted, because their weights would have to be in memory.
    """
    if plan.photons is not None:
        larger_bin = 2 * plan.scan.selection.binning
        raise DataError(
            f"{plan.source.path}: --noise counts needs all projections in memory. Give --noise log, or --bin "
            f"{larger_bin}."
        )
    frames_by_time, frames = np.sort(frames), frames[by_angle(plan.source.table, frames)]
    parts, batches = np.split(frames, np.arange(batch, frames.size, batch)), list[Projections]()
    passes, warn_again = (1, warn) if plan.references is None else (2, None)

    def done(parts: int, before: int) -> None:
        progress(before * frames.size + min(parts * batch, frames.size), passes * frames.size)

    with as_data_error(plan):
        of_rows = plan.of_rows(None)
        if isinstance(of_rows, CorrectionPlan):
            parts, of_rows = _with_air_found(plan, parts, of_rows, warn, lambda n: done(n, 0))
        for n, part in enumerate(parts, 1):
            pixels = read_views(plan.filters, plan.references, part, None, warn_again)
            lines, of_rows = apply_next(plan, *pixels, of_rows, last=n == len(parts))
            if lines is not None:
                out[np.searchsorted(frames_by_time, lines.view_ids)] = lines.data
                batches.append(replace(lines, data=np.empty((0, *out.shape[1:]), np.float32)))
                done(n, passes - 1)
    ids = np.sort(np.concatenate([part.view_ids for part in batches])) if batches else frames[:0]
    if warn is not None and (sentence := no_beam_sentence(plan.scan.evidence, frames_by_time, ids)):
        warn(sentence)
    if not ids.size:
        raise no_view(plan.scan.evidence, plan.references)
    for row, stored_row in enumerate(np.searchsorted(frames_by_time, ids)):  # without the projections that are left out
        if row != stored_row:
            out[row] = out[stored_row]
    masked = np.logical_and.reduce([part.masked for part in batches])
    merged = merge_and_empty(batches, out[: ids.size])
    return replace(merged, masked=masked, view_ids=ids, air=merged.air[np.argsort(merged.view_ids)])


def _with_air_found(
    plan: ScanCorrectionPlan,
    parts: list[NDArray[np.int64]],
    counts: CorrectionPlan,
    warn: Warn | None,
    done: Callable[[int], None],
) -> tuple[list[NDArray[np.int64]], CorrectionPlan]:
    """The usable frames of each part, and the plan for counts with the air columns of all parts."""
    usable = []
    for n, part in enumerate(parts, 1):
        data, view_ids = read_views(plan.filters, plan.references, part, None, warn)
        if view_ids.size:
            usable.append(view_ids)
            counts = counts.surveyed(counts.transmission(data, view_ids.astype(np.float64), view_ids))
        done(n)
    return usable, replace(counts, settings=replace(counts.settings, air=counts.air_columns), profiles=())


def read_usable(
    plan: ScanCorrectionPlan,
    frames: NDArray[np.int64],
    rows: slice | None,
    warn: Warn | None,
    progress: Done = lambda n, total: None,
) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """The usable frames and their pixels, see `read_views`. `warn` also gets a sentence about projections without
    beam.
    """
    data, usable = read_views(plan.filters, plan.references, frames, rows, warn, progress)
    # a band of rows is not enough to decide whether a projection is usable
    if warn is not None and rows is None and (sentence := no_beam_sentence(plan.scan.evidence, frames, usable)):
        warn(sentence)
    return data, usable


def apply_next(
    plan: ScanCorrectionPlan, data: NDArray[Any], frames: NDArray[np.int64], state: Plan, last: bool
) -> tuple[Projections | None, Plan]:
    """Line integrals of the next frames (None if none are ready), and the state for the frames after them.

    Args:
        state: `of_rows(None)` of the plan, after the frames before these.
    """
    if not frames.size and not (last and state.spots.waiting is not None):
        return None, state
    lines, state = correct.apply(data, frames.astype(np.float64), state, frames, last=last)
    return plan.filters.apply(lines, None), state


def line_integrals_of(scan: SelectedScan, frames: NDArray[np.int64]) -> Projections:
    """Line integrals of some frames of a finished scan, corrected without the other frames.

    Raises:
        ConfigError, DataError: as in `survey` and `apply`.
    """
    return apply(survey(scan, frames), frames)


def flats_as_projections(plan: ScanCorrectionPlan, most: int) -> NDArray[np.float32]:
    """Line integrals [frame, row, col] of at most N consecutive flats, corrected like projections.

    They are scaled so that their noise is that of the exposure of a projection. No frames if the scan contains
    line integrals already.

    Raises:
        DataError: as for `apply`.
    """
    if plan.references is None:
        return np.zeros((0, 0, 0), np.float32)
    evidence = plan.scan.evidence
    flats = evidence.used_references.flats[-1][:most]
    exposures = float(np.median(plan.source.table.exposures[flats])) / evidence.usual_exposure
    return apply(plan, flats).data * np.float32(math.sqrt(exposures) if exposures > 0 else 1.0)


def by_angle(table: FrameTable, frames: NDArray[np.int64]) -> NDArray[np.intp]:
    """The order of frames in which neighbours in angle follow one another.

    It is the order of the scan, except in two cases: the scan skips angles, or the sample is offset in some frames.
    Offset frames are then grouped.
    """
    angles, offsets = table.angles[frames], np.zeros(frames.size)
    if table.aside is not None:
        offsets = np.nan_to_num(table.aside[frames])
    steps = np.diff(np.unwrap(angles))
    one_sense = ((steps >= 0).all() or (steps <= 0).all()) and not np.diff(offsets).any()
    return np.arange(frames.size) if one_sense else np.lexsort((angles, offsets))


def at_once_memory(scan: SelectedScan, frames: int, rows: slice | None = None) -> int:
    """Memory in bytes that `apply` needs for N frames, including the line integrals; `rows` is as for `apply`.

    Raises:
        ConfigError: the selection does not fit the scan.
    """
    source, selection, read = scan.source, scan.selection, ViewFilters.of(scan).read(rows)
    pixels = frames * (read.stop - read.start) * source.shape[1] // selection.binning**2
    return reading_memory(source, frames, read, selection.binning) + 4 * _COPIES * pixels
