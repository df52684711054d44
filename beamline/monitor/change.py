"""Change: the difference between a projection and earlier ones that the rotation of the sample does not explain.

The last four projections predict each cell of the next one: depth + velocity. The difference from this prediction is
fitted by least squares with four causes: a different intensity everywhere (gain), a displaced sample (across, down),
and a step of the stage that differs from the steps before (turn). The model of the fit is: d depth = -gain - across
d/dx - down d/dy + turn velocity. All cells are used, so that the error of each result is 10 to 100 times smaller than
the noise of a cell. In the first pass, the weight of a cell depends on its distance from the median change; in the
second pass, on its residual in the first pass (Huber 1964). Therefore a loose particle, a zinger or a band hardly
affects the fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.view import CellGrid, CellValues, CellView
from recon.base.arrays import median_deviation

SPAN = 4  # number of previous projections; the velocity is the mean of their three steps
HUBER = 2.0  # standard deviations of the residual up to which a cell has its full weight
SAMPLED = 5  # every fifth cell is enough to estimate a spread
LEAST_VARYING = 0.1  # share of the change by a shift that must differ from row to row
MOST_STEPS = 4  # largest gap in steps; after a longer gap, velocities are not known


@dataclass(frozen=True, eq=False)
class SampleChange:
    """The change of a projection relative to the projection before."""

    gain: float  # relative change of the intensity, equal in all cells
    # across, down: displacement of the sample in pixels of the frame, to the right and downwards
    across: float
    down: float
    turn: float  # excess rotation of the stage, in steps; NaN if no rotation is visible
    residual: CellValues  # float32 [row, col], change of the depth that these causes do not explain
    # robust standard deviation of the residual times the square root of the weight, over the cells with beam
    noise: float
    # [cause, row, col], [row, col]: change for a shift of one pixel across, of one pixel down and for one step of the
    # stage; and the weights
    basis: CellValues | None = None
    weight: CellValues | None = None
    sigma: tuple[float, float] = (0.0, 0.0)  # pixels, standard deviations of `across` and `down` because of noise
    steps: float = 1.0  # steps since the previous projection

    def beside_columns(self) -> tuple[float, float, float] | None:
        """Shift across, shift down and turn, computed from differences between rows; None if the rows are too similar.

        A change that is as high as the frame, such as a moving shadow, is the same in all rows of a column. Unlike the
        motion of a sample, it has no effect here.
        """
        if self.basis is None or self.weight is None or min(self.residual.shape) < 2:
            return None
        weight = self.weight[:, 1:-1]
        sums = np.maximum(weight.sum(axis=0), np.float32(1e-12))
        whole = self.basis[:, :, 1:-1]
        basis, residual = (x - (weight * x).sum(axis=-2, keepdims=True) / sums for x in (whole, self.residual[:, 1:-1]))
        weighted = (basis * weight).reshape(3, -1).astype(np.float64)
        normal = weighted @ basis.reshape(3, -1).T
        if (np.diag(normal)[:2] < LEAST_VARYING * (whole**2 * weight).sum(axis=(1, 2))[:2]).any() or not normal.any():
            return None
        normal += np.diag(1e-9 * np.diag(normal) + 1e-12)
        across, down, turn = np.linalg.solve(normal, weighted @ residual.ravel()).tolist()
        return self.across + across, self.down + down, self.turn + turn


def change_of(view: CellView, before: Sequence[CellView], grid: CellGrid) -> SampleChange | None:
    """Change of a projection relative to earlier ones (oldest first); None if there are not SPAN of them at equal
    steps."""
    if len(before) < SPAN:
        return None
    last = before[-SPAN:]
    steps = _steps(view, last)
    if steps is None:
        return None
    # A change of the gain must not count as a velocity.
    gained = np.float32(sum(step.brighter for step in last[1:]))
    weight = np.minimum(view.weight, last[-1].weight)
    velocity = (last[-1].depth - last[0].depth + gained) * np.float32(steps / 3)
    change = view.depth - last[-1].depth - velocity
    # Half a step back, because `change` compares a projection with the previous one: the gradient belongs to the middle
    # between them.
    image = _smooth((last[-1].depth + last[-2].depth) * np.float32(0.5) + velocity)
    right, below = (np.gradient(image, axis=axis) if image.shape[axis] > 1 else np.zeros_like(image) for axis in (1, 0))
    basis = np.stack([np.ones_like(image), -right, -below, _smooth(velocity)])
    solution, variances = _fit(basis, _smooth(change), weight)
    residual = np.where(weight > 0, change - np.tensordot(solution.astype(np.float32), basis, 1), np.float32(0))
    noise = _spread(residual, weight) or 0.0
    units = np.array([1.0, grid.cell, grid.cell, 1 / steps])  # from cells to pixels, and from projections to steps
    gain, across, down, turn = (solution * units).tolist()
    _, sigma_across, sigma_down, _ = (np.sqrt(variances) * noise * units).tolist()
    basis, sigma = np.asarray(basis[1:] / units[1:, None, None], np.float32), (sigma_across, sigma_down)
    return SampleChange(math.expm1(-gain), across, down, turn, residual, noise, basis, weight, sigma, steps)


def _steps(view: CellView, last: Sequence[CellView]) -> float | None:
    """Number of steps since the previous projection: 1, or more if projections in between were not used. None if the
    angles are uneven."""
    usual = (last[-1].angle - last[0].angle) / (SPAN - 1)
    if not math.isfinite(usual) or usual == 0:
        return 1.0 if view.angle == last[-1].angle or not math.isfinite(view.angle) else None
    inner = [after.angle - before.angle for before, after in pairwise(last)]
    if max(abs(step / usual - 1) for step in inner) > 0.5:
        return None
    steps = (view.angle - last[-1].angle) / usual
    return steps if 0.5 < steps < MOST_STEPS + 0.5 else None


def _smooth(image: CellValues) -> CellValues:
    """Binomial filter 1 2 1 along both axes; values are mirrored at the edges of the frame."""
    wide = np.pad(image, 1, mode="edge")
    rows = 0.25 * (wide[:-2] + wide[2:]) + 0.5 * wide[1:-1]
    return np.asarray(0.25 * (rows[:, :-2] + rows[:, 2:]) + 0.5 * rows[:, 1:-1])


def _spread(change: CellValues, weight: CellValues) -> float | None:
    """Standard deviation of the changes for weight 1, from every fifth cell; None if no cell has a weight."""
    sample, weights = change.ravel()[::SAMPLED], weight.ravel()[::SAMPLED]
    weighted = weights > 0
    return median_deviation(sample[weighted] * np.sqrt(weights[weighted])) if weighted.any() else None


def _shares(change: CellValues, weight: CellValues) -> CellValues:
    """Huber weights of changes, for deviations from 0."""
    spread = _spread(change, weight)
    limit = np.float32(1.0 if spread is None else HUBER * spread + 1e-9)
    return np.minimum(np.float32(1), limit / np.maximum(np.abs(change) * np.sqrt(weight), np.float32(1e-12)))


def _fit(basis: CellValues, change: CellValues, weight: CellValues) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Robust least-squares fit of the four causes to a smooth change: the solution, and its variances for a noise of
    1."""
    inside = weight[:, 1:-1] * (weight[:, :-2] > 0) * (weight[:, 2:] > 0)
    causes, right = basis[:, :, 1:-1].reshape(4, -1).astype(np.float64), change[:, 1:-1].ravel()
    share = _shares(change - np.median(change), weight)
    for last in (False, True):
        weighted = causes * (inside * share[:, 1:-1]).ravel()
        normal = weighted @ causes.T
        # A cause without any effect (no sample, a single row, a rotating disc) gets no share of the change.
        normal += (1e-9 * normal[0, 0] + 1e-12) * np.eye(4)
        solution = np.linalg.solve(normal, weighted @ right)
        if not last:
            share = _shares(change - np.tensordot(solution.astype(np.float32), basis, 1), weight)
    return np.asarray(solution, np.float64), np.asarray(np.diag(np.linalg.inv(normal)).clip(0), np.float64)


