"""Counts along lines of response, with the parts of their mean: as a value, in a file, and as line integrals with
weights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from beamline.core.errors import DataError
from beamline.core.files import atomic_file
from beamline.storage.hdf5 import created, open_hdf5, readable
from recon import Geometry, Grid

WATER, AIR, TEFLON = 0.0096, 1e-5, 0.0174  # 1/mm at 511 keV: water 0.096 cm²/g, PTFE 0.079 cm²/g at 2.2 g/cm³
HEIGHT = 40.0
_RAYS = (-1 / 3, 0.0, 1 / 3)  # rays of a pixel: distances from its middle along a row, in pixels


@dataclass(frozen=True)
class Rod:
    """A cylinder along the axis at the position `at` (x, y). `activity` and `mu` are relative to the displaced
    material.
    """

    radius: float
    at: tuple[float, float]
    activity: float
    mu: float


def _position(turn: int) -> tuple[float, float]:
    """Position of the rod number `turn`; neighbouring rods are 60° apart."""
    return 13 * math.cos(turn * math.pi / 3), 13 * math.sin(turn * math.pi / 3)


RODS = (
    Rod(24.0, (0.0, 0.0), 1.0, WATER),
    *(Rod(radius, _position(turn), 3.0, 0.0) for turn, radius in enumerate((1.5, 2.5, 4.0, 5.5))),
    Rod(5.5, _position(4), -1.0, AIR - WATER),
    Rod(5.5, _position(5), -1.0, TEFLON - WATER),
)


@dataclass(frozen=True)
class Scanner:
    """The counts of a scanner: trues, scatter and randoms.

    Attributes:
        trues: number of pairs that arrive unscattered, over all lines.
        scatter, randoms: counts relative to the trues. Scatter is a broad blur of the trues, randoms are uniform.
        scatter_mm: standard deviation of that blur.
        spread: relative standard deviation of the efficiency from pixel to pixel.
    """

    trues: float = 1.5e7
    scatter: float = 0.15
    randoms: float = 0.2
    scatter_mm: float = 12.0
    spread: float = 0.1


def chords(geometry: Geometry, which: str) -> NDArray[np.float64]:
    """Line integrals [view, row, col] of "activity" (1 in the water) or "mu", averaged over the rays of a pixel."""
    rows, cols = geometry.detector_shape
    inside = np.abs(geometry.pixel_pitch * (np.arange(rows) - geometry.axis_row)) < HEIGHT / 2
    u = geometry.pixel_pitch * (np.arange(cols)[:, None] + np.array(_RAYS) - geometry.axis_col)
    out = np.zeros((geometry.n_views, rows, cols))
    for view, angle in enumerate(geometry.angles):
        for rod in RODS:
            off = u - rod.at[0] * math.cos(angle) - rod.at[1] * math.sin(angle)
            chord = 2 * np.sqrt(np.maximum(rod.radius**2 - off**2, 0)).mean(axis=1)
            out[view] += getattr(rod, which) * chord * inside[:, None]
    return out


def activity(grid: Grid, fine: int = 4) -> F32:
    """Activity [z, y, x], 1 in the water, from `fine`² points in each voxel."""
    z, y, x = grid.coordinates()
    part = ((np.arange(fine) + 0.5) / fine - 0.5) * grid.voxel_size
    ys, xs = (y[:, None] + part).ravel(), (x[:, None] + part).ravel()
    slice_ = np.zeros((ys.size, xs.size))
    for rod in RODS:
        slice_ += rod.activity * (np.hypot(ys[:, None] - rod.at[1], xs - rod.at[0]) < rod.radius)
    mean = slice_.reshape(y.size, fine, x.size, fine).mean(axis=(1, 3))
    return np.asarray((np.abs(z) < HEIGHT / 2)[:, None, None] * mean, np.float32)


def counts_of(geometry: Geometry, scanner: Scanner, seed: int) -> tuple[F32, dict[str, F32], float]:
    """Simulate counts. Returns Poisson counts [view, row, col], the parts of their mean by the names of `read_counts`,
    and the counts per mm of a line of activity 1.
    """
    rng = np.random.default_rng(seed)
    lines, depth = chords(geometry, "activity"), chords(geometry, "mu")
    efficiency = rng.normal(1, scanner.spread, geometry.detector_shape).clip(0.3, 1.7) + np.zeros_like(lines)
    trues = efficiency * np.exp(-depth) * lines
    scale = scanner.trues / float(trues.sum())
    trues *= scale
    sigma = scanner.scatter_mm / geometry.pixel_pitch
    scatter = scanner.scatter * gaussian_filter(trues, (0, sigma, sigma), mode="nearest")
    randoms = efficiency * scanner.randoms * scanner.trues / trues.size
    counts = rng.poisson(trues + randoms + scatter).astype(np.float32)
    sets = {"attenuation": depth, "normalisation": efficiency, "randoms": randoms, "scatter": scatter}
    return counts, {name: values.astype(np.float32) for name, values in sets.items()}, scale


F32 = NDArray[np.float32]
_SMOOTH = (0.0, 1.5, 1.5)  # standard deviation of the smoothing for weights, in projections, rows and columns
_FEWEST_OF_A_LINE = 0.5  # smallest mean counts of a line


@dataclass(frozen=True, eq=False)
class Emission:
    """Counts along lines of response, binned as parallel projections, with scatter, randoms and survival.

        mean = survival * A activity + background

    Attributes:
        counts: float32 [view, row, col], 0 or more, uncorrected, so that their noise is Poisson.
        geometry: geometry of the lines; A computes line integrals of voxels.
        survival: [view, row, col], attenuation factor (see `attenuation_factors`) times sensitivity.
        background: [view, row, col], mean randoms and scatter.
    """

    counts: F32
    geometry: Geometry
    survival: F32
    background: F32

    def __post_init__(self) -> None:
        for name in ("counts", "survival", "background"):
            values, shape = getattr(self, name), (self.geometry.n_views, *self.geometry.detector_shape)
            if values.shape != shape or not (np.isfinite(values).all() and values.min() >= 0):
                raise ValueError(f"{name} must be finite, 0 or more and of shape {shape}; got shape {values.shape}")
        if not self.counts.any():
            raise ValueError("there is nothing to reconstruct, because all counts are zero")


def read_counts(path: Path) -> Emission:
    """Read the group /emission of an HDF5 file: `counts` [view, row, col], `angles` in degrees, `pixel_size` in mm,
    and, as far as they are known, `attenuation` (line integrals), `normalisation` (efficiency), mean `randoms` and
    `scatter`.

    Raises:
        DataError: the file cannot be read, has no counts, angles or pixel size, or has values that cannot be counts.
    """
    with open_hdf5(path) as file, readable(path):
        group = file.get("emission", {})
        if missing := {"counts", "angles", "pixel_size"} - {*group}:
            raise DataError(f"{path} has no dataset /emission/{min(missing)}. Nothing was written.")
        counts = np.asarray(group["counts"][()], np.float32)
        zeros, ones = np.zeros_like(counts), np.ones_like(counts)
        sets = {"attenuation": zeros, "normalisation": ones, "randoms": zeros, "scatter": zeros}
        sets |= {name: np.asarray(group[name][()], np.float32) for name in sets if name in group}
        angles, pitch = np.radians(group["angles"][()]), float(group["pixel_size"][()])
    survival = sets["normalisation"] * np.exp(-sets["attenuation"])
    try:
        geometry = Geometry.parallel(angles, counts.shape[1:], pixel_pitch=pitch)
        return Emission(counts, geometry, survival, sets["randoms"] + sets["scatter"])
    except ValueError as error:
        raise DataError(f"{path} cannot be reconstructed: {error}. Nothing was written.") from error


def write_counts(path: Path, counts: F32, geometry: Geometry, sets: Mapping[str, F32]) -> None:
    """Write a file for `read_counts`. DataError: `path` exists or cannot be written; nothing is left."""
    with atomic_file(path) as partial, created(partial) as file:
        group = file.create_group("emission")
        for name, values in {"counts": counts, **sets}.items():
            group.create_dataset(name, data=values, chunks=(1, *values.shape[1:]), compression="gzip", fletcher32=True)
        group["angles"], group["pixel_size"] = np.degrees(geometry.angles), geometry.pixel_pitch


def weighted_lines(emission: Emission) -> tuple[F32, F32]:
    """Line integrals of the activity and weights [view, row, col], so that any method can use the likelihood of counts.

    To second order about an expected mean λ, the negative log-likelihood of y is ½ w (p - p~)² with p~ = (y - b) / s,
    whatever λ is, and Fisher's w = s² / λ (McCullagh & Nelder 1989, section 2.5). λ is y smoothed over neighbours: with
    the counts of a line alone, lines with many counts by chance would get the smallest weights, and the sum would be
    too low. Lines with survival 0 have weight 0.
    """
    survival, zeros = emission.survival, np.zeros_like(emission.counts)
    exposed = survival > 0
    # Smooth counts over survival, because efficiency and attenuation differ from line to line, and activity hardly.
    level = gaussian_filter(np.where(exposed, emission.counts, 0), _SMOOTH, mode="nearest")
    shape = gaussian_filter(survival * exposed, _SMOOTH, mode="nearest")
    mean = np.maximum(level * np.divide(survival, shape, out=1 + zeros, where=shape > 0), emission.background)
    lines = np.divide(emission.counts - emission.background, survival, out=zeros.copy(), where=exposed)
    weights = np.divide(survival**2, np.maximum(mean, _FEWEST_OF_A_LINE), out=zeros, where=exposed)
    return lines, weights
