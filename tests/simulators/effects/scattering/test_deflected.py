"""Scattered light, and crumbs on its way."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from simulators.effects.chain import VISIBLE
from simulators.effects.scattering.deflected import Crumb, Floaters, Scatter
from simulators.frame import sensor
from simulators.frame.shot import Detector, Shot
from tests.simulators import anomalies, shots

ONE = {"kind": "floaters", "distance": [0.7, 0.7], "count": 1, "size": [0.02, 0.02], "depth": 1.0, "seed": 5}
"""The frame reaches 0.4 mm to either side of the axis, and 0.3 mm up and down."""
VIEWS = 180


def _view(view: int, **changes: Any) -> Shot:
    """A half turn in 180 views of 1°."""
    return shots.shot(view=view, angle=math.pi * view / VIEWS, **changes)


def _depth(effect: Floaters, shot: Shot) -> np.ndarray:
    return effect.apply(np.zeros(shot.detector.shape), shot)


def test_within_half_a_turn_each_is_seen_for_one_stretch_of_views() -> None:
    for seed in range(8):
        effect = Floaters((0.7, 0.7), 1, (0.02, 0.02), 1.0, seed=seed)
        seen = np.array([bool(effect.labels(_view(view))) for view in range(2 * VIEWS)])
        begins = np.flatnonzero(seen & ~np.roll(seen, 1))
        assert begins.size == 2  # in a full turn: before the axis and behind it
        assert (begins[1] - begins[0]) == pytest.approx(VIEWS, abs=1)
        # |u| = 0.7 |cos| below 0.4 mm and the crumb's own reach: so many of the 360 degrees.
        reach = 0.4 + 0.02 * math.sqrt(2 * math.log(next(effect.crumbs(_view(begins[0]))).depth / VISIBLE))
        assert seen.sum() == pytest.approx(4 * math.degrees(math.asin(reach / 0.7)), abs=4)


def test_it_turns_with_the_stage_and_weighs_what_a_gaussian_weighs() -> None:
    (effect,) = shots.scene(ONE).chain.effects
    assert isinstance(effect, Floaters)
    us, vs = [], []
    for view in range(VIEWS):
        shot = _view(view, detector=Detector.centred((60, 200), 0.01))  # wide enough to follow it all the way
        depth = _depth(effect, shot)
        (crumb,) = effect.crumbs(shot)
        # ∫∫ exp(-r²/2σ²) = 2πσ², less what is cut off where it is VISIBLE thick.
        assert depth.sum() == pytest.approx(2 * math.pi * 2.0**2 * (crumb.depth - VISIBLE), rel=5e-3)
        us.append((depth.sum(axis=0) @ shot.detector.u()) / depth.sum())
        vs.append((depth.sum(axis=1) @ shot.detector.v()) / depth.sum())
    angles = np.pi * np.arange(VIEWS) / VIEWS
    wave = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    (x, y), *_ = np.linalg.lstsq(wave, np.array(us))
    np.testing.assert_allclose(us, wave @ [x, y], atol=2e-4)  # a point (x, y) of the sample
    assert math.hypot(x, y) == pytest.approx(0.7, abs=1e-4)
    assert np.ptp(vs) < 1e-4


def test_in_a_cone_it_is_larger_before_the_axis_than_behind_it() -> None:
    (effect,) = shots.scene(ONE).chain.effects
    assert isinstance(effect, Floaters)
    wide, cone = Detector.centred((60, 200), 0.01), Detector.centred((60, 300), 0.01, sod=2.1)
    x, y = (
        0.01 * (next(effect.crumbs(shots.shot(angle=angle, detector=wide))).col - wide.axis_col)
        for angle in (0.0, math.pi / 2)
    )
    for angle in np.linspace(0.0, 2 * math.pi, 23):
        (crumb,) = effect.crumbs(shots.shot(angle=angle, detector=cone))
        u, b = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
        assert crumb.col == pytest.approx(cone.axis_col + 100 * u * 2.1 / (2.1 + b))
        assert crumb.sigma == pytest.approx(2.0 * 2.1 / (2.1 + b))


def test_the_region_holds_all_it_changes_in_every_view() -> None:
    many = ONE | {"count": 2, "distance": [0.6, 0.9], "size": [0.01, 0.03]}
    seen = [anomalies.check_regions(many, _view(view), loose=1) for view in range(0, VIEWS, 3)]
    assert 0 < sum(seen) < len(seen)


def test_each_keeps_its_number_from_view_to_view() -> None:
    (effect,) = shots.scene(ONE | {"count": 3, "distance": [0.5, 0.6]}).chain.effects
    assert isinstance(effect, Floaters)
    places: dict[int, list[Any]] = {which: [] for which in range(3)}
    for view in range(VIEWS):
        shown = list(effect.crumbs(_view(view)))
        assert [label.which for label in effect.labels(_view(view))] == [crumb.which for crumb in shown]
        for crumb in shown:
            places[crumb.which].append((view, crumb.col, crumb.sigma))
    for path in places.values():
        views, cols, sigmas = np.array(path).T
        assert np.ptp(sigmas) == 0
        # 0.6 mm at most and 1° a view: what keeps its number never goes on by more than about a pixel a view.
        assert (np.abs(np.diff(cols)) < 1.1 * np.diff(views))[np.diff(views) == 1].all()


def test_loose_ones_drift_through_from_either_side() -> None:
    loose = ONE | {"motion": "loose", "views": [10, 40], "speed": 0.05}
    sides = set()
    for seed in range(6):
        (effect,) = shots.scene(loose | {"seed": seed}).chain.effects
        assert isinstance(effect, Floaters)
        path = {view: next(effect.crumbs(shots.shot(view=view)), None) for view in range(60)}
        cols = {view: crumb.col for view, crumb in path.items() if crumb}
        np.testing.assert_allclose(np.abs(np.diff(list(cols.values()))), 5.0)  # 0.05 mm a view, pixels of 0.01 mm
        sides.add(np.sign(np.diff(list(cols.values()))[0]))
        assert 10 <= min(cols, key=lambda view: abs(cols[view] - 39.5)) <= 40
        assert len(cols) == pytest.approx((80 + 2 * 2 * math.sqrt(2 * math.log(0.75 / VISIBLE))) / 5, abs=2)
        turned = [next(effect.crumbs(shots.shot(view=min(cols), angle=angle))).col for angle in (0.0, 1.0)]
        assert turned[0] == turned[1]  # it does not turn
    assert sides == {-1.0, 1.0}
    seen = [anomalies.check_regions(loose, shots.shot(view=view)) for view in range(60)]
    assert any(seen)
    near = loose | {"distance": [0.1, 0.1]}
    assert sum(bool(anomalies.labels(near, shots.shot(view=view))) for view in range(60)) == 4  # 0.2 mm


def test_blur_smears_it_and_the_label_follows() -> None:
    """10° during the exposure: 12 px of a crumb that crosses the middle, and the label is as much wider."""
    (effect,) = shots.scene(ONE).chain.effects
    assert isinstance(effect, Floaters)
    view = next(v for v in range(VIEWS) if abs(next(iter([c.col for c in effect.crumbs(_view(v))]), -99) - 40) < 3)
    start = _view(view).angle

    def stage(time: float) -> float:
        return start + math.radians(10.0) * (time - 1000.0) / 0.01

    shot = _view(view, angle_at=stage, radius=0.7)
    blurred = shots.scene({"kind": "motion_blur"}, ONE)
    (label,) = blurred.chain.labels(shot)
    (sharp,) = effect.labels(shot)
    width = label.region[3] - label.region[2] - (sharp.region[3] - sharp.region[2])
    assert width == pytest.approx(0.7 * math.radians(10.0) / 0.01 * 23 / 24, abs=1.5)
    frames = [shots.frame(scene, shot, stage).astype(float) for scene in (blurred, shots.scene("motion_blur"))]
    changed = np.flatnonzero((np.abs(frames[0] / np.maximum(frames[1], 1) - 1) > VISIBLE).any(axis=0))
    assert label.region[2] <= changed.min() <= changed.max() < label.region[3]
    # One of so many moments thins the crumb's ends out by 2 px; a sharp one would be 15 px wide.
    assert np.ptp(changed) + 1 >= label.region[3] - label.region[2] - 6 > 18


def test_it_is_only_where_the_sample_is_and_in_its_views() -> None:
    few = ONE | {"views": [0, 90], "count": 6}
    assert not anomalies.labels(few, _view(30, sample=False))
    assert not anomalies.labels(few, _view(30, beam=False))
    shown = [view for view in range(VIEWS) if anomalies.labels(few, _view(view))]
    assert shown
    assert max(shown) < 90
    assert not anomalies.change(few, _view(30, sample=False)).any()


def test_a_crumb_beyond_all_whole_numbers_is_out_of_the_frame() -> None:
    """So a cone's source shows it that nearly touches it."""
    assert Crumb(row=1e40, col=3.0, sigma=1.0, depth=0.5, which=0).box((8, 9))[0:2] == (8, 8)
    assert Crumb(row=-1e40, col=3.0, sigma=1.0, depth=0.5, which=0).box((8, 9))[0:2] == (0, 0)
    assert Crumb(row=-1e20, col=4.0, sigma=1e20, depth=0.5, which=0).box((8, 9)) == (0, 8, 0, 9)


