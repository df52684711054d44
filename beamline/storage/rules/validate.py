"""validate: conditions for trust in a scan, one function a rule. Public validators accept NaN angles; these do not.

The rules here look at a scan of any format through ScanSource; nexus_rules looks at how an NXtomo is written down.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError, damaged, user_message
from beamline.core.text import count, spans
from beamline.storage import hdf5
from beamline.storage.parts import is_joined, joined_file_of, other_parts
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.rules.finding import Finding, Severity
from beamline.storage.rules.flags import frames_flagged
from beamline.storage.rules.nexus import nexus_findings
from beamline.storage.rules.references import references_usable
from beamline.storage.rules.volume import volume_findings
from beamline.storage.volumes.files import opened_volume, times_of, volume_format
from beamline.storage.writers.partial_volume import completion_cut_short
from drivers.base.frame import FrameKind
from recon.base.units import look_like_counts, look_like_degrees

__all__ = ["Finding", "scan_findings", "source_findings", "validate"]

Progress = Callable[[int, int], None]  # Is told how many of how many frames are done

_FARTHEST = 1e6  # degrees
_COUNTED = " They are 0, 1, 2 and so on: do they count the frames?"
_FEWEST, _MANY = 5, 30  # views from which on a span tells a unit: if it is a turn in that unit, and in any case

SAMPLES = 4  # frames of a kind that are looked at
EXPOSURE_TOLERANCE = 1e-3  # cameras round an exposure


def validate(scan: SourceOptions | Path | str, deep: Progress | None = None) -> list[Finding]:
    """Everything that the rules find in a file, worst first; [] for a scan without fault.

    Never raises for faults of the file: a file that cannot be opened is a finding. Volumes have rules of their own.

    Args:
        deep: every frame is read and compared with its checksum; is told how many of how many.
    """
    path = Path(scan.path if isinstance(scan, SourceOptions) else scan)
    if completion_cut_short(path):
        said = f"Its writer was killed when it became the output; recon --resume {path} makes that of it."
        return [Finding("error", "partial", said)]
    kind = volume_format(path)
    findings = _as_hdf5(path) if kind is None else []
    try:
        if kind is not None:
            of_all: dict[Finding, None] = {}
            for at in range(len(times_of(path))) or (None,):
                with opened_volume(path, at=at) as record, hdf5.readable(path):
                    of_all |= dict.fromkeys(volume_findings(record))
            return [*of_all]
        with open_scan(scan) as source:
            findings += source_findings(source)
            findings += frames_as_written(source, deep)
    except DataError as error:
        if not any(finding.severity == "error" for finding in findings):  # else it is already said why
            findings.append(Finding("error", "readable", str(error)))
    except (OSError, RuntimeError, KeyError) as error:
        if not damaged(error):
            raise
        findings.append(Finding("error", "readable", user_message(error)))
    order = ("error", "warning", "info")
    return sorted(findings, key=lambda finding: order.index(finding.severity))


def source_findings(source: ScanSource) -> list[Finding]:
    """What the rules of this module find in an open scan, what is wrong with its references, and what is flagged."""
    return [*scan_findings(source), *references_usable(source), *frames_flagged(source)]


def scan_findings(source: ScanSource) -> list[Finding]:
    """What the rules of this module find in an open scan."""
    return [finding for rule in SOURCE_RULES for finding in rule(source)]


def frames_as_written(source: ScanSource, progress: Progress | None) -> Iterator[Finding]:
    """Every frame can be read, and has the checksum that was written with it, where the file has checksums.

    Args:
        progress: how many of how many frames were read; None: only those that other rules have read are judged.
    """
    n, unreadable, why = int(source.image_key.size), list[int](), ""
    if source.altered:
        yield Finding("error", "records", altered_said(source))
    for row in range(n) if progress is not None else ():
        try:
            source.read([row])
        except DataError as error:
            unreadable.append(row)
            why = why or str(error)
        if progress is not None:
            progress(row + 1, n)
    if unreadable:
        said = f"{count(len(unreadable), 'frame')} cannot be read: {spans(unreadable)}. {why} Look for a good copy."
        yield Finding("error", "unreadable", said)
    if source.damaged:
        yield Finding(
            "error",
            "checksums",
            f"{len(source.damaged)} of {n} frames differ from the checksums that were written with them: "
            f"{spans(sorted(source.damaged))}. Look for a good copy; `beamline recon` leaves them out."
            + ("" if progress else " `validate --deep` compares all frames."),
        )
    elif progress and not source.checksummed:
        yield Finding("info", "checksums", "The file holds no checksums: it is only known that its frames can be read.")


def altered_said(source: ScanSource) -> str:
    """Sentences on the rows of a scan whose record differs from its checksum."""
    rows = sorted(source.altered)
    return (
        f"{source.path}: what is said of {count(len(rows), 'frame')} (kind, angle, time, trigger) differs from the "
        f"checksum written with it: {spans(rows)}. Nothing uses {'it' if len(rows) == 1 else 'them'}. Look for a good "
        "copy."
    )


def enough_views(source: ScanSource) -> Iterator[Finding]:
    """A reconstruction needs at least two projections."""
    n = int((source.image_key == FrameKind.PROJECTION).sum())
    if n < 2:
        yield Finding("error", "views", f"{n} projections: a reconstruction needs at least 2, a good one hundreds.")


def angles_known(source: ScanSource) -> Iterator[Finding]:
    """Every projection has a finite angle."""
    views = np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    unknown = views[~np.isfinite(source.angles[views])]
    if unknown.size:
        why = source.attributes.get("angles", "")
        yield Finding(
            "error",
            "angles",
            f"{unknown.size} of {views.size} projections have no angle (first: frame {unknown[0]})"
            + (f"; {why}" if why else "")
            + ". Give them with --angles FILE (degrees, one a line).",
        )


def angles_spread(source: ScanSource) -> Iterator[Finding]:
    """The projections look from different directions, over half a turn, and their angles can be degrees."""
    angles = source.angles[source.image_key == FrameKind.PROJECTION]
    if angles.size < 2 or not np.isfinite(angles).all():
        return
    farthest = float(np.abs(angles).max()) * 180 / np.pi
    if farthest > _FARTHEST:
        yield Finding(
            "error",
            "angle-spread",
            f"The projections are at up to {farthest:.3g} degrees; expected at most {_FARTHEST:g}, beyond which "
            "angles are not exact. Are their units right? Give them with --angles FILE (degrees, one a line).",
        )
        return
    degrees = np.degrees(angles)
    span = float(np.ptp(degrees))
    distinct = np.unique(np.round(degrees, 6))
    if distinct.size == 1:
        yield Finding("error", "angle-spread", f"All {angles.size} projections are at {distinct[0]:g} degrees.")
        return
    step = span / (distinct.size - 1)
    # A plan is of our own scans, whose angles are in degrees.
    severity: Severity = "warning" if source.plan else "error"
    between = float(np.median(np.abs(np.diff(degrees))))
    if look_like_degrees(angles):
        yield Finding(
            severity,
            "angle-spread",
            f"{angles.size} projections span {span / 360:.1f} turns, or {np.ptp(angles):.5g} in radians: these look "
            "like degrees under a label of radians. If so, give them with --angles FILE (degrees, one a line).",
        )
    elif between >= 360:
        yield Finding(
            severity,
            "angle-spread",
            f"The projections go from {degrees.min():.6g} to {degrees.max():.6g} degrees, {between:.4g} from one to "
            "the next, which is a turn or more: these look like counts of an encoder or of steps. Give them in "
            "degrees with --angles FILE (one a line); if they are right, give them less whole turns.",
        )
    elif (unit := _smaller_unit(distinct, angles.size)) is not None:
        yield Finding(
            severity,
            "angle-spread",
            f"{angles.size} projections span only {span:.4g} degrees: {unit} Give them in degrees with --angles FILE "
            "(one a line).",
        )
    elif span + step < 179.5:
        yield Finding(
            "warning",
            "angle-spread",
            f"The projections span {span:.2f} degrees: less than half a turn (limited angle)."
            + (_COUNTED if np.allclose(degrees, np.arange(angles.size)) else ""),
        )


def _smaller_unit(degrees: NDArray[np.float64], n: int) -> str | None:
    """What n angles under a label of degrees, distinct and ascending, are instead; None where they may be degrees."""
    span = float(degrees[-1] - degrees[0])
    whole = span + span / (degrees.size - 1)
    for unit, turn in (("radians", 2 * np.pi), ("turns", 1.0)):
        for part, name in ((turn / 2, "half a turn"), (turn, "a turn")):
            if n >= _FEWEST and min(abs(span / part - 1), abs(whole / part - 1)) < 0.01:
                return f"these look like {unit}, of which {part:.5g} are {name}."
    return "these look like radians or turns." if n > _MANY and span <= 2 * np.pi else None


def quantity_said(source: ScanSource) -> Iterator[Finding]:
    """It is known what a pixel means: a forgotten or a second logarithm ruins a volume without a sign."""
    if source.quantity == "unknown":
        note = source.attributes.get("quantity")
        said = "Nothing says" if note is None else f"The file says only in its own words ({str(note)[:80]!r})"
        yield Finding(
            "error",
            "quantity",
            f"{said} whether pixels are counts or line integrals: say --quantity counts or --quantity line-integrals.",
        )


def references_present(source: ScanSource) -> Iterator[Finding]:
    """Counts come with darks and flats."""
    if source.quantity != "counts":
        return
    for name, kind in (("flats", FrameKind.FLAT), ("darks", FrameKind.DARK)):
        if not (source.image_key == kind).any():
            yield Finding(
                "error",
                "references",
                f"Counts without {name}: give --{name} FILE (or a folder), or --quantity line-integrals if they are.",
            )


def exposures_agree(source: ScanSource) -> Iterator[Finding]:
    """Darks are exposed as long as the projections, and the projections alike. Flats may have an exposure of their own,
    for their light is scaled to the projections'."""
    exposures = source.exposures
    views = exposures[(source.image_key == FrameKind.PROJECTION) & np.isfinite(exposures)]
    if source.quantity != "counts" or views.size == 0:
        return
    usual = float(np.median(views))
    if np.ptp(views) > EXPOSURE_TOLERANCE * usual:
        yield Finding(
            "warning",
            "exposures",
            f"The projections were exposed for {views.min():g} to {views.max():g} s; they are all corrected as if for "
            f"{usual:g} s.",
        )
    darks = np.unique(exposures[(source.image_key == FrameKind.DARK) & np.isfinite(exposures)])
    if (np.abs(darks - usual) > EXPOSURE_TOLERANCE * usual).any():
        said = ", ".join(f"{dark:g}" for dark in darks[:4])
        yield Finding(
            "warning",
            "exposures",
            f"The darks were exposed for {said} s and the projections for {usual:g} s: hot pixels and dark current are "
            "not the same. Take darks with the projections' exposure.",
        )


