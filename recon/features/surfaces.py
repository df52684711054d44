"""surface: where a volume, or the density of Gaussians, crosses a level, as a closed mesh; marching cubes by slabs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.volume import Grid
from recon.post import clusters
from recon.splatting.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Mesh:
    """A closed surface of triangles.

    Attributes:
        vertices: float32 [n, 3], (x, y, z) in the unit of the grid.
        faces: int32 [m, 3], numbers of vertices, anticlockwise for one who looks from air at matter.
    """

    vertices: F32
    faces: NDArray[np.int32]

    @property
    def volume(self) -> float:
        """Volume of the matter inside: a sixth of Σ a · (b x c) over the triangles (divergence theorem)."""
        if not len(self.faces):
            return 0.0
        a, b, c = np.moveaxis((self.vertices - self.vertices.mean(axis=0))[self.faces], 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c), dtype=np.float64)) / 6

    @property
    def euler(self) -> int:
        """Vertices - edges + faces: 2 for each closed shell, less 2 for each of its handles."""
        return len(self.vertices) - len(self.faces) // 2


BLOCK = 2**20  # voxels of a slab: a second or two where all is noise
_LOOKED = 2**20  # voxels from which the level is found
_RANGE = 0.5, 99.5  # percentiles at which they are cut, as for particles: a speck of metal is not the matter
_APART = 5e-4  # least distance of a voxel from the level, over the largest contrast
_WORK = 3  # copies of a mesh while it is joined


class BySlices(Protocol):
    """Voxels that are read slice by slice: an array, or a dataset of a file."""

    def __getitem__(self, z: slice, /) -> NDArray[np.number]: ...


class _Shared(NamedTuple):
    """Vertices in the slice that two slabs share: the lattice edges on which they lie, rising, and their numbers."""

    edges: NDArray[np.int64] = np.empty(0, np.int64)
    numbers: NDArray[np.int64] = np.empty(0, np.int64)


def half_way(data: BySlices, n_slices: int) -> float:
    """The level half-way between air and matter (ISO 50 % rule): between the medians of two clusters by k-means.

    Raises:
        ValueError: all values are one, or some are not finite.
    """
    thick = max(1, n_slices // 32)
    looked = range(thick // 2, n_slices, thick)
    slices = (np.asarray(data[z : z + 1], np.float32).ravel() for z in looked)
    sample = np.concatenate([some[:: max(1, some.size * len(looked) // _LOOKED)] for some in slices])
    cut = np.clip(sample, *np.percentile(sample, _RANGE))
    sample = cut if np.ptp(cut) else sample
    dense = sample > clusters(sample, 2).threshold
    return float(np.median(sample[dense]) + np.median(sample[~dense])) / 2


def surface(
    data: BySlices,
    grid: Grid,
    level: float,
    most: float = np.inf,
    count: Callable[[int, int], None] = lambda done, of: None,
) -> Mesh:
    """The surface of the matter above a level (Lewiner et al. 2003), closed at the faces of the box.

    Slabs share a slice. The edge of the lattice on which a vertex lies names it, so slabs are joined without a
    tolerance. Each edge of the mesh has two triangles.

    Args:
        data: [z, y, x], read twice, a few slices at a time.
        most: bytes that the mesh may take while it is joined.
        count: takes slices done and all.

    Raises:
        ValueError: no voxel, or every one, is above the level; some are not finite; or the mesh takes too much.
    """
    from skimage.measure import marching_cubes

    n, (ny, nx) = grid.shape[0], grid.shape[1:]
    thick = max(1, BLOCK // ((ny + 2) * (nx + 2)))
    least = _least(data, n, thick, level)
    vertices, faces = list[F32](), list[NDArray[np.int32]]()
    total, size = 0, 0  # vertices, and bytes of the mesh
    below = _Shared()
    for first in range(-1, n, thick):
        last = min(first + thick, n)
        block = _padded(data, first, last, n, level)
        block = np.copysign(np.maximum(np.abs(block), least), block)
        if block.min() > 0 or block.max() < 0:
            below = _Shared()
            count(min(last + 1, n), n)
            continue
        at, corners, _, _ = marching_cubes(block, 0.0)
        edges = (np.floor(at[:, 1:]) + np.ceil(at[:, 1:])).astype(np.int64) @ (2 * nx + 4, 1)
        own = (at[:, 0] > 0) | (below.edges.size == 0)
        number = np.empty(len(at), np.int64)
        number[~own] = below.numbers[np.searchsorted(below.edges, edges[~own])]
        number[own] = total + np.arange(own.sum())
        total += int(own.sum())
        size += 12 * (int(own.sum()) + len(corners))
        if _WORK * size > most or total > np.iinfo(np.int32).max:
            raise ValueError(
                f"the surface up to slice {last} of {n} has {total} vertices, which take {_WORK * size / 1e9:.3g} of "
                f"{most / 1e9:.3g} GB: noise has much surface. Take another level, or a smoother or binned volume"
            )
        vertices.append((at[own] + (first, -1, -1))[:, ::-1].astype(np.float32))
        faces.append(number[corners].astype(np.int32))
        top = np.flatnonzero(at[:, 0] == last - first)
        top = top[np.argsort(edges[top])]
        below = _Shared(edges[top], number[top])
        count(min(last + 1, n), n)
    if not vertices:
        raise ValueError(f"no surface: no value lies above the level {level:.4g}")
    return Mesh(_in_mm(np.concatenate(vertices), grid), np.concatenate(faces))


def _in_mm(vertices: F32, grid: Grid) -> F32:
    """Vertices (x, y, z) in voxels from the first one, changed to mm in place."""
    vertices *= np.asarray(grid.spacing[::-1], np.float32)
    vertices += np.asarray(grid.first[::-1], np.float32)
    return vertices


def _least(data: BySlices, n: int, thick: int, level: float) -> float:
    """Least distance of a voxel from the level, so that no vertex of float32 falls on a corner of the lattice."""
    largest = 0.0
    for first in range(0, n, thick):
        values = np.asarray(data[first : first + thick], np.float32)
        if not np.isfinite(values).all():
            raise ValueError(f"slices {first} to {first + len(values) - 1} have values that are not finite")
        largest = max(largest, float(values.max()) - level, level - float(values.min()))
    return _APART * largest


def _padded(data: BySlices, first: int, last: int, n: int, level: float) -> F32:
    """Slices first to last, less the level; one more on each side of the box is such that matter ends at its face."""
    low, high = max(first, 0), min(last, n - 1) + 1
    inside = np.asarray(data[low:high], np.float32) - np.float32(level)
    block = np.pad(inside, ((low - first, last + 1 - high), (1, 1), (1, 1)), mode="edge")
    rims = [block[:, 0], block[:, -1], block[:, :, 0], block[:, :, -1]]
    for rim in rims + [block[0]] * (first < 0) + [block[-1]] * (last == n):
        rim[:] = -np.abs(rim)
    return block


_SIGMAS = 5.0  # where a true Gaussian ends: exp(-12.5)
PAIRS, TOGETHER = 2**20, 2048  # pairs of Gaussian and point that are held, about; Gaussians looked up at once
_STEPS, _FARTHEST = 8, 0.5


def density_at(gaussians: Gaussians, points: F64) -> tuple[F64, F64]:
    """Density σ [n] and its gradient [n, 3] at points [n, 3] (x, y, z), in float64.

    With d from the centre, A = Σ⁻¹ and q = dᵀAd, a Gaussian adds ρ f(q) to σ and 2 ρ f'(q) A d to its gradient.
    """
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

    kernel, n = gaussians.kernel, len(points)
    density, gradient = np.zeros(n), np.zeros((n, 3))
    means = gaussians.means.detach().double().numpy()
    scales = gaussians.scales.detach().double().numpy()
    turn = Rotation.from_quat(gaussians.quaternions.detach().double().numpy(), scalar_first=True).as_matrix()
    whiten = turn.transpose(0, 2, 1) / scales[:, :, None]
    rho = gaussians.densities.detach().double().numpy()
    reach = kernel.reach(_SIGMAS) * scales.max(axis=1)
    tree = cKDTree(points)
    for first in range(0, gaussians.n, TOGETHER):
        near = tree.query_ball_point(means[first : first + TOGETHER], reach[first : first + TOGETHER])
        ends = np.cumsum([len(some) for some in near])
        cuts = np.unique([0, *np.searchsorted(ends, np.arange(PAIRS, ends[-1], PAIRS))])
        for low, high in zip(cuts, [*cuts[1:], len(near)], strict=True):
            sizes = [len(some) for some in near[low:high]]
            at = np.fromiter((p for some in near[low:high] for p in some), np.intp, sum(sizes))
            of = np.repeat(np.arange(first + low, first + high), sizes)
            white = np.einsum("nij,nj->ni", whiten[of], points[at] - means[of])
            q = np.einsum("ni,ni->n", white, white)
            if kernel.is_compact:
                m, inside = kernel.exponent, np.maximum(1 - q / kernel.radius**2, 0)
                value, slope = inside**m, -m / kernel.radius**2 * inside ** (m - 1)
            else:
                value = np.exp(-q / 2)
                slope = -value / 2
            density += np.bincount(at, rho[of] * value, n)
            step = (2 * rho[of] * slope)[:, None] * np.einsum("nji,nj->ni", whiten[of], white)
            gradient += np.stack([np.bincount(at, part, n) for part in step.T], axis=1)
    return density, gradient


def on_level(gaussians: Gaussians, points: F64, level: float, voxel: float) -> F64:
    """Points [n, 3] moved along the gradient until the density is `level` (Newton), by half a voxel at most.

    A point that does not come nearer to the level within that stays where it was.
    """
    moved, (density, gradient) = points.copy(), density_at(gaussians, points)
    begin = np.abs(density - level)
    for _ in range(_STEPS):
        squared = np.einsum("ni,ni->n", gradient, gradient)
        moved += np.divide(level - density, squared, out=np.zeros_like(squared), where=squared > 0)[:, None] * gradient
        away = moved - points
        length = np.linalg.norm(away, axis=1)
        moved = points + away * np.minimum(1, _FARTHEST * voxel / np.maximum(length, 1e-30))[:, None]
        density, gradient = density_at(gaussians, moved)
        if np.abs(density - level).max(initial=0) < 1e-6 * level:
            break
    return np.where((np.abs(density - level) < begin)[:, None], moved, points)
