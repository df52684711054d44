"""Lost beam: no light for a while, by views or by the clock."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.effects.beam.lost_beam import LostBeam
from tests.simulators import anomalies, shots


@pytest.mark.parametrize("view", range(8))
def test_its_views_lose_their_light(view: int) -> None:
    lost = {"kind": "lost_beam", "views": [3, 6], "share": 0.02}
    for sample in (True, False):
        shot = shots.shot(view=view, sample=sample)
        assert anomalies.check_regions(lost, shot, loose=0) == (3 <= view < 6)
        np.testing.assert_allclose(anomalies.change(lost, shot), -0.98 if 3 <= view < 6 else 0.0, atol=2e-4)
    assert not anomalies.labels(lost, shots.shot(view=view, beam=False))


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
