"""What is said of the choice whether matter moves."""

from __future__ import annotations

import pytest

from beamline.reconstruct.time_series import _chosen


@pytest.mark.parametrize(
    ("still", "moved", "moves", "advised"),
    [(0.0619, 0.0613, False, True), (0.051, 0.067, False, False), (0.0848, 0.0610, True, False)],
)
def test_a_motion_that_views_held_out_can_hardly_tell_is_to_be_compared(
    still: float, moved: float, moves: bool, advised: bool
) -> None:
    said = _chosen(still, moved, moves)
    assert f"{still:.4g} where nothing moves, {moved:.4g} with motion" in said
    assert ("--moves" in said) is advised
