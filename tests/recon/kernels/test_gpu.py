"""The Triton kernels against the float64 twin and the CPU's kernels: on CUDA where there is one, else interpreted."""

from __future__ import annotations

import importlib
import os

import numpy as np
import pytest
import torch
from torch import Tensor

from recon import fit
from recon.backend import Backend, Cpu, backend_for
from recon.checkpoint import arrays_of, state_from
from recon.density_control import DensityPolicy
from recon.gaussians import Gaussians
from recon.geometry import Geometry
from recon.kernels import footprints_cpu, reference
from recon.kernels.losses_cpu import L1, L2, POISSON, DataTerm
from recon.losses import projection_loss
from recon.losses import total_variation as twin_total_variation
from recon.splat import Active, RayModel, Truncation, project, view_table, voxelize
from recon.volume import Grid
from tests.recon.conftest import Make
from tests.recon.helpers import as_leaves, gradients, in_double

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when triton and the kernels are first imported, that is, here
pytest.importorskip("triton", reason="the GPU kernels need triton (extra gpu, Linux)")
gpu = importlib.import_module("recon.kernels.gpu")
autograd = importlib.import_module("recon.kernels.gpu.autograd")
engine = importlib.import_module("recon.kernels.gpu.engine")
images = importlib.import_module("recon.kernels.gpu.images")
parameters = importlib.import_module("recon.kernels.gpu.parameters")
tiles = importlib.import_module("recon.kernels.gpu.tiles")

WHOLE = (1e-12, 9.0)  # faint, cut: no cut-off worth the name
AFFINE, EXACT = RayModel(), RayModel(exact_above=0.0)
UNIT = 0.7
SHAPE = (19, 26)  # no multiple of a tile


@pytest.fixture
def device() -> torch.device:
    return gpu.require("cuda")


def parallel(shape: tuple[int, int] = SHAPE) -> Geometry:
    return Geometry.parallel([0.7, -4.0], shape, pixel_pitch=0.5, axis_col=shape[1] / 2 - 1.7)


def leaned() -> Geometry:
    return Geometry.parallel([2.5], SHAPE, 0.5, axis_row=8.2, shifts=[[1.3, -0.8]], roll=0.2, tilt=0.3)


def cone(shape: tuple[int, int] = SHAPE) -> Geometry:
    return Geometry.cone([0.4], shape, 1.1, 22.0, 45.0, shape[1] / 2 - 1.1, shifts=[[-0.6, 0.4]], roll=-0.1, tilt=0.2)


def raw_of(g: Gaussians, device: torch.device) -> tuple[Tensor, ...]:
    leaves = as_leaves(g)
    tensors = (leaves.means, leaves.log_scales, leaves.quaternions, leaves.raw_densities)
    return tuple(t.detach().to(device).requires_grad_() for t in tensors)


def twin_view(g: Gaussians, geometry: Geometry, view: int) -> Tensor:
    return reference.project_view(g.means, g.scales, g.quaternions, g.densities, geometry, view)


def assert_gradients(found: tuple[Tensor, ...], twin: Gaussians, relative: float = 2e-5) -> None:
    for tensor, (name, expected) in zip(found, gradients(twin).items(), strict=True):
        assert tensor.grad is not None
        off = float((tensor.grad.cpu().double() - expected).abs().max())
        assert off < relative * float(expected.abs().max()), name


@pytest.mark.parametrize("make", [parallel, leaned, cone])
def test_images_and_gradients_equal_the_twins(make: object, random_gaussians: Make, device: torch.device) -> None:
    geometry = make()  # type: ignore[operator]
    g = random_gaussians(18, 9.0)
    raw, twin = raw_of(g, device), in_double(g)
    found = autograd.project(*raw, UNIT, geometry, *WHOLE, AFFINE)
    expected = torch.stack([twin_view(twin, geometry, view) for view in range(geometry.n_views)])
    peak = float(expected.detach().max())
    assert float((found.detach().cpu() - expected.detach()).abs().max()) < 3e-6 * peak
    weights = torch.from_numpy(np.random.default_rng(3).normal(size=expected.shape))
    (found * weights.float().to(device)).sum().backward()
    (expected * weights).sum().backward()
    assert_gradients(raw, twin)


