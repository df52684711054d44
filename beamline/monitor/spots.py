"""Spots: bright pixels of a single frame, where a stray X-ray or a muon hit the sensor (zingers).

A spot is the largest pixel of a preview block if it is far brighter than the means of all blocks around it, beyond
noise. It must also exceed that place in the previous frame, because hot pixels and bright gaps in the sample stay.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.digest import FrameDigest, block_side
from drivers.base.frame import Frame, FrameKind
from recon.base.jit import njit

NOISES = 4.0  # times the usual excess of a block's largest pixel over its mean: 8 to 10 standard deviations of a pixel
RELATIVE = 0.25  # share of the light around it: least excess of a spot; less leaves only a faint streak
SAMPLES = 4096  # blocks that give the usual excess
MOST = 4096  # most spots whose places are kept


class Spots(NamedTuple):
    """The spots of a frame: their number, and how many saturated pixels they hold."""

    n: int = 0
    saturated: int = 0


NO_SPOTS = Spots()


def spots_of(
    frame: Frame, digest: FrameDigest, before: FrameDigest | None, dark: NDArray[np.float32] | None, saturation: float
) -> Spots:
    """The spots of a view or a flat, given the frame before it and the preview of the darks."""
    if before is None or frame.kind is FrameKind.DARK or digest.preview.shape != before.preview.shape:
        return NO_SPOTS
    every = max(1, digest.preview.size // SAMPLES)
    base = 0.0 if dark is None else float(np.median(dark.ravel()[::every]))
    mean, peak = digest.preview.ravel()[::every], digest.peaks.ravel()[::every]
    usual = float(np.median((peak - mean) / np.sqrt(np.maximum(mean - base, 1))))
    if not usual > 0:  # blocks of one pixel, or frames without noise
        return NO_SPOTS
    places = np.empty((MOST, 2), np.int64)
    n = _isolated(digest.peaks, digest.preview, before.peaks, np.float32(base), np.float32(NOISES * usual), places)
    size = block_side(frame.counts.shape, digest.preview.shape)
    saturated = 0
    for row, col in places[: min(n, MOST)]:
        if digest.peaks[row, col] >= saturation:
            block = frame.counts[row * size : (row + 1) * size, col * size : (col + 1) * size]
            saturated += int((block >= saturation).sum())
    return Spots(n, saturated)


@njit(nogil=True, cache=True)
def _isolated(peaks, means, before, dark, noises, places):
    """Number of blocks with a spot; the first of them go into `places`."""
    rows, cols = peaks.shape
    n = 0
    for row in range(rows):
        for col in range(cols):
            peak = peaks[row, col]
            rise, light = peak - means[row, col], max(means[row, col] - dark, np.float32(1))
            if not rise * rise > noises * noises * light:
                continue
            around, was = np.float32(0), np.float32(0)
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(col - 1, 0), min(col + 2, cols)):
                    was = max(was, before[r, c])
                    if r != row or c != col:
                        around = max(around, means[r, c])
            light = max(around - dark, np.float32(1))
            least = max(noises * np.sqrt(light), np.float32(RELATIVE) * light)
            if peak - around > least and was - around < np.float32(0.5) * (peak - around):
                if n < places.shape[0]:
                    places[n, 0], places[n, 1] = row, col
                n += 1
    return n
