"""Fbp: the direct method, FBP for a parallel beam, FDK for a cone, and views in any pose along their own rays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Self

import numpy as np
from numba import njit, prange
from scipy import fft

from recon.base.arrays import F32, F64
from recon.base.declared_types import check_settings
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import Progress, ReconProblem, Reconstruction, RunControl, Traits
from recon.base.volume import Grid, Volume
from recon.base.work import Costs, Work
from recon.kernels.cpu.activation import OPTIONS
from recon.kernels.cpu.joseph import calls
from recon.voxels.back_project import SLICES, nanoseconds
from recon.voxels.fbp import Filter, fbp, fbp_memory, ramp
from recon.voxels.fdk import fdk, refuse_climbing
from recon.voxels.projector import volume_slices
from recon.voxels.view_weights import cone_weights, missing_arc, ray_weights

_f = np.float32
_SLAB_BYTES = 128 * 2**20  # filtered views held at a time
_SAMPLES = 4  # samples of a projector that take as long as a voxel in a view


@njit(**OPTIONS)
def _back_project(
    filtered: F32, axes: F64, origins: F64, sod: float, sdd: float, pitch: float, x: F64, y: F64, z: F64, out: F32
) -> None:  # fmt: skip
    """out[y, x, z] += Σ_view (sod / w)² filtered[view, col, row] bilinearly; lengths in mm, w the voxel's depth.

    sod = 0: a parallel beam, where the factor is 1.
    """
    views, cols, rows = filtered.shape
    for j in prange(y.size):
        for v in range(views):
            e = axes[v]
            for i in range(x.size):
                u0, v0 = x[i] * e[0, 0] + y[j] * e[0, 1], x[i] * e[1, 0] + y[j] * e[1, 1]
                depth = sod + x[i] * e[2, 0] + y[j] * e[2, 1]
                for k in range(z.size):
                    magnify, share = 1.0 / pitch, _f(1)
                    if sod > 0.0:
                        w = depth + z[k] * e[2, 2]
                        magnify, share = sdd / (w * pitch), _f((sod / w) ** 2)
                    col = origins[v, 0] + (u0 + z[k] * e[0, 2]) * magnify
                    row = origins[v, 1] + (v0 + z[k] * e[1, 2]) * magnify
                    if not (-0.5 <= col <= cols - 0.5 and -0.5 <= row <= rows - 0.5):
                        continue
                    col, row = min(max(col, 0.0), cols - 1.0), min(max(row, 0.0), rows - 1.0)
                    a, b = int(col), int(row)
                    a1, b1 = min(a + 1, cols - 1), min(b + 1, rows - 1)
                    p, q = _f(col - a), _f(row - b)
                    near = filtered[v, a, b] + q * (filtered[v, a, b1] - filtered[v, a, b])
                    far = filtered[v, a1, b] + q * (filtered[v, a1, b1] - filtered[v, a1, b])
                    out[j, i, k] += share * (near + p * (far - near))


def posed_direct(
    projections: F32,
    geometry: Geometry,
    grid: Grid,
    filter: Filter = "ram-lak",
    on_block: Callable[[int, int], None] = lambda done, of: None,
) -> F32:
    """Reconstruct rolled and tilted views [view, row, col]; see `fbp` and `fdk` for arguments, result and errors.

    Two things differ from them. The ramp runs along the direction of the detector that is across the rotation axis,
    which a rolled detector's rows are not. Each voxel takes the filtered views where its own ray meets the detector, so
    no view is resampled. A tilted view weighs cos(tilt): the part of Fourier space between two views shrinks by it.

    Weights of columns that are measured twice count rolled and tilted views as straight ones.
    """
    expected = (geometry.n_views, *geometry.detector_shape)
    if projections.shape != expected:
        raise ValueError(
            f"projections have shape {projections.shape}, the geometry expects [view, row, col] {expected}"
        )
    refuse_climbing(geometry)
    if geometry.centres.any():
        raise ValueError(
            "the sources of these views lie on no circle about the axis, which filtered back-projection needs. Take an "
            "iterative method or r2"
        )
    reach = float(np.hypot(*np.abs(grid.edges[:, :2]).max(0)))
    if reach >= geometry.sod:
        raise ValueError(
            f"the box reaches {reach:.4g} mm from the rotation axis, the source stands at {geometry.sod:.4g}"
        )
    weights, zeros = cone_weights(geometry) if geometry.is_cone else ray_weights(geometry)
    weights = weights * np.cos(geometry.tilt)[:, None]
    z, y, x = grid.coordinates()
    rows, cols = geometry.detector_shape
    volume = np.zeros((y.size, x.size, z.size), np.float32)
    slab = max(1, _SLAB_BYTES // (4 * rows * cols))
    for start in range(0, geometry.n_views, slab):
        some = range(start, min(start + slab, geometry.n_views))
        prepared = np.stack([_prepared(projections[v], geometry, v, weights[v], zeros, filter) for v in some])
        if not np.isfinite(prepared).all():
            raise ValueError("projections hold NaN or infinite values; correct them before reconstruction")
        axes = np.stack([geometry.axes(v) for v in some])
        origins = np.array([geometry.origin(v) for v in some])
        origins[:, 0] += zeros[0]
        sod, sdd = (geometry.sod, geometry.sdd) if geometry.is_cone else (0.0, 0.0)
        for part in calls(y.size, _SAMPLES * len(some) * x.size * z.size):
            lines = slice(part.start, part.stop)
            _back_project(prepared, axes, origins, sod, sdd, geometry.pixel_pitch, x, y[lines], z, volume[lines])
            on_block((start * y.size + len(some) * part.stop) // geometry.n_views, y.size)
    return volume_slices(volume)


def _prepared(image: F32, geometry: Geometry, view: int, weights: F64, zeros: tuple[int, int], filter: Filter) -> F32:
    """A view [row, col], weighed and filtered across the rotation axis: [col, row], with columns of zeros beside it."""
    rows, cols = geometry.detector_shape
    weighed = image * weights
    if geometry.is_cone:
        col0, row0 = geometry.origin(view)
        u, v = (np.arange(cols) - col0) * geometry.pixel_pitch, (np.arange(rows) - row0) * geometry.pixel_pitch
        weighed *= geometry.sdd / np.sqrt(geometry.sdd**2 + u**2 + v[:, None] ** 2)
    roll, width = float(geometry.roll[view]), cols + sum(zeros)
    beyond = math.ceil(width * abs(math.sin(roll)))  # rows that the ramp's line spans: as the last ones
    wide = np.pad(np.pad(weighed, ((0, 0), zeros)), ((beyond, beyond), (0, 0)), mode="edge").astype(np.float32)
    m, n = fft.next_fast_len(rows + 2 * beyond), fft.next_fast_len(2 * width, real=True)
    across = np.abs(fft.rfftfreq(n) * math.cos(roll) - fft.fftfreq(m)[:, None] * math.sin(roll))
    response = ramp(n, geometry.sample_pitch, filter)
    gain = np.interp(across, np.arange(response.size) / n, response).astype(np.float32)
    filtered = fft.irfft2(fft.rfft2(wide, (m, n)) * gain, (m, n))
    return np.ascontiguousarray(filtered[beyond : beyond + rows, :width].T)


@dataclass(frozen=True)
class Fbp:
    """Filtered back-projection (FDK for a cone).

    Attributes:
        filter: the smooth one, "hann", is best for few or noisy views.
    """

    name: ClassVar[str] = "fbp"
    label: ClassVar[str] = "FBP"
    traits: ClassVar[Traits] = Traits(direct=True, error_bars=(1.0, 0.7))

    filter: Filter = "hann"

    def __post_init__(self) -> None:
        check_settings(self)

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        filled = masked(problem.projections, problem.use.weights)[0]
        begin, views = control.now(), problem.geometry.n_views

        def progress(done: int, slices: int) -> None:
            if control.on_progress is not None:
                nan = math.nan
                control.on_progress(Progress(done, slices, control.now() - begin, nan, nan, 0, views, unit="slices"))

        data = direct(filled, problem.geometry, problem.grid, self.filter, progress)
        return Reconstruction(Volume(data, problem.grid), {"filter": self.filter})

    def toy(self) -> Self:
        return self

    def costs(self, geometry: Geometry, grid: Grid) -> Costs:
        if geometry.is_cone and missing_arc(geometry) > 0:
            cone_weights(geometry)  # refuses these views by the degrees that they lack
        return Costs({self.name: direct_work(geometry, grid)})

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        views, (rows, cols) = geometry.n_views, geometry.detector_shape
        beside = fbp_memory(views, max(cols, grid.shape[2]))
        return 4 * (math.prod(grid.shape) + 2 * weighted * views * rows * cols) + beside


def direct(
    projections: F32,
    geometry: Geometry,
    grid: Grid,
    filter: Filter = "ram-lak",
    on_block: Callable[[int, int], None] = lambda done, of: None,
    out: F32 | None = None,
) -> F32:
    """FBP of a parallel beam, FDK of a cone [z, y, x], both along the rays of rolled and tilted views; see `fbp`, `fdk`
    and `posed_direct`. Only `fbp` takes `out`."""
    if not geometry.is_straight:
        return posed_direct(projections, geometry, grid, filter, on_block)
    if geometry.is_cone:
        return fdk(projections, geometry, grid, filter, on_block)
    return fbp(projections, geometry, grid, filter, on_block, out)


def direct_work(geometry: Geometry, grid: Grid) -> Work:
    """The work of `direct`; of views that it does not take, none."""
    if not has_direct_method(geometry):
        return Work()
    nz, ny, nx = grid.shape
    views, cols = geometry.n_views, geometry.detector_shape[1]
    if geometry.is_cone or not geometry.is_straight:
        kind = "cone" if geometry.is_straight else "posed"
        return Work.of(f"back-projection, {kind}", views * ny * nx, views * ny * nx * nz)
    ways = nanoseconds(views, cols, (ny, nx), nz, partial(ramp, pixel_pitch=1.0, filter="hann"))
    blocks = -(-nz // SLICES)
    way = "rays" if ways[0] <= ways[1] else "gridding"
    rays = 0.0 if way == "gridding" else float(views * SLICES * blocks * cols)  # gridding has them among its points
    return Work.of(f"fbp, {way}", rays, 1e-9 * min(ways) * blocks)


def has_direct_method(geometry: Geometry) -> bool:
    """Whether FBP or FDK takes these views: a cone needs a circle of sources, or a short scan (`missing_arc`).

    Views that climb along the axis have weights of their own in each slice, which only straight parallel ones have.
    """
    if geometry.centres.any():
        return False
    if geometry.climbs:
        return geometry.is_straight and not geometry.is_cone
    return not geometry.is_cone or missing_arc(geometry) == 0
