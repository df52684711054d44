"""Half voxels: when they are used, what they gain on exact line integrals, and that they can be stopped."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.base.choices import Quality
from recon.base.decisions import Decisions, GoesOn, Prior, always
from recon.base.geometry import Geometry
from recon.base.method import Progress, ReconProblem, RunControl
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.error_bars import error_bars_memory
from recon.kernels.cpu.tv import total_variation
from recon.voxels.choice import TrialChoice
from recon.voxels.half_voxels import (
    COST,
    HALF_VOXEL_WEIGHTS,
    HALVES,
    LARGEST_LOSS,
    HalfVoxels,
    best_half_voxel_weight,
    halved,
    predict_as_well_as,
    uses_half_voxels,
    with_halves,
)
from recon.voxels.iterative import scaled_problem
from recon.voxels.projector import Projector
from recon.voxels.trial import Trial
from recon.voxels.voxel_problem import difference_weights


def packed() -> list[tuple[float, float, float, float]]:
    """A disc full of small ones: (x, y, radius) in pixels, and the density that each adds."""
    rng, discs = np.random.default_rng(5), [(0.0, 0.0, 29.0, 0.02)]
    while len(discs) < 45:
        (x, y), radius = rng.uniform(-26, 26, 2), rng.uniform(2, 4)
        if np.hypot(x, y) + radius < 28 and all(np.hypot(x - a, y - b) > radius + r for a, b, r, _ in discs[1:]):
            discs.append((x, y, radius, 0.03))
    return discs


DISCS = packed()
SIDE, ROWS = 64, 3


def geometry_of(views: int, columns: int = SIDE, rows: int = ROWS) -> Geometry:
    return Geometry.parallel(np.linspace(0, np.pi, views, endpoint=False), (rows, columns), pixel_pitch=1.0)


def exact_views(geometry: Geometry) -> np.ndarray:
    """Line integrals of the discs, averaged over each pixel."""
    u = (np.arange(8 * SIDE) - 4 * SIDE + 0.5) / 8
    lines = np.zeros((geometry.n_views, u.size))
    for x, y, radius, density in DISCS:
        away = u - (x * np.cos(geometry.angles) + y * np.sin(geometry.angles))[:, None]
        lines += 2 * density * np.sqrt(np.maximum(radius**2 - away**2, 0))
    pixels = lines.reshape(geometry.n_views, SIDE, 8).mean(2)
    return np.repeat(pixels[:, None], geometry.detector_shape[0], axis=1).astype(np.float32)


def truth() -> np.ndarray:
    """[y, x] mean density of each voxel."""
    at = (np.arange(8 * SIDE) - 4 * SIDE + 0.5) / 8
    fine = sum(d * (np.hypot(at - x, at[:, None] - y) < r) for x, y, r, d in DISCS)
    return np.asarray(fine).reshape(SIDE, 8, SIDE, 8).mean((1, 3))


def error_of(volume: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(volume - truth()))))


@pytest.mark.parametrize(
    ("wanted", "views", "columns", "used"),
    [(None, 21, 64, True), (None, 22, 64, False), (True, 90, 64, True), (False, 12, 64, False),
     (None, 180, 1024, True), (None, 180, 2048, False), (True, 180, 2048, True)],
)  # fmt: skip
def test_few_projections_use_them(wanted: bool | None, views: int, columns: int, used: bool) -> None:
    geometry = geometry_of(views, columns)
    assert uses_half_voxels(wanted, geometry, Grid.matching(geometry)) is used


@pytest.mark.parametrize(("views", "used"), [(21, True), (63, True), (64, False)])
def test_with_levels_up_to_as_many_projections_as_columns(views: int, used: bool) -> None:
    geometry = geometry_of(views)
    assert recon.Discrete().halves(geometry, Grid.matching(geometry)) is used


def test_never_in_voxels_that_are_already_narrow() -> None:
    geometry = geometry_of(12)
    assert not uses_half_voxels(True, geometry, halved(Grid.matching(geometry)))


def test_by_default_in_a_box_as_wide_as_the_sample() -> None:
    geometry = geometry_of(12, 512)
    wide = Grid.matching(geometry)
    assert uses_half_voxels(None, geometry, replace(wide, shape=(ROWS, 1024, 1024)))
    assert not uses_half_voxels(None, geometry, replace(wide, shape=(ROWS, 1026, 1026)))
    assert not uses_half_voxels(None, geometry_of(12), replace(wide, shape=(ROWS, 3 * SIDE, 3 * SIDE)))


def test_only_on_request_in_a_cone() -> None:
    cone = Geometry.cone(np.linspace(0, 2 * np.pi, 12), (ROWS, SIDE), pixel_pitch=1.0, sod=200.0, sdd=400.0)
    assert not uses_half_voxels(None, cone, Grid.matching(cone))
    assert uses_half_voxels(True, cone, Grid.matching(cone))


def test_total_variation_doubles_so_that_half_the_weight_is_the_same_prior() -> None:
    step = np.zeros((16, 16, 4), np.float32)
    step[:, 8:] = 0.7
    grid = Grid.matching(Geometry.parallel(np.zeros(1), (4, 16), pixel_pitch=1.0))
    fine = np.repeat(np.repeat(step, 2, axis=0), 2, axis=1)
    of_whole, of_halves = (total_variation(x, difference_weights(g)) for x, g in ((step, grid), (fine, halved(grid))))
    assert of_halves == pytest.approx(2 * of_whole, rel=1e-6)


@pytest.mark.parametrize("views", [20, 40])
def test_discs_are_closer_to_the_truth(views: int) -> None:
    geometry = geometry_of(views)
    data = np.random.default_rng(1).normal(exact_views(geometry), 0.01).astype(np.float32)
    whole, halves = (
        error_of(recon.reconstruct(data, geometry, method=recon.Discrete(half_voxels=wanted)).volume.data)
        for wanted in (False, None)
    )
    assert halves < 0.92 * whole


def test_total_variation_is_not_farther_from_the_truth() -> None:
    geometry = geometry_of(20)
    views = np.random.default_rng(1).normal(exact_views(geometry), 0.01).astype(np.float32)
    whole, halves = (
        error_of(recon.reconstruct(views, geometry, method=recon.FistaTv(half_voxels=wanted)).volume.data)
        for wanted in (False, True)
    )
    assert halves < whole


def test_a_sample_wider_than_the_field_is_closer_to_the_truth() -> None:
    views = np.random.default_rng(1).normal(exact_views(geometry_of(30)), 0.01).astype(np.float32)
    first, width = 12, 40
    geometry = geometry_of(30, width)
    away = np.arange(width) - (width - 1) / 2
    seen = np.hypot(away[:, None], away) < 0.9 * width / 2
    errors = []
    for wanted in (False, True):
        made = recon.reconstruct(views[:, :, first : first + width], geometry, recon.Discrete(half_voxels=wanted))
        assert made.outside is not None
        true = truth()[first : first + width, first : first + width]
        errors.append(np.sqrt(np.mean(np.square(made.volume.data - true)[:, seen])))
    assert errors[1] < 0.9 * errors[0]


def test_the_record_says_how_many_iterations_used_them() -> None:
    geometry = geometry_of(20)
    result = recon.reconstruct(exact_views(geometry), geometry, method="fista-tv")
    own, all_of_them = result.settings["half_voxel_iterations"], result.settings["ended_after"]
    assert 0 < own < all_of_them
    assert result.history[-1].step == all_of_them - own + COST * own
    assert result.volume.data.shape == (ROWS, SIDE, SIDE)


def trial_of(views: np.ndarray, geometry: Geometry, trials: Callable[[int, float], bool] = always) -> Trial:
    projector, go_on = Projector(geometry, Grid.matching(geometry)), GoesOn(trials=GoesOn(trials))
    scan, _ = scaled_problem(projector, Views(views, geometry), None, True, go_on, Decisions())
    trial = Trial.of(scan)
    assert trial is not None
    return trial


def test_they_are_rejected_if_whole_voxels_predict_better() -> None:
    """Projections computed from whole voxels are predicted exactly by these voxels, and less well by half voxels."""
    geometry = geometry_of(20)
    volume = np.repeat(truth()[None], ROWS, 0).astype(np.float32)
    exact = trial_of(recon.Projector(geometry, Grid.matching(geometry)).forward(volume), geometry)
    whole = exact.lines_of(Volume(volume, Grid.matching(geometry)))
    assert best_half_voxel_weight(exact, whole, 1e-3, HALF_VOXEL_WEIGHTS[:1], LARGEST_LOSS) == 0
    assert best_half_voxel_weight(exact, whole, 1e-2, HALF_VOXEL_WEIGHTS, LARGEST_LOSS) == 0
    noisy = np.random.default_rng(1).normal(exact_views(geometry), 0.01).astype(np.float32)
    trial = trial_of(noisy, geometry)
    assert trial.weight is not None
    assert recon.FistaTv().half_voxel_weight_of(trial, Prior(trial.weight)) == 1


def test_a_smaller_weight_is_tested_before_they_are_rejected() -> None:
    """With a smaller weight, half voxels explain these exact projections, too."""
    geometry = geometry_of(20)
    volume = np.repeat(truth()[None], ROWS, 0).astype(np.float32)
    exact = trial_of(recon.Projector(geometry, Grid.matching(geometry)).forward(volume), geometry)
    whole = exact.lines_of(Volume(volume, Grid.matching(geometry)))
    assert 0 < best_half_voxel_weight(exact, whole, 1e-3, HALF_VOXEL_WEIGHTS, LARGEST_LOSS) < 1
    assert recon.FistaTv(tv_weight=1e-3).half_voxel_weights == (1,)  # the weight of the caller is kept


def test_the_weight_on_half_voxels_is_a_share_of_that_on_whole_voxels() -> None:
    geometry, decide = geometry_of(20), Decisions()
    views = np.random.default_rng(1).normal(exact_views(geometry), 0.01).astype(np.float32)
    method = recon.FistaTv(tv_weight=1e-3)
    recon.reconstruct(views, geometry, method, control=RunControl(decide=decide))

    def variation(share: float) -> float:
        control = RunControl(decide=Decisions(0, {**decide.made, HALVES: [share]}))
        volume = recon.reconstruct(views, geometry, method, control=control).volume.data
        return float(np.abs(np.diff(volume, axis=1)).sum() + np.abs(np.diff(volume, axis=2)).sum())

    assert variation(0.35) > 1.02 * variation(1)


@pytest.mark.parametrize("method", [recon.FistaTv(), recon.Discrete(), recon.Auto()])
def test_the_decision_is_made_once_and_followed(method: recon.FistaTv | recon.Discrete | recon.Auto) -> None:
    geometry, decide = geometry_of(20), Decisions()
    views = np.random.default_rng(1).normal(exact_views(geometry), 0.01).astype(np.float32)
    used = recon.reconstruct(views, geometry, method, control=RunControl(decide=decide))
    assert decide.made[HALVES] == [1] and used.settings["half_voxel_iterations"] > 0
    control = RunControl(decide=Decisions(0, {**decide.made, HALVES: [0]}))
    assert "half_voxel_iterations" not in recon.reconstruct(views, geometry, method, control=control).settings


def test_auto_tests_them_for_the_method_that_it_chose() -> None:
    geometry = geometry_of(20)
    views = np.random.default_rng(1).normal(exact_views(geometry), 0.01).astype(np.float32)
    problem = ReconProblem(Views(views, geometry), Grid.matching(geometry))
    choice = recon.Auto().choose(problem, RunControl())
    assert choice.prior is not None and choice.prior.half_voxel_weight == 1
    never = recon.Auto().with_quality("preview", 0).choose(problem, RunControl())
    assert never.prior is not None and never.prior.half_voxel_weight is None


def test_a_stop_leaves_them_out() -> None:
    geometry, seen = geometry_of(20), list[Progress]()
    problem = ReconProblem(Views(exact_views(geometry), geometry), Grid.matching(geometry))
    control = RunControl(lambda: len(seen) >= 3, on_progress=seen.append)
    result = recon.FistaTv(tv_weight=0.01, half_voxels=True).run(problem, control)
    assert "half_voxel_iterations" not in result.settings
    assert result.settings["ended"] == "stopped"


def test_a_stop_within_their_test_does_not_reject_them() -> None:
    geometry, stopped = geometry_of(20), [False]
    volume = np.repeat(truth()[None], ROWS, 0).astype(np.float32)
    exact_data = recon.Projector(geometry, Grid.matching(geometry)).forward(volume)
    trial = trial_of(exact_data, geometry, lambda step, _: not (stopped[0] and step > 2))
    whole = trial.lines_of(Volume(volume, Grid.matching(geometry)))
    assert best_half_voxel_weight(trial, whole, 1e-2, HALF_VOXEL_WEIGHTS, LARGEST_LOSS) == 0
    stopped[0] = True
    assert best_half_voxel_weight(trial, whole, 1e-2, HALF_VOXEL_WEIGHTS, LARGEST_LOSS) == 1 and trial.ended


def test_a_test_that_diverged_rejects_them() -> None:
    whole = np.ones(3)
    assert not predict_as_well_as(np.array([1.0, np.nan, 1.0]), whole, 0.01)
    assert predict_as_well_as(1.005 * whole, whole, 0.01) and not predict_as_well_as(1.015 * whole, whole, 0.01)


def test_the_record_states_a_smaller_weight() -> None:
    geometry = geometry_of(20)
    for share, recorded in ((0.5, 0.5), (1, None), (0, None)):
        control = RunControl(decide=Decisions(0, {HALVES: [share]}))
        result = recon.reconstruct(exact_views(geometry), geometry, recon.FistaTv(tv_weight=1e-3), control=control)
        assert result.settings.get("half_voxel_weight") == recorded


def test_a_slab_that_follows_decisions_is_the_same_to_the_bit() -> None:
    geometry = geometry_of(20)
    problem = ReconProblem(Views(exact_views(geometry), geometry), Grid.matching(geometry))
    decide = Decisions()
    first = recon.FistaTv().run(problem, RunControl(decide=decide))
    again = recon.FistaTv().run(problem, RunControl(decide=Decisions(0, decide.made)))
    np.testing.assert_array_equal(first.volume.data, again.volume.data)


def test_memory_counts_four_times_the_volume_only_with_few_projections() -> None:
    few, many = geometry_of(20, rows=64), geometry_of(60, rows=64)
    method = recon.FistaTv()
    never = replace(method, half_voxels=False)
    grid = Grid.matching(few)
    volume = 4 * np.prod(grid.shape)
    assert method.memory(few, grid, False) > 4 * method.buffers.volumes * volume > never.memory(few, grid, False)
    assert method.memory(many, grid, False) == never.memory(many, grid, False)


@pytest.mark.parametrize("method", [recon.FistaTv(2, half_voxels=True), recon.Discrete(2, half_voxels=True)])
def test_the_stated_memory_is_that_of_the_peak(method: recon.FistaTv | recon.Discrete) -> None:
    geometry = geometry_of(20, 2 * SIDE, 24)  # in fewer columns the coarse cells of damping are a part of the volume
    views = np.repeat(exact_views(geometry), 2, axis=2)
    problem = ReconProblem(Views(views, geometry), Grid.matching(geometry))
    method.run(problem, RunControl())  # loads kernels
    tracemalloc.start()
    method.run(problem, RunControl())
    peak, stated = tracemalloc.get_traced_memory()[1], method.memory(geometry, problem.grid, False)
    tracemalloc.stop()
    assert 0.75 * stated < peak < stated


def test_what_never_uses_half_voxels_states_the_memory_of_whole_ones() -> None:
    few = geometry_of(20, rows=64)
    grid = Grid.matching(few)
    halves = recon.FistaTv().memory(few, grid, True)
    assert recon.PnpDct().memory(few, grid, True) < halves
    assert error_bars_memory(recon.FistaTv(), few, grid) < halves
    assert error_bars_memory(recon.FistaTv(), few, grid) == error_bars_memory(
        with_halves(recon.FistaTv(), False), few, grid
    )


def test_a_trial_with_a_given_weight_compares_whole_voxels() -> None:
    geometry = geometry_of(20)
    trial = trial_of(exact_views(geometry), geometry)
    left = [
        recon.FistaTv(tv_weight=1e-3, half_voxels=wanted).predict(trial, TrialChoice("")).residuals
        for wanted in (False, True)
    ]
    assert left[0] is not None and left[0] == left[1]


def test_best_uses_them_and_a_preview_does_not() -> None:
    wanted = {
        quality: recon.FistaTv().with_quality(quality, 0).half_voxels for quality in ("preview", "standard", "best")
    }
    assert wanted == {"preview": False, "standard": None, "best": True}


def test_auto_passes_the_preset_to_its_candidates() -> None:
    def wanted(quality: Quality) -> set[bool | None]:
        candidates = recon.Auto().with_quality(quality, 0).candidates
        return {each.half_voxels for each in candidates if isinstance(each, HalfVoxels)}

    assert [wanted("preview"), wanted("standard"), wanted("best")] == [{False}, {None}, {True}]


def test_columns_without_weight_keep_the_gain_although_steps_are_not_damped() -> None:
    geometry = geometry_of(20)
    views = np.random.default_rng(1).normal(exact_views(geometry), 0.01).astype(np.float32)
    weights = np.ones_like(views)
    weights[:, :, [10, 33]] = 0
    whole, halves = (
        recon.reconstruct(
            views, geometry, method=recon.Discrete(half_voxels=wanted), use=recon.DataUse(weights=weights)
        )
        for wanted in (False, True)
    )
    assert error_of(halves.volume.data) < 0.95 * error_of(whole.volume.data)


@pytest.mark.parametrize(("width", "used"), [(1.0, True), (0.8, False), (1.5, False)])
def test_by_default_only_in_voxels_as_wide_as_pixels(width: float, used: bool) -> None:
    geometry = geometry_of(12)
    grid = replace(Grid.matching(geometry), voxel_size=width)
    assert uses_half_voxels(None, geometry, grid) is used
