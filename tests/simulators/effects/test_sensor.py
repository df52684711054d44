"""The sensor: efficiency, noise, dark current, full well, offset and converter."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from simulators.effects.sensor import (
    FEW,
    Adc,
    DarkCurrent,
    Offset,
    PhotonNoise,
    ReadNoise,
    Saturation,
)
from simulators.frame import sensor
from simulators.frame.sensor import digitise
from simulators.frame.shot import CannotExposeError
from tests.simulators import chance, shots

CONVERSION = sensor.CONVERSION["standard"]


@pytest.mark.parametrize(
    ("effect", "share"),
    [
        ({"value": 0.25}, 0.25),
        ({"wavelength_nm": 300}, 0.5),
        ({"wavelength_nm": 450}, 0.85),
        ({"wavelength_nm": 535}, 0.73),  # between 0.80 at 500 and 0.70 at 550 nm
        ({"wavelength_nm": 1000}, 0.09),
        ({"path": {"absorbed": 0.25, "light": 100, "aperture": 0.6, "index": 1.0, "transmission": 0.5}}, 0.9125),
    ],
)
def test_a_share_of_the_light_is_detected(effect: dict[str, float], share: float) -> None:
    flat = shots.frame(shots.scene({"kind": "quantum_efficiency"} | effect), sample=False)
    assert (flat == round(4000 * share / CONVERSION)).all()


def test_what_is_no_expectation_is_refused() -> None:
    with pytest.raises(ValueError, match="expected values must be 0"):
        PhotonNoise().apply(np.full((60, 80), -1.0), shots.shot())


@pytest.mark.parametrize(("exposure", "binning"), [(0.05, 1), (20.0, 1), (20.0, 2), (100.0, 1), (100.0, 4)])
def test_dark_electrons_are_poisson(exposure: float, binning: int) -> None:
    shot = shots.sized(600, 700, exposure=exposure, binning=binning)
    dark, mean = DarkCurrent().apply(np.zeros((600, 700)), shot), 0.0036 * exposure * binning**2
    chance.mean_is(dark, mean, mean)
    chance.variance_is(dark, mean, 1 / mean)
    chance.poisson_like(dark, mean)
    chance.uncorrelated(dark[1:], dark[:-1])


def test_either_way_has_one_distribution() -> None:
    for rate in (0.99 * FEW, 1.01 * FEW):
        dark = DarkCurrent(rate).apply(np.zeros((600, 700)), shots.sized(600, 700, exposure=1.0))
        chance.poisson_like(dark, rate)


def test_it_adds_new_electrons_to_each_frame() -> None:
    one, other = (DarkCurrent(5.0).apply(np.full((60, 80), 10.5), shots.shot(frame=k)) for k in (1, 2))
    assert set(np.unique(one)) <= {10.5, 11.5, 12.5}
    assert (one != other).any()


def _response(effect: Saturation, charge: NDArray[np.float64], binning: int = 1) -> NDArray[np.float64]:
    return effect.apply(np.atleast_2d(charge).copy(), shots.shot(binning=binning))[0]


def test_charge_beyond_the_full_well_is_lost() -> None:
    np.testing.assert_array_equal(_response(Saturation(), np.array([0, 6999.5, 7000, 9e9])), [0, 6999.5, 7000, 7000])
    np.testing.assert_array_equal(_response(Saturation(100.0), np.array([399.0, 500.0]), 2), [399, 400])  # four pixels


@given(st.floats(0.01, 1), st.floats(10, 1e5))
def test_the_knee_bends_smoothly_towards_the_full_well(knee: float, well: float) -> None:
    charge = np.linspace(0, 4 * well, 4001)
    out, begin = _response(Saturation(well, knee), charge), (1 - knee) * well
    np.testing.assert_array_equal(out[charge <= begin], charge[charge <= begin])
    bent = (charge > begin) & (well - out > 1e-6 * knee * well)
    # From the equation the other way round: x = x0 - (W - x0) ln(1 - (y - x0) / (W - x0)).
    back = begin - knee * well * np.log((well - out[bent]) / (knee * well))
    np.testing.assert_allclose(back, charge[bent], rtol=1e-6)
    slope = np.diff(out) / np.diff(charge)
    assert (slope >= 0).all()
    assert (slope <= 1 + 1e-9).all()
    assert out.max() <= well


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


def test_the_offset_is_added_in_counts() -> None:
    assert (Offset().apply(np.full((60, 80), 5.0), shots.shot()) == 205).all()
    binned = shots.shot(binning=4, detector=shots.sized(15, 20).detector)
    assert (Offset().apply(np.full((15, 20), 5.0), binned) == 205).all()
    assert (shots.frame(shots.scene("offset"), beam=False) == 200).all()


def test_photon_numbers_have_none() -> None:
    photons = np.full((60, 80), 5.0)
    assert (Offset(spread=1.0).apply(photons, shots.shot(readout="photon_number")) == 5).all()


def test_pixels_differ_and_stay() -> None:
    one, other = (Offset(1.5).apply(np.zeros((300, 400)), shots.sized(300, 400, frame=k)) - 200 for k in (1, 2))
    chance.normal_like(one / 1.5)
    chance.variance_is(one, 1.5**2)
    np.testing.assert_array_equal(one, other)
    chance.uncorrelated(one, Offset(1.5, seed=1).apply(np.zeros((300, 400)), shots.sized(300, 400)))
    summed = shots.sized(300, 400, binning=2, detector=shots.sized(150, 200).detector)
    found = Offset(1.5).apply(np.zeros((150, 200)), summed) - 200
    np.testing.assert_allclose(found, one.reshape(150, 2, 200, 2).sum(axis=(1, 3)))


def _codes(effect: Adc, counts: NDArray[np.float64]) -> NDArray[np.float64]:
    return effect.apply(np.atleast_2d(counts).copy(), shots.shot())[0]


def test_sixteen_straight_bits_are_the_converter_without_it() -> None:
    counts = np.concatenate([np.random.default_rng(0).uniform(-100, 66_000, 5000), [0.5, 1.5, 65534.5]])
    np.testing.assert_array_equal(_codes(Adc(), counts), digitise(counts.copy()))


@pytest.mark.parametrize(("bits", "step"), [(8, 256), (12, 16)])
def test_fewer_bits_are_wider_steps_of_the_same_scale(bits: int, step: int) -> None:
    counts = np.random.default_rng(0).uniform(2 * step, 65_535 - 2 * step, 20_000)
    codes = _codes(Adc(bits=bits), counts)  # type: ignore[arg-type]
    assert not (codes % step).any()
    chance.mean_is(codes - counts, 0.0, step**2 / 12)  # rounding (Janesick 2007)
    chance.variance_is(codes - counts, step**2 / 12, -1.2)
    assert np.abs(codes - counts).max() <= step / 2
    np.testing.assert_array_equal(_codes(Adc(bits=bits), np.array([-5.0, 9e9])), [0, step * (2**bits - 1)])  # type: ignore[arg-type]


def test_the_bow_is_zero_at_both_ends_and_largest_in_the_middle() -> None:
    counts = np.arange(65536.0)
    bow = _codes(Adc(nonlinearity=0.01), counts) - counts
    assert (bow[0], bow[-1]) == (0, 0)
    assert bow.max() == pytest.approx(0.01 * 65535, abs=1)
    x = counts / 65535
    assert np.abs(bow - 0.04 * 65535 * x * (1 - x)).max() <= 0.5 + 1e-9
    assert (np.diff(_codes(Adc(nonlinearity=-0.25), counts)) >= 0).all()


@pytest.mark.parametrize("adc", [{"bits": 12}, {"bits": 8}, {"nonlinearity": 0.01}])
def test_photon_numbers_are_not_resolved_with_a_lesser_converter(adc: dict[str, float]) -> None:
    """8 bits would show none of 40 photons: their steps are 256 counts."""
    shot = shots.shot(readout="photon_number")
    with pytest.raises(CannotExposeError, match="of 16 bits"):
        shots.frame(shots.scene("photon_noise", {"kind": "adc", **adc}), shot)
    straight, plain = (shots.frame(shots.scene("photon_noise", *also, flux=4e3), shot) for also in (["adc"], []))
    np.testing.assert_array_equal(straight, plain)
