"""Where the weight by the noise hides detail, views held out find a smaller one; elsewhere it stays."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import recon
from recon import FistaTv, OsSirtTv
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu.activation import F32
from recon.voxels.held_out_weight import LEAST_VIEWS, busiest_rows, slab_of, split_views
from recon.voxels.projector import Projector

VIEWS, ROWS, COLS, PHOTONS = 40, 16, 64, 1000


@pytest.fixture(scope="module")
def foam() -> tuple[F32, Geometry, Grid, F32]:
    """Struts with a fine texture, which total variation by the noise alone makes even: line integrals and truth."""
    rng = np.random.default_rng(4)
    shape = (ROWS, COLS, COLS)
    struts, texture = (gaussian_filter(rng.normal(size=shape), s) for s in (1.5, 0.6))
    _, y, x = np.indices(shape) - 31.5
    truth = np.where((struts > 0.3 * struts.std()) & (np.hypot(x, y) < 29), 0.7 + 0.08 * texture / texture.std(), 0)
    geometry = Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), (ROWS, COLS), 1.0)
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
    monkeypatch.setattr("recon.voxels.held_out_weight.smaller_weight", lambda problem, first: None)
    by_noise = recon.reconstruct(data, geometry, method, grid=grid).volume.data
    assert psnr(truth, found, peak) > psnr(truth, by_noise, peak) + 2


def test_an_even_disc_keeps_the_weight_by_the_noise(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    geometry = Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), (ROWS, COLS), 1.0)
    _, y, x = np.indices((ROWS, COLS, COLS)) - 31.5
    data = Projector(geometry, Grid.matching(geometry)).forward((np.hypot(x, y) < 25).astype(np.float32))
    data += rng.normal(0, 1, data.shape).astype(np.float32)
    found = recon.reconstruct(data, geometry, FistaTv()).volume.data
    monkeypatch.setattr("recon.voxels.held_out_weight.smaller_weight", lambda problem, first: None)
    np.testing.assert_array_equal(recon.reconstruct(data, geometry, FistaTv()).volume.data, found)


def test_one_view_of_eight_is_held_out_and_the_others_are_not() -> None:
    angles = np.random.default_rng(0).permutation(np.linspace(0, np.pi, 80, endpoint=False))
    seen, unseen = split_views(Geometry.parallel(angles, (4, 8), 1.0))
    assert unseen.size == 10 and sorted([*seen, *unseen]) == list(range(80))
    np.testing.assert_allclose(np.diff(np.sort(angles[unseen])), np.pi / 10)
    assert LEAST_VIEWS == 16


def test_a_slab_is_where_most_matter_is_and_sees_its_own_slices() -> None:
    data = np.zeros((3, 40, 8), np.float32)
    data[:, 20:30] = 1
    rows = busiest_rows(data, 10)
    assert rows == slice(20, 30)
    geometry = Geometry.parallel(np.linspace(0, np.pi, 3), (40, 8), 0.5)
    views, box = slab_of(geometry, Grid.matching(geometry), rows.start, rows.stop)
    volume = np.random.default_rng(1).random((40, 8, 8)).astype(np.float32)
    whole = Projector(geometry, Grid.matching(geometry)).forward(volume)
    np.testing.assert_allclose(Projector(views, box).forward(volume[rows]), whole[:, rows], rtol=1e-5)
