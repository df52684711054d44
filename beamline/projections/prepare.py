"""From the frames of a scan to line integrals and their geometry: only the views and rows asked for are ever held."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.phases import Phases
from beamline.core.sinks import Warn
from beamline.projections.axis import rotation_axis
from beamline.projections.correction import ScanCorrection
from beamline.projections.flag_regions import Regions
from beamline.projections.flags import UsableViews, usable_views
from beamline.projections.jumps import find_jumps
from beamline.projections.replay import judged_flags
from beamline.projections.selection import (
    Selection,
    choose_views,
    geometry_of,
    pixel_size,
    rows_of,
)
from beamline.projections.steps.flags import Flags
from beamline.projections.steps.references import ReferenceCheck
from beamline.projections.steps.resampling import TiltAndLens
from beamline.projections.steps.step import ScanStep, StepDone
from beamline.projections.tilt import spread, warn_of_tilt, with_tilt
from beamline.storage.flag_legend import FrameFlags
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.finding import Finding
from beamline.storage.rules.flags import frames_flagged
from beamline.storage.rules.references import references_usable
from beamline.storage.rules.validate import quantity_said, references_present, scan_findings
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from recon.base.masks import RayWeights, areas, masked
from recon.base.volume import Grid
from recon.prep.align import AxisEstimate
from recon.prep.correct import Projections
from recon.voxels.projector import seen_rays

_AXIS_VIEWS = 360  # more views do not sharpen the axis, they only cost reading
_AXIS_ROWS = 64
_HELD_OUT_VIEWS = 16


@dataclass(frozen=True, eq=False)
class PreparedProjections:
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
        view_weights: float32 [view], less than 1 for views with a warning of the monitor; None: one for all.
        left_out: views with an alarm of the monitor, or that a jump spoils: the selection does not choose from them.
        flags: of all frames of the scan; None where there are none.
        measured: bool [row, col], pixels that were measured, or interpolated well; None: all.
        shares: float32 [view, row, col], weights of rays in the regions of flags; None: all 1.
        jumps: what was done about jumps of the sample; empty where there was none.
        done: what each step did, by name, in the order in which it did.
        shares_of: `shares` of some rows [view, row, col], where line integrals lie on disk and these are made when
            wanted; None: as `shares` says.
    """

    projections: Projections
    geometry: Geometry
    axis_col: float
    axis: AxisEstimate | None
    held_out: tuple[NDArray[np.float32], Geometry] | None
    n_projections: int
    length_unit: str
    quantity: str
    view_weights: NDArray[np.float32] | None = None
    left_out: int = 0
    flags: FrameFlags | None = None
    measured: NDArray[np.bool_] | None = None
    shares: NDArray[np.float32] | None = None
    jumps: str = ""
    done: Mapping[str, StepDone] = field(default_factory=dict)
    shares_of: Callable[[slice], NDArray[np.float32] | None] | None = None

    @property
    def on_disk(self) -> bool:
        """Line integrals lie on disk, where rays that weigh nothing were filled from their neighbours."""
        return isinstance(self.projections.data, np.memmap)

    def of_rows(self, rows: slice, geometry: Geometry) -> PreparedProjections:
        """The same views in some detector rows, which `geometry` is of; line integrals stay where they are."""

        def cut(array: NDArray[Any] | None) -> NDArray[Any] | None:
            return None if array is None else array[..., rows, :]

        found, held = self.projections, self.held_out
        if held is not None:
            held = held[0][:, rows], held[1].rows(rows.start, rows.stop)
        shares = cut(self.shares) if self.shares_of is None else self.shares_of(rows)
        return replace(
            self,
            projections=replace(found, data=found.data[:, rows], masked=found.masked[rows], weights=cut(found.weights)),
            geometry=geometry,
            held_out=held,
            measured=cut(self.measured),
            shares=shares,
            shares_of=None,
        )

    def ray_weights(self, others: int = 0) -> NDArray[np.float32] | None:
        """Weights [view, row, col] as `ray_factors` says, read-only."""
        factors = self.ray_factors(others)
        return None if factors is None else factors[...]

    def ray_factors(self, others: int = 0) -> RayWeights | None:
        """Weights [view, row, col], computed only where they are asked for; None: one for all rays.

        Args:
            others: views after these, which weigh 1, as a usual ray of these does.
        """
        factors: list[NDArray[np.float32]] = []
        if self.view_weights is not None:
            factors.append(_and_ones(self.view_weights, others)[:, None, None])
        if (counted := self.projections.weights) is not None:
            factors.append(_and_ones(counted / counted.mean(where=counted > 0), others))
        if self.measured is not None:
            factors.append(self.measured.astype(np.float32)[None])
        if np.ptp(self.geometry.shifts[:, 1]) > 0:
            seen = seen_rays(self.geometry, Grid.matching(self.geometry)).astype(np.float32)
            factors.append(_and_ones(seen, others)[:, :, None])
        if self.shares is not None:
            factors.append(_and_ones(self.shares, others))
        if not factors:
            return None
        shape = (self.geometry.n_views + others, *self.geometry.detector_shape)
        return RayWeights(tuple(np.broadcast_to(factor, shape) for factor in factors))


