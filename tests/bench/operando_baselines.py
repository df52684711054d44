"""Published ways to use a reference; their weights are chosen with the truth.

All but the last get the reference that was moved to the state already. piccs: the mean of the total variations of the
volume and of its difference from the reference (Chen, Tang & Leng 2008, Med. Phys. 35, 660). dtv: total variation
without the differences along the gradient of the reference (Ehrhardt & Betcke 2016, SIAM J. Imaging Sci. 9, 1084).
rest: the reference plus FBP of what it leaves of the projections. start: a few iterations of total variation that begin
with the reference, as `init_recon` of mbirjax allows; their number is chosen with the truth, too. series: one fit of
the projections of the reference scan and of the state (`recon.fit_series`); held-out projections choose its weight, and
whether the sample moved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

import recon
from recon.base.arrays import F32
from recon.base.decisions import Prior
from recon.base.view_data import Views
from recon.base.volume import Volume
from recon.features.reference.fit import TwoVariations
from recon.voxels.iterative import solve_views
from recon.voxels.ordered_fista import Prox, Subsets, ordered_fista, subsets_of
from recon.voxels.priors import TvWeight, tv_prox
from recon.voxels.projector import Projector
from recon.voxels.trial import TV_STEPS
from recon.voxels.voxel_problem import VoxelProblem, difference_weights, times_power

WEIGHTS = 1e-2, 5e-3, 2.5e-3, 1.25e-3  # μ for each projection, the largest first; a volume begins with the one before
SWEEPS, STILL = 30, 2e-3  # at most, and the change of a volume that has converged
START_SWEEPS = 2, 5, 10
_STEPS = 8  # dual steps of a proximal step
_SMOOTH = 0.02  # slope of the reference, divided by its highest level, that halves what dtv takes away


def volumes(lines: F32, geometry: recon.Geometry, moved: Volume) -> dict[str, list[F32]]:
    """The volumes [z, y, x] of each way, one for each weight (or filter)."""
    projector = Projector(geometry, moved.grid)
    rest = lines - recon.Projector(geometry, moved.grid).forward(moved.data)
    by_fbp = [recon.reconstruct(rest, geometry, recon.Fbp(filter)).volume.data for filter in ("hann", "ram-lak")]
    made = {"piccs": list[F32](), "dtv": list[F32](), "rest": [moved.data + each for each in by_fbp]}
    views, m = Views(lines, geometry).masked(), np.ascontiguousarray(moved.data.transpose(1, 2, 0))
    for name, prox in (("piccs", _piccs), ("dtv", Directional)):
        state = _Weighed(m, prox)
        for weight in WEIGHTS:
            state.weight = weight * geometry.n_views
            made[name].append(solve_views(state, projector, views).data)
    made["start"] = [
        solve_views(_Started(m, weight * geometry.n_views, sweeps), projector, views).data
        for weight in WEIGHTS for sweeps in START_SWEEPS
    ]  # fmt: skip
    return made


def of_series(before: F32, angles: NDArray[np.float64], lines: F32, geometry: recon.Geometry) -> F32:
    """The volume [z, y, x] of the state from one fit of its projections and of those of the reference scan."""
    both = recon.Geometry.parallel(np.concatenate([angles, geometry.angles]), lines.shape[1:])
    times = np.repeat([0.0, 1.0], [len(before), len(lines)])
    return recon.fit_series(recon.TimedViews(np.concatenate([before, lines]), both, times), 2).at(1.0)


@dataclass(frozen=True)
class _Started:
    """Total variation of one weight, a few sweeps from the reference m [y, x, z]."""

    m: F32
    weight: float
    sweeps: int

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        m = times_power(self.m.copy(), -problem.units.density)
        weight = problem.units.prior(Prior(self.weight), problem.weight is not None, -1).weight
        subsets = Subsets.of(problem, subsets_of(problem.projector.geometry))
        return ordered_fista(problem, m, TvWeight(weight), subsets, sweeps=self.sweeps,
                             prox=tv_prox(problem, TV_STEPS), still=0.0)  # fmt: skip


@dataclass
class _Weighed:
    """The volume of one weight, which begins with that of the weight before, or with the reference m [y, x, z]."""

    m: F32
    prox: Callable[..., Prox]
    weight: float = 0.0
    last: F32 | None = field(default=None)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        m = times_power(self.m.copy(), -problem.units.density)
        weight = problem.units.prior(Prior(self.weight), problem.weight is not None, -1).weight
        prox = self.prox(m, difference_weights(problem.projector.grid))
        subsets = Subsets.of(problem, subsets_of(problem.projector.geometry))
        start = m if self.last is None else self.last
        self.last = ordered_fista(problem, start.copy(), TvWeight(weight), subsets, sweeps=SWEEPS, prox=prox,
                                  still=STILL)  # fmt: skip
        return self.last.copy()


def _piccs(m: F32, scale: tuple[float, float, float]) -> Prox:
    prox = TwoVariations(m.shape, scale, True)
    half = np.full_like(m, 0.5)
    prox.about(m, half, half)
    return prox


class Directional:
    """argmin_y ½|y - x|² + threshold Σ_i |P_i D y|_i, y >= 0, with P_i = I - ξ ξᵀ and ξ = D m / √(|D m|² + η²)."""

    def __init__(self, m: F32, scale: tuple[float, float, float]) -> None:
        self._scale = scale
        slope = self._differences(m)
        eta = _SMOOTH * float(m.max())
        self._along = slope / np.sqrt(np.square(slope).sum(0) + eta**2)
        self._dual = np.zeros_like(slope)

    def __call__(self, x: F32, threshold: float) -> None:
        """Replace x [y, x, z] by the proximal point."""
        if threshold <= 0:
            np.maximum(x, 0, out=x)
            return
        given, pace = x.copy(), np.float32(1 / (threshold * 4 * sum(w * w for w in self._scale)))
        for step in range(_STEPS + 1):
            x[...] = np.maximum(given - np.float32(threshold) * self._back(self._projected(self._dual)), 0)
            if step < _STEPS:
                self._dual += pace * self._projected(self._differences(x))
                self._dual /= np.maximum(np.sqrt(np.square(self._dual).sum(0)), 1)

    def turn(self) -> None:
        """Nothing: the differences stay those to the next voxels."""

    def _projected(self, d: F32) -> F32:
        return d - self._along * (self._along * d).sum(0)

    def _differences(self, x: F32) -> F32:
        d = np.zeros((3, *x.shape), np.float32)
        for axis in range(3):
            d[axis][_but(-1, axis)] = np.float32(self._scale[axis]) * np.diff(x, axis=axis)
        return d

    def _back(self, d: F32) -> F32:
        """The transpose of `_differences`."""
        x = np.zeros(d.shape[1:], np.float32)
        for axis in range(3):
            some = np.float32(self._scale[axis]) * d[axis][_but(-1, axis)]
            x[_but(-1, axis)] -= some
            x[_but(0, axis)] += some
        return x


def _but(end: int, axis: int) -> tuple[slice, ...]:
    """All voxels but the first (0) or the last (-1) along an axis."""
    some = slice(1, None) if end == 0 else slice(None, -1)
    return tuple(some if each == axis else slice(None) for each in range(3))