def test_exact_rays_and_gradients_equal_the_twins(random_gaussians: Make, device: torch.device) -> None:
    geometry, g = cone(), random_gaussians(18, 9.0)
    twin = in_double(g)
    errors = reference.affine_error(twin.means, twin.scales, twin.quaternions, geometry, 0)
    for worst in (0.0, float(errors.median())):
        raw, twin = raw_of(g, device), in_double(g)
        found = autograd.project(*raw, UNIT, geometry, *WHOLE, RayModel(exact_above=worst))[0]
        physical = (twin.means, twin.scales, twin.quaternions, twin.densities)
        expected = reference.project_view(*physical, geometry, 0, exact=errors > worst)
        assert float((found.detach().cpu() - expected.detach()).abs().max()) < 5e-6 * float(expected.detach().max())
        weights = torch.from_numpy(np.random.default_rng(3).normal(size=expected.shape))
        (found * weights.float().to(device)).sum().backward()
        (expected * weights).sum().backward()
        assert_gradients(raw, twin)


@pytest.mark.parametrize("cut", [1.5, 3.0])
def test_exact_rays_end_where_the_cpus_end(cut: float, random_gaussians: Make, device: torch.device) -> None:
    # To the pixel; and forward and backward agree on where.
    g, geometry = random_gaussians(12, 9.0), cone()
    raw, ours = raw_of(g, device), as_leaves(g)
    found = autograd.project(*raw, g.density_unit, geometry, 1e-4, cut, EXACT)[0]
    faint = 1e-4 / (g.density_unit * geometry.sample_pitch * SHAPE[1])
    expected = project(ours, geometry, truncation=Truncation(cut, faint), model=EXACT)[0]
    np.testing.assert_allclose(found.detach().cpu(), expected.detach(), atol=1e-5 * float(expected.detach().max()))
    y = torch.from_numpy(np.random.default_rng(4).normal(size=SHAPE).astype(np.float32))
    (found * y.to(device)).sum().backward()
    (expected * y).sum().backward()
    assert_gradients(raw, ours, 1e-4)
    assert raw[3].grad is not None
    back = raw[3].grad.cpu().double() / (g.density_unit * torch.sigmoid(g.raw_densities.double()))
    left, right = float((found.detach().cpu() * y).double().sum()), float((g.densities.double() * back).sum())
    assert left == pytest.approx(right, rel=2e-5)


@pytest.mark.parametrize("make", [parallel, cone])
def test_the_uncorrected_factor_equals_the_twins(make: object, random_gaussians: Make, device: torch.device) -> None:
    geometry = make()  # type: ignore[operator]
    g = random_gaussians(10, 9.0)
    raw, twin = raw_of(g, device), in_double(g)
    plain = RayModel(rectified=False)
    found = autograd.project(*raw, UNIT, geometry, *WHOLE, plain)[0]
    physical = (twin.means, twin.scales, twin.quaternions, twin.densities)
    expected = reference.project_view(*physical, geometry, 0, length=plain.length(geometry))
    assert float((found.cpu() - expected).detach().abs().max()) < 3e-6 * float(expected.detach().max())
    (found * found).sum().backward()
    (expected * expected).sum().backward()
    assert_gradients(raw, twin)


def test_footprints_equal_the_cpus(random_gaussians: Make, device: torch.device) -> None:
    g, geometry = random_gaussians(30, 30.0), parallel()
    arrays = g.arrays()
    active = Active.of(*(arrays[k] for k in ("means", "log_scales", "quaternions", "raw_densities")), UNIT)
    expected = view_table(active, geometry, 0, 1e-3, 3.5)
    raw = [t.detach() for t in raw_of(g, device)]
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


def test_a_cut_off_ends_at_the_box_whatever_the_tiles(device: torch.device) -> None:
    # One Gaussian over several tiles and image borders: exactly the pixels of its box are lit.
    g = Gaussians.from_physical([[2.3, 0.0, -3.1]], [1.4], [1.0])
    geometry = Geometry.parallel([0.0], (17, 20), axis_col=14.0)
    view = engine.GpuPass(*(t.detach() for t in raw_of(g, device)), 1.0).view(geometry, 0, 1e-9, 2.5, AFFINE)
    image = view.image.cpu().numpy()
    rows, cols = np.abs(np.arange(17) - (8 - 3.1)) <= 2.5 * 1.4, np.abs(np.arange(20) - 16.3) <= 2.5 * 1.4
    np.testing.assert_array_equal(image > 0, rows[:, None] & cols[None, :])
    assert view.footprints.boxes.tolist() == [
        [rows.argmax(), 17 - rows[::-1].argmax(), cols.argmax(), 20 - cols[::-1].argmax()]
    ]


