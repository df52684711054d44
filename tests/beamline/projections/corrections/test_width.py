"""The ray width: from an option, or from the motion that the file of a fly scan states."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import ConfigError
from beamline.projections.corrections.calibration.calibrate import Calibrate
from beamline.projections.corrections.width import Width
from beamline.projections.selection import Selection
from beamline.projections.step import StepDone
from beamline.projections.views import select
from beamline.reconstruct.followed_views import FollowedViews
from recon.base.geometry import Geometry
from tests.beamline.array_source import ArraySource

SHAPE = (64, 200)
STEP, PERIOD, EXPOSURE, ROW = math.radians(2), 0.5, 0.4, 1e-3
ARC, SKEW = math.radians(1.6), math.radians(4e-3)  # in an exposure, and from row to row


def _source(mode: str = "fly", sense: float = 1.0, row_period: float | None = ROW, exposure: float = EXPOSURE) -> Any:
    keys = [2, 1, *[0] * 90]
    angles = np.r_[np.nan, np.nan, sense * STEP * np.arange(90)]
    angles[50] = np.nan  # of a view without an angle
    source: Any = ArraySource(np.zeros((92, *SHAPE), np.uint16), keys, angles, np.r_[1.0, 1.0, np.full(90, exposure)])
    source.plan, source.facts, source.row_period = {"mode": mode}, {"period_s": PERIOD}, row_period
    return source


def _rays(step: Width, source: Any, selection: Selection | None = None) -> tuple[Geometry, Geometry, StepDone]:
    scan = select(source, selection or Selection())
    before = scan.selection.geometry(100.0, np.arange(0.0, 3.0, 0.1))
    return before, *step.rays(scan, before)


def test_nothing_is_changed_by_default_where_the_stage_stood() -> None:
    unknown = _source()
    unknown.table.exposures[:] = np.nan
    for source in (_source("step"), unknown):
        before, after, done = _rays(Width(), source)
        assert after is before and (done.sentence, done.parameters) == ("", {})
    before, after, _ = _rays(Width(arc="none"), _source())
    assert after is before


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_stage_that_hardly_moved_was_in_the_middle_of_the_exposure_too(sense: float) -> None:
    """No width is modelled below a pixel; else the volume would be turned by half of the arc."""
    before, after, done = _rays(Width(), _source(sense=sense, exposure=0.01))
    turned = sense * STEP / PERIOD * 0.01 / 2
    np.testing.assert_allclose(after.angles, before.angles + turned, rtol=0, atol=1e-15)
    assert (after.width, after.skew) == (before.width, 0) and done.sentence == ""
    assert done.parameters == {"middle_of_exposure_deg": pytest.approx(math.degrees(turned))}


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_the_file_of_a_fly_scan_tells_its_motion(sense: float) -> None:
    before, after, done = _rays(Width(), _source(sense=sense))
    assert after.width.arc == pytest.approx(ARC) and after.width.variance == 0
    assert after.skew == pytest.approx(sense * SKEW)
    np.testing.assert_allclose(after.angles, before.angles + sense * ARC / 2)
    assert done.sentence == (
        "Ray width in the reconstruction: a projection is the mean over 1.6 degrees (2.8 px at the edge of the field "
        f"of view), the last detector row is exposed {sense * 0.25:.2g} degrees later than the first."
    )
    assert done.parameters == {
        "ray_width": "none",
        "exposure_arc_deg": pytest.approx(sense * 1.6),
        "readout_arc_deg": pytest.approx(sense * 0.252),
    }


def test_rows_and_bins_see_the_angles_of_their_rows() -> None:
    whole = _rays(Width(), _source())[1]
    part = _rays(Width(), _source(), Selection(rows=(10, 50), binning=4))[1]
    np.testing.assert_allclose(part.angles, whole.rows(10, 50).binned(4).angles)
    assert part.skew == pytest.approx(4 * SKEW)


def test_a_motion_may_be_given_and_the_last_row_read_first() -> None:
    before, after, _ = _rays(Width(arc="0.8:-0.63"), _source("step", row_period=None))
    assert after.width.arc == pytest.approx(math.radians(0.8))
    assert after.skew == pytest.approx(-math.radians(0.01))
    np.testing.assert_allclose(after.angles, before.angles + math.radians(0.4))
    backwards = _rays(Width(arc="0.8:-0.63"), _source("step", sense=-1))[1]  # the stage turned the other way
    assert backwards.skew == pytest.approx(math.radians(0.01))


def test_a_pixel_has_its_area_and_blur() -> None:
    before, after, done = _rays(Width("0.6", "none"), _source(), Selection(binning=2))
    assert (after.width.pixel, after.width.blur, after.skew) == (1, 0.3, 0)
    np.testing.assert_array_equal(after.angles, before.angles)
    assert done.sentence == "Ray width in the reconstruction: each ray has the area of a pixel and a blur of 0.6 px."


def test_rows_of_a_cone_have_no_angles_of_their_own() -> None:
    source = _source()
    source.cone, source.pixel_size_mm = (100.0, 150.0), 0.01
    _, after, _ = _rays(Width(), source)
    assert after.width.arc > 0 and after.skew == 0
    with pytest.raises(ConfigError, match="is a cone"):
        _rays(Width(arc="1:0.1"), source)


@pytest.mark.parametrize("term", ["roll", "tilt"])
def test_rows_of_views_whose_lean_is_learnt_have_no_angles_of_their_own(term: str) -> None:
    learnt = Selection().with_steps(Calibrate((term,)))
    _, after, done = _rays(Width(), _source(), learnt)
    assert after.width.arc > 0 and after.skew == 0 and (done.parameters or {})["readout_arc_deg"] == 0
    with pytest.raises(ConfigError, match="calibrated"):
        _rays(Width(arc="1:0.1"), _source(), learnt)
    assert _rays(Width(), _source(), Selection().with_steps(Calibrate(("axis", "shifts"))))[1].skew > 0


def test_a_followed_scan_sees_the_middle_of_the_exposure_too() -> None:
    """Else its volume is turned by half of the arc from that of the finished scan, and its finish knows no motion."""
    source, ids = _source(), np.arange(2, 40)
    views = FollowedViews(select(source, Selection()))
    turned = ARC / 2 + SKEW * (SHAPE[0] - 1) / 2
    np.testing.assert_allclose(views.angles(100.0, ids), source.table.angles[ids] + turned)
    geometry, done = views.geometry(100.0, ids)
    assert (geometry.width.arc, geometry.skew) == (pytest.approx(ARC), pytest.approx(SKEW))
    assert (done.parameters or {})["exposure_arc_deg"] == pytest.approx(1.6)
