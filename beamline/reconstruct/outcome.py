"""The outcome of a reconstruction, and the facts of its scan and run that a report and a file state."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.phases import Phases
from beamline.core.text import spans
from beamline.projections.flagged_frames import reasons, reference_images, worst_frames
from beamline.projections.returned import returned_views
from beamline.projections.selection import Selection
from beamline.reconstruct.region import RegionOfRows
from beamline.report.record import history_arrays, residual_curve
from beamline.storage.flag_legend import FrameFlags, counted
from beamline.storage.readers.base import ScanSource, rows_replaced
from beamline.storage.rules.validate import scan_ended
from drivers.base.frame import FrameKind
from recon.assess.time_model import NextDecibel, duration_text, next_decibel, next_decibel_of_fit
from recon.base.method import Progress
from recon.base.volume import Volume
from recon.methods import by_name
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings
from recon.voxels.fbp import Filter

if TYPE_CHECKING:
    from beamline.report.contact_sheet import FlaggedFrame


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
        ended: how the scan ended where it did not take all its frames, and why; empty: it did, or runs.
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
    ended: str = ""


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
    def grew(self) -> bool:
        """The number of views grew during the fit."""
        return len({progress.n_views for progress in self.history}) > 1

    @property
    def next_decibel(self) -> NextDecibel | None:
        """The price of another dB: for a fit by fits of other lengths, for iterations by their own record.

        None for a direct method, while views still came, and for a resumed fit, whose whole time is not known. None
        also for other rates than those of the fits that were measured, as after following a scan.
        """
        judged = residual_curve(history_arrays(self.history))
        if judged is None or self.grew or "resumed_from" in self.settings:
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

    `stray` is the map of mass where views show nothing [y, x], None without any. `elapsed` are the seconds of the whole
    command until its report is drawn, 0 before.
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
    elapsed: float = 0.0


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
    table |= {str(k): as_text(v) for k, v in attributes.items() if len(str(v)) <= 200 and str(k) not in table}
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
    ended = " ".join(finding.message for finding in scan_ended(source)) if source.finished else ""
    return ScanFacts(
        source.path, source.path.name, sample, table, frames, remarks, flagged, images, source.shape, columns, ended
    )


def as_text(value: object) -> str:
    """A value as text for people; the file holds the exact value."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)
