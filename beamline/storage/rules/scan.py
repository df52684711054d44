"""Conditions for trust in a scan of any format, one function a rule. Public validators accept NaN angles, not these."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from beamline.core.files import run_of
from beamline.core.text import count, spans
from beamline.plan.passes import ended_by
from beamline.storage.interrupted import next_step
from beamline.storage.parts import is_joined, joined_file_of, other_parts, to_join
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules import Finding, Severity
from beamline.storage.rules.angles import angles_known, angles_spread
from beamline.storage.rules.angles_shown import angles_shown
from beamline.storage.rules.light import exposures_agree, light_one, one_energy, views_scaled
from beamline.storage.rules.pixels import (
    darks_measured,
    numbers_wrapped,
    pixels_as_labelled,
    pixels_measured,
    quantity_stated,
)
from beamline.storage.rules.stored_order import axis_vertical, sinogram_told, views_first
from drivers.base.frame import FrameKind

VARYING = "lengths"  # a rule on those that differ from view to view
_OFF_MIDDLE = 0.05  # of the detector: a central ray nearer to its middle is as good as there


def scan_findings(source: ScanSource) -> list[Finding]:
    """Findings of `SOURCE_RULES` on an open scan."""
    return [finding for rule in SOURCE_RULES for finding in rule(source)]


def scan_ended(source: ScanSource) -> Iterator[Finding]:
    """The writer closed the file, and the scan ended as planned; else a remedy, or who ended it."""
    ending, n = source.ending, count(len(source.table), "frame")
    if not source.finished:
        sentence = f"The file was not closed: {n} can be trusted."
    elif ending.status in ("stopped", "failed"):
        planned, taken = source.plan.get("angles_deg", ()), source.table.views.size
        of_plan = f", with {taken} of {len(planned)} views" if isinstance(planned, list) and planned else ""
        of_plan += "; it had decided against the others" if ended_by(source.decisions) else ""
        sentence = f"The scan ended as {ending.status!r} after {n}{of_plan}. {ending.reason}".strip()
    else:
        if ending.reason:
            yield Finding("info", "ended", ending.reason)
        return
    yield Finding("warning", "unfinished", f"{sentence} {next_step(source.path)}".strip())


def altered_sentence(source: ScanSource) -> str:
    """Sentences on the rows of a scan whose record differs from its checksum."""
    rows = np.flatnonzero(source.table.altered).tolist()
    return (
        f"{source.path}: what is said of {count(len(rows), 'frame')} (kind, angle, time, trigger) differs from the "
        f"checksum written with it: {spans(rows)}. Nothing uses {'it' if len(rows) == 1 else 'them'}. Look for a good "
        "copy."
    )


def enough_views(source: ScanSource) -> Iterator[Finding]:
    """A reconstruction needs at least two projections."""
    n = source.table.views.size
    if n < 2:
        yield Finding("error", "views", f"{n} projections: a reconstruction needs at least 2, a good one hundreds.")


def references_present(source: ScanSource) -> Iterator[Finding]:
    """Scans of counts have darks and flats."""
    if source.quantity == "unknown" and (path := Path(source.path).absolute()).is_dir():
        others = [each.name for each in path.parent.glob("*/") if each != path]
        beside = ", ".join(sorted(name for name in others if re.search("dark|flat|white|open.?beam", name.lower()))[:4])
        if beside:
            yield Finding("error", "references", f"Beside it lie {beside}: --quantity counts takes their images, too.")
    if "beside" in source.attributes:
        said = f"Darks and flats are those beside the views: {source.attributes['beside']}."
        yield Finding("info", "references", said)
    for name, kind in (("flats", FrameKind.FLAT), ("darks", FrameKind.DARK)):
        if source.quantity == "counts" and not source.table.of_kind(kind).size:
            yield Finding(
                "error",
                "references",
                f"Counts without {name}: give --{name} FILE, a folder, or their counts as one number where none were "
                "taken. If the frames were divided by their flats, say --quantity transmission, or line-integrals "
                "where their logarithm was taken.",
            )


def series_complete(source: ScanSource) -> Iterator[Finding]:
    """Every trigger has a frame, and no number is missing in a series of files."""
    missing = source.attributes.get("missing_triggers", 0)
    if missing:
        yield Finding("warning", "missing-frames", f"{missing} triggers gave no frame; the file lists them.")
    numbers = source.attributes.get("missing_numbers", "")
    if numbers:
        yield Finding("warning", "missing-frames", f"The series of files leaves out the numbers {numbers}.")


def scale_known(source: ScanSource) -> Iterator[Finding]:
    """The pixel size is known; without it a volume has no scale."""
    if source.pixel_size_mm is None:
        yield Finding("info", "pixel-size", "No pixel size: lengths will be in pixels, densities per pixel.")
    elif not 0 < source.pixel_size_mm < 10:
        yield Finding("error", "pixel-size", f"A pixel size of {source.pixel_size_mm:g} mm cannot be.")


def stated_used(source: ScanSource) -> Iterator[Finding]:
    """Everything that the file states is used or reported: as a warning if it may change the volume."""
    for field in source.not_used:
        message = f"The file states {field.where}, {field.value}, which is not used: {field.why}."
        severity: Severity = "error" if field.wrong else "warning" if field.doubt else "info"
        yield Finding(severity, VARYING if field.wrong else "not-used", message)


def central_ray_taken(source: ScanSource) -> Iterator[Finding]:
    """The central ray of a cone, which the file states or the caller, meets the middle of the rows, and the axis."""
    ways = ("row", "the middle of the rows", "--central-row"), ("column", "the rotation axis", "--axis")
    for (side, taken, option), at, n in zip(ways, source.central_ray or (), source.shape, strict=False):
        if source.cone is not None and abs(at - (n - 1) / 2) > _OFF_MIDDLE * n:
            yield Finding(
                "warning",
                f"central-{side}",
                f"The file says that the central ray meets {side} {at:.6g} (beam_center, from the centre of the first "
                f"of {n}). It is taken to meet {taken}: give {option} {at:.6g} where the file is right.",
            )


def pixels_square(source: ScanSource) -> Iterator[Finding]:
    """Pixels are square, or each row is a separate slice."""
    width, height = source.pixel_size_mm, source.row_pitch_mm
    if height is None or width == 0:  # a width of 0 is another rule's
        return
    if not width or not 0.01 < height / width < 100:
        width_text = "unknown" if width is None else f"{width:g} mm"
        yield Finding(
            "error", "pixel-height", f"The pixels are {height:g} mm high; their width is {width_text}. That cannot be."
        )
    elif source.cone is not None:
        yield Finding(
            "error",
            "pixel-height",
            f"The pixels are {width:g} mm wide and {height:g} mm high, in a cone beam: square pixels are expected. Bin "
            "the columns or the rows of a copy of the file.",
        )
    else:
        yield Finding(
            "info",
            "pixel-height",
            f"The pixels are {width:g} mm wide and {height:g} mm high: slices will be {height:g} mm apart.",
        )


def parts_joined(source: ScanSource) -> Iterator[Finding]:
    """The file is not a single part of a resumed scan."""
    if source.table.part_starts.size > 1:
        return
    if (joined_file := joined_file_of(source.path)) is not None and is_joined(joined_file[0]):
        joined, n = joined_file
        sentence = f"This file is one of {n} parts of a scan: give {joined}, which has the frames of all"
    elif others := other_parts(source.path):
        sentence = f"This file is a part of a run, as {others[0]} is, and no file has the frames of all its parts"
        sentence += f": {to_join(run_of(source.path.resolve().parent))}"
    else:
        return
    yield Finding("error", "parts", f"{sentence}. For this part alone, copy it out of the folder of its run.")


SOURCE_RULES: tuple[Callable[[ScanSource], Iterator[Finding]], ...] = (
    enough_views,
    angles_known,
    angles_spread,
    angles_shown,
    quantity_stated,
    references_present,
    numbers_wrapped,
    darks_measured,
    exposures_agree,
    one_energy,
    light_one,
    pixels_measured,
    pixels_as_labelled,
    views_scaled,
    axis_vertical,
    views_first,
    sinogram_told,
    series_complete,
    scale_known,
    pixels_square,
    stated_used,
    parts_joined,
)
