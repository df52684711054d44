"""Rows of docs/performance.md on emission and energies: dB, CPU seconds and peak memory, on a measured and a simulated
volume.

pytest -m bench -s tests/bench/test_beyond_grey.py    (needs xraylib; two minutes)
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.assess.metrics import psnr
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from simulators.light.palette import known
from tests.bench.quality_cases import OBJECTS, seen_by_simulator
from tests.bench.test_materials import grains
from tests.conftest import SHARED_DATA

pytestmark = pytest.mark.bench
PITCH, ROWS, ENERGIES = 1.1e-3, 8, (8.320, 8.345, 8.3485, 8.380)


def shell() -> F32:
    """[z, y, x] of 16 x 128 x 128 voxels, two a pixel, largest value 1."""
    return np.ascontiguousarray(OBJECTS["shell"](SHARED_DATA)[104:120])


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


@pytest.mark.parametrize("kind", ["shell", "grains"])
def test_emission(kind: str) -> None:
    """10⁶ counts of the volume as an activity, 30 % of them randoms, 90 views."""
    fine = shell() if kind == "shell" else grains()[1]
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


@pytest.mark.parametrize("kind", ["shell", "grains"])
def test_energies(kind: str) -> None:
    """The share of charged oxide, of two materials: fitted together, and from a volume an energy; 4 x 30 views."""
    if kind == "shell":
        whole = shell()
        left = np.arange(whole.shape[2]) < whole.shape[2] // 2
        parts = np.stack([whole * left, whole * ~left])
    else:
        parts = grains()[:2]
    truth = np.stack([coarse(part) for part in parts])
    energy = np.arange(120) % len(ENERGIES)
    geometry = Geometry.parallel(np.arange(120) * np.pi / 120, truth.shape[1:3], pixel_pitch=PITCH)
    oxide = known("NMC811")
    assert oxide is not None
    sections = np.stack([replace(oxide, state_of_charge=charge).attenuation(ENERGIES) for charge in (0.0, 1.0)], 1)
    lines = [seen_by_simulator(part, geometry, PITCH / 2) for part in parts]
    depth = sum(line * sections[energy, m][:, None, None] for m, line in enumerate(lines))
    counts = np.random.default_rng(2).poisson(5000 * np.exp(-depth)).clip(1)
    views = recon.EnergyViews((-np.log(counts / 5000)).astype(np.float32), geometry, energy, sections)

    def apart() -> F32:
        own = [np.flatnonzero(energy == e) for e in range(len(ENERGIES))]
        found = [
            recon.reconstruct(views.projections[at], geometry.select(at), recon.FistaTv()).volume.data for at in own
        ]
        return np.einsum("me,ezyx->mzyx", np.linalg.pinv(sections), np.stack(found))[1].astype(np.float32)

    measured(f"energies of the {kind}, together", truth[1], lambda: recon.fit_materials(views).densities[1])
    measured(f"energies of the {kind}, apart", truth[1], apart)
