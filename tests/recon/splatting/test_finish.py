"""Voxel refinement: a small system by hand, no change if nothing is missing, sharper edges, boxes in the field."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.assess.metrics import psnr
from recon.auto import Auto
from recon.base.geometry import Geometry
from recon.base.method import SWEEPS_OF_TRIALS, Progress, ReconProblem, RunControl
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.methods import build
from recon.reconstruction import reconstruct
from recon.splatting.finish import finish
from recon.splatting.gaussians import Gaussians
from recon.splatting.r2 import R2
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project, voxelize
from recon.voxels.beyond_field import reach_of
from recon.voxels.direct import Fbp
from recon.voxels.methods import FistaTv
from recon.voxels.projector import Projector
from tests.slow_cases import others_slow

F32 = NDArray[np.float32]
VIEWS = Geometry.parallel(np.linspace(0, math.pi, 30, endpoint=False), (8, 40))
GRID = Grid.matching(VIEWS)


def _blob(at: float = 0.0) -> Gaussians:
    return Gaussians.from_physical(np.array([[at, 2.0, 0.0]]), np.full((1, 3), 3.0), np.array([0.5]), density_unit=0.5)


def _box(grid: Grid = GRID) -> F32:
    """A piece of matter with edges: what Gaussians do badly."""
    z, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    return (0.3 * ((abs(x + 4) < 5) & (abs(y) < 8) & (abs(z) < 3))).astype(np.float32)


def _of(g: Gaussians, grid: Grid = GRID) -> Volume:
    return Volume(voxelize(g, grid).numpy(), grid)


def _problem(data: F32, weights: F32 | None = None, grid: Grid = GRID) -> ReconProblem:
    return ReconProblem(Views(data, VIEWS, weights), grid)


def test_a_model_that_explains_all_is_only_smoothed() -> None:
    g = _blob()
    volume = _of(g)
    finished = finish(volume, g, _problem(project(g, VIEWS).numpy()), 3).volume
    assert np.abs(finished.data - volume.data).max() < 0.02 * volume.data.max()


def test_voxels_add_what_the_gaussians_lack() -> None:
    g, missing = _blob(8.0), _box()
    data = project(g, VIEWS).numpy() + Projector(VIEWS, GRID).forward(missing)
    truth = _of(g).data + missing
    qualities = [psnr(truth, _of(g).data)]
    qualities += [psnr(truth, finish(_of(g), g, _problem(data), sweeps).volume.data) for sweeps in (1, 3, 9)]
    assert all(later > before + 1 for before, later in pairwise(qualities))
    assert qualities[-1] > 30


def test_sweeps_are_told_with_how_many_there_are() -> None:
    said: list[Progress] = []
    data = Projector(VIEWS, GRID).forward(_box())
    finish(_of(_blob()), _blob(), _problem(data), control=RunControl(on_progress=said.append))
    sweeps = [each for each in said if not each.unit.startswith(SWEEPS_OF_TRIALS)]
    assert [each.step for each in sweeps] == list(range(1, len(sweeps) + 1))
    assert {each.steps for each in sweeps} == {len(sweeps)}
    assert all(each.step <= each.steps for each in said) and len(said) > len(sweeps)


def test_what_lies_outside_the_box_stays_with_the_gaussians() -> None:
    # A box without the blob: its views must not be spread over what is inside.
    g = _blob(12.0)
    small = Grid((8, 40, 18), 1.0, (0.0, 0.0, -8.0))
    missing = _box(small)
    data = project(g, VIEWS).numpy() + Projector(VIEWS, small).forward(missing)
    finished = finish(_of(g, small), g, _problem(data), 16).volume
    assert psnr(missing + _of(g, small).data, finished.data) > 30


@pytest.mark.slow
def test_pixels_of_no_weight_or_not_finite_change_nothing() -> None:
    g = _blob(8.0)
    data = project(g, VIEWS).numpy() + Projector(VIEWS, GRID).forward(_box())
    bad = np.zeros(data.shape, bool)
    bad[:, 3:5, 7:9] = True
    volumes = []
    for value in (np.nan, np.inf):
        volumes.append(finish(_of(g), g, _problem(np.where(bad, np.float32(value), data)), 2).volume.data)
    np.testing.assert_array_equal(volumes[0], volumes[1])
    weights = (~bad).astype(np.float32)
    weighed = finish(_of(g), g, _problem(np.where(bad, np.float32(1), data), weights), 2).volume.data
    np.testing.assert_allclose(weighed, volumes[0], atol=1e-6)


@pytest.mark.slow
def test_reconstruct_finishes_and_says_so() -> None:
    data = Projector(VIEWS, GRID).forward(_box())
    plain, finished = (reconstruct(data, VIEWS, R2(steps=60, gaussians=300, finish=n)) for n in (0, 5))
    assert psnr(_box(), finished.volume.data) > psnr(_box(), plain.volume.data) + 0.5
    assert (plain.settings["finish"], finished.settings["finish"]) == (0, 5)
    assert "refinement" not in plain.settings and finished.settings["refinement"] == "fista-tv"
    # The model is the fit's, whatever voxels add.
    assert plain.gaussians is not None and finished.gaussians is not None
    np.testing.assert_array_equal(plain.gaussians.means, finished.gaussians.means)


@pytest.mark.slow
def test_a_crack_that_the_fit_fills_is_opened_again() -> None:
    views = Geometry.parallel(np.linspace(0, math.pi, 60, endpoint=False), (8, 64))
    grid = Grid.matching(views)
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    tooth = np.where(np.hypot(x, y) < 26, np.float32(0.04), np.float32(0))
    crack = (abs(x - 6.5) < 1) & (abs(y) < 12)
    truth = np.where(crack, np.float32(0), tooth)
    noise = np.random.default_rng(7).normal(0, 0.03, (60, 8, 64)).astype(np.float32)
    data = Projector(views, grid).forward(truth) + noise

    def depth(volume: F32) -> float:
        inside = volume[2:6][crack[2:6]].mean()
        beside = volume[2:6][(abs(abs(x - 6.5) - 5) < 1.6)[2:6] & (abs(y) < 12)[2:6]].mean()
        return float(1 - inside / beside)

    fit = R2(steps=200, gaussians=600, finish=0)
    filled, opened = (depth(reconstruct(data, views, replace(fit, finish=n)).volume.data) for n in (0, None))
    direct = depth(reconstruct(data, views, Fbp()).volume.data)
    assert filled < direct < 0.6 < 0.8 < opened


@pytest.mark.slow
def test_matter_that_fills_its_box_is_left_to_the_voxels(rng: np.random.Generator) -> None:
    # All views see the corners of the box cut off: the fit explains them by matter beyond the box, and there is none.
    views = Geometry.parallel(np.linspace(0, math.pi, 40, endpoint=False), (12, 32))
    grid = Grid.matching(views)
    truth = (0.02 * (1 + rng.integers(0, 3, (3, 8, 8)))).astype(np.float32).repeat(4, 0).repeat(4, 1).repeat(4, 2)
    data = Projector(views, grid).forward(truth) + rng.normal(0, 0.01, (40, 12, 32)).astype(np.float32)
    fitted, found = (reconstruct(data, views, method).volume.data for method in (R2(finish=0), Auto()))
    assert psnr(truth, found) > psnr(truth, fitted) + 3


@pytest.mark.slow
def test_matter_above_and_below_a_cone_stays_out_of_the_end_slices() -> None:
    views = Geometry.cone(np.linspace(0, 2 * math.pi, 30, endpoint=False), (16, 40), 1.0, 24.0, 33.6)
    tall, grid = Grid((35, 24, 24), 1.0), Grid((11, 24, 24), 1.0)
    z, y, x = np.meshgrid(*tall.coordinates(), indexing="ij")
    body = 0.04 * ((np.hypot(x, y) < 8) & (np.hypot(x - 3, y) > 2)) * (1 + 0.3 * np.sin(z))
    data = Projector(views, tall).forward(body.astype(np.float32))
    data += np.random.default_rng(0).normal(0, 0.003, data.shape).astype(np.float32)
    fitted, found = (reconstruct(data, views, R2(finish=n), grid=grid).volume.data for n in (0, None))
    raw = FistaTv().run(ReconProblem(Views(data, views), grid), RunControl()).volume.data  # its own box
    truth = body[12:23]
    assert psnr(truth[2:9], found[2:9]) > psnr(truth[2:9], fitted[2:9]) + 1  # the end slices have few rays to refine
    assert min(psnr(truth, found), psnr(truth, fitted)) > psnr(truth, raw) + 10


@pytest.mark.slow
def test_coarse_voxels_get_the_mean_over_their_edges() -> None:
    # Voxels of three pixels: a blob of four pixels is no sum of them.
    grid = Grid((4, 14, 14), 3.0)
    g = Gaussians.from_physical(np.array([[4.0, 2.0, 0.0]]), np.full((1, 3), 2.0), np.array([0.5]), density_unit=0.5)
    data = project(g, VIEWS).numpy() + np.random.default_rng(1).normal(0, 0.002, (30, 8, 40)).astype(np.float32)
    volume = _of(g, grid)
    truth = _of(g, Grid((12, 42, 42), 1.0)).data.reshape(4, 3, 14, 3, 14, 3).mean((1, 3, 5))
    found = finish(volume, g, _problem(data, grid=grid)).volume.data
    raw = FistaTv(20).run(_problem(data, grid=grid), RunControl()).volume.data
    assert psnr(truth, found) > psnr(truth, raw) and psnr(truth, found) > psnr(truth, volume.data) + 1.5


@pytest.mark.slow
def test_single_wild_rays_spoil_neither_the_fit_nor_its_finish() -> None:
    g = _blob(8.0)
    data = project(g, VIEWS).numpy() + 0.1 * Projector(VIEWS, GRID).forward(_box())
    wild = data.copy()
    wild[4, 3, 11] = 3 * data.max()
    clean, found = (finish(_of(g), g, _problem(views)).volume.data for views in (data, wild))
    assert np.abs(found - clean).max() < 0.1 * clean.max()


def test_what_cannot_be_is_refused() -> None:
    data = Projector(VIEWS, GRID).forward(_box())
    with pytest.raises(ValueError, match=">= 0 or None"):
        reconstruct(data, VIEWS, R2(steps=1, finish=-1))
    with pytest.raises(ValueError, match="has no setting 'finish'; methods that have this setting: r2, r2-published"):
        build(Fbp, {"finish": 2})


@pytest.mark.parametrize(("voxels", "seconds"), others_slow([(12, 1e9), (24, None)]))
def test_a_longer_fit_changes_less(voxels: int, seconds: float | None) -> None:
    """Four times the steps: half the rates; so by a clock, too."""
    cone = Geometry.cone(np.linspace(0, 2 * math.pi, 12, endpoint=False), (24, 24), 1.0, 60.0, 72.0)
    grid = Grid((voxels,) * 3, 24 * cone.sample_pitch / voxels)
    data = Projector(cone, grid).forward(np.pad(np.full((6, 6, 6), 0.1, np.float32), (voxels - 6) // 2))
    settings = FitSettings(paced_for=2, tv_size=8)
    method = R2(steps=8, seconds=seconds, gaussians=30, fit=settings)
    made = reconstruct(data, cone, method, grid=grid).settings
    assert (made["pace"], made["tv_least"]) == (settings.pace / 2, settings.tv_least / 2)
    assert made["finish"] == 8


def test_only_a_box_that_cuts_the_sample_leaves_a_part_of_it_to_the_gaussians() -> None:
    views = Geometry.parallel(np.linspace(0, math.pi, 30, endpoint=False), (4, 32))
    whole = Grid.matching(views)
    _, y, x = np.meshgrid(*whole.coordinates(), indexing="ij")
    data = Projector(views, whole).forward((0.02 * (np.hypot(x, y) < 10)).astype(np.float32))
    reach = reach_of(Views(data, views))
    assert not reach.is_cut_by(whole, views)
    assert not reach.is_cut_by(replace(whole, shape=(4, 30, 30)), views)  # a voxel on each side
    assert reach.is_cut_by(replace(whole, shape=(4, 16, 16)), views)
    assert reach.is_cut_by(replace(whole, shape=(4, 32, 32), centre=(0.0, 0.0, 5.0)), views)
    wide = Projector(views, whole.widened(2, views)).forward(np.full((4, 64, 64), 0.02, np.float32))
    assert reach_of(Views(wide, views)).is_cut_by(whole, views)  # how far it goes beyond the field is not known
