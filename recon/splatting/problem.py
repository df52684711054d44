"""FitProblem: the data of a fit on its device, in the units of the published learning rates and weights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.choices import Loss
from recon.base.geometry import Geometry, require_views
from recon.base.masks import masked
from recon.base.noise import noise_level
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.kernels.cpu.losses import L1, L2, POISSON, DataTerm
from recon.splatting.backend import Backend, ProjectionLoss

_KINDS = {"l1": L1, "l2": L2, "poisson": POISSON}

# Images contain values of about one. No material in the field of view can cause values above this limit. Larger values
# would exceed the range of float32 in SSIM, which sums products of squares.
_LARGEST = 1e6
# Limit for later projections: that of SSIM in float32. Their unit may come from noise before the sample was in the
# beam.
_LARGEST_LATER = 1e9


@dataclass(frozen=True, eq=False)
class FitProblem:
    """The data of a fit. Images are in units of half_field * unit, geometry and grid in mm.

    Attributes:
        images: one image [row, col] for each projection: line integrals / (half_field * unit).
        target_maps: each projection blurred for SSIM.
        weights: weights of the pixels [row, col] of each projection; None: all 1.
        grid: box of the Gaussians. It should contain everything that the projections see, even if a smaller volume is
            wanted later.
        half_field: half of the field of view, mm.
        unit: density unit, 1/mm.
        noise: standard deviation of the noise of a pixel, in units of `images`.
        change: mean change of the sample from voxel to voxel, in `unit`, see `initialise.mean_change`; 0: unknown.
        backend: operations on the device of all these arrays.
    """

    images: tuple[Any, ...]
    target_maps: tuple[Any, ...]
    weights: tuple[Any | None, ...]
    geometry: Geometry
    grid: Grid
    half_field: float
    unit: float
    noise: float
    loss: ProjectionLoss[Any]
    backend: Backend[Any]
    change: float = 0.0

    @property
    def scale(self) -> np.float32:
        """Factor from `images` to line integrals."""
        return np.float32(self.half_field * self.unit)

    @property
    def projections(self) -> F32:
        """The line integrals [view, row, col], copied to the host."""
        return np.stack([self.backend.numpy(image) * self.scale for image in self.images])


def make_problem(
    views: Views, grid: Grid, unit: float, backend: Backend[Any], *, loss: Loss = "l1", ssim_weight: float = 0.25
) -> FitProblem:
    """Normalise projections for a fit with the density unit `unit` (1/mm).

    Values that are not finite, or above a million times half_field * unit, get weight 0, see `masks.masked`. The
    squared losses are scaled: for residuals as large as the noise of the data (`noise_level`), they equal the absolute
    loss. So the weights of SSIM and total variation have the same effect with every loss.

    Raises:
        ValueError: the shapes do not match, a projection has no usable value, or the loss is unknown.
    """
    geometry = views.geometry
    require_views(geometry, views.data)
    if loss not in _KINDS:
        raise ValueError(f"loss must be one of {get_args(Loss)}, got {loss!r}")
    half_field = max(n * edge for n, edge in zip(grid.shape, grid.spacing, strict=True)) / 2
    scale = half_field * unit
    filled, known = masked(views.data, views.weights, _LARGEST * scale)
    delta = max(noise_level(filled) / scale, 1e-4)
    projection_loss = backend.projection_loss(
        geometry.detector_shape, ssim_weight, DataTerm(_KINDS[loss], delta, scale)
    )
    empty = FitProblem((), (), (), geometry, grid, half_field, unit, delta, projection_loss, backend)
    return replace(_with_views(empty, filled, known), geometry=geometry)


def extend(problem: FitProblem, projections: F32, angles: NDArray[np.float64]) -> FitProblem:
    """The problem with additional projections [view, row, col]; the existing ones are not copied.

    Large values are accepted up to the limit of the loss, because the density unit is too small if the first
    projections were empty. Values above 10⁹ times half_field * unit get weight 0.

    Raises:
        ValueError: the projections of the problem differ in shift, roll or tilt (see `Geometry.at`), or a projection
            has no usable value.
    """
    geometry = problem.geometry.at(np.concatenate((problem.geometry.angles, angles)))
    largest = _LARGEST_LATER * problem.half_field * problem.unit
    return replace(_with_views(problem, *masked(projections, None, largest)), geometry=geometry)


def with_projections(problem: FitProblem, projections: F32) -> FitProblem:
    """The same problem with all line integrals [view, row, col] replaced.

    Raises:
        ValueError: a projection has no usable value.
    """
    empty = replace(problem, images=(), target_maps=(), weights=())
    return _with_views(empty, *masked(projections, None, _LARGEST_LATER * problem.half_field * problem.unit))


def binned_geometry(geometry: Geometry, factor: int) -> Geometry:
    """The geometry of pixels binned by factor x factor, without a change of the height z = 0.

    In contrast, `Geometry.binned` moves z = 0 of a parallel beam to the middle of the remaining rows.

    Raises:
        ValueError: the detector has fewer rows or columns than the factor.
    """
    if factor > min(geometry.detector_shape):
        rows, cols = geometry.detector_shape
        raise ValueError(
            f"joined_pixels={factor} is larger than the detector, {rows} x {cols} pixels: set it to {min(rows, cols)} "
            "or less (1: the fit uses single pixels)"
        )
    return replace(geometry.binned(factor), axis_row=(geometry.axis_row - (factor - 1) / 2) / factor)


def join_pixels(views: Views, factor: int) -> Views:
    """Projections binned by factor x factor pixels.

    A binned pixel has the weighted mean of its pixels, and their mean weight. So pixels without data do not count.

    Raises:
        ValueError: as for `binned_geometry`.
    """
    if factor == 1:
        return views
    geometry = binned_geometry(views.geometry, factor)
    return views.binned(factor, geometry)


def _with_views(problem: FitProblem, projections: F32, weights: F32 | None) -> FitProblem:
    backend, loss = problem.backend, problem.loss
    images = tuple(backend.array(np.ascontiguousarray(view, np.float32) / problem.scale) for view in projections)
    known: tuple[Any | None, ...] = (None,) * len(images)
    if weights is not None:
        known = tuple(None if bool((w == 1).all()) else backend.array(w) for w in weights)
    maps = tuple(loss.target_maps(image, w) for image, w in zip(images, known, strict=True))
    return replace(
        problem, images=problem.images + images, target_maps=problem.target_maps + maps, weights=problem.weights + known
    )
