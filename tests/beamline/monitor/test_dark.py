"""Darks that are not dark, and darks that change, are flagged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level, ScanContext
from beamline.monitor.dark import DarkCheck
from beamline.monitor.digest import digest
from drivers.base.frame import Frame, FrameKind


def only(flags: list[Flag]) -> list[Flag]:
    return [f for f in flags if f.check == "dark"]


def test_an_open_shutter_shows_at_the_first_flat(fake: Any) -> None:
    flags = only(fake.flags(fake.darks(light=1.0) + fake.flats()))
    assert [(f.frame, f.level) for f in flags] == [(5, Level.ALARM)]
    assert flags[0].score == pytest.approx(1.0, abs=0.01)
    assert "shutter" in flags[0].advice


def test_an_open_shutter_shows_in_darks_at_the_end(fake: Any) -> None:
    flags = only(fake.flags(fake.flats() + fake.views(3) + fake.darks(2, light=0.9)))
    assert [f.frame for f in flags] == [8, 9]


@pytest.mark.parametrize(("drift", "found"), [(4, 0), (-4, 0), (6, 2), (-20, 2)])
def test_drifting_darks(fake: Any, drift: float, found: int) -> None:
    late = [replace(f, counts=(f.counts.astype(int) + drift).astype("uint16")) for f in fake.darks(2)]
    flags = only(fake.flags(fake.references() + late))
    assert len(flags) == found
    for flag in flags:
        assert flag.level is Level.WARN
        assert flag.score == pytest.approx(drift, abs=1)


def small_darks(n: int, rng: np.random.Generator) -> list[Frame]:
    """Darks of 32 x 48 pixels around 200 counts: one pixel of 30 000 counts moves their mean by 19."""
    return [
        Frame(rng.normal(200, 4, (32, 48)).round().astype(np.uint16), FrameKind.DARK, i, i, i, np.nan, 1000.0 + i, 0.05)
        for i in range(n)
    ]


def flags_of(frames: list[Frame], preview_bin: int) -> list[Flag]:
    state, found = DarkCheck().start(), []
    for frame in frames:
        look = DarkCheck().look(state, frame, digest(frame.counts, 65535, preview_bin), ScanContext(65535, 32 * 48))
        state = look.state
        found += [] if look.flag is None else [look.flag]
    return found


@pytest.mark.parametrize("preview_bin", [1, 4, 16])
@pytest.mark.parametrize("hit", [0, 3])
def test_a_zinger_in_a_small_dark_is_no_drift(rng: np.random.Generator, preview_bin: int, hit: int) -> None:
    frames = small_darks(6, rng)
    frames[hit].counts[11, 17] = 30_000
    assert abs(float(frames[3].counts.mean()) - float(frames[0].counts.mean())) > 15
    assert flags_of(frames, preview_bin) == []


@pytest.mark.parametrize("preview_bin", [4, 16])
def test_light_on_a_part_of_the_dark_is_still_seen(rng: np.random.Generator, preview_bin: int) -> None:
    frames = small_darks(6, rng)
    frames[4].counts[:, :16] += 40  # a third of the frame
    (flag,) = flags_of(frames, preview_bin)
    assert (flag.frame, flag.level) == (4, Level.WARN)
    assert 5 < flag.score < 40 / 3


@pytest.mark.parametrize(("photons", "found"), [(8.0, 0), (0.0, 1)])
def test_an_offset_under_few_photons_is_no_light(photons: float, found: int) -> None:
    """8 photons of a count each beside 2 counts of readout are light; none at all is a shutter in the wrong state."""
    rng = np.random.default_rng(4)
    frames = [
        replace(frame, kind=kind, counts=(100 + rng.poisson(light, (32, 48)) + rng.normal(0, 2, (32, 48))).astype("u2"))
        for frame, kind, light in zip(
            small_darks(2, rng), (FrameKind.DARK, FrameKind.FLAT), (0.0, photons), strict=True
        )
    ]
    assert len(flags_of(frames, 4)) == len(flags_of(frames[::-1], 4)) == found
