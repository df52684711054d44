"""Footprint tables and their backward pass against the reference, with plain sums over pixels in between."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.base.geometry import Geometry
from recon.kernels.cpu.engine import Active, Gradients, camera
from recon.kernels.cpu.footprints import (
    HIDDEN,
    HU,
    HV,
    INEXACT,
    KV,
    SHEAR,
    K,
    U,
    V,
    W,
    footprint_table,
    footprints,
    footprints_backward,
)
from tests.recon.kernels import reference

F64 = NDArray[np.float64]

SHAPE = (20, 26)
TURNED = {"axis_row": 8.0, "shifts": ((0.4, -1.3), (1.2, 0.7)), "roll": (0.2, -0.1), "tilt": -0.3}
ANGLES = (0.4, -2.7)
GEOMETRIES = {
    "straight": Geometry.parallel(ANGLES, SHAPE, pixel_pitch=0.5, axis_col=11.3, shifts=((0.4, -1.3), (1.2, 0.7))),
    "turned": Geometry.parallel(ANGLES, SHAPE, pixel_pitch=0.5, axis_col=11.3, **TURNED),
    "cone": Geometry.cone(ANGLES, SHAPE, 0.8, 25.0, 40.0, axis_col=11.3),
    "turned cone": Geometry.cone(ANGLES, SHAPE, 0.8, 25.0, 40.0, axis_col=11.3, **TURNED),
}
UNIT = 0.7


def raw(rng: np.random.Generator, n: int = 30, extent: float = 10.0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means, log scales, quaternions and raw densities, float32."""
    arrays = (
        (rng.random((n, 3)) - 0.5) * extent,
        np.log(rng.uniform(0.4, 1.6, (n, 3))),
        rng.normal(size=(n, 4)),
        rng.normal(size=n),
    )
    return tuple(torch.from_numpy(a.astype(np.float32)) for a in arrays)  # type: ignore[return-value]


def active_of(parameters: tuple[Tensor, ...]) -> Active:
    return Active.of(*(p.numpy() for p in parameters), UNIT)


def table_of(active: Active, geometry: Geometry, view: int, *, faint: float = 1e-12, **options: float) -> F64:
    table = footprint_table(len(active.densities))
    parameters = (active.means, active.scales, active.rotations, active.densities)
    footprints(*parameters, camera(geometry, view), faint, 9.0, table, **options)
    return table


def on_pixels(table: F64) -> tuple[F64, F64, F64]:
    """G [n, row, col] of each footprint and the offsets (τ, δv) [n, row, col] from its centre, in float64."""
    t = table.astype(np.float64)[:, :, None, None]
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    dv = rows[None] - t[:, V]
    dt = cols[None] - t[:, U] - t[:, SHEAR] * dv
    return np.exp(-0.5 * (t[:, K] * dt**2 + t[:, KV] * dv**2)), dt, dv


