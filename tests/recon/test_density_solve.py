"""Densities by least squares, against explicit matrices from the float64 twin and scipy's solvers on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.sparse.linalg import lsqr

from recon.density_solve import LEAST, DensityOperator, Method, solve_densities
from recon.gaussians import Gaussians
from recon.geometry import Geometry
from recon.initialise import scale_to_data
from recon.splat import RayModel, Truncation, project
from tests.recon.conftest import Make
from tests.recon.helpers import in_double

# No cut-off worth the name, so that kernel and twin sum the same terms.
WHOLE = Truncation(sigmas=9.0, faint=1e-12)
SHAPE = (18, 22)
ANGLES = (0.0, 0.7, 1.6, 2.5, -4.0)
PARALLEL = Geometry.parallel(ANGLES, SHAPE, 0.6, 10.1)
LEANING = Geometry.parallel(ANGLES, SHAPE, 0.6, 10.1, tilt=-0.3, roll=(0.2, -0.1, 0.0, 0.05, 0.1))
CONE = Geometry.cone(ANGLES, SHAPE, 0.9, 25.0, 40.0, 10.1, tilt=0.1)
PATHS = {
    "parallel": (PARALLEL, RayModel()),
    "leaning": (LEANING, RayModel()),
    "cone": (CONE, RayModel()),
    "cone, some exact": (CONE, RayModel(exact_above=0.035)),
    "cone, all exact": (CONE, RayModel(exact_above=0.0)),
    "parallel, plain": (PARALLEL, RayModel(rectified=False)),
}
F64 = NDArray[np.float64]


def matrix(gaussians: Gaussians, geometry: Geometry, model: RayModel | None = None) -> F64:
    """A as [pixels, n], each column the twin's picture of one Gaussian of the density unit."""
    ones = replace(gaussians, raw_densities=torch.full((gaussians.n,), float(np.log(np.e - 1)), dtype=torch.float64))
    columns = []
    for i in range(gaussians.n):
        one = in_double(ones.select(torch.tensor([i])))
        columns.append(project(one, geometry, model=model).detach().numpy().ravel())
    return np.stack(columns, 1)


def shares(gaussians: Gaussians) -> F64:
    """Densities in density units."""
    return gaussians.densities.double().numpy() / gaussians.density_unit


def with_shares(gaussians: Gaussians, values: F64) -> Gaussians:
    return Gaussians.from_physical(
        gaussians.means.numpy(), gaussians.scales.numpy(), values * gaussians.density_unit,
        gaussians.quaternions.numpy(), gaussians.density_unit,
    )  # fmt: skip


def noisy(clean: F64, share: float, rng: np.random.Generator) -> NDArray[np.float32]:
    white = rng.normal(size=clean.shape)
    return (clean + share * clean.max() * white).reshape(len(ANGLES), *SHAPE).astype(np.float32)


def slack(a: F64) -> float:
    """How far densities near one may be off: by the kernels' 1e-5 (see the first test) times the condition number."""
    return 1e-5 * float(np.linalg.cond(a))


def minimum(a: F64, data: NDArray[np.float32], root: F64) -> tuple[F64, float, float]:
    """Densities >= 0 of least |root (A x - data)|, that norm, and how far an x with 1e-6 more of it may be off.

    At the minimum x*, |A (x - x*)|² <= |A x - p|² - |A x* - p|² for every x >= 0.
    """
    weighed = root[:, None] * a
    x, norm = nnls(weighed, root * data.ravel().astype(np.float64))
    return x, float(norm), float(np.sqrt(2e-6) * norm / np.linalg.svd(weighed, compute_uv=False)[-1])


def overlapping(make: Make) -> Gaussians:
    """20 Gaussians a few standard deviations across a cube of some ten: all overlap in every view."""
    return make(20, 6.0, 0.7, 1.6)


