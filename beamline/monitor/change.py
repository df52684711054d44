"""Change: the difference of a view from earlier ones that the turning of the sample does not explain.

Between neighbouring views each cell goes on as it did: depth + velocity, from the last four views. The rest is fitted
by least squares with four causes: more light everywhere (gain), the sample elsewhere (across, down), and a step of the
stage other than the last ones (turn). For the columns of the fit: d depth = -gain - across d/dx - down d/dy + turn
velocity. All cells take part, so that each figure is 10 to 100 times finer than one cell's noise. The first pass
weights cells by how far they are from the median change, the second by their residuals of the first (Huber 1964). So a
floater, a zinger or a band hardly affects the fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.view import CellGrid, CellValues, CellView
from recon.base.arrays import MEDIAN
from recon.base.jit import njit

SPAN = 4  # views before; the velocity is the mean of their three steps
HUBER = 2.0  # standard deviations of the residual up to which a cell has its full weight
LEAST_VARYING = 0.1  # share of a shift's change that must differ from row to row
MOST_STEPS = 4  # largest gap in steps: after a longer one, velocities are not known


@dataclass(frozen=True, eq=False)
class SampleChange:
    """The change from the view before."""

    gain: float  # relative change of the light, of all cells alike
    # across, down: displacement of the sample in pixels of the frame, to the right and downwards
    across: float
    down: float
    turn: float  # excess rotation of the stage, in steps; NaN if nothing turns visibly
    residual: CellValues  # float32 [row, col], change of the depth that these do not explain
    noise: float  # robust standard deviation of the residual times the square root of the weight, over the lit cells
    causes: Causes | None = None  # inputs of the fit, for `beside_columns`
    sigma: tuple[float, float] = (0.0, 0.0)  # pixels, standard deviations of `across` and `down` by noise
    steps: float = 1.0  # since the view before

    def beside_columns(self) -> tuple[float, float, float] | None:
        """Shift across, shift down and turn, by differences between rows; None if rows are too similar.

        A hump of light as high as the frame, such as a ghost, changes all rows of a column alike. It has no effect
        here, while the motion of a sample has.
        """
        if self.causes is None or min(self.residual.shape) < 2:
            return None
        weight = self.causes.weight[:, 1:-1]
        sums = np.maximum(weight.sum(axis=0), np.float32(1e-12))
        whole = self.causes.basis()[:, :, 1:-1]
        basis, residual = (x - (weight * x).sum(axis=-2, keepdims=True) / sums for x in (whole, self.residual[:, 1:-1]))
        weighted = (basis * weight).reshape(3, -1).astype(np.float64)
        normal = weighted @ basis.reshape(3, -1).T
        if (np.diag(normal)[:2] < LEAST_VARYING * (whole**2 * weight).sum(axis=(1, 2))[:2]).any() or not normal.any():
            return None
        normal += np.diag(1e-9 * np.diag(normal) + 1e-12)
        across, down, turn = np.linalg.solve(normal, weighted @ residual.ravel()).tolist()
        return self.across + across, self.down + down, self.turn + turn


@dataclass(frozen=True, eq=False)
class Causes:
    """Causes of a change, as inputs of the fit of a view to earlier ones."""

    # image, turning: float32 [row, col], where the gradients are taken, and the change by turning on; both smoothed
    image: CellValues
    turning: CellValues
    weight: CellValues  # float32 [row, col]
    steps: float  # since the view before
    cell: int  # pixels a side

    def basis(self) -> CellValues:
        """[cause, row, col]: changes by a pixel across, a pixel down and a turn of a step."""
        down, across = np.gradient(self.image)
        return np.stack([-across / self.cell, -down / self.cell, self.turning * np.float32(self.steps)])


def change_of(view: CellView, before: Sequence[CellView], grid: CellGrid) -> SampleChange | None:
    """Change of a view against earlier ones (oldest first); None without SPAN of them at equal steps."""
    if len(before) < SPAN:
        return None
    last = before[-SPAN:]
    steps = _steps(view, last)
    if steps is None:
        return None
    # A gain that has changed is no velocity.
    gained = np.float32(sum(one.brighter for one in last[1:]))
    weight = np.minimum(view.weight, last[-1].weight)
    (gain, across, down, turn), residual, noise, image, turning, variances = _fit(
        view.depth, last[-1].depth, last[-2].depth, last[0].depth - gained, weight, steps
    )
    across, down, turn = across * grid.cell, down * grid.cell, turn / float(steps)
    causes = Causes(image, turning, weight, float(steps), grid.cell)
    sigma = math.sqrt(variances[1]) * noise * grid.cell, math.sqrt(variances[2]) * noise * grid.cell
    return SampleChange(math.expm1(-gain), across, down, turn, residual, noise, causes, sigma, float(steps))


def _steps(view: CellView, last: Sequence[CellView]) -> float | None:
    """Steps since the last view: 1, or more if views between were not used; None if the angles are uneven."""
    usual = (last[-1].angle - last[0].angle) / (SPAN - 1)
    if not math.isfinite(usual) or usual == 0:
        return 1.0 if view.angle == last[-1].angle or not math.isfinite(view.angle) else None
    inner = [after.angle - one.angle for one, after in pairwise(last)]
    if max(abs(step / usual - 1) for step in inner) > 0.5:
        return None
    steps = (view.angle - last[-1].angle) / usual
    return steps if 0.5 < steps < MOST_STEPS + 0.5 else None


@njit(nogil=True, cache=True)
def _smooth(image, out, line):
    """Binomial 1 2 1 along both axes; the frame's edges are mirrors."""
    rows, cols = image.shape
    for row in range(rows):
        above, below = image[max(row - 1, 0)], image[min(row + 1, rows - 1)]
        own = image[row]
        for col in range(cols):
            line[col] = 0.25 * (above[col] + below[col]) + 0.5 * own[col]
        target = out[row]
        for col in range(1, cols - 1):
            target[col] = 0.25 * (line[col - 1] + line[col + 1]) + 0.5 * line[col]
        target[0] = 0.75 * line[0] + 0.25 * line[min(1, cols - 1)]
        target[cols - 1] = 0.75 * line[cols - 1] + 0.25 * line[max(cols - 2, 0)]


