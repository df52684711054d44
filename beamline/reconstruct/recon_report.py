"""The content of the report on a reconstruction: scan, settings, figures of merit, pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.phases import Phases
from beamline.core.text import spans
from beamline.projections.flagged_frames import reasons, reference_images, worst_frames
from beamline.projections.prepared import PreparedProjections
from beamline.projections.returned import returned_views
from beamline.projections.selection import Selection
from beamline.reconstruct.region import RegionOfRows
from beamline.report import figures
from beamline.report.contact_sheet import FlaggedFrame, contact_sheet, reference_sheet
from beamline.report.html import Picture, Report
from beamline.report.metrics import METRICS, formatted
from beamline.report.record import history_arrays, residual_curve
from beamline.report.time_curves import quality_against_time
from beamline.storage.flag_legend import FrameFlags, counted
from beamline.storage.readers.base import ScanSource, rows_replaced
from beamline.storage.writers.recon_file import Value
from drivers.base.frame import FrameKind
from recon.assess.time_model import NextDecibel, duration_text, next_decibel, next_decibel_of_fit
from recon.base.method import Progress
from recon.base.volume import Grid, Volume
from recon.methods import BASELINE, by_name
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings
from recon.voxels.fbp import Filter
from recon.voxels.unexplained import LIMIT, Unexplained
from recon.voxels.view_weights import Wedge, unseen_wedges


@dataclass(frozen=True)
class ScanFacts:
    """The facts of a scan for a report.

    Attributes:
        table: facts for people, by name.
        frames: frames in the file of those triggered, e.g. "110/110".
        remarks: faults during the scan, by the file.
        flagged: the worst of the flagged frames.
        references: mean darks and flats [row, col], binned, by title.
        shape: of a frame.
        columns: of the detector that are used, the last not included, as --cols takes them; empty: all.
    """

    path: Path
    name: str
    sample: str
    table: Mapping[str, str]
    frames: str
    remarks: Sequence[str] = ()
    flagged: Sequence[FlaggedFrame] = ()
    references: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    shape: tuple[int, int] = (1, 1)
    columns: str = ""


@dataclass(frozen=True, eq=False)
class ReconOutcome:
    """A reconstruction and how it was made.

    Attributes:
        seconds: of reconstruction alone.
        history: of the fit or the iterations; empty for FBP.
        filter: of the FBP (also of the one it is compared with).
        psnr: (seconds, dB) of snapshots, where there was a truth to compare them with.
        chosen: what a budget or a preset chose, in a line; empty where the settings were given.
        gaussians: the model behind the volume, before its finish on voxels; None where there is none.
        deviation: the standard deviation of each voxel; None where it was not asked for, or not finished.
    """

    volume: Volume
    method: str
    seconds: float
    history: Sequence[Progress]
    settings: Mapping[str, Any]
    filter: Filter = "hann"
    psnr: Sequence[tuple[float, float]] = ()
    chosen: str = ""
    gaussians: Gaussians | None = None
    deviation: Volume | None = None

    @property
    def next_decibel(self) -> NextDecibel | None:
        """The price of another dB: for a fit by fits of other lengths, for iterations by their own record.

        None for a direct method, while views still came, and for a resumed fit, whose whole time is not known. None
        also for other rates than those of the fits that were measured, as after following a scan.
        """
        judged = residual_curve(history_arrays(self.history))
        if judged is None or _grew(self) or "resumed_from" in self.settings:
            return None
        if "pace" in self.settings:  # of a fit
            usual = FitSettings()
            if self.settings["pace"] != usual.pace or self.settings.get("decay", usual.decay) != usual.decay:
                return None
            return next_decibel_of_fit(self.history[-1].seconds, self.history[-1].step)
        return next_decibel(judged.seconds, judged.residuals)

    @property
    def next_decibel_text(self) -> str:
        """The time of the next dB as text; empty if it is not known."""
        found, judged = self.next_decibel, residual_curve(history_arrays(self.history))
        if found is None or judged is None:
            return ""
        by_others = found.of == "volume"
        if not found.measurable:
            of_what = "reach of what was measured" if by_others else f"the residual of {judged.views}"
            return f"none {'in' if by_others else 'measurable in'} {of_what}"
        high = f"to {duration_text(found.high)}" if math.isfinite(found.high) else "or far more"
        span = f"{duration_text(found.low)} {high}"
        source = "as longer fits gained on four other scans"
        if not by_others:
            source = f"from the residual of {judged.views} as it fell"
        return f"about {duration_text(found.seconds)} more ({span}), {source}"


@dataclass(frozen=True)
class ReportContext:
    """The context of a reconstruction: the scan, the selection, the command, and the warnings so far.

    `stray` is the map of mass where views show nothing [y, x], None without any.
    """

    facts: ScanFacts
    selection: Selection
    command: str
    seed: int
    warnings: Sequence[str] = ()
    started: float = 0.0
    scan_flags: Sequence[str] = field(default_factory=tuple)
    recipe: str = ""
    region: RegionOfRows | None = None
    live_picture: str = ""  # file name of the last picture of a volume that grew with its scan
    phases: Phases = field(default_factory=Phases)
    leaves: Callable[[float], bool] = lambda seconds: True  # whether there is time for so much before the report
    stray: NDArray[np.float32] | None = None


_NO_REFERENCE = "Neither is the truth: what only one of them shows is to be looked for in the views."


def label_of(method: str) -> str:
    """A method's name for people."""
    return by_name(method).label


