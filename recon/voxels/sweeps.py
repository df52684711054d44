"""Ordered subsets: simultaneous corrections from a few views at a time, the common step of SIRT, SART and OS-SIRT.

    x <- x + relaxation C A_sᵀ R (p_s - A_s x)        R = 1 / row sums of A,  C = 1 / column sums of A_s

One subset of all views is SIRT (Gilbert 1972; Gregor & Benson 2008), one view a subset is SART (Andersen & Kak 1984).
The column sums are the largest of all subsets, so that one volume serves all and no step is too long.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.kernels.cpu.vectors import add_product, replace_by_residual
from recon.voxels.projector import Projector

# Rays shorter than this share of the longest ray, and voxels with a column sum below this share of the largest, are
# left out: their corrections would be divided by almost zero.
_LEAST = 1e-3

_LOOKED_AT = 9  # views of a sweep whose residual is kept


def interleaved(projector: Projector, subsets: int) -> list[NDArray[np.intp]]:
    """View indices of each subset: neighbours in angle are in different subsets, so that each covers all directions."""
    order = np.argsort(np.mod(projector.geometry.angles, projector.geometry.period), kind="stable")
    count = min(subsets, order.size)
    return [order[start::count] for start in range(count)]


class Sweeps:
    """Passes over all views, subset by subset. Memory: two volumes, and twice the projections.

    Attributes:
        pace: a typical step of a sweep along the gradient of ½||A x - p||² (rays weighed).
        residual: p - A x of some views of the last sweep [view, col, row], times the root of their weight (NaN: 0).
    """

    def __init__(
        self, projector: Projector, data: F32, weight: F32 | None, subsets: Sequence[NDArray[np.intp]]
    ) -> None:
        """For `data` [view, col, row], each ray weighing `weight` (None: one), in `subsets` of views."""
        nz, ny, nx = projector.grid.shape
        self._parts: list[tuple[Projector, F32, F32 | None, F32]] = []
        self._step = np.zeros((ny, nx, nz), np.float32)  # largest column sums, then their inverse
        self._gradient = np.empty_like(self._step)
        for views in subsets:
            part = projector.subset(views) if len(subsets) > 1 else projector
            measured = data[views] if len(subsets) > 1 else data
            rays = None if weight is None else (weight[views] if len(subsets) > 1 else weight)
            self._gradient[...] = 1
            plain = part.plain  # sums of absolute values, but for less than 2 in a step
            scale = _inverse(plain.forward_lines(self._gradient))
            plain.adjoint_lines(np.ones_like(scale) if rays is None else rays, self._gradient)
            np.maximum(self._step, self._gradient, out=self._step)
            if rays is not None:
                scale *= rays
            self._parts.append((part, measured, rays, scale))
        _inverse(self._step)
        scales = sum(float(part[3].sum(dtype=np.float64)) for part in self._parts)
        weights = data.size if weight is None else float(weight.sum(dtype=np.float64))
        self.pace = float(self._step[self._step > 0].mean(dtype=np.float64)) * scales / weights if scales > 0 else 0.0

    def run(self, x: F32, relaxation: float, nonnegative: bool, rng: np.random.Generator | None) -> float:
        """One sweep over x [y, x, z], in place, the subsets in random order (None: as given).

        Returns:
            Σ weight (A x - p)², each ray counted before its own correction.
        """
        order = np.arange(len(self._parts)) if rng is None else rng.permutation(len(self._parts))
        total, seen = 0.0, []
        for index in order:
            part, data, weight, scale = self._parts[index]
            residual = part.forward_lines(x)  # the model, until the data are subtracted
            some = slice(None, None, max(1, len(self._parts) * len(data) // _LOOKED_AT))
            seen.append(whitened(data[some] - residual[some], None if weight is None else weight[some]))
            total += replace_by_residual(data, residual, weight, scale)
            part.adjoint_lines(residual, self._gradient)
            add_product(x, relaxation, self._step, self._gradient, nonnegative)
        self.residual = np.concatenate(seen)
        return total


def whitened(residual: F32, weight: F32 | None) -> F32:
    """The residual times the root of each ray's weight; NaN where that is 0."""
    if weight is None:
        return residual
    return np.where(weight > 0, residual * np.sqrt(weight), np.float32(np.nan)).astype(np.float32, copy=False)


def _inverse(sums: F32) -> F32:
    """1 / sums in place, 0 where they are too small."""
    least = max(_LEAST * float(sums.max()), float(np.finfo(np.float32).tiny))
    seen = sums > least
    np.divide(1, sums, out=sums, where=seen)
    sums[~seen] = 0
    return sums
