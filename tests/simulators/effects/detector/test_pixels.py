"""Pixels of the sensor: response, hot and dead ones, zingers, rolling shutter."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from drivers import orca_quest
from drivers.base.protocols import CameraSettings, TriggerSource
from drivers.orca_quest import SENSOR_SHAPE
from simulators.effects.detector.pixels import DeadPixels, HotPixels, Prnu, RollingShutter, Zingers
from simulators.frame import sensor
from simulators.frame.shot import CannotExposeError, Moments
from tests.simulators import chance, shots


def test_gains_are_normal_around_one_and_stay_on_the_sensor() -> None:
    flat, later = (Prnu(0.02).apply(np.full((300, 400), 500.0), shots.sized(300, 400, frame=k)) for k in (1, 2))
    chance.normal_like((flat / 500 - 1) / 0.02)
    chance.mean_is(flat / 500, 1.0, 0.02**2)
    np.testing.assert_array_equal(flat, later)
    moved = Prnu(0.02).apply(np.full((300, 400), 500.0), shots.sized(300, 400, roi=(4, 8, 300, 400)))
    np.testing.assert_array_equal(flat[4:, 8:], moved[:-4, :-8])
    chance.uncorrelated(flat, Prnu(0.02, seed=1).apply(np.full((300, 400), 500.0), shots.sized(300, 400)))


def test_a_binned_pixel_has_the_mean_of_its_pixels() -> None:
    flat = Prnu(0.02).apply(np.full((300, 400), 1.0), shots.sized(300, 400))
    summed = Prnu(0.02).apply(
        np.full((150, 200), 1.0), shots.sized(300, 400, binning=2, detector=shots.sized(150, 200).detector)
    )
    np.testing.assert_allclose(summed, flat.reshape(150, 2, 200, 2).mean(axis=(1, 3)), rtol=1e-13)


def test_it_is_a_share_of_the_light() -> None:
    assert not Prnu(0.2).apply(np.zeros((60, 80)), shots.shot()).any()
    ramp = np.linspace(0, 9, 4800).reshape(60, 80)
    gain = Prnu(0.01).apply(np.ones((60, 80)), shots.shot())
    of_ramp = Prnu(0.01).apply(ramp.copy(), shots.shot())
    np.testing.assert_allclose(of_ramp, ramp * gain)
    scene = shots.scene({"kind": "prnu", "spread": 0.05}, flux=4e5)
    ratio = shots.frame(scene).astype(float) / shots.frame(scene, sample=False)
    np.testing.assert_allclose(ratio, np.exp(-shots.depth(scene, 0.4)), atol=3e-5)


def test_hot_pixels_stay_on_the_sensor_whatever_the_roi() -> None:
    effect = HotPixels(fraction=0.01, rate=1e5, seed=4)
    frame = effect.apply(np.zeros((60, 80)), shots.shot())
    assert 0.006 < (frame > 0).mean() < 0.012
    moved = effect.apply(np.zeros((60, 80)), shots.shot(roi=(1124, 2016, 60, 80)))
    np.testing.assert_array_equal(frame[4:, 8:] > 0, moved[:-4, :-8] > 0)
    binned = effect.apply(np.zeros((30, 40)), shots.shot(detector=shots.sized(30, 40).detector, binning=2))
    np.testing.assert_array_equal(binned > 0, (frame > 0).reshape(30, 2, 40, 2).any(axis=(1, 3)))
    assert (HotPixels(0.01, 1e5, seed=5).apply(np.zeros((60, 80)), shots.shot()) > 0)[frame > 0].mean() < 0.5


def test_their_electrons_are_poisson_of_exponential_currents() -> None:
    """Then a number is geometric: mean m = rate x exposure, variance m² + m."""
    whole = shots.sized(*SENSOR_SHAPE)
    frame = HotPixels(2e-3, 2000.0).apply(np.zeros(SENSOR_SHAPE), whole)
    lit = frame[frame > 0] - 1  # a geometric number is the same again above 1: no memory
    n = 2e-3 * frame.size
    assert lit.size == pytest.approx(n * 20 / 21, rel=0.02)
    chance.mean_is(lit, 20.0, 420.0)
    rows, cols = np.nonzero(frame)
    assert rows.max() > 2290
    assert cols.max() > 4080


def test_each_frame_has_other_electrons_of_the_same_pixels() -> None:
    one, other = (HotPixels(0.01, 1e5).apply(np.zeros((60, 80)), shots.shot(frame=k)) for k in (1, 2))
    np.testing.assert_array_equal(one > 0, other > 0)
    assert (one != other).any()
    hot = one > 0
    assert np.abs(one - other)[hot].max() < 10 * np.sqrt(one.max())


def test_dead_pixels_hold_their_charge_and_the_others_theirs() -> None:
    light = np.linspace(100, 900, 4800).reshape(60, 80)
    dead = DeadPixels(0.01).apply(light.copy(), shots.shot())
    assert 0.006 < (dead == 0).mean() < 0.013
    np.testing.assert_array_equal(dead[dead > 0], light[dead > 0])
    stuck = DeadPixels(0.01, charge=7000.0).apply(light.copy(), shots.shot(frame=9, seed=9))
    np.testing.assert_array_equal(stuck == 7000, dead == 0)


def test_a_binned_pixel_loses_the_share_of_its_dead_pixels() -> None:
    dead = DeadPixels(0.1).apply(np.ones((60, 80)), shots.shot())
    shot = shots.shot(detector=shots.sized(30, 40).detector, binning=2)
    for charge in (0.0, 3.0):
        share = dead + charge * (dead == 0)
        binned = DeadPixels(0.1, charge).apply(np.full((30, 40), 4.0), shot)
        np.testing.assert_allclose(binned, share.reshape(30, 2, 40, 2).sum(axis=(1, 3)))


def _frame(effect: Zingers, number: int, side: int = 400) -> NDArray[np.float64]:
    return effect.apply(np.zeros((side, side)), shots.sized(side, side, exposure=0.01, frame=number))


def test_zingers_are_as_many_as_their_rate_says_and_in_one_frame_only() -> None:
    frames = np.stack([_frame(Zingers(1000.0, 500.0), k) for k in range(60)])
    chance.mean_is((frames > 0).sum(axis=(1, 2)), 10.0, 10.0)  # 10 ms of 1000/s
    charges = frames[frames > 0]
    assert stats.kstest(charges, "expon", args=(0, 500)).pvalue > chance.FALSE_ALARM
    assert ((frames > 0).sum(axis=0) <= 2).all()
    assert not _frame(Zingers(0.0), 0).any()


def test_places_are_even() -> None:
    rows, cols = np.nonzero(_frame(Zingers(2e5), 0))
    for at in (rows, cols):
        assert stats.chisquare(np.bincount(at // 40, minlength=10)).pvalue > chance.FALSE_ALARM


def test_tracks_are_straight_and_as_long_as_they_should_be() -> None:
    lengths, charges = [], []
    for k in range(400):
        frame = _frame(Zingers(100.0, tracks=1.0, length=15.0), k)
        rows, cols = np.nonzero(frame)
        alone = abs(np.ptp(rows)) < 150 and abs(np.ptp(cols)) < 150 if rows.size else False
        inside = alone and min(rows.min(), cols.min(), 399 - rows.max(), 399 - cols.max()) > 0
        if not inside:
            continue
        points = np.stack([rows - rows.mean(), cols - cols.mean()])
        _, across = np.linalg.svd(points, compute_uv=False) if rows.size > 1 else (0.0, 0.0)
        if across > 0.5 * np.sqrt(rows.size):
            continue  # two that met
        lengths.append(np.hypot(np.ptp(rows), np.ptp(cols)))
        charges.append(frame.sum())
    assert len(lengths) > 100
    assert np.mean(lengths) == pytest.approx(15.0, abs=1 + chance.SIGMAS * 15 / np.sqrt(len(lengths)))
    assert max(lengths) > 40
    assert np.mean(charges) == pytest.approx(3000, rel=1.5 * chance.SIGMAS / np.sqrt(len(charges)))


def test_charge_spreads_by_the_radius_and_is_kept() -> None:
    row, col = np.indices((400, 400))
    spreads = []
    for k in range(60):
        frame = _frame(Zingers(60.0, radius=2.0), k)
        if not frame.any():
            continue
        total = frame.sum()
        variances = [(frame * (axis - (frame * axis).sum() / total) ** 2).sum() / total for axis in (row, col)]
        if max(variances) < 16:  # one alone
            spreads.extend(variances)
    assert len(spreads) > 20
    # Each of n numbers is a variance of 200 drops: 2² and rounding's 1/12, times 199/200.
    expected = (4 + 1 / 12) * 199 / 200
    assert np.mean(spreads) == pytest.approx(expected, abs=chance.SIGMAS * expected * np.sqrt(2 / 200 / len(spreads)))


def test_each_keeps_its_own_charge_when_it_spreads() -> None:
    """By next to nothing: the frame is that of zingers that do not spread."""
    spread, still = _frame(Zingers(5000.0, radius=1e-9), 0), _frame(Zingers(5000.0), 0)
    np.testing.assert_allclose(spread, still, rtol=1e-9)


def test_more_zingers_than_a_frame_can_hold_are_refused() -> None:
    """They would fill the memory."""
    with pytest.raises(CannotExposeError, match=r"1e\+12 per"):
        _frame(Zingers(1e12), 0)


CONVERSION = sensor.CONVERSION["standard"]
LINE = 7.2e-6


def _fast(time: float) -> float:
    return 0.4 + 2000.0 * (time - 1000.0)


def test_rolling_shutter_shows_each_row_at_its_own_time() -> None:
    scene = shots.scene("rolling_shutter")
    skewed = shots.frame(scene, angle_at=_fast)
    for row in (21, 30, 37):  # rows that the ellipsoid casts its shadow on
        depth = shots.depth(scene, _fast(1000.0 + 0.01 / 2 + row // 2 * LINE))[row]  # of the middle of its exposure
        assert np.abs(depth - shots.depth(scene, 0.4)[row]).max() > 0.01
        np.testing.assert_allclose(skewed[row] * CONVERSION / 4000, np.exp(-depth), atol=2e-5)


@pytest.mark.parametrize("binning", [1, 2, 4])
@pytest.mark.parametrize("readout", ["standard", "ultra_quiet"])
def test_two_rows_are_read_in_a_line_time_from_the_first_row_down(binning: int, readout: str) -> None:
    timing = orca_quest.timing(CameraSettings(0.01, TriggerSource.EXTERNAL, binning=binning, readout=readout))
    rows = timing.shape[0]
    shot = shots.shot(row_period=timing.row_period, binning=binning)
    times = RollingShutter().moments(Moments.once(rows), shot).times[0]
    for row in range(0, rows, 7):
        pair = row * binning // 2  # the first of the sensor's pairs that the row is made of
        assert times[row] == pytest.approx(pair * orca_quest.LINE_TIME[readout], abs=1e-12)
    last = times[-1] + orca_quest.LINE_TIME[readout] * max(binning // 2, 1)
    assert last == pytest.approx(timing.readout)  # 1152 line times: 8.2944 ms in the standard readout


def test_blur_and_shutter_are_the_same_in_either_order() -> None:
    blur = {"kind": "motion_blur", "max_samples": 3}
    one, other = (
        shots.frame(shots.scene(*effects), angle_at=_fast)
        for effects in ((blur, "rolling_shutter"), ("rolling_shutter", blur))
    )
    np.testing.assert_array_equal(one, other)
    times = [1000.0 + (k + 0.5) / 3 * 0.01 + 15 * LINE for k in range(3)]
    mean = np.mean([np.exp(-shots.depth(shots.scene(), _fast(time))[30]) for time in times], axis=0)
    np.testing.assert_allclose(one[30] * CONVERSION / 4000, mean, atol=2e-5)
