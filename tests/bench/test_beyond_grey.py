"""Rows of docs/performance.md on emission, energies, time and surfaces: dB or distance, CPU seconds and peak memory, on
measured and simulated volumes.

pytest -m bench -s tests/bench/test_beyond_grey.py    (needs xraylib; eight minutes)
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

import recon
from recon.assess.metrics import psnr
from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.features.surfaces import Mesh, half_way, on_level, surface
from simulators.samples.sample import sample_at
from simulators.scenes.scene import load_scene
from tests.bench.quality_cases import OBJECTS, padded, seen_by_simulator
from tests.bench.test_materials import counted, cross_sections, grains
from tests.conftest import SHARED_DATA

pytestmark = pytest.mark.bench
PITCH, ROWS, ENERGIES = 1.1e-3, 8, (8.320, 8.345, 8.3485, 8.380)


def shell(planes: int = 16) -> F32:
    """[z, y, x] of so many x 128 x 128 voxels, two a pixel, largest value 1."""
    return np.ascontiguousarray(OBJECTS["shell"](SHARED_DATA)[112 - planes // 2 : 112 + planes // 2])


def teapot(planes: int = 16) -> F32:
    """As `shell`, of every other voxel's mean."""
    middle = padded(OBJECTS["teapot"](SHARED_DATA), 256)[128 - planes : 128 + planes]
    return coarse(np.ascontiguousarray(middle))


def measured(name: str, truth: F32, run: Callable[[], F32]) -> None:
    """Print the row of a run: of a second call for the time, and of a third for the memory."""
    found = run()
    began = time.process_time()
    run()
    took = time.process_time() - began
    tracemalloc.start()
    run()
    peak = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    print(f"| {name} | {psnr(truth, found):.2f} | {took:.2f} | {peak:.0f} |")