def test_the_backward_pass_is_the_adjoint_where_footprints_are_cut(
    random_gaussians: Make, rng: np.random.Generator, device: torch.device
) -> None:
    # <A ρ, y> = <ρ, Aᵀ y>: render and moments must agree on every pixel of every footprint, also at the cut.
    g = random_gaussians(25, 14.0)
    raw = raw_of(g, device)
    y = torch.from_numpy(rng.normal(size=(2, *SHAPE)).astype(np.float32)).to(device)
    image = autograd.project(*raw, UNIT, parallel(), 1e-3, 2.0, AFFINE)
    (image * y).sum().backward()
    assert raw[3].grad is not None
    back = raw[3].grad.cpu().double() / (UNIT * torch.sigmoid(g.raw_densities.double()))
    left, right = float((image.detach() * y).double().sum()), float((g.densities.double() * back).sum())
    assert left == pytest.approx(right, rel=1e-5)

    raw = raw_of(g, device)
    grid = Grid((9, 11, 10), 0.9)
    y = torch.from_numpy(rng.normal(size=grid.shape).astype(np.float32)).to(device)
    volume = autograd.voxelize(*raw, UNIT, grid, 1e-3, 2.0)
    (volume * y).sum().backward()
    assert raw[3].grad is not None
    back = raw[3].grad.cpu().double() / (UNIT * torch.sigmoid(g.raw_densities.double()))
    left, right = float((volume.detach() * y).double().sum()), float((g.densities.double() * back).sum())
    assert left == pytest.approx(right, rel=1e-5)


@pytest.mark.parametrize("grid", [Grid((9, 12, 10), 0.6, (0.4, -0.8, 1.1)), Grid((5, 9, 8), 0.7, slice_pitch=1.3)])
def test_voxels_and_gradients_equal_the_twins(
    grid: Grid, random_gaussians: Make, rng: np.random.Generator, device: torch.device
) -> None:
    g = random_gaussians(16, 8.0)
    raw, twin = raw_of(g, device), in_double(g)
    found = autograd.voxelize(*raw, UNIT, grid, *WHOLE)
    z, y, x = (torch.from_numpy(axis) for axis in grid.coordinates())
    expected = reference.voxelize(twin.means, twin.scales, twin.quaternions, twin.densities, (z, y, x))
    assert float((found.cpu() - expected).detach().abs().max()) < 3e-6 * float(expected.detach().max())
    weights = torch.from_numpy(rng.normal(size=grid.shape))
    (found * weights.float().to(device)).sum().backward()
    (expected * weights).sum().backward()
    assert_gradients(raw, twin)


@pytest.mark.parametrize("n", [0, 1, 3])
def test_none_one_and_those_that_cover_everything(n: int, device: torch.device) -> None:
    g = Gaussians.from_physical(np.full((n, 3), 0.2), np.full((n, 3), 40.0), np.ones(n), density_unit=1.0)
    raw, twin = raw_of(g, device), in_double(g)
    geometry, grid = Geometry.parallel([1.0], (9, 17)), Grid((3, 9, 9))
    image = autograd.project(*raw, 1.0, geometry, *WHOLE, AFFINE)
    volume = autograd.voxelize(*raw, 1.0, grid, *WHOLE)
    image.sum().backward()
    volume.sum().backward()
    if n == 0:
        assert not image.any() and not volume.any()
        return
    z, y, x = (torch.from_numpy(axis) for axis in grid.coordinates())
    expected = twin_view(twin, geometry, 0)
    dense = reference.voxelize(twin.means, twin.scales, twin.quaternions, twin.densities, (z, y, x))
    np.testing.assert_allclose(image.detach().cpu().numpy()[0], expected.detach().numpy(), rtol=3e-6)
    np.testing.assert_allclose(volume.detach().cpu().numpy(), dense.detach().numpy(), rtol=3e-6)
    (expected.sum() + dense.sum()).backward()
    # The rotation of a ball has no gradient: what is left of it is rounding.
    for tensor, (name, value) in zip(raw, gradients(twin).items(), strict=True):
        assert tensor.grad is not None
        np.testing.assert_allclose(tensor.grad.cpu(), value, rtol=1e-4, atol=0.3 if name == "quaternions" else 1e-3)


