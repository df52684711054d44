"""Dynamic flats: the beam changes from flat to flat. This module finds the components of these changes, and their
weights in each projection.

After Van Nieuwenhove, De Carlo, De Beenhouwer, Batenburg & Sijbers 2015, Opt. Express 23, 27975. The components are
principal components of the flats; parallel analysis gives their number. The weights of a projection minimise the total
variation of the corrected projection. [our own: components of the logarithm, so that a flat is mean * exp(weights @
components), and the weights of a projection are a convex fit to its line integrals]
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from recon.base.arrays import F32, F64

_FEWEST = 4  # smallest number of flats
_MOST = 10  # largest number of components
_RANDOM = 10  # number of random draws of the parallel analysis
_SAMPLED = 1 << 16  # number of pixels used for the components, and for the weights of a projection
_APART = 4  # distance in pixels for differences; the beam changes more slowly than noise
_ROUNDS = 20  # number of rounds of reweighting
_SMOOTHED = 5  # pixels per side of the smoothing that is used to detect air
# percentile of the line integrals that shows air; range of line integrals in air, and smallest share of air
_LOWEST, _AIR, _ENOUGH = 5.0, 0.04, 0.1
_MOST_RESIDUAL = 3.0  # multiple of the noise; with material, the residual is larger
_DARKEST = 0.05  # share of the median flat; darker pixels are not used


@dataclass(frozen=True, eq=False)
class DynamicFlats:
    """The mean of the flats of a scan and the components of their differences.

    Attributes:
        mean: float32 [row, col], mean of the flats minus the dark.
        components: float32 [component, row, col], changes of the logarithm of the flat, each with RMS 1; 0 in dark
            pixels.
    """

    mean: F32
    components: F32

    def rows(self, rows: slice) -> DynamicFlats:
        """The dynamic flats of some detector rows."""
        return DynamicFlats(self.mean[rows], self.components[:, rows])

    def flat_of(self, view: F32, floor: float = 1e-4) -> F32:
        """The flat [row, col] (minus dark) for this projection. Its level is that of the mean flat."""
        weights = self.weights_of(view, floor)
        return np.asarray(self.mean * np.exp(np.tensordot(weights, self.components, axes=1)), np.float32)

    def weights_of(self, view: F32, floor: float = 1e-4) -> F32:
        """Weights [component] of this projection. With these weights, the sum of absolute differences of line integrals
        between pixels is smallest. If some pixels turn out to be air, a least-squares fit on these pixels follows.

        Args:
            view: float32 [row, col], counts minus dark.
            floor: lowest transmission; darker pixels are not used.
        """
        transmission = np.divide(view, self.mean, out=np.zeros_like(self.mean), where=self.mean > 0)
        known = transmission > floor
        if not len(self.components) or known.mean() < _ENOUGH:
            return np.zeros(len(self.components), np.float32)
        integral = -np.log(np.where(known, transmission, 1.0))
        # the noise of a line integral is proportional to the inverse of this
        root_transmission = np.sqrt(np.where(known, transmission, 0))
        targets, columns = [], []
        for axis in [axis for axis, size in enumerate(view.shape) if size > 1]:
            distance = min(_APART, view.shape[axis] - 1)
            first, second = _pixel_pairs(axis, distance)
            step = max(1, 2 * view.size // _SAMPLED)
            weight = np.minimum(root_transmission[first], root_transmission[second])
            change = (self.components[:, *second] - self.components[:, *first]) * weight
            columns.append(change.reshape(len(self.components), -1)[:, ::step])
            targets.append(((integral[first] - integral[second]) * weight).ravel()[::step])
        weights = _least_absolute(np.concatenate(columns, axis=1).T, np.concatenate(targets))
        return self._fitted_in_air(weights, integral, known).astype(np.float32)

    def _fitted_in_air(self, fitted_weights: F64, integral: F32, known: NDArray[np.bool_]) -> F64:
        """The weights fitted on the pixels in air; `fitted_weights` if there are too few such pixels, or if they do
        not match the fit."""
        weights: NDArray[Any] = fitted_weights
        for _ in range(2):
            residual = integral + np.tensordot(weights, self.components, axes=1)
            smooth = scipy.ndimage.uniform_filter(residual, _SMOOTHED, mode="nearest")
            air = known & (np.abs(smooth - np.percentile(smooth[known], _LOWEST)) < _AIR)
            if air.mean() < _ENOUGH:
                return fitted_weights
            pixels = np.flatnonzero(air)[:: max(1, int(air.sum()) // _SAMPLED)]
            matrix = np.column_stack(
                (self.components.reshape(len(self.components), -1)[:, pixels].T, np.ones(pixels.size))
            )
            weights = np.linalg.lstsq(
                matrix.astype(np.float64), -integral.ravel()[pixels].astype(np.float64), rcond=None
            )[0]
            weights, level = weights[:-1], weights[-1]
        residual = integral + np.tensordot(weights, self.components, axes=1) + np.float32(level)
        smooth = scipy.ndimage.uniform_filter(residual, _SMOOTHED, mode="nearest")
        noise = float(np.median(np.abs(residual - smooth)[air])) / _SMOOTHED
        return weights if float(np.median(np.abs(smooth[air]))) < _MOST_RESIDUAL * noise else fitted_weights


def find_dynamic_flats(
    flats: Callable[[], Iterable[F32]], rng: np.random.Generator, masked: NDArray[np.bool_] | None = None
) -> DynamicFlats:
    """Mean and principal components of flats.

    Args:
        flats: function that returns an iterator over the flats, float32 [row, col] minus dark; called three times.
        masked: bool [row, col], pixels to ignore; None: all are used.

    Raises:
        ValueError: there are fewer than four flats, which show no components.
    """
    total, n = np.zeros((1, 1)), 0
    for flat in flats():
        total, n = total + flat, n + 1
    if n < _FEWEST:
        raise ValueError(f"dynamic flats need at least {_FEWEST} flats, got {n}")
    mean = np.asarray(total / n, np.float32)
    usable = mean > _DARKEST * np.median(mean)
    if masked is not None:
        usable &= ~masked
    sampled = np.flatnonzero(usable)[:: max(1, int(usable.sum()) // _SAMPLED)]
    samples = np.stack([_log_ratio(flat, mean, usable).ravel()[sampled] for flat in flats()]).astype(np.float64)
    loadings = _components(samples - samples.mean(axis=0), rng)
    components = np.zeros((len(loadings), *mean.shape), np.float32)
    for i, flat in enumerate(flats()):
        log_ratio = _log_ratio(flat, mean, usable)
        for component, loading in zip(components, loadings[:, i], strict=True):
            component += np.float32(loading) * log_ratio
    for component in components:
        component /= np.sqrt(np.mean(component[usable] ** 2))
    return DynamicFlats(mean, components)


def search_memory(flats: int, pixels: int) -> int:
    """Peak memory of `find_dynamic_flats` in bytes, including the components; `pixels`: of one flat."""
    return 4 * pixels * (_MOST + 16) + 8 * flats * 6 * min(pixels, 2 * _SAMPLED)


def view_memory(flats: int, pixels: int) -> int:
    """Peak memory in bytes of the components and of finding the weights of a projection."""
    components, samples = min(_MOST, flats), min(2 * pixels, 3 * _SAMPLED // 2)
    return 4 * pixels * (4 * components + 14) + 8 * samples * (3 * components + 8)


def _log_ratio(flat: F32, mean: F32, usable: NDArray[np.bool_]) -> F32:
    """The logarithm of a flat divided by the mean flat, minus its level; 0 in unused pixels."""
    ratio = np.divide(flat, mean, out=np.ones_like(mean), where=usable & (flat > 0))
    log_ratio = np.log(ratio)
    return np.asarray(np.where(usable, log_ratio - log_ratio[usable].mean(), 0), np.float32)


def _components(samples: F64, rng: np.random.Generator) -> F64:
    """Coefficient [component, flat] of each flat, for the components that are above noise (Horn's parallel
    analysis)."""
    values, vectors = np.linalg.eigh(samples @ samples.T)
    deviation = samples.std(axis=0, ddof=1)
    noise_eigenvalues = []
    for _ in range(_RANDOM):
        noise = rng.standard_normal(samples.shape) * deviation
        noise -= noise.mean(axis=0)
        noise_eigenvalues.append(np.linalg.eigvalsh(noise @ noise.T))
    limit = np.mean(noise_eigenvalues, axis=0) + 2 * np.std(noise_eigenvalues, axis=0)
    above_noise = (values > limit)[::-1]
    number = int(np.argmin(np.append(above_noise, False)))
    return vectors[:, ::-1].T[: min(number, _MOST)]


def _least_absolute(matrix: F64 | F32, target: F64 | F32) -> F64:
    """The x that minimises the sum of |matrix @ x - target| (iteratively reweighted least squares)."""
    matrix, target = matrix.astype(np.float64), target.astype(np.float64)
    weight: NDArray[Any] = np.ones(len(target))
    x = np.zeros(matrix.shape[1])
    for _ in range(_ROUNDS):
        weighted = matrix * weight[:, None]
        x = np.linalg.lstsq(weighted.T @ matrix, weighted.T @ target, rcond=None)[0]
        deviations = np.abs(target - matrix @ x)
        weight = 1 / np.maximum(deviations, 1e-3 * max(float(np.median(deviations)), 1e-12))
    return x


def _pixel_pairs(axis: int, distance: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Slices of the first and the second pixel of each pair along an axis."""
    whole = (slice(None), slice(None))
    first, second = list(whole), list(whole)
    first[axis], second[axis] = slice(None, -distance), slice(distance, None)
    return tuple(first), tuple(second)
