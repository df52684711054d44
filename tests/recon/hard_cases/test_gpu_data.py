"""Difficult data and parameters on the Triton kernels: far too bright, masked, of any size; see `on_gpu`."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
import torch

from recon.base.geometry import Geometry
from recon.base.kernel import Truncation
from recon.base.volume import Grid
from recon.kernels.cpu.losses import L2, POISSON, DataTerm
from recon.kernels.reference import projection_loss
from recon.splatting import optimise as fit
from recon.splatting.backend import backend_for
from recon.splatting.settings import FitSettings
from tests.recon.hard_cases.measure import STEP
from tests.recon.hard_cases.on_gpu import DEVICE, quiet, some
from tests.recon.helpers import run_steps

engine = importlib.import_module("recon.kernels.gpu.engine")
parameters = importlib.import_module("recon.kernels.gpu.parameters")
pytestmark = pytest.mark.slow  # where the interpreter stands in; tests/recon/kernels/gpu is quick


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


@quiet
@pytest.mark.parametrize("term", [None, DataTerm(L2, 0.05, 1.0), DataTerm(POISSON, 0.02, 3.0)])
def test_what_stands_in_a_pixel_of_no_weight_changes_no_bit(rng: np.random.Generator, term: DataTerm | None) -> None:
    target = rng.random((14, 18)).astype(np.float32)
    image = (target + 0.2 * rng.normal(size=target.shape)).astype(np.float32)
    weights = (rng.random(target.shape) * (rng.random(target.shape) > 0.3)).astype(np.float32)
    weights[3:9, 4:12] = 0  # a hole wider than SSIM's window sees around
    value, gradient = losses_of(image, target, weights, term)
    assert np.isfinite(value) and not gradient[weights == 0].any()
    marred = [np.where(weights > 0, a, np.float32(3e38)) for a in (image, target)]
    again, same = losses_of(*marred, weights, term)
    assert again == value
    np.testing.assert_array_equal(same, gradient)


@quiet
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
        problem = fit.problem_of(data, views, flat, 0.7, settings, backend)
        state = run_steps(fit.init(some((1.0, 1.4, 0.8), 4), 3, 1.0, backend), problem, settings, 1)
        states.append({name: backend.numpy(values) for name, values in state.parameters.items()})
    for name, expected in states[0].items():
        np.testing.assert_allclose(states[1][name], expected, atol=2e-5 * float(np.abs(expected).max()), err_msg=name)
