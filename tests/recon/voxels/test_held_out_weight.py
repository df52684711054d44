"""Views held out find the weight: lighter than the one by the noise where that hides detail, or much heavier."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import recon
from recon import FistaTv, OsSirtTv
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.noise import noise_level
from recon.base.volume import Grid, Volume
from recon.kernels.cpu.activation import F32
from recon.voxels.held_out_weight import (
    LEAST_VIEWS,
    bregman_weight,
    busiest_rows,
    heaviest_weight,
    preferred_sweeps,
    preferred_weight,
    slab_of,
    split_views,
)
from recon.voxels.iterative import solve
from recon.voxels.noise_balance import NoiseBalance
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import VoxelProblem

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


@pytest.mark.parametrize("method", [FistaTv(), OsSirtTv()], ids=lambda m: m.name)
def test_a_texture_survives(
    foam: tuple[F32, Geometry, Grid, F32], method: recon.Method, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, geometry, grid, truth = foam
    peak = float(truth.max())
    found = recon.reconstruct(data, geometry, method, grid=grid).volume.data
    monkeypatch.setattr("recon.voxels.held_out_weight.preferred_weight", lambda *_: None)
    by_noise = recon.reconstruct(data, geometry, method, grid=grid).volume.data
    monkeypatch.setattr("recon.voxels.noise_balance.noise_beside_structure", lambda lines, _: noise_level(lines))
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
    monkeypatch.setattr("recon.voxels.held_out_weight.preferred_weight", lambda *_: None)
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


def test_a_crack_under_few_photons_stays_nearly_as_deep_as_in_fbp(
    cracked: tuple[F32, Geometry], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = _depth(recon.reconstruct(*cracked, FistaTv()).volume.data)
    monkeypatch.setattr("recon.voxels.held_out_weight.preferred_weight", lambda *_: None)
    by_noise = _depth(recon.reconstruct(*cracked, FistaTv()).volume.data)
    fbp = _depth(recon.reconstruct(*cracked, "fbp").volume.data)
    assert by_noise < 0.8 * fbp
    assert found > 0.9 * fbp


@pytest.mark.parametrize("best", [0.05, 0.3, 0.7, 1.0, 1.3, 1.5, 10.0, 20.0])
def test_the_weight_with_the_smallest_error_is_found(best: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error that is a parabola of log μ has its vertex where a parabola through three points has it."""
    _errors(best, monkeypatch)
    found = preferred_weight(_views(), 3.0)
    assert found is not None and found.weight == pytest.approx(3.0 * best)
    assert 1 <= found.residual <= 1 + math.log(math.sqrt(2)) ** 2


