"""Resampling: corrects projections for a detector that is rotated about the beam, and for a lens that distorts.

Positions are in pixels of the whole detector, 0 at the centre of the first one. The value of a pixel (col, row) of the
new projection is read at a position on the detector. To find this position, (col, row) is first rotated about the
detector's middle, and then displaced as the lens displaces it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_TAPS = 6  # taps: number of pixels along each axis from which a new pixel is interpolated
_BEFORE = _TAPS // 2 - 1  # number of taps before a position
_PHASES = 4096  # number of positions within a pixel at which weights are tabulated
_LOOKED_AT = 65  # number of positions along each side at which the largest displacement is measured


@dataclass(frozen=True)
class Distortion:
    """Radial distortion of a lens: a point at (x, y) from the centre appears at (x, y) * sum a_i r^i.

    The backward model of Vo, Atwood & Drakopoulos 2015 (Opt. Express 23, 32859, equation 7, with even and odd powers).

    Attributes:
        col, row: the centre.
        factors: a_0, a_1 ...; r is in pixels.
    """

    col: float
    row: float
    factors: tuple[float, ...]

    def __post_init__(self) -> None:
        values = np.array([self.col, self.row, *self.factors])
        if not (self.factors and np.isfinite(values).all() and self.factors[0] > 0):
            raise ValueError(
                f"the distortion needs a centre and finite factors, the first above 0, got {values.tolist()}"
            )

    @classmethod
    def parse(cls, text: str) -> Distortion:
        """Read a text file of discorpy. Each line has a name and a value: xcenter, ycenter, factor0, factor1 ...

        Raises:
            ValueError: there are other lines, or values that do not form such a model.
        """
        lines = [line.replace("=", " ").replace(":", " ").split() for line in text.splitlines() if line.strip()]
        expected = ["xcenter", "ycenter", *(f"factor{i}" for i in range(len(lines) - 2))]
        if len(lines) < 3 or [line[0] for line in lines] != expected or any(len(line) != 2 for line in lines):
            raise ValueError("expected the lines 'xcenter = X', 'ycenter = Y', 'factor0 = A0', 'factor1 = A1' ...")
        col, row, *factors = (float(line[1]) for line in lines)
        return cls(col, row, tuple(factors))

    def on_detector(self, col: F64, row: F64) -> tuple[F64, F64]:
        """Position on the detector at which the lens shows (col, row)."""
        x, y = col - self.col, row - self.row
        r = np.hypot(x, y)
        scale = np.polynomial.polynomial.polyval(r, self.factors)
        return self.col + x * scale, self.row + y * scale


@dataclass(frozen=True)
class Resampling:
    """Resamples projections in one step, by cubic convolution over six pixels.

    Attributes:
        shape: (rows, cols) of the whole detector.
        tilt: tilt of the rotation axis in the detector's plane in radians: the column of the axis grows by tan(tilt)
            per row. `Geometry` calls this tilt `roll`; `Geometry.tilt` is the tilt along the beam.
        distortion: distortion of the lens; None: no distortion.
        binning: each pixel of the projections is the mean of binning x binning pixels.
    """

    shape: tuple[int, int]
    tilt: float = 0.0
    distortion: Distortion | None = None
    binning: int = 1

    @property
    def reach(self) -> int:
        """Number of binned rows on each side from which a new row is interpolated, at most."""
        rows, cols = (np.linspace(0, n - 1, _LOOKED_AT) for n in self.shape)
        rows_on_detector = self._on_detector(*np.meshgrid(cols, rows))[1]
        return math.ceil(float(np.abs(rows_on_detector - rows[:, None]).max()) / self.binning) + _TAPS // 2

    def apply(self, views: F32, first: int) -> None:
        """Resample projections [view, row, col] in place.

        Pixels beyond the given rows and columns take the value of the nearest given pixel.

        Args:
            first: detector row of the first row of the projections.
        """
        rows, cols = self._positions_in_given(views.shape[1:], first)
        table = _weights()
        for view in views:
            _resample(view.copy(), *_whole_and_phase(rows), *_whole_and_phase(cols), table, view)

    def nearest(self, image: NDArray[Any], first: int) -> NDArray[Any]:
        """An image [row, col] resampled without interpolation. It is meant for masks."""
        rows, cols = self._positions_in_given(image.shape, first)
        row, col = (
            np.clip(np.rint(positions), 0, n - 1).astype(np.int64)
            for positions, n in zip((rows, cols), image.shape, strict=True)
        )
        return np.asarray(image[row, col])

    def outside_detector(self, shape: tuple[int, int], first: int) -> NDArray[np.bool_]:
        """Mask [row, col] of the new pixels outside the detector, for projections that begin at row `first`."""
        rows, cols = self.positions(shape, first)
        n_rows, n_cols = self.shape
        return (rows < -0.5) | (rows > n_rows - 0.5) | (cols < -0.5) | (cols > n_cols - 0.5)

    def positions(self, shape: tuple[int, ...], first: int) -> tuple[F64, F64]:
        """Positions (row, col) of the new pixels on the detector, each [row, col]; projections begin at row `first`."""
        rows, cols = (np.arange(length) * self.binning + (self.binning - 1) / 2 for length in shape[-2:])
        col, row = self._on_detector(*np.meshgrid(cols, rows + first))
        return row, col

    def _positions_in_given(self, shape: tuple[int, ...], first: int) -> tuple[F64, F64]:
        """Positions (row, col) of the new pixels in the given projections."""
        row, col = self.positions(shape, first)
        middle = (self.binning - 1) / 2
        return (row - middle) / self.binning - first / self.binning, (col - middle) / self.binning

    def _on_detector(self, col: F64, row: F64) -> tuple[F64, F64]:
        middle_row, middle_col = ((n - 1) / 2 for n in self.shape)
        c, s = math.cos(self.tilt), math.sin(self.tilt)
        x, y = col - middle_col, row - middle_row
        col, row = middle_col + c * x + s * y, middle_row + c * y - s * x
        return (col, row) if self.distortion is None else self.distortion.on_detector(col, row)


def _whole_and_phase(positions: F64) -> tuple[NDArray[np.int32], NDArray[np.int16]]:
    """The integer part of a position, and its fraction in units of 1 / number of phases."""
    steps = np.rint(positions * _PHASES)
    whole = np.floor(steps / _PHASES)
    return whole.astype(np.int32), (steps - whole * _PHASES).astype(np.int16)


def _weights() -> F32:
    """[phase, tap] weights of the cubic convolution over six points (Keys 1981, IEEE Trans.

    ASSP 29, 1153, section VI).
    """
    s = np.abs(np.arange(_TAPS) - _BEFORE - np.arange(_PHASES)[:, None] / _PHASES)
    near = (4 / 3 * s - 7 / 3) * s**2 + 1
    middle = ((-7 / 12 * s + 3) * s - 59 / 12) * s + 5 / 2
    far = ((s / 12 - 2 / 3) * s + 7 / 4) * s - 3 / 2
    return np.where(s < 1, near, np.where(s < 2, middle, np.where(s < 3, far, 0))).astype(np.float32)


@njit(parallel=True, boundscheck=False, cache=True)
def _resample(view, row, row_phase, col, col_phase, table, out):
    """out[i, j] = weighted sum of the 6 x 6 pixels of `view` around (row, col)[i, j].

    Beyond an edge, the edge is repeated.
    """
    rows, cols = view.shape
    for i in prange(rows):
        for j in range(cols):
            r0, c0 = row[i, j] - _BEFORE, col[i, j] - _BEFORE
            row_weights, col_weights = table[row_phase[i, j]], table[col_phase[i, j]]
            total = np.float32(0)
            for k in range(_TAPS):
                line = view[min(max(r0 + k, 0), rows - 1)]
                row_sum = np.float32(0)
                for m in range(_TAPS):
                    row_sum += col_weights[m] * line[min(max(c0 + m, 0), cols - 1)]
                total += row_weights[k] * row_sum
            out[i, j] = total
