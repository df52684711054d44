"""Damped steps: L keeps less than all, the step is safe, and the sweeps end at the minimum of steps without damping."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.decisions import GoesOn
from recon.base.empirical import STANDS_STILL
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu.tv import total_variation
from recon.voxels.damping import Damping, largest_damped
from recon.voxels.devices import CPU
from recon.voxels.ordered_fista import Subsets, ordered_fista, subsets_of
from recon.voxels.priors import TvWeight, tv_prox
from recon.voxels.projector import Projector
from recon.voxels.standstill import MOST_SWEEPS
from recon.voxels.voxel_problem import VoxelProblem, difference_weights, largest_eigenvalue

F32 = NDArray[np.float32]


def keeps(damping: Damping) -> NDArray[np.float64]:
    """The matrix of L, for one slice."""
    ny, nx, _ = damping.shape
    columns = []
    for unit in np.eye(ny * nx, dtype=np.float32).reshape(-1, ny, nx, 1):
        left = unit.copy()
        damping.take_off(CPU, left, damping.cells(CPU, unit))
        columns.append((unit - left).ravel())
    return np.stack(columns, 1).astype(np.float64)


@pytest.mark.parametrize(("shape", "views"), [((16, 16, 1), 8), ((12, 18, 1), 40), ((66, 3, 1), 60), ((70, 4, 1), 5)])
def test_l_is_symmetric_and_keeps_at_least_nothing_and_less_than_all(shape: tuple[int, int, int], views: int) -> None:
    damping = Damping.of(shape, views)
    matrix = keeps(damping)
    np.testing.assert_allclose(matrix, matrix.T, atol=2e-6)
    values = np.linalg.eigvalsh((matrix + matrix.T) / 2)
    assert values.min() > -1e-5 and values.max() < 1 - 0.99 / damping.gain


def test_a_gain_of_one_takes_nothing_off(rng: np.random.Generator) -> None:
    x = rng.normal(size=(9, 9, 2)).astype(np.float32)
    damping = Damping.of((9, 9, 2), 1)
    assert damping.gain == 1
    left = x.copy()
    damping.take_off(CPU, left, damping.cells(CPU, x))
    np.testing.assert_allclose(left, x, atol=1e-6)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("cone", [False, True])
def test_the_step_is_safe(cone: bool, weighted: bool, rng: np.random.Generator) -> None:
    """1 / step is at least the largest eigenvalue of gain (1 - L) AᵀWA, by a dense matrix in float64."""
    angles = np.linspace(0, np.pi * (1 + cone), 14, endpoint=False)
    views = Geometry.cone(angles, (1, 14), 1.0, 40.0, 60.0) if cone else Geometry.parallel(angles, (1, 14))
    projector = Projector(views, Grid.matching(views))
    _, ny, nx = projector.grid.shape
    damping = Damping.of((ny, nx, 1), views.n_views)
    weight = rng.uniform(0.05, 1, (14, 14, 1)).astype(np.float32) if weighted else None
    units = np.eye(ny * nx, dtype=np.float32).reshape(-1, ny, nx, 1)
    a = np.stack([projector.forward_lines(unit).ravel() for unit in units], 1).astype(np.float64)
    w = np.ones(len(a)) if weight is None else weight.ravel().astype(np.float64)
    damped = damping.gain * (np.eye(ny * nx) - keeps(damping)) @ (a.T @ (w[:, None] * a))
    largest = float(np.abs(np.linalg.eigvals(damped)).max())
    assert largest <= largest_damped(projector, weight, damping) < 2.5 * largest  # sharpening: its bound


def test_rays_that_meet_no_voxel_allow_any_step() -> None:
    views = Geometry.parallel(np.linspace(0, np.pi, 6, endpoint=False), (1, 9))
    projector = Projector(views, Grid.matching(views))
    assert np.isinf(largest_damped(projector, np.zeros((6, 9, 1), np.float32), Damping.of((9, 9, 1), 6)))


def _problem(cone: bool, weighted: bool) -> tuple[VoxelProblem, F32]:
    rng = np.random.default_rng(3)
    angles = np.linspace(0, np.pi * (1 + cone), 20, endpoint=False)
    views = Geometry.cone(angles, (6, 32), 1.0, 80.0, 120.0) if cone else Geometry.parallel(angles, (6, 32))
    projector = Projector(views, Grid.matching(views))
    z, y, x = np.meshgrid(*projector.grid.coordinates(), indexing="ij")
    size = projector.grid.shape[2] * projector.grid.voxel_size
    truth = (np.hypot(x, y) < 0.3 * size) * (1 + (np.hypot(x - 0.1 * size, y) < 0.1 * size)) * (np.abs(z) < 0.05 * size)
    data = projector.forward_lines(np.ascontiguousarray(truth.transpose(1, 2, 0).astype(np.float32)))
    data += rng.normal(0, 0.02 * data.max(), data.shape).astype(np.float32)
    weight = rng.uniform(0.6, 1, data.shape).astype(np.float32) if weighted else None
    start = np.full((*projector.grid.shape[1:], projector.grid.shape[0]), 0.1, np.float32)
    return VoxelProblem(projector, data, weight, True, rng, GoesOn()), start


@pytest.mark.parametrize(("cone", "weighted"), [(False, False), (True, False), (False, True)])
def test_damped_steps_end_at_the_minimum_of_steps_without_damping(cone: bool, weighted: bool) -> None:
    problem, start = _problem(cone, weighted)
    mu = 0.02 * float(problem.data.max())

    def minimum(most: int, damped: bool, sweeps: int) -> tuple[float, F32]:
        made = replace(problem, rng=np.random.default_rng(0))
        subsets = Subsets.of(made, most, damped)
        assert subsets.is_damped is damped
        x = ordered_fista(made, start.copy(), TvWeight(mu), subsets, sweeps=sweeps, prox=tv_prox(made, 10), still=0.0)
        residual = made.projector.forward_lines(x) - made.data
        weight = 1.0 if made.weight is None else made.weight
        data = 0.5 * float((weight * np.square(residual, dtype=np.float64)).sum())
        return data + mu * total_variation(x, difference_weights(made.projector.grid)), x

    slow, by_slow = minimum(1, False, 800)
    fast, by_damped = minimum(3, True, 120)
    assert fast == pytest.approx(slow, rel=3e-3)
    assert np.linalg.norm(by_damped - by_slow) < 0.02 * np.linalg.norm(by_slow)


@pytest.mark.parametrize(
    ("sweeps", "still", "stop_at", "ended"),
    [(200, 0.005, 999, "still"), (40, 0.0, 999, "bound"), (200, 0.0, 3, "stopped"), (200, 0.0, 30, "stopped")],
)
def test_the_settings_say_how_the_sweeps_ended(sweeps: int, still: float, stop_at: int, ended: str) -> None:
    problem, start = _problem(False, False)
    done: list[int] = []

    def go_on(sweep: int, residual: float) -> bool:
        done.append(sweep)
        return sweep < stop_at

    made, mu = replace(problem, go_on=GoesOn(go_on)), 0.02 * float(problem.data.max())
    subsets = Subsets.of(made, subsets_of(made.projector.geometry))
    ordered_fista(made, start, TvWeight(mu), subsets, sweeps=sweeps, prox=tv_prox(made, 3), still=still)
    assert made.decide.ended is not None
    how, after, change, _ = made.decide.ended
    assert how == ended and after == len(done) == done[-1]
    if stop_at == 3:  # no volume was compared with an earlier one
        assert change == math.inf and "last_change" not in made.decide.record
    else:
        assert (change < 0.005) is (ended == "still") or still == 0


def test_steps_that_are_not_damped_make_all_sweeps_and_say_nothing() -> None:
    problem, start = _problem(False, False)
    done: list[int] = []
    made = replace(problem, go_on=GoesOn(lambda sweep, _: not done.append(sweep)))
    ordered_fista(
        made, start, TvWeight(0.1), Subsets.of(made, 1, to_the_end=False), sweeps=25, prox=tv_prox(made, 3), still=1.0
    )
    assert len(done) == 25 and made.decide.ended is None


HARD = {
    "without total variation": {},
    "nine of ten rays without weight": {"zeros": 0.9},
    "one column of a hundred times the weight": {"column": 100.0},
    "one view of a hundred times the weight": {"view": 100.0},
    "weights of four decades": {"spread": 2.0},
    "a wedge is missing": {"arc": np.pi / 4},
}


@pytest.mark.parametrize("name", HARD)
def test_hard_scans_end_no_further_from_the_minimum_than_the_early_end(name: str) -> None:
    """The end by default, against 20 sweeps on many subsets without damping; the minimum is that of 1000 sweeps."""
    hard: dict[str, float] = HARD[name]
    rng = np.random.default_rng(5)
    views = Geometry.parallel(np.linspace(0, hard.get("arc", np.pi), 40, endpoint=False), (1, 48))
    projector = Projector(views, Grid.matching(views))
    rows, cols = np.indices((48, 48)) - 23.5
    truth = (np.hypot(rows, cols) < 20) * 0.5 + (np.hypot(rows - 6, cols) < 7) * 0.5
    for row, col in rng.uniform(-12, 12, (20, 2)):
        truth += (np.hypot(rows - row, cols - col) < 2) * 0.3
    data = projector.forward_lines(truth[:, :, None].astype(np.float32))
    weight = np.exp(hard.get("spread", 0) * rng.standard_normal(data.shape)).astype(np.float32)
    weight[rng.random(data.shape) < hard.get("zeros", 0)] = 0
    weight[:, 20] *= hard.get("column", 1)
    weight[7] *= hard.get("view", 1)
    data += (rng.normal(0, 0.02 * data.max(), data.shape) / np.sqrt(np.maximum(weight, 1e-3))).astype(np.float32)
    problem = VoxelProblem(projector, data, weight if hard else None, True, rng, GoesOn())
    start = np.full((48, 48, 1), 0.1, np.float32)
    mu = 0 if not hard else 1e-3 * largest_eigenvalue(projector.plain, weight)

    def end(subsets: Subsets, sweeps: int, tv_steps: int, still: float) -> F32:
        made = replace(problem, rng=np.random.default_rng(0))
        return ordered_fista(
            made, start.copy(), TvWeight(mu), subsets, sweeps=sweeps, prox=tv_prox(made, tv_steps), still=still
        )

    def objective(x: F32) -> float:
        square = np.square(projector.forward_lines(x) - data, dtype=np.float64)
        return 0.5 * float((weight * square if hard else square).sum()) + mu * total_variation(x, (1, 1, 1))

    minimum = end(Subsets.of(problem, 1, False), 1000, 8, 0.0)
    early = end(Subsets.of(problem, subsets_of(views, 9, False), False), 20, 3, 0.0)
    by_default = end(Subsets.of(problem, subsets_of(views)), MOST_SWEEPS, 3, STANDS_STILL)
    assert objective(by_default) < objective(early)
    assert not mu or np.linalg.norm(by_default - minimum) < np.linalg.norm(early - minimum)
