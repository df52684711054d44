"""Reading: pixels of a scan, binned while they are read, and the means of its reference frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.projections.selection import Selection
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.references import ReferenceGroups
from drivers.frame import FrameKind
from recon.base.choices import FEW_PHOTONS
from recon.prep.correct import References
from recon.prep.counts import Photons, photon_transfer

_BATCH_BYTES = 64 * 2**20  # raw pixels read at a time

_PHOTONS = 1e-3, 1e12  # in a pixel of the open beam, far beyond any detector's on either side

_TRANSFER_FRAMES, _TRANSFER_ROWS = 16, 64  # more do not sharpen the gain, they only cost reading


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


def read_references(
    source: ScanSource, groups: ReferenceGroups, rows: slice, binning: int, use_damaged: bool = False
) -> References:
    """Mean dark, and the mean of each group of flats with its place in the scan; both kinds must be there.

    Frames that are damaged (see ScanSource) are left out, unless `use_damaged`. The light of flats with an exposure of
    their own is scaled to the projections': dark + (flat - dark) * t / t_flat, where both are known. The dark is one
    for all: the file's rules tell where it was exposed otherwise.

    Raises:
        DataError: all frames of a kind are damaged.
    """
    dark = _mean(source, np.concatenate(groups.darks), rows, binning, None, use_damaged)
    scale = light_scale(source.image_key, source.exposures)
    flats = []
    for group in groups.flats:
        mean = _mean(source, group, rows, binning, scale[group], use_damaged)
        if dark is not None and mean is not None:
            used = group if use_damaged else np.setdiff1d(group, list(source.damaged))
            flats.append((float(used.mean()), (mean + (1 - scale[used].mean()) * dark).astype(np.float32)))
    if dark is None or not flats:
        raise DataError(
            f"{source.path}: all {'darks' if dark is None else 'flats'} are damaged: their pixels are not those that "
            "were written, by their checksums. Use a good copy, or --flags ignore, which takes them as they are."
        )
    return References(dark.astype(np.float32), tuple(flats))


def light_scale(image_key: NDArray[np.int32], exposures: NDArray[np.float64]) -> NDArray[np.float64]:
    """By how much the light of each frame grows from its own exposure to the projections'; 1 where one is unknown.

    Args:
        exposures: [frame] s, NaN where unknown. Of projections that differ the median counts.
    """
    views = exposures[image_key == FrameKind.PROJECTION]
    views = views[np.isfinite(views)]
    if views.size == 0:
        return np.ones(exposures.size)
    return np.where(np.isfinite(exposures), np.median(views) / exposures, 1.0)


def _mean(
    source: ScanSource,
    frames: NDArray[np.int64],
    rows: slice,
    binning: int,
    weights: NDArray[np.float64] | None,
    use_damaged: bool,
) -> NDArray[np.float64] | None:
    """Mean of the frames that may be used, each times its weight; float64 [row, col], binned; None where none may."""
    total, n = np.zeros(((rows.stop - rows.start) // binning, source.shape[1] // binning), np.float64), 0
    for i, frame in enumerate(frames):
        image = read_binned(source, np.array([frame]), rows, binning)[0]
        if use_damaged or int(frame) not in source.damaged:
            total += image if weights is None else weights[i] * image
            n += 1
    return total / n if n else None


def photons_of(
    source: ScanSource, used: ReferenceGroups, references: References, rows: slice, selection: Selection
) -> Photons | None:
    """How the pixels of a scan count photons, as they are read (binned); None: their logarithms are to be taken.

    The gain is that of the selection, or the photon transfer of the largest group of flats, the readout noise that of
    the largest group of darks.

    Raises:
        ConfigError: counts are asked for, and the flats do not tell the gain; or the gain given makes the photons of
            the open beam too many or too few for any detector.
    """
    if selection.noise == "log":
        return None
    binning = selection.binning
    first = rows.start + max(0, (rows.stop - rows.start - _TRANSFER_ROWS * binning) // 2 // binning * binning)
    middle = slice(first, min(first + _TRANSFER_ROWS * binning, rows.stop))
    spoilt = [] if not selection.use_flags else sorted(source.damaged)
    flats, darks = (
        read_binned(source, np.setdiff1d(max(groups, key=len), spoilt)[:_TRANSFER_FRAMES], middle, binning)
        for groups in (used.flats, used.darks)
    )
    if selection.gain is not None:  # a mean of n pixels has n times as many photons a count
        light = _open_beam_counts(references) * binning**2 / selection.gain
        low, high = _PHOTONS
        if not low <= light <= high:
            raise ConfigError(
                f"--gain {selection.gain:g} makes {light:.3g} photons a pixel of the open beam of {source.path}; "
                f"expected {low:g} to {high:g}. Give counts a photon, or leave --gain out."
            )
        variance = float(np.median(darks.var(axis=0, ddof=1))) if len(darks) > 1 else 0.0
        found = Photons(selection.gain / binning**2, variance)
    else:
        try:
            found = Photons(*photon_transfer(flats, darks if len(darks) > 1 else None))
        except ValueError as error:
            if selection.noise == "auto":
                return None
            raise ConfigError(
                f"--noise counts: {source.path} does not tell the counts of a photon: {error}. Say --gain COUNTS."
            ) from error
    if selection.noise == "auto" and not open_beam(references, found) < FEW_PHOTONS:
        return None
    return found


def open_beam(references: References, photons: Photons) -> float:
    """Photons in a pixel of the open beam, the median of the flats."""
    return _open_beam_counts(references) / photons.gain


def _open_beam_counts(references: References) -> float:
    return float(np.median(references.flats[0][1] - references.dark))
