"""The iterative methods themselves, on lines along z; `recon.voxels.iterative.solve` is the way in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.kernels.cpu import tv as tv_cpu
from recon.kernels.cpu.vectors import combine, dot, misfit
from recon.voxels.projector import Projector
from recon.voxels.sweeps import Sweeps, interleaved
from recon.voxels.tv import TotalVariationProx, difference_weights

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Sirt:
    """Simultaneous iterative reconstruction (Gilbert 1972). Memory: 3 volumes, 3 x the projections."""

    iterations: int = 100
    relaxation: float = 1.0


@dataclass(frozen=True)
class Sart:
    """Simultaneous algebraic reconstruction, one view a step in random order (Andersen & Kak 1984).

    The relaxation shrinks by `decay` a sweep. Memory: 3 volumes, 3 x the projections.
    """

    iterations: int = 20
    relaxation: float = 1.0
    decay: float = 0.999


@dataclass(frozen=True)
class Cgls:
    """Conjugate gradients on the normal equations (Hestenes & Stiefel 1952); its early end is its regularisation.

    Negative values are clipped at the end. In float32 directions stop being conjugate after some eight iterations: from
    there the residual is that of one iteration less. Memory: 3 volumes, 3 x the projections.
    """

    iterations: int = 10


@dataclass(frozen=True)
class AsdPocs:
    """Adaptive steepest descent of TV between projections onto the data (Sidky & Pan 2008, Phys. Med. Biol. 53, 4777).

    A sweep of SART, then `tv_steps` steps down the gradient of TV, each `alpha` times as long as the first sweep was;
    steps shrink by `alpha_decay` where they undo more than `ratio` of the sweep while the data are not yet explained to
    `goal`. Memory: 5 volumes, 3 x the projections.

    Attributes:
        goal: ||A x - p|| / ||p|| to be reached; None: 0.15 of that of filtered back-projection (FBP or FDK), or, for
            views that it does not take (a cone's short scan), of a sweep of ordered-subset SIRT, which has about
            the same: 0.085 to 0.12 where FDK has 0.075 to 0.11 (a box in a box, 20 to 180 views, 0 and 2 % noise).
    """

    iterations: int = 10
    relaxation: float = 1.0
    decay: float = 0.9999
    tv_steps: int = 20
    alpha: float = 0.002
    alpha_decay: float = 0.95
    ratio: float = 0.94
    goal: float | None = None


@dataclass(frozen=True)
class FistaTv:
    """min ½||A x - p||² + μ TV(x), x >= 0, by FISTA with restarts (Beck & Teboulle 2009; O'Donoghue & Candès 2015).

    μ = tv_weight x density unit x ||A||², so `tv_weight` is the threshold of one proximal step in density units.
    Memory: 7 volumes, 2 x the projections.

    The weight: 60 views of a simulated battery give 29.3, 32.6, 35.0, 32.9 dB at 0.0002, 0.0005, 0.001, 0.002, of a
    measured walnut 28.2, 28.6, 28.9 and (after 40 iterations) 29.6.
    """

    iterations: int = 100
    tv_weight: float = 1e-3
    tv_steps: int = 5


@dataclass(frozen=True)
class OsSirtTv:
    """A sweep of ordered-subset SIRT, then a proximal step of TV. Memory: 6 volumes, 3 x the projections.

    Attributes:
        tv_weight: the threshold of that step in density units. Best of 0.002, 0.004 and 0.008 for 60 views, for a
            measured walnut (0.15 to 0.25 dB to its neighbours) and a simulated battery (1.0 to 1.5 dB).
        momentum: carry sweeps on along their last change (Kim, Ramani & Fessler 2015, IEEE Trans. Med. Imaging 34,
            167), for two volumes more: a quick volume. After 10 sweeps +4.2 dB (battery) and +2.1 dB (walnut), after 40
            -0.1 and -1.0 dB: noise comes in sooner, too.
    """

    iterations: int = 40
    subsets: int = 9
    tv_weight: float = 0.004
    tv_steps: int = 5
    momentum: bool = False


@dataclass(frozen=True, eq=False)
class Problem:
    """What every method is given.

    Attributes:
        data: [view, col, row], finite.
        weight: of each ray, [view, col, row], or None.
        go_on: told (iteration, relative residual) after each iteration; False: end with what there is.
        direct: the volume [y, x, z] of filtered back-projection, computed when asked for; None where it cannot be.
    """

    projector: Projector
    data: F32
    weight: F32 | None
    nonnegative: bool
    rng: np.random.Generator
    go_on: Callable[[int, float], bool]
    direct: Callable[[], F32 | None]

    @property
    def scale(self) -> float:
        """||p||, rays weighed."""
        return math.sqrt(misfit(self.data, np.zeros_like(self.data), self.weight))


def density_unit(x: F32) -> float:
    """A typical high density: the 99.5th percentile of the positive values, from some 10⁵ of them; 0 for none."""
    sample = x.reshape(-1)[:: max(1, x.size // 100_003)]
    positive = sample[sample > 0]
    return float(np.percentile(positive, 99.5)) if positive.size else 0.0


def sirt(problem: Problem, settings: Sirt, x: F32) -> F32:
    everything = [np.arange(problem.projector.geometry.n_views)]
    sweeps = Sweeps(problem.projector, problem.data, problem.weight, everything)
    scale = problem.scale
    for k in range(settings.iterations):
        error = sweeps.run(x, settings.relaxation, problem.nonnegative, None)
        if not problem.go_on(k + 1, math.sqrt(error) / scale):
            break
    return x


def sart(problem: Problem, settings: Sart, x: F32) -> F32:
    sweeps = _single_views(problem)
    scale = problem.scale
    for k in range(settings.iterations):
        error = sweeps.run(x, settings.relaxation * settings.decay**k, problem.nonnegative, problem.rng)
        if not problem.go_on(k + 1, math.sqrt(error) / scale):
            break
    return x


def os_sirt_tv(problem: Problem, settings: OsSirtTv, x: F32) -> F32:
    projector = problem.projector
    sweeps = Sweeps(projector, problem.data, problem.weight, interleaved(projector, settings.subsets))
    weights = difference_weights(projector.grid)
    prox = TotalVariationProx(_shape(x), weights, problem.nonnegative, settings.tv_steps)
    scale = problem.scale
    ahead = Momentum(x) if settings.momentum else None
    for k in range(settings.iterations):
        error = sweeps.run(x, 1.0, problem.nonnegative, problem.rng)
        # The unit follows the volume: the first sweeps are blurred, and fainter than what comes.
        prox(x, settings.tv_weight * density_unit(x))
        go_on = problem.go_on(k + 1, math.sqrt(error) / scale)
        if not go_on or k + 1 == settings.iterations:
            break
        if ahead is not None:
            ahead(x)
    return x


def cgls(problem: Problem, settings: Cgls, x: F32) -> F32:
    projector = problem.projector
    root = None if problem.weight is None else np.sqrt(problem.weight)
    residual = projector.forward_lines(x)
    misfit(problem.data, residual, None, root)
    s = _weighed_adjoint(projector, residual, root)
    direction = s.copy()
    gamma, scale = dot(s, s), problem.scale
    for k in range(settings.iterations):
        if gamma == 0:
            break
        image = projector.forward_lines(direction)
        if root is not None:
            image *= root
        step = gamma / dot(image, image)
        combine(1.0, x, step, direction, x)
        combine(1.0, residual, -step, image, residual)
        s = _weighed_adjoint(projector, residual, root, s)
        before, gamma = gamma, dot(s, s)
        combine(1.0, s, gamma / before, direction, direction)
        if not problem.go_on(k + 1, math.sqrt(dot(residual, residual)) / scale):
            break
    if problem.nonnegative:
        np.maximum(x, 0, out=x)
    return x


def asd_pocs(problem: Problem, settings: AsdPocs, x: F32) -> F32:
    projector = problem.projector
    sweeps = _single_views(problem)
    weights = difference_weights(projector.grid)
    scale = problem.scale
    goal = settings.goal if settings.goal is not None else 0.15 * _baseline(problem)
    before, slope = np.empty_like(x), np.empty_like(x)
    step = 0.0
    for k in range(settings.iterations):
        before[...] = x
        sweeps.run(x, settings.relaxation * settings.decay**k, problem.nonnegative, problem.rng)
        combine(1.0, x, -1.0, before, before)
        swept = math.sqrt(dot(before, before))
        model = projector.forward_lines(x)
        error = math.sqrt(misfit(problem.data, model, problem.weight)) / scale
        if k == 0:
            step = settings.alpha * swept
        if not problem.go_on(k + 1, error) or k + 1 == settings.iterations:
            break  # the last thing done to the volume is to fit the data, as published
        before[...] = x
        smoothing = 1e-4 * density_unit(x)
        for _ in range(settings.tv_steps if smoothing > 0 else 0):
            norm = tv_cpu.gradient(x, smoothing, weights, slope)
            if norm == 0:
                break
            combine(1.0, x, -step / norm, slope, x)
        combine(1.0, x, -1.0, before, before)
        if math.sqrt(dot(before, before)) > settings.ratio * swept and error > goal:
            step *= settings.alpha_decay
    return x


def _baseline(problem: Problem) -> float:
    """Relative residual of filtered back-projection, or of a sweep where there is none."""
    projector, volume = problem.projector, problem.direct()
    if volume is None:
        nz, ny, nx = projector.grid.shape
        volume = np.zeros((ny, nx, nz), np.float32)
        Sweeps(projector, problem.data, problem.weight, interleaved(projector, 9)).run(
            volume, 1.0, problem.nonnegative, None
        )
    return math.sqrt(misfit(problem.data, projector.forward_lines(volume), problem.weight)) / problem.scale


def fista_tv(problem: Problem, settings: FistaTv, x: F32) -> F32:
    projector = problem.projector
    if not x.any():
        # A sweep of OS-SIRT: a better start than nothing, and the density unit comes from it.
        Sweeps(projector, problem.data, problem.weight, interleaved(projector, 9)).run(
            x, 1.0, problem.nonnegative, problem.rng
        )
    return fista(problem, settings.iterations, settings.tv_weight * density_unit(x), settings.tv_steps, x)


def fista(problem: Problem, iterations: int, threshold: float, tv_steps: int, x: F32) -> F32:
    """FISTA with proximal steps of TV at `threshold` (the volume's unit), i.e. μ = threshold x the step's inverse."""
    projector = problem.projector
    step = 1 / largest_eigenvalue(projector, problem.weight)
    prox = TotalVariationProx(_shape(x), difference_weights(projector.grid), problem.nonnegative, tv_steps)
    gradient, ahead, scale = np.empty_like(x), Momentum(x), problem.scale
    for k in range(iterations):
        model = projector.forward_lines(x)
        error = misfit(problem.data, model, problem.weight, problem.weight)
        projector.adjoint_lines(model, gradient)
        combine(1.0, x, step, gradient, x)
        prox(x, threshold)
        if not problem.go_on(k + 1, math.sqrt(error) / scale) or k + 1 == iterations:
            break
        ahead(x)
    return x


class Momentum:
    """Nesterov's extrapolation between the steps of a descent, which starts anew where it points uphill.

    O'Donoghue & Candès 2015, Found. Comput. Math. 15, 715, eq. 13. Memory: two volumes.
    """

    def __init__(self, start: F32) -> None:
        self._last, self._from, self._t = start.copy(), start.copy(), 1.0

    def __call__(self, x: F32) -> None:
        """From the point x that a step has reached to the one where the next step starts, in place."""
        combine(1.0, self._from, -1.0, x, self._from)  # back along the step
        combine(1.0, x, -1.0, self._last, self._last)  # from the last point reached to this one
        if dot(self._from, self._last) > 0:
            self._t = 1.0
        after = (1 + math.sqrt(1 + 4 * self._t**2)) / 2
        change, self._last = self._last, self._from
        self._last[...] = x
        combine(1.0, x, (self._t - 1) / after, change, x)
        change[...] = x
        self._from, self._t = change, after


def largest_eigenvalue(projector: Projector, weight: F32 | None, rounds: int = 6) -> float:
    """An upper bound of the largest eigenvalue of Aᵀ W A, within a few per cent, by power iteration.

    For a matrix of non-negative entries and a positive x the largest (B x)_i / x_i bounds it from above (Collatz 1942),
    so the step 1 / bound is safe after any number of rounds; the Rayleigh quotient would err to the other side.
    """
    nz, ny, nx = projector.grid.shape
    x = np.ones((ny, nx, nz), np.float32)
    bound = math.inf
    for _ in range(rounds):
        image = projector.forward_lines(x)
        if weight is not None:
            image *= weight
        product = projector.adjoint_lines(image)
        ratio = np.divide(product, x, out=np.zeros_like(x), where=x > 0)
        bound = min(bound, float(ratio.max()))
        if bound == 0:
            return math.inf  # no ray meets the box
        x = product / product.max()
    return bound


def _shape(x: F32) -> tuple[int, int, int]:
    a, b, c = x.shape
    return a, b, c


def _single_views(problem: Problem) -> Sweeps:
    views = [np.array([v]) for v in range(problem.projector.geometry.n_views)]
    return Sweeps(problem.projector, problem.data, problem.weight, views)


def _weighed_adjoint(projector: Projector, rays: F32, weight: F32 | None, out: F32 | None = None) -> F32:
    return projector.adjoint_lines(rays if weight is None else rays * weight, out)
