"""error_bars: estimates the standard deviation of each voxel from two refits with different weights of the
projections."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter

from recon.base.arrays import F32, some_values
from recon.base.decisions import Decisions, GoesOn
from recon.base.geometry import Geometry
from recon.base.method import Method, ReconProblem, RunControl
from recon.base.volume import Grid, Volume
from recon.methods import names_where
from recon.splatting.fit_method import Fit
from recon.voxels.direct import Fbp, direct
from recon.voxels.iterative import VoxelMethod, solve_views
from recon.voxels.methods import FistaTv, PnpDct
from recon.voxels.ordered_fista import pull_methods
from recon.voxels.projector import Projector
from recon.voxels.view_weights import density_gain

HALO = 8  # smallest number of slices on each side of a slab that its error bars need
LEAST_VIEWS = 8

_WEIGHT_CHANGE = 0.5  # one half of the projections weighs this much more, the other half this much less
_REFIT_SHARE = 0.2  # share of a method's iterations in each of the two refits
# side, in voxels, of the cube over which variances are averaged; the variance from a single voxel is uncertain by a
# factor of 1.4
_WINDOW = 7
# number of classes of the gradient; variances are averaged separately in each, because edges vary more than their
# surroundings
_CLASSES = 4
_EDGE_BLUR = 0.7  # voxels; standard deviation of the blur before the gradient
_SAMPLED_VOXELS = 2**20  # number of voxels from which the limits of the classes are computed
# decisions of the run that a refit uses again
_DECISIONS_OF_RUN = ("units", "weight", "balance", "strength", "threshold")
# name of a decision that only error bars make; it distinguishes their decisions from those of the run
_LIMITS = "limits"


@dataclass(frozen=True, eq=False)
class ErrorBars:
    """Error bars of a volume, or of a slab.

    Attributes:
        deviation: float32 [z, y, x], 1/mm.
        decided: decisions that the error bars of the other slabs of this volume must use, too.
    """

    deviation: F32
    decided: Mapping[str, Sequence[Any]]


def error_bars(
    method: Method, problem: ReconProblem, volume: Volume, decided: Mapping[str, Sequence[Any]], control: RunControl
) -> ErrorBars | None:
    """The standard deviation of each voxel of `volume`, which `method` made from the projections of `problem`.

    The projections, in the order of their angles, are assigned alternately to two halves. An iterative method continues
    from the volume twice, with fewer iterations. In the first refit, one half has weight 1.5 and the other 0.5; in the
    second refit, the weights are exchanged. Half the difference of the two refits, divided by 0.5, has the same
    variance as the noise of the volume. This is a jackknife of two groups, by weights (Shao & Tu 1995, The Jackknife
    and Bootstrap, 2.3). The error from incomplete convergence is the same in both refits and cancels. If the method is
    a Gaussian fit, the voxel method that refined its volume makes the refits. FBP is linear: half the difference of the
    FBPs of both halves is the FBP of the projections with alternating signs.

    The squared difference in a single voxel is a poor estimate of the variance. So it is averaged over 7³ voxels,
    separately in four classes of the gradient. Noise is one part of the error. The other part is the blur and the
    smoothing of the method, which refits do not show. So the result is √((a s)² + (b g)²). Here s is the deviation from
    the refits, and g is the change of the volume from voxel to voxel. `Method.error_bars` has the factors a and b. They
    were chosen on simulated scans, so that about 68 % of the true values are within one deviation (docs/error_bars.md).

    Args:
        method: the method that made the volume. A method that chooses among methods, such as `Auto`, is not allowed.
        decided: the decisions of the run, or `ErrorBars.decided` of another slab.
        control: gets the progress after each iteration, and may stop the computation there.

    Returns:
        The error bars; None if `control` stopped the computation.

    Raises:
        ValueError: error bars of the method are not calibrated, there are fewer than eight projections, or the fit
        has no voxel refinement.
    """
    geometry = problem.geometry
    if method.error_bars is None:
        known = ", ".join(names_where(lambda each: each.error_bars))
        raise ValueError(
            f"use one of the methods with calibrated error bars: {known}. The error bars of {method.name} are not "
            f"calibrated"
        )
    if geometry.n_views < LEAST_VIEWS:
        raise ValueError(
            f"error bars need at least {LEAST_VIEWS} projections, because error bars compare two halves of the "
            f"projections; got {geometry.n_views}"
        )
    method = method_on_voxels(method, decided)
    factors = method.error_bars
    assert factors is not None
    made: Mapping[str, Sequence[Any]] = {}
    classes = 1  # the noise of FBP does not depend on edges
    if not isinstance(method, VoxelMethod):
        difference = _alternating(method, problem)
    else:
        classes = _CLASSES
        refitted = _refitted(method, problem, volume, decided, control)
        if refitted is None:
            return None
        difference, made = refitted
    gradient = _gradient(volume.data)
    decide = Decisions(problem.seed, decided)
    limits = decide(_LIMITS, lambda: _limits(gradient, classes))
    np.square(difference, out=difference)
    variance = _averaged(difference, gradient, limits)
    variance *= np.float32(factors[0] ** 2)
    variance += np.square(np.multiply(gradient, np.float32(factors[1]), out=gradient), out=gradient)
    return ErrorBars(np.sqrt(variance, out=variance), {**made, **decide.made})


def method_on_voxels(method: Method, decided: Mapping[str, Sequence[Any]]) -> Method:
    """The method that makes the refits: the given method, or for a Gaussian fit, the voxel method that last refined its
    volume.

    Raises:
        ValueError: the fit has no voxel refinement.
    """
    if not isinstance(method, Fit):
        return method
    if "weight" not in decided:
        raise ValueError(
            f"error bars of {method.name} need a run with voxel refinement, but this run had no voxel refinement"
        )
    smooth, patches = (method_class(allow_negative=method.allow_negative) for method_class in (FistaTv, PnpDct))
    (levels, *_), (_, by_patches) = decided.get("materials", [[()]])[-1], decided.get("strength", [(0.0, 0)])[-1]
    return pull_methods(allow_negative=method.allow_negative)[0] if levels else patches if by_patches else smooth


def error_bars_memory(method: Method, geometry: Geometry, grid: Grid) -> int:
    """Peak memory of `error_bars` in bytes, without the projections, their weights and the volume."""
    rays, voxels = geometry.n_views * math.prod(geometry.detector_shape), math.prod(grid.shape)
    made_by = (FistaTv(), PnpDct(), *pull_methods()) if isinstance(method, Fit) else (method,)
    refits = [
        each_method.refit(_REFIT_SHARE) if isinstance(each_method, VoxelMethod) else each_method
        for each_method in made_by
    ]
    memory_of_refit = max(each_method.memory(geometry, grid, True) for each_method in refits)
    return memory_of_refit + 4 * (2 * rays + 5 * voxels)


def alternating(geometry: Geometry) -> F32:
    """Signs [view]: alternately 1 and -1, in the order of the angles."""
    order = np.argsort(np.mod(geometry.angles, geometry.period), kind="stable")
    signs = np.empty(order.size, np.float32)
    signs[order] = 1 - 2 * (np.arange(order.size) % 2)
    return signs


def _alternating(method: Method, problem: ReconProblem) -> F32:
    """Half the difference of the FBPs of both halves of the projections."""
    signed = problem.views.masked().data * alternating(problem.geometry)[:, None, None]
    bars = direct(signed, problem.geometry, problem.grid, method.filter if isinstance(method, Fbp) else "hann")
    return bars * np.float32(density_gain(problem.geometry)) if isinstance(method, Fbp) else bars


def _refitted(
    method: VoxelMethod,
    problem: ReconProblem,
    volume: Volume,
    decided: Mapping[str, Sequence[Any]],
    control: RunControl,
) -> tuple[F32, Mapping[str, Sequence[Any]]] | None:
    """Half the difference of two refits, divided by the extra weight, and the decisions of the refits. None if it was
    stopped."""
    refit = method.refit(_REFIT_SHARE)
    sweeps, begin, done = refit.iterations, control.now(), 0
    follow = decided if _LIMITS in decided else _of_run(decided, sweeps)
    known_views = problem.views.masked()
    projector, signs = Projector(problem.geometry, problem.grid), alternating(problem.geometry)[:, None, None]

    def progress(iteration: int, residual: float) -> bool:
        nonlocal done
        done += 1
        control.report_progress(done, 2 * sweeps, begin, problem.geometry.n_views, "sweeps of error bars")
        return not control.stop()

    go_on = GoesOn(progress)
    volumes: list[F32] = []
    for sign in (1, -1):
        trusted = known_views.weighed(1 + np.float32(sign * _WEIGHT_CHANGE) * signs)
        decide = Decisions(problem.seed, follow)
        refitted = solve_views(
            refit, projector, trusted, start=volume, nonnegative=not method.allow_negative, go_on=go_on,
            decide=decide,
        )  # fmt: skip
        if not go_on.going:
            return None
        follow = decide.made
        volumes.append(refitted.data)
    heavier, lighter = volumes
    deviation = heavier
    deviation -= lighter
    deviation *= np.float32(0.5 / _WEIGHT_CHANGE)
    return deviation, follow


def _of_run(decided: Mapping[str, Sequence[Any]], sweeps: int) -> dict[str, list[Any]]:
    """The decisions of a run that refits use again. If a weight changed during the run, the refits use its last
    value."""
    kept = {name: list(decided[name]) for name in _DECISIONS_OF_RUN if name in decided}
    return {name: sweeps * values[-1:] if name == "balance" else values for name, values in kept.items()}


def _gradient(volume: F32) -> F32:
    """The change from voxel to voxel [z, y, x], after a slight blur."""
    smooth = gaussian_filter(volume, _EDGE_BLUR)
    total = np.zeros_like(smooth)
    for axis, n in enumerate(smooth.shape):
        if n > 1:
            total += np.square(np.gradient(smooth, axis=axis))
    return np.sqrt(total, out=total)


def _limits(gradient: F32, classes: int) -> list[float]:
    return [
        float(limit)
        for limit in np.percentile(some_values(gradient, _SAMPLED_VOXELS), np.linspace(0, 100, classes + 1)[1:-1])
    ]


def _averaged(squares: F32, gradient: F32, limits: Sequence[float]) -> F32:
    """The mean of the squares over a window. Only voxels whose gradient is in the same class are averaged."""
    if not limits:
        out = uniform_filter(squares, _WINDOW)
    else:
        out, classes = np.empty_like(squares), np.searchsorted(limits, gradient).astype(np.uint8)
        for k in range(len(limits) + 1):
            in_class = classes == k
            total = uniform_filter(np.where(in_class, squares, np.float32(0)), _WINDOW)
            np.divide(total, uniform_filter(in_class.astype(np.float32), _WINDOW), out=out, where=in_class)
    return np.maximum(out, 0, out=out)  # rounding errors of the running sums may be below zero
