"""Statistics of a frame (`FrameDigest`) for the monitor, the operator and the file, computed in one pass.

Counts (uint16) are read once, line by line. Range, sums and histogram of a line are computed while the line is in the
processor's cache. The sums are integers, so mean and variance are exact. Pixels of other types are read twice, because
the histogram needs the range first.

A pixel is invalid if it is not finite, if it has the no-data value, or if it is above what any detector counts
(LARGEST). Invalid pixels are counted and otherwise ignored: no mean and no block of the preview includes their values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

from recon.base.jit import njit

ENTROPY_BINS = 256
ENOUGH = 128  # blocks per side that are enough for a check; a large preview is subsampled to about this number
LARGEST = 1e15  # largest absolute value of a valid pixel: float32 holds the sum of the squares over a frame
SMALL, LARGE = 4, 8  # sides in pixels of the blocks that the checks use; large blocks if at least ENOUGH of them remain
# approximate number of pixels; for larger frames of counts, every k-th row is enough for the entropy
ENTROPY_PIXELS = 2**20


@dataclass(frozen=True, eq=False)
class FrameDigest:
    """Statistics of the valid pixels of one frame. They are NaN if no pixel is valid.

    Attributes:
        minimum, maximum, mean: in the frame's own unit (counts for a raw frame).
        variance: population variance (divisor n), unit squared.
        sum_abs: sum of absolute values.
        invalid_fraction: number of invalid pixels, divided by the number of all pixels.
        saturated_fraction: number of pixels at or above the saturation value, divided by the number of all pixels; 0 if
            no saturation value was given.
        entropy: bits; Shannon (1948) entropy of the histogram of 256 equal bins from minimum to maximum
            (0 for a constant frame, at most 8). For counts in frames of more than 2**20 pixels, only every k-th row
            is used.
        checksum: CRC-32 (IEEE 802.3) of the pixels in memory order. If two frames have equal checksums, the camera
            delivered the same frame twice.
        preview: float32 [ceil(row / bin), ceil(col / bin)], mean of the valid pixels of each block (NaN if it has
            none). Blocks at the lower and right edge are smaller if bin does not divide the shape.
        peaks: float32, largest valid pixel of each of these blocks (NaN if it has none).
    """

    minimum: float
    maximum: float
    mean: float
    variance: float
    sum_abs: float
    invalid_fraction: float
    saturated_fraction: float
    entropy: float
    checksum: int
    preview: NDArray[np.float32]
    peaks: NDArray[np.float32]


def check_block(shape: tuple[int, ...]) -> int:
    """Side in pixels of the blocks that the checks use for a frame of `shape`. It does not depend on the file's
    preview."""
    return LARGE if shape[1] >= ENOUGH * LARGE else SMALL


def preview_shape(shape: tuple[int, int], preview_bin: int) -> tuple[int, int]:
    """Shape of the preview of a frame of `shape`."""
    return -(-shape[0] // preview_bin), -(-shape[1] // preview_bin)


def block_side(shape: tuple[int, ...], preview: tuple[int, ...]) -> int:
    """Side in pixels of the blocks of a preview of a frame of `shape`. The frame may be smaller than a block."""
    return max(round(n / blocks) for n, blocks in zip(shape, preview, strict=True))


def subsampled(preview: NDArray[np.float32]) -> NDArray[np.float32]:
    """Every k-th block along both axes, so that a large frame does not need more time than a small frame."""
    step_rows, step_cols = (max(1, n // ENOUGH) for n in preview.shape)
    return preview[::step_rows, ::step_cols]


def digest(
    image: NDArray[Any], saturation: float | None = None, preview_bin: int = 4, no_data: float | None = None
) -> FrameDigest:
    """Digest of one frame [row, col] of any real type.

    Args:
        saturation: the value from which a pixel counts as saturated (65535 for a full 16-bit range).
        preview_bin: pixels per side of a preview block.
        no_data: the value of pixels without data.

    Raises ValueError for an array that is not two-dimensional, empty or complex, or for a bin below 1.
    """
    if image.ndim != 2 or image.size == 0 or image.dtype.kind not in "uif":
        raise ValueError(f"A frame is a non-empty real [row, col] array, not {image.dtype} {image.shape}.")
    if preview_bin < 1:
        raise ValueError(f"The preview bin is {preview_bin}; it must be at least 1.")
    image = np.ascontiguousarray(image).view()
    # numba compiles writable and read-only arrays separately: this way one kernel is enough
    image.flags.writeable = False
    checksum = checksum_of(image)  # of the pixels as they are written
    preview = np.empty(preview_shape((image.shape[0], image.shape[1]), preview_bin), np.float32)
    peaks = np.empty_like(preview)
    if image.dtype == np.uint16 and no_data is None:
        numbers = _of_greys(image, saturation, preview_bin, preview, peaks)
    else:
        if image.dtype not in (np.float32, np.float64):
            image = image.astype(np.float64)
            image.flags.writeable = False
        numbers = _from_reals(image, saturation, preview_bin, no_data, preview, peaks)
    return FrameDigest(*numbers, checksum, preview, peaks)


def digests(image: NDArray[np.uint16], saturation: float | None, preview_bin: int) -> tuple[FrameDigest, FrameDigest]:
    """Two digests of a frame: one for the checks, with blocks of `check_block`, and one for the file, with blocks of
    `preview_bin`. Each is bit-identical to the result of `digest`.

    Therefore the findings of the checks depend only on the frames. If the checks run again later on the file, they
    give the same findings. If the two block sizes differ, the pixels are read twice.
    """
    seen = digest(image, saturation, check_block(image.shape))
    return seen, seen if preview_bin == check_block(image.shape) else digest(image, saturation, preview_bin)


def block_means(image: NDArray[Any], side: int) -> NDArray[np.float32]:
    """The preview of a digest, computed without the compiled kernel. It is meant for a few frames, for which loading
    numba would take longer.

    For counts it is bit-identical to the preview of the kernel. For floats it is not, because they are summed in
    another order.
    """
    rows, cols = (np.arange(0, n, side) for n in image.shape)

    def sums(pixels: NDArray[Any], kind: type) -> NDArray[Any]:
        return np.asarray(np.add.reduceat(np.add.reduceat(pixels, cols, axis=1, dtype=kind), rows, axis=0))

    if image.dtype == np.uint16:
        counts = (np.diff(np.append(at, n)) for at, n in zip((rows, cols), image.shape, strict=True))
        return (sums(image, np.uint64) / np.multiply.outer(*counts)).astype(np.float32)
    valid = is_valid(image)
    with np.errstate(invalid="ignore"):  # no valid pixel: NaN
        return (sums(np.where(valid, image, 0), np.float64) / sums(valid, np.int64)).astype(np.float32)


def is_valid(image: NDArray[Any]) -> NDArray[np.bool_]:
    """Pixels that are finite and not beyond LARGEST."""
    return np.asarray(np.abs(image) <= np.float64(LARGEST))  # float16 cannot represent such a number


def checksum_of(image: NDArray[Any]) -> int:
    """CRC-32 of the pixels in memory order."""
    return zlib_ng.crc32(np.ascontiguousarray(image).data.cast("B"))


def has_checksum(image: NDArray[Any], stored: int) -> bool:
    """Whether the pixels have this checksum."""
    return stored == checksum_of(image)


Numbers = tuple[float, float, float, float, float, float, float, float]


def _of_greys(
    image: NDArray[np.uint16],
    saturation: float | None,
    preview_bin: int,
    preview: NDArray[np.float32],
    peaks: NDArray[np.float32],
) -> Numbers:
    full = 65536 if saturation is None else math.ceil(min(max(saturation, 0), 65536))
    every = max(1, image.size // ENTROPY_PIXELS)
    least, high, total, squares, saturated, histograms = _count_greys(image, full, every, preview_bin, preview, peaks)
    low, histogram = int(least.min()), histograms.sum(0, np.int64)
    # integers of any length, so that no square overflows
    size, total, squares = image.size, int(total), int(squares)
    greys = np.flatnonzero(histogram)
    bins = np.minimum((greys - low) * ENTROPY_BINS // max(high - low, 1), ENTROPY_BINS - 1)
    folded = np.bincount(bins, weights=histogram[greys], minlength=ENTROPY_BINS)
    variance = (size * squares - total**2) / size**2
    return float(low), float(high), total / size, variance, float(total), 0.0, saturated / size, _entropy(folded)


def _from_reals(
    image: NDArray[Any],
    saturation: float | None,
    preview_bin: int,
    no_data: float | None,
    preview: NDArray[np.float32],
    peaks: NDArray[np.float32],
) -> Numbers:
    marker = np.nan if no_data is None else float(image.dtype.type(no_data))  # floats: numba compiles for each type
    threshold = np.inf if saturation is None else float(saturation)
    n, low, high, mean, squares, sum_abs, saturated = _sum_reals(image, threshold, preview_bin, marker, preview, peaks)
    invalid = (image.size - n) / image.size
    if n == 0:
        return np.nan, np.nan, np.nan, np.nan, np.nan, invalid, 0.0, np.nan
    entropy = _entropy(_count_reals(image, low, high, marker)) if high > low else 0.0
    return low, high, mean, squares / n, sum_abs, invalid, saturated / image.size, entropy


def _entropy(histogram: NDArray[Any]) -> float:
    p = histogram[histogram > 0] / histogram.sum()
    return max(0.0, float(-(p * np.log2(p)).sum()))


@njit(nogil=True, cache=True)
def _folded(sums, tops, side):
    """Sums and largest values of `side` neighbours each, from those of `side` rows. As long as `side` is even and the
    sums fit into 32 bits, neighbours are added in pairs, because the compiler turns this into vector instructions."""
    width = 1
    while side % (2 * width) == 0 and 2 * width * side <= 65536:
        n = sums.size // 2
        pairs, highest = np.empty(n, np.uint32), np.empty(n, np.uint16)
        for i in range(n):
            pairs[i] = sums[2 * i] + sums[2 * i + 1]
        for i in range(n):
            highest[i] = max(tops[2 * i], tops[2 * i + 1])
        sums, tops, width = pairs, highest, 2 * width
    each = side // width
    parts, most = np.zeros(sums.size // each, np.uint64), np.zeros(sums.size // each, np.uint16)
    for block in range(parts.size):
        for i in range(block * each, (block + 1) * each):
            parts[block] += np.uint64(sums[i])
            most[block] = max(most[block], tops[i])
    return parts, most


@njit(nogil=True, cache=True, error_model="numpy")
def _count_greys(image, full, every, preview_bin, preview, peaks):
    """Returns (minima of columns, maximum, sum, sum of squares, number of pixels at or above `full`, two histograms of
    every k-th row).

    Fills preview and peaks. Each short loop handles one line, so that the compiler turns all of them except the
    histogram's into vector instructions. A check for a division by zero would prevent this.
    """
    rows, cols = image.shape
    # Two histograms are used in turn, because neighbouring pixels are often equal, and an increment must not wait for
    # the previous one.
    histogram = np.zeros((2, 65536), np.uint32)
    across = preview.shape[1]
    sums, tops = np.zeros(across * preview_bin, np.uint32), np.zeros(across * preview_bin, np.uint16)  # whole blocks
    least = np.full(cols, 65535, np.uint16)
    high = np.uint16(0)
    total, squares, saturated = np.uint64(0), np.uint64(0), np.int64(0)
    for block in range(preview.shape[0]):
        first, last = block * preview_bin, min((block + 1) * preview_bin, rows)
        sums[:], tops[:] = 0, 0
        for row in range(first, last):
            line = image[row]
            for col in range(cols):
                tops[col], least[col] = max(tops[col], line[col]), min(least[col], line[col])
            for col in range(cols):
                sums[col] += np.uint32(line[col])
            for col in range(cols):
                value = np.uint32(line[col])
                squares += np.uint64(np.uint32(value * value))
            if row % every == 0:
                for col in range(0, cols - 1, 2):
                    histogram[0, line[col]] += np.uint32(1)
                    histogram[1, line[col + 1]] += np.uint32(1)
                if cols & 1:
                    histogram[0, line[cols - 1]] += np.uint32(1)
        parts, most = _folded(sums, tops, preview_bin)
        for part in parts:
            total += part
        pixels, at_edge = preview_bin * (last - first), (cols - (across - 1) * preview_bin) * (last - first)
        for at in range(across):
            preview[block, at] = np.float64(parts[at]) / np.float64(pixels)
        preview[block, across - 1] = np.float64(parts[across - 1]) / np.float64(at_edge)
        top = np.uint16(0)
        # loops, because numba needs seconds to compile its own max, sum along an axis and assignment of rows
        for at in range(across):
            peaks[block, at], top = most[at], max(top, most[at])
        high = max(high, top)
        if top >= full:
            for row in range(first, last):
                for col in range(cols):
                    saturated += image[row, col] >= full
    return least, int(high), total, squares, saturated, histogram


@njit(nogil=True, cache=True)
def _sum_reals(image, saturation, preview_bin, no_data, preview, peaks):
    """Range and moments of the valid pixels, block by block (Chan, Golub & LeVeque 1983), and preview and peaks."""
    rows, cols = image.shape
    n, saturated = 0, 0
    low, high, mean, squares, sum_abs = np.inf, -np.inf, 0.0, 0.0, 0.0
    for block in range(preview.shape[0]):
        first, last = block * preview_bin, min((block + 1) * preview_bin, rows)
        for block_col in range(preview.shape[1]):
            left, right = block_col * preview_bin, min((block_col + 1) * preview_bin, cols)
            n_block, sum_block, most = 0, 0.0, -np.inf
            for row in range(first, last):
                for col in range(left, right):
                    value = image[row, col]
                    if abs(value) <= LARGEST and value != no_data:
                        n_block += 1
                        sum_block += value
                        sum_abs += abs(value)
                        low = min(low, value)
                        most = max(most, value)
                        if value >= saturation:
                            saturated += 1
            if n_block == 0:
                preview[block, block_col] = peaks[block, block_col] = np.nan
                continue
            high, peaks[block, block_col] = max(high, most), most
            mean_block = sum_block / n_block
            preview[block, block_col] = mean_block
            for row in range(first, last):
                for col in range(left, right):
                    value = image[row, col]
                    if abs(value) <= LARGEST and value != no_data:
                        squares += (value - mean_block) ** 2
            step = mean_block - mean
            squares += step * step * n * n_block / (n + n_block)
            mean += step * n_block / (n + n_block)
            n += n_block
    return n, low, high, mean, squares, sum_abs, saturated


@njit(nogil=True, cache=True)
def _count_reals(image, low, high, no_data):
    """Histogram of the valid pixels in ENTROPY_BINS equal bins over [low, high]."""
    histogram = np.zeros(ENTROPY_BINS, np.int64)
    scale = ENTROPY_BINS / (high - low)
    for row in range(image.shape[0]):
        for col in range(image.shape[1]):
            value = image[row, col]
            if abs(value) <= LARGEST and value != no_data:
                histogram[min(int((value - low) * scale), ENTROPY_BINS - 1)] += 1
    return histogram
