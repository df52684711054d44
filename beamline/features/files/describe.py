"""describe: the facts of a scan or a volume as plain values; `beamline info` prints them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from beamline.features.files.validate import source_findings
from beamline.storage.readers.base import ScanSource, rows_replaced
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.wrapped import BriefSource
from beamline.storage.recon_record import ReconRecord
from beamline.storage.rules.scan import altered_sentence
from beamline.storage.volumes.files import times_of, volume_format
from beamline.storage.writer_lock import held
from beamline.storage.writers.recon_file import opened_reconstruction
from drivers.base.frame import FrameKind

LOOK = 15.0
"""Seconds in which frames are looked at for faults."""


def describe(scan: SourceOptions | Path | str) -> Mapping[str, Any]:
    """Describe a scan or a volume. DataError if it cannot be opened."""
    path = Path(scan.path if isinstance(scan, SourceOptions) else scan)
    if (kind := volume_format(path)) is not None:
        seconds = times_of(path)
        with opened_reconstruction(path, 0) if seconds else kind.open(path) as record:
            return describe_volume(path, kind.name, record)
    with open_scan(scan) as source:
        return describe_source(source)


def describe_volume(path: Path, kind: str, record: ReconRecord) -> Mapping[str, Any]:
    """Format, voxels, where they come from, and every setting and figure of merit that is one number or a text."""
    grid, data = record.volume.grid, record.volume.data
    attributes = {k: v for k, v in record.parameters.items() if not isinstance(v, np.ndarray) or v.size == 2}
    return {
        "path": str(path),
        "format": f"volume, {kind}",
        "shape": tuple(grid.shape),
        **({} if record.series is None else {"times_s": tuple(float(f"{at:.6g}") for at in record.series.seconds)}),
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
    """Format, frames, angles, quantity, scale, and what the rules find; None for what is not known.

    Angles are in degrees. `flags` are frames by check and level, also those of views that were taken again. `used` are
    the numbers that the file states and somebody uses, by path, `not_used` those that nobody does. `findings` are the
    messages of errors and warnings, `reconstructable` whether no error stands against a reconstruction.
    """
    kinds = {kind.name.lower(): int((source.image_key == kind).sum()) for kind in FrameKind}
    until = clock() + LOOK
    findings = source_findings(BriefSource(source, lambda: clock() > until))
    attributes = dict(source.attributes)
    if not source.finished and not held(source.path):
        attributes["status"] = "died"
    facts = {
        "path": str(source.path),
        "format": source.format,
        "frames": int(source.image_key.size),
        "shape": tuple(source.shape),
        "dtype": str(source.dtype),
        "bytes": _size(source.path),
        "kinds": {name: n for name, n in kinds.items() if n},
        "quantity": source.quantity,
        **_angles(source),
        "pixel_size_mm": source.pixel_size_mm,
        **({} if source.row_pitch_mm is None else {"pixel_height_mm": source.row_pitch_mm}),
        **({} if source.cone is None else {"cone_mm": source.cone}),
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
        "used": {field.where: f"{field.value} (used: {field.use})" for field in source.used},
        "not_used": {field.where: f"{field.value} (not used: {field.why})" for field in source.not_used},
        "findings": [finding.message for finding in findings if finding.severity != "info"]
        + ([altered_sentence(source)] if source.altered else []),
    }


def _angles(source: ScanSource) -> dict[str, float | None]:
    views = np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    if (replaces := source.replaces) is not None:  # in the order in which they were planned
        views = views[np.argsort(np.where(replaces[views] >= 0, replaces[views], views))]
    angles = np.degrees(source.angles[views])
    if angles.size == 0 or not np.isfinite(angles).all():
        return {"first_angle_deg": None, "last_angle_deg": None, "step_deg": None}
    step = float(np.median(np.diff(np.unique(angles)))) if np.unique(angles).size > 1 else None
    return {"first_angle_deg": float(angles[0]), "last_angle_deg": float(angles[-1]), "step_deg": step}


def _flags(source: ScanSource) -> dict[str, Any]:
    flags = source.flags
    if flags is None:
        return {"flagged_frames": None, "alarmed_frames": None, "flags": None, "retaken_views": None}
    return {
        "flagged_frames": int(flags.flagged.sum()),
        "alarmed_frames": int(flags.alarmed.sum()),
        "flags": flags.counts(),
        "retaken_views": rows_replaced(source).size,
    }


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
