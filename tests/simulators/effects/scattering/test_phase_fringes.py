"""Phase fringes: closed forms of waves, Fresnel's integral, the limit of short distances, and no light lost."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from simulators.effects.scattering.phase_fringes import HC, PhaseFringes
from simulators.frame.shot import Detector, Shot
from tests.messages import refused
from tests.simulators import shots

Reals = NDArray[np.float64]
PITCH = 1e-3


def _shot(shape: tuple[int, int], pitch: float = PITCH, sod: float = math.inf) -> Shot:
    return shots.shot(detector=Detector.centred(shape, pitch, sod))


def _intensity(effect: PhaseFringes, depth: Reals, pitch: float = PITCH, sod: float = math.inf) -> Reals:
    return np.exp(-effect.apply(depth.copy(), _shot(depth.shape, pitch, sod)))


def _distance(fresnel_number: float, energy: float = 20.0, pitch: float = PITCH) -> float:
    """mm at which a pixel has this Fresnel number."""
    return pitch**2 * energy / HC / fresnel_number


@pytest.mark.parametrize(("delta_beta", "width", "peak"), [(0.0, 10, 0.863), (8.0, 26, 3.5)])
def test_a_gaussian_wave_spreads_or_is_focused_as_the_closed_form_says(
    delta_beta: float, width: float, peak: float
) -> None:
    """exp(-A r²/2), A = (1 + i g) / s², becomes A'/A exp(-A' r²/2) with 1/A' = 1/A + i wavelength z / 2 pi."""
    n, s, z = 256, width * PITCH, _distance(1 / 250)
    u = (np.arange(n) - (n - 1) / 2) * PITCH
    r2 = u**2 + u[:, None] ** 2
    a = (1 + 1j * delta_beta) / s**2
    after = 1 / (1 / a + 1j * HC / 20 * z / (2 * math.pi))
    expected = abs(after / a) ** 2 * np.exp(-after.real * r2)
    seen = _intensity(PhaseFringes(delta_beta, z, 20.0), r2 / s**2)
    np.testing.assert_allclose(seen, expected, atol=5e-5)
    assert expected.max() == pytest.approx(peak, rel=0.02)  # a phase of the other sign would spread it


@pytest.mark.parametrize("number", [400.0, 200.0])
def test_at_a_short_distance_it_is_the_transport_of_intensity(number: float, rng: np.random.Generator) -> None:
    """T - (z delta / mu) laplace T (Paganin et al. 2002); delta / mu = g wavelength / 4 pi. The next order is z²."""
    depth = gaussian_filter(rng.random((96, 96)), 5.0, mode="reflect")
    depth = (depth - depth.min()) / np.ptp(depth)
    t = np.exp(-depth)
    g, area = 25.0, 1 / number
    k = np.pi * np.fft.fftfreq(192)[:, None] * 2
    mirrored = np.block([[t, t[:, ::-1]], [t[::-1], t[::-1, ::-1]]])
    laplacian = np.fft.ifft2(-(k**2 + k.T**2) * np.fft.fft2(mirrored)).real[:96, :96]
    first = -g * area / (4 * math.pi) * laplacian
    seen = _intensity(PhaseFringes(g, _distance(number), 20.0), depth)
    second = (np.abs(first).max() / t.min()) ** 2
    np.testing.assert_allclose(seen - t, first, atol=second + 1e-5)
    assert np.abs(first).max() > 10 * (second + 1e-5)


