"""The motion of a reference: its bases, their transposes, and motions that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.base.decisions import Decisions, GoesOn
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.features.reference.motion import (
    Basis,
    MotionViews,
    Moved,
    affinely_moved,
    improved,
    padded,
    roughly_moved,
)
from recon.features.reference.particles import particles_of
from recon.voxels.iterative import scaled_problem
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import VoxelProblem, times_power
from tests.recon.features.reference.scene import Discs, N, packed, scanned

GRID = Grid((12, 20, 24), 0.5)
BASES = {
    "affine": Basis.affine(GRID, 12.0),
    "affine of few slices": Basis.affine(Grid((4, 20, 24), 0.5), 12.0),
    "splines": Basis.splines(GRID, 12.0, 4),
    "splines, constant along z": Basis.splines(GRID, 12.0, 2),
}


@pytest.mark.parametrize("name", BASES)
def test_back_is_the_transpose_of_field(name: str, rng: np.random.Generator) -> None:
    basis = BASES[name]
    c = rng.standard_normal(basis.shape)
    field = basis.field(c)
    f = rng.standard_normal(field.shape).astype(np.float32)
    assert np.vdot(field.astype(float), f) == pytest.approx(np.vdot(c, basis.back(f)), rel=1e-4)


@pytest.mark.parametrize("name", BASES)
def test_the_nearest_coefficients_give_the_field_again(name: str, rng: np.random.Generator) -> None:
    basis = BASES[name]
    field = basis.field(rng.standard_normal(basis.shape))
    np.testing.assert_allclose(basis.field(basis.nearest(padded(field))), field, atol=2e-4)


def test_bending_is_zero_for_straight_coefficients_and_a_gradient_for_others(rng: np.random.Generator) -> None:
    basis = BASES["splines"]
    straight = np.broadcast_to(np.arange(basis.shape[1], dtype=float)[:, None, None], basis.shape)
    np.testing.assert_allclose(basis.bending(straight), 0, atol=1e-12)

    def energy(c: np.ndarray) -> float:
        return sum(float(np.square(np.diff(c, 2, axis)).sum()) for axis in (1, 2, 3)) / 2

    c, d = rng.standard_normal(basis.shape), rng.standard_normal(basis.shape)
    slope = (energy(c + 1e-5 * d) - energy(c - 1e-5 * d)) / 2e-5
    assert slope == pytest.approx(float(np.vdot(basis.bending(c), d)), rel=1e-5)


def _state(scene: Discs) -> tuple[VoxelProblem, Moved]:
    """The problem of 24 views of the scene, and the scene at rest as its reference."""
    data, geometry = scanned(scene, 24, 1e5)
    projector = Projector(geometry, Grid.matching(geometry))
    problem, _ = scaled_problem(projector, Views(data, geometry), None, True, GoesOn(), Decisions(0))
    rest = replace(scene, turn=0.0, shift=(0.0, 0.0))
    volume = times_power(np.ascontiguousarray(rest.volume.transpose(1, 2, 0)), -problem.units.density)
    particles = particles_of(volume)
    assert particles is not None
    still = np.zeros((3, *volume.shape), np.float32)
    return problem, Moved(particles, (0, 0, 0), still, np.ones(particles.count + 1))


def test_a_turn_and_a_shift_are_found_from_the_views() -> None:
    scene = replace(packed(), turn=np.radians(2.5), shift=(4.0, -6.0))
    problem, moved = _state(scene)
    grid, views = problem.projector.grid, MotionViews.of(problem)
    width = grid.voxel_size * grid.shape[2]
    basis, filtered = Basis.affine(grid, width), problem.filtered("hann")
    assert filtered is not None
    x = np.maximum(filtered, 0)
    rough = replace(moved, u=padded(basis.field(roughly_moved(moved, x, grid, width))))
    found = affinely_moved(views, rough, basis, np.zeros_like(x))
    at = np.arange(N) - (N - 1) / 2
    y, x_ = np.meshgrid(at - 4.0, at + 6.0, indexing="ij")
    cos, sin = np.cos(scene.turn), np.sin(scene.turn)
    expected = np.stack((cos * y - sin * x_ - at[:, None], sin * y + cos * x_ - at))
    inside = np.hypot(*np.meshgrid(at, at)) < 0.4 * N
    off = (found.u[:2, :, :, 1] - expected)[:, inside]
    assert np.sqrt(np.square(off).mean()) < 0.1
    assert not found.u[2].any()  # few slices do not show motion along the axis
    assert found.gains[1] == pytest.approx(1, abs=0.02)


def test_a_step_on_splines_lowers_what_the_views_show_beside_the_reference() -> None:
    problem, moved = _state(replace(packed(), shift=(0.6, -0.4)))
    views, grid = MotionViews.of(problem), problem.projector.grid
    basis, none = Basis.splines(grid, grid.voxel_size * N, 4), np.zeros(moved.u.shape[1:], np.float32)

    def left(state: Moved) -> float:
        return float(np.square(views.lines - views.projector.forward_lines(state.volume())).sum())

    once = improved(views, moved, basis, 0, none, False)
    assert left(once) < 0.2 * left(moved)
    inside = slice(N // 4, -N // 4)
    np.testing.assert_allclose(once.u[0, inside, inside].mean(), -0.6, atol=0.1)
    np.testing.assert_allclose(once.u[1, inside, inside].mean(), 0.4, atol=0.1)
