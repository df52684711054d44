"""A flat plate with inclusions: parallel beam, laminography, cones with sources on a circle and anywhere.

Run with  pytest -m bench -s tests/bench/test_free_geometry.py  (three minutes). The views are traced through the bodies
by vectors alone, four rays a pixel, 10⁵ photons. PSNR in dB over the box of the plate, and inside it, and CPU seconds.
"""

from __future__ import annotations

import math
import time
from typing import TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.vectors import geometry_of_vectors, vectors_of
from recon.base.volume import Grid, Volume
from tests.recon.base.test_vectors import rays

F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]
VIEWS, PHOTONS, DENSITY = 90, 1e5, 0.02
HALF = np.array([24.3, 22.4, 5.4])  # of the plate along (x, y, z); edges lie within voxels
GRID = Grid((20, 64, 64))
INSIDE = slice(6, 14), slice(13, 51), slice(11, 53)
METHODS: dict[str, recon.Method] = {
    "fbp": recon.Fbp(),
    "fista-tv": recon.FistaTv(),
    "fista-tv, weight 0.003": recon.FistaTv(tv_weight=0.003),
    "r2": recon.R2(),
}


def inclusions() -> list[tuple[F64, F64, float]]:
    """Half axes, centre and additional density of ellipsoids in the plate: pores, and grains of two densities."""
    rng, some = np.random.default_rng(7), list[tuple[F64, F64, float]]()
    while len(some) < 24:
        axes = rng.uniform(1.2, 3.0, 3)
        centre = rng.uniform(-1, 1, 3) * (HALF - axes - 0.7)
        if all(np.linalg.norm(centre - other[1]) > axes.max() + other[0].max() + 0.5 for other in some):
            some.append((axes, centre, float(rng.choice([-DENSITY, DENSITY, 2 * DENSITY]))))
    return some


def truth(fine: int = 4) -> F32:
    """Mean density of each voxel, from 4³ points."""
    points = Grid(tuple(fine * n for n in GRID.shape), GRID.voxel_size / fine)  # type: ignore[arg-type]
    z, y, x = (
        axis.reshape(shape) for axis, shape in zip(points.coordinates(), ((-1, 1, 1), (-1, 1), (-1,)), strict=True)
    )
    density = DENSITY * ((np.abs(x) <= HALF[0]) & (np.abs(y) <= HALF[1]) & (np.abs(z) <= HALF[2])).astype(np.float32)
    for (a, b, c), (x0, y0, z0), more in inclusions():
        density += np.float32(more) * (((x - x0) / a) ** 2 + ((y - y0) / b) ** 2 + ((z - z0) / c) ** 2 <= 1)
    nz, ny, nx = GRID.shape
    return density.reshape(nz, fine, ny, fine, nx, fine).mean((1, 3, 5))


def line_integrals(vectors: F64, shape: tuple[int, int], *, cone: bool) -> F32:
    """Of the plate, from the mean light of four rays a pixel, with Poisson noise."""
    rows, cols = shape
    point, along = rays(vectors * np.repeat((1, 1, 0.5, 0.5), 3), (2 * rows, 2 * cols), cone=cone)
    with np.errstate(divide="ignore"):
        ends = np.stack(((-HALF - point) / along, (HALF - point) / along))
    integrals = DENSITY * np.maximum(ends.max(0).min(-1) - ends.min(0).max(-1), 0)
    for axes, centre, more in inclusions():
        p, d = (point - centre) / axes, along / axes
        a, b, c = (d * d).sum(-1), (p * d).sum(-1), (p * p).sum(-1) - 1
        integrals += more * 2 * np.sqrt(np.maximum(b * b - a * c, 0)) / a
    light = np.exp(-integrals).reshape(-1, rows, 2, cols, 2).mean((2, 4))
    counts = np.random.default_rng(1).poisson(PHOTONS * light)
    return -np.log(np.maximum(counts, 1) / PHOTONS).astype(np.float32)


def free_vectors() -> F64:
    """Sources on a wavy circle, some mm off it, and detectors that are turned, displaced, and do not face the axis."""
    rng, some = np.random.default_rng(11), []
    for turn in np.arange(VIEWS) * 2 * math.pi / VIEWS:
        up = math.radians(12) * math.sin(2 * turn)
        beam = np.array((-math.sin(turn) * math.cos(up), math.cos(turn) * math.cos(up), -math.sin(up)))
        source = -300 * (1 + 0.03 * math.sin(3 * turn)) * beam + 4 * rng.normal(size=3)
        normal = beam + 0.02 * rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        level = np.cross(normal, (0, 0, 1))
        level /= np.linalg.norm(level)
        roll, steep = 0.05 * rng.normal(), np.cross(level, normal)
        u, v = math.cos(roll) * level + math.sin(roll) * steep, math.cos(roll) * steep - math.sin(roll) * level
        middle = source - source * 600 / float(-source @ normal) + 3 * rng.normal() * u + 3 * rng.normal() * v
        some.append(np.concatenate((source, middle, 2 * u, 2 * v)))
    return np.array(some)


def scans() -> dict[str, Geometry]:
    circle, lean = np.arange(VIEWS) * 2 * math.pi / VIEWS, np.full(VIEWS, math.radians(30))
    return {
        "parallel": Geometry.parallel(circle / 2, (40, 72)),
        "laminography, 30 degrees": Geometry.parallel(circle, (52, 72), tilt=lean),
        "cone": Geometry.cone(circle, (40, 72), 2.0, 300.0, 600.0),
        "cone, laminography": Geometry.cone(circle, (52, 72), 2.0, 300.0, 600.0, tilt=lean),
        "cone, free": geometry_of_vectors(free_vectors(), (48, 76), cone=True),
    }


def reconstructed() -> dict[tuple[str, str], Volume]:
    volumes, best = {}, truth()
    for name, geometry in scans().items():
        data, cells = line_integrals(vectors_of(geometry), geometry.detector_shape, cone=geometry.is_cone), []
        for method in METHODS:
            if method == "fbp" and geometry.centres.any():
                continue
            begin = time.process_time()
            volume = recon.reconstruct(data, geometry, METHODS[method], grid=GRID).volume
            volumes[name, method], seconds = volume, time.process_time() - begin
            both = (psnr(best[of], np.maximum(volume.data, 0)[of], 3 * DENSITY) for of in ((...,), INSIDE))
            cells.append(f"{method} {' / '.join(f'{value:.2f}' for value in both)}, {seconds:.1f} s")
        print(f"{name}: {' | '.join(cells)}", flush=True)
    return volumes


@pytest.mark.bench
@pytest.mark.timeout(1800)
def test_free_sources_are_level_with_a_circle_of_sources() -> None:
    volumes, best = reconstructed(), truth()

    def quality(name: str) -> float:
        return psnr(best, volumes[name, "fista-tv, weight 0.003"].data, 3 * DENSITY)

    assert quality("cone, free") > quality("cone") - 0.5