def pixels_measured(source: ScanSource) -> Iterator[Finding]:
    """Projections hold finite numbers that are not all the same."""
    views = _sample(source, FrameKind.PROJECTION)
    if views is None:
        return
    finite = np.isfinite(views)
    if not finite.any():
        yield Finding("error", "pixels", "No finite pixel in the projections looked at: they are all NaN or infinite.")
    elif float(views[finite].min()) == float(views[finite].max()):
        yield Finding("error", "pixels", f"Every pixel of the projections looked at is {views[finite][0]:g}.")
    elif not finite.all():
        yield Finding("warning", "pixels", f"{1 - finite.mean():.3%} of the pixels looked at are NaN or infinite.")
    if source.quantity == "line_integrals" and look_like_counts(views):
        yield Finding(
            "warning",
            "pixels",
            f"The line integrals have a median of {np.nanmedian(views):.4g}, which no light passes: are they counts? "
            "If so, say --quantity counts, with darks and flats.",
        )


def series_complete(source: ScanSource) -> Iterator[Finding]:
    """No trigger without a frame, and no number left out of a series of files."""
    missing = source.attributes.get("missing_triggers", 0)
    if missing:
        yield Finding("warning", "missing-frames", f"{missing} triggers gave no frame; the file lists them.")
    numbers = source.attributes.get("missing_numbers", "")
    if numbers:
        yield Finding("warning", "missing-frames", f"The series of files leaves out the numbers {numbers}.")


