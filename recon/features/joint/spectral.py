"""Spectral reconstruction: joint fit of the density of each material to projections at several energies.

The attenuation at an energy is a sum over materials with known cross sections. The projections of all energies together
determine the few volumes of the materials. So no energy needs a complete set of projections.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from recon.base.arrays import F32, F64
from recon.base.declared_types import check_arguments
from recon.base.empirical import ONE_IN
from recon.base.units import warn_of_other_quantity
from recon.base.volume import Grid
from recon.features.joint.energy_fit import EnergyFit, EnergyViews, fitted, trial_rows

# number of rows and of iterations of a test of weights, which starts with the volumes of the previous test
TRIAL_ROWS, _TRIAL_SWEEPS = 16, 8
# share of the open-beam intensity below which rays have lower weights; smallest weight of a ray
_LOW_TRANSMISSION, _LEAST_WEIGHT = 0.1, 0.1
_AVERAGED_PIXELS = 1.5  # number of pixels over which line integrals are averaged
_FIRST_WEIGHT = 0.1  # the first weight, divided by the largest gradient at zero
ALIKE_LONGER = 3  # factor on the iterations, because volumes at different times differ more than materials
_TRIALS = 12  # tests of one weight for all components, each half of the previous one
_HEAVIER_TESTS = 4  # tests of a larger weight for all except the first component, each twice the previous one
_EQUAL_RESIDUAL_RATIO = 1.01  # weights whose residual is within this factor of the smallest count as equally good
MATERIAL_SWEEPS = 20
TRIAL_SWEEPS = (_TRIALS + _HEAVIER_TESTS) * _TRIAL_SWEEPS  # largest number of iterations of all tests


@dataclass(frozen=True, eq=False)
class Materials:
    """Densities of materials.

    Attributes:
        densities: float32 [material, z, y, x], 0 or more, in the unit in which the cross sections are stated for
            density 1.
        grid: grid of each volume.
        weights: weights of total variation, one for each component (see `fit_materials`).
        residual: norm of the residual of the projections, divided by the norm of the projections.
    """

    densities: F32
    grid: Grid
    weights: F64
    residual: float

    def share(self, of: int, others: Sequence[int], least: float) -> F32:
        """The density of the material `of`, divided by the sum of the densities of the materials `of` and `others`, [z,
        y, x], 0 to 1. For example, the share of a charged material is the state of charge of a battery electrode.

        Args:
            least: a share is computed where the densities of the materials `of` and `others` add up to `least` or more;
                voxels with a smaller sum get NaN.
        """
        part = self.densities[of]
        total = part + self.densities[list(others)].sum(0)
        return np.where(total >= least, np.clip(part / np.maximum(total, least), 0, 1), np.float32(np.nan))


def fit_materials(
    views: EnergyViews,
    grid: Grid | None = None,
    *,
    tv_weight: float | None = None,
    sweeps: int = MATERIAL_SWEEPS,
    seed: int = 0,
    go_on: Callable[[int, float], bool] = lambda sweep, residual: True,
    stop: Callable[[], bool] = lambda: False,
) -> Materials:
    """The densities of the materials, from one least-squares fit to the projections of all energies with total
    variation:

        min over z of ½ Σ_v |A_v Σ_k U[e(v), k] z_k - p_v|² + Σ_k μ_k TV(z_k),    densities >= 0.

    The singular value decomposition of the cross sections is U S Vᵀ (each energy weighted by its number of
    projections). The densities of the materials are V S⁻¹ z. The columns of U are orthonormal, so all components z_k
    have the same noise, and the fit is as well conditioned as a fit at a single energy. An iteration takes as long as
    an iteration for the same number of projections at a single energy. Each iteration makes the steps of
    `ordered_fista`. After each step, densities below 0 are set to 0. Long & Fessler (2014, IEEE TMI 33, 1614) also fit
    the densities of materials to spectral projections in one step. Memory: seven volumes per material, three times the
    projections.

    During the test reconstructions for the weights, the first argument of `go_on` is -n, where n is the number of
    iterations that may still follow (at most `TRIAL_SWEEPS`).

    Args:
        grid: grid of the volumes; None: the grid of the geometry.
        tv_weight: weight for all components; None: the weights that predict held-out projections best.
        sweeps: number of iterations, each of about nine steps that use all projections equally often.
        go_on: function called with (iteration, residual) after each iteration; False ends the fit with the volumes
            reached so far.
        stop: function called many times within an iteration, from the second step on; True ends the fit with the
            volumes from before the current step.
    """
    check_arguments(fit_materials, locals())
    warn_of_other_quantity(views.projections)
    grid, views = grid or Grid.matching(views.geometry), _weighed(views)
    n = views.cross_sections.shape[1]
    weights = weights_by_views(views, grid, seed, go_on, stop) if tv_weight is None else np.full(n, tv_weight)
    fit = EnergyFit(views, grid, np.random.default_rng(seed), stop=stop)
    densities, residual = fitted(fit, weights, sweeps, go_on)
    return Materials(densities, grid, weights, residual)


def weight_of(transmission: F32) -> F32:
    """Weights, up to 1, of rays with this transmission."""
    return np.clip(transmission / _LOW_TRANSMISSION, _LEAST_WEIGHT, 1)


def _weighed(views: EnergyViews) -> EnergyViews:
    """The projections, with lower weights (down to a tenth) for rays below a tenth of the open-beam intensity.

    Such rays have more noise, and the logarithm of few counts is biased. The intensity of a ray is computed from the
    mean line integral around the ray. Given weights above a tenth of the largest weight count as equal, because a wider
    range of weights would need more iterations.
    """
    known = np.ones_like(views.projections) if views.weight is None else (views.weight > 0).astype(np.float32)
    transmission = np.empty_like(known)
    for view, image in enumerate(views.projections):
        known_nearby = gaussian_filter(known[view], _AVERAGED_PIXELS)
        transmission[view] = np.exp(
            -gaussian_filter(known[view] * image, _AVERAGED_PIXELS) / np.maximum(known_nearby, 1e-3)
        )
    weight = weight_of(transmission)
    if views.weight is not None:
        weight *= np.minimum(1, views.weight / (_LOW_TRANSMISSION * (float(views.weight.max()) or 1)))
    return replace(views, weight=weight.astype(np.float32))


class _Trials:
    """Test reconstructions for the weights of total variation [component]. Each test starts with the volumes of the
    previous test.

    Attribute `going`: True as long as `go_on` and `stop` have not ended a test.
    """

    def __init__(
        self,
        fit: EnergyFit,
        judge: EnergyFit,
        sweeps: int,
        go_on: Callable[[int, float], bool],
        stop: Callable[[], bool],
    ) -> None:
        """`fit`: projections for the test reconstructions; `judge`: held-out projections."""
        self.going = True
        self._fit, self._judge, self._sweeps = fit, judge, sweeps
        self._go_on, self._stop = go_on, stop

    def residual(self, weights: F64, tests_after: int) -> float:
        """Residual in held-out projections; infinite if the test was stopped. `tests_after` is the number of tests that
        may still follow."""
        n = self._sweeps
        for sweep, residual in enumerate(self._fit.sweeps(weights, n), 1):
            if not self._go_on(sweep - n * (1 + tests_after), residual):
                self.going = False
                return math.inf
        if self._stop():
            self.going = False
            return math.inf
        # not z, because the share of an energy in these projections is different
        return self._judge.residual_of(self._fit.densities())

    def common(self, tests_after: int) -> F64:
        """The best single weight for all components: the weight is halved until the prediction has been worse twice. If
        the tests are stopped, the best weight so far."""
        weights = np.full(len(self._fit.z), _FIRST_WEIGHT * self._fit.steepest())
        best, least, n_worse = weights, math.inf, 0
        for trial in range(1, 1 + _TRIALS):
            residual = self.residual(weights, _TRIALS - trial + tests_after)
            if not self.going:
                return best
            best, least, n_worse = (weights, residual, 0) if residual < least else (best, least, n_worse + 1)
            if n_worse == 2:
                break
            weights = weights / 2
        return best

    def heaviest(self, weights: F64, factor: F64, rungs: int, tests_after: int) -> F64:
        """The largest weights, in powers of `factor`, that predict as well as the best weights. If the tests are
        stopped, `weights`."""
        ladder = [weights * factor**octave for octave in range(rungs)]
        residuals = [self.residual(rung, tests_after + rungs - 1 - n) for n, rung in enumerate(ladder) if self.going]
        if not self.going:
            return weights
        limit = _EQUAL_RESIDUAL_RATIO * min(residuals)
        return next(weight for weight, residual in zip(ladder[::-1], residuals[::-1], strict=True) if residual <= limit)


def weights_by_views(
    views: EnergyViews,
    grid: Grid,
    seed: int,
    go_on: Callable[[int, float], bool],
    stop: Callable[[], bool] = lambda: False,
    *,
    alike: bool = False,
) -> F64:
    """Weights of total variation [component], chosen with one in eight projections held out.

    First, one weight for all components is halved until the prediction gets worse. Then the components that contain
    differences get the largest weight whose residual is within 1 % of the smallest, because these components have less
    structure and the same noise.

    Args:
        alike: True: all components keep the same weight.
    """
    held_out = views.parted(ONE_IN) == ONE_IN // 2
    rows, grid = trial_rows(views, grid, TRIAL_ROWS)
    fit, judge = (
        EnergyFit(views.select(np.flatnonzero(chosen), rows), grid, np.random.default_rng(seed), stop=stop)
        for chosen in (~held_out, held_out)
    )
    trials = _Trials(fit, judge, (ALIKE_LONGER if alike else 1) * _TRIAL_SWEEPS, go_on, stop)
    weights = trials.common(tests_after=_HEAVIER_TESTS)
    components = np.arange(len(weights))
    if trials.going:
        factor = np.where((components > 0) | alike, 2.0, 1.0)
        weights = trials.heaviest(weights, factor, _HEAVIER_TESTS, tests_after=0)
    return weights
