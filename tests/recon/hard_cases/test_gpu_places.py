"""Gaussians at difficult places, of difficult weight, on the Triton kernels, within the CPU's bounds; see `on_gpu`."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest
import torch

from recon.base.geometry import Geometry
from recon.base.kernel import RayModel
from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from recon.splatting.splat import project, voxelize
from tests.recon.hard_cases.measure import STEP, WHOLE, bound, compare, gradient_bound
from tests.recon.hard_cases.on_gpu import BEAMS, DEVICE, EXACT, FAR, GRID, SHAPE, at, quiet, some
from tests.recon.helpers import as_leaves, gradients, in_double

images = importlib.import_module("recon.kernels.gpu.images")
tiles = importlib.import_module("recon.kernels.gpu.tiles")
pytestmark = pytest.mark.slow  # where the interpreter stands in; tests/recon/kernels/gpu is quick
SOURCE = Geometry.cone([0.0], SHAPE, 1.0, 10.0, 20.0)  # the source is at y = -10


@quiet
@pytest.mark.parametrize("far", [1e5, 1e30])
def test_far_outside_there_is_nothing_and_no_gradient(far: float) -> None:
    places = [(far, 0.0, 3.0), (-far, 0.0, 3.0), (3.0, 0.0, far), (far, far, far)]
    for where in (BEAMS["parallel"], GRID):
        g = as_leaves(at(places, 1.1), DEVICE)
        image = (
            voxelize(g, where, implementation="gpu")
            if isinstance(where, Grid)
            else project(g, where, implementation="gpu")
        )
        assert not image.any()
        image.sum().backward()
        assert all(not slope.any() for slope in gradients(g).values())


def test_far_outside_and_large_enough_to_be_seen() -> None:
    far = 1e5
    view = Geometry.parallel([0.0], SHAPE, pixel_pitch=1.0)
    found = compare(at([(far, 0.0, 3.0), (3.0, 0.0, -far), (-far, far, far)], far / 2), view, device=DEVICE)
    assert found.value < bound(far, 0.3 * far)
    assert found.worst < gradient_bound(far, 0.3 * far), found.gradients


def test_on_the_borders_of_images_and_tiles() -> None:
    sigma = 0.4
    cols, rows = (-1.0, -0.5, 0.0, 7.5, 8.0, 12.0, 12.5, 13.0), (-1.0, 0.0, 7.5, 8.0, 10.0, 11.0)
    view = Geometry.parallel([0.0], SHAPE, pixel_pitch=1.0, axis_col=0.0, axis_row=0.0)  # x is the column, z the row
    found = compare(at([(u, 0.0, v) for u in cols for v in rows], sigma), view, device=DEVICE)
    assert found.value < bound(FAR, 0.7 * sigma)
    assert found.worst < gradient_bound(FAR, 0.7 * sigma), found.gradients


@pytest.mark.parametrize("model", [None, EXACT], ids=["affine", "exact"])
def test_near_the_source_of_a_cone_a_gaussian_is_large_and_right(model: RayModel | None) -> None:
    # From a tenth of the distance on, magnified up to twenty times.
    g = at([(0.05, -9.0, 0.02), (-0.2, -8.0, 0.1), (0.3, -6.0, -0.2), (1.0, 0.0, 2.0)], 0.05)
    found = compare(g, SOURCE, model=model, device=DEVICE)
    assert found.value < bound(FAR, 0.6)
    assert found.worst < gradient_bound(FAR, 0.6), found.gradients


@quiet
@pytest.mark.parametrize("model", [None, EXACT], ids=["affine", "exact"])
def test_at_the_source_and_behind_it_there_is_nothing(model: RayModel | None) -> None:
    hidden = [(0.0, -10.0, 0.0), (0.0, -9.999, 0.0), (0.3, -10.0, 0.1), (0.0, -15.0, 0.0), (1.0, -1e6, 0.0)]
    both = at([(1.0, 0.0, 2.0), (-3.0, 4.0, 1.0), *hidden], 0.5)
    g, rest = as_leaves(both, DEVICE), as_leaves(both.select(torch.arange(2)), DEVICE)
    image = project(g, SOURCE, model=model, implementation="gpu")
    expected = project(rest, SOURCE, model=model, implementation="gpu")
    np.testing.assert_array_equal(image.detach().cpu(), expected.detach().cpu())
    image.sum().backward()
    for slope in gradients(g).values():
        assert torch.isfinite(slope).all() and slope[:2].any() and not slope[2:].any()


@quiet
@pytest.mark.parametrize("model", [None, EXACT], ids=["affine", "exact"])
def test_anywhere_before_a_source_all_is_finite(model: RayModel | None) -> None:
    rng = np.random.default_rng(8)
    places = np.stack((rng.uniform(-3, 3, 15), -10 + 10 ** rng.uniform(-3, 3, 15), np.full(15, 0.3)), 1)
    sigma = 10 ** rng.uniform(-3, 2, 15)
    one = Gaussians.from_physical(places, sigma[:, None] * rng.uniform(0.7, 1.4, (15, 3)), np.full(15, 0.8))
    g = as_leaves(one, DEVICE)
    image = project(g, SOURCE, model=model, implementation="gpu")
    assert torch.isfinite(image).all() and float(image.detach().min()) >= 0
    assert float(image.detach().max()) <= 1.001 * 0.8 * math.sqrt(2 * math.pi) * 1.4 * sigma.sum()
    image.sum().backward()
    assert all(torch.isfinite(slope).all() for slope in gradients(g).values())


@quiet
def test_a_density_of_zero_or_too_small_for_float32_is_nothing() -> None:
    raw = torch.tensor([-80.0, -104.0, -1e4, -3e38, 0.5])
    g = some((1.0, 0.7, 1.3), 5)
    faint = as_leaves(Gaussians(g.means, g.log_scales, g.quaternions, raw, 0.7), DEVICE)
    alone = faint.select(torch.tensor([4], device=DEVICE))
    for where, picture in ((BEAMS["parallel"], project), (GRID, voxelize)):
        image = picture(faint, where, implementation="gpu")  # type: ignore[operator]
        expected = picture(alone, where, implementation="gpu")  # type: ignore[operator]
        np.testing.assert_array_equal(image.detach().cpu(), expected.detach().cpu())
        image.sum().backward()
    slopes = gradients(faint)
    assert all(torch.isfinite(slope).all() for slope in slopes.values())
    assert float(slopes["raw_densities"][:4].abs().max()) < 1e-30


@quiet
@pytest.mark.parametrize("unit", [1e-44, 1e-38, 1e-30, 1e30])
def test_units_of_density_at_the_ends_of_float32(unit: float) -> None:
    g = some((1.0, 0.7, 1.3), 2)
    odd = Gaussians(g.means, g.log_scales, g.quaternions, torch.zeros(2), unit)
    leaves = as_leaves(odd, DEVICE)
    image = project(leaves, BEAMS["parallel"], implementation="gpu")
    expected = project(in_double(odd), BEAMS["parallel"]).detach()
    assert torch.isfinite(image).all()
    assert float((image.detach().cpu() - expected).abs().max()) <= 3e-3 * float(expected.max()) + 1e-37
    (image / unit if unit > 1e-37 else image).sum().backward()
    assert all(torch.isfinite(slope).all() for slope in gradients(leaves).values())


def test_a_dynamic_range_of_1e8_leaves_each_pixel_its_digits() -> None:
    # Densities fall by 1e8 along the columns: the error of a pixel is relative to what is in that pixel.
    n = 9
    size = 10 ** np.linspace(4, -4, n)
    view = Geometry.parallel([0.0], (5, 8 * n), pixel_pitch=1.0, axis_col=0.0, axis_row=0.0)
    places = np.stack((8 * np.arange(n) + 3.3, np.zeros(n), np.full(n, 2.2)), 1)
    g = Gaussians.from_physical(places, np.full(n, 0.6), size, density_unit=1.0)
    found = project(as_leaves(g, DEVICE), view, truncation=WHOLE, implementation="gpu").detach().cpu().double()[0]
    expected = project(in_double(g), view).detach()[0]
    for k in range(n):
        part = slice(8 * k, 8 * k + 8)
        off = (found[:, part] - expected[:, part]).abs().max() / expected[:, part].max()
        assert float(off) < bound(8 * n, 0.6), k


def test_a_pile_at_one_pixel_does_not_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    # All alike, of a weight whose last digits a sum of more than 128 rounds away, each time; in one share, as in an
    # image of many tiles.
    monkeypatch.setattr(tiles, "PROGRAMS", 1)
    groups, weight = 200, 1 + 0.9 * 2.0**-17
    one = Gaussians.from_physical([[0.0, 0.0, 0.0]], [0.9], [weight / (0.9 * math.sqrt(2 * math.pi))])
    pile = as_leaves(one.select(torch.zeros(groups * images._GROUP, dtype=torch.int64)), DEVICE)
    shown = project(pile, Geometry.parallel([0.0], (1, 1), pixel_pitch=1.0), truncation=WHOLE, implementation="gpu")
    off = abs(float(shown.detach()) / (groups * images._GROUP * weight) - 1)
    assert off < 16 * STEP  # of it the weight's own: a dozen roundings
    one_by_one = np.cumsum(np.full(groups, weight, np.float32), dtype=np.float32)[-1]
    assert abs(float(one_by_one) / (groups * weight) - 1) > 32 * STEP
