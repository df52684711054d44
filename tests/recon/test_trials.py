"""What trials prefer, by their scores, and on which part of a scan they are made."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from operator import contains

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon.base.geometry import Geometry
from recon.base.method import DataUse, ReconProblem, RunControl
from recon.base.volume import Grid
from recon.trials import Score, best_of, part_of, predicts_best
from recon.voxels.direct import Fbp
from recon.voxels.methods.fista_tv import FistaTv
from recon.voxels.projector import Projector

F32 = NDArray[np.float32]


@pytest.mark.parametrize(("residuals", "hiding", "best"), [
    ([1.02, 1.00, 1.01], (), 0),  # level: the first
    ([1.02, 1.00, 1.01], (0,), 1),
    ([1.02, 1.00, 1.01], (0, 1), 2),
    ([1.02, 1.00, 1.01], (0, 1, 2), 1),  # all hide something: the least residual
    ([1.05, 1.00, 1.30], (), 1),  # beyond 4 %
    ([1.05, 1.00, 1.30], (1,), 1),
])  # fmt: skip
def test_of_level_residuals_the_first_that_hides_nothing(
    residuals: list[float], hiding: tuple[int, ...], best: int
) -> None:
    scatter = np.array([-0.1, 0.1, -0.1, 0.1])  # a standard error of 0.058: two are more than 4 %
    scores = [Score(i, Fbp(), r + scatter, hides=partial(contains, hiding, i)) for i, r in enumerate(residuals)]
    assert best_of(scores)[0].at == best


def test_with_many_views_residuals_are_level_within_two_standard_errors() -> None:
    scatter = np.tile([-0.02, 0.02], 50)  # a standard error of 0.002
    for off, best in ((0.003, 0), (0.005, 1)):
        assert best_of([Score(0, Fbp(), 1 + off + scatter), Score(1, Fbp(), 1 + scatter)])[0].at == best


def test_no_ray_of_the_middle_rows_leaves_their_box() -> None:
    """A sample that fills it throws the same line integrals there as one that goes on above and below."""
    views = recon.Geometry.cone(np.linspace(0, 2 * np.pi, 24, endpoint=False), (80, 64), 1.0, 150.0, 300.0)
    grid = recon.Grid.matching(views)

    def column(box: recon.Grid) -> F32:
        _, y, x = np.meshgrid(*box.coordinates(), indexing="ij")
        return np.exp(-(x**2 + y**2) / (2 * 5**2)).astype(np.float32)

    data = Projector(views, grid).forward(column(grid))
    part, _ = part_of(ReconProblem(data, views, grid, DataUse(), 0, "cpu"))
    assert part.grid.shape[0] * part.grid.spacing[0] < 0.7 * grid.shape[0] * grid.spacing[0]
    found = Projector(part.geometry, part.grid).forward(column(part.grid))
    np.testing.assert_allclose(found, part.projections, atol=0.005 * data.max())


def test_of_two_that_predict_alike_the_one_that_follows_its_noise_is_not_taken() -> None:
    """0.9 of the other's residual, but 1.8 times what it leaves in its own views, where the other leaves as much."""
    scatter = np.array([-0.01, 0.01])
    honest, follower = (
        Score(0, Fbp(), 1.0 + scatter, residual_seen=1.0),
        Score(1, Fbp(), 0.9 + scatter, residual_seen=0.5),
    )
    assert best_of([honest, follower])[0].at == 0
    assert best_of([honest, Score(1, Fbp(), 0.9 + scatter, residual_seen=0.85)])[0].at == 1


@pytest.mark.parametrize(("losing", "best"), [((), 0), ((0,), 1), ((0, 1), 2), ((0, 1, 2), 0)])
def test_what_loses_weak_matter_is_taken_only_where_all_do(losing: tuple[int, ...], best: int) -> None:
    scores = [Score(i, Fbp(), np.full(9, r), loses=i in losing) for i, r in enumerate((1.0, 1.5, 2.0))]
    taken, passed = best_of(scores)
    assert taken.at == best and {at for at, why in passed.items() if why == "loses weak matter"} == set(losing)


def _dense_and_weak(haze: float) -> ReconProblem:
    """A dense rod in the upper rows and a weak one in the lower rows, in views that lack `haze`."""
    views = Geometry.parallel(np.linspace(0, np.pi, 40, endpoint=False), (160, 64), pixel_pitch=0.01)
    grid = Grid.matching(views)
    z, y, x = (np.arange(n) - (n - 1) / 2 for n in grid.shape)
    away = (y[:, None] ** 2 + x**2)[None]
    dense = (away < 22**2) & (np.abs(z + 35) < 35)[:, None, None]
    weak = (away < 12**2) & (np.abs(z - 45) < 15)[:, None, None]
    data = Projector(views, grid).forward((5 * dense + 0.8 * weak).astype(np.float32))
    noise = np.random.default_rng(0).normal(-haze, 0.01, data.shape)
    return ReconProblem(data + noise.astype(np.float32), views, grid, DataUse(), 0, "cpu")


def test_trials_see_the_weakest_rows_beside_the_fullest_ones() -> None:
    problem = _dense_and_weak(0.0)
    part, where = part_of(problem)
    assert part is not None and part.projections.shape[1] == part.grid.shape[0] == 40
    (full, weak) = [slice(*map(int, said.split(" to "))) for said in where.removeprefix("rows ").split(" and ")]
    assert full.stop < 80 and weak.start >= 110 and weak.stop < 140
    np.testing.assert_array_equal(part.projections[:, :32], problem.projections[:, full.start : full.stop + 1])
    np.testing.assert_array_equal(part.projections[:, 32:], problem.projections[:, weak.start : weak.stop + 1])


def test_rows_without_beam_are_not_the_weakest() -> None:
    problem = _dense_and_weak(0.0)
    weights = np.ones_like(problem.projections)
    weights[:, 108:132] = 0  # of the weak rod's rows 110 to 139
    part, where = part_of(replace(problem, use=DataUse(weights)))
    assert part is not None and part.use.weights is not None and part.use.weights.all(), where


def test_a_method_that_loses_the_weak_rows_is_passed_over() -> None:
    part, _ = part_of(_dense_and_weak(0.1))
    assert part is not None
    at, said = predicts_best(part, [FistaTv(), Fbp()], RunControl())
    assert at == 1 and "loses weak matter" in said
