"""Numbers of labelled volumes, compared with other libraries and with formulas."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse.linalg import cg
from skimage.measure import marching_cubes, mesh_surface_area, regionprops

from splatline_structure import transport
from splatline_structure.materials import label_values, labelled, materials_of, probabilities
from splatline_structure.numbers import Rules, coarse, structure_of
from splatline_structure.particles import cleaned, measured, parted, surfaces
from splatline_structure.transport import connecting, tortuosity

NECK = 0.8


def away(centre: tuple[float, ...], shape: tuple[int, int, int]) -> NDArray[np.float64]:
    """Distance of each voxel from a point."""
    return np.sqrt(sum((axis - at) ** 2 for axis, at in zip(np.indices(shape), centre, strict=True)))


def blobs(side: int = 48, seed: int = 0, level: float = 0.0) -> NDArray[np.bool_]:
    """A random structure of blobs and channels, about half of the volume."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(side,) * 3), 3)
    return np.asarray(noise > level * noise.std())


def grains(shape: tuple[int, int, int] = (40, 60, 60)) -> NDArray[np.float32]:
    """Balls of radius 6 on a lattice that nearly touch, 1 in 0, with edges of a voxel."""
    z, y, x = np.indices(shape)
    off = np.stack([(axis + shift) % 13 - 6 for axis, shift in ((z, 6), (y, 6), (x, 6))])
    return np.clip(6.5 - np.sqrt((off**2).sum(axis=0)), 0, 1).astype(np.float32)


@pytest.mark.parametrize(("radius", "flat"), [(10, 1.0), (16, 1.0), (16, 2.0)])
def test_the_surface_of_a_ball_is_that_of_the_formula(radius: float, flat: float) -> None:
    """Also in voxels that are twice as high as wide."""
    n = 2 * radius + 6
    z, y, x = np.indices((round(n / flat), n, n))
    z = (z - (n / flat - 1) / 2) * flat
    ball = z**2 + (y - n / 2 + 0.3) ** 2 + (x - n / 2 + 0.2) ** 2 < radius**2
    area = surfaces(ball.astype(np.int32), (flat, 1, 1))[1]
    assert area == pytest.approx(4 * math.pi * radius**2, rel=0.01)


def test_the_surface_of_smooth_blobs_is_that_of_another_librarys_mesh() -> None:
    noise = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(70, 70, 70)), 5)
    vertices, faces, *_ = marching_cubes(noise, 0.0)
    density = surfaces((noise > 0).astype(np.int32), goes_on=True)[1] / noise.size
    assert density == pytest.approx(mesh_surface_area(vertices, faces) / 69**3, rel=0.01)


def test_fraction_volumes_and_places_are_those_of_other_libraries() -> None:
    porespy = pytest.importorskip("porespy")
    mask = blobs()
    labels = parted(mask, NECK)
    particles = measured(labels, (0.5, 0.2, 0.2), (1.0, 2.0, 3.0))
    for i, region in enumerate(regionprops(labels, spacing=(0.5, 0.2, 0.2))):
        assert particles.volume[i] == pytest.approx(region.area)
        assert particles.diameter[i] == pytest.approx(region.equivalent_diameter_area)
        np.testing.assert_allclose(particles.centroid[i], np.add(region.centroid, (1, 2, 3)))
    rules = Rules(particles=2, through=2, side=0)
    numbers = structure_of(mask.astype(np.float32), np.array([0.5]), (1, 1, 1), rules).numbers
    assert numbers["fraction_1"] == pytest.approx(porespy.metrics.porosity(~mask), rel=1e-6)
    through = porespy.filters.trim_nonpercolating_paths(mask, inlets=faces(0), outlets=faces(-1))
    assert numbers["connected_z"] == pytest.approx(through.sum() / mask.sum(), rel=0.01)


def faces(at: int) -> NDArray[np.bool_]:
    out = np.zeros((48, 48, 48), bool)
    out[at] = True
    return out


@pytest.mark.parametrize("axis", [0, 2])
def test_the_tortuosity_is_that_of_taufactor(axis: int) -> None:
    taufactor = pytest.importorskip("taufactor")
    mask = blobs(40, 2)
    solver = taufactor.Solver(np.moveaxis(mask, axis, 0).astype(int), device="cpu")
    solver.solve(verbose=False)
    assert tortuosity(mask, axis) == pytest.approx(float(solver.tau[0]), rel=0.01)


