"""Reading: pixels of a scan, binned while they are read, and the means of its reference frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.storage.scan_source import ScanSource
from drivers.frame import FrameKind
from recon.correct import References

_BATCH_BYTES = 64 * 2**20  # raw pixels read at a time


def read_binned(source: ScanSource, frames: NDArray[np.int64], rows: slice, binning: int) -> NDArray[Any]:
    """Frames [frame, row, col], binned by averaging while they are read; NaN stays out of the averages.

    Whole counts that are not binned keep their type (half the memory), everything else becomes float32. Trailing
    columns that do not fill a bin go.
    """
    height, width = (rows.stop - rows.start) // binning, source.shape[1] // binning
    whole = binning == 1 and source.dtype.kind in "ui"
    out = np.empty((len(frames), height, width), source.dtype.newbyteorder("=") if whole else np.float32)
    frame_bytes = (rows.stop - rows.start) * source.shape[1] * source.dtype.itemsize
    batch = max(1, _BATCH_BYTES // max(1, frame_bytes))
    for start in range(0, len(frames), batch):
        raw = source.read(frames[start : start + batch], rows)
        if binning > 1:
            raw = _mean_bins(raw[:, : height * binning, : width * binning].astype(np.float32), binning)
        out[start : start + batch] = raw
    return out


def _mean_bins(raw: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    k, rows, cols = raw.shape
    blocks = raw.reshape(k, rows // n, n, cols // n, n)
    finite = np.isfinite(blocks)
    if finite.all():
        return blocks.mean(axis=(2, 4), dtype=np.float32)
    count = finite.sum(axis=(2, 4))
    total = np.where(finite, blocks, 0).sum(axis=(2, 4), dtype=np.float32)
    return np.where(count > 0, total / np.maximum(count, 1), np.float32(np.nan)).astype(np.float32)


def read_references(source: ScanSource, rows: slice, binning: int) -> References:
    """Mean dark, and the mean of each group of flats with its place in the scan; both kinds must be there."""
    dark_frames = np.flatnonzero(source.image_key == FrameKind.DARK)
    flat_frames = np.flatnonzero(source.image_key == FrameKind.FLAT)
    # Flats with no projection between them were taken together.
    views_before = np.cumsum(source.image_key == FrameKind.PROJECTION)[flat_frames]
    groups = np.split(flat_frames, np.flatnonzero(np.diff(views_before)) + 1)
    flats = tuple((float(group.mean()), _mean(source, group, rows, binning)) for group in groups)
    return References(_mean(source, dark_frames, rows, binning), flats)


def _mean(source: ScanSource, frames: NDArray[np.int64], rows: slice, binning: int) -> NDArray[np.float32]:
    total = np.zeros(((rows.stop - rows.start) // binning, source.shape[1] // binning), np.float64)
    for frame in frames:
        total += read_binned(source, np.array([frame]), rows, binning)[0]
    return (total / frames.size).astype(np.float32)
