"""Enough views: predicts, without a truth, the gain of the volume by the views still to come.

The volume of the views so far stands for the sample. Its views at all planned angles get noise like that in the
measured ones. Two volumes are reconstructed: from the views so far and from all (a parametric bootstrap; Efron &
Tibshirani 1993, ch. 6.5). The predicted gain says how much nearer to the sample the second volume is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from recon.voxels.fbp import fbp
from recon.voxels.field_edges import busiest_rows
from recon.voxels.iterative import solve
from recon.voxels.priors import NoiseBalance, Subsets, ordered_fista
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import VoxelProblem

_SWEEPS, _SUBSETS, _TV_STEPS = 8, 9, 3
_ROWS, _PIXELS = (2, 8), 2**17  # fewest and most rows of the slab, and approximate pixels of all its slices
_WIDEST_GAP = 3.0  # largest gap, in even steps: golden-ratio angles leave gaps of 2.6


@dataclass(frozen=True)
class Goal:
    """When views suffice; if there are two limits, both must be met.

    Attributes:
        psnr_gain_per_10_views: dB that ten more views may add; None: any.
        psnr_loss: dB that the volume may stay below that of the whole scan; None: any.
    """

    psnr_gain_per_10_views: float | None = None
    psnr_loss: float | None = None

    def __post_init__(self) -> None:
        given = [x for x in (self.psnr_gain_per_10_views, self.psnr_loss) if x is not None]
        if not given or not all(0 < x < math.inf for x in given):
            raise ValueError(f"a goal is at least one number of dB above 0, got {self}")

    def met(self, gain: Gain) -> bool:
        """Whether the upper ends of the predictions are within the limits."""
        limits = ((self.psnr_loss, gain.high), (self.psnr_gain_per_10_views, gain.high * gain.share_of(10)))
        return all(limit is None or value <= limit for limit, value in limits)


@dataclass(frozen=True)
class Gain:
    """The predicted gain of further views.

    Attributes:
        n_views, planned: so far, and in all.
        mean: dB.
        low, high: dB, two standard errors below and above it.
    """

    n_views: int
    planned: int
    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, n_views: int, planned: int, samples: ArrayLike) -> Gain:
        """The gain from two or more repeated predictions in dB."""
        values = np.asarray(samples, np.float64)
        mean, error = float(values.mean()), 2 * float(values.std(ddof=1)) / math.sqrt(values.size)
        return cls(n_views, planned, mean, mean - error, mean + error)

    def share_of(self, views: int) -> float:
        """The fraction of the gain from the next `views`, if the error follows a power of their number."""
        if self.n_views + views >= self.planned:
            return 1.0
        return math.log1p(views / self.n_views) / math.log(self.planned / self.n_views)


def predicted_gains(data: F32, geometry: Geometry, rng: np.random.Generator, samples: int) -> list[float]:
    """Random samples of the gain of further views, in dB of PSNR.

    Computed on the two to eight rows with most matter, by eight sweeps of FISTA-TV from FBP, the weight by the noise.
    Measured against true gains: tests/bench/test_enough_views.py.

    Args:
        data: line integrals [view, row, col] of the views so far.
        geometry: parallel beam, straight, of all planned views; the first are those so far.

    Raises:
        ValueError: there is no view to come, or these views hold no matter.
    """
    n, cols = len(data), data.shape[2]
    if not 2 <= n < geometry.n_views:
        raise ValueError(f"{n} of {geometry.n_views} views leave no view to predict")
    rows = busiest_rows(data, min(max(_PIXELS // cols**2, _ROWS[0]), _ROWS[1]))
    part = np.ascontiguousarray(data[:, rows])
    planned = geometry.rows(rows.start, rows.stop)
    so_far = planned.select(np.arange(n))
    sample = _volume(part, so_far)
    clean = Projector(planned, Grid.matching(planned)).forward(sample)
    # Photons: the variance of a line integral rises with it as its exponential does.
    variance = np.exp(clean, dtype=np.float64)
    variance *= float(np.mean(np.square(part - clean[:n], dtype=np.float64))) / float(variance[:n].mean())
    spread = np.sqrt(variance)

    def one() -> float:
        views = (clean + rng.normal(size=clean.shape) * spread).astype(np.float32)
        fewer, all_ = (
            float(np.mean(np.square(_volume(some, of) - sample, dtype=np.float64)))
            for some, of in ((views[:n], so_far), (views, planned))
        )
        if min(fewer, all_) == 0:
            raise ValueError("the views so far show no matter")
        return 10 * math.log10(fewer / all_)

    return [one() for _ in range(samples)]


def well_spread(angles: ArrayLike) -> bool:
    """Whether no gap between the angles (modulo π) exceeds three even steps, so that they could be a whole scan.

    Golden-ratio and interlaced angles meet this at any time, a sequence only at the end of half a turn.
    """
    theta = np.sort(np.mod(np.asarray(angles, np.float64), np.pi))
    gaps = np.diff(theta, append=theta[:1] + np.pi)
    return theta.size > 1 and bool(gaps.max() <= _WIDEST_GAP * np.pi / theta.size)


def _volume(data: F32, geometry: Geometry) -> F32:
    grid = Grid.matching(geometry)
    first = Volume(np.maximum(fbp(data, geometry, filter="hann"), 0), grid)
    return solve(_ByTheNoise(), Projector(geometry, grid), data, start=first).data


@dataclass(frozen=True)
class _ByTheNoise:
    """FISTA-TV without trials of weights, which would make its quality jump from one number of views to the next."""

    iterations: int = _SWEEPS

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        weight = NoiseBalance.of(problem, x, self.iterations, evenly=False)
        subsets = Subsets.of(problem, _SUBSETS)
        return ordered_fista(problem, x, weight, subsets, sweeps=self.iterations, tv_steps=_TV_STEPS)
