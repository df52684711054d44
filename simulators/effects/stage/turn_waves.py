"""Turn waves: errors of a stage that repeat every turn, as sums of waves over its angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator

from simulators.frame.mapping import NotNegative

Wave = tuple[int, NotNegative, float]
"""Waves a turn, amplitude (its unit is the effect's) and phase in degrees; 0 waves are a constant."""


def _once(waves: tuple[Wave, ...]) -> tuple[Wave, ...]:
    orders = [order for order, _, _ in waves]
    if len(set(orders)) < len(orders):
        raise ValueError(
            f"must be [waves a turn, amplitude, phase in degrees] for each number of waves once, got "
            f"{[list(wave) for wave in waves]}"
        )
    return waves


Waves = Annotated[tuple[Wave, ...], AfterValidator(_once)]


def series(angle: NDArray[np.float64], waves: Sequence[Wave]) -> NDArray[np.complex128]:
    """Sum of amplitude x exp(i (waves x angle + phase)) at `angle` in radians, any shape.

    A scalar effect takes the real part. A direction in the laboratory has the real part along u and minus the imaginary
    part along b: with one wave a turn it turns with the sample, with -1 against it.
    """
    total = np.zeros(np.shape(angle), dtype=np.complex128)
    for order, amplitude, phase in waves:
        total += amplitude * np.exp(1j * (order * angle + math.radians(phase)))
    return total
