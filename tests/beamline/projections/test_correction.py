"""The correction reads only the requested frames, flats and darks, with the same result in batches and at once."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import ConfigError
from beamline.projections.correction import ScanCorrectionPlan, apply, apply_in_batches, survey
from beamline.projections.corrections.air import Air
from beamline.projections.growing import ignores_shadow, outdated
from beamline.projections.preparation import Preparation
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.light import references_usable
from tests.beamline.array_source import ArraySource, counted, scan_of
from tests.beamline.prepared_views import feed_batches
from tests.beamline.scans import BEAM, DARK, TwoCylinders
from tests.messages import refused
from tests.slow_cases import others_slow

SCAN = TwoCylinders()
PLAIN = Selection(steps=(Air("none"),))


def plan_of(source: Any, selection: Selection) -> ScanCorrectionPlan:
    return survey(select(source, selection))


@pytest.mark.parametrize("air", ["auto", "none", "3,3"])
@pytest.mark.parametrize("sizes", others_slow([[45], [7, 20, 18], [1] * 45], 2))
@pytest.mark.parametrize("ended", ["with the last batch", "later"])
def test_batches_are_the_views_at_once_also_where_the_end_comes_later(sizes: list[int], air: str, ended: str) -> None:
    plan = plan_of(counted(SCAN.counts(), SCAN.angles), Selection(steps=(Air(air),)))
    ends = np.cumsum([2, *sizes])
    batches = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
    fed, state = feed_batches(plan, batches, ended=ended != "later")
    whole = apply(plan, np.arange(2, 47), warn=pytest.fail)
    if not outdated(state):
        np.testing.assert_array_equal(fed.data, whole.data)
    assert outdated(state) <= (air == "auto" and len(sizes) > 1)
    np.testing.assert_array_equal(fed.view_ids, whole.view_ids)


def test_at_once_in_batches_and_as_they_come_are_loops_over_one_plan(rng: np.random.Generator) -> None:
    """With bright spots, and a clamp in the beam of all views that is not in the flats."""
    counts = SCAN.counts()
    counts[:, :, :5] = DARK + rng.integers(-3, 4, (45, 4, 5))
    counts[rng.random(counts.shape) < 4e-3] += np.uint16(BEAM // 8)
    source, frames = counted(counts, SCAN.angles), np.arange(2, 47)
    out = np.empty((45, 4, 40), np.float32)
    plan = survey(select(source, PLAIN), frames)
    whole = apply(plan, frames)
    batches = apply_in_batches(plan, frames, out, 7, None, lambda n, of: None)
    fed, state = feed_batches(plan, np.array_split(frames, 6), warn=lambda sentence: None)
    assert plan.shadow is not None
    assert plan.shadow[0][:, :5].all() and not plan.shadow[0][:, 8:].any() and whole.replaced > 0
    for found in (batches, fed):
        np.testing.assert_array_equal(found.data, whole.data)
        np.testing.assert_array_equal(found.masked, whole.masked)
    assert not ignores_shadow(state, frames) and not outdated(state)
    unaware = replace(state, plan=survey(select(source, PLAIN)))
    assert ignores_shadow(unaware, frames)


PARTS = {  # image keys of two parts
    "flats at the start": ([2, 1, 1, *[0] * 9], [2, 1, 1, *[0] * 9]),
    "flats at both ends": ([2, 1, 1, *[0] * 9, 1, 1], [2, 1, 1, *[0] * 9, 1, 1]),
    "flats at the end, then at the start": ([2, *[0] * 9, 1, 1], [1, 1, *[0] * 9, 2]),
    "the second without flats": ([2, 1, 1, *[0] * 9, 1, 1], [2, *[0] * 9]),
}


@pytest.mark.parametrize("left", [0.9, 0.3])
@pytest.mark.parametrize("flats", PARTS)
def test_a_view_is_corrected_by_the_flats_of_its_part(flats: str, left: float, rng: np.random.Generator) -> None:
    """A beam that is weaker after an interruption, and a sample that lets half of it through."""
    first, second = PARTS[flats]
    keys, beam = np.array(first + second), np.repeat([BEAM, left * BEAM], [len(first), len(second)])
    light = beam * np.choose(keys, [0.5, 1.0, 0.0])
    data = rng.poisson(DARK + light[:, None, None] * np.ones((1, 20, 80))).astype(np.uint16)
    source = ArraySource(data, keys.tolist(), np.zeros(keys.size), np.ones(keys.size))
    source.state(part_starts=np.array([0, len(first)]))
    views = np.flatnonzero(keys == 0)
    plan = plan_of(source, PLAIN)
    found = apply(plan, views, warn=pytest.fail)
    truth = np.full(views.size, 0.5)
    if flats == "the second without flats":
        truth[9:] *= left  # by the beam of the first
        (warning,) = plan.warnings
        assert f"Frames {len(first)}-{keys.size - 1}, a part of the scan, have no usable flats" in warning
    else:
        assert plan.warnings == ()
    np.testing.assert_allclose(np.exp(-found.data).mean(axis=(1, 2)), truth, rtol=3e-3)  # 5 sigma of 1600 pixels


def test_dynamic_flats_of_a_beam_that_moves(rng: np.random.Generator) -> None:
    """Each frame has its own stripes; line integrals are exact up to noise, and a sentence says what was done."""
    counts, rows = SCAN.counts().astype(np.float64), np.arange(4)[:, None]
    flats = np.full((12, 4, 40), DARK + BEAM, np.float64)
    frames = np.concatenate([np.full((1, 4, 40), DARK), flats, counts])
    stripes = np.exp(0.1 * np.sin(rng.normal(0, 2, (len(frames), 1, 1)) + 1.5 * rows))
    data = rng.poisson((frames - DARK) * stripes * 20) / 20 + DARK
    source = scan_of(data[:1], data[1:13], data[13:], SCAN.angles, np.float32)
    errors = []
    for way in ("groups", "dynamic"):
        plan = plan_of(source, Selection(steps=(Preparation(flat_fields=way),)))
        assert bool(plan.done["flats"].sentence) is (way == "dynamic")
        errors.append(float(np.std(apply(plan, np.arange(13, 58)).data - SCAN.line_integrals())))
    assert errors[1] < 0.3 * errors[0]
    assert "principal components of the flats" in plan.done["flats"].sentence
    few = scan_of(data[:1], data[1:4], data[13:], SCAN.angles, np.float32)
    with refused(ConfigError):
        plan_of(few, Selection(steps=(Preparation(flat_fields="dynamic"),)))


def test_a_beam_that_decays_is_corrected_by_the_ring_current() -> None:
    """Without air columns; flats, which are dimmer by their own current, are scaled as well."""
    current = np.r_[np.nan, 80.0, 90.0, np.linspace(200, 150, 45)]
    light = np.concatenate([np.zeros((1, 4, 40)), np.full((2, 4, 40), BEAM), SCAN.counts() - DARK])
    data = DARK + light * np.nan_to_num(current)[:, None, None] / 180
    source = scan_of(data[:1], data[1:3], data[3:], SCAN.angles, np.float32)
    used = PLAIN.with_steps(Preparation(ring_current="use"))
    with refused(ConfigError):
        plan_of(source, used)
    source.state(currents=current)
    off = []
    for selection in (PLAIN, used):
        plan = plan_of(source, selection)
        off.append(float(np.abs(apply(plan, np.arange(3, 48)).data - SCAN.line_integrals()).max()))
    assert off[0] > 0.5 and off[1] < 0.01
    assert (
        plan.done["flats"].sentence
        == "The ring current of the projections varies from 0.857 to 1.143 times its median; each projection was "
        "scaled to its ring current."
    )
    current[2] = np.nan
    source.state(currents=current)
    with refused(ConfigError):
        plan_of(source, used)


BIAS, GLOW = 100.0, 20_000.0  # counts, and counts a second of dark current


def _exposed(dark: list[float], flat: float, views: np.ndarray, glow: float = GLOW) -> ArraySource:
    """Frames without noise: bias and dark current of their own exposure, light by the seconds."""
    lines, seconds = SCAN.line_integrals(), np.r_[np.repeat(dark, 2), flat, flat, views]
    light = np.concatenate([np.zeros((2 * len(dark), 4, 40)), np.ones((2, 4, 40)), np.exp(-lines)])
    t = seconds[:, None, None]
    keys, angles = [2] * 2 * len(dark) + [1, 1] + [0] * 45, np.r_[np.full(2 * len(dark) + 2, np.nan), SCAN.angles]
    data = BIAS + glow * t + 60_000.0 * t * light
    return ArraySource(np.round(data).astype(np.uint16), keys, angles, seconds)


@pytest.mark.parametrize(
    ("dark", "flat"),
    [
        ([0.2, 0.05], 0.05),  # each has darks of its own exposure
        ([0.4, 0.1], 0.05),  # two exposures tell that of any other
        ([0.05, 0.1, 0.2], 0.1),
    ],
)
def test_darks_are_dealt_by_exposure(dark: list[float], flat: float) -> None:
    source = _exposed(dark, flat, np.full(45, 0.2))
    frames, plan = np.flatnonzero(source.table.kinds == 0), plan_of(source, PLAIN)
    batches = apply_in_batches(plan, frames, np.empty((45, 4, 40), np.float32), 7, pytest.fail, lambda n, of: None)
    for found in (apply(plan, frames, warn=pytest.fail), batches):
        np.testing.assert_allclose(found.data, SCAN.line_integrals(), atol=3e-3)
    assert not list(references_usable(ScanEvidence(source)))


@pytest.mark.parametrize("flat", [0.1, 0.3])
def test_views_of_several_exposures_have_the_light_of_one(flat: float) -> None:
    views = 0.2 + 0.1 * np.sin(2 * SCAN.angles)
    source = _exposed([0.2], flat, views, glow=0.0)
    plan = plan_of(source, PLAIN)
    found = apply(plan, np.flatnonzero(source.table.kinds == 0), warn=pytest.fail).data
    np.testing.assert_allclose(found, SCAN.line_integrals(), atol=2e-3)
    assert plan.done["flats"].sentence.startswith("The exposure times of the projections vary from 0.1")
    assert not list(references_usable(ScanEvidence(source)))


def test_spots_are_sought_beside_views_with_the_sample_at_the_same_place(rng: np.random.Generator) -> None:
    """By their angles offset views are between others, which show the sample elsewhere."""
    views, angles = SCAN.counts()[2:], SCAN.angles
    wide = np.full_like(views[::3], DARK + BEAM)
    views[rng.random(views.shape) < 1e-3] += np.uint16(BEAM // 10)
    source = counted(np.concatenate([views, wide]), np.r_[angles, angles[::3]])
    source.state(aside=np.r_[np.zeros(2 + len(views)), np.full(len(wide), 0.5)])
    both = apply(plan_of(source, PLAIN), np.arange(2, len(source.table)))
    alone = apply(plan_of(counted(views, angles), PLAIN), np.arange(2, 2 + len(views)))
    assert alone.replaced > 0
    np.testing.assert_array_equal(both.data[: len(views) - 1], alone.data[:-1])  # the last is beside a wide one
