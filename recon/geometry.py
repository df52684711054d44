"""Geometry: where every view's rays run, as one immutable value.

Convention (fixed for the whole project): the object stands still and the view turns. For a view at angle θ

    u = x cos θ + y sin θ        columns grow with u
    v = z                        rows grow with v (the rotation axis is z)
    rays run along d = (-sin θ, cos θ, 0)

Column i has its centre at u = (i - axis_col) * pixel_pitch, so `axis_col` counts pixels from 0 at the
centre of the first column; row j has its centre at v = (j - (rows - 1) / 2) * pixel_pitch.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class Geometry:
    """Parallel-beam geometry of a set of views.

    Attributes:
        angles: float64 [view], radians, any order, any range.
        detector_shape: (rows, cols) in pixels.
        pixel_pitch: detector pixel in mm at the sample (1.0 = work in pixels).
        axis_col: column coordinate of the rotation axis, 0 at the centre of the first column.
    """

    angles: NDArray[np.float64]
    detector_shape: tuple[int, int]
    pixel_pitch: float
    axis_col: float

    @classmethod
    def parallel(
        cls,
        angles: ArrayLike,
        detector_shape: tuple[int, int],
        pixel_pitch: float = 1.0,
        axis_col: float | None = None,
    ) -> Geometry:
        """Parallel beam. `axis_col=None` puts the axis in the middle of the detector, at (cols - 1) / 2.

        Raises:
            ValueError: for no views, non-finite angles, an empty detector, or a pitch that is not positive.
        """
        theta = np.atleast_1d(np.asarray(angles, dtype=np.float64)).copy()
        rows, cols = (operator.index(n) for n in detector_shape)
        if theta.ndim != 1 or theta.size == 0:
            raise ValueError(f"angles must be a non-empty list of radians, got shape {theta.shape}")
        if not np.isfinite(theta).all():
            bad = np.flatnonzero(~np.isfinite(theta))[:8].tolist()
            raise ValueError(f"{(~np.isfinite(theta)).sum()} of {theta.size} angles are not finite (views {bad} ...)")
        if rows < 1 or cols < 1:
            raise ValueError(f"detector_shape must be (rows, cols) >= 1, got {(rows, cols)}")
        if not (np.isfinite(pixel_pitch) and pixel_pitch > 0):
            raise ValueError(f"pixel_pitch must be a positive length in mm, got {pixel_pitch}")
        axis = (cols - 1) / 2 if axis_col is None else float(axis_col)
        if not np.isfinite(axis):
            raise ValueError(f"axis_col must be finite, got {axis_col}")
        theta.setflags(write=False)
        return cls(theta, (rows, cols), float(pixel_pitch), axis)

    @property
    def n_views(self) -> int:
        return int(self.angles.size)

    def select(self, views: Sequence[int] | NDArray[np.integer] | slice) -> Geometry:
        """The same geometry with only `views`, in that order.

        Raises:
            ValueError: for no views.
        """
        theta = np.atleast_1d(self.angles[views]).copy()
        if theta.size == 0:
            raise ValueError("no views are selected")
        theta.setflags(write=False)
        return replace(self, angles=theta)

    def at(self, angles: ArrayLike) -> Geometry:
        """The same detector and axis at other angles (radians)."""
        return Geometry.parallel(angles, self.detector_shape, self.pixel_pitch, self.axis_col)

    def rows(self, start: int, stop: int) -> Geometry:
        """The same geometry for detector rows start..stop; v is measured from the middle of the kept rows."""
        if not 0 <= start < stop <= self.detector_shape[0]:
            raise ValueError(f"rows {start}:{stop} do not lie in 0:{self.detector_shape[0]}")
        return replace(self, detector_shape=(stop - start, self.detector_shape[1]))

    def binned(self, factor: int) -> Geometry:
        """The geometry after joining factor x factor pixels; trailing rows and columns that do not fill a bin go.

        As with `rows`, v is measured from the middle of what is left.
        """
        if operator.index(factor) < 1:
            raise ValueError(f"bin factor must be >= 1, got {factor}")
        rows, cols = (n // factor for n in self.detector_shape)
        if rows < 1 or cols < 1:
            raise ValueError(f"bin factor {factor} is larger than the detector {self.detector_shape}")
        axis = (self.axis_col - (factor - 1) / 2) / factor
        return replace(self, detector_shape=(rows, cols), pixel_pitch=self.pixel_pitch * factor, axis_col=axis)
