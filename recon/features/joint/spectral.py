"""One fit of several energies: the density of each material, from views that each see one energy.

The attenuation at an energy is a sum over materials with known cross sections. So no energy needs a full set of views:
all views of all energies determine the few volumes of the materials.
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

TRIAL_ROWS, _TRIAL_SWEEPS = 16, 8  # of a trial of weights, which begins with the volumes of the last one
_LITTLE, _LEAST = 0.1, 0.1  # light of the open beam; weight of a ray
_AVERAGED = 1.5  # pixels, over which depth is averaged
_FIRST = 0.1  # the first weight, over the largest gradient at zero
ALIKE_LONGER = 3  # times the sweeps: volumes of times differ by more than materials of energies
_TRIALS = 12  # of one weight for all components, each half of the last one
_HEAVIER = 4  # trials of a heavier one for all but the first component, each twice the last one
_AS_WELL = 1.01  # weights that leave so much of the least residual predict as well
MATERIAL_SWEEPS = 20
TRIAL_SWEEPS = (_TRIALS + _HEAVIER) * _TRIAL_SWEEPS  # of all trials, at most


@dataclass(frozen=True, eq=False)
class Materials:
    """Densities of materials.

    Attributes:
        densities: float32 [material, z, y, x], in the unit of the cross sections' densities. 0 or more.
        grid: of each volume.
        weights: of total variation, one for each component (see `fit_materials`).
        residual: norm of what the volumes leave of the views, over the norm of the views.
    """

    densities: F32
    grid: Grid
    weights: F64
    residual: float

    def share(self, of: int, others: Sequence[int], least: float) -> F32:
        """The fraction [z, y, x] of a material in the summed density of itself and others, 0 ... 1, such as a state of
        charge.

        Args:
            least: summed density below which there is nothing to take a share of: NaN there.
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
    """The densities that explain the views of all energies in one least-squares fit with total variation.

        min over z of ½ Σ_v |A_v Σ_k U[e(v), k] z_k - p_v|² + Σ_k μ_k TV(z_k),    densities >= 0

    U S Vᵀ is the singular value decomposition of the cross sections (each energy counted by its views). The densities
    are V S⁻¹ z. The columns of U are orthonormal, so noise is the same in all components z_k, and the fit is as well
    conditioned as that of one energy. A sweep costs as much as one over the same views at one energy. Steps are those
    of `ordered_fista`; densities below 0 are clipped after each of them. (Long & Fessler 2014, IEEE Trans. Med. Imaging
    33, 1614, fit materials to spectra in one step, too.)
    Memory: seven volumes a material, three times the projections.

    Args:
        grid: of the volumes; None: as the geometry has it.
        tv_weight: of all components; None: the weights with which views held out are predicted best.
        sweeps: of about nine steps each, which see all views equally often.
        go_on: called with (sweep, residual) after each sweep, and with (-n, residual) after each sweep of trials of
            weights, where n may follow. These are `TRIAL_SWEEPS` at most. False ends the fit, with the volumes so far.
        stop: asked many times within a sweep, from the second step on. True ends the fit with the volumes before the
            step that it interrupts.
    """
    check_arguments(fit_materials, locals())
    warn_of_other_quantity(views.projections)
    grid, views = grid or Grid.matching(views.geometry), _weighed(views)
    n = views.cross_sections.shape[1]
    weights = weights_by_views(views, grid, seed, go_on, stop) if tv_weight is None else np.full(n, tv_weight)
    fit = EnergyFit(views, grid, np.random.default_rng(seed), stop=stop)
    densities, residual = fitted(fit, weights, sweeps, go_on)
    return Materials(densities, grid, weights, residual)


def weight_of(light: F32) -> F32:
    """Weights of rays with this transmission, up to 1."""
    return np.clip(light / _LITTLE, _LEAST, 1)


