"""Phase filter of a scan: same result in batches, bands of rows and slabs; its values come from file or options."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beamline.core.errors import ConfigError
from beamline.projections.correction import ScanCorrectionPlan, apply, apply_in_batches, survey
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.phase.phase import Phase
from beamline.projections.preparation import Preparation
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.projections.protocols import ScanPart
from beamline.projections.selection import Selection
from beamline.projections.step import NamedStep
from beamline.projections.views import select
from recon.features.phase import FilterLength
from recon.prep.projections import Projections
from tests.beamline.array_source import ArraySource, counted
from tests.beamline.prepared_views import feed_batches
from tests.beamline.projections.corrections.test_memory import peak
from tests.beamline.scans import BEAM, DARK
from tests.messages import refused
from tests.recon.prep.rims import views_of_can

PHASE = Phase("20", distance_mm=50.0, energy_kev=20.0)
SELECTION = Selection(pixel_size_mm=1e-3, steps=(Air("none"), PHASE))


def _source() -> ArraySource:
    rng = np.random.default_rng(3)
    return counted(DARK + BEAM * np.exp(-rng.uniform(0, 1, (8, 48, 40))), np.radians(np.arange(0, 180, 22.5)))


def _plan(selection: Selection) -> ScanCorrectionPlan:
    return survey(select(_source(), selection))


def test_batches_and_views_on_disk_are_the_views_at_once() -> None:
    plan, frames = _plan(SELECTION), np.arange(2, 10)
    whole = apply(plan, frames, warn=pytest.fail)
    fed, _ = feed_batches(plan, [frames[:3], frames[3:]])
    np.testing.assert_array_equal(fed.data, whole.data)
    out = np.empty(whole.data.shape, np.float32)
    np.testing.assert_array_equal(apply_in_batches(plan, frames, out, 3, pytest.fail, lambda *_: None).data, whole.data)


@pytest.mark.parametrize("binning", [1, 2])
def test_some_rows_are_those_of_the_whole_frame(binning: int) -> None:
    """Rows around those chosen are read as far as the filter reaches, so that a band has no mirrors of its own."""
    frames, selection = np.arange(2, 10), replace(SELECTION, binning=binning)
    whole = apply(_plan(selection), frames, warn=pytest.fail).data
    band = apply(_plan(replace(selection, rows=(20, 28))), frames, warn=pytest.fail).data
    assert band.shape[1] == 8 // binning
    np.testing.assert_allclose(band, whole[:, 20 // binning : 28 // binning], atol=0.01)
    narrow = apply(_plan(selection), frames, slice(4, 6), pytest.fail).data
    np.testing.assert_allclose(narrow, whole[:, 4:6], atol=0.01)
    assert whole.std() < 0.5 * apply(_plan(selection.with_steps(Phase())), frames).data.std()


def test_what_the_file_does_not_say_is_asked_for() -> None:
    source = _source()
    with refused(ConfigError):
        Phase("20").filter_of(select(source, SELECTION))
    source.facts, source.energy_kev = {"distance_mm": 50.0}, 20.0
    found, said = Phase("20").filter_of(select(source, SELECTION))
    assert found == PHASE.filter_of(select(source, SELECTION))[0]
    assert "delta/beta 20 at 20 keV, 50 mm behind" in said
    with refused(ConfigError):
        replace(PHASE, distance_mm=5e6).filter_of(select(source, SELECTION))
    with refused(ConfigError):
        _plan(SELECTION.with_steps(Preparation(noise="counts")))


def test_a_cone_is_scaled_to_the_sample() -> None:
    source = _source()
    source.cone = (10.0, 40.0)
    found, said = replace(PHASE, distance_mm=None).filter_of(select(source, SELECTION))
    near = replace(SELECTION, pixel_size_mm=0.25e-3)
    plane, _ = replace(PHASE, distance_mm=7.5).filter_of(select(_source(), near))
    assert "30 mm behind" in said and found.length == pytest.approx(plane.length)


def _rimmed(fringes: float) -> ArraySource:
    views, geometry = views_of_can(fringes)
    source = counted(DARK + BEAM * np.exp(-views), geometry.angles)
    source.axis_col = geometry.axis_col
    return source


def _prepared(source: ArraySource, *steps: NamedStep) -> PreparedProjections:
    return prepare_projections(select(source, Selection(axis_col=source.axis_col, steps=steps)), lambda _: None)


def test_fringes_are_undone_by_default_and_said_with_the_ratio_where_it_is_known() -> None:
    source = _rimmed(0.8)
    found = _prepared(source)
    sentence = found.origin.done["phase"].sentence
    assert (
        "(from held-out projections)" in sentence
        and "lower than in air" in sentence
        and "--phase none omits the filter" in sentence
    )
    length = float(sentence.split("over ")[1].split(" pixels")[0])
    by_hand = replace(Phase(), length=length)
    np.testing.assert_allclose(found.seen.data, _prepared(source, by_hand).seen.data, atol=2e-3)
    still = _prepared(source, Phase(None))
    assert found.seen.data.min() > 0.5 * still.seen.data.min()  # less light beyond the open beam
    source.energy_kev, source.pixel_size_mm = 25.0, 4.6e-3
    ratio = _prepared(source, Phase(distance_mm=30.0)).origin.done["phase"].sentence.split("delta/beta ")[1]
    assert float(ratio.split(" at 25 keV, 30 mm")[0]) == pytest.approx((length / 0.0748) ** 2, rel=0.03)


def test_without_fringes_views_are_those_of_none_to_the_bit() -> None:
    found, still = (_prepared(_rimmed(0.0), *steps) for steps in ((), (Phase(None),)))
    np.testing.assert_array_equal(found.seen.data, still.seen.data)
    assert found.origin.done["phase"].sentence == "" and dict(found.origin.done["phase"].parameters or {}) == {
        "phase": "not retrieved"
    }


def test_an_overshoot_that_no_filter_explains_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recon.features.phase.length_by_held_out_views", lambda *_: None)
    found = _prepared(_rimmed(0.8))
    assert "--phase auto found no filter" in found.origin.done["phase"].sentence
    np.testing.assert_array_equal(found.seen.data, _prepared(_rimmed(0.8), Phase(None)).seen.data)


def test_a_filter_that_explains_little_is_told_of_and_not_applied(monkeypatch: pytest.MonkeyPatch) -> None:
    """It blurs: a tooth's thin cracks lose half their depth by one that predicts views held out 8 % better."""
    monkeypatch.setattr("recon.features.phase.length_by_held_out_views", lambda *_: FilterLength(1.4, 1.1, 0.08))
    found = _prepared(_rimmed(0.8))
    sentence = found.origin.done["phase"].sentence
    assert "over 1.4 pixels would lower the residual in held-out projections by 8%" in sentence
    np.testing.assert_array_equal(found.seen.data, _prepared(_rimmed(0.8), Phase(None)).seen.data)


@pytest.mark.slow
def test_the_search_takes_no_more_memory_than_it_states() -> None:
    source = _rimmed(0.8)
    views, geometry = views_of_can(0.8)
    part = ScanPart(select(source, Selection()), geometry)
    masked = np.zeros(views.shape[1:], np.bool_)
    given = Projections(views, np.arange(len(views)), 0.0, np.ones(len(views), np.float32), masked)
    taken = peak(lambda: Phase().estimated(part.scan, given, geometry, lambda *_: None))
    assert 0.25 * Phase().memory(part).alone < taken < Phase().memory(part).alone


def test_an_unsharp_mask_that_no_filter_precedes_is_not_dropped_without_a_word() -> None:
    sentence = _prepared(_rimmed(0.0), Phase(unsharp=(1.5, 2.0))).origin.done["phase"].sentence
    assert "No phase retrieval" in sentence and "--unsharp has no effect" in sentence
