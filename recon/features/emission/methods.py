"""MLEM and OSEM: the volume of highest Poisson likelihood, of what was counted or of line integrals."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import islice
from typing import ClassVar, NamedTuple, Self

import numpy as np
from scipy.special import xlogy

from recon.base.arrays import F32
from recon.base.declared_types import Checked, Count, check_arguments
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import Progress, ReconProblem, Reconstruction, RunControl, Traits
from recon.base.volume import Grid, Volume
from recon.prep.counts import Emission
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import Buffers, bytes_of, interleaved

_RANGE = 1e30  # products of a sensitivity and an activity beyond it, or below 1 / it, leave float32
_LEAST = 1e-6  # share of the largest sensitivity below which a voxel is not seen, and keeps no activity


def attenuation_factors(mu: Volume, geometry: Geometry) -> F32:
    """exp(-∫ μ) [view, row, col]: the fraction of photon pairs that leave the sample, wherever on the line they are
    emitted.

    Args:
        mu: attenuation at 511 keV, 1/mm.
    """
    check_arguments(attenuation_factors, locals())
    return np.exp(-Projector(geometry, mu.grid).forward(mu.data))


class _Subset(NamedTuple):
    """The lines of some views, what `Emission` says of them, and `sensitivity` Aᵀ survival [z, y, x]."""

    projector: Projector
    counts: F32
    survival: F32
    background: F32 | np.float32
    sensitivity: F32


def mlem(
    emission: Emission,
    grid: Grid,
    iterations: int = 20,
    subsets: int = 1,
    on_iteration: Callable[[int, float, float], object] | None = None,
) -> Volume:
    """Maximum likelihood by expectation maximisation (Shepp & Vardi 1982; Lange & Carson 1984).

        x <- x / (Aᵀs) * Aᵀ[s y / (s A x + b)]

    With one subset each iteration raises L = Σ y log(mean) - mean. More subsets of the views are OSEM (Hudson & Larkin
    1994): about as many times faster, without that promise. Memory: 4 volumes with one subset, else 3 + subsets; 4 x
    the projections of a subset.

    Args:
        on_iteration: called with the number of each iteration, from 1, L (up to a constant), and
            ||counts - mean|| / ||counts||. Both are of the volume before it; with subsets each view at its turn. The
            iterations end if it returns something true.

    Returns:
        counts per mm of line, 0 or more; 0 where no line sees a voxel.

    Raises:
        ValueError: no iterations, or other subsets than 1 to the number of views. Counts that are zero everywhere. A
            line with counts whose mean is zero whatever the activity. Survival so small that float32 overflows.
    """
    check_arguments(mlem, locals())
    if operator.index(iterations) < 1:
        raise ValueError(f"iterations must be 1 or more, got {iterations}")
    x, scale = np.zeros(grid.shape, np.float32), float(np.linalg.norm(emission.counts))
    for iteration, done in enumerate(islice(_passes(emission, grid, subsets), iterations), start=1):
        x = done.activity
        if on_iteration is not None and on_iteration(iteration, done.likelihood, math.sqrt(done.squares) / scale):
            break
    return Volume(x, grid)


class _Pass(NamedTuple):
    """After a pass over all views: `activity` [z, y, x], which the next one overwrites, and of that before it, each
    view at its turn, L and Σ (counts - mean)².
    """

    activity: F32
    likelihood: float
    squares: float


def _passes(emission: Emission, grid: Grid, subsets: int) -> Iterator[_Pass]:
    """Endless passes of `mlem`."""
    parts = _subsets(emission, grid, subsets)
    most = max(float(part.sensitivity.max()) for part in parts)
    if most == 0:
        raise ValueError("no line sees the grid: survival is 0 everywhere, or the lines miss it")
    least = _LEAST * most
    x = np.where(sum(part.sensitivity for part in parts) > least, np.float32(1), np.float32(0))
    seen = sum(float(x.ravel() @ part.sensitivity.ravel()) for part in parts)
    level = float(emission.counts.sum(dtype=np.float64)) / seen
    if not (most > 1 / _RANGE and level < _RANGE):
        highest = 1.0 if emission.survival is None else float(emission.survival.max())
        raise ValueError(
            f"survival is {highest:.3g} at most, so that activity would be about {level:.3g} counts per mm, beyond the "
            "numbers of float32. Expected the share of pairs that a line counts, such as 0.3"
        )
    x *= np.float32(level)
    while True:
        likelihood = squares = 0.0
        for projector, counts, survival, background, sensitivity in parts:
            mean = survival * projector.forward(x) + background
            if blind := np.count_nonzero(counts[mean <= 0]):
                raise ValueError(
                    f"{blind} lines have counts and the mean 0: they miss the grid, or "
                    "their survival is 0. Give a larger grid, their background, or no counts"
                )
            ratio = np.divide(counts, mean, out=np.zeros_like(mean), where=mean > 0)
            likelihood += float(np.sum(xlogy(counts, mean) - mean, dtype=np.float64))
            squares += float(np.sum((counts - mean) ** 2, dtype=np.float64))
            x *= np.divide(
                projector.adjoint(survival * ratio), sensitivity, out=np.ones_like(x), where=sensitivity > least
            )
        yield _Pass(x, likelihood, squares)


def _subsets(emission: Emission, grid: Grid, subsets: int) -> list[_Subset]:
    views = emission.geometry.n_views
    if not 1 <= operator.index(subsets) <= views:
        raise ValueError(f"subsets must be 1 to {views}, a view each at most, got {subsets}")
    if not emission.counts.any():
        raise ValueError("counts are zero everywhere: there is nothing to reconstruct")
    whole, parts = Projector(emission.geometry, grid).plain, []  # expectation maximisation needs a matrix >= 0
    for some in interleaved(whole, subsets):
        projector = whole.subset(some)
        if emission.survival is None:
            survival = np.ones(projector.projection_shape, np.float32)
        else:
            survival = emission.survival[some]
        background = np.float32(0) if emission.background is None else emission.background[some]
        parts.append(_Subset(projector, emission.counts[some], survival, background, projector.adjoint(survival)))
    return parts


def passes_by_halves(
    emission: Emission,
    grid: Grid,
    subsets: int,
    most: int,
    rng: np.random.Generator,
    go_on: Callable[[int], bool] = lambda done: True,
) -> int | None:
    """The number of iterations of `mlem`, up to `most`, for which held-out counts are predicted best.

    Each count goes to one of two halves by a coin, which makes them independent Poisson counts of half the mean
    (Kingman 1993, Poisson Processes, section 5.1), of all lines. Activity x of one half meets lines q = (y - b) / s of
    the other, whose noise it does not know. Along rows of pixels, with |ω| as in FBP,

        Σ |ω| |F(q - A x)|²  =  Σ |ω| |F(A x - A truth)|² + noise of q     on average

    and the first sum on the right is |x - truth|², up to a factor (Natterer 1986, The Mathematics of Computerized
    Tomography, section II.1). Without |ω|, or by the likelihood, lines are compared, which hardly show the noise of a
    volume: two to three times as many iterations have the least error then. The search ends where the sum rises.

    Memory: as `mlem`, and 6 x the projections.

    Args:
        go_on: called with the number of each iteration; False ends the search there.

    Returns:
        None: counts are not whole numbers, so that they are not Poisson's; or a half has none.
    """
    counts = emission.counts
    if not (np.rint(counts) == counts).all():
        return None
    kept = rng.binomial(counts.astype(np.int64), 0.5).astype(np.float32)
    if not kept.any():
        return None
    share = np.float32(0.5)
    survival = np.full_like(counts, share) if emission.survival is None else emission.survival * share
    background = None if emission.background is None else emission.background * share
    half = Emission(kept, emission.geometry, survival, background)
    other = counts - kept if background is None else counts - kept - background
    lines = np.divide(other, survival, out=np.zeros_like(other), where=survival > 0)
    whole, least, best = Projector(emission.geometry, grid).plain, math.inf, 0
    for n, done in enumerate(islice(_passes(half, grid, subsets), most), start=1):
        missed = np.where(survival > 0, lines - whole.forward(done.activity), np.float32(0))
        error = _error_of_images(missed)
        if error >= least:
            break
        least, best = error, n
        if not go_on(n):
            break
    return best


def _error_of_images(missed: F32) -> float:
    """Σ |ω| |F|² over the rows of pixels [view, row, col]."""
    columns = 2 * missed.shape[-1]  # padded, so that ends of a row do not meet
    spectrum = np.fft.rfft(missed, columns)
    return float(np.sum(np.fft.rfftfreq(columns) * (spectrum.real**2 + spectrum.imag**2), dtype=np.float64))


UPDATES = 200
"""Of the volume, by all subsets: where counts do not say how many, and the most that they may ask for."""

_FLOOR = 1e-6  # of the mean line integral


@dataclass(frozen=True)
class Mlem(Checked):
    """See `mlem`; each iteration raises the likelihood. No voxel is negative.

    Line integrals that come without counts are taken for counts with their weights as survival.

    Attributes:
        iterations: passes over all views; None: as counts held out prefer, see `passes_by_halves`, or 200 updates of
            the volume, where these are no counts.
    """

    name: ClassVar[str] = "mlem"
    label: ClassVar[str] = "MLEM"
    traits: ClassVar[Traits] = Traits(own_length=True)

    iterations: Count | None = None

    def parts(self, views: int) -> int:
        """Number of subsets for so many views."""
        return 1

    @property
    def most_iterations(self) -> int:
        """Largest number of iterations that held-out counts may choose."""
        return UPDATES // self.parts(UPDATES)

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        begin, views = control.now(), problem.geometry.n_views
        subsets, history = self.parts(views), list[Progress]()

        def tried(done: int) -> bool:
            control.tell_part(done, 0, begin, views, "iterations tried on half")
            return not control.stop()

        def report(iteration: int, likelihood: float, residual: float) -> bool:
            seconds = control.now() - begin
            history.append(Progress(iteration, iterations, seconds, -likelihood, residual, 0, views))
            control.tell(history[-1])
            return control.stop()

        emission, most = _emission(problem), max(1, UPDATES // subsets)
        chosen = self.iterations
        if chosen is None and problem.use.emission is not None:
            rng = np.random.default_rng(problem.seed)
            chosen = passes_by_halves(emission, problem.grid, subsets, most, rng, tried)
        iterations = most if chosen is None else chosen
        volume = mlem(emission, problem.grid, iterations, subsets, report)
        return Reconstruction(volume, {**asdict(self), "iterations": iterations}, tuple(history))

    def toy(self) -> Self:
        return replace(self, iterations=1)

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        subsets = self.parts(geometry.n_views)
        return bytes_of(Buffers(4.5 + subsets, 5.2 + 4 / subsets, 1.1), geometry, grid, weighted)


@dataclass(frozen=True)
class Osem(Mlem):
    """`Mlem` with subsets of the views, faster by about their number; the likelihood need not rise."""

    name: ClassVar[str] = "osem"
    label: ClassVar[str] = "OSEM"

    subsets: Count = 4

    def parts(self, views: int) -> int:
        return min(self.subsets, views)


def _emission(problem: ReconProblem) -> Emission:
    """The counts, without lines of weight 0."""
    given, weights = problem.use.emission, problem.use.weights
    if given is None:
        lines, survival_of_lines = masked(problem.projections, weights)
        survival_of_lines = np.ones_like(lines) if survival_of_lines is None else survival_of_lines
        counts = np.maximum(lines, 0) * survival_of_lines
        # Rays of real views may miss the grid, and are not 0: a background explains them.
        floor = np.full_like(counts, max(_FLOOR * float(counts.mean()), float(np.finfo(np.float32).tiny)))
        return Emission(counts, problem.geometry, survival_of_lines, floor)
    if weights is None or weights.all():
        return replace(given, geometry=problem.geometry)
    survival = np.ones_like(given.counts) if given.survival is None else given.survival
    return Emission(given.counts * (weights > 0), problem.geometry, survival * (weights > 0), given.background)
