"""Voxelisation and its backward pass against the float64 reference: anisotropic voxels, needles, dots, small boxes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.base.kernel import Kernel
from recon.kernels.cpu.voxelize import Layout
from tests.recon.kernels import reference

F32 = NDArray[np.float32]
Model = tuple[F32, F32, F32, F32]


def _model(rng: np.random.Generator, n: int, low: float = 0.6, high: float = 3.0) -> tuple[Model, F32]:
    """Means, scales, rotations [n, 9], densities; and the quaternions that the rotations come from."""
    means = rng.uniform(-6, 6, (n, 3)).astype(np.float32)
    scales = np.exp(rng.uniform(np.log(low), np.log(high), (n, 3))).astype(np.float32)
    quaternions = rng.normal(size=(n, 4)).astype(np.float32)
    rotations = reference.rotation_matrices(torch.from_numpy(quaternions)).reshape(n, 9).numpy()
    return (means, scales, np.ascontiguousarray(rotations), rng.uniform(0.2, 1, n).astype(np.float32)), quaternions


def _axes(origin: tuple[float, ...], spacing: tuple[float, ...], shape: tuple[int, ...]) -> tuple[torch.Tensor, ...]:
    """Voxel centres (z, y, x)."""
    return tuple(
        o + torch.arange(n, dtype=torch.float64) * e for o, e, n in zip(origin[::-1], spacing, shape, strict=True)
    )


def _reference(
    model: Model, quaternions: F32, axes: tuple[torch.Tensor, ...], kernel: Kernel = Kernel.GAUSSIAN
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    means, scales, _, densities = model
    leaves = [
        torch.from_numpy(a.astype(np.float64)).requires_grad_() for a in (means, np.log(scales), quaternions, densities)
    ]
    p, log_s, q, d = leaves
    return reference.voxelize(p, log_s.exp(), q, d, axes, kernel), leaves  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("spacing", "shape"),
    [
        ((1.0, 1.0, 1.0), (12, 13, 17)),
        ((2.5, 0.7, 0.7), (6, 20, 18)),
        ((0.8, 0.5, 1.9), (15, 5, 7)),
        ((1, 1, 1), (1, 1, 1)),
    ],
)
def test_density_and_gradients_equal_the_reference(
    rng: np.random.Generator, spacing: tuple[float, float, float], shape: tuple[int, int, int]
) -> None:
    model, quaternions = _model(rng, 12)
    origin = tuple(-e * (n - 1) / 2 for e, n in zip(spacing[::-1], shape[::-1], strict=True))
    layout = Layout(model, origin, spacing, shape, 0.0, 6.0)  # type: ignore[arg-type]
    expected, leaves = _reference(model, quaternions, _axes(origin, spacing, shape))
    top = float(expected.detach().max())
    np.testing.assert_allclose(layout.fill(), expected.detach().numpy(), atol=1e-5 * max(1.0, top))

    g = rng.normal(size=shape).astype(np.float32)
    (expected * torch.from_numpy(g.astype(np.float64))).sum().backward()
    n = 12
    into = [np.zeros(s, np.float32) for s in ((n, 3), (n, 3), (n, 9), (n,))]
    layout.backward(g, *into)
    for mine, leaf in ((into[0], leaves[0]), (into[1], leaves[1]), (into[3], leaves[3])):
        assert leaf.grad is not None
        np.testing.assert_allclose(mine, leaf.grad.numpy(), atol=3e-5 * float(leaf.grad.abs().max()) + 1e-9)
    # The rotations' gradient through the quaternions.
    q = torch.from_numpy(quaternions.astype(np.float64)).requires_grad_()
    (reference.rotation_matrices(q).reshape(n, 9) * torch.from_numpy(into[2].astype(np.float64))).sum().backward()
    assert q.grad is not None and leaves[2].grad is not None
    np.testing.assert_allclose(
        q.grad.numpy(), leaves[2].grad.numpy(), atol=3e-5 * float(leaves[2].grad.abs().max()) + 1e-9
    )

    still = [np.zeros_like(a) for a in into]
    layout.backward(g, *still, means_too=False)
    assert not still[0].any()
    for a, b in zip(still[1:], into[1:], strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_backward_pass_is_the_adjoint_in_density(rng: np.random.Generator) -> None:
    # Truncated or not: <fill(ρ), g> = ρ · ∂ρ, since both passes take the same voxels.
    model, _ = _model(rng, 40, 0.2, 4.0)
    shape = (9, 14, 20)
    layout = Layout(model, (-7.0, -5.0, -4.0), 1.0, shape, 1e-4, 3.5)
    g = rng.normal(size=shape).astype(np.float32)
    into = [np.zeros(s, np.float32) for s in ((40, 3), (40, 3), (40, 9), (40,))]
    layout.backward(g, *into)
    volume = layout.fill().astype(np.float64)
    right = np.vdot(model[3].astype(np.float64), into[3])
    assert abs(np.vdot(volume, g) - right) < 1e-5 * np.vdot(volume, np.abs(g))


@pytest.mark.parametrize("kernel", Kernel)
@pytest.mark.parametrize("scales", [(30.0, 0.3, 0.3), (20.0, 20.0, 0.3), (300.0, 0.5, 0.5), (0.05, 0.05, 0.05)])
def test_needles_discs_and_dots_keep_their_digits(
    rng: np.random.Generator, scales: tuple[float, ...], kernel: Kernel
) -> None:
    (means, _, rotations, densities), quaternions = _model(rng, 6)
    thin = np.tile(np.array(scales, np.float32), (6, 1))
    if max(scales) < 0.1:
        means = (np.round(means) + 0.02).astype(np.float32)  # else no voxel sees them
    model = (means, thin, rotations, densities)
    layout = Layout(model, (-6.0, -6.0, -6.0), 1.0, (13, 13, 13), 0.0, 5.0, kernel)
    expected = _reference(model, quaternions, _axes((-6.0,) * 3, (1.0,) * 3, (13, 13, 13)), kernel)[0].detach().numpy()
    assert expected.max() > 0.05
    # A float32 rotation turns a needle by 6e-8: at its end, ten voxels off, a few 1e-6 of the thin width's slope.
    np.testing.assert_allclose(layout.fill(), expected, atol=3e-5)


def test_only_gaussians_that_meet_the_box_are_placed(rng: np.random.Generator) -> None:
    # More than one task of the search, most of it outside, in the order of the model.
    model, _ = _model(rng, 3000, 0.3, 0.6)
    model[0][:] = rng.uniform(-100, 100, (3000, 3))
    shape, origin = (10, 11, 12), (3.0, -20.0, 40.0)
    layout = Layout(model, origin, 2.0, shape, 1e-6, 3.5)
    low, high = np.array(origin), np.array(origin) + 2.0 * (np.array(shape[::-1]) - 1)
    reach = 3.5 * np.sqrt(((model[2].reshape(-1, 3, 3) * model[1][:, None, :]) ** 2).sum(2))
    expected = np.flatnonzero(((model[0] + reach >= low) & (model[0] - reach <= high)).all(1))
    # Those that lie between two slices are met by none.
    assert set(layout.hits) <= set(expected) and np.all(np.diff(layout.hits) > 0)
    assert len(layout.hits) > 0
    brute = Layout(tuple(a[expected] for a in model), origin, 2.0, shape, 1e-6, 3.5)
    np.testing.assert_array_equal(layout.fill(), brute.fill())


def test_nothing_to_place_is_an_empty_volume() -> None:
    nothing = tuple(np.empty(s, np.float32) for s in ((0, 3), (0, 3), (0, 9), (0,)))
    far = tuple(np.full(s, 1e6, np.float32) for s in ((2, 3), (2, 3), (2, 9), (2,)))
    faint = tuple(np.ones(s, np.float32) for s in ((2, 3), (2, 3), (2, 9), (2,)))
    for model, limit in ((nothing, 0.0), (far, 1e9), (faint, 2.0)):
        layout = Layout(model, (0.0, 0.0, 0.0), 1.0, (3, 4, 5), limit, 3.5)
        assert layout.hits.size == 0 and not layout.fill().any()
        into = [np.zeros_like(a) for a in (model[0], model[1], model[2], model[3])]
        layout.backward(np.ones((3, 4, 5), np.float32), *into)
        assert not any(a.any() for a in into)


sizes = st.floats(-5, 5).map(lambda x: 10**x)


@given(sizes, sizes, sizes, st.floats(-20, 20), st.floats(-20, 20), st.integers(0, 2**31), sizes, st.booleans())
def test_any_gaussian_is_finite(
    a: float, b: float, c: float, x: float, z: float, seed: int, edge: float, compact: bool
) -> None:
    kernel = Kernel.COMPACT if compact else Kernel.GAUSSIAN
    (means, _, rotations, _), _ = _model(np.random.default_rng(seed), 1)
    means[0] = x, 0.3, z
    model = (means, np.array([[a, b, c]], np.float32), rotations, np.ones(1, np.float32))
    layout = Layout(model, (-4.0, -3.0, -2.0), (edge, 1.0, 1.0), (5, 7, 9), 1e-6, 3.5, kernel)
    volume = layout.fill()
    assert np.isfinite(volume).all() and volume.min() >= 0 and volume.max() <= 1.0001
    into = [np.zeros(s, np.float32) for s in ((1, 3), (1, 3), (1, 9), (1,))]
    layout.backward(np.ones((5, 7, 9), np.float32), *into)
    assert all(np.isfinite(g).all() for g in into)
