"""Preparation of a scan: reads, corrects and aligns the chosen projections. Only the selected projections and rows are
in memory.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.durations import Phases
from beamline.core.errors import DataError
from beamline.core.sinks import Warn
from beamline.projections.axis import rotation_axis
from beamline.projections.consistency import compare_with_flats, warn_of_inconsistency
from beamline.projections.correction import ScanCorrectionPlan, apply, apply_in_batches, survey, with_filters_of
from beamline.projections.corrections.poses import ScanPoses, poses_of, require_stated
from beamline.projections.corrections.resampling import TiltAndLens, with_tilt
from beamline.projections.prepared import Corrected, PreparedProjections, ScanOrigin, WeightSources
from beamline.projections.protocols import EstimatedStep, ScanStep, ViewStep
from beamline.projections.read import NoViewError, ViewFilters
from beamline.projections.registry import geometry_steps, in_order
from beamline.projections.scan_warnings import (
    report_defects,
    warn_of_other_axis,
    warn_of_the_field,
    warn_of_units,
)
from beamline.projections.selection import SelectedScan, choose_views
from beamline.projections.tilt import warn_of_tilt
from beamline.projections.usable_views import UsableViews
from beamline.projections.views import ViewGeometry, checked_views
from beamline.storage.readers.base import ScanSource
from recon.base.arrays import I64
from recon.base.geometry import Geometry
from recon.base.masks import areas, masked
from recon.base.view_data import Views
from recon.base.views import spread
from recon.base.volume import Grid
from recon.prep.align import AxisEstimate
from recon.prep.projections import Projections
from recon.voxels.beyond_field import reach_of, whole_reach
from recon.voxels.projector import seen_rays

HELD_OUT_VIEWS = 16
"""Largest number of projections that are held out if the selection leaves some out."""


@dataclass(frozen=True, eq=False)
class DiskBuffer:
    """Line integrals on disk instead of in memory, for a reconstruction in slabs.

    Attributes:
        views: float32 [view, row, col], with room for at least `HELD_OUT_VIEWS` more projections than are selected:
            receives the line integrals.
        batch: number of projections that are corrected together.
    """

    views: NDArray[np.float32]
    batch: int


def prepare_projections(
    scan: SelectedScan,
    warn: Warn,
    buffer: DiskBuffer | None = None,
    check: Callable[[Geometry], object] = lambda geometry: None,
    phases: Phases | None = None,
) -> PreparedProjections:
    """Read, correct and align the selected projections.

    Args:
        scan: a finished scan.
        warn: function that gets a sentence about everything that is unusual but does not stop the work.
        buffer: receives the line integrals on disk; missing rays, and rays with weight 0 because of flags, are
        interpolated, and `region_weights` is None. None: line integrals stay in memory.
        check: raises an error if the geometry of the projections is wrong, before they are corrected.
        phases: function that gets the name of each phase when the phase begins.

    Raises:
        DataError: the scan cannot be reconstructed; the message says why and what to do.
        ConfigError: the selection does not fit the scan.
    """
    phases = phases or Phases()
    phases.enter("flags and references")
    usable, poses, offset_frames = _usable(scan, warn)
    phases.enter("tilt and references", "bands")
    scan, tilt = with_tilt(scan, usable.frames, warn, phases.progress)
    selection, plan = scan.selection, survey(scan, usable.frames)
    for sentence in plan.warnings:
        warn(sentence)
    if poses is None and selection.step(TiltAndLens).tilt is None and selection.cone is None:
        warn_of_tilt(plan, usable.frames, warn, phases.progress)
    phases.enter("rotation axis")
    axis_col, axis = rotation_axis(plan, usable, poses, warn, phases.progress)
    warn_of_other_axis(poses, selection, axis_col, warn)
    phases.enter("jumps", "guesses")
    view_geometry = ViewGeometry(scan, axis_col)
    usable = view_geometry.find_motion(usable, warn, phases)
    used, held_out_frames = _chosen(view_geometry, usable, poses)
    view_geometry.calibrate(np.union1d(used, held_out_frames), phases)
    check(view_geometry.of(used))
    phases.enter("correction")
    used = np.union1d(used, offset_frames) if buffer is None else used
    projections = _corrected(plan, used, buffer, phases, warn)
    geometry = view_geometry.of(projections.view_ids)
    phases.enter("phase filter", "test reconstructions")
    if estimated := _estimated(scan, projections, geometry, phases):
        scan = scan.with_steps(*estimated)
        plan = with_filters_of(plan, scan, usable.frames)
        if any(step.on(scan)[0] is not None for step in estimated):
            phases.enter("correction")  # anything unusual in the frames has already been reported
            projections = _corrected(plan, used, buffer, phases)
    air_residual = compare_with_flats(scan, projections, warn)
    phases.enter("background, rings, held-out projections, hardening", "corrections")
    located_axis = view_geometry.axis_col, axis
    prepared = assemble(scan, projections, geometry, located_axis, usable, warn, buffer is not None)
    del projections  # the line integrals may be copied next
    if held_out_frames.size:
        with suppress(NoViewError):
            held_out = apply(plan, held_out_frames, warn=warn)
            storage = None if buffer is None else buffer.views
            prepared = prepared.with_held_out(held_out, view_geometry.of(held_out.view_ids), storage)
    prepared = prepared.stating(done={**plan.done, **tilt, **view_geometry.done})
    prepared = with_reach(scan, _after_scan_steps(scan, prepared, phases))  # the steps changed line integrals
    prepared = prepared.stating(
        consistency={**air_residual, **warn_of_inconsistency(prepared.centred, scan.selection, warn)}
    )
    return prepared if buffer is None else _with_unknown_filled(prepared)


def _estimated(scan: SelectedScan, projections: Projections, geometry: Geometry, phases: Phases) -> list[ViewStep]:
    """The steps whose settings follow from the corrected projections, with these settings."""
    steps = [step for step in in_order(scan.selection) if isinstance(step, EstimatedStep)]
    estimated = [step.estimated(scan, projections, geometry, phases.progress) for step in steps]
    return [step for step in estimated if step is not None]


def require_usable(scan: SelectedScan) -> None:
    """Raise the errors of `prepare_projections` that can be found without reading a frame."""
    _usable(scan, lambda sentence: None)
    scan.selection.step(TiltAndLens).of(scan)


def _usable(scan: SelectedScan, warn: Warn) -> tuple[UsableViews, ScanPoses | None, I64]:
    """The usable projections, their stated poses, and the rows of offset projections. Raises errors for faults before
    any frame is read.
    """
    source, selection = scan.source, scan.selection
    usable = checked_views(scan, warn)
    warn_of_units(scan, warn)
    chosen = choose_views(scan, usable.frames)
    for step in geometry_steps(selection):
        step.refuse_few(chosen.size, usable.frames.size, source.shape[1] // selection.binning)
    poses = poses_of(scan, usable.frames)
    if poses is not None:
        require_stated(poses, source, usable.frames[chosen])
        is_offset = np.abs((cols := poses.shifts[usable.frames, 0]) - np.nanmedian(cols)) > source.shape[1] / 2
        return replace(usable, frames=usable.frames[~is_offset]), poses, usable.frames[is_offset]
    return usable, poses, source.table.offset_views


def _chosen(
    view_geometry: ViewGeometry, usable: UsableViews, poses: ScanPoses | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the file of the projections that are used, and of some further projections that are held out."""
    scan, frames = view_geometry.scan, usable.frames
    chosen = choose_views(scan, frames, view_geometry.of(frames).period)
    used, not_chosen = frames[chosen], np.delete(frames, chosen)
    if poses is not None:
        require_stated(poses, scan.source, used)
        not_chosen = not_chosen[poses.stated(not_chosen)]
    return used, spread(not_chosen, HELD_OUT_VIEWS)


