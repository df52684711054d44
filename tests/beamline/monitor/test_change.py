"""A projection may differ from earlier ones by gain, shift or rotation, and the fit distinguishes them."""

from typing import Any

import numpy as np
import pytest

from beamline.monitor.change import SPAN, SampleChange, change_of
from beamline.monitor.view import CellView, grid_of, view_of
from tests.beamline.monitor.blobs import BLOCK, COLS, OPEN, ROWS, STEP, Blobs

SHAPE = (ROWS, COLS)
GRID = grid_of(SHAPE, BLOCK, None, np.full(SHAPE, OPEN, np.float32))


def view(i: float, gain: float = 0.0, shift: tuple[float, float] = (0.0, 0.0)) -> CellView:
    light = OPEN * (1 + gain) * np.exp(-Blobs().line_integrals(i, shift))  # type: ignore[arg-type]
    return view_of(light.astype(np.float32), GRID, int(i), round(i) * STEP, 1.0)


BEFORE = [view(i) for i in range(SPAN)]


def change(**of_view: Any) -> SampleChange:
    found = change_of(view(of_view.pop("i", SPAN), **of_view), BEFORE, GRID)
    assert found is not None
    return found


def test_a_black_band_is_no_gain_and_no_shift() -> None:
    now = view(SPAN)
    now.depth[10:13] = 6.0
    found = change_of(now, BEFORE, GRID)
    assert found is not None and found.gain == pytest.approx(0, abs=0.005)
    assert (found.across, found.down) == pytest.approx((0, 0), abs=0.3)


@pytest.mark.parametrize("gain", [0.0, -0.05, 0.01, 0.2])
def test_light_that_steps_is_gain_and_nothing_else(gain: float) -> None:
    found = change(gain=gain)
    assert found.gain == pytest.approx(gain, abs=1e-3)
    assert (found.across, found.down) == pytest.approx((0, 0), abs=0.03)
    assert found.turn == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize(("down", "across"), [(0.0, 0.25), (0.0, -0.25), (0.25, 0.0), (-0.1, 0.2)])
def test_a_sample_that_jumps_is_shifted_by_as_many_pixels(down: float, across: float) -> None:
    found = change(shift=(down, across))
    assert found.across == pytest.approx(BLOCK * across, abs=0.08)
    assert found.down == pytest.approx(BLOCK * down, abs=0.08)
    assert found.gain == pytest.approx(0, abs=1e-3)


def test_a_stage_that_slips_turns_by_as_many_steps() -> None:
    slipped = view_of(
        (OPEN * np.exp(-Blobs().line_integrals(SPAN + 2))).astype(np.float32), GRID, SPAN, SPAN * STEP, 1.0
    )
    found = change_of(slipped, BEFORE, GRID)
    assert found is not None
    assert found.turn == pytest.approx(2, abs=0.2)
    assert (found.across, found.down) == pytest.approx((0, 0), abs=0.1)


def test_a_gap_of_two_views_is_bridged_and_uneven_angles_are_not() -> None:
    assert change(i=SPAN + 2).turn == pytest.approx(0, abs=0.05)
    assert change_of(view(SPAN + 9), BEFORE, GRID) is None
    assert change_of(view(SPAN), [view(i) for i in (0, 7, 1, 3)], GRID) is None
    assert change_of(view(SPAN), BEFORE[1:], GRID) is None


def test_unlit_cells_have_no_say() -> None:
    flat = np.full(SHAPE, OPEN, np.float32)
    flat[:, 100:] = 10.0
    grid = grid_of(SHAPE, BLOCK, None, flat)
    views = []
    for i in range(SPAN + 1):
        light = OPEN * np.exp(-Blobs().line_integrals(i))
        light[:, 100:] = np.random.default_rng(i).uniform(0, 20, (ROWS, COLS - 100))
        views.append(view_of(light.astype(np.float32), grid, i, i * STEP, 1.0))
    found = change_of(views[-1], views[:-1], grid)
    assert found is not None
    assert found.gain == pytest.approx(0, abs=1e-3)
    assert not found.residual[:, 100:].any()
