"""Fbp: the direct method: FBP for a parallel beam, FDK for a cone, and a version for rolled and tilted projections."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import import_module
from typing import Any, ClassVar, Self

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from scipy import fft

from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry, require_views
from recon.base.method import ReconProblem, Reconstruction, RunControl
from recon.base.method_kinds import Direct
from recon.base.views import spread
from recon.base.volume import Grid, Volume
from recon.kernels.cpu.activation import OPTIONS
from recon.kernels.cpu.joseph import calls
from recon.voxels.devices import voxel_device
from recon.voxels.fbp import Filter, continuation, continued, fbp, fbp_memory, filter_projections, ramp
from recon.voxels.projector import volume_slices
from recon.voxels.view_weights import cone_weights, density_gain, missing_arc, ray_weights

_f = np.float32
_SAMPLES = 4  # samples of a projector that take as long as one voxel in one projection
_LOOKED_AT = 32  # number of projections in the mean that shows how rows continue; limits the memory
SLAB_BYTES = 128 * 2**20  # filtered projections in memory at a time


@njit(**OPTIONS)
def _along_columns(
    filtered: F32, cosines: F64, sines: F64, col0: F64, row0: F64, sod: float, sdd: float, pitch: float,
    x: F64, y: F64, z: F64, out: F32,
) -> None:  # fmt: skip
    """out[y, x, z] += Σ_view (sod / w)² filtered[view, col, row] bilinearly; lengths in mm, w the voxel's depth."""
    views, cols, rows = filtered.shape[0], filtered.shape[1] - 2, filtered.shape[2] - 2
    nx, ny, nz = x.size, y.size, z.size
    step = (z[1] - z[0]) if nz > 1 else 1.0
    for j in prange(ny):
        line = np.zeros(rows + 4, np.float32)
        for v in range(views):
            c, s = cosines[v], sines[v]
            for i in range(nx):
                depth = sod - x[i] * s + y[j] * c
                magnify = sdd / (depth * pitch)
                col = (x[i] * c + y[j] * s) * magnify + col0[v] + 1.0
                if not (col >= 0.5 and col <= cols + 0.5):
                    continue
                low = math.floor(col)
                part = _f(col - low)
                share = _f((sod / depth) ** 2)
                climb = step * magnify
                base = z[0] * magnify + row0[v] + 1.0
                if nz == 1:
                    if base >= 0.5 and base <= rows + 0.5:
                        row = math.floor(base)
                        a, b = filtered[v, low], filtered[v, low + 1]
                        value, next_value = (
                            a[row] + part * (b[row] - a[row]),
                            a[row + 1] + part * (b[row + 1] - a[row + 1]),
                        )
                        out[j, i, 0] += share * (value + _f(base - row) * (next_value - value))
                    continue
                first = math.ceil(max((0.5 - base) / climb, 0.0))
                end = math.floor(min((rows + 0.5 - base) / climb, nz - 1.0)) + 1
                if end <= first:
                    continue
                a, b = filtered[v, low], filtered[v, low + 1]
                r0 = max(0, math.floor(base + climb * first) - 1)
                r1 = min(rows + 2, math.ceil(base + climb * (end - 1)) + 2)
                # From r0 on, a row in single precision is right to 1e-4; to int32 the compiler converts many at once.
                a, b, near = a[r0:r1], b[r0:r1], line[: r1 - r0]
                for row in range(near.size):
                    near[row] = share * (a[row] + part * (b[row] - a[row]))
                target = out[j, i, first:end]
                start, rise = _f(base + climb * first - r0), _f(climb)
                for k in range(target.size):
                    position = start + rise * _f(k)
                    whole = np.int32(position)
                    target[k] += near[whole] + (position - _f(whole)) * (near[whole + 1] - near[whole])


