"""Units: warns of values that look like another quantity: degrees for radians, counts for line integrals."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

_TURNS = 10  # fewer are no reason for doubt, unless all angles are whole numbers
_FEWEST = 5  # with fewer views there is no warning
_OPAQUE = 15.0  # exp(-15) of the light, which no detector measures in nine of ten pixels
_LOOKED_AT = 2**16  # values


def look_like_degrees(angles: NDArray[np.floating]) -> bool:
    """Whether angles [view] given as radians look like degrees.

    They do if all are whole numbers, or if they span 180 or 360. They also do if they span more than ten turns and are
    round to two digits.
    """
    distinct = np.unique(angles)
    if distinct.size < _FEWEST or not np.isfinite(distinct).all():
        return False
    span = float(distinct[-1] - distinct[0])
    if span >= _FEWEST - 1 and np.array_equal(distinct, np.round(distinct)):
        return True
    if span <= 2 * np.pi * _TURNS:
        return False
    round_numbers = np.allclose(distinct * 100, np.round(distinct * 100), rtol=0, atol=1e-3)
    whole = span + span / (distinct.size - 1)
    turns = any(abs(s / turn - 1) < 1e-3 for s in (span, whole) for turn in (180, 360))
    return bool(round_numbers or turns)


def warn_of_degrees(angles: NDArray[np.floating]) -> None:
    """A UserWarning if angles look like degrees; it names the line that called the asking function."""
    if look_like_degrees(angles):
        warnings.warn(
            f"angles reach {np.abs(angles).max():.5g} rad and look like degrees. They are radians here: give "
            "np.deg2rad(angles)",
            stacklevel=3,
        )


def look_like_counts(projections: NDArray[np.floating]) -> bool:
    """Whether values [view, row, col] given as line integrals look like counts, by a sample of them.

    They do if nine in ten are too large for any detector to measure the remaining light. If all are whole numbers, half
    of them suffice.
    """
    flat = projections.reshape(-1)
    some = flat[:: max(1, flat.size // _LOOKED_AT)]
    some = some[np.isfinite(some)]
    if some.size == 0 or not np.median(some) > _OPAQUE:
        return False
    return bool(np.quantile(some, 0.1) > _OPAQUE or np.array_equal(some, np.round(some)))
