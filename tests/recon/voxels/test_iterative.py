"""Iterative methods compared with explicit matrices, a least-squares solver and slow references."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse.linalg import lsqr, svds

from recon.base.decisions import Decisions, GoesOn
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import SWEEPS_OF_TRIALS, RunControl
from recon.base.volume import Grid, Volume
from recon.features.iterative.methods import AsdPocs, Cgls, Sart, Sirt
from recon.reconstruction import reconstruct
from recon.voxels.choice import MOST_TRIALS
from recon.voxels.fbp import fbp
from recon.voxels.iterative import solve, watched
from recon.voxels.methods import FistaTv, OsSirtTv
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import density_unit, largest_eigenvalue
from tests.messages import refused
from tests.recon.kernels.voxels_reference import system_matrix
from tests.recon.voxels.tv_reference import differences, total_variation, transposed_differences
from tests.slow_cases import others_slow

METHODS = (Sirt(), Sart(), Cgls(), AsdPocs(), FistaTv(), OsSirtTv())
CUBES = (1.0, 1.0, 1.0)


def blocks(grid: Grid, scale: float = 1.0) -> NDArray[np.float32]:
    """A piecewise constant object: a box in a box."""
    nz, ny, nx = grid.shape
    data = np.zeros(grid.shape, np.float32)
    data[:, ny // 5 : -(ny // 5), nx // 4 : -(nx // 4)] = 0.4 * scale
    data[nz // 4 : -(nz // 4) or None, ny // 3 : -(ny // 3), nx // 3 : nx // 2] = scale
    return data


def parallel_case(
    n_views: int = 7, noise: float = 0.0, matched: bool = False
) -> tuple[Projector, NDArray[np.float32], NDArray[np.float32]]:
    """Projector, truth and its projections, with white noise of a share of their largest value."""
    geometry = Geometry.parallel(np.arange(n_views) * np.pi / n_views + 0.1, (6, 20), pixel_pitch=0.5, axis_col=9.2)
    projector = Projector(geometry, Grid((6, 18, 17), 0.5), matched)
    truth = blocks(projector.grid)
    views = projector.forward(truth)
    return projector, truth, views + _noise(views, noise)


def cone_case() -> tuple[Projector, NDArray[np.float32], NDArray[np.float32]]:
    geometry = Geometry.cone(np.arange(8) * np.pi / 4, (8, 22), 0.9, 30.0, 45.0)
    projector = Projector(geometry, Grid((6, 15, 16), 0.6, slice_pitch=0.7), matched=False)
    truth = blocks(projector.grid)
    return projector, truth, projector.forward(truth)


def _noise(views: NDArray[np.float32], share: float) -> NDArray[np.float32]:
    white = np.random.default_rng(5).normal(size=views.shape)
    return (share * views.max() * white).astype(np.float32)


def residual(projector: Projector, volume: Volume, views: NDArray[np.float32]) -> float:
    return float(np.linalg.norm(projector.forward(volume.data) - views) / np.linalg.norm(views))


def error(volume: Volume, truth: NDArray[np.float32]) -> float:
    return float(np.linalg.norm(volume.data - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("case", [parallel_case, cone_case])
def test_every_method_explains_clean_data(method: Any, case) -> None:  # type: ignore[no-untyped-def]
    projector, truth, views = case()
    found = solve(method, projector, views)
    assert found.grid == projector.grid
    assert found.data.dtype == np.float32
    assert found.data.flags.c_contiguous
    assert (found.data >= 0).all()
    if isinstance(method, Cgls):  # what it clips at the end is missing in the residual
        assert residual(projector, solve(method, projector, views, nonnegative=False), views) < 0.02
    else:
        assert residual(projector, found, views) < 0.05
    assert error(found, truth) < 0.25


def test_sirt_takes_the_step_of_its_formula() -> None:
    projector, _, views = parallel_case()
    matrix = system_matrix(projector.geometry, projector.grid)
    rows, columns = matrix.sum(1), matrix.sum(0)
    rows_inverse = np.where(rows > 1e-3 * rows.max(), 1 / np.maximum(rows, 1e-9), 0)
    columns_inverse = np.where(columns > 1e-3 * columns.max(), 1 / np.maximum(columns, 1e-9), 0)
    x = np.zeros(matrix.shape[1])
    for _ in range(3):
        x = np.maximum(x + 0.8 * columns_inverse * (matrix.T @ (rows_inverse * (views.ravel() - matrix @ x))), 0)
    found = solve(Sirt(iterations=3, relaxation=0.8), projector, views)
    np.testing.assert_allclose(found.data.ravel(), x, atol=2e-5)


def test_sart_takes_one_view_after_the_other_in_random_order() -> None:
    projector, _, views = parallel_case(n_views=5)
    matrices = [system_matrix(projector.geometry.select([v]), projector.grid) for v in range(5)]
    columns = np.max([m.sum(0) for m in matrices], axis=0)
    columns_inverse = np.where(columns > 1e-3 * columns.max(), 1 / np.maximum(columns, 1e-9), 0)
    rng = np.random.default_rng(3)
    x = np.zeros(columns.size)
    for sweep in range(2):
        for v in rng.permutation(5):
            rows = matrices[v].sum(1)
            rows_inverse = np.where(rows > 1e-3 * rows.max(), 1 / np.maximum(rows, 1e-9), 0)
            back = matrices[v].T @ (rows_inverse * (views[v].ravel() - matrices[v] @ x))
            x = np.maximum(x + 0.9**sweep * columns_inverse * back, 0)
    found = solve(Sart(iterations=2, decay=0.9), projector, views, decide=Decisions(3))
    np.testing.assert_allclose(found.data.ravel(), x, atol=2e-5)


def test_sirt_has_the_truth_as_its_fixed_point_and_a_falling_residual() -> None:
    projector, truth, views = parallel_case()
    kept = solve(Sirt(5), projector, views, start=Volume(truth, projector.grid))
    np.testing.assert_allclose(kept.data, truth, atol=1e-5)
    noisy = views + _noise(views, 0.05)
    curve: list[float] = []
    # In the norm that SIRT minimises (rays weighed by their lengths) without clipping; nearly so in the plain one.
    solve(Sirt(40), projector, noisy, nonnegative=False, go_on=GoesOn(lambda _, r: not curve.append(r)))
    assert curve[0] == pytest.approx(1.0)
    assert (np.diff(curve) < 1e-6).all()
    assert curve[-1] < 0.15


@pytest.mark.parametrize("weighed", [False, True])
@pytest.mark.parametrize("steps", [1, 4, 6])
def test_cgls_is_lsqr(steps: int, weighed: bool, rng: np.random.Generator) -> None:
    """Both minimise the residual over the same Krylov space (Paige & Saunders 1982), until float32 loses conjugacy."""
    projector, _, views = parallel_case(noise=0.02)
    weight = rng.uniform(0.2, 3, views.shape).astype(np.float32) if weighed else None
    root = np.sqrt(np.ones(views.size) if weight is None else weight.ravel().astype(np.float64))
    matrix = system_matrix(projector.geometry, projector.grid).multiply(root[:, None]).tocsr()
    expected = lsqr(matrix, root * views.ravel(), atol=0, btol=0, conlim=0, iter_lim=steps)[0]
    curve: list[float] = []
    found = solve(
        Cgls(steps), projector, views, weight=weight, nonnegative=False, go_on=GoesOn(lambda _, r: not curve.append(r))
    )
    np.testing.assert_allclose(found.data.ravel(), expected, atol=1e-4 * np.abs(expected).max())
    misfit = np.linalg.norm(matrix @ expected - root * views.ravel()) / np.linalg.norm(root * views.ravel())
    assert curve[-1] == pytest.approx(misfit, rel=1e-3)


def test_the_step_bound_is_the_largest_eigenvalue_from_above() -> None:
    for projector, _, _ in (parallel_case(), cone_case()):
        matrix = system_matrix(projector.geometry, projector.grid)
        exact = float(svds(matrix, k=1, return_singular_vectors=False, rng=0)[0] ** 2)
        bound = largest_eigenvalue(projector, None)
        assert exact * (1 - 1e-5) <= bound < 1.1 * exact


MIRRORS: tuple[tuple[int, ...], ...] = ((), (1,), (2,), (1, 2))  # axes of [z, y, x] that are reversed


def mirrored_variation(x: NDArray[np.float64]) -> float:
    """The mean total variation of four mirror images."""
    return float(np.mean([total_variation(np.flip(x, axes), CUBES) for axes in MIRRORS]))


def mirrored_differences(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """[mirror, 3, z, y, x], a quarter of the differences of each image."""
    return np.stack([differences(np.flip(x, axes), CUBES) for axes in MIRRORS]) / 4


def transposed_mirrored_differences(dual: NDArray[np.float64]) -> NDArray[np.float64]:
    images = [transposed_differences(each, CUBES) for each in dual]
    return np.sum([np.flip(image, axes) for image, axes in zip(images, MIRRORS, strict=True)], axis=0) / 4


@pytest.mark.slow
def test_fista_reaches_the_minimum_of_a_slow_reference() -> None:
    """Each sweep takes the differences of another of four mirror images, and so their mean in the end."""
    projector, _, views = parallel_case(n_views=5, noise=0.03)
    matrix = system_matrix(projector.geometry, projector.grid)
    step = 1 / float(svds(matrix, k=1, return_singular_vectors=False, rng=0)[0] ** 2)
    settings = FistaTv(iterations=150, tv_weight=2e-3, tv_steps=10, half_voxels=False)
    found = solve(settings, projector, views)
    # The weight is in units that the first sweep fixes; read the same sweep.
    first = solve(OsSirtTv(iterations=1, tv_weight=0.0), projector, views)
    threshold = 2e-3 * density_unit(np.ascontiguousarray(first.data.transpose(1, 2, 0)))
    # The problem is min ½|A x - p|² + μ TV(x) with μ = threshold / (step of the solver).
    mu = threshold * largest_eigenvalue(projector, None)

    def value(x: NDArray[np.float64]) -> float:
        return 0.5 * float(((matrix @ x.ravel() - views.ravel()) ** 2).sum()) + mu * mirrored_variation(x)

    x = np.zeros(projector.grid.shape)
    dual = np.zeros((len(MIRRORS), 3, *x.shape))
    t, y = 1.0, x
    for _ in range(200):
        z = y - step * (matrix.T @ (matrix @ y.ravel() - views.ravel())).reshape(x.shape)
        for _ in range(8):
            pull = np.maximum(z - mu * step * transposed_mirrored_differences(dual), 0)
            dual += mirrored_differences(pull) / (3 * mu * step)
            dual /= np.maximum(1, np.sqrt((dual**2).sum(1, keepdims=True)))
        new = np.maximum(z - mu * step * transposed_mirrored_differences(dual), 0)
        after = (1 + math.sqrt(1 + 4 * t * t)) / 2
        y, x, t = new + (t - 1) / after * (new - x), new, after
    assert value(found.data.astype(np.float64)) == pytest.approx(value(x), rel=1e-3)


def test_subsets_come_near_the_minimum_in_fewer_iterations() -> None:
    projector, _, views = parallel_case(n_views=40, noise=0.03)
    whole, few, subsets = (
        solve(FistaTv(n, tv_weight=2e-3, subsets=m, tv_steps=5), projector, views).data
        for n, m in ((200, 1), (4, 1), (4, 5))
    )
    scale = np.linalg.norm(whole)
    assert np.linalg.norm(subsets - whole) < 0.1 * scale
    assert np.linalg.norm(subsets - whole) < 0.5 * np.linalg.norm(few - whole)


def test_asd_pocs_has_less_variation_at_the_residual_of_sart() -> None:
    projector, truth, views = parallel_case(n_views=6, noise=0.02)
    plain = solve(Sart(iterations=12, decay=0.9999), projector, views)
    smooth = solve(AsdPocs(iterations=12, alpha=0.02), projector, views)
    variation = [total_variation(v.data.astype(np.float64), CUBES) for v in (plain, smooth)]
    assert variation[1] < 0.9 * variation[0]
    assert residual(projector, smooth, views) < 1.3 * residual(projector, plain, views)
    assert error(smooth, truth) < error(plain, truth)


@pytest.mark.parametrize("method", [FistaTv(iterations=100, tv_weight=2e-3), OsSirtTv(tv_weight=0.01)])
def test_tv_suits_a_piecewise_constant_object(method: Any) -> None:
    projector, truth, views = parallel_case(n_views=7, noise=0.02)
    sirt = error(solve(Sirt(), projector, views), truth)
    assert error(solve(method, projector, views), truth) < 0.6 * sirt


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_ordered_subset_sirt_ends_where_many_further_iterations_change_little(noise: float) -> None:
    projector, truth, views = parallel_case(n_views=31, noise=noise)
    by_default, further = OsSirtTv(tv_weight=0.01), OsSirtTv(iterations=200, tv_weight=0.01, still=0.0)
    decide = Decisions(0)
    ended = error(solve(by_default, projector, views, decide=decide), truth)
    assert decide.record["ended"] == "still" and decide.record["ended_after"] < by_default.iterations
    assert ended == pytest.approx(error(solve(further, projector, views), truth), rel=0.05)


@pytest.mark.parametrize("method", METHODS)
def test_rays_without_weight_do_not_count(method: Any) -> None:
    """Whatever they hold, NaN too."""
    projector, truth, views = parallel_case()
    weight = np.ones_like(views)
    weight[2, 3, 5:9] = weight[5, :, 11] = 0
    spoiled = np.where(weight == 0, np.nan, views).astype(np.float32)
    other = np.where(weight == 0, 70, views).astype(np.float32)
    eight = replace(method, iterations=8)
    found = solve(eight, projector, spoiled, weight=weight)
    np.testing.assert_array_equal(found.data, solve(eight, projector, other, weight=weight).data)
    assert error(found, truth) < 0.45


@pytest.mark.parametrize("method", METHODS)
def test_progress_stop_and_start(method: Any) -> None:
    projector, _, views = parallel_case()
    told: list[tuple[int, float]] = []
    three = solve(replace(method, iterations=3), projector, views)

    def third(iteration: int, residual: float) -> bool:
        told.append((iteration, residual))
        return len(told) < 3

    stopped = solve(replace(method, iterations=50), projector, views, go_on=GoesOn(third))
    assert [k for k, _ in told] == [1, 2, 3]
    assert all(0 < r <= 1.0 + 1e-6 for _, r in told)
    np.testing.assert_array_equal(stopped.data, three.data)
    before = three.data.copy()
    further = solve(replace(method, iterations=3), projector, views, start=three)
    assert residual(projector, further, views) < residual(projector, three, views)
    np.testing.assert_array_equal(three.data, before)


@pytest.mark.slow
@pytest.mark.parametrize("weighed", [True, False])
def test_asd_pocs_without_a_goal_takes_one_from_the_direct_method(weighed: bool, rng: np.random.Generator) -> None:
    projector, _, views = parallel_case(n_views=20)
    given, weight, root = views, None, np.ones(views.shape)
    if weighed:
        weight = rng.uniform(0.01, 3, views.shape).astype(np.float32)
        weight[:, 2, 4:8] = weight[4] = 0  # pixels that are not to be trusted, and a whole view
        root = np.sqrt(weight.astype(np.float64))
        given = np.where(weight == 0, np.nan, views).astype(np.float32)
    seen = np.flatnonzero(np.arange(20) != 4) if weighed else np.arange(20)
    filled, _ = masked(given[seen], None if weight is None else weight[seen])
    direct = fbp(filled, projector.geometry.select(seen), projector.grid)
    off = float(np.linalg.norm(root * (projector.forward(direct) - views)) / np.linalg.norm(root * views))
    # These steps shrink wherever the residual is above the goal, which the iterations pass: a wrong one would tell.
    how = AsdPocs(iterations=30, alpha=0.05, alpha_decay=0.5, ratio=0.0)
    own, same, other = (
        solve(method, projector, given, weight=weight).data
        for method in (how, replace(how, goal=0.15 * off), replace(how, goal=0.3 * off))
    )
    np.testing.assert_array_equal(own, same)
    assert not np.array_equal(own, other)


def test_asd_pocs_takes_a_short_scan_of_a_cone() -> None:
    whole, truth, _ = cone_case()
    short = Projector(whole.geometry.at(np.linspace(0, np.deg2rad(210), 16)), whole.grid)
    views = short.forward(truth)
    found = solve(AsdPocs(), short, views)
    assert residual(short, found, views) < 0.05 and error(found, truth) < 0.25


def test_misuse_is_named() -> None:
    projector, truth, views = parallel_case()
    with refused(ValueError):
        solve(Sirt(), projector, views[..., 1:])
    with refused(ValueError):
        solve(Sirt(0), projector, views)
    with refused(ValueError):
        solve(Sirt(), projector, np.zeros_like(views))
    with refused(ValueError):
        solve(Sirt(), projector, views, weight=np.zeros_like(views))
    with refused(ValueError):
        solve(Sirt(), projector, views, start=Volume(truth[:3].copy(), Grid((3, 18, 17), 0.5)))
    views[0, 0, :2] = np.nan, np.inf
    with refused(ValueError):
        solve(Sirt(), projector, views)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("weight", "pitch"),
    others_slow([(1e-40, 1.0), (1e20, 1e-12), (3e38, 1.0), (1.0, 1e8)], 2),
)
def test_units_do_not_matter(method: Any, weight: float, pitch: float) -> None:
    """Lengths, weights: only their ratios count, however far float32's squares would be out of range."""
    projector, _, views = parallel_case(noise=0.02)
    plain = solve(replace(method, iterations=4), projector, views).data
    geometry, grid = projector.geometry, projector.grid
    there = Projector(replace(geometry, pixel_pitch=0.5 * pitch), Grid(grid.shape, 0.5 * pitch)).plain
    found = solve(replace(method, iterations=4), there, views, weight=np.full(views.shape, weight, np.float32)).data
    np.testing.assert_allclose(found.astype(np.float64) * pitch, plain, atol=3e-4)


