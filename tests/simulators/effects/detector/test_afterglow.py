"""Afterglow: a transmission that falls exponentially has a closed form, and a few moments meet the law of times."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from simulators.effects.detector.afterglow import Afterglow, gauss_rule
from simulators.frame import sensor
from simulators.frame.shot import Moments
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]
TRIGGER = Moments.once(60)


def _mean(moments: Moments, rate: float) -> NDArray[np.float64]:
    """Mean of exp(-rate t) over the moments, float64 [row]."""
    return moments.weights @ np.exp(-rate * moments.times)


@given(share=st.floats(0.01, 0.9), decay=st.floats(1e-4, 10.0), slowness=st.floats(-0.2, 0.2))
def test_a_transmission_that_falls_exponentially_has_its_closed_form(
    share: float, decay: float, slowness: float
) -> None:
    """exp(-a t) glows as exp(-a t) / (1 - a tau): what was before was brighter. Four points are right to a power 7."""
    seen = Afterglow((share,), (decay,), samples=4).moments(TRIGGER, shots.shot())
    rate = slowness / decay
    rest = abs(slowness) ** 8 / (1 - abs(slowness))  # of the series of 1 / (1 - x); the rule's own is no larger
    expected = 1 - share + share / (1 - slowness)
    np.testing.assert_allclose(_mean(seen, rate), expected, atol=2 * share * rest + 1e-12)


@given(
    decays=st.lists(st.floats(1e-3, 0.1), min_size=1, max_size=3),
    samples=st.integers(1, 5),
    blur=st.integers(2, 6),
    power=st.integers(0, 9),
)
def test_powers_of_time_have_the_mean_of_all_components_and_all_moments(
    decays: list[float], samples: int, blur: int, power: int
) -> None:
    """E (t - s)^m = sum of binomials E t^(m-k) (-1)^k k! tau^k, up to m = 2 samples - 1."""
    power = min(power, 2 * samples - 1)
    within = np.sort(np.random.default_rng(blur).random(blur)) * 0.05
    before = Moments(np.tile(within[:, None], 60), np.arange(1.0, blur + 1) * 2 / (blur * (blur + 1)))
    shares = tuple(0.3 / (i + 1) for i in range(len(decays)))
    seen = Afterglow(shares, tuple(decays), samples).moments(before, shots.shot())
    assert seen.times.shape[0] == blur + samples
    mean = sum(
        share * math.comb(power, k) * float(before.weights @ before.times[:, 0] ** (power - k))
        * (-1) ** k * math.factorial(k) * decay**k
        for share, decay in zip(shares, decays, strict=True) for k in range(power + 1)
    )  # fmt: skip
    mean += (1 - sum(shares)) * float(before.weights @ before.times[:, 0] ** power)
    size = math.factorial(power) * (0.05 + max(decays)) ** power
    assert float(seen.weights @ seen.times[:, 0] ** power) == pytest.approx(mean, abs=1e-10 * size, rel=1e-10)


def test_weights_are_those_of_a_mean_and_rows_keep_their_own_times() -> None:
    rolled = Moments(np.arange(60) * 3.6e-6 + np.array([[1e-3], [4e-3]]), np.array([0.25, 0.75]))
    seen = Afterglow((0.1, 0.05), (0.01, 0.2)).moments(rolled, shots.shot())
    assert seen.weights.sum() == pytest.approx(1.0, rel=1e-14)
    assert (seen.weights > 0).all()
    np.testing.assert_array_equal(seen.times[:2], rolled.times)
    np.testing.assert_allclose(seen.weights[:2], [0.25 * 0.85, 0.75 * 0.85])
    assert (seen.times[2:] < rolled.times[1]).all()
    np.testing.assert_allclose(np.diff(seen.times, axis=1), 3.6e-6, rtol=1e-6)


def test_a_frame_holds_the_sample_as_it_stood_earlier() -> None:
    """Against the frame's mean over the exponential law in 400 steps of equal chance, of a sample that turns slowly."""
    depth = shots.depth

    def stage(time: float) -> float:
        return 0.4 + 6.0 * (time - 1000.0)

    scene = shots.scene({"kind": "afterglow", "shares": [0.5], "decay_times": [0.02], "samples": 8})
    seen = shots.frame(scene, angle_at=stage) * CONVERSION / 4000
    middle = 1000.0 + shots.shot().exposure / 2
    ages = -0.02 * np.log1p(-(np.arange(400) + 0.5) / 400)
    past = np.mean([np.exp(-depth(scene, stage(middle - age))) for age in ages], axis=0)
    now = np.exp(-depth(scene, stage(middle)))
    np.testing.assert_allclose(seen, 0.5 * now + 0.5 * past, atol=1.5e-3)
    assert np.abs(past - now).max() > 0.02
    flat = shots.frame(scene, sample=False)
    assert (flat == round(4000 / CONVERSION)).all()


def test_a_standing_sample_does_not_change() -> None:
    scene = shots.scene({"kind": "afterglow", "shares": [0.3], "decay_times": [0.1]})
    still = shots.frame(scene, replace(shots.shot(), exposure=0.01), angle_at=lambda time: 0.4)
    np.testing.assert_array_equal(still, shots.frame(shots.scene()))


def test_a_gauss_rule_of_fewer_points_than_asked_for_is_the_points() -> None:
    points, weights = gauss_rule(np.array([-1.0, 2.0, 2.0]), np.array([0.2, 0.3, 0.5]), 5)
    np.testing.assert_allclose(points, [-1.0, 2.0])
    np.testing.assert_allclose(weights, [0.2, 0.8])