@pytest.mark.parametrize("path", PATHS)
def test_both_ways_are_the_twins_matrix_and_each_others_transpose(
    path: str, random_gaussians: Make, rng: np.random.Generator
) -> None:
    views, model = PATHS[path]
    g = random_gaussians(extent=9.0)
    a, exact = DensityOperator(g, views, rays=model, truncation=WHOLE), matrix(g, views, model)
    x, y = rng.normal(size=g.n), rng.normal(size=(len(ANGLES), *SHAPE)).astype(np.float32)
    image, back = a.forward(x), a.adjoint(y)
    # Terms of both signs cancel, so errors are those of the sum of sizes; the kernel's recurrence costs 2e-5 of each.
    assert np.abs(image.ravel() - exact @ x).max() < 1e-5 * (exact @ np.abs(x)).max()
    assert np.abs(back - exact.T @ y.ravel()).max() < 1e-5 * (exact.T @ np.abs(y.ravel())).max()
    left, right = float(np.vdot(image.astype(np.float64), y)), float(x @ back)
    assert abs(left - right) < 1e-6 * float(np.abs(image).ravel() @ np.abs(y).ravel())


@pytest.mark.parametrize("path", ["parallel", "cone, some exact"])
def test_the_default_truncation_keeps_it_linear_and_near_what_a_fit_draws(
    path: str, random_gaussians: Make, rng: np.random.Generator
) -> None:
    views, model = PATHS[path]
    g = random_gaussians()
    a, drawn = DensityOperator(g, views, rays=model), project(g, views, model=model).numpy()
    np.testing.assert_allclose(a.forward(shares(g)), drawn, atol=1e-4 * drawn.max())
    x = rng.normal(size=g.n)
    one, two = a.forward(x), a.forward(-1e-6 * x)
    np.testing.assert_allclose(two, -1e-6 * one, atol=1e-6 * float(np.abs(two).max()))
    y = rng.normal(size=one.shape).astype(np.float32)
    left, right = float(np.vdot(one.astype(np.float64), y)), float(x @ a.adjoint(y))
    assert abs(left - right) < 1e-6 * float(np.abs(one).ravel() @ np.abs(y).ravel())


@pytest.mark.parametrize("path", PATHS)
def test_one_gaussian_takes_one_step_to_the_least_squares_factor(path: str, random_gaussians: Make) -> None:
    views, model = PATHS[path]
    g = random_gaussians(1, 2.0, 1.0, 1.5)
    data = 3.7 * project(g, views, model=model).numpy()
    found = solve_densities(g, data, views, iterations=1, rays=model)
    np.testing.assert_allclose(found.densities, scale_to_data(g, data, views, rays=model).densities, rtol=1e-4)


@pytest.mark.parametrize("method", ["fista", "cgls"])
@pytest.mark.parametrize("path", ["parallel", "cone", "cone, all exact"])
def test_gaussians_apart_get_their_densities_at_once(method: Method, path: str, rng: np.random.Generator) -> None:
    views, model = PATHS[path]
    means = np.array([[0, 0, -4.0], [0, 0, -1.5], [0, 0, 1.5], [0, 0, 4.0]])  # no two share a row of pixels
    truth = Gaussians.from_physical(means, rng.uniform(0.2, 0.3, (4, 3)), rng.uniform(0.1, 1, 4), density_unit=0.7)
    data = project(truth, views, model=model, truncation=WHOLE).numpy()
    start = with_shares(truth, np.full(4, 0.5))
    found = solve_densities(start, data, views, method=method, iterations=3, rays=model, truncation=WHOLE)
    np.testing.assert_allclose(found.densities, truth.densities, rtol=1e-4)


@pytest.mark.parametrize("method", ["fista", "cgls"])
@pytest.mark.parametrize("path", ["parallel", "leaning", "cone"])
def test_gaussians_that_overlap_get_their_densities(method: Method, path: str, random_gaussians: Make) -> None:
    views, _ = PATHS[path]
    truth = overlapping(random_gaussians)
    data = project(truth, views, truncation=WHOLE).numpy()
    start = with_shares(truth, np.full(truth.n, 0.4))
    steps = {"fista": 400, "cgls": 40}[method]
    found = solve_densities(start, data, views, method=method, iterations=steps, truncation=WHOLE)
    np.testing.assert_allclose(shares(found), shares(truth), atol=slack(matrix(truth, views)))