def fdk(
    projections: NDArray[np.float32],
    geometry: Geometry,
    grid: Grid | None = None,
    filter: Filter = "ram-lak",
    on_block: Callable[[int, int], None] = lambda done, total: None,
) -> NDArray[np.float32]:
    """Reconstruct a cone-beam scan (Feldkamp, Davis & Kress 1984, J. Opt. Soc. Am. A 1, 612); projections in any order.

    The result is exact in the plane of the source. Above and below, values fall off with the square of the cone angle,
    and flat interfaces perpendicular to the axis blur. A 360° scan must see the whole width of the object on one side
    of the axis or on both (see `fan_shares`). A short scan (180° plus the fan angle, or more) must see the whole width
    in every projection (see `cone_weights`). Rows that end in material are extrapolated as in `fbp`. A projection that
    does not see a voxel adds nothing to it.

    Args:
        projections: float32 [view, row, col], line integrals (dimensionless).
        geometry: a cone beam without roll and tilt; projections may be shifted.
        grid: grid of the volume; None: `Grid.matching(geometry)`.
        filter: as for `fbp`.
        on_block: function called with the number of finished layers (times projections) and their total number.

    Returns:
        float32 [z, y, x], 1/mm.

    Raises:
        ValueError: the beam is parallel, projections are rolled or tilted, the scan is too short, the filter is
            unknown, the shape does not match the geometry, values are not finite, or the box reaches the source.
    """
    grid = Grid.matching(geometry) if grid is None else grid
    if not geometry.is_cone:
        raise ValueError("FDK needs a cone beam; for a parallel beam use fbp")
    if not geometry.is_straight:
        raise ValueError("FDK needs projections without roll and tilt; use `direct` for rolled or tilted ones")
    prepare = partial(_prepared_views, filter=filter)
    return _by_slabs(projections, geometry, grid, filter, prepare, _along_columns, on_block)


Prepare = Callable[[F32, Geometry, F64, tuple[int, int], F32 | None], tuple[Any, tuple[Any, ...]]]
"""Function that weights and filters some projections, from their geometry, the weights of their rays, the columns of
zeros and the extrapolation; and the arguments of a kernel that come before the voxels."""


