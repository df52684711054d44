"""Slabs: they cover the volume, and their rows see the same part of it as whole projections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import recon
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import Method, RunControl
from recon.base.slabs import part_of, slabs_of
from recon.base.volume import Grid
from recon.voxels.projector import Projector, seen_rays
from tests.slow_cases import others_slow


@given(st.integers(1, 200), st.integers(1, 50), st.integers(0, 24))
def test_shares_of_all_slabs_add_up_to_one(slices: int, height: int, halo: int) -> None:
    total = np.zeros(slices)
    for slab in slabs_of(slices, height, halo):
        assert slab.own.start - slab.slices.start <= halo and slab.share.size == slab.slices.stop - slab.slices.start
        total[slab.slices] += slab.share
    np.testing.assert_allclose(total, 1, atol=1e-6)


@pytest.mark.parametrize("shift", [0.0, 1.3])
@pytest.mark.parametrize("axis_row", [None, 11.25])
def test_rows_of_a_slab_see_what_whole_views_see(
    rng: np.random.Generator, shift: float, axis_row: float | None
) -> None:
    shifts = np.zeros((6, 2))
    shifts[::2, 1] = shift
    angles = np.arange(6) / 2
    geometry = Geometry.parallel(angles, (24, 20), pixel_pitch=0.3, axis_row=axis_row, shifts=shifts)
    grid = Grid.matching(geometry)
    volume = rng.random(grid.shape, np.float32)
    whole = Projector(geometry, grid).forward(volume)
    for slices in (slice(0, 9), slice(7, 15), slice(20, grid.shape[0])):
        rows, views, box = part_of(geometry, grid, slices)
        part = Projector(views, box).forward(np.ascontiguousarray(volume[slices]))
        inside = seen_rays(views, box)[..., 0]  # rays between the outer slices of the slab
        assert inside.sum() >= 6 * (box.shape[0] - 2)
        np.testing.assert_allclose(part[inside], whole[:, rows][inside], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "method",
    others_slow(
        [
            recon.FistaTv(iterations=10),
            recon.Sirt(iterations=3),
            recon.Sart(iterations=2),
            recon.Cgls(iterations=4),
            recon.AsdPocs(iterations=3),
            recon.OsSirtTv(iterations=12),
            recon.OsSirtTv(iterations=8, tv_weight=0.01),
            recon.FistaTv(iterations=6, tv_weight=2e-3),
        ],
        3,
    ),
    ids=lambda method: method.name,
)
def test_slabs_that_follow_fit_together(method: Method, rng: np.random.Generator) -> None:
    """Seams below 1e-3 of the peak; the volume in slabs is that of all rows."""
    geometry = Geometry.parallel(np.arange(36) * np.pi / 36, (60, 40))
    grid = Grid.matching(geometry)
    z, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    truth = 0.5 * (np.hypot(x, y) < 17) + 0.5 * ((x - 4) ** 2 + y**2 + (z / 2) ** 2 < 64) - 0.3 * (np.abs(z - x) < 1.5)
    views = Projector(geometry, grid).forward(truth.astype(np.float32))
    views += rng.normal(0, 0.02 * views.max(), views.shape).astype(np.float32)
    decide = Decisions(3)
    whole = recon.reconstruct(views, geometry, method, control=RunControl(decide=decide)).volume.data
    found = np.zeros_like(whole)
    for slab in slabs_of(60, 24, method.halo):
        rows, part, box = part_of(geometry, grid, slab.slices)
        control = RunControl(decide=Decisions(3, decide.made))
        volume = recon.reconstruct(views[:, rows], part, method, grid=box, control=control).volume.data
        found[slab.slices] += slab.share[:, None, None] * volume
    assert np.abs(found - whole).max() < (1e-3 if method.halo else 1e-6) * whole.max()


@pytest.mark.slow
def test_fits_of_slabs_fit_together_within_the_noise() -> None:
    """Slabs differ from a fit of all rows by less than fits of two scans do by their noise, also at their edge."""
    geometry = Geometry.parallel(np.arange(40) * np.pi / 40, (48, 40))
    grid = Grid.matching(geometry)
    z, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    truth = 0.5 * (np.hypot(x, y) < 17) + 0.5 * ((x - 4) ** 2 + y**2 + (z / 2) ** 2 < 64) - 0.3 * (np.abs(z - x) < 1.5)
    clean = Projector(geometry, grid).forward(truth.astype(np.float32))
    one, other = (
        clean + np.random.default_rng(seed).normal(0, 0.02 * clean.max(), clean.shape).astype(np.float32)
        for seed in range(2)
    )
    method = recon.R2(steps=80, gaussians=2000)
    whole, again = (recon.reconstruct(p, geometry, method).volume.data for p in (one, other))
    scatter, found, decide = rms(whole - again), np.zeros_like(whole), Decisions()
    for slab in slabs_of(48, 24, recon.R2.halo):
        rows, part, box = part_of(geometry, grid, slab.slices)
        decide = Decisions(0, decide.made)
        method = replace(method, gaussians=round(2000 * box.shape[0] / 48))
        fit = recon.reconstruct(one[:, rows], part, method, grid=box, control=RunControl(decide=decide))
        found[slab.slices] += slab.share[:, None, None] * fit.volume.data
    left = found - whole
    assert rms(left) < scatter and rms(left[22:26]) < scatter
    steps = np.array([rms(step) for step in np.diff(left, axis=0)])
    assert steps[23] < scatter and steps[23] < 1.1 * np.delete(steps, 23).max()  # the edge is as any other slice
    assert rms(found - truth) < 1.02 * rms(whole - truth)


def rms(values: NDArray[np.floating]) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