def scale_known(source: ScanSource) -> Iterator[Finding]:
    """Pixel size, without which a volume has no scale."""
    if source.pixel_size_mm is None:
        yield Finding("info", "pixel-size", "No pixel size: lengths will be in pixels, densities per pixel.")
    elif not 0 < source.pixel_size_mm < 10:
        yield Finding("error", "pixel-size", f"A pixel size of {source.pixel_size_mm:g} mm cannot be.")


def stated_used(source: ScanSource) -> Iterator[Finding]:
    """What the file states is used, or named: as a warning where it may change the volume."""
    for field in source.not_used:
        message = f"The file states {field.where}, {field.value}, which is not used: {field.why}."
        yield Finding("warning" if field.doubt else "info", "not-used", message)


def pixels_square(source: ScanSource) -> Iterator[Finding]:
    """Pixels are as high as wide, or each row is a slice of its own."""
    width, height = source.pixel_size_mm, source.row_pitch_mm
    if height is None:
        return
    if width is None or not 0.01 < height / width < 100:
        said = "unknown" if width is None else f"{width:g} mm"
        yield Finding(
            "error", "pixel-height", f"The pixels are {height:g} mm high; their width is {said}. That cannot be."
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
    """A part of a scan that was resumed is not all of it."""
    if source.part_starts.size > 1:
        return
    if (found := joined_file_of(source.path)) is not None and is_joined(found[0]):
        joined, n = found
        yield Finding("warning", "parts", f"This file is one of {n} parts of a scan: {joined} has the frames of all.")
    elif others := other_parts(source.path):
        said = f"This file is a part of a run, as {others[0]} is, and no file has the frames of all its parts"
        yield Finding("warning", "parts", f"{said}: `beamline recover RUN` joins them.")


SOURCE_RULES: tuple[Callable[[ScanSource], Iterator[Finding]], ...] = (
    enough_views,
    angles_known,
    angles_spread,
    quantity_said,
    references_present,
    exposures_agree,
    pixels_measured,
    series_complete,
    scale_known,
    pixels_square,
    stated_used,
    parts_joined,
)


def _sample(source: ScanSource, kind: FrameKind) -> NDArray[Any] | None:
    """A few frames of a kind, spread over the scan, at most 256 rows of the middle; None where there is none."""
    rows = np.flatnonzero(source.image_key == kind)
    if rows.size == 0:
        return None
    chosen = np.unique(np.linspace(0, rows.size - 1, SAMPLES).astype(int))
    middle = source.shape[0] // 2
    return source.read(rows[chosen], slice(max(middle - 128, 0), middle + 128)).astype(np.float64)


def _as_hdf5(path: Path) -> list[Finding]:
    if not path.is_file():
        return []
    try:
        with hdf5.open_hdf5(path) as file:
            return nexus_findings(file)
    except DataError:
        return []  # not HDF5, or without frames: open_scan says what is wrong
