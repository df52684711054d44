"""Held-out projections: the rule, and the weight it finds, compared with the weight from the noise."""

from __future__ import annotations

import math
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import recon
from recon import FistaTv, OsSirtTv
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.noise import noise_level
from recon.base.view_data import split_views
from recon.base.volume import Grid
from recon.kernels.cpu.activation import F32
from recon.voxels.choice import BestStrength
from recon.voxels.field_edges import busiest_rows, columns_of_matter, slab_of
from recon.voxels.held_out import LEAST_VIEWS
from recon.voxels.iterative import solve
from recon.voxels.methods import EarlyTv
from recon.voxels.priors import pnp_dct
from recon.voxels.projector import Projector
from recon.voxels.trial import Trial, TrialSettings, choose_weight
from recon.voxels.voxel_problem import VoxelProblem
from tests.slow_cases import others_slow

VIEWS, ROWS, COLS, PHOTONS = 40, 16, 64, 1000


@pytest.fixture(scope="module")
def foam() -> tuple[F32, Geometry, Grid, F32]:
    """Struts with a fine texture, which total variation by the noise alone makes even: line integrals and truth."""
    rng = np.random.default_rng(4)
    shape = (ROWS, COLS, COLS)
    struts, texture = (gaussian_filter(rng.normal(size=shape), s) for s in (1.5, 0.6))
    _, y, x = np.indices(shape) - 31.5
    truth = np.where((struts > 0.3 * struts.std()) & (np.hypot(x, y) < 29), 0.7 + 0.08 * texture / texture.std(), 0)
    geometry = Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), (ROWS, COLS), pixel_pitch=1.0)
    grid = Grid.matching(geometry)
    clean = Projector(geometry, grid).forward(truth.astype(np.float32))
    scale = 2 / clean.max()
    counts = np.maximum(rng.poisson(PHOTONS * np.exp(-scale * clean)), 1)
    return -np.log(counts / PHOTONS).astype(np.float32), geometry, grid, (scale * truth).astype(np.float32)


@pytest.mark.parametrize("method", others_slow([FistaTv(), OsSirtTv()]), ids=lambda m: m.name)
def test_a_texture_survives(
    foam: tuple[F32, Geometry, Grid, F32], method: recon.Method, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, geometry, grid, truth = foam
    peak = float(truth.max())
    found = recon.reconstruct(data, geometry, method, grid=grid).volume.data
    monkeypatch.setattr("recon.voxels.trial.preferred_strength", lambda *_: None)
    by_noise = recon.reconstruct(data, geometry, method, grid=grid).volume.data
    monkeypatch.setattr("recon.voxels.priors.noise_beside_structure", lambda lines, _: noise_level(lines))
    by_texture = recon.reconstruct(data, geometry, method, grid=grid).volume.data  # the texture counts as noise
    assert psnr(truth, found, peak) > psnr(truth, by_texture, peak) + 2
    assert psnr(truth, by_noise, peak) > psnr(truth, by_texture, peak) + 1


def test_an_even_disc_gets_little_more_noise_than_by_the_weight_by_the_noise(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    geometry = Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), (ROWS, COLS), pixel_pitch=1.0)
    _, y, x = np.indices((ROWS, COLS, COLS)) - 31.5
    truth = (np.hypot(x, y) < 25).astype(np.float32)
    data = Projector(geometry, Grid.matching(geometry)).forward(truth)
    data += rng.normal(0, 1, data.shape).astype(np.float32)
    found = recon.reconstruct(data, geometry, FistaTv()).volume.data
    monkeypatch.setattr("recon.voxels.trial.preferred_strength", lambda *_: None)
    by_noise = recon.reconstruct(data, geometry, FistaTv()).volume.data
    assert psnr(truth, found) > psnr(truth, by_noise) - 1


