"""Footprint tables and their backward pass compared with the reference, with plain sums over pixels."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.base.geometry import Geometry
from recon.kernels.cpu.engine import Active, Gradients, camera
from recon.kernels.cpu.footprints import (
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

F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]

SHAPE = (20, 26)
TURNED: dict[str, Any] = {"axis_row": 8.0, "shifts": ((0.4, -1.3), (1.2, 0.7)), "roll": (0.2, -0.1), "tilt": -0.3}
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
    means, scales, quaternions, raw_densities = (p.numpy() for p in parameters)
    return Active.of(means, scales, quaternions, raw_densities, UNIT)


def table_of(active: Active, geometry: Geometry, view: int, *, faint: float = 1e-12, **options: Any) -> F32:
    table = footprint_table(len(active.densities))
    parameters = (active.means, active.scales, active.rotations, active.densities)
    footprints(*parameters, camera(geometry, view), faint, 9.0, table, **options)
    return table


def on_pixels(table: F32 | F64) -> tuple[F64, F64, F64]:
    """G [n, row, col] of each footprint and the offsets (τ, δv) [n, row, col] from its centre, in float64."""
    t = table.astype(np.float64)[:, :, None, None]
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    dv = rows[None] - t[:, V]
    dt = cols[None] - t[:, U] - t[:, SHEAR] * dv
    return np.exp(-0.5 * (t[:, K] * dt**2 + t[:, KV] * dv**2)), dt, dv


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
