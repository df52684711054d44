"""Array types for signatures, masked and read-only arrays, standard deviations by medians, and binning of images."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

MEDIAN = 0.6745  # of |x|, for a normal variable x with standard deviation 1


def without_mask(values: Any) -> Any:
    """Masked values become NaN: for a masked array, or for masked arrays in a list or tuple.

    The numbers become floats. Values without a mask are returned unchanged.
    """
    several = values if isinstance(values, list | tuple) else (values,)
    masked = any(isinstance(each, np.ma.MaskedArray) and np.ma.getmaskarray(each).any() for each in several)
    numbers: Any = np.ma.array(values) if masked else None
    return numbers.astype(np.result_type(numbers.dtype, np.float32)).filled(np.nan) if masked else values


def frozen(values: F64) -> F64:
    """A read-only copy."""
    copy = np.array(values, np.float64)
    copy.setflags(write=False)
    return copy


def median_deviation(values: NDArray[np.floating[Any]]) -> float:
    """Standard deviation of a normal distribution, computed from the median of the absolute values; 0 if no value is
    finite."""
    finite = values[np.isfinite(values)]
    return float(np.median(np.abs(finite))) / MEDIAN if finite.size else 0.0


def some_values(values: NDArray[Any], about: int) -> NDArray[Any]:
    """A sample of roughly `about` of the values, from all positions along the last axis.

    The step between sampled values has no common factor with the length of the last axis. With a common factor, a
    sample of 183³ voxels came from only three of the 183 slices.
    """
    step = max(1, values.size // about)
    while math.gcd(step, values.shape[-1]) > 1 and values.shape[-1] < values.size:
        step += 1
    return values.reshape(-1)[::step]


def bin_views(projections: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Means of factor x factor line integrals [view, row, col]; trailing pixels that do not fill a bin are dropped.

    If line integrals differ within a bin, their mean is slightly larger than the line integral of the mean
    transmission. The correction can bin the counts instead (`--bin`).

    Raises:
        ValueError: the factor is below 1 or larger than the detector.
    """
    n, rows, cols = projections.shape
    if not 1 <= factor <= min(rows, cols):
        raise ValueError(
            f"the bin factor must be between 1 and {min(rows, cols)} for {rows} x {cols} pixels, got {factor}"
        )
    if factor == 1:
        return projections
    rows, cols = rows // factor, cols // factor
    whole = projections[:, : rows * factor, : cols * factor]
    return whole.reshape(n, rows, factor, cols, factor).mean(axis=(2, 4), dtype=np.float32)


def factor_within(shape: tuple[int, int], voxels: int) -> int:
    """Factor by which projections [row, col] must be binned so that their volume has at most `voxels` voxels."""
    rows, cols = shape
    return next((f for f in range(1, rows + 1) if (rows // f) * (cols // f) ** 2 <= voxels), rows)
