"""Exact rays of a cone: the kernel compared with the reference, its cut-off, and difficult Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.kernels.cpu.engine import Active, Gradients, camera
from recon.kernels.cpu.rays import CpuRays
from tests.recon.kernels import reference

F32 = NDArray[np.float32]

SHAPE = (33, 41)
WIDE = Geometry.cone(
    [0.4], SHAPE, 0.8, 14.0, 30.0, axis_col=18.3, axis_row=14.0, shifts=[[0.4, -1.3]], roll=0.2, tilt=-0.3
)


UNIT = 0.7


def raw(rng: np.random.Generator, n: int = 25, extent: float = 10.0, largest: float = 2.0) -> tuple[F32, ...]:
    """Means, log scales, quaternions and raw densities."""
    arrays = (
        (rng.random((n, 3)) - 0.5) * extent,
        np.log(rng.uniform(0.2, largest, (n, 3))),
        rng.normal(size=(n, 4)),
        rng.normal(size=n),
    )
    return tuple(a.astype(np.float32) for a in arrays)


def rays_of(active: Active, geometry: Geometry, faint: float = 1e-12, cut: float = 8.0) -> CpuRays:
    parameters = (active.means, active.scales, active.rotations, active.densities)
    return CpuRays(parameters, camera(geometry, 0), geometry.detector_shape, faint, cut)


def exact_view(leaves: Sequence[torch.Tensor], geometry: Geometry) -> torch.Tensor:
    means, log_scales, quaternions, densities = leaves
    every = torch.ones(means.shape[0], dtype=torch.bool)
    density = UNIT * torch.nn.functional.softplus(densities)
    return reference.project_view((means, log_scales.exp(), quaternions, density), geometry, 0, exact=every)


def as_leaves(parameters: tuple[F32, ...]) -> list[torch.Tensor]:
    return [torch.from_numpy(a.astype(np.float64)).requires_grad_() for a in parameters]


def backward(rays: CpuRays, weights: F32) -> tuple[Gradients, F32]:
    n = rays.table.shape[0]
    into, centres = Gradients.zeros(n), np.empty((n, 2), np.float32)
    rays.backward(weights, into.means, into.log_scales, into.rotations, into.densities, centres)
    return into, centres


@given(seed=st.integers(0, 10_000), cut=st.floats(1.0, 4.0), largest=st.sampled_from([0.5, 2.0, 6.0]))
def test_a_ray_sees_a_gaussian_up_to_the_cut_and_not_beyond(seed: int, cut: float, largest: float) -> None:
    # The rays within `cut` standard deviations: the kernel lacks only what the reference has beyond them, and adds
    # nothing beyond, except for Gaussians that reach the source's plane, whose rays fill no ellipse.
    parameters = raw(np.random.default_rng(seed), 1, 9.0, largest)
    means, scales, quaternions, raw_densities = parameters
    active = Active.of(means, scales, quaternions, raw_densities, UNIT)
    image = np.zeros(SHAPE, np.float32)
    rays_of(active, WIDE, cut=cut).add_to(image)
    whole = exact_view(as_leaves(parameters), WIDE).detach().numpy()
    peak = active.densities[0] * active.scales[0].max() * math.sqrt(2 * math.pi)
    edge = float(peak) * math.exp(-(cut**2) / 2)
    seen = image > 0
    assert (whole[~seen] <= edge * 1.001 + 1e-6).all()
    np.testing.assert_allclose(image[seen], whole[seen], atol=1e-5 * float(peak))
    thinnest = float(peak) * float(active.scales[0].min() / active.scales[0].max())
    beam = WIDE.axes(0)[2]
    reach = cut * np.linalg.norm(active.scales[0] * (beam @ active.rotations[0].reshape(3, 3)))
    if WIDE.sod + beam @ active.means[0] > 1.001 * reach:
        assert (whole[seen] >= thinnest * math.exp(-(cut**2) / 2) * 0.999 - 1e-6).all()


@given(
    size=st.floats(-4, 2),
    aspect=st.floats(0, 4),
    flat=st.booleans(),
    depth=st.sampled_from([-14.0, -13.9, -13.8, -12.0, 0.0, 1e4]),
    aside=st.sampled_from([0.0, 3.0, 300.0]),
    seed=st.integers(0, 1000),
)
def test_extreme_gaussians_stay_finite(
    size: float, aspect: float, flat: bool, depth: float, aside: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    u, _, d = WIDE.axes(0)
    long, thin = 10.0**size, 10.0 ** (size - aspect)
    scales = [long, long if flat else thin, thin]
    active = Active.of(
        (aside * u + depth * d).astype(np.float32)[None],
        np.log(np.array([scales], np.float32)),
        rng.normal(size=(1, 4)).astype(np.float32),
        np.zeros(1, np.float32),
        UNIT,
    )
    rays, image = rays_of(active, WIDE, 1e-5, 3.5), np.zeros(SHAPE, np.float32)
    rays.add_to(image)
    assert np.isfinite(image).all() and (image >= 0).all()
    assert image.max() <= 1.001 * active.densities[0] * long * math.sqrt(2 * math.pi)
    into, centres = backward(rays, np.ones(SHAPE, np.float32))
    for gradient in (into.means, into.log_scales, into.rotations, into.densities, centres):
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize("aspect", [1e2, 1e3, 1e4])
def test_long_thin_ones_keep_their_digits(aspect: float, rng: np.random.Generator) -> None:
    # The integral by differences (|e|² - (e·w)² / |w|²) has no digit left in float32 here.
    n = 40
    scales = np.full((n, 3), 1.5 / aspect)
    scales[:, 0] = 1.5
    turn = rng.normal(size=(n, 4)).astype(np.float32)
    means = ((rng.random((n, 3)) - 0.5) * 6).astype(np.float32)
    parameters = (means, np.log(scales).astype(np.float32), turn, np.zeros(n, np.float32))
    rays, image = rays_of(Active.of(*parameters[:4], UNIT), WIDE), np.zeros(SHAPE, np.float32)
    rays.add_to(image)
    expected = exact_view(as_leaves(parameters), WIDE).detach().numpy()
    # A thousandth of a needle's width is what its centre's place in float32 leaves.
    step = 2e-7 * 20 * aspect
    assert float(np.abs(image - expected).max()) < (1e-5 + step) * float(expected.max())