def _corrected(
    plan: ScanCorrectionPlan,
    used: NDArray[np.int64],
    buffer: DiskBuffer | None,
    phases: Phases,
    warn: Warn | None = None,
) -> Projections:
    """Line integrals of these rows of the file. Raises DataError if fewer than half of the rows can be used."""
    if buffer is None:
        projections = apply(plan, used, None, warn, phases.progress)
    else:
        projections = apply_in_batches(plan, used, buffer.views, buffer.batch, warn, phases.progress)
    if 2 * (n := projections.view_ids.size) < used.size:
        raise DataError(
            f"{plan.source.path}: only {n} of {used.size} projections can be used, less than half. The other "
            "projections have no beam, have no finite pixel, or differ from their checksum. Choose the usable "
            "projections with --views, or repeat the scan."
        )
    return projections


def _after_scan_steps(scan: SelectedScan, prepared: PreparedProjections, phases: Phases) -> PreparedProjections:
    """The projections after the steps that work on all projections. The steps change line integrals in place."""
    done, steps = dict(prepared.origin.done), [step for step in in_order(scan.selection) if isinstance(step, ScanStep)]
    prepared = prepared.stating(done=done)  # each step has access to the results of the steps before it
    for n, step in enumerate(steps, 1):
        done[step.name] = step.apply(prepared, scan.source.table.angles[prepared.ids], phases.progress)
        phases.progress(n, len(steps))
    return prepared