def leaves(parameters: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return tuple(p.double().requires_grad_() for p in parameters)


def reference_image(doubles: tuple[Tensor, ...], geometry: Geometry, view: int, length: float) -> Tensor:
    means, log_scales, quaternions, densities = doubles
    density = UNIT * torch.nn.functional.softplus(densities)
    return reference.project_view((means, log_scales.exp(), quaternions, density), geometry, view, length=length)


@pytest.mark.parametrize("length", [0.0, 2.5], ids=["rectified", "plain"])
@pytest.mark.parametrize("name", GEOMETRIES)
def test_footprints_and_gradients_equal_the_reference(name: str, length: float, rng: np.random.Generator) -> None:
    geometry, parameters = GEOMETRIES[name], raw(rng)
    active = active_of(parameters)
    weights = rng.normal(size=(2, *SHAPE))
    into, centres = Gradients.zeros(30), np.empty((30, 2), np.float32)
    doubles = leaves(parameters)
    for view in range(2):
        table = table_of(active, geometry, view, length=length)
        shapes, dt, dv = on_pixels(table)
        image = np.einsum("n,nrc->rc", table[:, W], shapes)
        expected = reference_image(doubles, geometry, view, length)
        np.testing.assert_allclose(image, expected.detach().numpy(), atol=3e-6 * float(expected.detach().max()))

        (expected * torch.from_numpy(weights[view])).sum().backward()
        g = weights[view][None] * shapes
        powers = np.stack((g, g * dt, g * dv, g * dt * dt, g * dt * dv, g * dv * dv), -1)
        moments = powers.sum((1, 2)).astype(np.float32)
        footprints_backward(
            table, moments, active.means, active.scales, active.rotations, active.densities, camera(geometry, view),
            into.means, into.log_scales, into.rotations, into.densities, centres, length=length,
        )  # fmt: skip
    found = into.to_raw(parameters[2].numpy(), parameters[3].numpy(), UNIT)
    for gradient, leaf in zip(found, doubles, strict=True):
        assert leaf.grad is not None
        np.testing.assert_allclose(gradient, leaf.grad.numpy(), atol=2e-5 * float(leaf.grad.abs().max()))


@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_gradient_on_centres_is_that_of_moving_the_picture(name: str, rng: np.random.Generator) -> None:
    # Density control asks how hard the image pulls at a footprint, in pixels: shift the view and see.
    geometry, parameters = GEOMETRIES[name], raw(rng, 1, 3.0)
    active, weights = active_of(parameters), rng.normal(size=SHAPE)
    table = table_of(active, geometry, 0)
    g, dt, dv = on_pixels(table)
    g *= weights
    powers = np.stack((g, g * dt, g * dv, g * dt * dt, g * dt * dv, g * dv * dv), -1)
    centres = np.empty((1, 2), np.float32)
    into = Gradients.zeros(1)
    footprints_backward(
        table, powers.sum((1, 2)).astype(np.float32), active.means, active.scales, active.rotations, active.densities,
        camera(geometry, 0), into.means, into.log_scales, into.rotations, into.densities, centres,
    )  # fmt: skip

    def loss(shift: tuple[float, float]) -> float:
        moved = table.astype(np.float64)
        moved[:, U] += shift[0]
        moved[:, V] += shift[1]
        return float((weights * moved[0, W] * on_pixels(moved)[0]).sum())

    h = 1e-4
    expected = [(loss((h, 0)) - loss((-h, 0))) / (2 * h), (loss((0, h)) - loss((0, -h))) / (2 * h)]
    np.testing.assert_allclose(centres[0], expected, rtol=1e-4, atol=1e-5)


def test_a_cone_lists_those_whose_affine_picture_is_off(rng: np.random.Generator) -> None:
    geometry, parameters = GEOMETRIES["turned cone"], raw(rng)
    means, log_scales, quaternions, _ = leaves(parameters)
    estimate = reference.affine_error(means, log_scales.exp(), quaternions, geometry, 0).numpy()
    bound = float(np.median(estimate))
    all_of_them = table_of(active_of(parameters), geometry, 0)
    judged = table_of(active_of(parameters), geometry, 0, exact_above=bound)
    off = estimate > bound
    assert 10 < off.sum() < 20
    assert (judged[off, HU] == INEXACT).all() and (judged[off, HV] == INEXACT).all()
    np.testing.assert_array_equal(judged[~off], all_of_them[~off])
    np.testing.assert_array_equal(judged[:, : W + 1], all_of_them[:, : W + 1])


def test_what_is_behind_the_source_or_too_faint_is_hidden_and_has_no_gradient(rng: np.random.Generator) -> None:
    cone = Geometry.cone([0.0], SHAPE, 1.0, 10.0, 20.0)
    means, log_scales, quaternions, densities = raw(rng, 4, 0.0)
    means[:, 1] = torch.tensor([-10.0, -9.95, -30.0, 0.0])  # the source is at y = -10
    densities[3] = -60.0
    active = active_of((means, log_scales, quaternions, densities))
    table = table_of(active, cone, 0, faint=1e-6)
    assert (table[:3, HU] == HIDDEN).all() and table[3, HU] < 0
    assert np.isfinite(table).all()
    into, centres = Gradients.zeros(4), np.ones((4, 2), np.float32)
    footprints_backward(
        table, np.full((4, 6), 1e6, np.float32), active.means, active.scales, active.rotations, active.densities,
        camera(cone, 0), into.means, into.log_scales, into.rotations, into.densities, centres,
    )  # fmt: skip
    for gradient in (into.means, into.log_scales, into.rotations, into.densities, centres):
        assert not gradient.any()
