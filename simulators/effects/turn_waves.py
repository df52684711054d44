"""Turn waves: errors of a stage that repeat every turn, as sums of waves over its angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Wave: TypeAlias = tuple[int, float, float]
"""Waves a turn, amplitude (its unit is the effect's) and phase in degrees; 0 waves are a constant."""


def check(what: str, waves: Sequence[Wave]) -> None:
    """Raises ValueError if an amplitude is negative or a number of waves occurs twice."""
    orders = [order for order, _, _ in waves]
    if any(amplitude < 0 for _, amplitude, _ in waves) or len(set(orders)) < len(orders):
        raise ValueError(
            f"{what} must be [waves a turn, amplitude >= 0, phase in degrees] for each number of waves once, "
            f"got {[list(wave) for wave in waves]}"
        )


def series(angle: NDArray[np.float64], waves: Sequence[Wave]) -> NDArray[np.complex128]:
    """Sum of amplitude x exp(i (waves x angle + phase)) at `angle` in radians, any shape.

    A scalar effect takes the real part. A direction in the laboratory has the real part along u and minus the imaginary
    part along b: with one wave a turn it turns with the sample, with -1 against it.
    """
    total = np.zeros(np.shape(angle), dtype=np.complex128)
    for order, amplitude, phase in waves:
        total += amplitude * np.exp(1j * (order * angle + math.radians(phase)))
    return total
