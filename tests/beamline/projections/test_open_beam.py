"""Photon counts of a scan file: every method can use their likelihood; it is used automatically if they are few."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import ConfigError
from beamline.projections.correction import ScanCorrectionPlan, survey
from beamline.projections.corrections.air import Air
from beamline.projections.preparation import Preparation
from beamline.projections.prepared import hold_out
from beamline.projections.protocols import PrepStep
from beamline.projections.selection import Selection
from beamline.projections.views import select
from recon.base.choices import Noise
from recon.prep.counts import Counts, line_integrals
from tests.beamline.array_source import ArraySource, scan_of
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import TwoCylinders

SCAN = TwoCylinders(shape=(16, 64), axis_col=31.7)
EXACT = SCAN.line_integrals()
GAIN, DARK, READOUT = 7.0, 100.0, 6.0
PLAIN = Selection(axis_col=31.7, steps=(Air("none"),))


def scan(photons: float, n_flats: int = 20, n_darks: int = 10) -> ArraySource:
    """Darks, flats and views with so many photons a pixel in the open beam."""
    rng, shape = np.random.default_rng(3), SCAN.shape
    light = [np.zeros((n_darks, *shape)), np.full((n_flats, *shape), photons), photons * np.exp(-EXACT)]
    darks, flats, views = (DARK + GAIN * rng.poisson(some) + rng.normal(0, READOUT, some.shape) for some in light)
    return scan_of(darks, flats, views, SCAN.angles, np.float32)


def plan_of(source: Any, *steps: PrepStep, **chosen: Any) -> ScanCorrectionPlan:
    selection = replace(PLAIN, **chosen).with_steps(*steps)
    plan = survey(select(source, selection))
    assert plan.references is not None and not plan.warnings
    return plan


def test_line_integrals_and_weights_are_those_of_counts() -> None:
    source = scan(20)
    found = prepare(source, PLAIN.with_steps(Preparation(noise="counts", gain=GAIN)))[0].seen
    darks, flats, views = source.read(slice(10)), source.read(slice(10, 30)), source.read(slice(30, None))
    variance = float(np.median(darks.var(axis=0, ddof=1)))
    data, weights = line_integrals(Counts(views, flats.mean(axis=0), darks.mean(axis=0), GAIN, variance))
    assert found.weights is not None
    np.testing.assert_allclose(found.data, data, atol=2e-3)
    np.testing.assert_allclose(found.weights, weights, rtol=2e-3)


@pytest.mark.slow
def test_few_photons_are_unbiased_where_their_logarithm_is_not() -> None:
    """The likelihood chosen by itself, with the gain that the flats show."""
    behind = 0.3 * EXACT.max() < EXACT
    counted, logarithm = (prepare(scan(10), PLAIN.with_steps(Preparation(noise=way)))[0] for way in ("auto", "log"))
    weights = counted.views.weights[...]
    assert logarithm.views.weights is None
    assert abs(np.average((counted.seen.data - EXACT)[behind], weights=weights[behind])) < 0.03
    assert np.mean((logarithm.seen.data - EXACT)[behind]) > 0.1
    assert "10" in counted.origin.done["noise"].sentence and logarithm.origin.done["noise"].sentence == ""


@pytest.mark.parametrize(("photons", "noise", "counted"), [
    (30, "auto", True), (1000, "auto", False), (1000, "counts", True), (30, "log", False)
])  # fmt: skip
def test_counts_where_they_are_few_or_asked_for(photons: float, noise: Noise, counted: bool) -> None:
    found = plan_of(scan(photons), Preparation(noise=noise))
    assert (found.photons is not None) == counted
    if found.photons is not None:
        assert found.photons.gain == pytest.approx(GAIN, rel=0.1)
        assert found.photons.variance**0.5 == pytest.approx(READOUT, rel=0.1)


@pytest.mark.parametrize(("binning", "frames", "of"), [(2, 1, 4), (1, 5, 5)])
@pytest.mark.parametrize("gain", [None, GAIN])
def test_binned_pixels_and_means_of_frames_have_the_photons_of_all(
    binning: int, frames: int, of: int, gain: float | None
) -> None:
    """By the flats as they are read and by the gain of one pixel: a mean of four pixels has a quarter of the gain."""
    source = scan(20)
    source.frames_per_view = frames
    found = plan_of(source, Preparation(noise="counts", gain=gain), binning=binning)
    assert found.photons is not None
    assert found.photons.gain == pytest.approx(GAIN / of, rel=0.1)
    assert found.photons.variance == pytest.approx(READOUT**2 / of, rel=0.2)


def test_weights_follow_the_views_and_pixels_that_are_left() -> None:
    prepared, _ = prepare(scan(20), PLAIN.with_steps(Preparation(noise="counts")))
    held = hold_out(prepared, 9, advice="")
    weights, alike = prepared.views.weights[...], held.views.weights[...]
    assert held.lines.unseen is not None and len(held.lines.unseen.data) == 5
    apart = np.setdiff1d(np.arange(len(EXACT)), held.ids - prepared.ids[0])
    both = np.concatenate((np.delete(weights, apart, 0), weights[apart]))
    np.testing.assert_allclose(alike / alike.mean(), both / both.mean(), rtol=1e-5)
    rows = held.of_rows(slice(2, 6), held.geometry.rows(2, 6)).lines.unseen
    assert rows is not None
    np.testing.assert_array_equal(rows.weights, held.lines.unseen.weights[:, 2:6])


def test_one_flat_does_not_tell_the_gain() -> None:
    assert prepare(scan(20, n_flats=1), PLAIN)[0].origin.done["noise"].sentence == ""
    with pytest.raises(ConfigError, match="--gain COUNTS"):
        prepare(scan(20, n_flats=1), PLAIN.with_steps(Preparation(noise="counts")))


def test_line_integrals_have_no_photons() -> None:
    source = scan(20)
    source.quantity = "line_integrals"
    with pytest.raises(ConfigError, match="not counts"):
        prepare(source, PLAIN.with_steps(Preparation(noise="counts")))


@pytest.mark.parametrize("gain", [1.0, 3.0])
def test_dark_corners_of_the_frame_are_no_lack_of_photons(gain: float) -> None:
    """A beam that lights less than half of the frame, as behind a round window."""
    rng, (rows, cols) = np.random.default_rng(4), SCAN.shape
    window = np.hypot(*np.meshgrid(np.linspace(-1, 1, cols), np.linspace(-1, 1, rows))) < 0.7
    counts = (DARK + gain * rng.poisson(2000.0 * window * light) for light in np.exp(-np.r_[[0 * EXACT[0]] * 6, EXACT]))
    frames = np.stack([*counts])
    darks = rng.normal(DARK, 2, (6, rows, cols)).round()
    found = plan_of(scan_of(darks, frames[:6], frames[6:], SCAN.angles, np.float32))
    assert window.mean() < 0.5 and found.photons is None
