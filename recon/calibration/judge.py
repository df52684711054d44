"""Judge: views held out say whether a learnt geometry is better than another one.

A volume of the other views predicts them, by a method and a projector that the search does not use (FISTA-TV with exact
rays). Each view held out may first be put where it fits best, for either geometry. So its own place, which was fitted
to it as well, is no advantage: the volumes alone are compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.method import DataUse, ReconProblem, RunControl
from recon.base.volume import Grid
from recon.voxels.held_out_weight import beyond_chance
from recon.voxels.methods.fista_tv import FistaTv
from recon.voxels.projector import Projector

_ONE_IN = 4  # views held out
_SWEEPS, _TV_WEIGHT = 6, 3e-3
_EDGE = 1  # row at either end, in which rays of leaning views leave the slices seen
_SMOOTH = 4.0  # pixels
_LEAST = 0.002  # share of the squared deviation that a better geometry takes away
_SURE = 2.0  # see `beyond_chance`


@dataclass(frozen=True, eq=False)
class Judge:
    """Deviations of views held out.

    Attributes:
        views: float32 [view, row, col], line integrals.
        grid: of all volumes.
        known: [row, col] weights of pixels; None: one for all.
        placed: each view held out is first put where it fits best.
    """

    views: F32
    grid: Grid
    known: F32 | None
    placed: bool

    def deviations(self, geometry: Geometry) -> F64:
        """[view held out] root mean squares by a volume of the others in this geometry."""
        order = np.argsort(np.mod(geometry.angles, 2 * np.pi), kind="stable")
        unseen = order[1::_ONE_IN]
        rows = geometry.detector_shape[0]
        seen = np.setdiff1d(order, unseen)
        use = DataUse()
        if self.known is not None:
            use = DataUse(np.broadcast_to(self.known, self.views[seen].shape).copy())
        problem = ReconProblem(self.views[seen], geometry.select(seen), self.grid, use, 0, "cpu")
        volume = FistaTv(_SWEEPS, _TV_WEIGHT).run(problem, RunControl()).volume
        images = Projector(geometry.select(unseen), self.grid).forward(volume.data)
        known = np.ones(images.shape[1:], np.float32) if self.known is None else self.known.copy()
        edge = min(_EDGE, (rows - 1) // 4)
        known[:edge], known[rows - edge :] = 0, 0
        return np.array(
            [self._left(view - image, image, known) for view, image in zip(self.views[unseen], images, strict=True)]
        )

    def _left(self, left: F32, image: F32, known: F32) -> float:
        """Root mean square of what is left of a view, after it was put where it fits best."""
        rays = _without_smooth(left)[known > 0]
        if self.placed:
            ways = [_without_smooth(np.gradient(image, axis=axis)) for axis in (0, 1) if image.shape[axis] > 1]
            slopes = np.stack([way[known > 0] for way in ways], axis=1)
            rays = rays - slopes @ np.linalg.lstsq(slopes, rays, rcond=1e-6)[0]
        return float(np.sqrt(np.mean(rays**2)))


def _without_smooth(image: F32) -> F64:
    """Differences from the surroundings: air that is not zero and matter beyond the field are smooth."""
    return np.asarray(image - gaussian_filter(image, _SMOOTH, mode="nearest"), np.float64)


def better(one: F64, other: F64) -> bool:
    """The first deviations [view] are surely less than the second, by the scatter from view to view."""
    share: NDArray[np.float64] = 1 - np.square(one) / np.maximum(np.square(other), 1e-30)
    return bool(share.mean() > _LEAST) and beyond_chance(share, _SURE)
