"""Scintillator and optics: afterglow, dust and scratches, blur."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from simulators.effects.detector.optics import Afterglow, FlatStructure, ScintillatorBlur, discrete_gaussian, gauss_rule
from simulators.frame import sensor
from simulators.frame.shot import Detector, Moments, Shot, fixed_rng
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


MANY = FlatStructure(
    specks=1000, radius_um=30.0, scratches=800, scratch_length_um=3000.0, scratch_width_um=12.0, seed=5
)


def _roi(row0: int, col0: int, rows: int, cols: int, binning: int = 1) -> Shot:
    shape = (rows // binning, cols // binning)
    detector = Detector.centred(shape, 0.01 * binning)
    return shots.shot(detector=detector, roi=(row0, col0, rows, cols), binning=binning)


@settings(max_examples=6)
@given(row=st.integers(0, 60), col=st.integers(0, 60), binning=st.sampled_from([1, 2, 4]))
def test_it_stays_on_the_sensor_in_any_roi_and_binning(row: int, col: int, binning: int) -> None:
    whole = MANY.transmission(_roi(200, 300, 320, 320))
    seen = MANY.transmission(_roi(200 + 4 * row, 300 + 4 * col, 80, 64, binning))
    part = whole[4 * row : 4 * row + 80, 4 * col : 4 * col + 64]
    expected = part.reshape(80 // binning, binning, 64 // binning, binning).mean(axis=(1, 3))
    np.testing.assert_allclose(seen, expected, rtol=1e-12)
    assert whole.std() > 0.01


def test_a_speck_is_round_and_a_gaussian() -> None:
    rng = fixed_rng("flat_structure", 11)
    row, col, size, deep = rng.random(4) * (2304, 4096, 6.0, 0.4) + (0, 0, 3.0, 0)
    row0, col0 = 4 * (int(row) // 4 - 15), 4 * (int(col) // 4 - 15)
    seen = FlatStructure(1, 60.0, 0.2, scratches=0, seed=11).transmission(_roi(row0, col0, 120, 120))
    j, i = np.mgrid[:120, :120]
    expected = 1 - deep * np.exp(-((j + row0 - row) ** 2 + (i + col0 - col) ** 2) / (2 * size**2))
    np.testing.assert_allclose(seen, expected, atol=deep * math.exp(-8))


def test_scratches_take_the_light_of_lines() -> None:
    """A scratch of length L takes depth x (L sqrt(2 pi) w + 2 pi w²), whatever its angle, away from edges."""
    inside = 0
    for seed in range(8):
        scratch = FlatStructure(0, scratches=1, scratch_length_um=800.0, scratch_width_um=20.0, seed=seed)
        rng = fixed_rng("flat_structure", seed)
        row, col, angle, chance, deep = rng.random(5) * (2304, 4096, math.pi, 1, 0.1)
        length = -math.log1p(-chance) * 80
        reach = length / 2 + 18
        if not (reach < row < 2304 - reach and reach < col < 4096 - reach):
            continue
        inside += 1
        row0, col0, size = 4 * (int(row - reach) // 4), 4 * (int(col - reach) // 4), 4 * (int(2 * reach) // 4)
        loss = 1 - scratch.transmission(_roi(row0, col0, size, size))
        assert loss.sum() == pytest.approx(deep * (length * math.sqrt(2 * math.pi) * 2 + 8 * math.pi), rel=2e-3)
        j, i = np.nonzero(loss > 0.5 * loss.max())
        if length > 40:  # its direction is its angle: rows along its sine, columns along its cosine
            moments = np.cov(j, i)
            assert math.atan2(2 * moments[0, 1], moments[1, 1] - moments[0, 0]) / 2 % math.pi == pytest.approx(
                angle % math.pi, abs=0.05
            )
    assert inside >= 4


@pytest.mark.parametrize("width_um", [1e3, 1e6, 1e9])
def test_a_scratch_wider_than_the_frame_costs_no_more_than_the_frame(width_um: float) -> None:
    """Across and at its ends it is a Gaussian at every pixel."""
    rng = fixed_rng("flat_structure", 3)
    row, col, angle, chance, deep = rng.random(5) * (2304, 4096, math.pi, 1, 0.1)
    scratch = FlatStructure(0, scratches=1, scratch_length_um=800.0, scratch_width_um=width_um, seed=3)
    seen = scratch.transmission(_roi(1000, 2000, 120, 200))
    dy, dx = np.arange(120)[:, None] + 1000 - row, np.arange(200) + 2000 - col
    along = np.abs(dy * math.sin(angle) + dx * math.cos(angle)) + math.log1p(-chance) * 40
    across = dx * math.sin(angle) - dy * math.cos(angle)
    beside = (np.maximum(along, 0) ** 2 + across**2) / (width_um / 10) ** 2
    near = beside < 16
    np.testing.assert_allclose(seen[near], (1 - deep * np.exp(-beside / 2))[near], atol=1e-12)


def test_a_flat_divides_it_out() -> None:
    effect = {"kind": "flat_structure", "specks": 15_000, "radius_um": 60.0, "scratches": 200, "seed": 3}
    scene = shots.scene(effect)
    flat = shots.frame(scene, sample=False)
    expected = FlatStructure(15_000, 60.0, scratches=200, seed=3).transmission(shots.shot())
    np.testing.assert_allclose(flat * CONVERSION / 4000, expected, atol=2e-5)
    assert flat.std() / flat.mean() > 0.02
    np.testing.assert_allclose(shots.frame(scene) / flat, np.exp(-shots.depth(scene, 0.4)), rtol=3e-3)


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


def test_a_core_as_wide_as_a_slip_of_units_is_refused() -> None:
    image: NDArray[np.float64] = np.ones((8, 8))
    with pytest.raises(ValueError, match=r"5000 um FWHM is 212.*as the tail"):
        ScintillatorBlur(5000.0).apply(image, _shot((8, 8)))
