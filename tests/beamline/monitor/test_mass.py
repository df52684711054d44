"""What enters or leaves the field changes the projection's total; turning, noise and a dimming beam do not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from tests.slow_cases import others_slow

SAMPLE = ((0.0, 0.0, 30.0, 0.02), (10.0, 5.0, 8.0, 0.05), (-12.0, 3.0, 6.0, 0.05))


def total(discs: tuple[tuple[float, ...], ...]) -> float:
    """Area of each disc times its attenuation: the integral of the projection, from every side."""
    return sum(np.pi * radius**2 * attenuation for _, _, radius, attenuation in discs)


def only(flags: list[Flag]) -> list[Flag]:
    return [f for f in flags if f.check == "mass"]


def test_a_floater_is_flagged_from_its_third_view_with_its_mass(fake: Any) -> None:
    floater = (5.0, -20.0, 5.0, 0.08)
    with_floater = (*SAMPLE, floater)
    frames = fake.references() + fake.views(20) + fake.views(6, first=20, discs=with_floater)
    flags = only(fake.flags(frames))
    assert [f.frame for f in flags] == [32, 33, 34, 35]
    assert flags[0].level is Level.WARN
    assert flags[0].score == pytest.approx(total([floater]) / total(SAMPLE), rel=0.15)
    assert "entered" in flags[0].advice


def test_a_sample_that_falls_off_its_holder(fake: Any) -> None:
    frames = fake.references() + fake.views(20) + fake.views(4, first=20, discs=())
    flags = only(fake.flags(frames))
    assert [f.frame for f in flags] == [32, 33]
    assert flags[0].score == pytest.approx(-1, abs=0.05)
    assert "left" in flags[0].advice


def test_two_views_are_not_enough(fake: Any) -> None:
    frames = fake.references() + fake.views(20) + fake.views(2, first=20, discs=()) + fake.views(5, first=22)
    assert only(fake.flags(frames)) == []


def test_a_beam_that_loses_three_percent_is_not_mass(fake: Any) -> None:
    frames = fake.references() + fake.views(20) + fake.views(10, first=20, light=0.97)
    assert only(fake.flags(frames)) == []


@pytest.mark.parametrize("lost", others_slow([0.09, 0.3, 0.0, 0.03], 2))
def test_thin_matter_that_passes_the_edges_is_no_mass_that_left_while_the_beam_weakens(fake: Any, lost: float) -> None:
    beside = (*SAMPLE, (0.0, 41.0, 5.0, 0.006), (0.0, -41.0, 5.0, 0.006))  # in both edges at 90°
    frames = fake.references()
    frames += [fake.views(1, first=i, light=1 - lost * i / 180, discs=beside)[0] for i in range(180)]
    assert only(fake.flags(frames)) == []


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_a_sample_that_falls_off_while_the_beam_weakens_is_mass(fake: Any, lost: float) -> None:
    frames = fake.references()
    frames += [fake.views(1, first=i, light=1 - lost * i / 90)[0] for i in range(90)]
    frames += fake.views(4, first=90, discs=(), light=1 - lost)
    flags = only(fake.flags(frames))
    assert [f.frame for f in flags] == [102, 103] and "left" in flags[0].advice


def test_a_truncated_sample_is_left_alone(fake: Any) -> None:
    off_centre = ((40.0, 0.0, 30.0, 0.03),)
    assert only(fake.flags(fake.references() + fake.views(180, discs=off_centre))) == []


def test_without_flats_there_is_nothing_to_compare(fake: Any) -> None:
    assert only(fake.flags(fake.darks() + fake.views(20) + fake.views(5, first=20, discs=()))) == []


def test_an_empty_field_has_no_mass_to_change(fake: Any) -> None:
    assert only(fake.flags(fake.references() + fake.views(200, discs=()))) == []
