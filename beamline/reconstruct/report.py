"""The content of the report on a reconstruction: scan, settings, figures of merit, pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from beamline.core.quantities import VoxelKind
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.scan_facts import ReportContext, as_text, label_of
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
from beamline.storage.recon_record import Value
from recon.base.method import Reconstruction
from recon.base.views import spread
from recon.base.volume import Volume, VolumeSeries
from recon.methods import BASELINE
from recon.voxels.matter_checks import UNEXPLAINED_LIMIT, StrayMass, Unexplained
from recon.voxels.view_weights import Wedge, unseen_wedges

_SHOWN, _UPRIGHT = 12, 8  # times at most; slices from which on upright cuts of them are drawn, too
_NO_REFERENCE = "Neither is the truth: what only one of them shows is to be looked for in the views."


def compose(
    made: Reconstruction,
    prepared: PreparedProjections,
    truth: Volume | None,
    volumes: Mapping[str, Volume],
    checked: CheckedVolume,
    parameters: Mapping[str, Value],
    context: ReportContext,
) -> Report:
    """The report on a reconstruction."""
    metrics, judgement = checked.metrics, checked.judgement
    settings = {
        k: as_text(v) for k, v in parameters.items() if not isinstance(v, np.ndarray) and k not in ("command", "recipe")
    } | {f"law: {name}": left for name, left in prepared.laws.items()}
    return Report(
        title=f"{context.facts.sample or context.facts.name}: {label_of(made.method)}",
        summary=_summary(made, prepared, truth, metrics, context),
        scan=context.facts.table,
        settings=settings,
        metrics={label_of(method): values for method, values in metrics.items()},
        frames=context.facts.frames,
        flags=[*context.facts.remarks, *context.warnings],
        done=[each.sentence for each in prepared.done.values() if each.sentence and not each.warned],
        pictures=[
            *(_slices(prepared, truth, volumes) if made.series is None else _several(made.series)),
            *_doubts(made, prepared, judgement.unexplained),
            *_views(prepared),
            *_further(made, prepared, judgement.stray, context),
        ],
        command=context.command,
        recipe=context.recipe,
        footnotes=_footnotes(made, truth, metrics, judgement.unexplained),
        live_picture=context.facts.live_picture,
    )


def _summary(
    made: Reconstruction,
    prepared: PreparedProjections,
    truth: Volume | None,
    metrics: Mapping[str, Mapping[str, float]],
    context: ReportContext,
) -> str:
    name, geometry = label_of(made.method), prepared.geometry
    best = "psnr" if truth is not None else "residual"
    own = metrics[made.method]
    best = best if best in own else "seconds"  # a region by FBP is compared with nothing
    shape, what = " × ".join(str(n) for n in made.volume.grid.shape), f"{name} volume of"
    if made.series is not None:
        seconds = made.series.seconds
        what = f"{len(seconds)} volumes in time, {seconds[0]:.4g} to {seconds[-1]:.4g} s, of"
    summary = (
        f"{what} {shape} voxels from {geometry.n_views} of "
        f"{prepared.n_projections} views in {made.seconds:.1f} s; "
        f"{METRICS[best].label} {formatted(best, own[best])}"
    )
    if BASELINE in metrics and made.method != BASELINE:
        summary += f" (FBP of the same views: {formatted(best, metrics[BASELINE][best])})"
    if context.region is not None:
        summary += f". Written, and shown in pictures of slices: the region {context.region.region} [z, y, x]"
    if made.chosen:
        summary += f". Chosen: {made.chosen}"
    return summary + "."


def _footnotes(
    made: Reconstruction,
    truth: Volume | None,
    metrics: Mapping[str, Mapping[str, float]],
    unexplained: Unexplained | None,
) -> list[str]:
    """What the figures of merit mean, as far as there are any."""
    of_several = "what the volumes, in each view as it shows them, leave of all views. It falls with noise."
    of_one = "|A x − p| / |p| over up to 16 views, A the voxel projector (Joseph 1982)."
    slices = 0 if unexplained is None else len(unexplained.significance)
    footnotes = (
        (True, f"Data residual: {of_one if made.series is None else of_several}"),
        (
            True,
            "Time of the whole command: from its start until volume and page are written, with reading and measuring.",
        ),
        (
            any("cnr" in values for values in metrics.values()),
            "SNR, CNR: between the dense and the empty part (k-means of two classes) of "
            f"{'the truth' if truth else 'FBP of these views'}, without voxels near the other part; the same of all "
            "volumes. A smoother volume has more of both, though it may show less: look for cracks and pores in the "
            "pictures.",
        ),
        (
            any("air" in values for values in metrics.values()),
            "Level of air: the mean of the voxels that views show to be empty, within the field of all views, over the "
            "deviation of FBP there. Air of FBP that is below zero is missing from the other volume's weak matter.",
        ),
        (
            views_grew(made),
            "Time of reconstruction of R²-Gaussian: from the first look at the growing file to the volume; it includes "
            "the scan.",
        ),
        (
            bool(made.ending.resumed_from),
            f"Time of reconstruction of {label_of(made.method)}: since the fit was resumed, without the time before.",
        ),
        (
            unexplained is not None,
            f"Matter that leaves structure: voxels at which the back-projected residual of {slices} slices exceeds "
            f"four standard deviations of its noise; above {UNEXPLAINED_LIMIT:g} a fit hides something. It compares "
            "fits of the same views: views that are displaced have more noise, so less exceeds it.",
        ),
        (
            "stray" in metrics[made.method],
            "Mass where views show nothing: share of the volume's mass in voxels whose rays meet no matter in two "
            "views at least. Sparse views leave blobs and streaks there.",
        ),
        (
            truth is not None,
            "PSNR: the peak is the truth's largest value. SSIM 3D: mean over the slices of three directions.",
        ),
    )
    return [text for concerns, text in footnotes if concerns]


def _further(
    made: Reconstruction, prepared: PreparedProjections, stray: StrayMass | None, context: ReportContext
) -> Iterator[Picture]:
    """Stray mass, darks, flats and flagged frames, as far as there are any."""
    facts = context.facts
    if stray is not None and stray.share > 0:
        yield Picture(
            "Stray mass",
            "The highest density above each other, of voxels that the views show to be empty. All of it is an "
            "artefact: less is better.",
            pictures.stray_mass(stray.map, made.volume.grid, prepared.length_unit, VoxelKind.ATTENUATION),
        )
    if facts.references:
        yield Picture(
            "Darks and flats",
            "As the camera gave them. Smooth flats are better: what stands in them and moves, or is missing in the "
            "views, makes rings. Their ratio, where there are two groups, is better the nearer it is to one "
            "everywhere.",
            reference_sheet(facts.references, facts.shape),
        )
    if facts.flagged:
        yield Picture(
            "Flagged frames",
            "The worst of the frames that the monitor flagged, as the camera gave them, with the place of the flag if "
            "it has one. Red: an alarm, the view is left out; orange: a warning, it weighs half.",
            contact_sheet(facts.flagged),
        )


def _slices(prepared: PreparedProjections, truth: Volume | None, volumes: Mapping[str, Volume]) -> Iterator[Picture]:
    """Slices of all volumes, and in what these differ from the first."""
    unit, kind = prepared.length_unit, VoxelKind.ATTENUATION
    shown = {"Truth": truth} if truth is not None else {}
    shown |= {label_of(method): volume for method, volume in volumes.items()}
    yield Picture(
        "Slices",
        "Three orthogonal slices through the centre of mass of the bright voxels, y and z downwards as in image "
        "viewers. All share one grey window, from air to the densest class of matter; rare metal is white.",
        pictures.orthogonal_slices(shown, unit, kind),
    )
    yield Picture(
        "Sharpest edge, and values",
        "Along a line through the sharpest edge: steeper is sharper, dips and overshoots beside the edge are "
        "artefacts. Values: narrower peaks are better, unless the sample has values between them.",
        pictures.profile_and_values(shown, unit, kind),
    )
    if len(shown) > 1:
        yield Picture(
            "Differences",
            f"What each volume has more (red) or less (blue) than {next(iter(shown))}, in the first slice. "
            + ("Nearer to white is better." if truth is not None else _NO_REFERENCE),
            pictures.differences(shown, unit, kind),
        )


def _several(series: VolumeSeries) -> Iterator[Picture]:
    """Slices of some of several volumes, side by side."""
    n, depth = series.data.shape[:2]
    some = spread(np.arange(n), _SHOWN)
    for title, turned in (("Slices of each time", False), ("Upright slices of each time", True)):
        if turned and depth < _UPRIGHT:
            continue
        sheet = SliceSheet("z" if turned else "y")
        for k in some:
            volume = series.data[k]
            sheet.add(series.labels[k], volume.swapaxes(0, 1) if turned else volume)
        yield Picture(
            title,
            f"{len(some)} of {n} times in one grey window: what differs has changed or moved.",
            sheet.png(sheet.labels()),
        )


def _doubts(made: Reconstruction, prepared: PreparedProjections, unexplained: Unexplained | None) -> Iterator[Picture]:
    """What the views do not show, error bars, what the volume leaves in the views, and how the work went."""
    unit, kind = prepared.length_unit, VoxelKind.ATTENUATION
    if unseen := unseen_wedges(prepared.geometry):
        yield Picture("Missing wedge", _of_wedges(unseen), pictures.wedges(made.volume, unseen, unit))
    if made.deviation is not None:
        yield Picture(
            "Error bars",
            "A slice, and the standard deviation of its voxels. About two of three voxels of the true sample are "
            "within one deviation of the volume. Fine texture that the method has smoothed away may lie outside.",
            pictures.error_bars(made.volume, made.deviation, unit, kind),
        )
    if unexplained is not None:
        at = len(unexplained.significance) // 2
        yield Picture(
            "What the volume leaves in the views",
            "Filtered back-projection of the residual over its noise. Even noise, seldom beyond 4, is better; an "
            "edge, a crack or a pore seen here is in the views and not in the volume. Blue: the volume has too "
            "much, red: too little.",
            pictures.significance(unexplained.significance[at], made.volume.grid, unexplained.first + at, unit),
        )
    if made.history:
        yield Picture(
            "Quality against time",
            _history_caption(made),
            quality_against_time(history_arrays(made.history)),
        )


def _views(prepared: PreparedProjections) -> Iterator[Picture]:
    """A corrected view, a sinogram, the search of the axis, and the poses."""
    data, geometry, unit, axis = prepared.projections.data, prepared.geometry, prepared.length_unit, prepared.axis
    yield Picture(
        "Projection",
        f"One corrected view: the line integral of the {VoxelKind.ATTENUATION.value} along each ray. Air is better the "
        "nearer to 0 and the more even it is.",
        pictures.projection(data, geometry, 0, unit),
    )
    yield Picture(
        "Sinogram",
        "The middle detector row of all views used. Fewer vertical stripes are better: they become rings; a curve "
        "that breaks off is a view that does not fit.",
        pictures.sinogram(data, geometry, geometry.detector_shape[0] // 2),
    )
    if axis is not None:
        yield Picture(
            "Rotation axis",
            f"Mismatch of the views with each candidate for the rotation axis ({axis.method}): 0 where "
            "they agree, about 1 where they have nothing in common. Columns are those of the binned detector.",
            pictures.axis_curve(axis.candidates, axis.curve, axis.value, axis.confident),
        )
    turns = np.degrees(np.stack((geometry.roll, geometry.tilt), axis=1))
    if geometry.shifts.any() or turns.any():
        moved = geometry.shifts * geometry.sample_pitch
        yield Picture(
            "Poses of the views",
            "Displacement at the sample, roll and tilt of each view, against the angle of the stage: runout, "
            "wobble, drift and jumps. `beamline export --poses` writes them as a table.",
            pictures.pose_curves(np.degrees(geometry.angles), moved, turns, unit),
        )


def _of_wedges(unseen: Sequence[Wedge]) -> str:
    """Size and direction of the wedges, and what they do to the volume."""
    directions = " and ".join("{:.0f} to {:.0f}°".format(*wedge.rays) for wedge in unseen)
    size = math.degrees(sum(wedge.size for wedge in unseen))
    return (
        f"{size:.0f}° of rays are in no view, those at {directions} from x towards y (orange): edges along them are "
        "blurred, and small things are drawn out across them."
    )


def _history_caption(made: Reconstruction) -> str:
    gaussians = {progress.n_gaussians for progress in made.history}
    growing = ["views"] * views_grew(made) + ["Gaussians"] * (len(gaussians) > 1)
    parts = ["Misfit to the views in use"]
    if (judged := residual_curve(history_arrays(made.history))) is not None:
        parts.append(f"the residual of {judged.views} as dB below the data")
    parts += [f"number of {' and of '.join(growing)}"] if growing else []
    since = "the file was found" if views_grew(made) else "the start"
    return f"{', '.join(parts)}, against the time since {since}. Lower misfit and more dB are better."
