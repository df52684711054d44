"""Warnings before a reconstruction: unusual units, a rotation axis that differs from the axis of the poses, a sample
wider than the field of view, missing and repaired pixels.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from beamline.core.quantities import doubt
from beamline.core.sinks import Note, Warn
from beamline.core.text import count, frames_text, spans
from beamline.monitor.field import beyond_the_field
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.poses import ScanPoses
from beamline.projections.prepared import PreparedProjections
from beamline.projections.references import uncorrected_current
from beamline.projections.registry import in_order
from beamline.projections.selection import ScanSelection, SelectedScan
from beamline.storage.rules.light import without_air
from recon.base.masks import areas
from recon.voxels.beyond_field import reach_of
from recon.voxels.direct import has_direct_method

_LEAST_MAGNIFICATION = 1.02
_SAME_AXIS = 0.05  # columns


def warn_of_units(scan: SelectedScan, warn: Warn) -> None:
    """Warn of a pixel size, an energy or a distance that no instrument has. The cause is probably a wrong unit."""
    source, selection, size_mm = scan.source, scan.selection, scan.selection.pixel_size_mm
    stated = [("pixel_size_um", None if size_mm is None else size_mm * 1e3), ("energy_kev", source.energy_kev)]
    for step in in_order(selection):  # the options have the same names
        stated += [(name, getattr(step, name, None)) for name in ("pixel_size_um", "energy_kev", "distance_mm")]
    for sentence in dict.fromkeys(doubt(name, value) for name, value in stated):
        if sentence:
            warn(sentence)
    if orientation_note := source.attributes.get("turned"):
        warn(Note(str(orientation_note)))
    if (cone := selection.cone or source.cone) is not None and cone[1] < _LEAST_MAGNIFICATION * cone[0]:
        sod = cone[0]
        sdd = cone[1]
        magnification = cone[1] / cone[0]
        warn(
            "Check --cone SOD:SDD. SDD is the distance from the source to the detector, not from the axis to the "
            f"detector. With the present values, {sod:g} mm from the source to the axis and {sdd:g} mm to the "
            f"detector, the cone magnifies only {magnification:.4g} times."
        )


def warn_of_other_axis(poses: ScanPoses | None, selection: ScanSelection, axis_col: float, warn: Warn) -> None:
    """Warn if the poses of a volume are used with another rotation axis than the one they were found with."""
    if poses is None or (of_poses := poses.table.axis_col) is None or selection.axis_col is not None:
        return
    if abs(of_poses - axis_col) > _SAME_AXIS:
        warn(
            f"Give --axis {of_poses:.2f}, because the poses of {poses.table} were found with the rotation "
            f"axis at column {of_poses:.2f}. This reconstruction uses column {axis_col:.2f}."
        )


def warn_of_the_field(scan: SelectedScan, prepared: PreparedProjections, warn: Warn) -> None:
    """Warn of a sample that extends beyond the field of view. If no air is available to correct the intensity, also
    warn of changes of the intensity and of the ring current.
    """
    geometry, edges = prepared.geometry, reach_of(prepared.seen).edges
    unlevelled = not any(prepared.corrected.air_columns)
    if sides := edges.beyond():
        air_sentence = ""
        if unlevelled and scan.evidence.in_counts and scan.selection.step(Air).model != "none":
            air_sentence = without_air(scan.evidence, edges.mean)
        continued = edges.continued and has_direct_method(geometry)
        wide = not geometry.is_centred.all() or bool(scan.table.offset_views.size)
        warn(f"{cut_sentence(sides, continued, wide)} {air_sentence}".rstrip())
        if unlevelled and (change := uncorrected_current(scan)):
            warn(change)
    elif ranges := edges.passing():
        warn(passing_sentence(ranges, geometry.n_views))


def cut_sentence(sides: dict[str, float], continued: bool, wide: bool) -> str:
    """The warning that the sample extends beyond the field of view.

    Args:
        sides: see `FieldEdges.beyond`.
        continued: True if FBP extrapolates the projections.
        wide: True if the scan has laterally offset projections.
    """
    full_width = (
        "FBP extrapolates the projections beyond the detector, and densities are off by tens of per cent. The other "
        "methods reconstruct the full width of the sample."
        if continued
        else "Iterative methods reconstruct the full width of the sample."
    )
    advice = (
        "To measure the rest of the sample, take offset projections (scan.offset_views, 8 to 16 more "
        "exposures), or a 360° scan with the rotation axis near one edge of the detector (half "
        "acquisition, twice the projections). "
    )
    return (
        f"{beyond_the_field(sides)} {full_width} {'' if wide else advice}The edge columns show the sample, so they are "
        "not used as air reference. If the edge columns do show air, and only the beam is weaker than in the flats, "
        "use --air columns."
    )


def passing_sentence(ranges: Mapping[str, tuple[int, int]], n_views: int) -> str:
    """The warning for a sample that is inside the field of view only in some projections, see `FieldEdges.passing`."""
    where = " and ".join(
        f"at the {side} edge in projections {first} to {last}" for side, (first, last) in ranges.items()
    )
    return (
        "Centre the sample on the rotation axis, or move the camera until the axis is near an edge of the detector and "
        f"take a 360° scan: the sample leaves the field of view {where} of {n_views} and is inside the field of view "
        "in the other projections. The sample, or a part of it, is off the rotation axis. Material farther from the "
        "axis than the edge of the detector is not reconstructed, and the rim of the volume is uncertain."
    )


def report_defects(prepared: PreparedProjections, first_row: int, binning: int, warn: Warn) -> None:
    """Report slices (for a cone beam: detector rows) that no ray measured, pixels without data, and zingers that
    remain. Repaired pixels are reported if more than one in a thousand was repaired.

    Args:
        first_row: row of the detector at which the (binned) rows begin.
    """
    layer = "slice" if prepared.geometry.rows_show_slices else "row"
    corrected, (lost_rows, interpolated_rows) = prepared.corrected, prepared.unmeasured_rows
    masked, runs = corrected.masked.copy(), corrected.unmeasured
    masked[lost_rows] = False
    unseen, runs = areas(corrected.masked) & masked, runs[~np.isin(runs[:, 1], lost_rows)]
    if runs.size:
        frames, bin_rows = np.unique(runs[:, 0]), first_row + np.arange(binning)
        rows = spans((binning * np.unique(runs[:, 1])[:, None] + bin_rows).ravel().tolist(), 4)
        ends = np.unique(runs[:, 2:], axis=0) * binning
        cols = spans(np.unique(np.concatenate([np.arange(*each) for each in ends])).tolist(), 4)
        warn(
            f"In {count(frames.size, 'projection')} of {prepared.n_used} "
            f"({frames_text(frames)}), pixels of columns {cols} and rows {rows} contain no data and are "
            "ignored. Either the images were shifted or rotated before (zeros or NaN at a border), or "
            "something opaque other than the sample stood in the beam, such as a post or a clamp."
        )
    if n := corrected.spots_left:
        large = "Shield the detector against scattered and direct X-rays: bright spots larger than 3 x 3 pixels"
        warn(Note(f"{large} ({count(n, 'pixel')} brighter than the open beam) are not removed and make streaks."))
    shares = (
        (
            unseen.mean(),
            Note,
            "{share} of the detector got no beam or is saturated. The rays of these pixels count as missing data.",
        ),
        (
            (masked & ~unseen).mean(),
            Note,
            "{share} of the detector's pixels are dead or hot. The values of these pixels were replaced with values "
            "of neighbouring pixels.",
        ),
        (
            corrected.replaced,
            Note,
            "{share} of the pixels were zingers (bright spots in one projection only) or not finite. The values of "
            "these pixels were replaced with values of neighbouring pixels.",
        ),
        (
            corrected.floored,
            str,
            "{share} of the pixels transmit less than the smallest transmission that is used (--floor). The true "
            "attenuation there is at least what the volume shows, unless the darks are too high.",
        ),
    )
    for share, kind, text in shares:
        if share > 1e-3:
            warn(kind(text.format(share=f"{share:.1%}")))
    for dead_rows, result_of_slices in (
        (np.setdiff1d(lost_rows, interpolated_rows), "0 in the volume"),
        (interpolated_rows, "interpolated from their neighbours"),
    ):
        if dead_rows.size:
            result = (
                result_of_slices if layer == "slice" else "not used. Voxels that only these detector rows show are 0"
            )
            warn(
                f"No data in {count(dead_rows.size, layer)} of {len(masked)} (counted from 0: "
                f"{spans(dead_rows.tolist())}), because in all projections these detector rows have no beam, zeros, "
                f"no finite values, or dead pixels. These {layer}s are {result}."
            )
