"""Stored: a volume as a file holds it, and who reads it: whoever opens a scene, for simulators open no files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Stored:
    """Attributes:
    values: [z, y, x] or in another order that the scene gives, real numbers in the file's own units.
    spacing: mm from voxel to voxel along the same axes, where the file says.
    """

    values: NDArray[np.generic]
    spacing: tuple[float, float, float] | None = None


ReadVolume = Callable[[str, str | None], Stored]
"""Reads the file that a scene names, and the dataset in it; raises what its owner raises where it cannot."""
