"""Error bars: the analytic noise of FBP, scaling with noise, decisions, and selected projections."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import recon
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import Method, Progress, ReconProblem, RunControl
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.error_bars import alternating, error_bars, method_on_voxels
from recon.voxels.direct import direct
from recon.voxels.projector import Projector
from tests.messages import refused

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 96, endpoint=False), (12, 48), pixel_pitch=0.5)
GRID = Grid.matching(VIEWS)
NOISE = 0.02
LINEAR = recon.FistaTv(iterations=10, tv_weight=0.0, allow_negative=True)


def ball() -> np.ndarray:
    z, y, x = (axis - axis.mean() for axis in np.indices(GRID.shape).astype(np.float32))
    return np.where(np.hypot(np.hypot(2 * z, y), x) < 15, 0.2, 0).astype(np.float32)


def problem(noise: float = NOISE, seed: int = 0) -> ReconProblem:
    clean = Projector(VIEWS, GRID).forward(ball())
    data = clean + noise * np.random.default_rng(seed).normal(size=clean.shape).astype(np.float32)
    return ReconProblem(Views(data.astype(np.float32), VIEWS), GRID)


def made(method: Method, given: ReconProblem, control: RunControl | None = None) -> tuple[Volume, np.ndarray]:
    decide = Decisions(given.seed)
    volume = method.run(given, RunControl(decide=decide)).volume
    found = error_bars(method, given, volume, decide.made, control or RunControl())
    assert found is not None
    return volume, found.deviation


def test_the_halves_alternate_in_the_order_of_the_angles() -> None:
    shuffled = VIEWS.select(np.random.default_rng(0).permutation(96))
    order = np.argsort(shuffled.angles)
    np.testing.assert_array_equal(alternating(shuffled)[order], np.tile([1, -1], 48))


def test_the_deviation_of_fbp_is_its_analytic_noise() -> None:
    """White noise: the variance is that of many FBPs of noise alone, and, in the middle, the sum over all weights²."""
    _, deviation = made(recon.Fbp(), problem())
    rng, alone = np.random.default_rng(1), np.zeros(GRID.shape)
    for _ in range(40):
        noise = (NOISE * rng.normal(size=problem().projections.shape)).astype(np.float32)
        alone += direct(noise, VIEWS, GRID, "hann").astype(np.float64) ** 2 / 40
    inside = ball() > 0
    flat = inside & (np.abs(ndimage_gradient(ball())) == 0)
    assert np.sqrt((deviation[flat] ** 2).mean()) == pytest.approx(np.sqrt(alone[flat].mean()), rel=0.1)


def ndimage_gradient(volume: np.ndarray) -> np.ndarray:
    """Zero where all voxels within three are equal."""
    from scipy.ndimage import maximum_filter, minimum_filter

    return maximum_filter(volume, 7) - minimum_filter(volume, 7)


@pytest.mark.parametrize("method", [recon.Fbp(), LINEAR], ids=lambda m: m.name)
def test_twice_the_noise_is_twice_the_deviation(method: Method) -> None:
    flat = (ball() > 0) & (ndimage_gradient(ball()) == 0)
    once, twice = (np.median(made(method, problem(noise))[1][flat]) for noise in (NOISE, 2 * NOISE))
    assert twice == pytest.approx(2 * once, rel=0.1)


@pytest.mark.parametrize("method", [recon.Fbp(), recon.FistaTv(iterations=10, tv_weight=1e-3)], ids=lambda m: m.name)
def test_edges_are_less_certain_than_what_lies_beside_them(method: Method) -> None:
    deviation = made(method, problem())[1]
    changes = ndimage_gradient(ball())
    assert np.median(deviation[(changes > 0) & (ball() > 0)]) > 1.2 * np.median(
        deviation[(changes == 0) & (ball() > 0)]
    )


def test_a_fit_is_refitted_with_the_weight_of_its_finish() -> None:
    method = recon.R2(steps=5, gaussians=200, finish=2)
    volume, deviation = made(method, problem())
    assert deviation.shape == volume.data.shape and np.isfinite(deviation).all() and deviation.max() > 0
    with refused(ValueError):
        made(replace(method, finish=0), problem())


@pytest.mark.parametrize(
    ("decided", "name"),
    [
        ({"strength": [[0.1, 1]]}, "pnp-dct"),
        ({"strength": [[0.1, 0]]}, "fista-tv"),
        ({"materials": [[[0.1, 0.4], [0.5, 0.5], 0.5, 0.02]]}, "discrete"),
        ({"materials": [[[], [], 1.0, 0.0]], "strength": [[0.1, 1]]}, "pnp-dct"),
        ({}, "fista-tv"),
    ],
)
def test_the_volume_of_a_fit_is_refitted_by_what_refined_it(decided: dict[str, Any], name: str) -> None:
    assert method_on_voxels(recon.R2(), {"weight": [[0.1]], **decided}).name == name


def test_patches_go_on_from_the_volume() -> None:
    """A first volume by total variation would take 20 sweeps more, and would forget this one."""
    told = list[Progress]()
    method, decided = recon.PnpDct(iterations=10, patch_threshold=0.1), {"weight": [[1e-3]]}
    found = error_bars(method, problem(), Volume(ball(), GRID), decided, RunControl(on_progress=told.append))
    assert found is not None and np.isfinite(found.deviation).all() and found.deviation.max() > 0
    assert [p.step for p in told] == [1, 2, 3, 4]


def test_the_same_seed_gives_the_same_bits_and_another_slab_follows() -> None:
    method, given, decide = recon.FistaTv(iterations=5, tv_weight=1e-3), problem(), Decisions(0)
    volume = method.run(given, RunControl(decide=decide)).volume
    first, again = (error_bars(method, given, volume, decide.made, RunControl()) for _ in range(2))
    assert first is not None and again is not None
    np.testing.assert_array_equal(first.deviation, again.deviation)
    other = error_bars(method, given, volume, first.decided, RunControl())
    assert other is not None
    np.testing.assert_array_equal(first.deviation, other.deviation)


def test_it_leaves_its_arguments_alone_and_tells_its_sweeps() -> None:
    method, given, told = recon.FistaTv(iterations=10, tv_weight=1e-3), problem(), list[Progress]()
    before = given.projections.copy()
    made(method, given, RunControl(on_progress=told.append))
    np.testing.assert_array_equal(given.projections, before)
    assert [p.step for p in told] == [1, 2, 3, 4] and told[-1].steps == 4 and told[-1].unit


def test_a_stop_leaves_it_out() -> None:
    method, given, decide = recon.FistaTv(iterations=5, tv_weight=1e-3), problem(), Decisions(0)
    volume = method.run(given, RunControl(decide=decide)).volume
    assert error_bars(method, given, volume, decide.made, RunControl(should_stop=lambda: True)) is None


def test_a_method_without_calibration_and_too_few_views_are_refused() -> None:
    given = problem()
    with refused(ValueError):
        error_bars(recon.Sirt(), given, Volume(ball(), GRID), {}, RunControl())
    less = replace(given, views=given.views.select(np.arange(0, 96, 16)))
    with refused(ValueError):
        error_bars(recon.Fbp(), less, Volume(ball(), GRID), {}, RunControl())
