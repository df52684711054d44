"""Read noise: the figure of each readout and each binning, and amplifiers that differ around their median."""

from __future__ import annotations

import math

import numpy as np
import pytest

from simulators.effects.read_noise import ReadNoise
from tests.simulators import chance, shots


@pytest.mark.parametrize(("readout", "rms"), [("standard", 0.43), ("ultra_quiet", 0.27), ("photon_number", 0.27)])
@pytest.mark.parametrize("binning", [1, 4])
def test_read_noise_is_normal_with_the_readout_s_rms(readout: str, rms: float, binning: int) -> None:
    noise = ReadNoise().apply(np.full((300, 400), 9.0), shots.sized(300, 400, readout=readout, binning=binning))
    chance.mean_is(noise, 9.0, (rms * binning) ** 2)
    chance.variance_is(noise, (rms * binning) ** 2)  # that of binning² pixels adds up
    chance.normal_like((noise - 9) / (rms * binning))


def test_the_second_model_reads_ultra_quiet_with_more_noise() -> None:
    noise = ReadNoise().apply(np.zeros((300, 400)), shots.sized(300, 400, readout="ultra_quiet", model="C15550-22UP"))
    chance.variance_is(noise, 0.3**2)


def test_read_noise_and_offset_make_the_dark() -> None:
    dark = shots.frame(shots.scene("read_noise", "offset"), beam=False).astype(float)
    variance = (0.43 / 0.107) ** 2 + 1 / 12  # of rounding (Janesick 2007)
    chance.mean_is(dark, 200.0, variance)
    chance.variance_is(dark, variance)


def test_each_frame_has_its_own() -> None:
    one, other = (ReadNoise().apply(np.zeros((60, 80)), shots.shot(frame=k)) for k in (1, 2))
    chance.uncorrelated(one, other)


def test_the_rms_may_be_another_camera_s() -> None:
    noise = ReadNoise(rms=10.0).apply(np.zeros((300, 400)), shots.sized(300, 400))
    chance.variance_is(noise, 100.0)
    assert not ReadNoise(rms=0.0).apply(np.zeros((60, 80)), shots.shot()).any()


def test_amplifiers_are_spread_log_normally_around_the_median() -> None:
    """x = rms exp(s n) z: ln|x| has the mean ln rms + E ln|z| and the variance s² + π²/8, for normal n and z."""
    s = 0.4
    noises = [ReadNoise(spread=s).apply(np.zeros((300, 400)), shots.sized(300, 400, frame=k)) for k in (1, 2)]
    logs = np.log(np.abs(noises))
    chance.mean_is(logs[0], math.log(0.43) - (np.euler_gamma + math.log(2)) / 2, s**2 + np.pi**2 / 8)
    second = 0.43**2 * math.exp(2 * s**2)  # E x², and E x⁴ = 3 exp(4 s²) (E x²)²
    chance.mean_is(noises[0] ** 2, second, second**2 * (3 * math.exp(4 * s**2) - 1))
    # The pattern is the sensor's: it is shared by frames, not by another seed.
    shared = float(np.corrcoef(logs[0].ravel(), logs[1].ravel())[0, 1])
    assert shared == pytest.approx(s**2 / (s**2 + np.pi**2 / 8), abs=chance.SIGMAS / math.sqrt(logs[0].size))
    other = ReadNoise(spread=s, seed=1).apply(np.zeros((300, 400)), shots.sized(300, 400, frame=3))
    chance.uncorrelated(logs[0], np.log(np.abs(other)))


def test_spread_amplifiers_add_up_where_pixels_are_summed() -> None:
    noise = ReadNoise(spread=0.3).apply(
        np.zeros((300, 400)), shots.shot(roi=(0, 0, 600, 800), binning=2, detector=shots.sized(300, 400).detector)
    )
    assert (noise**2).mean() == pytest.approx(4 * 0.43**2 * math.exp(2 * 0.3**2), rel=0.03)
