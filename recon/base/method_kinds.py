"""Kinds of reconstruction methods: direct, iterative, and series of volumes; `recon.splatting.fit_method` has fits.

A method derives from one of them, which answers what its callers ask (`recon.base.method.Method`).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.method import Method


class Direct(Method):
    """One pass over the views, such as filtered back-projection: it continues views beyond the field."""

    fitted: ClassVar[bool] = False
    weighs: ClassVar[bool] = False
    knows_outside: ClassVar[bool] = False
    makes_boxes: ClassVar[bool] = True

    def views_wanted(self, geometry: Geometry) -> NDArray[np.bool_]:
        """All but offset views, see `Geometry.is_centred`."""
        return geometry.is_centred


class Iterative(Method):
    """Steps, each of which brings the volume nearer to the views, and after each of which it can be stopped."""


class Series(Method):
    """Several volumes at times of the scan, all at once in memory, which all views determine together.

    Attributes:
        volumes: how many; `Reconstruction.series` has all.
    """

    takes: ClassVar[frozenset[str]] = frozenset({"times"})
    knows_outside: ClassVar[bool] = False
