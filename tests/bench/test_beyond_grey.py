"""Rows of docs/performance.md on emission, energies, time and surfaces: dB or distance, CPU seconds and peak memory, on
measured and simulated volumes.

pytest -m bench -s tests/bench/test_beyond_grey.py    (needs xraylib; eight minutes)
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import recon
from recon.assess.metrics import psnr
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from simulators.samples.sample import sample_at
from simulators.scenes.scene import load_scene
from tests.bench.quality_cases import OBJECTS, padded, seen_by_simulator
from tests.bench.test_materials import counted, cross_sections, grains
from tests.bench.test_series import FOAM, of_sub_scans, scanned
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


MOMENTS = (np.arange(12) + 0.5) / 12


def settled(fine: F32, time: float) -> F32:
    """The volume, lower by 15 % at time 1: slices come from farther up, and hold as much as before."""
    shrunk = 1 - 0.15 * time
    places = np.meshgrid(np.arange(len(fine)) / shrunk, *(np.arange(n) for n in fine.shape[1:]), indexing="ij")
    return np.asarray(map_coordinates(fine, places, order=1, output=np.float32), np.float32)


def in_time(kind: str) -> tuple[recon.TimedViews, F32]:
    """72 golden-angle views over a second, 50 000 photons; the truth at `MOMENTS`."""
    if kind == "foam":
        return scanned(FOAM)
    fine, times = MEASURED[kind](48), (np.arange(72) + 0.5) / 72
    angles = np.pi * (np.sqrt(5) - 1) / 2 * np.arange(72)
    geometry = Geometry.parallel(angles, (24, 64), pixel_pitch=1.0)
    lines = np.concatenate([
        seen_by_simulator(settled(fine, float(t)), geometry.select([n]), 0.5) for n, t in enumerate(times)
    ])  # fmt: skip
    scale = np.float32(2 / lines.max())
    counts = np.random.default_rng(0).poisson(5e4 * np.exp(-scale * lines)).clip(1)
    truth = scale * np.stack([coarse(settled(fine, float(t))) for t in MOMENTS])
    return recon.TimedViews((-np.log(counts / 5e4)).astype(np.float32), geometry, times), truth


@pytest.mark.parametrize("kind", ["shell", "teapot", "foam"])
def test_time(kind: str) -> None:
    """A sample that settles: one volume, two to six parts of the views, and one fit of three volumes."""
    views, truth = in_time(kind)
    for parts in (1, 2, 3, 4, 6):
        measured(f"{kind} in time, fista-tv, {parts} parts", truth, lambda parts=parts: of_sub_scans(views, parts))  # type: ignore[misc]

    def one_fit() -> F32:
        made = recon.fit_series(views, 3)
        return np.stack([made.at(float(t)) for t in MOMENTS])

    measured(f"{kind} in time, one fit", truth, one_fit)


def foam() -> F32:
    """As `shell`, of a simulated foam: spheres of air in a cylinder."""
    sample = load_scene({"phantom": FOAM, "beam": {"photons_per_s": 1.0}}).sample
    grid = Grid((32, 128, 128), 0.0034)
    return np.asarray(sample_at(sample, 0.0).attenuation(grid), np.float32)[8:24]
