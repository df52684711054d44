"""The linear problem of particles in projections: derivatives, transposes, and a particle by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import recon
from recon import Grid
from recon.features.reference.particle_fit import (
    UNKNOWNS,
    Body,
    Linear,
    ParticleEstimate,
    StateViews,
    gram,
    improved_rounds,
    patch_of,
)
from recon.voxels.projector import Projector

N, NZ, VIEWS = 48, 20, 30
GEOMETRY = recon.Geometry.parallel(np.arange(VIEWS) * np.pi / VIEWS, (NZ, N))
PROJECTOR = Projector(GEOMETRY, Grid.matching(GEOMETRY))
PLACES = np.array([[16.0, 17.0, 9.0], [31.3, 15.2, 11.4], [24.5, 33.1, 8.7]])


def ball(radius: float) -> np.ndarray:
    """A smooth ball of height 1 around the middle of 21³ voxels."""
    away = np.linalg.norm(np.moveaxis(np.indices((21, 21, 21)), 0, -1) - 10.0, axis=-1)
    return (1 / (1 + np.exp((away - radius) / 0.7))).astype(np.float32)


def body(number: int, radius: float) -> Body:
    shape = ball(radius)
    spline = ndimage.spline_filter(shape, 3, output=np.float32)
    return Body(number, spline, np.zeros(3), np.full(3, 10.0), 1.0, float(np.square(shape).sum()))


OFF = (0.8, -0.6, 0.5), (-1.0, 0.4, -0.4), (0.3, 0.9, 0.6)
BODIES = [body(1, 4.0), body(2, 5.0), body(3, 4.5)]
TRUTH = ParticleEstimate(np.array([0.9, 1.0, 1.05]), np.array([1.03, 0.98, 1.0]), PLACES, np.eye(3))


def volume_of(estimate: ParticleEstimate) -> np.ndarray:
    volume = np.zeros((N, N, NZ), np.float32)
    for k, each in enumerate(BODIES):
        patch = patch_of(each, 1.0, estimate.scale[k], estimate.position[k], estimate.rotation, volume.shape)
        assert patch is not None
        volume[patch.box] += np.float32(estimate.gain[k]) * patch.columns[0]
    return volume


def views_of(lines: np.ndarray) -> StateViews:
    rest = np.zeros((N, N, NZ), np.float32)
    smooth = rest.copy()
    smooth[2:5, 2:5] = 1  # away from the particles
    return StateViews(PROJECTOR, lines, np.ones_like(lines), rest, smooth, np.ones(NZ, bool))


@pytest.mark.parametrize("unknown", range(UNKNOWNS))
def test_columns_are_derivatives(unknown: int) -> None:
    def shown(gain: float, scale: float, place: np.ndarray) -> np.ndarray:
        out = np.zeros((N, N, NZ))
        patch = patch_of(BODIES[1], gain, scale, place, np.eye(3), out.shape)
        assert patch is not None
        out[patch.box] += gain * patch.columns[0]
        return out

    at, step = np.concatenate(([0.9, 1.02], PLACES[1])), 0.02
    ends = [at.copy(), at.copy()]
    ends[0][unknown] -= step
    ends[1][unknown] += step
    low, high = (shown(each[0], each[1], each[2:]) for each in ends)
    found = np.zeros((N, N, NZ))
    patch = patch_of(BODIES[1], 0.9, 1.02, PLACES[1], np.eye(3), found.shape)
    assert patch is not None
    found[patch.box] += patch.columns[unknown]
    expected = (high - low) / (2 * step)
    assert np.linalg.norm(found - expected) < 0.12 * np.linalg.norm(expected)  # slopes are central differences


def test_a_particle_outside_has_no_patch() -> None:
    assert patch_of(BODIES[0], 1.0, 1.0, np.array([-40.0, 10.0, 10.0]), np.eye(3), (N, N, NZ)) is None


def test_a_turned_particle_is_turned() -> None:
    long = np.zeros((21, 21, 21), np.float32)
    long[4:17, 9:12, 9:12] = 1
    own = Body(1, ndimage.spline_filter(long, 3, output=np.float32), np.zeros(3), np.full(3, 10.0), 1.0, 1.0)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    patch = patch_of(own, 1.0, 1.0, np.full(3, 20.0), turn, (41, 41, 41))
    assert patch is not None
    volume = np.zeros((41, 41, 41))
    volume[patch.box] = patch.columns[0]
    along = [float((volume.sum(tuple(a for a in range(3) if a != axis)) > 0.5).sum()) for axis in range(3)]
    assert along[1] > 2 * along[0] and along[1] > 2 * along[2]


def test_back_is_the_transpose_of_the_model_and_the_normal_matrix_is_symmetric(rng: np.random.Generator) -> None:
    linear = Linear.of(views_of(rng.normal(size=(VIEWS, N, NZ)).astype(np.float32)), BODIES, TRUTH)
    one, other = rng.normal(size=(2, 3 * UNKNOWNS + 2))
    assert one @ linear.normal(other) == pytest.approx(other @ linear.normal(one), rel=1e-3)


def test_the_normal_matrix_of_a_particle_by_itself_is_near_the_true_one() -> None:
    patch = patch_of(BODIES[1], 1.0, 1.0, PLACES[1], np.eye(3), (N, N, NZ))
    assert patch is not None
    rays = []
    for column in patch.columns:
        volume = np.zeros((N, N, NZ), np.float32)
        volume[patch.box] = column
        rays.append(PROJECTOR.plain.forward_lines(volume).ravel())
    true = np.array(rays) @ np.array(rays).T / VIEWS
    np.testing.assert_allclose(np.diag(gram(patch.columns)), np.diag(true), rtol=0.12)


def test_rounds_find_gain_scale_and_place() -> None:
    lines = PROJECTOR.forward_lines(volume_of(TRUTH))
    start = ParticleEstimate(np.ones(3), np.ones(3), PLACES + np.array(OFF), np.eye(3))
    found = improved_rounds(views_of(lines), BODIES, start, (20, 20, 20, 20))
    np.testing.assert_allclose(found.gain, TRUTH.gain, atol=5e-3)
    np.testing.assert_allclose(found.scale, TRUTH.scale, atol=2e-3)
    np.testing.assert_allclose(found.position, TRUTH.position, atol=0.02)


def test_deviations_from_halves_are_those_of_least_squares(rng: np.random.Generator) -> None:
    clean, noise = PROJECTOR.forward_lines(volume_of(TRUTH)), 0.1
    linear = Linear.of(views_of(clean), BODIES, TRUTH)
    normal = np.stack([linear.normal(row) for row in np.eye(3 * UNKNOWNS + 2)])
    true = noise * np.sqrt(np.diag(np.linalg.inv(normal)))[:-2].reshape(3, UNKNOWNS)
    told = []
    for _ in range(10):
        noisy = views_of(clean + rng.normal(0, noise, clean.shape).astype(np.float32))
        told.append(Linear.of(noisy, BODIES, TRUTH).noise_by_halves(np.ones(3, bool))[:, :UNKNOWNS])
    ratio = np.sqrt(np.square(told).mean((0, 1)) / np.square(true).mean(0))
    assert (ratio > 0.7).all() and (ratio < 1.4).all(), ratio


def test_slices_that_are_not_known_do_not_count_as_seen() -> None:
    views = views_of(PROJECTOR.forward_lines(volume_of(TRUTH)))
    assert Linear.of(views, BODIES, TRUTH).seen.min() > 0.98
    known = np.arange(NZ) < 9
    assert Linear.of(replace(views, known=known), BODIES, TRUTH).seen.max() < 0.7
