"""Doubtful scans that can be read: the projections contradict the stated axis, or some are copies."""

from __future__ import annotations

import numpy as np

from beamline.projections.selection import Selection
from tests.beamline.array_source import scan_of
from tests.beamline.prepared_views import prepare

ROWS, COLS, VIEWS, AXIS = 8, 64, 60, 33.0


def told(selection: Selection, copies: tuple[int, ...] = ()) -> list[str]:
    """What is told of a scan of two balls, by the formula of a sphere's chord.

    Args:
        copies: views that are those before them.
    """
    rng = np.random.default_rng(3)
    angles = np.radians(np.linspace(0, 180, VIEWS, endpoint=False))
    row, col = np.arange(ROWS) - (ROWS - 1) / 2, np.arange(COLS) - AXIS
    depth = np.zeros((VIEWS, ROWS, COLS))
    for x, y, radius, mu in ((0, 0, 22, 0.01), (9, 5, 6, 0.04)):
        at = (x * np.cos(angles) + y * np.sin(angles))[:, None, None]
        depth += 2 * mu * np.sqrt((radius**2 - (col - at) ** 2 - row[:, None] ** 2).clip(0))
    light = np.zeros((3, ROWS, COLS)), np.ones((3, ROWS, COLS)), np.exp(-depth)
    darks, flats, views = (rng.poisson(3e4 * each + 100) for each in light)
    for view in copies:
        views[view] = views[view - 1]
    _, sentences = prepare(scan_of(darks, flats, views, angles), selection)
    return [sentence for sentence in sentences if "rotation axis" in sentence or "projection before" in sentence]


def test_a_scan_that_is_as_stated_is_not_doubted() -> None:
    assert told(Selection(axis_col=AXIS + 0.4)) == []


def test_copies_and_an_axis_that_the_views_contradict_are_named() -> None:
    axis, copied = told(Selection(axis_col=COLS - 1 - AXIS + 5), copies=(30, 31, 40))
    assert "rotation axis at column 33." in axis and "but 35 was given" in axis
    assert "3 projections of 60 (frames 36-37, 46) are identical to the projection before" in copied
