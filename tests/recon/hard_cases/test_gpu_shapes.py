"""Gaussians of difficult shape on the Triton kernels, within the CPU's bounds; see `on_gpu`."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest
import torch

from recon.base.geometry import Geometry
from recon.base.kernel import RayModel
from recon.base.volume import Grid
from recon.kernels.cpu.footprints import KV, K, W
from recon.splatting.gaussians import Gaussians
from recon.splatting.splat import project, voxelize
from tests.recon.hard_cases.measure import STEP, bound, compare, gradient_bound
from tests.recon.hard_cases.on_gpu import BEAMS, DEVICE, EXACT, FAR, GRID, PITCH, SHAPE, Shape, quiet, some
from tests.recon.helpers import as_leaves, gradients, in_double

engine = importlib.import_module("recon.kernels.gpu.engine")
voxels = importlib.import_module("recon.kernels.gpu.voxels")
pytestmark = pytest.mark.slow  # where the interpreter stands in; tests/recon/kernels/gpu is quick


@pytest.mark.parametrize(("beam", "aspect"), [("parallel", 1e2), ("parallel", 1e4), ("leaning", 1e4), ("cone", 50.0)])
def test_a_needle_as_wide_as_a_pixel_keeps_its_digits(beam: str, aspect: float) -> None:
    thin = 0.5 if beam != "cone" else 0.4
    found = compare(some((thin, thin, thin * aspect)), BEAMS[beam], device=DEVICE)
    assert found.value < bound(FAR, thin / PITCH)
    assert found.worst < gradient_bound(FAR, thin / PITCH), found.gradients


@pytest.mark.parametrize(("beam", "aspect"), [("parallel", 1e4), ("leaning", 1e2), ("leaning", 1e4), ("cone", 1e4)])
def test_a_needle_thinner_than_a_pixel_is_as_exact_as_its_position(beam: str, aspect: float) -> None:
    thin = 4 / aspect
    found = compare(some((thin, thin, 4.0), 12), BEAMS[beam], device=DEVICE)
    assert found.value < bound(FAR, thin / PITCH)
    assert found.worst < gradient_bound(FAR, thin / PITCH), found.gradients


@pytest.mark.parametrize("aspect", [1e2, 1e4])
def test_a_needle_in_voxels_keeps_its_digits(aspect: float) -> None:
    found = compare(some((0.5, 0.5, 0.5 * aspect)), GRID, device=DEVICE)
    assert found.value < bound(10.0, 0.5)
    assert found.worst < gradient_bound(10.0, 0.5), found.gradients


@pytest.mark.parametrize(
    ("shape", "where"), [((0.04, 0.04, 4.0), GRID), ((2.0, 2.0, 2e-2), GRID), ((4e-3, 4e-3, 4.0), BEAMS["cone"])]
)
def test_stretches_of_needles_and_discs_are_as_exact_as_positions(shape: Shape, where: Geometry | Grid) -> None:
    # Moments along the axes of the image or the grid would lose an aspect squared in them, and in nothing else.
    found = compare(some(shape), where, model=EXACT if isinstance(where, Geometry) else None, device=DEVICE).gradients
    assert found["log_scales"] < 3 * max(found["means"], found["raw_densities"])


@pytest.mark.parametrize(("beam", "thin"), [("leaning", 2e-2), ("cone", 2e-6)])
def test_flat_discs_at_any_angle(beam: str, thin: float) -> None:
    found = compare(some((2.0, 2.0, thin), 10), BEAMS[beam], device=DEVICE)
    narrowest = 0.1  # no view meets any of these edge-on
    assert found.value < bound(FAR, narrowest)
    assert found.worst < gradient_bound(FAR, narrowest), found.gradients


def test_a_flat_disc_seen_edge_on() -> None:
    view = Geometry.parallel([0.0], SHAPE, pixel_pitch=PITCH)  # a line 0.002 px wide through the middle of a column
    found = compare(Gaussians.from_physical([[0.0, 0.0, 0.0]], [[1e-3, 2.0, 2.0]], [0.8]), view, device=DEVICE)
    assert found.value < bound(FAR, 1e-3 / PITCH)
    assert found.worst < gradient_bound(FAR, 1e-3 / PITCH), found.gradients


@pytest.mark.parametrize("sigma", [0.05, 1e-3])
def test_dots_smaller_than_a_pixel(sigma: float) -> None:
    g = some((sigma,) * 3, 12, 6.0)
    identity = torch.tensor([[1.0, 0, 0, 0]]).repeat(12, 1)
    moved = Gaussians(torch.round(g.means) + 0.5 * sigma, g.log_scales, identity, g.raw_densities, g.density_unit)
    found = compare(moved, Geometry.parallel([0.0], SHAPE, pixel_pitch=1.0), device=DEVICE)
    assert found.value < bound(FAR, sigma)
    del found.gradients["quaternions"]  # of round Gaussians they are zero, see below
    assert found.worst < gradient_bound(FAR, sigma), found.gradients
    voxels = compare(moved, Grid((9, 9, 9)), device=DEVICE)
    assert voxels.value < bound(FAR, sigma)


def test_a_turned_ball_feels_no_torque() -> None:
    for where in (BEAMS["parallel"], GRID):
        found = compare(some((0.8,) * 3), where, device=DEVICE)
        size = float(found.slopes["log_scales"].abs().max())
        assert float(found.slopes["quaternions"].abs().max()) < 20 * STEP * size


@pytest.mark.parametrize("sigma", [1e3, 1e7])
def test_gaussians_larger_than_the_field(sigma: float) -> None:
    g = some((sigma, 1.3 * sigma, 0.7 * sigma))
    for where, thin in ((BEAMS["leaning"], sigma / PITCH), (GRID, sigma)):
        found = compare(g, where, device=DEVICE)
        assert found.value < bound(FAR, thin)
        assert found.worst < gradient_bound(FAR, thin), found.gradients


@quiet
@pytest.mark.parametrize("shape", [(1e-15,) * 3, (1e15,) * 3, (1e-12, 1e-12, 1e12)])
def test_a_covariance_that_is_singular_to_rounding_is_finite(shape: Shape) -> None:
    for where in (*BEAMS.values(), GRID):
        g = as_leaves(some(shape, 6), DEVICE)
        image = (
            voxelize(g, where, implementation="gpu")
            if isinstance(where, Grid)
            else project(g, where, implementation="gpu")
        )
        assert torch.isfinite(image).all() and float(image.detach().min()) >= 0
        assert float(image.detach().max()) <= 6 * math.sqrt(2 * math.pi) * max(shape)
        image.sum().backward()
        assert all(torch.isfinite(slope).all() for slope in gradients(g).values())


@pytest.mark.parametrize("sigma", [1e-15, 1e-12, 1e12, 1e15])
def test_factors_of_the_quadratic_form_keep_their_digits_at_any_width(sigma: float) -> None:
    # The product of three widths of 1e-15 is no float32 number, and neither is the square of its inverse.
    g = as_leaves(Gaussians.from_physical([[2.0, 0.0, 1.0]], [sigma], [0.8 / sigma]), DEVICE)
    raw = (g.means, g.log_scales, g.quaternions, g.raw_densities)
    run = engine.GpuPass(*(t.detach() for t in raw), g.density_unit)
    seen = run.view(Geometry.parallel([0.0], (5, 9), pixel_pitch=1.0), 0, 1e-6, 3.5, RayModel())
    table = seen.footprints.table[0].tolist()
    np.testing.assert_allclose([table[k] * sigma**2 for k in (K, KV)], 1, rtol=1e-5)
    assert table[W] == pytest.approx(0.8 * math.sqrt(2 * math.pi), rel=1e-5)
    placed = run.box(Grid((5, 5, 5)), 1e-6 / sigma, 3.5).placed.table[0].tolist()
    np.testing.assert_allclose([placed[k.value] * sigma**2 for k in (voxels.KX, voxels.KY, voxels.KZ)], 1, rtol=1e-5)


@pytest.mark.parametrize("length", [1e-11, 1e30, 1e38])
def test_quaternions_of_any_length_give_the_same_picture(length: float) -> None:
    g = some((0.4, 0.9, 1.7))
    unit = g.quaternions / g.quaternions.norm(dim=1, keepdim=True)
    scaled = Gaussians(g.means, g.log_scales, unit * length, g.raw_densities, g.density_unit)
    found = compare(scaled, BEAMS["leaning"], device=DEVICE)
    expected = project(in_double(g), BEAMS["leaning"]).detach()
    np.testing.assert_allclose(found.image, expected, atol=1e-5 * float(expected.max()))
    if length == 1e38:  # 1 / 2e38 is a denormal number
        del found.gradients["quaternions"]
    assert found.worst < gradient_bound(FAR, 0.8), found.gradients


@pytest.mark.parametrize("length", [0.0, 1e-30])
def test_a_quaternion_of_no_length_is_no_rotation_and_feels_nothing(length: float) -> None:
    g = some((0.4, 0.9, 1.7))
    still, identity = torch.zeros_like(g.quaternions), torch.zeros_like(g.quaternions)
    still[:, 2], identity[:, 0] = length, 1.0
    leaves, plain = (
        as_leaves(Gaussians(g.means, g.log_scales, q, g.raw_densities, g.density_unit), DEVICE)
        for q in (still, identity)
    )
    image = project(leaves, BEAMS["parallel"], implementation="gpu")
    np.testing.assert_array_equal(
        image.detach().cpu(), project(plain, BEAMS["parallel"], implementation="gpu").detach().cpu()
    )
    image.sum().backward()
    slopes = gradients(leaves)
    assert not slopes["quaternions"].any() and all(torch.isfinite(slope).all() for slope in slopes.values())