CONVERSION = sensor.CONVERSION["standard"]


def test_an_even_floor_is_a_share_of_the_mean_that_the_sample_lets_through() -> None:
    scene = shots.scene({"kind": "scatter", "ratio": 0.1})
    primary = np.exp(-shots.depth(scene, 0.4))
    seen = shots.frame(scene) * CONVERSION / 4000
    np.testing.assert_allclose(seen, primary + 0.1 * primary.mean(), atol=2e-5)
    assert (shots.frame(scene, sample=False) == round(4000 / CONVERSION)).all()


def test_a_background_is_there_with_and_without_the_sample_and_grows_with_exposure_and_binning() -> None:
    effect = Scatter(background=8e3)
    for sample in (True, False):
        added = effect.apply(np.zeros((60, 80)), shots.shot(sample=sample))
        np.testing.assert_allclose(added, 80.0)  # 8000/s x 10 ms
    added = effect.apply(np.zeros((30, 40)), shots.shot(exposure=0.03, binning=2))
    np.testing.assert_allclose(added, 8e3 * 0.03 * 4)


@pytest.mark.parametrize(("width_mm", "small"), [(0.03, 3.0), (0.1, 5.0), (0.3, 7.5)])
def test_a_broad_blur_keeps_the_mean_and_is_the_gaussian(width_mm: float, small: float) -> None:
    """Against scipy's sampled Gaussian on the full image; pixels of 10 um. `small` is the width in pixels of the image
    on which it is worked out: its square says how close (see the tests of broad_blur)."""
    primary = np.exp(-shots.depth(shots.scene(), 0.4))
    added = Scatter(ratio=0.2, width_mm=width_mm).apply(primary.copy(), shots.shot()) - primary
    assert added.mean() == pytest.approx(0.2 * primary.mean(), rel=1e-12)
    expected = gaussian_filter(primary, width_mm / 0.01, mode="reflect", truncate=8)
    np.testing.assert_allclose(added / 0.2, expected, atol=0.2 / small**2)
