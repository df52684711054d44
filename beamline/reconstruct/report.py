"""Report: composes the report of a reconstruction from scan, settings, figures of merit and pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from beamline.core.quantities import VoxelKind
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.scan_facts import MadeVolume, ReportContext, as_text, label_of
from beamline.reconstruct.volume_checks import CheckedVolume
from beamline.report import pictures
from beamline.report.history import (
    history_arrays,
    quality_against_time,
    residual_curve,
    views_grew,
)
from beamline.report.html import Picture, Report
from beamline.report.metrics import METRICS, formatted
from beamline.report.sheets import SliceSheet, contact_sheet, reference_sheet
from beamline.storage.recon_record import Value, VoxelsInFile
from recon.base.method import Reconstruction
from recon.base.views import spread
from recon.base.volume import Volume, VolumeSeries
from recon.methods import BASELINE
from recon.voxels.matter_checks import UNEXPLAINED_LIMIT, StrayMass, Unexplained
from recon.voxels.matter_checks import unexplained as unexplained_by
from recon.voxels.view_weights import Wedge, unseen_wedges

_MATERIAL = 0.3  # a voxel is material if its density exceeds this share of the 99th percentile
# largest number of times that are shown; number of slices from which on vertical sections of them are drawn, too
_SHOWN, _UPRIGHT = 12, 8
_NO_REFERENCE = (
    "Neither volume is the ground truth: if only one of the volumes shows a feature, look for this feature in the "
    "projections."
)


def compose(
    outcome: MadeVolume, volumes: Mapping[str, Volume], checked: CheckedVolume, parameters: Mapping[str, Value]
) -> Report:
    """The report on a reconstruction."""
    result, prepared, truth, context = outcome.result, outcome.prepared, outcome.truth, outcome.context
    metrics, judgement = checked.metrics, checked.judgement
    settings = {
        k: as_text(v) for k, v in parameters.items() if not isinstance(v, np.ndarray) and k not in ("command", "recipe")
    } | {f"law: {name}": residual for name, residual in prepared.origin.consistency.items()}
    return Report(
        title=f"{context.facts.sample or context.facts.name}: {label_of(result.method)}",
        summary=_summary(outcome, metrics),
        scan=context.facts.table,
        settings=settings,
        metrics={label_of(method): values for method, values in metrics.items()},
        frames=context.facts.frames,
        flags=[*context.facts.remarks, *context.warnings],
        done=[each.sentence for each in prepared.origin.done.values() if each.sentence and not each.warned],
        pictures=[
            *(_slices(prepared, truth, volumes) if result.series is None else _several(result.series)),
            *_doubts(result, prepared, judgement.unexplained),
            *_views(prepared),
            *_further(result, prepared, judgement.stray, context),
        ],
        command=context.command,
        recipe=context.recipe,
        footnotes=_footnotes(result, truth, metrics, judgement.unexplained),
        live_picture=context.facts.live_picture,
    )


def _summary(outcome: MadeVolume, metrics: Mapping[str, Mapping[str, float]]) -> str:
    result, prepared, truth, context = outcome.result, outcome.prepared, outcome.truth, outcome.context
    name, geometry = label_of(result.method), prepared.geometry
    best = "psnr" if truth is not None else "residual"
    own = metrics[result.method]
    best = best if best in own else "seconds"  # FBP of a region has no figures of quality
    shape, volumes_text = " × ".join(str(n) for n in result.volume.grid.shape), f"{name} volume of"
    if result.series is not None:
        seconds = result.series.seconds
        first_time = seconds[0]
        last_time = seconds[-1]
        volumes_text = f"{len(seconds)} volumes at successive times, {first_time:.4g} to {last_time:.4g} s, of"
    summary = (
        f"{volumes_text} {shape} voxels from {geometry.n_views} of {prepared.origin.n_projections} projections in "
        f"{result.seconds:.1f} s; {METRICS[best].label} {formatted(best, own[best])}"
    )
    if BASELINE in metrics and result.method != BASELINE:
        summary += f" (FBP of the same projections: {formatted(best, metrics[BASELINE][best])})"
    if context.region is not None:
        summary += f". The file and the pictures of slices contain only the region {context.region.region} [z, y, x]"
    if result.chosen:
        summary += f". Reason for the method: {result.chosen}"
    return summary + "."


def _footnotes(
    result: Reconstruction,
    truth: Volume | None,
    metrics: Mapping[str, Mapping[str, float]],
    unexplained: Unexplained | None,
) -> list[str]:
    """The meaning of the figures of merit that this report shows."""
    of_several = (
        "difference between each projection and the forward projection of the volume at the time of this projection, "
        "relative to the projection. The value also falls if the projections have less noise."
    )
    of_one = "|A x − p| / |p| over up to 16 projections p; x is the volume, A the forward projection (Joseph 1982)."
    slices = 0 if unexplained is None else len(unexplained.significance)
    reference = "the ground truth" if truth else "FBP of these projections"
    footnotes = (
        (True, f"Residual: {of_one if result.series is None else of_several}"),
        (
            True,
            "Total time, without loading the program: from opening the scan until volume and report are written, with "
            "reading and checks.",
        ),
        (
            any("cnr" in values for values in metrics.values()),
            f"SNR, CNR: computed from the dense and the empty part (two classes by k-means) of {reference}, without "
            "voxels near the boundary. All volumes use the same two parts. A smoother volume has higher values, "
            "although it may show less: look for cracks and pores in the pictures.",
        ),
        (
            any("air" in values for values in metrics.values()),
            "Air level: mean of the voxels that the projections show to be empty, divided by the standard deviation of "
            "FBP there. If the air of FBP is below zero, the densities of weakly absorbing material in the other "
            "volume are too low by the same amount.",
        ),
        (
            views_grew(result),
            "Time of reconstruction of R²-Gaussian: from the first reading of the growing file to the volume, so "
            "the time of the scan is included.",
        ),
        (
            bool(result.ending.resumed_from),
            f"Time of reconstruction of {label_of(result.method)}: only the time since the fit was resumed.",
        ),
        (
            unexplained is not None,
            f"Unexplained structure in the residual: fraction of the sample voxels in {slices} slices at which the "
            f"back-projected residual exceeds four standard deviations of its noise. Above {UNEXPLAINED_LIMIT:g} "
            "cracks, pores or edges of the sample may be missing in the volume. Compare only fits of the same "
            "projections: shifted projections have more noise, so that fewer voxels exceed four standard deviations.",
        ),
        (
            "stray" in metrics[result.method],
            "Mass in empty regions: fraction of the mass of the volume in voxels that at least two projections show to "
            "be empty. With few projections there are blobs and streaks in such regions.",
        ),
        (
            truth is not None,
            "PSNR: the peak is the largest value of the ground truth. SSIM 3D: mean over the slices of three "
            "directions.",
        ),
    )
    return [text for concerns, text in footnotes if concerns]


def _further(
    result: Reconstruction, prepared: PreparedProjections, stray: StrayMass | None, context: ReportContext
) -> Iterator[Picture]:
    """Pictures of stray mass, darks, flats and flagged frames, if there are any."""
    facts = context.facts
    if stray is not None and stray.share > 0:
        yield Picture(
            "Stray mass",
            "Maximum projection of the density in voxels that the projections show to be empty. All density in this "
            "picture is an artefact: less is better.",
            pictures.stray_mass(stray.map, result.volume.grid, prepared.origin.length_unit, VoxelKind.ATTENUATION),
        )
    if facts.references:
        yield Picture(
            "Darks and flats",
            "Frames as the camera recorded them. Smooth flats are better: dust makes rings if it moves, or if it is "
            "only in the flats. If there are two groups of flats, the ratio of the two groups should be near 1 "
            "everywhere.",
            reference_sheet(facts.references, facts.shape),
        )
    if facts.flagged:
        yield Picture(
            "Flagged frames",
            "The worst of the frames that the monitor flagged, as the camera recorded them, with the flagged region "
            "if there is one. Red: alarm, the projection is not used. Orange: warning, the projection has half the "
            "weight.",
            contact_sheet(facts.flagged),
        )


def _slices(prepared: PreparedProjections, truth: Volume | None, volumes: Mapping[str, Volume]) -> Iterator[Picture]:
    """Pictures of slices of all volumes, and of their differences from the first volume."""
    unit, kind = prepared.origin.length_unit, VoxelKind.ATTENUATION
    shown = {"Ground truth": truth} if truth is not None else {}
    shown |= {label_of(method): volume for method, volume in volumes.items()}
    yield Picture(
        "Slices",
        "Three orthogonal slices through the centre of mass of the bright voxels, y and z downwards as in image "
        "viewers. All have the same grey window, from air to the densest class of material; small metal parts are "
        "white.",
        pictures.orthogonal_slices(shown, unit, kind),
    )
    yield Picture(
        "Sharpest edge, and values",
        "Values along a line through the sharpest edge: the steeper the edge, the sharper the volume; dips and "
        "overshoots next to the edge are artefacts. Histogram: narrower peaks are better, unless the sample has values "
        "between the peaks.",
        pictures.profile_and_values(shown, unit, kind),
    )
    if len(shown) > 1:
        reference_name = next(iter(shown))
        yield Picture(
            "Differences",
            f"The first slice of each volume minus the first slice of {reference_name}. Red: higher, blue: lower. "
            + ("White means no difference: the whiter, the better." if truth is not None else _NO_REFERENCE),
            pictures.differences(shown, unit, kind),
        )


def _several(series: VolumeSeries) -> Iterator[Picture]:
    """Slices of some of the volumes of a time series, side by side."""
    n, depth = series.data.shape[:2]
    shown_times = spread(np.arange(n), _SHOWN)
    for title, turned in (("Slices at each time", False), ("Vertical slices at each time", True)):
        if turned and depth < _UPRIGHT:
            continue
        sheet = SliceSheet("z" if turned else "y")
        for k in shown_times:
            volume = series.data[k]
            sheet.add(series.labels[k], volume.swapaxes(0, 1) if turned else volume)
        yield Picture(
            title,
            f"{len(shown_times)} of {n} times, all with the same grey window: differences are changes or motion of the "
            "sample.",
            sheet.png(sheet.labels()),
        )


def _moved_reference(volume: Volume, change: Volume) -> Volume:
    """The volume minus its change. Slices are computed when they are used, because the volume may be on disk."""
    voxels: Any = VoxelsInFile(volume.grid.shape, lambda part: volume.data[part] - change.data[part])
    return Volume(voxels, volume.grid)


def _displaced(result: Reconstruction, moved: Volume) -> str:
    """A sentence on the displacement of the material; empty for a volume in slabs, whose displacement is not known."""
    if result.displacement is None:
        return ""
    reference = np.asarray(moved.data)
    material = reference > _MATERIAL * np.percentile(reference, 99)
    if not material.any():
        return ""
    voxels = np.sqrt(np.square(result.displacement[:, material]).sum(0)) / result.volume.grid.voxel_size
    middle, highest = np.percentile(voxels, (50, 99))
    return f" The material of the reference was displaced by {middle:.1f} voxels (median), at most {highest:.1f}."


def _doubts(
    result: Reconstruction, prepared: PreparedProjections, unexplained: Unexplained | None
) -> Iterator[Picture]:
    """Pictures of missing angles, error bars, the residual, and the progress of the reconstruction."""
    unit, kind = prepared.origin.length_unit, VoxelKind.ATTENUATION
    if unseen := unseen_wedges(prepared.geometry):
        yield Picture("Missing wedge", _of_wedges(unseen), pictures.wedges(result.volume, unseen, unit))
    if result.change is not None:
        moved = _moved_reference(result.volume, result.change)
        check = unexplained_by(moved, prepared.views.seen, np.random.default_rng(0))
        unexplained_change = check.alone(moved, prepared.geometry)
        yield Picture(
            "Change since the reference",
            "A slice of the moved reference, of this volume, and of their difference. Red: denser than before, "
            "blue: less dense. Cracks and pores that opened are blue; at edges, thin pairs of red and blue are "
            "errors of the motion. The last picture is FBP of the residual (the measured projections minus the "
            "forward projections of the moved reference), blurred by a voxel and divided by its standard error. "
            "Beyond 4 and -4 the projections themselves show a change." + _displaced(result, moved),
            pictures.change(result.volume, result.change, unexplained_change, unit, kind),
        )
    if result.deviation is not None:
        yield Picture(
            "Error bars",
            "A slice, and the standard deviation of its voxels. In about two of three voxels the true density "
            "is within one standard deviation of the volume. Where the method smoothed fine texture away, the "
            "error may be larger.",
            pictures.error_bars(result.volume, result.deviation, unit, kind),
        )
    if unexplained is not None:
        middle = len(unexplained.significance) // 2
        yield Picture(
            "Residual in the projections",
            "Filtered back-projection of the residual, divided by its noise. The picture should show even noise, "
            "with values seldom above 4 or below -4. An edge, crack or pore that is visible here is in the "
            "projections, but not in the volume. Blue: the volume is too dense. Red: the volume is not dense enough.",
            pictures.significance(
                unexplained.significance[middle], result.volume.grid, unexplained.first + middle, unit
            ),
        )
    if result.history:
        yield Picture(
            "Quality against time",
            _history_caption(result),
            quality_against_time(history_arrays(result.history)),
        )


def _views(prepared: PreparedProjections) -> Iterator[Picture]:
    """Pictures of a corrected projection, a sinogram, the search for the rotation axis, and the poses."""
    data, geometry, unit, axis = (
        prepared.seen.data,
        prepared.geometry,
        prepared.origin.length_unit,
        prepared.origin.axis,
    )
    yield Picture(
        "Projection",
        f"One corrected projection: the line integral of the {VoxelKind.ATTENUATION.value} along each ray. Air should "
        "be even and near 0.",
        pictures.projection(data, geometry, 0, unit),
    )
    yield Picture(
        "Sinogram",
        "The middle detector row of all projections used. Vertical stripes become rings in the volume. If a curve is "
        "interrupted, one of the projections does not fit the other projections.",
        pictures.sinogram(data, geometry, geometry.detector_shape[0] // 2),
    )
    if axis is not None:
        yield Picture(
            "Rotation axis",
            f"How badly the projections fit together for each candidate column of the rotation axis ({axis.method}): "
            "0 if they agree, about 1 if they have nothing in common. The columns are columns of the binned "
            "detector.",
            pictures.axis_curve(axis.candidates, axis.curve, axis.value, axis.confident),
        )
    turns = np.degrees(np.stack((geometry.roll, geometry.tilt), axis=1))
    if geometry.shifts.any() or turns.any():
        moved = geometry.shifts * geometry.sample_pitch
        yield Picture(
            "Poses of the projections",
            "Shift at the sample, roll and tilt of each projection, against the angle of the stage. These curves "
            "show runout, wobble, drift and jumps. `beamline export --poses` writes the values as a table.",
            pictures.pose_curves(np.degrees(geometry.angles), moved, turns, unit),
        )


def _of_wedges(unseen: Sequence[Wedge]) -> str:
    """Size and direction of the missing wedges, and their effect on the volume."""
    directions = " and ".join("{:.0f} to {:.0f}°".format(*wedge.rays) for wedge in unseen)
    size = math.degrees(sum(wedge.size for wedge in unseen))
    return (
        f"Orange: directions in which no projection has rays, {directions}, counted from x towards y ({size:.0f}° in "
        "all). Edges along these directions are blurred. Small objects are elongated across these directions."
    )


def _history_caption(result: Reconstruction) -> str:
    gaussians = {progress.n_gaussians for progress in result.history}
    growing = ["views"] * views_grew(result) + ["Gaussians"] * (len(gaussians) > 1)
    parts = ["Misfit to the projections in use"]
    if (judged := residual_curve(history_arrays(result.history))) is not None:
        parts.append(f"residual of {judged.views}, in dB below the measured values")
    parts += [f"number of {' and of '.join(growing)}"] if growing else []
    since = "the file was found" if views_grew(result) else "the start"
    return f"{', '.join(parts)}, against the time since {since}. Lower misfit and more dB are better."
