"""Gaussians at difficult positions or with difficult weights: borders, far outside, at the source, piles, ranges.

On the CPU's kernels, and in slow tests on Triton's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from recon.base.kernel import RayModel
from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from tests.recon.hard_cases.measure import RECURRENCE, STEP, WHOLE, bound, compare, gradient_bound
from tests.recon.hard_cases.on import EXACT, On, at, cpu
from tests.recon.helpers import as_leaves, gradients, in_double
from tests.recon.kernels.reference import on_grid as voxelize
from tests.recon.kernels.reference import project

CPU = cpu()
VIEW, SHAPE = CPU.view, CPU.view.detector_shape
MODELS = pytest.mark.parametrize("model", [None, EXACT], ids=["affine", "exact"])


@pytest.mark.parametrize(("sigma", "shift"), [(0.05, 0.02), (0.3, -0.02), (1.1, 0.0), (1.1, 0.5), (6.0, 0.0)])
def test_on_the_borders_of_images_lanes_and_groups_of_rows(sigma: float, shift: float) -> None:
    cols = (-1.0, -0.5, 0.0, 15.0, 15.5, 16.0, 30.5, 31.0, 46.0, 46.5, 47.0)
    rows = (-1.0, 0.0, 3.0, 3.5, 4.0, 16.0, 19.5, 31.5, 32.0, 33.0)
    g = at([(u + shift, 0.0, v - shift) for u in cols for v in rows], sigma)
    found = compare(g, VIEW)
    assert found.value < bound(60.0, 0.7 * sigma)
    assert found.worst < gradient_bound(60.0, 0.7 * sigma), found.gradients


@pytest.mark.parametrize("sigma", [0.05, 0.3, 1.1])
def test_on_the_borders_of_voxels_and_slabs(sigma: float) -> None:
    edges = (-0.5, 0.0, 3.0, 3.5, 4.0, 8.0, 8.5)
    grid = Grid((9, 9, 17), 1.0, centre=(4.0, 4.0, 8.0))
    found = compare(at([(2 * x, y, z) for x in edges for y in edges for z in edges], sigma), grid)
    assert found.value < bound(17.0, 0.7 * sigma)
    assert found.worst < gradient_bound(17.0, 0.7 * sigma), found.gradients


@pytest.mark.parametrize("far", [1e5, 1e30])
def test_far_outside_there_is_nothing_and_no_gradient(on: On, far: float) -> None:
    places = [(far, 0.0, 3.0), (-far, 0.0, 3.0), (3.0, 0.0, far), (far, far, far)]
    for where in (on.beams["parallel"], on.grid):
        g = on.leaves(at(places))
        image = on.shown(g, where)
        assert not image.any()
        image.sum().backward()
        assert all(not slope.any() for slope in gradients(g).values())


@pytest.mark.parametrize("far", [1e5, 1e7])
def test_far_outside_and_large_enough_to_be_seen(on: On, far: float) -> None:
    # The offset is taken in float32: half a step of it is far * 6e-8, over a width of half of far.
    found = on.compare(at([(far, 0.0, 3.0), (3.0, 0.0, -far), (-far, far, far)], far / 2), on.view)
    assert found.value < bound(far, 0.3 * far)
    assert found.worst < gradient_bound(far, 0.3 * far), found.gradients


@pytest.mark.slow
@MODELS
def test_near_the_source_of_a_cone_a_gaussian_is_large_and_right(on: On, model: RayModel | None) -> None:
    # From a tenth of the distance on, magnified up to twenty times.
    g = at([(0.05, -9.0, 0.02), (-0.2, -8.0, 0.1), (0.3, -6.0, -0.2), (1.0, 0.0, 2.0)], 0.05)
    found = on.compare(g, on.source, model)
    far = 60.0 if on.device is None else on.far
    assert found.value < bound(far, 0.6)
    assert found.worst < gradient_bound(far, 0.6), found.gradients


@MODELS
def test_at_the_source_and_behind_it_there_is_nothing(on: On, model: RayModel | None) -> None:
    # Naive: 1 / 0, and behind the source a picture upside down.
    hidden = [(0.0, -10.0, 0.0), (0.0, -9.999, 0.0), (0.3, -10.0, 0.1), (0.0, -15.0, 0.0), (1.0, -1e6, 0.0)]
    both = at([(1.0, 0.0, 2.0), (-3.0, 4.0, 1.0), *hidden], 0.5)
    g, rest = on.leaves(both), on.leaves(both.select(torch.arange(2)))
    image, expected = (on.shown(each, on.source, model) for each in (g, rest))
    np.testing.assert_array_equal(image.detach().cpu(), expected.detach().cpu())
    image.sum().backward()
    for slope in gradients(g).values():
        assert torch.isfinite(slope).all() and slope[:2].any() and not slope[2:].any()


@MODELS
def test_anywhere_before_a_source_all_is_finite(on: On, model: RayModel | None) -> None:
    rng, n = np.random.default_rng(8), on.many
    places = np.stack((rng.uniform(-3, 3, n), -10 + 10 ** rng.uniform(-3, 3, n), np.full(n, 0.3)), 1)
    sigma = 10 ** rng.uniform(-3, 2, n)
    g = on.leaves(Gaussians.from_physical(places, sigma[:, None] * rng.uniform(0.7, 1.4, (n, 3)), np.full(n, 0.8)))
    image = on.shown(g, on.source, model)
    assert torch.isfinite(image).all() and float(image.detach().min()) >= 0
    assert float(image.detach().max()) <= 1.001 * 0.8 * math.sqrt(2 * math.pi) * 1.4 * sigma.sum()
    image.sum().backward()
    assert all(torch.isfinite(slope).all() for slope in gradients(g).values())


def test_a_density_of_zero_or_too_small_for_float32_is_nothing(on: On) -> None:
    # softplus: -80 gives 2e-35; -104 a denormal, and log(1 + e^raw) as it stands gives 0 from -17 on.
    g = on.some((1.0, 0.7, 1.3), 5)
    faint = replace(g, raw_densities=torch.tensor([-80.0, -104.0, -1e4, -3e38, 0.5]))
    leaves, alone = on.leaves(faint), on.leaves(faint.select(torch.tensor([4])))
    for where in (on.beams["parallel"], on.grid):
        image, expected = (on.shown(each, where) for each in (leaves, alone))
        np.testing.assert_array_equal(image.detach().cpu(), expected.detach().cpu())
        image.sum().backward()
    slopes = gradients(leaves)
    assert all(torch.isfinite(slope).all() for slope in slopes.values())
    assert float(slopes["raw_densities"][:4].abs().max()) < 1e-30


@pytest.mark.parametrize("unit", [1e-44, 1e-38, 1e-30, 1e30])
def test_units_of_density_at_the_ends_of_float32(on: On, unit: float) -> None:
    # Data in 1/m of a gas, say: what is representable comes out, what is denormal is zero or right, nothing is NaN.
    odd = replace(on.some((1.0, 0.7, 1.3), 2), raw_densities=torch.zeros(2), density_unit=unit)
    leaves = on.leaves(odd)
    image = on.shown(leaves, on.beams["parallel"])
    expected = project(in_double(odd), on.beams["parallel"]).detach()
    assert torch.isfinite(image).all()
    assert float((image.detach().cpu() - expected).abs().max()) <= 3e-3 * float(expected.max()) + 1e-37
    (image / unit if unit > 1e-37 else image).sum().backward()
    assert all(torch.isfinite(slope).all() for slope in gradients(leaves).values())


@pytest.mark.parametrize("wide", [True, False], ids=["scales", "densities"])
def test_a_dynamic_range_of_1e8_leaves_each_pixel_its_digits(on: On, wide: bool) -> None:
    """Densities, or widths along the beam, fall by 1e8 along the columns: errors are relative to what is in a pixel."""
    n, apart = 9, 8
    size = 10 ** np.linspace(4, -4, n)
    view = Geometry.parallel([0.0], (5, apart * n), pixel_pitch=1.0, axis_col=0.0, axis_row=0.0)
    places = np.stack((apart * np.arange(n) + 3.3, np.zeros(n), np.full(n, 2.2)), 1)
    scales = np.full((n, 3), 0.6)
    if wide:
        scales[:, 1] *= size  # along the beam: the picture's place and size are as before
    g = Gaussians.from_physical(places, scales, np.ones(n) if wide else size, density_unit=1.0)
    leaves = on.leaves(g)
    found, expected = on.shown(leaves, view, whole=True), project(in_double(g), view).detach()[0]
    for k in range(n):
        part = slice(apart * k, apart * k + apart)
        off = (found[0, :, part].detach().cpu() - expected[:, part]).abs().max() / expected[:, part].max()
        assert float(off) < bound(apart * n, 0.6), k
    found.sum().backward()
    assert all(torch.isfinite(slope).all() for slope in gradients(leaves).values())


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Each thread adds up its own sums of 512: two of them add half as many one after another as one does."""
    before = numba.get_num_threads()
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
    yield
    numba.set_num_threads(before)


