"""Background of the beam, learnt with the volume: it needs no ray that misses the sample.

    p = A x + B c        B: polynomials of column and row, times polynomials of time

Terms are found in two steps. The drift is what no volume holds, whatever its sign. What a volume explains is taken off
the views and off the terms, and least squares of what is left follow (Frisch & Waugh 1933). A constant of all views,
and a mean surface that is even about the axis, are a volume's as well; they are left alone. Then the mean surface: what
a volume without negative densities leaves. A positive one stays in the volume.

Views held out judge: a step is taken only if it predicts them better.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from recon.base.arrays import F32, F64, Mask, bin_views, factor_within, median_deviation
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.views import spread
from recon.base.volume import Grid, Volume
from recon.kernels.cpu.vectors import dot
from recon.prep.background import LEAST_SIZE, coordinate, powers
from recon.voxels.field_edges import wider_than_field
from recon.voxels.held_out import beyond_chance, split_views
from recon.voxels.iterative import solve
from recon.voxels.methods import FistaTv
from recon.voxels.projector import Projector, projection_lines, volume_lines
from recon.voxels.voxel_problem import density_unit

LEAST_VIEWS = 24
ORDER, SLOW = 2, 3  # of the polynomials; of Chebyshev's polynomials over the scan, from the constant on
TERMS = tuple((i, j, k) for k in range(SLOW) for i, j in powers(ORDER))
"""(power of the column, of the row, degree over the scan) of each term; the mean surface comes first."""

_MEAN = len(powers(ORDER))
_VOXELS, _VIEWS = 2**15, 120  # at most; surfaces of the second order need no more
_WIDER = 1.2  # than the field, where the sample is
_ONE_IN = 6  # views held out
_STEPS, _LEAST = 25, 0.04  # of conjugate gradients; share of a combination that no volume holds
_CLIPPED, _ROBUST = 4.0, 4  # standard deviations, rounds
_TV_WEIGHT = 3e-4  # more takes mass from the sample, which the terms would take up
_FIRST, _SWEEPS, _ROUNDS = 9, 3, 24
_DENSE, _LONGEST = 0.2, 10.0  # of the density unit; factor of a step
_NEARER = 0.99  # of the residual of views held out: what a further round has to bring
_BETTER, _MEAN_BETTER = 0.9, 0.75  # shares of the mean square of views held out that a drift, or a mean, must reach
_SURE = 2.0  # see `beyond_chance`


@dataclass(frozen=True, eq=False)
class LearntBackground:
    """Background surfaces of all views.

    Attributes:
        coefficients: float64 [term], of `TERMS`; 0 where the views held out confirm no step.
        size: root mean square of the surfaces, in line integrals.
        lowest, highest: of the mean surface over the views.
        without, left: root mean square that volumes leave of views held out, without and with the background.
        drift, mean: whether the views held out confirm the step.
    """

    coefficients: F64
    shape: tuple[int, int]
    size: float
    lowest: float
    highest: float
    without: float
    left: float
    drift: bool
    mean: bool

    def remove(self, views: F32, times: F64) -> None:
        """Subtract the surfaces from views [view, row, col] in place; times [view]: 0 to 1 over the scan."""
        for view, time in zip(views, times, strict=True):
            view -= _surface(self.coefficients, time, self.shape)


def learn_background(
    projections: F32,
    geometry: Geometry,
    times: F64,
    measured: Mask | None = None,
    progress: Callable[[int, int], object] = lambda n, of: None,
) -> LearntBackground:
    """Find the background of the views, as far as held-out views confirm it; see `background_memory`.

    Args:
        projections: line integrals [view, row, col], finite.
        times: [view], 0 to 1 over the scan.
        measured: bool [row, col]; None: all pixels.
        progress: takes steps done and steps at most; what it raises ends the search.

    Raises:
        ValueError: fewer than 24 views.
    """
    if geometry.n_views < LEAST_VIEWS:
        raise ValueError(f"{geometry.n_views} views are too few for held-out views; at least {LEAST_VIEWS} are needed")
    total = len(TERMS) + _ROUNDS
    data = _Views.of(projections, geometry, times, measured)
    seen, unseen = data.parts()
    drifting = _Trial(seen, _of_no_volume(seen, lambda n: progress(n, total)))
    plain = _Trial(seen, np.zeros(len(TERMS)))
    for trial in (plain, drifting):
        trial.sweep(_FIRST)
    drift = drifting.beats(plain, unseen, _BETTER)
    best, without = (drifting if drift else plain), plain.errors(unseen)
    levelled, rounds = _levelled(best, unseen, lambda n: progress(len(TERMS) + n, total))
    best.sweep(rounds * _SWEEPS)
    mean = levelled.beats(best, unseen, _MEAN_BETTER)
    best = levelled if mean else best
    left, coefficients, shape = best.errors(unseen), best.coefficients, geometry.detector_shape
    middle = _surface(np.where(np.arange(len(TERMS)) < _MEAN, coefficients, 0), 0.0, shape)
    squares = [np.square(_surface(coefficients, time, shape)).mean() for time in data.times]
    return LearntBackground(
        coefficients=coefficients, shape=shape, size=float(np.sqrt(np.mean(squares))), lowest=float(middle.min()),
        highest=float(middle.max()), without=float(np.sqrt(without.mean())), left=float(np.sqrt(left.mean())),
        drift=drift, mean=mean,
    )  # fmt: skip


def background_memory(geometry: Geometry) -> int:
    """Approximate peak memory of `learn_background` in bytes, without the views."""
    factor = factor_within(geometry.detector_shape, _VOXELS)
    small = geometry.select(slice(min(geometry.n_views, _VIEWS))).binned(factor)
    rays = small.n_views * math.prod(small.detector_shape)
    voxels = math.prod(Grid.for_fit(small, Grid.matching(small)).widened(_WIDER, small).shape)
    pixels = math.prod(geometry.detector_shape)
    return 4 * ((9 * len(TERMS) + 16) * rays + 12 * voxels + 6 * pixels)


def _surface(coefficients: F64, time: float, shape: tuple[int, int], factor: int = 1) -> F32:
    """The background [row, col] of a view at a time of the scan, 0 to 1, binned by a factor."""
    v, u = (coordinate(n, factor) for n in shape)
    across = np.zeros((ORDER + 1, u.size))
    for c, (i, j, k) in zip(coefficients, TERMS, strict=True):
        across[j] += c * math.cos(k * math.acos(2 * time - 1)) * u**i
    return (np.vander(v, ORDER + 1, increasing=True) @ across).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Views:
    """Some views, binned.

    Attributes:
        data, terms: float32 [view, row, col], and [term, view, row, col].
        weight: of each ray, float32 [view, row, col]; None: one for all.
        projector: onto a box that is wider than the field where the sample is.
    """

    data: F32
    terms: F32
    weight: F32 | None
    projector: Projector
    times: F64

    @classmethod
    def of(cls, projections: F32, geometry: Geometry, times: F64, measured: Mask | None) -> _Views:
        shape, n = geometry.detector_shape, geometry.n_views
        factor = factor_within(shape, _VOXELS)
        some = spread(np.arange(n), _VIEWS)
        data = np.concatenate([bin_views(projections[k : k + 1], factor) for k in some])
        views, weight = geometry.select(some).binned(factor), None
        if measured is not None and not measured.all():
            whole = bin_views(measured[None].astype(np.float32), factor) > 1 - 1e-6
            weight = np.broadcast_to(whole, data.shape).astype(np.float32)
        grid = Grid.matching(views)
        if wider_than_field(data, views):
            grid = Grid.for_fit(views, grid).widened(_WIDER, views)
        terms = np.array([[_surface(one, time, shape, factor) for time in times[some]] for one in np.eye(len(TERMS))])
        # A background is smooth: thresholds on what views held out gain were found without sharpening.
        return cls(data, terms, weight, Projector(views, grid).plain, times[some])

    def select(self, numbers: NDArray[np.intp]) -> _Views:
        weight = None if self.weight is None else self.weight[numbers]
        return replace(
            self, data=self.data[numbers], terms=self.terms[:, numbers], weight=weight,
            projector=self.projector.subset(numbers), times=self.times[numbers],
        )  # fmt: skip

    def parts(self) -> tuple[_Views, _Views]:
        """Views to learn from, and one of six to judge by, evenly spread in angle."""
        seen, unseen = split_views(self.projector.geometry, _ONE_IN)
        return self.select(seen), self.select(unseen)

    def less(self, coefficients: F64) -> F32:
        """The data minus the background."""
        return np.asarray(self.data - np.tensordot(coefficients.astype(np.float32), self.terms, 1))

    def without_volume(self, images: F32, inside: F32 | None = None) -> F64:
        """Images [view, row, col] less what a volume of any sign explains of them, flat, by conjugate gradients (CGLS).

        Args:
            inside: [y, x, z], 1 where the volume may differ from 0; None: everywhere.
        """
        project, free = self.projector, np.float32(1) if inside is None else inside
        known = None if self.weight is None else projection_lines(self.weight)
        left = projection_lines(images) if known is None else projection_lines(images) * known
        gradient = project.adjoint_lines(left) * free
        towards, size = gradient.copy(), dot(gradient, gradient)
        for _ in range(_STEPS):
            if size == 0:
                break
            image = project.forward_lines(towards)
            if known is not None:
                image *= known
            left = left - np.float32(size / dot(image, image)) * image
            gradient, before = project.adjoint_lines(left) * free, size
            size = dot(gradient, gradient)
            towards = gradient + np.float32(size / before) * towards
        return left.ravel().astype(np.float64)

    def flat(self, images: F32) -> F64:
        """Images [view, row, col] in the order of `without_volume`, 0 where not measured."""
        known = np.float32(1) if self.weight is None else self.weight
        return projection_lines(images * known).ravel().astype(np.float64)


class _Trial:
    """A volume of the views minus a background."""

    def __init__(self, views: _Views, coefficients: F64, volume: Volume | None = None) -> None:
        self.views, self.coefficients, self.volume = views, coefficients, volume
        self._decide = Decisions()

    def sweep(self, sweeps: int) -> F32:
        """Sweeps of FISTA-TV; returns what the volume leaves of the views [view, row, col]."""
        views, data = self.views, self.views.less(self.coefficients)
        method = FistaTv(sweeps, _TV_WEIGHT)
        self.volume = solve(method, views.projector, data, weight=views.weight, start=self.volume, decide=self._decide)
        return np.asarray(data - views.projector.forward(self.volume.data))

    def errors(self, unseen: _Views) -> F64:
        """[view] mean square residual of views held out, by volume and background."""
        assert self.volume is not None
        left = unseen.less(self.coefficients) - unseen.projector.forward(self.volume.data)
        return np.asarray(np.average(np.square(left, dtype=np.float64), axis=(1, 2), weights=unseen.weight))

    def beats(self, other: _Trial, unseen: _Views, share: float) -> bool:
        """Whether its residual of views held out is below a share of another's, and its background large enough."""
        ours, theirs = self.errors(unseen), other.errors(unseen)
        change = np.tensordot(self.coefficients - other.coefficients, self.views.terms, 1)
        large = float(np.sqrt(np.mean(np.square(change)))) >= LEAST_SIZE
        if large and beyond_chance(theirs - ours, _SURE) and ours.mean() < share * theirs.mean():
            return True
        self.coefficients = other.coefficients
        return False


