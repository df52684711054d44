"""FISTA with ordered subsets and total variation, which ends when the volume has converged.

    min ½||A x - p||² + μ TV(x), x >= 0

The steps of the first sweeps (passes over all projections) use subsets of the projections. They converge faster by
about the number of subsets, but only to the neighbourhood of the minimum. The steps of the later sweeps use all
projections and converge to the minimum (Kim, Ramani & Fessler 2015, IEEE Trans. Med. Imaging 34, 167; Beck & Teboulle
2009, SIAM J. Imaging Sci. 2, 183; O'Donoghue & Candès 2015). Steps are damped if this saves time, see
`recon.voxels.damping`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.empirical import STANDS_STILL
from recon.base.geometry import Geometry
from recon.base.registry import MethodEntry, in_folders, loaded
from recon.voxels.damping import Damping, largest_damped
from recon.voxels.devices import LineProjector, projector_on, voxel_device
from recon.voxels.priors import TvWeight
from recon.voxels.projector import Projector
from recon.voxels.standstill import Standstill
from recon.voxels.view_weights import angular_weights
from recon.voxels.voxel_problem import (
    Momentum,
    VoxelProblem,
    interleaved,
    largest_eigenvalue,
    sampled_views,
    whitened,
)

SUBSETS, MANY_SUBSETS = 3, 9
"""Largest number of subsets: for sweeps until the volume has converged, and for a fixed number of sweeps."""
_LEAST_OF_SUBSET, _LEAST_OF_MANY = 15, 12  # smallest number of projections in a subset, see `SUBSETS`
# Subsets save time and do not change the volume at which the damped steps end. With one subset, 30 projections need 45
# sweeps instead of 31, and 180 projections 29 instead of 23, with 0 to 15 % more CPU time. With subsets up to the end:
# -0.1 to -1.0 dB.
# number of sweeps, and number of projections in sweeps, that use subsets: the larger of the two counts
_LEAST_ON_SUBSETS, _VIEWS_ON_SUBSETS = 6, 540
_MOST_MOMENTUM = 0.9
"""Largest momentum of damped steps.

A larger one accumulates the errors of the proximal steps. With three dual steps in each, and air that weighs five times
as much as the sample, the volume then never converges: it changes by 1 % in four sweeps.
"""
_LEAST_PACE = 0.5
"""Steps are damped only if the damped step of the coarsest shapes is at least this share of their step without damping.

