"""Tilt: the volume is as good as without tilt, in slabs too; a warning appears if no correction was asked for."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from beamline.core.errors import ConfigError, DataError
from beamline.projections.correction import apply, apply_in_batches, survey
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.resampling import TiltAndLens
from beamline.projections.preparation import Preparation
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from recon.assess.metrics import psnr
from recon.base.volume import Grid
from recon.prep.resample import Distortion
from recon.voxels.fbp import fbp
from tests.beamline.array_source import ArraySource, counted
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import BEAM, DARK
from tests.messages import refused
from tests.recon.prep.balls import Balls

SELECTION = Selection(steps=(Air("none"),))
STRAIGHT = Balls(np.radians(np.arange(0, 180, 3.0)), seed=3)


@cache
def _source(balls_tilt: float) -> ArraySource:
    balls = replace(STRAIGHT, tilt_deg=balls_tilt)
    return counted(DARK + np.random.default_rng(7).poisson(BEAM * np.exp(-balls.views())), balls.angles)


@cache
def _truth(shape: tuple[int, int, int]) -> np.ndarray:
    return STRAIGHT.truth(Grid(shape))


def _quality(prepared: PreparedProjections) -> float:
    """dB of the volume by FBP, in what all views of all these scans see."""
    grid = Grid.matching(prepared.geometry)
    inside = np.s_[4:-4, 8:-8, 8:-8]
    return psnr(fbp(prepared.seen.data, prepared.geometry, grid)[inside], _truth(grid.shape)[inside])


def _tilt(prepared: PreparedProjections) -> tuple[str, object]:
    """What was said of the tilt, and the degrees that the file records."""
    done = prepared.origin.done["tilt"]
    assert done.parameters is not None
    return done.sentence, done.parameters["tilt_deg"]


def test_a_tilt_is_warned_of() -> None:
    as_it_is, warned = prepare(_source(1.5), SELECTION)
    assert [
        text for text in warned if "seems to be tilted in the detector's plane by 1." in text and "--tilt auto" in text
    ]
    assert _tilt(as_it_is) == ("", 0)


@pytest.mark.slow
def test_the_volume_of_a_tilted_scan_is_as_good_as_that_of_a_straight_one() -> None:
    straight, said = prepare(_source(0.0), SELECTION)
    assert not said and _tilt(straight) == ("", 0)
    as_it_is, _ = prepare(_source(1.5), SELECTION)
    levelled, said = prepare(_source(1.5), SELECTION.with_steps(TiltAndLens("auto")))
    assert not said
    assert (
        _tilt(levelled)[0].startswith("The axis is tilted by 1.")
        and "the projections are rotated" in _tilt(levelled)[0]
    )
    given, _ = prepare(_source(1.5), replace(SELECTION, axis_col=STRAIGHT.axis_col).with_steps(TiltAndLens(1.5)))
    for found in (levelled, given):
        assert _tilt(found)[1] == pytest.approx(1.5, abs=0.05)
        assert found.origin.axis_col == pytest.approx(STRAIGHT.axis_col, abs=0.25)
        assert _quality(found) > _quality(straight) - 0.3
    assert _quality(as_it_is) < _quality(straight) - 1


@pytest.mark.slow
def test_no_tilt_changes_nothing() -> None:
    plain, _ = prepare(_source(1.5), SELECTION)
    zero, said = prepare(_source(1.5), SELECTION.with_steps(TiltAndLens(0.0)))
    assert not said and _tilt(zero)[0] == "" and zero.sources.measured is None
    np.testing.assert_array_equal(zero.seen.data, plain.seen.data)
    found, said = prepare(_source(0.0), SELECTION.with_steps(TiltAndLens("auto")))
    assert _tilt(found)[1] == 0 and _tilt(found)[0].endswith("not corrected.") and not said


def test_corners_that_the_detector_did_not_see_weigh_nothing() -> None:
    prepared, _ = prepare(_source(0.0), replace(SELECTION, axis_col=49.3).with_steps(TiltAndLens(5.0)))
    assert prepared.sources.measured is not None and 0.9 < prepared.sources.measured.mean() < 1
    assert prepared.sources.measured[8:-8, 4:-4].all() and not prepared.sources.measured[0, -1]
    weights = prepared.views.weights[...]
    assert weights is not None and not weights[:, ~prepared.sources.measured].any()


@pytest.mark.slow
@pytest.mark.parametrize("binning", [1, 2])
@pytest.mark.parametrize("lens", [None, Distortion(50.0, 30.0, (1.0, 3e-4, -4e-6))])
def test_slabs_and_batches_are_those_of_the_whole(binning: int, lens: Distortion | None) -> None:
    plain = Air("none"), Preparation(zinger_threshold=1e9)  # zingers are judged by the rows that are there
    selection = Selection(binning=binning, steps=(*plain, TiltAndLens(1.5, lens)))
    source, frames = _source(1.5), np.arange(2, 30)
    plan = survey(select(source, selection))
    whole = apply(plan, frames, warn=pytest.fail).data
    np.testing.assert_array_equal(apply(plan, frames, slice(9, 12), pytest.fail).data, whole[:, 9:12])
    rows = replace(selection, rows=(8 * binning, 14 * binning))
    band = apply(survey(select(source, rows)), frames, warn=pytest.fail).data
    np.testing.assert_array_equal(band, whole[:, 8:14])
    out = np.empty(whole.shape, np.float32)
    batches = apply_in_batches(plan, frames, out, 9, pytest.fail, lambda *_: None)
    np.testing.assert_array_equal(batches.data, whole)


def test_what_cannot_be_levelled_is_refused() -> None:
    source = _source(0.0)
    with refused(ConfigError):
        prepare(source, replace(SELECTION, cone=(100.0, 200.0), pixel_size_mm=0.1).with_steps(TiltAndLens(1.0)))
    with refused(ConfigError):
        prepare(source, SELECTION.with_steps(TiltAndLens(1.0), Preparation(noise="counts")))
    few = ArraySource(source._data[:22], source.table.kinds[:22].tolist(), source.table.angles[:22])
    with refused(DataError):
        prepare(few, replace(SELECTION, axis_col=49.3).with_steps(TiltAndLens("auto")))
