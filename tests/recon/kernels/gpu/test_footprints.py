"""Footprints, images and what flows back from them: the Triton kernels against the reference and the CPU's."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
import torch

from recon.base.geometry import Geometry
from recon.base.kernel import RayModel
from recon.base.volume import Grid
from recon.kernels.cpu import footprints as footprints_cpu
from recon.kernels.cpu.engine import Active, view_table
from recon.splatting.gaussians import Gaussians
from tests.recon.conftest import Make
from tests.recon.helpers import gradients, in_double
from tests.recon.kernels import reference
from tests.recon.kernels.gpu.on_gpu import (
    AFFINE,
    DEVICE,
    SHAPE,
    UNIT,
    WHOLE,
    assert_gradients,
    cone,
    leaned,
    parallel,
    project_raw,
    raw_of,
    reference_view,
    voxelize_raw,
)

engine = importlib.import_module("recon.kernels.gpu.engine")


@pytest.mark.parametrize("make", [parallel, leaned, cone])
def test_images_and_gradients_equal_the_reference(make: object, random_gaussians: Make) -> None:
    geometry = make()  # type: ignore[operator]
    g = random_gaussians(18, 9.0)
    raw, double = raw_of(g, DEVICE), in_double(g)
    found = project_raw(*raw, UNIT, geometry, *WHOLE, AFFINE)
    expected = torch.stack([reference_view(double, geometry, view) for view in range(geometry.n_views)])
    peak = float(expected.detach().max())
    assert float((found.detach().cpu() - expected.detach()).abs().max()) < 3e-6 * peak
    weights = torch.from_numpy(np.random.default_rng(3).normal(size=expected.shape))
    (found * weights.float().to(DEVICE)).sum().backward()
    (expected * weights).sum().backward()
    assert_gradients(raw, double)


@pytest.mark.parametrize("make", [parallel, cone])
def test_the_uncorrected_factor_equals_the_references(make: object, random_gaussians: Make) -> None:
    geometry = make()  # type: ignore[operator]
    g = random_gaussians(10, 9.0)
    raw, double = raw_of(g, DEVICE), in_double(g)
    plain = RayModel(rectified=False)
    found = project_raw(*raw, UNIT, geometry, *WHOLE, plain)[0]
    physical = (double.means, double.scales, double.quaternions, double.densities)
    expected = reference.project_view(physical, geometry, 0, length=plain.length(geometry))
    assert float((found.cpu() - expected).detach().abs().max()) < 3e-6 * float(expected.detach().max())
    (found * found).sum().backward()
    (expected * expected).sum().backward()
    assert_gradients(raw, double)


def test_footprints_equal_the_cpus(random_gaussians: Make) -> None:
    g, geometry = random_gaussians(30, 30.0), parallel()
    arrays = g.arrays()
    active = Active.of(*(arrays[k] for k in ("means", "log_scales", "quaternions", "raw_densities")), UNIT)
    expected = view_table(active, geometry, 0, 1e-3, 3.5)
    raw = [t.detach() for t in raw_of(g, DEVICE)]
    found = engine.GpuPass(*raw, UNIT).view(geometry, 0, 1e-3, 3.5, AFFINE).footprints
    table = found.table.cpu().numpy()
    hidden = expected[:, footprints_cpu.HU] < 0
    assert hidden.any() or not (table[:, footprints_cpu.HU] < 0).any()
    np.testing.assert_array_equal(table[:, footprints_cpu.HU] < 0, hidden)
    np.testing.assert_allclose(table[~hidden], expected[~hidden], rtol=2e-5, atol=2e-5)
    boxes = found.boxes.cpu().numpy()
    assert (boxes >= 0).all() and (boxes[:, 1] <= SHAPE[0]).all() and (boxes[:, 3] <= SHAPE[1]).all()
    u, v, hu, hv = (table[:, k] for k in (0, 1, 6, 7))
    hit = (u + hu >= 0) & (u - hu <= SHAPE[1] - 1) & (v + hv >= 0) & (v - hv <= SHAPE[0] - 1)
    assert 0 < hit.sum() < hit.size  # some lie outside the image
    np.testing.assert_array_equal(boxes[:, 1] > boxes[:, 0], hit)


def test_a_cut_off_ends_at_the_box_whatever_the_tiles() -> None:
    # One Gaussian over several tiles and image borders: exactly the pixels of its box are lit.
    g = Gaussians.from_physical([[2.3, 0.0, -3.1]], [1.4], [1.0])
    geometry = Geometry.parallel([0.0], (17, 20), axis_col=14.0)
    view = engine.GpuPass(*(t.detach() for t in raw_of(g, DEVICE)), 1.0).view(geometry, 0, 1e-9, 2.5, AFFINE)
    image = view.image.cpu().numpy()
    rows, cols = np.abs(np.arange(17) - (8 - 3.1)) <= 2.5 * 1.4, np.abs(np.arange(20) - 16.3) <= 2.5 * 1.4
    np.testing.assert_array_equal(image > 0, rows[:, None] & cols[None, :])
    assert view.footprints.boxes.tolist() == [
        [rows.argmax(), 17 - rows[::-1].argmax(), cols.argmax(), 20 - cols[::-1].argmax()]
    ]


def test_the_backward_pass_is_the_adjoint_where_footprints_are_cut(
    random_gaussians: Make, rng: np.random.Generator
) -> None:
    # <A ρ, y> = <ρ, Aᵀ y>: render and moments must agree on every pixel of every footprint, also at the cut.
    g = random_gaussians(25, 14.0)
    raw = raw_of(g, DEVICE)
    y = torch.from_numpy(rng.normal(size=(2, *SHAPE)).astype(np.float32)).to(DEVICE)
    image = project_raw(*raw, UNIT, parallel(), 1e-3, 2.0, AFFINE)
    (image * y).sum().backward()
    assert raw[3].grad is not None
    back = raw[3].grad.cpu().double() / (UNIT * torch.sigmoid(g.raw_densities.double()))
    left, right = float((image.detach() * y).double().sum()), float((g.densities.double() * back).sum())
    assert left == pytest.approx(right, rel=1e-5)

    raw = raw_of(g, DEVICE)
    grid = Grid((9, 11, 10), 0.9)
    y = torch.from_numpy(rng.normal(size=grid.shape).astype(np.float32)).to(DEVICE)
    volume = voxelize_raw(*raw, UNIT, grid, 1e-3, 2.0)
    (volume * y).sum().backward()
    assert raw[3].grad is not None
    back = raw[3].grad.cpu().double() / (UNIT * torch.sigmoid(g.raw_densities.double()))
    left, right = float((volume.detach() * y).double().sum()), float((g.densities.double() * back).sum())
    assert left == pytest.approx(right, rel=1e-5)


@pytest.mark.parametrize("n", [0, 1, 3])
def test_none_one_and_those_that_cover_everything(n: int) -> None:
    g = Gaussians.from_physical(np.full((n, 3), 0.2), np.full((n, 3), 40.0), np.ones(n), density_unit=1.0)
    raw, double = raw_of(g, DEVICE), in_double(g)
    geometry, grid = Geometry.parallel([1.0], (9, 17)), Grid((3, 9, 9))
    image = project_raw(*raw, 1.0, geometry, *WHOLE, AFFINE)
    volume = voxelize_raw(*raw, 1.0, grid, *WHOLE)
    image.sum().backward()
    volume.sum().backward()
    if n == 0:
        assert not image.any() and not volume.any()
        return
    z, y, x = (torch.from_numpy(axis) for axis in grid.coordinates())
    expected = reference_view(double, geometry, 0)
    dense = reference.voxelize(double.means, double.scales, double.quaternions, double.densities, (z, y, x))
    np.testing.assert_allclose(image.detach().cpu().numpy()[0], expected.detach().numpy(), rtol=3e-6)
    np.testing.assert_allclose(volume.detach().cpu().numpy(), dense.detach().numpy(), rtol=3e-6)
    (expected.sum() + dense.sum()).backward()
    # The rotation of a ball has no gradient: what is left of it is rounding.
    for tensor, (name, value) in zip(raw, gradients(double).items(), strict=True):
        assert tensor.grad is not None
        np.testing.assert_allclose(tensor.grad.cpu(), value, rtol=1e-4, atol=0.3 if name == "quaternions" else 1e-3)
