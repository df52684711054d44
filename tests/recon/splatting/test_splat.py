"""The CPU kernels compared with the float64 reference, which is compared with closed forms and finite differences."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel, Truncation
from recon.base.ray_width import RayWidth
from recon.base.volume import Grid
from recon.splatting import splat
from recon.splatting.gaussians import Gaussians
from recon.splatting.splat import voxel_means
from tests.recon.conftest import Make
from tests.recon.helpers import as_leaves, gradients, in_double
from tests.recon.kernels.reference import on_grid as voxelize
from tests.recon.kernels.reference import project

# Cut off so far out that kernel and reference sum the same terms.
WHOLE = Truncation(sigmas=9.0, faint=1e-12)
SHAPE = (24, 30)


ANGLES = (0.0, 0.7, 2.5, -4.0)
TURNED: dict[str, Any] = {
    "axis_row": 10.0,
    "shifts": ((0.4, -1.3), (1.2, 0.7), (-2.0, 0.0), (0.0, 0.5)),
    "roll": (0.2, -0.1, 0.0, 0.05),
    "tilt": -0.3,
}
WIDE = RayWidth(pixel=1, blur=0.6, arc=0.3)
# Every way to a projection: a beam and what a Gaussian gives a ray of it.
STRAIGHT = Geometry.parallel(ANGLES, SHAPE, pixel_pitch=0.5, axis_col=13.3)
LEANING = Geometry.parallel(ANGLES, SHAPE, pixel_pitch=0.5, axis_col=13.3, **TURNED)
CONE = Geometry.cone(ANGLES, SHAPE, 0.8, 25.0, 40.0, axis_col=13.3, **TURNED)
PATHS = {
    "straight": (STRAIGHT, RayModel()),
    "leaning": (LEANING, RayModel()),
    "cone": (CONE, RayModel()),
    "cone, some exact": (CONE, RayModel(exact_above=0.035)),
    "cone, all exact": (CONE, RayModel(exact_above=0.0)),
    "straight, plain": (STRAIGHT, RayModel(rectified=False)),
    "cone, plain": (CONE, RayModel(rectified=False)),
    "straight, wide": (STRAIGHT.seen_with(WIDE), RayModel()),
    "straight, pixels alone": (STRAIGHT.seen_with(RayWidth(pixel=1)), RayModel()),
    "leaning, wide": (LEANING.seen_with(WIDE), RayModel()),
    "cone, wide": (CONE.seen_with(WIDE), RayModel()),
}


def geometry(angles: tuple[float, ...] = (0.0, 0.7, 2.5, -4.0)) -> Geometry:
    return Geometry.parallel(angles, SHAPE, pixel_pitch=0.5, axis_col=13.3)


@pytest.mark.parametrize("kernel", Kernel)
@pytest.mark.parametrize("path", PATHS)
def test_cpu_projection_and_gradients_equal_the_reference(
    path: str, kernel: Kernel, random_gaussians: Make, rng: np.random.Generator
) -> None:
    views, model = PATHS[path]
    g, weights = random_gaussians(kernel=kernel), torch.from_numpy(rng.normal(size=(4, *SHAPE)))
    fast, double = as_leaves(g), in_double(g)
    found, expected = project(fast, views, truncation=WHOLE, model=model), project(double, views, model=model)
    # The image kernel's recurrence costs up to 2e-5 of a footprint's weight, and some dozen overlap.
    assert float((found - expected).detach().abs().max()) < 1e-5 * float(expected.detach().max())
    (found * weights.float()).sum().backward()
    (expected * weights).sum().backward()
    for name, gradient in gradients(double).items():
        off = (gradients(fast)[name] - gradient).abs().max()
        assert float(off) < 2e-5 * float(gradient.abs().max()), name


@pytest.mark.slow
@pytest.mark.parametrize("beam", [STRAIGHT, LEANING, CONE], ids=["straight", "leaning", "cone"])
def test_a_width_is_the_mean_over_pixels_and_angles(beam: Geometry, random_gaussians: Make) -> None:
    # Rays without a width, many within each pixel and within the exposure. What is left of their difference are moments
    # beyond the second, and that a Gaussian itself turns.
    g, width, n, turns = in_double(random_gaussians()), RayWidth(pixel=1, arc=0.1), 6, 4
    fine = replace(
        beam, detector_shape=(SHAPE[0] * n, SHAPE[1] * n), pixel_pitch=beam.pixel_pitch / n,
        axis_col=(beam.axis_col + 0.5) * n - 0.5, axis_row=(beam.axis_row + 0.5) * n - 0.5, shifts=beam.shifts * n,
    )  # fmt: skip
    mean = torch.zeros((4, *SHAPE), dtype=torch.float64)
    with torch.no_grad():  # with gradients it takes five times as long
        for turn in (np.arange(turns) + 0.5) / turns - 0.5:
            images = project(g, replace(fine, angles=fine.angles + turn * width.arc))
            mean += images.reshape(4, SHAPE[0], n, SHAPE[1], n).mean((2, 4)) / turns
        sharp, found = project(g, beam), project(g, beam.seen_with(width))
    assert float((found - mean).norm()) < 0.15 * float((sharp - mean).norm())


def test_a_width_and_the_uncorrected_factor_are_refused(random_gaussians: Make) -> None:
    with pytest.raises(ValueError, match="corrected footprints"):
        project(random_gaussians(), STRAIGHT.seen_with(RayWidth(pixel=1)), model=RayModel(rectified=False))


@pytest.mark.parametrize(
    ("options", "message"),
    [({"exact_above": -0.1}, "relative error"), ({"exact_above": 0.01, "rectified": False}, "rectified")],
)
def test_a_ray_model_that_makes_no_sense_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RayModel(**options)


@pytest.mark.parametrize("kernel", Kernel)
@pytest.mark.parametrize(
    ("n_slices", "slice_pitch"), [(9, None), (11, 0.05), (11, 1.3)], ids=["cubes", "flat voxels", "tall voxels"]
)
def test_cpu_voxels_and_gradients_equal_the_reference(
    random_gaussians: Make, rng: np.random.Generator, n_slices: int, slice_pitch: float | None, kernel: Kernel
) -> None:
    g = random_gaussians(kernel=kernel)
    grid = Grid((n_slices, 12, 20), 0.6, centre=(0.4, -0.8, 1.1), slice_pitch=slice_pitch)
    weights = torch.from_numpy(rng.normal(size=grid.shape))
    fast, double = as_leaves(g), in_double(g)
    a, b = voxelize(fast, grid, truncation=WHOLE), voxelize(double, grid)
    assert float((a - b).detach().abs().max()) < 3e-6 * float(b.detach().max())
    (a * weights.float()).sum().backward()
    (b * weights).sum().backward()
    for name, expected in gradients(double).items():
        found = gradients(fast)[name]
        assert float((found - expected).abs().max()) < 2e-5 * float(expected.abs().max()), name


@pytest.mark.parametrize(
    ("truncation", "kernel"),
    [(WHOLE, Kernel.GAUSSIAN), (Truncation(), Kernel.GAUSSIAN), (Truncation(), Kernel.COMPACT)],
    ids=["whole", "cut", "compact"],
)
@pytest.mark.parametrize("path", PATHS)
def test_projection_is_linear_in_density_and_its_adjoint_is_the_density_gradient(
    path: str, truncation: Truncation, kernel: Kernel, random_gaussians: Make, rng: np.random.Generator
) -> None:
    # <A ρ, y> = <ρ, Aᵀ y> with A the footprints and Aᵀ the first moment of the backward pass.
    views, model = PATHS[path]
    g = as_leaves(random_gaussians(kernel=kernel))
    y = torch.from_numpy(rng.normal(size=(4, *SHAPE)).astype(np.float32))
    image = project(g, views, truncation=truncation, model=model)
    (image * y).sum().backward()
    slope = g.density_unit * torch.sigmoid(g.raw_densities.detach())
    back = gradients(g)["raw_densities"] / slope
    left = float((image.detach().double() * y).sum())
    right = float((g.densities.detach().double() * back).sum())
    assert left == pytest.approx(right, rel=3e-5)


def test_without_gradients_the_memory_is_that_of_the_images_however_many_views(random_gaussians: Make) -> None:
    gaussians, peaks = random_gaussians(2000), []
    for n_views in (4, 64):
        geometry = Geometry.parallel(np.linspace(0, np.pi, n_views), (8, 8), pixel_pitch=0.5)
        tracemalloc.start()
        project(gaussians, geometry)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    images = 60 * 8 * 8 * 4
    assert peaks[1] - peaks[0] < 4 * images  # a table of the Gaussians would be 2000 x 32 bytes a view


def test_parameters_that_change_before_the_gradient_are_refused(random_gaussians: Make) -> None:
    g = as_leaves(random_gaussians(4))
    image, volume = project(g, geometry()), voxelize(g, Grid((3, 4, 5)))
    with torch.no_grad():
        g.means.add_(1)
    for rendered in (image, volume):
        with pytest.raises(RuntimeError, match="an inplace operation"):
            rendered.sum().backward()


def test_a_compact_kernel_ends_by_itself_and_nowhere_else(random_gaussians: Make) -> None:
    # No truncation touches it: any `sigmas` gives the same bits, the reference's zeros are zeros here.
    g = random_gaussians(kernel=Kernel.COMPACT)
    for cut in (Truncation(1.0, 0.0), Truncation(9.0, 1e-6)):
        assert torch.equal(project(g, geometry(), truncation=cut), project(g, geometry()))
        assert torch.equal(voxelize(g, Grid((9, 9, 9)), truncation=cut), voxelize(g, Grid((9, 9, 9))))
    one = Gaussians.from_physical([[0.3, -0.2, 0.1]], [1.1], [0.8], kernel=Kernel.COMPACT)
    expected = project(in_double(one), geometry()).detach()
    assert torch.equal(project(one, geometry()) > 1e-6, expected > 1e-6)


def test_default_truncation_loses_little(random_gaussians: Make) -> None:
    g = random_gaussians()
    whole = project(g, geometry(), truncation=WHOLE)
    cut = project(g, geometry())
    # 3.5 σ leave exp(-6.1) = 0.2 % of a footprint's mass outside.
    assert float(cut.sum() / whole.sum()) == pytest.approx(1, abs=0.004)
    assert float((whole - cut).abs().max()) < 0.01 * float(whole.max())


@pytest.mark.parametrize(("above", "seen"), [(1.5, True), (0.7, False)])
def test_what_is_faint_is_left_out(above: float, seen: bool) -> None:
    # A projection's limit is the fraction times the field times the density unit, a volume's times the unit alone.
    cut, unit, sigma = Truncation(3.5, 1e-3), 0.7, 0.8
    views = geometry()
    peak = above * cut.faint * unit * SHAPE[1] * views.pixel_pitch
    one = Gaussians.from_physical([[0.0, 0, 0]], [sigma], [peak / (sigma * math.sqrt(2 * math.pi))], density_unit=unit)
    assert bool(project(one, views, truncation=cut).any()) == seen
    one = Gaussians.from_physical([[0.0, 0, 0]], [sigma], [above * cut.faint * unit], density_unit=unit)
    assert bool(voxelize(one, Grid((5, 5, 5), 0.5), truncation=cut).any()) == seen


def test_doubles_are_refused(random_gaussians: Make) -> None:
    with pytest.raises(ValueError, match="float32"):
        splat.project(in_double(random_gaussians(2)), geometry())


def test_voxel_means_are_those_of_finer_voxels() -> None:
    """Of voxels of two pixels; Gaussians that were fitted to views without a width hold the mean over a pixel."""
    g = Gaussians.from_physical(
        [[0.3, -0.2, 0.1], [-1.2, 0.9, -0.4]], [[0.7, 1.1, 0.9], [0.8, 0.6, 1.0]], [1.0, 0.6],
        quaternions=[[1.0, 0.3, 0.2, 0.1], [1.0, 0.0, 0.0, 0.0]],
    )  # fmt: skip
    grid, views = Grid((6, 6, 6), 1.4), Geometry.parallel([0.0], (12, 12), pixel_pitch=0.7)
    means = voxelize(g, Grid((48, 48, 48), 1.4 / 8)).numpy().reshape(6, 8, 6, 8, 6, 8).mean((1, 3, 5))
    with_width = voxel_means(g, grid, views.seen_with(RayWidth(pixel=1))).numpy()
    at_centres, found = voxelize(g, grid).numpy(), voxel_means(g.widened(0.7**2 / 12), grid, views).numpy()
    assert np.abs(with_width - means).max() < 0.1 * np.abs(at_centres - means).max()
    np.testing.assert_allclose(found, with_width, atol=1e-5)
    fine = Grid((12, 12, 12), 0.7)
    np.testing.assert_array_equal(voxel_means(g, fine, views).numpy(), voxelize(g, fine).numpy())
