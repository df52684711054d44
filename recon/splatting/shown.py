"""Shown: which volume of a growing scan predicts views held out better, the fit's or FBP's.

While the fit has had few steps, FBP of the same views may show what it does not. The Fourier transform of a view lies
on a line through that of the volume (Kak & Slaney 1988, section 3.2), so that the squared error of a view with the
weight |ω| is that of the volume along this line. Without the weight a sector's FBP, whose level is too low, loses to
blobs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import fft

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.views import spread_views
from recon.base.volume import Grid, Volume
from recon.splatting.optimise import FitState, renders, volume_of
from recon.splatting.problem import FitProblem
from recon.splatting.settings import FitSettings
from recon.voxels.fbp import fbp
from recon.voxels.held_out import busiest_rows
from recon.voxels.projector import Projector

_ROWS = 8  # that are compared
_VIEWS = 400  # of an FBP, at most; of more, some are left out evenly by angle
_COMPARED = 4  # views held out, the last ones


def volume_error(rendered: F32, measured: F32) -> float:
    """The error of a volume along the rays of views [..., col], relative to what is measured: √Σ|ω||F Δ|² over it."""
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
class PredictionErrors:
    """The `volume_error` of the fit and of FBP, in views held out of a growing scan and as many others; NaN: not known.

    A volume's error is least at the angles of views and largest in the gaps. A view held out alone shows a gap that is
    twice as wide as the others, which FBP bears worse than a fit.
    """

    fit: float = math.nan
    direct: float = math.nan

    @classmethod
    def of(
        cls, images: Sequence[F32], geometry: Geometry, held_out: Sequence[int], render: Callable[[int], F32]
    ) -> Self:
        """In the last views held out and those before them; by FBP of all that are not held out.

        NaN where none is, or the beam is not one of FBP's slices.

        Args:
            images: [row, col] of each view of the geometry.
            render: the fit's own of a view.
        """
        if not held_out or not geometry.rows_show_slices:
            return cls()
        last = [view for each in held_out[-_COMPARED:] for view in (each - 1, each)]
        measured = np.stack([images[view] for view in last])
        rows = busiest_rows(measured, _ROWS)
        slab, learnt = geometry.rows(rows.start, rows.stop), np.setdiff1d(np.arange(len(images)), held_out)
        grid = Grid.matching(slab)
        volume = direct_volume([images[view][rows] for view in learnt], slab.select(learnt), grid)
        by_fit = np.stack([render(view)[rows] for view in last])
        by_fbp = Projector(slab.select(last), grid).forward(volume)
        return cls(volume_error(by_fit, measured[:, rows]), volume_error(by_fbp, measured[:, rows]))


@dataclass(frozen=True, eq=False)
class BetterVolume:
    """The volume of the views so far that predicts views held out best, 1/mm. `direct`: it is FBP's, else the fit's."""

    volume: Volume
    direct: bool
    errors: PredictionErrors

    @classmethod
    def of(
        cls, state: FitState, problem: FitProblem, settings: FitSettings, grid: Grid, held_out: Sequence[int]
    ) -> Self:
        """Of the views of a problem, from which a fit without those held out has this state."""

        def render(view: int) -> F32:
            return problem.backend.numpy(next(renders(state, problem, settings, [view])))

        errors = PredictionErrors.of(problem.images, problem.geometry, held_out, render)
        if not errors.direct < errors.fit:
            return cls(volume_of(state, grid, problem.geometry, settings), False, errors)
        data = direct_volume(problem.images, problem.geometry, grid) * problem.scale
        return cls(Volume(data, grid), True, errors)