@dataclass(frozen=True, eq=False)
class Spill:
    """Line integrals on disk instead of in memory, for work in slabs.

    Attributes:
        views: float32 [view, row, col], at least as many as are chosen: takes the line integrals.
        batch: views that are corrected at a time.
        progress: how many of how many frames were read.
    """

    views: NDArray[np.float32]
    batch: int
    progress: Callable[[int, int], None]


def prepare_projections(
    source: ScanSource,
    selection: Selection,
    warn: Warn,
    spill: Spill | None = None,
    check: Callable[[Geometry], object] | None = None,
    phases: Phases | None = None,
) -> PreparedProjections:
    """Read, correct and align what `selection` asks for.

    Args:
        source: a finished scan.
        selection: what to use.
        warn: is told, in a sentence, of everything that is not as it should be though work goes on.
        spill: where line integrals lie. Rays that were not measured, or weigh nothing by the flags, are filled there as
            a direct method does it, and `shares` is None.
        check: raises what is wrong with the geometry of the views, as soon as the axis is known: before they are
            corrected.
        phases: is told what is done, one after the other.

    Raises:
        DataError: the scan cannot be reconstructed; the message says why and what to do.
        ConfigError: the selection does not fit the scan.
    """
    phases = phases or Phases()
    phases.enter("flags and references")
    usable = checked_views(source, selection, warn)
    scan_frames = usable.frames
    pixel_size(source, selection)
    choose_views(source, scan_frames, selection)  # what is wrong with the words is told before any frame is read
    phases.enter("tilt and references", "bands")
    selection, sought = with_tilt(source, selection, scan_frames, warn, phases.progress)
    correction = ScanCorrection(source, selection, warn)
    warn_of_tilt(source, selection, correction, scan_frames, warn, phases.progress)
    phases.enter("rotation axis")
    axis_col, axis = rotation_axis(source, selection, correction, usable, warn, phases.progress)
    phases.enter("jumps", "guesses")
    jumps = find_jumps(source, selection, scan_frames, usable.jumps, axis_col, phases.progress)
    if jumps.said:
        warn(jumps.said)
    usable = replace(usable, frames=jumps.frames, left_out=usable.left_out + scan_frames.size - jumps.frames.size)
    scan_frames = jumps.frames
    period = geometry_of(source, selection, axis_col, source.angles[scan_frames]).period
    chosen = choose_views(source, scan_frames, selection, period)
    if check is not None:
        ids = scan_frames[chosen]
        check(jumps.corrected(geometry_of(source, selection, axis_col, source.angles[ids]), ids))
    phases.enter("correction")
    if spill is None:
        projections = correction.at_once(scan_frames[chosen], progress=phases.progress)
    else:
        projections = correction.in_batches(scan_frames[chosen], spill.views, spill.batch, spill.progress)
    phases.enter("background, rings, views held out, hardening", "corrections")
    rest = np.setdiff1d(np.arange(scan_frames.size), chosen)
    others, held_out = None, None
    if rest.size:
        others = correction.at_once(scan_frames[spread(rest, _HELD_OUT_VIEWS)])
        unseen = geometry_of(source, selection, axis_col, source.angles[others.view_ids])
        held_out = others.data, jumps.corrected(unseen, others.view_ids)
    ids = projections.view_ids
    geometry = jumps.corrected(geometry_of(source, selection, axis_col, source.angles[ids]), ids)
    regions = replace(usable.regions, resampling=selection.step(TiltAndLens).of(source, selection))
    shares_of = None
    if spill is not None:
        rows = rows_of(source, selection)
        if regions.mark(ids):
            shares_of = partial(_shares_of, regions, ids, rows, selection.binning, projections.data.shape[2])
        usable = replace(usable, regions=Regions())
    found = assemble(source, selection, projections, (axis_col, axis), usable, warn, held_out)
    done = {**correction.done, **({"tilt": selection.step(TiltAndLens).done(sought)} if sought else {})}
    found = replace(found, geometry=geometry, jumps=jumps.said, shares_of=shares_of)
    steps = [step for step in selection.in_order if isinstance(step, ScanStep)]
    for n, step in enumerate(steps, 1):
        done[step.name] = step.apply(found, source.angles[ids])
        phases.progress(n, len(steps))
    found = replace(found, done=done)
    if spill is not None:
        _fill_unknown(found, regions, rows_of(source, selection), selection.binning)
    return found


def _fill_unknown(found: PreparedProjections, regions: Regions, rows: slice, binning: int) -> None:
    """Fill, view by view, what `ray_weights` says weighs nothing, as `masked` does for all views."""
    data, ids, geometry = found.projections.data, found.projections.view_ids, found.geometry
    seen = seen_rays(geometry, Grid.matching(geometry)) if np.ptp(geometry.shifts[:, 1]) > 0 else None
    for view in range(len(data)):
        known = np.ones(geometry.detector_shape, np.float32)
        if found.measured is not None:
            known *= found.measured
        if (shares := regions.weights(ids[view : view + 1], rows, binning, geometry.detector_shape)) is not None:
            known *= shares[0]
        if seen is not None:
            known *= seen[view][:, None]
        if not known.all():
            data[view] = masked(data[view : view + 1], known[None])[0][0]