def test_what_misses_the_image_or_is_too_faint_has_no_gradient(device: torch.device) -> None:
    g = Gaussians.from_physical([[0.0, 0, 0], [500.0, 0, 0], [0, 0, 1e30]], [1.0, 1.0, 1.0], [1e-9, 1.0, 1.0])
    raw = raw_of(g, device)
    image = autograd.project(*raw, 1.0, Geometry.parallel([0.0], (5, 6)), 1e-6, 3.5, AFFINE)
    assert not image.any()
    image.sum().backward()
    assert all(tensor.grad is not None and not tensor.grad.any() for tensor in raw)


@pytest.mark.parametrize("aspect", [30.0, 1000.0])
def test_a_needle_keeps_its_digits(aspect: float, device: torch.device) -> None:
    # Askew and longer than the image: the expanded quadratic form would lose it in float32.
    g = Gaussians.from_physical([[0.1, 0.2, -0.3]], [[0.03 * aspect, 0.03, 0.03]], [1.0], [[0.9, 0.1, 0.35, 0.2]])
    geometry = Geometry.parallel([0.3], (24, 24), 0.05)
    raw, twin = raw_of(g, device), in_double(g)
    found = autograd.project(*raw, g.density_unit, geometry, *WHOLE, AFFINE)
    expected = twin_view(twin, geometry, 0)
    assert float((found[0].cpu() - expected).detach().abs().max()) < 1e-5 * float(expected.detach().max())
    found.sum().backward()
    expected.sum().backward()
    assert_gradients(raw, twin, 2e-5)


def test_extreme_gaussians_stay_finite(device: torch.device) -> None:
    scales = torch.tensor([[1e-3, 1.0, 1e-3], [1e3, 1e6, 1e3], [1.0, 1.0, 1.0], [0.5, 0.5, 0.5], [1e-30, 1.0, 1.0]])
    g = Gaussians(
        torch.tensor([[0.0, 0.0, 0.0], [1e4, -1e4, 5e3], [1e30, 0.0, 0.0], [0.1, 0.2, 0.3], [0.0, 0.0, 0.0]]),
        torch.log(scales),
        torch.tensor([[1e-30, 0, 1e-30, 0], [1e6, 0, 1e6, 0], [0, 0, 0, 0], [1, 0.2, 0, 0], [1, 1, 1, 0]]),
        torch.tensor([0.5, 3.0, 0.0, -80.0, 0.5]),
    )
    with np.errstate(all="ignore"):  # the interpreter is numpy, which warns of an infinity that a GPU just makes
        for call, where, *model in (
            (autograd.project, parallel(), AFFINE),
            (autograd.project, cone(), AFFINE),
            (autograd.project, cone(), EXACT),
            (autograd.voxelize, Grid((4, 5, 6))),
        ):
            raw = raw_of(g, device)
            out = call(*raw, 1.0, where, 1e-5, 3.5, *model)
            out.sum().backward()
            assert torch.isfinite(out).all() and float(out.detach().min()) >= 0
            assert all(tensor.grad is not None and torch.isfinite(tensor.grad).all() for tensor in raw)


