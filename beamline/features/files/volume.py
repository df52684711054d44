"""Conditions for trust in a volume."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from beamline.storage.recon_record import ReconRecord
from beamline.storage.rules.finding import Finding


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