@pytest.mark.parametrize("path", ["parallel", "cone"])
def test_fista_reaches_the_constrained_minimum(path: str, random_gaussians: Make, rng: np.random.Generator) -> None:
    views, _ = PATHS[path]
    g = overlapping(random_gaussians)
    a = matrix(g, views)
    data = noisy(a @ (shares(g) * (rng.random(g.n) < 0.5)), 0.1, rng)
    expected, norm, off = minimum(a, data, np.ones(data.size))
    assert 2 <= (expected == 0).sum() <= 18  # the constraint acts, and not on all
    curve: list[float] = []
    found = solve_densities(
        g, data, views, iterations=400, truncation=WHOLE, on_iteration=lambda _, r: curve.append(r)
    )  # fmt: skip
    assert np.linalg.norm(a @ shares(found) - data.ravel()) < norm * (1 + 1e-6)
    np.testing.assert_allclose(shares(found), expected, atol=off)
    assert curve[-1] == pytest.approx(norm / np.linalg.norm(data.astype(np.float64)), rel=1e-5)
    assert shares(found).min() == pytest.approx(LEAST, rel=1e-3)
    assert len(curve) < 400  # where rounding leaves nothing to gain it says so by ending


@pytest.mark.parametrize("weighed", [False, True])
def test_fista_takes_the_steps_of_its_formula(weighed: bool, random_gaussians: Make, rng: np.random.Generator) -> None:
    g = overlapping(random_gaussians)
    a = matrix(g, PARALLEL)
    data = noisy(a @ shares(g) * 1.3, 0.05, rng)
    weights = rng.uniform(0.2, 3, data.shape).astype(np.float32) if weighed else None
    w = np.ones(data.size) if weights is None else weights.ravel().astype(np.float64)
    step = 1 / (a.T @ (w * (a @ np.ones(g.n))))
    x = ahead = shares(g)
    t = 1.0
    for _ in range(4):
        new = np.maximum(ahead + step * (a.T @ (w * (data.ravel() - a @ ahead))), 0)
        after = (1 + np.sqrt(1 + 4 * t * t)) / 2
        x, ahead, t = new, new + (t - 1) / after * (new - x), after
    found = solve_densities(g, data, PARALLEL, iterations=4, weights=weights, truncation=WHOLE)
    np.testing.assert_allclose(shares(found), np.maximum(x, LEAST), atol=2e-5)