def facts_of(source: ScanSource, flags: FrameFlags | None = None) -> ScanFacts:
    """Facts of an open scan; `flags` count in place of the file's."""
    counts = {kind: int(np.sum(source.image_key == kind)) for kind in FrameKind}
    attributes = dict(source.attributes)
    sample = str(attributes.pop("sample", attributes.pop("sample_name", "")))
    pitch, energy = source.pixel_size_mm, source.energy_kev
    columns = "" if source.cols is None else f"{source.cols[0]}:{source.cols[1]}"
    missing, flags = int(attributes.get("missing_triggers", 0)), source.flags if flags is None else flags
    table = {
        "file": source.path.name,
        "format": source.format,
        "sample": sample or "not stated",
        "projections": str(counts[FrameKind.PROJECTION]),
        "flats, darks": f"{counts[FrameKind.FLAT]}, {counts[FrameKind.DARK]}",
        "detector (rows × columns)": f"{source.shape[0]} × {source.shape[1]}"
        + (f", columns {columns}" if columns else ""),
        "pixel size": "not known" if pitch is None else f"{pitch * 1e3:.4g} µm",
        "energy": "not known" if energy is None else f"{energy:g} keV",
        "axis in the file": "not stated" if source.axis_col is None else f"column {source.axis_col:.2f}",
        "flagged by the monitor": "no monitor looked at it" if flags is None else counted(flags.counts()),
    }
    table |= {str(k): _text(v) for k, v in attributes.items() if len(str(v)) <= 200 and str(k) not in table}
    n = int(source.image_key.size)
    again = rows_replaced(source)
    if again.size:
        table["views taken again"] = f"{again.size}, because of an alarm: frames {spans(again.tolist())} are not used"
    returned = returned_views(source)
    if returned:
        table["views on the way back"] = "; ".join(view.said() for view in returned)
    remarks = [] if flags is None else reasons(flags)
    remarks += [f"On the way back {view.said()} since the first view." for view in returned if view.moved]
    flagged = [] if flags is None else worst_frames(source, flags)
    frames = f"{n}/{n + missing}"
    images = reference_images(source)
    return ScanFacts(
        source.path, source.path.name, sample, table, frames, remarks, flagged, images, source.shape, columns
    )


def compose(
    made: ReconOutcome,
    prepared: PreparedProjections,
    truth: Volume | None,
    volumes: Mapping[str, Volume],
    metrics: Mapping[str, Mapping[str, float]],
    parameters: Mapping[str, Value],
    context: ReportContext,
    left: Unexplained | None = None,
) -> Report:
    """The report on a reconstruction; `left` is the structure in its residual, if known."""
    settings = {
        k: _text(v) for k, v in parameters.items() if not isinstance(v, np.ndarray) and k not in ("command", "recipe")
    }
    return Report(
        title=f"{context.facts.sample or context.facts.name}: {label_of(made.method)}",
        summary=_summary(made, prepared, truth, metrics, context),
        scan=context.facts.table,
        settings=settings,
        metrics={label_of(method): values for method, values in metrics.items()},
        frames=context.facts.frames,
        flags=[*context.scan_flags, *context.facts.remarks, *context.warnings],
        pictures=[
            *_pictures(made, prepared, truth, volumes, left),
            *_stray_mass(context.stray, made.volume.grid, prepared),
            *_frame_pictures(context.facts),
        ],
        command=context.command,
        recipe=context.recipe,
        footnotes=_footnotes(made, truth, metrics, left),
        live_picture=context.live_picture,
    )


