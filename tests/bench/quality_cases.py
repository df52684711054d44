"""Scans for quality tables: real volumes in a cone as in the published protocol, a measured walnut, a battery.

The published protocol (Zha et al. 2024): DSO 5, DSD 7, a detector of 4 x 4 of 512² pixels, the volume a cube of edge 2
with 256³ voxels; Poisson noise of 1e5 photons plus normal noise of 10, on projections scaled to a largest value of 1.
Half the size (256² pixels, 128³ voxels) keeps all ratios. Its data come from the volume with twice the resolution, so
that no method gets data from its own projector.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from beamline.projections.views import select
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.projector import Projector
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.composed import battery
from simulators.samples.voxels.voxels import Voxels

F32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Case:
    """Projections and the ground truth; PSNR is computed with `peak`, on values clipped at 0.

    Attributes:
        weights: weights of the rays; None: all equal.
        unseen: projections for evaluation if there is no ground truth, their geometry, and whether a ray counts.
    """

    name: str
    projections: F32
    geometry: Geometry
    grid: Grid
    truth: F32
    peak: float
    weights: F32 | None = None
    unseen: tuple[F32, Geometry, NDArray[np.bool_]] | None = None


def rows_of(case: Case, rows: Sequence[int]) -> Case:
    """A case with only these rows of a parallel beam, treated as neighbours."""
    chosen, shape = list(rows), (len(rows), case.geometry.detector_shape[1])
    unseen = case.unseen

    def cut(geometry: Geometry) -> Geometry:
        return replace(geometry, detector_shape=shape, axis_row=(len(rows) - 1) / 2)

    return replace(
        case,
        projections=np.ascontiguousarray(case.projections[:, chosen]),
        geometry=cut(case.geometry),
        grid=replace(case.grid, shape=(len(rows), *case.grid.shape[1:])),
        truth=case.truth[chosen],
        weights=None if case.weights is None else np.ascontiguousarray(case.weights[:, chosen]),
        unseen=unseen and (unseen[0][:, chosen], cut(unseen[1]), unseen[2][:, chosen]),
    )


def seen_by_simulator(fine: F32, geometry: Geometry, voxel: float | None = None) -> F32:
    """Line integrals [view, row, col] from the simulator's projector (which no method uses), 2 x 2 rays per pixel.

    `voxel`: voxel edge of `fine`; None: that of a cube of edge 2.
    """
    sample = Voxels.of(fine, voxel or 2 / len(fine))
    rows, cols = geometry.detector_shape
    axis = 2 * geometry.axis_col + 0.5, 2 * geometry.axis_row + 0.5
    detector = Detector((2 * rows, 2 * cols), geometry.sample_pitch / 2, *axis, geometry.sod)
    views = [sample.line_integrals(float(a), detector).reshape(rows, 2, cols, 2) for a in geometry.angles]
    return np.stack([view.mean(axis=(1, 3)) for view in views]).astype(np.float32)


def strip_integrals(volume: F32, geometry: Geometry) -> F32:
    """Exact pixel means [view, row, col] of the line integrals through cubes of constant density, in a parallel beam.

    A pixel is as wide as a voxel, and rows show slices. A square casts a trapezoid: the convolution of boxes as wide as
    the cosine and the sine of the angle, whose integral up to the edges of a pixel is a sum of four ramps squared.
    """
    (slices, rows, cols), pixels = volume.shape, geometry.detector_shape[1]
    y, x = (index - (n - 1) / 2 for index, n in zip(np.indices((rows, cols)), (rows, cols), strict=True))
    flat, seen = volume.reshape(slices, -1).T, []
    for angle in geometry.angles:
        a, b = (max(abs(f(angle)), 1e-6) for f in (np.cos, np.sin))

        def up_to(t: NDArray[np.float64], a: float = a, b: float = b) -> NDArray[np.float64]:
            edges = ((a + b) / 2, 1), ((a - b) / 2, -1), ((b - a) / 2, -1), (-(a + b) / 2, 1)
            return sum((sign * np.maximum(t + at, 0) ** 2 for at, sign in edges), np.zeros_like(t)) / (2 * a * b)

        centre = (x * np.cos(angle) + y * np.sin(angle)).ravel() + geometry.axis_col + 0.5  # pixel 0 begins at 0
        first = np.floor(centre - (a + b) / 2)
        cover = np.stack([up_to(first + k + 1 - centre) - up_to(first + k - centre) for k in range(3)])
        pixel = np.stack([first + k for k in range(3)]).astype(np.intp)
        there = (pixel >= 0) & (pixel < pixels)
        voxel = np.broadcast_to(np.arange(rows * cols), pixel.shape)
        matrix = csr_array((cover[there].astype(np.float32), (pixel[there], voxel[there])), (pixels, rows * cols))
        seen.append((matrix @ flat).T * np.float32(geometry.sample_pitch))
    return np.stack(seen)


def seen_by_engine(fine: F32, geometry: Geometry) -> F32:
    """Line integrals [view, row, col] from the projector of the classical methods."""
    return Projector(geometry, Grid(fine.shape, 2 / len(fine))).forward(fine)


def cone(folder: Path, name: str, views: int, size: int, seen: Callable[[F32, Geometry], F32] = seen_by_engine) -> Case:
    """An object of the protocol on size³ voxels and (2 size)² pixels, projected from 256³ voxels."""
    fine = padded(OBJECTS[name](folder), 256)
    factor = 256 // size
    truth = fine.reshape(size, factor, size, factor, size, factor).mean(axis=(1, 3, 5), dtype=np.float32)
    angles = np.linspace(0, 2 * np.pi, views, endpoint=False)
    geometry = Geometry.cone(angles, (2 * size, 2 * size), 4 / (2 * size), 5.0, 7.0)
    return Case(name, noisy(seen(fine, geometry)), geometry, Grid((size, size, size), 2 / size), truth, 1.0)


def walnut(folder: Path, views: int) -> Case:
    """Every n-th of 240 measured projections of a slab; the reference is an FDK of all 241 cone projections."""
    with h5py.File(folder / "walnut_parallel_rebinned_240x96x256.h5") as file:
        found: list[h5py.Dataset] = []
        file.visititems(lambda _, node: found.append(node) if getattr(node, "ndim", 0) == 3 else None)
        chosen = np.linspace(0, 240, views, endpoint=False).astype(int)
        data = np.asarray(found[0][:][chosen], np.float32)
    geometry = Geometry.parallel(np.deg2rad(0.75 * chosen), (96, 256), pixel_pitch=0.15217249972911476, axis_col=127.5)
    truth = np.maximum(first_of(folder / "walnut_fdk_256.npz")[70:166], 0)
    return Case("walnut slab", data, geometry, Grid.matching(geometry), truth, float(truth.max()))


def walnut_halved(folder: Path, views: int) -> Case:
    """`walnut` with pixels and voxels twice as large, 32 of its 48 slices."""
    fine = walnut(folder, views)
    data = fine.projections.reshape(views, 48, 2, 128, 2).mean(axis=(2, 4))[:, 8:40]
    truth = fine.truth.reshape(48, 2, 128, 2, 128, 2).mean(axis=(1, 3, 5))[8:40]
    geometry = Geometry.parallel(fine.geometry.angles, (32, 128), pixel_pitch=2 * fine.geometry.pixel_pitch)
    return Case("walnut", np.ascontiguousarray(data), geometry, Grid.matching(geometry), truth, float(truth.max()))


def diamond(folder: Path, views: int) -> Case:
    """32 rows of Diamond 24737, at most 76 of its 91 projections; the other 15 are for evaluation."""
    from beamline.projections.prepare import prepare_projections  # a machine that fits Gaussians has no readers
    from beamline.projections.selection import Selection
    from beamline.storage.readers.open import SourceOptions

    with SourceOptions(folder / "diamond_24737_parallel_91x135x160.h5").open() as source:
        prepared = prepare_projections(select(source, Selection(rows=(65, 97), axis_col=85.75)), lambda _: None)
    data, rays = np.asarray(prepared.seen.data), prepared.without_warnings.views.seen.weights
    rays = np.ones_like(data) if rays is None else rays[...]
    judges = np.arange(3, 91, 6)
    others = np.setdiff1d(np.arange(91), judges)
    chosen = others[np.linspace(0, others.size - 1, views).round().astype(int)]
    geometry = prepared.geometry.select(chosen)
    grid = Grid.matching(geometry)
    unseen = data[judges], prepared.geometry.select(judges), rays[judges] > 0
    return Case("diamond", data[chosen], geometry, grid, np.zeros(grid.shape, np.float32), 1.0, rays[chosen], unseen)


def slab(folder: Path, name: str, views: int, photons: float = 5000) -> Case:
    """40 x 128² voxels of one of SLABS in a parallel beam, from projections with twice the resolution (independent
    code)."""
    fine = SLABS[name](folder)
    angles = np.linspace(0, np.pi, views, endpoint=False)
    rows, side = fine.shape[0] // 2, fine.shape[2] // 2
    clean = strip_integrals(fine, Geometry.parallel(angles, (2 * rows, 2 * side), pixel_pitch=0.5))
    scale = 2 / float(clean.max())  # the longest path lets an eighth through
    counts = photons * np.exp(-scale * clean).reshape(views, rows, 2, side, 2).mean(axis=(2, 4))
    data = -np.log(np.maximum(np.random.default_rng(0).poisson(counts), 1) / photons)
    truth = scale * fine.reshape(rows, 2, side, 2, side, 2).mean(axis=(1, 3, 5))
    geometry = Geometry.parallel(angles, (rows, side), pixel_pitch=1.0)
    return Case(
        f"{name} slab", data.astype(np.float32), geometry, Grid.matching(geometry), truth, float(truth.max())
    )  # fmt: skip


def dense_battery(views: int, side: int = 256, photons: float = 2e4, particles: int = 300) -> Case:
    """A can full of particles: piecewise constant, which suits total variation best. Four rays per pixel."""
    pitch = 1.0 / side
    rng = np.random.default_rng(0)
    phantom = Phantom.of(battery(rng, (1.0, 1.0), particles))
    angles = np.linspace(0, np.pi, views, endpoint=False)
    fine = Detector.centred((2 * side, 2 * side), pitch / 2)
    clean = np.stack(
        [phantom.line_integrals(a, fine).reshape(side, 2, side, 2).mean(axis=(1, 3)) for a in angles]
    )  # fmt: skip
    data = -np.log(np.maximum(rng.poisson(photons * np.exp(-clean)), 1) / photons)
    geometry = Geometry.parallel(angles, (side, side), pixel_pitch=pitch)
    truth = phantom.attenuation(Grid.matching(geometry))
    return Case("battery", data.astype(np.float32), geometry, Grid.matching(geometry), truth, float(truth.max()))


def first_of(path: Path) -> F32:
    with np.load(path, allow_pickle=False) as file:
        return np.asarray(file[next(iter(file))], np.float32)


def _thorax(folder: Path) -> F32:
    """Hounsfield units of a NIfTI-1 file; -1000 to 1500 is mapped to 0 to 1."""
    raw = gzip.decompress((folder / "totalseg_thorax_ct_191x167x233.nii.gz").read_bytes())
    shape = np.frombuffer(raw, np.int16, 4, 40)[1:]
    kind = {4: np.int16, 16: np.float32}[int(np.frombuffer(raw, np.int16, 1, 70)[0])]
    start = int(np.frombuffer(raw, np.float32, 1, 108)[0])
    volume = np.frombuffer(raw, kind, int(np.prod(shape, dtype=int)), start).reshape(shape[::-1])
    return ((np.clip(volume, -1000, 1500) + 1000) / 2500).astype(np.float32)


def _unit(volume: F32, high: float) -> F32:
    return np.clip(volume.astype(np.float32) / high, 0, 1)


OBJECTS: dict[str, Callable[[Path], F32]] = {
    "teapot": lambda folder: _unit(first_of(folder / "scivis_teapot_256.npz"), 255.0),
    "shell": lambda folder: (lambda v: _unit(v, float(v.max())))(
        tifffile.imread(folder / "qim3d_shell_225x128x128.tif")
    ),
    "thorax": _thorax,
}  # fmt: skip


def _grains(folder: Path) -> F32:
    """Random polyhedra with five densities, a sixth of them empty, as in cement."""
    rng = np.random.default_rng(3)
    z, y, x = np.indices(_FINE, np.float32)
    seeds = rng.uniform(0, 1, (900, 3)) * _FINE
    _, nearest = cKDTree(seeds).query(np.stack([z, y, x], -1).reshape(-1, 3), workers=-1)
    density = rng.choice([0, 0.3, 0.55, 0.6, 1.0], 900, p=[0.15, 0.25, 0.25, 0.2, 0.15])
    return np.where(_in_the_field(y, x), density[nearest].reshape(_FINE), 0).astype(np.float32)


def _foam(folder: Path) -> F32:
    """Branching struts with a fine texture of a ninth of their density, as in bone."""
    rng = np.random.default_rng(4)
    struts, texture = (gaussian_filter(rng.normal(size=_FINE), s) for s in (3, 1.2))
    _, y, x = np.indices(_FINE, np.float32)
    solid = (struts > 0.3 * struts.std()) & _in_the_field(y, x)
    return np.where(solid, np.maximum(0.7 + 0.08 * texture / texture.std(), 0), 0).astype(np.float32)


def _in_the_field(y: F32, x: F32) -> NDArray[np.bool_]:
    return np.asarray(np.hypot(y - 127.5, x - 127.5) < 118)


_FINE = (80, 256, 256)
_MIDDLE = slice(88, 168)
SLABS: dict[str, Callable[[Path], F32]] = {
    "teapot": lambda folder: padded(OBJECTS["teapot"](folder), 256)[_MIDDLE],
    "shell": lambda folder: padded(OBJECTS["shell"](folder), 256)[_MIDDLE],
    "thorax": lambda folder: padded(OBJECTS["thorax"](folder), 256)[_MIDDLE],
    "kernel": lambda folder: np.maximum(first_of(folder / "walnut_fdk_256.npz"), 0)[_MIDDLE, 60:188, 60:188],
    "grains": _grains,
    "foam": _foam,
}  # fmt: skip


def _textured(name: str, own_voxels: bool) -> Callable[[Path], F32]:
    """Slices of a CT volume, 0 outside the field.

    Args:
        own_voxels: True: 24 slices, interpolated to twice the resolution, so that the voxels of the case are those of
            the CT, whose edges are one or two voxels wide. False: 80 original slices, whose structure is finer than the
            voxels.
    """

    def load(folder: Path) -> F32:
        slices = slice(52, 76) if own_voxels else slice(24, 104)
        volume = tifffile.imread(folder / f"qim3d_{name}_128x128x128.tif").astype(np.float32)[slices]
        _, y, x = np.indices(volume.shape, np.float32)
        inside = np.where(np.hypot(y - 63.5, x - 63.5) < 62, volume / volume.max(), 0).astype(np.float32)
        return zoom(inside, 2, order=1, mode="nearest", grid_mode=True) if own_voxels else inside

    return load


TEXTURED = {
    f"{name}{', binned' * (not own)}": _textured(name, own) for name in ("bone", "cement") for own in (True, False)
}


def walnut_held_out(folder: Path) -> Case:
    """60 of 240 measured projections, and the 60 between them."""
    case, other = walnut_halved(folder, 120), np.arange(1, 120, 2)
    rays = np.ones(case.projections[other].shape, np.bool_)
    unseen = case.projections[other], case.geometry.select(other), rays
    seen = np.arange(0, 120, 2)
    return replace(case, projections=case.projections[seen], geometry=case.geometry.select(seen), unseen=unseen)


def padded(volume: F32, side: int) -> F32:
    low = [(side - n) // 2 for n in volume.shape]
    return np.pad(volume, [(a, side - n - a) for a, n in zip(low, volume.shape, strict=True)])


def noisy(clean: F32, photons: float = 1e5, sigma: float = 10.0) -> F32:
    rng = np.random.default_rng(0)
    top = float(clean.max())
    counts = rng.poisson(photons * np.exp(-clean / top)) + rng.normal(0, sigma, clean.shape)
    return np.maximum(-np.log(np.maximum(counts, 1) / photons) * top, 0).astype(np.float32)