def test_faint_matter_around_metal_is_more_even_than_in_fbp(rng: np.random.Generator) -> None:
    """By its noise alone the scan gets a weight for the metal, whose edges are most of the variation."""
    geometry = Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), (ROWS, COLS), pixel_pitch=1.0)
    _, y, x = np.indices((ROWS, COLS, COLS)) - 31.5
    truth = np.where(np.hypot(x, y) < 26, 0.002, 0) + np.where(np.hypot(x - 4, y) < 5, 0.2, 0)
    data = Projector(geometry, Grid.matching(geometry)).forward(truth.astype(np.float32))
    data += (rng.normal(0, 0.01, data.shape) * np.exp(data / 2)).astype(np.float32)
    faint = (np.hypot(x, y) < 24) & (np.hypot(x - 4, y) > 8)
    found, fbp = (recon.reconstruct(data, geometry, m).volume.data[faint].std() for m in (FistaTv(), recon.Fbp()))
    assert found < 0.6 * fbp


@pytest.fixture(scope="module")
def cracked() -> tuple[F32, Geometry]:
    """A disc with a straight crack two pixels wide and 0.9 deep, from 80 views of 300 photons a pixel."""
    rng = np.random.default_rng(2)
    geometry = Geometry.parallel(np.linspace(0, np.pi, 80, endpoint=False), (ROWS, COLS), pixel_pitch=1.0)
    fine = Geometry.parallel(geometry.angles, (ROWS, 2 * COLS), pixel_pitch=0.5)
    _, y, x = (np.indices((ROWS, 2 * COLS, 2 * COLS)) - 63.5) / 2
    truth = np.where((abs(y) < 1) & (abs(x) < 14), 0.1, 1.0) * (np.hypot(x, y) < 27) * 0.028
    clean = Projector(fine, Grid((ROWS, 2 * COLS, 2 * COLS), 0.5, slice_pitch=0.5)).forward(truth.astype(np.float32))
    light = np.exp(-clean).reshape(80, ROWS, COLS, 2).mean(axis=3)
    return -np.log(np.maximum(rng.poisson(300 * light), 0.5) / 300).astype(np.float32), geometry


def _depth(volume: F32) -> float:
    profile = volume[:, :, 20:44].mean(axis=(0, 2), dtype=np.float64)
    return 1 - float(profile[31:33].mean() / profile[[26, 27, 28, 35, 36, 37]].mean())


