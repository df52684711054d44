"""Counts of lines of response with what their mean holds: the value, its file, and line integrals with weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from beamline.core.errors import DataError
from beamline.core.files import whole_file
from beamline.storage.hdf5 import created, open_hdf5, readable
from recon import Geometry

F32 = NDArray[np.float32]
_SMOOTH = (0.0, 1.5, 1.5)  # views, rows and columns, standard deviation, of the mean that weights follow
_FEWEST_OF_A_LINE = 0.5  # counts of a line's mean, at least


@dataclass(frozen=True, eq=False)
class Emission:
    """Counts along lines of response, binned as parallel views, with scatter, randoms and survival.

        mean = survival * A activity + background

    Attributes:
        counts: float32 [view, row, col], 0 or more, not corrected: their noise is Poisson's.
        geometry: of the lines; A takes line integrals on voxels.
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
                raise ValueError(f"{name} must be finite and 0 or more, of shape {shape}, got shape {values.shape}")
        if not self.counts.any():
            raise ValueError("counts are zero everywhere: there is nothing to reconstruct")


def read_counts(path: Path) -> Emission:
    """The group /emission of an HDF5 file: `counts` [view, row, col], `angles` in degrees, `pixel_size` in mm, and, as
    far as they are known, `attenuation` (line integrals), `normalisation` (efficiency), mean `randoms` and `scatter`.

    Raises:
        DataError: the file cannot be read, lacks counts, angles or pixel size, or has values that are no counts.
    """
    with open_hdf5(path) as file, readable(path):
        group = file.get("emission", {})
        if missing := {"counts", "angles", "pixel_size"} - {*group}:
            raise DataError(f"{path} has no /emission/{min(missing)}. Nothing was written.")
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
    """Write what `read_counts` reads. Raises DataError: `path` exists or cannot be written; nothing is left."""
    with whole_file(path) as partial, created(partial) as file:
        group = file.create_group("emission")
        for name, values in {"counts": counts, **sets}.items():
            group.create_dataset(name, data=values, chunks=(1, *values.shape[1:]), compression="gzip", fletcher32=True)
        group["angles"], group["pixel_size"] = np.degrees(geometry.angles), geometry.pixel_pitch


def weighted_lines(emission: Emission) -> tuple[F32, F32]:
    """Line integrals of the activity and weights [view, row, col] that carry the likelihood of counts to any method.

    To second order about an expected mean λ the negative log-likelihood of y is ½ w (p - p~)², with p~ = (y - b) / s,
    whatever λ is, and Fisher's w = s² / λ (McCullagh & Nelder 1989, section 2.5). λ is y smoothed by neighbours: the
    counts of a line alone would weigh its lucky ones least, and lower the sum. Lines of survival 0 weigh nothing.
    """
    survival, zeros = emission.survival, np.zeros_like(emission.counts)
    seen = survival > 0
    # Of counts over survival: efficiency and attenuation differ from line to line, activity hardly does.
    level = gaussian_filter(np.where(seen, emission.counts, 0), _SMOOTH, mode="nearest")
    shape = gaussian_filter(survival * seen, _SMOOTH, mode="nearest")
    mean = np.maximum(level * np.divide(survival, shape, out=1 + zeros, where=shape > 0), emission.background)
    lines = np.divide(emission.counts - emission.background, survival, out=zeros.copy(), where=seen)
    weights = np.divide(survival**2, np.maximum(mean, _FEWEST_OF_A_LINE), out=zeros, where=seen)
    return lines, weights
