"""error_bars: the standard deviation of each voxel, from two refits that trust every other view more, and less."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter

from recon.base.arrays import F32, some_values
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import Method, ReconProblem, RunControl
from recon.base.volume import Grid, Volume
from recon.methods import names_where
from recon.splatting.fit_method import Fit
from recon.voxels.direct import Fbp, direct
from recon.voxels.iterative import VoxelMethod, Watch, solve_views
from recon.voxels.methods import FistaTv, PnpDct
from recon.voxels.ordered_fista import pull_methods
from recon.voxels.projector import Projector

HALO = 8  # Slices beside a slab, at least, that its error bars need
LEAST_VIEWS = 8

_EXTRA = 0.5  # half of the views weigh so much more, the others so much less
_SHARE = 0.2  # of a method's iterations, in each of two refits: both take half the time of its iterations
_WINDOW = 7  # voxels, a side: variances are averaged over it; one squared difference has a relative deviation of 1.4
_CLASSES = 4  # of the gradient, which are averaged apart: edges move more than what lies beside them
_EDGE = 0.7  # voxels, the blur before the gradient
_SAMPLED = 2**20  # voxels that give the limits of the classes
_OF_RUN = ("units", "weight", "balance", "strength", "threshold")  # decisions of the run that a refit follows
_LIMITS = "limits"  # the decision of the first slab's error bars that tells them from the run's


@dataclass(frozen=True, eq=False)
class ErrorBars:
    """Error bars of a volume, or of a slab.

    Attributes:
        deviation: float32 [z, y, x], 1/mm.
        decided: what the error bars of other slabs of the same volume follow.
    """

    deviation: F32
    decided: Mapping[str, Sequence[Any]]


def error_bars(
    method: Method, problem: ReconProblem, volume: Volume, decided: Mapping[str, Sequence[Any]], control: RunControl
) -> ErrorBars | None:
    """The standard deviation of each voxel of `volume`, made by `method` from the views of `problem`.

    The views, in the order of their angles, are parted into two halves, every other view in each. An iterative method
    goes on from the volume twice, for fewer iterations: one half weighs 1.5 and the other 0.5, then the reverse.
    Half the difference, divided by 0.5, has the variance of the noise. That is a jackknife of two groups, by weights
    (Shao & Tu 1995, The Jackknife and Bootstrap, 2.3). What both refits have in common cancels: how far the volume is
    from convergence. The volume of a fit is refitted by the method on voxels that made it, or that refined it. FBP is
    linear: half the difference of the FBPs of both halves is FBP of the views with alternating signs.

    One squared difference is a poor variance. It is averaged over 7³ voxels, in four classes of the gradient apart.
    Noise is one part of the error, and the blur and the smoothing of the method are the other, which no refit shows.
    So the result is √((a s)² + (b g)²), where s is the deviation by the refits and g the change of the volume from
    voxel to voxel. `Method.error_bars` has a and b. They were chosen on simulated scans, so that about 68 %
    of the true voxels are within one deviation (docs/error_bars.md).

    Args:
        method: that made the volume; no choice of methods.
        decided: decisions of the run, or `ErrorBars.decided` of another slab.
        control: gets each sweep, and is asked after it whether to stop.

    Returns:
        None where `control` ended it.

    Raises:
        ValueError: a method without calibrated error bars, fewer than eight views, or a fit without a finish.
    """
    geometry = problem.geometry
    if method.error_bars is None:
        known = ", ".join(names_where(lambda each: each.error_bars))
        raise ValueError(f"the error bars of {method.name} are not calibrated; those of these methods are: {known}")
    if geometry.n_views < LEAST_VIEWS:
        raise ValueError(
            f"error bars split the views into two halves: at least {LEAST_VIEWS} views are needed, "
            f"got {geometry.n_views}"
        )
    method = method_on_voxels(method, decided)
    factors = method.error_bars
    assert factors is not None
    made: Mapping[str, Sequence[Any]] = {}
    classes = 1  # the noise of FBP knows no edges
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
    """The method whose refits show the noise: for a fit, the one that made its volume or the last steps of its finish.

    Raises:
        ValueError: a fit without a finish.
    """
    if not isinstance(method, Fit):
        return method
    if "weight" not in decided:
        raise ValueError(f"error bars of {method.name} need its finish on voxels, and there was none")
    smooth, patches = (one(allow_negative=method.allow_negative) for one in (FistaTv, PnpDct))
    (levels, *_), (_, by_patches) = decided.get("materials", [[()]])[-1], decided.get("strength", [(0.0, 0)])[-1]
    return pull_methods(allow_negative=method.allow_negative)[0] if levels else patches if by_patches else smooth


def error_bars_memory(method: Method, geometry: Geometry, grid: Grid) -> int:
    """Peak memory of `error_bars` in bytes, without the projections, their weights and the volume."""
    rays, voxels = geometry.n_views * math.prod(geometry.detector_shape), math.prod(grid.shape)
    made_by = (FistaTv(), PnpDct(), *pull_methods()) if isinstance(method, Fit) else (method,)
    work = max(one.memory(geometry, grid, True) for one in made_by)
    return work + 4 * (2 * rays + 5 * voxels)


def alternating(geometry: Geometry) -> F32:
    """[view]: 1 and -1 alternating in the order of the angles."""
    order = np.argsort(np.mod(geometry.angles, geometry.period), kind="stable")
    signs = np.empty(order.size, np.float32)
    signs[order] = 1 - 2 * (np.arange(order.size) % 2)
    return signs


def _alternating(method: Method, problem: ReconProblem) -> F32:
    """Half the difference of the FBPs of both halves of the views."""
    signed = problem.views.masked().data * alternating(problem.geometry)[:, None, None]
    return direct(signed, problem.geometry, problem.grid, method.filter if isinstance(method, Fbp) else "hann")


def _refitted(
    method: VoxelMethod,
    problem: ReconProblem,
    volume: Volume,
    decided: Mapping[str, Sequence[Any]],
    control: RunControl,
) -> tuple[F32, Mapping[str, Sequence[Any]]] | None:
    """Half the difference of two refits, divided by the extra weight of a half, and their decisions; None: stopped."""
    refit = method.refit(_SHARE)
    sweeps, begin, done, stopped = refit.iterations, control.now(), 0, False
    follow = decided if _LIMITS in decided else _of_run(decided, sweeps)
    given = problem.views.masked()
    projector, signs = Projector(problem.geometry, problem.grid), alternating(problem.geometry)[:, None, None]

    def told(iteration: int, residual: float) -> bool:
        nonlocal done, stopped
        done += 1
        control.report_progress(done, 2 * sweeps, begin, problem.geometry.n_views, "sweeps of error bars")
        stopped = stopped or control.stop()
        return stopped

    volumes: list[F32] = []
    for sign in (1, -1):
        trusted = given.weighed(1 + np.float32(sign * _EXTRA) * signs)
        decide = Decisions(problem.seed, follow)
        refitted = solve_views(
            refit, projector, trusted, start=volume, nonnegative=not method.allow_negative, watch=Watch(told),
            decide=decide, wide=problem.wide,
        )  # fmt: skip
        if stopped:
            return None
        follow = decide.made
        volumes.append(refitted.data)
    more, less = volumes
    more -= less
    more *= np.float32(0.5 / _EXTRA)
    return more, follow


def _of_run(decided: Mapping[str, Sequence[Any]], sweeps: int) -> dict[str, list[Any]]:
    """The decisions of a run that refits follow; a weight that changed along the run stays the last one."""
    kept = {name: list(decided[name]) for name in _OF_RUN if name in decided}
    return {name: sweeps * made[-1:] if name == "balance" else made for name, made in kept.items()}


def _gradient(volume: F32) -> F32:
    """The change from voxel to voxel [z, y, x], after a slight blur."""
    smooth = gaussian_filter(volume, _EDGE)
    total = np.zeros_like(smooth)
    for axis, n in enumerate(smooth.shape):
        if n > 1:
            total += np.square(np.gradient(smooth, axis=axis))
    return np.sqrt(total, out=total)


def _limits(gradient: F32, classes: int) -> list[float]:
    return [
        float(limit) for limit in np.percentile(some_values(gradient, _SAMPLED), np.linspace(0, 100, classes + 1)[1:-1])
    ]


def _averaged(squares: F32, gradient: F32, limits: Sequence[float]) -> F32:
    """The mean of the squares over a window, of the voxels between the same limits of the gradient alone."""
    if not limits:
        out = uniform_filter(squares, _WINDOW)
    else:
        out, classes = np.empty_like(squares), np.searchsorted(limits, gradient).astype(np.uint8)
        for k in range(len(limits) + 1):
            here = classes == k
            total = uniform_filter(np.where(here, squares, np.float32(0)), _WINDOW)
            np.divide(total, uniform_filter(here.astype(np.float32), _WINDOW), out=out, where=here)
    return np.maximum(out, 0, out=out)  # sums that run along a line end a little below zero
