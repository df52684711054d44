"""Black band: dark at the left side, with a soft edge, in flats too."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.effects.anomaly import Label
from simulators.effects.beam.black_band import BlackBand
from tests.simulators import anomalies, shots

BAND = {"kind": "black_band", "width": 0.08, "penumbra": 0.04, "share": 0.1, "views": [3, 6]}


def test_the_light_falls_off_as_a_ramp_to_the_share_that_is_left() -> None:
    light = 1 + anomalies.change(BAND, shots.shot(view=3, sample=False))
    # Pixels of 0.01 mm: dark up to 0.06 mm, all light from 0.1 mm on.
    ramp = [0.1] * 6 + [0.1 + 0.9 * share for share in (0.125, 0.375, 0.625, 0.875)] + [1.0] * 70
    np.testing.assert_allclose(light, np.broadcast_to(ramp, (60, 80)), atol=1e-4)


@given(width=st.floats(0.001, 1.5), penumbra=st.floats(0.0, 0.5), share=st.floats(0.0, 0.9))
def test_the_region_covers_the_darkened_pixels(width: float, penumbra: float, share: float) -> None:
    band = {"kind": "black_band", "width": width, "penumbra": penumbra, "share": share}
    anomalies.check_regions(band, shots.shot(sample=False))


@pytest.mark.parametrize("view", range(8))
def test_it_is_there_in_its_views_for_flats_and_projections_but_not_in_darks(view: int) -> None:
    for sample in (True, False):
        assert anomalies.check_regions(BAND, shots.shot(view=view, sample=sample)) == (3 <= view < 6)
    assert not anomalies.labels(BAND, shots.shot(view=view, beam=False))


def test_it_is_there_always_without_views() -> None:
    band = BlackBand(0.05)
    assert band.labels(shots.shot(view=10_000)) == [Label("black_band", (0, 60, 0, 5))]
    assert BlackBand(2.0).labels(shots.shot()) == [Label("black_band", (0, 60, 0, 80))]
