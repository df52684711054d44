"""Flat structure: dust and scratches on scintillator and optics, which make flats uneven; the same in all frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.orca_quest import SENSOR_SHAPE
from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import Positive, Whole
from simulators.frame.shot import Image, Shot, fixed_rng

Reals = NDArray[np.float64]
REACH = 4.0  # A Gaussian is drawn up to so many sigmas; less than 4e-4 of its depth lies beyond


@dataclass(frozen=True)
class FlatStructure(ImageEffect):
    """Each speck and scratch multiplies the light by 1 - depth x Gaussian.

    A flat corrects them, unless the beam has moved (beam_profile) or is blurred after them. Name dust on the
    scintillator before scintillator_blur, dust on the camera's window after it. They are computed for sensor pixels and
    averaged over binned ones, so that any ROI and binning shows the same ones.

    Attributes:
        specks: number of specks on the whole sensor.
        radius_um: mean of their radii (sigmas; half to one and a half times this), um at the sample.
        depth: mean share of the light that is lost in the middle of a speck; between 0 and twice this.
        scratches: number of straight scratches on the whole sensor.
        scratch_length_um: mean of their lengths (exponentially distributed), um at the sample.
        scratch_width_um: sigma across them, um at the sample.
        scratch_depth: mean share of the light that is lost along a scratch; between 0 and twice this.
        seed: of places, sizes and depths.
    """

    specks: Annotated[int, Field(ge=0, le=100_000)] = 200
    radius_um: Positive = 10.0
    depth: Annotated[float, Field(ge=0, le=0.5)] = 0.1
    scratches: Annotated[int, Field(ge=0, le=1000)] = 5
    scratch_length_um: Positive = 2000.0
    scratch_width_um: Positive = 3.0
    scratch_depth: Annotated[float, Field(ge=0, le=0.5)] = 0.05
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        image *= self.transmission(shot)
        return image

    def transmission(self, shot: Shot) -> Image:
        """Share of the light that is left, float64 [row, col]."""
        pixel_um = shot.detector.pitch / shot.binning * 1e3
        row0, col0, rows, cols = shot.roi
        left = np.ones((rows, cols))
        rng = fixed_rng(self.name, self.seed)
        for row, col, radius, depth in self._specks(rng, pixel_um):
            _draw_speck(left, row - row0, col - col0, radius, depth)
        for row, col, angle, length, depth in self._scratches(rng, pixel_um):
            _draw_scratch(left, row - row0, col - col0, angle, length, self.scratch_width_um / pixel_um, depth)
        n = shot.binning
        return left if n == 1 else left.reshape(rows // n, n, cols // n, n).mean(axis=(1, 3))

    def _specks(self, rng: np.random.Generator, pixel_um: float) -> Reals:
        """Sensor row and column, radius in sensor pixels and depth; float64 [speck, 4]."""
        draw = rng.random((self.specks, 4))
        draw[:, 2] += 0.5
        return draw * (*SENSOR_SHAPE, self.radius_um / pixel_um, 2 * self.depth)

    def _scratches(self, rng: np.random.Generator, pixel_um: float) -> Reals:
        """Sensor row and column of the middle, angle, length in sensor pixels and depth; float64 [scratch, 5]."""
        draw = rng.random((self.scratches, 5))
        draw[:, 3] = -np.log1p(-draw[:, 3])
        return draw * (*SENSOR_SHAPE, np.pi, self.scratch_length_um / pixel_um, 2 * self.scratch_depth)


def _draw_speck(left: Reals, row: float, col: float, radius: float, depth: float) -> None:
    """Multiply a round Gaussian into `left`; row and column may lie outside."""
    rows = _window(row, REACH * radius, left.shape[0])
    cols = _window(col, REACH * radius, left.shape[1])
    if rows.size and cols.size:
        down, across = (np.exp(-0.5 * ((at - middle) / radius) ** 2) for at, middle in ((rows, row), (cols, col)))
        left[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] *= 1 - depth * down[:, None] * across


def _draw_scratch(left: Reals, row: float, col: float, angle: float, length: float, width: float, depth: float) -> None:
    """Multiply a straight line with a Gaussian across it and at its ends into `left`; only pixels near it are touched.

    The line is followed along the axis that it is closer to, and drawn across that axis at each of its pixels.
    """
    if abs(np.sin(angle)) < abs(np.cos(angle)):
        left, row, col, angle = left.T, col, row, np.pi / 2 - angle
    along, beside = np.sin(angle), np.cos(angle)
    steps = _window(row, abs(along) * length / 2 + REACH * width, left.shape[0])
    # Across an inclined line a width w is w / cos along the axis: √2 w at most.
    reach = int(np.ceil(REACH * width * np.sqrt(2)))
    middle = np.rint(col + (steps - row) * beside / along).astype(np.int64)
    whole = 2 * reach >= left.shape[1]  # wider than the frame: each of its columns once
    at = np.arange(left.shape[1]) + 0 * middle[:, None] if whole else middle[:, None] + np.arange(-reach, reach + 1)
    dy, dx = (steps - row)[:, None], at - col
    t, s = dy * along + dx * beside, dx * along - dy * beside  # pixels along the line and across
    beyond = np.maximum(np.abs(t) - length / 2, 0.0)
    loss = depth * np.exp(-0.5 * (s**2 + beyond**2) / width**2)
    inside = (at >= 0) & (at < left.shape[1])
    left[np.broadcast_to(steps[:, None], at.shape)[inside], at[inside]] *= 1 - loss[inside]


def _window(middle: float, reach: float, extent: int) -> NDArray[np.int64]:
    """Indices 0 ... extent - 1 within reach of the middle."""
    return np.arange(max(0, int(np.ceil(middle - reach))), min(extent, int(np.floor(middle + reach)) + 1))