def _of_no_volume(views: _Views, progress: Callable[[int], object]) -> F64:
    """Coefficients [term] of what no volume holds, of any sign: robust least squares (see the module)."""
    left = []
    for n, term in enumerate(views.terms):
        progress(n)
        left.append(views.without_volume(term))
    terms, whole = np.stack(left, -1), np.stack([views.flat(term) for term in views.terms], -1)
    data, known = views.without_volume(views.data), views.flat(np.ones_like(views.data))
    weight, solution = known, np.zeros(len(TERMS))
    for _ in range(_ROBUST):
        shares, combinations = _shares(terms.T @ (terms * weight[:, None]), whole.T @ (whole * weight[:, None]))
        kept = combinations[:, shares > _LEAST] / shares[shares > _LEAST] ** 0.5
        solution = kept @ (kept.T @ (terms.T @ (weight * data)))
        off = np.abs(data - terms @ solution)
        weight = known * (off <= _CLIPPED * median_deviation(off[known > 0]))
    return np.asarray(solution)


def _shares(left: F64, whole: F64) -> tuple[F64, F64]:
    """Shares [combination] of sums of squares [term, term] that are left of the whole, and combinations [term, .].

    Terms that are alike on few rows have no share of their own.
    """
    least = 1e-9 * np.trace(whole) * np.eye(len(whole))
    shares, combinations = eigh(left, whole + least)
    return np.asarray(shares), np.asarray(combinations)


