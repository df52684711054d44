"""Wrong darks and flats are left out and named, or the scan ends with an error; none spoils a volume silently."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamline.core.errors import DataError
from beamline.storage.rules.evidence import ScanEvidence
from drivers.base.frame import FrameKind
from tests.beamline.projections.replaced import BEAM, VIEWS, Blocks, decibels, line_integrals
from tests.slow_cases import others_slow

DARK, FLAT, VIEW = FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION
OTHERS = {DARK: (FLAT, VIEW), FLAT: (DARK, VIEW)}


@cache
def clean(groups: int, n: int, scale: float = 1.0) -> float:
    found, told = decibels(Blocks(groups, n, scale).source(), scale)
    assert told == []
    return found


@pytest.mark.slow
@given(
    groups=st.integers(1, 3), kind=st.sampled_from((DARK, FLAT)), by=st.integers(0, 1), at=st.integers(0, 2),
    view=st.integers(0, VIEWS - 1), frame=st.integers(-1, 2),
)  # fmt: skip
@settings(deadline=None, max_examples=10)
def test_any_group_or_frame_of_another_kind_is_named_or_refused(
    groups: int, kind: FrameKind, by: int, at: int, view: int, frame: int
) -> None:
    """`frame` -1: the whole group. Views run on from `view`; the volume is within 0.5 dB of the clean scan's."""
    blocks = Blocks(groups, 3)
    group, other = blocks.of(kind)[at % groups], OTHERS[kind][by]
    frames = np.concatenate(blocks.of(other))
    begin = min(view, len(frames) - 3) if other is VIEW else 0
    if frame < 0:
        group[:] = frames[begin : begin + 3]
    else:
        group[frame] = frames[begin]
    try:
        found, told = decibels(blocks.source())
    except DataError as error:
        assert f"{kind.name.capitalize()}s in " in str(error) or "Flats in " in str(
            error
        )  # lit darks, and no beam in flats
        assert groups == 1 and frame < 0  # no good group is left
        return
    assert found > clean(groups, 3) - 0.5
    assert told and all(f"{kind.name.capitalize()}s in " in line and "used instead" in line for line in told)


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 10])
def test_one_lit_dark_does_not_change_a_volume(n: int) -> None:
    for share in (1.0, 0.5):
        blocks = Blocks(1, n)
        blocks.of(DARK)[0][0] += share * BEAM
        found, (line,) = decibels(blocks.source())
        assert found > clean(1, n) - 0.1
        assert line.startswith("Darks in frame 0: these darks were exposed to the beam")


@pytest.mark.parametrize(("scale", "at"), others_slow([(1.0, 1), (0.05, 0), (3.0, 2)]))
def test_flats_with_the_sample_in_are_known_at_the_start_between_and_at_the_end(scale: float, at: int) -> None:
    blocks = Blocks(3, 3, scale)
    view = (0, VIEWS // 2, VIEWS - 1)[at]
    blocks.of(FLAT)[at][:] = blocks.taken(np.repeat(line_integrals(scale)[view : view + 1], 3, axis=0))
    found, told = decibels(blocks.source(), scale)
    assert told[0].startswith(("Flats in frame ", "Flats in frames ")) and "in the beam" in told[0]
    assert found > clean(3, 3, scale) - 0.5


def _flats_through(blocks: Blocks, what: str) -> np.ndarray:
    """Flats [3, row, col] through what is no view of the sample."""
    lines = line_integrals()[10]
    match what:
        case "displaced":
            lines = np.roll(lines, 14, axis=1)
        case "another sample":
            lines = 2.5 * np.roll(lines, -9, axis=1)
        case "a blade":
            lines = np.repeat(np.where(np.arange(len(lines)) < 5, 0.7, 0.0)[:, None], lines.shape[1], axis=1)
    return blocks.taken(np.repeat(lines[None], 3, axis=0))


@pytest.mark.parametrize(("what", "at"), others_slow([("displaced", 1), ("another sample", 0), ("a blade", 1)]))
def test_flats_through_anything_else_are_known_by_places_that_the_views_outshine(what: str, at: int) -> None:
    """The flats differ from one another, and not those are left out that look more like views."""
    blocks = Blocks(2, 3)
    blocks.of(FLAT)[at][:] = _flats_through(blocks, what)
    found, (line,) = decibels(blocks.source())
    rows = (3, 5) if at == 0 else (6 + VIEWS + 3, 6 + VIEWS + 5)
    assert line.startswith(f"Flats in frames {rows[0]}-{rows[1]}: the sample, or something else, was in the beam")
    assert found > clean(2, 3) - 0.5


def test_a_group_of_flats_alone_with_the_sample_in_is_refused() -> None:
    """The views outshine them in places, and hold no more matter elsewhere."""
    blocks = Blocks(1, 3)
    blocks.of(FLAT)[0][:] = blocks.of(VIEW)[0][20:23]
    with pytest.raises(DataError, match=r"Flats in frames 4-5: the sample was in the beam"):
        decibels(blocks.source())


@pytest.mark.parametrize(
    ("value", "said"), [(np.nan, "has no valid value"), (65535.0, "are saturated"), (0.0, "the beam was lost")]
)
def test_a_flat_without_counts_is_left_out(value: float, said: str) -> None:
    blocks = Blocks(1, 3)
    blocks.of(FLAT)[0][1, 4:] = value
    if value == 0:
        blocks.of(FLAT)[0][1] = value
    found, (line,) = decibels(blocks.source())
    assert line.startswith("Flats in frame 4: ") and said in line
    assert found > clean(1, 3) - 0.5


def test_a_dark_that_was_never_written_is_left_out() -> None:
    blocks = Blocks(1, 3)
    blocks.of(DARK)[0][0] = 0
    found, (line,) = decibels(blocks.source())
    assert line.startswith("Darks in frame 0: every pixel is 0") and found > clean(1, 3) - 0.1


@pytest.mark.parametrize(("scale", "drift"), others_slow([(0.05, 0.15), (1.0, 0.05)]))
def test_a_beam_that_drifts_is_no_sample_in_the_flats(scale: float, drift: float) -> None:
    """It leans and fades while views are taken: the first views look most like the flats, and others outshine them."""
    blocks, ramp = Blocks(2, 3, scale), np.linspace(-1, 1, 48)
    light = 1 + drift * (np.linspace(0, 1, VIEWS)[:, None, None] * ramp - 0.3)
    blocks.of(VIEW)[0][:] = 100 + (blocks.of(VIEW)[0] - 100) * light
    blocks.of(FLAT)[1][:] = 100 + (blocks.of(FLAT)[1] - 100) * light[-1]
    assert not any(finding.frames for finding in ScanEvidence(blocks.source()).findings)
