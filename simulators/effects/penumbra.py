"""Penumbra: how the light falls off across the edge of a slit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

HARD = 1e-9
"""mm of penumbra that an edge has at least; below it the edge is a step anyway."""


def lit(inside: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Share of the light at `inside` mm within an edge (negative: behind it), for a penumbra `width` mm wide.

    The edge covers an evenly bright source bit by bit: a ramp, half of the light at the edge itself.
    """
    return np.clip(0.5 + inside / max(width, HARD), 0.0, 1.0)