@pytest.mark.parametrize(("heaviest", "best"), [(5, 5), (4, 3.5), (9, 5)])
def test_from_weights_that_change_nothing_the_search_goes_on_to_heavier_ones(
    heaviest: int, best: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a measured walnut of 25 views: level over three octaves, with a rise of 0.02 % each; then it falls."""

    def error(weight: float) -> float:
        octave = round(math.log2(weight / 3.0))
        return 1.08 + 0.0002 * octave if octave < 3 else 1 + abs(octave - heaviest + (heaviest == 4) / 2) / 100

    monkeypatch.setattr("recon.voxels.held_out_weight.WeightTrial", Mock(of=lambda problem: error))
    found = preferred_weight(_views(), 3.0)
    assert found is not None and math.log2(found.weight / 3.0) == pytest.approx(best)


@pytest.mark.parametrize(
    ("once", "less_heavy", "heavy", "found"),
    [(3, 2, 1, 6.0), (3, 1, 2, 5.0), (3, 1.9995, 2, 6.0), (1, 2, 3, None), (1, 0.998, 0.999, None)],
)
def test_two_runs_are_taken_where_they_predict_unseen_views_better(
    once: float, less_heavy: float, heavy: float, found: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = {(2.0, False): once, (5.0, True): less_heavy, (6.0, True): heavy}
    trial = Mock(of=lambda problem: lambda weight, twice=False: errors[weight, twice])
    monkeypatch.setattr("recon.voxels.held_out_weight.WeightTrial", trial)
    assert bregman_weight(_views(), 2.0) == found


def test_one_run_is_not_tried_again_where_two_are_clearly_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[bool] = []

    def error(weight: float, twice: bool = False) -> float:
        tried.append(twice)
        return 2.0

    monkeypatch.setattr("recon.voxels.held_out_weight.WeightTrial", Mock(of=lambda problem: error))
    assert bregman_weight(_views(), 2.0, 1.9) is None and tried == [True]


def _errors(best: float, monkeypatch: pytest.MonkeyPatch) -> None:
    trial = Mock(of=lambda problem: lambda weight: 1 + math.log(weight / (3.0 * best)) ** 2)
    monkeypatch.setattr("recon.voxels.held_out_weight.WeightTrial", trial)


def _views() -> Mock:
    return Mock(**{"projector.geometry": Geometry.parallel(np.linspace(0, 3, 40), (4, 8), pixel_pitch=1.0)})


@dataclass
class _Asked:
    """An iteration that only asks how many sweeps views held out prefer."""

    iterations: int = 4
    sweeps: int = 0

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        self.sweeps = preferred_sweeps(problem, x, NoiseBalance.of(problem, x, True).first / 4, self.iterations)
        return x


@pytest.mark.parametrize(("blur", "slices", "more"), [(2.0, ROWS, True), (0.0, ROWS, False), (2.0, ROWS // 2, False)])
def test_more_sweeps_are_made_from_a_volume_that_lacks_detail(
    foam: tuple[F32, Geometry, Grid, F32], blur: float, slices: int, more: bool
) -> None:
    """And none from the truth, which they can only spoil, nor where slices are not those of rows."""
    data, geometry, grid, truth = foam
    start = gaussian_filter(truth, blur).reshape(slices, -1, COLS, COLS).mean(axis=1)
    fewer = replace(grid, shape=(slices, COLS, COLS), slice_pitch=ROWS / slices)
    solve(asked := _Asked(), Projector(geometry, fewer), data, start=Volume(start, fewer))
    assert asked.sweeps == (12 if more else 4)


def test_a_cone_and_few_views_have_no_weight_by_views_held_out() -> None:
    few, cone = Geometry.parallel(np.linspace(0, 3, 15), (4, 8)), Geometry.cone(np.linspace(0, 6, 40), (4, 8), 1, 9, 20)
    for geometry in (few, cone):
        assert preferred_weight(Mock(**{"projector.geometry": geometry}), 1.0) is None


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


def test_coarse_voxels_of_a_cone_get_the_weight_that_views_held_out_allow(
    coarse_cone: tuple[F32, Geometry, Grid, F32], monkeypatch: pytest.MonkeyPatch
) -> None:
    data, geometry, grid, truth = coarse_cone
    found = recon.reconstruct(data, geometry, FistaTv(), grid=grid).volume.data
    monkeypatch.setattr("recon.voxels.held_out_weight.heaviest_weight", lambda *_: None)
    by_noise = recon.reconstruct(data, geometry, FistaTv(), grid=grid).volume.data
    assert psnr(truth, found) > psnr(truth, by_noise) + 0.5


def test_the_weight_of_a_cone_is_left_to_the_noise(coarse_cone: tuple[F32, Geometry, Grid, F32]) -> None:
    """Where heavier ones predict worse, the middle rows show little, voxels are as fine as pixels, or rows are few."""
    data, geometry, grid, _ = coarse_cone

    def weight(views: F32, first: float, grid: Grid = grid, geometry: Geometry = geometry) -> float | None:
        lines = np.ascontiguousarray(views.swapaxes(1, 2))
        return heaviest_weight(
            VoxelProblem(Projector(geometry, grid), lines, None, True, np.random.default_rng(0), lambda *_: True), first
        )

    assert weight(data, 3.0) is None
    above = data.copy()
    above[:, 8:] = 0
    assert weight(above, 1e-6) is None
    assert weight(data, 1e-6) is not None
    assert weight(data, 1e-6, grid=Grid.matching(geometry)) is None
    assert weight(data[:, 8:56], 1e-6, geometry=geometry.rows(8, 56)) is None


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


@pytest.mark.parametrize(
    ("errors", "sweeps"),
    [([1.0, 0.97, 0.95], 24), ([1.0, 0.95, 0.97], 8), ([1.0, 0.995, 0.992], 8), ([1.0, 1.1], 8), ([], 8)],
)
def test_more_sweeps_have_to_bring_unseen_views_nearer(
    errors: list[float], sweeps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Round for round."""
    monkeypatch.setattr("recon.voxels.held_out_weight.residuals_of_rounds", lambda *_: errors)
    assert preferred_sweeps(_views(), np.zeros(1, np.float32), 1.0, 8) == sweeps
