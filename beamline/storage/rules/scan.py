"""Rules for a scan of any format, one function per rule. Other programs accept angles that are NaN; these rules do
not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from beamline.core.files import run_of
from beamline.core.text import count, spans
from beamline.plan.passes import ended_by
from beamline.storage.interrupted import next_step
from beamline.storage.parts import is_joined, joined_file_of, other_parts, to_join
from beamline.storage.readers.averaged import JOINED_DEG
from beamline.storage.readers.base import ScanSource, TakesTooLongError
from beamline.storage.rules import Finding, Severity
from beamline.storage.rules.angles import angles_spread, angles_unknown
from beamline.storage.rules.angles_shown import angles_shown
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.flag_policy import frames_flagged
from beamline.storage.rules.light import (
    darks_beside_views,
    exposures_agree,
    one_intensity,
    references_usable,
    several_energies,
    views_scaled,
)
from beamline.storage.rules.pixels import (
    CONSTANT_DARKS,
    darks_computed,
    numbers_wrapped,
    pixels_measured,
    quantity_stated,
)
from beamline.storage.rules.stored_order import axis_vertical, sinogram_assumed, views_first
from drivers.base.frame import FrameKind

VARYING = "lengths"  # a rule about values that differ between projections
_JOINED_BLUR = 4.0  # columns at the edge of the field of view, between the frames of one projection
# share of the detector: if the central ray is nearer to the middle, it counts as being in the middle
_OFF_MIDDLE = 0.05


def scan_ended(scan: ScanEvidence) -> Iterator[Finding]:
    """The file was closed, and the scan ended as planned. Otherwise the finding says what to do, or who ended the
    scan.
    """
    ending, n = scan.source.ending, count(len(scan.table), "frame")
    if not scan.source.finished:
        sentence = f"The file was not closed: {n} can be trusted."
    elif ending.status in ("stopped", "failed"):
        planned, taken = scan.source.plan.get("angles_deg", ()), scan.table.views.size
        of_plan = f", with {taken} of {len(planned)} projections" if isinstance(planned, list) and planned else ""
        of_plan += (
            "; the scan itself had decided to omit the other projections" if ended_by(scan.source.decisions) else ""
        )
        sentence = f"The scan ended with the status {ending.status!r} after {n}{of_plan}. {ending.reason}".strip()
    else:
        if ending.reason:
            yield Finding("info", "ended", ending.reason)
        return
    yield Finding("warning", "unfinished", f"{sentence} {next_step(scan.source.path)}".strip())


def altered_sentence(source: ScanSource) -> str:
    """Sentences about the rows of a scan whose record differs from its checksum."""
    rows = np.flatnonzero(source.table.altered).tolist()
    these_frames = "this frame" if len(rows) == 1 else "these frames"
    return (
        f"Look for an intact copy of {source.path}: the records of {count(len(rows), 'frame')} (kind, angle, time, "
        f"trigger) differ from the checksum stored with them: {spans(rows)}. No command uses {these_frames}."
    )


def references_present(scan: ScanEvidence) -> Iterator[Finding]:
    """A scan whose pixels are counts has darks and flats."""
    if "beside" in scan.source.attributes:
        folders = scan.source.attributes["beside"]
        sentence = f"The darks and flats next to the projections are used: {folders}."
        yield Finding("info", "references", sentence)
    for name, kind in (("flats", FrameKind.FLAT), ("darks", FrameKind.DARK)):
        if scan.in_counts and not scan.table.of_kind(kind).size:
            yield Finding(
                "error",
                "references",
                f"The frames are counts, but {name} are missing. Give --{name} with a file or a folder. If no {name} "
                "were taken, give the counts of a pixel as one number. If the frames were already divided by their "
                "flats, give --quantity transmission; if the logarithm was also taken, --quantity line-integrals.",
            )


def stated_used(scan: ScanEvidence) -> Iterator[Finding]:
    """Everything that the file states is used or reported. The report is a warning if the value may change the
    volume.
    """
    for field in scan.source.not_used:
        message = f"The file states {field.where}, {field.value}, which is not used: {field.why}."
        severity: Severity = "error" if field.wrong else "warning" if field.doubt else "info"
        yield Finding(severity, VARYING if field.wrong else "not-used", message)


def central_ray_taken(scan: ScanEvidence) -> Iterator[Finding]:
    """In a cone beam, the central ray that the file or the caller states meets the middle row and the rotation axis."""
    ways = ("row", "the middle of the rows", "--central-row"), ("column", "the rotation axis", "--axis")
    for (side, taken, option), position, n in zip(ways, scan.source.central_ray or (), scan.source.shape, strict=False):
        if scan.cone is not None and abs(position - (n - 1) / 2) > _OFF_MIDDLE * n:
            yield Finding(
                "warning",
                f"central-{side}",
                f"Give {option} {position:.6g} if the file is right: the file states that the central ray meets {side} "
                f"{position:.6g} (beam_center, counted from the centre of the first of {n} {side}s). The "
                f"reconstruction assumes {taken}.",
            )


def pixels_square(scan: ScanEvidence) -> Iterator[Finding]:
    """Pixels are square, unless each row is a separate slice."""
    width, height = scan.source.pixel_size_mm, scan.source.row_pitch_mm
    if height is None or width == 0:  # another rule checks for a width of 0
        return
    if not width or not 0.01 < height / width < 100:
        width_text = "unknown" if width is None else f"{width:g} mm"
        yield Finding(
            "error",
            "pixel-height",
            f"The pixels are stated to be {height:g} mm high, and their width is {width_text}. Such pixels are "
            "impossible.",
        )
    elif scan.cone is not None:
        yield Finding(
            "error",
            "pixel-height",
            f"Bin the columns or the rows of a copy of the file: the pixels are {width:g} mm wide and "
            f"{height:g} mm high, and a cone beam needs square pixels.",
        )
    else:
        yield Finding(
            "info",
            "pixel-height",
            f"The pixels are {width:g} mm wide and {height:g} mm high: slices will be {height:g} mm apart.",
        )


def joined_views(scan: ScanEvidence) -> str:
    """Frames that are averaged to one projection are not so far apart in angle that their mean is blurred."""
    degrees = float(scan.source.attributes.get(JOINED_DEG, 0.0))
    blur = np.radians(degrees) * scan.source.shape[1] / 2
    return "" if blur <= _JOINED_BLUR else (
        f"--frames-per-view {scan.source.frames_per_view} averages frames that are up to {degrees:.3g} degrees "
        f"apart, which blurs details at the edge of the field of view by {blur:.0f} pixels. If you do not want this "
        "blur, give the number of frames taken at each angle, or omit the option."
    )  # fmt: skip


def parts_joined(scan: ScanEvidence) -> Iterator[Finding]:
    """The file is not a single part of a resumed scan, but contains all parts."""
    if scan.table.part_starts.size > 1:
        return
    if (joined_file := joined_file_of(scan.source.path)) is not None and is_joined(joined_file[0]):
        joined, n = joined_file
        sentence = f"This file is one of {n} parts of a scan: use {joined}, which has the frames of all parts"
    elif others := other_parts(scan.source.path):
        other_part = others[0]
        join = to_join(run_of(scan.source.path.resolve().parent))
        sentence = f"This file has only a part of the scan, and {other_part} has another part: {join} of the scan"
    else:
        return
    yield Finding("error", "parts", f"{sentence}. To use only this part, copy the file out of the folder of its run.")


@dataclass(frozen=True)
class Row:
    """A row of the table for a rule with a single finding: the condition returns the sentence of the finding, or "" if
    there is nothing to report.
    """

    severity: Severity
    rule: str
    sentence: Callable[[ScanEvidence], object]

    def __call__(self, scan: ScanEvidence) -> Iterator[Finding]:
        if sentence := self.sentence(scan):
            yield Finding(self.severity, self.rule, str(sentence))


Rule = Callable[[ScanEvidence], Iterator[Finding]]
RULES: tuple[Rule, ...] = (
    Row("error", "views", lambda scan: (n := scan.table.views.size) < 2 and (
        f"The scan has {count(n, 'projection')}; a reconstruction needs at least 2 projections, and a good "
        "reconstruction needs hundreds."
    )),
    Row("error", "angles", angles_unknown),
    Row("warning", "angles", lambda scan: (where := scan.source.attributes.get("angles_reversed")) and (
        f"The angles of {where} are used with the opposite sign, because the vector of the rotation axis is "
        f"negative. --angles-path {where} uses the angles as stored; the volume is then mirrored."
    )),
    angles_spread,
    angles_shown,
    quantity_stated,
    references_present,
    numbers_wrapped,
    Row("info", CONSTANT_DARKS, darks_computed),
    exposures_agree,
    Row("error", "energies", several_energies),
    one_intensity,
    pixels_measured,
    Row("warning", "pixels", lambda scan: (wrong := scan.source.attributes.get("pixels")) and (
        f"The type of the pixels is stated wrongly or not at all: the pixels are {wrong}."
    )),
    views_scaled,
    axis_vertical,
    views_first,
    sinogram_assumed,
    Row("warning", "missing-frames", lambda scan: (n := scan.source.attributes.get("missing_triggers")) and (
        f"{n} triggers gave no frame; the file lists these triggers."
    )),
    Row("warning", "missing-frames", lambda scan: (numbers := scan.source.attributes.get("missing_numbers")) and (
        f"Look for lost files: these numbers are missing in the names of the files: {numbers}."
    )),
    Row("info", "pixel-size", lambda scan: scan.source.pixel_size_mm is None and (
        "The pixel size is unknown: lengths will be in pixels, densities per pixel."
    )),
    Row("error", "pixel-size", lambda scan: (size := scan.source.pixel_size_mm) is not None and not 0 < size < 10 and (
        f"A pixel size of {size:g} mm is impossible."
    )),
    pixels_square,
    stated_used,
    parts_joined,
    Row("warning", "frames-per-view", joined_views),
    central_ray_taken,
    scan_ended,
    references_usable,
    darks_beside_views,
    frames_flagged,
)  # fmt: skip
"""All rules on a scan, in the order in which `validate`, `info` and the preparation report their findings."""
BEFORE_VIEWS: tuple[Rule, ...] = (quantity_stated, references_present, numbers_wrapped, references_usable)
"""The rules that a running scan must meet before its projections are corrected."""


def findings_of(scan: ScanEvidence, rules: tuple[Rule, ...] = RULES) -> list[Finding]:
    """The findings of these rules on a scan. If a rule would take too long, a finding says that it was not
    applied.
    """
    findings = list[Finding]()
    for rule in rules:
        try:
            findings += rule(scan)
        except TakesTooLongError as error:
            findings.append(Finding("warning", "brief", str(error)))
    return findings
