"""Narrow field: a rectangle of light."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.effects.beam.narrow_field import NarrowField
from simulators.frame.detector import Detector
from tests.simulators import anomalies, shots


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
