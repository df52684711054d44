"""A scan with wrong angles, heights or axis is reported with what its projections show; a right one is not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from beamline.projections.consistency import warn_of_inconsistency
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import ScanSelection, Selection
from recon.base.geometry import Geometry
from tests.beamline.array_source import ArraySource
from tests.beamline.prepared_views import prepare
from tests.bench.clean_scans import lines_of
from tests.recon.prep.balls import Balls
from tests.recon.prep.test_fan import views as fan_views
from tests.recon.prep.test_repeats import BALLS, shrinks

ANGLES, AXIS = np.linspace(0, np.pi, 45, endpoint=False), 36.8
VIEWS = Balls(ANGLES, (24, 72), AXIS).views() + np.random.default_rng(3).normal(0, 0.01, (45, 24, 72))


@cache
def stretched() -> tuple[PreparedProjections, list[str]]:
    """The scan, stated at angles 1.06 times as large, as it is prepared, and what was told of it."""
    source = ArraySource(VIEWS.astype(np.float32), [0] * len(VIEWS), ANGLES * 1.06)
    source.quantity = "line_integrals"
    return prepare(source, Selection(axis_col=AXIS))


def told(views: np.ndarray, axis_col: float = AXIS, angles: np.ndarray = ANGLES) -> list[str]:
    scan, sentences = stretched()[0], list[str]()
    geometry = Geometry.parallel(angles, VIEWS.shape[1:], axis_col=axis_col)
    lines = replace(scan.lines, data=views.astype(np.float32), geometry=geometry, reach=None)
    scan = replace(scan, lines=lines)
    whole = ScanSelection(asked=Selection(), shape=VIEWS.shape[1:], path=Path("scan.h5"), axis_col=axis_col)
    warn_of_inconsistency(scan, whole, sentences.append)
    return sentences


def test_a_right_scan_is_not_told_of_nor_one_whose_air_is_not_at_zero_and_has_moments_of_its_own() -> None:
    assert told(VIEWS) == told(VIEWS - 0.5, angles=ANGLES * 1.06) == []


def test_every_scan_is_looked_at() -> None:
    assert any("the stated angles cover 186.6" in sentence for sentence in stretched()[1])


@pytest.mark.parametrize("scale", [0.95, 1.06])
def test_angles_of_another_scale(scale: float) -> None:
    (sentence,) = told(VIEWS, angles=ANGLES * scale)
    assert f"the stated angles cover {176 * scale:.4g}" in sentence
    assert "--angles" in sentence


@pytest.mark.parametrize("turn", [180.0, 360.0])
@pytest.mark.parametrize("taken", [True, False])
def test_angles_with_both_ends_of_views_without_and_the_reverse(turn: float, taken: bool) -> None:
    """The wrong ends are told by name, the right ones are not."""
    stated = {ends: np.radians(np.linspace(0, turn, 45, endpoint=ends)) for ends in (True, False)}
    views = Balls(stated[taken], (24, 72), AXIS).views() + np.random.default_rng(3).normal(0, 0.01, (45, 24, 72))
    assert told(views, angles=stated[taken]) == []
    (sentence,) = told(views, angles=stated[not taken])
    assert f"both ends of {turn:g} degrees" in sentence and ("too small" if taken else "too large") in sentence


def test_a_faint_sample_that_shrinks_is_told_by_views_of_the_same_rays() -> None:
    twice = np.linspace(0, 4 * np.pi, len(VIEWS))  # view 44 sees the rays of view 0
    noise = np.random.default_rng(3).normal(0, 0.002, VIEWS.shape)
    still = 0.012 * lines_of(BALLS, twice, VIEWS.shape[1:], AXIS)
    smaller = 0.012 * lines_of(BALLS, twice, VIEWS.shape[1:], AXIS, change=shrinks)
    assert still.max() < 0.25
    assert told(still + noise, angles=twice) == []
    (sentence,) = told(smaller + noise, angles=twice)
    assert "measure the same rays" in sentence and "narrower" in sentence


def test_a_cone_that_is_not_stated_is_told_and_parallel_rays_are_not() -> None:
    for degrees, expected in ((0.0, 0), (17.0, 1)):
        sinogram, angles = fan_views(np.tan(np.radians(degrees / 2)) / 48)
        views = np.repeat(sinogram[:, None] / 100, 12, axis=1)
        source = ArraySource(views.astype(np.float32), [0] * len(views), angles)
        source.quantity = "line_integrals"
        _, sentences = prepare(source, Selection(axis_col=47.5))
        told_of = [sentence for sentence in sentences if "contradict the stated geometry" in sentence]
        assert len(told_of) == expected, sentences
        for sentence in told_of:
            assert (
                "If the beam is a cone, give --cone SOD:SDD" in sentence
                and "the stated distances give a fan angle of 0 degrees" in sentence
            )


@pytest.mark.parametrize("axis_col", [47.5, 47.2, 44.0])
def test_a_round_noisy_sample_shows_no_fan(axis_col: float) -> None:
    """Its views agree for every fan, and only with parallel rays is nothing interpolated, which averages noise."""
    angles, u = np.arange(90) * 2 * np.pi / 90, np.arange(96) - axis_col
    noise = np.random.default_rng(0).normal(0, 0.06, (90, 12, 96))
    source = ArraySource((np.sqrt(np.clip(1 - (u / 32) ** 2, 0, None)) + noise).astype(np.float32), [0] * 90, angles)
    source.quantity = "line_integrals"
    _, sentences = prepare(source, Selection(axis_col=axis_col))
    assert not any("contradict the stated geometry" in sentence for sentence in sentences)
