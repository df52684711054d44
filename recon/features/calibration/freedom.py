"""Freedom: which quantities of a geometry are learnt, what they do to an image, and which of them nobody can know.

What cannot be known is the gauge. A sample elsewhere on its stage shows the same views, moved by a cos θ + b sin θ
along the columns. A higher sample moves them by a constant along the rows. So shifts have no such part here. Their mean
along the columns is the axis. A turn of the sample about the axis adds a constant to all angles; these never change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry

TERMS = "axis", "roll", "tilt", "shifts"
"""The column of the axis; the axis leaning in the detector's plane; along the beam; each view's place (col, row)."""


@dataclass(frozen=True, eq=False)
class GeometryChange:
    """A change of a geometry, in its pixels and radians.

    Attributes:
        axis: columns.
        shifts: float64 [view, 2], (col, row).
    """

    axis: float
    roll: float
    tilt: float
    shifts: F64

    @classmethod
    def none(cls, views: int) -> GeometryChange:
        return cls(0.0, 0.0, 0.0, np.zeros((views, 2)))

    @classmethod
    def between(cls, before: Geometry, after: Geometry) -> GeometryChange:
        """The change from one geometry to another one of the same views."""
        return cls(
            after.axis_col - before.axis_col,
            float((after.roll - before.roll).mean()),
            float((after.tilt - before.tilt).mean()),
            after.shifts - before.shifts,
        )

    def of(self, terms: frozenset[str]) -> GeometryChange:
        """The part of it that these terms name."""
        return GeometryChange(
            self.axis * ("axis" in terms), self.roll * ("roll" in terms), self.tilt * ("tilt" in terms),
            self.shifts * ("shifts" in terms),
        )  # fmt: skip

    def scaled(self, factor: float) -> GeometryChange:
        """The same in pixels that are smaller by this factor."""
        return replace(self, axis=self.axis * factor, shifts=self.shifts * factor)

    def applied(self, geometry: Geometry) -> Geometry:
        """The geometry after it."""
        return replace(
            geometry,
            axis_col=geometry.axis_col + self.axis,
            roll=geometry.roll + self.roll,
            tilt=geometry.tilt + self.tilt,
            shifts=geometry.shifts + self.shifts,
        )


def knowable(shifts: F64, angles: F64) -> tuple[F64, float]:
    """Shifts [view, 2] without the part that nobody can know, and their mean along the columns: the axis' part."""
    place = np.stack((np.ones_like(angles), np.cos(angles), np.sin(angles)), axis=1)
    solution = np.linalg.lstsq(place, shifts[:, 0], rcond=None)[0]
    rest = np.stack((shifts[:, 0] - place @ solution, shifts[:, 1] - shifts[:, 1].mean()), axis=1)
    return rest, float(solution[0])


def slopes(images: F32, geometry: Geometry, tilted: F32 | None, terms: frozenset[str]) -> dict[str, F32]:
    """The derivative of images [view, col, row] by each quantity: a pixel; an image's half extent at its edge.

    Args:
        tilted: the derivative by tilt, a radian; None: not wanted.
    """
    across, down = -np.gradient(images, axis=1), -np.gradient(images, axis=2) if images.shape[2] > 1 else 0 * images
    by_term: dict[str, F32] = {}
    if "axis" in terms:  # beside shifts, too: their mean then comes in one step
        by_term["axis"] = across
    if "shifts" in terms:
        by_term |= {"col": across, "row": down}
    rows, cols = geometry.detector_shape
    if "roll" in terms:
        u = np.arange(cols) - geometry.axis_col - geometry.shifts[:, :1]
        v = np.arange(rows) - geometry.axis_row - geometry.shifts[:, 1:]
        turned = across * v[:, None, :].astype(np.float32) - down * u[:, :, None].astype(np.float32)
        by_term["roll"] = np.asarray(turned / edge_motion(geometry), np.float32)
    if tilted is not None:
        by_term["tilt"] = np.asarray(tilted / edge_motion(geometry), np.float32)
    return by_term


def edge_motion(geometry: Geometry) -> float:
    """Displacement of an image's edge by roll or tilt, in pixels a radian."""
    return max(geometry.detector_shape) / 2


def moved(geometry: Geometry, steps: dict[str, NDArray[np.float64]], farthest: float) -> Geometry:
    """The geometry after steps along `slopes`, limited to so many pixels; what nobody can know is left out."""
    limited = {name: np.clip(step, -farthest, farthest) for name, step in steps.items()}
    shifts, axis = geometry.shifts.copy(), geometry.axis_col
    if "col" in limited:
        shifts += np.stack((limited["col"], limited["row"]), axis=1)
        shifts, mean = knowable(shifts, geometry.angles)
        axis += mean
    if "axis" in limited:
        axis += float(limited["axis"][0])
    turns = {name: float(limited[name][0]) / edge_motion(geometry) for name in ("roll", "tilt") if name in limited}
    limit = math.radians(30)
    return replace(
        geometry,
        axis_col=axis,
        shifts=shifts,
        roll=np.clip(geometry.roll + turns.get("roll", 0.0), -limit, limit),
        tilt=np.clip(geometry.tilt + turns.get("tilt", 0.0), -limit, limit),
    )
