"""The displacement of a sample that slipped is found from its projections, for balls with known projections."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.voxels.displacement import (
    Displacement,
    displaced,
    displacements,
    judge,
    measured_unmagnified,
    unmagnified,
)
from tests.recon.voxels.balls import ball_views

SHAPE, PITCH = (8, 48), 0.5
ANGLES = np.radians(np.arange(0, 180, 3.0))
PARTS = (np.arange(ANGLES.size) >= 42).astype(np.int64)
GEOMETRY = Geometry.parallel(ANGLES, SHAPE, pixel_pitch=PITCH)
KNOWN = np.ones(SHAPE, np.bool_)
MOVED = Displacement(0.9 * PITCH, -0.6 * PITCH, 0.7 * PITCH, np.radians(1.0))


def views(move: Displacement) -> np.ndarray:
    pixels = [np.where(PARTS, s / PITCH, 0) for s in (move.x, move.y, move.z)]
    return PITCH * ball_views(ANGLES, SHAPE, np.where(PARTS, move.turn, 0), pixels)


@pytest.mark.slow
def test_a_shift_and_a_turn_of_the_sample_are_found() -> None:
    data = views(MOVED)
    still, found = displacements(data, GEOMETRY, PARTS, KNOWN, rounds=5)
    assert still == Displacement()
    np.testing.assert_allclose(astuple(found)[:3], astuple(MOVED)[:3], atol=0.15 * PITCH)
    assert found.turn == pytest.approx(MOVED.turn, abs=np.radians(0.25))
    right, wrong = (judge(data, GEOMETRY, PARTS, KNOWN, [still, at]) for at in (found, Displacement(z=2 * PITCH)))
    assert right.together < min(right.alone, wrong.together) and right.overall < wrong.overall
    assert right.others[1] < 1.5 * right.together


def test_another_sample_is_no_displacement() -> None:
    data = views(Displacement())
    data[PARTS == 1] = PITCH * ball_views(ANGLES[PARTS == 1], SHAPE, seed=1)
    moves = displacements(data, GEOMETRY, PARTS, KNOWN, rounds=2)
    verdict = judge(data, GEOMETRY, PARTS, KNOWN, moves)
    assert verdict.longest == 0
    assert verdict.together > verdict.alone or verdict.others[1] > 1.5 * verdict.together


def test_displaced_views_are_those_of_a_geometry_with_shifts() -> None:
    seen = displaced(GEOMETRY, PARTS, [Displacement(), MOVED])
    point = np.array([3.0, -2.0, 0.4])
    turned, later = ANGLES + np.where(PARTS, MOVED.turn, 0), PARTS * 1.0
    col = point[0] * np.cos(turned) + point[1] * np.sin(turned)
    col += later * (MOVED.x * np.cos(ANGLES) + MOVED.y * np.sin(ANGLES))
    for view in range(ANGLES.size):
        across, down, _ = seen.axes(view) @ point
        origin = seen.origin(view)
        assert across / PITCH + origin[0] - GEOMETRY.axis_col == pytest.approx(col[view] / PITCH)
        assert down / PITCH + origin[1] - GEOMETRY.axis_row == pytest.approx((point[2] + later[view] * MOVED.z) / PITCH)


def test_an_unmagnified_image_is_that_of_the_reference() -> None:
    """A Gaussian spot whose place and width grow with the magnification about a pixel that keeps its place."""
    row, col = np.mgrid[:40, :60].astype(float)

    def spot(factor: float) -> np.ndarray:
        at = (18 + factor * 5, 25 + factor * 9)
        return np.exp(-((row - at[0]) ** 2 + (col - at[1]) ** 2) / 2 / (3 * factor) ** 2).astype(np.float32)[None]

    for factor in (0.95, 1.0, 1.04):
        np.testing.assert_allclose(unmagnified(spot(factor), factor, (18, 25)), spot(1.0), atol=2e-3)
    there = np.ones((1, 40, 60), np.bool_)
    there[0, 7, 11] = False
    smaller = measured_unmagnified(there, 1.1, (18, 25))[0]
    assert not smaller[8, 12] and smaller[12:30, 18:50].all() and not smaller[0].any() and not smaller[:, -2:].any()
    assert (measured_unmagnified(there, 1.0, (18, 25)) == there).all()


def test_a_cone_is_refused() -> None:
    with pytest.raises(ValueError, match="cone"):
        displaced(Geometry.cone(ANGLES, SHAPE, PITCH, 100.0, 200.0), PARTS, [Displacement(), MOVED])