@pytest.mark.parametrize("n", [1000, 100_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
@pytest.mark.usefixtures("two_threads")
def test_a_pile_at_one_pixel_does_not_drift(n: int) -> None:
    # The worst kind: all alike, so that every rounding goes the same way. One by one a million lose half a percent.
    g = Gaussians.from_physical(np.tile([20.0, 0.0, 10.0], (n, 1)), np.full(n, 1.0), np.full(n, 0.7))
    one = project(in_double(g.select(torch.arange(1))), VIEW).detach()[0]
    leaves = as_leaves(g)
    image = project(leaves, VIEW, truncation=WHOLE)[0]
    off = (image.detach().double() / (n * one) - 1).abs()
    # Half a step for each of the 512 of one sum, and the footprint's own error.
    most = 512 * STEP / 2 + 0.5 * RECURRENCE
    assert float(off[one > 0.05 * one.max()].max()) < most
    one_by_one = np.cumsum(np.full(n, float(one.max()), np.float32), dtype=np.float32)[-1]
    if n >= 100_000:
        assert abs(float(one_by_one) / (n * float(one.max())) - 1) > 4 * most
    image.sum().backward()
    slopes = gradients(leaves)
    assert all(torch.isfinite(slope).all() for slope in slopes.values())
    assert float(slopes["raw_densities"].std()) == 0  # each gathers its own: a pile's size does not enter


def test_nothing_at_all_is_zeros() -> None:
    none = Gaussians(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0))
    assert not project(none, VIEW).any() and project(none, VIEW).shape == (1, *SHAPE)
    assert not voxelize(none, Grid((2, 3, 4))).any()


places = st.tuples(st.floats(-60, 110), st.floats(-50, 50), st.floats(-60, 90))


@given(
    spots=st.lists(st.tuples(places, st.floats(-2, 1.5), st.floats(-6, 6)), min_size=1, max_size=6),
    seed=st.integers(0, 100),
)
def test_any_places_sizes_and_weights_are_within_their_bounds(
    spots: list[tuple[tuple[float, float, float], float, float]], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    sizes = 10 ** np.array([size for _, size, _ in spots])
    g = Gaussians.from_physical(
        [place for place, _, _ in spots],
        sizes[:, None] * rng.uniform(0.5, 1, (len(spots), 3)),
        10 ** np.array([weight for *_, weight in spots]),
        rng.normal(size=(len(spots), 4)),
        density_unit=1.0,
    )
    found = compare(g, VIEW)
    assert found.value < len(spots) * (bound(120.0, 0.5 * float(sizes.min())) + RECURRENCE)