@pytest.mark.parametrize("method", METHODS)
def test_a_box_that_no_ray_meets_stays_empty(method: Any) -> None:
    projector, _, views = parallel_case()
    aside = Projector(projector.geometry, Grid((4, 5, 6), 0.5, (90.0, 0.0, 0.0)))
    assert not solve(replace(method, iterations=2), aside, views).data.any()


@pytest.mark.parametrize(
    ("method", "n_views"),  # by the noise, and by views held out
    others_slow([(OsSirtTv(iterations=8), 10), (FistaTv(iterations=6), 24)]),
)
def test_the_weight_that_was_chosen_is_recorded_and_gives_the_same_volume(method: Any, n_views: int) -> None:
    projector, _, views = parallel_case(n_views, 0.02, matched=True)
    chosen = reconstruct(views, projector.geometry, method, grid=projector.grid)
    weight = chosen.settings["tv_weight_chosen"]
    given = reconstruct(views, projector.geometry, replace(method, tv_weight=weight), grid=projector.grid)
    twice = reconstruct(views, projector.geometry, replace(method, tv_weight=2 * weight), grid=projector.grid)
    other, far = (np.std(each.volume.data - chosen.volume.data) for each in (given, twice))
    assert other < 0.2 * far
    assert "tv_weight_chosen" not in given.settings


@pytest.mark.parametrize("shape", [(40, 40, 40), (317, 317, 2), (183, 183, 183)])
def test_a_typical_density_is_that_of_all_slices(shape: tuple[int, int, int]) -> None:
    x = np.zeros(shape, np.float32)
    x[..., 1 : 1 + shape[2] // 2] = 3.0
    assert density_unit(x) == pytest.approx(3.0)


def test_trials_are_told_as_progress_and_asked_apart() -> None:
    """As a rule 4 iterations, at most as many as MOST_TRIALS times that."""
    told: list[tuple[int, int, str]] = []
    stop = iter([False, False, True])
    control = RunControl(
        lambda: False, lambda each: told.append((each.step, each.steps, each.unit)), stop_trials=lambda: next(stop)
    )
    iterations: list[int] = []
    going = watched(control, 90, 1, lambda number, residual: iterations.append(number))
    assert [going.trials(), going.trials(), going.trials(), going.trials()] == [True, True, False, False]
    most = round(MOST_TRIALS)
    assert told == [(1, 1, f"{SWEEPS_OF_TRIALS} as a rule"), (2, max(2, most), f"{SWEEPS_OF_TRIALS} at most")]
    assert going(1, 0.5) and iterations == [1] and going.trials.trials is going.trials