@njit(nogil=True, cache=True)
def _deviate(change, usual, weight, deviation, sample):
    """Fills `deviation`; `sample` gets that of one cell of five, of those with a weight: their number."""
    n = 0
    for row in range(change.shape[0]):
        for col in range(change.shape[1]):
            deviation[row, col] = abs(change[row, col] - usual) * np.sqrt(weight[row, col])
            if weight[row, col] > 0 and (row + col) % 5 == 0:
                sample[n] = deviation[row, col]
                n += 1
    return n


def _deviation(change: CellValues, usual: float, weight: CellValues) -> tuple[CellValues, float | None]:
    """Deviations from the usual value, and their standard deviation by the median; None where no cell has a weight."""
    deviation, sample = np.empty_like(change), np.empty(change.size, np.float32)
    n = _deviate(change, usual, weight, deviation, sample)
    return deviation, _median(sample[:n]) / MEDIAN if n else None


def _median(values: CellValues) -> float:
    """As np.median, but faster for a few thousand values."""
    half = values.size // 2
    low = half - 1 + values.size % 2
    ordered = np.partition(values, (low, half), axis=None)
    return float(0.5 * (ordered[low] + ordered[half]))


def _shares(change: CellValues, usual: float, weight: CellValues) -> CellValues:
    """Huber weights of changes about their usual value."""
    deviation, spread = _deviation(change, usual, weight)
    limit = np.float32(1.0 if spread is None else HUBER * spread + 1e-9)
    return np.minimum(np.float32(1), limit / np.maximum(deviation, np.float32(1e-12)))