def _with_unknown_filled(prepared: PreparedProjections) -> PreparedProjections:
    """Interpolate rays with weight 0 (see `_ray_factors` of `PreparedProjections`), projection by projection and in
    place, in the same way as pixels that are `masked` in all projections.
    """
    data, geometry = prepared.seen.data, prepared.geometry
    rays = seen_rays(geometry, Grid.matching(geometry)) if prepared.leaves_slices else None
    for view in range(len(data)):
        weights = np.ones(geometry.detector_shape, np.float32)
        if prepared.sources.measured is not None:
            weights *= prepared.sources.measured
        if prepared.sources.region_weights_of is not None:
            in_regions = prepared.sources.region_weights_of(slice(view, view + 1), slice(0, len(weights)))
            weights *= 1 if in_regions is None else in_regions[0]
        if rays is not None:
            weights *= rays[view]
        if not weights.all():
            data[view] = masked(data[view : view + 1], weights[None])[0][0]
    return prepared


def assemble(
    scan: SelectedScan,
    projections: Projections,
    geometry: Geometry,
    axis: tuple[float, AxisEstimate | None],
    usable: UsableViews,
    warn: Warn,
    on_disk: bool = False,
) -> PreparedProjections:
    """The corrected projections with their geometry. Before, warnings report the pixels that the correction replaced.

    Args:
        geometry: geometry of these projections.
        axis: column of the axis, and how it was found (None if the user gave it).
        usable: the usable projections, from which the selection chose.
        on_disk: True: weights of rays in the regions of flags are computed when they are needed.

    Raises:
        DataError: there are fewer than two projections, or no sample is in the beam.
    """
    source, selection, (height, width) = scan.source, scan.selection, geometry.detector_shape
    rows = selection.detector_rows
    binning, first = selection.binning, ViewFilters.of(scan).read(None).start
    ids = projections.view_ids
    if ids.size < 2:
        raise DataError(f"{source.path}: only {ids.size} of the chosen projections can be used; at least 2 are needed.")
    if not projections.data.any():
        raise DataError(
            f"{source.path}: there is no sample in the beam: the line integrals of the chosen projections are "
            "zero everywhere."
        )
    unmeasured, resampling = projections.masked, selection.step(TiltAndLens).of(scan)
    if resampling is not None:
        unmeasured = unmeasured | resampling.outside_detector((height, width), rows.start)
    unmeasured = areas(unmeasured)
    regions = replace(usable.regions, resampling=resampling).and_unmeasured(projections.unmeasured, first, binning)

    def region_weights_of(views: slice, part: slice) -> NDArray[np.float32] | None:
        detector_rows = slice(rows.start + part.start * binning, rows.start + part.stop * binning)
        return regions.weights(ids[views], detector_rows, binning, (part.stop - part.start, width))

    prepared = PreparedProjections(
        lines=Views(projections.data, geometry, projections.weights, ids),
        corrected=Corrected.of(projections),
        origin=ScanOrigin(
            axis_col=axis[0],
            axis=axis[1],
            n_projections=source.table.views.size,
            length_unit="px" if selection.pixel_size_mm is None else "mm",
            quantity=source.quantity,
            left_out=usable.left_out,
            flags=usable.flags,
        ),
        sources=WeightSources(
            usable.weights_of(ids),
            ~unmeasured if unmeasured.any() else None,
            None if on_disk else region_weights_of(slice(None), slice(0, height)),
            region_weights_of if on_disk and regions.mark(ids) else None,
        ),
        pixel_aspect=_pixel_aspect(source, geometry, resampled=resampling is not None),
    )
    prepared = with_reach(scan, prepared)
    report_defects(prepared, first, binning, warn)
    warn_of_the_field(scan, prepared.centred, warn)
    return prepared


def with_reach(scan: SelectedScan, prepared: PreparedProjections) -> PreparedProjections:
    """The projections with the reach of the sample, measured from them. The radius is known only if the user gave
    it.
    """
    width = scan.selection.sample_width
    views = replace(prepared.seen, weights=prepared.sources.region_weights, reach=None)
    reach = reach_of(views) if width is None else whole_reach(views, width / 2)
    return replace(prepared, lines=replace(prepared.lines, reach=reach))


def _pixel_aspect(source: ScanSource, geometry: Geometry, *, resampled: bool) -> float:
    """Height of a pixel divided by its width.

    Raises:
        DataError: pixels are not square, and a detector row does not show one slice.
    """
    if source.row_pitch_mm is None or source.pixel_size_mm is None:
        return 1.0
    if resampled or not geometry.rows_show_slices:
        raise DataError(
            f"Bin the columns or the rows of a copy of {source.path}, because its pixels are "
            f"{source.pixel_size_mm:g} mm wide and {source.row_pitch_mm:g} mm high. Square pixels are "
            "needed in a cone beam, and if projections are shifted along the axis or rotated."
        )
    return source.row_pitch_mm / source.pixel_size_mm