@pytest.mark.slow
def test_a_crack_under_few_photons_stays_nearly_as_deep_as_in_fbp(
    cracked: tuple[F32, Geometry], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = _depth(recon.reconstruct(*cracked, FistaTv()).volume.data)
    monkeypatch.setattr("recon.voxels.trial.preferred_strength", lambda *_: None)
    by_noise = _depth(recon.reconstruct(*cracked, FistaTv()).volume.data)
    fbp = _depth(recon.reconstruct(*cracked, "fbp").volume.data)
    assert by_noise < 0.8 * fbp
    assert found > 0.9 * fbp


def test_few_views_are_not_held_out() -> None:
    few = Geometry.parallel(np.linspace(0, 3, LEAST_VIEWS - 1), (4, 8))
    assert Trial.of(Mock(**{"projector.geometry": few})) is None


@pytest.fixture(scope="module")
def coarse_cone() -> tuple[F32, Geometry, Grid, F32]:
    """Grains in a cone on voxels of twice the width that their views come from: line integrals and truth."""
    fine = np.zeros((48, 64, 64), np.float32)
    rng = np.random.default_rng(1)
    z, y, x = np.indices(fine.shape)
    for centre, radius in zip(rng.uniform(16, 32, (40, 3)) * (1, 1.5, 1.5), rng.uniform(3, 7, 40), strict=True):
        fine[np.hypot(np.hypot(z - centre[0], y - 8 - centre[1] / 1.2), x - 8 - centre[2] / 1.2) < radius] = 0.02
    geometry = Geometry.cone(np.linspace(0, 2 * np.pi, 32, endpoint=False), (64, 80), 1.4, 300.0, 420.0)
    clean = Projector(geometry, Grid(fine.shape, 1.0)).forward(fine)
    data = clean + rng.normal(0, 1e-3, clean.shape)
    return data.astype(np.float32), geometry, Grid((24, 32, 32), 2.0), fine.reshape(24, 2, 32, 2, 32, 2).mean((1, 3, 5))


@pytest.mark.slow
def test_coarse_voxels_of_a_cone_get_the_weight_that_views_held_out_allow(
    coarse_cone: tuple[F32, Geometry, Grid, F32], monkeypatch: pytest.MonkeyPatch
) -> None:
    data, geometry, grid, truth = coarse_cone
    found = recon.reconstruct(data, geometry, FistaTv(), grid=grid).volume.data
    monkeypatch.setattr("recon.voxels.trial.preferred_strength", lambda *_: None)
    early = recon.reconstruct(data, geometry, EarlyTv(), grid=grid).volume.data
    finished = recon.reconstruct(data, geometry, FistaTv(), grid=grid).volume.data
    assert psnr(truth, found) > psnr(truth, early) + 0.5
    assert psnr(truth, found) > psnr(truth, finished) - 0.2  # a volume that is finished depends less on the weight


def test_one_view_of_eight_is_held_out_and_the_others_are_not() -> None:
    angles = np.random.default_rng(0).permutation(np.linspace(0, np.pi, 80, endpoint=False))
    seen, unseen = split_views(Geometry.parallel(angles, (4, 8), pixel_pitch=1.0))
    assert unseen.size == 10 and sorted([*seen, *unseen]) == list(range(80))
    np.testing.assert_allclose(np.diff(np.sort(angles[unseen])), np.pi / 10)
    assert LEAST_VIEWS == 16


def test_a_slab_is_where_most_matter_is_and_sees_its_own_slices() -> None:
    data = np.zeros((3, 40, 8), np.float32)
    data[:, 20:30] = 1
    rows = busiest_rows(data, 10)
    assert rows == slice(20, 30)
    geometry = Geometry.parallel(np.linspace(0, np.pi, 3), (40, 8), pixel_pitch=0.5)
    views, box = slab_of(geometry, Grid.matching(geometry), rows.start, rows.stop)
    volume = np.random.default_rng(1).random((40, 8, 8)).astype(np.float32)
    whole = Projector(geometry, Grid.matching(geometry)).forward(volume)
    np.testing.assert_allclose(Projector(views, box).forward(volume[rows]), whole[:, rows], rtol=1e-5)


def test_views_held_out_that_weigh_nothing_in_the_busiest_rows_leave_the_weight_by_the_noise(
    foam: tuple[F32, Geometry, Grid, F32],
) -> None:
    data, geometry, grid, _ = (np.concatenate([foam[0], foam[0] / 2], axis=1), *foam[1:])
    geometry, grid = replace(geometry, detector_shape=(2 * ROWS, COLS)), replace(grid, shape=(2 * ROWS, COLS, COLS))
    weights = np.ones_like(data)
    weights[split_views(geometry)[1], :ROWS] = 0
    found = recon.reconstruct(data, geometry, FistaTv(iterations=1), grid=grid, use=recon.DataUse(weights=weights))
    assert np.isfinite(found.volume.data).all()


def test_trials_see_the_columns_with_matter() -> None:
    """A disc of a third of the field, off the axis: its voxels lie where those of the whole grid lie."""
    views = Geometry.parallel(np.linspace(0, np.pi, 32, endpoint=False), (4, 120), pixel_pitch=0.5, axis_col=57.3)
    grid = Grid.matching(views)
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    disc = (np.hypot(x - 4, y) < 10).astype(np.float32)
    images = Projector(views, grid).forward(disc)
    cropped = columns_of_matter(views, grid, images)
    assert cropped is not None
    cols, narrow, box = cropped
    kept = [np.isin(whole, part) for whole, part in zip(grid.coordinates(), box.coordinates(), strict=True)]
    inside = disc[np.ix_(*kept)]
    assert inside.shape == box.shape and inside.sum() == disc.sum()
    assert (
        narrow.detector_shape[1] < 80 and not images[:, :, : cols.start].any() and not images[:, :, cols.stop :].any()
    )
    again = Projector(narrow, box).forward(inside)
    np.testing.assert_allclose(again, images[:, :, cols], atol=1e-4 * images.max())
    full = np.ones_like(images)
    assert columns_of_matter(views, grid, full) is None


def _problem_of(data: F32, geometry: Geometry, weights: F32 | None = None, grid: Grid | None = None) -> VoxelProblem:
    """The problem of these views [view, row, col] as methods get it."""
    given: list[VoxelProblem] = []

    class Asking(FistaTv):
        def iterate(self, problem: VoxelProblem, x: F32) -> F32:
            given.append(problem)
            return x

    solve(Asking(), Projector(geometry, grid or Grid.matching(geometry)), data.copy(), weight=weights)
    return given[0]


def _trial_of(data: F32, geometry: Geometry, weights: F32 | None = None, early: bool = False) -> Trial:
    trial = Trial.of(_problem_of(data, geometry, weights), TrialSettings(early=early))
    assert trial is not None
    return trial


def test_a_box_of_one_and_a_half_fields_is_wide_and_one_that_matches_is_not() -> None:
    geometry = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (4, 32))
    for cols, wide in ((32, False), (48, True)):
        trial = Trial.of(_problem_of(np.ones((24, 4, 32), np.float32), geometry, grid=Grid((4, cols, cols))))
        assert trial is not None and trial.wide is wide