@njit(nogil=True, cache=True)
def _add_normal(smooth, image, turning, weight, share, normal, right):
    """Adds the normal equations of the four causes: the upper half of `normal` [4, 4], and `right` [4]."""
    rows, cols = smooth.shape
    basis = np.zeros(4)
    for row in range(rows):
        above, below = max(row - 1, 0), min(row + 1, rows - 1)
        for col in range(1, cols - 1):
            w = weight[row, col] * share[row, col]
            if w <= 0 or weight[row, col - 1] <= 0 or weight[row, col + 1] <= 0:
                continue
            basis[0] = 1.0
            basis[1] = 0.5 * (image[row, col - 1] - image[row, col + 1])
            basis[2] = (image[above, col] - image[below, col]) / max(below - above, 1)
            basis[3] = turning[row, col]
            for i in range(4):
                right[i] += w * basis[i] * smooth[row, col]
                for j in range(i, 4):
                    normal[i, j] += w * basis[i] * basis[j]


@njit(nogil=True, cache=True)
def _take_off(change, smooth, image, turning, weight, solution, residual, left_over):
    """Fills `residual` and `left_over`, what the causes do not explain of the change and of the smooth one."""
    rows, cols = change.shape
    for row in range(rows):
        above, below = max(row - 1, 0), min(row + 1, rows - 1)
        for col in range(cols):
            left, beside = max(col - 1, 0), min(col + 1, cols - 1)
            explained = (
                solution[0]
                + solution[1] * (image[row, left] - image[row, beside]) / max(beside - left, 1)
                + solution[2] * (image[above, col] - image[below, col]) / max(below - above, 1)
                + solution[3] * turning[row, col]
            )
            residual[row, col] = change[row, col] - explained if weight[row, col] > 0 else 0.0
            left_over[row, col] = smooth[row, col] - explained


def _fit(
    now: CellValues, one: CellValues, two: CellValues, four: CellValues, weight: CellValues, steps: float
) -> tuple[list[float], CellValues, float, CellValues, CellValues, list[float]]:
    """The causes of the change from `one`, the view before; `two` and `four` are those before that.

    Returns the solution (minus gain; across and down in cells; turn in steps), the residual and its noise, the `image`
    and `turning` of `Causes`, and the variances of the solution for a noise of 1.

    The median and the solution are numpy's: numba's take ten seconds to compile, in a machine's first scan.
    """
    velocity = (one - four) * np.float32(steps / 3)
    change = now - one - velocity
    line = np.empty(now.shape[1], np.float32)
    image, turning, smooth, residual, left_over = (np.empty_like(now) for _ in range(5))
    # Half a step back, as `change` compares now with one: the gradient is that of the middle.
    _smooth((one + two) * np.float32(0.5) + velocity, image, line)
    _smooth(velocity, turning, line)
    _smooth(change, smooth, line)
    solution: NDArray[np.float64] = np.zeros(4)
    share = _shares(smooth, _median(smooth), weight)
    for robust in range(2):
        normal, right = np.zeros((4, 4)), np.zeros(4)
        _add_normal(smooth, image, turning, weight, share, normal, right)
        normal += np.triu(normal, 1).T
        # A cause without any effect (no sample, one row, a turning disc) gets no share of the change.
        normal += (1e-9 * normal[0, 0] + 1e-12) * np.eye(4)
        solution = np.asarray(np.linalg.solve(normal, right), np.float64)
        _take_off(change, smooth, image, turning, weight, solution, residual, left_over)
        if robust == 0:
            share = _shares(left_over, 0.0, weight)
    _, noise = _deviation(residual, 0.0, weight)
    variances = np.clip(np.diag(np.linalg.inv(normal)), 0.0, None).tolist()
    return solution.tolist(), residual, noise or 0.0, image, turning, variances
