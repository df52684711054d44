"""An exposure: motion blur, the area of a pixel, the profile of the beam."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.effects.exposure import BeamProfile, MotionBlur
from simulators.frame import sensor
from simulators.frame.shot import Detector
from simulators.scenes.expose import expose
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]
RADIUS_PX = 30  # of the sample that shots.shot() speaks of: 0.3 mm in pixels of 0.01 mm


def _turning(radians: float) -> Callable[[float], float]:
    """A stage that turns so far during the exposure of a shot, from its angle on."""
    return lambda time: 0.4 + radians / 0.01 * (time - 1000.0)


def test_motion_blur_is_the_mean_transmission_over_the_exposure() -> None:
    stage = _turning(0.2)
    scene = shots.scene({"kind": "motion_blur", "tolerance_px": 1.2, "max_samples": 9})  # 0.2 rad x 30 px: 6 px
    angles = stage(1000.0 + 0.01 * (np.arange(5) + 0.5) / 5)  # type: ignore[arg-type]
    mean = np.mean([np.exp(-shots.depth(scene, a)) for a in np.atleast_1d(angles)], axis=0)
    blurred = shots.frame(scene, angle_at=stage)
    np.testing.assert_allclose(blurred * CONVERSION / 4000, mean, atol=2e-5)
    # A finer midpoint rule agrees to second order: the samples are spread evenly over the exposure.
    fine = np.mean(
        [np.exp(-shots.depth(scene, stage(1000.0 + 0.01 * t))) for t in (np.arange(200) + 0.5) / 200], axis=0
    )
    assert np.abs(mean - fine).max() < 0.1 * np.abs(np.exp(-shots.depth(scene, 0.4)) - fine).max()


@given(radians=st.floats(-0.5, 0.5), tolerance=st.floats(0.1, 3.0), most=st.integers(2, 40))
def test_the_number_of_moments_follows_the_length_of_the_arc(radians: float, tolerance: float, most: int) -> None:
    blur = MotionBlur(tolerance, most)
    n = blur.samples(shots.shot(angle_at=_turning(radians)))
    arc = abs(radians) * RADIUS_PX
    assert n <= most
    assert n == most or arc / max(n, 1) <= tolerance * (1 + 1e-9)
    assert n <= 1 or arc / (n - 1) > tolerance * (1 - 1e-6)


def test_a_standing_stage_changes_no_bit() -> None:
    still = expose(shots.scene("motion_blur"), shots.shot(angle_at=lambda time: 0.4))
    np.testing.assert_array_equal(still, shots.frame(shots.scene()))


def test_a_stage_that_turns_back_within_the_exposure_is_seen_to_move() -> None:
    def swing(time: float) -> float:
        return 0.4 + 0.1 * math.sin(math.pi * (time - 1000.0) / 0.01)

    assert swing(1000.0) == pytest.approx(swing(1000.01))
    assert MotionBlur(tolerance_px=0.5).samples(shots.shot(angle_at=swing)) == math.ceil(0.2 * RADIUS_PX / 0.5)


def test_what_stands_before_the_axis_counts_though_its_rim_is_beyond_the_frame() -> None:
    """A ball 0.3 mm in front of the axis flies at the speed of the rim across a frame that is 0.11 mm wide."""
    ball = {"kind": "ellipsoid", "semi_axes": [0.01, 0.01, 0.01], "attenuation": 9.0, "centre": [0.0, -0.3, 0.0]}
    blur = {"kind": "motion_blur", "tolerance_px": 0.5, "max_samples": 60}
    shot = shots.shot(detector=Detector.centred((9, 11), 0.01), angle=0.0, radius=0.31)
    scene = shots.scene(blur, phantom={"kind": "solids", "solids": [ball]})
    lost = 4000 / CONVERSION - shots.frame(scene, shot, angle_at=lambda time: 80.0 * (time - 1000.0) - 0.4)
    assert lost[4].min() > 0.8 * lost[4].max()  # evenly smeared; a comb of separate balls has nothing between them


def test_a_cone_sees_the_side_of_its_source_move_faster() -> None:
    shot = shots.shot(angle_at=_turning(0.1), detector=Detector.centred((60, 80), 0.01, sod=0.6))
    assert MotionBlur(tolerance_px=0.5).samples(shot) == 2 * 0.1 * RADIUS_PX / 0.5  # 0.6 / (0.6 - 0.3)


def test_a_tolerance_of_next_to_nothing_takes_all_samples_allowed() -> None:
    assert MotionBlur(1e-320, 7).samples(shots.shot(angle_at=_turning(0.1))) == 7


HARDENING = {"kind": "beam_hardening", "weights": [1.0, 1.0], "ratios": [1.0, 2.0]}


@pytest.mark.parametrize("rays", [2, 3, 4])
@pytest.mark.parametrize("others", [(), (HARDENING,)])
def test_a_pixel_counts_what_finer_pixels_count_on_average(rays: int, others: tuple[dict[str, object], ...]) -> None:
    wide = shots.frame(shots.scene({"kind": "pixel_area", "rays": rays}, *others))
    fine = shots.shot(detector=Detector.centred((60 * rays, 80 * rays), 0.01 / rays))
    joined = shots.frame(shots.scene(*others), fine).reshape(60, rays, 80, rays).mean(axis=(1, 3))
    np.testing.assert_allclose(wide, joined, atol=1.0)  # of counts up to 8700, each rounded
    middle = shots.frame(shots.scene(*others))
    assert np.abs(middle.astype(float) - joined).max() > 200  # at edges


def test_the_open_beam_stays_as_it_is() -> None:
    np.testing.assert_array_equal(
        shots.frame(shots.scene("pixel_area"), sample=False), shots.frame(shots.scene(), sample=False)
    )


def test_beam_profile_is_a_gaussian_with_stripes_that_drift() -> None:
    profile = {"kind": "beam_profile", "sigma": [0.4, 0.3], "stripes": 0.1, "stripe_period": 0.2, "drift": 1e-3}
    shot = shots.shot()
    u, v = shot.detector.u()[None, :], shot.detector.v()[:, None]
    gauss = np.exp(-(u**2) / (2 * 0.4**2) - v**2 / (2 * 0.3**2))
    for elapsed in (0.0, 50.0):
        flat = shots.frame(shots.scene(profile), shots.shot(elapsed=elapsed), sample=False) * CONVERSION / 4000
        stripes = 1 + 0.1 * np.sin(2 * np.pi * (v - 1e-3 * elapsed) / 0.2)
        np.testing.assert_allclose(flat, gauss * stripes, atol=2e-5)
    # The sample's transmission is untouched: projection / flat is Beer-Lambert.
    scene = shots.scene(profile)
    ratio = shots.frame(scene) / shots.frame(scene, sample=False)
    np.testing.assert_allclose(ratio, np.exp(-shots.depth(scene, 0.4)), rtol=2e-3)


def test_a_beam_that_wanders_takes_its_stripes_along_by_whole_pixels() -> None:
    """Three columns and two rows of 10 um further, at a quarter of the swing's period."""
    shot, later = shots.shot(elapsed=0.0), shots.shot(elapsed=5.0)
    still = BeamProfile((0.4, 0.3), stripes=0.1, stripe_period=0.07)
    moves = BeamProfile((0.4, 0.3), 0.1, 0.07, wander_speed=(2e-3, -2e-3), wander=(0.02, -0.01), wander_period=20.0)
    before = still.apply(np.ones((60, 80)), shot)
    np.testing.assert_array_equal(moves.apply(np.ones((60, 80)), shot), before)
    after = moves.apply(np.ones((60, 80)), later)
    np.testing.assert_allclose(after[:-2, 3:], before[2:, :-3], rtol=1e-12)
    aside = BeamProfile((0.4, 0.3), 0.1, 0.07, centre=(0.03, -0.02))
    np.testing.assert_allclose(aside.apply(np.ones((60, 80)), shot), after, rtol=1e-12)


def test_the_sample_stays_where_it_is_while_the_beam_wanders() -> None:
    scene = shots.scene({"kind": "beam_profile", "sigma": [0.4, 0.3], "wander_speed": [1e-3, 0.0]})
    for elapsed in (0.0, 100.0):
        shot = shots.shot(elapsed=elapsed)
        ratio = shots.frame(scene, shot) / shots.frame(scene, shot, sample=False)
        np.testing.assert_allclose(ratio, np.exp(-shots.depth(scene, 0.4)), rtol=2e-3)


@given(elapsed=st.floats(0, 1e4), turns=st.integers(1, 50))
def test_a_swing_comes_back_after_its_period(elapsed: float, turns: int) -> None:
    profile = BeamProfile((1.0, 1.0), wander=(0.1, 0.2), wander_period=7.0)
    np.testing.assert_allclose(profile.middle(elapsed + 7.0 * turns), profile.middle(elapsed), atol=1e-10)
