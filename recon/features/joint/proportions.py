"""Proportions: least-squares fit of densities that are a known density times smooth factors.

    min over s of ½ Σ_v w_v |A_v f Σ_k c[e(v), k] s_k - q_v|²
                  + λ/2 Σ_k (Σ_ij f_i f_j (s_ki - s_kj)² + τ Σ_i f_i² (s_ki - s_k+1,i)²)

f is a known density and A_v a projection. c is the share of each s_k in projections of a kind e, such as an energy or a
moment. i, j are neighbouring voxels. Nothing is smoothed across empty regions, so bodies that do not touch have
independent factors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.declared_types import check_arguments
from recon.base.empirical import ONE_IN
from recon.base.volume import Grid
from recon.features.joint.energy_fit import EnergyViews, StoppedError, trial_rows
from recon.features.joint.motion import conjugate_gradients
from recon.features.joint.spectral import Materials
from recon.voxels.projector import Projector, projection_lines, volume_lines, volume_slices

# first λ, divided by the mean curvature of the projections; ratio of the next λ to it; number of tests
_LARGEST_SMOOTHNESS, _SMOOTHNESS_RATIO, _TRIALS = 32.0, 3.0, 9
_TIME_WEIGHT = 0.03  # the constant τ
SOLUTION_STEPS, _TRIAL_STEPS = 60, 20  # number of conjugate-gradient iterations of the solution, and of a test
TRIAL_STEPS = _TRIALS * _TRIAL_STEPS
"""Largest number of iterations of all tests together."""


@dataclass
class Countdown:
    """Reports to a listener how many steps may remain, and records whether the listener has ended the steps."""

    go_on: Callable[[int], bool]
    remaining: int
    stop: Callable[[], bool] = lambda: False
    going: bool = True

    def __call__(self) -> bool:
        self.remaining -= 1
        self.going = self.going and self.go_on(max(0, self.remaining))
        return self.going

    def end(self) -> None:
        """Report to the listener that no step follows."""
        if self.going and self.remaining > 0:
            self.remaining, self.going = 0, self.go_on(0)


@dataclass(frozen=True, eq=False)
class Proportions:
    """The least-squares problem of this module. Volumes are [y, x, z], factors [k, y, x, z], projections [view, col,
    row].

    Attributes:
        projector: projector of all projections.
        kind: e: number of the kind of each projection, [view].
        shares: c: share of each factor in projections of each kind, [kind, k].
        matter: f: the known density, [y, x, z].
        data: q: the measured line integrals, [view, col, row].
        weight: w: weights of the line integrals, [view, col, row].
        stop: called many times in each step. True ends the computation, with the factors from before the step.
    """

    projector: Projector
    kind: NDArray[np.intp]
    shares: F64
    matter: F32
    data: F32
    weight: F32
    stop: Callable[[], bool] = lambda: False

    def select(self, views: NDArray[np.intp]) -> Proportions:
        """The problem with only some projections."""
        return replace(
            self, projector=self.projector.subset(views), kind=self.kind[views], data=self.data[views],
            weight=self.weight[views],
        )  # fmt: skip

    @cached_property
    def _kinds(self) -> list[tuple[Projector, NDArray[np.intp], F64]]:
        """Projector, projections and shares of each kind."""
        owns = [(kind, np.flatnonzero(self.kind == kind)) for kind in np.unique(self.kind)]
        return [(self.projector.subset(own), own, self.shares[kind]) for kind, own in owns]

    def _each_kind(self) -> Iterator[tuple[Projector, NDArray[np.intp], F64]]:
        for kind in self._kinds:
            if self.stop():
                raise StoppedError
            yield kind

    def shown(self, factors: F32) -> F32:
        """The projections [view, col, row] that these factors predict: A f Σ c s."""
        out = np.empty_like(self.data)
        for projector, own, shares in self._each_kind():
            out[own] = projector.forward_lines(self.matter * np.tensordot(shares.astype(np.float32), factors, 1))
        return out

    def explained(self, lines: F32) -> F32:
        """The transpose of `shown`, applied to weighted projections."""
        out = np.zeros((self.shares.shape[1], *self.matter.shape), np.float32)
        for projector, own, shares in self._each_kind():
            back = self.matter * projector.adjoint_lines(self.weight[own] * lines[own])
            for k in np.flatnonzero(shares):
                out[k] += np.float32(shares[k]) * back
        return out

    def left(self, factors: F32) -> F64:
        """Weighted sum of squares [view] of the residual for these factors."""
        residual = self.data - self.shown(factors)
        return np.einsum("vij,vij,vij->v", self.weight, residual, residual, dtype=np.float64)

    def rough(self, factors: F32) -> F32:
        """Gradient of half the weighted squares of differences, without λ."""
        out = np.zeros_like(factors)
        differences = np.float32(_TIME_WEIGHT) * self.matter**2 * np.diff(factors, axis=0)
        out[:-1] -= differences
        out[1:] += differences
        for axis in range(3):
            low, high = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
            pairs = self.matter[low] * self.matter[high]
            for factor, target in zip(factors, out, strict=True):
                differences_in_space = pairs * (factor[high] - factor[low])
                target[low] -= differences_in_space
                target[high] += differences_in_space
        return out

    def ones(self) -> F32:
        """Factors of 1."""
        return np.ones((self.shares.shape[1], *self.matter.shape), np.float32)

    def solved(self, smooth: float, factors: F32, go_on: Callable[[], bool], steps: int = SOLUTION_STEPS) -> F32:
        """Factors after conjugate-gradient iterations that start from given factors.

        Args:
            smooth: λ divided by the mean curvature of the projections.
            go_on: called before each iteration; False ends it.
        """
        solution = factors.copy()
        with suppress(StoppedError):
            mean = float(np.vdot(self.explained(self.shown(self.ones())).sum(0), self.matter))
            weight = np.float32(smooth * mean / max(len(factors) * float(np.vdot(self.matter, self.matter)), 1e-30))

            def normal(proportions: F32) -> F32:
                return self.explained(self.shown(proportions)) + weight * self.rough(proportions)

            conjugate_gradients(normal, self.explained(self.data) - normal(solution), solution, steps, go_on)
        return solution


def smoothness(fit: Proportions, judge: Proportions, first: F32, go_on: Callable[[], bool]) -> tuple[float, float]:
    """The value of `smooth` with which the projections of `fit` predict the projections of `judge` best, and the
    residual in the projections of `judge`.

    The search starts with a large value and reduces it until the prediction has been worse twice. It then chooses the
    largest value that predicts as well as the best one: within one standard error of the difference over the
    projections of `judge` (Breiman et al. 1984, section 3.4.3).

    Args:
        first: factors to start with.
    """
    factors, trials, worse = first, list[tuple[float, F64]](), 0
    best = np.full(judge.data.shape[0], np.inf)
    with suppress(StoppedError):
        for trial in range(_TRIALS):
            smooth = _LARGEST_SMOOTHNESS / _SMOOTHNESS_RATIO**trial
            factors = fit.solved(smooth, factors, go_on, _TRIAL_STEPS)
            trials.append((smooth, judge.left(factors)))
            best, worse = (trials[-1][1], 0) if trials[-1][1].sum() < best.sum() else (best, worse + 1)
            if worse == 2:
                break
    for smooth, residuals in trials:
        excess = residuals - best
        if excess.sum() <= math.sqrt(excess.size) * excess.std(ddof=min(1, excess.size - 1)):
            return smooth, float(residuals.sum())
    return _LARGEST_SMOOTHNESS, math.inf


# number of rows of a test reconstruction; line integral above which all rays have equal weight
_ROWS, _DEEPEST_LINE_INTEGRAL = 16, 7.0
STEPS = TRIAL_STEPS + SOLUTION_STEPS


def fit_share(
    views: EnergyViews,
    found: Materials,
    states: tuple[int, int],
    go_on: Callable[[int], bool] = lambda remaining: True,
    stop: Callable[[], bool] = lambda: False,
) -> Materials:
    """Fit the densities of two states of one material again. The sum of both densities does not change; the fraction of
    each state becomes smooth in space.

    Held-out projections decide how smooth this fraction is. (On some rows, one projection in eight is held out.)
    Memory: ten volumes, six times the projections.

    Args:
        found: result of `fit_materials` from the same projections.
        states: the two states, as indices in `found.densities`.
        go_on: function called before each of at most `STEPS` steps, with the number of steps that may follow; if it
            returns False, `fit_share` returns `found` unchanged.
        stop: function called many times within a step; if it returns True, `fit_share` returns `found` unchanged.

    Raises:
        ValueError: `states` are not two different materials.
    """
    check_arguments(fit_share, locals())
    count = len(found.densities)
    if len(set(states)) != 2 or not set(states) <= set(range(count)):
        raise ValueError(f"states must be two different materials from 0 to {count - 1}, got {states}")
    steps = Countdown(go_on, STEPS, stop)
    smooth = _smoothness(views, found, states, steps)
    steps.remaining = min(steps.remaining, SOLUTION_STEPS)
    problem = share_problem(views, found.densities, states, found.grid)
    share = _even(problem)
    share = np.clip(volume_slices(replace(problem, stop=stop).solved(smooth, share, steps)[0]), 0, 1)
    if not steps.going or stop():
        return found
    densities, total = found.densities.copy(), found.densities[list(states)].sum(0)
    densities[states[0]], densities[states[1]] = total * (1 - share), total * share
    return replace(found, densities=densities)


def share_problem(views: EnergyViews, densities: F32, states: tuple[int, int], grid: Grid) -> Proportions:
    """The `Proportions` problem, with rays weighted by the expected photons (the inverse variance of their noise)."""
    projector, sections = Projector(views.geometry, grid), views.cross_sections
    of_view = sections[views.energy].astype(np.float32)[:, :, None, None]
    data = projection_lines(views.projections)
    depth = np.zeros_like(data)
    for material, density in enumerate(densities):
        lines = projector.forward_lines(volume_lines(density))
        depth += of_view[:, material] * lines
        data = data - of_view[:, states[0] if material in states else material] * lines
    weight = np.exp(-np.minimum(depth, _DEEPEST_LINE_INTEGRAL))
    if views.weight is not None:
        weight[projection_lines(views.weight) == 0] = 0
    difference = sections[:, [states[1]]] - sections[:, [states[0]]]
    return Proportions(projector, views.energy, difference, volume_lines(densities[list(states)].sum(0)), data, weight)


def _even(problem: Proportions) -> F32:
    """The share of each state, the same in the whole sample, that explains the mean of the projections best."""
    ones = problem.ones()
    all_explained = float(problem.explained(problem.shown(ones)).sum(dtype=np.float64))
    mean = float(problem.explained(problem.data).sum(dtype=np.float64)) / (all_explained or 1)
    return np.float32(np.clip(mean, 0, 1)) * ones


def _smoothness(views: EnergyViews, materials: Materials, states: tuple[int, int], steps: Countdown) -> float:
    rows, grid = slice(None), materials.grid
    if grid.shape[0] == views.geometry.detector_shape[0]:
        rows, grid = trial_rows(views, grid, _ROWS)
    part = views.select(np.arange(views.geometry.n_views), rows)
    problem = share_problem(part, materials.densities[:, rows], states, grid)
    held_out = views.parted(ONE_IN) == ONE_IN // 2
    first, problem = _even(problem), replace(problem, stop=steps.stop)
    fit, judge = problem.select(np.flatnonzero(~held_out)), problem.select(np.flatnonzero(held_out))
    return smoothness(fit, judge, first, steps)[0]