def _levelled(start: _Trial, unseen: _Views, progress: Callable[[int], object]) -> tuple[_Trial, int]:
    """A trial with the mean surface that a volume without negative densities leaves, and its rounds.

    Each round fits the residual. A volume of dense matter alone holds a share of each combination of terms; the step
    along it is divided by the other share. Rounds end where views held out gain less than a per cent: later ones lift
    the air by the noise that is clipped at zero.
    """
    trial = _Trial(start.views, start.coefficients.copy(), start.volume)
    terms = trial.views.terms[:_MEAN]
    whole = np.stack([trial.views.flat(term) for term in terms], -1)
    basis, known = terms[:, 0].reshape(_MEAN, -1).T.astype(np.float64), trial.views.weight
    used = np.ones(len(basis), bool) if known is None else known[0].ravel() > 0
    error, rounds, longer = math.inf, 0, np.eye(_MEAN)
    while rounds < _ROUNDS:
        progress(rounds)
        left, rounds = trial.sweep(_SWEEPS), rounds + 1
        before, error = error, float(np.sqrt(trial.errors(unseen).mean()))
        if error > _NEARER * before:
            break
        if rounds & (rounds - 1) == 0:  # after 1, 2, 4, 8 ... rounds: dense matter changes slowly
            assert trial.volume is not None
            x = volume_lines(trial.volume.data)
            dense = (x > _DENSE * density_unit(x)).astype(np.float32)
            unheld = np.stack([trial.views.without_volume(term, dense) for term in terms], -1)
            shares, combinations = _shares(unheld.T @ unheld, whole.T @ whole)
            longer = combinations / np.maximum(shares, 1 / _LONGEST) @ combinations.T @ (whole.T @ whole)
        trial.coefficients[:_MEAN] += longer @ _fitted(np.median(left, axis=0), basis, used)
    return trial, rounds


def _fitted(image: F32, basis: F64, used: Mask) -> F64:
    """Robust least squares of an image [row, col] by columns of a basis [pixel, term], on the pixels used."""
    values, kept = image.ravel().astype(np.float64), used
    solution: F64 = np.zeros(basis.shape[1])
    for _ in range(_ROBUST):
        solution = np.asarray(np.linalg.lstsq(basis[kept], values[kept], rcond=None)[0])
        off = np.abs(values - basis @ solution)
        kept = used & (off <= _CLIPPED * median_deviation(off[used]))
    return np.asarray(solution)
