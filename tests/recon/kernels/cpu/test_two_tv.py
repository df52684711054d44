"""Two total variations: each step is compared with NumPy in float64; many steps reach the minimum."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.kernels.cpu.two_tv import ascend, pace_of, primal

F64 = NDArray[np.float64]
WEIGHTS = 1.0, 1.0, 0.7
SHAPES = [(5, 7, 4), (9, 6, 1), (1, 8, 3), (6, 1, 5)]


def differences(x: NDArray[np.floating]) -> F64:
    """D x [3, y, x, z]."""
    out = np.zeros((3, *x.shape))
    for axis, weight in enumerate(WEIGHTS):
        low = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        out[axis][low] = weight * np.diff(x.astype(float), axis=axis)
    return out


def transposed(p: NDArray[np.floating]) -> F64:
    """Dᵀ p [y, x, z], by the definition of a transpose: one unit vector at a time."""
    out = np.zeros(p.shape[1:])
    for at in np.ndindex(out.shape):
        unit = np.zeros(out.shape)
        unit[at] = 1
        out[at] = np.vdot(differences(unit), p)
    return out


def bounded(p: F64, bound: F32) -> F64:
    length = np.sqrt(np.square(p).sum(0))
    return p * np.divide(bound, np.maximum(bound, length), out=np.zeros(bound.shape), where=length + bound > 0)


@pytest.fixture(params=SHAPES, ids=str)
def volumes(request: pytest.FixtureRequest, rng: np.random.Generator) -> list[F32]:
    """z, m, a and b; some bounds are 0."""
    z, m, a, b = (rng.random(request.param, np.float32) for _ in range(4))
    a[0, 0], b[-1, -1] = 0, 0
    return [z, m, a, b]


def test_a_step_is_that_of_the_formula(volumes: list[F32]) -> None:
    z, m, a, b = volumes
    p, q = (np.zeros((3, *z.shape), np.float32) for _ in range(2))
    x, beside = np.empty_like(z), np.empty_like(z)
    for _ in range(2):
        expected = bounded(p + 0.4 * differences(z), a)
        ascend(z, a, 0.4, WEIGHTS, p)
        np.testing.assert_allclose(p, expected, atol=1e-6)
    ascend(z - m, b, 0.4, WEIGHTS, q)
    np.testing.assert_allclose(q, bounded(0.4 * differences(z - m), b), atol=1e-6)
    for nonnegative in (True, False):
        primal(z, (p, q), m, 0.9, WEIGHTS, nonnegative, (x, beside))
        wanted = z - 0.9 * transposed(p + q)
        np.testing.assert_allclose(x, np.maximum(wanted, 0) if nonnegative else wanted, atol=2e-6)
        np.testing.assert_array_equal(beside, x - m)


def test_many_steps_reach_the_minimum(rng: np.random.Generator) -> None:
    """No small change of x lowers ½|x - z|² + t (Σ a |D x| + b |D (x - m)|)."""
    shape, threshold = (6, 5, 3), 0.2
    z, m, a, b = (rng.random(shape, np.float32) for _ in range(4))
    p, q = (np.zeros((3, *shape), np.float32) for _ in range(2))
    x, beside = np.empty_like(z), np.empty_like(z)

    def height(v: NDArray[np.floating]) -> float:
        parts = (np.sqrt(np.square(differences(each)).sum(0)) for each in (v, v - m))
        variations = sum(float((w * part).sum()) for w, part in zip((a, b), parts, strict=True))
        return float(np.square(v.astype(float) - z).sum()) / 2 + threshold * variations

    for _ in range(4000):
        primal(z, (p, q), m, threshold, WEIGHTS, False, (x, beside))
        ascend(x, a, pace_of(threshold, WEIGHTS), WEIGHTS, p)
        ascend(beside, b, pace_of(threshold, WEIGHTS), WEIGHTS, q)
    least = height(x)
    for size in (1e-1, 1e-2, 1e-3):
        for _ in range(20):
            assert height(x + size * rng.standard_normal(shape)) > least - 1e-6
    assert least < height(z) and least < height(m)
