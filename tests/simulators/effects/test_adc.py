"""ADC: steps of a code, their rounding noise, the range's ends and the bow between them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from simulators.effects.adc import Adc
from simulators.frame.sensor import digitise
from simulators.frame.shot import CannotExposeError
from tests.simulators import chance, shots


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


def test_it_ends_the_counts() -> None:
    frame = shots.frame(shots.scene("photon_noise", "read_noise", "offset", {"kind": "adc", "bits": 12}))
    assert not (frame % 16).any()
    assert frame.max() > 30_000


@pytest.mark.parametrize("adc", [{"bits": 12}, {"bits": 8}, {"nonlinearity": 0.01}])
def test_photon_numbers_are_not_resolved_with_a_lesser_converter(adc: dict[str, float]) -> None:
    """8 bits would show none of 40 photons: their steps are 256 counts."""
    shot = shots.shot(readout="photon_number")
    with pytest.raises(CannotExposeError, match="of 16 bits"):
        shots.frame(shots.scene("photon_noise", {"kind": "adc", **adc}), shot)
    straight, plain = (shots.frame(shots.scene("photon_noise", *also, flux=4e3), shot) for also in (["adc"], []))
    np.testing.assert_array_equal(straight, plain)
