"""Types of arrays that signatures share, and the spread of values by their median."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

MEDIAN = 0.6745  # of |x|, for a normal variable x with standard deviation 1


def median_deviation(values: NDArray[np.floating[Any]]) -> float:
    """Standard deviation of the normal distribution with this median of absolute values; 0 if none is finite."""
    finite = values[np.isfinite(values)]
    return float(np.median(np.abs(finite))) / MEDIAN if finite.size else 0.0
