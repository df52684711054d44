"""From frames to line integrals: right values, right geometry, and nothing that was not requested."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import recon
from beamline.projections import axis as axis_module
from beamline.projections.corrections.air import Air
from beamline.projections.selection import Selection
from recon.base.geometry import Geometry
from recon.base.views import spread_views
from recon.prep.align import AxisEstimate
from tests.beamline.array_source import ArraySource, counted
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import BEAM, DARK, TwoCylinders, write_exchange

SCAN = TwoCylinders()
FOUND = Selection(steps=(Air("none"),))
GIVEN = replace(FOUND, axis_col=20.7)


def test_counts_become_line_integrals_with_the_axis_found(tmp_path: Path) -> None:
    path = write_exchange(tmp_path / "scan.h5", SCAN)
    prepared, warnings = prepare(path, FOUND)
    # A count of 20000 is rounded to a half: 2.5e-5 of transmission near 1, less than 1e-4 of a line integral below 1.
    np.testing.assert_allclose(prepared.seen.data, SCAN.line_integrals(), atol=1e-4)
    assert prepared.origin.axis_col == pytest.approx(SCAN.axis_col, abs=0.25)
    assert prepared.geometry.axis_col == prepared.origin.axis_col
    np.testing.assert_allclose(prepared.geometry.angles, SCAN.angles)
    assert prepared.lines.unseen is None
    assert (prepared.origin.length_unit, prepared.origin.quantity, prepared.origin.n_projections) == (
        "mm",
        "counts",
        45,
    )
    assert warnings == []


def test_frames_of_a_view_that_stand_far_apart_are_named(tmp_path: Path) -> None:
    """40 columns, views 4 degrees apart: two of them blur the edge by 1.4 columns, six by 7."""
    path, selection = write_exchange(tmp_path / "scan.h5", SCAN), GIVEN
    for n, expected in ((2, []), (6, ["averages frames that are up to 20 degrees apart", "by 7 pixels"])):
        _, warnings = prepare(path, selection, frames_per_view=n)
        told = [warning for warning in warnings if "--frames-per-view" in warning]
        assert len(told) == bool(expected) and all(words in told[0] for words in expected)


@pytest.mark.parametrize(("rows", "binning", "shape"), [((1, 4), 1, (3, 40)), (None, 2, (2, 20)), ((0, 4), 3, (1, 13))])
def test_rows_and_bins(tmp_path: Path, rows: tuple[int, int] | None, binning: int, shape: tuple[int, int]) -> None:
    path = write_exchange(tmp_path / "scan.h5", replace(SCAN, pixel_size_mm=0.5))
    selection = replace(GIVEN, rows=rows, binning=binning)
    prepared, _ = prepare(path, selection)
    first, end = rows or (0, 4)
    expected = Geometry.parallel(SCAN.angles, (end - first, 40), pixel_pitch=0.5, axis_col=20.7).binned(binning)
    assert prepared.geometry.detector_shape == shape == expected.detector_shape
    assert prepared.geometry.axis_col == expected.axis_col
    assert prepared.geometry.pixel_pitch == 0.5 * binning
    assert prepared.origin.axis_col == 20.7
    # Counts are averaged, then the logarithm taken.
    transmission = np.exp(-SCAN.line_integrals())[:, : shape[0] * binning, : shape[1] * binning]
    mean = transmission.reshape(45, shape[0], binning, shape[1], binning).mean(axis=(2, 4))
    np.testing.assert_allclose(prepared.seen.data, -np.log(mean), atol=1e-4)


def test_auto_axis_of_binned_views_is_in_full_columns(tmp_path: Path) -> None:
    path = write_exchange(tmp_path / "scan.h5", TwoCylinders(shape=(2, 80), axis_col=40.7))
    prepared, _ = prepare(path, replace(FOUND, binning=2))
    assert prepared.origin.axis_col == pytest.approx(40.7, abs=0.5)
    assert prepared.geometry.axis_col == pytest.approx((prepared.origin.axis_col - 0.5) / 2)


def test_selected_views_and_views_held_out(tmp_path: Path) -> None:
    path = write_exchange(tmp_path / "scan.h5", SCAN)
    prepared, _ = prepare(path, replace(GIVEN, views="first:10"))
    assert prepared.geometry.n_views == 10
    assert prepared.origin.n_projections == 45
    np.testing.assert_array_equal(prepared.ids, np.arange(4, 14))  # 2 darks and 2 flats come first
    assert prepared.lines.unseen is not None
    data, geometry = prepared.lines.unseen.data, prepared.lines.unseen.geometry
    assert data.shape == (16, 4, 40)
    assert geometry.angles.min() >= SCAN.angles[10]
    np.testing.assert_allclose(data, replace(SCAN, angles=geometry.angles).line_integrals(), atol=1e-4)


@pytest.mark.parametrize(("axis_col", "turned"), [(20.7, 1 / 2), (8.0, 1)])
def test_selected_views_of_a_whole_turn_spread_over_it_where_the_axis_is_off_the_middle(
    tmp_path: Path, axis_col: float, turned: float
) -> None:
    whole = replace(SCAN, angles=np.linspace(0, 2 * np.pi, 48, endpoint=False))
    path = write_exchange(tmp_path / "scan.h5", whole)
    prepared, _ = prepare(path, replace(FOUND, views="fixed:12", axis_col=axis_col))
    expected = np.linspace(0, 2 * np.pi * turned, 12, endpoint=False)
    np.testing.assert_allclose(prepared.geometry.angles, expected, atol=1e-5)


def test_a_fading_beam_is_followed_by_flats_at_both_ends() -> None:
    """The beam loses 20 % from the first flat to the last: interpolation makes the views right."""
    n = SCAN.angles.size
    beam = np.linspace(1.0, 0.8, n + 2)
    views = DARK + BEAM * beam[1:-1, None, None] * np.exp(-SCAN.line_integrals())
    flats = [np.full((1, 4, 40), DARK + BEAM * b) for b in (beam[0], beam[-1])]
    data = np.concatenate([np.full((1, 4, 40), DARK), flats[0], views, flats[1]]).astype(np.float32)
    angles = np.concatenate([[np.nan] * 2, SCAN.angles, [np.nan]])
    prepared, told = prepare(ArraySource(data, [2, 1] + [0] * n + [1], angles), GIVEN)
    np.testing.assert_allclose(prepared.seen.data, SCAN.line_integrals(), atol=1e-4)
    assert told == []


def exposed(flats: list[float], dark: float = 0.1, views: float = 0.1) -> ArraySource:
    """A dark, the flats, the views and the flats again, each with as much light as its exposure in s gives."""
    n = SCAN.angles.size
    light = [np.full((1, 4, 40), BEAM * seconds / 0.1) for seconds in flats]
    images = [np.zeros((1, 4, 40)), *light, BEAM * views / 0.1 * np.exp(-SCAN.line_integrals()), *light]
    keys = [2] + [1] * len(flats) + [0] * n + [1] * len(flats)
    angles = np.full(len(keys), np.nan)
    angles[np.array(keys) == 0] = SCAN.angles
    exposures = np.array([dark, *flats, *[views] * n, *flats])
    return ArraySource(DARK + np.concatenate(images), keys, angles, exposures)


@pytest.mark.parametrize("flats", [[0.025], [0.3], [0.1, 0.02, 0.05]])
@pytest.mark.parametrize("binning", [1, 2])
def test_flats_with_an_exposure_of_their_own_count_as_exposed_like_the_views(flats: list[float], binning: int) -> None:
    """Without it every line integral would be off by log(flat exposure / view exposure)."""
    prepared, told = prepare(exposed(flats), replace(GIVEN, binning=binning))
    shape = (45, 4 // binning, binning, 40 // binning, binning)
    expected = -np.log(np.exp(-SCAN.line_integrals()).reshape(shape).mean(axis=(2, 4)))
    np.testing.assert_allclose(prepared.seen.data, expected, atol=1e-5)
    assert told == []


@pytest.mark.parametrize("unknown", ["flats", "views"])
def test_where_an_exposure_is_not_known_nothing_is_scaled(unknown: str) -> None:
    source = exposed([0.1])
    source.table.exposures[source.table.kinds == (1 if unknown == "flats" else 0)] = np.nan
    source.table.exposures[source.table.kinds == (0 if unknown == "flats" else 1)] = 7.0
    source.table.exposures[source.table.kinds == 2] = np.nan
    prepared, told = prepare(source, GIVEN)
    np.testing.assert_allclose(prepared.seen.data, SCAN.line_integrals(), atol=1e-5)
    assert told == []


def test_views_without_a_finite_pixel_are_left_out_aloud(tmp_path: Path) -> None:
    counts = SCAN.counts().astype(np.float32)
    counts[[3, 30]] = np.nan
    path = write_exchange(tmp_path / "scan.h5", SCAN, {"data": counts})
    prepared, warnings = prepare(path, FOUND)
    assert prepared.geometry.n_views == 43
    np.testing.assert_allclose(prepared.geometry.angles, np.delete(SCAN.angles, [3, 30]))
    np.testing.assert_allclose(prepared.seen.data, np.delete(SCAN.line_integrals(), [3, 30], axis=0), atol=1e-4)
    assert any(
        "2 of 45 projections have no finite pixel and are left out (first: frame 7)" in text for text in warnings
    )


def test_line_integrals_pass_as_they_are(tmp_path: Path) -> None:
    data = SCAN.line_integrals().astype(np.float32)
    data[3, 1, 20] = np.nan
    path = write_exchange(tmp_path / "scan.h5", SCAN, {"data": data, "data_white": None, "data_dark": None})
    prepared, _ = prepare(path, Selection(), quantity="line_integrals")
    assert prepared.origin.quantity == "line_integrals"
    left, right = data[3, 1, 19], data[3, 1, 21]
    assert prepared.seen.data[3, 1, 20] in (data[3, 0, 20], data[3, 2, 20], left, right)
    data[3, 1, 20] = prepared.seen.data[3, 1, 20]
    np.testing.assert_array_equal(prepared.seen.data, data)


def _estimate(value: float, confident: bool) -> AxisEstimate:
    return AxisEstimate(value, np.arange(3.0), np.arange(3.0), confident, "pair")


def test_a_doubtful_axis_is_used_aloud_unless_the_file_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(axis_module, "find_axis", lambda data, angles: _estimate(18.0, False))
    monkeypatch.setattr(axis_module, "axis_by_views", lambda data, geometry, lit: _estimate(17.0, False))
    source = counted(SCAN.counts(), SCAN.angles)
    prepared, warnings = prepare(source, FOUND)
    assert prepared.origin.axis_col == 18.0
    assert any("18.00, is not a clear optimum" in text and "--axis" in text for text in warnings)
    source.axis_col = 20.5
    prepared, warnings = prepare(source, FOUND)
    assert prepared.origin.axis_col == 20.5
    assert any("the file's column 20.50 is used" in text for text in warnings)


def test_a_doubtful_axis_gives_way_to_one_that_views_held_out_confirm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(axis_module, "find_axis", lambda data, angles: _estimate(18.0, False))
    prepared, warnings = prepare(counted(SCAN.counts(), SCAN.angles), FOUND)
    assert prepared.origin.axis_col == pytest.approx(SCAN.axis_col, abs=0.2)
    assert not any("axis" in text for text in warnings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "expected", "tolerance"),
    [
        ("diamond_24737_parallel_91x135x160.h5", 85.75, 0.5),
        pytest.param("aps2bm_tooth_181x2x640.h5", 295.6, 0.5, marks=pytest.mark.long),
    ],
)
def test_axis_of_measured_scans(shared_data: Path, name: str, expected: float, tolerance: float) -> None:
    prepared, _ = prepare(shared_data / name, Selection())
    assert prepared.origin.axis_col == pytest.approx(expected, abs=tolerance)
    assert prepared.origin.axis is not None
    assert prepared.origin.axis.confident
    assert np.isfinite(prepared.seen.data).all()


@pytest.mark.parametrize("views", [1000, 1800, 2161])
def test_of_a_full_turn_the_axis_is_given_pairs_of_opposite_views(views: int) -> None:
    angles = np.linspace(0, 2 * np.pi, views, endpoint=False)
    some = angles[spread_views(angles, 360, np.arange(views))]
    apart = np.abs(np.mod(some[:, None] - some + np.pi, 2 * np.pi) - np.pi).max(axis=1)
    assert some.size <= 360 and (np.pi - apart).max() <= np.pi / views + 1e-9
    half = np.linspace(0, np.pi, views, endpoint=False)
    assert spread_views(half, 360, np.arange(views)).size == 360


@pytest.mark.slow
def test_what_stands_in_the_beam_of_all_views_is_not_measured_and_becomes_no_wall() -> None:
    scan = TwoCylinders(shape=(6, 40))
    counts = scan.counts().astype(np.float32)
    counts[:, :, :12] = DARK + np.random.default_rng(0).normal(0, 3, counts[:, :, :12].shape)
    prepared, warnings = prepare(counted(counts, scan.angles, dtype=np.float32), FOUND)
    lost = "30.0% of the detector got no beam or is saturated. The rays of these pixels count as missing data."
    assert lost in warnings
    assert (
        prepared.sources.measured is not None
        and not prepared.sources.measured[:, :12].any()
        and prepared.sources.measured[:, 12:].all()
    )
    assert prepared.origin.axis_col == pytest.approx(scan.axis_col, abs=0.3)
    views = replace(prepared.views, weights=prepared.views.weights[...])
    volume = recon.reconstruct(views, method="fista-tv").volume
    truth = scan.truth(volume.grid)
    assert volume.data.max() < 1.5 * truth.max()
    assert float(volume.data[truth == 0].mean()) < 0.1 * float(truth[truth > 0].mean())
