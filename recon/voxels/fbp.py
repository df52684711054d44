"""Filtered back-projection for parallel beam: the fast baseline, in 1/mm.

f(x, y) = ∫₀^π q_θ(x cos θ + y sin θ) dθ, where q_θ is a projection convolved with the band-limited ramp (Kak & Slaney
1988, eq. 3.61 and 3.69). Rows are independent, so the computation runs in blocks of sixteen slices, counted from the
first slice of the volume. Blocks that are computed one by one are bit-identical to those of the whole volume.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, get_args

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray
from scipy import fft

from recon.base.arrays import F32, F64
from recon.base.choices import Filter as Filter
from recon.base.geometry import Geometry, require_views
from recon.base.registry import unknown
from recon.base.slabs import bands_of, slices_of
from recon.base.volume import Grid
from recon.voxels.back_project import SLICES, by_gridding, columns_of, gridding, gridding_pays, ray_by_ray
from recon.voxels.field_edges import FARTHEST, edge_levels, ends_in_matter, sample_reach
from recon.voxels.view_weights import column_shares, ray_weights, seen_by, slice_weights

_VIEWS = 32  # projections filtered at a time
_FEW_COLUMNS_FARTHER = 5  # columns


def ramp(n: int, pixel_pitch: float, filter: Filter) -> NDArray[np.float32]:
    """Transfer function [n // 2 + 1] of the ramp filter for a transform of n samples, 1/mm."""
    # The kernel is sampled in space and then transformed. Sampling |ω| would lose the mean value of the volume.
    k = np.minimum(np.arange(n), n - np.arange(n))
    kernel = np.zeros(n)
    kernel[0] = 1 / 4
    odd = k % 2 == 1
    kernel[odd] = -1 / (np.pi * k[odd]) ** 2
    response = fft.rfft(kernel).real / pixel_pitch
    f = np.arange(response.size) / n  # cycles per sample; Nyquist is 1/2
    if filter == "shepp-logan":
        response *= np.sinc(f)
    elif filter == "hann":
        response *= 0.5 + 0.5 * np.cos(2 * np.pi * f)
    return response.astype(np.float32)


def filter_projections(
    projections: NDArray[np.float32], pixel_pitch: float = 1.0, filter: Filter = "ram-lak"
) -> NDArray[np.float32]:
    """Convolve every detector row with the band-limited ramp (Kak & Slaney 1988, eq. 3.61), zero outside the detector.

    Args:
        projections: float32 [..., col], line integrals.
        filter: window of the ramp, 1 at zero frequency: no window (ram-lak), sinc (shepp-logan), raised cosine (hann).

    Returns:
        float32 of the same shape, 1/mm for dimensionless line integrals.

    Raises:
        ValueError: the filter is unknown.
    """
    _known(filter)
    cols = projections.shape[-1]
    n = fft.next_fast_len(2 * cols, real=True)  # no wrap-around for kernels as long as the row
    spectrum = fft.rfft(np.asarray(projections, np.float32), n, axis=-1, workers=get_num_threads())
    spectrum *= ramp(n, pixel_pitch, filter)
    return fft.irfft(spectrum, n, axis=-1, workers=get_num_threads())[..., :cols]


def _known(filter: str) -> None:
    if filter not in get_args(Filter):
        raise ValueError(unknown("filter", filter, get_args(Filter)))


def continuation(
    mean: F32, geometry: Geometry, weights: NDArray[Any], zeros: tuple[int, int], filter: Filter
) -> tuple[F32 | None, NDArray[Any]]:
    """What filtering adds inside the field if rows are extrapolated as an ellipse, for a level of 1 at the edge.

    A row that ends in material makes a bright rim and too low values in the middle, because the filter treats
    everything outside as air (Lewitt 1979, Med. Phys. 6, 412). The extrapolation corrects this. It does not replace a
    wider field of view. The ellipse ends at the `sample_reach` of the mean projection [row, col].

    Returns:
        float32 [row, side, col] including the columns of zeros, 0 for rows that end in air; None if all rows end in
        air. Also the weights [view, 1 + col + 1] of `ray_weights`. If a row is extrapolated and one edge is only a few
        columns farther out, which is too short for a transition of the shares, all columns have the share at the axis.
    """
    cols, axes, input_weights = mean.shape[1], geometry.axis_col + geometry.offsets[:, 0], weights
    edges = np.array([(axis := float(axes.mean())) + 0.5, cols - 0.5 - axis])
    if not geometry.is_cone and np.abs(2 * axes + 1 - cols).max() <= _FEW_COLUMNS_FARTHER:
        weights = np.repeat(weights[:, round(axis) + 1, None], cols + 2, axis=1)
    cut = ends_in_matter(mean) & weights[:, (0, -1)].any(axis=0)
    cut_rows = np.flatnonzero(cut.any(axis=1))
    if not cut_rows.size:
        return None, input_weights
    filtered = np.zeros((len(mean), 2, cols + sum(zeros)), np.float32)
    ends = sample_reach(mean, axis)
    for row in cut_rows:
        reach = min(max(ends[row], *np.abs(edges * cut[row])), FARTHEST * edges.max())
        length = max(*zeros, math.ceil(reach - edges.min()))
        fall = np.sqrt(np.maximum(reach**2 - (np.arange(-length, cols + length) - axis) ** 2, 0))
        sides = np.zeros((2, fall.size), np.float32)
        sides[0, :length], sides[1, length + cols :] = fall[:length], fall[length + cols :]
        sides /= np.maximum(edge_levels(fall[length : length + cols]), 1e-6 * reach)[:, None]
        wide = filter_projections(sides, geometry.sample_pitch, filter)
        filtered[row] = cut[row, :, None] * wide[:, length - zeros[0] : length + cols + zeros[1]]
    return filtered, weights


def continued(beyond: F32, views: F32, weights: NDArray[np.floating]) -> F32:
    """The part to add to filtered projections [..., row, col] with columns of zeros, from `continuation`.

    It is the `continuation` times the edge values of the projections and their weights."""
    levels = (edge_levels(views) * weights[..., None, (0, -1)]).astype(np.float32)
    return levels[..., :1] * beyond[:, 0] + levels[..., 1:] * beyond[:, 1]


@dataclass(frozen=True, eq=False)
class FbpPlan:
    """FBP of a scan, ready to reconstruct any block of slices.

    Attributes:
        geometry, grid, filter: as given.
        share: float32 [view, 1, 1 + col + 1], quadrature weight of each ray, see `ray_weights`.
        column_shares: shares of the columns if not all projections see all slices, so that weights differ from slice to
            slice; None: `share` is valid for all slices.
        zeros: number of columns of zeros to add before and after the columns.
        rows: [z], detector rows at which an unshifted projection sees the slices.
        back_project: function (columns [view, 1 + col + 1, 16], out [z, y, x]).
    """

    geometry: Geometry
    grid: Grid
    filter: Filter
    share: F32
    column_shares: F64 | None
    zeros: tuple[int, int]
    rows: F64
    back_project: Callable[[F32, F32], None]

    @property
    def blocks(self) -> list[slice]:
        """Slices of the volume that are reconstructed together."""
        return [slice(first, min(first + SLICES, self.rows.size)) for first in range(0, self.rows.size, SLICES)]

    def rows_of(self, part: slice) -> tuple[int, int]:
        """The detector rows that show these slices in any projection, as (first, after the last); at least one row."""
        rows, shifts = self.rows[part], self.geometry.shifts[:, 1]
        last = self.geometry.detector_shape[0] - 1
        low = np.clip(math.floor(rows.min() + shifts.min()), 0, last)
        return int(low), int(np.clip(math.floor(rows.max() + shifts.max()) + 1, low, last)) + 1


def plan_fbp(geometry: Geometry, grid: Grid, filter: Filter = "ram-lak") -> FbpPlan:
    """The part of `fbp` that does not depend on the data. With a skew, all rows have the angle of the middle row.

    Raises:
        ValueError: as for `fbp`, about the filter and the geometry.
    """
    _known(filter)
    if geometry.is_cone:
        raise ValueError("FBP needs a parallel beam; for a cone beam use fdk")
    if not geometry.is_straight:
        raise ValueError("FBP needs projections without roll and tilt; use `direct` for rolled or tilted ones")
    geometry = geometry.at_row((geometry.detector_shape[0] - 1) / 2)
    z, y, x = (axis / geometry.pixel_pitch for axis in grid.coordinates())
    weights, zeros = ray_weights(geometry)
    axis_cols = geometry.axis_col + geometry.shifts[:, 0] + zeros[0]
    cols = geometry.detector_shape[1] + sum(zeros)
    back_project = partial(ray_by_ray, geometry.angles, axis_cols, x, y)
    if is_gridded(geometry, grid, filter):
        response = partial(ramp, pixel_pitch=1.0, filter=filter)
        back_project = partial(by_gridding, gridding(geometry.angles, axis_cols, cols, x, y, response))
    share, rows = weights.astype(np.float32)[:, None], z + geometry.axis_row
    differ = geometry.shifts[:, 1].any() and not seen_by(geometry, rows).all()
    shares = column_shares(geometry)[0] if differ else None
    return FbpPlan(geometry, grid, filter, share, shares, zeros, rows, back_project)


def fbp_memory(views: int, cols: int) -> int:
    """Approximate memory in bytes of the plan and a block for slices [cols, cols], without projections and volume."""
    samples, cells = round(1.4 * cols), (round(1.25 * cols) + 64) ** 2
    return 64 * views * (cols + 2 * samples) + 16 * views * samples + 64 * cells + 4 * 32 * 16 * 8 * cols


def is_gridded(geometry: Geometry, grid: Grid, filter: Filter) -> bool:
    """Whether FBP of these projections uses gridding; False for a cone and for rolled or tilted projections."""
    if geometry.is_cone or not geometry.is_straight:
        return False
    response = partial(ramp, pixel_pitch=1.0, filter=filter)
    nz, ny, nx = grid.shape
    return gridding_pays(geometry.n_views, geometry.detector_shape[1], (ny, nx), nz, response)


def fbp_block(plan: FbpPlan, projections: F32, first: int, part: slice, out: F32) -> None:
    """Reconstruct the slices of a block.

    Args:
        projections: float32 [view, row, col]: the detector rows `plan.rows_of(part)`, or more.
        first: number of the first of the given rows.
        part: one of `plan.blocks`.
        out: float32 [z, y, x], the slices.

    Raises:
        ValueError: values are not finite.
    """
    geometry, rows = plan.geometry, plan.rows[part]
    columns = columns_of(geometry.n_views, geometry.detector_shape[1] + sum(plan.zeros))
    low, end = plan.rows_of(part)
    own = slice(low - first, end - first)
    mean = projections[:, own].mean(axis=0)
    beyond, weights = continuation(mean, geometry, plan.share[:, 0], plan.zeros, plan.filter)
    share = weights[:, None] if plan.column_shares is None else _shares_of(plan, rows, plan.column_shares)
    for begin in range(0, geometry.n_views, _VIEWS):
        views = slice(begin, begin + _VIEWS)
        weighed = _slab(projections[views], geometry.shifts[views, 1], rows, first, geometry.detector_shape[0])
        weighed *= share[views, :, 1:-1]
        if any(plan.zeros):
            weighed = np.pad(weighed, ((0, 0), (0, 0), plan.zeros))
        filtered = filter_projections(weighed, geometry.pixel_pitch, plan.filter)
        if beyond is not None:
            added = continued(beyond, projections[views, own], weights[views])
            filtered += _slab(added, geometry.shifts[views, 1], rows, low, geometry.detector_shape[0])
        if not np.isfinite(filtered).all():
            raise ValueError("projections contain NaN or infinite values; correct them before the reconstruction")
        columns[views, 1:-1, : rows.size] = filtered.transpose(0, 2, 1)
    columns[:, 0], columns[:, -1] = columns[:, 1], columns[:, -2]
    plan.back_project(columns, out)


def _shares_of(plan: FbpPlan, rows: F64, shares: F64) -> F32:
    """Weights of the rays of some slices, float32 [view, slice or 1, 1 + col + 1]."""
    covered = seen_by(plan.geometry, rows)
    if covered.all():
        return plan.share
    weights = [slice_weights(plan.geometry, covered_views, shares) for covered_views in covered.T]
    return np.stack(weights, axis=1).astype(np.float32)


def _rows_at(projections: F32, rows: F64, first: int, height: int) -> F32:
    """Projections at fractional rows, interpolated linearly; 0 outside the detector. The data begin at row `first`."""
    inside = (rows >= -0.5) & (rows <= height - 0.5)
    clamped = np.clip(rows, 0, height - 1)
    lower = np.floor(clamped).astype(np.intp)
    weight = (clamped - lower).astype(np.float32)
    if np.array_equal(rows, lower):
        return projections[:, lower - first]
    upper = np.minimum(lower + 1, height - 1)
    low_part = projections[:, lower - first] * np.where(inside, 1 - weight, 0).astype(np.float32)[:, None]
    return low_part + projections[:, upper - first] * np.where(inside, weight, 0).astype(np.float32)[:, None]


def _slab(projections: F32, shifts: F64, rows: F64, first: int, height: int) -> F32:
    """Projections at the detector rows that show the same heights; each projection has its own shift."""
    if not shifts.any():
        return _rows_at(projections, rows, first, height)
    moved = zip(projections, shifts, strict=True)
    return np.concatenate([_rows_at(view[None], rows + shift, first, height) for view, shift in moved])


def fbp(
    projections: F32,
    geometry: Geometry,
    grid: Grid | None = None,
    filter: Filter = "ram-lak",
    on_block: Callable[[int, int], None] = lambda done, total: None,
    out: F32 | None = None,
) -> F32:
    """Reconstruct by filtered back-projection (Kak & Slaney 1988, §3.3); projections in any order.

    The filtered projections are interpolated linearly at the centres of the voxels; many projections are gridded
    instead. The two agree within 1e-3 of the peak (see `recon.voxels.back_project`). For voxels larger than a pixel,
    bin the projections first. A projection that does not see a voxel adds nothing to it, unless its opposite projection
    sees it. If projections are shifted along the axis, a slice is reconstructed from the projections that see it. A
    360° scan with the axis off the middle of the detector, or outside it, covers the field of view out to the far
    columns.

    Args:
        projections: float32 [view, row, col], line integrals (dimensionless).
        grid: grid of the volume; None: one voxel per pixel, `Grid.matching(geometry)`.
        filter: "ram-lak", "shepp-logan" or "hann".
        on_block: function called after each block with the number of finished slices and their total number.
        out: float32 [z, y, x] to write to; None: a new one.

    Returns:
        float32 [z, y, x], 1/mm (1/pixel for a pitch of 1).

    Raises:
        ValueError: the shape does not match the geometry, values are not finite, the filter is unknown, or the beam is
            a cone, rolled or tilted.
    """
    require_views(geometry, projections)
    grid = Grid.matching(geometry) if grid is None else grid
    if out is None:
        out = np.empty(grid.shape, np.float32)
    for band, views in bands_of(geometry, grid):
        plan = plan_fbp(views, slices_of(grid, band) if geometry.skew else grid, filter)
        for part in plan.blocks:
            fbp_block(plan, projections, 0, part, out[band][part])
            on_block(band.start + part.stop, len(out))
    return out
