"""Emission: counts of a sample that emits (PET, SPECT), and their line integrals for any method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from recon.base.arrays import F32, I64
from recon.base.declared_types import check_arguments
from recon.base.geometry import Geometry
from recon.base.settings_check import check_settings

_SMOOTH = (0.0, 1.5, 1.5)  # views, rows and columns, standard deviation, of the mean that weights follow
_FEWEST = 0.5  # counts of a line's mean, at least


@dataclass(frozen=True, eq=False)
class Emission:
    """Counts along lines of response, binned as parallel views, with scatter, randoms and survival.

        mean = survival * A activity + background

    Attributes:
        counts: float32 [view, row, col], 0 or more, not corrected: their noise is Poisson's.
        geometry: of the lines; A takes line integrals on voxels.
        survival: [view, row, col], attenuation factor (see `recon.attenuation_factors`) times sensitivity; None: 1.
        background: [view, row, col], mean randoms and scatter; None: 0.
    """

    counts: F32
    geometry: Geometry
    survival: F32 | None = None
    background: F32 | None = None

    def __post_init__(self) -> None:
        check_settings(self)
        expected = (self.geometry.n_views, *self.geometry.detector_shape)
        for name in ("counts", "survival", "background"):
            values = getattr(self, name)
            if values is None:
                continue
            if values.shape != expected:
                raise ValueError(f"{name} [view, row, col] have shape {values.shape}, the geometry says {expected}")
            if not (np.isfinite(values).all() and values.min() >= 0):
                raise ValueError(f"{name} must be finite and 0 or more, got {values.min()} to {values.max()}")

    def summed(self, views: I64, geometry: Geometry) -> Emission:
        """Sums of the counts of neighbouring views, each sum as one view; the activity keeps its scale.

        Args:
            views: [view, window], numbers of the views that are added.
            geometry: of the views that are made.
        """

        def added(values: F32 | None) -> F32 | None:
            return None if values is None else values[views].sum(axis=1)

        survival = added(np.ones_like(self.counts) if self.survival is None else self.survival)
        return Emission(self.counts[views].sum(axis=1), geometry, survival, added(self.background))


def weighted_lines(emission: Emission) -> tuple[F32, F32]:
    """Line integrals of the activity and weights [view, row, col] that carry the likelihood of counts to any method.

    To second order about an expected mean λ the negative log-likelihood of y is ½ w (p - p~)², with p~ = (y - b) / s,
    whatever λ is, and Fisher's w = s² / λ (McCullagh & Nelder 1989, section 2.5). λ is y smoothed by neighbours: the
    counts of a line alone would weigh its lucky ones least, and lower the sum. Lines of survival 0 weigh nothing.

    Raises:
        ValueError: survival that is so small or large that lines or weights are beyond float32.
    """
    check_arguments(weighted_lines, locals())
    ones = np.ones_like(emission.counts)
    survival = ones if emission.survival is None else emission.survival
    background = 0 * ones if emission.background is None else emission.background
    seen = survival > 0
    # Of counts over survival: efficiency and attenuation differ from line to line, activity hardly does.
    level = gaussian_filter(np.where(seen, emission.counts, 0), _SMOOTH, mode="nearest")
    shape = gaussian_filter(survival * seen, _SMOOTH, mode="nearest")
    mean = np.maximum(level * np.divide(survival, shape, out=ones.copy(), where=shape > 0), background)
    with np.errstate(over="ignore"):
        lines = np.divide(emission.counts - background, survival, out=0 * ones, where=seen)
        weights = np.divide(survival**2, np.maximum(mean, _FEWEST), out=0 * ones, where=seen)
    if not (np.isfinite(lines).all() and np.isfinite(weights).all() and weights.any() == seen.any()):
        low, high = survival[seen].min(), survival.max()
        raise ValueError(f"survival from {low:.3g} to {high:.3g} gives lines or weights that float32 cannot hold")
    return lines, weights
