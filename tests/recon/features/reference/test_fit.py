"""Gains of particles, the proximal step of two total variations, and weights that fall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.features.reference.fit import TwoVariations, gains_of
from recon.features.reference.motion import Moved
from recon.features.reference.particles import particles_of
from recon.features.reference.weights import line_contrast, whole_lines
from tests.recon.features.reference.scene import packed


def _moved() -> Moved:
    particles = particles_of(np.ascontiguousarray(packed().volume.transpose(1, 2, 0)))
    assert particles is not None
    shape = particles.label.shape
    return Moved(particles, (0, 0, 0), np.zeros((3, *shape), np.float32), np.ones(particles.count + 1))


def test_gains_are_medians_that_a_slit_does_not_move_and_zero_for_what_is_gone(rng: np.random.Generator) -> None:
    moved = _moved()
    truth = rng.uniform(0.7, 1.3, moved.gains.size)
    truth[0], truth[5] = 1.2, 0.0
    x = replace(moved, gains=truth).volume()
    slit = (moved.particles.label == 3) & (np.arange(x.shape[1])[:, None] % 9 == 0)
    x[slit] = 0
    np.testing.assert_allclose(gains_of(x, moved), truth, atol=0.03)


def test_a_reference_that_is_kept_has_the_same_volume() -> None:
    moved = _moved()
    known = moved.known()
    assert known.all()
    np.testing.assert_allclose(moved.volume(), moved.particles.volume, atol=1e-6)
    u = moved.u.copy()
    u[1] = 10
    beyond = replace(moved, u=u)
    assert not beyond.known()[:, -10:].any() and beyond.known()[:, :-10].all()
    assert not beyond.volume()[:, -10:].any()


def test_the_proximal_step_pulls_towards_the_reference_and_follows_a_copy(rng: np.random.Generator) -> None:
    shape = (10, 10, 3)
    m = rng.random(shape, np.float32)
    z = m + np.float32(0.05) * rng.standard_normal(shape).astype(np.float32)
    prox = TwoVariations(shape, (1.0, 1.0, 1.0), True)
    prox.about(m, np.zeros(shape, np.float32), np.ones(shape, np.float32))
    x = z.copy()
    for _ in range(60):
        x[...] = z
        prox(x, 0.5)
    assert np.square(x - m).sum() < 0.1 * np.square(z - m).sum()
    other, again, once = prox.copy(), z.copy(), z.copy()
    other.about(m, np.zeros(shape, np.float32), np.ones(shape, np.float32))
    other(again, 0.5)
    prox(once, 0.5)
    np.testing.assert_array_equal(again, once)
    clipped = -z
    prox(clipped, 0.0)
    np.testing.assert_array_equal(clipped, np.maximum(-z, 0))


@pytest.mark.parametrize("turn", [0.0, 0.7, np.pi / 2])
def test_a_line_is_darker_than_its_sides_only_along_it(turn: float) -> None:
    stencil = line_contrast(turn)
    assert stencil.sum() == pytest.approx(0, abs=1e-6)
    half = stencil.shape[0] // 2
    j, i = np.mgrid[-half : half + 1, -half : half + 1]
    line = np.where(np.abs(j * np.cos(turn) - i * np.sin(turn)) < 0.5, -1.0, 0.0)
    across = np.where(np.abs(j * np.sin(turn) + i * np.cos(turn)) < 0.5, -1.0, 0.0)
    assert (stencil * line).sum() > 0.6
    assert abs((stencil * across).sum()) < 0.15


def test_faint_parts_of_a_line_count_only_with_its_dark_part() -> None:
    dark = np.zeros((12, 12, 3), np.float32)
    dark[3, 1:10, 1] = 2.0  # faint along all of its length, and dark in one voxel
    dark[3, 5, 1] = 4.0
    dark[4, 10, 2] = 1.8  # touches its end
    dark[8, 1:10, 1] = 2.5  # nowhere dark enough
    expected = dark.copy()
    expected[8] = 0
    np.testing.assert_array_equal(whole_lines(dark, 1.5), expected)
    clear = np.zeros_like(dark)
    clear[3, 5, 1] = 4.0
    np.testing.assert_array_equal(whole_lines(dark, 3.0), clear)
    assert not whole_lines(np.zeros_like(dark), 1.5).any()