def test_tile_lists_hold_each_box_in_every_tile_it_touches(rng: np.random.Generator, device: torch.device) -> None:
    for shape, edge in (((19, 26), 8), ((5, 17, 9), 4), ((1, 1), 8)):
        low = np.stack([rng.integers(0, size, 60) for size in shape], 1)
        high = np.minimum(low + rng.integers(0, 12, low.shape), shape)
        boxes = np.stack((low, high), 2).reshape(60, -1).astype(np.int32)
        boxes[~(high > low).all(1)] = 0
        lists = tiles.tile_lists(torch.from_numpy(boxes).to(device), shape, edge)
        expected: dict[int, list[int]] = {t: [] for t in range(lists.n_tiles)}
        for i, box in enumerate(boxes.reshape(60, -1, 2)):
            covered = np.zeros(shape, bool)
            covered[tuple(slice(a, b) for a, b in box)] = True
            for t in {int(np.ravel_multi_index(tuple(at // edge), lists.counts)) for at in np.argwhere(covered)}:
                expected[t].append(i)
        starts, owners = lists.starts.cpu().numpy(), lists.owners.cpu().numpy()
        assert starts[-1] == owners.size
        for t, wanted in expected.items():
            assert owners[starts[t] : starts[t + 1]].tolist() == wanted


def test_a_long_list_is_shared_out_and_sums_to_the_same(device: torch.device) -> None:
    rng = np.random.default_rng(2)
    g = Gaussians.from_physical(rng.uniform(-3, 3, (90, 3)), rng.uniform(0.8, 2, (90, 3)), rng.uniform(0.2, 1, 90))
    geometry, grid = Geometry.parallel([0.5], (7, 8)), Grid((4, 5, 6))
    run = engine.GpuPass(*(t.detach() for t in raw_of(g, device)), g.density_unit)
    view, box = run.view(geometry, 0, *WHOLE, AFFINE), run.box(grid, *WHOLE)
    boxes = view.footprints.boxes
    assert tiles.tile_lists(boxes, (7, 8), 8).shares > 1
    assert tiles.tile_lists(torch.zeros_like(boxes), (7, 8), 8).shares == 1
    double = in_double(g)
    expected = twin_view(double, geometry, 0).detach()
    np.testing.assert_allclose(view.image.cpu(), expected, rtol=2e-6)
    z, y, x = (torch.from_numpy(axis) for axis in grid.coordinates())
    volume = reference.voxelize(double.means, double.scales, double.quaternions, double.densities, (z, y, x)).detach()
    np.testing.assert_allclose(box.density.cpu(), volume, rtol=2e-6)


def test_activations_and_gradients_equal_torch(rng: np.random.Generator, device: torch.device) -> None:
    n = 21
    quaternions = rng.normal(size=(n, 4)).astype(np.float32)
    quaternions[:3] = [[0, 0, 0, 0], [1e-20, 0, 0, 0], [3e-7, 4e-7, 0, 0]]
    log_scales, raw = rng.normal(size=(n, 3)).astype(np.float32), (10 * rng.normal(size=n)).astype(np.float32)
    raw[:3] = [-80, -20, 80]
    q, r = (torch.from_numpy(a.astype(np.float64)).requires_grad_() for a in (quaternions, raw))
    turned, dense = reference.rotation_matrices(q).reshape(n, 9), UNIT * torch.nn.functional.softplus(r)
    on_device = [torch.from_numpy(a).to(device) for a in (log_scales, quaternions, raw)]
    scales, rotations, densities = parameters.activate(*on_device, UNIT)
    np.testing.assert_allclose(scales.cpu(), np.exp(log_scales), rtol=1e-5)
    np.testing.assert_allclose(densities.cpu(), dense.detach(), rtol=1e-5)
    np.testing.assert_allclose(rotations.cpu()[2:], turned.detach()[2:], atol=2e-6)
    np.testing.assert_array_equal(rotations.cpu()[:2], np.tile(np.eye(3, dtype=np.float32).ravel(), (2, 1)))

    g_rotations, g_densities = rng.normal(size=(n, 9)).astype(np.float32), rng.normal(size=n).astype(np.float32)
    d_q, d_r = parameters.activation_backward(
        *on_device[1:], UNIT, torch.from_numpy(g_rotations).to(device), torch.from_numpy(g_densities).to(device)
    )
    ((turned * torch.from_numpy(g_rotations)).sum() + (dense * torch.from_numpy(g_densities)).sum()).backward()
    assert q.grad is not None and r.grad is not None
    assert not d_q.cpu()[:2].any()
    np.testing.assert_allclose(d_q.cpu()[2], q.grad[2], rtol=1e-4)
    np.testing.assert_allclose(d_q.cpu()[3:], q.grad[3:], atol=2e-5 * float(q.grad[3:].abs().max()))
    np.testing.assert_allclose(d_r.cpu(), r.grad, rtol=1e-4, atol=1e-12)


def test_adam_and_its_bounds_equal_the_cpus(rng: np.random.Generator, device: torch.device) -> None:
    shapes, rates = ((700, 3), (5, 3), (5, 4), (1,)), (0.01, 0.02, 0.003, 0.1)
    bounds = (None, (-0.5, 0.4), None, (0.1, 2.0))
    ours, theirs = Cpu(), engine.Gpu("cuda")
    start = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
    sets = [[[b.array(p) for p in start], *([b.array(0 * p) for p in start] for _ in range(2))] for b in (ours, theirs)]
    for step in range(1, 4):
        slopes = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
        for backend, (p, first, second) in zip((ours, theirs), sets, strict=True):
            backend.adam(p, [backend.array(slope) for slope in slopes], first, second, rates, step, bounds)
    held = theirs.numpy(sets[1][0][1])
    assert held.min() == np.float32(-0.5) and held.max() == np.float32(0.4)
    for mine, others in zip(*sets, strict=True):
        for a, b in zip(mine, others, strict=True):
            np.testing.assert_allclose(theirs.numpy(b), a, atol=2e-6)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("term", [DataTerm(L1, 1.0, 1.0), DataTerm(L2, 0.3, 1.0), DataTerm(POISSON, 0.2, 1.7)])
def test_projection_loss_and_gradient_equal_the_twin(
    weighted: bool, term: DataTerm, rng: np.random.Generator, device: torch.device
) -> None:
    target = rng.random((19, 33)).astype(np.float32)
    image = (target + 0.2 * rng.normal(size=target.shape)).astype(np.float32)
    image[3, 4] = target[3, 4]
    weights = np.maximum(rng.uniform(-0.5, 2.0, target.shape), 0).astype(np.float32) if weighted else None
    backend = engine.Gpu("cuda")
    loss = backend.projection_loss(target.shape, 0.25, term)
    x, y = backend.array(image), backend.array(target)
    w = None if weights is None else backend.array(weights)
    value, gradient = loss(x, y, loss.target_maps(y, w), w)
    twin, *others = (None if a is None else torch.from_numpy(a.astype(np.float64)) for a in (image, target, weights))
    assert twin is not None
    twin.requires_grad_()
    expected = projection_loss(twin, others[0], 0.25, others[1], term)
    expected.backward()
    assert float(value) == pytest.approx(expected.item(), rel=1e-5)
    assert twin.grad is not None
    np.testing.assert_allclose(gradient.cpu(), twin.grad, atol=2e-5 * float(twin.grad.abs().max()))
    if weights is not None:
        assert not gradient.cpu().numpy()[weights == 0].any()


@pytest.mark.parametrize("weighted", [False, True])
def test_misfit_and_lengths_equal_the_cpus(weighted: bool, rng: np.random.Generator) -> None:
    image, target, w = rng.random((3, 12, 17)).astype(np.float32)
    vectors, factor = rng.normal(size=(31, 2)).astype(np.float32), 2.5
    found = []
    for backend in (Cpu(), backend_for("cuda")):
        weights, sums = backend.array(w) if weighted else None, backend.array(np.arange(31, dtype=np.float32))
        here = [backend.array(a) for a in (image, target, 0 * target)]
        assert float(backend.misfit(here[0], here[2], weights)) == 0
        backend.add_lengths(backend.array(vectors), factor, sums)
        found.append((float(backend.misfit(here[0], here[1], weights)), backend.numpy(sums)))
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-6)
    np.testing.assert_allclose(found[1][1], found[0][1], rtol=1e-6)


@pytest.mark.parametrize("shape", [(5, 6, 11), (1, 4, 4), (1, 1, 3), (1, 1, 1)])
def test_total_variation_and_gradient_equal_the_twin(
    rng: np.random.Generator, shape: tuple[int, int, int], device: torch.device
) -> None:
    volume = torch.from_numpy(rng.normal(size=shape).astype(np.float32))
    value, gradient = engine.losses.total_variation(volume.to(device), 0.3)
    if volume.numel() == 1:
        assert float(value) == 0 and not gradient.any()
        return
    x = volume.double().requires_grad_()
    expected = 0.3 * twin_total_variation(x)
    expected.backward()
    assert float(value) == pytest.approx(expected.item(), rel=1e-6)
    assert x.grad is not None
    np.testing.assert_allclose(gradient.cpu(), x.grad, atol=1e-7)


def _fit(backend: Backend, g: Gaussians, geometry: Geometry, settings: fit.FitSettings) -> tuple[fit.FitState, list]:
    """Five steps with rounds of density control on data and weights that are always the same."""
    rng = np.random.default_rng(5)
    data = rng.random((geometry.n_views, *geometry.detector_shape)).astype(np.float32)
    weights = (rng.random(data.shape) > 0.1).astype(np.float32)
    problem = fit.problem_of(data, geometry, Grid.matching(geometry), UNIT, settings, backend, weights)
    state, told = fit.init(g, 11, 1.5, backend), []
    fit.run(state, problem, settings, 5, lambda s: told.append((s.n, float(s.loss), float(s.residual))) is not None)
    return state, [*told, fit.misfit_of(state, problem, settings)]


@pytest.mark.parametrize(
    ("make", "changes"),
    [
        (parallel, {"loss": "poisson", "views_per_step": 2}),
        (cone, {"loss": "l1", "rays": RayModel(exact_above=0.05)}),
    ],
)
def test_a_fit_is_the_same_on_both_backends(make: object, changes: dict, random_gaussians: Make) -> None:
    g, geometry = random_gaussians(14, 6.0), make((11, 14))  # type: ignore[operator]
    # The CPU's sixteen lanes reach past a box's end; without truncation only rounding is left.
    policy = DensityPolicy(start=0.0, stop=1.0, every=2, threshold=1e-4, prune_below=0.3)
    settings = fit.FitSettings(
        truncation=Truncation(9.0, 1e-12), policy=policy, tv_size=5, pace=10.0, smallest=0.8, **changes
    )
    (ours, said), (theirs, told) = (_fit(backend, g, geometry, settings) for backend in (Cpu(), backend_for("cuda")))
    assert len({n for n, *_ in said[:-1]}) > 1  # density control changed the model
    np.testing.assert_allclose(np.hstack(told), np.hstack(said), rtol=2e-5)
    device = backend_for("cuda")
    for name in fit.NAMES:
        a, b = ours.parameters[name], device.numpy(theirs.parameters[name])
        np.testing.assert_allclose(b, a, atol=2e-5 * float(np.abs(a).max()), err_msg=name)
    np.testing.assert_allclose(device.numpy(theirs.statistic), ours.statistic, atol=2e-5 * ours.statistic.max())
    checkpoint = arrays_of(theirs, device)
    again = state_from(checkpoint, device)
    for key, array in arrays_of(again, device).items():
        np.testing.assert_array_equal(array, checkpoint[key], err_msg=key)


def test_project_and_voxelize_go_where_they_are_sent(random_gaussians: Make, device: torch.device) -> None:
    g, geometry, grid = random_gaussians(9, 8.0), cone(), Grid((4, 6, 5), 0.9)
    model, cut = RayModel(exact_above=0.05), Truncation(9.0, 1e-12)
    there = as_leaves(g, device)
    shown = project(there, geometry, truncation=cut, model=model, kernel="gpu").detach().cpu()
    np.testing.assert_allclose(shown, project(g, geometry, truncation=cut, model=model), rtol=1e-4, atol=1e-5)
    dense = voxelize(there, grid, truncation=cut, kernel="gpu").detach().cpu()
    np.testing.assert_allclose(dense, voxelize(g, grid, truncation=cut), rtol=1e-4, atol=1e-6)
    with pytest.raises(ValueError, match="gpu kernel works in float32"):
        project(in_double(g), geometry, kernel="gpu")


def test_errors_say_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "interpreted", lambda: False)
    with pytest.raises(ValueError, match="run on cuda devices, got cpu"):
        gpu.require("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(RuntimeError, match="sees no CUDA device"):
        gpu.require("cuda:1")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(ValueError, match=r"cuda:1 was asked for.*current one, cuda:0.*CUDA_VISIBLE_DEVICES=1"):
        gpu.require("cuda:1")
    for absent in ("cuda:2", "cuda:200"):  # torch takes the latter for a device of negative number
        with pytest.raises(ValueError, match=rf"{absent} was asked for, and torch sees 2 CUDA devices.*ask for cuda"):
            gpu.require(absent)
    assert gpu.require("cuda:0") == torch.device("cuda:0")
