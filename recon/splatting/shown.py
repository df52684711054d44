"""Shown: which volume of a growing scan predicts new views better before it has seen them, the fit's or FBP's.

While the fit has had few steps, FBP of the same views may show what it does not. The Fourier transform of a view lies
on a line through that of the volume (Kak & Slaney 1988, section 3.2), so that the squared error of a view with the
weight |ω| is that of the volume along this line. Without the weight a sector's FBP, whose level is too low, loses to
blobs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import fft

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import Clock
from recon.base.views import spread_views
from recon.base.volume import Grid, Volume
from recon.voxels.fbp import fbp
from recon.voxels.held_out import busiest_rows
from recon.voxels.projector import Projector

_ROWS = 8  # that are compared
_VIEWS = 400  # of an FBP, at most; of more, some are left out evenly by angle
_NEW = 0.4  # weight of the newest view in the running means
_SHARE = 0.1  # of the time, at most, for the comparisons


def volume_error(rendered: F32, measured: F32) -> float:
    """The error of a volume along the rays of a view [row, col], relative to what is measured: √Σ|ω||F Δ|² over it."""
    n = 2 * measured.shape[-1]
    ramp = np.arange(n // 2 + 1)

    def squared(image: F32) -> float:
        return float((np.abs(fft.rfft(image, n)) ** 2 * ramp).sum(dtype=np.float64))

    return math.sqrt(squared(rendered - measured) / max(squared(measured), 1e-30))


def direct_volume(images: Sequence[F32], geometry: Geometry, grid: Grid) -> F32:
    """FBP of at most 400 of the views [row, col], without what is below zero, float32 [z, y, x]."""
    some = spread_views(geometry.angles, _VIEWS, np.arange(len(images)))
    return np.maximum(fbp(np.stack([images[i] for i in some]), geometry.select(some), grid, "hann"), 0)


@dataclass(frozen=True)
class Predictions:
    """How well new views were predicted, running means of `volume_error`; NaN: not known.

    Attributes:
        fit, direct: by the fit and by FBP.
        n: comparisons.
        due: when the next comparison may be, by the clock.
    """

    fit: float = math.nan
    direct: float = math.nan
    n: int = 0
    due: float = -math.inf

    @property
    def direct_is_better(self) -> bool:
        return self.direct < self.fit

    def met(self, images: Sequence[F32], geometry: Geometry, rendered: F32, before: int, now: Clock) -> Self:
        """With the last of the views, as the fit rendered it before it had seen the views from number `before` on.

        Nothing changes where it is too early, or the beam is not one of FBP's slices.

        Args:
            images: line integrals [row, col] of each view of the geometry.
        """
        begin = now()
        if begin < self.due or before < 2 or not geometry.rows_show_slices:
            return self
        newest = np.asarray(images[-1])
        rows = busiest_rows(newest[None], _ROWS)
        slab = geometry.rows(rows.start, rows.stop)
        grid = Grid.matching(slab)
        volume = direct_volume([np.asarray(image[rows]) for image in images[:before]], slab.select(range(before)), grid)
        seen = Projector(slab.select([geometry.n_views - 1]), grid).forward(volume)[0]
        errors = (volume_error(image, newest[rows]) for image in (rendered[rows], seen))
        share = max(_NEW, 1 / (self.n + 1))
        fit, direct = (
            new if self.n == 0 else (1 - share) * old + share * new
            for old, new in zip((self.fit, self.direct), errors, strict=True)
        )
        end = now()
        return replace(self, fit=fit, direct=direct, n=self.n + 1, due=end + (end - begin) * (1 / _SHARE - 1))


@dataclass(frozen=True, eq=False)
class ShownVolume:
    """The volume of the views so far that predicts new ones best, 1/mm. `direct`: it is FBP's, else the fit's."""

    volume: Volume
    direct: bool
    predictions: Predictions
