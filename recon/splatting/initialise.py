"""First Gaussians of a fit: sampled from a first volume, mostly where it changes (after Zha et al. 2024)."""

from __future__ import annotations

import math
import operator

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from recon.base.choices import Start
from recon.base.empirical import SMOOTHED, SPREAD, VOXELS_A_GAUSSIAN, WILD_PIXEL, WILD_VIEWS
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel
from recon.base.masks import masked
from recon.base.method import Method, ReconProblem, RunControl
from recon.base.view_data import Views
from recon.base.views import spread
from recon.base.volume import Grid, Volume
from recon.kernels.cpu.slopes import slopes_at, windowed
from recon.kernels.cpu.tv import total_variation
from recon.splatting.gaussians import Gaussians
from recon.splatting.splat import project
from recon.voxels.beyond_field import reach_of
from recon.voxels.direct import Fbp, has_direct_method
from recon.voxels.methods import OsSirtTv
from recon.voxels.projector import volume_lines
from recon.voxels.voxel_problem import density_unit, difference_weights

START_SWEEPS = 10
"""Number of iterations for the first volume "tv". Because they use momentum, more iterations would fit the noise. The
effect was not measured."""

LEAST_GAUSSIANS, MOST_GAUSSIANS = 2000, 200_000
"""Bounds of the default number of Gaussians.

Without these bounds, small fields of view would get too few Gaussians, and large ones more Gaussians than 400 steps can
place. The effect was not measured.
"""

# No Gaussian is placed in voxels below this fraction of the density unit (Zha et al. 2024: τ = 0.05).
LEAST_DENSITY = 0.05

# The published start: density of a Gaussian, divided by that of its voxel; least width of a Gaussian, divided by the
# width of the field of view.
_PUBLISHED_SHARE, _PUBLISHED_LEAST = 0.15, 0.0005

SCALED_BY = 12  # number of projections from which the scale of the densities is computed
_SLOPE_SIGMA = 1.0  # standard deviation, in voxels, of the Gaussian for gradients
_LEAST_JOINED = 4  # fewest rows after binning
_MIDDLE = 8  # slices on each side of the middle whose changes are measured


def default_count(geometry: Geometry, voxel_size: float) -> int:
    """Default number of Gaussians for the field of view of this geometry, see `count_for`."""
    return count_for(Grid.of_field(geometry, voxel_size), geometry.is_cone)


def count_for(field: Grid, cone: bool) -> int:
    """Number of Gaussians for a field of view: one per 60 voxels of its inscribed cylinder, from 2000 to 200 000.

    The field of view of a cone beam is often much larger than the sample, and Gaussians gather at surfaces. So for a
    cone beam the number is at most V^(2/3) for V voxels (docs/published.md).
    """
    return int(np.clip(_count_of(field, cone), LEAST_GAUSSIANS, MOST_GAUSSIANS))