@pytest.mark.parametrize("weighed", [False, True])
@pytest.mark.parametrize("steps", [1, 3, 6])
def test_cgls_is_lsqr(steps: int, weighed: bool, random_gaussians: Make, rng: np.random.Generator) -> None:
    """Both minimise the residual over the same Krylov space, of the columns as 1 / √D weighs them."""
    g = overlapping(random_gaussians)
    a = matrix(g, CONE)
    data = noisy(a @ shares(g) * 1.3, 0.05, rng)
    weights = rng.uniform(0.2, 3, data.shape).astype(np.float32) if weighed else None
    root = np.ones(data.size) if weights is None else np.sqrt(weights.ravel().astype(np.float64))
    weighed_a = root[:, None] * a
    half = 1 / np.sqrt(weighed_a.T @ (weighed_a @ np.ones(g.n)))
    left = root * (data.ravel() - a @ shares(g))
    change = half * lsqr(weighed_a * half, left, atol=0, btol=0, conlim=0, iter_lim=steps)[0]
    curve: list[float] = []
    found = solve_densities(
        g, data, CONE, method="cgls", iterations=steps, weights=weights, truncation=WHOLE,
        on_iteration=lambda _, r: curve.append(r),
    )  # fmt: skip
    expected = shares(g) + change
    np.testing.assert_allclose(shares(found), np.maximum(expected, LEAST), atol=slack(weighed_a * half))
    misfit = np.linalg.norm(root * (a @ expected - data.ravel())) / np.linalg.norm(root * data.ravel())
    assert curve[-1] == pytest.approx(misfit, rel=1e-4)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    n=st.integers(1, 30),
    noise=st.sampled_from([0.0, 0.05, 2.0]),
    scale=st.sampled_from([1e-3, 1.0, 30.0]),
    path=st.sampled_from(sorted(PATHS)),
    weighed=st.booleans(),
    method=st.sampled_from(["fista", "cgls"]),
)
def test_the_residual_never_rises_and_is_that_of_what_comes_back(
    seed: int, n: int, noise: float, scale: float, path: str, weighed: bool, method: Method
) -> None:
    (views, model), rng = PATHS[path], np.random.default_rng(seed)
    g = Gaussians.from_physical(
        rng.uniform(-3, 3, (n, 3)), rng.uniform(0.4, 2, (n, 3)), rng.uniform(0.1, 1, n), rng.normal(size=(n, 4)), 0.7
    )
    a = DensityOperator(g, views, rays=model)
    data = noisy(scale * a.forward(rng.uniform(0, 1, n)).astype(np.float64), noise, rng)
    weights = rng.choice(np.array([0, 0.5, 3], np.float32), data.shape) if weighed else np.ones_like(data)

    def residual(x: F64) -> float:
        off = np.sqrt(weights) * (a.forward(x).astype(np.float64) - data)
        return float(np.linalg.norm(off) / np.linalg.norm(np.sqrt(weights) * data))

    curve = [residual(shares(g))]
    found = solve_densities(
        g, data, views, method=method, iterations=12, weights=weights, rays=model,
        on_iteration=lambda _, r: curve.append(r),
    )  # fmt: skip
    # Rounding of images that lie `scale` apart from what is left; cgls updates its residual instead of measuring it.
    rounding = {"fista": 1e-6, "cgls": 1e-5}[method] * curve[0]
    assert (np.diff(curve) <= rounding).all()
    if method == "fista":
        assert residual(shares(found)) == pytest.approx(curve[-1], rel=1e-3, abs=1e-5 + 1e-5 / scale)


@pytest.mark.parametrize("method", ["fista", "cgls"])
def test_pixels_without_weight_or_value_do_not_count(
    method: Method, random_gaussians: Make, rng: np.random.Generator
) -> None:
    g = overlapping(random_gaussians)
    a = matrix(g, PARALLEL)
    data = noisy(a @ shares(g), 0.05, rng)
    weights = rng.uniform(0.5, 2, data.shape).astype(np.float32)
    dead = rng.random(data.shape) < 0.1
    spoiled, other = np.where(dead, np.nan, data), np.where(dead, 70, data)
    known = np.where(dead, 0, weights).astype(np.float32)
    by_value = solve_densities(g, spoiled, PARALLEL, method=method, weights=weights)
    by_weight = solve_densities(g, other, PARALLEL, method=method, weights=known)
    assert torch.equal(by_value.raw_densities, by_weight.raw_densities)
    if method == "fista":
        root = np.sqrt(known.ravel().astype(np.float64))
        expected, _, off = minimum(a, np.where(dead, 0, data), root)
        found = solve_densities(g, spoiled, PARALLEL, weights=weights, iterations=400, truncation=WHOLE)
        np.testing.assert_allclose(shares(found), expected, atol=off)
    unweighed = solve_densities(g, spoiled, PARALLEL, method=method)
    ones = solve_densities(g, other, PARALLEL, method=method, weights=(~dead).astype(np.float32))
    assert torch.equal(unweighed.raw_densities, ones.raw_densities)


@pytest.mark.parametrize("views", [[3, 0], slice(1, 4), (2,)])
def test_some_views_are_as_a_scan_of_them(views: list[int] | slice, random_gaussians: Make) -> None:
    g = overlapping(random_gaussians)
    data, weights = 2 * project(g, CONE).numpy(), np.linspace(0.5, 2, CONE.n_views * 18 * 22, dtype=np.float32)
    weights = weights.reshape(data.shape)
    chosen = list(views) if isinstance(views, tuple) else views
    part = solve_densities(g, data, CONE, views=views, weights=weights)
    alone = solve_densities(g, data[chosen], CONE.select(chosen), weights=weights[chosen])
    assert torch.equal(part.raw_densities, alone.raw_densities)


