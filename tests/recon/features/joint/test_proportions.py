"""Smooth factors within the sample: transpose, gradient, and known factors from several kinds of projections."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.features.joint.proportions import _TIME_WEIGHT, Proportions, smoothness
from recon.voxels.projector import Projector

SIDE, ROWS, KNOTS = 20, 3, 3


def problem_of(factors: F32, noise: float = 0.0, views: int = 24) -> Proportions:
    """Views of two cylinders, each by its own mixture of three factors."""
    geometry = Geometry.parallel(np.arange(views) * 2.4, (ROWS, SIDE), axis_col=(SIDE - 1) / 2)
    projector = Projector(geometry, Grid.matching(geometry))
    shares = np.maximum(0, 1 - np.abs(np.linspace(0, KNOTS - 1, views)[:, None] - np.arange(KNOTS)))
    empty = np.zeros((views, SIDE, ROWS), np.float32)
    made = Proportions(projector, np.arange(views), shares, cylinders(), empty, np.ones_like(empty))
    data = made.shown(factors) + np.float32(noise) * np.random.default_rng(1).standard_normal(empty.shape)
    return Proportions(projector, made.kind, shares, made.matter, data.astype(np.float32), made.weight)


def cylinders() -> F32:
    y, x = (np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2) * 2 / SIDE
    both = (np.hypot(x + 0.4, y) < 0.35) | (np.hypot(x - 0.4, y) < 0.35)
    return np.ascontiguousarray(np.repeat(both[:, :, None], ROWS, 2), np.float32)


def changing() -> F32:
    """One cylinder grows linearly, the other stays."""
    x = np.broadcast_to((np.arange(SIDE) < SIDE / 2)[None, :, None], (SIDE, SIDE, ROWS))
    return np.stack([np.where(x, 1 + 0.25 * k, 1) for k in range(KNOTS)]).astype(np.float32)


def test_explained_is_the_transpose_of_shown(rng: np.random.Generator) -> None:
    problem = problem_of(changing())
    factors = rng.standard_normal(changing().shape).astype(np.float32)
    lines = rng.standard_normal(problem.data.shape).astype(np.float32)
    seen = float(np.vdot(problem.weight * problem.shown(factors), lines))
    assert float(np.vdot(factors, problem.explained(lines))) == pytest.approx(seen, rel=1e-4)


def test_rough_is_the_gradient_of_the_squares_of_differences(rng: np.random.Generator) -> None:
    problem = problem_of(changing())
    matter = problem.matter.astype(np.float64)
    at, along = rng.standard_normal((2, *changing().shape))

    def half_squares(factors: F64) -> float:
        pairs = _TIME_WEIGHT * float((matter**2 * np.diff(factors, axis=0) ** 2).sum())
        for axis in range(3):
            first, second = np.delete(matter, -1, axis), np.delete(matter, 0, axis)
            pairs += float((first * second * np.diff(factors, axis=axis + 1) ** 2).sum())
        return pairs / 2

    slope = half_squares(at + along / 2) - half_squares(at - along / 2)
    assert float(np.vdot(problem.rough(at.astype(np.float32)), along)) == pytest.approx(slope, rel=1e-4)


def test_known_factors_are_found() -> None:
    problem, truth = problem_of(changing()), changing()
    found = problem.solved(1e-4, problem.ones(), lambda: True)
    there = problem.matter > 0
    assert np.abs(found - truth)[:, there].max() < 0.02


def test_views_held_out_choose_smoother_factors_of_noisier_views() -> None:
    chosen = []
    for noise in (0.01, 1.0):
        problem = problem_of(changing(), noise)
        held_out = np.arange(24) % 6 == 3
        fit, judge = (problem.select(np.flatnonzero(some)) for some in (~held_out, held_out))
        chosen.append(smoothness(fit, judge, problem.ones(), lambda: True)[0])
    assert chosen[0] < chosen[1]


def test_an_end_keeps_the_factors_so_far() -> None:
    problem = problem_of(changing())
    np.testing.assert_array_equal(problem.solved(1.0, problem.ones(), lambda: False), problem.ones())


def test_smoothness_is_the_heaviest_within_one_standard_error_of_the_best() -> None:
    """Lighter trials predict each of two views better by turns, then both, then worse."""
    left = [[9.0, 9.0], [5.0, 4.2], [4.0, 5.0], [6.0, 6.0], [7.0, 7.0]]  # the second is within chance of the third
    trials = iter(left)
    fit: Any = SimpleNamespace(solved=lambda smooth, factors, go_on, steps: factors)
    judge: Any = SimpleNamespace(data=np.zeros((2, 1, 1)), left=lambda factors: np.array(next(trials)))
    heaviest, _ = smoothness(fit, judge, cast(F32, None), lambda: True), next(trials, None)
    second = heaviest[0]
    assert heaviest[1] == 9.2
    clear = iter([[9.0, 9.0], [5.4, 6.1], [4.0, 5.0], [6.0, 6.0], [7.0, 7.0]])  # here it is not
    judge.left = lambda factors: np.array(next(clear))
    third = smoothness(fit, judge, cast(F32, None), lambda: True)
    assert third[1] == 9.0 and third[0] < second
