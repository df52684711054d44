"""validate: everything that the rules find in a file of a scan or a volume.

The rules of storage.rules look at a scan of any format; the ones of `nexus` at how an NXtomo is written down.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from beamline.core.errors import DataError, damaged, user_message
from beamline.core.text import count, spans
from beamline.features.files.nexus import nexus_findings
from beamline.storage import hdf5
from beamline.storage.readers.base import LookedEnoughError, ScanSource
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.recon_record import ReconRecord
from beamline.storage.rules.finding import Finding
from beamline.storage.rules.light import darks_beside_views
from beamline.storage.rules.references import VIEWS, reference_groups, references_usable
from beamline.storage.rules.scan import SOURCE_RULES, altered_sentence, scan_ended
from beamline.storage.rules.treatment import frames_flagged
from beamline.storage.rules.unlit import ViewLight
from beamline.storage.volumes.files import opened_volume, times_of, volume_format
from beamline.storage.writers.partial_volume import completion_cut_short
from drivers.base.frame import FrameKind
from recon.base.views import spread

Progress = Callable[[int, int], None]  # Is told how many of how many frames are done


def volume_findings(record: ReconRecord) -> Iterator[Finding]:
    """What the rules find in a volume; every slice of it is read."""
    data, n = record.volume.data, record.volume.grid.shape[0]
    bad, first, low, high = 0, None, np.inf, -np.inf
    for z in range(n):
        values = np.asarray(data[z : z + 1])
        finite = np.isfinite(values)
        if not finite.all():
            bad, first = bad + int((~finite).sum()), z if first is None else first
        if finite.any():
            low, high = min(low, float(values[finite].min())), max(high, float(values[finite].max()))
    if bad:
        yield Finding("error", "voxels", f"{bad} voxels are NaN or infinite (first: slice {first}).")
    if low == high:
        yield Finding("error", "voxels", f"Every voxel is {low:g}.")
    if there := record.parameters.get("partial"):
        yield Finding(
            "error", "partial", f"Partial: {there} are there, the others are empty. recon --resume makes them."
        )
    if record.ending.early:
        yield Finding("warning", "ended-early", "The reconstruction was stopped early; this is what it had reached.")
    if record.length_unit != "mm":
        yield Finding("info", "voxel-size", "No voxel size in mm: lengths are in voxels.")
    if record.parameters and not Path(record.raw_file).exists():
        yield Finding("info", "raw-file", f"The scan that it was made from, {record.raw_file}, is not there.")


def validate(scan: SourceOptions | Path | str, deep: Progress | None = None) -> list[Finding]:
    """Everything that the rules find in a file, worst first; [] for a scan without fault.

    Never raises for faults of the file: a file that cannot be opened is a finding. Volumes have rules of their own.

    Args:
        deep: every frame is read and compared with its checksum; is told how many of how many.
    """
    path = Path(scan.path if isinstance(scan, SourceOptions) else scan)
    if completion_cut_short(path):
        sentence = f"Its writer was killed when it became the output; recon --resume {path} makes that of it."
        return [Finding("error", "partial", sentence)]
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
            findings += views_lit(source, deep is not None)
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
    """What the rules of scans find in an open one, what is wrong with its references, and what is flagged."""
    findings = list[Finding]()
    for rule in (*SOURCE_RULES, scan_ended, references_usable, darks_beside_views, frames_flagged):
        try:
            findings += rule(source)
        except LookedEnoughError as error:
            findings.append(Finding("warning", "brief", str(error)))
    return [*dict.fromkeys(findings)]


def views_lit(source: ScanSource, every: bool) -> Iterator[Finding]:
    """Views have light: all of them, or some over the scan. `beamline recon` names and leaves out those without."""
    counted = source.quantity == "counts"
    views = np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    kinds = {FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION}
    if not counted or not kinds <= {*source.image_key.tolist()}:
        return
    looked_at = views if every else spread(views, VIEWS)
    light = ViewLight.of(source, reference_groups(source).good())
    unlit = [row for row in looked_at.tolist() if light.unlit(row)]
    if unlit:
        of = f"{views.size} views" if every else f"{looked_at.size} views looked at"
        more = "" if every else " `validate --deep` looks at all."
        yield Finding(
            "warning",
            "unlit",
            f"{len(unlit)} of {of} (frames {spans(unlit)}) have no light: the shutter was closed, the beam was gone, "
            f"or the file was never written there. `beamline recon` leaves such views out.{more}",
        )


def frames_as_written(source: ScanSource, progress: Progress | None) -> Iterator[Finding]:
    """Every frame can be read, and has the checksum that was written with it, where the file has checksums.

    Args:
        progress: how many of how many frames were read; None: only those that other rules have read are judged.
    """
    n, unreadable, why = int(source.image_key.size), list[int](), ""
    if source.altered:
        yield Finding("error", "records", altered_sentence(source))
    for row in range(n) if progress is not None else ():
        try:
            source.read([row])
        except DataError as error:
            unreadable.append(row)
            why = why or str(error)
        if progress is not None:
            progress(row + 1, n)
    if unreadable:
        sentence = f"{count(len(unreadable), 'frame')} cannot be read: {spans(unreadable)}. {why} Look for a good copy."
        yield Finding("error", "unreadable", sentence)
    elif progress is None and source.unreadable:
        which = f"{count(len(source.unreadable), 'frame')} cannot be read: {spans(sorted(source.unreadable))}."
        sentence = f"{which} {next(iter(source.unreadable.values()))} `beamline recon` leaves such frames out."
        yield Finding("warning", "unreadable", f"{sentence} `validate --deep` reads all frames.")
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


def _as_hdf5(path: Path) -> list[Finding]:
    if not path.is_file():
        return []
    try:
        with hdf5.open_hdf5(path) as file:
            return nexus_findings(file)
    except DataError:
        return []  # not HDF5, or without frames: open_scan says what is wrong
