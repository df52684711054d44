"""Images, volumes, gradients and cut-offs: the Triton kernels compared with the reference."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
import torch

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel, Truncation
from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from tests.recon.conftest import Make
from tests.recon.hard_cases.measure import compare
from tests.recon.helpers import as_leaves, gradients, in_double
from tests.recon.kernels import reference
from tests.recon.kernels.gpu.on_gpu import (
    AFFINE,
    DEVICE,
    EXACT,
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
from tests.recon.kernels.reference import project

engine = importlib.import_module("recon.kernels.gpu.engine")


PATHS: dict[str, tuple[Geometry | Grid, RayModel | None, Kernel]] = {
    "parallel": (parallel(), None, Kernel.GAUSSIAN),
    "leaned": (leaned(), None, Kernel.GAUSSIAN),
    "cone": (cone(), None, Kernel.GAUSSIAN),
    "cone, some exact": (cone(), RayModel(exact_above=0.035), Kernel.GAUSSIAN),
    "cone, all exact": (cone(), EXACT, Kernel.GAUSSIAN),
    "parallel, plain": (parallel(), RayModel(rectified=False), Kernel.GAUSSIAN),
    "cone, plain": (cone(), RayModel(rectified=False), Kernel.GAUSSIAN),
    "compact": (cone((9, 12)), None, Kernel.COMPACT),
    "compact, exact": (cone((9, 12)), EXACT, Kernel.COMPACT),
    "voxels": (Grid((9, 12, 10), 0.6, (0.4, -0.8, 1.1)), None, Kernel.GAUSSIAN),
    "tall voxels": (Grid((5, 9, 8), 0.7, slice_pitch=1.3), None, Kernel.GAUSSIAN),
    "compact voxels": (Grid((3, 4, 3), 0.9), None, Kernel.COMPACT),
}


@pytest.mark.parametrize("path", PATHS)
def test_images_volumes_and_their_gradients_equal_the_reference(path: str, random_gaussians: Make) -> None:
    where, model, kernel = PATHS[path]
    found = compare(random_gaussians(8, 8.0, kernel=kernel), where, model=model, device=DEVICE)
    assert found.value < 5e-6 and found.worst < 2e-5, found.gradients


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


@pytest.mark.parametrize("cut", [1.5, 3.0])
def test_exact_rays_end_where_the_cpus_end(cut: float, random_gaussians: Make) -> None:
    # To the pixel; and forward and backward agree on where.
    g, geometry = random_gaussians(12, 9.0), cone()
    raw, ours = raw_of(g, DEVICE), as_leaves(g)
    found = project_raw(*raw, g.density_unit, geometry, 1e-4, cut, EXACT)[0]
    faint = 1e-4 / (g.density_unit * geometry.sample_pitch * SHAPE[1])
    expected = project(ours, geometry, truncation=Truncation(cut, faint), model=EXACT)[0]
    np.testing.assert_allclose(found.detach().cpu(), expected.detach(), atol=1e-5 * float(expected.detach().max()))
    y = torch.from_numpy(np.random.default_rng(4).normal(size=SHAPE).astype(np.float32))
    (found * y.to(DEVICE)).sum().backward()
    (expected * y).sum().backward()
    assert_gradients(raw, ours, 1e-4)
    assert raw[3].grad is not None
    back = raw[3].grad.cpu().double() / (g.density_unit * torch.sigmoid(g.raw_densities.double()))
    left, right = float((found.detach().cpu() * y).double().sum()), float((g.densities.double() * back).sum())
    assert left == pytest.approx(right, rel=2e-5)


tiles = importlib.import_module("recon.kernels.gpu.tiles")


def test_a_long_list_is_shared_out_and_sums_to_the_same() -> None:
    rng = np.random.default_rng(2)
    g = Gaussians.from_physical(rng.uniform(-3, 3, (90, 3)), rng.uniform(0.8, 2, (90, 3)), rng.uniform(0.2, 1, 90))
    geometry, grid = Geometry.parallel([0.5], (7, 8)), Grid((4, 5, 6))
    run = engine.GpuPass(*(t.detach() for t in raw_of(g, DEVICE)), g.density_unit)
    view, box = run.view(geometry, 0, *WHOLE, AFFINE), run.box(grid, *WHOLE)
    boxes = view.footprints.boxes
    assert tiles.tile_lists(boxes, (7, 8), 8).shares > 1
    assert tiles.tile_lists(torch.zeros_like(boxes), (7, 8), 8).shares == 1
    double = in_double(g)
    expected = reference_view(double, geometry, 0).detach()
    np.testing.assert_allclose(view.image.cpu(), expected, rtol=2e-6)
    z, y, x = (torch.from_numpy(axis) for axis in grid.coordinates())
    volume = reference.voxelize(double.means, double.scales, double.quaternions, double.densities, (z, y, x)).detach()
    np.testing.assert_allclose(box.density.cpu(), volume, rtol=2e-6)
