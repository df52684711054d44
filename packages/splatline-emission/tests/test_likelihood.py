"""MLEM compared with a general optimiser: likelihood and total counts, with known attenuation and randoms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

import recon
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from recon.voxels.projector import Projector
from splatline_emission import Emission, attenuation_factors, mlem, passes_by_halves, weighted_lines

F32 = np.float32


def toy(seed: int = 0) -> tuple[Emission, Grid, np.ndarray]:
    """16 views of 2 x 7 pixels, Poisson counts; and A as a dense matrix."""
    rng = np.random.default_rng(seed)
    geometry = Geometry.parallel(np.linspace(0, np.pi, 16, endpoint=False), (2, 7), pixel_pitch=1.0)
    grid = Grid.matching(geometry)
    activity = rng.uniform(5, 40, grid.shape).astype(F32) * (rng.random(grid.shape) < 0.6)
    shape = (16, 2, 7)
    survival, background = rng.uniform(0.3, 0.9, shape).astype(F32), rng.uniform(1, 4, shape).astype(F32)
    projector = Projector(geometry, grid).plain
    counts = rng.poisson(survival * projector.forward(activity) + background).astype(F32)
    unit = np.eye(activity.size, dtype=F32).reshape(-1, *grid.shape)
    return (
        Emission(counts, geometry, survival, background),
        grid,
        np.stack([projector.forward(u).ravel() for u in unit], 1),
    )


@pytest.mark.usefixtures("one_thread")
def test_the_maximum_is_that_of_a_general_optimiser() -> None:
    """L-BFGS-B with bounds on a dense matrix, in float64."""
    emission, grid, a = toy()
    y, s, b = (v.ravel().astype(np.float64) for v in (emission.counts, emission.survival, emission.background))  # type: ignore[union-attr]
    system = s[:, None] * a

    def descent(x: np.ndarray) -> tuple[float, np.ndarray]:
        mean = system @ x + b
        return float(np.sum(mean - y * np.log(mean))), system.T @ (1 - y / mean)

    best = minimize(descent, np.full(a.shape[1], 10.0), jac=True, method="L-BFGS-B", bounds=[(0, None)] * a.shape[1],
                    options={"maxiter": 5000, "ftol": 1e-14, "gtol": 1e-9, "maxfun": 50000})  # fmt: skip
    reached = []
    found = mlem(emission, grid, 3000, on_iteration=lambda n, likelihood, residual: reached.append(likelihood))
    assert -best.fun - reached[-1] == pytest.approx(0, abs=0.02)  # of some 10⁴; the statistical unit is 0.5
    np.testing.assert_allclose(found.data.ravel(), best.x, atol=0.03 * best.x.max())


def test_each_iteration_raises_the_likelihood() -> None:
    emission, grid, _ = toy(1)
    reached: list[float] = []
    mlem(emission, grid, 60, on_iteration=lambda n, likelihood, residual: reached.append(likelihood))
    assert (np.diff(reached) > -1e-3).all() and reached[20] > reached[0] + 10


def test_without_background_each_iteration_keeps_the_counts() -> None:
    """Σ s A x = Σ y (Lange & Carson 1984)."""
    emission, grid, _ = toy(2)
    plain = replace(emission, background=0 * emission.background)
    for n in (1, 2, 7):
        mean = emission.survival * Projector(emission.geometry, grid).plain.forward(mlem(plain, grid, n).data)
        assert mean.sum() == pytest.approx(emission.counts.sum(), rel=1e-4)


def phantom() -> tuple[Volume, Volume, Geometry]:
    """Activity 1 in water of radius 24 mm, with a hot rod of 4 and two cold ones, of air and of Teflon."""
    geometry = Geometry.parallel(np.linspace(0, np.pi, 90, endpoint=False), (1, 64), pixel_pitch=1.0)
    grid = Grid.matching(geometry)
    _, y, x = (np.asarray(axis) for axis in np.meshgrid(*grid.coordinates(), indexing="ij"))
    body, hot, air, teflon = (
        np.hypot(x - u, y - v) < r for u, v, r in ((0, 0, 24), (11, 0, 6), (-10, 8, 6), (-6, -11, 6))
    )
    activity = (body + 3.0 * hot - 1.0 * air - 1.0 * teflon).astype(F32)
    mu = (0.0096 * body - 0.0095 * air + 0.0078 * teflon).astype(F32)
    return Volume(activity, grid), Volume(mu, grid), geometry


def test_what_is_given_makes_activity_right_and_what_is_left_out_shows() -> None:
    """Mean of cold rods over background (spillover) below 5 %, hot rod within 5 %; with noise of 10⁶ counts."""
    activity, mu, geometry = phantom()
    survival = attenuation_factors(mu, geometry)
    true = survival * Projector(geometry, activity.grid).plain.forward(activity.data)
    scale = 1e6 / float(true.sum())
    background = np.full_like(true, 0.25 * scale * true.mean())
    counts = np.random.default_rng(0).poisson(scale * true + background).astype(F32)
    _, y, x = np.meshgrid(*activity.grid.coordinates(), indexing="ij")

    def rods(emission: Emission) -> dict[str, float]:
        found = mlem(emission, activity.grid, 20, subsets=10).data / scale
        places = {"hot": (11, 0, 4), "air": (-10, 8, 4), "teflon": (-6, -11, 4), "body": (5, 15, 4)}
        return {name: float(found[np.hypot(x - u, y - v) < r].mean()) for name, (u, v, r) in places.items()}

    right = rods(Emission(counts, geometry, survival, background))
    assert right["body"] == pytest.approx(1, abs=0.05) and right["hot"] == pytest.approx(4, rel=0.05)
    assert max(right["air"], right["teflon"]) < 0.05 * right["body"]
    assert rods(Emission(counts, geometry, survival, 0 * background))["teflon"] > 0.1  # randoms left out
    assert rods(Emission(counts, geometry, np.ones_like(survival), background))["hot"] < 3.2  # attenuation left out


def test_subsets_reach_in_one_iteration_what_takes_as_many_without() -> None:
    activity, _, geometry = phantom()
    counts = Projector(geometry, activity.grid).plain.forward(activity.data) * 1000
    emission = Emission(counts, geometry, np.ones_like(counts), 0 * counts)
    plain, ordered = (mlem(emission, activity.grid, n, m).data / 1000 for n, m in ((20, 1), (2, 10)))
    assert np.sqrt(np.mean((plain - ordered) ** 2)) < 0.05
    assert np.sqrt(np.mean((ordered - activity.data) ** 2)) < 0.35


@pytest.mark.parametrize(("total", "expected"), [(1e5, (2, 5)), (1e6, (6, 15))])
def test_counts_held_out_end_the_iterations_where_the_volume_is_nearest_to_the_truth(
    total: float, expected: tuple[int, int]
) -> None:
    """More counts take more of them. Half as many and twice as many are no nearer, and FBP is farther away."""
    activity, mu, geometry = phantom()
    survival = attenuation_factors(mu, geometry)
    lines = survival * Projector(geometry, activity.grid).plain.forward(activity.data)
    scale = total / float(lines.sum())
    background = np.full_like(lines, 0.25 * scale * lines.mean())
    counts = np.random.default_rng(0).poisson(scale * lines + background).astype(F32)
    emission = Emission(counts, geometry, survival, background)

    def error(volume: Volume) -> float:
        return float(np.sqrt(np.mean((volume.data / scale - activity.data) ** 2)))

    n = passes_by_halves(emission, activity.grid, 4, 50, np.random.default_rng(0))
    chosen = mlem(emission, activity.grid, n, 4)
    assert expected[0] <= n <= expected[1]
    others = (mlem(emission, activity.grid, max(1, k), 4) for k in (n // 2, 2 * n))
    assert error(chosen) <= 1.02 * min(map(error, others))
    assert error(chosen) < 0.9 * error(recon.reconstruct(weighted_lines(emission)[0], geometry, "fbp").volume)


def test_counts_that_are_none_of_poissons_choose_nothing() -> None:
    emission, grid, _ = toy()
    scaled = replace(emission, counts=emission.counts * F32(0.7))
    assert passes_by_halves(scaled, grid, 4, 60, np.random.default_rng(0)) == 60


def test_weighted_squares_have_the_gradient_and_the_curvature_of_the_likelihood() -> None:
    """At even counts, whose smoothed mean is their mean: by differences of Σ mean - y log(mean) in float64."""
    geometry = Geometry.parallel(np.linspace(0, np.pi, 4, endpoint=False), (2, 7))
    s, b, y = (np.full((4, 2, 7), value, F32) for value in (0.4, 3.0, 23.0))
    lines, weights = weighted_lines(Emission(y, geometry, s, b))

    def descent(p: float) -> float:
        return 0.4 * p + 3.0 - 23.0 * np.log(0.4 * p + 3.0)

    at, h = (23.0 - 3.0) / 0.4, 0.01
    np.testing.assert_allclose(lines, at, rtol=1e-6)
    assert (descent(at + h) - descent(at - h)) / (2 * h) == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(weights, (descent(at + h) - 2 * descent(at) + descent(at - h)) / h**2, rtol=1e-3)


def test_lines_of_few_counts_are_not_lowered_by_their_weights() -> None:
    """A weight by each line's own count favours the low ones; that of its neighbours does not. Blind lines weigh 0."""
    geometry, rng = Geometry.parallel(np.linspace(0, np.pi, 40, endpoint=False), (16, 32)), np.random.default_rng(0)
    s = rng.uniform(0.2, 0.6, (40, 16, 32)).astype(F32)
    s[:, 3] = 0
    b = np.full_like(s, 2.0)
    y = rng.poisson(s * 20 + b).astype(F32)
    lines, weights = weighted_lines(Emission(y, geometry, s, b))
    assert not weights[:, 3].any() and np.isfinite(lines).all()
    assert np.average(lines, weights=weights) == pytest.approx(20, rel=0.03)
    own = s**2 / np.maximum(y, 1)
    assert np.average(lines, weights=own) < 18
    rays = lines[weights > 0] - 20
    assert np.mean(rays**2 * weights[weights > 0]) == pytest.approx(1, abs=0.1)  # inverse variances


def test_a_stop_ends_it_and_bad_counts_are_refused() -> None:
    emission, grid, _ = toy()
    calls: list[int] = []
    mlem(emission, grid, 50, on_iteration=lambda n, *_: calls.append(n) or n == 3)
    assert calls == [1, 2, 3]
    for spoiled in (-emission.counts, emission.counts[:3], 0 * emission.counts):
        with pytest.raises(ValueError, match="counts"):
            replace(emission, counts=spoiled)
    for iterations, subsets, said in ((0, 1, "iterations .* got 0"), (1, 17, "1 to 16, .* got 17"), (1, 0, "got 0")):
        with pytest.raises(ValueError, match=said):
            mlem(emission, grid, iterations, subsets)
    blind = np.where(np.arange(16)[:, None, None] == 3, 0, np.ones_like(emission.counts))
    with pytest.raises(ValueError, match="the model expects 0 counts"):
        mlem(replace(emission, survival=blind.astype(F32), background=0 * emission.background), grid)