def coarse(fine: F32) -> F32:
    z, y, x = fine.shape
    return fine.reshape(z // 2, 2, y // 2, 2, x // 2, 2).mean((1, 3, 5), dtype=np.float32)


MEASURED = {"shell": shell, "teapot": teapot}


@pytest.mark.parametrize("kind", ["shell", "teapot", "grains"])
def test_emission(kind: str) -> None:
    """10⁶ counts of the volume as an activity, 30 % of them randoms, 90 views."""
    fine = MEASURED[kind]() if kind in MEASURED else grains()[1]
    truth = coarse(fine)
    geometry = Geometry.parallel(np.arange(90) * np.pi / 90, truth.shape[:2], pixel_pitch=1.0)
    lines = seen_by_simulator(fine, geometry, 0.5)
    scale, background = 7e5 / lines.sum(), np.full_like(lines, 3e5 / lines.size)
    counts = np.random.default_rng(0).poisson(scale * lines + background).astype(np.float32)
    emission = recon.Emission(counts, geometry, None, background)
    for method in (recon.Osem(), recon.Fbp(), recon.FistaTv(), recon.R2()):

        def run(method: object = method) -> F32:
            return recon.reconstruct(emission, geometry, method).volume.data / np.float32(scale)  # type: ignore[arg-type]

        measured(f"emission of the {kind}, {method.name}", truth, run)


@pytest.mark.parametrize("kind", ["shell", "teapot", "grains"])
def test_energies(kind: str) -> None:
    """The share of charged oxide, of two materials: fitted together, and from a volume an energy; 4 x 30 views."""
    if kind in MEASURED:
        whole = MEASURED[kind]()
        left = np.arange(whole.shape[2]) < whole.shape[2] // 2
        parts = np.stack([whole * left, whole * ~left])
    else:
        parts = grains()[:2]
    truth = np.stack([coarse(part) for part in parts])
    energy = np.arange(120) % len(ENERGIES)
    geometry = Geometry.parallel(np.arange(120) * np.pi / 120, truth.shape[1:3], pixel_pitch=PITCH)
    sections = cross_sections(ENERGIES)[:, :2]
    lines = [seen_by_simulator(part, geometry, PITCH / 2) for part in parts]
    depth = sum(line * sections[energy, m][:, None, None] for m, line in enumerate(lines))
    views = recon.EnergyViews(counted(depth, 5000), geometry, energy, sections)

    def apart() -> F32:
        own = [np.flatnonzero(energy == e) for e in range(len(ENERGIES))]
        found = [
            recon.reconstruct(views.projections[at], geometry.select(at), recon.FistaTv()).volume.data for at in own
        ]
        return np.einsum("me,ezyx->mzyx", np.linalg.pinv(sections), np.stack(found))[1].astype(np.float32)

    measured(f"energies of the {kind}, together", truth[1], lambda: recon.fit_materials(views).densities[1])
    measured(
        f"energies of the {kind}, states of one material", truth[1],
        lambda: recon.fit_share(views, recon.fit_materials(views), (0, 1)).densities[1],
    )  # fmt: skip
    measured(f"energies of the {kind}, apart", truth[1], apart)


FOAM = {"kind": "foam", "diameter": 0.408, "height": 0.408, "n_holes": 120, "largest_um": 107.0, "smallest_um": 35.0,
        "gap_um": 4.0, "candidates": 40_000}  # fmt: skip


def foam() -> F32:
    """As `shell`, of a simulated foam: spheres of air in a cylinder."""
    sample = load_scene({"phantom": FOAM, "beam": {"photons_per_s": 1.0}}).sample
    grid = Grid((32, 128, 128), 0.0034)
    return np.asarray(sample_at(sample, 0.0).attenuation(grid), np.float32)[8:24]


def distances(mesh: Mesh, truth: Mesh, half: float) -> F64:
    """Of vertices from the plane of the nearest triangle of the truth, in its unit; less those near the ends."""
    corners = truth.vertices[truth.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    middles = corners.mean(axis=1)
    points = mesh.vertices[np.abs(mesh.vertices[:, 2]) < half].astype(np.float64)
    _, near = cKDTree(middles).query(points)
    return np.asarray(np.einsum("ni,ni->n", points - middles[near], normals[near]))


@pytest.mark.parametrize("kind", ["teapot", "shell", "foam"])
def test_surfaces(kind: str) -> None:
    """Half-way between air and matter, of 90 views of 20 000 photons; RMS distance from the truth's, in voxels."""
    fine = foam() if kind == "foam" else np.ascontiguousarray(padded(OBJECTS[kind](SHARED_DATA), 256)[120:136])
    height, width = fine.shape[0] // 2, fine.shape[1] // 2
    geometry = Geometry.parallel(np.arange(90) * np.pi / 90, (height, width), pixel_pitch=1.0)
    grid, half = Grid.matching(geometry), height / 2 - 1
    exact = surface(fine, Grid(fine.shape, 0.5), half_way(fine, len(fine)))
    lines = seen_by_simulator(fine, geometry, 0.5)
    depth = 2 * lines / lines.max()
    counts = np.random.default_rng(0).poisson(2e4 * np.exp(-depth)).clip(1)
    views = (-np.log(counts / 2e4)).astype(np.float32)

    def row(name: str, run: Callable[[], Mesh]) -> float:
        run()
        began = time.process_time()
        away = distances(run(), exact, half)
        took = time.process_time() - began
        tracemalloc.start()
        run()
        peak = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        rms = float(np.sqrt(np.mean(away**2)))
        print(f"| surface of the {kind}, {name} | {rms:.3f} | {took:.2f} | {peak:.0f} |")
        return rms

    def of(method: object, of_gaussians: bool = False) -> Callable[[], Mesh]:
        def run() -> Mesh:
            found = recon.reconstruct(views, geometry, method)  # type: ignore[arg-type]
            if not of_gaussians:
                return surface(found.volume.data, grid, half_way(found.volume.data, height))
            assert found.gaussians is not None
            voxels = recon.voxelize(found.gaussians, grid).numpy()
            level = half_way(voxels, height)
            mesh = surface(voxels, grid, level)
            moved = on_level(found.gaussians, mesh.vertices.astype(np.float64), level, grid.voxel_size)
            return replace(mesh, vertices=moved.astype(np.float32))

        return run

    rms = {name: row(name, of(method)) for name, method in
           (("fbp", recon.Fbp()), ("fista-tv", recon.FistaTv()), ("r2", recon.R2()))}  # fmt: skip
    row("r2, its Gaussians", of(recon.R2(), of_gaussians=True))
    assert rms["r2"] < rms["fbp"]