CALIBRATION = 12  # number of first values, from which the scatter is estimated
MEMORY = 0.02  # weight of the newest value
NORMAL = 1.2533  # standard deviation of a normal distribution, divided by its mean absolute deviation: sqrt(pi / 2)
OUTLIER = 4.0  # largest number of mean absolute deviations that a single value may add


@dataclass(frozen=True)
class FrameScatter:
    """Running mean and mean absolute deviation. A single outlier counts as at most four mean absolute deviations."""

    n: int = 0
    mean: float = 0.0
    deviation: float = 0.0

    @property
    def ready(self) -> bool:
        return self.n >= CALIBRATION

    @property
    def sigma(self) -> float:
        return NORMAL * self.deviation

    def with_figure(self, figure: float) -> FrameScatter:
        weight = max(MEMORY, 1 / (self.n + 1))
        difference = figure - self.mean
        if self.ready and abs(difference) > OUTLIER * self.deviation:
            difference = OUTLIER * self.deviation if difference > 0 else -OUTLIER * self.deviation
        return FrameScatter(
            self.n + 1, self.mean + weight * difference, self.deviation + weight * (abs(difference) - self.deviation)
        )


def running_mean(so_far: NDArray[np.float32] | None, newest: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    """The mean of n arrays, from the mean of the first n - 1 arrays and the n-th array."""
    return newest if so_far is None or n == 1 else so_far + (newest - so_far) / np.float32(n)