def _shares_of(
    regions: Regions, view_ids: NDArray[np.int64], rows: slice, binning: int, cols: int, part: slice
) -> NDArray[np.float32] | None:
    """Weights of the rays in the regions of flags, in some of the binned rows."""
    within = slice(rows.start + part.start * binning, rows.start + part.stop * binning)
    return regions.weights(view_ids, within, binning, (part.stop - part.start, cols))


def checked_views(source: ScanSource, selection: Selection, warn: Warn) -> UsableViews:
    """The views of a finished scan that may be used, by the flags of the monitor.

    What else its file lacks is told as a warning, also what its flags mean for this scan.

    Raises:
        DataError: it cannot be reconstructed; with every reason, and what to do about each.
    """
    flags = selection.step(Flags)
    judged = judged_flags(source) if flags.judged and source.finished else None
    findings = [*scan_findings(source), *references_usable(source, selection.step(ReferenceCheck).accepted)]
    if flags.used:
        findings += [finding for finding in frames_flagged(source, judged) if finding.severity == "error"]
    refuse(source, findings)
    usable = usable_views(source, flags.used, judged)
    if usable.said:
        warn(usable.said)
    for finding in findings:
        if finding.severity == "warning":
            warn(finding.message)
    return usable


def assemble(
    source: ScanSource,
    selection: Selection,
    projections: Projections,
    axis: tuple[float, AxisEstimate | None],
    usable: UsableViews,
    warn: Warn,
    held_out: tuple[NDArray[np.float32], Geometry] | None = None,
) -> PreparedProjections:
    """Corrected views with their geometry, after a look at what correction had to repair.

    Args:
        axis: the column, and how it was found; None where it was given.
        usable: the views that were chosen from.

    Raises:
        DataError: fewer than two views, or nothing in the beam.
    """
    report_defects(projections, warn)
    if projections.view_ids.size < 2:
        raise DataError(
            f"{source.path}: only {projections.view_ids.size} of the views chosen can be used, 2 are needed."
        )
    if not projections.data.any():
        raise DataError(f"{source.path}: the views chosen are zero everywhere; there is nothing in the beam.")
    axis_col, estimate = axis
    rows, shape = rows_of(source, selection), projections.data.shape[1:]
    unknown, resampling = projections.masked, selection.step(TiltAndLens).of(source, selection)
    if resampling is not None:
        unknown = unknown | resampling.unseen((shape[0], shape[1]), rows.start)
    unknown = areas(unknown)
    regions = replace(usable.regions, resampling=resampling)
    return PreparedProjections(
        projections=projections,
        geometry=geometry_of(source, selection, axis_col, source.angles[projections.view_ids]),
        axis_col=axis_col,
        axis=estimate,
        held_out=held_out,
        n_projections=int((source.image_key == FrameKind.PROJECTION).sum()),
        length_unit="px" if pixel_size(source, selection) is None else "mm",
        quantity=source.quantity,
        view_weights=usable.weights_of(projections.view_ids),
        left_out=usable.left_out,
        flags=usable.flags,
        shares=regions.weights(projections.view_ids, rows, selection.binning, (shape[0], shape[1])),
        measured=~unknown if unknown.any() else None,
    )


def refuse(source: ScanSource, findings: Iterable[Finding]) -> None:
    """Raises DataError for the errors among the findings, with what to do about each."""
    reasons = [finding.message for finding in findings if finding.severity == "error"]
    if reasons:
        raise DataError(f"{source.path} cannot be reconstructed. " + "\n  ".join(reasons))


def correction_blockers(source: ScanSource, selection: Selection) -> list[Finding]:
    """Why the frames of a scan that is still growing cannot be corrected."""
    checked = () if selection.step(ReferenceCheck).accepted else (references_usable,)
    rules = (quantity_said, references_present, *checked)
    return [finding for rule in rules for finding in rule(source)]


def report_defects(projections: Projections, warn: Warn) -> None:
    """Tell of what correction had to repair, where it is more than a stray pixel in a thousand."""
    unseen = areas(projections.masked)
    masked = float((projections.masked & ~unseen).mean())
    if unseen.mean() > 1e-3:
        warn(f"{unseen.mean():.1%} of the detector got no beam: its rays count as not measured.")
    if masked > 1e-3:
        warn(f"{masked:.1%} of the detector's pixels are dead or hot and were filled from their neighbours.")
    if projections.replaced > 1e-3:
        warn(f"{projections.replaced:.1%} of the pixels were zingers or not finite: filled from their neighbours.")
    if projections.floored > 1e-3:
        warn(
            f"{projections.floored:.1%} of the pixels let less light through than the floor; their attenuation is at "
            "least what the volume says."
        )


def _and_ones(values: NDArray[np.float32], others: int) -> NDArray[np.float32]:
    """The values of views, and ones for others after them."""
    return np.concatenate((values, np.ones((others, *values.shape[1:]), np.float32)))