def _weighed(views: EnergyViews) -> EnergyViews:
    """Rays with less than a tenth of the light weigh less, by the mean depth around them, down to a tenth.

    Their noise is larger, and the logarithm of few counts is biased. Of the weights given, those above a tenth of the
    largest count as equal. Weights of a wider range would take more sweeps.
    """
    there = np.ones_like(views.projections) if views.weight is None else (views.weight > 0).astype(np.float32)
    light = np.empty_like(there)
    for view, image in enumerate(views.projections):
        near = gaussian_filter(there[view], _AVERAGED)
        light[view] = np.exp(-gaussian_filter(there[view] * image, _AVERAGED) / np.maximum(near, 1e-3))
    weight = weight_of(light)
    if views.weight is not None:
        weight *= np.minimum(1, views.weight / (_LITTLE * (float(views.weight.max()) or 1)))
    return replace(views, weight=weight.astype(np.float32))


class _Trials:
    """Trials of weights of total variation [component]: each begins with the volumes of the last one.

    Attribute `going`: `go_on` and `stop` have ended none.
    """

    def __init__(
        self,
        fit: EnergyFit,
        judge: EnergyFit,
        sweeps: int,
        go_on: Callable[[int, float], bool],
        stop: Callable[[], bool],
    ) -> None:
        """Take the views of a trial (`fit`) and those held out (`judge`)."""
        self.going = True
        self._fit, self._judge, self._sweeps = fit, judge, sweeps
        self._go_on, self._stop = go_on, stop

    def residual(self, weights: F64, after: int) -> float:
        """Residual of the views held out, infinite if the trial was stopped; `after`: trials that may still follow."""
        n = self._sweeps
        for sweep, residual in enumerate(self._fit.sweeps(weights, n), 1):
            if not self._go_on(sweep - n * (1 + after), residual):
                self.going = False
                return math.inf
        if self._stop():
            self.going = False
            return math.inf
        return self._judge.residual_of(self._fit.densities())  # not z: an energy's share of the views is another one

    def common(self, after: int) -> F64:
        """One weight for all components, halved until it predicts worse twice; the best so far if ended."""
        weights = np.full(len(self._fit.z), _FIRST * self._fit.steepest())
        best, least, worse = weights, math.inf, 0
        for trial in range(1, 1 + _TRIALS):
            now = self.residual(weights, _TRIALS - trial + after)
            if not self.going:
                return best
            best, least, worse = (weights, now, 0) if now < least else (best, least, worse + 1)
            if worse == 2:
                break
            weights = weights / 2
        return best

    def heaviest(self, weights: F64, factor: F64, rungs: int, after: int) -> F64:
        """The heaviest weights, in powers of the factor, that predict as well as the best; `weights` if stopped."""
        ladder = [weights * factor**octave for octave in range(rungs)]
        residuals = [self.residual(rung, after + rungs - 1 - n) for n, rung in enumerate(ladder) if self.going]
        if not self.going:
            return weights
        limit = _AS_WELL * min(residuals)
        return next(at for at, now in zip(ladder[::-1], residuals[::-1], strict=True) if now <= limit)


def weights_by_views(
    views: EnergyViews,
    grid: Grid,
    seed: int,
    go_on: Callable[[int, float], bool],
    stop: Callable[[], bool] = lambda: False,
    *,
    alike: bool = False,
) -> F64:
    """Weights of total variation [component], chosen with one view in eight held out.

    First one weight for all components, halved until it predicts worse. Those that hold differences then get the
    heaviest that predicts within 1 % of the best: they have less structure, and the same noise.

    Args:
        alike: all components keep one weight.
    """
    held_out = views.parted(ONE_IN) == ONE_IN // 2
    rows, grid = trial_rows(views, grid, TRIAL_ROWS)
    fit, judge = (
        EnergyFit(views.select(np.flatnonzero(chosen), rows), grid, np.random.default_rng(seed), stop=stop)
        for chosen in (~held_out, held_out)
    )
    trials = _Trials(fit, judge, (ALIKE_LONGER if alike else 1) * _TRIAL_SWEEPS, go_on, stop)
    weights = trials.common(after=_HEAVIER)
    components = np.arange(len(weights))
    if trials.going:
        factor = np.where((components > 0) | alike, 2.0, 1.0)
        weights = trials.heaviest(weights, factor, _HEAVIER, after=0)
    return weights
