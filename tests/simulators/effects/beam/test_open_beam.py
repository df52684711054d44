"""The open beam: bends, current, lost light, ghosts, slits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.effects.beam.open_beam import BeamBend, BlackBand, LostBeam, NarrowField, RingCurrent
from simulators.effects.chain import AnomalyLabel
from simulators.frame.shot import Detector
from tests.simulators import anomalies, shots

BEND = BeamBend(curvature=(0.04, -0.02), level=-0.01, drift=1e-4)


def test_views_have_the_stated_surface_of_line_integrals() -> None:
    shot = shots.shot(sample=True, elapsed=50.0)
    left = -np.log(BEND.apply(np.ones((61, 81)), shot))
    assert left[30, 40] == pytest.approx(-0.01 + 1e-4 * 50)
    np.testing.assert_allclose(left[30] - left[30, 40], 0.04 * (2 * (np.arange(81) - 40) / 81) ** 2, atol=1e-12)
    np.testing.assert_allclose(left[:, 40] - left[30, 40], -0.02 * (2 * (np.arange(61) - 30) / 61) ** 2, atol=1e-12)


def test_flats_stay_as_they_are() -> None:
    assert (BEND.apply(np.ones((6, 8)), shots.shot(sample=False)) == 1).all()


TAU = 100.0
RINGS = {
    "falls": RingCurrent(TAU),
    "by the clock": RingCurrent(TAU, top_up_every=30.0),
    "by the clock, with a ramp": RingCurrent(TAU, top_up_every=30.0, refill=4.0),
    "by the current": RingCurrent(TAU, top_up_below=0.8),
    "by the current, with a ramp": RingCurrent(TAU, top_up_below=0.8, refill=4.0),
}


@pytest.mark.parametrize("ring", RINGS.values(), ids=RINGS)
def test_the_mean_is_the_integral_of_the_current_itself(ring: RingCurrent) -> None:
    """Against the sum over the current as its words describe it, in steps of 10 ms."""
    times = (np.arange(10_000) + 0.5) * 0.01
    falls = -TAU * math.log(0.8) if ring.top_up_below else (ring.top_up_every or math.inf) - ring.refill
    phase = times % (falls + ring.refill) if math.isfinite(falls) else times
    least = math.exp(-falls / TAU)
    rise = least + (1 - least) * (phase - falls) / (ring.refill or 1.0)
    current = np.where(phase < falls, np.exp(-phase / TAU), rise)
    assert ring.mean(0.0, 100.0) == pytest.approx(current.mean(), rel=1e-4)  # a jump may fall anywhere in a step
    for start, duration in ((3.0, 10.0), (20.0, 30.0), (61.3, 0.5)):
        inside = (times > start) & (times < start + duration)
        assert ring.mean(start, duration) == pytest.approx(current[inside].mean(), rel=2e-4)


@pytest.mark.parametrize("ring", RINGS.values(), ids=RINGS)
@given(start=st.floats(0, 1e4), first=st.floats(1e-3, 100), second=st.floats(1e-3, 100))
def test_consecutive_exposures_collect_the_light_of_one_long_exposure(
    ring: RingCurrent, start: float, first: float, second: float
) -> None:
    apart = first * ring.mean(start, first) + second * ring.mean(start + first, second)
    assert (first + second) * ring.mean(start, first + second) == pytest.approx(apart, rel=1e-6)


@pytest.mark.parametrize(
    "effect",
    [
        {"kind": "lost_beam", "views": [3, 6], "share": 0.02},
        {"kind": "black_band", "width": 0.08, "penumbra": 0.04, "share": 0.1, "views": [3, 6]},
    ],
)
@pytest.mark.parametrize("view", [2, 3, 5, 6])
def test_it_is_there_in_its_views_for_flats_and_projections_but_not_in_darks(effect: dict[str, Any], view: int) -> None:
    for sample in (True, False):
        assert anomalies.check_regions(effect, shots.shot(view=view, sample=sample)) == (3 <= view < 6)
    assert not anomalies.labels(effect, shots.shot(view=view, beam=False))


def test_a_lost_beam_leaves_its_share_of_the_light_everywhere() -> None:
    lost = {"kind": "lost_beam", "views": [3, 6], "share": 0.02}
    assert anomalies.check_regions(lost, shots.shot(view=3), loose=0)
    np.testing.assert_allclose(anomalies.change(lost, shots.shot(view=3)), -0.98, atol=2e-4)


@given(begin=st.floats(49.9, 50.1), lasts=st.floats(1e-4, 0.1))
def test_by_the_clock_a_frame_loses_the_part_of_its_exposure(begin: float, lasts: float) -> None:
    """A frame is exposed from 50 s to 50.01 s; counted on a fine grid of its moments."""
    effect = LostBeam(seconds=(begin, begin + lasts), share=0.2)
    moments = 50.0 + 0.01 * (np.arange(20_000) + 0.5) / 20_000
    off = np.mean((moments >= begin) & (moments < begin + lasts))
    image = effect.apply(np.ones((60, 80)), shots.shot())
    np.testing.assert_allclose(image, 1 - 0.8 * off, atol=2e-4)
    assert (not effect.labels(shots.shot())) == bool((image == 1).all())


@given(elapsed=st.floats(0.0, 1e6), exposure=st.floats(7.2e-6, 10.0))
def test_a_frame_within_the_loss_is_dark_to_the_last_photon(elapsed: float, exposure: float) -> None:
    """Not darker: photons cannot be fewer than none."""
    shot = shots.shot(elapsed=elapsed, exposure=exposure)
    assert not LostBeam(seconds=(-1.0, 2e6)).apply(np.ones((60, 80)), shot).any()


GHOST = {"kind": "ghost", "view": 4, "width": 0.2, "speed": 0.3, "gain": 0.5}
"""Pixels of 0.01 mm: 40 px wide at its foot, 30 px a view; the frame has 80 columns."""


def test_it_crosses_from_right_to_left_in_a_few_views() -> None:
    middles = {}
    for view in range(12):
        shot = shots.shot(view=view, sample=True)
        if anomalies.check_regions(GHOST, shot):
            gained = anomalies.change(GHOST, shot)[7]
            middles[view] = (gained * np.arange(80)).sum() / gained.sum()
    assert list(middles) == [4, 5, 6, 7]  # 80 + 40 px at 30 px a view
    assert middles[5] - middles[6] == pytest.approx(30, abs=0.05)  # both wholly in the frame


def test_it_is_a_smooth_hump_of_the_light_that_is_there() -> None:
    gained = anomalies.change(GHOST, shots.shot(view=5))
    middle = 79.5 + 20 - 45  # a view and a half after its left end touched the right edge
    away = np.clip((np.arange(80) - middle) / 20, -1, 1)
    np.testing.assert_allclose(gained, np.broadcast_to(0.5 * np.cos(np.pi / 2 * away) ** 2, (60, 80)), atol=4e-4)
    assert ((gained[7] > 0.25).sum()) == 20  # half of its height: `width`
    darker = anomalies.change(GHOST | {"gain": -0.5}, shots.shot(view=5))
    np.testing.assert_allclose(darker, -gained, atol=6e-4)


def test_flats_and_darks_do_not_have_it() -> None:
    for state in ({"sample": False}, {"beam": False}):
        assert not anomalies.labels(GHOST, shots.shot(view=5, **state))
    assert not anomalies.change(GHOST, shots.shot(view=5, sample=False)).any()


def test_the_light_falls_off_as_a_ramp_to_the_share_that_is_left() -> None:
    band = {"kind": "black_band", "width": 0.08, "penumbra": 0.04, "share": 0.1}
    light = 1 + anomalies.change(band, shots.shot(sample=False))
    # Pixels of 0.01 mm: dark up to 0.06 mm, all light from 0.1 mm on.
    ramp = [0.1] * 6 + [0.1 + 0.9 * share for share in (0.125, 0.375, 0.625, 0.875)] + [1.0] * 70
    np.testing.assert_allclose(light, np.broadcast_to(ramp, (60, 80)), atol=1e-4)


@given(width=st.floats(0.001, 1.5), penumbra=st.floats(0.0, 0.5), share=st.floats(0.0, 0.9))
def test_the_region_covers_the_darkened_pixels(width: float, penumbra: float, share: float) -> None:
    band = {"kind": "black_band", "width": width, "penumbra": penumbra, "share": share}
    anomalies.check_regions(band, shots.shot(sample=False))


def test_it_is_there_always_without_views() -> None:
    band = BlackBand(0.05)
    assert band.labels(shots.shot(view=10_000)) == [AnomalyLabel("black_band", (0, 60, 0, 5))]
    assert BlackBand(2.0).labels(shots.shot()) == [AnomalyLabel("black_band", (0, 60, 0, 80))]


def test_the_light_is_a_rectangle_with_soft_edges() -> None:
    field = {"kind": "narrow_field", "width": 0.4, "height": 0.3, "centre": [0.1, -0.05], "penumbra": 0.06}
    light = 1 + anomalies.change(field, shots.shot(sample=False))

    def share(place: np.ndarray, middle: float, width: float) -> np.ndarray:
        return np.interp(np.abs(place - middle), [width / 2 - 0.03, width / 2 + 0.03], [1.0, 0.0])

    detector = shots.shot().detector
    expected = share(detector.v(), -0.05, 0.3)[:, None] * share(detector.u(), 0.1, 0.4)
    np.testing.assert_allclose(light, expected, atol=2e-4)


def test_it_is_the_same_on_both_sides_of_the_axis_wherever_that_is() -> None:
    shot = shots.shot(sample=False, detector=Detector((60, 80), 0.01, 30.0, 29.5))
    light = 1 + anomalies.change({"kind": "narrow_field", "width": 0.35, "penumbra": 0.05}, shot)
    np.testing.assert_array_equal(light[:, :61], light[:, 60::-1])
    assert light[5].sum() == pytest.approx(35, abs=0.01)  # all light of 0.35 mm, in pixels of 0.01 mm


@pytest.mark.parametrize("penumbra", [0.05, 0.1, 0.25, 0.6])
def test_a_slit_narrower_than_its_penumbra_shows_a_part_of_the_source(penumbra: float) -> None:
    """The share of an evenly bright source that is seen through a slit of 0.1 mm, counted point by point."""
    light = NarrowField(0.1, penumbra=penumbra).apply(np.ones((60, 80)), shots.shot())[30]
    source = penumbra * (np.arange(20_000) + 0.5) / 20_000 - penumbra / 2
    expected = [np.mean(np.abs(u + source) < 0.05) for u in shots.shot().detector.u()]
    np.testing.assert_allclose(light, expected, atol=2e-4)


@given(
    width=st.floats(0.01, 1.2),
    height=st.none() | st.floats(0.01, 1.0),
    across=st.floats(-0.3, 0.3),
    penumbra=st.floats(0.0, 0.3),
)
def test_the_region_goes_around_all_that_is_not_fully_lit(
    width: float, height: float | None, across: float, penumbra: float
) -> None:
    field = {"kind": "narrow_field", "width": width, "height": height, "centre": [across, 0.0], "penumbra": penumbra}
    anomalies.check_regions(field, shots.shot(sample=False))


def test_projections_are_as_narrow_and_darks_show_nothing() -> None:
    field = {"kind": "narrow_field", "width": 0.3}
    assert anomalies.check_regions(field, shots.shot())
    assert not anomalies.labels(field, shots.shot(beam=False))
    assert not anomalies.labels({"kind": "narrow_field", "width": 2.0}, shots.shot())