def test_volumes_of_a_trial_have_the_density_of_a_sample_beyond_the_field() -> None:
    """From FBP 1.19 of it, as the matter beside the field came last; levels of materials were wrong by as much."""
    geometry = Geometry.parallel(np.linspace(0, np.pi, 48, endpoint=False), (4, 32), pixel_pitch=1.0)
    box = Grid((4, 96, 96), 1.0)
    _, y, x = np.indices(box.shape) - 47.5
    away = np.hypot(x, y)
    data = Projector(geometry, box).forward((away < 46).astype(np.float32))
    trial = Trial.of(_problem_of(data, geometry, grid=box))
    assert trial is not None
    density = trial.volume_of_weight(0.02)[away[0] < 12].mean() * 2.0**trial.problem.units.density
    assert density == pytest.approx(1, abs=0.04)


@pytest.mark.parametrize("early", [True, False], ids=["20 sweeps", "until it stands still"])
@pytest.mark.parametrize("weighted", [False, True], ids=["even rays", "air weighs most"])
def test_columns_of_air_hardly_change_volumes_of_a_trial(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, weighted: bool, early: bool
) -> None:
    """Steps and the pull towards patches are shares of an eigenvalue that grows with the columns and their weights:
    without those of air, trials preferred other strengths than the volume needs, -0.8 dB on an emission."""
    geometry = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (4, 96), pixel_pitch=1.0)
    _, y, x = np.indices((4, 96, 96)) - 47.5
    truth = ((np.hypot(x, y) < 20) * (1 + 0.5 * (np.hypot(x - 6, y) < 6))).astype(np.float32)
    lines = Projector(geometry, Grid.matching(geometry)).forward(truth)
    data = lines + rng.normal(0, 0.3, lines.shape).astype(np.float32)
    weights = np.where(lines > 0, 0.2, 1).astype(np.float32) if weighted else None
    monkeypatch.setattr("recon.voxels.trial.STILL_IN_TRIAL", 0.0005)  # volumes are known to that share
    monkeypatch.setattr("recon.voxels.trial.MOST_SWEEPS", 300)
    narrow = _trial_of(data, geometry, weights, early)
    monkeypatch.setattr("recon.voxels.trial.columns_of_matter", lambda *_: None)
    wide = _trial_of(data, geometry, weights, early)
    off = (wide.start.shape[0] - narrow.start.shape[0]) // 2
    assert off > 5
    matter = np.hypot(x, y)[0, off:-off, off:-off] < 18
    for make in (
        lambda trial: trial.volume_of_weight(0.02 if early else 0.005),
        lambda trial: trial.volume_by(lambda part, first: pnp_dct(part, first, 0.01, steps=15)),
    ):
        few, many = make(narrow)[matter], make(wide)[off:-off, off:-off][matter]
        assert np.sqrt(np.mean((few - many) ** 2)) < 0.004 * np.sqrt(np.mean(many**2))


def test_all_views_get_the_weight_of_seven_eighths_by_the_root_of_their_number(
    foam: tuple[F32, Geometry, Grid, F32], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As much noise of a volume: without, -0.2 to -0.4 dB on bone and cement of 1000 photons."""
    problem = _problem_of(foam[0], foam[1])
    monkeypatch.setattr("recon.voxels.trial.preferred_strength", lambda *_: BestStrength(3.0, np.ones(5)))
    start = problem.filtered("hann")
    assert start is not None
    weight = choose_weight(problem, start, 20)
    assert weight.value == pytest.approx(3 * math.sqrt(8 / 7)) and not weight.by_noise
