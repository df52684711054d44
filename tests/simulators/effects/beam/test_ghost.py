"""Ghost: a hump of light that crosses from right to left in a few views."""

from __future__ import annotations

import numpy as np
import pytest

from tests.simulators import anomalies, shots

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
