"""Difficult data: empty, constant, zero or saturated counts, values that are not finite, few projections."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.kernel import Truncation
from recon.base.method import DataUse, Reconstruction
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.prep.correct import correct
from recon.prep.references import References
from recon.reconstruction import reconstruct
from recon.splatting import optimise as fit
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import without_wild_pixels
from recon.splatting.r2 import R2
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project
from recon.voxels.fbp import fbp
from tests.messages import refused
from tests.recon.bodies import Bodies
from tests.recon.helpers import run_steps
from tests.slow_cases import others_slow

F32 = NDArray[np.float32]
SHAPE = (12, 48)
VIEWS = Geometry.parallel(np.linspace(0, math.pi, 32, endpoint=False), SHAPE)
GRID = Grid.matching(VIEWS)
SHORT = FitSettings(policy=None, tv_size=12)
_AT = np.array([(0.0, 0.0, 0.0), (-7.0, 5.0, 1.0), (8.0, -6.0, -1.0), (6.0, 8.0, 0.5), (-3.0, -10.0, 0.0)])
_RADII = np.array([19.0, 6.0, 4.0, 3.0, 2.0])
SPHERES = Bodies(_AT, np.eye(3) / _RADII[:, None, None], np.array([0.02, 0.03, 0.05, -0.02, 0.06]))
"""With sharp edges, which Gaussians cannot represent exactly; in units of a detector of 48 columns and 12 rows."""


@pytest.fixture(scope="module")
def clean() -> F32:
    return SPHERES.views(VIEWS)


@pytest.fixture(scope="module")
def truth() -> F32:
    return SPHERES.volume(GRID)


def fitted(
    data: F32,
    geometry: Geometry = VIEWS,
    steps: int = 100,
    seed: int = 0,
    weights: F32 | None = None,
    finish: int | None = None,
) -> Reconstruction:
    method = R2(steps=steps, gaussians=1200, fit=SHORT, finish=finish)
    found = reconstruct(data, geometry, method, seed=seed, use=DataUse(weights))
    assert np.isfinite(found.volume.data).all()
    assert found.gaussians is not None
    for name, values in found.gaussians.arrays().items():
        assert name == "kernel_exponent" or np.isfinite(values).all(), name  # that of a Gaussian is infinite
    return found


def a_few(seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians.from_physical(
        rng.uniform(-5, 5, (60, 3)), rng.uniform(1, 3, (60, 3)), rng.uniform(0.01, 0.05, 60), rng.normal(size=(60, 4))
    )


def test_projections_of_nothing_are_refused_by_name_and_empty_a_model_that_is_there() -> None:
    nothing = np.zeros((32, *SHAPE), np.float32)
    with refused(ValueError):
        reconstruct(nothing, VIEWS, R2(steps=1))
    assert not reconstruct(nothing, VIEWS, "fbp").volume.data.any()
    start = a_few()
    left = reconstruct(nothing, VIEWS, R2(steps=300, gaussians=start, fit=replace(SHORT, pace=10.0)))
    assert left.gaussians is not None and np.isfinite(left.volume.data).all()
    assert float(left.gaussians.densities.mean()) < 0.3 * float(start.densities.mean())


@pytest.mark.slow
def test_constant_projections_leave_all_finite_and_are_explained_where_they_can_be() -> None:
    # No body that fits into the field has them: its edge would have to be infinitely dense.
    found = fitted(np.ones((32, *SHAPE), np.float32), finish=0)
    assert found.history[-1].residual < 0.2
    assert np.isfinite(fbp(np.ones((32, *SHAPE), np.float32), VIEWS, GRID)).all()


@pytest.mark.slow
def test_counts_of_zero_and_saturated_ones_become_line_integrals_that_fit(clean: F32, truth: F32) -> None:
    rng = np.random.default_rng(1)
    good = rng.poisson(20_000 * np.exp(-clean)) + 100
    counts = good.copy()
    hit = rng.random(counts.shape)
    counts[hit < 0.01] = 0  # less than the dark: a transmission below zero
    counts[hit > 0.99] = 65_535
    counts[:, 5, 20] = 65_535  # one that is stuck
    references = References(np.full(SHAPE, 100, np.float32), ((0.0, np.full(SHAPE, 20_100, np.float32)),))
    given = correct(counts.astype(np.uint16), np.arange(32.0), references)
    assert np.isfinite(given.data).all()
    assert float(given.data.max()) <= -math.log(1e-4) + 1e-3  # the floor that the settings state
    # -log of 0 is inf; and with those of no weight the fit is nearly that of the same counts without them.
    weights = ((counts > 150) & (counts < 60_000)).astype(np.float32)
    best = correct(good.astype(np.uint16), np.arange(32.0), references)
    of_good, with_masks, without = (
        psnr(truth, found.volume.data)
        for found in (
            fitted(best.data, steps=60, finish=0),
            fitted(given.data, steps=60, weights=weights, finish=0),
            fitted(given.data, steps=60, finish=0),
        )
    )
    assert with_masks > of_good - 0.5
    assert with_masks > without


@pytest.fixture(scope="module")
def of_all_but_one(clean: F32) -> F32:
    """A fit of the projections without pixel [9, 4, 31]."""
    without = clean.copy()
    without[9, 4, 31] = np.nan
    with pytest.warns(UserWarning, match="1 of .* are not finite"):
        return fitted(without, steps=60, finish=0).volume.data


@pytest.mark.parametrize("value", others_slow([1e30, 300.0, -1e30, 3e3]))
def test_one_wild_pixel_changes_a_fit_little(clean: F32, truth: F32, of_all_but_one: F32, value: float) -> None:
    # It may have no part in where the first Gaussians are placed, nor in how dense they are.
    wild = clean.copy()
    wild[9, 4, 31] = value
    found, expected = fitted(wild, steps=60, finish=0).volume.data, of_all_but_one
    if abs(value) > 1e6:  # beyond what `make_problem` takes: as if it were not finite
        np.testing.assert_array_equal(found, expected)
    assert psnr(truth, found) > psnr(truth, expected) - 0.5


def test_views_with_only_wild_pixels_do_not_cause_filling_in_others(clean: F32) -> None:
    # Most views before the sample was there: what the few others show is not wild.
    late = np.concatenate((np.full((24, *SHAPE), 1e-5, np.float32), clean[24:]))
    np.testing.assert_array_equal(without_wild_pixels(late), late)
    closed = clean.copy()
    closed[5] = 1e4  # a view of nothing but nonsense, which has nothing to be filled from
    tame = without_wild_pixels(closed)
    np.testing.assert_array_equal(np.delete(tame, 5, 0), np.delete(clean, 5, 0))
    assert tame[5].max() <= 10 * clean.max()


def test_one_view_is_refused_by_name_but_no_step_breaks_on_it(clean: F32) -> None:
    one = VIEWS.select([3])
    with refused(ValueError):
        reconstruct(clean[3:4], one)
    problem = fit.problem_of(Views(clean[3:4], one), GRID, 0.05, SHORT)
    state = run_steps(fit.init(a_few(), 0), problem, SHORT, 200)
    assert all(np.isfinite(values).all() for values in state.parameters.values())
    assert float(state.residual) < 0.5


@pytest.mark.slow
def test_equal_angles_count_as_one_place(clean: F32, truth: F32) -> None:
    with pytest.raises(ValueError, match="got only one direction"):
        reconstruct(clean[[0, 0]], VIEWS.select([0, 0]))
    twice = np.r_[np.arange(32), 7, 7, 7]
    data, geometry = clean[twice], VIEWS.select(twice)
    np.testing.assert_allclose(fbp(data, geometry, GRID), fbp(clean, VIEWS, GRID), atol=1e-6)
    assert psnr(truth, fitted(data, geometry).volume.data) > 27


@pytest.mark.slow
@given(st.permutations(range(32)), st.lists(st.integers(-40, 40), min_size=32, max_size=32))
@settings(max_examples=10)
def test_order_and_whole_turns_of_the_angles_do_not_matter(order: list[int], turns: list[int]) -> None:
    data = SPHERES.views(VIEWS)
    angles = VIEWS.angles[order] + 2 * math.pi * np.array(turns)
    odd = Geometry.parallel(angles, SHAPE)
    np.testing.assert_allclose(fbp(data[order], odd, GRID), fbp(data, VIEWS, GRID), atol=1e-6)
    g = a_few()
    np.testing.assert_allclose(project(g, odd), project(g, VIEWS)[order], atol=2e-6)


@pytest.mark.parametrize("shape", [(1, 48), (12, 1), (1, 1), (2, 17), (1, 300)])
def test_detectors_of_one_row_or_one_column(shape: tuple[int, int]) -> None:
    views = Geometry.parallel(VIEWS.angles, shape, axis_col=(shape[1] - 1) / 2)
    data = SPHERES.views(views)
    problem = fit.problem_of(Views(data, views), Grid.matching(views), 0.05, SHORT)
    state = run_steps(fit.init(a_few(), 0), problem, SHORT, 60)
    assert all(np.isfinite(values).all() for values in state.parameters.values())
    if shape == (1, 48):
        grid = Grid.matching(views)
        assert psnr(SPHERES.volume(grid), fitted(data, views).volume.data) > 25


@pytest.mark.slow
def test_a_fit_smooths_voxels_of_any_edges(clean: F32) -> None:
    flat = Grid((3, 48, 48), 1.0, slice_pitch=4.0)
    problem = fit.problem_of(Views(clean, VIEWS), flat, 0.05, SHORT)
    state = fit.init(a_few(), 0)
    before = fit.misfit_of(state, problem, SHORT)
    run_steps(state, problem, SHORT, 100)
    assert all(np.isfinite(values).all() for values in state.parameters.values())
    assert fit.misfit_of(state, problem, SHORT) < 0.8 * before
    seen = fit.volume_of(state, flat, VIEWS, SHORT).data
    cubes = fit.volume_of(state, Grid((9, 48, 48)), VIEWS, SHORT).data
    np.testing.assert_allclose(seen[1], cubes[4], atol=1e-4 * float(cubes.max()))
    # What the loss counts is the variation of these flat voxels, here of all of them: the box is as large as the grid.
    whole = replace(SHORT, tv_size=48, truncation=Truncation(9.0, 1e-12), views_per_step=1)
    losses = []
    for weight in (0.0, 20.0):
        state = fit.init(a_few(), 0)
        volume = fit.volume_of(state, flat, VIEWS, whole).data / state.unit
        losses.append(fit.step(state, problem, replace(whole, tv_weight=weight), 0.0, view=3).loss)
    steps = np.concatenate([np.abs(np.diff(volume, axis=axis)).ravel() for axis in range(3)])
    assert losses[1] - losses[0] == pytest.approx(20.0 * steps.mean(), rel=1e-3)
    # And the fit follows it: more weight, less variation.
    varied = []
    for weight in (0.0, 20.0):
        state = run_steps(fit.init(a_few(), 0), problem, replace(SHORT, tv_size=48, tv_weight=weight), 60)
        varied.append(np.abs(np.diff(fit.volume_of(state, flat, VIEWS, SHORT).data, axis=2)).mean())
    assert varied[1] < 0.7 * varied[0]


@pytest.mark.slow
def test_photon_starved_views_give_a_volume_and_a_better_one_than_fbp(clean: F32, truth: F32) -> None:
    # With three photons a pixel, some count none at all: their line integral is -log(floor), and finite.
    rng, photons = np.random.default_rng(6), 3
    counts = rng.poisson(photons * np.exp(-clean)).astype(np.float32)
    assert (counts == 0).any()
    references = References(np.zeros(SHAPE, np.float32), ((0.0, np.full(SHAPE, photons, np.float32)),))
    data = correct(counts, np.arange(32.0), references).data
    direct = fbp(data, VIEWS, GRID, "hann")
    found = fitted(data)
    assert psnr(truth, found.volume.data) > psnr(truth, direct)
