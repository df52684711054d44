"""Counts to line integrals: Beer-Lambert is recovered, and bad values neither pass nor spread."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.prep.correct import Plan, apply, correct
from recon.prep.counts_plan import CorrectionSettings, survey
from recon.prep.projections import Projections, merge_and_empty
from recon.prep.references import References, air_columns, dead_pixels, edge_profiles
from tests.messages import refused

PLAIN = CorrectionSettings(hot_threshold=np.inf, zinger_threshold=np.inf, air="none")


def sphere(views: int = 6, rows: int = 16, cols: int = 48) -> NDArray[np.float64]:
    """Line integrals of a sphere that moves a little from view to view, air on both sides."""
    v, r, c = np.ogrid[:views, :rows, :cols]
    s2 = (r - rows / 2) ** 2 + (c - cols / 2 - 0.5 * np.sin(v)) ** 2
    return 0.12 * 2 * np.sqrt(np.maximum(13.0**2 - s2, 0))


def beer_lambert(
    truth: NDArray[np.float64], rng: np.random.Generator, noise: float = 0.0
) -> tuple[NDArray[np.float64], References]:
    shape = truth.shape[1:]
    dark = 100 + rng.normal(0, 1.0, shape)
    flat = dark + 20_000 * (1 + 0.1 * np.sin(np.arange(shape[1]) / 9)) * (1 + rng.normal(0, 0.01, shape))
    counts = dark + (flat - dark) * np.exp(-truth) * (1 + noise * rng.normal(size=truth.shape))
    return counts, References(dark.astype(np.float32), ((0.0, flat.astype(np.float32)),))


def positions(counts: NDArray[np.generic]) -> NDArray[np.float64]:
    return np.arange(len(counts), dtype=np.float64)


@given(seed=st.integers(0, 2**32 - 1), views=st.integers(1, 4), rows=st.integers(1, 5), cols=st.integers(1, 9))
def test_beer_lambert_round_trips(seed: int, views: int, rows: int, cols: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0, 6, (views, rows, cols))
    counts, references = beer_lambert(truth, rng)
    result = correct(counts, positions(counts), references, PLAIN)
    np.testing.assert_allclose(result.data, truth, atol=2e-3)
    assert result.data.dtype == np.float32
    assert (result.floored, result.replaced, result.masked.any()) == (0, 0, False)
    np.testing.assert_array_equal(result.air, 1)
    np.testing.assert_array_equal(result.view_ids, np.arange(views))


def test_an_ordinary_sample_round_trips_with_everything_on(rng: np.random.Generator) -> None:
    truth = sphere()
    counts, references = beer_lambert(truth, rng)
    result = correct(counts, positions(counts), references)
    np.testing.assert_allclose(result.data, truth, atol=2e-3)
    assert (result.floored, result.replaced, result.masked.sum()) == (0, 0, 0)
    assert min(result.air_columns) >= 3
    np.testing.assert_allclose(result.air, 1, atol=1e-4)


@given(
    seed=st.integers(0, 2**32 - 1),
    low=st.integers(-500, 0),
    kind=st.sampled_from([np.uint16, np.int32, np.float32, np.float64]),
)
def test_counts_of_zero_and_below_stand_at_the_floor(seed: int, low: int, kind: type) -> None:
    rng = np.random.default_rng(seed)
    counts, references = beer_lambert(sphere(3, 6, 40), rng)
    hit = rng.random(counts.shape) < 0.1
    hit[:, [0, -1]] = hit[:, :, [0, -1]] = False  # at a corner they would be what a turn of the image moved in
    counts = np.where(hit, max(low, 0) if kind is np.uint16 else low, counts).astype(kind)
    result = correct(counts, positions(counts), references, replace(PLAIN, floor=1e-3))
    assert np.isfinite(result.data).all()
    np.testing.assert_allclose(result.data[hit], -np.log(1e-3), rtol=1e-6)
    assert result.data.max() <= -np.log(1e-3) * (1 + 1e-6)
    assert result.floored == pytest.approx(hit.mean())


@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(1e-3, 1e3))
def test_the_unit_of_the_counts_does_not_matter(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    counts, references = beer_lambert(sphere(), rng, noise=0.01)
    counts[2, 5, 7] *= 4
    references.dark[:] = 100
    references.dark[3, 3] += 9_000
    references.dark[2, 9] += 15  # not hot: a thousandth of the beam
    scaled = References(
        (references.dark * scale).astype(np.float32),
        tuple((p, (flat * scale).astype(np.float32)) for p, flat in references.flats),
    )
    first = correct(counts, positions(counts), references)
    second = correct(counts * scale, positions(counts), scaled)
    np.testing.assert_allclose(second.data, first.data, atol=1e-3)
    np.testing.assert_array_equal(second.masked, first.masked)
    assert second.replaced == first.replaced > 0


@given(seed=st.integers(0, 2**32 - 1), value=st.sampled_from([np.nan, np.inf, -np.inf]))
def test_what_is_not_finite_is_filled_and_does_not_spread(seed: int, value: float) -> None:
    rng = np.random.default_rng(seed)
    truth = sphere()
    counts, references = beer_lambert(truth, rng)
    bad = rng.random(counts.shape) < 0.02
    bad[:, 4, 20] = False
    counts[bad] = value
    references.dark[4, 20] = value
    result = correct(counts, positions(counts), references, replace(PLAIN, air="auto"))
    good = ~bad
    good[:, 4, 20] = False
    np.testing.assert_allclose(result.data[good], truth[good], atol=2e-3)
    # A neighbour's mean on a sphere: right to the curvature and, at the rim, to the step between pixels.
    assert np.abs(result.data - truth).max() < 1.2
    assert np.isfinite(result.data).all()
    assert result.masked.sum() == 1
    assert result.masked[4, 20]
    assert result.replaced == pytest.approx(bad.sum() / (bad.size - len(bad)))


def test_blind_and_hot_pixels_are_filled_from_their_neighbours(rng: np.random.Generator) -> None:
    """On a plane of line integrals the fill is exact up to the mean of exp over the neighbours."""
    truth = np.broadcast_to(0.01 * np.arange(40.0) + 0.5, (3, 12, 40)).copy()
    counts, references = beer_lambert(truth, rng)
    flat = references.flats[0][1]
    flat[5, 5] = references.dark[5, 5]  # blind
    flat[7:9, 20:23] = 0  # a blind patch
    references.dark[0, 0] = np.nan
    references.dark[3, 30] += 5_000  # hot, and so less is left for the beam
    references.dark[10, 8] += 5_000  # hot, though it answers the beam like the others
    flat[10, 8] += 5_000
    flat[9, 12] *= 0.5  # answers unlike its neighbours
    counts[:, 5, 5] = counts[:, 7:9, 20:23] = counts[:, 3, 30] = 0
    masked = dead_pixels(references.dark, [flat for _, flat in references.flats])
    expected = np.zeros_like(masked)
    expected[5, 5] = expected[7:9, 20:23] = expected[0, 0] = expected[3, 30] = expected[10, 8] = expected[9, 12] = True
    np.testing.assert_array_equal(masked, expected)
    result = correct(counts, positions(counts), references, CorrectionSettings(air="none"))
    np.testing.assert_array_equal(result.masked, expected)
    np.testing.assert_allclose(result.data, truth, atol=0.012)
    assert result.floored == 0
    again = correct(counts, positions(counts), references, CorrectionSettings(air="none"), masked=masked)
    np.testing.assert_array_equal(again.data, result.data)


def test_what_stands_behind_a_slit_is_filled_from_beside_it(rng: np.random.Generator) -> None:
    """Flat less dark is noise there, as often above zero as below: nothing of its ratio to a view may come through."""
    truth = sphere()
    counts, references = beer_lambert(truth, rng)
    behind = np.zeros(counts.shape[1:], bool)
    behind[:, :7] = behind[:, 44:] = True
    light = np.where(behind, 1e-4, 1.0)
    noise = rng.normal(0, 4.0, (len(counts) + 1, *behind.shape))
    flat = references.dark + (references.flats[0][1] - references.dark) * light + behind * noise[0]
    counts = references.dark + (counts - references.dark) * light + behind * noise[1:]
    seen = correct(counts, positions(counts), References(references.dark, ((0.0, flat.astype(np.float32)),)))
    np.testing.assert_array_equal(seen.masked, behind)
    np.testing.assert_allclose(seen.data[:, ~behind], truth[:, ~behind], atol=5e-3)
    assert np.abs(seen.data[:, behind]).max() < 0.1  # air, as at the edge of what is seen
    assert seen.floored == 0


def test_flats_are_interpolated_between_groups_and_held_outside(rng: np.random.Generator) -> None:
    dark = np.full((2, 5), 10, np.float32)
    groups = ((110.0, dark + 3000), (10.0, dark + 1000))  # not in order
    at = np.array([0.0, 10, 35, 60, 110, 500])
    beam = np.array([1000.0, 1000, 1500, 2000, 3000, 3000])
    counts = dark + np.broadcast_to((beam * np.exp(-0.7))[:, None, None], (6, 2, 5))
    result = correct(counts, at, References(dark, groups), PLAIN)
    np.testing.assert_allclose(result.data, 0.7, atol=1e-5)


def test_stacks_of_darks_and_flats_count_by_their_means(rng: np.random.Generator) -> None:
    counts, references = beer_lambert(sphere(), rng)
    (position, flat), change = references.flats[0], np.array([-3.0, 0.0, 3.0], np.float32)[:, None, None]
    stacks = References(references.dark + change, ((position, flat + 10 * change),))
    expected = correct(counts, positions(counts), references)
    np.testing.assert_allclose(correct(counts, positions(counts), stacks).data, expected.data, atol=1e-5)
    camera: Any = np.stack([np.full((2, 5), n, np.uint16) for n in (65535, 65533)])  # their sum is beyond 16 bits
    assert (References(camera, ((0.0, camera[:1]),)).dark == 65534).all()
    assert references.rows(slice(0, 2)).dark.shape == (2, 48)
    with refused(ValueError):
        References(references.dark, ((7.0, camera[:0]),))


def test_air_takes_out_the_beam(rng: np.random.Generator) -> None:
    truth = sphere(views=40)
    counts, references = beer_lambert(truth, rng, noise=0.01)
    beam = 0.68 * (1 + 0.1 * np.sin(np.arange(40) / 5))
    counts = references.dark + (counts - references.dark) * beam[:, None, None]
    result = correct(counts, positions(counts), references)
    np.testing.assert_allclose(result.air, beam, rtol=0.005)
    assert np.sqrt(np.mean((result.data - truth) ** 2)) < 0.012
    by_hand = correct(counts, positions(counts), references, CorrectionSettings(air=(4, 4)))
    np.testing.assert_allclose(by_hand.air, beam, rtol=0.005)
    assert by_hand.air_columns == (4, 4)
    one_side = correct(counts, positions(counts), references, CorrectionSettings(air=(0, 4)))
    np.testing.assert_allclose(one_side.air, beam, rtol=0.008)


def test_a_beam_that_tilted_since_the_flat_is_taken_out(rng: np.random.Generator) -> None:
    truth = sphere(views=40)
    counts, references = beer_lambert(truth, rng, noise=0.003)
    tilted = 0.7 * (1 + 0.04 * np.linspace(-1, 1, truth.shape[2]))
    counts = references.dark + (counts - references.dark) * tilted
    result = correct(counts, positions(counts), references)
    np.testing.assert_allclose(result.air, 0.7, rtol=0.002)
    assert np.abs(result.data - truth).mean(axis=(0, 1)).max() < 0.005


@pytest.mark.parametrize("density", [0.025, 0.004])
def test_a_sample_that_fills_the_view_has_no_air(rng: np.random.Generator, density: float) -> None:
    c = np.arange(100) - 50.0
    truth = np.broadcast_to(density * 2 * np.sqrt(62.0**2 - c**2), (20, 8, 100))
    counts, references = beer_lambert(truth, rng, noise=0.002)
    result = correct(counts, positions(counts), references)
    assert result.air_columns == (0, 0)
    np.testing.assert_array_equal(result.air, 1)


def test_sample_on_one_side_leaves_the_other_side_for_air() -> None:
    transmission = np.ones((5, 4, 64), np.float32)
    transmission[:, :, 40:] = 0.5
    left, right = air_columns(edge_profiles(transmission), 64)
    assert left >= 3
    assert right == 0


def test_sample_in_a_few_rows_only_is_still_no_air() -> None:
    """A pin wider than the sample: its rows at the bottom have no air at the edge."""
    transmission = np.ones((5, 32, 64), np.float32)
    transmission[:, 24:, 2:62] = 0.3
    assert air_columns(edge_profiles(transmission), 64) == (0, 0)


def test_zingers_are_restored_and_only_they(rng: np.random.Generator) -> None:
    truth = sphere(views=12, rows=24, cols=60)
    counts, references = beer_lambert(truth, rng, noise=0.01)
    options = CorrectionSettings(air="none")
    clean = correct(counts, positions(counts), references, options)
    hit = np.zeros(counts.shape, bool)
    for v, r, c in [(0, 3, 30), (3, 12, 30), (4, 12, 33), (7, 0, 0), (7, 20, 5), (11, 23, 59)]:
        hit[v, r, c] = True
    struck = np.where(hit, counts + 15_000, counts)
    result = correct(struck, positions(struck), references, options)
    assert result.replaced == pytest.approx(hit.mean())
    np.testing.assert_allclose(result.data[hit], truth[hit], atol=0.1)
    np.testing.assert_array_equal(result.data[~hit], clean.data[~hit])
    assert clean.replaced == 0


def test_a_bright_point_of_the_sample_stays(rng: np.random.Generator) -> None:
    """A hole one pixel wide that stands on the axis is in every view: it is no zinger."""
    truth = sphere(views=8)
    truth[:, 8, 24] = 0
    counts, references = beer_lambert(truth, rng, noise=0.005)
    result = correct(counts, positions(counts), references)
    np.testing.assert_allclose(result.data[:, 8, 24], 0, atol=0.05)
    assert result.replaced == 0


def test_one_view_alone_can_be_corrected(rng: np.random.Generator) -> None:
    truth = sphere(views=1)
    counts, references = beer_lambert(truth, rng, noise=0.01)
    counts[0, 8, 24] *= 5
    result = correct(counts, np.array([7.0]), references, view_ids=np.array([42]))
    np.testing.assert_array_equal(result.view_ids, [42])
    assert abs(result.data[0, 8, 24] - truth[0, 8, 24]) < 0.1


def good() -> tuple[NDArray[np.float64], References]:
    return beer_lambert(sphere(), np.random.default_rng(0))


def in_batches(
    counts: NDArray[np.generic], references: References, options: CorrectionSettings, ends: list[int]
) -> Projections:
    """All views surveyed, then corrected in batches that end at `ends`; the last one ends with the scan."""
    plan, at = survey(references, options), positions(counts)
    for view in range(len(counts)):
        ids = np.array([view])
        plan = plan.surveyed(plan.transmission(counts[view : view + 1], at[view : view + 1], ids))
    following: Plan = replace(plan, settings=replace(options, air=plan.air_columns))  # whichever views follow
    parts = []
    for first, end in zip([0, *ends], [*ends, len(counts)], strict=True):
        batch = slice(first, end)
        lines, following = apply(counts[batch], at[batch], following, np.arange(first, end), last=end == len(counts))
        parts.append(lines)
        if following.spots.waiting is not None:
            following.line_integrals(None)  # which changes nothing
    assert following.spots.waiting is None
    return merge_and_empty(parts)


@given(
    seed=st.integers(0, 2**32 - 1),
    views=st.integers(2, 9),
    cuts=st.sets(st.integers(1, 8)),
    air=st.sampled_from(["auto", "none", (4, 3)]),
)
def test_batches_of_any_size_are_the_views_at_once_to_the_bit(
    seed: int, views: int, cuts: set[int], air: object
) -> None:
    rng = np.random.default_rng(seed)
    counts, references = beer_lambert(sphere(views), rng, noise=0.01)
    counts[rng.random(counts.shape) < 2e-3] += 60_000  # zingers, which the neighbouring views tell
    counts[rng.random(counts.shape) < 2e-3] = np.nan
    flats = (*references.flats, (views / 2, references.flats[0][1] * np.float32(1.1)))
    references, options = References(references.dark, flats), CorrectionSettings(air=air)  # type: ignore[arg-type]
    whole = correct(counts, positions(counts), references, options)
    parts = in_batches(counts, references, options, sorted(cut for cut in cuts if cut < views))
    np.testing.assert_array_equal(parts.data, whole.data)
    np.testing.assert_array_equal(parts.air, whole.air)
    np.testing.assert_array_equal(parts.view_ids, whole.view_ids)
    assert (parts.masked == whole.masked).all() and parts.air_columns == whole.air_columns
    assert (parts.replaced, parts.floored) == pytest.approx((whole.replaced, whole.floored), rel=1e-12)


@pytest.mark.parametrize("air", ["auto", "none", (4, 3)])
def test_a_scan_may_end_after_its_last_view_was_fed(rng: np.random.Generator, air: object) -> None:
    """Nothing is left to feed, and the newest view waits: `line_integrals(None)` gives it out."""
    counts, references = beer_lambert(sphere(5), rng, noise=0.01)
    options = CorrectionSettings(air=air)  # type: ignore[arg-type]
    plan = survey(references, options)
    lines, following = apply(counts, positions(counts), plan, np.arange(5), last=False)
    early, _ = following.line_integrals(None)
    parts = [lines, following.line_integrals(None)[0]]
    np.testing.assert_array_equal(early.data, parts[1].data)
    assert [part.view_ids.tolist() for part in parts] == [[0, 1, 2, 3], [4]]
    whole = correct(counts, positions(counts), references, options)
    np.testing.assert_array_equal(merge_and_empty(parts).data, whole.data)


def test_apply_changes_neither_its_frames_nor_its_plan(rng: np.random.Generator) -> None:
    """What was corrected before, and in which order, leaves no trace: a plan is a value."""
    counts, references = beer_lambert(sphere(5), rng, noise=0.01)
    counts[2, 4, 7] += 60_000
    before, at, plan = counts.copy(), positions(counts), survey(references)
    first, after = apply(counts, at, plan, np.arange(5))
    apply(counts[::-1], at[::-1], plan, np.arange(5)[::-1], last=False)
    again, _ = apply(counts, at, plan, np.arange(5))
    np.testing.assert_array_equal(counts, before)
    np.testing.assert_array_equal(first.data, again.data)
    assert first.spots_left == again.spots_left and first.replaced == again.replaced > 0
    assert plan.air_columns == (0, 0) != after.air_columns == first.air_columns


def test_bad_input_is_refused_with_its_values() -> None:
    counts, references = good()
    at = positions(counts)
    dark, flat = references.dark, references.flats[0][1]
    with refused(ValueError):
        correct(counts, at, References(dark, ()))
    with refused(ValueError):
        correct(counts, at, References(flat, ((0.0, dark),)))
    with refused(ValueError):
        correct(counts, at, References(dark[:, 1:], references.flats))
    with refused(ValueError):
        correct(counts, at[1:], references)
    with refused(ValueError):
        correct(counts[0], at, references)
    with refused(ValueError):
        correct(counts, at, References(dark, ((3.0, flat), (3.0, flat))))
    with refused(ValueError):
        correct(counts, at, references, CorrectionSettings(air=(40, 9)))
    with refused(ValueError):
        correct(counts, np.where(at == 2, np.nan, at), references)
    with refused(ValueError):
        correct(counts, at, references, masked=np.zeros((5, 5), bool))
    with refused(ValueError):
        correct(counts, at, references, view_ids=np.arange(2))
    with refused(ValueError):
        correct(counts, at, references, masked=np.ones((16, 48), bool))
    with refused(ValueError):
        CorrectionSettings(floor=0)
    with refused(ValueError):
        CorrectionSettings(zinger_threshold=-1)


def test_views_without_values_or_beam_are_named() -> None:
    counts, references = good()
    at = positions(counts)
    lost = counts.copy()
    lost[4] = np.nan
    with refused(ValueError):
        correct(lost, at, references)
    counts[2] = references.dark
    with refused(ValueError):
        correct(counts, at, references, CorrectionSettings(air=(4, 4)))


def test_counts_and_references_are_left_as_they_were() -> None:
    counts, references = good()
    before = counts.copy(), references.dark.copy(), references.flats[0][1].copy()
    correct(counts, positions(counts), references)
    for array, copy in zip((counts, references.dark, references.flats[0][1]), before, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_diamond_scan_comes_out_on_air(shared_data: Path) -> None:
    """Flat brighter than the open beam by half, pixel (0, 0) dead in data, flat and dark."""
    with h5py.File(shared_data / "diamond_24737_parallel_91x135x160.h5") as file:
        group = file["exchange"]
        counts = group["data"][()]
        references = References(group["data_dark"][0], ((-1.0, group["data_white"][0]),))
    result: Projections = correct(counts, positions(counts), references)
    assert np.isfinite(result.data).all()
    assert result.masked[0, 0]
    assert result.masked.mean() < 1e-3
    assert result.replaced < 1e-4
    assert result.floored == 0
    assert 0.6 < result.air.min() <= result.air.max() < 0.72
    left, right = result.air_columns
    assert abs(np.median(result.data[:, :, :left]) + np.median(result.data[:, :, -right:])) < 0.02
    assert 2 < result.data.max() < 3
