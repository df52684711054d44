"""Geometry calibrated from projections of analytic bodies: shifts, axis, roll; no change if all is right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.features.calibration.joint import GeometryChange, knowable
from recon.features.calibration.learn import LearntGeometry, better, learn_geometry
from tests.recon.bodies import balls

VIEWS, SHAPE = 60, (24, 48)
BODY = balls(20, 24)
PLACES = frozenset({"axis", "shifts"})


def _start(beam: str = "parallel") -> Geometry:
    if beam == "parallel":
        return Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), SHAPE)
    return Geometry.cone(np.linspace(0, 2 * np.pi, VIEWS, endpoint=False), SHAPE, 1.5, 100, 150)


@pytest.mark.parametrize("beam", ["parallel", "cone"])
def test_the_axis_and_a_jump_are_found_to_a_tenth_of_a_pixel(beam: str) -> None:
    jump = np.outer(np.arange(VIEWS) >= 25, (2.0, -1.5))
    start = _start(beam)
    truth = replace(start, axis_col=start.axis_col + 1.7, shifts=jump)
    learnt, told = None, list[tuple[int, int]]()
    learnt = learn_geometry(BODY.views(truth, 0.01), start, PLACES, lambda n, of: told.append((n, of)))
    rest, mean = knowable(learnt.change.shifts - jump, start.angles)
    assert np.sqrt(np.mean(rest**2)) < 0.1
    assert learnt.change.axis + mean == pytest.approx(1.7, abs=0.1)
    assert learnt.confirmed == ("axis", "shifts") and learnt.after < 0.8 * learnt.before
    assert [n for n, _ in told] == list(range(1, len(told) + 1)) and told[-1][0] <= told[-1][1]


def test_a_right_geometry_stays_as_it_is() -> None:
    start = _start()
    learnt = learn_geometry(BODY.views(start, 0.02), start, frozenset({"axis", "roll", "tilt"}))
    assert abs(learnt.change.axis) < 0.05 and abs(learnt.change.roll) < 2e-3 and not learnt.change.shifts.any()


def test_roll_is_found() -> None:
    start = _start()
    truth = replace(start, roll=np.full(VIEWS, np.radians(3.0)))
    learnt = learn_geometry(BODY.views(truth, 0.01), start, frozenset({"axis", "roll"}))
    assert np.degrees(learnt.change.roll) == pytest.approx(3.0, abs=0.15) and "roll" in learnt.confirmed


def test_a_sample_elsewhere_on_its_stage_is_no_error_of_the_geometry() -> None:
    """Its views differ by a cos θ + b sin θ and a constant along the rows: nobody can know these, nor a turn."""
    angles = _start().angles
    elsewhere = np.stack((2 * np.cos(angles) - 3 * np.sin(angles) + 0.7, np.full(VIEWS, 1.1)), axis=1)
    rest, axis = knowable(elsewhere, angles)
    assert rest == pytest.approx(np.zeros((VIEWS, 2)), abs=1e-12) and axis == pytest.approx(0.7)
    moved = replace(BODY, centre=BODY.centre + np.array((2.0, -3.0, 0.0)))
    learnt = learn_geometry(moved.views(_start(), 0.01), _start(), PLACES)
    assert np.abs(learnt.change.shifts).max() < 0.25 and abs(learnt.change.axis) < 0.05


def test_a_change_is_of_its_terms_and_scales_with_pixels() -> None:
    change = GeometryChange(1.0, 0.1, 0.2, np.ones((2, 2)))
    assert (change.of(frozenset({"roll"})).axis, change.of(frozenset({"roll"})).roll) == (0, 0.1)
    assert change.scaled(4).axis == 4 and change.scaled(4).tilt == 0.2 and (change.scaled(4).shifts == 4).all()
    after = change.applied(Geometry.parallel([0.0, 1.0], (4, 8)))
    found = GeometryChange.between(Geometry.parallel([0.0, 1.0], (4, 8)), after)
    assert (found.axis, found.shifts.tolist()) == (1.0, change.shifts.tolist())


def test_what_was_learnt_is_said_in_pixels_of_the_detector() -> None:
    change = GeometryChange(1.0, 0.0, 0.0, np.zeros((2, 2)))
    assert LearntGeometry(change, ("axis",), ("roll",), 0.4, 0.3).in_words(2) == (
        "Geometry calibrated: the axis moves by +2.00 px. The deviation of held-out projections fell from 0.4 to 0.3. "
        "Roll: unchanged, because held-out projections do not confirm a change."
    )
    assert (
        LearntGeometry(GeometryChange.none(2), (), (), 0.4, 0.4)
        .in_words()
        .startswith("Geometry: unchanged, because the projections show no significant error")
    )


def test_better_means_better_in_most_views() -> None:
    base = np.linspace(1, 2, 20)
    assert better(0.9 * base, base) and not better(base, base) and not better(base, 0.9 * base)
    one_view = base.copy()
    one_view[3] *= 0.5
    assert not better(one_view, base)


def test_few_views_and_views_without_matter_are_refused() -> None:
    few = _start().select(slice(11))
    with pytest.raises(ValueError, match="geometry: 11"):
        learn_geometry(np.ones((11, *SHAPE), np.float32), few, PLACES)
    with pytest.raises(ValueError, match="no absorbing sample"):
        learn_geometry(np.zeros((VIEWS, *SHAPE), np.float32), _start(), PLACES)