def _summary(
    made: ReconOutcome,
    prepared: PreparedProjections,
    truth: Volume | None,
    metrics: Mapping[str, Mapping[str, float]],
    context: ReportContext,
) -> str:
    name, geometry = label_of(made.method), prepared.geometry
    best = "psnr" if truth is not None else "residual"
    own = metrics[made.method]
    best = best if best in own else "seconds"  # a region by FBP is compared with nothing
    summary = (
        f"{name} volume of {' × '.join(str(n) for n in made.volume.grid.shape)} voxels from {geometry.n_views} of "
        f"{prepared.n_projections} views in {made.seconds:.1f} s; {METRICS[best].label} {formatted(best, own[best])}"
    )
    if BASELINE in metrics and made.method != BASELINE:
        summary += f" (FBP of the same views: {formatted(best, metrics[BASELINE][best])})"
    if context.region is not None:
        summary += f". Written, and shown in pictures of slices: the region {context.region.region} [z, y, x]"
    if made.chosen:
        summary += f". Chosen: {made.chosen}"
    if made.next_decibel_text:
        summary += f". The next dB: {made.next_decibel_text}"
    return summary + "."


def _footnotes(
    made: ReconOutcome, truth: Volume | None, metrics: Mapping[str, Mapping[str, float]], left: Unexplained | None
) -> list[str]:
    """What the figures of merit mean, as far as there are any."""
    footnotes = [
        "Data residual: |A x − p| / |p| over up to 16 views, A the voxel projector (Joseph 1982).",
        f"SNR, CNR: between the two classes of k-means on the values of {'the truth' if truth else 'this volume'}. A "
        "smoother volume has more of both, though it may show less: look for cracks and pores in the pictures.",
    ]
    if any("air" in values for values in metrics.values()):
        footnotes.append(
            "Level of air: the mean where FBP has no matter, over the deviation of FBP there (blocks of voxels). "
            "Air of FBP that is below zero is missing from the other volume's weak matter."
        )
    if _grew(made):
        footnotes.append(
            "Time of R²-Gaussian: from the first look at the growing file to the volume; it includes the scan."
        )
    if "resumed_from" in made.settings:
        footnotes.append(f"Time of {label_of(made.method)}: since the fit was resumed, without the time before.")
    if left is not None:
        footnotes.append(
            f"Matter that leaves structure: voxels at which the back-projected residual of {len(left.significance)} "
            f"slices exceeds four standard deviations of its noise; above {LIMIT:g} a fit hides something."
        )
    if "stray" in metrics[made.method]:
        footnotes.append(
            "Mass where views show nothing: share of the volume's mass in voxels whose rays meet no matter in two "
            "views at least. Sparse views leave blobs and streaks there."
        )
    if truth is not None:
        footnotes.append(
            "PSNR: the peak is the truth's largest value. SSIM 3D: mean over the slices of three directions."
        )
    return footnotes


def _stray_mass(stray: NDArray[np.float32] | None, grid: Grid, prepared: PreparedProjections) -> list[Picture]:
    if stray is None:
        return []
    caption = (
        "The highest density above each other, of voxels that the views show to be empty. All of it is an artefact: "
        "less is better."
    )
    return [Picture("Stray mass", caption, figures.stray_mass(stray, grid, prepared.length_unit, prepared.kind))]


def _frame_pictures(facts: ScanFacts) -> list[Picture]:
    """Darks, flats and flagged frames, as far as there are any."""
    pictures = []
    if facts.references:
        caption = (
            "As the camera gave them. Smooth flats are better: what stands in them and moves, or is missing in the "
            "views, makes rings. Their ratio, where there are two groups, is better the nearer it is to one everywhere."
        )
        pictures.append(Picture("Darks and flats", caption, reference_sheet(facts.references, facts.shape)))
    if facts.flagged:
        caption = (
            "The worst of the frames that the monitor flagged, as the camera gave them, with the place of the flag if "
            "it has one. Red: an alarm, the view is left out; orange: a warning, it weighs half."
        )
        pictures.append(Picture("Flagged frames", caption, contact_sheet(facts.flagged)))
    return pictures


