"""Fits the volume of a state of the sample: the moved reference plus a change that has few edges.

    min over x, u, g of  ½ |A x - p|² + μ Σ_i (a_i |D x|_i + b_i |D (x - m(u, g))|_i),    x >= 0

m is the reference, moved by u and with a gain g for each particle. x, g and u are improved one after the other: x by
`ordered_fista`, g from medians of x, u from the projections. (Chen, Tang & Leng 2008, Med. Phys. 35, 660; with the
motion: Dang et al. 2014, Phys. Med. Biol. 59, 4799; weights that fall: Candès, Wakin & Boyd 2008, J. Fourier Anal.
Appl. 14, 877.)
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage as ndi

from recon.base.arrays import F32
from recon.base.decisions import GoesOn
from recon.features.reference.motion import KNOTS, Basis, MotionViews, Moved, improved
from recon.features.reference.weights import falling
from recon.kernels.cpu.two_tv import ascend, pace_of, primal
from recon.voxels.half_voxels import DUAL_STEPS, on_half_voxels, repeated
from recon.voxels.ordered_fista import SUBSETS, Subsets, ordered_fista, subsets_of
from recon.voxels.priors import TvWeight
from recon.voxels.voxel_problem import VoxelProblem, difference_weights

OWN = 0.3
"""Weight of the total variation of the volume, divided by the weight of the total variation of the change."""
_STEPS = 6  # dual steps of each proximal step; with three dual steps, damped steps do not converge
_EDGE_SLOPE = 0.12  # slope of the moved reference, in particle levels per voxel, above which a voxel belongs to an edge
PLAN: tuple[tuple[tuple[int, float], ...], ...] = (((4, 1), (4, 1)), ((6, 0.5), (6, 0)), ((KNOTS, 0), (KNOTS, 0)))
"""The rounds. Each round lists the steps of the motion, with the number of intervals of the splines and the blur in
voxels.
"""
# iterations of a volume within the rounds, and relative change below which it has converged
_MOST_ITERATIONS, _CONVERGED_CHANGE = 12, 2e-3


class TwoVariations:
    """argmin_y ½|y - x|² + threshold Σ_i (a_i |D y|_i + b_i |D (y - m)|_i), y >= 0: the `Prox` of a state.

    The dual fields are kept from one call to the next, also if m changes. Memory: 8 volumes in addition to m, a and b.
    """

    def __init__(
        self, shape: tuple[int, ...], weights: tuple[float, float, float], nonnegative: bool, steps: int = _STEPS
    ) -> None:
        self._weights, self._nonnegative, self._steps = weights, nonnegative, steps
        self._fields = np.zeros((3, *shape), np.float32), np.zeros((3, *shape), np.float32)
        self._start, self._to_reference = np.empty(shape, np.float32), np.empty(shape, np.float32)
        self.m = self.own = self.change = self._start

    def copy(self) -> TwoVariations:
        """A copy with separate dual fields."""
        other = TwoVariations(self._start.shape, self._weights, self._nonnegative, self._steps)
        other._fields = self._fields[0].copy(), self._fields[1].copy()
        return other

    def about(self, m: F32, own: F32, change: F32) -> None:
        """Set m and the weights a (`own`) and b (`change`), all [y, x, z]."""
        self.m, self.own, self.change = m, own, change

    def __call__(self, x: F32, threshold: float) -> None:
        """Replace x [y, x, z] by the proximal point."""
        if threshold <= 0:
            np.maximum(x, 0, out=x, where=self._nonnegative)
            return
        self._start[...] = x
        results = x, self._to_reference
        arguments = self._start, self._fields, self.m, threshold, self._weights, self._nonnegative, results
        step_length = pace_of(threshold, self._weights)
        primal(*arguments)
        for _ in range(self._steps):
            ascend(x, self.own, step_length, self._weights, self._fields[0])
            ascend(self._to_reference, self.change, step_length, self._weights, self._fields[1])
            primal(*arguments)

    def turn(self) -> None:
        """Does nothing: the differences are always those to the next voxels."""


@dataclass(eq=False)
class StateFit:
    """The fit of a state: volume, gains and motion are improved one after the other.

    Attributes:
        problem: the projections of the state.
        moved: the reference with its present motion and gains.
        x: the present volume [y, x, z].
        weight: μ, the weight of the total variation of the change.
        width: width of the field of view in the units of the problem; the intervals of the splines divide this width.
        rounds: number of rounds of the volume with weights that fall, see `sharpen`.
    """

    problem: VoxelProblem
    moved: Moved
    x: F32
    weight: float
    width: float
    going: GoesOn = field(init=False)

    def __post_init__(self) -> None:
        problem = self.problem
        self.going = problem.go_on
        self._subsets = Subsets.of(problem, subsets_of(problem.projector.geometry, SUBSETS, True), True)
        self._prox = TwoVariations(self.x.shape, difference_weights(problem.projector.grid), problem.nonnegative)
        self._views = MotionViews.of(problem)
        self._done = 0
        self.m = self.moved.volume()
        self.known = self.moved.known()

    def again(self, weight: float, x: F32, moved: Moved | None = None) -> StateFit:
        """A copy of the fit with another weight and volume, and with another position of the reference if `moved` is
        given.
        """
        copied = copy(self)
        copied.weight, copied.x, copied.moved = weight, x.copy(), moved or self.moved
        copied._prox = self._prox.copy()
        copied.m, copied.known = (self.m, self.known) if moved is None else (moved.volume(), moved.known())
        return copied

    def alone(self) -> None:
        """Leave out the reference. Both weights then apply to the total variation of x."""
        self.m, self.known = np.zeros_like(self.m), np.ones_like(self.known)

    def solve(self, own: F32 | float = 1.0, change: F32 | float = 1.0, iterations: int = _MOST_ITERATIONS) -> None:
        """Improve x. `own` and `change` are factors [y, x, z] on the two weights."""
        if not self.going.going:
            return
        self._prox.about(self.m, *self._weights(own, change))
        done_before = self._done

        def go_on(sweep: int, residual: float) -> bool:
            self._done = done_before + sweep
            return self.going(self._done, residual)

        self.x = ordered_fista(
            replace(self.problem, go_on=GoesOn(go_on)), self.x, TvWeight(self.weight), self._subsets, sweeps=iterations,
            prox=self._prox, still=_CONVERGED_CHANGE,
        )  # fmt: skip

    def _weights(self, own: F32 | float, change: F32 | float) -> tuple[F32, F32]:
        """The weights a and b [y, x, z], for these factors on the two weights."""
        own, change = (np.broadcast_to(np.asarray(w, np.float32), self.x.shape) for w in (own, change))
        # In voxels that the reference does not show, and in differences to such voxels, both weights apply to x.
        inner = ndi.binary_erosion(self.known, border_value=1)
        a = np.where(inner, np.float32(OWN) * own, np.float32(OWN + 1) * own).astype(np.float32)
        return a, np.where(inner, change, np.float32(0)).astype(np.float32)

    def follow(self, steps: Sequence[tuple[int, float]]) -> None:
        """Improve the gains from x, then the motion from the projections.

        The difference of x from m counts as a change of the sample and not as motion, except at edges of m, where
        motion that was not found yet looks like a change.
        """
        self.moved = replace(self.moved, gains=gains_of(self.x, self.moved))
        m, slopes = self.moved.with_slopes(self.moved.at_rest)
        assert slopes is not None
        known = self.moved.known()
        is_steep = np.sqrt(np.square(slopes).sum(0)) > _EDGE_SLOPE * self.moved.particles.level
        edge = ndi.maximum_filter(is_steep & known, (3, 3, 1))
        additional = np.where(edge, 0, self.x - m * known).astype(np.float32)
        for intervals, blur in steps:
            basis = Basis.splines(self.problem.projector.grid, self.width, intervals)
            self.moved = improved(self._views, self.moved, basis, blur, additional, False)
        self.m, self.known = self.moved.volume(), self.moved.known()

    def rounds(self, plan: Sequence[Sequence[tuple[int, float]]], iterations: int = _MOST_ITERATIONS) -> None:
        """Improve the volume and the motion of the reference alternately, with at most `iterations` iterations in each
        round.
        """
        self.solve(iterations=iterations)
        for steps in plan:
            if not self.going.going:
                return
            self.follow(steps)
            self.solve(iterations=iterations)

    def sharpen(self, rounds: int, lines_from: float, iterations: int = _MOST_ITERATIONS) -> None:
        """Improve the volume in rounds in which the weights are lower where the change is steep, and along dark lines
        in particles. `lines_from` is explained in `falling`.
        """
        for _ in range(rounds):
            own, change = falling(self.problem, self.moved, self.x, self.m, lines_from)
            self.solve(own, change, iterations)

    def on_half_voxels(self, lines_from: float, iterations: int = _MOST_ITERATIONS) -> int:
        """Improve the volume once more as `sharpen` does, but on half voxels, see `recon.voxels.half_voxels`.

        The moved reference and the weights are the same in the four half voxels of a voxel. This ends the fit: the
        memory of the whole voxels is given back.

        Returns:
            The number of iterations; 0 if the fit was stopped before.
        """
        if not self.going.going:
            return 0
        del self._prox

        def prox_of(fine: VoxelProblem) -> TwoVariations:
            own, change = self._weights(*falling(self.problem, self.moved, self.x, self.m, lines_from))
            m, weights = repeated(self.m), difference_weights(fine.projector.grid)
            prox = TwoVariations(m.shape, weights, fine.nonnegative, DUAL_STEPS * _STEPS)
            prox.about(m, repeated(own), repeated(change))
            return prox

        self.x = on_half_voxels(
            self.problem, self.x, self.weight, prox_of, done=self._done, sweeps=iterations, still=_CONVERGED_CHANGE
        )
        ended = self.problem.decide.ended
        return 0 if ended is None else ended.after


def gains_of(x: F32, moved: Moved) -> NDArray[np.float64]:
    """The gains of the ground and of the particles in a volume. They are medians, so cracks and pores do not affect
    them.

    A particle that has disappeared gets 0.
    """
    own, label, gains = moved.particles, moved.labels(), moved.gains.copy()
    ground, excess, known = moved.pulled(own.ground), moved.pulled(own.above), moved.known()
    clear_ground = known & (excess < 0.1 * own.level) & (ground > 0.8 * own.ground.max())
    if own.base > 0 and clear_ground.any():
        gains[0] = np.median(x[clear_ground] / ground[clear_ground])
    label = np.where(known, label, 0)
    order = np.argsort(label, axis=None, kind="stable")
    first_of_label = np.searchsorted(label.ravel()[order], np.arange(gains.size + 1))
    flat, high, low = x.ravel(), excess.ravel(), ground.ravel()
    for k in range(1, gains.size):
        voxels = order[first_of_label[k] : first_of_label[k + 1]]
        a = high[voxels]
        if a.size > 4 and (top := 0.75 * np.percentile(a, 90)) > 0:
            voxels, a = voxels[a > top], a[a > top]
            gains[k] = np.median((flat[voxels] - gains[0] * low[voxels]) / a)
    return np.maximum(gains, 0)