@given(
    rows=st.integers(8, 40),
    cols=st.integers(8, 40),
    number=st.floats(0.2, 50),
    g=st.floats(0, 3),
    seed=st.integers(0, 99),
)
def test_light_is_kept_and_none_is_negative(rows: int, cols: int, number: float, g: float, seed: int) -> None:
    depth = np.random.default_rng(seed).exponential(0.5, (rows, cols))
    depth[rows // 2 :, cols // 2 :] = 5.0  # a wave that hardly passes
    effect = PhaseFringes(min(g, 3.1 / np.ptp(depth)), _distance(number), 20.0)
    seen = _intensity(effect, depth)
    assert seen.sum() == pytest.approx(np.exp(-depth).sum(), rel=1e-5)
    assert seen.min() >= 0


def test_a_cone_is_a_plane_wave_over_the_effective_distance() -> None:
    """sod 100 mm and 400 mm behind it: M = 5, z / M = 80 mm, in the sample's scale."""
    depth = shots.depth(shots.scene(), 0.4)
    cone = _intensity(PhaseFringes(1.5, 400.0, 20.0), depth, sod=100.0)
    plane = _intensity(PhaseFringes(1.5, 80.0, 20.0), depth)
    np.testing.assert_allclose(cone, plane, atol=1e-6)
    assert np.abs(cone - np.exp(-depth)).max() > 0.05


def test_oversampling_follows_what_a_finer_detector_would_see(rng: np.random.Generator) -> None:
    """A smooth depth on pixels of half the pitch, propagated there and averaged, against oversampling of the coarse."""
    fine = gaussian_filter(rng.random((128, 128)), 8.0, mode="reflect")
    fine = 2 * (fine - fine.min()) / np.ptp(fine)
    coarse = fine.reshape(64, 2, 64, 2).mean(axis=(1, 3))
    z = _distance(1 / 4)
    finely = _intensity(PhaseFringes(24.0, z, 20.0), fine).reshape(64, 2, 64, 2).mean(axis=(1, 3))
    seen = _intensity(PhaseFringes(24.0, z, 20.0, oversampling=4), coarse, pitch=2 * PITCH)
    assert np.abs(finely - np.exp(-coarse)).max() > 0.15
    np.testing.assert_allclose(seen, finely, atol=0.03)


def test_transport_is_the_first_order_with_the_laplacian_of_neighbours(rng: np.random.Generator) -> None:
    depth = gaussian_filter(rng.random((60, 90)), 2.0, mode="reflect")
    t = np.exp(-depth)
    padded = np.pad(t, 1, mode="symmetric")
    laplacian = padded[2:, 1:-1] + padded[:-2, 1:-1] + padded[1:-1, 2:] + padded[1:-1, :-2] - 4 * t
    seen = _intensity(PhaseFringes(200.0, _distance(5.0), 20.0, method="transport"), depth)
    np.testing.assert_allclose(seen, t - 200 / (4 * math.pi * 5) * laplacian, rtol=1e-12)
    assert np.abs(seen - t).max() > 0.02


def test_transport_and_the_wave_agree_on_the_edges_of_a_solid() -> None:
    """A wire of 24 pixels and 7 rad a pixel at its steepest, Fresnel number 6.7; the wave with 8 x 8 pixels a pixel,
    less what averaging over these does at no distance."""
    u = np.arange(64) - 31.5
    depth = np.tile(0.1 * np.sqrt(np.maximum(0, 12.0**2 - u**2)), (16, 1))
    wave = PhaseFringes(40.0, _distance(6.7), 20.0, oversampling=8)
    change = _intensity(wave, depth) - _intensity(replace(wave, distance=0.0), depth)
    moved = _intensity(replace(wave, oversampling=1, method="transport"), depth) - np.exp(-depth)
    assert np.abs(change).max() > 0.12
    assert np.std(moved - change) < 0.06 * np.std(change)


def test_oversampling_alone_averages_over_a_pixel() -> None:
    """Straight lines between pixels have the means (1, 6, 1) / 8 of three pixels, where the depth is small."""
    depth = np.zeros((9, 9))
    depth[4, 4] = 1e-4
    seen = 1 - _intensity(PhaseFringes(0.0, 0.0, 20.0, oversampling=8), depth)
    expected = np.zeros((9, 9))
    expected[3:6, 3:6] = np.outer([1, 6, 1], [1, 6, 1]) / 64 * 1e-4
    np.testing.assert_allclose(seen, expected, atol=3e-6)


def test_transport_far_from_the_sample_is_refused() -> None:
    with refused(ValueError):
        PhaseFringes(40.0, _distance(0.5), 20.0, method="transport").apply(np.zeros((8, 8)), _shot((8, 8)))


def test_a_wave_that_would_alias_is_refused_and_the_depth_left() -> None:
    depth = np.zeros((64, 64))
    depth[:, 32:] = 1.0
    effect = PhaseFringes(20.0, 1.0, 20.0)
    kept = depth.copy()
    with refused(ValueError):
        effect.apply(depth, _shot((64, 64)))
    np.testing.assert_array_equal(depth, kept)
    replace(effect, oversampling=7).apply(depth, _shot((64, 64)))


def test_a_propagator_that_would_alias_is_refused() -> None:
    """wavelength z = N p² is the last that is taken."""
    far, shot = _distance(1 / 64), _shot((64, 80))
    PhaseFringes(1.0, far * 0.999, 20.0).apply(np.zeros((64, 80)), shot)
    with refused(ValueError):
        PhaseFringes(1.0, far * 1.001, 20.0).apply(np.zeros((64, 80)), shot)
    with refused(ValueError):
        PhaseFringes(1.0, far * 0.6, 20.0, oversampling=2).apply(np.zeros((64, 80)), shot)