def joined_for(field: Grid, cone: bool, count: float, detector: tuple[int, int]) -> int:
    """The factor by which pixels [row, col] are binned for a fit of `count` Gaussians.

    If there are fewer Gaussians than one per 60 voxels, each Gaussian is wider by the cube root of the ratio. In a cone
    beam, Gaussians cover surfaces and are wider by the square root of the ratio. Pixels of this width still show every
    Gaussian. At least four rows remain.
    """
    wider = (_count_of(field, cone) / count) ** (1 / 2 if cone else 1 / 3)
    return max(1, min(int(wider), detector[0] // _LEAST_JOINED, detector[1] // _LEAST_JOINED))


def _count_of(field: Grid, cone: bool) -> float:
    voxels = math.prod(field.shape)
    count = np.pi / 4 * voxels / VOXELS_A_GAUSSIAN
    return min(count, voxels ** (2 / 3)) if cone else count


def place(
    volume: Volume,
    views: Views,
    count: int | None,
    rng: np.random.Generator,
    *,
    start: Start = "fbp",
    rays: RayModel | None = None,
    kernel: Kernel = Kernel.GAUSSIAN,
) -> Gaussians:
    """The starting point of a fit: Gaussians sampled from a first volume, scaled to the projections.

    Args:
        volume: see `first_volume`. Its box must contain everything that the projections see (`Grid.for_fit`), because a
            fit cannot represent material outside its box. No Gaussian is placed in the corners of the box, outside the
            circle that all projections see, unless the sample is wider than the field of view.
        count: number of Gaussians; None: the default for the field, see `default_count`.
        start: how the volume was made, see `first_volume`.

    Raises:
        ValueError: the count is below 1, or the data contain no material or are not line integrals.
    """
    geometry = views.geometry
    wanted = default_count(geometry, volume.grid.voxel_size) if count is None else operator.index(count)
    if wanted < 1:
        raise ValueError(f"a fit needs at least one Gaussian, got {wanted}")
    radius = math.inf if reach_of(views).edges.beyond(0.0) else geometry.reach
    if start == "published":
        return sample_as_published(volume, wanted, rng, field_radius=radius, kernel=kernel)
    placed = sample_gaussians(volume, wanted, rng, field_radius=radius, kernel=kernel)
    return scale_to_data(placed, without_wild_pixels(views.data), geometry, rays=rays)


def without_wild_pixels(projections: NDArray[np.float32]) -> NDArray[np.float32]:
    """The projections [view, row, col] with their wild pixels filled from neighbours.

    A wild pixel has more than ten times the largest value of the other projections. A single wild pixel makes a streak
    in a first volume, and may dominate a least-squares factor. At most a tenth of the projections, but at least one,
    may contain wild pixels. If all pixels of a projection are wild, its values are clipped.
    """
    peaks = np.maximum(projections.max(axis=(1, 2)), -projections.min(axis=(1, 2)))
    sound = max(1, peaks.size - max(1, round(WILD_VIEWS * peaks.size)))
    largest = WILD_PIXEL * float(np.partition(peaks, sound - 1)[sound - 1])
    if not (0 < largest < peaks.max()):
        return projections
    cleaned = np.array(projections, np.float32)
    for view in np.flatnonzero(peaks > largest):
        if (np.abs(cleaned[view]) > largest).all():
            np.clip(cleaned[view], -largest, largest, out=cleaned[view])
    return masked(cleaned, None, largest)[0]


def first_volume(
    projections: NDArray[np.float32], geometry: Geometry, grid: Grid, start: Start = "fbp", device: str = "cpu"
) -> Volume:
    """A quickly computed volume in 1/mm from which Gaussians are sampled. Wild pixels are filled first
    (`without_wild_pixels`).

    "fbp": FBP or FDK. If a cone scan is too short for FDK, the volume comes from a few iterations of OS-SIRT with TV.
    "tv": the volume always comes from these iterations, which are slower but without the streaks of few projections.
    "published": as "fbp", but with the plain ramp filter. `device` is where the volume is computed.
    """
    sweeps = OsSirtTv(iterations=START_SWEEPS, still=0.0)
    quick: Method = sweeps if _swept(geometry, start) else Fbp("ram-lak" if start == "published" else "hann")
    problem = ReconProblem(Views(without_wild_pixels(projections), geometry), grid, device=device)
    return quick.run(problem, RunControl()).volume


def mean_change(
    projections: NDArray[np.float32], geometry: Geometry, grid: Grid, known: Volume | None = None, device: str = "cpu"
) -> float:
    """Total variation of the sample per voxel, in density units, in the middle slices of a first volume "fbp".

    The value is 0 if a direct method is not suitable (the cone scan is too short), or if the slices contain no
    material.

    Args:
        known: a volume "fbp" on the grid, if there is one; None: the slices are reconstructed on the device.
    """
    nz, ny, nx = grid.shape
    first = max(0, nz // 2 - _MIDDLE)
    middle = slice(first, min(nz, first + 2 * _MIDDLE))
    slab = grid.part(middle, slice(0, ny), slice(0, nx))
    if _swept(geometry, "fbp"):
        return 0.0
    data = first_volume(projections, geometry, slab, device=device).data if known is None else known.data[middle]
    lines = volume_lines(np.maximum(data, 0))
    unit = density_unit(lines)
    in_sample = np.count_nonzero(lines > LEAST_DENSITY * unit)
    return float(total_variation(lines, difference_weights(slab)) / (in_sample * unit)) if in_sample else 0.0


def _swept(geometry: Geometry, start: Start) -> bool:
    return start == "tv" or not has_direct_method(geometry)


def sample_gaussians(
    volume: Volume,
    n: int,
    rng: np.random.Generator,
    *,
    field_radius: float,
    smooth: float = SMOOTHED,
    kernel: Kernel = Kernel.GAUSSIAN,
) -> Gaussians:
    """At most n isotropic Gaussians sampled from a volume.

    The volume is smoothed first, because Gaussians would otherwise be placed on the streaks of few projections (Yuluo
    et al. 2025, GR-Gaussian; gain 0.4 dB with 25 projections). Then voxels above 5 % of the density unit are drawn
    without replacement. Density and gradient of a voxel contribute equally to its probability. The size of a Gaussian
    is the distance to its neighbours, and its density is that of its voxel.

    Args:
        volume: an FBP or iterative reconstruction.
        n: number of Gaussians. The result has fewer Gaussians if fewer voxels contain material.
        field_radius: radius in mm around the rotation axis outside which no Gaussian is placed.
        smooth: standard deviation of the smoothing, in voxels.

    Raises:
        ValueError: the volume contains no material inside the field of view.
    """
    data, unit, candidates = _material(volume, field_radius, smooth)
    data /= unit  # so that squared gradients stay in the range of float32
    value, slope = data.ravel()[candidates], np.empty(candidates.size, np.float32)
    slopes_at(_smoothed(data, _SLOPE_SIGMA), candidates, slope)
    weight = value / value.sum() + slope / max(float(slope.sum()), 1e-30)
    # Exponential keys give a weighted draw without replacement in one pass (Efraimidis & Spirakis 2006).
    keys = rng.exponential(size=candidates.size) / weight
    chosen = candidates if candidates.size <= n else candidates[np.argpartition(keys, n)[:n]]
    z, y, x = volume.grid.coordinates()
    k, j, i = np.unravel_index(chosen, data.shape)
    jitter = (rng.random((chosen.size, 3)) - 0.5) * volume.grid.spacing[::-1]
    means = np.stack((x[i], y[j], z[k]), 1) + jitter
    scales = SPREAD * neighbour_distance(means)
    scales = np.clip(scales, 0.5 * volume.grid.voxel_size, 0.25 * volume.grid.voxel_size * min(data.shape[1:]))
    densities = data.ravel()[chosen].astype(np.float64) * unit
    return Gaussians.from_physical(means, scales, densities, density_unit=unit, kernel=kernel)


def sample_as_published(
    volume: Volume, n: int, rng: np.random.Generator, *, field_radius: float, kernel: Kernel = Kernel.GAUSSIAN
) -> Gaussians:
    """The published start (Zha et al. 2024): voxels above 5 % of the density unit, all with the same probability.

    The width of a Gaussian is the distance to its neighbours. Its density is 0.15 times that of its voxel. In the
    published code, Gaussians are half a voxel away from the voxel centres; here they are at the centres. Arguments and
    errors as in `sample_gaussians`.
    """
    data, unit, candidates = _material(volume, field_radius, 0.0)
    chosen = rng.permutation(candidates)[:n]
    z, y, x = volume.grid.coordinates()
    k, j, i = np.unravel_index(chosen, data.shape)
    means = np.stack((x[i], y[j], z[k]), 1)
    side = volume.grid.voxel_size * max(data.shape)
    scales = np.clip(neighbour_distance(means), _PUBLISHED_LEAST * side, side / 2)
    densities = _PUBLISHED_SHARE * data.ravel()[chosen].astype(np.float64)
    return Gaussians.from_physical(means, scales, densities, density_unit=unit, kernel=kernel)


def _material(
    volume: Volume, field_radius: float, smooth: float
) -> tuple[NDArray[np.float32], float, NDArray[np.int64]]:
    """The smoothed volume within the field of view, its density unit, and the voxels in which a Gaussian may start."""
    data = _smoothed(np.maximum(volume.data, 0), smooth)
    _, y, x = volume.grid.coordinates()
    data *= (x[None, :] ** 2 + y[:, None] ** 2) <= field_radius**2
    unit = density_unit(data)
    candidates = np.flatnonzero(data.ravel() > LEAST_DENSITY * unit) if unit > 0 else np.empty(0, np.int64)
    if candidates.size < 4:
        raise ValueError(
            f"check that the projections are line integrals (-log of the transmission) and that the rotation axis is "
            "right: the initial volume contains no material, because "
            f"only {candidates.size} voxels are above {LEAST_DENSITY:.0%} of "
            f"{unit:.3g} 1/mm"
        )
    return data, unit, candidates


def _smoothed(x: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """x [z, y, x] smoothed by a Gaussian with this standard deviation in voxels. The Gaussian is cut off at four
    standard deviations."""
    taps, out = np.arange(-round(4 * sigma), round(4 * sigma) + 1), np.empty(x.shape, np.float32)
    window = np.exp(-0.5 * (taps / max(sigma, 1e-9)) ** 2)
    windowed(x, (window / window.sum()).astype(np.float32), out)
    return out


def neighbour_distance(means: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square distance [n] of each point to its three nearest neighbours; infinite for a single point."""
    n_queried = min(4, means.shape[0])
    if n_queried < 2:
        return np.full(n_queried, np.inf)
    from scipy.spatial import cKDTree

    distances = np.asarray(cKDTree(means).query(means, k=n_queried, workers=get_num_threads())[0])
    return np.sqrt((distances[:, 1:] ** 2).mean(axis=1))


def scale_to_data(
    gaussians: Gaussians, projections: NDArray[np.float32], geometry: Geometry, rays: RayModel | None = None
) -> Gaussians:
    """The same Gaussians, with all densities multiplied by the factor k = <Aρ, P> / <Aρ, Aρ>, computed from a few
    projections.

    Projection is linear in density, so k is the exact least-squares factor. k replaces the published constant 0.15, and
    makes the start independent of units and of the number of Gaussians.
    """
    chosen = spread(np.arange(geometry.n_views), SCALED_BY)
    rendered = project(gaussians, geometry, chosen.tolist(), model=rays).numpy()
    measured = np.asarray(projections[chosen], np.float64)
    power = float((rendered.astype(np.float64) ** 2).sum())
    factor = float((rendered * measured).sum()) / power if power > 0 else 0.0
    if not factor > 0:
        raise ValueError(
            "the data do not look like line integrals: the best factor between the initial volume and the "
            f"projections is {factor:.3g}, and it must be positive"
        )
    densities = gaussians.densities.double().numpy() * factor
    return Gaussians.from_physical(
        gaussians.means.numpy(), gaussians.scales.numpy(), densities,
        gaussians.quaternions.numpy(), gaussians.density_unit, gaussians.kernel,
    )  # fmt: skip


def morton_order(means: NDArray[np.float32], cell: float) -> NDArray[np.int64]:
    """Order [n] of points along a Z-curve through cells of the given edge, so that neighbours in space become
    neighbours in memory."""
    cells = np.clip(((means - means.min(axis=0)) / cell).astype(np.int64), 0, 1023)
    code = np.zeros(means.shape[0], np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")
