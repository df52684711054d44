"""Darks that are not dark, and darks that change, are flagged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from beamline.monitor.flag import Flag, Level


def only(flags: list[Flag]) -> list[Flag]:
    return [f for f in flags if f.check == "dark"]


def test_an_open_shutter_shows_at_the_first_flat(bench: Any) -> None:
    flags = only(bench.watch(bench.darks(light=1.0) + bench.flats()))
    assert [(f.view, f.level) for f in flags] == [(5, Level.ALARM)]
    assert flags[0].score == pytest.approx(1.0, abs=0.01)
    assert "shutter" in flags[0].advice


def test_an_open_shutter_shows_in_darks_at_the_end(bench: Any) -> None:
    flags = only(bench.watch(bench.flats() + bench.views(3) + bench.darks(2, light=0.9)))
    assert [f.view for f in flags] == [8, 9]


@pytest.mark.parametrize(("drift", "found"), [(4, 0), (-4, 0), (6, 2), (-20, 2)])
def test_drifting_darks(bench: Any, drift: float, found: int) -> None:
    late = [replace(f, counts=(f.counts.astype(int) + drift).astype("uint16")) for f in bench.darks(2)]
    flags = only(bench.watch(bench.references() + late))
    assert len(flags) == found
    for flag in flags:
        assert flag.level is Level.WARN
        assert flag.score == pytest.approx(drift, abs=1)