def test_few_iterations_solve_the_tortuosity(monkeypatch: pytest.MonkeyPatch) -> None:
    """29 for this cube; 244 with the diagonal alone, whose number grows with the side."""
    iterations: list[float] = []

    def counted(*system: Any, **settings: Any) -> Any:
        return cg(*system, **settings, callback=lambda field: iterations.append(field[0]))

    monkeypatch.setattr(transport, "cg", counted)
    assert tortuosity(blobs(), 0) > 1
    assert 0 < len(iterations) < 60


def test_a_straight_channel_has_the_tortuosity_1_and_a_wall_none() -> None:
    channel = np.zeros((20, 12, 12), bool)
    channel[:, 3:9, 4:8] = True
    assert tortuosity(channel, 0) == pytest.approx(1, rel=1e-4)
    assert connecting(channel, 0).sum() == channel.sum()
    assert tortuosity(channel, 1) == math.inf and not connecting(channel, 2).any()


@pytest.mark.parametrize(("radius", "apart"), [(5, 1.0), (8, 0.8), (12, 0.75)])
def test_two_balls_that_touch_are_two_and_touch(radius: float, apart: float) -> None:
    shape = (40, 40, 70)
    one = away((20, 20, 22), shape) <= radius
    other = away((20, 21, 22 + 2 * radius * apart), shape) <= radius
    labels = parted(one | other, NECK)
    particles = measured(labels)
    np.testing.assert_array_equal(labels > 0, one | other)
    assert particles.volume / (one | other).sum() == pytest.approx([0.5, 0.5], abs=0.05)
    assert particles.neighbours == ((2,), (1,)) and not particles.cut.any()
    assert particles.sphericity == pytest.approx([1, 1], abs=0.1)
    assert parted(one | other, 0).max() == 1


def test_cleaning_removes_specks_and_whiskers_and_fills_holes() -> None:
    body = away((20, 30, 30), (40, 70, 70)) <= 9
    dirty = body.copy()
    dirty[20, 30, 30] = False  # a hole
    dirty[20, 30, 40:60] = True  # a whisker
    dirty[5, 60, 60] = dirty[5, 60, 62] = True  # specks
    np.testing.assert_array_equal(cleaned(dirty, 1, 8), cleaned(body, 1, 8))
    assert cleaned(body, 1, 8).sum() == pytest.approx(body.sum(), rel=0.01)
    assert not cleaned(body, 0, int(body.sum()) + 1).any()


def test_a_particle_at_a_face_loses_nothing_there_and_is_cut() -> None:
    half = away((0, 30, 30), (20, 60, 60)) <= 8
    whole = cleaned(np.concatenate((half[:0:-1], half)))
    np.testing.assert_array_equal(cleaned(half), whole[19:])
    assert measured(parted(cleaned(half), NECK)).cut.tolist() == [True]


def test_quantiles_are_of_volume_and_of_whole_particles() -> None:
    shape = (30, 30, 80)
    labels = np.zeros(shape, np.int32)
    for number, (at, radius) in enumerate([((15, 15, 12), 4), ((15, 15, 40), 10), ((15, 15, 79), 12)], 1):
        labels[away(at, shape) <= radius] = number
    particles = measured(labels)
    assert particles.cut.tolist() == [False, False, True]
    assert particles.quantile(0.9) == pytest.approx(20, rel=0.03)  # the large ball has most of the volume
    assert math.isnan(measured(np.zeros((3, 3, 3), np.int32)).quantile(0.5))


def test_cracks_are_what_particles_lack() -> None:
    ball = (away((20, 20, 20), (41, 41, 41)) <= 15).astype(np.float32)
    ball[20, 12:29, 12:29] = 0
    structure = structure_of(ball, np.array([0.5]), (1, 1, 1), Rules(2, 1, radius=2, side=0))
    numbers, page = structure.numbers, structure._repr_html_()
    assert f"particles: {len(structure.particles.cut)}" in page and "fraction_1" in page and "data:image/png" in page
    assert numbers["cracks"] == pytest.approx(17 * 17 / (4 / 3 * math.pi * 15**3), rel=0.05)


