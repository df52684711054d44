"""MLEM and OSEM: find the activity with the highest Poisson likelihood."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy.special import xlogy

from recon import Geometry, Grid, Projector, Volume
from splatline_emission.counts import F32, Emission

_LEAST = 1e-6  # voxels below this fraction of the largest sensitivity are not measured and get no activity


def attenuation_factors(mu: Volume, geometry: Geometry) -> F32:
    """exp(-∫ μ) [view, row, col]: fraction of photon pairs that leave the sample; the same for all points of a line.

    Args:
        mu: attenuation at 511 keV, 1/mm.
    """
    return np.exp(-Projector(geometry, mu.grid).forward(mu.data))


def mlem(
    emission: Emission,
    grid: Grid,
    iterations: int = 20,
    subsets: int = 1,
    on_iteration: Callable[[int, float, float], object] | None = None,
) -> Volume:
    """Maximum likelihood by expectation maximisation (Shepp & Vardi 1982; Lange & Carson 1984).

        x <- x / (Aᵀs) * Aᵀ[s y / (s A x + b)]

    With one subset, each iteration raises L = Σ y log(mean) - mean. With N subsets of the projections this is OSEM
    (Hudson & Larkin 1994), which is about N times as fast, but L may fall. Memory: 4 volumes with one subset, else 3 +
    subsets; 4 times the projections of a subset.

    Args:
        on_iteration: called with the number of each iteration, from 1, L (up to a constant), and
            ||counts - mean|| / ||counts||. Both are for the volume before the iteration; with subsets, for the volume
            before each subset. The iterations end if it returns True.

    Returns:
        counts per mm of line, 0 or more; 0 in voxels that no line meets.

    Raises:
        ValueError: fewer than one iteration; subsets not between 1 and the number of projections; or a line has counts
            although its mean is zero for any activity.
    """
    if iterations < 1:
        raise ValueError(f"iterations must be 1 or more, got {iterations}")
    x, scale = np.zeros(grid.shape, np.float32), float(np.linalg.norm(emission.counts))
    for iteration, done in enumerate(islice(_passes(emission, grid, subsets), iterations), start=1):
        x = done.activity
        if on_iteration is not None and on_iteration(iteration, done.likelihood, math.sqrt(done.squares) / scale):
            break
    return Volume(x, grid)


class _Pass(NamedTuple):
    """State after a pass over all projections: `activity` [z, y, x], which the next pass overwrites; L and
    Σ (counts - mean)² for the activity before each subset.
    """

    activity: F32
    likelihood: float
    squares: float


def _passes(emission: Emission, grid: Grid, subsets: int) -> Iterator[_Pass]:
    """Endless passes of `mlem`."""
    views = emission.geometry.n_views
    if not 1 <= subsets <= views:
        raise ValueError(f"subsets must be 1 to {views}, the number of projections, got {subsets}")
    whole = Projector(emission.geometry, grid).plain  # because expectation maximisation needs a matrix >= 0
    parts = [
        (view_numbers, whole.subset(view_numbers))
        for view_numbers in (np.arange(first, views, subsets) for first in range(subsets))
    ]
    sensitivities = [projector.adjoint(emission.survival[view_numbers]) for view_numbers, projector in parts]
    least = _LEAST * max(float(each.max()) for each in sensitivities)
    x = np.where(sum(sensitivities) > least, np.float32(1), np.float32(0))
    x *= np.float32(emission.counts.sum(dtype=np.float64) / sum(float(np.vdot(x, each)) for each in sensitivities))
    while True:
        likelihood = squares = 0.0
        for (view_numbers, projector), sensitivity in zip(parts, sensitivities, strict=True):
            counts, survival = emission.counts[view_numbers], emission.survival[view_numbers]
            mean = survival * projector.forward(x) + emission.background[view_numbers]
            if blind := np.count_nonzero(counts[mean <= 0]):
                raise ValueError(
                    f"{blind} lines of response have counts, although the model expects 0 counts: the lines miss "
                    "the grid, or their survival is 0. Use a larger grid, state a background for these lines, or "
                    "set their counts to 0"
                )
            ratio = np.divide(counts, mean, out=np.zeros_like(mean), where=mean > 0)
            likelihood += float(np.sum(xlogy(counts, mean) - mean, dtype=np.float64))
            squares += float(np.sum((counts - mean) ** 2, dtype=np.float64))
            x *= np.divide(
                projector.adjoint(survival * ratio), sensitivity, out=np.ones_like(x), where=sensitivity > least
            )
        yield _Pass(x, likelihood, squares)


def passes_by_halves(emission: Emission, grid: Grid, subsets: int, most: int, rng: np.random.Generator) -> int:
    """The number of iterations of `mlem`, up to `most`, after which the volume predicts held-out counts best.

    Each count goes to one of two halves at random. The halves are independent Poisson counts of half the mean (Kingman
    1993, Poisson Processes, section 5.1), for all lines. The activity x of one half is compared with the lines
    q = (y - b) / s of the other half, whose noise is independent. Along rows of pixels, with |ω| as in FBP,

        Σ |ω| |F(q - A x)|²  =  Σ |ω| |F(A x - A truth)|² + noise of q     on average

    and the first sum on the right is |x - truth|², up to a factor (Natterer 1986, The Mathematics of Computerized
    Tomography, section II.1). Without |ω|, or with the likelihood, lines would be compared, and lines hardly show the
    noise of a volume: two to three times as many iterations would then seem best. The search ends when the sum
    increases.

    Returns:
        `most` if counts are not integers, because they are then not Poisson.
    """
    counts = emission.counts
    if not (np.rint(counts) == counts).all() or counts.sum() < 2:
        return most
    taken = rng.binomial(counts.astype(np.int64), 0.5).astype(np.float32)
    survival, background = emission.survival * np.float32(0.5), emission.background * np.float32(0.5)
    half = Emission(taken, emission.geometry, survival, background)
    remaining = counts - taken - background
    lines = np.divide(remaining, survival, out=np.zeros_like(remaining), where=survival > 0)
    whole, least = Projector(emission.geometry, grid).plain, math.inf
    for n, done in enumerate(islice(_passes(half, grid, subsets), most), start=1):
        error = _error_of_images(np.where(survival > 0, lines - whole.forward(done.activity), np.float32(0)))
        if error >= least:
            return n - 1
        least = error
    return most


def _error_of_images(missed: F32) -> float:
    """Σ |ω| |F|² over the rows of pixels [view, row, col]."""
    columns = 2 * missed.shape[-1]  # padded, so that ends of a row do not meet
    spectrum = np.fft.rfft(missed, columns)
    return float(np.sum(np.fft.rfftfreq(columns) * (spectrum.real**2 + spectrum.imag**2), dtype=np.float64))
