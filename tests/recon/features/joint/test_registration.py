"""Registration of energies: known shifts of a sample between energies, projected by the simulator."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.features.joint.energy_fit import EnergyViews
from recon.features.joint.learnt_motion import STEPS, register_energies
from recon.features.joint.spectral import fit_materials
from tests.bench.quality_cases import seen_by_simulator

SIDE, ROWS, PITCH, EACH, PHOTONS = 48, 16, 1.1e-3, 10, 5000
# NMC811, fresh and charged, 1/mm at 8.320 ... 8.380 keV, and a liquid that is the same at all of them.
SECTIONS = np.array([[28.2, 28.1, 1.2], [31.7, 30.4, 1.2], [117.4, 96.7, 1.2], [114.3, 128.8, 1.2], [91.4, 91.4, 1.2]])
ALIKE = np.zeros(len(SECTIONS))
MOVES = np.array([[0, 0, 0], [3, -2, 0], [-4, 1, 2], [2, 4, -2], [-1, -3, 1]])  # x, y, z in half pixels


def grains() -> F32:
    """Fresh and charged grains in a liquid, [material, z, y, x] with two voxels a pixel."""
    rng = np.random.default_rng(4)
    z, y, x = np.meshgrid(*(np.arange(2 * n) / 2 - (2 * n - 1) / 4 for n in (ROWS, SIDE, SIDE)), indexing="ij")
    grain, charge = np.zeros(z.shape), np.zeros(z.shape)
    for _ in range(22):
        at, radius = (rng.uniform(-5, 5), *rng.uniform(-11, 11, 2)), rng.uniform(2, 4)
        own = ((z - at[0]) ** 2 + (y - at[1]) ** 2 + (x - at[2]) ** 2 < radius**2) & (grain == 0)
        grain[own], charge[own] = 1, rng.uniform(0, 1)
    liquid = (np.hypot(x, y) < 18) * (1 - grain)
    return np.stack([grain * (1 - charge), grain * charge, liquid]).astype(np.float32)


def seen(fine: F32, moves: np.ndarray, images: np.ndarray = ALIKE, magnified: np.ndarray = ALIKE) -> EnergyViews:
    n = len(SECTIONS) * EACH
    angles, energy = np.arange(n) * np.pi / n, np.arange(n) % len(SECTIONS)
    geometry, depth = Geometry.parallel(angles, (ROWS, SIDE), pixel_pitch=PITCH), np.zeros((n, ROWS, SIDE))
    for e, (x, y, z) in enumerate(moves):
        own, factor = np.flatnonzero(energy == e), 1 + magnified[e]
        axis_col = geometry.axis_col + images[e] * factor
        views = replace(geometry.select(own), pixel_pitch=PITCH / factor, axis_col=axis_col)
        for volume, mu in zip(fine, SECTIONS[e], strict=True):
            stood = np.ascontiguousarray(np.roll(volume, (z, y, x), (0, 1, 2)))
            depth[own] += mu * seen_by_simulator(stood, views, PITCH / 2)
    counts = np.random.default_rng(2).poisson(PHOTONS * np.exp(-depth)).clip(1)
    return EnergyViews((-np.log(counts / PHOTONS)).astype(np.float32), geometry, energy, SECTIONS)


def charge_error(views: EnergyViews, fine: F32) -> float:
    truth = fine.reshape(3, ROWS, 2, SIDE, 2, SIDE, 2).mean((2, 4, 6))
    inner = truth[:2].sum(0) > 0.9
    inner[:2] = inner[-2:] = False
    share = fit_materials(views, tv_weight=1e-3).share(1, [0], 0.05)
    return float(np.sqrt(np.nanmean((share - truth[1] / np.maximum(truth[:2].sum(0), 0.1))[inner] ** 2)))


def test_shifts_between_energies_are_found_and_the_charge_with_them() -> None:
    fine, steps = grains(), list[tuple[int, int]]()
    views = seen(fine, MOVES)
    corrected, moves = register_energies(views, lambda n, most: steps.append((n, most)))
    found = np.array([(move.x, move.y, move.z) for move in moves]) / PITCH
    assert found[:, :2] == pytest.approx(MOVES[:, :2] / 2, abs=0.1)
    assert found[:, 2] == pytest.approx(MOVES[:, 2] / 2, abs=0.2)  # the first and last rows show other matter
    assert [math.degrees(move.turn) for move in moves] == pytest.approx([0] * 5, abs=0.3)
    assert steps[-1] == (STEPS, STEPS) and [n for n, _ in steps] == sorted(n for n, _ in steps)
    true = replace(views, geometry=seen_where(views, MOVES / 2))
    errors = [charge_error(each, fine) for each in (views, corrected, true)]
    assert errors[1] < 0.5 * errors[0] and errors[1] < 1.3 * errors[2]


@pytest.mark.slow
def test_the_image_of_other_optics_is_that_of_the_reference() -> None:
    """The sample stands elsewhere, too; the image is shifted by up to 2 pixels and magnified by up to 3 %."""
    fine, images, magnified = grains(), np.array([0, 1.5, -1, 0.5, 2]), np.array([0, 0.02, -0.015, 0.01, -0.03])
    views = seen(fine, MOVES, images, magnified)
    corrected, moves = register_energies(views)
    assert [move.image / PITCH for move in moves] == pytest.approx(images, abs=0.1)
    assert [move.magnification - 1 for move in moves] == pytest.approx(magnified, abs=0.005)
    assert np.array([(move.x, move.y) for move in moves]) / PITCH == pytest.approx(MOVES[:, :2] / 2, abs=0.1)
    assert corrected.weight is not None and (corrected.weight[corrected.energy == 0] == 1).all()
    lost = corrected.weight[corrected.energy == 4]  # what is magnified by 0.97 ... shows more than the reference
    assert (lost[:, 2:-2, 3:-3] == 1).all() and (corrected.weight[corrected.energy == 1] == 1).mean() > 0.8
    assert charge_error(corrected, fine) < 0.5 * charge_error(views, fine)


def seen_where(views: EnergyViews, moves: np.ndarray) -> Geometry:
    """The geometry of these views of a sample that stood elsewhere by known pixels: x cos + y sin along a row."""
    x, y, z = moves[views.energy].T
    across = x * np.cos(views.geometry.angles) + y * np.sin(views.geometry.angles)
    return replace(views.geometry, shifts=np.stack((across, z), axis=1))


def test_a_sample_that_stood_still_is_left_where_it_is() -> None:
    corrected, moves = register_energies(seen(grains(), np.zeros((5, 3), int)))
    farthest = [np.hypot.reduce((move.x, move.y, move.z)) + abs(move.turn) * SIDE * PITCH / 2 for move in moves]
    assert max(farthest) < 0.1 * PITCH
    assert np.abs(corrected.geometry.shifts).max() < 0.1


def test_a_cone_is_refused() -> None:
    n = 2 * 6
    geometry = Geometry.cone(np.arange(n) * np.pi / 6, (8, 16), PITCH, 5.0, 7.0)
    views = EnergyViews(np.ones((n, 8, 16), np.float32), geometry, np.arange(n) % 2, SECTIONS[[0, 2], :2])
    with pytest.raises(ValueError, match="cone"):
        register_energies(views)