def test_levels_lie_away_from_edges_and_noise_leaves_voxels_undecided(rng: np.random.Generator) -> None:
    blurred = ndimage.gaussian_filter(grains((60, 60, 60)), 1.0) + rng.normal(0, 0.05, (60, 60, 60)).astype(np.float32)
    materials = materials_of(2 + 3 * blurred.astype(np.float32), 2)
    assert materials.levels == pytest.approx([2.1, 5], abs=0.25)
    shares = probabilities(np.float32([[[2.0, 3.5, 5.0]]]), materials.thresholds, 0.5)
    np.testing.assert_allclose(shares.sum(axis=0), 1, atol=1e-6)
    assert shares[1, 0, 0, 0] < 0.05 and shares[1, 0, 0, 2] > 0.95 and 0.3 < shares[1, 0, 0, 1] < 0.7


@pytest.mark.parametrize(("count", "words"), [(2, "materials 1 and 2 of 2 have no contrast"), (1, "at least 2")])
def test_noise_alone_is_no_two_materials(count: int, words: str, rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match=words):
        materials_of(rng.normal(1, 0.1, (30, 30, 30)).astype(np.float32), count)


def test_three_materials_are_numbered_from_the_least_dense_on() -> None:
    z = np.indices((30, 30, 30))[0]
    volume = np.select([z < 10, z < 20], [0.0, 1.0], 3.0).astype(np.float32)
    materials = materials_of(volume, 3)
    assert materials.levels == pytest.approx([0, 1, 3], abs=0.01)
    labels = labelled(volume, materials.thresholds)
    assert np.bincount(labels.ravel()).tolist() == [9000, 9000, 9000]
    structure = structure_of(volume, materials.thresholds, (1, 1, 1), Rules(2, 3, side=0))
    assert structure.along_z == pytest.approx([0.0] * 10 + [1.0] * 10 + [0.0] * 10)
    assert structure.numbers["connected_z"] == 0 and structure.numbers["connected_y"] == 1
    assert structure.radial[0] == pytest.approx(1 / 3 * np.ones_like(structure.radial[0]))


def test_voxels_twice_as_wide_are_means() -> None:
    fine = np.arange(5 * 4 * 4, dtype=np.float32).reshape(5, 4, 4)
    assert coarse(fine).shape == (2, 2, 2) and coarse(fine)[0, 0, 0] == pytest.approx(fine[:2, :2, :2].mean())


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_thick_slices_are_voxels_that_conduct_by_their_edges(axis: int) -> None:
    mask = blobs(24, 2)
    fine, turned = mask.repeat(3, axis=0), np.swapaxes(mask, 0, 1)
    found = tortuosity(mask, axis, (3, 1, 1))
    assert found == pytest.approx(tortuosity(fine, axis), rel=0.08)
    assert found == pytest.approx(tortuosity(turned, (1, 0, 2)[axis], (1, 3, 1)), rel=1e-3)
    assert abs(tortuosity(mask, axis) / found - 1) > 0.03  # what cubes would have


def test_particles_in_thick_slices_are_those_in_cubes() -> None:
    shape, balls = (48, 48, 48), (((22, 14, 14), 10), ((22, 34, 14), 10.5), ((24, 30, 36), 9))
    fine = np.logical_or.reduce([away(at, shape) < r for at, r in balls])
    cubes, slabs = (
        measured(parted(cleaned(mask, 1, 27, edges), NECK, edges), edges)
        for mask, edges in ((fine, (1.0, 1.0, 1.0)), (fine[1::3], (3.0, 1.0, 1.0)))
    )
    assert cubes.label.size == slabs.label.size == 3
    np.testing.assert_allclose(np.sort(slabs.diameter), np.sort(cubes.diameter), rtol=0.03)


def test_labels_are_their_own_levels() -> None:
    labels = np.random.default_rng(0).integers(0, 3, (12, 12, 12)).astype(np.float32)
    assert materials_of(labels, 3).levels.tolist() == [0, 1, 2]
    assert label_values(labels).tolist() == [0, 1, 2] and not label_values(grains()).size
    assert not label_values(np.ones((4, 4, 4), np.float32)).size
