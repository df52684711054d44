"""A broad blur, and the bands of rows that threads share."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from itertools import pairwise

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import j0

from simulators.pixels import bands
from simulators.pixels.broad_blur import Transfer, add_enlarged, broad_blur, exponential, gaussian, lorentzian

KERNELS: dict[Transfer, Callable[[float], float]] = {
    gaussian: lambda r: math.exp(-(r**2) / 2) / (2 * math.pi),
    exponential: lambda r: math.exp(-r) / (2 * math.pi),
    lorentzian: lambda r: (1 + r**2) ** -1.5 / (2 * math.pi),
}


def _blurred(image: np.ndarray, width: float, transfer: Transfer) -> np.ndarray:
    out = np.zeros_like(image)
    add_enlarged(out, broad_blur(image, width, transfer), 1.0)
    return out


@pytest.mark.parametrize("transfer", KERNELS)
def test_each_transfer_is_the_hankel_transform_of_its_kernel(transfer: Transfer) -> None:
    kernel = KERNELS[transfer]
    for omega in (0.0, 0.5, 1.0, 2.0):
        # In pieces of half a period; the Lorentzian's slow end is an alternating sum, halved at its last term.
        edges = np.arange(0, 400) * (math.pi / max(omega, 0.5))
        parts = [quad(lambda r, w: 2 * math.pi * r * kernel(r) * j0(w * r), a, b, args=(omega,))[0]
                 for a, b in pairwise(edges)]  # fmt: skip
        total = sum(parts) if omega == 0 else sum(parts) - parts[-1] / 2
        assert float(transfer(np.array(omega**2))) == pytest.approx(total, abs=2e-3)


@pytest.mark.parametrize("transfer", KERNELS)
def test_the_spread_of_a_point_is_the_kernel(transfer: Transfer) -> None:
    """32 pixels wide, worked out at an eighth, where the point is one pixel; mirrors are 30 widths away."""
    n, width = 2048, 32.0
    point = np.zeros((n, n))
    point[n // 2 - 4 : n // 2 + 4, n // 2 - 4 : n // 2 + 4] = 1 / 64
    r = np.hypot(0.5, np.arange(n) - (n / 2 - 0.5)) / width
    expected = np.vectorize(KERNELS[transfer])(r) / width**2
    seen = _blurred(point, width, transfer)[n // 2]
    near = (r > 0.5) & (r < 2.5)
    np.testing.assert_allclose(seen[near], expected[near], rtol=0.03, atol=0.015 / (2 * math.pi * width**2))


@pytest.mark.parametrize("transfer", KERNELS)
@pytest.mark.parametrize(("width", "small"), [(3.0, 3.0), (8.0, 4.0), (40.0, 5.0)])
def test_waves_are_weakened_by_the_transfer(transfer: Transfer, width: float, small: float) -> None:
    """A cosine that fits between the mirrors stays one. `small` is the width in pixels of the smaller image: there the
    discrete Laplacian is off by w^4/12, and shrinking and enlarging blur by a variance of 1/4; for the Gaussian both
    come to less than 0.1 / small² of transfer, and the others fall more slowly."""
    n = 320
    for k in (1, 3, 8, 16, 30):
        omega = math.pi * k / n
        wave = np.cos(omega * (np.arange(n) + 0.5))
        seen = _blurred(1 + wave[:, None] * np.ones(80), width, transfer) - 1
        amplitude = 2 / n * float(wave @ seen.mean(axis=1))
        assert amplitude == pytest.approx(float(transfer(np.array((omega * width) ** 2))), abs=0.2 / small**2)


@given(
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    scale=st.sampled_from([1, 2, 4]),
    width=st.floats(0.01, 200),
    transfer=st.sampled_from(list(KERNELS)),
    seed=st.integers(0, 99),
)
def test_light_is_kept_and_none_is_negative(
    shape: tuple[int, int], scale: int, width: float, transfer: Transfer, seed: int
) -> None:
    image = np.random.default_rng(seed).exponential(1000.0, (shape[0] * scale, shape[1] * scale))
    image[image < 1000] = 0.0
    seen = _blurred(image, width, transfer)
    assert seen.sum() == pytest.approx(image.sum(), rel=1e-11)
    assert seen.min() >= 0


@pytest.mark.parametrize("transfer", KERNELS)
@pytest.mark.parametrize("width", [1e5, 1e12, 1e200])
def test_a_width_far_beyond_the_frame_spreads_evenly_and_at_once(transfer: Transfer, width: float) -> None:
    image = np.random.default_rng(1).random((24, 36))
    np.testing.assert_allclose(_blurred(image, width, transfer), image.mean(), rtol=1e-6)


def test_an_even_image_stays_and_a_tiny_width_changes_nothing() -> None:
    np.testing.assert_allclose(_blurred(np.full((24, 36), 7.0), 20.0, exponential), 7.0, rtol=1e-12)
    image = np.random.default_rng(1).random((24, 36))
    np.testing.assert_allclose(_blurred(image, 1e-6, lorentzian), image, atol=1e-5)


@pytest.mark.parametrize("threads", [1, 2, 3, 7])
@pytest.mark.parametrize("shape", [(1, 100_000), (5, 100_000), (1000, 100), (3, 4)])
def test_every_row_is_done_once(monkeypatch: pytest.MonkeyPatch, threads: int, shape: tuple[int, int]) -> None:
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
    rows: list[int] = []
    bands.share_rows(lambda first, end: rows.extend(range(first, end)), shape)
    assert sorted(rows) == list(range(shape[0]))


def test_small_frames_stay_in_their_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 2)
    seen: list[threading.Thread] = []
    bands.share_rows(lambda first, end: seen.append(threading.current_thread()), (64, 64))
    assert seen == [threading.current_thread()]
    bands.share_rows(lambda first, end: seen.append(threading.current_thread()), (2048, 64))
    assert threading.current_thread() not in seen[1:]


def test_an_error_comes_through(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 2)
    with pytest.raises(ZeroDivisionError):
        bands.share_rows(lambda first, end: print(1 // 0), (1000, 1000))
