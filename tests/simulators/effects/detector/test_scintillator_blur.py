"""Scintillator blur: light is kept, widths are those at the sample, and waves are weakened by the closed form."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from simulators.effects.detector.scintillator_blur import ScintillatorBlur, discrete_gaussian
from simulators.frame.detector import Detector
from simulators.frame.shot import Shot
from tests.simulators import shots

SIGMA = 1 / math.sqrt(8 * math.log(2))
"""Standard deviation of a Gaussian of FWHM 1."""


def _shot(shape: tuple[int, int], pixel_um: float = 10.0) -> Shot:
    return shots.shot(detector=Detector.centred(shape, pixel_um * 1e-3))


def _amplitude(effect: ScintillatorBlur, k: int, shot: Shot) -> float:
    """By how much a cosine of k half periods across the rows is weakened."""
    rows, cols = shot.detector.shape
    wave = np.cos(math.pi * k / rows * (np.arange(rows) + 0.5))
    seen = effect.apply(1 + wave[:, None] * np.ones(cols), shot)
    return 2 / rows * float(wave @ seen.mean(axis=1))


@settings(max_examples=40)
@given(
    rows=st.integers(1, 50),
    cols=st.integers(1, 50),
    fwhm=st.floats(0, 200),
    share=st.floats(0, 0.99),
    width=st.floats(0.1, 1000),
    tail=st.sampled_from(["exponential", "lorentzian"]),
)
def test_light_is_kept_and_none_is_negative(
    rows: int, cols: int, fwhm: float, share: float, width: float, tail: Any
) -> None:
    image = np.random.default_rng(rows * 50 + cols).exponential(1000.0, (rows, cols))
    image[image < 1000] = 0.0
    seen = ScintillatorBlur(fwhm, share, width, tail).apply(image.copy(), _shot((rows, cols)))
    assert seen.sum() == pytest.approx(image.sum(), rel=1e-11)
    assert seen.min() >= 0


def test_a_point_becomes_a_gaussian_of_its_width() -> None:
    point = np.zeros((81, 81))
    point[40, 40] = 1.0
    seen = ScintillatorBlur(100.0).apply(point, _shot((81, 81)))  # 10 pixels of FWHM
    line = seen[40] / seen[40, 40]
    right = 40 + int(np.argmax(line[40:] < 0.5))
    half = right - 1 + (line[right - 1] - 0.5) / (line[right - 1] - line[right]) - 40
    assert 2 * half == pytest.approx(10.0, rel=5e-3)
    at = np.arange(81) - 40
    spread = np.sqrt((seen.sum(axis=0) * at**2).sum())
    assert spread == pytest.approx(10 * SIGMA, rel=1e-5)  # exact but for what lies beyond the frame
    assert (line[:40] - line[:40:-1] == 0).all()


def test_the_core_is_the_gaussian_of_another_implementation(rng: np.random.Generator) -> None:
    image = rng.random((60, 90))
    seen = ScintillatorBlur(150.0).apply(image.copy(), _shot((60, 90)))
    np.testing.assert_allclose(seen, gaussian_filter(image, 15 * SIGMA, mode="reflect", truncate=8), atol=1e-8)


@given(variance=st.floats(1e-6, 50))
def test_the_taps_have_the_variance_of_the_gaussian_however_narrow(variance: float) -> None:
    taps = discrete_gaussian(variance)
    n = np.arange(taps.size)
    assert 2 * float(n**2 @ taps) == pytest.approx(variance, rel=1e-5)
    assert taps[0] + 2 * taps[1:].sum() == pytest.approx(1.0, rel=1e-14)
    assert (taps >= 0).all()


@given(variance=st.floats(1.0, 50), omega=st.floats(0, math.pi))
def test_the_taps_have_the_transfer_of_the_sampled_gaussian(variance: float, omega: float) -> None:
    """By Poisson's sum the Gaussian's transfer and its aliases."""
    taps = discrete_gaussian(variance)
    transfer = taps[0] + 2 * float(taps[1:] @ np.cos(omega * np.arange(1, taps.size)))
    aliases = sum(math.exp(-variance * (omega + 2 * math.pi * m) ** 2 / 2) for m in (-1, 0, 1))
    assert transfer == pytest.approx(aliases, abs=2e-8)


@pytest.mark.parametrize("pixel_um", [2.0, 4.0])
@pytest.mark.parametrize("tail", ["exponential", "lorentzian"])
def test_waves_are_weakened_by_the_transfer_of_core_and_tail(pixel_um: float, tail: Any) -> None:
    """Closed forms of the continuous kernels, and the same at the sample whatever is binned."""
    rows = round(1280 / pixel_um)
    shot, effect = _shot((rows, 64), pixel_um), ScintillatorBlur(15.0, 0.2, 80.0, tail)
    for k in (1, 4, 10, 40):
        f = k / (2 * 1280)  # cycles/um
        core = math.exp(-2 * (math.pi * f * 15 * SIGMA) ** 2)
        s = 2 * math.pi * f * 80
        wide = (1 + s**2) ** -1.5 if tail == "exponential" else math.exp(-s)
        assert _amplitude(effect, k, shot) == pytest.approx(0.8 * core + 0.2 * wide, abs=4e-3)


def test_glare_lights_up_what_lies_behind_an_opaque_edge() -> None:
    """Line spread of the Lorentzian: w / pi (x² + w²), so that beyond an edge there is 1/2 - atan(x / w) / pi."""
    image = np.zeros((16, 4096))
    image[:, :2048] = 1.0
    seen = ScintillatorBlur(5.0, 0.1, 200.0, "lorentzian").apply(image, _shot((16, 4096)))[8]
    for x in (200, 400, 1000):  # um; the mirrors are 20 mm away
        column = 2048 + x // 10
        between = (seen[column - 1] + seen[column]) / 2
        assert between / 0.1 == pytest.approx(0.5 - math.atan(x / 200) / math.pi, abs=0.008)


def test_a_core_as_wide_as_a_slip_of_units_is_refused() -> None:
    image: NDArray[np.float64] = np.ones((8, 8))
    with pytest.raises(ValueError, match=r"5000 um FWHM is 212.*as the tail"):
        ScintillatorBlur(5000.0).apply(image, _shot((8, 8)))
