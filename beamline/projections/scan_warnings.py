"""Warnings of a scan while it is prepared: odd units, joined views, another axis, matter beyond the field, repairs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from beamline.core.quantities import doubt
from beamline.core.sinks import Note, Warn
from beamline.core.text import count, frames_text, spans
from beamline.monitor.field import beyond_the_field
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.poses import ScanPoses
from beamline.projections.corrections.references import uncorrected_current
from beamline.projections.prepared import PreparedProjections
from beamline.projections.registry import in_order
from beamline.projections.selection import ScanSelection
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.light import without_air
from recon.base.masks import areas
from recon.voxels.direct import has_direct_method
from recon.voxels.field_edges import FieldEdges

_LEAST_MAGNIFICATION = 1.02
_SAME_AXIS = 0.05  # columns


def warn_of_units(source: ScanSource, selection: ScanSelection, warn: Warn) -> None:
    """Warn of a size, an energy or a distance that no instrument has, as by a mistaken unit."""
    size_mm = selection.pixel_size_mm
    stated = [("pixel_size_um", None if size_mm is None else size_mm * 1e3), ("energy_kev", source.energy_kev)]
    for step in in_order(selection):  # options of the same names
        stated += [(name, getattr(step, name, None)) for name in ("pixel_size_um", "energy_kev", "distance_mm")]
    for sentence in dict.fromkeys(doubt(name, value) for name, value in stated):
        if sentence:
            warn(sentence)
    if turned := source.attributes.get("turned"):
        warn(Note(str(turned)))
    if (cone := selection.cone or source.cone) is not None and cone[1] < _LEAST_MAGNIFICATION * cone[0]:
        warn(
            f"The cone magnifies {cone[1] / cone[0]:.4g} times only: {cone[0]:g} mm from the source to the axis and "
            f"{cone[1]:g} mm to the detector. Check --cone SOD:SDD: SDD goes from the source, not from the axis."
        )


def warn_of_other_axis(poses: ScanPoses | None, selection: ScanSelection, axis_col: float, warn: Warn) -> None:
    """Tell that poses of a volume are used with another rotation axis than they were learnt or used with."""
    if poses is None or (of_poses := poses.table.axis_col) is None or selection.axis_col is not None:
        return
    if abs(of_poses - axis_col) > _SAME_AXIS:
        warn(
            f"The poses of {poses.table} go with the rotation axis of that volume, column {of_poses:.2f}; column "
            f"{axis_col:.2f} is used. Give --axis {of_poses:.2f} to have both."
        )


def warn_of_the_field(scan: ScanEvidence, selection: ScanSelection, prepared: PreparedProjections, warn: Warn) -> None:
    """Warn of matter beyond the field of view; and of the light and the ring current, where no air corrects them."""
    projections, geometry = prepared.projections, prepared.geometry
    edges = FieldEdges.of(projections.data, geometry, prepared.shares)
    unlevelled = not any(projections.air_columns)
    if sides := edges.beyond():
        light = ""
        if unlevelled and scan.in_counts and selection.step(Air).model != "none":
            light = without_air(scan, edges.mean)
        continued = edges.continued and has_direct_method(geometry)
        wide = not geometry.is_centred.all() or bool(scan.table.offset_views.size)
        warn(f"{cut_sentence(sides, continued, wide)} {light}".rstrip())
        if unlevelled and (change := uncorrected_current(scan, selection)):
            warn(change)
    elif ranges := edges.passing():
        warn(passing_sentence(ranges, geometry.n_views))


def cut_sentence(sides: dict[str, float], continued: bool, wide: bool) -> str:
    """The warning that the sample extends beyond the field of view, by `FieldEdges.beyond`; `continued`: by FBP,
    `wide`: the scan has offset views."""
    fbp = "FBP continues the views, with densities off by tens of per cent; other" if continued else "Iterative"
    advice = (
        "Offset views (scan.offset_views, some 8 to 16 exposures more) or a full turn with the axis near an edge "
        "(twice the views) show the rest. "
    )
    return (
        f"{beyond_the_field(sides)} {fbp} methods reconstruct the sample as wide as it is. {'' if wide else advice}The "
        "edge columns are not used as air. If they are air, and the beam is weaker than its flats, give --air columns."
    )


def passing_sentence(ranges: Mapping[str, tuple[int, int]], n_views: int) -> str:
    """A warning for `FieldEdges.passing`."""
    words = " and ".join(f"at the {side} edge in views {first} to {last}" for side, (first, last) in ranges.items())
    return (
        f"Matter leaves the field {words} of {n_views}, and all of it is inside in others: the sample, or a part of "
        "it, stands beside the rotation axis. What lies farther from the axis than the edge is not reconstructed, and "
        "the rim is uncertain. Centre the sample on the axis, or move the camera until the axis is near its edge and "
        "take a full turn."
    )


def report_defects(prepared: PreparedProjections, first_row: int, binning: int, warn: Warn) -> None:
    """Name slices (of a cone, rows) that no ray measured; beside them what measured nothing, by frames, rows and
    columns, bright spots that stay, and repaired pixels if more than one in a thousand.

    Args:
        first_row: of the detector, at which the (binned) rows begin.
    """
    what = "slice" if prepared.geometry.rows_show_slices else "row"
    projections, (lost, between) = prepared.projections, prepared.unmeasured_rows
    masked, runs = projections.masked.copy(), projections.unmeasured
    masked[lost] = False
    unseen, runs = areas(projections.masked) & masked, runs[~np.isin(runs[:, 1], lost)]
    if runs.size:
        frames, within = np.unique(runs[:, 0]), first_row + np.arange(binning)
        rows = spans((binning * np.unique(runs[:, 1])[:, None] + within).ravel().tolist(), 4)
        ends = np.unique(runs[:, 2:], axis=0) * binning
        cols = spans(np.unique(np.concatenate([np.arange(*each) for each in ends])).tolist(), 4)
        warn(
            f"In {count(frames.size, 'view')} of {projections.view_ids.size} ({frames_text(frames)}) pixels "
            f"of columns {cols} and rows {rows} measured nothing: zeros or values that are not finite at a border, as "
            "where views were shifted or turned before, or something opaque in the beam that is not the sample, such "
            "as a post or a clamp. These rays have no weight."
        )
    if n := projections.spots_left:
        large = f"Bright spots larger than 3 x 3 pixels ({count(n, 'pixel')} brighter than the open beam) stay and make"
        warn(Note(f"{large} streaks: shield the detector against scattered and direct X-rays."))
    shares = (
        (unseen.mean(), Note, "of the detector got no beam, or is saturated: its rays count as not measured."),
        (
            (masked & ~unseen).mean(),
            Note,
            "of the detector's pixels are dead or hot and were filled from their neighbours.",
        ),
        (
            projections.replaced,
            Note,
            "of the pixels were bright spots of single views (zingers), or not finite: filled from their neighbours.",
        ),
        (
            projections.floored,
            str,
            "of the pixels let less light through than the floor; their attenuation is at least what the volume says, "
            "unless the darks are too high.",
        ),
    )
    for share, kind, text in shares:
        if share > 1e-3:
            warn(kind(f"{share:.1%} {text}"))
    for some, so in (np.setdiff1d(lost, between), "0 in the volume"), (between, "interpolated from their neighbours"):
        if some.size:
            warn(
                f"No ray measured {count(some.size, what)} of {len(masked)} (from 0: {spans(some.tolist())}): in all "
                "views these rows have no beam, zeros, no finite values, or dead pixels. "
                f"They are {so if what == 'slice' else 'not used, and voxels that other rows do not show are 0'}."
            )
