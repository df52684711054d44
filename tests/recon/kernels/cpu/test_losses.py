"""Fused losses compared with torch references; the SSIM of the reference compared with scikit-image."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from recon.kernels.cpu.losses import L2, POISSON, CpuProjectionLoss, DataTerm, total_variation
from tests.recon.kernels.reference import data_term, projection_loss, ssim
from tests.recon.kernels.reference import total_variation as reference_total_variation


def _images(rng: np.random.Generator, shape: tuple[int, int] = (27, 33)) -> tuple[np.ndarray, np.ndarray]:
    target = rng.random(shape).astype(np.float32)
    return (target + 0.2 * rng.normal(size=shape)).astype(np.float32), target


@pytest.mark.parametrize("shape", [(27, 33), (40, 48), (9, 16), (30, 5), (1, 40), (3, 1), (17, 31)])
def test_projection_loss_and_gradient_equal_the_reference(rng: np.random.Generator, shape: tuple[int, int]) -> None:
    image, target = _images(rng, shape)
    loss = CpuProjectionLoss(image.shape, 0.25)
    value, gradient = loss(image, target, loss.target_maps(target))
    gradient = gradient.copy()
    x = torch.from_numpy(image.astype(np.float64)).requires_grad_()
    expected = projection_loss(x, torch.from_numpy(target.astype(np.float64)), 0.25)
    expected.backward()
    assert value == pytest.approx(expected.item(), rel=1e-5)
    assert x.grad is not None
    np.testing.assert_allclose(gradient, x.grad.numpy(), atol=2e-5 * float(x.grad.abs().max()))
    # Nothing of one call stays in the scratch memory for the next, and arrays in pieces serve too.
    same, again = loss(np.asfortranarray(image), target, loss.target_maps(target))
    assert same == value and again.shape == shape
    np.testing.assert_array_equal(again, gradient)


@pytest.mark.parametrize("shape", [(27, 33), (40, 48), (30, 5), (1, 40), (3, 1)])
def test_weighted_loss_and_gradient_equal_the_reference(rng: np.random.Generator, shape: tuple[int, int]) -> None:
    image, target = _images(rng, shape)
    weights = (rng.random(shape) * (rng.random(shape) > 0.3)).astype(np.float32)
    weights[: shape[0] // 3] = 0  # whole rows, more than a window can look across where there are so many
    weights[:, -1] = 0.5
    loss = CpuProjectionLoss(image.shape, 0.25)
    value, gradient = loss(image, target, loss.target_maps(target, weights), weights)
    gradient = gradient.copy()
    x = torch.from_numpy(image.astype(np.float64)).requires_grad_()
    # The reference cannot see what is masked, not even a NaN.
    hidden = torch.from_numpy(np.where(weights > 0, target, np.nan).astype(np.float64))
    expected = projection_loss(x, hidden, 0.25, torch.from_numpy(weights.astype(np.float64)))
    expected.backward()
    assert value == pytest.approx(expected.item(), rel=1e-5)
    assert x.grad is not None
    np.testing.assert_allclose(gradient, x.grad.numpy(), atol=2e-5 * float(x.grad.abs().max()))
    assert not gradient[weights == 0].any()
    # What stands in masked pixels, of either image, changes no bit.
    marred = [np.where(weights > 0, a, np.float32(1e6)) for a in (image, target)]
    same, other = loss(marred[0], marred[1], loss.target_maps(marred[1], weights), weights)
    assert same == value
    np.testing.assert_array_equal(other, gradient)


@pytest.mark.parametrize("term", [DataTerm(L2, 0.05, 1.0), DataTerm(POISSON, 0.02, 3.0)])
@pytest.mark.parametrize("weighted", [False, True])
def test_squares_and_the_poisson_likelihood_equal_the_reference(
    rng: np.random.Generator, term: DataTerm, weighted: bool
) -> None:
    image, target = _images(rng)
    weights = (rng.random(image.shape) * (rng.random(image.shape) > 0.3)).astype(np.float32) if weighted else None
    loss = CpuProjectionLoss(image.shape, 0.25, term=term)
    value, gradient = loss(image, target, loss.target_maps(target, weights), weights)
    x = torch.from_numpy(image.astype(np.float64)).requires_grad_()
    w = None if weights is None else torch.from_numpy(weights.astype(np.float64))
    expected = projection_loss(x, torch.from_numpy(target.astype(np.float64)), 0.25, w, term)
    expected.backward()
    assert value == pytest.approx(expected.item(), rel=1e-5)
    assert x.grad is not None
    np.testing.assert_allclose(gradient, x.grad.numpy(), atol=2e-5 * float(x.grad.abs().max()))


def test_no_transmission_is_above_one(rng: np.random.Generator) -> None:
    image, target = _images(rng)
    target[3:9] -= np.float32(3)  # line integrals below zero: noise, or a flat field that has changed
    likely, squares = (CpuProjectionLoss(image.shape, 0.0, term=DataTerm(kind, 0.02, 4.0)) for kind in (POISSON, L2))
    maps = likely.target_maps(target)
    value, gradient = likely(image, target, maps)
    _, expected = squares(image, target, maps)
    expected *= np.where(target < 0, 1, np.exp(-4 * target))
    np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())
    reference = projection_loss(torch.from_numpy(image), torch.from_numpy(target), 0.0, term=likely.term)
    assert value == pytest.approx(reference.item(), rel=1e-5)


def test_the_poisson_term_is_the_likelihood_of_counts_near_its_minimum() -> None:
    # -log L of N counts where I0 e^-x are expected is I0 (e^-x + e^-y x), y = -log(N / I0); delta = 1 takes I0 away.
    y, step, depth = np.array([[0.3, 1.1, 2.5]]), 1e-3, 1.7
    x = y + step

    def likelihood(at: np.ndarray) -> np.ndarray:
        return (np.exp(-depth * at) + np.exp(-depth * y) * depth * at) / depth**2

    term = data_term(torch.from_numpy(x), torch.from_numpy(y), DataTerm(POISSON, 1.0, depth)).numpy()
    np.testing.assert_allclose(term, likelihood(x) - likelihood(y), rtol=2e-3)


@pytest.mark.parametrize("size", [10.0, 1e3, 1e4, 1e8])
def test_images_far_brighter_than_they_should_be_do_not_break_the_loss(rng: np.random.Generator, size: float) -> None:
    # Variances are differences of squares. Of values of 1e3 none of their digits is left: naively they come out
    # negative, 1 / (vx + vy + c2) anything, and one hot pixel gives NaN to a whole model.
    target = np.full((40, 48), size, np.float32)
    image = (target + 0.05 * rng.normal(size=target.shape)).astype(np.float32)
    naive = np.float32(np.mean(image * image)) - np.float32(np.mean(image)) ** 2
    loss = CpuProjectionLoss(image.shape, 0.25)
    value, gradient = loss(image, target, loss.target_maps(target))
    absolute = float(np.abs(image.astype(np.float64) - target).mean())
    assert absolute <= value <= absolute + 0.25 * 2.001  # SSIM lies in -1..1
    assert np.isfinite(gradient).all()
    if size == 10.0:
        expected = projection_loss(torch.from_numpy(image).double(), torch.from_numpy(target).double(), 0.25)
        # A variance is known to some eight roundings of the square.
        assert value == pytest.approx(float(expected), abs=0.25 * 2 * 8 * 2.0**-24 * size**2 / loss.c2)
    else:
        assert abs(naive - 0.05**2) > 0.05**2
    one = np.zeros((40, 48), np.float32)
    one[20, 20] = size
    value, gradient = loss(one, target / size, loss.target_maps(target / size))
    assert np.isfinite(value) and np.isfinite(gradient).all()


def test_ssim_equals_scikit_image_in_the_interior(rng: np.random.Generator) -> None:
    # The borders differ by choice (zeros there, reflection here), so only the inside is compared.
    image, target = (a.astype(np.float64) for a in _images(rng, (60, 60)))
    _, full = structural_similarity(
        image, target, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, full=True
    )
    grown = ssim(torch.from_numpy(image), torch.from_numpy(target)).item()
    assert grown == pytest.approx(float(full.mean()), abs=0.02)
    # Zero frames around both images make the two border rules agree.
    padded = [np.pad(a, 10) for a in (image, target)]
    _, full = structural_similarity(
        *padded, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, full=True
    )
    assert ssim(torch.from_numpy(padded[0]), torch.from_numpy(padded[1])).item() == pytest.approx(
        float(full.mean()), abs=1e-6
    )


@pytest.mark.parametrize("shape", [(5, 6, 7), (1, 4, 4), (1, 1, 3), (1, 1, 1)])
def test_total_variation_and_gradient_equal_the_reference(
    rng: np.random.Generator, shape: tuple[int, int, int]
) -> None:
    volume = rng.normal(size=shape).astype(np.float32)
    gradient = np.empty_like(volume)
    value = total_variation(volume, gradient, 0.3)
    if volume.size == 1:
        assert value == 0 and gradient[0, 0, 0] == 0
        return
    x = torch.from_numpy(volume.astype(np.float64)).requires_grad_()
    expected = 0.3 * reference_total_variation(x)
    expected.backward()
    assert value == pytest.approx(expected.item(), rel=1e-6)
    assert x.grad is not None
    np.testing.assert_allclose(gradient, x.grad.numpy(), atol=1e-7)
