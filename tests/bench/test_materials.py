"""Materials from several energies beside one volume an energy, on grains of known charge.

pytest -m bench -s tests/bench/test_materials.py    (needs xraylib; a minute)
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.voxels.displacement import Displacement, displaced
from simulators.samples.materials.materials import known
from tests.bench.quality_cases import seen_by_simulator

pytestmark = pytest.mark.bench
SIDE, ROWS, PITCH = 96, 8, 1.1e-3  # mm
SIX = (8.320, 8.336, 8.345, 8.3485, 8.352, 8.380)
CASES = [  # energies, views of each, photons
    ((8.320, 8.3485, 8.352), 30, 2000),
    ((8.320, 8.345, 8.3485, 8.380), 30, 5000),
    (SIX, 15, 5000),
    (SIX, 15, 20_000),
    (tuple(np.linspace(8.33, 8.37, 12)), 8, 5000),
]
WEIGHTS = (0.001, 0.003, 0.01, 0.03, 0.1)


def grains() -> F32:
    """Fresh and charged oxide and electrolyte, [material, z, y, x] with two voxels a pixel; charge rises outwards."""
    rng, side, rows = np.random.default_rng(1), 2 * SIDE, 2 * ROWS
    y, x = (np.mgrid[:side, :side] - (side - 1) / 2) / 2
    z = (np.arange(rows)[:, None, None] - (rows - 1) / 2) / 2
    grain, charge = np.zeros((rows, side, side)), np.zeros((rows, side, side))
    for _ in range(40):
        at_x, at_y, at_z = rng.uniform(-30, 30), rng.uniform(-30, 30), rng.uniform(-6, 6)
        radius = rng.uniform(3.5, 7)
        far = np.sqrt((x - at_x) ** 2 + (y - at_y) ** 2 + (z - at_z) ** 2)
        own = (far < radius) & (grain == 0)
        grain[own] = 1
        charge[own] = np.clip(rng.uniform(0.1, 0.6) + rng.uniform(0, 0.4) * far[own] / radius, 0, 1)
    liquid = (np.hypot(x, y) < 42) * (1 - grain)
    return np.stack([grain * (1 - charge), grain * charge, liquid]).astype(np.float32)


def cross_sections(energies: Sequence[float]) -> F64:
    """1/mm of the three materials, [energy, material]."""
    oxide, liquid = known("NMC811"), known("electrolyte")
    assert oxide is not None and liquid is not None
    materials = replace(oxide, state_of_charge=0.0), replace(oxide, state_of_charge=1.0), liquid
    return np.stack([material.attenuation(energies) for material in materials], 1)


def counted(depth: F64, photons: float) -> F32:
    """Line integrals with the noise of so many photons."""
    counts = np.random.default_rng(2).poisson(photons * np.exp(-depth)).clip(1)
    return (-np.log(counts / photons)).astype(np.float32)


def charge_of(fine: F32) -> tuple[NDArray[np.bool_], F32]:
    """Voxels of the oxides, and their charge, [z, y, x] of single pixels."""
    truth = fine.reshape(3, ROWS, 2, SIDE, 2, SIDE, 2).mean((2, 4, 6))
    oxides = truth[:2].sum(0)
    return oxides > 0.9, truth[1] / np.maximum(oxides, 0.1)


@pytest.mark.parametrize(("energies", "each", "photons"), CASES)
def test_charge(energies: tuple[float, ...], each: int, photons: float) -> None:
    fine, n = grains(), len(energies) * each
    angles, energy = np.arange(n) * np.pi / n, np.arange(n) % len(energies)
    geometry = Geometry.parallel(angles, (ROWS, SIDE), pixel_pitch=PITCH)
    sections = cross_sections(energies)
    lines = [seen_by_simulator(volume, geometry, PITCH / 2) for volume in fine]
    depth = sum(line * sections[energy, m][:, None, None] for m, line in enumerate(lines))
    views = recon.EnergyViews(counted(depth, photons), geometry, energy, sections)

    matter, charge = charge_of(fine)

    def error(densities: F32) -> float:
        found = np.clip(densities[1] / np.maximum(densities[:2].sum(0), 0.05), 0, 1)
        return float(np.sqrt(np.mean((found - charge)[matter] ** 2)))

    def separately(weight: float | None) -> F32:
        own = [np.flatnonzero(energy == e) for e in range(len(energies))]
        method = recon.FistaTv(tv_weight=weight)
        volumes = [
            recon.reconstruct(views.projections[at], geometry.select(at), method=method).volume.data for at in own
        ]
        return np.einsum("me,ezyx->mzyx", np.linalg.pinv(sections), np.stack(volumes)).astype(np.float32)

    began = time.process_time()
    found = recon.fit_materials(views)
    joint, took = error(found.densities), time.process_time() - began
    began = time.process_time()
    smooth, more = error(recon.fit_share(views, found, (0, 1)).densities), time.process_time() - began
    default = error(separately(None))
    apart = {weight: error(separately(weight)) for weight in WEIGHTS}
    best = min(apart, key=lambda weight: apart[weight])
    began = time.process_time()
    separately(best)
    alone = time.process_time() - began
    guess = float(charge[matter].std())
    print(
        f"\n{len(energies)} energies of {each} views, {photons} photons: joint {joint:.3f} ({took:.1f} CPU s), "
        f"share {smooth:.3f} ({more:.1f} CPU s), apart {apart[best]:.3f} at {best} ({alone:.1f} CPU s), by views held "
        f"out {default:.3f}, ratios {joint / apart[best]:.2f}, {smooth / apart[best]:.2f}, guess {guess:.3f}"
    )
    assert smooth < joint < apart[best]


@pytest.mark.parametrize("optics", [0.0, 1.0])
def test_shifts(monkeypatch: pytest.MonkeyPatch, optics: float) -> None:
    """Six energies of 15 views; the sample stood up to 3 pixels elsewhere at each but the first.

    With optics the image is shifted by up to 2 pixels, too, and magnified by up to 2 %.
    """
    monkeypatch.setattr("tests.bench.test_materials.ROWS", 16)
    fine, each, photons, rng = grains(), 15, 5000, np.random.default_rng(3)
    half = np.concatenate([rng.integers(-6, 7, (len(SIX), 2)), rng.integers(-3, 4, (len(SIX), 1))], 1)  # half pixels
    images, magnified = optics * rng.uniform(-2, 2, len(SIX)), 1 + optics * rng.uniform(-0.02, 0.02, len(SIX))
    half[0], images[0], magnified[0] = 0, 0, 1
    n = len(SIX) * each
    angles, energy = np.arange(n) * np.pi / n, np.arange(n) % len(SIX)
    geometry, depth = Geometry.parallel(angles, (ROWS, SIDE), pixel_pitch=PITCH), np.zeros((n, ROWS, SIDE))
    sections = cross_sections(SIX)
    for e, (x, y, z) in enumerate(half):
        own, factor = np.flatnonzero(energy == e), magnified[e]
        axis_col = geometry.axis_col + images[e] * factor
        seen = replace(geometry.select(own), pixel_pitch=PITCH / factor, axis_col=axis_col)
        for volume, mu in zip(fine, sections[e], strict=True):
            depth[own] += mu * seen_by_simulator(np.roll(volume, (z, y, x), (0, 1, 2)), seen, PITCH / 2)
    views = recon.EnergyViews(counted(depth, photons), geometry, energy, sections)
    began = time.process_time()
    corrected, moves = recon.register_energies(views)
    took = time.process_time() - began
    apart = np.array([(move.x, move.y, move.z) for move in moves]) / PITCH - half / 2
    by_optics = [np.array([move.image for move in moves]) / PITCH - images]
    by_optics.append(np.array([move.magnification for move in moves]) - magnified)
    matter, charge = charge_of(fine)
    matter[:2] = matter[-2:] = False

    def error(seen: recon.EnergyViews) -> float:
        share = recon.fit_materials(seen).share(1, [0], 0.05)
        return float(np.sqrt(np.nanmean((share - charge)[matter] ** 2)))

    true = displaced(geometry, energy, [Displacement(*(at / 2 * PITCH)) for at in half])
    errors = [error(each) for each in (views, corrected, replace(views, geometry=true))]
    image, larger = np.abs(by_optics[0]).max(), 100 * np.abs(by_optics[1]).max()
    print(
        f"\nlargest errors of x, y, z {np.abs(apart).max(0).round(3)} px, of the image {image:.3f} px and "
        f"{larger:.2f} %, {took:.1f} CPU s; charge's error {errors[0]:.3f} as it is, {errors[1]:.3f} registered, "
        f"{errors[2]:.3f} with the true shifts"
    )
    assert errors[1] < 0.5 * errors[0]