def test_the_solve_explains_more_than_one_factor_and_changes_nothing_else(
    random_gaussians: Make, rng: np.random.Generator
) -> None:
    g = overlapping(random_gaussians)
    before = {name: values.copy() for name, values in g.arrays().items()}
    data = noisy(matrix(g, PARALLEL) @ rng.uniform(0, 2, g.n), 0.02, rng)
    factor, found = scale_to_data(g, data, PARALLEL), solve_densities(g, data, PARALLEL)
    misfits = [np.linalg.norm(project(model, PARALLEL).numpy() - data) for model in (factor, found)]
    assert misfits[1] < 0.5 * misfits[0]
    for name, values in g.arrays().items():
        np.testing.assert_array_equal(values, before[name])
        if name != "raw_densities":
            np.testing.assert_array_equal(found.arrays()[name], values)


def test_a_gaussian_that_no_view_sees_keeps_its_density(random_gaussians: Make) -> None:
    g = overlapping(random_gaussians)
    far = replace(g, means=torch.where(torch.arange(g.n)[:, None] == 4, torch.tensor(500.0), g.means))
    found = solve_densities(far, 2 * project(far, PARALLEL).numpy(), PARALLEL)
    assert float(found.densities[4]) == pytest.approx(float(g.densities[4]), rel=1e-5)
    assert float(found.densities[5]) != pytest.approx(float(g.densities[5]), rel=1e-3)


@pytest.mark.parametrize("method", ["fista", "cgls"])
def test_the_unit_of_attenuation_does_not_matter(
    method: Method, random_gaussians: Make, rng: np.random.Generator
) -> None:
    g = overlapping(random_gaussians)
    data = noisy(matrix(g, PARALLEL) @ shares(g), 0.05, rng)
    small = replace(g, density_unit=g.density_unit / 2**9)
    one = solve_densities(g, data, PARALLEL, method=method)
    other = solve_densities(small, data / np.float32(2**9), PARALLEL, method=method)
    np.testing.assert_allclose(shares(other), shares(one), atol=1e-5)


def test_misuse_is_named(random_gaussians: Make) -> None:
    g = random_gaussians(5, 4.0)
    data = project(g, PARALLEL).numpy()
    with pytest.raises(ValueError, match=r"method must be one of .*fista.*'sirt'"):
        solve_densities(g, data, PARALLEL, method="sirt")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least one iteration is needed, got 0"):
        solve_densities(g, data, PARALLEL, iterations=0)
    with pytest.raises(ValueError, match=r"projections have shape \(5, 18, 21\).* \(5, 18, 22\)"):
        solve_densities(g, data[..., 1:], PARALLEL)
    with pytest.raises(ValueError, match=r"weights have shape \(4, 18, 22\)"):
        solve_densities(g, data, PARALLEL, weights=data[1:])
    with pytest.raises(ValueError, match="weights must be finite and 0 or more"):
        solve_densities(g, data, PARALLEL, weights=-np.ones_like(data))
    with pytest.raises(ValueError, match="no views are selected"):
        solve_densities(g, data, PARALLEL, views=[])
    with pytest.raises(ValueError, match="zero everywhere"):
        solve_densities(g, np.zeros_like(data), PARALLEL)
    with pytest.raises(ValueError, match="none of 5 Gaussians is seen"):
        solve_densities(replace(g, means=g.means + 500), data, PARALLEL)
    with pytest.raises(ValueError, match=r"1 of 5 Gaussians .*not finite"):
        log_scales = g.log_scales.clone()
        log_scales[2, 1] = float("nan")
        solve_densities(replace(g, log_scales=log_scales), data, PARALLEL)