The share is small if single rays weigh much more than others. Then 60 damped sweeps end farther from the minimum than
20 sweeps without damping. (It is 0.9 without weights, and 0.6 if the sample is three times as wide as the field of
view.)
"""
# smallest covered share of 180° with which steps are damped, because the coarse shapes of a missing wedge converge last
_LEAST_COVERED = 0.9


@dataclass(frozen=True, eq=False)
class Subsets:
    """Subsets of the projections of a problem. All runs with the same projections and weights can share them.

    Attributes:
        views: indices of the projections, for each subset.
        projectors: projector of each subset.
        step: 1 / L, where L is the largest eigenvalue of AᵀWA of the subset with the largest weight, with all columns.
        plain_norm: the same eigenvalue for the projector without sharpening.
        to_the_end: True: the sweeps end when the volume has converged; False: after a fixed number.
        damping: damping of the steps from a subset; its gain is 1 if steps are not damped.
        damped_step: like `step`, for damped steps and the columns of the problem.
        damping_of_all: damping of the steps from all projections.
    """

    views: Sequence[NDArray[np.intp]]
    projectors: Sequence[Projector]
    step: float
    plain_norm: float
    to_the_end: bool
    damping: Damping
    damped_step: float
    damping_of_all: Damping

    @classmethod
    def of(cls, problem: VoxelProblem, count: int, to_the_end: bool = True) -> Subsets:
        """Subsets, at most `count` of them, see `subsets_of`.

        Steps are damped if the sweeps continue until the volume has converged, and if damping saves time."""
        projector, weight = problem.projector, problem.weight
        views = interleaved(projector, count)
        projectors = [projector] if count == 1 else [projector.subset(some) for some in views]
        rays = [None if weight is None else weight[some] for some in views] if count > 1 else [weight]
        heaviest = 0
        if weight is not None:
            heaviest = int(np.argmax([0.0 if some is None else float(some.sum(dtype=np.float64)) for some in rays]))
        norm = largest_eigenvalue(projectors[heaviest].plain, rays[heaviest])
        step = own = 1 / (norm * max(part.gain(some) for part, some in zip(projectors, rays, strict=True)))
        if problem.with_all_columns is not None:
            step = cls.of(problem.with_all_columns(), count, to_the_end=False).step
        nz, ny, nx = projector.grid.shape
        undamped = Damping((ny, nx, nz), 1.0)
        subsets = cls(views, projectors, step, norm, to_the_end, undamped, step, undamped)
        of_subset, of_all = (Damping.of(undamped.shape, n) for n in (len(views[heaviest]), projector.geometry.n_views))
        covered = float(angular_weights(projector.geometry.angles).sum()) / math.pi
        if not to_the_end or of_subset.gain == 1 or covered < _LEAST_COVERED:
            return subsets
        longest = 1 / largest_damped(projectors[heaviest], rays[heaviest], of_subset)
        if longest == 0 or longest < _LEAST_PACE * own:  # 0: no ray crosses the box
            return subsets
        return replace(subsets, damping=of_subset, damped_step=longest, damping_of_all=of_all)

    @property
    def is_damped(self) -> bool:
        return self.damping_of_all.gain > 1


def subsets_of(geometry: Geometry, most: int = SUBSETS, to_the_end: bool = True) -> int:
    """Number of subsets, at most `most`. Each subset has at least `_LEAST_OF_SUBSET` projections.

    With a fixed number of sweeps, each subset has at least twelve projections. From twelve projections on there are at
    least two subsets, because with one subset these sweeps stop far from the minimum.
    """
    if to_the_end:
        return max(1, min(most, geometry.n_views // _LEAST_OF_SUBSET))
    whole = geometry.n_views // _LEAST_OF_MANY
    return max(1, min(most, max(whole, 2) if whole else 1))


RENEWED = 2
"""The volume towards which steps are pulled is recomputed after this number of sweeps."""


# methods with a pull that held-out projections may prefer, also for the voxel refinement of a fit; see `Discrete`
PULLS: dict[str, MethodEntry] = in_folders("recon.features", "PULLS")


def pull_methods(**settings: Any) -> list[Any]:
    """The methods in `PULLS`, with these settings."""
    return [getattr(loaded(entry.module), entry.cls)(**settings) for entry in PULLS.values()]


class Pull(Protocol):
    """Computes a volume z from x. Each step of `ordered_fista` moves x towards z by a share of the distance.

    Attributes:
        share: the factor c in c (z - x), for a step without damping.
    """

    @property
    def share(self) -> float: ...

    def target(self, x: F32) -> F32:
        """The volume z [y, x, z] for a volume x, which is not changed."""


class Prox(Protocol):
    """The proximal step of a prior: `TotalVariationProx`, or one that compares x with another volume."""

    def __call__(self, x: Any, threshold: float) -> None:
        """Replace x [y, x, z], an array of the device, by the proximal point of threshold times the prior."""

    def turn(self) -> None:
        """Called after each step, see `TotalVariationProx.turn`."""


@dataclass(frozen=True, eq=False)
class _Part:
    """The projections that a step uses: their projector, and their numbers or all of them."""

    projector: LineProjector[Any]
    views: NDArray[np.intp] | slice


class _Descent:
    """The state of `ordered_fista`: the volume, its momentum, the proximal step, and what a step needs.

    Attributes:
        x: [y, x, z], on the device.
        error: Σ weight (A x - p)² of the last sweep, each projection before its step.
        seen: whitened residuals of some projections of the last sweep.
    """

    def __init__(self, problem: VoxelProblem, x: F32, subsets: Subsets, prox: Prox, pull: Pull | None) -> None:
        device = self._device = voxel_device(problem.projector.device)
        self._prox = prox
        self._data, self._rays = device.array(problem.data), None
        if problem.weight is not None:
            self._rays = device.array(problem.weight)
        self._all = _Part(projector_on(device, problem.projector), slice(None))
        of_subsets = zip(subsets.projectors, subsets.views, strict=True)
        self._parts = [_Part(projector_on(device, part), views_of_subset) for part, views_of_subset in of_subsets]
        if len(self._parts) == 1:
            self._parts = [self._all]
        self._subsets, self._pull, self._problem = subsets, pull, problem
        self.x = device.array(x)
        largest_momentum = _MOST_MOMENTUM if subsets.is_damped else 1.0
        self._gradient, self._ahead = device.copy(self.x), Momentum(self.x, problem.decide, device, largest_momentum)
        self._slope: Any = None  # cells of the gradient of the prior (total variation and x >= 0) at the last point
        self._target: Any = None
        self.error, self.seen = 0.0, list[F32]()

    def renew_target(self) -> None:
        """Recompute the volume towards which steps are pulled."""
        if self._pull is not None:
            self._target = self._device.array(self._pull.target(self._device.numpy(self.x)))

    def sweep(self, weight: TvWeight, on_subsets: bool, looked_at: bool) -> None:
        """One pass over all projections. `go_ahead` adds the momentum after its last step."""
        self.error, self.seen = 0.0, []
        parts = self._parts if on_subsets else [self._all]
        count, subsets = len(parts), self._subsets
        damping, share = (subsets.damping, 1.0) if on_subsets else (subsets.damping_of_all, 1 / len(self._parts))
        mu = weight.value / count
        for step, s in enumerate(self._problem.rng.permutation(count)):
            self._residual(parts[s], count, looked_at)
            self._step(mu, count, damping, subsets.step * share, subsets.damped_step * share)
            if step + 1 < count:
                self._ahead(self.x)

    def go_ahead(self) -> None:
        """Add the momentum to the volume: the start of the next step."""
        self._ahead(self.x)

    def _residual(self, part: _Part, count: int, looked_at: bool) -> None:
        """Write the negative gradient for these projections into `_gradient`."""
        device, residual = self._device, part.projector.forward_lines(self.x)
        data, rays = self._data[part.views], None if self._rays is None else self._rays[part.views]
        self.error += device.replace_by_residual(data, residual, rays)
        if looked_at:
            sampled = sampled_views(count, len(residual))
            unweighted = np.array(device.numpy(residual[sampled]))
            self.seen.append(whitened(unweighted, None if rays is None else device.numpy(rays[sampled])))
        if rays is not None:
            residual *= rays
        part.projector.adjoint_lines(residual, self._gradient)

    def _step(self, mu: float, count: int, damping: Damping, step: float, damped_step: float) -> None:
        """One step: x <- proximal point of the prior after a gradient step; see `ordered_fista`."""
        device, x, length = self._device, self.x, damping.gain * damped_step
        if self._pull is not None:
            pull = self._pull.share / step
            device.combine(1.0, self._gradient, pull, self._target, self._gradient)
            device.combine(1.0, self._gradient, -pull, x, self._gradient)
            length /= 1 + length * pull
        if damping.gain > 1:
            cells = damping.cells(device, self._gradient)
            if self._slope is not None:
                cells -= self._slope * np.float32(1 / count)
            damping.take_off(device, self._gradient, cells)
        device.combine(1.0, x, length, self._gradient, x)
        cells_before = damping.cells(device, x) if damping.gain > 1 else None
        self._prox(x, mu * length)
        self._prox.turn()
        if cells_before is not None:
            self._slope = cells_before
            self._slope -= damping.cells(device, x)
            self._slope *= np.float32(count / length)

    @property
    def volume(self) -> F32:
        return self._device.numpy(self.x)


def ordered_fista(
    problem: VoxelProblem, x: F32, weight: TvWeight, subsets: Subsets, *, sweeps: int, prox: Prox,
    pull: Pull | None = None, still: float = STANDS_STILL,
) -> F32:  # fmt: skip
    """min ½||A x - p||² + μ TV(x), x >= 0, by sweeps until the volume has converged.

        x <- prox_{gain t μ TV}(x + gain t (g - L (g - v))),    g = A_sᵀ W (p_s - A_s x), downhill

    with m subsets s of the projections, μ / m instead of μ, and t the safe step of gain (1 - L) AᵀWA of a subset. v is
    μ times the slope of total variation at the last point, from the last proximal step. When the volume has converged,
    g = v, so that the steps end at the minimum for any L. Without damping (gain 1, L = 0) these are the steps of FISTA.
    After `_VIEWS_ON_SUBSETS` projections, but at least six sweeps, each damped step uses all projections. Steps without
    damping always use subsets. The sweeps end when four of them together change the volume by less than `still` of its
    norm; `problem.decide.ended` says how. If `subsets` are for a fixed number of sweeps, there are `sweeps` of
    them. Memory: 8 volumes, 2 x the projections.

    Args:
        x: [y, x, z], not zero; overwritten.
        weight: μ; if it follows the noise, it is adapted after each sweep.
        sweeps: largest number of sweeps.
        prox: proximal step of the prior, such as `tv_prox` for total variation.
        pull: adds c (z - x) to each step, so that β/2 |x - z|² with β = c L is also minimised.
        still: share of the norm of the volume; 0: all sweeps are made.
    """
    descent, scale, count = _Descent(problem, x, subsets, prox, pull), problem.scale, len(subsets.views)
    n_views = problem.projector.geometry.n_views
    first = 0 if count == 1 else max(_LEAST_ON_SUBSETS, math.ceil(_VIEWS_ON_SUBSETS / n_views))
    standstill = Standstill(
        problem.decide, still, voxel_device(problem.projector.device), first, from_rest=not subsets.is_damped
    )
    for k in range(sweeps):
        if k % RENEWED == 0:
            descent.renew_target()
        on_subsets = k < first or not subsets.is_damped
        descent.sweep(weight, on_subsets, weight.by_noise)
        if weight.by_noise:
            weight.value = problem.decide("balance", partial(weight.after_sweep, np.concatenate(descent.seen)))
        going = problem.go_on(k + 1, math.sqrt(descent.error) / scale)
        if standstill.ends(descent.x, k + 1, going) if subsets.to_the_end else not going:
            break
        if k + 1 < sweeps:
            descent.go_ahead()
    if subsets.to_the_end:
        standstill.report()
    return descent.volume
