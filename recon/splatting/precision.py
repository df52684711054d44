"""Accuracy of the float32 kernels: one small fit, with the kernels and with the float64 reference implementation."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from recon.base.binning import bin_views
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.reference import projection_loss
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import place
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project, voxelize

_VIEWS, _ROWS, _COLS, _GAUSSIANS = 12, 8, 32, 150  # few, since the reference evaluates every Gaussian at every pixel
_RATES = (1e-3, 1e-2, 3e-3, 3e-2)  # of means (per half field), log scales, quaternions, raw densities


def small_crop(projections: NDArray[np.float32], geometry: Geometry) -> tuple[NDArray[np.float32], Geometry]:
    """A small part of a scan: at most 12 views, its middle rows, binned to at most 8 x 32 pixels."""
    factor = max(1, -(-geometry.detector_shape[1] // _COLS))
    factor = min(factor, geometry.detector_shape[0])
    rows = min(_ROWS, geometry.detector_shape[0] // factor) * factor
    first = (geometry.detector_shape[0] - rows) // 2
    views = np.unique(np.linspace(0, geometry.n_views - 1, min(_VIEWS, geometry.n_views)).round().astype(int))
    coarse = geometry.select(views).rows(first, first + rows).binned(factor)
    return bin_views(projections[views, first : first + rows], factor), coarse


def compare(
    projections: NDArray[np.float32],
    geometry: Geometry,
    seed: int,
    now: Callable[[], float] = time.perf_counter,
    steps: int = 60,
) -> dict[str, float]:
    """Fit a `small_crop` of a scan twice, with the same loss, views and optimiser (Adam), in float32 and in float64.

    Returns:
        residual_float32, residual_float64: |rendered - measured| / |measured| at the end, both rendered in float64.
        difference: root mean square of the volumes' difference over that of the float64 volume.
        seconds_float32, seconds_float64: of the steps.

    Raises:
        ValueError: the scan shows no matter.
    """
    data, views = small_crop(projections, geometry)
    grid = Grid.matching(views)
    start = place(data, views, grid, _GAUSSIANS, np.random.default_rng(seed), kernel=FitSettings().kernel)
    out: dict[str, float] = {}
    volumes = []
    for name, dtype in (("float32", torch.float32), ("float64", torch.float64)):
        # Two steps first, so that compilation and loading are not timed.
        _fit(start, data, views, dtype, 2)
        begin = now()
        fitted = _fit(start, data, views, dtype, steps)
        out[f"seconds_{name}"] = now() - begin
        exact = _as(fitted, torch.float64)
        with torch.no_grad():
            rendered = project(exact, views, implementation="reference").numpy()
            volumes.append(voxelize(exact, grid, implementation="reference").numpy())
        out[f"residual_{name}"] = float(np.linalg.norm(rendered - data) / np.linalg.norm(data))
    single, double = volumes
    out["difference"] = float(np.linalg.norm(single - double) / np.linalg.norm(double))
    return out


def _as(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    """The same Gaussians as leaves of another precision."""
    g = gaussians
    means, log_scales, quaternions, raw = (
        p.detach().to(dtype, copy=True) for p in (g.means, g.log_scales, g.quaternions, g.raw_densities)
    )
    return Gaussians(means, log_scales, quaternions, raw, g.density_unit, g.kernel)


def _fit(start: Gaussians, data: NDArray[np.float32], geometry: Geometry, dtype: torch.dtype, steps: int) -> Gaussians:
    """Adam over the views in turn; only the precision, and with it the kernel, differs between two calls."""
    g = _as(start, dtype)
    half_field = max(geometry.detector_shape) * geometry.sample_pitch / 2
    scale = half_field * g.density_unit
    leaves = [p.requires_grad_() for p in (g.means, g.log_scales, g.quaternions, g.raw_densities)]
    rates = (_RATES[0] * half_field, *_RATES[1:])
    optimiser = torch.optim.Adam([{"params": [p], "lr": lr} for p, lr in zip(leaves, rates, strict=True)], eps=1e-15)
    target = torch.from_numpy(data).to(dtype) / scale
    for step in range(steps):
        view = step * 5 % geometry.n_views
        optimiser.zero_grad()
        image = project(g, geometry, [view])[0] / scale
        projection_loss(image, target[view], 0.25).backward()
        optimiser.step()
    return _as(g, dtype)
