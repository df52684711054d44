"""Particles: those of a phantom are found, each with its volume and its place."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation
from skimage.measure import regionprops

from recon.features.particles import bodies_outside, cleaned, measured, parted, volume_deviation
from recon.post import clusters, enhanced, inscribed_box
from tests.recon.post.phantom import BALLS, CIRCLE, SHAPE, can, inside


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.25])
def test_balls_in_a_can_are_found_with_number_volume_and_place(noise: float) -> None:
    box = inscribed_box(SHAPE, CIRCLE, margin=0.08)
    grey = enhanced(can(noise)[box])
    labels = parted(cleaned(grey > clusters(grey).threshold, smallest=27))
    found = measured(labels, origin=tuple(float(part.start) for part in box))  # type: ignore[arg-type]
    expected = [(centre, radius) for centre, radius in BALLS if centre[2] < 55]
    assert found.label.size == len(expected) and not found.cut.any()
    for centre, radius in expected:
        nearest = int(np.linalg.norm(found.centroid - centre, axis=1).argmin())
        np.testing.assert_allclose(found.centroid[nearest], centre, atol=0.3)
        # The level of half the contrast moves inwards by the mean curvature: σ² / r, σ² of phantom and filter together.
        inwards = (0.6**2 + 0.7**2) / radius
        assert -0.1 <= radius - found.diameter[nearest] / 2 <= inwards + 0.1


def test_sizes_and_places_are_those_of_another_library(rng: np.random.Generator) -> None:
    labels = np.zeros(SHAPE, np.int32)
    for number, (centre, radius) in enumerate(BALLS, 3):
        labels[inside(centre, radius)] = number
    labels[0, :4, :5] = 1
    spacing, origin = (0.5, 0.2, 0.2), (-3.0, 1.0, 2.0)
    found = measured(labels, spacing, origin)
    for i, region in enumerate(regionprops(labels, spacing=spacing)):
        assert found.label[i] == region.label
        assert found.volume[i] == pytest.approx(region.area)
        assert found.diameter[i] == pytest.approx(region.equivalent_diameter_area)
        np.testing.assert_allclose(found.centroid[i], np.add(region.centroid, origin))
    assert found.cut.tolist() == [True] + [False] * len(BALLS)
    whole = found.diameter[1:]
    assert found.statistics()["d50"] == pytest.approx(np.median(whole))
    assert found.statistics()["particles"] == len(BALLS) + 1


@pytest.mark.parametrize(("radius", "apart"), [(5, 1.0), (5, 0.85), (8, 0.8), (12, 0.75)])
def test_two_balls_that_touch_are_two(radius: float, apart: float) -> None:
    shape = (40, 40, 70)
    one = inside((20, 20, 22), radius, shape)
    other = inside((20, 21, 22 + 2 * radius * apart), radius, shape)
    labels = parted(one | other)
    assert labels.max() == 2
    np.testing.assert_array_equal(labels > 0, one | other)
    shares = np.bincount(labels.ravel())[1:] / (one | other).sum()
    assert shares == pytest.approx([0.5, 0.5], abs=0.05)
    assert parted(one | other, neck=0).max() == 1


@pytest.mark.parametrize("seed", range(6))
def test_an_ellipsoid_and_a_plate_are_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turned = (np.moveaxis(np.mgrid[:32, :32, :32], 0, -1) - 15.3) @ Rotation.random(rng=rng).as_matrix()
    ellipsoid = ((turned / rng.uniform(4, 12, 3)) ** 2).sum(axis=-1) <= 1
    plate = (np.abs(turned) <= (3, 8, 9)).all(axis=-1)
    assert parted(ellipsoid).max() == parted(plate).max() == 1


def test_cleaning_removes_specks_and_whiskers_and_fills_holes() -> None:
    body = inside((20, 30, 30), 9)
    dirty = body.copy()
    dirty[20, 30, 30] = False  # a hole
    dirty[20, 30, 40:60] = True  # a whisker
    dirty[5, 60, 60] = dirty[5, 60, 62] = True  # specks
    np.testing.assert_array_equal(cleaned(dirty, 1, 8), cleaned(body, 1, 8))
    assert cleaned(body, 1, 8).sum() == pytest.approx(body.sum(), rel=0.01)
    assert not cleaned(body, 0, int(body.sum()) + 1).any()
    assert cleaned(body, 0, int(body.sum())).sum() == body.sum()


def test_a_particle_at_a_face_loses_nothing_there() -> None:
    half = inside((0, 30, 30), 8)
    whole = cleaned(np.concatenate((half[:0:-1], half)))
    np.testing.assert_array_equal(cleaned(half), whole[SHAPE[0] - 1 :])
    assert measured(parted(cleaned(half))).cut.tolist() == [True]


def test_no_particles_are_no_error() -> None:
    found = measured(parted(np.zeros((4, 5, 6), bool)))
    assert found.label.size == 0 and found.statistics() == {"particles": 0.0, "cut": 0.0}


def test_a_negative_radius_is_refused() -> None:
    with pytest.raises(ValueError, match="0 or more"):
        cleaned(np.ones((3, 3, 3), bool), -1)


def soft_balls(shape: tuple[int, int, int], radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Grey values of nine balls in a slab, one at a place off the grid, that are 1/2 at their surfaces, and labels."""
    rng, grey = np.random.default_rng(3), np.zeros(shape)
    z, y, x = np.indices(shape)
    labels = np.zeros(shape, np.int32)
    for number in range(9):
        centre = np.array([shape[0] / 2, 10 + 20 * (number // 3), 10 + 20 * (number % 3)]) + rng.uniform(-0.5, 0.5, 3)
        away = radius - np.sqrt((z - centre[0]) ** 2 + (y - centre[1]) ** 2 + (x - centre[2]) ** 2)
        grey = np.maximum(grey, np.clip(0.5 + away / 4, 0, 1))
        labels[away > 0] = number + 1
    return grey.astype(np.float32), labels


def test_the_deviation_of_a_volume_is_that_of_repeated_noise() -> None:
    """Noise that is correlated over 1.2 voxels moves the volumes by their deviation, beside that of placement."""
    grey, labels = soft_balls((20, 60, 60), 6)
    sigma, volumes = 0.06, []
    for seed in range(60):
        noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=grey.shape), 1.2 / np.sqrt(2))
        noisy = grey + sigma * noise / noise.std()
        volumes.append(np.bincount(ndimage.label(ndimage.binary_opening(noisy > 0.5))[0].ravel())[1:])
    scatter = np.std([v for v in volumes if len(v) == 9], axis=0).mean()
    assert len([v for v in volumes if len(v) == 9]) > 50
    by_noise = volume_deviation(labels, grey, np.full_like(grey, sigma), 0.5)
    placed = volume_deviation(labels, grey, np.zeros_like(grey), 0.5)
    assert np.sqrt(by_noise**2 - placed**2).mean() == pytest.approx(scatter, rel=0.25)
    np.testing.assert_allclose(placed, 0.07 * 4 * np.pi * 6**2, rtol=0.1)  # 0.07 voxels times the surface


def test_bodies_outside_a_box_are_counted_without_the_wall_around_it() -> None:
    mask = np.zeros((8, 60, 60), bool)
    y, x = np.ogrid[:60, :60]
    mask[:, np.abs(np.hypot(y - 30, x - 30) - 28) < 1.5] = True  # the wall
    box = slice(0, 8), slice(18, 43), slice(18, 43)
    assert bodies_outside(mask, box) == 0
    for n, (row, col) in enumerate([(10, 30), (30, 10), (50, 30), (30, 50)], 1):
        mask[2:6, row - 2 : row + 2, col - 2 : col + 2] = True
        assert bodies_outside(mask, box) == n
    mask[2:6, 28:32, 28:32] = True  # inside
    mask[2:6, 16:20, 28:32] = True  # across an edge of the box
    assert bodies_outside(mask, box) == 4
