"""Kinds of reconstruction methods: direct, iterative, and series of volumes. `recon.splatting.fit_method` has fits.

A method derives from one of these classes, which defines the properties that callers need (see
`recon.base.method.Method`).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.method import Method


class Direct(Method):
    """A method that makes one pass over the projections, such as filtered back-projection. It extrapolates truncated
    projections."""

    fitted: ClassVar[bool] = False
    weighs: ClassVar[bool] = False
    knows_outside: ClassVar[bool] = False
    makes_boxes: ClassVar[bool] = True

    def views_wanted(self, geometry: Geometry) -> NDArray[np.bool_]:
        """All projections except laterally offset ones, see `Geometry.is_centred`."""
        return geometry.is_centred


class Iterative(Method):
    """A method that improves the agreement of the volume with the projections by iterations. It can be stopped after
    each iteration."""


class Series(Method):
    """A method that reconstructs several volumes at different times of the scan, together from all projections, all in
    memory.

    Attributes:
        volumes: number of volumes; `Reconstruction.series` contains all of them.
    """

    takes: ClassVar[frozenset[str]] = frozenset({"times"})
    knows_outside: ClassVar[bool] = False
