"""Gaussians at difficult places and of difficult weight: borders, far outside, the source, nothing, piles, ranges."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numba
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from recon.base.kernel import RayModel
from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from recon.splatting.splat import project, voxelize
from tests.recon.hard_cases.measure import RECURRENCE, STEP, WHOLE, bound, compare, directional, gradient_bound
from tests.recon.helpers import as_leaves, gradients, in_double

SHAPE = (33, 47)  # neither a multiple of the 4 rows nor of the 16 columns that the kernels take at a time
VIEW = Geometry.parallel([0.0], SHAPE, pixel_pitch=1.0, axis_col=0.0, axis_row=0.0)  # x is the column, z the row
CONE = Geometry.cone([0.0], SHAPE, 1.0, 10.0, 20.0)
EXACT = RayModel(exact_above=0.0)


def at(places: list[tuple[float, float, float]], sigma: float = 1.1, density: float = 0.8) -> Gaussians:
    """Slightly different, slightly turned Gaussians at (x, y, z)."""
    n = len(places)
    rng = np.random.default_rng(5)
    shapes = sigma * rng.uniform(0.7, 1.4, (n, 3))
    return Gaussians.from_physical(places, shapes, np.full(n, density), rng.normal(size=(n, 4)))


@pytest.mark.parametrize("sigma", [0.05, 0.3, 1.1, 6.0])
@pytest.mark.parametrize("shift", [0.0, 0.02, -0.02, 0.5])
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


@pytest.mark.parametrize("far", [1e3, 1e5, 1e7, 1e30])
def test_far_outside_there_is_nothing_and_no_gradient(far: float) -> None:
    places = [(far, 0.0, 3.0), (-far, 0.0, 3.0), (3.0, 0.0, far), (3.0, far, 3.0) if far < 1e30 else (far, 0, 0)]
    for where in (VIEW, Grid((5, 6, 7))):
        g = as_leaves(at(places[:3] if isinstance(where, Geometry) else places))
        image = voxelize(g, where) if isinstance(where, Grid) else project(g, where)
        assert not image.any()
        image.sum().backward()
        assert all(not slope.any() for slope in gradients(g).values())


@pytest.mark.parametrize("far", [1e3, 1e5, 1e7])
def test_far_outside_and_large_enough_to_be_seen(far: float) -> None:
    # The offset is taken in float32: half a step of it is far * 6e-8, over a width of half of far.
    found = compare(at([(far, 0.0, 3.0), (3.0, 0.0, -far), (-far, far, far)], far / 2), VIEW)
    assert found.value < bound(far, 0.3 * far)
    assert found.worst < gradient_bound(far, 0.3 * far), found.gradients


@pytest.mark.slow
@pytest.mark.parametrize("model", [None, EXACT], ids=["affine", "exact"])
def test_near_the_source_of_a_cone_a_gaussian_is_large_and_right(model: RayModel | None) -> None:
    # The source is at y = -10: from a tenth of the distance on, magnified up to twenty times.
    g = at([(0.05, -9.0, 0.02), (-0.2, -8.0, 0.1), (0.3, -6.0, -0.2), (1.0, 0.0, 2.0)], 0.05)
    found = compare(g, CONE, model=model)
    assert found.value < bound(60.0, 0.6)
    assert found.worst < gradient_bound(60.0, 0.6), found.gradients


def test_the_reference_gradients_near_the_source_are_its_differences() -> None:
    g = at([(0.05, -9.0, 0.02), (-0.2, -8.0, 0.1), (0.3, -6.0, -0.2)], 0.05)
    steps = {"means": 0.01, "log_scales": 0.1, "quaternions": 0.1, "raw_densities": 0.1}
    slope, difference = directional(g, CONE, steps)
    assert slope == pytest.approx(difference, rel=1e-4)


@pytest.mark.parametrize("model", [None, EXACT], ids=["affine", "exact"])
def test_at_the_source_and_behind_it_there_is_nothing(model: RayModel | None) -> None:
    # Naive: 1 / 0, and behind the source a picture upside down.
    hidden = [(0.0, -10.0, 0.0), (0.0, -9.999, 0.0), (0.3, -10.0, 0.1), (0.0, -15.0, 0.0), (1.0, -1e6, 0.0)]
    seen = [(1.0, 0.0, 2.0), (-3.0, 4.0, 1.0)]
    g, rest = as_leaves(at(seen + hidden, 0.5)), at(seen + hidden, 0.5).select(torch.arange(2))
    image = project(g, CONE, model=model)
    np.testing.assert_array_equal(image.detach(), project(rest, CONE, model=model))
    image.sum().backward()
    for slope in gradients(g).values():
        assert torch.isfinite(slope).all() and slope[:2].any() and not slope[2:].any()


@settings(max_examples=40)
@given(
    depth=st.floats(-3, 3).map(lambda x: -10 + 10**x),
    aside=st.floats(-3, 3),
    sigma=st.floats(-3, 2).map(lambda x: 10**x),
    exact=st.booleans(),
)
def test_anywhere_before_a_source_all_is_finite(depth: float, aside: float, sigma: float, exact: bool) -> None:
    g = as_leaves(at([(aside, depth, 0.3), (0.0, 0.0, 0.0)], sigma))
    image = project(g, CONE, model=EXACT if exact else None)
    assert torch.isfinite(image).all() and float(image.detach().min()) >= 0
    assert float(image.detach().max()) <= 2 * 1.001 * 0.8 * math.sqrt(2 * math.pi) * 1.4 * sigma
    image.sum().backward()
    assert all(torch.isfinite(slope).all() for slope in gradients(g).values())


@pytest.mark.parametrize("raw", [-80.0, -104.0, -1e4, -3e38])
def test_a_density_of_zero_or_too_small_for_float32_is_nothing(raw: float) -> None:
    # softplus: -80 gives 2e-35; -104 a denormal, and log(1 + e^raw) as it stands gives 0 from -17 on.
    g = at([(20.0, 0.0, 10.0), (22.0, 0.0, 12.0)])
    densities = torch.tensor([raw, 0.5])
    faint = as_leaves(Gaussians(g.means, g.log_scales, g.quaternions, densities, 0.7))
    alone = Gaussians(*(p[1:] for p in (g.means, g.log_scales, g.quaternions, densities)), 0.7)
    for where, picture in ((VIEW, project), (Grid((20, 20, 20), centre=(11.0, 0.0, 21.0)), voxelize)):
        image = picture(faint, where)
        np.testing.assert_array_equal(image.detach(), picture(alone, where))
        image.sum().backward()
    assert all(torch.isfinite(slope).all() for slope in gradients(faint).values())
    assert abs(float(gradients(faint)["raw_densities"][0])) < 1e-30


@pytest.mark.parametrize("unit", [1e-44, 1e-38, 1e-30, 1e30])
def test_units_of_density_at_the_ends_of_float32(unit: float) -> None:
    # Data in 1/m of a gas, say: what is representable comes out, what is denormal is zero or right, nothing is NaN.
    g = at([(20.0, 0.0, 10.0), (22.0, 0.0, 12.0)])
    odd = as_leaves(Gaussians(g.means, g.log_scales, g.quaternions, torch.zeros(2), unit))
    image = project(odd, VIEW)
    expected = project(in_double(odd), VIEW).detach()
    assert torch.isfinite(image).all()
    assert float((image.detach() - expected).abs().max()) <= 3e-3 * float(expected.max()) + 1e-37
    (image / unit if unit > 1e-37 else image).sum().backward()
    assert all(torch.isfinite(slope).all() for slope in gradients(odd).values())


@pytest.mark.parametrize("what", ["densities", "scales"])
def test_a_dynamic_range_of_1e8_leaves_each_pixel_its_digits(what: str) -> None:
    # The error of a pixel is relative to what is in that pixel, not to the brightest one.
    rng = np.random.default_rng(3)
    n = 60
    size = 10 ** np.linspace(-4, 4, n)
    scales = rng.uniform(0.8, 1.6, (n, 3)) * (size[:, None] if what == "scales" else 1)
    densities = size if what == "densities" else np.ones(n)
    places = np.stack((rng.uniform(0, 46, n), rng.normal(size=n), rng.uniform(0, 32, n)), 1)
    g = Gaussians.from_physical(places, scales, densities, rng.normal(size=(n, 4)), density_unit=1.0)
    found, expected = project(g, VIEW, truncation=WHOLE).double(), project(in_double(g), VIEW).detach()
    assert torch.isfinite(found).all()
    # All of a pixel's footprints: the recurrence's error of each weight within its reach, and the sum's rounding.
    weights = g.densities.double() * g.scales.double().amax(1) * math.sqrt(2 * math.pi)
    reach = torch.zeros(SHAPE, dtype=torch.float64)
    rows, cols = torch.meshgrid(*(torch.arange(k, dtype=torch.float64) for k in SHAPE), indexing="ij")
    for place, scale, weight in zip(g.means.double(), g.scales.double(), weights, strict=True):
        near = (cols - place[0]) ** 2 + (rows - place[2]) ** 2 <= (9.01 * scale.max()) ** 2
        reach += near * weight * bound(50.0, max(float(scale.min()), 0.8 if what == "densities" else 0.05))
    assert ((found[0] - expected[0]).abs() <= reach + 1e-30).all()
    leaves = as_leaves(g)
    project(leaves, VIEW).sum().backward()
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


@settings(max_examples=60)
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