def _pictures(
    made: ReconOutcome,
    prepared: PreparedProjections,
    truth: Volume | None,
    volumes: Mapping[str, Volume],
    left: Unexplained | None,
) -> list[Picture]:
    data, geometry, unit = prepared.projections.data, prepared.geometry, prepared.length_unit
    kind, row = prepared.kind, geometry.detector_shape[0] // 2
    shown = {"Truth": truth} if truth is not None else {}
    shown |= {label_of(method): volume for method, volume in volumes.items()}
    pictures = [
        Picture(
            "Slices",
            "Three orthogonal slices through the centre of mass of the bright voxels, y and z downwards as in image "
            "viewers. All share one grey window (1st to 99.5th percentile).",
            figures.orthogonal_slices(shown, unit, kind),
        ),
        Picture(
            "Slices, low contrast",
            "The same slices, brighter: the 2nd to 90th percentile, for weak matter; fewer streaks are better.",
            figures.orthogonal_slices(shown, unit, kind, (2.0, 90.0)),
        ),
        Picture(
            "Sharpest edge, and values",
            "Along a line through the sharpest edge: steeper is sharper, dips and overshoots beside the edge are "
            "artefacts. Values: narrower peaks are better, unless the sample has values between them.",
            figures.profile_and_values(shown, unit, kind),
        ),
    ]
    if unseen := unseen_wedges(geometry):
        pictures.append(Picture("Missing wedge", _of_wedges(unseen), figures.wedges(made.volume, unseen, unit)))
    if len(shown) > 1:
        pictures.append(
            Picture(
                "Differences",
                f"What each volume has more (red) or less (blue) than {next(iter(shown))}, in the first slice. "
                + ("Nearer to white is better." if truth is not None else _NO_REFERENCE),
                figures.differences(shown, unit, kind),
            )
        )
    if made.deviation is not None:
        pictures.append(
            Picture(
                "Error bars",
                "A slice, and the standard deviation of its voxels. About two of three voxels of the true sample are "
                "within one deviation of the volume. Fine texture that the method has smoothed away may lie outside.",
                figures.error_bars(made.volume, made.deviation, unit, kind),
            )
        )
    if left is not None:
        at = len(left.significance) // 2
        pictures.append(
            Picture(
                "What the volume leaves in the views",
                "Filtered back-projection of the residual over its noise. Even noise, seldom beyond 4, is better; an "
                "edge, a crack or a pore seen here is in the views and not in the volume. Blue: the volume has too "
                "much, red: too little.",
                figures.significance(left.significance[at], made.volume.grid, left.first + at, unit),
            )
        )
    if made.history:
        pictures.append(
            Picture(
                "Quality against time",
                _history_caption(made),
                quality_against_time(history_arrays(made.history), made.psnr, made.next_decibel),
            )
        )
    pictures += [
        Picture(
            "Projection",
            f"One corrected view: the line integral of the {kind.value} along each ray. Air is better the nearer "
            "to 0 and the more even it is.",
            figures.projection(data, geometry, 0, unit),
        ),
        Picture(
            "Sinogram",
            "The middle detector row of all views used. Fewer vertical stripes are better: they become rings; a curve "
            "that breaks off is a view that does not fit.",
            figures.sinogram(data, geometry, row),
        ),
    ]
    if prepared.axis is not None:
        axis = prepared.axis
        pictures.append(
            Picture(
                "Rotation axis",
                f"Mismatch of the views with each candidate for the rotation axis ({axis.method}): lower is "
                "better, 0 is perfect agreement, about 1 is none. Columns of the binned detector.",
                figures.axis_curve(axis.candidates, axis.curve, axis.value, axis.confident),
            )
        )
    turns = np.degrees(np.stack((geometry.roll, geometry.tilt), axis=1))
    if geometry.shifts.any() or turns.any():
        pitch, unit = geometry.sample_pitch, prepared.length_unit
        pictures.append(
            Picture(
                "Poses of the views",
                "Displacement at the sample, roll and tilt of each view, against the angle of the stage: runout, "
                "wobble, drift and jumps. `beamline export --poses` writes them as a table.",
                figures.pose_curves(np.degrees(geometry.angles), geometry.shifts * pitch, turns, unit),
            )
        )
    return pictures


def _of_wedges(unseen: Sequence[Wedge]) -> str:
    """Size and direction of the wedges, and what they do to the volume."""
    said = " and ".join("{:.0f} to {:.0f}°".format(*wedge.rays) for wedge in unseen)
    size = math.degrees(sum(wedge.size for wedge in unseen))
    return (
        f"{size:.0f}° of rays are in no view, those at {said} from x towards y (orange): edges along them are blurred, "
        "and small things are drawn out across them."
    )


def _grew(made: ReconOutcome) -> bool:
    """The number of views grew during the fit."""
    return len({progress.n_views for progress in made.history}) > 1


def _history_caption(made: ReconOutcome) -> str:
    gaussians = {progress.n_gaussians for progress in made.history}
    growing = ["views"] * _grew(made) + ["Gaussians"] * (len(gaussians) > 1)
    parts = ["Misfit to the views in use"]
    if (judged := residual_curve(history_arrays(made.history))) is not None:
        parts.append(f"the residual of {judged.views} as dB below the data")
    parts += ["PSNR of its snapshots against the truth"] if made.psnr else []
    parts += [f"number of {' and of '.join(growing)}"] if growing else []
    since = "the file was found" if _grew(made) else "the start"
    return f"{', '.join(parts)}, against the time since {since}. Lower misfit and more dB are better."


def _text(value: object) -> str:
    """A value as text for people; the file holds the exact value."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)
