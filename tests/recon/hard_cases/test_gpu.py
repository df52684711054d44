"""Hard cases only for the Triton kernels: tiles, footprint tables, losses and parameters."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest
import torch

from recon.base.geometry import Geometry
from recon.base.kernel import RayModel, Truncation
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.kernels.cpu.footprints import KV, K, W
from recon.kernels.cpu.losses import L2, POISSON, DataTerm
from recon.splatting import optimise as fit
from recon.splatting.backend import backend_for
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings
from tests.recon.hard_cases.measure import STEP, WHOLE, bound, gradient_bound
from tests.recon.hard_cases.on import at, gpu
from tests.recon.helpers import as_leaves, run_steps
from tests.recon.kernels.gpu.on_gpu import DEVICE
from tests.recon.kernels.reference import project, projection_loss

engine, passes, parameters, tiles, voxels = (
    importlib.import_module(f"recon.kernels.gpu.{name}")
    for name in ("engine", "passes", "parameters", "tiles", "voxels")
)
# where the interpreter stands in, which is numpy and warns of an infinity; tests/recon/kernels/gpu is quick
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning")]
ON = gpu()


def test_on_the_borders_of_images_and_tiles() -> None:
    sigma = 0.4
    cols, rows = (-1.0, -0.5, 0.0, 7.5, 8.0, 12.0, 12.5, 13.0), (-1.0, 0.0, 7.5, 8.0, 10.0, 11.0)
    found = ON.compare(at([(u, 0.0, v) for u in cols for v in rows], sigma), ON.view)
    assert found.value < bound(ON.far, 0.7 * sigma)
    assert found.worst < gradient_bound(ON.far, 0.7 * sigma), found.gradients


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


def test_a_pile_at_one_pixel_does_not_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    # All alike, of a weight whose last digits a sum of more than 128 rounds away, each time; in one share, as in an
    # image of many tiles.
    monkeypatch.setattr(tiles, "PROGRAMS", 1)
    groups, weight = 200, 1 + 0.9 * 2.0**-17
    one = Gaussians.from_physical([[0.0, 0.0, 0.0]], [0.9], [weight / (0.9 * math.sqrt(2 * math.pi))])
    pile = as_leaves(one.select(torch.zeros(groups * passes._GROUP, dtype=torch.int64)), DEVICE)
    shown = project(pile, Geometry.parallel([0.0], (1, 1), pixel_pitch=1.0), truncation=WHOLE, gpu=True)
    off = abs(float(shown.detach()) / (groups * passes._GROUP * weight) - 1)
    assert off < 16 * STEP  # of it the weight's own: a dozen roundings
    one_by_one = np.cumsum(np.full(groups, weight, np.float32), dtype=np.float32)[-1]
    assert abs(float(one_by_one) / (groups * weight) - 1) > 32 * STEP


def losses_of(
    image: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None, term: DataTerm | None = None
) -> tuple[float, np.ndarray]:
    backend = engine.Gpu("cuda")
    loss = backend.projection_loss(image.shape, 0.25, *(() if term is None else (term,)))
    x, y = backend.array(image), backend.array(target)
    w = None if weights is None else backend.array(weights)
    value, gradient = loss(x, y, loss.target_maps(y, w), w)
    return float(value), backend.numpy(gradient)


@pytest.mark.parametrize("size", [10.0, 1e4, 1e8])
def test_images_far_brighter_than_they_should_be_do_not_break_the_loss(rng: np.random.Generator, size: float) -> None:
    target = np.full((14, 18), size, np.float32)
    image = (target + 0.05 * rng.normal(size=target.shape)).astype(np.float32)
    value, gradient = losses_of(image, target)
    absolute = float(np.abs(image.astype(np.float64) - target).mean())
    assert absolute * (1 - 1e-6) <= value <= absolute + 0.25 * 2.001  # SSIM lies in -1..1
    assert np.isfinite(gradient).all()
    if size == 10.0:
        expected = projection_loss(torch.from_numpy(image).double(), torch.from_numpy(target).double(), 0.25)
        # A variance is known to some eight roundings of the square.
        assert value == pytest.approx(float(expected), abs=0.25 * 2 * 8 * 2.0**-24 * size**2 / 0.03**2)
    one = np.zeros((14, 18), np.float32)
    one[7, 9] = size
    value, gradient = losses_of(one, target / size)
    assert np.isfinite(value) and np.isfinite(gradient).all()


@pytest.mark.parametrize("term", [None, DataTerm(L2, 0.05, 1.0), DataTerm(POISSON, 0.02, 3.0)])
def test_what_stands_in_a_pixel_of_no_weight_changes_no_bit(rng: np.random.Generator, term: DataTerm | None) -> None:
    target = rng.random((14, 18)).astype(np.float32)
    image = (target + 0.2 * rng.normal(size=target.shape)).astype(np.float32)
    weights = (rng.random(target.shape) * (rng.random(target.shape) > 0.3)).astype(np.float32)
    weights[3:9, 4:12] = 0  # a hole wider than SSIM's window sees around
    value, gradient = losses_of(image, target, weights, term)
    assert np.isfinite(value) and not gradient[weights == 0].any()
    marred = [np.where(weights > 0, a, np.float32(3e38)) for a in (image, target)]
    again, same = losses_of(marred[0], marred[1], weights, term)
    assert again == value
    np.testing.assert_array_equal(same, gradient)


def test_any_finite_parameters_give_finite_ones_and_gradients(rng: np.random.Generator) -> None:
    n = 400
    values = rng.choice([-1.0, 1.0], (n, 8)) * 2.0 ** rng.uniform(-140, 100, (n, 8))
    logs, quaternions, raw = (
        torch.from_numpy(a.astype(np.float32)).to(DEVICE) for a in (values[:, :3], values[:, 3:7], values[:, 7])
    )
    scales, rotations, densities = parameters.activate(logs, quaternions, raw, 1.0)
    assert torch.isfinite(scales).all() and (scales > 0).all()
    assert torch.isfinite(densities).all() and (densities >= 0).all()
    turned = rotations.cpu().double().reshape(n, 3, 3)
    np.testing.assert_allclose(turned @ turned.transpose(1, 2), np.tile(np.eye(3), (n, 1, 1)), atol=1e-5)
    g = torch.ones((n, 9), device=DEVICE)
    d_quaternions, d_raw = parameters.activation_backward(quaternions, raw, 1.0, g, g[:, 0].contiguous())
    assert torch.isfinite(d_quaternions).all() and torch.isfinite(d_raw).all()


def test_densities_and_their_slopes_have_all_digits_far_down() -> None:
    # log(1 + e^raw) as it stands is 0 from -17 on, and e^raw is no float32 number from 89 on.
    raw = torch.cat((torch.linspace(-86, 86, 691), torch.tensor([-1e-20, 0.0, 1e-20])))
    n = len(raw)
    zeros, quaternions = torch.zeros((n, 3), device=DEVICE), torch.ones((n, 4), device=DEVICE)
    _, _, densities = parameters.activate(zeros, quaternions, raw.to(DEVICE), 1.0)
    limit = 1e-6 + 4 * STEP * raw.abs().double()  # the exponential's own: its argument's rounding
    exact = torch.logaddexp(raw.double(), torch.zeros(n, dtype=torch.float64))
    assert ((densities.cpu().double() / exact - 1).abs() < limit).all()
    g = torch.ones((n, 9), device=DEVICE)
    _, d_raw = parameters.activation_backward(quaternions, raw.to(DEVICE), 1.0, g, g[:, 0].contiguous())
    assert ((d_raw.cpu().double() / torch.sigmoid(raw.double()) - 1).abs() < limit).all()


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (1, 1)])
def test_detectors_of_one_row_or_column_with_a_pixel_missing_are_the_cpus(
    shape: tuple[int, int], rng: np.random.Generator
) -> None:
    views = Geometry.parallel([0.3, 1.9], shape)
    data = rng.random((2, *shape)).astype(np.float32)
    data[0, 0, 0] = np.nan if shape != (1, 1) else 0.3  # a view of nothing else is refused
    settings = FitSettings(policy=None, tv_size=3, truncation=Truncation(9.0, 1e-12))
    flat = Grid((2, 5, 4), 1.0, slice_pitch=2.5)
    states = []
    for device in ("cpu", "cuda"):
        backend = backend_for(device)
        problem = fit.problem_of(Views(data, views), flat, 0.7, settings, backend)
        state = run_steps(fit.init(ON.some((1.0, 1.4, 0.8), 4), 3, 1.0, backend), problem, settings, 1)
        states.append({name: backend.numpy(values) for name, values in state.parameters.items()})
    for name, expected in states[0].items():
        np.testing.assert_allclose(states[1][name], expected, atol=2e-5 * float(np.abs(expected).max()), err_msg=name)
