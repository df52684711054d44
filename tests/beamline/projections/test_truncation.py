"""A sample wider than the field is reported; its edges are not used as air, those of a drifting beam are."""

from __future__ import annotations

import re

import numpy as np
import pytest

from beamline.projections.preparation import Preparation
from beamline.projections.scan_warnings import cut_sentence
from beamline.projections.selection import Selection
from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.voxels.field_edges import edges_of
from tests.beamline.array_source import ArraySource, scan_of
from tests.beamline.prepared_views import prepare
from tests.slow_cases import others_slow

VIEWS, SHAPE, MU = 90, (4, 64), 0.004
ANGLES = np.linspace(0, np.pi, VIEWS, endpoint=False)
SELECTION = Selection(axis_col=31.5)


def scan(radius: float, light: np.ndarray | float = 1.0, beside: float = 0.0) -> ArraySource:
    """A disc in a beam with noise, of which `light` is left in each view; darks and flats before.

    Its middle lies `beside` columns from the axis, along the beam at first.
    """
    u = np.arange(SHAPE[1]) - 31.5 - beside * np.sin(ANGLES)[:, None, None]
    lines = np.broadcast_to(2 * MU * np.sqrt(np.clip(radius**2 - u**2, 0, None)), (VIEWS, *SHAPE))
    rng = np.random.default_rng(2)
    open_beam = np.full((5, *SHAPE), 40_000.0)
    counts = [rng.poisson(0 * open_beam), rng.poisson(open_beam), rng.poisson(40_000 * light * np.exp(-lines))]
    darks, flats, views = ((each + rng.integers(99, 102, each.shape)).clip(0, 65535) for each in counts)
    return scan_of(darks, flats, views, ANGLES)


def test_a_sample_wider_than_the_field_is_named_and_its_edges_are_not_air() -> None:
    found, (line,) = prepare(scan(45.0), SELECTION)
    assert found.corrected.air_columns == (0, 0)
    assert line.startswith(
        "The sample extends beyond the left and right edge of the field of view (line integral there: "
    )


def test_that_fbp_continues_the_views_is_said_where_it_does() -> None:
    """Not of edges far below the depth in the middle: FBP takes them for air in a beam that has changed."""
    u = np.arange(SHAPE[1]) - 31.5
    lines = np.broadcast_to(0.13 + 2.0 * (np.abs(u) < 8), (VIEWS, *SHAPE)).astype(np.float32)
    geometry = Geometry.parallel(ANGLES, SHAPE)
    low, high = (edges_of(Views(data, geometry)) for data in (lines, lines + np.float32(0.3)))
    assert set(low.beyond()) == set(high.beyond()) == {"left", "right"}
    for edges, continues in ((low, False), (high, True)):
        sentences = [cut_sentence(edges.beyond(), edges.continued, wide) for wide in (False, True)]
        assert [edges.continued == continues == ("FBP extrapolates" in sentence) for sentence in sentences] == [
            True,
            True,
        ]
        assert ["scan.offset_views" in sentence for sentence in sentences] == [True, False]
    _, (line,) = prepare(scan(90.0), SELECTION)
    assert "FBP extrapolates the projections" in line and "they are not used as air" in line


@pytest.mark.slow
def test_a_sample_beside_the_axis_that_leaves_the_field_and_comes_back_is_named_with_its_views() -> None:
    _, told = prepare(scan(28.0, beside=15.0), SELECTION)
    (line,) = (line for line in told if "leaves the field of view" in line)  # a disc's views are mirror images, too
    views = re.search(r"leaves the field of view at the right edge in projections (\d+) to (\d+) of 90", line)
    assert views is not None  # a line integral of 0.1 is at the edge at 25 and 155 degrees
    assert np.abs(np.array(views.groups(), float) - (13, 77)).max() <= 4
    for radius, beside in ((20.0, 8.0), (40.0, 3.0), (45.0, 0.0)):
        _, told = prepare(scan(radius, beside=beside), SELECTION)
        assert not any("leaves the field of view" in line for line in told), (radius, beside)


@pytest.mark.parametrize(
    ("radius", "ring_current", "of_current"),
    others_slow([(90.0, "ignore", [True]), (90.0, "use", []), (20.0, "ignore", [])]),
    ids=["nothing corrects it", "corrected", "corrected by the air"],
)
def test_a_ring_current_that_nothing_corrects_is_told(radius: float, ring_current: str, of_current: list[bool]) -> None:
    current = np.linspace(200, 150, VIEWS)
    source = scan(radius, current[:, None, None] / 200)
    source.state(currents=np.r_[np.full(10, 200.0), current])
    _, told = prepare(source, SELECTION.with_steps(Preparation(ring_current=ring_current)))
    assert ["varies by 33% (from 150 to 200)" in line for line in told if "ring current" in line] == of_current


@pytest.mark.parametrize(
    "light", others_slow([1.0, 0.5]), ids=["matter at the edges", "flats so dark that edges are near 0"]
)
def test_what_flats_of_more_light_do_is_told_where_no_column_shows_air(light: float) -> None:
    as_taken, told = prepare(scan(120.0, 1.8 * light), SELECTION)
    mean = as_taken.seen.data.mean()
    more = prepare(scan(120.0, 1.8 * light / 1.1), SELECTION)[0].seen.data.mean() - mean
    (line,) = (line for line in told if "no detector column shows air" in line)
    assert more == pytest.approx(0.095, abs=0.002)
    share = re.search(r"0.095 too large \((\d+)% of the mean", line)
    assert share is not None
    assert int(share[1]) == pytest.approx(100 * more / mean, rel=0.05)
    assert "Check whether flats and projections had the same exposure time" in line


@pytest.mark.parametrize(
    "light", others_slow([0.68, 1.2, *(np.linspace(1, end, VIEWS)[:, None, None] for end in (0.6, 1.3))]), ids=str
)
def test_a_beam_that_is_not_that_of_its_flats_is_levelled_by_its_air(light: np.ndarray | float) -> None:
    """As of Diamond's scan, whose one flat is brighter than the open beam; its air is no thinner at the edges."""
    found, told = prepare(scan(20.0, light), SELECTION)
    assert told == [] and min(found.corrected.air_columns) > 0
    assert abs(found.seen.data[:, :, :5].mean()) < 0.005


def test_a_full_turn_about_an_axis_beside_the_middle_is_cut_on_purpose() -> None:
    angles = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    lines = np.broadcast_to(np.linspace(1, 0, 64), (180, 2, 64)).astype(np.float32)
    turn, half = (Geometry.parallel(each, (2, 64), axis_col=8.0) for each in (angles, angles / 2))
    assert edges_of(Views(lines, turn)).beyond() == {}
    assert set(edges_of(Views(lines, half)).beyond()) == {"left"}
    assert set(edges_of(Views(lines[:, :, ::-1], turn)).beyond()) == {"right"}
