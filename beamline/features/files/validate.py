"""validate lists all findings about the file of a scan or a volume; describe returns facts about the file as plain
values.

The rules of storage.rules check a scan of any format. The rules at the end of this module use the frame counter of the
camera and the times to find frames that are lost, repeated or out of order.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from beamline.core.errors import DataError, damaged, user_message
from beamline.core.quantities import cone_facts
from beamline.core.text import count, frames_text, spans
from beamline.storage import hdf5
from beamline.storage.readers.base import ScanSource, TakesTooLongError, read_known
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.transforms import WRAPPED, brief_source
from beamline.storage.recon_record import ReconRecord
from beamline.storage.rules import Finding
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.illumination import VIEWS
from beamline.storage.rules.pixels import CONSTANT_DARKS
from beamline.storage.rules.scan import altered_sentence, findings_of
from beamline.storage.rules.stored_order import SINOGRAM
from beamline.storage.volumes.files import opened_volume, times_of, volume_format
from beamline.storage.writer_lock import abandoned, held
from beamline.storage.writers.recon_file import opened_reconstruction
from beamline.storage.writers.rows import RUNNING
from drivers.base.frame import FrameKind
from recon.base.arrays import F32, I64
from recon.base.views import spread
from recon.prep.overshoot import MOST_VIEWS, SEARCH, Overshoot

Progress = Callable[[int, int], None]  # Function that gets the number of frames done, and of all frames


def volume_findings(record: ReconRecord) -> Iterator[Finding]:
    """Findings about a volume. Every slice is read."""
    data, n = record.volume.data, record.volume.grid.shape[0]
    bad, first, low, high = 0, None, np.inf, -np.inf
    for z in range(n):
        values = np.asarray(data[z : z + 1])
        finite = np.isfinite(values)
        if not finite.all():
            bad, first = bad + int((~finite).sum()), z if first is None else first
        if finite.any():
            low, high = min(low, float(values[finite].min())), max(high, float(values[finite].max()))
    raw, stored_part = record.raw_file, record.parameters.get("partial")
    partial = (
        f"The volume is partial: {stored_part} are reconstructed, the other slices are empty. `beamline recon "
        "--resume` reconstructs the empty slices."
    )
    early = "The reconstruction was stopped early; the file contains the volume reached by then."
    rules = (
        (bad > 0, Finding("error", "voxels", f"{bad} voxels are NaN or infinite (first: slice {first}).")),
        (low == high, Finding("error", "voxels", f"Every voxel is {low:g}.")),
        (bool(stored_part), Finding("error", "partial", partial)),
        (record.ending.early, Finding("warning", "ended-early", early)),
        (
            record.length_unit != "mm",
            Finding("info", "voxel-size", "The voxel size in mm is not known: lengths are in voxels."),
        ),
        (
            bool(record.parameters) and not Path(raw).exists(),
            Finding(
                "info",
                "raw-file",
                f"The scan file from which the volume was reconstructed, {raw}, no longer exists at this path.",
            ),
        ),
    )
    yield from (finding for broken, finding in rules if broken)


def validate(scan: SourceOptions | Path | str, deep: Progress | None = None) -> list[Finding]:
    """All findings in a file, the most severe first; [] for a valid scan.

    Faults of the file never raise an error: a file that cannot be opened is a finding. Volumes have separate rules.

    Args:
        deep: function that gets the number of frames read and their total number; if it is given, every frame is read
            and compared with its checksum.
    """
    path = Path(scan.path if isinstance(scan, SourceOptions) else scan)
    findings, stated = list[Finding](), isinstance(scan, SourceOptions) and scan.stated
    try:
        if not stated and volume_format(path) is not None:
            of_all: dict[Finding, None] = {}
            for time_index in range(len(times_of(path))) or (None,):
                with opened_volume(path, at=time_index) as record, hdf5.readable(path):
                    of_all |= dict.fromkeys(volume_findings(record))
            return [*of_all]
        with open_scan(scan) as source:
            evidence = ScanEvidence(source)
            findings += [*time_order(source), *framestamp_order(source), *source_findings(evidence)]
            findings += views_lit(evidence, deep is not None)
            findings += frames_as_written(source, deep)
    except DataError as error:
        findings.append(Finding("error", "readable", str(error)))
    except (OSError, RuntimeError, KeyError) as error:
        if not damaged(error):
            raise
        findings.append(Finding("error", "readable", user_message(error)))
    order = ("error", "warning", "info")
    return sorted(findings, key=lambda finding: order.index(finding.severity))


def source_findings(scan: ScanEvidence) -> list[Finding]:
    """Findings in an open scan: its content, its references, and its flagged frames. If pixels overflowed, findings on
    the intensity and on darks and flats are left out, because the overflow explains them."""
    findings = findings_of(scan)
    if any(finding.rule == WRAPPED and finding.severity == "error" for finding in findings):
        findings = [finding for finding in findings if finding.rule not in ("light", "bad-references")]
    return [*dict.fromkeys(findings)]


def views_lit(scan: ScanEvidence, every: bool) -> Iterator[Finding]:
    """The projections are exposed throughout the scan. `beamline recon` lists dark projections and leaves them out."""
    views = scan.table.views
    looked_at = views if every else spread(views, VIEWS)
    can_tell = scan.dark_and_flat is not None
    unlit = [row for row in looked_at.tolist() if can_tell and scan.illumination.without_beam(row)]
    if unlit:
        checked = f"{views.size} projections" if every else f"{looked_at.size} projections checked"
        more = "" if every else " `validate --deep` checks all projections."
        yield Finding(
            "warning",
            "unlit",
            f"{len(unlit)} of {checked} ({frames_text(unlit)}) had no beam: the shutter was closed, the beam was "
            f"lost, or these frames were never written. `beamline recon` does not use projections without beam.{more}",
        )


def frames_as_written(source: ScanSource, progress: Progress | None) -> Iterator[Finding]:
    """Every frame can be read and matches its checksum, if the file has checksums.

    Args:
        progress: function that gets the number of frames read and their total number; None: only frames that other
            rules have read are checked.
    """
    n, unreadable, reason = len(source.table), list[int](), ""
    if source.table.altered.any():
        yield Finding("error", "records", altered_sentence(source))
    for row in range(n) if progress is not None else ():
        try:
            source.read([row])
        except DataError as error:
            unreadable.append(row)
            reason = reason or str(error)
        if progress is not None:
            progress(row + 1, n)
    if unreadable:
        sentence = (
            f"{count(len(unreadable), 'frame')} cannot be read: {spans(unreadable)}. {reason} Use an intact copy "
            "of the file."
        )
        yield Finding("error", "unreadable", sentence)
    elif progress is None and source.unreadable:
        which = f"{count(len(source.unreadable), 'frame')} cannot be read: {spans(sorted(source.unreadable))}."
        first_reason = next(iter(source.unreadable.values()))
        sentence = f"{which} {first_reason} `beamline recon` does not use frames that cannot be read."
        yield Finding("warning", "unreadable", f"{sentence} `validate --deep` reads all frames.")
    if source.damaged:
        damaged_frames = spans(sorted(source.damaged))
        yield Finding(
            "error",
            "checksums",
            f"{len(source.damaged)} of {n} frames are damaged, because they differ from their stored checksums: "
            f"{damaged_frames}. Look for an intact copy of the file; `beamline recon` leaves these frames out."
            + ("" if progress else " `validate --deep` compares all frames."),
        )
    elif progress and not source.checksummed:
        yield Finding(
            "info", "checksums", "The frames can be read, but not checked, because the file has no checksums."
        )


LOOK = 15.0
"""Time limit in seconds for the search for faults in frames."""


def describe(scan: SourceOptions | Path | str) -> Mapping[str, Any]:
    """Describe a scan or a volume. Raises DataError if it cannot be opened."""
    path = Path(scan.path if isinstance(scan, SourceOptions) else scan)
    if not (isinstance(scan, SourceOptions) and scan.stated) and (kind := volume_format(path)) is not None:
        seconds = times_of(path)
        with opened_reconstruction(path, 0) if seconds else kind.open(path) as record:
            return describe_volume(path, kind.name, record)
    with open_scan(scan) as source:
        return describe_source(source)


def describe_volume(path: Path, kind: str, record: ReconRecord) -> Mapping[str, Any]:
    """Format, voxels, origin of the volume, and every setting and figure of merit that is a single number or a text."""
    grid, data = record.volume.grid, record.volume.data
    attributes = {k: v for k, v in record.parameters.items() if not isinstance(v, np.ndarray) or v.size == 2}
    return {
        "path": str(path),
        "format": f"volume, {kind}",
        "shape": tuple(grid.shape),
        **(
            {}
            if record.series is None
            else {"times_s": tuple(float(f"{seconds:.6g}") for seconds in record.series.seconds)}
        ),
        "dtype": str(data.dtype),
        "bytes": _size(path),
        "voxel_zyx": tuple(float(f"{edge:.6g}") for edge in grid.spacing),
        "length_unit": record.length_unit,
        "title": record.title,
        "sample": record.sample,
        "raw_file": record.raw_file,
        "date": datetime.fromtimestamp(record.time, UTC).isoformat(timespec="seconds"),
        "attributes": {**attributes, **record.metrics},
        "findings": [],
    }


def describe_source(source: ScanSource, clock: Callable[[], float] = time.monotonic) -> Mapping[str, Any]:
    """Format, frames, angles, quantity, scale, and the findings of the rules; None for what is unknown.

    Angles are in degrees. `flags` has the number of frames by check and level, also of projections that were taken
    again. `not_used` has, by path, the numbers that the file states but this program does not use. `findings` are the
    messages of errors and warnings, `reconstructable` is True if no error prevents a reconstruction.
    """
    kinds = {kind.name.lower(): source.table.of_kind(kind).size for kind in FrameKind}
    until = clock() + LOOK
    brief = brief_source(source, lambda: clock() > until)
    findings = source_findings(ScanEvidence(brief))
    attributes = dict(source.attributes)
    if not source.finished:
        # the writer of this program holds a lock
        dead = not held(source.path) if "status" in attributes else abandoned(source.path)
        attributes["status"] = "died" if dead else RUNNING
    optional: dict[str, Any] = {"pixel_height_mm": source.row_pitch_mm, "cone_mm": source.cone}
    if source.cone is not None and source.pixel_size_mm is not None:
        optional |= cone_facts(source.cone, source.pixel_size_mm, source.shape[1])
    facts = {
        "path": str(source.path),
        "format": source.format,
        "frames": len(source.table),
        "shape": tuple(source.shape),
        "dtype": str(source.dtype),
        "bytes": _size(source.path),
        "kinds": {name: n for name, n in kinds.items() if n},
        "quantity": source.quantity,
        **_angles(source),
        "pixel_size_mm": source.pixel_size_mm,
        **{name: value for name, value in optional.items() if value is not None},
        "energy_kev": source.energy_kev,
        "axis_col": source.axis_col,
        "exposure_s": attributes.pop("exposure_s", None),
        "finished": source.finished,
        "missing_triggers": attributes.pop("missing_triggers", None),
        **_flags(source),
        "reconstructable": all(finding.severity != "error" for finding in findings),
    }
    return {
        **facts,
        "attributes": {f"{name} (of the file)" if name in facts else name: v for name, v in attributes.items()},
        "not_used": {field.where: f"{field.value} (not used: {field.why})" for field in source.not_used},
        "findings": [
            *(each.message for each in findings if each.severity != "info" or each.rule in (CONSTANT_DARKS, SINOGRAM)),
            *([altered_sentence(source)] if source.table.altered.any() else []),
            *(_fringes(brief) if facts["reconstructable"] else []),
        ],
    }


def _fringes(source: ScanSource) -> list[str]:
    """A sentence on phase fringes, if outer edges of the sample show them in the middle rows of some projections."""
    rows = slice(*np.clip(source.shape[0] // 2 + np.array([-16, 16]), 0, source.shape[0]).tolist())

    def read(kind: FrameKind) -> F32:
        return read_known(source, spread(source.table.of_kind(kind), MOST_VIEWS), rows).astype(np.float32)

    with suppress(DataError, TakesTooLongError):
        views = read(FrameKind.PROJECTION)
        if source.quantity == "line_integrals":
            overshoot = Overshoot.of(views)
        elif source.quantity == "counts":
            overshoot = Overshoot.of_counts(
                views, *(read(kind).mean(axis=0) for kind in (FrameKind.DARK, FrameKind.FLAT))
            )
        else:
            overshoot = Overshoot.of_counts(views, 0.0, 1.0)
        return [f"{overshoot.in_words()} {SEARCH}"] if overshoot.certain else []
    return []


def _angles(source: ScanSource) -> dict[str, float | None]:
    views = source.table.views
    if (replaces := source.table.replaces) is not None:  # the frames in the order in which they were planned
        views = views[np.argsort(np.where(replaces[views] >= 0, replaces[views], views))]
    angles = np.degrees(source.table.angles[views])
    if angles.size == 0 or not np.isfinite(angles).all():
        return {"first_angle_deg": None, "last_angle_deg": None, "step_deg": None}
    step = float(np.median(np.diff(np.unique(angles)))) if np.unique(angles).size > 1 else None
    return {"first_angle_deg": float(angles[0]), "last_angle_deg": float(angles[-1]), "step_deg": step}


def _flags(source: ScanSource) -> dict[str, Any]:
    flags = source.table.flags
    if flags is None:
        return {"flagged_frames": None, "alarmed_frames": None, "flags": None, "retaken_views": None}
    return {
        "flagged_frames": int(flags.flagged.sum()),
        "alarmed_frames": int(flags.alarmed.sum()),
        "flags": flags.counts(),
        "retaken_views": source.table.replaced.size,
    }


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def time_order(source: ScanSource) -> Iterator[Finding]:
    """Frames are in the order of their times."""
    if source.table.times is not None and (back := np.flatnonzero(np.diff(source.table.times) < 0)).size:
        step = np.diff(source.table.times)[back[0]]
        first_frame = back[0] + 1
        seconds_back = -step
        yield Finding(
            "error",
            "time-order",
            f"{back.size} frames have an earlier time than the frame before them (first: frame {first_frame}, by "
            f"{seconds_back:.6g} s).",
        )


def framestamp_order(source: ScanSource) -> Iterator[Finding]:
    """The camera's frame counter increases by one for each frame.

    The counter starts again when the camera is armed again: for another kind of frames, for other triggers of the same
    kind, or in another part of a joined file. It does not always start at 0, because the first frame may be lost.
    """
    table = source.table
    stamps, triggers, key = table.framestamps, table.triggers, table.kinds
    if stamps.size < 2 or (stamps < 0).any():
        return
    steps, rows = np.diff(stamps), np.arange(key.size)
    passes = np.searchsorted(table.pass_ends, rows, "right")  # a framestamp may be repeated
    # for laterally offset projections the counter continues, as for projections taken again
    aside = np.zeros(key.size) if table.aside is None else table.aside
    new = np.zeros(key.size, np.bool_)
    new[np.unique(np.stack([key, triggers, passes, aside]), axis=1, return_index=True)[1]] = True
    new[table.part_starts] = True
    armed = (np.diff(passes) > 0) | (new[1:] & ((steps < 0) | (stamps[1:] == 0)))
    same_block = (np.diff(key) == 0) & ~armed
    repeated = np.flatnonzero(same_block & (steps <= 0))
    if repeated.size:
        first = repeated[0]
        frame_number = first + 1
        its_stamp = stamps[first + 1]
        stamp_before = stamps[first]
        yield Finding(
            "error",
            "framestamps",
            f"{repeated.size} frames have a framestamp that repeats or goes back (first: frame {frame_number}, "
            f"framestamp {its_stamp} after {stamp_before}).",
        )
    skipped = [i for i in np.flatnonzero(same_block & (steps > 1)).tolist() if not _taken_again(source, i, steps[i])]
    if skipped:
        n_missing = sum(steps[skipped] - 1)
        next_frame = skipped[0] + 1
        yield Finding(
            "warning",
            "framestamps",
            f"The camera recorded {n_missing} frames that are not in the file (first gap before frame {next_frame}).",
        )


def _taken_again(source: ScanSource, row: int, step: I64) -> bool:
    """Whether all triggers between a frame and the next frame have their frames elsewhere in the file."""
    triggers, key = source.table.triggers, source.table.kinds
    between = np.arange(triggers[row] + 1, triggers[row + 1])
    return between.size == step - 1 and bool(np.isin(between, triggers[key == key[row]]).all())