def _by_slabs(
    projections: F32, geometry: Geometry, grid: Grid, filter: Filter, prepare: Prepare,
    kernel: Callable[..., None], on_block: Callable[[int, int], None], device: str = "cpu",
) -> F32:  # fmt: skip
    """Back-project projections [view, row, col], some at a time, to a volume [z, y, x], with a kernel of the device.

    Raises:
        ValueError: the shape does not match the geometry, the projections move along the axis, the box reaches the
            source, or values are not finite.
    """
    require_views(geometry, projections)
    if geometry.climbs:  # each voxel would lack the projections that do not see it
        raise ValueError(
            f"use an iterative method (fista-tv, sirt): the projections move by {np.ptp(geometry.shifts[:, 1]):.4g} "
            f"of {geometry.detector_shape[0]} rows along the rotation axis. Direct methods support such movement "
            "only for a parallel beam without roll and tilt"
        )
    if (reach := float(np.hypot(*np.abs(grid.edges[:, :2]).max(0)))) >= geometry.sod:
        raise ValueError(
            f"use a smaller box: the box reaches {reach:.4g} mm from the rotation axis, but the source is only "
            f"{geometry.sod:.4g} mm from the axis"
        )
    weights, zeros = cone_weights(geometry) if geometry.is_cone else ray_weights(geometry)
    # the part of Fourier space between two projections shrinks by this factor
    weights *= np.cos(geometry.tilt)[:, None]
    looked_at = spread(np.arange(geometry.n_views), _LOOKED_AT)
    mean = sum(projections[view] / np.float32(looked_at.size) for view in looked_at)
    beyond, weights = continuation(mean, geometry, weights, zeros, filter)
    z, y, x = grid.coordinates()
    compute_device = voxel_device(device)
    volume = compute_device.zeros((y.size, x.size, z.size))
    slab = max(1, SLAB_BYTES // (4 * math.prod(geometry.detector_shape)))
    for start in range(0, geometry.n_views, slab):
        slab_views = slice(start, start + slab)
        part = geometry.select(slab_views)
        prepared, of_views = prepare(projections[slab_views], part, weights[slab_views], zeros, beyond)
        # the filter would spread NaN and infinite values; works on any device
        if not math.isfinite(float(prepared.max()) - float(prepared.min())):
            raise ValueError("projections contain NaN or infinite values; correct them before the reconstruction")
        samples = _SAMPLES * part.n_views * x.size * z.size
        for layers in calls(y.size, samples) if device == "cpu" else [range(y.size)]:
            lines = slice(layers.start, layers.stop)
            kernel(prepared, *of_views, x, y[lines], z, volume[lines])
            on_block((start * y.size + part.n_views * layers.stop) // geometry.n_views, y.size)
    return volume_slices(compute_device.numpy(volume))


def _prepared_views(
    views: F32, geometry: Geometry, weights: F64, zeros: tuple[int, int], beyond: F32 | None, filter: Filter
) -> tuple[F32, tuple[Any, ...]]:
    """Filtered projections, after multiplication by the weights [view, 1 + col + 1] and the cosine of each ray.

    The shape is [view, col + 2, row + 2], with the edge columns and rows stored twice."""
    rows, cols = geometry.detector_shape
    out = np.empty((geometry.n_views, sum(zeros) + cols + 2, rows + 2), np.float32)
    for view in range(geometry.n_views):
        cosine = _cosine(geometry, view)
        # The ramp filter is that of a detector at the rotation axis.
        weighed = np.pad((views[view] * (weights[view, 1:-1] * cosine)).astype(np.float32), ((0, 0), zeros))
        filtered = filter_projections(weighed, geometry.sample_pitch, filter)
        if beyond is not None:
            filtered += continued(beyond, views[view] * cosine, weights[view])
        out[view] = np.pad(filtered.T, 1, mode="edge")
    origin = geometry.axis_col + geometry.shifts[:, 0] + zeros[0], geometry.axis_row + geometry.shifts[:, 1]
    turn = np.cos(geometry.angles), np.sin(geometry.angles)
    return out, (*turn, *origin, geometry.sod, geometry.sdd, geometry.pixel_pitch)


def _cosine(geometry: Geometry, view: int) -> F64:
    """Cosine [row, col] of the angle between the rays of a cone and its central ray."""
    (rows, cols), (col0, row0) = geometry.detector_shape, geometry.origin(view)
    u, v = (np.arange(cols) - col0) * geometry.pixel_pitch, (np.arange(rows) - row0) * geometry.pixel_pitch
    return np.asarray(geometry.sdd / np.sqrt(geometry.sdd**2 + u**2 + v[:, None] ** 2))


@njit(**OPTIONS)
def _along_rays(
    filtered: F32, axes: F64, origins: F64, sod: float, sdd: float, pitch: float, x: F64, y: F64, z: F64, out: F32
) -> None:  # fmt: skip
    """out[y, x, z] += Σ_view (sod / w)² filtered[view, col, row] bilinearly; lengths in mm, w the voxel's depth.

    sod = 0: a parallel beam; then the factor is 1.
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
    on_block: Callable[[int, int], None] = lambda done, total: None,
    device: str = "cpu",
) -> F32:
    """Reconstruct rolled and tilted projections [view, row, col]; arguments, result and errors as for `fbp` and `fdk`.

    There are two differences. The ramp filter acts perpendicular to the rotation axis, which on a rolled detector is
    not the direction of the rows. Each voxel reads the filtered projections where its own ray meets the detector, so
    that no projection is resampled. A tilted projection has the weight cos(tilt). The extrapolation beyond an edge is
    smooth from row to row. In the weights of columns that are measured twice, rolled and tilted projections count as
    straight.
    """
    if geometry.centres.any():
        raise ValueError(
            "use an iterative method or r2, because filtered back-projection needs sources on a circle about the "
            "axis, and the sources of these projections are not on a circle"
        )
    gpu = None if device == "cpu" else import_module("recon.kernels.gpu.back_project")

    def prepare(
        views: F32, part: Geometry, weights: F64, zeros: tuple[int, int], beyond: F32 | None
    ) -> tuple[Any, tuple[Any, ...]]:
        each, (rows, cols) = range(part.n_views), part.detector_shape
        responses = (_response(rows, cols + sum(zeros), float(roll), part.sample_pitch, filter) for roll in part.roll)
        if gpu is None:
            prepared = np.stack([_prepared(views[v], part, v, weights[v, 1:-1], zeros, next(responses)) for v in each])
        else:
            prepared = gpu.filtered(views, part, weights[:, 1:-1], zeros, responses)
        for v in each:
            if beyond is not None:
                image = views[v] * (_cosine(part, v) if part.is_cone else 1)
                added = continued(beyond, image, weights[v] * abs(math.cos(part.roll[v])))
                prepared[v] += voxel_device(device).array(np.ascontiguousarray(added.T))
        origins = np.array([part.origin(v) for v in each])
        origins[:, 0] += zeros[0]
        distances = (part.sod, part.sdd) if part.is_cone else (0.0, 0.0)
        return prepared, (np.stack([part.axes(v) for v in each]), origins, *distances, part.pixel_pitch)

    kernel = _along_rays if gpu is None else gpu.back_project
    return _by_slabs(projections, geometry, grid, filter, prepare, kernel, on_block, device)


Response = tuple[int, tuple[int, int], F32]
"""A filter in two dimensions: rows added on either side, the shape of the transform, and the gain [row or 1, col]."""


@lru_cache(1)  # most scans have the same roll in all projections
def _response(rows: int, width: int, roll: float, pitch: float, filter: Filter) -> Response:
    """The ramp filter perpendicular to the axis, for this roll, `rows` rows and `width` padded columns."""
    # rows that the line of the ramp crosses; outside, the last rows are repeated
    beyond = math.ceil(width * abs(math.sin(roll)))
    m, n = fft.next_fast_len(rows + 2 * beyond), fft.next_fast_len(2 * width, real=True)
    along = fft.fftfreq(m)[:, None] if roll else np.zeros((1, 1))
    across = np.abs(fft.rfftfreq(n) * math.cos(roll) - along * math.sin(roll))
    response = ramp(n, pitch, filter)
    return beyond, (m, n), np.interp(across, np.arange(response.size) / n, response).astype(np.float32)


def _prepared(
    image: F32, geometry: Geometry, view: int, weights: F64, zeros: tuple[int, int], response: Response
) -> F32:  # fmt: skip
    """A projection [row, col], weighted, padded with zeros and filtered perpendicular to the axis: [col, row]."""
    rows, cols = geometry.detector_shape
    weighed = image * weights
    if geometry.is_cone:
        weighed *= _cosine(geometry, view)
    beyond, shape, gain = response
    wide = np.pad(np.pad(weighed, ((0, 0), zeros)), ((beyond, beyond), (0, 0)), mode="edge").astype(np.float32)
    filtered = fft.irfft2(fft.rfft2(wide, shape) * gain, shape)
    return np.ascontiguousarray(filtered[beyond : beyond + rows, : cols + sum(zeros)].T)


@dataclass(frozen=True)
class Fbp(Direct):
    """Filtered back-projection (FDK for a cone).

    Attributes:
        filter: window of the ramp filter; the smooth "hann" is best for few or noisy projections.
    """

    name: ClassVar[str] = "fbp"
    label: ClassVar[str] = "FBP"
    error_bars: ClassVar[tuple[float, float] | None] = 1.0, 0.7

    filter: Filter = "hann"

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        filled = problem.views.masked().data
        begin, views = control.now(), problem.geometry.n_views

        def progress(done: int, slices: int) -> None:
            control.report_progress(done, slices, begin, views, "slices")

        data = direct(filled, problem.geometry, problem.grid, self.filter, progress, device=problem.device)
        if (gain := density_gain(problem.geometry)) != 1:
            data *= np.float32(gain)
        return Reconstruction(Volume(data, problem.grid), {"filter": self.filter})

    def views_wanted(self, geometry: Geometry) -> NDArray[np.bool_]:
        """True for all projections except laterally offset ones. Raises ValueError for a cone scan that is too short
        for FDK, or whose angles have several gaps.
        """
        if geometry.is_cone and missing_arc(geometry) > 0:
            cone_weights(geometry)  # the error says how many degrees are missing
        return super().views_wanted(geometry)

    def toy(self) -> Self:
        return self

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        views, (rows, cols) = geometry.n_views, geometry.detector_shape
        fbp_buffers = fbp_memory(views, max(cols, grid.shape[2]))
        return 4 * (math.prod(grid.shape) + 2 * weighted * views * rows * cols) + fbp_buffers


def direct(
    projections: F32,
    geometry: Geometry,
    grid: Grid,
    filter: Filter = "ram-lak",
    on_block: Callable[[int, int], None] = lambda done, total: None,
    out: F32 | None = None,
    device: str = "cpu",
) -> F32:
    """FBP of a parallel beam or FDK of a cone [z, y, x], also for rolled and tilted projections.

    See `fbp`, `fdk` and `posed_direct`. Only `fbp` uses `out`. Projections of a parallel beam without roll and tilt are
    reconstructed on the CPU. Laterally offset projections are not used."""
    if not (own := geometry.is_centred).all():
        projections, geometry = projections[own], geometry.select(np.flatnonzero(own))
    if not geometry.is_straight or (geometry.is_cone and device != "cpu"):
        return posed_direct(projections, geometry, grid, filter, on_block, device)
    if geometry.is_cone:
        return fdk(projections, geometry, grid, filter, on_block)
    return fbp(projections, geometry, grid, filter, on_block, out)


def has_direct_method(geometry: Geometry) -> bool:
    """Whether FBP or FDK can use these projections: a cone needs a circle of sources, or a short scan (`missing_arc`).

    Projections that move along the axis need weights for each slice. These exist only for a parallel beam without roll
    and tilt.
    """
    if geometry.centres.any():
        return False
    if geometry.climbs:
        return geometry.is_straight and not geometry.is_cone
    return not geometry.is_cone or missing_arc(geometry) == 0
