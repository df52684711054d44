"""A beam of several energies: harmonics and beam hardening."""

from __future__ import annotations

import math
from decimal import Decimal, getcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.effects.beam.energies import BeamHardening, Harmonics
from simulators.frame import sensor
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


@given(depth=st.floats(-1e-12, 1e4), share=st.floats(0, 1), ratio=st.floats(0, 1))
def test_transmissions_of_both_energies_add_up(depth: float, share: float, ratio: float) -> None:
    """Against 60 digits, since exp(-1e4) is no float."""
    getcontext().prec = 60
    d, f, r = Decimal(depth), Decimal(share), Decimal(ratio)
    expected = -float(((1 - f) * (-d).exp() + f * (-d * r).exp()).ln())
    seen = Harmonics(share, ratio).apply(np.array([[depth]]), shots.shot())
    assert seen[0, 0] == pytest.approx(expected, rel=1e-11, abs=1e-14)


def test_a_frame_has_a_twenty_seventh_of_the_attenuation_at_the_third_harmonic() -> None:
    depth = shots.depth(shots.scene(), 0.4)
    frame = shots.frame(shots.scene({"kind": "harmonics", "share": 0.02})) * CONVERSION / 4000
    np.testing.assert_allclose(frame, 0.98 * np.exp(-depth) + 0.02 * np.exp(-depth / 27), atol=2e-5)
    flat = shots.frame(shots.scene({"kind": "harmonics", "share": 0.02}), sample=False)
    assert (flat == round(4000 / CONVERSION)).all()


SPECTRA = st.lists(st.tuples(st.floats(1e-3, 1e3), st.floats(5, 120)), min_size=1, max_size=6)


def _seen(effect: BeamHardening, depth: list[float]) -> list[float]:
    return effect.apply(np.array([depth]), shots.shot())[0].tolist()


def test_two_energies_have_the_closed_form() -> None:
    """20 and 40 keV, 3 : 1: attenuations 8 : 1, and 32/25 and 4/25 of their mean."""
    depth = shots.depth(shots.scene(), 0.4)
    scene = shots.scene({"kind": "beam_hardening", "weights": [3, 1], "energies": [20, 40]})
    expected = 0.75 * np.exp(-depth * 32 / 25) + 0.25 * np.exp(-depth * 4 / 25)
    np.testing.assert_allclose(shots.frame(scene) * CONVERSION / 4000, expected, atol=2e-5)
    assert (shots.frame(scene, sample=False) == round(4000 / CONVERSION)).all()


@given(SPECTRA)
def test_a_thin_sample_is_seen_as_it_is_and_a_thick_one_as_less(spectrum: list[tuple[float, float]]) -> None:
    weights, energies = zip(*spectrum, strict=True)
    effect = BeamHardening(weights, energies=energies)
    thin, some, more, most = _seen(effect, [1e-6, 0.5, 1.0, 5.0])
    assert thin == pytest.approx(1e-6, rel=2e-3)  # the next term is at most d x the spread of the ratios
    assert some <= 0.5 + 1e-12
    assert more <= 2 * some + 1e-12  # d' is concave (Hölder)
    assert some < more < most


@given(SPECTRA)
def test_only_proportions_of_weights_and_attenuations_count(spectrum: list[tuple[float, float]]) -> None:
    weights, energies = zip(*spectrum, strict=True)
    ratios = tuple(7.3 * energy**-3 for energy in energies)
    by_energy = _seen(BeamHardening(weights, energies=energies), [0.3, 4.0])
    by_ratio = _seen(BeamHardening(tuple(5 * w for w in weights), ratios=ratios), [0.3, 4.0])
    assert by_energy == pytest.approx(by_ratio, rel=1e-12)


def test_one_energy_is_beer_lambert_and_no_depth_is_too_large() -> None:
    assert _seen(BeamHardening((2.0,), energies=(30.0,)), [0.0, 1.0, 900.0]) == pytest.approx([0.0, 1.0, 900.0])
    (deep,) = _seen(BeamHardening((0.0, 3.0, 1.0), ratios=(1e-9, 8.0, 1.0)), [5000.0])
    assert deep == pytest.approx(5000 * 4 / 25 - math.log(0.25), rel=1e-12)
